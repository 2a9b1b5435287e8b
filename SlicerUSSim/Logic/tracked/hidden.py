"""What hides an imaged field: where a file cuts it off, and what a scanner draws over it.

Such pixels are black, or the same in all images, whatever the patient looks like; compared with simulated ones they
would count as anatomy. They are taken out of the mask, and said.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import require

_log = logging.getLogger(__name__)

#: Largest grey level of black, as codecs leave it
_DARK = 4
#: A line of pixels is the last before a cut if at least this part of the field in it is bright, and the next ones are
#: black; fewer lines than this are the rounding of the field's outline
_BRIGHT_SHARE, _LEAST_LINES = 0.15, 3
#: At a cut images end suddenly: the line has at least this part of the brightness of so many behind it. Dark tips of a
#: sector do not, or have less than this part of the field.
_SUDDEN, _LINES_BEHIND, _LEAST_CUT = 0.5, 8, 0.001
#: Least number of images in which what is drawn is told from the patient, and least change of the grey level of half of
#: the pixels that show something
_LEAST_IMAGES, _LEAST_CHANGE = 4, 20
#: Largest change of what is drawn: grey levels (codecs), or a part of that of its surroundings (smoothed edges)
_SAME, _SAME_SHARE = 3, 0.1
#: Least grey level of what is drawn, above its surroundings in all images, and above the darkest pixel beside it, since
#: echoes have no sharp edges
_DRAWN, _SHARP = 40, 50
#: Surroundings from which the patient's changes say something, and largest grey level of those that are always dark
_CHANGING, _ALWAYS_DARK = 16, 24
#: Surroundings that are brighter in all images, as near a face, change less where they are brightest
_ALWAYS_BRIGHT = 100
#: Surroundings: pixels of their square, and every how many of them are looked at
_WIDE, _STEP = 27, 3
#: A mark of fewer pixels counts if as many are alike: anywhere in many images, in few within one row or column
_WHOLE_MARK, _ALIKE, _MANY_IMAGES = 4, 4, 10
#: Near a mark what stands out as sharply, and changes by less than this part of what its surroundings do, is one too;
#: half the gap between letters, pixels
_ALIKE_SHARE, _GAP = 0.25, 3
#: How many times as many as by chance are clearly more
_CLEARLY = 6.0
#: Edges of a field that are found in images may lie outside what is bright, pixels
_RIM = 6
#: Of the field: more that stays the same is a recording of one place, and not drawn
_MOST_DRAWN = 0.15
#: Around what is drawn, pixels: smoothed by resampling and codecs
_AROUND = 2
#: Smooth edges of what is drawn: least grey level above the surroundings, and largest part of their change
_SMOOTH, _EDGE_SHARE = 15, 0.6
#: Of what is bright in the field: colours in more are no Doppler box
_MOST_COLOURED = 0.5
#: Most images that are looked at
_MOST_IMAGES = 200
#: Of the field at 255 grey levels, from which images are said to be saturated
_SATURATED = 0.02
_WHITE = 255
#: Of the pixels at the border of images that are white in all of them: more is a background that should be black
_INVERTED = 0.5


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
    finds_marks : whether what a scanner draws over the field is looked for; nothing is drawn over simulated images.

    What is left out is logged as a warning. Raises SimulationError if most of what is bright has colours.
    """
    images = spread_images(images)
    seen: np.ndarray = field & ~_cut_off(images.max(axis=0), field)
    if coloured is not None and (coloured & seen).any():
        bright = seen & (images.max(axis=0) > _DRAWN)
        share = float((coloured & bright).sum() / max(bright.sum(), 1))
        require(
            share <= _MOST_COLOURED,
            f"{share:.0%} of what is bright in the probe's field has colours, and not those of one colour map "
            "from black on, expected grey levels, with colours in a Doppler box at most",
        )
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
    if not finds_marks:
        return seen
    images = _different(images, seen)
    low, high = images.min(axis=0).astype(int), images.max(axis=0).astype(int)
    untold = _why_untold(len(images), low, high, seen)
    if untold:
        _log.warning("text, rulers and other marks in the images could not be looked for: %s", untold)
        return seen
    drawn = _drawn_over(len(images), low, high, seen, _WHITE if is_saturated else 256)
    if drawn.any():
        _say(drawn, seen, "are the same in all images, as text, rulers, logos and boxes are")
        seen = seen & ~drawn
    return seen


def look_inverted(images: np.ndarray) -> bool:
    """Whether the border of (n, rows, columns) uint8 images is white rather than black, as after 255 - image; said."""
    darkest = spread_images(images).min(axis=0)
    border = np.concatenate([darkest[[0, -1]].ravel(), darkest[:, [0, -1]].ravel()])
    share = float((border >= _WHITE - _DARK).mean())
    if share <= _INVERTED:
        return False
    _log.warning(
        "the images look inverted: %.0f %% of their border is white, expected black around the probe's field, and what "
        "echoes more to be brighter",
        100 * share,
    )
    return True


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
            if lines < _LEAST_LINES or whole[order[:lines]].sum() < _LEAST_CUT * field.sum():
                continue
            share = shown[order] / whole[order]
            behind = float(share[lines + 1 : lines + 1 + _LINES_BEHIND].mean()) if lines + 1 < len(order) else 0.0
            if share[lines] < max(_BRIGHT_SHARE, _SUDDEN * behind):
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


