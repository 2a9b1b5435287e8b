"""The workstation in the browser: `ussim serve` as a process, and Chromium as its client."""

from __future__ import annotations

import base64
import contextlib
import io
import re
import shutil
import socket
import tempfile
from collections import Counter
from pathlib import Path
from time import monotonic

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("trame_slicer", reason="the workstation comes with: pip install '.[serve]'")
pytest.importorskip("playwright", reason="browser tests need playwright: pip install '.[test]'")
pyigtl = pytest.importorskip("pyigtl", reason="OpenIGTLink comes with pyigtl: pip install '.[serve]'")

from playwright.sync_api import Page, sync_playwright  # noqa: E402

from SlicerUSSim.Logic import TissueTable, Volume  # noqa: E402
from SlicerUSSim.Logic.base.errors import required  # noqa: E402
from SlicerUSSim.Logic.base.volume import read_image_file  # noqa: E402
from SlicerUSSim.Logic.probe.poses import pose_looking_at  # noqa: E402
from SlicerUSSim.Workstation.state import NAMES, value_of  # noqa: E402
from tests.openigtlink_client import StrictClient  # noqa: E402
from tests.served import Served, refused  # noqa: E402
from tests.test_grown_lesions import CENTRE  # noqa: E402
from tests.test_tracking import free_port  # noqa: E402
from validation.brain_phantoms import phantom, tissue_maps, with_low_grade_tumour  # noqa: E402

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="Chromium is missing: apt-get install chromium")

FLAGS = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
]  # fmt: skip
#: A state that has not come after so long never will, however busy the machine is.
PATIENCE_S = 180
#: Trame's own messages that a page could not send since it was left are not faults of the page.
LEAVING = """addEventListener("beforeunload", () =>
  addEventListener("unhandledrejection", rejection => rejection.preventDefault()));"""
POSE = ("right_deg", "front_deg", "rotate_deg", "rock_deg", "tilt_deg", "lift_mm")


# ---- server and browser ----------------------------------------------------------------------------------------------


@contextlib.contextmanager
def serving(*arguments: str):
    """The URL printed by `ussim serve`, while it runs."""
    with tempfile.TemporaryDirectory(prefix="ussim-state-") as state:  # of its own: it offers no other one's pose
        server = Served("--port", "0", *arguments, state=state)
        try:
            yield server.url
            assert server.is_running, server.errors
        finally:
            server.end()


@pytest.fixture(scope="module")
def tracker():
    """A tracker's server, the peer of the workstation's --igtl."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    server = pyigtl.OpenIGTLinkServer(port=port, local_server=True)
    yield server
    server.stop()


@pytest.fixture(scope="module")
def url(files, tracker):
    arguments = [str(files / "head.nii.gz"), "--sequence", str(files / "sweep.igs.mha")]
    with serving(*arguments, "--igtl", f"127.0.0.1:{tracker.port}") as address:
        yield address


@pytest.fixture(scope="module")
def browser():
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield chromium
        chromium.close()


def opened(browser, address: str, problems: list[str] | None = None) -> Page:
    page = browser.new_page(viewport={"width": 1500, "height": 900})
    if problems is not None:
        page.on("pageerror", lambda error: problems.append(str(error)))
    page.add_init_script(LEAVING)
    page.set_default_timeout(1000 * PATIENCE_S)
    page.on("websocket", lambda socket: socket.on("framesent", lambda frame: _sent(page, frame)))
    page.goto(address)
    loaded(page)
    return page


#: Releases of the mouse in Slicer's views that pages have sent to their servers.
_RELEASES: Counter[Page] = Counter()


def _sent(page: Page, frame: bytes | str) -> None:
    _RELEASES[page] += (frame if isinstance(frame, bytes) else frame.encode()).count(b"LeftButtonRelease")


def loaded(page: Page) -> None:
    """Wait until the page shows an image, and make it count the images of Slicer's views."""
    page.wait_for_function("window.ussim?.images > 0")
    page.evaluate(
        """() => {
          const session = window.trame.client.getConnection().getSession();
          const counts = window.viewImages = {};
          session.subscribe('trame.rca.topic.stream', ([{ name, meta }]) => {
            if (meta?.number === undefined) counts[name] = (counts[name] ?? 0) + 1; }); }"""
    )


@pytest.fixture(scope="module")
def first_page(browser, url):
    problems: list[str] = []
    page = opened(browser, url, problems)
    settled(page)  # the sequence, whose depth the probe takes, comes after the first image
    yield page, problems


