"""Checks of what attenuation does to the band of a pulse (docs/physics.md#frequency-that-falls-with-depth)."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.settings import DisplaySettings, SimulationSettings
from SlicerUSSim.Logic.imaging.frame import Frame
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.probe.arrays import PROBES, ConvexProbe, LinearProbe, PhasedProbe, Probe
from SlicerUSSim.Logic.probe.poses import elevational_motion
from validation.apertures import lens_profile
from validation.checks import Check, Outcome, Row
from validation.measurement import EVEN, correlation, depth_window, level_db
from validation.phantoms import BACKGROUND, band_power, uniform_speckle
from validation.pictures import Curve, Plot, draw_plots

_FOCI: dict[str, Any] = {"focus_mm": 50.0, "elevation_focus_mm": 50.0}
_PROBES: dict[str, Probe] = {
    "linear": LinearProbe(40.0, 90.0, scan_lines=129, **_FOCI),
    "convex": ConvexProbe(60.0, 36.0, 90.0, scan_lines=129, **_FOCI),
    "phased": PhasedProbe(60.0, 90.0, scan_lines=161, fractional_bandwidth=0.6, directivity="none", **_FOCI),
}
_DEPTHS_MM = (20.0, 50.0, 80.0)
#: Presets with a wide band, in tissue that attenuates much: the centre of the spectrum falls to near zero
_WIDE, _MUCH_DB_CM_MHZ = ("cardiac", "neonatal", "matrix"), 0.8
_HALF_MM = 2.0


def downshift(rotation: np.ndarray, device) -> Outcome:
    """Level, frequency and width of the beam in tissue of 0.5 dB/(cm MHz), at three depths; levels of wide bands."""
    phantom = uniform_speckle(BACKGROUND, rotation)
    simulators = [
        # The widths of beams are compared, and curved wavefronts shorten the correlation, too.
        UltrasoundSimulator(
            phantom.labels, phantom.tissues, SimulationSettings(seed=seed, wavefront_curvature=False), device
        )
        for seed in range(12)
    ]
    rows, curves = [], []
    for name, probe in _PROBES.items():
        frames = [simulator.simulate(probe, phantom.probe_to_ras, EVEN) for simulator in simulators]
        dz = frames[0].sample_interval_mm
        for depth in _DEPTHS_MM:
            near = [depth_window(frame, depth, _HALF_MM) for frame in frames]
            deep = depth + np.linspace(-_HALF_MM, _HALF_MM, near[0].shape[1])
            level = 10 * np.log10(band_power(probe, _loss_db(probe, deep)).mean() * BACKGROUND.scatterer_variance)
            rows.append(Row(f"level at {depth:.0f} mm, {name}", "dB", level, level_db(np.stack(near)), 0.3))
            predicted = probe.frequency_mhz * _mean_frequency(probe, depth)
            # Within a pulse the earlier, stronger echoes have the higher frequency: 0.03 MHz.
            turn = np.angle(sum((signal[:, 1:] * signal[:, :-1].conj()).sum() for signal in near))
            found = probe.frequency_mhz * (1.0 + turn / (2.0 * np.pi * dz * frames[0].cycles_per_mm))
            rows.append(Row(f"mean frequency at {depth:.0f} mm, {name}", "MHz", predicted, found, 0.1))
        rows += _widths(name, probe, phantom.probe_to_ras, simulators, frames)
        deep = np.arange(5.0, 85.0, 4.0)
        measured = [level_db(np.stack([depth_window(frame, at, 1.0) for frame in frames])) for at in deep]
        variance = 10 * np.log10(BACKGROUND.scatterer_variance)
        fine = np.linspace(0.0, 90.0, 91)
        theory = 10 * np.log10(band_power(probe, _loss_db(probe, fine)))
        curves.append(Curve(name, deep, np.array(measured) - variance, fine, theory))
    rows += _wide_bands(rotation, device)
    plot = Plot("level of speckle at 0.5 dB/(cm MHz)", "depth [mm]", "dB", curves)
    return Outcome(tuple(rows), partial(draw_plots, plots=[plot]))


def _wide_bands(rotation: np.ndarray, device) -> list[Row]:
    """Levels down to the end of the image, and after the TGC of the band."""
    tissue = replace(BACKGROUND, attenuation_db_cm_mhz=_MUCH_DB_CM_MHZ)
    phantom = uniform_speckle(tissue, rotation)
    display = DisplaySettings(look="even", tgc_db_cm_mhz=_MUCH_DB_CM_MHZ, tgc_reach=1.0, noise_db=None)
    rows, even = [], 10 * np.log10(tissue.scatterer_variance)
    for name in _WIDE:
        probe = replace(PROBES[name], directivity="none")
        frames = [
            UltrasoundSimulator(phantom.labels, phantom.tissues, SimulationSettings(seed=seed), device).simulate(
                probe, phantom.probe_to_ras, display
            )
            for seed in range(6)
        ]
        for depth in np.array([0.5, 0.95]) * probe.depth_mm:
            deep = depth + np.linspace(-_HALF_MM, _HALF_MM, 41)
            loss = 0.2 * _MUCH_DB_CM_MHZ * probe.frequency_mhz * deep
            level = 10 * np.log10(band_power(probe, loss).mean()) + even
            found = level_db(np.stack([depth_window(frame, float(depth), _HALF_MM) for frame in frames]))
            rows.append(Row(f"level at {depth:.0f} mm of 0.8 dB/(cm MHz), {name}", "dB", level, found, 0.3))
            ends = ((depth + np.array([-_HALF_MM, _HALF_MM])) / frames[0].sample_interval_mm).astype(int)
            shown = level_db(np.stack([frame.envelope[:, slice(*ends)] for frame in frames]))
            rows.append(Row(f"after TGC at {depth:.0f} mm, {name}", "dB", even, shown, 0.4))
    return rows


def _loss_db(probe: Probe, depth_mm) -> np.ndarray:
    return 0.2 * BACKGROUND.attenuation_db_cm_mhz * probe.frequency_mhz * np.asarray(depth_mm)


def _mean_frequency(probe: Probe, depth_mm: float) -> float:
    """Mean over the power spectrum, relative to the centre: the logarithmic derivative of its power by the loss."""
    loss, step = float(_loss_db(probe, depth_mm)), 0.01
    before, behind = (float(band_power(probe, loss + side * step)) for side in (-1, 1))
    return -10.0 * np.log10(behind / before) / (2.0 * step)


def _widths(name: str, probe: Probe, pose: np.ndarray, simulators, frames: list[Frame]) -> list[Row]:
    """Correlations of signals apart, which follow from the beam of a probe of the lower frequency."""
    depth, rows = _DEPTHS_MM[-1], []
    lower = replace(probe, frequency_mhz=probe.frequency_mhz * _mean_frequency(probe, depth))
    sigma_l, sigma_e = (float(sigma) for sigma in lower.beam_sigma_mm(depth))
    apart = float(probe.line_distance_mm(depth))
    lag = max(1, round(sigma_l / apart))
    near = [depth_window(frame, depth, _HALF_MM) for frame in frames]
    beside = pose @ elevational_motion(0.8 * sigma_e)
    others = [depth_window(simulator.simulate(probe, beside, EVEN), depth, _HALF_MM) for simulator in simulators]
    across = np.linspace(-8.0, 8.0, 801) * sigma_e
    profile, moved = (lens_profile(lower, depth, np.abs(across - shift)) for shift in (0.0, 0.8 * sigma_e))
    # Elevationally the main beam ends where it has nine tenths of the deviation of all of the power.
    for direction, theory, limit, pairs in (
        ("lateral", np.exp(-((lag * apart) ** 2) / (4 * sigma_l**2)), 0.05, [(s[:-lag], s[lag:]) for s in near]),
        ("elevational", (profile * moved).sum() / (profile**2).sum(), 0.1, list(zip(near, others, strict=True))),
    ):
        theory = float(theory)
        found = float(np.mean([correlation(*pair) for pair in pairs]))
        rows.append(Row(f"{direction} correlation at {depth:.0f} mm, {name}", "", theory, found, limit * theory))
    return rows


CHECKS = (
    Check(
        "frequency downshift",
        "Level and mean frequency agree with a sum over the frequencies of the pulse, the beam with the mean.",
        downshift,
    ),
)
