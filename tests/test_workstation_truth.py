"""Every picture of the workstation says whose it is, and shows what is there now; nothing of the user's is lost."""

from __future__ import annotations

import json
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
from vtkmodules.vtkIOXML import vtkXMLImageDataReader

from SlicerUSSim.Logic import Volume
from SlicerUSSim.Logic.base.volume import read_image_file
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence
from SlicerUSSim.Workstation.scene_files import read_scene
from SlicerUSSim.Workstation.state import NAMES
from tests.conftest import name_labels
from tests.test_workstation import (
    answer_new_patient,
    browser as browser,
    click,
    cost,
    dismiss_messages,
    download,
    errors,
    eventually,
    first_page as first_page,
    new_image,
    open_head,
    open_new_patient,
    pixels,
    pose,
    pytestmark as pytestmark,
    serving,
    settled,
    shown,
    shown_errors,
    state,
    status,
)


@pytest.fixture(scope="module")
def url(files):
    with serving(str(files / "head.nii.gz"), "--sequence", str(files / "sweep.igs.mha")) as address:
        yield address


@pytest.fixture
def page(first_page, files):
    """The page with a patient, live images, the probe at a craniotomy, and no messages."""
    page, problems = first_page
    dismiss_messages(page)
    if state(page, NAMES.title) == "":
        open_new_patient(page, files / "head.nii.gz")
    page.mouse.move(600, 500)
    if not shown(page, "liveCheckBox"):
        click(page, "#live")
        eventually(page, lambda: shown(page, "liveCheckBox"))
    page.evaluate("window.trame.trigger('press', ['placeButton'])")
    settled(page)
    yield page
    assert not problems


@pytest.fixture
def head_page(page, files):
    """The page with the head and its sequence."""
    open_head(page, files)
    return page


def lift_off(page) -> None:
    """Beyond the volume of the patient."""
    page.evaluate("() => { for (let n = 0; n < 100; n++) window.trame.trigger('key', ['+', true]); }")


# ---- what an image is of ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_an_image_comes_with_patient_time_pose_and_ruler(head_page, tmp_path):
    page = head_page
    image = page.evaluate("window.ussim.image")
    assert image["patient"] == "head.nii.gz" and image["ruler"]["h"] == pytest.approx(70, rel=0.02)
    assert np.shape(image["pose"]) == (4, 4) and image["time"].startswith("20")
    assert f"{image['time'][11:19]} UTC" in page.locator("#image-caption").inner_text()
    with new_image(page):
        page.keyboard.press("a")
    after = page.evaluate("window.ussim.image")
    assert after["pose"] != image["pose"] and after["time"] > image["time"]
    png = Image.open(download(page, "png"))
    about = json.loads(png.text["SlicerUSSim"])
    assert about["patient"] == "head.nii.gz" and about["preset"]["probe"]["kind"] == "phased"
    np.testing.assert_allclose(about["probe_to_ras"], after["pose"], atol=1e-3)
    for kind in ("nrrd", "mha"):
        content = download(page, kind).read_bytes()
        assert b"head.nii.gz" in content and b"probe_to_ras" in content and b"preset" in content, kind
    vti = vtkXMLImageDataReader()
    vti.SetFileName(str(download(page, "vti")))
    vti.Update()
    assert json.loads(vti.GetOutput().GetFieldData().GetAbstractArray("SlicerUSSim").GetValue(0)) == about
    with new_image(page):
        page.keyboard.press("a")
    shutil.copy(download(page, "cine"), tmp_path / "cine.igs.mha")
    cine = TrackedSequence.read(tmp_path / "cine.igs.mha")
    last, moved = json.loads(cine.fields["SlicerUSSim"]), page.evaluate("window.ussim.image")
    assert (last["patient"], last["time"], last["preset"]) == ("head.nii.gz", moved["time"], about["preset"])
    np.testing.assert_allclose(cine.pose(len(cine) - 1, "ProbeToReference"), moved["pose"], atol=1e-3)
    assert cine.timestamps[-2] < cine.timestamps[-1] and not np.array_equal(cine.images[-2], cine.images[-1])


