// scatter: the echoes of all scatterers along all ray segments, as complex baseband impulses
// (docs/physics.md#5-scatterers).
//
// One work-item computes CHUNK samples of one traced line. It processes the segments of the line's ray tree that
// overlap these samples in time and, for each, the cells of the patient-fixed scatterer lattice beside it: laterally
// half-way to the next traced line, and as far as the beam reaches in the elevation direction. A scatterer is weighted
// by the elevational profile and distributed linearly between the two edges of its strip (buffer line 2 line: left,
// 2 line + 1: right); beam.cl then distributes it over all scan lines whose beam covers it. So each scatterer is
// computed once per image, not once per beam. Work-items write disjoint samples in a fixed order: a pose always gives
// the same bits. Global size (chunks, traced lines).
//
// Position, sign and existence of a cell's scatterer come from a hash of the cell's index and the seed. It stands for
// all scatterers that tissue has in the cell: it exists if there is any, and its amplitude is the tissue's in every
// cell, with a random sign (scattering.py). The signal is linear in that amplitude.
//
// With TEXTURE defined, scatterers depend on the MRI in addition to labels (texture.py): a scatterer takes the second
// tissue of its voxel with that tissue's probability, and its amplitude follows the intensity.
//
// With VARIED defined, the echoes are written in PARTS parts, each of which has the tissues given for it. So the image
// of a pose is a linear combination of the parts for all amplitudes of these tissues (appearance.py).
//
// With LOBES defined, the echoes are those that elevational side lobes receive, and are added to those that are there.
// Lobes have a record and a coarser lattice of their own (side_lobes.py), whose cells are wider than the strip of a
// line: one work-item computes `together` lines, along the path of the one in their middle. A scatterer is weighted by
// the diffraction pattern (diffraction.py) instead of the main beam's profile. Only pieces of the path in dark tissue
// count.
//
// With FOUND defined, planes have two words: some are of sheets that were found in the MRI (sheets.clh). Beside these
// nothing else is membrane.
//
// With UNEVEN defined, some tissues have an echogenicity that varies within them (scattering.py).
//
// Buffers: voxels, segments as in raytracing.cl; planes uint [k][j][i] of sheets.cl (one element without sheets);
// texture uint [k][j][i] (one element without TEXTURE); sites float2 [label], the share of cells with a scatterer, in
// 1/65536, and its amplitude, behind them whether it is dark (with LOBES), behind that UNEVEN_WORDS of
// imaging/scattering.py; re, im float [2 traced line + side][stride]; with VARIED also [part] before these, and part_of
// int [label], -1 for a tissue in none; with LOBES lobes float [LOBE_DEPTHS][LOBE_DISTANCES], and behind them the
// distance of the last column [LOBE_DEPTHS].

#include "common.clh"
#include "sheets.clh"

#ifdef VARIED
#define VARIED_PARAMETERS , __global const int *part_of
#define PART_OF part_of
#else
#define VARIED_PARAMETERS
#define PART_OF 0
#undef PARTS
#define PARTS 1
#endif
#ifndef CHUNK
#define CHUNK BLOCK
#endif
#define PART (CHUNK + 2)  // one extra sample at either end: echoes lie between samples
#ifdef LOBES
#define PIECE_BLOCK (4 * BLOCK)  // samples over which gains are assumed linear
#define LOBE_PARAMETERS , __global const float *lobes, int together
#define LOBE_TABLE lobes
#else
#define PIECE_BLOCK BLOCK
#define LOBE_PARAMETERS
#define LOBE_TABLE 0
#endif

#ifdef FOUND
#define PLANE_WORDS 2
#define LOOK(sheet) ((sheet).look)
#define TISSUE_OF(label) ((label) & LABEL_MASK)  // of a label by drawn_label
#define IS_ON_MEMBRANE(label) ((label) == MEMBRANE_LABEL || ((label) & ON_SHEET))
#else
#define PLANE_WORDS 1
#define LOOK(sheet) 0u
#define TISSUE_OF(label) (label)
#define IS_ON_MEMBRANE(label) ((label) == MEMBRANE_LABEL)
#endif

#define GRAINS 1024.0f      // places of a scatterer along each axis of its cell, in the middle of as many parts
#define BATCH (16 * LANES)  // cells waiting to be computed; rows are packed end to end so that every lane has work

// What scatters, see above
typedef struct {
  Frame frame;
  __global const ushort *voxels;
  __global const uint *planes, *texture;
  __global const float *sites;
  __global const int *part_of;  // with VARIED
  __global const float *lobes;  // with LOBES
} Patient;

// The strips that a work-item computes: `lines` of them from `left` on, along the path of one in the middle, whose
// displayed depths begin with `begins`.
typedef struct {
  int line, left, lines;
  float begins;
} Strips;

// Quantities common to all scatterers beside one piece of a segment. Vectors are in the order u, v, w of lattice axes.
typedef struct {
  float3 start, direction, lateral, elevational;  // of the segment
  float3 at_start, row_i, row_j, row_k;           // voxel index = at_start + rows * (offset from the segment's start)
  float low, span;                                // first path length of this piece, 1 / its length
  float narrow0, narrow1;  // elevational exponent of two per mm^2 at the near end, and its change
  float curved0, curved1;  // elevational phase in cycles per mm^2, likewise
  float gain0, gain1;      // amplitude as an exponent of two, likewise
  float line0, line1;      // 1 / distance of traced lines, likewise
  float edge;              // of the strip that begins there: distance re its width
  float bend;              // 1 / (2 radius) of the surfaces of equal range
  float depth0, slope;
  float from_mm, to_mm;    // path lengths whose scatterers belong to this piece
  float path0;             // path length from the face at the near end
  float reach_l, reach_e;  // largest lateral and elevational distance
  int u, v, w, first;
} Piece;

// Cells that wait to be computed: their u, and of the row the hash and v and w of the first place of its cells
typedef struct {
  int u[BATCH + LANES];
  uint key[BATCH + LANES];
  float v[BATCH + LANES], w[BATCH + LANES];
} Cells;

// The `count` scatterers of them which contribute, by stages of scatter_batch
typedef struct {
  int count;
  float u[BATCH], v[BATCH], w[BATCH];  // place_scatterers: from the segment's start
  uint key[BATCH];
  float part[BATCH], right[BATCH], re[BATCH], im[BATCH];  // compute_echoes: between samples and strips' edges; the echo
  float fx[BATCH], fy[BATCH], fz[BATCH];                  // place in the cell of voxels at `voxel`
  int bin[BATCH], voxel[BATCH];
  uint random[BATCH];
#ifdef LOBES
  float away[BATCH], path[BATCH];
#endif
  uchar label[BATCH];  // label_scatterers
#ifdef UNEVEN
  float uneven[BATCH];  // vary_scatterers
#endif
} Batch;

