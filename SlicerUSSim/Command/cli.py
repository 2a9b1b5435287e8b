"""The `ussim` command. Heavy imports happen inside the commands, so that --help answers at once."""

from __future__ import annotations

import os
import sys
import warnings
from pathlib import Path

import click

from SlicerUSSim import __version__
from SlicerUSSim.Logic.errors import SimulationError, is_our_warning, user_message


class _Commands(click.Group):
    """Turns what the user caused into one line on stderr and exit status 2."""

    def invoke(self, ctx: click.Context):
        try:
            return super().invoke(ctx)
        except Exception as error:
            message = user_message(error)
            if message is None:
                raise
            click.echo(f"ussim: {message}", err=True)
            ctx.exit(2)


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="ussim")
def main() -> None:
    """B-mode ultrasound simulated from a patient's MRI."""
    warnings.showwarning = _show_warning


def _show_warning(message, category, *_, **__) -> None:
    """Our own warnings are one line; those of the libraries are not for the user of a command."""
    if is_our_warning(category):
        click.echo(f"ussim: warning: {message}", err=True)


_PROBE_NAMES = ["phased", "convex", "linear", "microconvex", "abdominal"]  # probe.PROBES, which would import numpy
_device_option = click.option(
    "--device", help='OpenCL device: "platform:device" or part of its name (see `ussim devices`).'
)
_seed_option = click.option("--seed", type=int, default=0, show_default=True, help="Which speckle and noise.")
_contrast_option = click.option(
    "--contrast",
    type=click.Choice(["t1", "t1gd", "t2", "flair"]),
    default="t1",
    show_default=True,
    help="MRI contrast.",
)
_mask_option = click.option("--mask", type=click.Path(), help="Foreground on the MRI's grid (default: found by Otsu).")
_sulci_option = click.option(
    "--thin-sulci/--no-thin-sulci", default=True, show_default=True,
    help="Label sulci too narrow to reach CSF intensity as leptomeninges.",
)  # fmt: skip


@main.command()
@click.option(
    "--out", type=click.Path(path_type=Path), default="ussim-demo", show_default=True, help="Folder for the results."
)
@click.option(
    "--mri", type=click.Path(), help="Skull-stripped T1 MRI (default: the MNI152 brain that nilearn carries)."
)
@click.option("--probe", "kind", type=click.Choice(_PROBE_NAMES), default="phased", show_default=True)
@_seed_option
@_device_option
def demo(out: Path, mri: str | None, kind: str, seed: int, device: str | None) -> None:
    """The whole line on a real brain MRI: segmentation, a craniotomy view, pictures."""
    from SlicerUSSim.Logic.demo import demo_mri, run_demo
    from SlicerUSSim.Logic.probe import PROBES
    from SlicerUSSim.Logic.settings import DisplaySettings, SimulationSettings
    from SlicerUSSim.Logic.volume import Volume

    settings = SimulationSettings(seed=seed)
    volume, source = (Volume.read(mri), os.path.abspath(mri)) if mri else demo_mri()
    click.echo(f"MRI: {source}, {'x'.join(map(str, volume.array.shape[::-1]))} voxels")
    with _steps(5) as step:
        summary = run_demo(out, volume, source, PROBES[kind], settings, DisplaySettings(), device, step)
    times = summary["milliseconds"]
    click.echo(f"device: {summary['device']}")
    click.echo(f"segmentation {times['segmentation']:.0f} ms, one frame {times['frame']:.1f} ms")
    click.echo(f"wrote {out / 'figure.png'} and nine more files beside it")


