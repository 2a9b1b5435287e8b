"""Brain masks that a user gives: what is refused, and what should be checked."""

from __future__ import annotations

from typing import cast

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import require, require_kind
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.masks import several_segments
from SlicerUSSim.Logic.mri.recognition import POSSIBLE_ML, USUAL_ML

#: Labels of a segmentation count as inside too; an image has more values
_MOST_MASK_VALUES = 128
#: Values that are listed
_LISTED = 6


#: What a filter leaves beyond 0 and 1
_ROUNDING = 1e-3
#: Pieces of a mask smaller than this share of the largest are no part of a brain; and how much of them is said, ml
_LEAST_PIECE, _WORTH_ML = 0.1, 0.5


def checked_mask(mask: Volume, mri: Volume) -> np.ndarray:
    """(k, j, i) True in the mask. Raises SimulationError as brain.given_brain."""
    require_kind("mask", mask, Volume, "Volume.read reads a file")
    name = f"mask {mask.name}" if mask.name else "mask"
    mask = mask.along(mri)
    require(
        mask.array.shape == mri.array.shape,
        f"{name} has {mask.size_text} voxels and the MRI {mri.size_text}, expected the same grid; resample the mask",
    )
    corners = np.array([[0, 0, 0, 1], [*(np.array(mri.array.shape[::-1]) - 1), 1]]).T
    apart = float(np.linalg.norm((mask.ijk_to_ras - mri.ijk_to_ras) @ corners, axis=0).max())
    require(
        np.allclose(mask.ijk_to_ras, mri.ijk_to_ras, atol=1e-3),
        f"{name} lies up to {apart:.1f} mm from the MRI's voxels, expected the same origin, spacing and directions; "
        "resample the mask",
    )
    if _is_probability(mask.array):
        mask = mask.with_array(mask.array > 0.5)
    values = np.unique(mask.array[:: max(mask.array.shape[0] // 16, 1)])
    require(
        len(values) <= _MOST_MASK_VALUES,
        f"{name} has {len(values)} or more different values, expected 0 outside and one value inside: is it an image?",
    )
    inside = mask.array > 0
    require(bool(inside.any()), f"{name} is empty, expected at least one voxel inside")
    millilitres = float(inside.sum() * mri.voxel_ml)
    require(
        millilitres <= POSSIBLE_ML[1],
        f"{name} has {millilitres:.0f} ml, expected a brain ({USUAL_ML[0]:.0f} to {USUAL_ML[1]:.0f} ml) or a part of "
        f"one; it covers {inside.mean():.0%} of the image: for all of that, give --skull-strip none and no mask",
    )
    return inside


def _is_probability(array: np.ndarray) -> bool:
    """Whether these are probabilities of the brain: from 0 to 1, most of them near one of the two."""
    low, high = float(array.min()), float(array.max())
    if not np.issubdtype(array.dtype, np.floating) or low < -_ROUNDING or not 0.9 < high <= 1.0 + _ROUNDING:
        return False
    some = array[::3, ::3, ::3]
    some = some[some > 0.05]
    return bool(some.size and (some > 0.95).mean() > 0.5)


def mask_doubts(mri: Volume, inside: np.ndarray) -> tuple[str, ...]:
    """What should be checked in a mask (k, j, i) that a user made."""
    millilitres = float(inside.sum() * mri.voxel_ml)
    if millilitres < POSSIBLE_ML[0]:
        small = (
            f"the mask has {millilitres:.3g} ml, expected a brain of {USUAL_ML[0]:.0f} to {USUAL_ML[1]:.0f} ml or a "
            "large part of one; what is outside it has no tissue (a lesion is added with --add tumour=FILE)"
        )
        return (*_islands(mri, inside), small)
    return (*volume_warnings(millilitres), *_islands(mri, inside))


def label_doubts(mask: Volume) -> tuple[str, ...]:
    """A warning about a mask that is a label map, all of whose labels are taken."""
    values = np.unique(mask.array[mask.array > 0])
    if len(values) < 2 or _is_probability(mask.array):
        return ()
    segments = several_segments(mask)
    if segments:
        return (
            f"the mask holds the segments {segments}, expected a file with one; the brain is taken where any of them "
            "is: if some are not brain, export the brain alone",
        )
    listed = ", ".join(f"{value:g}" for value in values[:_LISTED]) + (", ..." if len(values) > _LISTED else "")
    return (
        f"the mask holds {len(values)} values ({listed}), expected one; the brain is taken where it is not 0: if some "
        "are not brain, give a mask without them",
    )


def _islands(mri: Volume, inside: np.ndarray) -> tuple[str, ...]:
    """One line if the mask has pieces away from the brain, as scattered voxels of a threshold or a network."""
    labels, count = cast(tuple[np.ndarray, int], ndimage.label(inside, np.ones((3, 3, 3))))
    if count < 2:
        return ()
    sizes = np.bincount(labels.ravel())[1:]
    small = sizes[sizes < _LEAST_PIECE * sizes.max()]
    millilitres = float(small.sum() * mri.voxel_ml)
    if millilitres < _WORTH_ML:
        return ()
    return (
        f"the mask has {millilitres:.3g} ml in {len(small)} small piece{'s' * (len(small) > 1)} away from the brain, "
        "which become tissue: keep its largest piece only",
    )


def volume_warnings(millilitres: float) -> tuple[str, ...]:
    """A warning about a brain that is smaller or larger than an adult's."""
    if USUAL_ML[0] <= millilitres <= USUAL_ML[1]:
        return ()
    return (
        f"the brain has {millilitres:.0f} ml, expected {USUAL_ML[0]:.0f} to {USUAL_ML[1]:.0f} ml of an adult; "
        "check the mask",
    )
