"""Lesions in a scene, and labels of others, which do not change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

slicer = pytest.importorskip("slicer", reason="MRML nodes come with slicer-core: pip install '.[slicer]'")

from SlicerUSSim.Logic import SimulationError, Volume  # noqa: E402
from SlicerUSSim.Logic.base.vtk_data import vtk_matrix  # noqa: E402
from SlicerUSSim.Logic.mri import add_tissues  # noqa: E402
from SlicerUSSim.Logic.mri.samples import head_mri  # noqa: E402
from SlicerUSSim.Logic.mrml.label_nodes import node_labels, read_labels, write_labels  # noqa: E402
from SlicerUSSim.Logic.mrml.lesion_nodes import add_lesion  # noqa: E402
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic  # noqa: E402
from SlicerUSSim.Logic.mrml.nodes import write_volume  # noqa: E402
from SlicerUSSim.Widget.presenter import PanelPresenter  # noqa: E402
from tests.conftest import rigid  # noqa: E402
from tests.test_pathology import ball, empty, moved  # noqa: E402
from tests.test_presenter import PlainView  # noqa: E402

pytestmark = pytest.mark.usefixtures("segmented_once")

HEAD = head_mri(4.0)
PLACE = np.array([30.0, 10.0, 35.0])
KINDS = ["LabelMapVolume", "Segmentation"]


def lesion(radius: float, centre=PLACE) -> Volume:
    """A ball on a separate grid, finer than the head's and turned."""
    return ball(moved(empty((1.3, 1.3, 2.0), np.diag([-1.0, -1.0, 1.0]), 22), *PLACE), radius, centre)


def brats(values: tuple[int, int, int]) -> Volume:
    """Shells with these labels, from the inside."""
    r = np.sqrt(((np.indices((20, 20, 20)) - 9.5) ** 2).sum(axis=0))
    return Volume(np.select([r < 4, r < 6, r < 9], values, 0).astype(np.uint8), rigid(np.eye(3), PLACE - 9.5))


class Scene:
    """A head with tissues of either kind, and lesions."""

    def __init__(self, kind: str = "Segmentation", **lesions: float) -> None:
        self.scene = slicer.vtkMRMLScene()
        self.mri = self.add("ScalarVolume", "Head")
        write_volume(self.mri, HEAD)
        self.labels, self.lesions = self.add(kind, "tissues"), self.add("Segmentation", "Lesions")
        for name, radius in lesions.items():
            self.paint(lesion(radius), name)
        self.logic = UltrasoundSceneLogic(self.scene)

    def add(self, kind: str, name: str):
        return self.scene.AddNewNodeByClass(f"vtkMRML{kind}Node", name)

    def paint(self, mask: Volume, name: str) -> None:
        """As a user does in the segment editor: a segment with a name of his own."""
        (segment,) = add_lesion(self.lesions, mask, "tumour", "tumour.nii")
        self.lesions.GetSegmentation().GetSegment(segment).SetName(name.replace("_", " "))

    def voxels(self, name: str, node=None) -> int:
        labelled = read_labels(self.labels if node is None else node, self.logic.preset.tissues)
        return int((labelled.labels.array == labelled.names.index(name) + 1).sum())

    def presenter(self, **options) -> PanelPresenter:
        result = PanelPresenter(self.logic, PlainView(), **options)
        parameters = self.logic.parameters
        parameters.mri, parameters.labels = self.mri, None
        return result


def millilitres(radius: float) -> float:
    return 4 / 3 * np.pi * (radius / 10) ** 3


# ---- lesions over labels ---------------------------------------------------------------------------------------------


def test_segments_called_as_tissues_are_laid_over_them_others_are_reported():
    bench = Scene("LabelMapVolume", Peritumoral_Edema=16.0, my_tumor=10.0, Segment_1=3.0)
    bench.logic.segment(bench.mri, bench.labels)
    added = bench.logic.addTissues(bench.labels, bench.lesions)
    assert [note.split(":")[0] for note in added.messages] == ["oedema", "tumour"]
    assert bench.logic.notes == added.messages
    assert bench.logic.warnings == ("segment 'Segment 1' of 'Lesions' is not added: no tissue is called so",)
    assert bench.voxels("tumour") * 0.064 == pytest.approx(millilitres(10), rel=0.05)
    assert bench.voxels("oedema") * 0.064 == pytest.approx(millilitres(16) - millilitres(10), rel=0.1)
    assert bench.logic.mayReplace(bench.labels)
    once = bench.voxels("oedema")
    bench.logic.addTissues(bench.labels, bench.lesions)
    assert bench.voxels("oedema") == once
    again = bench.logic.segment(bench.mri, bench.labels, lesions_node=bench.lesions)
    assert bench.voxels("oedema") == once and "tumour" not in again.tissue_names


