// fans and screens: what soft tissue does to a beam from an aperture (docs/physics.md#beams-from-an-aperture).
//
// Soft tissue changes the phase of a wave long before it bends it, so the aperture is treated as a phase screen: paths
// are straight, and the echo is the coherent sum over them. From every point of the face goes a fan of straight rays
// with running sums of delay and attenuation (fans). For every traced line and depth, the sums along the lines from the
// points of its aperture to the point on its axis are interpolated between those rays; they give the mean delay, the
// deflection of the beam, the loss of coherence and the mean attenuation (screens). raytracing.cl follows them (beams)
// up to the first strong border (is_soft). What phases remain after mean and deflection make the beam wider (beam.cl).
//
// The elevational aperture is represented by three sheets, at quantiles of the elevational beam (ROW_SIGMA).
//
// Buffers: voxels ushort [k][j][i] (medium.py); acoustics float4 [label]: extra path per mm, attenuation in nepers per
// mm (both ways), speed of sound, impedance; sums float4 [row][point][angle][depth]: extra path in mm, nepers, nepers
// that strong tissue takes (the lowest bit says whether the step before is in it), and the sheet's part in the
// elevational deflection in mm; screens float4 [screen line][depth], depths from screen_step on: nepers lost both ways,
// extra path in mm, deflection in the lateral and in the elevational direction in mm; shades float4 [screen
// line][depth]: the nepers of them that strong tissue takes; those that it takes right behind its last end between the
// depth before and this one; those that soft tissue has taken from what arrives, on average; and the distance from
// that end in mm, NO_END if there is none, negative in strong tissue. spreads float2 [screen line][depth]: width of the
// beam and a factor of its echoes, both relative to an undisturbed one; beams float4 [traced line][1 + depth] as
// screens, followed by float4 [traced line][1 + depth] as shades, but that the last is 1, -1 where the beam is in
// strong tissue, and -2 where that does not end between this depth and the previous one.

#include "common.clh"

#define ROWS 3
// Nodes and weights of the three-point Gauss-Hermite rule for the power of the elevational beam.
#define ROW_SIGMA 1.2247449f
#define ROW_WEIGHT(row) ((row) == 1 ? 0.6666667f : 0.1666667f)
#define MOST_POINTS 16        // of one aperture: it has at most 12 intervals, and two partial ones
#define STEEPEST 0.1f         // slope of the delay: tissue is soft
#define MOST_SPREAD 3.0f      // of a beam
#define BENT_PER_MM 4.0f      // nepers, both ways, that a line loses in strong tissue that bends what goes through
#define LEAST_PER_MM 1e-3f    // nepers by which strong tissue differs from soft, so that its ends are seen in the sums
#define NOT_TOGETHER 1.7f     // axes from 1 / this of their distance without tissue on do not come together; ...
#define MOST_GATHERED 64      // ... lines whose strips have scatterers in common, ...
#define LEAST_GATHERED 0.4f   // ... and the least part that is left of their power
#define LEFT_FOR_MEANS 0.01f  // of the power of a line that strong tissue stops
#define EDGE_OF_BONE 0.75f    // part of a cell from which lines are lost in it by their length
#define LEAST_OPEN 0.05f      // amplitude that is left by the part that bone covers
#define LEAST_POWER 1e-7f     // of a beam relative to an undisturbed one
#define NO_END 1e3f
#define LEAST_UNEVEN 0.02f  // nepers, both ways, by which soft tissue may take more from one line than from another
#define MOST_UNEVEN 0.7f    // ... and up to which that belongs to the width of the beam

// Position along the face (mm) and angle of the normal of a point of the array.
inline float point_angle(Frame frame, float along) { return frame->flat_face ? 0.0f : along / frame->apex_radius_mm; }

inline float2 point_on_face(Frame frame, float along) {
  const float angle = point_angle(frame, along);
  return angle == 0.0f ? (float2)(along, 0.0f) : frame->apex_radius_mm * (float2)(sin_of(angle), cos_of(angle) - 1.0f);
}

// Extra path and nepers per mm of tissue beside `soft`, of which strong tissue has the attenuation, and also the extra
// path if it bends what goes through; whether it does; and the nepers per mm that it takes more, if it does not.
inline float4 rates_beside(float4 soft, float4 tissue) {
  if (is_soft(soft.z, soft.w, tissue.z, tissue.w)) return (float4)(tissue.xy, 0.0f, 0.0f);
  if (bends(soft.z, tissue.z)) return (float4)(soft.xy, 1.0f, 0.0f);
  return (float4)(tissue.x, soft.y, 0.0f, tissue.y - soft.y);
}

// At the fraction f of a cell of voxels, linear between the eight labels: extra path and nepers per mm, its part that
// is tissue which bends, and the nepers per mm that strong tissue takes more; the first two alone where all tissue is
// soft.
#define DEFINE_IN_CELL(floats, name, RATES)                                                                    \
  inline floats name(__global const float4 *acoustics, __global const ushort *cell, int nx, int nxy, float3 f, \
                     float4 soft) {                                                                            \
    floats along_y[2], along_z[2];                                                                             \
    for (int z = 0; z < 2; z++) {                                                                              \
      for (int y = 0; y < 2; y++) {                                                                            \
        __global const ushort *row = cell + y * nx + z * nxy;                                                  \
        const floats a = RATES(acoustics[row[0] & LABEL_MASK]), b = RATES(acoustics[row[1] & LABEL_MASK]);     \
        along_y[y] = a + f.x * (b - a);                                                                        \
      }                                                                                                        \
      along_z[z] = along_y[0] + f.y * (along_y[1] - along_y[0]);                                               \
    }                                                                                                          \
    return along_z[0] + f.z * (along_z[1] - along_z[0]);                                                       \
  }
#define BESIDE_SOFT(tissue) rates_beside(soft, tissue)
#define OF_SOFT(tissue) (tissue).xy
DEFINE_IN_CELL(float4, rates_in_cell, BESIDE_SOFT)
DEFINE_IN_CELL(float2, soft_rates, OF_SOFT)

