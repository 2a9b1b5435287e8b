"""Side lobes of the beam: the records and the host code of kernels/side_lobes.cl.

The main lobe of a beam is a Gaussian. What an aperture of finite size has beside it is one broad, weak Gaussian more,
of as much power as the diffraction pattern of the aperture has at the distances from which cysts and shadows are filled
(J. W. Goodman, Introduction to Fourier Optics, section 4.4; docs/physics.md#side-lobes-and-ring-down).
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import erfc

from SlicerUSSim.Logic.imaging.noise import stirred
from SlicerUSSim.Logic.imaging.signals import EchoLines, RayTree
from SlicerUSSim.Logic.imaging.stage import SAMPLE_BYTES, DeviceFrame, FrameInputs, Stage, Work
from SlicerUSSim.Logic.opencl.device import Device
from SlicerUSSim.Logic.probe.beam import FWHM_PER_SIGMA, MAIN_LOBE

if TYPE_CHECKING:
    from SlicerUSSim.Logic.probe.arrays import Probe

#: How many times larger, along each axis, cells of the lattice are for elevational lobes, which are as much wider
COARSER = 3.0
#: Distances from the axis, in wavelengths x f-number, beyond which the lobes have the power of the diffraction pattern
MATCHED = (2.0, 3.0)
#: Lobes that hardly fall, as those of a Hamming window, are cut off here
_WIDEST = 4.0
_PER_LINE = 6  # operations per sample and scan line that contributes
_SEED = 0x51DE10BE


class SideLobes(Stage):
    """Adds the echoes that lateral side lobes receive, of scatterers and interfaces."""

    name = "side lobes"

    def __init__(self, device: Device) -> None:
        super().__init__(device)
        self.kernel = device.kernels("side_lobes.cl", device.lanes)["side_lobes"]
        self.lines = EchoLines(device)

    def run(self, frame: DeviceFrame) -> None:
        """Enqueue the side lobes of one frame: a new `scanned`, unless they are off."""
        if not frame.settings.side_lobes:
            return
        lines, samples = frame.line_shape
        before, frame.scanned = frame.scanned, self.lines
        self.lines.prepare(lines, samples)
        power, sigma = lateral_lobes(frame.probe)
        self.device.run(
            self.kernel,
            (samples // self.device.lanes, lines),
            frame.acquisition_buffer,
            before.re,
            before.im,
            self.lines.re,
            self.lines.im,
            np.int32(before.stride),
            np.float32(sigma),
            np.float32(power),
        )

    def work(self, frame: FrameInputs, tree: RayTree) -> Work:
        if not frame.settings.side_lobes:
            return Work(0.0, 0.0)
        lines, samples = frame.line_shape
        depth = np.arange(samples) * float(frame.acquisition["sample_mm"])
        main, (least, slope) = frame.probe.beam_sigma_mm(depth)[0], frame.probe.receive_beam()
        sigma = lateral_lobes(frame.probe)[1] * np.maximum(least, slope * depth)
        step = np.maximum(2.0 * main, frame.probe.line_distance_mm(depth))
        others = np.minimum(2.0 * frame.settings.beam_cutoff * sigma / step, lines)
        return Work(2 * lines * samples * SAMPLE_BYTES, _PER_LINE * lines * float(others.sum()))


def lateral_lobes(probe: Probe) -> tuple[float, float]:
    """(power re the main lobe, sigma of the amplitude re that of the receive beam) of a probe's lateral side lobes."""
    power, sigma = side_lobes_of(probe.receive_apodization, probe.harmonic)
    return power, sigma * FWHM_PER_SIGMA / MAIN_LOBE


def elevational_lobe_record(acquisition: np.ndarray, probe: Probe) -> np.ndarray:
    """The record (layout.ACQUISITION) with which scattering.cl computes what elevational side lobes receive.

    Elements have no apodisation in this direction, and one height. To the square of the main beam's width comes that of
    the lobes of the aperture in its far field, which grow with depth: this is one Gaussian beam again. Its lattice is
    COARSER, with scatterers of its own.
    """
    record = acquisition.copy()
    power, sigma = side_lobes_of(0.0, probe.harmonic)
    waist, focus, rayleigh = (float(acquisition[f"elevation_{name}"]) for name in ("sigma", "focus", "rayleigh"))
    # The square of the width is a z^2 - 2 b z + c.
    a = (waist / rayleigh) ** 2 + (sigma * probe.wavelength_mm / probe.elevation_aperture_mm) ** 2
    b, c = focus * (waist / rayleigh) ** 2, waist**2 * (1.0 + (focus / rayleigh) ** 2)
    least = np.sqrt(c - b**2 / a)
    record["elevation_sigma"], record["elevation_focus"] = least, b / a
    record["elevation_rayleigh"] = least / np.sqrt(a)
    record["cell_mm"] = COARSER * float(acquisition["cell_mm"])
    record["seed"] = stirred(int(acquisition["seed"]) ^ _SEED)
    record["speckle_scale"] = float(acquisition["speckle_scale"]) * np.sqrt(COARSER**3 * power)
    return record


@cache
def side_lobes_of(receive_apodization: float, harmonic: bool = False) -> tuple[float, float]:
    """(power re the main lobe, sigma in received wavelengths x f-number) of the lobes of a two-way beam.

    The transmit aperture is uniform, the receive aperture has the weights 1 - a + a cos(pi x)^2, x from -1/2 to 1/2,
    with a from 0, uniform, to 1, Hann. The power beyond MATCHED is that of the diffraction pattern. The second harmonic
    has the square of the pattern of half its frequency.
    """
    x = (np.arange(512) + 0.5) / 512 - 0.5
    u = np.linspace(0.0, 64.0, 16_385)  # wavelengths x f-number
    weights = 1.0 - receive_apodization + receive_apodization * np.cos(np.pi * x) ** 2
    receive = np.cos(2.0 * np.pi * np.outer(u, x)) @ weights / weights.sum()
    sent = np.sinc(0.5 * u) ** 2 if harmonic else np.sinc(u)
    pattern = (sent * receive) ** 2
    beyond = [float(pattern[u > at].sum() / pattern.sum()) for at in MATCHED]
    # The power of a Gaussian amplitude of this sigma beyond u is erfc(u / sigma).
    ratio = beyond[1] / beyond[0]
    widths = np.geomspace(0.3, _WIDEST, 4096)
    sigma = float(np.interp(ratio, erfc(MATCHED[1] / widths) / erfc(MATCHED[0] / widths), widths))
    return beyond[0] / float(erfc(MATCHED[0] / sigma)), sigma
