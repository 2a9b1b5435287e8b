"""ApproachLogic: approaches to a lesion in labels of a scene; target, path and opening in its views."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.imaging.approach_images import simulated_approach
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.mrml.craniotomy_nodes import closed_labels, surface_of
from SlicerUSSim.Logic.mrml.label_nodes import LABEL_CLASSES
from SlicerUSSim.Logic.mrml.nodes import display_of, node_called, require_node
from SlicerUSSim.Logic.mrml.patient_logic import PatientLogic
from SlicerUSSim.Logic.mrml.sheet_nodes import read_sheets
from SlicerUSSim.Logic.placement.approach import Approach, Candidate, plan_approach

#: Names of the nodes that show an approach, and their colours
TARGET, WAY, OPENING = "Approach target", "Approach path", "Approach opening"
_YELLOW, _BLUE = (1.0, 0.78, 0.24), (0.35, 0.85, 1.0)


class ApproachLogic:
    """Plans, in the world, and shows what was planned."""

    def __init__(self, patient: PatientLogic) -> None:
        self._patient = patient

    def planApproach(self, labels_node, what: str | Sequence[float] | None = None) -> Approach:
        """The best candidates for the probe of the scene, with images; see plan_approach for `what` and errors.

        Of labels with an opening, the plan is for the closed head.
        """
        require_node(labels_node, *LABEL_CLASSES, use="label map")
        imaged = self._patient.imaged(closed_labels(labels_node))
        patient, preset = imaged.patient, imaged.preset
        placed = Volume(patient.labels.array, np.linalg.inv(patient.world_to_patient) @ patient.labels.ijk_to_ras)
        chosen: Any = self._patient.parameters.sheets
        sheets = None if chosen is None else read_sheets(chosen, np.eye(4), self._patient.parameters.sheet.kinds)
        work, device = self._patient.work, self._patient.device
        plan = work.doAside(lambda: plan_approach(placed, patient.names, preset.probe, what))

        def simulated() -> Approach:
            closed = UltrasoundSimulator(placed, imaged.tissues, preset.settings, device, imaged.texture, sheets)
            return simulated_approach(plan, closed, preset.probe, preset.display)

        return work.do(simulated)

    def showApproach(self, approach: Approach, candidate: Candidate) -> Any:
        """Show the target, the path of a candidate and its opening in the 3D views and slices.

        Returns the closed curve around the opening, whose points can be moved; None without a skull.
        """
        self.hideApproach()
        model = node_called(self._patient.scene, "Model", TARGET)
        model.SetAndObservePolyData(surface_of(approach.target.region))
        if (display := display_of(model)) is not None:
            display.SetColor(*_YELLOW)
            display.SetOpacity(0.6)
            display.SetVisibility2D(True)
        entry, across = candidate.entry_ras, candidate.probe_to_ras[:3, [0, 2]]
        self._draw("MarkupsCurve", WAY, np.array([entry, approach.target.centre_ras])).SetLocked(True)
        if not candidate.opening_mm:
            return None
        turn = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
        rim = entry + 0.5 * candidate.opening_mm * np.stack([np.cos(turn), np.sin(turn)], axis=1) @ across.T
        return self._draw("MarkupsClosedCurve", OPENING, rim)

    def hideApproach(self) -> None:
        """Remove what showApproach made."""
        for name in (TARGET, WAY, OPENING):
            self._patient.scene.RemoveNode(self._patient.scene.GetFirstNodeByName(name))

    def _draw(self, kind: str, name: str, points: np.ndarray) -> Any:
        node = node_called(self._patient.scene, kind, name)
        for point in points.tolist():
            node.AddControlPointWorld(*point)
        if (display := display_of(node)) is not None:
            display.SetSelectedColor(*_BLUE)
            display.SetGlyphScale(1.5)
            display.SetPointLabelsVisibility(False)
            display.SetPropertiesLabelVisibility(False)
            display.SetSliceProjection(True)
        return node
