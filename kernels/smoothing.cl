// Smoothing of the indicators of acoustic groups (borders.py): a separable Gaussian. Beyond the volume its outermost
// voxels are repeated. One work-item computes LANES voxels of a row; global size (columns / LANES rounded up, rows or
// more, planes).
//
// With MEMBERSHIP a voxel belongs to a second group by the share that the segmentation gives it: a border at the
// half-level between voxels instead of their steps.
//
// Buffers: groups uchar [k][j][i] with flags; second uchar [k][j][i], groups; share uchar [k][j][i], 255 for 1; taps
// float [2 reach + 1] of unit sum; partial float [plane][j][i]; smooth ushort [k][j][i], 65535 for 1. `columns` and
// `rows` are the voxels along i and j.

#include "common.clh"

// Whether all bytes of LANES voxels are `byte`
#if LANES == 1
#define ALL_BYTES(pointer, byte) (*(pointer) == (byte))
#elif LANES == 8
#define ALL_BYTES(pointer, byte) (as_ulong(vload8(0, pointer)) == (byte) * 0x0101010101010101ul)
#else
#define ALL_BYTES(pointer, byte) (ALL_EIGHT(pointer, byte) && ALL_EIGHT((pointer) + 8, byte))
#define ALL_EIGHT(pointer, byte) (as_ulong(vload8(0, pointer)) == (byte) * 0x0101010101010101ul)
#endif

#if LANES == 1
#define LOAD_BYTES(pointer) ((int)*(pointer))
#define STORE_SMOOTH(value, pointer) (*(pointer) = (ushort)((value) * 65535.0f + 0.5f))
#else
#define LOAD_BYTES(pointer) TO_INTN(JOIN(vload, LANES)(0, pointer))
#define STORE_SMOOTH(value, pointer) \
  JOIN(vstore, LANES)(JOIN(JOIN(convert_ushort, LANES), _sat)((value) * 65535.0f + 0.5f), 0, pointer)
#endif

#ifdef MEMBERSHIP
#define MEMBERSHIP_PARAMETERS __global const uchar *second, __global const uchar *share,
#else
#define MEMBERSHIP_PARAMETERS
#endif

// Defines a function for LANES values of a row from `column`; beyond the row its outermost voxels are repeated.
#define DEFINE_ROW_FROM(NAME, TYPE, VALUE, VALUES, LOAD, LOAD_VALUES)                        \
  inline VALUES NAME(__global const TYPE *row, int column, int columns, int is_inside) {     \
    if (is_inside) return LOAD(row + column);                                                \
    VALUE at_the_ends[LANES];                                                                \
    for (int n = 0; n < LANES; n++) at_the_ends[n] = row[clamp(column + n, 0, columns - 1)]; \
    return LOAD_VALUES(at_the_ends);                                                         \
  }
DEFINE_ROW_FROM(bytes_from, uchar, int, intn, LOAD_BYTES, LOAD_LANES)
DEFINE_ROW_FROM(floats_from, float, float, floatn, LOAD_LANES, LOAD_LANES)

// Whether the bytes of LANES voxels and of `reach` beside them on either side are the first one; all lie in the row.
inline int is_uniform(__global const uchar *bytes, int reach) {
  const ulong first = bytes[-reach];
  for (int at = -reach; at < reach; at += LANES)
    if (!ALL_BYTES(bytes + at, first)) return 0;
  return ALL_BYTES(bytes + reach, first);
}

// Along i, from groups: planes starting at `first`, each clamped to the volume.
__kernel void smooth_rows(__global const uchar *groups, MEMBERSHIP_PARAMETERS int group, __constant const float *taps,
                          int reach, int columns, int rows, int planes, int first, __global float *partial) {
  // The last vector of a row starts earlier: voxels shared with the previous vector are computed twice.
  const int column = min((int)get_global_id(0) * LANES, columns - LANES), row = get_global_id(1);
  if (row >= rows) return;
  const int plane = clamp((int)get_global_id(2) + first, 0, planes - 1);
  __global const uchar *from = groups + ((size_t)plane * rows + row) * columns;
  const int is_inside = column >= reach && column + LANES + reach <= columns;
  floatn sum = 0.0f;
  // Most voxels are far from a border.
  int is_far = is_inside && is_uniform(from + column, reach);
#ifdef MEMBERSHIP
  __global const uchar *shares = share + (from - groups) + column;
  is_far = is_far && shares[0] == 0 && is_uniform(shares, reach);
#endif
  if (is_far) {
    if ((from[column] & GROUP_MASK) == group)
      for (int k = 0; k <= 2 * reach; k++) sum += taps[k];
    STORE_LANES(sum, partial + ((size_t)get_global_id(2) * rows + row) * columns + column);
    return;
  }
  for (int k = -reach; k <= reach; k++) {
    const int at = column + k;
    const intn found = bytes_from(from, at, columns, is_inside) & GROUP_MASK;
#ifdef MEMBERSHIP
    const size_t row_start = (size_t)(from - groups);
    const intn other = bytes_from(second + row_start, at, columns, is_inside);
    const floatn part = TO_FLOATN(bytes_from(share + row_start, at, columns, is_inside)) * (1.0f / 255.0f);
    floatn member = found == group ? (floatn)(1.0f) : (floatn)(0.0f);
    member += part * ((other == group ? (floatn)(1.0f) : (floatn)(0.0f)) - member);
    sum += taps[k + reach] * member;
#else
    sum += found == group ? (floatn)(taps[k + reach]) : (floatn)(0.0f);
#endif
  }
  STORE_LANES(sum, partial + ((size_t)get_global_id(2) * rows + row) * columns + column);
}

