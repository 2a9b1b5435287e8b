"""Sheets, organs of a CT and grown lesions in a scene, as module and page have them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

slicer = pytest.importorskip("slicer", reason="MRML nodes come with slicer-core: pip install '.[slicer]'")

from SlicerUSSim.Logic import TissueTable, UltrasoundSimulator, Volume  # noqa: E402
from SlicerUSSim.Logic.base.vtk_data import vtk_matrix  # noqa: E402
from SlicerUSSim.Logic.imaging.noise import seed_of_pose  # noqa: E402
from SlicerUSSim.Logic.mri.pathology import add_tissues, texture_below  # noqa: E402
from SlicerUSSim.Logic.mri.samples import head_mri  # noqa: E402
from SlicerUSSim.Logic.mri.sheets import find_sheets  # noqa: E402
from SlicerUSSim.Logic.mrml.label_nodes import read_labels, write_labels  # noqa: E402
from SlicerUSSim.Logic.mrml.nodes import node_to_world, write_volume  # noqa: E402
from SlicerUSSim.Logic.mrml.sheet_nodes import read_sheets, sheets_version, write_sheets  # noqa: E402
from SlicerUSSim.Logic.tissue import KINDS, Surfels  # noqa: E402
from tests.conftest import coarse_chest  # noqa: E402
from tests.remembered import segment_once  # noqa: E402
from tests.test_craniotomy_nodes import TURN  # noqa: E402
from tests.test_grown_lesions import CENTRE, brain  # noqa: E402
from tests.test_lesion_nodes import Scene  # noqa: E402

pytestmark = pytest.mark.usefixtures("segmented_once")


def some_surfels() -> Surfels:
    """Squares of all kinds, at random places with random normals."""
    rng = np.random.default_rng(3)
    normal = rng.normal(size=(40, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    parts = [
        Surfels.of(kind, rng.uniform(-40, 40, (10, 3)), normal[10 * n :][:10], rng.uniform(0.2, 1, 10), 0.7, 0.8)
        for n, kind in enumerate(KINDS)
    ]  # fmt: skip
    return Surfels.joined(parts)


@pytest.mark.parametrize("how", ["under a transform", "hardened", "scaled"])
def test_sheets_lie_where_transforms_of_their_model_put_them(how):
    bench, surfels = Scene(), some_surfels()
    model = bench.add("Model", "sheets")
    write_sheets(model, surfels, bench.mri)
    matrix = TURN if how != "scaled" else np.diag([2.0, 1.0, 1.0, 1.0])
    transform = bench.add("LinearTransform", "turn")
    transform.SetMatrixTransformToParent(vtk_matrix(matrix))
    before = sheets_version(model)
    model.SetAndObserveTransformNodeID(transform.GetID())
    if how == "hardened":
        model.HardenTransform()
        assert model.GetParentTransformNode() is None
    assert sheets_version(model) != before
    found = read_sheets(model, np.eye(4), KINDS)
    np.testing.assert_allclose(found.place, surfels.place @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-3)
    normal = surfels.normal @ np.linalg.inv(matrix[:3, :3])
    length = np.linalg.norm(normal, axis=1)
    cosine = np.abs((found.normal * normal).sum(axis=1)) / length
    np.testing.assert_allclose(cosine, 1.0, atol=1e-4)
    np.testing.assert_allclose(found.thickness, surfels.thickness / length, rtol=1e-3)  # twice as thick along x alone
    assert set(read_sheets(model, np.eye(4), ["falx"]).kind) == {KINDS.index("falx")}


def bench_with_probe() -> tuple[Scene, object]:
    bench = Scene("LabelMapVolume")
    presenter = bench.presenter(label_maps=True)
    bench.logic.preset = bench.logic.preset.changed("probe", scan_lines=48)
    return bench, presenter


@pytest.mark.slow
def test_segment_finds_sheets_and_images_show_them(monkeypatch):
    found = []

    def find(*arguments, **options):
        found.append(find_sheets(*arguments, **options))
        return found[-1]

    monkeypatch.setattr("SlicerUSSim.Logic.mrml.segment_logic.find_sheets", find)
    bench, presenter = bench_with_probe()
    mri = head_mri(5.0)
    write_volume(bench.mri, mri)
    parent = bench.add("LinearTransform", "to world")
    parent.SetMatrixTransformToParent(vtk_matrix(TURN))
    bench.mri.SetAndObserveTransformNodeID(parent.GetID())
    parameters = bench.logic.parameters
    presenter.values.setValue("scene.sheet_find", True)
    presenter.values.setValue("scene.thin_sulci", False)
    presenter.segmenting.segment()
    assert not presenter.view.errors, presenter.view.errors
    model = parameters.sheets
    assert model.GetName() == "Head sheets" and not model.GetDisplayNode().GetVisibility()
    np.testing.assert_allclose(node_to_world(model), TURN)
    assert "sulcus: " in presenter.notes.text() and "images show the sheets in 'Head sheets'" in presenter.notes.text()
    assert presenter.view.shares[-1] == 1.0 and np.all(np.diff(presenter.view.shares) >= 0)
    presenter.placing.placeProbe()
    presenter.images.simulate()
    shown = bench.logic.lastFrame.image

    result = segment_once(mri, classes=None, thin_sulci=False)
    laid = add_tissues(result.labels, result.tissue_names, found[0].masks(), has_brain_mask=True)  # corpus callosum
    preset, pose = bench.logic.preset, np.linalg.inv(TURN) @ node_to_world(parameters.probe_transform)
    simulator = UltrasoundSimulator(
        laid.labels, TissueTable.brain(laid.tissue_names), preset.settings,
        texture=texture_below(result.texture(), mri, result.labels, laid.labels), sheets=found[0].surfels,
    )  # fmt: skip
    expected = simulator.simulate(preset.probe, pose, preset.display, noise_seed=seed_of_pose(pose)).image

    for kind in KINDS:
        presenter.values.setValue(f"scene.sheet_{kind}", False)
    presenter.images.simulate()
    without = bench.logic.lastFrame.image
    assert np.abs(shown.astype(int) - expected).mean() < 0.01 and np.abs(without.astype(int) - shown).mean() > 1.0
    parameters.sheets = None
    presenter.images.simulate()
    np.testing.assert_array_equal(bench.logic.lastFrame.image, without)

    parameters.sheets = model
    presenter.values.setValue("scene.sheet_find", False)
    presenter.segmenting.segment()
    assert parameters.sheets is None and "of an earlier Segment, are no longer shown" in presenter.notes.text()


def test_sheets_of_a_user_are_kept_and_another_model_is_one_line():
    bench, presenter = bench_with_probe()
    parameters = bench.logic.parameters
    mine = bench.add("Model", "mine")
    write_sheets(mine, some_surfels(), bench.mri)
    mine.RemoveAttribute("SlicerUSSim.result")  # as loaded from a file
    parameters.sheets = mine
    presenter.segmenting.segment()
    assert parameters.sheets is mine and "images show the sheets in 'mine'" in presenter.notes.text()
    assert "falx" in bench.logic.tissues(parameters.labels).names()
    presenter.placing.placeProbe()
    presenter.images.simulate()
    parameters.sheets = parameters.outline  # a model without sheets
    presenter.images.simulate()
    (line,) = presenter.view.errors
    assert line.startswith("sheets Model 'Ultrasound outline': has no array 'place' of its cells, expected a file of")


def test_what_has_no_sheets_is_reported_before_anything_is_computed():
    bench, presenter = bench_with_probe()
    presenter.values.setValue("scene.sheet_find", True)
    for contrast, words in (("flair", "sheets are not found in contrast 'flair'"), ("ct", "in contrast 'ct'")):
        presenter.values.setValue("scene.contrast", contrast)
        presenter.segmenting.segment()
        assert words in presenter.view.errors[-1] and presenter.view.shares == []
    assert bench.logic.parameters.labels is None and bench.logic.parameters.sheets is None
    names = {node.GetName() for node in (bench.scene.GetNthNode(n) for n in range(bench.scene.GetNumberOfNodes()))}
    assert "Head sheets" not in names


# ---- organs of a CT --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_organs_of_a_ct_are_laid_over_its_tissues_wherever_their_node_lies():
    bench, phantom = Scene(), coarse_chest()
    write_volume(bench.mri, phantom.ct)
    liver = Volume((phantom.organs.array == 5).astype(np.uint8), np.linalg.inv(TURN) @ phantom.organs.ijk_to_ras)
    assert liver.array.sum() > 1000
    organs = bench.add("Segmentation", "organs")
    write_labels(organs, liver, ("liver",), organs)
    parent = bench.add("LinearTransform", "to world")
    parent.SetMatrixTransformToParent(vtk_matrix(TURN))
    organs.SetAndObserveTransformNodeID(parent.GetID())
    presenter, parameters = bench.presenter(label_maps=True), bench.logic.parameters
    parameters.organs = organs
    presenter.segmenting.segment()
    assert not presenter.view.errors and "organs: liver" in presenter.notes.text()
    assert "taken as a CT: its values are Hounsfield units" in presenter.notes.text()
    laid = bench.voxels("liver", parameters.labels)
    assert 0.6 * liver.array.sum() < laid <= liver.array.sum()


@pytest.mark.slow
def test_organs_without_names_are_read_by_totalsegmentators_numbers():
    """After Segment of a CT, they were mistaken for the tissues that it had found: a kidney for fat."""
    bench, phantom = Scene(), coarse_chest()
    organs = bench.add("LabelMapVolume", "organs")
    write_volume(organs, phantom.organs)
    found = read_labels(organs, TissueTable.named(("skin", "fat", "muscle", "blood", "bone")), of_ct=True)
    assert found.names == ("kidney", "liver", "lung")
    assert found.message.startswith("TotalSegmentator CT: 3 labels")


# ---- lesions that are grown ------------------------------------------------------------------------------------------


def growing() -> tuple[Scene, object, np.ndarray]:
    """A scene whose MRI was segmented, with a tumour at CENTRE; its (k, j, i) voxels."""
    segmentation, true = brain("low")
    bench = Scene("LabelMapVolume")
    write_volume(bench.mri, segmentation.labels)
    presenter = bench.presenter(label_maps=True)
    write_labels(bench.labels, segmentation.labels, segmentation.tissue_names, bench.mri)
    bench.logic.parameters.labels = bench.labels
    return bench, presenter, true


def test_a_point_in_a_view_grows_a_lesion_that_is_removed_or_laid_on():
    bench, presenter, true = growing()
    parameters, lesions = bench.logic.parameters, presenter.lesions
    assert lesions.canGrow() == (False, "Segment this MRI first")
    lesions.pickSeed()
    assert "segment this MRI first" in presenter.view.errors.pop()
    bench.logic.growth.segmented(bench.mri, brain("low")[0])
    assert lesions.canGrow()[0]
    lesions.pickSeed()
    node, picked = presenter.view.picking
    assert node is parameters.seed and not lesions.canRemove()[0]
    node.AddControlPointWorld(0.0, 0.0, 300.0)
    picked()
    assert "300" not in presenter.notes.aboutLesions() and "mm outside the image" in presenter.view.errors.pop()
    assert parameters.lesions is None
    node.AddControlPointWorld(*CENTRE)
    picked()
    grown = parameters.lesions.GetSegmentation()
    assert not presenter.view.errors and list(grown.GetSegmentIDs()) and lesions.canRemove()[0]
    assert (
        "grown: tumour" in presenter.notes.aboutLesions() and "add it to the tissues" in presenter.notes.aboutLesions()
    )
    assert parameters.lesions.GetDisplayNode().GetVisibility()
    with pytest.raises(ValueError, match="not in tuple"):  # nothing is laid over the tissues
        bench.voxels("tumour", parameters.labels)
    lesions.removeGrown()
    assert (
        not list(grown.GetSegmentIDs())
        and not lesions.canRemove()[0]
        and "grown: " not in presenter.notes.aboutLesions()
    )
    lesions.growAtPoint()
    lesions.addTissues()
    assert not presenter.view.errors and "grown: " not in presenter.notes.aboutLesions()
    laid = bench.voxels("tumour", parameters.labels)
    assert 0.6 * true.sum() < laid < 1.4 * true.sum()
    parameters.panel = replace(parameters.panel, lesion_size="larger")
    lesions.growAtPoint()  # beside the smaller one, which stays
    assert not presenter.view.errors and len(list(grown.GetSegmentIDs())) == 2
    lesions.addTissues()
    assert bench.voxels("tumour", parameters.labels) > 1.02 * laid