@pytest.mark.parametrize("kind", KINDS)
def test_tissues_read_from_the_scene_get_the_same_lesion_as_the_arrays(kind):
    """Also a lesion that reaches out of the brain, where a segmentation node is cropped."""
    bench, outside = Scene(kind), np.array([60.0, 10.0, 35.0])
    mask = moved(lesion(9.0), *(outside - PLACE))
    bench.paint(mask, "tumour")
    result = bench.logic.segment(bench.mri, bench.labels)
    direct = add_tissues(result.labels, result.tissue_names, [("tumour", mask, "")])
    expected = int((direct.labels.array == direct.tissue_names.index("tumour") + 1).sum())
    for logic in (bench.logic, UltrasoundSceneLogic(bench.scene)):  # the second one has not segmented
        logic.segment(bench.mri, bench.labels)
        logic.addTissues(bench.labels, bench.lesions)
        assert bench.voxels("tumour") == expected
        assert any(warning.startswith("the brain mask leaves out ") for warning in logic.warnings)
    write_labels(bench.labels, result.labels, result.tissue_names, bench.mri)
    other = bench.add(kind, "other")
    bench.logic.addTissues(bench.labels, bench.lesions, other)
    assert bench.voxels("tumour", other) == expected


def test_transforms_of_tissues_and_of_lesions_are_followed():
    bench = Scene(tumour=10.0)
    for node, shift in ((bench.lesions, (0, 40, 0)), (bench.mri, (7, 8, 9))):
        transform = bench.add("LinearTransform", "moved")
        transform.SetMatrixTransformToParent(vtk_matrix(rigid(np.eye(3), shift)))
        node.SetAndObserveTransformNodeID(transform.GetID())
    result = bench.logic.segment(bench.mri, bench.labels)
    bench.logic.addTissues(bench.labels, bench.lesions)
    volume, names = node_labels(bench.labels)
    (label,) = (label for label, name in names.items() if name == "tumour")
    k, j, i = np.argwhere(volume.array == label).mean(axis=0)
    centre = (volume.ijk_to_ras @ [i, j, k, 1])[:3]
    np.testing.assert_allclose(centre, PLACE + [0, 40, 0] - np.array([7, 8, 9]), atol=0.5)
    assert result.tissue_names[0] == "csf"


@pytest.mark.parametrize(
    ("paint", "message"),
    [
        ([], "is empty, expected segments called tumour, oedema"),
        ([(lesion(8.0), "Segment_1")], "segment 'Segment 1' of 'Lesions' is not added: no tissue is called so;"),
    ],
)
def test_lesions_that_cannot_be_added_are_one_line_and_change_nothing(paint, message):
    bench = Scene("LabelMapVolume")
    for mask, name in paint:
        bench.paint(mask, name)
    bench.logic.segment(bench.mri, bench.labels)
    before = bench.labels.GetImageData().GetMTime()
    for call in (
        lambda: bench.logic.addTissues(bench.labels, bench.lesions),
        lambda: bench.logic.segment(bench.mri, bench.labels, lesions_node=bench.lesions),
    ):
        with pytest.raises(SimulationError, match=message) as caught:
            call()
        assert "\n" not in str(caught.value) and bench.labels.GetImageData().GetMTime() == before


def test_a_lesion_of_another_place_leaves_the_segmentation_and_a_warning():
    bench = Scene("LabelMapVolume")
    bench.paint(moved(lesion(8.0), 300, 0, 0), "tumour")
    bench.logic.segment(bench.mri, bench.labels, lesions_node=bench.lesions)
    assert "no lesion was added: tumour.nii (segment 'tumour'): lies 2" in bench.logic.warnings[-1]
    before = bench.labels.GetImageData().GetMTime()
    with pytest.raises(SimulationError, match=r"^tumour\.nii \(segment 'tumour'\): lies 2.. mm outside"):
        bench.logic.addTissues(bench.labels, bench.lesions)
    assert bench.labels.GetImageData().GetMTime() == before