#ifdef LOBES
// Where echoes are added: the strips of `lines` traced lines from `line` on, `last` samples from `first` on.
typedef struct {
  __global float *re, *im;
  int stride, line, traced, lines, first, last;
} Echoes;
#else
typedef float4 Echoes;  // [PARTS][PART] left re, im, right re, im
#endif

// Of LANES vectors with one: (u, v, w) . along; and the line a + t slope.
inline floatn dot_lanes(floatn u, floatn v, floatn w, float3 along) {
  return fma(u, (floatn)(along.x), fma(v, (floatn)(along.y), w * along.z));
}

inline floatn line_lanes(floatn t, float a, float slope) { return fma(t, (floatn)(slope), (floatn)(a)); }

// The hash uses cell indices by lattice axis (0, 1, 2), not by u, v, w: the same scatterer from every direction.
inline uint axis_step(int axis) { return axis == 0 ? 0x9E3779B1u : axis == 1 ? 0x85EBCA77u : 0xC2B2AE3Du; }

// The depth of tables for a path length: its row, and the part by which it is deeper.
inline float row_of_depth(Frame frame, float path, int *row) {
  const float place = clamp(path / frame->depth_mm * (LOBE_DEPTHS - 1), 0.0f, LOBE_DEPTHS - 1.001f);
  *row = (int)place;
  return place - *row;
}

// By how many cycles the phase of the elevational beam, of this sigma, is behind that on its axis, per squared
// millimetre from there. With it, speckle has the height that it has at the aperture's beam (diffraction.py).
inline float elevational_cycles(Frame frame, float path, float frequency, float sigma) {
  int row;
  const float deeper = row_of_depth(frame, path, &row);
  __constant const float *heights = frame->speckle_height_mm + row;
  const float height = blend(heights[0], heights[1], deeper) / frequency;
  if (height <= 0.0f || height >= sigma) return 0.0f;
  return sqrt(1.0f / (height * height) - 1.0f / (sigma * sigma)) / (sigma * 2.0f * TWO_PI);
}

// The distance from the axis at which lobes are cut off.
inline float reach_of_lobes(Frame frame, __global const float *lobes, float path) {
  int row;
  const float deeper = row_of_depth(frame, path, &row);
  __global const float *ends = lobes + LOBE_DEPTHS * LOBE_DISTANCES + row;
  return blend(ends[0], ends[1], deeper);
}

// The square root of their power per millimetre at a distance from the axis.
inline float lobe_at(Frame frame, __global const float *lobes, float path, float distance) {
  const float at = distance / reach_of_lobes(frame, lobes, path) * (LOBE_DISTANCES - 1);
  if (at >= LOBE_DISTANCES - 1) return 0.0f;
  int row;
  const float deeper = row_of_depth(frame, path, &row);
  const int column = (int)at;
  __global const float *near = lobes + row * LOBE_DISTANCES + column, *far = near + LOBE_DISTANCES;
  return blend(blend(near[0], near[1], at - column), blend(far[0], far[1], at - column), deeper);
}

#ifdef LOBES
// Adds an echo of this amplitude to the two edges of its strip. Work-items add to disjoint samples.
inline void add_echo(Echoes *to, int part, int bin, float between, float right, float strength, float re, float im) {
  const float place = right * to->lines;
  const int strip = min((int)place, to->lines - 1);
  const float to_right = (place - strip) * strength, to_left = strength - to_right;
  const int left = 2 * (part * to->traced + to->line + strip) * to->stride + LINE_PAD + to->first + bin;
  for (int after = 0; after < 2; after++) {
    if (bin + after < 0 || bin + after >= to->last) continue;
    const float share = after ? between : 1.0f - between;
    to->re[left + after] += share * to_left * re;
    to->im[left + after] += share * to_left * im;
    to->re[left + to->stride + after] += share * to_right * re;
    to->im[left + to->stride + after] += share * to_right * im;
  }
}
#else
// Adds an echo of this amplitude to one part.
inline void add_echo(Echoes *sum, int part, int bin, float between, float right, float strength, float re, float im) {
  const float to_right = right * strength, to_left = strength - to_right;
  const float4 echo = (float4)(to_left, to_left, to_right, to_right) * (float4)(re, im, re, im);
  // Bins start at -1, so that the first and last sample of the chunk receive contributions from scatterers beyond them.
  sum[part * PART + bin + 1] += echo * (1.0f - between);
  sum[part * PART + bin + 2] += echo * between;
}
#endif

inline __global const uint *planes_at(const Patient *patient, int voxel) {
  return patient->planes + (patient->frame->sheet_label < 0 ? 0 : PLANE_WORDS * voxel);
}

// The sheet (sheets.clh) at the voxel nearest to a scatterer at fraction `at` of a cell, its plane 0 for none; and the
// offset from it
typedef struct {
  uint plane, look;  // LOOK(sheet); none without FOUND
} Sheet;

inline Sheet nearest_sheet(Frame frame, __global const uint *planes, float3 at, float3 *offset) {
  const int x = at.x > 0.5f, y = at.y > 0.5f, z = at.z > 0.5f;
  *offset = at - (float3)(x, y, z);
  __global const uint *words = planes + PLANE_WORDS * (x + frame->dims[0] * (y + frame->dims[1] * z));
  const Sheet sheet = {words[0], PLANE_WORDS == 2 ? words[1] : 0u};
  return sheet;
}

// Whether a scatterer is in a sheet, at this offset from its voxel; and the normal, of the length of a gradient
inline int is_in_sheet(Frame frame, const Piece *piece, Sheet sheet, float3 offset, float3 *normal) {
  const float3 gradient = gradient_of_sheet(sheet.plane);
  const float distance = LOOK(sheet) ? distance_of_look(LOOK(sheet)) : distance_of_sheet(sheet.plane);
  const float reach = LOOK(sheet) ? half_of_look(LOOK(sheet)) : frame->sheet_reach_mm;
  const float away = fabs(dot3(gradient, offset) - length3(gradient) * distance);
  // A gradient's length in millimetres is at most 1 / voxel_mm of that in voxels; this is seldom true.
  if (away * frame->voxel_mm >= reach) return 0;
  *normal = gradient.x * piece->row_i + gradient.y * piece->row_j + gradient.z * piece->row_k;
  return away < reach * length3(*normal);
}

