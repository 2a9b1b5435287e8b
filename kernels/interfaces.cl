// interface_echoes: adds the echoes of tissue interfaces to the traced lines (docs/physics.md#3-rays; eq. 2 of
// the paper).
//
// One work-item computes one traced line: every hit of its elevational rays is an impulse at its travel time. The rays
// sample quantiles of the elevational profile, so their sum has the beam's elevational width; beam.cl applies the
// lateral profile.
//
// Buffers: hits, hit_counts (raytracing.cl); re, im float [2 traced line + side][stride]: complex baseband impulses,
// half on either side of the line (scattering.cl).

#include "common.clh"

__kernel void interface_echoes(__constant const Acquisition *acquisition, __global const Hit *hits,
                               __global const int *hit_counts, __global float *re, __global float *im, int stride) {
  int line = get_global_id(0), rays = acquisition->elevational_rays;
  __global float *left_re = re + 2 * line * stride + LINE_PAD, *left_im = im + 2 * line * stride + LINE_PAD;
  for (int ray = 0; ray < rays; ray++) {
    int slot = line * rays + ray, count = min(hit_counts[slot], MAX_HITS);
    __global const Hit *ray_hits = hits + slot * MAX_HITS;
    for (int h = 0; h < count; h++) {
      float depth = ray_hits[h].depth_mm, echo = 0.5f * ray_hits[h].echo;
      float place = depth / acquisition->sample_mm;
      int bin = (int)floor(place);
      if (bin < 0 || bin + 1 >= acquisition->samples) continue;
      float part = place - bin, c, s;
      turn(depth * acquisition->cycles_per_mm, &c, &s);
      c *= echo, s *= -echo;
      for (int side = 0; side < 2; side++) {
        int at = side * stride + bin;
        left_re[at] += c * (1.0f - part);
        left_im[at] += s * (1.0f - part);
        left_re[at + 1] += c * part;
        left_im[at + 1] += s * part;
      }
    }
  }
}
