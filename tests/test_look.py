"""Plausibility of the image of a brain, the template's."""

from __future__ import annotations

import numpy as np
import pytest

from SlicerUSSim.Logic import (
    DisplaySettings,
    PhasedProbe,
    SimulationSettings,
    TissueTable,
    UltrasoundSimulator,
    Volume,
    segment_mri,
)
from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.probe.poses import craniotomy_pose, pose_looking_at, sample, slice_under_probe, surface_point


@pytest.fixture(scope="module")
def view(mni):
    """(frames, labels under the probe) of the demo's view, averaged over seeds to look through the speckle."""
    segmentation = segment_mri(mni[0], thin_sulci=True)
    table = TissueTable.brain(segmentation.tissue_names)
    probe = PhasedProbe(80, 90, scan_lines=196)
    pose = craniotomy_pose(segmentation.labels, probe)
    images = []
    simulator = UltrasoundSimulator(segmentation.labels, table)
    for seed in range(4):
        simulator.settings = SimulationSettings(seed=seed)
        frame = simulator.simulate(probe, pose, DisplaySettings(look="even"))
        images.append(frame.image)
    labels = slice_under_probe(segmentation.labels, frame.grid, pose, order=0)
    return np.stack(images).astype(float), labels, probe, frame


def eroded(mask: np.ndarray, pixels: int) -> np.ndarray:
    from scipy.ndimage import binary_erosion

    return binary_erosion(mask, iterations=pixels)


def largest_part(mask: np.ndarray) -> np.ndarray:
    from scipy.ndimage import label

    parts, count = label(mask)
    assert count >= 1
    return parts == np.argmax(np.bincount(parts.ravel())[1:]) + 1


def in_field(probe, frame) -> np.ndarray:
    rows, columns = frame.image.shape
    x, y = np.meshgrid(
        np.arange(columns) * frame.pixel_spacing_mm[0] + frame.image_to_probe[0, 3],
        np.arange(rows) * frame.pixel_spacing_mm[1] + frame.image_to_probe[1, 3],
    )
    return (np.abs(np.arctan2(x, y)) < -probe.first_line * 0.95) & (np.hypot(x, y) < 0.95 * probe.depth_mm) & (y > 3)


@pytest.mark.slow
def test_mean_grey_is_neither_dark_nor_washed_out(view):
    images, _, probe, frame = view
    assert 40 < images[:, in_field(probe, frame)].mean() < 90


@pytest.mark.slow
def test_ventricles_are_black_and_white_matter_is_above_grey(view):
    images, labels, probe, frame = view
    mean, field = images.mean(axis=0), in_field(probe, frame)
    # The lateral ventricle under the probe: fluid near the axis, half-way down.
    near_axis = in_field(PhasedProbe(30, 72, scan_lines=196), frame)
    ventricle = eroded((labels == 1) & near_axis, 6)
    assert ventricle.sum() > 200
    assert np.median(mean[ventricle]) < 12
    near = in_field(PhasedProbe(80, 50, scan_lines=196), frame)  # before enhancement and shadow have an effect
    grey, white = (np.median(mean[eroded(labels == label, 3) & field & near]) for label in (2, 3))
    assert white > grey + 8


@pytest.mark.slow
def test_sulci_and_walls_are_bright(view):
    images, labels, probe, frame = view
    mean, field = images.mean(axis=0), in_field(probe, frame)
    sulci = mean[(labels == 4) & field]
    brain = mean[eroded(np.isin(labels, (2, 3)), 6) & field]
    assert sulci.size > 200
    assert np.percentile(sulci, 75) > np.median(brain) + 25  # lines break
    # Ventricle walls: a rim about the eroded fluid.
    from scipy.ndimage import binary_dilation

    largest = largest_part(eroded((labels == 1) & field, 4))
    rim = binary_dilation(largest, iterations=9) & ~binary_dilation(largest, iterations=3) & field
    assert np.percentile(mean[rim], 75) > np.median(brain) + 15


def test_poses_look_where_they_are_aimed():
    pose = pose_looking_at([0, 0, 100], [0, 0, 0], lateral_ras=[1, 0.2, 0])
    np.testing.assert_allclose(pose[:3, 1], [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1) and pose[0, 0] > 0.9
    with pytest.raises(SimulationError, match="expected two points"):
        pose_looking_at([1, 2, 3], [1, 2, 3])
    with pytest.raises(SimulationError, match="along the probe axis"):
        pose_looking_at([0, 0, 9], [0, 0, 0], lateral_ras=[0, 0, 1])


def test_the_surface_is_found_from_inside():
    z, y, x = np.meshgrid(*(np.arange(-30, 31),) * 3, indexing="ij")
    matrix = np.eye(4)
    matrix[:3, 3] = -30
    ball = Volume((x**2 + y**2 + z**2 < 20**2).astype(np.uint8), matrix)
    for direction in ([0, 0, 1], [1, 1, 1], [-1, 0.3, 0.2]):
        assert np.linalg.norm(surface_point(ball, [0, 0, 0], direction)) == pytest.approx(20, abs=1)
    with pytest.raises(SimulationError, match="no tissue"):
        surface_point(ball, [0, 0, 40], [0, 0, 1])
    assert sample(ball, np.array([[0.0, 0, 0], [100, 0, 0]]), order=0).tolist() == [1, 0]