// The label of a scatterer at fraction `at` of the cell of voxels at `here`, which contains a border, a sheet or the
// membrane; with ON_SHEET if it is in a sheet of the dura's own tissue. `random` are random bits of the scatterer. With
// TEXTURE, also its gain.
inline int drawn_label(const Patient *patient, const Piece *piece, int here, float3 at, uint random, float *gain) {
  Frame frame = patient->frame;
  __global const ushort *corner = patient->voxels + here;
  __global const uint *planes = planes_at(patient, here);
  const int nx = frame->dims[0], nxy = nx * frame->dims[1];
  // Partial volume without blending: the scatterer takes the label of one corner, drawn with that corner's trilinear
  // weight. The border is soft on average and fixed in the patient.
  const int dx = at.x * 32.0f > (random & 31u) + 0.5f, dy = at.y * 32.0f > ((random >> 5) & 31u) + 0.5f,
            dz = at.z * 32.0f > ((random >> 10) & 31u) + 0.5f;
  const int drawn = dx + nx * dy + nxy * dz;
  int label = corner[drawn] & LABEL_MASK;
#ifdef TEXTURE
  const uint known = patient->texture[here + drawn];
  *gain = exp_fast(LN10_OVER_20 * TEXTURE_STEP_DB * ((int)((known >> 16) & 255u) - 128));
  if ((hash_mix(random) & 255u) < ((known >> 8) & 255u)) label = known & LABEL_MASK;
#endif
  if (corner[0] & NO_MEMBRANE) return label;
  int is_membrane = 0, tissue = MEMBRANE_LABEL;
  if (frame->sheet_label >= 0) {
    float3 offset, normal;
    const Sheet sheet = nearest_sheet(frame, planes, at, &offset);
    is_membrane = sheet.plane && is_in_sheet(frame, piece, sheet, offset, &normal);
    // Voxels are thicker than the sheet.
    const uint drawn_plane = planes[PLANE_WORDS * drawn];
    if (label == frame->sheet_label && drawn_plane) label = label_beside_sheet(drawn_plane);
    if (LOOK(sheet) && !is_membrane) return label;
    if (is_dura(LOOK(sheet))) tissue = frame->dura_label | ON_SHEET;
  }
  if (!is_membrane) {
    const float near_z = blend(blend((float)(corner[0] >> 8), (float)(corner[1] >> 8), at.x),
                               blend((float)(corner[nx] >> 8), (float)(corner[nx + 1] >> 8), at.x), at.y);
    corner += nxy;
    const float far_z = blend(blend((float)(corner[0] >> 8), (float)(corner[1] >> 8), at.x),
                              blend((float)(corner[nx] >> 8), (float)(corner[nx + 1] >> 8), at.x), at.y);
    if (fabs(blend(near_z, far_z, at.z) - 127.5f) >= frame->membrane_reach) return label;
  }
  *gain = 1.0f;
  return tissue;
}

// A scatterer of the membrane is the brighter the more squarely the beam meets the sheet; one of falx and tentorium
// that were found by Lambert's law, but for a part that is the same from all sides. Its normal is that of the
// fitted plane, or the gradient of the fluid distance: from lines of two voxels along i, first those of the near plane,
// then of the far.
inline float gain_on_membrane(const Patient *patient, const Piece *piece, int here, float3 at) {
  Frame frame = patient->frame;
  __global const ushort *corner = patient->voxels + here;
  float3 normal, offset;
  float level = frame->membrane_gain, exponent = frame->membrane_exponent;
  int of_dura = 0;
  Sheet sheet = {0u, 0u};
  if (frame->sheet_label >= 0) sheet = nearest_sheet(frame, planes_at(patient, here), at, &offset);
  if (!sheet.plane || !is_in_sheet(frame, piece, sheet, offset, &normal)) {
    const int nx = frame->dims[0], nxy = nx * frame->dims[1];
    const float4 from = (float4)(corner[0] >> 8, corner[nx] >> 8, corner[nxy] >> 8, corner[nxy + nx] >> 8);
    const float4 to = (float4)(corner[1] >> 8, corner[nx + 1] >> 8, corner[nxy + 1] >> 8, corner[nxy + nx + 1] >> 8);
    const float4 lines = from + at.x * (to - from), rise = to - from;
    const float gx = blend(blend(rise.x, rise.y, at.y), blend(rise.z, rise.w, at.y), at.z);
    const float gy = blend(lines.y - lines.x, lines.w - lines.z, at.z);
    const float gz = blend(lines.z, lines.w, at.y) - blend(lines.x, lines.y, at.y);
    normal = gx * piece->row_i + gy * piece->row_j + gz * piece->row_k;
  } else {
    if (!is_wall(LOOK(sheet))) exponent = frame->sheet_exponent;
    if (LOOK(sheet)) {
      level *= level_of_look(LOOK(sheet));
      of_dura = is_dura(LOOK(sheet));
    }
  }
  const float cosine = fabs(dot3(normal, piece->direction)) / fmax(length3(normal), 1e-6f);
  if (of_dura) {
    const float isotropic = frame->dura_isotropic;
    return level * sqrt(isotropic + (1.0f - isotropic) * cosine * cosine);
  }
  return level * exp2_scalar(max(exponent * log2_scalar(fmax(cosine, 1e-6f)), -100.0f));
}

