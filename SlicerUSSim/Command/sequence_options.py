"""SequenceOptions: options of every command that reads tracked ultrasound, and the data read from them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from SlicerUSSim.Command.options import declared
from SlicerUSSim.Command.patient_options import Examination, PatientOptions, open_examination, say_contact
from SlicerUSSim.Command.progress import note
from SlicerUSSim.Logic.base.errors import require

if TYPE_CHECKING:
    import numpy as np

    from SlicerUSSim.Logic.base import Volume
    from SlicerUSSim.Logic.tracked import TrackedImages, TrackedSequence


@dataclass(frozen=True)
class TrackingOptions:
    """Where tracked images lie in the MRI."""

    transform: str = declared(
        "--transform", default="ImageToReference", show_default=True,
        help="Transform from pixels to the patient's frame, composed from the transforms in the sequence.",
    )  # fmt: skip
    calibration: str | None = declared(
        "--calibration", type=click.Path(),
        help="ImageToProbe, if the sequence lacks it: a Plus configuration (XML), or a file with the 4x4 matrix.",
    )  # fmt: skip
    to_mri: str | None = declared(
        "--to-mri", type=click.Path(),
        help="Transform from the patient's frame to the MRI: a pose file, .xfm, or .tag with landmarks in both.",
    )  # fmt: skip


#: Parameters of a sequence that no command has an option for
RARE_OF_SEQUENCE = "transform cut cut_tilt cut_slide cuts field"


@dataclass(frozen=True)
class SequenceOptions(TrackingOptions):
    """Tracked images and their position in the MRI. Files are given by their paths."""

    sequence: str = declared(
        "--sequence", type=click.Path(), required=True,
        help="Tracked images: .igs.mha .seq.mha .mhd .nrrd (Plus, 3D Slicer; poses alone for a sweep), a folder of "
        "MINC slices, or with recording.cut a 3D ultrasound volume. Without --probe or --preset, the geometry is "
        "estimated from the images.",
    )  # fmt: skip
    frames: str | None = declared(
        "--frames", help="Images to use, such as 0,5,10 or 0:20:5 (default: all tracked images; for a fit, six of "
        "them).",
    )  # fmt: skip
    cut: str | None = declared(
        "--cut", type=click.Path(), help="For a volume: file with the pose at which the image plane of a probe is "
        "extracted, and neighbouring planes",
    )  # fmt: skip
    cut_tilt: float | None = declared("--cut-tilt", type=float, help="Total tilt of these planes in degrees")
    cut_slide: float | None = declared(
        "--cut-slide", type=float, help="Total distance between these planes in millimetres"
    )
    cuts: int = declared("--cuts", type=click.IntRange(1), default=3, help="Number of these planes (default: 3)")
    field: Path | None = declared(  # noqa: RUF009, a dataclasses.field like the others
        "--field", type=click.Path(path_type=Path), help="Figure of the imaged field, for checking: .png"
    )


@dataclass(frozen=True, eq=False)
class TrackedExamination:
    """An examination, and the real images for comparison."""

    examination: Examination
    sequence: TrackedSequence
    #: The selected images, at their poses in the MRI
    images: TrackedImages
    #: Those of `apart`, None without
    others: TrackedImages | None
    #: (4, 4) rigid, from the reference frame of the ultrasound to the MRI; the identity without --to-mri
    reference_to_ras: np.ndarray


def open_tracked(
    patient: PatientOptions, recording: SequenceOptions, most: int | None = None, apart: str = "", *,
    finds_marks: bool = True,
) -> TrackedExamination:  # fmt: skip
    """The TrackedExamination of a command's options; `most` is the default number of images.

    `apart` selects other images, in the format of --frames; `finds_marks` as in TrackedImages.of.

    Fast checks come before slow computations. Raises SimulationError for inconsistent options.
    """
    import numpy as np

    from SlicerUSSim.Logic.tracked.imaged_field import draw_field
    from SlicerUSSim.Logic.tracked.images import TrackedImages, pixels_for_poses
    from SlicerUSSim.Logic.tracked.sequence import TrackedSequence, checked_apart, frame_numbers

    to_ras = read_to_mri(recording.to_mri) if recording.to_mri else np.eye(4)
    if recording.cut:
        volume, poses = _read_cuts(recording.cut, recording)
        examination = open_examination(patient)
        known_probe = examination.probe
        sequence = TrackedSequence.from_volume(volume, known_probe, poses)
    else:
        sequence = read_sequence(recording.sequence, recording.calibration)
        examination = open_examination(patient)
        known_probe = examination.probe if patient.gives_probe else None
    path, field = recording.transform, None
    if not sequence.has_images:
        require(not finds_marks, f"{recording.sequence}: has poses without images, expected images to compare or draw")
        known_probe = examination.probe
        sequence, path, field = pixels_for_poses(sequence, path, known_probe)
    chosen = None if recording.frames is None else frame_numbers(recording.frames, len(sequence))
    beside = checked_apart(apart, chosen, len(sequence))
    images = TrackedImages.of(
        sequence, chosen, path=path, reference_to_ras=to_ras, probe=known_probe, beam=examination.probe, most=most,
        apart=beside, field=field, finds_marks=finds_marks,
    )  # fmt: skip
    others = None
    if beside:
        images, others = images.split(beside)
    if recording.field:
        draw_field(recording.field, sequence.images[images.numbers[0]], images.field)
    say_contact(examination, images.probe, images.poses if others is None else [*images.poses, *others.poses])
    return TrackedExamination(examination, sequence, images, others, to_ras)


def read_sequence(path: str, calibration: str | None) -> TrackedSequence:
    """The TrackedSequence of --sequence, with the transform of --calibration."""
    from SlicerUSSim.Logic.tracked.pose_files import read_calibration
    from SlicerUSSim.Logic.tracked.sequence import TrackedSequence

    source = Path(path)
    if source.is_dir():
        sequence = TrackedSequence.from_slices(sorted(source.glob("*.mnc")))
    else:
        sequence = TrackedSequence.read(source)
    return sequence.with_transforms(read_calibration(calibration)) if calibration else sequence


def read_to_mri(path: str) -> np.ndarray:
    """(4, 4) map of --to-mri, from the reference frame of the ultrasound to the MRI."""
    from SlicerUSSim.Logic.tracked.pose_files import read_registration

    to_ras, line = read_registration(path)
    if line:
        note(line)
    return to_ras


def _read_cuts(pose_file: str, recording: SequenceOptions) -> tuple[Volume, list[np.ndarray]]:
    """The volume of --sequence, and (4, 4) the pose of --cut and neighbouring poses in its frame."""
    from SlicerUSSim.Logic.base.volume import Volume
    from SlicerUSSim.Logic.probe.poses import slide_sweep, tilt_sweep
    from SlicerUSSim.Logic.tracked.pose_files import read_pose

    tilt, slide, pose = recording.cut_tilt, recording.cut_slide, read_pose(pose_file)
    if tilt is None and slide is None:
        return Volume.read(recording.sequence), [pose]
    given = "recording.cut_tilt and recording.cut_slide are both given, expected only one"
    require(tilt is None or slide is None, given)
    around, extent = (slide_sweep, slide or 0.0) if tilt is None else (tilt_sweep, tilt)
    return Volume.read(recording.sequence), around(pose, extent, recording.cuts)
