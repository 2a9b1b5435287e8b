"""Voxels as the occupied bins of a histogram over intensity and spatial prior, so that EM takes a moment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from SlicerUSSim.Logic.mri.mixture import Points

#: Bins per channel for 1, 2, 3 and more channels
_BINS = (256, 96, 40, 20)
#: Shares of the spatial prior are rounded to multiples of 1 / _LEVELS, which leaves (7 x 8) / 2 = 28 cells
_LEVELS = 6
#: Percentage of voxels beyond the box at either end
_BEYOND = 0.02
#: Largest weight of dark and bright outliers
_OUTLIERS = {"t1": (0.01, 0.03), "t1gd": (0.01, 0.1), "t2": (0.2, 0.01), "flair": (0.02, 0.1)}
_OUTLIERS_OF_SEVERAL = 0.2


@dataclass(frozen=True, eq=False)
class Histogram:
    """The bins of a set of voxels."""

    points: Points
    #: (voxels,) point of every voxel
    point_of_voxel: np.ndarray

    @classmethod
    def of(
        cls,
        values: np.ndarray,
        contrasts: tuple[str, ...],
        prior: np.ndarray | None = None,
        bins: int | None = None,
        voxel_mm: float = 1.0,
    ) -> Histogram:
        """From (channels, voxels) intensities and, where there is one, the (3, voxels) prior share of every tissue."""
        channels, voxels = values.shape
        bins = bins or _BINS[min(channels, len(_BINS)) - 1]
        code = np.zeros(voxels, np.int64)
        lows, steps = np.empty(channels), np.empty(channels)
        for n, channel in enumerate(values):
            low, high = np.percentile(channel, (_BEYOND, 100.0 - _BEYOND))
            lows[n], steps[n] = low, max(high - low, 1e-6 * max(abs(high), 1.0)) / (bins - 1)
            index = np.rint((channel - low) * np.float32(1.0 / steps[n]))
            code = code * bins + np.clip(index, 0, bins - 1).astype(np.int64)
        codes = bins**channels
        shares = np.full((1, 3), 1.0 / 3.0)
        if prior is not None:
            cells, shares = _cells(prior)
            code += codes * cells
        counts = np.bincount(code, minlength=codes * len(shares))
        occupied = np.flatnonzero(counts)
        place = np.empty(counts.size, np.int32)
        place[occupied] = np.arange(len(occupied))
        cell, rest = np.divmod(occupied, codes)
        index = np.stack(np.unravel_index(rest, (bins,) * channels), axis=1)
        levels = lows + steps * index
        outliers, limits = _outliers(levels, steps * bins, contrasts)
        points = Points(levels, counts[occupied].astype(float), shares[cell], steps, outliers, limits, voxel_mm)
        return cls(points, place[code])


def _outliers(levels: np.ndarray, size: np.ndarray, contrasts: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """((outlier classes, points) densities, (outlier classes,) limits of their weights).

    Several channels: one class, uniform. One channel: one below and one above the middle of the range, since what may
    be an outlier depends on the side: CSF is the darkest tissue in T1, but bone and flowing blood are darker in T2.
    """
    if len(contrasts) != 1:
        return np.full((1, len(levels)), 1.0 / np.prod(size)), np.array([_OUTLIERS_OF_SEVERAL])
    low = levels.min()
    middle = low + 0.5 * float(size.sum())
    is_bright = levels.sum(axis=1) > middle
    density = np.stack([~is_bright, is_bright]) * (2.0 / float(size.sum()))
    return density, np.array(_OUTLIERS[contrasts[0]])


def _cells(prior: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """((voxels,) cell, (cells, 3) mean share of the tissues in the cell)."""
    first, second = (np.rint(_LEVELS * share).astype(np.int64) for share in prior[:2])
    second = np.minimum(second, _LEVELS - np.minimum(first, _LEVELS))
    code = first * (_LEVELS + 1) + second
    counts = np.bincount(code, minlength=(_LEVELS + 1) ** 2)
    sums = np.stack([np.bincount(code, weights=share, minlength=len(counts)) for share in prior], axis=1)
    occupied = np.flatnonzero(counts)
    place = np.zeros(len(counts), np.int64)
    place[occupied] = np.arange(len(occupied))
    means = sums[occupied] / counts[occupied, None]
    return place[code], means / means.sum(axis=1, keepdims=True)
