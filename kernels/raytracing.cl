// trace: the binary ray tree of every traced line (docs/physics.md#3-rays).
//
// One work-item follows one ray and all its children. Global size (traced lines, 1 + elevational rays).
//   ray 0 of a line runs along the beam axis and writes the segments along which the scatter kernel works;
//   rays 1.. run at fixed quantiles of the elevational beam profile and write the interface hits, so that an interface
//   echo has the beam's elevational width. The lateral width comes from the neighbouring lines (beam.cl).
// Traced lines are at least as dense as scan lines (lateral_rays per scan line), with a few beyond the edges.
//
// With aperture_beams, rays go straight through soft borders (is_soft), and up to the first strong one a line follows
// the beam: its axis consists of pieces between the depths of aperture.cl, deflected as the beam is. Delay and
// attenuation are those of the ray itself, corrected linearly over each piece so that at its ends they are the beam's.
// What is given back of the ray's own losses is given back behind the layer that takes them, or inside if the piece
// ends there, so that nothing is brighter than in front of it; and with it the change of frequency, since lines that
// have not met this layer have none.
//
// Buffers: voxels ushort [k][j][i], groups uchar [k][j][i] and smooth ushort [group][k][j][i] (medium.py); tissues
// Tissue [label]; roots float4 [traced line], origin and direction (x, y) in the probe frame; beams as in
// aperture.cl; quantiles float [traced line][elevational ray], offsets in units of the elevational sigma; segments
// Segment [traced line][MAX_SEGMENTS] with segment_counts; hits Hit [traced line][elevational ray][MAX_HITS] with
// hit_counts; cut float [traced line][1 + elevational ray], the weight of the branches that were not followed;
// overflown int [1], the number of traced lines with more than MAX_SEGMENTS segments.

#include "borders.clh"

typedef struct {
  float3 axis;  // a point on the beam axis at path length `path`
  float3 direction;
  float3 lateral;
  float3 elevational;
  float path;
  float depth;
  float log_attenuation;  // natural logarithm, two-way amplitude
  float loss;             // the part of it, in nepers, that is attenuation by tissues
  float weight;
  float4 tube;        // widths and growths per mm at `path`: lateral, its growth, elevational, its growth
  float blind_until;  // path length before which crossings are ignored: a reflected ray must leave its interface
  int reflections;
  int label;
  int piece;      // of the beam, that starts at path piece x screen_step; -1 where the line is a ray
  int piece_has;  // number of segments or hits written before this piece
  float from;     // path length from which the piece is corrected: its start, or the end of strong tissue in it
  float shade;    // nepers lost to strong tissue beside the axis or in front: there, or where it entered such tissue
  float soft;     // the part of the loss that is of soft tissue
  float given_from, given;  // path length from which losses are given back, and the nepers lost to that layer
  float decay_before;       // in front of the tissue that it is in
  // Strong tissue in which a beam goes straight on; the last soft tissue, the weight there, and the nepers since then
  // by which this tissue attenuates more.
  int strong, front;
  float front_weight, excess;
} Ray;

#define NOT_STRONG 0
#define THROUGH 1       // strong tissue that does not bend
#define UNDER 2         // strong tissue that does: nothing is written of it, since it is a matter of the refracted ray
#define MOST_LOSS 1.0f  // nepers by which strong tissue may change the frequency of what has passed it
#define MOST_BEFORE_STRONG 0.35f  // nepers by which a piece of a beam in front of bone may differ from its ray
#define DARKEST 7.0f              // nepers lost to strong tissue: behind it nothing is left of a beam
#define LEAST_GIVEN 0.2f          // nepers lost to a layer which are given back behind it, not along the whole piece

// The label at fraction f of the cell of voxels at index `here`: the acoustic group with the largest trilinear weight,
// so that borders are smooth at the sub-voxel scale, and within the group the label of the nearest corner. Voting by
// group keeps the border between fluid and brain smooth where grey, white and other brain labels change along it.
inline int label_in_cell(__global const ushort *voxels, __global const uchar *groups,
                         __constant const Acquisition *acquisition, int here, float3 f) {
  const int word = voxels[here];
  if (word & SAME_LABEL) return word & LABEL_MASK;
  const int nx = acquisition->dims[0], nxy = nx * acquisition->dims[1];
  if (groups[here] & SAME_GROUP)
    return voxels[here + (f.x > 0.5f) + (f.y > 0.5f ? nx : 0) + (f.z > 0.5f ? nxy : 0)] & LABEL_MASK;
  __global const uchar *far = groups + here + nxy;
  const uchar8 corners =
      (uchar8)(vload2(0, groups + here), vload2(0, groups + here + nx), vload2(0, far), vload2(0, far + nx));
  const int8 group = convert_int8(corners) & GROUP_MASK;
  const float3 g = 1.0f - f;
  const float4 plane = (float4)(g.x * g.y, f.x * g.y, g.x * f.y, f.x * f.y);
  const float8 weights = (float8)(plane * g.z, plane * f.z);
  // Nearly every border cell contains two groups: that of the first corner and another one.
  const int first = group.s0, second = max_int8(select(group, (int8)(-1), group == first));
  const float first_weight = sum8(where8(group == first, weights));
  const float second_weight = sum8(where8(group == second, weights));
  int best = first_weight >= second_weight ? first : second;
  float best_weight = max(first_weight, second_weight);
  if (best_weight < 1.0f - first_weight - second_weight)
    for (int other = 0; other < second; other++) {
      const float weight = sum8(where8(group == other, weights));
      if (weight > best_weight) {
        best_weight = weight;
        best = other;
      }
    }
  const float8 of_best = where8(group == best, weights);
  const int corner = max_int8(select((int8)(0), (int8)(0, 1, 2, 3, 4, 5, 6, 7), of_best == max8(of_best)));
  return voxels[here + (corner & 1) + ((corner >> 1) & 1) * nx + (corner >> 2) * nxy] & LABEL_MASK;
}

