"""Panel: the widgets for sections.py in Slicer, connected to a PanelPresenter, which has all other behaviour.

Widgets are read and written with property() and setProperty(), which exist in PythonQt and in other Qt bindings.
"""

from __future__ import annotations

from base64 import b64decode
from collections.abc import Callable, Collection
from contextlib import contextmanager
from functools import partial
from typing import Any

import qt
import slicer

from SlicerUSSim.Logic.base.errors import Cancelled, SimulationError, required
from SlicerUSSim.Logic.mrml.fitting_nodes import offered
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic
from SlicerUSSim.Logic.mrml.nodes import nodes_of_class
from SlicerUSSim.Widget.interface import Control, by_widget, tr as _
from SlicerUSSim.Widget.notes import CHECK
from SlicerUSSim.Widget.presenter import PanelPresenter
from SlicerUSSim.Widget.sections import panel_sections
from SlicerUSSim.Widget.tissue_presenter import TISSUE_COLUMNS, TissueRow
from SlicerUSSim.Widget.widgets import WORDS_HEIGHT, build

#: Property that holds a widget's value, and the signal of its change. The first property that the widget has applies.
_VALUES = (
    ("value", "valueChanged"), ("checked", "toggled"), ("currentText", "currentTextChanged"),
    ("text", "editingFinished"),
)  # fmt: skip
_BLINK_MS = 500
#: Style of results, and of those with something to check
_RESULT = "QLabel { background: #e8f4e8; color: #202020; padding: 2px }"
_TO_CHECK = "QLabel { background: #fff7df; color: #202020; padding: 2px }"
#: Number of the layout for ultrasound, as modules choose one, and its views: a slice beside 3D and another slice
_LAYOUT = 7301
_SLICE = """<item><view class="vtkMRMLSliceNode" singletontag="{name}"><property name="orientation" action="default">
{orientation}</property><property name="viewlabel" action="default">{name[0]}</property></view></item>"""
_LAYOUT_VIEWS = (
    '<layout type="horizontal" split="true">' + _SLICE.format(name="Red", orientation="Axial") + "<item>"
    '<layout type="vertical" split="true"><item><view class="vtkMRMLViewNode" singletontag="1"/></item>'
    + _SLICE.format(name="Yellow", orientation="Sagittal") + "</layout></item></layout>"
)  # fmt: skip


