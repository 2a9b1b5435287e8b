"""What an image shows: a skull-stripped brain, a whole head, or something else, which is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import SimulationError, require, require_kind
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.alignment import DOUBTFUL_AGREEMENT, SIZES, Alignment, align_coarse
from SlicerUSSim.Logic.mri.atlas import mni152
from SlicerUSSim.Logic.mri.atlas_registration import WHOLE_BRAIN_ML
from SlicerUSSim.Logic.mri.coarse import CoarseImage, largest_component
from SlicerUSSim.Logic.mri.ct_unit import looks_like_ct
from SlicerUSSim.Logic.mri.no_data import edge_value

#: Volumes of a brain, millilitres: outside the first range a user should look, outside the second it is no brain.
USUAL_ML, POSSIBLE_ML = (1000.0, 1900.0), (500.0, 2600.0)
#: Least agreement with the template (Alignment.agreement). Heads and brains that were tried had 0.19 (proton density)
#: to 0.88; CT, bodies, phantoms, and heads that lie wrongly 0.00 to 0.14.
LEAST_AGREEMENT = 0.16
#: Where the agreement is doubtful, least overlap (Dice) of a brain on a background with noise with the template: brains
#: had 0.94 to 0.96; whole heads of 0.7 to 0.78 times their size, over which the template was spread, 0.85 to 0.90
_STRIPPED_OVERLAP = 0.915
#: A patient in a scanner nods by up to 40 degrees. Brains of adults differ by less than the other in shape.
_MOST_TURN_DEG, _MOST_STRETCH = 48.0, 1.25
#: Share of the template's brain that must show tissue, and below which a user should look
_LEAST_SHOWN, _USUAL_SHOWN = 0.75, 0.95
#: Between the 5th and 95th percentile of the inner brain, relative to its median. T1 and T2 had 0.46 to 0.82;
#: CT whose air is stored as 0 has 0.01 to 0.05 (25 to 50 HU on 1000).
_LEAST_CONTRAST = 0.1
#: Volume of what may be a head
_LEAST_HEAD_ML, _MOST_HEAD_ML = 900.0, 9000.0
#: Share of the directions in which what has the shape of a brain has a skull
_LEAST_SKULL = 0.5
#: More different values are an image.
_MOST_LABELS = 12


@dataclass(frozen=True, eq=False)
class Shown:
    """What an image shows."""

    #: (k, j, i) True in the brain of a skull-stripped image; None for a whole head
    stripped: np.ndarray | None
    #: None without the atlas, or where it was not needed
    alignment: Alignment | None = None
    warnings: tuple[str, ...] = ()


def recognise(mri: Volume, progress: Callable[[float], None] | None = None) -> Shown:
    """What the image shows. Raises SimulationError, saying what was found, if it is neither a brain nor a head."""
    report = progress or (lambda share: None)
    _check_values(mri)
    stripped = stripped_brain(mri)
    report(0.1)
    if stripped is not None:
        return Shown(stripped)
    image = CoarseImage.of(mri)
    _check_size(image, mri)
    if mni152() is None:
        return Shown(None, warnings=("without nilearn it is not checked that the image shows a head",))
    alignment = align_coarse(image, lambda share: report(0.1 + 0.9 * share))
    is_plausible = alignment.turn_deg <= _MOST_TURN_DEG and alignment.stretch <= _MOST_STRETCH
    is_plausible &= SIZES[0] <= alignment.size <= SIZES[1]
    if alignment.agreement < LEAST_AGREEMENT or not is_plausible:
        _require_no_ct(mri)
        size = " x ".join(f"{n * image.spacing_mm:.0f}" for n in image.array.shape[::-1])
        raise SimulationError(
            f"no head or brain is recognised in this {size} mm image: agreement with the atlas "
            f"{alignment.agreement:.2f}, expected {LEAST_AGREEMENT:g} or more, turned by {alignment.turn_deg:.0f} "
            f"degrees, {alignment.size:.2f} times an adult's size and stretched {alignment.stretch:.2f} times; use a "
            "T1, T2 or FLAIR of the whole head, correct the orientation or the voxel size in its header, or give a "
            "brain mask (--mask)"
        )
    return _head(mri, image, alignment)


def is_head_sized(mri: Volume) -> bool:
    """Whether what is brighter than air has the volume of a head, as a fast guess before `recognise`."""
    image = CoarseImage.of(mri)
    millilitres = image.foreground.sum() * image.spacing_mm**3 / 1000.0
    return bool(_LEAST_HEAD_ML <= millilitres <= _MOST_HEAD_ML)


def require_no_hounsfield(mri: Volume) -> None:
    """Raise SimulationError for an image with air at -1000, as a CT has."""
    values = mri.array
    low, high = float(values.min()), float(values.max())
    air = float(np.percentile(values[::3, ::3, ::3], 5.0))
    require(
        not (low <= -900.0 and air < -500.0),
        f"image has values from {low:g} to {high:g}, as CT has (Hounsfield units; air is -1000), expected an MRI; "
        "segment a CT with --ct (contrast ct); if it is an MRI, set its background to 0",
    )


def _require_no_ct(mri: Volume) -> None:
    """Raise SimulationError for an image that is no head's MRI and has the numbers of a CT, also with an offset."""
    require(
        not looks_like_ct(mri),
        f"image has values from {float(mri.array.min()):g} to {float(mri.array.max()):g}, with air and soft tissue "
        "1000 apart as CT has, expected an MRI; segment a CT with --ct (contrast ct)",
    )


