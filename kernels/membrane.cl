// flatten_membrane: the fluid distance of voxels beside flat borders of fluid, by the wide Gaussians of smoothing.cl,
// which see none of the steps of the voxels that the narrow one follows (medium.py, docs/physics.md#5-scatterers).
//
// One work-item computes one voxel; global size (points).
//
// Buffers: smooth ushort as in borders.clh; points int [point], flat indices of voxels near a border of the membrane's
// fluids; distance float [point], voxels from it, positive inside, from the narrow Gaussian and replaced. `fluid` is
// the acoustic group of the fluids.

#include "flat_borders.clh"

#define MOST_OFF 0.9f  // voxels from where the narrow Gaussian has a border that a wide one places

// What a wide Gaussian finds at a voxel position: (distance in voxels of the volume, how sure it is)
inline float2 by_wider(Smoothed smoothed, float3 voxel, int fluid, float narrow, float voxels) {
  if (min(smoothed.dims.x, min(smoothed.dims.y, smoothed.dims.z)) < 4) return (float2)(0.0f);
  float both;
  const Border border = border_from(smoothed, voxel, fluid, fluid, OF_BEFORE, &both);
  const float found = -voxels * border.overshoot;
  const float sure = border.confidence * (1.0f - ramp(0.6f, MOST_OFF, fabs(found - narrow)));
  if (sure == 1.0f || border.sigma == 0.0f) return (float2)(found, sure);
  const Border layer = layer_border(smoothed, border);
  const float found_layer = -voxels * layer.overshoot;
  const float sure_layer = layer.confidence * (1.0f - ramp(0.6f, MOST_OFF, fabs(found_layer - narrow)));
  return sure >= sure_layer ? (float2)(found, sure) : (float2)(found_layer, sure_layer);
}

#ifdef NO_IMPLICIT_VECTORS  // Intel's compiler makes wrong distances of this kernel with them
__attribute__((intel_vec_len_hint(1)))
#endif
__kernel void flatten_membrane(__global const ushort *smooth, int nx, int ny, int nz, int groups, int fluid,
                               __global const int *points, __global float *distance) {
  const int point = get_global_id(0), here = points[point];
  const int k = here / (nx * ny), j = here / nx - k * ny, i = here - (k * ny + j) * nx;
  const float3 voxel = (float3)(i, j, k);
  const Smoothed full = {smooth, (int3)(nx, ny, nz), groups, WIDE_VARIANCE, 0.9f, 2.5f, 0.0f};
  const Smoothed halved = {
      smooth + groups * nx * ny * nz, ((int3)(nx, ny, nz) + 1) / 2, groups, WIDEST_VARIANCE, 0.99f, 1.25f, 0.0f};
  const float narrow = distance[point];
  const float2 widest = by_wider(halved, 0.5f * voxel - 0.25f, fluid, narrow, 2.0f);
  float found = narrow;
  if (widest.y < 1.0f) {
    const float2 wide = by_wider(full, voxel, fluid, narrow, 1.0f);
    found = blend(narrow, wide.x, wide.y);
  }
  distance[point] = blend(found, widest.x, widest.y);
}
