"""The slice views beside the image: each is what it is called on the page, and shows the patient that is there."""

from __future__ import annotations

import numpy as np
import pytest

slicer = pytest.importorskip("slicer", reason="MRML nodes come with slicer-core: pip install '.[slicer]'")
pytest.importorskip("trame_slicer", reason="the workstation comes with: pip install '.[serve]'")

from trame.app import get_server  # noqa: E402
from trame_slicer.core import SlicerApp  # noqa: E402
from vtkmodules.util.numpy_support import vtk_to_numpy  # noqa: E402

from SlicerUSSim.Logic import PhasedProbe, Volume  # noqa: E402
from SlicerUSSim.Logic.base.vtk_data import matrix_array  # noqa: E402
from SlicerUSSim.Logic.mrml.nodes import write_volume  # noqa: E402
from SlicerUSSim.Logic.probe.poses import pose_looking_at  # noqa: E402
from SlicerUSSim.Logic.probe.shape import probe_polydata  # noqa: E402
from SlicerUSSim.Logic.probe.surface import PatientSurface  # noqa: E402
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
    assert views.planes == {"Red": "In plane", "Green": "Axial"}
    green = by_name["Green"].get_view_node()
    np.testing.assert_allclose(np.abs(matrix_array(green.GetSliceToRAS())[:3, :3]), np.abs(AXIAL), atol=1e-6)
    node = views.app.scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "head")
    write_volume(node, Volume(np.ones((20, 20, 20), np.float32), np.diag([5.0, 5.0, 5.0, 1.0])))
    views.show_volume(node)
    np.testing.assert_allclose(np.abs(matrix_array(green.GetSliceToRAS())[:3, :3]), np.abs(AXIAL), atol=1e-6)
    assert background(by_name["Green"]) == node.GetID()
    assert background(by_name["Red"]) is None  # without a probe no plane
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


def in_view(view, points: np.ndarray) -> np.ndarray:
    """(n, 2) shares of the width and height at which a 3D view shows (n, 3) points, 0 to 1 if it does."""
    renderer, (width, height) = view.renderer(), view.render_window().GetSize()
    camera = renderer.GetActiveCamera()
    matrix = matrix_array(camera.GetCompositeProjectionTransformMatrix(width / height, -1.0, 1.0))
    found = np.c_[points, np.ones(len(points))] @ matrix.T
    return 0.5 + 0.5 * found[:, :2] / found[:, 3:]


@pytest.mark.parametrize("size", [(300, 270), (200, 600), (1200, 250), (60, 400)])
def test_the_camera_sees_head_and_probe_at_every_size(views, size):
    """It was always at 540 mm, where the probe was cut off in a narrow view."""
    axis = np.arange(-84.0, 84.5, 4.0)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    matrix = np.diag([4.0, 4.0, 4.0, 1.0])
    matrix[:3, 3] = axis[0]
    surface = PatientSurface(Volume((x**2 + y**2 + z**2 <= 80.0**2).astype(np.uint8), matrix))
    probe, pose = PhasedProbe(75.0, 70.0), pose_looking_at((60.0, 0.0, 54.0), (0.0, 0.0, 0.0))
    body = vtk_to_numpy(probe_polydata(probe).GetPoints().GetData()) @ pose[:3, :3].T + pose[:3, 3]
    points = np.vstack([body, vtk_to_numpy(surface.coarse_polydata.GetPoints().GetData())])
    views.threed.update_size(300, 300)
    views.look_at_probe(pose, surface, probe)
    for change in (lambda: None, lambda: views.look_at_probe(pose, surface, probe)):  # resized, and looked at again
        views.threed.update_size(*size)
        views.threed.interactor().InvokeEvent("WindowResizeEvent")
        change()
        shown = in_view(views.threed, points)
        assert shown.min() >= 0.0 and shown.max() <= 1.0
        assert np.ptp(shown, axis=0).max() > 0.6  # and not from far away


def test_a_point_is_at_its_place_in_every_view_and_letters_name_its_sides(views):
    node = views.app.scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "head")
    write_volume(node, Volume(np.ones((20, 20, 20), np.float32), np.diag([5.0, 5.0, 5.0, 1.0])))
    for view in views.slices:
        view.update_size(300, 300)
    views.set_plane("Green", "Axial")
    views.show_volume(node)
    pose = pose_looking_at((50.0, 45.0, 90.0), (50.0, 45.0, 0.0), (1.0, 0.0, 0.0))
    views.follow(pose, PhasedProbe(75.0, 70.0))
    letters = views.letters()
    assert letters["Green"] == ["R", "L", "A", "P"] and letters["Red"][2:] == ["S", "I"]
    left, right = letters["Red"][:2]
    assert {left, right} == {"L", "R"}
    here, up, to_right, aside = (views.places(np.array(at)) for at in (
        (50.0, 45.0, 60.0), (50.0, 45.0, 70.0), (60.0, 45.0, 60.0), (50.0, 55.0, 60.0)))  # fmt: skip
    assert here["Red"][2] == pytest.approx(0.0, abs=1e-6) and aside["Red"][2] == pytest.approx(10.0)
    assert up["Red"][1] < here["Red"][1] and (to_right["Red"][0] > here["Red"][0]) == (right == "R")
    assert to_right["Green"][0] < here["Green"][0] and aside["Green"][1] < here["Green"][1]  # R is at the left
    assert up["ThreeD"] != here["ThreeD"]
    views.hide_patient()
