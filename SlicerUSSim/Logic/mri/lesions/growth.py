"""The region around a point that is like it: the level of likeness at which its border is sharpest.

Seeded region growing with the contrast at the border as the measure of the best region (Hojjatoleslami and Kittler,
IEEE TIP 7(7), 1998), among regions that are connected by more than thin bridges (Serra, Image Analysis and Mathematical
Morphology, 1982: opening by reconstruction).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy import ndimage

#: Levels of likeness that are tried: 1 at the seed, 0 in what is healthy
_LEVELS = np.linspace(0.2, 0.85, 14)
#: Standard deviation of the smoothing of the likeness
_SMOOTHING_MM = 1.0
#: Bridges thinner than this share of the region at the seed are cut, and those thinner than this many millimetres
_BRIDGE_SHARE, _LEAST_BRIDGE_MM, _MOST_BRIDGE_MM = 0.5, 0.8, 5.0
#: Windows that reach farther are looked at in blocks of about this size
_FINE_REACH_MM, _COARSE_MM = 25.0, 2.0
#: What is this near to the seed is the place that was meant
_NEAR_MM = 2.5
#: Farthest and lowest at which a border has its foot, and thickness of the shell beyond it that is the surroundings
_FOOT_MM, _FOOT_LEVEL, _SHELL_MM = 2.5, 0.25, 3.0

#: Least share of a region of blocks that its voxels have: what is less is on the mean of blocks alone
_LEAST_OF_BLOCKS = 0.25


@dataclass(frozen=True, eq=False)
class Region:
    """A connected part of a window."""

    #: (k, j, i) bool
    inside: np.ndarray
    #: Level of likeness at its border, and mean slope of the likeness there, per mm
    level: float
    slope: float
    #: Radius of the largest ball in it
    radius_mm: float

    def volume_ml(self, spacing_mm: np.ndarray) -> float:
        return float(self.inside.sum() * np.prod(spacing_mm)) / 1000.0


def grow(
    likeness: np.ndarray,
    allowed: np.ndarray,
    seed: np.ndarray,
    spacing_mm: np.ndarray,
    *,
    largest_mm: float,
) -> Region | None:
    """The region around a seed with the sharpest border; None if there is none within the window.

    Parameters
    ----------
    likeness : (k, j, i), 1 at the seed and 0 in what surrounds it.
    allowed : (k, j, i) bool, where the region may be.
    seed : (3,) k, j, i.
    spacing_mm : (3,) along k, j, i.
    largest_mm : distance from the seed that a region must not reach.
    """
    step = np.maximum(np.floor(_COARSE_MM / spacing_mm + 0.1).astype(int), 1)
    if largest_mm > _FINE_REACH_MM and step.max() > 1:
        return _on_coarse(likeness, allowed, seed, spacing_mm, step, largest_mm)
    smooth = smoothed(likeness, allowed, spacing_mm)
    steepness = _steepness(smooth, spacing_mm)
    distance = distance_from(seed, likeness.shape, spacing_mm)
    best: Region | None = None
    for level in _LEVELS:
        region = _region_at(level, smooth, allowed, distance, spacing_mm)
        if region is None:
            continue
        inside, radius = region
        if distance[inside].max() >= largest_mm:
            continue
        # On both sides of the border, where tissue is on both
        free = cast(np.ndarray, ndimage.binary_dilation(inside)) & ~inside & allowed
        within = inside & allowed & cast(np.ndarray, ndimage.binary_dilation(free))
        slope = 0.5 * float(steepness[free].mean() + steepness[within].mean()) if free.any() else 0.0
        if best is None or slope > best.slope:
            best = Region(inside, float(level), slope, radius)
    return best


def _steepness(values: np.ndarray, spacing_mm: np.ndarray) -> np.ndarray:
    """(k, j, i) magnitude of the gradient, per mm; across a single voxel nothing changes."""
    axes = [axis for axis, size in enumerate(values.shape) if size > 1]
    slopes = (np.gradient(values, float(spacing_mm[axis]), axis=axis) for axis in axes)
    return np.sqrt(sum((slope**2 for slope in slopes), np.zeros_like(values)))


def _on_coarse(
    likeness: np.ndarray, allowed: np.ndarray, seed: np.ndarray, spacing_mm: np.ndarray, step: np.ndarray,
    largest_mm: float,
) -> Region | None:  # fmt: skip
    """As grow, with the level and the extent from means of blocks of voxels, and the border from the voxels."""
    shape = tuple(int(n) * int(size // n) for n, size in zip(step, likeness.shape, strict=True))
    blocks = [int(n) for size, each in zip(shape, step, strict=True) for n in (size // each, each)]
    cut = tuple(slice(0, size) for size in shape)
    weight = allowed[cut].reshape(blocks).mean(axis=(1, 3, 5))
    total = np.where(allowed[cut], likeness[cut], 0.0).reshape(blocks).mean(axis=(1, 3, 5))
    coarse = (total / np.maximum(weight, 1e-6)).astype(np.float32)
    place = (np.asarray(seed, float) - 0.5 * (step - 1)) / step
    found = grow(coarse, weight >= 0.5, place, spacing_mm * step, largest_mm=largest_mm)
    if found is None:
        return None
    near = ndimage.binary_dilation(found.inside)
    for axis, each in enumerate(step):
        near = near.repeat(int(each), axis)
    near = np.pad(near, [(0, full - part) for full, part in zip(likeness.shape, near.shape, strict=True)])
    inside = near & allowed & (smoothed(likeness, allowed, spacing_mm) > found.level)
    parts, count = ndimage.label(inside)  # type: ignore[misc]
    if not count:
        return None
    inside = cast(np.ndarray, ndimage.binary_fill_holes(parts == np.bincount(parts.ravel())[1:].argmax() + 1))
    if inside.sum() < _LEAST_OF_BLOCKS * found.inside.sum() * step.prod():
        return None
    return Region(inside, found.level, found.slope, found.radius_mm)


def with_foot(region: Region, likeness: np.ndarray, allowed: np.ndarray, spacing_mm: np.ndarray) -> Region:
    """A region out to the foot of its border, where it fades into what surrounds it, as it is drawn by hand.

    Not farther than 2.5 mm.
    """
    outside = cast(np.ndarray, ndimage.distance_transform_edt(~region.inside, sampling=spacing_mm.tolist()))
    shell = allowed & (outside > _FOOT_MM) & (outside <= _FOOT_MM + _SHELL_MM)
    base = float(np.median(likeness[shell])) if shell.any() else 0.0
    level = base + _FOOT_LEVEL * (float(np.median(likeness[region.inside])) - base)
    wide = allowed & (outside <= _FOOT_MM) & (smoothed(likeness, allowed, spacing_mm) > level)
    parts, _ = ndimage.label(wide | region.inside)  # type: ignore[misc]
    inside = parts == parts[region.inside][0]
    inside = cast(np.ndarray, ndimage.binary_fill_holes(ndimage.binary_opening(inside) | region.inside))
    return Region(inside, level, region.slope, float(_depth(inside, spacing_mm).max()))


def smoothed(
    values: np.ndarray, where: np.ndarray, spacing_mm: np.ndarray, sigma_mm: float = _SMOOTHING_MM
) -> np.ndarray:
    """Means of `values` under a Gaussian, of voxels in `where` alone."""
    deviation = (sigma_mm / spacing_mm).tolist()
    weight = ndimage.gaussian_filter(where.astype(np.float32), deviation)
    total = ndimage.gaussian_filter(np.where(where, values, 0).astype(np.float32), deviation)
    return total / np.maximum(weight, 1e-6)


def _region_at(
    level: float, smooth: np.ndarray, allowed: np.ndarray, distance: np.ndarray, spacing_mm: np.ndarray
) -> tuple[np.ndarray, float] | None:
    """((k, j, i) bool, radius of its largest ball in mm) above a level, without what hangs on it by thin bridges."""
    above = (smooth > level) & allowed
    near = above & (distance <= _NEAR_MM)
    if not near.any():
        return None
    parts, _ = ndimage.label(above)  # type: ignore[misc]
    counts = np.bincount(parts[near])
    number = int(counts[1:].argmax()) + 1
    # With a voxel around it, or the depth would go on beyond the box as it does beyond the window
    box = tuple(slice(max(part.start - 1, 0), part.stop + 1) for part in ndimage.find_objects(parts)[number - 1])
    above, distance = parts[box] == number, distance[box]
    depth = _depth(above, spacing_mm)
    bridge = float(np.clip(_BRIDGE_SHARE * depth[distance <= _NEAR_MM].max(), _LEAST_BRIDGE_MM, _MOST_BRIDGE_MM))
    core, count = ndimage.label(depth > bridge)  # type: ignore[misc]
    if not count:
        return None
    # The core nearest to the seed, and all that lies within the radius of the ball that was rolled in it
    chosen = core == core.ravel()[np.where(core > 0, distance, np.inf).argmin()]
    reach = cast(np.ndarray, ndimage.distance_transform_edt(~chosen, sampling=spacing_mm.tolist()))
    inside = above & (reach <= bridge + float(spacing_mm.max()))
    result = np.zeros(smooth.shape, bool)
    result[box] = ndimage.binary_fill_holes(inside)
    return result, float(depth[chosen].max())


def _depth(inside: np.ndarray, spacing_mm: np.ndarray) -> np.ndarray:
    """(k, j, i) distance from what is not inside. Beyond the window it goes on as at its end: an image may be thin."""
    padded = ndimage.distance_transform_edt(np.pad(inside, 1, mode="edge"), sampling=spacing_mm.tolist())
    return cast(np.ndarray, padded)[1:-1, 1:-1, 1:-1]


def distance_from(seed: np.ndarray, shape: tuple[int, ...], spacing_mm: np.ndarray) -> np.ndarray:
    """(k, j, i) float32 distance in mm from a place (k, j, i)."""
    k, j, i = np.ogrid[tuple(map(slice, shape))]
    offsets = [(axis - place) * step for axis, place, step in zip((k, j, i), seed, spacing_mm, strict=True)]
    return np.sqrt(sum(offset**2 for offset in offsets)).astype(np.float32)
