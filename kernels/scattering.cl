// scatter: the echoes of all scatterers along all ray segments, as complex baseband impulses
// (docs/physics.md#5-scatterers).
//
// One work-item computes CHUNK samples of one traced line. It processes the segments of the line's ray tree that
// overlap these samples in time and, for each, the cells of the patient-fixed scatterer lattice beside it: laterally
// half-way to the next traced line, and as far as the beam reaches in the elevation direction. A scatterer is weighted
// by the elevational profile (a table, lens_at) and distributed linearly between the two edges of its strip (buffer
// line 2 line: left, 2 line + 1: right); beam.cl then distributes it over all scan lines whose beam covers it. So each
// scatterer is computed once per image, not once per beam. Work-items write disjoint samples in a fixed order: a pose
// always gives the same bits. Global size (chunks, traced lines).
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
// line: one work-item computes `together` lines, along the path of the one in their middle. The table has what
// the main beam leaves out. Only pieces of the path in dark tissue count.
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
// int [label], -1 for a tissue in none; beam float2 [LOBE_DEPTHS][LENS_DISTANCES] of probe/lens.py, behind it float
// [LOBE_DEPTHS] where it ends, and the largest of these, that of the last column.

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
#define LOBE_PARAMETERS , int together
#else
#define PIECE_BLOCK BLOCK
#define LOBE_PARAMETERS
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

#define GRAINS 1024.0f  // places of a scatterer along each axis of its cell, in the middle of as many parts
// Where strips and segments meet, a scatterer passes from one to the other over twice this part of the strip's width,
// or length: one that only one of them has would vanish, or count twice, with the least movement of the probe.
#define SHARED 0.015625f
#define SHARED_MM 0.01f
#define MOST_MOVED 1.3f     // cycles: depth_moved, with LEAST_PART and MOST_CYCLES of strips.cl
#define MOST_DARK 40        // places along a piece at which tissue is looked at for lobes
#define BATCH (16 * LANES)  // cells waiting to be computed; rows are packed end to end so that every lane has work

// What scatters, see above
typedef struct {
  Frame frame;
  __global const ushort *voxels;
  __global const uint *planes, *texture;
  __global const float *sites;
  __global const float *beam;
  __global const int *part_of;  // with VARIED
} Patient;

// The strips that a work-item computes: `lines` of them from `left` on, along the path of one in the middle, whose
// displayed depths begin with `begins`, and for which the face is foreshortened by `cosine`.
typedef struct {
  int line, left, lines;
  float begins, cosine;
} Strips;

