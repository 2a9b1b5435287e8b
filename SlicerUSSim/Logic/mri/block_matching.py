"""Whether the parts of two registered brains lie in the same places, by block matching: one patient, or two."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.coarse import resampled_to_ras

_SPACING_MM = 2.0
#: Edge of a block, largest shift along an axis (voxels), and share of the block that has to be in the brain
_BLOCK, _REACH, _INSIDE = 8, 3, 0.7
#: Classes of intensity in the first image; blocks that are looked at, at most
_CLASSES, _MOST_BLOCKS = 6, 120
#: What the best place explains more than the middle one, so that a block has a place, and the least blocks with one
_LEAST_PEAK, _LEAST_BLOCKS = 0.1, 10
_NEAR_MM = 3.5


def share_in_place(first: Volume, second: Volume, inside: np.ndarray) -> float | None:
    """Share of the blocks (16 mm) of a brain that fit the second image best within 3.5 mm of their own place.

    Two brains that are registered as wholes have the same outline, and other sulci in it. How well a block fits is the
    correlation ratio (Roche et al., MICCAI 1998), which holds for any relation between two contrasts; places up to 6 mm
    away along each axis are tried. `second` is on the grid of `first`, `inside` (k, j, i) is the brain there. None
    where fewer than ten blocks can tell.
    """
    volumes = (first, second, first.with_array(inside.astype(np.float32)))
    one, other, mask = (np.pad(resampled_to_ras(volume, _SPACING_MM)[0], _REACH) for volume in volumes)
    ranges = [range(_REACH, size - _REACH - _BLOCK, _BLOCK) for size in one.shape]
    corners = [(k, j, i) for k in ranges[0] for j in ranges[1] for i in ranges[2]]
    corners = [at for at in corners if (mask[_block(at)] > 0.5).mean() >= _INSIDE]
    step = max(1, -(-len(corners) // _MOST_BLOCKS))
    found = [shift for at in corners[::step] if (shift := _shift_mm(one, other, at)) is not None]
    if len(found) < _LEAST_BLOCKS:
        return None
    return float(np.mean(np.array(found) <= _NEAR_MM))


def _block(at: tuple[int, int, int], more: int = 0) -> tuple[slice, ...]:
    return tuple(slice(n - more, n + _BLOCK + more) for n in at)


def _shift_mm(one: np.ndarray, other: np.ndarray, at: tuple[int, int, int]) -> float | None:
    """Distance from a block of the first image to where it fits the second best; None for one that fits anywhere."""
    values = one[_block(at)].ravel()
    borders = np.quantile(values, np.arange(1, _CLASSES) / _CLASSES)
    of_class = (np.searchsorted(borders, values) == np.arange(_CLASSES)[:, None]).astype(np.float32)
    places = sliding_window_view(other[_block(at, _REACH)], (_BLOCK,) * 3).reshape(-1, values.size).T
    places = places - places.mean(axis=0)
    # Correlation ratio: variance of the means of the classes, relative to the whole
    counts = np.maximum(of_class.sum(axis=1), 1.0)[:, None]
    ratio = ((of_class @ places) ** 2 / counts).sum(axis=0) / np.maximum((places * places).sum(axis=0), 1e-9)
    best = int(ratio.argmax())
    if ratio[best] - np.median(ratio) < _LEAST_PEAK:
        return None
    shift = np.array(np.unravel_index(best, (2 * _REACH + 1,) * 3)) - _REACH
    return float(_SPACING_MM * np.linalg.norm(shift))
