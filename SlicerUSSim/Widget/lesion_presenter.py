"""LesionPresenter: lesions over the tissues, and their growth from a point, without Qt."""

from __future__ import annotations

from typing import Any

from SlicerUSSim.Logic.base.errors import require, required
from SlicerUSSim.Logic.mrml.nodes import display_of
from SlicerUSSim.Logic.mrml.parameter_node import BY_LOOK, LARGER
from SlicerUSSim.Widget.interface import PanelHost, tr as _
from SlicerUSSim.Widget.notes import GROWN, Notes, checks
from SlicerUSSim.Widget.segment_presenter import SegmentPresenter


class LesionPresenter:
    """Lays lesions over the tissues, and grows them from a point."""

    def __init__(self, panel: PanelHost, notes: Notes, segmenting: SegmentPresenter) -> None:
        self._panel, self._notes, self._segmenting = panel, notes, segmenting
        self.forget()

    def forget(self) -> None:
        """Forget the lesion that was grown last, which belongs to another patient."""
        self._grown: tuple[Any, list[str]] = (None, [])  # node and IDs of the segments

    def canAddTissues(self) -> tuple[bool, str]:
        """(whether lesions can be laid over the tissues, the reason if not)"""
        can, why_not = self._panel.canSimulate()
        if can and self._panel.parameters.lesions is None:
            return False, _("Choose a segmentation with segments called tumour, oedema, ...")
        return can, why_not

    def addTissues(self) -> None:
        """Lay the lesions over the chosen tissues, or over a copy of them in a new node (see replaceable)."""
        with self._panel.acting():
            self.layLesions()

    def layLesions(self) -> None:
        """As addTissues, but raises errors."""
        parameters = self._panel.parameters
        with self._panel.working(_("Add to tissues")):
            require(parameters.labels is not None, "no label map chosen; segment the MRI first")
            before: Any = parameters.labels
            if not self._notes.isAbout(before):
                self._notes.checks = []
            with self._segmenting.replaceable(f"{before.GetName()} with lesions", before) as labels:
                self._panel.logic.addTissues(before, parameters.lesions, labels)
            self._notes.drop(GROWN)
            self._notes.add(*self._notes.checks)

    # ---- growth from a point -----------------------------------------------------------------------------------

    def canGrow(self) -> tuple[bool, str]:
        """(whether a lesion can be grown on the MRI, the reason if not)"""
        can, why_not = self._segmenting.canSegment()
        if can and not self._panel.logic.growth.knows(self._panel.parameters.mri):
            return False, _("Segment this MRI first")
        return can, why_not

    def canRemove(self) -> tuple[bool, str]:
        """(whether the lesion that was grown last is there to be removed, the reason if not)"""
        return self._panel.ready((bool(self._last_grown()), _("No lesion was grown")))

    def pickSeed(self) -> None:
        """Let the user show a point in the lesion in a view; then grow the lesion there."""
        parameters = self._panel.parameters
        with self._panel.acting():
            require(parameters.mri is not None, "no MRI chosen, expected the one with the lesion")
            require(self._panel.logic.growth.knows(parameters.mri), "segment this MRI first")
            if parameters.seed is None:
                parameters.seed = self._panel.add("MarkupsFiducial", "Lesion")
            self._panel.view.pickPoint(parameters.seed, self.growAtPoint)

    def growAtPoint(self) -> None:
        """Add the lesion around the last point of the chosen markups to the lesions; the tissues do not change."""
        parameters, growth = self._panel.parameters, self._panel.logic.growth
        with self._panel.acting(), self._panel.working(_("Grow lesion")):
            chosen = parameters.panel
            tissue, larger = None if chosen.lesion_as == BY_LOOK else chosen.lesion_as, chosen.lesion_size == LARGER
            seed = required(parameters.seed, "no point chosen, expected one in the lesion")
            with self._panel.made(parameters.lesions, "Segmentation", "Lesions") as lesions:
                self._grown = lesions, growth.growFrom(parameters.mri, seed, lesions, tissue, larger)
            parameters.lesions = lesions
            if display_of(lesions) is not None:
                display_of(lesions).SetVisibility(True)
            after = f"look at {lesions.GetName()!r} over the MRI, and add it to the tissues, or remove it"
            self._notes.say(GROWN, *growth.notes, *checks(growth.warnings), after)

    def removeGrown(self) -> None:
        """Take the segments that were grown last out of the lesions."""
        with self._panel.acting():
            for segment_id in self._last_grown():
                self._grown[0].GetSegmentation().RemoveSegment(segment_id)
            self._notes.drop(GROWN)

    def _last_grown(self) -> list[str]:
        """IDs of the segments that were grown last and are still among the chosen lesions."""
        node, ids = self._grown
        if node is None or node is not self._panel.parameters.lesions:
            return []
        return [segment_id for segment_id in ids if node.GetSegmentation().GetSegment(segment_id) is not None]
