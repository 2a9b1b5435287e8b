"""LesionPresenter: lesions over the tissues, and proposals of them, without Qt."""

from __future__ import annotations

from typing import Any

from SlicerUSSim.Logic.base.errors import require, required
from SlicerUSSim.Logic.mrml.nodes import display_of
from SlicerUSSim.Logic.mrml.parameter_node import BY_LOOK
from SlicerUSSim.Widget.interface import PanelHost
from SlicerUSSim.Widget.notes import Notes, checks
from SlicerUSSim.Widget.segment_presenter import SegmentPresenter

#: Begin of the lines about a proposal
_PROPOSED = "proposal: "


class LesionPresenter:
    """Lays lesions over the tissues; proposes, accepts and discards them."""

    def __init__(self, panel: PanelHost, notes: Notes, segmenting: SegmentPresenter) -> None:
        self._panel, self._notes, self._segmenting = panel, notes, segmenting

    def canAddTissues(self) -> tuple[bool, str]:
        """(whether lesions can be laid over the tissues, the reason if not)"""
        can, why_not = self._panel.canSimulate()
        if can and self._panel.parameters.lesions is None:
            return False, "Choose a segmentation with segments called tumour, oedema, ..."
        return can, why_not

    def addTissues(self) -> None:
        """Lay the lesions over the chosen tissues, or over a copy of them in a new node (see replaceable)."""
        with self._panel.acting():
            self.layLesions()

    def layLesions(self) -> None:
        """As addTissues, but raises errors."""
        parameters = self._panel.parameters
        with self._panel.working("Add to tissues"):
            require(parameters.labels is not None, "no label map chosen; segment the MRI first")
            before: Any = parameters.labels
            if not self._notes.isAbout(before):
                self._notes.checks = []
            with self._segmenting.replaceable(f"{before.GetName()} with lesions", before) as labels:
                self._panel.logic.addTissues(before, parameters.lesions, labels)
            self._notes.add(*self._notes.checks)

    # ---- proposals ---------------------------------------------------------------------------------------------

    def canPropose(self) -> tuple[bool, str]:
        """(whether lesions can be proposed on the MRI, the reason if not)"""
        can, why_not = self._segmenting.canSegment()
        if can and not self._panel.logic.proposals.knows(self._panel.parameters.mri):
            return False, "Segment this MRI first"
        return can, why_not

    def canProposeAtPoint(self) -> tuple[bool, str]:
        """(whether a lesion can be proposed at the point, the reason if not)"""
        can, why_not = self.canPropose()
        if can and self._panel.parameters.seed is None:
            return False, "Choose a point in the lesion"
        return can, why_not

    def canAccept(self) -> tuple[bool, str]:
        """(whether there is a proposal to accept or discard, the reason if not)"""
        return self._panel.ready((self._panel.parameters.proposal, "There is no proposal"))

    def pickSeed(self) -> None:
        """Let the user show a point in the lesion in a view; then propose the lesion there."""
        parameters = self._panel.parameters
        with self._panel.acting():
            require(parameters.mri is not None, "no MRI chosen, expected the one with the lesion")
            require(self._panel.logic.proposals.knows(parameters.mri), "segment this MRI first")
            if parameters.seed is None:
                parameters.seed = self._panel.add("MarkupsFiducial", "Lesion")
            self._panel.view.pickPoint(parameters.seed, self.proposeAtPoint)

    def proposeAtPoint(self) -> None:
        """Propose the lesion around the last point of the chosen markups; nothing else is changed."""
        parameters = self._panel.parameters
        with self._panel.acting(), self._panel.working("Propose lesion"):
            tissue = None if parameters.panel.lesion_as == BY_LOOK else parameters.panel.lesion_as
            seed = required(parameters.seed, "no point chosen, expected one in the lesion")
            self._show(self._panel.logic.proposals.growFrom(parameters.mri, seed, tissue))

    def proposeLesions(self) -> None:
        """Propose what looks like lesions in the MRI, without a point; nothing else is changed."""
        with self._panel.acting(), self._panel.working("Propose lesions"):
            self._show(self._panel.logic.proposals.propose(self._panel.parameters.mri))

    def acceptProposal(self) -> None:
        """Move what is proposed, as it was corrected, to the lesions, and lay these over the tissues."""
        parameters = self._panel.parameters
        with self._panel.acting():
            proposal: Any = required(parameters.proposal, "there is no proposal")
            with self._panel.made(parameters.lesions, "Segmentation", "Lesions") as lesions:
                self._panel.logic.proposals.confirm(proposal, lesions)
            parameters.lesions, parameters.proposal = lesions, None
            self._notes.drop(_PROPOSED)
            if parameters.labels is not None:
                self.layLesions()

    def discardProposal(self) -> None:
        """Remove a proposal; nothing else is changed."""
        with self._panel.acting():
            proposal = required(self._panel.parameters.proposal, "there is no proposal")
            self._panel.parameters.proposal = None
            self._panel.logic.scene.RemoveNode(proposal)
            self._notes.drop(_PROPOSED)

    def _show(self, node: Any) -> None:
        """Choose a proposal, or none, and say what it is."""
        proposals = self._panel.logic.proposals
        self._panel.parameters.proposal = node
        if node is not None and display_of(node) is not None:
            display_of(node).SetVisibility(True)
        lines = [*proposals.notes, *checks(proposals.warnings)]
        if node is not None:
            lines.append(f"look at {node.GetName()!r} over the MRI, correct it, and accept or discard it")
        self._notes.say(_PROPOSED, *lines)
