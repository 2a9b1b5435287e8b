"""Host side of kernels/smoothing.cl: indicators of acoustic groups, smoothed on the device."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from SlicerUSSim.Logic.opencl.device import Device, Workspace, divisible
from SlicerUSSim.Logic.opencl.layout import CONSTANTS

if TYPE_CHECKING:
    from pyopencl import Buffer

#: Standard deviations at which the Gaussians are cut off; layers are found by the tails of the second
WIDE_CUT, HALVED_CUT = 2.5, 3.5
_SLAB = 48  # planes at a time, to limit the memory between the passes
_ROWS, _VOXELS = 8, 16  # in a group with PoCL


def smoothed_indicators(
    device: Device,
    group_buffer: Buffer,
    dims,
    present: set[int],
    fields: int,
    membership: tuple[np.ndarray, np.ndarray] | None = None,
) -> Buffer:
    """Device buffer ushort: indicators of the first `fields` groups, smoothed by Gaussians, at two resolutions.

    First [field][k][j][i] with WIDE_SIGMA voxels, then the same at half the resolution, rounded up, smoothed once more
    with HALVED_SIGMA voxels of that grid. `group_buffer` has uint8 groups, with or without flags, `dims` (i, j, k)
    voxels, `present` the groups that occur. Fields of other groups are 0, and all fields if there is only one group,
    which has no border. 65535 means 1. `membership` are the second group of every voxel and its share in 1/255,
    (k, j, i) uint8 each: borders then lie at the half-level of the shares and not at the faces of voxels.
    """
    dims = np.asarray(dims)
    voxels, halved = int(dims.prod()), int(((dims + 1) // 2).prod())
    # All of it is written below where every group has a field.
    new = device.empty if set(range(fields)) <= present and len(present) > 1 else device.zeros
    smooth = new(-(-2 * fields * (voxels + halved) // 4) * 4)
    if len(present) < 2:
        return smooth
    *all_but_last, last = sorted(present)
    workspace, wide = Workspace(device), [gaussian_taps(CONSTANTS["WIDE_SIGMA"], WIDE_CUT)] * 3
    # Rows are read a vector at a time, including the last one.
    others = [] if membership is None else [device.upload(np.pad(part.ravel(), (0, 16))) for part in membership]
    for group in all_but_last[:fields]:
        _smooth(device, workspace, [group_buffer, *others], dims, group, wide, smooth, group * voxels)
        _smooth_halved(device, workspace, dims, group * voxels, fields * voxels + group * halved, smooth)
    if last < fields:
        rest = device.kernels("smoothing.cl")["smooth_rest"]
        for count, offset in ((voxels, 0), (halved, fields * voxels)):
            sizes = np.uint64(offset), np.uint64(count), np.int32(last), np.int32(fields)
            device.run(rest, (divisible(count),), smooth, *sizes)
    return smooth


def smoothed_members(device: Device, is_member: np.ndarray, sigmas: Iterable[float], cut: float) -> np.ndarray:
    """(k, j, i) uint16, 65535 for 1: bool `is_member` (k, j, i), smoothed by a Gaussian of `sigmas` (i, j, k) voxels.

    It is cut off at `cut` standard deviations. Beyond the volume its outermost voxels are repeated.
    """
    taps = [gaussian_taps(sigma, cut) for sigma in sigmas]
    smooth = device.empty(-(-2 * is_member.size // 4) * 4)
    members = device.upload(np.pad(is_member.view(np.uint8).ravel(), (0, 16)))
    _smooth(device, Workspace(device), [members], is_member.shape[::-1], 1, taps, smooth, 0)
    return device.download(smooth, is_member.size, np.uint16).reshape(is_member.shape)


def _smooth(
    device: Device,
    workspace: Workspace,
    groups: Sequence[Buffer],
    dims,
    group: int,
    taps: Sequence[np.ndarray],
    smooth: Buffer,
    offset: int,
) -> None:
    """The indicator of one group, from the groups of voxels, and their second groups and shares if they have any.

    `taps` are those along i, j and k. The result begins at `offset`, in values, of `smooth`.
    """
    columns, rows, planes = (int(n) for n in dims)
    lanes = device.lanes if columns >= device.lanes else 1
    kernels = device.kernels("smoothing.cl", lanes, *(["MEMBERSHIP"] if len(groups) > 1 else []))
    along_i, along_j, along_k = ((device.upload(axis), np.int32(len(axis) // 2)) for axis in taps)
    reach = int(along_k[1])
    slab = min(_SLAB, planes)
    partial = [workspace.get(name, 4 * columns * rows * (slab + 2 * reach)) for name in ("rows", "columns")]
    plane, shape = (-(-columns // lanes), divisible(rows, _ROWS)), (np.int32(columns), np.int32(rows))
    group_size = 1, _ROWS, 1
    for first in range(0, planes, slab):
        count = min(slab, planes - first)
        around = count + 2 * reach
        device.run(
            kernels["smooth_rows"], (*plane, around), *groups, np.int32(group), *along_i, *shape,
            np.int32(planes), np.int32(first - reach), partial[0], group=group_size,
        )  # fmt: skip
        device.run(
            kernels["smooth_columns"], (*plane, around), partial[0], *along_j, *shape, partial[1], group=group_size
        )
        device.run(
            kernels["smooth_planes"], (*plane, count), partial[1], *along_k, *shape, np.int32(first),
            np.uint64(offset), smooth, group=group_size,
        )  # fmt: skip


def _smooth_halved(device: Device, workspace: Workspace, dims, offset: int, to_offset: int, smooth: Buffer) -> None:
    """One indicator at half the resolution, from that at full resolution; both at offsets, in values, of `smooth`."""
    columns, rows, planes = (-(-int(n) // 2) for n in dims)
    lanes = device.lanes if columns >= device.lanes else 1
    scalar, kernels = device.kernels("smoothing.cl"), device.kernels("smoothing.cl", lanes)
    taps = gaussian_taps(CONSTANTS["HALVED_SIGMA"], HALVED_CUT)
    reach, tap_buffer = np.int32(len(taps) // 2), device.upload(taps)
    around, shape = planes + 2 * int(reach), (np.int32(columns), np.int32(rows))
    partial = [workspace.get(name, 4 * columns * rows * around) for name in ("halved", "halved rows")]
    device.run(
        scalar["halve"], (divisible(columns, _VOXELS), rows, around), smooth, np.uint64(offset),
        *(np.int32(n) for n in dims), -reach, partial[0], group=(_VOXELS, 1, 1),
    )  # fmt: skip
    plane, group = (-(-columns // lanes), divisible(rows, _ROWS)), (1, _ROWS, 1)
    size = *plane, around
    device.run(kernels["smooth_halved_rows"], size, partial[0], tap_buffer, reach, *shape, partial[1], group=group)
    device.run(kernels["smooth_columns"], size, partial[1], tap_buffer, reach, *shape, partial[0], group=group)
    device.run(
        kernels["smooth_planes"], (*plane, planes), partial[0], tap_buffer, reach, *shape, np.int32(0),
        np.uint64(to_offset), smooth, group=group,
    )  # fmt: skip


def gaussian_taps(sigma: float, cut: float) -> np.ndarray:
    """(2 reach + 1,) float32 Gaussian of unit sum, cut off at `cut` standard deviations."""
    reach = int(cut * sigma + 0.5)
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return (taps / taps.sum()).astype(np.float32)
