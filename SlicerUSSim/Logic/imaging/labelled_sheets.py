"""Host side of kernels/sheets.cl: thin sheets of the membrane's own tissue, as planes fitted to their voxels."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from SlicerUSSim.Logic.opencl.device import Device, divisible
from SlicerUSSim.Logic.opencl.layout import CONSTANTS

if TYPE_CHECKING:
    from pyopencl import Buffer

_CORE_SIGMA, _CORE_REACH = 0.75, 2  # of the window by which layers are thick, voxels


def sheet_planes(device: Device, padded: np.ndarray, sheet: int, spacing_mm: np.ndarray) -> tuple[Buffer, np.ndarray]:
    """Fit a plane to the voxels of thin sheets around each of them.

    Parameters
    ----------
    padded : (k, j, i) uint8 labels.
    sheet : the label of sheets; -1 for none.
    spacing_mm : (3,) of i, j, k.

    Returns the device buffer [k][j][i] uint of kernels/sheets.cl, of one element if there are no sheets, and the flat
    indices of the voxels of thin sheets.
    """
    is_sheet = padded == sheet
    points = np.flatnonzero(is_sheet).astype(np.int32)
    if not len(points):
        return device.zeros(4), points
    kernels = device.kernels("sheets.cl")
    cores, planes = device.zeros(-(-padded.size // 4) * 4), device.zeros(4 * padded.size)
    is_thin = device.empty(len(points))
    bits = device.upload(np.pad(np.packbits(is_sheet.ravel(), bitorder="little"), (1, 2)))
    dims = [np.int32(n) for n in padded.shape[::-1]]
    rows, taps = (device.upload(table) for table in window_tables())
    point_buffer, labels = device.upload(points), device.upload(padded)
    side = (spacing_mm / np.cbrt(np.prod(spacing_mm))).astype(np.float32)
    size, listed = (divisible(len(points)),), (point_buffer, np.int32(len(points)))
    device.run(kernels["find_cores"], size, bits, *dims, rows, taps, *listed, cores)
    device.run(
        kernels["fit_sheets"], size, bits, *dims, np.int32(sheet), *side, rows, taps, labels, *listed, cores, is_thin,
        planes,
    )  # fmt: skip
    device.run(kernels["spread_sheets"], size, labels, *dims, np.int32(sheet), *listed, planes)
    return planes, points[device.download(is_thin, len(points), np.uint8) > 0]


@lru_cache(maxsize=1)
def window_tables() -> tuple[np.ndarray, np.ndarray]:
    """((512, 8), (2 SHEET_REACH + 2,)) float32: `rows` and `taps` of kernels/sheets.cl.

    The narrow weights are the fourth power of the wide ones.
    """
    reach = CONSTANTS["SHEET_REACH"]
    x = np.arange(-reach, reach + 1)
    wide = np.exp(-0.5 * (x / CONSTANTS["SHEET_SIGMA"]) ** 2)
    core = np.where(abs(x) <= _CORE_REACH, np.exp(-0.5 * (x / _CORE_SIGMA) ** 2), 0.0)
    core /= core.sum()
    of_voxel = np.stack([wide, wide * x, wide * x**2, wide**4, wide**4 * x, core, 0.0 * x, wide])
    is_set = np.arange(512)[:, None] >> np.arange(9) & 1
    return (is_set @ of_voxel.T).astype(np.float32), np.concatenate([wide[reach:], core[reach:]]).astype(np.float32)
