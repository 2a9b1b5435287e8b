"""Scatterers and interfaces as impulses, and the lateral beam (kernels/scattering.cl, interfaces.cl, beam.cl)."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy import special

from SlicerUSSim.Logic.opencl.layout import CONSTANTS
from tests.reference.acquisition import stratum_centres
from tests.reference.beam import Beam
from tests.reference.elementary import (
    LOG2_E,
    affine_point,
    exp,
    exp2,
    f32,
    gaussian,
    hash_mix,
    turn,
)
from tests.reference.labels import Labels
from tests.reference.lobes import Table

# Radians that the sum over hits has at most: from line to line, and over an elevational sigma (interfaces.cl)
_MOST_PER_STEP, _MOST_ASIDE = f32(3.0), f32(0.7)
_AXIS_STEPS = np.array([0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D], np.uint32)


@dataclass(frozen=True)
class _Strips:
    """Lines whose echoes follow the path of `line`: `lines`, of which `before` are left of it; `table` of lobes."""

    line: int
    lines: int = 1
    before: int = 0
    block: int = CONSTANTS["BLOCK"]  # samples with linear interpolation of widths and gains
    table: Table | None = None
    quiet: np.ndarray | None = None  # (labels,) bool


def scatterer_lines(
    acquisition: np.ndarray, labels: Labels, tissues: np.ndarray, segments, segment_lines
) -> np.ndarray:
    """(2 traced lines, samples) complex64 impulses of all scatterers, on the left and right edges of every strip."""
    lines = np.zeros((2 * int(acquisition["traced_lines"]), int(acquisition["samples"])), np.complex128)
    for segment, line in zip(segments, segment_lines, strict=True):
        _add_segment(acquisition, labels, tissues, segment, lines[2 * line : 2 * line + 2], _Strips(line))
    return lines.astype(np.complex64)


def lobe_lines(
    acquisition: np.ndarray,
    labels: Labels,
    tissues: np.ndarray,
    segments,
    segment_lines,
    table: Table,
    together: int,
    quiet: np.ndarray,
) -> np.ndarray:
    """The same for elevational lobes, near quiet tissue: `together` lines have the path of the middle one of them."""
    traced = int(acquisition["traced_lines"])
    lines = np.zeros((2 * traced, int(acquisition["samples"])), np.complex128)
    for segment, line in zip(segments, segment_lines, strict=True):
        first = line // together * together
        count = min(together, traced - first)
        if line == first + count // 2:
            strips = _Strips(line, count, line - first, 4 * CONSTANTS["BLOCK"], table, quiet)
            _add_segment(acquisition, labels, tissues, segment, lines[2 * first : 2 * (first + count)], strips)
    return lines.astype(np.complex64)


def _add_segment(acquisition, labels, tissues, segment, lines: np.ndarray, strips: _Strips) -> None:
    """Add the scatterers of one segment to (2 lines, samples)."""
    slope, start = segment["depth_per_mm"], segment["depth_mm"]
    end, size = start + segment["length_mm"] * slope, strips.block
    for first in range(
        max(int(start / acquisition["sample_mm"]) - 1, 0) // size * size, int(acquisition["samples"]), size
    ):
        if (first - 1) * acquisition["sample_mm"] > end:
            break
        _add_block(acquisition, labels, tissues, segment, first, lines[:, first : first + size], strips)


def _add_block(acquisition, labels, tissues, segment, first: int, sums: np.ndarray, strips: _Strips) -> None:
    """Add the scatterers of one segment to the samples of one block, (2 lines, block) from sample `first` on."""
    slope, depth0 = segment["depth_per_mm"], segment["depth_mm"]
    low = np.maximum(f32(0), (f32(first - 1) * acquisition["sample_mm"] - depth0) / slope)
    high = np.minimum(segment["length_mm"], (f32(first + strips.block) * acquisition["sample_mm"] - depth0) / slope)
    if low >= high:
        return
    waist = acquisition["transmit_waist"]
    longest = waist if strips.table is not None else f32(0.4) * np.minimum(waist, acquisition["elevation_rayleigh"])
    pieces = max(1, int(np.ceil((high - low) / longest)))
    begins = Beam(acquisition).traced_start(np.asarray(strips.line))
    to_apex = segment["path_mm"] + (f32(1e6) if acquisition["linear"] else acquisition["apex_radius_mm"] + begins)
    ends = [low]
    for n in range(1, pieces + 1):
        next_end = low + f32(n) / f32(pieces) * (high - low)
        while ends[-1] < next_end:
            ends.append(min(next_end, ends[-1] + max(to_apex + ends[-1], f32(0.2))))
    last = len(ends) - 2
    for n, (begin, end) in enumerate(itertools.pairwise(ends)):
        belongs = f32(0) if n == 0 else begin, segment["length_mm"] if n == last else end
        _add_piece(acquisition, labels, tissues, segment, first, begin, end, belongs, sums, strips)


def _add_piece(acquisition, labels, tissues, segment, first, low, high, belongs, sums, strips) -> None:
    beam = Beam(acquisition)
    path = segment["path_mm"] + np.array([low, high])
    loss = segment["loss"] + segment["loss_per_mm"] * np.array([low, high])
    frequency, begins = beam.frequency_after(loss), beam.traced_start(np.asarray(strips.line))
    elevation, apart = beam.elevation_sigma(path, frequency), beam.line_distance(path + begins)
    # The image is as wide as the beam at the displayed depth.
    shown = np.maximum(segment["depth_mm"] + segment["depth_per_mm"] * np.array([low, high]), begins)
    across = beam.lateral_sigma(shown - begins, frequency) / beam.line_distance(shown)
    narrow = f32(0.5) * LOG2_E / (elevation * elevation)
    curved = beam.elevational_cycles(path, frequency)
    along_tube = [segment["tube"][w] + segment["tube"][w + 1] * np.array([low, high]) for w in (0, 2)]
    strength = np.log2(segment["weight"] * segment["attenuation"] * acquisition["speckle_scale"] * f32(2.50662827))
    gain = strength - LOG2_E * segment["decay_per_mm"] * np.array([low, high]) + LOG2_E * beam.gain_of_band(loss)
    tall = elevation if strips.table is None else f32(1.0 / np.sqrt(np.pi))
    spread = tall * along_tube[0] * along_tube[1] * apart
    gain = gain + f32(0.5) * np.log2(segment["depth_per_mm"] * across / spread)

    # Lattice axes in the kernel's order, for the same rounding of sums.
    u = int(np.abs(segment["elevational"]).argmax())
    v, w = (u + 1) % 3, (u + 2) % 3
    if abs(segment["direction"][v]) < abs(segment["direction"][w]):
        v, w = w, v
    order = [u, v, w]
    start = segment["start"][order]
    d, side, e = (segment[name][order] for name in ("direction", "lateral", "elevational"))
    aside = (max(strips.before, strips.lines - 1 - strips.before) + 0.5) * apart.max()
    widest = acquisition["beam_cutoff"] * elevation.max()
    height = widest if strips.table is None else strips.table.end(path).max()
    if strips.quiet is not None:
        from_mm, to_mm = _quiet_part(acquisition, labels, strips.quiet, segment, low, high, aside)
        belongs = from_mm if from_mm > low else belongs[0], to_mm if to_mm < high else belongs[1]
    cells = _cells_of_box(acquisition, start, d, side, e, low, high, aside, height)

    key = hash_mix((cells.astype(np.uint32) * _AXIS_STEPS[order]).sum(axis=1, dtype=np.uint32) ^ acquisition["seed"])
    random = hash_mix(key + np.uint32(0x3C6EF372))
    cell, grain = acquisition["cell_mm"], acquisition["cell_mm"] / f32(1024)
    p = [
        (cells[:, n].astype(np.float32) * cell - start[n])
        + (((key >> np.uint32(10 * axis)) & np.uint32(0x3FF)).astype(np.float32) + f32(0.5)) * grain
        for n, axis in enumerate(order)
    ]
    along, aside_l, aside_e = (p[0] * x[0] + p[1] * x[1] + p[2] * x[2] for x in (d, side, e))
    t = (along - low) * (f32(1) / np.maximum(high - low, f32(1e-6)))
    one_over = f32(1) / (strips.lines * apart)
    right = f32((strips.before + 0.5) / strips.lines) + aside_l * (one_over[0] + t * (one_over[1] - one_over[0]))
    r2 = aside_e * aside_e * (narrow[0] + t * (narrow[1] - narrow[0]))
    bend = (
        f32(0)
        if acquisition["linear"]
        else f32(0.5) / np.maximum(acquisition["apex_radius_mm"] + begins + path[0], f32(1))
    )
    depth = segment["depth_mm"] + (along + aside_l * aside_l * bend) * segment["depth_per_mm"]
    place = depth * (f32(1) / acquisition["sample_mm"])
    bins = np.floor(place).astype(int) - first
    cutoff2 = f32(0.5) * LOG2_E * acquisition["beam_cutoff"] * acquisition["beam_cutoff"]
    near = r2 <= cutoff2 if strips.table is None else np.abs(aside_e) <= height
    counts = (right >= 0) & (right < 1) & near & (bins >= -1) & (bins < strips.block)
    counts &= (along >= belongs[0]) & (along < belongs[1])
    p, t, r2, right, depth = [x[counts] for x in p], t[counts], r2[counts], right[counts], depth[counts]
    away, profile = np.abs(aside_e[counts]), r2
    bins, part, random = bins[counts], (place - np.floor(place))[counts], random[counts]

    at = affine_point(acquisition["ras_to_voxel"], segment["start"])
    rows = acquisition["ras_to_voxel"].reshape(3, 4)[:, order]
    voxel = np.stack([at[n] + p[0] * r[0] + p[1] * r[1] + p[2] * r[2] for n, r in enumerate(rows)], axis=-1)
    label, of_sheet = drawn_labels(acquisition, labels, voxel, random, segment["direction"])
    share, level = (of_label[label] for of_label in _site_statistics(tissues, float(cell)))
    if _is_uneven(tissues):
        places = np.empty((len(label), 3), np.float32)
        places[:, order] = np.stack([x + start[n] for n, x in enumerate(p)], axis=-1)
        level = level * unevenness(acquisition["seed"], tissues[label], places)
    exists = (random >> np.uint32(16)).astype(np.float32) + f32(0.5) < share
    strength = np.where(exists, level, f32(0)) * np.where((random >> np.uint32(15)) & np.uint32(1), f32(-1), f32(1))
    if strips.table is not None:
        strength, profile = strength * strips.table.at(path[0] + t * (high - low), away), f32(0)
    amplitude = exp2(np.clip(gain[0] + t * (gain[1] - gain[0]) - profile, f32(-100), f32(100)))
    cycles = depth * acquisition["cycles_per_mm"]
    if strips.table is None:
        cycles = cycles + away * away * (curved[0] + t * (curved[1] - curved[0]))
    cosine, sine = turn(cycles)
    echo = of_sheet * strength * amplitude * (cosine - 1j * sine)
    strip = np.minimum((right * strips.lines).astype(int), strips.lines - 1)
    right = right * strips.lines - strip
    samples = sums.shape[1]
    for edge, of_edge in enumerate((f32(1) - right, right)):
        for ahead, of_sample in enumerate((f32(1) - part, part)):
            here = bins + ahead
            inside = (here >= 0) & (here < samples)
            np.add.at(sums, ((2 * strip + edge)[inside], here[inside]), (echo * of_edge * of_sample)[inside])


def _quiet_part(acquisition, labels, quiet, segment, low, high, aside) -> tuple[np.float32, np.float32]:
    """From where to where along a piece, with a step more, there is quiet tissue on the axis or beside it."""
    steps = max(1, int(np.ceil(high - low)))
    step = (high - low) / f32(steps)
    along = low + (np.arange(steps, dtype=np.float32) + f32(0.5)) * step
    across = f32(0.8) * aside * np.array([-1, 0, 1], np.float32)
    point = segment["start"] + along[:, None, None] * segment["direction"] + across[:, None] * segment["lateral"]
    voxel = affine_point(acquisition["ras_to_voxel"], point) + f32(0.5)
    index = np.clip(voxel, f32(0), f32(labels.dims) - f32(1)).astype(np.int64) @ labels.steps
    found = np.flatnonzero(quiet[labels.label[index]].any(axis=1))
    if len(found) == 0:
        return high, low
    return max(low, low + f32(found[0] - 1) * step), min(high, low + f32(found[-1] + 2) * step)


def _site_statistics(tissues: np.ndarray, cell_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """By label, in how many of 65536 cells there is a scatterer of the paper's lattice of 20 um, and its amplitude."""
    empty = (1.0 - tissues["scatterer_share"].astype(float)) ** max((cell_mm / 0.02) ** 3, 1.0)
    count = np.rint(65536.0 * (1.0 - empty))
    with np.errstate(divide="ignore", invalid="ignore"):
        amplitude = np.sqrt(tissues["scatterer_variance"].astype(float) / (count / 65536.0))
    return count.astype(np.float32), np.where(count > 0, amplitude, 0.0).astype(np.float32)


