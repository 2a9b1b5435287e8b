"""`ussim volume`."""

from __future__ import annotations

from pathlib import Path

import click

from SlicerUSSim.Command.options import check_output, gathered
from SlicerUSSim.Command.patient_options import PatientOptions, open_examination_at, pose_option, say_contact
from SlicerUSSim.Command.progress import Share, note
from SlicerUSSim.Logic.base.errors import SimulationError


@click.command()
@gathered(patient=PatientOptions)
@pose_option
@click.option("-o", "--out", type=click.Path(path_type=Path), required=True, help="Volume: .nrrd .nii.gz .mha or .vti")
@click.option("--tilt", type=float, help="Tilt the image plane about the probe face over this total angle in degrees.")
@click.option(
    "--slide", type=float, help="Slide the probe across its image plane over this total distance in millimetres."
)
@click.option(
    "--frames", type=click.IntRange(1, 10_000), default=61, show_default=True, help="Number of images in the sweep."
)
@click.option("--spacing", type=float, default=0.5, show_default=True, help="Voxel size [mm].")
@click.option("--like", type=click.Path(), help="Use the voxel grid of this volume, such as the MRI.")
def volume(
    patient: PatientOptions, pose: str, out: Path, tilt: float | None, slide: float | None, frames: int,
    spacing: float, like: str | None,
) -> None:  # fmt: skip
    """Simulate a 3D ultrasound volume: a sweep of images around a pose, compounded in patient space."""
    from SlicerUSSim.Logic.base.own_outputs import write_own_volume
    from SlicerUSSim.Logic.base.volume import Volume
    from SlicerUSSim.Logic.probe.placement import slide_sweep, tilt_sweep

    check_output(out)
    if tilt is not None and slide is None:
        sweep, extent = tilt_sweep, tilt
    elif slide is not None and tilt is None:
        sweep, extent = slide_sweep, slide
    else:
        raise SimulationError("expected exactly one of --tilt DEGREES and --slide MILLIMETRES")
    grid = Volume.read(like) if like else None
    examination, middle = open_examination_at(patient, pose)
    poses = sweep(middle, extent, frames)
    say_contact(examination, examination.probe, poses)
    with Share("sweep") as progress:
        result = examination.simulator.volume(
            examination.probe, poses, examination.display, spacing_mm=spacing, like=grid,
            progress=lambda done: progress(done / frames),
        )  # fmt: skip
    write_own_volume(out, result)
    note(f"wrote {out} ({result.size_text} voxels from {frames} images)")