// By how much tissue varies at LANES places in the patient, as factors of amplitudes. `words` are those of the tissue
// at each place.
inline floatn unevenness(uint seed, const floatn *words, int has_specks, floatn x, floatn y, floatn z) {
  floatn level = words[2];
  // g: normal numbers at the corners of lattice cells, with trilinear weights, over the root of the weights' squares
  const floatn px = x * words[0], py = y * words[0], pz = z * words[0];
  const floatn ix = floor(px), iy = floor(py), iz = floor(pz);
  const floatn fx = px - ix, fy = py - iy, fz = pz - iz;
  const uintn key = TO_UINTN(TO_INTN(ix)) * axis_step(0) + TO_UINTN(TO_INTN(iy)) * axis_step(1) +
                    TO_UINTN(TO_INTN(iz)) * axis_step(2);
  floatn sum = 0.0f;
  for (int corner = 0; corner < 8; corner++) {
    const int dx = corner & 1, dy = (corner >> 1) & 1, dz = corner >> 2;
    const uint step = dx * axis_step(0) + dy * axis_step(1) + dz * axis_step(2);
    const floatn weight = (dx ? fx : 1.0f - fx) * (dy ? fy : 1.0f - fy) * (dz ? fz : 1.0f - fz);
    sum = fma(weight, gaussian(hash_mixn((key + step) ^ (seed + 0x68E31DA4u))), sum);
  }
  const floatn squares = fma(fx, fx, (1.0f - fx) * (1.0f - fx)) * fma(fy, fy, (1.0f - fy) * (1.0f - fy)) *
                         fma(fz, fz, (1.0f - fz) * (1.0f - fz));
  level = fma(words[1], sum / sqrt(squares), level);
  if (has_specks) {  // which fill the cell that they are in
    const floatn sx = x * words[3], sy = y * words[3], sz = z * words[3];
    const floatn jx = floor(sx), jy = floor(sy), jz = floor(sz);
    const uintn place = TO_UINTN(TO_INTN(jx)) * axis_step(0) + TO_UINTN(TO_INTN(jy)) * axis_step(1) +
                        TO_UINTN(TO_INTN(jz)) * axis_step(2);
    const floatn drawn = TO_FLOATN(hash_mixn(place ^ (seed + 0xB5297A4Du)) >> 16) + 0.5f;
    const floatn rx = sx - jx - 0.5f, ry = sy - jy - 0.5f, rz = sz - jz - 0.5f;
    const floatn near = fmax(1.0f - 4.0f * fma(rx, rx, fma(ry, ry, rz * rz)), 0.0f);
    level += drawn < words[4] ? words[5] * near : (floatn)(0.0f);
  }
  return exp2_fast(clamp(level, (floatn)(-30.0f), (floatn)(30.0f)));
}

// Where scatterers are re a piece, for LANES of them at places u, v, w from the segment's start.
typedef struct {
  floatn t, right, depth;  // part of the piece, of the strip's width, displayed depth
  floatn aside2;           // squared distance from the axis in elevation
  intn counts;             // whether it belongs to this piece and strip
#ifdef LOBES
  floatn along, away;  // length along the segment, distance from the axis in elevation
#endif
} Beside;

inline Beside beside_piece(const Piece *piece, floatn pu, floatn pv, floatn pw) {
  const floatn along = dot_lanes(pu, pv, pw, piece->direction);
  const floatn aside_l = dot_lanes(pu, pv, pw, piece->lateral);
  const floatn aside_e = dot_lanes(pu, pv, pw, piece->elevational);
  Beside at;
  at.t = (along - piece->low) * piece->span;
  at.right = fma(aside_l, line_lanes(at.t, piece->line0, piece->line1), (floatn)(piece->edge));
  at.aside2 = aside_e * aside_e;
  const floatn range = fma(aside_l, aside_l * piece->bend, along);
  at.depth = line_lanes(range, piece->depth0, piece->slope);
  at.counts = (at.right >= 0.0f) & (at.right < 1.0f) & (along >= piece->from_mm) & (along < piece->to_mm);
#ifdef LOBES
  at.along = along;
  at.away = fabs(aside_e);
#endif
  return at;
}

// Where the scatterers of cells are, and which contribute, often a quarter of them: those are put side by side.
inline void place_scatterers(Frame frame, const Piece *piece, const Cells *cells, int count, Batch *batch) {
  const float cell = frame->cell_mm, grain = cell / GRAINS, first_u = 0.5f * grain - piece->start.x;
  const float cutoff2 = 0.5f * LOG2_E * frame->beam_cutoff * frame->beam_cutoff;
  const float inverse_sample = 1.0f / frame->sample_mm;
  const int u = piece->u, v = piece->v, w = piece->w;
  const uint step_u = axis_step(u);
  ushort chosen[BATCH + 1];
  int n = 0;
  for (int begin = 0; begin < count; begin += LANES) {
    const intn cell_u = LOAD_LANES(cells->u + begin);
    const uintn key = hash_mixn((LOAD_LANES(cells->key + begin) + TO_UINTN(cell_u) * step_u) ^ frame->seed);
    // (The seed is not added to the index: seeds would then give the same scatterers, shifted by cells.)
    // Jitter is defined by lattice axis: u, v, w use the bits of the axis they represent.
    const uintn bits_u = (key >> (10 * u)) & 0x3ffu, bits_v = (key >> (10 * v)) & 0x3ffu,
                bits_w = (key >> (10 * w)) & 0x3ffu;
    const floatn pu =
        fma(TO_FLOATN(bits_u), (floatn)(grain), fma(TO_FLOATN(cell_u), (floatn)(cell), (floatn)(first_u)));
    const floatn pv = fma(TO_FLOATN(bits_v), (floatn)(grain), LOAD_LANES(cells->v + begin));
    const floatn pw = fma(TO_FLOATN(bits_w), (floatn)(grain), LOAD_LANES(cells->w + begin));
    const Beside at = beside_piece(piece, pu, pv, pw);
#ifdef LOBES
    const intn near = at.away <= piece->reach_e;
#else
    const intn near = at.aside2 * line_lanes(at.t, piece->narrow0, piece->narrow1) <= cutoff2;
#endif
    const intn bins = TO_INTN(floor(at.depth * inverse_sample)) - piece->first;
    SPREAD(int, counts_, at.counts & near & (bins >= -1) & (bins < CHUNK) & (LANE_INDEX < count - begin));
    for (int j = 0; j < LANES; j++) {
      chosen[n] = begin + j;
      n += counts_[j] & 1;
    }
    STORE_LANES(pu, batch->u + begin);
    STORE_LANES(pv, batch->v + begin);
    STORE_LANES(pw, batch->w + begin);
    STORE_LANES(key, batch->key + begin);
  }
  for (int i = 0; i < n; i++) {
    const int j = chosen[i];
    batch->u[i] = batch->u[j];
    batch->v[i] = batch->v[j];
    batch->w[i] = batch->w[j];
    batch->key[i] = batch->key[j];
  }
  batch->count = n;
}

