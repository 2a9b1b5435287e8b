"""What a scanner adds to the controls of its console, which therefore stand in the middle (docs/realism.md#look)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from SlicerUSSim.Logic.base.settings import DisplaySettings
from SlicerUSSim.Logic.probe.arrays import Probe


@dataclass(frozen=True)
class Look:
    """The part of a display that is a scanner's own: it adds to gains and smoothing of DisplaySettings."""

    #: (frequency x depth in MHz cm, dB): what is left of attenuation, straight between these and even beyond
    by_path: tuple[tuple[float, float], ...] = ((0.0, 0.0),)
    #: dB by scan line, at even distances from the first to the last: contact is poor at the edges
    by_line: tuple[float, ...] = (0.0,)
    #: Sigmas of the envelope's smoothing along the lines, in wavelengths of 1540 m/s, and across them
    smoothing_wavelengths: float = 0.0
    smoothing_deg: float = 0.0

    def along(self, depth_mm: np.ndarray, frequency_mhz: float) -> np.ndarray:
        """(samples,) dB by depth."""
        path, gain_db = np.transpose(self.by_path)
        return np.interp(0.1 * frequency_mhz * depth_mm, path, gain_db)

    def across(self, lines: int) -> np.ndarray:
        """(lines,) dB."""
        knots = len(self.by_line)
        return np.interp(np.linspace(0.0, 1.0, lines), np.linspace(0.0, 1.0, knots), self.by_line)


EVEN = Look()
#: By kind of probe; with their sources in docs/realism.md#look
SCANNERS = {
    "phased": Look(
        ((0.0, 13.0), (5.0, 15.5), (16.5, 10.0), (25.0, -3.0), (37.0, -16.0)), (-11.0, 1.0, -1.0, 2.0, -10.0),
        0.27, 0.26,
    ),
    "convex": Look(
        ((0.0, 3.0), (8.0, 3.0), (13.0, -3.0), (21.0, -6.0), (38.0, -7.0), (50.0, -12.0)),
        (-8.0, -1.0, 1.0, 2.0, -4.0), 0.27, 0.2,
    ),
    "linear": Look(((0.0, 3.0), (2.0, 3.0), (9.0, -6.0), (36.0, -8.0)), (-2.5, 0.5, 1.0, 0.0, -2.0), 0.27, 0.2),
}  # fmt: skip


def look_of(display: DisplaySettings, probe: Probe) -> Look:
    """The look of a display with a probe."""
    return EVEN if display.look == "even" else SCANNERS[probe.kind]
