"""Filters of the 3 x 3 x 3 voxels around each."""

from __future__ import annotations

import numpy as np


def largest_around(array: np.ndarray) -> np.ndarray:
    """(k, j, i) the largest of each voxel and the 26 around it; of bool, whether one is True.

    Several times faster than a filter of any size.
    """
    result = array
    for axis in range(3):
        narrow, result = np.moveaxis(result, axis, 0), result.copy()
        wide = np.moveaxis(result, axis, 0)
        np.maximum(wide[1:], narrow[:-1], out=wide[1:])
        np.maximum(wide[:-1], narrow[1:], out=wide[:-1])
    return result
