"""The panel's presenter without Qt, with another view, as in the browser."""

from __future__ import annotations

import inspect
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import pytest

slicer = pytest.importorskip("slicer", reason="MRML nodes come with slicer-core: pip install '.[slicer]'")

from SlicerUSSim.Logic.base.declaration import Shown, parameter  # noqa: E402
from SlicerUSSim.Logic.base.transforms import pose_of_angles  # noqa: E402
from SlicerUSSim.Logic.mri.samples import head_mri  # noqa: E402
from SlicerUSSim.Logic.mrml.craniotomy_nodes import set_closed_labels  # noqa: E402
from SlicerUSSim.Logic.mrml.label_nodes import read_labels, write_labels  # noqa: E402
from SlicerUSSim.Logic.mrml.lesion_nodes import add_lesion  # noqa: E402
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic  # noqa: E402
from SlicerUSSim.Logic.mrml.nodes import probe_pose, read_volume, set_node_to_world, write_volume  # noqa: E402
from SlicerUSSim.Logic.mrml.own_results import content_of  # noqa: E402
from SlicerUSSim.Logic.mrml.share_nodes import read_shares  # noqa: E402
from SlicerUSSim.Logic.mrml.taken_image import about_image, is_frozen, patient_of  # noqa: E402
from SlicerUSSim.Logic.probe.arrays import PROBE_KINDS, PROBES, LinearProbe  # noqa: E402
from SlicerUSSim.Logic.tissue.schemes import schemes  # noqa: E402
from SlicerUSSim.Widget.interface import by_widget, in_panel  # noqa: E402
from SlicerUSSim.Widget.presenter import PanelPresenter  # noqa: E402
from SlicerUSSim.Widget.sections import panel_sections  # noqa: E402
from SlicerUSSim.Widget.value_presenter import CUSTOM_PROBE  # noqa: E402

pytestmark = pytest.mark.usefixtures("segmented_once")


class PlainView:
    """Records all calls; its event loop is a list."""

    def __init__(self) -> None:
        self.errors, self.status, self.waiting, self.shares, self.refreshed = [], [], [], [], 0

    def showError(self, message: str) -> None:
        self.errors.append(message)

    def showStatus(self, message: str) -> None:
        self.status.append(message)

    def refresh(self, changed=None) -> None:
        self.refreshed += 1
        self.changed = changed

    @contextmanager
    def progress(self, title: str):
        yield self.shares.append

    def schedule(self, function) -> None:
        self.waiting.append(function)

    def sliceNode(self):
        return None

    def pickPoint(self, points_node, picked) -> None:
        self.picking = points_node, picked


@pytest.fixture
def presenter():
    scene = slicer.vtkMRMLScene()
    node = scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "Head")
    write_volume(node, head_mri(3.5))
    result = PanelPresenter(UltrasoundSceneLogic(scene), PlainView())
    result.chooseDefaultNodes()
    return result


def test_from_mri_to_live_image(presenter):
    view = presenter.view
    assert presenter.segmenting.canSegment()[0] and not presenter.canSimulate()[0]
    presenter.segmenting.segment()
    assert presenter.canSimulate()[0] and view.shares[-1] == 1.0
    presenter.values.setValue("probe.scan_lines", 48)
    presenter.images.setLive(True)
    assert presenter.images.isLive() and not view.errors
    before = slicer.util.arrayFromVolume(presenter.logic.parameters.output).copy()
    presenter.values.setValue("display.gain_db", 10.0)
    assert presenter.values.value("display.gain_db") == 10.0 and len(view.waiting) == 1
    view.waiting.pop()()
    after = slicer.util.arrayFromVolume(presenter.logic.parameters.output)
    assert after.astype(float).mean() > before.astype(float).mean() + 10
    presenter.images.setLive(False)
    assert not presenter.images.isLive()


