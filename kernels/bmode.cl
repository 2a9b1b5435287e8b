// From complex baseband impulses to grey levels (docs/physics.md#4-beam-and-pulse, docs/physics.md#6-from-rf-to-image).
// Global size (samples / LANES, scan lines).
//
// Buffers: re, im float [scan line][stride], LINE_PAD zeros on either side of the samples; losses as in downshift.cl;
// pulse float [2 reach + 1]; iq float2 (real, imaginary), envelope float and grey uchar [scan line][samples].

#include "display.clh"

// The axial part of the point spread function. The pulse is exp(-x^2 / 2 sx^2) cos(2 pi f x). Baseband impulses contain
// the phase of the carrier, so only the Gaussian envelope remains, and the magnitude needs no Hilbert transform.
__kernel void convolve_pulse(__global const float *re, __global const float *im, int stride,
                             __constant const float *pulse, int reach, Frame frame, __global const float *losses,
                             __global float *iq, int samples) {
  int sample = get_global_id(0) * LANES, line = get_global_id(1);
  __global const float *from_re = re + line * stride + LINE_PAD + sample - reach;
  __global const float *from_im = im + line * stride + LINE_PAD + sample - reach;
  floatn sum_re = 0.0f, sum_im = 0.0f;
  for (int k = 0; k <= 2 * reach; k++) {
    const floatn tap = (floatn)(pulse[k]);
    sum_re = fma(tap, LOAD_LANES(from_re + k), sum_re);
    sum_im = fma(tap, LOAD_LANES(from_im + k), sum_im);
  }
  if (frame->downshift > 0.0f) {  // back to the carrier of the transmitted pulse
    floatn c, s;
    turn(turns_at(frame, losses + LOSS_WORDS * line * (samples / LOSS_STEP + 1), sample), &c, &s);
    const floatn x = sum_re;
    sum_re = x * c + sum_im * s;
    sum_im = sum_im * c - x * s;
  }
  STORE_PAIRS(sum_re, sum_im, iq + 2 * (line * samples + sample));
}

// Amplifier noise, time gain compensation, envelope, log compression, eight bits. TGC is `tgc` [sample], in dB, and
// `line_gains` [scan line] are added to it. `ringing`, float2 [sample], is added to every line: the reverberation at
// the face. Both count from where the line leaves it.
__kernel void compress(Frame frame, __global const float *iq, int samples, __global const float *ringing, float noise,
                       uint noise_seed, __global const float *tgc, __global const float *line_gains,
                       float level_of_white_db, Display display, __global float *envelope, __global uchar *grey) {
  int sample = get_global_id(0) * LANES, line = get_global_id(1);
  int here = line * samples + sample;
  floatn re, im;
  LOAD_PAIRS(re, im, iq + 2 * here);
  const int start = (int)(line_start(frame, (float)line) / frame->sample_mm + 0.5f);
  floatn ring_re, ring_im, tgc_db;
  if (start == 0) {
    LOAD_PAIRS(ring_re, ring_im, ringing + 2 * sample);
    tgc_db = LOAD_LANES(tgc + sample);
  } else {
    float shifted_re[LANES], shifted_im[LANES], shifted_db[LANES];
    for (int lane = 0; lane < LANES; lane++) {
      const int from = sample + lane - start, at = max(from, 0);
      shifted_re[lane] = from < 0 ? 0.0f : ringing[2 * at];
      shifted_im[lane] = from < 0 ? 0.0f : ringing[2 * at + 1];
      shifted_db[lane] = tgc[at];
    }
    ring_re = LOAD_LANES(shifted_re);
    ring_im = LOAD_LANES(shifted_im);
    tgc_db = LOAD_LANES(shifted_db);
  }
  tgc_db += line_gains[line];
  re += ring_re;
  im += ring_im;
  const intn index = sample + LANE_INDEX;
  if (noise > 0.0f) {
    uintn key = hash_mixn(TO_UINTN(index) * 0x9E3779B1u + (noise_seed + (uint)line * 0x85EBCA77u));
    re += noise * gaussian(key);
    im += noise * gaussian(hash_mixn(key + 0x9E3779B9u));
  }
  floatn power = re * re + im * im + 1e-30f;
  const floatn level_db = 3.01029996f * log2_fast(power) + tgc_db;
  STORE_LANES(sqrt(power) * exp2_fast(clamp(tgc_db * 0.166096405f, -100.0f, 100.0f)), envelope + here);
  STORE_GREY(grey_level(level_db, level_of_white_db, display.dynamic_range_db), grey + here);
}

// Mean grey level over `width` samples about each sample, the depth range of one pixel of the image. Single samples
// would alias the speckle into black dashes. Beyond its ends a line repeats its first and last sample of the image,
// which has `shown` of them: the pulse is not whole in those behind.
__kernel void average_depth(__global const uchar *grey, __global uchar *smooth, int samples, int shown, int width) {
  int sample = get_global_id(0) * LANES, line = get_global_id(1);
  __global const uchar *row = grey + line * samples;
  const int first = sample - width / 2;
  floatn sum = 0.0f;
  if (first >= 0 && first + width - 1 + LANES <= shown) {
    for (int k = 0; k < width; k++) sum += GREY_LANES(row + first + k);
  } else {
    float ends[LANES];
    for (int lane = 0; lane < LANES; lane++) {
      ends[lane] = 0.0f;
      for (int k = 0; k < width; k++) ends[lane] += row[clamp(first + k + lane, 0, shown - 1)];
    }
    sum = LOAD_LANES(ends);
  }
  STORE_GREY(sum / width + 0.5f, smooth + line * samples + sample);
}
