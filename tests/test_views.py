"""Standard views: transcranial and through a fontanelle."""

from __future__ import annotations

import numpy as np
import pytest

from SlicerUSSim.Command.patient_options import STANDARD_VIEWS
from SlicerUSSim.Logic import SimulationError
from SlicerUSSim.Logic.placement.views import VIEWS, view_pose
from tests.test_craniotomy import NAMES, head  # noqa: F401


def test_the_command_knows_the_views():
    assert tuple(VIEWS) == STANDARD_VIEWS


@pytest.mark.parametrize(("name", "is_open"), [("temporal", False), ("fontanelle", True)])
def test_a_view_is_square_to_the_skin_or_the_brain(head, name, is_open):  # noqa: F811
    pose, _ = view_pose(head, NAMES, name, is_open=is_open)
    place, axis = pose[:3, 3], pose[:3, 1]
    assert np.linalg.norm(place) == pytest.approx(60.0 if is_open else 78.0, abs=2.0)
    np.testing.assert_allclose(axis, -place / np.linalg.norm(place), atol=0.05)
    np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-9)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)


@pytest.mark.slow
def test_left_and_right_front_and_back_are_where_they_are_in_such_images(head):  # noqa: F811
    right, left, coronal, sagittal = (view_pose(head, NAMES, name)[0] for name in VIEWS)
    assert right[0, 3] > 70 and left[0, 3] < -70  # RAS: the right is positive
    assert right[1, 0] < -0.9 and left[1, 0] < -0.9 and sagittal[1, 0] < -0.9  # the front on the left of the image
    assert coronal[0, 0] < -0.9  # seen from the front: the patient's right on the left of the image
    assert coronal[2, 3] > 70 and coronal[1, 3] > 15


def test_a_view_that_is_none_and_labels_without_a_brain_are_refused(head):  # noqa: F811
    with pytest.raises(SimulationError, match="view is 'frontal', expected one of temporal, temporal-left, fontanelle"):
        view_pose(head, NAMES, "frontal")
    with pytest.raises(SimulationError, match="the labels have no brain"):
        view_pose(head.with_array(np.where(head.array > 2, head.array, 0).astype(np.uint8)), NAMES, "temporal")
