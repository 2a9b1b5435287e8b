"""Where labels are: how much of a large label map is looked at, and their centres."""

from __future__ import annotations

import numpy as np

from SlicerUSSim.Logic.base.volume import Volume

#: Voxels from which on places of structures are known well enough
_VOXELS = 2_000_000


def thinning(labels: np.ndarray) -> int:
    """Every so-manieth voxel along each axis of (k, j, i) labels tells where structures are."""
    return max(1, int(np.ceil((labels.size / _VOXELS) ** (1 / 3))))


def label_centres(labels: Volume) -> dict[int, np.ndarray]:
    """{label: its centre in RAS mm} of all labels but 0."""
    step = thinning(labels.array)
    array = labels.array[::step, ::step, ::step]
    where = np.nonzero(array)
    values, inverse, counts = np.unique(array[where], return_inverse=True, return_counts=True)
    ijk = np.stack([np.bincount(inverse, axis) * step / counts for axis in where[::-1]], axis=1)
    ras = ijk @ labels.ijk_to_ras[:3, :3].T + labels.ijk_to_ras[:3, 3]
    return dict(zip(map(int, values), ras, strict=True))
