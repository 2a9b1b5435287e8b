"""`ussim segment`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from time import perf_counter

import click

from SlicerUSSim.Command.additions import Additions
from SlicerUSSim.Command.mri_options import MriOptions, also_files, read_mri, segmented_file
from SlicerUSSim.Command.options import check_outputs, gathered, out_option, overwrite_option
from SlicerUSSim.Command.progress import note
from SlicerUSSim.Command.seeds import (
    grown_at,
    require_none_refused,
    require_seeds,
    seed_option,
    split_seeds,
    write_lesions,
)
from SlicerUSSim.Command.sheet_options import require_sheets, sheets_option, write_sheets
from SlicerUSSim.Logic.base.errors import SimulationError, require


@click.command()
@click.argument("mri", type=click.Path())
@gathered(patient=MriOptions)
@out_option("Label map; the tissue table is written to a .json file of the same name.")
@seed_option
@sheets_option
@overwrite_option
def segment(mri: str, patient: MriOptions, out: Path, seeds: tuple[str, ...], sheets: Path | None) -> None:
    """Segment an MRI of a head or a brain, or a CT, into tissues."""
    from SlicerUSSim.Logic.base.volume import require_image_name
    from SlicerUSSim.Logic.mri.modality import has_brain_mask
    from SlicerUSSim.Logic.mri.outside import require_findable
    from SlicerUSSim.Logic.mri.segmentation import Segmentation
    from SlicerUSSim.Logic.tissue.table import TissueTable, tissues_beside, write_label_files

    for change in patient.changes:
        raise SimulationError(f"--set {change}: no image is simulated, expected a key of segmentation")
    require_image_name(out)
    check_outputs(out, tissues_beside(out), sheets)
    also_files(patient.also)
    split_seeds(seeds)
    masks = Additions.read(patient.additions)
    volume = read_mri(mri, patient)
    patient = patient.for_image(volume)
    settings = patient.segmentation
    if settings.outside and not patient.is_ct:
        require_findable(settings.contrast, settings.skull_strip, patient.mask is not None)
    if sheets is not None:
        require_sheets(sheets, settings.contrast)
    if seeds:
        require(has_brain_mask(settings.contrast), "--seed grows lesions of an MRI, and this is a CT")
        require_seeds(seeds, volume, out)
    start = perf_counter()
    result = segmented_file(mri, volume, patient, tell_all=True)
    seconds = perf_counter() - start
    lesions, refused = grown_at(result, seeds) if isinstance(result, Segmentation) else ([], [])
    labels, names = result.labels, result.tissue_names
    if sheets is not None and isinstance(result, Segmentation):
        labels, names = write_sheets(sheets, mri, volume, result, settings.contrast)
    added = masks.on(labels, names, has_brain_mask=has_brain_mask(settings.contrast))
    beside = write_label_files(out, added.labels, TissueTable.brain().for_names(added.tissue_names))
    click.echo(replace(result, labels=added.labels, tissue_names=added.tissue_names).table())
    note(f"segmented in {seconds:.1f} s; wrote {out} and {beside}")
    write_lesions(lesions, out)
    require_none_refused(refused, out)  # at last: a wrong seed does not cost a segmentation