def test_the_tissues_of_another_patient_in_the_scene_stay(presenter):
    """Segment wrote the second patient into the first one's node, with the first one's lesions."""
    parameters, scene = presenter.logic.parameters, presenter.logic.scene
    presenter.segmenting.segment()
    first, content = parameters.labels, content_of(parameters.labels)
    parameters.lesions = scene.AddNewNodeByClass("vtkMRMLSegmentationNode", "Lesions")
    other = scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "Other")
    write_volume(other, head_mri(4.5))
    parameters.mri = other
    presenter.segmenting.segment()
    assert not presenter.view.errors and parameters.labels is not first and parameters.lesions is None
    assert parameters.labels.GetName() == "Other tissues" and content_of(first) == content
    assert "'Head tissues' belongs to another MRI, and is kept" in presenter.notes.text()
    assert "'Lesions' was chosen for another MRI and was not used" in presenter.notes.text()


def test_tissues_follow_the_chosen_mri_and_live_images_stop(presenter):
    """Live went on with the tissues of the MRI before."""
    parameters, scene = presenter.logic.parameters, presenter.logic.scene
    presenter.segmenting.segment()
    presenter.images.setLive(True)
    presenter.parametersChanged()
    first, of_first = parameters.mri, parameters.labels
    parameters.mri = scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "Other")
    presenter.parametersChanged()
    assert parameters.labels is None and not presenter.images.isLive()
    assert presenter.view.status[-1].startswith("FROZEN: Head") and not presenter.view.errors
    parameters.mri = first
    presenter.parametersChanged()
    assert parameters.labels is of_first and not presenter.images.isLive()


def test_a_sweep_along_a_path_is_a_sequence_and_a_volume(presenter):
    parameters, scene = presenter.logic.parameters, presenter.logic.scene
    sequences = slicer.vtkSlicerSequencesLogic()
    sequences.SetMRMLScene(scene)  # registers browsers
    presenter.segmenting.segment()
    presenter.placing.placeProbe()
    presenter.values.setValue("probe.scan_lines", 48)
    parameters.path = scene.AddNewNodeByClass("vtkMRMLMarkupsLineNode", "Path")
    presenter.images.sweepAlongPath()
    assert "has 0 points, expected two or more" in presenter.view.errors.pop()
    here = probe_pose(parameters.probe_transform)[:3, 3]
    for step in (-2.0, 2.0):
        parameters.path.AddControlPointWorld(*(here + [0, step, 0]))
    presenter.images.sweepAlongPath()
    images, volume = parameters.image_sequence, scene.GetFirstNodeByName("Path volume")
    assert images.GetName() == "Path ultrasound" and images.GetNumberOfDataNodes() >= 4 and not presenter.view.errors
    assert presenter.images.sequenceDone.endswith("images in 'Path ultrasound', compounded to 'Path volume'")
    assert slicer.util.arrayFromVolume(volume).max() > 100
    assert parameters.transform_sequence.GetNumberOfDataNodes() == images.GetNumberOfDataNodes()


def test_presets_carry_the_pose_if_it_is_wanted(presenter, tmp_path):
    view, parameters = presenter.view, presenter.logic.parameters
    presenter.values.setValue("scene.preset_pose", True)
    presenter.values.savePreset(tmp_path / "none.json")
    assert "Pose in presets is ticked, and there is no probe" in view.errors.pop() and not list(tmp_path.iterdir())
    presenter.segmenting.segment()
    presenter.placing.placeProbe()
    pose = probe_pose(parameters.probe_transform) @ pose_of_angles([3.0, 0, 5.0], [0, 10.0, 20.0])
    set_node_to_world(parameters.probe_transform, pose)
    presenter.values.savePreset(tmp_path / "with.json")
    presenter.values.setValue("scene.preset_pose", False)
    presenter.values.savePreset(tmp_path / "without.json")
    presenter.placing.placeProbe()
    placed = probe_pose(parameters.probe_transform)
    presenter.values.loadPreset(tmp_path / "without.json")
    np.testing.assert_array_equal(probe_pose(parameters.probe_transform), placed)
    presenter.values.loadPreset(tmp_path / "with.json")
    np.testing.assert_allclose(probe_pose(parameters.probe_transform), pose, atol=1e-9)
    assert not view.errors and presenter.logic.preset.probe_to_ras is None  # the probe's node has it
    parameters.labels = None
    presenter.values.loadPreset(tmp_path / "with.json")
    assert "the pose of the preset is not used, since there are no tissues" in view.errors.pop()


