"""Adopting the result of a fit in a preset, and taking it back later."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

from SlicerUSSim.Logic.fitting.tracked_fit import Fit
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.tissue.sheet_looks import DURA, DURA_KINDS, with_dura

#: Of a section that has no such value
_NONE = object()
#: What a section is about: with another one, its values are not compared one by one
_KINDS = ("name", "kind")
_SOURCES = "sources"


def with_fit(preset: Preset, found: Fit) -> Preset:
    """A preset with probe, display and tissues of a fit."""
    tissues = preset.tissues
    changed = set(found.appearance.parameters.varied())
    if found.speckle is not None:  # which gives tissues a texture
        changed |= {tissue.name for tissue in found.speckle.tissues.all_tissues() if tissue.texture_db > 0.0}
    if DURA in changed:  # of sheets that were found: under the label that it has in images
        tissues = with_dura(tissues, DURA_KINDS)
    for name in sorted(changed):
        tissues = tissues.with_tissue(found.appearance.tissues.tissue(name))
    return replace(preset, probe=found.tracked.probe, display=found.appearance.display, tissues=tissues)


def taken_back(before: Preset, adopted: Preset, now: Preset) -> tuple[Preset, list[str]]:
    """(`now` with the values that came from `before` to `adopted` as they were before, names of the others).

    Values that were changed since `adopted` stay, and are named, as "csf mu0". Raises SimulationError if values of
    before do not go together with those that stay.
    """
    if now == adopted:
        return before, []
    kept: list[str] = []
    merged = _merged(_plain(before), _plain(adopted), _plain(now), (), kept)
    return Preset.from_dict(merged), list(dict.fromkeys(kept))


def _plain(preset: Preset) -> dict[str, Any]:
    return json.loads(json.dumps(preset.to_dict()))


def _merged(before: Any, adopted: Any, now: Any, called: tuple[str, ...], kept: list[str]) -> Any:
    """The value to be used, _NONE for none; appends what was changed since to `kept`."""
    if now == adopted:
        return before
    sections = [value for value in (before, adopted, now) if isinstance(value, dict)]
    if len(sections) == 3 and all(value.get(kind) == now.get(kind) for value in sections for kind in _KINDS):
        found = {}
        for name in dict.fromkeys([*before, *now]):
            was, came, has = (value.get(name, _NONE) for value in (before, adopted, now))
            value = _merged(was, came, has, _called(called, name, now), kept)
            if value is not _NONE:
                found[name] = value
        return found
    if _SOURCES not in called and now != before:
        kept.append(" ".join(called))
    return now


def _called(called: tuple[str, ...], name: str, section: dict[str, Any]) -> tuple[str, ...]:
    """The words for a value of a section: tissues by their names, and not by their labels."""
    entry = section.get(name)
    if called == ("tissues",) and isinstance(entry, dict):
        return (str(entry.get("name", name)),)
    return (*called, name)
