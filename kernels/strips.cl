// strips: the strip of tissue beside every segment, up to half-way to the neighbouring lines, for scattering.cl
// (docs/physics.md#5-scatterers).
//
// One work-item computes those of one traced line. Global size (traced lines). What borders bend or deflect has axes
// that are not as far apart as without tissue, and other delays: strips of the width that they have in homogeneous
// tissue would leave scatterers out, or have them twice, and these would come and go with the least movement of the
// probe. At a border half-way between two axes both strips also have the mean of what the two lines show it at.
//
// Buffers: segments Segment [traced line][MAX_SEGMENTS] with segment_counts, as in raytracing.cl; `left` and `right` of
// each are written.

#include "common.clh"

#define LEAST_APART 0.5f   // distance of two axes, in that without tissue, ...
#define MOST_APART 1.5f    // ... at which they are as those of neighbours are
#define MOST_CYCLES 0.25f  // by which a line's depths are changed at its border
#define LEAST_PART 0.1f    // of its half width at the other end, by which these depths change at most so much per mm

// The border towards a neighbouring line (`side` -1 or 1) at a length along a segment: its distance from the axis, and
// what is added to the displayed depth there. `known` is the number of the neighbour's segment that was beside last.
inline float2 border_at(Frame frame, __global const Segment *segments, __global const int *counts, int line, int side,
                        __global const Segment *own, float along, int *known) {
  const float path = own->path_mm + along, step = frame->line_spacing / frame->lateral_rays;
  const float apart = step * (frame->linear ? 1.0f : frame->apex_radius_mm + traced_start(frame, (float)line) + path);
  const int other = line + side;
  float2 border = (float2)(0.5f * apart, 0.0f);
  if (!frame->aperture_beams || other < 0 || other >= frame->traced_lines) return border;
  const float3 direction = vload3(0, own->direction), lateral = vload3(0, own->lateral);
  const float3 place = vload3(0, own->start) + along * direction, expected = place + side * apart * lateral;
  // Of segments that meet where this one ends too, the one beside it
  const float inwards = (along > 0.0f ? -1.0f : 1.0f) * fmin(0.5f * own->length_mm, 0.05f);
  const int count = min(counts[other], MAX_SEGMENTS);
  for (int steps = 0; steps < count; steps++) {
    const int n = *known + steps < count ? *known + steps : *known + steps - count;
    __global const Segment *segment = segments + other * MAX_SEGMENTS + n;
    const float beyond = path - segment->path_mm, within = beyond + inwards;
    if (segment->reflections != own->reflections || within < 0.0f || within >= segment->length_mm) continue;
    const float3 its = vload3(0, segment->direction), there = vload3(0, segment->start) + beyond * its;
    if (length3(there - expected) > 0.3f + 0.5f * apart) continue;  // elsewhere, as behind a bone
    *known = n;
    // Where both lines are at one point half-way between them
    const float depth = own->depth_mm + along * own->depth_per_mm;
    const float later = segment->depth_mm + beyond * segment->depth_per_mm - depth -
                        0.5f * own->depth_per_mm * dot3(there - place, direction + its);
    const float most = MOST_CYCLES / frame->cycles_per_mm;
    border.x = 0.5f * clamp(side * dot3(there - place, lateral), LEAST_APART * apart, MOST_APART * apart);
    border.y = 0.5f * clamp(later, -2.0f * most, 2.0f * most);
    break;
  }
  return border;
}

ONE_BY_ONE
__kernel void strips(Frame frame, __global Segment *segments, __global const int *segment_counts) {
  const int line = get_global_id(0);
  int known[2] = {0, 0};
  for (int n = 0; n < min(segment_counts[line], MAX_SEGMENTS); n++) {
    __global Segment *segment = segments + line * MAX_SEGMENTS + n;
    const float length = segment->length_mm, per_mm = 1.0f / fmax(length, 1e-3f);
    for (int side = -1; side <= 1; side += 2) {
      const float2 from = border_at(frame, segments, segment_counts, line, side, segment, 0.0f, known + (side > 0));
      const float2 to = border_at(frame, segments, segment_counts, line, side, segment, length, known + (side > 0));
      const float least = fmax(LEAST_PART * fmax(from.x, to.x), 1e-4f);  // all lines of a sector begin at one point
      const float later = side * from.y / fmax(from.x, least), later_to = side * to.y / fmax(to.x, least);
      const float4 border =
          (float4)(side * from.x, side * (to.x - from.x) * per_mm, later, (later_to - later) * per_mm);
      vstore4(border, 0, side < 0 ? segment->left : segment->right);
    }
  }
}
