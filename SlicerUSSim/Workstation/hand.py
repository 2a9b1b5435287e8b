"""ProbeHand: moving the probe by mouse and keys: slide over the patient, rock, tilt, rotate, aim."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import monotonic
from typing import Any, cast

import numpy as np
from trame_slicer.views import AbstractView, SliceView
from vtkmodules.vtkCommonCore import mutable, vtkCommand
from vtkmodules.vtkCommonDataModel import vtkStaticCellLocator

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.vtk_data import matrix_array
from SlicerUSSim.Logic.mrml.nodes import nodes_of_class
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.poses import aimed_at, carried, turned
from SlicerUSSim.Logic.probe.shape import probe_polydata
from SlicerUSSim.Logic.probe.surface import PatientSurface

#: Actions of the keys: turn by (rock, tilt, rotate) degrees, slide by (lateral, elevational) mm, lift by mm. With Shift
#: five times as much.
KEYS: dict[str, tuple[str, tuple[float, ...]]] = {
    "ArrowLeft": ("slide", (-2.0, 0.0)), "ArrowRight": ("slide", (2.0, 0.0)),
    "ArrowUp": ("slide", (0.0, 2.0)), "ArrowDown": ("slide", (0.0, -2.0)),
    "a": ("turn", (2.0, 0.0, 0.0)), "d": ("turn", (-2.0, 0.0, 0.0)),
    "w": ("turn", (0.0, 2.0, 0.0)), "s": ("turn", (0.0, -2.0, 0.0)),
    "q": ("turn", (0.0, 0.0, -2.0)), "e": ("turn", (0.0, 0.0, 2.0)),
    "+": ("lift", (0.5,)), "-": ("lift", (-0.5,)), "Home": ("upright", ()),
}  # fmt: skip
_DOUBLE_CLICK_S, _DOUBLE_CLICK_PX = 0.4, 5
#: A drag in a slice view slides the probe if it starts less than this far below the probe face, mm; else it swings it.
_AT_THE_PROBE_MM = 8.0
#: Rotation of the probe per pixel of mouse movement, degrees.
_DEG_PER_PIXEL = 0.5
#: Priority above VTK's own observers, which then do not receive events for the probe.
_FIRST = 1000.0


@dataclass(frozen=True, eq=False)
class _Drag:
    kind: str
    pose: np.ndarray
    point: np.ndarray  # grabbed point, in the world frame
    pixel: np.ndarray
    normal: np.ndarray  # of the plane in which the mouse moves


class ProbeHand:
    """Converts mouse and key events into probe poses.

    Parameters
    ----------
    pose : returns (4, 4) probe_to_world, or None without a probe.
    move : called with the new pose.
    surface : returns the surface that the probe slides over, or None.
    upright : whether sliding aligns the probe with the surface normal; otherwise it keeps its angles to the normal.
    hold : called with the slice view in which a drag starts, and with None at its end.
    hover : called with the slice view under the mouse, while nothing is dragged, and the point (3,) there in the world.
    """

    def __init__(
        self,
        pose: Callable[[], np.ndarray | None],
        move: Callable[[np.ndarray], None],
        surface: Callable[[], PatientSurface | None],
        upright: Callable[[], bool],
        hold: Callable[[SliceView | None], None],
        hover: Callable[[SliceView, np.ndarray], None],
    ) -> None:
        self._pose, self._move, self._surface, self._upright, self._hold = pose, move, surface, upright, hold
        self._hover = hover
        self._drag: _Drag | None = None
        self._last_press = (0.0, np.zeros(2))
        self._body = vtkStaticCellLocator()
        self._probe: Probe | None = None
        self._picked: Callable[[np.ndarray | None], None] | None = None

    def pick(self, picked: Callable[[np.ndarray | None], None] | None) -> None:
        """Call a function with the point, (3,) in the world, of the next click in a slice view.

        It is called with None if Escape is pressed, or another function takes its place; None: no other one.
        """
        before, self._picked = self._picked, picked
        if before is not None:
            before(None)

    def set_probe(self, probe: Probe) -> None:
        """Use the body of another probe for picking."""
        self._probe = probe
        self._body.SetDataSet(probe_polydata(probe))
        self._body.BuildLocator()

    # ---- keys and buttons --------------------------------------------------------------------------------------

    def key(self, name: str, fast: bool = False) -> bool:
        """Apply the action of a key. Returns False if the key has none or there is no probe."""
        pose, surface = self._pose(), self._surface()
        if name == "Escape" and self._picked is not None:
            self.pick(None)
            return True
        if name not in KEYS or pose is None:
            return False
        kind, values = KEYS[name]
        values = tuple((5.0 if fast else 1.0) * value for value in values)
        if kind == "turn":
            rock, tilt, rotate = values
            self._move(turned(pose, rock_deg=rock, tilt_deg=tilt, rotate_deg=rotate))
        elif kind == "lift":
            pose = pose.copy()
            pose[:3, 3] -= values[0] * pose[:3, 1]
            self._move(pose)
        elif surface is None:
            return False
        elif kind == "slide":
            self._move(surface.slid(pose, pose[:3, 3] + pose[:3, [0, 2]] @ values, upright=self._upright()))
        else:
            self._move(surface.held(pose, rock_deg=0.0, tilt_deg=0.0))
        return True

    def aim(self, point_world: np.ndarray) -> None:
        """Turn the probe about its position so that its axis passes through a point."""
        pose = self._pose()
        if pose is None:
            return
        try:
            self._move(aimed_at(pose, point_world))
        except SimulationError:  # the point is on the probe face and gives no direction
            return

    # ---- mouse -------------------------------------------------------------------------------------------------

    def attach(self, view: AbstractView) -> None:
        """Observe the mouse in a view, with priority over the view's own interaction."""
        interactor = view.interactor()

        def observe(event: int, method) -> None:
            tags: list[int] = []

            def callback(_subject, _event) -> None:
                if method(view):
                    interactor.GetCommand(tags[0]).SetAbortFlag(1)

            tags.append(interactor.AddObserver(event, callback, _FIRST))

        observe(vtkCommand.LeftButtonPressEvent, self._pressed)
        observe(vtkCommand.MouseMoveEvent, self._moved)
        observe(vtkCommand.LeftButtonReleaseEvent, self._released)

    def _pressed(self, view: AbstractView) -> bool:
        if self._picked is not None and isinstance(view, SliceView):
            picked, self._picked = self._picked, None
            picked(_in_slice(view, np.array(view.interactor().GetEventPosition(), float)))
            return True
        pose, scene = self._pose(), cast(Any, view.get_view_node()).GetScene()
        markups = nodes_of_class(scene, "vtkMRMLMarkupsDisplayNode")
        if pose is None or any(display.HasActiveComponent() for display in markups):  # a point of a curve is moved
            return False
        pixel, now = np.array(view.interactor().GetEventPosition(), float), monotonic()
        last, where = self._last_press
        self._last_press = (now, pixel)
        if now - last < _DOUBLE_CLICK_S and np.abs(pixel - where).max() <= _DOUBLE_CLICK_PX:
            self._last_press = (0.0, pixel)
            return self._double_clicked(view, pixel)
        drag = self._grab_in_slice(view, pose, pixel) if isinstance(view, SliceView) else self._grab(view, pose, pixel)
        self._drag = drag
        if drag is not None and isinstance(view, SliceView):
            self._hold(view)
        return drag is not None

    def _grab_in_slice(self, view: SliceView, pose: np.ndarray, pixel: np.ndarray) -> _Drag | None:
        node: Any = view.get_view_node()
        point, normal = _in_slice(view, pixel), matrix_array(node.GetSliceToRAS())[:3, 2]
        x, y, _ = (np.linalg.inv(pose) @ [*point, 1.0])[:3]
        kind = _kind(view) or ("slide" if y < _AT_THE_PROBE_MM else "swing")
        beside = abs(x) > 60.0 and y < 0  # far from the body
        return None if beside or self._surface() is None else _Drag(kind, pose, point, pixel, normal)

    def _grab(self, view: AbstractView, pose: np.ndarray, pixel: np.ndarray) -> _Drag | None:
        near, far = _ray(view, pixel)
        to_probe = np.linalg.inv(pose)
        start, end = (to_probe @ [*near, 1.0])[:3], (to_probe @ [*far, 1.0])[:3]
        hit, kind = self._on_body(start, end), _kind(view)
        if hit is not None:
            grabbed = hit
        elif kind and (start[2] > 0) != (end[2] > 0):  # with a modifier key the imaged field can be grabbed too
            grabbed = start + start[2] / (start[2] - end[2]) * (end - start)
            if self._probe is None or not self._probe.holds(grabbed[0], grabbed[1]):
                return None
        else:
            return None
        direction = (far - near) / np.linalg.norm(far - near)
        return _Drag(kind or "slide", pose, (pose @ [*grabbed, 1.0])[:3], pixel, direction)

    def _on_body(self, start: np.ndarray, end: np.ndarray) -> np.ndarray | None:
        """(3,) first intersection of a line with the probe's body in the probe frame, or None."""
        point, local, by_reference = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], cast(Any, mutable)  # the stubs want numbers
        hit = self._body.IntersectWithLine(
            start.tolist(), end.tolist(), 1e-6, by_reference(0.0), point, local, by_reference(0), by_reference(0)
        )
        return np.array(point) if hit else None

    def _moved(self, view: AbstractView) -> bool:
        drag = self._drag
        pixel = np.array(view.interactor().GetEventPosition(), float)
        if drag is None:
            if isinstance(view, SliceView):
                self._hover(view, _in_slice(view, pixel))
            return False
        if drag.kind == "rotate":
            self._move(turned(drag.pose, rotate_deg=_DEG_PER_PIXEL * (pixel - drag.pixel)[0]))
            return True
        point = _in_slice(view, pixel) if isinstance(view, SliceView) else _on_plane(view, pixel, drag)
        face, surface = drag.pose[:3, 3], self._surface()
        if drag.kind == "slide" and surface is not None:
            self._move(surface.slid(drag.pose, face + point - drag.point, upright=self._upright()))
        elif drag.kind == "swing" and min(np.linalg.norm(drag.point - face), np.linalg.norm(point - face)) > 1.0:
            self._move(carried(drag.pose, face, drag.point - face, point - face))
        return True

    def _released(self, view: AbstractView) -> bool:
        was, self._drag = self._drag, None
        self._hold(None)
        return was is not None

    def _double_clicked(self, view: AbstractView, pixel: np.ndarray) -> bool:
        pose, surface = self._pose(), self._surface()
        if isinstance(view, SliceView):
            self.aim(_in_slice(view, pixel))
            return True
        found = None if surface is None else surface.hit(*_ray(view, pixel))
        if pose is None or surface is None or found is None:
            return False
        self._move(surface.slid(pose, found, upright=self._upright()))
        return True


