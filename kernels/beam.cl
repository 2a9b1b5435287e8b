// lateral_beam: the lateral part of the point spread function, from traced lines to scan lines (PHYSICS section 4).
//
// One work-item computes LANES samples of one scan line; global size (samples / LANES, scan lines). In the unfolded
// geometry of the array two lines are y = (R + s) dtheta apart at path length s (or a fixed distance for a linear
// array), wherever refraction and reflection have sent them; so each part of the beam has gone its own way, and the
// edge of a shadow is as soft as the beam is wide. The weights are a Gaussian of unit sum. Scatterers come shared
// between the edges of a strip (scattering.cl), which has the mean variance step^2 / 6; this Gaussian is narrower by
// that.
//
// Buffers: from_re, from_im float [2 traced line + side][stride]; to_re, to_im float [scan line][stride].

#include "common.clh"

__kernel void lateral_beam(__constant const Scene *scene, __global const float *from_re, __global const float *from_im,
                           __global float *to_re, __global float *to_im, int stride) {
  int sample = get_global_id(0) * LANES, line = get_global_id(1);
  int centre = scene->guard_lines + line * scene->lateral_rays;
  float s0 = sample * scene->sample_mm, s1 = (sample + LANES) * scene->sample_mm;
  float widest = fmax(lateral_sigma(scene, s0), lateral_sigma(scene, s1));
  // Lane by lane: near a tight focus the width changes from sample to sample.
  const floatn s = (TO_FLOATN(LANE_INDEX) + sample) * scene->sample_mm;
  floatn step = line_distance_lanes(scene, s) / lateral_sigma_lanes(scene, s);  // between traced lines, in sigmas
  floatn step2 = step * step;
  floatn narrow2 = fmax(1.0f - step2 / 6.0f, 0.25f);  // (sigma of these weights / sigma of the beam)^2
  floatn exponent = -0.5f * LOG2_E * step2 / narrow2;
  int reach = (int)ceil(scene->beam_cutoff * widest / line_distance(scene, s0));
  // Edge `edge` lies half a step before traced line `edge`; the strips on both its sides contribute.
  int first = max(centre - reach, 1), last = min(centre + reach + 1, scene->traced_lines - 1);
  int here = LINE_PAD + sample;
  floatn sum_re = 0.0f, sum_im = 0.0f;
  for (int edge = first; edge <= last; edge++) {
    float away = edge - 0.5f - centre;
    floatn weight = exp2_fast(fmax(exponent * (away * away), -60.0f));
    int before = (2 * edge - 1) * stride + here, behind = before + stride;
    sum_re += weight * (LOAD_LANES(from_re + before) + LOAD_LANES(from_re + behind));
    sum_im += weight * (LOAD_LANES(from_im + before) + LOAD_LANES(from_im + behind));
  }
  floatn scale = step * rsqrt(narrow2) * 0.39894228f;  // 1 / sqrt(2 pi)
  STORE_LANES(sum_re * scale, to_re + line * stride + here);
  STORE_LANES(sum_im * scale, to_im + line * stride + here);
}
