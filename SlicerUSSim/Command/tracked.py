"""`ussim sweep` and `ussim optimize`: simulated against tracked ultrasound."""

from __future__ import annotations

from pathlib import Path

import click

from SlicerUSSim.Command.options import Scene, scene_options
from SlicerUSSim.Command.progress import Curve, Share
from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.version import __version__

transform_option = click.option(
    "--transform", "path", default="ImageToReference", show_default=True,
    help="From pixels to where the patient lies; composed of what the sequence has.",
)  # fmt: skip
calibration_option = click.option(
    "--calibration", type=click.Path(),
    help="What the sequence lacks: a Plus configuration (XML), or a file with the 4x4 ImageToProbe.",
)  # fmt: skip
to_mri_option = click.option(
    "--to-mri", "to_mri_file", type=click.Path(),
    help="From there to the MRI: a pose file, .xfm, or .tag with landmarks in MRI and ultrasound.",
)  # fmt: skip
_SEQUENCE_OPTIONS = (
    click.option(
        "--sequence", "sequence_file", type=click.Path(), required=True,
        help="Tracked images: .igs.mha .seq.mha .mhd .nrrd (Plus, 3D Slicer), a folder of MINC slices, or with --cut a "
        "3D ultrasound volume. Without --probe or --preset, the probe's geometry is found in the images.",
    ),
    click.option(
        "--frames", help="Which images: 0,5,10 or 0:20:5 (default: all that were tracked; to fit, six of them)."
    ),
    transform_option,
    calibration_option,
    to_mri_option,
    click.option("--cut", type=click.Path(), help="Cut a volume where a probe at this pose would look, and beside it:"),
    click.option("--cut-tilt", type=float, help="tilted by this many degrees in all,"),
    click.option("--cut-slide", type=float, help="or slid by this many millimetres in all,"),
    click.option("--cuts", type=click.IntRange(1), default=3, show_default=True, help="in as many images."),
    click.option("--field", type=click.Path(path_type=Path), help="Picture of the imaged field, to check it: .png"),
)  # fmt: skip


_SEQUENCE_NAMES = (
    "sequence_file", "frames", "path", "calibration", "to_mri_file", "cut", "cut_tilt", "cut_slide", "cuts", "field",
)  # fmt: skip


def _sequence_options(command):
    """What every command takes that reads tracked images; _open makes a scene and TrackedImages of it."""
    for option in reversed(_SEQUENCE_OPTIONS):
        command = option(command)
    return command


def _open(options: dict, most: int | None = None):
    """(Scene, TrackedSequence, TrackedImages) of the options of a command; what is cheap to check comes first.

    `most` is how many images are taken if none are chosen.
    """
    from SlicerUSSim.Logic.base.files import require_place
    from SlicerUSSim.Logic.tracked.field import draw_field
    from SlicerUSSim.Logic.tracked.images import TrackedImages
    from SlicerUSSim.Logic.tracked.sequence import frame_numbers

    wanted = {name: options.pop(name) for name in _SEQUENCE_NAMES}
    if wanted["field"]:
        require_place(wanted["field"])
    to_ras = to_mri(wanted["to_mri_file"])
    probe = None
    if wanted["cut"] is None:
        sequence = read_sequence(wanted["sequence_file"], wanted["calibration"])
        scene = Scene(**options)
        probe = scene.probe if scene.probe_is_given else None
    else:
        cut = _read_cuts(wanted)
        scene = Scene(**options)
        probe = scene.probe
        sequence = cut(probe)
    numbers = None if wanted["frames"] is None else frame_numbers(wanted["frames"], len(sequence))
    tracked = TrackedImages.of(
        sequence, numbers, path=wanted["path"], reference_to_ras=to_ras, probe=probe, beam=scene.probe, most=most
    )
    if wanted["field"]:
        draw_field(wanted["field"], sequence.images[tracked.numbers[0]], tracked.field)
    return scene, sequence, tracked


