"""The corpus callosum: the template's, moved to the patient's white matter in the midsagittal plane."""

from __future__ import annotations

import itertools
from functools import cache

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.neighbourhood import distance_to
from SlicerUSSim.Logic.mri.atlas import Atlas
from SlicerUSSim.Logic.mri.coarse import largest_component
from SlicerUSSim.Logic.mri.sheets.head import Head

#: y and z of MNI152 between which it is, and how far it is followed to the sides, mm
_Y_MM, _Z_MM, _SIDE_MM = (-48.0, 38.0), (-12.0, 35.0), 15.0
_WHITE = 0.6
#: Moves in the midsagittal plane that are tried, and the ring around it that has to be darker, mm
_MOVES_MM, _RING_MM = 6, 3.0
#: By how much the template's may differ from the patient's, mm
_GROWN_MM = 1.0


@cache
def template_callosum(atlas: Atlas) -> np.ndarray:
    """(k, j, i) bool of the atlas: connected white matter of the midline, followed to the sides."""
    t1, white = atlas.t1, atlas.white.array > _WHITE
    k, j, i = np.ogrid[tuple(map(slice, white.shape))]
    x, y, z = (row[0] * i + row[1] * j + row[2] * k + row[3] for row in t1.ijk_to_ras[:3])
    place = (y > _Y_MM[0]) & (y < _Y_MM[1]) & (z > _Z_MM[0]) & (z < _Z_MM[1])
    white &= place
    middle = largest_component(ndimage.binary_opening(white & (np.abs(x) <= 2.0)))
    result = middle.copy()
    centre = int(np.argmin(np.abs(x[0, 0])))
    # From slice to slice to both sides: each may be a voxel wider only every fourth time.
    for direction in (1, -1):
        before = middle[:, :, centre]
        for n in range(1, int(_SIDE_MM / t1.spacing_mm[0]) + 1):
            column = centre + direction * n
            before = (ndimage.binary_dilation(before) if n % 4 == 0 else before) & white[:, :, column]
            result[:, :, column] |= before
    return ndimage.binary_opening(result)


def corpus_callosum(head: Head) -> np.ndarray:
    """(k, j, i) True in the corpus callosum; all False where it is not met."""
    template = template_callosum(head.atlas.atlas)
    move = _best_move(head, template)
    t1 = head.atlas.atlas.t1
    shifted = ndimage.shift(template.astype(np.float32), np.rint(move[::-1] / t1.spacing_mm[::-1]), order=0)
    near = distance_to(head.carried(shifted) > 0.5, head.image.spacing_mm) <= _GROWN_MM
    values = head.smoothed(0.4)
    white = (values > 0.5 * (head.grey + head.white)) & (values < head.white + 4.0 * head.noise)
    found = ndimage.binary_opening(near & white & head.brain)
    return largest_component(found) if found.any() else found


def _best_move(head: Head, template: np.ndarray) -> np.ndarray:
    """(3,) mm of the atlas, in its midsagittal plane, by which it is most white within and least around."""
    t1 = head.atlas.atlas.t1
    around = distance_to(template) * float(t1.spacing_mm.mean())
    x = t1.ijk_to_ras[0, 0] * np.arange(template.shape[2]) + t1.ijk_to_ras[0, 3]
    near = np.abs(x) <= 6.0
    ring = (around > 0.5) & (around <= _RING_MM) & near
    inside = template & near
    points, signs = [], []
    for part, sign in ((inside, 1.0), (ring, -1.0)):
        kji = np.argwhere(part)[::3]
        points.append(kji[:, ::-1] @ t1.ijk_to_ras[:3, :3].T + t1.ijk_to_ras[:3, 3])
        signs.append(np.full(len(kji), sign / len(kji)))
    xyz, weights = np.concatenate(points), np.concatenate(signs)
    share = np.clip((head.smoothed(1.0) - head.grey) / (head.white - head.grey), -1.0, 1.0)

    def score(move: tuple[int, ...]) -> float:
        seen = float(head.at(head.from_atlas(xyz + [0.0, *move]), share) @ weights)
        return seen - 0.01 * float(np.hypot(move[0], move[1]))

    steps = range(-_MOVES_MM, _MOVES_MM + 1)
    coarse = max(itertools.product(steps[::2], steps[::2]), key=score)
    fine = max(itertools.product(*(range(m - 1, m + 2) for m in coarse)), key=score)
    return np.array([0.0, *fine])
