"""A scene as plain values and back, as scene files are read into them by a child process."""

from __future__ import annotations

import io
import pickle
from dataclasses import replace

import numpy as np
import pytest

slicer = pytest.importorskip("slicer", reason="MRML nodes come with slicer-core: pip install '.[slicer]'")

from SlicerUSSim.Logic import SimulationError, Volume  # noqa: E402
from SlicerUSSim.Logic.base import reading  # noqa: E402
from SlicerUSSim.Logic.base.errors import required  # noqa: E402
from SlicerUSSim.Logic.base.vtk_data import vtk_matrix  # noqa: E402
from SlicerUSSim.Logic.imaging.preset import Preset  # noqa: E402
from SlicerUSSim.Logic.mri.samples import head_mri  # noqa: E402
from SlicerUSSim.Logic.mri.segmentation_settings import SegmentationSettings  # noqa: E402
from SlicerUSSim.Logic.mrml.label_nodes import write_labels  # noqa: E402
from SlicerUSSim.Logic.mrml.lesion_nodes import add_lesion, read_lesions  # noqa: E402
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic  # noqa: E402
from SlicerUSSim.Logic.mrml.nodes import node_to_world, write_volume  # noqa: E402
from SlicerUSSim.Logic.mrml.scene_record import (  # noqa: E402
    NodeRecord,
    SceneRecord,
    put_nodes,
    put_values,
    record_nodes,
    record_scene,
    recorded_values,
)
from SlicerUSSim.Logic.mrml.sequence_nodes import (  # noqa: E402
    KnownField,
    add_sequence,
    write_known_field,
)
from SlicerUSSim.Logic.mrml.taken_image import is_frozen  # noqa: E402
from SlicerUSSim.Logic.mrml.taken_sequence import put_taken, record_frozen, taken_of  # noqa: E402
from SlicerUSSim.Logic.probe.image_grid import ImageGrid  # noqa: E402
from SlicerUSSim.Logic.tracked.images import TrackedImages  # noqa: E402
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence  # noqa: E402

pytestmark = pytest.mark.usefixtures("segmented_once")


def add(scene, kind: str, name: str = ""):
    return scene.AddNewNodeByClass(f"vtkMRML{kind}Node", name or kind)


def segmented(kind: str = "LabelMapVolume") -> UltrasoundSceneLogic:
    """A scene with a head, its tissues with a tumour on top, a probe and an image."""
    logic = UltrasoundSceneLogic(slicer.vtkMRMLScene())
    scene, parameters = logic.scene, logic.parameters
    mri = head_mri(4.0)
    node, labels, lesions = add(scene, "ScalarVolume", "head"), add(scene, kind, "tissues"), add(scene, "Segmentation")
    turned = np.array([[0, -1, 0, 5.0], [1, 0, 0, -3.0], [0, 0, 1, 7.0], [0, 0, 0, 1]])
    tilt = add(scene, "LinearTransform", "registration")
    tilt.SetMatrixTransformToParent(vtk_matrix(turned))
    write_volume(node, mri)
    node.SetAndObserveTransformNodeID(tilt.GetID())
    lesions.SetAndObserveTransformNodeID(tilt.GetID())
    tumour = np.zeros(mri.array.shape, np.uint8)
    middle = np.array(mri.array.shape) // 2
    tumour[tuple(slice(m - 2, m + 3) for m in middle)] = 1
    add_lesion(lesions, mri.with_array(tumour), "tumour", "tumour.nii.gz")
    parameters.mri, parameters.labels, parameters.lesions = node, labels, lesions
    logic.segment(node, labels, lesions_node=lesions)
    parameters.probe_transform, parameters.output = add(scene, "LinearTransform"), add(scene, "ScalarVolume")
    logic.placeProbe(labels, parameters.probe_transform)
    logic.preset = Preset().changed("display", gain_db=4.0).changed("probe", depth_mm=60.0)
    parameters.segmentation = SegmentationSettings("t2")
    return logic