// Quantities common to all scatterers beside one piece of a segment. Vectors are in the order u, v, w of lattice axes.
typedef struct {
  float3 start, direction, lateral, elevational;  // of the segment
  float3 at_origin, row_i, row_j, row_k;          // voxel index = at_origin + rows * place
  float low, span;                                // first path length of this piece, 1 / its length
  float tall0, tall1;      // distances of the beam's table per elevational mm at the near end, and their change
  float turned0, turned1;  // factor of its phase, likewise
  float gain0, gain1;      // amplitude as an exponent of two, likewise
  float bend;              // 1 / (2 radius) of the surfaces of equal range
  float middle0, middle1;  // of the strip on the segment's lateral axis, and its change per mm of length
  float half0, half1;      // half the strip's width with what it shares, likewise
  float4 later;  // displayed depth per mm of lateral offset: to the left, its change; to the right, its change
  float depth0, slope;
  float from_mm, to_mm;    // ranges whose scatterers belong to this piece
  float moved;             // by how many mm these depths change at most
  float path0;             // path length from the face at the near end
  float reach_l, reach_e;  // largest lateral and elevational distance
  int u, v, w, first;
#ifdef LOBES
  float dark[MOST_DARK + 1], dark_step;  // how dark tissue is from `low` on, at intervals in mm
  int dark_steps;                        // of these in the piece
#endif
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
  float u[BATCH], v[BATCH], w[BATCH];  // place_scatterers: from the segment's start; compute_echoes: in the patient
  uint key[BATCH];
  float part[BATCH], right[BATCH], re[BATCH], im[BATCH];  // compute_echoes: between samples and strips' edges; the echo
  float fx[BATCH], fy[BATCH], fz[BATCH];                  // place in the cell of voxels at `voxel`
  int bin[BATCH], voxel[BATCH];
  uint random[BATCH];
#ifdef LOBES
  float beyond[BATCH];  // range from the start of the piece on
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

// The table of the beam (probe/lens.py) at LANES path lengths, and places among its distances from the axis: square
// root of the power per millimetre, and by how many cycles the phase is behind that on the axis.
inline void lens_at(Frame frame, __global const float *beam, floatn path, floatn place, floatn *root, floatn *cycles) {
  const floatn row =
      clamp(path * ((LOBE_DEPTHS - 1) / frame->depth_mm), (floatn)(0.0f), (floatn)(LOBE_DEPTHS - 1.001f));
  const floatn column = fmin(place, (floatn)(LENS_DISTANCES - 1.001f));
  const intn rows = TO_INTN(row), columns = TO_INTN(column);
  SPREAD(int, at_, rows *LENS_DISTANCES + columns);
  SPREAD(float, deeper_, row - TO_FLOATN(rows));
  float near_root[LANES], far_root[LANES], near_cycles[LANES], far_cycles[LANES];
  for (int lane = 0; lane < LANES; lane++) {
    const float4 above = vload4(0, beam + 2 * at_[lane]), below = vload4(0, beam + 2 * (at_[lane] + LENS_DISTANCES));
    const float4 here = above + deeper_[lane] * (below - above);
    near_root[lane] = here.x, near_cycles[lane] = here.y, far_root[lane] = here.z, far_cycles[lane] = here.w;
  }
  const floatn farther = column - TO_FLOATN(columns), root0 = LOAD_LANES(near_root), cycles0 = LOAD_LANES(near_cycles);
  *root = fma(farther, LOAD_LANES(far_root) - root0, root0);
  *cycles = fma(farther, LOAD_LANES(far_cycles) - cycles0, cycles0);
}

// The distance from the axis at which the table ends, at no depth around this one nearer.
inline float reach_of_lens(Frame frame, __global const float *beam, float path) {
  int row;
  row_of_depth(frame, path, &row);
  __global const float *ends = beam + 2 * LOBE_DEPTHS * LENS_DISTANCES + row;
  return fmax(ends[0], ends[1]);
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
  return (Sheet){words[0], PLANE_WORDS == 2 ? words[1] : 0u};
}

// Whether a scatterer is in a sheet, at this offset from its voxel; and the normal, of the length of a gradient
inline int is_in_sheet(Frame frame, const Piece *piece, Sheet sheet, float3 offset, float3 *normal) {
  const float3 gradient = gradient_of_sheet(sheet.plane);
  const float distance = LOOK(sheet) ? distance_of_look(LOOK(sheet)) : distance_of_sheet(sheet.plane);
  const float reach = LOOK(sheet) ? half_of_look(LOOK(sheet)) : frame->sheet_reach_mm;
  const float away = fabs(dot3(gradient, offset) - length3(gradient) * distance);
  // A gradient's length in millimetres is at most 1 / voxel_mm of its length in voxels; this is rarely true.
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
// that were found by Lambert's law, except for a part that is the same from all sides. Its normal comes from the
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

// By how much tissue varies at LANES places in the patient, as factors of amplitudes. `words` of the tissue
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

// Positions of LANES scatterers relative to a piece, at places u, v, w from the segment's start.
typedef struct {
  floatn t, along, aside;  // part of the piece, length along the segment, distance from its axis in the image plane
  floatn right, ends;      // distance from the strip's middle, at which it ends
  floatn range, depth;     // length along the segment at which it is seen, displayed depth
  floatn away;             // distance from the axis in elevation
} Beside;

inline Beside beside_piece(const Piece *piece, floatn pu, floatn pv, floatn pw) {
  const floatn aside_e = dot_lanes(pu, pv, pw, piece->elevational);
  Beside at;
  at.along = dot_lanes(pu, pv, pw, piece->direction);
  at.aside = dot_lanes(pu, pv, pw, piece->lateral);
  at.t = (at.along - piece->low) * piece->span;
  at.right = at.aside - line_lanes(at.along, piece->middle0, piece->middle1);
  at.ends = line_lanes(at.along, piece->half0, piece->half1);
  at.range = fma(at.aside * at.aside, (floatn)(piece->bend), at.along);
  at.depth = line_lanes(at.range, piece->depth0, piece->slope);
  at.away = fabs(aside_e);
  return at;
}

// 0 up to -1/2, 1 from 1/2 on
inline floatn rise_lanes(floatn x) { return clamp(x + 0.5f, (floatn)(0.0f), (floatn)(1.0f)); }

// The part of scatterers that belongs to a piece of the strip, where they are `right` of its middle in widths: with
// those of its neighbours the sum is one.
inline floatn share_of(const Piece *piece, floatn range, floatn right) {
  const float per_mm = 0.5f / SHARED_MM, per_width = 0.5f / SHARED;
  return (rise_lanes((range - piece->from_mm) * per_mm) - rise_lanes((range - piece->to_mm) * per_mm)) *
         rise_lanes(per_width * (0.5f - fabs(right)));
}

// Where the scatterers of cells are, and which contribute, often a quarter of them: those are put side by side.
inline void place_scatterers(Frame frame, const Piece *piece, const Cells *cells, int count, Batch *batch) {
  const float cell = frame->cell_mm, grain = cell / GRAINS, first_u = 0.5f * grain - piece->start.x;
  // The ranges of which something is seen in these samples, and of which a part belongs to this piece
  const float before = (piece->first - 1) * frame->sample_mm - piece->moved - piece->depth0;
  const float behind = (piece->first + CHUNK) * frame->sample_mm + piece->moved - piece->depth0;
  const float nearest = fmax(piece->from_mm - SHARED_MM, before / piece->slope);
  const float farthest = fmin(piece->to_mm + SHARED_MM, behind / piece->slope);
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
    const intn near = at.away <= piece->reach_e;
    const intn counts = (fabs(at.right) < at.ends) & (at.range > nearest) & (at.range < farthest) & near;
    SPREAD(int, counts_, counts &(LANE_INDEX < count - begin));
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
inline void compute_echoes(const Patient *patient, const Piece *piece, Batch *batch) {
  Frame frame = patient->frame;
  const int nx = frame->dims[0], ny = frame->dims[1];
  const float3 voxel_top = (float3)(nx - 1.001f, ny - 1.001f, frame->dims[2] - 1.001f);
  const float inverse_sample = 1.0f / frame->sample_mm;
  const float grain = frame->cell_mm / GRAINS, inverse_grain = 1.0f / grain, first = 0.5f * grain;
  for (int begin = 0; begin < batch->count; begin += LANES) {
    const floatn pu = LOAD_LANES(batch->u + begin), pv = LOAD_LANES(batch->v + begin),
                 pw = LOAD_LANES(batch->w + begin);
    // 16 bits for its existence, one for its sign, 15 for its label
    const uintn random = hash_mixn(LOAD_LANES(batch->key + begin) + 0x3C6EF372u);
    const Beside beside = beside_piece(piece, pu, pv, pw);
    floatn root, curved, depth = beside.depth;
    lens_at(frame, patient->beam, piece->path0 + (beside.along - piece->low),
            beside.away * line_lanes(beside.t, piece->tall0, piece->tall1), &root, &curved);
#ifdef LOBES
    STORE_LANES(beside.range - piece->low, batch->beyond + begin);
#else
    if (piece->moved > 0.0f) {
      const floatn along = beside.along, aside = beside.aside;
      depth = fma(min(aside, (floatn)(0.0f)), line_lanes(along, piece->later.x, piece->later.y), depth);
      depth = fma(max(aside, (floatn)(0.0f)), line_lanes(along, piece->later.z, piece->later.w), depth);
    }
#endif
    const floatn place = depth * inverse_sample, right = (0.5f + SHARED) * beside.right / beside.ends;
    const floatn bin = floor(place);
    const intn bins = TO_INTN(bin) - piece->first;
    const floatn gain = clamp(line_lanes(beside.t, piece->gain0, piece->gain1), (floatn)(-100.0f), (floatn)(100.0f));
    const floatn amplitude = ((bins >= -1) & (bins < CHUNK)) ? root * exp2_fast(gain) : (floatn)(0.0f);
    const floatn share = share_of(piece, beside.range, right);
    const floatn echo = share * amplitude * (1.0f - TO_FLOATN((random >> 14) & 2u));
    floatn cosine, sine;
    turn(fma(depth, (floatn)(frame->cycles_per_mm), curved * line_lanes(beside.t, piece->turned0, piece->turned1)),
         &cosine, &sine);
    // Places in the patient are the same, to the bit, from every pose, and so are tissues.
    const floatn u = fma(floor((pu + piece->start.x) * inverse_grain), (floatn)(grain), (floatn)(first));
    const floatn v = fma(floor((pv + piece->start.y) * inverse_grain), (floatn)(grain), (floatn)(first));
    const floatn w = fma(floor((pw + piece->start.z) * inverse_grain), (floatn)(grain), (floatn)(first));
    const float3 at = piece->at_origin, ri = piece->row_i, rj = piece->row_j, rk = piece->row_k;
    const floatn vx = clamp(at.x + dot_lanes(u, v, w, ri), (floatn)(0.0f), (floatn)(voxel_top.x));
    const floatn vy = clamp(at.y + dot_lanes(u, v, w, rj), (floatn)(0.0f), (floatn)(voxel_top.y));
    const floatn vz = clamp(at.z + dot_lanes(u, v, w, rk), (floatn)(0.0f), (floatn)(voxel_top.z));
    const intn ix = TO_INTN(vx), iy = TO_INTN(vy), iz = TO_INTN(vz);
    STORE_LANES(u, batch->u + begin);
    STORE_LANES(v, batch->v + begin);
    STORE_LANES(w, batch->w + begin);
    STORE_LANES(clamp(bins, -1, CHUNK - 1), batch->bin + begin);
    STORE_LANES(place - bin, batch->part + begin);
    STORE_LANES(right + 0.5f, batch->right + begin);
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
    const floatn along_u = LOAD_LANES(batch->u + i), along_v = LOAD_LANES(batch->v + i),
                 along_w = LOAD_LANES(batch->w + i);
    const floatn x = u == 0 ? along_u : v == 0 ? along_v : along_w;  // along the axes of the patient
    const floatn y = u == 1 ? along_u : v == 1 ? along_v : along_w;
    const floatn z = u == 2 ? along_u : v == 2 ? along_v : along_w;
    STORE_LANES(unevenness(patient->frame->seed, words, has_specks, x, y, z), batch->uneven + i);
  }
}
#endif

// The place of a scatterer in the patient, RAS mm.
inline float3 place_of(const Piece *piece, const Batch *batch, int i) {
  float place[3];
  place[piece->u] = batch->u[i], place[piece->v] = batch->v[i], place[piece->w] = batch->w[i];
  return vload3(0, place);
}

// The factor of the amplitude of a membrane's scatterers there: a log-normal one, whose mean power is 1.
inline float patch_gain(Frame frame, float3 place) {
  const float octaves = frame->membrane_octaves;
  return exp2_scalar(octaves * (patch_at(frame, place) - 0.6931472f * octaves));
}

#ifdef LOBES
// How dark tissue is at a place, from 0 to 1: trilinear.
inline float darkness(const Patient *patient, const Piece *piece, float3 place) {
  Frame frame = patient->frame;
  __global const float *is_dark = patient->sites + 2 * MAX_TISSUES;
  const int nx = frame->dims[0], ny = frame->dims[1];
  const float3 voxel =
      piece->at_origin + (float3)(dot3(place, piece->row_i), dot3(place, piece->row_j), dot3(place, piece->row_k));
  const float3 inside = clamp(voxel, (float3)(0.0f), (float3)(nx - 1.001f, ny - 1.001f, frame->dims[2] - 1.001f));
  const int3 base = convert_int3(inside);
  const float3 part = inside - convert_float3(base);
  const int here = patient->voxels[(base.z * ny + base.y) * nx + base.x];
  if (here & SAME_LABEL) return is_dark[here & LABEL_MASK];
  float sum = 0.0f;
  for (int corner = 0; corner < 8; corner++) {
    const int dx = corner & 1, dy = (corner >> 1) & 1, dz = corner >> 2;
    const float weight = (dx ? part.x : 1.0f - part.x) * (dy ? part.y : 1.0f - part.y) * (dz ? part.z : 1.0f - part.z);
    const int label = patient->voxels[((base.z + dz) * ny + base.y + dy) * nx + base.x + dx] & LABEL_MASK;
    sum += weight * is_dark[label];
  }
  return sum;
}

// Finds how dark tissue is along a piece, at most a step away: in the middle or near the edges of its strip. From where
// to where it is; (high, low) if it is nowhere.
inline float2 find_dark(const Patient *patient, Piece *piece, float low, float high) {
  const int steps = min(max(1, (int)ceil(high - low)), MOST_DARK - 1);
  float here[MOST_DARK];
  int first = steps + 1, last = -1;
  piece->dark_steps = steps;
  piece->dark_step = fmax((high - low) / steps, 1e-6f);
  for (int n = 0; n <= steps; n++) {
    here[n] = 0.0f;
    for (int side = -1; side <= 1; side++) {
      const float3 along = (low + n * piece->dark_step) * piece->direction;
      const float3 place = piece->start + along + (0.8f * side * piece->reach_l) * piece->lateral;
      here[n] = fmax(here[n], darkness(patient, piece, place));
    }
    if (here[n] > 0.0f) first = min(first, n), last = n;
  }
  for (int n = 0; n <= steps; n++) piece->dark[n] = fmax(here[n], fmax(here[max(n - 1, 0)], here[min(n + 1, steps)]));
  piece->dark[steps + 1] = piece->dark[steps];
  if (last < 0) return (float2)(high, low);
  return (float2)(fmax(low, low + (first - 2) * piece->dark_step), fmin(high, low + (last + 2) * piece->dark_step));
}

// How dark tissue is at a length beyond the piece's start
inline float dark_at(const Piece *piece, float length) {
  const float place = clamp(length / piece->dark_step, 0.0f, (float)piece->dark_steps);
  const int n = (int)place;
  return blend(piece->dark[n], piece->dark[n + 1], place - n);
}
#endif

inline void add_echoes(const Patient *patient, const Piece *piece, const Batch *batch, Echoes *sum) {
  for (int i = 0; i < batch->count; i++) {
    const int label = TISSUE_OF(batch->label[i]);
    const float2 site = vload2(label, patient->sites);
    float strength = (batch->random[i] >> 16) + 0.5f < site.x ? site.y : 0.0f;
#ifdef LOBES
    if (strength == 0.0f) continue;
    strength *= dark_at(piece, batch->beyond[i]);
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
  compute_echoes(patient, piece, &batch);
  label_scatterers(patient, piece, &batch);
#ifdef UNEVEN
  vary_scatterers(patient, piece, &batch);
#endif
  add_echoes(patient, piece, &batch, sum);
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
        const float place_v = fma((float)(cv + j), cell, first_v);
        for (int cu = 0; cu < fill_[j]; cu += LANES) {
          STORE_LANES(u_low_[j] + cu + LANE_INDEX, cells.u + waiting);
          STORE_LANES((uintn)(key), cells.key + waiting);
          STORE_LANES((floatn)(place_v), cells.v + waiting);
          STORE_LANES((floatn)(fma((float)cw, cell, first_w)), cells.w + waiting);
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
  piece->at_origin = (float3)(m[3], m[7], m[11]);
  piece->row_i = (float3)(m[u], m[v], m[w]);
  piece->row_j = (float3)(m[4 + u], m[4 + v], m[4 + w]);
  piece->row_k = (float3)(m[8 + u], m[8 + v], m[8 + w]);
}

// By how much displayed depths in the strip of a segment differ from those on its axis, at most.
inline float depth_moved(__global const Segment *segment) {
  const float4 left = vload4(0, segment->left), right = vload4(0, segment->right);
  const float length = segment->length_mm;
  const float2 from = (float2)(left.x, right.x), later = (float2)(left.z, right.z);
  const float2 to = from + length * (float2)(left.y, right.y), later_to = later + length * (float2)(left.w, right.w);
  // A product of two linear functions is among its ends and the point that its tangents there have in common.
  const float2 most = fmax(fmax(fabs(from * later), fabs(to * later_to)), 0.5f * fabs(from * later_to + to * later));
  return (1.0f + 2.0f * SHARED) * fmax(most.x, most.y);
}

// The factor by which curved mirrors lower the power of speckle at a path length: the integral of what is transmitted
// times what is received, relative to that behind plane ones.
inline float mirrored_power(Frame frame, float path, float4 tube, float cosine) {
  if (tube.x == 1.0f && tube.z == 1.0f) return 1.0f;
  const float per_mm2 = 0.5f * TWO_PI * frame->cycles_per_mm;
  const float receive = fmax(path * frame->receive_sigma_slope, frame->receive_sigma_min) / cosine;
  const float receive2 = receive * receive, transmit2 = transmit_variance(frame, path, 1.0f, cosine);
  float waist2 = transmit2, away = 0.0f, length = per_mm2 * transmit2, least = 1e30f;  // of compounded waves
  for (int zone = 0; zone < frame->transmit_zones; zone++) {
    const float a = path - frame->transmit_focus[zone], rayleigh = frame->transmit_rayleigh[zone] / (cosine * cosine);
    const float sigma = frame->transmit_sigma[zone] / cosine, b = sigma * sqrt(1.0f + a * a / (rayleigh * rayleigh));
    if (b < least) least = b, waist2 = sigma * sigma, away = a, length = rayleigh;
  }
  const float mirrored2 = waist2 * mirrored_beam(away, length, tube.x, tube.y) +
                          receive2 * mirrored_beam(0.0f, per_mm2 * receive2, tube.x, tube.y);
  const float from_lens = path - frame->elevation_focus, b = from_lens / frame->elevation_rayleigh;
  return sqrt((transmit2 + receive2) / mirrored2 * (1.0f + b * b) /
              mirrored_beam(from_lens, frame->elevation_rayleigh, tube.z, tube.w));
}

// Of a piece of a segment at one of its ends, linear between them: see Piece
typedef struct {
  float tall, turned, gain, reach_e;
} End;

// At a length along the segment, where the strip is `width` wide.
inline End end_at(const Patient *patient, __global const Segment *segment, const Strips *strips, const Piece *piece,
                  float along, float width) {
  Frame frame = patient->frame;
  const float path = segment->path_mm + along;
  float band;
  const float frequency = band_after(frame, segment->loss + segment->loss_per_mm * along, &band);
  // beam.cl knows the displayed depth alone, which differs from the path where sound is slower or faster.
  const float shown = fmax(piece->depth0 + piece->slope * along, strips->begins);
  const float wide = lateral_sigma(frame, shown - strips->begins, 1.0f / frequency, strips->cosine);
  const float apart = fmax(width / strips->lines, 1e-4f) * line_distance(frame, shown);
  const float stretch = elevation_stretch(frame, path, 1.0f / frequency);
  const float widest = patient->beam[2 * LOBE_DEPTHS * LENS_DISTANCES + LOBE_DEPTHS];  // distance of the last column
  const float left = mirrored_power(frame, path, tube_after(vload4(0, segment->tube), along), strips->cosine);
  // Unit energy of the point spread function for all widths: sqrt(1 / (sigma_l sigma_e)) times the scale. The
  // weights of beam.cl have unit sum, that is apart / (sqrt(2 pi) sigma_l) at the peak, so that a strip of width
  // `apart` has the power apart / sigma_l of both at the displayed depth. A pulse covers 1 / slope of its length.
  const float gain = log2_scalar(segment->weight * segment->attenuation * frame->speckle_scale * 2.50662827f);
  // The table has the square root of the power per millimetre, where a Gaussian beam has 1 / (sqrt(pi) sigma_e).
  const float power = piece->slope * wide * left / (0.56418958f * stretch * apart);
  return (End){(LENS_DISTANCES - 1) / (widest * stretch), frame->wavefront_curvature == 0.0f ? 0.0f : frequency,
               gain + LOG2_E * (band - segment->decay_per_mm * along) + 0.5f * log2_scalar(power),
               stretch * reach_of_lens(frame, patient->beam, path)};
}

// The widths and gains of a piece of a segment between two lengths along it.
inline void set_ends(const Patient *patient, __global const Segment *segment, const Strips *strips, float low,
                     float high, float to_apex, Piece *piece) {
  Frame frame = patient->frame;
  piece->low = low;
  piece->path0 = segment->path_mm + low;
  piece->span = 1.0f / fmax(high - low, 1e-6f);
  piece->bend = frame->linear ? 0.0f : 0.5f / fmax(to_apex + low, 1.0f);
#ifdef LOBES
  const float step = frame->line_spacing / frame->lateral_rays, before = strips->line - strips->left + 0.5f;
  const float2 nominal = frame->linear ? (float2)(step, 0.0f) : (float2)(step * to_apex, step);
  const float2 left_border = -before * nominal, right_border = (strips->lines - before) * nominal;
#else
  const float4 to_left = vload4(0, segment->left), to_right = vload4(0, segment->right);
  const float2 left_border = to_left.xy, right_border = to_right.xy;
  piece->later = (float4)(to_left.zw, to_right.zw);
#endif
  const float2 middle = 0.5f * (left_border + right_border), across = right_border - left_border;
  piece->middle0 = middle.x, piece->middle1 = middle.y;
  piece->half0 = (0.5f + SHARED) * across.x, piece->half1 = (0.5f + SHARED) * across.y;
  const float2 ends = (float2)(low, high), width = across.x + across.y * ends;
  const float2 reach = fabs(middle.x + middle.y * ends) + (0.5f + SHARED) * width;
  const End near = end_at(patient, segment, strips, piece, low, width.x);
  const End far = end_at(patient, segment, strips, piece, high, width.y);
  piece->reach_l = fmax(reach.x, reach.y), piece->reach_e = fmax(near.reach_e, far.reach_e);
  piece->tall0 = near.tall, piece->tall1 = far.tall - near.tall;
  piece->turned0 = near.turned, piece->turned1 = far.turned - near.turned;
  piece->gain0 = near.gain, piece->gain1 = far.gain - near.gain;
}

ONE_BY_ONE
__kernel void scatter(Frame frame, __global const ushort *voxels, __global const uint *planes,
                      __global const uint *texture, __global const float *sites, __global const Segment *segments,
                      __global const int *segment_counts, __global float *re, __global float *im, int stride,
                      __global const float *beam VARIED_PARAMETERS LOBE_PARAMETERS) {
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
  const Strips strips = {line, left, lines, traced_start(frame, (float)line), traced_cosine(frame, (float)line)};
  const Patient patient = {frame, voxels, planes, texture, sites, beam, PART_OF};

  int count = min(segment_counts[line], MAX_SEGMENTS);
  for (int index = 0; index < count; index++) {
    __global const Segment *segment = segments + line * MAX_SEGMENTS + index;
    Piece piece;
    piece.first = first;
    piece.slope = segment->depth_per_mm;
    piece.depth0 = segment->depth_mm;
    // Most segments are elsewhere.
    const float farthest = MOST_MOVED / frame->cycles_per_mm;
    if (piece.depth0 > depth_high + farthest || piece.depth0 + piece.slope * segment->length_mm < depth_low - farthest)
      continue;
#ifdef LOBES
    const float moved = 0.0f;
#else
    const float moved = depth_moved(segment);
#endif
    piece.moved = moved > 1e-5f ? moved : 0.0f;
    const float before = piece.depth0 + moved, behind = piece.depth0 - moved;
    const float segment_low = fmax(0.0f, (block_low - before) / piece.slope);
    const float segment_high = fmin(segment->length_mm, (block_high - behind) / piece.slope);
    const float chunk_low = (depth_low - before) / piece.slope;
    const float chunk_high = (depth_high - behind) / piece.slope;
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
      float begin = fmax(piece.from_mm - SHARED_MM, chunk_low) - early, end = fmin(piece.to_mm + SHARED_MM, chunk_high);
#ifdef LOBES
      const float2 dark = find_dark(&patient, &piece, low, high);
      if (dark.x >= dark.y) continue;
      if (dark.x > low) begin = fmax(begin, dark.x);
      if (dark.y < high) end = fmin(end, dark.y);
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
