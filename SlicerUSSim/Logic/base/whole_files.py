"""Files that are whole by themselves: no headers whose voxels are in another file, which could be anybody's."""

from __future__ import annotations

import re
from pathlib import Path

from SlicerUSSim.Logic.base.errors import require

#: Where headers end that name their voxels
_HEADER_BYTES = 2**16
#: First words of MetaImage headers, whose lines may come in any order
_META = re.compile(rb"\s*(?:ObjectType|NDims|Comment|ObjectSubType|BinaryData)\s*=")
_NRRD = re.compile(rb"^data ?file:\s*(.*)$", re.MULTILINE | re.IGNORECASE)
_METAIMAGE = re.compile(rb"^ElementDataFile\s*=[ \t]*(.*)$", re.MULTILINE)


def require_whole_file(path: Path) -> None:
    """Raise SimulationError for a file of a bundle that is a header whose voxels are in another file."""
    other = other_file(path.name, path.read_bytes())
    require(other is None, f"{path.name}: is a header whose voxels are in another file ({other}), expected one file")


def other_file(name: str, content: bytes) -> str | None:
    """The file that a header names as its voxels; None for a file that is whole."""
    lower, start = name.lower(), content[:4]
    if lower.endswith((".mhd", ".mha")) or _META.match(content[:256]):
        # Of a sequence the line comes after the fields of all images
        found = _METAIMAGE.search(content)
        named = found[1].strip().decode("utf-8", "replace") if found else ""
        return None if named in ("", "LOCAL", "Local", "local") else plain(named)
    if start == b"NRRD":
        found = _NRRD.search(content.partition(b"\n\n")[0][:_HEADER_BYTES])
        return plain(found[1].strip().decode("utf-8", "replace")) if found else None
    if lower.endswith((".nhdr", ".hdr", ".img")) and content[128:132] != b"DICM":  # as some DICOM files are called
        return "beside it"
    return None


def plain(text: str) -> str:
    """A text for a message, short and without control characters."""
    plain = "".join(letter if letter.isprintable() else "?" for letter in text)
    return plain if len(plain) <= 60 else f"{plain[:57]}..."
