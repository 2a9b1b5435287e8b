"""Bundles of scenes (.mrb), unpacked so that nothing but their own files is read.

A scene names files, also by absolute paths and addresses, and Slicer's readers take all of them: anything outside the
bundle could be a file of the server's user, or a request to a computer elsewhere.
"""

from __future__ import annotations

import os
import zipfile
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from urllib.parse import unquote
from xml.etree import ElementTree

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.whole_files import require_whole_file

#: Files in a bundle, and bytes of all of them
_MOST_FILES, _MOST_BYTES = 5000, 8 * 2**30
#: Bundles in a bundle
_DEEPEST = 1
#: Attributes of storage nodes that name files or addresses
_FILES = ("fileName", "fileListMember", "uri")
#: Suffixes of files that may name another one
_HEADERS = (".mhd", ".mha", ".nhdr", ".nrrd", ".hdr", ".img")
#: Folders in archives that do not belong to the bundle
_NOT_OURS = ("__MACOSX/",)


def unpacked(path: Path, folder: Path, depth: int = 0) -> Path:
    """The scene file of a bundle that was unpacked into a folder, and names only what is in there."""
    try:
        archive = zipfile.ZipFile(path)
    except (zipfile.BadZipFile, OSError) as error:
        raise SimulationError(f"{path}: is not a bundle of a scene, expected a .mrb ({error})") from None
    with archive:
        entries = [entry for entry in archive.infolist() if not entry.is_dir() and not _is_extra(entry.filename)]
        require(len(entries) <= _MOST_FILES, f"{path}: has {len(entries)} files, expected at most {_MOST_FILES}")
        size = sum(entry.file_size for entry in entries)
        require(size <= _MOST_BYTES, f"{path}: has {size} bytes unpacked, expected at most {_MOST_BYTES}")
        left = size
        for entry in entries:
            name = PurePosixPath(entry.filename.replace("\\", "/"))
            inside = not name.is_absolute() and ".." not in name.parts and ":" not in entry.filename
            require(inside and "\0" not in entry.filename, f"{path}: has a file outside its folder, {name.name!r}")
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                with archive.open(entry) as source, target.open("wb") as file:
                    while piece := source.read(2**20):
                        left -= len(piece)
                        require(left >= 0, f"{path}: unpacks to more than it states, expected {size} bytes")
                        file.write(piece)
            except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, OSError) as error:
                raise SimulationError(f"{path}: is damaged at {name.name!r} ({error})") from None
    scenes = sorted(folder.rglob("*.mrml"))
    require(len(scenes) == 1, f"{path}: has {len(scenes)} scenes (.mrml), expected one")
    _check_names(path, scenes[0], folder)
    for file in folder.rglob("*"):
        if file.is_file() and file.suffix.lower() in _HEADERS:
            require_whole_file(file)
        elif file.suffix.lower() == ".mrb":  # a sequence of transforms
            require(depth < _DEEPEST, f"{path}: has bundles in bundles in bundles, expected at most two levels")
            with TemporaryDirectory(dir=folder.parent) as inner:
                unpacked(file, Path(inner) / "scene", depth + 1)
    return scenes[0]


def _is_extra(name: str) -> bool:
    return name.startswith(_NOT_OURS) or PurePosixPath(name).name.startswith("._")


def _check_names(path: Path, scene: Path, folder: Path) -> None:
    """Raise SimulationError if a scene names an address, or a file that is not in the bundle."""
    try:
        tree = ElementTree.parse(scene)
    except ElementTree.ParseError as error:
        raise SimulationError(f"{path}: its scene is not XML ({error})") from None
    for element in tree.iter():
        for attribute, text in element.attrib.items():
            if not text or not attribute.startswith(_FILES):
                continue
            # Slicer decodes the names, and resolves them from the folder of the scene
            for name in {text, unquote(text), unquote(unquote(text))}:
                is_inside = "://" not in name and (scene.parent / name).resolve().is_relative_to(folder)
                require(
                    is_inside,
                    f"{path}: names a file outside itself ({os.path.basename(name)[:60]!r}), which is not read; save "
                    "the scene as a bundle (.mrb) again",
                )
