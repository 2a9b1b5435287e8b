"""NumpyModel: the line from a pose to an image, as UltrasoundSimulator has it, in numpy."""

from __future__ import annotations

from time import perf_counter

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.settings import FULL_SCALE_DB, DisplaySettings
from SlicerUSSim.Logic.base.transforms import check_rigid
from SlicerUSSim.Logic.imaging.bmode import pulse_taps
from SlicerUSSim.Logic.imaging.noise import noise_key
from SlicerUSSim.Logic.imaging.raytracing import beam_quantiles, line_roots
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.verification.numpy_model.echoes import add_interfaces, lateral_beam, scatterer_lines
from SlicerUSSim.Logic.verification.numpy_model.elementary import f32, gaussian, hash_mix
from SlicerUSSim.Logic.verification.numpy_model.labels import Labels
from SlicerUSSim.Logic.verification.numpy_model.tracing import Tracer


class NumpyModel:
    """Simulates what `simulator` would, on the host.

    Medium and settings are the simulator's; nothing is computed on its device. Raises SimulationError if the settings
    ask for a texture, which this model does not have.
    """

    def __init__(self, simulator: UltrasoundSimulator) -> None:
        settings = simulator.settings
        require(
            not settings.needs_texture, "NumpyModel has no texture, expected partial_volume and mri_modulation_db 0"
        )
        self.simulator = simulator
        self.labels = Labels(simulator.medium)
        #: Milliseconds per stage of the last image
        self.timings_ms: dict[str, float] = {}

    def simulate(
        self,
        probe: Probe,
        probe_to_ras: np.ndarray,
        display: DisplaySettings | None = None,
        grid: ImageGrid | None = None,
        *,
        noise_seed: int = 0,
    ) -> np.ndarray:
        """(rows, columns) uint8 image; arguments as UltrasoundSimulator.simulate has them."""
        display, settings = display or DisplaySettings(), self.simulator.settings
        grid = grid or ImageGrid.for_probe(probe, display.image_size)
        acquisition = self.simulator.acquisition(probe, check_rigid("probe_to_ras", probe_to_ras))
        tissues = self.simulator.medium.rows
        clock = [perf_counter()]

        traced = int(acquisition["traced_lines"]), int(acquisition["elevational_rays"])
        tracer = Tracer(acquisition, self.labels, tissues)
        segments, segment_lines, hits, hit_lines = tracer.run(line_roots(acquisition), beam_quantiles(*traced))
        clock.append(perf_counter())
        if settings.scattering:
            lines = scatterer_lines(acquisition, self.labels, tissues, segments, segment_lines)
        else:
            lines = np.zeros((2 * traced[0], int(acquisition["samples"])), np.complex64)
        clock.append(perf_counter())
        if settings.interfaces:
            add_interfaces(acquisition, hits, hit_lines, lines)
        clock.append(perf_counter())
        lines = lateral_beam(acquisition, lines)
        clock.append(perf_counter())
        iq = _convolved(lines, pulse_taps(self.simulator.axial_sigma_mm(probe) / float(acquisition["sample_mm"])))
        clock.append(perf_counter())
        grey = compressed(acquisition, display, iq, noise_seed)
        clock.append(perf_counter())
        image = scan_converted(acquisition, grid, grey)
        clock.append(perf_counter())
        stages = ("ray tree", "scatterers", "interfaces", "beam", "pulse", "B-mode", "scan conversion")
        self.timings_ms = dict(zip(stages, (np.diff(clock) * 1e3).tolist(), strict=True))
        return image


def _convolved(lines: np.ndarray, taps: np.ndarray) -> np.ndarray:
    reach = len(taps) // 2
    padded = np.pad(lines, ((0, 0), (reach, reach)))
    return sum((tap * padded[:, k : k + lines.shape[1]] for k, tap in enumerate(taps)), np.zeros_like(lines))


def compressed(acquisition: np.ndarray, display: DisplaySettings, iq: np.ndarray, noise_seed: int = 0) -> np.ndarray:
    """(scan lines, samples) uint8: amplifier noise, time-gain compensation, envelope, log compression."""
    index = np.arange(iq.shape[1])
    if display.noise_db is not None:
        noise = f32(10.0 ** (display.noise_db / 20.0) / np.sqrt(2.0))
        line = np.arange(len(iq), dtype=np.uint32)[:, None]
        key = hash_mix(
            index.astype(np.uint32) * np.uint32(0x9E3779B1)
            + (np.uint32(noise_key(acquisition, noise_seed)) + line * np.uint32(0x85EBCA77))
        )
        iq = iq + noise * (gaussian(key) + 1j * gaussian(hash_mix(key + np.uint32(0x9E3779B9))))
    power = np.real(iq) ** 2 + np.imag(iq) ** 2 + f32(1e-30)
    tgc_db = index * (
        2.0 * display.tgc_db_cm_mhz * float(acquisition["frequency_mhz"]) * float(acquisition["sample_mm"]) * 0.1
    )
    level_db = 10.0 * np.log10(power) + tgc_db
    value = 255.0 * (1.0 + (level_db - (FULL_SCALE_DB - display.gain_db)) / display.dynamic_range_db)
    return (np.clip(value, 0.0, 255.0) + 0.5).astype(np.uint8)


def scan_converted(acquisition: np.ndarray, grid: ImageGrid, grey: np.ndarray) -> np.ndarray:
    """(rows, columns) uint8: linear along the lines, cubic (Catmull-Rom) across them, 0 outside the field."""
    width = max(round(grid.pixel_spacing_mm[1] / float(acquisition["sample_mm"])), 1)
    lines, samples = grey.shape
    around = np.clip(np.arange(samples)[:, None] + np.arange(width) - width // 2, 0, samples - 1)
    grey = (grey[:, around].mean(axis=2) + 0.5).astype(np.uint8).astype(np.float32)
    x = grid.left_mm + (np.arange(grid.columns) + 0.5) * grid.pixel_spacing_mm[0]
    y = grid.top_mm + (np.arange(grid.rows)[:, None] + 0.5) * grid.pixel_spacing_mm[1]
    if acquisition["linear"]:
        lateral, depth = x + 0 * y, y + 0 * x
    else:
        from_apex = y + float(acquisition["apex_radius_mm"])
        depth = np.hypot(x, from_apex) - float(acquisition["apex_radius_mm"])
        lateral = np.where(from_apex > 0, np.arctan2(x, from_apex), 1e9)
    place = (lateral - float(acquisition["first_line"])) / float(acquisition["line_spacing"])
    inside = (place >= -0.5) & (place <= lines - 0.5) & (depth >= 0) & (depth < float(acquisition["depth_mm"]))
    image = np.zeros((grid.rows, grid.columns), np.uint8)
    sample = depth[inside] / float(acquisition["sample_mm"])
    bins = np.minimum(sample.astype(int), samples - 2)
    part = np.minimum(sample - bins, 1.0)
    place = np.clip(place[inside], 0.0, lines - 1.0)
    line = place.astype(int)
    t = place - line
    a, b, c, d = (
        grey[at, bins] * (1 - part) + grey[at, bins + 1] * part
        for at in (np.clip(line + n, 0, lines - 1) for n in (-1, 0, 1, 2))
    )
    value = b + 0.5 * t * (c - a + t * (2.0 * a - 5.0 * b + 4.0 * c - d + t * (3.0 * (b - c) + d - a)))
    image[inside] = (np.clip(value, 0.0, 255.0) + 0.5).astype(np.uint8)
    return image