// What a border takes from an amplitude, both ways, in nepers.
inline float border_nepers(float impedance, float other_impedance) {
  return -log_fast(fmax(1.0f - square_reflection(impedance, other_impedance), 1e-6f));
}

// Stored depths that lines need of the ray at an angle from a point of a flat face whose lines begin in its middle: no
// traced line goes where the ray, or the previous one, has left the sector of them. All of other faces.
inline int depths_needed(Frame frame, float along, float angle) {
  const int depths = frame->fan_depths;
  if (frame->linear || frame->apex_radius_mm > 0.0f) return depths;
  const float reach = -frame->first_line + frame->guard_lines * frame->line_spacing / frame->lateral_rays;
  const float beyond = fabs(angle) - frame->fan_angle_step - reach, inwards = angle < 0.0f ? along : -along;
  if (beyond <= 0.0f) return depths;
  return (int)fmin((float)depths, fmax(inwards, 0.0f) * cos_of(reach) / sin_of(beyond) / frame->fan_step + 3.0f);
}

// One work-item follows one ray of a fan. Global size (angles, points, rows). Look-ups are trilinear, so that sums over
// steps of a voxel are smooth. Strong tissue counts as the tissue in front of it, and its additional losses are
// recorded: by its borders, its attenuation, and by refraction. With `all_soft`, no tissues have a strong border.
ONE_BY_ONE
__kernel void fans(Frame frame, __global const ushort *voxels, __global const float4 *acoustics, int all_soft,
                   __global float *sums) {
  const int ray = get_global_id(0), point = get_global_id(1), row = get_global_id(2);
  const int depths = frame->fan_depths;
  const int nx = frame->dims[0], ny = frame->dims[1], nxy = nx * ny;
  const float3 top = (float3)(nx - 1.001f, ny - 1.001f, frame->dims[2] - 1.001f);
  __global float *to = sums + ((row * frame->fan_points + point) * frame->fan_angles + ray) * depths * 4;

  const float along = frame->fan_first + point * frame->fan_pitch;
  const float2 origin = point_on_face(frame, along);
  const float own = frame->fan_first_angle + ray * frame->fan_angle_step;
  const float angle = own + point_angle(frame, along);
  const float3 start =
      affine_point(frame->ras_to_voxel, affine_point(frame->probe_to_ras, (float3)(origin.x, origin.y, 0.0f)));
  const float3 step = affine_vector(frame->ras_to_voxel,
                                    affine_vector(frame->probe_to_ras, (float3)(sin_of(angle), cos_of(angle), 0.0f)));
  const float3 aside =
      affine_vector(frame->ras_to_voxel, affine_vector(frame->probe_to_ras, (float3)(0.0f, 0.0f, 1.0f))) *
      (ROW_SIGMA * (row - 1));
  const float length = frame->fan_step;

  float covered = 0.0f;           // the largest part of a cell that was bone
  int label = 0, was_strong = 0;  // of the last soft tissue, first the coupling medium; whether strong tissue is behind
  int leaving = 0;                // whether it was in this cell or the last ones
  float4 soft = acoustics[0];
  float impedance = 0.0f;
  float4 sum = (float4)(0.0f);
  float lean = 0.0f;
  vstore4(sum, 0, to);
  const int needed = all_soft ? depths_needed(frame, along, own) : depths;
  for (int depth = 1; depth < needed; depth += 8) {
    // Eight look-ups at once, which are nearly always in one tissue.
    const float8 path = (depth - 0.5f + (float8)(0, 1, 2, 3, 4, 5, 6, 7)) * length;
    // Over eight of them it is nearly linear.
    const float sigma0 = elevation_sigma(frame, path.s0), sigma7 = elevation_sigma(frame, path.s7);
    const float8 sigma = fma((float8)(0, 1, 2, 3, 4, 5, 6, 7), (float8)((sigma7 - sigma0) / 7.0f), (float8)(sigma0));
    const float8 x = clamp(start.x + path * step.x + sigma * aside.x, (float8)(0.0f), (float8)(top.x));
    const float8 y = clamp(start.y + path * step.y + sigma * aside.y, (float8)(0.0f), (float8)(top.y));
    const float8 z = clamp(start.z + path * step.z + sigma * aside.z, (float8)(0.0f), (float8)(top.z));
    const int8 i = convert_int8(x), j = convert_int8(y), k = convert_int8(z);
    int here[8], differs = depth == 1;
    float turn_per_rate[8], fx[8], fy[8], fz[8];
    vstore8((k * ny + j) * nx + i, 0, here);
    for (int n = 0; n < 8; n++) differs |= (voxels[here[n]] & (LABEL_MASK | SAME_LABEL)) ^ (label | SAME_LABEL);
    // A path turns towards slower tissue by the gradient of the extra path, here the difference of the outer sheets
    // over their distance; what a turn moves aside grows with the length behind it.
    vstore8(length / (2.0f * ROW_SIGMA * sigma), 0, turn_per_rate);
    if (differs) {
      vstore8(x - convert_float8(i), 0, fx);
      vstore8(y - convert_float8(j), 0, fy);
      vstore8(z - convert_float8(k), 0, fz);
    }
    for (int n = 0; n < min(8, depths - depth) && all_soft; n++) {
      float2 rate = soft.xy;
      if (differs) {
        __global const ushort *cell = voxels + here[n];
        const int first = cell[0];
        label = first & LABEL_MASK;
        rate = soft.xy = acoustics[label].xy;
        if (!(first & SAME_LABEL)) rate = soft_rates(acoustics, cell, nx, nxy, (float3)(fx[n], fy[n], fz[n]), soft);
      }
      const float turned = rate.x * turn_per_rate[n];
      sum += (float4)(length * rate.x, length * rate.y, 0.0f, length * (lean + 0.5f * turned));
      lean += turned;
      vstore4(sum, depth + n, to);
    }
    for (int n = 0; n < min(8, depths - depth) && !all_soft; n++) {
      float2 rate = soft.xy;
      float strong = 0.0f, bone = 0.0f, excess = 0.0f;
      int is_strong = 0, is_seen = 0;  // as strong
      if (differs) {
        __global const ushort *cell = voxels + here[n];
        const float3 f = (float3)(fx[n], fy[n], fz[n]);
        const int first = cell[0];
        const int is_mixed = !(first & SAME_LABEL);
        const int corner = (f.x > 0.5f) + (f.y > 0.5f ? nx : 0) + (f.z > 0.5f ? nxy : 0);
        const int nearest = (is_mixed ? cell[corner] : first) & LABEL_MASK;
        const float4 found = acoustics[nearest];
        const int begins = depth + n == 1 && !is_covered(soft.z, found.z);
        const int goes_on = begins || is_soft(soft.z, soft.w, found.z, found.w);
        if (goes_on) {
          soft = found;
          label = nearest;
        }
        const float4 in_cell =
            is_mixed ? rates_in_cell(acoustics, cell, nx, nxy, f, soft) : (float4)(soft.xy, 0.0f, 0.0f);
        rate = in_cell.xy, bone = in_cell.z, excess = in_cell.w;
        is_strong = !goes_on;
        if (is_strong || was_strong) strong = border_nepers(was_strong ? impedance : soft.w, found.w);
        impedance = found.w;
        if (is_strong) {
          if (bends(soft.z, found.z)) {
            if (!is_mixed) bone = 1.0f;
            strong += length * fmax(BENT_PER_MM * ramp(EDGE_OF_BONE, 1.0f, bone), LEAST_PER_MM);
          } else {
            if (!is_mixed) {
              excess = found.y - soft.y;
              rate.x = found.x;
            }
            if (fabs(excess) < LEAST_PER_MM) excess = LEAST_PER_MM;
          }
        }
        // Of a cell at the border, strong tissue beyond it has a part too. It begins there, as bone does, and ends
        // where soft tissue is nearest.
        is_seen = is_strong || strong != 0.0f || (excess != 0.0f && !leaving);
        leaving = is_strong || (leaving && excess != 0.0f);
        strong += length * excess;
        // Beside bone a line is covered in part, as its neighbours are in whole: no step as the edge comes to it.
        if (bone > covered) {
          strong += 2.0f * log_fast((1.0f - covered) / fmax(1.0f - bone, LEAST_OPEN));
          covered = fmin(bone, 1.0f - LEAST_OPEN);
          is_seen = 1;
        }
      } else if (was_strong) {
        strong = border_nepers(impedance, soft.w);
        is_seen = strong != 0.0f;
        leaving = 0;
      }
      was_strong = is_strong;
      const float turned = rate.x * turn_per_rate[n];
      sum += (float4)(length * rate.x, length * rate.y, strong, length * (lean + 0.5f * turned));
      lean += turned;
      float4 stored = sum;
      stored.z = as_float((as_uint(sum.z) & ~1u) | is_seen);
      vstore4(stored, depth + n, to);
    }
  }
}

