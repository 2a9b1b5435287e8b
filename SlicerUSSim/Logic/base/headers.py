"""What must hold of the header of an image before ITK or VTK reads it: they crash, hang or fill the memory otherwise.

MetaIO allocates tables for the number of dimensions that a header promises, ITK's orthogonalisation does not end for
directions of 1e308, and VTK's XML reader allocates what the extent says.
"""

from __future__ import annotations

import base64
import math
import mmap
import os
import re
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO
from xml.parsers import expat

from SlicerUSSim.Logic.base.dicom_elements import is_compressed, require_sound_elements
from SlicerUSSim.Logic.base.errors import SimulationError, require, shown_path

#: Voxels of the largest image: 2000 slices of 1024 x 1024
MOST_VOXELS = 2**31
#: Deflate turns at most 1032 bytes into one (zlib, "An Explanation of the Deflate Algorithm"), and headers are small
_MOST_EXPANSION = 1100
#: Formats with all voxels in one file, compressed by deflate or not at all
_ONE_FILE = (".mha", ".nii", ".nii.gz", ".nrrd", ".mgz", ".mgh", ".vti")
#: Endings of DICOM files that may lack the prefix
_DICOM = (".dcm", ".ima")
#: Pixels of one bit in a byte of a DICOM file that is not compressed
_PIXELS_PER_BYTE = 8
#: Largest coordinate, direction and voxel size that is read, in any unit of length
_MOST = 1e9
#: The part of a file in which its header ends; sequences have some hundred bytes for every image
_MOST_HEADER_BYTES = 2**26
_CHUNK = 2**18  # bytes
#: Bytes that VTK may allocate for an array, however small its file is; and the longest text of numbers in front of one
_LEAST_BLOCK, _BLOCK_TEXT = 2**20, 40
#: Where a VTI file ends, and in which of its last bytes
_VTI_END, _LAST_BYTES = b"</VTKFile>", 4096
#: Millimetres that voxels may have along an axis, and those that suggest that the file is in metres
_SPACING_MM, _LIKE_METRES = (0.01, 50.0), (1e-4, 9e-3)
_DIMENSIONS = range(2, 5)
#: Value of ElementDataFile for a file per slice: a pattern with one number, and first, last and step of that
_NUMBERED_FILES = r"[^%]*%(0?[0-9]{1,2})?d[^%]*?([ \t]+[0-9]{1,9}){0,3}"


def require_readable_name(path: str | os.PathLike) -> None:
    """Raise SimulationError for a name that ITK and VTK cannot take: with bytes that are not UTF-8, or with NUL."""
    text, shown = str(path), shown_path(path)
    require(shown == text, f"{shown}: its name has bytes that are not UTF-8, expected a name in UTF-8")
    require("\0" not in text, f"{text!r}: its name has a NUL, expected a file name")


def require_sound_header(path: Path) -> None:
    """Raise SimulationError for a MetaImage, VTI or DICOM file whose header is none that can be read.

    Files of other formats pass, and so do files whose voxels are missing, of which ITK and VTK say so.
    """
    suffix = path.suffix.lower()
    if suffix in (".mha", ".mhd"):
        _require_metaimage(path)
    elif suffix == ".vti":
        _require_vti(path)
    elif path.is_file() and is_dicom(path):
        require_sound_elements(path)


def require_bytes(path: Path, size: tuple[int, ...], bytes_per_voxel: int = 1) -> None:
    """Raise SimulationError for an image of more voxels than are read, or than its file can hold.

    `bytes_per_voxel` are the least that it may have.
    """
    voxels = math.prod(int(n) for n in size)
    text = "x".join(str(n) for n in size)
    require(voxels <= MOST_VOXELS, f"{path}: has {text} voxels, expected at most {MOST_VOXELS} in all")
    if path.is_file():
        require_held(str(path), text, voxels * bytes_per_voxel, [path])


