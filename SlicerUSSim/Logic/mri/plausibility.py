"""What a user should check: how sure labels are, shares of the tissues, and the contrast."""

from __future__ import annotations

from typing import cast

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.atlas_registration import WHOLE_BRAIN_ML
from SlicerUSSim.Logic.mri.classification import EXPECTED_SHARES, FAINT, ORDERS, Classes
from SlicerUSSim.Logic.mri.mixture import TISSUES

#: Smallest extent of a whole brain along any axis of the image, mm
_LEAST_EXTENT_MM = 90.0
#: Smallest part of a brain that should have all tissues, as half of one
_LEAST_PART_ML = 400.0
#: Prior share from which a voxel shows the atlas's tissue, and the least number of such voxels
_SURE_SHARE, _LEAST_VOXELS = 0.7, 200
_LIKELY_CSF, _DEEP_MM = 0.3, 20.0
#: Distance of grey and white matter's medians in the wrong order from which that is said, and from which it is refused,
#: in units of the width of both together
_APART, _FAR_APART = 0.25, 0.5
#: Share of an image that the atlas explains, below which a user should look: heads and brains had 0.24 (T2) to 0.95,
#: a clinical scan in 6.5 mm slices 0.19, brains that lie the wrong way round 0.11
_USUALLY_EXPLAINED = 0.22


def is_whole_brain(image: Volume, inside: np.ndarray) -> str:
    """Empty for a mask (k, j, i) of the size of a whole brain, otherwise what is wrong with it."""
    millilitres = float(inside.sum() * image.voxel_ml)
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


def require_contrast(image: Volume, inside: np.ndarray, prior: np.ndarray, contrast: str) -> list[str]:
    """Warnings where the atlas's grey and white matter are in another order than the contrast's.

    `prior` (3, voxels) are the atlas's shares in the voxels `inside` (k, j, i). Raises SimulationError if ventricles
    have CSF at the other end, or grey and white matter are far apart in the other order.
    """
    values = image.array[inside]
    sure = prior > _SURE_SHARE
    if min(int(one.sum()) for one in sure[1:]) < _LEAST_VOXELS:
        return []
    grey, white = (float(np.median(values[one])) for one in sure[1:])
    solid = np.concatenate([values[sure[1]], values[sure[2]]])
    # The atlas's ventricles also cover tissue, so the tails decide, not the median.
    likely = values[(prior[0] >= _LIKELY_CSF) & _deep(image, inside)]
    if len(likely) >= _LEAST_VOXELS:
        low, high = np.percentile(solid, (2.0, 98.0))
        dark, bright = float((likely < low).mean()), float((likely > high).mean())
        is_clear = max(dark, bright) > 3.0 * min(dark, bright) and max(dark, bright) > 0.3
        if is_clear and (bright > dark) != (ORDERS[contrast][-1] == 0):
            where, fits = ("brightest", "t2") if bright > dark else ("darkest", "t1 or flair")
            raise SimulationError(f"contrast is {contrast}, but CSF is {where}, as in {fits}: choose {fits}")
    expected = ORDERS[contrast].index(2) > ORDERS[contrast].index(1)
    spread = float(np.percentile(solid, 84.0) - np.percentile(solid, 16.0))
    apart = abs(white - grey) / spread if spread > 0 else 0.0
    if (white > grey) == expected or apart < _APART:
        return []
    fits, how = ("t1 or t1gd", "brighter") if white > grey else ("flair or t2", "darker")
    found = f"contrast is {contrast}, but white matter is {how} than grey matter, as in {fits}"
    require(apart < _FAR_APART, f"{found}: choose {fits}")
    return [f"{found}: check the contrast"]


def require_order(found: Classes, contrast: str, is_led: bool) -> list[str]:
    """A warning where the tissues found are not in the order of the contrast; with an atlas that is refused.

    Raises SimulationError then, naming the contrasts in which grey and white matter have this order.
    """
    order = [found.names.index(TISSUES[tissue]) for tissue in ORDERS[contrast]]
    means = found.means[order, 0]
    if (np.diff(means) > 0).all():
        return []
    grey, white = found.grey_and_white
    reversed_ = (white > grey) != (ORDERS[contrast].index(2) > ORDERS[contrast].index(1))
    names = ", ".join(f"{TISSUES[tissue]} {mean:.4g}" for tissue, mean in zip(ORDERS[contrast], means, strict=True))
    what = f"choose {'t1 or t1gd' if white > grey else 't2 or flair'}" if reversed_ else "check the brain mask"
    message = f"contrast is {contrast}, but its tissues are not in that order of brightness ({names}): {what}"
    require(not is_led, message)
    return [message]


def unsure(found: Classes, explained: float | None) -> list[str]:
    """The warning that says how sure labels are; `explained` is alignment.explained, None without an atlas."""
    apart = found.grey_white_contrast
    faint = f"grey and white matter differ by {apart:.1f} times the noise only, expected {FAINT[0]:g} or more"
    faint += "" if explained is None else ", so that the atlas decides between them"
    lines = [faint] if apart < FAINT[0] else []
    if explained is not None and explained < _USUALLY_EXPLAINED:
        found_share = f"the atlas explains {explained:.0%} of this image, expected {_USUALLY_EXPLAINED:.0%} or more"
        lines = [f"{found_share}: check the orientation and the voxel size in its header", *lines]
    return ["; ".join([*lines, "look at the labels"])] if lines else []


def _deep(image: Volume, inside: np.ndarray) -> np.ndarray:
    """(voxels,) whether each voxel `inside` (k, j, i) is far from the border of the brain, as the ventricles are."""
    step = np.maximum(np.rint(2.0 / image.spacing_mm[::-1]).astype(int), 1)
    coarse = np.pad(inside[tuple(slice(None, None, n) for n in step)], 1)
    distance = cast(np.ndarray, ndimage.distance_transform_edt(coarse, (image.spacing_mm[::-1] * step).tolist()))
    deep = distance[1:-1, 1:-1, 1:-1] > _DEEP_MM
    for axis, n in enumerate(step):
        deep = deep.repeat(n, axis)
    return deep[tuple(map(slice, inside.shape))][inside]


def implausible(found: Classes, millilitres: float, contrast: str) -> list[str]:
    """One line for each share that a healthy brain does not have, or a part of a brain of _LEAST_PART_ML."""
    shares = [float(found.shares[found.names.index(name)]) for name in TISSUES]
    return [
        f"{name} is {share:.0%} of the brain, expected {low:.0%} to {high:.0%}: check the contrast ({contrast}) and "
        "the brain mask"
        for name, share, (low, high) in zip(TISSUES, shares, EXPECTED_SHARES, strict=True)
        if not low <= share <= high and millilitres >= _LEAST_PART_ML
    ]