// The label at `voxel` (padded voxel indices).
inline int label_at(__global const ushort *voxels, __global const uchar *groups,
                    __constant const Acquisition *acquisition, float3 voxel) {
  const int nx = acquisition->dims[0], ny = acquisition->dims[1], nz = acquisition->dims[2];
  voxel = clamp(voxel, (float3)(0.0f), (float3)(nx - 1.001f, ny - 1.001f, nz - 1.001f));
  const int3 base = convert_int3(voxel);
  return label_in_cell(voxels, groups, acquisition, (base.z * ny + base.y) * nx + base.x, voxel - convert_float3(base));
}

// Carry a vector perpendicular to `from` along the smallest rotation that takes `from` to `to`.
inline float3 carry(float3 v, float3 from, float3 to) {
  return v - dot3(v, to) / (1.0f + dot3(from, to)) * (from + to);
}

inline float3 mirror(float3 v, float3 normal) { return v - 2.0f * dot3(v, normal) * normal; }

// The ray beside its axis, in padded voxel indices: start + l step + sigma(l) aside at length l from the node's start.
typedef struct {
  float3 start, step, aside;
  float path;
} Course;

inline float3 course_at(__constant const Acquisition *acquisition, const Course *course, float l) {
  return course->start + l * course->step + elevation_sigma(acquisition, course->path + l) * course->aside;
}

// Lengths along the course at which it enters and leaves the volume: (enter, leave). `margin` is in voxels.
inline float2 volume_span(__constant const Acquisition *acquisition, const Course *course, float margin,
                          float longest) {
  float start[3] = {course->start.x, course->start.y, course->start.z};
  float step[3] = {course->step.x, course->step.y, course->step.z};
  float enter = 0.0f, leave = longest;
  for (int a = 0; a < 3; a++) {
    float inverse = 1.0f / (fabs(step[a]) < 1e-7f ? 1e-7f : step[a]);
    float t0 = (-margin - start[a]) * inverse, t1 = (acquisition->dims[a] - 1 + margin - start[a]) * inverse;
    enter = fmax(enter, fmin(t0, t1));
    leave = fmin(leave, fmax(t0, t1));
  }
  return (float2)(fmin(enter, longest), leave);
}

// Bisect the interval from `inside`, in `label`, to `beyond`, in `other`.
inline void bisect(__global const ushort *voxels, __global const uchar *groups,
                   __constant const Acquisition *acquisition, const Course *course, int label, int times, float *inside,
                   float *beyond, int *other) {
  for (int n = 0; n < times; n++) {
    const float middle = 0.5f * (*inside + *beyond);
    const int found = label_at(voxels, groups, acquisition, course_at(acquisition, course, middle));
    if (found == label) {
      *inside = middle;
    } else {
      *beyond = middle;
      *other = found;
    }
  }
}

// March from `*inside` until the label is no longer `label`, then bisect. Returns the first length found in another
// tissue, writes its label to `other` and the last length before it to `inside`; returns -1 if there is none up to
// `last`. Crossings before `blind_until` are ignored. Eight steps of half a voxel are looked up at once.
inline float next_border(__global const ushort *voxels, __global const uchar *groups,
                         __constant const Acquisition *acquisition, __constant const Tissue *tissues,
                         const Course *course, int label, float *inside, float last, float blind_until, int *other) {
  const float stride = 0.5f * acquisition->voxel_mm;
  const int nx = acquisition->dims[0], ny = acquisition->dims[1];
  const float3 top = (float3)(nx - 1.001f, ny - 1.001f, acquisition->dims[2] - 1.001f);
  float beyond = -1.0f;
  while (*inside < last && beyond < 0.0f) {
    const float8 ahead = min(*inside + stride * (float8)(1, 2, 3, 4, 5, 6, 7, 8), (float8)(last + 1e-4f));
    const float8 sigma = elevation_sigma8(acquisition, course->path + ahead);
    const float8 x =
        clamp(fma(sigma, (float8)(course->aside.x), fma(ahead, (float8)(course->step.x), (float8)(course->start.x))),
              (float8)(0.0f), (float8)(top.x));
    const float8 y =
        clamp(fma(sigma, (float8)(course->aside.y), fma(ahead, (float8)(course->step.y), (float8)(course->start.y))),
              (float8)(0.0f), (float8)(top.y));
    const float8 z =
        clamp(fma(sigma, (float8)(course->aside.z), fma(ahead, (float8)(course->step.z), (float8)(course->start.z))),
              (float8)(0.0f), (float8)(top.z));
    const int8 i = convert_int8(x), j = convert_int8(y), k = convert_int8(z);
    int here[8], differs = 0;
    vstore8((k * ny + j) * nx + i, 0, here);
    for (int n = 0; n < 8; n++) differs |= (voxels[here[n]] & (LABEL_MASK | SAME_LABEL)) ^ (label | SAME_LABEL);
    float length[8];
    vstore8(ahead, 0, length);
    if (differs) {
      float fx[8], fy[8], fz[8];
      vstore8(x - convert_float8(i), 0, fx);
      vstore8(y - convert_float8(j), 0, fy);
      vstore8(z - convert_float8(k), 0, fz);
      for (int n = 0; n < 8; n++) {
        *other = label_in_cell(voxels, groups, acquisition, here[n], (float3)(fx[n], fy[n], fz[n]));
        if (*other != label && course->path + length[n] > blind_until) {
          beyond = length[n];
          break;
        }
        *inside = length[n];
      }
    } else {
      *inside = length[7];
    }
  }
  if (beyond < 0.0f) return beyond;
  // Where only attenuation changes, a sixteenth of a voxel is enough. At an interface the position is bisected to 1/64
  // of a voxel, from which the smoothed border refines it.
  bisect(voxels, groups, acquisition, course, label, 3, inside, &beyond, other);
  if (tissues[*other].group != tissues[label].group)
    bisect(voxels, groups, acquisition, course, label, 2, inside, &beyond, other);
  return beyond;
}

