"""Sheets as ridges of an image, with a place finer than a voxel (Steger, IEEE TPAMI 20(2), 1998)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage


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
        return Ridges(
            self.voxel[which], self.place[which], self.normal[which], self.strength[which], self.area[which]
        )


def ridges(
    values: np.ndarray, spacing: np.ndarray, candidates: np.ndarray, sigma_mm: float, least_strength: float
) -> Ridges:
    """Where (k, j, i) `values` smoothed by `sigma_mm` are largest across a sheet, in the voxels of `candidates`.

    `spacing` is in mm along k, j, i. The second derivatives of the smoothed values give the direction in which they
    bend most, and the first ones how far in that direction the top is; a point is kept where that is within its voxel.
    """
    # Differences over two voxels, as derivatives are taken here, are those of values averaged by a triangle.
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
    offset = (slope / np.maximum(strength, 1e-6))[:, None] * normal / spacing  # voxels
    kept = (strength > least_strength) & (np.abs(offset) <= 0.5).all(axis=1)
    voxel = np.stack(np.unravel_index(here[kept], values.shape), axis=1)
    normal = normal[kept]
    # A plane crosses 1 / (volume max |n_i| / h_i) voxels per area so that its foot point lies in them.
    area = np.prod(spacing) * (np.abs(normal) / spacing).max(axis=1)
    return Ridges(
        voxel,
        (voxel + offset[kept]).astype(np.float32),
        normal.astype(np.float32),
        strength[kept].astype(np.float32),
        area.astype(np.float32),
    )


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
    parts, _ = ndimage.label(crossed, np.ones((3, 3, 3)))  # type: ignore[misc]
    part = parts[tuple(found.voxel.T)]
    areas = np.bincount(part, found.area)
    return found.chosen(areas[part] >= least_mm2)
