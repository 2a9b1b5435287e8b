"""Segmentation of an MRI: 3D guided filter, then a Gaussian mixture (docs/physics.md#1-from-mri-to-tissues)."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import cast

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.declaration import parameter_of
from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.brain import BrainMask, find_brain, given_brain
from SlicerUSSim.Logic.mri.filtering import guided_filter
from SlicerUSSim.Logic.mri.mixture import classify, fit_mixture, mixture_posteriors
from SlicerUSSim.Logic.mri.settings import SegmentationSettings
from SlicerUSSim.Logic.opencl.device import DeviceChoice
from SlicerUSSim.Logic.tissue.texture import Texture, tissue_deviation

_log = logging.getLogger(__name__)

#: Tissue names per contrast and number of classes, in the order of intensity.
_CLASS_NAMES = {
    "t1": {3: ("csf", "grey matter", "white matter")},
    "t1gd": {
        3: ("csf", "grey matter", "white matter"),
        4: ("csf", "grey matter", "white matter", "enhancing"),
    },
    "t2": {3: ("white matter", "grey matter", "csf")},
    "flair": {3: ("csf", "white matter", "grey matter"), 4: ("csf", "white matter", "grey matter", "tumour")},
}
#: Filter strength per estimated noise: removes noise, preserves borders; chosen on the MNI152 brain at 0-9 % noise.
_EPSILON_PER_NOISE = 1.5


@dataclass(frozen=True, eq=False)
class Segmentation:
    """A label map, and the Gaussian mixture from which it was computed."""

    #: uint8; label n + 1 is class n, 0 is background; one extra label for thin sulci
    labels: Volume
    #: Name of label n + 1
    tissue_names: tuple[str, ...]
    #: (classes,) in the unit of the MRI
    means: np.ndarray
    standard_deviations: np.ndarray
    #: (classes,) summing to 1
    weights: np.ndarray
    #: One per EM iteration, never decreasing
    log_likelihoods: np.ndarray
    #: Standard deviation of the estimated noise, and the filter's epsilon
    noise: float
    filter_epsilon: float
    #: Where tissues were looked for, and how it was found
    brain: BrainMask
    _filtered: np.ndarray = field(repr=False)

    @property
    def posteriors(self) -> np.ndarray:
        """(classes, k, j, i) float32 probability of every class in the order of the labels; 0 in the background."""
        foreground = self.labels.array > 0
        result = np.zeros((len(self.means), *foreground.shape), np.float32)
        result[:, foreground] = mixture_posteriors(
            self._filtered[foreground], self.means, self.standard_deviations, self.weights
        )
        return result

    def texture(self) -> Texture:
        """Information of the MRI beyond labels: the second most probable tissue of every voxel with its probability
        relative to the two, and the filtered intensity in standard deviations of its tissue."""
        labels = self.labels.array
        foreground = labels > 0
        label, values = labels[foreground], self._filtered[foreground]
        posteriors = mixture_posteriors(values, self.means, self.standard_deviations, self.weights)
        # Labels are in order of intensity. Posteriors are not meaningful beyond the outermost means, where the widest
        # class dominates (see mixture.classify), nor where the label does not come from the mixture (thin sulci).
        sure = (label > len(self.means)) | (values <= self.means[0]) | (values >= self.means[-1])
        own = np.where(sure, 1, label)[None] - 1
        first = np.take_along_axis(posteriors, own, 0)[0]
        np.put_along_axis(posteriors, own, -1.0, 0)
        other = np.maximum(posteriors.max(axis=0), 0.0)
        second_label, second_share = np.zeros(labels.shape, np.uint8), np.zeros(labels.shape, np.float32)
        second_label[foreground] = posteriors.argmax(axis=0) + 1
        second_share[foreground] = np.where(sure, 0.0, other / np.maximum(first + other, 1e-12))
        return Texture(second_label, second_share, tissue_deviation(self._filtered, labels))


def segment_mri(
    mri: Volume,
    *,
    classes: int = SegmentationSettings.classes,
    contrast: str = SegmentationSettings.contrast,
    mask: Volume | None = None,
    filter_radius: int = SegmentationSettings.filter_radius,
    filter_epsilon: float | None = SegmentationSettings.filter_epsilon,
    bias_correction: bool = SegmentationSettings.bias_correction,
    thin_sulci: bool = False,
    skull_strip: str = SegmentationSettings.skull_strip,
    keep_mask_at: Path | None = None,
    device: DeviceChoice = None,
    progress: Callable[[float], None] | None = None,
) -> Segmentation:
    """Label the tissues of a brain MRI by intensity.

    Parameters
    ----------
    mri : the image: a whole head, a skull-stripped brain, or any image with a `mask`.
    classes : number of tissues.
    contrast : "t1", "t1gd", "t2" or "flair"; orders and names the classes.
    mask : foreground on the same grid (non-zero is inside); default: found by `skull_strip`.
    filter_radius : of the guided filter in voxels; 0 disables it.
    filter_epsilon : of the guided filter, squared intensity; default: from the noise estimated in the image.
    bias_correction : run N4 first (slow); for scans with a visible intensity gradient.
    thin_sulci : also label the middle of sulci that are too narrow to reach CSF intensity, one voxel thick, as an extra
        tissue "leptomeninges" within the grey matter. Ultrasound shows these sulci, but intensity classes miss them.
    skull_strip : how the brain is found without a `mask`; see brain.find_brain.
    keep_mask_at : file in which the mask of a whole head is kept, so that it is extracted once; see brain.find_brain.
    progress : called with the completed fraction, 0 to 1.

    Raises SimulationError for an unknown contrast or number of classes, an image that is constant or not finite, and a
    mask that is empty or on another grid.

    >>> from SlicerUSSim.Logic import segment_mri
    >>> from SlicerUSSim.Logic.mri import head_mri
    >>> segmentation = segment_mri(head_mri(spacing_mm=3.0), contrast="t1")
    >>> segmentation.tissue_names  # of labels 1, 2, 3
    ('csf', 'grey matter', 'white matter')
    >>> segmentation.labels.array.dtype
    dtype('uint8')
    """
    report = progress or (lambda share: None)
    names = _class_names(contrast, classes)
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
    _log.info("%s", brain.message)
    report(0.2)
    if bias_correction:
        intensity = _without_bias(mri.with_array(intensity), foreground, lambda share: report(0.2 + 0.4 * share))
        timed("bias correction")
        report(0.6)

    noise = estimate_noise(intensity, foreground)
    epsilon = (_EPSILON_PER_NOISE * noise) ** 2 if settings.filter_epsilon is None else settings.filter_epsilon
    timed("noise")
    filtered = guided_filter(intensity, foreground, settings.filter_radius, epsilon, device)
    timed("guided filter")
    _log.info(
        "noise %.3g in the unit of the MRI; guided filter: radius %d, epsilon %.3g",
        noise, settings.filter_radius, epsilon,
    )  # fmt: skip
    report(0.8)

    values = filtered[foreground]
    spread = float(values.max() - values.min())
    require(
        spread > 0, f"MRI is constant ({values[0]:g}) inside the foreground, expected tissues of different intensity"
    )
    means, deviations, weights, likelihoods = fit_mixture(values, classes)
    labels = np.zeros(intensity.shape, np.uint8)
    labels[foreground] = classify(values, means, deviations, weights)
    timed("mixture")
    _log.info(
        "%s taken for classes of %s after %d iterations: %s", ", ".join(names), contrast, len(likelihoods),
        "; ".join(f"mean {m:.4g} sd {d:.3g} share {w:.0%}" for m, d, w in zip(means, deviations, weights, strict=True)),
    )  # fmt: skip
    if thin_sulci:
        csf, grey = names.index("csf"), names.index("grey matter")
        middles = _sulcal_middles(filtered, labels, grey + 1, means[csf], means[grey], noise)
        # CSF less than two voxels thick is such a sulcus too; as CSF it would form isolated droplets, each a lens.
        is_csf = labels == csf + 1
        middles |= is_csf & ~cast(np.ndarray, ndimage.binary_opening(is_csf, np.ones((2, 2, 2))))
        labels[middles] = classes + 1
        names = (*names, "leptomeninges")
        timed("thin sulci")
        _log.info("thin sulci: %d voxels become leptomeninges", int(middles.sum()))
    _log.debug("segmentation: %s", timed)
    report(1.0)
    return Segmentation(
        labels=mri.with_array(labels),
        tissue_names=names,
        means=means,
        standard_deviations=deviations,
        weights=weights,
        log_likelihoods=likelihoods,
        noise=noise,
        filter_epsilon=epsilon,
        brain=brain,
        _filtered=filtered,
    )


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


def estimate_noise(image: np.ndarray, mask: np.ndarray) -> float:
    """Standard deviation of the noise inside the mask, in the unit of the image.

    From the difference of every voxel to its six neighbours (Coupe et al., Medical Image Analysis 14(4) 2010), by the
    median absolute deviation, which is robust against borders. Every other slice is used.
    """
    inner = cast(np.ndarray, ndimage.binary_erosion(mask[::2], np.ones((1, 3, 3))))
    if inner.sum() < 1000:
        return 0.0
    image = image.astype(np.float32, copy=False)
    around = sum(np.roll(image, shift, axis)[::2] for axis in (0, 1, 2) for shift in (-1, 1))
    residual = np.sqrt(6.0 / 7.0) * (image[::2] - around / 6.0)[inner]
    return float(1.4826 * np.median(np.abs(residual - np.median(residual))))


def _sulcal_middles(
    filtered: np.ndarray, labels: np.ndarray, grey_label: int, csf_mean: float, grey_mean: float, noise: float
) -> np.ndarray:
    """(k, j, i) True at grey-matter voxels on the middle of a sheet that is closer to CSF than both of its sides.

    Along at least one of the 13 directions of the 26-neighbourhood the voxel must be an extremum compared with both
    neighbours, and differ sufficiently from the first two voxels on either side.
    """
    towards_csf = np.sign(csf_mean - grey_mean)
    # Depth below grey matter. Intensities further from CSF than grey matter count as grey matter; otherwise all cortex
    # would be a valley between white matter on both sides.
    depth = np.where(labels > 0, np.maximum(towards_csf * (filtered - grey_mean), 0), 0).astype(np.float32)
    depth = np.pad(ndimage.gaussian_filter(depth, 0.6), 2)
    flat, steps = depth.ravel(), np.array([depth.shape[1] * depth.shape[2], depth.shape[2], 1])
    grey = np.flatnonzero(np.pad(labels == grey_label, 2))
    here = flat[grey]
    least = max(0.15 * abs(csf_mean - grey_mean), noise)
    is_middle = np.zeros(grey.size, bool)
    for direction in itertools.product((-1, 0, 1), repeat=3):
        if direction <= (0, 0, 0):
            continue  # equivalent to the opposite direction
        step = int(np.dot(direction, steps))
        before, behind = flat[grey - step], flat[grey + step]
        side = np.maximum(np.minimum(before, flat[grey - 2 * step]), np.minimum(behind, flat[grey + 2 * step]))
        is_middle |= (here >= before) & (here >= behind) & (here - side > least)
    result = np.zeros(depth.shape, bool)
    result.ravel()[grey[is_middle]] = True
    return result[2:-2, 2:-2, 2:-2]


def _class_names(contrast: str, classes: int) -> tuple[str, ...]:
    """The names of the classes. Raises SimulationError that says how many go with the contrast."""
    contrast = parameter_of(SegmentationSettings, "contrast").checked("segmentation", contrast)
    known = _CLASS_NAMES[contrast]
    require(
        classes in tuple(known),
        f"classes is {classes!r}, expected {' or '.join(map(str, known))} for contrast {contrast}",
    )
    return known[classes]


def _finite(mri: Volume) -> np.ndarray:
    intensity = mri.array.astype(np.float32)
    bad = int(intensity.size - np.isfinite(intensity).sum())
    require(bad == 0, f"MRI has {bad} voxels that are not finite numbers, expected none")
    low, high = float(intensity.min()), float(intensity.max())
    require(high > low, f"MRI is constant ({low:g}), expected different intensities")
    return intensity


def _without_bias(mri: Volume, foreground: np.ndarray, report: Callable[[float], None]) -> np.ndarray:
    import SimpleITK as sitk

    image = sitk.Cast(mri.to_sitk(), sitk.sitkFloat32)
    mask = mri.with_array(foreground.astype(np.uint8)).to_sitk()
    shrink = [4 if size >= 64 else 1 for size in image.GetSize()]
    corrector = sitk.N4BiasFieldCorrectionImageFilter()
    iterations = [50, 50, 30]
    corrector.SetMaximumNumberOfIterations(iterations)
    raised: list[Exception] = []

    def iterated() -> None:
        done = sum(iterations[: corrector.GetCurrentLevel()]) + corrector.GetElapsedIterations()
        try:
            report(min(done / sum(iterations), 1.0))
        except Exception as error:  # it cannot propagate through C++
            raised.append(error)
            corrector.Abort()

    corrector.AddCommand(sitk.sitkIterationEvent, iterated)
    corrector.Execute(sitk.Shrink(image, shrink), sitk.Shrink(mask, shrink))
    if raised:
        raise raised[0]
    bias = sitk.GetArrayFromImage(corrector.GetLogBiasFieldAsImage(image))
    return (mri.array / np.exp(bias)).astype(np.float32)
