"""Which numbers a volume holds: the labels of a label map, or the intensities of an MRI."""

from __future__ import annotations

import numpy as np

#: Numbers from here on are not labels.
_TOO_LARGE = 100_000
#: Share of negative voxels, by positive ones, up to which they may be slips in a label map, which then is no MRI either
_FEW_NEGATIVE = 0.05
#: What formats, resampling and augmentation by noise leave of whole numbers
_ROUNDING = 0.02
#: Labels that were stored as bytes with a scale: each is one multiple of it, at most so far from a whole number
_SCALED, _BYTES = 0.25, 256
#: Label maps of up to this many labels are not examined further. Above, at least this share of neighbours has to be
#: equal; a label map of a brain has 0.65 (voxels of 5 mm) to 0.95, an MRI 0.05 to 0.35.
_FEW, _EQUAL_NEIGHBOURS = 8, 0.6
#: An MRI of few grey levels has more equal neighbours, but evenly spaced levels, and the others are the next level.
_FEW_LEVELS, _EQUAL_NEIGHBOURS_OF_LEVELS, _NEXT_LEVEL = 32, 0.8, 0.5
#: Voxels along each side of the part of a volume that is examined
_EXAMINED = 128


def numbers_of(original: np.ndarray) -> tuple[str, bool]:
    """(what a (k, j, i) array holds, in words; whether these are labels), see Volume.looks_like_labels."""
    low, high = original.min(), original.max()
    array = whole_numbers(original) if np.isfinite(low) and np.isfinite(high) else None
    if array is None:
        found, is_labels = f"{original.dtype} numbers", False
    else:
        below = low < 0 and float((array < 0).sum()) > _FEW_NEGATIVE * float((array > 0).sum())
        if low < 0 and (high < 1 or (below and low < -1)):
            return f"negative numbers (down to {low:g})", False
        if below:  # the background of a label map
            array, high = array.astype(np.float64) + 1.0, float(high) + 1.0
        array = np.maximum(array, 0)
        values = np.flatnonzero(np.bincount(array.ravel().astype(np.int64))) if high < _TOO_LARGE else np.unique(array)
        found = f"{len(values)} whole numbers from {values[0]:g} to {values[-1]:g}"
        is_labels = high < _TOO_LARGE and (len(values) <= _FEW or _has_regions(array, values))
    return found, is_labels


def whole_numbers(array: np.ndarray) -> np.ndarray | None:
    """The array, rounded where it is of floats; None if it contains fractions, or nothing but fractions of 1.

    Fractions of labels that were stored as bytes with a scale (0.2118 n for label n of an aseg) are rounded.
    """
    if not np.issubdtype(array.dtype, np.floating):
        return array
    rounded = np.rint(array)
    if not np.allclose(array, rounded, rtol=0.0, atol=_ROUNDING):
        return rounded if _is_scaled(array, rounded) else None
    return rounded if rounded.any() or not array.any() else None


def has_uniform_fractions(array: np.ndarray) -> bool:
    """Whether these are few values with fractions, in uniform regions: labels to which something was added or done."""
    if not np.issubdtype(array.dtype, np.floating):
        return False
    middle = _middle(array)
    values = np.unique(array[middle])
    return 1 < len(values) <= _BYTES and _has_regions(array, values)


def _middle(array: np.ndarray) -> tuple[slice, ...]:
    return tuple(slice(max((n - _EXAMINED) // 2, 0), (n + _EXAMINED) // 2) for n in array.shape)


def _is_scaled(array: np.ndarray, rounded: np.ndarray) -> bool:
    """Whether every whole number stands for one value near it, as labels have that were stored with a scale."""
    if not float(np.abs(array - rounded).max()) <= _SCALED or rounded.max() <= 1:
        return False
    values = np.unique(array)
    return len(values) <= _BYTES and len(np.unique(np.rint(values))) == len(values)


def _has_regions(array: np.ndarray, values: np.ndarray) -> bool:
    """Whether neighbours that are not 0 have mostly equal `values`, as in a label map; see the constants above."""
    part = np.searchsorted(values, array[_middle(array)]) + (values[0] > 0)  # ranks; 0 is 0
    total = equal = following = 0
    for axis in range(3):
        first, second = np.moveaxis(part, axis, 0)[:-1], np.moveaxis(part, axis, 0)[1:]
        steps = np.abs(first - second)[(first > 0) & (second > 0)]
        total += steps.size
        equal += int(np.count_nonzero(steps == 0))
        following += int(np.count_nonzero(steps == 1))
    if equal < _EQUAL_NEIGHBOURS * total:
        return False
    spacing = np.diff(values[values > 0])
    is_graded = len(values) <= _FEW_LEVELS and len(spacing) > 0 and spacing.max() <= 2 * spacing.min()
    return not (is_graded and equal < _EQUAL_NEIGHBOURS_OF_LEVELS * total and following > _NEXT_LEVEL * (total - equal))