def read_sequence(sequence_file, calibration):
    """The TrackedSequence of --sequence, with what --calibration adds."""
    from SlicerUSSim.Logic.tracked.pose_files import read_matrix
    from SlicerUSSim.Logic.tracked.sequence import TrackedSequence, read_coordinate_definitions

    source = Path(sequence_file)
    if source.is_dir():
        sequence = TrackedSequence.from_slices(sorted(source.glob("*.mnc")))
    else:
        sequence = TrackedSequence.read(source)
    if calibration:
        is_xml = Path(calibration).suffix.lower() == ".xml"
        constant = read_coordinate_definitions(calibration) if is_xml else {"ImageToProbe": read_matrix(calibration)}
        sequence = sequence.with_transforms(constant)
    return sequence


def _read_cuts(wanted: dict):
    """A function of the probe that cuts the volume into a sequence."""
    from SlicerUSSim.Logic.base.volume import Volume
    from SlicerUSSim.Logic.probe.placement import slide_sweep, tilt_sweep
    from SlicerUSSim.Logic.tracked.pose_files import read_pose
    from SlicerUSSim.Logic.tracked.sequence import TrackedSequence

    pose, tilt, slide = read_pose(wanted["cut"]), wanted["cut_tilt"], wanted["cut_slide"]
    if tilt is not None and slide is not None:
        raise SimulationError("expected either --cut-tilt DEGREES or --cut-slide MILLIMETRES, for cuts of one kind")
    poses = [pose]
    if tilt is not None:
        poses = tilt_sweep(pose, tilt, wanted["cuts"])
    elif slide is not None:
        poses = slide_sweep(pose, slide, wanted["cuts"])
    volume = Volume.read(wanted["sequence_file"])
    return lambda probe: TrackedSequence.from_volume(volume, probe, poses)


def to_mri(file):
    """(4, 4) rigid of --to-mri, or None."""
    from SlicerUSSim.Logic.base.transforms import rigid_between
    from SlicerUSSim.Logic.tracked.pose_files import read_tags, read_transform

    if not file:
        return None
    if Path(file).suffix.lower() != ".tag":
        return read_transform(file)
    in_mri, in_ultrasound = read_tags(file)
    if in_ultrasound is None:
        raise SimulationError(f"{file}: has points of one volume, expected pairs in MRI and ultrasound")
    to_ras, left = rigid_between(in_ultrasound, in_mri)
    click.echo(f"{len(in_mri)} landmarks agree to {left:.2f} mm (root mean square)")
    return to_ras


@click.command()
@scene_options
@_sequence_options
@click.option(
    "-o", "--out", type=click.Path(path_type=Path), required=True, help="Sequence: .igs.mha .seq.mha .mhd or .nrrd"
)
def sweep(out: Path, **options) -> None:
    """Simulate the images of a tracked sequence: what its probe saw, on the same pixels."""
    import numpy as np

    from SlicerUSSim.Logic.base.files import require_place
    from SlicerUSSim.Logic.tracked.sequence import require_sequence_name

    require_sequence_name(out)
    require_place(out)
    scene, sequence, tracked = _open(options)
    images = np.zeros((len(tracked.poses), *tracked.field.mask.shape), np.uint8)
    with Share("sweep") as progress:
        for number, pose in enumerate(tracked.poses):
            frame = scene.simulator.simulate(
                tracked.probe, pose, scene.display, tracked.grid, noise_seed=tracked.numbers[number]
            )
            images[number][tracked.field.window] = frame.image
            progress((number + 1) / len(tracked.poses))
    sequence.with_images(tracked.numbers, images).write(out)
    click.echo(f"wrote {out} ({len(images)} images of {images.shape[2]}x{images.shape[1]})")


