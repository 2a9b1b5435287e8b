// The echoes of tissue interfaces, added to the scan lines (docs/physics.md#3-rays; eq. 2 of the paper).
//
// Near a hit the interface is a plane of known tilt: its depth changes by `slope` per millimetre of offset, and its
// echo is an integral over the cycles of the carrier along this slope. A sum of impulses at the hits would be wrong
// wherever neighbouring hits differ by whole cycles, at which they add up again. So each hit stands for a Gaussian
// patch of the plane, about as wide as the distance to its neighbours, with the phase along it. The integral of patch
// times beam is a Gaussian of the distance to the scan line; its centre of phase is moved from the hit towards the line
// by the part `carried`, and the phase over the patch lowers it. For a plane the sum over the patches is that over the
// whole beam, whatever their number; small targets keep the width of the beam.
//
// Buffers: hits, hit_counts (raytracing.cl); centres float [elevational ray] (raytracing.py, ray_centres); planes
// float2 [PLANE_DEPTHS][PLANE_TILTS] of diffraction.py: (lateral, elevational); walls Wall
// [traced line][elevational ray * MAX_HITS] with wall_counts, and wall_reach int [traced line], the largest `reach` of
// a line's walls; re, im float [scan line][stride]: complex baseband impulses (beam.cl).

#include "common.clh"

// Echo of a plane over which a beam of standard deviation sigma has the phase k sigma, relative to a perpendicular one:
// the peak of the Gaussian exp(-(k sigma f/f0)^2 / 2) times the pulse's spectrum of relative deviation `width`. With
// increasing tilt it moves to lower frequencies. `phase2` is (k sigma)^2.
inline float plane_echo(float phase2, float width) {
  const float spread = 1.0f + phase2 * width * width;
  return exp_fast(-0.5f * phase2 / spread) / sqrt(spread);
}

// Factor of the echo of a patch. Of the squared phase over the beam (`phase2`) the sum over the patches has the part
// not `inside` them. Both parts are Gaussian. For a pulse the product of their peaks is not the peak of their product,
// which matters as long as the echo of a plane can be seen: up to 4.5 radians, -40 dB.
inline float patch_echo(float phase2, float inside2, float width) {
  const float seen = fmin(1.0f, 20.0f / fmax(phase2, 1e-6f)), seen2 = seen * phase2, seen_inside2 = seen * inside2;
  return plane_echo(inside2, width) * plane_echo(seen2, width) /
         (plane_echo(seen_inside2, width) * plane_echo(seen2 - seen_inside2, width));
}

// Squared phase inside a patch of this variance along one axis, across which the depth changes by `slope` per
// millimetre and bends by `bend` per squared millimetre. A bent patch is seen where it is square to the beam: its
// `depth` moves towards that point, and the phase within the Fresnel zone around that is smaller.
inline float bent_patch(float per_mm, float slope, float bend, float variance, float *depth) {
  const float turning = per_mm * bend * variance, zones = 1.0f + turning * turning, phase = per_mm * slope;
  *depth -= 0.5f * phase * slope * turning * variance / zones;
  return phase * phase * variance / zones;
}

// Radians from one hit to the next, laterally, and over a standard deviation of the beam, elevationally, of which a sum
// over hits is the integral, also at the upper frequencies of a pulse. Laterally no fewer: in a fan of lines a plane is
// not one against the depth, and a patch that is moved far has the slope of another line.
#define MOST_PER_STEP 3.0f
#define MOST_ASIDE 0.7f

#define MOST_MORE 4.3f  // octaves by which the echo of a plane is larger than that of a Gaussian beam

// How far a wall is a plane that bends by `turning` radians within the beam. Others are seen where they are square to
// it, and a plane there is not what is found beside that.
inline float flatness(float turning) { return 1.0f / (1.0f + 16.0f * turning * turning); }

// The part by which a patch's centre of phase is moved: `least`, and on steeper walls, where they are `flat`, so much
// that less than `most` of `phase` is left to the sum over the patches. It changes smoothly with the phase: in a fan of
// lines neighbours see a plane under other angles, and where the parts of their patches jump the sum is not the
// integral. A single hit, or one far from the next, is all of the beam: no patch is moved farther than to its middle.
inline float part_carried(float least, float phase, float most, float flat) {
  const float share = phase / most, part = fmin(least, 1.0f);
  return part + flat * (1.0f - part) * (1.0f - 1.0f / sqrt(1.0f + share * share));
}

