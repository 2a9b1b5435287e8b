"""Sulci that are too narrow to reach the intensity of CSF."""

from __future__ import annotations

import itertools
from typing import cast

import numpy as np
from scipy import ndimage


def sulcal_middles(
    filtered: np.ndarray, labels: np.ndarray, grey_label: int, csf_mean: float, grey_mean: float, noise: float
) -> np.ndarray:
    """(k, j, i) True at grey-matter voxels on the middle of a sheet that is closer to CSF than both of its sides.

    Along at least one of the 13 directions of the 26-neighbourhood the voxel must be an extremum compared with both
    neighbours, and differ sufficiently from the first two voxels on either side.
    """
    towards_csf = np.sign(csf_mean - grey_mean)
    # Depth below grey matter. Intensities further from CSF than grey matter count as grey matter; otherwise all cortex
    # would be a valley between white matter on both sides.
    depth = np.where(labels > 0, np.maximum(towards_csf * (filtered - grey_mean), 0), 0).astype(np.float32)
    depth = np.pad(ndimage.gaussian_filter(depth, 0.6), 2)
    flat, steps = depth.ravel(), np.array([depth.shape[1] * depth.shape[2], depth.shape[2], 1])
    grey = np.flatnonzero(np.pad(labels == grey_label, 2))
    here = flat[grey]
    least = max(0.15 * abs(csf_mean - grey_mean), noise)
    is_middle = np.zeros(grey.size, bool)
    for direction in itertools.product((-1, 0, 1), repeat=3):
        if direction <= (0, 0, 0):
            continue  # equivalent to the opposite direction
        step = int(np.dot(direction, steps))
        before, behind = flat[grey - step], flat[grey + step]
        side = np.maximum(np.minimum(before, flat[grey - 2 * step]), np.minimum(behind, flat[grey + 2 * step]))
        is_middle |= (here >= before) & (here >= behind) & (here - side > least)
    result = np.zeros(depth.shape, bool)
    result.ravel()[grey[is_middle]] = True
    return result[2:-2, 2:-2, 2:-2]