@main.command()
@click.argument("mri", type=click.Path())
@click.option(
    "-o",
    "--out",
    type=click.Path(path_type=Path),
    required=True,
    help="Label map; its tissues go to a .json beside it.",
)
@_contrast_option
@click.option("--classes", type=int, default=3, show_default=True, help="Number of tissues.")
@_mask_option
@click.option(
    "--radius", type=int, default=1, show_default=True, help="Radius of the guided filter in voxels; 0: none."
)
@click.option("--bias-correction", is_flag=True, help="Run N4 first.")
@_sulci_option
@_device_option
def segment(mri, out, contrast, classes, mask, radius, bias_correction, thin_sulci, device) -> None:
    """Label the tissues of a skull-stripped brain MRI."""
    from SlicerUSSim.Logic.segmentation import segment_mri
    from SlicerUSSim.Logic.tissues import TissueTable
    from SlicerUSSim.Logic.volume import Volume

    _check_output(out)
    volume = Volume.read(mri)
    with _share("segment") as progress:
        result = segment_mri(
            volume, classes=classes, contrast=contrast, mask=Volume.read(mask) if mask else None, filter_radius=radius,
            bias_correction=bias_correction, thin_sulci=thin_sulci, device=device, progress=progress,
        )  # fmt: skip
    result.labels.write(out)
    TissueTable.brain(result.tissue_names).write(_tissue_file(out))
    for label, (name, mean, sd, weight) in enumerate(
        zip(result.tissue_names, result.means, result.standard_deviations, result.weights, strict=False), 1
    ):
        click.echo(f"label {label}: {name:14s} mean {mean:8.2f}  sd {sd:7.2f}  share {weight:5.1%}")
    click.echo(f"wrote {out} and {_tissue_file(out)}")


_pose_option = click.option(
    "--pose", required=True, help='File with probe_to_ras (JSON, 16 numbers, or a Slicer transform), or "auto".'
)
_SCENE_OPTIONS = (
    click.argument("mri_or_labels", type=click.Path()),
    click.option(
        "--labels/--mri", "is_labels", default=None, help="What the input is (default: few whole numbers are labels)."
    ),
    click.option(
        "--preset", "preset_file", type=click.Path(),
        help="Probe, display, settings and tissues as JSON, from `ussim demo` or the Slicer module; the options below "
        "go before it.",
    ),
    click.option(
        "--probe", "probe_file", type=click.Path(), help="Probe as JSON (default: the preset's, a phased array)."
    ),
    click.option(
        "--tissues", "tissue_file", type=click.Path(),
        help="Tissue table as JSON (default: the preset's, the file beside the labels, or brain).",
    ),
    _contrast_option,
    _mask_option,
    _sulci_option,
    click.option(
        "--partial-volume/--hard-labels", default=None,
        help="Scatterers take their tissue by the segmentation's probabilities (from an MRI only).",
    ),
    click.option(
        "--mri-modulation", type=float,
        help="Scatterers follow the MRI inside tissues, dB per standard deviation (from an MRI only).",
    ),
    click.option("--gain", type=float, help="Gain [dB] (default: the preset's, 0)."),
    click.option("--dynamic-range", type=float, help="Dynamic range [dB] (default: the preset's, 55)."),
    click.option("--tgc", type=float, help="Time-gain compensation [dB/(cm MHz)] (default: the preset's, 0.5)."),
    click.option("--seed", type=int, help="Which speckle and noise (default: the preset's, 0)."),
    _device_option,
)  # fmt: skip


def _scene_options(command):
    """What every command that simulates takes; _Scene makes a simulator, a probe and a pose of it."""
    for option in reversed(_SCENE_OPTIONS):
        command = option(command)
    return command


class _Scene:
    """A simulator for one patient, a probe, where it is (unless a sequence says it), and how its images are shown."""

    def __init__(
        self, mri_or_labels, is_labels, preset_file, probe_file, tissue_file, contrast, mask, thin_sulci,
        partial_volume, mri_modulation, gain, dynamic_range, tgc, seed, device, pose=None,
    ) -> None:  # fmt: skip
        from SlicerUSSim.Logic.placement import craniotomy_pose
        from SlicerUSSim.Logic.pose import read_pose
        from SlicerUSSim.Logic.preset import Preset
        from SlicerUSSim.Logic.probe import probe_from_dict
        from SlicerUSSim.Logic.segmentation import segment_mri
        from SlicerUSSim.Logic.simulator import UltrasoundSimulator
        from SlicerUSSim.Logic.tissues import TissueTable, read_json
        from SlicerUSSim.Logic.volume import Volume

        self.source = os.path.abspath(mri_or_labels)
        # What is cheap to check comes before what takes time.
        preset = Preset.read(preset_file) if preset_file else Preset()
        preset = preset.changed("display", **_given(gain_db=gain, dynamic_range_db=dynamic_range, tgc_db_cm_mhz=tgc))
        preset = preset.changed(
            "settings", **_given(seed=seed, partial_volume=partial_volume, mri_modulation_db=mri_modulation)
        )
        self.display, settings = preset.display, preset.settings
        self.probe = probe_from_dict(read_json(probe_file), str(probe_file)) if probe_file else preset.probe
        self.probe_is_given = bool(probe_file or preset_file)
        self.pose = None if pose in (None, "auto") else read_pose(pose)
        volume = Volume.read(mri_or_labels)
        self.is_labels = _looks_like_labels(volume) if is_labels is None else is_labels
        texture = None
        if self.is_labels:
            if settings.needs_texture:
                raise SimulationError(
                    f"{mri_or_labels}: is a label map; --partial-volume and --mri-modulation need the MRI it came from"
                )
            labels, tissues = volume, preset.tissues
            beside = _tissue_file(Path(mri_or_labels))
            tissue_file = tissue_file or (beside if beside.exists() and not preset_file else None)
        else:
            with _share("segment") as progress:
                result = segment_mri(
                    volume, contrast=contrast, mask=Volume.read(mask) if mask else None, thin_sulci=thin_sulci,
                    device=device, progress=progress,
                )  # fmt: skip
            labels, tissues = result.labels, preset.tissues.for_names(result.tissue_names)
            texture = result.texture() if settings.needs_texture else None
        if tissue_file:
            tissues = TissueTable.read(tissue_file)
        self.simulator = UltrasoundSimulator(labels, tissues, settings, device, texture)
        if pose == "auto":
            self.pose = craniotomy_pose(labels, self.probe)


