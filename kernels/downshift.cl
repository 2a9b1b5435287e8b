// losses, shift_frequency: attenuation rises with frequency, so that a pulse loses more of its high frequencies
// (docs/physics.md#frequency-that-falls-with-depth).
//
// A Gaussian spectrum exp(-(f - f0)^2 / 2 sf^2) times exp(-A f), the two-way loss, is the same Gaussian about f0 - A
// sf^2 times exp(-A f0 + (A sf)^2 / 2), of which the part above zero is there. Every echo has its own amplitude
// (gain_of_band). Its frequency comes from the strongest path to its depth on the scan line: behind bone, from a
// mirror image in front of it.
//
// Buffers: segments with their counts as in raytracing.cl; losses float [scan line][1 + samples / LOSS_STEP]
// [LOSS_WORDS] of common.clh; re, im float [scan line][stride].

#include "common.clh"

// One work-item computes one scan line. Global size (scan lines).
__kernel void losses(Frame frame, __global const Segment *segments, __global const int *segment_counts,
                     __global float *losses_) {
  const int scan_line = get_global_id(0), nodes = frame->samples / LOSS_STEP + 1;
  const int line = frame->guard_lines + scan_line * frame->lateral_rays;
  const float step = LOSS_STEP * frame->sample_mm;
  __global float *to = losses_ + LOSS_WORDS * scan_line * nodes;
  const int count = min(segment_counts[line], MAX_SEGMENTS);
  for (int node = 0; node < nodes; node++) vstore3((float3)(0.0f, -1.0f, 1.0f), node, to);
  for (int index = 0; index < count; index++) {
    __global const Segment *segment = segments + line * MAX_SEGMENTS + index;
    const float slope = segment->depth_per_mm, end = segment->depth_mm + segment->length_mm * slope;
    const int last = min((int)(end / step), nodes - 1);
    for (int node = max((int)ceil(segment->depth_mm / step), 0); node <= last; node++) {
      const float along = (node * step - segment->depth_mm) / slope;
      const float strength = segment->weight * segment->attenuation * exp_fast(-segment->decay_per_mm * along);
      if (strength > to[LOSS_WORDS * node + 1])
        vstore3((float3)(segment->loss + segment->loss_per_mm * along, strength, 1.0f), node, to);
    }
  }
  float loss = 0.0f, lower = 0.0f, turns = 0.0f;
  for (int node = 0; node < nodes; node++) {
    if (to[LOSS_WORDS * node + 1] >= 0.0f) loss = to[LOSS_WORDS * node];  // without an echo here, the loss stays
    const float frequency = frequency_after(frame, loss), missing = 1.0f - frequency;
    if (node > 0) turns += 0.5f * (lower + missing) * step * frame->cycles_per_mm;
    lower = missing;
    vstore3((float3)(loss, turns, frequency), node, to);
  }
}

// The carrier of every echo becomes that of its depth, for a pulse without a carrier to be convolved with. Echoes lie
// between two samples, with one phase in both. Turned by an angle from one sample to the next, they have (2 + cos) / 3
// of their power on average, which is given back. Global size (samples / LANES, scan lines).
__kernel void shift_frequency(Frame frame, __global const float *losses_, __global float *re, __global float *im,
                              int stride) {
  const int sample = get_global_id(0) * LANES, line = get_global_id(1);
  const int here = line * stride + LINE_PAD + sample;
  __global const float *of_line = losses_ + LOSS_WORDS * line * (frame->samples / LOSS_STEP + 1);
  floatn c, s;
  turn(turns_at(frame, of_line, sample), &c, &s);
  const float cycles = frame->sample_mm * frame->cycles_per_mm;
  floatn step_c, step_s;
  turn((1.0f - frequency_at(of_line, sample)) * cycles, &step_c, &step_s);
  const floatn kept = 1.0f / sqrt((2.0f + step_c) / 3.0f);
  const floatn x = kept * LOAD_LANES(re + here), y = kept * LOAD_LANES(im + here);
  STORE_LANES(x * c - y * s, re + here);
  STORE_LANES(x * s + y * c, im + here);
}
