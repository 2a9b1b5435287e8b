"""What a page may send: files that are whole by themselves, under plain names.

The name is a text from a browser, or from whoever has the token, and becomes a path; a header may name any other file
of the server's user as its voxels, which would then be shown and saved with the scene.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Workstation.formats import is_metaimage

#: Bytes of the longest name that file systems take, less what is added to it
_LONGEST_NAME = 200
#: Bytes that are sent at once
MOST_BYTES = 2**31
#: Names that are listed
_MOST_LISTED = 4
#: Files that are sent at once; a CT of the whole body has 2000 images
MOST_FILES = 10_000
#: Where headers end that name their voxels
_HEADER_BYTES = 2**16
_NRRD = re.compile(rb"^data ?file:\s*(.*)$", re.MULTILINE | re.IGNORECASE)
_METAIMAGE = re.compile(rb"^ElementDataFile\s*=[ \t]*(.*)$", re.MULTILINE)


def require_whole_files(files: Mapping[str, bytes]) -> None:
    """Raise SimulationError for names that are no plain file names, and for headers that name another file.

    `files` are {name: content} as a page sent them. Nothing has been written yet.
    """
    size = sum(map(len, files.values()))
    require(size <= MOST_BYTES, f"{listed(list(files))}: {size} bytes, expected at most {MOST_BYTES}")
    require(len(files) <= MOST_FILES, f"{len(files)} files are sent at once, expected at most {MOST_FILES}")
    for name, content in files.items():
        require(
            bool(name) and name not in (".", "..") and not re.search(r"[/\\\0-\x1f\x7f]", name),
            f"{_shown(name)}: is no plain file name, expected one without slashes and control characters",
        )
        length = len(name.encode("utf-8", "replace"))
        require(
            length <= _LONGEST_NAME, f"{_shown(name)}: its name has {length} bytes, expected at most {_LONGEST_NAME}"
        )
        other = _other_file(name, content)
        require(
            other is None,
            f"{name}: is a header whose voxels are in another file ({other}), which a page cannot send; save it as one "
            "file, such as .nrrd, .mha or .nii.gz",
        )


def require_whole_file(path: Path) -> None:
    """Raise SimulationError for a file of a bundle that is a header whose voxels are in another file."""
    other = _other_file(path.name, path.read_bytes())
    require(other is None, f"{path.name}: is a header whose voxels are in another file ({other}), expected one file")


def listed(names: Sequence[str]) -> str:
    """Names of files for a message; many are counted."""
    return ", ".join(map(_shown, names)) if len(names) <= _MOST_LISTED else f"{len(names)} files"


def plain_names(parts: Iterable[tuple[str, bytes]]) -> dict[str, bytes]:
    """{name: content} of files, of which several may have one name, as in folders of a CD."""
    files: dict[str, bytes] = {}
    for name, content in parts:
        unique, number = name, 1
        while unique in files:
            number += 1
            unique = f"{number} {name}"
        files[unique] = content
    return files


def _other_file(name: str, content: bytes) -> str | None:
    """The file that a header names as its voxels; None for a file that is whole."""
    lower, start = name.lower(), content[:4]
    if lower.endswith((".mhd", ".mha")) or is_metaimage(content):
        # Of a sequence the line comes after the fields of all images
        found = _METAIMAGE.search(content)
        named = found[1].strip().decode("utf-8", "replace") if found else ""
        return None if named in ("", "LOCAL", "Local", "local") else _shown(named)
    if start == b"NRRD":
        found = _NRRD.search(content.partition(b"\n\n")[0][:_HEADER_BYTES])
        return _shown(found[1].strip().decode("utf-8", "replace")) if found else None
    if lower.endswith((".nhdr", ".hdr", ".img")) and content[128:132] != b"DICM":  # as some DICOM files are called
        return "beside it"
    return None


def _shown(text: str) -> str:
    """A text for a message, short and without control characters."""
    plain = "".join(letter if letter.isprintable() else "?" for letter in text)
    return plain if len(plain) <= 60 else f"{plain[:57]}..."