// The echoes of scatterers of unit amplitude, where they are among samples and strips, and among voxels.
inline void compute_echoes(Frame frame, const Piece *piece, Batch *batch) {
  const int nx = frame->dims[0], ny = frame->dims[1];
  const float3 voxel_top = (float3)(nx - 1.001f, ny - 1.001f, frame->dims[2] - 1.001f);
  const float inverse_sample = 1.0f / frame->sample_mm;
  for (int begin = 0; begin < batch->count; begin += LANES) {
    const floatn pu = LOAD_LANES(batch->u + begin), pv = LOAD_LANES(batch->v + begin),
                 pw = LOAD_LANES(batch->w + begin);
    // 16 bits for its existence, one for its sign, 15 for its label
    const uintn random = hash_mixn(LOAD_LANES(batch->key + begin) + 0x3C6EF372u);
    const Beside beside = beside_piece(piece, pu, pv, pw);
#ifdef LOBES
    const floatn r2 = 0.0f, curved = 0.0f;  // lobes have random phases
    STORE_LANES(beside.away, batch->away + begin);
    STORE_LANES(piece->path0 + (beside.along - piece->low), batch->path + begin);
#else
    const floatn r2 = beside.aside2 * line_lanes(beside.t, piece->narrow0, piece->narrow1);
    const floatn curved = beside.aside2 * line_lanes(beside.t, piece->curved0, piece->curved1);
#endif
    const floatn place = beside.depth * inverse_sample;
    const floatn bin = floor(place);
    const floatn amplitude =
        exp2_fast(clamp(line_lanes(beside.t, piece->gain0, piece->gain1) - r2, (floatn)(-100.0f), (floatn)(100.0f)));
    const floatn echo = amplitude * (1.0f - TO_FLOATN((random >> 14) & 2u));
    floatn cosine, sine;
    turn(fma(beside.depth, (floatn)(frame->cycles_per_mm), curved), &cosine, &sine);
    const float3 at = piece->at_start, ri = piece->row_i, rj = piece->row_j, rk = piece->row_k;
    const floatn vx = clamp(at.x + dot_lanes(pu, pv, pw, ri), (floatn)(0.0f), (floatn)(voxel_top.x));
    const floatn vy = clamp(at.y + dot_lanes(pu, pv, pw, rj), (floatn)(0.0f), (floatn)(voxel_top.y));
    const floatn vz = clamp(at.z + dot_lanes(pu, pv, pw, rk), (floatn)(0.0f), (floatn)(voxel_top.z));
    const intn ix = TO_INTN(vx), iy = TO_INTN(vy), iz = TO_INTN(vz);
    STORE_LANES(TO_INTN(bin) - piece->first, batch->bin + begin);
    STORE_LANES(place - bin, batch->part + begin);
    STORE_LANES(beside.right, batch->right + begin);
    STORE_LANES(echo * cosine, batch->re + begin);
    STORE_LANES(echo * -sine, batch->im + begin);
    STORE_LANES(random, batch->random + begin);
    STORE_LANES((iz * ny + iy) * nx + ix, batch->voxel + begin);
    STORE_LANES(vx - TO_FLOATN(ix), batch->fx + begin);
    STORE_LANES(vy - TO_FLOATN(iy), batch->fy + begin);
    STORE_LANES(vz - TO_FLOATN(iz), batch->fz + begin);
  }
}

// The labels of scatterers, of which most are in the middle of one tissue.
inline void label_scatterers(const Patient *patient, const Piece *piece, Batch *batch) {
  ushort mixed[BATCH + 1];
  int several = 0;
  for (int i = 0; i < batch->count; i++) {
    const int word = patient->voxels[batch->voxel[i]];
    batch->label[i] = word & LABEL_MASK;
    mixed[several] = i;
#ifdef TEXTURE
    several++;  // texture also varies within tissues
#else
    several += (word & PLAIN_CELL) != PLAIN_CELL;
#endif
  }
  for (int k = 0; k < several; k++) {
    const int i = mixed[k], here = batch->voxel[i];
    float gain = 1.0f;
    const float3 at = (float3)(batch->fx[i], batch->fy[i], batch->fz[i]);
    batch->label[i] = drawn_label(patient, piece, here, at, batch->random[i], &gain);
#ifdef TEXTURE
    batch->re[i] *= gain;
    batch->im[i] *= gain;
#endif
  }
}

#ifdef UNEVEN
// The factors of their amplitudes by which tissues vary
inline void vary_scatterers(const Patient *patient, const Piece *piece, Batch *batch) {
  const int n = batch->count, u = piece->u, v = piece->v;
  for (int i = 0; i < n; i += LANES) {
    int several_tissues = 0;
    for (int lane = 0; lane < LANES; lane++) several_tissues |= batch->label[min(i + lane, n - 1)] ^ batch->label[i];
    __global const float *uneven = patient->sites + 3 * MAX_TISSUES,
                         *here = uneven + UNEVEN_WORDS * TISSUE_OF(batch->label[i]);
    floatn words[6];
    int has_specks = here[3] > 0.0f;
    if (several_tissues) {
      float words_[6][LANES];
      for (int lane = 0; lane < LANES; lane++) {
        here = uneven + UNEVEN_WORDS * TISSUE_OF(batch->label[min(i + lane, n - 1)]);
        for (int word = 0; word < 6; word++) words_[word][lane] = here[word];
        has_specks |= here[3] > 0.0f;
      }
      for (int word = 0; word < 6; word++) words[word] = LOAD_LANES(words_[word]);
    } else if (here[0] == 0.0f && !has_specks) {
      STORE_LANES((floatn)(1.0f), batch->uneven + i);
      continue;
    } else {
      for (int word = 0; word < 6; word++) words[word] = here[word];
    }
    const floatn along_u = LOAD_LANES(batch->u + i) + piece->start.x,
                 along_v = LOAD_LANES(batch->v + i) + piece->start.y,
                 along_w = LOAD_LANES(batch->w + i) + piece->start.z;
    const floatn x = u == 0 ? along_u : v == 0 ? along_v : along_w;  // along the axes of the patient
    const floatn y = u == 1 ? along_u : v == 1 ? along_v : along_w;
    const floatn z = u == 2 ? along_u : v == 2 ? along_v : along_w;
    STORE_LANES(unevenness(patient->frame->seed, words, has_specks, x, y, z), batch->uneven + i);
  }
}
#endif

// The place of a scatterer in the patient, RAS mm.
inline float3 place_of(const Piece *piece, const Batch *batch, int i) {
  const int u = piece->u, v = piece->v;
  const float along[3] = {batch->u[i] + piece->start.x, batch->v[i] + piece->start.y, batch->w[i] + piece->start.z};
  return (float3)(along[u == 0   ? 0
                        : v == 0 ? 1
                                 : 2],
                  along[u == 1   ? 0
                        : v == 1 ? 1
                                 : 2],
                  along[u == 2   ? 0
                        : v == 2 ? 1
                                 : 2]);
}

// The factor of the amplitude of a membrane's scatterers there: a log-normal one, whose mean power is 1.
inline float patch_gain(Frame frame, float3 place) {
  const float octaves = frame->membrane_octaves;
  return exp2_scalar(octaves * (patch_at(frame, place) - 0.6931472f * octaves));
}

