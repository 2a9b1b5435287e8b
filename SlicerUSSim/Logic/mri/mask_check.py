"""Do labels and an MRI belong to one patient? Intensities then change where labels do."""

from __future__ import annotations

import itertools

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.volume import Volume

#: Labelled voxels that are looked at; the share of them that has to lie in the MRI
_SAMPLES, _LEAST_INSIDE = 40_000, 0.5
#: The labels are moved by so much along either direction of the three axes, for comparison
_MOVED_MM = 6.0
#: How many times as much of the variance of the intensities they explain in their place as in the best other place:
#: 3.5 to 28 of a patient's own (also those of another contrast: 4.3 and 10.6), at most 1.4 of another head's that was
#: registered to the same template
_LEAST_GAIN = 2.0


def follows(mri: Volume, labels: Volume) -> bool:
    """Whether the intensities of an MRI follow labels, as those of the same head in the same frame do.

    Measured by the share of the variance of the intensities that is between tissues (the correlation ratio of Roche et
    al., "The correlation ratio as a new similarity measure for multimodal image registration", MICCAI 1998), in the
    labels' place and 6 mm beside it. False also where nothing can be seen, as with labels of one tissue.

    Parameters
    ----------
    mri : (k, j, i) intensities.
    labels : (k, j, i) tissues, 0 is none; on any grid.
    """
    places = np.argwhere(labels.array > 0)
    if not len(places):
        return False
    places = places[np.random.default_rng(0).integers(len(places), size=_SAMPLES)]
    tissues = labels.array[tuple(places.T)]
    points = places[:, ::-1] @ labels.ijk_to_ras[:3, :3].T + labels.ijk_to_ras[:3, 3]
    steps = [np.eye(3)[axis] * way * _MOVED_MM for axis, way in itertools.product(range(3), (-1, 1))]
    beside = max(_explained(mri, points + step, tissues) for step in steps)
    return _explained(mri, points, tissues) > _LEAST_GAIN * beside


def _explained(mri: Volume, points: np.ndarray, tissues: np.ndarray) -> float:
    """Share of the variance of the intensities at points [mm RAS] that is between tissues; 0 outside the MRI."""
    index = points @ mri.ras_to_ijk[:3, :3].T + mri.ras_to_ijk[:3, 3]
    inside = ((index > -0.5) & (index < np.array(mri.array.shape[::-1]) - 0.5)).all(axis=1)
    if inside.mean() < _LEAST_INSIDE:
        return 0.0
    values = ndimage.map_coordinates(mri.array, index[inside, ::-1].T, np.float32, order=1, mode="nearest")
    values = np.clip(values, *np.percentile(values, [1.0, 99.0]))  # not led by a few bright vessels
    tissues = np.unique(tissues[inside], return_inverse=True)[1]
    counts = np.bincount(tissues)
    means = np.bincount(tissues, values) / counts
    total = float(((values - values.mean()) ** 2).sum())
    return float((counts * (means - values.mean()) ** 2).sum()) / total if total > 0.0 else 0.0
