"""Segmentation of an MRI: brain, atlas, filter, bias, mixture of tissues (docs/physics.md#1-from-mri-to-tissues)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import cast

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.atlas import mni152
from SlicerUSSim.Logic.mri.atlas_registration import AtlasFit, register_atlas
from SlicerUSSim.Logic.mri.bias import corrected
from SlicerUSSim.Logic.mri.brain import BrainMask, find_brain, given_brain
from SlicerUSSim.Logic.mri.classification import FILTER_BLUR, class_names, classify
from SlicerUSSim.Logic.mri.coregistration import aligned
from SlicerUSSim.Logic.mri.filtering import denoised, estimate_noise as estimate_noise
from SlicerUSSim.Logic.mri.neighbours import smoothed_posteriors
from SlicerUSSim.Logic.mri.plausibility import implausible, is_whole_brain, require_contrast
from SlicerUSSim.Logic.mri.recognition import check_finite
from SlicerUSSim.Logic.mri.settings import SegmentationSettings
from SlicerUSSim.Logic.mri.sulci import sulcal_middles
from SlicerUSSim.Logic.opencl.device import DeviceChoice
from SlicerUSSim.Logic.tissue.texture import Texture, tissue_deviation

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Segmentation:
    """A label map, and the mixture of tissues from which it was computed."""

    #: uint8; label n + 1 is class n, 0 is background; one extra label for thin sulci
    labels: Volume
    #: Name of label n + 1
    tissue_names: tuple[str, ...]
    #: (classes,) in the unit of the MRI; the standard deviation is the same for CSF, grey and white matter
    means: np.ndarray
    standard_deviations: np.ndarray
    #: (classes,) share of every class in the brain, summing to 1
    weights: np.ndarray
    #: One per EM iteration, never decreasing
    log_likelihoods: np.ndarray
    #: Standard deviation of the estimated noise, and the filter's epsilon
    noise: float
    filter_epsilon: float
    #: Where tissues were looked for, and how it was found
    brain: BrainMask
    #: Lines for the user: what was recognised and decided, and what should be checked
    notes: tuple[str, ...]
    warnings: tuple[str, ...]
    _filtered: np.ndarray = field(repr=False)
    #: (classes, voxels of the brain)
    _shares: np.ndarray = field(repr=False)

    @property
    def posteriors(self) -> np.ndarray:
        """(classes, k, j, i) float32 probability that each tissue fills most of the voxel; 0 in the background."""
        foreground = self.labels.array > 0
        result = np.zeros((len(self.means), *foreground.shape), np.float32)
        result[:, foreground] = self._shares
        return result

    def texture(self) -> Texture:
        """Information of the MRI beyond labels: the second most probable tissue of every voxel with its probability
        relative to the two, and the filtered intensity in standard deviations of its tissue."""
        labels = self.labels.array
        foreground = labels > 0
        label, posteriors = labels[foreground], self._shares.copy()
        sure = label > len(self.means)  # thin sulci do not come from the mixture
        own = np.where(sure, 1, label)[None].astype(np.intp) - 1
        first = np.take_along_axis(posteriors, own, 0)[0]
        np.put_along_axis(posteriors, own, -1.0, 0)
        other = np.maximum(posteriors.max(axis=0), 0.0)
        second_label, second_share = np.zeros(labels.shape, np.uint8), np.zeros(labels.shape, np.float32)
        second_label[foreground] = posteriors.argmax(axis=0) + 1
        second_share[foreground] = np.where(sure, 0.0, other / np.maximum(first + other, 1e-12))
        return Texture(second_label, second_share, tissue_deviation(self._filtered, labels))

    def table(self) -> str:
        """Share, volume, mean intensity and standard deviation of every label, one per line."""
        counts = np.bincount(self.labels.array.ravel(), minlength=len(self.tissue_names) + 1)[1:]
        millilitres = counts * float(np.prod(self.labels.spacing_mm)) / 1000.0
        lines = [f"{'label':>5}  {'tissue':14} {'share':>6} {'ml':>7} {'mean':>9} {'sd':>8}"]
        for n, name in enumerate(self.tissue_names):
            numbers = ""
            if n < len(self.means):
                numbers = f" {self.means[n]:9.2f} {self.standard_deviations[n]:8.2f}"
            lines.append(
                f"{n + 1:5d}  {name:14} {counts[n] / max(counts.sum(), 1):6.1%} {millilitres[n]:7.1f}{numbers}"
            )
        return "\n".join(lines)


def segment_mri(
    mri: Volume,
    *,
    classes: int | None = SegmentationSettings.classes,
    contrast: str = SegmentationSettings.contrast,
    others: Mapping[str, Volume] | None = None,
    mask: Volume | None = None,
    filter_radius: int = SegmentationSettings.filter_radius,
    filter_epsilon: float | None = SegmentationSettings.filter_epsilon,
    bias_correction: bool | None = SegmentationSettings.bias_correction,
    thin_sulci: bool = False,
    skull_strip: str = SegmentationSettings.skull_strip,
    keep_mask_at: Path | None = None,
    device: DeviceChoice = None,
    progress: Callable[[float], None] | None = None,
) -> Segmentation:
    """Label the tissues of a brain MRI by intensity, led by an atlas where nilearn and a whole brain are there.

    Parameters
    ----------
    mri : the image: a whole head, a skull-stripped brain, or any image with a `mask`.
    classes : number of tissues; default: 3, or 4 with contrast agent, whose fourth is what enhances.
    contrast : "t1", "t1gd", "t2" or "flair"; orders and names the classes.
    others : more volumes of the same patient by their contrast, on any grid. They are registered to `mri` rigidly and
        classified together with it; labels are then CSF, grey and white matter, and what enhances.
    mask : foreground on the same grid (non-zero is inside); default: found by `skull_strip`.
    filter_radius : of the guided filter in voxels; 0 disables it.
    filter_epsilon : of the guided filter, squared intensity; default: from the noise estimated in the image.
    bias_correction : remove the bias field, with N4 (some seconds); default: where the image has one, with N4 only
        where it is strong or there is no atlas; see bias.corrected.
    thin_sulci : also label the middle of sulci that are too narrow to reach CSF intensity, one voxel thick, as an extra
        tissue "leptomeninges" within the grey matter. Ultrasound shows these sulci, but intensity classes miss them.
    skull_strip : how the brain is found without a `mask`; see brain.find_brain.
    keep_mask_at : file in which the mask of a whole head is kept, so that it is extracted once; see brain.find_brain.
    progress : called with the completed fraction, 0 to 1.

    Raises SimulationError for an unknown contrast or number of classes, an image that is constant or not finite or has
    the order of intensities of another contrast, a mask that is empty or on another grid, and volumes that are not of
    one patient.

    >>> from SlicerUSSim.Logic import segment_mri
    >>> from SlicerUSSim.Logic.mri import head_mri
    >>> segmentation = segment_mri(head_mri(spacing_mm=3.0), contrast="t1")
    >>> segmentation.tissue_names  # of labels 1, 2, 3
    ('csf', 'grey matter', 'white matter')
    >>> segmentation.labels.array.dtype
    dtype('uint8')
    """
    report = progress or (lambda share: None)
    others = dict(others or {})
    require(
        contrast not in others, f"others has a second volume of contrast {contrast}, expected one volume per contrast"
    )
    contrasts = (contrast, *others)
    names = class_names(contrasts, classes)
    settings = SegmentationSettings(
        contrast, classes, skull_strip, thin_sulci, bias_correction, filter_radius, filter_epsilon
    )
    timed = _StepTimes()
    intensity = _finite(mri)
    if mask is None:
        brain = find_brain(
            mri.with_array(intensity), settings.skull_strip, keep_at=keep_mask_at,
            progress=lambda share: report(0.2 * share),
        )  # fmt: skip
    else:
        brain = given_brain(mask, mri)
    foreground = brain.mask.array > 0
    timed("brain")
    report(0.2)
    notes, warnings = [brain.message], [*brain.warnings]
    images = [mri.with_array(intensity)]
    for name, other in others.items():
        image, message = aligned(other.with_array(_finite(other)), images[0], foreground, name)
        images.append(image)
        notes.append(message)
    if others:
        timed("registration")
    part = _Part.of(images, foreground)
    atlas, message = _atlas_of(part, report)
    notes.append(message)
    timed("atlas")
    report(0.4)
    prior = atlas.prior(part.images[0], part.inside) if atlas else None
    if prior is not None:
        for name, image in zip(contrasts, part.images, strict=True):
            warnings += require_contrast(image, part.inside, prior, name)

    if bias_correction is not False:
        for n, (name, image) in enumerate(zip(contrasts, part.images, strict=True)):
            share = lambda done, n=n: report(0.4 + 0.3 * (n + done) / len(contrasts))  # noqa: E731
            result = corrected(image, part.inside, name, atlas, prior, bias_correction, share)
            part.images[n] = result.image
            notes.append(result.message)
        timed("bias field")
    report(0.7)
    filtered = [
        denoised(image.array, part.inside, settings.filter_radius, settings.filter_epsilon, device)
        for image in part.images
    ]
    timed("filter")
    report(0.8)
    values = np.stack([image[part.inside] for image, _, _ in filtered])
    for name, channel in zip(contrasts, values, strict=True):
        require(
            float(channel.max()) > float(channel.min()),
            f"MRI is constant ({channel[0]:g}) inside the foreground, expected tissues of different intensity"
            + (f" in {name}" if others else ""),
        )
    found = classify(values, contrasts, names, prior, FILTER_BLUR if settings.filter_radius else 1.0)
    timed("mixture")
    found = replace(found, posteriors=smoothed_posteriors(found.posteriors, part.inside))
    timed("neighbours")
    report(0.9)
    warnings += implausible(found, part.images[0], part.inside, atlas, contrast)

    labels = np.zeros(part.inside.shape, np.uint8)
    labels[part.inside] = found.posteriors.argmax(axis=0) + 1
    means = found.means[:, 0]
    if thin_sulci:
        csf, grey = names.index("csf"), names.index("grey matter")
        middles = sulcal_middles(filtered[0][0], labels, grey + 1, means[csf], means[grey], filtered[0][1])
        # CSF less than two voxels thick is such a sulcus too; as CSF it would form isolated droplets, each a lens.
        is_csf = labels == csf + 1
        middles |= is_csf & ~cast(np.ndarray, ndimage.binary_opening(is_csf, np.ones((2, 2, 2))))
        labels[middles] = len(names) + 1
        tissue_names = (*names, "leptomeninges")
        timed("thin sulci")
        _log.info("thin sulci: %d voxels become leptomeninges", int(middles.sum()))
    else:
        tissue_names = names
    for line in notes:
        _log.info("%s", line)
    for line in warnings:
        _log.warning("%s", line)
    _log.debug("segmentation: %s", timed)
    report(1.0)
    return Segmentation(
        labels=mri.with_array(part.whole(labels)),
        tissue_names=tissue_names,
        means=means,
        standard_deviations=found.standard_deviations[:, 0],
        weights=found.posteriors.mean(axis=1, dtype=float),
        log_likelihoods=found.mixture.log_likelihoods,
        noise=filtered[0][1],
        filter_epsilon=filtered[0][2],
        brain=brain,
        notes=tuple(notes),
        warnings=tuple(warnings),
        _filtered=part.whole(filtered[0][0]),
        _shares=found.posteriors,
    )


@dataclass(eq=False)
class _Part:
    """The images and the mask within the box of the brain."""

    images: list[Volume]
    inside: np.ndarray
    _box: tuple[slice, ...]
    _shape: tuple[int, ...]

    @classmethod
    def of(cls, images: list[Volume], inside: np.ndarray) -> _Part:
        found = ndimage.find_objects(inside.astype(np.uint8))[0]
        box = tuple(slice(max(side.start - 2, 0), side.stop + 2) for side in found)
        matrix = images[0].ijk_to_ras.copy()
        matrix[:3, 3] = (matrix @ [*(side.start for side in reversed(box)), 1.0])[:3]
        parts = [Volume(np.ascontiguousarray(image.array[box], np.float32), matrix) for image in images]
        return cls(parts, inside[box], box, inside.shape)

    def whole(self, array: np.ndarray) -> np.ndarray:
        """An array of the box on the whole grid, 0 elsewhere."""
        result = np.zeros(self._shape, array.dtype)
        result[self._box] = array
        return result


def _atlas_of(part: _Part, report: Callable[[float], None]) -> tuple[AtlasFit | None, str]:
    """The registered atlas, or None where it is of no use; and a line that says why."""
    reason = is_whole_brain(part.images[0], part.inside)
    if reason:
        return None, f"without an atlas, since {reason}"
    atlas = mni152()
    if atlas is None:
        return None, 'without an atlas; install "SlicerUSSim[demo]" for one'
    fit = register_atlas(part.images[0], part.inside, atlas, lambda share: report(0.2 + 0.2 * share))
    if not fit.is_good:
        return None, f"without an atlas, since MNI152 covers the brain with a Dice of {fit.dice:.2f} only"
    return fit, f"led by the MNI152 atlas, whose brain covers this one with a Dice of {fit.dice:.2f}"


class _StepTimes:
    """Milliseconds of steps, for the log."""

    def __init__(self) -> None:
        self._last, self._steps = perf_counter(), []

    def __call__(self, step: str) -> None:
        """A step has ended."""
        now = perf_counter()
        self._steps.append(f"{step} {(now - self._last) * 1e3:.0f} ms")
        self._last = now

    def __str__(self) -> str:
        return ", ".join(self._steps)


def _finite(mri: Volume) -> np.ndarray:
    check_finite(mri)
    return mri.array.astype(np.float32)