inline void add_echoes(const Patient *patient, const Piece *piece, const Batch *batch, Echoes *sum) {
  for (int i = 0; i < batch->count; i++) {
    const int label = TISSUE_OF(batch->label[i]);
    const float2 site = vload2(label, patient->sites);
    float strength = (batch->random[i] >> 16) + 0.5f < site.x ? site.y : 0.0f;
#ifdef LOBES
    if (strength == 0.0f) continue;
    strength *= lobe_at(patient->frame, patient->lobes, batch->path[i], batch->away[i]);
#endif
    if (IS_ON_MEMBRANE(batch->label[i])) {
      const float3 at = (float3)(batch->fx[i], batch->fy[i], batch->fz[i]);
      strength *= gain_on_membrane(patient, piece, batch->voxel[i], at);
      if (patient->frame->membrane_octaves != 0.0f) strength *= patch_gain(patient->frame, place_of(piece, batch, i));
    }
#ifdef UNEVEN
    strength *= batch->uneven[i];
#endif
    int part = 0;
#ifdef VARIED
    part = patient->part_of[label];
    if (part < 0) continue;
#endif
    add_echo(sum, part, batch->bin[i], batch->part[i], batch->right[i], strength, batch->re[i], batch->im[i]);
  }
}

// The scatterers of cells in stages, each without unpredictable branches.
inline void scatter_batch(const Patient *patient, const Piece *piece, const Cells *cells, int count, Echoes *sum) {
  Batch batch;
  place_scatterers(patient->frame, piece, cells, count, &batch);
  compute_echoes(patient->frame, piece, &batch);
  label_scatterers(patient, piece, &batch);
#ifdef UNEVEN
  vary_scatterers(patient, piece, &batch);
#endif
  add_echoes(patient, piece, &batch, sum);
}

// From where to where along a piece there is dark tissue in the middle or near the edges of its strip, a step farther
// to both sides; (high, low) if there is none.
inline float2 dark_part(const Patient *patient, const Piece *piece, float low, float high) {
  Frame frame = patient->frame;
  __global const float *is_dark = patient->sites + 2 * MAX_TISSUES;
  const int nx = frame->dims[0], ny = frame->dims[1], steps = max(1, (int)ceil(high - low));
  const float3 most = (float3)(nx - 1, ny - 1, frame->dims[2] - 1);
  const float step = (high - low) / steps;
  int first = steps, last = -1;
  for (int n = 0; n < steps; n++) {
    const float along = low + (n + 0.5f) * step;
    for (int side = -1; side <= 1; side++) {
      const float3 p = along * piece->direction + (0.8f * side * piece->reach_l) * piece->lateral;
      const float3 voxel =
          piece->at_start + (float3)(dot3(p, piece->row_i), dot3(p, piece->row_j), dot3(p, piece->row_k)) + 0.5f;
      const int3 at = convert_int3(clamp(voxel, (float3)(0.0f), most));
      if (is_dark[patient->voxels[(at.z * ny + at.y) * nx + at.x] & LABEL_MASK] == 0.0f) continue;
      first = min(first, n);
      last = n;
    }
  }
  if (last < 0) return (float2)(high, low);
  return (float2)(fmax(low, low + (first - 1) * step), fmin(high, low + (last + 2) * step));
}

// The scatterers of one piece between two lengths along it: finds the lattice cells beside it and computes them in
// batches.
inline void scatter_piece(const Patient *patient, const Piece *piece, float low, float high, Echoes *sum) {
  Frame frame = patient->frame;
  Cells cells;
  const float cell = frame->cell_mm, inverse_cell = 1.0f / cell;
  const float3 start = piece->start, d = piece->direction, l = piece->lateral, e = piece->elevational;
  const float radius_l = piece->reach_l, radius_e = piece->reach_e;

  // The box of lattice cells around this piece, then rows along u clipped by the three slabs that bound it.
  const float3 near_end = start + low * d, far_end = start + high * d;
  const float3 reach = radius_l * fabs(l) + radius_e * fabs(e);
  const float3 box_low = (fmin(near_end, far_end) - reach) * inverse_cell;
  const float3 box_high = (fmax(near_end, far_end) + reach) * inverse_cell;
  const int v_low = (int)floor(box_low.y), v_high = (int)floor(box_high.y);
  const int w_low = (int)floor(box_low.z), w_high = (int)floor(box_high.z);
  // A scatterer is at most half a cell from the centre of its cell along each axis. The rest is for rounding, and for
  // axes nearly at right angles to u, whose slope along it is at least 1e-5.
  const float half_cell = 0.5f * cell, rest = 1e-3f;
  const float slack_d = half_cell * (fabs(d.x) + fabs(d.y) + fabs(d.z)) + rest;
  const float limit_l = radius_l + half_cell * (fabs(l.x) + fabs(l.y) + fabs(l.z)) + rest;
  const float limit_e = radius_e + half_cell * (fabs(e.x) + fabs(e.y) + fabs(e.z)) + rest;
  const float per_d = inverse_cell / (fabs(d.x) < 1e-5f ? 1e-5f : d.x);
  const float per_l = inverse_cell / (fabs(l.x) < 1e-5f ? 1e-5f : l.x);
  const float per_e = inverse_cell / (fabs(e.x) < 1e-5f ? 1e-5f : e.x);
  const uint step_v = axis_step(piece->v), step_w = axis_step(piece->w);

  // In the plane of v and w the piece is a band along the elevational axis; where that axis is oblique, the band
  // leaves most of the box empty. Its v at a given w, and how far it reaches on either side:
  const float along_band = fabs(e.z) < 0.02f ? 0.0f : e.y / e.z;
  const float middle = 0.5f * (low + high);
  const float band_v = start.y + middle * d.y - along_band * (start.z + middle * d.z);
  const float band_reach =
      fabs(e.z) < 0.02f ? 1e6f
                        : 0.5f * (high - low) * fabs(d.y - along_band * d.z) + radius_l * fabs(l.y - along_band * l.z);

  const float base_u = 0.5f * cell - start.x;
  // Of rows, the first place of their cells
  const float first_v = 0.5f * cell / GRAINS - start.y, first_w = 0.5f * cell / GRAINS - start.z;
  int waiting = 0;
  for (int cw = w_low; cw <= w_high; cw++) {
    const float v_here = band_v + along_band * cw * cell, v_next = v_here + along_band * cell;
    const int v_first = max(v_low, (int)floor((fmin(v_here, v_next) - band_reach) * inverse_cell));
    const int v_last = min(v_high, (int)floor((fmax(v_here, v_next) + band_reach) * inverse_cell));
    const float base_w = (cw + 0.5f) * cell - start.z;
    const float rest_d = base_u * d.x + base_w * d.z, rest_l = base_u * l.x + base_w * l.z,
                rest_e = base_u * e.x + base_w * e.z;
    for (int cv = v_first; cv <= v_last; cv += LANES) {
      const floatn base_v = (TO_FLOATN(cv + LANE_INDEX) + 0.5f) * cell - start.y;
      const floatn base_d = rest_d + base_v * d.y, base_l = rest_l + base_v * l.y, base_e = rest_e + base_v * e.y;
      const floatn d0 = (low - slack_d - base_d) * per_d, d1 = (high + slack_d - base_d) * per_d;
      const floatn l0 = (-limit_l - base_l) * per_l, l1 = (limit_l - base_l) * per_l;
      const floatn e0 = (-limit_e - base_e) * per_e, e1 = (limit_e - base_e) * per_e;
      const floatn from = max(max(min(d0, d1), min(l0, l1)), max(min(e0, e1), (floatn)(box_low.x - 1.0f)));
      const floatn to = min(min(max(d0, d1), max(l0, l1)), min(max(e0, e1), (floatn)(box_high.x + 1.0f)));
      const intn u_low = TO_INTN(ceil(from));
      SPREAD(int, u_low_, u_low);
      SPREAD(int, fill_, TO_INTN(floor(to)) - u_low + 1);
      for (int j = 0; j < min(LANES, v_last - cv + 1); j++) {
        const uint key = (uint)(cv + j) * step_v + (uint)cw * step_w;
        const float place_v = (cv + j) * cell + first_v;
        for (int cu = 0; cu < fill_[j]; cu += LANES) {
          STORE_LANES(u_low_[j] + cu + LANE_INDEX, cells.u + waiting);
          STORE_LANES((uintn)(key), cells.key + waiting);
          STORE_LANES((floatn)(place_v), cells.v + waiting);
          STORE_LANES((floatn)(cw * cell + first_w), cells.w + waiting);
          waiting += min(LANES, fill_[j] - cu);
          if (waiting >= BATCH) {
            scatter_batch(patient, piece, &cells, BATCH, sum);
            waiting -= BATCH;
            for (int i = 0; i < waiting; i++) {
              cells.u[i] = cells.u[BATCH + i];
              cells.key[i] = cells.key[BATCH + i];
              cells.v[i] = cells.v[BATCH + i];
              cells.w[i] = cells.w[BATCH + i];
            }
          }
        }
      }
    }
  }
  scatter_batch(patient, piece, &cells, waiting, sum);
}

