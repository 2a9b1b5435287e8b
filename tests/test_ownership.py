"""Nodes whose results this module replaces: its own, also in scenes that were loaded or imported, and no others."""

from __future__ import annotations

import numpy as np
import pytest
import slicer

from SlicerUSSim.Logic import SimulationError
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.base.vtk_data import vtk_matrix
from SlicerUSSim.Logic.mrml import UltrasoundSceneLogic
from SlicerUSSim.Logic.mrml.fitting_nodes import fits
from SlicerUSSim.Logic.mrml.label_nodes import node_labels, write_labels
from SlicerUSSim.Logic.mrml.nodes import write_volume
from SlicerUSSim.Logic.mrml.own_results import (
    IMAGE,
    OUTLINE,
    REGISTRATION,
    SEQUENCE,
    content_of,
    kind_of_result,
    mark_as_made,
    mark_as_result,
)
from SlicerUSSim.Logic.mrml.scene_record import SceneRecord, put_nodes, record_nodes
from tests.conftest import rigid
from tests.test_scene import Bench, add, cyst, pixels, put, save_scene

pytestmark = pytest.mark.usefixtures("segmented_once")


@pytest.fixture
def bench():
    bench = Bench()
    bench.simulate()
    return bench


def clone(node):
    """As Slicer's Data module does."""
    if node.IsA("vtkMRMLScalarVolumeNode"):
        volumes = slicer.vtkSlicerVolumesLogic()
        volumes.SetMRMLScene(node.GetScene())
        return volumes.CloneVolume(node.GetScene(), node, "kept")
    copy = add(node.GetScene(), node.GetClassName()[len("vtkMRML") : -len("Node")])
    copy.Copy(node)
    copy.SetName("kept")
    return copy


def flair() -> Volume:
    return Volume(np.arange(10.0 * 12 * 14).reshape(10, 12, 14).astype(np.float32), np.eye(4))


def test_a_copy_of_an_image_is_the_users(bench):
    bench.logic.showOutline(outline := add(bench.scene, "Model", "outline"), bench.probe)
    kept, kept_outline = clone(bench.image), clone(outline)
    before = pixels(kept)
    assert bench.logic.mayReplaceResult(bench.image) and fits("output", bench.image)
    for role, copy, own in (("output", kept, bench.image), ("outline", kept_outline, outline)):
        copy.SetAttribute("SlicerUSSim.result", own.GetAttribute("SlicerUSSim.result"))  # as some copies have
        copy.SetAttribute("SlicerUSSim.resultData", own.GetAttribute("SlicerUSSim.resultData"))
        assert not bench.logic.mayReplaceResult(copy) and not fits(role, copy) and fits(role, own)
    assert not fits("mri", kept) and not fits("real", kept)  # it is simulated ultrasound all the same
    put(bench.probe, rigid(np.eye(3), [1, 2, 3]))
    with pytest.raises(SimulationError, match="'kept' has data that this module did not make"):
        bench.logic.simulate(bench.labels, bench.probe, kept)
    with pytest.raises(SimulationError, match="'kept' has data that this module did not make"):
        bench.logic.showOutline(kept_outline, bench.probe)
    np.testing.assert_array_equal(pixels(kept), before)
    bench.scene.RemoveNode(bench.image)
    assert not bench.logic.mayReplaceResult(kept)


def test_data_that_the_user_put_in_place_of_a_result_are_the_users(bench):
    images = add(bench.scene, "Sequence", "images")
    transforms = add(bench.scene, "Sequence", "poses")
    for number in range(2):
        transforms.SetDataNodeAtValue(put(add(bench.scene, "LinearTransform"), np.eye(4)), str(number))
    bench.logic.simulateSequence(bench.labels, transforms, images)
    assert bench.logic.mayReplaceResult(images)
    images.GetNthDataNode(1).GetImageData().GetPointData().GetScalars().SetComponent(7, 0, 99.0)
    assert not bench.logic.mayReplaceResult(images)

    write_volume(bench.image, flair())
    assert kind_of_result(bench.image) is None and fits("mri", bench.image) and not fits("output", bench.image)
    for act in (bench.simulate, bench.live, lambda: bench.logic.showSequenceImage(images, 0, bench.image)):
        with pytest.raises(SimulationError, match="'ultrasound' has data that this module did not make"):
            act()
    bench.logic.clearImage(bench.image)
    np.testing.assert_array_equal(Volume.from_vtk(bench.image.GetImageData(), np.eye(4)).array, flair().array)
    bench.image.SetAndObserveImageData(None)
    bench.simulate()
    assert bench.logic.mayReplaceResult(bench.image)
    bench.image.GetImageData().GetPointData().GetScalars().SetComponent(7, 0, 99.0)  # painted on
    assert not bench.logic.mayReplaceResult(bench.image)


