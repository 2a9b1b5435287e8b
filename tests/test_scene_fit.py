"""Fitting in a MRML scene: tracked sequences, single images and volumes as nodes; plot, result, images to compare."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

slicer = pytest.importorskip("slicer", reason="Slicer's MRML libraries: pip install '.[slicer]'")

from vtkmodules.util.numpy_support import vtk_to_numpy  # noqa: E402

from benchmarks.twins import make_twin  # noqa: E402
from SlicerUSSim.Logic import PhasedProbe, Preset, SimulationError, TissueTable, Volume  # noqa: E402
from SlicerUSSim.Logic.base.vtk_data import vtk_matrix  # noqa: E402
from SlicerUSSim.Logic.fitting import tracked_fit  # noqa: E402
from SlicerUSSim.Logic.fitting.registration import Registration, rigid_from  # noqa: E402
from SlicerUSSim.Logic.fitting.tracked_fit import Fit  # noqa: E402
from SlicerUSSim.Logic.mri.samples import head_mri  # noqa: E402
from SlicerUSSim.Logic.mrml.fit_nodes import CostPlot  # noqa: E402
from SlicerUSSim.Logic.mrml.label_nodes import write_labels  # noqa: E402
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic  # noqa: E402
from SlicerUSSim.Logic.mrml.nodes import ijk_to_ras, node_to_world, nodes_of_class, read_volume, write_volume  # noqa: E402
from tests.remembered import segment_once  # noqa: E402

PROBE = PhasedProbe(70.0, 50.0, scan_lines=48)


@pytest.fixture(scope="module")
def brain():
    segmentation = segment_once(head_mri(4.0))
    return segmentation, make_twin(
        segmentation.labels, TissueTable.brain(segmentation.tissue_names), 3, probe=PROBE, frames=3
    )


class Scene:
    """A patient with a tracked sequence: image under ImageToProbe (fixed) under ProbeToReference (recorded)."""

    def __init__(self, brain, step_s: float = 0.5) -> None:
        segmentation, twin = brain
        self.twin = twin
        self.scene = scene = slicer.vtkMRMLScene()
        self.sequences = slicer.vtkSlicerSequencesLogic()  # which also registers the browser's class
        self.sequences.SetMRMLScene(scene)
        self.logic = UltrasoundSceneLogic(scene)
        self.labels = scene.AddNewNodeByClass("vtkMRMLLabelMapVolumeNode", "Tissues")
        mri = scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "MRI")
        write_volume(mri, head_mri(4.0))
        write_labels(self.labels, twin.simulator.medium.labels, segmentation.tissue_names, mri)
        self.logic.preset = Preset(
            probe=PROBE, display=twin.display, settings=twin.simulator.settings, tissues=twin.simulator.medium.tissues
        )
        tracked = twin.sequence()
        self.calibration = scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "ImageToProbe")
        self.calibration.SetMatrixTransformToParent(vtk_matrix(tracked.transforms[0]["ImageToProbe"]))
        self.images = scene.AddNewNodeByClass("vtkMRMLSequenceNode", "Images")
        self.poses = scene.AddNewNodeByClass("vtkMRMLSequenceNode", "ProbeToReference")
        for node in (self.images, self.poses):
            node.SetNumericIndexValueTolerance(1e-9)  # while they are filled, so that any step is kept
        for number, image in enumerate(tracked.images):
            item = slicer.vtkMRMLScalarVolumeNode()
            write_volume(item, Volume(image[None], np.eye(4)))
            self.images.SetDataNodeAtValue(item, f"{step_s * number}")
            pose = slicer.vtkMRMLLinearTransformNode()
            pose.SetMatrixTransformToParent(vtk_matrix(tracked.transforms[number]["ProbeToReference"]))
            self.poses.SetDataNodeAtValue(pose, f"{step_s * number}")
        for node in (self.images, self.poses):
            node.SetNumericIndexValueTolerance(1e-3)  # as they come
        self.browser = scene.AddNewNodeByClass("vtkMRMLSequenceBrowserNode", "Sweep")
        self.browser.SetAndObserveMasterSequenceNodeID(self.images.GetID())
        self.browser.AddSynchronizedSequenceNodeID(self.poses.GetID())
        shown = scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "Image")
        probe = scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "ProbeToReference now")
        self.browser.AddProxyNode(shown, self.images, False)
        self.browser.AddProxyNode(probe, self.poses, False)
        shown.SetAndObserveTransformNodeID(self.calibration.GetID())
        self.calibration.SetAndObserveTransformNodeID(probe.GetID())

    def optimize(self, images=None, **options):
        options = {"max_evaluations": 30, "restarts": 0, "free": ["display"], **options}
        return self.logic.optimize(self.labels, images or self.images, **options)

    def volume(self, name: str):
        return self.scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", name)


@pytest.fixture(scope="module")
def scene(brain):
    return Scene(brain)


@pytest.fixture(scope="module")
def found(scene):
    return scene.optimize(plot=CostPlot(scene.scene))


def test_a_tracked_sequence_is_fitted_where_its_transforms_say(scene, found):
    assert found.tracked.numbers == [0, 1, 2]
    for pose, expected in zip(found.tracked.poses, scene.twin.poses, strict=True):
        assert np.allclose(pose[:3, 3], expected[:3, 3], atol=0.5)  # to a pixel or two: the face is found in the image
        assert np.allclose(pose[:3, :3], expected[:3, :3], atol=1e-5)
    assert found.appearance.cost_after < found.appearance.cost_before
    (chart,) = nodes_of_class(scene.scene, "vtkMRMLPlotChartNode")
    assert chart.GetNumberOfPlotSeriesNodes() == 2
    table = chart.GetNthPlotSeriesNode(0).GetTableNode().GetTable()
    cost, best = (vtk_to_numpy(table.GetColumnByName(name)) for name in ("cost", "best"))
    assert table.GetNumberOfRows() >= 20 and cost.min() == pytest.approx(best.min())


@pytest.mark.slow
def test_images_at_almost_the_same_time_keep_their_own_transforms(brain, scene, found):
    own = Scene(brain, step_s=3e-4)
    poses = own.optimize(max_evaluations=1).tracked.poses
    for pose, expected in zip(poses, found.tracked.poses, strict=True):
        np.testing.assert_allclose(pose, expected, atol=1e-9)


def test_frames_are_chosen_by_number(scene):
    assert scene.optimize(frames=[2], max_evaluations=10).tracked.numbers == [2]
    with pytest.raises(SimulationError, match="image 9 does not exist, expected 0 to 2"):
        scene.optimize(frames=[9])


@pytest.mark.slow
def test_images_that_are_not_fitted_are_predicted(scene):
    found = scene.optimize(validate=[1], max_evaluations=20)
    assert found.tracked.numbers == [0, 2] and found.prediction is not None
    assert found.prediction.numbers == [1]
    assert len(found.prediction.predicted["real neighbours"]) == 2
    with pytest.raises(SimulationError, match="is not a sequence, expected one to predict other images"):
        scene.optimize(scene.volume("none"), validate=[1])


@pytest.mark.slow
def test_a_fit_is_applied_and_reverted_without_what_was_set_since(brain):
    """Revert dropped a tissue's value that was typed in the meantime."""
    own = Scene(brain)
    before = own.logic.preset
    found = own.optimize(free=["gain_db", "white matter.mu0"])
    assert own.logic.preset == before
    was = own.logic.applyFit(found)
    after, csf = own.logic.preset, before.tissues.tissue("csf")
    assert was == before and after.display.gain_db == found.appearance.after["gain_db"]
    assert after.tissues.tissue("white matter").mu0 == found.appearance.after["white matter.mu0"]
    assert own.logic.revertFit(found, was) == [] and own.logic.preset == before
    own.logic.applyFit(found)
    typed = replace(csf, mu0=0.33, sources={})
    own.logic.preset = replace(after, tissues=after.tissues.with_tissue(typed)).changed("probe", frequency_mhz=3.0)
    assert own.logic.revertFit(found, was) == ["probe frequency_mhz", "csf mu0"]
    expected = replace(before, tissues=before.tissues.with_tissue(typed)).changed("probe", frequency_mhz=3.0)
    assert own.logic.preset == expected and own.logic.preset.display == before.display
    assert "mu0" not in own.logic.preset.tissues.tissue("csf").sources
    assert own.logic.preset.tissues.tissue("white matter").sources == before.tissues.tissue("white matter").sources

    own.logic.preset = was  # and a value that the fit set as well
    own.logic.applyFit(found)
    own.logic.preset = own.logic.preset.changed("display", gain_db=-7.5)
    assert own.logic.revertFit(found, was) == ["display gain_db"]
    assert own.logic.preset == before.changed("display", gain_db=-7.5)

    own.logic.preset = was  # with another probe, whose values are not those of the fit's
    own.logic.applyFit(found)
    linear = own.logic.preset.changed("probe", kind="linear").probe
    own.logic.preset = replace(own.logic.preset, probe=linear)
    assert own.logic.revertFit(found, was) == ["probe"]
    assert own.logic.preset == replace(before, probe=linear)


