"""Where a labelled brain was cut off: its sides that are flat, and the side of which little is there.

A brain is round, so that its outermost slice along any axis is small; that of a half, or of a crop, is not.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from SlicerUSSim.Logic.base.volume import SIDES, Volume

#: Share of the largest slice that the outermost has where a brain was cut (0.36 where a tenth of its extent is gone);
#: of whole ones it is below 0.1, at slices of 3 mm. In thicker slices than this, it tells nothing.
_FLAT, _THICKEST_MM = 0.2, 5.0
#: Smaller pieces are not judged, and none that fill less of their box, which a brain fills by half
LEAST_ML, _LEAST_FILLED = 100.0, 0.2
#: Grey and white matter of a whole brain have more; a newborn's has 300
WHOLE_ML = 600.0
#: Share of one side's volume that the other has at least, by names, and the volume from which both are there: labels of
#: the right side may have been given the names of the left
_LEAST_SIDE, _BOTH_SIDES_ML = 0.5, 750.0
_LEFT, _RIGHT = (re.compile(rf"(^|[-_ ])({words})([-_ ]|$)", re.IGNORECASE) for words in ("left|lh", "right|rh"))


def cut_sides(labels: Volume, names: Mapping[int, str | None], counts: np.ndarray) -> list[str]:
    """At which sides a brain was cut off, or which side is mostly missing: of left, right, back, front, bottom, top.

    Parameters
    ----------
    labels : (k, j, i) whole numbers, the labels.
    names : {label: name} of the labels that are brain; None for one without a name.
    counts : voxels of label 0, 1, 2, ...
    """
    if counts[list(names)].sum() * labels.voxel_ml < LEAST_ML:
        return []
    inside = _inside(labels, names, counts)
    found = set(_flat_sides(inside, labels))
    left, right = (
        sum(int(counts[label]) for label, name in names.items() if name and side.search(name))
        for side in (_LEFT, _RIGHT)
    )
    is_half = inside.sum() * labels.voxel_ml < _BOTH_SIDES_ML
    if is_half and min(left, right) < _LEAST_SIDE * max(left, right):
        found.add("left" if left < right else "right")
    return [side for sides in SIDES for side in sides if side in found]


def is_solid(labels: Volume, names: Mapping[int, str | None], counts: np.ndarray) -> bool:
    """Whether labels, as for cut_sides, fill their box as a piece of a brain does, and not as scattered pieces."""
    return _filled(_inside(labels, names, counts)) >= _LEAST_FILLED


def _inside(labels: Volume, names: Mapping[int, str | None], counts: np.ndarray) -> np.ndarray:
    """(k, j, i) True in the labels that have these names."""
    lookup = np.zeros(len(counts), bool)
    lookup[list(names)] = True
    return lookup[labels.array]


def _filled(inside: np.ndarray) -> float:
    boxes = [np.flatnonzero(inside.any(axis=tuple(other for other in range(3) if other != axis))) for axis in range(3)]
    return float(inside.sum() / np.prod([float(np.ptp(box) + 1) for box in boxes]))


def _flat_sides(inside: np.ndarray, labels: Volume) -> list[str]:
    if _filled(inside) < _LEAST_FILLED:
        return []
    sides = []
    for axis, column in enumerate((2, 1, 0)):  # of (k, j, i), and of the matrix
        if labels.spacing_mm[column] > _THICKEST_MM:
            continue
        areas = inside.sum(axis=tuple(other for other in range(3) if other != axis))
        occupied = np.flatnonzero(areas)
        for end, side in zip(occupied[[0, -1]], labels.ends[column], strict=True):
            if areas[end] > _FLAT * areas.max():
                sides.append(side)
    return sides
