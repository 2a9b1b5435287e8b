"""Tracked ultrasound in the panel: what a calibration says of the probe's face, and what the panel does with it."""

from __future__ import annotations

from unittest.mock import Mock, call

import numpy as np
import pytest

slicer = pytest.importorskip("slicer", reason="MRML nodes come with slicer-core: pip install '.[slicer]'")

from SlicerUSSim.Logic import SimulationError, Volume  # noqa: E402
from SlicerUSSim.Logic.base.vtk_data import matrix_array, vtk_matrix  # noqa: E402
from SlicerUSSim.Logic.mrml.label_nodes import write_labels  # noqa: E402
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic  # noqa: E402
from SlicerUSSim.Logic.mrml.nodes import node_to_world, probe_pose, write_volume  # noqa: E402
from SlicerUSSim.Logic.probe.arrays import PROBES  # noqa: E402
from SlicerUSSim.Logic.probe.image_grid import ImageGrid  # noqa: E402
from SlicerUSSim.Logic.probe.poses import turned  # noqa: E402
from SlicerUSSim.Logic.tracked.images import face_of_calibration  # noqa: E402
from SlicerUSSim.Widget.interface import by_widget  # noqa: E402
from SlicerUSSim.Widget.presenter import PanelPresenter  # noqa: E402
from SlicerUSSim.Widget.sections import panel_sections  # noqa: E402
from tests.conftest import block  # noqa: E402
from tests.test_presenter import PlainView  # noqa: E402

PROBE = PROBES["convex"]
GRID = ImageGrid.for_probe(PROBE, (220, 260))
#: Face to sensor, as a marker is fixed to a probe, and the sensor in the frame of the tracker
FACE_TO_PROBE = turned(np.eye(4), rock_deg=25.0, rotate_deg=70.0)
FACE_TO_PROBE[:3, 3] = [8.0, -95.0, 31.0]
SENSOR = turned(np.eye(4), tilt_deg=-40.0)
SENSOR[:3, 3] = [12.0, 20.0, -30.0]
IMAGE_TO_PROBE = FACE_TO_PROBE @ GRID.image_to_probe
IMAGE = np.where(GRID.field(PROBE), 90, 0).astype(np.uint8)


def transform(scene, name: str, matrix: np.ndarray):
    node = scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", name)
    node.SetMatrixTransformToParent(vtk_matrix(matrix))
    return node


@pytest.fixture
def panel():
    scene = slicer.vtkMRMLScene()
    labels = scene.AddNewNodeByClass("vtkMRMLLabelMapVolumeNode", "Tissues")
    volume = block(lambda x, y, z: 1.0 + (x > 0), half_mm=(60, 60, 60), spacing_mm=4.0)
    write_labels(labels, volume, ["grey matter", "white matter"], labels)
    presenter = PanelPresenter(UltrasoundSceneLogic(scene), PlainView())
    presenter.logic.preset = presenter.logic.preset.changed("probe", kind="linear", scan_lines=16, depth_mm=30.0)
    presenter.parameters.labels = labels
    presenter.parameters.tracked = transform(scene, "ProbeToReference", SENSOR)
    return presenter


def slice_view(panel):
    """(view, its layers) of the panel."""
    view, composite = (panel.logic.scene.AddNewNodeByClass(f"vtkMRMLSlice{kind}Node") for kind in ("", "Composite"))
    view.SetLayoutName("Red")
    composite.SetLayoutName("Red")
    panel.view.sliceNode = lambda: view
    return view, composite


def streamed(scene):
    """As Plus sends Image_Image: in pixels."""
    node = scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "Image_Image")
    write_volume(node, Volume(IMAGE[None], np.eye(4)))
    return node


