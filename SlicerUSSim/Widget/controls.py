"""Sections and controls of a panel, for every user interface; conversion between declared and displayed values.

A value is named "section.name" in the preset ("display.gain_db") and "scene.name" in the parameters of the scene
("scene.contrast"). Its label, tool tip, range and unit come from its declaration.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

from SlicerUSSim.Logic.base.declaration import Parameter, Shown, short
from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.imaging.preset import preset_parameters
from SlicerUSSim.Logic.mrml.parameter_node import NODE_PARAMETERS, VALUE_PARAMETERS

SCENE = "scene"
Kind = Literal["slider", "number", "tick", "choice", "text", "node", "button", "words", "table", "list"]
#: The choices of a parameter that is true, false or none
_OPTIONAL = {"automatic": None, "on": True, "off": False}
#: Suffix of the widget's name, by kind of control.
_WIDGETS: dict[Kind, str] = {
    "slider": "Slider", "number": "SpinBox", "tick": "CheckBox", "choice": "ComboBox", "text": "LineEdit",
    "node": "Selector", "button": "Button", "words": "Label", "table": "Table", "list": "List",
}  # fmt: skip


@dataclass(frozen=True)
class Control:
    """One element of the panel, which displays or sets a value or runs an action; see also value(), node(), button().

    `shows`, `action` and `enabled` name properties and methods of the presenter, or of a part of it ("fits.apply").
    """

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
    #: Source of the displayed value or text
    shows: str = ""
    #: Method to call, with the value if there is one
    action: str = ""
    #: Source of whether it can be used: a bool, or (bool, the reason if not). "": it can always be used, and its action
    #: needs no additional packages.
    enabled: str = ""

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
        if self.range.as_db:
            return "dB"
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
    def hint(self) -> str:
        """Meaning of an empty text field: the part of the tool tip after "empty for ", or ""."""
        return self.tip.partition("empty for ")[2]

    @property
    def node_classes(self) -> tuple[str, ...]:
        """Classes of the nodes that can be selected."""
        return NODE_PARAMETERS[self.node]


#: A line of the panel: one control, or several side by side.
Row: TypeAlias = Control | tuple[Control, ...]


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
            yield from (row,) if isinstance(row, Control) else row


# ---- controls --------------------------------------------------------------------------------------------------------


def value(name: str) -> Control:
    """The control for a declared value: slider, number, tick, choice or text, depending on the declaration."""
    declared = value_parameter(name)
    kind: Kind = "text"
    if isinstance(declared.shown, Shown):
        kind = "slider" if declared.shown.is_slider else "number"
    elif declared.choices:
        kind = "choice"
    elif declared.type is bool:
        kind = "choice" if declared.can_be_none else "tick"
    widget = _camel_case(_without_unit(declared))
    choices = tuple(_OPTIONAL) if kind == "choice" and declared.type is bool else declared.choices
    result = Control(widget, kind, declared.label, declared.tip, name, declared, choices=choices)
    if isinstance(declared.shown, Shown):
        span = f"{declared.shown.low:.10g} to {declared.shown.high:.10g}{result.suffix}"
        result = replace(result, tip=f"{declared.tip} ({span})")
    return result


def values(*names: str) -> tuple[Control, ...]:
    """The controls for those of the named values that panels show."""
    return tuple(value(name) for name in names if value_parameter(name).shown)


def node(role: str, label: str, tip: str, new_node: str = "") -> Control:
    """The node selector for a role of SceneParameters."""
    return Control(_camel_case(role), "node", label, tip, node=role, new_node=new_node)


def button(name: str, label: str, tip: str, action: str = "", enabled: str = "") -> Control:
    """A button; by default its action is the presenter's method of the same name."""
    return Control(name, "button", label, tip, action=action or name, enabled=enabled)


def by_widget(sections: tuple[Section, ...]) -> dict[str, Control]:
    """{name of its widget: control}. Raises ValueError if two have the same name."""
    controls = [control for section in sections for control in section.controls]
    found = {control.widget: control for control in controls}
    if len(found) < len(controls):
        raise ValueError(f"two controls of one name among {', '.join(control.widget for control in controls)}")
    return found


# ---- values ----------------------------------------------------------------------------------------------------------


def value_parameter(name: str) -> Parameter:
    """The declaration of a value. Raises KeyError for an unknown one."""
    section, attribute = name.split(".")
    return VALUE_PARAMETERS[attribute] if section == SCENE else preset_parameters()[name]


def to_shown(declared: Parameter, found: Any) -> Any:
    """The displayed form of a value; None if nothing is displayed."""
    if declared.type is bool and declared.can_be_none:
        return next(text for text, value in _OPTIONAL.items() if value is found)
    return declared.shown.number(found) if isinstance(declared.shown, Shown) else found


def from_shown(declared: Parameter, entered: Any) -> Any:
    """The value for the content of a widget, not yet checked.

    Values of type int are rounded, since widgets hold them as floats.
    """
    if declared.type is bool and declared.can_be_none:
        return _OPTIONAL.get(entered, entered)
    is_number = isinstance(entered, int | float) and not isinstance(entered, bool) and math.isfinite(entered)
    if not is_number or not isinstance(declared.shown, Shown):
        return entered
    converted = declared.shown.value(entered)
    return round(converted) if declared.type is int and converted is not None else converted


@contextmanager
def in_words_of(declared: Parameter, entered: Any) -> Iterator[None]:
    """Within the block, an error about this parameter has its label, and what was entered as it is shown."""
    try:
        yield
    except SimulationError as error:
        _, is_about_it, rest = str(error).partition(f"{declared.name} is ")
        if not is_about_it:
            raise
        as_db = isinstance(declared.shown, Shown) and declared.shown.as_db
        unit = "dB" if as_db else declared.unit
        is_number = isinstance(entered, int | float) and not isinstance(entered, bool)
        what = f"{entered:g} {unit}".rstrip() if is_number else short(entered)
        expected = rest.rpartition(", expected ")[2]
        if as_db and declared.bounds is not None:
            expected = f"at most {20.0 * math.log10(declared.bounds[1]):.4g} dB"
        raise SimulationError(f"{declared.label} is {what}, expected {expected}") from error


def part_of(presenter: Any, name: str) -> Any:
    """A property or method of the presenter or of a part of it, by its dotted name."""
    for part in name.split("."):
        presenter = getattr(presenter, part)
    return presenter


def shown_by(presenter: Any, name: str) -> Any:
    """The current value of a property of the presenter, or of a method without arguments."""
    found = part_of(presenter, name)
    return found() if callable(found) else found


def usable(presenter: Any, control: Control) -> tuple[bool, str]:
    """(whether a control can be used, its tool tip, which is the reason if it cannot)"""
    found = shown_by(presenter, control.enabled) if control.enabled else True
    can, why_not = found if isinstance(found, tuple) else (found, "")
    return can, why_not or control.tip


def _without_unit(declared: Parameter) -> str:
    """The name without the suffix of its unit: gain for gain_db."""
    unit = "deg" if declared.unit == "°" else re.sub(r"[^a-z]+", "_", declared.unit.lower()).strip("_")
    return declared.name.removesuffix(f"_{unit}") if unit else declared.name


def _camel_case(name: str) -> str:
    first, *more = name.split("_")
    return first + "".join(word.capitalize() for word in more)
