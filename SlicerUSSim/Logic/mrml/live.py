"""LiveLogic: an image that follows the probe, one for each burst of changes."""

from __future__ import annotations

import logging
import weakref
from collections.abc import Callable, Hashable
from time import perf_counter
from typing import Any, NamedTuple

import slicer
from vtkmodules.vtkCommonCore import VTK_OBJECT, vtkCommand

from SlicerUSSim.Logic.base.errors import user_message
from SlicerUSSim.Logic.mrml.image_logic import ImageLogic
from SlicerUSSim.Logic.mrml.label_nodes import labels_version
from SlicerUSSim.Logic.mrml.nodes import node_to_world, show_in_slice
from SlicerUSSim.Logic.mrml.patient_logic import PatientLogic

_log = logging.getLogger(__name__)

#: Event of an output volume: another live update writes to it from now on.
_CLAIMED = vtkCommand.UserEvent + 7301
#: An image that takes longer is not live; the first of a patient or a probe includes its preparation, so the second
#: in a row ends the update
_SLOWEST_S, _SLOW_IMAGES = 10.0, 2
#: Priority of an observer that is called before others, whose is 0
_FIRST = 1000.0
_Schedule = Callable[[Callable[[], None]], None]


class LiveNodes(NamedTuple):
    """The nodes of one live update; outline model and slice view may be None."""

    labels: Any
    probe_transform: Any
    output: Any
    outline: Any
    slice_view: Any


class LiveUpdate:
    """Keeps an output volume up to date with a probe transform; all observers are removed at the end."""

    running = False

    def __init__(
        self, patient: PatientLogic, images: ImageLogic, nodes: LiveNodes, schedule: _Schedule | None,
        report: Callable[[str], None] | None, stopped: Callable[[], None] | None,
    ) -> None:  # fmt: skip
        self._parameters, self._images = patient.parameters, images
        self._nodes: LiveNodes | None = nodes
        labels_node, transform_node, output_node = nodes.labels, nodes.probe_transform, nodes.output
        self._schedule, self._report, self._stopped = schedule, report, stopped
        self._pending = self._busy = False
        self._is_claimed = False  # by another live update, whose image is in the output now
        self._logged = ""
        self._slow = 0  # images in a row
        self._outlined = patient.parameters.preset.probe
        self._observed: list[tuple[Any, int]] = []
        self.running = True

        scene = patient.scene
        output_node.InvokeEvent(_CLAIMED)  # stops a live update that wrote to it before
        self._observe(output_node, _CLAIMED, self._claimed)
        self._observe(scene, scene.StartCloseEvent, self.stop)
        # Before Slicer's node selectors, which choose the next node instead: live images would continue in that
        self._observe(scene, scene.NodeAboutToBeRemovedEvent, self._node_goes, call_data=VTK_OBJECT, priority=_FIRST)
        self._observe(scene, scene.EndBatchProcessEvent, self._batch_ended)
        self._observe(transform_node, transform_node.TransformModifiedEvent, self.request)
        self._observe(labels_node, labels_node.TransformModifiedEvent, self.request)
        if labels_node.IsA("vtkMRMLSegmentationNode"):
            segmentation, events = labels_node.GetSegmentation(), slicer.vtkSegmentation
            segments = events.SegmentAdded, events.SegmentRemoved, events.SegmentModified
            for event in (events.SourceRepresentationModified, *segments):
                self._observe(segmentation, event, self.request)
        else:
            self._observe(labels_node, labels_node.ImageDataModifiedEvent, self.request)
            self._observe(labels_node, vtkCommand.ModifiedEvent, self.request)
        self._observe(patient.parameters.node, vtkCommand.ModifiedEvent, self.request)

    def _claimed(self) -> None:
        self._is_claimed = True
        self.stop()

    def stop(self) -> None:
        """Remove all observers and node references, freeze the image, and report the end once."""
        if not self.running:
            return
        self.running = False
        for observed, tag in self._observed:
            observed.RemoveObserver(tag)
        self._observed.clear()
        nodes, self._nodes = self._nodes, None
        if nodes is not None and not self._is_claimed and nodes.output.GetScene() is not None:
            self._images.holdImage(nodes.output)
        stopped, self._stopped, self._report = self._stopped, None, None
        if stopped is not None:
            stopped()

    def __del__(self) -> None:
        self._stopped = self._nodes = None
        self.stop()

    def _observe(self, subject, event, method, call_data=None, priority=0.0) -> None:
        weak = weakref.WeakMethod(method)  # a strong reference would keep this object alive as long as the scene

        def callback(_subject, _event, *data):
            alive = weak()
            if alive is not None:
                alive(*data)

        if call_data is not None:
            setattr(callback, "CallDataType", call_data)  # noqa: B010, where VTK looks for it
        self._observed.append((subject, subject.AddObserver(event, callback, priority)))

    def _node_goes(self, node) -> None:
        if any(node is mine for mine in self._nodes or ()):
            self.stop()

    def _batch_ended(self) -> None:
        if self._pending:
            self._pending = False
            self.request()

    def request(self) -> None:
        """After a change: schedule exactly one image."""
        if self._pending or self._nodes is None:
            return
        self._pending = True
        if self._nodes.output.GetScene().IsBatchProcessing():
            return  # the scene is being loaded or closed; the end of the batch calls this again
        if self._schedule is not None:
            self._schedule(self._run)
        elif not self._busy:
            while self._pending and self.running:  # an image can cause the next change within this loop
                self._run()

    def _run(self) -> None:
        images, nodes = self._images, self._nodes
        if self._busy or not self._pending or nodes is None:
            return  # changes can occur while the work is done in another thread
        self._pending = False
        self._busy = True
        begun = perf_counter()
        try:
            caught: list[Warning] = []
            images.simulate(nodes.labels, nodes.probe_transform, nodes.output, warned=caught.append)
            probe = self._parameters.preset.probe
            if nodes.outline is not None and probe != self._outlined:
                images.showOutline(nodes.outline, nodes.probe_transform)
                self._outlined = probe
            if nodes.slice_view is not None and images.taken is not None:
                show_in_slice(nodes.slice_view, nodes.output, images.taken.probe_to_world, probe, fit=False)
            message = "; ".join(map(str, caught))
        except Exception as error:
            message = user_message(error)
            if message is None:
                self.stop()
                raise
        finally:
            self._busy = False
        seconds = perf_counter() - begun
        self._slow = self._slow + 1 if seconds > _SLOWEST_S else 0
        if self._slow >= _SLOW_IMAGES:
            message = (
                f"live update ended: {_SLOW_IMAGES} images in a row took more than {_SLOWEST_S:g} s, the last "
                f"{seconds:.0f} s; simulate single images, or use fewer scan lines, less depth or another device"
            )
        if message and message != self._logged:
            _log.warning("live update: %s", message)
        self._logged = message
        if self._report is not None:
            self._report(message)
        if self._slow >= _SLOW_IMAGES:
            self.stop()
        if self._pending and self._schedule is not None and self.running:
            self._schedule(self._run)


