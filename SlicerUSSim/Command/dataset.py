"""`ussim dataset`."""

from __future__ import annotations

import os
from pathlib import Path

import click

from SlicerUSSim.Command.options import device_option, out_option
from SlicerUSSim.Command.progress import Curve, note


@click.command()
@click.argument("recipe")
@out_option("Folder of the set; one that this recipe has begun is completed.")
@click.option(
    "--scheduler", metavar="tcp://HOST:PORT|FILE",
    help="Scheduler of a Dask cluster (docs/scale.md), by its address or file (default: processes on this computer).",
)  # fmt: skip
@click.option(
    "--workers", type=click.IntRange(1, 1024),
    help="Processes on this computer; 1: without Dask (default: one for each core that has memory).",
)  # fmt: skip
@click.option(
    "--export", type=click.Choice(("coco", "nnunet")), multiple=True, help="Also for COCO or nnU-Net v2; repeatable."
)
@device_option
@click.pass_context
def dataset(
    ctx: click.Context, recipe: str, out: Path, scheduler: str | None, workers: int | None, export: tuple[str, ...],
    device: str | None,
) -> None:  # fmt: skip
    """Make many labelled images from a recipe.

    RECIPE is a file in TOML (docs/datasets.md), or the name of one in the package: brain-tumour, denoising,
    mri-registration, standard-views or ventricles.

    Image n is the same whoever makes it on the same OpenCL runtime. The same command resumes an interrupted set.

    The exit status is 1 if a patient was left out.
    """
    from SlicerUSSim.Logic.datasets import Recipe, export_coco, export_nnunet, make_dataset
    from SlicerUSSim.Logic.datasets.reader import labels_to_export

    if device is not None:
        os.environ["USSIM_DEVICE"] = device  # workers have it, too
    read = Recipe.read(recipe)
    if export:  # before hours of work
        labels_to_export(read.settings.outputs, read.settings.format, recipe)
    note(f"{recipe}: {read.settings.images} images of {read.cases} cases in {read.shards} shards of {read.shard}")
    with Curve("dataset") as progress:
        made = make_dataset(read, out, scheduler=scheduler, workers=workers, progress=progress, say=note)
    for why in made.skipped.values():
        note(f"left out: {why}")
    for form in export:
        note(f"wrote {(export_coco if form == 'coco' else export_nnunet)(out)}")
    memory = f", at most {made.peak_mb:.0f} MB in a process" if made.peak_mb else ""
    rate = f", {made.rate:.1f} images/s" if made.rate else ""
    note(f"wrote {out} ({made.done} images{rate}{memory})")
    ctx.exit(1 if made.skipped else 0)
