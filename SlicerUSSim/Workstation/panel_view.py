"""BrowserView: what the presenter shows, as the state of the page."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import contextmanager
from time import perf_counter

import numpy as np

from SlicerUSSim.Logic.base.errors import Cancelled
from SlicerUSSim.Logic.mrml.nodes import nodes_of_class
from SlicerUSSim.Logic.probe.arrays import PROBES
from SlicerUSSim.Widget.presenter import PanelPresenter
from SlicerUSSim.Workstation.sections import Control, Section
from SlicerUSSim.Workstation.tasks import Tasks

CUSTOM_PROBE = "custom"
#: How the presenter says how fast images come, and seconds for which a page shows it.
_RATE, _STATUS_EVERY_S = "images per second", 1.0
#: Points of the curve of costs that the page draws.
_CURVE_POINTS = 150


def state_key(control: Control) -> str:
    """The name under which the page's state holds what a control shows."""
    for kind, name in (("field", control.field), ("value", control.value), ("node", control.node)):
        if name:
            return f"{kind}_{name.replace('.', '_')}"
    return f"control_{control.name}"


class BrowserView:
    """Is the presenter's PanelView. The page reads the state, and tells changes of it to `changed`.

    Parameters
    ----------
    state : of the trame server.
    tasks : who runs what may wait.
    sections : of the panel.
    """

    def __init__(self, state, tasks: Tasks, sections: tuple[Section, ...]) -> None:
        self._state, self._tasks = state, tasks
        self._controls = [control for section in sections for control in section.controls]
        self._thread = threading.get_ident()
        self._cancelled = False
        self._status, self._status_until = "", 0.0
        self._chart_observed: tuple | None = None
        self.presenter: PanelPresenter | None = None
        #: Called before a live image is computed, in the event loop
        self.about_to_compute: Callable[[], None] = lambda: None
        for control in self._controls:
            state[state_key(control)] = None
        state.update(
            {
                "errors": [], "status": "", "progress_title": "", "progress_share": 0, "tissue_rows": [],
                "can": {}, "tip": {}, "node_items": {}, "free_parameters": [], "fit_summary": "", "fit_curve": [],
                "fit_costs": "", "control_probePresetComboBox": CUSTOM_PROBE, "control_liveCheckBox": False,
            }
        )  # fmt: skip

    # ---- PanelView ---------------------------------------------------------------------------------------------

    def showError(self, message: str) -> None:
        self._state.errors = [*self._state.errors[-4:], message]
        self._state.flush()

    def showStatus(self, message: str) -> None:
        # Images per second are told with every image, which would be too often for a page to draw itself anew.
        now = perf_counter()
        if message != self._status and (now > self._status_until or not message.endswith(_RATE)):
            self._status, self._status_until = message, now + _STATUS_EVERY_S
            self._in_loop(lambda: self._set(status=message))

    def schedule(self, function: Callable[[], None]) -> None:
        def run() -> None:
            self.about_to_compute()
            function()

        self._tasks.start(run)

    def sliceNode(self):
        """None: anatomy.py keeps the slice views on the probe."""
        return None

    def showChart(self, chart_node) -> None:
        """Draw the costs of the table behind a chart, whenever it changes."""
        series = chart_node.GetNthPlotSeriesNode(0)
        table = series.GetTableNode()
        if self._chart_observed is not None:
            observed, tag = self._chart_observed
            observed.RemoveObserver(tag)
        self._chart_observed = (table, table.AddObserver("ModifiedEvent", lambda *_: self._show_costs(table)))
        self._set(fit_curve=[], fit_costs="")

    def refresh(self) -> None:
        presenter, parameters = self.presenter, self.presenter.logic.parameters
        shown = {}
        for control in self._controls:
            if control.field:
                shown[state_key(control)] = presenter.value(control.field)
            elif control.value:
                shown[state_key(control)] = getattr(parameters, control.value)
            elif control.node:
                node = getattr(parameters, control.node)
                shown[state_key(control)] = None if node is None else node.GetID()
        shown["node_items"] = {
            state_key(control): self._nodes_for(control) for control in self._controls if control.kind == "node"
        }
        shown["control_probePresetComboBox"] = presenter.probeName() or CUSTOM_PROBE
        shown["control_liveCheckBox"] = presenter.isLive()
        shown["tissue_rows"] = [
            {"name": row.name, "values": [f"{value:.6g}" for value in row.values], "sources": list(row.sources)}
            for row in presenter.tissues()
        ]
        can_segment, segment_tip = presenter.canSegment()
        can_simulate, simulate_tip = presenter.canSimulate()
        can_fit, fit_tip = presenter.fits.canFit()
        shown["can"] = {
            "segmentButton": can_segment, "simulateButton": can_simulate, "placeButton": can_simulate,
            "liveCheckBox": can_simulate, "simulateSequenceButton": can_simulate, "fitButton": can_fit,
            "applyFitButton": presenter.fits.canApply, "revertFitButton": presenter.fits.canRevert,
        }  # fmt: skip
        shown["tip"] = {"segmentButton": segment_tip, "simulateButton": simulate_tip, "fitButton": fit_tip}
        shown["free_parameters"] = [{"name": name, "on": on} for name, on in presenter.fits.freeParameters()]
        shown["fit_summary"] = presenter.fits.summary
        self._set(**shown)

    @contextmanager
    def progress(self, title: str):
        self._cancelled = False
        self._set(progress_title=title, progress_share=0)

        def report(share: float) -> None:
            percent = int(100 * share)
            if percent != self._state.progress_share:
                self._in_loop(lambda: self._set(progress_share=percent))
            if self._cancelled:
                raise Cancelled

        try:
            yield report
        finally:
            self._set(progress_title="")

    # ---- what the page says ------------------------------------------------------------------------------------

    def cancel(self) -> None:
        """Stop the work under way."""
        self._cancelled = True

    def changed(self, control: Control, value) -> None:
        """The user gave a control another value; called in a task."""
        presenter, parameters = self.presenter, self.presenter.logic.parameters
        if control.field:
            if value != presenter.value(control.field):
                presenter.setValue(control.field, value)
                self.refresh()
        elif control.value:
            kind = type(getattr(parameters, control.value))
            if value != getattr(parameters, control.value):
                with presenter.shown():
                    setattr(parameters, control.value, kind(value))
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

    def _nodes_for(self, control: Control) -> list[dict]:
        scene = self.presenter.logic.scene
        found = [
            node for name in control.node_classes for node in nodes_of_class(scene, name) if node.GetClassName() == name
        ]
        items = [{"title": node.GetName(), "value": node.GetID()} for node in found]
        return [{"title": "None", "value": None}, *items] if control.none_allowed else items

    def _show_costs(self, table) -> None:
        rows = table.GetTable()
        columns = [rows.GetColumn(number) for number in range(rows.GetNumberOfColumns())]
        if len(columns) < 3 or not columns[0].GetNumberOfTuples():
            return
        evaluations, best = (np.asarray(memoryview(columns[n])) for n in (0, 2))
        best = np.minimum.accumulate(best)  # restarts, which tell what the images determine, begin high again
        chosen = np.unique(np.linspace(0, len(best) - 1, _CURVE_POINTS).round().astype(int))
        self._set(
            fit_curve=best[chosen].round(5).tolist(),
            fit_costs=f"cost {best[0]:.3f} → {best[-1]:.3f} after {evaluations[-1]:.0f} evaluations",
        )

    def _set(self, **values) -> None:
        self._state.update(values)
        self._state.flush()

    def _in_loop(self, function: Callable[[], None]) -> None:
        if threading.get_ident() == self._thread:
            function()
        else:
            self._tasks.tell(function)
