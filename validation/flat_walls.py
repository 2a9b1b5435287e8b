"""Checks of flat walls: planes and layers turned against the voxels, also near an end of the label map."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import partial
from typing import cast

import numpy as np
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic.base.settings import SimulationSettings
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.imaging.frame import Frame
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.probe.arrays import PROBES, LinearProbe, Probe
from SlicerUSSim.Logic.tissue.table import TissueTable
from validation.beams import BEHIND
from validation.checks import Check, Outcome, Row
from validation.measurement import EVEN, depth_window
from validation.phantoms import FLUID, Phantom, layered, reflection_coefficient
from validation.pictures import Curve, Plot, draw_plots

_DEPTH_MM = 25.0
_SETTINGS = SimulationSettings(scattering=False, specular_exponent=0.0)
#: The shipped probe with the widest aperture re wavelength, at 5 MHz: it sees a slope of 2 degrees as 3 dB
_PROBE = cast(
    LinearProbe, replace(PROBES["linear"], frequency_mhz=5.0, focus_mm=_DEPTH_MM, elevation_focus_mm=_DEPTH_MM)
)
#: Turns of the voxels in degrees, with the loss in dB that is allowed: the steps between voxels are 57 voxels long at 1
#: degree, longer than any smoothing
_TURNS = {1.0: 3.0, 2.0: 3.0, 3.0: 3.0, 5.0: 1.5, 8.0: 1.5, 15.0: 1.5, 30.0: 1.5}
#: Turns about random axes in the plane, in degrees, of small maps, which have one step of the plane or none; how many
#: of each, and half their voxels of 1 mm across the beam: in the image plane and out of it
_SMALL_TURNS, _SMALL_MAPS, _SMALL_HALF = (0.3, 0.5, 1.0, 2.0), 8, (40.0, 26.0)
_SMALL_PROBES = ("convex", "phased", "linear")
#: Voxels of 1 mm beside the axis at which planes end, out of the image plane, by the turn of the voxels in degrees
_ENDS = {0.0: (14.0, 18.0, 22.0, 26.0, 30.0, 36.0, 42.0), 2.0: (26.0, 30.0, 36.0, 42.0)}

#: Tilt of planes to the beam, and the largest variation of the level along them in dB
_TILT_DEG, _VARIATION_DB = 5.0, 3.0

#: Layers of voxels at right angles to diagonals, and degrees by which planes are turned from them. The steps of one
#: turned by 1 degree from (1, 1, 1) are 33 voxels long; between them a Gaussian sees the layer.
_DIAGONALS, _FROM_DIAGONAL = ((0, 1, 1), (1, 1, 1), (0, 1, 2), (1, 1, 2)), (0.8, 1.2, 1.8)

#: Planes tilted to the axis, in degrees, about azimuths from the image plane, in voxels turned as numbered; and
#: the dB re a square wall down to which single lines are compared, which change by less than the second
_FLANKS, _FLANK_FLOOR_DB, _CHANGE_DB = ((5.0, 347.0, 11), (5.0, 200.0, 12), (12.0, 50.0, 13)), -30.0, 3.0
_LINES = (96, 191, 381)

#: The same of layers, by their thickness in voxels. Single lines lose up to 7 dB where it is two voxels (physics.md).
_LAYER_TURNS = {
    2: {5.0: 7.0, 15.0: 7.0},
    3: {5.0: 1.5, 15.0: 1.5},
    6: {3.0: 3.0, 5.0: 1.5, 15.0: 1.5},
    10: {3.0: 3.0, 5.0: 1.5, 15.0: 1.5},
    16: {3.0: 3.0, 5.0: 1.5, 15.0: 1.5},
}
#: Voxels between a wall's point on the axis of the probe and an end of the label map; thickness of layers in voxels,
#: None: a half space
_FROM_END, _LAYERS_AT_END = (5, 8, 12, 16, 20), (None, 3, 6, 12)


def _levels(frame: Frame, depth_mm: float, half_mm: float, lateral_mm: float = 10.0) -> np.ndarray:
    """Peak in dB around a depth, of the scan lines within `lateral_mm` of the axis."""
    lateral = np.linspace(-0.5, 0.5, _PROBE.scan_lines) * _PROBE.width_mm
    lines = depth_window(frame, depth_mm, half_mm)[np.abs(lateral) <= lateral_mm]
    return 20 * np.log10(np.abs(lines).max(axis=1) + 1e-12)


def _tilt_about(depth_mm: float, tilt_deg: float) -> np.ndarray:
    """(4, 4) motion of the probe: in the image plane, about a point on its axis."""
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_euler("z", tilt_deg, degrees=True).as_matrix()
    motion[:3, 3] = [0.0, depth_mm, 0.0] - motion[:3, :3] @ [0.0, depth_mm, 0.0]
    return motion


def turned_planes(rotation: np.ndarray, device) -> Outcome:
    """Planes that face the beam or are tilted to it, in voxels of 0.5 and 1 mm turned further and further."""
    level = 20 * np.log10(reflection_coefficient(FLUID, BEHIND)) + _SETTINGS.interface_gain_db
    rows, curves = [], []
    for spacing in (0.5, 1.0):
        lowest = []
        for turn, loss in _TURNS.items():
            turned = rotation @ Rotation.from_euler("xz", [turn, 0.6 * turn], degrees=True).as_matrix()
            phantom = layered(
                [FLUID, BEHIND], [_DEPTH_MM], turned, spacing_mm=spacing, half_width_mm=36.0, half_thickness_mm=30.0
            )
            simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, _SETTINGS, device)
            along = _levels(simulator.simulate(_PROBE, phantom.probe_to_ras, EVEN), _DEPTH_MM, 3.0) - level
            lowest.append(float(along.min()))
            voxels = f"turned by {turn:g} degrees, {spacing:g} mm"
            rows.append(Row(f"lowest level, {voxels}", "dB", 0.0, lowest[-1], loss, "at least"))
            rows.append(Row(f"highest level, {voxels}", "dB", 0.0, float(along.max()), 0.5, "at most"))
            tilted = phantom.probe_to_ras @ _tilt_about(_DEPTH_MM, _TILT_DEG)
            variation = float(np.ptp(_levels(simulator.simulate(_PROBE, tilted, EVEN), _DEPTH_MM, 3.0)))
            what = f"variation along a plane tilted by {_TILT_DEG:g} degrees, {voxels}"
            rows.append(Row(what, "dB", 0.0, variation, _VARIATION_DB, "at most"))
        turns = np.array(list(_TURNS))
        curves.append(Curve(f"{spacing:g} mm", turns, np.array(lowest), turns, 0.0 * turns))
    plot = Plot("plane facing the beam", "voxels turned by [degrees]", "lowest echo [dB]", curves)
    return Outcome(tuple(rows), partial(draw_plots, plots=[plot]))


def _lowest_facing(along: np.ndarray, straight: np.ndarray) -> float:
    """The lowest of levels in dB by line, relative to a straight plane, of the lines that it faces."""
    facing = straight > np.nanmax(straight) - 0.7
    return float(np.min((along - straight)[facing], initial=np.inf))


def planes_in_small_maps(rotation: np.ndarray, device) -> Outcome:
    """Planes that face the beam in maps of 80 x 66 x 52 voxels, relative to planes along the voxels."""
    probes = {name: replace(PROBES[name], frequency_mhz=5.0, band_mhz=None) for name in _SMALL_PROBES}
    normal = np.array([0.0, 1.0, 0.0])
    random = np.random.default_rng(round(1e6 * Rotation.from_matrix(rotation).magnitude()))

    def levels(turned: np.ndarray, shift_mm: float) -> dict[str, np.ndarray]:
        phantom = layered(
            [FLUID, BEHIND], [_DEPTH_MM - shift_mm], turned, spacing_mm=1.0, half_width_mm=_SMALL_HALF[0],
            half_thickness_mm=_SMALL_HALF[1],
        )  # fmt: skip
        simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, _SETTINGS, device)
        pose = phantom.probe_to_ras.copy()
        pose[:3, 3] -= shift_mm * pose[:3, 1]
        return {name: _along_plane(simulator, probe, pose, normal) for name, probe in probes.items()}

    straight = levels(np.eye(3), 0.0)
    rows = []
    for turn in _SMALL_TURNS:
        lowest = dict.fromkeys(probes, np.inf)
        for _ in range(_SMALL_MAPS):
            azimuth, spin = random.uniform(0.0, 2.0 * np.pi, 2)
            axis = np.radians(turn) * np.array([np.cos(azimuth), 0.0, np.sin(azimuth)])
            turned = (Rotation.from_rotvec(axis) * Rotation.from_rotvec([0.0, spin, 0.0])).as_matrix()
            for name, along in levels(turned, random.uniform(-0.5, 0.5)).items():
                lowest[name] = min(lowest[name], _lowest_facing(along, straight[name]))
        for name, level in lowest.items():
            what = f"turned by {turn:g} degrees, {_SMALL_MAPS} small maps of 1 mm, {name}"
            rows.append(Row(f"lowest level, {what}", "dB", 0.0, level, 3.0, "at least"))
    return Outcome(tuple(rows))


def planes_with_edges(rotation: np.ndarray, device) -> Outcome:
    """Planes that face the beam and end beside it, re such that do not, in voxels along them and turned."""
    probes = {name: replace(PROBES[name], frequency_mhz=5.0, band_mhz=None) for name in _SMALL_PROBES}
    normal, size = np.array([0.0, 1.0, 0.0]), np.array([100, 60, 100])
    azimuth = Rotation.from_matrix(rotation).magnitude()
    table = TissueTable({0: FLUID, 1: FLUID, 2: BEHIND})

    def levels(turn: float, end_mm: float) -> dict[str, np.ndarray]:
        axis = np.radians(turn) * np.array([np.cos(azimuth), 0.0, np.sin(azimuth)])
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_rotvec(axis).as_matrix()
        centre = 0.5 * (size - 1.0)
        centre[1] = np.floor(centre[1]) + 0.5  # a face of voxels where they are not turned
        matrix[:3, 3] = [0.0, _DEPTH_MM, 0.0] - matrix[:3, :3] @ centre
        index = np.stack(np.meshgrid(*[np.arange(n) for n in size[::-1]], indexing="ij")[::-1], axis=-1)
        place = index @ matrix[:3, :3].T + matrix[:3, 3]
        array = 1 + ((place[..., 1] > _DEPTH_MM) & (place[..., 2] < end_mm)).astype(np.uint8)
        simulator = UltrasoundSimulator(Volume(array, matrix), table, _SETTINGS, device)
        return {name: _along_plane(simulator, probe, np.eye(4), normal) for name, probe in probes.items()}

    whole = levels(0.0, np.inf)
    rows = []
    for turn, ends in _ENDS.items():
        lowest = {name: (np.inf, 0.0) for name in probes}
        for end in ends:
            for name, along in levels(turn, end).items():
                lowest[name] = min(lowest[name], (_lowest_facing(along, whole[name]), end))
        for name, (level, end) in lowest.items():
            where = f"edges {ends[0]:g} to {ends[-1]:g} voxels beside (lowest at {end:g})"
            what = f"{where}, turned by {turn:g} degrees, {name}"
            rows.append(Row(f"lowest level, {what}", "dB", 0.0, level, 3.0, "at least"))
    return Outcome(tuple(rows))


def planes_along_diagonals(rotation: np.ndarray, device) -> Outcome:
    """Planes tilted to the beam and nearly at right angles to diagonals of the voxels."""
    rows = []
    for spacing, across in itertools.product((0.5, 1.0), _DIAGONALS):
        variations = []
        for angle in _FROM_DIAGONAL:
            # The orientation of the phantom about its normal belongs to this run.
            to_diagonal = Rotation.align_vectors([across], [[0.0, 1.0, 0.0]])[0]
            off = Rotation.from_euler("x", angle, degrees=True)
            spin = Rotation.from_rotvec([0.0, 0.5 + Rotation.from_matrix(rotation).magnitude(), 0.0])
            phantom = layered(
                [FLUID, BEHIND], [_DEPTH_MM], (to_diagonal * off * spin).as_matrix(), spacing_mm=spacing,
                half_width_mm=60.0 * spacing + 10.0, half_thickness_mm=60.0 * spacing,
            )  # fmt: skip
            simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, _SETTINGS, device)
            tilted = phantom.probe_to_ras @ _tilt_about(_DEPTH_MM, _TILT_DEG)
            variations.append(float(np.ptp(_levels(simulator.simulate(_PROBE, tilted, EVEN), _DEPTH_MM, 3.0))))
        worst = int(np.argmax(variations))
        what = f"{_FROM_DIAGONAL[worst]:g} degrees from {across}, {spacing:g} mm"
        quantity = f"largest variation along a plane tilted by {_TILT_DEG:g} degrees, {what}"
        rows.append(Row(quantity, "dB", 0.0, variations[worst], _VARIATION_DB, "at most"))
    return Outcome(tuple(rows))


def _along_plane(simulator: UltrasoundSimulator, probe: Probe, pose: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Peak in dB on the lines of a probe that meet a plane within 14 mm of its axis; nan on others.

    The plane lies _DEPTH_MM deep on the axis and has the unit normal (3,) in the frame of the probe.
    """
    frame = simulator.simulate(probe, pose, EVEN)
    origins, directions = probe.origins_mm(), probe.directions()
    path = ((np.array([0.0, _DEPTH_MM, 0.0]) - origins) @ normal) / (directions @ normal)
    is_near = (path > 0.0) & (np.abs((origins + path[:, None] * directions)[:, 0]) < 14.0)
    peaks = np.full(len(path), np.nan)
    for line in np.flatnonzero(is_near):
        first, last = (max(round((path[line] + off) / frame.sample_interval_mm), 0) for off in (-3.0, 3.0))
        peaks[line] = np.abs(frame.iq[line, first : last + 1]).max(initial=1e-12)
    return 20 * np.log10(peaks)


