"""The workstation opens scenes: its own, and those of the Slicer module; and nothing that a scene names elsewhere."""

from __future__ import annotations

import re
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("trame_slicer", reason="the workstation comes with: pip install '.[serve]'")
pytest.importorskip("playwright", reason="browser tests need playwright: pip install '.[test]'")

import slicer
from PIL import Image
from trame_slicer.core import SlicerApp

from SlicerUSSim.Logic import SimulationError
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mri.samples import head_mri
from SlicerUSSim.Logic.mrml.lesion_nodes import add_lesion
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic
from SlicerUSSim.Logic.mrml.nodes import probe_pose, write_volume
from SlicerUSSim.Widget.presenter import PanelPresenter
from SlicerUSSim.Workstation.scene_files import read_scene
from SlicerUSSim.Workstation.state import NAMES
from tests.served import refused
from tests.test_presenter import PlainView
from tests.test_workstation import (
    answer_new_patient,
    browser as browser,
    click,
    dismiss_messages,
    download,
    errors,
    first_page as first_page,
    new_image,
    open_head,
    open_new_patient,
    opened,
    pixels,
    pytestmark as pytestmark,
    serving,
    settled,
    shown,
    state,
    status,
)


def app_of_slicer() -> SlicerApp:
    app = SlicerApp()
    app.register_module_logic(slicer.vtkSlicerSequencesLogic())
    return app


