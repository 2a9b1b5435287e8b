// Images of one pose as a function of the free parameters (docs/optimization.md#efficient-evaluation). The
// echoes of each varied tissue are combined again for every image (appearance.py).
//
// Buffers: lengths, path float [scan line][sample]; bases and iq float2 [scan line][sample].

#include "common.clh"

// Two-way attenuation in nepers along the direct path to every sample of a scan line. One work-item computes one line.
// Reflected branches, which overlap the direct path in time, are assumed to have the same attenuation.
__kernel void direct_path(Frame frame, __global const Segment *segments, __global const int *segment_counts,
                          __global float *path) {
  const int scan_line = get_global_id(0);
  const int line = frame->guard_lines + scan_line * frame->lateral_rays;
  __global float *to = path + scan_line * frame->samples;
  const int count = min(segment_counts[line], MAX_SEGMENTS);
  int sample = 0;
  float spent = 0.0f;
  for (int index = 0; index < count; index++) {
    __global const Segment *segment = segments + line * MAX_SEGMENTS + index;
    if (segment->reflections > 0) continue;
    const float end = segment->depth_mm + segment->length_mm * segment->depth_per_mm;
    const float before = -log_fast(segment->attenuation);
    for (; sample < frame->samples && sample * frame->sample_mm <= end; sample++) {
      const float along = fmax(sample * frame->sample_mm - segment->depth_mm, 0.0f) / segment->depth_per_mm;
      spent = before + segment->decay_per_mm * along;
      to[sample] = spent;
    }
  }
  for (; sample < frame->samples; sample++) to[sample] = spent;
}

// One image's baseband signal: the bases with these weights, times exp2 of the paths with theirs. Global size
// (samples / LANES, scan lines).
__kernel void mix_bases(__global const float *bases, __constant const float *weights, int count,
                        __global const float *paths, __constant const float *decays, int tissues, Frame frame,
                        __global const float *losses, __global float *iq, int samples) {
  const int here = get_global_id(1) * samples + get_global_id(0) * LANES;
  const int values = (int)get_global_size(1) * samples;
  floatn low = 0.0f, high = 0.0f;  // real and imaginary parts side by side
  for (int n = 0; n < count; n++) {
    __global const float *from = bases + 2 * (n * values + here);
    low += weights[n] * LOAD_LANES(from);
    high += weights[n] * LOAD_LANES(from + LANES);
  }
  floatn exponent = 0.0f;
  for (int t = 0; t < tissues; t++) exponent += decays[t] * LOAD_LANES(paths + t * values + here);
  // A further loss costs less of a band whose frequency has fallen (downshift.cl).
  const int sample = get_global_id(0) * LANES;
  const floatn loss = loss_at(losses + LOSS_WORDS * (int)get_global_id(1) * (samples / LOSS_STEP + 1), sample);
  const floatn further = exponent / -LOG2_E;
  if (tissues > 0) exponent += LOG2_E * (gain_of_band_lanes(frame, loss + further) - gain_of_band_lanes(frame, loss));
  const floatn factor = exp2_fast(clamp(exponent, -100.0f, 100.0f));
#if LANES == 1
  vstore2((float2)(low, high) * factor, here, iq);
#else
  floatn re, im;
  re.lo = low.even, im.lo = low.odd, re.hi = high.even, im.hi = high.odd;
  STORE_PAIRS(re * factor, im * factor, iq + 2 * here);
#endif
}