def _kind(view: AbstractView) -> str:
    """Kind of drag for the modifier keys held: "rotate", "swing" or ""."""
    interactor = view.interactor()
    if interactor.GetControlKey():
        return "rotate"
    return "swing" if interactor.GetShiftKey() else ""


def _in_slice(view: SliceView, pixel: np.ndarray) -> np.ndarray:
    """(3,) position of a pixel in the world frame."""
    node: Any = view.get_view_node()
    return (matrix_array(node.GetXYToRAS()) @ [*pixel, 0.0, 1.0])[:3]


def _ray(view: AbstractView, pixel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """((3,), (3,)) near and far end of the viewing ray through a pixel, in the world frame."""
    ends = []
    x, y = pixel.tolist()
    for depth in (0.0, 1.0):
        view.renderer().SetDisplayPoint(x, y, depth)
        view.renderer().DisplayToWorld()
        point = np.array(view.renderer().GetWorldPoint())
        ends.append(point[:3] / point[3])
    return ends[0], ends[1]


def _on_plane(view: AbstractView, pixel: np.ndarray, drag: _Drag) -> np.ndarray:
    """(3,) intersection of the viewing ray through a pixel with the drag plane, which faces the viewer."""
    near, far = _ray(view, pixel)
    along = far - near
    return near + ((drag.point - near) @ drag.normal) / (along @ drag.normal) * along