@pytest.fixture
def page(first_page, files):
    """The page with the head, its sequence, the probe at a craniotomy, and no messages."""
    page, problems = first_page
    dismiss_messages(page)
    close_drawer(page)
    page.mouse.move(600, 500)  # away from what shows tips
    open_head(page, files)
    if not shown(page, "liveCheckBox"):  # a test that failed has left it so
        click(page, "#live")
    page.evaluate("window.trame.trigger('press', ['placeButton'])")
    settled(page)
    yield page
    assert not problems


def open_head(page: Page, files: Path) -> None:
    """Open the head and its sequence again, unless they are open as they were."""
    is_as_it_was = shown(page, "lesionsSelector") is None and state(page, NAMES.sequence.length) == 6
    if state(page, NAMES.title) != "head.nii.gz" or not is_as_it_was:
        open_new_patient(page, files / "head.nii.gz", files / "sweep.igs.mha")
        eventually(page, lambda: state(page, NAMES.sequence.length) == 6)
        settled(page)


def open_new_patient(page: Page, *files: Path) -> None:
    """Open files of a new patient, whether one is open or not, and wait for the image."""
    is_one_open = state(page, NAMES.title) != ""
    page.set_input_files("#open-file", files)
    if is_one_open:
        answer_new_patient(page)
    page.wait_for_function("name => window.ussim.image?.patient === name", arg=files[0].name)
    settled(page)


def state(page: Page, name):
    """The value of one of NAMES on the page."""
    return page.evaluate("name => window.trame.state.get(name)", name)


def set_state(page: Page, name, value) -> None:
    page.evaluate("([name, value]) => window.trame.state.set(name, value)", [name, value])


def shown(page: Page, control: str):
    """The value of a control of the panel."""
    return state(page, value_of(control))


def errors(page: Page) -> list[str]:
    return state(page, NAMES.messages.errors)


def dismiss_messages(page: Page) -> None:
    """Dismiss all errors that the page shows."""
    for _ in errors(page):
        page.evaluate("window.trame.trigger('dismiss', [0])")


def pose(page: Page) -> dict[str, float]:
    where = state(page, NAMES.pose)
    return {name: where[name] for name in POSE}


def cost(page: Page) -> float:
    """The cost of simulated and real image as shown on the page."""
    return float(re.match(r"cost ([0-9.]+)", state(page, NAMES.sequence.similarity))[1])


def click(page: Page, selector: str) -> None:
    page.locator(selector).first.click()


#: Waits until the server is idle; the second answer arrives after all messages sent to the page before the first.
_AT_REST = """async (patience) => {
  const late = new Promise((_, failed) => setTimeout(() => failed(new Error('it never came to rest')), patience));
  for (let before = null; ; ) {
    const now = JSON.stringify(await Promise.race([window.trame.trigger('at_rest'), late]));
    if (now === before) return JSON.parse(now);
    before = now;
  } }"""
_DRAWN = """(numbers) => Object.entries(numbers).every(([name, number]) =>
  Number(document.querySelector(`canvas[data-stream="${name}"]`)?.dataset.number ?? 0) >= number)"""


def settled(page: Page) -> None:
    """Wait until all requests of the page are done and it shows the last images."""
    page.wait_for_function("!window.ussim.uploading && !window.ussim.exporting")
    page.wait_for_function(_DRAWN, arg=page.evaluate(_AT_REST, 1000 * PATIENCE_S))


def drawn(page: Page) -> None:
    """Wait until Slicer's views are up to date too: for two new images of each, since one may already be on its way."""
    settled(page)
    for _ in range(2):
        counts = page.evaluate("() => { window.trame.trigger('page_opened'); return { ...window.viewImages }; }")
        page.wait_for_function(
            """(before) => ['ThreeD', 'Red', 'Green'].every(
              (name) => (window.viewImages[name] ?? 0) > (before[name] ?? 0))""",
            arg=counts,
        )


@contextlib.contextmanager
def new_image(page: Page):
    """Asserts that the actions in it produce a new image."""
    count = page.evaluate("window.ussim.images")
    yield
    page.wait_for_function("n => window.ussim.images > n", arg=count)
    settled(page)


def eventually(page: Page, condition) -> None:
    """Wait until a condition is true."""
    end = monotonic() + PATIENCE_S
    while not condition():
        assert monotonic() < end, "it never became so"
        page.wait_for_timeout(100)


