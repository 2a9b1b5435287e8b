"""SequenceLogic: sequences of images, and previous images that are shown again."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import require, required, warn_again
from SlicerUSSim.Logic.base.transforms import check_rigid
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.imaging.compounding import Compounder, sweep_grid
from SlicerUSSim.Logic.mrml.image_logic import ImageLogic
from SlicerUSSim.Logic.mrml.live import LiveLogic
from SlicerUSSim.Logic.mrml.nodes import (
    named,
    node_to_world,
    path_points,
    require_node,
    show_all_greys,
    write_volume,
)
from SlicerUSSim.Logic.mrml.own_results import COMPOUNDED, mark_as_result, require_result
from SlicerUSSim.Logic.mrml.patient_logic import PatientLogic
from SlicerUSSim.Logic.mrml.sequence_nodes import SequenceIndex, add_poses
from SlicerUSSim.Logic.mrml.taken_image import TakenImage, follow, freeze, write_image
from SlicerUSSim.Logic.mrml.taken_sequence import FrozenRecord, read_taken, taken_of, write_taken
from SlicerUSSim.Logic.probe.surface import PatientSurface


class SequenceLogic:
    """Images of many poses, and whether they show the patient's current state."""

    def __init__(self, patient: PatientLogic, images: ImageLogic, live: LiveLogic) -> None:
        self._patient, self._images, self._live = patient, images, live
        self.forget()

    def forget(self) -> None:
        """Release what is kept in memory of the last patient."""
        #: Node of the last simulated sequence, and what its images show of the patient
        self._last: tuple[Any, Hashable] = (None, None)

    def simulateSequence(
        self, labels_node, transforms_node, images_node, *, browser_node=None,
        progress: Callable[[float], None] | None = None,
    ) -> int:  # fmt: skip
        """A sequence of simulated images from a vtkMRMLSequenceNode of linear transforms; returns how many.

        Images are in the probe frame with the transforms' index values; SequenceIndex changes values that a sequence
        node cannot distinguish, so that no image is lost. Their numbers are the seeds of their noise. With the browser
        of the transforms, the parents of its current transform are applied, and the images are added to it, under that
        transform. `progress` is called with the fraction done and may raise errors.Cancelled; `images_node` is then
        unchanged. Raises SimulationError for an `images_node` with data that this module did not make.
        """
        require_node(transforms_node, "vtkMRMLSequenceNode", use="sequence of transforms")
        require_node(images_node, "vtkMRMLSequenceNode", use="sequence of images")
        require(
            images_node is not transforms_node,
            f"input and output are both {named(images_node)}, expected different nodes",
        )
        require_result(images_node, "sequence of images")
        count = transforms_node.GetNumberOfDataNodes()
        require(count > 0, f"sequence {named(transforms_node)} is empty, expected transforms")
        proxy = None if browser_node is None else browser_node.GetProxyNode(transforms_node)
        parent = None if proxy is None else proxy.GetParentTransformNode()
        to_world = np.eye(4) if parent is None else node_to_world(parent)

        images: list[TakenImage] = []
        for number in range(count):
            item = transforms_node.GetNthDataNode(number)
            require_node(item, "vtkMRMLTransformNode", use=f"item {number} of {named(transforms_node)}")
            pose = check_rigid(f"item {number} of {named(transforms_node)}", to_world @ node_to_world(item))
            image = self._patient.scene.CreateNodeByClass("vtkMRMLScalarVolumeNode")
            image.UnRegister(None)
            taken = self._images.take(labels_node, pose, image, warn_again, number)
            write_image(taken)  # the browser's node for the shown image is a copy of it
            images.append(replace(taken, frame=None))  # whose signals are many times larger
            if progress is not None:
                progress((number + 1) / count)
        require_node(images_node, "vtkMRMLSequenceNode", use="sequence of images")

        write_taken(images_node, SequenceIndex.of_node(transforms_node), images)
        same = {image.anatomy for image in images}
        self._last = (images_node, images[0].anatomy if len(same) == 1 else None)
        if browser_node is not None:
            is_new = not browser_node.IsSynchronizedSequenceNode(images_node, True)
            if is_new:
                browser_node.AddSynchronizedSequenceNode(images_node)
            shown = browser_node.GetProxyNode(images_node)
            if shown is not None and is_new:
                show_all_greys(shown)
            if shown is not None and proxy is not None:
                shown.SetAndObserveTransformNodeID(proxy.GetID())
        return count

    def followPath(self, labels_node, path_node, *, step_mm: float = 1.0):
        """(browser, transforms): the poses of a probe that moves along a curve or line of Markups on the patient.

        The nodes are new, for simulateSequence(). The path is projected onto the surface of the labels, on which the
        probe stands upright, its image planes across the path (PatientSurface.along).
        Raises SimulationError for a path without length.
        """
        require_node(path_node, "vtkMRMLMarkupsCurveNode", "vtkMRMLMarkupsLineNode", use="path of the probe")
        points, patient = path_points(path_node), self._patient.patient(labels_node)
        require(len(points) > 1, f"path {named(path_node)} has {len(points)} points, expected two or more")
        to_patient = patient.world_to_patient
        local = points @ to_patient[:3, :3].T + to_patient[:3, 3]
        poses = self._patient.work.do(lambda: PatientSurface(patient.labels).along(local, step_mm))
        poses = [np.linalg.inv(to_patient) @ pose for pose in poses]
        return add_poses(self._patient.scene, poses, f"{path_node.GetName()} poses")

    def compoundSequence(self, images_node, volume_node, *, spacing_mm: float = 0.5) -> None:
        """Write the volume of all images of simulateSequence() into a scalar volume node, along the axes of RAS.

        See imaging.compounding. Raises SimulationError for another sequence, for images of several probes, for a
        volume that is too large, and for a node with data that this module did not make.
        """
        require_node(images_node, "vtkMRMLSequenceNode", use="sequence of images")
        require_node(volume_node, "vtkMRMLScalarVolumeNode", use="compounded volume")
        require_result(volume_node, "compounded volume")
        count = images_node.GetNumberOfDataNodes()
        require(count > 0, f"sequence {named(images_node)} is empty, expected images")
        images = [self.sequenceImage(images_node, number) for number in range(count)]
        probe = images[0].preset.probe
        require(all(one.preset.probe == probe for one in images), f"{named(images_node)} has images of several probes")

        def compute() -> Volume:
            grid = sweep_grid(probe, [one.probe_to_world for one in images], spacing_mm)
            compounder = Compounder(grid, probe, self._patient.device)
            for one in images:
                compounder.add_buffer(compounder.device.upload(one.image), one.grid, one.probe_to_world)
            return compounder.volume()

        volume = self._patient.work.do(compute)
        write_volume(volume_node, volume)
        show_all_greys(volume_node)
        mark_as_result(volume_node, COMPOUNDED)

    def sequenceImage(self, images_node, number: int) -> TakenImage:
        """The image with a number, from 0, that simulateSequence made, with everything it shows.

        Raises SimulationError for a sequence of something else.
        """
        require_node(images_node, "vtkMRMLSequenceNode", use="sequence of images")
        last, anatomy = self._last
        return read_taken(images_node, number, anatomy if last is images_node else None)

    def showSequenceImage(self, images_node, number: int, output_node) -> TakenImage:
        """Write an image that simulateSequence made into a scalar volume node, where it was taken; it stays there.

        Ends live update, whose next image would take its place. Raises SimulationError for an output with data that
        this module did not make.
        """
        return self.showTaken(self.sequenceImage(images_node, number), output_node)

    def showFrozen(self, record: FrozenRecord, output_node) -> TakenImage:
        """Write an image of a scene that was saved into a scalar volume node, where it was taken; it stays there.

        Ends live update. Raises SimulationError for a damaged record, and for an output that this module did not make.
        """
        return self.showTaken(taken_of(record, output_node), output_node)

    def showTaken(self, taken: TakenImage, output_node) -> TakenImage:
        """The same with any image that was taken."""
        require_node(output_node, "vtkMRMLScalarVolumeNode", use="output")
        require_result(output_node, "output")
        taken = replace(taken, node=output_node)
        self._live.stopLiveUpdate()
        self._images.taken = taken
        was_modifying = output_node.StartModify()
        write_image(taken)
        freeze(taken)
        output_node.EndModify(was_modifying)
        return taken

    @contextmanager
    def imageHeld(self) -> Iterator[None]:
        """While a scene is saved: as if Live ended, so that the image is where it was taken; Live then continues.

        The scene says that the image is live. Saving lays the segments of tissues together into one label map. The
        images are of them as before.
        """
        parameters = self._patient.parameters
        taken, labels, images = self._images.taken, parameters.labels, parameters.image_sequence
        is_of_tissues, are_of_tissues = self.areOfTissues()
        transform = taken.node.GetParentTransformNode() if taken is not None and self._live.isLive else None
        if taken is not None and transform is not None:
            freeze(taken, while_saved=True)
        try:
            yield
        finally:
            if taken is not None and transform is not None:
                follow(taken, transform)
            if taken is not None and is_of_tissues:
                self._images.taken = replace(taken, anatomy=self._patient.anatomyOf(labels))
            if are_of_tissues:
                self.sequenceIsOfTissues(images)

    def areOfTissues(self) -> tuple[bool, bool]:
        """(whether the last image, whether those of the chosen sequence) show labels and sheets as they are now."""
        labels, images = self._patient.parameters.labels, self._patient.parameters.image_sequence
        if labels is None:
            return False, False
        now, (last, in_sequence) = self._patient.anatomyOf(labels), self._last
        taken, is_known = self._images.taken, images is not None and images is last
        return taken is not None and taken.anatomy == now, is_known and in_sequence == now

    def sequenceIsOfTissues(self, images_node) -> None:
        """Take the images of a sequence for those of the chosen labels and sheets, with which it was restored."""
        labels = required(self._patient.parameters.labels, "no label map is chosen, expected that of the images")
        self._last = images_node, self._patient.anatomyOf(labels)
