"""Landmarks of a registration: what is accepted, and what a scene keeps."""

from __future__ import annotations

import numpy as np
import pytest

slicer = pytest.importorskip("slicer", reason="MRML nodes come with slicer-core: pip install '.[slicer]'")

from SlicerUSSim.Logic import SimulationError  # noqa: E402
from SlicerUSSim.Logic.mrml.landmark_nodes import Landmark, landmarks_of, write_landmarks  # noqa: E402


@pytest.mark.parametrize(
    ("pixel", "point", "words"),
    [
        ((-50.0, 10.0), (1, 2, 3), "in the image has column -50, expected 0 to 623, as the image has 624x512 pixels"),
        ((10.0, 9999.0), (1, 2, 3), "in the image has row 9999, expected 0 to 511, as the image has 624x512 pixels"),
        ((10.0, 10.0), (1e9, 0, 0), r"in the patient has R 1e\+09 mm, expected at most 100000 mm from the origin"),
    ],
)
def test_landmarks_outside_the_image_or_far_from_any_patient_are_refused(pixel, point, words):
    with pytest.raises(SimulationError, match=words):
        Landmark(0, np.array(pixel), np.array(point, float)).check(624, 512)


@pytest.mark.parametrize("pixel", [(-0.5, -0.5), (623.5, 511.5)])
def test_landmarks_of_the_image_and_its_borders_are_accepted_and_kept(pixel):
    scene = slicer.vtkMRMLScene()
    mark = Landmark(3, np.array(pixel), np.array([1e5, -1e5, 20.5]))
    mark.check(624, 512)
    write_landmarks(scene.AddNewNodeByClass("vtkMRMLMarkupsFiducialNode", "marks"), [mark])
    (again,) = landmarks_of(scene)
    assert again.to_list() == mark.to_list()
