"""Host side of kernels/bmode.cl: pulse, noise, time-gain compensation, envelope, log compression, eight bits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from SlicerUSSim.Logic.base.settings import FULL_SCALE_DB, DisplaySettings
from SlicerUSSim.Logic.imaging.noise import noise_key
from SlicerUSSim.Logic.imaging.scattering import EchoLines
from SlicerUSSim.Logic.opencl.device import Device, Workspace
from SlicerUSSim.Logic.opencl.layout import CONSTANTS

if TYPE_CHECKING:
    from pyopencl import Buffer


@dataclass(frozen=True, eq=False)
class BasebandSignal:
    """A complex baseband signal on the device, of whole blocks of samples."""

    #: float2 [line][sample]
    iq: Buffer
    lines: int
    samples: int


class PulseFilter:
    """Convolves the impulses with the envelope of the pulse; the result is the complex baseband signal."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self.kernel = device.kernels("bmode.cl", device.lanes)["convolve_pulse"]
        self.workspace = Workspace(device)
        self._sigma: float | None = None
        # Of the pulse with that sigma, and of the frame convolved last
        self._pulse: Buffer
        self._reach: int
        self.signal: BasebandSignal
        #: What the signal was made for, if whoever made it says so (UltrasoundSimulator.render)
        self.made_for: object = None

    def run(self, acquisition: np.ndarray, axial_sigma_mm: float, lines: EchoLines) -> None:
        """Enqueue the convolution of every line."""
        self.made_for = None
        sigma = axial_sigma_mm / float(acquisition["sample_mm"])
        if sigma != self._sigma:
            taps = pulse_taps(sigma)
            self._pulse, self._reach, self._sigma = self.device.upload(taps), taps.size // 2, sigma
        count, samples = int(acquisition["scan_lines"]), int(acquisition["samples"])
        iq = self.workspace.get("iq", count * samples * 8)
        self.signal = BasebandSignal(iq, count, samples)
        self.device.run(
            self.kernel,
            (samples // self.device.lanes, count),
            lines.re,
            lines.im,
            np.int32(lines.stride),
            self._pulse,
            np.int32(self._reach),
            iq,
            np.int32(samples),
        )

    def download(self, samples: int) -> np.ndarray:
        """(scan_lines, samples) complex64 baseband signal of the frame convolved last."""
        signal = self.signal
        return self.device.download(signal.iq, (signal.lines, signal.samples), np.complex64)[:, :samples]


class Compressor:
    """Noise, TGC, envelope and log compression to eight bits."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self.kernel = device.kernels("bmode.cl", device.lanes)["compress"]
        self.workspace = Workspace(device)
        # Of the frame compressed last: its size, float32 and uint8 [line][sample]
        self.lines: int
        self.samples: int
        self.envelope: Buffer
        self.grey: Buffer

    def run(
        self, acquisition: np.ndarray, display: DisplaySettings, signal: BasebandSignal, noise_seed: int = 0
    ) -> None:
        """Enqueue the grey levels of every line; `noise_seed` is the draw of the noise."""
        self.lines, self.samples = signal.lines, signal.samples
        self.envelope = self.workspace.get("envelope", self.lines * self.samples * 4)
        self.grey = self.workspace.get("grey", self.lines * self.samples)
        # Two ways through `sample_mm` of depth each sample, in cm.
        tgc = 2.0 * display.tgc_db_cm_mhz * float(acquisition["frequency_mhz"]) * float(acquisition["sample_mm"]) * 0.1
        # Noise power is shared between the two quadrature components.
        noise = 0.0 if display.noise_db is None else 10.0 ** (display.noise_db / 20.0) / np.sqrt(2.0)
        self.device.run(
            self.kernel,
            (self.samples // self.device.lanes, self.lines),
            signal.iq,
            np.int32(self.samples),
            np.float32(noise),
            np.uint32(noise_key(acquisition, noise_seed)),
            np.float32(tgc),
            np.float32(FULL_SCALE_DB - display.gain_db),
            np.float32(display.dynamic_range_db),
            self.envelope,
            self.grey,
        )

    def download(self, samples: int) -> tuple[np.ndarray, np.ndarray]:
        """(envelope float32, grey uint8), both (scan_lines, samples), of the frame compressed last."""
        shape = self.lines, self.samples
        envelope = self.device.download(self.envelope, shape, np.float32)[:, :samples]
        return envelope, self.device.download(self.grey, shape, np.uint8)[:, :samples]


def pulse_taps(sigma: float) -> np.ndarray:
    """(2 reach + 1,) float32 Gaussian of standard deviation `sigma` samples and height 1.

    Impulses are placed between samples by linear interpolation, which convolves them with a triangle of variance 1/6 on
    average; the taps are narrower by that much so that the whole has the width asked for.
    """
    narrowed = np.sqrt(max(sigma**2 - 1.0 / 6.0, 0.25))
    reach = int(np.ceil(3.7 * narrowed))
    assert reach <= CONSTANTS["LINE_PAD"], "the bounds of Probe and SimulationSettings keep every pulse within the pad"
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / narrowed) ** 2)
    return (taps * sigma / narrowed).astype(np.float32)
