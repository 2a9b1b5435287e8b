"""Distances in voxels, by SimpleITK, whose transform takes half the time of scipy's."""

from __future__ import annotations

import numpy as np


def distance_to(target: np.ndarray) -> np.ndarray:
    """(k, j, i) float32 distance to the next True voxel, in voxels; 0 or less in it (Maurer et al., 2003)."""
    import SimpleITK as sitk

    image = sitk.GetImageFromArray(target.astype(np.uint8))
    return sitk.GetArrayFromImage(sitk.SignedMaurerDistanceMap(image, False, False, False))
