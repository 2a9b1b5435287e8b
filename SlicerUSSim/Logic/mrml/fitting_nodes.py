"""Which nodes of a scene fit which role of SceneParameters, so that a selector offers nothing that makes no sense."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from SlicerUSSim.Logic.mrml.own_results import IMAGE, OUTLINE, SEQUENCE, is_own, kind_of_result
from SlicerUSSim.Logic.mrml.parameter_node import NODE_PARAMETERS, SceneParameters
from SlicerUSSim.Logic.mrml.sheet_nodes import holds_sheets

#: Of transforms and models that Slicer keeps for its slice views; they are hidden from editors only as a rule
_OF_SLICE_VIEWS = ("Volume Slice", "Slice Transform", "Volume Slice Transform")
#: {role: roles of which a node cannot have one at the same time}
_OTHERS = {"second_mri": ("mri",), "real": ("mri", "second_mri")}
#: Attribute of nodes for display alone, which hold no user's data
_DRAWN = "SlicerUSSim.drawn"


def mark_as_drawn(node: Any) -> None:
    """Record that a node is part of what views draw, such as the probe's body, and fits no role."""
    node.SetAttribute(_DRAWN, "1")


def offered(role: str, node: Any, parameters: SceneParameters) -> bool:
    """Whether a node can have a role beside the nodes that are chosen for the others."""
    return fits(role, node) and all(getattr(parameters, other) is not node for other in _OTHERS.get(role, ()))


def fits(role: str, node: Any) -> bool:
    """Whether a node can have a role: its class, what it holds, and whether this module made it."""
    is_drawn = node.GetAttribute(_DRAWN) is not None
    if is_drawn or node.GetHideFromEditors() or (node.GetName() or "").endswith(_OF_SLICE_VIEWS):
        return False
    is_of_class = any(node.IsA(name) for name in NODE_PARAMETERS[role])
    return is_of_class and _RULES.get(role, lambda node: True)(node)


def _is_anatomy(node) -> bool:
    """A volume of several slices that this module did not make; an empty one can still be filled."""
    if node.IsA("vtkMRMLLabelMapVolumeNode") or kind_of_result(node) is not None:
        return False
    image = node.GetImageData()
    return image is None or min(image.GetDimensions()) != 1


def _is_real(node) -> bool:
    if node.IsA("vtkMRMLSequenceNode"):
        return kind_of_result(node) is None and _holds(node, "vtkMRMLScalarVolumeNode")
    return kind_of_result(node) is None and not node.IsA("vtkMRMLLabelMapVolumeNode")


def _holds(sequence_node, class_name: str) -> bool:
    """Whether the items of a sequence are of a class; an empty one can still be filled."""
    return not sequence_node.GetNumberOfDataNodes() or bool(sequence_node.GetNthDataNode(0).IsA(class_name))


_RULES: dict[str, Callable[[Any], bool]] = {
    "mri": _is_anatomy,
    "second_mri": _is_anatomy,
    "sheets": holds_sheets,
    "probe_transform": lambda node: kind_of_result(node) is None,
    "output": lambda node: not node.IsA("vtkMRMLLabelMapVolumeNode") and is_own(node, IMAGE),
    "outline": lambda node: is_own(node, OUTLINE),
    "real": _is_real,
    "transform_sequence": lambda node: kind_of_result(node) is None and _holds(node, "vtkMRMLTransformNode"),
    "image_sequence": lambda node: is_own(node, SEQUENCE),
}
