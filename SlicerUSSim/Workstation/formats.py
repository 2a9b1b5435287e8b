"""The format of a file by its first bytes, and the ending by which readers know it, whatever the file is called."""

from __future__ import annotations

import re
import zlib

#: Bytes that are looked at
_START = 2**16
#: Where NIfTI has its magic
_NIFTI_AT, _NIFTI = 344, (b"n+1\0", b"ni1\0")
#: First words of MetaImage headers, whose lines may come in any order
_META = re.compile(rb"\s*(?:ObjectType|NDims|Comment|ObjectSubType|BinaryData)\s*=")
_TABLES = (".txt", ".ctbl", ".csv", ".tsv", ".lut")
#: Endings of texts whose content says nothing more
_TEXTS = (".json", ".xml", ".xfm", ".tag", ".tfm", ".mat", *_TABLES)


def is_dicom_file(name: str, content: bytes) -> bool:
    """Whether a file is DICOM: by its prefix, or by the ending of older ones that lack it."""
    return content[128:132] == b"DICM" or name.lower().endswith((".dcm", ".ima"))


def is_metaimage(content: bytes) -> bool:
    """Whether a file begins as a header of MetaImage does."""
    return bool(_META.match(content[:256]))


def readable_name(name: str, content: bytes) -> str:
    """The name of a file with the ending of its format behind it, if it does not have one already.

    A tracked sequence that is called sweep.dat becomes sweep.dat.mha; a name whose content says nothing stays, and that
    of a scene (.mrb) with a text, which is no scene.
    """
    start, lower = content[:_START], name.lower()
    endings = _endings(start)
    is_no_scene = lower.endswith(".mrb") and endings == _endings_of_text(start)
    if not endings or is_no_scene or lower.endswith(endings):
        return name
    return f"{name}{endings[0]}"


def _endings(start: bytes) -> tuple[str, ...]:
    """Endings of the format, the first of which is usual; none if the format is not known by these bytes."""
    if start[:4] == b"NRRD":
        return ".nrrd", ".nhdr"
    if _META.match(start):
        return ".mha", ".mhd"
    if start[:2] == b"\x1f\x8b":
        return _endings_of_gzip(start)
    if start[_NIFTI_AT : _NIFTI_AT + 4] in _NIFTI:
        return ".nii", ".hdr", ".img"
    if start[:8] == b"\x89HDF\r\n\x1a\n":
        return (".mnc",) if b"minc" in start else (".h5", ".hdf5", ".mnc", ".mat")
    if start[:3] == b"CDF":
        return (".mnc",)
    if start[:4] == b"PK\x03\x04":
        return (".mrb", ".zip")
    return _endings_of_text(start)


def _endings_of_gzip(start: bytes) -> tuple[str, ...]:
    try:
        inside = zlib.decompressobj(wbits=31).decompress(start, _NIFTI_AT + 8)
    except zlib.error:
        return ()
    if inside[_NIFTI_AT : _NIFTI_AT + 4] in _NIFTI:
        return (".nii.gz",)
    return (".mgz", ".mgh") if inside[:4] == b"\0\0\0\1" else ()


def _endings_of_text(start: bytes) -> tuple[str, ...]:
    text = start.lstrip(b"\xef\xbb\xbf \t\r\n")
    if text[:1] in (b"{", b"["):
        return (".json",)
    if text.startswith(b"MNI Tag Point File"):
        return (".tag",)
    if text.startswith(b"MNI Transform File"):
        return (".xfm",)
    if text.startswith(b"#Insight Transform File"):
        return ".tfm", ".txt"
    if text.startswith(b"<"):
        if b"<VTKFile" in text:
            return (".vtp",) if b'type="PolyData"' in text[:2000] else (".vti",)
        return (".xml",)
    return ()


def is_text_name(name: str) -> bool:
    """Whether a file is a table or another text by its ending."""
    return name.lower().endswith(_TEXTS)
