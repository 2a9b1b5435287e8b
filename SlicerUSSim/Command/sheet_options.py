"""--sheets and no_sheets: thin sheets and small structures found after a segmentation, and in images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from SlicerUSSim.Command.mri_options import NONE
from SlicerUSSim.Command.progress import Share, note
from SlicerUSSim.Logic.base.errors import require

if TYPE_CHECKING:
    from SlicerUSSim.Logic.base import Volume
    from SlicerUSSim.Logic.mri import Segmentation
    from SlicerUSSim.Logic.tissue import Surfels

sheets_option = click.option(
    "--sheets", type=click.Path(path_type=Path), metavar="FILE",
    help="Also find sulci, falx, tentorium and walls of ventricles as surfaces and write them to FILE, a .vtp "
    "for Slicer; corpus callosum, choroid plexus and vessels are laid over the labels. T1, T1 with contrast, or T2.",
)  # fmt: skip
#: Value of --sheets that is not a file, like NONE
AUTO = "auto"


@dataclass(frozen=True, eq=False)
class DrawnSheets:
    """What --sheets and no_sheets ask for in images."""

    #: AUTO, NONE, or a file
    source: str
    #: Of ALL_KINDS
    kinds: tuple[str, ...]
    #: Of the file
    read: Surfels | None = None

    @classmethod
    def of(cls, source: str, without: tuple[str, ...], *, is_labels: bool, contrast: str) -> DrawnSheets:
        """Reads and checks, before anything slow. Raises SimulationError for what cannot be met."""
        require(source != NONE or not without, "no_sheets leaves out some of --sheets; give --sheets, too")
        if source == NONE:
            return cls(source, ())
        from SlicerUSSim.Logic.mri.sheets.finding import ALL_KINDS, require_findable
        from SlicerUSSim.Logic.mri.sheets.polydata import read_surfels
        from SlicerUSSim.Logic.tissue.surfels import KINDS

        for kind in without:
            require(kind in ALL_KINDS, f"no_sheets is {kind!r}, expected one of: {', '.join(ALL_KINDS)}")
        kinds = tuple(kind for kind in ALL_KINDS if kind not in without)
        if source != AUTO:
            require(
                Path(source).is_file(), f"--sheets is {source!r} (no such file), expected a .vtp file, {AUTO} or {NONE}"
            )
            for kind in dict.fromkeys(kind for kind in without if kind not in KINDS):
                note(f"no_sheets {kind} has no effect: sheets of {source} do not include it; the labels may")
            whole = read_surfels(source)
            return cls(source, kinds, whole.of_kind(*(set(KINDS) & set(kinds))))
        require(not is_labels, "--sheets is auto, and a label map has no sheets, expected a .vtp or an MRI")
        require_findable(kinds, contrast)
        return cls(source, kinds)

    def found(
        self, mri_path: str, mri: Volume, segmentation: Segmentation, contrast: str
    ) -> tuple[Surfels | None, Volume, tuple[str, ...]]:
        """(Sheets of an MRI, its labels, their names with the structures on top). One search keeps all."""
        if self.source != AUTO or not self.kinds:
            return self.read, segmentation.labels, segmentation.tissue_names
        return _searched(mri_path, mri, segmentation, contrast, self.kinds)


def require_sheets(path: Path, contrast: str) -> None:
    """Raise SimulationError, before anything slow, for a file of --sheets of another kind, or another contrast."""
    from SlicerUSSim.Logic.mri.sheets.finding import require_findable
    from SlicerUSSim.Logic.mri.sheets.polydata import require_surfel_file

    require_findable((), contrast)
    require_surfel_file(path)


def write_sheets(
    path: Path, mri_path: str, mri: Volume, found: Segmentation, contrast: str
) -> tuple[Volume, tuple[str, ...]]:
    """Find the sheets of a segmented MRI and write them; returns the labels and names with the structures on top."""
    from SlicerUSSim.Logic.mri.sheets.finding import ALL_KINDS
    from SlicerUSSim.Logic.mri.sheets.polydata import write_surfels

    surfels, labels, names = _searched(mri_path, mri, found, contrast, ALL_KINDS)
    write_surfels(path, surfels)
    note(f"wrote {path}")
    return labels, names


def _searched(
    mri_path: str, mri: Volume, found: Segmentation, contrast: str, shown: Sequence[str]
) -> tuple[Surfels, Volume, tuple[str, ...]]:
    """(Sheets, labels, names) of the kinds `shown` of all; with notes on them."""
    from SlicerUSSim.Logic.base.errors import about_file
    from SlicerUSSim.Logic.mri.pathology import add_tissues
    from SlicerUSSim.Logic.mri.sheets.finding import ALL_KINDS, find_sheets
    from SlicerUSSim.Logic.mri.sheets.kept import sheets_beside
    from SlicerUSSim.Logic.tissue.surfels import KINDS

    with Share("sheets") as progress, about_file(mri_path):
        sheets = find_sheets(
            mri, found, contrast=contrast, kinds=ALL_KINDS, keep_at=sheets_beside(mri_path), progress=progress
        )
    for line in sheets.notes:
        if not line.startswith(tuple(f"{kind}:" for kind in ALL_KINDS if kind not in shown)):
            note(line)
    labels, names = found.labels, found.tissue_names
    masks = [mask for mask in sheets.masks() if mask[2] in shown]
    if masks:
        added = add_tissues(labels, names, masks, has_brain_mask=True)
        labels, names = added.labels, added.tissue_names
    return sheets.surfels.of_kind(*(set(KINDS) & set(shown))), labels, names
