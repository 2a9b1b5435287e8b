"""Noise of an image, and the guided filter on the device, which reduces it and preserves edges."""

from __future__ import annotations

from typing import cast

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.opencl.device import Device, DeviceChoice

#: Standard deviation in voxels of the Gaussian before the guided filter, which makes a calmer guide, and the filter's
#: strength per noise that the Gaussian leaves; chosen on MNI152 phantoms at 3 and 7 % noise
_GAUSSIAN, _EPSILON_PER_NOISE = 0.4, 1.5


def denoised(
    image: np.ndarray, mask: np.ndarray, radius: int, epsilon: float | None, device: DeviceChoice = None
) -> tuple[np.ndarray, float, float]:
    """((k, j, i) float32 image for classification, its noise before, epsilon): a light Gaussian, then guided_filter.

    With the epsilon None it follows from the noise. A radius of 0 returns the image.
    """
    noise = estimate_noise(image, mask)
    if radius == 0:
        return guided_filter(image, mask, 0, 0.0), noise, noise**2 if epsilon is None else epsilon
    weight, smooth = (
        ndimage.gaussian_filter(array, _GAUSSIAN, truncate=2.0)
        for array in (mask.astype(np.float32), np.where(mask, image, 0).astype(np.float32))
    )
    smooth = np.where(mask, smooth / np.maximum(weight, 1e-6), 0.0).astype(np.float32)
    if epsilon is None:
        epsilon = (_EPSILON_PER_NOISE * estimate_noise(smooth, mask)) ** 2
    return guided_filter(smooth, mask, radius, epsilon, device), noise, epsilon


def guided_filter(
    image: np.ndarray, mask: np.ndarray, radius: int, epsilon: float, device: DeviceChoice = None
) -> np.ndarray:
    """(k, j, i) float32 self-guided filter of `image` inside the boolean `mask` (He et al., ECCV 2010).

    `radius` of the box window in voxels, `epsilon` the variance below which a window counts as homogeneous. The
    models of overlapping windows are weighted by the inverse of their variance, not equally.
    Outside the mask the result is 0. A radius of 0 returns the image.
    """
    if radius == 0:
        return np.where(mask, image, 0).astype(np.float32)
    device = Device.get(device)
    lanes = device.lanes
    kernels = device.kernels("segmentation.cl", lanes)
    depth, height, width = image.shape
    row = -(-width // lanes) * lanes
    shape = (depth, height, row)

    def padded(array: np.ndarray) -> np.ndarray:
        result = np.zeros(shape, np.float32)
        result[..., :width] = array
        return result

    # Intensities are taken relative to the mean, so that sums of squares are accurate enough in float32.
    centre = float(image[mask].mean())
    values = device.upload(padded(np.where(mask, image - centre, 0)))
    inside_mask = device.upload(padded(mask))
    nbytes = 4 * int(np.prod(shape))
    count, first, second, spare, spare2 = (device.empty(nbytes) for _ in range(5))
    whole = (int(np.prod(shape)) // lanes,)

    def across(source, target, count_: int, stride: int, others: int, other_stride: int) -> None:
        numbers = (np.int32(value) for value in (count_, stride, other_stride, radius))
        device.run(kernels["box_sum_across"], (row // lanes, others), source, target, *numbers)

    def summed(source, into) -> None:
        """Box sums of `source` into `into`, which may be the same buffer."""
        device.run(kernels["box_sum_along"], (depth * height,), source, spare, np.int32(row), np.int32(radius))
        across(spare, spare2, height, row, depth, height * row)
        across(spare2, into, depth, height * row, height, row)

    summed(inside_mask, count)
    summed(values, first)
    device.run(kernels["squares"], whole, values, second)
    summed(second, second)
    least_variance = max(1e-4 * float(image[mask].var()), 1e-20)
    device.run(
        kernels["linear_model"],
        whole,
        count,
        inside_mask,
        first,
        second,
        np.float32(epsilon),
        np.float32(least_variance),
    )
    summed(count, count)
    summed(first, first)
    summed(second, second)
    device.run(kernels["apply_model"], whole, count, first, second, values, spare)
    filtered = device.download(spare, shape, np.float32)[..., :width]
    return np.where(mask, filtered + centre, 0).astype(np.float32)


def estimate_noise(image: np.ndarray, mask: np.ndarray) -> float:
    """Standard deviation of the noise inside the mask, in the unit of the image.

    From the difference of every voxel to its six neighbours (Coupe et al., Medical Image Analysis 14(4) 2010), by the
    median absolute deviation, which is robust against borders. Every other slice is used.
    """
    inner = cast(np.ndarray, ndimage.binary_erosion(mask[::2], np.ones((1, 3, 3))))
    if inner.sum() < 1000:
        return 0.0
    image = image.astype(np.float32, copy=False)
    around = sum(np.roll(image, shift, axis)[::2] for axis in (0, 1, 2) for shift in (-1, 1))
    residual = np.sqrt(6.0 / 7.0) * (image[::2] - around / 6.0)[inner]
    return float(1.4826 * np.median(np.abs(residual - np.median(residual))))
