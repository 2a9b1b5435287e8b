"""Marks of nodes that hold results of this module, so that it never overwrites what others made.

A result is this module's own as long as three things hold: its node has the kind of the result as an attribute, refers
to itself (claim), and has the data that this module wrote, by a hash that is an attribute, too.
All are saved with the scene, and formats that keep voxels, points and matrices as they are (NRRD, VTK, HDF5) keep the
hash: results that were saved and loaded are replaced again. Data that the user put in their place, or edited, are the
user's.

Attributes are copied with a node, and the number in a node's ID may change when a scene is imported into another one.
A reference to the node itself does right in both: a copy (clone) refers to the node that it was copied from, and scenes
put references right when they give nodes other IDs, on import as on loading. Nodes of scenes that were saved by
versions without this reference count as the user's, and are kept.
"""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
from scipy import ndimage
from vtkmodules.util.numpy_support import vtk_to_numpy

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mrml.label_nodes import layered_segments, node_labels
from SlicerUSSim.Logic.mrml.nodes import named, node_to_parent, nodes_of_class

#: Role of the reference of a node to itself; saved with the scene
OWN = "SlicerUSSim.own"
#: Attributes of a node, saved with the scene: kind of result, and a hash of its data
_RESULT, _DATA = "SlicerUSSim.result", "SlicerUSSim.resultData"
#: The same of a node with labels: a hash of voxels, place and names as Segment wrote them
_MADE = "SlicerUSSim.made"
#: Kinds of results
IMAGE, OUTLINE, SEQUENCE, COMPOUNDED, SHEETS, FLAP, COMPARED, REGISTRATION = (
    "image", "outline", "sequence", "compounded", "sheets", "flap", "compared", "registration"
)  # fmt: skip


def claim(node: Any) -> None:
    """Record that this module filled a node; one outside a scene, as an item of a sequence, has no ID and stays."""
    if node.GetScene() is not None and not is_claimed(node):
        node.SetNodeReferenceID(OWN, node.GetID())


def is_claimed(node: Any) -> bool:
    """Whether this module filled this very node, and not one that it is a copy of."""
    return node.GetID() is not None and node.GetNodeReferenceID(OWN) == node.GetID()


def mark_as_result(node, kind: str) -> None:
    """Record that a volume, model, sequence or transform node holds a result of this module, of this kind.

    To be called after its data were written. Of a node outside a scene, an item of a sequence, only the kind is kept.
    """
    marks = {_RESULT: kind}
    if node.GetScene() is not None:
        marks[_DATA] = _hash_of(node)
        claim(node)
    for name, text in marks.items():
        if node.GetAttribute(name) != text:  # an attribute that is set is a change, which observers are notified of
            node.SetAttribute(name, text)


def kind_of_result(node) -> str | None:
    """The kind of the result in a node, or of that of which it is a copy; None of a node with data of others.

    Of a sequence, its items are not compared with what was written.
    """
    kind, data = node.GetAttribute(_RESULT), node.GetAttribute(_DATA)
    if kind is None or data is None or node.IsA("vtkMRMLSequenceNode") or is_empty(node) or _hash_of(node) == data:
        return kind
    return None


def may_replace_result(node) -> bool:
    """Whether a volume, model, sequence or transform node is empty, or holds what this module wrote into it."""
    return is_empty(node) or (
        node.GetAttribute(_RESULT) is not None and is_claimed(node) and _hash_of(node) == node.GetAttribute(_DATA)
    )


def is_own(node, kind: str) -> bool:
    """Whether a node is empty, or holds a result of this kind that may be replaced."""
    if is_empty(node):
        return kind_of_result(node) in (None, kind)
    # Items of a sequence are compared when it is replaced
    may_be = is_claimed if node.IsA("vtkMRMLSequenceNode") else may_replace_result
    return kind_of_result(node) == kind and may_be(node)


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
    """Whether a volume, model, sequence, linear transform, segmentation or markups node has no data."""
    if node.IsA("vtkMRMLSequenceNode"):
        return node.GetNumberOfDataNodes() == 0
    if node.IsA("vtkMRMLLinearTransformNode"):
        return bool(np.array_equal(node_to_parent(node), np.eye(4)))
    if node.IsA("vtkMRMLSegmentationNode"):
        return node.GetSegmentation().GetNumberOfSegments() == 0
    if node.IsA("vtkMRMLMarkupsNode"):
        return node.GetNumberOfControlPoints() == 0
    data = node.GetPolyData() if node.IsA("vtkMRMLModelNode") else node.GetImageData()
    return data is None or data.GetNumberOfPoints() == 0


