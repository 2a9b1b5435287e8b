"""Lesions proposed in a scene: grown from a markups point into a segmentation of their own, applied when confirmed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import slicer

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.mri.lesions.detection import propose_lesions
from SlicerUSSim.Logic.mri.lesions.proposal import Proposal
from SlicerUSSim.Logic.mri.lesions.seeded import grow_lesion
from SlicerUSSim.Logic.mri.segmentation import Segmentation
from SlicerUSSim.Logic.mrml.lesion_nodes import add_lesion
from SlicerUSSim.Logic.mrml.nodes import control_points, named, node_to_world, nodes_of_class, require_node
from SlicerUSSim.Logic.mrml.own_results import mark_as_made, may_replace

#: Name of the node with a proposal
NAME = "Lesion proposal"


class LesionProposals:
    """Proposes lesions on the last segmentation of a scene.

    A proposal is a segmentation node of its own, with a segment for each part, and changes nothing else. confirm()
    moves its segments to the lesions; UltrasoundSceneLogic.addTissues lays those over the labels. What a user has
    edited, or confirmed, is never replaced.

    Parameters
    ----------
    scene : vtkMRMLScene.
    work : runs a slow function that does not access nodes, and returns its result.
    """

    def __init__(self, scene, work: Callable[[Callable[[], Any]], Any]) -> None:
        self._scene, self._work = scene, work
        self._last: tuple[str, object, Segmentation] | None = None
        #: Of the last proposal: what it is, and what a user should check, one line each
        self.notes: tuple[str, ...] = ()
        self.warnings: tuple[str, ...] = ()

    def segmented(self, mri_node, result: Segmentation) -> None:
        """Take note of a segmentation of an MRI node, on which lesions are proposed from now on."""
        self._last = (mri_node.GetID(), _version(mri_node), result)

    def knows(self, mri_node) -> bool:
        """Whether lesions can be proposed on an MRI node: it was segmented, and has not changed since."""
        return mri_node is not None and self._last is not None and self._last[:2] == (
            mri_node.GetID(), _version(mri_node),
        )  # fmt: skip

    def growFrom(self, mri_node, points_node, tissue: str | None = None):
        """The segmentation node with the lesion around the last control point of a markups node that is placed.

        See seeded.grow_lesion. Raises SimulationError, and changes nothing, if the MRI was not segmented or has changed
        since, and for a point in what is no lesion.
        """
        require_node(points_node, "vtkMRMLMarkupsFiducialNode", use="point in the lesion")
        placed = control_points(points_node)
        require(len(placed) > 0, f"{named(points_node)} has no point, expected one in the lesion; click it in a slice")
        result = self._segmentation_of(mri_node)
        seed = np.linalg.inv(node_to_world(mri_node)) @ [*placed[-1], 1.0]
        return self._written([self._work(lambda: grow_lesion(result, seed[:3].tolist(), tissue))], mri_node)

    def propose(self, mri_node):
        """The segmentation node with what looks like lesions, without a point; None if nothing does."""
        result = self._segmentation_of(mri_node)
        found = self._work(lambda: propose_lesions(result))
        if not found:
            self.notes, self.warnings = ("no lesion proposed",), ()
            return None
        return self._written(found, mri_node)

    def confirm(self, proposal_node, lesions_node) -> tuple[str, ...]:
        """Move the segments of a proposal, also of an edited one, to the lesions; their tissues.

        The proposal node is removed from the scene.
        """
        require_node(proposal_node, "vtkMRMLSegmentationNode", use="proposal")
        require_node(lesions_node, "vtkMRMLSegmentationNode", use="lesions")
        require(proposal_node is not lesions_node, f"proposal and lesions are both {named(lesions_node)}")
        source, target = proposal_node.GetSegmentation(), lesions_node.GetSegmentation()
        ids = list(source.GetSegmentIDs())
        require(bool(ids), f"proposal {named(proposal_node)} is empty, expected a lesion")
        apart = not np.allclose(node_to_world(proposal_node), node_to_world(lesions_node), atol=1e-6)
        if target.GetNumberOfSegments() == 0 and apart:
            lesions_node.SetAndObserveTransformNodeID(proposal_node.GetTransformNodeID())
        else:
            require(not apart, f"{named(lesions_node)} has another parent transform than {named(proposal_node)}")
        if target.GetNumberOfSegments() == 0:
            lesions_node.SetSourceRepresentationToBinaryLabelmap()
        names = []
        for segment_id in ids:
            segment, image = source.GetSegment(segment_id), slicer.vtkOrientedImageData()
            name = segment.GetName()
            is_there = proposal_node.GetBinaryLabelmapRepresentation(segment_id, image)
            require(is_there and min(image.GetDimensions()) > 0, f"segment {name!r} of {named(proposal_node)} is empty")
            lesions_node.AddSegmentFromBinaryLabelmapRepresentation(
                image, name, segment.GetColor(), target.GenerateUniqueSegmentID(name)
            )
            names.append(name)
        self._scene.RemoveNode(proposal_node)
        return tuple(names)

    def _segmentation_of(self, mri_node) -> Segmentation:
        require_node(mri_node, "vtkMRMLScalarVolumeNode", use="MRI")
        if self._last is None or not self.knows(mri_node):
            raise SimulationError(f"{named(mri_node)} was not segmented yet, or has changed since; segment it first")
        return self._last[2]

    def _written(self, proposals: Sequence[Proposal], mri_node):
        """The node with these proposals: the last one if nobody has edited it, else a new one."""
        nodes = nodes_of_class(self._scene, "vtkMRMLSegmentationNode")
        known = (node for node in nodes if node.GetName().startswith(NAME) and may_replace(node))
        node = next(known, None) or self._scene.AddNewNodeByClass("vtkMRMLSegmentationNode", NAME)
        node.GetSegmentation().RemoveAllSegments()
        node.SetAndObserveTransformNodeID(mri_node.GetTransformNodeID())
        for proposal in proposals:
            for tissue in proposal.tissues:
                add_lesion(node, proposal.mask(tissue), tissue, tissue)
        mark_as_made(node)
        self.notes = tuple(proposal.message for proposal in proposals)
        self.warnings = tuple(line for proposal in proposals for line in proposal.warnings)
        return node


def _version(volume_node) -> object:
    """Changes with the voxels of a volume node."""
    image = volume_node.GetImageData()
    return None if image is None else image.GetMTime()