def _is_uneven(tissues: np.ndarray) -> bool:
    return bool(np.any((tissues["texture_db"] > 0) | ((tissues["specks_per_mm3"] > 0) & (tissues["speck_db"] > 0))))


def unevenness(seed, rows: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(n,) float32 factors of amplitudes at (n, 3) places in the patient (RAS mm), of these layout.TISSUE rows (n,)."""
    length = np.maximum(rows["texture_mm"].astype(float), 1e-6)
    textured = rows["texture_db"] > 0
    specked = (rows["specks_per_mm3"] > 0) & (rows["speck_db"] > 0)
    share = np.minimum(np.rint(65536.0 * rows["specks_per_mm3"].astype(float) * (2.0 * length) ** 3), 65536.0)

    def keys(index: np.ndarray, word: int) -> np.ndarray:
        steps = (index.astype(np.int64).astype(np.uint32) * _AXIS_STEPS).sum(axis=-1, dtype=np.uint32)
        return hash_mix(steps ^ np.uint32((int(seed) + word) % 2**32))

    # The lattice on which the correlation is one half a length away
    place = places * f32(0.754 / length)[:, None]
    corner = np.floor(place)
    part = place - corner
    total, squares = np.zeros(len(places), np.float32), np.zeros(len(places), np.float32)
    for step in itertools.product((0, 1), repeat=3):
        weight = np.where(np.array(step) == 1, part, f32(1) - part).prod(axis=1)
        total = total + weight * gaussian(keys(corner + np.array(step), 0x68E31DA4))
        squares = squares + weight * weight
    level_db = np.where(textured, rows["texture_db"] * total / np.sqrt(squares), f32(0))
    place = places * f32(0.5 / length)[:, None]
    middle = np.floor(place) + f32(0.5)
    near = np.maximum(f32(1) - f32(4) * ((place - middle) ** 2).sum(axis=1), f32(0))
    drawn = (keys(np.floor(place), 0xB5297A4D) >> np.uint32(16)).astype(np.float32) + f32(0.5) < share
    level_db = level_db + np.where(specked & drawn, rows["speck_db"] * near, f32(0))
    # Power that both add on average: of a log-normal variable, and of spheres in a box, by Gauss-Legendre quadrature
    neper = np.where(textured, rows["texture_db"], 0) * np.log(10.0) / 10.0
    power = np.exp(0.5 * neper.astype(float) ** 2)
    for bright in np.unique(rows["speck_db"][specked]):
        here = specked & (rows["speck_db"] == bright)
        power[here] *= 1.0 + share[here] / 65536.0 * (_power_of_speck(float(bright)) - 1.0)
    return (10.0 ** (level_db / 20.0) / np.sqrt(power)).astype(np.float32)


def _power_of_speck(bright_db: float) -> float:
    """Mean over the cube of side 2 of 10^(bright (1 - r^2) / 10) in the unit sphere and 1 outside: by spheres."""
    radius, weights = np.polynomial.legendre.leggauss(60)
    radius, weights = 0.5 * (radius + 1.0), 0.5 * weights
    inside = (weights * 4.0 * np.pi * radius**2 * 10.0 ** (0.1 * bright_db * (1.0 - radius**2))).sum() / 8.0
    return float(inside + 1.0 - np.pi / 6.0)


def _cells_of_box(acquisition, start, d, side, e, low, high, radius_l, radius_e) -> np.ndarray:
    """(n, 3) indices of the lattice cells in the box around a piece, in the order of the axes given."""
    ends = start + np.outer([low, high], d)
    reach = radius_l * np.abs(side) + radius_e * np.abs(e) + acquisition["cell_mm"]
    first = np.floor((ends.min(axis=0) - reach) / acquisition["cell_mm"]).astype(np.int64)
    last = np.floor((ends.max(axis=0) + reach) / acquisition["cell_mm"]).astype(np.int64)
    return np.stack(np.meshgrid(*map(np.arange, first, last + 1), indexing="ij"), axis=-1).reshape(-1, 3)


def drawn_labels(
    acquisition, labels: Labels, voxel: np.ndarray, random: np.ndarray, direction: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(labels, gains) of scatterers at (n, 3) voxel positions: that of a random corner by weight, or the membrane.

    The gain of the membrane's falls with the angle between the beam's `direction` (RAS) and the sheet.
    """
    here, f = labels.cells(voxel)
    threshold = ((random[:, None] >> np.array([0, 5, 10], np.uint32)) & np.uint32(31)).astype(np.float32) + f32(0.5)
    corner = here + (f * f32(32) > threshold) @ labels.steps
    label = labels.label[corner].astype(int)
    gain = np.ones(len(label), np.float32)
    drawn = labels.drawn
    if labels.distance is None and drawn is None:
        return label, gain
    if labels.distance is None:
        corners = np.zeros((len(here), 8), np.float32)  # far outside
    else:
        corners = labels.distance[here[:, None] + labels.corner_steps].astype(np.float32)

    def derived(along: int | None) -> np.ndarray:
        """The trilinear distance, or its derivative along one axis."""
        rest = corners
        for axis in range(3):  # x first
            near, rise = rest[:, ::2], rest[:, 1::2] - rest[:, ::2]
            rest = rise if axis == along else near + f[:, axis : axis + 1] * rise
        return rest[:, 0]

    thin = np.abs(derived(None) - f32(127.5)) < acquisition["membrane_reach"]
    to_voxel = acquisition["ras_to_voxel"].reshape(3, 4)[:, :3]
    normal = np.stack([derived(axis) for axis in range(3)], axis=-1) @ to_voxel
    if labels.sheets is not None and acquisition["sheet_label"] >= 0:
        in_cell = (labels.label[here[:, None] + labels.corner_steps] == acquisition["sheet_label"]) & (
            labels.sheets.is_thin.ravel()[here[:, None] + labels.corner_steps]
        )
        near_cell = in_cell.any(axis=1) | _has_membrane(acquisition, corners)
        nearest = (f > f32(0.5)).astype(np.int64)
        at = here + nearest @ labels.steps
        gradient, distance = labels.sheets.gradient.reshape(-1, 3)[at], labels.sheets.distance.ravel()[at]
        across = gradient @ to_voxel
        away = np.abs((gradient * (f - nearest)).sum(axis=1) - distance)
        in_sheet = near_cell & gradient.any(axis=1)
        in_sheet &= away < acquisition["sheet_reach_mm"] * np.sqrt((across**2).sum(axis=1))
        normal[in_sheet] = across[in_sheet]
        thin |= in_sheet
        beside = near_cell & (label == acquisition["sheet_label"])
        beside &= labels.sheets.gradient.reshape(-1, 3)[corner].any(axis=1)
        label[beside] = labels.sheets.beside.ravel()[corner[beside]]
    level, is_dura = np.ones(len(label), np.float32), np.zeros(len(label), bool)
    if drawn is not None:
        # Where the kernel looks: the cells that the device flags
        looked_at = drawn.near_cell[here] | _has_membrane(acquisition, corners)
        at = here + (f > f32(0.5)).astype(np.int64) @ labels.steps
        gradient = drawn.gradient[at]
        across = gradient @ to_voxel
        away = np.abs((gradient * (f - (f > f32(0.5)))).sum(axis=1) - drawn.distance[at])
        inside = away < drawn.half[at] * np.sqrt((across**2).sum(axis=1))
        has_plane = looked_at & drawn.is_drawn[at]
        thin[has_plane] = inside[has_plane]
        normal[has_plane] = across[has_plane]
        level[has_plane] = drawn.level[at][has_plane]
        is_dura[has_plane] = drawn.is_dura[at][has_plane]
        beside = looked_at & (label == acquisition["sheet_label"]) & drawn.is_drawn[corner]
        label[beside] = drawn.beside[corner[beside]].astype(int)
    label[thin] = np.where(is_dura[thin], acquisition["dura_label"], CONSTANTS["MEMBRANE_LABEL"])
    normal = normal[thin]
    size = np.maximum(np.sqrt((normal**2).sum(axis=1)), f32(1e-6))
    cosine = np.maximum(np.abs(normal @ direction) / size, f32(1e-6))
    falls = cosine ** acquisition["membrane_exponent"]
    isotropic = acquisition["dura_isotropic"]
    falls = np.where(is_dura[thin], np.sqrt(isotropic + (f32(1.0) - isotropic) * cosine**2), falls)
    gain[thin] = level[thin] * acquisition["membrane_gain"] * falls
    return label, gain


def _has_membrane(acquisition: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(n,) whether the distances of a cell's (n, 8) corners let the membrane of a border pass between them."""
    reach = acquisition["membrane_reach"]
    return (corners.min(axis=1) <= f32(127.5) + reach) & (corners.max(axis=1) >= f32(127.5) - reach)


def add_interfaces(acquisition: np.ndarray, hits: np.ndarray, hit_lines: np.ndarray, scanned: np.ndarray) -> None:
    """Add every hit to the scan lines near it, as a Gaussian patch of a plane (docs/physics.md#3-rays)."""
    beam, rays = Beam(acquisition), acquisition["elevational_rays"].astype(np.float32)
    # Of lines much closer than the beam is wide, only some: at least four, at most eight per standard deviation
    apart = beam.line_distance(hits["path_mm"] + beam.traced_start(hit_lines))
    crowd = np.floor(np.log2(beam.lateral_sigma(hits["path_mm"]) / apart / f32(4)))
    crowd = 2 ** np.clip(crowd, 0, 6).astype(int)
    hits, hit_lines, crowd, apart = (values[hit_lines % crowd == 0] for values in (hits, hit_lines, crowd, apart))
    step = apart * f32(crowd)
    lateral, elevational = beam.lateral_sigma(hits["path_mm"]), beam.elevation_sigma(hits["path_mm"])
    width = np.sqrt(lateral * lateral + step * step / f32(12))
    per_slope = f32(2 * np.pi) * acquisition["cycles_per_mm"]
    stretch = np.minimum(f32(1) + hits["lateral_slope"] ** 2, f32(10))
    bend = hits["curvature"] * stretch * np.sqrt(stretch)
    # How far the centre of phase moves towards the scan line, and the fraction of the squared phase inside a patch
    flat = [f32(1) / (f32(1) + f32(16) * (per_slope * bend * sigma**2) ** 2) for sigma in (lateral, elevational)]
    carried = [
        _carried((f32(0.45) * step / width) ** 2, per_slope * hits["lateral_slope"] * step, _MOST_PER_STEP, flat[0]),
        _carried(f32(10) / (rays * rays), per_slope * hits["elevational_slope"] * elevational, _MOST_ASIDE, flat[1]),
    ]
    within = [
        np.maximum(f32(1) - ((f32(1) - carried[0]) * width / lateral) ** 2, f32(0)),
        f32(1) - (f32(1) - carried[1]) ** 2,
    ]
    # Flat walls are summed over the middles of the rays' strata, whatever the shifts of a line.
    strata = np.floor(special.ndtr(hits["elevational_mm"] / elevational) * rays).astype(int)
    middle = stratum_centres(np.clip(strata, 0, int(rays) - 1), int(rays)) * elevational
    aside = hits["elevational_mm"] + flat[1] * (middle - hits["elevational_mm"])
    depth = hits["depth_mm"] - hits["elevational_slope"] * (hits["elevational_mm"] - (f32(1) - carried[1]) * aside)
    whole, inside = f32(0), f32(0)
    # Laterally, a plane is bent against the depths of a fan of lines.
    fan = beam.line_distance(hits["path_mm"] + f32(1)) / beam.line_distance(hits["path_mm"]) - f32(1)
    bends = (bend + (f32(2) * stretch - f32(1)) * fan, bend)
    for part, sigma, bent, axis in zip(within, (lateral, elevational), bends, ("lateral", "elevational"), strict=True):
        slope, variance = hits[f"{axis}_slope"], part * sigma * sigma
        turning = per_slope * bent * variance
        zones = f32(1) + turning * turning
        whole = whole + (per_slope * slope * sigma) ** 2
        inside = inside + (per_slope * slope) ** 2 * variance / zones
        depth = depth - f32(0.5) * per_slope * slope * slope * turning * variance / zones
    share = _patch_echo(acquisition, whole, inside)
    depth_per_line = carried[0] * hits["lateral_slope"] * step
    strength = (
        hits["echo"]
        * exp(beam.gain_of_band(hits["loss"]))
        * (f32(1) + (per_slope * bend * within[0] * lateral * lateral) ** 2) ** f32(-0.25)
        * share
        * step
        / width
        * f32(1 / np.sqrt(2 * np.pi))
    )
    reach = f32(1.35) * acquisition["beam_cutoff"] * width / step
    for line, sums in enumerate(scanned):
        away = f32(int(acquisition["guard_lines"]) + line * int(acquisition["lateral_rays"]) - hit_lines)
        away = away / f32(crowd)
        at = depth + away * depth_per_line
        place = at / acquisition["sample_mm"]
        bins = np.floor(place).astype(int)
        near = (np.abs(away) <= reach) & (share >= f32(1e-4)) & (bins >= 0) & (bins + 1 < len(sums))
        part = (place - np.floor(place))[near]
        cosine, sine = turn((at * acquisition["cycles_per_mm"])[near])
        profile = exp2(np.maximum(f32(-0.5) * LOG2_E * (away * step / width)[near] ** 2, f32(-100)))
        echo = strength[near] * profile * (cosine - 1j * sine)
        np.add.at(sums, bins[near], echo * (f32(1) - part))
        np.add.at(sums, bins[near] + 1, echo * part)


def _carried(least: np.ndarray, phase: np.ndarray, most: np.ndarray, flat: np.ndarray) -> np.ndarray:
    """Part by which a patch's centre of phase moves, <= 1: on steep flat walls more, so that sums have few radians."""
    part = np.minimum(least, f32(1))
    return part + flat * (f32(1) - part) * (f32(1) - f32(1) / np.sqrt(f32(1) + (phase / most) ** 2))


def _patch_echo(acquisition: np.ndarray, phase2: np.ndarray, inside2: np.ndarray) -> np.ndarray:
    """Factor of a patch that has `inside2` of the squared phase; exact for planes down to -30 dB."""
    seen = np.minimum(f32(1), f32(9) / np.maximum(phase2, f32(1e-6)))
    whole, inside = (_plane_echo(acquisition, seen * part) for part in (phase2, inside2))
    between = _plane_echo(acquisition, seen * (phase2 - inside2))
    return _plane_echo(acquisition, inside2) * whole / (inside * between)


def _plane_echo(acquisition: np.ndarray, phase2: np.ndarray) -> np.ndarray:
    """Peak echo of an oblique plane re a perpendicular one, by the squared phase over the beam's sigma.

    Both the beam's fall with the phase and the pulse's spectrum are Gaussian in the frequency.
    """
    relative_bandwidth = acquisition["fractional_bandwidth"] / f32(np.sqrt(8.0 * np.log(2.0)))
    spread = f32(1) + phase2 * relative_bandwidth * relative_bandwidth
    return exp(f32(-0.5) * phase2 / spread) / np.sqrt(spread)


def frequencies_along(acquisition: np.ndarray, segments, segment_lines) -> np.ndarray:
    """(scan lines, samples) float32 frequency after the strongest path to a sample, re the carrier's.

    It follows from the loss at every 16th sample, and is linear in between.
    """
    samples = int(acquisition["samples"])
    nodes = np.arange(0, samples + 1, 16)
    depth, result = (
        nodes * f32(acquisition["sample_mm"]),
        np.zeros((int(acquisition["scan_lines"]), samples), np.float32),
    )
    for n in range(len(result)):
        line = int(acquisition["guard_lines"]) + n * int(acquisition["lateral_rays"])
        stored, strongest = np.full(len(nodes), np.nan), np.full(len(nodes), -1.0)
        for segment in segments[segment_lines == line]:
            along = (depth - segment["depth_mm"]) / segment["depth_per_mm"]
            strength = segment["weight"] * segment["attenuation"] * np.exp(-segment["decay_per_mm"] * along)
            is_its = (along >= 0) & (along <= segment["length_mm"]) & (strength > strongest)
            strongest[is_its] = strength[is_its]
            stored[is_its] = (segment["loss"] + segment["loss_per_mm"] * along)[is_its]
        last = np.maximum.accumulate(np.where(np.isnan(stored), 0, np.arange(len(nodes))))
        found = Beam(acquisition).frequency_after(np.nan_to_num(stored[last]))
        result[n] = np.interp(np.arange(samples), nodes, found)
    return result


def lateral_beam(
    acquisition: np.ndarray, lines: np.ndarray, spreads: np.ndarray, frequencies: np.ndarray
) -> np.ndarray:
    """(scan lines, samples) complex64 from the impulses of the traced lines, distributed by the lateral profile.

    `spreads` (screen lines, depths, 2) is by how much tissue has made the beam wider, and a factor of its echoes;
    `frequencies` are those of frequencies_along.
    """
    beam = Beam(acquisition)
    depth = np.arange(int(acquisition["samples"]), dtype=np.float32) * acquisition["sample_mm"]
    edges = lines[1:-1:2] + lines[2::2]  # edge n is half a step after traced line n
    result = np.empty((int(acquisition["scan_lines"]), len(depth)), np.complex64)
    screens, depths, _ = spreads.shape
    nodes = acquisition["screen_step"] * np.arange(1, depths + 1, dtype=np.float32)
    for n in range(len(result)):
        start = beam.line_start(n)
        s = np.maximum(depth - start, f32(0))
        centre = int(acquisition["guard_lines"]) + n * int(acquisition["lateral_rays"])
        line = f32(centre * (screens - 1) / (int(acquisition["traced_lines"]) - 1))
        left = min(int(line), screens - 2)
        of_line = spreads[left] + (line - left) * (spreads[left + 1] - spreads[left])
        spread, factor = (f32(np.interp(s, nodes, of_line[:, n])) for n in range(2))
        sigma = spread * beam.lateral_sigma(s, frequencies[n])
        apart = beam.line_distance(s + start)
        step = apart / sigma
        narrow2 = np.maximum(f32(1) - step * step / f32(6), f32(0.25))
        scale = factor * step / np.sqrt(narrow2) * np.sqrt(spread) * f32(0.39894228)
        reach = np.ceil(acquisition["beam_cutoff"] * sigma / apart) + f32(0.5)
        away = np.arange(len(edges), dtype=np.float32)[:, None] + f32(0.5) - f32(centre)
        near = np.flatnonzero(np.abs(away[:, 0]) <= reach.max())
        weights = np.exp(f32(-0.5) * step * step / narrow2 * away[near] ** 2) * (np.abs(away[near]) <= reach)
        # The phase is that of the middle of sixteen samples; interpolation between the edges loses some of its power.
        blocks = np.arange(len(s)) // 16
        middle = np.maximum((f32(16) * f32(blocks) + f32(8)) * acquisition["sample_mm"] - start, f32(0))
        of_block = frequencies[n].reshape(-1, 16).mean(axis=1)[blocks]
        curved = beam.lateral_curvature(middle, of_block) * (beam.line_distance(middle + start) / spread) ** 2
        weights = weights * np.exp(np.complex64(-0.5j) * curved * away[near] ** 2)
        apart2 = step * step / narrow2
        kept = 2.0 + np.exp(-0.25 * apart2 - 0.25 * curved**2 / apart2)
        result[n] = (weights * edges[near]).sum(axis=0) * scale * np.sqrt((2.0 + np.exp(-0.25 * apart2)) / kept)
    return result
