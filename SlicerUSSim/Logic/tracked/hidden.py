"""What hides an imaged field: where a file cuts it off, and what a scanner draws over it.

Such pixels are black, or the same in all images, whatever the patient looks like; compared with simulated ones they
would count as anatomy. They are taken out of the mask with a warning.
"""

from __future__ import annotations

import logging

import numpy as np
from scipy import ndimage

_log = logging.getLogger(__name__)

#: Largest grey level of black, as codecs leave it; fewer black lines at an end of the field are rounding of its outline
_DARK, _LEAST_LINES = 4, 3
#: Least grey level of what is drawn, and largest change of it: grey levels (codecs), or a part of the change of half
#: of what the field shows (smooth edges)
_DRAWN, _SAME, _SAME_SHARE = 40, 3, 0.1
#: Least number of different images, and least change of half of what they show, that tell what is drawn from a patient
_LEAST_IMAGES, _LEAST_CHANGE = 4, 20
#: Of the field: more that stays the same is the patient
_MOST_DRAWN = 0.15
#: Fewer pixels side by side are the same by chance; pixels around what is drawn, smoothed by resampling and codecs
_LEAST_PIXELS, _AROUND = 4, 3
#: Most images that are looked at
_MOST_IMAGES = 200


def spread_images(images: np.ndarray) -> np.ndarray:
    """At most 200 of (n, rows, columns), evenly spread."""
    if len(images) <= _MOST_IMAGES:
        return images
    return images[np.linspace(0, len(images) - 1, _MOST_IMAGES).round().astype(int)]


def visible_part(
    images: np.ndarray, field: np.ndarray, coloured: np.ndarray | None = None, *, finds_marks: bool = True
) -> np.ndarray:
    """(rows, columns) bool, the pixels of the field in which all images show the patient.

    Parameters
    ----------
    images : (n, rows, columns) uint8, of a recording.
    field : (rows, columns) bool, the probe's imaged field.
    coloured : (rows, columns) bool, pixels that have a colour in any image, such as Doppler's.
    finds_marks : whether to find what a scanner draws over the field; nothing is drawn over simulated images.

    The omitted part is logged as a warning.
    """
    images = spread_images(images)
    seen = _without(field, ~_shown(images.max(axis=0) > _DARK, field), "are beyond what the file shows")
    if coloured is not None:
        around = np.asarray(ndimage.binary_dilation(coloured, iterations=_AROUND), bool)
        seen = _without(seen, around, "have colours, such as Doppler or markers")
    if finds_marks:
        seen = _without(seen, _drawn_over(images, seen), "are the same in all images, as text, rulers and boxes are")
    return seen


def _without(seen: np.ndarray, hidden: np.ndarray, what: str) -> np.ndarray:
    """What is seen and not hidden, which is logged."""
    rows, columns = np.nonzero(seen & hidden)
    if len(rows):
        _log.warning(
            "%d pixels of the field (%.1f %%, columns %d to %d, rows %d to %d) %s: left out", len(rows),
            100.0 * len(rows) / seen.sum(), columns.min(), columns.max(), rows.min(), rows.max(), what,
        )  # fmt: skip
    return seen & ~hidden


def _shown(bright: np.ndarray, field: np.ndarray) -> np.ndarray:
    """(rows, columns) bool, the rectangle of rows and columns from the first to the last that is bright in the field.

    An end at which only a few lines are black belongs to the field.
    """
    found = np.ones_like(field)
    for axis in (0, 1):
        lines = np.flatnonzero((bright & field).any(axis=1 - axis))
        whole = np.flatnonzero(field.any(axis=1 - axis))
        if not len(lines):
            continue
        place = np.arange(field.shape[axis])
        is_in = np.ones(len(place), bool)
        if lines[0] - whole[0] >= _LEAST_LINES:
            is_in &= place >= lines[0]
        if whole[-1] - lines[-1] >= _LEAST_LINES:
            is_in &= place <= lines[-1]
        found &= is_in[:, None] if axis == 0 else is_in
    return found


def _drawn_over(images: np.ndarray, field: np.ndarray) -> np.ndarray:
    """(rows, columns) bool, bright pixels of the field that stay the same while what it shows changes."""
    nothing = np.zeros_like(field)
    different = {image[field].tobytes(): number for number, image in enumerate(images)}  # a scanner may be frozen
    if len(different) < _LEAST_IMAGES:
        _log.warning(
            "text, rulers and other marks in the images could not be detected: %d different images, expected at "
            "least %d", len(different), _LEAST_IMAGES,
        )  # fmt: skip
        return nothing
    chosen = images[sorted(different.values())]
    low, high = chosen.min(axis=0).astype(int), chosen.max(axis=0).astype(int)
    shows = field & (high >= _DRAWN)
    change = float(np.median((high - low)[shows])) if shows.any() else 0.0
    same = shows & (low >= _DRAWN) & (high - low <= max(_SAME, _SAME_SHARE * change))
    if change < _LEAST_CHANGE or same.sum() > _MOST_DRAWN * field.sum():
        _log.warning(
            "text, rulers and other marks in the images could not be detected: half of what the field shows changes "
            "by at most %.0f grey levels, expected %d or more, as with a moving probe", change, _LEAST_CHANGE,
        )  # fmt: skip
        return nothing
    regions = np.zeros(same.shape, np.int32)
    ndimage.label(same, np.ones((3, 3)), regions)
    same &= (np.bincount(regions.ravel()) >= _LEAST_PIXELS)[regions]
    return np.asarray(ndimage.binary_dilation(same, np.ones((3, 3)), iterations=_AROUND), bool)