@pytest.fixture(scope="module")
def module_scene(tmp_path_factory) -> tuple[Path, np.ndarray, np.ndarray]:
    """(an .mrb as the Slicer module leaves it, its image, the pose of its probe)"""
    app = app_of_slicer()
    logic = UltrasoundSceneLogic(app.scene)
    presenter = PanelPresenter(logic, PlainView())  # as in Slicer: segmentations, handles
    mri = head_mri(3.0)
    node = app.scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "Ms. Example T1")
    write_volume(node, mri)
    other = app.scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "FLAIR of somebody")
    write_volume(other, head_mri(5.0))
    lesions = app.scene.AddNewNodeByClass("vtkMRMLSegmentationNode", "my lesions")
    mask = np.zeros(mri.array.shape, np.uint8)
    mask[tuple(slice(size // 2 - 3, size // 2 + 3) for size in mask.shape)] = 1
    add_lesion(lesions, mri.with_array(mask), "cyst", "cyst.nii.gz")
    logic.parameters.mri, logic.parameters.lesions = node, lesions
    logic.preset = Preset().changed("display", gain_db=5.0).changed("probe", kind="convex", depth_mm=80.0)
    presenter.segmenting.segment()
    presenter.placing.placeProbe()
    presenter.images.simulate()
    path = tmp_path_factory.mktemp("slicer") / "study.mrb"
    assert app.io_manager.write_scene(path)
    frame = logic.lastFrame
    assert frame is not None and logic.parameters.labels.IsA("vtkMRMLSegmentationNode")
    return path, frame.image, probe_pose(logic.parameters.probe_transform)


@pytest.fixture(scope="module")
def url(files):
    with serving("--labels", str(files / "labels.nii.gz")) as address:
        yield address


@pytest.fixture
def page(first_page, files):
    """The page with a patient, live images and no messages."""
    page, problems = first_page
    dismiss_messages(page)
    if state(page, NAMES.title) == "":
        open_new_patient(page, files / "labels.nii.gz")
    elif not shown(page, "liveCheckBox"):
        click(page, "#live")
    settled(page)
    yield page
    assert not problems


def open_scene(page, path: Path) -> None:
    """Open a scene in place of the patient who is open, which the page asks."""
    before = page.evaluate("window.ussim.images")
    page.set_input_files("#open-file", path)
    answer_new_patient(page, "The patient of the scene")
    settled(page)
    assert page.evaluate("window.ussim.images") > before, errors(page)


@pytest.mark.slow
def test_the_workstation_opens_the_scene_that_it_saved(page, files, tmp_path):
    """With tissues, probe, settings, images of a sequence, and the place of the probe.

    Another depth than that of the images was mistaken for a wrong calibration, and the page was empty; the registration
    was "none".
    """
    open_head(page, files)
    (tmp_path / "moved.txt").write_text("1 0 0 0.5 0 1 0 -0.25 0 0 1 1 0 0 0 1")
    page.evaluate("window.trame.trigger('show_number', [1])")
    page.evaluate("window.trame.trigger('set', ['gainSlider', 5])")
    page.evaluate("window.trame.trigger('set', ['depthSlider', 45])")
    settled(page)
    page.set_input_files("#registration-file", tmp_path / "moved.txt")
    settled(page)
    assert shown(page, "depthSlider") == 45  # a registration does not take back what was changed
    at_1 = state(page, NAMES.pose_matrix), state(page, NAMES.sequence.similarity)
    for _ in range(2):
        with new_image(page):
            page.keyboard.press("d")
    settled(page)
    image, where = pixels(page), page.evaluate("window.ussim.image.pose")
    shutil.copy(download(page, "mrb"), tmp_path / "saved.mrb")
    page.set_input_files("#open-file", files / "labels.nii.gz")
    answer_new_patient(page)
    page.wait_for_function("window.ussim.image?.patient === 'labels.nii.gz'")
    page.evaluate("window.trame.trigger('set', ['gainSlider', -3])")
    settled(page)
    page.set_input_files("#open-file", tmp_path / "saved.mrb")
    page.wait_for_function("document.getElementById('question')?.dataset.number > 0")
    page.keyboard.press("Escape")  # opens nothing
    page.locator("#question").wait_for(state="detached")
    settled(page)
    assert state(page, NAMES.title) == "labels.nii.gz" and state(page, NAMES.opened) == []
    open_scene(page, tmp_path / "saved.mrb")
    assert state(page, NAMES.opened) == [
        "saved.mrb: a scene of 3D Slicer or of this page: shown as it was; labels.nii.gz is closed"
    ]
    assert state(page, NAMES.registration.recording).startswith("sweep: 6 images")
    assert not errors(page) and state(page, NAMES.title) == "head.nii.gz" and shown(page, "gainSlider") == 5
    np.testing.assert_allclose(page.evaluate("window.ussim.image.pose"), where, atol=1e-3)
    assert np.array_equal(pixels(page), image)
    assert state(page, NAMES.sequence.length) == 6 and "saved.mrb: a scene" in shown(page, "notesLabel")
    assert shown(page, "depthSlider") == 45 and state(page, NAMES.image.status) == "LIVE"
    assert state(page, NAMES.registration.registration) == "as it was given or saved"
    page.evaluate("window.trame.trigger('show_number', [1])")
    settled(page)
    now = state(page, NAMES.pose_matrix)
    np.testing.assert_allclose(*(np.array(text.split(), float) for text in (now, at_1[0])), atol=1e-3)
    assert state(page, NAMES.sequence.similarity) == at_1[1]
    page.evaluate("window.trame.trigger('show_number', [4])")
    settled(page)
    assert re.match(r"cost 0\.\d+", state(page, NAMES.sequence.similarity))


@pytest.mark.slow
def test_the_workstation_opens_the_scene_of_the_slicer_module(page, module_scene):
    path, image, _ = module_scene
    open_scene(page, path)
    assert not errors(page) and state(page, NAMES.title) == "Ms. Example T1"
    assert np.array_equal(np.asarray(Image.open(download(page, "png"))), image)  # of Simulate, which is not live
    assert shown(page, "kindComboBox") == "convex" and state(page, NAMES.sequence.length) == 0
    notes = shown(page, "notesLabel")
    assert "left out, since the simulator does not use them: FLAIR of somebody" in notes
    assert "cyst" in [row["name"] for row in state(page, NAMES.panel.tissues)]
    status(page, "FROZEN")
    with new_image(page):
        click(page, "#live")
    settled(page)
    assert (np.asarray(Image.open(download(page, "png"))) != image).mean() < 0.001  # poses are saved as text


@pytest.mark.slow
def test_nothing_of_a_patient_stays_on_the_next_one(page, files, tmp_path):
    """The line "FROZEN: ..." and the outline of the imaged field of the patient before lay over the next one."""
    open_new_patient(page, files / "labels.nii.gz")
    page.evaluate("window.trame.trigger('close_patient')")
    settled(page)
    assert state(page, NAMES.messages.status) == "" and state(page, NAMES.title) == ""
    shutil.copy(download(page, "mrb"), tmp_path / "closed.mrb")
    with zipfile.ZipFile(tmp_path / "closed.mrb") as bundle:
        names = bundle.namelist()
        scene = bundle.read(next(name for name in names if name.endswith(".mrml"))).decode()
    assert not [name for name in names if "outline" in name.lower()]
    poses = re.findall(r'name="Probe"[^>]*matrixTransformToParent="([^"]*)"', scene)
    assert [np.array(pose.split(), float).reshape(4, 4).tolist() for pose in poses] == [np.eye(4).tolist()]
    page.set_input_files("#open-file", files / "head.nii.gz")
    page.wait_for_function("window.ussim.image?.patient === 'head.nii.gz'")
    settled(page)


@pytest.mark.slow
def test_a_scene_comes_from_a_child_process_as_plain_values(module_scene):
    path, _, pose = module_scene
    record = read_scene(path)
    assert set(record.nodes) == {"mri", "labels", "shares", "lesions"}
    np.testing.assert_allclose(record.pose, pose, atol=1e-6)
    assert [segment.name for segment in record.nodes["lesions"].segments] == ["cyst"]
    assert record.left_out == ("FLAIR of somebody",)


def changed(path: Path, to: Path, pattern: str, text: str, **more: bytes) -> Path:
    """A bundle with a text of its scene replaced, and more files."""
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(to, "w") as target:
        for entry in source.infolist():
            content = source.read(entry)
            if entry.filename.endswith(".mrml"):
                content, count = re.subn(pattern.encode(), text.encode(), content, count=1)
                assert count == 1
            target.writestr(entry.filename, content)
        for name, content in more.items():
            target.writestr(name, content)
    return to


@pytest.mark.slow
@pytest.mark.parametrize("name", ["/etc/passwd", "Data/..%252F..%252F..%252Fother.nrrd"])
def test_a_scene_that_names_files_elsewhere_is_refused(module_scene, tmp_path, name):
    """They could be any of the server's user, and were shown to whoever has sent the scene."""
    path = changed(module_scene[0], tmp_path / "bad.mrb", r'fileName="[^"]*\.nrrd"', f'fileName="{name}"')
    with pytest.raises(SimulationError, match="names a file outside itself"):
        read_scene(path)


@pytest.mark.slow
def test_a_bundle_with_files_outside_or_headers_of_others_is_refused(module_scene, tmp_path):
    bad = changed(module_scene[0], tmp_path / "bad.mrb", "<MRML", "<MRML", **{"../outside.txt": b"1"})
    with pytest.raises(SimulationError, match=r"has a file outside its folder, 'outside\.txt'"):
        read_scene(bad)
    assert not (tmp_path.parent / "outside.txt").exists()
    header = b"NRRD0004\ntype: uchar\ndimension: 3\nsizes: 2 2 2\nencoding: raw\ndata file: /etc/passwd\n\n"
    bad = changed(module_scene[0], tmp_path / "header.mrb", "<MRML", "<MRML", **{"x/Data/other.nrrd": header})
    with pytest.raises(SimulationError, match="is a header whose voxels are in another file"):
        read_scene(bad)


@pytest.mark.long
def test_a_scene_that_this_module_was_not_used_in_is_opened_as_its_mri(page, tmp_path):
    app = app_of_slicer()
    write_volume(app.scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "T1 of a study"), head_mri(3.0))
    assert app.io_manager.write_scene(tmp_path / "other.mrb")
    open_scene(page, tmp_path / "other.mrb")
    page.wait_for_function("window.ussim.image?.patient === 'T1 of a study'")
    notes = shown(page, "notesLabel")
    assert not errors(page) and "other.mrb: a scene" in notes and "white matter" in notes


@pytest.mark.long
def test_the_workstation_starts_with_a_scene(browser, module_scene):
    path, image, pose = module_scene
    with serving(str(path)) as address:
        page = opened(browser, address)
        settled(page)
        assert not errors(page) and state(page, NAMES.title) == "Ms. Example T1"
        np.testing.assert_allclose(page.evaluate("window.ussim.image.pose"), pose, atol=2e-3)
        assert np.array_equal(np.asarray(Image.open(download(page, "png"))), image)
        # It belongs to a user, who is asked before it is closed
        page.set_input_files("#open-file", path)
        page.wait_for_function("document.getElementById('question')?.dataset.number > 0")
        page.keyboard.press("Escape")
        page.close()


@pytest.mark.slow
def test_a_scene_is_served_without_options_for_a_patient(module_scene):
    said = refused(module_scene[0], "--outside", "--add", "tumour=x.nii.gz")
    assert "is a scene, which has a patient and settings, expected" in said
