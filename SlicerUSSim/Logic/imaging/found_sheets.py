"""Sheets that were found in the MRI (mri/sheets), as the kernels meet them: a plane beside every voxel near one.

A plane has two words (kernels/sheets.clh): that of sheets.cl, and its look: distance, thickness, level, reflection.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.imaging.sheet_voxels import SheetVoxels, on_voxels
from SlicerUSSim.Logic.opencl.layout import CONSTANTS
from SlicerUSSim.Logic.tissue.sheet_looks import SheetLook, looks_of, with_dura
from SlicerUSSim.Logic.tissue.surfels import KINDS, Surfels
from SlicerUSSim.Logic.tissue.table import TissueTable

#: Fluid around a sheet, along its normal, is a gap as narrow as a sheet up to here on either side; from here on it is
#: a cistern, whose walls are two lines. A sheet of labels may lie this far beside a sheet that was found.
_WIDE_MM, _STEP_MM, _BESIDE_MM = 2.0, 0.5, 1.0
#: Dura in the coupling medium has tissue on both sides within this, or hangs in it
_BETWEEN_MM = 8.0
#: Least distance from a sheet within which nothing else draws a line, mm
_OWN_MM = 1.0
#: Sheets farther than this from the plane of an image hardly change it: only rays that leave the plane meet them, mm
_BESIDE_IMAGE_MM = 20.0
#: Sheets farther than this from the labels are in another frame, mm
_FAR_MM = 100.0


@dataclass(frozen=True, eq=False)
class FoundSheets:
    """The planes of sheets on a label map, whose narrow gaps of fluid are closed."""

    #: (k, j, i) labels; where a sheet stands for a narrow gap of fluid, that of the tissue beside it
    labels: np.ndarray
    #: (n,) flat indices of voxels with a plane, and (n, 2) uint32, its two words
    voxels: np.ndarray
    words: np.ndarray
    #: (n,) bool: whether scatterers around the voxel may lie in the sheet
    is_near: np.ndarray
    #: (k, j, i) bool: gaps that were closed
    closed: np.ndarray

    @property
    def reflects(self) -> bool:
        """Whether any sheet has its own coherent echo."""
        return bool((self.words[:, 1] >> np.uint32(28)).any())


def found_sheets(
    surfels: Surfels, padded: np.ndarray, grid: Volume, fluids: tuple[int, ...], tissues: TissueTable
) -> FoundSheets:
    """Lay sheets over a label map. The caller ensures that they belong to this patient.

    Parameters
    ----------
    surfels : in RAS mm.
    padded : (k, j, i) uint8 labels with a margin of one voxel around `grid`.
    fluids : labels of which gaps consist, without the coupling medium.
    tissues : of the labels, with a membrane.

    Raises SimulationError for sheets that are in another frame.
    """
    grid, looks = _with_margin(grid), looks_of(tissues)
    _require_near(surfels, grid)
    surfels = surfels.chosen(~_hangs(surfels, padded, grid))
    extent = _fluid_beside(surfels, padded, grid, fluids)
    is_gap = np.isin(surfels.kind, [KINDS.index(kind) for kind in ("sulcus", "falx", "tentorium")])
    is_wide = is_gap & (extent >= _WIDE_MM - 1e-6).any(axis=1)
    # Walls of a cistern are drawn as such; a line in its middle belongs to a sheet only if it is dura.
    kept = ~(is_wide & (surfels.kind == KINDS.index("sulcus")))
    surfels, extent, closes = surfels.chosen(kept), extent[kept], (is_gap & ~is_wide)[kept]
    labels, closed = _closed(surfels.chosen(closes), extent[closes], padded, grid, fluids)
    half_diagonal = 0.5 * float(np.linalg.norm(grid.spacing_mm))
    most = max((look.most_thickness_mm for look in looks.values()), default=0.0)
    reach = max(_OWN_MM, 0.5 * most + half_diagonal)
    planes = on_voxels(surfels, grid, reach_mm=reach)
    words, half = _words(planes, grid, looks)
    words[:, 0] |= tissue_beside(labels, planes.voxels, fluids).astype(np.uint32) << np.uint32(26)
    return FoundSheets(labels, planes.voxels, words, np.abs(planes.distance) <= half + half_diagonal, closed)


def _hangs(surfels: Surfels, padded: np.ndarray, grid: Volume) -> np.ndarray:
    """(n,) bool: falx and tentorium in the coupling medium, without tissue on both sides.

    Above the hull of a brain without its head, or in the saline of an opening, nothing holds the dura.
    """
    labels = padded.ravel()
    found = np.isin(surfels.kind, [KINDS.index("falx"), KINDS.index("tentorium")])
    found &= labels[_along(surfels, grid, padded.shape)(0.0)] == 0
    some = np.flatnonzero(found)
    index = _along(surfels.chosen(some), grid, padded.shape)
    has_tissue = np.zeros((2, len(some)), bool)
    for side, sign in enumerate((-1.0, 1.0)):
        for step in np.arange(1.0, _BETWEEN_MM + 0.5):
            has_tissue[side] |= labels[index(sign * step)] != 0
    found[some] = ~has_tissue.all(axis=0)
    return found


def with_their_tissue(tissues: TissueTable, sheets: Surfels | None, known: TissueTable | None = None) -> TissueTable:
    """The table with the tissue of falx and tentorium where `sheets` has them, see sheet_looks.with_dura."""
    return tissues if sheets is None else with_dura(tissues, sheets.kinds(), known)


def beside_image(sheets: Surfels, probe_to_ras: np.ndarray) -> Surfels:
    """The sheets that one image shows, for a simulator of that image alone: within 20 mm of its plane.

    On an MNI152 head with all sheets 0.1 % of an image's pixels differ by more than a grey level from those with all.
    """
    away_mm = (sheets.place - probe_to_ras[:3, 3]) @ probe_to_ras[:3, 2]
    return sheets.chosen(np.abs(away_mm) <= _BESIDE_IMAGE_MM)


def _require_near(surfels: Surfels, grid: Volume) -> None:
    """Raise SimulationError if no sheet is within 100 mm of the volume."""
    if not len(surfels):
        return
    at = surfels.place @ grid.ras_to_ijk[:3, :3].T + grid.ras_to_ijk[:3, 3]
    apart = (np.clip(at, 0.0, np.array(grid.array.shape[::-1]) - 1.0) - at) @ grid.ijk_to_ras[:3, :3].T
    away_mm = float(np.linalg.norm(apart, axis=1).min())
    require(
        away_mm <= _FAR_MM,
        f"the sheets lie {away_mm:.0f} mm outside the labels, expected those that were found in this patient's MRI",
    )


def _with_margin(grid: Volume) -> Volume:
    matrix = grid.ijk_to_ras.copy()
    matrix[:3, 3] -= matrix[:3, :3].sum(axis=1)
    return Volume(np.broadcast_to(np.zeros(1, np.uint8), tuple(n + 2 for n in grid.array.shape)), matrix)


def _fluid_beside(surfels: Surfels, padded: np.ndarray, grid: Volume, fluids: tuple[int, ...]) -> np.ndarray:
    """(n, 2) mm along and against the normals, up to _WIDE_MM, to which fluid continues; -1 without fluid."""
    extent = np.full((len(surfels), 2), -1.0)
    steps = np.arange(0.0, _WIDE_MM + 1e-6, _STEP_MM)
    index = _along(surfels, grid, padded.shape)
    for side, sign in enumerate((1.0, -1.0)):
        goes_on = np.ones(len(surfels), bool)
        for step in steps:
            is_fluid = np.isin(padded.ravel()[index(sign * step)], fluids)
            extent[goes_on & is_fluid, side] = step
            # Labels may have the gap beside the sheet.
            goes_on &= is_fluid | ((step <= _BESIDE_MM) & (extent[:, side] < 0.0))
    return extent


def _along(
    surfels: Surfels, grid: Volume, shape: tuple[int, ...], rounded: Callable[[np.ndarray], np.ndarray] = np.rint
) -> Callable[[float], np.ndarray]:
    """A function of a distance, mm: (n,) flat indices of the voxels nearest to places so far along the normals."""
    matrix, strides = grid.ras_to_ijk, np.array([1.0, shape[2], shape[1] * shape[2]])
    at = surfels.place @ matrix[:3, :3].T + matrix[:3, 3]
    along, last = surfels.normal @ matrix[:3, :3].T, np.array(shape[::-1]) - 1.0
    return lambda mm: (np.clip(rounded(at + mm * along), 0.0, last) @ strides).astype(np.int64)


def _closed(
    surfels: Surfels, extent: np.ndarray, padded: np.ndarray, grid: Volume, fluids: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """((k, j, i) labels with the tissue beside in narrow gaps around these sheets, (k, j, i) True there)."""
    gap, index = np.zeros(padded.shape, bool), _along(surfels, grid, padded.shape, np.floor)
    for side, sign in enumerate((1.0, -1.0)):
        for step in np.arange(0.0, _WIDE_MM + 1e-6, _STEP_MM):
            gap.ravel()[index(sign * step)[extent[:, side] >= step - 1e-6]] = True
    for axis in range(3):  # all corners of these cells; what is clipped is in the margin, which is not fluid
        wide = np.moveaxis(gap, axis, 0)
        wide[1:] |= wide[:-1].copy()
    gap &= np.isin(padded, fluids)
    voxels = np.flatnonzero(gap)
    result = padded.copy()
    result.ravel()[voxels] = tissue_beside(padded, voxels, fluids)
    return result, gap


def tissue_beside(labels: np.ndarray, voxels: np.ndarray, fluids: tuple[int, ...]) -> np.ndarray:
    """(n,) uint8: the label of tissue, not of fluid or the coupling medium, nearest to voxels (flat indices).

    Their own where no tissue is within four voxels.
    """
    shape = labels.shape
    outside = (0, *fluids)
    flat, result = labels.ravel(), labels.ravel()[voxels].copy()
    open_ = np.flatnonzero(np.isin(result, outside))
    steps = sorted(
        (offset for offset in np.ndindex(9, 9, 9) if 0 < _square(offset) <= 16),
        key=lambda offset: (_square(offset), offset),
    )
    k, j, i = np.unravel_index(voxels, shape)
    for dk, dj, di in steps:
        if not len(open_):
            break
        at = [
            np.clip(index[open_] + step - 4, 0, size - 1)
            for index, step, size in zip((k, j, i), (dk, dj, di), shape, strict=True)
        ]
        found = flat[(at[0] * shape[1] + at[1]) * shape[2] + at[2]]
        is_tissue = ~np.isin(found, outside)
        result[open_[is_tissue]] = found[is_tissue]
        open_ = open_[~is_tissue]
    return result


def _square(offset: tuple[int, ...]) -> int:
    return sum((step - 4) ** 2 for step in offset)


def _words(planes: SheetVoxels, grid: Volume, looks: dict[str, SheetLook]) -> tuple[np.ndarray, np.ndarray]:
    """((n, 2) uint32 of kernels/sheets.clh, without the label beside; (n,) half the thickness as stored, mm)."""
    of_kind = [looks[name] for name in KINDS]
    least, most, level, is_wall, is_dura, reflection = (
        np.array([getattr(look, name) for look in of_kind])[planes.kind]
        for name in ("least_thickness_mm", "most_thickness_mm", "level_db", "is_wall", "is_dura", "reflection")
    )
    # From millimetres of distance along the normal to voxels along the gradient in voxels
    gradient = planes.normal.astype(float) @ grid.ijk_to_ras[:3, :3]
    size = np.linalg.norm(gradient, axis=1)
    octahedral = gradient / np.abs(gradient).sum(axis=1, keepdims=True)
    u, v = octahedral[:, 0], octahedral[:, 1]
    below = octahedral[:, 2] < 0.0
    turned_u, turned_v = np.copysign(1.0 - np.abs(v), u), np.copysign(1.0 - np.abs(u), v)
    u, v = np.where(below, turned_u, u), np.where(below, turned_v, v)
    steps = planes.distance / size / CONSTANTS["SHEET_DISTANCE_STEP"]
    first = _bits(256.0 + 255.0 * u, 0, 511) | _bits(256.0 + 255.0 * v, 9, 511) | _bits(128.0 + steps, 18, 255)
    first = np.where(first >> 18 & 255, first, first | 1 << 18)  # 0 stands for no plane
    half = 0.5 * np.clip(planes.thickness, least, most)
    halves = np.clip(np.rint(half / CONSTANTS["SHEET_HALF_STEP"]), 1, 255)
    with np.errstate(divide="ignore"):
        amplitude = level + 20.0 * np.log10(planes.confidence)
    second = _bits(1024.0 + steps, 0, 2047) | _bits(halves, 11, 255)
    second |= _bits(96.0 + amplitude / CONSTANTS["SHEET_LEVEL_STEP_DB"], 19, 127)
    second |= is_wall.astype(np.int64) << 26 | is_dura.astype(np.int64) << 27
    # A wall of a ventricle is a border, too, which has the coherent echo.
    second |= _bits(np.abs(reflection) * planes.confidence / CONSTANTS["SHEET_REFLECTION_STEP"], 28, 15)
    return np.stack([first, second], axis=1).astype(np.uint32), halves * CONSTANTS["SHEET_HALF_STEP"]


def _bits(value: np.ndarray, shift: int, most: int) -> np.ndarray:
    return np.rint(np.clip(value, 0.0, most)).astype(np.int64) << shift


def cells_around(voxels: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """(8 n,) flat indices of the cells that have these voxels (flat indices, none at the first faces) as corners."""
    return np.concatenate([voxels - (k * shape[1] + j) * shape[2] - i for k, j, i in np.ndindex(2, 2, 2)])
