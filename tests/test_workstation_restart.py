"""A server that is started again offers the last pose and settings; what the page made is saved as a scene."""

from __future__ import annotations

import json
import shutil
import stat
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("trame_slicer", reason="the workstation comes with: pip install '.[serve]'")
pytest.importorskip("playwright", reason="browser tests need playwright: pip install '.[test]'")

from SlicerUSSim.Workstation import kept_state
from SlicerUSSim.Workstation.state import NAMES
from tests.served import Served
from tests.test_workstation import (
    answer_new_patient,
    browser as browser,
    click,
    download,
    errors,
    eventually,
    open_new_patient,
    opened,
    pytestmark as pytestmark,
    settled,
    shown,
    state,
)


@pytest.fixture
def start(tmp_path):
    """A function that starts a server, which keeps its state in a folder of the test; and that file."""
    made: list[Served] = []

    def served(*arguments: object) -> Served:
        made.append(Served("--port", "0", *arguments, state=tmp_path / "state"))
        return made[-1]

    yield served, tmp_path / "state" / "slicerussim" / "workstation.json"
    for one in made:
        one.end()


def kept(page, file: Path) -> dict:
    """What the file holds, once it is the state that the page shows."""
    pose = np.array(state(page, NAMES.pose_matrix).split(), float).reshape(4, 4)

    def is_there() -> bool:
        if not file.exists():
            return False
        found = json.loads(file.read_text())
        return found["patient"] == state(page, NAMES.title) and np.allclose(found["pose"], pose, atol=1e-3)

    eventually(page, is_there)
    return json.loads(file.read_text())


@pytest.mark.slow
def test_pose_and_settings_are_offered_after_a_crash_and_restored(start, browser, files):
    served, file = start
    server = served(files / "head.nii.gz")
    page = opened(browser, server.url)
    assert page.locator("#offer").count() == 0
    page.evaluate("window.trame.trigger('set', ['gainSlider', 7])")
    page.evaluate("window.trame.trigger('set_tissue', ['white matter', 'mu0', '0.41'])")
    for _ in range(3):
        page.keyboard.press("Shift+a")
    settled(page)
    pose = state(page, NAMES.pose_matrix)
    found = kept(page, file)
    assert found["files"] == [str(files / "head.nii.gz")] and "token" not in json.dumps(found)
    for path, mode in ((file, 0o600), (file.parent, 0o700)):
        assert stat.S_IMODE(path.stat().st_mode) == mode
    server.kill()
    page.locator("#connection-lost").wait_for()
    page.close()
    # Another patient is open: the last one is opened from his file, and nothing is restored unasked
    page = opened(browser, served("--labels", files / "labels.nii.gz").url)
    page.locator("#offer").wait_for()
    text = page.locator("#offer-text").inner_text()
    assert text.startswith("Continue with head.nii.gz as at ") and shown(page, "gainSlider") != 7
    assert json.loads(file.read_text()) == found  # until the offer is answered
    click(page, "#restore")
    answer_new_patient(page)
    page.locator("#offer").wait_for(state="detached")
    settled(page)
    assert not errors(page) and state(page, NAMES.title) == "head.nii.gz" and shown(page, "gainSlider") == 7
    np.testing.assert_allclose(*(np.array(text.split(), float) for text in (state(page, NAMES.pose_matrix), pose)),
                               atol=1e-3)  # fmt: skip
    assert any(row["name"] == "white matter" and "0.41" in row["values"] for row in state(page, NAMES.panel.tissues))
    page.evaluate("window.trame.trigger('close_patient')")
    eventually(page, lambda: not file.exists())
    page.close()


@pytest.mark.slow
def test_an_uploaded_patient_continues_with_his_saved_scene(start, browser, files, tmp_path):
    served, file = start
    server = served("--labels", files / "labels.nii.gz")
    page = opened(browser, server.url)
    settled(page)
    shutil.copy(files / "head.nii.gz", tmp_path / "sent.nii.gz")
    open_new_patient(page, tmp_path / "sent.nii.gz")
    page.evaluate("window.trame.trigger('set', ['gainSlider', 5])")
    page.keyboard.press("Shift+d")
    settled(page)
    pose = state(page, NAMES.pose_matrix)
    shutil.copy(download(page, "mrb"), tmp_path / "saved.mrb")
    assert kept(page, file)["files"] == []
    server.kill()
    page.close()
    page = opened(browser, served("--labels", files / "labels.nii.gz").url)
    click(page, "#restore")
    eventually(page, lambda: bool(errors(page)))
    assert errors(page)[0].startswith("sent.nii.gz: its files are no longer on the computer of the server")
    assert page.locator("#offer").is_visible() and state(page, NAMES.title) == "labels.nii.gz"
    page.set_input_files("#open-file", tmp_path / "saved.mrb")
    answer_new_patient(page, "The patient of the scene")
    page.wait_for_function("window.ussim.image?.patient === 'sent.nii.gz'")
    click(page, "#restore")
    page.locator("#offer").wait_for(state="detached")
    settled(page)
    np.testing.assert_allclose(*(np.array(text.split(), float) for text in (state(page, NAMES.pose_matrix), pose)),
                               atol=1e-3)  # fmt: skip
    assert shown(page, "gainSlider") == 5
    page.close()


@pytest.mark.parametrize(
    "text",
    ["", "[1]", '{"patient": "x"}', '{"saved": "2026-01-01", "patient": "x", "files": [], "pose": [1], "values": {}}'],
)
def test_what_is_damaged_is_not_offered(tmp_path, text):
    (tmp_path / "state.json").write_text(text)
    assert kept_state._State.of_file(tmp_path / "state.json") is None


def test_the_file_is_in_the_state_folder_of_the_user(monkeypatch):
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("XDG_STATE_HOME", "/some/where")
    assert kept_state.state_file() == Path("/some/where/slicerussim/workstation.json")
