// trace: the binary ray tree of every traced line (docs/physics.md#3-rays).
//
// One work-item follows one ray and all its children. Global size (traced lines, 1 + elevational rays).
//   ray 0 of a line runs along the beam axis and writes the segments along which the scatter kernel works;
//   rays 1.. run at fixed quantiles of the elevational beam profile and write the interface hits, so that an interface
//   echo has the beam's elevational width. The lateral width comes from the neighbouring lines (beam.cl).
// Traced lines are at least as dense as scan lines (lateral_rays per scan line), with a few beyond the edges. With
// aperture_beams, a line follows its beam up to the first border that bends it (follow_beam.clh).
//
// Buffers: voxels ushort [k][j][i], groups uchar [k][j][i] and smooth ushort [group][k][j][i] (medium.py); tissues
// Tissue [label]; roots float4 [traced line], origin and direction (x, y) in the probe frame; beams as in
// aperture.cl; quantiles float [traced line][elevational ray], offsets in units of the elevational sigma; segments
// Segment [traced line][MAX_SEGMENTS] with segment_counts; hits Hit [traced line][elevational ray][MAX_HITS] with
// hit_counts; cut float [traced line][1 + elevational ray], the weight of the branches that were not followed;
// overflown int [1], the number of traced lines with more than MAX_SEGMENTS segments.

#include "follow_beam.clh"

// Follow one ray of the tree. Its nodes are straight and end at a border between acoustic groups, where it splits: with
// the pressure reflection coefficient r of two fluids and R = r^2, the reflected child has the weight w R and waits on
// the stack; the refracted one, w (1 - R), is followed in its place, turned by Snell's law (Salehi et al. 2015, section
// 2.2). Of the amplitude, 10^(-alpha f 2 l / 20) remains over a length of l cm. A ray ends at the depth of the image,
// where w A falls below intensity_threshold, or where nothing more can be written (the number of branches can grow
// exponentially). The rest of it then, and children that are not followed, is added to `cut`: leaves and cuts
// sum to one. Through soft borders, with the aperture's beams, it goes straight on.
inline void trace_ray(Line *line, Ray ray) {
  Frame frame = line->frame;
  while (line->count <= line->room) {
    March to = march_from(line, &ray, 0);
    do {
      march(line, &ray, &to, 1e9f);
      write_segments(line, &ray, &to, to.ends);
    } while (!to.ends);
    if (to.border < 0.0f) {
      if (to.is_silenced) line->cut += ray.weight;
      return;
    }
    const Crossing at = cross_border(line, &ray, &to, 0.0f);
    if (ray.depth >= frame->traced_mm) return;  // without the overshoot, the border lies beyond the field
    write_hit(line, &ray, &at);
    if (at.is_strong) {
      push_reflected(line, &ray, &at);
      if (!refract(line, &ray, &at)) return;
    } else {
      go_straight(line, &ray, &at, 1);
    }
  }
  line->cut += ray.weight;
}

ONE_BY_ONE
__kernel void trace(Frame frame, __global const ushort *voxels, __global const uchar *groups,
                    __global const ushort *smooth, __constant const Tissue *tissues, __global const float *roots,
                    __global const float *quantiles, __global const float *beams, __global Segment *segments,
                    __global int *segment_counts, __global Hit *hits, __global int *hit_counts, __global float *cut,
                    __global int *overflown) {
  const int number = get_global_id(0), ray_of_line = get_global_id(1), rays = frame->elevational_rays;
  const int on_axis = ray_of_line == 0, slot = number * rays + ray_of_line - 1, depths = 1 + frame->screen_depths;
  Ray stack[MAX_STACK + 1];  // one of them for the ray that is followed next
  Line line = {frame,
               tissues,
               voxels,
               groups,
               smooth,
               segments + number * MAX_SEGMENTS,
               hits + max(slot, 0) * MAX_HITS,
               stack,
               on_axis ? 0.0f : quantiles[slot],
               0.0f,
               on_axis,
               on_axis ? MAX_SEGMENTS : MAX_HITS,
               0,
               0};
  Ray ray = root_of(frame, vload4(number, roots), traced_start(frame, (float)number));
  Beam beam = {beams + 4 * number * depths, beams + 4 * (frame->traced_lines + number) * depths, ray};
  int is_beam = frame->aperture_beams;
  if (is_beam) start_piece(&line, 0, &ray, &beam);
  const Course course = course_of(&line, &ray);
  ray.label = label_at(&line, course_at(frame, &course, 0.0f));
  // Where the face stands in bone, what other parts of the aperture see goes beside the ray through it.
  const int is_in_bone =
      is_beam && is_covered(speed_to_beams(frame, tissues), speed_to_beams(frame, tissues + ray.label));
  if (is_in_bone) {
    beam.strong = UNDER;
    beam.front_weight = 1.0f;
    is_beam = !is_dark(&line, &beam);
  }
  if (is_in_bone || !is_beam) stack[line.waiting++] = ray;

  // Depth first: the refracted ray and all its children, before the beam continues beside it; all others at the end.
  int below = 0;
  while (1) {
    while (line.waiting > below) trace_ray(&line, stack[--line.waiting]);
    if (!is_beam) break;
    is_beam = follow_beam(&line, &ray, &beam);
    below = is_beam ? line.waiting - 1 : 0;
  }

  cut[number * (rays + 1) + ray_of_line] = line.cut;
  *(on_axis ? segment_counts + number : hit_counts + slot) = line.count;
  if (on_axis && line.count > MAX_SEGMENTS) atomic_inc(overflown);
}
