"""Workstation: one scene, one presenter, one page, run by `ussim serve`. All parts are created and connected here."""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, cast

import slicer
from trame.app import get_server
from trame_server import Server
from trame_slicer.core import SlicerApp

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic
from SlicerUSSim.Workstation.access import proof_key
from SlicerUSSim.Workstation.anatomy import AnatomyViews
from SlicerUSSim.Workstation.autosave import Autosave
from SlicerUSSim.Workstation.browser_panel import BrowserPanel, Observed
from SlicerUSSim.Workstation.comparison import Comparison
from SlicerUSSim.Workstation.export import Cine, Exports
from SlicerUSSim.Workstation.hand import KEYS
from SlicerUSSim.Workstation.image_flow import ImageFlow, LatencyStamps
from SlicerUSSim.Workstation.loading import Loading
from SlicerUSSim.Workstation.opener import Files, Opener
from SlicerUSSim.Workstation.opening import Opening
from SlicerUSSim.Workstation.page import build_page, view_tools
from SlicerUSSim.Workstation.pose_entry import PoseEntry
from SlicerUSSim.Workstation.pose_registration import Registration
from SlicerUSSim.Workstation.probe_control import ProbeControl
from SlicerUSSim.Workstation.questions import Questions
from SlicerUSSim.Workstation.restoring import Restoring
from SlicerUSSim.Workstation.session_store import OwnSession, SessionStore
from SlicerUSSim.Workstation.simulated import SimulatedSequence
from SlicerUSSim.Workstation.state import NAMES, SharedState
from SlicerUSSim.Workstation.tasks import Tasks
from SlicerUSSim.Workstation.tracker import Tracker
from SlicerUSSim.Workstation.transfer import Receiver, Sender

#: Seconds between two checks whether all work is done.
_LOOK_EVERY_S = 0.02


