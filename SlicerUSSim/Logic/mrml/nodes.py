"""Conversion between MRML nodes and values of this package: volumes, labels and names, poses, images, outlines.

Uses only nodes, and nothing of the `slicer` namespace.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from vtkmodules.vtkCommonMath import vtkMatrix4x4

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.transforms import check_rigid
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.base.vtk_data import matrix_array, vtk_matrix
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.shape import outline_polydata, probe_polydata

#: What belongs to a patient: images, labels, surfaces, points, recordings, the costs of a fit
_PATIENT_CLASSES = (
    "vtkMRMLSequenceBrowserNode", "vtkMRMLSequenceNode", "vtkMRMLVolumeNode", "vtkMRMLSegmentationNode",
    "vtkMRMLModelNode", "vtkMRMLMarkupsNode", "vtkMRMLTransformNode", "vtkMRMLPlotChartNode", "vtkMRMLPlotSeriesNode",
    "vtkMRMLTableNode",
)  # fmt: skip


def named(node) -> str:
    """Description of a node in messages: its kind and name."""
    if node is None:
        return "no node"
    kind = node.GetNodeTagName() if hasattr(node, "GetNodeTagName") else type(node).__name__
    return f"{kind} {node.GetName()!r}"


def require_node(node, *classes: str, use: str) -> None:
    """Raise SimulationError unless `node` is of one of the classes and still in a scene."""
    words = " or ".join(name.removeprefix("vtkMRML").removesuffix("Node") for name in classes)
    require(node is not None, f"no {use} chosen, expected a {words} node")
    require(
        hasattr(node, "IsA") and any(node.IsA(name) for name in classes),
        f"{use} is {named(node)}, expected a {words} node",
    )
    require(node.GetScene() is not None, f"{use} {named(node)} has been removed from the scene; choose another")


def nodes_of_class(scene, name: str) -> list:
    """All nodes of a class and its subclasses, in the order of the scene."""
    return [scene.GetNthNodeByClass(number, name) for number in range(scene.GetNumberOfNodesByClass(name))]


def node_called(scene, kind: str, name: str):
    """The first vtkMRML`kind`Node with this name, or a new one."""
    known = (node for node in nodes_of_class(scene, f"vtkMRML{kind}Node") if node.GetName() == name)
    return next(known, None) or scene.AddNewNodeByClass(f"vtkMRML{kind}Node", name)


def display_of(node):
    """A node's display node, created by default; None if none can be created."""
    if node.GetDisplayNode() is None:
        node.CreateDefaultDisplayNodes()
    return node.GetDisplayNode()


def put_beside(node, patient_node) -> None:
    """Put a node into the folder of a patient's node in the subject hierarchy, if the scene has one.

    A node at the top, as a volume that was loaded from a file, gets a folder of its name; one of DICOM has a study.
    """
    hierarchy = patient_node.GetScene().GetFirstNodeByClass("vtkMRMLSubjectHierarchyNode")
    if hierarchy is None or not hierarchy.GetItemByDataNode(patient_node):
        return
    patient = hierarchy.GetItemByDataNode(patient_node)
    folder = hierarchy.GetItemParent(patient)
    if folder == hierarchy.GetSceneItemID():
        folder = hierarchy.CreateFolderItem(folder, f"{patient_node.GetName()} ultrasound")
        hierarchy.SetItemParent(patient, folder)
    item = hierarchy.GetItemByDataNode(node)
    if item:
        hierarchy.SetItemParent(item, folder)
    else:
        hierarchy.CreateItem(folder, node)


class Observed:
    """Observes the node that currently has a role.

    Parameters
    ----------
    event : name of an event of that node, such as "TransformModifiedEvent".
    method : called on this event.
    """

    def __init__(self, event: str, method: Callable[[], None]) -> None:
        self._event, self._method = event, method
        self._node: Any = None
        self._tag = 0

    def watch(self, node: Any) -> bool:
        """Observe this node from now on, or none; whether it is another one than before."""
        if node is self._node:
            return False
        if self._node is not None:
            self._node.RemoveObserver(self._tag)
        self._node = node
        if node is not None:
            event = getattr(node, self._event, self._event)  # VTK takes its own events by name, MRML's by number
            self._tag = node.AddObserver(event, lambda *_: self._method())
        return True


# ---- positions of nodes ----------------------------------------------------------------------------------------------


def node_to_world(node) -> np.ndarray:
    """(4, 4) from a node's own frame to the world (RAS), by its parent transforms and, for a transform node, itself.

    Raises SimulationError if one of the transforms is not linear.
    """
    transform = node if node.IsA("vtkMRMLTransformNode") else node.GetParentTransformNode()
    if transform is None:
        return np.eye(4)
    matrix = vtkMatrix4x4()
    require(
        bool(transform.IsTransformToWorldLinear()) and bool(transform.GetMatrixTransformToWorld(matrix)),
        f"{named(node)} is under a transform that is not linear; harden it or use a linear one",
    )
    return matrix_array(matrix)