def test_an_output_of_others_is_kept_and_a_new_one_selected(presenter):
    logic = presenter.logic
    presenter.segmenting.segment()
    presenter.values.setValue("probe.scan_lines", 48)
    scan = logic.scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "CT")
    write_volume(scan, head_mri(3.5))
    logic.parameters.output = scan
    presenter.images.simulate()
    assert not presenter.view.errors and logic.parameters.output.GetName() == "Ultrasound"
    assert "'CT' has other data and is kept; the result is 'Ultrasound'" in presenter.notes.text()
    np.testing.assert_array_equal(slicer.util.arrayFromVolume(scan), head_mri(3.5).array)
    chosen = logic.parameters.output
    presenter.images.simulate()
    assert logic.parameters.output is chosen


def test_every_control_shows_something_and_says_whether_it_can_be_used(presenter):
    controls = by_widget(panel_sections(presenter))
    own = {"loadPreset", "savePreset", "assignTissue", "editTissues", "layout"}  # of the view
    for control in controls.values():
        assert control.shows is None or control.shows() is not None, control.name
        is_pressed = control.kind in ("button", "picture") and control.name not in own
        assert (control.action is not None) == is_pressed, control.name
        for method, given in ((control.action, False), (control.sets, True)):
            if method is not None:
                needs = [
                    entry for entry in inspect.signature(method).parameters.values() if entry.default is entry.empty
                ]
                assert bool(needs) == given, control.name
        can, tip = control.usable()
        assert isinstance(can, bool) and tip
    assert len(controls) > 60


def test_a_parameter_of_a_new_probe_is_in_the_panel_by_its_declaration(presenter):
    @dataclass(frozen=True)
    class RingProbe(LinearProbe):
        kind = "ring"
        turn_deg: float = parameter(
            0.0, "Turn", "About its axis", unit="°", bounds=(-180, 180), shown=Shown(-90, 90, 0.5)
        )

    try:
        control = by_widget(panel_sections(presenter))["turnSpinBox"]
        assert control.tip == "About its axis (-90 to 90°)" and control.suffix == "°" and control.decimals == 1
        assert presenter.values.value("probe.turn_deg") is None  # the probe in use has none
    finally:
        del PROBE_KINDS["ring"]


def test_widgets_are_called_after_what_they_show_without_its_unit(presenter):
    names = {
        control.value: control.widget for control in by_widget(panel_sections(presenter)).values() if control.value
    }
    assert names["display.tgc_db_cm_mhz"] == "tgcSlider" and names["probe.field_of_view_deg"] == "fieldOfViewSpinBox"
    assert names["settings.contact_gap_mm"] == "contactGapSpinBox" and names["probe.kind"] == "kindComboBox"
    assert names["scene.fit_frames"] == "fitFramesLineEdit" and names["scene.outside"] == "outsideCheckBox"
    section = panel_sections(presenter)[0]
    with pytest.raises(ValueError, match="two controls of one name"):
        by_widget((section, section))


def test_values_are_shown_in_the_unit_of_the_panel_and_meant_in_their_own(presenter):
    presenter.values.setValue("display.noise_db", -150.0)
    assert presenter.logic.preset.display.noise_db is None and presenter.values.value("display.noise_db") == -150.0
    presenter.values.setValue("probe.focus_mm", 0.0)
    assert presenter.values.value("probe.focus_mm") == 54.0  # where it is by default
    presenter.values.setValue("probe.scan_lines", 64.0)
    assert type(presenter.logic.preset.probe.scan_lines) is int
    assert presenter.values.value("probe.width_mm") is None
    presenter.values.setValue("scene.fit_evaluations", 70.0)
    assert presenter.logic.parameters.fit.evaluations == 70 and not presenter.view.errors
    for wrong in (float("nan"), "many", True, None):
        presenter.values.setValue("scene.fit_evaluations", wrong)
        assert "Evaluations is " in presenter.view.errors[-1] and presenter.values.value("scene.fit_evaluations") == 70
    assert len(presenter.view.errors) == 4