// Two-way amplitude decay in nepers per mm: 10^(-alpha f 2 l / 20) with l in cm.
inline float decay_in(__constant const Acquisition *acquisition, Tissue tissue) {
  return tissue.attenuation_db_cm_mhz * acquisition->frequency_mhz * 0.2f * LN10_OVER_20;
}

// The sides of a border between two tissues.
inline Sides sides_of(__constant const Acquisition *acquisition, __constant const Tissue *tissues, Tissue here,
                      Tissue behind) {
  const float speed = beam_speed(here.speed_of_sound_m_s, decay_in(acquisition, here));
  const float speed_behind = beam_speed(behind.speed_of_sound_m_s, decay_in(acquisition, behind));
  Sides sides;
  sides.before = here.group, sides.behind = behind.group;
  sides.all_before = 1ul << here.group, sides.all_behind = 1ul << behind.group;
  sides.is_strong = !is_soft(speed, here.impedance_mrayl, speed_behind, behind.impedance_mrayl);
  for (int group = 0; sides.is_strong && group < MAX_TISSUES; group++) {
    const int label = tissues[group].label_of_group;
    if (label < 0) break;
    const Tissue third = tissues[label];
    const float speed_of_third = beam_speed(third.speed_of_sound_m_s, decay_in(acquisition, third));
    const int with_here = is_soft(speed, here.impedance_mrayl, speed_of_third, third.impedance_mrayl);
    const int with_behind = is_soft(speed_behind, behind.impedance_mrayl, speed_of_third, third.impedance_mrayl);
    if (with_here && !with_behind) sides.all_before |= 1ul << group;
    if (with_behind && !with_here) sides.all_behind |= 1ul << group;
  }
  return sides;
}

// The tube (tube_after) behind a mirror of curvature k at angle of incidence i in the plane of the offset: a ray beside
// this one meets a normal turned by k / cos i per mm of offset, and is itself turned by twice that angle.
inline float4 tube_reflected(__global const uchar *groups, __global const ushort *smooth,
                             __constant const Acquisition *acquisition, float4 tube, Ray ray, float3 point,
                             float3 normal, Sides sides) {
  for (int axis = 0; axis < 2; axis++) {
    const float3 offset = axis == 0 ? ray.lateral : ray.elevational;
    // Projected along the ray onto the surface, which lengthens the offset by 1 / cos i.
    const float3 along = offset - dot3(normal, offset) / fmin(dot3(normal, ray.direction), -0.2f) * ray.direction;
    const float longer = fmax(length3(along), 1e-3f);
    // Concave mirrors focus. With curvatures from voxels this would cause random bright spots, so they count as flat.
    const float curvature = convex_curvature(groups, smooth, acquisition, point, normal, along / longer, sides);
    const float growth = 2.0f * curvature * longer;
    if (axis == 0)
      tube.y += growth * tube.x;
    else
      tube.w += growth * tube.z;
  }
  return tube;
}

// The piece of a node from length `from` to `to`; `spent` is the attenuation exponent since the node's start at each.
inline Segment segment_of(Ray ray, float from, float to, float spent_from, float spent_to, float depth_per_mm) {
  Segment segment;
  vstore3(ray.axis + from * ray.direction, 0, segment.start);
  vstore3(ray.direction, 0, segment.direction);
  vstore3(ray.lateral, 0, segment.lateral);
  vstore3(ray.elevational, 0, segment.elevational);
  vstore4(tube_after(ray.tube, from), 0, segment.tube);
  segment.path_mm = ray.path + from;
  segment.length_mm = to - from;
  segment.depth_mm = ray.depth + from * depth_per_mm;
  segment.depth_per_mm = depth_per_mm;
  segment.weight = ray.weight;
  segment.attenuation = exp_fast(ray.log_attenuation - spent_from);
  segment.decay_per_mm = segment.loss_per_mm = (spent_to - spent_from) / (to - from);
  segment.loss = ray.loss + spent_from;
  segment.reflections = ray.reflections;
  segment.label = ray.label;
  return segment;
}

// Refraction and reflection at a fluid interface (docs/physics.md#3-rays): Snell's law and the pressure reflection
// coefficient r. R = r^2 is the two-way factor of the reflected branch, 1 - R that of the refracted branch.
typedef struct {
  float cos_in, cos_out, speed_ratio, pressure;
  int is_total;
} Interface;

inline Interface interface_between(Tissue here, Tissue behind, float3 direction, float3 normal) {
  Interface result;
  result.cos_in = clamp(-dot3(direction, normal), 0.01f, 1.0f);
  result.speed_ratio = behind.speed_of_sound_m_s / here.speed_of_sound_m_s;
  float sin2_out = result.speed_ratio * result.speed_ratio * (1.0f - result.cos_in * result.cos_in);
  result.is_total = sin2_out >= 1.0f;
  result.cos_out = sqrt(fmax(0.0f, 1.0f - sin2_out));
  float z_in = here.impedance_mrayl * result.cos_out, z_out = behind.impedance_mrayl * result.cos_in;
  result.pressure = result.is_total ? 1.0f : (z_out - z_in) / (z_out + z_in);
  return result;
}