@pytest.mark.slow
def test_ruler_and_image_change_together(page):
    page.evaluate(
        """() => { window.drawnWith = []; const draw = CanvasRenderingContext2D.prototype.drawImage;
        CanvasRenderingContext2D.prototype.drawImage = function (bitmap, ...rest) {
          if (this.canvas.dataset.stream === 'simulated') {
            const [, , w, h] = document.getElementById('overlay').getAttribute('viewBox').split(' ').map(Number);
            window.drawnWith.push([window.ussim.image.ruler.h, h, w / h, bitmap.width / bitmap.height]); }
          return draw.call(this, bitmap, ...rest); }; }"""
    )
    for depth in (50, 90, 70):
        with new_image(page):
            page.evaluate("depth => window.trame.trigger('set', ['depthSlider', depth])", depth)
    drawn_with = page.evaluate("window.drawnWith")
    assert {round(entry[0] / 10) * 10 for entry in drawn_with} == {50, 70, 90}
    for of_image, of_ruler, ratio, of_pixels in drawn_with:
        assert of_image == of_ruler and ratio == pytest.approx(of_pixels, rel=0.02)


@pytest.mark.long
def test_a_frozen_image_stays_where_it_was_taken_in_every_export(head_page, tmp_path):
    page = head_page
    status(page, "LIVE")
    click(page, "#live")
    status(page, "FROZEN")
    settled(page)
    taken, seen = page.evaluate("window.ussim.image.pose"), pixels(page)
    for _ in range(4):
        page.keyboard.press("Shift+ArrowRight")
    settled(page)
    assert page.evaluate("window.ussim.image.pose") == taken and np.array_equal(pixels(page), seen)
    shutil.copy(download(page, "nrrd"), tmp_path / "frozen.nrrd")
    frozen = read_image_file(tmp_path / "frozen.nrrd")
    node, in_scene = output_of_scene(download(page, "mrb"), tmp_path)
    np.testing.assert_allclose(in_scene, frozen.ijk_to_ras, atol=1e-3)
    assert node.GetAttribute("SlicerUSSim.frozen") and not errors(page)
    click(page, "#live")
    status(page, "LIVE")


def output_of_scene(bundle: Path, folder: Path):
    """(the output volume node, (4, 4) of its slice to the world) of an .mrb."""
    from trame_slicer.core import SlicerApp

    from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic
    from SlicerUSSim.Logic.mrml.nodes import ijk_to_ras, node_to_world

    shutil.copy(bundle, folder / "scene.mrb")
    app = SlicerApp()
    app.register_module_logic(slicer.vtkSlicerSequencesLogic())
    assert app.io_manager.load_scene(folder / "scene.mrb")
    output_of_scene.app = app  # keeps its nodes
    node = UltrasoundSceneLogic(app.scene).parameters.output
    return node, node_to_world(node) @ ijk_to_ras(node)


@pytest.mark.slow
def test_a_live_image_is_saved_where_it_was_taken(page, tmp_path):
    shutil.copy(download(page, "nrrd"), tmp_path / "live.nrrd")
    _, in_scene = output_of_scene(download(page, "mrb"), tmp_path)
    np.testing.assert_allclose(in_scene, read_image_file(tmp_path / "live.nrrd").ijk_to_ras, atol=1e-3)
    with new_image(page):
        page.keyboard.press("a")
    status(page, "LIVE")


@pytest.mark.slow
def test_the_cost_is_blank_where_the_probe_sees_nothing(head_page):
    """A black image had a lower cost than a real one."""
    page = head_page
    page.evaluate("window.trame.trigger('show_number', [2])")
    settled(page)
    assert 0 < cost(page) < 1
    lift_off(page)
    settled(page)
    assert "looks past the volume" in state(page, NAMES.messages.status)
    assert state(page, NAMES.sequence.similarity) == "" == page.locator("#similarity").inner_text()
    page.evaluate("window.trame.trigger('show_number', [2])")
    settled(page)
    assert 0 < cost(page) < 1


@pytest.mark.slow
def test_a_new_patient_clears_image_ruler_cost_and_pose_at_once(head_page, files, tmp_path):
    page = head_page
    for _ in range(6):
        page.keyboard.press("Shift+ArrowLeft")
    settled(page)
    moved = pose(page)
    other = Volume.read(files / "labels.nii.gz")
    shift = np.eye(4)
    shift[:3, 3] = [0.0, 9.0, -13.0]
    Volume(other.array, shift @ other.ijk_to_ras).write(tmp_path / "other.nii.gz")
    name_labels(tmp_path / "other.nii.gz", [other.label_names[n] for n in sorted(other.label_names)])
    page.evaluate(
        """() => { window.cleared = [];
        const look = () => { const image = window.ussim.image;
          window.cleared.push([document.getElementById('title').textContent, image?.patient ?? null,
            document.getElementById('overlay').children.length, document.getElementById('image-caption').textContent]);
          if (window.looking) setTimeout(look, 5); };
        window.looking = true; look(); }"""
    )
    open_new_patient(page, tmp_path / "other.nii.gz")
    seen = page.evaluate("() => { window.looking = false; return window.cleared; }")
    assert ["other.nii.gz", None, 0, ""] in seen, seen[-5:]
    late = [entry for entry in seen if entry[0] == "other.nii.gz" and entry[1] == "head.nii.gz"]
    assert len(late) <= 3, late  # the messages about title and image are two
    assert not errors(page) and state(page, NAMES.sequence.similarity) == ""
    placed = pose(page)
    page.evaluate("window.trame.trigger('press', ['placeButton'])")
    settled(page)
    assert pose(page) == placed != moved