def require_held(name: str, size: str, least_bytes: int, files: Sequence[Path]) -> None:
    """Raise SimulationError if files cannot hold `least_bytes` of voxels, however they are compressed.

    `size` is the number of voxels as text. Nothing is said about formats with voxels in other files, or unknown ones.
    """
    held = [_most_held(file) for file in files]
    if None in held:
        return
    stored = sum(file.stat().st_size for file in files)
    require(
        least_bytes <= sum(filter(None, held)),
        f"{name}: promises {size} voxels, {least_bytes} bytes, which its {stored} bytes cannot hold; copy or export it "
        "again",
    )


def _most_held(file: Path) -> int | None:
    """Bytes of voxels that a file can hold, a pixel of one bit counted as a byte; None for formats of several files."""
    expansion = _MOST_EXPANSION
    if is_dicom(file):
        if not is_compressed(file):
            expansion = _PIXELS_PER_BYTE
    elif not file.name.lower().endswith(_ONE_FILE):
        return None
    return expansion * max(file.stat().st_size, 1)


def is_dicom(file: Path) -> bool:
    """Whether a file has the DICOM prefix, or the suffix of the older ones that lack it."""
    if file.suffix.lower() in _DICOM:
        return True
    with open(file, "rb") as opened:
        return opened.read(132)[128:] == b"DICM"


def require_spacing(name: str, spacing_mm: tuple[float, ...]) -> None:
    """Raise SimulationError for voxels smaller than .01 mm or larger than 50 mm, as of lengths in another unit."""
    low, high = _SPACING_MM
    if all(low <= mm <= high for mm in spacing_mm):
        return
    hint = ""
    if all(_LIKE_METRES[0] <= mm <= _LIKE_METRES[1] for mm in spacing_mm):
        hint = "; its lengths look like metres: set the unit, or multiply them by 1000"
    elif all(low <= mm / 1000.0 <= high for mm in spacing_mm):
        hint = "; its lengths look like micrometres: set the unit, or divide them by 1000"
    shown = " x ".join(f"{mm:.3g}" for mm in spacing_mm)
    raise SimulationError(f"{name}: has voxels of {shown} mm, expected {low:g} to {high:g} mm along every axis{hint}")


# ---- MetaImage -------------------------------------------------------------------------------------------------------


def _require_metaimage(path: Path) -> None:
    fields = _metaimage_fields(path)
    dimensions = _whole(path, fields, "NDims")
    require(
        len(dimensions) == 1 and dimensions[0] in _DIMENSIONS,
        f"{path}: NDims is {fields.get('NDims', 'missing')[:40]}, expected 2, 3 or 4",
    )
    count = dimensions[0]
    pattern = fields["ElementDataFile"]
    require(  # MetaIO hands it to printf
        "%" not in pattern or re.fullmatch(_NUMBERED_FILES, pattern),
        f"{path}: ElementDataFile is {pattern[:80]!r}, expected a file, LOCAL, LIST or numbered files, as "
        "'slice%03d.raw 1 9 1'",
    )
    size = _whole(path, fields, "DimSize")
    require(
        len(size) == count and min(size) > 0,
        f"{path}: DimSize is {fields.get('DimSize', 'missing')[:80]!r}, expected {count} numbers above 0",
    )
    require_bytes(path, tuple(size))
    for name in ("ElementNumberOfChannels", "HeaderSize", "CompressedDataSize"):
        if name in fields:
            value = _whole(path, fields, name)
            low, high = (1, 256) if name == "ElementNumberOfChannels" else (-1, 2**48)
            require(
                len(value) == 1 and low <= value[0] <= high, f"{path}: {name} is {fields[name][:40]!r}, expected a size"
            )
    for names, many in _GEOMETRY:
        for name in names:
            if name in fields:
                _require_numbers(path, name, fields[name], count**2 if many else count)


#: Fields with a number for every axis, or for every pair of them, and their older names
_GEOMETRY = (
    (("ElementSpacing", "ElementSize", "Offset", "Position", "Origin", "CenterOfRotation"), False),
    (("TransformMatrix", "Rotation", "Orientation"), True),
)


