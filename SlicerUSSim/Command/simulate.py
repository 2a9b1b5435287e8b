"""`ussim simulate`."""

from __future__ import annotations

from pathlib import Path

import click

from SlicerUSSim.Command.options import check_output, gathered
from SlicerUSSim.Command.patient_options import PatientOptions, open_examination_at, pose_option, say_contact
from SlicerUSSim.Command.progress import note
from SlicerUSSim.Logic.mri.settings import CT


@click.command()
@gathered(patient=PatientOptions)
@pose_option
@click.option(
    "-o", "--out", type=click.Path(path_type=Path), required=True, help="Image: .png .mha .nrrd .nii.gz or .vti"
)
def simulate(patient: PatientOptions, pose: str, out: Path) -> None:
    """Simulate one B-mode image from an MRI or a label map at a given pose."""
    from SlicerUSSim.Logic.base.own_outputs import write_own_volume
    from SlicerUSSim.Logic.imaging.figures import write_png

    check_output(out, png=True)
    examination, probe_to_ras = open_examination_at(patient, pose)
    say_contact(examination, examination.probe, [probe_to_ras])
    frame = examination.simulator.simulate(examination.probe, probe_to_ras, examination.display)
    if out.suffix.lower() == ".png":
        write_png(out, frame.image)
    else:
        write_own_volume(out, frame.to_volume())
    kind = "labels" if examination.is_labels else "CT" if patient.segmentation.contrast == CT else "MRI"
    note(f"wrote {out} ({frame.image.shape[1]}x{frame.image.shape[0]}, from {kind})")