@click.command()
@scene_options
@_sequence_options
@click.option("-o", "--out", type=click.Path(path_type=Path), required=True, help="Result: .json")
@click.option(
    "--free",
    multiple=True,
    metavar="NAME[=LOW:HIGH]",
    help='Free parameters: "display", a tissue, one of either ("gain_db", "white matter.mu0"), with bounds if wanted; '
    'may be repeated (default: display and "white matter").',
)
@click.option("--evaluations", type=click.IntRange(1), default=500, show_default=True, help="Of the cost, at most.")
@click.option("--restarts", type=click.IntRange(0), default=2, show_default=True, help="For what fits equally well.")
@click.option("--report", type=click.Path(path_type=Path), help="Self-contained report: .html")
@click.option("--save-preset", type=click.Path(path_type=Path), help="Preset with what was found: .json")
@click.option(
    "--state",
    type=click.Path(path_type=Path),
    help="Keep what was evaluated here, and go on from there when run again: .json",
)
@click.option("--register", is_flag=True, help="Also refine where the ultrasound lies in the MRI (rigid).")
@click.option("--save-transform", type=click.Path(path_type=Path), help="With --register: ultrasound to MRI, .json")
def optimize(
    out: Path, free, evaluations, restarts, report, save_preset, state, register, save_transform, **options
) -> None:
    """Fit display and tissue parameters until simulated and tracked real ultrasound agree."""
    from SlicerUSSim.Logic.base.files import read_json, require_place, write_json
    from SlicerUSSim.Logic.fitting.fit import fit
    from SlicerUSSim.Logic.fitting.report import write_report
    from SlicerUSSim.Logic.imaging.figures import require_matplotlib
    from SlicerUSSim.Logic.imaging.preset import Preset
    from SlicerUSSim.Logic.tracked.pose_files import write_pose

    for place in filter(None, (out, report, save_preset, state, save_transform)):
        require_place(place)
    if report:
        require_matplotlib()
    if save_transform and not register:
        raise SimulationError("--save-transform needs --register")
    names = dict(_free_parameter(text) for text in free) or dict.fromkeys(("display", "white matter"))
    sequence_file = options["sequence_file"]
    scene, _, tracked = _open(options, most=6)
    earlier = read_json(state) if state and state.exists() else None
    simulator = scene.simulator
    with Curve("optimize") as curve:
        found = fit(
            simulator, tracked, free=names, display=scene.display, register=register, max_evaluations=evaluations,
            restarts=restarts, progress=curve, resume=earlier,
            checkpoint=(lambda reached: write_json(state, reached)) if state else None,
        )  # fmt: skip
    result = found.appearance
    write_json(out, found.to_dict())
    if save_preset:
        Preset(tracked.probe, result.display, simulator.settings, result.tissues).write(save_preset)
    if save_transform:
        write_pose(save_transform, found.registration.correction)
    if report:
        provenance = (
            f"SlicerUSSim {__version__}, {simulator.device.info}. MRI or labels: {scene.source}. Sequence: "
            f"{sequence_file}, images {', '.join(map(str, tracked.numbers))}. Probe: {tracked.probe}. Settings: "
            f"{simulator.settings}."
        )
        write_report(
            report, result, found.tracked, found.before, found.after, simulator,
            subtitle=f"{Path(sequence_file).name} on {Path(scene.source).name}", provenance=provenance,
        )  # fmt: skip
    if found.registration:
        moved = found.registration
        click.echo(f"moved by {moved.shift_mm:.2f} mm and {moved.turn_deg:.2f} degrees")
    click.echo(f"cost {result.cost_before:.4f} -> {result.cost_after:.4f} ({result.evaluations} evaluations)")
    for parameter in result.parameters:
        spread = result.identifiability[parameter.name]
        note = f"  not determined: {spread.low:.3g} to {spread.high:.3g} fit as well"
        note = note if spread.is_determined is False else ""
        note = "  at its bound" if parameter.name in result.at_bounds else note
        before, after = result.before[parameter.name], result.after[parameter.name]
        click.echo(f"{parameter.name:42s} {before:8.3f} -> {after:8.3f}{note}")
    click.echo("wrote " + ", ".join(map(str, filter(None, (out, report, save_preset, save_transform, state)))))


def _free_parameter(text: str) -> tuple[str, tuple[float, float] | None]:
    """A name, or name=low:high."""
    name, equals, bounds = text.partition("=")
    if not equals:
        return name.strip(), None
    try:
        low, high = (float(end) for end in bounds.split(":"))
    except ValueError:
        raise SimulationError(f"--free is {text!r}, expected such as white matter.mu0=0.1:0.8") from None
    return name.strip(), (low, high)
