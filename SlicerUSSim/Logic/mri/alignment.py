"""Rigid registration of several volumes of one patient."""

from __future__ import annotations

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.volume import Volume


def aligned(other: Volume, reference: Volume, inside: np.ndarray, name: str) -> tuple[Volume, str]:
    """(the other volume on the grid of the reference, a line that says how it was moved)."""
    raise SimulationError("several volumes are not supported yet")
