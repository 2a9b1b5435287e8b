"""Loading: reads MRI, labels and sequences from files, segments the MRI and places the probe."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.given_mask import checked_mask, follows
from SlicerUSSim.Logic.mrml.label_nodes import labels_version
from SlicerUSSim.Logic.mrml.nodes import nodes_of_class, pose_in_labels, probe_pose, read_volume
from SlicerUSSim.Logic.mrml.taken_sequence import FrozenRecord
from SlicerUSSim.Logic.placement.craniotomy import disc_diameter_mm
from SlicerUSSim.Logic.tissue.label_maps import LabelledTissues, as_whole
from SlicerUSSim.Workstation.anatomy import AnatomyViews
from SlicerUSSim.Workstation.browser_panel import BrowserPanel
from SlicerUSSim.Workstation.comparison import Comparison
from SlicerUSSim.Workstation.content import Kind
from SlicerUSSim.Workstation.opener import FILE, Files, LabelTable, Opener
from SlicerUSSim.Workstation.pose_registration import Recording, Registration
from SlicerUSSim.Workstation.probe_control import ProbeControl
from SlicerUSSim.Workstation.script import LabelSource
from SlicerUSSim.Workstation.state import ORGANS

#: Roles of nodes of a patient
_OF_PATIENT = (
    "mri", "labels", "mask", "second_mri", "lesions", "organs", "sheets", "seed", "opening", "real",
    "transform_sequence", "image_sequence",
)  # fmt: skip
#: What is of a patient: images, labels, surfaces, points, recordings, the costs of a fit
_PATIENT_CLASSES = (
    "vtkMRMLSequenceBrowserNode", "vtkMRMLSequenceNode", "vtkMRMLVolumeNode", "vtkMRMLSegmentationNode",
    "vtkMRMLModelNode", "vtkMRMLMarkupsNode", "vtkMRMLTransformNode", "vtkMRMLPlotChartNode", "vtkMRMLPlotSeriesNode",
    "vtkMRMLTableNode",
)  # fmt: skip


class Loading:
    """Replaces the patient, or adds data of the same patient. All methods run in a task."""

    def __init__(
        self, panel: BrowserPanel, opener: Opener, views: AnatomyViews, probe: ProbeControl, comparison: Comparison,
        registration: Registration,
    ) -> None:  # fmt: skip
        self._shared, self._logic, self._scene, self._tasks = panel.shared, panel.logic, panel.logic.scene, panel.tasks
        self._panel, self._presenter, self._opener = panel, panel.presenter, opener
        self._views, self._probe, self._comparison = views, probe, comparison
        self._registration = registration
        self._is_new = False  # a patient was opened, on whom the probe is not yet
        self._source_before: LabelSource | None = None  # of the labels before the last Segment
        self._dropped = ""  # name of an MRI that was closed for labels that are not of it

    def begin(self, files: Files) -> None:
        """Load the files with which the workstation was started, and show the first image."""
        parameters = self._logic.parameters
        with self._presenter.shown():
            if files.preset is not None:
                self._logic.preset = replace(files.preset, probe_to_ras=None)
            parameters.segmentation = replace(
                parameters.segmentation, contrast=files.contrast, skull_strip=files.skull_strip, outside=files.outside
            )
            if files.mri is not None or files.labels is None:
                self._take_mri(self._opener.mri(files.mri))
            if files.mask is not None:
                parameters.mask = self._opener.mask(files.mask)
            for contrast, path in list(files.also.items())[:1]:  # the panel has one
                parameters.second_mri = self._opener.second_mri(path)
                parameters.panel = replace(parameters.panel, second_contrast=contrast)
            if files.organs is not None:
                self._take_organs(*self._opener.organs(files.organs, files.maps))
            parameters.sheet = files.sheet_settings
            if files.sheets is not None:
                parameters.sheets = self._opener.sheets(files.sheets)
            for tissue, path in files.additions:
                parameters.lesions = self._opener.lesion_of_file(parameters.lesions, tissue, path)
            if files.labels is not None:
                node, found = self._opener.labels(files.labels)
                self._take_labels(node, found, self._mri_of(found.labels))
                if files.additions:
                    self.lay(self._presenter.lesions.addTissues)
            else:
                self.segment()
            self._open_at_start(files)
            if files.sequence is not None:
                recording = Recording(files.sequence, files.sequence_name, files.transform)
                self._registration.take(recording, files.to_ras)
            elif files.preset is not None and files.preset.probe_to_ras is not None:
                self._presenter.values.takePreset(files.preset)

    @property
    def has_users_patient(self) -> bool:
        """Whether a patient is open, other than the demo brain as it is."""
        parameters: Any = self._logic.parameters
        is_demo = parameters.mri is not None and parameters.mri.GetAttribute(FILE) == ""
        mine = (parameters.lesions, parameters.mask, parameters.second_mri)
        is_untouched = all(node is None or self._logic.isOwnBrain(node) for node in mine)
        return bool(self._opener.patient()) and not (is_demo and is_untouched)

    # ---- files of a page: each is read, and then taken without anything that can fail or be cancelled --------------

    def reading_mri(self, path: str, contrast: str, then_segment: bool) -> Callable[[], str | None]:
        """Of a new patient, segmented with this contrast; what is done says so if that fails."""
        with self._reading(path):
            mri = self._opener.mri(path)

        def take() -> str | None:
            parameters = self._logic.parameters
            self._panel.clearErrors()
            self._take_mri(mri)
            if parameters.segmentation.contrast != contrast:
                parameters.segmentation = replace(parameters.segmentation, contrast=contrast)
            return None if not then_segment or self.segment() else "a new patient, whose tissues were not found"

        return take

    def reading_image(self, path: str) -> Callable[[], None]:
        """The MRI or CT of a patient of whom only labels are open."""
        with self._reading(path):
            mri = self._opener.mri(path)

        def take() -> None:
            self._logic.parameters.mri = mri
            self._views.show_volume(mri)

        return take

    def reading_second(self, path: str, contrast: str) -> Callable[[], None]:
        """A second MRI of the patient."""
        with self._reading(path):
            mri = self._opener.second_mri(path)

        def take() -> None:
            parameters = self._logic.parameters
            parameters.second_mri = mri
            parameters.panel = replace(parameters.panel, second_contrast=contrast)

        return take

    def reading_labels(self, path: str, table: LabelTable | None, are_of_patient: bool | None) -> Callable[[], None]:
        """A label map: of the patient, whose MRI stays; of a new one; None: of the MRI that is there if it follows."""
        with self._reading(path):
            node, found = self._opener.labels(path, table)
            mri: Any = self._logic.parameters.mri
            follow = self._mri_of(found.labels)
            kept = follow if are_of_patient is None else []

        def take_own() -> None:
            self._logic.parameters.labels = node
            checks = [f"Check: {warning}" for warning in found.warnings]
            if mri is not None and not follow:
                checks.append(
                    f"Check: the intensities of {mri.GetName()} do not follow the labels (of another patient?)"
                )
            elif mri is not None:
                checks.append(_of_mri(mri))
            self._presenter.notes.set(f"{node.GetName()}: {found.message}", *checks)
            for warning in found.warnings:
                self._presenter.view.showError(warning)
            self.show_title()
            self.labels_ready()

        def take() -> None:
            self._panel.clearErrors()
            self.forget_patient(node, *kept)
            if are_of_patient is False:
                self._dropped = ""  # the user said that it is another patient's
            self._take_labels(node, found, kept)

        return take_own if are_of_patient else take

    def are_of_mri(self, path: str) -> bool:
        """Whether the intensities of the MRI follow a label map, as those of the same head do."""
        mri: Any = self._logic.parameters.mri
        if mri is None:
            return False
        volume = read_volume(mri)
        with self._reading(path):
            labels = self._opener.peek(path)
            try:
                whole = as_whole(labels, path)
            except SimulationError:  # probabilities
                return False
            return self._tasks.doAside(lambda: follows(volume, whole))

    def reading_organs(self, path: str) -> Callable[[], None]:
        """The organs of the CT."""
        with self._reading(path):
            organs = self._opener.organs(path)
        return lambda: self._take_organs(*organs)

    def reading_brain(self, path: str) -> Callable[[], str | None]:
        """A brain mask on the grid of the MRI, with which it is segmented again."""
        with self._reading(path):
            volume, mri = self._opener.peek(path), read_volume(self._logic.parameters.mri)
            self._tasks.doAside(lambda: checked_mask(volume, mri))
            node = self._opener.mask(path)

        def take() -> str | None:
            self._logic.parameters.mask = node
            return None if self.segment() else "brain mask, with which no tissues were found"

        return take

    def reading_opening(self, path: str) -> Callable[[], None]:
        """An opening of skin and skull."""
        with self._reading(path):
            node = self._opener.opening(path)
        return lambda: setattr(self._logic.parameters, "opening", node)

    def reading_lesion(self, path: str, tissue: str) -> Callable[[], None]:
        """Lesions, laid over the tissues."""
        with self._reading(path):
            mask, file = self._opener.lesion(path)
        return lambda: self._lay(mask, tissue, Path(path).name, file)

    def add(self, name: str, content: bytes, tissue: str) -> None:
        """Add a mask sent by a page to the lesions, and lay them over the tissues."""
        if tissue == ORGANS:
            with self._presenter.shown(), self._opener.sent({name: content}) as parcel:
                (upload, *_), _ = self._opener.uploads(parcel)
                require(upload.kind in (Kind.LABELS, Kind.MASK), f"{name} is no label map, expected one of organs")
                self._take_organs(*self._opener.organs(upload.path))
            return
        with self._presenter.shown(), self._opener.uploaded_mask(name, content) as (mask, file):
            self._lay(mask, tissue, name, file)

    def _reading(self, path: str) -> AbstractContextManager[object]:
        return self._presenter.view.progress(f"Open {Path(path).name}")

    def segment(self) -> bool:
        """Segment the MRI into tissues, and place a probe on the patient if there is none; whether that was done."""
        parameters: Any = self._logic.parameters
        # A mask that Segment extracted is found again by the same options.
        mask = None if self._logic.isOwnBrain(parameters.mask) else parameters.mask
        inputs = parameters.mri, mask, asdict(parameters.segmentation)
        contrast = parameters.panel.second_contrast
        others = {} if parameters.second_mri is None or contrast == "none" else {contrast: parameters.second_mri}
        lesions, organs = parameters.lesions, parameters.organs
        kinds = parameters.sheet.kinds if parameters.sheet.find else ()
        before = self._opener.known_source(parameters.labels)
        if not self._changed(self._presenter.segmenting.segment):
            return False
        self._source_before = before
        self._opener.segmented(parameters.labels, *inputs, others, lesions, kinds, organs)
        self.labels_ready()
        return True

    def undo_segment(self) -> None:
        """Go back to the tissues from before the last Segment; others that were chosen since stay as they are."""
        chosen = self._logic.parameters.labels
        is_changed = self._changed(self._presenter.segmenting.undoSegment)
        labels: Any = self._logic.parameters.labels
        if chosen is not None and labels is None:
            self._logic.clearImage(self._logic.parameters.output)
            self._probe.forget_patient()
            self._views.show_volume(self._logic.parameters.mri)
        elif is_changed:
            self._opener.restored(self._source_before, labels)
            self.labels_ready()
        self.show_title()

    def lay(self, action: Callable[[], None]) -> None:
        """Run an action that lays the lesions over the tissues."""
        source, patient = self._opener.known_source(self._logic.parameters.labels), self._opener.patient()
        if self._changed(action):
            self._laid(source, patient)

    def open_craniotomy(self) -> None:
        """Open skin and skull under the probe, or where the chosen node says."""
        parameters: Any = self._logic.parameters
        labels, patient = parameters.labels, self._opener.patient()
        source = None if labels is None else self._opener.known_source(self._logic.closedLabels(labels))
        if self._changed(self._presenter.placing.openCraniotomy):
            disc = None
            if parameters.opening is None:
                pose, _ = pose_in_labels(parameters.labels, probe_pose(parameters.probe_transform))
                diameter = parameters.panel.craniotomy_mm or disc_diameter_mm(self._logic.preset.probe)
                disc = diameter, pose
            self._opener.opened(source, patient, parameters.labels, disc)
            self.labels_ready()

    def _open_at_start(self, files: Files) -> None:
        """Open what --craniotomy asks for, and place the probe on the brain in it, as commands do."""
        parameters: Any = self._logic.parameters
        if files.craniotomy == "none" or parameters.labels is None:
            return
        parameters.panel = replace(parameters.panel, craniotomy_mm=files.craniotomy_mm)
        if files.craniotomy not in ("auto", "disc:"):
            parameters.opening = self._opener.opening(files.craniotomy)
            self.open_craniotomy()
            self.place(self._presenter.placing.placeProbe)
            return
        self._logic.placeProbe(parameters.labels, parameters.probe_transform, will_open=True)
        self.open_craniotomy()

    def close_craniotomy(self) -> None:
        """Go back to the labels without the opening."""
        if self._changed(self._presenter.placing.closeCraniotomy):
            self.labels_ready()

    def place(self, action: Callable[[], None]) -> None:
        """Run an action that places the probe, and look at it."""
        action()
        self._probe.look()

    def show_title(self) -> None:
        """Show the name of the patient on the page."""
        title = self._opener.patient()
        if self._shared.now.title != title:
            with self._shared.changing() as now:
                now.title = title

    # ---- implementation ----------------------------------------------------------------------------------------

    def _lay(self, mask: Volume, tissue: str, name: str, file: str) -> None:
        """Add a mask of a file to the lesions, and lay them over the tissues; without tissues Segment does so."""
        parameters: Any = self._logic.parameters
        before, source, patient = (
            parameters.lesions, self._opener.known_source(parameters.labels), self._opener.patient()
        )  # fmt: skip
        node, undo = self._opener.add_lesion(before, mask, tissue, name, file)
        parameters.lesions = node
        try:
            if parameters.labels is not None:
                self._presenter.lesions.layLesions()
        except SimulationError:
            undo()
            parameters.lesions = before
            raise
        if parameters.labels is not None:
            self._laid(source, patient)

    def _laid(self, source: LabelSource | None, patient: str) -> None:
        """The lesions now lie over labels of this source and patient."""
        parameters = self._logic.parameters
        self._opener.added(source, patient, parameters.labels, parameters.lesions)
        self.labels_ready()

    def _changed(self, action: Callable[[], None]) -> bool:
        """Whether an action has written labels."""

        def version() -> Hashable:
            labels = self._logic.parameters.labels
            return None if labels is None else labels_version(labels)

        before = version()
        action()
        return version() not in (before, None)

    def _take_labels(self, node: Any, found: LabelledTissues, mris: Sequence[Any] = ()) -> None:
        """Choose labels; `mris` are the MRIs that they may be of, see _mri_of."""
        parameters: Any = self._logic.parameters
        for warning in found.warnings:
            self._presenter.view.showError(warning)
        checks = [f"Check: {warning}" for warning in found.warnings]
        if mris:
            checks.append(_of_mri(mris[0]))
        elif self._dropped:
            checks.append(
                f"Check: the MRI {self._dropped} was closed: its intensities do not follow the labels (of another "
                "patient?)"
            )
        self._dropped = ""
        if not mris and parameters.mri is not None:
            dropped = parameters.mri
            parameters.mri = parameters.mask = parameters.second_mri = None
            self._scene.RemoveNode(dropped)
        elif mris:
            parameters.mri = mris[0]
        self._views.show_volume(node if parameters.mri is None else parameters.mri)
        parameters.labels = node
        self._presenter.notes.set(f"{node.GetName()}: {found.message}", *checks)
        self.show_title()
        self.labels_ready()

    def _mri_of(self, labels: Volume) -> list[Any]:
        """The MRI if it follows the labels; otherwise it may be of another patient."""
        mri: Any = self._logic.parameters.mri
        self._dropped = ""
        if mri is None:
            return []
        volume = read_volume(mri)
        if self._tasks.doAside(lambda: follows(volume, labels)):
            return [mri]
        self._dropped = mri.GetName()
        return []

    def _take_organs(self, node: Any, found: LabelledTissues) -> None:
        """Choose the label map of organs of a CT, which Segment uses."""
        self._logic.parameters.organs = node
        self._presenter.notes.set(f"{node.GetName()}: {found.message}; Segment uses it with the contrast ct")

    def close_patient(self) -> None:
        """Close the patient: nothing of him stays on the page, in the scene or in memory; settings stay."""
        parameters = self._logic.parameters
        with self._presenter.acting():
            self._panel.clearErrors()
            self.forget_patient()
            parameters.mri = parameters.labels = parameters.mask = parameters.second_mri = None
            self._presenter.notes.set()
            self.show_title()

    def forget_patient(self, *new: Any) -> None:
        """Show, choose and keep nothing of the patient before, when another one is opened; `new` are nodes of his."""
        parameters = self._logic.parameters
        self._logic.stopLiveUpdate()
        self._logic.clearImage(parameters.output)
        self._logic.clearOutline(parameters.outline)
        # Ultrasound that was opened before any patient of the user's is of this one
        kept = [] if self.has_users_patient else self._registration.nodes
        if self.has_users_patient:
            self._forget_ultrasound()
        self._probe.forget_patient()
        if parameters.probe_transform is not None and self._registration.recording is None:
            self._probe.move(np.eye(4))  # it is placed on the next one; a saved scene has no pose of the one before
        self._presenter.forgetPatient()
        self._opener.forget_patient(*new)
        kept += [parameters.output, parameters.outline, parameters.probe_transform, *new]
        for role in _OF_PATIENT:
            node: Any = getattr(parameters, role)
            if node not in kept:
                setattr(parameters, role, None)
        _remove_patient_nodes(self._scene, kept)
        with self._shared.changing() as now:
            now.fit.curve, now.fit.costs = [], ""
        self._is_new = True

    def _forget_ultrasound(self) -> None:
        self._comparison.drop()
        self._registration.forget()

    def _take_mri(self, node: Any) -> None:
        parameters = self._logic.parameters
        self.forget_patient(node)
        parameters.mri = node
        self._presenter.notes.set()
        self.show_title()
        self._views.show_volume(node)

    def begin_patient(self, *nodes: Any) -> None:
        """Close the patient before, also the ultrasound that was opened before him; `nodes` are all of the next one."""
        self._panel.clearErrors()
        self._forget_ultrasound()
        self.forget_patient(*nodes)

    def show_number(self, number: int) -> None:
        """Show the real image with this index, and move the probe there."""
        self._comparison.show(number)

    def show_restored(self, *, is_placed: bool, frozen: FrozenRecord | None = None) -> None:
        """Show the nodes that were chosen, and a `frozen` image; the probe `is_placed`, or is now if there are tissues.

        Without such an image live ones begin.
        """
        parameters: Any = self._logic.parameters
        self._views.show_volume(parameters.labels if parameters.mri is None else parameters.mri)
        self.show_title()
        if parameters.labels is not None:
            self.labels_ready(is_placed=is_placed, frozen=frozen)

    def labels_ready(self, *, is_placed: bool = False, frozen: FrozenRecord | None = None) -> None:
        """Show the image of new labels, or a `frozen` one of them.

        The probe `is_placed`, or is placed now if they are of a new patient.
        """
        if self._logic.parameters.probe_transform is None or (self._is_new and not is_placed):
            self._presenter.placing.placeProbe()
        self._is_new = False
        self.show_title()
        if frozen is not None:
            self._presenter.images.showFrozen(frozen)
        elif not self._logic.isLive:
            self._presenter.images.setLive(True)
        self._probe.update_surface()  # after the start of live images, which do not need it
        self._probe.look()


def _of_mri(mri_node: Any) -> str:
    return f"of the MRI {mri_node.GetName()}, which is shown: its intensities follow the labels"


def _remove_patient_nodes(scene, kept: Iterable[Any]) -> None:
    """Remove all nodes of these classes, with what displays and stores them, except those that are kept.

    Nodes that are not saved with the scene belong to the views and stay. The scene is the workstation's own: nobody
    else puts nodes into it.
    """
    ids = {node.GetID() for node in kept if node is not None}
    for name in _PATIENT_CLASSES:
        for node in nodes_of_class(scene, name):
            # One may be gone together with another one before
            if node.GetSaveWithScene() and node.GetScene() is not None and node.GetID() not in ids and _is_data(node):
                for helper in _helpers(node):
                    scene.RemoveNode(helper)
                scene.RemoveNode(node)


def _is_data(node) -> bool:
    """Not a model of a slice view, which Slicer makes and needs."""
    return (not (node.GetName() or "").endswith("Volume Slice") and not node.GetHideFromEditors()) or _is_shares(node)


def _is_shares(node) -> bool:
    return node.GetAttribute("SlicerUSSim.sharesOf") is not None


def _helpers(node) -> list[Any]:
    """Display and storage nodes, and the colours of labels."""
    displays = range(node.GetNumberOfDisplayNodes()) if node.IsA("vtkMRMLDisplayableNode") else ()
    stores = range(node.GetNumberOfStorageNodes()) if node.IsA("vtkMRMLStorableNode") else ()
    found = [node.GetNthDisplayNode(number) for number in displays]
    found += [node.GetNthStorageNode(number) for number in stores]
    found.append(node.GetNodeReference("tissueColors"))
    return [helper for helper in found if helper is not None]