def flanks_and_lines(rotation: np.ndarray, device) -> Outcome:
    """Single lines on the flanks of planes in turned voxels, drawn with more and more scan lines."""
    probes = {name: replace(probe, frequency_mhz=5.0, band_mhz=None) for name, probe in PROBES.items()}
    square = 20 * np.log10(reflection_coefficient(FLUID, BEHIND)) + _SETTINGS.interface_gain_db
    rows = []
    for spacing, (tilt, azimuth, grid) in itertools.product((0.5, 1.0), _FLANKS):
        across, up = np.sin(np.radians(tilt)), np.cos(np.radians(tilt))
        normal = np.array([across * np.cos(np.radians(azimuth)), up, across * np.sin(np.radians(azimuth))])
        turned = rotation @ Rotation.from_quat(np.random.default_rng(grid).normal(size=4)).as_matrix()
        phantom = layered(
            [FLUID, BEHIND], [_DEPTH_MM], turned, spacing_mm=spacing, half_width_mm=36.0, half_thickness_mm=30.0
        )
        # The phantom's plane is square to its probe: the probe is turned so that the plane has the normal.
        motion = np.eye(4)
        motion[:3, :3] = Rotation.align_vectors([[0.0, 1.0, 0.0]], [normal])[0].as_matrix()
        motion[:3, 3] = [0.0, _DEPTH_MM, 0.0] - motion[:3, :3] @ [0.0, _DEPTH_MM, 0.0]
        simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, _SETTINGS, device)
        for name, probe in probes.items():
            if probe.depth_mm < _DEPTH_MM + 10.0:
                continue
            levels = np.array(
                [
                    _along_plane(simulator, replace(probe, scan_lines=lines), phantom.probe_to_ras @ motion, normal)[
                        :: (lines - 1) // (_LINES[0] - 1)
                    ]
                    for lines in _LINES
                ]
            )
            seen = (levels - square).min(axis=0) > _FLANK_FLOOR_DB
            change = float(np.ptp(levels[:, seen], axis=0).max(initial=0.0))
            what = f"{tilt:g} degrees about {azimuth:g}, {spacing:g} mm, {name} ({np.count_nonzero(seen)} lines)"
            rows.append(Row(f"change of single lines, {what}", "dB", 0.0, change, _CHANGE_DB, "at most"))
    return Outcome(tuple(rows))


