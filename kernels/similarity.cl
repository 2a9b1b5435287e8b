// compare_patches: the local histograms of two images and their absolute difference
// (docs/optimization.md#cost-function, equations 4 and 5 of the paper). One work-item compares one square patch; global
// size (patch columns, patch rows).
//
// Buffers: image, reference uchar [row][column]; inside uchar [row][column], 0 for pixels to ignore; result float
// [patch row][patch column][3]: 1 - sum_j sqrt(P_j Q_j), sum of absolute differences in grey levels, number of pixels
// used. The first is computed as half of sum_j (sqrt P_j - sqrt Q_j)^2, which is equal, and exact where P = Q.

#include "common.clh"

__kernel void compare_patches(__global const uchar *image, __global const uchar *reference,
                              __global const uchar *inside, int columns, int rows, int patch_columns, int patch_rows,
                              int bins, __global float *result) {
  const int px = get_global_id(0), py = get_global_id(1);
  int ours[MAX_BINS], theirs[MAX_BINS];
  for (int j = 0; j < bins; j++) ours[j] = theirs[j] = 0;
  const int x1 = min((px + 1) * patch_columns, columns), y1 = min((py + 1) * patch_rows, rows);
  int count = 0, difference = 0;
  for (int y = py * patch_rows; y < y1; y++)
    for (int x = px * patch_columns; x < x1; x++) {
      const int here = y * columns + x;
      if (!inside[here]) continue;
      const int a = image[here], b = reference[here];
      ours[a * bins / 256]++;
      theirs[b * bins / 256]++;
      difference += abs(a - b);
      count++;
    }
  float apart = 0.0f;
  for (int j = 0; j < bins; j++) {
    const float step = sqrt((float)ours[j]) - sqrt((float)theirs[j]);
    apart += step * step;
  }
  __global float *to = result + 3 * (py * (int)get_global_size(0) + px);
  to[0] = count > 0 ? 0.5f * apart / count : 0.0f;
  to[1] = difference;
  to[2] = count;
}
