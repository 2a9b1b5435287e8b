"""Contrast and width of thin bright lines in B-mode images: sheets and walls of fluid, against their angle to the beam.

Profiles across the line are averaged along it over 2 mm, shifted so that their maxima within 2 mm coincide, since poses
and labels are not more accurate, and averaged. The maximum of noise is bright, too: `chance` is what the same procedure
finds beside the line, and only the excess over it is contrast.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.tissue.surfels import Surfels

#: Angles between the normal of a line and the beam, degrees: from squarely on to along it
ANGLES_DEG = ((0, 30), (30, 60), (60, 90))
_STEP_MM, _REACH_MM, _SEARCH_MM = 0.1, 6.0, 2.0
#: Flanks of a line, from its maximum
_FLANK_MM = 2.0, 4.0
_ALONG_MM = np.linspace(-1.0, 1.0, 7)
#: How far beside a line `chance` is measured
_ASIDE_MM = 7.0
_LEAST_POINTS = 12
#: How far from the image plane pieces of sheets count, mm
_SLICE_MM = 0.7


@dataclass(frozen=True, eq=False)
class LinePoints:
    """Points of thin lines in one image."""

    #: (n, 2) mm in the image plane: lateral, depth
    place: np.ndarray
    #: (n, 2) unit vectors across the line; of a wall away from the fluid
    normal: np.ndarray
    #: Whether one side is dark, so that only the flank along the normal counts
    is_wall: bool


@dataclass(frozen=True)
class LineContrast:
    """A thin line in some images where its normal is between two angles to the beam."""

    angle_deg: tuple[int, int]
    points: int
    #: Grey levels of the line above its flanks
    contrast: float
    #: The same beside the line
    chance: float
    #: Full width at half height, mm
    width_mm: float


def wall_points(labels: np.ndarray, chosen: Sequence[int], grid: ImageGrid) -> LinePoints:
    """Borders of labels (rows, columns), a wall: points half-way between pixels of `chosen` labels and others."""
    inside = np.isin(labels, chosen).astype(np.float32)
    pixel = grid.pixel_spacing_mm
    smooth = ndimage.gaussian_filter(inside, [0.6 / pixel[1], 0.6 / pixel[0]])
    down, across = np.gradient(smooth, pixel[1], pixel[0])
    steep = np.hypot(down, across)
    border = (smooth > 0.5) & (ndimage.minimum_filter(smooth, 3) <= 0.5) & (steep > 0.2)
    return _points(border, -np.stack([across, down], axis=-1), grid, is_wall=True)


def sheet_points(labels: np.ndarray, chosen: Sequence[int], grid: ImageGrid) -> LinePoints:
    """Middle lines of thin labels (rows, columns)."""
    inside = np.isin(labels, chosen)
    pixel = grid.pixel_spacing_mm
    smooth = ndimage.gaussian_filter(inside.astype(np.float32), [0.8 / pixel[1], 0.8 / pixel[0]])
    # Across a ridge the curvature is largest: the eigenvector of the Hessian with the most negative eigenvalue
    down, across = np.gradient(smooth, pixel[1], pixel[0])
    yy, yx = np.gradient(down, pixel[1], pixel[0])
    _, xx = np.gradient(across, pixel[1], pixel[0])
    angle = 0.5 * np.arctan2(2.0 * yx, xx - yy) + 0.5 * np.pi
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    # On the ridge the gradient across it changes sign within a pixel
    slope = across * normal[..., 0] + down * normal[..., 1]
    bend = xx * normal[..., 0] ** 2 + 2.0 * yx * normal[..., 0] * normal[..., 1] + yy * normal[..., 1] ** 2
    ridge = inside & (bend < 0.0) & (np.abs(slope) < 0.6 * max(pixel) * np.abs(bend))
    return _points(ridge, normal, grid, is_wall=False)


def surfel_points(surfels: Surfels, probe_to_ras: np.ndarray, grid: ImageGrid) -> LinePoints:
    """Where sheets that were found in the MRI cross the image plane of a probe at a pose (4, 4)."""
    inverse = np.linalg.inv(probe_to_ras)
    place = surfels.place @ inverse[:3, :3].T + inverse[:3, 3]
    normal = (surfels.normal @ inverse[:3, :3].T)[:, :2]
    size = np.linalg.norm(normal, axis=1)
    # A sheet nearly in the plane has no line there.
    chosen = (np.abs(place[:, 2]) < _SLICE_MM) & (size > 0.5)
    pixel = (place[:, :2] - [grid.left_mm, grid.top_mm]) / grid.pixel_spacing_mm
    chosen &= (pixel >= 0.0).all(axis=1) & (pixel < [grid.columns, grid.rows]).all(axis=1)
    return LinePoints(place[chosen, :2], normal[chosen] / size[chosen, None], is_wall=False)


def line_contrast(
    images: Sequence[np.ndarray], points: Sequence[LinePoints], probe: Probe, grid: ImageGrid, inside: np.ndarray
) -> list[LineContrast]:
    """Contrast and width of the lines at these points of each image, (rows, columns) uint8, by their angle to the beam.

    `inside` is the imaged field, (rows, columns) bool. Angles with too few points are left out.
    """
    profiles: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for image, found in zip(images, points, strict=True):
        if not len(found.place):
            continue
        beam = _beam(found.place, probe)
        angle = np.rad2deg(np.arccos(np.clip(np.abs((beam * found.normal).sum(axis=1)), 0.0, 1.0)))
        on = _profiles(image, found, grid, inside, 0.0)
        sides = (1.0,) if found.is_wall else (1.0, -1.0)
        beside = np.stack([_profiles(image, found, grid, inside, side * _ASIDE_MM) for side in sides])
        profiles.append((angle, on, beside))
    if not profiles:
        return []
    is_wall = any(found.is_wall for found in points)
    angle = np.concatenate([a for a, _, _ in profiles])
    on = np.concatenate([p for _, p, _ in profiles])
    beside = np.concatenate([p for _, _, p in profiles], axis=1)
    result = []
    for low, high in ANGLES_DEG:
        near = (angle >= low) & (angle < high + (high == 90)) & np.isfinite(on).all(axis=1)
        if np.count_nonzero(near) < _LEAST_POINTS:
            continue
        contrast, width = _aligned(on[near], is_wall)
        others = np.concatenate([p[near] for p in beside])
        others = others[np.isfinite(others).all(axis=1)]
        chance = _aligned(others, False)[0] if len(others) >= _LEAST_POINTS else float("nan")
        result.append(LineContrast((low, high), int(np.count_nonzero(near)), contrast, chance, width))
    return result


def _points(where: np.ndarray, normal: np.ndarray, grid: ImageGrid, is_wall: bool) -> LinePoints:
    rows, columns = np.nonzero(where)
    size = np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    place = np.stack(
        [
            grid.left_mm + (columns + 0.5) * grid.pixel_spacing_mm[0],
            grid.top_mm + (rows + 0.5) * grid.pixel_spacing_mm[1],
        ],
        axis=1,
    )
    return LinePoints(place, (normal / size)[rows, columns], is_wall)


def _beam(place: np.ndarray, probe: Probe) -> np.ndarray:
    """(n, 2) unit vectors along the beams at (n, 2) places."""
    if probe.is_linear:
        return np.broadcast_to([np.sin(probe.steering_rad), np.cos(probe.steering_rad)], place.shape)
    away = place + [0.0, probe.apex_radius_mm]
    return away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)


def _profiles(image: np.ndarray, found: LinePoints, grid: ImageGrid, inside: np.ndarray, aside_mm: float) -> np.ndarray:
    """(n, samples) grey levels across the line from -_REACH_MM to _REACH_MM; NaN where a profile leaves the field."""
    across = np.arange(-_REACH_MM, _REACH_MM + 0.5 * _STEP_MM, _STEP_MM) + aside_mm
    tangent = found.normal[:, ::-1] * [-1.0, 1.0]
    at = (
        found.place[:, None, None]
        + across[None, :, None, None] * found.normal[:, None, None]
        + _ALONG_MM[None, None, :, None] * tangent[:, None, None]
    )
    columns = (at[..., 0] - grid.left_mm) / grid.pixel_spacing_mm[0] - 0.5
    rows = (at[..., 1] - grid.top_mm) / grid.pixel_spacing_mm[1] - 0.5
    grey = ndimage.map_coordinates(image.astype(np.float32), [rows, columns], order=1, mode="nearest").mean(axis=2)
    seen = ndimage.map_coordinates(inside.astype(np.float32), [rows, columns], order=0, cval=0.0).min(axis=2)
    return np.where(seen > 0.5, grey, np.nan)


def _aligned(profiles: np.ndarray, is_wall: bool) -> tuple[float, float]:
    """(contrast, full width at half height in mm) of (n, samples) profiles, shifted by their maxima."""
    middle, search = profiles.shape[1] // 2, round(_SEARCH_MM / _STEP_MM)
    reach = middle - search
    peak = middle - search + np.argmax(profiles[:, middle - search : middle + search + 1], axis=1)
    around = profiles[np.arange(len(profiles))[:, None], peak[:, None] + np.arange(-reach, reach + 1)].mean(axis=0)
    distance = np.arange(-reach, reach + 1) * _STEP_MM
    flank = (np.abs(distance) >= _FLANK_MM[0]) & (np.abs(distance) <= _FLANK_MM[1])
    if is_wall:
        flank &= distance > 0.0
    ground = float(around[flank].mean())
    contrast = float(around[reach]) - ground
    half = ground + 0.5 * contrast
    width = 0.0
    for side in (around[reach:], around[reach::-1]):
        below = np.flatnonzero(side < half)
        if contrast <= 0.0 or not below.size:
            return contrast, float("nan")
        n = int(below[0])
        width += _STEP_MM * (n - 1 + (side[n - 1] - half) / (side[n - 1] - side[n]))
    return contrast, float(width)