def pixels(page: Page, stream: str = "simulated") -> np.ndarray:
    """(rows, columns) of the image of a stream, as it came."""
    size, values = page.evaluate("stream => window.ussimScreens.pixels(stream)", stream)
    return np.frombuffer(base64.b64decode(values), np.uint8).reshape(size)


def views(page: Page):
    """The three views of Slicer: 3D, red (in plane), green (axial)."""
    found = page.locator(".ussim-anatomy .remote-controlled-area")
    assert found.count() == 3
    return [found.nth(n) for n in range(3)]


def picture(page: Page, box: dict) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(page.screenshot(clip=box))).convert("RGB")).astype(int)


@contextlib.contextmanager
def heard(page: Page, releases: int = 1):
    """Wait until the page has sent all mouse events in Slicer's views, which it sends one at a time."""
    before = _RELEASES[page]
    yield
    eventually(page, lambda: _RELEASES[page] >= before + releases)


def drag(page: Page, start: tuple[float, float], by: tuple[float, float], key: str | None = None) -> None:
    with _held(page, key), heard(page):
        page.mouse.move(*start)
        page.mouse.down()
        for share in np.linspace(0, 1, 9)[1:]:
            page.mouse.move(start[0] + share * by[0], start[1] + share * by[1])
            page.evaluate("() => new Promise(requestAnimationFrame)")  # the rate of a browser's mouse events
        page.mouse.up()
    settled(page)


@contextlib.contextmanager
def _held(page: Page, key: str | None):
    if key:
        page.keyboard.down(key)
    yield
    if key:
        page.keyboard.up(key)


def in_view(view, across: float, down: float) -> tuple[float, float]:
    box = view.bounding_box()
    return box["x"] + across * box["width"], box["y"] + down * box["height"]


def answer_new_patient(page: Page, title: str = "New patient") -> None:
    """Answer the question about a file that is opened while a patient is: it is a new one's, or `title`."""
    page.wait_for_function("document.getElementById('question')?.dataset.number > 0")
    page.locator("#question .ussim-choice").filter(has_text=title).click()
    page.locator("#question").wait_for(state="detached")


def download(page: Page, kind: str) -> Path:
    click(page, "#save summary")
    with page.expect_download() as waiting:
        click(page, f"#save-{kind}")
    return Path(waiting.value.path())


def open_section(page: Page, title: str) -> None:
    """Open a section of the drawer, and the drawer."""
    page.evaluate("document.getElementById('page').classList.add('drawer-open')")
    page.evaluate("name => document.getElementById(name).open = true", f"section-{title.replace(' ', '-').lower()}")


def close_drawer(page: Page) -> None:
    page.evaluate("document.getElementById('page').classList.remove('drawer-open')")


def status(page: Page, wanted: str) -> None:
    """Wait until the image is LIVE, OUTDATED or FROZEN."""
    page.wait_for_function(
        "wanted => document.getElementById('image-status')?.textContent.trim() === wanted", arg=wanted
    )


def shown_errors(page: Page) -> str:
    page.locator(".ussim-error").first.wait_for()
    return " ".join(page.locator(".ussim-error").all_inner_texts())


# ---- what one sees ---------------------------------------------------------------------------------------------------


def test_the_page_shows_image_marks_anatomy_and_the_panel_of_a_fit(page):
    image = pixels(page)
    assert image.shape[0] == 512 and image.mean() > 15
    us = page.evaluate("window.ussim.image.ruler")
    assert us["h"] == pytest.approx(70, rel=0.02)  # the depth of the sequence's probe
    screen = page.locator("[data-screen=simulated]")
    for mark in ("depth-ruler", "focus-mark", "orientation-mark", "grey-bar"):
        assert screen.locator(f".{mark}").bounding_box()["width"] > 0
    labels = screen.locator(".depth-ruler text").all_text_contents()
    assert labels[:3] == ["0", "20", "40"]
    ticks = [screen.locator(".depth-ruler text").nth(n).bounding_box()["y"] for n in range(3)]
    frame = screen.locator(".ussim-frame").bounding_box()
    assert (ticks[2] - ticks[0]) / frame["height"] == pytest.approx(40 / us["h"], rel=0.03)
    assert frame["width"] / frame["height"] == pytest.approx(us["w"] / us["h"], rel=0.02)
    drawn(page)
    for view in views(page):
        assert picture(page, view.bounding_box()).std() > 10
    open_section(page, "Fit to real ultrasound")
    assert page.locator("#fitButton").is_enabled() and page.locator("#applyFitButton").is_disabled()


