"""The outer surface of the skull: a smooth layer over the brain, on the border from dark bone to bright scalp.

Voxel by voxel the outer table of the skull is not to be seen: it is as thin as a voxel, and between marrow and fat,
which are both bright. A skull is smooth, though, so that its thickness over the brain is found for all places together:
where the image rises from dark to bright outward, near the usual thickness, and alike in neighbours. The profiles along
normals of the brain are those of Smith, "Fast robust automated brain extraction" (Human Brain Mapping 17, 2002).
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array, csr_array
from scipy.spatial import KDTree

from SlicerUSSim.Logic.base.neighbourhood import distance_to

#: Places over the brain, mm apart, and thicknesses that are tried, mm
_PLACES_MM, _STEP_MM = 4.0, 0.5
LEAST_MM, LARGEST_MM = 2.5, 14.0
#: Usual distance from the brain's surface to that of the skull with what is between, and its deviation over heads and
#: places (skulls of adults: 3 mm at the temples to 9 mm at the back; Lillie et al., Journal of Anatomy 228, 2016)
_USUAL_MM, _DEVIATION_MM = 5.5, 3.0
#: A border is looked for across this
_ACROSS_MM = 1.5
#: What it costs that there is bone farther out, but below the skin
_NOT_OUTERMOST, _SKIN_MM = 1.0, 2.0
#: The brain's surface looks down below this (the upward part of its normal)
_BASE = -0.3
#: Weight of the usual thickness; reach in mm and weight per mm^2 of the neighbours, from the first rounds to the last
_PRIOR, _NEIGHBOURS, _ROUNDS = 0.15, ((15.0, 0.1), (10.0, 0.08), (5.0, 0.06)), 20


def thickness_of_skull(
    image: np.ndarray, inner: np.ndarray, below_skin: np.ndarray, dark: float, mm: np.ndarray, ijk_to_ras: np.ndarray
) -> np.ndarray:
    """(k, j, i) float32 mm from the brain to the outer surface of the skull over the nearest place of the brain.

    NaN below the brain, where the base of the skull is neither smooth nor of even thickness.

    Parameters
    ----------
    image : (k, j, i) intensity, T1.
    inner : (k, j, i) bool, the brain with the dura.
    below_skin : (k, j, i) mm below the surface of the head, 0 outside.
    dark : intensity below which it is bone or air.
    mm : (3,) voxel size along i, j, k.
    ijk_to_ras : (4, 4), from which is known where is up.
    """
    step = mm[::-1]
    points, outward = _places(inner, mm)
    depth = np.arange(0.0, LARGEST_MM + _ACROSS_MM + 0.1, _STEP_MM)
    along = ((points[:, None] + depth[None, :, None] * outward[:, None]) / step).reshape(-1, 3).T

    def sampled(field: np.ndarray) -> np.ndarray:
        return ndimage.map_coordinates(field, along, order=1, mode="nearest").reshape(len(points), len(depth))

    value = sampled(ndimage.gaussian_filter(image, 0.4 / step)) / dark
    skin = sampled(below_skin)
    n = round(_ACROSS_MM / _STEP_MM)
    tried = depth[n:-n]
    # From dark to bright, both relative to the threshold; where it is not dark inside there is no bone
    before, at, after = value[:, : -2 * n], value[:, n:-n], value[:, 2 * n :]
    rise = np.clip(after, 0.0, 1.5) - np.clip(before, 0.0, 1.5)
    border = np.clip(rise, 0.0, 1.0) * np.clip(1.6 - before, 0.0, 1.0) * np.clip(1.2 - np.abs(at - 1.0), 0.0, 1.0)
    cost = -border + _PRIOR * ((tried - _USUAL_MM) / _DEVIATION_MM) ** 2
    # Bone farther out, the outer table, makes it a border of the marrow
    table = np.where(skin > _SKIN_MM, value, np.inf)[:, 2 * n :]
    beyond = np.minimum.accumulate(table[:, ::-1], axis=1)[:, ::-1]
    cost += _NOT_OUTERMOST * np.clip((1.0 - beyond) / 0.4, 0.0, 1.0)
    cost[(tried < LEAST_MM) | (skin[:, n:-n] < 1.0)] = 10.0
    found = tried[cost.argmin(axis=1)]
    for reach_mm, weight in _NEIGHBOURS:
        neighbours = _neighbours(points, reach_mm)
        for _ in range(_ROUNDS):
            around = neighbours @ found
            found = tried[(cost + weight * (tried - around[:, None]) ** 2).argmin(axis=1)]
    found = _neighbours(points, _PLACES_MM) @ found
    up = outward @ (ijk_to_ras[2, :3] / mm)[::-1]
    is_vault = _over(points, (up > _BASE).astype(float), inner.shape, step) > 0.5
    return np.where(is_vault, _over(points, found, inner.shape, step), np.float32(np.nan))


def _places(inner: np.ndarray, mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(places, 3) k, j, i mm of voxels on the surface of the brain, evenly spread, and the directions outward."""
    step = mm[::-1]
    signed = distance_to(inner, mm) - distance_to(~inner, mm)
    smooth = ndimage.gaussian_filter(signed.astype(np.float32), 3.0 / step)
    surface = np.argwhere(inner & np.logical_not(ndimage.binary_erosion(inner)))
    # One of the voxels in each cell of a coarse grid
    _, first = np.unique((surface * step // _PLACES_MM).astype(int), axis=0, return_index=True)
    voxels = surface[first]
    gradient = np.stack([np.gradient(smooth, axis=axis)[tuple(voxels.T)] / step[axis] for axis in range(3)], axis=1)
    length = np.linalg.norm(gradient, axis=1)
    keep = np.asarray(length > 0.1)
    outward = gradient[keep] / length[keep, None]
    return voxels[keep] * step, outward


def _neighbours(points: np.ndarray, reach_mm: float) -> csr_array:
    """(places, places) mean over the neighbours of each."""
    pairs = KDTree(points).query_pairs(2.0 * reach_mm, output_type="ndarray")
    rows, columns = np.concatenate([pairs, pairs[:, ::-1]]).T
    weights = np.exp(-0.5 * (np.linalg.norm(points[rows] - points[columns], axis=1) / reach_mm) ** 2)
    total = np.bincount(rows, weights, minlength=len(points))
    return coo_array((weights / total[rows], (rows, columns)), shape=(len(points),) * 2).tocsr()


def _over(points: np.ndarray, values: np.ndarray, shape: tuple[int, ...], step: np.ndarray) -> np.ndarray:
    """(k, j, i) float32 the value of the places near each voxel."""
    coarse = [int(np.ceil(n * mm / _PLACES_MM)) + 1 for n, mm in zip(shape, step, strict=True)]
    grid = np.stack(np.meshgrid(*(np.arange(n) * _PLACES_MM for n in coarse), indexing="ij"), axis=-1)
    distance, nearest = KDTree(points).query(grid.reshape(-1, 3), k=4)
    weights = 1.0 / np.maximum(distance, 1.0) ** 2
    field = ((weights * values[nearest]).sum(axis=1) / weights.sum(axis=1)).reshape(coarse)
    at = np.meshgrid(*(np.arange(n) * mm / _PLACES_MM for n, mm in zip(shape, step, strict=True)), indexing="ij")
    return ndimage.map_coordinates(field.astype(np.float32), np.stack(at), order=1, mode="nearest").astype(np.float32)
