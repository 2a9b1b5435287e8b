// trace: the binary ray tree of every traced line (PHYSICS section 3).
//
// One work-item follows one ray and all its children. Global size (traced lines, 1 + elevational rays).
//   ray 0 of a line runs along the beam axis and writes the segments along which the scatter kernel works;
//   rays 1.. run at fixed quantiles of the elevational beam profile and write the interface hits, so that an interface
//   echo has the beam's elevational width. The lateral width comes from the neighbouring lines (beam.cl).
// Lines are traced at least as finely as they are scanned (lateral_rays per scan line), and a few beyond the edges.
//
// Buffers: voxels ushort [k][j][i] (medium.py); tissues Tissue [label]; quantiles float [traced line][elevational ray],
// offsets in units of the elevational sigma; segments Segment [traced line][MAX_SEGMENTS] with segment_counts;
// hits Hit [traced line][elevational ray][MAX_HITS] with hit_counts; cut float [traced line][1 + elevational ray],
// the weight of the branches that were not followed.

typedef struct {
  float3 axis;  // a point on the beam axis at path length `path`
  float3 direction;
  float3 lateral;
  float3 elevational;
  float path;
  float depth;
  float log_attenuation;  // natural logarithm, two-way amplitude
  float weight;
  float blind_until;  // path length before which no crossing counts: a reflected ray has to get off its interface
  int reflections;
  int label;
} Ray;

// The label at `voxel` (padded voxel indices): the acoustic group with the largest trilinear weight, so that borders
// are sub-voxel and without stairs, and within it the label of the nearest corner. Voting by group keeps the border of
// fluid against brain smooth wherever grey, white and other brain labels change along it.
inline int label_at(__global const ushort *voxels, __constant const Scene *scene, __constant const Tissue *tissues,
                    float3 voxel) {
  int nx = scene->dims[0], ny = scene->dims[1], nz = scene->dims[2];
  voxel = clamp(voxel, (float3)(0.0f), (float3)(nx - 1.001f, ny - 1.001f, nz - 1.001f));
  int3 base = convert_int3(voxel);
  int here = (base.z * ny + base.y) * nx + base.x;
  uint word = voxels[here];
  if (word & SAME_LABEL) return word & LABEL_MASK;
  float3 f = voxel - convert_float3(base), g = 1.0f - f;
  int labels[8], groups[8];
  float weights[8];
  for (int c = 0; c < 8; c++) {
    labels[c] = voxels[here + (c & 1) + ((c >> 1) & 1) * nx + (c >> 2) * nx * ny] & LABEL_MASK;
    groups[c] = tissues[labels[c]].group;
    weights[c] = ((c & 1) ? f.x : g.x) * ((c & 2) ? f.y : g.y) * ((c & 4) ? f.z : g.z);
  }
  // Nearly every border cell holds two groups: the first corner's and another one.
  int first = groups[0], second = first;
  float first_weight = 0.0f, second_weight = 0.0f;
  for (int c = 0; c < 8; c++) second = groups[c] != first ? groups[c] : second;
  for (int c = 0; c < 8; c++) {
    first_weight += groups[c] == first ? weights[c] : 0.0f;
    second_weight += groups[c] == second ? weights[c] : 0.0f;
  }
  int best = first_weight >= second_weight ? first : second;
  float best_weight = fmax(first_weight, second_weight);
  if (best_weight < 1.0f - first_weight - second_weight)
    for (int c = 0; c < 8; c++) {
      float total = 0.0f;
      for (int e = 0; e < 8; e++) total += groups[e] == groups[c] ? weights[e] : 0.0f;
      if (total > best_weight) {
        best_weight = total;
        best = groups[c];
      }
    }
  int label = 0;
  float nearest = -1.0f;
  for (int c = 0; c < 8; c++)
    if (groups[c] == best && weights[c] > nearest) {
      nearest = weights[c];
      label = labels[c];
    }
  return label;
}

