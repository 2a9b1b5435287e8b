// Planes through the voxels of thin sheets, around each of them (sheets.py, docs/physics.md#5-scatterers).
//
// find_cores marks the points inside thick layers. fit_sheets fits a plane to the others: along the normal of a sheet
// its voxels have the least variance. One work-item computes their mean and covariance in Gaussian windows about a
// voxel, and writes the normal, the distance, and the tissue beside the sheet. A wide window gives the normal, a narrow
// one the distance: in the wide one, the mean of a bent sheet is away from it. Global size (at least the points).
//
// Buffers: bits uchar, a bit per voxel of [k][j][i], 1 for the sheet's label, after 8 zeros; rows float8 [512], sums
// over the voxels of a row of the window for each set of its bits: of weights, weights x, weights x^2; narrow weights,
// those times x; weights of find_cores; 0; the first again; taps float [5 + SHEET_REACH], weights along an axis by the
// distance; labels uchar [k][j][i]; points int [point], flat indices of the voxels with the sheet's label; cores uchar
// [k][j][i]; is_thin uchar [point]; planes uint [k][j][i], 0 where there is none. A plane is packed: normal by
// octahedral coordinates (9 bits each), distance (8 bits), tissue (6 bits).

#include "common.clh"
#include "sheets.clh"

// The bits of the 9 voxels of a row around the one with flat index `at`; `inside` is a mask of those of the volume.
inline int row_bits(__global const uchar *bits, int at, int inside) {
  const int first = at + 8 - SHEET_REACH;
  return ((bits[first >> 3] | (bits[(first >> 3) + 1] << 8)) >> (first & 7)) & inside;
}

// The mask of the 9 voxels of a row around column i that are inside the volume
inline int row_inside(int i, int nx) {
  return (511 << max(SHEET_REACH - i, 0)) & (511 >> max(SHEET_REACH - (nx - 1 - i), 0));
}

ONE_BY_ONE
__kernel void find_cores(__global const uchar *bits, int nx, int ny, int nz, __constant const float8 *rows,
                         __constant const float *taps, __global const int *points, int point_count,
                         __global uchar *cores) {
  if ((int)get_global_id(0) >= point_count) return;
  const int here = points[get_global_id(0)];
  const int k = here / (nx * ny), j = here / nx - k * ny, i = here - (k * ny + j) * nx;
  const int inside = row_inside(i, nx);
  float part = 0.0f;
  for (int z = max(-2, -k); z <= min(2, nz - 1 - k); z++)
    for (int y = max(-2, -j); y <= min(2, ny - 1 - j); y++)
      part += taps[SHEET_REACH + 1 + abs(y)] * taps[SHEET_REACH + 1 + abs(z)] *
              rows[row_bits(bits, here + (z * ny + y) * nx, inside)].s5;
  cores[here] = part >= SHEET_THICK;
}

// The most frequent label but the sheet's among the 26 voxels around; the sheet's if there is no other.
inline uint tissue_beside(__global const uchar *labels, int sheet, int i, int j, int k, int3 dims) {
  uchar found[27], count = 0;
  for (int z = max(k - 1, 0); z <= min(k + 1, dims.z - 1); z++)
    for (int y = max(j - 1, 0); y <= min(j + 1, dims.y - 1); y++)
      for (int x = max(i - 1, 0); x <= min(i + 1, dims.x - 1); x++) {
        const uchar label = labels[(z * dims.y + y) * dims.x + x];
        if (label != sheet) found[count++] = label;
      }
  uint best = sheet;
  int most = 0;
  for (int n = 0; n < count; n++) {
    int votes = 0;
    for (int m = 0; m < count; m++) votes += found[m] == found[n];
    if (votes > most) {
      most = votes;
      best = found[n];
    }
  }
  return best;
}

// From a voxel to one of the six around it, along i, j or k, backwards or forwards
inline int step_to(int neighbour, int nx, int ny) {
  const int size = neighbour < 2 ? 1 : neighbour < 4 ? nx : nx * ny;
  return neighbour & 1 ? size : -size;
}