class Workstation:
    """The server side of the page. All pages show and control the same workstation.

    Parameters
    ----------
    files : files and options at the start.
    device : see opencl.devices.choose_device.
    sessions : where sessions are kept; None: nowhere.
    """

    def __init__(self, files: Files, device: str | None = None, sessions: SessionStore | None = None) -> None:
        self.server = cast(Server, get_server("ussim", client_type="vue3"))
        self._files = files
        self._shared = shared = SharedState(self.server.state)
        app = SlicerApp()
        # Registers the classes of sequence nodes; pyright does not see names that slicer imports from its libraries.
        app.register_module_logic(cast(Any, slicer).vtkSlicerSequencesLogic())
        stamps, cine = LatencyStamps(), Cine()

        self._tasks = tasks = Tasks(lambda error: self._panel.failed(error))
        self._logic = logic = UltrasoundSceneLogic(app.scene, device, tasks)
        self._panel = panel = BrowserPanel(shared, logic, tasks, stamps.image_begun)
        self._presenter = presenter = panel.presenter
        self._views = AnatomyViews(app, self.server, view_tools)
        self._probe = probe = ProbeControl(panel, self._views, stamps.probe_moved)
        self._poses = PoseEntry(panel, probe.pose, probe.move)
        probe.told = self._poses.show
        self._comparison = comparison = Comparison(shared, probe.move)
        self._tracker = Tracker(shared, tasks, probe.move)
        self._images = ImageFlow(panel, self._views, comparison, cine, self._tracker, stamps)
        self._simulated = SimulatedSequence(panel, comparison, probe.move)
        opener = Opener(app.scene, logic, tasks, files)
        presenter.segmenting.maskFile, presenter.segmenting.sheetsFile = opener.mask_file, opener.sheets_file
        panel.pick = probe.hand.pick
        self._exports = Exports(app, panel, opener, cine)
        self._registration = registration = Registration(panel, opener, comparison, probe.hand)
        self._loading = loading = Loading(panel, opener, self._views, probe, comparison, registration)
        self._questions = Questions(shared, tasks)
        self._opening = Opening(panel, opener, loading, registration, self._questions, self._poses)

        self._session = self._begun_session(sessions)
        self._autosave = Autosave(self._session, panel, opener, cine, probe.pose, lambda: registration.landmarks)
        self._restoring = Restoring(
            sessions if self._session is not None else None, panel, opener, loading, registration, probe, cine,
            self._autosave.when_kept, perf_counter,
        )  # fmt: skip
        self._opening.open_scene = self._restoring.open_scene

        self._following = False
        self._probe_node = Observed("TransformModifiedEvent", probe.moved)
        self._image_node = Observed("ImageDataModifiedEvent", self._images.image_changed)
        self._parameter_node = Observed("ModifiedEvent", self._parameters_changed)
        self._parameter_node.watch(logic.parameters.node)
        segmenting, lesions, placing = presenter.segmenting, presenter.lesions, presenter.placing
        panel.own_actions |= {
            segmenting.segment: loading.segment,
            segmenting.undoSegment: loading.undo_segment,
            lesions.addTissues: partial(loading.lay, lesions.addTissues),
            placing.openCraniotomy: loading.open_craniotomy,
            placing.closeCraniotomy: loading.close_craniotomy,
            placing.placeProbe: partial(loading.place, placing.placeProbe),
            placing.placeAtView: partial(loading.place, placing.placeAtView),
            placing.approach: partial(loading.place, placing.approach),
        }
        self._answer_pages(stamps)
        self._follow_pages()
        opened, added = partial(self._then_refresh, self._opening.open), partial(self._then_refresh, loading.add)
        receiver = Receiver(
            self._in_task(opened), self._in_task(added), panel.showError, self._in_task(self._poses.open)
        )  # fmt: skip
        self.server.controller.on_server_bind.add(lambda wslink: receiver.serve(wslink.app))
        self.server.controller.on_server_bind.add(lambda wslink: Sender(self._export).serve(wslink.app))
        self.server.controller.on_server_ready.add(self._ready)
        self.server.controller.on_server_exited.add(self.close)
        build_page(self.server, panel, self._views.layout, (*KEYS, "Escape"))

    def take_token(self, port: int) -> str:
        """The token of the last server at this port, if it was killed, so that its pages go on; otherwise a new one."""
        kept = None if self._sessions is None or port == 0 else self._sessions.token_of(port)
        token = kept or secrets.token_urlsafe(24)
        with self._shared.changing() as now:
            now.proof_key = proof_key(token)
        return token

    def keep_token(self, port: int, token: str) -> None:
        """Keep the token, in case this server is killed; called once it listens at this port."""
        if self._session is not None and self._shared.now.keeps_session:
            with suppress(SimulationError):  # the page then says that a new address is to be opened
                self._session.keep_address(port, token)

    @property
    def is_computing(self) -> bool:
        """Whether a thread computes something for the page."""
        return self._tasks.are_computing

    def end_session(self) -> None:
        """Called when the server ends as it should; what was kept of the patient stays."""
        if self._session is not None:
            self._session.end()
            self._session = None

    def _begun_session(self, sessions: SessionStore | None) -> OwnSession | None:
        self._sessions, session = sessions, None
        if sessions is not None:
            try:
                session = sessions.begin()
            except SimulationError as error:
                self._panel.showError(f"this session is not kept: {error}")
        with self._shared.changing() as now:
            now.keeps_session = now.can_keep_session = session is not None
        return session

    def close(self, **_: object) -> None:
        """Close the connection to the tracker and cancel waiting tasks."""
        self._autosave.end()
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
            "close_patient": self._in_task(self._loading.close_patient),
            "set_tissue": self._in_task(self._presenter.tissues.setTissue),
            "set_free": self._in_task(self._presenter.fits.setFree),
            "set_pose": probe.set_pose,
            "type_pose": self._in_task(self._poses.type),
            "key": probe.hand.key,
            "plane": probe.choose_plane,
            "look": self._in_task(probe.look_again),
            "aim_image": probe.aim_image,
            "play": self._play,
            "play_simulated": self._in_task(self._simulated.play),
            "show_simulated": self._in_task(self._simulated.show),
            "show_number": comparison.show,
            "answer": self._questions.answer,
            "calibrate": self._in_task(registration.calibrate),
            "register": self._in_task(registration.register),
            "choose_frame": self._in_task(registration.choose_frame),
            "pick_landmark": registration.pick,
            "landmark_in_image": registration.picked_in_image,
            "add_landmark": registration.add_typed,
            "remove_landmark": registration.remove_landmark,
            "fit_landmarks": self._in_task(registration.fit),
            "cancel": self._panel.cancel,
            "dismiss": self._panel.dismiss,
            "script": self._show_script,
            "restore_session": self._in_task(partial(self._then_refresh, self._restoring.restore)),
            "discard_session": self._in_task(self._restoring.discard),
            "session_kept": self._session_kept,
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

    async def _export(self, kind: str) -> tuple[str, bytes, str] | None:
        """(file name, content, MIME type), or None after an error was shown on the page, or a cancellation."""
        exported: asyncio.Future[tuple[str, bytes, str] | None] = asyncio.get_running_loop().create_future()

        def export() -> None:
            found = None
            try:
                with self._presenter.shown():
                    if kind.startswith("pose."):
                        found = *self._poses.file(kind.removeprefix("pose")), "application/octet-stream"
                    else:
                        found = self._exports.export(kind)
            finally:
                if not exported.done():  # the page may be gone
                    exported.set_result(found)

        self._tasks.start(export)
        return await exported

    def _play(self) -> None:
        self._simulated.stop()
        self._comparison.play()

    def _show_script(self) -> None:
        with self._presenter.shown(), self._shared.changing() as now:
            (now.script.text, now.script.needs_files), now.script.is_open = self._exports.script(), True

    async def _session_kept(self) -> bool:
        """Wait until the present state is kept on the disk; returns whether it is. For programs that control a page."""
        while not (self._is_at_rest and self._autosave.is_done):
            await asyncio.sleep(_LOOK_EVERY_S)
        self._autosave.look()
        while not self._autosave.is_done:
            await asyncio.sleep(_LOOK_EVERY_S)
        return self._autosave.has_kept

    async def _at_rest(self) -> dict[str, int]:
        """Wait until all requests of pages and trackers are done; returns the number of the last image by stream.

        For programs that control a page; a page is up to date once its canvases show those images.
        """
        while not self._is_at_rest:
            await asyncio.sleep(_LOOK_EVERY_S)
        return {stream.area_name: stream.count for stream in self._images.streams}

    @property
    def _is_at_rest(self) -> bool:
        sending = any(stream.is_sending for stream in self._images.streams)
        is_told = self._probe.is_told and self._images.is_shown
        return self._tasks.are_done and is_told and not sending and not self._comparison.is_comparing

    # ---- scene -------------------------------------------------------------------------------------------------

    def _ready(self, **_: object) -> None:
        for stream in self._images.streams:
            self.server.controller.rc_area_register(stream)
        self._tasks.start(self._begin)
        self._autosave.begin()

    def _begin(self) -> None:
        files = self._files
        if files.tracker is not None:
            with self._presenter.shown():
                self._tracker.start(files.tracker, files.tracker_device)
        if files.scene is not None:
            self._restoring.show_scene(files.scene, files.scene_name)
        else:
            self._loading.begin(files)
        if files.also_open is not None:
            with self._presenter.shown():
                self._opening.open({Path(files.also_open).name: Path(files.also_open).read_bytes()})
        self._restoring.offer()  # not before: what is restored takes the place of this patient
        self._panel.refresh()

    def _parameters_changed(self) -> None:
        if not self._following:
            self._following = True
            self._tasks.start(self._follow_parameters)

    def _follow_parameters(self) -> None:
        """Observe, draw and simulate the nodes that the scene's parameters refer to."""
        self._following = False
        parameters = self._logic.parameters
        self._loading.show_title()
        self._probe_node.watch(parameters.probe_transform)
        taken = self._logic.taken
        if self._image_node.watch(parameters.output) and taken is not None and taken.node is parameters.output:
            self._images.image_changed()  # it is in there already, as the frozen one of a scene at the start
        self._probe.draw()
        self._panel.tellFrozen()
        if self._logic.isLive:
            with self._presenter.shown():
                self._probe.update_surface()
        self._presenter.parametersChanged()
