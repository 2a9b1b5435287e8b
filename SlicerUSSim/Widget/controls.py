"""What a panel is made of, for every user interface: controls in sections, and how declared values are shown in them.

A value has the name "section.name" of the preset ("display.gain_db") or "scene.name" of what the scene remembers
("scene.contrast"). Everything else about it, its label, tool tip, range and unit, is its declaration's.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

from SlicerUSSim.Logic.base.declaration import Parameter, Shown
from SlicerUSSim.Logic.imaging.preset import preset_parameters
from SlicerUSSim.Logic.mrml.parameter_node import NODE_PARAMETERS, VALUE_PARAMETERS

SCENE = "scene"
Kind = Literal["slider", "number", "tick", "choice", "text", "node", "button", "words", "table", "list"]
#: What the widget of a kind is called after the name of what it shows.
_WIDGETS: dict[Kind, str] = {
    "slider": "Slider", "number": "SpinBox", "tick": "CheckBox", "choice": "ComboBox", "text": "LineEdit",
    "node": "Selector", "button": "Button", "words": "Label", "table": "Table", "list": "List",
}  # fmt: skip


@dataclass(frozen=True)
class Control:
    """One thing that a user sees, sets or presses; value(), node(), button() and the like make them.

    `shows`, `action` and `enabled` are names of the presenter's properties and methods, "fits.apply" of a part of it.
    """

    name: str
    kind: Kind
    #: Beside it; on ticks and buttons
    label: str = ""
    tip: str = ""
    #: Name of the value that it shows, with its declaration
    value: str = ""
    parameter: Parameter | None = None
    #: Role of the node that it shows, and the name of nodes that it makes; "": it makes none
    node: str = ""
    new_node: str = ""
    #: What a choice offers, if that is always the same
    choices: tuple[str, ...] = ()
    #: What gives the value or the words
    shows: str = ""
    #: What is called, with the value if there is one
    action: str = ""
    #: What says whether it can be used: true or false, or (true or false, why not). Without it, it can always be used,
    #: and needs no packages.
    enabled: str = ""

    @property
    def widget(self) -> str:
        """Name of its widget, such as gainSlider."""
        return f"{self.name}{_WIDGETS[self.kind]}"

    @property
    def range(self) -> Shown:
        """What a slider or a number offers."""
        shown = None if self.parameter is None else self.parameter.shown
        return shown if isinstance(shown, Shown) else Shown(0, 0)

    @property
    def unit(self) -> str:
        """What the number is shown in."""
        if self.range.as_db:
            return "dB"
        return "" if self.parameter is None else self.parameter.unit

    @property
    def suffix(self) -> str:
        """The unit as it follows a number."""
        return f" {self.unit}" if self.unit and self.unit != "°" else self.unit

    @property
    def decimals(self) -> int:
        """Decimals of the number: a spin box of what is no whole number has one at least."""
        is_whole = self.parameter is None or self.parameter.type is int
        return max(self.range.decimals, 0 if is_whole or self.kind == "slider" else 1)

    @property
    def hint(self) -> str:
        """What an empty text stands for, if the tool tip says "empty for ..."."""
        return self.tip.partition("empty for ")[2]

    @property
    def node_classes(self) -> tuple[str, ...]:
        """Classes of the nodes that can be chosen."""
        return NODE_PARAMETERS[self.node]


#: A line of the panel: one control, or some side by side.
Row: TypeAlias = Control | tuple[Control, ...]


@dataclass(frozen=True)
class Section:
    """A part of the panel that opens and closes."""

    title: str
    is_open: bool
    rows: tuple[Row, ...]

    @property
    def controls(self) -> Iterator[Control]:
        """All of them in their order."""
        for row in self.rows:
            yield from (row,) if isinstance(row, Control) else row


# ---- controls --------------------------------------------------------------------------------------------------------


def value(name: str) -> Control:
    """The control of a declared value: a slider, a number, a tick, a choice or a text, as its declaration says."""
    declared = value_parameter(name)
    kind: Kind = "text"
    if isinstance(declared.shown, Shown):
        kind = "slider" if declared.shown.is_slider else "number"
    elif declared.choices:
        kind = "choice"
    elif declared.type is bool:
        kind = "tick"
    widget = _camel_case(_without_unit(declared))
    result = Control(widget, kind, declared.label, declared.tip, name, declared, choices=declared.choices)
    if isinstance(declared.shown, Shown):
        span = f"{declared.shown.low:.10g} to {declared.shown.high:.10g}{result.suffix}"
        result = replace(result, tip=f"{declared.tip} ({span})")
    return result


def values(*names: str) -> tuple[Control, ...]:
    """The controls of those values that panels show."""
    return tuple(value(name) for name in names if value_parameter(name).shown)


def node(role: str, label: str, tip: str, new_node: str = "") -> Control:
    """The choice of the node that plays a role of SceneParameters."""
    return Control(_camel_case(role), "node", label, tip, node=role, new_node=new_node)


def button(name: str, label: str, tip: str, action: str = "", enabled: str = "") -> Control:
    """A button; its action is the presenter's method of its name, if no other is given."""
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
    """What a panel shows for a value; None: nothing."""
    return declared.shown.number(found) if isinstance(declared.shown, Shown) else found


def from_shown(declared: Parameter, entered: Any) -> Any:
    """The value that is meant by what a widget holds, to be checked by whoever takes it.

    Widgets hold whole numbers as floats.
    """
    is_number = isinstance(entered, int | float) and not isinstance(entered, bool) and math.isfinite(entered)
    if not is_number or not isinstance(declared.shown, Shown):
        return entered
    meant = declared.shown.value(entered)
    return round(meant) if declared.type is int and meant is not None else meant


def part_of(presenter: Any, name: str) -> Any:
    """A property or method of the presenter or of a part of it, by its dotted name."""
    for part in name.split("."):
        presenter = getattr(presenter, part)
    return presenter


def shown_by(presenter: Any, name: str) -> Any:
    """What a property of the presenter, or a method without arguments, now is."""
    found = part_of(presenter, name)
    return found() if callable(found) else found


def usable(presenter: Any, control: Control) -> tuple[bool, str]:
    """(whether a control can be used, its tool tip, which says why not)"""
    found = shown_by(presenter, control.enabled) if control.enabled else True
    can, why_not = found if isinstance(found, tuple) else (found, "")
    return can, why_not or control.tip


def _without_unit(declared: Parameter) -> str:
    """The name without the unit at its end: gain_db is gain."""
    unit = "deg" if declared.unit == "°" else re.sub(r"[^a-z]+", "_", declared.unit.lower()).strip("_")
    return declared.name.removesuffix(f"_{unit}") if unit else declared.name


def _camel_case(name: str) -> str:
    first, *more = name.split("_")
    return first + "".join(word.capitalize() for word in more)
