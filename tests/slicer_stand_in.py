"""A substitute for the parts of the Slicer application that the scripted module uses, on PySide6 and slicer-core.

Slicer's scripted-module base classes, PythonQt and CTK cannot be installed; these stand in for them, so that the panel
runs, is clicked and is looked at. What they promise is what Slicer's sources do: the loader, the lifecycle, signals and
properties of the widgets, and the form in which parameterNodeWrapper keeps values in the node.
"""

from __future__ import annotations

import sys
import types
import typing
import unittest
from pathlib import Path
from tempfile import mkdtemp

import slicer
from PySide6 import QtCore, QtGui, QtWidgets
from vtkmodules.vtkCommonCore import VTK_OBJECT

# ---- CTK and MRML widgets --------------------------------------------------------------------------------------------


class CollapsibleButton(QtWidgets.QGroupBox):
    """ctkCollapsibleButton: a bar with an arrow and its text, which hides what is in it while collapsed."""

    def __init__(self, parent=None) -> None:
        super().__init__(parent)
        self._text, self._collapsed, self._hidden = "", False, []
        self.setStyleSheet(
            "QGroupBox { border: 1px solid #c0c0c0; margin-top: 20px } QGroupBox::title { subcontrol-origin: margin; "
            "subcontrol-position: top left; padding: 3px 900px 3px 4px; background: #dcdcdc; font-weight: bold }"
        )

    def _set_text(self, text: str) -> None:
        self._text = text
        self.setTitle(f"{'▸' if self._collapsed else '▾'} {text}")

    def setCollapsed(self, collapsed: bool) -> None:
        if collapsed == self._collapsed:
            return
        self._collapsed = collapsed
        self._set_text(self._text)
        self.setMaximumHeight(22 if collapsed else 16_777_215)
        children = self.findChildren(QtWidgets.QWidget, options=QtCore.Qt.FindDirectChildrenOnly)
        if collapsed:
            self._hidden = [child for child in children if child.isHidden()]  # these stay so
        for child in children:
            if child not in self._hidden:
                child.setVisible(not collapsed)

    def childEvent(self, event) -> None:
        super().childEvent(event)
        if event.added() and event.child().isWidgetType() and self._collapsed:
            event.child().setVisible(False)

    text = QtCore.Property(str, lambda self: self._text, _set_text)
    collapsed = QtCore.Property(bool, lambda self: self._collapsed, setCollapsed)


def _with_node(method):
    """An observer whose event comes with a node."""

    def observer(_subject, _event, node) -> None:
        method(node)

    observer.CallDataType = VTK_OBJECT
    return observer


class SliderWidget(QtWidgets.QWidget):
    """ctkSliderWidget: a slider and a spin box side by side."""

    valueChanged = QtCore.Signal(float)

    def __init__(self, parent=None) -> None:
        super().__init__(parent)
        self._slider = QtWidgets.QSlider(QtCore.Qt.Horizontal, self)
        self._box = QtWidgets.QDoubleSpinBox(self)
        layout = QtWidgets.QHBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(self._slider, 1)
        layout.addWidget(self._box)
        self._slider.setRange(0, 1000)
        self._box.setFixedWidth(132)  # as synchronizeSiblings makes them
        self._slider.valueChanged.connect(self._slid)
        self._box.valueChanged.connect(self._typed)

    def _slid(self, position: int) -> None:
        span = self._box.maximum() - self._box.minimum()
        self._box.setValue(self._box.minimum() + span * position / 1000)

    def _typed(self, value: float) -> None:
        span = max(self._box.maximum() - self._box.minimum(), 1e-12)
        self._slider.blockSignals(True)
        self._slider.setValue(round(1000 * (value - self._box.minimum()) / span))
        self._slider.blockSignals(False)
        self.valueChanged.emit(value)

    def setValue(self, value: float) -> None:
        self._box.setValue(value)

    def _set_minimum(self, value: float) -> None:
        self._box.setMinimum(value)
        self._typed(self._box.value())

    def _set_maximum(self, value: float) -> None:
        self._box.setMaximum(value)
        self._typed(self._box.value())

    value = QtCore.Property(float, lambda self: self._box.value(), setValue)
    minimum = QtCore.Property(float, lambda self: self._box.minimum(), _set_minimum)
    maximum = QtCore.Property(float, lambda self: self._box.maximum(), _set_maximum)
    singleStep = QtCore.Property(float, lambda self: self._box.singleStep(), lambda self, v: self._box.setSingleStep(v))
    synchronizeSiblings = QtCore.Property(int, lambda self: 1, lambda self, v: None)
    pageStep = QtCore.Property(float, lambda self: 1.0, lambda self, v: None)
    decimals = QtCore.Property(int, lambda self: self._box.decimals(), lambda self, v: self._box.setDecimals(v))
    suffix = QtCore.Property(str, lambda self: self._box.suffix(), lambda self, v: self._box.setSuffix(v))


