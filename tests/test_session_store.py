"""Where sessions are kept: for one user, few and small, and known to be of a server that has ended."""

from __future__ import annotations

import json
import os
import stat
import subprocess
import sys
import threading
import time
from datetime import datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("greenlet", reason="the workstation comes with: pip install '.[serve]'")
pytest.importorskip("trame_slicer", reason="the workstation comes with: pip install '.[serve]'")

from trame_server.state import State

from SlicerUSSim.Logic import SimulationError
from SlicerUSSim.Logic.base.reading import write_values
from SlicerUSSim.Logic.mri.samples import head_mri
from SlicerUSSim.Logic.mrml.nodes import write_volume
from SlicerUSSim.Workstation import session_store
from SlicerUSSim.Workstation.autosave import Autosave
from SlicerUSSim.Workstation.export import Cine
from SlicerUSSim.Workstation.session_store import OwnSession, SessionStore, sessions_folder
from SlicerUSSim.Workstation.state import SharedState

TOKEN = "t" * 32


def ended(store: SessionStore, patient: str = "head.nii.gz", token: tuple[int, str] | None = None) -> Path:
    """The folder of a session as a server leaves it that was killed."""
    own = store.begin()
    own.write("anatomy-1", lambda file: write_values(file, {"of": patient}))
    own.write_state(patient, {"anatomy": "anatomy-1"}, {})
    if token is not None:
        own.keep_address(*token)
    own._lock.close()  # as the system does it
    return own.folder