@pytest.mark.slow
def test_slice_views_show_the_field_outlined_and_the_image_blended_in(page):
    box = views(page)[1].bounding_box()
    drawn(page)
    outlined = picture(page, box)
    red, green, blue = np.moveaxis(outlined, -1, 0)
    yellow = (red > 110) & (green > 80) & (blue < 0.6 * green)
    assert yellow.sum() > 25  # of a line of one pixel, not blended with the image below
    inside = np.zeros(yellow.shape, bool)
    rows, columns = np.nonzero(yellow)
    inside[rows.min() + 20 : rows.max() - 5, columns.min() + 40 : columns.max() - 40] = True
    textures = []
    for blend in (0, 1):
        set_state(page, NAMES.views.blend, blend)
        drawn(page)
        textures.append(picture(page, box).mean(axis=-1)[inside])
    set_state(page, NAMES.views.blend, 0.6)
    assert np.abs(np.diff(textures[1])).mean() > 2 * np.abs(np.diff(textures[0])).mean()  # speckle, not MRI


@pytest.mark.slow
def test_every_shown_parameter_has_its_tip_unit_and_range(page):
    from SlicerUSSim.Logic.imaging.preset import preset_parameters
    from SlicerUSSim.Widget.sections import value
    from SlicerUSSim.Workstation.page import NOT_SHOWN

    shown = {name: entry.shown for name, entry in preset_parameters().items() if entry.shown}
    assert len(shown) > 30
    for name, limits in shown.items():
        control = value(name)
        if control.widget in NOT_SHOWN or "depthGain" in control.widget:  # those stand side by side
            continue
        found = page.locator(f"#slider-{control.widget}" if control.kind == "slider" else f"#{control.widget}")
        assert found.count() == 1, name
        line = found.locator("xpath=ancestor-or-self::*[@title][1]")
        assert line.get_attribute("title") == control.tip and control.unit in line.text_content(), name
        if control.kind == "number":
            assert [float(found.get_attribute(limit)) for limit in ("min", "max")] == [limits.low, limits.high], name


# ---- moving the probe ------------------------------------------------------------------------------------------------


def test_the_probe_slides_where_the_mouse_drags_it_in_a_slice(page):
    before, image = pose(page), pixels(page)
    drag(page, in_view(views(page)[1], 0.5, 0.15), (35, 5))
    after = pose(page)
    assert abs(after["right_deg"] - before["right_deg"]) + abs(after["front_deg"] - before["front_deg"]) > 3
    assert abs(after["rock_deg"]) < 1 and abs(after["tilt_deg"]) < 1  # along the normal
    assert after["lift_mm"] == pytest.approx(before["lift_mm"], abs=1.0)
    assert (pixels(page) != image).mean() > 0.2


@pytest.mark.slow
def test_the_probes_body_is_taken_in_3d_and_slides_swings_or_rotates(page):
    drawn(page)
    box = views(page)[0].bounding_box()
    seen = picture(page, box)
    body = (seen.min(axis=-1) > 105) & (seen[..., 2] >= seen[..., 0]) & (seen[..., 2] - seen[..., 0] < 45)
    rows, columns = np.nonzero(body)
    assert len(rows) > 300
    grip = box["x"] + float(np.median(columns)), box["y"] + float(np.median(rows))
    before = pose(page)
    drag(page, grip, (0, 30), "Shift")
    swung = pose(page)
    assert abs(swung["rock_deg"] - before["rock_deg"]) + abs(swung["tilt_deg"] - before["tilt_deg"]) > 3
    assert swung["right_deg"] == pytest.approx(before["right_deg"], abs=0.1)
    click(page, "#place")
    settled(page)
    drag(page, grip, (40, 0), "Control")
    assert abs(pose(page)["rotate_deg"] - before["rotate_deg"]) == pytest.approx(20, abs=2)
    click(page, "#place")
    settled(page)
    drag(page, grip, (30, 40))
    slid = pose(page)
    assert abs(slid["right_deg"] - before["right_deg"]) + abs(slid["front_deg"] - before["front_deg"]) > 3


@pytest.mark.slow
def test_a_double_click_aims_the_probe_at_a_structure(page):
    page.evaluate("window.trame.trigger('plane', ['Green', 'Across'])")
    settled(page)
    before = pose(page)

    def aimed() -> bool:
        with heard(page, 2):
            page.mouse.dblclick(*in_view(views(page)[2], 0.4, 0.3))  # beside the image: the probe has to tilt
        settled(page)
        return pose(page) != before

    eventually(page, aimed)  # the server takes two clicks for two where it is too busy to handle them in time
    page.evaluate("window.trame.trigger('plane', ['Green', 'Axial'])")
    after = pose(page)
    assert abs(after["tilt_deg"] - before["tilt_deg"]) > 3 and after["right_deg"] == pytest.approx(before["right_deg"])
    page.mouse.dblclick(*in_view(page.locator("[data-screen=simulated] .ussim-frame"), 0.7, 0.4))
    settled(page)
    assert abs(pose(page)["rock_deg"] - after["rock_deg"]) > 3


