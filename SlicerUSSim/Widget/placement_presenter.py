"""PlacementPresenter: placement of the probe on the patient, and the opening of the skull under it, without Qt."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import require, required
from SlicerUSSim.Logic.mrml.nodes import display_of, set_node_to_world
from SlicerUSSim.Widget.interface import PanelHost, tr as _
from SlicerUSSim.Widget.notes import OPENED, PLACED, VIEW, Notes, checks
from SlicerUSSim.Widget.tracked_presenter import FACE


class PlacementPresenter:
    """Places the probe, and opens and closes the skull.

    Parameters
    ----------
    handles : whether a placed probe has Slicer's interaction handles for translation and rotation.
    """

    def __init__(self, panel: PanelHost, notes: Notes, handles: bool) -> None:
        self._panel, self._notes, self.handles = panel, notes, handles

    def placeProbe(self) -> None:
        """Place the probe on the surface in the slice view, or at a craniotomy; create its transform if needed."""
        with self._panel.acting():
            self._place(PLACED, slice_node=self._panel.view.sliceNode())

    def placeAtView(self) -> None:
        """Place the probe where the chosen standard view is seen from; create its transform if needed."""
        with self._panel.acting():
            self._place(VIEW, view=self._panel.parameters.panel.view)

    def _place(self, what: str, **where: Any) -> None:
        require(self._panel.parameters.labels is not None, "no label map chosen, expected one to put the probe on")
        line = self.put(**where)
        self._notes.drop(VIEW, PLACED)
        self._notes.add(*[f"{what}{line}"] if line else [])

    def put(self, **where: Any) -> str:
        """Place the probe's transform, or a new one if none is selected; a line about where, or "".

        See UltrasoundSceneLogic.placeProbe for `where`.
        """
        labels, logic = self._panel.parameters.labels, self._panel.logic
        return self._moved(lambda probe: logic.placeProbe(labels, probe, **where))

    def putAt(self, probe_to_world: np.ndarray) -> None:
        """Move the probe's transform, or a new one if none is selected, to a pose (4, 4)."""
        self._moved(lambda probe: set_node_to_world(probe, probe_to_world))

    def _moved(self, move: Callable[[Any], Any]) -> Any:
        parameters = self._panel.parameters
        chosen: Any = parameters.probe_transform
        is_moved = chosen is not None and chosen.GetName() == FACE
        require(not is_moved, "the tracker moves the probe; choose another probe transform, or none, to place it")
        with self._panel.made(chosen, "LinearTransform", "Probe") as probe:
            line = move(probe)
        parameters.probe_transform = probe
        display = display_of(probe)
        if display is not None:
            display.SetEditorVisibility(self.handles)
        return line

    # ---- craniotomy --------------------------------------------------------------------------------------------

    def canOpenCraniotomy(self) -> tuple[bool, str]:
        """(whether skin and skull can be opened, the reason if not)"""
        can, why_not = self._panel.canSimulate()
        parameters = self._panel.parameters
        if can and parameters.opening is None and parameters.probe_transform is None:
            return False, _("Place the probe over the brain, or choose an opening")
        return can, why_not

    def canCloseCraniotomy(self) -> tuple[bool, str]:
        """(whether there are labels before the opening, the reason if not)"""
        labels: Any = self._panel.parameters.labels
        is_open = labels is not None and self._panel.logic.closedLabels(labels) is not labels
        return self._panel.ready((is_open, _("These labels have no opening, or the previous labels were removed")))

    def openCraniotomy(self) -> None:
        """Open skin and skull under the probe, or where the chosen node says, in separate labels.

        Opened labels are opened again from the closed ones: an opening follows the probe when it is moved.
        """
        panel, logic, parameters = self._panel, self._panel.logic, self._panel.parameters
        with panel.acting(), panel.working(_("Open skull")):
            chosen: Any = required(parameters.labels, "no label map chosen; segment the MRI first")
            closed = logic.closedLabels(chosen)
            again = chosen if closed is not chosen and logic.mayReplace(chosen) else None
            kind = "Segmentation" if closed.IsA("vtkMRMLSegmentationNode") else "LabelMapVolume"
            with panel.made(again, kind, f"{closed.GetName()} with craniotomy") as node:
                logic.openCraniotomy(
                    chosen, node, probe_transform_node=parameters.probe_transform, opening_node=parameters.opening,
                    diameter_mm=parameters.panel.craniotomy_mm,
                )  # fmt: skip
            self._choose(node)
            self._notes.add(*logic.notes, *(f"{OPENED}{line}" for line in checks(logic.warnings)))

    def closeCraniotomy(self) -> None:
        """Choose the labels without the opening again."""
        logic = self._panel.logic
        with self._panel.acting():
            chosen: Any = required(self._panel.parameters.labels, "no label map chosen; segment the MRI first")
            closed = logic.closedLabels(chosen)
            require(closed is not chosen, f"{chosen.GetName()!r} has no opening, or the previous labels were removed")
            logic.hideOpening(chosen)
            self._choose(closed)

    def _choose(self, labels: Any) -> None:
        self._notes.drop(OPENED, PLACED)
        self._notes.areAbout(labels)  # before live images begin anew, which recognise what the notes are not about
        self._panel.parameters.labels = labels
