"""remove_patient_nodes: takes a patient out of the scene, so that no saved scene holds two of them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from SlicerUSSim.Logic.mrml.nodes import nodes_of_class

#: What is of a patient: images, labels, surfaces, points, recordings, the costs of a fit
_CLASSES = (
    "vtkMRMLSequenceBrowserNode", "vtkMRMLSequenceNode", "vtkMRMLVolumeNode", "vtkMRMLSegmentationNode",
    "vtkMRMLModelNode", "vtkMRMLMarkupsNode", "vtkMRMLTransformNode", "vtkMRMLPlotChartNode", "vtkMRMLPlotSeriesNode",
    "vtkMRMLTableNode",
)  # fmt: skip


def remove_patient_nodes(scene, kept: Iterable[Any]) -> None:
    """Remove all nodes of these classes, with what displays and stores them, except those that are kept.

    Nodes that are not saved with the scene belong to the views and stay. The scene is the workstation's own: nobody
    else puts nodes into it.
    """
    ids = {node.GetID() for node in kept if node is not None}
    for name in _CLASSES:
        for node in nodes_of_class(scene, name):
            # One may be gone together with another one before
            if node.GetSaveWithScene() and node.GetScene() is not None and node.GetID() not in ids and _is_data(node):
                for helper in _helpers(node):
                    scene.RemoveNode(helper)
                scene.RemoveNode(node)


def _is_data(node) -> bool:
    """Not a model of a slice view, which Slicer makes and needs."""
    return (not (node.GetName() or "").endswith("Volume Slice") and not node.GetHideFromEditors()) or _is_shares(node)


def _is_shares(node) -> bool:
    return node.GetAttribute("SlicerUSSim.sharesOf") is not None


def _helpers(node) -> list[Any]:
    """Display and storage nodes, and the colours of labels."""
    displays = range(node.GetNumberOfDisplayNodes()) if node.IsA("vtkMRMLDisplayableNode") else ()
    stores = range(node.GetNumberOfStorageNodes()) if node.IsA("vtkMRMLStorableNode") else ()
    found = [node.GetNthDisplayNode(number) for number in displays]
    found += [node.GetNthStorageNode(number) for number in stores]
    found.append(node.GetNodeReference("tissueColors"))
    return [helper for helper in found if helper is not None]