def simulated_sequence(logic: UltrasoundSceneLogic):
    """The node with two images at the pose of the probe."""
    scene, parameters = logic.scene, logic.parameters
    transforms, images = add(scene, "Sequence", "sweep"), add(scene, "Sequence", "sweep ultrasound")
    for number in range(2):
        item = slicer.vtkMRMLLinearTransformNode()
        item.SetMatrixTransformToParent(vtk_matrix(node_to_world(parameters.probe_transform)))
        transforms.SetDataNodeAtValue(item, f"{0.1 * number:g}")
    logic.simulateSequence(parameters.labels, transforms, images)
    parameters.image_sequence = images
    return images


def image_of(logic: UltrasoundSceneLogic) -> np.ndarray:
    chosen = logic.parameters
    if chosen.output is None:
        chosen.output = add(logic.scene, "ScalarVolume")
    return logic.simulate(chosen.labels, chosen.probe_transform, chosen.output).image


def written_and_read(record: SceneRecord) -> SceneRecord:
    return reading._Safe(io.BytesIO(pickle.dumps(record))).load()  # as it comes from a child process


def in_new_scene(record: SceneRecord) -> UltrasoundSceneLogic:
    logic = UltrasoundSceneLogic(slicer.vtkMRMLScene())
    nodes = put_nodes(logic.scene, record)
    for role, node in nodes.items():
        if role in ("mri", "labels", "lesions", "mask", "sheets"):
            setattr(logic.parameters, role, node)
    assert put_values(logic.parameters, record.values) == []
    if record.pose is not None:
        logic.parameters.probe_transform = add(logic.scene, "LinearTransform")
        logic.parameters.probe_transform.SetMatrixTransformToParent(vtk_matrix(record.pose))
    return logic


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["LabelMapVolume", "Segmentation"])
def test_a_scene_has_the_same_image_after_it_was_kept_as_values(kind):
    """With the shares of tissues in voxels, lesions, transforms, probe, display and tissues."""
    logic = segmented(kind)
    before = image_of(logic)
    record = written_and_read(record_scene(logic.scene))
    assert set(record.nodes) == {"mri", "labels", "shares", "lesions"} and record.left_out == ()
    again = in_new_scene(record)
    assert np.array_equal(image_of(again), before)
    assert again.parameters.segmentation.contrast == "t2" and again.preset == logic.preset
    np.testing.assert_allclose(node_to_world(again.parameters.mri), node_to_world(logic.parameters.mri))
    assert again.mayReplace(again.parameters.labels)  # it is still what Segment made
    lesions = again.parameters.lesions.GetSegmentation()
    assert [lesions.GetNthSegment(n).GetName() for n in range(lesions.GetNumberOfSegments())] == ["tumour"]
    found, _ = read_lesions(again.parameters.lesions, again.parameters.mri, again.preset.tissues)
    assert [(tissue, source) for tissue, _, source in found] == [("tumour", "tumour.nii.gz (segment 'tumour')")]


def test_a_record_copies_no_voxels():
    logic = segmented()
    parameters = logic.parameters
    record = record_nodes(parameters)
    mri = Volume.from_vtk(parameters.mri.GetImageData(), np.eye(4)).array
    assert np.shares_memory(required(record["mri"].volume, "none").array, mri)
    labels = required(record["labels"].volume, "none")
    kept = labels.array.copy()
    write_labels(parameters.labels, labels.with_array(kept * 0 + 1), ["bone"], parameters.mri)
    assert np.array_equal(labels.array, kept)  # it is replaced and not changed


def test_a_scene_without_choices_has_its_first_volume_as_mri():
    scene = slicer.vtkMRMLScene()
    for name in ("one", "two"):
        write_volume(add(scene, "ScalarVolume", name), head_mri(4.0))
    record = record_scene(scene)
    assert record.nodes["mri"].name == "one" and record.left_out == ("two",) and record.pose is None
    with pytest.raises(SimulationError, match="the scene has no volume, expected an MRI"):
        record_scene(slicer.vtkMRMLScene())


