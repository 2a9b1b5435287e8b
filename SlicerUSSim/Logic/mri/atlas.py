"""The atlas: the MNI152 template and its tissue maps, in mni152.npz; mni152.txt has its copyright notice."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.volume import Volume

_FILE = Path(__file__).with_name("mni152.npz")
#: RAS mm of its first voxel
_ORIGIN = (-98.0, -134.0, -72.0)


@dataclass(frozen=True, eq=False)
class Atlas:
    """A skull-stripped T1 and the share of each tissue in every voxel, on one grid."""

    #: 0 outside the brain
    t1: Volume
    #: float32, 0 to 1; the three add up to 1 in the brain
    csf: Volume
    grey: Volume
    white: Volume


@cache
def mni152() -> Atlas:
    """The MNI152 2009a template at 1 mm (Fonov et al., NeuroImage 54(1), 2011); the file has the left half of it."""
    with np.load(_FILE) as halves:
        t1, *counts = (_both_sides(halves[name]) for name in ("t1", "grey", "white"))
    grey, white = (count.astype(np.float32) / 255.0 for count in counts)
    csf = np.where(t1 > 0, np.clip(1.0 - grey - white, 0.0, 1.0), np.float32(0.0))
    ijk_to_ras = np.eye(4)
    ijk_to_ras[:3, 3] = _ORIGIN
    return Atlas(*(Volume(array, ijk_to_ras) for array in (t1, csf, grey, white)))


def _both_sides(half: np.ndarray) -> np.ndarray:
    """(k, j, 2 i - 1) of (k, j, i) up to and with the plane of symmetry."""
    return np.concatenate([half, half[:, :, -2::-1]], axis=2)
