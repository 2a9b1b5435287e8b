"""ImagePresenter: single images, live images, and those of a recorded sequence of poses, without Qt."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import perf_counter
from typing import Any

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.mrml.nodes import nodes_of_class, put_beside
from SlicerUSSim.Logic.mrml.parameter_node import SceneParameters
from SlicerUSSim.Logic.mrml.sequence_nodes import MADE_FROM
from SlicerUSSim.Logic.mrml.taken_sequence import FrozenRecord
from SlicerUSSim.Widget.interface import PanelHost, tr as _
from SlicerUSSim.Widget.notes import Notes
from SlicerUSSim.Widget.placement_presenter import PlacementPresenter

#: State of an image that no longer follows the probe
FROZEN = "FROZEN"


class ImagePresenter:
    """Simulates images into the chosen nodes, or into new ones."""

    def __init__(self, panel: PanelHost, notes: Notes, placing: PlacementPresenter) -> None:
        self._panel, self._notes, self._placing = panel, notes, placing
        self._last_image: float | None = None
        self._followed: tuple = ()  # the nodes of the live update
        self._in_3d: Any = None  # slice view that this shows in the 3D views
        #: Result of the last simulateSequence, as text
        self.sequenceDone = ""

    def simulate(self) -> None:
        """Simulate one image, into the chosen volume or a new one."""
        logic, view = self._panel.logic, self._panel.view
        with self._panel.acting():
            self._panel.awaitKernels()
            nodes = self._nodes()
            start = perf_counter()
            caught: list[Warning] = []
            logic.simulate(nodes.labels, nodes.probe_transform, nodes.output, warned=caught.append)
            self._notes.recognise(nodes.labels)
            view.showStatus("; ".join(map(str, caught)) or f"{(perf_counter() - start) * 1e3:.0f} ms")
            logic.showOutline(nodes.outline, nodes.probe_transform)
            if (slice_node := self._slice_node()) is not None:
                logic.showInSlice(slice_node, nodes.output, nodes.probe_transform)
            self.showIn3D()
            if not logic.isLive:
                logic.holdImage(nodes.output)

    def showFrozen(self, record: FrozenRecord) -> None:
        """Show the image of a scene that was saved, which stays where it was taken."""
        with self._panel.shown():
            self._panel.logic.showFrozen(record, self._nodes().output)
            self._stopped()

    # ---- live images -------------------------------------------------------------------------------------------

    def isLive(self) -> bool:
        """Whether live images are on."""
        return self._panel.logic.isLive

    def setLive(self, on: bool) -> None:
        """Start or stop live update."""
        logic = self._panel.logic
        if on == logic.isLive:
            return
        if not on:
            logic.stopLiveUpdate()
            return
        with self._panel.acting():
            self._panel.awaitKernels()
            self._nodes()
            self._last_image = None
            self._followed = self._live_nodes()
            logic.startLiveUpdate(
                *self._followed, schedule=self._panel.view.schedule, report=self._reported, stopped=self._stopped
            )
            self._notes.recognise(self._panel.parameters.labels)
            self.showIn3D()

    def showIn3D(self) -> None:
        """Show the slice view of the image and the probe's model in the 3D views, or hide them, as chosen."""
        parameters = self._panel.parameters
        outline: Any = parameters.outline
        if parameters.output is None or outline is None or not self._placing.handles:
            return
        view = self._slice_node()
        if self._in_3d not in (None, view):
            self._in_3d.SetSliceVisible(False)
        self._in_3d = view
        if view is not None:
            view.SetSliceVisible(parameters.panel.show_in_3d)
        self._panel.logic.showProbe(outline, parameters.panel.show_probe)

    def followChoices(self) -> None:
        """Begin live update anew if other nodes or another slice view were chosen."""
        if self._panel.logic.isLive and self._live_nodes() != self._followed:
            self._panel.logic.stopLiveUpdate()
            self.setLive(True)

    def _live_nodes(self) -> tuple:
        nodes = self._panel.parameters
        return nodes.labels, nodes.probe_transform, nodes.output, nodes.outline, self._slice_node()

    def _reported(self, message: str) -> None:
        now = perf_counter()
        if not message and self._last_image is not None and now - self._last_image < 1.0:
            rate = 1.0 / max(now - self._last_image, 1e-3)
            message = _("{rate:.0f} images per second").format(rate=rate)
        self._panel.view.showStatus(message)
        self._last_image = now
        if self._notes.probeSaysOther():
            self._panel.view.refresh()

    def _stopped(self) -> None:
        taken = self._panel.logic.taken
        self._panel.view.showStatus("" if taken is None else f"{FROZEN}: {taken.patient}, {taken.time[11:19]} UTC")
        self._panel.view.refresh()

    # ---- sequence ----------------------------------------------------------------------------------------------

    def simulateSequence(self) -> None:
        """Simulate an image for each transform of the chosen sequence; its sequence browser plays both."""
        panel, parameters = self._panel, self._panel.parameters
        transforms_node: Any = parameters.transform_sequence
        images_node: Any = parameters.image_sequence
        with panel.acting(), panel.working(_("Simulate sequence")) as progress:
            require(transforms_node is not None, "no sequence of transforms chosen, expected a Sequence node")
            own = (None, transforms_node.GetID())
            if images_node is not None and images_node.GetNodeReferenceID(MADE_FROM) not in own:
                images_node = None  # those of other transforms stay
            with self._images_at(transforms_node, transforms_node.GetName(), images_node, progress) as (images, count):
                self.sequenceDone = _("{count} images in {name!r}").format(count=count, name=images.GetName())

    def sweepAlongPath(self) -> None:
        """Simulate the images of a probe that moves along the chosen path, and compound them to a volume."""
        panel, parameters = self._panel, self._panel.parameters
        path_node: Any = parameters.path
        with panel.acting(), panel.working(_("Sweep along path")) as progress:
            require(path_node is not None, "no path chosen, expected a curve or a line of Markups on the patient")
            browser, transforms = panel.logic.followPath(parameters.labels, path_node)
            try:
                name, report = path_node.GetName(), lambda share: progress(0.95 * share)
                with (
                    self._images_at(transforms, name, None, report) as (images, count),
                    panel.made(None, "ScalarVolume", f"{name} volume") as volume,
                ):
                    panel.logic.compoundSequence(images, volume)
            except BaseException:
                panel.logic.scene.RemoveNode(browser)
                panel.logic.scene.RemoveNode(transforms)
                raise
            parameters.transform_sequence = transforms
            self.sequenceDone = _("{count} images in {name!r}, compounded to {volume!r}").format(
                count=count, name=images.GetName(), volume=volume.GetName()
            )

    @contextmanager
    def _images_at(
        self, transforms_node: Any, name: str, images_node: Any, progress: Callable[[float], None]
    ) -> Iterator[tuple[Any, int]]:
        """(sequence node of the images at transforms, their number); it is chosen and shown if the block succeeds.

        `images_node` is filled; None: a new one, called after `name`. A browser for both is made if there is none.
        """
        panel, parameters = self._panel, self._panel.parameters
        with (
            panel.made(images_node, "Sequence", f"{name} ultrasound") as images,
            panel.made(self._browser_of(transforms_node), "SequenceBrowser", f"{name} browser") as browser,
        ):
            browser.AddSynchronizedSequenceNode(transforms_node)
            count = panel.logic.simulateSequence(
                parameters.labels, transforms_node, images, browser_node=browser, progress=progress
            )
            yield images, count
        images.SetNodeReferenceID(MADE_FROM, transforms_node.GetID())
        parameters.image_sequence = images  # in place of which the next ones come
        self._show_played(browser, images, transforms_node)

    def _show_played(self, browser: Any, images: Any, transforms: Any) -> None:
        """Show the image of a sequence that its browser plays in the chosen slice view."""
        slice_node, shown = self._slice_node(), browser.GetProxyNode(images)
        if slice_node is not None and shown is not None:
            self._panel.logic.showInSlice(slice_node, shown, browser.GetProxyNode(transforms))

    def _browser_of(self, sequence_node: Any) -> Any:
        browsers = nodes_of_class(self._panel.logic.scene, "vtkMRMLSequenceBrowserNode")
        return next((node for node in browsers if node.IsSynchronizedSequenceNode(sequence_node, True)), None)

    def _slice_node(self) -> Any:
        """The chosen slice view, if images are shown in it; None otherwise."""
        return self._panel.view.sliceNode() if self._panel.parameters.panel.show_in_slice else None

    # ---- nodes -------------------------------------------------------------------------------------------------

    def _nodes(self) -> SceneParameters:
        """The parameters, with the nodes that simulation needs; nodes that are not selected are created."""
        parameters = self._panel.parameters
        require(parameters.labels is not None, "no label map chosen; segment the MRI first")
        if parameters.probe_transform is None:
            self._placing.put()
        parameters.output = self._own(parameters.output, "ScalarVolume", "Ultrasound")
        parameters.outline = self._own(parameters.outline, "Model", "Ultrasound outline")
        return parameters

    def _own(self, chosen: Any, kind: str, name: str) -> Any:
        """The chosen node, or a new one if none is chosen or it has other data, which the notes report."""
        if chosen is not None and self._panel.logic.mayReplaceResult(chosen):
            return chosen
        node = self._panel.add(kind, name)
        put_beside(node, self._panel.parameters.labels)
        if chosen is not None:
            self._notes.add(f"{chosen.GetName()!r} has other data and is kept; the result is {node.GetName()!r}")
        return node
