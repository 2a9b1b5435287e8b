"""ApproachPresenter: candidates for the approach to a lesion, and the opening of the skull at one, without Qt."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from SlicerUSSim.Logic.base.errors import require, required
from SlicerUSSim.Logic.imaging.approach_images import outlined
from SlicerUSSim.Logic.imaging.figures import png_url
from SlicerUSSim.Logic.mrml.approach_logic import ring
from SlicerUSSim.Logic.mrml.nodes import control_points
from SlicerUSSim.Logic.mrml.parameter_node import LARGEST, POINT
from SlicerUSSim.Logic.placement.approach import Approach, Candidate
from SlicerUSSim.Logic.placement.approach_weights import NO_ADVICE
from SlicerUSSim.Widget.interface import PanelHost, tr as _
from SlicerUSSim.Widget.placement_presenter import PlacementPresenter

#: Candidates that a panel has room for
CANDIDATES = 3


class ApproachPresenter:
    """Plans the approach to the chosen target, shows the candidates, and opens the skull at one."""

    def __init__(self, panel: PanelHost, placing: PlacementPresenter) -> None:
        self._panel, self._placing = panel, placing
        self.forget()

    def forget(self) -> None:
        """Forget the plan, which is of another patient."""
        self._plan: Approach | None = None
        self._labels: Any = None  # of the plan: those of the closed head
        self._pictures: list[str] = []
        self._chosen = 0

    @property
    def found(self) -> Approach | None:
        """The plan for the labels that are chosen; None without one."""
        labels: Any = self._panel.parameters.labels
        is_here = labels is not None and self._panel.logic.closedLabels(labels) is self._labels
        return self._plan if is_here else None

    def plan(self) -> None:
        """Plan the approach to the target that is chosen; let the user show it in a view, if that is a point."""
        panel, parameters = self._panel, self._panel.parameters
        if parameters.panel.target != POINT:
            self.planNow()
            return
        with panel.acting():
            if parameters.seed is None:
                parameters.seed = panel.add("MarkupsFiducial", "Target")
            panel.view.pickPoint(parameters.seed, self.planNow)

    def planNow(self) -> None:
        """The same, of a point the last one of the chosen markups."""
        panel, parameters = self._panel, self._panel.parameters
        with panel.acting(), panel.working(_("Plan approach")) as progress:
            labels: Any = required(parameters.labels, "no label map chosen; segment the MRI first")
            wanted = parameters.panel.target
            what = None if wanted == LARGEST else wanted
            if wanted == POINT:
                points = control_points(required(parameters.seed, "no point chosen, expected one in the lesion"))
                require(len(points) > 0, "the chosen markups have no point, expected one in the lesion")
                what = points[-1]
            progress(0.1)
            plan = panel.logic.planApproach(labels, what)
            self._plan, self._labels = plan, panel.logic.closedLabels(labels)
            probe = panel.preset.probe
            self._pictures = [png_url(outlined(candidate, plan.target, probe)) for candidate in plan.candidates]
            self._choose(0)

    def choose(self, number: int) -> None:
        """Show way and opening of candidate 0, 1, ... in the views."""
        with self._panel.acting():
            self._choose(number)

    def _choose(self, number: int) -> None:
        plan = required(self.found, "no approach is planned, press Plan first")
        self._chosen = number
        self._panel.logic.showApproach(plan, plan.candidates[number])

    def picture(self, number: int) -> str:
        """The image of a candidate as a data URL; "" without one."""
        return self._pictures[number] if self.found is not None and number < len(self._pictures) else ""

    def text(self) -> str:
        """The target, what is known of the chosen candidate, and that it is no advice; "" without a plan."""
        plan = self.found
        if plan is None:
            return ""
        chosen = _("Candidate {number}: {text}").format(number=self._chosen + 1, text=self._candidate(plan).text)
        return "\n".join((plan.target.text, chosen, _(NO_ADVICE)))

    def _candidate(self, plan: Approach) -> Candidate:
        return plan.candidates[min(self._chosen, len(plan.candidates) - 1)]

    def canChoose(self, number: int) -> tuple[bool, str]:
        """(whether there is this candidate, the reason if not)"""
        return self._panel.ready((bool(self.picture(number)), _("Plan an approach first")))

    def openHere(self) -> None:
        """Place and aim the probe as the chosen candidate says, and open the skull there if there is one."""
        panel, parameters = self._panel, self._panel.parameters
        with panel.acting():
            candidate = self._candidate(required(self.found, "no approach is planned, press Plan first"))
            self._placing.putAt(candidate.probe_to_ras)
            if not candidate.opening_mm:
                return
            parameters.opening = None
            parameters.panel = replace(parameters.panel, craniotomy_mm=round(candidate.opening_mm, 1))
        self._placing.openCraniotomy()

    def drawOpening(self) -> None:
        """Choose a closed curve around the opening of the candidate as the opening, whose points can be moved."""
        panel, parameters = self._panel, self._panel.parameters
        with panel.acting():
            candidate = self._candidate(required(self.found, "no approach is planned, press Plan first"))
            require(candidate.opening_mm, "no skull is labelled, so that there is nothing to open")
            curve: Any = panel.add("MarkupsClosedCurve", "Opening")
            for point in ring(candidate).tolist():
                curve.AddControlPointWorld(*point)
            parameters.opening = curve
