"""Marks of label nodes whose content Segment made, so that it never overwrites what others made or edited."""

from __future__ import annotations

import hashlib

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.mrml.label_nodes import node_labels
from SlicerUSSim.Logic.mrml.ownership import claim, is_claimed

#: Attribute of a node, saved with the scene: a hash of voxels, place and names as Segment wrote them.
_MADE = "SlicerUSSim.made"


def mark_as_made(labels_node) -> None:
    """Record that the present content of a label map or segmentation node was made by this program."""
    labels_node.SetAttribute(_MADE, content_of(labels_node))
    claim(labels_node)


def may_replace(labels_node) -> bool:
    """Whether a node is new, or has labels that this program made, and nobody has edited since.

    A new one has neither segments nor voxels; segments without voxels are somebody's plan. A copy of labels is of whom
    copied them, see ownership.
    """
    is_own = is_claimed(labels_node) and labels_node.GetAttribute(_MADE) is not None
    return _is_new(labels_node) or (is_own and content_of(labels_node) == labels_node.GetAttribute(_MADE))


def _is_new(labels_node) -> bool:
    if labels_node.IsA("vtkMRMLSegmentationNode"):
        return labels_node.GetSegmentation().GetNumberOfSegments() == 0
    image = labels_node.GetImageData()
    return image is None or image.GetNumberOfPoints() == 0


def content_of(labels_node) -> str:
    """A hash of voxels, position and names, the same after saving and loading; "" if no voxel has a label."""
    try:
        volume, names = node_labels(labels_node)
    except SimulationError:  # no segments, or none with a voxel
        return ""
    found = np.argwhere(volume.array)
    if not found.size:
        return ""
    # Only the part with labels, since segmentations are stored cropped.
    low, high = found.min(axis=0), found.max(axis=0) + 1
    part = volume.array[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
    place = volume.ijk_to_ras.copy()
    place[:3, 3] = (volume.ijk_to_ras @ [*low[::-1], 1])[:3]
    content = hashlib.sha256(repr((part.shape, (place.round(3) + 0.0).tolist(), sorted(names.items()))).encode())
    content.update(part.astype(np.int32).tobytes())
    return content.hexdigest()
