"""Checks of a scanner's floor: side lobes, ring-down at the face (docs/physics.md#side-lobes-and-ring-down)."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from SlicerUSSim.Logic.base.settings import SimulationSettings
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.probe.arrays import ConvexProbe, PhasedProbe, Probe
from validation.checks import Check, Outcome, Row
from validation.measurement import EVEN, depth_window, level_db
from validation.phantoms import FLUID, clutter_power, round_cyst, uniform_speckle
from validation.pictures import Curve, Plot, draw_plots

_RADIUS_MM, _WITHIN_MM = 5.0, 1.0  # of the cyst, and of the lines through its middle
_PROBES: dict[str, Probe] = {
    "phased 5 MHz": PhasedProbe(60.0, 90.0, scan_lines=161, directivity="none"),
    "convex 5 MHz": ConvexProbe(60.0, 36.0, 90.0, scan_lines=129),
    "convex 3.5 MHz": ConvexProbe(
        60.0, 36.0, 90.0, scan_lines=129, frequency_mhz=3.5, aperture_mm=20.0, elevation_aperture_mm=12.0
    ),
}
_DEPTHS_MM = (20.0, 30.0, 40.0)
_BEHIND_MM = 12.0  # imaged behind the centre of the cyst
_SEEDS = 24


def cyst_contrast(rotation: np.ndarray, device) -> Outcome:
    """The level at the centre of a ball without scatterers re around it, focused at its depth and elsewhere.

    Without the probe's clutter, apart from one row, so that the rest is the pattern's.
    """
    rows, curves = [], []

    def row(name: str, probe: Probe, depth: float, limit: float = 2.5) -> tuple[float, float]:
        found = _contrast_db(probe, depth, rotation, device)
        predicted = 10.0 * np.log10(clutter_power(probe, depth, _RADIUS_MM, _WITHIN_MM))
        rows.append(Row(f"10 mm cyst at {depth:.0f} mm, {name}", "dB", predicted, found, limit))
        return found, predicted

    for name, probe in _PROBES.items():
        plain = replace(probe, clutter_db=None)
        levels = [row(name, replace(plain, focus_mm=depth, elevation_focus_mm=depth), depth) for depth in _DEPTHS_MM]
        found, predicted = np.array(levels).T
        depths = np.array(_DEPTHS_MM)
        curves.append(Curve(name, depths, found, depths, predicted))
        row(f"{name}, focus at 54 mm", plain, 20.0)
    phased = _PROBES["phased 5 MHz"]
    focused = replace(phased, focus_mm=30.0, elevation_focus_mm=30.0, clutter_db=None)
    row("phased 5 MHz, Hann window", replace(focused, receive_apodization=1.0), 30.0)
    row("phased 5 MHz, clutter of -30 dB", replace(focused, clutter_db=-30.0), 30.0)
    # Lobes are the mean over the band, and the prediction belongs to its centre, which counts 60 dB down.
    row("phased 5 MHz as harmonic", replace(focused, frequency_mhz=2.5, harmonic=True), 30.0, 4.0)
    plot = Plot("centre of a 10 mm cyst relative to its surroundings", "depth [mm]", "dB", curves)
    return Outcome(tuple(rows), partial(draw_plots, plots=[plot]))


def _contrast_db(probe: Probe, depth: float, rotation: np.ndarray, device) -> float:
    phantom = round_cyst(rotation, depth_mm=depth, radius_mm=_RADIUS_MM)
    probe = replace(probe, depth_mm=depth + _BEHIND_MM)  # deeper samples are not looked at
    apart = float(probe.line_distance_mm(depth))
    middle, near = probe.scan_lines // 2, round(_WITHIN_MM / apart)
    far = min(round(12.0 / apart), middle)
    inside, outside = [], []
    simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, device=device)
    for seed in range(_SEEDS):
        simulator.settings = SimulationSettings(seed=seed, interfaces=False)
        window = depth_window(simulator.simulate(probe, phantom.probe_to_ras, EVEN), depth, 1.0)
        inside.append(window[middle - near : middle + near + 1])
        outside += [window[middle - far : middle - far + 2 * near], window[middle + far - 2 * near : middle + far]]
    return level_db(np.stack(inside)) - level_db(np.stack(outside))


def ring_down(rotation: np.ndarray, device) -> Outcome:
    """The level of the reverberation at the face of a probe in fluid, and where it has fallen by 40 dB."""
    phantom = uniform_speckle(FLUID, rotation)
    simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, device=device)
    rows = []
    for name, probe in _PROBES.items():
        ringing = replace(probe, ring_down_mm=2.0, ring_down_db=6.0)
        frame = simulator.simulate(ringing, phantom.probe_to_ras, replace(EVEN, noise_db=None, tgc_db_cm_mhz=0.0))
        level = 20.0 * np.log10(frame.envelope.mean(axis=0) + 1e-9)
        pulse = round(2.4 * probe.axial_sigma_mm / frame.sample_interval_mm)
        end = round(2.0 / frame.sample_interval_mm)
        rows.append(Row(f"level at the face, {name}", "dB", 6.0, float(level[: pulse // 2].max()), 1.0))
        rows.append(Row(f"level at 2 mm, {name}", "dB", -34.0, float(level[end - pulse // 2 : end + pulse].max()), 6.0))
    return Outcome(tuple(rows))


CHECKS = (
    Check(
        "cyst contrast",
        "Side lobes fill a black cyst as much as the diffraction pattern of the apertures says, in and out of focus.",
        cyst_contrast,
    ),
    Check(
        "ring-down",
        "Reverberation at the face has its level there, and 40 dB less at the probe's ring-down.",
        ring_down,
    ),
)