// Unit normal (RAS) of the border between two acoustic groups near `voxel`, pointing to the side of `before`: the
// gradient of their difference smoothed by a Gaussian of BORDER_SIGMA voxels. The sum runs over voxel centres, so it is
// the exact gradient.
//
// `overshoot` is the length along the ray, in millimetres, by which `voxel` lies beyond the border. The trilinear
// border wavers by a fifth of a voxel; the smoothed difference D of the two sides knows better. A plane at distance d
// has the share Phi(d / sigma) behind it, and sigma^2 D'' / |D'| = d as well; a border of mean curvature H moves by
// sigma^2 H under smoothing, which enters the two with opposite signs. The second is noisier, hence the weights. The
// overshoot is 0 where the two borders do not agree to half a voxel (thin sheets, corners). Measured on a sphere of
// radius 20 voxels: normals within 2.9 degrees and positions within 0.145 voxel RMS (trilinear: 0.18).
#define BORDER_SIGMA 1.5f
inline float3 interface_normal(__global const ushort *voxels, __constant const Scene *scene,
                               __constant const Tissue *tissues, float3 voxel, int before, int behind, float3 direction,
                               float3 voxel_step, float *overshoot) {
  // All voxels within 3.5 of the point: a window that is not symmetric about it would shift the border.
  int3 top = (int3)(scene->dims[0], scene->dims[1], scene->dims[2]) - 1;
  float3 inside = clamp(voxel, (float3)(0.0f), convert_float3(top));
  int3 low = max(convert_int3(ceil(inside - 3.5f)), (int3)(0)), high = min(convert_int3(floor(inside + 3.5f)), top);
  float wx[8], wy[8], wz[8], dx[8];  // the Gaussian is separable
  for (int n = 0; n < 8; n++) {
    float3 d = (float3)(low.x + n, low.y + n, low.z + n) - voxel;
    const float narrow = -0.5f / (BORDER_SIGMA * BORDER_SIGMA);
    dx[n] = d.x;
    const float edge = native_exp(narrow * 3.5f * 3.5f);  // falls to zero at the window's edge: voxels fade in and out
    wx[n] = fmax(native_exp(narrow * d.x * d.x) - edge, 0.0f);
    wy[n] = fmax(native_exp(narrow * d.y * d.y) - edge, 0.0f);
    wz[n] = fmax(native_exp(narrow * d.z * d.z) - edge, 0.0f);
  }
  float row_weight = 0.0f, row_square = 0.0f;
  for (int n = 0; n <= high.x - low.x; n++) {
    row_weight += wx[n];
    row_square += wx[n] * dx[n] * dx[n];
  }
  // Moments of order 0, 1 and 2 of D = [before] - [behind], and of the window itself.
  float total = 1e-6f, total_square = 0.0f, difference = 0.0f, square = 0.0f, either = 1e-6f;
  float3 gradient = (float3)(0.0f);
  for (int k = low.z; k <= high.z; k++)
    for (int j = low.y; j <= high.y; j++) {
      float yz = wy[j - low.y] * wz[k - low.z], dy = j - voxel.y, dz = k - voxel.z, aside2 = dy * dy + dz * dz;
      __global const ushort *row = voxels + (k * (top.y + 1) + j) * (top.x + 1) + low.x;
      float sum = 0.0f, moment = 0.0f, moment2 = 0.0f, sum_either = 0.0f;
      for (int n = 0; n <= high.x - low.x; n++) {
        int group = tissues[row[n] & LABEL_MASK].group;
        float sign = (group == before) - (group == behind), weight = wx[n] * sign;
        sum += weight;
        moment += weight * dx[n];
        moment2 += weight * dx[n] * dx[n];
        sum_either += weight * sign;
      }
      gradient += yz * (float3)(moment, sum * dy, sum * dz);
      difference += yz * sum;
      square += yz * (moment2 + sum * aside2);
      either += yz * sum_either;
      total += yz * row_weight;
      total_square += yz * (row_square + row_weight * aside2);
    }
  float steepness = fmax(length(gradient), 1e-9f);
  // Logistic approximation of the inverse of Phi, near enough within half a voxel.
  float share = clamp(0.5f - 0.5f * difference / either, 0.01f, 0.99f);
  float by_share = BORDER_SIGMA / 1.702f * log(share / (1.0f - share));
  float by_bend = (square - total_square / total * difference) / steepness;
  float distance = mix(by_share, by_bend, 0.3f);
  float across = -dot(voxel_step, gradient) / steepness;  // voxels per mm of ray
  *overshoot = fabs(distance) < 0.5f && across * scene->voxel_mm > 0.2f ? distance / across : 0.0f;
  // A gradient in voxel indices becomes one in millimetres by the transposed map.
  __constant const float *m = scene->ras_to_voxel;
  float3 normal = (float3)(m[0] * gradient.x + m[4] * gradient.y + m[8] * gradient.z,
                           m[1] * gradient.x + m[5] * gradient.y + m[9] * gradient.z,
                           m[2] * gradient.x + m[6] * gradient.y + m[10] * gradient.z);
  float length_ = steepness < 1e-3f * total ? 0.0f : length(normal);
  if (length_ == 0.0f) return -direction;  // no preferred side: as if hit head-on
  normal /= length_;
  return dot(normal, direction) > 0.0f ? -normal : normal;
}