def nodes_of_scene(bundle: Path) -> list[str]:
    """Names of what an .mrb holds: files, and nodes with the name of a patient."""
    with zipfile.ZipFile(bundle) as archive:
        (scene,) = [name for name in archive.namelist() if name.endswith(".mrml")]
        text = archive.read(scene).decode()
        return [*archive.namelist(), *re.findall(r'name="([^"]*)"', text)]


@pytest.mark.slow
def test_a_saved_scene_holds_this_patient_only_and_a_patient_can_be_closed(page, files, tmp_path):
    """A scene held 21 files of three patients."""
    for name in ("second", "third"):
        shutil.copy(files / "labels.nii.gz", tmp_path / f"{name}.nii.gz")
        open_new_patient(page, tmp_path / f"{name}.nii.gz")
    held = nodes_of_scene(download(page, "mrb"))
    assert any("third.nii.gz" in name for name in held)
    assert not [name for name in held if "second" in name or "head.nii" in name or "sweep" in name], held
    page.evaluate("window.trame.trigger('close_patient')")
    page.wait_for_function("window.ussim.image === null")
    settled(page)
    assert page.locator("#title").inner_text() == "" and page.locator("#notesLabel").inner_text() == ""
    assert shown(page, "mriSelector") is None and not errors(page)
    assert not [name for name in nodes_of_scene(download(page, "mrb")) if "third" in name]
    page.set_input_files("#open-file", tmp_path / "second.nii.gz")
    page.wait_for_function("window.ussim.image?.patient === 'second.nii.gz'")
    settled(page)
    assert not errors(page)


@pytest.mark.long
def test_an_upload_shows_how_far_it_is_can_be_cancelled_and_images_go_on(page, files):
    """Of 216 MB nothing was shown for 49 s, and no image came meanwhile."""
    session = page.context.new_cdp_session(page)
    session.send("Network.enable")
    slow = {"offline": False, "latency": 0, "downloadThroughput": -1, "uploadThroughput": 2_000_000}
    session.send("Network.emulateNetworkConditions", slow)
    before = state(page, NAMES.title)
    content = np.random.default_rng(0).integers(0, 255, 16_000_000, np.uint8).tobytes()
    try:
        page.set_input_files("#open-file", {"name": "big.nrrd", "mimeType": "application/x", "buffer": content})
        page.locator("#upload-text").wait_for()
        page.wait_for_function("/Send big.nrrd [1-9][0-9]* %/.test(document.getElementById('upload-text').textContent)")
        count = page.evaluate("window.ussim.images")
        page.keyboard.press("a")
        page.wait_for_function("n => window.ussim.images > n && window.ussim.uploading", arg=count)
        click(page, "#upload-cancel")
        page.wait_for_function("!window.ussim.uploading")
        assert page.locator("#upload").is_hidden()
    finally:
        session.send("Network.emulateNetworkConditions", {**slow, "uploadThroughput": -1})
    settled(page)
    assert state(page, NAMES.title) == before and not errors(page)


# ---- images of a sequence --------------------------------------------------------------------------------------------


