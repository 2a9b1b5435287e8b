"""Tissues outside the brain in the MRI of a whole head: skin, scalp, skull with its marrow, and air.

Bone, its tables at least, and air give no signal; fat, muscle and marrow do. As in Dogdas, Shattuck and Leahy,
"Segmentation of skull and scalp in 3-D human MRI using mathematical morphology" (Human Brain Mapping 26, 2005), the
skull is the dark space between the brain and the scalp, closed over its marrow. Bone and air look alike: dark space
farther from the brain is air.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array, csr_array
from scipy.spatial import KDTree

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.neighbourhood import distance_to
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.coarse import largest_component
from SlicerUSSim.Logic.mri.edges import areas_at_edges
from SlicerUSSim.Logic.tissue.names import OUTSIDE

#: Contrasts in which bone is known to be found
CONTRASTS = ("t1", "t1gd")
#: Air around the head: below this part of Otsu's threshold. Bone: below this part of the one beside the brain
_AIR, _DARK = 0.35, 0.8
#: Gaps of the head's outline that are closed: mouth, ears, sinuses
_OUTLINE_MM = 10.0
#: Sulci over which the inner surface of the skull goes, and the dura with the space between it and the brain
_SULCUS_MM, _DURA_MM = 5.0, 1.0
#: Bright tissue beside the brain, from which the threshold is found
_BESIDE_MM = (2.0, 30.0)
#: Skin over the skull, marrow within it that is closed over, its least thickness, and the largest
_SKIN_MM, _MARROW_MM, _LEAST_SKULL_MM, _LARGEST_SKULL_MM = 2.0, 3.5, 2.5, 14.0
#: A skull is smooth at this scale
_SMOOTH_MM = 6.0
#: Area of a head at a face of the image from which it is cut there
_CUT_CM2 = 4.0
#: Near the faces of an image no air is labelled
_FACES_MM = 8.0
#: Tables of the skull over its marrow
_TABLE_MM = 1.2
#: Air in the head, except for cracks between tissues: darker than this part of the dark voxels, as bone between fat
#: and marrow is not
_CAVITY_MM, _VOID = 1.5, 0.6


@dataclass(frozen=True, eq=False)
class Outside:
    """Tissues outside the brain, on the grid of the MRI."""

    #: (k, j, i) uint8, 0 in the brain and around the head, else the number in OUTSIDE from 1 on
    labels: np.ndarray
    #: Intensity below which it is bone or air
    dark: float
    #: What a user should check, one line each
    warnings: tuple[str, ...] = ()

    def text(self, voxel_ml: float) -> str:
        """One line for the user: "outside the brain: skin 240 ml, scalp 1100 ml, ..."."""
        counts = np.bincount(self.labels.ravel(), minlength=len(OUTSIDE) + 1)[1:]
        parts = [f"{name} {count * voxel_ml:.0f} ml" for name, count in zip(OUTSIDE, counts, strict=True)]
        line = f"outside the brain: {', '.join(parts)}; bone is darker than {self.dark:.4g}"
        return f"{line}, and so is CSF between brain and skull"

    def over(self, labels: Volume, names: Sequence[str]) -> tuple[Volume, tuple[str, ...]]:
        """(labels with those outside the brain after them, names of all labels from 1 on).

        `labels` (k, j, i) of the brain, which go first.
        """
        present = [n for n in range(1, len(OUTSIDE) + 1) if (self.labels == n).any()]
        lookup = np.zeros(len(OUTSIDE) + 1, labels.array.dtype)
        lookup[present] = len(names) + 1 + np.arange(len(present))
        array = np.where(labels.array > 0, labels.array, lookup[self.labels])
        return labels.with_array(array), (*names, *(OUTSIDE[n - 1] for n in present))


def require_findable(contrast: str, skull_strip: str, has_mask: bool) -> None:
    """Raise SimulationError where the image is not a T1, or its brain cannot be found."""
    require(
        contrast in CONTRASTS,
        f"skin, skull and what else is outside the brain (--outside) are found in a whole head of contrast "
        f"{' or '.join(CONTRASTS)}, and this is {contrast}",
    )
    require(
        has_mask or skull_strip != "none",
        "--outside needs the brain, which --skull-strip none does not find; choose another method, or "
        "give a brain mask (--mask)",
    )


def find_outside(
    mri: Volume, brain: np.ndarray, progress: Callable[[float], None] = lambda share: None
) -> Outside:  # fmt: skip
    """Label the tissues outside the brain in the MRI of a whole head (T1, with or without contrast agent).

    Parameters
    ----------
    mri : whole head.
    brain : (k, j, i) bool, the brain.
    progress : called with the completed fraction, 0 to 1.

    In a T1, CSF is as dark as bone: the gap between a shrunken brain and its skull counts as skull.
    Raises SimulationError if there is no brain, or nothing around it.
    """
    require(brain.any(), "the brain mask is empty, expected a brain")
    image = mri.array.astype(np.float32)
    head = _head(image, mri.spacing_mm, lambda share: progress(0.4 * share)) | brain
    margin = [slice(max(box.start - 2, 0), box.stop + 2) for box in ndimage.find_objects(head.astype(np.uint8))[0]]
    box = tuple(margin)
    image, head, brain, mm = image[box], head[box], brain[box], mri.spacing_mm
    inner = _within(_closed(brain, _SULCUS_MM, mm), _DURA_MM, mm)  # with sulci, dura and the space between
    progress(0.46)
    from_brain = distance_to(inner, mm)
    beside = image[head & (from_brain > _BESIDE_MM[0]) & (from_brain < _BESIDE_MM[1])]
    require(
        beside.size > 10 * inner.sum() ** (2.0 / 3.0),
        "there is next to nothing around the brain, expected a whole head",
    )
    dark = _DARK * _otsu(beside)
    below_skin = _depth(head, mm)
    progress(0.52)
    may_be = (below_skin > _SKIN_MM) & (from_brain < _LARGEST_SKULL_MM)
    thickness = thickness_of_skull(image, inner, below_skin, dark, mm, mri.ijk_to_ras)
    progress(0.73)
    is_dark = head & (image < dark) & ~inner
    vault = may_be & (from_brain <= thickness)
    base = may_be & np.isnan(thickness) & (is_dark | inner)
    thick = _opened(is_dark & may_be, _CAVITY_MM, mm)  # also where it is thicker than usual
    progress(0.8)
    skull = _closed(inner | vault | base | thick, _MARROW_MM, mm) & may_be
    progress(0.86)
    skull = largest_component(_opened(skull | inner, _SMOOTH_MM, mm) | inner)
    skull |= head & (from_brain < _LEAST_SKULL_MM)
    progress(0.92)
    below_table = _depth(skull, mm)
    labels = np.where(below_skin > _SKIN_MM, 2, 1).astype(np.uint8)
    is_void = is_dark & (image < _VOID * dark) & ~skull & (below_skin > _SKIN_MM)
    labels[_opened(is_void & ~_at_faces(margin, mri), _CAVITY_MM, mm)] = 5
    labels[skull] = 3
    labels[skull & (image > dark) & (below_table > _TABLE_MM) & (from_brain > _TABLE_MM)] = 4
    # Between brain and skull there are fluid and the dura: the coupling medium, as in a label map without this
    labels[~head | inner] = 0
    whole = np.zeros(mri.array.shape, np.uint8)
    whole[box] = labels
    return Outside(whole, float(dark), _cut(whole, mri))


def _cut(labels: np.ndarray, mri: Volume) -> tuple[str, ...]:
    """A line about the faces of the image at which the head ends, other than the lower one, as in a neck."""
    cut = [(name, cm2) for name, cm2 in areas_at_edges(mri, labels) if name != "bottom" and cm2 > _CUT_CM2]
    if not cut:
        return ()
    sides = ", ".join(f"{name} {cm2:.0f} cm2" for name, cm2 in cut)
    return (
        f"the image cuts the head ({sides}): there it has no skin, and what is missing of its skull lets a beam in; do "
        "not put a probe there",
    )


def _at_faces(box: list[slice], mri: Volume) -> np.ndarray:
    """(k, j, i) bool of the box: near the faces of the image, where coils receive little and fat is as dark as air."""
    inside = np.ones(mri.array.shape, bool)
    for axis, step in enumerate(mri.spacing_mm[::-1]):
        n = min(int(np.ceil(_FACES_MM / step)), mri.array.shape[axis] // 2)
        np.moveaxis(inside, axis, 0)[[*range(n), *range(-n, 0)]] = False
    return ~inside[tuple(box)]


def _head(image: np.ndarray, mm: np.ndarray, progress: Callable[[float], None]) -> np.ndarray:
    """(k, j, i) bool: what is within the skin, with its cavities."""
    smooth = ndimage.gaussian_filter(image, 1.0 / mm[::-1])
    inside = largest_component(_opened(smooth > _AIR * _otsu(smooth[smooth > np.percentile(smooth, 1.0)]), 1.5, mm))
    progress(0.3)
    inside = _closed(inside, _OUTLINE_MM, mm)
    progress(0.55)
    for axis in range(3):
        inside = np.stack([ndimage.binary_fill_holes(part) for part in np.moveaxis(inside, axis, 0)])  # type: ignore
        inside = np.moveaxis(inside, 0, axis)
    progress(0.7)
    return largest_component(_opened(inside, 4.0, mm))


def _otsu(values: np.ndarray) -> float:
    from skimage.filters import threshold_otsu

    return float(threshold_otsu(values[values <= np.percentile(values, 99.0)]))


def _within(mask: np.ndarray, distance_mm: float, mm: np.ndarray) -> np.ndarray:
    return distance_to(mask, mm) <= distance_mm


def _depth(mask: np.ndarray, mm: np.ndarray) -> np.ndarray:
    """(k, j, i) distance in mm to the outside; it keeps growing beyond the image."""
    return distance_to(~mask, mm)


def _opened(mask: np.ndarray, radius_mm: float, mm: np.ndarray) -> np.ndarray:
    return _within(_depth(mask, mm) > radius_mm, radius_mm, mm)


def _closed(mask: np.ndarray, radius_mm: float, mm: np.ndarray) -> np.ndarray:
    pad = int(np.ceil(radius_mm / mm.min())) + 1
    wide = _within(np.pad(mask, pad), radius_mm, mm)
    return (distance_to(~wide, mm) > radius_mm)[pad:-pad, pad:-pad, pad:-pad]


# ---- the outer surface of the skull: a smooth layer over the brain, from dark bone to bright scalp -------------------
# The outer table of the skull is as thin as a voxel, between marrow and fat, which are both bright. A skull is smooth,
# so its thickness over the brain is found for all places together: where the image rises from dark to bright outward,
# near the usual thickness, and alike in neighbours. The profiles along normals of the brain are from Smith, Human
# Brain Mapping 17, 2002.

#: Places over the brain, mm apart, and thicknesses that are tried, mm
_PLACES_MM, _STEP_MM = 4.0, 0.5
LEAST_MM, LARGEST_MM = 2.5, 14.0
#: Usual distance from the brain's surface to that of the skull with the space between, and its deviation over heads and
#: places (skulls of adults: 3 mm at the temples to 9 mm at the back; Lillie et al., Journal of Anatomy 228, 2016)
_USUAL_MM, _DEVIATION_MM = 5.5, 3.0
#: Width of the search across a border
_ACROSS_MM = 1.5
#: What it costs that there is bone farther out, but below the skin
_NOT_OUTERMOST = 1.0
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
