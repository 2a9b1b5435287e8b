"""Filters of the 3 x 3 x 3 voxels around each, and distances on a grid."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def largest_around(array: np.ndarray) -> np.ndarray:
    """(k, j, i) the largest of each voxel and the 26 around it; of bool, whether one is True.

    Several times faster than a filter of any size.
    """
    return _extreme_around(array, np.maximum)


def smallest_around(array: np.ndarray) -> np.ndarray:
    """As largest_around, the smallest; of bool, whether all are True. Voxels beyond the ends do not count."""
    return _extreme_around(array, np.minimum)


def _extreme_around(array: np.ndarray, extreme: np.ufunc) -> np.ndarray:
    result = array
    for axis in range(3):
        narrow, result = np.moveaxis(result, axis, 0), result.copy()
        wide = np.moveaxis(result, axis, 0)
        extreme(wide[1:], narrow[:-1], out=wide[1:])
        extreme(wide[:-1], narrow[1:], out=wide[:-1])
    return result


def distance_to(target: np.ndarray, spacing: Sequence[float] | np.ndarray = (1.0, 1.0, 1.0)) -> np.ndarray:
    """(k, j, i) float32 distance to the next True voxel; 0 or less in it (Maurer et al., 2003).

    In voxels, or in the unit in which the size of a voxel along i, j and k is given. SimpleITK takes half the time of
    scipy.
    """
    import SimpleITK as sitk

    image = sitk.GetImageFromArray(target.astype(np.uint8))
    image.SetSpacing([float(size) for size in spacing])
    return sitk.GetArrayFromImage(sitk.SignedMaurerDistanceMap(image, squaredDistance=False, useImageSpacing=True))
