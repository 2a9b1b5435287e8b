"""What a user should check: how sure labels are, shares of the tissues, and the contrast."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.classification import EXPECTED_SHARES, FAINT, ORDERS, Classes
from SlicerUSSim.Logic.mri.mixture import TISSUES
from SlicerUSSim.Logic.mri.recognition import POSSIBLE_ML

#: Smallest extent of a whole brain along any axis of the image, mm
_LEAST_EXTENT_MM = 90.0
#: Smallest part of a brain that should have all tissues, as half of one
_LEAST_PART_ML = 400.0
#: Prior share from which a voxel shows the atlas's tissue, and the least number of such voxels
_SURE_SHARE, _LEAST_VOXELS = 0.7, 200
#: Least distance of grey and white matter's medians in the wrong order that triggers a warning, and an error, in units
#: of the width of both together
_APART, _FAR_APART = 0.25, 0.5
#: Share of an image that the atlas explains, below which a user should look: heads and brains had 0.24 (T2) to 0.95,
#: a clinical scan in 6.5 mm slices 0.19, brains that lie the wrong way round 0.11
_USUALLY_EXPLAINED = 0.22


#: Brightness above white matter in units of its contrast to grey matter, and least volume in one piece of what
#: enhances. Largest pieces: 19.5 ml in a T1 with contrast agent (ReMIND-022), 0.65 ml in one with bright arteries, and
#: 0.01 ml in the others
_ENHANCED, _ENHANCED_ML = 1.5, 2.0


def is_whole_brain(image: Volume, inside: np.ndarray) -> str:
    """Empty for a mask (k, j, i) of the size of a whole brain, otherwise what is wrong with it."""
    millilitres = float(inside.sum() * image.voxel_ml)
    if not POSSIBLE_ML[0] <= millilitres <= POSSIBLE_ML[1]:
        low, high = POSSIBLE_ML
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


def require_contrast(image: Volume, inside: np.ndarray, prior: np.ndarray, contrast: str) -> list[str]:
    """A warning where the atlas's grey and white matter are in another order than the contrast's.

    `prior` (3, voxels) are the atlas's shares in the voxels `inside` (k, j, i). Raises SimulationError if they are far
    apart in the other order.
    """
    values = image.array[inside]
    sure = [values[share > _SURE_SHARE] for share in prior[1:]]
    if min(map(len, sure)) < _LEAST_VOXELS:
        return []
    grey, white = (float(np.median(one)) for one in sure)
    low, high = np.percentile(np.concatenate(sure), (16.0, 84.0))
    apart = abs(white - grey) / max(float(high - low), 1e-12)
    expected = ORDERS[contrast].index(2) > ORDERS[contrast].index(1)
    if (white > grey) == expected or apart < _APART:
        return []
    fits, how = ("t1 or t1gd", "brighter") if white > grey else ("flair or t2", "darker")
    found = f"contrast is {contrast}, but white matter is {how} than grey matter, as in {fits}"
    require(apart < _FAR_APART, f"{found}: choose {fits}")
    return [f"{found}: check the contrast"]


def enhancing(image: np.ndarray, inside: np.ndarray, found: Classes, voxel_ml: float) -> list[str]:
    """A warning where a T1, `image` (k, j, i), is far brighter than white matter, as only contrast agent makes it."""
    grey, white = found.grey_and_white
    parts, _ = ndimage.label((image > white + _ENHANCED * (white - grey)) & inside)  # type: ignore[misc]
    largest = float(np.bincount(parts.ravel(), minlength=2)[1:].max()) * voxel_ml
    if white <= grey or largest < _ENHANCED_ML:
        return []
    return [
        f"contrast is t1, but {largest:.1f} ml in one piece are far brighter than white matter, as vessels and tumours "
        "are after contrast agent: if it was given, choose t1gd (--contrast t1gd)"
    ]


def unsure(found: Classes, explained: float | None, is_led: bool) -> list[str]:
    """The warning that says how sure labels are; `explained` is alignment.explained, None where not known."""
    apart = found.grey_white_contrast
    faint = f"grey and white matter differ by {apart:.1f} times the noise only, expected {FAINT[0]:g} or more"
    faint += ", so that the atlas decides between them" if is_led else ""
    lines = [faint] if apart < FAINT[0] else []
    if explained is not None and explained < _USUALLY_EXPLAINED:
        found_share = f"the atlas explains {explained:.0%} of this image, expected {_USUALLY_EXPLAINED:.0%} or more"
        lines = [f"{found_share}: check the orientation and the voxel size in its header", *lines]
    return ["; ".join([*lines, "look at the labels"])] if lines else []


def implausible(found: Classes, millilitres: float, contrast: str) -> list[str]:
    """One line for each share that a healthy brain does not have, or a part of a brain of _LEAST_PART_ML."""
    shares = [float(found.shares[found.names.index(name)]) for name in TISSUES]
    return [
        f"{name} is {share:.0%} of the brain, expected {low:.0%} to {high:.0%}: check the contrast ({contrast}) and "
        "the brain mask"
        for name, share, (low, high) in zip(TISSUES, shares, EXPECTED_SHARES, strict=True)
        if not low <= share <= high and millilitres >= _LEAST_PART_ML
    ]
