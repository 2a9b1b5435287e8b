"""Workstation: one scene, one presenter, one page: what `ussim serve` runs."""

from __future__ import annotations

import asyncio
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np
from slicer import vtkSlicerSequencesLogic
from trame.app import get_server
from trame_server.utils.asynchronous import get_event_loop
from trame_slicer.core import SlicerApp
from vtkmodules.vtkCommonCore import vtkCommand

from SlicerUSSim.Logic.base.errors import SimulationError, require, user_message
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mrml.label_nodes import labels_version
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.tracked.openigtlink import TrackerLink, parse_address
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence
from SlicerUSSim.Widget.presenter import PanelPresenter
from SlicerUSSim.Workstation.anatomy import AnatomyViews
from SlicerUSSim.Workstation.comparison import Comparison
from SlicerUSSim.Workstation.export import Exports
from SlicerUSSim.Workstation.hand import KEYS
from SlicerUSSim.Workstation.opener import Files, Opener
from SlicerUSSim.Workstation.page import build_page, initial_state, view_tools
from SlicerUSSim.Workstation.panel_view import BrowserView
from SlicerUSSim.Workstation.probe_control import ProbeControl
from SlicerUSSim.Workstation.sections import read_sections
from SlicerUSSim.Workstation.streams import ImageStream
from SlicerUSSim.Workstation.tasks import Tasks


