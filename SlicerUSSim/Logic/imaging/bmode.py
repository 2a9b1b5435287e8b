"""Host side of kernels/bmode.cl: pulse, noise, time-gain compensation, envelope, log compression, eight bits;
and of kernels/scan_conversion.cl: from scan lines to pixels."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.special import log_ndtr

from SlicerUSSim.Logic.base.settings import FULL_SCALE_DB
from SlicerUSSim.Logic.imaging.console import gains_across, gains_along
from SlicerUSSim.Logic.imaging.noise import noise_key
from SlicerUSSim.Logic.imaging.stage import SAMPLE_BYTES, DeviceFrame, Stage
from SlicerUSSim.Logic.opencl.device import Device, Workspace
from SlicerUSSim.Logic.opencl.layout import CONSTANTS
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.beam import FWHM_PER_SIGMA

if TYPE_CHECKING:
    from pyopencl import Buffer

#: Standard deviations of a pulse beyond which nothing is left of it
_PULSE_SIGMAS = 8.0
#: Decibels of amplitude in a neper
DB_PER_NEPER = 20.0 / np.log(10.0)


class PulseFilter(Stage):
    """Convolves the impulses with the envelope of the pulse; the result is the complex baseband signal."""

    name = "pulse"

    def __init__(self, device: Device) -> None:
        super().__init__(device)
        self.kernel = device.kernels("bmode.cl", device.lanes)["convolve_pulse"]
        self._shift = device.kernels("downshift.cl", device.lanes)["shift_frequency"]
        self.workspace = Workspace(device)
        self._level = device.kernels("harmonic.cl", device.lanes)["apply_level"]
        #: What levels along the lines depend on, and their buffer
        self._levels: tuple[tuple, Buffer] | None = None
        self._sigma: float | None = None
        # Taps of the pulse with this sigma
        self._pulse: Buffer
        self._reach: int

    def run(self, frame: DeviceFrame) -> None:
        """Enqueue the convolution of every line: the frame's `iq`. Its impulses get the frequency of their depth."""
        sigma = frame.axial_sigma_mm / float(frame.acquisition["sample_mm"])
        if sigma != self._sigma:
            taps = pulse_taps(sigma)
            self._pulse, self._reach, self._sigma = self.device.upload(taps), taps.size // 2, sigma
        lines, samples = frame.line_shape
        frame.iq = self.device.pooled(lines * samples * SAMPLE_BYTES)
        if frame.acquisition["downshift"] > 0.0:
            self.device.run(
                self._shift,
                (samples // self.device.lanes, lines),
                frame.acquisition_buffer,
                frame.losses,
                frame.scanned.re,
                frame.scanned.im,
                np.int32(frame.scanned.stride),
            )
        if frame.probe.harmonic or frame.contact is not None or frame.probe.line_levels() is not None:
            self._apply_level(frame)
        self.device.run(
            self.kernel,
            (samples // self.device.lanes, lines),
            frame.scanned.re,
            frame.scanned.im,
            np.int32(frame.scanned.stride),
            self._pulse,
            np.int32(self._reach),
            frame.acquisition_buffer,
            frame.losses,
            frame.iq,
            np.int32(samples),
        )

    def _apply_level(self, frame: DeviceFrame) -> None:
        lines, samples = frame.line_shape
        key = frame.probe, samples, float(frame.acquisition["sample_mm"])
        if self._levels is None or self._levels[0] != key:
            levels = np.ones(samples, np.float32)
            if frame.probe.harmonic:
                levels = frame.probe.harmonic_level(np.arange(samples) * key[2]).astype(np.float32)
            self._levels = key, self.device.upload(levels)
        of_lines = np.ones(lines, np.float32)
        for factor in (frame.contact, frame.probe.line_levels()):
            of_lines *= 1.0 if factor is None else factor
        buffer = self.workspace.get("of_lines", of_lines.nbytes)
        self.device.write(buffer, of_lines)
        self.device.run(
            self._level,
            (samples // self.device.lanes, lines),
            frame.acquisition_buffer,
            self._levels[1],
            buffer,
            frame.scanned.re,
            frame.scanned.im,
            np.int32(frame.scanned.stride),
        )


def downshift(probe: Probe) -> float:
    """Part of the centre frequency that a pulse loses per neper of two-way loss: (sf / f0)^2 of its Gaussian band."""
    return (probe.received_bandwidth / FWHM_PER_SIGMA) ** 2


def log_band_above(shift: float) -> float:
    """log erfc(-f0 / sf) of the transmitted band, whose `shift` comes from `downshift`: twice its part above zero."""
    return float(np.log(2.0) + log_ndtr(np.sqrt(2.0 / shift))) if shift else float(np.log(2.0))


def gain_of_band(shift: float, loss: np.ndarray) -> np.ndarray:
    """By how many nepers the band of a pulse has more amplitude than its centre alone, after `loss` nepers both ways.

    `shift` as for `downshift`, 0 for a single frequency. Only frequencies above zero count: the Gaussian spectrum
    about 1 - shift loss has the part erfc(-z) / 2 of its power there, z in its widths
    (docs/physics.md#frequency-that-falls-with-depth).
    """
    if shift == 0.0:
        return np.zeros_like(loss)
    z = (1.0 - shift * loss) / np.sqrt(shift)
    parts = log_ndtr(np.sqrt(2.0) * z) - log_ndtr(np.sqrt(2.0 / shift))
    return 0.5 * (shift * loss**2 + parts)


class Compressor(Stage):
    """Noise, TGC, envelope and log compression to eight bits."""

    name = "B-mode"

    def __init__(self, device: Device) -> None:
        super().__init__(device)
        self.kernel = device.kernels("bmode.cl", device.lanes)["compress"]
        #: What the ring-down depends on, and its buffer
        self._ringing: tuple[tuple, Buffer] | None = None
        #: Likewise of the time-gain compensation
        self._gains: tuple[tuple, Buffer] | None = None
        #: Of the gain by line
        self._across: tuple[tuple, Buffer] | None = None

    def run(self, frame: DeviceFrame) -> None:
        """Enqueue the grey levels of every line: the frame's `envelope` and `grey`."""
        display, acquisition, (lines, samples) = frame.display, frame.acquisition, frame.line_shape
        frame.envelope = self.device.pooled(lines * samples * 4)
        frame.grey = self.device.pooled(lines * samples)
        # Noise power is shared between the two quadrature components.
        noise = 0.0 if display.noise_db is None else 10.0 ** (display.noise_db / 20.0) / np.sqrt(2.0)
        self.device.run(
            self.kernel,
            (samples // self.device.lanes, lines),
            frame.acquisition_buffer,
            frame.iq,
            np.int32(samples),
            self._ring_down(frame),
            np.float32(noise),
            np.uint32(noise_key(acquisition, frame.noise_seed)),
            self._compensation(frame),
            self._line_gains(frame),
            np.float32(FULL_SCALE_DB - display.gain_db),
            frame.display_record,
            frame.envelope,
            frame.grey,
        )

    def _ring_down(self, frame: DeviceFrame) -> Buffer:
        """complex64 [sample], the same for all lines."""
        probe, samples, sigma = frame.probe, frame.line_shape[1], frame.axial_sigma_mm
        sample_mm, cycles_per_mm = (float(frame.acquisition[name]) for name in ("sample_mm", "cycles_per_mm"))
        key = (probe, frame.settings.ring_down, samples, sigma, sample_mm, cycles_per_mm)
        if self._ringing is None or self._ringing[0] != key:
            signal = ring_down(probe, np.arange(samples) * sample_mm, sigma, cycles_per_mm)
            self._ringing = key, self.device.upload(signal * frame.settings.ring_down)
        return self._ringing[1]

    def _compensation(self, frame: DeviceFrame) -> Buffer:
        """float32 [sample] dB of time-gain compensation, from where a line leaves the face."""
        display, probe, samples = frame.display, frame.probe, frame.line_shape[1]
        sample_mm, mhz, shift = (float(frame.acquisition[n]) for n in ("sample_mm", "frequency_mhz", "downshift"))
        key = display, probe, samples, sample_mm, mhz, shift
        if self._gains is None or self._gains[0] != key:
            depth_mm, rises_mm = np.arange(samples) * sample_mm, display.tgc_reach * probe.depth_mm
            sliders = gains_along(display, probe, depth_mm)
            path_cm = 0.2 * np.minimum(depth_mm, rises_mm)  # both ways
            loss = display.tgc_db_cm_mhz * mhz * path_cm / DB_PER_NEPER
            gains = DB_PER_NEPER * (loss - gain_of_band(shift, loss))
            self._gains = key, self.device.upload((gains + sliders).astype(np.float32))
        return self._gains[1]

    def _line_gains(self, frame: DeviceFrame) -> Buffer:
        """float32 [scan line] dB."""
        key = frame.display, frame.probe, frame.line_shape[0]
        if self._across is None or self._across[0] != key:
            self._across = key, self.device.upload(gains_across(*key))
        return self._across[1]


def ring_down(probe: Probe, depth_mm: np.ndarray, axial_sigma_mm: float, cycles_per_mm: float) -> np.ndarray:
    """(samples,) complex64 baseband signal of the pulse that bounces between the face's layers and the skin.

    One echo a pulse length after the other, each weaker by the same factor and of the other sign, since one of the two
    borders is harder than the tissue between them. It falls by 40 dB over the probe's ring_down_mm.
    """
    if probe.ring_down_mm == 0.0:
        return np.zeros(len(depth_mm), np.complex64)
    apart_mm = FWHM_PER_SIGMA * axial_sigma_mm
    places = np.arange(0.0, 2.0 * probe.ring_down_mm, apart_mm)
    level_db = probe.ring_down_db - 40.0 * places / probe.ring_down_mm
    echoes = 10.0 ** (level_db / 20.0) * (-1.0) ** np.arange(len(places)) * np.exp(-2j * np.pi * cycles_per_mm * places)
    ringing = np.zeros(len(depth_mm), np.complex64)
    near_mm = depth_mm[depth_mm < places[-1] + _PULSE_SIGMAS * axial_sigma_mm]
    pulses = np.exp(-0.5 * ((near_mm[:, None] - places) / axial_sigma_mm) ** 2)
    level = probe.harmonic_level(near_mm) if probe.harmonic else 1.0
    ringing[: len(near_mm)] = level * (pulses * echoes).sum(axis=1)  # no BLAS: its threads wait for those of the device
    return ringing


def pulse_taps(sigma: float) -> np.ndarray:
    """(2 reach + 1,) float32 Gaussian of standard deviation `sigma` samples and height 1.

    Impulses are placed between samples by linear interpolation, which convolves them with a triangle of variance 1/6 on
    average. The variance of the taps is reduced by this value, so that the result has the specified width.
    """
    narrowed = np.sqrt(max(sigma**2 - 1.0 / 6.0, 0.25))
    reach = int(np.ceil(3.7 * narrowed))
    assert reach <= CONSTANTS["LINE_PAD"], "the bounds of Probe and SimulationSettings keep every pulse within the pad"
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / narrowed) ** 2)
    return (taps * sigma / narrowed).astype(np.float32)


# ---- from scan lines to pixels (kernels/scan_conversion.cl) ----------------------------------------------------------


class ScanConverter(Stage):
    """Interpolates the grey levels of the scan lines at the pixels of an ImageGrid."""

    name = "scan conversion"

    def __init__(self, device: Device) -> None:
        super().__init__(device)
        self.average = device.kernels("bmode.cl", device.lanes)["average_depth"]
        self.convert = device.kernels("scan_conversion.cl", device.lanes)["scan_convert"]
        self.workspace = Workspace(device)

    def run(self, frame: DeviceFrame) -> None:
        """Enqueue the conversion of one frame: its `image`."""
        grid, (lines, samples) = frame.grid, frame.line_shape
        sample_mm = float(frame.acquisition["sample_mm"])
        frame.image = self.workspace.get("image", grid.rows * grid.columns)
        smooth = self.workspace.get("smooth", lines * samples)
        self.device.run(
            self.average,
            (samples // self.device.lanes, lines),
            frame.grey,
            smooth,
            np.int32(samples),
            np.int32(np.ceil(float(frame.acquisition["depth_mm"]) / sample_mm)),
            np.int32(max(round(grid.pixel_spacing_mm[1] / sample_mm), 1)),
        )
        self.device.run(
            self.convert,
            (-(-grid.columns // self.device.lanes), grid.rows),
            frame.acquisition_buffer,
            smooth,
            np.float32(grid.left_mm),
            np.float32(grid.top_mm),
            np.float32(grid.pixel_spacing_mm[0]),
            np.float32(grid.pixel_spacing_mm[1]),
            np.int32(grid.columns),
            frame.image,
        )
