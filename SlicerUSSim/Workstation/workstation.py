"""Workstation: one scene, one presenter, one page, run by `ussim serve`. All parts are created and connected here."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, cast

import slicer
from trame.app import get_server
from trame_server import Server
from trame_slicer.core import SlicerApp

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.imaging.self_check import golden_scene, golden_view
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic
from SlicerUSSim.Logic.mrml.nodes import Observed
from SlicerUSSim.Workstation.advice import Advice
from SlicerUSSim.Workstation.anatomy import AnatomyViews
from SlicerUSSim.Workstation.browser_panel import BrowserPanel
from SlicerUSSim.Workstation.cine import Cine
from SlicerUSSim.Workstation.comparison import Comparison
from SlicerUSSim.Workstation.export import Exports
from SlicerUSSim.Workstation.file_nodes import FileNodes, Files
from SlicerUSSim.Workstation.hand import KEYS
from SlicerUSSim.Workstation.image_flow import ImageFlow, LatencyStamps
from SlicerUSSim.Workstation.kept_state import KeptState
from SlicerUSSim.Workstation.opener import Opener
from SlicerUSSim.Workstation.page import build_page
from SlicerUSSim.Workstation.patient import OpenPatient
from SlicerUSSim.Workstation.pointer import Pointer
from SlicerUSSim.Workstation.pose_entry import PoseEntry
from SlicerUSSim.Workstation.pose_registration import Registration
from SlicerUSSim.Workstation.probe_control import ProbeControl
from SlicerUSSim.Workstation.questions import Questions
from SlicerUSSim.Workstation.scenes import Scenes
from SlicerUSSim.Workstation.state import NAMES, SharedState
from SlicerUSSim.Workstation.tasks import Tasks
from SlicerUSSim.Workstation.tracker import Tracker
from SlicerUSSim.Workstation.transfer import Transfer
from SlicerUSSim.Workstation.view_tools import view_tools

#: Seconds between two checks whether all work is done.
_LOOK_EVERY_S = 0.02


class Workstation:
    """The server side of the page. All pages show and control the same workstation.

    Parameters
    ----------
    files : files and options at the start.
    device : see opencl.devices.choose_device.
    state_file : where pose and settings are kept, see kept_state.state_file; None: nowhere.
    """

    def __init__(self, files: Files, device: str | None = None, state_file: Path | None = None) -> None:
        self.server = cast(Server, get_server("ussim", client_type="vue3"))
        self._files = files
        self._shared = shared = SharedState(self.server.state)
        app = SlicerApp()
        # Registers the classes of sequence nodes; pyright does not see names that slicer imports from its libraries.
        app.register_module_logic(cast(Any, slicer).vtkSlicerSequencesLogic())
        stamps = LatencyStamps()

        self._tasks = tasks = Tasks(lambda error: self._panel.failed(error))
        self._logic = logic = UltrasoundSceneLogic(app.scene, device, tasks)
        self._panel = panel = BrowserPanel(shared, logic, tasks, stamps.image_begun)
        self._presenter = presenter = panel.presenter
        self._views = AnatomyViews(app, self.server, view_tools)
        self._probe = probe = ProbeControl(panel, self._views, stamps.probe_moved)
        self._pointer = Pointer(shared, logic, self._views, probe)
        self._poses = PoseEntry(panel, probe.pose, probe.move)
        probe.told = self._poses.show
        self._comparison = comparison = Comparison(shared, probe.move, tasks.tell)
        presenter.fits.following = comparison.follow
        self._tracker = Tracker(shared, tasks, probe.move, logic)
        self._cine = cine = Cine(panel, comparison, probe.move)
        self._images = ImageFlow(panel, self._views, comparison, cine, self._tracker, stamps)
        nodes = FileNodes(logic, tasks, files)
        presenter.segmenting.maskFile, presenter.segmenting.sheetsFile = nodes.mask_file, nodes.sheets_file
        panel.pick = probe.hand.pick
        self._registration = registration = Registration(panel, nodes, comparison)
        self._patient = patient = OpenPatient(panel, nodes, self._views, probe, comparison, registration)
        self._exports = Exports(app, panel, cine, self._poses, patient.saved)
        self._questions = Questions(shared, tasks)
        self._scenes = Scenes(panel, nodes, patient, registration)
        self._opener = opener = Opener(
            panel, nodes, patient, self._scenes, registration, self._questions, self._poses
        )  # fmt: skip
        self._advice = advice = Advice(panel, registration)
        panel.refreshed.append(advice.update)
        self._kept = KeptState(state_file, panel, patient, opener, probe)

        self._following = False
        self._probe_node = Observed("TransformModifiedEvent", self._probe_moved)
        self._image_node = Observed("ImageDataModifiedEvent", self._images.image_changed)
        self._parameter_node = Observed("ModifiedEvent", self._parameters_changed)
        self._parameter_node.watch(logic.parameters.node)
        segmenting, lesions, placing = presenter.segmenting, presenter.lesions, presenter.placing
        panel.own_actions |= {
            segmenting.undoSegment: patient.undo_segment,
            placing.placeProbe: partial(patient.place, placing.placeProbe),
            placing.placeAtView: partial(patient.place, placing.placeAtView),
        }
        open_here = presenter.approach.openHere
        panel.own_actions[open_here] = lambda: patient.place(lambda: patient.then_show(open_here))
        for action in (segmenting.segment, lesions.addTissues, placing.openCraniotomy, placing.closeCraniotomy):
            panel.own_actions[action] = partial(patient.then_show, action)
        self._answer_pages(stamps)
        self._follow_pages()
        opened = self._in_task(partial(self._then_refresh, opener.open_sent))
        transfer = Transfer(opened, self._export, panel.showError)
        self.server.controller.on_server_bind.add(lambda wslink: transfer.serve(wslink.app))
        self.server.controller.on_server_ready.add(self._ready)
        self.server.controller.on_server_exited.add(self.close)
        build_page(self.server, panel, (*KEYS, "Escape"))

    def close(self, **_: object) -> None:
        """Close the connection to the tracker and cancel waiting tasks."""
        self._logic.stopLiveUpdate()
        self._tracker.stop()
        self._tasks.stop()

    # ---- pages -------------------------------------------------------------------------------------------------

    def _answer_pages(self, stamps: LatencyStamps) -> None:
        """Register the triggers by which pages call methods."""
        probe, comparison, registration = self._probe, self._comparison, self._registration
        triggers: dict[str, Callable[..., object]] = {
            "set": self._panel.set,
            "press": self._panel.press,
            "close_patient": self._in_task(self._opener.close_patient),
            "set_tissue": self._in_task(self._presenter.tissues.setTissue),
            "set_free": self._in_task(self._presenter.fits.setFree),
            "set_pose": probe.set_pose,
            "type_pose": self._in_task(self._poses.type),
            "key": probe.hand.key,
            "plane": probe.choose_plane,
            "look": self._in_task(probe.look_again),
            "aim_image": probe.aim_image,
            "point_at": self._pointer.at_image,
            "play": self._play,
            "freeze": self._in_task(partial(self._then_refresh, self._cine.freeze)),
            "cine_show": self._in_task(self._cine.show),
            "cine_step": self._in_task(self._cine.step),
            "cine_play": self._in_task(self._cine.play),
            "cine_trim": self._cine.trim,
            "cine_source": self._in_task(self._cine.choose),
            "mmode": self._cine.draw_mmode,
            "show_number": comparison.show,
            "choose_tissue": lambda name: self._shared.put("panel", {"chosen_tissue": name}),
            "answer": self._questions.answer,
            "choose_frame": self._in_task(registration.choose_frame),
            "remedy": self._in_task(self._advice.follow),
            "dismiss_advice": self._advice.dismiss,
            "compare_next": comparison.compare_next,
            "cancel": self._panel.cancel,
            "dismiss": self._panel.dismiss,
            "restore": self._in_task(partial(self._then_refresh, self._kept.restore)),
            "discard": self._in_task(self._kept.discard),
            "stamp": stamps.receive,
            "page_opened": self._images.show_again,
            "at_rest": self._at_rest,
        }
        for name, method in triggers.items():
            self.server.controller.trigger(name)(method)

    def _follow_pages(self) -> None:
        """React to changes that pages make in the shared state."""
        self._shared.on_change(NAMES.views.blend, self._views.set_blend)
        self._shared.on_change(NAMES.views.follow, self._probe.set_follow)
        self._shared.on_change(NAMES.views.show_tissues, self._probe.show_tissues)
        self._shared.on_change(NAMES.sequence.comparison, lambda _: self._comparison.send())

    def _in_task(self, method: Callable[..., None]) -> Callable[..., None]:
        return lambda *arguments: self._tasks.start(lambda: method(*arguments))

    def _then_refresh(self, method: Callable[..., None], *arguments: object) -> None:
        method(*arguments)
        self._panel.refresh()

    async def _export(self, kind: str, sent: Mapping[str, bytes] | None = None) -> tuple[str, bytes, str] | None:
        """(file name, content, MIME type), or None after an error was shown on the page, or a cancellation."""
        exported: asyncio.Future[tuple[str, bytes, str] | None] = asyncio.get_running_loop().create_future()

        def export() -> None:
            found = None
            try:
                with self._presenter.shown():
                    found = self._exports.export(kind, sent or {})
            finally:
                if not exported.done():  # the page may be gone
                    exported.set_result(found)

        self._tasks.start(export)
        return await exported

    def _play(self) -> None:
        self._cine.stop()
        self._comparison.play()

    async def _at_rest(self) -> dict[str, int]:
        """Wait until all requests of pages and trackers are done; returns the number of the last image by stream.

        For programs that control a page; a page is up to date once its canvases show those images.
        """
        while not self._is_at_rest:
            await asyncio.sleep(_LOOK_EVERY_S)
        return {stream.area_name: stream.count for stream in self._images.streams}

    @property
    def _is_at_rest(self) -> bool:
        is_told = self._probe.is_told and self._images.is_shown
        return self._tasks.are_done and is_told and not self._comparison.is_comparing

    # ---- scene -------------------------------------------------------------------------------------------------

    def _ready(self, **_: object) -> None:
        for stream in self._images.streams:
            self.server.controller.rc_area_register(stream)
        self._images.watch()
        self._tasks.start(self._begin)
        self._tasks.start(lambda: self._tasks.doAside(self._build_kernels))

    def _build_kernels(self) -> None:
        """While the patient's files are read and segmented: the first image would wait for them."""
        with suppress(SimulationError):  # which the first image reports
            golden_view(UltrasoundSimulator(*golden_scene(), device=self._logic.device), self._logic.preset.probe)

    def _begin(self) -> None:
        files = self._files
        if files.tracker is not None:
            with self._presenter.shown():
                self._tracker.start(files.tracker, files.tracker_device)
        if files.scene is not None:
            with self._presenter.shown():
                self._scenes.show(files.scene, files.scene_name)
        else:
            self._patient.begin(files)
        if files.also_open is not None:
            self._opener.open_paths([files.also_open])
        self._kept.offer()  # not before: it concerns the open patient
        self._panel.refresh()

    def _probe_moved(self) -> None:
        self._probe.moved()
        self._kept.changed()

    def _parameters_changed(self) -> None:
        if not self._following:
            self._following = True
            self._tasks.start(self._follow_parameters)

    def _follow_parameters(self) -> None:
        """Observe, draw and simulate the nodes that the scene's parameters refer to."""
        self._following = False
        parameters = self._logic.parameters
        self._patient.show_title()
        self._probe_node.watch(parameters.probe_transform)
        taken = self._logic.taken
        if self._image_node.watch(parameters.output) and taken is not None and taken.node is parameters.output:
            self._images.image_changed()  # it is in there already, as the frozen one of a scene at the start
        self._probe.draw()
        if self._logic.isLive:
            with self._presenter.shown():
                self._probe.update_surface()
        self._presenter.parametersChanged()
        self._kept.changed()
        with self._presenter.shown():
            self._cine.follow_display()  # at the end, since it waits for the device
