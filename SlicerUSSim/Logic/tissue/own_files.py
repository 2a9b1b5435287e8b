"""Files of a label map and its tissue table, which are replaced only while they are as this package wrote them."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.files import read_json, write_json
from SlicerUSSim.Logic.base.own_outputs import hash_of_values
from SlicerUSSim.Logic.base.volume import WRITABLE_SUFFIXES, Volume
from SlicerUSSim.Logic.tissue.table import TissueTable, tissues_beside

#: Entries of the table's file: hashes of the labels and of the table, as they were written.
_LABELS, _TABLE = "labels_sha256", "tissues_sha256"


def write_label_files(path: Path, labels: Volume, tissues: TissueTable) -> Path:
    """Write a label map, and its tissue table beside it, whose path is returned.

    Raises SimulationError if one of them cannot be written.
    """
    beside = tissues_beside(path)
    labels.write(path)
    values = tissues.to_dict()
    # Of the file as it is read, since formats differ in the precision of positions.
    write_json(beside, {**values, _LABELS: _hash_of_labels(Volume.read(path)), _TABLE: hash_of_values(values)})
    return beside


def require_replaceable(path: Path, remedy: str = "give another name, or --overwrite to replace it") -> None:
    """Raise SimulationError for a label map, or a table beside it, that were made or edited by others.

    So for the table of another label map, whose file has the same name with another ending.
    """
    beside = tissues_beside(path)
    other = None if path.exists() or not beside.exists() else _other_labels(path, beside)
    require(other is None, f"{beside}: has the tissues of {other}, so it is not replaced; {remedy}")
    for file in (path, beside):
        why = None if not file.exists() else _why_not_ours(path, beside)
        require(
            why is None,
            f"{file}: {why}, so it is not replaced; {remedy}",
        )


def _other_labels(path: Path, beside: Path, labels_hash: str | None = None) -> str | None:
    """The name of another label map with this table, as far as it can be read; of the one with this hash."""
    from SlicerUSSim.Logic.tissue.label_sources import is_label_file  # which needs more than files

    for file in sorted(path.parent.iterdir()):
        if (
            file not in (path, beside)
            and tissues_beside(file) == beside
            and file.name.lower().endswith(WRITABLE_SUFFIXES)
        ):
            try:
                volume = Volume.read(file)
                if is_label_file(file, volume) and labels_hash in (None, _hash_of_labels(volume)):
                    return file.name
            except SimulationError:
                continue
    return None


def _why_not_ours(path: Path, beside: Path) -> str | None:
    if not beside.exists():
        return f"exists and was not written by this program ({beside.name} is not beside it)"
    try:
        values = read_json(beside)
        hashes = (values.pop(_LABELS, None), values.pop(_TABLE, None)) if isinstance(values, dict) else (None, None)
        if None in hashes:
            return f"exists and was not written by this program ({beside.name} does not say so)"
        if hashes[1] != hash_of_values(values):
            return f"the tissues in {beside.name} have been edited"
        if path.exists() and hashes[0] != _hash_of_labels(Volume.read(path)):
            other = _other_labels(path, beside, hashes[0])
            if other is not None:
                return f"exists, and {beside.name} has the tissues of {other}"
            return "the labels have been edited since this program wrote them"
    except SimulationError as error:
        return f"exists and cannot be read ({error})"
    return None


def _hash_of_labels(labels: Volume) -> str:
    content = hashlib.sha256(repr((labels.array.shape, labels.ijk_to_ras.round(4).tolist())).encode())
    content.update(labels.array.astype(np.int32).tobytes())
    return content.hexdigest()
