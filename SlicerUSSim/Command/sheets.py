"""--sheets and --sheet: thin sheets and small structures that are looked for after a segmentation."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from SlicerUSSim.Command.progress import Share, note
from SlicerUSSim.Logic.base.errors import require

if TYPE_CHECKING:
    from SlicerUSSim.Logic.base import Volume
    from SlicerUSSim.Logic.mri import Segmentation

sheets_option = click.option(
    "--sheets", type=click.Path(path_type=Path), metavar="FILE",
    help="Also find sulci, falx, tentorium and walls of ventricles as surfaces and write them to FILE, a .vtp or .ply "
    "for Slicer; corpus callosum, choroid plexus and vessels are laid over the labels. T1, T1 with contrast, or T2.",
)  # fmt: skip
sheet_kind_option = click.option(
    "--sheet", "sheet_kinds", multiple=True, metavar="KIND",
    help="What --sheets looks for: sulcus, falx, tentorium, ependyma, corpus callosum, choroid plexus or vessels; may "
    "be repeated (default: all).",
)  # fmt: skip


def require_sheets(path: Path | None, kinds: tuple[str, ...], contrast: str) -> None:
    """Raise SimulationError, before anything slow, for values of --sheets and --sheet that cannot be met."""
    require(path is not None or not kinds, "--sheet chooses what --sheets FILE looks for; give --sheets, too")
    if path is None:
        return
    from SlicerUSSim.Command.options import check_places
    from SlicerUSSim.Logic.mri.sheets.finding import require_findable
    from SlicerUSSim.Logic.mri.sheets.polydata import require_own_surface, require_surfel_file

    require_findable(kinds, contrast)
    require_surfel_file(path)
    check_places(path)
    require_own_surface(path)


def write_sheets(
    path: Path, mri_path: str, mri: Volume, found: Segmentation, contrast: str, kinds: tuple[str, ...]
) -> tuple[Volume, tuple[str, ...]]:
    """Find the sheets of a segmented MRI and write them; returns the labels and names with the structures on top."""
    from SlicerUSSim.Logic.base.errors import about_file
    from SlicerUSSim.Logic.mri.pathology import add_tissues
    from SlicerUSSim.Logic.mri.sheets.finding import ALL_KINDS, find_sheets
    from SlicerUSSim.Logic.mri.sheets.kept import sheets_beside
    from SlicerUSSim.Logic.mri.sheets.polydata import write_surfels

    with Share("sheets") as progress, about_file(mri_path):
        sheets = find_sheets(
            mri, found, contrast=contrast, kinds=kinds or ALL_KINDS, keep_at=sheets_beside(mri_path), progress=progress
        )
    write_surfels(path, sheets.surfels)
    for line in sheets.notes:
        note(line)
    note(f"wrote {path}")
    masks = sheets.masks()
    if not masks:
        return found.labels, found.tissue_names
    added = add_tissues(found.labels, found.tissue_names, masks, has_brain_mask=True)
    return added.labels, added.tissue_names