@main.command()
@_scene_options
@_pose_option
@click.option(
    "-o", "--out", type=click.Path(path_type=Path), required=True, help="Image: .png .mha .nrrd .nii.gz or .vti"
)
def simulate(out: Path, **scene_options) -> None:
    """One B-mode image from an MRI or a label map at a given pose."""
    from SlicerUSSim.Logic.figures import write_png

    _check_output(out, png=True)
    scene = _Scene(**scene_options)
    frame = scene.simulator.simulate(scene.probe, scene.pose, scene.display)
    if out.suffix.lower() == ".png":
        write_png(out, frame.image)
    else:
        frame.to_volume().write(out)
    kind = "labels" if scene.is_labels else "MRI"
    click.echo(f"wrote {out} ({frame.image.shape[1]}x{frame.image.shape[0]}, from {kind})")


@main.command()
@_scene_options
@_pose_option
@click.option("-o", "--out", type=click.Path(path_type=Path), required=True, help="Volume: .nrrd .nii.gz .mha or .vti")
@click.option("--tilt", type=float, help="Tilt the image plane about the probe's face by this many degrees in all.")
@click.option("--slide", type=float, help="Slide the probe across its image plane by this many millimetres in all.")
@click.option("--frames", type=click.IntRange(1), default=61, show_default=True, help="Images of the sweep.")
@click.option("--spacing", type=float, default=0.5, show_default=True, help="Voxel size [mm].")
@click.option("--like", type=click.Path(), help="Take the voxel grid of this volume instead (the MRI, say).")
def volume(
    out: Path, tilt: float | None, slide: float | None, frames: int, spacing: float, like: str | None, **scene_options
) -> None:
    """A 3D ultrasound volume: a sweep of images around a pose, compounded in patient space."""
    from SlicerUSSim.Logic.placement import slide_sweep, tilt_sweep
    from SlicerUSSim.Logic.volume import Volume

    _check_output(out)
    if (tilt is None) == (slide is None):
        raise SimulationError("expected either --tilt DEGREES or --slide MILLIMETRES, for a sweep of one kind")
    grid = Volume.read(like) if like else None
    scene = _Scene(**scene_options)
    poses = slide_sweep(scene.pose, slide, frames) if tilt is None else tilt_sweep(scene.pose, tilt, frames)
    with _share("sweep") as progress:
        result = scene.simulator.volume(
            scene.probe, poses, scene.display, spacing_mm=spacing, like=grid,
            progress=lambda done: progress(done / frames),
        )  # fmt: skip
    result.write(out)
    click.echo(f"wrote {out} ({'x'.join(map(str, result.array.shape[::-1]))} voxels from {frames} images)")


