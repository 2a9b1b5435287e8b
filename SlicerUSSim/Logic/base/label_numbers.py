"""Which numbers a volume holds: the labels of a label map, or the intensities of an MRI."""

from __future__ import annotations

import numpy as np

#: What formats, resampling and augmentation by noise leave of whole numbers
_ROUNDING = 0.02
#: Labels that were stored as bytes with a scale: each is one multiple of it, at most so far from a whole number
_SCALED, _BYTES = 0.25, 256
#: Up to so many whole numbers are labels. Above, they are if neighbours are equal, or far apart, as names are: the
#: share of equal neighbours and half of the distance of the others, by that of two by chance, are at least the second
#: number. Labels of brains in voxels of 1 to 8 mm had 0.70 to 1, MRIs of 40 grey levels and more up to 0.58
_FEW, _EQUAL_OR_FAR = 32, 0.65
#: Relative difference of neighbours that are equal in spite of rounding, and their share in labels with fractions:
#: 0.2 to 0.8 after linear and cubic interpolation, at most 0.12 in MRIs of 50 to 700 levels, treated alike
_SAME, _UNIFORM = 1e-4, 0.17
#: Ranges of numbers up to this wide are counted one by one, wider ones sorted
_COUNTED = 1_000_000
#: Voxels along each side of the part of a volume that is examined
_EXAMINED = 128


def numbers_of(original: np.ndarray) -> tuple[str, bool]:
    """(what a (k, j, i) array holds, in words; whether these are labels), see Volume.looks_like_labels."""
    low, high = original.min(), original.max()
    array = whole_numbers(original) if np.isfinite(low) and np.isfinite(high) else None
    if array is None:
        return f"{original.dtype} numbers", False
    array = _without_repeats(array)
    values = _counted(array)
    is_labels = (len(values) <= _FEW and low >= 0) or _has_regions(array)
    if low < 0 and not is_labels:
        return f"negative numbers (down to {low:g})", False
    return f"{len(values)} whole numbers from {values[0]:g} to {values[-1]:g}", is_labels


def _without_repeats(array: np.ndarray) -> np.ndarray:
    """The array before it was enlarged twice by nearest neighbours, which makes neighbours equal also in an MRI."""
    for axis in range(3):
        along = np.moveaxis(array, axis, 0)
        if len(along) % 2 == 0 and np.array_equal(along[::2], along[1::2]):
            array = np.moveaxis(along[::2], 0, axis)
    return array


def _counted(array: np.ndarray) -> np.ndarray:
    """Ascending values of an array of whole numbers."""
    low, high = int(array.min()), int(array.max())
    if high - low > _COUNTED:
        return np.unique(array)
    return np.flatnonzero(np.bincount(array.ravel().astype(np.int64) - low)) + low


def whole_numbers(array: np.ndarray) -> np.ndarray | None:
    """The array, rounded where it has floats; None if it contains fractions, or nothing but fractions of 1.

    Fractions of labels that were stored as bytes with a scale (0.2118 n for label n of an aseg) are rounded.
    """
    if not np.issubdtype(array.dtype, np.floating):
        return array
    rounded = np.rint(array)
    if not (np.abs(array - rounded) <= _ROUNDING).all():
        return rounded if _is_scaled(array, rounded) else None
    return rounded if rounded.any() or not array.any() else None


def has_uniform_fractions(array: np.ndarray) -> bool:
    """Whether these are fractions in uniform regions: labels that were scaled, shifted, interpolated or smoothed.

    The two most frequent values do not count: an MRI or a CT has a background, and may have padding.
    """
    if not np.issubdtype(array.dtype, np.floating):
        return False
    array = _without_repeats(array)
    part = array[middle(array)]
    values, counts = np.unique(part, return_counts=True)
    inside = ~np.isin(part, values[np.argsort(counts)[-2:]])
    first, second = np.concatenate([_pairs(part, inside, axis) for axis in range(3)], axis=1)
    return first.size > 0 and float(np.isclose(first, second, rtol=_SAME, atol=0.0).mean()) >= _UNIFORM


def middle(array: np.ndarray) -> tuple[slice, ...]:
    """The part of a volume (k, j, i) that is examined: its middle 128 voxels along each axis."""
    return tuple(slice(max((n - _EXAMINED) // 2, 0), (n + _EXAMINED) // 2) for n in array.shape)


def _is_scaled(array: np.ndarray, rounded: np.ndarray) -> bool:
    """Whether every whole number stands for one value near it, as labels have that were stored with a scale."""
    if not float(np.abs(array - rounded).max()) <= _SCALED or rounded.max() <= 1:
        return False
    values = np.unique(array)
    return len(values) <= _BYTES and len(np.unique(np.rint(values))) == len(values)


def _has_regions(array: np.ndarray) -> bool:
    """Whether neighbours have mostly equal values, as in a label map; those of the most frequent one do not count."""
    part = array[middle(array)]
    low = int(part.min())
    if int(part.max()) - low > _COUNTED:
        _, ranks, counts = np.unique(part, return_inverse=True, return_counts=True)
        ranks = ranks.reshape(part.shape)
    else:
        whole = part.astype(np.int64) - low
        counts = np.bincount(whole.ravel())
        rank_of = np.cumsum(counts > 0) - 1
        ranks, counts = rank_of[whole], counts[counts > 0]
    inside = ranks != counts.argmax()
    pairs = np.concatenate([_pairs(ranks, inside, axis) for axis in range(3)], axis=1)
    is_equal = pairs[0] == pairs[1]
    equal = float(is_equal.mean()) if is_equal.size else 1.0
    return equal + 0.5 * _distance(pairs[:, ~is_equal], len(counts)) >= _EQUAL_OR_FAR


def _pairs(ranks: np.ndarray, inside: np.ndarray, axis: int) -> np.ndarray:
    """(2, n) numbers of neighbours along an axis that are both inside."""
    first, second = (np.moveaxis(each, axis, 0) for each in (ranks, inside))
    both = second[:-1] & second[1:]
    return np.stack([first[:-1][both], first[1:][both]])


def _distance(pairs: np.ndarray, n_values: int) -> float:
    """Mean distance of two unequal neighbours, in ranks among all these, by that of two which do not touch."""
    counts = np.bincount(pairs.ravel(), minlength=n_values)
    place = (np.cumsum(counts) - 0.5 * counts)[pairs]
    apart = np.roll(pairs[1], pairs.shape[1] // 2)
    differ = apart != pairs[0]
    by_chance = np.abs(place[0] - np.roll(place[1], pairs.shape[1] // 2))[differ]
    return float(np.abs(place[0] - place[1]).mean() / by_chance.mean()) if differ.any() else 0.0
