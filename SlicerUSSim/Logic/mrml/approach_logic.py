"""ApproachLogic: approaches to a lesion in labels of a scene, and models of target, way and opening in its views."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from vtkmodules.vtkCommonCore import vtkPoints
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.imaging.approach_images import simulated_approach
from SlicerUSSim.Logic.mrml.craniotomy_nodes import closed_labels, surface_of
from SlicerUSSim.Logic.mrml.label_nodes import LABEL_CLASSES
from SlicerUSSim.Logic.mrml.nodes import display_of, nodes_of_class, require_node
from SlicerUSSim.Logic.mrml.patient_logic import PatientLogic
from SlicerUSSim.Logic.mrml.sheet_nodes import read_sheets
from SlicerUSSim.Logic.placement.approach import Approach, Candidate, plan_approach

#: Attribute of a model node of this module: what it shows
_SHOWS = "SlicerUSSim.approach"
_TARGET, _WAY = "Target", "Approach"
_COLOURS = {_TARGET: (1.0, 0.78, 0.24), _WAY: (0.35, 0.85, 1.0)}
#: Points of a ring
_RING = 16


class ApproachLogic:
    """Plans, in the world, and shows what was planned."""

    def __init__(self, patient: PatientLogic) -> None:
        self._patient = patient

    def planApproach(self, labels_node, what: str | Sequence[float] | Volume | None = None) -> Approach:
        """The best candidates for the probe of the scene, with images; see plan_approach for `what` and errors.

        Of labels with an opening it is that of those before.
        """
        require_node(labels_node, *LABEL_CLASSES, use="label map")
        imaged = self._patient.imaged(closed_labels(labels_node))
        patient, preset = imaged.patient, imaged.preset
        placed = Volume(patient.labels.array, np.linalg.inv(patient.world_to_patient) @ patient.labels.ijk_to_ras)
        chosen: Any = self._patient.parameters.sheets
        sheets = None if chosen is None else read_sheets(chosen, np.eye(4), self._patient.parameters.sheet.kinds)
        work, device = self._patient.work, self._patient.device
        plan = work.doAside(lambda: plan_approach(placed, patient.names, preset.probe, what))
        return work.do(
            lambda: simulated_approach(
                plan, placed, imaged.tissues, preset.probe, preset.settings, preset.display, device=device,
                texture=imaged.texture, sheets=sheets,
            )
        )  # fmt: skip

    def showApproach(self, approach: Approach, candidate: Candidate) -> None:
        """Show the target, the way of a candidate and the rim of its opening in the 3D views and slices."""
        self._show(_TARGET, surface_of(approach.target.region))
        ends = np.array([candidate.entry_ras, approach.target.centre_ras])
        self._show(_WAY, _lines([ends, ring(candidate, closed=True)] if candidate.opening_mm else [ends]))

    def hideApproach(self) -> None:
        """Remove what showApproach made."""
        for node in self._shown():
            self._patient.scene.RemoveNode(node)

    def _shown(self) -> list[Any]:
        return [node for node in nodes_of_class(self._patient.scene, "vtkMRMLModelNode") if node.GetAttribute(_SHOWS)]

    def _show(self, what: str, polydata: vtkPolyData) -> None:
        node = next((node for node in self._shown() if node.GetAttribute(_SHOWS) == what), None)
        if node is None:
            node = self._patient.scene.AddNewNodeByClass("vtkMRMLModelNode", what)
            node.SetAttribute(_SHOWS, what)
        node.SetAndObservePolyData(polydata)
        display = display_of(node)
        if display is not None:
            display.SetColor(*_COLOURS[what])
            display.SetOpacity(0.6 if what == _TARGET else 1.0)
            display.SetLineWidth(3)
            display.SetVisibility2D(True)
            if what == _WAY:
                display.SetLighting(False)
                display.SetSliceDisplayModeToProjection()


def ring(candidate: Candidate, *, closed: bool = False) -> np.ndarray:
    """(points, 3) RAS mm of the rim of a candidate's opening, at the place where its way begins."""
    turn = np.linspace(0.0, 2.0 * np.pi, _RING + closed, endpoint=closed)
    around = np.stack([np.cos(turn), np.sin(turn)], axis=1) @ candidate.probe_to_ras[:3, [0, 2]].T
    return candidate.entry_ras + 0.5 * candidate.opening_mm * around


def _lines(paths: Sequence[np.ndarray]) -> vtkPolyData:
    """A line along each of the (points, 3)."""
    points, cells, first = vtkPoints(), vtkCellArray(), 0
    for path in paths:
        for place in path.tolist():
            points.InsertNextPoint(place)
        cells.InsertNextCell(len(path), list(range(first, first + len(path))))
        first += len(path)
    result = vtkPolyData()
    result.SetPoints(points)
    result.SetLines(cells)
    return result
