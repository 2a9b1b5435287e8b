"""ApproachPresenter: candidates for the approach to a lesion, and the opening of the skull at one, without Qt."""

from __future__ import annotations

from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import required
from SlicerUSSim.Logic.imaging.figures import png_url
from SlicerUSSim.Logic.mrml.nodes import Observed, control_points, probe_pose, set_node_to_world
from SlicerUSSim.Logic.mrml.parameter_node import LARGEST, POINT
from SlicerUSSim.Logic.placement.approach import Approach
from SlicerUSSim.Logic.placement.approach_weights import NO_ADVICE
from SlicerUSSim.Widget.interface import PanelHost, tr as _
from SlicerUSSim.Widget.placement_presenter import PlacementPresenter
from SlicerUSSim.Widget.tracked_presenter import FACE


class ApproachPresenter:
    """Plans the approach to the chosen target, shows the candidates, and opens the skull at one."""

    def __init__(self, panel: PanelHost, placing: PlacementPresenter) -> None:
        self._panel, self._placing = panel, placing
        #: The probe that is chosen, which the user may want to be kept in the opening
        self.probe = Observed("TransformModifiedEvent", self._keep)
        self.forget()

    def forget(self) -> None:
        """Forget the plan, which was for another patient."""
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
            return self._plan_now()
        with panel.acting():
            if parameters.seed is None:
                parameters.seed = panel.add("MarkupsFiducial", "Target")
            panel.view.pickPoint(parameters.seed, self._plan_now)

    def _plan_now(self) -> None:
        panel, parameters = self._panel, self._panel.parameters
        with panel.acting(), panel.working(_("Plan approach")) as progress:
            labels, what = parameters.labels, parameters.panel.target
            if what in (LARGEST, POINT):
                what = None if what == LARGEST else control_points(parameters.seed)[-1]
            progress(0.1)
            self._plan = plan = panel.logic.planApproach(labels, what)
            self._labels = panel.logic.closedLabels(labels)
            self._pictures = [png_url(candidate.pictures[0]) for candidate in plan.candidates]
            self.choose(0)

    def choose(self, number: int) -> None:
        """Show path and opening of candidate 0, 1, ... in the views; what Open skull opens is then that opening."""
        with self._panel.acting():
            plan = required(self.found, "no approach is planned, press Plan first")
            self._chosen = number
            self._panel.parameters.opening = self._panel.logic.showApproach(plan, plan.candidates[number])

    def picture(self, number: int) -> str:
        """The image of a candidate as a data URL; "" without one."""
        return self._pictures[number] if self.found is not None and number < len(self._pictures) else ""

    def text(self) -> str:
        """The target, what is known of the chosen candidate, and the caution; "" without a plan."""
        plan = self.found
        if plan is None:
            return ""
        rim, candidate = self._rim(), plan.candidates[self._chosen]
        chosen = _("Candidate {number}: {text}").format(number=self._chosen + 1, text=candidate.text)
        if len(rim) and not np.allclose(rim.mean(axis=0), candidate.entry_ras, atol=0.1):
            chosen += "\n" + _("The opening was changed: these numbers are for the planned one.")
        return "\n".join((plan.target.text, chosen, _(NO_ADVICE)))

    def canChoose(self, number: int) -> tuple[bool, str]:
        """(whether there is this candidate, the reason if not)"""
        return self._panel.ready((bool(self.picture(number)), _("Plan an approach first")))

    def openHere(self) -> None:
        """Place the probe in the middle of the opening, aim it, and open the skull there if there is one."""
        panel = self._panel
        with panel.acting():
            plan = required(self.found, "no approach is planned, press Plan first")
            rim, candidate = self._rim(), plan.candidates[self._chosen]
            pose = candidate.probe_to_ras.copy()
            pose[:3, 3] = rim.mean(axis=0) if len(rim) else candidate.entry_ras
            self._placing.putAt(plan.in_opening(panel.preset.probe, pose, rim))
            if candidate.opening_mm:
                self._placing.openCraniotomy()

    # ---- the probe in the opening --------------------------------------------------------------------------------

    def _rim(self) -> np.ndarray:
        """(points, 3) world RAS mm of the closed curve that is chosen as the opening; none without one."""
        opening: Any = self._panel.parameters.opening
        is_curve = opening is not None and opening.IsA("vtkMRMLMarkupsClosedCurveNode")
        return control_points(opening) if is_curve else np.zeros((0, 3))

    def _keep(self) -> None:
        plan, parameters = self.found, self._panel.parameters
        probe: Any = parameters.probe_transform
        if plan is None or probe is None or not parameters.panel.keep_in_opening or probe.GetName() == FACE:
            return
        self.probe.watch(None)  # this change is not by the user
        set_node_to_world(probe, plan.in_opening(self._panel.preset.probe, probe_pose(probe), self._rim()))
        self.probe.watch(probe)
