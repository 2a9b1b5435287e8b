// face_hits: where the elevational rays that something has reflected meet the probe's face, which reflects a part of
// what comes back to it (docs/physics.md#reverberation-at-the-face). They are added to the hits of raytracing.cl.
//
// What strong mirrors such as bone and gas send back to the face is sent to them again: at twice its depth a mirror
// that faces the probe has a fainter image. One work-item follows one elevational ray along the reflected segments of
// its traced line. Global size (traced lines, elevational rays).
//
// Buffers: quantiles, segments, segment_counts, hits, hit_counts as in raytracing.cl.

#include "common.clh"
#include "hits.clh"

// Length along a ray in the probe frame at which it meets the surface of the face from in front; -1 if it does not.
inline float length_to_face(float3 start, float3 direction, float radius) {
  if (radius == 0.0f) return direction.y < -1e-4f ? -start.y / direction.y : -1.0f;
  const float a = direction.x * direction.x + direction.y * direction.y;
  const float b = start.x * direction.x + (start.y + radius) * direction.y;
  const float c = start.x * start.x + (start.y + radius) * (start.y + radius) - radius * radius;
  const float root = b * b - a * c;
  return b < 0.0f && root >= 0.0f && a > 1e-6f ? -(b + sqrt(root)) / a : -1.0f;
}

__kernel void face_hits(Frame frame, __global const float *quantiles, __global const Segment *segments,
                        __global const int *segment_counts, __global Hit *hits, __global int *hit_counts) {
  const int line = get_global_id(0), ray = get_global_id(1), slot = line * frame->elevational_rays + ray;
  const float quantile = quantiles[slot];
  const float radius = frame->flat_face ? 0.0f : frame->apex_radius_mm;
  __constant const float *m = frame->probe_to_ras;
  const float3 origin = (float3)(m[3], m[7], m[11]);
  const int segments_of_line = min(segment_counts[line], MAX_SEGMENTS);
  int count = hit_counts[slot];
  for (int index = 0; index < segments_of_line; index++) {
    __global const Segment *segment = segments + line * MAX_SEGMENTS + index;
    if (segment->reflections == 0) continue;
    const float3 start = transposed_vector(m, vload3(0, segment->start) - origin);
    const float3 direction = transposed_vector(m, vload3(0, segment->direction));
    const float3 elevational = transposed_vector(m, vload3(0, segment->elevational));
    float along = length_to_face(start, direction, radius);
    float3 aside = (float3)(0.0f);
    for (int n = 0; n < 2 && along >= 0.0f; n++) {  // the ray's offset changes slowly along the segment
      aside = quantile * elevation_sigma(frame, segment->path_mm + along) * elevational;
      along = length_to_face(start + aside, direction, radius);
    }
    if (along < 0.0f || along > segment->length_mm) continue;
    const float3 at = start + aside + along * direction;
    if (fabs(at.x) > frame->face_half_mm || fabs(at.z) > frame->face_half_height_mm) continue;
    const float3 normal =
        radius == 0.0f ? (float3)(0.0f, 1.0f, 0.0f) : (float3)(at.x / radius, (at.y + radius) / radius, 0.0f);
    if (count < MAX_HITS)
      hits[slot * MAX_HITS + count] =
          hit_on_segment(frame, segment, along, quantile, affine_vector(m, normal), frame->face_reflection);
    count++;
  }
  hit_counts[slot] = count;
}
