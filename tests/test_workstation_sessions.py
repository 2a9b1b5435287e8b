"""Nothing is lost when the server is killed: sessions are kept, offered and restored, and the page comes back."""

from __future__ import annotations

import json
import shutil
import socket
import stat
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("trame_slicer", reason="the workstation comes with: pip install '.[serve]'")
pytest.importorskip("playwright", reason="browser tests need playwright: pip install '.[test]'")

from SlicerUSSim.Logic.base.volume import Volume, read_image_file
from SlicerUSSim.Workstation.state import NAMES, value_of
from tests.served import Served, run_script
from tests.test_workstation import (
    answer_new_patient,
    browser as browser,
    click,
    download,
    errors,
    eventually,
    loaded,
    new_image,
    open_new_patient,
    opened,
    pixels,
    pose,
    pytestmark as pytestmark,
    settled,
    shown,
    state,
)
from tests.test_workstation_opening import dicom as dicom
from tests.test_workstation_registration import add as add_landmark, recording as recording


class Server:
    """`ussim serve` at one port, which can be killed and started again."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        self.sessions = folder / "slicerussim" / "sessions"
        self._folder, self._arguments = folder, arguments
        self.start()

    def start(self, *other: str) -> None:
        self._process = Served("--port", self.port, *(other or self._arguments), state=self._folder)
        self.url = self._process.url

    def kill(self) -> None:
        self._process.kill()

    def end(self) -> None:
        self._process.end()


@pytest.fixture
def server(tmp_path, files):
    made: list[Server] = []

    def start(*arguments: str) -> Server:
        made.append(Server(tmp_path / "state", *arguments))
        return made[-1]

    yield start
    for one in made:
        one.end()


def kept(page) -> None:
    """Wait until the present state is on the disk."""
    assert page.evaluate("window.trame.trigger('session_kept')")


def reloaded(page) -> None:
    """Wait until the page has loaded itself again after its server was killed, and shows an image."""
    page.wait_for_function("window.ussim && !window.before && window.ussim.images > 0")
    loaded(page)
    settled(page)


def values(page) -> dict[str, object]:
    """{name: value} of all controls of the panel but the selectors of nodes."""
    state = page.evaluate("window.trame.state.state")
    return {name: value for name, value in state.items() if name.startswith(value_of("")) and "Selector" not in name}


def restore(page) -> None:
    """Take the session that is offered, and wait until the page shows it."""
    click(page, "#restore-session")
    page.locator("#session-offer").wait_for(state="detached")
    settled(page)


def killed_and_started(server: Server, page, *other: str) -> None:
    page.evaluate("window.before = true")
    server.kill()
    page.locator("#connection-lost").wait_for()
    server.start(*other)


def crashed_and_restored(server: Server, page) -> None:
    """Kill the server once the present state is on the disk, start it again and take the session."""
    kept(page)
    killed_and_started(server, page)
    reloaded(page)
    restore(page)


@pytest.mark.long
def test_after_kill_9_the_page_reconnects_by_itself_and_restores_all(server, browser, files, tmp_path):
    own = server(str(files / "head.nii.gz"), "--sequence", str(files / "sweep.igs.mha"))
    problems: list[str] = []
    page = opened(browser, own.url, problems)
    settled(page)
    assert page.locator("#session-offer").count() == 0
    # Images at all poses
    page.evaluate("window.trame.trigger('press', ['simulateSequenceButton'])")
    page.locator("#simulated-player").wait_for()
    settled(page)
    page.evaluate("window.trame.trigger('show_simulated', [3])")
    settled(page)
    simulated = page.evaluate("window.ussim.image"), pixels(page)
    click(page, "#live")
    settled(page)
    # A fit, applied; a tissue, a setting, a view; then the pose, away from the images
    page.evaluate("window.trame.trigger('set', ['fitEvaluationsSpinBox', 20])")
    page.evaluate("window.trame.trigger('press', ['fitButton'])")
    eventually(page, lambda: "cost" in shown(page, "fitLabel"))
    settled(page)
    page.evaluate("window.trame.trigger('press', ['applyFitButton'])")
    page.evaluate("window.trame.trigger('set_tissue', ['white matter', 'mu0', '0.41'])")
    page.evaluate("window.trame.trigger('set', ['classesSpinBox', 4])")
    page.evaluate("window.trame.trigger('plane', ['Green', 'Sagittal'])")
    page.evaluate("window.trame.trigger('show_number', [2])")
    for _ in range(3):
        with new_image(page):
            page.keyboard.press("a")
    settled(page)
    was = {
        "pose": page.evaluate("window.ussim.image.pose"), "sliders": pose(page), "pixels": pixels(page),
        "values": values(page),
        "tissues": state(page, NAMES.panel.tissues), "curve": state(page, NAMES.fit.curve),
    }  # fmt: skip
    assert any(row["name"] == "white matter" and "0.41" in row["values"] for row in was["tissues"])
    cine = page.evaluate("window.ussim.images")
    kept(page)

    assert not problems
    killed_and_started(own, page)
    reloaded(page)
    problems.clear()  # what it had asked when the server was killed had no answer
    offer = page.locator("#session-offer-text")
    offer.wait_for()
    assert offer.inner_text().startswith("Restore the session of ") and "(head.nii.gz)?" in offer.inner_text()
    assert pose(page) != was["sliders"]  # nothing is restored unasked
    restore(page)
    assert not errors(page)
    np.testing.assert_allclose(page.evaluate("window.ussim.image.pose"), was["pose"], atol=1e-3)
    assert np.array_equal(pixels(page), was["pixels"])
    now = values(page)
    assert {name: (now[name], value) for name, value in was["values"].items() if now[name] != value} == {}
    assert now[value_of("fitEvaluationsSpinBox")] == 20
    assert state(page, NAMES.panel.tissues) == was["tissues"] and state(page, NAMES.fit.curve) == was["curve"]
    assert state(page, NAMES.views.planes)["Green"] == "Sagittal" and state(page, NAMES.sequence.number) == 2
    assert state(page, NAMES.panel.can)["revertFitButton"] and cine > 3
    # The cine loop has the images from before
    gif = download(page, "gif").read_bytes()
    assert gif.count(b"\x21\xf9\x04") > 3
    # and it is kept again; the old one is gone only then
    kept(page)
    eventually(page, lambda: len([path for path in own.sessions.iterdir() if (path / "state.json").exists()]) == 1)
    page.evaluate("window.trame.trigger('press', ['revertFitButton'])")
    settled(page)
    page.evaluate("window.trame.trigger('show_simulated', [3])")
    settled(page)
    again = page.evaluate("window.ussim.image")
    told = ("time", "pose", "patient", "sequence", "ruler")
    assert {name: again[name] for name in told} == {name: simulated[0][name] for name in told}
    assert np.array_equal(pixels(page), simulated[1])
    # The last Segment was of the program that is gone, which the button says
    assert state(page, NAMES.panel.can)["undoSegmentButton"] is False
    assert not errors(page) and not problems
    # An image of the sequence is the same one again, in the player too, and the script makes it
    image = np.asarray(Image.open(download(page, "png")))
    crashed_and_restored(own, page)
    again = page.evaluate("window.ussim.image")
    assert {name: again[name] for name in told} == {name: simulated[0][name] for name in told} and again[
        "sequence"
    ] == 4
    assert page.locator("#simulated-text").inner_text() == "Simulated 4 of 6" and page.locator("#frozen").is_visible()
    assert np.array_equal(bundled(page, tmp_path / "script"), image)
    page.evaluate("window.trame.trigger('show_simulated', [0])")
    settled(page)
    page.evaluate("window.trame.trigger('show_simulated', [3])")
    settled(page)
    assert np.array_equal(pixels(page), simulated[1]) and not errors(page)
    assert np.array_equal(bundled(page, tmp_path / "from the sequence"), image)
    page.close()


@pytest.mark.long
def test_a_frozen_image_comes_back_frozen_where_it_was_taken(server, browser, files, tmp_path):
    """A live image at the probe's pose was shown in its place, and then it had no script."""
    own = server("--labels", str(files / "labels.nii.gz"))
    page = opened(browser, own.url)
    settled(page)
    click(page, "#live")
    page.locator("#frozen").wait_for()
    settled(page)
    image, about = pixels(page), page.evaluate("window.ussim.image")
    for _ in range(3):
        page.keyboard.press("d")
        settled(page)
    moved = state(page, NAMES.pose_matrix)
    crashed_and_restored(own, page)
    assert not errors(page) and page.locator("#frozen").is_visible() and not shown(page, "liveCheckBox")
    again = page.evaluate("window.ussim.image")
    assert np.array_equal(pixels(page), image) and again["time"] == about["time"]
    np.testing.assert_allclose(again["pose"], about["pose"], atol=1e-3)
    now = state(page, NAMES.pose_matrix)
    np.testing.assert_allclose(*(np.array(text.split(), float) for text in (now, moved)), atol=1e-3)
    assert np.array_equal(bundled(page, tmp_path / "script"), np.asarray(Image.open(download(page, "png"))))
    # Going on from there: nothing of it is kept once images are live again
    click(page, "#live")
    page.locator("#frozen").wait_for(state="hidden")
    settled(page)
    kept(page)
    eventually(page, lambda: not [path for path in own.sessions.glob("*/frozen-*")])
    page.close()


