// apply_level: the second harmonic arises on the way, so that its level depends on the distance from the face
// (docs/physics.md#harmonic-imaging); lines without contact have none (docs/physics.md#contact), and steered ones less
// (docs/physics.md#steered-lines).
//
// One work-item scales LANES samples of one scan line; global size (samples / LANES, scan lines). Buffers: levels float
// [sample], from where a line leaves the face; of_lines float [scan line]; re, im float [scan line][stride].

#include "common.clh"

__kernel void apply_level(Frame frame, __global const float *levels, __global const float *of_lines, __global float *re,
                          __global float *im, int stride) {
  const int sample = get_global_id(0) * LANES, line = get_global_id(1);
  const int here = line * stride + LINE_PAD + sample;
  const int start = (int)(line_start(frame, (float)line) / frame->sample_mm + 0.5f);
  float level_[LANES];
  for (int lane = 0; lane < LANES; lane++) level_[lane] = levels[max(sample + lane - start, 0)] * of_lines[line];
  const floatn level = LOAD_LANES(level_);
  STORE_LANES(LOAD_LANES(re + here) * level, re + here);
  STORE_LANES(LOAD_LANES(im + here) * level, im + here);
}
