"""Host side of kernels/smoothing.cl: indicators of acoustic groups, smoothed on the device."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from SlicerUSSim.Logic.opencl.device import Device, Workspace
from SlicerUSSim.Logic.opencl.layout import CONSTANTS

if TYPE_CHECKING:
    from pyopencl import Buffer

_SLAB = 48  # planes at a time, to limit the memory between the passes


def smoothed_indicators(device: Device, group_buffer: Buffer, dims, present: set[int], fields: int) -> Buffer:
    """Device buffer ushort [field][k][j][i]: indicators of the first `fields` groups, smoothed by a Gaussian.

    `group_buffer` has uint8 groups with flags, `dims` (i, j, k) voxels, `present` the groups that occur. Fields of
    groups that do not occur are 0, and all fields if there is only one group, which has no border. 65535 means 1.
    """
    columns, rows, planes = (int(n) for n in dims)
    voxels = columns * rows * planes
    smooth = device.zeros(-(-2 * fields * voxels // 4) * 4)
    if len(present) < 2:
        return smooth
    lanes = device.lanes if columns >= device.lanes else 1
    kernels = device.kernels("smoothing.cl", lanes)
    taps = gaussian_taps(CONSTANTS["WIDE_SIGMA"])
    reach, tap_buffer = np.int32(len(taps) // 2), device.upload(taps)
    workspace, slab = Workspace(device), min(_SLAB, planes)
    partial = [workspace.get(name, 4 * columns * rows * (slab + 2 * int(reach))) for name in ("rows", "columns")]
    across, shape = -(-columns // lanes), (np.int32(columns), np.int32(rows))
    *all_but_last, last = sorted(present)
    for group in all_but_last[:fields]:
        for first in range(0, planes, slab):
            count = min(slab, planes - first)
            around = count + 2 * int(reach)
            device.run(
                kernels["smooth_rows"], (across, rows, around), group_buffer, np.int32(group), tap_buffer, reach,
                *shape, np.int32(planes), np.int32(first - reach), partial[0],
            )  # fmt: skip
            device.run(
                kernels["smooth_columns"], (across, rows, around), partial[0], tap_buffer, reach, *shape, partial[1]
            )
            device.run(
                kernels["smooth_planes"], (across, rows, count), partial[1], tap_buffer, reach, *shape, np.int32(first),
                np.uint64(group * voxels), smooth,
            )  # fmt: skip
    if last < fields:
        device.run(kernels["smooth_rest"], (voxels,), smooth, np.int32(last), np.int32(fields))
    return smooth


def gaussian_taps(sigma: float) -> np.ndarray:
    """(2 reach + 1,) float32 Gaussian of unit sum, cut off at 2.5 standard deviations."""
    reach = int(2.5 * sigma + 0.5)
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return (taps / taps.sum()).astype(np.float32)
