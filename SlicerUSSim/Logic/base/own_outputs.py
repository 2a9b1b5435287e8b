"""Results of this program in single files, which are replaced only while they are as this program wrote them.

A result holds a mark: the program's name with a hash of what is in the file. Other programs drop the mark, or keep it
and change the content.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.files import read_json, write_json
from SlicerUSSim.Logic.base.image_files import read_image
from SlicerUSSim.Logic.base.reading import in_child
from SlicerUSSim.Logic.base.volume import MADE_BY, Volume

_PROGRAM = "SlicerUSSim"
#: Entry of a JSON file with its mark, and beginning of the last line of an HTML file
MARK = "made_by"
_COMMENT = "<!-- made by "
#: Name of PNG's entry for the program that made an image
_PNG_ENTRY = "Software"
_MOST_JSON_BYTES = 2**30


def require_own(*paths: Path | None) -> None:
    """Raise SimulationError for a file that exists and is not as this program wrote it, before it is replaced.

    For images (PNG, and the formats of Volume and TrackedSequence), JSON and HTML. MINC holds no mark, so that such a
    file is never replaced. None stands for an output that was not asked for.
    """
    for path in paths:
        if path is not None:
            require_known(path, _is_own)


def require_known(path: Path, is_own: Callable[[Path], bool]) -> None:
    """Raise SimulationError for a file that exists, and of which `is_own` is False or raises anything."""
    if not path.exists():
        return
    try:
        is_known = path.is_file() and is_own(path)
    except Exception:  # whatever libraries raise for what is none of ours; PIL for an image of too many pixels
        is_known = False
    require(
        is_known,
        f"{path}: exists and is not as this program wrote it, so it is not replaced; choose another name, or remove it",
    )


def mark_of(array: np.ndarray) -> str:
    """The mark of an image or a sequence, by its voxels in their order."""
    return _mark(np.ascontiguousarray(array).tobytes())


def hash_of_values(values: dict) -> str:
    """A hash of plain values, the same before they are written as JSON and after they are read."""
    plain = json.loads(json.dumps(values))  # names as text, before they are sorted
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()


def write_own_json(path: str | os.PathLike, values: dict) -> None:
    """Write plain values as JSON, with a mark. Raises SimulationError if the file cannot be written."""
    write_json(path, {**values, MARK: _mark_of_values(values)})


def write_own_volume(path: str | os.PathLike, volume: Volume) -> None:
    """Write a volume with a mark. Raises SimulationError as Volume.write does."""
    volume.write(path, made_by=mark_of(volume.array))


def marked_html(text: str) -> str:
    """The text of an HTML file with a mark in its last line."""
    return f"{text}{_COMMENT}{_mark(text.encode())} -->\n"


def save_marked_png(path: Path, image: Any) -> None:
    """Save a PIL image as PNG with a mark."""
    from PIL.PngImagePlugin import PngInfo

    entries = PngInfo()
    entries.add_text(_PNG_ENTRY, mark_of(np.asarray(image)))
    image.save(path, "PNG", pnginfo=entries)


def _mark(content: bytes) -> str:
    return f"{_PROGRAM} {hashlib.sha256(content).hexdigest()[:32]}"


def _mark_of_values(values: dict) -> str:
    return f"{_PROGRAM} {hash_of_values(values)[:32]}"


def _is_own(path: Path) -> bool:
    """Whether a file has a mark that fits its content. Raises what its library does for one that cannot be read."""
    with path.open("rb") as file:
        start = file.read(16)
    if start.startswith(b"\x89PNG"):
        return _is_own_png(path)
    if start.startswith(b"{"):
        values = read_json(path, _MOST_JSON_BYTES)
        return values.pop(MARK, None) == _mark_of_values(values)
    if start.lower().startswith((b"<!doctype", b"<html")):
        text, _, last = path.read_text(encoding="utf-8").rpartition(_COMMENT)
        return bool(text) and marked_html(text) == f"{text}{_COMMENT}{last}"
    return _is_own_vti(path) if path.suffix.lower() == ".vti" else _is_own_itk(path)


def _is_own_png(path: Path) -> bool:
    from PIL import Image

    with Image.open(path) as image:
        return image.info.get(_PNG_ENTRY) == mark_of(np.asarray(image))


@in_child  # VTK ends the process for some damaged files
def _is_own_vti(path: Path) -> bool:
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOXML import vtkXMLImageDataReader

    reader = vtkXMLImageDataReader()
    if not reader.CanReadFile(str(path)):
        return False
    reader.SetFileName(str(path))
    reader.Update()
    image = reader.GetOutput()
    mark, scalars = image.GetFieldData().GetAbstractArray(MADE_BY), image.GetPointData().GetScalars()
    return mark is not None and scalars is not None and mark.GetValue(0) == mark_of(vtk_to_numpy(scalars))


def _is_own_itk(path: Path) -> bool:
    image = read_image(path)
    array = np.moveaxis(image.array, -1, 0) if image.has_components else image.array  # a sequence in NRRD
    return any(image.header.get(key) == mark_of(array) for key in (MADE_BY, "ITK_FileNotes"))
