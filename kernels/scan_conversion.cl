// scan_convert: scan lines to pixels of the probe plane (docs/physics.md#6-from-rf-to-image). One work-item computes
// LANES pixels of a row; global size (columns / LANES rounded up, rows).
//
// Interpolation along a line is linear (by default the sample spacing is an eighth of a wavelength, four samples per
// cycle of the carrier). Across lines it is cubic (Catmull-Rom): the line spacing is only slightly smaller than the
// beam width, and linear interpolation would be visible as spokes in the far field.
// Buffers: grey uchar [scan line][samples]; image uchar [row][column], 0 outside the field.

#include "display.clh"

// atan(x / y) for y > 0, to 2e-6 rad: a thousandth of the spacing of scan lines.
inline floatn angle_of(floatn x, floatn y) {
  floatn small = fmin(fabs(x), y), large = fmax(fabs(x), y);
  floatn t = small / large, t2 = t * t;
  floatn a = t * (0.99997726f + t2 * (-0.33262347f +
                                      t2 * (0.19354346f + t2 * (-0.11643287f + t2 * (0.05265332f - t2 * 0.0117212f)))));
  a = fabs(x) > y ? 1.57079633f - a : a;
  return x < 0.0f ? -a : a;
}

__kernel void scan_convert(Frame frame, __global const uchar *grey, float left, float top, float pixel_x, float pixel_y,
                           int columns, __global uchar *image) {
  const int column = get_global_id(0) * LANES, row = get_global_id(1);
  const int scan_lines = frame->scan_lines, samples = frame->samples;
  const floatn x = left + (TO_FLOATN(column + LANE_INDEX) + 0.5f) * pixel_x;
  const floatn y = (floatn)(top + (row + 0.5f) * pixel_y);
  floatn lateral = x * frame->steering_cos - y * frame->steering_sin;
  floatn depth = x * frame->steering_sin + y * frame->steering_cos + frame->start_mm;
  if (!frame->linear) {
    const floatn from_apex = y + frame->apex_radius_mm;
    depth = sqrt(x * x + from_apex * from_apex) - frame->apex_radius_mm;
    lateral = from_apex > 0.0f ? angle_of(x, from_apex) : (floatn)(1e9f);  // the field opens to less than 180 degrees
  }
  const floatn place = (lateral - frame->first_line) / frame->line_spacing, sample = depth / frame->sample_mm;
  const intn inside = (place >= -0.5f) & (place <= scan_lines - 0.5f) & (depth >= 0.0f) & (depth < frame->depth_mm) &
                      (y >= frame->top_mm) & (y < frame->bottom_mm);
  if (!ANY_LANE(inside)) {
    for (int j = 0; j < min(LANES, columns - column); j++) image[row * columns + column + j] = 0;
    return;
  }
  const intn bin = clamp(TO_INTN(sample), (intn)(0), (intn)(samples - 2));
  const floatn on_line = clamp(place, 0.0f, scan_lines - 1.0f);
  const intn line = TO_INTN(on_line);
  const floatn part = fmin(sample - TO_FLOATN(bin), 1.0f);
  floatn around[4];  // the grey levels of the four lines about each pixel, at its depth
  for (int n = 0; n < 4; n++) {
    SPREAD(int, at, clamp(line + (n - 1), (intn)(0), (intn)(scan_lines - 1)) * samples + bin);
    uchar near[LANES], far[LANES];
    for (int j = 0; j < LANES; j++) {
      near[j] = grey[at[j]];
      far[j] = grey[at[j] + 1];
    }
    const floatn level = GREY_LANES(near);
    around[n] = fma(part, GREY_LANES(far) - level, level);
  }
  const floatn a = around[0], b = around[1], c = around[2], d = around[3], t = on_line - TO_FLOATN(line);
  const floatn value = b + 0.5f * t * (c - a + t * (2.0f * a - 5.0f * b + 4.0f * c - d + t * (3.0f * (b - c) + d - a)));
  const floatn shown = inside ? clamp(value, 0.0f, 255.0f) + 0.5f : (floatn)(0.0f);
  if (columns - column >= LANES) {
    STORE_GREY(shown, image + row * columns + column);
    return;
  }
  SPREAD(float, shown_, shown);
  for (int j = 0; j < columns - column; j++) image[row * columns + column + j] = (uchar)shown_[j];
}