def check_finite(mri: Volume, name: str = "MRI", remedy: str = "for example by 0 outside the head") -> None:
    """Raise SimulationError if voxels are not finite, naming how many and the first (i, j, k), or all are equal.

    `name` is that of the image, and `remedy` by what to replace such voxels.
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


def _check_values(mri: Volume) -> None:
    check_finite(mri)
    check_intensities(mri)
    require_no_hounsfield(mri)
    values = mri.array
    low = float(values.min())
    border = np.concatenate(
        [np.ravel(face[::3, ::3]) for n in range(3) for face in (values.take(m, n) for m in (0, -1))]
    )
    around, bright = float(np.median(border)), float(np.percentile(values[::3, ::3, ::3], 99.0))
    require(
        not (around >= bright and around > low),
        f"the background ({around:g}) is as bright as the brightest tissue ({bright:g}): the intensities are inverted, "
        "or it has a bright border; expected an MRI with a dark background",
    )


def stripped_brain(mri: Volume) -> np.ndarray | None:
    """(k, j, i) the brain of a skull-stripped image; None if it is not one.

    Its background has exactly one value, and its foreground the volume and the shape of a brain, without a skull.
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
    if not WHOLE_BRAIN_ML[0] <= millilitres <= WHOLE_BRAIN_ML[1]:
        return None
    coarse = CoarseImage.of(mri.with_array(np.where(inside, 1.0, 0.0).astype(np.float32)))
    intensity = CoarseImage.of(mri.with_array(np.where(inside, values - values.min(), 0).astype(np.float32)))
    shape = coarse.array > 0.5
    if not (_is_brain_shaped(shape) and _has_tissues(intensity.array, shape)):
        return None
    # A small head has the size and the shape of a brain
    return None if skull_share(mri, inside) > _LEAST_SKULL else inside


def _is_cut(inside: np.ndarray) -> bool:
    """Whether a mask ends at a face of the image with more than a tangent: a head without its neck looks so."""
    for axis in range(3):
        areas = inside.sum(axis=tuple(other for other in range(3) if other != axis))
        if max(areas[0], areas[-1]) > 0.3 * areas.max():
            return True
    return False


def _is_brain_shaped(shape: np.ndarray) -> bool:
    """Whether the principal axes and their ellipsoid fit: a brain is longer than wide and fills its ellipsoid."""
    points = np.argwhere(shape).astype(float)
    points -= points.mean(axis=0)
    variances, axes = np.linalg.eigh(points.T @ points / len(points))
    deviations = np.sqrt(variances)
    # Of MNI152, Colin27, three patients and the synthetic phantom: 1.15 to 1.33, 1.21 to 1.45.
    if not (1.06 <= deviations[2] / deviations[1] <= 1.7 and 1.1 <= deviations[2] / deviations[0] <= 2.0):
        return False
    radius = np.sqrt((((points @ axes) / deviations) ** 2).sum(axis=1))
    filled = float((radius <= np.sqrt(5.0)).mean())  # 0.922 to 0.999; boxes and cylinders have 0.89 to 0.905
    return filled >= 0.912


