"""Opener: files from a page or the command line are recognised, asked about where it matters, and put into the scene.

Each file is one line on the page: what it was recognised as, and what was done with it. Nothing changes for a file that
cannot be read, or whose question is answered with none of its choices.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

from SlicerUSSim.Logic.base.dicom import Series
from SlicerUSSim.Logic.base.errors import Cancelled, SimulationError, require
from SlicerUSSim.Logic.base.files import read_json
from SlicerUSSim.Logic.base.reading import untrusted_folder
from SlicerUSSim.Logic.imaging.content import Content, Kind, content_of
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mri.markups import markup_points
from SlicerUSSim.Logic.mri.modality import has_brain_mask
from SlicerUSSim.Logic.mri.pathology import LESIONS
from SlicerUSSim.Logic.mri.segmentation_settings import CT, MRI_CONTRASTS
from SlicerUSSim.Logic.placement.craniotomy import POLYGONS
from SlicerUSSim.Logic.tissue.label_mapping import LabelMapping
from SlicerUSSim.Logic.tissue.table import TissueTable, tissues_beside
from SlicerUSSim.Logic.tracked.pose_files import read_pose
from SlicerUSSim.Workstation.browser_panel import BrowserPanel
from SlicerUSSim.Workstation.file_nodes import FileNodes, LabelTable
from SlicerUSSim.Workstation.patient import OpenPatient
from SlicerUSSim.Workstation.pose_entry import PoseEntry
from SlicerUSSim.Workstation.pose_registration import Registration
from SlicerUSSim.Workstation.questions import Questions
from SlicerUSSim.Workstation.scenes import Scenes
from SlicerUSSim.Workstation.state import Choice
from SlicerUSSim.Workstation.uploads import Sent, as_known, listed

_log = logging.getLogger(__name__)
_T = TypeVar("_T")

#: Kinds of files in the order in which those that are opened together are: settings, a patient, what is laid on him
_ORDER = (
    Kind.SCENE, Kind.PRESET, Kind.MRI, Kind.CT, Kind.LABELS, Kind.LESIONS, Kind.MASK, Kind.SHEETS, Kind.SEQUENCE,
    Kind.TRANSFORM, Kind.POSE, Kind.POINTS,
)  # fmt: skip
#: Keys of choices
_NEW, _SECOND, _SHOWN, _OWN = "new", "second", "shown", "own"
_ORGANS, _BRAIN, _OPENING, _AS = "organs", "brain", "opening", "as "
_CALIBRATION, _REGISTRATION, _POSE = "calibration", "registration", "pose"
#: The tissue that stands for several
_SEVERAL = "brats"


@dataclass
class _File:
    """A file that was recognised."""

    path: str
    content: Content
    #: Of the labels; None without
    table: LabelTable | None
    #: Whether an MRI or CT of a new patient was opened together with it
    has_image: bool = False

    @property
    def kind(self) -> Kind:
        return self.content.kind

    @property
    def name(self) -> str:
        """Its name, as the user knows it."""
        return Path(self.path).name


class Opener:
    """Opens files. All methods run in a task."""

    def __init__(
        self, panel: BrowserPanel, nodes: FileNodes, patient: OpenPatient, scenes: Scenes,
        registration: Registration, questions: Questions, poses: PoseEntry,
    ) -> None:  # fmt: skip
        self._shared, self._logic, self._tasks = panel.shared, panel.logic, panel.tasks
        self._panel, self._presenter, self._nodes, self._patient = panel, panel.presenter, nodes, patient
        self._scenes, self._registration, self._questions, self._poses = scenes, registration, questions, poses
        self._take: dict[Kind, Callable[[_File, list[_File]], str]] = {
            Kind.MRI: self._image, Kind.CT: self._image, Kind.LABELS: self._labels, Kind.MASK: self._mask,
            Kind.LESIONS: self._mask, Kind.SEQUENCE: self._sequence, Kind.SHEETS: self._sheets, Kind.SCENE: self._scene,
            Kind.PRESET: self._preset, Kind.TRANSFORM: self._transform, Kind.POSE: self._pose,
            Kind.POINTS: self._points,
        }  # fmt: skip

    def open_sent(self, files: Mapping[str, bytes], meant: str = "") -> None:
        """Open what a page has sent, {name: content}: any files of a patient, his ultrasound, and settings.

        A transform that is `meant` to be a calibration or a registration is used as such without a question.
        """
        self._begin()
        with self._presenter.shown(), untrusted_folder() as folder:
            with self._presenter.view.progress(f"Open {listed(list(files))}"):
                sent = Sent(folder, files)
                series = self._tasks.doAside(sent.series) if sent.has_dicom else []
            if sent.has_dicom:
                sent.take(self._chosen(series), series)
            self._open(sent.paths, meant)

    def open_paths(self, paths: Sequence[str]) -> None:
        """Open files of this computer."""
        self._begin()
        with self._presenter.shown():
            self._open([Path(path) for path in paths])

    def close_patient(self) -> None:
        """Close the patient, after a question if something of him would be lost."""
        with self._presenter.shown():
            if self._patient.unsaved:
                text = "Save, Scene for 3D Slicer (MRB), saves what was made here."
                self._ask(f"Close {self._patient.name}?", text, [Choice("close", "Close", self._closed())])
            self._patient.close()

    def _begin(self) -> None:
        with self._shared.changing() as now:
            now.opened = []

    def _open(self, paths: Sequence[Path], meant: str = "") -> None:
        try:
            with self._presenter.view.progress(f"Open {listed([path.name for path in paths])}"):
                files, wrong = self.recognised(paths)
            self._take_all(files, meant)
        finally:
            self._nodes.volumes.clear()
        for line in wrong:  # after a new patient, who clears the messages about the previous one
            self._panel.showError(line)

    def _take_all(self, files: list[_File], meant: str) -> None:
        for file in files:
            with self._presenter.shown():
                deed = self._transform_as(file, meant) if meant else self._take[file.kind](file, files)
                self._say(f"{file.name}: {file.content.what}: {deed}")

    def recognised(self, paths: Sequence[Path]) -> tuple[list[_File], list[str]]:
        """(what files are, in the order in which they can be opened; lines about those that cannot).

        Label maps include the tables of their labels. Raises SimulationError if there is nothing to open.
        """
        found: dict[Path, Content] = {}
        wrong: list[str] = []
        for path in paths:
            try:
                found[path] = content = self._tasks.doAside(lambda path=path: content_of(path))
            except Cancelled:
                raise
            except SimulationError as error:
                wrong.append(str(error))
                continue
            _log.info("%s: is %s", path.name, content.what)
            if content.volume is not None:
                self._nodes.volumes[str(path)] = content.volume
        if not found:
            raise SimulationError("; ".join(wrong) or "no files were sent, expected one or more")
        tables, maps = _tables_of(found)
        parts = {name for content in found.values() for name in content.files[1:]}
        files = [
            _File(str(path), content, self._table(maps[path]) if path in maps else None)
            for path, content in found.items()
            if path not in tables and path.name not in parts
        ]
        return sorted(files, key=lambda file: _ORDER.index(file.kind)), wrong

    def _table(self, path: Path) -> LabelTable:
        values = read_json(path) if path.suffix.lower() == ".json" else None
        if isinstance(values, dict) and "tissues" in values:
            return LabelTable(path.name, TissueTable.read(path))
        return LabelTable(path.name, mapping=LabelMapping.of([str(path)], self._logic.preset.tissues))

    def _say(self, line: str) -> None:
        with self._shared.changing() as now:
            now.opened = [*now.opened, as_known(line)]

    def _read(self, file: _File, read: Callable[[str], _T]) -> _T:
        with self._presenter.view.progress(f"Open {file.name}"):
            return read(file.path)

    def _chosen(self, series: list[Series]) -> Series:
        """The only series that is a volume, or the one that the user chooses."""
        volumes = [one for one in series if one.is_volume]
        listing = "; ".join(f"{one.title}: {one.images}" for one in series[:12])
        require(
            bool(volumes),
            f"the DICOM files have no series with enough parallel images for a volume, expected one "
            f"({listing or 'none'})",
        )
        if len(volumes) == 1:
            return volumes[0]
        patients = list(dict.fromkeys(one.patient for one in volumes))
        whose = [f", patient {patients.index(one.patient) + 1}" if len(patients) > 1 else "" for one in volumes]
        of_many = f" of {len(patients)} different patients" if len(patients) > 1 else ""
        number = self._ask(
            "Which series?",
            f"The DICOM files have {len(volumes)} series that are volumes{of_many}.",
            [Choice(str(n), f"{one.title}: {one.images}{whose[n]}") for n, one in enumerate(volumes)],
        )
        return volumes[int(number)]

    # ---- the patient -------------------------------------------------------------------------------------------

    def _image(self, file: _File, together: list[_File]) -> str:
        parameters: Any = self._logic.parameters
        patient, is_ct, before = self._patient.name, file.kind is Kind.CT, parameters.segmentation.contrast
        contrast = CT if is_ct else MRI_CONTRASTS[0] if before == CT else before
        key = _NEW
        if self._patient.is_of_user:
            choices = [self._new()]
            if parameters.mri is None:
                choices.append(Choice(_SHOWN, f"Image of {patient}", "Shown under the labels, which stay"))
            elif not is_ct and before != CT:
                tip = "Registered to the first MRI and classified together with it by Segment"
                choices.append(Choice(_SECOND, f"Second MRI of {patient}", tip))
            key = self._ask_what(file, choices)
        if key == _SECOND:
            second = self._ask(
                f"Contrast of {file.name}?",
                f"The first MRI of {patient} is used as {before}.",
                [Choice(name, name) for name in MRI_CONTRASTS],
            )
            self._patient.take_second(self._read(file, self._nodes.second_mri), second)
            return f"second MRI of {patient}, {second}; Segment uses it"
        node = self._read(file, self._nodes.mri)
        labels = [other for other in together if other.kind is Kind.LABELS]
        for other in labels:
            other.has_image = True
        if key == _SHOWN:
            self._patient.show_image(node)
            return f"shown as the image of {patient}"
        if not self._patient.take_mri(node, contrast, then_segment=not labels):
            return "a new patient, whose tissues were not found"
        then = "with its own labels" if labels else f"segmented as {contrast}"
        changed = f" (before: {before})" if contrast != before else ""
        return f"a new patient, {then}{changed}{f'; {patient} is closed' if patient else ''}"

    def _labels(self, file: _File, together: list[_File]) -> str:
        parameters: Any = self._logic.parameters
        patient, key = self._patient.name, _OWN if file.has_image else _NEW
        if self._patient.is_of_user and not file.has_image:
            choices = [self._new()]
            if parameters.mri is not None:
                choices.append(Choice(_OWN, f"Tissues of {patient}", "In place of its tissues; the MRI stays"))
            if parameters.mri is not None and parameters.segmentation.contrast == CT:
                choices.append(_organs_of(patient))
            key = self._ask_what(file, choices)
        if key == _ORGANS:
            return self._organs(file)
        return self._take_labels(file, patient, are_of_patient=key == _OWN)

    def _take_labels(self, file: _File, patient: str, *, are_of_patient: bool) -> str:
        table = self._numbering(file)
        node, found = self._read(file, lambda path: self._nodes.labels(path, table))
        self._patient.take_labels(node, found, are_of_patient=are_of_patient)
        if are_of_patient:
            return f"tissues of {patient}"
        return f"a new patient{f'; {patient} is closed' if patient else ''}"

    def _numbering(self, file: _File) -> LabelTable | None:
        """The table of its labels, or the numbering that the user says where several fit."""
        schemes = {scheme.key: scheme for scheme in file.content.schemes}
        if file.table is not None or not schemes:
            return file.table
        choices = [
            Choice(key, scheme.title, ", ".join(f"{n} {name}" for n, name in islice(scheme.names.items(), 4)))
            for key, scheme in schemes.items()
        ]
        key = self._ask(f"Numbers of {file.name}?", f"{file.name} is {file.content.what}.", choices)
        return LabelTable(schemes[key].title, mapping=LabelMapping(scheme=key))

    def _organs(self, file: _File) -> str:
        self._patient.take_organs(*self._read(file, self._nodes.organs))
        return f"organs of the CT {self._patient.name}; Segment uses them"

    def _mask(self, file: _File, together: list[_File]) -> str:
        """A mask, or lesions: of the patient, or a label map."""
        parameters: Any = self._logic.parameters
        patient = self._patient.name
        if not patient or file.table is not None:  # whose table says what its labels are
            return self._labels(file, together)
        tip = f"Laid over the tissues of {patient}"
        choices = [Choice(f"{_AS}{name}", f"Add as {name}", tip) for name in LESIONS if name != _SEVERAL]
        if file.kind is Kind.LESIONS:
            choices.insert(0, Choice(f"{_AS}{_SEVERAL}", "Add its lesions by their names or numbers", tip))
        contrast = parameters.segmentation.contrast
        if parameters.mri is not None and file.kind is Kind.MASK and has_brain_mask(contrast):
            tip = f"Segment makes the tissues of {patient} anew, inside the mask"
            choices.append(Choice(_BRAIN, "Use as brain mask", tip))
        if file.kind is Kind.MASK and parameters.labels is not None:
            choices.append(Choice(_OPENING, "Use as opening of the skull", "Chosen for Open skull"))
        if parameters.mri is not None and contrast == CT:
            choices.append(_organs_of(patient))
        choices.append(Choice(_NEW, "Label map of a new patient", self._closed()))
        key = self._ask_what(file, choices)
        if key == _NEW:
            return self._take_labels(file, patient, are_of_patient=False)
        if key == _ORGANS:
            return self._organs(file)
        if key == _BRAIN:
            parameters.mask = self._read(file, lambda path: self._nodes.brain_mask(path, parameters.mri))
            is_segmented = self._patient.segment()
            return f"brain mask of {patient}, {'whose tissues are made anew' if is_segmented else 'without tissues'}"
        if key == _OPENING:
            parameters.opening = self._read(file, self._nodes.opening)
            return f"opening of {patient}, used by Open skull"
        tissue = key.removeprefix(_AS)
        self._patient.lay(self._read(file, self._nodes.lesions), tissue, file.name)
        return f"{'its lesions' if tissue == _SEVERAL else tissue} of {patient}, over the tissues"

    # ---- ultrasound and settings -------------------------------------------------------------------------------

    def _sequence(self, file: _File, together: list[_File]) -> str:
        recording = self._registration.read(file.path)
        self._registration.take(recording)
        if not recording.is_calibrated:
            return f"{recording.what}: enter its calibration in Tracked ultrasound"
        return f"{recording.what}: compared with {self._patient.name or 'the patient who is opened next'}"

    def _transform(self, file: _File, together: list[_File]) -> str:
        """A calibration, a registration or a pose: of these only two files say which they are."""
        known = {".xml": _CALIBRATION, ".tag": _REGISTRATION}
        key = known.get(Path(file.name).suffix.lower())
        if key is None:
            later = "" if self._registration.recording is not None else "; for the next one that is opened"
            choices = [
                Choice(_CALIBRATION, "Calibration", f"Of tracked ultrasound: from pixels to its probe{later}"),
                Choice(_REGISTRATION, "Registration", f"Of tracked ultrasound: from its frame to the patient{later}"),
            ]
            if self._logic.parameters.labels is not None:
                tip = f"The simulated probe is moved there, on {self._patient.name}"
                choices.append(Choice(_POSE, "Pose of the probe", tip))
            key = self._ask_what(file, choices)
        return self._pose(file, together) if key == _POSE else self._transform_as(file, key)

    def _transform_as(self, file: _File, key: str) -> str:
        use = self._registration.calibrate if key == _CALIBRATION else self._registration.register
        of_next = self._registration.recording is None
        self._read(file, use)
        return f"{key} of the tracked ultrasound{' that is opened next' if of_next else ''}"

    def _sheets(self, file: _File, together: list[_File]) -> str:
        self._logic.parameters.sheets = self._read(file, self._nodes.sheets)
        return "shown in the images"

    def _preset(self, file: _File, together: list[_File]) -> str:
        preset = self._tasks.doAside(lambda: Preset.read(file.path))
        self._presenter.values.takePreset(preset)
        moves = "" if preset.probe_to_ras is None else "; the probe is moved to its pose"
        return f"in place of the previous settings{moves}"

    def _pose(self, file: _File, together: list[_File]) -> str:
        self._poses.set(self._tasks.doAside(lambda: read_pose(file.path)))
        return "the probe is moved there"

    def _points(self, file: _File, together: list[_File]) -> str:
        path, parameters = file.path, self._logic.parameters
        kind, points = self._tasks.doAside(lambda: markup_points(path, POLYGONS, "a closed curve or a list of points"))
        require(len(points) > 0, f"{file.name}: has no point that was placed, expected one or more")
        if kind == "Fiducial":
            parameters.seed = self._nodes.points(path, points)
            self._presenter.lesions.growAtPoint()
            return "the lesion around the last one is grown, if the notes of Lesions say so"
        parameters.opening = self._read(file, self._nodes.opening)
        return "chosen as the opening of a craniotomy"

    def _scene(self, file: _File, together: list[_File]) -> str:
        before = self._patient.name
        if self._patient.is_of_user:
            self._ask_what(file, [Choice(_NEW, "The patient of the scene", self._closed())])
        self._scenes.open(file.path)
        return f"shown as it was{f'; {before} is closed' if before else ''}"

    # ---- questions ---------------------------------------------------------------------------------------------

    def _new(self) -> Choice:
        return Choice(_NEW, "New patient", self._closed())

    def _closed(self) -> str:
        """A line about closing the open patient, and about unsaved data that are lost."""
        unsaved = self._patient.unsaved
        lost = f"; not saved: {', '.join(unsaved)}" if unsaved else ""
        return f"{self._patient.name} is closed with everything that belongs to it{lost}"

    def _ask_what(self, file: _File, choices: list[Choice]) -> str:
        return self._ask(f"Open {file.name} as?", f"{file.name} is {file.content.what}.", choices)

    def _ask(self, title: str, text: str, choices: list[Choice]) -> str:
        """The key of the answer. Raises SimulationError if the patient of the question is no longer open."""
        patient = self._patient.name
        key = self._questions.ask(title, as_known(text), choices)
        now = self._patient.name
        require(now == patient, f"{patient or 'no patient'} was open for this question, and now {now or 'none'} is")
        return key


def _organs_of(patient: str) -> Choice:
    return Choice(_ORGANS, f"Organs of the CT {patient}", "They replace muscle and blood when Segment is pressed")


def _tables_of(found: Mapping[Path, Content]) -> tuple[set[Path], dict[Path, Path]]:
    """(tables of labels, {label map: its table}) of files that are opened together.

    A table is called as its label map, or there is one of each. Raises SimulationError for a table of nothing.
    """
    tables = [path for path, content in found.items() if content.kind is Kind.TABLE]
    maps = [path for path, content in found.items() if content.kind in (Kind.LABELS, Kind.MASK, Kind.LESIONS)]
    pairs: dict[Path, Path] = {}
    for table in tables:
        own = [path for path in maps if tissues_beside(path).stem == table.stem] or maps
        require(
            len(own) == 1 and own[0] not in pairs,
            f"{table.name} is a table of labels and was opened with {len(maps)} label maps, expected one for each "
            "table: open a label map and its table together, with the same name if there are several",
        )
        pairs[own[0]] = table
    return set(tables), pairs