def test_doubts_about_a_file_of_lesions_are_reported_every_time():
    """Of a BraTS map that was added as one tissue, and not only when it was opened."""
    bench = Scene()
    whole = replace(brats((1, 3, 2)), doubts=("brats3.nii.gz: 7 voxels are NaN",))
    add_lesion(bench.lesions, whole, "tumour", "brats3.nii.gz")
    bench.logic.segment(bench.mri, bench.labels, lesions_node=bench.lesions)
    told = (
        "brats3.nii.gz holds the labels 1, 2, 3; all of them are added as tumour (brats=FILE adds the tissues of "
        "a BraTS map)",
        "brats3.nii.gz: 7 voxels are NaN",
    )
    assert set(told) <= set(bench.logic.warnings)
    add_lesion(bench.lesions, whole, "tumour", "brats3.nii.gz")  # again
    bench.logic.addTissues(bench.labels, bench.lesions)
    assert [bench.logic.warnings.count(line) for line in told] == [1, 1]
    with pytest.raises(SimulationError, match=r"what it is: tumour=FILE, or necrosis=FILE if it is BraTS's label 1$"):
        add_lesion(bench.lesions, whole.with_array((whole.array == 1).astype(np.uint8)), "brats", "core")


# ---- labels that do not change ---------------------------------------------------------------------------------------


def edit(node) -> None:
    """As the segment editor or a script does: one voxel less."""
    volume, names = node_labels(node)
    array = volume.array.copy()
    array[tuple(np.argwhere(array)[0])] = 0
    if node.IsA("vtkMRMLSegmentationNode"):
        write_labels(node, volume.with_array(array.astype(np.uint8)), names.values(), node)
    else:
        write_volume(node, volume.with_array(array))


def rename(segmentation) -> None:
    segmentation.GetSegmentation().GetNthSegment(1).SetName("tumour")


@pytest.mark.parametrize(("kind", "change"), [(KINDS[0], edit), (KINDS[1], edit), (KINDS[1], rename)])
def test_segment_does_not_replace_labels_that_were_edited(kind, change):
    bench = Scene(kind)
    assert bench.logic.mayReplace(bench.labels)  # empty
    bench.logic.segment(bench.mri, bench.labels)
    bench.logic.segment(bench.mri, bench.labels)
    change(bench.labels)
    content = node_labels(bench.labels)
    assert not bench.logic.mayReplace(bench.labels)
    kept = "'tissues' was not made by Segment, or edited since, and is not replaced"
    with pytest.raises(SimulationError, match=kept):
        bench.logic.segment(bench.mri, bench.labels)
    with pytest.raises(SimulationError, match=kept):
        bench.logic.addTissues(bench.labels, bench.lesions)
    np.testing.assert_array_equal(node_labels(bench.labels)[0].array, content[0].array)
    bench.logic.segment(bench.mri, bench.labels, overwrite=True)
    assert bench.logic.mayReplace(bench.labels)


def test_segments_without_voxels_are_a_users_plan_and_not_replaced():
    bench = Scene()
    plan = bench.add("Segmentation", "plan")
    write_labels(plan, HEAD.with_array(np.zeros(HEAD.array.shape, np.uint8)), ("my plan",), bench.mri)
    with pytest.raises(SimulationError, match="'plan' was not made by Segment, or edited since, and is not replaced"):
        bench.logic.segment(bench.mri, plan)
    zeros = bench.add("LabelMapVolume", "zeros")
    write_volume(zeros, HEAD.with_array(np.zeros(HEAD.array.shape, np.uint8)))
    assert not bench.logic.mayReplace(zeros)