// The amplitude that is left after these nepers (both ways) in strong tissue.
inline float passed_strong(float nepers) { return nepers == 0.0f ? 1.0f : exp_fast(-0.5f * fmax(nepers, -4.0f)); }

// The sums of a point's fan in the direction `place` (in rays) at distance `far` (in stored depths); of strong tissue
// the amplitude that passes it. Between a ray in bone and one beside it that is half, where the mean of the nepers is
// dark.
inline float4 sums_at(Frame frame, __global const float *sums, int row, int point, float place, float far) {
  const int ray = (int)place, depth = (int)far, depths = frame->fan_depths;
  const float t = place - ray, u = far - depth;
  __global const float *near =
      sums + (((row * frame->fan_points + point) * frame->fan_angles + ray) * depths + depth) * 4;
  __global const float *next = near + depths * 4;
  const float4 a = vload4(0, near) + u * (vload4(1, near) - vload4(0, near));
  const float4 b = vload4(0, next) + u * (vload4(1, next) - vload4(0, next));
  float4 result = a + t * (b - a);
  result.z = passed_strong(a.z) + t * (passed_strong(b.z) - passed_strong(a.z));
  return result;
}

// Adds `share` times the autocorrelation of the wave from `count` points to `sum`. It is the spectrum of the intensity
// across the beam.
inline void add_correlation(const float2 *wave, int count, float share, float2 *sum) {
  for (int apart = 0; apart < count; apart++)
    for (int i = 0; i + apart < count; i++) {
      const float2 a = wave[i], b = wave[i + apart];
      sum[apart] += share * (float2)(a.x * b.x + a.y * b.y, a.x * b.y - a.y * b.x);
    }
}

// The integral of the product of two intensities across the beam, by Parseval's theorem.
inline float overlap(const float2 *first, const float2 *second, int count) {
  float sum = 0.5f * first[0].x * second[0].x;
  for (int apart = 1; apart < count; apart++)
    sum += first[apart].x * second[apart].x + first[apart].y * second[apart].y;
  return sum;
}

// Where the line from a point of the face to a target lies in its fan: direction in rays, distance in stored depths,
// and in mm.
inline float3 place_in_fan(Frame frame, float along, float2 target) {
  const float2 towards = target - point_on_face(frame, along);
  const float away = sqrt(towards.x * towards.x + towards.y * towards.y);
  const float turned = direction_of(towards.x, towards.y) - point_angle(frame, along);
  return (float3)(clamp((turned - frame->fan_first_angle) / frame->fan_angle_step, 0.0f, frame->fan_angles - 1.001f),
                  clamp(away / frame->fan_step, 0.0f, frame->fan_depths - 1.001f), away);
}

// The axis of a screen line: where it leaves the face, its direction, and its place along the face.
typedef struct {
  float2 origin, direction;
  float centre;
} Axis;

inline Axis axis_of(Frame frame, int line) {
  const float traced = (float)line * (frame->traced_lines - 1) / (frame->screen_lines - 1);
  const float position = frame->first_line + frame->line_spacing * (traced - frame->guard_lines) / frame->lateral_rays;
  const float radius = frame->apex_radius_mm;
  Axis axis;
  axis.direction =
      frame->linear ? (float2)(frame->steering_sin, frame->steering_cos) : (float2)(sin_of(position), cos_of(position));
  axis.centre = frame->linear ? position / frame->steering_cos : radius * position;
  if (frame->steered && !frame->linear) axis.centre = radius * axis.direction.x / axis.direction.y;
  axis.origin =
      frame->flat_face ? (float2)(axis.centre, 0.0f) : radius * (float2)(axis.direction.x, axis.direction.y - 1.0f);
  return axis;
}

