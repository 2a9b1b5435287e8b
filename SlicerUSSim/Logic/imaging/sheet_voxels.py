"""Surfels on a grid, as a ray that steps through voxels meets them: the plane of the nearest sheet in each voxel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.tissue.surfels import Surfels

#: Bits of an entry: distance, normal (two coordinates of its octahedron), thickness, confidence
_DISTANCE_BITS, _NORMAL_BITS, _THICKNESS_BITS, _CONFIDENCE_BITS = 12, 10, 8, 6
#: Thickest sheet that is stored as it is, mm
_THICKEST_MM = 5.0
#: Surfels that share in the plane of a voxel, and the deviation of their weights by distance, mm
_NEIGHBOURS, _SIGMA_MM = 8, 0.7
#: Neighbours whose normals differ by more belong to another sheet
_SAME_COSINE = 0.7
#: A sheet goes on beyond a surfel's place by this much of its radius, and this far at least: of ridges in voxels of
#: 1 mm, no place is farther from a surfel, however the sheet is tilted
_RIM, _RIM_MM = 1.5, 0.9
#: Voxels at a time
_CHUNK = 50_000


@dataclass(frozen=True, eq=False)
class SheetVoxels:
    """The sheet next to each voxel of a grid, in 8 bytes for each voxel near one."""

    #: (k, j, i) int32 entry of each voxel; -1 where no sheet is near
    entry: Volume
    #: (entries, 2) uint32; see unpacked
    packed: np.ndarray
    #: (entries,) uint8 index in KINDS
    kind: np.ndarray
    #: Largest distance that is stored, mm
    reach_mm: float

    def unpacked(self, which: np.ndarray | slice = slice(None)) -> tuple[np.ndarray, ...]:
        """((n,) signed distance in mm, (n, 3) normal in RAS, (n,) thickness in mm, (n,) confidence) of entries.

        A voxel's centre plus distance times normal lies on the sheet.
        """
        first, second = self.packed[which].T.astype(np.int64)
        distance = _number(first, 0, _DISTANCE_BITS) * 2.0 - 1.0
        u = _number(first, _DISTANCE_BITS, _NORMAL_BITS) * 2.0 - 1.0
        v = _number(first, _DISTANCE_BITS + _NORMAL_BITS, _NORMAL_BITS) * 2.0 - 1.0
        thickness = _number(second, 0, _THICKNESS_BITS) * _THICKEST_MM
        confidence = _number(second, _THICKNESS_BITS, _CONFIDENCE_BITS)
        values = (distance * self.reach_mm, _from_octahedron(u, v), thickness, confidence)
        return tuple(value.astype(np.float32) for value in values)


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
    entry = np.full(grid.array.shape, -1, np.int32)
    # A plane's foot lies this far from its surfel at most
    farthest = float(np.hypot(reach_mm, max(_RIM * np.sqrt(surfels.area.max(initial=0.0) / np.pi), _RIM_MM))) + 1e-3
    near = np.argwhere(_near(surfels, grid, farthest))
    if not len(near):
        return SheetVoxels(grid.with_array(entry), np.zeros((0, 2), np.uint32), np.zeros(0, np.uint8), reach_mm)
    tree = KDTree(surfels.place)
    kept, packed, kinds = [], [], []
    for start in range(0, len(near), _CHUNK):
        voxels = near[start : start + _CHUNK]
        centres = (voxels[:, ::-1] @ grid.ijk_to_ras[:3, :3].T + grid.ijk_to_ras[:3, 3]).astype(np.float32)
        inside, words, kind = _planes(surfels, tree, centres, reach_mm)
        kept.append(voxels[inside])
        packed.append(words)
        kinds.append(kind)
    places = np.concatenate(kept)
    entry[tuple(places.T)] = np.arange(len(places), dtype=np.int32)
    return SheetVoxels(grid.with_array(entry), np.concatenate(packed), np.concatenate(kinds), reach_mm)


def _planes(
    surfels: Surfels, tree: Any, centres: np.ndarray, reach_mm: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """((n,) bool: whether a sheet is in reach, (m, 2) uint32 packed, (m,) uint8 kind) of (n, 3) centres."""
    count = min(_NEIGHBOURS, len(surfels))
    _, nearest = tree.query(centres, count, workers=-1)
    nearest = nearest.reshape(len(centres), count)
    # The sheet is that of the surfel whose disc is nearest; its neighbours smooth it.
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
    values = [(weight * getattr(surfels, name)[nearest]).sum(axis=1)[inside] for name in ("thickness", "confidence")]
    words = _packed(distance[inside] / reach_mm, normal[inside], *values)
    return inside, words, surfels.kind[lead[inside]]


def _packed(distance: np.ndarray, normal: np.ndarray, thickness: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    """(n, 2) uint32: distance (-1 to 1) and normal; thickness in mm and confidence."""
    u, v = _to_octahedron(normal)
    first = _bits(0.5 * distance + 0.5, 0, _DISTANCE_BITS)
    first |= _bits(0.5 * u + 0.5, _DISTANCE_BITS, _NORMAL_BITS)
    first |= _bits(0.5 * v + 0.5, _DISTANCE_BITS + _NORMAL_BITS, _NORMAL_BITS)
    second = _bits(thickness / _THICKEST_MM, 0, _THICKNESS_BITS) | _bits(confidence, _THICKNESS_BITS, _CONFIDENCE_BITS)
    return np.stack([first, second], axis=1).astype(np.uint32)


def _bits(share: np.ndarray, shift: int, bits: int) -> np.ndarray:
    """Whole numbers of some bits, shifted, of values from 0 to 1."""
    most = (1 << bits) - 1
    return np.rint(np.clip(share, 0.0, 1.0) * most).astype(np.int64) << shift


def _number(word: np.ndarray, shift: int, bits: int) -> np.ndarray:
    """The opposite of _bits."""
    most = (1 << bits) - 1
    return ((word >> shift) & most) / most


def _to_octahedron(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two coordinates, -1 to 1, of unit vectors (Cigolle et al., J. Computer Graphics Techniques 3(2), 2014)."""
    u, v, w = (normal / np.abs(normal).sum(axis=1, keepdims=True)).T
    below = w < 0
    turned_u, turned_v = (1 - np.abs(v)) * np.where(u >= 0, 1, -1), (1 - np.abs(u)) * np.where(v >= 0, 1, -1)
    return np.where(below, turned_u, u), np.where(below, turned_v, v)


def _from_octahedron(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(n, 3) unit vectors."""
    w = 1.0 - np.abs(u) - np.abs(v)
    fold = np.maximum(-w, 0.0)
    u, v = u - np.where(u >= 0, fold, -fold), v - np.where(v >= 0, fold, -fold)
    normal = np.stack([u, v, w], axis=1)
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


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
