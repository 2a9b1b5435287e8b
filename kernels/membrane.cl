// flatten_membrane: the fluid distance of voxels beside flat borders of fluid, by the wide Gaussians of smoothing.cl,
// which see none of the steps of the voxels that the narrow one follows (medium.py, docs/physics.md#5-scatterers).
//
// One work-item computes LANES voxels; global size (at least points / LANES). Borders are looked up voxel by voxel,
// since the rows of their stencils are apart; layers are solved for all of them at once.
//
// Buffers: smooth ushort as in borders.clh; points int [point], flat indices of voxels near a border of the membrane's
// fluids; distance float [point], voxels from it, positive inside, from the narrow Gaussian and replaced. `fluid` is
// the acoustic group of the fluids.

#include "flat_borders.clh"

#define MOST_OFF 0.9f  // voxels from where the narrow Gaussian has a border that a wide one places

// How certain a border is that a wide Gaussian has at `found` and the narrow one at `narrow`
inline floatn certainty_beside(floatn found, floatn narrow) {
  return 1.0f - ramps(0.6f, MOST_OFF, fabs(found - narrow));
}

// What a wide Gaussian finds at voxels: the border as if it was isolated, or that of a layer, in voxels of the volume.
// `scale` is a voxel of its grid, in which the voxels are at position / scale - shift. Replaces `sure`, how certain
// that is; lanes that are sure before are not looked at.
inline floatn by_wider(Smoothed smoothed, __global const int *points, int count, int nx, int ny, float scale,
                       float shift, int fluid, floatn narrow, floatn *sure) {
  SPREAD(float, known, *sure);
  float places[LANES], confidences[LANES], shares[LANES], gradients[LANES], laplacians[LANES], sigmas[LANES];
  for (int n = 0; n < LANES; n++) {
    places[n] = confidences[n] = sigmas[n] = laplacians[n] = 0.0f;
    shares[n] = 0.5f, gradients[n] = MOST_LAYER_GRADIENT;
    if (n >= count || known[n] == 1.0f) continue;
    const int here = points[n], k = here / (nx * ny), j = here / nx - k * ny, i = here - (k * ny + j) * nx;
    float both;
    const Border border = border_from(smoothed, (float3)(i, j, k) / scale - shift, fluid, fluid, OF_BEFORE, &both);
    places[n] = -scale * border.overshoot, confidences[n] = border.confidence;
    if (border.sigma == 0.0f) continue;
    sigmas[n] = border.sigma, shares[n] = border.share;
    gradients[n] = gradient_of_share(border), laplacians[n] = laplacian_of_share(border);
  }
  const floatn isolated = LOAD_LANES(places), sigma = LOAD_LANES(sigmas), share = LOAD_LANES(shares);
  const floatn gradient = LOAD_LANES(gradients), laplacian = LOAD_LANES(laplacians);
  *sure = LOAD_LANES(confidences) * certainty_beside(isolated, narrow);
  if (!ANY_LANE(*sure < 1.0f && sigma > 0.0f)) return isolated;
  const floatn first = thicknesses_by_gradient(gradient);
  floatn depth, curvature, thickness = first, depth_before, curvature_before, thickness_before = first;
  flat_layersn(share, gradient, laplacian, &depth, &thickness, &curvature);
  flat_layersn(1.0f - share, gradient, -laplacian, &depth_before, &thickness_before, &curvature_before);
  const intn is_behind = fabs(curvature) < fabs(curvature_before);
  depth = is_behind ? depth : -depth_before;
  thickness = is_behind ? thickness : thickness_before;
  curvature = is_behind ? curvature : curvature_before;
  const floatn overshoot = depth * sigma, in_layer = -scale * overshoot;
  floatn of_layer = layer_certainties(thickness, curvature) * certainty_beside(in_layer, narrow);
  of_layer = fabs(overshoot) <= (floatn)(smoothed.farthest) ? of_layer : (floatn)(0.0f);
  of_layer = sigma > (floatn)(0.0f) ? of_layer : (floatn)(0.0f);
  const floatn found = *sure >= of_layer ? isolated : in_layer;
  *sure = max(*sure, of_layer);
  return found;
}

ONE_BY_ONE
__kernel void flatten_membrane(__global const ushort *smooth, int nx, int ny, int nz, int groups, int fluid,
                               __global const int *points, int point_count, __global float *distance) {
  const int first = get_global_id(0) * LANES, count = min(LANES, point_count - first);
  if (count <= 0) return;
  const int3 halved_dims = ((int3)(nx, ny, nz) + 1) / 2;
  const Smoothed full = {smooth, (int3)(nx, ny, nz), groups, WIDE_VARIANCE, 0.9f, 2.5f, 0.0f};
  const Smoothed halved = {smooth + groups * nx * ny * nz, halved_dims, groups, WIDEST_VARIANCE, 0.99f, 1.25f, 0.0f};
  float distances[LANES];
  for (int n = 0; n < LANES; n++) distances[n] = distance[first + min(n, count - 1)];
  const floatn narrow = LOAD_LANES(distances);
  floatn widest = narrow, sure = 0.0f, found = narrow;
  if (min(halved_dims.x, min(halved_dims.y, halved_dims.z)) >= 4)
    widest = by_wider(halved, points + first, count, nx, ny, 2.0f, 0.25f, fluid, narrow, &sure);
  floatn wide_sure = sure;
  if (min(nx, min(ny, nz)) >= 4 && ANY_LANE(sure < 1.0f)) {
    const floatn wide = by_wider(full, points + first, count, nx, ny, 1.0f, 0.0f, fluid, narrow, &wide_sure);
    found = fma(wide_sure, wide - narrow, narrow);
  }
  found = fma(sure, widest - found, found);
  STORE_LANES(found, distances);
  for (int n = 0; n < count; n++) distance[first + n] = distances[n];
}