def test_a_flair_that_is_put_into_the_output_during_live_stays(bench):
    reports = []
    bench.live(report=reports.append)
    write_volume(bench.image, flair())
    put(bench.probe, rigid(np.eye(3), [1, 2, 3]))
    assert "has data that this module did not make" in reports[-1]
    np.testing.assert_array_equal(Volume.from_vtk(bench.image.GetImageData(), np.eye(4)).array, flair().array)


def test_a_registration_that_the_user_turned_further_is_the_users(bench):
    node = put(add(bench.scene, "LinearTransform", "registration"), rigid(np.eye(3), [1, 2, 3]))
    warned = []
    node.AddObserver("WarningEvent", lambda *_: warned.append(1))  # VTK's, which Slicer's log showed for each look
    mark_as_result(node, REGISTRATION)
    assert bench.logic.mayReplaceResult(node)
    put(node, rigid(np.eye(3), [1, 2, 4]))
    assert not bench.logic.mayReplaceResult(node) and not warned


@pytest.mark.parametrize("is_imported", [False, True])
def test_saved_scenes_know_their_own_results_again(bench, tmp_path, is_imported):
    """Importing gives nodes other IDs where the scene already has nodes of these."""
    bench.logic.showOutline(outline := add(bench.scene, "Model", "outline"), bench.probe)
    registration = put(add(bench.scene, "LinearTransform", "registration"), rigid(np.eye(3), [0.1, 2.3, 3.7]))
    mark_as_result(registration, REGISTRATION)
    mark_as_made(bench.labels)
    kept = clone(bench.image)
    colours = bench.labels.GetNodeReference("tissueColors")
    save_scene(bench.scene, (bench.labels, colours, bench.image, kept, outline, registration), tmp_path)
    scene = slicer.vtkMRMLScene()
    if is_imported:
        for kind in ("ScalarVolume", "Model", "LinearTransform", "LabelMapVolume"):
            for _ in range(3):
                add(scene, kind, "there before")
    scene.SetURL(str(tmp_path / "scene.mrml"))
    assert scene.Import() if is_imported else scene.Connect()
    logic = UltrasoundSceneLogic(scene)
    found = {name: scene.GetFirstNodeByName(name) for name in ("ultrasound", "outline", "registration", "kept")}
    assert is_imported == (found["ultrasound"].GetID() != bench.image.GetID())
    for name, kind in (("ultrasound", IMAGE), ("outline", OUTLINE), ("registration", REGISTRATION)):
        assert found[name].GetAttribute("SlicerUSSim.result") == kind and logic.mayReplaceResult(found[name])
    assert not logic.mayReplaceResult(found["kept"])
    assert logic.mayReplace(scene.GetFirstNodeByName("tissues"))


def test_a_saved_sequence_of_images_is_known_again(bench, tmp_path):
    images, transforms = add(bench.scene, "Sequence", "images"), add(bench.scene, "Sequence", "poses")
    for number in range(3):
        transforms.SetDataNodeAtValue(put(add(bench.scene, "LinearTransform"), np.eye(4)), f"{0.1 * number}")
    bench.logic.simulateSequence(bench.labels, transforms, images)
    images.AddDefaultStorageNode()
    storage = images.GetStorageNode()
    storage.SetFileName(str(tmp_path / "images.seq.nrrd"))
    assert storage.WriteData(images) == 1
    bench.scene.SetURL(str(tmp_path / "scene.mrml"))
    bench.scene.SetRootDirectory(str(tmp_path))
    assert bench.scene.Commit()
    scene = slicer.vtkMRMLScene()
    scene.SetURL(str(tmp_path / "scene.mrml"))
    assert scene.Connect()
    again = scene.GetFirstNodeByName("images")
    assert again.GetNumberOfDataNodes() == 3 and kind_of_result(again) == SEQUENCE
    assert UltrasoundSceneLogic(scene).mayReplaceResult(again)


