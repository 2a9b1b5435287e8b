// interface_echoes: adds the echoes of tissue interfaces to the scan lines (PHYSICS section 3, the paper's eq. 2).
//
// One work-item computes one scan line. Every hit is an impulse at its own time, seen by each scan line whose beam
// covers it. The lateral profile is applied in unfolded coordinates: in the probe's polar (or linear) geometry a hit of
// line m lies at y = (R + s) sin((m - n) dtheta) beside line n, wherever reflections have sent the ray. The elevational
// profile is already in the hits: their rays run at quantiles of it.
//
// Buffers: hits, hit_counts (raytracing.cl); re, im float [scan line][stride]: complex baseband impulses, to be
// convolved with the pulse.

// Standard normal cumulative distribution (logistic approximation, error < 2e-4): the share of the lateral profile
// that traced lines cover, next to the edge of the field and near the apex.
inline float share_below(float x) { return 1.0f / (1.0f + native_exp(-x * (1.5976f + 0.070566f * x * x))); }

__kernel void interface_echoes(__constant const Scene *scene, __global const Hit *hits, __global const int *hit_counts,
                               __global float *re, __global float *im, int stride) {
  int line = get_global_id(0);
  int lateral = scene->lateral_rays, rays = scene->elevational_rays;
  int traced = (scene->scan_lines - 1) * lateral + 1, me = line * lateral;
  float spacing = scene->line_spacing / lateral;
  __global float *line_re = re + line * stride + LINE_PAD, *line_im = im + line * stride + LINE_PAD;
  float widest = fmax(beam_sigma(scene, 0.0f).x, beam_sigma(scene, 4.0f * scene->depth_mm).x);

  for (int side = -1; side <= 1; side += 2)
    for (int other = side < 0 ? me : me + 1; other >= 0 && other < traced; other += side) {
      float apart = spacing * (other - me);
      float sine = scene->linear ? apart : sin(apart);
      float versine = scene->linear ? 0.0f : 2.0f * pow(sin(0.5f * apart), 2.0f);  // 1 - cos
      // Beyond this the beams of the two lines no longer overlap at any depth.
      float nearest = scene->linear ? fabs(sine) : fabs(sine) * scene->apex_radius_mm;
      if (nearest > scene->beam_cutoff * widest || fabs(apart) > (scene->linear ? 1e9f : 1.5f)) break;
      for (int ray = 0; ray < rays; ray++) {
        int slot = other * rays + ray;
        __global const Hit *ray_hits = hits + slot * MAX_HITS;
        int count = min(hit_counts[slot], MAX_HITS);
        for (int h = 0; h < count; h++) {
          float path = ray_hits[h].path_mm;
          float radius = scene->linear ? 1.0f : scene->apex_radius_mm + path;
          float sigma = beam_sigma(scene, path).x;
          float y = radius * sine;
          if (fabs(y) > scene->beam_cutoff * sigma) continue;
          float step = radius * spacing / sigma;  // between traced lines, in sigmas
          float covered = share_below((traced - 0.5f - me) * step) - share_below((-0.5f - me) * step);
          // Wide-spaced lines: each hit stands for itself.
          float weight = fmin(step * 0.39894228f / fmax(covered, 0.05f), 1.0f);
          float depth = ray_hits[h].depth_mm - radius * versine;
          float place = depth / scene->sample_mm;
          int bin = (int)floor(place);
          if (bin < 0 || bin + 1 >= scene->samples) continue;
          float amplitude = ray_hits[h].echo * weight * native_exp(-0.5f * y * y / (sigma * sigma));
          float turns = depth * scene->cycles_per_mm;
          turns -= floor(turns);
          float c = native_cos(TWO_PI * turns), s = -native_sin(TWO_PI * turns);
          float f = place - bin;
          line_re[bin] += amplitude * (1.0f - f) * c;
          line_re[bin + 1] += amplitude * f * c;
          line_im[bin] += amplitude * (1.0f - f) * s;
          line_im[bin + 1] += amplitude * f * s;
        }
      }
    }
}
