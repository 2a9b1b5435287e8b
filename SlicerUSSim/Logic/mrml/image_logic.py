"""ImageLogic: single images of a scene, and the probe, outline and slice view that belong to them."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import replace
from datetime import datetime, timezone
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, collected_warnings, require, required, warn_again
from SlicerUSSim.Logic.base.settings import DisplaySettings
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.base.vtk_data import matrix_array, vtk_matrix
from SlicerUSSim.Logic.imaging.contact import about_contact
from SlicerUSSim.Logic.imaging.frame import Echoes, Frame
from SlicerUSSim.Logic.imaging.noise import seed_of_pose
from SlicerUSSim.Logic.imaging.simulator import EmptyViewWarning
from SlicerUSSim.Logic.mrml.craniotomy_nodes import flap_centre, is_opened
from SlicerUSSim.Logic.mrml.fitting_nodes import mark_as_drawn
from SlicerUSSim.Logic.mrml.label_nodes import labels_version
from SlicerUSSim.Logic.mrml.nodes import (
    display_of,
    named,
    node_to_world,
    pose_in_labels,
    probe_pose,
    read_volume,
    require_node,
    set_node_to_world,
    show_in_slice,
    write_body,
    write_outline,
)
from SlicerUSSim.Logic.mrml.own_results import OUTLINE, mark_as_result, may_replace_result, require_result
from SlicerUSSim.Logic.mrml.patient_logic import PatientLogic
from SlicerUSSim.Logic.mrml.taken_image import TakenImage, freeze, mri_of, patient_of, remove_image, write_image
from SlicerUSSim.Logic.placement.aiming import opening_pose
from SlicerUSSim.Logic.placement.bone_before_probe import about_bone, about_missing_skull
from SlicerUSSim.Logic.placement.craniotomy import default_pose
from SlicerUSSim.Logic.placement.views import opened_view_pose, view_pose
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.probe.poses import pose_in_slice
from SlicerUSSim.Logic.probe.shape import outline_polydata

#: Reference of an outline to the model of the probe's body
_BODY = "SlicerUSSim.body"


class ImageLogic:
    """Images at the probe's pose, in nodes that are empty or have an image of this module."""

    def __init__(self, patient: PatientLogic) -> None:
        self._patient, self._parameters = patient, patient.parameters
        #: The last image with everything it shows; None if there is none, or the last one failed
        self.taken: TakenImage | None = None
        #: What about_missing_skull says, and of what
        self._missing: tuple[Hashable, tuple[str, ...]] = None, ()
        self._held = ""  # time of the image at which holdOutline left the outline

    def simulate(
        self, labels_node, probe_transform_node, output_node, *, warned: Callable[[Warning], None] = warn_again
    ) -> Frame:
        """Write the image at the probe's pose into a scalar volume node, and put it under the probe's transform.

        `labels_node` is a label map or a segmentation; its names determine the tissues, see label_nodes.read_labels.
        Amplifier noise differs between poses in the labels' frame (noise.seed_of_pose). `warned` is called with each
        warning.
        Raises SimulationError, before anything is computed, for an output with data that this module did not make.
        """
        self._check_output(labels_node, output_node)
        checked = self._state_of(output_node)
        try:
            taken = self.take(labels_node, probe_pose(probe_transform_node), output_node, warned)
            if self._state_of(output_node) != checked:  # nodes have changed in the meantime
                self._check_output(labels_node, output_node)
            require_node(probe_transform_node, "vtkMRMLTransformNode", use="probe transform")
        except BaseException:
            self.clearImage(output_node)  # the previous image would be mistaken for the image of this pose
            raise
        self.taken = taken
        write_image(taken, probe_transform_node)
        return required(taken.frame, "the image has no frame")

    def take(
        self, labels_node, probe_to_world: np.ndarray, output_node, warned: Callable[[Warning], None],
        number: int | None = None,
    ) -> TakenImage:  # fmt: skip
        """The image at a pose (4, 4) for a volume node, into which nothing is written.

        `number` is its place in a sequence, and the seed of its noise; by default that depends on the pose.
        """
        anatomy, imaged = self._patient.anatomyOf(labels_node), self._patient.imaged(labels_node)
        preset, patient, pose = imaged.preset, patient_of(labels_node), imaged.patient.pose(probe_to_world)
        seed = seed_of_pose(pose) if number is None else number

        def compute() -> tuple[Frame, bool, list[Warning]]:
            # Collected within the work, since Python collects warnings for all threads together.
            with collected_warnings() as caught:
                simulator = self._patient.simulator(imaged)
                frame = simulator.simulate(preset.probe, pose, preset.display, noise_seed=seed)
                return frame, not frame.iq.any(), caught

        frame, is_silent, warnings = self._patient.work.do(compute)
        for warning in warnings:
            warned(warning)
        is_empty = any(isinstance(warning, EmptyViewWarning) for warning in warnings) or is_silent
        time = datetime.now(timezone.utc).isoformat(timespec="milliseconds")
        return TakenImage(
            frame.image, frame.grid, probe_to_world, preset, patient, anatomy, time, is_empty, output_node,
            frame=frame, number=number,
        )  # fmt: skip

    def redisplay(self, taken: TakenImage, echoes: Echoes, display: DisplaySettings) -> TakenImage:
        """A previous image with another display, from its echoes; nothing is written.

        Raises SimulationError without labels.
        """
        imaged = self._patient.imaged(required(self._parameters.labels, "no label map is chosen"))
        seed = seed_of_pose(echoes.probe_to_ras) if taken.number is None else taken.number
        preset = replace(taken.preset, display=display)
        image = self._patient.work.do(
            lambda: self._patient.simulator(imaged).redisplay(
                echoes, preset.probe, preset.settings, display, noise_seed=seed
            )
        )
        return replace(taken, image=image, grid=ImageGrid.for_probe(preset.probe, display.image_size), preset=preset)

    def differences(self, taken: TakenImage) -> tuple[str, ...]:
        """What of an image is not as the scene is now, of patient, tissues, pose, probe, settings and display."""
        labels, transform, preset = self._parameters.labels, self._parameters.probe_transform, self._parameters.preset
        if labels is None or patient_of(labels) != taken.patient:
            return ("patient",)
        try:
            are_same = {
                "tissues": (self._patient.anatomyOf(labels), preset.tissues) == (taken.anatomy, taken.preset.tissues),
                "pose": transform is not None and np.allclose(node_to_world(transform), taken.probe_to_world),
                "probe": preset.probe == taken.preset.probe,
                "settings": self._patient.settings(labels) == taken.preset.settings,
                "display": preset.display == taken.preset.display,
            }
        except SimulationError:  # the nodes of now make no image
            return ("tissues",)
        return tuple(name for name, is_same in are_same.items() if not is_same)

    def _check_output(self, labels_node, output_node) -> None:
        require_node(output_node, "vtkMRMLScalarVolumeNode", use="output")
        require(
            labels_node is not output_node, f"input and output are both {named(output_node)}, expected different nodes"
        )
        require(
            not output_node.IsA("vtkMRMLLabelMapVolumeNode"),
            f"output is {named(output_node)}, expected a ScalarVolume node",
        )
        require(
            output_node is not self._parameters.mri, f"output is the MRI {named(output_node)}, expected another volume"
        )
        require_result(output_node, "output")

    def _state_of(self, output_node) -> Hashable:
        """Changes with what _check_output is about."""
        image, choices = output_node.GetImageData(), self._parameters.node.GetMTime()
        return output_node.GetScene() is None, output_node.GetMTime(), image and image.GetMTime(), choices

    def holdImage(self, output_node) -> None:
        """Freeze the image that simulate() wrote last into this node: it stays where it was taken.

        Without that it is under the probe's transform, for the next image, and would be shown where the probe is then.
        """
        taken = self.taken
        if taken is not None and taken.node is output_node and output_node.GetImageData() is not None:
            freeze(taken)

    def clearImage(self, output_node) -> None:
        """Empty a node with an image of this module, which is not of the present patient or pose.

        Data of others, which were put in place of the image, are kept.
        """
        if output_node is None:
            return
        if self.taken is not None and self.taken.node is output_node:
            self.taken = None
        if output_node.GetImageData() is not None and may_replace_result(output_node):
            remove_image(output_node)

    def clearOutline(self, model_node) -> None:
        """Empty a model with an outline of this module, which is where a probe was on another patient."""
        if model_node is not None and may_replace_result(model_node):
            model_node.SetAndObservePolyData(None)

    def lastImage(self) -> Volume:
        """The image of simulate() as one slice at the probe's pose of that time (RAS), not its present pose.

        Raises SimulationError if there is none.
        """
        return required(self.taken, "there is no image yet, simulate one first").volume()

    def placeProbe(
        self, labels_node, probe_transform_node, slice_node=None, target_ras=None, *, view: str | None = None,
        will_open: bool = False,
    ) -> str:  # fmt: skip
        """Put the probe on the surface of the labelled tissue, with its axis inwards.

        With a slice node the image is in that slice, with its depth towards the bottom of the view, aimed at
        `target_ras` (default: the middle of the view). Without one it is a coronal view through a parasagittal
        craniotomy: on a brain, upright on the skin of a whole head, or on the brain in the middle of an opening, aimed
        at a lesion below it (aiming.opening_pose).
        `view` is one of placement.views.VIEWS instead, as "temporal". With `will_open` it is on the brain of a closed
        head, where openCraniotomy opens a disc under it: over the lesion that was laid over the labels, if any.
        Returns a line about what was done in labels with an opening, or about how the head lies for a view, or "".
        """
        require_node(probe_transform_node, "vtkMRMLLinearTransformNode", use="probe transform")
        patient = self._patient.patient(labels_node)
        surface = Volume(patient.labels.array, np.linalg.inv(patient.world_to_patient) @ patient.labels.ijk_to_ras)
        line = ""
        if view is not None and is_opened(labels_node):
            pose, line = opened_view_pose(surface, patient.names, view)
        elif view is not None:
            pose, line = view_pose(surface, patient.names, view)
        elif slice_node is None:
            opening = flap_centre(labels_node)
            probe, names = self._parameters.preset.probe, patient.names
            if opening is None:
                pose = default_pose(
                    surface, names, probe, is_open=will_open or is_opened(labels_node),
                    target_ras=self._laid_lesion(labels_node) if will_open else None,
                )  # fmt: skip
            else:
                pose, line = opening_pose(surface, names, probe, opening)
        else:
            require_node(slice_node, "vtkMRMLSliceNode", use="slice view")
            pose = pose_in_slice(surface, matrix_array(slice_node.GetSliceToRAS()), target_ras)
        set_node_to_world(probe_transform_node, pose)
        return line

    def _laid_lesion(self, labels_node) -> np.ndarray | None:
        """(3,) RAS mm of the largest lesion that was laid over these labels last, such as by --add; or None."""
        version, place = self._patient.lesion_place
        if place is None or version != labels_version(labels_node):
            return None
        world_to_labels, scaling = pose_in_labels(labels_node, np.eye(4))
        return (np.linalg.inv(world_to_labels) @ scaling @ [*place, 1.0])[:3]

    def aboutBone(self, labels_node, probe_transform_node) -> tuple[str, ...]:
        """Lines about bone before the probe at its pose: a closed skull, or an opening that its face does not fit.

        See bone_before_probe.about_bone, and about_missing_skull.
        """
        patient, preset = self._patient.patient(labels_node), self._parameters.preset
        mri: Any = mri_of(labels_node) or self._parameters.mri
        if "skull" not in patient.names and mri is not None and mri.GetImageData() is not None:
            version = patient.version, mri.GetID(), mri.GetImageData().GetMTime()
            if self._missing[0] != version:
                image, to_patient = read_volume(mri), patient.world_to_patient @ node_to_world(mri)
                placed = Volume(image.array, to_patient @ image.ijk_to_ras)
                self._missing = version, about_missing_skull(patient.labels, patient.names, placed)
            return self._missing[1]
        tissues = preset.tissues.for_names(patient.names).all_tissues()
        pose, is_open = patient.pose(probe_pose(probe_transform_node)), is_opened(labels_node)
        return about_bone(patient.labels, patient.names, tissues, preset.probe, pose, is_open=is_open)

    def aboutContact(self, labels_node, probe_transform_node) -> tuple[str, ...]:
        """Lines about a probe whose face does not touch the patient at its pose, or with little of it.

        See contact.about_contact.
        """
        patient = self._patient.patient(labels_node)
        gap_mm = self._patient.settings(labels_node, patient).contact_gap_mm
        pose = patient.pose(probe_pose(probe_transform_node))
        return about_contact(patient.labels, self._parameters.preset.probe, [pose], gap_mm)

    def showOutline(self, model_node, probe_transform_node) -> None:
        """The outline of the imaged field as a model under the probe's transform.

        Raises SimulationError for a model with a surface that this module did not make.
        """
        require_node(model_node, "vtkMRMLModelNode", use="outline")
        require_node(probe_transform_node, "vtkMRMLTransformNode", use="probe transform")
        require_result(model_node, "outline")
        write_outline(model_node, self._parameters.preset.probe, probe_transform_node)
        mark_as_result(model_node, OUTLINE)
        self._write_body(model_node)

    def holdOutline(self) -> None:
        """Leave the chosen outline where the last image was taken, as holdImage does with the image."""
        taken, model = self.taken, self._parameters.outline
        if taken is None or model is None or not may_replace_result(model):
            return
        if model.GetTransformNodeID() is not None or self._held != taken.time:
            self._held = taken.time
            model.SetAndObserveTransformNodeID(None)
            model.SetAndObservePolyData(outline_polydata(taken.preset.probe))
            model.ApplyTransformMatrix(vtk_matrix(taken.probe_to_world))
            mark_as_result(model, OUTLINE)

    def showProbe(self, outline_node, is_shown: bool) -> None:
        """Show or hide a model of the probe's body, which belongs to the outline of its imaged field."""
        body = outline_node.GetNodeReference(_BODY)
        if body is None and is_shown:
            body = outline_node.GetScene().AddNewNodeByClass("vtkMRMLModelNode", "Ultrasound probe")
            mark_as_drawn(body)
            outline_node.SetNodeReferenceID(_BODY, body.GetID())
            self._write_body(outline_node)
        if body is not None and display_of(body) is not None:
            display_of(body).SetVisibility(is_shown)

    def _write_body(self, outline_node) -> None:
        """The model of the probe's body, if there is one, of the present probe and where its outline is."""
        body = outline_node.GetNodeReference(_BODY)
        if body is not None:
            write_body(body, self._parameters.preset.probe)
            body.SetAndObserveTransformNodeID(outline_node.GetTransformNodeID())

    def showInSlice(self, slice_node, output_node, probe_transform_node, fit: bool = True) -> None:
        """Move a slice view to the image plane and overlay the image."""
        require_node(slice_node, "vtkMRMLSliceNode", use="slice view")
        require_node(output_node, "vtkMRMLScalarVolumeNode", use="output")
        show_in_slice(slice_node, output_node, probe_pose(probe_transform_node), self._parameters.preset.probe, fit)