@pytest.mark.parametrize("kind", ["LabelMapVolume", "Segmentation"])
def test_a_copy_of_segments_labels_is_the_users(kind):
    bench = Bench(kind)
    mark_as_made(bench.labels)
    kept = clone(bench.labels)
    write_labels(kept, cyst(), ("speckle", "fluid"), bench.grid())  # outside Slicer, segments are not copied
    assert kept.GetAttribute("SlicerUSSim.made") == content_of(kept) == content_of(bench.labels)
    assert bench.logic.mayReplace(bench.labels) and not bench.logic.mayReplace(kept)


def test_a_session_knows_its_own_and_what_was_copied():
    bench = Bench()
    mark_as_made(bench.labels)
    parameters = bench.logic.parameters
    for labels, is_own in ((bench.labels, True), (clone(bench.labels), False)):
        parameters.labels = labels
        again = UltrasoundSceneLogic(slicer.vtkMRMLScene())
        made = put_nodes(again.scene, SceneRecord(record_nodes(parameters, ("labels",))))
        assert again.mayReplace(made["labels"]) == is_own


@pytest.mark.parametrize("has_voxels", [True, False])
def test_a_segment_of_a_user_is_never_replaced_even_without_voxels(has_voxels):
    bench = Bench("Segmentation")
    plan = add(bench.scene, "Segmentation", "plan")
    assert bench.logic.mayReplace(plan)  # nobody has begun
    tissues = cyst() if has_voxels else cyst().with_array(np.zeros_like(cyst().array))
    write_labels(plan, tissues, ("tumour",), bench.grid())
    assert not bench.logic.mayReplace(plan)
    mark_as_made(bench.labels)
    write_labels(bench.labels, tissues, ("tumour",), bench.grid())
    assert not bench.logic.mayReplace(bench.labels)
    with pytest.raises(SimulationError, match="'plan' was not made by Segment"):
        bench.logic.segment(bench.grid(), plan)
    assert plan.GetSegmentation().GetSegment("tumour") is not None


def paint(segmentation_node, segment_id: str, mask: Volume) -> None:
    """Give a segment these voxels, with overlap allowed, as Slicer's editor does."""
    image = slicer.vtkOrientedImageData()
    image.ShallowCopy(Volume((mask.array > 0).astype(np.uint8), np.eye(4)).to_vtk())
    image.SetImageToWorldMatrix(vtk_matrix(mask.ijk_to_ras))
    slicer.vtkSlicerSegmentationsModuleLogic.SetBinaryLabelmapToSegment(image, segmentation_node, segment_id, 0)


def test_voxels_of_a_user_below_a_later_segment_are_seen(tmp_path):
    """They are not in the flattened label map: Segment cut a painted segment from 7195 voxels to 644."""
    bench = Bench("Segmentation")
    mark_as_made(bench.labels)
    assert bench.logic.mayReplace(bench.labels)
    flat, _ = node_labels(bench.labels)
    first, *_, last = bench.labels.GetSegmentation().GetSegmentIDs()
    assert first != last
    paint(bench.labels, first, flat)  # over all that the later segments cover
    np.testing.assert_array_equal(node_labels(bench.labels)[0].array, flat.array)
    assert not bench.logic.mayReplace(bench.labels)
    with pytest.raises(SimulationError, match="edited since, and is not replaced"):
        bench.logic.segment(bench.grid(), bench.labels)

    mark_as_made(bench.labels)  # as a proposal whose segments lie within each other
    save_scene(bench.scene, (bench.labels,), tmp_path)
    scene = slicer.vtkMRMLScene()
    scene.SetURL(str(tmp_path / "scene.mrml"))
    assert scene.Connect()
    again = scene.GetFirstNodeByName(bench.labels.GetName())
    assert UltrasoundSceneLogic(scene).mayReplace(again)
    paint(again, first, flat.with_array(flat.array == 1))  # the voxels below are wiped out
    np.testing.assert_array_equal(node_labels(again)[0].array, flat.array)
    assert not UltrasoundSceneLogic(scene).mayReplace(again)
