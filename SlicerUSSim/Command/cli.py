"""The `ussim` command. Heavy imports happen inside the commands, so that --help answers at once."""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import click

from SlicerUSSim.Command.bench import bench
from SlicerUSSim.Command.options import (
    PROBE_NAMES,
    Scene,
    check_output,
    contrast_option,
    device_option,
    mask_option,
    pose_option,
    scene_options,
    seed_option,
    sulci_option,
)
from SlicerUSSim.Command.progress import Share, Steps
from SlicerUSSim.Command.serve import serve
from SlicerUSSim.Command.tracked import optimize, sweep
from SlicerUSSim.Logic.base.errors import SimulationError, is_our_warning, user_message
from SlicerUSSim.Logic.base.version import __version__


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


@main.command()
@click.option(
    "--out", type=click.Path(path_type=Path), default="ussim-demo", show_default=True, help="Folder for the results."
)
@click.option(
    "--mri", type=click.Path(), help="Skull-stripped T1 MRI (default: the MNI152 brain that nilearn carries)."
)
@click.option("--probe", "kind", type=click.Choice(PROBE_NAMES), default="phased", show_default=True)
@seed_option
@device_option
def demo(out: Path, mri: str | None, kind: str, seed: int, device: str | None) -> None:
    """The whole line on a real brain MRI: segmentation, a craniotomy view, pictures."""
    from SlicerUSSim.Command.demo import run_demo
    from SlicerUSSim.Logic.base.settings import DisplaySettings, SimulationSettings
    from SlicerUSSim.Logic.base.volume import Volume
    from SlicerUSSim.Logic.mri.samples import demo_mri
    from SlicerUSSim.Logic.probe.arrays import PROBES

    settings = SimulationSettings(seed=seed)
    volume, source = (Volume.read(mri), os.path.abspath(mri)) if mri else demo_mri()
    click.echo(f"MRI: {source}, {'x'.join(map(str, volume.array.shape[::-1]))} voxels")
    with Steps(5) as step:
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
@contrast_option
@click.option("--classes", type=int, default=3, show_default=True, help="Number of tissues.")
@mask_option
@click.option(
    "--radius", type=int, default=1, show_default=True, help="Radius of the guided filter in voxels; 0: none."
)
@click.option("--bias-correction", is_flag=True, help="Run N4 first.")
@sulci_option
@device_option
def segment(mri, out, contrast, classes, mask, radius, bias_correction, thin_sulci, device) -> None:
    """Label the tissues of a skull-stripped brain MRI."""
    from SlicerUSSim.Logic.base.volume import Volume
    from SlicerUSSim.Logic.mri.segmentation import segment_mri
    from SlicerUSSim.Logic.tissue.table import TissueTable, tissues_beside

    check_output(out)
    volume = Volume.read(mri)
    with Share("segment") as progress:
        result = segment_mri(
            volume, classes=classes, contrast=contrast, mask=Volume.read(mask) if mask else None, filter_radius=radius,
            bias_correction=bias_correction, thin_sulci=thin_sulci, device=device, progress=progress,
        )  # fmt: skip
    result.labels.write(out)
    TissueTable.brain(result.tissue_names).write(tissues_beside(out))
    for label, (name, mean, sd, weight) in enumerate(
        zip(result.tissue_names, result.means, result.standard_deviations, result.weights, strict=False), 1
    ):
        click.echo(f"label {label}: {name:14s} mean {mean:8.2f}  sd {sd:7.2f}  share {weight:5.1%}")
    click.echo(f"wrote {out} and {tissues_beside(out)}")


@main.command()
@scene_options
@pose_option
@click.option(
    "-o", "--out", type=click.Path(path_type=Path), required=True, help="Image: .png .mha .nrrd .nii.gz or .vti"
)
def simulate(out: Path, **of_scene) -> None:
    """One B-mode image from an MRI or a label map at a given pose."""
    from SlicerUSSim.Logic.imaging.figures import write_png

    check_output(out, png=True)
    scene = Scene(**of_scene)
    frame = scene.simulator.simulate(scene.probe, scene.pose, scene.display)
    if out.suffix.lower() == ".png":
        write_png(out, frame.image)
    else:
        frame.to_volume().write(out)
    kind = "labels" if scene.is_labels else "MRI"
    click.echo(f"wrote {out} ({frame.image.shape[1]}x{frame.image.shape[0]}, from {kind})")


@main.command()
@scene_options
@pose_option
@click.option("-o", "--out", type=click.Path(path_type=Path), required=True, help="Volume: .nrrd .nii.gz .mha or .vti")
@click.option("--tilt", type=float, help="Tilt the image plane about the probe's face by this many degrees in all.")
@click.option("--slide", type=float, help="Slide the probe across its image plane by this many millimetres in all.")
@click.option("--frames", type=click.IntRange(1), default=61, show_default=True, help="Images of the sweep.")
@click.option("--spacing", type=float, default=0.5, show_default=True, help="Voxel size [mm].")
@click.option("--like", type=click.Path(), help="Take the voxel grid of this volume instead (the MRI, say).")
def volume(
    out: Path, tilt: float | None, slide: float | None, frames: int, spacing: float, like: str | None, **of_scene
) -> None:
    """A 3D ultrasound volume: a sweep of images around a pose, compounded in patient space."""
    from SlicerUSSim.Logic.base.volume import Volume
    from SlicerUSSim.Logic.probe.placement import slide_sweep, tilt_sweep

    check_output(out)
    if (tilt is None) == (slide is None):
        raise SimulationError("expected either --tilt DEGREES or --slide MILLIMETRES, for a sweep of one kind")
    grid = Volume.read(like) if like else None
    scene = Scene(**of_scene)
    poses = slide_sweep(scene.pose, slide, frames) if tilt is None else tilt_sweep(scene.pose, tilt, frames)
    with Share("sweep") as progress:
        result = scene.simulator.volume(
            scene.probe, poses, scene.display, spacing_mm=spacing, like=grid,
            progress=lambda done: progress(done / frames),
        )  # fmt: skip
    result.write(out)
    click.echo(f"wrote {out} ({'x'.join(map(str, result.array.shape[::-1]))} voxels from {frames} images)")


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
@device_option
@click.pass_context
def validate(ctx: click.Context, out: Path, only: tuple[str, ...], device: str | None) -> None:
    """Measure the simulator against theory on phantoms: tables and pictures; exit status 1 if any number is off."""
    from SlicerUSSim.Logic.verification.validation import chosen_checks, validate as run

    with Steps(sum(len(check.orientations) for check in chosen_checks(only))) as step:
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
@device_option
def devices(device: str | None) -> None:
    """Which OpenCL devices exist, which one is used and why, and how to get a faster one."""
    from SlicerUSSim.Logic.opencl.devices import choose_device, faster_hint, list_devices

    chosen, reason = choose_device(device)
    for info in list_devices():
        click.echo(f"{'*' if info == chosen else ' '} {info}, {info.memory_mb} MB")
    click.echo(f"used: {chosen.index}, {reason}")
    hint = faster_hint(chosen)
    if hint:
        click.echo(f"faster on this computer: {hint}")


main.add_command(bench)
main.add_command(serve)
main.add_command(sweep)
main.add_command(optimize)

if __name__ == "__main__":
    main()
