"""`ussim demo`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import click

from SlicerUSSim.Command.additions import Additions
from SlicerUSSim.Command.mri_options import MriOptions, read_mri, segmented_file
from SlicerUSSim.Command.options import (
    check_results,
    declared,
    declared_parameters,
    gathered,
    out_option,
    overwrite_option,
    results_of,
)
from SlicerUSSim.Command.patient_options import RARE, named_probe
from SlicerUSSim.Command.progress import note
from SlicerUSSim.Command.set_option import Changes
from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.settings import SimulationSettings


@dataclass(frozen=True)
class DemoOptions(MriOptions):
    """Patient and probe of the demo."""

    mri: str | None = declared("--mri", type=click.Path(), help="MRI of a head or a brain (default: the MNI152 brain).")
    probe: str = declared(
        "--probe", default="phased", show_default=True, metavar="NAME|PATH", help="Name of a probe, or one as JSON."
    )
    settings: Mapping[str, Any] = declared_parameters(SimulationSettings, of_preset=True)


#: Files of the results; the last says what was done
_RESULTS = (
    "figure.png", "mri.png", "labels.png", "bmode.png", "bmode.mha", "labels.nii.gz", "labels.json", "pose.json",
    "preset.json", "demo.json",
)  # fmt: skip


@click.command()
@out_option("Folder for the results.", default="ussim-demo", show_default=True)
@gathered(f"{RARE} outside maps organs", patient=DemoOptions)
@overwrite_option
def demo(out: Path, patient: DemoOptions) -> None:
    """Segment a brain MRI, simulate a view through a craniotomy, and write figures."""
    from SlicerUSSim.Logic.base.files import write_json
    from SlicerUSSim.Logic.imaging.figures import draw_views, require_matplotlib, write_png
    from SlicerUSSim.Logic.imaging.preset import Preset
    from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
    from SlicerUSSim.Logic.mri.samples import demo_mri
    from SlicerUSSim.Logic.mri.segmentation import Segmentation
    from SlicerUSSim.Logic.probe.poses import craniotomy_pose, slice_under_probe
    from SlicerUSSim.Logic.tissue.table import TissueTable, write_label_files
    from SlicerUSSim.Logic.tracked.pose_files import write_pose

    check_results(out, _RESULTS)
    require_matplotlib()  # before the computation, not after it
    changes = Changes.of(patient.changes)
    preset = changes.to_preset(Preset(named_probe(patient.probe)).changed("settings", **patient.settings))
    masks, probe, path = Additions.read(patient.additions), preset.probe, patient.mri
    if path is None:
        mri, source = demo_mri()
    else:
        mri = read_mri(path, patient)
        patient = patient.for_image(mri)
        require(not patient.is_ct, f"{path}: is a CT, expected an MRI; use ussim simulate")
        source = os.path.abspath(path)
    note(f"MRI: {source}, {mri.size_text} voxels")
    note("segment the MRI ...")
    start = perf_counter()
    found = segmented_file(path or mri.name, mri, patient, tell_all=True, is_file=path is not None)
    assert isinstance(found, Segmentation)
    seconds = perf_counter() - start

    note("build the acoustic medium ...")
    added = masks.on(found.labels, found.tissue_names, has_brain_mask=True)
    labels, names = added.labels, added.tissue_names
    table = replace(found, labels=labels, tissue_names=names).table().splitlines()
    for line in table:
        note(line)
    tissues = changes.to_tissues(TissueTable.brain(names))
    simulator = UltrasoundSimulator(labels, tissues, preset.settings, patient.device)
    pose = craniotomy_pose(labels, probe, target_ras=added.centre_ras(found.labels))

    note("simulate ...")
    simulator.profiling = True
    simulator.simulate(probe, pose, preset.display)  # builds kernels
    frames = [simulator.simulate(probe, pose, preset.display) for _ in range(3)]
    frame = frames[-1]
    stages = {stage: round(min(f.timings_ms[stage] for f in frames), 3) for stage in frame.timings_ms}

    with results_of(out) as folder:
        note("draw ...")
        bounds = probe.image_bounds_mm()
        seen = ("MRI under the probe", slice_under_probe(mri, frame.grid, pose), "mri")
        labelled = ("Tissues", slice_under_probe(labels, frame.grid, pose, order=0), "labels")
        simulated = ("Simulated B-mode", frame.image, "bmode")
        draw_views(folder / "figure.png", [seen, labelled, simulated], probe, bounds, names)
        draw_views(folder / "mri.png", [seen], probe, bounds, names)
        draw_views(folder / "labels.png", [labelled], probe, bounds, names)

        note("write ...")
        write_png(folder / "bmode.png", frame.image)
        frame.to_volume().write(folder / "bmode.mha")
        write_label_files(folder / "labels.nii.gz", labels, tissues)
        write_pose(folder / "pose.json", pose)
        preset = replace(preset, tissues=tissues)
        preset.write(folder / "preset.json")
        summary = {
            "mri": source, "device": str(simulator.device.info), "probe_to_ras": pose.tolist(), **preset.to_dict(),
            "segmentation": [*found.notes, *added.messages, *table], "segmentation_seconds": round(seconds, 3),
            "milliseconds_per_stage": stages,
        }  # fmt: skip
        write_json(folder / "demo.json", summary)
    note(f"device: {simulator.device.info}")
    note(f"segmentation {1e3 * seconds:.0f} ms, one frame {sum(stages.values()):.1f} ms")
    note(f"wrote {out / 'figure.png'} and nine more files in this folder")
    click.echo(out / "figure.png")