// The root of a traced line: the beam frame at the probe face, transformed from the probe frame to RAS.
// `origin_and_direction` are (x, y) each, `start` the displayed depth at the face.
inline Ray root_of(__constant const Acquisition *acquisition, float4 origin_and_direction, float start) {
  const float2 origin = origin_and_direction.lo, direction = origin_and_direction.hi;
  Ray root;
  root.axis = affine_point(acquisition->probe_to_ras, (float3)(origin, 0.0f));
  root.direction = unit3(affine_vector(acquisition->probe_to_ras, (float3)(direction, 0.0f)));
  root.lateral = unit3(affine_vector(acquisition->probe_to_ras, (float3)(direction.y, -direction.x, 0.0f)));
  root.elevational = unit3(affine_vector(acquisition->probe_to_ras, (float3)(0.0f, 0.0f, 1.0f)));
  root.path = 0.0f;
  root.depth = start;
  root.log_attenuation = 0.0f;
  root.loss = 0.0f;
  root.weight = 1.0f;
  root.tube = (float4)(1.0f, 0.0f, 1.0f, 0.0f);
  root.blind_until = -1.0f;
  root.reflections = 0;
  root.label = -1;  // looked up at its start
  root.piece = -1;
  root.piece_has = root.strong = root.front = 0;
  root.from = root.shade = root.excess = root.soft = root.given_from = root.given = root.decay_before = 0.0f;
  root.front_weight = 1.0f;
  return root;
}

// Set a ray to the start of piece `number` of its line; behind the last one it goes straight on.
inline void start_piece(__constant const Acquisition *acquisition, __global const float *beams,
                        __global const float *shades, Ray root, int number, int count, Ray *ray) {
  ray->piece = number < acquisition->screen_depths ? number : -1;
  ray->piece_has = count;
  ray->from = ray->given_from = number * acquisition->screen_step;
  if (ray->strong == NOT_STRONG && (shades[4 * number + 3] >= 0.0f || ray->shade < shades[4 * number]))
    ray->shade = shades[4 * number];
  ray->given = 0.0f;
  ray->decay_before = 1e9f;  // what it starts in lies in front of nothing
  const float4 here = vload4(number, beams);
  const float path = number * acquisition->screen_step;
  ray->axis = root.axis + path * root.direction + here.z * root.lateral + here.w * root.elevational;
  if (ray->piece < 0) return;
  const float4 next = vload4(number + 1, beams);
  const float3 along = acquisition->screen_step * root.direction + (next.z - here.z) * root.lateral +
                       (next.w - here.w) * root.elevational;
  ray->direction = unit3(along);
  ray->lateral = carry(root.lateral, root.direction, ray->direction);
  ray->elevational = carry(root.elevational, root.direction, ray->direction);
}

// How a ray is corrected: changes of depth per mm since the start of the piece, and of the logarithm of amplitude and
// of the loss by which the frequency falls, since the path length `since`.
typedef struct {
  float depth, amplitude, loss, since;
} Correction;

// The correction by which a ray agrees with its beam at the end of the piece, which has lost `more` nepers there. The
// ray is at `path`, with `soft` nepers lost to soft tissue; from there on it is continued with these rates of depth and
// decay.
inline Correction correction(__constant const Acquisition *acquisition, __global const float *beams,
                             __global const float *shades, float start, const Ray *ray, float path, float depth,
                             float log_attenuation, float soft, float depth_per_mm, float decay, float more) {
  const float4 beam = vload4(ray->piece + 1, beams);
  // A border may turn out to lie a little beyond the end; no ray is corrected by more than it lacks at the end.
  const float end = (ray->piece + 1) * acquisition->screen_step, rest = end - path, last = fmax(end, path);
  const float lack = -beam.x - more - (log_attenuation - rest * decay);
  // What soft tissue has taken from it and not, on the mean, from the lines of which something arrives
  const float spared = soft + rest * decay - shades[4 * ray->piece + 6];
  Correction result;
  result.since = lack > 0.0f || spared > 0.0f ? fmax(ray->from, ray->given_from) : ray->from;
  const float per_mm = 1.0f / fmax(last - result.since, 1e-3f);
  result.depth = (start + end + beam.y - (depth + rest * depth_per_mm)) / fmax(last - ray->from, 1e-3f);
  result.amplitude = lack * per_mm;
  result.loss = -spared * per_mm;
  return result;
}

// Whether what a ray loses over a length in a layer, more than it would beside it, is to be given back from `path` on:
// it is of the layer of the piece in which most is lost. That is noted in the ray.
inline int gives_back(Ray *ray, float decay, float decay_beside, float length, float path) {
  const float lost = (decay - decay_beside) * length;
  if (ray->piece < 0 || ray->strong != NOT_STRONG || lost <= fmax(ray->given, LEAST_GIVEN)) return 0;
  ray->given = lost;
  ray->given_from = path;
  return 1;
}

// Whether strong tissue leaves nothing of a beam from piece `piece` on.
inline int is_dark(__constant const Acquisition *acquisition, __global const float *shades, int piece) {
  for (int n = piece + 1; n <= acquisition->screen_depths; n++)
    if (shades[4 * n] < DARKEST) return 0;
  return 1;
}

