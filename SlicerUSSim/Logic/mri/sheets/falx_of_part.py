"""The falx cerebri in a part of a brain, without an atlas: the fissure that is straighter and deeper than all sulci.

Between the hemispheres the sulci that were found (sulcal.py) lie in one sheet close to a plane across the patient's
left and right, which goes from the hull of the brain down to the corpus callosum. No other sulcus does: of the planes
in parts of two whole heads, those that are the fissure reach 31 to 54 mm deep and others 6 to 28 mm (docs/sheets.md).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.mri.coarse import largest_component
from SlicerUSSim.Logic.mri.sheets.falx import thick_white_matter
from SlicerUSSim.Logic.mri.sheets.head import Head
from SlicerUSSim.Logic.mri.sheets.heights import patches
from SlicerUSSim.Logic.mri.sheets.regions import ventricles
from SlicerUSSim.Logic.mri.sheets.sulcal import sulci
from SlicerUSSim.Logic.tissue.surfels import Surfels

#: The plane's normal is this near to left and right, and to the axial plane: heads are turned in scanners. Those of the
#: leaves of the tentorium are steeper
_MOST_TURN_DEG, _MOST_ROLL_DEG = 30.0, 20.0
#: Sulci within this distance and angle of a plane are in it; another plane is this much farther away or turned
_NEAR_MM, _NEAR_DEG, _APART_MM, _APART_DEG = 3.0, 35.0, 10.0, 30.0
#: Places of sulci at which planes are tried, planes of most sulci that are looked at, and fewest surfels in one
_TRIED, _LOOKED_AT, _LEAST_SULCI = 800, 6, 30
#: Grid of the height field; standard deviation by which heights are smoothed, and least share that sulci cover of it
_STEP_MM, _SMOOTHING_MM, _LEAST_COVER = 1.0, 4.0, 0.12
#: The fissure begins at most so far below the hull or the end of the image, and gaps as long are bridged
_TOP_MM, _GAP_MM = 8.0, 8.0
#: How deep the deepest tenth of it reaches at least, and how near to the hull it comes; there the hull is not below it,
#: as below cisterns: upwards its depth grows by less than this, per mm
_LEAST_DEEP_MM, _AT_HULL_MM, _FROM_BELOW = 30.0, 3.0, 0.5
#: From the end of the fissure up to the free edge: 3 mm at the back of MNI152 and 16 mm in front (falx.FREE_EDGE); and
#: how far it is below the top there, but at the back, where fissure and falx end together
_FREE_MM, _WIDEST_MM = 5.0, 42.0
_THICKNESS_MM, _CONFIDENCE = 1.0, 0.7


@dataclass(frozen=True, eq=False)
class _Plane:
    """A plane and the sulci in it."""

    #: (3,) RAS mm, and (3,) unit normal, towards R
    middle: np.ndarray
    normal: np.ndarray
    #: (n,) bool: which sulci, and mm² of them, weighted by confidence
    inside: np.ndarray
    amount: float

    @property
    def axes(self) -> np.ndarray:
        """(3, 3) rows: the normal, towards A and towards S in the plane."""
        up = np.array([0.0, 0.0, 1.0]) - self.normal[2] * self.normal
        up /= np.linalg.norm(up)
        return np.stack([self.normal, np.cross(up, self.normal), up])

    @property
    def is_across(self) -> bool:
        """Whether it may divide left from right."""
        turn, roll = np.cos(np.radians(_MOST_TURN_DEG)), np.sin(np.radians(_MOST_ROLL_DEG))
        return bool(self.normal[0] >= turn and abs(self.normal[2]) <= roll)

    def is_apart(self, other: _Plane) -> bool:
        is_turned = abs(self.normal @ other.normal) < np.cos(np.radians(_APART_DEG))
        return bool(is_turned or abs((self.middle - other.middle) @ other.normal) > _APART_MM)


@dataclass(frozen=True, eq=False)
class _Fissure:
    """The height field of a plane's sulci, (upward, forward)."""

    #: (upward, forward, 3) RAS mm
    place: np.ndarray
    #: mm below the hull, and bool: from the hull down to its end
    depth: np.ndarray
    inside: np.ndarray

    @property
    def is_between_hemispheres(self) -> bool:
        if not self.inside.any():
            return False
        deepest = np.where(self.inside, self.depth, 0.0).max(axis=0)
        reach = np.percentile(deepest[deepest > 0.0], 90.0) if (deepest > 0.0).any() else 0.0
        at_hull = self.inside & (self.depth <= _AT_HULL_MM) & (np.gradient(self.depth, axis=0) < _FROM_BELOW * _STEP_MM)
        return bool(reach >= _LEAST_DEEP_MM and at_hull.any())


