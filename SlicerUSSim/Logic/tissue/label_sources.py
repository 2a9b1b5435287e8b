"""read_label_file: the tissues of a label map's file, with the tables and names beside it."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.files import read_json
from SlicerUSSim.Logic.base.label_numbers import has_uniform_fractions
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.tissue.label_files import names_of_file
from SlicerUSSim.Logic.tissue.label_mapping import LabelMapping
from SlicerUSSim.Logic.tissue.label_maps import LabelledTissues, as_whole, read_label_map
from SlicerUSSim.Logic.tissue.names import BRAIN_TISSUES
from SlicerUSSim.Logic.tissue.probability_maps import combined_probability_maps
from SlicerUSSim.Logic.tissue.table import TissueTable, tissues_beside

_log = logging.getLogger(__name__)


def is_label_file(path: Path, volume: Volume) -> bool:
    """Whether a file is a label map or a tissue probability map, and no MRI.

    Raises SimulationError for a probability map whose companions are missing, and for labels with fractions.
    """
    if volume.looks_like_labels() or combined_probability_maps(path, volume) is not None:
        return True
    why = not_intensities(volume)
    require(why is None, f"{path}: {why}")
    return False


def not_intensities(volume: Volume) -> str | None:
    """What a volume is, and what to do, if it is a label map or the remains of one; None for an image."""
    if volume.looks_like_labels():
        return "is a label map, expected the intensities of an MRI"
    if has_uniform_fractions(volume.array):
        return (
            "is uniform regions with fractions, as a label map that was scaled or interpolated, expected an MRI or "
            "labels; save labels as whole numbers, and resample them with nearest-neighbour interpolation"
        )
    return None


def read_label_file(
    path: Path,
    volume: Volume,
    mapping: LabelMapping | None = None,
    *,
    table: TissueTable | None = None,
    preset: TissueTable | None = None,
    default: TissueTable | None = None,
    of_ct: bool = False,
) -> LabelledTissues:
    """The tissues of a label map that was read from a file.

    In this order: the user's mapping; `table`, or the tissue table beside the file, if it has every label; names in the
    file's header or in a table beside it; `preset`, if it has every label; the numbers of the only program that can
    have written it.

    Parameters
    ----------
    table : given for this label map (--tissues).
    preset : of a preset that the user gave; then the table beside the file is not used.
    default : tissues by their names, and the membrane, if neither of them is given.
    of_ct : as for read_label_map.

    Raises SimulationError as read_label_map does.
    """
    mapping = mapping or LabelMapping()
    maps = combined_probability_maps(path, volume)
    if maps is not None:
        names = dict(enumerate(BRAIN_TISSUES, 1))
        found = read_label_map(maps.labels, names, mapping, source=str(path), tissues=table or preset or default)
        return replace(found, message=maps.message.removeprefix(f"{path}: "))
    own = table
    if own is None and preset is None:
        own = table_beside(path)
    names, where = names_of_file(path, volume)
    present = np.flatnonzero(np.bincount(as_whole(volume, str(path)).array.ravel())).tolist()
    by_number = own
    if own is not None and all(label in own for label in present if label not in mapping.by_label):
        names = {}
    elif own is None and not names and preset is not None and all(label in preset for label in present if label):
        by_number = preset
    found = read_label_map(
        volume, names, mapping, source=str(path), tissues=own or preset or default, by_number=by_number, of_ct=of_ct,
    )  # fmt: skip
    return replace(found, message=f"{found.message}, named in {where}") if names else found


def table_beside(path: Path) -> TissueTable | None:
    """The tissue table beside a label map, as `ussim segment` writes it; other programs' .json files are left alone."""
    beside = tissues_beside(path)
    if not beside.exists():
        return None
    values = read_json(beside)
    if not isinstance(values, dict) or "tissues" not in values:
        _log.info("%s: has no tissues and is not used", beside)
        return None
    _log.info("tissues: the table next to the label map, %s", beside)
    return TissueTable.from_dict(values, str(beside))
