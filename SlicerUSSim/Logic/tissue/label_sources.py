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
from SlicerUSSim.Logic.tissue.probability_maps import CombinedMaps, combined_probability_maps
from SlicerUSSim.Logic.tissue.table import TissueTable, tissues_beside

_log = logging.getLogger(__name__)


def is_label_file(path: Path, volume: Volume) -> bool:
    """Whether a file is a label map or a tissue probability map, and no MRI.

    Raises SimulationError for a probability map whose companions are missing, and for labels with fractions.
    """
    if volume.looks_like_labels() or _without_labels(path, volume) is not None:
        return True
    why = not_intensities(volume)
    require(why is None, f"{path}: {why}")
    return False


def not_intensities(volume: Volume) -> str | None:
    """What a volume is, and what to do, if it is a label map or what is left of one; None for an image."""
    if volume.looks_like_labels():
        return "is a label map, expected the intensities of an MRI"
    if is_partial_volume_map(volume.array):
        return (
            "is a partial volume map of three tissues, as CAT12's p0, or their label map resampled with interpolation, "
            "expected the intensities of an MRI; use it as a label map"
        )
    if has_uniform_fractions(volume.array):
        return (
            "is uniform regions of few values with fractions, as a label map that was scaled or shifted, expected an "
            "MRI or labels; save the labels as whole numbers"
        )
    return None


def _without_labels(path: Path, volume: Volume) -> CombinedMaps | None:
    """The label map of what holds probabilities or partial volumes, and no labels; None if it is neither."""
    maps = combined_probability_maps(path, volume)
    return partial_volume_labels(path, volume) if maps is None else maps


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
    file's header or in a table beside it; `preset`, if it has every label; the numbers of a known program.

    Parameters
    ----------
    table : given for this label map (--tissues).
    preset : of a preset that the user gave; then the table beside the file is not used.
    default : tissues by their names, and the membrane, if neither of them is given.
    of_ct : as of read_label_map.

    Raises SimulationError as read_label_map does.
    """
    mapping = mapping or LabelMapping()
    maps = _without_labels(path, volume)
    if maps is not None:
        if not any(mapping.tissue_of(label, name) for label, name in maps.names.items()):
            maps.require_order(str(path))
        found = read_label_map(maps.labels, maps.names, mapping, source=str(path), tissues=table or preset or default)
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


# ---- CAT12's partial volume map p0: 1 CSF, 2 grey, 3 white matter, and fractions between them ------------------------
# Many voxels are one pure tissue, at exactly 1, 2 and 3, and nothing is above.
# Noise widens the tissues of an MRI, and one cut off at its largest value has no peaks below it (C. Gaser et al.,
# GigaScience 13, 2024).

#: Largest value, which is that of pure white matter
_LARGEST = (2.95, 3.05)
#: Half of the width of a peak, and the share of what is above zero that peaks of grey and white matter have at least
_NEAR, _PURE_SHARE = 0.03, 0.04
#: How many times more voxels are at 2 than half-way to 1 and 3
_ABOVE_BETWEEN = 2.0
#: Share of what is above zero that is at least between the peaks; a label map stored as floating point has none
_FRACTIONS_SHARE = 0.02


def partial_volume_labels(path: Path, volume: Volume) -> CombinedMaps | None:
    """The label map of CAT12's p0, each voxel its nearest tissue; None if it is none."""
    if not is_partial_volume_map(volume.array):
        return None
    labels = volume.with_array(np.rint(np.clip(volume.array, 0, 3)).astype(np.uint8))
    message = f"{path}: CAT12's partial volume map (p0), 3 tissues: 1 csf, 2 grey matter, 3 white matter, rounded"
    return CombinedMaps(labels, message, (path.name,) * 3)


def is_partial_volume_map(array: np.ndarray) -> bool:
    """Whether a (k, j, i) array is a partial volume map of CSF, grey and white matter, 0 to 3, by its histogram."""
    if not np.issubdtype(array.dtype, np.floating):
        return False
    low, high = float(array.min()), float(array.max())  # NaN fails both comparisons
    if not (low >= -_NEAR and _LARGEST[0] <= high <= _LARGEST[1]):
        return False
    inside = array[array > _NEAR]
    grey, white, below, above = (float(np.mean(np.abs(inside - at) < _NEAR)) for at in (2.0, 3.0, 1.5, 2.5))
    has_fractions = float(np.mean(np.abs(inside - np.rint(inside)) > _NEAR)) >= _FRACTIONS_SHARE
    return has_fractions and min(grey, white) >= _PURE_SHARE and grey >= _ABOVE_BETWEEN * max(below, above)