def flat_layers(rotation: np.ndarray, device) -> Outcome:
    """Both walls of a layer of one tissue in another, thinner than the smoothing of the borders is wide."""
    square = 20 * np.log10(reflection_coefficient(FLUID, BEHIND)) + _SETTINGS.interface_gain_db
    through = 20 * np.log10(1.0 - reflection_coefficient(FLUID, BEHIND) ** 2)
    rows = []
    for spacing, voxels in itertools.product((0.5, 1.0), _LAYER_TURNS):
        thickness = voxels * spacing
        depths = (_DEPTH_MM - 0.5 * thickness, _DEPTH_MM + 0.5 * thickness)
        for turn, loss in _LAYER_TURNS[voxels].items():
            turned = rotation @ Rotation.from_euler("xz", [turn, 0.6 * turn], degrees=True).as_matrix()
            phantom = layered(
                [FLUID, BEHIND, FLUID], depths, turned, spacing_mm=spacing, half_width_mm=36.0, half_thickness_mm=30.0
            )
            simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, _SETTINGS, device)
            frame = simulator.simulate(_PROBE, phantom.probe_to_ras, EVEN)
            shown = depths[0] + thickness * phantom.tissues[0].speed_of_sound_m_s / BEHIND.speed_of_sound_m_s
            for wall, depth, expected in (("front", depths[0], square), ("back", shown, square + through)):
                along = _levels(frame, depth, min(1.5, 0.4 * thickness)) - expected
                what = f"{wall} of {voxels} voxels, turned by {turn:g} degrees, {spacing:g} mm"
                rows.append(Row(f"lowest level, {what}", "dB", 0.0, float(along.min()), loss, "at least"))
    return Outcome(tuple(rows))


