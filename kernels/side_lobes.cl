// side_lobes: what the lateral side lobes of the beam add to every scan line
// (docs/physics.md#side-lobes-and-ring-down).
//
// One work-item computes LANES samples of one scan line; global size (samples / LANES, scan lines). The lobes are one
// broad Gaussian about the line. They are summed over scan lines, which have the main beam already, two of its
// sigmas apart, and in quadrature to it: the lobes of an aperture have alternating signs, so that on average they
// do not interfere with the main beam.
//
// Buffers: from_re, from_im, to_re, to_im float [scan line][stride].

#include "common.clh"

// `wide` is the sigma of the lobes re that of the one-way receive beam, `power` theirs re that of the main beam.
__kernel void side_lobes(__constant const Acquisition *acquisition, __global const float *from_re,
                         __global const float *from_im, __global float *to_re, __global float *to_im, int stride,
                         float wide, float power) {
  const int sample = get_global_id(0) * LANES, line = get_global_id(1), here = LINE_PAD + sample;
  const float depth = (sample / LOSS_STEP * LOSS_STEP + 0.5f * LOSS_STEP) * acquisition->sample_mm;  // for all LANES
  const float s = fmax(depth - line_start(acquisition, (float)line), 0.0f);
  const float apart = line_distance(acquisition, s) * acquisition->lateral_rays;
  const float main_beam = lateral_sigma(acquisition, s);
  const float sigma = wide * fmax(acquisition->receive_sigma_min, acquisition->receive_sigma_slope * s);
  // Scan lines already have the width of the main beam.
  const float rest = sqrt(fmax(sigma * sigma - main_beam * main_beam, 0.25f * sigma * sigma));
  const int step = max(1, (int)(2.0f * main_beam / apart));
  const float exponent = -0.5f * LOG2_E * (step * apart / rest) * (step * apart / rest);
  const int reach = (int)ceil(acquisition->beam_cutoff * rest / (step * apart));
  const int last = acquisition->scan_lines - 1;
  floatn sum_re = 0.0f, sum_im = 0.0f;
  float whole = 0.0f;
  for (int n = -reach; n <= reach; n++) {
    const float weight = exp2_scalar(max(exponent * n * n, -100.0f));
    const int other = line + n * step;
    whole += weight;
    if (other < 0 || other > last) continue;  // beyond the image nothing is known
    sum_re += weight * LOAD_LANES(from_re + other * stride + here);
    sum_im += weight * LOAD_LANES(from_im + other * stride + here);
  }
  // The energy of a Gaussian of unit area is inversely proportional to its width. Of a beam with a curved phase less is
  // left by the sum.
  const float bent = lateral_curvature(acquisition, s, 1.0f) * main_beam * main_beam;
  const float kept = rsqrt(sqrt(1.0f + bent * bent));
  const float scale = sqrt(power * sqrt(main_beam * main_beam + rest * rest) / main_beam) / (kept * whole);
  const int at = line * stride + here;
  STORE_LANES(LOAD_LANES(from_re + at) - scale * sum_im, to_re + at);
  STORE_LANES(LOAD_LANES(from_im + at) + scale * sum_re, to_im + at);
}