def test_images_to_compare_lie_where_the_real_one_does(scene, found):
    nodes = {name: scene.volume(name) for name in ("real", "before", "after", "difference")}
    scene.logic.showFit(found, scene.labels, nodes, 1)
    real = read_volume(nodes["real"]).array[0]
    assert np.array_equal(real, np.where(found.tracked.mask, found.tracked.images[1], 0))
    assert np.array_equal(read_volume(nodes["after"]).array[0], found.after[1])
    # A pixel of the real image is where the tracked one is.
    whole, cropped = scene.twin.references[1], np.argwhere(real == real.max())[0]
    at = ijk_to_ras(nodes["real"]) @ [cropped[1], cropped[0], 0, 1]
    pose = scene.twin.sequence().pose(1, "ImageToReference")
    pixel = np.linalg.inv(pose) @ at
    assert whole[round(pixel[1]), round(pixel[0])] == real.max()
    scene.logic.showFit(found, scene.labels, nodes, 0)  # its own are replaced
    mine = scene.volume("mine")
    write_volume(mine, read_volume(nodes["real"]))
    after = read_volume(nodes["after"]).array.copy()
    with pytest.raises(SimulationError, match="volume for real Volume 'mine' has data that this module did not make"):
        scene.logic.showFit(found, scene.labels, {"after": nodes["after"], "real": mine}, 1)
    assert np.array_equal(read_volume(nodes["after"]).array, after)
    with pytest.raises(SimulationError, match="image 7 was not fitted, expected one of 0, 1, 2"):
        scene.logic.showFit(found, scene.labels, nodes, 7)