def test_the_face_is_given_found_in_the_image_or_in_its_first_row():
    pixel = np.linalg.inv(GRID.image_to_probe)[:2, 3].tolist()
    pose, words = face_of_calibration(IMAGE_TO_PROBE, face_pixel=pixel)
    assert np.allclose(pose, FACE_TO_PROBE, atol=1e-9) and "(as given)" in words
    assert words.startswith("pixels of {:.3g} x {:.3g} mm; ".format(*GRID.pixel_spacing_mm))
    pose, words = face_of_calibration(IMAGE_TO_PROBE, IMAGE[None])
    assert np.allclose(pose, FACE_TO_PROBE, atol=0.6) and "of a field" in words
    _, words = face_of_calibration(IMAGE_TO_PROBE, np.zeros((1, 220, 260), np.uint8))
    assert "; face at column 129.5, row -0.5 (the middle of the first row, no field was found); " in words
    pose, words = face_of_calibration(IMAGE_TO_PROBE @ np.diag([1.0, 1.0, -1.0, 1.0]), face_pixel=(10, 0))
    assert "; the calibration mirrors: " in words and np.linalg.det(pose) > 0 and "check" not in words
    _, words = face_of_calibration(IMAGE_TO_PROBE, IMAGE[None], (5000, 10))
    _, far = face_of_calibration(np.eye(4) + 600.0 * np.eye(4, k=3), face_pixel=(10, 0))
    assert "; check: the face is outside of the image" in words and "; check: " in far


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (np.diag([1e-3, 1e-3, 1e-3, 1.0]), "is it in metres"),
        (np.eye(4) + 0.3 * np.eye(4)[[1, 0, 2, 3]] * np.array([1, 0, 0, 0]), "is skewed"),
        (np.diag([0.0, 1.0, 1.0, 1.0]), "is singular"),
    ],
)
def test_a_calibration_in_metres_or_skewed_is_refused(change, words):
    with pytest.raises(SimulationError, match=words):
        face_of_calibration(change @ GRID.image_to_probe, face_pixel=(130, 0))


def test_a_tracker_moves_the_face_and_the_streamed_image_lies_in_its_plane(panel):
    scene, parameters = panel.logic.scene, panel.parameters
    parameters.calibration = transform(scene, "ImageToProbe", IMAGE_TO_PROBE)
    parameters.real = streamed(scene)
    view, composite = slice_view(panel)
    panel.tracking.useCalibration()
    assert composite.GetBackgroundVolumeID() == parameters.real.GetID() and panel.fits.canBlink()
    face = parameters.probe_transform
    assert not panel.view.errors and face.GetName() == "Probe face"
    assert np.allclose(probe_pose(face), SENSOR @ FACE_TO_PROBE, atol=0.6)
    assert "'ImageToProbe' below 'ProbeToReference': pixels of" in panel.tracking.text()
    assert np.allclose(node_to_world(parameters.real), SENSOR @ IMAGE_TO_PROBE)
    panel.images.setLive(True)
    moved = turned(SENSOR, rock_deg=10.0)  # as while a sequence plays
    parameters.tracked.SetMatrixTransformToParent(vtk_matrix(moved))
    panel.view.waiting.pop()()
    assert np.allclose(panel.logic.taken.probe_to_world, probe_pose(face)) and not panel.view.errors
    assert np.allclose(matrix_array(view.GetSliceToRAS())[:3, 0], probe_pose(face)[:3, 0])
    panel.placing.placeAtView()
    assert "the tracker moves the probe" in panel.view.errors[-1]
    assert np.allclose(node_to_world(face), panel.logic.taken.probe_to_world)
    panel.images.setLive(False)


def test_the_difference_to_the_streamed_image_is_shown_and_ends(panel):
    scene, real = panel.logic.scene, streamed(panel.logic.scene)
    colours = slicer.vtkMRMLColorLogic()
    colours.SetMRMLScene(scene)  # Slicer's own tables
    _, composite = slice_view(panel)
    shown = scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "Ultrasound")
    write_volume(shown, Volume(IMAGE[None], np.eye(4)))
    panel.parameters.real = real
    panel.fits.showDifference(True)  # of nothing
    composite.SetForegroundVolumeID(shown.GetID())
    panel.fits.showDifference(True)
    assert shown.GetDisplayNode().GetColorNode().GetName() == "InvertedGrey"
    assert composite.GetForegroundOpacity() == 0.5  # of the inverted one, and of the real one: grey where they agree
    panel.fits.showDifference(False)
    assert shown.GetDisplayNode().GetColorNode().GetName() == "Grey" and composite.GetForegroundOpacity() == 1.0