class NodeFilter(QtCore.QObject):
    """qMRMLSortFilterProxyModel: which nodes a selector leaves out."""

    def __init__(self, selector: NodeComboBox) -> None:
        super().__init__(selector)
        self._selector, self.hidden = selector, []

    def _hide(self, ids) -> None:
        self.hidden = list(ids)
        self._selector._fill()

    hiddenNodeIDs = QtCore.Property("QStringList", lambda self: self.hidden, _hide)


class NodeComboBox(QtWidgets.QComboBox):
    """qMRMLNodeComboBox: the nodes of some classes in a scene.

    Without the current node it chooses the next one, as Qt's combo boxes do when a row is removed, and tells it as if
    the user had chosen it.
    """

    currentNodeChanged = QtCore.Signal(object)

    def __init__(self, parent=None) -> None:
        super().__init__(parent)
        self._scene, self._types, self._nodes, self._filling = None, [], [], False
        self._options, self._filter = {}, NodeFilter(self)
        self.setSizePolicy(QtWidgets.QSizePolicy.Expanding, QtWidgets.QSizePolicy.Fixed)
        self.currentIndexChanged.connect(self._changed)

    def setMRMLScene(self, scene) -> None:
        self._scene = scene
        scene.AddObserver(scene.NodeAddedEvent, lambda *_: self._fill())
        scene.AddObserver(scene.NodeAboutToBeRemovedEvent, _with_node(self._remove))
        self._fill()

    def sortFilterProxyModel(self) -> NodeFilter:
        return self._filter

    def _remove(self, node) -> None:
        """qMRMLSceneModel removes the row before the node is gone."""
        if node in getattr(self, "_nodes", ()):  # not of one that Qt has deleted
            at, was_current = self._nodes.index(node), self.currentNode() is node
            del self._nodes[at]
            was = self.blockSignals(True)
            self.removeItem(at)
            if was_current:
                self.setCurrentIndex(min(at, len(self._nodes) - 1))
            self.blockSignals(was)
            if was_current and not self.signalsBlocked():
                self.currentNodeChanged.emit(self.currentNode())

    def _fill(self) -> None:
        if self._scene is None:
            return
        before = self.currentNode()
        self._filling = True
        self.clear()
        self._nodes = [None]
        self.addItem("None")
        count = self._scene.GetNumberOfNodes()
        for node in (self._scene.GetNthNode(n) for n in range(count)):
            is_hidden = node.GetHideFromEditors() or node.GetID() in self._filter.hidden
            if node.GetClassName() in self._types and not is_hidden:
                self._nodes.append(node)
                self.addItem(node.GetName())
        self._filling = False
        at = self._nodes.index(before) if before in self._nodes else 0
        was = self.blockSignals(True)
        self.setCurrentIndex(at)
        self.blockSignals(was)
        if self.currentNode() is not before:
            self.currentNodeChanged.emit(self.currentNode())

    def _changed(self, *_) -> None:
        if not self._filling:
            self.currentNodeChanged.emit(self.currentNode())

    def currentNode(self):
        at = self.currentIndex()
        return self._nodes[at] if 0 <= at < len(self._nodes) else None

    def setCurrentNode(self, node) -> None:
        self.setCurrentIndex(self._nodes.index(node) if node in self._nodes else 0)

    def _set_types(self, types) -> None:
        self._types = list(types)

    def _option(name):  # noqa: N805
        return QtCore.Property(
            bool, lambda self: self._options.get(name, False), lambda self, v: self._options.__setitem__(name, v)
        )

    nodeTypes = QtCore.Property("QStringList", lambda self: self._types, _set_types)
    noneEnabled, addEnabled = _option("none"), _option("add")
    removeEnabled, renameEnabled = _option("remove"), _option("rename")
    showChildNodeTypes, selectNodeUponCreation = _option("child"), _option("select")
    baseName = QtCore.Property(
        str, lambda self: self._options.get("base", ""), lambda self, v: self._options.__setitem__("base", v)
    )


# ---- slicer.parameterNodeWrapper -------------------------------------------------------------------------------------


class Choice:
    def __init__(self, choices) -> None:
        self.choices = choices


class WithinRange:
    def __init__(self, minimum, maximum) -> None:
        self.minimum, self.maximum = minimum, maximum


def parameter_node_wrapper(cls):
    """Typed attributes kept in a vtkMRMLScriptedModuleNode."""
    hints = typing.get_type_hints(cls, include_extras=True)
    types_ = {name: typing.get_args(hint)[0] if typing.get_args(hint) else hint for name, hint in hints.items()}
    notes = {name: typing.get_args(hint)[1:] for name, hint in hints.items()}
    defaults = {name: getattr(cls, name, None) for name in hints}

    def make(name):
        kind = types_[name]

        def read(self):
            if issubclass(kind, slicer.vtkMRMLNode):
                return self.parameterNode.GetNodeReference(name)
            text = self.parameterNode.GetParameter(name)
            return text == "True" if kind is bool else kind(text)

        def write(self, value):
            if issubclass(kind, slicer.vtkMRMLNode):
                assert value is None or isinstance(value, kind)
                was = self.parameterNode.StartModify()
                self.parameterNode.SetParameter(name, "")
                self.parameterNode.SetNodeReferenceID(name, None if value is None else value.GetID())
                self.parameterNode.EndModify(was)
                return
            assert isinstance(value, kind), (name, value)
            for note in notes[name]:
                if isinstance(note, Choice):
                    assert value in note.choices
                if isinstance(note, WithinRange):
                    assert note.minimum <= value <= note.maximum
            self.parameterNode.SetParameter(name, str(value))

        return property(read, write)

    def init(self, parameter_node) -> None:
        self.parameterNode = parameter_node
        for name, default in defaults.items():
            if not parameter_node.HasParameter(name):
                setattr(self, name, default)

    for name in hints:
        setattr(cls, name, make(name))
    cls.__init__ = init
    cls.AddObserver = lambda self, *arguments: self.parameterNode.AddObserver(*arguments)
    cls.RemoveObserver = lambda self, tag: self.parameterNode.RemoveObserver(tag)
    cls.allParameters = hints
    return cls


