"""Surfels on a grid, as a ray that steps through voxels meets them: the plane of the nearest sheet in each voxel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.tissue.surfels import Surfels

#: Surfels that share in the plane of a voxel, and the deviation of their weights by distance, mm
_NEIGHBOURS, _SIGMA_MM = 8, 0.7
#: Neighbours whose normals differ by more belong to another sheet
_SAME_COSINE = 0.7
#: A sheet extends beyond a surfel's place by this much of its radius, and this far at least: of ridges in voxels of
#: 1 mm, no place is farther from a surfel, however the sheet is tilted
_RIM, _RIM_MM = 1.5, 0.9
#: Voxels at a time
_CHUNK = 50_000


@dataclass(frozen=True, eq=False)
class SheetVoxels:
    """The sheet next to each voxel of a grid that has one near."""

    #: (n,) flat indices of these voxels
    voxels: np.ndarray
    #: (n,) uint8 index in KINDS
    kind: np.ndarray
    #: (n,) signed distance in mm, and (n, 3) unit normal in RAS: centre + distance x normal lies on the sheet
    distance: np.ndarray
    normal: np.ndarray
    #: (n,) mm, and (n,) 0 to 1
    thickness: np.ndarray
    confidence: np.ndarray


def on_voxels(surfels: Surfels, grid: Volume, *, reach_mm: float = 2.0) -> SheetVoxels:
    """The plane of the nearest sheet in every voxel whose centre is within reach of one.

    Parameters
    ----------
    surfels : about as dense as the voxels of the image in which they were found.
    grid : whose voxels are filled, such as a label map's.
    reach_mm : largest distance from a sheet; at least 0.9 of a voxel's diagonal, so that no ray slips through.

    The plane in a voxel is the mean of the nearest surfels' planes, weighted by their distance from the foot of the
    perpendicular: of surfels on a plane it is that plane, wherever the voxels lie. Beyond the rim of a sheet, by more
    than a surfel's radius, nothing is filled.

    Raises SimulationError for a reach that is shorter than voxels need.
    """
    from scipy.spatial import KDTree  # images of labels alone do not wait for it

    least = 0.9 * 0.5 * float(np.linalg.norm(grid.spacing_mm))
    require(reach_mm >= least, f"reach_mm is {reach_mm:g}, expected at least {least:.2g} mm for voxels of this grid")
    # A plane's foot lies this far from its surfel at most
    farthest = float(np.hypot(reach_mm, max(_RIM * np.sqrt(surfels.area.max(initial=0.0) / np.pi), _RIM_MM))) + 1e-3
    near = np.flatnonzero(_near(surfels, grid, farthest))
    if not len(near):
        none = np.zeros(0, np.float32)
        return SheetVoxels(near, np.zeros(0, np.uint8), none, np.zeros((0, 3), np.float32), none, none)
    tree = KDTree(surfels.place)
    chunks = [near[start : start + _CHUNK] for start in range(0, len(near), _CHUNK)]
    parts = [_planes(surfels, tree, voxels, grid, reach_mm) for voxels in chunks]
    return SheetVoxels(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def _planes(surfels: Surfels, tree: Any, voxels: np.ndarray, grid: Volume, reach_mm: float) -> tuple[np.ndarray, ...]:
    """The fields of SheetVoxels of those of `voxels` (flat indices) that have a sheet in reach."""
    indices = np.stack(np.unravel_index(voxels, grid.array.shape)[::-1], axis=1)
    centres = (indices @ grid.ijk_to_ras[:3, :3].T + grid.ijk_to_ras[:3, 3]).astype(np.float32)
    count = min(_NEIGHBOURS, len(surfels))
    _, nearest = tree.query(centres, count, workers=-1)
    nearest = nearest.reshape(len(centres), count)
    # The sheet belongs to the surfel whose disc is nearest; its neighbours smooth it.
    apart = surfels.place[nearest] - centres[:, None]
    normals = surfels.normal[nearest]
    across = np.einsum("nkx,nkx->nk", apart, normals)
    aside = np.sqrt(np.maximum(np.einsum("nkx,nkx->nk", apart, apart) - across**2, 0.0))
    radius = np.sqrt(surfels.area[nearest] / np.pi)
    first = np.hypot(across, np.maximum(aside - radius, 0.0)).argmin(axis=1)
    row = np.arange(len(centres))
    lead, lead_normal = nearest[row, first], normals[row, first]
    cosine = np.einsum("nkx,nx->nk", normals, lead_normal)
    same = (np.abs(cosine) > _SAME_COSINE) & (surfels.kind[nearest] == surfels.kind[lead][:, None])
    # Nearness to the foot on the leading plane
    foot = across[row, first][:, None] * lead_normal
    off = apart - foot[:, None]
    from_foot = np.einsum("nkx,nkx->nk", off, off)
    weight = np.where(same, np.exp(-0.5 * from_foot / _SIGMA_MM**2), 0.0) + 1e-12
    weight /= weight.sum(axis=1, keepdims=True)
    normal = np.einsum("nk,nkx->nx", weight * np.sign(cosine), normals)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    distance = np.einsum("nk,nkx,nx->n", weight, apart, normal)
    # How far the foot lies outside the leading surfel; a sheet ends where its surfels do.
    beyond = aside[row, first] - np.maximum(_RIM * radius[row, first], _RIM_MM)
    inside = (np.abs(distance) <= reach_mm) & (beyond <= 0.0)
    thickness, confidence = (
        (weight * getattr(surfels, name)[nearest]).sum(axis=1)[inside] for name in ("thickness", "confidence")
    )
    return voxels[inside], surfels.kind[lead[inside]], distance[inside], normal[inside], thickness, confidence


def _near(surfels: Surfels, grid: Volume, reach_mm: float) -> np.ndarray:
    """(k, j, i) True where a centre is within reach of a surfel."""
    matrix, spacing = grid.ras_to_ijk, grid.spacing_mm
    around = np.ceil(reach_mm / spacing + 0.5).astype(int)
    shape = np.array(grid.array.shape[::-1]) + 4 * around
    strides = np.array([1, shape[0], shape[0] * shape[1]])
    at = surfels.place @ matrix[:3, :3].T + matrix[:3, 3] + 2 * around
    at = at[((at >= around) & (at <= shape - around - 1)).all(axis=1)]
    nearest = np.rint(at)
    flat, apart = nearest.astype(int) @ strides, (nearest - at) @ grid.ijk_to_ras[:3, :3].T
    square = (apart**2).sum(axis=1)
    result = np.zeros(shape[::-1], bool)
    for offset in np.ndindex(*(2 * around + 1)):
        step = np.array(offset) - around
        step_mm = grid.ijk_to_ras[:3, :3] @ step
        if np.linalg.norm(step_mm) <= reach_mm + 0.5 * np.linalg.norm(spacing):
            is_near = square + apart @ (2.0 * step_mm) <= reach_mm**2 - step_mm @ step_mm
            result.ravel()[flat[is_near] + step @ strides] = True
    return result[tuple(slice(2 * n, -2 * n) for n in around[::-1])]
