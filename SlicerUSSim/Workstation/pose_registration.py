"""Registration: calibration of tracked ultrasound and its place in the patient: from files, values, and landmarks."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require, required
from SlicerUSSim.Logic.base.transforms import check_affine, check_rigid
from SlicerUSSim.Logic.mrml.landmark_nodes import Landmark, write_landmarks
from SlicerUSSim.Logic.mrml.nodes import display_of
from SlicerUSSim.Logic.mrml.scene_record import SequenceRecord
from SlicerUSSim.Logic.mrml.sequence_nodes import MADE_FROM, POSES
from SlicerUSSim.Logic.tracked.pose_files import fit_landmarks, read_calibration, read_registration
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence
from SlicerUSSim.Workstation.browser_panel import BrowserPanel
from SlicerUSSim.Workstation.comparison import Comparison
from SlicerUSSim.Workstation.hand import ProbeHand
from SlicerUSSim.Workstation.opener import Opener
from SlicerUSSim.Workstation.state import ComparisonMode, LandmarkLine

_IMAGE, _REFERENCE = "Image", "Reference"
_CALIBRATION, _REGISTRATION = "Calibration", "Registration"
#: What is to be clicked next, as the page shows it
PICK_IMAGE = "click the landmark in the real image (Escape: not)"
PICK_PATIENT = "click the same landmark in a slice view (Escape: not)"
#: Name and colour of the landmarks in the views, as in workstation.css
_MARKS, _MARK_COLOR = "Registration landmarks", (1.0, 0.62, 0.18)
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

    def __init__(self, panel: BrowserPanel, opener: Opener, comparison: Comparison, hand: ProbeHand) -> None:
        self._shared, self._logic, self._tasks = panel.shared, panel.logic, panel.tasks
        self._presenter, self._opener, self._comparison, self._hand = panel.presenter, opener, comparison, hand
        self.recording: Recording | None = None
        self._calibration: dict[str, np.ndarray] = {}
        self._to_ras = np.eye(4)
        self._from = {_CALIBRATION: "", _REGISTRATION: ""}
        self._landmarks: list[Landmark] = []
        self._nodes: list[Any] = []
        #: Calibration and registration of the ultrasound that is opened next, and where they are from
        self._next_calibration: tuple[dict[str, np.ndarray], str] = ({}, "")
        self._next_to_ras: tuple[np.ndarray | None, str] = (None, "")
        self._marks: Any = None  # vtkMRMLMarkupsFiducialNode with the landmarks
        comparison.grid_changed = self._tell_landmarks

    # ---- recording ---------------------------------------------------------------------------------------------

    def read(self, path: str) -> Recording:
        """The recording of a file. Raises SimulationError if it cannot be read."""
        with self._presenter.view.progress(f"Open {Path(path).name}"):
            sequence = self._tasks.doAside(lambda: TrackedSequence.read(path))
        require(sequence.has_images, f"{Path(path).name}: has poses without images, expected tracked images")
        return Recording(sequence, Path(path).name.split(".")[0])

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
        self._landmarks = []
        self._from = {_CALIBRATION: calibrated_by, _REGISTRATION: source if to_ras is not None else ""}
        self._tell()
        if not replace(recording, sequence=recording.sequence.with_transforms(calibration)).is_calibrated:
            self._open_section()

    @property
    def landmarks(self) -> tuple[Landmark, ...]:
        """Those that were picked."""
        return tuple(self._landmarks)

    def restore(self, record: SequenceRecord, landmarks: Iterable[Landmark] = ()) -> None:
        """Use what was kept of a recording, calibrated and in its place; its images are prepared if they can be."""
        place = np.eye(4) if record.to_ras is None else record.to_ras
        self._apply(Recording(record.sequence, record.name, record.path), {}, place, record)
        self._landmarks = list(landmarks)
        is_placed = not np.allclose(place, np.eye(4))
        self._from = {_CALIBRATION: "", _REGISTRATION: "as it was kept" if is_placed else ""}
        self._tell()

    def forget(self) -> None:
        """Forget the recording, which is of another patient; its nodes are removed with him."""
        self.recording, self._calibration, self._to_ras = None, {}, np.eye(4)
        self._landmarks, self._nodes = [], []
        self._opener.opened_sequence = None
        self._forget_next()
        self._from = {_CALIBRATION: "", _REGISTRATION: ""}
        self.stop_picking()
        self._tell()

    def choose_frame(self, frame: str) -> None:
        """Take another frame of the recording for that which is fixed to the patient."""
        with self._presenter.shown():
            recording = self._required()
            self._apply(replace(recording, path=f"{_IMAGE}To{frame}"), self._calibration, self._to_ras)
            self._left_unknown()
            self._tell()

    # ---- calibration and registration --------------------------------------------------------------------------

    def _forget_next(self) -> None:
        self._next_calibration, self._next_to_ras = ({}, ""), (None, "")

    def reading_calibration(self, path: str, *, for_next: bool = False) -> Callable[[], None]:
        """The calibration of a file: of the name that is chosen, or those of a Plus configuration.

        It is that of the ultrasound that is open, or `for_next` of the one that is opened next.
        """
        name = _checked_name(self._shared.now.registration.name)
        with self._reading(path):
            found = self._tasks.doAside(lambda: read_calibration(path, name))
        source = f"{', '.join(found)} of {Path(path).name}"
        if for_next:
            return lambda: setattr(self, "_next_calibration", (found, source))
        return lambda: self._calibrate(found, source)

    def calibrate(self, name: str, text: str) -> None:
        """Use a calibration whose 16 numbers were typed."""
        with self._presenter.shown():
            name = _checked_name(name)
            matrix = check_affine(_CALIBRATION, _matrix(_CALIBRATION, text))
            self._calibrate({name: matrix}, f"{name} as typed")

    def reading_registration(self, path: str, *, for_next: bool = False) -> Callable[[], None]:
        """The registration of a file: a transform, or landmarks in MRI and ultrasound (.tag); `for_next` as above."""
        with self._reading(path):
            matrix, line = self._tasks.doAside(lambda: read_registration(path))
        source = f"{Path(path).name}{f': {line}' if line else ''}"
        if for_next:
            place = check_rigid(_REGISTRATION, matrix)
            return lambda: setattr(self, "_next_to_ras", (place, source))
        return lambda: self._register(matrix, source)

    def register(self, text: str) -> None:
        """Use a registration whose 16 numbers were typed."""
        with self._presenter.shown():
            self._register(check_rigid(_REGISTRATION, _matrix(_REGISTRATION, text)), "as typed")

    def _calibrate(self, calibration: dict[str, np.ndarray], source: str) -> None:
        calibration = {**self._calibration, **calibration}
        self._apply(self._required(), calibration, self._to_ras)
        self._from[_CALIBRATION] = "; ".join(filter(None, (self._from[_CALIBRATION], source)))
        self._left_unknown()
        self._tell()

    def _register(self, to_ras: np.ndarray, source: str, left: np.ndarray | None = None) -> None:
        """`left`: mm of each landmark, by which it was registered."""
        matrix = check_rigid(_REGISTRATION, to_ras)
        self._apply(self._required(), self._calibration, matrix)
        self._from[_REGISTRATION] = source
        self._left_unknown()
        if left is not None:
            marks = zip(self._landmarks, left, strict=True)
            self._landmarks = [replace(mark, left_mm=float(distance)) for mark, distance in marks]
        self._tell()

    def _left_unknown(self) -> None:
        """What is left of the landmarks is not that of this registration by these any more."""
        self._landmarks = [replace(mark, left_mm=None) for mark in self._landmarks]

    # ---- landmarks ---------------------------------------------------------------------------------------------

    def pick(self) -> None:
        """Ask for a landmark: a click in the real image, and one in a slice view."""
        with self._presenter.shown():
            sequence = self._shared.now.sequence
            require(
                self.recording is not None and sequence.length > 0,
                "no real image is shown, expected tracked ultrasound with its calibration",
            )
            require(self._logic.taken is not None, "no simulated image is shown, expected a patient first")
            self._hand.pick(self._too_early)  # Escape ends it
            with self._shared.changing() as now:
                now.registration.picking = "ultrasound"
                if now.sequence.comparison is not ComparisonMode.BESIDE:
                    now.sequence.comparison = ComparisonMode.BESIDE
            self._presenter.view.showStatus(PICK_IMAGE)

    def picked_in_image(self, across: float, down: float) -> None:
        """Called with a click in the real image, at fractions of its width and height."""
        if self._shared.now.registration.picking != "ultrasound":
            return
        found = self._comparison.pixel_at(float(across), float(down))
        if found is None:
            return
        number, pixel = found

        def clicked(point: np.ndarray | None) -> None:
            self._end_picking()
            if point is not None:
                with self._presenter.shown():
                    self._add(Landmark(number, pixel, point))

        self._hand.pick(clicked)
        with self._shared.changing() as now:
            now.registration.picking = "patient"
        self._presenter.view.showStatus(PICK_PATIENT)

    def stop_picking(self) -> None:
        """Wait for no landmark any more."""
        if self._shared.now.registration.picking:
            self._hand.pick(None)

    def add_typed(self, pixel: str, point: str) -> None:
        """Add a landmark of the image that is shown: column and row in it, R, A and S in the patient."""
        with self._presenter.shown():
            self._required()
            column_row, ras = _numbers("Landmark in the image", pixel, 2), _numbers("Landmark in the patient", point, 3)
            found = required(
                self._comparison.pixel_at(0.0, 0.0),
                "no real image is shown, expected tracked ultrasound with its calibration",
            )
            self._add(Landmark(found[0], column_row, ras))
            with self._shared.changing() as now:
                now.registration.typed_pixel = now.registration.typed_point = ""

    def remove_landmark(self, number: int) -> None:
        """Remove the landmark with an index from 0."""
        if 0 <= number < len(self._landmarks):
            del self._landmarks[number]
            self._left_unknown()
            self._tell()

    def fit(self) -> None:
        """Register by the landmarks: the rigid map with the least squared distances."""
        with self._presenter.shown():
            recording = self._required()
            sequence = recording.sequence.with_transforms(self._calibration)
            for mark in self._landmarks:  # those of a scene, too
                self._check(mark)
            placed = [
                (sequence.pose(mark.number, recording.path) @ [*mark.pixel, 0.0, 1.0])[:3] for mark in self._landmarks
            ]
            points = [mark.point for mark in self._landmarks]
            matrix, line, remaining = fit_landmarks(np.reshape(placed, (-1, 3)), np.reshape(points, (-1, 3)))
            self._register(matrix, line, remaining)

    def _check(self, landmark: Landmark) -> None:
        """Raise SimulationError for a landmark outside the recorded images, or far outside any patient."""
        rows, columns = self._required().sequence.images.shape[1:]
        landmark.check(columns, rows)

    def _add(self, landmark: Landmark) -> None:
        self._check(landmark)
        self._landmarks.append(landmark)
        self._left_unknown()
        self._tell()

    def _too_early(self, point: np.ndarray | None) -> None:
        """Called with a click in a slice view before that in the image, or with None for Escape."""
        self._end_picking()
        if point is not None:
            self.pick()

    def _end_picking(self) -> None:
        with self._shared.changing() as now:
            now.registration.picking = ""
        self._presenter.view.showStatus("")

    # ---- implementation ----------------------------------------------------------------------------------------

    def _apply(
        self,
        recording: Recording,
        calibration: dict[str, np.ndarray],
        to_ras: np.ndarray,
        kept: SequenceRecord | None = None,
    ) -> None:
        """Use these, or raise SimulationError and change nothing.

        `kept` is what is known of the recording, if it is restored.
        """
        sequence = recording.sequence.with_transforms(calibration) if calibration else recording.sequence
        made = None
        known = replace(recording, sequence=sequence)
        before, opened = self.recording, self._opener.opened_sequence
        is_same, field = False, None
        if before is not None and before.sequence is recording.sequence:
            is_same = True
            # Another place in the patient does not change the field of the images
            is_field_same = before.path == recording.path and calibration is self._calibration
            if is_field_same and opened is not None and opened.tracked is not None:
                field = opened.tracked.field
        record = kept or SequenceRecord(sequence, recording.name, recording.path, to_ras, field=field)
        if known.is_calibrated:
            with self._presenter.view.progress("Find the probe's field"):
                made = self._opener.sequence(record)
        number = self._shared.now.sequence.number if is_same else 0
        old, self._nodes = self._nodes, [] if made is None else made[3]
        self.recording, self._calibration, self._to_ras = recording, calibration, to_ras
        if made is None:
            self._comparison.drop()
            self._logic.parameters.real = None
        else:
            tracked, browser, images, _ = made
            record = replace(record, tracked=tracked)
            if field is None:  # else a user may have changed it since
                self._logic.preset = replace(self._logic.preset, probe=tracked.probe)
            self._logic.parameters.real = images
            self._comparison.take(tracked, browser, number)
            self._choose_poses(browser, old)
        self._opener.opened_sequence = record
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

    def _required(self) -> Recording:
        return required(self.recording, "no tracked ultrasound is open, expected a file with it first")

    def _tell(self) -> None:
        """Show what is used."""
        recording = self.recording
        calibration, to_ras = self._calibration, self._to_ras
        self._draw_landmarks()
        self._tell_landmarks()
        with self._shared.changing() as now:
            about = now.registration
            about.recording = "" if recording is None else f"{recording.name}: {recording.what}"
            frames = [] if recording is None else recording.sequence.frames_of_reference()
            about.frames = [frame for frame in frames if frame != _IMAGE]
            about.frame = "" if recording is None else recording.path.removeprefix(f"{_IMAGE}To")
            if recording is not None and about.frame not in about.frames:
                about.frames = [about.frame, *about.frames]
            about.calibration = self._calibration_line(recording)
            name = about.name if about.name in calibration else next(iter(calibration), "")
            about.calibration_text = _text(calibration[name]) if name else ""
            about.registration = self._from[_REGISTRATION] or (_NOT_REGISTERED if recording is not None else "")
            about.registration_text = _text(to_ras) if self._from[_REGISTRATION] else ""
        self._presenter.view.refresh()

    def _tell_landmarks(self) -> None:
        lines = []
        for mark in self._landmarks:
            place = self._comparison.place_of(mark.pixel)
            lines.append(
                LandmarkLine(
                    f"image {mark.number}: {mark.pixel[0]:.1f}, {mark.pixel[1]:.1f}",
                    ", ".join(f"{value:.1f}" for value in mark.point),
                    "" if mark.left_mm is None else f"{mark.left_mm:.2f} mm",
                    f"image {mark.number}",
                    None if place is None else [round(100.0 * share, 2) for share in place],
                )
            )
        with self._shared.changing() as now:
            now.registration.landmarks = lines

    def _draw_landmarks(self) -> None:
        """Show the landmarks in the views of the patient, and save them with the scene."""
        node, scene = self._marks, self._logic.scene
        if node is not None and node.GetScene() is not scene:  # it went with a patient
            node = None
        if not self._landmarks:
            if node is not None:
                scene.RemoveNode(node)
            self._marks = None
            return
        if node is None:
            node = scene.AddNewNodeByClass("vtkMRMLMarkupsFiducialNode", _MARKS)
            node.CreateDefaultDisplayNodes()
            display_of(node).SetSelectedColor(*_MARK_COLOR)
        self._marks = node
        recording = self._required()
        sequence = recording.sequence.with_transforms(self._calibration)
        placed = [number for number in range(len(sequence)) if sequence.has_pose(number, recording.path)]
        # The scene has no other images, see add_sequence: there they have other numbers
        known = [replace(mark, number=placed.index(mark.number)) for mark in self._landmarks if mark.number in placed]
        write_landmarks(node, known)

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

    def _open_section(self) -> None:
        with self._shared.changing() as now:
            if SECTION not in now.open_sections:
                now.open_sections = [*now.open_sections, SECTION]

    def _reading(self, path: str) -> AbstractContextManager[object]:
        return self._presenter.view.progress(f"Open {Path(path).name}")


#: Title of its section on the page
SECTION = "Tracked ultrasound"


def _checked_name(name: str) -> str:
    name = name.strip()
    require(
        re.fullmatch(r"\w+To[A-Z0-9]\w*", name),
        f"Its name is {name[:40]!r}, expected two frames joined by To, such as ImageToProbe",
    )
    return name


def _matrix(what: str, text: str) -> np.ndarray:
    return _numbers(what, text, 16, "16 numbers, the 4x4 matrix by rows").reshape(4, 4)


def _numbers(what: str, text: str, count: int, expected: str = "") -> np.ndarray:
    expected = expected or f"{count} numbers"
    words = text.replace(",", " ").split()
    try:
        values = np.array(words, float)
    except ValueError:
        wrong = next(word for word in words if not _is_number(word))
        raise SimulationError(f"{what} has {wrong[:40]!r}, expected {expected}") from None
    require(values.size == count, f"{what} has {values.size} number{'s' * (values.size != 1)}, expected {expected}")
    require(bool(np.isfinite(values).all()), f"{what} has a value that is not finite, expected {expected}")
    return values


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _text(matrix: np.ndarray) -> str:
    return "\n".join(" ".join(f"{value:.6g}" for value in row) for row in matrix)
