// scan_convert: scan lines to pixels of the probe plane. One work-item computes one pixel; global size (columns, rows).
//
// Along the line interpolation is linear (samples are four per wavelength); across lines it is cubic (Catmull-Rom),
// since lines are little denser than the beam is wide and linear interpolation shows as spokes in the far field.
// Buffers: grey uchar [scan line][samples]; image uchar [row][column], 0 outside the field.

#include "common.clh"

// atan(x / y) for y > 0, to 2e-6 rad: a thousandth of the spacing of scan lines.
inline float angle_of(float x, float y) {
  float small = fmin(fabs(x), y), large = fmax(fabs(x), y);
  float t = small / large, t2 = t * t;
  float a = t * (0.99997726f +
                 t2 * (-0.33262347f + t2 * (0.19354346f + t2 * (-0.11643287f + t2 * (0.05265332f - t2 * 0.0117212f)))));
  a = fabs(x) > y ? 1.57079633f - a : a;
  return x < 0.0f ? -a : a;
}

inline float sample_at(__global const uchar *grey, int line, int scan_lines, int samples, int bin, float part) {
  __global const uchar *at = grey + clamp(line, 0, scan_lines - 1) * samples + bin;
  return mix((float)at[0], (float)at[1], part);
}

__kernel void scan_convert(__constant const Scene *scene, __global const uchar *grey, float left, float top,
                           float pixel_x, float pixel_y, __global uchar *image) {
  int column = get_global_id(0), row = get_global_id(1);
  float x = left + (column + 0.5f) * pixel_x, y = top + (row + 0.5f) * pixel_y;
  float lateral, depth;
  if (scene->linear) {
    lateral = x;
    depth = y;
  } else {
    float from_apex = y + scene->apex_radius_mm;
    depth = sqrt(x * x + from_apex * from_apex) - scene->apex_radius_mm;
    lateral = from_apex > 0.0f ? angle_of(x, from_apex) : 1e9f;  // the field opens to less than 180 degrees
  }
  float place = (lateral - scene->first_line) / scene->line_spacing, sample = depth / scene->sample_mm;
  int here = row * get_global_size(0) + column;
  if (place < -0.5f || place > scene->scan_lines - 0.5f || depth < 0.0f || depth >= scene->depth_mm) {
    image[here] = 0;
    return;
  }
  int bin = min((int)sample, scene->samples - 2);
  float part = fmin(sample - bin, 1.0f);
  place = clamp(place, 0.0f, scene->scan_lines - 1.0f);
  int line = (int)place;
  float t = place - line;
  float a = sample_at(grey, line - 1, scene->scan_lines, scene->samples, bin, part);
  float b = sample_at(grey, line, scene->scan_lines, scene->samples, bin, part);
  float c = sample_at(grey, line + 1, scene->scan_lines, scene->samples, bin, part);
  float d = sample_at(grey, line + 2, scene->scan_lines, scene->samples, bin, part);
  float value = b + 0.5f * t * (c - a + t * (2.0f * a - 5.0f * b + 4.0f * c - d + t * (3.0f * (b - c) + d - a)));
  image[here] = (uchar)(clamp(value, 0.0f, 255.0f) + 0.5f);
}
