"""Work that follows the picture: what a draft computes less of (docs/performance.md#drafts).

With SimulationSettings.quality "full" nothing depends on the size of the image. A "draft" has

- 0.6 scan lines per column of the image, no more than the probe and no fewer than are 1.75 sigmas of the beam apart,
  with one traced line each, or as many as are that far apart where the probe has too few scan lines,
- four samples per cycle of the carrier times the pulse's fractional bandwidth, two or more,
- a fifth of the scatterers, about one in the smallest resolution cell, within two sigmas of the beam,
- one ray instead of several across the slice, and
- half the points and angles of the aperture's fans, whose look-ups are two millimetres apart.

Values that are lower in the settings are kept, as is a density of scatterers that is set.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import numpy as np

from SlicerUSSim.Logic.base.settings import SimulationSettings
from SlicerUSSim.Logic.imaging.scattering import sites_per_mm3
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.beam import NOMINAL_SPEED_M_S

_LINES_PER_COLUMN, _APART_SIGMAS = 0.6, 1.75
_SAMPLES_PER_BANDWIDTH, _LEAST_SAMPLES = 4.0, 2
_FEWER_SITES, _LEAST_SITES, _CUTOFF = 5.0, 0.1, 2.0
_FAN_STEP_MM = 2.0


@lru_cache(maxsize=64)
def worked(probe: Probe, settings: SimulationSettings, columns: int) -> tuple[Probe, SimulationSettings]:
    """The probe and settings that compute an image of this many columns."""
    if settings.quality == "full":
        return probe, settings
    needed = int(np.ceil((probe.scan_lines - 1) * sigmas_between(probe)[1].max() / _APART_SIGMAS)) + 1
    lines = int(min(probe.scan_lines, max(np.ceil(_LINES_PER_COLUMN * columns), needed)))
    samples = max(np.ceil(_SAMPLES_PER_BANDWIDTH * probe.received_bandwidth), _LEAST_SAMPLES)
    return replace(probe, scan_lines=lines), replace(
        settings,
        lateral_rays=settings.lateral_rays or max(-(-(needed - 1) // (lines - 1)), 1),
        elevational_rays=1,
        scatterers_per_mm3=settings.scatterers_per_mm3
        or max(sites_per_mm3(settings, probe) / _FEWER_SITES, _LEAST_SITES),
        beam_cutoff=min(settings.beam_cutoff, _CUTOFF),
        samples_per_cycle=int(min(settings.samples_per_cycle, samples)),
    )


def line_shape(probe: Probe, settings: SimulationSettings) -> tuple[int, int]:
    """(scan_lines, samples) of the signals along the lines, of what worked() gives."""
    return probe.scan_lines, int(np.ceil(probe.displayed_mm / sample_mm(probe, settings)))


def sample_mm(probe: Probe, settings: SimulationSettings) -> float:
    """Millimetres between samples along the lines, with the scanner's speed of sound."""
    return 1.0 / (settings.samples_per_cycle * cycles_per_mm(probe, settings))


def cycles_per_mm(probe: Probe, settings: SimulationSettings) -> float:
    """Cycles of the carrier for a millimetre along the lines, with the scanner's speed of sound."""
    return probe.cycles_per_mm * NOMINAL_SPEED_M_S / settings.reference_speed_m_s


@lru_cache(maxsize=64)
def sigmas_between(probe: Probe) -> tuple[np.ndarray, np.ndarray]:
    """(depths in mm, distances between scan lines there in lateral sigmas of the beam), (65,) each."""
    depth = np.linspace(0.0, probe.depth_mm, 65)
    return depth, probe.line_distance_mm(depth) / probe.beam_sigma_mm(depth)[0]


def coarser_fans(fields: Mapping[str, float]) -> dict[str, float]:
    """The fields of layout.ACQUISITION of aperture.aperture_fields whose fans a draft has."""
    half = {name: max(-(-int(fields[f"fan_{name}"]) // 2), 2) for name in ("points", "angles")}
    reach = fields["fan_step"] * (fields["fan_depths"] - 1)
    depths = min(int(fields["fan_depths"]), int(np.ceil(reach / _FAN_STEP_MM)) + 1)
    return {
        "fan_points": half["points"],
        "fan_pitch": fields["fan_pitch"] * (fields["fan_points"] - 1) / (half["points"] - 1),
        "fan_angles": half["angles"],
        "fan_angle_step": fields["fan_angle_step"] * (fields["fan_angles"] - 1) / (half["angles"] - 1),
        "fan_depths": depths,
        "fan_step": reach / (depths - 1),
    }