def test_every_probe_preset_is_offered_by_a_readable_name(presenter):
    control = by_widget(panel_sections(presenter))["probePresetComboBox"]
    assert len(control.choices) == len(PROBES) + 1
    for name, probe in PROBES.items():
        shown = name.replace("_", " ")
        assert shown in control.choices and f"{shown} {probe.frequency_mhz:g} MHz" in control.tip
        for spelling in (shown, name):  # scripts may use the name in PROBES
            presenter.logic.preset = presenter.logic.preset.changed("probe", depth_mm=77.0)
            assert presenter.values.probeName() == CUSTOM_PROBE
            presenter.values.chooseProbe(spelling)
            assert presenter.logic.preset.probe == probe and presenter.values.probeName() == shown
            presenter.values.chooseProbe(CUSTOM_PROBE)  # back to the previous one
            assert presenter.values.probeName() == CUSTOM_PROBE and presenter.logic.preset.probe.depth_mm == 77.0
    assert not presenter.view.errors


def test_custom_without_a_custom_probe_says_how_to_make_one(presenter):
    presenter.values.chooseProbe("linear")
    presenter.values._custom_probe = None
    presenter.values.chooseProbe(CUSTOM_PROBE)
    assert presenter.values.probeName() == "linear"
    assert presenter.view.errors == ["there is no custom probe yet: change a value of this probe to make one"]


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda p: p.values.setValue("display.gain_db", 1000.0), "Gain is 1000 dB, expected a number between -"),
        (lambda p: p.values.chooseProbe("loud"), "no probe is called 'loud', expected one of phased"),
        (lambda p: p.tissues.setTissue("csf", "mu0", "nan"), "tissue 'csf': mu0 is 'nan', expected a number"),
        (lambda p: p.tissues.assignTissue("csf", "cheese"), "no tissue is called 'cheese'"),
        (lambda p: p.images.setLive(True), "no label map chosen; segment the MRI first"),
        (lambda p: p.values.loadPreset("/nowhere.json"), "/nowhere.json: cannot be read"),
    ],
)
def test_what_a_user_does_wrong_is_shown_and_changes_nothing(presenter, act, message):
    before, nodes = presenter.logic.preset, presenter.logic.scene.GetNumberOfNodes()
    act(presenter)
    assert len(presenter.view.errors) == 1 and message in presenter.view.errors[0]
    assert presenter.logic.preset == before and presenter.logic.scene.GetNumberOfNodes() == nodes
    assert presenter.view.refreshed


