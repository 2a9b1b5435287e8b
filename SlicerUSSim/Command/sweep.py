"""`ussim sweep`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from SlicerUSSim.Command.options import check_outputs, gathered
from SlicerUSSim.Command.patient_options import PatientOptions
from SlicerUSSim.Command.progress import Share, note
from SlicerUSSim.Command.sequence_options import SequenceOptions, open_tracked


@click.command()
@gathered(patient=PatientOptions, recording=SequenceOptions)
@click.option(
    "-o", "--out", type=click.Path(path_type=Path), required=True, help="Sequence: .igs.mha .seq.mha .mhd or .nrrd"
)
def sweep(patient: PatientOptions, recording: SequenceOptions, out: Path) -> None:
    """Simulate the images of a tracked sequence, at its poses and on its pixels."""
    import numpy as np

    from SlicerUSSim.Logic.base.own_outputs import mark_of
    from SlicerUSSim.Logic.base.volume import MADE_BY
    from SlicerUSSim.Logic.tracked.sequence import require_sequence_name

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
    replace(sequence, fields={**sequence.fields, MADE_BY: mark_of(simulated)}).write(out)
    figure = f", {recording.field}" if recording.field else ""
    note(f"wrote {out} ({len(simulated)} images of {columns}x{rows}){figure}")
