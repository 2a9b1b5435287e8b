"""LabelsBefore: the labels before Segment, to which a user can go back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mrml.label_nodes import empty, read_labels, write_labels
from SlicerUSSim.Logic.mrml.own_results import content_of, mark_as_made
from SlicerUSSim.Logic.mrml.share_nodes import read_shares, write_shares
from SlicerUSSim.Logic.mrml.taken_image import PATIENT
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tissue.texture import Texture


class LabelsBefore:
    """A copy of what a label map or segmentation node holds.

    Parameters
    ----------
    labels_node : the node that Segment may replace; None if there is none.
    tissues : see label_nodes.read_labels.
    """

    def __init__(self, labels_node: Any, tissues: TissueTable) -> None:
        self.node = labels_node
        self._kept: tuple[Volume, Sequence[str], Texture | None, str | None] | None = None
        self._content = ""
        if labels_node is None:
            return
        self._content = content_of(labels_node)
        try:
            found = read_labels(labels_node, tissues)
        except SimulationError:  # an empty node
            return
        labels = found.labels.with_array(found.labels.array.copy())
        shares = read_shares(labels_node, labels, found.names)
        self._kept = labels, found.names, shares, labels_node.GetAttribute(PATIENT)

    @property
    def is_changed(self) -> bool:
        """Whether the node holds something else now."""
        return self.node is not None and content_of(self.node) != self._content

    def restore(self) -> None:
        """Write the copy into the node, as this module's own; one that was empty is emptied again."""
        if not self.is_changed:
            return
        if self._kept is None:
            empty(self.node)
            return
        labels, names, shares, patient = self._kept
        write_labels(self.node, labels, names, self.node)
        mark_as_made(self.node)
        if patient is None:
            self.node.RemoveAttribute(PATIENT)
        else:
            self.node.SetAttribute(PATIENT, patient)
        if shares is not None:
            write_shares(self.node, labels, names, shares)
