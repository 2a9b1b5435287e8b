"""Masks of lesions on any grid: what a file holds, and resampling to the grid of a label map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.volume import Volume

#: Tissues of BraTS maps, from outside to inside: 1 is the necrotic core with tumour that does not enhance. Enhancing
#: tumour is 4 until 2022 and 3 since, when 4 is a resection cavity (Menze et al., IEEE TMI 34(10), 2015; BraTS 2023).
_BRATS_2022 = {"oedema": 2, "necrosis": 1, "enhancing": 4}
_BRATS = {"oedema": 2, "necrosis": 1, "enhancing": 3, "cavity": 4}
#: More different whole numbers are an image and not a label map.
_MOST_LABELS = 32
#: Smallest and largest share at which a voxel becomes inside.
_CUTS = (0.3, 0.7)
#: Most samples along an edge of a voxel of the labels.
_MOST_SAMPLES = 4


@dataclass(frozen=True, eq=False)
class Masks:
    """Where one or several tissues are, which do not overlap."""

    #: For messages: the name of their file or node
    source: str
    tissues: tuple[str, ...]
    #: (tissues, k, j, i) float32: 0 to 1, the share of each voxel, or the probability
    shares: np.ndarray
    #: Their grid; its array is the sum of the shares
    union: Volume
    warnings: tuple[str, ...] = ()

    @property
    def inside(self) -> np.ndarray:
        """(k, j, i) bool: in any of the tissues."""
        return self.union.array > 0.5

    @property
    def volume_ml(self) -> float:
        """Of all tissues, on their own grid."""
        return float(self.inside.sum() * self.union.voxel_ml)


def read_masks(volume: Volume, tissue: str, source: str) -> Masks:
    """What a volume holds: `tissue`, or with "brats" the tissues of a BraTS map.

    Raises SimulationError for an empty mask, and for an image that is neither a mask, nor a label map, nor
    probabilities.
    """
    array = volume.array
    bad = int(array.size - np.isfinite(array).sum())
    require(bad == 0, f"{source}: has {bad} voxels that are not finite numbers, expected none")
    values = _whole_numbers(array)
    low, high = float(array.min()), float(array.max())
    if values is None:
        require(
            tissue != "brats" and low >= 0.0 and high <= 1.0,
            f"{source}: holds numbers from {low:g} to {high:g}, expected a mask (0 and not 0), a label map"
            + ("" if tissue == "brats" else ", or probabilities from 0 to 1"),
        )
        require(high > 0.5, f"{source}: no probability is above 0.5 (the largest is {high:g}); nothing would be added")
        return _masks(volume, {tissue: array}, source)
    require(
        low >= 0 and len(values) <= _MOST_LABELS,
        f"{source}: holds {_listed(values)}, as an image does, expected a mask: 0 outside and another number inside",
    )
    require(high > 0, f"{source}: is empty, expected voxels that are not 0")
    if tissue == "brats":
        return _brats(volume, values, source)
    warnings = ()
    if len(values) > 2:
        warnings = (
            f"{source} holds the labels {_listed(values[values > 0])}; all of them are added as {tissue}"
            + (" (brats=FILE adds the tissues of a BraTS map)" if set(values.tolist()) <= {0, 1, 2, 3, 4} else ""),
        )
    return _masks(volume, {tissue: array != 0}, source, warnings)


def _masks(volume: Volume, shares: dict[str, np.ndarray], source: str, warnings: tuple[str, ...] = ()) -> Masks:
    stacked = np.stack([share.astype(np.float32) for share in shares.values()])
    return Masks(source, tuple(shares), stacked, volume.with_array(stacked.sum(axis=0)), warnings)


def _brats(volume: Volume, values: np.ndarray, source: str) -> Masks:
    there = set(values.tolist())
    require(
        there <= {0, 1, 2, 3, 4},
        f"{source}: holds the labels {_listed(values[values > 0])}, expected those of BraTS: 1 necrosis, 2 oedema, 3 "
        "enhancing and 4 cavity, or without 3: 4 enhancing",
    )
    is_old = 4 in there and 3 not in there
    tissues = _BRATS_2022 if is_old else _BRATS
    warnings = (f"{source}: label 4 is read as enhancing, as until 2022, and not as a cavity, without a label 3",)
    masks = {name: volume.array == label for name, label in tissues.items() if label in there}
    return _masks(volume, masks, source, warnings if is_old else ())


def _whole_numbers(array: np.ndarray) -> np.ndarray | None:
    """The different values, if all are whole numbers, also when they are stored as float."""
    if array.dtype == bool or np.issubdtype(array.dtype, np.integer):
        return np.unique(array).astype(int)
    if not np.array_equal(array, np.rint(array)) or np.abs(array).max() > 2**31:
        return None
    return np.unique(array).astype(int)


def _listed(values: np.ndarray) -> str:
    if len(values) > 8:
        return f"{len(values)} whole numbers from {values[0]} to {values[-1]}"
    return ", ".join(map(str, values))


def resampled(masks: Masks, like: Volume) -> tuple[tuple[slice, ...], np.ndarray, float]:
    """(part of the grid of `like`; (k, j, i) number of the tissue there, from 1, or 0; share of the masks outside).

    Masks are interpolated linearly and cut near one half, so that borders are surfaces and not the steps of their own
    voxels; just where their volume stays the same, since one half would shrink what is small and round. Where the
    voxels of `like` are larger, the mean over each is cut instead. Of several tissues, that with the largest share is
    taken, so that there are no gaps between them.
    """
    to_like, shape = like.ras_to_ijk @ masks.union.ijk_to_ras, np.array(like.array.shape[::-1])

    def in_like(indices: np.ndarray) -> np.ndarray:  # (3, n) i, j, k
        return to_like[:3, :3] @ indices + to_like[:3, 3:]

    centres = in_like(np.argwhere(masks.inside)[:, ::-1].T)
    outside = ((centres < -0.5) | (centres > shape[:, None] - 0.5)).any(axis=0)
    found = np.argwhere(masks.union.array > 0)[:, ::-1]
    ends = list(zip(found.min(axis=0) - 1, found.max(axis=0) + 1, strict=True))
    there = in_like(np.array(np.meshgrid(*ends, indexing="ij")).reshape(3, -1))
    first = np.clip(np.floor(there.min(axis=1)).astype(int), 0, shape)
    last = np.clip(np.ceil(there.max(axis=1)).astype(int) + 1, first, shape)
    where = tuple(slice(int(a), int(b)) for a, b in zip(first[::-1], last[::-1], strict=True))
    size = tuple(axis.stop - axis.start for axis in where)
    numbers = np.zeros(size, np.uint8)
    if all(size):
        shares = np.stack([_mean_over_voxels(masks.union.with_array(one), like, first, size) for one in masks.shares])
        here = np.count_nonzero(masks.inside) * (1.0 - outside.mean()) * abs(np.linalg.det(to_like[:3, :3]))
        union = shares.sum(axis=0)
        numbers[:] = np.where(union >= _cut_at(union, round(here)), shares.argmax(axis=0) + 1, 0)
    return where, numbers, float(outside.mean())


def _cut_at(shares: np.ndarray, count: int) -> float:
    """The share, within _CUTS, from which on nearest to `count` voxels are inside."""
    low, high = _CUTS
    cuts, of_each = np.unique(np.append(shares[(shares > low) & (shares < high)], high), return_counts=True)
    counts = np.count_nonzero(shares >= high) + np.cumsum(of_each[::-1])[::-1] - 1  # -1: the one appended
    return float(cuts[np.lexsort((np.abs(cuts - 0.5), np.abs(counts - count)))[0]])


def _mean_over_voxels(volume: Volume, like: Volume, first: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """(k, j, i) mean of `volume` over the voxels of `like` from voxel `first` (i, j, k), by samples in each."""
    to_volume = volume.ras_to_ijk @ like.ijk_to_ras
    step = np.linalg.norm(to_volume[:3, :3], axis=0)  # voxels of `volume` along the edges of one of `like`
    counts = np.clip(np.ceil(step - 0.01).astype(int), 1, _MOST_SAMPLES)
    backwards = to_volume[:3, :3][::-1, ::-1]  # indices k, j, i
    total = np.zeros(size, np.float32)
    for n in np.ndindex(*counts.tolist()):
        within = first + (np.array(n) + 0.5) / counts - 0.5
        start = (to_volume[:3, :3] @ within + to_volume[:3, 3])[::-1]
        total += ndimage.affine_transform(
            volume.array, backwards, start, size, order=1, mode="grid-constant", output=np.float32
        )
    return total / np.prod(counts)
