"""The slice views beside the image: each is what it is called on the page, and shows the patient that is there."""

from __future__ import annotations

import numpy as np
import pytest

slicer = pytest.importorskip("slicer", reason="MRML nodes come with slicer-core: pip install '.[slicer]'")
pytest.importorskip("trame_slicer", reason="the workstation comes with: pip install '.[serve]'")

from trame.app import get_server  # noqa: E402
from trame_slicer.core import SlicerApp  # noqa: E402

from SlicerUSSim.Logic import PhasedProbe, Volume  # noqa: E402
from SlicerUSSim.Logic.base.vtk_data import matrix_array  # noqa: E402
from SlicerUSSim.Logic.mrml.nodes import write_volume  # noqa: E402
from SlicerUSSim.Workstation.anatomy import AnatomyViews  # noqa: E402

AXIAL = [[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


@pytest.fixture(scope="module")
def views():
    app = SlicerApp()
    found = AnatomyViews(app, get_server("slice views", client_type="vue3"), lambda server, name, view: None)
    found.app = app
    return found


def background(view) -> str | None:
    return view.get_background_volume_id() or None


def test_a_view_is_what_it_is_called_from_the_start(views):
    """The view that was called Axial showed a coronal slice until there was an image."""
    by_name = {view.get_singleton_tag(): view for view in views.slices}
    assert views.planes == {"Red": "In plane", "Yellow": "Across", "Green": "Axial"}
    green = by_name["Green"].get_view_node()
    np.testing.assert_allclose(np.abs(matrix_array(green.GetSliceToRAS())[:3, :3]), np.abs(AXIAL), atol=1e-6)
    node = views.app.scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "head")
    write_volume(node, Volume(np.ones((20, 20, 20), np.float32), np.diag([5.0, 5.0, 5.0, 1.0])))
    views.show_volume(node)
    np.testing.assert_allclose(np.abs(matrix_array(green.GetSliceToRAS())[:3, :3]), np.abs(AXIAL), atol=1e-6)
    assert background(by_name["Green"]) == node.GetID()
    assert background(by_name["Red"]) is None and background(by_name["Yellow"]) is None  # without a probe no plane
    pose = np.eye(4)
    pose[:3, 3] = [50.0, 0.0, 50.0]
    views.follow(pose, PhasedProbe(75.0, 70.0))
    assert {background(view) for view in views.slices} == {node.GetID()}
    red = by_name["Red"].get_view_node()
    np.testing.assert_allclose(np.abs(matrix_array(red.GetSliceToRAS())[:3, 2]), [0, 0, 1], atol=1e-6)
    views.set_plane("Red", "Coronal")
    normal = matrix_array(by_name["Red"].get_view_node().GetSliceToRAS())[:3, 2]
    np.testing.assert_allclose(np.abs(normal), [0, 1, 0], atol=1e-6)
    views.set_plane("Red", "In plane")


def test_without_a_patient_nothing_is_shown(views):
    views.hide_patient()
    assert {background(view) for view in views.slices} == {None}
    assert {view.get_foreground_volume_id() or None for view in views.slices} == {None}
    views.set_plane("Green", "Sagittal")
    normal = matrix_array(
        next(v for v in views.slices if v.get_singleton_tag() == "Green").get_view_node().GetSliceToRAS()
    )
    np.testing.assert_allclose(np.abs(normal[:3, 2]), [1, 0, 0], atol=1e-6)
