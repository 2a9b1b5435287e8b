"""ProbeControl: where the probe is on the patient: moved by hand, sliders and trackers, followed by the views."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mrml.label_nodes import labels_version, read_labels
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic
from SlicerUSSim.Logic.mrml.nodes import node_to_world, probe_pose, set_node_to_world
from SlicerUSSim.Logic.probe.surface import PatientSurface
from SlicerUSSim.Workstation.anatomy import AnatomyViews
from SlicerUSSim.Workstation.hand import ProbeHand
from SlicerUSSim.Workstation.page import POSE_SLIDERS
from SlicerUSSim.Workstation.tasks import AtMost, Tasks

#: Seconds between two times that the slice views turn to the probe, and that the sliders are told where it is: both
#: take time that the image then has to wait for.
_TURN_EVERY_S, _TELL_EVERY_S = 0.12, 0.4


class ProbeControl:
    """Moves the probe's transform node, and tells views and sliders where it went.

    Parameters
    ----------
    state : of the trame server.
    """

    def __init__(self, state, logic: UltrasoundSceneLogic, tasks: Tasks, views: AnatomyViews) -> None:
        self._state, self._logic, self._tasks, self._views = state, logic, tasks, views
        self.surface: PatientSurface | None = None
        self._surface_version: object = None
        self._drawn: tuple | None = None
        #: Called when a hand is about to move the probe
        self.by_hand: Callable[[], None] = lambda: None
        self.turn_slices = AtMost(_TURN_EVERY_S, self._turn_slices)
        self._tell = AtMost(_TELL_EVERY_S, self._tell_pose)
        self.hand = ProbeHand(self.pose, self._moved_by_hand, lambda: self.surface, self._hold)
        for view in (views.threed, *views.slices):
            self.hand.attach(view)

    def pose(self) -> np.ndarray | None:
        """(4, 4) probe_to_world, or None without a probe, or with one that is scaled: simulating says so."""
        transform = self._logic.parameters.probe_transform
        try:
            return None if transform is None else probe_pose(transform)
        except SimulationError:
            return None

    def move(self, probe_to_world: np.ndarray) -> None:
        """Put the probe somewhere; the image follows."""
        transform = self._logic.parameters.probe_transform
        if transform is not None:
            set_node_to_world(transform, probe_to_world)

    def moved(self, *_) -> None:
        """The transform changed, whoever did it."""
        self.turn_slices()
        self._tell()

    # ---- what the page asks for --------------------------------------------------------------------------------

    def set_pose(self, name: str, value: float) -> None:
        """A slider of page.POSE_SLIDERS was moved."""
        pose = self.pose()
        if pose is not None and self.surface is not None and name in {slider[0] for slider in POSE_SLIDERS}:
            self.move(self.surface.held(pose, **{name: float(value)}))

    def aim_image(self, across: float, down: float) -> None:
        """Aim at a point of the image, in shares of its width and height."""
        pose = self.pose()
        left, right, top, bottom = self._logic.preset.probe.image_bounds_mm()
        if pose is not None:
            point = [left + across * (right - left), top + down * (bottom - top), 0.0, 1.0]
            self.hand.aim((pose @ point)[:3])

    def look(self) -> None:
        """Turn the 3D view to the probe."""
        pose = self.pose()
        if pose is not None and self.surface is not None:
            self._views.look_at_probe(pose, self.surface)

    def choose_plane(self, name: str, plane: str) -> None:
        """Let a slice view follow the probe in another plane."""
        self._views.set_plane(name, plane)
        self._state.planes = dict(self._views.planes)
        self.turn_slices()

    def follow_changed(self) -> None:
        """The user wants the slice views to follow the probe, or to rest."""
        self._views.follows = bool(self._state.follow)
        self.turn_slices()

    def show_tissues(self) -> None:
        """Colour the tissues in the slice views, or not."""
        self._views.show_labels(self._logic.parameters.labels, bool(self._state.show_tissues))

    # ---- patient and probe in the views ------------------------------------------------------------------------

    def update_surface(self) -> None:
        """Make the surface anew if the labels are others; called in a task."""
        labels = self._logic.parameters.labels
        if labels is None or (labels.IsA("vtkMRMLVolumeNode") and labels.GetImageData() is None):
            return
        version = labels_version(labels)
        if version == self._surface_version:
            return
        self._surface_version = version
        volume = read_labels(labels, self._logic.preset.tissues).volume
        placed = Volume(volume.array, node_to_world(labels) @ volume.ijk_to_ras)
        self.surface = self._tasks.do(lambda: PatientSurface(placed))
        self._views.show_surface(self.surface)
        self.show_tissues()
        self._tell()

    def draw(self) -> None:
        """Draw another probe, or the same under another transform."""
        transform, probe = self._logic.parameters.probe_transform, self._logic.preset.probe
        if transform is not None and (probe, transform) != self._drawn:
            self._drawn = (probe, transform)
            self.hand.set_probe(probe)
            self._views.show_probe(probe, transform)
            self.moved()

    # ---- inside ------------------------------------------------------------------------------------------------

    def _moved_by_hand(self, probe_to_world: np.ndarray) -> None:
        self.by_hand()
        self.move(probe_to_world)

    def _hold(self, view) -> None:
        self._views.hold(view)
        if view is None:
            self.moved()

    def _turn_slices(self) -> None:
        pose = self.pose()
        if pose is not None and self._logic.parameters.output is not None:
            self._views.follow(pose, self._logic.preset.probe)

    def _tell_pose(self) -> None:
        pose = self.pose()
        if pose is None or self.surface is None:
            return
        with self._state:
            for name, value in asdict(self.surface.where(pose)).items():
                self._state[f"pose_{name}"] = round(value, 2)
