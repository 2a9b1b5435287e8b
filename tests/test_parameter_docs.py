"""docs/parameters.md says what the declarations say.

    python -m tests.test_parameter_docs

writes it again from them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import get_args, get_origin

from SlicerUSSim.Logic.base.declaration import Declared, Parameter, parameters_of
from SlicerUSSim.Logic.base.settings import DisplaySettings, SimulationSettings
from SlicerUSSim.Logic.fitting.image_similarity import SimilaritySettings
from SlicerUSSim.Logic.fitting.settings import FitSettings
from SlicerUSSim.Logic.mri.settings import SegmentationSettings
from SlicerUSSim.Logic.probe.arrays import PROBE_KIND, PROBE_KINDS, Probe
from SlicerUSSim.Logic.tissue.tissue import Membrane, Tissue

PAGE = Path(__file__).parents[1] / "docs" / "parameters.md"
INTRODUCTION = """# Parameters

All that can be set, as the sources declare it: `python -m tests.test_parameter_docs` writes this page from there. One
declaration per parameter makes its checks, its place in a preset, its option, its field in the panel and on the page,
and the bounds of its fit.

A preset is a JSON file with the objects `probe`, `display`, `settings`, `tissues` (by label, `"1"` to `"62"`, and `"0"`
for the coupling medium) and `membrane`; `ussim demo` and the panels write one, `--preset` and the panels read it. Types
are strict: `true` is no number, `"5"` is no 5, 3.0 is no whole number, and names that are not in these tables are
refused. *None* is `null` in JSON.

In the command, `--set` changes any parameter of probe, display, settings, membrane and tissues, by the name of the
section or tissue, a dot and the name of the parameter: `--set settings.max_ray_depth=4`, `--set probe.depth_mm=70`,
`--set "white matter.mu0=0.5"`. Those with an option of their own have it in the last column. `--set` goes before
options, options before `--preset`.
"""
#: (heading, declared classes, what to know of them)
SECTIONS: list[tuple[str, type[Declared], str]] = [
    ("Probe", Probe, "What all kinds share; `probe` in a preset."),
    *((f"{name.capitalize()} probe", kind, f"{(kind.__doc__ or '').splitlines()[0]}") for name, kind in
      PROBE_KINDS.items()),
    ("Display", DisplaySettings, "`display` in a preset: what a scanner's console does to the echoes."),
    ("Settings", SimulationSettings, "`settings` in a preset: what the physics needs beside tissues, probe and pose."),
    ("Tissues", Tissue, "`tissues` in a preset, one object for each label. [physics.md](physics.md#5-scatterers) has "
     "the model; the presets and the source of every number are in "
     "[presets.py](../SlicerUSSim/Logic/tissue/presets.py)."),
    ("Membrane", Membrane, "`membrane` in a preset: a thin scattering layer along the border between fluid and brain. "
     "Its `tissue` is an object as in [Tissues](#tissues)."),
    ("Segmentation", SegmentationSettings, "How an MRI becomes tissues: `ussim segment`, `segment_mri` and the VTK "
     "filter."),
    ("Fit", FitSettings, "How simulated images are fitted to real ones ([optimization.md](optimization.md)); "
     "`ussim optimize` has `--frames` and `--free` for the first two."),
    ("Similarity", SimilaritySettings, "How alike two images are ([optimization.md](optimization.md#the-cost)), in "
     "Python alone."),
]  # fmt: skip


def page() -> str:
    """The page as the declarations have it."""
    parts = [INTRODUCTION]
    for heading, kind, text in SECTIONS:
        entries = list(parameters_of(kind))
        if kind is Probe:
            entries = [replace(PROBE_KIND, is_required=True), *entries]
        elif issubclass(kind, Probe):
            shared = {entry.name for entry in parameters_of(Probe)}
            entries = [entry for entry in entries if entry.name not in shared]
        parts.append(f"## {heading}\n\n{text}\n\n{table(entries)}")
    return "\n".join(parts)


def table(entries: list[Parameter]) -> str:
    """One row for each; columns that would be empty are left out."""
    columns: dict[str, Callable[[Parameter], str]] = {
        "Name": lambda entry: f"`{entry.name}`",
        "What it is": what_it_is,
        "Unit": lambda entry: entry.unit,
        "Values": values,
        "Default": default,
        "Fit: bounds": fit_bounds,
        "Fit: tolerance": lambda entry: f"± {entry.fit.tolerance:g}" if entry.fit else "",
        "Option": lambda entry: " ".join(f"`--{name}`" for name in (entry.option or "").split("/") if name),
    }
    cells = {name: [column(entry).replace("|", r"\|") for entry in entries] for name, column in columns.items()}
    cells = {name: column for name, column in cells.items() if any(column)}
    rows = [list(cells), ["---"] * len(cells), *map(list, zip(*cells.values(), strict=True))]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def what_it_is(entry: Parameter) -> str:
    symbol = f" {entry.symbol}" if entry.symbol else ""
    more = " ".join(f"{text}." for text in (entry.note, entry.source) if text)
    return f"**{entry.label}{symbol}**: {entry.tip}." + (f" {more}" if more else "")


def values(entry: Parameter) -> str:
    kind = get_origin(entry.type) or entry.type
    between = "" if entry.bounds is None else f"{entry.bounds[0]:.10g} to {entry.bounds[1]:.10g}"
    if entry.choices:
        text = ", ".join(f"`{choice}`" for choice in entry.choices)
    elif kind is tuple and between:
        text = f"{len(get_args(entry.type))} whole numbers, {between}"
    elif kind is tuple:
        text = "texts"
    else:
        text = {bool: "true, false", int: f"whole, {between}", float: between, str: "text"}.get(kind, "object of texts")
    return f"{text}, none" if entry.can_be_none else text


def default(entry: Parameter) -> str:
    if entry.is_required:
        return "has to be given"
    value = entry.default
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return ", ".join(map(str, value))
    if value is None:
        return "none" if entry.can_be_none else "empty"
    return f"{value:.10g}" if isinstance(value, int | float) else value or "empty"


def fit_bounds(entry: Parameter) -> str:
    if entry.fit is None:
        return ""
    return f"{entry.fit.low:g} to {entry.fit.high:g}{', logarithmic' if entry.fit.is_logarithmic else ''}"


def test_the_page_says_what_is_declared():
    assert PAGE.read_text(encoding="utf-8") == page(), "python -m tests.test_parameter_docs writes it again"


def test_every_declared_class_is_on_the_page():
    def below(kind: type) -> set[type]:
        return {kind}.union(*map(below, kind.__subclasses__()))

    ours = {kind for kind in below(Declared) - {Declared} if kind.__module__.startswith("SlicerUSSim.Logic")}
    # What only a scene remembers is imported with Slicer's libraries, and is no parameter of images.
    ours = {kind for kind in ours if not kind.__module__.startswith("SlicerUSSim.Logic.mrml")}
    assert ours == {kind for _, kind, _ in SECTIONS}


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
