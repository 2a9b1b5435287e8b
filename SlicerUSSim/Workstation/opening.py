"""Opening: what a page has sent is recognised, said in one line with what is done, and asked where it matters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from itertools import islice
from typing import Any

from SlicerUSSim.Logic.base.dicom import Series
from SlicerUSSim.Logic.base.errors import Cancelled, SimulationError, require
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mri.markups import markup_points
from SlicerUSSim.Logic.mri.modality import has_brain_mask
from SlicerUSSim.Logic.mri.pathology import LESIONS
from SlicerUSSim.Logic.mri.segmentation_settings import CT, MRI_CONTRASTS
from SlicerUSSim.Logic.placement.craniotomy import POLYGONS
from SlicerUSSim.Logic.tissue.label_mapping import LabelMapping
from SlicerUSSim.Logic.tracked.pose_files import read_pose
from SlicerUSSim.Workstation.browser_panel import BrowserPanel
from SlicerUSSim.Workstation.content import Kind
from SlicerUSSim.Workstation.loading import Loading
from SlicerUSSim.Workstation.opener import LabelTable, Opener, Upload
from SlicerUSSim.Workstation.parcel import Parcel
from SlicerUSSim.Workstation.pose_entry import PoseEntry
from SlicerUSSim.Workstation.pose_registration import Registration
from SlicerUSSim.Workstation.questions import Questions
from SlicerUSSim.Workstation.state import Choice
from SlicerUSSim.Workstation.uploads import listed

#: Keys of choices
_NEW, _SECOND, _SHOWN, _OWN = "new", "second", "shown", "own"
_ORGANS, _BRAIN, _OPENING, _AS = "organs", "brain", "opening", "as "
_CALIBRATION, _REGISTRATION, _POSE = "calibration", "registration", "pose"
#: The tissue that stands for several
_SEVERAL = "brats"


class Opening:
    """Opens what a page has sent. All methods run in a task."""

    def __init__(
        self, panel: BrowserPanel, opener: Opener, loading: Loading, registration: Registration, questions: Questions,
        poses: PoseEntry,
    ) -> None:  # fmt: skip
        self._shared, self._logic, self._tasks = panel.shared, panel.logic, panel.tasks
        self._presenter, self._opener, self._loading = panel.presenter, opener, loading
        self._registration, self._questions, self._poses = registration, questions, poses
        #: Opens a scene (.mrb) by its path, in place of the patient, and returns what was done
        self.open_scene: Callable[[str], str] | None = None
        self._took: dict[Kind, Callable[[Upload, list[Upload]], tuple[str, Callable[[], object]]]] = {
            Kind.MRI: self._mri, Kind.CT: self._mri, Kind.LABELS: self._labels, Kind.MASK: self._mask,
            Kind.LESIONS: self._mask, Kind.SEQUENCE: self._sequence, Kind.SHEETS: self._sheets, Kind.SCENE: self._scene,
            Kind.PRESET: self._preset, Kind.TRANSFORM: self._transform, Kind.POSE: self._pose,
            Kind.POINTS: self._points,
        }  # fmt: skip

    def open(self, files: Mapping[str, bytes], meant: str = "") -> None:
        """Open what a page has sent, {name: content}: any files of a patient, his ultrasound, and settings.

        A transform that is `meant` to be a calibration or a registration is used as such without a question.
        Nothing changes for a file that cannot be read, or whose question is answered with none of its choices.
        """
        title = f"Open {listed(list(files))}"
        with self._shared.changing() as now:
            now.opened = []
        with self._presenter.shown(), ExitStack() as sent:
            with self._presenter.view.progress(title):
                parcel = sent.enter_context(self._opener.sent(files))
                series = self._tasks.doAside(parcel.series) if parcel.has_dicom else []
            if parcel.has_dicom:
                self._choose_series(parcel, series)
            with self._presenter.view.progress(title):
                uploads, wrong = self._opener.uploads(parcel)
            for known, name in parcel.renamed.items():
                self._say(f"{name} is read as {known}, by its content")
            if parcel.left_out:
                self._say(
                    f"{parcel.left_out} file{'s' * (parcel.left_out > 1)} beside the DICOM images left out, as no image"
                )
            for upload in uploads:
                with self._presenter.shown(), self._opener.known_names():
                    self._open(upload, uploads, meant)
            for line in wrong:  # after a new patient, with whom the messages about the one before are gone
                self._presenter.view.showError(line)

    def _open(self, upload: Upload, beside: list[Upload], meant: str) -> None:
        if meant in (_CALIBRATION, _REGISTRATION):
            is_one = upload.kind in (Kind.TRANSFORM, Kind.POSE)
            require(is_one, f"{upload.name} is {upload.content.what}, expected the {meant} of tracked ultrasound")
            deed, take = self._transform_as(upload, meant)
        else:
            deed, take = self._took[upload.kind](upload, beside)
        try:
            told = take()
        finally:  # the patient is open even if his tissues are not found
            self._opener.keep(upload.path)
        deed = told if isinstance(told, str) else deed
        self._say(f"{upload.name}: {upload.content.what}: {deed}")

    def _say(self, line: str) -> None:
        with self._shared.changing() as now:
            now.opened = [*now.opened, self._opener.as_known(line)]

    def _choose_series(self, parcel: Parcel, series: list[Series]) -> None:
        """Take the only series that is a volume, or the one that the user chooses."""
        volumes = [one for one in series if one.is_volume]
        listing = "; ".join(f"{one.title}: {one.images}" for one in series[:12])
        require(
            bool(volumes),
            f"the DICOM files have no series with enough parallel images for a volume, expected one "
            f"({listing or 'none'})",
        )
        chosen = volumes[0]
        if len(volumes) > 1:
            patients = list(dict.fromkeys(one.patient for one in volumes))
            whose = f" of {len(patients)} different patients" if len(patients) > 1 else ""
            others = len(series) - len(volumes)
            more = f"; {others} more {'are no volumes' if others > 1 else 'is no volume'}" if others else ""
            number = self._ask(
                "Which series?",
                f"The DICOM files have {len(volumes)} series that are volumes{whose}{more}.",
                [
                    Choice(str(n), f"{one.title}: {one.images}{number}")
                    for n, one in enumerate(volumes)
                    for number in [f", patient {patients.index(one.patient) + 1}" * (len(patients) > 1)]
                ],
            )
            chosen = volumes[int(number)]
        elif len(series) > 1:
            self._say(f"the DICOM files have {len(series)} series, of which one is a volume: {chosen.title}")
        parcel.paths.insert(0, parcel.take(chosen, series))

    # ---- the patient -------------------------------------------------------------------------------------------

    def _mri(self, upload: Upload, beside: list[Upload]) -> tuple[str, Callable[[], object]]:
        parameters: Any = self._logic.parameters
        patient, is_ct = self._opener.patient(), upload.kind is Kind.CT
        contrast, before = CT if is_ct else parameters.segmentation.contrast, parameters.segmentation.contrast
        if not is_ct and before == CT:
            contrast = MRI_CONTRASTS[0]
        key = _NEW
        if self._loading.has_users_patient:
            choices = [Choice(_NEW, "New patient", f"{patient} is closed, with all that belongs to it")]
            if parameters.mri is None:
                choices.append(Choice(_SHOWN, f"Image of {patient}", "Shown under the labels, which stay"))
            elif not is_ct and before != CT:
                tip = "Registered to the first MRI and classified together with it by Segment"
                choices.append(Choice(_SECOND, f"Second MRI of {patient}", tip))
            key = self._ask_what(upload, choices)
        if key == _SECOND:
            return self._second(upload, patient)
        if key == _SHOWN:
            return f"shown as the image of {patient}", self._loading.reading_image(upload.path)
        is_with_labels = any(other.kind is Kind.LABELS for other in beside)
        then = "its labels came with it" if is_with_labels else f"segmented as {contrast}"
        if contrast != before:
            then += f" (before: {before})"
        closed = f"; {patient} is closed" if patient else ""
        return f"a new patient, {then}{closed}", self._loading.reading_mri(
            upload.path, contrast, then_segment=not is_with_labels
        )

    def _second(self, upload: Upload, patient: str) -> tuple[str, Callable[[], object]]:
        first = self._logic.parameters.segmentation.contrast
        contrast = self._ask(
            f"Contrast of {upload.name}?",
            f"The first MRI of {patient} is used as {first}.",
            [Choice(name, name) for name in MRI_CONTRASTS],
        )
        take = self._loading.reading_second(upload.path, contrast)
        return f"second MRI of {patient}, {contrast}; Segment uses it", take

    def _labels(self, upload: Upload, beside: list[Upload]) -> tuple[str, Callable[[], object]]:
        parameters: Any = self._logic.parameters
        patient = self._opener.patient()
        reading = self._loading.reading_labels
        came_along = any(other.kind in (Kind.MRI, Kind.CT) for other in beside)
        if not self._loading.has_users_patient or (came_along and self._loading.are_of_mri(upload.path)):
            return "tissues to simulate", reading(upload.path, self._table_of(upload), None)
        choices = [Choice(_NEW, "New patient", f"{patient} is closed, with all that belongs to it")]
        if parameters.mri is not None:
            choices.append(Choice(_OWN, f"Tissues of {patient}", "In place of its tissues; the MRI stays"))
        if parameters.mri is not None and parameters.segmentation.contrast == CT:
            choices.append(_organs_of(patient))
        key = self._ask_what(upload, choices)
        if key == _ORGANS:
            return self._organs(upload, patient)
        if key == _OWN:
            return f"tissues of {patient}", reading(upload.path, self._table_of(upload), True)
        return f"a new patient; {patient} is closed", reading(upload.path, self._table_of(upload), False)

    def _table_of(self, upload: Upload) -> LabelTable | None:
        """Its table, or the numbering that the user says where several fit."""
        schemes = {scheme.key: scheme for scheme in upload.content.schemes}
        if upload.table is not None or not schemes:
            return upload.table
        choices = [
            Choice(key, scheme.title, ", ".join(f"{n} {name}" for n, name in islice(scheme.names.items(), 4)))
            for key, scheme in schemes.items()
        ]
        key = self._ask(f"Numbers of {upload.name}?", f"{upload.name} is {upload.content.what}.", choices)
        return LabelTable(schemes[key].title, mapping=LabelMapping(scheme=key))

    def _organs(self, upload: Upload, patient: str) -> tuple[str, Callable[[], object]]:
        return f"organs of the CT {patient}; Segment uses them", self._loading.reading_organs(upload.path)

    def _mask(self, upload: Upload, beside: list[Upload]) -> tuple[str, Callable[[], object]]:
        """A mask, or lesions: of the patient, or a label map."""
        parameters: Any = self._logic.parameters
        patient = self._opener.patient()
        if not patient or upload.table is not None:  # whose table says what its labels are
            return self._labels(upload, beside)
        single = [name for name in LESIONS if name != _SEVERAL]
        tip = f"Laid over the tissues of {patient}"
        choices = [Choice(f"{_AS}{name}", f"Add as {name}", tip) for name in single]
        if upload.kind is Kind.LESIONS:
            choices.insert(0, Choice(f"{_AS}{_SEVERAL}", "Add its lesions by their names or numbers", tip))
        contrast = parameters.segmentation.contrast
        if parameters.mri is not None and upload.kind is Kind.MASK and has_brain_mask(contrast):
            tip = f"Segment makes the tissues of {patient} anew, inside the mask"
            choices.append(Choice(_BRAIN, "Use as brain mask", tip))
        if upload.kind is Kind.MASK and parameters.labels is not None:
            choices.append(Choice(_OPENING, "Use as opening of the skull", "Chosen for Open skull"))
        if parameters.mri is not None and contrast == CT:
            choices.append(_organs_of(patient))
        choices.append(Choice(_NEW, "Label map of a new patient", f"{patient} is closed"))
        key = self._ask_what(upload, choices)
        if key == _NEW:
            take = self._loading.reading_labels(upload.path, self._table_of(upload), False)
            return f"a new patient; {patient} is closed", take
        if key == _ORGANS:
            return self._organs(upload, patient)
        if key == _BRAIN:
            return f"brain mask of {patient}, whose tissues are made anew", self._loading.reading_brain(upload.path)
        if key == _OPENING:
            return f"opening of {patient}, used by Open skull", self._loading.reading_opening(upload.path)
        tissue = key.removeprefix(_AS)
        take = self._loading.reading_lesion(upload.path, tissue)
        what = "its lesions" if tissue == _SEVERAL else tissue
        return f"{what} of {patient}, over the tissues", take

    # ---- ultrasound and settings -------------------------------------------------------------------------------

    def _sequence(self, upload: Upload, beside: list[Upload]) -> tuple[str, Callable[[], object]]:
        patient = self._opener.patient()
        recording = self._registration.read(upload.path)
        with_whom = f"compared with {patient}" if patient else "compared with the patient who is opened next"
        deed = with_whom if recording.is_calibrated else "its calibration is asked for in Tracked ultrasound"
        return f"{recording.what}: {deed}", lambda: self._registration.take(recording)

    def _transform(self, upload: Upload, beside: list[Upload]) -> tuple[str, Callable[[], object]]:
        """A calibration, a registration or a pose: of these only two files say which they are."""
        name = upload.name.lower()
        if name.endswith(".xml"):
            key = _CALIBRATION
        elif name.endswith(".tag"):
            key = _REGISTRATION
        else:
            later = "" if self._registration.recording is not None else "; of the one that is opened next"
            choices = [
                Choice(_CALIBRATION, "Calibration", f"Of tracked ultrasound: from pixels to its probe{later}"),
                Choice(_REGISTRATION, "Registration", f"Of tracked ultrasound: from its frame to the patient{later}"),
            ]
            if self._logic.parameters.labels is not None and self._is_pose(upload):
                tip = f"The simulated probe is moved there, on {self._opener.patient()}"
                choices.append(Choice(_POSE, "Pose of the probe", tip))
            key = self._ask_what(upload, choices)
        if key == _POSE:
            return self._pose(upload, beside)
        if self._registration.recording is not None:
            return self._transform_as(upload, key)
        registration = self._registration
        if key == _CALIBRATION:
            take = registration.reading_calibration(upload.path, for_next=True)
        else:
            take = registration.reading_registration(upload.path, for_next=True)
        return f"{key} of the tracked ultrasound that is opened next", take

    def _is_pose(self, upload: Upload) -> bool:
        try:
            self._tasks.doAside(lambda: read_pose(upload.path))
        except Cancelled:
            raise
        except SimulationError:
            return False
        return True

    def _transform_as(self, upload: Upload, key: str) -> tuple[str, Callable[[], object]]:
        registration = self._registration
        require(
            registration.recording is not None,
            f"{upload.name}: {upload.content.what}, expected tracked ultrasound first, to which it belongs",
        )
        if key == _CALIBRATION:
            return "calibration of the tracked ultrasound", registration.reading_calibration(upload.path)
        return "registration of the tracked ultrasound", registration.reading_registration(upload.path)

    def _sheets(self, upload: Upload, beside: list[Upload]) -> tuple[str, Callable[[], object]]:
        sheets = self._opener.sheets(upload.path)
        return "shown in the images", lambda: setattr(self._logic.parameters, "sheets", sheets)

    def _preset(self, upload: Upload, beside: list[Upload]) -> tuple[str, Callable[[], object]]:
        preset = self._tasks.doAside(lambda: Preset.read(upload.path))
        moves = "" if preset.probe_to_ras is None else "; the probe is moved to its pose"
        return f"in place of the settings of before{moves}", lambda: self._presenter.values.takePreset(preset)

    def _pose(self, upload: Upload, beside: list[Upload]) -> tuple[str, Callable[[], object]]:
        pose = self._tasks.doAside(lambda: read_pose(upload.path))
        return "the probe is moved there", lambda: self._poses.set(pose)

    def _points(self, upload: Upload, beside: list[Upload]) -> tuple[str, Callable[[], object]]:
        path, parameters = upload.path, self._logic.parameters
        kind, points = self._tasks.doAside(lambda: markup_points(path, POLYGONS, "a closed curve or a list of points"))
        require(len(points) > 0, f"{upload.name}: has no point that was placed, expected one or more")
        if kind == "Fiducial":
            deed = "the last one is chosen as the point of a lesion; Craniotomy has them, too, for an opening"
            return deed, lambda: setattr(parameters, "seed", self._opener.points(path, points))
        return "chosen as the opening of a craniotomy", self._loading.reading_opening(path)

    def _scene(self, upload: Upload, beside: list[Upload]) -> tuple[str, Callable[[], object]]:
        opened = self.open_scene
        if opened is None:
            raise SimulationError(
                f"{upload.name}: {upload.content.what}, expected a file of a patient, tracked ultrasound or settings"
            )
        if self._loading.has_users_patient:
            patient = self._opener.patient()
            self._ask_what(
                upload, [Choice(_NEW, "The patient of the scene", f"{patient} is closed, with all that belongs to it")]
            )
        return "shown as it was", lambda: opened(upload.path)

    # ---- questions ---------------------------------------------------------------------------------------------

    def _ask_what(self, upload: Upload, choices: list[Choice]) -> str:
        return self._ask(f"Open {upload.name} as?", f"{upload.name} is {upload.content.what}.", choices)

    def _ask(self, title: str, text: str, choices: list[Choice]) -> str:
        """The key of the answer. Raises SimulationError if the patient about whom was asked is not open any more."""
        patient = self._opener.patient()
        key = self._questions.ask(title, self._opener.as_known(text), choices)
        now = self._opener.patient()
        require(now == patient, f"{patient or 'no patient'} was open for this question, and now {now or 'none'} is")
        return key


def _organs_of(patient: str) -> Choice:
    return Choice(_ORGANS, f"Organs of the CT {patient}", "They replace muscle and blood when Segment is pressed")
