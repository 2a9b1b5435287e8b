// side_lobes: adds what the lateral side lobes of the beam receive to every scan line
// (docs/physics.md#side-lobes-and-ring-down).
//
// One work-item computes LANES samples of all scan lines; global size (samples / LANES). The lobes are as broad as
// several beams, so neighbouring lines are averaged to nodes, which are convolved with the square root of the power
// that the diffraction pattern has at each distance; what comes out is interpolated between nodes. Lines have the main
// beam already. The phases of lobes and of multiply scattered waves are as good as random: each pair of a place that
// scatters and a distance at which its echo is shown has a random sign, fixed in the patient as scatterers are. A lobe
// and the main beam of the same line are in quadrature, so that they do not interfere. Main beam and lobes together
// have the power of the main beam before. Walls are added to the lines afterwards.
//
// Buffers: lobes float [LOBE_DEPTHS][LOBE_DISTANCES] of diffraction.py; roots as in raytracing.cl; re, im float [scan
// line][stride].

#include "common.clh"

// Nodes are at most this far apart, in wavelengths x f-number: about the length over which speckle of the main beam
// correlates.
#define NODE_DISTANCE 1.0f
// Signs are random from cell to cell of a lattice fixed in the patient, whose cells are so wide, in the same unit.
#define SIGN_CELL 4.0f

#define FADING 0.03f  // part of a cell to either side of its border over which those of its neighbour replace them

// Random bits of the cells of the patient that a place is in, with their amplitudes: one, or several near a border.
typedef struct {
  int count;
  uint bits[8];
  float parts[8];
} Place;

// The lattice is oblique to the patient's axes: an image along them would lie in the border of its cells. Rows of
// (2 -1 2; 2 2 -1; -1 2 2) / 3 are its axes.
//
// Where in the patient a scan line is at a displayed depth.
inline Place place_at(Frame frame, __global const float *roots, int line, float depth_mm, float inverse_cell) {
  const float4 root = vload4(frame->guard_lines + line * frame->lateral_rays, roots);
  const float along = fmax(depth_mm - line_start(frame, (float)line), 0.0f);
  const float3 place = (float3)(root.x + along * root.z, root.y + along * root.w, 0.0f);
  const float3 p = affine_point(frame->probe_to_ras, place) * (inverse_cell / 3.0f);
  const float3 at = 2.0f * (p.xxy + p.zyz) - p.yzx + 0.37f, cell = floor(at), inside = at - cell;
  const float3 beside = fmax(0.5f - 0.5f / FADING * fmin(inside, 1.0f - inside), 0.0f);  // of the nearest neighbours
  const float3 power = beside * beside + (1.0f - beside) * (1.0f - beside);
  const int3 step = select((int3)(-1), (int3)(1), inside > 0.5f);
  const float scale = 1.0f / sqrt(power.x * power.y * power.z);
  Place found;
  found.count = 0;
  for (int corner = 0; corner < 8; corner++) {
    const int dx = corner & 1, dy = (corner >> 1) & 1, dz = corner >> 2;
    const float part =
        (dx ? beside.x : 1.0f - beside.x) * (dy ? beside.y : 1.0f - beside.y) * (dz ? beside.z : 1.0f - beside.z);
    if (part == 0.0f) continue;
    const uint key = (uint)((int)cell.x + dx * step.x) * 0x9E3779B1u + (uint)((int)cell.y + dy * step.y) * 0x85EBCA77u +
                     (uint)((int)cell.z + dz * step.z) * 0xC2B2AE3Du;
    found.bits[found.count] = hash_mix(key ^ frame->seed);
    found.parts[found.count++] = scale * part;
  }
  return found;
}

// A weight with a random sign: the parity of the bits that both have.
inline float with_sign(float weight, uint place, uint offset) {
  return as_float(as_uint(weight) ^ (popcount(place & offset) << 31));
}

// What the lobes of a node receive, with the weights of nodes 0, 1, 2... to either side and the random bits of these
// distances. `places` are those from places_of[node] on. Beyond the image nothing is known.
inline void at_node(const floatn *re, const floatn *im, const int *nodes_of, const uint *bits, const float *parts,
                    const int *places_of, const uint *offsets, const float *weights, int node, int nodes, int reach,
                    floatn *lobe_re, floatn *lobe_im) {
  floatn x = weights[0] * re[node], y = weights[0] * im[node];
  for (int n = places_of[max(node - reach, 0)]; n < places_of[node]; n++) {
    const int other = nodes_of[n], away = node - other;
    const float weight = with_sign(weights[away] * parts[n], bits[n], offsets[away]);
    x += weight * re[other];
    y += weight * im[other];
  }
  for (int n = places_of[node + 1]; n < places_of[min(node + reach, nodes - 1) + 1]; n++) {
    const int other = nodes_of[n], away = other - node;
    const float weight = with_sign(weights[away] * parts[n], bits[n], rotate(offsets[away], 16u));
    x += weight * re[other];
    y += weight * im[other];
  }
  *lobe_re = x;
  *lobe_im = y;
}