def require_whole_metaimage(path: Path) -> None:
    """Raise SimulationError for a MetaImage whose compressed voxels are fewer than its DimSize says.

    MetaIO leaves the rest as the memory was. Files of other formats pass, and so do voxels in several files.
    """
    if path.suffix.lower() not in (".mha", ".mhd"):
        return
    fields = _metaimage_fields(path)
    voxels = path if fields["ElementDataFile"] == "LOCAL" else path.parent / fields["ElementDataFile"]
    size = _METAIMAGE_BYTES.get(fields.get("ElementType", "").removesuffix("_ARRAY"))
    if fields.get("CompressedData", "").lower() not in ("true", "t", "1") or size is None or "HeaderSize" in fields:
        return
    if not voxels.is_file():
        return
    dimensions = _whole(path, fields, "DimSize")
    channels = int(fields.get("ElementNumberOfChannels", "1"))
    slices, one = dimensions[-1], math.prod(dimensions[:-1]) * channels * size
    unpack, found = zlib.decompressobj(32 + zlib.MAX_WBITS), 0
    try:
        with voxels.open("rb") as file:
            if voxels == path:
                _skip_metaimage_header(file)
            while not unpack.eof and (chunk := file.read(_CHUNK)):
                while chunk and not unpack.eof:
                    found += len(unpack.decompress(chunk, _CHUNK))
                    chunk = unpack.unconsumed_tail
    except zlib.error:
        raise SimulationError(f"{path}: its compressed content is damaged; copy or export it again") from None
    text = "x".join(str(n) for n in dimensions)
    require(
        found >= slices * one,
        f"{path}: DimSize promises {text} voxels, {slices * one} bytes, and it has {found} bytes, enough for "
        f"{found // one} of {slices} slices; copy or export it again",
    )


def _skip_metaimage_header(file: BinaryIO) -> None:
    for line in file:
        if line.partition(b"=")[0].strip() == b"ElementDataFile":
            return


#: Bytes of the types of voxels
_METAIMAGE_BYTES = {
    "MET_CHAR": 1, "MET_UCHAR": 1, "MET_SHORT": 2, "MET_USHORT": 2, "MET_INT": 4, "MET_UINT": 4, "MET_LONG_LONG": 8,
    "MET_ULONG_LONG": 8, "MET_FLOAT": 4, "MET_DOUBLE": 8,
}  # fmt: skip


def _metaimage_fields(path: Path) -> dict[str, str]:
    """The fields of a header, without those of the images of a sequence, whose values may be anything in UTF-8."""
    fields: dict[str, str] = {}
    read = 0
    with path.open("rb") as file:
        for line in file:
            read += len(line)
            require(read <= _MOST_HEADER_BYTES, f"{path}: its header does not end, expected a line ElementDataFile")
            try:
                text = line.decode("utf-8")
            except UnicodeDecodeError:
                raise SimulationError(f"{path}: its header is not text, expected lines in UTF-8") from None
            name, equals, value = (part.strip() for part in text.partition("="))
            require("\0" not in text, f"{path}: its header is not text, expected lines as NDims = 3")
            if equals and not name.startswith("Seq_Frame"):
                fields[name] = value
            if name == "ElementDataFile":
                return fields
    raise SimulationError(f"{path}: its header has no line ElementDataFile, expected a MetaImage")


def _whole(path: Path, fields: dict[str, str], name: str) -> list[int]:
    text = fields.get(name, "")
    require(
        re.fullmatch(r"[-+]?[0-9]{1,18}([ \t]+[-+]?[0-9]{1,18})*", text),
        f"{path}: {name} is {text[:80]!r}, expected whole numbers",
    )
    return [int(part) for part in text.split()]


def _require_numbers(path: Path, name: str, text: str, count: int) -> None:
    try:
        values = [float(part) for part in text.split() if part.isascii()]  # Python reads the digits of all scripts
    except ValueError:
        values = []
    require(
        len(values) == count and all(abs(value) <= _MOST for value in values),
        f"{path}: {name} is {text[:80]!r}, expected {count} numbers of at most {_MOST:g}",
    )


