"""Registration: calibration of tracked ultrasound and its place in the patient, from files."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require, required
from SlicerUSSim.Logic.base.transforms import check_rigid
from SlicerUSSim.Logic.mrml.scene_record import SequenceRecord
from SlicerUSSim.Logic.mrml.sequence_nodes import MADE_FROM, POSES
from SlicerUSSim.Logic.tracked.imaged_field import ImagedField
from SlicerUSSim.Logic.tracked.pose_files import read_calibration, read_registration
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence
from SlicerUSSim.Workstation.browser_panel import BrowserPanel
from SlicerUSSim.Workstation.comparison import Comparison
from SlicerUSSim.Workstation.file_nodes import FileNodes

#: Title of its section on the page
SECTION = "Tracked ultrasound"
_IMAGE, _REFERENCE = "Image", "Reference"
_CALIBRATION, _REGISTRATION = "Calibration", "Registration"
_NOT_REGISTERED = "none: the frame of the ultrasound is taken for the patient's"


@dataclass(frozen=True, eq=False)
class Recording:
    """Tracked ultrasound as it was recorded."""

    sequence: TrackedSequence
    name: str
    #: Transform from pixels to the frame that is fixed to the patient
    path: str = f"{_IMAGE}To{_REFERENCE}"

    @property
    def what(self) -> str:
        """Its images and transforms, in words."""
        rows, columns = self.sequence.images.shape[1:]
        count = len(self.sequence)
        names = sorted({name for entry in self.sequence.transforms for name in entry})
        transforms = f"transforms {', '.join(names)}" if names else "no transforms"
        return f"{count} image{'s' * (count > 1)} of {columns}x{rows}, {transforms}"

    @property
    def is_calibrated(self) -> bool:
        """Whether the place of at least one image is known."""
        return any(self.sequence.has_pose(number, self.path) for number in range(len(self.sequence)))


class Registration:
    """The tracked ultrasound of the page. Methods that change it run in a task."""

    def __init__(self, panel: BrowserPanel, file_nodes: FileNodes, comparison: Comparison) -> None:
        self._shared, self._logic, self._tasks = panel.shared, panel.logic, panel.tasks
        self._presenter, self._file_nodes, self._comparison = panel.presenter, file_nodes, comparison
        self.recording: Recording | None = None
        self._calibration: dict[str, np.ndarray] = {}
        self._to_ras = np.eye(4)
        self._from = {_CALIBRATION: "", _REGISTRATION: ""}
        self._nodes: list[Any] = []
        self._field: ImagedField | None = None  # of the images, once they are prepared
        #: Calibration and registration of the ultrasound that is opened next, and where they are from
        self._next_calibration: tuple[dict[str, np.ndarray], str] = ({}, "")
        self._next_to_ras: tuple[np.ndarray | None, str] = (None, "")

    # ---- recording ---------------------------------------------------------------------------------------------

    def read(self, path: str) -> Recording:
        """The recording of a file. Raises SimulationError if it cannot be read."""
        with self._presenter.view.progress(f"Open {Path(path).name}"):
            sequence = self._tasks.doAside(lambda: TrackedSequence.read(path))
        require(sequence.has_images, f"{Path(path).name}: has poses without images, expected tracked images")
        return Recording(sequence, Path(path).name.split(".")[0])

    @property
    def is_waiting(self) -> bool:
        """Whether there is a recording whose place in the patient is not known yet."""
        return self.recording is not None and self._logic.parameters.real is None

    @property
    def nodes(self) -> list[Any]:
        """The nodes of the recording in the scene."""
        return list(self._nodes)

    def take(self, recording: Recording, to_ras: np.ndarray | None = None) -> None:
        """Use a recording from now on, in the patient at `to_ras` (4, 4), if it is known.

        Its probe and poses are used once its calibration is known. Nothing changes if it cannot be used.
        """
        source = "given at the start"
        if to_ras is None:
            to_ras, source = self._next_to_ras
        calibration, calibrated_by = self._next_calibration
        self._apply(recording, calibration, np.eye(4) if to_ras is None else to_ras)
        self._forget_next()
        self._from = {_CALIBRATION: calibrated_by, _REGISTRATION: source if to_ras is not None else ""}
        self._tell()

    def restore(self, record: SequenceRecord) -> None:
        """Use what was kept of a recording, calibrated and in its place; its images are prepared if they can be."""
        place = np.eye(4) if record.to_ras is None else record.to_ras
        self._apply(Recording(record.sequence, record.name, record.path), {}, place, record)
        is_placed = not np.allclose(place, np.eye(4))
        self._from = {_CALIBRATION: "", _REGISTRATION: "as it was kept" if is_placed else ""}
        self._tell()

    def forget(self) -> None:
        """Forget the recording, which is of another patient; its nodes are removed with him."""
        self.recording, self._calibration, self._to_ras = None, {}, np.eye(4)
        self._nodes, self._field = [], None
        self._forget_next()
        self._from = {_CALIBRATION: "", _REGISTRATION: ""}
        self._tell()

    def choose_frame(self, frame: str) -> None:
        """Take another frame of the recording for that which is fixed to the patient."""
        with self._presenter.shown():
            recording = required(self.recording, "no tracked ultrasound is open, expected a file with it first")
            self._apply(replace(recording, path=f"{_IMAGE}To{frame}"), self._calibration, self._to_ras)
            self._tell()

    # ---- calibration and registration --------------------------------------------------------------------------

    def _forget_next(self) -> None:
        self._next_calibration, self._next_to_ras = ({}, ""), (None, "")

    def calibrate(self, path: str) -> None:
        """Use the calibration of a file: of the name that is chosen, or those of a Plus configuration.

        It is that of the ultrasound that is open, or else of the one that is opened next.
        """
        name = _checked_name(self._shared.now.registration.name)
        found = self._tasks.doAside(lambda: read_calibration(path, name))
        source = f"{', '.join(found)} of {Path(path).name}"
        if self.recording is None:
            self._next_calibration = found, source
            return
        self._apply(self.recording, {**self._calibration, **found}, self._to_ras)
        self._from[_CALIBRATION] = "; ".join(filter(None, (self._from[_CALIBRATION], source)))
        self._tell()

    def register(self, path: str) -> None:
        """Use the registration of a file: a transform, or landmarks in MRI and ultrasound (.tag), as calibrate."""
        matrix, line = self._tasks.doAside(lambda: read_registration(path))
        place, source = check_rigid(_REGISTRATION, matrix), f"{Path(path).name}{f': {line}' if line else ''}"
        if self.recording is None:
            self._next_to_ras = place, source
            return
        self._apply(self.recording, self._calibration, place)
        self._from[_REGISTRATION] = source
        self._tell()

    # ---- implementation ----------------------------------------------------------------------------------------

    def _apply(
        self, recording: Recording, calibration: dict[str, np.ndarray], to_ras: np.ndarray,
        kept: SequenceRecord | None = None,
    ) -> None:  # fmt: skip
        """Use these, or raise SimulationError and change nothing.

        `kept` is what is known of the recording, if it is restored.
        """
        sequence = recording.sequence.with_transforms(calibration) if calibration else recording.sequence
        before, made = self.recording or recording, None
        is_same = before.sequence is recording.sequence
        # Another place in the patient does not change the field of the images
        is_field_same = is_same and before.path == recording.path and calibration is self._calibration
        field = self._field if is_field_same else None
        record = kept or SequenceRecord(sequence, recording.name, recording.path, to_ras, field=field)
        if replace(recording, sequence=sequence).is_calibrated:
            with self._presenter.view.progress("Find the probe's field"):
                made = self._file_nodes.sequence(record)
        number = self._shared.now.sequence.number if is_same else 0
        old, self._nodes = self._nodes, [] if made is None else made[3]
        self.recording, self._calibration, self._to_ras = recording, calibration, to_ras
        if made is None:
            self._comparison.drop()
            self._comparison.view(sequence.images, number)
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
            made[2].SetName(recording.name)  # which its nodes of before had, and scenes give back

    def _choose_poses(self, browser: Any, old: list[Any]) -> None:
        """Let Simulate sequence use the poses of the images, instead of those before, or of none."""
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

    def _calibration_line(self, recording: Recording | None) -> str:
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


def _checked_name(name: str) -> str:
    name = name.strip()
    require(
        re.fullmatch(r"\w+To[A-Z0-9]\w*", name),
        f"Its name is {name[:40]!r}, expected two frames joined by To, such as ImageToProbe",
    )
    return name
