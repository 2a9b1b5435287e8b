"""Files of a label map and its tissue table, which are replaced only while they are as this package wrote them."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.files import read_json, write_json
from SlicerUSSim.Logic.base.volume import Volume
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
    write_json(beside, {**values, _LABELS: _hash_of_labels(Volume.read(path)), _TABLE: _hash_of_table(values)})
    return beside


def require_replaceable(path: Path, remedy: str = "give another name, or --overwrite to replace it") -> None:
    """Raise SimulationError for a label map, or a table beside it, that were made or edited by others."""
    beside = tissues_beside(path)
    for file in (path, beside):
        why = None if not file.exists() else _why_not_ours(path, beside)
        require(
            why is None,
            f"{file}: {why}, so it is not replaced; {remedy}",
        )


def _why_not_ours(path: Path, beside: Path) -> str | None:
    if not beside.exists():
        return f"exists and was not written by this program ({beside.name} is not beside it)"
    try:
        values = read_json(beside)
        hashes = (values.pop(_LABELS, None), values.pop(_TABLE, None)) if isinstance(values, dict) else (None, None)
        if None in hashes:
            return f"exists and was not written by this program ({beside.name} does not say so)"
        if hashes[1] != _hash_of_table(values):
            return f"the tissues in {beside.name} have been edited"
        if path.exists() and hashes[0] != _hash_of_labels(Volume.read(path)):
            return "the labels have been edited since this program wrote them"
    except SimulationError as error:
        return f"exists and cannot be read ({error})"
    return None


def _hash_of_labels(labels: Volume) -> str:
    content = hashlib.sha256(repr((labels.array.shape, labels.ijk_to_ras.round(4).tolist())).encode())
    content.update(labels.array.astype(np.int32).tobytes())
    return content.hexdigest()


def _hash_of_table(values: dict) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