# ---- NRRD ------------------------------------------------------------------------------------------------------------


def require_whole_nrrd(path: Path) -> None:
    """Raise SimulationError for a NRRD file whose voxels, compressed by gzip, lack their end or have another checksum.

    Teem reads as much as the image needs and does not look at the checksum. Files of other formats pass, and so do
    headers with voxels in several files, or with something before them.
    """
    if path.suffix.lower() not in (".nrrd", ".nhdr"):
        return
    fields = {}
    with path.open("rb") as file:
        for line in file:
            if not line.strip() or file.tell() > _MOST_HEADER_BYTES:
                break
            name, colon, value = line.decode("utf-8", "replace").partition(":")
            if colon:
                fields[name.strip().lower().replace(" ", "")] = value.strip()
        at = file.tell()
    is_gzip = fields.get("encoding", "").lower() in ("gz", "gzip")
    if not is_gzip or {"byteskip", "lineskip"} & fields.keys():
        return
    voxels = path
    if "datafile" in fields:
        voxels, at = path.parent / fields["datafile"], 0
        if not voxels.is_file():  # of several, whose names are a pattern or a list
            return
    unpack = zlib.decompressobj(16 + zlib.MAX_WBITS)
    try:
        with voxels.open("rb") as file:
            file.seek(at)
            while not unpack.eof and (chunk := file.read(_CHUNK)):
                while chunk and not unpack.eof:
                    unpack.decompress(chunk, _CHUNK)
                    chunk = unpack.unconsumed_tail
    except zlib.error:
        raise SimulationError(f"{path}: its compressed content is damaged; copy or export it again") from None
    require(unpack.eof, f"{path}: is incomplete, the end of its compressed content is missing; copy or export it again")


# ---- VTI -------------------------------------------------------------------------------------------------------------


def _require_vti(path: Path) -> None:
    header = _vti_header(path)
    whole = _extent(path, header.get("WholeExtent", ""), "WholeExtent")
    size = tuple(high - low + 1 for low, high in zip(whole[::2], whole[1::2], strict=True))
    require_bytes(path, size)
    for name, count in (("Origin", 3), ("Spacing", 3), ("Direction", 9)):
        if name in header:
            _require_numbers(path, name, header[name], count)
    if "Piece" in header:
        piece = _extent(path, header["Piece"], "the extent of its piece")
        require(
            all(w <= p for w, p in zip(whole[::2], piece[::2], strict=True))
            and all(p <= w for w, p in zip(whole[1::2], piece[1::2], strict=True)),
            f"{path}: the extent of its piece is {header['Piece']!r}, expected one within {header['WholeExtent']!r}",
        )
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - _LAST_BYTES))
        require(
            file.read().rstrip().endswith(_VTI_END),
            f"{path}: is incomplete, expected {_VTI_END.decode()} at its end; copy or export it again",
        )
    _require_vti_blocks(path)


@dataclass
class _VtiData:
    """Where a VTI file has the values of its arrays, and how."""

    words: str = "<I"  # struct's format of a number in front of values
    is_compressed: bool = False
    #: Beginnings of values within the XML, and places of those behind it
    inline: list[str] = field(default_factory=list)
    offsets: list[int] = field(default_factory=list)
    encoding: str = ""