def node_to_parent(transform_node) -> np.ndarray:
    """(4, 4) of a linear transform node, without its parents."""
    matrix = vtkMatrix4x4()
    transform_node.GetMatrixTransformToParent(matrix)  # without an argument, it warns in Slicer's log
    return matrix_array(matrix)


def set_node_to_world(transform_node, matrix: np.ndarray) -> None:
    """Set a linear transform node so that it and its parents together are `matrix` (4, 4)."""
    parent = transform_node.GetParentTransformNode()
    to_parent = matrix if parent is None else np.linalg.inv(node_to_world(parent)) @ matrix
    transform_node.SetMatrixTransformToParent(vtk_matrix(to_parent))


def probe_pose(transform_node) -> np.ndarray:
    """(4, 4) probe_to_ras of a transform node with all its parents. Raises SimulationError unless it is rigid."""
    require_node(transform_node, "vtkMRMLTransformNode", use="probe transform")
    return check_rigid(named(transform_node), node_to_world(transform_node))


def pose_in_labels(labels_node, probe_to_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(probe pose, transform of the volume), both (4, 4), in one rigid frame.

    The inverse of a rigid transform of the labels is applied to the pose, so that the volume does not change; a
    transform that scales is applied to the volume.
    """
    labels_to_world = node_to_world(labels_node)
    try:
        check_rigid("labels", labels_to_world)
    except SimulationError:
        return probe_to_world, labels_to_world
    return np.linalg.inv(labels_to_world) @ probe_to_world, np.eye(4)


# ---- volumes ---------------------------------------------------------------------------------------------------------


def control_points(markups_node) -> np.ndarray:
    """(points, 3) world RAS mm of the control points that are placed."""
    points, place = [], [0.0, 0.0, 0.0]
    for number in range(markups_node.GetNumberOfControlPoints()):
        if markups_node.GetNthControlPointPositionStatus(number) == markups_node.PositionDefined:
            markups_node.GetNthControlPointPositionWorld(number, place)
            points.append(tuple(place))
    return np.array(points).reshape(-1, 3)


def path_points(markups_node) -> np.ndarray:
    """(points, 3) world RAS mm of a curve, or of the control points of other markups."""
    if not markups_node.IsA("vtkMRMLMarkupsCurveNode"):
        return control_points(markups_node)
    curve = markups_node.GetCurvePointsWorld()
    return np.array([curve.GetPoint(n) for n in range(curve.GetNumberOfPoints() if curve else 0)]).reshape(-1, 3)


def ijk_to_ras(volume_node) -> np.ndarray:
    """(4, 4) of a volume node, in its own frame."""
    matrix = vtkMatrix4x4()
    volume_node.GetIJKToRASMatrix(matrix)
    return matrix_array(matrix)


def read_volume(volume_node, use: str = "volume") -> Volume:
    """The image of a scalar volume node, in its own frame; its voxels are shared, not copied.

    Raises SimulationError for another node, and for one without image data.
    """
    require_node(volume_node, "vtkMRMLScalarVolumeNode", use=use)
    image = volume_node.GetImageData()
    require(image is not None and image.GetNumberOfPoints() > 0, f"{use} {named(volume_node)} has no image data")
    try:
        return replace(Volume.from_vtk(image, ijk_to_ras(volume_node)), name=volume_node.GetName() or "")
    except SimulationError as error:
        raise SimulationError(f"{use} {named(volume_node)}: {error}") from None


def write_volume(volume_node, volume: Volume) -> None:
    """Write a copy of a volume into a volume node, as when loading a file."""
    volume_node.SetIJKToRASMatrix(vtk_matrix(volume.ijk_to_ras))
    volume_node.SetAndObserveImageData(Volume(volume.array, np.eye(4)).to_vtk())


# ---- simulated images -----------------------------------------------------------------------------------------------


def write_slice(volume_node, in_probe: Volume, transform_node=None) -> None:
    """Write a uint8 volume of one slice into a volume node; memory is reused if the size is the same."""
    was_modifying = volume_node.StartModify()
    if transform_node is not None and volume_node.GetTransformNodeID() != transform_node.GetID():
        volume_node.SetAndObserveTransformNodeID(transform_node.GetID())
    image = volume_node.GetImageData()
    _, rows, columns = in_probe.array.shape
    if image is None or image.GetDimensions() != (columns, rows, 1) or image.GetScalarTypeAsString() != "unsigned char":
        write_volume(volume_node, in_probe)
        display = None if volume_node.GetScene() is None else display_of(volume_node)  # not of an item of a sequence
        if display is not None and display.GetAutoWindowLevel():  # and not after the user has chosen a window
            show_all_greys(volume_node)
    else:
        if not np.array_equal(ijk_to_ras(volume_node), in_probe.ijk_to_ras):
            volume_node.SetIJKToRASMatrix(vtk_matrix(in_probe.ijk_to_ras))
        scalars = image.GetPointData().GetScalars()
        np.asarray(memoryview(scalars)).reshape(rows, columns)[:] = in_probe.array[0]
        scalars.Modified()
        image.Modified()
    volume_node.EndModify(was_modifying)


def show_all_greys(volume_node) -> None:
    """Black at 0 and white at 255, as on a scanner; an automatic window would change the brightness between frames."""
    display = display_of(volume_node)
    if display is not None:
        display.SetAutoWindowLevel(False)
        display.SetWindowLevelMinMax(0, 255)


def write_outline(model_node, probe: Probe, transform_node) -> None:
    """Write the outline of the imaged field into a model node, under the probe's transform node."""
    model_node.SetAndObservePolyData(outline_polydata(probe))
    if model_node.GetTransformNodeID() != transform_node.GetID():
        model_node.SetAndObserveTransformNodeID(transform_node.GetID())
    is_new = model_node.GetDisplayNode() is None
    display = display_of(model_node)
    if is_new and display is not None:
        display.SetColor(1.0, 0.85, 0.1)
        display.SetLineWidth(3)
        display.SetLighting(False)
        display.SetVisibility2D(True)
        display.SetSliceDisplayModeToProjection()


def write_body(model_node, probe: Probe) -> None:
    """Write the probe's body into a model node, in its own colors."""
    model_node.SetAndObservePolyData(probe_polydata(probe))
    display = display_of(model_node)
    if display is not None:
        display.SetActiveScalar("Color", 1)  # of the cells
        display.SetScalarRangeFlag(display.UseDirectMapping)
        display.SetScalarVisibility(True)


def show_in_slice(slice_node, volume_node, probe_to_world: np.ndarray, probe: Probe, fit: bool, behind=None) -> None:
    """Move a slice view to the image plane, oriented as on a scanner, and overlay the image on its background.

    `fit` also zooms to the imaged field; `behind` is another volume for the background. A view that Volume Reslice
    Driver moves (SlicerIGT) stays where that has it.
    """
    left, right, top, bottom = probe.image_bounds_mm()
    view = probe_to_world @ np.diag([1.0, -1.0, -1.0, 1.0])  # a view's second axis points up, the probe's down
    view[:3, 3] = (probe_to_world @ [0.5 * (left + right), 0.5 * (top + bottom), 0.0, 1.0])[:3]
    if not is_driven_by_other(slice_node):
        slice_node.GetSliceToRAS().DeepCopy(vtk_matrix(view))
        if fit:
            width, height, thickness = slice_node.GetFieldOfView()
            scale = max((right - left) / width, (bottom - top) / height) * 1.05
            slice_node.SetFieldOfView(width * scale, height * scale, thickness)
        slice_node.UpdateMatrices()
    composite = composite_of(slice_node)
    if composite is None:
        return
    if behind is not None:
        composite.SetBackgroundVolumeID(behind.GetID())
    if composite.GetForegroundVolumeID() != volume_node.GetID():
        composite.SetForegroundVolumeID(volume_node.GetID())
        composite.SetForegroundOpacity(1.0)


def is_driven_by_other(slice_node) -> bool:
    """Whether Volume Reslice Driver moves a slice view."""
    return bool(slice_node.GetAttribute("VolumeResliceDriver.Driver"))


def composite_of(slice_node):
    """The vtkMRMLSliceCompositeNode of a slice view, or None."""
    composites = nodes_of_class(slice_node.GetScene(), "vtkMRMLSliceCompositeNode")
    return next((node for node in composites if node.GetLayoutName() == slice_node.GetLayoutName()), None)


# ---- nodes of a patient ---------------------------------------------------------------------------------------------


def remove_patient_nodes(scene, kept: Iterable[Any]) -> None:
    """Remove all nodes of these classes, with what displays and stores them, except those that are kept.

    Nodes that are not saved with the scene belong to the views and stay. The scene belongs to the workstation:
    nothing else puts nodes into it.
    """
    ids = {node.GetID() for node in kept if node is not None}
    for name in _PATIENT_CLASSES:
        for node in nodes_of_class(scene, name):
            # One may be gone together with another one before
            if node.GetSaveWithScene() and node.GetScene() is not None and node.GetID() not in ids and _is_data(node):
                for helper in _helpers(node):
                    scene.RemoveNode(helper)
                scene.RemoveNode(node)


def _is_data(node) -> bool:
    """Not a model of a slice view, which Slicer makes and needs."""
    is_shares = node.GetAttribute("SlicerUSSim.sharesOf") is not None
    return (not (node.GetName() or "").endswith("Volume Slice") and not node.GetHideFromEditors()) or is_shares


def _helpers(node) -> list[Any]:
    """Display and storage nodes, and the colours of labels."""
    displays = range(node.GetNumberOfDisplayNodes()) if node.IsA("vtkMRMLDisplayableNode") else ()
    stores = range(node.GetNumberOfStorageNodes()) if node.IsA("vtkMRMLStorableNode") else ()
    found = [node.GetNthDisplayNode(number) for number in displays]
    found += [node.GetNthStorageNode(number) for number in stores]
    found.append(node.GetNodeReference("tissueColors"))
    return [helper for helper in found if helper is not None]
