"""Standard views follow the head, however it lies in its image."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic import Volume
from SlicerUSSim.Logic.placement.views import VIEWS, head_axes, view_pose

NAMES = ("csf", "grey matter", "white matter")


@pytest.fixture(scope="module")
def brain(mni):
    """Labels of MNI152, every other voxel."""
    t1, grey, white = (volume.array[::2, ::2, ::2] for volume in mni)
    labels = np.where(t1 > 0, 1 + np.argmax([255 - grey - white.astype(int), grey, white], axis=0), 0)
    return Volume(labels.astype(np.uint8), mni[0].ijk_to_ras @ np.diag([2.0, 2.0, 2.0, 1.0]))


def lying(brain: Volume, turn: Rotation) -> Volume:
    """The same head, turned about the origin of MNI152 and moved, which its header tells truly."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn.as_matrix(), [12.0, -30.0, 45.0]
    return Volume(brain.array, matrix @ brain.ijk_to_ras)


@pytest.mark.parametrize(
    "turn",
    [
        pytest.param((25.0, 0.0, 0.0), id="nodding", marks=pytest.mark.long),
        pytest.param((40.0, 30.0, 155.0), id="oblique", marks=pytest.mark.slow),
    ],
)
def test_views_of_a_turned_head_are_those_of_the_upright_one_turned(brain, turn):
    rotation = Rotation.from_euler("xyz", turn, degrees=True)
    turned = lying(brain, rotation)
    upright, line = head_axes(brain, NAMES)
    assert line == "" and Rotation.from_matrix(upright).magnitude() < np.radians(2.0)
    axes, line = head_axes(turned, NAMES)
    assert Rotation.from_matrix(axes @ rotation.as_matrix().T).magnitude() < np.radians(2.0)
    assert f"the head lies turned by {np.degrees(rotation.magnitude()):.0f}"[:-1] in line
    for view in ("temporal", "fontanelle-sagittal"):
        (before, _), (after, told) = (view_pose(labels, NAMES, view) for labels in (brain, turned))
        expected = rotation.as_matrix() @ before[:3, :3]
        bare = "no skull is labelled: the probe stands on the brain, and the image has no bone"
        assert told == ("; ".join([line, bare]) if view == "temporal" else line)
        assert Rotation.from_matrix(after[:3, :3] @ expected.T).magnitude() < np.radians(12.0)  # normals of a surface
        across = np.cross(VIEWS[view].lateral, VIEWS[view].outward)
        assert abs(after[:3, 2] @ axes @ across) / np.linalg.norm(across) > np.cos(np.radians(1.0))  # in its plane


def test_where_the_atlas_does_not_lead_a_view_follows_the_image(brain):
    half = brain.array.copy()
    half[:, :, : half.shape[2] // 2] = 0
    half[:, : half.shape[1] // 2] = 0
    axes, line = head_axes(brain.with_array(half), NAMES)
    assert np.array_equal(axes, np.eye(3)) and line.startswith("the view follows the image's axes, since ")
    assert view_pose(brain.with_array(half), NAMES, "fontanelle")[1] == line


@pytest.mark.slow
def test_a_temporal_view_looks_for_the_window_where_bone_is_thin(brain):
    away = ndimage.distance_transform_edt(brain.array == 0, brain.spacing_mm[::-1])
    labels = np.where(away < 14.0, 5, 0)
    labels[away < 10.0] = 4
    labels[brain.array > 0] = brain.array[brain.array > 0]
    names = (*NAMES, "skull", "scalp")
    pose, _ = view_pose(
        Volume(labels.astype(np.uint8), brain.ijk_to_ras), names, "temporal"
    )  # about as thick everywhere
    k, j, i = np.indices(labels.shape)
    places = np.stack([i, j, k, np.ones_like(i)], axis=-1) @ brain.ijk_to_ras.T
    window = pose[:3, 3] + [0.0, 12.0, 0.0]  # in front of the middle of the temple
    is_thin = np.hypot(places[..., 1] - window[1], places[..., 2] - window[2]) < 8.0
    labels[is_thin & (away > 3.0) & (labels == 4)] = 5
    moved, line = view_pose(Volume(labels.astype(np.uint8), brain.ijk_to_ras), names, "temporal")
    assert np.linalg.norm(moved[:3, 3] - pose[:3, 3]) > 4.0 and np.linalg.norm(moved[1:3, 3] - window[1:]) < 8.0
    assert line.startswith("placed where bone is ") and int(line.split()[4]) <= 5
    assert " from the middle of the temple, where it is " in line
    on_brain, line = view_pose(Volume(labels.astype(np.uint8), brain.ijk_to_ras), names, "temporal", is_open=True)
    assert line == "" and np.linalg.norm(on_brain[1:3, 3] - pose[1:3, 3]) < 6.0  # an opening needs no window
