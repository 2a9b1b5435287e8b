"""Marks of label nodes whose content Segment made, so that it never overwrites what others made or edited."""

from __future__ import annotations

import hashlib

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mrml.label_nodes import node_labels, overlapping_segments
from SlicerUSSim.Logic.mrml.own_results import claim, is_claimed, is_empty

#: Attribute of a node, saved with the scene: a hash of voxels, place and names as Segment wrote them.
_MADE = "SlicerUSSim.made"


def mark_as_made(labels_node) -> None:
    """Record that the present content of a label map or segmentation node was made by this program."""
    labels_node.SetAttribute(_MADE, content_of(labels_node))
    claim(labels_node)


def content_as_made(labels_node) -> str | None:
    """content_of a node when mark_as_made was called with it last; None if it never was, or with a node copied."""
    return labels_node.GetAttribute(_MADE) if is_claimed(labels_node) else None


def may_replace(labels_node) -> bool:
    """Whether a node is new, or has labels that this program made, and nobody has edited since.

    A new one has neither segments nor voxels; segments without voxels are somebody's plan. A copy of labels is of whom
    copied them, see own_results.
    """
    made = content_as_made(labels_node)
    return is_empty(labels_node) or (made is not None and content_of(labels_node) == made)


def content_of(labels_node) -> str:
    """A hash of voxels, position and names, the same after saving and loading; "" if no voxel has a label.

    Where segments overlap, the voxels of each count, since those below others are as much somebody's work. Without
    overlaps, as Segment writes its results, the hash is that of earlier versions, which knew the topmost segment of
    every voxel only: what these made is known again. What they made with overlaps is taken for its user's, and kept.
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
        for number, segment in enumerate(overlapping_segments(labels_node)):
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