def test_values_of_other_versions_are_reported_and_have_their_default():
    logic = segmented()
    values = {**recorded_values(logic.parameters), "contrast": "t9", "what_is_that": "1"}
    again = UltrasoundSceneLogic(slicer.vtkMRMLScene())
    lines = put_values(again.parameters, values)
    assert len(lines) == 1 and lines[0].startswith("Contrast in the scene is 't9', expected one of t1")
    assert again.parameters.segmentation.contrast == "t1" and again.preset == logic.preset
    assert put_values(again.parameters, {}) == [] and again.preset == Preset()


def test_what_does_not_fit_together_leaves_nothing_in_the_scene():
    scene = slicer.vtkMRMLScene()
    wrong = NodeRecord("vtkMRMLCameraNode", "camera", {}, np.eye(4))
    good = NodeRecord("vtkMRMLScalarVolumeNode", "mri", {}, 2 * np.eye(4) - np.diag([0, 0, 0, 1.0]), head_mri(4.0))
    before = scene.GetNumberOfNodes()
    with pytest.raises(SimulationError, match="which is not kept"):
        put_nodes(scene, SceneRecord({"mri": good, "mask": wrong}))
    assert scene.GetNumberOfNodes() == before


def test_images_of_a_sequence_and_lesions_there_and_back():
    logic = segmented()
    parameters, scene = logic.parameters, logic.scene
    images = simulated_sequence(logic)
    mri = head_mri(4.0)
    mask = np.zeros(mri.array.shape, np.uint8)
    mask[20:23, 20:25, 20:24] = 1
    lesions = add(scene, "Segmentation", "Lesions")
    add_lesion(lesions, mri.with_array(mask), "tumour", "tumour")
    parameters.lesions = lesions
    before = record_scene(scene)
    assert before.simulated is not None
    record = written_and_read(before)
    other = UltrasoundSceneLogic(slicer.vtkMRMLScene())
    made = put_nodes(other.scene, record)
    segmentation = made["lesions"].GetSegmentation()
    assert segmentation.GetNumberOfSegments() == 1 and segmentation.GetNthSegment(0).GetName() == "tumour"
    sequence = put_taken(other.scene, record.simulated)
    for number in range(2):
        old, new = logic.sequenceImage(images, number), other.sequenceImage(sequence, number)
        assert np.array_equal(old.image, new.image) and old.about() == new.about() and new.grid == old.grid
        assert np.array_equal(old.probe_to_world, new.probe_to_world)
        assert sequence.GetNthIndexValue(number) == images.GetNthIndexValue(number)
        assert new.anatomy is None  # which may have changed
    # What does not go together is refused, and nothing of it stays.
    count = other.scene.GetNumberOfNodesByClass("vtkMRMLSequenceNode")
    with pytest.raises(SimulationError, match=r"of a sequence is|images of"):
        put_taken(other.scene, replace(record.simulated, images=record.simulated.images[:1]))
    assert other.scene.GetNumberOfNodesByClass("vtkMRMLSequenceNode") == count


def live_update(logic: UltrasoundSceneLogic) -> None:
    chosen = logic.parameters
    logic.startLiveUpdate(chosen.labels, chosen.probe_transform, chosen.output)


def test_a_scene_tells_a_frozen_image_from_a_live_one():
    """Both are where the probe is if that has not moved, and the frozen one came back live."""
    logic = segmented()
    live_update(logic)
    output = logic.parameters.output
    with logic.imageHeld():
        assert is_frozen(output) and record_scene(logic.scene).frozen is None
    assert not is_frozen(output) and logic.isLive
    logic.stopLiveUpdate()
    taken = required(logic.taken, "no image")
    logic.preset = logic.preset.changed("display", gain_db=-9.0)
    with logic.imageHeld():
        record = required(written_and_read(record_scene(logic.scene)).frozen, "no frozen image")
    assert np.array_equal(record.image, taken.image) and record.number is None and is_frozen(output)
    assert np.array_equal(record.pose, taken.probe_to_world)  # with all digits, which the noise of a script follows


