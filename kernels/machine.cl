// Memory bandwidth and arithmetic throughput of the device (benchmarks/measuring.py): lower bounds of stage times.

#include "common.clh"

// Read and write once. One work-item moves LANES floats; global size (floats / LANES).
__kernel void move_memory(__global const float *from, __global float *to) {
  const size_t here = get_global_id(0) * LANES;
  STORE_LANES(LOAD_LANES(from + here) + 1.0f, to + here);
}

// Sixteen independent chains of multiply-adds, enough to hide their latency: 32 `rounds` LANES operations a work-item.
#define CHAINS 16
__kernel void multiply_add(__global float *to, float factor, float term, int rounds) {
  floatn chain[CHAINS];
  for (int n = 0; n < CHAINS; n++)
    chain[n] = TO_FLOATN(LANE_INDEX) + (float)(n + get_global_id(0));  // different in every chain
  for (int round = 0; round < rounds; round++)
    for (int n = 0; n < CHAINS; n++) chain[n] = mad(chain[n], (floatn)(factor), (floatn)(term));
  floatn sum = 0.0f;
  for (int n = 0; n < CHAINS; n++) sum += chain[n];
  STORE_LANES(sum, to + get_global_id(0) * LANES);
}