@pytest.mark.long
def test_simulated_sequences_are_shown_and_played_where_they_were_taken(head_page, files, tmp_path):
    """The page made images that it could not show."""
    page = head_page
    assert state(page, NAMES.cine.sequence_length) == 0
    page.evaluate("window.trame.trigger('press', ['simulateSequenceButton'])")
    settled(page)
    assert not errors(page) and state(page, NAMES.cine.sequence_length) == 6
    page.evaluate("window.trame.trigger('cine_source', ['sequence'])")
    settled(page)
    assert (state(page, NAMES.cine.length), state(page, NAMES.cine.index)) == (6, 0)
    recorded = TrackedSequence.read(files / "sweep.igs.mha")
    seen = []
    for number in (1, 4):
        page.evaluate("number => window.trame.trigger('cine_show', [number])", number)
        settled(page)
        image = page.evaluate("window.ussim.image")
        assert image["sequence"] == number
        status(page, "FROZEN")
        np.testing.assert_allclose(image["pose"], recorded.transforms[number]["ProbeToReference"], atol=0.05)
        assert state(page, NAMES.sequence.number) == number and cost(page) > 0  # beside the real image of that pose
        assert not shown(page, "liveCheckBox")
        seen.append(pixels(page))
    assert not np.array_equal(*seen)
    # The probe is there, and what is exported is that image
    np.testing.assert_allclose(probe_pose(page), recorded.transforms[4]["ProbeToReference"], atol=0.05)
    again = np.asarray(Image.open(download(page, "png")))
    shutil.copy(download(page, "mrb"), tmp_path / "sequence.mrb")
    record = read_scene(str(tmp_path / "sequence.mrb")).simulated
    assert record is not None and len(record.images) == 6 and np.array_equal(record.images[4], again)
    assert '"patient": "head.nii.gz"' in record.about
    click(page, "#cine-play")
    page.wait_for_function(f"window.trame.state.get('{NAMES.cine.index}') === 2")
    page.wait_for_function(f"window.trame.state.get('{NAMES.cine.index}') === 5")
    click(page, "#live")  # ends it
    eventually(page, lambda: not state(page, NAMES.cine.playing))
    eventually(page, lambda: shown(page, "liveCheckBox"))
    with new_image(page):
        page.keyboard.press("a")
    assert page.evaluate("window.ussim.image.sequence") is None
    status(page, "LIVE")
    # Those of a patient go with him
    open_new_patient(page, files / "labels.nii.gz")
    assert state(page, NAMES.cine.sequence_length) == 0 and not errors(page)


def probe_pose(page) -> np.ndarray:
    """(4, 4) of the probe, as the page shows it in numbers."""
    return np.array(state(page, NAMES.pose_matrix).split(), float).reshape(4, 4)


# ---- work that takes long --------------------------------------------------------------------------------------------


_AT_WORK = f"title => window.trame.state.get('{NAMES.messages.progress_title}') === title"


def cancel(page) -> None:
    """Press Cancel and wait until the page shows that nothing is under way."""
    page.evaluate("document.getElementById('cancel').click()")  # playwright waits until a button stands still
    page.wait_for_function(_AT_WORK, arg="")


def image_during(page, title: str) -> None:
    """Assert that the image follows the probe while something is under way."""
    count = page.evaluate("window.ussim.images")
    page.keyboard.press("a")
    page.wait_for_function("n => window.ussim.images > n", arg=count)
    assert page.evaluate(_AT_WORK, title)


@pytest.mark.long
def test_a_surface_is_cancelled_or_late_and_images_go_on(page, files, tmp_path):
    k, j, i = np.ogrid[-119.5:120, -119.5:120, -119.5:120]
    away = k**2 + j**2 + i**2
    ball = sum((away < radius**2).astype(np.uint8) for radius in (60.0, 90.0, 110.0))
    Volume(ball, np.eye(4)).write(tmp_path / "ball.nii.gz")
    shutil.copy(files / "labels.json", tmp_path / "ball.json")
    ball = [tmp_path / "ball.nii.gz", tmp_path / "ball.json"]
    page.set_input_files("#open-file", ball)
    answer_new_patient(page)
    page.wait_for_function(_AT_WORK, arg="Make the surface")
    cancel(page)
    settled(page)
    assert state(page, NAMES.title) == "ball.nii.gz" and state(page, NAMES.pose) is None
    assert state(page, NAMES.messages.status).startswith("no surface of the patient") and pixels(page).any()
    click(page, "#look")
    page.wait_for_function(_AT_WORK, arg="Make the surface")
    image_during(page, "Make the surface")
    settled(page)
    assert abs(state(page, NAMES.pose)["lift_mm"]) < 5
    page.set_input_files("#open-file", ball)
    answer_new_patient(page)
    page.wait_for_function(_AT_WORK, arg="Make the surface")
    page.evaluate("window.trame.trigger('close_patient')")
    page.wait_for_function("window.ussim.image === null")
    settled(page)
    assert state(page, NAMES.title) == "" and state(page, NAMES.pose) is None
    page.keyboard.press("ArrowRight")  # along no surface
    settled(page)
    assert state(page, NAMES.pose) is None and page.evaluate("window.ussim.image") is None


@pytest.mark.slow
def test_exports_are_for_whom_has_the_token(page, browser, url):
    other = browser.new_context()
    address = f"{url.split('?')[0]}exported?kind="
    assert other.request.get(f"{address}json").status == 403
    found = page.request.get(f"{address}json")
    assert found.status == 200 and found.headers["cache-control"] == "no-store" and "probe" in found.json()
    assert page.request.get(f"{address}../secret").status == 204
    shown_errors(page)  # the message comes by the page's socket, after the answer
    assert errors(page) == ["the export is '../secret', expected one of the menu"]
    dismiss_messages(page)
    other.close()