def test_an_image_of_a_sequence_keeps_its_number_the_seed_of_its_noise():
    logic = segmented()
    parameters, scene = logic.parameters, logic.scene
    images = simulated_sequence(logic)
    taken = logic.showSequenceImage(images, 1, parameters.output)
    assert logic.areOfTissues() == (True, True)
    record = required(written_and_read(record_scene(scene)).frozen, "no frozen image")
    assert record.number == taken.number == 1 and taken_of(record, parameters.output).number == 1
    again = logic.showFrozen(record, parameters.output)
    assert again.number == 1 and np.array_equal(again.image, taken.image)
    logic.simulate(parameters.labels, parameters.probe_transform, parameters.output)
    logic.holdImage(parameters.output)
    assert required(record_frozen(parameters.output), "no frozen image").number is None


def recorded_images(scene):
    """(images node, TrackedImages) of a recording whose probe has a depth of 60 mm."""
    probe = replace(Preset().probe, depth_mm=60.0)
    grid = ImageGrid.for_probe(probe, None)
    generator = np.random.default_rng(1)
    images = (generator.integers(40, 250, (3, grid.rows, grid.columns)) * grid.field(probe)).astype(np.uint8)
    place = grid.slice_to_probe
    poses = [np.array([[0, 0, 1, 4.0], [1, 0, 0, 2.0 * n], [0, 1, 0, 30.0], [0, 0, 0, 1]]) for n in range(3)]
    entries = tuple({"ImageToReference": pose @ place} for pose in poses)
    sequence = TrackedSequence(images, entries, np.arange(3.0))
    to_ras = np.array([[0, -1, 0, 5.0], [1, 0, 0, -3.0], [0, 0, 1, 7.0], [0, 0, 0, 1]])
    tracked = TrackedImages.of(sequence, reference_to_ras=to_ras)
    _, node = add_sequence(scene, sequence, "sweep", to_ras=to_ras, poses=tracked.poses)
    return node, tracked, to_ras


def test_real_images_keep_their_probe_and_registration():
    """A depth that a user had set since was mistaken for a wrong calibration, and the registration for none."""
    logic = UltrasoundSceneLogic(slicer.vtkMRMLScene())
    sequences = slicer.vtkSlicerSequencesLogic()  # which also registers the browser's class
    sequences.SetMRMLScene(logic.scene)
    logic.parameters.mri = add(logic.scene, "ScalarVolume", "head")
    write_volume(logic.parameters.mri, head_mri(5.0))
    node, tracked, to_ras = recorded_images(logic.scene)
    write_known_field(node, KnownField(tracked.field, to_ras))
    logic.parameters.real = node
    logic.preset = logic.preset.changed("probe", depth_mm=45.0)
    record = required(written_and_read(record_scene(logic.scene)).sequence, "no sequence")
    np.testing.assert_allclose(record.to_ras, to_ras)
    again = TrackedImages.of(record.sequence, reference_to_ras=record.to_ras, field=record.field)
    assert again.probe == tracked.probe and np.array_equal(again.mask, tracked.mask) and again.grid == tracked.grid
    np.testing.assert_allclose(again.poses, tracked.poses, atol=1e-9)
    # An older scene has neither, and is nevertheless where it was
    node.SetAttribute("SlicerUSSim.field", None)
    record = required(record_scene(logic.scene).sequence, "no sequence")
    assert record.field is None and record.to_ras is None
    np.testing.assert_allclose(TrackedImages.of(record.sequence).poses, tracked.poses, atol=1e-6)
    node.SetAttribute("SlicerUSSim.field", '{"probe": {}}')
    with pytest.raises(SimulationError, match=r"'sweep': its attribute SlicerUSSim\.field is damaged"):
        record_scene(logic.scene)
