"""Check: one phenomenon, measured with several probes and orientations; gives rows of a table and a figure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic.probe.arrays import ConvexProbe, LinearProbe, PhasedProbe, Probe

#: Orientations of the phantoms, with their probes, to the voxels: aligned, and two oblique ones.
ORIENTATIONS: dict[str, np.ndarray] = {
    "aligned": np.eye(3),
    "oblique": Rotation.from_euler("xyz", [20, 33, 11], degrees=True).as_matrix(),
    "diagonal": Rotation.from_euler("xyz", [45, 40, 10], degrees=True).as_matrix(),
}

_FOCUS = {"scan_lines": 161, "focus_mm": 30.0, "elevation_focus_mm": 30.0}
PROBES: dict[str, Probe] = {
    "linear": LinearProbe(36.0, 52.0, **_FOCUS),
    "convex": ConvexProbe(60.0, 36.0, 52.0, **_FOCUS),
    "phased": PhasedProbe(70.0, 52.0, directivity="none", **_FOCUS),
}


@dataclass(frozen=True)
class Row:
    """One quantity: predicted and measured value."""

    #: Measured quantity, with the probe or depth
    quantity: str
    unit: str
    predicted: float
    measured: float
    tolerance: float
    #: "within": |measured - predicted| <= tolerance; "at most" and "at least": predicted + or - tolerance is a limit
    kind: str = "within"

    @property
    def passed(self) -> bool:
        """Whether the measured value is within its limits; False if it is not finite."""
        off = self.measured - self.predicted
        if self.kind == "at most":
            return bool(off <= self.tolerance)
        if self.kind == "at least":
            return bool(-off <= self.tolerance)
        return bool(abs(off) <= self.tolerance)

    @property
    def limits(self) -> str:
        """The limits of the measured value as text."""
        if self.kind == "at most":
            return f"≤ {self.predicted + self.tolerance:.3g}"
        if self.kind == "at least":
            return f"≥ {self.predicted - self.tolerance:.3g}"
        return f"± {self.tolerance:.3g}"

    @property
    def strain(self) -> float:
        """Deviation of the measured value as a fraction of its limit: 0 as predicted, 1 at the limit, more fails."""
        if np.isnan(self.measured):  # the echo to measure was missing
            return float("inf")
        if self.kind == "within":
            off = abs(self.measured - self.predicted)
            return off / self.tolerance if self.tolerance > 0 else float(off > 0)
        limit = self.predicted + (self.tolerance if self.kind == "at most" else -self.tolerance)
        pair = (self.measured, limit) if self.kind == "at most" else (limit, self.measured)
        # If both have the same sign, the fraction of the limit; otherwise only 0 or 1.
        return pair[0] / pair[1] if min(pair) > 0 else float(not self.passed)


@dataclass(frozen=True, eq=False)
class Outcome:
    """The result of one check in one orientation."""

    rows: tuple[Row, ...]
    #: Writes the figure to a path; None if there is none
    draw: Callable[[Path], None] | None = None


@dataclass(frozen=True)
class Check:
    """One phenomenon. `measure(rotation, device)` returns an Outcome."""

    name: str
    #: The theoretical prediction, in one line
    claim: str
    measure: Callable[[np.ndarray, object], Outcome]
    orientations: tuple[str, ...] = tuple(ORIENTATIONS)

    @property
    def picture(self) -> str:
        """File name of its figure, if it draws one."""
        return f"{self.name.replace(' ', '-')}.png"