@pytest.mark.slow
def test_moved_patient_and_tracking_together_change_nothing(brain, found):
    moved = np.array([[0, -1, 0, 10], [1, 0, 0, -20], [0, 0, 1, 30], [0, 0, 0, 1.0]])
    own = Scene(brain)
    room = own.scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "Room")
    room.SetMatrixTransformToParent(vtk_matrix(moved))
    own.labels.SetAndObserveTransformNodeID(room.GetID())
    own.calibration.GetParentTransformNode().SetAndObserveTransformNodeID(room.GetID())
    again = own.optimize()
    assert again.appearance.after == pytest.approx(found.appearance.after, abs=0.05)
    nodes = {"real": own.volume("real")}
    own.logic.showFit(again, own.labels, nodes, 0)
    still = Scene(brain)
    other = {"real": still.volume("real")}
    still.logic.showFit(found, still.labels, other, 0)
    assert np.allclose(ijk_to_ras(nodes["real"]), moved @ ijk_to_ras(other["real"]), atol=1e-3)


def test_a_single_image_is_fitted_where_it_lies(scene):
    image = scene.volume("single")
    tracked = scene.twin.sequence()
    write_volume(image, Volume(tracked.images[0][None], tracked.pose(0, "ImageToReference")))
    found = scene.optimize(image, max_evaluations=20)
    assert np.allclose(found.tracked.poses[0][:3, 3], scene.twin.poses[0][:3, 3], atol=0.5)