// The nepers that strong tissue has taken from a ray and not from its beam at the end of the piece: what the beam has
// there, where it is in such tissue, is what it had in front of that. So of a ray in strong tissue, and of a darker one
// that is beside it or has left it already.
inline float taken_from_ray(__global const float *shades, const Ray *ray) {
  const float lacks = ray->shade - shades[4 * ray->piece + 4];
  if (ray->strong != NOT_STRONG) return lacks;
  return shades[4 * ray->piece + 7] < 0.0f ? fmax(lacks, 0.0f) : 0.0f;
}

// The nepers that strong tissue takes right behind where a ray leaves it in this piece. Where the beam does not leave
// it before the end, those behind that.
inline float shade_behind(__constant const Acquisition *acquisition, __global const float *shades, int piece) {
  float shade = shades[4 * piece + 5];
  if (shades[4 * piece + 7] > -1.5f) return shade;
  for (int n = piece + 2; n <= acquisition->screen_depths; n++)
    if (shades[4 * n + 3] > 0.0f) return fmax(shade, shades[4 * n]);
  return shade;
}

// Length over which a ray at `path` is corrected. Strong tissue may end a little beyond its piece.
inline float corrected_length(float path, float from) { return fmax(path - from, 0.0f); }

// Correct what a ray has written since the start of its piece. Segments end where losses are given back.
inline void correct_segments(__global Segment *segments, int count, Correction by, float start) {
  for (int n = 0; n < count; n++) {
    segments[n].depth_mm += by.depth * corrected_length(segments[n].path_mm, start);
    segments[n].depth_per_mm += by.depth;
    if (segments[n].path_mm + 0.5f * segments[n].length_mm < by.since) continue;
    const float along = corrected_length(segments[n].path_mm, by.since);
    segments[n].attenuation *= exp_fast(by.amplitude * along);
    segments[n].decay_per_mm -= by.amplitude;
    segments[n].loss += by.loss * along;
    segments[n].loss_per_mm += by.loss;
  }
}

inline void correct_hits(__global Hit *hits, int count, Correction by, float start) {
  for (int n = 0; n < count; n++) {
    const float along = corrected_length(hits[n].path_mm, by.since), factor = exp_fast(by.amplitude * along);
    hits[n].depth_mm += by.depth * corrected_length(hits[n].path_mm, start);
    hits[n].attenuation *= factor;
    hits[n].echo *= factor;
    hits[n].loss += by.loss * along;
  }
}

// Coherent part of the echo of a border that carries the membrane, a surface of random heights: the mean of
// exp(i 2 k h cos i) over normal heights h (Ogilvy 1991, eq. 4.12). Its scatterers return the rest.
inline float membrane_coherence(__constant const Acquisition *acquisition, Tissue here, Tissue behind, float cos_in) {
  if (acquisition->membrane_reach < 0.0f || here.is_fluid == behind.is_fluid) return 1.0f;
  const float phase = acquisition->membrane_phase * cos_in;
  return exp_fast(-0.5f * phase * phase);
}

