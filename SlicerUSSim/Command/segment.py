"""`ussim segment`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

from SlicerUSSim.Command.additions import Additions, add_option
from SlicerUSSim.Command.options import check_output, device_option, gathered, mask_option
from SlicerUSSim.Command.progress import Share, note
from SlicerUSSim.Logic.mri.settings import SegmentationSettings


@click.command()
@click.argument("mri", type=click.Path())
@click.option(
    "-o",
    "--out",
    type=click.Path(path_type=Path),
    required=True,
    help="Label map; the tissue table is written to a .json file of the same name.",
)
@gathered(settings=SegmentationSettings)
@mask_option
@add_option
@click.option(
    "--overwrite", is_flag=True, help="Replace labels that were made by others, or edited since they were written."
)
@device_option
def segment(
    mri: str, out: Path, settings: SegmentationSettings, mask: str | None, additions: tuple[str, ...], overwrite: bool,
    device: str | None,
) -> None:  # fmt: skip
    """Segment a skull-stripped brain MRI into tissues."""
    from SlicerUSSim.Logic.base.volume import Volume
    from SlicerUSSim.Logic.mri.segmentation import segment_mri
    from SlicerUSSim.Logic.tissue.own_files import require_replaceable, write_label_files
    from SlicerUSSim.Logic.tissue.table import TissueTable

    check_output(out)
    if not overwrite:
        require_replaceable(out)
    masks = Additions.read(additions)
    volume = Volume.read(mri)
    with Share("segment") as progress:
        result = segment_mri(
            volume, **asdict(settings), mask=Volume.read(mask) if mask else None, device=device, progress=progress,
        )  # fmt: skip
    added = masks.on(result.labels, result.tissue_names)
    beside = write_label_files(out, added.labels, TissueTable.brain(added.tissue_names))
    for label, (name, mean, sd, weight) in enumerate(
        zip(result.tissue_names, result.means, result.standard_deviations, result.weights, strict=False), 1
    ):
        click.echo(f"label {label}: {name:14s} mean {mean:8.2f}  sd {sd:7.2f}  share {weight:5.1%}")
    note(f"wrote {out} and {beside}")
