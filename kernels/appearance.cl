// Images of one pose as a function of the free parameters (docs/optimization.md#efficient-evaluation). Parts of the
// echoes are combined before beam and pulse, which are linear too, and the results again for every image
// (appearance.py).
//
// Buffers: parts float [part][values]; lengths, path float [scan line][sample]; bases and iq float2 [scan
// line][sample].

#include "common.clh"

// One linear combination of the parts written by scattering.cl. Global size (values / LANES).
__kernel void mix_parts(__global const float *parts, __global const float *weights, int count, int values,
                        __global float *mixed) {
  const int here = get_global_id(0) * LANES;
  floatn sum = 0.0f;
  for (int part = 0; part < count; part++)
    if (weights[part] != 0.0f) sum += weights[part] * LOAD_LANES(parts + part * values + here);
  STORE_LANES(sum, mixed + here);
}

// Two-way attenuation in nepers along the direct path to every sample of a scan line. One work-item computes one line.
// Reflected branches, which overlap the direct path in time, are assumed to have the same attenuation.
__kernel void direct_path(__constant const Acquisition *acquisition, __global const Segment *segments,
                          __global const int *segment_counts, __global float *path) {
  const int scan_line = get_global_id(0);
  const int line = acquisition->guard_lines + scan_line * acquisition->lateral_rays;
  __global float *to = path + scan_line * acquisition->samples;
  const int count = min(segment_counts[line], MAX_SEGMENTS);
  int sample = 0;
  float spent = 0.0f;
  for (int index = 0; index < count; index++) {
    __global const Segment *segment = segments + line * MAX_SEGMENTS + index;
    if (segment->reflections > 0) continue;
    const float end = segment->depth_mm + segment->length_mm * segment->depth_per_mm;
    const float before = -log(segment->attenuation);
    for (; sample < acquisition->samples && sample * acquisition->sample_mm <= end; sample++) {
      const float along = fmax(sample * acquisition->sample_mm - segment->depth_mm, 0.0f) / segment->depth_per_mm;
      spent = before + segment->decay_per_mm * along;
      to[sample] = spent;
    }
  }
  for (; sample < acquisition->samples; sample++) to[sample] = spent;
}

// One image's baseband signal: the bases with these weights, times exp2 of the paths with theirs. Global size
// (samples / LANES, scan lines).
__kernel void mix_bases(__global const float *bases, __constant const float *weights, int count,
                        __global const float *paths, __constant const float *decays, int tissues, __global float *iq,
                        int samples) {
  const int here = get_global_id(1) * samples + get_global_id(0) * LANES;
  const int values = (int)get_global_size(1) * samples;
  floatn low = 0.0f, high = 0.0f;  // real and imaginary parts side by side
  for (int n = 0; n < count; n++) {
    __global const float *from = bases + 2 * (n * values + here);
#if LANES == 1
    low += weights[n] * from[0];
    high += weights[n] * from[1];
#else
    low += weights[n] * LOAD_LANES(from);
    high += weights[n] * LOAD_LANES(from + LANES);
#endif
  }
  floatn exponent = 0.0f;
  for (int t = 0; t < tissues; t++) exponent += decays[t] * LOAD_LANES(paths + t * values + here);
  const floatn factor = exp2_fast(clamp(exponent, -100.0f, 100.0f));
#if LANES == 1
  vstore2((float2)(low, high) * factor, here, iq);
#else
  floatn re, im;
  re.lo = low.even, im.lo = low.odd, re.hi = high.even, im.hi = high.odd;
  STORE_PAIRS(re * factor, im * factor, iq + 2 * here);
#endif
}
