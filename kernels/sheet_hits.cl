// sheet_hits: where the elevational rays meet sheets that were found in the MRI and have a coherent echo, as dura has
// (found_sheets.py, docs/physics.md#sheets-found-in-the-mri). They are added to the hits of raytracing.cl.
//
// One work-item follows one elevational ray along the segments of its traced line, half a voxel at a time, and looks up
// the plane at the nearest voxel. Planes of neighbouring voxels differ a little: a crossing may lie slightly outside
// the step, and counts once per voxel. Global size (traced lines, elevational rays).
//
// Buffers: planes uint2 [k][j][i] (sheets.clh); quantiles, segments, segment_counts, hits, hit_counts as in
// raytracing.cl.

#include "common.clh"
#include "hits.clh"
#include "sheets.clh"

#define SLACK 0.75f  // of a step, from its middle, in which a crossing counts

__kernel void sheet_hits(Frame frame, __global const uint *planes, __global const float *quantiles,
                         __global const Segment *segments, __global const int *segment_counts, __global Hit *hits,
                         __global int *hit_counts) {
  const int line = get_global_id(0), ray = get_global_id(1), rays = frame->elevational_rays;
  const int slot = line * rays + ray, nx = frame->dims[0], ny = frame->dims[1], nz = frame->dims[2];
  const float quantile = quantiles[slot], stride = 0.5f * frame->voxel_mm;
  __constant const float *m = frame->ras_to_voxel;
  const int segments_of_line = min(segment_counts[line], MAX_SEGMENTS);
  int count = hit_counts[slot];
  for (int index = 0; index < segments_of_line; index++) {
    __global const Segment *segment = segments + line * MAX_SEGMENTS + index;
    const float3 start = vload3(0, segment->start), direction = vload3(0, segment->direction);
    const float3 elevational = vload3(0, segment->elevational);
    const float3 at_start = affine_point(m, start), step = affine_vector(m, direction);
    const float3 aside = quantile * affine_vector(m, elevational);
    const int steps = (int)ceil(segment->length_mm / stride);
    float last = -1e6f;
    for (int n = 0; n < steps; n++) {
      const float middle = (n + 0.5f) * stride;
      const float3 place = at_start + middle * step + elevation_sigma(frame, segment->path_mm + middle) * aside;
      const int3 nearest = convert_int3_rtn(place + 0.5f);
      if (nearest.x < 0 || nearest.y < 0 || nearest.z < 0 || nearest.x >= nx || nearest.y >= ny || nearest.z >= nz)
        continue;
      const uint2 words = vload2((nearest.z * ny + nearest.y) * nx + nearest.x, planes);
      if (!(words.y >> 28)) continue;
      const float3 gradient = gradient_of_sheet(words.x);
      const float away =
          dot3(gradient, place - convert_float3(nearest)) - length3(gradient) * distance_of_look(words.y);
      const float rate = dot3(gradient, step);
      const float ahead = -away / (fabs(rate) < 1e-6f ? 1e-6f : rate), along = middle + ahead;
      if (fabs(ahead) > SLACK * stride || along < last + frame->voxel_mm || along < 0.0f || along > segment->length_mm)
        continue;
      last = along;
      float3 normal = transposed_vector(m, gradient);
      normal *= (dot3(normal, direction) > 0.0f ? -1.0f : 1.0f) / length3(normal);
      if (count < MAX_HITS) {
        Hit hit = hit_on_segment(frame, segment, along, quantile, normal, reflection_of_look(words.y));
        hit.echo *= coherence_of_sheet(frame, start + along * direction, hit.cos_incidence);
        hits[slot * MAX_HITS + count] = hit;
      }
      count++;
    }
  }
  hit_counts[slot] = count;
}