_SEQUENCE_OPTIONS = (
    click.option(
        "--sequence", "sequence_file", type=click.Path(), required=True,
        help="Tracked images: .igs.mha .seq.mha .mhd .nrrd (Plus, 3D Slicer), or a folder of MINC slices.",
    ),
    click.option("--frames", help="Which images: 0,5,10 or 0:20:5 (default: all that were tracked)."),
    click.option(
        "--transform", "path", default="ImageToReference", show_default=True,
        help="From pixels to where the patient lies; composed of what the sequence has.",
    ),
    click.option(
        "--calibration", type=click.Path(),
        help="What the sequence lacks: a Plus configuration (XML), or a file with the 4x4 ImageToProbe.",
    ),
    click.option(
        "--to-mri", type=click.Path(),
        help="From there to the MRI: a pose file, .xfm, or .tag with landmarks in MRI and ultrasound.",
    ),
)  # fmt: skip


def _sequence_options(command):
    """What every command takes that reads tracked images; _tracked makes TrackedImages of it."""
    for option in reversed(_SEQUENCE_OPTIONS):
        command = option(command)
    return command


def _read_sequence(sequence_file, calibration):
    from SlicerUSSim.Logic.pose import read_matrix
    from SlicerUSSim.Logic.sequence import TrackedSequence, read_coordinate_definitions

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


def _tracked(sequence, frames, path, to_mri, probe):
    from SlicerUSSim.Logic.pose import read_tags, read_transform, rigid_between
    from SlicerUSSim.Logic.sequence import frame_numbers
    from SlicerUSSim.Logic.tracked import TrackedImages

    to_ras = None
    if to_mri and Path(to_mri).suffix.lower() == ".tag":
        in_mri, in_ultrasound = read_tags(to_mri)
        if in_ultrasound is None:
            raise SimulationError(f"{to_mri}: has points of one volume, expected pairs in MRI and ultrasound")
        to_ras, left = rigid_between(in_ultrasound, in_mri)
        click.echo(f"{len(in_mri)} landmarks agree to {left:.2f} mm (root mean square)")
    elif to_mri:
        to_ras = read_transform(to_mri)
    numbers = None if frames is None else frame_numbers(frames, len(sequence))
    return TrackedImages.of(sequence, numbers, path=path, reference_to_ras=to_ras, probe=probe)


@main.command()
@_scene_options
@_sequence_options
@click.option(
    "-o", "--out", type=click.Path(path_type=Path), required=True, help="Sequence: .igs.mha .seq.mha .mhd or .nrrd"
)
def sweep(out: Path, sequence_file, frames, path, calibration, to_mri, **scene_options) -> None:
    """Simulate the images of a tracked sequence: what its probe saw, on the same pixels."""
    import numpy as np

    from SlicerUSSim.Logic.sequence import require_sequence_name
    from SlicerUSSim.Logic.volume import require_place

    require_sequence_name(out)
    require_place(out)
    sequence = _read_sequence(sequence_file, calibration)
    scene = _Scene(**scene_options)
    tracked = _tracked(sequence, frames, path, to_mri, scene.probe if scene.probe_is_given else None)
    images = np.zeros((len(tracked.poses), *tracked.fan.mask.shape), np.uint8)
    rows, columns = (np.flatnonzero(tracked.fan.mask.any(axis=axis)) for axis in (1, 0))
    with _share("sweep") as progress:
        for number, pose in enumerate(tracked.poses):
            frame = scene.simulator.simulate(tracked.probe, pose, scene.display, tracked.grid)
            images[number, rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] = frame.image
            progress((number + 1) / len(tracked.poses))
    sequence.with_images(tracked.numbers, images).write(out)
    click.echo(f"wrote {out} ({len(images)} images of {images.shape[2]}x{images.shape[1]})")


@main.command()
@_scene_options
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
    out: Path, sequence_file, frames, path, calibration, to_mri, free, evaluations, restarts, report, save_preset,
    state, register, save_transform, **scene_options,
) -> None:  # fmt: skip
    """Fit display and tissue parameters until simulated and tracked real ultrasound agree."""
    from SlicerUSSim.Logic.figures import require_matplotlib
    from SlicerUSSim.Logic.fitting import fit
    from SlicerUSSim.Logic.pose import write_pose
    from SlicerUSSim.Logic.preset import Preset
    from SlicerUSSim.Logic.report import write_report
    from SlicerUSSim.Logic.tissues import read_json, write_json
    from SlicerUSSim.Logic.volume import require_place

    for place in filter(None, (out, report, save_preset, state, save_transform)):
        require_place(place)
    if report:
        require_matplotlib()
    if save_transform and not register:
        raise SimulationError("--save-transform needs --register")
    names = dict(_free_parameter(text) for text in free) or dict.fromkeys(("display", "white matter"))
    sequence = _read_sequence(sequence_file, calibration)
    scene = _Scene(**scene_options)
    tracked = _tracked(sequence, frames, path, to_mri, scene.probe if scene.probe_is_given else None)
    earlier = read_json(state) if state and state.exists() else None
    simulator = scene.simulator
    with _Curve("optimize") as curve:
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