@pytest.mark.parametrize("kind", KINDS)
def test_tissues_keep_the_colours_that_a_user_gave_them(kind):
    bench = Scene(kind, tumour=10.0)
    bench.logic.segment(bench.mri, bench.labels)

    def colours() -> dict[str, tuple[float, ...]]:
        if kind == "Segmentation":
            segments = bench.labels.GetSegmentation()
            found = [segments.GetSegment(segment_id) for segment_id in segments.GetSegmentIDs()]
            return {segment.GetName(): tuple(np.round(segment.GetColor(), 3)) for segment in found}
        table, found = bench.labels.GetDisplayNode().GetColorNode(), {}
        for label in range(1, table.GetNumberOfColors()):
            colour = [0.0] * 4
            table.GetColor(label, colour)
            found[table.GetColorName(label)] = tuple(np.round(colour[:3], 3))
        return found

    before = colours()
    if kind == "Segmentation":
        bench.labels.GetSegmentation().GetNthSegment(1).SetColor(1.0, 0.0, 0.2)
    else:
        bench.labels.GetDisplayNode().GetColorNode().SetColor(2, 1.0, 0.0, 0.2, 1.0)
    expected = {**before, "grey matter": (1.0, 0.0, 0.2)}
    assert before["grey matter"] != expected["grey matter"] and colours() == expected
    bench.logic.segment(bench.mri, bench.labels)
    assert colours() == expected
    bench.logic.addTissues(bench.labels, bench.lesions)
    assert {name: colour for name, colour in colours().items() if name != "tumour"} == expected


def test_a_segmentation_that_was_saved_and_loaded_is_still_segments_own(tmp_path):
    bench = Scene()
    bench.logic.segment(bench.mri, bench.labels)
    storage = bench.add("SegmentationStorage", "file")
    storage.SetFileName(str(tmp_path / "tissues.seg.nrrd"))
    assert storage.WriteData(bench.labels)
    again = bench.add("Segmentation", "again")
    assert storage.ReadData(again)
    assert not bench.logic.mayReplace(again)
    again.SetAttribute("SlicerUSSim.made", bench.labels.GetAttribute("SlicerUSSim.made"))  # as the scene's file does
    assert not bench.logic.mayReplace(again)  # a copy, until the scene's file says that it is the node itself
    again.SetNodeReferenceID("SlicerUSSim.own", again.GetID())
    assert bench.logic.mayReplace(again)


@pytest.mark.parametrize("label_maps", [True, False])
def test_tissues_that_must_stay_are_kept_and_the_new_node_is_named(label_maps):
    bench = Scene()
    presenter, parameters = bench.presenter(label_maps=label_maps), bench.logic.parameters
    presenter.segmenting.segment()
    first = parameters.labels
    assert first.IsA("vtkMRMLLabelMapVolumeNode" if label_maps else "vtkMRMLSegmentationNode")
    presenter.segmenting.segment()
    assert parameters.labels is first and "is kept" not in presenter.notes.text()
    edit(first)
    before = node_labels(first)[0].array.copy()
    presenter.segmenting.segment()
    assert parameters.labels is not first and not presenter.view.errors
    line = presenter.notes.text().splitlines()[-1]
    assert line.startswith("'Head tissues' was not made by Segment, or edited since, and is kept; the result is ")
    assert line.endswith(repr(parameters.labels.GetName()))
    np.testing.assert_array_equal(node_labels(first)[0].array, before)


def test_the_panel_lays_lesions_over_a_copy_of_the_users_own_labels():
    bench = Scene("LabelMapVolume", tumour=10.0)
    result = bench.logic.segment(bench.mri, bench.labels)
    write_labels(bench.labels, result.labels, result.tissue_names, bench.mri)
    edit(bench.labels)
    presenter, parameters = bench.presenter(), bench.logic.parameters
    parameters.labels = bench.labels
    assert presenter.lesions.canAddTissues() == (
        False,
        "Choose a segmentation with segments called tumour, oedema, ...",
    )
    parameters.lesions = bench.lesions
    assert presenter.lesions.canAddTissues()[0]
    presenter.lesions.addTissues()
    assert parameters.labels.GetName() == "tissues with lesions" and bench.voxels("tumour", parameters.labels) > 50
    assert "'tissues' was not made by Segment" in presenter.notes.text() and "tumour: " in presenter.notes.text()
    assert "tumour" not in node_labels(bench.labels)[1].values()
    own = parameters.labels
    presenter.lesions.addTissues()  # of its own making
    assert parameters.labels is own
