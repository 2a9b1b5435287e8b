"""Craniotomies in a scene, as the module and the page open and close them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

slicer = pytest.importorskip("slicer", reason="MRML nodes come with slicer-core: pip install '.[slicer]'")

from vtkmodules.vtkCommonCore import vtkPoints  # noqa: E402

from SlicerUSSim.Logic import SimulationError, Volume  # noqa: E402
from SlicerUSSim.Logic.base.vtk_data import vtk_matrix  # noqa: E402
from SlicerUSSim.Logic.mri.pathology import add_tissues  # noqa: E402
from SlicerUSSim.Logic.mrml.label_nodes import read_labels, write_labels  # noqa: E402
from SlicerUSSim.Logic.mrml.lesion_nodes import add_lesion  # noqa: E402
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic  # noqa: E402
from SlicerUSSim.Logic.mrml.nodes import node_to_world, nodes_of_class, set_node_to_world, write_volume  # noqa: E402
from SlicerUSSim.Logic.mrml.own_results import mark_as_made  # noqa: E402
from SlicerUSSim.Logic.mrml.scene_record import put_nodes, record_scene  # noqa: E402
from SlicerUSSim.Logic.placement.craniotomy import default_pose, disc_opening, opened  # noqa: E402
from SlicerUSSim.Logic.probe.poses import pose_looking_at  # noqa: E402
from SlicerUSSim.Widget.presenter import PanelPresenter  # noqa: E402
from tests.test_aiming import with_ball  # noqa: E402
from tests.test_craniotomy import NAMES, TOP, head  # noqa: E402, F401
from tests.test_presenter import PlainView  # noqa: E402

KINDS = ["LabelMapVolume", "Segmentation"]
TURN = np.array([[0.8, -0.6, 0.0, 12.0], [0.6, 0.8, 0.0, -7.0], [0.0, 0.0, 1.0, 25.0], [0.0, 0.0, 0.0, 1.0]])


class Bench:
    """The round head in a scene, with a probe on its vertex, under a transform that turns and moves both."""

    def __init__(self, labels: Volume, kind: str = KINDS[0], to_world: np.ndarray = TURN, names=NAMES) -> None:
        self.scene = slicer.vtkMRMLScene()
        self.presenter = PanelPresenter(UltrasoundSceneLogic(self.scene), PlainView(), label_maps=kind == KINDS[0])
        self.logic, self.view = self.presenter.logic, self.presenter.view
        self.logic.preset = self.logic.preset.changed("probe", scan_lines=48)
        parent = self.add("LinearTransform", "to world")
        parent.SetMatrixTransformToParent(vtk_matrix(to_world))
        grid = self.add("ScalarVolume", "grid")
        write_volume(grid, labels)
        grid.SetAndObserveTransformNodeID(parent.GetID())
        self.whole, self.probe = self.add(kind, "tissues"), self.add("LinearTransform", "Probe")
        self.to_world = to_world
        write_labels(self.whole, labels, names, grid)
        mark_as_made(self.whole)
        self.logic.parameters.labels, self.logic.parameters.probe_transform = self.whole, self.probe
        self.move(TOP)

    def add(self, kind: str, name: str):
        return self.scene.AddNewNodeByClass(f"vtkMRML{kind}Node", name)

    def move(self, pose: np.ndarray) -> None:
        set_node_to_world(self.probe, self.to_world @ pose)

    @property
    def labels(self):
        return self.logic.parameters.labels

    def tissues(self, node) -> np.ndarray:
        """(k, j, i) of the brain (1) and of its surroundings (2) in a box that both kinds of nodes have."""
        found = read_labels(node, self.logic.preset.tissues)
        around = [number for number, name in enumerate(found.names, 1) if name not in ("csf", "grey matter")]
        return np.where(np.isin(found.labels.array, around), 2, np.minimum(found.labels.array, 1))


def expected(labels: Volume, pose: np.ndarray, diameter_mm: float) -> float:
    return opened(labels, NAMES, disc_opening(labels, NAMES, pose, diameter_mm))[1]


def test_a_disc_is_opened_in_separate_labels_and_closed_again(head):  # noqa: F811
    bench = Bench(head)
    before = bench.tissues(bench.whole)
    assert bench.presenter.placing.canOpenCraniotomy()[0] and not bench.presenter.placing.canCloseCraniotomy()[0]
    bench.presenter.values.setValue("scene.craniotomy_mm", 30.0)
    bench.presenter.placing.openCraniotomy()
    assert not bench.view.errors and bench.labels is not bench.whole
    np.testing.assert_array_equal(bench.tissues(bench.whole), before)
    after = bench.tissues(bench.labels)
    gone = (after != before) & (before == 2)
    assert not after[after != before].any() and (after == 1).sum() == (before == 1).sum()
    assert gone.sum() * head.voxel_ml == pytest.approx(expected(head, TOP, 30.0), rel=1e-6)
    assert "craniotomy: a disc of 30 mm under the probe; " in bench.presenter.notes.aboutProbe()
    node = bench.labels
    bench.move(pose_looking_at((0.0, 80.0, 0.0), (0.0, 0.0, 0.0)))
    bench.presenter.placing.openCraniotomy()  # there, and closed again where it was
    assert bench.labels is node and len(nodes_of_class(bench.scene, "vtkMRMLModelNode")) == 1
    assert (bench.tissues(bench.labels)[gone] == 2).mean() > 0.9 and bench.presenter.notes.aboutProbe().count(
        "craniotomy: "
    ) == 1
    bench.presenter.placing.closeCraniotomy()
    assert bench.labels is bench.whole and "craniotomy: " not in bench.presenter.notes.aboutProbe()
    assert not bench.presenter.placing.canCloseCraniotomy()[0] and not bench.view.errors


def test_the_model_shows_what_was_removed_where_it_was(head):  # noqa: F811
    bench = Bench(head)
    bench.logic.openCraniotomy(bench.whole, output := bench.add("LabelMapVolume", "open"),
                               probe_transform_node=bench.probe, diameter_mm=30.0)  # fmt: skip
    (model,) = nodes_of_class(bench.scene, "vtkMRMLModelNode")
    assert model.GetDisplayNode().GetVisibility()
    bounds = np.array(model.GetPolyData().GetBounds()).reshape(3, 2)
    np.testing.assert_allclose(bounds[:2], [[-15, 15], [-15, 15]], atol=1.6)
    assert 55.0 < bounds[2, 0] < 62.5 and bounds[2, 1] == pytest.approx(78.0, abs=1.6)
    np.testing.assert_allclose(node_to_world(model), TURN)
    bench.logic.hideOpening(output)
    assert not model.GetDisplayNode().GetVisibility()


def test_markups_and_masks_are_opened(head):  # noqa: F811
    bench = Bench(head)
    curve = bench.add("MarkupsClosedCurve", "curve")
    points = vtkPoints()
    for x, y in ((-20, -10), (20, -10), (20, 10), (-20, 10)):
        points.InsertNextPoint((TURN @ [x, y, 78.0, 1.0])[:3])
    bench.logic.parameters.opening = curve
    bench.presenter.placing.openCraniotomy()
    assert "'curve' has 0 points, expected three or more" in bench.view.errors[-1] and bench.labels is bench.whole
    curve.SetControlPointPositionsWorld(points)
    bench.presenter.placing.openCraniotomy()
    before = bench.tissues(bench.whole)
    gone = np.argwhere(bench.tissues(bench.labels) != before)
    along = 2.0 * gone - 84.0
    assert np.abs(along[:, 2]).max() == pytest.approx(19.0, abs=1.5) and np.abs(along[:, 1]).max() <= 10.0
    mask = bench.add("LabelMapVolume", "mask")
    above = head.with_array(((head.array > 2) & (np.arange(head.array.shape[0])[:, None, None] > 75)).astype(np.uint8))
    write_labels(mask, above, ("opening",), bench.whole)
    bench.logic.parameters.opening = mask
    bench.presenter.placing.openCraniotomy()
    gone = (bench.tissues(bench.labels) != before) & (before == 2)
    assert len(bench.view.errors) == 1
    np.testing.assert_array_equal(gone, above.array > 0)


def test_what_cannot_be_opened_changes_nothing(head):  # noqa: F811
    bench = Bench(head)
    bench.move(pose_looking_at((300.0, 0.0, 0.0), (300.0, 100.0, 0.0)))
    names = [node.GetName() for node in nodes_of_class(bench.scene, "vtkMRMLVolumeNode")]
    bench.presenter.placing.openCraniotomy()
    assert "there is no brain under the craniotomy" in bench.view.errors[-1] and bench.labels is bench.whole
    assert [node.GetName() for node in nodes_of_class(bench.scene, "vtkMRMLVolumeNode")] == names
    mine = bench.add("LabelMapVolume", "mine")
    write_labels(mine, head, NAMES, bench.whole)
    with pytest.raises(SimulationError, match="was not made by this module, or edited since, and is not replaced"):
        bench.logic.openCraniotomy(bench.whole, mine, probe_transform_node=bench.probe)
    bench.presenter.placing.closeCraniotomy()
    assert "has no opening, or the previous labels were removed" in bench.view.errors[-1]


@pytest.mark.slow
def test_the_probe_is_placed_at_the_chosen_view(head):  # noqa: F811
    bench = Bench(head)
    bench.presenter.values.setValue("scene.view", "temporal-left")
    bench.presenter.placing.placeAtView()
    place = (np.linalg.inv(TURN) @ node_to_world(bench.probe))[:3, 3]
    world = node_to_world(bench.probe)[:3, 3] - TURN[:3, 3]
    assert np.linalg.norm(place) == pytest.approx(78.0, abs=2.0) and world[0] < -70 and not bench.view.errors


def test_place_follows_the_labels_and_takes_the_largest_piece(head):  # noqa: F811
    bench = Bench(head)
    bench.presenter.placing.openCraniotomy()
    moved = bench.add("LinearTransform", "moved")
    moved.SetMatrixTransformToParent(vtk_matrix(np.array([[1.0, 0, 0, 100], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])))
    bench.labels.SetAndObserveTransformNodeID(moved.GetID())
    bench.logic.placeProbe(bench.labels, bench.probe)
    place = node_to_world(bench.probe)[:3, 3] - [100.0, 0.0, 0.0]
    np.testing.assert_allclose(place, [0.0, 0.0, 60.0], atol=4.0)
    (model,) = nodes_of_class(bench.scene, "vtkMRMLModelNode")
    assert model.GetParentTransformNode() is moved


def test_the_labels_are_not_an_opening_and_edits_are_not_lost_silently(head):  # noqa: F811
    bench = Bench(head)
    bench.logic.parameters.opening = bench.whole
    bench.presenter.placing.openCraniotomy()
    assert "the labels themselves, expected a node with the opening alone" in bench.view.errors[-1]
    bench.logic.parameters.opening = None
    bench.presenter.placing.openCraniotomy()
    first = bench.labels
    first.GetImageData().SetScalarComponentFromDouble(42, 42, 42, 0, 2.0)
    first.GetImageData().Modified()
    bench.presenter.placing.openCraniotomy()
    assert bench.labels is not first and "what was edited in LabelMapVolume" in bench.presenter.notes.aboutProbe()


@pytest.mark.slow
def test_gel_is_between_skin_and_probe_unless_the_user_says_otherwise(head):  # noqa: F811
    bench = Bench(head)
    bench.move(pose_looking_at((0.0, 0.0, 88.0), (0.0, 0.0, 0.0)))  # 10 mm off the skin
    image = bench.add("ScalarVolume", "image")
    gel = bench.logic.simulate(bench.whole, bench.probe, image).image.copy()
    assert "gel fills gaps of up to 3 mm between skin and probe" in bench.presenter.notes.aboutProbe()
    plain = bench.logic.preset
    bench.logic.preset = plain.changed("settings", contact_gap_mm=3.0)
    np.testing.assert_array_equal(bench.logic.simulate(bench.whole, bench.probe, image).image, gel)
    bench.logic.preset = plain.changed("settings", contact_gap_mm=1.0)
    assert bench.logic.settings(bench.whole).contact_gap_mm == 1.0 and "gel " not in bench.presenter.notes.aboutProbe()
    bench.logic.preset = plain
    bench.presenter.values.setValue("scene.gel", False)
    immersed = bench.logic.simulate(bench.whole, bench.probe, image).image
    assert gel.mean() < 0.5 * immersed.mean() and immersed.max() > gel.max() + 50
    assert "gel " not in bench.presenter.notes.aboutProbe()
    bench.presenter.values.setValue("scene.gel", True)
    bench.presenter.placing.openCraniotomy()  # filled with saline
    assert (
        bench.logic.settings(bench.labels).contact_gap_mm is None and "gel " not in bench.presenter.notes.aboutProbe()
    )
    bench.presenter.placing.closeCraniotomy()
    assert bench.logic.settings(bench.labels).contact_gap_mm == 3.0
    brain = Bench(head.with_array(np.where(head.array == 2, 2, 0).astype(np.uint8)))
    assert brain.logic.settings(brain.whole).contact_gap_mm is None


@pytest.mark.parametrize("to_world", [np.eye(4), TURN], ids=["plain", "turned"])
def test_a_disc_opens_over_the_lesion_that_was_laid_over_the_labels(head, to_world):  # noqa: F811
    """At the start of the page with --add and --craniotomy auto it was where a craniotomy is by default."""
    place = np.array([38.0, -20.0, 20.0])
    bench = Bench(head, to_world=to_world)
    mask = with_ball(head, place, 8.0, 9)
    mask = mask.with_array((mask.array == 9).astype(np.uint8))
    lesions = bench.add("Segmentation", "lesions")
    lesions.SetAndObserveTransformNodeID(bench.whole.GetTransformNodeID())
    add_lesion(lesions, mask, "tumour", "tumour")
    bench.logic.addTissues(bench.whole, lesions)
    bench.logic.placeProbe(bench.whole, bench.probe, will_open=True)
    pose = np.linalg.inv(to_world) @ node_to_world(bench.probe)
    assert np.hypot(*(np.linalg.inv(pose) @ [*place, 1.0])[[0, 2]]) < 2.5
    if to_world is not TURN:  # a coronal view is one of the world
        added = add_tissues(head, NAMES, [("tumour", mask, "a")], has_brain_mask=False)
        probe, target = bench.logic.preset.probe, added.centre_ras(head)
        same = default_pose(added.labels, added.tissue_names, probe, is_open=True, target_ras=target)
        np.testing.assert_allclose(pose, same, atol=1e-3)


@pytest.mark.slow
def test_the_notes_say_that_no_part_of_the_face_touches_the_patient(head):  # noqa: F811
    nothing = "0% of the probe's face touches the patient (contact gap: 3 mm): the image is black"
    bench = Bench(head)
    bench.presenter.placing.placeProbe()
    assert "face touches" not in bench.presenter.notes.aboutProbe()
    bench.presenter.images.setLive(True)
    refreshed = bench.view.refreshed
    bench.move(pose_looking_at((0.0, 0.0, 88.0), (0.0, 0.0, 0.0)))
    bench.view.waiting.pop()()
    assert bench.view.refreshed == refreshed + 1 and bench.presenter.notes.aboutProbe().count(nothing) == 1
    bench.presenter.images.setLive(False)
    bench.logic.parameters.panel = replace(bench.logic.parameters.panel, gel=False)  # it lies in the coupling medium
    assert "face touches" not in bench.presenter.notes.aboutProbe() and not bench.view.errors


@pytest.mark.slow
def test_the_notes_follow_the_probe_over_bone_and_openings(head):  # noqa: F811
    closed, misfit = "the skull is closed in front of the probe", "does not fit the opening"
    bench = Bench(head)
    bench.presenter.placing.placeProbe()
    assert (
        bench.presenter.notes.aboutProbe().count(closed) == 1 and "open the skull" in bench.presenter.notes.aboutProbe()
    )
    bench.presenter.placing.openCraniotomy()
    bench.presenter.placing.placeProbe()
    assert closed not in bench.presenter.notes.aboutProbe() and misfit not in bench.presenter.notes.aboutProbe()
    bench.logic.preset = bench.logic.preset.changed("probe", aperture_mm=40.0)
    assert "is 40 mm wide and does not fit the opening" in bench.presenter.notes.aboutProbe()
    bench.logic.preset = bench.logic.preset.changed("probe", aperture_mm=12.0)
    bench.presenter.images.setLive(True)
    assert misfit not in bench.presenter.notes.aboutProbe() and not bench.view.errors
    refreshed = bench.view.refreshed
    bench.move(pose_looking_at((78.5, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    bench.view.waiting.pop()()  # the image there
    assert bench.view.refreshed == refreshed + 1  # so that the notes are shown anew
    assert (
        closed in bench.presenter.notes.aboutProbe()
        and "the opening is elsewhere" in bench.presenter.notes.aboutProbe()
    )
    bench.presenter.images.setLive(False)
    assert not [line for line in bench.presenter.notes.lines if closed in line]


@pytest.mark.slow
def test_a_view_is_placed_in_an_opening_or_reported_elsewhere(head):  # noqa: F811
    bench = Bench(head)

    def radius() -> float:
        return float(np.linalg.norm((np.linalg.inv(TURN) @ node_to_world(bench.probe))[:3, 3]))

    bench.presenter.values.setValue("scene.view", "fontanelle")
    bench.presenter.placing.placeAtView()
    assert radius() == pytest.approx(78.0, abs=2.0)
    bench.presenter.placing.openCraniotomy()
    bench.presenter.placing.placeAtView()
    assert radius() == pytest.approx(60.0, abs=2.0) and not bench.view.errors
    assert "the view fontanelle is seen through the opening" in bench.presenter.notes.aboutProbe()
    bench.presenter.values.setValue("scene.view", "temporal")
    bench.presenter.placing.placeAtView()
    assert radius() == pytest.approx(78.0, abs=2.0) and bench.presenter.notes.aboutProbe().count("view: ") == 1
    assert "the view temporal does not pass through the opening: the probe stands on the skin" in (
        bench.presenter.notes.aboutProbe()
    )


def test_hidden_segments_of_an_opening_stay_closed_and_are_reported(head):  # noqa: F811
    bench = Bench(head)
    z, _, x = np.indices(head.array.shape)
    above = (head.array > 2) & (z > 75)
    opening = bench.add("Segmentation", "opening")
    both = head.with_array(np.where(above, np.where(x > 42, 2, 1), 0).astype(np.uint8))
    write_labels(opening, both, ("left", "right"), bench.whole)
    opening.CreateDefaultDisplayNodes()
    first, second = opening.GetSegmentation().GetSegmentIDs()
    bench.logic.parameters.opening = opening
    opening.GetDisplayNode().SetSegmentVisibility(second, False)
    bench.presenter.placing.openCraniotomy()
    assert not bench.view.errors
    before, after = bench.tissues(bench.whole), bench.tissues(bench.labels)
    np.testing.assert_array_equal((after != before) & (before == 2), both.array == 1)
    notes = bench.presenter.notes.aboutProbe()
    assert "with left; " in notes and "what is hidden is not opened: right" in notes
    opening.GetDisplayNode().SetSegmentVisibility(first, False)
    bench.presenter.placing.openCraniotomy()
    assert "all its segments are hidden, expected a visible one to open" in bench.view.errors[-1]


def test_an_opening_is_kept_with_the_scene_and_can_then_be_closed(head):  # noqa: F811
    bench = Bench(head, "Segmentation")
    bench.presenter.placing.openCraniotomy()
    assert not bench.view.errors
    bench.presenter.images.simulate()
    image, whole = bench.logic.lastFrame.image, bench.tissues(bench.whole)
    record = record_scene(bench.scene)
    assert set(record.nodes) == {"labels", "closed"}
    again = Bench(head, KINDS[0], np.eye(4))
    again.scene.RemoveNode(again.whole)
    nodes = put_nodes(again.scene, record)
    again.logic.parameters.labels = nodes["labels"]
    set_node_to_world(again.probe, record.pose)
    again.presenter.images.simulate()
    assert not again.view.errors and np.array_equal(again.logic.lastFrame.image, image)
    flaps = [node for node in nodes_of_class(again.scene, "vtkMRMLModelNode") if "removed" in node.GetName()]
    assert len(flaps) == 1 and flaps[0].GetPolyData().GetNumberOfPoints() > 20
    again.presenter.placing.closeCraniotomy()
    assert not again.view.errors and again.labels is nodes["closed"]
    assert np.array_equal(np.unique(again.tissues(again.labels)), np.unique(whole))
