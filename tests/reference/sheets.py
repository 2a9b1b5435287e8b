"""Planes fitted to the voxels of thin sheets (kernels/sheets.cl, docs/physics.md#5-scatterers)."""

from __future__ import annotations

import itertools

import numpy as np
from scipy import ndimage

_SIGMA, _REACH = 2.0, 4  # of the window, voxels; that of distances is half as wide
_CORE_SIGMA, _CORE_REACH, _THICK = 0.75, 2, 0.9
_LEAST_AREA = 2.5
_STEP = 1.0 / 64.0  # of stored distances, voxels
_AROUND = np.array([(x, 0, 0) for x in (-1, 1)] + [(0, y, 0) for y in (-1, 1)] + [(0, 0, z) for z in (-1, 1)])


class Sheets:
    """Thin sheets of one label.

    Parameters
    ----------
    labels : (k, j, i) with a margin of another label.
    sheet : the label.
    spacing_mm : (3,) of i, j, k.
    """

    def __init__(self, labels: np.ndarray, sheet: int, spacing_mm: np.ndarray) -> None:
        self.label = sheet
        member = (labels == sheet).astype(float)
        inside = _windowed(member, _CORE_SIGMA, _CORE_REACH, np.zeros((1, 3), int))[..., 0]
        is_thick: np.ndarray = ndimage.maximum_filter(inside * member >= _THICK, size=3)
        #: (k, j, i) True in thin sheets
        self.is_thin = (member > 0) & ~is_thick
        #: (k, j, i, 3) gradients in voxels, of length 1, 0 where there is no plane; (k, j, i) distances in voxels; and
        #: labels of the tissue beside
        self.gradient = np.zeros((*labels.shape, 3), np.float32)
        self.distance = np.zeros(labels.shape, np.float32)
        self.beside = np.zeros(labels.shape, np.uint8)
        self._fit(labels, member, spacing_mm / np.cbrt(np.prod(spacing_mm)))
        self._spread(member > 0)

    def _fit(self, labels: np.ndarray, member: np.ndarray, side: np.ndarray) -> None:
        powers = np.array([p for p in itertools.product(range(3), repeat=3) if sum(p) <= 2])
        wide, near = (_windowed(member, sigma, _REACH, powers)[self.is_thin].T for sigma in (_SIGMA, _SIGMA / 2.0))

        def moment(of: np.ndarray, *axes: int) -> np.ndarray:
            wanted = np.bincount(axes, minlength=3)
            return of[np.flatnonzero((powers == wanted).all(axis=1))[0]] / of[0]

        mean = [moment(wide, axis) for axis in range(3)]
        covariance = np.stack([
            np.stack([(moment(wide, a, b) - mean[a] * mean[b]) * side[a] * side[b] for b in range(3)], axis=-1)
            for a in range(3)
        ], axis=-1)  # fmt: skip
        variances, vectors = np.linalg.eigh(covariance)
        low, middle, high = (variances + 1e-4).T
        is_sheet = low * middle + middle * high + high * low >= _LEAST_AREA
        gradient = vectors[..., 0] * side
        gradient /= np.linalg.norm(gradient, axis=-1, keepdims=True)
        distance = sum(gradient[:, axis] * moment(near, axis) for axis in range(3))
        at = tuple(index[is_sheet] for index in np.nonzero(self.is_thin))
        self.gradient[at], self.distance[at] = _packed(gradient)[is_sheet], _in_steps(distance)[is_sheet]
        for k, j, i in zip(*at, strict=True):
            around = labels[k - 1 : k + 2, j - 1 : j + 2, i - 1 : i + 2].ravel()
            others = around[around != self.label]
            counts = np.bincount(others, minlength=1)
            # Of equally frequent ones the first
            self.beside[k, j, i] = others[counts[others].argmax()] if others.size else self.label

    def _spread(self, member: np.ndarray) -> None:
        """Voxels beside a sheet get the nearest plane of the six around them."""
        has_plane = np.abs(self.gradient).sum(axis=-1) > 0.0
        for k, j, i in np.argwhere(ndimage.binary_dilation(member) & ~member)[:, ::1]:
            if min(k, j, i) < 1 or any(n >= size - 1 for n, size in zip((k, j, i), member.shape, strict=True)):
                continue
            best = 2.0
            for step in _AROUND:
                there = tuple(np.array([k, j, i]) + step[::-1])
                if not (member[there] and has_plane[there]):
                    continue
                distance = self.distance[there] + self.gradient[there] @ step
                if abs(distance) < best:
                    best = abs(distance)
                    self.gradient[k, j, i], self.beside[k, j, i] = self.gradient[there], self.beside[there]
                    self.distance[k, j, i] = _in_steps(distance)


def _windowed(member: np.ndarray, sigma: float, reach: int, powers: np.ndarray) -> np.ndarray:
    """(k, j, i, powers) sums of offsets (x, y, z) to these powers, in a Gaussian window about every voxel."""
    offset = np.arange(-reach, reach + 1)
    taps = np.exp(-0.5 * (offset / sigma) ** 2)
    taps /= taps.sum()
    sums = []
    for power in powers:
        result = member
        for axis, exponent in zip((2, 1, 0), power, strict=True):
            result = ndimage.correlate1d(result, taps * offset.astype(float) ** exponent, axis, mode="constant")
        sums.append(result)
    return np.stack(sums, axis=-1)


def _packed(gradient: np.ndarray) -> np.ndarray:
    """(n, 3) of length 1 as it comes back from two octahedral coordinates of 9 bits."""
    octahedral = gradient / np.abs(gradient).sum(axis=1, keepdims=True)
    plane = np.where(
        octahedral[:, 2:] < 0.0,
        np.copysign(1.0 - np.abs(octahedral[:, 1::-1]), octahedral[:, :2]), octahedral[:, :2],
    )  # fmt: skip
    u, v = (np.rint(255.0 * plane) / 255.0).T
    z = 1.0 - abs(u) - abs(v)
    folded = np.maximum(-z, 0.0)
    result = np.stack([u - np.copysign(folded, u), v - np.copysign(folded, v), z], axis=-1)
    return result / np.linalg.norm(result, axis=1, keepdims=True)


def _in_steps(distance) -> np.ndarray:
    return np.clip(np.rint(distance / _STEP), -127, 127) * _STEP
