"""Work that follows the picture: what a draft computes less of. docs/performance.md#drafts has the rule.

With SimulationSettings.quality "full" nothing depends on the size of the image. A draft keeps values that are lower in
the settings, and a density of scatterers that is set.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from SlicerUSSim.Logic.base.settings import SimulationSettings
from SlicerUSSim.Logic.imaging.scattering import sites_per_mm3
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.beam import NOMINAL_SPEED_M_S

_LINES_PER_COLUMN, _APART_SIGMAS = 0.5, 2.0
_SAMPLES_PER_BANDWIDTH, _LEAST_SAMPLES = 4.0, 2
_FEWER_SITES, _LEAST_SITES, _CUTOFF = 5.0, 0.1, 1.5


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


def axial_sigma_mm(probe: Probe, settings: SimulationSettings) -> float:
    """Standard deviation of the pulse in depth, millimetres, with the scanner's speed of sound."""
    return probe.axial_sigma_mm * settings.reference_speed_m_s / NOMINAL_SPEED_M_S


@lru_cache(maxsize=64)
def sigmas_between(probe: Probe) -> tuple[np.ndarray, np.ndarray]:
    """(depths in mm, distances between scan lines there in lateral sigmas of the beam), (65,) each."""
    depth = np.linspace(0.0, probe.depth_mm, 65)
    return depth, probe.line_distance_mm(depth) / probe.beam_sigma_mm(depth)[0]