def test_the_folder_is_in_the_users_state_folder(monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_STATE_HOME", "/somewhere/state")
    assert sessions_folder() == Path("/somewhere/state/slicerussim/sessions")
    monkeypatch.setenv("XDG_STATE_HOME", "not/absolute")  # which the specification says to ignore
    assert sessions_folder() == Path.home() / ".local/state/slicerussim/sessions"


def test_what_was_written_is_read_by_the_user_alone(tmp_path):
    store = SessionStore(tmp_path / "own" / "sessions")
    before = os.umask(0)
    try:
        folder = ended(store, token=(8080, TOKEN))
    finally:
        os.umask(before)
    for path in (folder.parent.parent, folder.parent, folder):
        assert stat.S_IMODE(path.stat().st_mode) == 0o700
    assert {stat.S_IMODE(path.stat().st_mode) for path in folder.iterdir()} == {0o600}
    (session,) = store.ended()
    assert session.patient == "head.nii.gz" and session.read("anatomy") == {"of": "head.nii.gz"}
    assert session.read("fit") is None and abs(datetime.now().astimezone() - session.saved) < timedelta(minutes=1)
    session.remove()
    assert store.ended() == [] and not folder.exists()


def test_a_session_is_not_offered_while_its_server_runs(tmp_path):
    code = (
        "import sys, time; from pathlib import Path; from SlicerUSSim.Workstation.session_store import SessionStore; "
        "own = SessionStore(Path(sys.argv[1])).begin(); own.write_state('head', {}, {}); print('there', flush=True); "
        "time.sleep(600)"
    )
    server = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None and server.stdout.readline() == "there\n"
        assert SessionStore(tmp_path).ended() == []
    finally:
        server.kill()
        server.communicate()
    assert [session.patient for session in SessionStore(tmp_path).ended()] == ["head"]


def test_what_is_replaced_is_there_until_all_of_the_new_is(tmp_path):
    store = SessionStore(tmp_path)
    own = store.begin()
    own.write("anatomy-1", lambda file: write_values(file, 1))
    own.write_state("first", {"anatomy": "anatomy-1"}, {})
    own.write("anatomy-2", lambda file: write_values(file, 2))

    def half(file) -> None:
        file.write(b"half")
        raise OSError(28, "No space left on device")

    with pytest.raises(SimulationError, match="No space left"):
        own.write("cine-3", half)
    own._lock.close()
    (session,) = store.ended()
    assert session.patient == "first" and session.read("anatomy") == 1
    assert not (session.folder / "cine-3").exists()


def test_few_young_and_small_sessions_stay(tmp_path, monkeypatch):
    store = SessionStore(tmp_path)
    folders = []
    for number in range(session_store.MOST_SESSIONS + 2):
        folders.append(ended(store, f"patient {number}"))
        path = folders[-1] / "state.json"
        values = json.loads(path.read_text())
        values["saved"] = (datetime.now().astimezone() - timedelta(hours=10 - number)).isoformat()
        path.write_text(json.dumps(values))
    found = [session.patient for session in store.ended()]
    assert found == ["patient 4", "patient 3", "patient 2"]
    assert [folder.exists() for folder in folders] == [False, False, True, True, True]
    values = json.loads((folders[2] / "state.json").read_text())
    values["saved"] = (datetime.now().astimezone() - timedelta(days=8)).isoformat()
    (folders[2] / "state.json").write_text(json.dumps(values))
    assert [session.patient for session in store.ended()] == ["patient 4", "patient 3"]
    size = sum(path.stat().st_size for path in folders[4].iterdir())
    monkeypatch.setattr(session_store, "MOST_BYTES", size + 1)
    assert [session.patient for session in store.ended()] == ["patient 4"] and not folders[3].exists()


@pytest.mark.parametrize("text", ["", "{}", '{"format": 99}', "[1]", '{"format": 1, "files": {}, "patient": "x"}'])
def test_what_is_no_session_is_not_offered(tmp_path, text):
    folder = ended(SessionStore(tmp_path))
    (folder / "state.json").write_text(text)
    assert SessionStore(tmp_path).ended() == [] and not folder.exists()


def test_a_session_reads_no_file_outside_its_folder(tmp_path):
    folder = ended(SessionStore(tmp_path / "sessions"))
    (tmp_path / "sessions" / "other").write_bytes(b"x")
    values = json.loads((folder / "state.json").read_text())
    values["files"] = {"anatomy": "../other", "sent": {"a": "../other"}}
    (folder / "state.json").write_text(json.dumps(values))
    (session,) = SessionStore(tmp_path / "sessions").ended()
    with pytest.raises(SimulationError, match="expected a file of its folder"):
        session.read("anatomy")
    with pytest.raises(SimulationError, match="expected a file of its folder"):
        session.copies("sent", tmp_path)


def test_the_token_of_a_killed_server_is_taken_once_and_at_its_port_only(tmp_path):
    store = SessionStore(tmp_path)
    ended(store, token=(8080, TOKEN))
    assert store.token_of(8081) is None
    assert store.token_of(8080) == TOKEN and store.token_of(8080) is None
    folder = ended(store, token=(8080, TOKEN))
    old = time.time() - 25 * 3600
    os.utime(folder / "address.json", (old, old))
    assert store.token_of(8080) is None  # it is of yesterday
    own = store.begin()
    own.write_state("head", {}, {})
    own.keep_address(8080, TOKEN)
    own.end()  # as it should
    assert store.token_of(8080) is None and (own.folder / "state.json").exists()


# ---- autosave --------------------------------------------------------------------------------------------------------


class Kept(OwnSession):
    """A session on a disk that waits until it may write."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(exist_ok=True)
        super().__init__(folder)
        self.goes_on, self.begun = threading.Event(), threading.Event()

    def write(self, name: str, write) -> None:
        self.begun.set()
        assert self.goes_on.wait(60)
        super().write(name, write)


def autosave_of(session: OwnSession, told: list[str]):
    """(an Autosave of a scene with a head, its logic, its cine loop, what is to be called in the event loop)"""
    slicer = pytest.importorskip("slicer")
    from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic
    from SlicerUSSim.Widget.presenter import PanelPresenter
    from SlicerUSSim.Workstation.opener import Files, Opener
    from tests.test_presenter import PlainView

    scene = slicer.vtkMRMLScene()
    logic = UltrasoundSceneLogic(scene)
    node = scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "head.nii.gz")
    write_volume(node, head_mri(4.0))
    logic.parameters.mri = node
    shared, cine, calls = SharedState(State(ready=True)), Cine(), []
    with shared.changing() as now:
        now.keeps_session = True
    opener = Opener(scene, logic, None, Files())
    panel = SimpleNamespace(
        shared=shared, logic=logic, presenter=PanelPresenter(logic, PlainView()), showError=told.append,
        tasks=SimpleNamespace(tell=calls.append),
    )  # fmt: skip
    autosave = Autosave(session, panel, opener, cine, lambda: None, tuple)
    return autosave, logic, cine, calls, shared


def written(autosave: Autosave, calls: list) -> None:
    thread = autosave._writing
    if thread is not None:
        thread.join(60)
    while calls:
        calls.pop(0)()
    assert autosave.is_done


def test_nothing_waits_for_the_disk(tmp_path):
    session, told = Kept(tmp_path / "own"), []
    autosave, logic, cine, calls, _ = autosave_of(session, told)
    autosave.look()  # comes back although nothing is written yet
    assert session.begun.wait(60) and not autosave.is_done
    cine.add(np.zeros((8, 8), np.uint8), 0.0)
    autosave.look()  # and again, while the first is still being written
    session.goes_on.set()
    written(autosave, calls)
    first = json.loads((session.folder / "state.json").read_text())
    assert first["patient"] == "head.nii.gz" and first["files"]["cine"] == []
    autosave.look()
    written(autosave, calls)
    second = json.loads((session.folder / "state.json").read_text())
    assert len(second["files"]["cine"]) == 1 and second["files"]["anatomy"] == first["files"]["anatomy"]
    when = (session.folder / "state.json").stat().st_mtime_ns
    autosave.look()
    written(autosave, calls)
    assert (session.folder / "state.json").stat().st_mtime_ns == when and not told  # nothing has changed
    assert logic.parameters.mri is not None


def test_a_patient_without_room_is_not_kept_which_is_said_once(tmp_path, monkeypatch):
    session, told = Kept(tmp_path / "own"), []
    session.goes_on.set()
    autosave, logic, _, calls, _ = autosave_of(session, told)
    monkeypatch.setattr(session_store, "MOST_SESSION_BYTES", 1000)
    for gain in (1, 2):
        logic.preset = logic.preset.changed("display", gain_db=gain)
        autosave.look()
        written(autosave, calls)
    assert len(told) == 1 and told[0].startswith(
        "this session is not kept: head.nii.gz has 0.0 GB, expected at most 0.0"
    )
    assert {path.name for path in session.folder.iterdir()} == {"lock"} and not autosave.has_kept


def test_what_waits_for_the_session_to_be_kept_is_done_after_that(tmp_path):
    session, told, done = Kept(tmp_path / "own"), [], []
    autosave, _, _, calls, shared = autosave_of(session, told)
    autosave.when_kept(lambda: done.append((session.folder / "state.json").exists()))
    autosave.look()
    assert session.begun.wait(60) and done == []
    session.goes_on.set()
    written(autosave, calls)
    assert done == [True]
    with shared.changing() as now:
        now.keeps_session = False
    autosave.look()
    written(autosave, calls)
    assert {path.name for path in session.folder.iterdir()} == {"lock"}


def test_a_cine_loop_is_kept_from_its_last_images_on(tmp_path):
    session, told = Kept(tmp_path / "own"), []
    session.goes_on.set()
    autosave, _, cine, calls, _ = autosave_of(session, told)
    for number in range(250):
        cine.add(np.full((8, 8), number, np.uint8), float(number))
        if number % 20 == 19:
            autosave.look()
            written(autosave, calls)
    files = json.loads((session.folder / "state.json").read_text())["files"]["cine"]
    assert 10 <= len(files) <= 11 and len(list(session.folder.glob("cine-*"))) == len(files)
    cine.clear()
    cine.add(np.zeros((9, 9), np.uint8), 0.0)
    autosave.look()
    written(autosave, calls)
    assert len(list(session.folder.glob("cine-*"))) == 1


def test_files_of_one_name_of_two_patients_are_not_taken_for_one_another(tmp_path):
    session, told = Kept(tmp_path / "own"), []
    session.goes_on.set()
    autosave, logic, _, calls, _ = autosave_of(session, told)
    sent = autosave._opener.sent_files
    for content in (b"first", b"second"):
        (tmp_path / "head.nii.gz").write_bytes(content)
        sent.forget()
        sent.keep("head.nii.gz", tmp_path / "head.nii.gz")
        logic.preset = logic.preset.changed("display", gain_db=float(len(content)))
        autosave.look()
        written(autosave, calls)
        files = json.loads((session.folder / "state.json").read_text())["files"]["sent"]
        assert {name: (session.folder / file).read_bytes() for name, file in files.items()} == {"head.nii.gz": content}
        assert len(list(session.folder.glob("sent-*"))) == 1
    assert not told
