"""Check of beams in whole brains against wave propagation (docs/physics.md#beams-from-an-aperture)."""

from __future__ import annotations

from functools import partial

import numpy as np
from scipy.ndimage import map_coordinates

from SlicerUSSim.Logic.probe.arrays import ConvexProbe, PhasedProbe, Probe
from validation.beam_levels import along_line, beam_of_line, levels_and_widths
from validation.brain_views import BRAIN_M_S, EvenBrain, even_brains, random_pose
from validation.checks import Check, Outcome, Row
from validation.pictures import Curve, Plot, draw_plots
from validation.wave import beam_intensities

_PROBES: dict[str, Probe] = {"phased": PhasedProbe(75.0, 73.0), "convex": ConvexProbe(60.0, 60.0, 100.0)}
_VIEWS = 10  # by either probe, of all brains together
_LINES = slice(8, 184, 7)
_EDGES = np.linspace(0.5, 1.0, 7)  # of blocks of depth in the deeper half, as parts of the image depth
_SEEDS = {"aperture": 12, "ray": 3}  # of scatterers, over which speckle averages
_NEAR_MM = 1.5
_VIEW_SEED = 5


def beams_in_heads(rotation: np.ndarray, device) -> Outcome:
    """The level of every line behind a brain's sulci and ventricles; views are random, so there is one orientation."""
    brains = even_brains(device, attenuation_db_cm_mhz=0.0)
    names = ", ".join(brain.name for brain in brains)
    rows, plots = [Row(f"heads: {names}", "", 2.0, float(len(brains)), 1.0, "at least")], []
    for kind, probe in _PROBES.items():
        rng = np.random.default_rng(_VIEW_SEED)
        found: dict[str, list[np.ndarray]] = {"aperture": [], "ray": [], "wave": [], "near": []}
        widths: dict[str, list[np.ndarray]] = {"aperture": [], "ray": [], "wave": []}
        for number in range(_VIEWS):
            brain = brains[number * len(brains) // _VIEWS]
            pose = random_pose(brain.labels, rng)
            for beam in ("aperture", "ray"):
                level, width = levels_and_widths(
                    brain.labels, brain.tissues, brain.baseline, probe, pose, device,
                    beam=beam, edges_mm=_EDGES * probe.depth_mm, lines=_LINES, seeds=_SEEDS[beam],
                    wavefront_curvature=False,
                )  # fmt: skip
                found[beam].append(level)
                widths[beam].append(width)
            wave, near, width = _waves(brain, probe, pose)
            found["wave"].append(wave)
            widths["wave"].append(width)
            found["near"].append(near)
        level, ray, wave, near = (np.array(values) for values in found.values())
        rms, step = float(np.sqrt(np.mean((level - wave) ** 2))), float(np.abs(np.diff(level, axis=1)).mean())
        rows += [
            Row(f"correlation with waves, {kind}", "", 1.0, _correlation(level, wave), 0.15, "at least"),
            Row(f"difference RMS, {kind}", "dB", 0.0, rms, 2.0, "at most"),
            Row(f"mean level, {kind}", "dB", float(wave.mean()), float(level.mean()), 0.5),
            Row(f"mean step between lines, {kind}", "dB", 0.0, step, 1.5, "at most"),
            Row(f"control, single rays: correlation, {kind}", "", 0.5, _correlation(ray, wave), 0.0, "at most"),
            # A deflected beam has left that window: the prediction is the correlation within the waves themselves.
            Row(
                f"correlation with waves' power within {_NEAR_MM} mm of the line, {kind}", "",
                _correlation(wave, near), _correlation(level, near), 0.15, "at least",
            ),
            *_width_rows(kind, *(np.log(np.mean(values, axis=-1)) for values in widths.values())),
        ]  # fmt: skip
        place = probe.line_positions()[_LINES]
        views = (0, _VIEWS - 1)
        curves = [Curve(f"view {view + 1}", place, level[view], place, wave[view]) for view in views]
        plots.append(Plot(f"level in brains, {kind}", "line [radians]", "dB", curves))
    return Outcome(tuple(rows), partial(draw_plots, plots=plots))


def _correlation(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.corrcoef(first.ravel(), second.ravel())[0, 1])


def _width_rows(kind: str, image: np.ndarray, ray: np.ndarray, wave: np.ndarray) -> list[Row]:
    """Rows about the logarithms of the beams' widths (views, lines), re undisturbed ones."""
    widest = np.quantile(np.exp([wave, image]), 0.9, axis=(1, 2))
    return [
        Row(
            f"width of the beam re undisturbed, mean, {kind}",
            "",
            np.exp(wave.mean()),
            float(np.exp(image.mean())),
            0.15,
        ),
        Row(f"width of the beam, 90 % of lines below, {kind}", "", float(widest[0]), float(widest[1]), 0.25),
        Row(f"correlation of widths with waves, {kind}", "", 1.0, _correlation(image, wave), 0.4, "at least"),
        Row(f"control, single rays: width, {kind}", "", 1.0, float(np.exp(ray.mean())), 0.1),
    ]


def _waves(brain: EvenBrain, probe: Probe, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """From wave propagation in the image plane: level, twice the one-way power near the line, and width of the beam.

    (lines,) in dB twice, and (lines, blocks) relative to an undisturbed beam.
    """
    extra = np.zeros(256, np.float32)  # of the path, per length
    for label, tissue in brain.tissues.items():
        extra[label] = BRAIN_M_S / tissue.speed_of_sound_m_s - 1.0
    extras, to_ijk = extra[brain.labels.array], brain.labels.ras_to_ijk @ pose
    depths = 0.5 * (_EDGES[1:] + _EDGES[:-1]) * probe.depth_mm
    levels, widths = [], []
    for position in probe.line_positions()[_LINES]:
        voxel = along_line(probe, position, to_ijk)

        def speed(x, depth, voxel=voxel):
            return BRAIN_M_S / (1.0 + map_coordinates(extras, voxel(x, depth)[2::-1], order=1, cval=extra[0]))

        beam = beam_of_line(beam_intensities, probe, position, depths, BRAIN_M_S)
        speckle, near, width = [], [], []
        for medium in (speed, None):
            x, transmitted, received = beam(medium)
            both_ways = transmitted * received
            speckle.append(both_ways.sum(axis=1))
            width.append(speckle[-1] ** 2 / (both_ways**2).sum(axis=1))
            near.append(transmitted[:, np.abs(x) < _NEAR_MM].sum(axis=1))
        levels.append((10.0 * np.log10(np.mean(speckle[0] / speckle[1])), 20.0 * np.log10(np.mean(near[0] / near[1]))))
        widths.append(width[0] / width[1])
    both = np.array(levels)
    return both[:, 0], both[:, 1], np.array(widths)


CHECKS = (
    Check(
        "beams in heads",
        "In random views of brains, the level of a line changes as wave propagation says; single rays do not follow.",
        beams_in_heads,
        orientations=("aligned",),
    ),
)
