"""Names of labels in files: in a label map's own header, or in a table beside it.

Headers: segments of DICOM SEG and 3D Slicer's .seg.nrrd, and the label table that TotalSegmentator writes into NIfTI.
Tables: ITK-SNAP's label descriptions, 3D Slicer's colour tables (.ctbl, .csv), FreeSurfer's look-up tables, and those
of BIDS (.tsv with columns index and name). The label's SNOMED CT code replaces a name that matches no tissue.
"""

from __future__ import annotations

import csv
import logging
import re
from pathlib import Path

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.files import read_text
from SlicerUSSim.Logic.base.reading import reader
from SlicerUSSim.Logic.base.segments import is_meaningful, ranked_codes
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.tissue.names import name_or_term

_log = logging.getLogger(__name__)

_LARGEST_TABLE = 4 * 2**20
TABLE_SUFFIXES = (".txt", ".ctbl", ".label", ".lut", ".tsv", ".csv")
#: 1   255 0 0   1 1 1   "Left kidney", with \ before a quote in a name
_SNAP = re.compile(r'\s*(\d+)\s[\d\s.]+"((?:[^"\\]|\\.)*)"\s*')
#: The number in front of a line of separated values
_SEPARATED = re.compile(r'\s*"?\d+"?\s*([\t,;])')
#: 24  CSF  60 60 60 0
_PLAIN = re.compile(r"\s*(\d+)\s+(.*?)((?:\s+[\d.]+){3,8})?\s*")
#: Columns of 3D Slicer's tables with codes, in the order of ranked_codes
_CODES = tuple(f"{name}_CodeValue" for name in ("Category", "Type", "TypeModifier", "Region"))


def names_of_file(path: Path, volume: Volume) -> tuple[dict[int, str], str]:
    """({label: name}, where they are from) of a label map, read from a file; ({}, "") if it has none.

    Raises SimulationError for a table beside it that cannot be read.
    """
    given = {label: name_or_term(name, volume.label_codes.get(label, ())) for label, name in volume.label_names.items()}
    names = {label: name for label, name in given.items() if is_meaningful(name)}
    if names:
        return names, "its header"
    stem = path.name
    for suffix in (".seg.nrrd", ".nii.gz", path.suffix):
        if suffix and stem.lower().endswith(suffix.lower()):
            stem = stem[: -len(suffix)]
            break
    # 3D Slicer exports a label map as NAME.nii.gz and NAME_ColorTable.csv, or .ctbl.
    for suffix in (*TABLE_SUFFIXES, "_ColorTable.csv", "_ColorTable.ctbl"):
        beside = path.with_name(stem + suffix)
        if beside.is_file():
            names = read_names(beside)
            if names:
                return names, beside.name
            _log.info("%s: has no names of labels", beside)
    return {}, ""


@reader
def read_names(path: Path) -> dict[int, str]:
    """{label: name} of a table; lines that have no label and name are skipped.

    Raises SimulationError for a file that cannot be read and for a label with two names.
    """
    try:
        text = read_text(path, _LARGEST_TABLE, errors="replace")
    except OSError as error:
        raise SimulationError(f"{path}: cannot be read ({error.strerror})") from None
    names: dict[int, str] = {}
    header: list[str] = []
    for line in text.splitlines():
        label, name, columns = _entry(line)
        if label is None and "CodeValue" in line:
            header = next(csv.reader([line]))
        codes = [columns[header.index(column)] if column in header[: len(columns)] else "" for column in _CODES]
        name = name_or_term(name, ranked_codes(*codes))
        if label is None or not is_meaningful(name):
            continue
        require(
            names.get(label, name) == name, f"{path}: label {label} has two names, {names.get(label)!r} and {name!r}"
        )
        names[label] = name
    return names


def _entry(line: str) -> tuple[int | None, str, list[str]]:
    """(label, name, all columns of separated values) of a line of a table; None without."""
    found = _SNAP.fullmatch(line)
    if found:
        return int(found[1]), re.sub(r"\\(.)", r"\1", found[2]).strip(), []
    found = _SEPARATED.match(line)
    if found:
        columns = [column.strip() for column in next(csv.reader([line], delimiter=found[1], skipinitialspace=True))]
        number, name, *_ = *filter(None, columns), "", ""
        return (int(number) if number.isdecimal() else None), name.strip('"').strip(), columns
    found = _PLAIN.fullmatch(line)
    return (int(found[1]), found[2].strip().strip('"').strip(), []) if found else (None, "", [])