@main.command()
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default="ussim-validation",
    show_default=True,
    help="Folder for the report.",
)
@click.option(
    "--only", multiple=True, metavar="TEXT", help="Only checks with this text in their name; may be repeated."
)
@_device_option
@click.pass_context
def validate(ctx: click.Context, out: Path, only: tuple[str, ...], device: str | None) -> None:
    """Measure the simulator against theory on phantoms: tables and pictures; exit status 1 if any number is off."""
    from SlicerUSSim.Logic.validation import chosen_checks
    from SlicerUSSim.Logic.validation import validate as run

    with _steps(sum(len(check.orientations) for check in chosen_checks(only))) as step:
        report = run(out, device, only, step)
    for finding in report.failed:
        row = finding.row
        click.echo(
            f"off: {finding.check}, {row.quantity}, {finding.orientation}: {row.measured:.4g} {row.unit}, "
            f"predicted {row.predicted:.4g} ({row.limits})"
        )
    click.echo(f"{report.summary()} Wrote {out / 'report.md'}, report.json and {len(report.pictures)} pictures.")
    ctx.exit(1 if report.failed else 0)


@main.command()
@_device_option
def devices(device: str | None) -> None:
    """Which OpenCL devices exist, which one is used and why, and how to get a faster one."""
    from SlicerUSSim.Logic.device import choose_device, faster_hint, list_devices

    chosen, reason = choose_device(device)
    for info in list_devices():
        click.echo(f"{'*' if info == chosen else ' '} {info}, {info.memory_mb} MB")
    click.echo(f"used: {chosen.index}, {reason}")
    hint = faster_hint(chosen)
    if hint:
        click.echo(f"faster on this computer: {hint}")


def _given(**options) -> dict:
    """The options that were given."""
    return {name: value for name, value in options.items() if value is not None}


def _looks_like_labels(volume) -> bool:
    import numpy as np

    return (
        bool(np.issubdtype(volume.array.dtype, np.integer))
        and int(volume.array.min()) >= 0
        and len(np.unique(volume.array)) <= 32
    )


def _tissue_file(labels: Path) -> Path:
    name = labels.name
    for suffix in (".nii.gz", labels.suffix):
        if suffix and name.endswith(suffix):
            return labels.with_name(name[: -len(suffix)] + ".json")
    return labels.with_name(name + ".json")


def _check_output(out: Path, png: bool = False) -> None:
    """Refuse an output that cannot be written now rather than after the work."""
    from SlicerUSSim.Logic.volume import require_image_name, require_place

    if not (png and out.suffix.lower() == ".png"):
        require_image_name(out)
    require_place(out)


class _steps:  # noqa: N801
    """A progress bar that is told the name of each step."""

    def __init__(self, count: int) -> None:
        from tqdm import tqdm

        self.bar = tqdm(total=count, bar_format="|{bar:24}| {desc}", file=sys.stderr, leave=False, disable=None)
        self.begun = 0

    def __enter__(self):
        return self

    def __call__(self, name: str) -> None:
        self.bar.set_description_str(name, refresh=False)
        self.bar.update(1 if self.begun else 0)
        self.bar.refresh()
        self.begun += 1

    def __exit__(self, *_) -> None:
        self.bar.close()


class _Curve(_steps):
    """The same for an optimisation: its stage and the best cost so far."""

    def __init__(self, name: str) -> None:
        super().__init__(100)
        self.bar.set_description_str(name)

    def __call__(self, progress) -> None:
        self.bar.set_description_str(f"{progress.stage}: cost {progress.best_cost:.4f}", refresh=False)
        self.bar.update(int(100 * progress.share) - self.bar.n)


class _share(_steps):  # noqa: N801
    """The same for a share done between 0 and 1."""

    def __init__(self, name: str) -> None:
        super().__init__(100)
        self.bar.set_description_str(name)

    def __call__(self, share: float) -> None:
        self.bar.update(int(100 * share) - self.bar.n)


if __name__ == "__main__":
    main()
