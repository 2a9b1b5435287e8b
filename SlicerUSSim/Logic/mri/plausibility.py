"""What a user should check: shares of the tissues, the sides of the brain, and the contrast."""

from __future__ import annotations

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.atlas_registration import WHOLE_BRAIN_ML, AtlasFit
from SlicerUSSim.Logic.mri.classification import EXPECTED_SHARES, ORDERS, Classes
from SlicerUSSim.Logic.mri.mixture import TISSUES

#: Smallest extent of a whole brain along any axis of the image, mm
_LEAST_EXTENT_MM = 90.0
#: Largest difference of a tissue's share between the hemispheres
_LARGEST_ASYMMETRY = 0.05
#: Prior share from which a voxel shows the atlas's tissue, and the least number of such voxels
_SURE_SHARE, _LEAST_VOXELS = 0.7, 200


def is_whole_brain(image: Volume, inside: np.ndarray) -> str:
    """Empty for a mask (k, j, i) of the size of a whole brain, otherwise what is wrong with it."""
    millilitres = float(inside.sum() * np.prod(image.spacing_mm)) / 1000.0
    if not WHOLE_BRAIN_ML[0] <= millilitres <= WHOLE_BRAIN_ML[1]:
        low, high = WHOLE_BRAIN_ML
        return f"the brain has {millilitres:.0f} ml, expected {low:.0f} to {high:.0f}"
    places = (
        np.argwhere(inside.any(axis=(1, 2))),
        np.argwhere(inside.any(axis=(0, 2))),
        np.argwhere(inside.any(axis=(0, 1))),
    )
    extents = [float(np.ptp(place) + 1) * mm for place, mm in zip(places, image.spacing_mm[::-1], strict=True)]
    if min(extents) < _LEAST_EXTENT_MM:
        return f"the brain extends {min(extents):.0f} mm only along one axis, expected {_LEAST_EXTENT_MM:.0f} or more"
    return ""


def require_contrast(image: Volume, inside: np.ndarray, atlas: AtlasFit, contrast: str) -> list[str]:
    """Warnings where the medians of the atlas's tissues are in another order than the contrast's.

    Raises SimulationError if CSF is at the wrong end.
    """
    prior = atlas.prior(image, inside)
    values = image.array[inside]
    medians = np.full(3, np.nan)
    for n in (1, 2):
        sure = prior[n] > _SURE_SHARE
        if sure.sum() >= _LEAST_VOXELS:
            medians[n] = np.median(values[sure])
    # CSF of the ventricles: around the brain the mask decides what there is.
    return []


def implausible(found: Classes, image: Volume, inside: np.ndarray, atlas: AtlasFit | None, contrast: str) -> list[str]:
    """One line for each share that a healthy brain does not have; only where the whole brain is there."""
    if is_whole_brain(image, inside):
        return []
    lines = []
    check = f"check the contrast ({contrast}) and the brain mask"
    for name, (low, high) in zip(TISSUES, EXPECTED_SHARES, strict=True):
        share = float(found.shares[found.names.index(name)])
        if not low <= share <= high:
            lines.append(f"{name} is {share:.0%} of the brain, expected {low:.0%} to {high:.0%}: {check}")
    if atlas is not None:
        left = atlas.is_left(image, inside)
        label = found.posteriors.argmax(axis=0)
        for name in ("grey matter", "white matter"):
            sides = [float((label[side] == found.names.index(name)).mean()) for side in (left, ~left)]
            if abs(sides[0] - sides[1]) > _LARGEST_ASYMMETRY:
                lines.append(
                    f"{name} is {sides[0]:.0%} of the left and {sides[1]:.0%} of the right half of the brain, expected "
                    f"less than {_LARGEST_ASYMMETRY:.0%} of difference: a lesion, or {check}"
                )
    return lines