// The rays beside the axis at the depth `path`: the point before it, the part of the way to the next one, the places in
// the fans of both, and the stored depth.
typedef struct {
  int before, depth;
  float part, places[2];
} Beside;

inline Beside rays_beside(Frame frame, Axis axis, float path) {
  const float place = clamp((axis.centre - frame->fan_first) / frame->fan_pitch, 0.0f, frame->fan_points - 1.0f);
  Beside beside;
  beside.before = (int)place;
  beside.part = place - beside.before;
  for (int n = 0; n < 2; n++) {
    const int point = min(beside.before + n, frame->fan_points - 1);
    const float3 at =
        place_in_fan(frame, frame->fan_first + point * frame->fan_pitch, axis.origin + path * axis.direction);
    beside.places[n] = at.x;
    beside.depth = (int)at.y;
  }
  return beside;
}

// How much of the axis is in strong tissue in the step behind the stored depth `depth`: of the rays beside it.
inline float share_strong(Frame frame, __global const float *sums, const Beside *beside, int depth) {
  float strong = 0.0f;
  for (int n = 0; n < 2; n++) {
    const int point = min(beside->before + n, frame->fan_points - 1), ray = (int)beside->places[n];
    const float aside = beside->places[n] - ray;
    for (int m = 0; m < 2; m++) {
      const float share = (n ? beside->part : 1.0f - beside->part) * (m ? aside : 1.0f - aside);
      __global const float *at =
          sums + 4 * (((frame->fan_points + point) * frame->fan_angles + ray + m) * frame->fan_depths + depth);
      if (as_uint(at[6]) & 1u) strong += share;
    }
  }
  return strong;
}

// The path on an axis of which the step behind the stored depth `depth` is the last in strong tissue, or has its
// border: half a step behind it, where all lines have left it.
inline float path_behind(Frame frame, int depth) { return (depth + 1.5f) * frame->fan_step; }

// The depth on the axis at which a beam is as at `path`: there, unless it is in strong tissue or a step before it; then
// the last depth before that, and behind it, if it ends in this step or its border is in the next one. (Of a ray that
// is still in it, raytracing.cl takes what it had before.)
inline float depth_outside(Frame frame, __global const float *sums, float path, Axis axis) {
  const Beside beside = rays_beside(frame, axis, path);
  // Lines are interpolated between rays, and labels found at the middle of a step: they seem to enter strong tissue up
  // to four steps before the axis does.
  int own = clamp(beside.depth, 2, frame->fan_depths - 6);
  const float own_share = share_strong(frame, sums, &beside, own);
  float in_front = 0.0f, beyond = own_share, most = own_share;
  int ends = 0;  // the last step in strong tissue, from this one on
  for (int n = 1; n <= 4; n++) {
    const float share = share_strong(frame, sums, &beside, own + n);
    beyond += share;
    most = fmax(most, share);
    if (share <= 0.5f && n <= 2 && own_share > 0.5f && ends == 0) ends = own + n - 1;
    if (n <= 2) in_front += share_strong(frame, sums, &beside, own - n);
  }
  // Not in it, nor before it: beside it, or behind it
  if (most <= 0.5f || (own_share <= 0.5f && beyond <= 2.0f * in_front)) return path;
  if (ends > 0) return fmax(path, path_behind(frame, ends));
  float share = own_share;
  for (int last = own; last > 4 && share > 0.0f; last--) {
    const float before = share_strong(frame, sums, &beside, last - 1);
    // It has come out of other strong tissue, which lies in front of this one.
    if (share <= 0.5f && before > share) return fmin(last * frame->fan_step, path);
    share = before;
    own = last - 1;
  }
  return fmin(fmax(own - 3.0f, 1.0f) * frame->fan_step, path);
}

// The path on the axis behind the last step between `start` and `end` in which strong tissue ends; 0 if there is none.
inline float exit_between(Frame frame, __global const float *sums, float start, float end, Axis axis) {
  const Beside beside = rays_beside(frame, axis, end);
  const int last = min(beside.depth + 1, frame->fan_depths - 3);  // as in depth_outside
  const int first = max(beside.depth - (int)ceil((end - start) / frame->fan_step) - 1, 0);
  __global const float *on_axis =
      sums + 4 * ((frame->fan_points + beside.before) * frame->fan_angles + (int)(beside.places[0] + 0.5f)) *
                 frame->fan_depths;
  if (on_axis[4 * last + 6] == on_axis[4 * first + 2]) return 0.0f;
  float behind = share_strong(frame, sums, &beside, last + 1);
  for (int depth = last; depth >= first; depth--) {
    const float share = share_strong(frame, sums, &beside, depth);
    if (share > 0.5f && behind <= 0.5f) return path_behind(frame, depth);
    behind = share;
  }
  return 0.0f;
}

// Straight lines from the points of an aperture to a point on its axis.
typedef struct {
  int count;
  float x[MOST_POINTS];       // lateral position of the point
  float weight[MOST_POINTS];  // 1 in the aperture, less where a point is partly in it
  // Sums along the lines, per length of the axis: extra path, nepers, elevational deflection; and the amplitude that
  // passes strong tissue
  float delay[ROWS][MOST_POINTS], loss[ROWS][MOST_POINTS], lift[ROWS][MOST_POINTS], passed[ROWS][MOST_POINTS];
  // The amplitude that soft tissue leaves, relative to the line of least loss, and by how much losses differ
  float kept[ROWS][MOST_POINTS], least_loss, uneven;
} Lines;

