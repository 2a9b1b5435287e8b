"""docs/parameters.md agrees with the declarations.

    python -m tests.test_parameter_docs

generates it from them.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import get_args, get_origin

import click

from SlicerUSSim.Command.cli import main
from SlicerUSSim.Command.options import rare_keys
from SlicerUSSim.Logic.base.declaration import Declared, Parameter, parameters_of
from SlicerUSSim.Logic.base.settings import DisplaySettings, SimulationSettings
from SlicerUSSim.Logic.datasets.recipe import LesionSettings, PatientSettings, PoseSettings, SetSettings
from SlicerUSSim.Logic.fitting.fit_settings import FitSettings
from SlicerUSSim.Logic.fitting.image_similarity import SimilaritySettings
from SlicerUSSim.Logic.mri.segmentation_settings import SegmentationSettings, SheetSettings
from SlicerUSSim.Logic.mrml.parameter_node import PanelSettings
from SlicerUSSim.Logic.placement.approach_weights import ApproachWeights
from SlicerUSSim.Logic.probe.arrays import PROBE_KINDS, Probe, probe_kind
from SlicerUSSim.Logic.probe.beam import Beam
from SlicerUSSim.Logic.tissue.tissue import Membrane, Tissue

PAGE = Path(__file__).parents[1] / "docs" / "parameters.md"
INTRODUCTION = """# Parameters

This page lists all parameters. `python -m tests.test_parameter_docs` generates it from their declarations in the code.

```bash
ussim simulate labels.nii.gz --pose auto --set probe.depth_mm=70 --set "white matter.mu0=0.5" -o image.png
```

A preset is a JSON file with the objects `probe`, `display`, `settings`, `tissues` (by label, `"1"` to `"62"`, and `"0"`
for the coupling medium) and `membrane`. `probe_to_ras`, four rows of four numbers, is the pose of the probe, which
`--pose` also reads. `ussim demo` and the panels write presets; `--preset` and the panels read them. Types are strict:
`true` and `"5"` are not numbers, 3.0 is not a whole number, and unknown names are errors. *None* is `null` in JSON.

