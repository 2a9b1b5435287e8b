"""Which nodes of a scene fit which role of SceneParameters, so that a selector offers nothing that makes no sense."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from SlicerUSSim.Logic.mrml.landmark_nodes import is_landmarks
from SlicerUSSim.Logic.mrml.own_results import IMAGE, OUTLINE, SEQUENCE, SHEETS, is_empty, kind_of_result
from SlicerUSSim.Logic.mrml.parameter_node import NODE_PARAMETERS

#: Of transforms and models that Slicer keeps for its slice views; they are hidden from editors only as a rule
_OF_SLICE_VIEWS = ("Volume Slice", "Slice Transform", "Volume Slice Transform")


def fits(role: str, node: Any) -> bool:
    """Whether a node can have a role: its class, what it holds, and whether this module made it."""
    if node.GetHideFromEditors() or (node.GetName() or "").endswith(_OF_SLICE_VIEWS):
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


def _made_as(kind: str) -> Callable[[Any], bool]:
    """Empty, or holding a result of this kind."""
    return lambda node: kind_of_result(node) in (kind, "1") or (kind_of_result(node) is None and is_empty(node))


_RULES: dict[str, Callable[[Any], bool]] = {
    "mri": _is_anatomy,
    "second_mri": _is_anatomy,
    "sheets": lambda node: kind_of_result(node) in (None, SHEETS, "1"),
    "seed": lambda node: not is_landmarks(node),
    "probe_transform": lambda node: kind_of_result(node) is None,
    "output": lambda node: not node.IsA("vtkMRMLLabelMapVolumeNode") and _made_as(IMAGE)(node),
    "outline": _made_as(OUTLINE),
    "real": _is_real,
    "transform_sequence": lambda node: kind_of_result(node) is None and _holds(node, "vtkMRMLTransformNode"),
    "image_sequence": _made_as(SEQUENCE),
}
