"""The page as a scanner: room of the image, one record for badge and values, freeze, cine, measurements, export."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("trame_slicer", reason="the workstation comes with: pip install '.[serve]'")
pytest.importorskip("playwright", reason="browser tests need playwright: pip install '.[test]'")
pydicom = pytest.importorskip("pydicom", reason="it comes with: pip install '.[test]'")

from SlicerUSSim.Logic import TissueTable, Volume  # noqa: E402
from SlicerUSSim.Workstation.state import NAMES  # noqa: E402
from tests.test_workstation import (  # noqa: E402
    browser as browser,
    click,
    close_drawer,
    errors,
    eventually,
    new_image,
    open_section,
    opened,
    pixels,
    pytestmark as pytestmark,
    serving,
    settled,
    state,
    status,
)

#: Windows of small and large screens, and of a screen at 200 %; the least share of each that the image has
SIZES = {(1024, 768): 0.45, (1280, 720): 0.45, (1920, 1080): 0.6, (2560, 1440): 0.6, (960, 540): 0.45}
#: Depth of the fluid in the slab under the surface, mm
FLUID_MM = (10.0, 30.0)


@pytest.fixture(scope="module")
def slab(tmp_path_factory):
    """Labels of grey matter with 20 mm of fluid in it, parallel to its flat surface."""
    axes = [np.arange(-40.0, 40.1, 0.5)] * 3
    depth = 40.0 - axes[2]
    layer = np.where((depth > FLUID_MM[0]) & (depth < FLUID_MM[1]), 2, 1).astype(np.uint8)
    array = np.broadcast_to(layer[:, None, None], (len(depth), 161, 161)).copy()
    matrix = np.diag([0.5, 0.5, 0.5, 1.0])
    matrix[:3, 3] = -40.0
    folder = tmp_path_factory.mktemp("slab")
    Volume(array, matrix).write(folder / "slab.nii.gz")
    TissueTable.brain(("grey matter", "csf")).write(folder / "slab.json")
    return folder / "slab.nii.gz"


@pytest.fixture(scope="module")
def first_page(browser, slab):
    problems: list[str] = []
    with serving("--labels", str(slab)) as address:
        page = opened(browser, address, problems)
        settled(page)
        page.evaluate("window.trame.trigger('set', ['probePresetComboBox', 'linear'])")
        matrix = [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 40], [0, 0, 0, 1]]  # on the surface, looking down
        page.evaluate(
            "text => window.trame.trigger('type_pose', [text])", "\n".join(" ".join(map(str, row)) for row in matrix)
        )
        settled(page)
        yield page, problems


@pytest.fixture
def page(first_page):
    page, problems = first_page
    close_drawer(page)
    page.set_viewport_size({"width": 1500, "height": 900})
    if state(page, NAMES.image.status) == "FROZEN":
        page.keyboard.press("f")
        status(page, "LIVE")
    settled(page)
    yield page
    assert not problems


def at(page, x_mm: float, y_mm: float) -> tuple[float, float]:
    """The place of a point of the image on the window."""
    box = page.locator("[data-screen=simulated]").bounding_box()
    x, y = page.evaluate("([x, y]) => window.ussimScreens.place('simulated').toPx(x, y)", [x_mm, y_mm])
    return box["x"] + x, box["y"] + y


def words(page) -> list[str]:
    return page.evaluate("window.ussimMeasure.marks.map((mark) => window.ussimMeasure.words(mark))")


def saved(page, kind: str) -> bytes:
    click(page, "#save summary")
    with page.expect_download() as waiting:
        click(page, f"#save-{kind}")
    return waiting.value.path().read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
def test_the_image_has_most_of_the_window_and_nothing_is_cut(page, size):
    page.set_viewport_size({"width": size[0], "height": size[1]})
    settled(page)
    canvas = page.locator("canvas[data-stream=simulated]").bounding_box()
    assert canvas["width"] * canvas["height"] / (size[0] * size[1]) >= SIZES[size]
    screen = page.locator("[data-screen=simulated]")
    inside = screen.bounding_box()
    for mark in (".depth-ruler", ".grey-bar", ".orientation-mark", "#image-values"):
        box = screen.locator(mark).bounding_box()
        assert box["x"] >= inside["x"] and box["x"] + box["width"] <= inside["x"] + inside["width"], mark
        assert box["y"] >= inside["y"] and box["y"] + box["height"] <= inside["y"] + inside["height"] + 1, mark
    for name in ("menu", "live", "gainSlider", "save", "help-button", "probe-phased", "image-status"):
        box = page.locator(f"#{name}").bounding_box()
        middle = [box["x"] + box["width"] / 2, box["y"] + box["height"] / 2, name]
        on_top = "([x, y, name]) => Boolean(document.elementFromPoint(x, y)?.closest('#' + name))"
        assert page.evaluate(on_top, middle), f"{name} is covered or cut"
    assert page.evaluate("[document.documentElement.scrollWidth, document.documentElement.scrollHeight]") == list(size)


@pytest.mark.slow
def test_a_caliper_across_the_fluid_reads_its_thickness(page):
    """The edges are where the mean of the lines crosses half of the level beside them."""
    page.keyboard.press("f")
    status(page, "FROZEN")
    image = pixels(page).astype(float)
    ruler = page.evaluate("window.ussim.image.ruler")
    profile = image[:, image.shape[1] // 4 : -image.shape[1] // 4].mean(axis=1)
    depth = ruler["y"] + (np.arange(len(profile)) + 0.5) * ruler["h"] / len(profile)
    level = profile[(depth > 5) & (depth < 9)].mean()
    dark = depth[(profile < 0.5 * level) & (depth > 5) & (depth < 35)]
    assert dark.min() == pytest.approx(FLUID_MM[0], abs=0.3) and dark.max() == pytest.approx(FLUID_MM[1], abs=0.3)
    page.mouse.move(*at(page, 0.0, 20.0))
    page.keyboard.down("Control")
    page.mouse.wheel(0, -100)  # zoomed in, it reads the same
    page.keyboard.up("Control")
    eventually(page, lambda: page.evaluate("window.ussimScreens.view.zoom") > 1.1)
    page.keyboard.press("m")
    page.mouse.click(*at(page, 0.0, float(dark.min())))
    page.mouse.click(*at(page, 0.0, float(dark.max())))
    eventually(page, lambda: len(words(page)) == 1)
    assert float(words(page)[0].split()[0]) == pytest.approx(FLUID_MM[1] - FLUID_MM[0], abs=0.3)
    page.keyboard.press("0")
    page.keyboard.press("f")
    status(page, "LIVE")
    with new_image(page):
        page.keyboard.press("a")
    assert words(page) == []  # they were of the image before


@pytest.mark.slow
def test_frozen_echoes_take_gain_and_the_cine_goes_back(page):
    for _ in range(3):
        with new_image(page):
            page.keyboard.press("a")
    last = pixels(page)
    page.keyboard.press(" ")
    status(page, "FROZEN")
    pose = page.evaluate("window.ussim.image.pose")
    page.keyboard.press("w")  # the probe moves on, the image stays
    settled(page)
    assert page.evaluate("window.ussim.image.pose") == pose and np.array_equal(pixels(page), last)
    with new_image(page):
        page.locator("#gainSlider").fill("8")
        page.locator("#gainSlider").blur()
    brighter = pixels(page)
    assert brighter.mean() > last.mean() + 5 and page.evaluate("window.ussim.image.pose") == pose
    assert "+8 dB" in page.locator("#image-values").inner_text()
    with new_image(page):
        page.keyboard.press("ArrowLeft")
    assert page.evaluate("window.ussim.image.pose") != pose and not np.array_equal(pixels(page), brighter)
    page.mouse.move(*at(page, 0.0, 20.0))
    with new_image(page):
        page.mouse.wheel(0, 100)
    with new_image(page):
        page.evaluate("window.trame.trigger('set', ['gainSlider', 0])")
    assert np.array_equal(pixels(page), last)  # an unchanged display shows the very same pixels
    status(page, "FROZEN")
    page.keyboard.press("f")
    status(page, "LIVE")
    assert page.evaluate("window.ussim.image.pose") != pose and not errors(page)


@pytest.mark.slow
def test_pictures_and_dicom_have_scale_and_measurements(page):
    for _ in range(2):
        with new_image(page):
            page.keyboard.press("d")
    page.keyboard.press("f")
    status(page, "FROZEN")
    plain = np.asarray(Image.open(io.BytesIO(saved(page, "picture"))).convert("RGB")).astype(int)
    click(page, "#measure summary")
    click(page, "#tool-ellipse")
    for point in ((-8.0, 20.0), (8.0, 20.0), (0.0, 25.0)):
        page.mouse.click(*at(page, *point))
    eventually(page, lambda: words(page) == ["16.0 × 10.0 mm, 126 mm²"])
    marked = np.asarray(Image.open(io.BytesIO(saved(page, "picture"))).convert("RGB")).astype(int)
    green = marked[..., 1] - marked[..., [0, 2]].max(axis=-1)
    assert marked.shape == plain.shape and (green > 40).sum() > 100 + (plain[..., 1] - plain[..., 0] > 40).sum()
    frame = pydicom.dcmread(io.BytesIO(saved(page, "dicom")))
    (region,) = frame.SequenceOfUltrasoundRegions
    ruler = page.evaluate("window.ussim.image.ruler")
    width = (region.RegionLocationMaxX1 - region.RegionLocationMinX0 + 1) * region.PhysicalDeltaX * 10.0
    assert width == pytest.approx(ruler["w"], abs=0.3) and frame.BurnedInAnnotation == "YES"
    cine = pydicom.dcmread(io.BytesIO(saved(page, "dicom-cine")))
    assert cine.NumberOfFrames == state(page, NAMES.cine.length) > 1 and cine.PatientName == "slab.nii.gz"
    assert saved(page, "video")[:4] == b"\x1aE\xdf\xa3"  # EBML
    assert not errors(page)


@pytest.mark.slow
def test_the_line_over_the_image_has_a_remedy(browser, tmp_path):
    """A closed skull: the button opens it."""
    from tests.test_workstation import round_head

    round_head(tmp_path)
    with serving("--labels", str(tmp_path / "labels.nii.gz")) as address:
        page = opened(browser, address)
        settled(page)
        eventually(page, lambda: "skull is closed" in page.locator("#advice").inner_text())
        assert page.locator("#remedy").inner_text() == "Open skull"
        click(page, "#remedy")
        eventually(page, lambda: "skull is closed" not in json.dumps(state(page, NAMES.advice.text)))
        settled(page)
        open_section(page, "Probe")
        assert "craniotomy: a disc of" in page.locator("#probeNotesLabel").inner_text() and not errors(page)
        page.close()
