// fans and screens: what soft tissue does to a beam from an aperture (docs/physics.md#beams-from-an-aperture).
//
// Soft tissue changes the phase of a wave long before it bends it, so the aperture is treated as a phase screen: paths
// are straight, and the echo is the coherent sum over them. From every point of the face goes a fan of straight rays
// with running sums of delay and attenuation (fans). For every traced line and depth, the sums along the lines from the
// points of its aperture to the point on its axis are interpolated between those rays; they give the mean delay, the
// deflection of the beam, the loss of coherence and the mean attenuation (screens). raytracing.cl follows them up to
// the first strong border (is_soft).
//
// The elevational aperture is represented by three sheets, at quantiles of the elevational beam (ROW_SIGMA).
//
// Buffers: voxels ushort [k][j][i] (medium.py); acoustics float4 [label]: extra path per mm, attenuation in nepers per
// mm (both ways), speed of sound, impedance; sums float4 [row][point][angle][depth]: extra path in mm, nepers, mm of
// strong tissue, and the sheet's part in the elevational deflection in mm; screens float4 [screen line][depth], depths
// from screen_step on: nepers lost both ways, extra path in mm, deflection in the lateral and in the elevational
// direction in mm.

#include "common.clh"

#define ROWS 3
// Nodes and weights of the three-point Gauss-Hermite rule for the power of the elevational beam.
#define ROW_SIGMA 1.2247449f
#define ROW_WEIGHT(row) ((row) == 1 ? 0.6666667f : 0.1666667f)
#define MOST_POINTS 16       // of one aperture: it has at most 12 intervals, and two partial ones
#define STEEPEST 0.1f        // slope of the delay: tissue is soft
#define BLOCKED_PER_MM 2.0f  // nepers per millimetre of strong tissue that the axis does not meet

// Position along the face (mm) and angle of the normal of a point of the array.
inline float point_angle(__constant const Acquisition *acquisition, float along) {
  return acquisition->linear || acquisition->apex_radius_mm <= 0.0f ? 0.0f : along / acquisition->apex_radius_mm;
}

inline float2 point_on_face(__constant const Acquisition *acquisition, float along) {
  const float angle = point_angle(acquisition, along);
  return angle == 0.0f ? (float2)(along, 0.0f) : acquisition->apex_radius_mm * (float2)(sin(angle), cos(angle) - 1.0f);
}

// Extra path and nepers per mm at the fraction f of a cell of voxels, linear between its eight labels; unless
// `all_soft`, a label counts as `soft` if a border between them is strong.
inline float2 rates_in_cell(__global const float4 *acoustics, __global const ushort *cell, int nx, int nxy, float3 f,
                            float4 soft, int all_soft) {
  float2 along_y[2], along_z[2];
  for (int z = 0; z < 2; z++) {
    for (int y = 0; y < 2; y++) {
      __global const ushort *row = cell + y * nx + z * nxy;
      const float4 left = acoustics[row[0] & LABEL_MASK], right = acoustics[row[1] & LABEL_MASK];
      const float2 a = all_soft || is_soft(soft.z, soft.w, left.z, left.w) ? left.xy : soft.xy;
      const float2 b = all_soft || is_soft(soft.z, soft.w, right.z, right.w) ? right.xy : soft.xy;
      along_y[y] = a + f.x * (b - a);
    }
    along_z[z] = along_y[0] + f.y * (along_y[1] - along_y[0]);
  }
  return along_z[0] + f.z * (along_z[1] - along_z[0]);
}

