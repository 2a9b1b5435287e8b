"""`ussim demo`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from SlicerUSSim.Command.additions import Additions
from SlicerUSSim.Command.mri_options import MriOptions, read_mri
from SlicerUSSim.Command.options import check_results, declared, declared_parameters, gathered, out_option
from SlicerUSSim.Command.patient_options import RARE, named_probe
from SlicerUSSim.Command.progress import Steps, note
from SlicerUSSim.Command.set_option import Changes
from SlicerUSSim.Logic.base.settings import SimulationSettings


@dataclass(frozen=True)
class DemoOptions(MriOptions):
    """Patient and probe of the demo."""

    mri: str | None = declared(
        "--mri", type=click.Path(), help="MRI of a head or a brain (default: the MNI152 brain of nilearn)."
    )
    probe: str = declared(
        "--probe", default="phased", show_default=True, metavar="NAME|PATH", help="Name of a probe, or one as JSON."
    )
    settings: Mapping[str, Any] = declared_parameters(SimulationSettings, of_preset=True)


@click.command()
@out_option("Folder for the results.", default="ussim-demo", show_default=True)
@gathered(f"{RARE} outside maps organs", patient=DemoOptions)
def demo(out: Path, patient: DemoOptions) -> None:
    """Segment a brain MRI, simulate a view through a craniotomy, and write figures."""
    from SlicerUSSim.Command.whole_line import RESULTS, SUMMARY, run_whole_line
    from SlicerUSSim.Logic.imaging.preset import Preset
    from SlicerUSSim.Logic.mri.samples import demo_mri

    check_results(out, RESULTS, SUMMARY)
    preset = Preset(named_probe(patient.probe)).changed("settings", **patient.settings)
    preset = Changes.of(patient.changes).to_preset(preset)
    masks = Additions.read(patient.additions)
    if patient.mri is None:
        volume, source = demo_mri()
    else:
        volume = read_mri(patient.mri, mask=patient.mask, skull_strip=patient.segmentation.skull_strip)
        source = os.path.abspath(patient.mri)
    note(f"MRI: {source}, {volume.size_text} voxels")
    with Steps(5) as step:
        summary = run_whole_line(out, volume, source, preset, patient, masks, step)
    times = summary["milliseconds"]
    note(f"device: {summary['device']}")
    note(f"segmentation {times['segmentation']:.0f} ms, one frame {times['frame']:.1f} ms")
    note(f"wrote {out / 'figure.png'} and nine more files in this folder")
    click.echo(out / "figure.png")
