"""Registration: calibration of tracked ultrasound and its place in the patient, from files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require, required
from SlicerUSSim.Logic.base.transforms import check_rigid
from SlicerUSSim.Logic.mrml.scene_record import SequenceRecord
from SlicerUSSim.Logic.mrml.sequence_nodes import MADE_FROM, POSES
from SlicerUSSim.Logic.tracked.imaged_field import ImagedField
from SlicerUSSim.Logic.tracked.pose_files import read_calibration, read_registration
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence, asked_ends
from SlicerUSSim.Workstation.browser_panel import BrowserPanel
from SlicerUSSim.Workstation.comparison import Comparison
from SlicerUSSim.Workstation.file_nodes import FileNodes

#: Title of its section on the page
SECTION = "Tracked ultrasound"
_IMAGE, _REFERENCE = "Image", "Reference"
_CALIBRATION, _REGISTRATION = "Calibration", "Registration"
_NOT_REGISTERED = "none: the frame of the ultrasound is assumed to be the patient's"


class Registration:
    """The tracked ultrasound of the page. Methods that change it run in a task."""

    def __init__(self, panel: BrowserPanel, file_nodes: FileNodes, comparison: Comparison) -> None:
        self._shared, self._logic, self._tasks = panel.shared, panel.logic, panel.tasks
        self._presenter, self._file_nodes, self._comparison = panel.presenter, file_nodes, comparison
        self.recording: SequenceRecord | None = None
        #: Of the recording, or of the next one if there is none
        self._calibration: dict[str, np.ndarray] = {}
        self._to_ras = np.eye(4)
        self._from = {_CALIBRATION: "", _REGISTRATION: ""}
        #: The nodes of the recording in the scene
        self.nodes: list[Any] = []
        self._field: ImagedField | None = None  # of the images, once they are prepared

    # ---- recording ---------------------------------------------------------------------------------------------

    def read(self, path: str) -> SequenceRecord:
        """The recording of a file. Raises SimulationError if it cannot be read."""
        with self._presenter.view.progress(f"Open {Path(path).name}"):
            sequence = self._tasks.doAside(lambda: TrackedSequence.read(path))
        require(sequence.has_images, f"{Path(path).name}: has poses without images, expected tracked images")
        return SequenceRecord(sequence, Path(path).name.split(".")[0])

    @property
    def doubt(self) -> str:
        """What is assumed or not known of the recording's place, or ""."""
        if self.recording is not None and self._logic.parameters.real is None:
            return "The real ultrasound is not calibrated: its place in the patient is not known"
        is_assumed = self.recording is not None and not self._from[_REGISTRATION]
        return "The real ultrasound is not registered: its frame is assumed to be the patient's" if is_assumed else ""

    def take(self, recording: SequenceRecord) -> None:
        """Use a recording from now on, in its place in the patient, if it is known.

        Its probe and poses are used once its calibration is known. Nothing changes if it cannot be used.
        """
        calibration, place, sources = self._calibration, self._to_ras, dict(self._from)
        if self.recording is not None:  # they belong to that one
            calibration, place, sources = {}, np.eye(4), {_CALIBRATION: "", _REGISTRATION: ""}
        if recording.to_ras is not None and not np.allclose(recording.to_ras, np.eye(4)):
            place, sources[_REGISTRATION] = recording.to_ras, "as it was given or saved"
        self._apply(recording, calibration, place)
        self._from = sources
        self._tell()

    def forget(self) -> None:
        """Forget the recording, which belongs to another patient; its nodes are removed with him."""
        self.recording, self._calibration, self._to_ras = None, {}, np.eye(4)
        self.nodes, self._field = [], None
        self._from = {_CALIBRATION: "", _REGISTRATION: ""}
        self._tell()

    def choose_frame(self, frame: str) -> None:
        """Take another frame of the recording for that which is fixed to the patient."""
        with self._presenter.shown():
            recording = required(self.recording, "no tracked ultrasound is open, expected a file with it first")
            self._apply(replace(recording, path=f"{_IMAGE}To{frame}"), self._calibration, self._to_ras)
            self._tell()

    # ---- calibration and registration --------------------------------------------------------------------------

    def calibrate(self, path: str) -> None:
        """Use the calibration of a file: of the name that is chosen, or those of a Plus configuration.

        It belongs to the open ultrasound, or else to the next one that is opened.
        """
        name = self._shared.now.registration.name.strip()
        asked_ends(name, ())
        found = self._tasks.doAside(lambda: read_calibration(path, name))
        source = "; ".join(filter(None, (self._from[_CALIBRATION], f"{', '.join(found)} of {Path(path).name}")))
        self._use({**self._calibration, **found}, self._to_ras, _CALIBRATION, source)

    def register(self, path: str) -> None:
        """Use the registration of a file: a transform, or landmarks in MRI and ultrasound (.tag), as calibrate."""
        matrix, line = self._tasks.doAside(lambda: read_registration(path))
        source = f"{Path(path).name}{f': {line}' if line else ''}"
        self._use(self._calibration, check_rigid(_REGISTRATION, matrix), _REGISTRATION, source)

    # ---- implementation ----------------------------------------------------------------------------------------

    def _use(self, calibration: dict[str, np.ndarray], to_ras: np.ndarray, what: str, source: str) -> None:
        """Use these for the recording, or for the next one if there is none; one of them is new, from `source`."""
        if self.recording is not None:
            self._apply(self.recording, calibration, to_ras)
        self._calibration, self._to_ras, self._from[what] = calibration, to_ras, source
        self._tell()

    def _apply(self, recording: SequenceRecord, calibration: dict[str, np.ndarray], to_ras: np.ndarray) -> None:
        """Use these, or raise SimulationError and change nothing."""
        sequence = recording.sequence.with_transforms(calibration) if calibration else recording.sequence
        before, made = self.recording or recording, None
        is_same = before.sequence is recording.sequence
        # Another place in the patient does not change the field of the images
        is_field_same = is_same and before.path == recording.path and calibration is self._calibration
        field = self._field if self.recording is not None and is_field_same else recording.field
        record = replace(recording, sequence=sequence, to_ras=to_ras, field=field)
        if record.is_calibrated:
            with self._presenter.view.progress("Find the probe's field"):
                made = self._file_nodes.sequence(record)
        number = self._shared.now.sequence.number if is_same else 0
        old, self.nodes = self.nodes, [] if made is None else made[3]
        self.recording = replace(recording, tracked=None, field=None)  # which another calibration changes
        self._calibration, self._to_ras = calibration, to_ras
        if made is None:
            self._comparison.drop()
            self._comparison.take(sequence.images, number=number)
            self._logic.parameters.real = self._field = None
        else:
            tracked, browser, images, _ = made
            self._field = tracked.field
            if field is None:  # else a user may have changed it since
                self._logic.preset = replace(self._logic.preset, probe=tracked.probe)
            self._logic.parameters.real = images
            self._comparison.take(tracked, browser, number)
            self._choose_poses(browser, old)
        for node in old:
            if node.GetScene() is not None:
                node.GetScene().RemoveNode(node)
        if made is not None and self._logic.scene.GetFirstNodeByName(recording.name) is None:
            made[2].SetName(recording.name)  # the name of its previous nodes, which scenes restore

    def _choose_poses(self, browser: Any, old: list[Any]) -> None:
        """Let Simulate sequence use the poses of the images, instead of previous ones, or of none."""
        parameters: Any = self._logic.parameters
        if parameters.transform_sequence is None or parameters.transform_sequence in old:
            parameters.transform_sequence = browser.GetNodeReference(POSES)
        images = parameters.image_sequence
        if images is not None and images.GetNodeReference(MADE_FROM) in old:  # which are at other poses
            parameters.image_sequence = None

    def _tell(self) -> None:
        """Show what is used."""
        recording = self.recording
        with self._shared.changing() as now:
            about = now.registration
            about.recording = "" if recording is None else f"{recording.name}: {recording.what}"
            frames = [] if recording is None else recording.sequence.frames_of_reference()
            about.frames = [frame for frame in frames if frame != _IMAGE]
            about.frame = "" if recording is None else recording.path.removeprefix(f"{_IMAGE}To")
            if recording is not None and about.frame not in about.frames:
                about.frames = [about.frame, *about.frames]
            about.calibration = self._calibration_line(recording)
            about.registration = self._from[_REGISTRATION] or (_NOT_REGISTERED if recording is not None else "")
        self._presenter.view.refresh()

    def _calibration_line(self, recording: SequenceRecord | None) -> str:
        if recording is None:
            return ""
        known = replace(recording, sequence=recording.sequence.with_transforms(self._calibration))
        source = self._from[_CALIBRATION]
        if known.is_calibrated:
            return source or "that of the file"
        try:
            known.sequence.pose(0, recording.path)
        except SimulationError as error:
            return f"{source}; {error}" if source else str(error)
        return source