def test_keys_and_sliders_move_the_probe(page):
    before = pose(page)
    for key, name, change in (("a", "rock_deg", 2), ("w", "tilt_deg", 2), ("Shift+E", "rotate_deg", 10)):
        with new_image(page):
            page.keyboard.press(key)
        after = pose(page)
        assert after[name] - before[name] == pytest.approx(change, abs=0.6), key
        before = after
    page.locator("#slider-gainSlider").focus()
    with new_image(page):
        page.keyboard.press("ArrowRight")  # of the slider
    assert shown(page, "gainSlider") > 0 and pose(page) == before
    with new_image(page):
        page.keyboard.press("d")  # which no slider takes
    assert pose(page)["rock_deg"] < before["rock_deg"]
    page.evaluate("window.trame.trigger('set', ['gainSlider', 0])")
    open_section(page, "Probe")
    with new_image(page):
        page.locator("#slider-pose-lift_mm").fill("10")
    assert pose(page)["lift_mm"] == pytest.approx(10, abs=2)
    open_section(page, "Beam and display")
    page.locator("#fieldOfViewSpinBox").click()
    before = pose(page)
    page.keyboard.press("w")  # what is typed into a field is not a key for the probe
    page.locator("#fieldOfViewSpinBox").blur()
    settled(page)
    assert pose(page) == before


# ---- tissues, settings -----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_changed_tissue_changes_the_image_and_nonsense_is_refused(page):
    open_section(page, "Tissues")
    cell, before = page.get_by_label("white matter mu0"), pixels(page)
    was = cell.input_value()
    with new_image(page):
        cell.fill("1.5")
        cell.blur()
    assert pixels(page).mean() > before.mean() + 5
    cell.fill("bright")
    cell.blur()
    assert "mu0 is 'bright', expected a number" in shown_errors(page)
    assert cell.input_value() == "1.5"
    page.get_by_role("row", name="white matter").locator("td").first.click()
    page.locator("#tissuePresetComboBox").select_option("white matter")
    with new_image(page):
        click(page, "#assignTissueButton")
    assert cell.input_value() == was and np.abs(pixels(page).astype(int) - before).mean() < 0.5


def test_gain_probe_and_depth_change_the_image(page):
    before, depth = pixels(page), shown(page, "depthSlider")
    with new_image(page):
        page.locator("#slider-gainSlider").fill("10")
    assert shown(page, "gainSlider") > 5 and pixels(page).mean() > before.mean() + 10
    probe, gain = shown(page, "probePresetComboBox"), shown(page, "gainSlider")
    with new_image(page):
        click(page, "#probe-linear")
    assert shown(page, "kindComboBox") == "linear" and shown(page, "radiusSpinBox") is None
    assert page.locator("#radiusSpinBox").is_disabled() and probe == "custom" and gain > 5
    open_section(page, "Beam and display")
    page.locator("#widthSpinBox").fill("-5")
    page.locator("#widthSpinBox").blur()
    assert "Width is -5 mm, expected a number between" in shown_errors(page)
    assert float(page.locator("#widthSpinBox").input_value()) > 0
    with new_image(page):
        page.evaluate("window.trame.trigger('set', ['probePresetComboBox', 'custom'])")  # the sequence's
    assert shown(page, "kindComboBox") == "phased"
    with new_image(page):
        page.evaluate("window.trame.trigger('set', ['depthSlider', 50])")
    assert page.evaluate("window.ussim.image.ruler.h") == pytest.approx(50, rel=0.02)
    with new_image(page):
        page.evaluate("depth => window.trame.trigger('set', ['depthSlider', depth])", depth)
        page.evaluate("window.trame.trigger('set', ['gainSlider', 0])")
    assert np.array_equal(pixels(page), before)