// The echo of a plane of this tilt relative to a square one, as an exponent of two, along one `axis` of the aperture's
// table (diffraction.py); nan where there is none.
inline float plane_of_aperture(Frame frame, __global const float *planes, float path, float tilt, int axis) {
  const float deep = clamp(path * ((PLANE_DEPTHS - 1) / frame->depth_mm), 0.0f, PLANE_DEPTHS - 1.001f);
  const float place = clamp(sqrt(fabs(tilt)) * (PLANE_TILTS - 1), 0.0f, PLANE_TILTS - 1.001f);
  const int row = (int)deep, column = (int)place;
  __global const float *near = planes + 2 * (row * PLANE_TILTS + column) + axis, *far = near + 2 * PLANE_TILTS;
  const float part = place - column;
  return blend(blend(near[0], near[2], part), blend(far[0], far[2], part), deep - row);
}

// One work-item computes the walls of one traced line.
__kernel void find_walls(Frame frame, __global const Hit *hits, __global const int *hit_counts,
                         __global const float *centres, __global const float *planes, __global Wall *walls,
                         __global int *wall_counts, __global int *wall_reach) {
  const int line = get_global_id(0), rays = frame->elevational_rays;
  const float pulse = frame->fractional_bandwidth * 0.42466090f;  // 1 / (2 sqrt(2 ln 2))
  const float per_mm = TWO_PI * frame->cycles_per_mm;
  const float start = traced_start(frame, (float)line), cosine = traced_cosine(frame, (float)line);
  __global Wall *my_walls = walls + line * rays * MAX_HITS;
  int walls_found = 0;
  float farthest = 0.0f;
  for (int ray = 0; ray < rays; ray++) {
    const int slot = line * rays + ray, count = min(hit_counts[slot], MAX_HITS);
    for (int h = 0; h < count; h++) {
      __global const Hit *hit = hits + slot * MAX_HITS + h;
      const float2 sigma =
          (float2)(lateral_sigma(frame, hit->path_mm, 1.0f, cosine), elevation_sigma(frame, hit->path_mm));
      // Near the apex of a phased array all lines are within the beam, and every second, fourth ... is enough.
      float step = line_distance(frame, hit->path_mm + start);
      int every = 1;
      for (; 8.0f * step < sigma.x && every < 64; every *= 2) step *= 2.0f;
      if (line % every) continue;
      const float stretch = fmin(1.0f + hit->lateral_slope * hit->lateral_slope, 10.0f);
      const float bend = hit->curvature * stretch * sqrt(stretch), sigma2 = sigma.x * sigma.x;
      const float across = per_mm * hit->lateral_slope, aside = per_mm * hit->elevational_slope;
      const float phase_l = across * across * sigma2, phase_e = aside * aside * sigma.y * sigma.y;
      const float phase2 = phase_l + phase_e;
      // A patch has a deviation of 0.45 steps: aliases of planes are then below -35 dB at one frequency. The beam times
      // the patch would be wider than the beam; this width gives a row of hits, each a strip one step wide, the beam's.
      const float width2 = sigma2 + step * step / 12.0f;
      const float flat = flatness(per_mm * bend * sigma2), flat_aside = flatness(per_mm * bend * sigma.y * sigma.y);
      const float carried = part_carried(0.2025f * step * step / width2, across * step, MOST_PER_STEP, flat);
      const float inside = fmax(1.0f - (1.0f - carried) * (1.0f - carried) * width2 / sigma2, 0.0f);
      // The strata of the elevational rays are 2.5 / rays deviations wide in the middle and 7 / rays outside.
      const float carried_aside = part_carried(10.0f / (rays * rays), aside * sigma.y, MOST_ASIDE, flat_aside);
      const float inside_aside = 1.0f - (1.0f - carried_aside) * (1.0f - carried_aside);
      // Where flat, from the centre of the ray's stratum: rays are shifted in it from line to line, and the sum over
      // shifted ones differs from the integral, the more so in steep walls.
      const float centre = hit->elevational_mm + flat_aside * (centres[ray] * sigma.y - hit->elevational_mm);
      Wall wall;
      wall.echo = hit->echo * exp_fast(gain_of_band(frame, hit->loss));
      wall.depth_mm = hit->depth_mm - hit->elevational_slope * (hit->elevational_mm - (1.0f - carried_aside) * centre);
      // In a fan of lines a plane is bent: the depth along it grows to both sides.
      const float apart = line_distance(frame, hit->path_mm);
      const float fan = (2.0f * stretch - 1.0f) * (line_distance(frame, hit->path_mm + 1.0f) / apart - 1.0f);
      const float inside2 =
          bent_patch(per_mm, hit->lateral_slope, bend + fan, inside * sigma2, &wall.depth_mm) +
          bent_patch(per_mm, hit->elevational_slope, bend, inside_aside * sigma.y * sigma.y, &wall.depth_mm);
      // Of a bent patch only the Fresnel zone contributes. The mean curvature does not show its direction; laterally,
      // where patches are wide, this is within 2 dB of theory for spheres and for cylinders along and across the plane.
      const float zones = per_mm * bend * inside * sigma2;
      wall.echo /= sqrt(sqrt(1.0f + zones * zones));
      // What planes echo is a matter of the edges of the apertures, which the beam's Gaussian does not have.
      const float gauss = plane_echo(flat * phase_l + flat_aside * phase_e, pulse);
      const float of_aperture = flat * plane_of_aperture(frame, planes, hit->path_mm, hit->lateral_slope / cosine, 0) +
                                flat_aside * plane_of_aperture(frame, planes, hit->path_mm, hit->elevational_slope, 1) -
                                log2_scalar(gauss);
      // More than this would raise what the sum over the patches of a steep wall leaves, which no wall echoes.
      const float more = of_aperture == of_aperture ? clamp(of_aperture, -60.0f, MOST_MORE) : 0.0f;
      const float share = patch_echo(phase2, inside2, pulse) * exp2_scalar(more);
      if (share < 1e-4f) continue;
      const float lines = step / sqrt(width2), per_line = lines / every;
      wall.depth_per_line = carried * hit->lateral_slope * step / every;
      wall.echo *= share * 0.39894228f * lines;  // 1 / sqrt(2 pi): unit sum over the lines
      wall.fall = -0.5f * LOG2_E * per_line * per_line;
      // Walls are far brighter than speckle: cut off as early as that they would visibly end.
      wall.reach = 1.35f * frame->beam_cutoff / per_line;
      farthest = fmax(farthest, wall.reach);
      my_walls[walls_found++] = wall;
    }
  }
  wall_counts[line] = walls_found;
  wall_reach[line] = (int)fmin(farthest, 1e6f);
}