In the command, `--set` changes any parameter of probe, display, settings, membrane, tissues, segmentation and fit, by
the name of the section or tissue: `--set settings.max_ray_depth=4`, `--set "white matter.mu0=0.5"`. Parameters that are
often changed also have an option, which `--help` lists. `--set` overrides options, and they override `--preset`. A
preset of the command may also have the objects `segmentation`, `fit`, `patient`, `recording` and `results`; the last
three have the [keys of the command](#command).

A bold text is the label of a field in the panels, if it differs from the name. Parameters without values are `true` or
`false`. *Fit* has the bounds and the tolerance of a [fit](optimization.md). `n` stands for a number.
"""
#: (heading, declared class, description)
SECTIONS: list[tuple[str, type[Declared], str]] = [
    ("Probe", Probe, "Parameters of all kinds of probe; `probe` in a preset."),
    *((f"{name.capitalize()} probe", kind, f"{(kind.__doc__ or '').splitlines()[0]}") for name, kind in
      PROBE_KINDS.items()),
    ("Display", DisplaySettings, "Settings of a scanner's console; `display` in a preset."),
    ("Settings", SimulationSettings, "Settings of the acoustic model; `settings` in a preset."),
    ("Tissues", Tissue, "`tissues` in a preset, one object for each label. [physics.md](physics.md#5-scatterers) "
     "describes the model; [presets.py](../SlicerUSSim/Logic/tissue/presets.py) has the presets and the source of "
     "every value."),
    ("Membrane", Membrane, "A thin rough sheet along the border between fluid and brain; `membrane` in a preset. "
     "Its `tissue` is an object as in [Tissues](#tissues)."),
    ("Segmentation", SegmentationSettings, "Segmentation of an MRI into tissues; `segmentation` in a preset of the "
     "command."),
    ("Sheets", SheetSettings, "Sheets and vessels of a scene, in Slicer and on the page; commands have `--sheets` "
     "([sheets.md](sheets.md))."),
    ("Fit", FitSettings, "Fit of simulated to real images ([optimization.md](optimization.md)); `fit` in the preset of "
     "`ussim optimize`."),
    ("Approach", ApproachWeights, "Weights of the cost of paths to a target ([approach.md](approach.md)); `approach` "
     "in the preset of `ussim approach` and `ussim simulate --approach`."),
    ("Similarity", SimilaritySettings, "The cost of a fit ([optimization.md](optimization.md#cost-function)); set in "
     "Python only."),
    ("Recipe", SetSettings, "Of a data set, before the tables of its recipe ([datasets.md](datasets.md))."),
    *((f"Recipe: {name}", kind, f"{(kind.__doc__ or '').splitlines()[0]}") for name, kind in
      (("patients", PatientSettings), ("pose", PoseSettings), ("lesions", LesionSettings))),
    ("Panel", PanelSettings, "Further values of the panel that are saved with a scene ([slicer.md](slicer.md))."),
]  # fmt: skip


def page() -> str:
    """The page, generated from the declarations."""
    parts = [INTRODUCTION]
    for heading, kind, text in SECTIONS:
        entries = list(parameters_of(kind))
        if kind is Probe:
            entries = [replace(probe_kind(), is_required=True), *entries]
        elif issubclass(kind, Probe):
            shared = {entry.name for entry in parameters_of(Probe)}
            entries = [entry for entry in entries if entry.name not in shared]
        parts.append(f"## {heading}\n\n{text}\n\n{table(entries)}")
    keys: dict[str, str] = {}
    shown = {option.name for command in main.commands.values() for option in command.params}
    for command in main.commands.values():
        for key, known in rare_keys(command).items():
            if known.entry is None and known.option.name not in shown and isinstance(known.option, click.Option):
                keys[key] = f"| `{key}` | {(known.option.help or '').replace('|', chr(92) + '|')} |\n"
    parts.append(f"## Command\n\nFor `--set`.\n\n| Key | Description |\n| --- | --- |\n{''.join(keys.values())}")
    return "\n".join(parts)


def table(entries: list[Parameter]) -> str:
    """One row for each parameter, or for several numbered ones, without empty columns."""
    columns: dict[str, Callable[[Parameter], str]] = {
        "Name": lambda entry: f"`{entry.name}`",
        "Description": description,
        "Values": values,
        "Default": default,
        "Fit": fit,
    }
    rows = [[column(entry).replace("|", r"\|") for column in columns.values()] for entry in entries]
    rows = list(dict.fromkeys(tuple(re.sub(r"(?<=_)\d(?=_)|\d(?= of \d)", "n", cell) for cell in row) for row in rows))
    kept = [place for place in range(len(columns)) if any(row[place] for row in rows)]
    rows = [tuple(columns), ("---",) * len(columns), *rows]
    return "".join(f"| {' | '.join(row[place] for place in kept)} |\n" for row in rows)


def description(entry: Parameter) -> str:
    label = f"{entry.label} {entry.symbol}".strip()
    is_name = re.sub("_(mm|deg|db|mhz)$", "", entry.name).replace("_", " ") == label.lower()
    more = " ".join(f"{text}." for text in (entry.note, entry.source) if text)
    return ("" if is_name else f"**{label}**: ") + f"{entry.tip}." + (f" {more}" if more else "")


def values(entry: Parameter) -> str:
    kind = get_origin(entry.type) or entry.type
    between = "" if entry.bounds is None else f"{entry.bounds[0]:.10g} to {entry.bounds[1]:.10g}"
    if entry.choices:
        text = ", ".join(f"`{choice}`" for choice in entry.choices)
    elif kind is tuple and between:
        elements = get_args(entry.type)
        text = f"{len(elements)} {'numbers' if float in elements else 'whole numbers'}, {between}"
    elif kind is tuple:
        text = "texts"
    else:
        of_bool = "true, false" if entry.can_be_none else ""
        text = {bool: of_bool, int: f"whole, {between}", float: between, str: "text"}.get(kind, "object of texts")
    text = f"{text} {entry.unit}".strip()
    return f"{text}, none" if entry.can_be_none else text


def default(entry: Parameter) -> str:
    if entry.is_required:
        return "required"
    value = entry.default
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return ", ".join(map(str, value))
    if value is None:
        return "none" if entry.can_be_none else "empty"
    return f"{value:.10g}" if isinstance(value, int | float) else value or "empty"


def fit(entry: Parameter) -> str:
    if entry.fit is None:
        return ""
    scale = "logarithmic " if entry.fit.is_logarithmic else ""
    return f"{scale}{entry.fit.low:g} to {entry.fit.high:g} ± {entry.fit.tolerance:g}"


def test_the_page_agrees_with_the_declarations():
    assert PAGE.read_text(encoding="utf-8") == page(), "run python -m tests.test_parameter_docs to generate it"


def test_every_declared_class_is_on_the_page():
    def below(kind: type) -> set[type]:
        return {kind}.union(*map(below, kind.__subclasses__()))

    # A Beam is the part of a Probe that has a separate file.
    ours = {kind for kind in below(Declared) - {Declared, Beam} if kind.__module__.startswith("SlicerUSSim.Logic")}
    assert ours == {kind for _, kind, _ in SECTIONS}


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
