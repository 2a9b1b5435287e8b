"""BrowserPanel: connects the panel's controls on the page to a PanelPresenter."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np
from greenlet import getcurrent, greenlet

from SlicerUSSim.Logic.base.errors import Cancelled, SimulationError
from SlicerUSSim.Logic.mrml.fitting_nodes import offered
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic
from SlicerUSSim.Logic.mrml.nodes import nodes_of_class
from SlicerUSSim.Widget.controls import Control, Section, by_widget, part_of, shown_by, usable, value_parameter
from SlicerUSSim.Widget.presenter import PanelPresenter, TissueRow
from SlicerUSSim.Workstation.messages import Messages
from SlicerUSSim.Workstation.observed import Observed
from SlicerUSSim.Workstation.state import FreeParameter, NodeItem, SharedState, TissueLine
from SlicerUSSim.Workstation.tasks import Tasks

#: End of the presenter's messages about the frame rate, and the least time between two of them on a page.
_RATE, _STATUS_EVERY_S = "images per second", 1.0
#: The class of all markups, of which there is no node itself
_MARKUPS = "vtkMRMLMarkupsNode"
#: Maximum number of points of the cost curve on the page.
_CURVE_POINTS = 150


_CLICK = "click in the lesion, in a slice view (Escape: not)"


@dataclass(eq=False)
class _Work:
    """Something that a user waits for."""

    title: str
    task: greenlet
    percent: int = 0
    #: Of this work alone: what is abandoned goes on to hear of it
    is_cancelled: threading.Event = field(default_factory=threading.Event)


class BrowserPanel:
    """The view of one PanelPresenter on the pages, as Widget/panel.py is in Slicer.

    Parameters
    ----------
    tasks : runs functions that may wait for computations.
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
        self._controls = by_widget(sections)
        self._thread = threading.get_ident()
        #: Calls a function with the point (3,), in the world, of the next click in a slice view, or None
        self.pick: Callable[[Callable[[np.ndarray | None], None]], None] = lambda clicked: None
        #: Called after every change, such as when live images have ended, or begun to wait for other work
        self.refreshed: Callable[[], None] = lambda: None
        #: The work under way: its title, whether it is cancelled, and the task that does it. The last is shown
        self._under_way: list[_Work] = []
        self._status, self._status_until = "", 0.0
        self._table: Any = None  # vtkMRMLTableNode with the costs of a fit
        self._costs = Observed("ModifiedEvent", self._show_costs)
        self.presenter = PanelPresenter(
            logic, self, handles=False, label_maps=True
        )  # label maps: filled ten times as fast as segmentations, and usable as overlays of the slice views
        with shared.changing() as now:
            now.open_sections = [section.title for section in sections if section.is_open]
            now.panel.choices = {name: list(control.choices) for name, control in self._controls.items()}
            now.panel.values = {name: next(iter(control.choices), None) for name, control in self._controls.items()}

    # ---- PanelView ---------------------------------------------------------------------------------------------

    def showError(self, message: str) -> None:
        self._messages.show(message)

    def showStatus(self, message: str) -> None:
        # The frame rate is reported with every image, which is too often for updates of the page.
        now = perf_counter()
        if message != self._status and (now > self._status_until or not message.endswith(_RATE)):
            self._status, self._status_until = message, now + _STATUS_EVERY_S
            self._in_loop(lambda: self._send_status(message))

    def schedule(self, function: Callable[[], None]) -> None:
        def run() -> None:
            self._about_to_compute()
            function()

        self._tasks.start(run)

    def sliceNode(self) -> None:
        """None: anatomy.py aligns the slice views with the probe."""
        return None

    def pickPoint(self, points_node: Any, picked: Callable[[], None]) -> None:
        """The next click in a slice view is the point."""

        def clicked(point_world: np.ndarray | None) -> None:
            self.showStatus("")
            if point_world is None:
                return
            points_node.AddControlPointWorld(*point_world.tolist())
            self._tasks.start(picked)

        self.pick(clicked)
        self.showStatus(_CLICK)

    def showChart(self, chart_node: Any) -> None:
        """Draw the costs in the table of a chart, and update the curve when the table changes."""
        self._table = chart_node.GetNthPlotSeriesNode(0).GetTableNode()
        self._costs.watch(self._table)
        with self._shared.changing() as now:
            now.fit.curve, now.fit.costs = [], ""

    def refresh(self) -> None:
        presenter = self.presenter
        can = {name: usable(presenter, control) for name, control in self._controls.items() if control.enabled}
        with self._shared.changing() as now:
            panel = now.panel
            panel.values = {**panel.values, **self._shown_values()}
            panel.nodes = {
                name: self._nodes_for(control) for name, control in self._controls.items() if control.kind == "node"
            }
            panel.tissues = [_line(row) for row in presenter.tissues.rows()]
            panel.can = {name: is_usable for name, (is_usable, _) in can.items()}
            panel.tips = {name: tip for name, (_, tip) in can.items()}
            now.fit.free = [FreeParameter(name, on) for name, on in presenter.fits.freeParameters()]
        self.refreshed()

    @contextmanager
    def progress(self, title: str) -> Iterator[Callable[[float], None]]:
        work = _Work(title, getcurrent())
        self._under_way.append(work)
        self._show_work()

        def report(share: float) -> None:
            percent = int(100 * share)
            if work.is_cancelled.is_set():
                raise Cancelled
            if percent != work.percent:
                work.percent = percent
                self._in_loop(self._show_work)

        try:
            yield report
        finally:
            self._under_way.remove(work)
            self._show_work()

    # ---- triggers of the page ----------------------------------------------------------------------------------

    def cancel(self) -> None:
        """Stop the work under way, within a second."""
        if self._under_way:
            work = self._under_way[-1]
            work.is_cancelled.set()
            self._tasks.abandonSoon(work.task, lambda: work in self._under_way, self._logic.renewSimulator)

    def set(self, name: str, value: Any) -> None:
        """Called when the user changes the value of a control."""
        control = self._controls[name]
        if control.value or control.node or control.action:
            self._tasks.start(lambda: self._changed(control, value))
        else:
            with self._shared.changing() as now:  # used when a button is pressed
                now.panel.values = {**now.panel.values, name: value}

    def _changed(self, control: Control, value: Any) -> None:
        presenter, parameters = self.presenter, self._logic.parameters
        none_at = control.range.none_at
        if control.kind == "number" and none_at is not None:
            if value is None:  # an empty field
                value = none_at
            elif isinstance(value, int | float) and value <= none_at:  # a number that stands for none, but was typed
                self._refuse(control, value)
                return
        if value == self._shown_value(control):
            return
        if control.value:
            presenter.values.setValue(control.value, value)
        elif control.node:
            with presenter.shown():
                setattr(parameters, control.node, self._logic.scene.GetNodeByID(value) if value else None)
        else:
            part_of(presenter, control.action)(value)
        self.refresh()

    def _refuse(self, control: Control, value: float) -> None:
        """Say that a number is out of the range of its parameter."""
        declared = value_parameter(control.value)
        whole = int(value) if float(value).is_integer() else value
        with self.presenter.shown():
            declared.checked(control.value.split(".")[0], whole)
            raise SimulationError(
                f"{declared.name} is {whole}, expected more than {control.range.none_at:g}, or nothing"
            )

    # ---- helpers -----------------------------------------------------------------------------------------------

    def _shown_values(self) -> dict[str, object]:
        return {
            name: self._shown_value(control)
            for name, control in self._controls.items()
            if control.value or control.node or control.shows
        }

    def _shown_value(self, control: Control) -> object:
        if control.value:
            return self.presenter.values.value(control.value)
        if control.node:
            node = getattr(self._logic.parameters, control.node)
            return None if node is None else node.GetID()
        return shown_by(self.presenter, control.shows)

    def _nodes_for(self, control: Control) -> list[NodeItem]:
        scene = self._logic.scene
        found = [
            node
            for name in control.node_classes
            for node in nodes_of_class(scene, name)
            # A label map is a volume, too, and is chosen elsewhere; of markups there is no node but of its kinds
            if name in (node.GetClassName(), _MARKUPS) and offered(control.node, node, self._logic.parameters)
        ]
        return [NodeItem("None", None), *(NodeItem(node.GetName(), node.GetID()) for node in found)]

    def _show_costs(self) -> None:
        rows = self._table.GetTable()
        columns = [rows.GetColumn(number) for number in range(rows.GetNumberOfColumns())]
        if len(columns) < 3 or not columns[0].GetNumberOfTuples():
            return
        evaluations, best = (np.asarray(memoryview(columns[n])) for n in (0, 2))
        best = np.minimum.accumulate(best)  # restarts, which measure identifiability, begin with high costs
        chosen = np.unique(np.linspace(0, len(best) - 1, _CURVE_POINTS).round().astype(int))
        with self._shared.changing() as now:
            curve = now.fit.curve = best[chosen].round(5).tolist()
            # Of the rounded numbers: rounding 0.23449998 at once gives 0.234, rounding it twice 0.235
            now.fit.costs = f"cost {curve[0]:.3f} → {curve[-1]:.3f} after {evaluations[-1]:.0f} evaluations"

    def _send_status(self, message: str) -> None:
        with self._shared.changing() as now:
            now.messages.status = message

    def _show_work(self) -> None:
        work = self._under_way[-1] if self._under_way else None
        with self._shared.changing() as now:
            now.messages.progress_title = "" if work is None else work.title
            now.messages.progress_percent = 0 if work is None else work.percent

    def _in_loop(self, function: Callable[[], None]) -> None:
        if threading.get_ident() == self._thread:
            function()
        else:
            self._tasks.tell(function)


def _line(row: TissueRow) -> TissueLine:
    return TissueLine(row.name, [f"{value:.6g}" for value in row.values], list(row.sources))
