"""Label maps that were resampled with interpolation, or smoothed: their numbers no longer are those of tissues."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.label_numbers import middle

#: Share of whole numbers in an interpolated label map, and of equal neighbours among them: 0.76 and more, in MRIs 0.14
_MOSTLY, _UNIFORM = 0.3, 0.65
#: Variation among 27 neighbours, relative to the range of the image, up to which they are a plateau, and the share of
#: the voxels in plateaus from which these are regions of labels. FreeSurfer's and SynthSeg's labels of 1 mm smoothed by
#: Gaussians of 0.5, 1 and 2 voxels 0.13 to 0.20, 0.05 to 0.08, 0.014 to 0.02, cubic splines 0.03 to 0.04; MRIs and
#: tissue maps, also smoothed and with 256 levels, 0.002 at most
_FLAT, _PLATEAUS = 1e-4, 0.01
#: Least number of plateaus' values, and their share of the plateaus: an MRI may have a second background
_VALUES, _OF_PLATEAUS = 2, 0.02
#: Deviation of a plateau from a whole number, and the share of the plateaus that are so near to one
_WHOLE, _MOSTLY_WHOLE = 0.01, 0.9
#: Steps of the range in which values are counted, and the least distance of the foreground from the background
_STEP, _FOREGROUND = 1e-3, 1e-2
#: Of voxels between two whose labels differ by so much, the share that has a number between these, from which whole
#: numbers were interpolated, in maps of so many labels with mostly equal neighbours (an image has few). SynthSeg's, AAL
#: and Brodmann's of mricron 0.007 to 0.019, by nearest neighbours at 3 mm up to 0.083, at 5 mm 0.116; interpolated 0.21
#: (by half a voxel along one axis) to 0.67
_APART, _BETWEEN, _LEAST_LABELS, _EQUAL = 4, 0.17, 8, 0.3
#: Layers outside the brain, which lie between others as they are, and are numbered in their order: those over the bone,
#: which touch each other, the bone, and the air, and the bone, which touches a brain on its inner side
_OVER_BONE = ("skin", "scalp", "fat", "muscle")
_BONE = ("skull", "bone", "cancellous bone")
_AROUND = ("coupling", "air", "water", "gel")
_OTHER, _EMPTY, _SOFT, _HARD = range(4)


def is_interpolated(array: np.ndarray) -> bool:
    """Whether most voxels have whole numbers, in uniform regions, and others fractions. An MRI is noisy everywhere.

    The background, which is the most frequent whole number, is uniform in both and not counted.
    """
    is_whole = array == np.rint(array)
    if not np.issubdtype(array.dtype, np.floating) or not is_whole.any():
        return False
    values, counts = np.unique(array[is_whole], return_counts=True)
    inside = array != values[np.argmax(counts)]
    is_whole &= inside
    if not inside.any() or not _MOSTLY <= is_whole.sum() / inside.sum() < 1.0:
        return False
    pairs = is_whole[..., 1:] & inside[..., :-1]
    return bool(pairs.any() and (array[..., 1:] == array[..., :-1])[pairs].mean() > _UNIFORM)


def is_smoothed(array: np.ndarray) -> bool:
    """Whether an image of fractions (k, j, i) has plateaus at several whole numbers, as smoothing leaves of labels.

    Examined are the middle 128 voxels along each axis. An MRI varies everywhere, by its noise.
    """
    if not np.issubdtype(array.dtype, np.floating) or min(array.shape) < 3:
        return False
    part = array[middle(array)]
    if not np.isfinite(part).all():
        return False
    low, high = float(part.min()), float(np.percentile(part, 99.9))
    if not high > low:
        return False
    levels = (part - low) / (high - low)
    background = _frequent(levels)
    inside = np.abs(levels - background) > _FOREGROUND
    spread = ndimage.maximum_filter(levels, 3) - ndimage.minimum_filter(levels, 3)
    is_flat = inside & (spread <= _FLAT)
    flat = levels[is_flat]
    if not len(flat) >= max(_PLATEAUS * inside.sum(), 1):
        return False
    numbers = part[is_flat].astype(np.float64)
    if (np.abs(numbers - np.rint(numbers)) > max(_WHOLE, 2.0 * _FLAT * (high - low))).mean() > 1.0 - _MOSTLY_WHOLE:
        return False
    counts = np.bincount(np.rint(flat / _STEP).astype(np.int64) + 1)  # levels below 0 by rounding
    return int((counts >= _OF_PLATEAUS * len(flat)).sum()) >= _VALUES


def share_between(array: np.ndarray, tissues: Mapping[int, str] | None = None) -> tuple[float, float]:
    """(share of voxels with a number between those of their neighbours, share of equal neighbours).

    The first is of voxels between two neighbours along an axis of an array (k, j, i) whose numbers differ by 4 or more;
    the second of pairs of neighbours of which neither is 0. With `tissues`, {label: tissue}, layers of a head outside
    the brain that lie between their neighbours in a body (skin between air and scalp) are not counted in the first.
    """
    part = array[middle(array)].astype(np.int64)
    kinds = _kinds(int(part.max(initial=0)), tissues or {})
    between = far = equal = pairs = 0
    for axis in range(3):
        along = np.moveaxis(part, axis, 0)
        first, second = along[:-1], along[1:]
        labelled = (first != 0) & (second != 0)
        equal, pairs = equal + int((labelled & (first == second)).sum()), pairs + int(labelled.sum())
        before, here, after = along[:-2], along[1:-1], along[2:]
        is_far = np.abs(before - after) >= _APART
        before, here, after = before[is_far], here[is_far], after[is_far]
        is_between = (np.minimum(before, after) < here) & (here < np.maximum(before, after))
        is_layer = is_between & _is_layer(kinds[before], kinds[here], kinds[after])
        between, far = between + int((is_between & ~is_layer).sum()), far + int((~is_layer).sum())
    return between / max(1, far), equal / max(1, pairs)


def are_interpolated_numbers(array: np.ndarray, n_labels: int, tissues: Mapping[int, str] | None = None) -> bool:
    """Whether whole numbers (k, j, i) with so many labels were interpolated and rounded.

    Between two labels are then numbers of others. `tissues`, {label: tissue} of those that are known, tell layers of a
    head, which are between others also in an original.
    """
    if n_labels < _LEAST_LABELS:
        return False
    between, equal = share_between(array, tissues)
    return between >= _BETWEEN and equal >= _EQUAL


def _kinds(largest: int, tissues: Mapping[int, str]) -> np.ndarray:
    """(largest + 1,) of _OTHER, _EMPTY, _SOFT and _HARD for the labels from 0 on."""
    kinds = np.full(largest + 1, _OTHER, np.uint8)
    for label, tissue in ((0, "coupling"), *tissues.items()):
        for kind, names in ((_EMPTY, _AROUND), (_SOFT, _OVER_BONE), (_HARD, _BONE)):
            if label <= largest and tissue in names:
                kinds[label] = kind
    return kinds


def _is_layer(before: np.ndarray, here: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Whether what is between two others is a layer outside the brain beside what it touches in a body; by kinds."""
    others = (before == _OTHER).astype(np.uint8) + (after == _OTHER)
    return ((here == _SOFT) & (others == 0)) | ((here == _HARD) & (others <= 1))


def _frequent(levels: np.ndarray) -> float:
    """The most frequent value, to a step."""
    steps = np.rint(levels.ravel() / _STEP).astype(np.int64)
    return float(np.argmax(np.bincount(steps)) * _STEP)