// The axes of a segment in the order u, v, w of lattice axes: u is closest to the elevation direction, in which the
// beam is widest and whose cells fill the lanes, and v is closest to depth.
inline void set_axes(Frame frame, __global const Segment *segment, Piece *piece) {
  const float3 wide = fabs(vload3(0, segment->elevational));
  const int u = wide.x >= wide.y ? (wide.x >= wide.z ? 0 : 2) : (wide.y >= wide.z ? 1 : 2);
  const int next = u == 2 ? 0 : u + 1, after = next == 2 ? 0 : next + 1;
  const int is_deep = fabs(segment->direction[next]) >= fabs(segment->direction[after]);
  const int v = is_deep ? next : after, w = is_deep ? after : next;
  piece->start = (float3)(segment->start[u], segment->start[v], segment->start[w]);
  piece->direction = (float3)(segment->direction[u], segment->direction[v], segment->direction[w]);
  piece->lateral = (float3)(segment->lateral[u], segment->lateral[v], segment->lateral[w]);
  piece->elevational = (float3)(segment->elevational[u], segment->elevational[v], segment->elevational[w]);
  __constant const float *m = frame->ras_to_voxel;
  piece->u = u, piece->v = v, piece->w = w;
  piece->at_start = affine_point(m, (float3)(segment->start[0], segment->start[1], segment->start[2]));
  piece->row_i = (float3)(m[u], m[v], m[w]);
  piece->row_j = (float3)(m[4 + u], m[4 + v], m[4 + w]);
  piece->row_k = (float3)(m[8 + u], m[8 + v], m[8 + w]);
}

// The widths and gains of a piece of a segment between two lengths along it, linear between those at the ends.
inline void set_ends(const Patient *patient, __global const Segment *segment, const Strips *strips, float low,
                     float high, float to_apex, Piece *piece) {
  Frame frame = patient->frame;
  const float path_low = segment->path_mm + low, path_high = segment->path_mm + high;
  const float loss_low = segment->loss + segment->loss_per_mm * low;
  const float loss_high = segment->loss + segment->loss_per_mm * high;
  float band_low, band_high;
  const float frequency_low = band_after(frame, loss_low, &band_low);
  const float frequency_high = band_after(frame, loss_high, &band_high);
  const float apart_low = line_distance(frame, path_low + strips->begins);
  const float apart_high = line_distance(frame, path_high + strips->begins);
  // beam.cl knows the displayed depth alone, which differs from the path where sound is slower or faster.
  const float shown_low = fmax(piece->depth0 + piece->slope * low, strips->begins);
  const float shown_high = fmax(piece->depth0 + piece->slope * high, strips->begins);
  const float wide_low = lateral_sigma_at(frame, shown_low - strips->begins, 1.0f / frequency_low);
  const float wide_high = lateral_sigma_at(frame, shown_high - strips->begins, 1.0f / frequency_high);
  piece->low = low;
  piece->path0 = path_low;
  piece->span = 1.0f / fmax(high - low, 1e-6f);
  piece->bend = frame->linear ? 0.0f : 0.5f / fmax(to_apex + low, 1.0f);
  piece->edge = (strips->line - strips->left + 0.5f) / strips->lines;
  piece->line0 = 1.0f / (strips->lines * apart_low);
  piece->line1 = 1.0f / (strips->lines * apart_high) - piece->line0;
#ifdef LOBES
  // The table has the square root of the power per millimetre, where the main beam has 1 / (sqrt(pi) sigma_e).
  const float tall_low = 0.56418958f, tall_high = tall_low;
  piece->reach_e =
      fmax(reach_of_lobes(frame, patient->lobes, path_low), reach_of_lobes(frame, patient->lobes, path_high));
#else
  const float tall_low = elevation_sigma_at(frame, path_low, 1.0f / frequency_low);
  const float tall_high = elevation_sigma_at(frame, path_high, 1.0f / frequency_high);
  piece->reach_e = frame->beam_cutoff * fmax(tall_low, tall_high);
  piece->narrow0 = 0.5f * LOG2_E / (tall_low * tall_low);
  piece->narrow1 = 0.5f * LOG2_E / (tall_high * tall_high) - piece->narrow0;
  piece->curved0 = elevational_cycles(frame, path_low, frequency_low, tall_low);
  piece->curved1 = elevational_cycles(frame, path_high, frequency_high, tall_high) - piece->curved0;
#endif
  // Unit energy of the point spread function for all widths: sqrt(1 / (sigma_l sigma_e)) times the scale. The
  // weights of beam.cl have unit sum, that is apart / (sqrt(2 pi) sigma_l) at the peak, so that a strip of width
  // `apart` has the power apart / sigma_l of both at the displayed depth. A pulse covers 1 / slope of its length.
  const float gain = log2_scalar(segment->weight * segment->attenuation * frame->speckle_scale * 2.50662827f);
  const float decay = LOG2_E * segment->decay_per_mm;
  // Behind a curved mirror the same power is spread over a wider tube.
  const float4 tube_low = tube_after(vload4(0, segment->tube), low);
  const float4 tube_high = tube_after(vload4(0, segment->tube), high);
  piece->gain0 = gain + LOG2_E * band_low - decay * low +
                 0.5f * log2_scalar(piece->slope * wide_low /
                                    (tall_low * tube_low.x * tube_low.z * apart_low * line_distance(frame, shown_low)));
  piece->gain1 =
      gain + LOG2_E * band_high - decay * high +
      0.5f * log2_scalar(piece->slope * wide_high /
                         (tall_high * tube_high.x * tube_high.z * apart_high * line_distance(frame, shown_high))) -
      piece->gain0;
  const float lines_aside = max(strips->line - strips->left, strips->left + strips->lines - 1 - strips->line) + 0.5f;
  piece->reach_l = lines_aside * fmax(apart_low, apart_high);
}

