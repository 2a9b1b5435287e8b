"""Impulses of scatterers and their level in uneven tissue (docs/physics.md#5-scatterers).

Gains and widths are those at every scatterer. The kernel has them at the ends of short pieces, linear between.
"""

from __future__ import annotations

import itertools

import numpy as np
from scipy import spatial

from SlicerUSSim.Logic.probe.lens import LensBeam
from tests.reference.beam import Beam
from tests.reference.elementary import gaussian, hash_mix, hash_of_cells


def scatterer_lines(record, lens: LensBeam, labels: np.ndarray, tissues: np.ndarray, segments, lines) -> np.ndarray:
    """(2 traced lines, samples) complex impulses on the left and right edges of the strips of all traced lines.

    Parameters
    ----------
    record : of layout.ACQUISITION.
    lens : of the probe.
    labels : (k, j, i) with a margin of one voxel, without sheets and membranes.
    tissues : (labels,) layout.TISSUE.
    segments, lines : layout.SEGMENT and the traced line of each.
    """
    beam, seed = Beam(record), int(record["seed"])
    of, cell = beam.of, beam.of["cell_mm"]
    sums = np.zeros((2 * int(of["traced_lines"]), int(of["samples"])), complex)
    far = segments["start"] + segments["length_mm"][:, None] * segments["direction"]
    ends = np.concatenate([segments["start"], far])
    reach = 2.0 * float(lens.main_mm.max()) + 1.0
    low, high = np.floor([(ends.min(axis=0) - reach) / cell, (ends.max(axis=0) + reach) / cell]).astype(int)
    cells = np.stack(np.meshgrid(*map(np.arange, low, high + 1), indexing="ij"), axis=-1).reshape(-1, 3)
    key = hash_of_cells(cells, seed)
    random = hash_mix(key + np.uint32(0x3C6EF372))
    grains = (key[:, None] >> np.array([0, 10, 20], np.uint32)) & np.uint32(1023)
    places = cell * (cells + (grains + 0.5) / 1024.0)
    amplitudes = _amplitudes(record, labels, tissues, places, random)
    exists = amplitudes != 0.0
    places, amplitudes = places[exists], amplitudes[exists]
    tree = spatial.cKDTree(places)
    for segment, line in zip(segments, lines, strict=True):
        scan_line = (line - of["guard_lines"]) / of["lateral_rays"]
        begins, cosine = beam.line_start(scan_line), beam.line_cosine(scan_line)
        half = 0.5 * segment["length_mm"]
        near = tree.query_ball_point(segment["start"] + half * segment["direction"], half + reach)
        axes = np.stack([segment[name] for name in ("direction", "lateral", "elevational")])
        along, aside, height = axes @ (places[near] - segment["start"]).T
        bend = (
            0.0 if of["linear"] else 0.5 / np.maximum(of["apex_radius_mm"] + begins + segment["path_mm"] + along, 1.0)
        )
        at = along + bend * aside**2  # off the axis of a sector the same range is reached earlier
        left, apart = (segment["left"], segment["right"] - segment["left"])
        left, apart = left[0] + left[1] * along, apart[0] + apart[1] * along
        # Where strips and segments meet, a scatterer passes from one to the other.
        share = np.clip(at / 0.02 + 0.5, 0.0, 1.0) - np.clip((at - segment["length_mm"]) / 0.02 + 0.5, 0.0, 1.0)
        right = (aside - left) / apart
        share *= np.clip(32.0 * (0.5 - abs(right - 0.5)) + 0.5, 0.0, 1.0)
        inside = (share > 0.0) & (apart > 0.0)
        along, aside, height, at, apart, right = (x[inside] for x in (along, aside, height, at, apart, right))
        amplitude = amplitudes[near][inside] * share[inside]
        path, loss = segment["path_mm"] + along, segment["loss"] + segment["loss_per_mm"] * along
        frequency = beam.frequency_after(loss)
        root, cycles = beam.elevation(lens, path, height, frequency)
        # The image is as wide as the beam at the displayed depth.
        shown = np.maximum(segment["depth_mm"] + segment["depth_per_mm"] * along, begins)
        wide = beam.lateral_sigma(shown - begins, frequency, cosine) / beam.line_distance(shown)
        left = beam.mirrored_power(path, segment["tube"], along, cosine)
        amplitude = (
            amplitude * segment["weight"] * segment["attenuation"] * of["speckle_scale"] * np.sqrt(2.0 * np.pi**1.5)
        )
        amplitude *= np.exp(beam.gain_of_band(loss) - segment["decay_per_mm"] * along) * root
        amplitude *= np.sqrt(segment["depth_per_mm"] * wide * left / apart)
        depth = segment["depth_mm"] + segment["depth_per_mm"] * at
        for side, (_, _, later, change) in ((aside < 0.0, segment["left"]), (aside > 0.0, segment["right"])):
            depth += np.where(side, aside * (later + change * along), 0.0)
        echo = amplitude * np.exp(-2j * np.pi * (depth * of["cycles_per_mm"] + cycles))
        place = depth / of["sample_mm"]
        bins, part = np.floor(place).astype(int), place % 1.0
        for edge, of_edge in enumerate((1.0 - right, right)):
            for ahead, of_sample in enumerate((1.0 - part, part)):
                within = (bins + ahead >= 0) & (bins + ahead < sums.shape[1])
                np.add.at(sums[2 * line + edge], (bins + ahead)[within], (echo * of_edge * of_sample)[within])
    return sums


