"""Whether labels and an MRI are of one patient."""

import numpy as np
import pytest

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.given_mask import follows
from SlicerUSSim.Logic.mri.samples import demo_mri


@pytest.fixture(scope="module")
def brain() -> Volume:
    return demo_mri()[0]


@pytest.fixture(scope="module")
def labels(brain) -> Volume:
    """CSF, grey and white matter by thresholds, on voxels of 2 mm."""
    coarse = brain.array[::2, ::2, ::2]
    bounds = np.quantile(coarse[coarse > 0], [0.15, 0.6])
    tissues = np.where(coarse > 0, 1 + np.digitize(coarse, bounds), 0).astype(np.uint8)
    return Volume(tissues, brain.ijk_to_ras @ np.diag([2.0, 2.0, 2.0, 1.0]))


def moved(volume: Volume, *by_mm: float) -> Volume:
    matrix = volume.ijk_to_ras.copy()
    matrix[:3, 3] += by_mm
    return Volume(volume.array, matrix)


def test_an_mri_follows_its_own_labels_whatever_its_contrast_and_frame(brain, labels):
    assert follows(brain, labels)
    other_contrast = np.where(brain.array > 0, brain.array.max() - brain.array, 0)
    assert follows(brain.with_array(other_contrast), labels)
    noise = np.random.default_rng(0).normal(0.0, 0.1 * brain.array.max(), brain.array.shape).astype(np.float32)
    assert follows(brain.with_array(brain.array + noise), labels)


@pytest.mark.parametrize("by_mm", [(8.0, 0.0, 0.0), (0.0, 0.0, 8.0), (400.0, 0.0, 0.0)])
def test_an_mri_does_not_follow_labels_in_another_place(brain, labels, by_mm):
    assert not follows(brain, moved(labels, *by_mm))


def test_an_mri_does_not_follow_labels_of_a_mirrored_head(brain, labels):
    mirrored = labels.with_array(np.ascontiguousarray(labels.array[:, ::-1]))  # front to back
    assert not follows(brain, mirrored)


def test_labels_of_one_tissue_or_none_tell_nothing(brain, labels):
    assert not follows(brain, labels.with_array((labels.array > 0).astype(np.uint8)))
    assert not follows(brain, labels.with_array(np.zeros_like(labels.array)))
    assert not follows(brain.with_array(np.zeros_like(brain.array)), labels)


@pytest.mark.parametrize("shell_mm", [20.0, 60.0])
def test_an_mri_follows_labels_that_are_the_same_beside_themselves(shell_mm):
    """A symmetric phantom was mistaken for another patient: labels of a cylinder are the same along its axis."""
    k, j, i = np.ogrid[:40, :80, :80]
    radius = 2.5 * np.hypot(j - 40, i - 40) + 0.0 * k
    labels = np.where(radius < 95.0, 1 + radius // shell_mm, 0).astype(np.uint8)
    noise = np.random.default_rng(1).normal(0.0, 20.0, labels.shape)
    mri = np.array([0.0, 300.0, 100.0, 200.0, 50.0, 250.0])[labels] + noise
    to_ras = np.diag([2.5, 2.5, 2.5, 1.0])
    assert follows(Volume(mri.astype(np.float32), to_ras), Volume(labels, to_ras))
    assert not follows(Volume(mri.astype(np.float32), to_ras), moved(Volume(labels, to_ras), 40.0, 0.0, 0.0))
