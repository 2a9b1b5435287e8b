"""Texture: information of an MRI for scatterers beyond hard labels (docs/physics.md#hybrid-scatterers).

Two kinds of information, which can be used separately:
- partial volume: the probability that a voxel belongs to another tissue than its label. A scatterer takes the other
  tissue with this probability, with a random number that is fixed for each scatterer. The mean power is therefore the
  weighted mean of both tissues, and the signal remains linear in mu0 and sigma0 of every tissue;
- intensity: the deviation of the MRI from the mean of the tissue. Amplitudes follow it in decibels, normalised so that
  the tissue as a whole keeps its mean power.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.opencl.layout import CONSTANTS

_FARTHEST_DEVIATION = 2.5


@dataclass(frozen=True, eq=False)
class Texture:
    """Texture on the grid of a label map.

    Parameters
    ----------
    second_label : (k, j, i) uint8, the most probable other tissue of every voxel.
    second_share : (k, j, i) float32, its probability, 0 to 1; 0 if the label is certain.
    deviation : (k, j, i) float32, MRI intensity in standard deviations from the mean of the voxel's tissue.

    Raises SimulationError if the shapes differ, or for a probability outside 0 to 1.
    """

    second_label: np.ndarray
    second_share: np.ndarray
    deviation: np.ndarray

    def __post_init__(self) -> None:
        shapes = {name: np.shape(getattr(self, name)) for name in ("second_label", "second_share", "deviation")}
        require(len(set(shapes.values())) == 1, f"texture arrays have different shapes: {shapes}")
        low, high = float(np.min(self.second_share)), float(np.max(self.second_share))
        require(low >= 0.0 and high <= 1.0, f"second_share goes from {low:g} to {high:g}, expected 0 to 1")
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
        return Texture(self.second_label[part], self.second_share[part], self.deviation[part])

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
