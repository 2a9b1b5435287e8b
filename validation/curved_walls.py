"""Checks of bent walls whose radius is a few voxels (docs/physics.md#2-interfaces)."""

from __future__ import annotations

import itertools
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic.base.settings import SimulationSettings
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.probe.arrays import LinearProbe
from validation.beams import BEHIND
from validation.checks import Check, Outcome, Row
from validation.measurement import EVEN, depth_window
from validation.phantoms import FLUID, curved_wall, reflection_coefficient
from validation.pictures import Curve, Plot, draw_plots

_DEPTH_MM = 25.0
_SETTINGS = SimulationSettings(scattering=False, specular_exponent=0.0)
_PROBE = LinearProbe(20.0, 40.0, scan_lines=161, focus_mm=_DEPTH_MM, aperture_mm=12.5, receive_f_number=2.0,
                     elevation_focus_mm=_DEPTH_MM)  # fmt: skip
#: Radii in voxels; dB by which the level in a single grid may be below theory
_RADII = {
    "ball": {5: 8.0, 6: 4.0, 8: 2.5, 10: 2.5, 15: 2.5},
    "rod across the image": {4: 4.5, 5: 3.5, 8: 2.0},
    "rod in the image": {4: 3.0, 5: 3.0, 8: 2.0},
}
_GRIDS, _MEAN_DB = 6, 2.5


def _expected_db(shape: str, radius_mm: float) -> float:
    """Echo relative to a plane: per bent axis (1 + q^2 s^4)^(-1/4), q the phase per squared millimetre."""
    q = 2.0 * np.pi * _PROBE.cycles_per_mm / radius_mm
    lateral, elevational = _PROBE.beam_sigma_mm(_DEPTH_MM)
    bent = {"ball": (lateral, elevational), "rod across the image": (lateral,), "rod in the image": (elevational,)}
    return float(sum(-5.0 * np.log10(1.0 + (q * sigma**2) ** 2) for sigma in bent[shape]))


def _turn(grid: int) -> np.ndarray:
    """(3, 3) random rotation: a normally distributed quaternion."""
    return Rotation.from_quat(np.random.default_rng(grid).normal(size=4)).as_matrix()


def curved_walls(rotation: np.ndarray, device) -> Outcome:
    """Front walls of balls and rods of few voxels, in grids turned at random."""
    square = 20 * np.log10(reflection_coefficient(FLUID, BEHIND)) + _SETTINGS.interface_gain_db
    rows, curves = [], []
    for spacing, (shape, radii) in itertools.product((0.5, 1.0), _RADII.items()):
        means, predictions = [], []
        for voxels, loss in radii.items():
            radius, levels = voxels * spacing, []
            expected = _expected_db(shape, radius)
            for grid in range(_GRIDS):
                turned = rotation @ _turn(grid)
                phantom = curved_wall(shape, radius, turned, depth_mm=_DEPTH_MM, spacing_mm=spacing)
                simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, _SETTINGS, device)
                frame = simulator.simulate(_PROBE, phantom.probe_to_ras, EVEN)
                near = depth_window(frame, _DEPTH_MM, min(2.0, 0.8 * radius))[75:86]
                levels.append(20 * np.log10(np.abs(near).max()) - square)
            means.append(float(np.mean(levels)))
            predictions.append(expected)
            what = f"{shape}, radius {voxels} voxels of {spacing:g} mm"
            rows.append(Row(f"mean of {_GRIDS} grids, {what}", "dB", expected, means[-1], _MEAN_DB))
            rows.append(Row(f"lowest, {what}", "dB", expected, float(np.min(levels)), loss, "at least"))
        at = np.array(list(radii), float)
        curves.append(Curve(f"{shape}, {spacing:g} mm", at, np.array(means), at, np.array(predictions)))
    plot = Plot("bent walls", "radius [voxels]", "echo relative to a plane [dB]", curves)
    return Outcome(tuple(rows), partial(draw_plots, plots=[plot]))


CHECKS = (
    Check(
        "small curved walls",
        "The echo of a ball or rod falls with its curvature alone, also where its radius is a few voxels.",
        curved_walls,
    ),
)