# ---- real images -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_sequence_plays_beside_the_simulation_and_the_cost_follows(page):
    click(page, "#compare-beside")
    settled(page)
    page.evaluate("window.trame.trigger('show_number', [0])")
    settled(page)
    real = pixels(page, "real")
    assert real.shape == pixels(page).shape and real.mean() > 15
    assert 0 < cost(page) < 1
    click(page, "#play")
    eventually(page, lambda: state(page, NAMES.sequence.number) >= 3)
    click(page, "#play")
    settled(page)
    assert (pixels(page, "real") != real).mean() > 0.1
    at_the_pose = cost(page)
    for _ in range(4):
        page.keyboard.press("Shift+ArrowRight")
    settled(page)
    assert cost(page) > at_the_pose  # away from the recorded pose the cost is higher


@pytest.mark.slow
def test_real_and_simulated_blink_or_are_subtracted(page):
    page.evaluate("window.trame.trigger('show_number', [2])")
    click(page, "#compare-difference")
    real = page.locator("canvas[data-stream=real-over]")
    real.and_(page.locator(".difference")).wait_for()
    settled(page)
    box = page.locator("[data-screen=simulated] .ussim-frame").bounding_box()
    difference = picture(page, box).mean()
    click(page, "#compare-simulated")
    real.wait_for(state="hidden")
    assert 0 < difference < 0.8 * picture(page, box).mean()
    click(page, "#compare-blink")
    seen = set()

    def blinked() -> bool:
        seen.add(round(float(picture(page, box).mean()), 1))
        return len(seen) >= 2

    eventually(page, blinked)
    click(page, "#compare-beside")


def fit(page: Page, evaluations: int) -> None:
    open_section(page, "Fit to real ultrasound")
    box = page.locator("#fitEvaluationsSpinBox")
    box.fill(str(evaluations))
    box.blur()
    eventually(page, lambda: shown(page, "fitEvaluationsSpinBox") == evaluations)
    click(page, "#fitButton")


@pytest.mark.slow
def test_a_fit_outlives_its_page_and_is_applied_and_reverted(page, browser, url):
    page.evaluate("window.trame.trigger('show_number', [2])")
    settled(page)
    before = cost(page)
    page.evaluate("window.trame.trigger('set', ['fitFramesLineEdit', '2'])")
    other = opened(browser, url)
    fit(other, 120)
    eventually(other, lambda: len(state(other, NAMES.fit.curve)) > 1)
    other.close()
    open_section(page, "Fit to real ultrasound")
    page.locator("#cost-curve svg").wait_for()
    eventually(page, lambda: shown(page, "fitLabel").startswith("cost"))
    settled(page)
    curve = state(page, NAMES.fit.curve)
    assert len(curve) > 2 and min(curve) < curve[0] and curve == sorted(curve, reverse=True)
    evaluations = int(re.search(r", (\d+) evaluations", shown(page, "fitLabel"))[1])
    assert 30 <= evaluations <= 120
    with new_image(page):
        click(page, "#applyFitButton")
    assert cost(page) <= before  # three decimals
    with new_image(page):
        click(page, "#revertFitButton")
    assert cost(page) == pytest.approx(before, abs=0.02)
    page.evaluate("window.trame.trigger('set', ['fitFramesLineEdit', ''])")


@pytest.mark.slow
def test_a_fit_is_cancelled_and_nothing_changes(page):
    summary, gain = shown(page, "fitLabel"), shown(page, "gainSlider")
    fit(page, 100_000)
    page.locator("#cancel").wait_for()
    eventually(page, lambda: len(state(page, NAMES.fit.curve)) > 1)
    click(page, "#cancel")
    eventually(page, lambda: not state(page, NAMES.messages.progress_title))
    assert shown(page, "fitLabel") == summary and shown(page, "gainSlider") == gain
    assert not errors(page)


# ---- export ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_images_are_exported_as_they_are_seen_with_their_place(page):
    seen = pixels(page)
    png = np.asarray(Image.open(download(page, "png")))
    assert png.shape == seen.shape and np.abs(png.astype(int) - seen).mean() < 4  # the page has it as JPEG
    arrays = []
    for kind in ("nrrd", "mha", "vti"):
        file = download(page, kind)
        named = file.with_suffix(f".{kind}")
        shutil.copy(file, named)
        arrays.append(read_image_file(named))
    to_ras = arrays[0].ijk_to_ras
    for found in arrays:
        assert np.array_equal(found.array[0], png) and np.allclose(found.ijk_to_ras, to_ras, atol=1e-4)
    assert np.linalg.norm(to_ras[:3, 0]) == pytest.approx(
        page.evaluate("window.ussim.image.ruler.w") / png.shape[1], rel=1e-4
    )