@pytest.mark.slow
def test_the_folder_is_for_the_user_alone_and_holds_this_patient_only(server, browser, files, tmp_path):
    shutil.copy(files / "labels.nii.gz", tmp_path / "other.nii.gz")
    own = server("--labels", str(files / "labels.nii.gz"))
    page = opened(browser, own.url)
    settled(page)
    kept(page)
    (session,) = own.sessions.iterdir()
    for path in (own.sessions.parent, own.sessions, session):
        assert stat.S_IMODE(path.stat().st_mode) == 0o700, path
    parts = {path.name.split("-")[0] for path in session.iterdir()}
    assert parts == {"lock", "address.json", "state.json", "anatomy", "cine"}
    assert all(stat.S_IMODE(path.stat().st_mode) == 0o600 for path in session.iterdir())
    first = [path.name for path in session.glob("anatomy-*")]
    open_new_patient(page, tmp_path / "other.nii.gz")
    kept(page)
    assert json.loads((session / "state.json").read_text())["patient"] == "other.nii.gz"
    assert len(list(session.glob("anatomy-*"))) == 1 and not (session / first[0]).exists()
    # A patient that is closed is not on the disk either, and neither is one who is not to be kept
    click(page, "#close-patient")
    settled(page)
    page.evaluate("window.trame.trigger('session_kept')")
    assert {path.name for path in session.iterdir()} == {"lock", "address.json"}
    page.set_input_files("#open-file", tmp_path / "other.nii.gz")
    page.wait_for_function("window.ussim.image?.patient === 'other.nii.gz'")
    settled(page)
    kept(page)
    page.locator("#keeps-session").uncheck()
    settled(page)
    page.evaluate("window.trame.trigger('session_kept')")
    assert {path.name for path in session.iterdir()} == {"lock", "address.json"}
    page.close()
    own.end()
    assert not session.exists()  # nothing is left of one without a patient


