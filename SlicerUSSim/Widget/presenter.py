"""PanelPresenter: the behaviour of the panel, without Qt.

A view calls it for each action of the user and displays its state. Views are the panel in Slicer (panel.py), the page
in the browser, and the view of the tests. Errors caused by the user are not raised, but shown in one line.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import Cancelled, SimulationError, require, required, user_message
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mri.segmentation import Segmentation
from SlicerUSSim.Logic.mri.segmentation_settings import GEL_MM, SegmentationSettings
from SlicerUSSim.Logic.mrml.fitting_nodes import fits
from SlicerUSSim.Logic.mrml.labels_before import LabelsBefore
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic
from SlicerUSSim.Logic.mrml.nodes import display_of, nodes_of_class, probe_pose, set_node_to_world
from SlicerUSSim.Logic.mrml.own_results import SHEETS, content_as_made, mark_as_result
from SlicerUSSim.Logic.mrml.parameter_node import BY_LOOK
from SlicerUSSim.Logic.mrml.sequence_nodes import MADE_FROM
from SlicerUSSim.Logic.mrml.taken_sequence import FrozenRecord
from SlicerUSSim.Logic.probe.arrays import PROBES, Probe
from SlicerUSSim.Logic.probe.beam import TRANSMIT_OF
from SlicerUSSim.Logic.tissue.names import same_name
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tissue.tissue import TISSUE_PARAMETERS, Tissue
from SlicerUSSim.Widget.controls import SCENE, from_shown, in_words_of, to_shown, value_parameter
from SlicerUSSim.Widget.fit_presenter import FitPresenter
from SlicerUSSim.Widget.interface import PanelView
from SlicerUSSim.Widget.sections import CUSTOM_PROBE, SHOWN_PROBES

#: Begin of the lines of the notes that a user should check
_CHECK = "Check: "
#: Begin of the line about an opening
_OPENED = "craniotomy: "
#: Begin of the line about where the probe was placed: at a standard view, or in an opening
_VIEW, _PLACED = "view: ", "probe: "
#: Begin of the lines about a proposal
_PROPOSED = "proposal: "
#: What is said of an image that does not follow the probe any more
FROZEN = "FROZEN"
_BUSY = "Wait until the work under way is done"
#: Columns of the tissue table: parameter, heading, tool tip.
TISSUE_COLUMNS = tuple(
    (entry.name, entry.symbol or entry.label, f"{entry.tip} [{entry.unit}]" if entry.unit else entry.tip)
    for entry in TISSUE_PARAMETERS
)


@dataclass(frozen=True)
class TissueRow:
    """A line of the tissue table."""

    name: str
    #: In the order of TISSUE_COLUMNS
    values: tuple[float, ...]
    #: Sources of the values
    sources: tuple[str, ...]


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
    settings: SegmentationSettings


class PanelPresenter:
    """Operates on one scene for one view.

    With `handles`, a placed probe has Slicer's interaction handles for translation and rotation. With `label_maps`, new
    labels are label maps and not segmentations.
    """

    def __init__(
        self, logic: UltrasoundSceneLogic, view: PanelView, handles: bool = True, label_maps: bool = False
    ) -> None:
        self.logic = logic
        self.view = view
        self._handles, self._label_maps = handles, label_maps
        self._notes: list[str] = []
        self._checks: list[str] = []  # those of the notes that are about the tissues under the lesions
        self._notes_of: str | None = None  # ID of the MRI node that was segmented
        self._labels_said: str | None = None  # ID of the labels that the notes are about
        #: File in which the brain mask of an MRI node is kept beside the MRI's; None: in the scene only
        self.maskFile: Callable[[Any], Path | None] = lambda mri_node: None
        #: The same of the sheets that were found in it
        self.sheetsFile: Callable[[Any], Path | None] = lambda mri_node: None
        self._busy = False
        self._last_segment: _LastSegment | None = None
        #: {content of labels, see own_results.content_of: settings by which Segment made them}
        self._made_by: dict[str | None, SegmentationSettings] = {}
        self._custom_probe: Probe | None = None  # the last one that was none of PROBES
        self._last_image: float | None = None
        #: The lines about bone before the probe that the notes had when they were shown last
        self._probe_said: tuple[str, ...] = ()
        self._followed: tuple = ()  # the nodes of the live update
        #: Fits of simulated to real ultrasound
        self.fits = FitPresenter(self)

    # ---- values of preset and scene ----------------------------------------------------------------------------

    def value(self, name: str):
        """The displayed form of a value, named as in controls.py; None if the probe has no such value.

        The same for a value of another transmission than the probe's, which it would refuse.
        """
        declared = value_parameter(name)
        section, attribute = name.split(".")
        if section == SCENE:
            try:
                return to_shown(declared, getattr(self.logic.parameters, attribute))
            except SimulationError:  # an invalid value in the scene: the error is shown when it is used
                return to_shown(declared, declared.default)
        owner = getattr(self._preset(), section)
        if section == "probe" and attribute in TRANSMIT_OF and owner.transmit != TRANSMIT_OF[attribute]:
            return None
        return to_shown(declared, getattr(owner, attribute)) if hasattr(owner, attribute) else None

    def setValue(self, name: str, shown) -> None:
        """Set a value from its displayed form."""
        declared = value_parameter(name)
        section, attribute = name.split(".")
        with self.shown(), in_words_of(declared, shown):
            value = from_shown(declared, shown)
            if section == SCENE:
                setattr(self.logic.parameters, attribute, value)
                return
            preset = self._preset().changed(section, **{attribute: value})
            if preset != self._preset():
                self.logic.preset = preset

    def chooseProbe(self, name: str) -> None:
        """Select a probe of probe.PROBES by its name there or in the panel.

        CUSTOM_PROBE is the last one that was none of them; before there is one, it is said how to make it.
        """
        with self.shown():
            before = self._preset().probe
            if self.probeName() == CUSTOM_PROBE:
                self._custom_probe = before
            if name == CUSTOM_PROBE:
                probe = required(
                    self._custom_probe, "there is no custom probe yet: change a value of this probe, and it is one"
                )
            else:
                key = SHOWN_PROBES.get(name, name)
                require(key in PROBES, f"no probe is called {name!r}, expected one of {', '.join(SHOWN_PROBES)}")
                probe = PROBES[key]
            self.logic.preset = replace(self._preset(), probe=probe)
        self.view.refresh()

    def probeName(self) -> str:
        """Name in the panel of the probe of probe.PROBES; sections.CUSTOM_PROBE if it is not one of them."""
        probe = self._preset().probe
        return next((shown for shown, name in SHOWN_PROBES.items() if PROBES[name] == probe), CUSTOM_PROBE)

    def loadPreset(self, path: str | os.PathLike) -> None:
        """Read the preset from a JSON file of the module or the `ussim` command."""
        with self.shown():
            self.takePreset(Preset.read(path))
        self.view.refresh()

    def takePreset(self, preset: Preset) -> None:
        """Use a preset; one with a pose moves the probe there, if there are tissues to look at."""
        pose, parameters = preset.probe_to_ras, self.logic.parameters
        self.logic.preset = replace(preset, probe_to_ras=None)
        if pose is None:
            return
        require(
            parameters.labels is not None,
            "the pose of the preset is not used, since there are no tissues to look at; segment the MRI, and load it "
            "again",
        )
        if parameters.probe_transform is None:
            self._put_probe()
        set_node_to_world(parameters.probe_transform, np.array(pose))

    def presetToSave(self) -> Preset:
        """The preset, with the pose of the probe if it is wanted. Raises SimulationError if it has none."""
        preset, parameters = self._preset(), self.logic.parameters
        if not parameters.panel.preset_pose:
            return preset
        transform = required(
            parameters.probe_transform, "Pose in presets is ticked, and there is no probe; place it, or untick it"
        )
        return replace(preset, probe_to_ras=tuple(map(tuple, probe_pose(transform).tolist())))

    def savePreset(self, path: str | os.PathLike) -> None:
        """Write the preset to a JSON file."""
        with self.shown():
            self.presetToSave().write(path)

    # ---- tissues -----------------------------------------------------------------------------------------------

    def tissues(self) -> list[TissueRow]:
        """The tissues of the chosen labels, or of the preset without labels; coupling medium first, membrane last."""
        rows: dict[str, TissueRow] = {}
        for tissue in self.tissueTable().all_tissues():
            values = tuple(getattr(tissue, parameter) for parameter, _, _ in TISSUE_COLUMNS)
            sources = tuple(tissue.sources.get(parameter, "set by hand") for parameter, _, _ in TISSUE_COLUMNS)
            rows.setdefault(tissue.name, TissueRow(tissue.name, values, sources))
        return list(rows.values())

    def setTissue(self, name: str, parameter: str, text: str) -> None:
        """Set a parameter of a tissue from the text of a table cell."""
        with self.shown():
            try:
                value = float(text.strip().replace(",", "."))
            except ValueError:
                value = math.nan
            require(math.isfinite(value), f"tissue {name!r}: {parameter} is {text!r}, expected a number")
            self._change_tissue(name, lambda old: replace(old, **{parameter: value}, sources=_without(old, parameter)))

    def assignTissue(self, name: str, preset: str) -> None:
        """Copy the parameters of the preset tissue `preset` to the tissue `name`."""
        with self.shown():
            require(preset in TISSUES, f"no tissue is called {preset!r}, expected one of {', '.join(TISSUES)}")
            self._change_tissue(name, lambda old: replace(TISSUES[preset], name=old.name))
        self.view.refresh()

    def resetTissues(self) -> None:
        """Reset all tissues to the presets."""
        with self.shown():
            preset = self._preset()
            table = {label: TISSUES.get(tissue.name, tissue) for label, tissue in preset.tissues.items()}
            self.logic.preset = replace(preset, tissues=TissueTable(table, Preset().tissues.membrane))
        self.view.refresh()

    # ---- actions -----------------------------------------------------------------------------------------------

    @property
    def isBusy(self) -> bool:
        """Whether work is under way for which live images wait."""
        return self._busy

    def canSegment(self) -> tuple[bool, str]:
        """(whether Segment is enabled, the reason if not)"""
        if self._busy:
            return False, _BUSY
        if self.logic.parameters.mri is None:
            return False, "Choose an MRI first"
        return True, ""

    def canSimulate(self) -> tuple[bool, str]:
        """(whether an image can be simulated, the reason if not)"""
        if self._busy:
            return False, _BUSY
        if self.logic.parameters.labels is None:
            return False, "Segment the MRI, or choose a label map or segmentation"
        return True, ""

    def canAddTissues(self) -> tuple[bool, str]:
        """(whether lesions can be laid over the tissues, the reason if not)"""
        if self._busy:
            return False, _BUSY
        if self.logic.parameters.labels is None:
            return False, "Segment the MRI, or choose a label map or segmentation"
        if self.logic.parameters.lesions is None:
            return False, "Choose a segmentation with segments called tumour, oedema, ..."
        return True, ""

    def canOpenCraniotomy(self) -> tuple[bool, str]:
        """(whether skin and skull can be opened, the reason if not)"""
        can, why_not = self.canSimulate()
        if not can:
            return can, why_not
        if self.logic.parameters.opening is None and self.logic.parameters.probe_transform is None:
            return False, "Place the probe over the brain, or choose an opening"
        return True, ""

    def canCloseCraniotomy(self) -> tuple[bool, str]:
        """(whether there are labels before the opening, the reason if not)"""
        labels: Any = self.logic.parameters.labels
        if self._busy:
            return False, _BUSY
        if labels is None or self.logic.closedLabels(labels) is labels:
            return False, "These labels have no opening, or those before it are gone"
        return True, ""

    def segment(self) -> None:
        """Segment the MRI into the chosen label map or segmentation, or into a new node (see _replaceable)."""
        parameters = self.logic.parameters
        with self.shown(), self.working("Segment") as progress:
            mri = required(parameters.mri, "no MRI chosen, expected a scalar volume")
            if self._notes_of not in (None, mri.GetID()):  # also if this fails: they are about another patient
                self.setNotes()
            nodes, notes, settings = self._chosen_by_segment(), tuple(self._notes), parameters.segmentation
            told = self._forget_other_brain(mri) + self._closed_again()
            before = _BeforeSegment(self._labels_before(), nodes, _data_of(parameters.sheets), notes)
            others, untold = self._second_mri()
            kinds = parameters.sheet.kinds if parameters.sheet.find else ()
            own_sheets = parameters.sheets if kinds and self._are_own_sheets() else None
            with (
                self._made(own_sheets, "Model", f"{mri.GetName()} sheets", wanted=bool(kinds)) as sheets,
                self._replaceable(f"{mri.GetName()} tissues", mri) as labels,
            ):
                result = self.logic.segment(
                    mri, labels, settings, mask_node=parameters.mask, others=others, organs_node=parameters.organs,
                    lesions_node=parameters.lesions, sheets=kinds, sheets_node=sheets,
                    keep_mask_at=self.maskFile(mri), keep_sheets_at=self.sheetsFile(mri), progress=progress,
                )  # fmt: skip
            told += self._take_sheets(sheets)
            self._notes_of, self._checks = mri.GetID(), _checks(result.warnings)
            if (
                parameters.mask is None
                and isinstance(result, Segmentation)  # and not of a CT
                and result.brain.method not in ("stripped", "none")
            ):
                parameters.mask = brain = self.logic.writeBrain(result, mri)
                told.append(f"the brain mask is {brain.GetName()!r}, which Segment uses from now on; edit it as needed")
            self._notes += [*told, *untold]
            content = content_as_made(labels)
            self._last_segment = _LastSegment(before, labels, content, self._chosen_by_segment(), settings)
            self._made_by[content] = settings
        self.view.refresh()

    def _chosen_by_segment(self) -> dict[str, Any]:
        """{role: chosen node} of the nodes that Segment chooses."""
        return {role: getattr(self.logic.parameters, role) for role in ("labels", "mask", "sheets")}

    def canUndoSegment(self) -> tuple[bool, str]:
        """(whether the last Segment can be undone, the reason if not)"""
        last, chosen = self._last_segment, self.logic.parameters.labels
        if self._busy:
            return False, _BUSY
        if last is None:
            return False, "Nothing was segmented since the scene was opened"
        if last.labels.GetScene() is None:
            return False, "The tissues of the last Segment were removed from the scene"
        name = repr(last.labels.GetName())
        if chosen is not None and chosen is not last.labels and self.logic.closedLabels(chosen) is last.labels:
            return False, f"The skull was opened in {name} after Segment; close it first"
        if content_as_made(last.labels) != last.content:
            return False, f"{name} was changed after Segment, as by lesions laid over it, and is kept"
        if not self.logic.mayReplace(last.labels):
            return False, f"{name} was edited after Segment, and is kept"
        return True, ""

    def undoSegment(self) -> None:
        """Go back to the tissues, mask, sheets, settings and notes from before the last Segment.

        What the user chose or set since then stays, whatever it is; only the node into which Segment wrote is changed,
        or removed if Segment made it.
        """
        parameters = self.logic.parameters
        with self.shown():
            can, why_not = self.canUndoSegment()
            require(can, why_not)
            last = required(self._last_segment, why_not)
            before, self._last_segment = last.before, None
            are_its_notes = self._labels_said == last.labels.GetID()
            before.labels.restore()
            for role, node in before.nodes.items():
                if getattr(parameters, role) is last.nodes[role]:
                    setattr(parameters, role, None if node is None or node.GetScene() is None else node)
            sheets: Any = before.nodes["sheets"]
            if (
                before.sheets is not None
                and sheets.GetScene() is not None
                and sheets.GetPolyData() is not before.sheets
                and self.logic.mayReplaceResult(sheets)
            ):
                sheets.SetAndObservePolyData(before.sheets)
                mark_as_result(sheets, SHEETS)
            if last.labels is not before.labels.node:
                self.logic.scene.RemoveNode(last.labels)
            if are_its_notes:
                self._notes, self._notes_of, self._checks = list(before.notes), None, []
                self._labels_said = None if parameters.labels is None else parameters.labels.GetID()
            self._notes += self._settings_undone(last)
        self.view.refresh()

    def _settings_undone(self, last: _LastSegment) -> list[str]:
        """Go back to the settings by which the tissues before `last` were made; a line about it if they stay."""
        parameters, before = self.logic.parameters, last.before
        labels: Any = parameters.labels
        if labels is None or labels is not before.nodes["labels"]:
            return []
        known = self._made_by.get(content_as_made(labels))
        if known == parameters.segmentation:
            return []
        if known is not None and parameters.segmentation == last.settings:
            parameters.segmentation = known
            return []
        why = "they were changed after it" if known is not None else "those of these tissues are not known"
        return [f"Undo left the settings of Segment as they are, since {why}"]

    def _labels_before(self) -> LabelsBefore:
        labels: Any = self.logic.parameters.labels
        replaced = labels if labels is not None and self.logic.mayReplace(labels) else None
        return LabelsBefore(replaced, self._preset().tissues)

    def _are_own_sheets(self) -> bool:
        """Whether the chosen sheets are of Segment, and not those that a user loaded."""
        chosen = self.logic.parameters.sheets
        return chosen is not None and self.logic.mayReplaceResult(chosen)

    def _take_sheets(self, found: Any) -> list[str]:
        """Choose the sheets that Segment found, or none in place of those of an earlier Segment; a line about it."""
        parameters = self.logic.parameters
        before: Any = parameters.sheets
        if found is not None:
            parameters.sheets = found
            lines = [f"images show the sheets in {found.GetName()!r}"]
            if before not in (None, found):
                lines.append(f"{before.GetName()!r} was loaded by others and is kept, but not shown any more")
            return lines
        if before is None:
            return []
        if self._are_own_sheets():
            parameters.sheets = None
            return [f"the sheets in {before.GetName()!r}, of an earlier Segment, are not shown any more"]
        return [f"images show the sheets in {before.GetName()!r}"]

    def _forget_other_brain(self, mri: Any) -> list[str]:
        """Deselect the mask that Segment extracted from another MRI; a line about it."""
        parameters = self.logic.parameters
        mask: Any = parameters.mask
        if self.logic.brainOf(mask) in (None, mri.GetID()):
            return []
        parameters.mask = None
        return [f"{mask.GetName()!r} is the mask of another MRI and was not used"]

    def _closed_again(self) -> list[str]:
        """Choose the labels before the opening, into which Segment writes; a line about it."""
        chosen: Any = self.logic.parameters.labels
        if chosen is None or self.logic.closedLabels(chosen) is chosen:
            return []
        closed = self.logic.closedLabels(chosen)
        self.logic.hideOpening(chosen)
        self.logic.parameters.labels = closed
        return [f"the skull is closed again; {chosen.GetName()!r} still has the opening in the tissues before"]

    def _second_mri(self) -> tuple[dict[str, Any], list[str]]:
        """({contrast: node}, lines about it)"""
        parameters = self.logic.parameters
        node, contrast = parameters.second_mri, parameters.panel.second_contrast
        if node is None or contrast == "none":
            return {}, [] if node is None else ["the second MRI was not used: choose its contrast"]
        require(node is not parameters.mri, f"first and second MRI are both {node.GetName()!r}, expected two volumes")
        return {contrast: node}, []

    def addTissues(self) -> None:
        """Lay the lesions over the chosen tissues, or over a copy of them in a new node (see _replaceable)."""
        with self.shown():
            self.layLesions()
        self.view.refresh()

    def layLesions(self) -> None:
        """As addTissues, but raises errors."""
        parameters = self.logic.parameters
        with self.working("Add to tissues"):
            require(parameters.labels is not None, "no label map chosen; segment the MRI first")
            before: Any = parameters.labels
            if self._labels_said != before.GetID():
                self._checks = []
            with self._replaceable(f"{before.GetName()} with lesions", before) as labels:
                self.logic.addTissues(before, parameters.lesions, labels)
            self._notes += self._checks

    # ---- lesions that are proposed -----------------------------------------------------------------------------

    def canPropose(self) -> tuple[bool, str]:
        """(whether lesions can be proposed on the MRI, the reason if not)"""
        can, why_not = self.canSegment()
        if not can:
            return can, why_not
        if not self.logic.proposals.knows(self.logic.parameters.mri):
            return False, "Segment this MRI first"
        return True, ""

    def canProposeAtPoint(self) -> tuple[bool, str]:
        """(whether a lesion can be proposed at the point, the reason if not)"""
        can, why_not = self.canPropose()
        if can and self.logic.parameters.seed is None:
            return False, "Choose a point in the lesion"
        return can, why_not

    def canAccept(self) -> tuple[bool, str]:
        """(whether there is a proposal to accept or discard, the reason if not)"""
        if self._busy:
            return False, _BUSY
        if self.logic.parameters.proposal is None:
            return False, "There is no proposal"
        return True, ""

    def pickSeed(self) -> None:
        """Let the user show a point in the lesion in a view; then propose the lesion there."""
        parameters = self.logic.parameters
        with self.shown():
            require(parameters.mri is not None, "no MRI chosen, expected the one with the lesion")
            require(self.logic.proposals.knows(parameters.mri), "segment this MRI first")
            if parameters.seed is None:
                parameters.seed = self._add("MarkupsFiducial", "Lesion")
            self.view.pickPoint(parameters.seed, self.proposeAtPoint)
        self.view.refresh()

    def proposeAtPoint(self) -> None:
        """Propose the lesion around the last point of the chosen markups; nothing else is changed."""
        parameters = self.logic.parameters
        with self.shown(), self.working("Propose lesion"):
            tissue = None if parameters.panel.lesion_as == BY_LOOK else parameters.panel.lesion_as
            seed = required(parameters.seed, "no point chosen, expected one in the lesion")
            self._show_proposal(self.logic.proposals.growFrom(parameters.mri, seed, tissue))
        self.view.refresh()

    def proposeLesions(self) -> None:
        """Propose what looks like lesions in the MRI, without a point; nothing else is changed."""
        with self.shown(), self.working("Propose lesions"):
            self._show_proposal(self.logic.proposals.propose(self.logic.parameters.mri))
        self.view.refresh()

    def _show_proposal(self, node: Any) -> None:
        """Choose a proposal, or none, and say what it is."""
        proposals = self.logic.proposals
        self.logic.parameters.proposal = node
        if node is not None and display_of(node) is not None:
            display_of(node).SetVisibility(True)
        self._forget_proposal()
        self._notes += [f"{_PROPOSED}{line}" for line in (*proposals.notes, *_checks(proposals.warnings))]
        if node is not None:
            self._notes.append(
                f"{_PROPOSED}look at {node.GetName()!r} over the MRI, correct it, and accept or discard it"
            )

    def _forget_proposal(self) -> None:
        self._notes = [line for line in self._notes if not line.startswith(_PROPOSED)]

    def acceptProposal(self) -> None:
        """Move what is proposed, as it was corrected, to the lesions, and lay these over the tissues."""
        with self.shown():
            self.takeProposal()
        self.view.refresh()

    def takeProposal(self) -> None:
        """As acceptProposal, but raises errors."""
        parameters = self.logic.parameters
        proposal: Any = required(parameters.proposal, "there is no proposal")
        with self._made(parameters.lesions, "Segmentation", "Lesions") as lesions:
            self.logic.proposals.confirm(proposal, lesions)
        parameters.lesions, parameters.proposal = lesions, None
        self._forget_proposal()
        if parameters.labels is not None:
            self.layLesions()

    def discardProposal(self) -> None:
        """Remove a proposal; nothing else is changed."""
        parameters = self.logic.parameters
        with self.shown():
            proposal = required(parameters.proposal, "there is no proposal")
            parameters.proposal = None
            self.logic.scene.RemoveNode(proposal)
            self._forget_proposal()
        self.view.refresh()

    # ---- craniotomy --------------------------------------------------------------------------------------------

    def openCraniotomy(self) -> None:
        """Open skin and skull under the probe, or where the chosen node says, in labels of their own.

        Labels that were opened are opened anew, from those before: an opening follows the probe when it is moved.
        """
        parameters = self.logic.parameters
        with self.shown(), self.working("Open skull"):
            chosen: Any = required(parameters.labels, "no label map chosen; segment the MRI first")
            closed = self.logic.closedLabels(chosen)
            again = chosen if closed is not chosen and self.logic.mayReplace(chosen) else None
            kind = "Segmentation" if closed.IsA("vtkMRMLSegmentationNode") else "LabelMapVolume"
            with self._made(again, kind, f"{closed.GetName()} with craniotomy") as node:
                self.logic.openCraniotomy(
                    chosen, node, probe_transform_node=parameters.probe_transform, opening_node=parameters.opening,
                    diameter_mm=parameters.panel.craniotomy_mm,
                )  # fmt: skip
            parameters.labels = node
            kept = [line for line in self._notes if not line.startswith((_OPENED, _PLACED))]
            self._notes, self._labels_said = [*kept, *self.logic.notes], node.GetID()
            self._notes += _checks(self.logic.warnings)
        self.view.refresh()

    def closeCraniotomy(self) -> None:
        """Choose the labels without the opening again."""
        parameters = self.logic.parameters
        with self.shown():
            chosen: Any = required(parameters.labels, "no label map chosen; segment the MRI first")
            closed = self.logic.closedLabels(chosen)
            require(closed is not chosen, f"{chosen.GetName()!r} has no opening, or the labels before it are gone")
            self.logic.hideOpening(chosen)
            parameters.labels = closed
            self._notes = [line for line in self._notes if not line.startswith((_OPENED, _PLACED))]
            self._labels_said = closed.GetID()
        self.view.refresh()

    def notes(self) -> str:
        """What the last segmentation or addition did, and what a user should check, in lines."""
        self._probe_said = self._about_probe()
        return "\n".join([*self._notes, *self._gel(), *self._probe_said])

    @property
    def noteLines(self) -> tuple[str, ...]:
        """The same without what follows from the present choices, for setNotes."""
        return tuple(self._notes)

    def addNotes(self, *lines: str) -> None:
        """Add lines to them."""
        self._notes += lines

    def _gel(self) -> list[str]:
        """A line about gel on the skin, if the chosen tissues have it by default."""
        labels = self.logic.parameters.labels
        try:
            is_there = labels is not None and self.logic.settings(labels) != self._preset().settings
        except SimulationError:  # an empty node, or unknown names: the error is shown by simulate()
            return []
        return [f"gel fills gaps of up to {GEL_MM:g} mm between skin and probe (Gel on the skin)"] if is_there else []

    def _about_probe(self) -> tuple[str, ...]:
        """Lines about the probe where it is now: its contact with the patient, and bone before it."""
        parameters = self.logic.parameters
        labels, probe = parameters.labels, parameters.probe_transform
        if labels is None or probe is None:
            return ()
        try:
            return (*self.logic.aboutContact(labels, probe), *self.logic.aboutBone(labels, probe))
        except SimulationError:  # as in _gel, or a probe that scales: the error is shown by simulate()
            return ()

    def forgetPatient(self) -> None:
        """Release what is kept in memory of the last patient, with notes and fit; nodes stay."""
        self.logic.forgetPatient()
        self.view.showStatus("")
        self.fits.forget()
        self._last_segment, self._made_by = None, {}
        self.setNotes()

    def setNotes(self, *lines: str) -> None:
        """Replace them by lines about another patient, whose labels are chosen; by none, to forget them."""
        labels: Any = self.logic.parameters.labels
        self._notes, self._notes_of = list(lines), None
        self._checks = [line for line in lines if line.startswith(_CHECK)]
        self._labels_said = None if labels is None else labels.GetID()

    def placeProbe(self) -> None:
        """Place the probe on the surface in the slice view, or at a craniotomy; create its transform if needed."""
        with self.shown():
            require(self.logic.parameters.labels is not None, "no label map chosen, expected one to put the probe on")
            self._say_placed(_PLACED, self._put_probe(self.view.sliceNode()))
        self.view.refresh()

    def placeAtView(self) -> None:
        """Place the probe where the chosen standard view is seen from; create its transform if needed."""
        with self.shown():
            require(self.logic.parameters.labels is not None, "no label map chosen, expected one to put the probe on")
            self._say_placed(_VIEW, self._put_probe(view=self.logic.parameters.panel.view))
        self.view.refresh()

    def _say_placed(self, what: str, line: str) -> None:
        """Replace the line of the notes about where the probe was placed."""
        self._notes = [known for known in self._notes if not known.startswith((_VIEW, _PLACED))]
        self._notes += [f"{what}{line}"] if line else []

    def simulate(self) -> None:
        """Simulate one image, into the chosen volume or a new one."""
        with self.shown():
            nodes = self._nodes()
            start = perf_counter()
            caught: list[Warning] = []
            self.logic.simulate(nodes.labels, nodes.probe_transform, nodes.output, warned=caught.append)
            self._say_labels(nodes.labels)
            self.view.showStatus("; ".join(map(str, caught)) or f"{(perf_counter() - start) * 1e3:.0f} ms")
            self.logic.showOutline(nodes.outline, nodes.probe_transform)
            if self.view.sliceNode() is not None:
                self.logic.showInSlice(self.view.sliceNode(), nodes.output, nodes.probe_transform)
            if not self.logic.isLive:
                self.logic.holdImage(nodes.output)
        self.view.refresh()

    def showFrozen(self, record: FrozenRecord) -> None:
        """Show the image of a scene that was saved, which stays where it was taken."""
        with self.shown():
            self.logic.showFrozen(record, self._nodes().output)
            self._stopped()

    def _say_labels(self, labels: Any) -> None:
        """Replace the notes by what labels were recognised as, if they are about others."""
        if self._labels_said != labels.GetID():
            message, warnings = self.logic.recognised()
            self.setNotes(f"{labels.GetName()}: {message}", *_checks(warnings))

    def isLive(self) -> bool:
        return self.logic.isLive

    def setLive(self, on: bool) -> None:
        """Start or stop live update."""
        if on == self.logic.isLive:
            return
        if not on:
            self.logic.stopLiveUpdate()
            return
        with self.shown():
            self._nodes()
            self._last_image = None
            self._followed = self._live_nodes()
            self.logic.startLiveUpdate(
                *self._followed,
                schedule=self.view.schedule,
                report=self._reported,
                stopped=self._stopped,
            )
            self._say_labels(self.logic.parameters.labels)
        self.view.refresh()

    def simulateSequence(self) -> None:
        """Simulate an image for each transform of the chosen sequence; its sequence browser plays both."""
        parameters = self.logic.parameters
        transforms_node: Any = parameters.transform_sequence
        images_node: Any = parameters.image_sequence
        with self.shown(), self.working("Simulate sequence") as progress:
            require(transforms_node is not None, "no sequence of transforms chosen, expected a Sequence node")
            if images_node is not None and images_node.GetNodeReferenceID(MADE_FROM) not in (
                None, transforms_node.GetID()
            ):  # fmt: skip
                images_node = None  # those of other transforms stay
            with self._made(images_node, "Sequence", f"{transforms_node.GetName()} ultrasound") as images:
                count = self.logic.simulateSequence(
                    parameters.labels,
                    transforms_node,
                    images,
                    browser_node=self._browser_of(transforms_node),
                    progress=progress,
                )
            images.SetNodeReferenceID(MADE_FROM, transforms_node.GetID())
            parameters.image_sequence = images  # in place of which the next ones come
            self.view.showStatus(f"{count} images in {images.GetName()!r}")
        self.view.refresh()

    def chooseDefaultNodes(self) -> None:
        """Select the first volume of the scene as the MRI, if none is selected."""
        parameters = self.logic.parameters
        if parameters.mri is not None:
            return
        for node in nodes_of_class(self.logic.scene, "vtkMRMLScalarVolumeNode"):
            if fits("mri", node) and node not in (parameters.output, parameters.real):
                parameters.mri = node
                return

    def parametersChanged(self) -> None:
        """Update the view and the nodes of live update after a change of the scene's parameters or slice view."""
        if self.logic.isLive and self._live_nodes() != self._followed:
            self.logic.stopLiveUpdate()
            self.setLive(True)
        self.view.refresh()

    # ---- helpers -----------------------------------------------------------------------------------------------

    def _preset(self) -> Preset:
        try:
            return self.logic.preset
        except SimulationError:  # an invalid preset in the scene: the error is shown by simulate()
            return Preset()

    def tissueTable(self) -> TissueTable:
        """The tissues of the chosen labels, or of the preset."""
        labels = self.logic.parameters.labels
        try:
            return self.logic.tissues(labels) if labels is not None else self._preset().tissues
        except SimulationError:  # an empty node, or unknown names: the error is shown by simulate()
            return self._preset().tissues

    def _change_tissue(self, name: str, change: Callable[[Tissue], Tissue]) -> None:
        """Change a tissue of the table in use; it is added to the preset if missing there."""
        preset, used = self._preset(), self.tissueTable()
        old = required(
            next((tissue for tissue in used.all_tissues() if same_name(tissue.name, name)), None),
            f"no tissue is called {name!r}, expected one of {', '.join(used.names())}",
        )
        self.logic.preset = replace(preset, tissues=preset.tissues.with_tissue(change(old)))

    def _nodes(self):
        """The parameters, with the nodes that simulation needs; nodes that are not selected are created."""
        parameters = self.logic.parameters
        require(parameters.labels is not None, "no label map chosen; segment the MRI first")
        if parameters.probe_transform is None:
            self._put_probe()
        parameters.output = self._own(parameters.output, "ScalarVolume", "Ultrasound")
        parameters.outline = self._own(parameters.outline, "Model", "Ultrasound outline")
        return parameters

    def _own(self, chosen: Any, kind: str, name: str):
        """The chosen node, or a new one if none is chosen or it has data of others, which the notes say."""
        if chosen is not None and self.logic.mayReplaceResult(chosen):
            return chosen
        node = self._add(kind, name)
        if chosen is not None:
            self._notes.append(f"{chosen.GetName()!r} has data of others and is kept; the result is {node.GetName()!r}")
        return node

    def _put_probe(self, slice_node=None, view: str | None = None) -> str:
        """Place the probe's transform, or a new one if none is selected; a line about it, as placeProbe returns."""
        parameters = self.logic.parameters
        with self._made(parameters.probe_transform, "LinearTransform", "Probe") as probe:
            line = self.logic.placeProbe(parameters.labels, probe, slice_node, view=view)
        parameters.probe_transform = probe
        display = display_of(probe)
        if display is not None:
            display.SetEditorVisibility(self._handles)
        return line

    def _live_nodes(self) -> tuple:
        nodes = self.logic.parameters
        return nodes.labels, nodes.probe_transform, nodes.output, nodes.outline, self.view.sliceNode()

    def _browser_of(self, sequence_node):
        browsers = nodes_of_class(self.logic.scene, "vtkMRMLSequenceBrowserNode")
        return next((node for node in browsers if node.IsSynchronizedSequenceNode(sequence_node, True)), None)

    def _add(self, kind: str, name: str):
        return self.logic.scene.AddNewNodeByClass(f"vtkMRML{kind}Node", self.logic.scene.GenerateUniqueName(name))

    @contextmanager
    def _replaceable(self, name: str, source: Any) -> Iterator[Any]:
        """The chosen labels if Segment made them and nobody has edited them; otherwise a new node, which is selected.

        Afterwards the notes are those of the logic, about the node `source`.
        """
        chosen: Any = self.logic.parameters.labels
        kept = None if chosen is None or self.logic.mayReplace(chosen) else str(chosen.GetName())
        kind = "LabelMapVolume" if self._label_maps else "Segmentation"
        with self._made(chosen if kept is None else None, kind, name) as node:
            yield node
        self.logic.parameters.labels = node
        self._notes, self._labels_said = [f"{source.GetName()}:", *self.logic.notes], node.GetID()
        self._notes += _checks(self.logic.warnings)
        if kept is not None:
            self._notes.append(
                f"{kept!r} was not made by Segment, or edited since, and is kept; the result is {node.GetName()!r}"
            )

    @contextmanager
    def _made(self, node: Any, kind: str, name: str, *, wanted: bool = True) -> Iterator[Any]:
        """`node`, or a new one, which is removed if an exception is raised; None if none is wanted."""
        made = node is None and wanted
        if made:
            node = self._add(kind, name)
        try:
            yield node
        except BaseException:
            if made:
                self.logic.scene.RemoveNode(node)
            raise

    def _reported(self, message: str) -> None:
        now = perf_counter()
        if message:
            self.view.showStatus(message)
        elif self._last_image is not None and now - self._last_image < 1.0:
            self.view.showStatus(f"{1.0 / max(now - self._last_image, 1e-3):.0f} images per second")
        else:
            self.view.showStatus("")
        self._last_image = now
        before, self._probe_said = self._probe_said, self._about_probe()
        if self._probe_said != before:  # the probe has moved over bone or an opening, or off the patient
            self.view.refresh()

    def _stopped(self) -> None:
        taken = self.logic.taken
        self.view.showStatus("" if taken is None else f"{FROZEN}: {taken.patient}, {taken.time[11:19]} UTC")
        self.view.refresh()

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Show errors caused by the user in one line, then refresh the view."""
        try:
            yield
        except Exception as error:
            message = user_message(error)
            if message is None:
                raise
            if not isinstance(error, Cancelled):
                self.view.showError(message)
            self.view.refresh()

    @contextmanager
    def working(self, title: str) -> Iterator[Callable[[float], None]]:
        require(not self._busy, "wait until the work under way is done")
        self._busy = True
        self.view.refresh()
        try:
            with self.view.progress(title) as progress:
                yield progress
        finally:
            self._busy = False


def _data_of(model_node: Any) -> Any:
    return None if model_node is None else model_node.GetPolyData()


def _checks(warnings: Iterable[str]) -> list[str]:
    return [f"{_CHECK}{warning}" for warning in warnings]


def _without(tissue: Tissue, parameter: str) -> dict[str, str]:
    """The sources of all parameters except `parameter`."""
    return {name: source for name, source in tissue.sources.items() if name != parameter}