class Panel:
    """The view of one PanelPresenter in Slicer.

    Parameters
    ----------
    column : QVBoxLayout to which the widgets are added; they are attributes of `ui`, by object name.
    logic : UltrasoundSceneLogic of the scene.
    ensure_packages : called before actions that need packages; raises SimulationError if any are missing afterwards.
    """

    def __init__(self, column: Any, logic: UltrasoundSceneLogic, ensure_packages: Callable[[], None]) -> None:
        self.logic = logic
        self.presenter = presenter = PanelPresenter(logic, self)
        sections = panel_sections(presenter)
        self.ui, self.advanced = build(sections, column)
        #: Whether changes of widgets are written to the scene: not while it is closed or loaded, nor in other modules
        self.isConnected = True
        self._ensure_packages = ensure_packages
        self._cancelled = False
        self._rows: list[TissueRow] = []
        self._blinking = False
        self._picking: tuple[Any, int] | None = None  # markups node and observer
        self._removed: Any = None  # node that is being removed from the scene
        #: Controls with their widgets
        self._controls = [(control, getattr(self.ui, name)) for name, control in by_widget(sections).items()]
        #: {button: its action}, of those that use widgets, dialogs or views of Slicer
        self._own_actions: dict[str, Callable[[], None]] = {
            "assignTissue": self._assign_tissue, "loadPreset": self._load_preset, "savePreset": self._save_preset,
            "editTissues": self._edit_tissues, "layout": self._toggle_layout,
        }  # fmt: skip
        self._layout_before: int | None = None  # that of the user, while ours is used
        self._show(self.ui.compareComboBox, "after")
        self._prepare_table()
        self._connect()
        self.refresh()

    # ---- the presenter's view ----------------------------------------------------------------------------------

    def showError(self, message: str) -> None:
        slicer.util.errorDisplay(message)

    def showStatus(self, message: str) -> None:
        self._show_words(self.ui.statusLabel, message)

    def schedule(self, function: Callable[[], None]) -> None:
        qt.QTimer.singleShot(0, function)

    def sliceNode(self):
        wanted = self.ui.sliceViewComboBox.property("currentText")
        return next((node for node in self._slice_nodes() if node.GetLayoutName() == wanted), None)

    def pickPoint(self, points_node, picked: Callable[[], None]) -> None:
        """Slicer's mouse mode for placing one control point; the next point ends it."""
        markups = getattr(getattr(slicer, "modules", None), "markups", None)  # missing without a main window
        markups = required(markups, "a point can only be placed in Slicer's main window")
        self._stop_picking()
        tag = points_node.AddObserver(points_node.PointPositionDefinedEvent, lambda *_: self._picked(picked))
        self._picking = points_node, tag
        markups.logic().SetActiveList(points_node)
        markups.logic().StartPlaceMode(False)

    def _picked(self, picked: Callable[[], None]) -> None:
        self._stop_picking()
        qt.QTimer.singleShot(0, picked)  # after the markups have done with their event

    def _stop_picking(self) -> None:
        if self._picking is not None:
            node, tag = self._picking
            node.RemoveObserver(tag)
            self._picking = None

    def showChart(self, chart_node) -> None:
        plots = getattr(getattr(slicer, "modules", None), "plots", None)  # missing if Slicer runs without a main window
        if plots is not None:
            plots.logic().ShowChartInLayout(chart_node)

    @contextmanager
    def progress(self, title: str):
        self._cancelled = False
        self.ui.progressBar.setFormat(f"{title} %p%")
        self.ui.progressBar.setValue(0)
        self.ui.progressWidget.setVisible(True)

        def report(share: float) -> None:
            self.ui.progressBar.setValue(int(100 * share))
            slicer.app.processEvents()  # so that Cancel can be pressed
            if self._cancelled:
                raise Cancelled

        try:
            report(0.0)
            yield report
        finally:
            self.ui.progressWidget.setVisible(False)

    def refresh(self, changed: Collection[str] | None = None) -> None:
        if changed is None:
            self._fill(self.ui.sliceViewComboBox, [node.GetLayoutName() for node in self._slice_nodes()])
            numbers = self.presenter.fits.comparedNumbers()
            self._fill(self.ui.compareNumberComboBox, [str(number) for number in numbers])
        for control, widget in self._controls:
            if control.depends_on(changed):
                self._refresh(control, widget)

    def _refresh(self, control: Control, widget: Any) -> None:
        if control.enabled:
            can, tip = control.usable()
            widget.setEnabled(can)
            widget.setToolTip(tip)
        if control.node:
            self._offer_fitting(control, widget)
            with _silent(widget):
                widget.setCurrentNode(getattr(self.logic.parameters, control.node))
        elif control.value:
            value = self.presenter.values.value(control.value)
            widget.setEnabled(value is not None)
            if value is not None:
                self._show(widget, value)
        elif control.kind == "table":
            self._show_tissues()
        elif control.kind == "list":
            self._show_free()
        elif control.kind == "picture" and control.shows:
            picture = qt.QPixmap()
            picture.loadFromData(b64decode(control.shows().partition(",")[2]))
            widget.setIcon(qt.QIcon(picture))
        elif control.kind == "words" and control.shows:
            self._show_words(widget, control.shows())
        elif control.shows:
            self._show(widget, control.shows())

    def _offer_fitting(self, control: Control, widget: Any) -> None:
        """Hide the nodes of a selector's classes that do not fit its role."""
        nodes = {node.GetID(): node for name in control.node_classes for node in nodes_of_class(self.logic.scene, name)}
        parameters = self.logic.parameters
        chosen = getattr(parameters, control.node)
        hidden = [
            key for key, node in nodes.items() if node is not chosen and not offered(control.node, node, parameters)
        ]
        model = widget.sortFilterProxyModel()
        if list(model.property("hiddenNodeIDs")) != hidden:
            with _silent(widget):
                model.setProperty("hiddenNodeIDs", hidden)

    # ---- connections -------------------------------------------------------------------------------------------

    def _connect(self) -> None:
        ui, presenter = self.ui, self.presenter
        for control, widget in self._controls:
            if control.node:
                widget.currentNodeChanged.connect(self._changed(self._choose_node, control, widget))
            elif control.value:
                _signal_of(widget).connect(self._changed(self._set_value, control, widget))
            elif control.action or control.kind == "button":
                widget.clicked.connect(self._changed(self._press, control, widget))
            elif control.sets:
                _signal_of(widget).connect(self._changed(self._act, control, widget))
        ui.cancelButton.clicked.connect(self._cancel)
        ui.sliceViewComboBox.currentTextChanged.connect(lambda *_: presenter.parametersChanged())
        ui.tissueTable.cellChanged.connect(self._tissue_changed)
        ui.freeList.itemChanged.connect(self._free_changed)
        ui.compareComboBox.currentTextChanged.connect(self._compare)
        ui.compareNumberComboBox.currentTextChanged.connect(self._compare)
        ui.blinkCheckBox.toggled.connect(self._blink)

    def _changed(self, method: Callable[[Control, Any], None], control: Control, widget: Any) -> Callable[..., None]:
        """A slot that calls `method`. It ignores the signal's arguments, which differ between Qt bindings."""

        def slot(*_) -> None:
            if self.isConnected or control.kind == "button":
                method(control, widget)

        return slot

    def _choose_node(self, control: Control, widget: Any) -> None:
        chosen = widget.currentNode()
        if self._removed is not None and getattr(self.logic.parameters, control.node) is self._removed:
            chosen = None  # the selector went on to the next node, which the user did not choose
        with self.presenter.shown():
            setattr(self.logic.parameters, control.node, chosen)

    def nodeGoes(self, node: Any) -> None:
        """Called before a node is removed from the scene, and before its selectors see the removal."""
        self._removed = node

    def nodeGone(self) -> None:
        """Called after a node was removed from the scene."""
        self._removed = None
        if self.isConnected:  # else it is shown anew later; a closing scene removes all nodes, one by one
            self.refresh()

    def _set_value(self, control: Control, widget: Any) -> None:
        self.presenter.values.setValue(control.value, widget.property(_property_of(widget)))

    def _act(self, control: Control, widget: Any) -> None:
        if control.sets:
            self._do(control, partial(control.sets, widget.property(_property_of(widget))))

    def _press(self, control: Control, widget: Any) -> None:
        action = self._own_actions.get(control.name, control.action)
        if action:
            self._do(control, action)

    def _do(self, control: Control, action: Callable[[], object]) -> None:
        """Run the action of a control, after installing the packages that it needs (see Control.enabled)."""
        try:
            if control.enabled:
                self._ensure_packages()
        except SimulationError as error:
            self.showError(str(error))
            self.refresh()
            return
        action()

    def _cancel(self, *_) -> None:
        self._cancelled = True

    def _load_preset(self) -> None:
        self._with_file(qt.QFileDialog.getOpenFileName, _("Load preset"), "", self.presenter.values.loadPreset)

    def _save_preset(self) -> None:
        save = self.presenter.values.savePreset
        self._with_file(qt.QFileDialog.getSaveFileName, _("Save preset"), "preset.json", save)

    @staticmethod
    def _with_file(ask, title: str, proposal: str, action: Callable[[str], None]) -> None:
        path = ask(None, title, proposal, _("Presets (*.json)"))
        path = path if isinstance(path, str) else path[0]  # other Qt bindings return (path, filter)
        if path:
            action(path)

    def _edit_tissues(self) -> None:
        parameters = self.logic.parameters
        slicer.util.selectModule("SegmentEditor")
        editor = slicer.modules.segmenteditor.widgetRepresentation().self().editor
        editor.setSegmentationNode(parameters.labels)
        editor.setSourceVolumeNode(parameters.mri)

    # ---- layout of the views -----------------------------------------------------------------------------------

    def _toggle_layout(self) -> None:
        layout = self.logic.scene.GetFirstNodeByClass("vtkMRMLLayoutNode")
        if layout is None:  # Slicer runs without a main window
            return
        if self._layout_before is not None:
            self.restoreLayout()
            return
        if not layout.IsLayoutDescription(_LAYOUT):
            layout.AddLayoutDescription(_LAYOUT, _LAYOUT_VIEWS)
        self._layout_before = layout.GetViewArrangement()
        layout.SetViewArrangement(_LAYOUT)

    def restoreLayout(self) -> None:
        """Give the views the layout from before the button Layout, unless the user has chosen another one since."""
        layout, before = self.logic.scene.GetFirstNodeByClass("vtkMRMLLayoutNode"), self._layout_before
        self._layout_before = None
        if layout is not None and before is not None and layout.GetViewArrangement() == _LAYOUT:
            layout.SetViewArrangement(before)

    # ---- the tissue table --------------------------------------------------------------------------------------

    def _prepare_table(self) -> None:
        table = self.ui.tissueTable
        table.setColumnCount(1 + len(TISSUE_COLUMNS))
        first = "", _("Tissue"), _("Name of the tissue")
        for column, (_name, heading, tip) in enumerate((first, *TISSUE_COLUMNS)):
            item = qt.QTableWidgetItem(heading)
            item.setToolTip(_(tip))
            table.setHorizontalHeaderItem(column, item)
        table.horizontalHeader().setSectionResizeMode(0, qt.QHeaderView.ResizeToContents)

    def _show_tissues(self) -> None:
        rows = self.presenter.tissues.rows()
        if rows == self._rows:
            return
        self._rows = rows
        table = self.ui.tissueTable
        with _silent(table):
            table.setRowCount(len(rows))
            for line, row in enumerate(rows):
                name = qt.QTableWidgetItem(row.name)
                name.setFlags(qt.Qt.ItemIsSelectable | qt.Qt.ItemIsEnabled)
                table.setItem(line, 0, name)
                for column, (value, source) in enumerate(zip(row.values, row.sources, strict=True), 1):
                    item = qt.QTableWidgetItem(f"{value:.6g}")
                    item.setToolTip(source)
                    table.setItem(line, column, item)

    def _tissue_changed(self, line: int, column: int) -> None:
        row, name = self._rows[line], TISSUE_COLUMNS[column - 1][0]
        text = self.ui.tissueTable.item(line, column).text()
        self._rows = []  # redraw the table even if the change is rejected
        self.presenter.tissues.setTissue(row.name, name, text)
        self._show_tissues()

    def _assign_tissue(self) -> None:
        line = self.ui.tissueTable.currentRow
        line = line if isinstance(line, int) else line()  # a property in PythonQt, a method elsewhere
        if 0 <= line < len(self._rows):
            preset = self.ui.tissuePresetComboBox.property("currentText")
            self.presenter.tissues.assignTissue(self._rows[line].name, preset)

    # ---- fit to real ultrasound --------------------------------------------------------------------------------

    def _show_free(self) -> None:
        ui, free = self.ui, self.presenter.fits.freeParameters()
        with _silent(ui.freeList):
            labels = [label for _name, label, _on in free]
            if [ui.freeList.item(n).text() for n in range(ui.freeList.property("count"))] != labels:
                ui.freeList.clear()
                ui.freeList.addItems(labels)
            for n, (name, _label, on) in enumerate(free):
                item = ui.freeList.item(n)
                item.setData(qt.Qt.UserRole, name)
                item.setFlags(qt.Qt.ItemIsUserCheckable | qt.Qt.ItemIsEnabled | qt.Qt.ItemIsSelectable)
                item.setCheckState(qt.Qt.Checked if on else qt.Qt.Unchecked)

    def _free_changed(self, item) -> None:
        self.presenter.fits.setFree(item.data(qt.Qt.UserRole), item.checkState() == qt.Qt.Checked)

    def _compare(self, *_) -> None:
        number = self.ui.compareNumberComboBox.property("currentText")
        if number:
            self.presenter.fits.compare(self.ui.compareComboBox.property("currentText"), int(number))

    def _blink(self, *_) -> None:
        if self.ui.blinkCheckBox.property("checked") and not self._blinking:
            self._blinking = True
            qt.QTimer.singleShot(_BLINK_MS, self._blinked)

    def _blinked(self) -> None:
        self._blinking = False
        if self.ui.blinkCheckBox.property("checked"):
            self.presenter.fits.blink()
            self._blink()

    # ---- helpers -----------------------------------------------------------------------------------------------

    def _slice_nodes(self) -> list:
        return nodes_of_class(self.logic.scene, "vtkMRMLSliceNode")

    @staticmethod
    def _fill(combo, names: list[str]) -> None:
        if [combo.itemText(n) for n in range(combo.property("count"))] != names:
            with _silent(combo):
                combo.clear()
                for name in names:
                    combo.addItem(name)

    @staticmethod
    def _show_words(label, text: str) -> None:
        """Show a result, or with another colour what to check, in as many lines as it needs; longer ones scroll."""
        label.setText(text)
        label.setStyleSheet(_TO_CHECK if CHECK in text else _RESULT)
        area = label.parentWidget().parentWidget()
        area.setVisible(bool(text))
        if text:
            area.setFixedHeight(min(label.heightForWidth(area.property("width")), WORDS_HEIGHT))

    @staticmethod
    def _show(widget, value) -> None:
        prop = _property_of(widget)
        with _silent(widget):
            if prop == "value":
                # Values of a loaded preset can exceed the slider's range.
                if value > widget.property("maximum"):
                    widget.setProperty("maximum", value)
                if value < widget.property("minimum"):
                    widget.setProperty("minimum", value)
            if prop == "currentText":
                widget.setCurrentIndex(widget.findText(value))
            else:
                widget.setProperty(prop, value)


def _property_of(widget) -> str:
    """Name of the property that holds a widget's value."""
    return next(name for name, _signal in _VALUES if widget.property(name) is not None)


def _signal_of(widget):
    """The signal emitted when this property changes."""
    return getattr(widget, dict(_VALUES)[_property_of(widget)])


@contextmanager
def _silent(widget):
    was = widget.blockSignals(True)
    try:
        yield
    finally:
        widget.blockSignals(was)
