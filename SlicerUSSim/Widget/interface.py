"""What presenters and user interfaces, in Slicer and in the browser, share.

Control and Section: of what a panel consists. PanelView: what presenters require of an interface. PanelHost: what the
presenters of all subjects have in common.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any, Literal, Protocol, TypeAlias

from SlicerUSSim.Logic.base.declaration import Parameter, Shown
from SlicerUSSim.Logic.base.errors import Cancelled, SimulationError, require, user_message
from SlicerUSSim.Logic.imaging.device_trials import DeviceTrials
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic
from SlicerUSSim.Logic.mrml.parameter_node import NODE_PARAMETERS, SceneParameters

try:
    from slicer.i18n import tr as _in_slicer
except ImportError:  # outside of 3D Slicer
    _in_slicer = str

#: The text in the user's language; Slicer's own function, which looks at the file that calls it
tr: Callable[[str], str] = _in_slicer
_ = tr  # the name that Slicer's tools look for

Kind = Literal["slider", "number", "tick", "choice", "text", "node", "button", "words", "table", "list", "picture"]
#: Suffix of the widget's name, by kind of control.
_WIDGETS: dict[Kind, str] = {
    "slider": "Slider", "number": "SpinBox", "tick": "CheckBox", "choice": "ComboBox", "text": "LineEdit",
    "node": "Selector", "button": "Button", "words": "Label", "table": "Table", "list": "List",
    "picture": "Picture",
}  # fmt: skip


#: Whether a control can be used, or (whether it can, the reason if not)
Can: TypeAlias = Callable[[], bool | tuple[bool, str]]


@dataclass(frozen=True)
class Control:
    """One element of the panel, which displays or sets a value or runs an action."""

    name: str
    kind: Kind
    #: Text beside the widget, or on a check box or button
    label: str = ""
    tip: str = ""
    #: Name of the displayed value, and its declaration
    value: str = ""
    parameter: Parameter | None = None
    #: Role of the selected node, and base name of the nodes that the selector creates; "": it cannot create nodes
    node: str = ""
    new_node: str = ""
    #: Options of a choice, if they are constant
    choices: tuple[str, ...] = ()
    #: Source of the displayed value or text, unless it is a declared value; and what takes the one that a user enters
    shows: Callable[[], Any] | None = None
    sets: Callable[[Any], object] | None = None
    #: Called when a button is pressed, unless the view has its own action instead
    action: Callable[[], object] | None = None
    #: Whether it can be used; None: always, and without additional packages
    enabled: Can | None = None
    #: Values, and sections of the preset, on which what it shows depends, besides chosen nodes and actions
    depends: tuple[str, ...] = ()

    @property
    def widget(self) -> str:
        """Name of its widget, such as gainSlider."""
        return f"{self.name}{_WIDGETS[self.kind]}"

    @property
    def range(self) -> Shown:
        """Range, step and decimals of a slider or number."""
        shown = None if self.parameter is None else self.parameter.shown
        return shown if isinstance(shown, Shown) else Shown(0, 0)

    @property
    def unit(self) -> str:
        """Unit of the displayed number."""
        return "" if self.parameter is None else self.parameter.unit

    @property
    def suffix(self) -> str:
        """The unit as displayed after a number: with a space before it, except for °."""
        return f" {self.unit}" if self.unit and self.unit != "°" else self.unit

    @property
    def decimals(self) -> int:
        """Number of decimals; at least one in a spin box for a float."""
        is_whole = self.parameter is None or self.parameter.type is int
        return max(self.range.decimals, 0 if is_whole or self.kind == "slider" else 1)

    @property
    def node_classes(self) -> tuple[str, ...]:
        """Classes of the nodes that can be selected."""
        return NODE_PARAMETERS[self.node]

    def depends_on(self, changed: Collection[str] | None) -> bool:
        """Whether it may show something else after a change of these values; None: anything may have changed."""
        return changed is None or any(name in changed for name in self.depends)

    def usable(self) -> tuple[bool, str]:
        """(whether it can be used, its tool tip, which is the reason if it cannot)"""
        found = True if self.enabled is None else self.enabled()
        can, why_not = found if isinstance(found, tuple) else (found, "")
        return can, why_not or self.tip


#: A line of the panel: one control, or several side by side, after a label or not
Row: TypeAlias = Control | tuple[str | Control, ...]


@dataclass(frozen=True)
class Section:
    """A collapsible section of the panel."""

    title: str
    is_open: bool
    rows: tuple[Row, ...]

    @property
    def controls(self) -> Iterator[Control]:
        """All controls in order."""
        for row in self.rows:
            entries = (row,) if isinstance(row, Control) else row
            yield from (entry for entry in entries if isinstance(entry, Control))


def by_widget(sections: tuple[Section, ...]) -> dict[str, Control]:
    """{name of its widget: control}. Raises ValueError if two have the same name."""
    controls = [control for section in sections for control in section.controls]
    found = {control.widget: control for control in controls}
    if len(found) < len(controls):
        raise ValueError(f"two controls of one name among {', '.join(control.widget for control in controls)}")
    return found


class PanelView(Protocol):
    """What the presenters require of a user interface."""

    def showError(self, message: str) -> None:
        """Show one line in a message box."""
        ...

    def showStatus(self, message: str) -> None:
        """Show one line as the panel's status."""
        ...

    def refresh(self, changed: Collection[str] | None = None) -> None:
        """Update the controls that depend on these values, see Control.depends_on; by default all of them."""
        ...

    def progress(self, title: str) -> AbstractContextManager[Callable[[float], None]]:
        """Show a progress bar; the function takes the share done, 0 to 1, and raises Cancelled after Cancel."""
        ...

    def schedule(self, function: Callable[[], None]) -> None:
        """Call `function` once, soon, from the event loop."""
        ...

    def sliceNode(self) -> Any:
        """The vtkMRMLSliceNode of the selected slice view, or None."""
        ...

    def pickPoint(self, points_node: Any, picked: Callable[[], None]) -> None:
        """Let the user show a point in a view; it becomes the last of a markups node, then `picked` is called."""
        ...

    def showChart(self, chart_node) -> None:
        """Show a vtkMRMLPlotChartNode in the plot view."""
        ...