# ---- slicer.ScriptedLoadableModule -----------------------------------------------------------------------------------


class ScriptedLoadableModule:
    def __init__(self, parent) -> None:
        self.parent = parent


class ScriptedLoadableModuleWidget:
    def __init__(self, parent) -> None:
        self.parent = parent
        self.layout = parent.layout()

    def setup(self) -> None:
        pass


class ScriptedLoadableModuleLogic:
    def __init__(self, parent=None) -> None:
        self.moduleName = type(self).__name__.removesuffix("Logic")

    def getParameterNode(self):
        node = slicer.mrmlScene.GetSingletonNode(self.moduleName, "vtkMRMLScriptedModuleNode")
        if node is None:
            node = slicer.mrmlScene.CreateNodeByClass("vtkMRMLScriptedModuleNode")
            node.UnRegister(None)
            node.SetSingletonTag(self.moduleName)
            node.SetAttribute("ModuleName", self.moduleName)
            node = slicer.mrmlScene.AddNode(node)
        return node


class ScriptedLoadableModuleTest(unittest.TestCase):
    def delayDisplay(self, message: str) -> None:
        slicer.app.shown.append(message)


# ---- the application -------------------------------------------------------------------------------------------------


class Application:
    """slicer.app, with the texts of message boxes."""

    def __init__(self) -> None:
        self.qt = QtWidgets.QApplication.instance() or QtWidgets.QApplication([])
        self.errors: list[str] = []
        self.questions: list[str] = []
        self.answer = True
        self.started: list = []
        self.shown: list[str] = []
        #: Arguments of pip: packages, and the content of the file of constraints
        self.installed: list[str] = []
        self.constraints = ""
        self.settings = QtCore.QSettings(str(Path(mkdtemp()) / "Slicer.ini"), QtCore.QSettings.IniFormat)
        #: --testing, in which message boxes answer themselves
        self.testing = False

    def testingEnabled(self) -> bool:
        return self.testing

    def userSettings(self) -> QtCore.QSettings:
        return self.settings

    def connect(self, signal: str, function) -> None:
        assert signal == "startupCompleted()"
        self.started.append(function)

    def processEvents(self) -> None:
        self.qt.processEvents()

    def pip_install(self, arguments: list[str]) -> None:
        at = arguments.index("--constraint")
        self.constraints = Path(arguments[at + 1]).read_text()
        self.installed += arguments[:at] + arguments[at + 2 :]

    def confirm(self, question: str) -> bool:
        self.questions.append(question)
        return self.answer or self.testing


def _qt_name(name: str):
    """PythonQt keeps all of Qt in one module."""
    for source in (QtCore, QtGui, QtWidgets):
        if hasattr(source, name):
            return getattr(source, name)
    raise AttributeError(f"qt has no {name}")


def start() -> Application:
    """Install the stand-ins where the module imports them; pytest's monkeypatch of sys.modules removes them again."""
    qt = types.ModuleType("qt")
    qt.__getattr__ = _qt_name
    app = Application()
    modules = {
        "qt": qt,
        "ctk": types.SimpleNamespace(ctkCollapsibleButton=CollapsibleButton, ctkSliderWidget=SliderWidget),
        "slicer.i18n": types.SimpleNamespace(tr=lambda text: text, translate=lambda context, text: text),
        "slicer.parameterNodeWrapper": types.SimpleNamespace(
            parameterNodeWrapper=parameter_node_wrapper, Choice=Choice, WithinRange=WithinRange
        ),
        "slicer.ScriptedLoadableModule": types.SimpleNamespace(
            ScriptedLoadableModule=ScriptedLoadableModule,
            ScriptedLoadableModuleWidget=ScriptedLoadableModuleWidget,
            ScriptedLoadableModuleLogic=ScriptedLoadableModuleLogic,
            ScriptedLoadableModuleTest=ScriptedLoadableModuleTest,
        ),
    }
    sys.modules.update(modules)
    slicer.app = app
    slicer.qMRMLNodeComboBox = NodeComboBox
    slicer.util.errorDisplay = app.errors.append
    slicer.util.pip_install = app.pip_install
    slicer.util.confirmOkCancelDisplay = app.confirm
    return app
