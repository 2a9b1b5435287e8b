"""Scenes: puts scenes of 3D Slicer and of this page into the scene, in place of the patient."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import required
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mrml.nodes import display_of, set_node_to_world
from SlicerUSSim.Logic.mrml.parameter_node import preset_texts
from SlicerUSSim.Logic.mrml.scene_record import ROLES, SceneRecord, put_nodes, put_values
from SlicerUSSim.Logic.mrml.taken_sequence import FrozenRecord, count_taken, put_taken, read_taken, taken_of
from SlicerUSSim.Workstation.browser_panel import BrowserPanel
from SlicerUSSim.Workstation.cine import SEQUENCE
from SlicerUSSim.Workstation.file_nodes import FileNodes, show_all_tissue
from SlicerUSSim.Workstation.patient import OpenPatient
from SlicerUSSim.Workstation.pose_registration import Recording, Registration
from SlicerUSSim.Workstation.scene_files import read_scene


class Scenes:
    """Shows scenes. All methods run in a task, and change nothing for a scene that cannot be shown."""

    def __init__(self, panel: BrowserPanel, nodes: FileNodes, patient: OpenPatient, registration: Registration) -> None:
        self._shared, self._logic, self._scene, self._tasks = panel.shared, panel.logic, panel.logic.scene, panel.tasks
        self._presenter, self._nodes, self._patient, self._registration = panel.presenter, nodes, patient, registration

    def open(self, path: str) -> None:
        """Show the patient of a scene file in place of the present one."""
        with self._presenter.view.progress(f"Open {Path(path).name}"):
            record = self._tasks.doAside(lambda: read_scene(path))
        self.show(record, Path(path).name)

    def show(self, record: SceneRecord, name: str) -> None:
        """Show a scene that was read already, in place of the present patient."""
        refused = self._take(self._checked(record))
        parameters = self._logic.parameters
        lines = [f"{name}: a scene"]
        if record.left_out:
            lines.append(f"left out, since the simulator does not use them: {', '.join(record.left_out)}")
        if parameters.labels is None:
            self._patient.segment()
            self._presenter.notes.add(*lines, *refused)
        else:
            message, warnings = self._logic.recognised()
            checks = [f"Check: {warning}" for warning in warnings]
            self._presenter.notes.set(*lines, f"{parameters.labels.GetName()}: {message}", *checks, *refused)

    def _checked(self, record: SceneRecord) -> SceneRecord:
        """A record with its real images prepared. Raises SimulationError for what cannot be shown."""
        preset = Preset.from_texts(preset_texts(record.values), "the scene's preset")
        if record.frozen is not None:
            taken_of(record.frozen, None)
        found = record.sequence
        if found is None or not Recording(found.sequence, found.name, found.path).is_calibrated:
            return record
        with self._presenter.view.progress("Find the probe's field"):
            tracked = self._nodes.prepared(found, preset.probe)
        return replace(record, sequence=replace(found, tracked=tracked))

    def _take(self, record: SceneRecord) -> list[str]:
        """Put a record into the scene; returns lines about values that this version does not take."""
        parameters: Any = self._logic.parameters
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
        self._patient.forget_ultrasound()
        self._patient.begin_patient(*made.values(), *parents, flap, simulated)
        refused = put_values(parameters, record.values)
        preset, pose = self._logic.preset, record.pose
        for role in ROLES:
            if role != "real" or record.sequence is None:
                setattr(parameters, role, made.get(role))
        if "mri" in made:
            show_all_tissue(made["mri"], required(record.nodes["mri"].volume, "the MRI has no voxels"))
        if pose is not None:
            self._put_probe(pose)
        if record.sequence is not None:
            self._registration.restore(record.sequence)
            self._logic.preset = preset
        parameters.image_sequence = simulated
        if pose is not None:
            self._put_probe(pose)  # the sequence has moved it
        self._presenter.notes.set()
        self._patient.show_restored(is_placed=pose is not None, frozen=record.frozen)
        if simulated is not None:
            with self._shared.changing() as now:
                now.cine.source, now.cine.index = SEQUENCE, _place_of(record.frozen, simulated)
        return refused

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


def _place_of(frozen: FrozenRecord | None, images_node: Any) -> int:
    """The number of a frozen image in a sequence; 0 if it is none of its images."""
    number = None if frozen is None else frozen.number
    if frozen is None or number is None or number >= count_taken(images_node):
        return 0
    is_same = read_taken(images_node, number).time == frozen.about.get("time")
    return number if is_same else 0
