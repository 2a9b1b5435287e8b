"""BrowserPanel: the panel's controls on the page: shows what its PanelPresenter knows, tells it what the user did."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import perf_counter
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import Cancelled
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic
from SlicerUSSim.Logic.mrml.nodes import nodes_of_class
from SlicerUSSim.Logic.probe.arrays import PROBES
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Widget.presenter import PanelPresenter, TissueRow
from SlicerUSSim.Workstation.messages import Messages
from SlicerUSSim.Workstation.observed import Observed
from SlicerUSSim.Workstation.sections import Control, Section
from SlicerUSSim.Workstation.state import CUSTOM_PROBE, FreeParameter, NodeItem, SharedState, TissueLine
from SlicerUSSim.Workstation.tasks import Tasks

#: How the presenter says how fast images come, and seconds for which a page shows it.
_RATE, _STATUS_EVERY_S = "images per second", 1.0
#: Points of the curve of costs that the page draws.
_CURVE_POINTS = 150


class BrowserPanel:
    """What the pages show of one PanelPresenter; it is that presenter's view, as panel.Panel is in Slicer.

    Parameters
    ----------
    tasks : who runs what may wait.
    sections : of the panel.
    about_to_compute : called before a live image is computed, in the event loop.
    """

    def __init__(
        self,
        shared: SharedState,
        messages: Messages,
        logic: UltrasoundSceneLogic,
        tasks: Tasks,
        sections: tuple[Section, ...],
        about_to_compute: Callable[[], None],
    ) -> None:
        self._shared, self._messages, self._logic, self._tasks = shared, messages, logic, tasks
        self._about_to_compute = about_to_compute
        self._controls = {control.name: control for section in sections for control in section.controls}
        self._thread = threading.get_ident()
        self._cancelled = False
        self._status, self._status_until = "", 0.0
        self._table: Any = None  # vtkMRMLTableNode of the costs of a fit
        self._costs = Observed("ModifiedEvent", self._show_costs)
        self.presenter = PanelPresenter(logic, self, handles=False)
        with shared.changing() as now:
            now.open_sections = [section.title for section in sections if section.is_open and section.title]
            now.panel.choices = {
                **{name: list(control.choices) for name, control in self._controls.items()},
                "probePresetComboBox": [CUSTOM_PROBE, *PROBES],
                "tissuePresetComboBox": list(TISSUES),
            }
            now.panel.values = {
                **dict.fromkeys(self._controls),
                "probePresetComboBox": CUSTOM_PROBE,
                "tissuePresetComboBox": next(iter(TISSUES)),
                "liveCheckBox": False,
            }

    # ---- PanelView ---------------------------------------------------------------------------------------------

    def showError(self, message: str) -> None:
        self._messages.show(message)

    def showStatus(self, message: str) -> None:
        # Images per second are told with every image, which would be too often for a page to draw itself anew.
        now = perf_counter()
        if message != self._status and (now > self._status_until or not message.endswith(_RATE)):
            self._status, self._status_until = message, now + _STATUS_EVERY_S
            self._in_loop(lambda: self._tell_status(message))

    def schedule(self, function: Callable[[], None]) -> None:
        def run() -> None:
            self._about_to_compute()
            function()

        self._tasks.start(run)

    def sliceNode(self) -> None:
        """None: anatomy.py keeps the slice views on the probe."""
        return None

    def showChart(self, chart_node: Any) -> None:
        """Draw the costs of the table behind a chart, whenever it changes."""
        self._table = chart_node.GetNthPlotSeriesNode(0).GetTableNode()
        self._costs.watch(self._table)
        with self._shared.changing() as now:
            now.fit.curve, now.fit.costs = [], ""

    def refresh(self) -> None:
        presenter = self.presenter
        can_segment, segment_tip = presenter.canSegment()
        can_simulate, simulate_tip = presenter.canSimulate()
        can_fit, fit_tip = presenter.fits.canFit()
        with self._shared.changing() as now:
            panel = now.panel
            panel.values = {**panel.values, **self._shown_values()}
            panel.nodes = {
                name: self._nodes_for(control) for name, control in self._controls.items() if control.kind == "node"
            }
            panel.tissues = [_line(row) for row in presenter.tissues()]
            panel.can = {
                "segmentButton": can_segment, "simulateButton": can_simulate, "placeButton": can_simulate,
                "liveCheckBox": can_simulate, "simulateSequenceButton": can_simulate, "fitButton": can_fit,
                "applyFitButton": presenter.fits.canApply, "revertFitButton": presenter.fits.canRevert,
            }  # fmt: skip
            panel.tips = {"segmentButton": segment_tip, "simulateButton": simulate_tip, "fitButton": fit_tip}
            now.fit.free = [FreeParameter(name, on) for name, on in presenter.fits.freeParameters()]
            now.fit.summary = presenter.fits.summary

    @contextmanager
    def progress(self, title: str) -> Iterator[Callable[[float], None]]:
        self._cancelled = False
        told = 0
        with self._shared.changing() as now:
            now.messages.progress_title, now.messages.progress_percent = title, told

        def report(share: float) -> None:
            nonlocal told
            percent = int(100 * share)
            if percent != told:
                told = percent
                self._in_loop(lambda: self._tell_percent(percent))
            if self._cancelled:
                raise Cancelled

        try:
            yield report
        finally:
            with self._shared.changing() as now:
                now.messages.progress_title = ""

    # ---- what the page says ------------------------------------------------------------------------------------

    def cancel(self) -> None:
        """Stop the work under way."""
        self._cancelled = True

    def set(self, name: str, value: Any) -> None:
        """The user gave a control another value."""
        control = self._controls[name]
        if name == "tissuePresetComboBox" or (control.kind == "node" and not control.node):
            with self._shared.changing() as now:  # what a button will take
                now.panel.values = {**now.panel.values, name: value}
        else:
            self._tasks.start(lambda: self._changed(control, value))

    def _changed(self, control: Control, value: Any) -> None:
        presenter, parameters = self.presenter, self._logic.parameters
        if control.field:
            if value != presenter.value(control.field):
                presenter.setValue(control.field, value)
                self.refresh()
        elif control.value:
            old = getattr(parameters, control.value)
            if value != old:
                with presenter.shown():
                    setattr(parameters, control.value, type(old)(value))
        elif control.node:
            node = parameters.node.GetScene().GetNodeByID(value) if value else None
            if node is not getattr(parameters, control.node):
                setattr(parameters, control.node, node)
        elif control.name == "probePresetComboBox":
            if value in PROBES and value != presenter.probeName():
                presenter.chooseProbe(value)
        elif control.name == "liveCheckBox":
            presenter.setLive(bool(value))

    # ---- inside ------------------------------------------------------------------------------------------------

    def _shown_values(self) -> dict[str, object]:
        parameters = self._logic.parameters
        shown: dict[str, object] = {}
        for name, control in self._controls.items():
            if control.field:
                shown[name] = self.presenter.value(control.field)
            elif control.value:
                shown[name] = getattr(parameters, control.value)
            elif control.node:
                node = getattr(parameters, control.node)
                shown[name] = None if node is None else node.GetID()
        shown["probePresetComboBox"] = self.presenter.probeName() or CUSTOM_PROBE
        shown["liveCheckBox"] = self.presenter.isLive()
        return shown

    def _nodes_for(self, control: Control) -> list[NodeItem]:
        scene = self._logic.scene
        found = [
            node for name in control.node_classes for node in nodes_of_class(scene, name) if node.GetClassName() == name
        ]
        none = [NodeItem("None", None)] if control.none_allowed else []
        return [*none, *(NodeItem(node.GetName(), node.GetID()) for node in found)]

    def _show_costs(self) -> None:
        rows = self._table.GetTable()
        columns = [rows.GetColumn(number) for number in range(rows.GetNumberOfColumns())]
        if len(columns) < 3 or not columns[0].GetNumberOfTuples():
            return
        evaluations, best = (np.asarray(memoryview(columns[n])) for n in (0, 2))
        best = np.minimum.accumulate(best)  # restarts, which tell what the images determine, begin high again
        chosen = np.unique(np.linspace(0, len(best) - 1, _CURVE_POINTS).round().astype(int))
        with self._shared.changing() as now:
            now.fit.curve = best[chosen].round(5).tolist()
            now.fit.costs = f"cost {best[0]:.3f} → {best[-1]:.3f} after {evaluations[-1]:.0f} evaluations"

    def _tell_status(self, message: str) -> None:
        with self._shared.changing() as now:
            now.messages.status = message

    def _tell_percent(self, percent: int) -> None:
        with self._shared.changing() as now:
            now.messages.progress_percent = percent

    def _in_loop(self, function: Callable[[], None]) -> None:
        if threading.get_ident() == self._thread:
            function()
        else:
            self._tasks.tell(function)


def _line(row: TissueRow) -> TissueLine:
    return TissueLine(row.name, [f"{value:.6g}" for value in row.values], list(row.sources))
