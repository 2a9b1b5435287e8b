"""What hides an imaged field: where a file cuts it off, and what a scanner draws over it.

Such pixels are black, or the same in all images, whatever the patient looks like; compared with simulated ones they
would count as anatomy. They are taken out of the mask, and said.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
from scipy import ndimage

_log = logging.getLogger(__name__)

#: Largest grey level of black, as codecs leave it
_DARK = 4
#: A line of pixels is the last before a cut if at least this part of the field in it is bright, and the next ones are
#: black; fewer lines than this are the rounding of the field's outline
_BRIGHT_SHARE, _LEAST_LINES = 0.15, 3
#: Least number of different images in which what is drawn is told from the patient, the largest change of its grey
#: level (codecs) and its least grey level: dark parts of a patient are alike in many images
_LEAST_IMAGES, _SAME, _DRAWN = 4, 3, 40
#: Of the field: more that stays the same is a recording of one place, and not drawn
_MOST_DRAWN = 0.15
#: Around what is drawn, pixels: smoothed by resampling and codecs
_AROUND = 2
#: Most images that are looked at
_MOST_IMAGES = 200
#: Of the field at 255 grey levels, from which images are said to be saturated
_SATURATED = 0.02
_WHITE = 255


def spread_images(images: np.ndarray) -> np.ndarray:
    """At most 200 of (n, rows, columns), evenly spread."""
    if len(images) <= _MOST_IMAGES:
        return images
    return images[np.linspace(0, len(images) - 1, _MOST_IMAGES).round().astype(int)]


def visible_part(images: np.ndarray, field: np.ndarray, coloured: np.ndarray | None = None) -> np.ndarray:
    """(rows, columns) bool, the pixels of the field in which all images show the patient.

    Parameters
    ----------
    images : (n, rows, columns) uint8, of a recording.
    field : (rows, columns) bool, the probe's imaged field.
    coloured : (rows, columns) bool, pixels that have a colour in any image, such as Doppler's.

    What is left out is logged as a warning.
    """
    images = spread_images(images)
    seen: np.ndarray = field & ~_cut_off(images.max(axis=0), field)
    if coloured is not None and (coloured & seen).any():
        hidden = np.asarray(ndimage.binary_dilation(coloured, iterations=_AROUND), bool) & seen
        _say(hidden, seen, "have colours, as of Doppler or markers")
        seen &= ~hidden
    is_white = images[:, seen] == _WHITE
    # What is drawn is white in all images; what changes is the patient
    changing = is_white[:, ~is_white.all(axis=0)] if len(images) >= _LEAST_IMAGES else is_white
    is_saturated = bool(changing.size) and float(changing.mean()) > _SATURATED
    if is_saturated:
        _log.warning(
            "%.0f %% of the field is at 255 grey levels: the images are saturated, and levels above are lost",
            100 * float(is_white.mean()),
        )
    drawn = _drawn_over(images, seen, _WHITE if is_saturated else 256)
    if drawn.any():
        _say(drawn, seen, "are the same in all images, as text, rulers, logos and boxes are")
        seen = seen & ~drawn
    return seen


def _say(hidden: np.ndarray, of: np.ndarray, what: str) -> None:
    rows, columns = np.nonzero(hidden)
    _log.warning(
        "%d pixels of the field (%.1f %%, columns %d to %d, rows %d to %d) %s: left out", len(rows),
        100.0 * len(rows) / max(int(of.sum()), 1), columns.min(), columns.max(), rows.min(), rows.max(), what,
    )  # fmt: skip


def _cut_off(brightest: np.ndarray, field: np.ndarray) -> np.ndarray:
    """(rows, columns) bool, the field beyond straight edges at which bright images end."""
    hidden = np.zeros_like(field)
    bright = (brightest > _DARK) & field
    for axis, names in ((1, ("left", "right")), (0, ("top", "bottom"))):
        whole, shown = field.sum(axis=1 - axis), bright.sum(axis=1 - axis)
        for is_last, name in enumerate(names):
            # From the outer end of the field inwards
            order = np.flatnonzero(whole)[:: -1 if is_last else 1]
            is_black = shown[order] == 0
            lines = int(np.argmin(is_black)) if not is_black.all() else 0
            if lines < _LEAST_LINES or shown[order[lines]] < _BRIGHT_SHARE * whole[order[lines]]:
                continue
            part = np.take(hidden, order[:lines], axis=axis) | np.take(field, order[:lines], axis=axis)
            if axis:
                hidden[:, order[:lines]] = part
            else:
                hidden[order[:lines]] = part
            _log.warning(
                "the images end at %s %d, %d before the %s end of the probe's field: what the file cuts off is left "
                "out", "column" if axis else "row", order[lines], lines, name,
            )  # fmt: skip
    return hidden


def _drawn_over(images: np.ndarray, field: np.ndarray, below: int) -> np.ndarray:
    """(rows, columns) bool, bright pixels of the field that stay the same while those around them change.

    Grey levels from `below` on are left, as the patient's in saturated images.
    """
    nothing = np.zeros_like(field)
    if len(images) < _LEAST_IMAGES:
        return nothing
    low, high = images.min(axis=0).astype(int), images.max(axis=0).astype(int)
    same = (high - low <= _SAME) & field
    if same.sum() > _MOST_DRAWN * field.sum() + (same & (high <= _DARK)).sum():
        return nothing
    core = same & (low >= _DRAWN) & (high < below)
    # Single pixels are chance; letters and lines are not
    labels, count = _components(core)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    core &= sizes[labels] >= 4
    return np.asarray(ndimage.binary_dilation(core, iterations=_AROUND), bool) & field if core.any() else nothing


def _components(mask: np.ndarray) -> tuple[np.ndarray, int]:
    found: Sequence = ndimage.label(mask, structure=np.ones((3, 3)))  # type: ignore[assignment]
    return np.asarray(found[0]), int(found[1])
