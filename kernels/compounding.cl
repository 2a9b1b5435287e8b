// Compounding of the images of a sweep into a volume (compounding.py). Positions are in voxels (i, j, k) and pixels
// (column, row).

#include "common.clh"

// The mean grey level over the window of `size` (columns, rows) about each pixel, within the imaged field: single
// pixels would alias speckle. It is 0 if the window is entirely outside the field. One work-item computes one pixel;
// global size (columns, rows). Buffers: image, field uchar [row][column] (field: 0 or 1); mean float [row][column].
__kernel void mean_in_field(__global const uchar *image, __global const uchar *field, int2 size, __global float *mean) {
  const int2 pixel = (int2)(get_global_id(0), get_global_id(1)), count = (int2)(get_global_size(0), get_global_size(1));
  const int2 low = max(pixel - size / 2, (int2)(0)), high = min(pixel - size / 2 + size, count);
  int sum = 0, inside = 0;
  for (int row = low.y; row < high.y; row++)
    for (int column = low.x; column < high.x; column++) {
      const int at = row * count.x + column;
      sum += field[at] * image[at];
      inside += field[at];
    }
  mean[pixel.y * count.x + pixel.x] = inside > 0 ? (float)sum / inside : 0.0f;
}

// Adds one image to the volume. The volume is processed in columns of voxels along the axis that crosses the image
// plane most steeply. One work-item processes one column and adds to the voxels within `reach` millimetres of the
// plane, with a weight that falls linearly. Global size: voxels along the two other axes of the box that starts at
// voxel `low`.
//
// `to_image` is the affine map from voxels to (column, row, distance from the plane in millimetres), three rows of
// four. `axes` are (first other axis, second other axis, axis of the columns), `dims` the voxels along i, j, k,
// `pixels` the (columns, rows) of the image. Buffers: mean, field as above; sum, weight float [k][j][i].
__kernel void add_image(__global const float *mean, __global const uchar *field, int2 pixels,
                        __constant const float *to_image, int4 axes, int4 low, int4 dims, float reach,
                        __global float *sum, __global float *weight) {
  const int size[3] = {dims.x, dims.y, dims.z}, start[3] = {low.x, low.y, low.z};
  int voxel[3] = {0, 0, 0};
  voxel[axes.x] = start[axes.x] + get_global_id(0);
  voxel[axes.y] = start[axes.y] + get_global_id(1);
  const int across = axes.z;
  const float3 base = affine_point(to_image, (float3)(voxel[0], voxel[1], voxel[2]));
  const float3 step = (float3)(to_image[across], to_image[4 + across], to_image[8 + across]);
  const float range = reach / fabs(step.z);
  const float middle = -base.z / step.z;
  const int first = max((int)ceil(middle - range), 0), last = min((int)floor(middle + range), size[across] - 1);
  for (int n = first; n <= last; n++) {
    const float3 place = base + (float)n * step;
    const float share = 1.0f - fabs(place.z) / reach;
    const int2 nearest = convert_int2(floor(place.xy + 0.5f));
    if (share <= 0.0f || nearest.x < 0 || nearest.y < 0 || nearest.x >= pixels.x || nearest.y >= pixels.y) continue;
    if (!field[nearest.y * pixels.x + nearest.x]) continue;
    const float2 on_image = clamp(place.xy, (float2)(0.0f), convert_float2(pixels) - 1.001f);
    const int2 corner = convert_int2(on_image);
    const float2 f = on_image - convert_float2(corner);
    __global const float *at = mean + corner.y * pixels.x + corner.x;
    const float grey = blend(blend(at[0], at[1], f.x), blend(at[pixels.x], at[pixels.x + 1], f.x), f.y);
    voxel[across] = n;
    const size_t here = ((size_t)voxel[2] * size[1] + voxel[1]) * size[0] + voxel[0];
    sum[here] += share * grey;
    weight[here] += share;
  }
}
