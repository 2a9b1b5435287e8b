"""The page as it is used: keys, poses, names for screen readers, contrast, and room at two sizes of the window."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

pytest.importorskip("trame_slicer", reason="the workstation comes with: pip install '.[serve]'")
pytest.importorskip("playwright", reason="browser tests need playwright: pip install '.[test]'")
axe_of = pytest.importorskip("axe_playwright_python.sync_playwright", reason="it comes with: pip install '.[test]'")

from SlicerUSSim.Logic.base.transforms import pose_of_angles  # noqa: E402
from SlicerUSSim.Logic.tracked.pose_files import read_pose  # noqa: E402
from SlicerUSSim.Workstation.pose_entry import POSE_SUFFIXES  # noqa: E402
from SlicerUSSim.Workstation.state import NAMES  # noqa: E402
from tests.test_workstation import (  # noqa: E402
    browser as browser,
    click,
    dismiss_messages,
    errors,
    eventually,
    new_image,
    open_section,
    opened,
    pose,
    pytestmark as pytestmark,
    serving,
    settled,
    shown,
    shown_errors,
    state,
)

SIZES = ((2560, 1440), (1024, 768))


@pytest.fixture(scope="module")
def first_page(browser, files):
    problems: list[str] = []
    arguments = ["--labels", str(files / "labels.nii.gz"), "--sequence", str(files / "sweep.igs.mha")]
    with serving(*arguments) as address:
        page = opened(browser, address, problems)
        settled(page)
        yield page, problems


@pytest.fixture
def page(first_page):
    page, problems = first_page
    dismiss_messages(page)
    page.set_viewport_size({"width": 1500, "height": 900})
    page.evaluate("document.activeElement?.blur()")
    page.evaluate("window.trame.trigger('press', ['placeButton'])")
    settled(page)
    yield page
    assert not problems


# ---- keys ------------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_keys_change_the_slider_that_has_them_and_else_move_the_probe(page):
    before, gain = pose(page), shown(page, "gainSlider")
    page.locator("#slider-gainSlider").focus()
    page.keyboard.press("ArrowRight")
    settled(page)
    assert shown(page, "gainSlider") > gain and pose(page) == before
    page.keyboard.press("ArrowLeft")
    settled(page)
    assert shown(page, "gainSlider") == pytest.approx(gain) and pose(page) == before
    page.keyboard.press("a")  # which no slider knows
    settled(page)
    assert pose(page)["rock_deg"] - before["rock_deg"] == pytest.approx(2, abs=0.6)
    open_section(page, "Probe")
    view = shown(page, "viewComboBox")
    page.locator("#viewComboBox").focus()
    page.keyboard.press("a")  # does not choose
    settled(page)
    assert shown(page, "viewComboBox") == view == page.locator("#viewComboBox").input_value()
    assert pose(page)["rock_deg"] - before["rock_deg"] == pytest.approx(4, abs=0.9)
    for _ in range(2):
        page.locator("#upright").click()  # a tick box
    settled(page)
    before = pose(page)
    page.keyboard.press("ArrowUp")
    settled(page)
    assert pose(page)["front_deg"] != before["front_deg"]
    page.keyboard.press("Home")
    settled(page)
    assert abs(pose(page)["rock_deg"]) < 0.1 and abs(pose(page)["tilt_deg"]) < 0.1


# ---- poses -----------------------------------------------------------------------------------------------------------


def where(page) -> np.ndarray:
    return np.array(page.evaluate("window.ussim.image.pose"))


def typed(page, field: str, text: str) -> None:
    page.locator(field).fill(text)
    page.locator(field).blur()
    settled(page)


@pytest.mark.long
def test_a_pose_is_typed_as_position_and_angles_or_as_a_matrix(page):
    open_section(page, "Probe")
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
    before = where(page)
    typed(page, "#pose-numbers", "1 2 3")
    page.locator(".ussim-error").first.wait_for()
    assert errors(page)[0].startswith("the pose is '1 2 3', expected 6 numbers")
    np.testing.assert_array_equal(where(page), before)


@pytest.mark.long
def test_a_pose_is_saved_and_opened_again(page, tmp_path):
    open_section(page, "Probe")
    with new_image(page):
        page.keyboard.press("d")
    saved = where(page)
    page.select_option("#pose-format", POSE_SUFFIXES[0])
    with page.expect_download() as waiting:
        click(page, "#save-pose")
    file = tmp_path / waiting.value.suggested_filename
    assert file.name == f"pose{POSE_SUFFIXES[0]}"
    shutil.copy(waiting.value.path(), file)
    np.testing.assert_allclose(read_pose(file), saved, atol=1e-3)
    page.evaluate("window.trame.trigger('press', ['placeButton'])")
    settled(page)
    assert not np.allclose(where(page), saved, atol=1e-2)
    page.set_input_files("#open-file", file)
    eventually(page, lambda: np.allclose(where(page), saved, atol=1e-3))
    settled(page)
    assert not errors(page)


# ---- names and contrast ----------------------------------------------------------------------------------------------


@pytest.mark.long
def test_axe_finds_nothing_wrong(page):
    for title in ("Probe", "Tissues", "Advanced", "Tracked ultrasound", "Fit to real ultrasound"):
        open_section(page, title)
    page.evaluate("window.trame.trigger('set', ['classesSpinBox', 99])")
    shown_errors(page)
    page.wait_for_timeout(1500)  # panels slide open, views get their names
    found = axe_of.Axe().run(page, options={"runOnly": ["wcag2a", "wcag2aa", "cat.name-role-value"]})
    wrong = [
        (entry["id"], node["html"][:150], node.get("failureSummary", "")[:200])
        for entry in found.response["violations"]
        for node in entry["nodes"]
    ]
    assert not wrong, "\n".join(map(str, wrong[:30]))


@pytest.mark.long
def test_a_question_is_asked_of_everyone(page, files):
    """Of screen readers and keyboards, too, within two sizes of the window."""
    sent = files / "head.nii.gz"
    page.set_input_files("#open-file", sent)
    page.wait_for_function("document.getElementById('question')?.dataset.number > 0")
    page.get_by_role("button", name="New patient").wait_for()
    for width, height in SIZES:
        page.set_viewport_size({"width": width, "height": height})
        page.wait_for_timeout(300)
        box = page.locator("#question").bounding_box()
        assert (
            box["x"] >= 0 and box["y"] >= 0 and box["x"] + box["width"] <= width and box["y"] + box["height"] <= height
        )
    found = axe_of.Axe().run(page, options={"runOnly": ["wcag2a", "wcag2aa", "cat.name-role-value"]})
    wrong = [(entry["id"], node["html"][:150]) for entry in found.response["violations"] for node in entry["nodes"]]
    before = pose(page)
    page.keyboard.press("a")  # does not move the probe
    for _ in range(4):
        page.keyboard.press("Tab")
    inside = page.evaluate("Boolean(document.activeElement.closest('#question'))")
    page.locator("#question-cancel").focus()
    page.keyboard.press("Enter")
    page.locator("#question").wait_for(state="detached")
    settled(page)
    assert inside and not wrong and not errors(page) and state(page, NAMES.title) == "labels.nii.gz", wrong
    assert pose(page) == before