def _different(images: np.ndarray, field: np.ndarray) -> np.ndarray:
    """Those of the images that are not the same as one before them, as of a frozen scanner."""
    first = {image[field].tobytes(): number for number, image in reversed(list(enumerate(images)))}
    return images[sorted(first.values())]


def _why_untold(images: int, low: np.ndarray, high: np.ndarray, field: np.ndarray) -> str:
    """Why what is drawn cannot be told from the patient in so many images; empty if it can.

    `low` and `high` are (rows, columns), the least and largest grey levels of all.
    """
    if images < _LEAST_IMAGES:
        return f"{images} different image{'s' * (images > 1)}, expected at least {_LEAST_IMAGES}"
    low, high = low[field], high[field]
    shows = high > _ALWAYS_DARK
    change = float(np.median((high - low)[shows])) if shows.any() else 0.0
    alike = (high - low <= _SAME) & (low >= _DRAWN)
    if change >= _LEAST_CHANGE and alike.mean() <= _MOST_DRAWN:
        return ""
    return (
        f"half of what the field shows changes by at most {change:.0f} grey levels from image to image, expected "
        f"{_LEAST_CHANGE} or more, as of a moving probe"
    )


def _drawn_over(images: int, low: np.ndarray, high: np.ndarray, field: np.ndarray, below: int) -> np.ndarray:
    """(rows, columns) bool, bright sharp pixels of the field that stay the same while those around them change.

    `low` and `high` as in _why_untold. Grey levels from `below` on are left, as the patient's in saturated images.
    """
    change = high - low
    # Beyond the field its edge goes on: the black beside it is no surroundings of what lies within
    edge = field & ~np.asarray(ndimage.binary_erosion(field, iterations=_RIM), bool) & (high <= _ALWAYS_DARK)
    inside = field & ~edge
    if not inside.any():
        return np.zeros_like(field)
    nearest: np.ndarray = ndimage.distance_transform_edt(~inside, return_distances=False, return_indices=True)  # type: ignore[assignment]
    beside = low[tuple(nearest)]
    # Marks cover less than half of their surroundings
    around = _surroundings(beside, 30)
    changes, brightest = _surroundings(change[tuple(nearest)], 70), _surroundings(high[tuple(nearest)], 50)
    is_changing = changes >= _CHANGING
    most = np.where(is_changing & (around < _ALWAYS_BRIGHT), np.maximum(_SAME_SHARE * changes, _SAME), _SAME)
    told = inside & (is_changing | (brightest <= _ALWAYS_DARK)) & (high < below)
    stands_out = told & (low >= _DRAWN) & (low - around >= _DRAWN)
    stands_out &= beside - ndimage.minimum_filter(beside, 3) >= _SHARP
    drawn = _marks(stands_out & (change <= most), images)
    if not drawn.any():
        return drawn
    # Codecs change some letters of a line more than others
    share = _ALIKE_SHARE if images >= _MANY_IMAGES else _SAME_SHARE
    alike = drawn | (stands_out & (change <= np.where(around < _ALWAYS_BRIGHT, share * changes, _SAME)))
    line, _ = _components(np.asarray(ndimage.binary_dilation(alike, iterations=_GAP), bool))
    drawn = alike & np.isin(line, line[drawn])
    # The inside of a logo is drawn as its edge is, and of letters their smooth edges and the gaps between strokes
    same = field & (change <= _SAME) & (low >= _DRAWN) & (high < below)
    drawn = np.asarray(ndimage.binary_propagation(drawn, structure=np.ones((3, 3)), mask=drawn | same), bool)
    smooth = told & (low - around >= _SMOOTH) & (change <= _EDGE_SHARE * np.maximum(changes, _CHANGING / 2))
    drawn |= smooth & np.asarray(ndimage.binary_dilation(drawn, iterations=_AROUND + 1), bool)
    drawn |= np.asarray(ndimage.binary_closing(drawn, np.ones((3, 3)), iterations=2), bool)
    return np.asarray(ndimage.binary_dilation(drawn, iterations=_AROUND), bool) & field


def _surroundings(values: np.ndarray, percent: int) -> np.ndarray:
    """(rows, columns) int, a percentile of the grey levels around each pixel."""
    found = ndimage.percentile_filter(values[::_STEP, ::_STEP].astype(np.uint8), percent, size=_WIDE // _STEP)
    rows, columns = values.shape
    return np.repeat(np.repeat(found, _STEP, axis=0), _STEP, axis=1)[:rows, :columns].astype(int)


def _marks(core: np.ndarray, images: int) -> np.ndarray:
    """(rows, columns) bool, pixels that are no chance: letters, lines, and several ticks or dots."""
    labels, count = _components(core)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    counts = sizes >= _WHOLE_MARK
    counts[0] = False
    small = np.flatnonzero(~counts[1:]) + 1
    if len(small) >= _ALIKE and images >= _MANY_IMAGES:
        counts[small] = True
    elif len(small) >= _ALIKE:
        centres = np.array(ndimage.center_of_mass(core, labels, small))
        for places, extent in zip(centres.T, core.shape, strict=True):
            # In few images single pixels are alike by chance, and as many lie in any row as in others
            by_chance = 3.0 * len(small) / extent
            aligned = (np.abs(places[:, None] - places) <= 1.0).sum(axis=1)
            counts[small] |= aligned >= _ALIKE + _CLEARLY * by_chance
    return counts[labels]


def _components(mask: np.ndarray) -> tuple[np.ndarray, int]:
    found: Sequence = ndimage.label(mask, structure=np.ones((3, 3)))  # type: ignore[assignment]
    return np.asarray(found[0]), int(found[1])
