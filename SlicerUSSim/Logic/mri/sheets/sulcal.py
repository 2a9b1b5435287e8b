"""Sulci as the ridge of distance to white matter and of darkness: found where they are closed, too."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from SlicerUSSim.Logic.base.neighbourhood import distance_to
from SlicerUSSim.Logic.mri.coarse import components
from SlicerUSSim.Logic.mri.sheets.head import Head
from SlicerUSSim.Logic.mri.sheets.regions import hindbrain
from SlicerUSSim.Logic.tissue.surfels import Surfels

#: The distance counts up to this, and darkness as much as this distance, mm
_FARTHEST_MM, _DARK_MM = 7.0, 4.0
_SIGMA_MM, _LEAST_STRENGTH = 0.65, 0.35
#: Distance to white matter, depth below the hull of the brain, and least area of connected parts of a sulcus
_LEAST_DISTANCE_MM, _LEAST_DEPTH_MM, _LEAST_MM2 = 1.2, 1.5, 40.0
#: A dip is the intensity between two places at this distance along the normal and that at the middle, in deviations of
#: the noise; the mean of this many neighbours counts
_FLANK_MM, _NEIGHBOURS, _LEAST_DIP = 2.0, 24, 1.5
#: Sulci of this dip are sure to 63 %: fitted to the share that a T2 confirms beyond chance, see docs/sheets.md
_SURE_DIP = 2.8
#: Profiles across sulci from which their width is taken, mm, and the least: two layers of pia mater
_REACH_MM, _STEP_MM, _THINNEST_MM = 3.0, 0.5, 0.2
#: Tumours and vessels are brighter than white matter by this many deviations of the noise
_BRIGHT = 3.0


def sulci(head: Head, ventricles: np.ndarray) -> Surfels:
    """Surfels on the middles of sulci: ridges of min(D, 7 mm) + 4 mm fluid, where D is the distance to white matter.

    None in and beside the `ventricles` (k, j, i), and none below the tentorium. Without an atlas, as in a part of a
    brain, darkness alone counts: the distance to white matter is not that of the whole, and a lesion may fill most of
    it.
    """
    is_whole = head.registered is not None
    relief = _DARK_MM * head.fluid(head.image.array)
    if is_whole:
        relief += np.minimum(head.white_distance, _FARTHEST_MM)
    near_ventricle = distance_to(ventricles, head.image.spacing_mm) < 2.0
    where = (
        (head.depth > _LEAST_DEPTH_MM)
        & ((head.white_distance > _LEAST_DISTANCE_MM) | (not is_whole))
        & (head.image.array < head.white + _BRIGHT * head.noise)
        & ~hindbrain(head)
        & ~near_ventricle
    )
    found = ridges(relief, head.spacing, where, _SIGMA_MM, _LEAST_STRENGTH)
    found = large_parts(found, where.shape, _LEAST_MM2)
    return described(head, found)


def described(head: Head, found: Ridges) -> Surfels:
    """Points as surfels with width and confidence; without those that no dip of the intensity supports."""
    place = head.to_ras(found.place)
    turn = head.image.ijk_to_ras[:3, :3] / head.image.spacing_mm
    normal = found.normal[:, ::-1] @ turn.T
    dip = dips(head, place, normal)
    dip = smoothed_over_neighbours(place, dip)
    kept = dip > _LEAST_DIP
    place, normal, dip = place[kept], normal[kept], dip[kept]
    confidence = 1.0 - np.exp(-dip / _SURE_DIP)
    return Surfels.of("sulcus", place, normal, widths(head, place, normal), confidence, found.area[kept])


def dips(head: Head, place: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(n,) by how much it is darker than beside, in deviations of the noise; white matter beside counts as grey."""
    sides = [np.minimum(head.at(place + side * _FLANK_MM * normal), head.grey) for side in (-1.0, 1.0)]
    return (0.5 * (sides[0] + sides[1]) - head.at(place)) / head.noise