ONE_BY_ONE
__kernel void trace(__constant const Acquisition *acquisition, __global const ushort *voxels,
                    __global const uchar *groups, __global const ushort *smooth, __constant const Tissue *tissues,
                    __global const float *roots, __global const float *quantiles, __global const float *beams,
                    __global Segment *segments, __global int *segment_counts, __global Hit *hits,
                    __global int *hit_counts, __global float *cut, __global int *overflown) {
  const int line = get_global_id(0), ray_of_line = get_global_id(1), rays = acquisition->elevational_rays;
  const int on_axis = ray_of_line == 0;
  const int slot = line * rays + ray_of_line - 1;
  const float quantile = on_axis ? 0.0f : quantiles[slot];
  __global Segment *my_segments = segments + line * MAX_SEGMENTS;
  __global Hit *my_hits = hits + max(slot, 0) * MAX_HITS;
  __global const float *my_beams = beams + line * (1 + acquisition->screen_depths) * 4;
  __global const float *my_shades = beams + 4 * (acquisition->traced_lines + line) * (1 + acquisition->screen_depths);
  const int room = on_axis ? MAX_SEGMENTS : MAX_HITS;
  int count = 0;  // of segments or hits; a value above `room` means that some are missing
  float cut_weight = 0.0f;

  const float start = line_start(acquisition, (float)(line - acquisition->guard_lines) / acquisition->lateral_rays);
  const Ray root = root_of(acquisition, vload4(line, roots), start);
  Ray stack[MAX_STACK];
  stack[0] = root;
  if (acquisition->aperture_beams) start_piece(acquisition, my_beams, my_shades, root, 0, 0, stack);
  int waiting = 1;
  while (waiting > 0) {
    Ray ray = stack[--waiting];
    if (count > room) {  // nothing more can be written, and the number of branches can grow exponentially
      cut_weight += ray.weight;
      continue;
    }
    while (1) {  // one iteration per tree node: march to the next interface, branch, continue with the refracted child
      Course course;
      course.start = affine_point(acquisition->ras_to_voxel, ray.axis);
      course.step = affine_vector(acquisition->ras_to_voxel, ray.direction);
      course.aside = affine_vector(acquisition->ras_to_voxel, ray.elevational) * quantile;
      course.path = ray.path;
      if (ray.label < 0) {
        ray.label = label_at(voxels, groups, acquisition, course_at(acquisition, &course, 0.0f));
        const Tissue coupling = tissues[0], covering = tissues[ray.label];
        if (ray.piece >= 0 && is_covered(beam_speed(coupling.speed_of_sound_m_s, decay_in(acquisition, coupling)),
                                         beam_speed(covering.speed_of_sound_m_s, decay_in(acquisition, covering)))) {
          // The face stands in bone: beside the ray through it goes what other parts of the aperture see.
          if (!is_dark(acquisition, my_shades, ray.piece)) {
            Ray under = ray;
            under.front = 0;
            under.strong = UNDER;
            stack[waiting++] = under;
          }
          ray.piece = -1;
        }
      }
      Tissue here = tissues[ray.label], behind = here;
      const int is_under = ray.strong == UNDER;
      const Tissue front = tissues[ray.strong == NOT_STRONG ? ray.label : ray.front];
      const float front_decay = decay_in(acquisition, front);
      const float depth_per_mm =
          acquisition->reference_speed_m_s / (is_under ? front.speed_of_sound_m_s : here.speed_of_sound_m_s);
      const float to_depth = (acquisition->traced_mm - ray.depth) / depth_per_mm;
      const float to_piece = ray.piece < 0 ? 2.0f * to_depth : (ray.piece + 1) * acquisition->screen_step - ray.path;
      const float2 span =
          volume_span(acquisition, &course, 3.0f + fabs(quantile) * 4.0f / acquisition->voxel_mm, to_depth);

      // Tissues of one group have no interface between them: only attenuation changes there and the node continues.
      // `since` is the start of the current tissue, `spent` the attenuation exponent up to there; a segment is open
      // from `open`, with `spent_open`.
      float since = 0.0f, spent = 0.0f, open = 0.0f, spent_open = 0.0f, inside = span.x, border, until;
      int other = ray.label, is_silenced, piece_ends;
      while (1) {
        const float decay = is_under ? front_decay : decay_in(acquisition, here);
        const float reserve = log_fast(ray.weight / acquisition->intensity_threshold) + ray.log_attenuation - spent;
        const float to_silence = since + fmax(reserve, 0.0f) / fmax(decay, 1e-9f);
        const float longest = fmin(fmin(to_depth, to_silence), to_piece);
        piece_ends = ray.piece >= 0 && longest == to_piece;
        is_silenced = to_silence < to_depth && !piece_ends;
        border = next_border(voxels, groups, acquisition, tissues, &course, ray.label, &inside, fmin(span.y, longest),
                             ray.blind_until, &other);
        until = border < 0.0f ? longest : border;
        const float spent_until = spent + decay * (until - since);
        if (border >= 0.0f) behind = tissues[other];
        const int node_ends = border < 0.0f || behind.group != here.group;
        const int gives =
            !node_ends && gives_back(&ray, decay, decay_in(acquisition, behind), until - since, ray.path + until);
        if (on_axis && !is_under) {
          // A segment has one decay, its mean. If the error inside would exceed 0.02 neper (0.17 dB), the segment is
          // closed at the last change of tissue.
          const float earlier = since - open, mean_decay = earlier > 0.0f ? (spent - spent_open) / earlier : decay;
          if (fabs(decay - mean_decay) * fmin(earlier, until - since) > 0.02f) {
            if (count < room) my_segments[count] = segment_of(ray, open, since, spent_open, spent, depth_per_mm);
            count++;
            open = since;
            spent_open = spent;
          }
          if ((node_ends || gives) && until > open) {
            if (count < room) my_segments[count] = segment_of(ray, open, until, spent_open, spent_until, depth_per_mm);
            count++;
            open = until;
            spent_open = spent_until;
          }
        }
        spent = spent_until;
        if (node_ends) break;
        ray.decay_before = decay;
        since = until;
        here = behind;
        ray.label = other;
        inside = border;
      }
      const float own_decay = ray.strong == NOT_STRONG ? decay_in(acquisition, here) : front_decay;
      const int written = is_under ? 0 : min(count, room) - ray.piece_has;  // in this piece
      if (border < 0.0f) {
        Correction by = {0.0f, 0.0f, 0.0f, 0.0f};
        gives_back(&ray, own_decay, ray.decay_before, until - since, ray.path + since);
        const int goes_dark = is_silenced && ray.strong == THROUGH;
        ray.soft += ray.strong == THROUGH ? until * front_decay : spent;
        if (ray.strong == THROUGH) ray.excess += spent - until * front_decay;
        if (ray.piece >= 0)
          by = correction(acquisition, my_beams, my_shades, start, &ray, ray.path + until,
                          ray.depth + until * depth_per_mm, ray.log_attenuation - spent, ray.soft, depth_per_mm,
                          own_decay, ray.excess + taken_from_ray(my_shades, &ray));
        if (ray.piece >= 0 && on_axis) correct_segments(my_segments + ray.piece_has, written, by, ray.from);
        if (ray.piece >= 0 && !on_axis) correct_hits(my_hits + ray.piece_has, written, by, ray.from);
        if (!piece_ends && !goes_dark) {
          if (is_silenced) cut_weight += ray.weight;
          break;
        }
        ray.path += until;
        ray.depth += until * depth_per_mm + by.depth * corrected_length(ray.path, ray.from);
        ray.log_attenuation += by.amplitude * corrected_length(ray.path, by.since) - spent;
        ray.loss += by.loss * corrected_length(ray.path, by.since) + spent;
        ray.soft += by.loss * corrected_length(ray.path, by.since);
        if (goes_dark) {  // but the beam may go on behind this tissue
          cut_weight += ray.weight;
          ray.axis += until * ray.direction;
          ray.tube = tube_after(ray.tube, until);
          ray.strong = UNDER;
          ray.weight = ray.front_weight;
          ray.log_attenuation += ray.excess;
          ray.loss -= ray.excess;
          ray.excess = 0.0f;
          ray.from = ray.given_from = ray.blind_until = ray.path;
          continue;
        }
        start_piece(acquisition, my_beams, my_shades, root, ray.piece + 1, count, &ray);
        if (ray.piece < 0 && ray.strong != NOT_STRONG) break;
        continue;
      }

      float overshoot, curvature;
      const Sides sides = sides_of(acquisition, tissues, here, behind);
      const float3 normal = interface_normal(groups, smooth, acquisition, course_at(acquisition, &course, border),
                                             sides, ray.direction, course.step, &overshoot, &curvature);
      // Not back beyond the last border; but beyond the start of a piece, where there is none.
      const int is_continued = ray.piece > 0 && since == 0.0f;
      overshoot = fmin(overshoot, border - since + (is_continued ? acquisition->voxel_mm : 0.0f));
      float back = overshoot;
      if (overshoot == 0.0f) {  // only the labels give the position
        float beyond = border;
        bisect(voxels, groups, acquisition, &course, ray.label, 3, &inside, &beyond, &other);
        back = border - beyond;
        behind = tissues[other];
      }
      border -= back;
      spent -= back * (is_under ? front_decay : decay_in(acquisition, here));
      if (on_axis && !is_under && count > 0 && count <= room)
        my_segments[count - 1].length_mm = fmax(my_segments[count - 1].length_mm - back, 0.0f);
      const float front_speed = beam_speed(front.speed_of_sound_m_s, front_decay);
      const float behind_speed = beam_speed(behind.speed_of_sound_m_s, decay_in(acquisition, behind));
      const int is_strong_border =
          !acquisition->aperture_beams || !is_soft(beam_speed(here.speed_of_sound_m_s, decay_in(acquisition, here)),
                                                   here.impedance_mrayl, behind_speed, behind.impedance_mrayl);
      // Strong tissue ends where there is soft tissue again, as compared with what lies in front of it.
      const int is_strong = ray.strong == NOT_STRONG
                                ? is_strong_border
                                : !is_soft(front_speed, front.impedance_mrayl, behind_speed, behind.impedance_mrayl);
      const int is_beam = ray.piece >= 0;
      const int is_bent = !is_under && is_strong && !(is_beam && !bends(front_speed, behind_speed));
      const float path = ray.path + border;
      float depth = ray.depth + border * depth_per_mm, log_attenuation = ray.log_attenuation - spent;
      const int leaves = depth >= acquisition->traced_mm;
      if (!is_strong_border)
        gives_back(&ray, decay_in(acquisition, here), decay_in(acquisition, behind), border - since, path);
      ray.soft += ray.strong == THROUGH ? border * front_decay : spent;
      if (ray.strong == THROUGH) ray.excess += spent - border * front_decay;
      Correction by = {0.0f, 0.0f, 0.0f, 0.0f};
      // At a border that is not soft, as if the beam had up to the piece's end what strong tissue has left of it here.
      if (is_beam)
        by = correction(
            acquisition, my_beams, my_shades, start, &ray, path, depth, log_attenuation, ray.soft,
            is_bent || is_under || leaves ? depth_per_mm : acquisition->reference_speed_m_s / behind.speed_of_sound_m_s,
            own_decay, ray.excess + (leaves ? 0.0f : ray.shade - my_shades[4 * ray.piece + 4]));
      // What lies behind bone is not in front of it: of the beam's loss up to the piece's end, it is what phases take.
      const float most = MOST_BEFORE_STRONG / acquisition->screen_step;
      if (is_bent) {
        by.amplitude = clamp(by.amplitude, -most, most);
        by.loss = clamp(by.loss, -most, most);
      }
      const float corrected_depth = depth + by.depth * corrected_length(path, ray.from);
      const float corrected_log = log_attenuation + by.amplitude * corrected_length(path, by.since);
      float loss = ray.loss + spent;
      const float corrected_loss = loss + by.loss * corrected_length(path, by.since);
      Ray under = ray;  // where the beam goes on below strong tissue
      if (is_beam &&
          (leaves || is_bent || (ray.strong != NOT_STRONG && !is_strong))) {  // this course of the beam ends here
        if (on_axis)
          correct_segments(my_segments + ray.piece_has, written, by, ray.from);
        else
          correct_hits(my_hits + ray.piece_has, written, by, ray.from);
        depth = corrected_depth;
        log_attenuation = corrected_log;
        loss = corrected_loss;
        if (is_bent) {
          ray.piece = -1;
          ray.strong = NOT_STRONG;
        }
      }
      if (leaves) break;  // without the overshoot, the border lies beyond the field
      const float attenuation = exp_fast(log_attenuation);
      const float3 aside = quantile * elevation_sigma(acquisition, path) * ray.elevational;
      const float3 hit_point = ray.axis + border * ray.direction + aside;
      const float4 tube = tube_after(ray.tube, border);
      const Interface surface = interface_between(here, behind, ray.direction, normal);
      const float reflectance = surface.pressure * surface.pressure;

      if (!on_axis && !is_under) {
        if (count < room) {
          Hit hit;
          vstore3(hit_point, 0, hit.position);
          vstore3(normal, 0, hit.normal);
          hit.path_mm = path;
          hit.depth_mm = depth;
          hit.weight = ray.weight;
          hit.attenuation = attenuation;
          hit.loss = loss;
          hit.cos_incidence = surface.cos_in;
          hit.reflectance = reflectance;
          hit.lateral_slope = depth_per_mm * tube.x * slope_along(ray.lateral, ray.direction, normal);
          hit.elevational_slope = depth_per_mm * tube.z * slope_along(ray.elevational, ray.direction, normal);
          hit.curvature = curvature;
          hit.elevational_mm = quantile * elevation_sigma(acquisition, path);
          hit.echo = ray.weight * attenuation * (acquisition->interface_is_energy ? reflectance : surface.pressure) *
                     exp2_scalar(max(acquisition->specular_exponent * log2_scalar(surface.cos_in), -100.0f)) *
                     acquisition->interface_gain / (rays * tube.x * tube.z) *
                     membrane_coherence(acquisition, here, behind, surface.cos_in);
          hit.reflections = ray.reflections;
          hit.label_before = ray.label;
          hit.label_behind = other;
          my_hits[count] = hit;
        }
        count++;
      }

      // The reflected child is pushed onto the stack; weak ones and those beyond the tree's depth are cut.
      const float reflected_weight = ray.weight * reflectance, refracted_weight = ray.weight * (1.0f - reflectance);
      if (is_strong_border && !is_under) {
        if (ray.reflections < acquisition->max_ray_depth && reflected_weight >= acquisition->reflection_threshold &&
            reflected_weight * attenuation >= acquisition->intensity_threshold && waiting < MAX_STACK) {
          Ray child = ray;
          child.direction = unit3(mirror(ray.direction, normal));
          child.lateral = mirror(ray.lateral, normal);
          child.elevational = mirror(ray.elevational, normal);
          child.axis = hit_point - mirror(aside, normal);
          if (acquisition->reflection_spreading)
            child.tube = tube_reflected(groups, smooth, acquisition, tube, ray, hit_point, normal, sides);
          child.path = path;
          child.depth = corrected_depth;
          child.log_attenuation = corrected_log;
          child.loss = corrected_loss;
          child.weight = reflected_weight;
          child.blind_until = path + acquisition->voxel_mm;
          child.reflections = ray.reflections + 1;
          child.piece = -1;
          child.strong = NOT_STRONG;
          stack[waiting++] = child;
        } else {
          cut_weight += reflected_weight;
        }
      }

      // Up to a point beyond the trilinear border too: at grazing incidence the ray would cross the same border again.
      const float blind_until = overshoot > 0.0f ? path + overshoot + 0.5f * acquisition->voxel_mm : path;
      if (!is_bent) {
        if (is_strong && ray.strong == NOT_STRONG) {
          ray.strong = THROUGH;
          ray.front = ray.label;
          ray.front_weight = ray.weight;
        }
        // What is lost is what a square border reflects: grazing ones are a matter of the whole aperture.
        const float lost =
            is_under ? 0.0f : ray.weight * square_reflection(here.impedance_mrayl, behind.impedance_mrayl);
        if (!is_strong_border) cut_weight += lost;
        ray.weight -= lost;
        ray.axis = hit_point - aside;
        ray.tube = tube;
        ray.path = path;
        ray.depth = depth;
        ray.log_attenuation = log_attenuation;
        ray.loss = loss;
        ray.label = other;
        ray.blind_until = blind_until;
        ray.decay_before = is_under ? front_decay : decay_in(acquisition, here);
        if (count > room) break;
        if (!is_strong && ray.strong != NOT_STRONG) {
          // What this and other strong tissue has taken from the beam is in the level of its aperture.
          const float shade = shade_behind(acquisition, my_shades, ray.piece);
          ray.log_attenuation += ray.excess - (shade - ray.shade);
          // Of the pulse, the frequency falls by attenuation. Behind opaque tissue it is what has come past that.
          ray.loss -= ray.excess - clamp(shade - ray.shade, fmin(ray.excess, 0.0f), clamp(ray.excess, 0.0f, MOST_LOSS));
          ray.weight = ray.front_weight;
          ray.shade = shade;
          ray.excess = 0.0f;
          ray.strong = NOT_STRONG;
          ray.from = ray.given_from = path;
          ray.piece_has = count;
          if (is_dark(acquisition, my_shades, ray.piece)) {
            cut_weight += ray.weight;
            break;
          }
        }
        continue;
      }

      // Beside what is refracted, the beam goes on: from strong tissue's edge on, parts of its aperture see past it.
      if (is_beam && waiting < MAX_STACK && !is_dark(acquisition, my_shades, under.piece)) {
        if (under.strong == NOT_STRONG) {
          under.front = under.label;
          under.front_weight = under.weight;
        }
        under.weight = under.front_weight;
        under.strong = UNDER;
        under.axis = hit_point - aside;
        under.tube = tube;
        under.path = path;
        under.depth = depth;
        under.log_attenuation = log_attenuation + under.excess;
        under.loss = loss - under.excess;
        under.excess = 0.0f;
        under.from = under.given_from = path;
        under.label = other;
        under.blind_until = blind_until;
        stack[waiting++] = under;
      }

      // The refracted child continues this ray in a new direction.
      if (surface.is_total) break;
      if (refracted_weight * attenuation < acquisition->intensity_threshold || count > room) {
        cut_weight += refracted_weight;
        break;
      }
      const float ratio = surface.speed_ratio;
      const float3 bent = unit3(ratio * ray.direction + (ratio * surface.cos_in - surface.cos_out) * normal);
      ray.lateral = carry(ray.lateral, ray.direction, bent);
      ray.elevational = carry(ray.elevational, ray.direction, bent);
      ray.direction = bent;
      ray.axis = hit_point - quantile * elevation_sigma(acquisition, path) * ray.elevational;
      ray.tube = tube;
      ray.path = path;
      ray.depth = depth;
      ray.log_attenuation = log_attenuation;
      ray.loss = loss;
      ray.weight = refracted_weight;
      ray.label = other;
      ray.blind_until = blind_until;
    }
  }
  cut[line * (rays + 1) + ray_of_line] = cut_weight;
  if (!on_axis) {
    hit_counts[slot] = count;
    return;
  }
  segment_counts[line] = count;
  if (count > MAX_SEGMENTS) atomic_inc(overflown);
}
