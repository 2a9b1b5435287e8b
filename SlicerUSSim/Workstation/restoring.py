"""Restoring: offers the last session of a server that was killed, and puts kept sessions and scenes into the scene."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image

from SlicerUSSim.Logic.base.errors import SimulationError, require, required
from SlicerUSSim.Logic.base.transforms import check_rigid
from SlicerUSSim.Logic.fitting.tracked_fit import Fit
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mrml.landmark_nodes import Landmark
from SlicerUSSim.Logic.mrml.nodes import display_of, set_node_to_world
from SlicerUSSim.Logic.mrml.parameter_node import preset_texts
from SlicerUSSim.Logic.mrml.scene_record import ROLES, SceneRecord, SequenceRecord, put_nodes, put_values
from SlicerUSSim.Logic.mrml.taken_sequence import (
    FrozenRecord,
    SimulatedRecord,
    count_taken,
    put_taken,
    read_taken,
    taken_of,
)
from SlicerUSSim.Workstation.browser_panel import BrowserPanel
from SlicerUSSim.Workstation.export import Cine, CineImage
from SlicerUSSim.Workstation.loading import Loading
from SlicerUSSim.Workstation.opener import Opener, show_all_tissue
from SlicerUSSim.Workstation.pose_registration import Recording, Registration
from SlicerUSSim.Workstation.probe_control import ProbeControl
from SlicerUSSim.Workstation.scene_files import read_scene
from SlicerUSSim.Workstation.script import LabelSource
from SlicerUSSim.Workstation.session_store import KeptSession, SessionStore
from SlicerUSSim.Workstation.state import PLANES, SLICE_VIEWS, ComparisonMode


class Restoring:
    """Puts kept sessions into the scene. All methods run in a task.

    Parameters
    ----------
    store : where sessions are kept; None: there is nothing to offer.
    when_kept : see Autosave.
    now : seconds, as of the images of the cine loop.
    """

    def __init__(
        self, store: SessionStore | None, panel: BrowserPanel, opener: Opener, loading: Loading,
        registration: Registration, probe: ProbeControl, cine: Cine,
        when_kept: Callable[[Callable[[], None]], None], now: Callable[[], float],
    ) -> None:  # fmt: skip
        self._store, self._shared, self._logic, self._scene = store, panel.shared, panel.logic, panel.logic.scene
        self._tasks, self._presenter, self._opener, self._loading = panel.tasks, panel.presenter, opener, loading
        self._registration, self._probe, self._cine = registration, probe, cine
        self._when_kept, self._now = when_kept, now
        self._offered: KeptSession | None = None

    # ---- sessions ----------------------------------------------------------------------------------------------

    def offer(self) -> None:
        """Offer the last session that ended, if there is one."""
        store = self._store
        kept = [] if store is None else self._tasks.doAside(store.ended)
        self._offered = kept[0] if kept else None
        self._show_offer()

    def restore(self) -> None:
        """Restore what is offered, which takes the place of the patient; what cannot be read changes nothing."""
        session = self._offered
        if session is None:
            return
        with self._presenter.shown():
            with TemporaryDirectory(prefix="ussim-sent-") as folder:
                with self._presenter.view.progress("Restore the session"):
                    record, fit, images = self._tasks.doAside(lambda: _parts_of(session))
                    sent = self._tasks.doAside(lambda: session.copies("sent", Path(folder)))
                self._take(record, session.content, fit, images)
                for name, path in sent.items():
                    self._opener.sent_files.keep(name, path)
            self._offered = None
            self._show_offer()
            self._when_kept(session.remove)  # by the session of this server; until then it stays on the disk

    def discard(self) -> None:
        """Remove what is offered from the disk."""
        session, self._offered = self._offered, None
        self._show_offer()
        if session is not None:
            self._tasks.doAside(session.remove)

    def _show_offer(self) -> None:
        session, text = self._offered, ""
        if session is not None:
            saved = session.saved.astimezone()
            is_today = saved.date() == saved.now(saved.tzinfo).date()
            when = f"{saved:%H:%M}" if is_today else f"{saved:%d %B, %H:%M}"
            text = f"Restore the session of {when} ({session.patient})?"
        with self._shared.changing() as now:
            now.offer = text

    # ---- into the scene ----------------------------------------------------------------------------------------

    def open_scene(self, path: str) -> str:
        """Show the patient of a scene file in place of the present one; returns what was done.

        Nothing changes if it cannot be read.
        """
        before = self._opener.patient()
        with self._presenter.view.progress(f"Open {Path(path).name}"):
            record = self._tasks.doAside(lambda: read_scene(path))
        self._take_scene(record, Path(path).name)
        return f"shown as it was{f'; {before} is closed' if before else ''}"

    def show_scene(self, record: SceneRecord, name: str) -> None:
        """Show a scene that was read already, in place of the present patient."""
        with self._presenter.shown():
            self._take_scene(record, name)

    def _take_scene(self, record: SceneRecord, name: str) -> None:
        self._take(record, {"values": dict(record.values)}, None, [])
        parameters = self._logic.parameters
        lines = [f"{name}: a scene"]
        if record.left_out:
            lines.append(f"left out, since the simulator does not use them: {', '.join(record.left_out)}")
        if parameters.labels is None:
            self._loading.segment()
            self._presenter.notes.add(*lines)
        else:
            message, warnings = self._logic.recognised()
            checks = [f"Check: {warning}" for warning in warnings]
            self._presenter.notes.set(*lines, f"{parameters.labels.GetName()}: {message}", *checks)

    def _take(
        self,
        record: SceneRecord,
        kept: Mapping[str, Any],
        fit: tuple[Fit, Preset | None] | None,
        images: list[CineImage],
    ) -> None:
        parameters: Any = self._logic.parameters
        record = self._checked(record, kept)
        source = kept.get("source")
        labels_from = None if source is None else LabelSource.from_dict(source)
        simulated = None if record.simulated is None else put_taken(self._scene, record.simulated)
        try:
            made = put_nodes(self._scene, record)
        except BaseException:
            if simulated is not None:
                self._scene.RemoveNode(simulated)
            raise
        parents = [node.GetParentTransformNode() for node in made.values()]
        labels: Any = made.get("labels")
        flap = None if labels is None else labels.GetNodeReference("SlicerUSSim.flap")
        self._loading.begin_patient(*made.values(), *parents, flap, simulated)
        refused = put_values(parameters, kept.get("values", {}))
        preset = self._logic.preset
        for role in ROLES:
            if role != "real" or record.sequence is None:
                setattr(parameters, role, made.get(role))
        mri, pose = made.get("mri"), record.pose
        if mri is not None:
            show_all_tissue(mri, required(record.nodes["mri"].volume, "the MRI has no voxels"))
        if labels is not None and labels_from is not None:
            self._opener.restored(labels_from, labels)
        if parameters.lesions is not None and kept.get("lesions") is not None:
            files = tuple((str(tissue), str(file)) for tissue, file in kept["lesions"])
            self._opener.restore_lesions(parameters.lesions, files)
        if pose is not None:
            self._put_probe(pose)
        if record.sequence is not None:
            self._registration.restore(record.sequence, record.landmarks)
            self._logic.preset = preset
        parameters.image_sequence = simulated
        page = kept.get("page", {})
        self._show_page(page)
        if pose is not None:
            self._put_probe(pose)  # the sequence has moved it
        if fit is not None and labels is not None:
            self._presenter.fits.restore(*fit, labels)
            with self._shared.changing() as now:
                now.fit.curve, now.fit.costs = [float(cost) for cost in kept["curve"]], str(kept["costs"])
        self._cine.restore(images, self._now())
        self._presenter.notes.set(*map(str, kept.get("notes", ())), *refused)
        frozen = record.frozen
        if frozen is not None and refused:  # such as kinds of sheets, which the image shows
            frozen = replace(frozen, is_of_tissues=False)
        self._loading.show_restored(is_placed=pose is not None, frozen=frozen)
        if record.simulated is not None and simulated is not None:
            if record.simulated.are_of_tissues and labels is not None and not refused:
                self._logic.sequenceIsOfTissues(simulated)
            with self._shared.changing() as now:
                now.simulated.length = count_taken(simulated)
                now.simulated.number = _place_of(frozen, simulated)

    def _checked(self, record: SceneRecord, kept: Mapping[str, Any]) -> SceneRecord:
        """A record with its real images prepared. Raises SimulationError for what cannot be shown; nothing changes."""
        preset = Preset.from_texts(preset_texts(kept.get("values", {})), "the scene's preset")
        if record.frozen is not None:
            taken_of(record.frozen, None)
        found = record.sequence
        if found is None or found.tracked is not None:
            return record
        if not Recording(found.sequence, found.name, found.path).is_calibrated:
            return record
        with self._presenter.view.progress("Find the probe's field"):
            tracked = self._opener.prepared(found, preset.probe)
        return replace(record, sequence=replace(found, tracked=tracked))

    def _put_probe(self, pose: np.ndarray) -> None:
        parameters: Any = self._logic.parameters
        transform = parameters.probe_transform
        if transform is None:
            transform = self._scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "Probe")
            parameters.probe_transform = transform
            display = display_of(transform)
            if display is not None:
                display.SetEditorVisibility(False)
        set_node_to_world(transform, pose)

    def _show_page(self, page: Mapping[str, Any]) -> None:
        for view, plane in dict(page.get("planes", {})).items():
            if view in SLICE_VIEWS and plane in PLANES:
                self._probe.choose_plane(view, plane)
        if not page:
            return
        with self._shared.changing() as now:
            now.views.blend = min(max(float(page["blend"]), 0.0), 1.0)
            now.views.follow, now.views.show_tissues = bool(page["follow"]), bool(page["show_tissues"])
            now.upright = bool(page["upright"])
            now.sequence.comparison = ComparisonMode(page["comparison"])
        if self._shared.now.sequence.length:
            self._loading.show_number(int(page["number"]))


def _place_of(frozen: FrozenRecord | None, images_node: Any) -> int:
    """The number of a frozen image in a sequence; 0 if it is none of its images."""
    number = None if frozen is None else frozen.number
    if frozen is None or number is None or number >= count_taken(images_node):
        return 0
    is_same = read_taken(images_node, number).time == frozen.about.get("time")
    return number if is_same else 0


def _parts_of(session: KeptSession) -> tuple[SceneRecord, tuple[Fit, Preset | None] | None, list]:
    """(patient and probe, fit, cine loop) of a session. Raises SimulationError for one that is damaged."""
    content = session.content
    anatomy = session.read("anatomy")
    require(isinstance(anatomy, SceneRecord), "the session has no patient, expected one; discard it")
    sequence = session.read("sequence")
    pose = content.get("pose")
    if pose is not None:
        pose = check_rigid("the session's pose", pose)
    try:
        landmarks = tuple(map(Landmark.of_list, content.get("landmarks", ())))
    except (ValueError, TypeError) as error:
        raise SimulationError(f"the session's landmarks are damaged ({error})") from None
    image_is_of_tissues, are_of_tissues = map(bool, content.get("of_tissues", (False, False)))  # sessions of before
    simulated = session.read("simulated")
    made = replace(simulated, are_of_tissues=are_of_tissues) if isinstance(simulated, SimulatedRecord) else None
    recorded = sequence if isinstance(sequence, SequenceRecord) else None
    frozen = session.read("frozen")
    image = replace(frozen, is_of_tissues=image_is_of_tissues) if isinstance(frozen, FrozenRecord) else None
    record = SceneRecord(anatomy.nodes, {}, pose, recorded, landmarks=landmarks, simulated=made, frozen=image)
    images = []
    for name in content["files"].get("cine", []):
        for seconds, jpeg, *about in session.read_file(str(name)):  # without it in sessions of earlier versions
            images.append(CineImage(float(seconds), _decoded(jpeg), *map(str, about)))
    fit: Any = session.read("fit")
    return record, fit, images


def _decoded(content: bytes) -> np.ndarray:
    """(rows, columns) uint8 of an image of the loop."""
    try:
        return np.asarray(Image.open(io.BytesIO(content), formats=["JPEG"]).convert("L"))
    except (OSError, ValueError) as error:
        raise SimulationError(f"an image of the session's cine loop is damaged ({error})") from None
