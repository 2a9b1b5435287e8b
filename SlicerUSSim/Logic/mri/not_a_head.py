"""What an image shows that is no head: an ultrasound fan, a phantom, a part of a head or of a body, probabilities."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.coarse import CoarseImage, largest_component
from SlicerUSSim.Logic.mri.no_data import edge_value

#: A fan's two sides have 0.17 to 0.28 of the perimeter of its outline and open by 45 to 92 degrees. A third straight
#: side as long as that, or one parallel to either, is of a box: an image resampled along other axes.
_LEAST_SIDE, _PARALLEL_SIDE, _OPENING_DEG = 0.165, 0.12, (25.0, 130.0)
#: The shorter of a fan's sides, relative to the longer; halves of a brain that were cut have less
_EQUAL_SIDES = 0.8
#: Deviation from a straight side, as a share of the perimeter
_STRAIGHT = 0.006
#: Share of the inner object that varies by less than 3 % within 20 mm: heads 0.00 to 0.01 (proton density), phantoms
#: 0.01 (a noisy box) to 0.32
_UNIFORM_SHARE, _UNIFORM_SHARE_OF_NO_HEAD, _UNIFORM = 0.02, 0.005, 0.03
#: Correlation of voxels 8 mm apart below which an image is noise: in noise 0.0, in heads 0.8
_NOISE_CORRELATION = 0.2
#: Least correlation with the mirror images along the three axes: heads and brains 0.30 to 0.63 (a macaque's 0.75), as
#: left and right alone are alike; phantoms of shells, with and without noise, 0.87 to 1.00
_SYMMETRIC = 0.85
#: Cross-section at an end of the object, relative to the largest, from which it is cut there. The neck is cut in
#: most images of a head, so that the bottom has to be cut through the head itself.
_CUT, _CUT_AT_BOTTOM = 0.5, 0.85
#: Largest value of probabilities, with what is rounded where they are stored as integers with a slope, and as percent
#: or in 8 bits
_FULL_SHARE, _FULL_SHARES = 1.0001, (100.0, 255.0)


def is_ultrasound(mri: Volume) -> bool:
    """Whether the image is a fan, between two straight sides that open, on a background of exactly one value.

    The fan is looked for in the outlines along the three axes of the voxels.
    """
    values = mri.array
    background, share = edge_value(values)
    shown = values != background
    if share < 0.3 or shown.mean() > 0.9 or not shown.any():
        return False
    return any(_is_fan(shown.any(axis=axis)) for axis in range(3) if min(np.delete(shown.shape, axis)) > 30)


def uniform_share(image: CoarseImage) -> float:
    """Share of the object, deeper than 12 mm, in which intensities hardly vary within 20 mm: phantoms, not tissue."""
    inside = np.pad(image.foreground, 1)
    deep = (image.spacing_mm * ndimage.distance_transform_edt(inside))[1:-1, 1:-1, 1:-1] > 12.0  # type: ignore
    if deep.sum() < 100:
        return 0.0
    window = 10.0 / image.spacing_mm
    smooth = ndimage.gaussian_filter(image.array, 1.0)  # noise is not structure
    mean = ndimage.gaussian_filter(smooth, window)
    variance = ndimage.gaussian_filter(smooth**2, window) - mean**2
    return float((variance[deep] < (_UNIFORM * mean[deep]) ** 2).mean())


def is_symmetric(image: CoarseImage) -> bool:
    """Whether the object is its own mirror image along all three axes, as spheres, cylinders and shells are."""
    inside = image.foreground
    smooth = ndimage.gaussian_filter(image.array, 1.0)
    centre = np.array(ndimage.center_of_mass(inside))
    return all(_mirrored_correlation(smooth, inside, centre, axis) > _SYMMETRIC for axis in range(3))


def _mirrored_correlation(image: np.ndarray, inside: np.ndarray, centre: np.ndarray, axis: int) -> float:
    """Of an image with its mirror image along an axis, inside both, at the best of three places near the centre."""
    found = []
    for shift in (-0.5, 0.0, 0.5):
        steps, start = np.ones(3), np.zeros(3)
        steps[axis], start[axis] = -1.0, 2.0 * (centre[axis] + shift)
        mirrored, within = (
            ndimage.affine_transform(values, steps, start, order=1)  # type: ignore[arg-type]
            for values in (image, inside.astype(np.float32))
        )
        both = inside & (within > 0.5)
        first, second = (
            values[both] - values[both].mean() if both.any() else np.zeros(1) for values in (image, mirrored)
        )
        found.append(float(first @ second / max(np.sqrt((first @ first) * (second @ second)), 1e-12)))
    return max(found)


def is_noise(image: CoarseImage) -> bool:
    """Whether neighbours have nothing in common, as in an image of noise alone."""
    if min(image.array.shape) < 8:
        return False
    inner = image.array[2:-2, 2:-2, 2:-2]  # beyond the edge of the image it is air
    inner = inner - inner.mean()
    # Interpolation has given direct neighbours something in common.
    return float((inner[2:] * inner[:-2]).mean()) < _NOISE_CORRELATION * float((inner**2).mean())


def is_phantom(image: CoarseImage, looks_like_a_head: bool = True) -> bool:
    """Whether large parts of the object are uniform, as no tissue of a head is; fewer, where nothing speaks for one."""
    return uniform_share(image) > (_UNIFORM_SHARE if looks_like_a_head else _UNIFORM_SHARE_OF_NO_HEAD)


def cut_ends(mri: Volume) -> tuple[str, ...]:
    """Ends, along the axes of the voxels, at which the object is cut off in the middle: "front", ...

    By the image's edge, or before it, with nothing beyond.
    """
    from skimage.filters import threshold_otsu

    step = tuple(slice(None, None, max(1, round(4.0 / size))) for size in mri.spacing_mm[::-1])
    values = ndimage.gaussian_filter(mri.array[step].astype(np.float32), 0.7)
    values -= np.percentile(values, 0.5)
    inside = largest_component(values > 0.5 * threshold_otsu(values))
    inside = np.stack([np.asarray(ndimage.binary_fill_holes(part)) for part in inside])
    ends = []
    for axis in range(3):
        areas = np.trim_zeros(inside.sum(axis=tuple(other for other in range(3) if other != axis)))
        for area, name in zip((areas[:2].max(), areas[-2:].max()), mri.ends[2 - axis], strict=True):
            if area > (_CUT_AT_BOTTOM if name == "bottom" else _CUT) * areas.max():
                ends.append(name)
    return tuple(ends)


def _is_fan(outline: np.ndarray) -> bool:
    sides = _straight_sides(outline)
    inner = [side for side in sides if not side[2] and side[0] >= _LEAST_SIDE]
    if len(inner) != 2:
        return False
    (one, first, _), (other, second, _) = inner
    if min(one, other) < _EQUAL_SIDES * max(one, other):
        return False
    opening = abs((first - second + 180.0 + 180.0) % 360.0 - 180.0)  # the outline runs along them in opposite ways
    others = [direction for share, direction, _ in sides if share >= _PARALLEL_SIDE]
    is_box = any(abs((other - side) % 360.0 - 180.0) < 6.0 for other in others for side in (first, second))
    return _OPENING_DEG[0] <= opening <= _OPENING_DEG[1] and not is_box


def _straight_sides(outline: np.ndarray) -> list[tuple[float, float, bool]]:
    """(share of the perimeter, direction in degrees, whether at the image's edge) of the hull's longest sides."""
    from scipy.spatial import ConvexHull

    outline = np.asarray(ndimage.binary_opening(outline, iterations=2))
    if outline.sum() < 100:
        return []
    outline = largest_component(outline)
    border = np.argwhere(outline & np.logical_not(ndimage.binary_erosion(outline)))
    hull = ConvexHull(border)
    if outline.sum() < 0.9 * hull.volume:
        return []
    corners = border[hull.vertices].astype(float)
    n, perimeter = len(corners), float(hull.area)
    found = []
    for i in range(n):
        longest = (0.0, i, 0)
        for count in range(1, n):
            way = corners[(i + count) % n] - corners[i]
            length = float(np.hypot(*way))
            between = corners[[(i + m) % n for m in range(1, count)]] - corners[i]
            off = np.abs(way[0] * between[:, 1] - way[1] * between[:, 0]) / length if count > 1 else np.zeros(1)
            if off.max() > _STRAIGHT * perimeter:
                break
            longest = (length, i, count)
        found.append(longest)
    used, sides, edges = np.zeros(n, bool), [], np.array(outline.shape) - 1
    for length, i, count in sorted(found, reverse=True):
        at = [(i + m) % n for m in range(count)]
        if used[at].any() or length < 0.1 * perimeter:
            continue
        used[at] = True
        ends = corners[[i, (i + count) % n]]
        way = ends[1] - ends[0]
        at_edge = bool(((ends <= 2.5).all(axis=0) | (ends >= edges - 2.5).all(axis=0)).any())
        sides.append((length / perimeter, float(np.degrees(np.arctan2(way[0], way[1]))), at_edge))
    return sides


def if_probabilities(mri: Volume) -> str:
    """What to do with a refused image that may be probabilities, as percent or in 8 bits, too; empty for any other."""
    low, high = float(mri.array.min()), float(mri.array.max())
    if low != 0.0 or not (high <= _FULL_SHARE or high in _FULL_SHARES):
        return ""
    values = f"values from 0 to {high:.3g}"
    hint = f"; if it shows the probabilities of a tissue ({values}), use the MRI from which they were made"
    if high > _FULL_SHARE:
        return hint
    return f"{hint}; the probabilities of a lesion are added to an MRI with --add tumour=FILE"
