"""Parts of the segmentation of an MRI: the box of the brain, the atlas, the bias field, and thin sulci."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.alignment import explained
from SlicerUSSim.Logic.mri.atlas import mni152
from SlicerUSSim.Logic.mri.atlas_registration import AtlasFit, register_atlas
from SlicerUSSim.Logic.mri.bias import corrected
from SlicerUSSim.Logic.mri.classification import Classes
from SlicerUSSim.Logic.mri.plausibility import is_whole_brain
from SlicerUSSim.Logic.mri.recognition import check_finite

#: Percentile of the brain that counts as 0 where it has more than this share of negative values
_DARKEST, _FEW_NEGATIVE = 0.1, 0.01


@dataclass(eq=False)
class BrainPart:
    """The images and the mask within the box of the brain."""

    images: list[Volume]
    inside: np.ndarray
    _box: tuple[slice, ...]
    _shape: tuple[int, ...]

    @classmethod
    def of(cls, images: list[Volume], inside: np.ndarray) -> BrainPart:
        found = ndimage.find_objects(inside.astype(np.uint8))[0]
        box = tuple(slice(max(side.start - 2, 0), side.stop + 2) for side in found)
        matrix = images[0].ijk_to_ras.copy()
        matrix[:3, 3] = (matrix @ [*(side.start for side in reversed(box)), 1.0])[:3]
        parts = [Volume(np.ascontiguousarray(image.array[box], np.float32), matrix) for image in images]
        return cls(parts, inside[box], box, inside.shape)

    def raised(self, contrasts: tuple[str, ...]) -> tuple[list[str], float]:
        """(a line for each image that was raised, by how much the first was) where the brain has negative values.

        Z-scores have them: a bias field multiplies, and what is multiplied has to be positive.
        """
        lines, above = [], 0.0
        for n, (name, image) in enumerate(zip(contrasts, self.images, strict=True)):
            values = image.array[self.inside]
            low = float(np.percentile(values, _DARKEST))
            if low >= 0.0 or float((values < 0.0).mean()) < _FEW_NEGATIVE:
                continue
            self.images[n] = image.with_array(np.maximum(image.array - np.float32(low), 0.0))
            lines.append(f"{name}: has values below 0 in the brain, as z-scores have; counted from {low:.3g} on")
            above = low if n == 0 else above
        return lines, above

    @property
    def start(self) -> tuple[int, int, int]:
        """First voxel (k, j, i) of the box in the whole grid."""
        k, j, i = (side.start for side in self._box)
        return k, j, i

    @property
    def whole_shape(self) -> tuple[int, int, int]:
        """(k, j, i) size of the whole grid."""
        k, j, i = self._shape
        return k, j, i

    def whole(self, array: np.ndarray) -> np.ndarray:
        """An array of the box on the whole grid, 0 elsewhere."""
        result = np.zeros(self._shape, array.dtype)
        result[self._box] = array
        return result


def atlas_of(part: BrainPart, report: Callable[[float], None]) -> tuple[AtlasFit | None, str, float | None]:
    """(the registered atlas, or None where it is useless; a line that says why; the share that it explains)."""
    reason = is_whole_brain(part.images[0], part.inside)
    if reason:
        return None, f"without an atlas, since {reason}", None
    fit = register_atlas(part.images[0], part.inside, mni152(), lambda share: report(0.05 + 0.35 * share))
    share = explained(part.images[0], np.linalg.inv(fit.patient_to_atlas))
    if not fit.is_good:
        return None, f"without an atlas, since MNI152 covers the brain with a Dice of {fit.dice:.2f} only", share
    return fit, f"guided by the MNI152 atlas (overlap of the brains: Dice {fit.dice:.2f})", share


def finite(mri: Volume) -> np.ndarray:
    """The voxels as float32. Raises SimulationError for voxels that are not finite, or all the same."""
    check_finite(mri)
    return mri.array.astype(np.float32)


def remove_fields(
    part: BrainPart,
    contrasts: tuple[str, ...],
    atlas: AtlasFit | None,
    prior: np.ndarray | None,
    wanted: bool | None,
    report: Callable[[float], None],
) -> list[str]:
    """Takes the bias field out of every image of the part, where there is one or it is wanted; a line for each."""
    messages = []
    for n, (name, image) in enumerate(zip(contrasts, part.images, strict=True)):
        share = lambda done, n=n: report((n + done) / len(contrasts))  # noqa: E731
        result = corrected(image, part.inside, name, atlas, prior, wanted, share)
        part.images[n] = result.image
        messages.append(result.message)
    return messages


def require_different(values: np.ndarray, contrasts: tuple[str, ...]) -> None:
    """Raises SimulationError if one of the (channels, voxels) intensities is constant."""
    for name, channel in zip(contrasts, values, strict=True):
        require(
            float(channel.max()) > float(channel.min()),
            f"MRI is constant ({channel[0]:g}) inside the foreground, expected tissues of different intensity"
            + (f" in {name}" if len(contrasts) > 1 else ""),
        )


def narrow_sulci(labels: np.ndarray, found: Classes, filtered: np.ndarray, noise: float) -> np.ndarray:
    """(k, j, i) bool: the middles of sulci too narrow for CSF, and CSF less than two voxels thick.

    As CSF, the latter would form isolated droplets, each a lens.
    """
    csf, grey = found.names.index("csf"), found.names.index("grey matter")
    middles = sulcal_middles(filtered, labels, grey + 1, found.means[csf, 0], found.means[grey, 0], noise)
    is_csf = labels == csf + 1
    return middles | (is_csf & ~cast(np.ndarray, ndimage.binary_opening(is_csf, np.ones((2, 2, 2)))))


# ---- sulci that are too narrow to reach the intensity of CSF ---------------------------------------------------------


def sulcal_middles(
    filtered: np.ndarray, labels: np.ndarray, grey_label: int, csf_mean: float, grey_mean: float, noise: float
) -> np.ndarray:
    """(k, j, i) True at grey-matter voxels on the middle of a sheet that is closer to CSF than both of its sides.

    Along at least one of the 13 directions of the 26-neighbourhood the voxel must be an extremum compared with both
    neighbours, and differ sufficiently from the first two voxels on either side.
    """
    towards_csf = np.sign(csf_mean - grey_mean)
    # Depth below grey matter. Intensities further from CSF than grey matter count as grey matter; otherwise all cortex
    # would be a valley between white matter on both sides.
    depth = np.where(labels > 0, np.maximum(towards_csf * (filtered - grey_mean), 0), 0).astype(np.float32)
    depth = np.pad(ndimage.gaussian_filter(depth, 0.6), 2)
    flat, steps = depth.ravel(), np.array([depth.shape[1] * depth.shape[2], depth.shape[2], 1])
    grey = np.flatnonzero(np.pad(labels == grey_label, 2))
    here = flat[grey]
    least = max(0.15 * abs(csf_mean - grey_mean), noise)
    is_middle = np.zeros(grey.size, bool)
    for direction in itertools.product((-1, 0, 1), repeat=3):
        if direction <= (0, 0, 0):
            continue  # equivalent to the opposite direction
        step = int(np.dot(direction, steps))
        before, behind = flat[grey - step], flat[grey + step]
        side = np.maximum(np.minimum(before, flat[grey - 2 * step]), np.minimum(behind, flat[grey + 2 * step]))
        is_middle |= (here >= before) & (here >= behind) & (here - side > least)
    result = np.zeros(depth.shape, bool)
    result.ravel()[grey[is_middle]] = True
    return result[2:-2, 2:-2, 2:-2]