def _has_tissues(intensity: np.ndarray, shape: np.ndarray) -> bool:
    """Whether intensities inside vary as tissues do, and there is no skull: no dark shell below a brighter surface."""
    depth = 4.0 * ndimage.distance_transform_edt(shape)  # type: ignore[operator]
    smooth = ndimage.gaussian_filter(intensity, 1.0)
    deep = smooth[depth > 12.0]
    if deep.size < 100:
        return False
    low, middle, high = np.percentile(deep, (5, 50, 95))
    if high - low < 0.08 * middle:
        return False
    shells = [smooth[(depth > d) & (depth <= d + 4.0)] for d in np.arange(0.0, 32.0, 4.0)]
    profile = np.array([np.median(shell) for shell in shells if shell.size > 50])
    notch = max(min(profile[:n].max(), profile[n + 1 :].max()) - profile[n] for n in range(1, len(profile) - 1))
    return bool(notch < 0.25 * profile.max())


def _check_size(image: CoarseImage, mri: Volume) -> None:
    inside = image.foreground
    millilitres = inside.sum() * image.spacing_mm**3 / 1000.0
    if not _LEAST_HEAD_ML <= millilitres <= _MOST_HEAD_ML:
        _require_no_ct(mri)
    extent = np.ptp(np.argwhere(inside), axis=0)[::-1] * image.spacing_mm
    size = " x ".join(f"{mm + image.spacing_mm:.0f}" for mm in extent)
    require(
        millilitres >= _LEAST_HEAD_ML and extent.max() >= 110.0,
        f"image shows {millilitres:.0f} ml of tissue in {size} mm, too little for a head; "
        "correct the voxel size in its header, or use an image of the whole head",
    )
    # A head with neck has 4 to 6 litres. Nothing of a body is searched for a brain, which would take minutes.
    require(
        millilitres <= _MOST_HEAD_ML,
        f"image shows {millilitres / 1000.0:.0f} litres of tissue in {size} mm, too much for a head, as a body has; "
        "use an MRI of the head, or correct the voxel size in its header",
    )


def _head(mri: Volume, image: CoarseImage, alignment: Alignment) -> Shown:
    """A whole head, or a brain on a background with noise; in half of one there is nothing to extract."""
    counts = image.array.shape
    grid = Volume(np.zeros(counts, np.uint8), _matrix(image))
    pad = 40
    wide = Volume(np.zeros([n + 2 * pad for n in counts], np.uint8), grid.ijk_to_ras @ _shift(-pad))
    distance = alignment.brain_on(wide)
    tissue = np.pad(image.foreground, pad)
    brain = distance < -4.0
    shown = float(tissue[brain].mean())
    missing = _missing(brain, tissue) if shown < _USUAL_SHOWN else ""
    require(
        shown >= _LEAST_SHOWN,
        f"image shows only {shown:.0%} of a brain, its {missing} is cut off, expected a whole one; "
        "use a series of the whole head, or give a brain mask (--mask)",
    )
    low, middle, high = np.percentile(np.pad(image.array, pad)[distance < -8.0], (5, 50, 95))
    require(
        high - low >= _LEAST_CONTRAST * middle,
        f"the tissues of the brain in this head differ by {(high - low) / max(middle, 1e-9):.0%}, as in CT, expected "
        f"{_LEAST_CONTRAST:.0%} or more of an MRI; use an MRI, or segment a CT with --ct (contrast ct)",
    )
    warnings: tuple[str, ...] = ()
    if shown < _USUAL_SHOWN:
        warnings = (f"the image shows only {shown:.0%} of the brain; its {missing} is cut off",)
    if alignment.agreement < DOUBTFUL_AGREEMENT:
        warnings += (
            f"the atlas fits this head with an agreement of {alignment.agreement:.2f}, expected {DOUBTFUL_AGREEMENT:g} "
            "or more of a T1: check the orientation and the voxel size in its header, and the brain mask",
        )
    # In a head, scalp and muscle lie around the brain. The foreground of a stripped brain ends with it.
    around = (distance > 8.0) & (distance < 24.0)
    bright = float((np.pad(image.array, pad)[around] > 0.25 * np.median(np.pad(image.array, pad)[brain])).mean())
    if bright < 0.06:
        inside = above_noise(mri)
        covered = alignment.brain_on(mri) < 0.0
        overlap = float(2.0 * (inside & covered).sum() / (inside.sum() + covered.sum()))
        require(
            alignment.agreement >= DOUBTFUL_AGREEMENT or overlap >= _STRIPPED_OVERLAP,
            "image shows neither a head, with a scalp around the brain, nor the outline of a brain alone (agreement "
            f"with the atlas {alignment.agreement:.2f}, Dice of the outlines {overlap:.2f}): a small head, a wrong "
            "voxel size in its header, or no head; correct the header, or give a brain mask (--mask)",
        )
        return Shown(inside, alignment, warnings)
    return Shown(None, alignment, warnings)


