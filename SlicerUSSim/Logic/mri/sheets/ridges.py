"""Sheets as ridges of an image, with a place finer than a voxel (Steger, IEEE TPAMI 20(2), 1998)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.mri.coarse import components

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
