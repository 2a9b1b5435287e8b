"""Where labels are: how much of a large label map is looked at, their centres, and whether they lie apart."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from SlicerUSSim.Logic.base.volume import Volume

#: Voxels from which on places of structures are known well enough
_VOXELS = 2_000_000
#: 0.12 and 0.24 in the tissues of a brain and of a head, 2.8 and more in an atlas of regions
_APART = 0.6

#: {label: (its centre, its standard deviation along R, A and S), in mm}
Places = dict[int, tuple[np.ndarray, np.ndarray]]


def thinning(labels: np.ndarray) -> int:
    """Every so-manieth voxel along each axis of (k, j, i) labels tells where structures are."""
    return max(1, int(np.ceil((labels.size / _VOXELS) ** (1 / 3))))


def label_places(labels: Volume) -> Places:
    """{label: (its centre, its standard deviation along R, A and S), in mm} of all labels but 0."""
    step = thinning(labels.array)
    array = labels.array[::step, ::step, ::step]
    where = np.nonzero(array)
    values, inverse, counts = np.unique(array[where], return_inverse=True, return_counts=True)
    ijk = np.stack(where[::-1], axis=1) * float(step)
    ras = ijk @ labels.ijk_to_ras[:3, :3].T + labels.ijk_to_ras[:3, 3]
    centres = np.stack([np.bincount(inverse, axis) / counts for axis in ras.T], axis=1)
    squares = np.stack([np.bincount(inverse, axis) / counts for axis in ((ras - centres[inverse]) ** 2).T], axis=1)
    places = zip(centres, np.sqrt(squares), strict=True)
    return dict(zip(map(int, values), places, strict=True))


def centres_of(places: Places) -> dict[int, np.ndarray]:
    """The centres alone."""
    return {label: centre for label, (centre, _) in places.items()}


def lie_apart(places: Places) -> bool:
    """Whether most labels lie beside each other, as organs do, and not around each other, as the tissues of a head do.

    Two lie beside each other if their centres are further apart along R, A or S than a part of what their voxels
    deviate from these.
    """
    distances = [
        np.max(np.abs(one - other) / np.maximum(spread + other_spread, 1e-9))
        for (one, spread), (other, other_spread) in combinations(places.values(), 2)
    ]
    return not distances or float(np.median(distances)) >= _APART