// Along j, within planes.
__kernel void smooth_columns(__global const float *from, __constant const float *taps, int reach, int columns, int rows,
                             __global float *to) {
  const int column = min((int)get_global_id(0) * LANES, columns - LANES), row = get_global_id(1);
  if (row >= rows) return;
  const size_t plane = (size_t)get_global_id(2) * rows;
  floatn sum = 0.0f;
  for (int k = -reach; k <= reach; k++)
    sum += taps[k + reach] * LOAD_LANES(from + (plane + clamp(row + k, 0, rows - 1)) * columns + column);
  STORE_LANES(sum, to + (plane + row) * columns + column);
}

// Along k: `from` starts `reach` planes before the plane `first` of the volume.
__kernel void smooth_planes(__global const float *from, __constant const float *taps, int reach, int columns, int rows,
                            int first, ulong offset, __global ushort *smooth) {
  const int column = min((int)get_global_id(0) * LANES, columns - LANES), row = get_global_id(1);
  if (row >= rows) return;
  const size_t plane = get_global_id(2), size = (size_t)rows * columns, here = (size_t)row * columns + column;
  floatn sum = 0.0f;
  for (int k = 0; k <= 2 * reach; k++) sum += taps[k] * LOAD_LANES(from + (plane + k) * size + here);
  STORE_SMOOTH(min(sum, (floatn)(1.0f)), smooth + offset + (plane + first) * size + here);
}

// Means of two voxels along each axis: half the resolution. `columns`, `rows` and `planes` as for `smooth`, whose
// last voxels are repeated; the planes of the result start at `first`, each clamped. Global size (columns of the result
// or more, rows, planes).
ONE_BY_ONE
__kernel void halve(__global const ushort *smooth, ulong offset, int columns, int rows, int planes, int first,
                    __global float *to) {
  const int column = get_global_id(0), row = get_global_id(1), halved = (columns + 1) / 2;
  if (column >= halved) return;
  const int plane = clamp((int)get_global_id(2) + first, 0, (planes + 1) / 2 - 1);
  int sum = 0;
  for (int n = 0; n < 8; n++) {
    const int i = min(2 * column + (n & 1), columns - 1), j = min(2 * row + ((n >> 1) & 1), rows - 1);
    const int k = min(2 * plane + (n >> 2), planes - 1);
    sum += smooth[offset + ((size_t)k * rows + j) * columns + i];
  }
  to[((size_t)get_global_id(2) * get_global_size(1) + row) * halved + column] = sum * (0.125f / 65535.0f);
}

// Along i, within planes of floats.
ONE_BY_ONE
__kernel void smooth_halved_rows(__global const float *from, __constant const float *taps, int reach, int columns,
                                 int rows, __global float *to) {
  const int column = min((int)get_global_id(0) * LANES, columns - LANES);
  if ((int)get_global_id(1) >= rows) return;
  __global const float *row = from + ((size_t)get_global_id(2) * rows + get_global_id(1)) * columns;
  const int is_inside = column >= reach && column + LANES + reach <= columns;
  floatn sum = 0.0f;
  for (int k = -reach; k <= reach; k++) sum += taps[k + reach] * floats_from(row, column + k, columns, is_inside);
  STORE_LANES(sum, to + (row - from) + column);
}

// Indicators sum to one, so the last group needs no Gaussian. One work-item computes one voxel; global size voxels or
// more.
__kernel void smooth_rest(__global ushort *all, ulong offset, ulong voxels, int group, int groups) {
  const size_t voxel = get_global_id(0);
  if (voxel >= voxels) return;
  __global ushort *smooth = all + offset;
  int rest = 65535;
  for (int n = 0; n < groups; n++) rest -= n == group ? 0 : smooth[n * voxels + voxel];
  smooth[group * voxels + voxel] = (ushort)max(rest, 0);
}
