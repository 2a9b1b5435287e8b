"""The border of a brain mask, moved to the dark valley between cortex and scalp."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.neighbourhood import distance_to
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.coarse import resampled_to_ras, widened

_SPACING_MM = 1.2
#: Brightness, relative to the brain nearby, between tissue and the skull or CSF of a T1
_TISSUE = 0.6
#: Brightness of what is surely CSF and surely tissue, lowest border between them, Gaussian windows in mm in which both
#: are measured, and share of CSF in these from which their space is wide
_FLUID, _SOLID, _LEAST_TISSUE, _WINDOW_MM, _WIDE = 0.4, 0.5, 0.4, 5.0, 0.2


def refined(
    mri: Volume, distance: np.ndarray, *, core_mm: float, reach_mm: float, keep_mm: float,
    progress: Callable[[float], None] = lambda share: None,
) -> np.ndarray:  # fmt: skip
    """(k, j, i) True in the brain.

    `distance` is the signed distance to a first mask in mm on the MRI's grid, negative inside. What is deeper than
    `core_mm` is brain, what is further out than `reach_mm` is not. Between them a watershed on the brightness, after
    division by that of the brain nearby (bias field), puts the border into the darkest valley (Hahn and Peitgen, MICCAI
    2000); darker tissue than grey matter is then taken off outside, and sulci are closed. Where much CSF is outside the
    cortex (the vertex of an older patient), its brightness separates it from gyri that a bias field makes dark.
    What is deeper in the first mask than `keep_mm` stays if it is on this side of the valley. `progress` is called with
    the completed fraction, 0 to 1.
    """
    from skimage.segmentation import watershed

    image, origin = resampled_to_ras(mri, _SPACING_MM)
    matrix = np.diag([_SPACING_MM] * 3 + [1.0])
    matrix[:3, 3] = origin
    # Outside the field of view there is no brain.
    far = on_grid(mri.with_array(distance), Volume(image, matrix), outside=reach_mm + 6.0)
    box = ndimage.find_objects((far <= reach_mm + 6.0).astype(np.uint8))[0]
    image, far = image[box], far[box]
    progress(0.15)
    mm = _SPACING_MM
    core = far < -core_mm
    brightness = ndimage.gaussian_filter(brightness_near(image, core, mm), 0.5)
    progress(0.3)
    markers = np.where(core, 1, np.where(far > reach_mm, 2, 0)).astype(np.int32)
    undecided = (far >= -core_mm - 3.0) & (far <= reach_mm + 3.0)  # and 3 mm of the markers on either side
    region = core | (watershed(-brightness, markers, mask=undecided) == 1)
    progress(0.45)
    bright = region & (brightness > _tissue_from(brightness, region))
    ball = _ball(2.0 / mm)
    # Casts: the return types of scipy's functions depend on their arguments, without type annotations for that.
    opened = _connected(cast(np.ndarray, ndimage.binary_erosion(bright, ball)) | core, core)
    brain = cast(np.ndarray, ndimage.binary_dilation(opened, _ball(3.0 / mm))) & bright
    brain |= region & (far <= -keep_mm)
    progress(0.7)
    brain = closed(brain | core, 5.0 / mm) & region
    brain = cast(np.ndarray, ndimage.binary_fill_holes(brain))
    progress(0.9)
    smooth = ndimage.gaussian_filter(brain.astype(np.float32), 0.8)
    matrix[:3, 3] += mm * np.array([part.start for part in box][::-1])
    return on_grid(Volume(smooth, matrix), mri) > 0.5


def brightness_near(image: np.ndarray, core: np.ndarray, spacing_mm: float) -> np.ndarray:
    """(k, j, i) float32 brightness relative to that of the brain nearby, 0 (air) to 1.3.

    The brain's is the mean in `core` in Gaussian windows of 15 mm deviation, continued beyond it: a bias field cancels.
    """
    air = float(np.percentile(image, 1.0))
    values = image - air
    tissue = float(np.median(values[core]))
    step, deviation = 4, 15.0 / spacing_mm / 4
    some = values[::step, ::step, ::step]
    weight = (core[::step, ::step, ::step] & (np.abs(some - tissue) < 0.5 * tissue)).astype(np.float32)
    near = ndimage.gaussian_filter(weight, deviation, truncate=6.0)
    level = ndimage.gaussian_filter(weight * some, deviation, truncate=6.0) / np.maximum(near, 1e-9)
    level = np.where(near > 1e-6, level, tissue)
    wide = widened(level, step, values.shape)
    return np.clip(values / np.maximum(wide, max(0.2 * tissue, 1e-6)), 0.0, 1.3).astype(np.float32)


def _tissue_from(brightness: np.ndarray, region: np.ndarray) -> np.ndarray:
    """(k, j, i) brightness from which it is tissue: _TISSUE, or less in wide CSF, half-way between both nearby.

    Only there: where the cortex touches the dura, a lower border would take that in.
    """
    step = 2
    deviation = _WINDOW_MM / _SPACING_MM / step
    some, inside = (values[::step, ::step, ::step] for values in (brightness, region))

    def amount(values: np.ndarray) -> np.ndarray:
        return np.maximum(ndimage.gaussian_filter(values.astype(np.float32), deviation), 1e-3)

    is_fluid, is_solid = inside & (some < _FLUID), inside & (some > _SOLID)
    fluid, solid = (amount(np.where(part, some, 0.0)) / amount(part) for part in (is_fluid, is_solid))
    between = np.clip((fluid + solid) / 2.0, _LEAST_TISSUE, _TISSUE)
    share = amount(is_fluid) / amount(inside)
    wide = widened(share, step, brightness.shape) > _WIDE
    return np.where(wide, widened(between, step, brightness.shape), _TISSUE)


def on_grid(volume: Volume, grid: Volume, outside: float = 0.0) -> np.ndarray:
    """(k, j, i) float32 values of the volume on another grid, by linear interpolation; `outside` beyond it."""
    matrix = volume.ras_to_ijk @ grid.ijk_to_ras
    offset = cast(float, matrix[:3, 3][::-1])  # annotated as a number, takes one for each axis
    return ndimage.affine_transform(
        volume.array.astype(np.float32), matrix[:3, :3][::-1, ::-1], offset, grid.array.shape,
        output=np.float32, order=1, mode="constant",
 cval=outside,
    )  # fmt: skip


def near_points(grid: Volume, points: np.ndarray, distance_mm: float) -> np.ndarray:
    """(k, j, i) True in voxels of a grid within a distance of (n, 3) RAS points in it."""
    index = np.rint(points @ grid.ras_to_ijk[:3, :3].T + grid.ras_to_ijk[:3, 3]).astype(int)[:, ::-1]
    index = index[((index >= 0) & (index < grid.array.shape)).all(axis=1)]
    result = np.zeros(grid.array.shape, bool)
    result[tuple(index.T)] = True
    return distance_to(result, grid.spacing_mm) <= distance_mm if len(index) else result


def box_around(points: np.ndarray, grid: Volume) -> tuple[slice, ...]:
    """(k, j, i) part of a grid that holds (n, 3) RAS points, with a voxel more on every side."""
    places = (points @ grid.ras_to_ijk[:3, :3].T + grid.ras_to_ijk[:3, 3])[:, ::-1]
    ends = np.floor(places.min(axis=0)) - 1, np.ceil(places.max(axis=0)) + 2
    first, last = (np.clip(end, 0, grid.array.shape).astype(int) for end in ends)
    return tuple(map(slice, first, np.maximum(first, last)))


def _ball(radius: float) -> np.ndarray:
    n = int(radius)
    z, y, x = np.mgrid[-n : n + 1, -n : n + 1, -n : n + 1]
    return x * x + y * y + z * z <= radius * radius


def closed(inside: np.ndarray, radius: float) -> np.ndarray:
    """Closing with a ball, by distances, which is quick for large balls."""
    n = int(radius) + 2
    padded = np.pad(inside, n)
    grown = distance_to(padded) <= radius
    return (distance_to(~grown) > radius)[n:-n, n:-n, n:-n]


def _connected(inside: np.ndarray, core: np.ndarray) -> np.ndarray:
    components, _ = ndimage.label(inside)  # type: ignore[misc]
    counts = np.bincount(components[core])
    counts[0] = 0
    return components == counts.argmax()
