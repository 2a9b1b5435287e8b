"""Pointer: the point under the mouse in all views, its tissue and its values."""

from __future__ import annotations

import numpy as np
from trame_slicer.views import SliceView

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.segmentation_settings import CT
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic
from SlicerUSSim.Logic.mrml.nodes import ijk_to_ras, node_to_world, read_volume
from SlicerUSSim.Workstation.anatomy import AnatomyViews
from SlicerUSSim.Workstation.probe_control import ProbeControl
from SlicerUSSim.Workstation.state import IMAGE, SharedState
from SlicerUSSim.Workstation.tasks import AtMost

#: Seconds between two updates of marks and letters after the slices were turned
_TURN_EVERY_S = 0.12
#: Distance from the image plane up to which a point is in it, mm
_IN_PLANE_MM = 1.0


class Pointer:
    """Shows the point under the mouse: a mark in all views but that of the mouse, and a line of text."""

    def __init__(
        self, shared: SharedState, logic: UltrasoundSceneLogic, views: AnatomyViews, probe: ProbeControl
    ) -> None:  # fmt: skip
        self._shared, self._logic, self._views, self._probe = shared, logic, views, probe
        self._point: np.ndarray | None = None
        self._where = ""  # name of the view of the mouse
        probe.hovered = self._hovered
        views.turned = AtMost(_TURN_EVERY_S, self._turned)

    def at_image(self, x_mm: float | None, y_mm: float | None) -> None:
        """The mouse is at a point of the image, mm of the probe frame, or on nothing that has a point (None)."""
        taken = self._logic.taken
        if x_mm is None or y_mm is None or taken is None:
            self._show(None, "")
        else:
            self._show((taken.probe_to_world @ [float(x_mm), float(y_mm), 0.0, 1.0])[:3], IMAGE)

    def _hovered(self, view: SliceView, point: np.ndarray) -> None:
        self._show(point, view.get_singleton_tag())

    def _turned(self) -> None:
        with self._shared.changing() as now:
            now.views.letters = self._views.letters()
        self._show(self._point, self._where)

    def _show(self, point: np.ndarray | None, where: str) -> None:
        if point is None and self._point is None:
            return
        self._point, self._where = point, where
        places = {} if point is None else self._views.places(point)
        words = [] if point is None else self._words(point)
        taken = self._logic.taken
        if point is not None and taken is not None:
            x, y, z = (np.linalg.inv(taken.probe_to_world) @ [*point, 1.0])[:3]
            grid, (dx, dy) = taken.grid, taken.grid.pixel_spacing_mm
            places[IMAGE] = [(x - grid.left_mm) / (grid.columns * dx), (y - grid.top_mm) / (grid.rows * dy), abs(z)]
            if abs(z) < _IN_PLANE_MM and taken.preset.probe.holds(x, y):
                words.append(f"{y:.1f} mm deep")
        inside = {name: place for name, place in places.items() if 0 <= place[0] <= 1 and 0 <= place[1] <= 1}
        with self._shared.changing() as now:
            now.views.under_mouse = ", ".join(words)
            now.views.cross = {name: np.round(at, 4).tolist() for name, at in inside.items() if name != where}

    def _words(self, point: np.ndarray) -> list[str]:
        """Tissue, place and value at a point, as far as they are known."""
        words = []
        if self._probe.labelled is not None:
            labels, names = self._probe.labelled
            label = _value(labels, point)
            words.append(names[int(label) - 1].replace("_", " ") if label else "no tissue")
        sides = zip(("RL", "AP", "SI"), point.tolist(), strict=True)
        words.append(" ".join(f"{side[value < 0]} {abs(value):.0f}" for side, value in sides))
        node = self._views.background
        if node is not None and node.GetImageData() is not None and not node.IsA("vtkMRMLLabelMapVolumeNode"):
            volume = Volume(read_volume(node).array, node_to_world(node) @ ijk_to_ras(node))
            value = _value(volume, point)
            of = "CT" if self._logic.parameters.segmentation.contrast == CT else "MRI"
            words += [] if value is None else [f"{of} {value:.4g}"]
        return words


def _value(volume: Volume, point: np.ndarray) -> float | None:
    """The value of the voxel at a point, (3,) mm; None outside."""
    i, j, k = np.round(volume.ras_to_ijk @ [*point, 1.0])[:3].astype(int)
    inside = all(0 <= n < size for n, size in zip((k, j, i), volume.array.shape, strict=True))
    return float(volume.array[k, j, i]) if inside else None
