"""Masks of lesions on any grid: what a file holds, and resampling to the grid of a label map."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.label_numbers import whole_numbers
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.tissue.label_files import names_of_file
from SlicerUSSim.Logic.tissue.names import tissue_named

#: Tissues of BraTS maps, from outside to inside: 1 is the necrotic core with tumour that does not enhance. Enhancing
#: tumour is 4 until 2022 and 3 since, when 4 is a resection cavity (Menze et al., IEEE TMI 34(10), 2015; BraTS 2023).
_BRATS = {
    "brats-2022": {"oedema": 2, "necrosis": 1, "enhancing": 4},
    "brats-2023": {"oedema": 2, "necrosis": 1, "enhancing": 3, "cavity": 4},
}
#: What several tissues are added as: by the names of their labels, or else as BraTS numbers them; without a year, by
#: whether a label 3 occurs
SEVERAL = ("brats", *_BRATS)
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


def read_mask(path: str | os.PathLike) -> Volume:
    """A mask's file with the names of its labels: segments of a .seg.nrrd, a table beside it.

    Raises SimulationError as Volume.read.
    """
    return with_label_names(Volume.read(path), path)


def with_label_names(volume: Volume, path: str | os.PathLike) -> Volume:
    """The volume of a file with the names of its labels. Raises SimulationError for a table that cannot be read."""
    return replace(volume, label_names=names_of_file(Path(path), volume)[0])


def read_masks(volume: Volume, tissue: str, source: str) -> Masks:
    """What a volume holds: `tissue`, or with one of SEVERAL the tissues of its labels.

    Raises SimulationError for an empty mask, for labels that have no tissue, and for an image that is neither a mask,
    nor a label map, nor probabilities.
    """
    is_several = tissue in SEVERAL
    array = volume.array
    bad = int(array.size - np.isfinite(array).sum())
    require(bad == 0, f"{source}: has {bad} voxels that are not finite numbers, expected none")
    whole = _whole_numbers(array)
    low, high = float(array.min()), float(array.max())
    if whole is None:
        expected = (
            "labels, whole numbers" if is_several else "a mask (0 and not 0), labels, or probabilities from 0 to 1"
        )
        require(
            not is_several and low >= 0.0 and high <= 1.0,
            f"{source}: holds fractions from {low:g} to {high:g}, expected {expected}",
        )
        require(high > 0.5, f"{source}: no probability is above 0.5 (the largest is {high:g}); nothing would be added")
        return _masks(volume, {tissue: array}, source)
    values = np.unique(whole).astype(int)
    require(
        values[0] >= 0 and len(values) <= _MOST_LABELS,
        f"{source}: holds {_listed(values)}, as an image does, expected a mask: 0 outside and another number inside",
    )
    labels = values[values > 0]
    require(labels.size > 0, f"{source}: is empty, expected voxels that are not 0")
    names = {int(label): volume.label_names[label] for label in labels if label in volume.label_names}
    labelled = volume.with_array(whole)
    if is_several:
        return _by_name(labelled, labels, names, source) if names else _brats(labelled, labels, tissue, source)
    warnings = ()
    if len(labels) > 1:
        warnings = (
            f"{source} holds the labels {called(labels, names)}; all of them are added as {tissue}"
            f"{_alternative(labels, names)}",
        )
    return _masks(volume, {tissue: whole != 0}, source, warnings)


def several_segments(volume: Volume) -> str:
    """The labels that a mask holds with their names, if there are several and they have names; otherwise ""."""
    labels = np.unique(volume.array[np.isfinite(volume.array)])
    labels = labels[labels != 0]
    if not 1 < len(labels) <= _MOST_LABELS or (labels % 1 != 0).any():
        return ""
    names = {int(label): volume.label_names[int(label)] for label in labels if int(label) in volume.label_names}
    return called(labels.astype(int), names) if names else ""


def _alternative(labels: np.ndarray, names: Mapping[int, str]) -> str:
    """How several labels could be added as separate tissues, in brackets; empty if it is not known."""
    if not names:
        return " (brats=FILE adds the tissues of a BraTS map)" if set(labels.tolist()) <= {1, 2, 3, 4} else ""
    try:
        tissues = [tissue_named(names[label]).name for label in labels.tolist()]
    except (KeyError, SimulationError):
        return ""
    return f" (brats=FILE adds each by its name, as {', '.join(dict.fromkeys(tissues))})"


def _masks(volume: Volume, shares: dict[str, np.ndarray], source: str, warnings: tuple[str, ...] = ()) -> Masks:
    stacked = np.stack([share.astype(np.float32) for share in shares.values()])
    return Masks(source, tuple(shares), stacked, volume.with_array(stacked.sum(axis=0)), warnings)


def _by_name(labelled: Volume, labels: np.ndarray, names: Mapping[int, str], source: str) -> Masks:
    """The tissues that the names of the labels mean, whatever their numbers are."""
    found: dict[str, list[int]] = {}
    for label in labels.tolist():
        name = names.get(label)
        try:
            tissue = None if name is None else tissue_named(name).name
        except SimulationError:
            tissue = None
        require(
            tissue is not None,
            f"{source}: holds the labels {called(labels, names)}, and {name or f'label {label}'!r} matches no "
            "tissue; rename it (tumour, oedema, necrosis, enhancing, cyst, cavity), or add every label from a "
            "separate file with its tissue",
        )
        found.setdefault(str(tissue), []).append(label)
    masks = {tissue: np.isin(labelled.array, of_it) for tissue, of_it in found.items()}
    pairs = ", ".join(
        f"{' and '.join(repr(names[label]) for label in of_it)} as {tissue}" for tissue, of_it in found.items()
    )
    return _masks(labelled, masks, source, (f"{source}: labels are added by their names, {pairs}",))


def _brats(labelled: Volume, labels: np.ndarray, year: str, source: str) -> Masks:
    """The tissues of BraTS's numbers; `year` is one of SEVERAL."""
    there = set(labels.tolist())
    is_guessed = year == "brats" and 4 in there and 3 not in there
    numbers = _BRATS["brats-2022" if is_guessed or year == "brats-2022" else "brats-2023"]
    expected = ", ".join(f"{label} {name}" for name, label in sorted(numbers.items(), key=lambda item: item[1]))
    if year == "brats":
        expected += ", or without 3: 4 enhancing"
    require(
        there <= {*numbers.values()},
        f"{source}: holds the labels {_listed(labels)}, expected those of BraTS: {expected}",
    )
    require(
        there != {1},
        f"{source}: holds the label 1 alone, as the mask of a whole tumour does, expected several labels of BraTS; add "
        "it as what it is: tumour=FILE, or necrosis=FILE if it is BraTS's label 1",
    )
    warnings = (f"{source}: label 4 is read as enhancing, as until 2022, and not as a cavity, without a label 3",)
    masks = {name: labelled.array == label for name, label in numbers.items() if label in there}
    return _masks(labelled, masks, source, warnings if is_guessed else ())


def _whole_numbers(array: np.ndarray) -> np.ndarray | None:
    """The array, rounded, if it holds whole numbers, also when they are stored as float."""
    if array.dtype == bool:
        return array.astype(np.uint8)
    return None if float(np.abs(array).max()) > 2**31 else whole_numbers(array)


def called(labels: np.ndarray, names: Mapping[int, str]) -> str:
    """Labels with their names, as far as they have one: "1 'Edema', 2 'Necrosis'"."""
    if not names:
        return _listed(labels)
    return ", ".join(f"{label} {names[label]!r}" if label in names else str(label) for label in labels.tolist())


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
    """The threshold of the share, within _CUTS, with the number of voxels inside nearest to `count`."""
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