// The lines to the depth `path` of an axis.
inline void find_lines(Frame frame, __global const float *sums, float path, Axis axis, Lines *lines) {
  const float pitch = frame->fan_pitch, centre = axis.centre;
  const float2 origin = axis.origin, direction = axis.direction;
  const float reach = 0.5f * fmin(frame->aperture_mm, path / frame->receive_f_number);
  const int low = max((int)ceil((centre - reach - 0.5f * pitch - frame->fan_first) / pitch), 0);
  const int high = (int)floor((centre + reach + 0.5f * pitch - frame->fan_first) / pitch);
  lines->count = clamp(high - low + 1, 1, min(MOST_POINTS, frame->fan_points - low));
  float least = 1e30f, most = 0.0f;
  for (int i = 0; i < lines->count; i++) {
    const float along = frame->fan_first + (low + i) * pitch;
    const float2 point = point_on_face(frame, along);
    const float3 at = place_in_fan(frame, along, origin + path * direction);
    lines->x[i] = (point.x - origin.x) * direction.y - (point.y - origin.y) * direction.x;
    lines->weight[i] = clamp((reach - fabs(along - centre)) / pitch + 0.5f, 0.0f, 1.0f);
    for (int row = 0; row < ROWS; row++) {
      const float4 found = sums_at(frame, sums, row, low + i, at.x, at.y);
      const float ratio = path / at.z;  // per length of the axis: a homogeneous medium changes nothing but the mean
      lines->delay[row][i] = ratio * found.x;
      lines->loss[row][i] = ratio * found.y;
      lines->passed[row][i] = found.z;
      lines->lift[row][i] = ratio * found.w;
      least = fmin(least, lines->loss[row][i]);
      most = fmax(most, lines->loss[row][i]);
    }
  }
  lines->least_loss = least;
  lines->uneven = most - least;
  for (int row = 0; row < ROWS; row++)
    for (int i = 0; i < lines->count; i++)
      lines->kept[row][i] =
          lines->uneven < LEAST_UNEVEN ? 1.0f : exp_fast(-0.5f * (lines->loss[row][i] - lines->least_loss));
}

// The integral of the square of that product. Its spectrum is the convolution of the two autocorrelations.
inline float squared_overlap(const float2 *first, const float2 *second, int count) {
  float sum = 0.0f;
  for (int k = 0; k < 2 * count - 1; k++) {
    float2 value = (float2)(0.0f);
    for (int n = k + 1 - count; n < count; n++) {
      const int rest = k - n;
      const float2 a = first[abs(n)], b = second[abs(rest)];
      const float a_y = n < 0 ? -a.y : a.y, b_y = rest < 0 ? -b.y : b.y;
      value += (float2)(a.x * b.x - a_y * b_y, a.x * b_y + a_y * b.x);
    }
    sum += (k == 0 ? 0.5f : 1.0f) * (value.x * value.x + value.y * value.y);
  }
  return sum;
}

// Autocorrelations of the received and of the transmitted wave of a beam: the spectra of its intensities.
typedef struct {
  float2 received[MOST_POINTS], transmitted[MOST_POINTS];
} Waves;

// The transmit focus of the zone that is used at the depth `path`; `path` itself where all depths are in focus.
inline float transmit_focus_at(Frame frame, float path) {
  float focus = path, least = 1e30f;
  for (int zone = 0; zone < frame->transmit_zones; zone++) {
    const float a = (path - frame->transmit_focus[zone]) / frame->transmit_rayleigh[zone];
    const float width = frame->transmit_sigma[zone] * sqrt(1.0f + a * a);
    if (width < least) focus = frame->transmit_focus[zone];
    least = fmin(least, width);
  }
  return focus;
}

// The parts of the wave that lines bring to a depth, without amplitudes: `turned` by the phases of soft tissue, and
// `focus`, the phase of the transmitted wave that is focused elsewhere. They hold for all levels.
typedef struct {
  float2 turned[ROWS][MOST_POINTS], focus[MOST_POINTS];
} Phases;

inline void find_phases(Frame frame, const Lines *lines, float path, float mean_delay, Phases *phases) {
  const float cycles = 0.5f * frame->cycles_per_mm;  // per millimetre of path, one way
  const float focusing = 0.5f * cycles * (1.0f / path - 1.0f / transmit_focus_at(frame, path));  // turns per mm^2
  float c, s;
  for (int i = 0; i < lines->count; i++) {
    turn(focusing * lines->x[i] * lines->x[i], &c, &s);
    phases->focus[i] = (float2)(c, s);
    for (int row = 0; row < ROWS; row++) {
      turn(cycles * (lines->delay[row][i] - mean_delay), &c, &s);
      phases->turned[row][i] = (float2)(c, s);
    }
  }
}

inline float2 times(float2 a, float2 b) { return (float2)(a.x * b.x - a.y * b.y, a.x * b.y + a.y * b.x); }

#define UNDISTURBED 0
#define BY_PHASE 1   // with the phases of soft tissue
#define BY_LOSS 2    // and with the amplitudes that it leaves
#define BY_TISSUE 3  // and with what strong tissue stops

// The waves at a depth, which is a receive focus.
inline void find_waves(const Lines *lines, const Phases *phases, int kind, Waves *waves) {
  for (int i = 0; i < lines->count; i++) waves->received[i] = waves->transmitted[i] = (float2)(0.0f);
  for (int row = 0; row < (kind == UNDISTURBED ? 1 : ROWS); row++) {
    float2 wave[MOST_POINTS], focused[MOST_POINTS];
    for (int i = 0; i < lines->count; i++) {
      float amplitude = lines->weight[i];
      if (kind >= BY_LOSS) amplitude *= lines->kept[row][i];
      if (kind == BY_TISSUE) amplitude *= lines->passed[row][i];
      wave[i] = kind == UNDISTURBED ? (float2)(amplitude, 0.0f) : amplitude * phases->turned[row][i];
      focused[i] = times(wave[i], phases->focus[i]);
    }
    const float share = kind == UNDISTURBED ? 1.0f : ROW_WEIGHT(row);
    add_correlation(wave, lines->count, share, waves->received);
    add_correlation(focused, lines->count, share, waves->transmitted);
  }
}