def falx_of_part(head: Head, surfels: Surfels) -> Surfels:
    """Surfels 1 mm apart on the falx; none where no fissure of the sulci (`surfels`) is deep enough.

    Its free edge is not seen: it is taken 5 mm above the end of the fissure.
    """
    fissure = _fissure(head, surfels)
    return Surfels.joined([]) if fissure is None else _above_free_edge(fissure)


def fissure_of_part(head: Head) -> np.ndarray:
    """(n, 3) RAS mm of points 1 mm apart between the hemispheres, down to the end of the fissure; none if not found."""
    fissure = _fissure(head, sulci(head, ventricles(head)))
    if fissure is None:
        return np.zeros((0, 3))
    # Some millimetres farther down, where it fades
    down = np.zeros((2 * round(_FREE_MM / _STEP_MM) + 1, 1), bool)
    down[: len(down) // 2 + 1] = True
    return fissure.place[np.asarray(ndimage.binary_dilation(fissure.inside, down)).astype(bool)]


def _fissure(head: Head, surfels: Surfels) -> _Fissure | None:
    white = thick_white_matter(head)
    found = (_fissure_at(head, surfels, plane, white) for plane in _planes(surfels))
    return next((fissure for fissure in found if fissure.is_between_hemispheres), None)


def _planes(surfels: Surfels) -> Iterator[_Plane]:
    """Planes across left and right, those with most sulci first."""
    weight = surfels.area * surfels.confidence
    some = np.linspace(0, len(surfels) - 1, min(_TRIED, len(surfels))).astype(int)
    tried = [_plane_at(surfels, weight, surfels.place[n], surfels.normal[n]) for n in some]
    tried = [plane for plane in tried if plane.is_across]
    chosen: list[_Plane] = []
    for plane in sorted(tried, key=lambda plane: -plane.amount):
        if all(plane.is_apart(other) for other in chosen):
            chosen.append(plane)
            better = _refined(surfels, weight, plane)
            if better.is_across and np.count_nonzero(better.inside) >= _LEAST_SULCI:
                yield better
        if len(chosen) == _LOOKED_AT:
            return


def _plane_at(surfels: Surfels, weight: np.ndarray, middle: np.ndarray, normal: np.ndarray) -> _Plane:
    normal = np.asarray(normal, float) * (1.0 if normal[0] >= 0.0 else -1.0)
    is_near = np.abs((surfels.place - middle) @ normal) < _NEAR_MM
    inside = is_near & (np.abs(surfels.normal @ normal) > np.cos(np.radians(_NEAR_DEG)))
    return _Plane(np.asarray(middle, float), normal, inside, float(weight[inside].sum()))


def _refined(surfels: Surfels, weight: np.ndarray, plane: _Plane) -> _Plane:
    """The plane of least squares through the sulci in it."""
    for _ in range(3):
        if np.count_nonzero(plane.inside) < _LEAST_SULCI:
            return plane
        points, share = surfels.place[plane.inside].astype(float), weight[plane.inside]
        middle = np.average(points, axis=0, weights=share)
        rows = np.linalg.svd((points - middle) * np.sqrt(share)[:, None], full_matrices=False)[2]
        plane = _plane_at(surfels, weight, middle, rows[2])
    return plane


def _fissure_at(head: Head, surfels: Surfels, plane: _Plane, white: np.ndarray) -> _Fissure:
    chosen, axes = surfels.chosen(plane.inside), plane.axes
    local = (chosen.place - plane.middle) @ axes.T  # (n, 3): height, forward, upward
    low = np.floor(local[:, 1:].min(axis=0)) - _SMOOTHING_MM
    high = np.ceil(local[:, 1:].max(axis=0)) + _SMOOTHING_MM
    forward, upward = (np.arange(start, stop + 1e-6, _STEP_MM) for start, stop in zip(low, high, strict=True))
    height, cover = _height_field(local, chosen.area * chosen.confidence, low, (len(upward), len(forward)))
    corners = np.stack([height, *np.broadcast_arrays(forward[None], upward[:, None])], axis=-1)
    place = plane.middle + corners @ axes

    def on_sheet(array: np.ndarray) -> np.ndarray:
        return head.at(place.reshape(-1, 3), array.astype(np.float32)).reshape(height.shape)

    depth, is_white = on_sheet(head.depth), on_sheet(white) > 0.5
    usable = (depth > 0.0) & (on_sheet(np.ones(head.brain.shape)) > 0.5)
    inside = np.zeros_like(usable)
    for column in range(inside.shape[1]):
        rows = _rows(usable[:, column], cover[:, column] > _LEAST_COVER, is_white[:, column])
        inside[rows, column] = usable[rows, column]
    inside = largest_component(np.asarray(ndimage.binary_opening(inside, np.ones((3, 3)))))
    return _Fissure(place, depth, inside)


def _height_field(
    local: np.ndarray, weight: np.ndarray, low: np.ndarray, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """((upward, forward) heights in mm, mm² of sulci per mm² there), both smooth."""
    index = np.rint((local[:, 1:] - low) / _STEP_MM).astype(int)
    cell = np.ravel_multi_index((index[:, 1], index[:, 0]), shape)
    count, sigma = int(np.prod(shape)), _SMOOTHING_MM / _STEP_MM
    amount = np.bincount(cell, weight, count).reshape(shape)
    total = np.bincount(cell, weight * local[:, 0], count).reshape(shape)
    wide = np.maximum(ndimage.gaussian_filter(amount, sigma, mode="nearest"), 1e-12)
    cover = ndimage.gaussian_filter(amount, 0.5 * sigma) / _STEP_MM**2
    return ndimage.gaussian_filter(total, sigma, mode="nearest") / wide, cover


def _rows(usable: np.ndarray, covered: np.ndarray, white: np.ndarray) -> slice:
    """Of one column, from the bottom upwards: from its highest place down to the end of the fissure, or none."""
    none = slice(0, 0)
    if not usable.any():
        return none
    top = int(np.flatnonzero(usable)[-1])
    # The corpus callosum ends it
    callosum = np.flatnonzero(ndimage.binary_opening(white[: top + 1], np.ones(3)))
    found = np.flatnonzero(covered[: top + 1] & usable[: top + 1])
    found = found[found > (callosum[-1] if len(callosum) else -1)][::-1]
    if not len(found) or (top - found[0]) * _STEP_MM > _TOP_MM:
        return none
    gaps = np.flatnonzero(np.diff(found) < -_GAP_MM / _STEP_MM)
    return slice(int(found[gaps[0]] if len(gaps) else found[-1]), top + 1)


def _above_free_edge(fissure: _Fissure) -> Surfels:
    kept = np.zeros_like(fissure.inside)
    free, widest = round(_FREE_MM / _STEP_MM), round(_WIDEST_MM / _STEP_MM)
    for column in np.flatnonzero(fissure.inside.any(axis=0)):
        rows = np.flatnonzero(fissure.inside[:, column])
        edge = max(rows[0] + free, rows[-1] - widest)
        kept[edge:, column] = fissure.inside[edge:, column]
    normal, area = patches(fissure.place)
    return Surfels.of("falx", fissure.place[kept], normal[kept], _THICKNESS_MM, _CONFIDENCE, area[kept])
