"""`ussim segment`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from time import perf_counter

import click

from SlicerUSSim.Command.options import check_output, device_option, gathered, mask_option
from SlicerUSSim.Command.progress import Share, note, note_brain
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
@device_option
def segment(mri: str, out: Path, settings: SegmentationSettings, mask: str | None, device: str | None) -> None:
    """Segment an MRI of a head or a brain into tissues."""
    from SlicerUSSim.Logic.base.volume import Volume
    from SlicerUSSim.Logic.mri.kept_mask import mask_beside
    from SlicerUSSim.Logic.mri.segmentation import segment_mri
    from SlicerUSSim.Logic.tissue.table import TissueTable, tissues_beside

    check_output(out)
    volume = Volume.read(mri)
    start = perf_counter()
    with Share("segment") as progress:
        result = segment_mri(
            volume, **asdict(settings), mask=Volume.read(mask) if mask else None, keep_mask_at=mask_beside(mri),
            device=device, progress=progress,
        )  # fmt: skip
    seconds = perf_counter() - start
    note_brain(result.brain)
    result.labels.write(out)
    TissueTable.brain(result.tissue_names).write(tissues_beside(out))
    for label, (name, mean, sd, weight) in enumerate(
        zip(result.tissue_names, result.means, result.standard_deviations, result.weights, strict=False), 1
    ):
        click.echo(f"label {label}: {name:14s} mean {mean:8.2f}  sd {sd:7.2f}  share {weight:5.1%}")
    note(f"segmented in {seconds:.1f} s; wrote {out} and {tissues_beside(out)}")
