"""The page as it is used: keys, choices, names for screen readers, contrast, and room at four sizes of the window."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

pytest.importorskip("trame_slicer", reason="the workstation comes with: pip install '.[serve]'")
pytest.importorskip("playwright", reason="browser tests need playwright: pip install '.[test]'")
axe_of = pytest.importorskip("axe_playwright_python.sync_playwright", reason="it comes with: pip install '.[test]'")

from SlicerUSSim.Workstation.state import NAMES  # noqa: E402
from tests.test_workstation import (  # noqa: E402
    browser as browser,
    dismiss_messages,
    errors,
    eventually,
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

SIZES = ((2560, 1440), (1500, 900), (1280, 720), (1024, 768))


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


def test_arrow_keys_on_a_slider_change_the_slider_and_not_the_probe(page):
    before, gain = pose(page), shown(page, "gainSlider")
    page.locator("#gainSlider, [aria-label='Gain']").first.focus()
    page.keyboard.press("ArrowRight")
    settled(page)
    assert shown(page, "gainSlider") > gain and pose(page) == before
    page.keyboard.press("ArrowLeft")
    settled(page)
    assert shown(page, "gainSlider") == pytest.approx(gain) and pose(page) == before
    page.keyboard.press("a")  # which no slider knows
    settled(page)
    assert pose(page)["rock_deg"] - before["rock_deg"] == pytest.approx(2, abs=0.6)


def test_a_letter_in_a_choice_moves_the_probe_and_does_not_choose(page):
    open_section(page, "Probe")
    before, probe = pose(page), shown(page, "probePresetComboBox")
    page.locator("#probePresetComboBox").focus()
    page.keyboard.press("a")
    settled(page)
    assert shown(page, "probePresetComboBox") == probe == page.locator("#probePresetComboBox").input_value()
    assert pose(page)["rock_deg"] - before["rock_deg"] == pytest.approx(2, abs=0.6)


def test_keys_move_the_probe_after_a_tick_box_too(page):
    page.locator("#upright").click()
    page.locator("#upright").click()
    settled(page)
    before = pose(page)
    page.keyboard.press("ArrowUp")
    settled(page)
    assert pose(page)["front_deg"] != before["front_deg"]


# ---- choices ---------------------------------------------------------------------------------------------------------


def test_custom_is_the_last_probe_that_was_no_preset(page):
    open_section(page, "Probe")
    box = page.locator("#probePresetComboBox")
    assert shown(page, "probePresetComboBox") == "custom"  # of the sequence
    depth = shown(page, "depthSlider")
    box.select_option("linear")
    eventually(page, lambda: shown(page, "probePresetComboBox") == "linear")
    settled(page)
    assert shown(page, "depthSlider") != depth
    box.select_option("custom")
    eventually(page, lambda: shown(page, "probePresetComboBox") == "custom")
    settled(page)
    assert shown(page, "depthSlider") == depth and shown(page, "kindComboBox") == "phased" and not errors(page)


@pytest.mark.parametrize("count", ["99", "1", "-3"])
def test_numbers_out_of_range_are_refused_in_words(page, count):
    open_section(page, "Inputs")
    before = shown(page, "classesSpinBox")
    page.locator("#classesSpinBox").fill(count)
    page.locator("#classesSpinBox").blur()
    text = shown_errors(page)
    assert f"lasses is {count}, expected " in text and "SegmentationSettings" not in text
    settled(page)
    assert shown(page, "classesSpinBox") == before


# ---- names and contrast ----------------------------------------------------------------------------------------------


def test_sliders_and_buttons_have_names(page):
    nameless = page.evaluate(
        """() => [...document.querySelectorAll('button, [role=slider], select, input:not([type=hidden])')]
        .filter((e) => e.offsetParent && !(e.getAttribute('aria-label') || e.textContent.trim() || e.title
          || (e.id && document.querySelector(`label[for="${e.id}"]`))
          || e.closest('label')
          || document.getElementById(e.getAttribute('aria-labelledby') ?? '')))
        .map((e) => e.outerHTML.slice(0, 160))"""
    )
    assert not nameless, nameless
    sliders = page.locator("[role=slider]")
    assert sliders.count() > 8


@pytest.mark.slow
def test_axe_finds_nothing_wrong(page):
    for title in ("Probe", "Tissues", "Rays", "Tracked ultrasound", "Fit to real ultrasound"):
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
    for title in ("Tissues", "Rays", "Tracked ultrasound", "Fit to real ultrasound"):
        page.get_by_role("button", name=title, exact=True).click()
    assert not wrong, "\n".join(map(str, wrong[:30]))


@pytest.mark.slow
def test_a_question_is_asked_of_everyone(page, files):
    """Of screen readers and keyboards, too, within four sizes of the window."""
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
        folder = os.environ.get("USSIM_SCREENSHOTS")
        if folder:
            page.screenshot(path=str(Path(folder) / f"question-{width}x{height}.png"))
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


# ---- room ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "size",
    [SIZES[0], *(pytest.param(size, marks=pytest.mark.slow) for size in SIZES[1:-1]), SIZES[-1]],
    ids=lambda size: f"{size[0]}x{size[1]}",
)
def test_nothing_is_cut_off(page, size):
    width, height = size
    page.set_viewport_size({"width": width, "height": height})
    page.wait_for_timeout(700)
    settled(page)
    folder = os.environ.get("USSIM_SCREENSHOTS")
    if folder:
        page.screenshot(path=str(Path(folder) / f"page-{width}x{height}.png"))
    boxes = {}
    for mark in ("depth-ruler", "grey-bar", "orientation-mark", "image-caption"):
        boxes[mark] = page.locator(f"#{mark}").bounding_box()
    for number in range(page.locator("#depth-ruler text").count()):
        boxes[f"digits {number}"] = page.locator("#depth-ruler text").nth(number).bounding_box()
    assert min(box["height"] for name, box in boxes.items() if name.startswith("digits")) >= 9
    screen = page.locator(".ussim-screen").first.bounding_box()
    for name, box in boxes.items():
        assert box["x"] >= screen["x"] - 1 and box["x"] + box["width"] <= screen["x"] + screen["width"] + 1, name
        assert box["y"] >= screen["y"] - 1 and box["y"] + box["height"] <= screen["y"] + screen["height"] + 1, name
    image = page.locator(".ussim-image").bounding_box()
    for name in (
        "live",
        "export",
        "compare-simulated",
        "compare-beside",
        "compare-blink",
        "compare-difference",
        "play",
    ):
        box = page.locator(f"#{name}").bounding_box()
        assert box["x"] >= image["x"] and box["x"] + box["width"] <= image["x"] + image["width"] + 1, name
        assert box["y"] >= 0 and box["y"] + box["height"] <= height, name
        middle = [box["x"] + box["width"] / 2, box["y"] + box["height"] / 2]
        inside = page.evaluate(
            "([x, y, name]) => Boolean(document.elementFromPoint(x, y)?.closest('#' + name))", [*middle, name]
        )
        assert inside, f"{name} is covered"
    wide = page.evaluate(
        """() => [...document.querySelectorAll('.ussim-bar, .ussim-tool, .v-navigation-drawer__content')]
        .filter((e) => e.scrollWidth > e.clientWidth + 1).map((e) => e.className)"""
    )
    assert not wide
    for name in ("Gain", "Depth"):
        box = page.locator(f"[role=slider][aria-label='{name}']").bounding_box()
        assert box["y"] + box["height"] < height, f"{name} is below the fold"


def test_a_focus_below_the_image_is_not_drawn_over_other_things(page):
    focus, depth = shown(page, "focusSlider"), shown(page, "depthSlider")
    page.evaluate("window.trame.trigger('set', ['focusSlider', 65])")
    settled(page)
    assert page.locator("#focus-mark").count() == 1
    page.evaluate("window.trame.trigger('set', ['depthSlider', 40])")
    settled(page)
    assert page.evaluate("window.ussim.image.ruler.h") == pytest.approx(40, abs=3)
    assert page.locator("#focus-mark").count() == 0
    page.evaluate("depth => window.trame.trigger('set', ['depthSlider', depth])", depth)
    page.evaluate("focus => window.trame.trigger('set', ['focusSlider', focus])", focus)
    settled(page)
    assert state(page, NAMES.messages.errors) == [] and page.locator("#focus-mark").count() == 1
