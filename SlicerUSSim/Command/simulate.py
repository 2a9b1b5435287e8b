"""`ussim simulate`, `ussim approach`, `ussim sweep` and `ussim volume`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from SlicerUSSim.Command.options import check_outputs, gathered, out_option, overwrite_option
from SlicerUSSim.Command.patient_options import (
    RARE,
    RARE_BESIDE,
    PatientOptions,
    open_examination,
    open_examination_at,
    pose_option,
    pose_or_approach,
    say_contact,
    target_of,
)
from SlicerUSSim.Command.progress import Share, note
from SlicerUSSim.Command.sequence_options import RARE_OF_SEQUENCE, SequenceOptions, open_tracked
from SlicerUSSim.Logic.base.declaration import parameters_of
from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.placement.approach_weights import NO_ADVICE, ApproachWeights

_WEIGHTS = " ".join(entry.name for entry in parameters_of(ApproachWeights))


@click.command()
@gathered(f"{RARE} {_WEIGHTS}", patient=PatientOptions, approach=ApproachWeights)
@pose_or_approach
@click.option(
    "--approach", "what", metavar="TISSUE|R,A,S", help="In place of a pose: the first candidate of an approach to "
    "this lesion or point (mm), through its opening in a whole head (see `ussim approach`).",
)  # fmt: skip
@out_option("Image: .png .mha .nrrd .nii.gz or .vti")
@overwrite_option
def simulate(patient: PatientOptions, approach: ApproachWeights, pose: str | None, what: str | None, out: Path) -> None:
    """Simulate one B-mode image from an MRI or a label map at a given pose."""
    from SlicerUSSim.Logic.base.volume import require_image_name
    from SlicerUSSim.Logic.imaging.figures import write_png

    require_image_name(out, also=(".png",))
    check_outputs(out)
    require((pose is None) != (what is None), "expected exactly one of --pose and --approach")
    at = (what, approach) if pose is None else pose
    examination, probe_to_ras = open_examination_at(patient, at, one_image=True)
    say_contact(examination, examination.probe, [probe_to_ras])
    frame = examination.simulator.simulate(examination.probe, probe_to_ras, examination.display)
    if out.suffix.lower() == ".png":
        write_png(out, frame.image)
    else:
        frame.to_volume().write(out)
    note(f"wrote {out} ({frame.image.shape[1]}x{frame.image.shape[0]})")


@click.command()
@gathered(f"{RARE} seed {_WEIGHTS}", patient=PatientOptions, approach=ApproachWeights)
@click.option(
    "--target", metavar="TISSUE|R,A,S", help="What is to be seen: a tissue, or a point in mm (default: the largest "
    "lesion).",
)  # fmt: skip
@out_option("Report: .html")
@overwrite_option
def approach(patient: PatientOptions, approach: ApproachWeights, target: str | None, out: Path) -> None:
    """Plan from where a probe sees a lesion best: candidates with paths, openings and images. No medical advice."""
    from SlicerUSSim.Logic.imaging.approach_images import simulated_approach, write_approach_report
    from SlicerUSSim.Logic.placement.approach import plan_approach

    require(out.suffix.lower() == ".html", f"--out is {str(out)!r}, expected a file .html")
    check_outputs(out)
    what = target_of(target)
    require(patient.craniotomy == "none", f"--craniotomy is {patient.craniotomy}, expected none: the plan opens a head")
    examination = open_examination(patient)
    simulator, probe = examination.simulator, examination.probe
    names = simulator.medium.tissues.names_by_label()
    plan = plan_approach(simulator.medium.labels, names, probe, what, weights=approach)
    plan = simulated_approach(plan, simulator, probe, examination.display)
    write_approach_report(out, plan, patient.source)
    for line in (plan.target.text, *(candidate.text for candidate in plan.candidates), NO_ADVICE):
        click.echo(line)
    note(f"wrote {out} ({len(plan.candidates)} candidates)")


@click.command()
@gathered(f"{RARE} {RARE_OF_SEQUENCE} skull_strip tissues seed", patient=PatientOptions, recording=SequenceOptions)
@out_option("Sequence: .igs.mha .seq.mha or .nrrd")
@overwrite_option
def sweep(patient: PatientOptions, recording: SequenceOptions, out: Path) -> None:
    """Simulate the images of a tracked sequence, at its poses and on its pixels."""
    import numpy as np

    from SlicerUSSim.Logic.tracked.sequence import SIMULATED, require_sequence_name

    require_sequence_name(out)
    check_outputs(out, recording.field)
    # The real images are not compared: what is drawn over them is seen in the figure of --field alone
    tracked = open_tracked(patient, recording, finds_marks=recording.field is not None)
    simulator, display = tracked.examination.simulator, tracked.examination.display
    real = tracked.images
    rows, columns = real.field.mask.shape
    simulated = np.zeros((len(real.poses), rows, columns), np.uint8)
    with Share("sweep") as progress:
        for place, (number, pose) in enumerate(zip(real.numbers, real.poses, strict=True)):
            frame = simulator.simulate(real.probe, pose, display, real.grid, noise_seed=number)
            simulated[place][real.field.window] = frame.image
            progress((place + 1) / len(real.poses))
    sequence = tracked.sequence.with_images(real.numbers, simulated)
    replace(sequence, fields={**sequence.fields, SIMULATED: "sweep"}).write(out)
    figure = f", {recording.field}" if recording.field else ""
    note(f"wrote {out} ({len(simulated)} images of {columns}x{rows}){figure}")


@click.command()
@gathered(f"{RARE} {RARE_BESIDE}", patient=PatientOptions)
@pose_option
@out_option("Volume: .nrrd .nii.gz .mha or .vti")
@click.option("--tilt", type=float, help="Tilt the image plane about the probe face over this total angle in degrees.")
@click.option(
    "--slide", type=float, help="Slide the probe across its image plane over this total distance in millimetres."
)
@click.option(
    "--frames", type=click.IntRange(1, 10_000), default=61, show_default=True, help="Number of images in the sweep."
)
@click.option("--spacing", type=float, default=0.5, show_default=True, help="Voxel size [mm].")
@click.option("--like", type=click.Path(), help="Use the voxel grid of this volume, such as the MRI.")
@overwrite_option
def volume(
    patient: PatientOptions, pose: str, out: Path, tilt: float | None, slide: float | None, frames: int,
    spacing: float, like: str | None,
) -> None:  # fmt: skip
    """Simulate a 3D ultrasound volume: a sweep of images around a pose, compounded in patient space."""
    from SlicerUSSim.Logic.base.volume import Volume, require_image_name
    from SlicerUSSim.Logic.probe.poses import slide_sweep, tilt_sweep

    require_image_name(out)
    check_outputs(out)
    require((tilt is None) != (slide is None), "expected exactly one of --tilt DEGREES and --slide MILLIMETRES")
    poses_around, extent = (slide_sweep, slide or 0.0) if tilt is None else (tilt_sweep, tilt)
    grid = Volume.read(like) if like else None
    examination, middle = open_examination_at(patient, pose)
    poses = poses_around(middle, extent, frames)
    say_contact(examination, examination.probe, poses)
    with Share("sweep") as progress:
        result = examination.simulator.volume(
            examination.probe, poses, examination.display, spacing_mm=spacing, like=grid,
            progress=lambda done: progress(done / frames),
        )  # fmt: skip
    result.write(out)
    note(f"wrote {out} ({result.size_text} voxels from {frames} images)")
