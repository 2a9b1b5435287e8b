"""Checks of masks to add that need no segmentation, so that a mistake is told before one and not after it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import cast

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.masks import read_masks, resampled
from SlicerUSSim.Logic.mri.pathology import (
    FARTHEST_MM,
    LARGEST_SHARE,
    mask_tissue,
    mm_outside,
    require_in_patient,
    require_size,
)
from SlicerUSSim.Logic.mri.recognition import USUAL_ML

#: Spacing at which the patient in an image is looked for; also how far its border may be off
_COARSE_MM = 3.0


def require_addable(
    mri: Volume,
    masks: Iterable[tuple[str, Volume, str]],
    *,
    mask: Volume | None = None,
    skull_strip: str = "auto",
    also: Iterable[str] = (),
) -> None:
    """Raise SimulationError for what add_tissues would refuse after a segmentation of `mri`, as far as it is certain.

    Takes less than a second, a segmentation up to half a minute.

    Parameters
    ----------
    mri : the image that will be segmented.
    masks : (tissue, mask, source) as in add_tissues.
    mask, skull_strip : as in segment_mri.
    also : names of tissues besides those of the presets.

    Raises SimulationError for an unknown tissue, for a mask that is none, is empty or too small for the voxels of the
    MRI, and for one outside the head in the image (outside `mask`, if it is given), or as large as a brain.

    >>> import numpy as np
    >>> from SlicerUSSim.Logic import SimulationError, Volume
    >>> from SlicerUSSim.Logic.mri import head_mri, require_addable
    >>> mri = head_mri(spacing_mm=4.0)
    >>> ball = Volume(np.ones((10, 10, 10), np.uint8), np.eye(4))
    >>> require_addable(mri, [("tumour", ball, "ball.nii.gz")])
    >>> moved = np.eye(4)
    >>> moved[0, 3] = 200.0
    >>> try:
    ...     require_addable(mri, [("tumour", Volume(ball.array, moved), "ball.nii.gz")])
    ... except SimulationError as error:
    ...     print(str(error)[:48])
    ball.nii.gz: lies 128 mm outside the patient, ex
    """
    patient = None
    for name, volume, source in masks:
        masked = read_masks(volume, mask_tissue(name, also), source)
        if patient is None:
            patient, margin = (mask, 0.0) if mask is not None else (_patient_in(mri), _COARSE_MM)
            inside = patient.array > 0
            if not inside.any():  # the segmentation says what is wrong with it
                return
        apart = mm_outside(inside, patient, masked)
        require_in_patient(masked, float(apart.min()), FARTHEST_MM + margin)
        share = float((apart == 0.0).sum() * masked.union.voxel_ml / (inside.sum() * patient.voxel_ml))
        require_size(masked, share)
        if mask is None and skull_strip != "none":
            # Of a whole head, which is several times larger than its brain
            require(
                masked.volume_ml <= LARGEST_SHARE * USUAL_ML[1],
                f"{masked.source}: has {masked.volume_ml:.0f} ml, as a whole brain has, expected a lesion in it; is it "
                "the mask of the brain (--mask)?",
            )
        _, numbers, lost = resampled(masked, mri)
        require(
            lost == 1.0 or bool((numbers > 0).any()),
            f"{masked.source}: {masked.volume_ml * 1000:.2g} mm³ are too small for the voxels of the MRI, "
            f"{mri.voxel_ml * 1000:.2g} mm³; nothing would be added",
        )


def _patient_in(mri: Volume) -> Volume:
    """What is brighter than the background, uint8 on a coarser grid, filled: the head, or the brain if it is stripped.

    Never smaller than a brain in it, except by a voxel.
    """
    from skimage.filters import threshold_otsu

    steps = np.maximum(np.floor(_COARSE_MM / mri.spacing_mm + 0.01).astype(int), 1)  # i, j, k
    array = np.nan_to_num(mri.array[:: steps[2], :: steps[1], :: steps[0]].astype(np.float32))
    grid = Volume(array, mri.ijk_to_ras @ np.diag([*steps, 1.0]))
    if array.max() <= array.min():
        return grid.with_array(np.zeros(array.shape, np.uint8))
    low = float(np.percentile(array, 1.0))
    inside = array > low + 0.25 * (threshold_otsu(array) - low)
    inside = cast(np.ndarray, ndimage.binary_opening(inside))  # without speckles of noise
    filled = cast(np.ndarray, ndimage.binary_fill_holes(inside))
    return grid.with_array(filled.astype(np.uint8))