// `unit_least` and `unit_slope` give the wavelength times the f-number of the receive aperture, in millimetres.
__kernel void side_lobes(Frame frame, __global const float *lobes, __global const float *roots, __global float *re,
                         __global float *im, int stride, float unit_least, float unit_slope) {
  const int sample = get_global_id(0) * LANES, here = LINE_PAD + sample, lines = frame->scan_lines;
  // One path length for all lines and LANES: with steered lines that of the middle line, from where it leaves the face.
  // (At one displayed depth all lines are equally far apart.)
  const float depth_mm = (sample / LOSS_STEP * LOSS_STEP + 0.5f * LOSS_STEP) * frame->sample_mm;
  const float s = fmax(depth_mm - line_start(frame, 0.5f * (lines - 1)), 0.0f);
  const float apart = line_distance(frame, depth_mm) * frame->lateral_rays;
  const float unit = fmax(unit_least, unit_slope * s), cosine = line_cosine(frame, 0.5f * (lines - 1)),
              main_beam = lateral_sigma(frame, s, 1.0f, cosine);
  const int dense = (lines + LOBE_NODES - 1) / LOBE_NODES;
  const int step = clamp((int)(NODE_DISTANCE * unit / apart), dense, lines), nodes = (lines + step - 1) / step;

  // The mean of lines whose speckle has the correlation exp(-distance^2 / 4 sigma^2) has this part of their power; with
  // a curved phase k y^2 / 2 the exponent is 1 + k^2 sigma^4 times as large. (Signs are random, so that the correlation
  // of different nodes does not matter.)
  const float bent = lateral_curvature(frame, s, 1.0f, cosine) * main_beam * main_beam;
  const float fall = 0.25f * LOG2_E * (apart / main_beam) * (apart / main_beam) * (1.0f + bent * bent);
  float mean_power = 1.0f;
  for (int n = 1; n < step; n++)
    mean_power += 2.0f * (1.0f - (float)n / step) * exp2_scalar(fmax(-fall * n * n, -100.0f));
  mean_power /= step;
  const float per_node = step * apart / unit, scale = sqrt(per_node / mean_power);
  const float place = fmin(s / frame->depth_mm, 1.0f) * (LOBE_DEPTHS - 1);
  const int depth = min((int)place, LOBE_DEPTHS - 2);
  const float deeper = place - depth;
  __global const float *row = lobes + depth * LOBE_DISTANCES;
  float weights[LOBE_NODES], power[LOBE_NODES];  // the power up to each node, on one side
  uint offsets[LOBE_NODES];                      // random bits of every distance
  int reach = 0;
  for (int n = 0; n < nodes; n++) {
    const float at = n * per_node / LOBE_STEP;
    if (at >= LOBE_DISTANCES - 1) break;
    const int column = (int)at;
    const float near = blend(row[column], row[column + 1], at - column);
    const float far = blend(row[LOBE_DISTANCES + column], row[LOBE_DISTANCES + column + 1], at - column);
    weights[n] = scale * blend(near, far, deeper);
    offsets[n] = hash_mix((uint)n * 0x9E3779B1u + 0x3C6EF372u);
    power[n] = mean_power * weights[n] * weights[n] + (n > 1 ? power[n - 1] : 0.0f);
    reach = n;
  }

  floatn node_re[LOBE_NODES], node_im[LOBE_NODES];
  int places_of[LOBE_NODES + 1], nodes_of[8 * LOBE_NODES], found = 0;  // first place of every node, node of every place
  uint bits[8 * LOBE_NODES];
  float parts[8 * LOBE_NODES];
  const float inverse_cell = 1.0f / (SIGN_CELL * unit_least);
  for (int node = 0; node < nodes; node++) {
    floatn sum_re = 0.0f, sum_im = 0.0f;
    for (int line = node * step; line < min(lines, (node + 1) * step); line++) {
      sum_re += LOAD_LANES(re + line * stride + here);
      sum_im += LOAD_LANES(im + line * stride + here);
    }
    node_re[node] = sum_re / (float)step;
    node_im[node] = sum_im / (float)step;
    const Place at = place_at(frame, roots, min(node * step + step / 2, lines - 1), depth_mm, inverse_cell);
    places_of[node] = found;
    for (int n = 0; n < at.count; n++) nodes_of[found] = node, bits[found] = at.bits[n], parts[found++] = at.parts[n];
  }
  places_of[nodes] = found;

  floatn before_re, before_im;
  float before_kept = 1.0f;
  int line = 0;
  for (int node = 0; node <= nodes; node++) {
    const int last = min(node, nodes - 1);
    floatn lobe_re, lobe_im;
    at_node(node_re, node_im, nodes_of, bits, parts, places_of, offsets, weights, last, nodes, reach, &lobe_re,
            &lobe_im);
    // Of those that there are
    const int left = min(last, reach), right = min(nodes - 1 - last, reach);
    const float kept =
        1.0f / sqrt(1.0f + power[0] + (left > 0 ? power[left] : 0.0f) + (right > 0 ? power[right] : 0.0f));
    if (node == 0) before_re = lobe_re, before_im = lobe_im, before_kept = kept;
    // Up to the middle of the lines of this node
    const int end = node == nodes ? lines : min(lines, node * step + step / 2);
    for (; line < end; line++) {
      const float part = (line + 0.5f) / step + 0.5f - node;
      // Nodes are independent: equal power between them
      const float even = node == 0 || node == nodes ? 1.0f : 1.0f / sqrt(1.0f - 2.0f * part * (1.0f - part));
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
