"""The Qt widgets of a panel: one for each control of its sections.

Properties are set with setProperty(), which exists in PythonQt and in other Qt bindings. Control.widget is the object
name of a widget, and the name of its attribute in the result of build().
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import ctk
import qt
import slicer

from SlicerUSSim.Widget.interface import Control, Section, by_widget, tr as _

_PAGE_STEPS = 10
_TABLE_HEIGHT, _LIST_HEIGHT, _PICTURE_SIZE = 220, 140, 110
#: The most that a result or warning takes; the rest is scrolled
WORDS_HEIGHT = 72


def build(sections: tuple[Section, ...], column: Any) -> tuple[SimpleNamespace, Any]:
    """(widgets of all controls in a QVBoxLayout with a progress bar above them, QFormLayout of the last section)."""
    ui = SimpleNamespace(**{name: _widget(control) for name, control in by_widget(sections).items()})
    for name, widget in vars(ui).items():
        widget.setObjectName(name)
    column.setContentsMargins(0, 0, 0, 0)  # the module's own layout has margins
    _add_progress(column, ui)  # where it is in sight, whatever is open below
    form = None
    for section in sections:
        button, form = _section(section, ui)
        column.addWidget(button)
    column.addStretch(1)
    return ui, form


def _section(section: Section, ui: SimpleNamespace) -> tuple[Any, Any]:
    """(ctkCollapsibleButton, QFormLayout in it)."""
    result = ctk.ctkCollapsibleButton()
    result.setProperty("text", section.title)
    form = qt.QFormLayout(result)
    for row in section.rows:
        if isinstance(row, Control):
            _add_row(form, row, getattr(ui, row.widget))
            continue
        beside = qt.QWidget()
        line = qt.QHBoxLayout(beside)
        line.setContentsMargins(0, 0, 0, 0)
        for entry in row:
            if isinstance(entry, Control):
                line.addWidget(getattr(ui, entry.widget), 1)
        form.addRow(*(f"{entry}:" for entry in row[:1] if isinstance(entry, str)), beside)
    result.setProperty("collapsed", not section.is_open)
    return result, form


def _add_row(form: Any, control: Control, widget: Any) -> None:
    if control.kind == "words":
        form.addRow(_scrolled(widget))
        return
    if control.kind in ("button", "table", "tick"):
        form.addRow(widget)
        return
    label = qt.QLabel(f"{control.label}:")
    label.setToolTip(control.tip)
    form.addRow(label, widget)


def _widget(control: Control) -> Any:
    result = _MAKERS[control.kind](control)
    result.setToolTip(control.tip)
    return result


def _slider(control: Control) -> Any:
    result = _with_range(ctk.ctkSliderWidget(), control)
    result.setProperty("pageStep", _PAGE_STEPS * control.range.step)
    result.setProperty("synchronizeSiblings", 1)  # ctkSliderWidget.SynchronizeWidth: sliders of a section end alike
    return result


def _number(control: Control) -> Any:
    # For whole numbers too: a seed can exceed the range of a QSpinBox.
    result = _with_range(qt.QDoubleSpinBox(), control)
    result.setProperty("keyboardTracking", False)
    if control.range.none_at == control.range.low:  # the lowest number stands for none
        result.setProperty("specialValueText", _("none"))
    return result


def _with_range(widget: Any, control: Control) -> Any:
    widget.setProperty("decimals", control.decimals)  # first, since the other values are rounded to them
    widget.setProperty("minimum", control.range.low)
    widget.setProperty("maximum", control.range.high)
    widget.setProperty("singleStep", control.range.step)
    widget.setProperty("suffix", control.suffix)
    return widget


def _choice(control: Control) -> Any:
    result = qt.QComboBox()
    for name in control.choices:
        result.addItem(name)
    return result


def _node(control: Control) -> Any:
    result = slicer.qMRMLNodeComboBox()
    result.nodeTypes = list(control.node_classes)
    result.setProperty("showChildNodeTypes", False)
    result.setProperty("noneEnabled", True)
    for name in ("addEnabled", "removeEnabled", "renameEnabled", "selectNodeUponCreation"):
        result.setProperty(name, bool(control.new_node))
    if control.new_node:
        result.setProperty("baseName", control.new_node)
    result.setMRMLScene(slicer.mrmlScene)
    return result


def _words(control: Control) -> Any:
    result = qt.QLabel("")
    result.setProperty("wordWrap", True)
    result.setAlignment(qt.Qt.AlignTop)
    return result


def _picture(control: Control) -> Any:
    result = qt.QToolButton()
    result.setText(control.label)
    result.setToolButtonStyle(qt.Qt.ToolButtonTextUnderIcon)
    result.setIconSize(qt.QSize(_PICTURE_SIZE, _PICTURE_SIZE))
    return result


def _scrolled(label: Any) -> Any:
    result = qt.QScrollArea()
    result.setProperty("widgetResizable", True)
    result.setHorizontalScrollBarPolicy(qt.Qt.ScrollBarAlwaysOff)
    result.setFrameShape(qt.QFrame.NoFrame)
    result.setWidget(label)
    result.setVisible(False)
    return result


def _table(control: Control) -> Any:
    result = qt.QTableWidget()
    result.setMinimumHeight(_TABLE_HEIGHT)
    result.setAlternatingRowColors(True)
    result.verticalHeader().setVisible(False)
    result.horizontalHeader().setSectionResizeMode(qt.QHeaderView.Stretch)
    return result


def _list(control: Control) -> Any:
    result = qt.QListWidget()
    result.setMinimumHeight(_LIST_HEIGHT)
    result.setMaximumHeight(_LIST_HEIGHT)
    return result


_MAKERS = {
    "slider": _slider,
    "number": _number,
    "tick": lambda control: qt.QCheckBox(control.label),
    "choice": _choice,
    "text": lambda control: qt.QLineEdit(),
    "node": _node,
    "button": lambda control: qt.QPushButton(control.label),
    "words": _words,
    "table": _table,
    "list": _list,
    "picture": _picture,
}


def _add_progress(column: Any, ui: SimpleNamespace) -> None:
    ui.progressWidget = qt.QWidget()
    ui.progressBar, ui.cancelButton = qt.QProgressBar(), qt.QPushButton(_("Cancel"))
    ui.progressBar.setToolTip(_("Progress [%]"))
    ui.cancelButton.setToolTip(_("Stop the work without changing anything"))
    line = qt.QHBoxLayout(ui.progressWidget)
    line.setContentsMargins(0, 0, 0, 0)
    for name in ("progressBar", "cancelButton"):
        getattr(ui, name).setObjectName(name)
        line.addWidget(getattr(ui, name))
    ui.progressWidget.setObjectName("progressWidget")
    ui.progressWidget.setVisible(False)
    column.addWidget(ui.progressWidget)