def _cut(phantom: Phantom, from_end: int) -> tuple[Volume, TissueTable]:
    """The labels of a phantom without those beyond an end `from_end` voxels beside the wall's point on the axis."""
    labels, pose = phantom.labels, phantom.probe_to_ras
    at = labels.ras_to_ijk @ pose @ [0.0, _DEPTH_MM, 0.0, 1.0]
    lateral = labels.ras_to_ijk[:3, :3] @ pose[:3, 0]
    axis = int(np.abs(lateral).argmax())
    first = int(np.rint(at[axis])) - from_end + 1
    kept = [slice(None)] * 3
    kept[2 - axis] = slice(first, None)
    matrix = labels.ijk_to_ras.copy()
    matrix[:3, 3] += first * matrix[:3, axis]
    # The fluid continues beyond the end.
    return Volume(np.ascontiguousarray(labels.array[tuple(kept)]), matrix), TissueTable({**phantom.tissues, 0: FLUID})


def walls_near_ends(rotation: np.ndarray, device) -> Outcome:
    """Walls that an end of the label map cuts obliquely, a few voxels beside the beam."""
    square = 20 * np.log10(reflection_coefficient(FLUID, BEHIND)) + _SETTINGS.interface_gain_db
    through = 20 * np.log10(1.0 - reflection_coefficient(FLUID, BEHIND) ** 2)
    turned = rotation @ Rotation.from_euler("xz", [15.0, 9.0], degrees=True).as_matrix()
    rows = []
    for spacing, voxels in itertools.product((0.5, 1.0), _LAYERS_AT_END):
        thickness = (voxels or 0) * spacing
        borders = [_DEPTH_MM, _DEPTH_MM + thickness] if voxels else [_DEPTH_MM]
        phantom = layered(
            [FLUID, BEHIND, FLUID][: len(borders) + 1], borders, turned, spacing_mm=spacing, half_width_mm=36.0,
            half_thickness_mm=30.0,
        )  # fmt: skip
        lowest = np.full((len(_FROM_END), len(borders)), np.inf)
        shown = _DEPTH_MM + thickness * FLUID.speed_of_sound_m_s / BEHIND.speed_of_sound_m_s
        for place, from_end in enumerate(_FROM_END):
            labels, tissues = _cut(phantom, from_end)
            frame = UltrasoundSimulator(labels, tissues, _SETTINGS, device).simulate(_PROBE, phantom.probe_to_ras, EVEN)
            for wall, depth in enumerate((_DEPTH_MM, shown)[: len(borders)]):
                half = min(1.5, 0.4 * thickness) if voxels else 3.0
                lowest[place, wall] = (_levels(frame, depth, half, 1.0) - square - wall * through).min()
        of = f"of a layer of {voxels} voxels" if voxels else "of a half space"
        for wall, levels in zip(("front", "back"), lowest.T, strict=False):
            worst = int(levels.argmin())
            what = f"{wall} {of}, {_FROM_END[0]} to {_FROM_END[-1]} voxels from an end (lowest at {_FROM_END[worst]})"
            rows.append(Row(f"{what}, {spacing:g} mm", "dB", 0.0, float(levels[worst]), 1.5, "at least"))
    return Outcome(tuple(rows))


CHECKS = (
    Check(
        "turned planes", "A plane that faces the beam has the same level wherever its voxels are turned.", turned_planes
    ),
    Check(
        "planes in small maps",
        "A plane that faces the beam has its level where a small label map has one step of it.",
        planes_in_small_maps,
    ),
    Check(
        "planes with edges",
        "A plane that faces the beam has its level up to where it ends beside the beam.",
        planes_with_edges,
    ),
    Check(
        "planes along diagonals",
        "A plane has the same level along itself, also nearly at right angles to a diagonal of the voxels.",
        planes_along_diagonals,
    ),
    Check(
        "flanks and lines",
        "Single lines on the flank of a wall do not depend on the number of scan lines.",
        flanks_and_lines,
    ),
    Check(
        "flat layers", "Both walls of a layer have the level of a plane, wherever its voxels are turned.", flat_layers
    ),
    Check(
        "walls near ends",
        "A wall has the level of a plane up to where an end of the label map cuts it.",
        walls_near_ends,
    ),
)
