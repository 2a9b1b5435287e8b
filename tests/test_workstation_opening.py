"""Opening anything on the page: recognised by its content, said in one line, and asked where it matters."""

from __future__ import annotations

import base64
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("trame_slicer", reason="the workstation comes with: pip install '.[serve]'")
pytest.importorskip("playwright", reason="browser tests need playwright: pip install '.[test]'")

from SlicerUSSim.Logic import Volume
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Workstation.state import NAMES
from tests.test_label_maps import head
from tests.test_uploads import write_series
from tests.test_workstation import (
    browser as browser,
    dismiss_messages,
    errors,
    eventually,
    first_page as first_page,
    new_image,
    pytestmark as pytestmark,
    serving,
    settled,
    shown,
    state,
)
from validation.ct_phantoms import lumbar_spine


@pytest.fixture(scope="module")
def url(files):
    with serving(str(files / "head.nii.gz")) as address:
        yield address


@pytest.fixture
def page(first_page, files):
    """The page with the head and no messages."""
    page, problems = first_page
    dismiss_messages(page)
    title = state(page, NAMES.title)
    if title != "head.nii.gz":
        answered(page, files / "head.nii.gz", *(["New patient"] if title else []))
    settled(page)
    yield page
    assert not problems


def question(page) -> str:
    """The text of the question that the page asks."""
    page.wait_for_function("document.getElementById('question')?.dataset.number > 0")
    return page.locator("#question-text").inner_text()


def answer(page, title: str) -> None:
    """Answer the question with the choice that is called so."""
    number = page.locator("#question").get_attribute("data-number")
    page.locator("#question .ussim-choice").filter(has_text=re.compile(f"^\\s*{re.escape(title)}")).first.click()
    page.wait_for_function("number => document.getElementById('question')?.dataset.number !== number", arg=number)


def answered(page, sent, *titles: str) -> str:
    """Open files, answer the questions, and return the notes about them."""
    page.set_input_files("#open-file", sent)
    for title in titles:
        question(page)
        answer(page, title)
    settled(page)
    eventually(page, lambda: state(page, NAMES.opened) or errors(page))
    return "\n".join(state(page, NAMES.opened))


# ---- what is recognised and said -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_an_mri_is_a_new_patient_or_a_second_contrast_as_the_user_says(page, files, tmp_path):
    shutil.copy(files / "head.nii.gz", tmp_path / "other.nii.gz")
    before = shown(page, "labelsSelector")
    page.set_input_files("#open-file", tmp_path / "other.nii.gz")
    text = question(page)
    assert text.startswith("other.nii.gz is an MRI of a brain without skull, 80x94x74 voxels of 2x2x2 mm.")
    page.keyboard.press("Escape")  # nothing is opened
    page.locator("#question").wait_for(state="detached")
    settled(page)
    assert state(page, NAMES.title) == "head.nii.gz" and shown(page, "labelsSelector") == before
    said = answered(page, tmp_path / "other.nii.gz", "Second MRI of head.nii.gz", "t2")
    assert said.endswith(": second MRI of head.nii.gz, t2; Segment uses it")
    assert shown(page, "secondContrastComboBox") == "t2" and shown(page, "labelsSelector") == before
    assert page.locator("#secondMriSelector option:checked").inner_text().strip() == "other.nii.gz"
    said = answered(page, tmp_path / "other.nii.gz", "New patient")
    assert said.endswith(": a new patient, segmented as t1; head.nii.gz is closed")
    assert page.locator("#opened").inner_text() == said and not errors(page)
    assert state(page, NAMES.title) == "other.nii.gz" and shown(page, "secondMriSelector") is None


def ball(mri: Volume, radius_mm: float = 12.0) -> Volume:
    """A mask of a ball in the right hemisphere, on the grid of an MRI."""
    index = np.indices(mri.array.shape)[::-1].reshape(3, -1)
    points = (mri.ijk_to_ras[:3, :3] @ index + mri.ijk_to_ras[:3, 3:]).reshape(3, *mri.array.shape)
    inside = radius_mm**2 > ((points.T - [30, 10, 40]) ** 2).sum(axis=-1).T
    return mri.with_array(inside.astype(np.uint8))


