"""Segmentation of an MRI: brain, atlas, filter, bias, mixture of tissues (docs/physics.md#1-from-mri-to-tissues)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import about_other_file, require, require_kind
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.atlas_registration import AtlasFit
from SlicerUSSim.Logic.mri.brain import BrainMask, find_brain, given_brain
from SlicerUSSim.Logic.mri.classification import FILTER_BLUR, class_names, classify
from SlicerUSSim.Logic.mri.coarse import with_thin_slices
from SlicerUSSim.Logic.mri.coregistration import aligned
from SlicerUSSim.Logic.mri.evidence import Evidence
from SlicerUSSim.Logic.mri.filtering import denoised, estimate_noise as estimate_noise
from SlicerUSSim.Logic.mri.nuclei import with_nuclei
from SlicerUSSim.Logic.mri.outside import find_outside, require_findable
from SlicerUSSim.Logic.mri.plausibility import enhancing, implausible, require_contrast, unsure
from SlicerUSSim.Logic.mri.recognition import check_intensities, require_no_ct
from SlicerUSSim.Logic.mri.segmentation_settings import SegmentationSettings
from SlicerUSSim.Logic.mri.segmentation_steps import (
    BrainPart,
    atlas_of,
    finite,
    narrow_sulci,
    remove_fields,
    require_different,
)
from SlicerUSSim.Logic.opencl.device import DeviceChoice
from SlicerUSSim.Logic.tissue.label_sources import not_intensities
from SlicerUSSim.Logic.tissue.texture import Texture, tissue_deviation, volume_shares

_log = logging.getLogger(__name__)

#: Least volume of a mask in which several images are compared
_LEAST_TO_REGISTER_ML = 100.0
#: Share of the time that finding the brain in a whole head takes, and share before the search outside it begins
_SHARE_OF_BRAIN, _SHARE_OF_TISSUES = 0.6, 0.75
#: Size of voxels above which thin sulci, which are narrower, cannot be found: tissues mix across them
_THICK_SLICE_MM = 3.5
#: Least mean for which the table has two decimals; it has three digits below
_LARGE = 10.0


@dataclass(frozen=True, eq=False)
class Segmentation:
    """A label map, and the mixture of tissues from which it was computed."""

    #: uint8; label n + 1 is class n, 0 is background; one extra label for thin sulci
    labels: Volume
    #: Name of label n + 1
    tissue_names: tuple[str, ...]
    #: (classes,) in the unit of the MRI; CSF and white matter have the same standard deviation
    means: np.ndarray
    standard_deviations: np.ndarray
    #: (classes,) share of every class in the brain, summing to 1
    weights: np.ndarray
    #: One per EM iteration
    log_likelihoods: np.ndarray
    #: Standard deviation of the estimated noise, and the filter's epsilon
    noise: float
    filter_epsilon: float
    #: Region that was segmented, and how it was found
    brain: BrainMask
    #: Lines for the user: what was recognised and decided, and what should be checked
    notes: tuple[str, ...]
    warnings: tuple[str, ...]
    #: The images in the box of the brain, on which lesions are proposed
    evidence: Evidence = field(repr=False)
    #: (k, j, i) float32 the first image without its bias field, before the filter; 0 outside the brain
    corrected: np.ndarray = field(repr=False)
    _filtered: np.ndarray = field(repr=False)
    #: (classes, voxels of the brain)
    _shares: np.ndarray = field(repr=False)

    @property
    def atlas(self) -> AtlasFit | None:
        """The registered atlas by which tissues were led; None without one."""
        return self.evidence.atlas

    @property
    def _in_brain(self) -> np.ndarray:
        return self.brain.mask.array > 0

    @property
    def posteriors(self) -> np.ndarray:
        """(classes, k, j, i) float32 probability that each tissue fills most of the voxel; 0 in the background."""
        foreground = self._in_brain
        result = np.zeros((len(self.means), *foreground.shape), np.float32)
        result[:, foreground] = self._shares
        return result

    def texture(self) -> Texture:
        """Information of the MRI beyond labels: the second most probable tissue of every voxel with its probability
        relative to the two and the part of the voxel it fills, and the filtered intensity in standard deviations of its
        tissue."""
        foreground = self._in_brain
        labels = np.where(foreground, self.labels.array, 0).astype(np.uint8)
        label, posteriors = labels[foreground], self._shares.copy()
        sure = label > len(self.means)  # thin sulci do not come from the mixture
        own = np.where(sure, 1, label)[None].astype(np.intp) - 1
        first = np.take_along_axis(posteriors, own, 0)[0]
        np.put_along_axis(posteriors, own, -1.0, 0)
        other = np.maximum(posteriors.max(axis=0), 0.0)
        second_label, second_share = np.zeros(labels.shape, np.uint8), np.zeros(labels.shape, np.float32)
        second_label[foreground] = posteriors.argmax(axis=0) + 1
        second_share[foreground] = np.where(sure, 0.0, other / np.maximum(first + other, 1e-12))
        shares = volume_shares(self._filtered, labels, second_label, second_share)
        return Texture(second_label, second_share, tissue_deviation(self._filtered, labels), shares)

    def table(self) -> str:
        """Share, volume, mean intensity and standard deviation of every label that occurs, one per line."""
        return label_table(self.labels, self.tissue_names, self.means, self.standard_deviations)


def label_table(labels: Volume, names: tuple[str, ...], means: np.ndarray, deviations: np.ndarray) -> str:
    """A line for every label that occurs: share, volume, and mean and deviation of those that have them."""
    counts = np.bincount(labels.array.ravel(), minlength=len(names) + 1)[1:]
    digits = ".2f" if np.abs(means).max() >= _LARGE else ".3g"  # of images from 0 to 1, or 1e-6
    lines = [f"{'label':>5}  {'tissue':15} {'share':>6} {'ml':>8} {'mean':>9} {'sd':>8}"]
    for n, name in enumerate(names):
        if not counts[n]:  # of a part of a brain, or under what was added
            continue
        numbers = f" {means[n]:9{digits}} {deviations[n]:8{digits}}" if n < len(means) else ""
        share = counts[n] / max(counts.sum(), 1)
        lines.append(f"{n + 1:5d}  {name:15} {share:6.1%} {counts[n] * labels.voxel_ml:8.1f}{numbers}")
    return "\n".join(lines)


def segment_mri(
    mri: Volume,
    settings: SegmentationSettings | None = None,
    *,
    others: Mapping[str, Volume] | None = None,
    mask: Volume | None = None,
    keep_mask_at: Path | None = None,
    device: DeviceChoice = None,
    progress: Callable[[float], None] | None = None,
    **values: Any,
) -> Segmentation:
    """Label the tissues of a brain MRI by intensity, led by an atlas in a whole brain.

    Parameters
    ----------
    mri : the image: a whole head, a skull-stripped brain, or any image with a `mask`.
    settings : or single ones by name, from `classes` on: contrast="t2".
    others : more volumes of the same patient by their contrast, on any grid. They are registered to `mri` rigidly and
        classified together with it; labels are then CSF, grey and white matter, and what enhances.
    mask : foreground on the same grid (non-zero is inside); default: found by `skull_strip`.
        Slices of more than 3 mm are divided into ones of at most 1.5 mm first, and labels have these.
    keep_mask_at : file in which the mask of a whole head is kept, so that it is extracted once; see brain.find_brain.
    progress : called with the completed fraction, 0 to 1.
    classes : number of tissues; default: 3, or 4 with contrast agent, whose fourth is what enhances.
    contrast : "t1", "t1gd", "t2" or "flair"; orders and names the classes.
    bias_correction : remove the bias field, with N4 (some seconds); default: where the image has one, with N4 only
        where it is strong or there is no atlas; see bias.corrected.
    thin_sulci : also label the middle of sulci that are too narrow to reach CSF intensity, one voxel thick, as an extra
        tissue "leptomeninges" within the grey matter. Ultrasound shows these sulci, but intensity classes miss them.
        Voxels of more than 3.5 mm do not show them, which the notes state.
    outside : also label the tissues outside the brain of a whole head (t1, t1gd), after all others: see
        outside.find_outside. Probabilities cover the brain alone.
    skull_strip : how the brain is found without a `mask`; see brain.find_brain.

    Raises SimulationError for an unknown contrast or number of classes, an image that is constant or not finite or has
    the order of intensities of another contrast, a mask that is empty or on another grid, and volumes that are not of
    one patient.

    >>> from SlicerUSSim.Logic import segment_mri
    >>> from SlicerUSSim.Logic.mri import head_mri
    >>> segmentation = segment_mri(head_mri(spacing_mm=4.0), contrast="t1")
    >>> segmentation.tissue_names  # of labels 1, 2, 3
    ('csf', 'grey matter', 'white matter')
    >>> segmentation.labels.array.dtype
    dtype('uint8')
    """
    require_kind("mri", mri, Volume, "Volume.read reads a file")
    settings = SegmentationSettings.of(settings, **values)
    contrast = settings.contrast
    told = progress or (lambda share: None)
    begin = _SHARE_OF_BRAIN if mask is None else 0.0
    end = _SHARE_OF_TISSUES if settings.outside else 1.0
    report = lambda share: told(begin + (end - begin) * share)  # noqa: E731
    others = dict(others or {})
    require(
        contrast not in others,
        f"there are two volumes of contrast {contrast}, expected one: choose another contrast for the second",
    )
    contrasts = (contrast, *others)
    names = class_names(contrasts, settings.classes)
    if settings.outside:
        require_findable(contrast, settings.skull_strip, mask is not None)
    thickest_mm = float(mri.spacing_mm.max())
    if mask is not None and mask.array.shape == mri.array.shape:
        mask = with_thin_slices(mask, interpolate=False)
    mri = image = with_thin_slices(replace(mri, array=finite(mri)))
    if mask is None and settings.skull_strip != "none":
        _require_intensities(mri, "MRI")
    if mask is None:
        brain = find_brain(
            image, settings.skull_strip, keep_at=keep_mask_at, progress=lambda share: told(begin * share)
        )
    else:
        require_no_ct(mri)
        brain = given_brain(mask, mri)
        require(
            not others or brain.volume_ml >= _LEAST_TO_REGISTER_ML,
            f"the mask has {brain.volume_ml:.3g} ml, expected a brain or a large part of one, from which volumes are "
            "registered to each other; a lesion is added with --add tumour=FILE",
        )
    require(
        not settings.outside or brain.method != "stripped",
        "image is a brain without its head (skull-stripped), and tissue outside the brain (--outside) is found in a "
        "whole head",
    )
    # Blocks of coarse images begin at the first voxel: in any order of voxels but this, others would
    foreground = brain.mask.along().array > 0
    report(0.05)
    notes, warnings = [brain.message], [*brain.warnings]
    images = [image.along()]
    for name, other in others.items():
        named = _called(name, other)
        with about_other_file(named):
            _require_intensities(other, named)
            image, message = aligned(other.with_array(finite(other)).along(), images[0], foreground, named)
        images.append(image)
        notes.append(message)
        voxel_mm = float(other.spacing_mm.max())
        if voxel_mm > max(_THICK_SLICE_MM, thickest_mm):
            warnings.append(
                f"{named} has voxels of {voxel_mm:.3g} mm, across which its tissues mix: compare with the labels of "
                f"the {contrast} alone"
            )
    if others and brain.method != "given":
        notes.append(
            f"the brain mask is of the {contrast} image alone: tissue outside it stays out, also where "
            f"{' and '.join(others)} shows it"
        )
    part = BrainPart.of(images, foreground)
    raised, above = part.raised(contrasts)
    notes += raised
    atlas, message, fits = atlas_of(part, report)
    notes.append(message)
    report(0.4)
    prior = atlas.prior(part.images[0], part.inside) if atlas else None
    if prior is not None:
        warnings += require_contrast(part.images[0], part.inside, prior, contrast)
        for (name, other), image in zip(others.items(), part.images[1:], strict=True):
            with about_other_file(_called(name, other)):
                warnings += require_contrast(image, part.inside, prior, name)

    if settings.bias_correction is not False:
        share = lambda done: report(0.4 + 0.3 * done)  # noqa: E731
        notes += remove_fields(part, contrasts, atlas, prior, settings.bias_correction, share)
    report(0.7)
    filtered = [
        denoised(image.array, part.inside, settings.filter_radius, settings.filter_epsilon, device)
        for image in part.images
    ]
    report(0.8)
    intensities = np.stack([image[part.inside] for image, _, _ in filtered])
    require_different(intensities, contrasts)
    voxel_mm = float(mri.spacing_mm.mean())
    found = classify(intensities, contrasts, names, prior, FILTER_BLUR if settings.filter_radius else 1.0, voxel_mm)
    if atlas:
        found = with_nuclei(found, intensities, atlas, part.images[0], part.inside)
    found = replace(found, posteriors=less_sure(smoothed_posteriors(found.posteriors, part.inside)))
    report(0.9)
    warnings += implausible(found, brain.volume_ml, contrast) + unsure(found, fits, atlas is not None)
    if contrasts == ("t1",) and len(names) == 3:
        warnings += enhancing(filtered[0][0], part.inside, found, part.images[0].voxel_ml)

    labels = np.zeros(part.inside.shape, np.uint8)
    labels[part.inside] = found.posteriors.argmax(axis=0) + 1
    tissue_names = names
    if settings.thin_sulci and thickest_mm > _THICK_SLICE_MM:
        notes.append(f"thin sulci get no separate label: voxels of {thickest_mm:.3g} mm are thicker than they are")
    elif settings.thin_sulci:
        middles = narrow_sulci(labels, found, filtered[0][0], filtered[0][1])
        labels[middles] = len(names) + 1
        tissue_names = (*names, "leptomeninges")
        _log.info("thin sulci: %d voxels become leptomeninges", int(middles.sum()))
    whole = images[0].with_array(part.whole(labels))
    if settings.outside:
        around = find_outside(images[0], foreground, lambda share: told(end + (1.0 - end) * share))
        whole, tissue_names = around.over(whole, tissue_names)
        notes.append(around.text(mri.voxel_ml))
        warnings += around.warnings
    for line in notes:
        _log.info("%s", line)
    for line in warnings:
        _log.warning("%s", line)
    told(1.0)

    def as_given(array: np.ndarray) -> Volume:
        return images[0].with_array(part.whole(array)).along(mri)

    known = BrainPart.of([as_given(image) for image, _, _ in filtered], brain.mask.array > 0)
    number = np.zeros(part.inside.shape, np.int32)
    number[part.inside] = np.arange(np.count_nonzero(part.inside))
    return Segmentation(
        labels=mri.with_array(whole.along(mri).array),
        tissue_names=tissue_names,
        means=found.means[:, 0] + above,
        standard_deviations=found.standard_deviations[:, 0],
        weights=found.posteriors.mean(axis=1, dtype=float),
        log_likelihoods=found.mixture.log_likelihoods,
        noise=filtered[0][1],
        filter_epsilon=filtered[0][2],
        brain=brain,
        notes=tuple(notes),
        warnings=tuple(warnings),
        evidence=Evidence(
            contrasts,
            np.stack([image.array for image in known.images]),
            known.inside,
            known.images[0].ijk_to_ras,
            known.start,
            known.whole_shape,
            found.mixture.means,
            np.sqrt(np.diag(found.mixture.covariance)),
            atlas,
        ),
        corrected=as_given(np.where(part.inside, part.images[0].array + np.float32(above), np.float32(0.0))).array,
        _filtered=as_given(filtered[0][0]).array,
        _shares=found.posteriors[:, as_given(number).array[brain.mask.array > 0]],
    )


def _called(name: str, volume: object) -> str:
    """The image and its file in messages: "t2 (scan.nii.gz)"."""
    return f"{name} ({volume.name})" if isinstance(volume, Volume) and volume.name else name


def _require_intensities(volume: Volume, name: str) -> None:
    """Raise SimulationError for a label map, or the remains of one."""
    check_intensities(volume, name)
    why = not_intensities(volume)
    require(why is None, f"{name} {why}")


# ---- a weak Markov random field (Zhang et al., IEEE TMI 20(1), 2001): neighbours share a tissue ----------------------

#: Weight of a neighbour, and number of mean-field iterations. With 0.25 posteriors are too sure: of those given 75 %,
#: 63 to 73 % are right
_WEIGHT, _ITERATIONS = 0.15, 3
#: Posterior from which a voxel is left alone: six neighbours move log-odds by 0.9 at most, and these are above 4
_SURE = 0.985
#: Factor of all log-odds: neighbours do not err independently, so that what they agree on is less sure than it seems
_EVIDENCE = 0.9


def smoothed_posteriors(posteriors: np.ndarray, inside: np.ndarray, weight: float = _WEIGHT) -> np.ndarray:
    """(classes, voxels) posteriors of the voxels `inside` (k, j, i), led by those of their six neighbours.

    Mean field: every voxel has the log-odds of its intensity plus `weight` times the sum of the neighbours'
    posteriors. Voxels whose intensity leaves no doubt keep theirs.
    """
    open_ = np.flatnonzero(posteriors.max(axis=0) < _SURE)
    if not len(open_):
        return posteriors
    # A row per voxel, and one of zeros for whatever is outside.
    rows = np.zeros((posteriors.shape[1] + 1, len(posteriors)), np.float32)
    rows[:-1] = posteriors.T
    numbers = np.full([n + 2 for n in inside.shape], posteriors.shape[1], np.int32)
    numbers[1:-1, 1:-1, 1:-1][inside] = np.arange(posteriors.shape[1], dtype=np.int32)
    flat = numbers.ravel()
    places = np.flatnonzero(flat < posteriors.shape[1])[open_]
    steps = (1, numbers.shape[2], numbers.shape[1] * numbers.shape[2])
    around = [flat[places + way * step] for step in steps for way in (-1, 1)]
    own = rows[open_]
    for _ in range(_ITERATIONS):
        total = rows[around[0]]
        for neighbour in around[1:]:
            total += rows[neighbour]
        moved = own * np.exp(weight * total)
        rows[open_] = moved / moved.sum(axis=1, keepdims=True)
    return np.ascontiguousarray(rows[:-1].T)


def less_sure(posteriors: np.ndarray) -> np.ndarray:
    """(classes, voxels) posteriors of smaller log-odds; the most probable class of every voxel stays the same."""
    scaled = posteriors ** np.float32(_EVIDENCE)
    return scaled / scaled.sum(axis=0)
