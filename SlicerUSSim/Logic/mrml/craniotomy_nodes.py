"""Craniotomies in a scene: openings given by nodes, and the piece that was removed as a model."""

from __future__ import annotations

from typing import Any

import numpy as np
from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D, vtkWindowedSincPolyDataFilter

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mrml.label_nodes import LABEL_CLASSES, hidden_segments, node_labels
from SlicerUSSim.Logic.mrml.nodes import control_points, display_of, named, node_to_world, require_node
from SlicerUSSim.Logic.mrml.own_results import FLAP, mark_as_result, may_replace_result
from SlicerUSSim.Logic.placement.craniotomy import mask_opening, middle_of, polygon_opening

#: Nodes that describe an opening
OPENING_CLASSES = ("vtkMRMLMarkupsNode", *LABEL_CLASSES)
#: References of opened labels: to the labels before, and to the model of the removed piece
_CLOSED, _FLAP = "SlicerUSSim.closed", "SlicerUSSim.flap"
#: Attribute of opened labels: R, A, S mm of the middle of the piece, in their own frame
_MIDDLE = "SlicerUSSim.middle"
_FLAP_COLOR = (0.95, 0.75, 0.35)


def closed_labels(labels_node: Any) -> Any:
    """The node from which opened labels were made; the node itself for others, and if that node is gone."""
    return labels_node.GetNodeReference(_CLOSED) or labels_node


def is_opened(labels_node: Any) -> bool:
    """Whether labels were made by opening others, which are still there."""
    return labels_node.GetNodeReference(_CLOSED) is not None


def set_closed_labels(labels_node: Any, closed_node: Any | None) -> None:
    """Record that labels are another node's with an opening, or that they no longer are; hides the piece."""
    labels_node.SetNodeReferenceID(_CLOSED, None if closed_node is None else closed_node.GetID())
    hide_flap(labels_node)


def opening_of(
    opening_node: Any, labels: Volume, names: tuple[str, ...], world_to_labels: np.ndarray
) -> tuple[np.ndarray, str, tuple[str, ...]]:
    """((k, j, i) bool, what it is, warnings) of a markups node (the polygon of its points), label map or segmentation.

    Segments that are hidden are left out. `world_to_labels` (4, 4) leads to the frame of `labels`. Raises
    SimulationError for another or an empty node.
    """
    require_node(opening_node, *OPENING_CLASSES, use="opening")
    if opening_node.IsA("vtkMRMLMarkupsNode"):
        points = control_points(opening_node)
        require(len(points) >= 3, f"opening {named(opening_node)} has {len(points)} points, expected three or more")
        places = points @ world_to_labels[:3, :3].T + world_to_labels[:3, 3]
        return polygon_opening(labels, names, places), named(opening_node), ()
    hidden = hidden_segments(opening_node) if opening_node.IsA("vtkMRMLSegmentationNode") else {}
    require(
        not hidden or len(hidden) < opening_node.GetSegmentation().GetNumberOfSegments(),
        f"opening {named(opening_node)}: all its segments are hidden, expected a visible one to open",
    )
    mask, segments = node_labels(opening_node, hidden)
    mask = mask.with_array((mask.array != 0).astype(np.uint8))
    placed = Volume(mask.array, world_to_labels @ node_to_world(opening_node) @ mask.ijk_to_ras)
    what = named(opening_node)
    left_out = (f"of {what} what is hidden is not opened: {', '.join(hidden.values())}",) if hidden else ()
    with_segments = f" with {', '.join(segments.values())}" if opening_node.IsA("vtkMRMLSegmentationNode") else ""
    return mask_opening(labels, placed, what), what + with_segments, left_out


def show_flap(labels_node: Any, removed: Volume) -> Any:
    """The model node with the surface of what an opening removed, (k, j, i) bool, which opened labels refer to."""
    middle = middle_of(removed.with_array(np.zeros_like(removed.array)), removed)
    labels_node.SetAttribute(_MIDDLE, " ".join(f"{mm:.6g}" for mm in middle))
    scene = labels_node.GetScene()
    model = labels_node.GetNodeReference(_FLAP)
    if model is None or not may_replace_result(model):
        name = scene.GenerateUniqueName(f"{labels_node.GetName()} removed")
        model = scene.AddNewNodeByClass("vtkMRMLModelNode", name)
        labels_node.SetNodeReferenceID(_FLAP, model.GetID())
    model.SetAndObservePolyData(surface_of(removed))
    mark_as_result(model, FLAP)
    follow_labels(labels_node)
    display = display_of(model)
    if display is not None:
        display.SetColor(*_FLAP_COLOR)
        display.SetOpacity(0.5)
        display.SetVisibility(True)
        display.SetVisibility2D(True)
    return model


def hide_flap(labels_node: Any) -> None:
    """Hide the model of the removed piece, if there is one."""
    model = labels_node.GetNodeReference(_FLAP)
    display = None if model is None else model.GetDisplayNode()
    if display is not None:
        display.SetVisibility(False)


def flap_centre(labels_node: Any) -> np.ndarray | None:
    """(3,) world RAS mm, the middle of the largest piece that was removed; None without one."""
    text = labels_node.GetAttribute(_MIDDLE) if is_opened(labels_node) else None
    if text is None:
        return None
    follow_labels(labels_node)
    return (node_to_world(labels_node) @ [*map(float, text.split()), 1.0])[:3]


def follow_labels(labels_node: Any) -> None:
    """Put the model of the removed piece under the transform of the labels, which may have changed."""
    model, parent = labels_node.GetNodeReference(_FLAP), labels_node.GetParentTransformNode()
    if model is not None and may_replace_result(model) and model.GetParentTransformNode() is not parent:
        model.SetAndObserveTransformNodeID(None if parent is None else parent.GetID())


def surface_of(removed: Volume) -> Any:
    """The surface of a mask as vtkPolyData, in the frame of the mask's matrix."""
    places = np.argwhere(removed.array)
    low, high = places.min(axis=0), places.max(axis=0) + 1
    box = tuple(slice(start, stop) for start, stop in zip(low, high, strict=True))
    padded = np.pad(removed.array[box].astype(np.uint8), 1)
    matrix = removed.ijk_to_ras.copy()
    matrix[:3, 3] = (removed.ijk_to_ras @ [*(low[::-1] - 1), 1.0])[:3]
    edges = vtkFlyingEdges3D()
    edges.SetInputData(Volume(padded, matrix).to_vtk())
    edges.SetValue(0, 0.5)
    edges.ComputeScalarsOff()  # views would colour it by them
    smooth = vtkWindowedSincPolyDataFilter()
    smooth.SetInputConnection(edges.GetOutputPort())
    smooth.SetNumberOfIterations(12)
    smooth.SetPassBand(0.05)
    smooth.Update()
    return smooth.GetOutput()
