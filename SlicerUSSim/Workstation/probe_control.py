"""ProbeControl: pose of the probe on the patient, set by mouse, keys, sliders and tracker, followed by the views."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np
from trame_slicer.views import SliceView

from SlicerUSSim.Logic.base.errors import Cancelled, SimulationError
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mrml.label_nodes import labels_version, read_labels
from SlicerUSSim.Logic.mrml.nodes import node_to_world, probe_pose, set_node_to_world
from SlicerUSSim.Logic.probe.surface import PatientSurface, SurfacePose
from SlicerUSSim.Workstation.anatomy import AnatomyViews
from SlicerUSSim.Workstation.browser_panel import BrowserPanel
from SlicerUSSim.Workstation.hand import ProbeHand
from SlicerUSSim.Workstation.tasks import AtMost

_log = logging.getLogger(__name__)

#: Seconds between two updates of the slice views, and of the sliders: both delay the image.
_TURN_EVERY_S, _TELL_EVERY_S = 0.12, 0.4
#: Message after a surface was cancelled
_NO_SURFACE = "no surface of the patient for the probe to slide on: the camera over the 3D view makes it"
_POSE_FIELDS = tuple(entry.name for entry in fields(SurfacePose))


class ProbeControl:
    """Moves the probe's transform node, and updates views and sliders.

    Parameters
    ----------
    about_to_move : called before the user moves the probe with mouse or keys.
    """

    def __init__(self, panel: BrowserPanel, views: AnatomyViews, about_to_move: Callable[[], None]) -> None:
        self._shared, self._logic, self._tasks, self._views = panel.shared, panel.logic, panel.tasks, views
        self._about_to_move, self._progress = about_to_move, panel.progress
        self.surface: PatientSurface | None = None
        self._surface_version: object = None
        #: The labels in the world, and the names of tissue 1, 2, ... of which the surface is
        self.labelled: tuple[Volume, tuple[str, ...]] | None = None
        #: Called with the slice view under the mouse, and the point (3,) in the world
        self.hovered: Callable[[SliceView, np.ndarray], None] = lambda view, point: None
        self._drawn: tuple | None = None
        self._refused = False  # whether the last pose was
        #: Called after the sliders were set to the pose
        self.told: Callable[[], None] = lambda: None
        self._turn = AtMost(_TURN_EVERY_S, self._turn_slices)
        self._tell = AtMost(_TELL_EVERY_S, self._tell_pose)
        self.hand = ProbeHand(
            pose=self.pose,
            move=self._move_by_hand,
            surface=lambda: self.surface,
            upright=lambda: panel.shared.now.upright,
            hold=self._hold,
            hover=lambda view, point: self.hovered(view, point),
        )
        for view in (views.threed, *views.slices):
            self.hand.attach(view)

    def pose(self) -> np.ndarray | None:
        """(4, 4) probe_to_world; None without a probe, or if its transform scales, which the simulation reports."""
        transform = self._logic.parameters.probe_transform
        try:
            return None if transform is None else probe_pose(transform)
        except SimulationError:
            return None

    def move(self, probe_to_world: np.ndarray) -> None:
        """Set the pose of the probe; the image follows."""
        transform = self._logic.parameters.probe_transform
        if transform is not None:
            set_node_to_world(transform, probe_to_world)
            self._refused = False
        elif not self._refused:
            _log.warning("a pose is refused: there is no probe to move yet")
            self._refused = True

    def moved(self) -> None:
        """Update views and sliders after any change of the transform."""
        self._turn()
        self._tell()

    @property
    def is_told(self) -> bool:
        """Whether views and sliders are up to date with the pose."""
        return not (self._turn.is_waiting or self._tell.is_waiting)

    # ---- requests of the page ----------------------------------------------------------------------------------

    def set_pose(self, name: str, value: float) -> None:
        """Set a field of SurfacePose from its slider."""
        pose = self.pose()
        if pose is not None and self.surface is not None and name in _POSE_FIELDS:
            self.move(self.surface.held(pose, **{name: float(value)}))

    def aim_image(self, across: float, down: float) -> None:
        """Aim at a point of the image, given as fractions of its width and height."""
        taken = self._logic.taken
        if taken is not None and self.pose() is not None:
            rows, columns = taken.image.shape
            point = [across * columns - 0.5, down * rows - 0.5, 0.0, 1.0]
            self.hand.aim((taken.image_to_world @ point)[:3])

    def look_again(self) -> None:
        """As look, called in a task: a surface that was cancelled is made now."""
        if self.surface is None:
            self._surface_version = None
            self.update_surface()
        self.look()

    def look(self) -> None:
        """Turn the 3D view to the probe."""
        pose = self.pose()
        if pose is not None and self.surface is not None:
            self._views.look_at_probe(pose, self.surface, self._logic.preset.probe)

    def choose_plane(self, name: str, plane: str) -> None:
        """Choose the plane in which a slice view follows the probe."""
        self._views.set_plane(name, plane)
        with self._shared.changing() as now:
            now.views.planes = dict(self._views.planes)
        self._turn()

    def set_follow(self, on: bool) -> None:
        """Make the slice views follow the probe, or not."""
        self._views.set_follow(on)
        self._turn()

    def show_tissues(self, on: bool) -> None:
        """Colour the tissues in the slice views, or not."""
        self._views.show_labels(self._logic.parameters.labels, on)

    # ---- patient and probe in the views ------------------------------------------------------------------------

    def update_surface(self) -> None:
        """Recompute the surface if the labels have changed; called in a task.

        Images continue meanwhile. A cancelled surface is made again after the labels change, or after look_again.
        """
        labels: Any = self._logic.parameters.labels
        if labels is None or (labels.IsA("vtkMRMLVolumeNode") and labels.GetImageData() is None):
            return
        version = labels_version(labels)
        if version == self._surface_version:
            return
        self._surface_version = version
        found = read_labels(labels, self._logic.preset.tissues)
        placed = Volume(found.labels.array, node_to_world(labels) @ found.labels.ijk_to_ras)
        self.labelled = placed, found.names
        try:
            with self._progress("Make the surface") as progress:
                made = surface = self._tasks.doAside(lambda: PatientSurface(placed, progress))
                self._tasks.doAside(lambda: surface.coarse_polydata)  # made here, not where views wait for it
        except Cancelled:
            made = None  # a surface of the previous labels does not fit these
        if self._surface_version != version:  # of a patient who was closed meanwhile, or of previous labels
            return
        self.surface = made
        self._views.show_surface(made)
        if made is None:
            with self._shared.changing() as now:
                now.pose, now.messages.status = None, _NO_SURFACE
            return
        self.show_tissues(self._shared.now.views.show_tissues)
        self._tell()

    def forget_patient(self) -> None:
        """Forget the surface of a patient, and show neither patient nor probe nor pose until the next one is there."""
        self.surface = self._surface_version = self._drawn = self.labelled = None
        self._views.hide_patient()
        with self._shared.changing() as now:
            now.pose, now.pose_numbers, now.pose_matrix = None, "", ""

    def draw(self) -> None:
        """Draw the probe if it or its transform node has changed, once there is a patient."""
        transform, probe = self._logic.parameters.probe_transform, self._logic.preset.probe
        if self._logic.parameters.labels is None:
            return
        if transform is not None and (probe, transform) != self._drawn:
            self._drawn = (probe, transform)
            self.hand.set_probe(probe)
            self._views.show_probe(probe, transform)
            self.moved()

    # ---- implementation ----------------------------------------------------------------------------------------

    def _move_by_hand(self, probe_to_world: np.ndarray) -> None:
        self._about_to_move()
        self.move(probe_to_world)

    def _hold(self, view) -> None:
        self._views.hold(view)
        if view is None:
            self.moved()

    def _turn_slices(self) -> None:
        """Turn the slices to the frozen image, or to the probe if there is none; ImageFlow turns them to live ones."""
        pose, taken = self.pose(), self._logic.taken
        if taken is not None and not self._logic.isLive:
            self._views.follow(taken.probe_to_world, taken.preset.probe)
        elif pose is not None and self.surface is not None and taken is None:
            self._views.follow(pose, self._logic.preset.probe)

    def _tell_pose(self) -> None:
        pose = self.pose()
        if pose is None or self.surface is None:
            return
        where = self.surface.where(pose)
        with self._shared.changing() as now:
            now.pose = SurfacePose(**{name: round(float(getattr(where, name)), 2) for name in _POSE_FIELDS})
        self.told()
