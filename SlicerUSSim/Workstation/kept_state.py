"""KeptState: pose, settings and names of the patient's files in one small file, which a server started next offers."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.files import make_folder, read_json, written_whole
from SlicerUSSim.Logic.base.transforms import check_rigid
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mrml.parameter_node import preset_texts
from SlicerUSSim.Logic.mrml.scene_record import put_values, recorded_values
from SlicerUSSim.Workstation.browser_panel import BrowserPanel
from SlicerUSSim.Workstation.file_nodes import FILE
from SlicerUSSim.Workstation.opener import Opener
from SlicerUSSim.Workstation.patient import OpenPatient
from SlicerUSSim.Workstation.probe_control import ProbeControl
from SlicerUSSim.Workstation.tasks import AtMost

#: Seconds between two writes
_EVERY_S = 2.0


def state_file() -> Path:
    """The file of this user."""
    home = Path.home()
    if sys.platform == "win32":
        root = Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local") / "SlicerUSSim"
    elif sys.platform == "darwin":
        root = home / "Library" / "Application Support" / "SlicerUSSim"
    else:
        own = os.environ.get("XDG_STATE_HOME", "")
        root = (Path(own) if os.path.isabs(own) else home / ".local" / "state") / "slicerussim"
    return root / "workstation.json"


@dataclass(frozen=True)
class _State:
    """What is kept."""

    patient: str
    #: Of this computer: MRI or CT, labels
    files: list[str]
    #: (4, 4) probe_to_ras by rows; None without a probe
    pose: list[list[float]] | None
    #: {name: text} of the scene's values, see scene_record.recorded_values
    values: dict[str, str]
    #: Time at which it was written, local
    saved: str = field(default="", compare=False)

    @classmethod
    def of_file(cls, path: Path) -> _State | None:
        """What a file holds; None if there is none, or it cannot be read: it is offered, and not asked for."""
        try:
            found = cls(**read_json(path))
            datetime.fromisoformat(found.saved)
            Preset.from_texts(preset_texts(found.values), str(path))
            if found.pose is not None:
                check_rigid("the pose", found.pose)
            require(all(isinstance(text, str) for text in (found.patient, *found.files)), "no names")
            return found
        except (SimulationError, TypeError, ValueError, AttributeError):
            return None


class KeptState:
    """Writes the file at changes, and offers what was in it at the start. Methods but `changed` run in a task.

    While the offer stands nothing is written: what it holds stays until the user has restored or discarded it.

    Parameters
    ----------
    path : see state_file; None: nothing is kept.
    """

    def __init__(
        self, path: Path | None, panel: BrowserPanel, patient: OpenPatient, opener: Opener, probe: ProbeControl
    ) -> None:
        self._path, self._panel, self._logic = path, panel, panel.logic
        self._patient, self._opener, self._probe = patient, opener, probe
        self._offered = None if path is None else _State.of_file(path)
        self._written: _State | None = None
        #: Called when anything may have changed
        self.changed = AtMost(_EVERY_S, self._write)

    def offer(self) -> None:
        """Show the offer, unless there is none, or all is as it was."""
        kept, text = self._offered, ""
        if kept == self._state():
            self._offered = kept = None
        if kept is not None:
            saved = datetime.fromisoformat(kept.saved).astimezone()
            is_today = saved.date() == saved.now(saved.tzinfo).date()
            when = f"{saved:%H:%M}" if is_today else f"{saved:%d %B, %H:%M}"
            text = f"Continue with {kept.patient} as at {when} (pose and settings)?"
        with self._panel.shared.changing() as now:
            now.offer = text

    def restore(self) -> None:
        """Take the kept pose and settings, on the patient of that name, whose files are opened if he is not."""
        kept = self._offered
        if kept is None:
            return
        with self._panel.presenter.shown():
            is_there = self._patient.name == kept.patient
            require(
                is_there or (kept.files and all(map(os.path.exists, kept.files))),
                f"{kept.patient}: its files are no longer on the computer of the server, or were uploaded; "
                "open them or the saved scene (.mrb), and press Restore again",
            )
            parameters = self._logic.parameters
            before = recorded_values(parameters)
            refused = put_values(parameters, kept.values)
            if not is_there:
                self._opener.open_paths(kept.files)
            if self._patient.name != kept.patient:  # the user has opened none, or there was an error
                put_values(parameters, before)
                return
            for line in refused:
                self._panel.showError(line)
            if kept.pose is not None:
                self._probe.move(np.array(kept.pose))
            self._offered = None
            self.offer()
            self.changed()

    def discard(self) -> None:
        """Forget what is offered; the file holds the present state from now on."""
        self._offered = None
        self.offer()
        self.changed()

    def _state(self) -> _State:
        parameters: Any = self._logic.parameters
        nodes = (parameters.mri, parameters.labels)
        pose = None if parameters.labels is None else self._probe.pose()
        files = {file for node in nodes if node is not None and os.path.isabs(file := node.GetAttribute(FILE) or "")}
        return _State(
            self._patient.name, sorted(files), None if pose is None else pose.tolist(), recorded_values(parameters)
        )

    def _write(self) -> None:
        path = self._path
        if path is None or self._offered is not None:
            return
        state = self._state()
        if state != self._written:
            self._written = state
            self._panel.tasks.start(lambda: self._save(path, state))

    def _save(self, path: Path, state: _State) -> None:
        try:
            self._panel.tasks.doAside(lambda: _write(path, state))
        except (SimulationError, OSError) as error:
            self._path = None
            self._panel.showError(f"pose and settings are not kept: {error}")


def _write(path: Path, state: _State) -> None:
    """Write a state for this user alone; without a patient there is none."""
    if not state.patient:
        path.unlink(missing_ok=True)
        return
    folder = make_folder(path.parent)
    if os.name == "posix":
        folder.chmod(0o700)
    saved = datetime.now().astimezone().isoformat(timespec="seconds")
    with written_whole(path) as partial:
        partial.touch(0o600)
        partial.write_text(json.dumps(asdict(replace(state, saved=saved))), "utf-8")