// One work-item follows one ray of a fan. Global size (angles, points, rows). Look-ups are trilinear, so that sums over
// steps of a voxel are smooth. Strong tissue counts as what lies in front of it, with its length recorded; with
// `all_soft`, no tissues have a strong border.
#ifdef NO_IMPLICIT_VECTORS
__attribute__((intel_vec_len_hint(1)))
#endif
__kernel void fans(__constant const Acquisition *acquisition, __global const ushort *voxels,
                   __global const float4 *acoustics, int all_soft, __global float *sums) {
  const int ray = get_global_id(0), point = get_global_id(1), row = get_global_id(2);
  const int depths = acquisition->fan_depths;
  const int nx = acquisition->dims[0], ny = acquisition->dims[1], nxy = nx * ny;
  const float3 top = (float3)(nx - 1.001f, ny - 1.001f, acquisition->dims[2] - 1.001f);
  __global float *to = sums + ((row * acquisition->fan_points + point) * acquisition->fan_angles + ray) * depths * 4;

  const float along = acquisition->fan_first + point * acquisition->fan_pitch;
  const float2 origin = point_on_face(acquisition, along);
  const float own = acquisition->fan_first_angle + ray * acquisition->fan_angle_step;
  const float angle = own + point_angle(acquisition, along);
  const float3 start = affine_point(acquisition->ras_to_voxel,
                                    affine_point(acquisition->probe_to_ras, (float3)(origin.x, origin.y, 0.0f)));
  const float3 step = affine_vector(acquisition->ras_to_voxel,
                                    affine_vector(acquisition->probe_to_ras, (float3)(sin(angle), cos(angle), 0.0f)));
  const float3 aside =
      affine_vector(acquisition->ras_to_voxel, affine_vector(acquisition->probe_to_ras, (float3)(0.0f, 0.0f, 1.0f))) *
      (ROW_SIGMA * (row - 1));
  const float length = acquisition->fan_step;

  float4 soft = acoustics[0];
  float4 sum = (float4)(0.0f);
  float lean = 0.0f;
  vstore4(sum, 0, to);
  for (int depth = 1; depth < depths; depth++) {
    const float path = (depth - 0.5f) * length;
    const float sigma = elevation_sigma(acquisition, path);
    const float3 at = clamp(start + path * step + sigma * aside, (float3)(0.0f), top);
    const int3 base = convert_int3(at);
    const float3 f = at - convert_float3(base);
    __global const ushort *cell = voxels + (base.z * ny + base.y) * nx + base.x;
    const int first = cell[0];
    const int is_mixed = !(first & SAME_LABEL);
    float blocked = 0.0f;
    if (all_soft) {
      soft = acoustics[first & LABEL_MASK];
    } else {
      const int nearest = is_mixed ? cell[(f.x > 0.5f) + (f.y > 0.5f ? nx : 0) + (f.z > 0.5f ? nxy : 0)] : first;
      const float4 found = acoustics[nearest & LABEL_MASK];
      const int goes_on = depth == 1 || is_soft(soft.z, soft.w, found.z, found.w);
      soft = goes_on ? found : soft;
      blocked = goes_on ? 0.0f : length;
    }
    const float2 rate = is_mixed ? rates_in_cell(acoustics, cell, nx, nxy, f, soft, all_soft) : soft.xy;
    // A path turns towards slower tissue by the gradient of the extra path, here the difference of the outer sheets
    // over their distance; what a turn moves aside grows with the length behind it.
    const float turned = length * rate.x / (2.0f * ROW_SIGMA * sigma);
    sum += (float4)(length * rate.x, length * rate.y, blocked, length * (lean + 0.5f * turned));
    lean += turned;
    vstore4(sum, depth, to);
  }
}