// The equivalent width of a beam in units of its own: the square of the integral of its intensity over the integral of
// its square.
inline float width_of(const Waves *waves, int count) {
  const float power = overlap(waves->received, waves->transmitted, count);
  return power * power / fmax(squared_overlap(waves->received, waves->transmitted, count), 1e-20f);
}

// Relative to a beam that nothing disturbs and that has lost `loss` nepers: (nepers of the amplitude of speckle lost by
// the phases and the uneven losses of soft tissue, nepers lost to strong tissue, width, and the nepers lost to strong
// tissue right in front, which is the mean power over the lines). The power of speckle is the integral over the beam of
// the transmitted times the received intensity. A shift of both beams changes nothing.
inline float4 level_and_spread(Frame frame, const Lines *lines, float path, float mean_delay, float loss) {
  const int count = lines->count;
  Phases phases;
  Waves waves;
  find_phases(frame, lines, path, mean_delay, &phases);
  find_waves(lines, &phases, UNDISTURBED, &waves);
  const float still = overlap(waves.received, waves.transmitted, count), own_width = width_of(&waves, count);
  // Strong and very lossy tissue takes parts of the aperture away. That is in the level; the line's neighbours are
  // taken away by it too, so that a wider beam would brighten its shadow.
  find_waves(lines, &phases, lines->uneven < MOST_UNEVEN ? BY_LOSS : BY_PHASE, &waves);
  const float spread = clamp(width_of(&waves, count) / own_width, 1.0f, MOST_SPREAD);
  if (lines->uneven >= MOST_UNEVEN) find_waves(lines, &phases, BY_LOSS, &waves);
  const float by_soft = fmax(overlap(waves.received, waves.transmitted, count) / still, LEAST_POWER);
  float differs = 0.0f, all = 0.0f, lit = 0.0f;
  for (int row = 0; row < ROWS; row++)
    for (int i = 0; i < count; i++) {
      const float square = lines->passed[row][i] * lines->passed[row][i], share = ROW_WEIGHT(row) * lines->weight[i];
      differs = fmax(differs, fabs(lines->passed[row][i] - 1.0f));
      all += share;
      lit += share * square * square;
    }
  float level = by_soft;
  if (differs > 0.0f) {
    find_waves(lines, &phases, BY_TISSUE, &waves);
    level = fmax(overlap(waves.received, waves.transmitted, count) / still, LEAST_POWER * by_soft);
  }
  const float own = lines->uneven < LEAST_UNEVEN ? loss : lines->least_loss;  // that of a line which is `kept`
  return (float4)(own - loss - 0.5f * log_fast(by_soft), 0.5f * log_fast(by_soft / level), spread,
                  differs > 0.0f ? -0.5f * log_fast(fmax(lit / fmax(all, 1e-6f), LEAST_POWER)) : 0.0f);
}

// Of lines that soft tissue alone disturbs: the mean loss of what arrives.
inline float mean_loss(const Lines *lines) {
  float all = 0.0f, losses = 0.0f;
  for (int row = 0; row < ROWS; row++)
    for (int i = 0; i < lines->count; i++) {
      const float amplitude = lines->kept[row][i];
      const float power = ROW_WEIGHT(row) * lines->weight[i] * amplitude * amplitude;
      all += power;
      losses += power * lines->loss[row][i];
    }
  return losses / fmax(all, 1e-6f);
}

// Means over an aperture by power: lateral position of its points, extra path, and nepers; the slope of the extra path
// across it, and the deflection in the elevational direction in mm.
typedef struct {
  float x, delay, loss, slope, rise;
} Means;

inline Means means_over(Frame frame, const Lines *lines, float path) {
  const float pitch = frame->fan_pitch;
  float all = 0.0f, first = 0.0f, second = 0.0f, delays = 0.0f, moments = 0.0f, arriving = 0.0f, losses = 0.0f;
  float row_lift[ROWS];
  for (int row = 0; row < ROWS; row++) {
    float row_power = 0.0f;
    row_lift[row] = 0.0f;
    for (int i = 0; i < lines->count; i++) {
      const float kept = lines->kept[row][i], passed = lines->passed[row][i], x = lines->x[i];
      const float delay = lines->delay[row][i], seen = passed * kept;
      // A little is left of what tissue stops, so that there is always a mean.
      const float power = ROW_WEIGHT(row) * (lines->weight[i] * (seen * seen + LEFT_FOR_MEANS) + 1e-6f);
      // Of what lossy tissue takes, such as marrow, nothing arrives: its tens of nepers are not the mean of what does.
      const float arrives =
          ROW_WEIGHT(row) * kept * kept * (lines->weight[i] * (passed * passed + LEFT_FOR_MEANS) + 1e-6f);
      row_power += power;
      row_lift[row] += power * lines->lift[row][i];
      delays += power * delay;
      first += power * x;
      second += power * x * x;
      moments += power * x * delay;
      arriving += arrives;
      losses += arrives * lines->loss[row][i];
    }
    all += row_power;
    row_lift[row] /= row_power;
  }
  Means means;
  means.x = first / all;
  means.delay = delays / all;
  means.loss = losses / fmax(arriving, 1e-6f);
  const float spread = second / all - means.x * means.x, common = moments / all - means.x * means.delay;
  means.slope = clamp(common / (spread + 0.02f * pitch * pitch), -STEEPEST, STEEPEST);
  means.rise = clamp(row_lift[2] - row_lift[0], -STEEPEST * path, STEEPEST * path);
  return means;
}

