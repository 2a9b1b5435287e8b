"""Marks of nodes that hold results of this module, so that it never overwrites what others made."""

from __future__ import annotations

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.vtk_data import matrix_array
from SlicerUSSim.Logic.mrml.nodes import named, nodes_of_class

#: Attribute of a node, saved with the scene: the kind of result; "1" in scenes of earlier versions
_RESULT = "SlicerUSSim.result"
#: Kinds of results
IMAGE, OUTLINE, SEQUENCE, SHEETS, FLAP, COMPARED, REGISTRATION = (
    "image", "outline", "sequence", "sheets", "flap", "compared", "registration"
)  # fmt: skip


def mark_as_result(node, kind: str) -> None:
    """Record that a volume, model, sequence or transform node holds a result of this module, of this kind."""
    if node.GetAttribute(_RESULT) != kind:  # an attribute that is set is a change, which observers hear of
        node.SetAttribute(_RESULT, kind)


def kind_of_result(node) -> str | None:
    """The kind of the result in a node; None of a node of others, or an empty one."""
    return node.GetAttribute(_RESULT)


def may_replace_result(node) -> bool:
    """Whether a volume, model, sequence or transform node is empty, or holds a result of this module."""
    return node.GetAttribute(_RESULT) is not None or is_empty(node)


def require_result(node, use: str) -> None:
    """Raise SimulationError for a node with data that this module did not make; `use` is what the node is for."""
    require(
        may_replace_result(node),
        f"{use} {named(node)} has data that this module did not make, so it is not replaced; choose an empty node, or "
        "one with its results",
    )


def result_called(scene, kind: str, name: str):
    """The first vtkMRML`kind`Node with this name that may be replaced, or a new one."""
    for node in nodes_of_class(scene, f"vtkMRML{kind}Node"):
        if node.GetName() == name and may_replace_result(node):
            return node
    return scene.AddNewNodeByClass(f"vtkMRML{kind}Node", name)


def is_empty(node) -> bool:
    """Whether a volume, model, sequence or linear transform node has no data."""
    if node.IsA("vtkMRMLSequenceNode"):
        return node.GetNumberOfDataNodes() == 0
    if node.IsA("vtkMRMLLinearTransformNode"):
        return bool(np.array_equal(matrix_array(node.GetMatrixTransformToParent()), np.eye(4)))
    data = node.GetPolyData() if node.IsA("vtkMRMLModelNode") else node.GetImageData()
    return data is None or data.GetNumberOfPoints() == 0
