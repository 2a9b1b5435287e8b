"""Where an image has no data: beyond its edges, and what is padded, cropped or blanked with one value."""

from __future__ import annotations

from typing import cast

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.volume import SIDES, Volume
from SlicerUSSim.Logic.mri.coarse import largest_component

#: Voxels of the blank are a ball of this radius at least: dark CSF or bone with the same value is not
_THICK_MM = 5.0
#: Volume of the brain without data from which it is said, millilitres
_WORTH_ML = 2.0
#: Area of the brain at an edge of the image from which that is said, and at the bottom, where the stem leaves, cm2
_WORTH_CM2, _WORTH_AT_BASE_CM2 = 6.0, 20.0


def no_data(mri: Volume) -> np.ndarray:
    """(k, j, i) True where the image has one value without a gap from its edge on, in thick pieces.

    It is the lowest value, or the most frequent one at the edges. Air has noise, unless it was set to one value; then
    this is the air, too.
    """
    values = mri.array
    blank = (values == values.min()) | (values == edge_value(values)[0])
    # Opened on every other voxel, which is fast; what is thinner than the ball does not connect.
    step = tuple(max(1, int(_THICK_MM / 2.5 / mm)) for mm in mri.spacing_mm[::-1])
    coarse = np.pad(blank[tuple(slice(None, None, n) for n in step)], 1, constant_values=True)
    spacing = (mri.spacing_mm[::-1] * step).tolist()
    inner = cast(np.ndarray, ndimage.distance_transform_edt(coarse, spacing)) > _THICK_MM
    inner |= _frame(coarse)
    parts, _ = cast(tuple[np.ndarray, int], ndimage.label(inner))
    reached = np.isin(parts, np.unique(parts[_frame(coarse)])) & inner
    near = cast(np.ndarray, ndimage.distance_transform_edt(~reached, spacing)) <= _THICK_MM
    near = (near & coarse)[1:-1, 1:-1, 1:-1]
    wide = near.repeat(step[0], 0).repeat(step[1], 1).repeat(step[2], 2)
    return wide[tuple(map(slice, blank.shape))] & blank


def edge_value(values: np.ndarray) -> tuple[float, float]:
    """(the most frequent value at the six edges of a (k, j, i) image, its share of them)."""
    border = np.concatenate([values[[0, -1]].ravel(), values[:, [0, -1]].ravel(), values[:, :, [0, -1]].ravel()])
    levels, counts = np.unique(border, return_counts=True)
    return levels[counts.argmax()], float(counts.max() / border.size)


def without_blank(mri: Volume, inside: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    """((k, j, i) the brain without voxels that have no data, one line if it loses more than a little by that)."""
    lost = inside & no_data(mri)
    millilitres = float(lost.sum()) * mri.voxel_ml
    if millilitres < _WORTH_ML:
        return inside, ()
    away = np.argwhere(lost).mean(axis=0)[::-1] - np.argwhere(inside).mean(axis=0)[::-1]
    towards = mri.ijk_to_ras[:3, :3] @ away
    axis = int(np.abs(towards).argmax())
    name = SIDES[axis][int(towards[axis] > 0)]
    line = (
        f"{millilitres:.0f} ml where the brain should be have no data (one value, as around it): they "
        f"get no tissue, and the brain is cut off at its {name}"
    )
    return largest_component(inside & ~lost), (line,)


def ends_at_edge(mri: Volume, inside: np.ndarray) -> tuple[str, ...]:
    """One line for each edge of the image that cuts the brain (k, j, i) off; at the bottom only over a larger area.

    A whole brain does not reach the edge but for the stem, however little of scalp and skull is shown.
    """
    return tuple(
        f"the brain reaches the {name} edge of the image over {area:.0f} cm2: it is cut off there"
        for name, area in areas_at_edges(mri, inside)
        if area >= (_WORTH_AT_BASE_CM2 if name == "bottom" else _WORTH_CM2)
    )


def areas_at_edges(mri: Volume, inside: np.ndarray) -> list[tuple[str, float]]:
    """(side of the patient, cm2 of a mask (k, j, i) at that edge of the image) of all six edges."""
    areas = []
    for axis in range(3):
        others = [other for other in range(3) if other != axis]
        cm2 = float(np.linalg.norm(np.cross(*mri.ijk_to_ras[:3, others].T))) / 100.0
        for end in (0, -1):
            outwards = mri.ijk_to_ras[:3, axis] * (1 if end else -1)
            main = int(np.abs(outwards).argmax())
            areas.append((SIDES[main][int(outwards[main] > 0)], np.count_nonzero(inside.take(end, 2 - axis)) * cm2))
    return areas


def _frame(array: np.ndarray) -> np.ndarray:
    frame = np.ones(array.shape, bool)
    frame[1:-1, 1:-1, 1:-1] = False
    return frame
