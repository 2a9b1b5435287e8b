"""The page as a scanner: room of the image, one record for badge and values, freeze, cine, measurements, export."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("trame_slicer", reason="the workstation comes with: pip install '.[serve]'")
pytest.importorskip("playwright", reason="browser tests need playwright: pip install '.[test]'")
axe_of = pytest.importorskip("axe_playwright_python.sync_playwright", reason="it comes with: pip install '.[test]'")
pydicom = pytest.importorskip("pydicom", reason="it comes with: pip install '.[test]'")

from SlicerUSSim.Logic import TissueTable, Volume  # noqa: E402
from SlicerUSSim.Logic.base.transforms import pose_of_angles  # noqa: E402
from SlicerUSSim.Logic.tracked.pose_files import read_pose  # noqa: E402
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


def area(page, selector: str) -> float:
    box = page.locator(selector).bounding_box()
    return 0.0 if box is None else box["width"] * box["height"]


def test_views_fold_fill_the_window_and_change_places_with_the_image(page):
    names = ("#view-ThreeD", "#view-Red", "#view-Green")
    before = {name: area(page, name) for name in (*names, ".ussim-stage")}
    assert min(before.values()) > 10_000
    click(page, "#fold")
    assert [area(page, name) for name in names] == [0.0] * 3 and area(page, ".ussim-stage") > before[".ussim-stage"]
    click(page, "#fold")
    click(page, "#max-Green")
    assert area(page, "#view-Green") > before[".ussim-stage"] and area(page, "#view-Red") == 0.0
    click(page, "#swap-Green")
    assert area(page, "#view-Green") == pytest.approx(before[".ussim-stage"], rel=0.01)
    assert area(page, ".ussim-stage") == pytest.approx(before["#view-Green"], rel=0.01)
    click(page, "#swap-Green")
    assert {name: area(page, name) for name in before} == pytest.approx(before)


def test_the_point_under_the_mouse_is_shown_and_marked_in_all_views(page):
    page.mouse.move(*at(page, 5.0, 20.0))  # in the fluid
    eventually(page, lambda: state(page, NAMES.views.under_mouse) != "")
    page.mouse.move(*at(page, 6.0, 20.0))
    told = "csf, R 6 A 0 S 20, 20.0 mm deep"
    eventually(page, lambda: state(page, NAMES.views.under_mouse).replace("P 0", "A 0") == told)
    assert page.locator("#under-mouse").inner_text().startswith("csf")
    assert set(state(page, NAMES.views.cross)) == {"ThreeD", "Red", "Green"}
    place = state(page, NAMES.views.cross)["Red"]
    assert place[2] == pytest.approx(0.0, abs=1e-3) and page.locator("#view-Red .ussim-cross").count() == 1
    box = page.locator("#view-Red").bounding_box()
    page.mouse.move(box["x"] + place[0] * box["width"], box["y"] + place[1] * box["height"])
    eventually(page, lambda: "image" in state(page, NAMES.views.cross))  # the same point from the other side
    ruler, (across, down, _) = page.evaluate("window.ussim.image.ruler"), state(page, NAMES.views.cross)["image"]
    assert ruler["x"] + across * ruler["w"] == pytest.approx(6.0, abs=0.6)
    assert ruler["y"] + down * ruler["h"] == pytest.approx(20.0, abs=0.6)
    assert state(page, NAMES.views.letters)["Red"] == ["L", "R", "S", "I"]
    page.mouse.move(5, 5)
    eventually(page, lambda: state(page, NAMES.views.under_mouse) == "" and not state(page, NAMES.views.cross))


def test_the_tissue_table_fits_into_its_drawer(page):
    open_section(page, "Tissues")
    size = page.evaluate(
        """() => { const [table, drawer] = ['.ussim-table', '#drawer'].map((name) => document.querySelector(name));
        return [table.scrollWidth, table.getBoundingClientRect().right, drawer.scrollWidth,
          drawer.getBoundingClientRect().right, drawer.clientWidth]; }"""
    )
    assert 0 < size[0] <= size[4] and size[1] <= size[3] and size[2] <= size[4]


@pytest.mark.slow
def test_a_caliper_across_the_fluid_reads_its_thickness(page):
    """From wall to wall: the echoes of its two surfaces are the brightest rows of the picture near them."""
    page.keyboard.press("f")
    status(page, "FROZEN")
    ruler, image = page.evaluate("window.ussim.image.ruler"), pixels(page).astype(float)
    rows = image[:, image.shape[1] // 4 : -image.shape[1] // 4].mean(axis=1)
    depth = ruler["y"] + (np.arange(len(rows)) + 0.5) * ruler["h"] / len(rows)
    walls = [float(depth[np.argmax(np.where(np.abs(depth - wall) < 1.5, rows, 0.0))]) for wall in FLUID_MM]
    assert walls == pytest.approx(FLUID_MM, abs=0.3)
    page.mouse.move(*at(page, 0.0, 20.0))
    page.keyboard.down("Control")
    page.mouse.wheel(0, -100)  # zoomed in, it reads the same
    page.keyboard.up("Control")
    eventually(page, lambda: page.evaluate("window.ussimScreens.view.zoom") > 1.1)
    page.keyboard.press("m")
    page.mouse.click(*at(page, 0.0, walls[0]))
    page.mouse.click(*at(page, 0.0, walls[1]))
    eventually(page, lambda: len(words(page)) == 1)
    assert float(words(page)[0].split()[0]) == pytest.approx(FLUID_MM[1] - FLUID_MM[0], abs=0.3)
    page.keyboard.press("0")
    page.keyboard.press("f")
    status(page, "LIVE")
    with new_image(page):
        page.keyboard.press("a")
    assert words(page) == []  # they belonged to the previous image


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
    with new_image(page):
        page.keyboard.press("f")
    status(page, "LIVE")
    assert not errors(page)


@pytest.mark.slow
def test_what_is_typed_stays_while_images_come(page):
    """Vue set all fields to their values with every image."""
    for name in ("gainSlider", "pose-numbers"):
        open_section(page, "Probe")
        field = page.locator(f"#{name}")
        before = field.input_value()
        field.fill("12")
        with new_image(page):
            page.evaluate("window.trame.trigger('set', ['dynamicRangeSlider', window.ussim.images % 2 ? 50 : 52])")
        page.wait_for_function("document.getElementById('image-values').textContent.includes('DR 5')")
        assert field.input_value() == "12"
        field.fill(before)
        field.blur()
    settled(page)


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
    click(page, "#measure summary")
    click(page, "#tool-mmode")
    for point in ((0.0, 5.0), (0.0, 35.0)):
        page.mouse.click(*at(page, *point))
    eventually(page, lambda: page.evaluate("Boolean(window.ussimScreens.images.mmode)"))
    assert pixels(page, "mmode").std() > 5
    click(page, "#mmode button")
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
        eventually(page, lambda: "skull is closed" not in json.dumps(state(page, NAMES.advice)))
        settled(page)
        open_section(page, "Probe")
        assert "craniotomy: a disc of" in page.locator("#probeNotesLabel").inner_text() and not errors(page)
        page.close()


@pytest.mark.slow
def test_axe_finds_nothing_wrong_with_the_page_and_its_sections(page):
    for title in ("Patient", "Probe", "Tissues", "Advanced", "Tracked ultrasound", "Fit to real ultrasound"):
        open_section(page, title)
    found = axe_of.Axe().run(page, options={"runOnly": ["wcag2a", "wcag2aa", "cat.name-role-value"]})
    wrong = [(entry["id"], node["html"][:150]) for entry in found.response["violations"] for node in entry["nodes"]]
    assert not wrong, "\n".join(map(str, wrong[:30]))


@pytest.mark.slow
def test_a_pose_is_typed_saved_and_opened_again(page, tmp_path):
    def where() -> np.ndarray:
        return np.array(page.evaluate("window.ussim.image.pose"))

    open_section(page, "Probe")
    before = where()
    numbers = [float(number) for number in page.locator("#pose-numbers").input_value().split()]
    np.testing.assert_allclose(pose_of_angles(numbers[:3], numbers[3:]), before, atol=1e-2)
    typed = page.locator("#pose-numbers")
    with new_image(page):
        typed.fill(f"{numbers[0] + 2} {' '.join(map(str, numbers[1:5]))} {numbers[5] + 4}")
        typed.blur()
    moved = where()
    np.testing.assert_allclose(moved, pose_of_angles([numbers[0] + 2, *numbers[1:3]], [*numbers[3:5], numbers[5] + 4]),
                               atol=1e-3)  # fmt: skip
    page.select_option("#pose-format", ".tfm")
    with page.expect_download() as waiting:
        click(page, "#save-pose")
    (tmp_path / "pose.tfm").write_bytes(waiting.value.path().read_bytes())
    np.testing.assert_allclose(read_pose(tmp_path / "pose.tfm"), moved, atol=1e-3)
    typed.fill("1 2 3")
    typed.blur()
    eventually(page, lambda: bool(errors(page)))
    assert errors(page)[0].startswith("the pose is '1 2 3', expected 6 numbers") and np.array_equal(where(), moved)
    page.evaluate("window.trame.trigger('dismiss', [0])")
    with new_image(page):
        page.evaluate("rows => window.trame.trigger('type_pose', [rows])", " ".join(map(str, before.ravel().tolist())))
    page.set_input_files("#open-file", tmp_path / "pose.tfm")
    page.get_by_text("Pose of the probe").click()
    eventually(page, lambda: np.allclose(where(), moved, atol=1e-3))
    assert not errors(page)