// Carry a vector perpendicular to `from` along the smallest rotation that takes `from` to `to`.
inline float3 carry(float3 v, float3 from, float3 to) { return v - dot(v, to) / (1.0f + dot(from, to)) * (from + to); }

inline float3 mirror(float3 v, float3 normal) { return v - 2.0f * dot(v, normal) * normal; }

#ifdef NO_IMPLICIT_VECTORS
__attribute__((intel_vec_len_hint(1)))
#endif
__kernel void
trace(__constant const Scene *scene, __global const ushort *voxels, __constant const Tissue *tissues,
      __global const float *quantiles, __global Segment *segments, __global int *segment_counts, __global Hit *hits,
      __global int *hit_counts, __global float *cut) {
  int line = get_global_id(0), ray_of_line = get_global_id(1);
  int rays = scene->elevational_rays;
  int on_axis = ray_of_line == 0;
  int slot = line * rays + ray_of_line - 1;
  float quantile = on_axis ? 0.0f : quantiles[slot];
  float cut_weight = 0.0f;
  __global Segment *my_segments = segments + line * MAX_SEGMENTS;
  __global Hit *my_hits = hits + max(slot, 0) * MAX_HITS;
  int count = 0;

  // The root: the beam frame of this line, taken from the probe frame to RAS.
  float position = scene->first_line + scene->line_spacing * (line - scene->guard_lines) / scene->lateral_rays;
  float3 origin, direction, across;
  if (scene->linear) {
    origin = (float3)(position, 0.0f, 0.0f);
    direction = (float3)(0.0f, 1.0f, 0.0f);
    across = (float3)(1.0f, 0.0f, 0.0f);
  } else {
    float c = cos(position), s = sin(position);
    origin = scene->apex_radius_mm * (float3)(s, c - 1.0f, 0.0f);
    direction = (float3)(s, c, 0.0f);
    across = (float3)(c, -s, 0.0f);
  }
  Ray stack[MAX_STACK];
  int waiting = 1;
  Ray root;
  root.axis = affine_point(scene->probe_to_ras, origin);
  root.direction = normalize(affine_vector(scene->probe_to_ras, direction));
  root.lateral = normalize(affine_vector(scene->probe_to_ras, across));
  root.elevational = normalize(affine_vector(scene->probe_to_ras, (float3)(0.0f, 0.0f, 1.0f)));
  root.path = 0.0f;
  root.depth = 0.0f;
  root.log_attenuation = 0.0f;
  root.weight = 1.0f;
  root.blind_until = -1.0f;
  root.reflections = 0;
  root.label = -1;  // looked up at its start
  stack[0] = root;

  while (waiting > 0) {
    Ray ray = stack[--waiting];
    int alive = 1;
    while (alive) {  // one turn per tree node: march to the next interface, branch, go on with the refracted child
      float3 voxel0 = affine_point(scene->ras_to_voxel, ray.axis);
      float3 voxel_step = affine_vector(scene->ras_to_voxel, ray.direction);
      float3 voxel_aside = affine_vector(scene->ras_to_voxel, ray.elevational) * quantile;
#define VOXEL_AT(l) (voxel0 + (l)*voxel_step + elevation_sigma(scene, ray.path + (l)) * voxel_aside)
      if (ray.label < 0) ray.label = label_at(voxels, scene, tissues, VOXEL_AT(0.0f));
      Tissue here = tissues[ray.label];
      float depth_per_mm = scene->reference_speed_m_s / here.speed_m_s;
      float to_depth = (scene->depth_mm - ray.depth) / depth_per_mm;
      float start_[3] = {voxel0.x, voxel0.y, voxel0.z}, step_[3] = {voxel_step.x, voxel_step.y, voxel_step.z};
      float margin = 3.0f + fabs(quantile) * 4.0f / scene->voxel_mm;  // the ray runs beside the axis
      float enter = 0.0f, leave = to_depth;
      for (int a = 0; a < 3; a++) {
        float inverse = 1.0f / (fabs(step_[a]) < 1e-7f ? 1e-7f : step_[a]);
        float t0 = (-margin - start_[a]) * inverse, t1 = (scene->dims[a] - 1 + margin - start_[a]) * inverse;
        enter = fmax(enter, fmin(t0, t1));
        leave = fmin(leave, fmax(t0, t1));
      }

      // March. Tissues of one speed and impedance have no interface between them; only attenuation changes there, so
      // the node goes on. `inside` is the last length known to be in this tissue, `beyond` the first one in another,
      // `since` where this tissue began. A segment starts at `open`, with `spent_open` of the attenuation exponent
      // `spent`.
      float inside = fmax(fmin(enter, to_depth), 0.0f), beyond = 0.0f, longest = 0.0f;
      float since = 0.0f, open = 0.0f, spent = 0.0f, spent_open = 0.0f;
      int other, crossing, ended = 0;
      Tissue behind;
      do {
        // Two-way amplitude: 10^(-alpha f 2 l / 20) with l in cm.
        float decay = here.attenuation * scene->frequency_mhz * 0.2f * LN10_OVER_20;
        float reserve = log(ray.weight / scene->intensity_threshold) + ray.log_attenuation - spent;
        float to_silence = since + fmax(reserve, 0.0f) / fmax(decay, 1e-9f);
        ended = to_silence < to_depth;
        longest = fmin(to_depth, to_silence);
        float last = fmin(leave, longest), stride = 0.5f * scene->voxel_mm;
        crossing = 0;
        while (inside < last) {
          float next = fmin(inside + stride, last + 1e-4f);
          other = label_at(voxels, scene, tissues, VOXEL_AT(next));
          if (other != ray.label && ray.path + next > ray.blind_until) {
            beyond = next;
            crossing = 1;
            break;
          }
          inside = next;
        }
        if (crossing)
          for (int iteration = 0; iteration < 8; iteration++) {
            float middle = 0.5f * (inside + beyond);
            int label = label_at(voxels, scene, tissues, VOXEL_AT(middle));
            if (label == ray.label)
              inside = middle;
            else {
              beyond = middle;
              other = label;
            }
          }
        float until = crossing ? beyond : longest;
        // One segment has one decay, its mean. Where that would be off by more than 0.02 neper (0.17 dB) inside, the
        // segment is closed at the last change of tissue.
        float earlier = since - open, mean_decay = earlier > 0.0f ? (spent - spent_open) / earlier : decay;
        int close = fabs(decay - mean_decay) * fmin(earlier, until - since) > 0.02f;
        float spent_until = spent + decay * (until - since);
        if (crossing) behind = tissues[other];
        int interface_here = crossing && behind.group != here.group;
        int last_piece = !crossing || interface_here;
        for (int piece = close ? 0 : 1; piece < (last_piece ? 2 : 1) && on_axis; piece++) {
          float end = piece == 0 ? since : until, spent_end = piece == 0 ? spent : spent_until;
          if (end <= open) continue;
          if (count < MAX_SEGMENTS) {
            Segment segment;
            vstore3(ray.axis + open * ray.direction, 0, segment.start);
            vstore3(ray.direction, 0, segment.direction);
            vstore3(ray.lateral, 0, segment.lateral);
            vstore3(ray.elevational, 0, segment.elevational);
            segment.path_mm = ray.path + open;
            segment.length_mm = end - open;
            segment.depth_mm = ray.depth + open * depth_per_mm;
            segment.depth_per_mm = depth_per_mm;
            segment.weight = ray.weight;
            segment.attenuation = exp(ray.log_attenuation - spent_open);
            segment.decay_per_mm = (spent_end - spent_open) / (end - open);
            segment.reflections = ray.reflections;
            segment.label = ray.label;
            my_segments[count] = segment;
          }
          count++;
          open = end;
          spent_open = spent_end;
        }
        spent = spent_until;
        since = until;
        if (last_piece) break;
        here = behind;
        ray.label = other;
        inside = beyond;
      } while (1);
      if (!crossing) {
        if (ended) cut_weight += ray.weight;
        break;
      }

      float3 voxel_hit = VOXEL_AT(beyond);
      float overshoot;
      float3 normal = interface_normal(voxels, scene, tissues, voxel_hit, here.group, behind.group, ray.direction,
                                       voxel_step, &overshoot);
      overshoot = fmin(overshoot, beyond - since);
      beyond -= overshoot;
      if (on_axis && count <= MAX_SEGMENTS && count > 0) my_segments[count - 1].length_mm -= overshoot;
      spent -= overshoot * here.attenuation * scene->frequency_mhz * 0.2f * LN10_OVER_20;
      float path = ray.path + beyond;
      float depth = ray.depth + beyond * depth_per_mm;
      float log_attenuation = ray.log_attenuation - spent;
      float attenuation = exp(log_attenuation);
      float3 aside = quantile * elevation_sigma(scene, path) * ray.elevational;
      float3 hit_point = ray.axis + beyond * ray.direction + aside;

      // Snell and the pressure reflection coefficient of a fluid interface; R = r^2 is the two-way factor.
      float cos_in = clamp(-dot(ray.direction, normal), 0.01f, 1.0f);
      float ratio = behind.speed_m_s / here.speed_m_s;
      float sin2_out = ratio * ratio * (1.0f - cos_in * cos_in);
      int total = sin2_out >= 1.0f;
      float cos_out = sqrt(fmax(0.0f, 1.0f - sin2_out));
      float z_in = here.impedance * cos_out, z_out = behind.impedance * cos_in;
      float pressure = total ? 1.0f : (z_out - z_in) / (z_out + z_in);
      float reflectance = pressure * pressure;

      if (!on_axis) {
        if (count < MAX_HITS) {
          Hit hit;
          vstore3(hit_point, 0, hit.position);
          vstore3(normal, 0, hit.normal);
          hit.path_mm = path;
          hit.depth_mm = depth;
          hit.weight = ray.weight;
          hit.attenuation = attenuation;
          hit.cos_incidence = cos_in;
          hit.reflectance = reflectance;
          hit.echo = ray.weight * attenuation * (scene->interface_is_energy ? reflectance : fabs(pressure)) *
                     pow(cos_in, scene->specular_exponent) * scene->interface_gain / rays;
          hit.reflections = ray.reflections;
          hit.label_before = ray.label;
          hit.label_behind = other;
          my_hits[count] = hit;
        }
        count++;
      }

      // The reflected child waits on the stack; weak ones and those beyond the tree's depth are cut.
      float reflected_weight = ray.weight * reflectance;
      if (ray.reflections < scene->max_ray_depth && reflected_weight >= scene->reflection_threshold &&
          reflected_weight * attenuation >= scene->intensity_threshold && waiting < MAX_STACK) {
        Ray child = ray;
        child.direction = normalize(mirror(ray.direction, normal));
        child.lateral = mirror(ray.lateral, normal);
        child.elevational = mirror(ray.elevational, normal);
        child.axis = hit_point - mirror(aside, normal);
        child.path = path;
        child.depth = depth;
        child.log_attenuation = log_attenuation;
        child.weight = reflected_weight;
        child.blind_until = path + scene->voxel_mm;
        child.reflections = ray.reflections + 1;
        stack[waiting++] = child;
      } else
        cut_weight += reflected_weight;

      // The refracted child: this ray, bent.
      float refracted_weight = ray.weight * (1.0f - reflectance);
      if (total) break;
      if (refracted_weight * attenuation < scene->intensity_threshold || depth >= scene->depth_mm) {
        cut_weight += refracted_weight;
        break;
      }
      float3 bent = normalize(ratio * ray.direction + (ratio * cos_in - cos_out) * normal);
      ray.lateral = carry(ray.lateral, ray.direction, bent);
      ray.elevational = carry(ray.elevational, ray.direction, bent);
      ray.direction = bent;
      ray.axis = hit_point - quantile * elevation_sigma(scene, path) * ray.elevational;
      ray.path = path;
      ray.depth = depth;
      ray.log_attenuation = log_attenuation;
      ray.weight = refracted_weight;
      ray.label = other;
      ray.blind_until = path + fmax(overshoot, 0.0f);  // until the trilinear border is behind, too
    }
  }
  cut[line * (rays + 1) + ray_of_line] = cut_weight;
  if (on_axis)
    segment_counts[line] = count;
  else
    hit_counts[slot] = count;
}