def test_a_bug_of_ours_is_not_swallowed(presenter, monkeypatch):
    monkeypatch.setattr(presenter.logic, "segment", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        presenter.segmenting.segment()
    assert presenter.logic.scene.GetFirstNodeByName("Head tissues") is None and presenter.segmenting.canSegment()[0]


def test_the_notes_say_what_the_shown_labels_were_recognised_as(presenter):
    """They stayed those of the segmentation before; what labels are was in the log alone."""
    from tests.test_label_maps import ASEG, numbered

    presenter.segmenting.segment()
    presenter.images.simulate()
    assert "\nHead:\n" in presenter.notes.text() and not presenter.view.errors
    scene = presenter.logic.scene
    more = numbered(ASEG)
    more.array[more.array == 255] = 9999
    for name, volume in (("aseg", numbered(ASEG)), ("more", more)):
        node = scene.AddNewNodeByClass("vtkMRMLLabelMapVolumeNode", name)
        write_volume(node, volume)
        presenter.logic.parameters.labels = node
        presenter.images.simulate()
        assert f"{name}: FreeSurfer" in presenter.notes.text()
    assert "ml) is unknown and taken as" in presenter.notes.text() and not presenter.view.errors
    assert presenter.notes.text().startswith("Check: ")  # what is urgent comes first


def test_lesions_leave_the_checks_of_the_tissues_under_them_in_the_notes(presenter):
    """The line about the nearest tissue was gone when a tumour had been laid over the tissues."""
    from tests.test_label_maps import head as head_of_freesurfer

    scene, parameters = presenter.logic.scene, presenter.logic.parameters
    whole = head_of_freesurfer()
    labels, numbers = np.unique(whole.array, return_inverse=True)
    names = [schemes()["freesurfer"].names[int(label)] for label in labels[1:]]
    whole = whole.with_array(numbers.reshape(whole.array.shape).astype(np.uint8))
    names[-1] = "Cerebral-Exterior"
    parameters.labels = scene.AddNewNodeByClass("vtkMRMLLabelMapVolumeNode", "whole")
    write_labels(parameters.labels, whole, names, parameters.mri)
    presenter.images.simulate()
    checks = [line for line in presenter.notes.text().splitlines() if "the nearest tissue is used" in line]
    assert len(checks) == 1
    mask = np.zeros(whole.array.shape, np.uint8)
    centre = np.argwhere(whole.array > 0).mean(axis=0).astype(int)
    mask[tuple(slice(at - 3, at + 4) for at in centre)] = 1
    parameters.lesions = scene.AddNewNodeByClass("vtkMRMLSegmentationNode", "Lesions")
    add_lesion(parameters.lesions, whole.with_array(mask), "tumour", "tumour.nii.gz")
    for _ in range(2):
        presenter.lesions.addTissues()
        lines = presenter.notes.text().splitlines()
        assert not presenter.view.errors and lines.count(checks[0]) == 1 and any("tumour: " in line for line in lines)
        presenter.images.simulate()
        assert presenter.notes.text().splitlines() == lines
    parameters.labels = scene.AddNewNodeByClass("vtkMRMLLabelMapVolumeNode", "whole")
    write_labels(parameters.labels, whole, names, parameters.mri)
    presenter.lesions.addTissues()  # over the tissues of another patient, which were not simulated yet
    assert "tumour: " in presenter.notes.text() and checks[0] not in presenter.notes.text()


def test_an_image_that_does_not_follow_the_probe_is_called_frozen(presenter):
    presenter.segmenting.segment()
    presenter.values.setValue("probe.scan_lines", 48)
    presenter.images.setLive(True)
    output, probe = presenter.logic.parameters.output, presenter.logic.parameters.probe_transform
    assert output.GetParentTransformNode() is probe
    presenter.images.setLive(False)
    assert presenter.view.status[-1].startswith("FROZEN: Head, ") and output.GetParentTransformNode() is None
    presenter.images.simulate()
    assert output.GetParentTransformNode() is None and is_frozen(output)
    assert about_image(output)["patient"] == "Head"


@pytest.mark.parametrize("label_maps", [False, True])
def test_the_last_segment_can_be_undone(presenter, label_maps):
    presenter.segmenting._label_maps = label_maps
    logic, parameters = presenter.logic, presenter.logic.parameters
    assert presenter.segmenting.canUndoSegment() == (False, "Nothing was segmented since the scene was opened")
    presenter.segmenting.segment()
    first, labels, notes = content_of(parameters.labels), parameters.labels, presenter.notes.text()
    shares = read_shares(labels, *_labels_of(labels, logic))
    presenter.values.setValue("scene.thin_sulci", not presenter.values.value("scene.thin_sulci"))
    presenter.segmenting.segment()
    assert parameters.labels is labels and content_of(labels) != first
    assert presenter.segmenting.canUndoSegment() == (True, "")
    presenter.segmenting.undoSegment()
    assert parameters.labels is labels and content_of(labels) == first and presenter.notes.text() == notes
    assert patient_of(labels) == "Head" and logic.mayReplace(labels)
    again = read_shares(labels, *_labels_of(labels, logic))
    np.testing.assert_array_equal(again.second_label, shares.second_label)
    assert not presenter.segmenting.canUndoSegment()[0] and not presenter.view.errors


def _labels_of(labels_node, logic):
    found = read_labels(labels_node, logic.preset.tissues)
    return found.labels, found.names


def test_undo_of_the_first_segment_leaves_the_users_tissues_alone(presenter):
    parameters, scene = presenter.logic.parameters, presenter.logic.scene
    own = scene.AddNewNodeByClass("vtkMRMLSegmentationNode", "tumour of the user")
    head = read_volume(parameters.mri)
    write_labels(own, head.with_array((head.array > head.array.mean()).astype(np.uint8)), ["tumour"], parameters.mri)
    parameters.labels, content = own, content_of(own)
    presenter.segmenting.segment()
    made = parameters.labels
    assert made is not own and content_of(own) == content
    presenter.segmenting.undoSegment()
    assert parameters.labels is own and made.GetScene() is None and content_of(own) == content
    presenter.segmenting.undoSegment()
    assert "Nothing was segmented" in presenter.view.errors[-1]


def test_undo_takes_back_the_last_segment_whatever_labels_are_chosen(presenter):
    """It removed the chosen tissues, and left those that were made last."""
    parameters = presenter.logic.parameters
    presenter.segmenting.segment()
    first, content = parameters.labels, content_of(parameters.labels)
    parameters.labels = None
    presenter.segmenting.segment()
    second = parameters.labels
    parameters.labels = first
    assert first is not second and presenter.segmenting.canUndoSegment() == (True, "")
    presenter.segmenting.undoSegment()
    assert parameters.labels is first and first.GetScene() is not None and content_of(first) == content
    assert second.GetScene() is None and not presenter.view.errors
    assert not presenter.segmenting.canUndoSegment()[0]


def test_undo_of_tissues_that_are_gone_or_opened_is_refused(presenter):
    parameters, scene = presenter.logic.parameters, presenter.logic.scene
    presenter.segmenting.segment()
    made = parameters.labels
    opened = scene.AddNewNodeByClass("vtkMRMLSegmentationNode", "opened")
    set_closed_labels(opened, made)
    parameters.labels = opened
    assert "was opened in 'Head tissues' after Segment" in presenter.segmenting.canUndoSegment()[1]
    presenter.segmenting.undoSegment()
    assert opened.GetScene() is made.GetScene() is scene and "close it first" in presenter.view.errors.pop()
    scene.RemoveNode(opened)
    scene.RemoveNode(made)
    assert "were removed from the scene" in presenter.segmenting.canUndoSegment()[1]


@pytest.mark.parametrize("kind", ["Segmentation", "LabelMapVolume"])
def test_undo_empties_a_node_that_was_empty(presenter, kind):
    parameters, scene = presenter.logic.parameters, presenter.logic.scene
    parameters.labels = own = scene.AddNewNodeByClass(f"vtkMRML{kind}Node", "mine")
    presenter.segmenting.segment()
    assert parameters.labels is own and content_of(own)
    presenter.segmenting.undoSegment()
    assert parameters.labels is own and not content_of(own) and presenter.logic.mayReplace(own)
    presenter.segmenting.segment()
    assert parameters.labels is own and content_of(own) and not presenter.view.errors


def test_lesions_that_were_laid_over_the_tissues_after_segment_end_undo(presenter):
    """Undo took them away with the tissues, without a word."""
    parameters, scene = presenter.logic.parameters, presenter.logic.scene
    presenter.segmenting.segment()
    labels, names = _labels_of(parameters.labels, presenter.logic)
    mask = np.zeros(labels.array.shape, np.uint8)
    centre = np.argwhere(labels.array == names.index("white matter") + 1).mean(axis=0).astype(int)
    mask[tuple(slice(at - 2, at + 3) for at in centre)] = 1
    parameters.lesions = scene.AddNewNodeByClass("vtkMRMLSegmentationNode", "Lesions")
    add_lesion(parameters.lesions, labels.with_array(mask), "tumour", "tumour.nii.gz")
    presenter.lesions.addTissues()
    content = content_of(parameters.labels)
    can, why_not = presenter.segmenting.canUndoSegment()
    assert not can and "was changed after Segment, as by lesions laid over it, and is kept" in why_not
    presenter.segmenting.undoSegment()
    assert presenter.view.errors.pop() == why_not and content_of(parameters.labels) == content
    presenter.segmenting.segment()  # with the lesions
    assert presenter.segmenting.canUndoSegment() == (True, "")
    presenter.segmenting.undoSegment()
    assert content_of(parameters.labels) == content


@pytest.mark.parametrize(
    ("message", "shown"),
    [
        ("give a brain mask (--mask)", "give a brain mask"),
        ("or label the whole head (--outside)", "or tick Label tissues outside the brain and press Segment"),
        ("choose another, --skull-strip none or --mask", "choose another, Brain extraction none or Brain mask"),
        ("map them with --map 9=TISSUE", "map them with the name of a tissue for 9 in its colour table"),
        ("add it with --add brats=FILE, or alone with --map 1=csf --map 2='grey matter' (ussim simulate)",
         "add it with Add to tissues, or alone with names of its tissues"),
    ],
)  # fmt: skip
def test_messages_name_controls_and_no_options_of_the_command(message, shown):
    assert in_panel(message) == shown
