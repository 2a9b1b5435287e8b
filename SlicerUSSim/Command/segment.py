"""`ussim segment`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

from SlicerUSSim.Command.options import also_option, check_output, device_option, gathered, mask_option, read_others
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
@also_option
@mask_option
@device_option
def segment(
    mri: str, out: Path, settings: SegmentationSettings, also: tuple[str, ...], mask: str | None, device: str | None
) -> None:
    """Segment the MRI of a head or brain into tissues."""
    from SlicerUSSim.Logic.base.volume import Volume
    from SlicerUSSim.Logic.mri.segmentation import segment_mri
    from SlicerUSSim.Logic.tissue.table import TissueTable, tissues_beside

    check_output(out)
    volume = Volume.read(mri)
    with Share("segment") as progress:
        result = segment_mri(
            volume, **asdict(settings), others=read_others(also), mask=Volume.read(mask) if mask else None,
            device=device, progress=progress,
        )  # fmt: skip
    result.labels.write(out)
    TissueTable.brain(result.tissue_names).write(tissues_beside(out))
    for line in result.notes:
        note(line)
    for line in result.warnings:
        note(f"warning: {line}")
    click.echo(result.table())
    note(f"wrote {out} and {tissues_beside(out)}")