// One work-item computes the samples of one slice of one scan line; global size (slices, scan lines).
__kernel void interface_echoes(Frame frame, __global const Wall *walls, __global const int *wall_counts,
                               __global const int *wall_reach, __global float *re, __global float *im, int stride) {
  const int slice = get_global_id(0), slices = get_global_size(0), line = get_global_id(1);
  const int first = slice * frame->samples / slices, last = (slice + 1) * frame->samples / slices;
  const int centre = frame->guard_lines + line * frame->lateral_rays;
  const int most = frame->elevational_rays * MAX_HITS;
  __global float *my_re = re + line * stride + LINE_PAD, *my_im = im + line * stride + LINE_PAD;
  for (int from = 0; from < frame->traced_lines; from++) {
    const int away = centre - from;
    if (abs(away) > wall_reach[from]) continue;
    __global const Wall *its_walls = walls + from * most;
    const int count = wall_counts[from];
    for (int w = 0; w < count; w++) {
      if (fabs((float)away) > its_walls[w].reach) continue;
      const float depth = its_walls[w].depth_mm + away * its_walls[w].depth_per_line;
      const float place = depth / frame->sample_mm;
      const int bin = (int)floor(place);
      if (bin < first - 1 || bin >= last || bin < 0 || bin + 1 >= frame->samples) continue;
      const float part = place - bin;
      const float echo = its_walls[w].echo * exp2_scalar(fmax(its_walls[w].fall * away * away, -100.0f));
      float c, s;
      turn(depth * frame->cycles_per_mm, &c, &s);
      c *= echo, s *= -echo;
      if (bin >= first) {
        my_re[bin] += c * (1.0f - part);
        my_im[bin] += s * (1.0f - part);
      }
      if (bin + 1 < last) {
        my_re[bin + 1] += c * part;
        my_im[bin + 1] += s * part;
      }
    }
  }
}