#: Options of the command in messages, and what a panel has for them
_IN_PANEL = (
    (r"label the whole head \(--outside\)", "tick Label tissues outside the brain and press Segment"),
    (r" ?\((?:--|ussim )[^()]*\)", ""),
    (r"--map (\d+)=TISSUE", r"the name of a tissue for \1 in its colour table"),
    (r"--map [^\s=]+=(?:'[^']*'|\S+)(?: --map [^\s=]+=(?:'[^']*'|\S+))*", "names of its tissues"),
    (r"--map (\S+)", r"names of \1"), (r"--add [^\s,;]+", "Add to tissues"), (r"--skull-strip", "Brain extraction"),
    (r"--contrast", "Contrast"), (r"--mask", "Brain mask"), (r"--organs", "Organs of a CT"),
    (r"--outside", "Label tissues outside the brain"), (r"--craniotomy", "Open skull"),
)  # fmt: skip


def in_panel(message: str) -> str:
    """A message with the names of controls in place of the command's options."""
    for option, control in _IN_PANEL:
        message = re.sub(option, control, message)
    return message


class PanelHost:
    """What the presenters of all subjects share: the scene's logic, the view, and the work under way."""

    def __init__(self, logic: UltrasoundSceneLogic, view: PanelView) -> None:
        self.logic = logic
        self.view = view
        self._busy = False
        #: In which devices build the kernels of images
        self.trials: DeviceTrials | None = None

    @property
    def parameters(self) -> SceneParameters:
        """The parameters of the scene."""
        return self.logic.parameters

    @property
    def preset(self) -> Preset:
        """The preset of the scene; the default in place of an invalid one."""
        try:
            return self.logic.preset
        except SimulationError:  # the error is shown when an image is simulated
            return Preset()

    @property
    def isBusy(self) -> bool:
        """Whether work is under way for which live images wait."""
        return self._busy

    def ready(self, *needs: tuple[object, str]) -> tuple[bool, str]:
        """(whether no work is under way and no need is None or False, the reason of the first one if not)"""
        needs = (not self._busy, _("Wait until the work under way is done")), *needs
        return next(((False, why_not) for met, why_not in needs if met is None or met is False), (True, ""))

    def canSimulate(self) -> tuple[bool, str]:
        """(whether there are tissues of which an image can be simulated, the reason if not)"""
        return self.ready((self.parameters.labels, _("Segment the MRI, or choose a label map or segmentation")))

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Show errors caused by the user in one line, then refresh the view."""
        try:
            yield
        except Exception as error:
            message = user_message(error)
            if message is None:
                raise
            if not isinstance(error, Cancelled):
                self.view.showError(in_panel(message))
            self.view.refresh()

    @contextmanager
    def acting(self) -> Iterator[None]:
        """As shown, and refresh the view without errors, too."""
        with self.shown():
            yield
        self.view.refresh()

    @contextmanager
    def working(self, title: str) -> Iterator[Callable[[float], None]]:
        """Show progress; no other work can start meanwhile."""
        require(not self._busy, "wait until the work under way is done")
        self._busy = True
        self.view.refresh()
        try:
            with self.view.progress(title) as progress:
                yield progress
        finally:
            self._busy = False

    def awaitKernels(self) -> None:
        """Show progress while the kernels of images are built, which takes a minute the first time."""
        if self.trials is not None and self.trials.used is None:
            with self.working(_("Build kernels, once on this computer")) as progress:
                self.trials.wait(progress)

    def add(self, kind: str, name: str) -> Any:
        """A new node vtkMRML{kind}Node."""
        return self.logic.scene.AddNewNodeByClass(f"vtkMRML{kind}Node", self.logic.scene.GenerateUniqueName(name))

    @contextmanager
    def made(self, node: Any, kind: str, name: str, *, wanted: bool = True) -> Iterator[Any]:
        """`node`, or a new one, which is removed if an exception is raised; None if none is wanted."""
        is_new = node is None and wanted
        if is_new:
            node = self.add(kind, name)
        try:
            yield node
        except BaseException:
            if is_new:
                self.logic.scene.RemoveNode(node)
            raise