@pytest.mark.slow
def test_a_mask_is_a_tumour_or_a_brain_mask_as_the_user_says(page, files, tmp_path):
    mri = Volume.read(files / "head.nii.gz")
    ball(mri).write(tmp_path / "mask.nii.gz")
    page.set_input_files("#open-file", tmp_path / "mask.nii.gz")
    assert re.match(r"mask\.nii\.gz is a mask of one region, 7\.\d+ ml, 80x94x74 voxels", question(page))
    assert shown(page, "lesionsSelector") is None and shown(page, "maskSelector") is None
    with new_image(page):
        answer(page, "Add as tumour")
    kept = shown(page, "lesionsSelector")
    assert state(page, NAMES.opened)[0].endswith(": tumour of head.nii.gz, over the tissues") and not errors(page)
    assert "tumour" in {row["name"] for row in state(page, NAMES.panel.tissues)}
    assert shown(page, "lesionsSelector") is not None and shown(page, "maskSelector") is None
    far = ball(mri)
    Volume(far.array, far.ijk_to_ras + np.array([[0, 0, 0, 400.0], *[[0] * 4] * 3])).write(tmp_path / "far.nii.gz")
    answered(page, tmp_path / "far.nii.gz", "Add as cyst")
    assert "outside the patient" in errors(page)[0] and "/tmp" not in errors(page)[0]
    assert "cyst" not in {row["name"] for row in state(page, NAMES.panel.tissues)}
    assert shown(page, "lesionsSelector") == kept
    dismiss_messages(page)
    mri.with_array((mri.array > 0).astype(np.uint8)).write(tmp_path / "brain.nii.gz")
    with new_image(page):
        said = answered(page, tmp_path / "brain.nii.gz", "Use as brain mask")
    assert said.endswith(": brain mask of head.nii.gz, whose tissues are made anew") and not errors(page)
    assert page.locator("#maskSelector option:checked").inner_text().strip() == "brain.nii.gz"
    assert shown(page, "lesionsSelector") is not None  # which stays


@pytest.mark.long
def test_a_label_map_is_of_this_patient_or_of_a_new_one(page, files, tmp_path):
    labels = Volume.read(files / "labels.nii.gz")
    Volume(labels.array, labels.ijk_to_ras).write(tmp_path / "own.nii.gz")  # without the names in its header
    ball(Volume.read(files / "head.nii.gz")).write(tmp_path / "mask.nii.gz")
    answered(page, tmp_path / "mask.nii.gz", "Add as cyst")
    lesions = shown(page, "lesionsSelector")
    page.set_input_files("#open-file", tmp_path / "own.nii.gz")
    assert "a label map with the labels 1, 2, 3, 4 of ussim segment and FSL FAST or BraTS since 2023" in question(page)
    answer(page, "Tissues of head.nii.gz")
    question(page)
    with new_image(page):
        answer(page, "ussim segment and FSL FAST")
    assert page.locator("#labelsSelector option:checked").inner_text().strip() == "own.nii.gz" and not errors(page)
    assert shown(page, "lesionsSelector") == lesions is not None  # what is the patient's stays
    assert page.locator("#mriSelector option:checked").inner_text().strip() == "head.nii.gz"
    head().write(tmp_path / "aseg.nii.gz")
    said = answered(page, tmp_path / "aseg.nii.gz", "New patient")
    assert "a label map: FreeSurfer, 8 labels" in said and said.endswith("a new patient; own.nii.gz is closed")
    assert state(page, NAMES.title) == "aseg.nii.gz" and shown(page, "mriSelector") is None
    assert shown(page, "lesionsSelector") is None


@pytest.mark.long
def test_a_ct_is_recognised_and_segmented_as_one(page, tmp_path):
    lumbar_spine((3.0, 3.0, 3.0)).ct.write(tmp_path / "spine.nrrd")
    with new_image(page):
        said = answered(page, tmp_path / "spine.nrrd", "New patient")
    assert "spine.nrrd: a CT (" in said and "segmented as ct (before: t1)" in said and not errors(page)
    assert shown(page, "contrastComboBox") == "ct"
    assert "bone" in {row["name"] for row in state(page, NAMES.panel.tissues)}


