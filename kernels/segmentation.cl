// 3D guided filter (He et al., ECCV 2010), self-guided, inside a mask (docs/physics.md#1-from-mri-to-tissues).
//
// Box windows are running sums along one axis at a time, so the cost does not depend on the radius. Volumes are float
// [k][j][i] with i padded to whole lanes; the mask (1 inside) excludes air from every mean.

#include "common.clh"

// Sums over 2 radius + 1 neighbours along j (axis 1) or k (axis 2). One work-item computes LANES columns;
// global size (row / LANES, other axis).
__kernel void box_sum_across(__global const float *from, __global float *to, int count, int stride, int other_stride,
                             int radius) {
  int start = get_global_id(0) * LANES + get_global_id(1) * other_stride;
  floatn sum = 0.0f;
  for (int n = 0; n < min(radius, count); n++) sum += LOAD_LANES(from + start + n * stride);
  for (int n = 0; n < count; n++) {
    if (n + radius < count) sum += LOAD_LANES(from + start + (n + radius) * stride);
    if (n - radius > 0) sum -= LOAD_LANES(from + start + (n - radius - 1) * stride);
    STORE_LANES(sum, to + start + n * stride);
  }
}

// The same along i. One work-item computes one row; global size (rows).
__kernel void box_sum_along(__global const float *from, __global float *to, int row, int radius) {
  __global const float *in = from + get_global_id(0) * row;
  __global float *out = to + get_global_id(0) * row;
  float sum = 0.0f;
  for (int n = 0; n < min(radius, row); n++) sum += in[n];
  for (int n = 0; n < row; n++) {
    if (n + radius < row) sum += in[n + radius];
    if (n - radius > 0) sum -= in[n - radius - 1];
    out[n] = sum;
  }
}

// image^2 inside the mask. Global size (voxels / LANES).
__kernel void squares(__global const float *image, __global float *square) {
  int at = get_global_id(0) * LANES;
  floatn value = LOAD_LANES(image + at);
  STORE_LANES(value * value, square + at);
}

// The local linear model a I + b of every window (He, eq. 5 and 6 with the image as its own guide), from the sums of
// mask, image and image^2 over the window. A voxel lies in many windows, and He averages their models. Here they are
// weighted by 1 / variance, so that windows across an edge do not blur the estimate of homogeneous windows.
// Overwrites sum_of_mask with the weight, sum with weight a, sum_of_squares with weight b.
__kernel void linear_model(__global float *sum_of_mask, __global const float *mask, __global float *sum,
                           __global float *sum_of_squares, float epsilon, float least_variance) {
  int at = get_global_id(0) * LANES;
  floatn count = fmax(LOAD_LANES(sum_of_mask + at), 1.0f);
  floatn mean = LOAD_LANES(sum + at) / count;
  floatn variance = fmax(LOAD_LANES(sum_of_squares + at) / count - mean * mean, 0.0f) + least_variance;
  floatn a = variance / (variance + epsilon);
  floatn weight = LOAD_LANES(mask + at) * least_variance / variance;
  STORE_LANES(weight, sum_of_mask + at);
  STORE_LANES(weight * a, sum + at);
  STORE_LANES(weight * (1.0f - a) * mean, sum_of_squares + at);
}

// The filtered image: weighted mean a times I plus weighted mean b (He, eq. 8).
__kernel void apply_model(__global const float *weight, __global const float *weighted_a,
                          __global const float *weighted_b, __global const float *image, __global float *filtered) {
  int at = get_global_id(0) * LANES;
  floatn value = LOAD_LANES(weighted_a + at) * LOAD_LANES(image + at) + LOAD_LANES(weighted_b + at);
  STORE_LANES(value / fmax(LOAD_LANES(weight + at), 1e-20f), filtered + at);
}
