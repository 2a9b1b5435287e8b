"""Whose a node is: those that this module filled refer to themselves, so that a copy of one is its user's.

Attributes are copied with a node, and the number in a node's ID may change when a scene is imported into another one.
A reference to the node itself does right in both: a copy (clone) refers to the node that it was copied from, and scenes
put references right when they give nodes other IDs, on import as on loading. Nodes of scenes that were saved by
versions without this reference are taken for their users', and kept.
"""

from __future__ import annotations

from typing import Any

#: Role of the reference of a node to itself; saved with the scene
OWN = "SlicerUSSim.own"


def claim(node: Any) -> None:
    """Record that this module filled a node; one outside a scene, as an item of a sequence, has no ID and stays."""
    if node.GetScene() is not None and not is_claimed(node):
        node.SetNodeReferenceID(OWN, node.GetID())


def is_claimed(node: Any) -> bool:
    """Whether this module filled this very node, and not one that it is a copy of."""
    return node.GetID() is not None and node.GetNodeReferenceID(OWN) == node.GetID()
