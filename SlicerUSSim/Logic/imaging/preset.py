"""Preset: all settings of a user as one value and one JSON file, for the command, VTK filter and Slicer module."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from SlicerUSSim.Logic.base.declaration import Parameter, built, kind_of, parameter_of, parameters_of, short
from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.files import read_json, write_json
from SlicerUSSim.Logic.base.reading import reader
from SlicerUSSim.Logic.base.settings import DisplaySettings, SimulationSettings
from SlicerUSSim.Logic.base.transforms import check_rigid
from SlicerUSSim.Logic.probe.arrays import PROBE_KINDS, PROBES, Probe, probe_from_dict, probe_kind
from SlicerUSSim.Logic.probe.beam import TRANSMIT_OF
from SlicerUSSim.Logic.tissue.table import TissueTable

_log = logging.getLogger(__name__)

#: {name: class} of the sections of a preset that consist of one dataclass.
SECTIONS: dict[str, type[DisplaySettings] | type[SimulationSettings]] = {
    "display": DisplaySettings,
    "settings": SimulationSettings,
}
#: Name of the pose, as in files of poses
_POSE = "probe_to_ras"
_KIND = "probe.kind"
#: Objects of keys that the command alone has (Command/options.py)
_OF_COMMAND = ("segmentation", "fit", "approach", "patient", "recording", "results")
#: Tissues of segment_mri with thin sulci.
_BRAIN = ("csf", "grey matter", "white matter", "leptomeninges")


@dataclass(frozen=True)
class Preset:
    """Probe, display, settings and tissues. The default is a cranial phased array and the brain's tissues.

    >>> from SlicerUSSim.Logic import Preset
    >>> preset = Preset().changed("probe", kind="convex", depth_mm=110).changed("display", gain_db=3)
    >>> preset.probe.focus_mm
    66.0
    >>> preset.write("preset.json")
    >>> Preset.read("preset.json") == preset
    True
    """

    probe: Probe = PROBES["phased"]
    display: DisplaySettings = field(default_factory=DisplaySettings)
    settings: SimulationSettings = field(default_factory=SimulationSettings)
    tissues: TissueTable = field(default_factory=lambda: TissueTable.brain(_BRAIN))
    #: (4, 4) pose of the probe by rows, which a preset has if it is to be loaded together with it
    probe_to_ras: tuple[tuple[float, ...], ...] | None = None

    def __post_init__(self) -> None:
        if self.probe_to_ras is not None:
            pose = check_rigid("preset: probe_to_ras", self.probe_to_ras)
            object.__setattr__(self, "probe_to_ras", tuple(map(tuple, pose.tolist())))
        for name, kind in (
            ("probe", Probe), ("display", DisplaySettings), ("settings", SimulationSettings), ("tissues", TissueTable),
        ):  # fmt: skip
            value = getattr(self, name)
            require(isinstance(value, kind), f"preset: {name} is {short(value)}, expected a {kind.__name__}")

    def changed(self, section: str, **values) -> Preset:
        """A preset with values of one section changed: changed("display", gain_db=3).

        Sections are "probe", "display" and "settings"; probe values may include its "kind". Parameters that only
        the new kind has are then taken from its preset in PROBES. A new "transmit" resets the parameters that
        only other ones have. A focus at its default depth moves with the image depth.
        Raises SimulationError for an unknown section or name and for a value out of range.
        """
        _check_section(section)
        if section == "probe":
            return replace(self, probe=_changed_probe(self.probe, values))
        old = asdict(getattr(self, section))
        changed: dict[str, Any] = {section: built(SECTIONS[section], {**old, **values}, section)}
        return replace(self, **changed)

    def to_dict(self) -> dict:
        """Plain values; from_dict reads them back."""
        pose = {} if self.probe_to_ras is None else {_POSE: [list(row) for row in self.probe_to_ras]}
        return {
            "probe": self.probe.to_dict(),
            **{name: asdict(getattr(self, name)) for name in SECTIONS},
            **self.tissues.to_dict(),
            **pose,
        }

    @classmethod
    def from_dict(cls, values: dict, source: str = "preset") -> Preset:
        """The inverse of to_dict; missing sections have their default.

        Raises SimulationError that names `source` and the error in it.
        """
        known = ("probe", *SECTIONS, "tissues", "membrane", _POSE)
        require(isinstance(values, dict), f"{source}: is {kind_of(values)}, expected an object")
        require(
            not {"cost_after", "parameters"} <= values.keys(),
            f"{source}: is the result of a fit, expected a preset, as ussim optimize --save-preset writes it",
        )
        for name in values:
            is_known = name in (*known, *_OF_COMMAND)
            require(is_known, f"{source}: has {short(name)}, expected {', '.join(known)}")
        sections: dict[str, Any] = {}
        if "probe" in values:
            sections["probe"] = probe_from_dict(values["probe"], f"{source}: probe")
        for name, kind in SECTIONS.items():
            if name in values:
                sections[name] = built(kind, values[name], f"{source}: {name}")
        if "tissues" in values or "membrane" in values:
            sections["tissues"] = TissueTable.from_dict(values, source)
        if values.get(_POSE) is not None:
            require(values.keys() != {_POSE}, f"{source}: is a pose, not a preset; open it as a pose")
            sections[_POSE] = check_rigid(f"{source}: {_POSE}", values[_POSE])
        missing = [name for name in known[:-2] if name not in values]
        if missing:
            _log.info("%s: has no %s; the defaults are used", source, ", ".join(missing))
        return cls(**sections)

    def to_texts(self) -> dict[str, str]:
        """{name: text} of all values, so that what is kept does not change with the defaults of a later version.

        Names as in preset_parameters, and "tissues.2" for label 2 or "membrane.fluids", whose values are JSON:
        null for what this preset lacks. The pose is left out.
        """
        values, declared = _flat(self), preset_parameters()
        return {
            name: declared[name].to_text(values[name]) if name in declared else json.dumps(values.get(name))
            for name in {**_flat_default(self.probe.kind), **values}
        }

    @classmethod
    def from_texts(cls, texts: Mapping[str, str], source: str = "preset") -> Preset:
        """The inverse of to_texts. Raises SimulationError that names `source` and the invalid value."""
        declared = {name: replace(entry, name=name) for name, entry in preset_parameters().items()}
        kind = declared[_KIND].from_text(source, texts.get(_KIND, probe_kind().default))
        values, nested = _flat_default(kind), {"tissues": {}}
        for name, text in texts.items():
            values[name] = (
                declared[name].from_text(source, text) if name in declared else _from_json(name, text, source)
            )
        for name, value in {**values, _KIND: kind}.items():
            section, _, entry = name.partition(".")
            if value is not None or name in declared:
                nested.setdefault(section, {})[entry] = value
        return cls.from_dict(nested, source)

    @classmethod
    @reader
    def read(cls, path: str | os.PathLike) -> Preset:
        """Read a preset from JSON. Raises SimulationError for a missing, unreadable or invalid file."""
        return cls.from_dict(read_json(path), str(path))

    def write(self, path: str | os.PathLike) -> None:
        """Write the preset as JSON; on failure an existing file is kept."""
        write_json(path, self.to_dict())


def preset_parameters() -> dict[str, Parameter]:
    """{"section.name": Parameter} of probe, display and settings; the probe's include those of all kinds."""
    found = {"probe.kind": probe_kind()}
    for kind in PROBE_KINDS.values():
        found |= {f"probe.{entry.name}": entry for entry in parameters_of(kind)}
    for section, owner in SECTIONS.items():
        found |= {f"{section}.{entry.name}": entry for entry in parameters_of(owner)}
    return found