@pytest.mark.slow
def test_a_session_is_never_put_onto_another_patient(server, browser, files, tmp_path):
    own = server(str(files / "head.nii.gz"))
    page = opened(browser, own.url)
    for _ in range(3):
        page.keyboard.press("Shift+a")
    settled(page)
    kept(page)
    killed_and_started(own, page, "--labels", str(files / "labels.nii.gz"))
    reloaded(page)
    page.locator("#session-offer").wait_for()
    assert state(page, NAMES.title) == "labels.nii.gz"
    assert abs(pose(page)["rock_deg"]) < 10  # placed anew on this one
    assert "(head.nii.gz)?" in page.locator("#session-offer-text").inner_text()
    click(page, "#restore-session")
    page.wait_for_function("window.ussim.image?.patient === 'head.nii.gz'")
    settled(page)
    assert state(page, NAMES.title) == "head.nii.gz" and pose(page)["rock_deg"] > 10
    assert not any("labels" in item["title"] for item in state(page, NAMES.panel.nodes)["labelsSelector"])
    page.close()


@pytest.mark.long
def test_what_is_discarded_or_damaged_changes_nothing(server, browser, files):
    own = server("--labels", str(files / "labels.nii.gz"))
    page = opened(browser, own.url)
    settled(page)
    kept(page)
    (session,) = own.sessions.iterdir()
    (anatomy,) = session.glob("anatomy-*")
    killed_and_started(own, page)
    anatomy.write_bytes(anatomy.read_bytes()[:1000])
    reloaded(page)
    before = pixels(page)
    click(page, "#restore-session")
    page.locator(".ussim-error").first.wait_for()
    text = errors(page)[0]
    assert "is damaged, or of another version" in text and "\n" not in text
    settled(page)
    assert np.array_equal(pixels(page), before) and page.locator("#session-offer").count() == 1
    click(page, "#discard-session")
    page.locator("#session-offer").wait_for(state="detached")
    settled(page)
    assert not session.exists()
    page.close()


@pytest.mark.long
def test_a_new_server_with_another_token_is_said_and_not_trusted(server, browser, files):
    """After an end as it should be the token is a new one; the cookie is sent to no server that cannot prove itself."""
    own = server("--labels", str(files / "labels.nii.gz"))
    page = opened(browser, own.url)
    settled(page)
    before = own.url
    page.evaluate("window.before = true")
    own.end()
    page.locator("#connection-lost").wait_for()
    own.start()
    assert own.url != before
    page.wait_for_function("document.getElementById('connection-lost').textContent.includes('Open the address')")
    assert page.evaluate("window.before")
    page.goto(own.url)
    page.locator("#session-offer").wait_for()  # what was kept is offered nevertheless
    page.close()


