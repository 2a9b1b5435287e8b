"""Lengths of elements of a DICOM file, which GDCM allocates and fills with zeros before it looks at the file's end.

A file of 1.5 kB, one of whose lengths was damaged, took 4 GB. Where its pixels are fewer than rows, columns and bits
say, it reads the rest as zeros without a word. Source of the encoding: DICOM PS3.5, chapters 7 and A.
"""

from __future__ import annotations

import math
import mmap
import struct
from pathlib import Path
from typing import TypeAlias

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
#: What the number of pixels and their size are in
_SIZES = {
    (0x0028, 0x0002): "samples",
    (0x0028, 0x0008): "frames",
    (0x0028, 0x0010): "rows",
    (0x0028, 0x0011): "columns",
    (0x0028, 0x0100): "bits",
}
_COLOURS = (0x0028, 0x0004)
_ITEM_END, _SEQUENCE_END = (0xFFFE, 0xE00D), (0xFFFE, 0xE0DD)
_UNCOMPRESSED = (_IMPLICIT, b"1.2.840.10008.1.2.1", _BIG_ENDIAN)


def require_sound_elements(path: Path) -> None:
    """Raise SimulationError for a DICOM file with an element, before its pixels, far beyond the end of the file.

    Other files pass, and so does what is no element of DICOM, of which GDCM says so; not in the group of the first
    elements, though, since GDCM reads them again in another encoding then, and takes text for lengths.
    """
    damage = _walked(path)[0]
    if damage:
        raise SimulationError(f"{path}: is damaged: {damage}; copy or export it again")


def require_whole_pixels(path: Path) -> None:
    """Raise SimulationError for a DICOM file whose pixels, which are not compressed, have another size than it says.

    That is one of rows, columns, samples, frames and BitsAllocated. Other files pass, and so do longer pixels, of which
    only the first are read, as long as they are no second image.
    """
    if is_compressed(path):
        return
    damage, (length, sizes) = _walked(path)
    if damage or length is None or not {"rows", "columns", "bits"} <= sizes.keys():
        return
    sizes = {"samples": 1, "frames": 1, **sizes}
    expected = -(-math.prod(sizes.values()) // 8)
    if not expected <= length < max(2 * expected, expected + 2):
        raise SimulationError(
            f"{path}: its pixels have {length} bytes, expected {expected} for {sizes['rows']} rows, {sizes['columns']} "
            f"columns, {sizes['samples']} sample{'s' * (sizes['samples'] != 1)} and {sizes['frames']} "
            f"frame{'s' * (sizes['frames'] != 1)} of {sizes['bits']} bits (BitsAllocated); copy or export it again"
        )


#: Bytes of the pixels, None where they are not found or not plain, and the values of _SIZES
_Pixels: TypeAlias = tuple[int | None, dict[str, int]]


def _walked(path: Path) -> tuple[str, _Pixels]:
    """What is said of the first damaged element of a file, and its pixels."""
    if path.stat().st_size < 8:
        return "", (None, {})
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        if content[_PREAMBLE : _PREAMBLE + 4] == _PREFIX:
            start = _PREAMBLE + 4
        elif content[:2] in (b"\x02\x00", b"\x08\x00"):  # older files without a prefix
            start = 0
        else:
            return "", (None, {})
        return _walk(content, start)


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


def _walk(content: mmap.mmap, at: int) -> tuple[str, _Pixels]:
    """What is said of the first damaged element, or nothing, and the pixels.

    Sequences and items are not stepped over, so that what is in them follows as elements of their own; sizes and pixels
    in them, of a small picture, are not those of the image.
    """
    sizes: dict[str, int] = {}
    none: _Pixels = None, {}
    within, opened, is_halved = 0, 0, False  # the end of a sequence, and ends that are still to come
    order, syntax, implicit, in_meta = "<", b"", False, True
    while at + 8 <= len(content):
        tag, begin = struct.unpack_from(f"{order}HH", content, at), at
        if in_meta and tag[0] != _META:
            in_meta = False
            if syntax == _DEFLATED:
                return "", none
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
            return f"{name} has the type {kind!r}, expected one of DICOM" if in_meta else "", none
        is_top = begin >= within and not opened
        if tag == _PIXELS and (is_top or length == _UNDEFINED):
            is_plain = length != _UNDEFINED and not is_halved
            return "", (length if is_plain else None, sizes)
        if kind == b"UN" and length == _UNDEFINED and not implicit:  # which is implicit within
            return "", none
        left = len(content) - at
        if length != _UNDEFINED and length > left + (_MOST_BEYOND_IN_META if in_meta else _MOST_BEYOND):
            return f"{name} has {length} bytes, and {left} are left in the file", none
        if tag == _SYNTAX:
            syntax = content[at : at + length].rstrip(b"\0 ")
        is_sequence = (kind == b"SQ" and not implicit) or content[at : at + 4] == b"\xfe\xff\x00\xe0"
        is_walked = length == _UNDEFINED or tag == _ITEM or is_sequence
        if length == _UNDEFINED:
            opened += 1
        elif tag in (_ITEM_END, _SEQUENCE_END):
            opened = max(opened - 1, 0)
        elif is_walked:
            within = max(within, at + length)
        elif is_top:
            if tag in _SIZES:
                value = content[at : at + length]
                sizes[_SIZES[tag]] = _frames(value) if _SIZES[tag] == "frames" else _number(value, order)
            elif tag == _COLOURS:  # two pixels share two of three samples
                is_halved = content[at : at + length].rstrip(b"\0 ").endswith((b"_422", b"_420"))
        at += 0 if is_walked else length
    return "", none


def _number(value: bytes, order: str) -> int:
    """Of two bytes; 1 for anything else, which GDCM does not read either."""
    return struct.unpack(f"{order}H", value)[0] if len(value) == 2 else 1


def _frames(text: bytes) -> int:
    """A number in digits; 1 for anything else."""
    digits = text.strip(b"\0 ")
    return int(digits) if digits.isdigit() and len(digits) < 10 else 1
