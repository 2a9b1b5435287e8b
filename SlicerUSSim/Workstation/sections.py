"""What the panel consists of, read from Resources/UI/SlicerUSSim.ui.

Slicer shows that file with Qt, the browser what is read here in HTML: the same sections with the same labels, tips,
ranges and units, from one file that Qt Designer edits.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

_UI_FILE = Path(__file__).parents[1] / "Resources" / "UI" / "SlicerUSSim.ui"

#: Kinds of controls, by widget class.
_KINDS = {
    "ctkSliderWidget": "slider",
    "QSpinBox": "number",
    "QDoubleSpinBox": "number",
    "QCheckBox": "tick",
    "QComboBox": "choice",
    "QLineEdit": "text",
    "qMRMLNodeComboBox": "node",
    "QPushButton": "button",
    "QTableWidget": "table",
    "QListWidget": "list",
    "QLabel": "words",
}
#: Qt's defaults of what a file may leave out.
_DEFAULTS = {"minimum": 0.0, "maximum": 99.0, "singleStep": 1.0}


@dataclass(frozen=True)
class Control:
    """One thing that a user sees, sets or presses."""

    name: str
    #: One of the values of _KINDS
    kind: str
    #: Beside it, and on it
    label: str
    text: str
    tip: str
    #: What it shows: a field of the preset (fields.FIELDS), a value or a node of the scene (mrml.parameter_node), or ""
    field: str
    value: str
    node: str
    minimum: float
    maximum: float
    step: float
    decimals: int
    unit: str
    #: What a choice offers, as the file says
    choices: tuple[str, ...]
    #: Classes of nodes that can be chosen, and whether none may be
    node_classes: tuple[str, ...]
    none_allowed: bool


@dataclass(frozen=True)
class Section:
    """A part of the panel that opens and closes."""

    title: str
    is_open: bool
    controls: tuple[Control, ...]


def read_sections() -> tuple[Section, ...]:
    """The sections of the panel in their order; what stands outside of them comes last, under "" as title."""
    root = ElementTree.parse(_UI_FILE).getroot()
    sections, around = [], []
    labels = {
        widget.get("name", ""): _properties(widget) for widget in root.iter("widget") if widget.get("class") == "QLabel"
    }
    for widget in root.iter("widget"):
        if widget.get("class") != "ctkCollapsibleButton":
            continue
        inside = [inner for inner in widget.iter("widget") if inner is not widget]
        around += inside
        properties = _properties(widget)
        sections.append(
            Section(properties["text"], properties.get("collapsed") != "true", tuple(_controls(inside, labels)))
        )
    rest = [widget for widget in root.iter("widget") if widget not in around]
    return (*sections, Section("", True, tuple(_controls(rest, labels))))


def _controls(widgets: list[Element], labels: dict[str, dict[str, str]]) -> Iterator[Control]:
    for widget in widgets:
        kind, name = _KINDS.get(widget.get("class", "")), widget.get("name", "")
        if kind is None or (name.endswith("Label") and name.removesuffix("Label") in {w.get("name") for w in widgets}):
            continue
        properties = _properties(widget)
        numbers = {key: float(properties.get(key, value)) for key, value in _DEFAULTS.items()}
        parameter = properties.get("SlicerParameterName", "")
        yield Control(
            name, kind,
            label=labels.get(f"{name}Label", {}).get("text", "").rstrip(":"),
            text=properties.get("text", ""),
            tip=properties.get("toolTip", ""),
            field=properties.get("presetField", ""),
            value=properties.get("sceneValue", "") or ("" if kind == "node" else parameter),
            node=properties.get("sceneNode", "") or (parameter if kind == "node" else ""),
            minimum=numbers["minimum"], maximum=numbers["maximum"], step=numbers["singleStep"],
            decimals=0 if widget.get("class") == "QSpinBox" else int(properties.get("decimals", 2)),
            unit=properties.get("suffix", "").strip(),
            choices=tuple(item.findtext("property/string", "") for item in widget.findall("item")),
            node_classes=tuple(properties.get("nodeTypes", "").split()),
            none_allowed=properties.get("noneEnabled") == "true",
        )  # fmt: skip


def _properties(widget: Element) -> dict[str, str]:
    """Name and text of the properties a widget has of its own."""
    return {entry.get("name", ""): "".join(entry.itertext()).strip() for entry in widget.findall("property")}
