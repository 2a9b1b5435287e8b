// side_lobes: adds what the lateral side lobes of the beam receive to every scan line
// (docs/physics.md#side-lobes-and-ring-down).
//
// One work-item computes LANES samples of all scan lines; global size (samples / LANES). The lobes are as broad as
// several beams, so neighbouring lines are averaged to nodes, which are convolved with the square root of the power
// that the diffraction pattern has at each distance; what comes out is interpolated between nodes. Lines have the main
// beam already. Lobes of an aperture have alternating signs: on average they do not interfere with the main beam, to
// which they are added in quadrature; signs change every two nodes. Main beam and lobes together have the power of the
// main beam before. Walls are added to the lines afterwards.
//
// Buffers: lobes float [LOBE_DEPTHS][LOBE_DISTANCES] of diffraction.py;
// re, im float [scan line][stride].

#include "common.clh"

// Nodes are at most this far apart, in wavelengths x f-number: less than a lobe.
#define NODE_DISTANCE 0.8f

// The convolution at a node with the weights of nodes 0, 1, 2... to either side.
inline floatn at_node(const floatn *values, const float *weights, int node, int nodes, int reach) {
  floatn sum = weights[0] * values[node];
  for (int n = 1; n <= reach; n++) {
    const int left = node - n, right = node + n;
    if (left < 0 && right >= nodes) break;  // beyond the image nothing is known
    if (left < 0) {
      sum += weights[n] * values[right];
    } else if (right >= nodes) {
      sum += weights[n] * values[left];
    } else {
      sum += weights[n] * (values[left] + values[right]);
    }
  }
  return sum;
}

// `unit_least` and `unit_slope` give the wavelength times the f-number of the receive aperture, in millimetres.
__kernel void side_lobes(__constant const Acquisition *acquisition, __global const float *lobes, __global float *re,
                         __global float *im, int stride, float unit_least, float unit_slope) {
  const int sample = get_global_id(0) * LANES, here = LINE_PAD + sample, lines = acquisition->scan_lines;
  // One path length for all lines and LANES: with steered lines that of the middle line, from where it leaves the face.
  const float depth_mm = (sample / LOSS_STEP * LOSS_STEP + 0.5f * LOSS_STEP) * acquisition->sample_mm;
  const float s = fmax(depth_mm - line_start(acquisition, 0.5f * (lines - 1)), 0.0f);
  const float apart = line_distance(acquisition, s) * acquisition->lateral_rays;
  const float unit = fmax(unit_least, unit_slope * s), main_beam = lateral_sigma(acquisition, s);
  const int dense = (lines + LOBE_NODES - 1) / LOBE_NODES;
  const int step = clamp((int)(NODE_DISTANCE * unit / apart), dense, lines), nodes = (lines + step - 1) / step;

  // The mean of lines whose speckle has the correlation exp(-distance^2 / 4 sigma^2) has this part of their power; with
  // a curved phase k y^2 / 2 the exponent is 1 + k^2 sigma^4 times as large. (Neighbouring nodes have one sign as often
  // as the other, and their correlation does not matter.)
  const float bent = lateral_curvature(acquisition, s, 1.0f) * main_beam * main_beam;
  const float fall = 0.25f * LOG2_E * (apart / main_beam) * (apart / main_beam) * (1.0f + bent * bent);
  float mean_power = 1.0f;
  for (int n = 1; n < step; n++)
    mean_power += 2.0f * (1.0f - (float)n / step) * exp2_scalar(fmax(-fall * n * n, -100.0f));
  mean_power /= step;
  const float per_node = step * apart / unit, scale = sqrt(per_node / mean_power);
  const float place = fmin(s / acquisition->depth_mm, 1.0f) * (LOBE_DEPTHS - 1);
  const int depth = min((int)place, LOBE_DEPTHS - 2);
  const float deeper = place - depth;
  __global const float *row = lobes + depth * LOBE_DISTANCES;
  float weights[LOBE_NODES], power[LOBE_NODES];  // the power up to each node, on one side
  int reach = 0;
  for (int n = 0; n < nodes; n++) {
    const float at = n * per_node / LOBE_STEP;
    if (at >= LOBE_DISTANCES - 1) break;
    const int column = (int)at;
    const float near = blend(row[column], row[column + 1], at - column);
    const float far = blend(row[LOBE_DISTANCES + column], row[LOBE_DISTANCES + column + 1], at - column);
    weights[n] = (n & 2 ? -scale : scale) * blend(near, far, deeper);
    power[n] = mean_power * weights[n] * weights[n] + (n > 1 ? power[n - 1] : 0.0f);
    reach = n;
  }

  floatn node_re[LOBE_NODES], node_im[LOBE_NODES];
  for (int node = 0; node < nodes; node++) {
    floatn sum_re = 0.0f, sum_im = 0.0f;
    for (int line = node * step; line < min(lines, (node + 1) * step); line++) {
      sum_re += LOAD_LANES(re + line * stride + here);
      sum_im += LOAD_LANES(im + line * stride + here);
    }
    node_re[node] = sum_re / (float)step;
    node_im[node] = sum_im / (float)step;
  }

  floatn before_re, before_im;
  float before_kept = 1.0f;
  int line = 0;
  for (int node = 0; node <= nodes; node++) {
    const int last = min(node, nodes - 1);
    const floatn lobe_re = at_node(node_re, weights, last, nodes, reach);
    const floatn lobe_im = at_node(node_im, weights, last, nodes, reach);
    // Of those that there are: beyond the image nothing is known.
    const int left = min(last, reach), right = min(nodes - 1 - last, reach);
    const float kept = rsqrt(1.0f + power[0] + (left > 0 ? power[left] : 0.0f) + (right > 0 ? power[right] : 0.0f));
    if (node == 0) before_re = lobe_re, before_im = lobe_im, before_kept = kept;
    // Up to the middle of the lines of this node
    const int end = node == nodes ? lines : min(lines, node * step + step / 2);
    for (; line < end; line++) {
      const float part = (line + 0.5f) / step + 0.5f - node;
      const float even = rsqrt(1.0f - 2.0f * part * (1.0f - part));  // nodes are independent: equal power between them
      floatn x = LOAD_LANES(re + line * stride + here), y = LOAD_LANES(im + line * stride + here);
      const float whole = blend(before_kept, kept, part);
      x = whole * (x - even * (before_im + part * (lobe_im - before_im)));
      y = whole * (y + even * (before_re + part * (lobe_re - before_re)));
      STORE_LANES(x, re + line * stride + here);
      STORE_LANES(y, im + line * stride + here);
    }
    before_re = lobe_re, before_im = lobe_im, before_kept = kept;
  }
}
