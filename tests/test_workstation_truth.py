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
from SlicerUSSim.Workstation.state import NAMES
from tests.conftest import name_labels
from tests.test_workstation import (
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
            const { w, h } = window.ussimScreens.place('simulated').ruler;
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
            document.querySelector('[data-screen=simulated] svg').children.length,
            document.getElementById('image-caption').textContent.trim()]);
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
    assert state(page, NAMES.title) == "" == shown(page, "notesLabel")
    assert shown(page, "mriSelector") is None and not errors(page)
    assert not [name for name in nodes_of_scene(download(page, "mrb")) if "third" in name]
    page.set_input_files("#open-file", tmp_path / "second.nii.gz")
    page.wait_for_function("window.ussim.image?.patient === 'second.nii.gz'")
    settled(page)
    assert not errors(page)


@pytest.mark.long
def test_an_upload_shows_progress_can_be_cancelled_and_images_continue(page, files):
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


# ---- work that takes long --------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_exports_need_the_token(page, browser, url):
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