ONE_BY_ONE
__kernel void scatter(Frame frame, __global const ushort *voxels, __global const uint *planes,
                      __global const uint *texture, __global const float *sites, __global const Segment *segments,
                      __global const int *segment_counts, __global float *re, __global float *im,
                      int stride VARIED_PARAMETERS LOBE_PARAMETERS) {
  const int chunk = get_global_id(0), first = chunk * CHUNK;
#ifdef LOBES
  const int left = get_global_id(1) * together, lines = min(together, frame->traced_lines - left);
  const int line = left + lines / 2;
  Echoes echoes = {re, im, stride, left, frame->traced_lines, lines, first, 0};
  echoes.last = min(CHUNK, frame->samples - first);
  Echoes *sum = &echoes;
#else
  const int line = get_global_id(1), left = line, lines = 1;
  Echoes sum[PARTS * PART];
  for (int i = 0; i < PARTS * PART; i++) sum[i] = (float4)(0.0f);
#endif
  const float depth_low = (first - 1) * frame->sample_mm, depth_high = (first + CHUNK) * frame->sample_mm;
  // Widths and gains are assumed linear over a block, of which CHUNK is a part, so that the image does not depend on
  // the split of the work.
  const int block = first / PIECE_BLOCK * PIECE_BLOCK;
  const float block_low = (block - 1) * frame->sample_mm;
  const float block_high = (block + PIECE_BLOCK) * frame->sample_mm;
  const Strips strips = {line, left, lines, traced_start(frame, (float)line)};
  const Patient patient = {frame, voxels, planes, texture, sites, PART_OF, LOBE_TABLE};

  int count = min(segment_counts[line], MAX_SEGMENTS);
  for (int index = 0; index < count; index++) {
    __global const Segment *segment = segments + line * MAX_SEGMENTS + index;
    Piece piece;
    piece.first = first;
    piece.slope = segment->depth_per_mm;
    piece.depth0 = segment->depth_mm;
    const float segment_low = fmax(0.0f, (block_low - piece.depth0) / piece.slope);
    const float segment_high = fmin(segment->length_mm, (block_high - piece.depth0) / piece.slope);
    const float chunk_low = (depth_low - piece.depth0) / piece.slope;
    const float chunk_high = (depth_high - piece.depth0) / piece.slope;
    if (fmax(segment_low, chunk_low) >= fmin(segment_high, chunk_high)) continue;

    set_axes(frame, segment, &piece);
    // Widths and gains are assumed linear between the two ends of a piece, so it must be short compared with the beam's
    // waist, and end at most twice as far from the apex as it begins: lines are apart in proportion to that distance.
#ifdef LOBES
    const float longest = frame->transmit_waist;
#else
    const float longest = 0.4f * fmin(frame->transmit_waist, frame->elevation_rayleigh);
#endif
    const int pieces = max(1, (int)ceil((segment_high - segment_low) / longest));
    const float to_apex = segment->path_mm + (frame->linear ? 1e6f : frame->apex_radius_mm + strips.begins);
    float high = segment_low;
    for (int n = 0; n < pieces;) {
      const float low = high, next_high = blend(segment_low, segment_high, (float)(n + 1) / pieces);
      high = fmin(next_high, low + fmax(to_apex + low, 0.2f));
      n += high >= next_high;
      piece.from_mm = low == segment_low ? 0.0f : low;
      piece.to_mm = n == pieces ? segment->length_mm : high;
      set_ends(&patient, segment, &strips, low, high, to_apex, &piece);
      // Off the axis of a curved array the same range is reached slightly earlier.
      const float early = piece.bend * piece.reach_l * piece.reach_l;
      float begin = fmax(low, chunk_low - early), end = fmin(high, chunk_high);
#ifdef LOBES
      const float2 dark = dark_part(&patient, &piece, low, high);
      begin = fmax(begin, dark.x), end = fmin(end, dark.y);
      if (dark.x > low) piece.from_mm = dark.x;
      if (dark.y < high) piece.to_mm = dark.y;
#endif
      if (begin >= end) continue;
      scatter_piece(&patient, &piece, begin, end, sum);
    }
  }
#ifndef LOBES
  for (int part = 0; part < PARTS; part++) {
    const float4 *echoes = sum + part * PART + 1;
    const int left = 2 * (part * (int)get_global_size(1) + line) * stride + LINE_PAD + first, right = left + stride;
    for (int i = 0; i < CHUNK; i++) {
      re[left + i] = echoes[i].x;
      im[left + i] = echoes[i].y;
      re[right + i] = echoes[i].z;
      im[right + i] = echoes[i].w;
    }
  }
#endif
}
