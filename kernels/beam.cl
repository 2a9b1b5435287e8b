// lateral_beam: the lateral part of the point spread function, from traced lines to scan lines
// (docs/physics.md#4-beam-and-pulse).
//
// One work-item computes LANES samples of one scan line; global size (samples / LANES, scan lines). In the unfolded
// geometry of the array two lines are y = (R + s) dtheta apart at path length s (or a fixed distance for a linear
// array), independent of refraction and reflection. Each part of the beam therefore follows its own path, and the edge
// of a shadow is as blurred as the beam is wide. The weights are a Gaussian of unit sum. scattering.cl has distributed
// scatterers between the two edges of a strip, with a mean variance of step^2 / 6; the variance of this Gaussian is
// reduced by that.
//
// The phase of the beam is curved across it (lateral_curvature), so that the weights are complex. Linear interpolation
// between edges lowers their power the more they turn from edge to edge; `kept` is the remaining part.
//
// Where tissue has disturbed the phases of the aperture, the beam is wider (aperture.cl), of the same power of speckle:
// the level has what it loses. Its phase then turns as much over its width as before.
//
// Each edge lies between two strips, of which both have echoes there. Scan lines read the sum of the two (join_edges),
// since every edge is read by all scan lines whose beam covers it.
//
// Buffers: from_re, from_im float [2 traced line + side][stride]; edge_re, edge_im float [edge][stride]: the edge
// before each traced line, without that before the first; spreads float2 [screen line][depth]; losses as in
// downshift.cl; to_re, to_im float [scan line][stride].

#include "common.clh"

// Writes the width of the beam of a traced line at path lengths `s` and the factor of its echoes, both relative
// to an undisturbed one, linear between the screens.
inline void find_spread(Frame frame, __global const float *spreads, int traced, floatn s, floatn *width,
                        floatn *factor) {
  *width = *factor = (floatn)(1.0f);
  if (!frame->aperture_beams) return;
  const int depths = frame->screen_depths;
  const float line = (float)traced * (frame->screen_lines - 1) / (frame->traced_lines - 1);
  const int left = min((int)line, frame->screen_lines - 2);
  const floatn far = s / frame->screen_step - 1.0f;
  SPREAD(float, far_, far);
  const int near = clamp((int)far_[0], 0, depths - 2);  // for all lanes, which are much closer than screens
  const floatn t = clamp(far - (float)near, (floatn)(0.0f), (floatn)(1.0f));
  const float4 a = vload4(0, spreads + 2 * (left * depths + near));
  const float4 b = vload4(0, spreads + 2 * ((left + 1) * depths + near));
  const float4 found = a + (line - left) * (b - a);  // width and factor at one depth and at the next
  *width = found.x + t * (found.z - found.x);
  *factor = found.y + t * (found.w - found.y);
}

// One work-item adds up LANES samples of one edge. Global size (samples / LANES, traced lines - 1).
__kernel void join_edges(__global const float *from_re, __global const float *from_im, __global float *edge_re,
                         __global float *edge_im, int stride) {
  const int edge = get_global_id(1) + 1, here = LINE_PAD + get_global_id(0) * LANES;
  const int before = (2 * edge - 1) * stride + here, behind = before + stride, to = edge * stride + here;
  STORE_LANES(LOAD_LANES(from_re + before) + LOAD_LANES(from_re + behind), edge_re + to);
  STORE_LANES(LOAD_LANES(from_im + before) + LOAD_LANES(from_im + behind), edge_im + to);
}

