"""Panel: the widgets of Resources/UI/USSim.ui, wired to a PanelPresenter. All it decides is how things look.

Widgets are read and written by property() and setProperty(), which PythonQt and other bindings of Qt share.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import contextmanager

import qt
import slicer

from SlicerUSSim.Logic.base.errors import Cancelled, SimulationError
from SlicerUSSim.Logic.mrml.fit_nodes import COMPARED
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic
from SlicerUSSim.Logic.mrml.nodes import nodes_of_class
from SlicerUSSim.Logic.probe.arrays import PROBES
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Widget.presenter import TISSUE_COLUMNS, PanelPresenter, TissueRow

_CUSTOM = "custom"
#: Property that holds a value, and signal that tells of another one, by what a widget has.
_VALUES = (
    ("value", "valueChanged"), ("checked", "toggled"), ("currentText", "currentTextChanged"),
    ("text", "editingFinished"),
)  # fmt: skip
_BLINK_MS = 500


class Panel:
    """What the user sees of one PanelPresenter; it is that presenter's view.

    Parameters
    ----------
    ui : the named widgets, as slicer.util.childWidgetVariables gives them.
    logic : UltrasoundSceneLogic of the scene.
    ensure_packages : called before work that needs them; raises SimulationError if they are not there then.
    """

    def __init__(self, ui, logic: UltrasoundSceneLogic, ensure_packages: Callable[[], None]) -> None:
        self.ui = ui
        self.logic = logic
        self.presenter = PanelPresenter(logic, self)
        self._ensure_packages = ensure_packages
        self._cancelled = False
        self._rows: list[TissueRow] = []
        self._fields = {w.property("presetField"): w for w in vars(ui).values() if w.property("presetField")}
        self._node_selectors = {w.property("sceneNode"): w for w in vars(ui).values() if w.property("sceneNode")}
        self._values = {w.property("sceneValue"): w for w in vars(ui).values() if w.property("sceneValue")}

        ui.progressWidget.setVisible(False)
        for name in (_CUSTOM, *PROBES):
            ui.probePresetComboBox.addItem(name)
        for name in TISSUES:
            ui.tissuePresetComboBox.addItem(name)
        for name in COMPARED:
            ui.compareComboBox.addItem(name)
        self._show(ui.compareComboBox, "after")
        self._blinking = False
        self._prepare_table()
        self._connect()
        self.refresh()

    # ---- the presenter's view ----------------------------------------------------------------------------------

    def showError(self, message: str) -> None:
        slicer.util.errorDisplay(message)

    def showStatus(self, message: str) -> None:
        self.ui.statusLabel.setText(message)

    def schedule(self, function: Callable[[], None]) -> None:
        qt.QTimer.singleShot(0, function)

    def sliceNode(self):
        wanted = self.ui.sliceViewComboBox.property("currentText")
        if not self.logic.parameters.show_in_slice:
            return None
        return next((node for node in self._slice_nodes() if node.GetLayoutName() == wanted), None)

    def showChart(self, chart_node) -> None:
        plots = getattr(getattr(slicer, "modules", None), "plots", None)  # not where Slicer runs without windows
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
            slicer.app.processEvents()  # which lets Cancel be pressed
            if self._cancelled:
                raise Cancelled

        try:
            report(0.0)
            yield report
        finally:
            self.ui.progressWidget.setVisible(False)

    def refresh(self) -> None:
        presenter, ui = self.presenter, self.ui
        for field, widget in self._fields.items():
            value = presenter.value(field)
            widget.setEnabled(value is not None)
            if value is not None:
                self._show(widget, value)
        for role, widget in self._node_selectors.items():
            with _silent(widget):
                widget.setCurrentNode(getattr(self.logic.parameters, role))
        for name, widget in self._values.items():
            self._show(widget, getattr(self.logic.parameters, name))
        self._show(ui.probePresetComboBox, presenter.probeName() or _CUSTOM)
        self._show(ui.liveCheckBox, presenter.isLive())
        self._show_slice_names()
        self._show_tissues()
        can, tip = presenter.canSegment()
        self._enable(can, tip, ui.segmentButton)
        can, tip = presenter.canSimulate()
        self._enable(can, tip, ui.simulateButton)
        for widget in (ui.liveCheckBox, ui.placeButton, ui.simulateSequenceButton):
            widget.setEnabled(can)
        self._show_fit()

    # ---- wiring ------------------------------------------------------------------------------------------------

    def _connect(self) -> None:
        ui, presenter = self.ui, self.presenter
        for field, widget in self._fields.items():
            prop, signal = _value_of(widget)

            def changed(*_, field=field, widget=widget, prop=prop) -> None:
                presenter.setValue(field, widget.property(prop))

            getattr(widget, signal).connect(changed)
        for role, widget in self._node_selectors.items():

            def chosen(*_, role=role, widget=widget) -> None:
                setattr(self.logic.parameters, role, widget.currentNode())

            widget.currentNodeChanged.connect(chosen)
        for name, widget in self._values.items():
            prop, signal = _value_of(widget)

            def written(*_, name=name, widget=widget, prop=prop) -> None:
                setattr(self.logic.parameters, name, widget.property(prop))

            getattr(widget, signal).connect(written)
        ui.probePresetComboBox.currentTextChanged.connect(self._probe_chosen)
        ui.sliceViewComboBox.currentTextChanged.connect(lambda *_: presenter.parametersChanged())
        ui.tissueTable.cellChanged.connect(self._tissue_changed)

        for button, action in (
            (ui.segmentButton, presenter.segment),
            (ui.simulateButton, presenter.simulate),
            (ui.placeButton, self._place),
            (ui.simulateSequenceButton, self._simulate_sequence),
            (ui.fitButton, presenter.fits.fit),
        ):
            button.clicked.connect(lambda *_, action=action: self._with_packages(action))
        ui.liveCheckBox.toggled.connect(self._live_toggled)
        ui.cancelButton.clicked.connect(self._cancel)
        ui.assignTissueButton.clicked.connect(self._assign_tissue)
        ui.resetTissuesButton.clicked.connect(lambda *_: presenter.resetTissues())
        ui.loadPresetButton.clicked.connect(self._load_preset)
        ui.savePresetButton.clicked.connect(self._save_preset)
        ui.applyFitButton.clicked.connect(lambda *_: presenter.fits.apply())
        ui.revertFitButton.clicked.connect(lambda *_: presenter.fits.revert())
        ui.freeList.itemChanged.connect(self._free_changed)
        ui.compareComboBox.currentTextChanged.connect(self._compare)
        ui.compareNumberComboBox.currentTextChanged.connect(self._compare)
        ui.blinkCheckBox.toggled.connect(self._blink)

    def _with_packages(self, action: Callable[[], None]) -> None:
        try:
            self._ensure_packages()
        except SimulationError as error:
            self.showError(str(error))
            self.refresh()
            return
        action()

    def _live_toggled(self, *_) -> None:
        on = bool(self.ui.liveCheckBox.property("checked"))
        self._with_packages(lambda: self.presenter.setLive(on))

    def _probe_chosen(self, *_) -> None:
        name = self.ui.probePresetComboBox.property("currentText")
        if name == _CUSTOM:
            self.refresh()  # one does not choose it, one makes it
        else:
            self.presenter.chooseProbe(name)

    def _place(self) -> None:
        self.presenter.placeProbe(self.sliceNode())

    def _simulate_sequence(self) -> None:
        self.presenter.simulateSequence(
            self.ui.transformSequenceSelector.currentNode(), self.ui.imageSequenceSelector.currentNode()
        )

    def _cancel(self, *_) -> None:
        self._cancelled = True

    def _load_preset(self, *_) -> None:
        self._with_file(qt.QFileDialog.getOpenFileName, "Load preset", "", self.presenter.loadPreset)

    def _save_preset(self, *_) -> None:
        self._with_file(qt.QFileDialog.getSaveFileName, "Save preset", "preset.json", self.presenter.savePreset)

    @staticmethod
    def _with_file(ask, title: str, proposal: str, action: Callable[[str], None]) -> None:
        path = ask(None, title, proposal, "Presets (*.json)")
        path = path if isinstance(path, str) else path[0]  # with the chosen filter, where it is not PythonQt
        if path:
            action(path)

    # ---- the tissue table --------------------------------------------------------------------------------------

    def _prepare_table(self) -> None:
        table = self.ui.tissueTable
        table.setColumnCount(1 + len(TISSUE_COLUMNS))
        for column, (_, heading, tip) in enumerate((("", "Tissue", "name of the tissue"), *TISSUE_COLUMNS)):
            item = qt.QTableWidgetItem(heading)
            item.setToolTip(tip)
            table.setHorizontalHeaderItem(column, item)

    def _show_tissues(self) -> None:
        rows = self.presenter.tissues()
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
            table.resizeColumnsToContents()

    def _tissue_changed(self, line: int, column: int) -> None:
        row, parameter = self._rows[line], TISSUE_COLUMNS[column - 1][0]
        text = self.ui.tissueTable.item(line, column).text()
        self._rows = []  # show it anew, whatever becomes of the change
        self.presenter.setTissue(row.name, parameter, text)
        self._show_tissues()

    def _assign_tissue(self, *_) -> None:
        line = self.ui.tissueTable.currentRow
        line = line if isinstance(line, int) else line()  # a property in PythonQt
        if 0 <= line < len(self._rows):
            self.presenter.assignTissue(self._rows[line].name, self.ui.tissuePresetComboBox.property("currentText"))

    # ---- fit to real ultrasound --------------------------------------------------------------------------------

    def _show_fit(self) -> None:
        ui, fits = self.ui, self.presenter.fits
        can, tip = fits.canFit()
        self._enable(can, tip, ui.fitButton)
        ui.applyFitButton.setEnabled(fits.canApply)
        ui.revertFitButton.setEnabled(fits.canRevert)
        ui.fitLabel.setText(fits.summary)
        numbers = [str(number) for number in fits.comparedNumbers()]
        self._fill(ui.compareNumberComboBox, numbers)
        for widget in (ui.compareComboBox, ui.compareNumberComboBox, ui.blinkCheckBox):
            widget.setEnabled(bool(numbers))
        free = fits.freeParameters()
        with _silent(ui.freeList):
            if [ui.freeList.item(n).text() for n in range(ui.freeList.property("count"))] != [name for name, _ in free]:
                ui.freeList.clear()
                for name, _ in free:
                    ui.freeList.addItem(name)
            for n, (_, on) in enumerate(free):
                item = ui.freeList.item(n)
                item.setFlags(qt.Qt.ItemIsUserCheckable | qt.Qt.ItemIsEnabled | qt.Qt.ItemIsSelectable)
                item.setCheckState(qt.Qt.Checked if on else qt.Qt.Unchecked)

    def _free_changed(self, item) -> None:
        self.presenter.fits.setFree(item.text(), item.checkState() == qt.Qt.Checked)

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

    # ---- small things ------------------------------------------------------------------------------------------

    def _slice_nodes(self) -> list:
        return nodes_of_class(self.logic.scene, "vtkMRMLSliceNode")

    def _show_slice_names(self) -> None:
        self._fill(self.ui.sliceViewComboBox, [node.GetLayoutName() for node in self._slice_nodes()])

    @staticmethod
    def _fill(combo, names: list[str]) -> None:
        if [combo.itemText(n) for n in range(combo.property("count"))] != names:
            with _silent(combo):
                combo.clear()
                for name in names:
                    combo.addItem(name)

    @staticmethod
    def _enable(can: bool, tip: str, widget) -> None:
        widget.setEnabled(can)
        widget.setToolTip(tip)

    @staticmethod
    def _show(widget, value) -> None:
        prop, _ = _value_of(widget)
        with _silent(widget):
            if prop == "value":
                # A preset from elsewhere may go beyond what a slider offers.
                if value > widget.property("maximum"):
                    widget.setProperty("maximum", value)
                if value < widget.property("minimum"):
                    widget.setProperty("minimum", value)
            if prop == "currentText":
                widget.setCurrentIndex(widget.findText(value))
            else:
                widget.setProperty(prop, value)


def _value_of(widget) -> tuple[str, str]:
    return next((prop, signal) for prop, signal in _VALUES if widget.property(prop) is not None)


@contextmanager
def _silent(widget):
    was = widget.blockSignals(True)
    try:
        yield
    finally:
        widget.blockSignals(was)
