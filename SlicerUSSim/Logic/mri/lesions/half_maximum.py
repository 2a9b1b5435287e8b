"""The region around a point that is brighter than half-way from its surroundings to its own intensity.

The full width at half maximum is the border of a blurred object (such as hot spots in PET: Erdi et al., Cancer 80(12),
1997). Both intensities are medians and are taken anew from each region until it stays. Regions end at thin bridges
(opening by reconstruction: Serra, Image Analysis and Mathematical Morphology, 1982).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.mri.evidence import Evidence

#: Shares of the contrast at the border that are tried until a region ends within the window; one for the last window
_SHARES, _LAST_SHARE = (0.5, 0.6, 0.7), 0.85
#: Most repetitions, and share of the voxels that may still change
_MOST_STEPS, _STAYS = 8, 0.02
#: A point means the region that is this near, or else this near: clicks miss, and rims are thin
NEAR_MM, SNAP_MM = 2.5, 5.0
#: Bridges thinner than this share of the region at the point are cut, and those thinner than this many millimetres
_BRIDGE_SHARE, _LEAST_BRIDGE_MM, _MOST_BRIDGE_MM = 0.5, 0.8, 5.0
#: Distances from the border between which the surroundings are
_SHELL_MM = (2.0, 6.0)
#: The foot of a border: how far outside it is at most, and its share of the contrast
_FOOT_MM, _FOOT_SHARE = 3.0, 0.25
#: Standard deviation of the smoothing of images
_SMOOTHING_MM = 1.0


@dataclass(frozen=True, eq=False)
class Window:
    """A cube around a place in the box of the brain, on a separate grid with cubic voxels."""

    evidence: Evidence
    #: (3,) k, j, i in the box of its centre
    centre: np.ndarray
    reach_mm: float
    mm: float
    #: Whether there is no larger one: the last region before one that does not end is then taken, too
    is_last: bool = True

    @property
    def size(self) -> int:
        """Voxels on a side."""
        return 2 * round(self.reach_mm / self.mm) + 1

    @property
    def distance(self) -> np.ndarray:
        """(k, j, i) from the centre, mm."""
        axis = (np.arange(self.size) - self.size // 2) ** 2
        return self.mm * np.sqrt(axis[:, None, None] + axis[:, None] + axis)

    def of(self, array: np.ndarray) -> np.ndarray:
        """(k, j, i) float32 array of the box in this window, interpolated; 0 beyond the box."""
        step = self.mm / self.evidence.spacing_mm
        return _resampled(array, step, self.centre - (self.size // 2) * step, (self.size,) * 3)

    def to_box(self, inside: np.ndarray) -> np.ndarray:
        """(k, j, i) bool on the box of the brain, of a region of this window."""
        step = self.evidence.spacing_mm / self.mm
        return _resampled(inside, step, self.size // 2 - self.centre * step, self.evidence.inside.shape) > 0.5

    def index_of(self, place: np.ndarray) -> np.ndarray:
        """(3,) k, j, i in the box of a voxel of this window."""
        return self.centre + (np.asarray(place) - self.size // 2) * self.mm / self.evidence.spacing_mm


@dataclass(frozen=True, eq=False)
class Region:
    """A connected part of a window."""

    #: (k, j, i) bool; and out to the foot of its border, where it fades into what surrounds it
    inside: np.ndarray
    larger: np.ndarray
    #: Intensity of it and of its surroundings
    own: float
    base: float
    #: Radius of the largest ball in it
    radius_mm: float


def grow(image: np.ndarray, allowed: np.ndarray, window: Window, own: float, base: float) -> Region | None:
    """The region at the centre of a window; None if nothing there stands out, or nothing ends within the window.

    Parameters
    ----------
    image : (k, j, i), smoothed; brighter in the region than around it.
    allowed : (k, j, i) bool, where the region may be.
    own, base : intensity of it and of its surroundings, to begin with.
    """
    distance = window.distance
    for share in (*_SHARES, _LAST_SHARE) if window.is_last else _SHARES:
        inside: np.ndarray | None = None
        its, around = own, base
        for _ in range(_MOST_STEPS):
            found = _connected(allowed & (image > around + share * (its - around)), distance, window.mm)
            if its <= around or found is None or distance[found].max() >= window.reach_mm:
                inside = inside if window.is_last else None
                break
            before, inside = inside, found
            if before is not None and (before ^ inside).sum() <= _STAYS * inside.sum():
                break
            outside = _distance_to(inside, window.mm)
            shell = allowed & (outside > _SHELL_MM[0]) & (outside <= _SHELL_MM[1])
            its = float(np.median(image[inside]))
            around = min(float(np.median(image[shell])), base) if shell.any() else around
        if inside is not None:
            radius = float(_depth(inside, window.mm).max())
            return Region(inside, _to_foot(inside, image, allowed, its, around, window.mm), its, around, radius)
    return None


def smoothed(values: np.ndarray, where: np.ndarray, mm: float, sigma_mm: float = _SMOOTHING_MM) -> np.ndarray:
    """Means of `values` under a Gaussian, of voxels in `where` alone."""
    weight = ndimage.gaussian_filter(where.astype(np.float32), sigma_mm / mm)
    total = ndimage.gaussian_filter(np.where(where, values, 0).astype(np.float32), sigma_mm / mm)
    return total / np.maximum(weight, 1e-6)


def closed(inside: np.ndarray, allowed: np.ndarray, mm: float, gap_mm: float) -> np.ndarray:
    """A region without holes, also those behind gaps of its rim."""
    wide = _distance_to(inside, mm) <= 0.5 * gap_mm
    filled = cast(np.ndarray, ndimage.binary_fill_holes(wide))
    return inside | (allowed & (_depth(filled, mm) > 0.5 * gap_mm))


def _to_foot(
    inside: np.ndarray, image: np.ndarray, allowed: np.ndarray, own: float, base: float, mm: float
) -> np.ndarray:
    """A region out to where little of the contrast to its surroundings is left."""
    wide = allowed & (_distance_to(inside, mm) <= _FOOT_MM) & (image > base + _FOOT_SHARE * (own - base))
    wide = cast(np.ndarray, ndimage.binary_opening(wide)) | inside
    parts, _ = ndimage.label(wide)  # type: ignore[misc]
    return cast(np.ndarray, ndimage.binary_fill_holes(parts == parts[inside][0]))


def _connected(above: np.ndarray, distance: np.ndarray, mm: float) -> np.ndarray | None:
    """(k, j, i) bool: what is connected at the centre, without what hangs on it by thin bridges; None if nothing is."""
    near = above & (distance <= NEAR_MM)
    if not near.any():
        near = above & (distance <= SNAP_MM)
        if not near.any():
            return None
    parts, _ = ndimage.label(above)  # type: ignore[misc]
    number = int(np.bincount(parts[near])[1:].argmax()) + 1
    # With a voxel around it, or the depth would continue beyond the box as it does beyond the window
    box = tuple(slice(max(part.start - 1, 0), part.stop + 1) for part in ndimage.find_objects(parts)[number - 1])
    part, away = parts[box] == number, distance[box]
    depth = _depth(part, mm)
    at_point = depth[near[box] & part].max()
    bridge = float(np.clip(_BRIDGE_SHARE * at_point, _LEAST_BRIDGE_MM, _MOST_BRIDGE_MM))
    core, count = ndimage.label(depth > bridge)  # type: ignore[misc]
    if not count:
        return None
    # The core nearest to the point, and all that lies within the radius of the ball that was rolled in it
    chosen = core == core.ravel()[np.where(core > 0, away, np.inf).argmin()]
    result = np.zeros(above.shape, bool)
    result[box] = ndimage.binary_fill_holes(part & (_distance_to(chosen, mm) <= bridge + mm))
    return result


def _resampled(array: np.ndarray, step: np.ndarray, first: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    moved = ndimage.affine_transform(array.astype(np.float32), step, first, shape, order=1)  # pyright: ignore
    return cast(np.ndarray, moved)


def _depth(inside: np.ndarray, mm: float) -> np.ndarray:
    return cast(np.ndarray, ndimage.distance_transform_edt(inside, sampling=mm))


def _distance_to(inside: np.ndarray, mm: float) -> np.ndarray:
    return _depth(~inside, mm)
