"""--set NAME=VALUE: any parameter of probe, display, settings, tissues and membrane, by its name."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any

from SlicerUSSim.Logic.base.errors import SimulationError, either, require

if TYPE_CHECKING:
    from SlicerUSSim.Logic.base.declaration import Parameter
    from SlicerUSSim.Logic.imaging import Preset
    from SlicerUSSim.Logic.tissue import TissueTable

_MEMBRANE = "membrane"


@dataclass(frozen=True)
class Changes:
    """The changes of --set, with checked values."""

    #: {section of the preset: {parameter: value}}
    sections: dict[str, dict[str, Any]] = field(default_factory=dict)
    #: {tissue as written by the user: {parameter: value}}
    tissues: dict[str, dict[str, Any]] = field(default_factory=dict)
    membrane: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, texts: Iterable[str]) -> Changes:
        """From texts "section.parameter=value"; of several for one parameter the last one is used.

        Raises SimulationError for an unknown name, with similar names, and for invalid values.
        """
        changes = cls()
        for text in texts:
            name, equals, value = (part.strip() for part in text.partition("="))
            require(name.isprintable() and value.isprintable(), f"--set is {text!r}, expected NAME=VALUE as text")
            require(name and equals, f"--set is {text!r}, expected NAME=VALUE, such as display.gain_db=3")
            section, _, attribute = name.rpartition(".")
            parameter, place = changes._found(name, section, attribute)
            place[attribute] = parameter.from_text(f"--set {name}", value)
        return changes

    def _found(self, name: str, section: str, attribute: str) -> tuple[Parameter, dict[str, Any]]:
        """The parameter with a name, and the mapping for its value."""
        from SlicerUSSim.Logic.base.declaration import parameters_of
        from SlicerUSSim.Logic.imaging.preset import preset_parameters
        from SlicerUSSim.Logic.tissue.tissue import TISSUE_PARAMETERS, Membrane

        of_preset = preset_parameters()
        of_membrane = {entry.name: entry for entry in parameters_of(Membrane)}
        of_tissue = {entry.name: entry for entry in TISSUE_PARAMETERS}
        sections = list(dict.fromkeys(known.partition(".")[0] for known in of_preset))
        if name in of_preset:
            return of_preset[name], self.sections.setdefault(section, {})
        if section == _MEMBRANE and attribute in of_membrane:
            return of_membrane[attribute], self.membrane
        if section and section not in (*sections, _MEMBRANE) and attribute in of_tissue:
            return of_tissue[attribute], self.tissues.setdefault(section, {})
        of_preset |= {f"{_MEMBRANE}.{known}": entry for known, entry in of_membrane.items()}
        raise SimulationError(f"--set: no parameter {name!r}, expected {_hint(name, section, of_preset, of_tissue)}")

    @property
    def gives_geometry(self) -> bool:
        """Whether the geometry of the probe was set, and not only its beam."""
        from SlicerUSSim.Logic.base.declaration import parameters_of
        from SlicerUSSim.Logic.probe.arrays import Probe

        return not set(self.sections.get("probe", ())) <= {entry.name for entry in parameters_of(Probe)}

    def to_preset(self, preset: Preset) -> Preset:
        """The preset with probe, display and settings changed; its tissues are unchanged."""
        for section, values in self.sections.items():
            preset = preset.changed(section, **values)
        return preset

    def to_tissues(self, tissues: TissueTable) -> TissueTable:
        """The table with tissues and membrane changed. Raises SimulationError for an unknown tissue."""
        for written, values in self.tissues.items():
            tissues = tissues.replace(_owner(written, (tissue.name for tissue in tissues.all_tissues())), **values)
        if self.membrane:
            require(tissues.membrane is not None, "--set membrane: the tissue table has no membrane")
            values = self._membrane_of([tissue.name for tissue in tissues.all_tissues()])
            tissues = tissues.with_membrane(replace(tissues.membrane, **values))  # type: ignore[type-var]
        return tissues

    def check_tissues(self, known: Iterable[str]) -> None:
        """Raise SimulationError for a tissue that is not among these names."""
        known = list(known)
        for written in self.tissues:
            _owner(written, known)
        self._membrane_of(known)

    def _membrane_of(self, known: list[str]) -> dict[str, Any]:
        """The membrane's values; fluids are among these tissues and the presets, in their spelling."""
        from SlicerUSSim.Logic.tissue.presets import TISSUES

        if "fluids" not in self.membrane:
            return self.membrane
        fluids = [_owner(written, (*known, *TISSUES), "membrane.fluids: ") for written in self.membrane["fluids"]]
        return {**self.membrane, "fluids": tuple(dict.fromkeys(fluids))}


def _owner(written: str, known: Iterable[str], where: str = "") -> str:
    """The known tissue with this name, in other spelling if necessary; `where` is for the message."""
    from SlicerUSSim.Logic.tissue.names import same_name

    known = list(dict.fromkeys(known))
    for name in known:
        if same_name(name, written):
            return name
    near = get_close_matches(written, known, n=3)
    raise SimulationError(f"--set: {where}no tissue {written!r}, expected {either(near or known)}")


def _hint(name: str, section: str, of_preset: dict[str, Parameter], of_tissue: dict[str, Parameter]) -> str:
    """Similar names for an unknown parameter."""
    from SlicerUSSim.Logic.tissue.presets import TISSUES

    attribute = name.rpartition(".")[2]
    everything = [*of_preset, *(f"{tissue}.{known}" for tissue in TISSUES for known in of_tissue)]
    own = [known for known in everything if known.startswith(f"{section}.")]
    if own:
        return either(get_close_matches(name, own, n=3) or own)
    last = {known: known.rpartition(".")[2] for known in everything}
    parts = dict.fromkeys(last.values())
    near = [part for part in parts if attribute in part] or get_close_matches(attribute, parts, n=3)
    same = [known for name in near for known in everything if last[known] == name]
    sections = list(dict.fromkeys(known.partition(".")[0] for known in of_preset))
    return either(same[:3] or [*sections, "a tissue"])
