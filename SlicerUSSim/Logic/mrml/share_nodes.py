"""Shares of tissues in the voxels of labels that Segment wrote, kept in the scene with the node of these labels.

Labels alone say only which tissue a voxel has most of. What the segmentation knows besides, the second tissue of every
voxel and its share (Texture), is in a hidden volume to which the node of the labels refers. It is used until
a user edits the labels, and is saved with the scene, so that a scene has the same images after it is opened again.
"""

from __future__ import annotations

import json
from collections.abc import Hashable, Sequence

import numpy as np

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mrml.label_nodes import LABEL_CLASSES
from SlicerUSSim.Logic.mrml.nodes import nodes_of_class, read_volume, write_volume
from SlicerUSSim.Logic.mrml.own_results import content_of
from SlicerUSSim.Logic.tissue.texture import Texture

#: Reference of the labels' node to the volume
_ROLE = "SlicerUSSim.shares"
#: Attributes of the volume: the content of the labels' node (own_results.content_of), and the names of its labels
_OF, _NAMES = "SlicerUSSim.sharesOf", "SlicerUSSim.sharesNames"
#: Bytes of a voxel: second label, its probability, the part of the voxel that it fills, whether that is known
_PROBABILITY, _FILLED, _IS_FILLED = 8, 16, 24


def write_shares(labels_node, labels: Volume, names: Sequence[str], texture: Texture) -> None:
    """Keep the shares of `labels` (k, j, i), 1, 2, ... called `names`, which were written into the node."""
    scene, name = labels_node.GetScene(), f"{labels_node.GetName()} shares"
    _remove_unused(scene)
    node = labels_node.GetNodeReference(_ROLE)
    if node is None or len(_users(node)) > 1:  # a copy of a node refers to the same volume
        node = scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", scene.GenerateUniqueName(name))
        node.SetHideFromEditors(True)
        labels_node.SetNodeReferenceID(_ROLE, node.GetID())
    voxels = texture.second_label.astype(np.uint32) | _byte(texture.second_share) << _PROBABILITY
    if texture.volume_share is not None:
        voxels |= _byte(texture.volume_share) << _FILLED | np.uint32(1 << _IS_FILLED)
    node.SetAttribute(_NAMES, json.dumps(list(names)))
    node.SetAttribute(_OF, content_of(labels_node))
    write_volume(node, labels.with_array(voxels))


def shares_node(labels_node):
    """The volume node that write_shares wrote for a node; None without one."""
    return labels_node.GetNodeReference(_ROLE)


def set_shares_node(labels_node, node) -> None:
    """Let labels refer to a volume with shares, which write_shares wrote for the same content in another scene."""
    node.SetHideFromEditors(True)
    labels_node.SetNodeReferenceID(_ROLE, node.GetID())


def shares_version(labels_node) -> Hashable:
    """A value that changes with what write_shares kept for a node."""
    node = labels_node.GetNodeReference(_ROLE)
    return None if node is None or node.GetImageData() is None else (node.GetID(), node.GetImageData().GetMTime())


def read_shares(labels_node, labels: Volume, names: Sequence[str]) -> Texture | None:
    """The texture, without deviations, of a node's `labels` (k, j, i), 1, 2, ... called `names`.

    None if there is none, or they were edited. A segmentation node may return its labels on a smaller part of the grid.
    """
    node = labels_node.GetNodeReference(_ROLE)
    if node is None or node.GetImageData() is None or node.GetAttribute(_OF) != content_of(labels_node):
        return None
    kept = read_volume(node, "shares of the tissues")
    voxels = kept.array.astype(np.uint32)
    numbers = np.zeros(256, np.uint8)
    for number, name in enumerate(json.loads(node.GetAttribute(_NAMES)), 1):
        numbers[number] = names.index(name) + 1 if name in names else 0
    second = numbers[voxels & 255]
    shares = (np.where(second > 0, _share(voxels, shift), 0.0).astype(np.float32) for shift in (_PROBABILITY, _FILLED))
    probability, filled = shares
    is_known = bool((voxels >> _IS_FILLED).any())
    texture = Texture(second, probability, np.zeros(voxels.shape, np.float32), filled if is_known else None)
    return texture.on_grid_of(labels, kept)


def _users(shares_node) -> list:
    """The nodes of labels that refer to a volume with shares."""
    scene = shares_node.GetScene()
    nodes = (node for name in LABEL_CLASSES for node in nodes_of_class(scene, name))
    return [node for node in nodes if node.GetNodeReferenceID(_ROLE) == shares_node.GetID()]


def _remove_unused(scene) -> None:
    """Remove what was kept for nodes that are no longer in the scene."""
    for node in nodes_of_class(scene, "vtkMRMLScalarVolumeNode"):
        if node.GetAttribute(_OF) is not None and not _users(node):
            scene.RemoveNode(node)


def _byte(share: np.ndarray) -> np.ndarray:
    return np.rint(255.0 * share).astype(np.uint32)


def _share(voxels: np.ndarray, shift: int) -> np.ndarray:
    return ((voxels >> shift & 255) / 255.0).astype(np.float32)