def _require_vti_blocks(path: Path) -> None:
    """Raise SimulationError if the numbers in front of values promise more than a file can hold: VTK allocates that."""
    data, size = _vti_data(path), path.stat().st_size
    length = struct.calcsize(data.words) * (3 if data.is_compressed else 1)
    starts = [_from_base64(text, length) for text in data.inline]
    if data.offsets:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            begin = content.find(b"_", content.find(b"<AppendedData")) + 1
            require(begin > 0, f"{path}: the values behind <AppendedData> do not begin with '_', as VTK writes them")
            for offset in data.offsets:
                at = begin + offset
                require(at < size, f"{path}: an array has the offset {offset}, expected one within the file")
                is_raw = data.encoding == "raw"
                text = content[at : at + (length if is_raw else 4 * length)]
                starts.append(text if is_raw else _from_base64(text.decode("ascii", "replace"), length))
    for start in starts:
        if len(start) < length:  # an empty array
            continue
        numbers = [number for (number,) in struct.iter_unpack(data.words, start)]
        promised = numbers[0]
        if data.is_compressed:
            blocks, block, last = numbers
            promised = max(blocks * block, last, blocks)
        most = size * (_MOST_EXPANSION if data.is_compressed else 1)
        require(
            promised <= max(most, _LEAST_BLOCK),
            f"{path}: an array promises {promised} bytes, which its {size} bytes cannot hold; copy or export it again",
        )


def _vti_data(path: Path) -> _VtiData:
    found, is_binary = _VtiData(), [False]
    parser = expat.ParserCreate()

    def started(name: str, attributes: dict[str, str]) -> None:
        if name == "VTKFile":
            order = ">" if attributes.get("byte_order") == "BigEndian" else "<"
            found.words = order + ("Q" if attributes.get("header_type") == "UInt64" else "I")
            found.is_compressed = "compressor" in attributes
        elif name == "AppendedData":
            found.encoding = attributes.get("encoding", "base64")
        elif attributes.get("format") == "appended":
            offset = attributes.get("offset", "")
            require(re.fullmatch("[0-9]{1,18}", offset.strip()), f"{path}: an array has the offset {offset!r:.40}")
            found.offsets.append(int(offset))
        is_binary[0] = attributes.get("format") == "binary"
        if is_binary[0]:
            found.inline.append("")

    def told(text: str) -> None:
        if is_binary[0] and len(found.inline[-1]) < _BLOCK_TEXT:
            found.inline[-1] += text.strip()[:_BLOCK_TEXT]

    def ended(_: str) -> None:
        is_binary[0] = False

    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = started, ended, told
    with path.open("rb") as file:
        while not found.encoding and (chunk := file.read(_CHUNK)):
            try:
                parser.Parse(chunk)
            except expat.ExpatError:  # behind the start of voxels, which are no XML; of others VTK says so
                break
    return found


def _from_base64(text: str, length: int) -> bytes:
    """The first bytes of a text in base64; fewer if there are not as many."""
    text = "".join(text.split())[: 4 * -(-length // 3)]
    try:
        return base64.b64decode(text)[:length]
    except ValueError:
        return b""


def _vti_header(path: Path) -> dict[str, str]:
    """The attributes of the image in a VTI file, and the extent of its first piece as "Piece"."""
    found: dict[str, str] = {}
    parser = expat.ParserCreate()

    def started(name: str, attributes: dict[str, str]) -> None:
        if name == "ImageData":
            found.update(attributes)
        elif name == "Piece":
            found.setdefault("Piece", attributes.get("Extent", ""))

    parser.StartElementHandler = started
    with path.open("rb") as file:
        while "Piece" not in found:
            chunk = file.read(4096)
            if not chunk:
                break
            try:
                parser.Parse(chunk)
            except expat.ExpatError as error:
                if "Piece" in found:  # what follows may be voxels, which are no XML
                    break
                raise SimulationError(f"{path}: cannot be read as a VTK image ({error})") from None
    require("WholeExtent" in found, f"{path}: cannot be read as a VTK image (it has no <ImageData WholeExtent=...>)")
    return found


def _extent(path: Path, text: str, name: str) -> list[int]:
    require(
        re.fullmatch(r"\s*[-+]?[0-9]{1,9}(\s+[-+]?[0-9]{1,9}){5}\s*", text),
        f"{path}: {name} is {text[:80]!r}, expected six numbers",
    )
    values = [int(part) for part in text.split()]
    require(
        all(low <= high for low, high in zip(values[::2], values[1::2], strict=True)),
        f"{path}: {name} is {text!r}, expected a last index that is not below the first, along every axis",
    )
    return values
