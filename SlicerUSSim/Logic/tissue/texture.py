"""Texture: information of an MRI for scatterers beyond hard labels (docs/physics.md#hybrid-scatterers).

Two kinds of information, which can be used separately:
- partial volume: the probability that a voxel belongs to another tissue than its label. A scatterer takes the other
  tissue with this probability, with a random number that is fixed for each scatterer. The mean power is therefore the
  weighted mean of both tissues, and the signal remains linear in sqrt(Var) of every tissue;
- intensity: the deviation of the MRI from the mean of the tissue. Amplitudes follow it in decibels, normalised so that
  the tissue as a whole keeps its mean power.

A third places borders between voxels, without a setting: the part of a voxel that its second tissue fills.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.neighbourhood import largest_around
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.opencl.layout import CONSTANTS

_FARTHEST_DEVIATION = 2.5
#: Of volume shares: voxels whose second tissue is less probable are whole; least standard deviations between
#: the means of tissues for which an intensity between them shows a share; the part of that range in which it does
_SURE, _CLEAR, _INNER_RANGE = 0.05, 5.0, 0.7


@dataclass(frozen=True, eq=False)
class Texture:
    """Texture on the grid of a label map.

    Parameters
    ----------
    second_label : (k, j, i) uint8, the most probable other tissue of every voxel.
    second_share : (k, j, i) float32, its probability, 0 to 1; 0 if the label is certain.
    deviation : (k, j, i) float32, MRI intensity in standard deviations from the mean of the voxel's tissue.
    volume_share : (k, j, i) float32, the part of the voxel that the second tissue fills, 0 to 1 (volume_shares). It
        places borders between voxels; without it labels do.

    Raises SimulationError if the shapes differ, or for a probability outside 0 to 1.
    """

    second_label: np.ndarray
    second_share: np.ndarray
    deviation: np.ndarray
    volume_share: np.ndarray | None = None

    def __post_init__(self) -> None:
        shapes = {name: np.shape(array) for name, array in vars(self).items() if array is not None}
        require(len(set(shapes.values())) == 1, f"texture arrays have different shapes: {shapes}")
        for name in ("second_share", "volume_share"):
            share = getattr(self, name)
            if share is not None:
                low, high = float(np.min(share)), float(np.max(share))
                require(low >= 0.0 and high <= 1.0, f"{name} goes from {low:g} to {high:g}, expected 0 to 1")
        require(bool(np.isfinite(self.deviation).all()), "deviation has values that are not finite, expected none")

    @classmethod
    def from_mri(cls, mri: Volume, labels: Volume) -> Texture:
        """Texture from any label map and an image on its grid: intensity only, no partial volume.

        Raises SimulationError if the grids differ or the image is not finite.
        """
        require(
            mri.array.shape == labels.array.shape and np.allclose(mri.ijk_to_ras, labels.ijk_to_ras, atol=1e-3),
            f"the MRI ({mri.size_text}) and the labels "
            f"({labels.size_text}) lie on different grids; resample one of them",
        )
        require(bool(np.isfinite(mri.array).all()), "the MRI has values that are not finite, expected none")
        nothing = np.zeros(labels.array.shape, np.uint8)
        return cls(nothing, nothing.astype(np.float32), tissue_deviation(mri.array, labels.array))

    def on_grid_of(self, labels: Volume, whole: Volume) -> Texture:
        """The part of this texture of `whole` on the voxels of `labels`, a label map cropped from it.

        Raises SimulationError if `labels` is not a part of `whole`.
        """
        offset = (whole.ras_to_ijk @ labels.ijk_to_ras)[:3]
        first = np.rint(offset[:, 3]).astype(int)[::-1]
        last = first + labels.array.shape
        require(
            np.allclose(offset[:, :3], np.eye(3), atol=1e-3)
            and np.allclose(offset[::-1, 3], first, atol=1e-2)
            and bool((first >= 0).all() and (last <= whole.array.shape).all()),
            "the labels are on another grid than their MRI; segment the MRI again",
        )
        part = tuple(slice(a, b) for a, b in zip(first, last, strict=True))
        share = None if self.volume_share is None else self.volume_share[part]
        return Texture(self.second_label[part], self.second_share[part], self.deviation[part], share)

    def along(self, labels: Volume) -> Texture:
        """Stored as `labels.along()`, of its label map. Raises SimulationError if the shapes differ."""
        require(
            self.deviation.shape == labels.array.shape,
            f"the texture has shape {self.deviation.shape}, expected that of the labels, {labels.array.shape}",
        )
        arrays = {name: array for name, array in vars(self).items() if array is not None}
        return replace(self, **{name: labels.with_array(array).along().array for name, array in arrays.items()})

    def membership(self) -> tuple[np.ndarray, np.ndarray] | None:
        """(second label, the part of the voxel that it fills in 1/255), (k, j, i) uint8 each; None if not known."""
        if self.volume_share is None:
            return None
        return self.second_label.astype(np.uint8), np.rint(255.0 * self.volume_share).astype(np.uint8)

    def packed(self, labels: np.ndarray, partial_volume: bool, modulation_db: float) -> np.ndarray:
        """(k, j, i) uint32 for kernels/scattering.cl: second label | share in 1/255 << 8 | gain << 16.

        The gain is in steps of TEXTURE_STEP_DB, with 128 for 0 dB. `modulation_db` is per standard deviation; the mean
        square of the gain over each label is 1.
        """
        level = np.full(labels.shape, 128.0, np.float32)
        if modulation_db != 0.0:
            gain_db = modulation_db * np.clip(self.deviation, -_FARTHEST_DEVIATION, _FARTHEST_DEVIATION)
            power_db = 10.0 * np.log10(_means(10.0 ** (gain_db / 10.0), labels) + 1e-30)
            level += (gain_db - power_db[labels]) / CONSTANTS["TEXTURE_STEP_DB"]
        packed = np.clip(np.rint(level), 0, 255).astype(np.uint32) << np.uint32(16)
        if partial_volume:
            share = np.rint(255.0 * self.second_share).astype(np.uint32)
            packed |= np.where(share > 0, self.second_label, 0).astype(np.uint32) | (share << np.uint32(8))
        return packed


def volume_shares(
    intensity: np.ndarray, labels: np.ndarray, second_label: np.ndarray, second_share: np.ndarray
) -> np.ndarray:
    """(k, j, i) float32 part of every voxel that its second tissue fills, 0 to 1/2, from a denoised image.

    A voxel of both tissues lies between their means by the parts that they fill; its class is more certain than that
    (`second_share`). Only voxels next to the second tissue count as mixed, and pairs of tissues whose means differ
    by _CLEAR standard deviations; the others have the share of the class. The outer parts of the range count as
    whole, since noise there would have one sign.
    """
    inside = labels > 0
    own_label, other_label, share, value = (a[inside] for a in (labels, second_label, second_share, intensity))
    value = value.astype(np.float64)
    sure = np.where(share < _SURE, own_label, 0)
    mean = _means(value, sure)
    spread = np.sqrt(np.maximum(_means(value**2, sure) - mean**2, 0.0))
    size = int(max(labels.max(), second_label.max())) + 1
    mean, spread = (np.pad(values, (0, max(size - len(values), 0))) for values in (mean, spread))
    apart = np.abs(mean[None] - mean[:, None])
    is_clear = apart > _CLEAR * 0.5 * (spread[None] + spread[:, None]) + 1e-12
    found = np.zeros(len(value), np.float32)
    for other in np.unique(other_label):
        beside = (other_label == other) & (own_label != other)
        beside &= largest_around(labels == other)[inside]
        for own in np.unique(own_label[beside]):
            where = np.flatnonzero(beside & (own_label == own))
            of_class = share[where]
            if is_clear[own, other]:
                fraction = (value[where] - mean[own]) / (mean[other] - mean[own])
                by_value = np.clip((fraction - 0.5) / _INNER_RANGE + 0.5, 0.0, 0.5)
                of_class = np.where(of_class > 0.0, by_value, 0.0)
            found[where] = of_class
    shares = np.zeros(labels.shape, np.float32)
    shares[inside] = found
    return shares


def tissue_deviation(intensity: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """(k, j, i) float32 intensity in standard deviations from the mean of each label's voxels."""
    values = intensity.astype(np.float64)
    mean = _means(values, labels)
    spread = np.sqrt(np.maximum(_means(values**2, labels) - mean**2, 0.0))
    table = np.where(spread > 1e-6 * np.abs(mean).max(), spread, np.inf)  # no deviation in a constant tissue
    return ((intensity - mean[labels]) / table[labels]).astype(np.float32)


def _means(values: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """(largest label + 1,) mean of `values` over the voxels of each label; 0 for labels that do not occur."""
    return np.bincount(labels.ravel(), values.ravel()) / np.maximum(np.bincount(labels.ravel()), 1)
