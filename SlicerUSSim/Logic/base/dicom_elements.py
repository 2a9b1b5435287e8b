"""Lengths of elements of a DICOM file, which GDCM allocates and fills with zeros before it looks at the file's end.

A file of 1.5 kB, one of whose lengths was damaged, took 4 GB. Source of the encoding: DICOM PS3.5, chapters 7 and A.
"""

from __future__ import annotations

import mmap
import struct
from pathlib import Path

from SlicerUSSim.Logic.base.errors import SimulationError

#: Longer elements than this must be in the file; GDCM finds out by itself that a shorter one is cut. Those of the first
#: group it reads again then with type and length together as a length of four bytes.
_MOST_BEYOND, _MOST_BEYOND_IN_META = 2**16, 2**9
_PREAMBLE, _PREFIX = 128, b"DICM"
_UNDEFINED, _META = 0xFFFFFFFF, 2
_PIXELS, _ITEM, _SYNTAX = (0x7FE0, 0x0010), (0xFFFE, 0xE000), (0x0002, 0x0010)
#: Value representations with a length of four bytes (PS3.5, table 7.1-1); those of sequences are walked through
_LONG = {b"OB", b"OD", b"OF", b"OL", b"OV", b"OW", b"SQ", b"SV", b"UC", b"UN", b"UR", b"UT", b"UV"}
_TYPES = _LONG | set(b"AE AS AT CS DA DS DT FL FD IS LO LT PN SH SL SS ST TM UI UL US".split())
#: The bytes before the length of the transfer syntax, and how far into the file it is at most
_SYNTAX_ELEMENT, _META_BYTES = b"\x02\x00\x10\x00UI", 4096
_IMPLICIT, _BIG_ENDIAN, _DEFLATED = b"1.2.840.10008.1.2", b"1.2.840.10008.1.2.2", b"1.2.840.10008.1.2.1.99"
_UNCOMPRESSED = (_IMPLICIT, b"1.2.840.10008.1.2.1", _BIG_ENDIAN)


def require_sound_elements(path: Path) -> None:
    """Raise SimulationError for a DICOM file with an element, before its pixels, far beyond the end of the file.

    Other files pass, and so does what is no element of DICOM, of which GDCM says so; not in the group of the first
    elements, though, since GDCM reads them again in another encoding then, and takes text for lengths.
    """
    if path.stat().st_size < 8:
        return
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        if content[_PREAMBLE : _PREAMBLE + 4] == _PREFIX:
            start = _PREAMBLE + 4
        elif content[:2] in (b"\x02\x00", b"\x08\x00"):  # older files without a prefix
            start = 0
        else:
            return
        damage = _damage(content, start)
    if damage:
        raise SimulationError(f"{path}: is damaged: {damage}; copy or export it again")


def is_compressed(file: Path) -> bool:
    """Whether a DICOM file says that its pixels are compressed, or are in another way that is not among the plain ones.

    False for other files, and for older ones without a prefix, which cannot say so.
    """
    with file.open("rb") as opened:
        start = opened.read(_META_BYTES)
    if start[_PREAMBLE : _PREAMBLE + 4] != _PREFIX:
        return False
    _, found, value = start.partition(_SYNTAX_ELEMENT)
    length = int.from_bytes(value[:2], "little")
    return not found or value[2 : 2 + length].rstrip(b"\0 ") not in _UNCOMPRESSED


def _damage(content: mmap.mmap, at: int) -> str:
    """What is said of the first damaged element, or nothing.

    Sequences and items are not stepped over, so that what is in them follows as elements of their own.
    """
    order, syntax, implicit, in_meta = "<", b"", False, True
    while at + 8 <= len(content):
        tag = struct.unpack_from(f"{order}HH", content, at)
        if in_meta and tag[0] != _META:
            in_meta = False
            if syntax == _DEFLATED:
                return ""
            order = ">" if syntax == _BIG_ENDIAN else "<"
            tag = struct.unpack_from(f"{order}HH", content, at)
            implicit = syntax == _IMPLICIT or (not syntax and content[at + 4 : at + 6] not in _TYPES)
        name, kind = f"its element ({tag[0]:04X},{tag[1]:04X})", content[at + 4 : at + 6]
        if implicit or tag[0] == _ITEM[0]:
            (length,), at = struct.unpack_from(f"{order}I", content, at + 4), at + 8
        elif kind in _LONG and at + 12 <= len(content):
            (length,), at = struct.unpack_from(f"{order}I", content, at + 8), at + 12
        elif kind in _TYPES:
            (length,), at = struct.unpack_from(f"{order}H", content, at + 6), at + 8
        else:
            return f"{name} has the type {kind!r}, expected one of DICOM" if in_meta else ""
        if tag == _PIXELS or (kind == b"UN" and length == _UNDEFINED and not implicit):  # which is implicit within
            return ""
        left = len(content) - at
        if length != _UNDEFINED and length > left + (_MOST_BEYOND_IN_META if in_meta else _MOST_BEYOND):
            return f"{name} has {length} bytes, and {left} are left in the file"
        if tag == _SYNTAX:
            syntax = content[at : at + length].rstrip(b"\0 ")
        is_sequence = (kind == b"SQ" and not implicit) or content[at : at + 4] == b"\xfe\xff\x00\xe0"
        is_walked = length == _UNDEFINED or tag == _ITEM or is_sequence
        at += 0 if is_walked else length
    return ""