def round_head(folder: Path) -> Volume:
    """A brain in skull and skin, whose labels are written to labels.nii.gz with their table."""
    axis = np.arange(-84.0, 85.0, 3.0)
    radius = np.sqrt(sum(place**2 for place in np.meshgrid(axis, axis, axis)))
    matrix = np.diag([3.0, 3.0, 3.0, 1.0])
    matrix[:3, 3] = axis[0]
    labels = Volume(np.select([radius < 60, radius < 70, radius < 78], [1, 2, 3], 0).astype(np.uint8), matrix)
    labels.write(folder / "labels.nii.gz")
    TissueTable.brain(("grey matter", "skull", "skin")).write(folder / "labels.json")
    return labels


def test_a_saved_scene_opens_again_with_the_same_image(page, tmp_path):
    from slicer import vtkSlicerSequencesLogic
    from trame_slicer.core import SlicerApp

    from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic
    from SlicerUSSim.Logic.mrml.nodes import read_volume

    expected = np.asarray(Image.open(download(page, "png")))
    bundle = tmp_path / "ultrasound.mrb"
    shutil.copy(download(page, "mrb"), bundle)
    app = SlicerApp()  # Slicer's own scene and logic, without a window
    app.register_module_logic(vtkSlicerSequencesLogic())
    assert app.io_manager.load_scene(bundle)
    logic = UltrasoundSceneLogic(app.scene)
    parameters = logic.parameters
    assert np.array_equal(read_volume(parameters.output).array[0], expected)
    logic.simulate(parameters.labels, parameters.probe_transform, parameters.output)
    assert np.abs(read_volume(parameters.output).array[0].astype(int) - expected).max() <= 1
    assert parameters.real.GetNumberOfDataNodes() == 6 and parameters.mri is not None
    assert app.scene.GetFirstNodeByName("Probe body") is None  # what only this page shows stays here


# ---- tracker ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_tracker_moves_the_probe_and_gets_every_image_with_its_matrix(page, tracker):
    target = pose_looking_at([35.0, 0.0, 60.0], [0.0, 0.0, 0.0])
    tracker.send_message(pyigtl.TransformMessage(target, device_name="ProbeToReference"), wait=False)
    end = monotonic() + PATIENCE_S
    while True:
        assert monotonic() < end, "no image came of where the tracker put the probe"
        message = tracker.wait_for_message("SlicerUSSim", timeout=1)
        if message is None:
            continue
        matrix = message.ijk_to_world_matrix
        # The middle of the image's upper edge is the face of the probe, its rows run down the axis.
        middle = (matrix @ [(message.image.shape[2] - 1) / 2, -0.5, 0, 1])[:3]
        if np.linalg.norm(middle - target[:3, 3]) < 0.5:
            break
    down = matrix[:3, 1] / np.linalg.norm(matrix[:3, 1])
    assert np.allclose(middle, target[:3, 3], atol=0.5) and np.allclose(down, target[:3, 1], atol=1e-3)
    assert message.image.max() > 50
    page.get_by_text("following ProbeToReference").wait_for()


@pytest.mark.slow
def test_clients_see_the_page_as_an_ultrasound_device(browser, files):
    port = free_port()
    with serving(str(files / "head.nii.gz"), "--igtl", f":{port}") as address:
        page = opened(browser, address)
        with StrictClient(port) as client, StrictClient(port) as robot:
            assert client.next("IMAGE").device == "SlicerUSSim"
            wanted = '<Parameter Name="DepthMm" Value="80"/><Parameter Name="GainPercent" Value="60"/>'
            reply = client.command(f'<Command Name="SetUsParameter">{wanted}</Command>')
            assert reply.metadata == {"DepthMm": "SUCCESS", "GainPercent": "SUCCESS", "Status": "SUCCESS"}
            asked = '<Parameter Name="DepthMm"/><Parameter Name="GainPercent"/>'
            reply = client.command(f'<Command Name="GetUsParameter">{asked}</Command>')
            assert reply.metadata == {"DepthMm": "80", "GainPercent": "60", "Status": "SUCCESS"}
            calibration = robot.next("TRANSFORM", "ImageToProbe").matrix
            place = robot.next("TRANSFORM", "ProbeToReference").matrix
            image, matrix = robot.next("IMAGE").image
            assert np.allclose((place @ calibration)[:, [0, 1, 3]], matrix[:, [0, 1, 3]], atol=1e-3) and image.any()
            place[0, 3] += 1.5
            robot.move(place)
            while not np.allclose(robot.next("TRANSFORM", "ProbeToReference").matrix, place, atol=1e-3):
                pass
            page.get_by_text("connected to 2 clients, following ProbeToReference").wait_for()
        page.close()


