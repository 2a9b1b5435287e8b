"""Distances on a grid, by SimpleITK, whose transform takes half the time of scipy's."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def distance_to(target: np.ndarray, spacing: Sequence[float] | np.ndarray = (1.0, 1.0, 1.0)) -> np.ndarray:
    """(k, j, i) float32 distance to the next True voxel; 0 or less in it (Maurer et al., 2003).

    In voxels, or in the unit in which the size of a voxel along i, j and k is given.
    """
    import SimpleITK as sitk

    image = sitk.GetImageFromArray(target.astype(np.uint8))
    image.SetSpacing([float(size) for size in spacing])
    return sitk.GetArrayFromImage(sitk.SignedMaurerDistanceMap(image, squaredDistance=False, useImageSpacing=True))
