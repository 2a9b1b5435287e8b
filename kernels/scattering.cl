// scatter: every scatterer within the beam of every ray segment, as complex baseband impulses (PHYSICS section 4).
//
// One work-item owns CHUNK samples of one scan line: it visits the segments of the line's ray tree whose times meet
// those samples and, for each, the cells of the patient-fixed scatterer lattice inside the beam. Work-items write
// disjoint samples in a fixed order, so a pose gives the same bits every time. Global size (chunks, scan lines).
//
// A cell's scatterer has its place, T0 and T1 from a hash of the cell's index and the seed. Its amplitude is
//   mu0 (E - p) + sigma0 T0 E,  E = [T1 >= mu1],  p = P(E):
// zero mean, variance p (1 - p) mu0^2 + p sigma0^2, linear in mu0 and sigma0. The mean p mu0 of the field is taken out
// because a uniform medium does not echo; on a fine lattice the pulse would cancel it, a jittered one would not.
//
// Buffers: voxels, tissues, segments as in raytracing.cl; re, im float [scan line][stride].

__kernel void scatter(__constant const Scene *scene, __global const ushort *voxels, __global const Tissue *tissues,
                      __global const Segment *segments, __global const int *segment_counts, __global float *re,
                      __global float *im, int stride) {
  int chunk = get_global_id(0), line = get_global_id(1);
  int first = chunk * CHUNK;
  float sum_re[CHUNK], sum_im[CHUNK];
  for (int i = 0; i < CHUNK; i++) sum_re[i] = sum_im[i] = 0.0f;

  const float cell = scene->cell_mm, inverse_cell = 1.0f / cell;
  const float inverse_sample = 1.0f / scene->sample_mm;
  const float depth_low = (first - 1) * scene->sample_mm, depth_high = (first + CHUNK) * scene->sample_mm;
  const float cutoff2 = 0.5f * LOG2_E * scene->beam_cutoff * scene->beam_cutoff;
  const int nx = scene->dims[0], ny = scene->dims[1], nz = scene->dims[2];
  const float3 voxel_top = (float3)(nx - 1.001f, ny - 1.001f, nz - 1.001f);

  int count = min(segment_counts[line], MAX_SEGMENTS);
  for (int index = 0; index < count; index++) {
    __global const Segment *segment = segments + line * MAX_SEGMENTS + index;
    float slope = segment->depth_per_mm, depth0 = segment->depth_mm;
    float low = fmax(0.0f, (depth_low - depth0) / slope);
    float high = fmin(segment->length_mm, (depth_high - depth0) / slope);
    if (low >= high) continue;

    // Lattice axes in an order that puts the beam's longer width along u, where the lanes run.
    float2 sigma_low = beam_sigma(scene, segment->path_mm + low), sigma_high = beam_sigma(scene, segment->path_mm + high);
    float radius_l = scene->beam_cutoff * fmax(sigma_low.x, sigma_high.x);
    float radius_e = scene->beam_cutoff * fmax(sigma_low.y, sigma_high.y);
    float wide[3];
    for (int a = 0; a < 3; a++) wide[a] = fabs(radius_e > radius_l ? segment->elevational[a] : segment->lateral[a]);
    int u = wide[0] >= wide[1] ? (wide[0] >= wide[2] ? 0 : 2) : (wide[1] >= wide[2] ? 1 : 2);
    int v = u == 2 ? 0 : u + 1, w = v == 2 ? 0 : v + 1;
    const float3 d = (float3)(segment->direction[u], segment->direction[v], segment->direction[w]);
    const float3 l = (float3)(segment->lateral[u], segment->lateral[v], segment->lateral[w]);
    const float3 e = (float3)(segment->elevational[u], segment->elevational[v], segment->elevational[w]);
    const float3 start = (float3)(segment->start[u], segment->start[v], segment->start[w]);

    // Voxel index = at_start + rows * (offset from start).
    const float3 ras0 = (float3)(segment->start[0], segment->start[1], segment->start[2]);
    const float3 at_start = affine_point(scene->ras_to_voxel, ras0);
    __constant const float *m = scene->ras_to_voxel;
    const float3 row_i = (float3)(m[u], m[v], m[w]), row_j = (float3)(m[4 + u], m[4 + v], m[4 + w]);
    const float3 row_k = (float3)(m[8 + u], m[8 + v], m[8 + w]);

    // Widths and gains vary slowly: linear between the two ends of the chunk, in the exponent of two.
    const float span = 1.0f / fmax(high - low, 1e-6f);
    const float narrow_l0 = 0.5f * LOG2_E / (sigma_low.x * sigma_low.x);
    const float narrow_l1 = 0.5f * LOG2_E / (sigma_high.x * sigma_high.x) - narrow_l0;
    const float narrow_e0 = 0.5f * LOG2_E / (sigma_low.y * sigma_low.y);
    const float narrow_e1 = 0.5f * LOG2_E / (sigma_high.y * sigma_high.y) - narrow_e0;
    const float gain = segment->weight * segment->attenuation * scene->speckle_scale;
    const float gain0 = log2(gain) - LOG2_E * segment->decay_per_mm * low - 0.5f * log2(sigma_low.x * sigma_low.y);
    const float gain1 =
        log2(gain) - LOG2_E * segment->decay_per_mm * high - 0.5f * log2(sigma_high.x * sigma_high.y) - gain0;

    // Box of lattice cells around this piece of the beam, then rows along u clipped by the beam's three slabs.
    const float3 near_end = start + low * d, far_end = start + high * d;
    const float3 reach = radius_l * fabs(l) + radius_e * fabs(e);
    const float3 box_low = (fmin(near_end, far_end) - reach) * inverse_cell;
    const float3 box_high = (fmax(near_end, far_end) + reach) * inverse_cell;
    const int v_low = (int)floor(box_low.y), v_high = (int)floor(box_high.y);
    const int w_low = (int)floor(box_low.z), w_high = (int)floor(box_high.z);
    // A scatterer is at most half a cell from its cell's centre along each axis.
    const float slack_d = 0.5f * cell * (fabs(d.x) + fabs(d.y) + fabs(d.z));
    const float limit_l = radius_l + 0.5f * cell * (fabs(l.x) + fabs(l.y) + fabs(l.z));
    const float limit_e = radius_e + 0.5f * cell * (fabs(e.x) + fabs(e.y) + fabs(e.z));
    const float per_d = inverse_cell / (fabs(d.x) < 1e-5f ? 1e-5f : d.x);
    const float per_l = inverse_cell / (fabs(l.x) < 1e-5f ? 1e-5f : l.x);
    const float per_e = inverse_cell / (fabs(e.x) < 1e-5f ? 1e-5f : e.x);

    for (int cw = w_low; cw <= w_high; cw++)
      for (int cv = v_low; cv <= v_high; cv++) {
        const float3 base = (float3)(0.5f * cell, (cv + 0.5f) * cell, (cw + 0.5f) * cell) - start;
        const float base_d = dot(base, d), base_l = dot(base, l), base_e = dot(base, e);
        const float d0 = (low - slack_d - base_d) * per_d, d1 = (high + slack_d - base_d) * per_d;
        const float l0 = (-limit_l - base_l) * per_l, l1 = (limit_l - base_l) * per_l;
        const float e0 = (-limit_e - base_e) * per_e, e1 = (limit_e - base_e) * per_e;
        const float from = fmax(fmax(fmin(d0, d1), fmin(l0, l1)), fmax(fmin(e0, e1), box_low.x - 1.0f));
        const float to = fmin(fmin(fmax(d0, d1), fmax(l0, l1)), fmin(fmax(e0, e1), box_high.x + 1.0f));
        if (from > to) continue;
        const int u_low = (int)ceil(from), u_high = (int)floor(to);
        // The hash counts cells by lattice axis, not by u, v, w: the same scatterer from every direction.
        const uint step_u = u == 0 ? 0x9E3779B1u : u == 1 ? 0x85EBCA77u : 0xC2B2AE3Du;
        const uint step_v = v == 0 ? 0x9E3779B1u : v == 1 ? 0x85EBCA77u : 0xC2B2AE3Du;
        const uint step_w = w == 0 ? 0x9E3779B1u : w == 1 ? 0x85EBCA77u : 0xC2B2AE3Du;
        const uint row = scene->seed + (uint)cv * step_v + (uint)cw * step_w;

        for (int cu = u_low; cu <= u_high; cu += LANES) {
          const intn cells = cu + LANE_INDEX;
          const uintn key = hash_mixn(row + TO_UINTN(cells) * step_u);
          const uintn key1 = hash_mixn(key + 0x9E3779B9u), key2 = hash_mixn(key + 0x3C6EF372u);
          // Jitter belongs to the lattice axes too: u, v, w take the bits of the axis they stand for.
          const uintn bits_x = key & 0x3ffu, bits_y = (key >> 10) & 0x3ffu, bits_z = (key >> 20) & 0x3ffu;
          const uintn bits_u = u == 0 ? bits_x : u == 1 ? bits_y : bits_z;
          const uintn bits_v = v == 0 ? bits_x : v == 1 ? bits_y : bits_z;
          const uintn bits_w = w == 0 ? bits_x : w == 1 ? bits_y : bits_z;
          const float grain = cell / 1024.0f;
          const floatn pu = (TO_FLOATN(cells) * cell - start.x) + (TO_FLOATN(bits_u) + 0.5f) * grain;
          const floatn pv = (cv * cell - start.y) + (TO_FLOATN(bits_v) + 0.5f) * grain;
          const floatn pw = (cw * cell - start.z) + (TO_FLOATN(bits_w) + 0.5f) * grain;
          const floatn along = pu * d.x + pv * d.y + pw * d.z;
          const floatn aside_l = pu * l.x + pv * l.y + pw * l.z;
          const floatn aside_e = pu * e.x + pv * e.y + pw * e.z;
          const floatn t = (along - low) * span;
          const floatn r2 =
              aside_l * aside_l * (narrow_l0 + t * narrow_l1) + aside_e * aside_e * (narrow_e0 + t * narrow_e1);
          const floatn depth = depth0 + along * slope;
          const floatn place = depth * inverse_sample;
          const floatn bin = floor(place);
          const floatn amplitude = exp2_fast(clamp(gain0 + t * gain1 - r2, -100.0f, 100.0f));
          floatn cosine, sine;
          turn(depth * scene->cycles_per_mm, &cosine, &sine);
          const floatn t0 = gaussian(key1);
          const floatn vx = clamp(at_start.x + pu * row_i.x + pv * row_i.y + pw * row_i.z, 0.0f, voxel_top.x);
          const floatn vy = clamp(at_start.y + pu * row_j.x + pv * row_j.y + pw * row_j.z, 0.0f, voxel_top.y);
          const floatn vz = clamp(at_start.z + pu * row_k.x + pv * row_k.y + pw * row_k.z, 0.0f, voxel_top.z);
          const intn ix = TO_INTN(vx), iy = TO_INTN(vy), iz = TO_INTN(vz);

          SPREAD(float, r2_, r2);
          SPREAD(float, along_, along);
          SPREAD(int, bin_, TO_INTN(bin) - first);
          SPREAD(float, part_, place - bin);
          SPREAD(float, re_, amplitude * cosine);
          SPREAD(float, im_, amplitude * sine);
          SPREAD(float, t0_, t0);
          SPREAD(uint, random_, key2);
          SPREAD(int, voxel_, (iz * ny + iy) * nx + ix);
          SPREAD(float, fx_, vx - TO_FLOATN(ix));
          SPREAD(float, fy_, vy - TO_FLOATN(iy));
          SPREAD(float, fz_, vz - TO_FLOATN(iz));

          const int lanes = min(LANES, u_high - cu + 1);
          for (int j = 0; j < lanes; j++) {
            const int b = bin_[j];
            if (r2_[j] > cutoff2 || b < -1 || b >= CHUNK || along_[j] < 0.0f || along_[j] >= segment->length_mm) continue;
            const uint random = random_[j];
            const uint word = voxels[voxel_[j]];
            int label = word & LABEL_MASK;
            if (!(word & UNIFORM_CELL)) {
              const float fx = fx_[j], fy = fy_[j], fz = fz_[j];
              // Partial volume without blending: the scatterer takes the label of one corner, drawn with that
              // corner's trilinear weight from bits of its own. The border is soft on average and fixed in the patient.
              const int dx = fx * 32.0f > (random & 31u) + 0.5f, dy = fy * 32.0f > ((random >> 5) & 31u) + 0.5f,
                        dz = fz * 32.0f > ((random >> 10) & 31u) + 0.5f;
              __global const ushort *corner = voxels + voxel_[j];
              label = corner[dx + nx * (dy + ny * dz)] & LABEL_MASK;
              if (scene->membrane_reach >= 0.0f) {
                const float near_z = mix(mix((float)(corner[0] >> 8), (float)(corner[1] >> 8), fx),
                                         mix((float)(corner[nx] >> 8), (float)(corner[nx + 1] >> 8), fx), fy);
                corner += nx * ny;
                const float far_z = mix(mix((float)(corner[0] >> 8), (float)(corner[1] >> 8), fx),
                                        mix((float)(corner[nx] >> 8), (float)(corner[nx + 1] >> 8), fx), fy);
                if (fabs(mix(near_z, far_z, fz) - 127.5f) < scene->membrane_reach) label = MEMBRANE_LABEL;
              }
            }
            const float share = tissues[label].share;
            const int exists = (random >> 16) + 0.5f < share * 65536.0f;
            const float strength =
                tissues[label].mu0 * (exists - share) + (exists ? tissues[label].sigma0 * t0_[j] : 0.0f);
            const float part = part_[j], a = strength * re_[j], c = -strength * im_[j];
            if (b >= 0) {
              sum_re[b] += a * (1.0f - part);
              sum_im[b] += c * (1.0f - part);
            }
            if (b + 1 < CHUNK) {
              sum_re[b + 1] += a * part;
              sum_im[b + 1] += c * part;
            }
          }
        }
      }
  }
  __global float *out_re = re + line * stride + LINE_PAD + first, *out_im = im + line * stride + LINE_PAD + first;
  for (int i = 0; i < CHUNK; i++) {
    out_re[i] = sum_re[i];
    out_im[i] = sum_im[i];
  }
}
