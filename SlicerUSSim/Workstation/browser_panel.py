"""BrowserPanel: connects the panel's controls on the page to a PanelPresenter."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np
from greenlet import getcurrent, greenlet
from trame_server.utils.asynchronous import get_event_loop

from SlicerUSSim.Logic.base.errors import Cancelled, require, required, user_message
from SlicerUSSim.Logic.mrml.fitting_nodes import offered
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic
from SlicerUSSim.Logic.mrml.nodes import Observed, nodes_of_class
from SlicerUSSim.Widget.image_presenter import FROZEN
from SlicerUSSim.Widget.interface import Control, by_widget
from SlicerUSSim.Widget.presenter import PanelPresenter
from SlicerUSSim.Widget.sections import panel_sections
from SlicerUSSim.Widget.tissue_presenter import TissueRow
from SlicerUSSim.Workstation.state import FreeParameter, NodeItem, SharedState, TissueLine
from SlicerUSSim.Workstation.tasks import Tasks
from SlicerUSSim.Workstation.uploads import as_known

_log = logging.getLogger(__name__)

#: Number of messages; more would cover the page.
_MOST = 5
#: End of the presenter's messages about the frame rate, and the least time between two of them on a page.
_RATE, _STATUS_EVERY_S = "images per second", 1.0
#: The class of all markups, of which there is no node itself
_MARKUPS = "vtkMRMLMarkupsNode"
#: Maximum number of points of the cost curve on the page.
_CURVE_POINTS = 150
_CLICK = "click in the lesion, in a slice view (Escape cancels)"


@dataclass(eq=False)
class _Work:
    """Something that a user waits for."""

    title: str
    task: greenlet
    percent: int = 0
    began: float = field(default_factory=perf_counter)
    #: Of this work alone: abandoned work still sees it
    is_cancelled: threading.Event = field(default_factory=threading.Event)


class BrowserPanel:
    """The view of one PanelPresenter on the pages, as Widget/panel.py is in Slicer.

    Parameters
    ----------
    tasks : runs functions that may wait for computations.
    about_to_compute : called before a live image is computed, in the event loop.
    """

    def __init__(
        self, shared: SharedState, logic: UltrasoundSceneLogic, tasks: Tasks, about_to_compute: Callable[[], None]
    ) -> None:
        self.shared, self.logic, self.tasks = shared, logic, tasks
        self._about_to_compute = about_to_compute
        self._thread = threading.get_ident()
        #: Calls a function with the point (3,), in the world, of the next click in a slice view, or None
        self.pick: Callable[[Callable[[np.ndarray | None], None]], None] = lambda clicked: None
        #: The work under way: its title, whether it is cancelled, and the task that does it. The last is shown
        self._under_way: list[_Work] = []
        self._status, self._status_until = "", 0.0
        self._table: Any = None  # vtkMRMLTableNode with the costs of a fit
        self._costs = Observed("ModifiedEvent", self._show_costs)
        #: Called after the controls were refreshed
        self.refreshed: list[Callable[[], None]] = []
        self.presenter = PanelPresenter(
            logic, self, handles=False, label_maps=True
        )  # label maps: filled ten times as fast as segmentations, and usable as overlays of the slice views
        self.sections = panel_sections(self.presenter)
        self._controls = by_widget(self.sections)
        #: Actions of the page in place of those of buttons
        self.own_actions: dict[Callable[[], object], Callable[[], object]] = {}
        with shared.changing() as now:
            now.panel.choices = {name: list(control.choices) for name, control in self._controls.items()}
        shared.show_values({name: next(iter(control.choices), None) for name, control in self._controls.items()})

    # ---- PanelView ---------------------------------------------------------------------------------------------

    def showError(self, message: str) -> None:
        message = as_known(message)
        _log.warning("%s", message)
        with self.shared.changing() as now:
            now.messages.errors = [*now.messages.errors, message][-_MOST:]

    def showStatus(self, message: str) -> None:
        # The frame rate is reported with every image, which is too often for updates of the page.
        now = perf_counter()
        message = "" if message.startswith(FROZEN) else message  # the badge says so, of the shown image
        if message != self._status and (now > self._status_until or not message.endswith(_RATE)):
            self._status, self._status_until = message, now + _STATUS_EVERY_S
            self._in_loop(lambda: self.shared.put("messages", {"status": message}))

    def schedule(self, function: Callable[[], None]) -> None:
        def run() -> None:
            self._about_to_compute()
            function()

        self.tasks.start(run)

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
            self.tasks.start(picked)

        self.pick(clicked)
        self.showStatus(_CLICK)

    def showChart(self, chart_node: Any) -> None:
        """Draw the costs in the table of a chart, and update the curve when the table changes."""
        self._table = chart_node.GetNthPlotSeriesNode(0).GetTableNode()
        self._costs.watch(self._table)
        with self.shared.changing() as now:
            now.fit.curve, now.fit.best = [], ""

    def refresh(self, changed: Collection[str] | None = None) -> None:
        stale = {name: control for name, control in self._controls.items() if control.depends_on(changed)}
        can = {name: control.usable() for name, control in stale.items() if control.enabled}
        nodes = {name: self._nodes_for(control) for name, control in stale.items() if control.node}
        shown = {name for name, control in stale.items() if control.value or control.node or control.shows}
        self.shared.show_values({name: self._shown_value(stale[name]) for name in shown})
        with self.shared.changing() as now:
            panel = now.panel
            if nodes or can:
                panel.nodes = {**panel.nodes, **nodes}
                panel.can = {**panel.can, **{name: is_usable for name, (is_usable, _) in can.items()}}
                panel.tips = {**panel.tips, **{name: tip for name, (_, tip) in can.items()}}
            if any(control.kind == "table" for control in stale.values()):
                panel.tissues = [_line(row) for row in self.presenter.tissues.rows()]
            if any(control.kind == "list" for control in stale.values()):
                now.fit.free = [FreeParameter(*entry) for entry in self.presenter.fits.freeParameters()]
        for told in self.refreshed:
            told()

    @contextmanager
    def progress(self, title: str) -> Iterator[Callable[[float], None]]:
        work = _Work(title, getcurrent())
        self._under_way.append(work)
        self._tick(work)

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

    def clearErrors(self) -> None:
        """Remove all errors, which are about what was before."""
        self.shared.put("messages", {"errors": []})

    def failed(self, error: Exception) -> None:
        """Show an exception that a task did not catch; an internal error is also logged with its traceback."""
        message = user_message(error)
        if message is None:
            _log.error("a mistake of the program", exc_info=error)
            message = f"something went wrong ({type(error).__name__}: {error})"
        self.showError(message)

    # ---- triggers of the page ----------------------------------------------------------------------------------

    def dismiss(self, number: int) -> None:
        """Remove an error that the user has closed."""
        with self.shared.changing() as now:
            now.messages.errors = [message for n, message in enumerate(now.messages.errors) if n != number]

    def cancel(self) -> None:
        """Stop the work under way, within a second."""
        if self._under_way:
            work = self._under_way[-1]
            work.is_cancelled.set()
            self.tasks.abandonSoon(work.task, lambda: work in self._under_way, self.logic.renewSimulator)

    def set(self, name: str, value: Any) -> None:
        """Called when the user changes the value of a control."""
        control = self._controls[name]
        if control.value or control.node or control.sets:
            self.tasks.start(lambda: self._changed(control, value))
        else:
            self.shared.show_values({name: value})  # used when a button is pressed

    def press(self, name: str) -> None:
        """Called when the user presses a button."""
        action = self._controls[name].action
        if name == "assignTissueButton":
            action = self._assign_tissue
        action = required(action, f"{name} is not a button of the page")
        self.clearErrors()
        self.tasks.start(lambda: self.act(action))

    def act(self, action: Callable[[], object]) -> None:
        """Run the action of a button, or that of the page in place of it; called in a task."""
        self.own_actions.get(action, action)()

    def _changed(self, control: Control, value: Any) -> None:
        presenter, parameters = self.presenter, self.logic.parameters
        none_at = control.range.none_at
        if control.kind == "number" and none_at is not None:
            if value is None:  # an empty field
                value = none_at
            elif isinstance(value, int | float) and value <= none_at:  # it stands for none, but was typed
                self.showError(f"{control.label} is {value:g}, expected more than {none_at:g}, or nothing")
                return
        if value == self._shown_value(control):
            return
        if control.value:
            presenter.values.setValue(control.value, value)
        elif control.node:
            with presenter.shown():
                setattr(parameters, control.node, self.logic.scene.GetNodeByID(value) if value else None)
        elif control.sets:
            control.sets(value)
        self.refresh(presenter.values.changes())

    def _assign_tissue(self) -> None:
        tissue = self.shared.now.panel.chosen_tissue
        with self.presenter.shown():
            require(bool(tissue), "no tissue chosen, click on its line in the table")
            self.presenter.tissues.assignTissue(tissue, str(self.shared.value("tissuePresetComboBox")))

    # ---- helpers -----------------------------------------------------------------------------------------------

    def _shown_value(self, control: Control) -> object:
        if control.value:
            return self.presenter.values.value(control.value)
        if control.node:
            node = getattr(self.logic.parameters, control.node)
            return None if node is None else node.GetID()
        return None if control.shows is None else control.shows()

    def _nodes_for(self, control: Control) -> list[NodeItem]:
        scene = self.logic.scene
        found = [
            node
            for name in control.node_classes
            for node in nodes_of_class(scene, name)
            # A label map is a volume, too, and is chosen elsewhere; of markups there is no node but of its kinds
            if name in (node.GetClassName(), _MARKUPS) and offered(control.node, node, self.logic.parameters)
        ]
        return [NodeItem("None", None), *(NodeItem(node.GetName(), node.GetID()) for node in found)]

    def _show_costs(self) -> None:
        rows = self._table.GetTable()
        columns = [rows.GetColumn(number) for number in range(rows.GetNumberOfColumns())]
        if len(columns) < 3 or not columns[0].GetNumberOfTuples():
            return
        best = np.minimum.accumulate(np.asarray(memoryview(columns[2])))  # a new stage begins with its own
        chosen = np.unique(np.linspace(0, len(best) - 1, _CURVE_POINTS).round().astype(int))
        self.shared.put("fit", {"curve": best[chosen].round(5).tolist()})

    def _show_work(self) -> None:
        work = self._under_way[-1] if self._under_way else None
        with self.shared.changing() as now:
            now.messages.progress_title = "" if work is None else work.title
            now.messages.progress_percent = 0 if work is None else work.percent
            now.messages.progress_s = 0 if work is None else int(perf_counter() - work.began)

    def _tick(self, work: _Work) -> None:
        """Show how long work has taken, every second: it may be long until it reports its next share."""
        if work in self._under_way:
            self._show_work()
            get_event_loop().call_later(1.0, self._tick, work)

    def _in_loop(self, function: Callable[[], None]) -> None:
        if threading.get_ident() == self._thread:
            function()
        else:
            self.tasks.tell(function)


def _line(row: TissueRow) -> TissueLine:
    return TissueLine(row.name, [f"{value:.6g}" for value in row.values], list(row.sources))
