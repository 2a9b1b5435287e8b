"""Shares of tissues in a scene: the images of a patient that Segment labelled agree with the same in Python."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

slicer = pytest.importorskip("slicer", reason="MRML nodes come with slicer-core: pip install '.[slicer]'")

from SlicerUSSim.Logic import SimulationError, UltrasoundSimulator, seed_of_pose  # noqa: E402
from SlicerUSSim.Logic.mri.pathology import add_tissues, texture_below  # noqa: E402
from SlicerUSSim.Logic.mri.samples import head_mri  # noqa: E402
from SlicerUSSim.Logic.mrml.lesion_nodes import add_lesion  # noqa: E402
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic  # noqa: E402
from SlicerUSSim.Logic.mrml.nodes import node_to_world, nodes_of_class, read_volume, write_volume  # noqa: E402
from tests.test_pathology import ball, empty, moved  # noqa: E402

pytestmark = pytest.mark.usefixtures("segmented_once")

KINDS = ["LabelMapVolume", "Segmentation"]
MRI = head_mri(4.0)
LESION = ball(moved(empty((2.0, 2.0, 2.0), np.eye(3), 20), 30.0, 10.0, 35.0), 8.0, np.array([30.0, 10.0, 35.0]))


def read_back(path: Path):
    """The scene of a .mrb."""
    scene, folder = slicer.vtkMRMLScene(), path.with_suffix("")
    zipfile.ZipFile(path).extractall(folder)
    scene.SetURL(str(next(folder.rglob("*.mrml"))))
    assert scene.Import()
    return scene


class Bench:
    def __init__(self, kind: str = KINDS[0]) -> None:
        self.scene = slicer.vtkMRMLScene()
        self.logic = UltrasoundSceneLogic(self.scene)
        self.logic.preset = self.logic.preset.changed("probe", scan_lines=48)
        self.mri, self.labels = self.add("ScalarVolume", "Head"), self.add(kind, "tissues")
        self.probe, self.image = self.add("LinearTransform", "Probe"), self.add("ScalarVolume", "ultrasound")
        write_volume(self.mri, MRI)

    def add(self, kind: str, name: str):
        return self.scene.AddNewNodeByClass(f"vtkMRML{kind}Node", name)

    def segmented(self) -> Bench:
        self.result = self.logic.segment(self.mri, self.labels)
        self.logic.placeProbe(self.labels, self.probe)
        return self

    def set(self, **settings) -> Bench:
        self.logic.preset = self.logic.preset.changed("settings", **settings)
        return self

    def pixels(self, logic: UltrasoundSceneLogic | None = None) -> np.ndarray:
        return (logic or self.logic).simulate(self.labels, self.probe, self.image).image

    def shares(self) -> list:
        return [node for node in nodes_of_class(self.scene, "vtkMRMLScalarVolumeNode") if "shares" in node.GetName()]


def expected(bench: Bench, labels, names, texture) -> np.ndarray:
    preset, pose = bench.logic.preset, node_to_world(bench.probe)
    simulator = UltrasoundSimulator(labels, preset.tissues.for_names(names), preset.settings, texture=texture)
    return simulator.simulate(preset.probe, pose, preset.display, noise_seed=seed_of_pose(pose)).image


def differ(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.mean(one != other))


@pytest.mark.parametrize("kind", KINDS)
def test_labels_of_segment_have_the_shares_of_the_segmentation(kind):
    bench = Bench(kind).segmented()
    segmentation = bench.result
    names, texture = segmentation.tissue_names, segmentation.texture()
    mixed, hard = (expected(bench, segmentation.labels, names, known) for known in (texture, None))
    assert differ(mixed, hard) > 0.01
    assert differ(bench.pixels(), mixed) < 0.001  # a segmentation is cropped to what it holds
    assert differ(bench.set(partial_volume=False).pixels(), hard) < 0.001


def test_another_logic_and_lesions_have_them_too():
    """As after a scene is opened, where no segmentation is in memory."""
    bench = Bench("Segmentation").segmented()
    before, other = bench.pixels(), UltrasoundSceneLogic(bench.scene)
    np.testing.assert_array_equal(bench.pixels(other), before)
    lesions = bench.add("Segmentation", "Lesions")
    add_lesion(lesions, LESION, "tumour", "tumour")
    other.addTissues(bench.labels, lesions)
    segmentation = bench.result
    added = add_tissues(
        segmentation.labels, segmentation.tissue_names, [("tumour", LESION, "tumour")], has_brain_mask=True
    )
    texture = texture_below(segmentation.texture(), MRI, segmentation.labels, added.labels)
    assert differ(bench.pixels(other), expected(bench, added.labels, added.tissue_names, texture)) < 0.005
    assert len(bench.shares()) == 1


@pytest.mark.parametrize("kind", KINDS)
def test_edited_labels_have_none(kind):
    bench = Bench(kind).segmented()
    hard = bench.set(partial_volume=False).pixels()
    assert differ(bench.set(partial_volume=None).pixels(), hard) > 0.01
    if kind == "Segmentation":
        segmentation = bench.labels.GetSegmentation()
        segmentation.RemoveSegment(segmentation.GetSegmentIDs()[0])
    else:
        image = bench.labels.GetImageData()
        image.SetScalarComponentFromDouble(5, 5, 5, 0, 1.0)
        image.Modified()
    edited = bench.pixels()
    np.testing.assert_array_equal(bench.set(partial_volume=False).pixels(), edited)
    bench.set(partial_volume=True)
    with pytest.raises(SimulationError, match="need a texture from the MRI, which"):
        bench.pixels()


def test_shares_are_hidden_saved_and_removed_with_their_labels(tmp_path):
    bench = Bench().segmented()
    (node,) = bench.shares()
    assert node.GetHideFromEditors() and node.GetSaveWithScene()
    before = bench.pixels()
    assert bench.scene.WriteToMRB(str(tmp_path / "scene.mrb"))
    scene = read_back(tmp_path / "scene.mrb")
    labels, probe, image = (scene.GetFirstNodeByName(name) for name in ("tissues", "Probe", "ultrasound"))
    again = UltrasoundSceneLogic(scene).simulate(labels, probe, image).image
    np.testing.assert_array_equal(again, before)
    bench.scene.RemoveNode(bench.labels)
    bench.labels = bench.add("LabelMapVolume", "others")
    bench.logic.segment(bench.mri, bench.labels)
    (left,) = bench.shares()
    assert left.GetName().startswith("others")


@pytest.mark.slow
def test_a_live_image_has_the_shares_of_labels_that_are_made_anew():
    """One was computed between labels and shares, and kept."""
    bench = Bench().segmented()
    bench.logic.startLiveUpdate(bench.labels, bench.probe, bench.image)
    bench.result = bench.logic.segment(bench.mri, bench.labels, thin_sulci=False)
    live = read_volume(bench.image).array[0].copy()
    bench.logic.stopLiveUpdate()
    np.testing.assert_array_equal(live, bench.pixels(UltrasoundSceneLogic(bench.scene)))
    texture = bench.result.texture()
    assert differ(live, expected(bench, bench.result.labels, bench.result.tissue_names, texture)) < 0.001
