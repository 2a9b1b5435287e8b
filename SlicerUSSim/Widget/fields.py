"""The values of a preset as a panel shows them: one number, tick or choice each, in the unit a user expects."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import log10
from typing import Any

from SlicerUSSim.Logic.imaging.preset import Preset

#: At or below this a noise level means none.
NO_NOISE_DB = -150.0


@dataclass(frozen=True)
class PresetField:
    """How a value of the preset is shown, and read back."""

    shown: Callable[[Any], Any] = lambda value: value
    meant: Callable[[Any], Any] = lambda value: value


def _db(amplitude: float) -> float:
    return 20.0 * log10(amplitude)


def _amplitude(db: float) -> float:
    return 10.0 ** (db / 20.0)


_PLAIN = PresetField()
_WHOLE = PresetField(meant=round)
_LEVEL = PresetField(_db, _amplitude)

#: By "section.name" of the preset.
FIELDS: dict[str, PresetField] = {
    "probe.kind": _PLAIN,
    "probe.width_mm": _PLAIN,
    "probe.radius_mm": _PLAIN,
    "probe.field_of_view_deg": _PLAIN,
    "probe.depth_mm": _PLAIN,
    "probe.frequency_mhz": _PLAIN,
    "probe.scan_lines": _WHOLE,
    "probe.focus_mm": PresetField(meant=lambda value: value or None),  # 0 is the default place
    "display.gain_db": _PLAIN,
    "display.dynamic_range_db": _PLAIN,
    "display.tgc_db_cm_mhz": _PLAIN,
    "display.noise_db": PresetField(
        lambda value: NO_NOISE_DB if value is None else value, lambda value: None if value <= NO_NOISE_DB else value
    ),
    "settings.seed": _WHOLE,
    "settings.reference_speed_m_s": _PLAIN,
    "settings.scattering": _PLAIN,
    "settings.interfaces": _PLAIN,
    "settings.reflections": _PLAIN,
    "settings.max_ray_depth": _WHOLE,
    "settings.intensity_threshold": _LEVEL,
    "settings.reflection_threshold": _LEVEL,
    "settings.elevational_rays": _WHOLE,
    "settings.partial_volume": _PLAIN,
    "settings.mri_modulation_db": _PLAIN,
}


def field_value(preset: Preset, name: str):
    """What a panel shows for a field, or None if the probe has no such value."""
    section, attribute = name.split(".")
    owner = getattr(preset, section)
    if name == "probe.kind":
        return owner.to_dict()["kind"]
    if not hasattr(owner, attribute):
        return None
    return FIELDS[name].shown(getattr(owner, attribute))


def with_field(preset: Preset, name: str, value) -> Preset:
    """The preset with what a panel says about a field. Raises SimulationError for a value out of range."""
    section, attribute = name.split(".")
    return preset.changed(section, **{attribute: FIELDS[name].meant(value)})