// One work-item computes one depth of one screen line. Global size (screen lines, depths): at one depth all lines have
// about as many points, and compilers that make vectors of neighbouring work-items need alike ones.
__kernel void screens(Frame frame, __global const float *sums, int with_level, int all_soft, __global float *screens_,
                      __global float *shades, __global float *spreads) {
  const int line = get_global_id(0), node = get_global_id(1), nodes = frame->screen_depths;
  const float path = (node + 1) * frame->screen_step;
  const Axis axis = axis_of(frame, line);
  Lines lines;
  find_lines(frame, sums, path, axis, &lines);

  const Means means = means_over(frame, &lines, path);
  float slope = means.slope, rise = means.rise;
  float4 found = (float4)(0.0f, 0.0f, 1.0f, 0.0f);
  float exit_shade = 0.0f, away = NO_END;
  int is_inside = 0;  // strong tissue
  if (with_level) {
    // In strong tissue, a beam has the level that it has before it: what this tissue takes is a matter of its ray.
    const float depth = all_soft ? path : depth_outside(frame, sums, path, axis);
    is_inside = depth < path;
    if (depth != path) find_lines(frame, sums, depth, axis, &lines);
    if (is_inside) {  // and continues as before it: within bone, the remaining lines do not show a direction
      const Means before = means_over(frame, &lines, depth);
      slope = before.slope;
      rise = before.rise * path / depth;
    }
    const float loss = depth != path ? mean_loss(&lines) : means.loss;
    found = level_and_spread(frame, &lines, depth, means.delay, loss);
    exit_shade = found.y;
    // Behind the last end of strong tissue on this axis, or on one beside it, between which lines may meet it
    float behind = 0.0f;
    for (int n = 0; n < 3 && behind == 0.0f && !all_soft; n++) {
      const int beside = line + (n == 1 ? -1 : n == 2 ? 1 : 0);
      if (beside >= 0 && beside < frame->screen_lines)
        behind = exit_between(frame, sums, path - frame->screen_step, path, axis_of(frame, beside));
    }
    if (behind != 0.0f) {
      find_lines(frame, sums, behind, axis, &lines);
      exit_shade = level_and_spread(frame, &lines, behind, means.delay, loss).w;
      // The part u of an aperture leaves u^3 of the power of speckle, in a beam 1 / u times as wide; but the edge of a
      // plate right in front of a point cuts a beam that is in focus: u. A beam is made of the visible aperture from
      // the distance on at which the cone of its lines is wider than a Fresnel zone, 4 F^2 wavelengths.
      away = fmax(path - behind, 0.0f);
      const float zone = 8.0f * frame->receive_f_number * frame->receive_f_number;
      const float far = fmin(away * frame->cycles_per_mm / zone, 1.0f);
      found.y = blend(found.w, found.y, far);
    }
  }
  const float4 screen = (float4)(means.loss + found.x + found.y, means.delay - slope * means.x, slope * path, rise);
  vstore4(screen, line * nodes + node, screens_);
  const float signed_away = is_inside ? -fmax(away, 1e-3f) : away;
  vstore4((float4)(found.y, exit_shade, means.loss, signed_away), line * nodes + node, shades);
  vstore2((float2)(found.z, 1.0f), line * nodes + node, spreads);
}

// Mean power over a beam of standard deviation `sigma`, in screen lines, of what the lines at one depth let through,
// relative to its own line. The power of the beam has sigma / sqrt 2; a Gauss-Hermite rule of three points.
inline float mean_passed(Frame frame, __global const float *screens_, int node, int line, float sigma) {
  const int nodes = frame->screen_depths, lines = frame->screen_lines;
  const float own = screens_[4 * (line * nodes + node)];
  float sum = 0.6666667f;
  for (int side = -1; side <= 1; side += 2) {
    const float place = clamp(line + side * 1.2247449f * sigma, 0.0f, lines - 1.001f);
    const int left = (int)place;
    const float a = screens_[4 * (left * nodes + node)], b = screens_[4 * ((left + 1) * nodes + node)];
    sum += 0.1666667f * exp_fast(clamp(-2.0f * (blend(a, b, place - left) - own), -10.0f, 10.0f));
  }
  return sum;
}

// An echo has the level of the line that its scatterer is on, but should have that of the line whose beam receives it.
// Over the width of an undisturbed beam the two hardly differ. For a wider one this is the factor that leaves a line
// the mean power that it had. One work-item computes one depth of one screen line. Global size (depths, screen lines).
__kernel void keep_levels(Frame frame, __global const float *screens_, __global float *spreads) {
  const int node = get_global_id(0), line = get_global_id(1), at = line * frame->screen_depths + node;
  const float path = (node + 1) * frame->screen_step, spread = spreads[2 * at];
  const float traced_lines = (float)(frame->traced_lines - 1) / (frame->screen_lines - 1);
  const float apart = line_distance(frame, path + traced_start(frame, line * traced_lines));
  const float cosine = traced_cosine(frame, line * traced_lines);
  const float sigma = lateral_sigma(frame, path, 1.0f, cosine) / (apart * traced_lines);
  spreads[2 * at + 1] =
      sqrt(mean_passed(frame, screens_, node, line, sigma) / mean_passed(frame, screens_, node, line, sigma * spread));
}

// The factor by which the power of speckle would change where the axes of neighbouring lines come together to the part
// `ratio` of their distance: several lines then look at the same tissue, and add up with phases that differ by `turns`
// from one to the next (docs/physics.md#beams-from-an-aperture).
inline float gathered_power(Frame frame, float path, float apart_mm, float ratio, float turns, float cosine) {
  const float apart = 0.5f * apart_mm / lateral_sigma(frame, path, 1.0f, cosine);
  // Their depths differ, too, by a part of the pulse. Its deviation is 2.3548 / (2 pi bandwidth) cycles.
  const float later = 1.3341168f * frame->fractional_bandwidth * turns;
  const float decay = apart * apart + later * later;
  float sum = 1.0f;
  for (int n = 1; n < MOST_GATHERED; n++) {
    const float common = 1.0f - n * fabs(ratio), weight = exp_fast(-decay * n * n);
    if (common <= 0.0f || weight < 1e-3f) break;
    float cosine, sine;
    turn(n * turns, &cosine, &sine);
    sum += 2.0f * common * weight * cosine;
  }
  return fmax(sum, LEAST_GATHERED);
}

// The lines of an aperture seem to meet in a point on the axis, but out of its focus the transmitted beam is wide, and
// a part of it passes beside strong tissue that is right in front of this point: the variance of its intensity, in
// mm^2, by which it is wider than the received one. (Over the width of that, images average by the lateral beam.)
inline float extra_variance(Frame frame, float path) {
  const float receive = fmax(path * frame->receive_sigma_slope, frame->receive_sigma_min);
  return 0.5f * fmax(transmit_variance(frame, path, 1.0f, 1.0f) - receive * receive, 0.0f);
}

