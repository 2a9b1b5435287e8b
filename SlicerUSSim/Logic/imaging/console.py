"""Host code of kernels/console.cl: what a scanner does to the envelope and to grey levels; and its look."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from SlicerUSSim.Logic.base.settings import FULL_SCALE_DB, DisplaySettings
from SlicerUSSim.Logic.imaging.grey_map import TABLE_SIZE, grey_table, is_linear
from SlicerUSSim.Logic.imaging.stage import DeviceFrame, Stage
from SlicerUSSim.Logic.opencl.device import Device
from SlicerUSSim.Logic.probe.arrays import LinearProbe, Probe

if TYPE_CHECKING:
    from pyopencl import Buffer

#: Sigmas at which a Gaussian of the smoothing is cut off, and samples or lines that it has to either side at most
_CUT_OFF, _MOST_TAPS = 2.6, 128
#: Depth by which the near gain falls to 1 / e; on a real sweep of a brain 5 and 8 mm are as good
_NEAR_GAIN_MM = 6.0
#: Of edge enhancement: samples of a line and lines in the mean to either side, and the mean's half length in mm
_EDGE_SAMPLES, _EDGE_LINES, _EDGE_MM = 4, 1, 0.5


class EnvelopeSmoothing(Stage):
    """Smooths the envelope along the lines and across them, after detection and before compression."""

    name = "smoothing"

    def __init__(self, device: Device) -> None:
        super().__init__(device)
        kernels = device.kernels("console.cl", device.lanes)
        self._along, self._across = kernels["smooth_along"], kernels["smooth_across"]
        #: Taps by their standard deviation
        self._taps: dict[float, Buffer] = {}

    def run(self, frame: DeviceFrame) -> None:
        """Enqueue the smoothing: the frame's `envelope`."""
        lines, samples = frame.line_shape
        sigmas = smoothing_sigmas(frame)
        size = samples // self.device.lanes, lines
        for kernel, sigma in zip((self._along, self._across), sigmas, strict=True):
            if sigma == 0.0:
                continue
            smooth = self.device.pooled(4 * lines * samples)
            reach = np.int32(len(gaussian_taps(sigma)) // 2)
            self.device.run(kernel, size, frame.envelope, self._uploaded(sigma), reach, np.int32(samples), smooth)
            frame.envelope = smooth

    def _uploaded(self, sigma: float) -> Buffer:
        if sigma not in self._taps:
            if len(self._taps) > 16:  # a fit tries many
                self._taps.clear()
            self._taps[sigma] = self.device.upload(gaussian_taps(sigma))
        return self._taps[sigma]


class GreyMapping(Stage):
    """Log compression of an envelope that was smoothed, and of any by a grey map."""

    name = "grey map"

    def __init__(self, device: Device) -> None:
        super().__init__(device)
        self.kernel = device.kernels("console.cl", device.lanes)["map_grey"]
        # The table of the last display
        self._made_for: bytes | None = None
        self._table: Buffer

    def run(self, frame: DeviceFrame) -> None:
        """Enqueue the grey levels: the frame's `grey`."""
        if not _maps(frame):
            return
        table = grey_table(frame.display)
        if self._made_for != table.tobytes():
            self._table, self._made_for = self.device.upload(table), table.tobytes()
        lines, samples = frame.line_shape
        grey = self.device.pooled(lines * samples)
        self.device.run(
            self.kernel,
            (samples // self.device.lanes, lines),
            frame.envelope,
            self._table,
            np.int32(TABLE_SIZE),
            np.float32(FULL_SCALE_DB - frame.display.gain_db),
            frame.display_record,
            np.int32(samples),
            grey,
        )
        frame.grey = grey


class EdgeEnhancement(Stage):
    """Adds the difference of grey levels to the mean around them: borders and speckle get sharper."""

    name = "edges"

    def __init__(self, device: Device) -> None:
        super().__init__(device)
        self.kernel = device.kernels("console.cl", device.lanes)["enhance_edges"]

    def run(self, frame: DeviceFrame) -> None:
        """Enqueue the enhancement: the frame's `grey`."""
        if frame.display.edge_enhancement == 0.0:
            return
        lines, samples = frame.line_shape
        sharp = self.device.pooled(lines * samples)
        self.device.run(
            self.kernel,
            (samples // self.device.lanes, lines),
            frame.grey,
            np.int32(samples),
            np.int32(_edge_step(frame)),
            frame.display_record,
            sharp,
        )
        frame.grey = sharp


def smoothing_sigmas(frame: DeviceFrame) -> tuple[float, float]:
    """Sigmas of the smoothing along the lines in samples and across them in lines; 0 for none.

    The lateral one is an angle, at the apex of a sector. On a linear array, whose lines have one distance, it is that
    seen from the depth of the focus.
    """
    display, probe = frame.display, frame.probe
    looks = scanner_looks(display, probe)
    own_mm = sum(share * look.smoothing_cycles for share, look in looks) / float(frame.acquisition["cycles_per_mm"])
    own_deg = sum(share * look.smoothing_deg for share, look in looks)
    along = float(np.hypot(display.smoothing_axial_mm, own_mm)) / float(frame.acquisition["sample_mm"])
    if not np.isinf(probe.apex_radius_mm):  # seen from the face
        focus = probe.focus_mm or probe.depth_mm
        own_deg *= focus / (probe.apex_radius_mm + focus)
    angle = float(np.deg2rad(np.hypot(display.smoothing_lateral_deg, own_deg)))
    if probe.is_linear and probe.focus_mm is not None:
        angle *= probe.focus_mm
    return along if along >= 0.2 else 0.0, across if (across := angle / probe.line_spacing) >= 0.1 else 0.0


def gaussian_taps(sigma: float) -> np.ndarray:
    """(2 reach + 1,) float32 Gaussian of standard deviation `sigma` and sum 1."""
    reach = min(max(int(np.ceil(_CUT_OFF * sigma)), 1), _MOST_TAPS)
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return (taps / taps.sum()).astype(np.float32)


def gains_along(display: DisplaySettings, probe: Probe, depth_mm: np.ndarray) -> np.ndarray:
    """(samples,) dB of the eight sliders of the gain by depth, straight between their middles, near gain and look."""
    sliders = [getattr(display, f"depth_gain_{n}_db") for n in range(1, 9)]
    places = (np.arange(8) + 0.5) / 8.0 * probe.depth_mm
    near = display.near_gain_db * np.exp(-np.maximum(depth_mm, 0.0) / _NEAR_GAIN_MM)
    own = sum(share * look.along(probe, depth_mm) for share, look in scanner_looks(display, probe))
    return np.interp(depth_mm, places, sliders) + near + own


def gains_across(display: DisplaySettings, probe: Probe, lines: int) -> np.ndarray:
    """(lines,) float32 dB of the gain by line: the look's, and what is straight between five knots."""
    knots = [getattr(display, f"line_gain_{n}_db") for n in range(1, 6)]
    own = np.interp(np.linspace(0.0, 1.0, lines), np.linspace(0.0, 1.0, 5), knots)
    own = own + sum(share * look.across(lines) for share, look in scanner_looks(display, probe))
    return own.astype(np.float32)


def _maps(frame: DeviceFrame) -> bool:
    return any(smoothing_sigmas(frame)) or not is_linear(frame.display)


def _edge_step(frame: DeviceFrame) -> int:
    """Samples between those of the mean."""
    return max(round(_EDGE_MM / _EDGE_SAMPLES / float(frame.acquisition["sample_mm"])), 1)


# ---- look: what a scanner adds to the controls of its console, which therefore stand in the middle -------------------


@dataclass(frozen=True)
class Look:
    """The part of a display that is a scanner's own: it adds to gains and smoothing of DisplaySettings."""

    #: (frequency x depth in MHz cm, dB): what compensation leaves of attenuation, straight between these
    by_path: tuple[tuple[float, float], ...] = ((0.0, 0.0),)
    #: dB by scan line, at even distances from the first to the last: contact is poor at the edges
    by_line: tuple[float, ...] = (0.0,)
    #: Sigmas of the envelope's smoothing along the lines, in cycles, and across them
    smoothing_cycles: float = 0.0
    smoothing_deg: float = 0.0

    def along(self, probe: Probe, depth_mm: np.ndarray) -> np.ndarray:
        """(samples,) dB by depth, which do not change with the depth of the image."""
        return np.interp(0.1 * probe.received_mhz * depth_mm, *np.transpose(self.by_path))

    def across(self, lines: int) -> np.ndarray:
        """(lines,) dB."""
        return np.interp(np.linspace(0.0, len(self.by_line) - 1.0, lines), np.arange(len(self.by_line)), self.by_line)


#: Radii of arrays that look through a small window, as the sector of 4.5 mm of the real sweep does, and of those that
#: are laid on an abdomen; between them both looks mix
_SMALL_RADIUS_MM, _LARGE_RADIUS_MM = 15.0, 40.0
_EVEN = Look()
#: From a real sweep of a brain, of a liver, and of a bone (docs/realism.md#look)
_SECTOR = Look(
    ((0.0, 14.0), (5.0, 16.5), (16.5, 11.0), (25.0, -4.5), (33.0, -12.5), (45.0, -11.0)),
    (-5.0, 1.5, 0.0, 0.5, -8.0), 0.27, 0.26,
)  # fmt: skip
_CONVEX = Look(
    ((0.0, 3.0), (6.5, 3.0), (10.5, -3.0), (17.0, -6.0), (30.5, -7.0), (40.0, -12.0)), (-8.0, -1.0, 1.0, 2.0, -4.0),
    0.27, 0.2,
)  # fmt: skip
_LINEAR = Look(((0.0, 3.0), (2.0, 3.0), (9.0, -6.0), (36.0, -8.0)), (-2.5, 0.5, 1.0, 0.0, -2.0), 0.27, 0.2)


def scanner_looks(display: DisplaySettings, probe: Probe) -> tuple[tuple[float, Look], ...]:
    """(share, look) of a display with a probe; the shares add up to 1."""
    if display.look == "even":
        return ((1.0, _EVEN),)
    if isinstance(probe, LinearProbe):  # a trapezoid's radius reaches to where its lines meet
        return ((1.0, _LINEAR),)
    large = float(np.interp(probe.apex_radius_mm, (_SMALL_RADIUS_MM, _LARGE_RADIUS_MM), (0.0, 1.0)))
    return ((1.0 - large, _SECTOR), (large, _CONVEX))
