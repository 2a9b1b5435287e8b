"""OpenPatient: the patient on the page: replaced, added to, segmented, closed, and what of him is not saved."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.given_mask import follows
from SlicerUSSim.Logic.mrml.label_nodes import labels_version
from SlicerUSSim.Logic.mrml.lesion_nodes import add_lesion
from SlicerUSSim.Logic.mrml.nodes import read_volume, remove_patient_nodes
from SlicerUSSim.Logic.mrml.scene_record import SequenceRecord
from SlicerUSSim.Logic.mrml.taken_image import patient_of
from SlicerUSSim.Logic.mrml.taken_sequence import FrozenRecord, version_taken
from SlicerUSSim.Logic.tissue.label_maps import LabelledTissues
from SlicerUSSim.Workstation.anatomy import AnatomyViews
from SlicerUSSim.Workstation.browser_panel import BrowserPanel
from SlicerUSSim.Workstation.comparison import Comparison
from SlicerUSSim.Workstation.file_nodes import FILE, FileNodes, Files
from SlicerUSSim.Workstation.pose_registration import Registration
from SlicerUSSim.Workstation.probe_control import ProbeControl

#: Roles of nodes of a patient
_OF_PATIENT = (
    "mri", "labels", "mask", "second_mri", "lesions", "organs", "sheets", "seed", "opening", "real",
    "transform_sequence", "image_sequence",
)  # fmt: skip


class OpenPatient:
    """Replaces the patient, or adds data of the same patient. All methods run in a task."""

    def __init__(
        self, panel: BrowserPanel, nodes: FileNodes, views: AnatomyViews, probe: ProbeControl, comparison: Comparison,
        registration: Registration,
    ) -> None:  # fmt: skip
        self._shared, self._logic, self._scene, self._tasks = panel.shared, panel.logic, panel.logic.scene, panel.tasks
        self._panel, self._presenter, self._nodes = panel, panel.presenter, nodes
        self._views, self._probe, self._comparison = views, probe, comparison
        self._registration = registration
        self._is_new = False  # a patient was opened, and the probe is not placed yet
        #: {what was made here: its version in the last scene that was saved or opened}
        self._saved: dict[str, Hashable] = {}

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
                self._choose_mri(self._nodes.mri(files.mri))
            if files.mask is not None:
                parameters.mask = self._nodes.brain_mask(files.mask, parameters.mri)
            for contrast, path in list(files.also.items())[:1]:  # the panel has one
                self.take_second(self._nodes.second_mri(path), contrast)
            if files.organs is not None:
                self.take_organs(*self._nodes.organs(files.organs, files.maps))
            parameters.sheet = files.sheet_settings
            if files.sheets is not None:
                parameters.sheets = self._nodes.sheets(files.sheets)
            for tissue, path in files.additions:
                with self._added(self._nodes.lesions(path), tissue, path):
                    pass
            if files.labels is not None:
                self.take_labels(*self._nodes.labels(files.labels), are_of_patient=True)
                if files.additions:
                    self.then_show(self._presenter.lesions.addTissues)
            else:
                self.segment()
            self._open_at_start(files)
            if files.sequence is not None:
                sequence = SequenceRecord(files.sequence, files.sequence_name, files.transform, files.to_ras)
                self._registration.take(sequence)
            elif files.preset is not None and files.preset.probe_to_ras is not None:
                self._presenter.values.takePreset(files.preset)

    @property
    def name(self) -> str:
        """Name of the patient of the chosen labels, or of the MRI if there are none; "" without either."""
        labels, mri = self._logic.parameters.labels, self._logic.parameters.mri
        if labels is not None:
            return patient_of(labels)
        return "" if mri is None else patient_of(mri)

    @property
    def is_of_user(self) -> bool:
        """Whether a patient is open, other than the unchanged demo brain."""
        parameters: Any = self._logic.parameters
        is_demo = parameters.mri is not None and parameters.mri.GetAttribute(FILE) == ""
        mine = (parameters.lesions, parameters.mask, parameters.second_mri)
        is_untouched = all(node is None or self._logic.isOwnBrain(node) for node in mine)
        return bool(self.name) and not (is_demo and is_untouched)

    # ---- what is not saved -------------------------------------------------------------------------------------

    @property
    def unsaved(self) -> tuple[str, ...]:
        """What was made on the page, and is in no file and no saved scene."""
        return tuple(what for what, version in self._made().items() if version != self._saved.get(what))

    def saved(self) -> None:
        """Called when all that was made on the page is in a file."""
        self._saved = self._made()

    def _made(self) -> dict[str, Hashable]:
        """{what is made on the page: a value that changes with it} of what there is."""
        parameters: Any = self._logic.parameters
        labels, lesions, images = parameters.labels, parameters.lesions, version_taken(parameters.image_sequence)
        made: dict[str, Hashable] = {}
        if lesions is not None and lesions.GetSegmentation().GetNumberOfSegments():
            made["lesions"] = lesions.GetID(), tuple(lesions.GetSegmentation().GetSegmentIDs())
        if labels is not None and self._logic.closedLabels(labels) is not labels:
            made["the opening of the skull"] = labels_version(labels)
        if images is not None:
            made["the images of Simulate sequence"] = images
        return made

    # ---- a new patient, and more of the same one ---------------------------------------------------------------

    def take_mri(self, node: Any, contrast: str, then_segment: bool) -> bool:
        """Take the MRI or CT of a new patient; whether the tissues are known, if they are to be found."""
        parameters = self._logic.parameters
        self._panel.clearErrors()
        self._choose_mri(node)
        if parameters.segmentation.contrast != contrast:
            parameters.segmentation = replace(parameters.segmentation, contrast=contrast)
        return not then_segment or self.segment()

    def show_image(self, node: Any) -> None:
        """Take the MRI or CT of a patient whose labels alone are open."""
        self._logic.parameters.mri = node
        self._views.show_volume(node)

    def take_second(self, node: Any, contrast: str) -> None:
        """Take a second MRI of the patient."""
        parameters = self._logic.parameters
        parameters.second_mri = node
        parameters.panel = replace(parameters.panel, second_contrast=contrast)

    def take_labels(self, node: Any, found: LabelledTissues, *, are_of_patient: bool) -> None:
        """Take a label map: of the patient, whose MRI stays, or of a new one."""
        parameters: Any = self._logic.parameters
        lines = [f"{node.GetName()}: {found.message}", *(f"Check: {warning}" for warning in found.warnings)]
        if are_of_patient and parameters.mri is not None:
            name, volume = parameters.mri.GetName(), read_volume(parameters.mri)
            if not self._tasks.doAside(lambda: follows(volume, found.labels)):
                lines.append(f"Check: the intensities of {name} do not follow the labels (of another patient?)")
        elif not are_of_patient:
            self.begin_patient(node)
        if parameters.mri is None:
            self._views.show_volume(node)
        parameters.labels = node
        self._presenter.notes.set(*lines)
        for warning in found.warnings:
            self._panel.showError(warning)
        self.labels_ready()

    def take_organs(self, node: Any, found: LabelledTissues) -> None:
        """Choose the label map of organs of a CT, which Segment uses."""
        self._logic.parameters.organs = node
        self._presenter.notes.set(f"{node.GetName()}: {found.message}; Segment uses it with the contrast ct")

    def lay(self, mask: Volume, tissue: str, name: str) -> None:
        """Add a mask of a file to the lesions, and lay them over the tissues; without tissues Segment does so."""
        with self._added(mask, tissue, name):
            if self._logic.parameters.labels is not None:
                self.then_show(self._presenter.lesions.layLesions)

    @contextmanager
    def _added(self, mask: Volume, tissue: str, name: str) -> Iterator[None]:
        """Add a mask of a file to the lesions; after an error in the block it is taken out of them again."""
        parameters: Any = self._logic.parameters
        before = parameters.lesions
        with self._presenter.made(before, "Segmentation", "Lesions") as node:
            ids = add_lesion(node, mask, tissue, name)
            try:
                parameters.lesions = node
                yield
            except SimulationError:
                parameters.lesions = before
                for segment_id in ids:
                    node.GetSegmentation().RemoveSegment(segment_id)
                raise

    # ---- actions of the panel ----------------------------------------------------------------------------------

    def segment(self) -> bool:
        """Segment the MRI into tissues, and place a probe on the patient if there is none; whether that was done."""
        return self.then_show(self._presenter.segmenting.segment)

    def undo_segment(self) -> None:
        """Go back to the tissues from before the last Segment; tissues that were chosen since do not change."""
        chosen = self._logic.parameters.labels
        self.then_show(self._presenter.segmenting.undoSegment)
        if chosen is not None and self._logic.parameters.labels is None:
            self._logic.clearImage(self._logic.parameters.output)
            self._probe.forget_patient()
            self._views.show_volume(self._logic.parameters.mri)
        self.show_title()

    def then_show(self, action: Callable[[], None]) -> bool:
        """Run an action, and show the image of the labels if it has changed them; whether it has."""

        def version() -> Hashable:
            labels = self._logic.parameters.labels
            return None if labels is None else labels_version(labels)

        before = version()
        action()
        is_changed = version() not in (before, None)
        if is_changed:
            self.labels_ready()
        return is_changed

    def place(self, action: Callable[[], object]) -> None:
        """Run an action that places the probe, and look at it."""
        action()
        self._probe.look()

    def show_title(self) -> None:
        """Show the name of the patient on the page."""
        with self._shared.changing() as now:
            now.title = self.name

    def _open_at_start(self, files: Files) -> None:
        """Open what --craniotomy asks for, and place the probe on the brain in it, as commands do."""
        parameters: Any = self._logic.parameters
        if files.craniotomy == "none" or parameters.labels is None:
            return
        parameters.panel = replace(parameters.panel, craniotomy_mm=files.craniotomy_mm)
        placing = self._presenter.placing
        if files.craniotomy not in ("auto", "disc:"):
            parameters.opening = self._nodes.opening(files.craniotomy)
            self.then_show(placing.openCraniotomy)
            self.place(placing.placeProbe)
            return
        self._logic.placeProbe(parameters.labels, parameters.probe_transform, will_open=True)
        self.then_show(placing.openCraniotomy)

    # ---- the patient before ------------------------------------------------------------------------------------

    def close(self) -> None:
        """Close the patient: nothing of him stays on the page, in the scene or in memory; settings stay."""
        parameters = self._logic.parameters
        with self._presenter.acting():
            self._panel.clearErrors()
            self._forget()
            parameters.mri = parameters.labels = parameters.mask = parameters.second_mri = None
            self._presenter.notes.set()
            self.show_title()

    def begin_patient(self, *nodes: Any) -> None:
        """Close the patient before; `nodes` are all of the next one."""
        self._panel.clearErrors()
        self._forget(*nodes)

    def _choose_mri(self, node: Any) -> None:
        self._forget(node)
        self._logic.parameters.mri = node
        self._presenter.notes.set()
        self.show_title()
        self._views.show_volume(node)

    def _forget(self, *new: Any) -> None:
        """Show, choose and keep nothing of the patient before, when another one is opened; `new` are nodes of his."""
        parameters = self._logic.parameters
        self._logic.stopLiveUpdate()
        self._logic.clearImage(parameters.output)
        self._logic.clearOutline(parameters.outline)
        # Ultrasound that was opened before any patient of the user belongs to this one
        kept = [] if self.is_of_user else list(self._registration.nodes)
        if self.is_of_user:
            self.forget_ultrasound()
        self._probe.forget_patient()
        if parameters.probe_transform is not None and self._registration.recording is None:
            self._probe.move(np.eye(4))  # placed on the next patient; a saved scene has no pose of the previous one
        self._presenter.forgetPatient()
        self._saved = {}
        kept += [parameters.output, parameters.outline, parameters.probe_transform, *new]
        for role in _OF_PATIENT:
            node: Any = getattr(parameters, role)
            if node not in kept:
                setattr(parameters, role, None)
        remove_patient_nodes(self._scene, kept)
        with self._shared.changing() as now:
            now.fit.curve = []
        self._is_new = True

    def forget_ultrasound(self) -> None:
        """Forget the tracked ultrasound, also what was opened before the patient."""
        self._comparison.drop()
        self._registration.forget()

    # ---- the first image ---------------------------------------------------------------------------------------

    def show_restored(self, *, is_placed: bool, frozen: FrozenRecord | None = None) -> None:
        """Show the nodes that were chosen, and a `frozen` image; the probe `is_placed`, or is now if there are tissues.

        Without such an image live ones begin.
        """
        parameters: Any = self._logic.parameters
        self._views.show_volume(parameters.labels if parameters.mri is None else parameters.mri)
        self.show_title()
        if parameters.labels is not None:
            self.labels_ready(is_placed=is_placed, frozen=frozen)
        self.saved()

    def labels_ready(self, *, is_placed: bool = False, frozen: FrozenRecord | None = None) -> None:
        """Show the image of new labels, or a `frozen` one of them.

        The probe `is_placed`, or is placed now if the patient is new.
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