__kernel void lateral_beam(Frame frame, __global const float *edge_re, __global const float *edge_im,
                           __global const float *spreads, __global const float *losses, __global float *to_re,
                           __global float *to_im, int stride) {
  int sample = get_global_id(0) * LANES, line = get_global_id(1);
  int centre = frame->guard_lines + line * frame->lateral_rays;
  // One width per lane: near a tight focus the width changes from sample to sample.
  const float start = line_start(frame, (float)line), cosine = line_cosine(frame, (float)line);
  const floatn s = fmax((TO_FLOATN(LANE_INDEX) + sample) * frame->sample_mm - start, (floatn)(0.0f));
  floatn spread, factor;
  find_spread(frame, spreads, centre, s, &spread, &factor);
  __global const float *of_line = losses + LOSS_WORDS * line * (frame->samples / LOSS_STEP + 1);
  const floatn stretch = 1.0f / frequency_at(of_line, sample);
  const floatn apart = line_distance_lanes(frame, s + start);
  const floatn sigma = spread * lateral_sigma_lanes(frame, s, stretch, cosine);
  floatn step = apart / sigma;  // between traced lines, in sigmas
  floatn step2 = step * step;
  floatn narrow2 = fmax(1.0f - step2 / 6.0f, 0.25f);  // (sigma of these weights / sigma of the beam)^2
  const floatn apart2 = step2 / narrow2;              // squared distance of traced lines in sigmas of these weights
  const floatn reach = ceil(frame->beam_cutoff * sigma / apart);
  const int last = min((int)largest(reach), max(centre, frame->traced_lines - 1 - centre));
  // Up to here both edges of a pair are there, for all lanes.
  const int whole = min((int)smallest(reach), min(centre - 1, frame->traced_lines - 2 - centre));
  // By how much the phase turns at one step from the axis; at the middle between stored frequencies.
  const int node = sample / LOSS_STEP;
  const float middle = fmax((node + 0.5f) * LOSS_STEP * frame->sample_mm - start, 0.0f);
  __global const float *stored = of_line + LOSS_WORDS * node + 2;
  const float frequency = 0.5f * (stored[0] + stored[LOSS_WORDS]);
  SPREAD(float, spread_, spread);
  const float across = line_distance(frame, middle + start);
  const float curved = spread_curvature(frame, middle, 1.0f / frequency, cosine, spread_[0]) * across * across;
  const float turns = curved / (2.0f * TWO_PI);
  // Edge `edge` is half a step before traced line `edge`. Edges come in pairs, n + 1/2 lines to either side. Their
  // weights w are a Gaussian by recurrence: w(n + 1) = w(n) ratio(n).
  const floatn fall = exp2_fast(max(-LOG2_E * apart2, -60.0f)),
               first_weight = exp2_fast(max(-0.125f * LOG2_E * apart2, -60.0f));
  floatn weight = first_weight, ratio = fall;
  int here = LINE_PAD + sample;
  floatn sum_re = 0.0f, sum_im = 0.0f;
  for (int first = 0; first <= last; first += LANES) {
    const floatn beside = TO_FLOATN(first + LANE_INDEX) + 0.5f;
    floatn cosine, sine;
    turn(turns * beside * beside, &cosine, &sine);
    SPREAD(float, cosine_, cosine);
    SPREAD(float, sine_, sine);
    for (int n = first; n <= min(first + LANES - 1, last); n++) {
      floatn pair_re = 0.0f, pair_im = 0.0f;
      const int edges[2] = {centre - n, centre + n + 1};
      for (int side = 0; side < 2; side++) {
        if (n > whole && (edges[side] < 1 || edges[side] >= frame->traced_lines)) continue;
        pair_re += LOAD_LANES(edge_re + edges[side] * stride + here);
        pair_im += LOAD_LANES(edge_im + edges[side] * stride + here);
      }
      if (n > whole) weight = (float)n <= reach ? weight : (floatn)(0.0f);
      const floatn along = weight * cosine_[n - first], across = weight * sine_[n - first];
      sum_re = fma(along, pair_re, fma(across, pair_im, sum_re));
      sum_im = fma(along, pair_im, fma(-across, pair_re, sum_im));
      weight *= ratio;
      ratio *= fall;
    }
  }
  const floatn straight = first_weight * first_weight;
  const floatn bent = exp2_fast(max(-0.25f * LOG2_E * (apart2 + curved * curved / apart2), -60.0f));
  // 1 / sqrt(2 pi), with 1 / sqrt(kept) for kept = (2 + bent) / (2 + straight)
  const floatn scale = 0.39894228f * factor * sqrt(apart2 * spread * (2.0f + straight) / (2.0f + bent));
  STORE_LANES(sum_re * scale, to_re + line * stride + here);
  STORE_LANES(sum_im * scale, to_im + line * stride + here);
}