ONE_BY_ONE
__kernel void fit_sheets(__global const uchar *bits, int nx, int ny, int nz, int sheet, float side_x, float side_y,
                         float side_z, __constant const float8 *rows, __constant const float *taps,
                         __global const uchar *labels, __global const int *points, int point_count,
                         __global const uchar *cores, __global uchar *is_thin, __global uint *planes) {
  if ((int)get_global_id(0) >= point_count) return;
  const int here = points[get_global_id(0)];
  const int k = here / (nx * ny), j = here / nx - k * ny, i = here - (k * ny + j) * nx;
  int is_thick = 0;
  for (int z = max(k - 1, 0); z <= min(k + 1, nz - 1); z++)
    for (int y = max(j - 1, 0); y <= min(j + 1, ny - 1); y++)
      for (int x = max(i - 1, 0); x <= min(i + 1, nx - 1); x++) is_thick |= cores[(z * ny + y) * nx + x];
  is_thin[get_global_id(0)] = !is_thick;
  if (is_thick) return;
  // Wide window: number of voxels, sums of their offsets and of products of these. Narrow: number, sums of offsets.
  float count = 0.0f, near_count = 0.0f;
  float3 sum = (float3)(0.0f), near_sum = (float3)(0.0f), squares = (float3)(0.0f), mixed = (float3)(0.0f);
  const int inside = row_inside(i, nx);
  for (int z = max(-SHEET_REACH, -k); z <= min(SHEET_REACH, nz - 1 - k); z++) {
    // Over the rows of a plane: of the words of `rows`, and of those times y. The last word is the first one again.
    float8 plain = 0.0f, by_y = 0.0f;
    for (int y = max(-SHEET_REACH, -j); y <= min(SHEET_REACH, ny - 1 - j); y++) {
      const int set = row_bits(bits, here + (z * ny + y) * nx, inside);
      if (!set) continue;
      const float wide = taps[abs(y)], wide2 = wide * wide, narrow = wide2 * wide2;  // half as wide
      const float8 row = (float8)(wide, wide, wide, narrow, narrow, 0.0f, 0.0f, wide * (y * y)) * rows[set];
      plain += row;
      by_y += (float)y * row;
    }
    const float wide = taps[abs(z)], wide2 = wide * wide, narrow = wide2 * wide2;
    count += wide * plain.s0;
    sum += wide * (float3)(plain.s1, by_y.s0, z * plain.s0);
    squares += wide * (float3)(plain.s2, plain.s7, z * z * plain.s0);
    mixed += wide * (float3)(z * by_y.s0, z * plain.s1, by_y.s1);
    near_count += narrow * plain.s3;
    near_sum += narrow * (float3)(plain.s4, by_y.s3, z * plain.s3);
  }
  const float3 side = (float3)(side_x, side_y, side_z), mean = sum / count;
  const float3 diagonal = (squares / count - mean * mean) * side * side + 1e-4f;
  const float3 beside = (mixed / count - mean.yzx * mean.zxy) * side.yzx * side.zxy;  // of yz, zx, xy
  // The largest eigenvector of the adjugate is the smallest one of the covariance; squaring makes it dominate.
  float3 a = diagonal.yzx * diagonal.zxy - beside * beside;
  float3 b = beside.yzx * beside.zxy - beside * diagonal;
  const float minors = a.x + a.y + a.z;
  if (minors < SHEET_LEAST_AREA) return;  // a line or a few voxels: no sheet
  for (int n = 0; n < 5; n++) {
    const float scale = 1.0f / (a.x + a.y + a.z);
    a *= scale;
    b *= scale;
    const float3 whole = a * a + b.yzx * b.yzx + b.zxy * b.zxy;
    b = b * (a.yzx + a.zxy) + b.yzx * b.zxy;
    a = whole;
  }
  const float3 column = a.x >= a.y && a.x >= a.z ? (float3)(a.x, b.z, b.y)
                        : a.y >= a.z             ? (float3)(b.z, a.y, b.x)
                                                 : (float3)(b.y, b.x, a.z);
  // As a gradient in voxels
  float3 normal = column * side;
  normal /= length3(normal);
  const float distance = dot3(normal, near_sum) / near_count;
  const float3 octahedral = normal / (fabs(normal.x) + fabs(normal.y) + fabs(normal.z));
  float u = octahedral.x, v = octahedral.y;
  if (octahedral.z < 0.0f) {
    u = copysign(1.0f - fabs(octahedral.y), octahedral.x);
    v = copysign(1.0f - fabs(octahedral.x), octahedral.y);
  }
  planes[here] = packed_sheet(u, v, distance, tissue_beside(labels, sheet, i, j, k, (int3)(nx, ny, nz)));
}

// Voxels beside a sheet get the nearest plane of the six voxels around them: a scatterer then finds it at the nearest
// voxel. The first of these six that has the sheet's label writes.
ONE_BY_ONE
__kernel void spread_sheets(__global const uchar *labels, int nx, int ny, int nz, int sheet, __global const int *points,
                            int point_count, __global uint *planes) {
  if ((int)get_global_id(0) >= point_count) return;
  const int here = points[get_global_id(0)];
  for (int n = 0; n < 6; n++) {
    const int beside = here + step_to(n, nx, ny);
    if (beside < 0 || beside >= nx * ny * nz) continue;
    // Voxels at the ends of the volume, its margin, get none: not all six are inside.
    const int k = beside / (nx * ny), j = beside / nx - k * ny, i = beside - (k * ny + j) * nx;
    if (i < 1 || j < 1 || k < 1 || i >= nx - 1 || j >= ny - 1 || k >= nz - 1 || labels[beside] == sheet) continue;
    float nearest = 2.0f;
    uint best = 0u;
    int is_first = 1;
    for (int m = 0; m < 6; m++) {
      const int from = beside + step_to(m, nx, ny);
      if (labels[from] != sheet) continue;
      if (is_first && from != here) break;
      is_first = 0;
      if (!planes[from]) continue;
      const uint plane = planes[from];
      const float3 gradient = gradient_of_sheet(plane);
      const float along = m < 2 ? gradient.x : m < 4 ? gradient.y : gradient.z;
      // The step goes from `beside` to the plane's voxel.
      const float distance = distance_of_sheet(plane) + (m & 1 ? along : -along) / length3(gradient);
      if (fabs(distance) >= nearest) continue;
      nearest = fabs(distance);
      best = (plane & ~(255u << 18)) | ((uint)clamp((int)rint(128.0f + distance / SHEET_DISTANCE_STEP), 1, 255) << 18);
    }
    if (!is_first) planes[beside] = best;
  }
}
