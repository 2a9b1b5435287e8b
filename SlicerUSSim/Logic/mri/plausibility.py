"""What a user should check: shares of the tissues, the sides of the brain, and the contrast."""

from __future__ import annotations

from typing import cast

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.atlas_registration import WHOLE_BRAIN_ML, AtlasFit
from SlicerUSSim.Logic.mri.classification import EXPECTED_SHARES, ORDERS, Classes, is_csf_near_grey
from SlicerUSSim.Logic.mri.mixture import TISSUES

#: Smallest extent of a whole brain along any axis of the image, mm
_LEAST_EXTENT_MM = 90.0
#: Smallest part of a brain that should have all tissues, as half of one
_LEAST_PART_ML = 400.0
#: Largest difference of a tissue's share between the hemispheres
_LARGEST_ASYMMETRY = 0.05
#: Prior share from which a voxel shows the atlas's tissue, and the least number of such voxels
_SURE_SHARE, _LEAST_VOXELS = 0.7, 200
_LIKELY_CSF, _DEEP_MM = 0.3, 20.0
#: Distance of grey and white matter's medians in the wrong order from which that is said, and from which it is refused,
#: in units of the width of both together
_APART, _FAR_APART = 0.25, 0.5
#: Least correlation of white matter with the atlas's: 0.64 to 0.87 in T1, T2 and FLAIR of MNI152 and Colin27, 0.23 to
#: 0.45 upside down and back to front
_LEAST_ALIKE = 0.5
#: Share of one tissue from which the rest is noise
_ONE_TISSUE = 0.97
#: Contrast of grey and white matter in units of the noise: 1.1 in a T2 whose labels are blobs, 3 and more in T1s
_LEAST_CONTRAST = 2.0


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


def require_several_tissues(found: Classes) -> None:
    """Raise SimulationError if all but a few voxels are one tissue, as in a phantom or a liver."""
    largest = int(found.shares.argmax())
    share = float(found.shares[largest])
    require(
        share < _ONE_TISSUE,
        f"{share:.1%} of the voxels are {found.names[largest]}, expected several tissues: no brain, or a wrong mask "
        "or contrast",
    )


def csf_is_doubtful(found: Classes, contrast: str) -> list[str]:
    """A warning where what was found as CSF is nearly as bright as grey matter, as without CSF in the mask."""
    grey, white = found.grey_and_white
    csf = float(found.means[found.names.index("csf"), 0])
    if not is_csf_near_grey(csf, grey, white, contrast):
        return []
    return [
        f"csf ({csf:.4g}) is nearer to grey matter ({grey:.4g}) than that to white matter ({white:.4g}) and may be "
        "grey matter: check the labels, and that the brain mask includes the CSF"
    ]


def out_of_place(found: Classes, prior: np.ndarray) -> list[str]:
    """A warning where white matter is not where the atlas has it: a brain that is turned, or a phantom.

    `prior` (3, voxels) are the atlas's shares.
    """
    alike = float(np.corrcoef(prior[2], found.posteriors[found.names.index("white matter")])[0, 1])
    if alike >= _LEAST_ALIKE:
        return []
    return [
        f"white matter correlates with the atlas's by {alike:.2f}, expected {_LEAST_ALIKE:g} or more: check that the "
        "image lies as its header says, the contrast, and the brain mask"
    ]


def faint(found: Classes, noise: float) -> list[str]:
    """A warning where noise hides the difference between grey and white matter."""
    grey, white = found.grey_and_white
    if abs(white - grey) >= _LEAST_CONTRAST * noise:
        return []
    return [
        f"grey matter ({grey:.4g}) and white matter ({white:.4g}) differ by {abs(white - grey) / noise:.1f} times the "
        f"noise, expected {_LEAST_CONTRAST:g} or more: look at the labels, or add a T1 of the patient"
    ]


def _deep(image: Volume, inside: np.ndarray) -> np.ndarray:
    """(voxels,) whether each voxel `inside` (k, j, i) is far from the border of the brain, as the ventricles are."""
    step = np.maximum(np.rint(2.0 / image.spacing_mm[::-1]).astype(int), 1)
    coarse = np.pad(inside[tuple(slice(None, None, n) for n in step)], 1)
    distance = cast(np.ndarray, ndimage.distance_transform_edt(coarse, (image.spacing_mm[::-1] * step).tolist()))
    deep = distance[1:-1, 1:-1, 1:-1] > _DEEP_MM
    for axis, n in enumerate(step):
        deep = deep.repeat(n, axis)
    return deep[tuple(map(slice, inside.shape))][inside]


def implausible(found: Classes, image: Volume, inside: np.ndarray, atlas: AtlasFit | None, contrast: str) -> list[str]:
    """One line for each share that a healthy brain does not have, or a part of a brain of _LEAST_PART_ML."""
    if is_whole_brain(image, inside) and inside.sum() * image.voxel_ml < _LEAST_PART_ML:
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