def _amplitudes(record, labels: np.ndarray, tissues: np.ndarray, places: np.ndarray, random: np.ndarray) -> np.ndarray:
    """(n,) amplitudes of the cells' scatterers at (n, 3) RAS mm, 0 where there is none.

    The label belongs to one of the eight voxels around, drawn with its trilinear weight. A cell stands for all sites of
    the paper's lattice of 20 um in it, and has a scatterer where one of them has.
    """
    matrix = record["ras_to_voxel"].reshape(3, 4).astype(float)
    voxel = np.clip(places @ matrix[:, :3].T + matrix[:, 3], 0.0, np.array(labels.shape[::-1]) - 1.001)
    base = voxel.astype(int)
    drawn = (random[:, None] >> np.array([0, 5, 10], np.uint32)) & np.uint32(31)
    i, j, k = (base + ((voxel - base) * 32.0 > drawn + 0.5)).T
    label = labels[k, j, i]
    empty = (1.0 - tissues["scatterer_share"].astype(float)) ** max((float(record["cell_mm"]) / 0.02) ** 3, 1.0)
    share = np.rint(65536.0 * (1.0 - empty))
    level = np.sqrt(tissues["scatterer_variance"] * 65536.0 / np.maximum(share, 1.0))
    exists = (random >> np.uint32(16)) + 0.5 < share[label]
    sign = np.where((random >> np.uint32(15)) & np.uint32(1), -1.0, 1.0)
    return exists * sign * level[label] * unevenness(int(record["seed"]), tissues[label], places)


def unevenness(seed: int, rows: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(n,) factors of amplitudes at (n, 3) RAS mm in tissues of the layout.TISSUE rows (n,).

    Texture is a random field on a lattice whose correlation is one half a length away, specks are spheres in the cells
    of another (docs/physics.md#uneven-tissue).
    """
    texture_db, length, specks, speck_db = (
        rows[name].astype(float) for name in ("texture_db", "texture_mm", "specks_per_mm3", "speck_db")
    )
    length = np.maximum(length, 1e-6)
    specked = (specks > 0.0) & (speck_db > 0.0)
    share = np.where(specked, np.minimum(np.rint(65536.0 * specks * length**3), 65536.0), 0.0)
    place = places * (0.754 / length)[:, None]
    corner = np.floor(place)
    total, squares = np.zeros(len(places)), np.zeros(len(places))
    for step in itertools.product((0, 1), repeat=3):
        weight = np.where(np.array(step) == 1, place - corner, 1.0 - (place - corner)).prod(axis=1)
        total += weight * gaussian(hash_of_cells(corner + np.array(step), seed + 0x68E31DA4))
        squares += weight**2
    cell = places / length[:, None]
    near = np.maximum(1.0 - 4.0 * ((cell - np.floor(cell) - 0.5) ** 2).sum(axis=1), 0.0)
    drawn = (hash_of_cells(np.floor(cell), seed + 0xB5297A4D) >> np.uint32(16)) + 0.5 < share
    level_db = texture_db * total / np.sqrt(squares) + drawn * speck_db * near
    # Mean power of both: of a log-normal variable, and of spheres in boxes
    power = np.exp(0.5 * (texture_db * np.log(10.0) / 10.0) ** 2)
    for bright in np.unique(speck_db[specked]):
        power[specked & (speck_db == bright)] *= (
            1.0 + (share / 65536.0 * (_power_of_speck(bright) - 1.0))[specked & (speck_db == bright)]
        )
    return 10.0 ** (level_db / 20.0) / np.sqrt(power)


def _power_of_speck(bright_db: float) -> float:
    """Mean over the cube of side 2 of 10^(bright (1 - r^2) / 10) in the unit sphere and 1 outside: by spheres."""
    radius, weights = np.polynomial.legendre.leggauss(60)
    radius = 0.5 * (radius + 1.0)
    inside = 0.5 * weights * 4.0 * np.pi * radius**2 * (10.0 ** (0.1 * bright_db * (1.0 - radius**2)) - 1.0)
    return float(1.0 + inside.sum() / 8.0)