@pytest.mark.long
def test_several_files_at_once_are_opened_in_their_order(page, files, tmp_path):
    preset = Preset()
    preset.write(tmp_path / "a.json")
    shutil.copy(files / "labels.nii.gz", tmp_path / "labels.nii.gz")
    shutil.copy(files / "head.nii.gz", tmp_path / "z.nii.gz")
    (tmp_path / "broken.nii.gz").write_bytes(b"this is not an image")
    sent = [tmp_path / "labels.nii.gz", files / "sweep.igs.mha", tmp_path / "z.nii.gz", tmp_path / "a.json",
            tmp_path / "broken.nii.gz"]  # fmt: skip
    said = answered(page, sent, "New patient").splitlines()
    assert [line.partition(":")[0] for line in said] == ["a.json", "z.nii.gz", "labels.nii.gz", "sweep.igs.mha"]
    assert "with its own labels; head.nii.gz is closed" in said[1] and said[2].endswith("tissues of z.nii.gz")
    assert state(page, NAMES.title) == "labels.nii.gz" and state(page, NAMES.sequence.length) == 6
    assert page.locator("#mriSelector option:checked").inner_text().strip() == "z.nii.gz"
    assert len(errors(page)) == 1 and errors(page)[0].startswith("broken.nii.gz: ") and "/tmp" not in errors(page)[0]


# ---- DICOM, and what is dropped --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def dicom(files, tmp_path_factory) -> Path:
    """A folder as on a CD: two volumes and a localiser in separate folders, with a viewer."""
    folder = tmp_path_factory.mktemp("cd")
    mri = Volume.read(files / "head.nii.gz")
    scaled = mri.with_array((mri.array * (1000.0 / mri.array.max())).astype(np.int16))
    write_series(folder / "IMAGES" / "A", scaled, 3, "T1 MPRAGE")
    write_series(folder / "IMAGES" / "B", scaled.with_array(1000 - scaled.array), 4, "T2 tse")
    write_series(folder / "IMAGES" / "C", Volume(scaled.array[:4], scaled.ijk_to_ras), 1, "localizer")
    for path in (folder / "IMAGES" / "B").iterdir():  # names that are in another folder as well
        path.rename(path.with_name(path.name.replace("IM4", "IM3")))
    (folder / "viewer.exe").write_bytes(b"MZ")
    return folder


@pytest.mark.long
def test_the_series_of_a_dicom_folder_is_asked_by_its_description(page, dicom):
    page.set_input_files("#open-folder", dicom)
    text = question(page)
    assert text == "The DICOM files have 2 series that are volumes."
    titles = page.locator("#question .ussim-choice").all_inner_texts()
    assert [title.split("\n")[0] for title in titles] == [
        "T1 MPRAGE (series 3): 74 images of 80x94", "T2 tse (series 4): 74 images of 80x94", "Cancel",
    ]  # fmt: skip
    answer(page, "T1 MPRAGE")
    assert question(page).startswith("T1 MPRAGE (series 3) is an MRI of a brain without skull, 80x94x74 voxels")
    with new_image(page):
        answer(page, "New patient")
    settled(page)
    assert state(page, NAMES.title) == "T1 MPRAGE (series 3)" and not errors(page)
    body = page.locator("body").inner_text()
    assert "Miller" not in body and "4711" not in body and "/tmp" not in body


DROP = """async ([files, from]) => {
  const data = new DataTransfer();
  for (const [name, text] of files)
    data.items.add(new File([Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0))], name));
  const drop = (kind) => document.querySelector(from).dispatchEvent(
    new DragEvent(kind, { bubbles: true, cancelable: true, dataTransfer: data }));
  drop("dragover");
  const shown = document.body.classList.contains("ussim-dropping");
  drop("drop");
  return [shown, document.body.classList.contains("ussim-dropping")];
}"""


@pytest.mark.long
def test_files_are_dropped_anywhere_on_the_page(page, files, dicom):
    paths = sorted((dicom / "IMAGES" / "A").iterdir())
    sent = [(path.name, base64.b64encode(path.read_bytes()).decode()) for path in paths]
    assert page.evaluate(DROP, [sent, "#screens"]) == [True, False]
    assert question(page).startswith("T1 MPRAGE (series 3) is an MRI of a brain")  # the only series is not asked
    answer(page, "Second MRI of head.nii.gz")
    answer(page, "t2")
    settled(page)
    assert page.locator("#secondMriSelector option:checked").inner_text().strip() == "T1 MPRAGE (series 3)"
    assert not errors(page)