def test_a_plus_configuration_or_typed_numbers_are_a_calibration(panel, tmp_path):
    numbers = " ".join(f"{value:.9g}" for value in IMAGE_TO_PROBE.ravel())
    panel.values.setValue("scene.face_pixel", "129.5, 3")
    config = f'<PlusConfiguration><Transform From="Image" To="Probe" Matrix="{numbers}"/></PlusConfiguration>'
    (tmp_path / "plus.xml").write_text(config)
    for text in (numbers, str(tmp_path / "plus.xml")):
        panel.values.setValue("scene.calibration_text", text)
        panel.parameters.probe_transform = None
        panel.tracking.useCalibration()
        assert not panel.view.errors and "column 129.5, row 3.0 (as given)" in panel.tracking.text()
        expected = SENSOR @ IMAGE_TO_PROBE @ [129.5, 3.0, 0.0, 1.0]
        assert np.allclose(probe_pose(panel.parameters.probe_transform)[:3, 3], expected[:3], atol=1e-4)


def test_what_is_missing_or_wrong_is_said(panel):
    panel.tracking.useCalibration()
    panel.values.setValue("scene.calibration_text", "1 2 3")
    panel.tracking.useCalibration()
    panel.parameters.calibration = transform(panel.logic.scene, "ImageToProbe", IMAGE_TO_PROBE)
    panel.tracking.useCalibration()
    panel.values.setValue("scene.face_pixel", "left")
    panel.tracking.useCalibration()
    panel.parameters.tracked = None
    panel.tracking.useCalibration()
    words = "no calibration", "expected 16", "face is in the image is not known", "expected a column", "no tracked"
    assert len(panel.view.errors) == 5
    assert all(word in error for word, error in zip(words, panel.view.errors, strict=True)), panel.view.errors
    for chosen in (panel.parameters.calibration, transform(panel.logic.scene, "ProbeToTracker", SENSOR)):
        panel.parameters.probe_transform = chosen
        assert panel.tracking.text().startswith(f"Check: {chosen.GetName()!r} is not the pose of the probe's face")


def test_a_page_of_the_browser_cannot_name_a_calibration_file(panel):
    page = PanelPresenter(panel.logic, PlainView(), handles=False)
    names = {"calibrationTextLineEdit", "useCalibrationButton", "sendImagesButton"}
    assert names <= set(by_widget(panel_sections(panel))) and not names & set(by_widget(panel_sections(page)))


def test_a_slice_view_that_volume_reslice_driver_moves_stays(panel):
    scene, parameters = panel.logic.scene, panel.parameters
    parameters.probe_transform = transform(scene, "Probe", SENSOR)
    view, _ = slice_view(panel)
    view.SetAttribute("VolumeResliceDriver.Driver", parameters.tracked.GetID())
    panel.images.simulate()
    assert view.GetSliceToRAS().GetElement(0, 3) == 0.0 and not panel.view.errors
    assert "Volume Reslice Driver moves this slice view" in panel.tracking.text()
    view.RemoveAttribute("VolumeResliceDriver.Driver")
    panel.images.simulate()
    assert view.GetSliceToRAS().GetElement(0, 3) != 0.0 and panel.tracking.text() == ""


def test_the_image_and_the_probe_are_sent_by_openigtlinkif(panel, monkeypatch):
    parameters, connector = panel.parameters, Mock()
    parameters.probe_transform = transform(panel.logic.scene, "Probe", SENSOR)
    panel.tracking.sendImages()
    panel.images.simulate()
    panel.tracking.sendImages()
    words = "no image yet", "install the extension SlicerOpenIGTLink"
    assert all(word in error for word, error in zip(words, panel.view.errors, strict=True))
    monkeypatch.setattr(panel.logic.scene, "AddNewNodeByClass", lambda *_: connector)
    panel.tracking.sendImages()
    assert len(panel.view.errors) == 2
    outgoing = [call.RegisterOutgoingMRMLNode(node) for node in (parameters.output, parameters.probe_transform)]
    assert connector.mock_calls == [call.SetTypeServer(18944), *outgoing, call.Start()]
