"""SegmentPresenter: segmentation of the MRI into tissues, and its undo, without Qt."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from SlicerUSSim.Logic.base.errors import SimulationError, require, required
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.segmentation import Segmentation
from SlicerUSSim.Logic.mrml.label_nodes import LABEL_CLASSES, empty, read_labels, write_labels
from SlicerUSSim.Logic.mrml.nodes import nodes_of_class
from SlicerUSSim.Logic.mrml.own_results import SHEETS, content_as_made, content_of, mark_as_made, mark_as_result
from SlicerUSSim.Logic.mrml.share_nodes import read_shares, write_shares
from SlicerUSSim.Logic.mrml.taken_image import PATIENT, mri_of
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tissue.texture import Texture
from SlicerUSSim.Widget.interface import PanelHost, tr as _
from SlicerUSSim.Widget.notes import Notes, checks

#: Roles of nodes that Segment chooses, and of those beside them that belong to the patient whose tissues are chosen
_OF_SEGMENT = ("labels", "mask", "sheets")
_BESIDE = ("lesions", "second_mri", "organs", "opening")


@dataclass(frozen=True, eq=False)
class _BeforeSegment:
    """What a Segment replaced."""

    labels: LabelsBefore
    #: {role: chosen node}
    nodes: dict[str, Any]
    #: vtkPolyData of the sheets
    sheets: Any
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _LastSegment:
    """The last Segment: what it replaced, and what it left."""

    before: _BeforeSegment
    labels: Any
    #: Of the labels, see own_results.content_as_made
    content: str | None
    #: {role: chosen node}
    nodes: dict[str, Any]


class SegmentPresenter:
    """Runs Segment, and goes back to what was before.

    Parameters
    ----------
    label_maps : whether new labels are label maps and not segmentations.
    """

    def __init__(self, panel: PanelHost, notes: Notes, label_maps: bool) -> None:
        self._panel, self._notes, self._label_maps = panel, notes, label_maps
        #: File in which the brain mask of an MRI node is kept beside the MRI's; None: in the scene only
        self.maskFile: Callable[[Any], Path | None] = lambda mri_node: None
        #: The same of the sheets that were found in it
        self.sheetsFile: Callable[[Any], Path | None] = lambda mri_node: None
        self.forget()

    def forget(self) -> None:
        """Forget the last Segment, which belongs to another patient."""
        self._last: _LastSegment | None = None
        self._mri: Any = None  # as it was chosen when followMri was called last

    def followMri(self) -> None:
        """Choose the tissues of the MRI if another MRI was chosen: those that are in the scene, or none."""
        parameters, before = self._panel.parameters, self._mri
        self._mri = mri = parameters.mri
        if None in (before, mri) or before is mri:
            return
        if parameters.labels is not None and not self._are_of_other(parameters.labels, mri):
            return
        told = self._forget_other_patient(mri)
        labels = [node for kind in LABEL_CLASSES for node in nodes_of_class(self._panel.logic.scene, kind)]
        own = [node for node in labels if mri_of(node) is mri]
        if not own:
            self._panel.logic.stopLiveUpdate()  # images of the patient before stay, as FROZEN
        parameters.labels = own[-1] if own else None
        self._notes.set(*told)

    def canSegment(self) -> tuple[bool, str]:
        """(whether Segment is enabled, the reason if not)"""
        return self._panel.ready((self._panel.parameters.mri, _("Choose an MRI first")))

    def canEdit(self) -> tuple[bool, str]:
        """(whether the Segment Editor can edit the tissues, the reason if not)"""
        labels: Any = self._panel.parameters.labels
        is_segmentation = labels is not None and labels.IsA("vtkMRMLSegmentationNode")
        return self._panel.ready((is_segmentation, _("Segment the MRI, or choose a segmentation of its tissues")))

    def segment(self) -> None:
        """Segment the MRI into the chosen label map or segmentation, or into a new node (see replaceable)."""
        panel, notes, parameters = self._panel, self._notes, self._panel.parameters
        with panel.acting(), panel.working(_("Segment")) as progress:
            mri = required(parameters.mri, "no MRI chosen, expected a scalar volume")
            if notes.segmented not in (None, mri):  # also if this fails: they are about another patient
                notes.set()
            chosen, lines, settings = self._chosen(_BESIDE), notes.lines, parameters.segmentation
            nodes = self._chosen()
            told = self._forget_other_brain(mri) + self._forget_other_patient(mri) + self._closed_again()
            before = _BeforeSegment(self._labels_before(), nodes, _data_of(parameters.sheets), lines)
            others, untold = self._second_mri()
            kinds = parameters.sheet.kinds if parameters.sheet.find else ()
            own_sheets = parameters.sheets if kinds and self._are_own_sheets() else None
            with (
                self._chosen_again_on_failure(chosen | nodes),
                panel.made(own_sheets, "Model", f"{mri.GetName()} sheets", wanted=bool(kinds)) as sheets,
                self.replaceable(f"{mri.GetName()} tissues", mri) as labels,
            ):
                result = panel.logic.segment(
                    mri, labels, settings, mask_node=parameters.mask, others=others, organs_node=parameters.organs,
                    lesions_node=parameters.lesions, sheets=kinds, sheets_node=sheets,
                    keep_mask_at=self.maskFile(mri), keep_sheets_at=self.sheetsFile(mri), progress=progress,
                )  # fmt: skip
            told += self._take_sheets(sheets)
            notes.segmented, notes.checks = mri, checks(result.warnings)
            if (
                parameters.mask is None
                and isinstance(result, Segmentation)  # and not of a CT
                and result.brain.method not in ("stripped", "none")
            ):
                parameters.mask = brain = panel.logic.writeBrain(result, mri)
                told.append(f"the brain mask is {brain.GetName()!r}, which Segment uses from now on; edit it as needed")
            notes.add(*told, *untold)
            content = content_as_made(labels)
            self._last = _LastSegment(before, labels, content, self._chosen())

    @contextmanager
    def replaceable(self, name: str, source: Any) -> Iterator[Any]:
        """The chosen labels if Segment made them and no user edited them; otherwise a new node, which is selected.

        Afterwards the notes are the logic's, about the node `source`.
        """
        panel, chosen = self._panel, self._panel.parameters.labels
        kept, is_of_other = None, chosen is not None and self._are_of_other(chosen, source)
        if chosen is not None and (is_of_other or not panel.logic.mayReplace(chosen)):
            kept = str(chosen.GetName())
        kind = "LabelMapVolume" if self._label_maps else "Segmentation"
        with panel.made(chosen if kept is None else None, kind, name) as node:
            yield node
        panel.parameters.labels = node
        self._notes.replaceByLogic(source, node)
        if kept is not None:
            why = "belongs to another MRI" if is_of_other else "was not made by Segment, or edited since"
            self._notes.add(f"{kept!r} {why}, and is kept; the result is {node.GetName()!r}")

    # ---- undo --------------------------------------------------------------------------------------------------

    def canUndoSegment(self) -> tuple[bool, str]:
        """(whether the last Segment can be undone, the reason if not)"""
        last, chosen, logic = self._last, self._panel.parameters.labels, self._panel.logic
        can, why_not = self._panel.ready((last, _("Nothing was segmented since the scene was opened")))
        if not can or last is None:
            return can, why_not
        if last.labels.GetScene() is None:
            return False, _("The tissues of the last Segment were removed from the scene")
        name = repr(last.labels.GetName())
        if chosen is not None and chosen is not last.labels and logic.closedLabels(chosen) is last.labels:
            return False, _("The skull was opened in {name} after Segment; close it first").format(name=name)
        if content_as_made(last.labels) != last.content:
            text = _("{name} was changed after Segment, as by lesions laid over it, and is kept")
            return False, text.format(name=name)
        if not logic.mayReplace(last.labels):
            return False, _("{name} was edited after Segment, and is kept").format(name=name)
        return True, ""

    def undoSegment(self) -> None:
        """Go back to the tissues, mask, sheets and notes from before the last Segment.

        Settings, and what the user chose since then, stay, whatever it is; only the node into which Segment wrote is
        changed, or removed if Segment made it.
        """
        panel, parameters = self._panel, self._panel.parameters
        with panel.acting():
            can, why_not = self.canUndoSegment()
            require(can, why_not)
            last = required(self._last, why_not)
            if last.before.nodes["labels"] is None:  # nothing is left of which there are images
                panel.logic.stopLiveUpdate()
            before, self._last = last.before, None
            are_its_notes = self._notes.isAbout(last.labels)
            before.labels.restore()
            for role, node in before.nodes.items():
                if getattr(parameters, role) is last.nodes[role]:
                    setattr(parameters, role, None if node is None or node.GetScene() is None else node)
            sheets: Any = before.nodes["sheets"]
            if (
                before.sheets is not None
                and sheets.GetScene() is not None
                and sheets.GetPolyData() is not before.sheets
                and panel.logic.mayReplaceResult(sheets)
            ):
                sheets.SetAndObservePolyData(before.sheets)
                mark_as_result(sheets, SHEETS)
            if last.labels is not before.labels.node:
                panel.logic.scene.RemoveNode(last.labels)
            if are_its_notes:
                self._notes.set(*before.notes)
                self._notes.checks = []

    # ---- what Segment finds chosen -----------------------------------------------------------------------------

    def _chosen(self, roles: Iterable[str] = _OF_SEGMENT) -> dict[str, Any]:
        """{role: chosen node} of some roles, by default those that Segment chooses."""
        return {role: getattr(self._panel.parameters, role) for role in roles}

    def _labels_before(self) -> LabelsBefore:
        labels: Any = self._panel.parameters.labels
        replaced = labels if labels is not None and self._panel.logic.mayReplace(labels) else None
        return LabelsBefore(replaced, self._panel.preset.tissues)

    def _are_own_sheets(self) -> bool:
        """Whether the chosen sheets are of Segment, and not those that a user loaded."""
        chosen = self._panel.parameters.sheets
        return chosen is not None and self._panel.logic.mayReplaceResult(chosen)

    def _take_sheets(self, found: Any) -> list[str]:
        """Choose the sheets that Segment found, or none in place of those of an earlier Segment; a line about it."""
        parameters = self._panel.parameters
        before: Any = parameters.sheets
        if found is not None:
            parameters.sheets = found
            lines = [f"images show the sheets in {found.GetName()!r}"]
            if before not in (None, found):
                lines.append(f"{before.GetName()!r} was loaded separately and is kept, but no longer shown")
            return lines
        if before is None:
            return []
        if self._are_own_sheets():
            parameters.sheets = None
            return [f"the sheets in {before.GetName()!r}, of an earlier Segment, are no longer shown"]
        return [f"images show the sheets in {before.GetName()!r}"]

    def _forget_other_brain(self, mri: Any) -> list[str]:
        """Deselect the mask that Segment extracted from another MRI; a line about it."""
        mask: Any = self._panel.parameters.mask
        if self._panel.logic.isBrainOf(mask, mri) is not False:
            return []
        self._panel.parameters.mask = None
        return [f"{mask.GetName()!r} is the mask of another MRI and was not used"]

    @contextmanager
    def _chosen_again_on_failure(self, chosen: dict[str, Any]) -> Iterator[None]:
        try:
            yield
        except BaseException:
            for role, node in chosen.items():
                setattr(self._panel.parameters, role, node)
            raise

    @staticmethod
    def _are_of_other(labels: Any, source: Any) -> bool:
        """Whether labels are known to be of another volume than that which is now segmented."""
        return source.IsA("vtkMRMLScalarVolumeNode") and mri_of(labels) not in (None, source, mri_of(source))

    def _forget_other_patient(self, mri: Any) -> list[str]:
        """Deselect what was chosen beside the tissues of another MRI; lines about it."""
        parameters, lines = self._panel.parameters, []
        if parameters.labels is None or not self._are_of_other(parameters.labels, mri):
            return []
        for role, node in self._chosen(_BESIDE).items():
            if node is not None:
                setattr(parameters, role, None)
                lines.append(
                    f"{node.GetName()!r} was chosen for another MRI and was not used; choose it if it fits this one"
                )
        return lines

    def _closed_again(self) -> list[str]:
        """Choose the labels before the opening, into which Segment writes; a line about it."""
        logic, chosen = self._panel.logic, self._panel.parameters.labels
        closed = None if chosen is None else logic.closedLabels(chosen)
        if chosen is None or closed is chosen:
            return []
        logic.hideOpening(chosen)
        self._panel.parameters.labels = closed
        return [f"the skull is closed again; {chosen.GetName()!r} still has the opening in the tissues before"]

    def _second_mri(self) -> tuple[dict[str, Any], list[str]]:
        """({contrast: node}, lines about it)"""
        parameters = self._panel.parameters
        node, contrast = parameters.second_mri, parameters.panel.second_contrast
        if node is None or contrast == "none":
            return {}, [] if node is None else ["the second MRI was not used: choose its contrast"]
        require(node is not parameters.mri, f"first and second MRI are both {node.GetName()!r}, expected two volumes")
        return {contrast: node}, []


def _data_of(model_node: Any) -> Any:
    return None if model_node is None else model_node.GetPolyData()


# ---- the labels before Segment, to which a user can go back ----------------------------------------------------------


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
