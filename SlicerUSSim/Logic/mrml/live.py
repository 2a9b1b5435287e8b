"""LiveUpdate: one image per burst of changes; all observers are removed at the end."""

from __future__ import annotations

import logging
import weakref
from collections.abc import Callable
from time import perf_counter
from typing import Any, NamedTuple

import slicer
from vtkmodules.vtkCommonCore import VTK_OBJECT, vtkCommand

from SlicerUSSim.Logic.base.errors import user_message

_log = logging.getLogger(__name__)

#: Event of an output volume: another live update writes to it from now on.
_CLAIMED = vtkCommand.UserEvent + 7301
#: An image that takes longer is not live; the first of a patient or a probe includes its preparation, so the second
#: in a row ends the update
_SLOWEST_S, _SLOW_IMAGES = 10.0, 2
#: Priority of an observer that is called before others, whose is 0
_FIRST = 1000.0


class LiveNodes(NamedTuple):
    """The nodes of one live update; outline model and slice view may be None."""

    labels: Any
    probe_transform: Any
    output: Any
    outline: Any
    slice_view: Any


class LiveUpdate:
    """Keeps an output volume up to date with a probe transform, for UltrasoundSceneLogic.startLiveUpdate."""

    running = False

    def __init__(
        self,
        logic,
        nodes: LiveNodes,
        schedule: Callable[[Callable[[], None]], None] | None,
        report: Callable[[str], None] | None,
        stopped: Callable[[], None] | None,
    ) -> None:
        self._logic = weakref.ref(logic)  # the logic owns this object
        self._nodes: LiveNodes | None = nodes
        labels_node, transform_node, output_node = nodes.labels, nodes.probe_transform, nodes.output
        self._schedule, self._report, self._stopped = schedule, report, stopped
        self._pending = self._busy = False
        self._is_claimed = False  # by another live update, whose image is in the output now
        self._logged = ""
        self._slow = 0  # images in a row
        self._outlined = logic.preset.probe
        self._observed: list[tuple[Any, int]] = []
        self.running = True

        scene = logic.scene
        output_node.InvokeEvent(_CLAIMED)  # stops a live update that wrote to it before
        self._observe(output_node, _CLAIMED, self._claimed)
        self._observe(scene, scene.StartCloseEvent, self.stop)
        # Before Slicer's node selectors, which choose the next node instead: live images would go on into that
        self._observe(scene, scene.NodeAboutToBeRemovedEvent, self._node_goes, call_data=VTK_OBJECT, priority=_FIRST)
        self._observe(scene, scene.EndBatchProcessEvent, self._batch_ended)
        self._observe(transform_node, transform_node.TransformModifiedEvent, self.request)
        self._observe(labels_node, labels_node.TransformModifiedEvent, self.request)
        if labels_node.IsA("vtkMRMLSegmentationNode"):
            segmentation, events = labels_node.GetSegmentation(), slicer.vtkSegmentation
            for event in (
                events.SourceRepresentationModified,
                events.SegmentAdded,
                events.SegmentRemoved,
                events.SegmentModified,
            ):
                self._observe(segmentation, event, self.request)
        else:
            self._observe(labels_node, labels_node.ImageDataModifiedEvent, self.request)
            self._observe(labels_node, vtkCommand.ModifiedEvent, self.request)
        self._observe(logic.parameters.node, vtkCommand.ModifiedEvent, self.request)

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
        nodes, self._nodes, logic = self._nodes, None, self._logic()
        if nodes is not None and logic is not None and not self._is_claimed and nodes.output.GetScene() is not None:
            logic.holdImage(nodes.output)
        stopped, self._stopped, self._report = self._stopped, None, None
        if stopped is not None:
            stopped()

    def __del__(self) -> None:
        self._stopped = None
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
        logic, nodes = self._logic(), self._nodes
        if self._busy or not self._pending or logic is None or nodes is None:
            return  # changes can occur while the work is done in another thread
        self._pending = False
        self._busy = True
        begun = perf_counter()
        try:
            caught: list[Warning] = []
            logic.simulate(nodes.labels, nodes.probe_transform, nodes.output, warned=caught.append)
            if nodes.outline is not None and logic.preset.probe != self._outlined:
                logic.showOutline(nodes.outline, nodes.probe_transform)
                self._outlined = logic.preset.probe
            if nodes.slice_view is not None:
                logic.showInSlice(nodes.slice_view, nodes.output, nodes.probe_transform, fit=False)
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