def _hash_of(node) -> str:
    """Of the voxels, points, items or matrix of a node; not of its place and what else the user may change of it."""
    found = hashlib.blake2b(digest_size=16)
    if node.IsA("vtkMRMLSequenceNode"):
        for number in range(node.GetNumberOfDataNodes()):
            item = node.GetNthDataNode(number)
            found.update(f"{node.GetNthIndexValue(number)} {_hash_of(item)} ".encode())
    elif node.IsA("vtkMRMLTransformNode"):
        if node.IsA("vtkMRMLLinearTransformNode"):
            found.update((node_to_parent(node).round(5) + 0.0).tobytes())
    elif node.IsA("vtkMRMLModelNode"):
        data = node.GetPolyData()
        if data is not None and data.GetNumberOfPoints():
            points = np.asarray(vtk_to_numpy(data.GetPoints().GetData()), np.float32)
            found.update(f"{data.GetNumberOfCells()} ".encode())
            found.update(np.ascontiguousarray(points + np.float32(0.0)).data)  # -0.0, as files in LPS make of 0.0
    else:
        image = node.GetImageData()
        scalars = None if image is None else image.GetPointData().GetScalars()
        if image is not None and scalars is not None:
            found.update(f"{image.GetDimensions()} {image.GetScalarTypeAsString()} ".encode())
            found.update(np.ascontiguousarray(vtk_to_numpy(scalars)).data)
    return found.hexdigest()


# ---- labels ----------------------------------------------------------------------------------------------------------


def mark_as_made(labels_node) -> None:
    """Record that the present content of a label map or segmentation node was made by this program."""
    labels_node.SetAttribute(_MADE, content_of(labels_node))
    claim(labels_node)


def content_as_made(labels_node) -> str | None:
    """content_of a node when mark_as_made was called with it last; None if it never was, or with a node copied."""
    return labels_node.GetAttribute(_MADE) if is_claimed(labels_node) else None


def may_replace(labels_node) -> bool:
    """Whether a node is new, or has unedited labels that this program made.

    A new one has neither segments nor voxels; segments without voxels are a user's plan. A copy of labels belongs to
    the user who made it, see claim.
    """
    made = content_as_made(labels_node)
    return is_empty(labels_node) or (made is not None and content_of(labels_node) == made)


def content_of(labels_node) -> str:
    """A hash of voxels, position and names, the same after saving and loading; "" if no voxel has a label.

    Where segments lie in several layers and may overlap, the voxels of each count, since those below others are work,
    too. Segment writes one layer.
    """
    try:
        volume, names = node_labels(labels_node)
    except SimulationError:  # no segments, or none with a voxel
        return ""
    if not volume.array.any():
        return ""
    content = hashlib.sha256()
    _add(content, volume, sorted(names.items()))
    if labels_node.IsA("vtkMRMLSegmentationNode"):
        for number, segment in enumerate(layered_segments(labels_node)):
            _add(content, segment, number)
    return content.hexdigest()


def _add(content, volume: Volume, about: object) -> None:
    """Add the voxels of a volume that are not 0, their place and something `about` them to a hash.

    Only the part with such voxels counts, since segmentations are stored cropped.
    """
    boxes = ndimage.find_objects((volume.array != 0).view(np.uint8)) or [(slice(0, 0),) * 3]
    part = volume.array[boxes[0]]
    place = volume.ijk_to_ras.copy()
    place[:3, 3] = (volume.ijk_to_ras @ [*(side.start for side in reversed(boxes[0])), 1])[:3]
    content.update(repr((part.shape, (place.round(3) + 0.0).tolist(), about)).encode())
    content.update(part.astype(np.int32).tobytes())
