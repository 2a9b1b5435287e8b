"""The MNI152 brain as the search for it in a patient uses it: points, their classes, and how well they agree."""

from __future__ import annotations

from functools import cache
from typing import cast

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import required
from SlicerUSSim.Logic.base.neighbourhood import distance_to
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.atlas import mni152
from SlicerUSSim.Logic.mri.coarse import CoarseImage

#: Voxel size of the template in the search and width of its dark ring, mm
TEMPLATE_MM, _RING_MM = 5, 6.0
_TEMPLATE_BINS, _PATIENT_BINS = 8, 32


class Points:
    """Points of the template with their class: 0 is the dark ring, the others are intensities of the brain."""

    def __init__(self, xyz: np.ndarray, classes: np.ndarray, centre: np.ndarray) -> None:
        self.from_centre, self.classes = xyz - centre, classes

    def information(self, values: np.ndarray) -> float:
        """Mutual information, in nats, of the classes and (n,) values from 0 to 1."""
        return self.information_of(binned(values))

    def information_of(self, bins: np.ndarray) -> float:
        """The same of (n,) values that are binned."""
        joint = np.bincount(self.classes * _PATIENT_BINS + bins, minlength=_TEMPLATE_BINS * _PATIENT_BINS)
        joint = joint.reshape(_TEMPLATE_BINS, _PATIENT_BINS) / len(bins)
        return entropy(joint.sum(axis=0)) + entropy(joint.sum(axis=1)) - entropy(joint)


def binned(values: np.ndarray) -> np.ndarray:
    """Numbers of the histogram's bins of values from 0 to 1."""
    return np.minimum((values * (_PATIENT_BINS - 1) + 0.5).astype(np.int64), _PATIENT_BINS - 1)


def entropy(shares: np.ndarray) -> float:
    """Entropy in nats of shares that add up to 1."""
    shares = shares[shares > 0]
    return float(-(shares * np.log(shares)).sum())


class Template:
    """The MNI152 T1 at 5 mm: points for the search, an image for the agreement, and the distance to its brain."""

    def __init__(self) -> None:
        t1 = required(mni152(), "the brain atlas needs nilearn; install it with: pip install nilearn").t1
        step = slice(None, None, TEMPLATE_MM)
        brain = t1.array > 0
        # Its voxels are of 1 mm.
        outside, inside = (np.maximum(distance_to(side), 0.0) for side in (brain, ~brain))
        self.distance = t1.with_array((outside - inside).astype(np.float32))
        smooth = ndimage.gaussian_filter(t1.array.astype(np.float32), TEMPLATE_MM / 2.4)
        self.image, self.is_brain = smooth[step, step, step], brain[step, step, step]
        used = self.distance.array[step, step, step] <= _RING_MM
        k, j, i = np.indices(used.shape)
        grid = TEMPLATE_MM * np.stack([i, j, k], axis=-1)
        grid_xyz = grid @ t1.ijk_to_ras[:3, :3].T + t1.ijk_to_ras[:3, 3]
        self.brain_xyz = grid_xyz[self.is_brain]
        self.centre = self.brain_xyz.mean(axis=0)
        self.model = np.where(self.is_brain, self.image / self.image.max(), 0.0).astype(np.float32)
        self._weight = self._windows(self.is_brain.astype(np.float32))
        mean = self.local_mean(self.model)
        self.local = mean, self.local_mean(self.model**2) - mean**2
        borders = np.quantile(self.image[self.is_brain], np.arange(1, _TEMPLATE_BINS - 1) / (_TEMPLATE_BINS - 1))
        classes = np.where(self.is_brain, np.digitize(self.image, borders) + 1, 0)
        coarse = used & (k % 2 == 0) & (j % 2 == 0) & (i % 2 == 0)
        self.fine, self.coarse = (Points(grid_xyz[at], classes[at], self.centre) for at in (used, coarse))

    def _windows(self, values: np.ndarray) -> np.ndarray:
        return ndimage.gaussian_filter(values, 10.0 / TEMPLATE_MM)[self.is_brain]

    def local_mean(self, values: np.ndarray) -> np.ndarray:
        """(points of the brain,) means in Gaussian windows of 10 mm deviation of (k, j, i) values, 0 outside it."""
        return self._windows(values) / self._weight

    def distance_on(self, grid: Volume, template_to_ras: np.ndarray) -> np.ndarray:
        matrix = self.distance.ras_to_ijk @ np.linalg.inv(template_to_ras) @ grid.ijk_to_ras
        order = matrix[:3, :3][::-1, ::-1]
        shift = cast(float, matrix[:3, 3][::-1] + 1.0)  # annotated as a number, takes one for each axis
        padded = np.pad(self.distance.array, 1, mode="edge")  # far outside: at least the distance at the border
        return ndimage.affine_transform(
            padded, order, shift, grid.array.shape, output=np.float32, order=1, mode="nearest"
        )


@cache
def template() -> Template:
    """The template, computed once."""
    return Template()


def agreement(image: CoarseImage, template_to_ras: np.ndarray) -> float:
    """Mean over the template's brain of the squared correlation with the patient in windows of 10 mm deviation.

    Local, so that neither a bias field nor the contrast matters: it asks whether borders are in the same places.
    """
    model = template()
    points = model.brain_xyz @ template_to_ras[:3, :3].T + template_to_ras[:3, 3]
    patient = np.zeros(model.is_brain.shape, np.float32)
    patient[model.is_brain] = image.at(points)
    mean_model, variance_model = model.local
    mean_patient = model.local_mean(patient)
    covariance = model.local_mean(model.model * patient) - mean_model * mean_patient
    variances = variance_model * (model.local_mean(patient**2) - mean_patient**2)
    return float(np.mean(covariance**2 / np.maximum(variances, 1e-10)))