// A place between two screen lines
typedef struct {
  int left;
  float part;
} Between;

inline Between between_lines(Frame frame, float place) {
  Between between;
  const float inside = clamp(place, 0.0f, frame->screen_lines - 1.001f);
  between.left = (int)inside;
  between.part = inside - between.left;
  return between;
}

// The amplitude that strong tissue lets through at the depth `node`, at a place among the screen lines: of one of the
// two `kinds` of shades. In shadows it is the mean over a deviation `sigma` in screen lines, by a Gauss-Hermite rule of
// three points; from where the beam passes beside, nothing is taken. In strong tissue shades are those in front of it,
// and light from there does not reach the space behind: its lines count as the line itself.
inline float mean_lit(Frame frame, __global const float *shades, int kind, int node, float place, float sigma) {
  const int nodes = frame->screen_depths;
  const Between middle = between_lines(frame, place);
  __global const float *left = shades + 4 * (middle.left * nodes + node), *right = left + 4 * nodes;
  // Between a line that is in strong tissue and one that is not, a ray which has left it is as the latter; between two
  // that are, as the darker one: the other may not have come out since the face.
  const int left_inside = left[3] < 0.0f, right_inside = right[3] < 0.0f;
  const float on_left = exp_fast(-left[kind]), on_right = exp_fast(-right[kind]);
  const float part = left_inside != right_inside ? (left_inside ? 1.0f : 0.0f) : middle.part;
  const float own = left_inside && right_inside ? fmin(on_left, on_right) : blend(on_left, on_right, part);
  float sum = 0.6666667f * own;
  for (int side = -1; side <= 1; side += 2) {
    const Between at = between_lines(frame, place + side * 1.7320508f * sigma);
    float lit[2];
    for (int n = 0; n < 2; n++) {
      __global const float *shade = shades + 4 * ((at.left + n) * nodes + node);
      lit[n] = exp_fast(-shade[kind]);
      if (shade[3] < 0.0f) lit[n] = fmin(lit[n], own);
    }
    sum += 0.1666667f * blend(lit[0], lit[1], at.part);
  }
  return fmax(sum, own);
}

// The nepers that strong tissue takes at a depth, and behind its last end before.
inline float2 mean_shades(Frame frame, __global const float *shades, int node, float place, float path,
                          float lines_per_mm) {
  const int nodes = frame->screen_depths;
  const float extra = extra_variance(frame, path);
  const float reach = sqrt(extra) * lines_per_mm;
  float away = NO_END;
  for (int side = -1; side <= 1; side++) {
    const Between at = between_lines(frame, place + side * 1.7320508f * reach);
    away = fmin(away, fmin(fabs(shades[4 * (at.left * nodes + node) + 3]),
                           fabs(shades[4 * ((at.left + 1) * nodes + node) + 3])));
  }
  if (away == NO_END) {
    const float lit = mean_lit(frame, shades, 0, node, place, 0.0f);
    return (float2)(-log_fast(lit), -log_fast(lit));
  }
  // The lines come together from a distance in a cone, over whose width they average themselves.
  const float cone = away / frame->receive_f_number;
  const float sigma = sqrt(fmax(extra - cone * cone / 12.0f, 0.0f)) * lines_per_mm;
  const float end_sigma = sqrt(extra_variance(frame, path - away)) * lines_per_mm;
  return (float2)(-log_fast(mean_lit(frame, shades, 0, node, place, sigma)),
                  -log_fast(mean_lit(frame, shades, 1, node, place, end_sigma)));
}

// The beams of traced lines, interpolated between screens; 0 at the face. One work-item computes one depth of one
// traced line. Global size (1 + depths, traced lines).
__kernel void beams(Frame frame, __global const float *screens_, __global const float *shades, int all_soft,
                    __global float *beams_) {
  const int number = get_global_id(0), line = get_global_id(1), depths = frame->screen_depths;
  const int to = line * (1 + depths) + number;
  __global float *shade = beams_ + 4 * frame->traced_lines * (1 + depths);
  if (number == 0) {
    vstore4((float4)(0.0f), to, beams_);
    vstore4((float4)(0.0f), to, shade);
    return;
  }
  const float per_line = (frame->screen_lines - 1.0f) / (frame->traced_lines - 1);
  const float place = line * per_line;
  const int before = min((int)place, frame->screen_lines - 2);
  const float4 left = vload4(before * depths + number - 1, screens_);
  const float4 right = vload4((before + 1) * depths + number - 1, screens_);
  float4 beam = left + (place - before) * (right - left);
  const float4 left_shade = vload4(before * depths + number - 1, shades);
  const float4 right_shade = vload4((before + 1) * depths + number - 1, shades);
  float4 own = left_shade + (place - before) * (right_shade - left_shade);
  const float path = number * frame->screen_step;
  const float apart = line_distance(frame, path + traced_start(frame, (float)line));
  if (!all_soft) {
    const float lines_per_mm = per_line / apart;
    const float2 mean = mean_shades(frame, shades, number - 1, place, path, lines_per_mm);
    beam.x += mean.x - own.x;
    own.xy = mean;
  }
  // Of interest to rays that are not where both lines are: whether these are in strong tissue, of which no end is near
  const int is_inside = left_shade.w < 0.0f && right_shade.w < 0.0f;
  own.w = !is_inside ? 1.0f : left_shade.w == -NO_END && right_shade.w == -NO_END ? -2.0f : -1.0f;
  vstore4(own, to, shade);
  const float4 per_strip = (right - left) * per_line;  // from line to line
  const float tilt = beam.z / path;
  const float turns = frame->cycles_per_mm * (per_strip.y - (apart + per_strip.z) * tilt);
  beam.x += 0.5f * log_fast(gathered_power(frame, path, apart, NOT_TOGETHER * (1.0f + per_strip.z / apart), turns,
                                           traced_cosine(frame, (float)line)));
  vstore4(beam, to, beams_);
}