def _missing(brain: np.ndarray, tissue: np.ndarray) -> str:
    """Which part of the brain is outside the image, such as "front"."""
    points = np.argwhere(brain)
    away = (np.argwhere(brain & ~tissue).mean(axis=0) - points.mean(axis=0)) / np.ptp(points, axis=0)
    axis = int(np.abs(away).argmax())
    return (("bottom", "top"), ("back", "front"), ("left half", "right half"))[axis][int(away[axis] > 0)]


def above_noise(mri: Volume) -> np.ndarray:
    """(k, j, i) True where the image is brighter than its background: the largest component, without holes."""
    from skimage.filters import threshold_otsu

    # Half: Otsu's threshold itself would exclude CSF in T1.
    return ndimage.binary_fill_holes(largest_component(mri.array > 0.5 * threshold_otsu(mri.array)))  # type: ignore[return-value]


def _matrix(image: CoarseImage) -> np.ndarray:
    matrix = np.diag([image.spacing_mm] * 3 + [1.0])
    matrix[:3, 3] = image.origin
    return matrix


def _shift(voxels: int) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = voxels
    return matrix


# ---- is it a head? Below its surface lies the dark skull -------------------------------------------------------------

#: Voxels that are looked at, and shells below the surface, for a head of 4000 ml; smaller objects have thinner ones
_VOXEL_MM, _SHELL_MM, _SHELLS, _WHOLE_ML = 2.0, 2.8, 18, 4000.0
#: Sectors around the centre in the upper half: along the equator, and from it to the top
_AROUND, _UPWARDS, _LEAST_VOXELS, _LEAST_SHELLS = 12, 4, 50, 6
#: A sector has a skull if a shell is darker than this part of what is brightest on either side of it
_DARK = 0.7


def skull_share(mri: Volume, inside: np.ndarray) -> float:
    """Share of the sectors of an object's upper half, `inside` (k, j, i) bool, with a dark shell below a bright one.

    Of whole heads shrunk to 0.75 and more, which have the size of a brain, 1.0; of stripped brains 0.0 to 0.17.
    """
    strides = [max(1, round(_VOXEL_MM / mm)) for mm in mri.spacing_mm[::-1]]
    every = tuple(slice(None, None, stride) for stride in strides)
    mm = np.array(strides) * mri.spacing_mm[::-1]
    values = ndimage.uniform_filter(mri.array.astype(np.float32) - float(mri.array.min()), strides)[every]  # type: ignore[arg-type]
    shown = inside[every]
    depth = ndimage.distance_transform_edt(np.pad(shown, 1), sampling=mm)[1:-1, 1:-1, 1:-1]  # type: ignore[index]
    scale = float(np.cbrt(shown.sum() * mm.prod() / 1000.0 / _WHOLE_ML))
    points = (np.argwhere(shown) - np.argwhere(shown).mean(axis=0)) * mm
    towards = points[:, ::-1] @ (mri.ijk_to_ras[:3, :3] / mri.spacing_mm).T
    height = towards[:, 2] / np.maximum(np.linalg.norm(towards, axis=1), 1e-6)
    around = ((np.arctan2(towards[:, 1], towards[:, 0]) / (2.0 * np.pi) + 0.5) * _AROUND).astype(int) % _AROUND
    sector = around * _UPWARDS + np.clip((height * _UPWARDS).astype(int), 0, _UPWARDS - 1)
    shell = (depth[shown] / (_SHELL_MM * scale)).astype(int)
    used = (height > 0.0) & (shell < _SHELLS)
    key, found = (sector * _SHELLS + shell)[used], values[shown][used]
    counts = np.bincount(key, minlength=_AROUND * _UPWARDS * _SHELLS)
    medians = np.full(len(counts), np.nan)
    present = np.flatnonzero(counts > 5)
    medians[present] = ndimage.median(found, key, present)
    with_skull = []
    sectors = _AROUND * _UPWARDS, _SHELLS
    for profile, total in zip(medians.reshape(sectors), counts.reshape(sectors).sum(axis=1), strict=True):
        profile = profile[np.isfinite(profile)]
        if total < _LEAST_VOXELS or len(profile) < _LEAST_SHELLS:
            continue
        beside = [min(profile[:n].max(), profile[n + 1 :].max()) for n in range(1, len(profile) - 1)]
        with_skull.append((profile[1:-1] < _DARK * np.array(beside)).any())
    return float(np.mean(with_skull)) if with_skull else 0.0
