// What a scanner's console does to the envelope and to grey levels (docs/physics.md#6-from-rf-to-image, console.py).
// Global size (samples / LANES, scan lines).
//
// Buffers: envelope, smooth float and grey, sharp uchar [scan line][samples]; taps float [2 reach + 1]; table float
// [entries], grey levels from black to white.

#include "display.clh"

// The envelope along a line, smoothed. Beyond its ends a line repeats its first and last sample.
__kernel void smooth_along(__global const float *envelope, __constant const float *taps, int reach, int samples,
                           __global float *smooth) {
  const int sample = get_global_id(0) * LANES, line = get_global_id(1);
  __global const float *row = envelope + line * samples;
  const int first = sample - reach;
  floatn sum = 0.0f;
  if (first >= 0 && sample + reach + LANES <= samples) {
    for (int k = 0; k <= 2 * reach; k++) sum = fma((floatn)(taps[k]), LOAD_LANES(row + first + k), sum);
  } else {
    for (int k = 0; k <= 2 * reach; k++) {
      float values[LANES];
      for (int lane = 0; lane < LANES; lane++) values[lane] = row[clamp(first + k + lane, 0, samples - 1)];
      sum = fma((floatn)(taps[k]), LOAD_LANES(values), sum);
    }
  }
  STORE_LANES(sum, smooth + line * samples + sample);
}

// The same across the lines.
__kernel void smooth_across(__global const float *envelope, __constant const float *taps, int reach, int samples,
                            __global float *smooth) {
  const int sample = get_global_id(0) * LANES, line = get_global_id(1), lines = get_global_size(1);
  floatn sum = 0.0f;
  for (int k = 0; k <= 2 * reach; k++) {
    const int from = clamp(line + k - reach, 0, lines - 1);
    sum = fma((floatn)(taps[k]), LOAD_LANES(envelope + from * samples + sample), sum);
  }
  STORE_LANES(sum, smooth + line * samples + sample);
}

// Log compression by a grey map.
__kernel void map_grey(__global const float *envelope, __global const float *table, int entries,
                       float level_of_white_db, Display display, int samples, __global uchar *grey) {
  const int here = get_global_id(1) * samples + get_global_id(0) * LANES;
  const floatn level_db = 6.02059991f * log2_fast(fmax(LOAD_LANES(envelope + here), 1e-15f));
  const floatn part = 1.0f + (level_db - level_of_white_db) / display.dynamic_range_db;
  const floatn place = clamp(part, 0.0f, 1.0f) * (float)(entries - 1);
  const intn entry = clamp(TO_INTN(place), (intn)(0), (intn)(entries - 2));
  const floatn between = place - TO_FLOATN(entry);
  SPREAD(int, at, entry);
  float low[LANES], high[LANES];
  for (int lane = 0; lane < LANES; lane++) {
    low[lane] = table[at[lane]];
    high[lane] = table[at[lane] + 1];
  }
  const floatn from = LOAD_LANES(low);
  STORE_GREY(fma(between, LOAD_LANES(high) - from, from) + 0.5f, grey + here);
}

// Grey levels, less their mean over 9 samples `step` apart of three lines.
__kernel void enhance_edges(__global const uchar *grey, int samples, int step, Display display, __global uchar *sharp) {
  const int sample = get_global_id(0) * LANES, line = get_global_id(1), lines = get_global_size(1);
  const int is_inside = sample - 4 * step >= 0 && sample + 4 * step + LANES <= samples;
  floatn sum = 0.0f;
  for (int aside = -1; aside <= 1; aside++) {
    __global const uchar *row = grey + clamp(line + aside, 0, lines - 1) * samples;
    for (int k = -4; k <= 4; k++) {
      if (is_inside) {
        sum += GREY_LANES(row + sample + k * step);
      } else {
        float values[LANES];
        for (int lane = 0; lane < LANES; lane++) values[lane] = row[clamp(sample + lane + k * step, 0, samples - 1)];
        sum += LOAD_LANES(values);
      }
    }
  }
  const floatn own = GREY_LANES(grey + line * samples + sample);
  const floatn value = own + display.edge_enhancement * (own - sum / 27.0f);
  STORE_GREY(clamp(value, 0.0f, 255.0f) + 0.5f, sharp + line * samples + sample);
}