class LiveLogic:
    """Starts and ends the live update of a scene."""

    def __init__(self, patient: PatientLogic, images: ImageLogic) -> None:
        self._patient, self._images = patient, images
        self._update: LiveUpdate | None = None

    @property
    def isLive(self) -> bool:
        """Whether a live update is running."""
        return self._update is not None and self._update.running

    def startLiveUpdate(
        self, labels_node, probe_transform_node, output_node, outline_node=None, slice_node=None, *,
        schedule: _Schedule | None = None, report: Callable[[str], None] | None = None,
        stopped: Callable[[], None] | None = None,
    ) -> None:  # fmt: skip
        """Simulate now, and again whenever the transform or its parents, the labels or the preset change.

        `outline_node` is a model for the outline of the imaged field, `slice_node` a slice view that follows its plane.
        `schedule(function)` must call `function` once, soon, from the event loop (in Slicer: qt.QTimer.singleShot(0,
        function)). One image is then computed for all changes before the call. Without `schedule` an image is computed
        synchronously with each change.
        `report` is called with "" after an image, and otherwise with one line that describes the error; the update
        continues, since the error may be corrected. `stopped` is called when it ends: by stopLiveUpdate, when one of
        its nodes or the scene is removed, or when another live update uses the output.
        """
        self.stopLiveUpdate()
        images = self._images
        caught: list[Warning] = []

        def version() -> tuple[Hashable, ...]:
            pose = node_to_world(probe_transform_node).tobytes()
            return pose, labels_version(labels_node), self._patient.parameters.node.GetMTime()

        before = version()
        images.simulate(labels_node, probe_transform_node, output_node, warned=caught.append)  # raises errors now
        if outline_node is not None:
            images.showOutline(outline_node, probe_transform_node)
        if slice_node is not None:
            images.showInSlice(slice_node, output_node, probe_transform_node)
        nodes = LiveNodes(labels_node, probe_transform_node, output_node, outline_node, slice_node)
        self._update = LiveUpdate(self._patient, images, nodes, schedule, report, stopped)
        if report is not None:
            report("; ".join(map(str, caught)))
        if version() != before:  # changed while the first image was computed, before anything was observed
            self.request()

    def request(self) -> None:
        """Another image of the live update, if one is running."""
        if self._update is not None:
            self._update.request()

    def stopLiveUpdate(self) -> None:
        """End the live update and remove its observers."""
        if self._update is not None:
            self._update.stop()
            self._update = None