def smoothed_over_neighbours(place: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(n,) means over the nearest surfels."""
    count = min(_NEIGHBOURS, len(place))
    if count < 2:
        return values
    _, nearest = KDTree(place).query(place, count, workers=-1)
    return values[nearest].mean(axis=1)


def widths(head: Head, place: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(n,) mm of fluid along the normal through the middle, up to the first tissue."""
    total = head.fluid(head.at(place)) * _STEP_MM
    for side in (-1.0, 1.0):
        before = head.fluid(head.at(place))
        for step in np.arange(_STEP_MM, _REACH_MM + 1e-6, _STEP_MM):
            # A second sulcus beside is another: the fluid never grows again.
            before = np.minimum(before, head.fluid(head.at(place + side * step * normal)))
            total = total + before * _STEP_MM
    return np.maximum(total, _THINNEST_MM)


# ---- ridges of an image, with a place finer than a voxel (Steger, IEEE TPAMI 20(2), 1998) ----------------------------

#: First estimates of tops that are improved, in voxels from the middle of one along each axis; and places beside the
#: estimate at which values are compared, mm
_FIRST_VOXELS, _ASIDE_MM = 1.2, 0.4


@dataclass(frozen=True, eq=False)
class Ridges:
    """Points on ridges; one per voxel that a ridge crosses."""

    #: (n, 3) int voxels k, j, i
    voxel: np.ndarray
    #: (n, 3) float32 places k, j, i, within half a voxel of those
    place: np.ndarray
    #: (n, 3) float32 unit vectors across the ridge, along k, j, i
    normal: np.ndarray
    #: (n,) float32 curvature across the ridge, per mm²
    strength: np.ndarray
    #: (n,) float32 mm² of ridge for which a point stands
    area: np.ndarray

    def chosen(self, which: np.ndarray) -> Ridges:
        """Some of the points."""
        return Ridges(self.voxel[which], self.place[which], self.normal[which], self.strength[which], self.area[which])


def ridges(
    values: np.ndarray, spacing: np.ndarray, candidates: np.ndarray, sigma_mm: float, least_strength: float
) -> Ridges:
    """Where (k, j, i) `values` smoothed by `sigma_mm` are largest across a sheet, in the voxels of `candidates`.

    `spacing` is in mm along k, j, i. The second derivatives of the smoothed values give the direction in which they
    bend most, and the first ones how far in that direction the top is; a point is kept where that is within its voxel.
    """
    smooth = ndimage.gaussian_filter(values.astype(np.float32), sigma_mm / spacing)
    inner = np.zeros_like(candidates)
    inner[1:-1, 1:-1, 1:-1] = candidates[1:-1, 1:-1, 1:-1]
    here = np.flatnonzero(inner)
    gradient, hessian = _derivatives(smooth, here, spacing)
    # Most voxels bend nowhere downwards (Gershgorin's bound of the eigenvalues), and eigenvectors take time.
    diagonal = np.diagonal(hessian, axis1=1, axis2=2)
    bent = (diagonal - np.abs(hessian).sum(axis=2) + np.abs(diagonal)).min(axis=1) < -least_strength
    here, gradient, hessian = here[bent], gradient[bent], hessian[bent]
    bends, directions = np.linalg.eigh(hessian)
    strength, normal = -bends[:, 0], directions[:, :, 0]
    slope = (gradient * normal).sum(axis=1)
    offset = slope / np.maximum(strength, 1e-6)  # mm
    reached = (np.abs(offset[:, None] * normal) <= _FIRST_VOXELS * spacing).all(axis=1)
    kept = (strength > least_strength) & reached
    voxel = np.stack(np.unravel_index(here[kept], values.shape), axis=1)
    normal, strength, offset = normal[kept], strength[kept], offset[kept]
    offset = _at_top(smooth, voxel, normal / spacing, offset)
    place = voxel + offset[:, None] * normal / spacing
    # Half open, so that a top midway between two voxels belongs to one of them.
    moved = place - voxel
    kept = ((moved > -0.5) & (moved <= 0.5)).all(axis=1)
    voxel, place, normal, strength = voxel[kept], place[kept], normal[kept], strength[kept]
    # A plane crosses 1 / (volume max |n_i| / h_i) voxels per area so that its foot point lies in them.
    area = np.prod(spacing) * (np.abs(normal) / spacing).max(axis=1)
    return Ridges(
        voxel,
        place.astype(np.float32),
        normal.astype(np.float32),
        strength.astype(np.float32),
        area.astype(np.float32),
    )


def _at_top(smooth: np.ndarray, voxel: np.ndarray, step: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """(n,) mm along the normal to the top, from a first estimate: by parabolas through three values around it.

    `step` (n, 3) is a millimetre along the normal in voxels. The first estimate is of derivatives at the voxel, which
    overshoot where the ridge is not a parabola; at borders of voxels, points would be lost.
    """
    spline = cast(np.ndarray, ndimage.spline_filter(smooth, output=np.float32))  # pyright: ignore[reportArgumentType]
    for _ in range(2):
        before, here, after = (
            ndimage.map_coordinates(
                spline, (voxel + (offset + move)[:, None] * step).T, output=np.float32, prefilter=False, mode="nearest"
            )
            for move in (-_ASIDE_MM, 0.0, _ASIDE_MM)
        )
        bend = np.minimum(before + after - 2.0 * here, -1e-6)
        offset = offset - np.clip(0.5 * _ASIDE_MM * (after - before) / bend, -_ASIDE_MM, _ASIDE_MM)
    return offset


def _derivatives(smooth: np.ndarray, here: np.ndarray, spacing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """((n, 3) per mm, (n, 3, 3) per mm²) along k, j, i at flat indices."""
    flat = smooth.ravel()
    steps = np.array([smooth.shape[1] * smooth.shape[2], smooth.shape[2], 1])
    gradient = np.empty((len(here), 3), np.float32)
    hessian = np.empty((len(here), 3, 3), np.float32)
    centre = flat[here]
    for a in range(3):
        after, before = flat[here + steps[a]], flat[here - steps[a]]
        gradient[:, a] = (after - before) / (2.0 * spacing[a])
        hessian[:, a, a] = (after + before - 2.0 * centre) / spacing[a] ** 2
        for b in range(a):
            plus, minus = steps[a] + steps[b], steps[a] - steps[b]
            mixed = flat[here + plus] + flat[here - plus] - flat[here + minus] - flat[here - minus]
            hessian[:, a, b] = hessian[:, b, a] = mixed / (4.0 * spacing[a] * spacing[b])
    return gradient, hessian


def large_parts(found: Ridges, shape: tuple[int, ...], least_mm2: float) -> Ridges:
    """The points in connected parts of at least this area; voxels connect by faces, edges and corners."""
    crossed = np.zeros(shape, bool)
    crossed[tuple(found.voxel.T)] = True
    part = components(crossed, corners=True)[tuple(found.voxel.T)]
    areas = np.bincount(part, found.area)
    return found.chosen(areas[part] >= least_mm2)
