"""AnatomyViews: Slicer's 3D view and two slice views, which show the probe and the anatomy under it."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import numpy as np
from trame_server import Server
from trame_server.utils.asynchronous import get_event_loop
from trame_slicer.core import SlicerApp
from trame_slicer.rca_view import RemoteViewFactory
from trame_slicer.views import (
    AbstractView,
    NoScheduleRendering,
    SliceView,
    ThreeDView,
    ViewLayoutDefinition,
    ViewType,
)
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkCommand
from vtkmodules.vtkCommonExecutionModel import vtkTrivialProducer

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.base.vtk_data import matrix_array, vtk_matrix
from SlicerUSSim.Logic.mrml.fitting_nodes import mark_as_drawn
from SlicerUSSim.Logic.mrml.nodes import composite_of, display_of, node_called, show_in_slice, write_body, write_slice
from SlicerUSSim.Logic.mrml.taken_image import TakenImage
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.shape import field_polydata, probe_polydata
from SlicerUSSim.Logic.probe.surface import PatientSurface
from SlicerUSSim.Workstation.state import ACROSS, IN_PLANE, SLICE_VIEWS, THREED

#: Images per second of the view under the mouse, and of the others: on few cores the ultrasound image has priority.
_CORES = os.cpu_count() or 2
_FAST, _SLOW = min(2.0 * _CORES, 20.0), min(0.75 * _CORES, 8.0)
#: Seconds between mouse events; more events than images would only delay the images.
_EVENTS_EVERY_S = 0.025
#: Seconds after a resize event until a view has its new size.
_RESIZED_S = 0.05
#: Radius of head and probe in the 3D view by that of the view, and its smaller angle, degrees
_FILLED, _ANGLE_DEG = 0.95, 30.0
#: Names of the nodes for display; they are not saved with the scene.
_PATIENT, _BODY, _FIELD, _SEEN = "Patient surface", "Probe body", "Ultrasound field", "Ultrasound as shown"
#: Name of the transform of what is shown of the image: the pose at which it was taken, which the probe may have left
_POSE = "Pose of the image"
#: Share of a direction from which its letters name a side
_OBLIQUE = 0.35
_SKIN_COLOR = (0.92, 0.8, 0.72)


class AnatomyViews:
    """Slice views and 3D view that follow the probe.

    Parameters
    ----------
    app : SlicerApp, with its scene.
    server : trame server of the views.
    view_ui : (server, view_id, view) adds the controls on top of a view.
    """

    def __init__(self, app: SlicerApp, server: Server, view_ui: Callable[[Server, str, AbstractView], None]) -> None:
        self._app = app
        self.planes = dict(SLICE_VIEWS)
        self._follows = True
        self._followed: tuple[np.ndarray, Probe] | None = None  # probe_to_world
        self._held: SliceView | None = None
        self._fitted: set[str] = set()
        self._volume_id: str | None = None
        self._blend = 1.0
        self._field_of: Probe | None = None  # the probe of the image whose field is shown
        #: Called after a slice view was turned, moved or zoomed
        self.turned: Callable[[], None] = lambda: None
        self._image = vtkTrivialProducer()
        self._image.SetOutput(Volume(np.zeros((1, 2, 2), np.uint8), np.eye(4)).to_vtk())  # until the first image
        for kind, make in ((ViewType.SLICE_VIEW, SliceView), (ViewType.THREE_D_VIEW, ThreeDView)):
            app.view_manager.register_factory(
                RemoteViewFactory(
                    server, _silent(make), kind, populate_view_ui_f=view_ui, target_fps=_FAST, blur_fps=_SLOW,
                    interactive_quality=75, rca_event_throttle_s=_EVENTS_EVERY_S,
                )
            )  # fmt: skip
        made = [ViewLayoutDefinition.threed_view(name=THREED), ViewLayoutDefinition.axial_view()]
        made.append(ViewLayoutDefinition.coronal_view())  # Red and Green of Slicer
        for view in made:
            app.view_manager.create_view(view)
        app.view_manager.set_current_view_ids([view.singleton_tag for view in made])
        # Without a GPU these cost more than all other rendering, and depth peeling hides translucent objects.
        for view in (self.threed, *self.slices):
            view.render_window().SetMultiSamples(0)
        for view in self.slices:
            self._stand_in_plane(view)
            view.interactor().AddObserver(vtkCommand.WindowResizeEvent, self._on_resize(view))
            _node(view).SetRulerType(_node(view).RulerTypeThin)
            _node(view).AddObserver(vtkCommand.ModifiedEvent, lambda *_: self.turned())
        threed = _node(self.threed)
        threed.SetOrientationMarkerType(threed.OrientationMarkerTypeCube)
        threed.SetOrientationMarkerSize(threed.OrientationMarkerSizeSmall)
        self.threed.interactor().AddObserver(vtkCommand.WindowResizeEvent, lambda *_: self._keep_angle())
        threed.SetUseDepthPeeling(False)
        self.threed.renderer().SetUseDepthPeeling(False)
        self.threed.renderer().SetUseDepthPeelingForVolumes(False)

    def _on_resize(self, view: SliceView) -> Callable[..., None]:
        def resized(*_: object) -> None:
            get_event_loop().call_later(_RESIZED_S, self._fit_anew, view)

        return resized

    def _fit_anew(self, view: SliceView) -> None:
        self._fitted.discard(view.get_singleton_tag())
        if self._followed is not None:
            self.follow(*self._followed)

    # ---- content -----------------------------------------------------------------------------------------------

    @property
    def slices(self) -> list[SliceView]:
        return self._app.view_manager.get_slice_views()

    @property
    def threed(self) -> ThreeDView:
        return self._app.view_manager.get_threed_views()[0]

    def show_volume(self, volume_node) -> None:
        """Show an MRI in the slice views, at full extent; those that follow the probe are empty until it is there."""
        self._volume_id = None if volume_node is None else volume_node.GetID()
        self._fitted.clear()
        self._followed = None
        for view in self.slices:
            is_there = self._stand_in_plane(view)
            view.set_background_volume_id(self._volume_id if is_there else None)
            if is_there:
                view.fit_view_to_content()

    def _stand_in_plane(self, view: SliceView) -> bool:
        """Turn a view to its anatomical plane, as it is called on the page; whether it has one."""
        plane = self.planes[view.get_singleton_tag()]
        if plane in (IN_PLANE, ACROSS):
            return False
        _node(view).SetOrientation(plane)
        return True

    def hide_patient(self) -> None:
        """Show no patient, and no probe, until the next one is there."""
        self.show_volume(None)
        self.show_labels(None, False)
        self.hide_image()
        display_of(self._model(_BODY)).SetVisibility(False)
        self.hide_surface()

    def hide_image(self) -> None:
        """Show no image in the views."""
        for view in self.slices:
            view.set_foreground_volume_id(None)
        display_of(self._model(_FIELD)).SetVisibility(False)
        self.threed.schedule_render()

    def hide_surface(self) -> None:
        """Show no surface of a patient."""
        display_of(self._model(_PATIENT)).SetVisibility(False)
        self._model(_PATIENT).SetAndObservePolyData(None)
        self.threed.schedule_render()

    def show_surface(self, surface: PatientSurface) -> None:
        """Show the patient in 3D."""
        model = self._model(_PATIENT)
        model.SetAndObservePolyData(surface.coarse_polydata)
        display = display_of(model)
        display.SetColor(*_SKIN_COLOR)
        display.SetOpacity(0.45)
        display.SetVisibility(True)
        display.SetVisibility2D(False)
        display.SetBackfaceCulling(True)

    def show_probe(self, probe: Probe, transform_node) -> None:
        """Show the probe's body under its transform, and prepare its imaged field, which has the image as texture."""
        body, field = self._model(_BODY), self._model(_FIELD)
        write_body(body, probe)
        body.SetAndObserveTransformNodeID(transform_node.GetID())
        field.SetAndObserveTransformNodeID(self._pose.GetID())
        display = display_of(body)
        display.SetVisibility(True)
        display.SetVisibility2D(True)
        display.SetSliceIntersectionThickness(1)
        display = display_of(field)
        display.SetTextureImageDataConnection(self._image.GetOutputPort())
        display.SetLighting(False)
        display.SetColor(1.0, 1.0, 1.0)
        display.SetBackfaceCulling(False)
        display.SetVisibility2D(False)
        self._fitted.clear()

    def show_image(self, taken: TakenImage, field: np.ndarray) -> None:
        """Show an image where it was taken, in 3D and blended into the slice views.

        `field` (rows, columns) bool is the imaged field; outside it the MRI is unchanged.
        """
        image, probe = taken.image, taken.preset.probe
        if probe != self._field_of:
            self._field_of = probe
            self._model(_FIELD).SetAndObservePolyData(field_polydata(probe))
        # A copy without zeros inside the field, so that the threshold removes only the pixels outside.
        seen = np.where(field, np.maximum(image, 1), 0).astype(np.uint8)
        shown, pose = self._seen, self._pose
        pose.SetMatrixTransformToParent(vtk_matrix(taken.probe_to_world))
        write_slice(shown, Volume(seen[None], taken.grid.slice_to_probe), pose)
        if self._image.GetOutputDataObject(0) is not shown.GetImageData():
            self._image.SetOutput(shown.GetImageData())
            display = display_of(shown)
            display.SetSaveWithScene(False)
            display.SetAutoThreshold(False)
            display.SetThreshold(1, 255)
            display.SetApplyThreshold(True)
        display_of(self._model(_FIELD)).SetVisibility(True)
        for view in self.slices:
            if view.get_foreground_volume_id() != shown.GetID():
                view.set_foreground_volume_id(shown.GetID())
                view.set_foreground_opacity(self._blend)
        self.threed.schedule_render()

    def set_blend(self, share: float) -> None:
        """Set the opacity of the image over the MRI in the slice views: 0 to 1."""
        self._blend = share
        for view in self.slices:
            view.set_foreground_opacity(share)

    def show_labels(self, labels_node: Any, on: bool) -> None:
        """Colour the tissues in the slice views, or not; only possible with a label map."""
        shown = labels_node if on and _is_label_map(labels_node) else None
        for view in self.slices:
            composite: Any = composite_of(_node(view))
            composite.SetLabelVolumeID(None if shown is None else shown.GetID())
            composite.SetLabelOpacity(0.35)
            view.schedule_render()

    # ---- following the probe -----------------------------------------------------------------------------------

    def hold(self, view: SliceView | None) -> None:
        """Stop a slice view from following while the probe is dragged in it; None releases it."""
        self._held = view

    def set_follow(self, on: bool) -> None:
        """Make the slice views follow the probe, or not."""
        self._follows = on

    def set_plane(self, name: str, plane: str) -> None:
        """Choose the plane of a slice view."""
        self.planes[name] = plane
        self._fitted.discard(name)
        if self._followed is not None:
            self.follow(*self._followed)
            return
        view = next(view for view in self.slices if view.get_singleton_tag() == name)
        view.set_background_volume_id(self._volume_id if self._stand_in_plane(view) else None)

    def follow(self, probe_to_world: np.ndarray, probe: Probe) -> None:
        """Move the slice views to the current pose of the probe, (4, 4) probe_to_world."""
        self._followed = (probe_to_world, probe)
        left, right, top, bottom = probe.image_bounds_mm()
        middle = (probe_to_world @ [0.5 * (left + right), 0.5 * (top + bottom), 0.0, 1.0])[:3]
        for view in self.slices:
            name, node = view.get_singleton_tag(), _node(view)
            fit = name not in self._fitted
            if view is self._held or not (self._follows or fit):
                continue
            plane = self.planes[name]
            was_modifying = node.StartModify()
            if plane == IN_PLANE:
                show_in_slice(node, self._seen, probe_to_world, probe, fit=False)
            elif plane == ACROSS:
                across = np.eye(4)  # right, up and normal of the view: elevation, negative depth, lateral
                across[:3, :3] = probe_to_world[:3, [2, 1, 0]] * [1.0, -1.0, 1.0]
                across[:3, 3] = middle
                node.GetSliceToRAS().DeepCopy(vtk_matrix(across))
                node.UpdateMatrices()
            else:
                if fit:
                    node.SetOrientation(plane)
                    view.set_background_volume_id(self._volume_id)
                    view.fit_view_to_content()
                node.JumpSliceByOffsetting(*middle)
            if fit and plane in (IN_PLANE, ACROSS):
                view.set_background_volume_id(self._volume_id)
                width, height, thickness = node.GetFieldOfView()
                scale = max((right - left) / width, (bottom - top) / height) * 1.25
                node.SetFieldOfView(width * scale, height * scale, thickness)
                node.UpdateMatrices()
            node.EndModify(was_modifying)
            self._fitted.add(name)

    def _keep_angle(self) -> None:
        """Let the camera's angle be that of the narrower side of the 3D view, so that no size of it cuts anything."""
        width, height = self.threed.render_window().GetSize()
        camera = self.threed.renderer().GetActiveCamera()
        camera.SetViewAngle(_ANGLE_DEG)
        camera.SetUseHorizontalViewAngle(width < height)

    def look_at_probe(self, probe_to_world: np.ndarray, surface: PatientSurface, probe: Probe) -> None:
        """Turn the 3D view so that it shows head and probe, the probe on the visible side, its image obliquely."""
        camera = self.threed.get_camera_node()
        if camera is None:
            return
        outward = probe_to_world[:3, 3] - surface.centre
        away = outward / np.linalg.norm(outward) + 1.3 * probe_to_world[:3, 2] + 0.35 * probe_to_world[:3, 0]
        if away @ [0, 1, 0] < 0:  # prefer a view from the patient's front
            away = away - 2.6 * probe_to_world[:3, 2]
        away = away / np.linalg.norm(away)
        self._keep_angle()
        head = vtk_to_numpy(surface.coarse_polydata.GetPoints().GetData())
        body = vtk_to_numpy(probe_polydata(probe).GetPoints().GetData()) @ probe_to_world[:3, :3].T
        points = np.vstack([head, body + probe_to_world[:3, 3]])
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        radius = np.linalg.norm(points - middle, axis=1).max()
        away *= radius / (_FILLED * np.sin(np.radians(0.5 * _ANGLE_DEG)))
        camera.SetFocalPoint(*middle)
        camera.SetPosition(*(middle + away))
        camera.SetViewUp(0.0, 0.0, 1.0)
        camera.ResetClippingRange()
        self.threed.schedule_render()

    # ---- points and sides --------------------------------------------------------------------------------------

    @property
    def background(self) -> Any:
        """The node of the MRI that is shown, or None."""
        return None if self._volume_id is None else self._app.scene.GetNodeByID(self._volume_id)

    def letters(self) -> dict[str, list[str]]:
        """Sides of the patient at the left, right, upper and lower edge of each slice view."""
        axes = {view.get_singleton_tag(): matrix_array(_node(view).GetSliceToRAS())[:3, :2].T for view in self.slices}
        return {name: [_side(-x), _side(x), _side(y), _side(-y)] for name, (x, y) in axes.items()}

    def places(self, point_world: np.ndarray) -> dict[str, list[float]]:
        """{view: shares of its width and height from the upper left corner, mm to its plane} of a point, (3,) mm."""
        found, point = {}, [*point_world, 1.0]
        for view in self.slices:
            node = _node(view)
            x, y = (np.linalg.inv(matrix_array(node.GetXYToRAS())) @ point)[:2]
            width, height, _ = node.GetDimensions()
            found[view.get_singleton_tag()] = [
                x / width, 1.0 - y / height, abs((np.linalg.inv(matrix_array(node.GetSliceToRAS())) @ point)[2])
            ]  # fmt: skip
        renderer = self.threed.renderer()
        renderer.SetWorldPoint(*point)
        renderer.WorldToView()
        x, y, _ = renderer.GetViewPoint()
        found[THREED] = [0.5 + 0.5 * x, 0.5 - 0.5 * y, 0.0]
        return found

    @property
    def _seen(self):
        return self._of_page("ScalarVolume", _SEEN)

    @property
    def _pose(self):
        return self._of_page("LinearTransform", _POSE)

    def _of_page(self, kind: str, name: str):
        """The node of a view of the page, which is neither offered nor saved."""
        node = node_called(self._app.scene, kind, name)
        node.SetSaveWithScene(False)
        node.SetHideFromEditors(True)
        return node

    def _model(self, name: str):
        model = node_called(self._app.scene, "Model", name)
        model.SetSaveWithScene(False)
        mark_as_drawn(model)
        display = display_of(model)
        display.SetSaveWithScene(False)
        return model


def _side(direction: np.ndarray) -> str:
    """The sides to which a direction, (3,) of length 1, leads, the first one first: "R", or "RA" for an oblique one."""
    order = [axis for axis in np.argsort(-np.abs(direction)) if abs(direction[axis]) > _OBLIQUE]
    return "".join("RAS"[axis] if direction[axis] > 0 else "LPI"[axis] for axis in order)


def _silent(make):
    """Create views that do not render during their construction, which would be some two hundred times."""
    return lambda **options: make(**options, scheduled_render_strategy=NoScheduleRendering())


def _node(view: AbstractView) -> Any:
    """The MRML node of a view."""
    return view.get_view_node()


def _is_label_map(node: Any) -> bool:
    return node is not None and node.IsA("vtkMRMLLabelMapVolumeNode")