def test_a_3d_volume_is_cut_where_the_probe_is(scene):
    volume = scene.volume("3D ultrasound")
    simulator = scene.twin.simulator
    write_volume(volume, simulator.volume(PROBE, scene.twin.poses, scene.twin.display, spacing_mm=1.0))
    with pytest.raises(SimulationError, match="is a 3D volume, expected a probe transform"):
        scene.optimize(volume)
    probe = scene.scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "Probe")
    probe.SetMatrixTransformToParent(vtk_matrix(scene.twin.poses[1]))
    found = scene.optimize(volume, probe_transform_node=probe, max_evaluations=20)
    assert np.allclose(found.tracked.poses[0], scene.twin.poses[1], atol=1e-6)


@pytest.mark.slow
def test_geometry_can_be_estimated(scene):
    scene_preset = scene.logic.preset
    try:
        scene.logic.preset = replace(scene_preset, probe=replace(PROBE, depth_mm=90.0, frequency_mhz=4.0))
        with pytest.raises(SimulationError, match="the probe's depth is 90 mm, expected"):
            scene.optimize()
        found = scene.optimize(estimate_geometry=True, max_evaluations=20)
        assert found.tracked.probe.depth_mm == pytest.approx(50.0, abs=1.0)
        assert found.tracked.probe.frequency_mhz == 4.0 and found.tracked.probe.scan_lines == 48
    finally:
        scene.logic.preset = scene_preset


@pytest.mark.slow
def test_registration_is_written_as_a_transform_of_the_tracking(brain, monkeypatch):
    monkeypatch.setattr(tracked_fit, "_ROUNDS", ((8.0, 10),))  # how well: test_registration
    own = Scene(brain)
    away = np.eye(4)
    away[:3, 3] = 1.5, -1.0, 2.0
    first = own.calibration.GetParentTransformNode()
    room = own.scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "off")
    room.SetMatrixTransformToParent(vtk_matrix(away))
    first.SetAndObserveTransformNodeID(room.GetID())
    found = own.optimize(register=True, max_evaluations=5)
    registration = own.scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "registration")
    own.logic.writeRegistration(found, own.labels, registration)
    assert np.allclose(node_to_world(registration), found.registration.correction)
    assert found.registration.cost_after <= found.registration.cost_before


def test_a_registration_of_moved_labels_is_written_for_where_they_are(brain):
    """What moves a point of the ultrasound beside the labels moves it in the room as well."""
    own = Scene(brain)
    room = own.scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "room")
    to_world = rigid_from([30, -10, 5, 20, -35, 50])
    room.SetMatrixTransformToParent(vtk_matrix(to_world))
    own.labels.SetAndObserveTransformNodeID(room.GetID())
    correction = rigid_from([1, -2, 3, 10, 5, -15])
    moved = Registration(correction, [], np.zeros(3), 0.0, 0.5, 0.4, [])
    node = own.scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "registration")
    own.logic.writeRegistration(Fit(None, moved, None, [], []), own.labels, node)
    point = np.array([12.0, -7.0, 3.0, 1.0])  # in the frame of the labels
    own.logic.writeRegistration(Fit(None, moved, None, [], []), own.labels, node)  # its own is replaced
    with pytest.raises(SimulationError, match="registration LinearTransform 'room' has data that this module did not"):
        own.logic.writeRegistration(Fit(None, moved, None, [], []), own.labels, room)
    assert np.allclose(node_to_world(room), to_world)
    assert np.allclose(node_to_world(node) @ to_world @ point, to_world @ correction @ point, atol=1e-6)


def test_bad_nodes_are_one_clear_line(scene):
    empty = scene.scene.AddNewNodeByClass("vtkMRMLSequenceNode", "empty")
    transforms = scene.scene.AddNewNodeByClass("vtkMRMLSequenceNode", "transforms")
    transforms.SetDataNodeAtValue(slicer.vtkMRMLLinearTransformNode(), "0")
    for images, message in (
        (None, "no real images chosen"),
        (empty, "is empty, expected images"),
        (transforms, "item 0 of"),
        (scene.labels, "3D volume"),
        (scene.volume("nothing"), "has no image data"),
    ):
        with pytest.raises(SimulationError) as caught:
            scene.logic.optimize(scene.labels, images)
        assert message in str(caught.value) and "\n" not in str(caught.value)
