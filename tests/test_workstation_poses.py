"""Poses on the page: typed, opened and saved."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("trame_slicer", reason="the workstation comes with: pip install '.[serve]'")
pytest.importorskip("playwright", reason="browser tests need playwright: pip install '.[test]'")

from SlicerUSSim.Logic.base.transforms import pose_of_angles
from SlicerUSSim.Logic.tracked.pose_files import read_pose
from SlicerUSSim.Workstation.pose_entry import POSE_SUFFIXES
from SlicerUSSim.Workstation.state import NAMES
from tests.test_workstation import (
    browser as browser,
    click,
    dismiss_messages,
    errors,
    eventually,
    new_image,
    open_section,
    opened,
    pytestmark as pytestmark,
    serving,
    settled,
    state,
)


@pytest.fixture(scope="module")
def first_page(browser, files):
    problems: list[str] = []
    with serving("--labels", str(files / "labels.nii.gz")) as address:
        page = opened(browser, address, problems)
        open_section(page, "Probe")
        yield page, problems


@pytest.fixture
def page(first_page):
    page, problems = first_page
    dismiss_messages(page)
    page.evaluate("window.trame.trigger('press', ['placeButton'])")
    settled(page)
    yield page
    assert not problems


def where(page) -> np.ndarray:
    return np.array(page.evaluate("window.ussim.image.pose"))


def typed(page, field: str, text: str) -> None:
    page.locator(field).fill(text)
    page.locator(field).blur()
    settled(page)


@pytest.mark.slow
def test_a_pose_is_typed_as_position_and_angles_or_as_a_matrix(page):
    shown = [float(number) for number in page.locator("#pose-numbers").input_value().split()]
    np.testing.assert_allclose(pose_of_angles(shown[:3], shown[3:]), where(page), atol=1e-2)
    with new_image(page):
        typed(page, "#pose-numbers", f"{shown[0] + 2} {shown[1]} {shown[2]} {shown[3]} {shown[4]} {shown[5] + 4}")
    expected = pose_of_angles([shown[0] + 2, *shown[1:3]], [*shown[3:5], shown[5] + 4])
    np.testing.assert_allclose(where(page), expected, atol=1e-3)
    matrix = page.locator("#pose-matrix").input_value()
    np.testing.assert_allclose(np.array(matrix.split(), float).reshape(4, 4), expected, atol=1e-4)
    moved = expected.copy()
    moved[2, 3] -= 3.0
    with new_image(page):
        typed(page, "#pose-matrix", "\n".join(" ".join(f"{value:.6f}" for value in row) for row in moved))
    np.testing.assert_allclose(where(page), moved, atol=1e-3)
    assert not errors(page)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("field", "text", "words"),
    [
        ("#pose-numbers", "1 2 3", "the pose is '1 2 3', expected 6 numbers"),
        ("#pose-matrix", "2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1", "the pose is not rigid"),
    ],
)
def test_what_is_no_pose_is_said_and_moves_nothing(page, field, text, words):
    before = where(page)
    typed(page, field, text)
    page.locator(".ussim-error").first.wait_for()
    assert errors(page)[0].startswith(words)
    np.testing.assert_array_equal(where(page), before)


@pytest.mark.slow
def test_keys_typed_in_the_fields_do_not_move_the_probe(page):
    before = where(page)
    page.locator("#pose-matrix").focus()
    page.keyboard.type("wasd")
    settled(page)
    np.testing.assert_array_equal(where(page), before)
    page.evaluate("document.activeElement.blur()")
    settled(page)


@pytest.mark.slow
@pytest.mark.parametrize(
    "suffix", [*POSE_SUFFIXES[:2], *(pytest.param(suffix, marks=pytest.mark.slow) for suffix in POSE_SUFFIXES[2:])]
)
def test_a_pose_is_saved_and_opened_again(page, suffix, tmp_path):
    with new_image(page):
        page.keyboard.press("d")
    saved = where(page)
    page.select_option("#pose-format", suffix)
    with page.expect_download() as waiting:
        click(page, "#save-pose")
    assert waiting.value.suggested_filename == f"pose{suffix}"
    shutil.copy(waiting.value.path(), tmp_path / f"pose{suffix}")
    np.testing.assert_allclose(read_pose(tmp_path / f"pose{suffix}"), saved, atol=1e-3)
    page.evaluate("window.trame.trigger('press', ['placeButton'])")
    settled(page)
    assert not np.allclose(where(page), saved, atol=1e-2)
    page.set_input_files("#open-pose", tmp_path / f"pose{suffix}")
    eventually(page, lambda: np.allclose(where(page), saved, atol=1e-3))
    settled(page)
    assert not errors(page)


@pytest.mark.slow
def test_a_file_that_is_no_pose_is_said_by_its_own_name(page, tmp_path):
    (tmp_path / "no.tfm").write_text("nothing")
    page.set_input_files("#open-pose", tmp_path / "no.tfm")
    page.locator(".ussim-error").first.wait_for()
    assert errors(page)[0].startswith("no.tfm: ") and "/tmp" not in errors(page)[0]


@pytest.mark.slow
def test_a_preset_carries_the_pose_if_it_is_wanted(page, tmp_path):
    open_section(page, "Output")
    with page.expect_download() as waiting:
        click(page, "#savePresetButton")
    assert "probe_to_ras" not in json.loads(Path(waiting.value.path()).read_text())
    page.locator("#presetPoseCheckBox").check()
    settled(page)
    with new_image(page):
        page.keyboard.press("Shift+d")
    saved = where(page)
    with page.expect_download() as waiting:
        click(page, "#savePresetButton")
    shutil.copy(waiting.value.path(), tmp_path / "preset.json")
    np.testing.assert_allclose(json.loads((tmp_path / "preset.json").read_text())["probe_to_ras"], saved, atol=1e-3)
    page.locator("#presetPoseCheckBox").uncheck()
    page.evaluate("window.trame.trigger('press', ['placeButton'])")
    settled(page)
    assert not np.allclose(where(page), saved, atol=1e-2)
    page.set_input_files("#open-file", tmp_path / "preset.json")
    eventually(page, lambda: np.allclose(where(page), saved, atol=1e-3))
    settled(page)
    assert not errors(page)


@pytest.mark.slow
def test_without_a_patient_there_is_no_pose(page, files):
    click(page, "#close-patient")
    page.wait_for_function("window.ussim.image === null")
    settled(page)
    assert state(page, NAMES.pose_numbers) == "" and page.locator("#pose-numbers").is_disabled()
    assert page.locator("#save-pose").is_disabled()
    page.set_input_files("#open-file", files / "labels.nii.gz")
    page.wait_for_function("window.ussim.image?.patient === 'labels.nii.gz'")
    settled(page)