class Workstation:
    """Everything behind the page. All pages show and drive the same workstation.

    Parameters
    ----------
    files : what to begin with.
    device : see opencl.devices.choose_device.
    """

    def __init__(self, files: Files, device: str | None = None) -> None:
        self.server = get_server("ussim", client_type="vue3")
        self.files = files
        self.state = self.server.state
        self.app = SlicerApp()
        self.app.register_module_logic(vtkSlicerSequencesLogic())  # whose nodes the scene does not know without it
        self.tasks = Tasks(self._failed)
        self.logic = UltrasoundSceneLogic(self.app.scene, device, self.tasks)
        sections = read_sections()
        self._controls = {control.name: control for section in sections for control in section.controls}
        self.view = BrowserView(self.state, self.tasks, sections)
        self.state.update({**initial_state(sections), "probe_keys": list(KEYS), "trame__title": "SlicerUSSim"})
        self.presenter = self.view.presenter = PanelPresenter(self.logic, self.view, handles=False)
        self.views = AnatomyViews(self.app, self.server, view_tools, lambda: self.probe.turn_slices())
        self.probe = ProbeControl(self.state, self.logic, self.tasks, self.views)
        self.probe.by_hand = self._moved_by_hand
        self._stream = ImageStream("simulated")
        self.opener = Opener(self.app.scene, self.logic, self.tasks, files)
        self.exports = Exports(self.app, self.logic, self.opener)
        self.comparison = Comparison(self.state, self.probe.move)
        self._link: TrackerLink | None = None
        self._observed: dict[str, tuple[object, int]] = {}
        self._field: tuple = (None, None)  # of an image's grid and probe
        self._stamp_told = self._stamp_applied = self._stamp_computed = None
        self._refreshing = False
        self._connect()
        build_page(self.server, sections, self.views.layout)

    # ---- life --------------------------------------------------------------------------------------------------

    def _connect(self) -> None:
        probe, comparison, fits = self.probe, self.comparison, self.presenter.fits
        triggers: dict[str, Callable] = {
            "set": self._set_control, "press": self._press, "set_tissue": self._in_task(self.presenter.setTissue),
            "set_free": self._in_task(fits.setFree), "set_pose": probe.set_pose, "key": probe.hand.key,
            "plane": probe.choose_plane, "look": probe.look, "aim_image": probe.aim_image, "play": comparison.play,
            "show_number": comparison.show, "cancel": self.view.cancel, "dismiss": self._dismiss,
            "export": self._export, "script": self._show_script, "stamp": self._stamped, "page_opened": self._opened,
        }  # fmt: skip
        for name, method in triggers.items():
            self.server.controller.trigger(name)(method)
        for name, method in (
            ("blend", lambda: self.views.set_blend(float(self.state.blend))),
            ("follow", self.probe.follow_changed),
            ("upright", lambda: setattr(self.probe.hand, "upright", bool(self.state.upright))),
            ("show_tissues", self.probe.show_tissues),
            ("comparison", self.comparison.send),
            ("opened_file", self._file_opened),
        ):
            self.state.change(name)(lambda method=method, **_: method())
        node = self.logic.parameters.node
        node.AddObserver(vtkCommand.ModifiedEvent, self._parameters_changed)
        self.view.about_to_compute = self._about_to_compute
        self.server.controller.on_server_ready.add(self._ready)
        self.server.controller.on_server_exited.add(self.close)

    def _ready(self, **_) -> None:
        for stream in (self._stream, *self.comparison.streams):
            self.server.controller.rc_area_register(stream)
        self.tasks.start(self._begin)

    def _begin(self) -> None:
        """Load what was asked for, and show the first image."""
        files, parameters = self.files, self.logic.parameters
        with self.presenter.shown():
            if files.preset is not None:
                self.logic.preset = files.preset
            parameters.contrast = files.contrast
            if files.tracker is not None:
                host, port, listen = parse_address(files.tracker)
                self._link = TrackerLink(host, port, self._tracked, device=files.tracker_device, listen=listen)
                get_event_loop().create_task(self._show_tracker())
            if files.mri is not None or files.labels is None:
                self._take_mri(files.mri)
            if files.mask is not None:
                parameters.mask = self.opener.mask(files.mask)
            if files.labels is not None:
                self._take_labels(files.labels)
            else:
                self.segment()
            if files.sequence is not None:
                self._take_sequence(files.sequence, files.sequence_name)
        self.view.refresh()

    def close(self, **_) -> None:
        """Let go of the tracker and of what waits."""
        self.logic.stopLiveUpdate()
        if self._link is not None:
            self._link.stop()
        self.tasks.stop()

    def _failed(self, error: Exception) -> None:
        message = user_message(error)
        if message is None:
            traceback.print_exception(error)
            message = f"something went wrong ({type(error).__name__}: {error})"
        self.view.showError(message)

    def _in_task(self, method: Callable) -> Callable:
        return lambda *arguments: self.tasks.start(lambda: method(*arguments))

    # ---- files -------------------------------------------------------------------------------------------------

    def _take_labels(self, path: str) -> None:
        node = self.opener.labels(path)
        if self.logic.parameters.mri is None:
            self._take_volume(node)
        self.logic.parameters.labels = node
        self._labels_ready()

    def _take_mri(self, path: str | None) -> None:
        parameters = self.logic.parameters
        node = self.opener.mri(path)
        self.logic.stopLiveUpdate()  # until there are labels of it
        parameters.mri, parameters.labels, parameters.mask = node, None, None
        self._take_volume(node)

    def _take_volume(self, node) -> None:
        self.state.title = node.GetName()
        self.views.show_volume(node)

    def _take_sequence(self, sequence: TrackedSequence, name: str) -> None:
        """The probe goes where the images were taken, and is the one that took them."""
        tracked, browser, images = self.opener.sequence(sequence, name)
        self.logic.preset = replace(self.logic.preset, probe=tracked.probe)
        self.logic.parameters.real = images
        self.comparison.take(tracked, browser)

    def _file_opened(self) -> None:
        given = self.state.opened_file
        given = given[0] if isinstance(given, list) and given else given
        if not given or not given.get("content"):
            return
        name, content = Path(given["name"]).name, bytes(given["content"])
        with self.state:
            self.state.opened_file = None
        self.tasks.start(lambda: self._open_content(name, content))

    def _open_content(self, name: str, content: bytes) -> None:
        """Whatever a page sent: an MRI, a label map, a tracked sequence, or settings."""
        with self.presenter.shown(), self.opener.uploaded(name, content) as (path, kind):
            if kind == "preset":
                self.logic.preset = Preset.read(path)
            elif kind == "sequence":
                self._take_sequence(self.tasks.do(lambda: TrackedSequence.read(path)), name.split(".")[0])
            elif kind == "labels":
                self._take_labels(path)
            else:
                self._take_mri(path)
                self.segment()
        self.view.refresh()

    # ---- what the panel does -----------------------------------------------------------------------------------

    def segment(self) -> None:
        """Label the MRI's tissues, and put a probe on the patient if there is none."""
        parameters = self.logic.parameters
        if parameters.mri is not None and parameters.labels is None:
            # A label map: ten times as fast to fill as a segmentation, and its tissues colour the slice views.
            name = self.app.scene.GenerateUniqueName(f"{parameters.mri.GetName()} tissues")
            parameters.labels = self.app.scene.AddNewNodeByClass("vtkMRMLLabelMapVolumeNode", name)
        labels, mri, mask = parameters.labels, parameters.mri, parameters.mask
        options = {name: getattr(parameters, name) for name in ("contrast", "classes", "thin_sulci", "bias_correction")}
        before = None if labels is None else labels_version(labels)
        self.presenter.segment()
        if labels is None or labels_version(labels) == before:
            if labels is not None and labels.IsA("vtkMRMLVolumeNode") and labels.GetImageData() is None:
                self.app.scene.RemoveNode(labels)  # made for this, and nothing came of it
            return
        self.opener.segmented(labels, mri, mask, options)
        self._labels_ready()

    def _labels_ready(self) -> None:
        if self.logic.parameters.probe_transform is None:
            self.presenter.placeProbe()
        if not self.logic.isLive:
            self.presenter.setLive(True)
        self.probe.update_surface()  # which the first image does not need
        self.probe.look()

    def _press(self, name: str) -> None:
        presenter, fits = self.presenter, self.presenter.fits
        actions = {
            "segmentButton": self.segment, "simulateButton": presenter.simulate, "placeButton": self._place,
            "resetTissuesButton": presenter.resetTissues, "assignTissueButton": self._assign_tissue,
            "simulateSequenceButton": self._simulate_sequence, "fitButton": fits.fit, "applyFitButton": fits.apply,
            "revertFitButton": fits.revert,
        }  # fmt: skip
        self.tasks.start(actions[name])

    def _set_control(self, name: str, value) -> None:
        control = self._controls[name]
        if control.kind == "node" and not (control.node):
            self.state[f"control_{name}"] = value
            return
        if name == "tissuePresetComboBox":
            self.state.control_tissuePresetComboBox = value
            return
        self.tasks.start(lambda: self.view.changed(control, value))

    def _assign_tissue(self) -> None:
        with self.presenter.shown():
            require(bool(self.state.chosen_tissue), "no tissue chosen, click on its line in the table")
            self.presenter.assignTissue(self.state.chosen_tissue, self.state.control_tissuePresetComboBox)

    def _simulate_sequence(self) -> None:
        scene = self.app.scene
        chosen = [
            scene.GetNodeByID(self.state[f"control_{name}"] or "")
            for name in ("transformSequenceSelector", "imageSequenceSelector")
        ]
        self.presenter.simulateSequence(*chosen)

    def _place(self) -> None:
        self.presenter.placeProbe()
        self.probe.look()

    # ---- the image ---------------------------------------------------------------------------------------------

    def _parameters_changed(self, *_) -> None:
        if not self._refreshing:
            self._refreshing = True
            self.tasks.start(self._follow_parameters)

    def _follow_parameters(self) -> None:
        self._refreshing = False
        parameters = self.logic.parameters
        self._watch("probe", parameters.probe_transform, "TransformModifiedEvent", self.probe.moved)
        self._watch("image", parameters.output, "ImageDataModifiedEvent", self._image_changed)
        self.probe.draw()
        self._tell_field()
        if self.logic.isLive:
            with self.presenter.shown():
                self.probe.update_surface()
        self.presenter.parametersChanged()

    def _watch(self, role: str, node, event: str, method: Callable) -> None:
        if role in self._observed and self._observed[role][0] is node:
            return
        if role in self._observed:
            observed, tag = self._observed.pop(role)
            observed.RemoveObserver(tag)
        if node is not None:
            self._observed[role] = (node, node.AddObserver(getattr(node, event), method))

    def _tell_field(self) -> None:
        """What the page draws around the image: its place in the probe frame, depths, focus, grey levels."""
        preset = self.logic.preset
        grid = ImageGrid.for_probe(preset.probe, preset.display.image_size)
        width, height = grid.columns * grid.pixel_spacing_mm[0], grid.rows * grid.pixel_spacing_mm[1]
        step = 10 if height > 40 else 5
        ticks = [
            {"y": depth, "text": str(depth) if depth % (2 * step) == 0 else ""}
            for depth in range(0, int(grid.top_mm + height) + 1, step)
        ]
        with self.state:
            self.state.us = {
                "x": grid.left_mm, "y": grid.top_mm, "w": width, "h": height, "ticks": ticks, "size": height / 36.0,
                "focus": preset.probe.focus_mm, "range": f"{preset.display.dynamic_range_db:.0f}",
            }  # fmt: skip

    def _moved_by_hand(self) -> None:
        self._stamp_applied = self._stamp_told

    def _stamped(self, page: str, milliseconds: float) -> None:
        self._stamp_told = (page, milliseconds)

    def _about_to_compute(self) -> None:
        self._stamp_computed = self._stamp_applied

    def _image_changed(self, *_) -> None:
        frame = self.logic.lastFrame
        self._stream.send(frame.image, stamp=self._stamp_computed)
        self.exports.cine.add(frame.image, perf_counter())
        self.views.show_image(self.logic.parameters.output, self._field_of(frame.grid))
        if self._link is not None:
            self._link.send(self.logic.lastImage())
        self.comparison.compare(frame.image, frame.grid)

    def _field_of(self, grid: ImageGrid) -> np.ndarray:
        """(rows, columns) bool: where an image shows anything."""
        probe = self.logic.preset.probe
        if self._field[0] != (grid, probe):
            self._field = ((grid, probe), grid.field(probe))
        return self._field[1]

    def _opened(self) -> None:
        """Another page came: it has to be shown what there is."""
        for stream in (self._stream, *self.comparison.streams):
            stream.send_again()
        for view in (self.views.threed, *self.views.slices):
            view.schedule_render()

    # ---- tracker -----------------------------------------------------------------------------------------------

    def _tracked(self, pose: np.ndarray) -> None:
        self.tasks.tell(lambda: self.probe.move(pose))

    async def _show_tracker(self) -> None:
        while self._link is not None:
            if self.state.tracker_status != self._link.status:
                with self.state:
                    self.state.tracker_status = self._link.status
            await asyncio.sleep(0.3)

    # ---- export ------------------------------------------------------------------------------------------------

    async def _export(self, kind: str):
        """[file name, content, MIME type], or None after the page was told why not."""
        try:
            name, content, mime = await self.exports.export(kind)
        except SimulationError as error:
            self.view.showError(str(error))
            return None
        return [name, self.server.protocol.addAttachment(content), mime]

    def _show_script(self) -> None:
        with self.presenter.shown():
            self.state.update({"script": self.exports.script(), "show_script": True})

    def _dismiss(self, number: int) -> None:
        self.state.errors = [message for n, message in enumerate(self.state.errors) if n != number]
