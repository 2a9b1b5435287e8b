"""What an image shows: a skull-stripped brain, or a whole head. What the atlas does not fit at all is refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import SimulationError, require, require_kind
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.alignment import Alignment, align_template
from SlicerUSSim.Logic.mri.coarse import largest_component
from SlicerUSSim.Logic.mri.ct_unit import why_ct
from SlicerUSSim.Logic.mri.edges import edge_value

#: Volumes of a brain, millilitres: outside the first a user should check it, outside the second it is not a brain.
USUAL_ML, POSSIBLE_ML = (1000.0, 1900.0), (500.0, 2600.0)
#: Share of an image that the atlas's tissues have to explain (alignment.explained). Heads had 0.10 (6.5 mm slices) to
#: 0.60; phantoms, bodies, noise, ultrasound and heads upside down 0.01 to 0.07
LEAST_EXPLAINED = 0.07
#: Brighter than this part of the brain is tissue; a head has it in more than that share of what is 8 to 24 mm around
_BRIGHT, _LEAST_AROUND = 0.25, 0.06
#: More different values are an image.
_MOST_LABELS = 12


def recognise(mri: Volume, progress: Callable[[float], None] | None = None) -> np.ndarray | Alignment:
    """(k, j, i) True in the brain of a skull-stripped image, or the fitted atlas for a head.

    Raises SimulationError, with how well the atlas fits, if the image shows neither a brain nor a head.
    """
    check_finite(mri)
    check_intensities(mri)
    require_no_ct(mri)
    stripped = stripped_brain(mri)
    if stripped is not None:
        return stripped
    alignment = align_template(mri, progress)
    share = alignment.explained
    if share < LEAST_EXPLAINED:
        size = " x ".join(f"{n * mm:.0f}" for n, mm in zip(mri.array.shape[::-1], mri.spacing_mm, strict=True))
        raise SimulationError(
            f"no head or brain is recognised in this {size} mm image: the atlas explains {share:.0%} of it, expected "
            f"{LEAST_EXPLAINED:.0%} or more; correct the orientation or the voxel size in its header, or give a brain "
            "mask (--mask)"
        )
    distance, air = alignment.brain_on(mri), float(np.percentile(mri.array, 1.0))
    level = air + _BRIGHT * (float(np.median(mri.array[distance < -8.0])) - air)
    around = mri.array[(distance > 8.0) & (distance < 24.0)]
    return alignment if np.mean(around > level) > _LEAST_AROUND else above_noise(mri)


def require_no_ct(mri: Volume) -> None:
    """Raise SimulationError for a CT."""
    why = why_ct(mri)
    require(why is None, f"the image is a CT ({why}), expected an MRI; segment_ct and segment_image segment a CT")


def check_finite(mri: Volume, name: str = "MRI", remedy: str = "for example by 0 outside the head") -> None:
    """Raise SimulationError if voxels are not finite, naming how many and the first (i, j, k), or all are equal.

    `name` of the image; `remedy`: by what to replace such voxels.
    """
    values = mri.array
    if np.issubdtype(values.dtype, np.floating):
        is_bad = ~np.isfinite(values)
        if is_bad.any():
            first = tuple(int(n) for n in np.unravel_index(int(is_bad.argmax()), values.shape)[::-1])
            raise SimulationError(
                f"{name} has {int(is_bad.sum())} voxels that are not finite numbers, the first at (i, j, k) = {first}, "
                f"expected none; replace them, {remedy}"
            )
    low, high = float(values.min()), float(values.max())
    require(high > low, f"{name} is constant ({low:g}), expected different intensities")


def check_intensities(mri: Volume, name: str = "MRI") -> None:
    """Raise SimulationError if the image `name` has as few different values as a mask or a label map."""
    require_kind(name, mri, Volume, "Volume.read reads a file")
    sample = np.unique(mri.array[::3, ::3, ::3])
    require(
        len(sample) > _MOST_LABELS,
        f"{name} has only {len(sample)} different values, as a mask or label map has, expected the intensities of an "
        "MRI; a lesion is added to one with --add tumour=FILE",
    )


def stripped_brain(mri: Volume) -> np.ndarray | None:
    """(k, j, i) the brain of a skull-stripped image; None if it is not one.

    Its background has exactly one value, and its foreground the volume of a brain and no end at a face of the image.
    """
    values = mri.array
    background, share = edge_value(values)
    if share < 0.5 or (values == background).mean() < 0.15:
        return None
    inside = largest_component(values != background)
    if _is_cut(inside):
        return None
    inside = cast(np.ndarray, ndimage.binary_fill_holes(inside))
    millilitres = inside.sum() * mri.voxel_ml
    return inside if POSSIBLE_ML[0] <= millilitres <= POSSIBLE_ML[1] else None


def _is_cut(inside: np.ndarray) -> bool:
    """Whether a mask ends at a face of the image with more than a tangent: a head without its neck looks so."""
    for axis in range(3):
        areas = inside.sum(axis=tuple(other for other in range(3) if other != axis))
        if max(areas[0], areas[-1]) > 0.3 * areas.max():
            return True
    return False


def above_noise(mri: Volume) -> np.ndarray:
    """(k, j, i) True where the image is brighter than its background: the largest component, without holes."""
    from skimage.filters import threshold_otsu

    # Half: Otsu's threshold itself would exclude CSF in T1.
    return ndimage.binary_fill_holes(largest_component(mri.array > 0.5 * threshold_otsu(mri.array)))  # type: ignore[return-value]