@pytest.mark.long
def test_without_autosave_nothing_is_on_the_disk(server, browser, files, tmp_path):
    own = server("--labels", str(files / "labels.nii.gz"), "--no-autosave")
    page = opened(browser, own.url)
    settled(page)
    assert not page.evaluate("window.trame.trigger('session_kept')") and not own.sessions.exists()
    assert page.locator("#keeps-session").is_disabled()
    page.close()


def bundled(page, folder: Path) -> np.ndarray:
    """The image of the exported script, run beside nothing but what was exported with it."""
    folder.mkdir()
    with zipfile.ZipFile(download(page, "zip")) as archive:
        archive.extractall(folder)
    run_script(folder / "image.py")
    return read_image_file(folder / "image.nrrd").array[0]


@pytest.mark.long
def test_scripts_of_uploads_run_also_of_files_with_one_name(server, browser, files, tmp_path):
    """They read files that nobody had any more."""
    own = server("--labels", str(files / "labels.nii.gz"))
    page = opened(browser, own.url)
    settled(page)
    open_new_patient(page, files / "head.nii.gz")
    mri = Volume.read(files / "head.nii.gz")
    middle = np.array(mri.array.shape) // 2
    for number, tissue in enumerate(("tumour", "cyst")):
        mask = np.zeros(mri.array.shape, np.uint8)
        mask[tuple(slice(m - 4, m + 4) for m in middle + [8, 8 - 16 * number, 8])] = 1
        folder = tmp_path / tissue
        folder.mkdir()
        mri.with_array(mask).write(folder / "mask.nii.gz")
        page.select_option("#added-as", tissue)
        with new_image(page):
            page.set_input_files("#add-file", folder / "mask.nii.gz")
        settled(page)
    assert not errors(page)
    image = np.asarray(Image.open(download(page, "png")))
    assert np.array_equal(bundled(page, tmp_path / "script"), image)
    found = sorted(path.name for path in (tmp_path / "script").iterdir())
    assert found == ["head.nii.gz", "image.nrrd", "image.py", "mask (2).nii.gz", "mask.nii.gz"]
    click(page, "#export")
    click(page, "#export-python")
    with page.expect_download() as waiting:
        click(page, "#save-script")
    assert waiting.value.suggested_filename == "ultrasound.zip"
    page.get_by_role("button", name="Close", exact=True).click()
    page.close()


@pytest.mark.long
def test_a_dicom_series_and_calibrated_ultrasound_survive_a_crash(server, browser, files, dicom, recording, tmp_path):
    own = server("--labels", str(files / "labels.nii.gz"))
    page = opened(browser, own.url)
    settled(page)
    page.set_input_files("#open-file", sorted((dicom / "IMAGES" / "A").iterdir()))
    answer_new_patient(page)
    page.wait_for_function("window.ussim.image?.patient.startsWith('T1 MPRAGE')")
    settled(page)
    page.set_input_files("#open-file", recording["folder"] / "phantom.igs.mha")
    settled(page)
    for name, file in (("calibration", "plus.xml"), ("registration", "registration.txt")):
        page.set_input_files(f"#{name}-file", recording["folder"] / file)
        settled(page)
    for number, pixel in ((0, (200.0, 150.0)), (0, (420.0, 160.0)), (3, (300.0, 400.0)), (5, (310.0, 155.0))):
        add_landmark(page, recording, number, pixel)
    click(page, "#fit-landmarks")
    settled(page)
    landmarks = state(page, NAMES.registration.landmarks)
    assert [mark["remaining"] for mark in landmarks] == ["0.00 mm"] * 4
    image = np.asarray(Image.open(download(page, "png")))
    assert np.array_equal(bundled(page, tmp_path / "script"), image)
    assert not errors(page)
    kept(page)
    killed_and_started(own, page)
    reloaded(page)
    click(page, "#restore-session")
    page.wait_for_function("window.ussim.image?.patient.startsWith('T1 MPRAGE')")
    settled(page)
    assert not errors(page) and np.array_equal(np.asarray(Image.open(download(page, "png"))), image)
    assert np.array_equal(bundled(page, tmp_path / "again"), image)
    assert state(page, NAMES.registration.recording).startswith("phantom: 6 images")
    assert page.locator("#registration-from").inner_text() == "Registration as it was kept"
    assert state(page, NAMES.registration.landmarks) == landmarks  # with what is left of each
    page.evaluate("window.trame.trigger('show_number', [0])")
    settled(page)
    np.testing.assert_allclose(page.evaluate("window.ussim.image.pose"), recording["poses"][0], atol=0.5)
    page.close()
