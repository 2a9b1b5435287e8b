"""What a check is: one phenomenon, measured with some probes in some orientations; rows of a table and a picture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic.probe.arrays import ConvexProbe, LinearProbe, PhasedProbe, Probe

#: How the phantoms, and the probes with them, lie on the voxels: along them, and two oblique ways.
ORIENTATIONS: dict[str, np.ndarray] = {
    "aligned": np.eye(3),
    "oblique": Rotation.from_euler("xyz", [20, 33, 11], degrees=True).as_matrix(),
    "diagonal": Rotation.from_euler("xyz", [45, 40, 10], degrees=True).as_matrix(),
}

_FOCUS = {"scan_lines": 161, "focus_mm": 30.0, "elevation_focus_mm": 30.0}
PROBES: dict[str, Probe] = {
    "linear": LinearProbe(36.0, 52.0, **_FOCUS),
    "convex": ConvexProbe(60.0, 36.0, 52.0, **_FOCUS),
    "phased": PhasedProbe(70.0, 52.0, **_FOCUS),
}


@dataclass(frozen=True)
class Row:
    """One number: what theory predicts and what was measured."""

    #: What is measured, and on which probe or at which depth
    quantity: str
    unit: str
    predicted: float
    measured: float
    tolerance: float
    #: "within": |measured - predicted| <= tolerance; "at most" and "at least": predicted + or - tolerance is a limit
    kind: str = "within"

    @property
    def passed(self) -> bool:
        """Whether the measured number is as predicted; not for one that is not finite."""
        off = self.measured - self.predicted
        if self.kind == "at most":
            return bool(off <= self.tolerance)
        if self.kind == "at least":
            return bool(-off <= self.tolerance)
        return bool(abs(off) <= self.tolerance)

    @property
    def limits(self) -> str:
        """What the measured number may be, in words."""
        if self.kind == "at most":
            return f"≤ {self.predicted + self.tolerance:.3g}"
        if self.kind == "at least":
            return f"≥ {self.predicted - self.tolerance:.3g}"
        return f"± {self.tolerance:.3g}"

    @property
    def strain(self) -> float:
        """How near the measured number is to its limit: 0 as predicted, 1 at the limit, above it failed."""
        if np.isnan(self.measured):  # what was to be measured was not there
            return float("inf")
        if self.kind == "within":
            off = abs(self.measured - self.predicted)
            return off / self.tolerance if self.tolerance > 0 else float(off > 0)
        limit = self.predicted + (self.tolerance if self.kind == "at most" else -self.tolerance)
        pair = (self.measured, limit) if self.kind == "at most" else (limit, self.measured)
        # Of numbers of one sign, the share of the limit; a limit of zero or of another sign says only yes or no.
        return pair[0] / pair[1] if min(pair) > 0 else float(not self.passed)


@dataclass(frozen=True, eq=False)
class Outcome:
    """What one check found in one orientation."""

    rows: tuple[Row, ...]
    #: Writes the picture to a path; None where there is nothing to see
    draw: Callable[[Path], None] | None = None


@dataclass(frozen=True)
class Check:
    """One phenomenon. `measure(rotation, device)` gives an Outcome."""

    name: str
    #: What theory says, in one line
    claim: str
    measure: Callable[[np.ndarray, object], Outcome]
    orientations: tuple[str, ...] = tuple(ORIENTATIONS)