def _flat(preset: Preset) -> dict[str, Any]:
    sections = {**preset.to_dict(), _POSE: {}}
    return {f"{section}.{name}": value for section, values in sections.items() for name, value in values.items()}


def _flat_default(kind: str) -> dict[str, Any]:
    return {**_flat(Preset(PROBES[kind])), _KIND: probe_kind().default}


def _from_json(name: str, text: str, source: str) -> Any:
    try:
        return json.loads(text)
    except ValueError as error:
        raise SimulationError(f"{source}: {name} is {short(text)}, which is not JSON ({error})") from None


def _check_section(section: str) -> None:
    require(
        section in ("probe", *SECTIONS), f"preset has no section {section!r}, expected probe, {' or '.join(SECTIONS)}"
    )


def _changed_probe(probe: Probe, values: dict) -> Probe:
    old = probe.to_dict()
    if "depth_mm" in values:
        default = type(probe).default_focus_mm(probe.depth_mm)
        old |= {name: None for name in ("focus_mm", "elevation_focus_mm") if old[name] == default}
    transmit = values.get("transmit", old["transmit"])
    if transmit != old["transmit"]:  # what was set for the other kind of transmission goes with it
        old |= {name: parameter_of(Probe, name).default for name, kind in TRANSMIT_OF.items() if kind != transmit}
    kind = values.get("kind", old["kind"])
    if kind != old["kind"]:
        probe_kind().checked("probe", kind)
        preset = PROBES[kind].to_dict() if kind in PROBES else {}
        known = preset | old
        old = {entry.name: known[entry.name] for entry in parameters_of(PROBE_KINDS[kind]) if entry.name in known}
    return probe_from_dict({**old, "kind": kind, **values}, "probe")
