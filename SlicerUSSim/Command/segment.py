"""`ussim segment`."""

from __future__ import annotations

from pathlib import Path

import click

from SlicerUSSim.Command.options import check_output, contrast_option, device_option, mask_option, sulci_option
from SlicerUSSim.Command.progress import Share, note


@click.command()
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
def segment(
    mri: str, out: Path, contrast: str, classes: int, mask: str | None, radius: int, bias_correction: bool,
    thin_sulci: bool, device: str | None,
) -> None:  # fmt: skip
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
    note(f"wrote {out} and {tissues_beside(out)}")