# ---- more than one page, reload, errors ------------------------------------------------------------------------------


@pytest.mark.slow
def test_two_tabs_show_and_drive_the_same_workstation(page, browser, url):
    other = opened(browser, url)
    before = pose(page)
    other.keyboard.press("Shift+A")
    settled(other)
    settled(page)
    assert pose(page)["rock_deg"] - before["rock_deg"] == pytest.approx(10, abs=0.7)
    assert pose(other) == pose(page)
    assert np.abs(pixels(page).astype(int) - pixels(other)).mean() < 1
    other.close()
    page.keyboard.press("a")  # and one can go
    settled(page)
    assert pose(page)["rock_deg"] - before["rock_deg"] == pytest.approx(12, abs=0.9)


def test_a_reloaded_page_shows_the_same_image(page):
    image, where = pixels(page), pose(page)
    page.reload()
    loaded(page)
    settled(page)
    assert np.array_equal(pixels(page), image) and pose(page) == where


@pytest.mark.slow
def test_a_click_grows_a_lesion_that_is_added_to_the_tissues(browser, tmp_path):
    maps = with_low_grade_tumour(required(tissue_maps("mni152"), "no atlas"), CENTRE, 14.0).coarser(2)
    image = phantom(maps, "flair", noise=0.03, bias=0.0)
    image.mri.write(tmp_path / "flair.nii.gz")
    image.mask.write(tmp_path / "mask.nii.gz")
    arguments = [str(tmp_path / "flair.nii.gz"), "--contrast", "flair", "--mask", str(tmp_path / "mask.nii.gz")]
    with serving(*arguments) as address:
        page = opened(browser, address)
        settled(page)
        axial = views(page)[2]
        for across, down in ((0.05, 0.1), (0.352, 0.507)):  # beside the head; in the lesion
            page.evaluate("window.trame.trigger('press', ['pickSeedButton'])")
            settled(page)
            with heard(page):
                page.mouse.click(*in_view(axial, across, down))
            if down == 0.1:
                eventually(page, lambda: bool(errors(page)))
                assert re.search(r"mm outside the (brain|image)", errors(page)[0]), errors(page)
                dismiss_messages(page)
        eventually(page, lambda: "grown: tumour" in shown(page, "lesionNotesLabel"))
        page.evaluate("window.trame.trigger('press', ['addTissuesButton'])")
        eventually(page, lambda: "tumour" in [row["name"] for row in state(page, NAMES.panel.tissues)])
        settled(page)
        assert not errors(page)
        page.close()


def test_a_file_that_cannot_be_read_is_reported_and_changes_nothing(page):
    before = state(page, NAMES.title), shown(page, "kindComboBox"), shown(page, "mriSelector")
    broken = {"name": "broken.nii.gz", "mimeType": "application/octet-stream", "buffer": b"this is not an image"}
    page.set_input_files("#open-file", broken)
    text = shown_errors(page)
    assert "broken.nii.gz: " in text and "/tmp" not in text and "Traceback" not in text
    settled(page)
    assert (state(page, NAMES.title), shown(page, "kindComboBox"), shown(page, "mriSelector")) == before
    page.locator(".ussim-error button").first.click()
    eventually(page, lambda: not errors(page))


# ---- who may come in, and how it is started --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["missing.nii.gz"], "missing.nii.gz: no such file"),
        (["{broken}"], "broken.nii.gz: cannot be read"),
        (["--igtl", "nowhere"], "--igtl is 'nowhere', expected HOST:PORT"),
        (["--igtl", "listen:203.0.113.7:18944"], "cannot wait for a tracker at 203.0.113.7:18944"),
        (["--host", "203.0.113.7"], "cannot listen at 203.0.113.7"),
        (["--labels", "{head}", "--contrast", "t2"], "head.nii.gz: is a label map, and --contrast is for an MRI"),
        (["{head}", "--set", "patient.no_sheets=falx"], "no_sheets leaves out some of --sheets; give --sheets, too"),
    ],
)
def test_what_cannot_be_served_is_reported_in_one_line(files, arguments, message):
    names = {name: files / f"{name}.nii.gz" for name in ("broken", "head", "far")}
    assert message in refused(*(text.format(**names) for text in arguments))


def test_a_port_that_is_taken_is_reported():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert f"127.0.0.1:{port}" in refused("--port", port)