// The sums of a point's fan in the direction `place` (in rays) at distance `far` (in stored depths).
inline float4 sums_at(__constant const Acquisition *acquisition, __global const float *sums, int row, int point,
                      float place, float far) {
  const int ray = (int)place, depth = (int)far, depths = acquisition->fan_depths;
  const float t = place - ray, u = far - depth;
  __global const float *near =
      sums + (((row * acquisition->fan_points + point) * acquisition->fan_angles + ray) * depths + depth) * 4;
  __global const float *next = near + depths * 4;
  const float4 a = vload4(0, near) + u * (vload4(1, near) - vload4(0, near));
  const float4 b = vload4(0, next) + u * (vload4(1, next) - vload4(0, next));
  return a + t * (b - a);
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

// Straight lines from the points of an aperture to a point on its axis.
typedef struct {
  int count;
  float x[MOST_POINTS];       // lateral position of the point
  float weight[MOST_POINTS];  // 1 in the aperture, less where a point is partly in it
  float middle[MOST_POINTS];  // weights of the points next to the axis
  // Sums along the lines, per length of the axis: extra path, nepers, elevational deflection; and the amplitude that
  // passes strong tissue
  float delay[ROWS][MOST_POINTS], loss[ROWS][MOST_POINTS], lift[ROWS][MOST_POINTS], passed[ROWS][MOST_POINTS];
} Lines;

// The lines to the depth `path` of the axis from `origin` in a direction, whose aperture is around `centre` on the
// face.
inline void find_lines(__constant const Acquisition *acquisition, __global const float *sums, float path, float2 origin,
                       float2 direction, float centre, Lines *lines) {
  const float pitch = acquisition->fan_pitch;
  const float reach = 0.5f * fmin(acquisition->aperture_mm, path / acquisition->receive_f_number);
  const int low = max((int)ceil((centre - reach - 0.5f * pitch - acquisition->fan_first) / pitch), 0);
  const int high = (int)floor((centre + reach + 0.5f * pitch - acquisition->fan_first) / pitch);
  lines->count = clamp(high - low + 1, 1, min(MOST_POINTS, acquisition->fan_points - low));
  float own_strong = 0.0f, middles = 0.0f;
  for (int i = 0; i < lines->count; i++) {
    const float along = acquisition->fan_first + (low + i) * pitch;
    const float2 point = point_on_face(acquisition, along);
    const float2 towards = origin + path * direction - point;
    const float away = sqrt(towards.x * towards.x + towards.y * towards.y);
    const float turned = atan2(towards.x, towards.y) - point_angle(acquisition, along);
    const float place = clamp((turned - acquisition->fan_first_angle) / acquisition->fan_angle_step, 0.0f,
                              acquisition->fan_angles - 1.001f);
    const float far = clamp(away / acquisition->fan_step, 0.0f, acquisition->fan_depths - 1.001f);
    lines->x[i] = (point.x - origin.x) * direction.y - (point.y - origin.y) * direction.x;
    lines->weight[i] = clamp((reach - fabs(along - centre)) / pitch + 0.5f, 0.0f, 1.0f);
    lines->middle[i] = fmax(1.0f - fabs(along - centre) / pitch, 0.0f);
    for (int row = 0; row < ROWS; row++) {
      // Per length of the axis: a homogeneous medium changes nothing but the mean.
      const float4 found = sums_at(acquisition, sums, row, low + i, place, far) * (path / away);
      lines->delay[row][i] = found.x;
      lines->loss[row][i] = found.y;
      lines->passed[row][i] = found.z;
      lines->lift[row][i] = found.w;
    }
    own_strong += lines->middle[i] * lines->passed[1][i];
    middles += lines->middle[i];
  }
  // Where the axis itself is in strong tissue, oblique lines may be so for longer: a beam changes only beside its end.
  // Lengths in strong tissue are whole steps: a line may seem to enter it one step before the axis does.
  const float allowed = 2.0f * own_strong / fmax(middles, 1e-6f) + acquisition->fan_step;
  for (int row = 0; row < ROWS; row++)
    for (int i = 0; i < lines->count; i++)
      lines->passed[row][i] = exp(-BLOCKED_PER_MM * fmax(lines->passed[row][i] - allowed, 0.0f));
}

// Adds a sheet's share to the autocorrelations of the received and of the transmitted wave; `turns` of focusing at the
// lateral position of 1 mm. Without `disturbed`, the wave of a homogeneous medium.
inline void add_waves(const Lines *lines, int row, int disturbed, float cycles, float mean_delay, float focusing,
                      float2 *received, float2 *transmitted) {
  float2 wave[MOST_POINTS], focused[MOST_POINTS];
  for (int i = 0; i < lines->count; i++) {
    const float amplitude = lines->weight[i] * (disturbed ? lines->passed[row][i] : 1.0f);
    const float turns = disturbed ? cycles * (lines->delay[row][i] - mean_delay) : 0.0f;
    float c, s;
    turn(turns, &c, &s);
    wave[i] = amplitude * (float2)(c, s);
    turn(turns + focusing * lines->x[i] * lines->x[i], &c, &s);
    focused[i] = amplitude * (float2)(c, s);
  }
  const float share = disturbed ? ROW_WEIGHT(row) : 1.0f;
  add_correlation(wave, lines->count, share, received);
  add_correlation(focused, lines->count, share, transmitted);
}

// Logarithm of the amplitude of speckle relative to an undisturbed beam. The power of speckle is the integral over the
// beam of the transmitted times the received intensity. There is one transmit focus; every depth is a receive focus. A
// shift of both beams changes nothing.
inline float level_of(__constant const Acquisition *acquisition, const Lines *lines, float path, float mean_delay) {
  const float cycles = 0.5f * acquisition->cycles_per_mm;  // per millimetre of path, one way
  const float focusing = 0.5f * cycles * (1.0f / path - 1.0f / acquisition->transmit_focus);
  float2 received[2][MOST_POINTS], transmitted[2][MOST_POINTS];  // [undisturbed, disturbed]
  for (int i = 0; i < lines->count; i++)
    received[0][i] = received[1][i] = transmitted[0][i] = transmitted[1][i] = (float2)(0.0f);
  add_waves(lines, 0, 0, cycles, mean_delay, focusing, received[0], transmitted[0]);
  for (int row = 0; row < ROWS; row++)
    add_waves(lines, row, 1, cycles, mean_delay, focusing, received[1], transmitted[1]);
  const float still = overlap(received[0], transmitted[0], lines->count);
  return 0.5f * log(fmax(overlap(received[1], transmitted[1], lines->count) / still, 1e-4f));
}

// One work-item computes one depth of one screen line. Global size (depths, screen lines).
__kernel void screens(__constant const Acquisition *acquisition, __global const float *sums, int with_level,
                      __global float *screens_) {
  const int node = get_global_id(0), line = get_global_id(1), nodes = acquisition->screen_depths;
  const float path = (node + 1) * acquisition->screen_step;
  const float traced = (float)line * (acquisition->traced_lines - 1) / (acquisition->screen_lines - 1);
  const float position = acquisition->first_line +
                         acquisition->line_spacing * (traced - acquisition->guard_lines) / acquisition->lateral_rays;
  const float radius = acquisition->apex_radius_mm, pitch = acquisition->fan_pitch;
  const float2 direction = acquisition->linear ? (float2)(0.0f, 1.0f) : (float2)(sin(position), cos(position));
  const float2 origin =
      acquisition->linear ? (float2)(position, 0.0f) : radius * (float2)(direction.x, direction.y - 1.0f);
  Lines lines;
  find_lines(acquisition, sums, path, origin, direction, acquisition->linear ? position : radius * position, &lines);

  // Means over the aperture by power, and the slope of the delay across it.
  float all = 0.0f, first = 0.0f, second = 0.0f, delays = 0.0f, moments = 0.0f, losses = 0.0f;
  float row_lift[ROWS];
  for (int row = 0; row < ROWS; row++) {
    float row_power = 0.0f;
    row_lift[row] = 0.0f;
    for (int i = 0; i < lines.count; i++) {
      const float passed = lines.passed[row][i], x = lines.x[i], delay = lines.delay[row][i];
      // A little of the axis is left, so that there is always a mean.
      const float power = ROW_WEIGHT(row) * (lines.weight[i] * passed * passed + 1e-4f * lines.middle[i]);
      row_power += power;
      row_lift[row] += power * lines.lift[row][i];
      delays += power * delay;
      first += power * x;
      second += power * x * x;
      moments += power * x * delay;
      losses += power * lines.loss[row][i];
    }
    all += row_power;
    row_lift[row] /= row_power;
  }
  const float mean_x = first / all, mean_delay = delays / all;
  const float spread = second / all - mean_x * mean_x, common = moments / all - mean_x * mean_delay;
  const float slope = clamp(common / (spread + 0.02f * pitch * pitch), -STEEPEST, STEEPEST);
  const float rise = clamp(row_lift[2] - row_lift[0], -STEEPEST * path, STEEPEST * path);
  const float level = with_level ? level_of(acquisition, &lines, path, mean_delay) : 0.0f;
  vstore4((float4)(losses / all - level, mean_delay - slope * mean_x, slope * path, rise), line * nodes + node,
          screens_);
}
