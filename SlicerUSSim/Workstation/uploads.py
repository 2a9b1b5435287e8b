"""What a page may send: files that are whole by themselves, under plain names, in a separate folder.

The name is a text from a browser, or from whoever has the token, and becomes a path; a header may name any other file
of the server's user as its voxels, which would then be shown and saved with the scene.
"""

from __future__ import annotations

import logging
import os
import re
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from SlicerUSSim.Logic.base.dicom import Series, list_series
from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.whole_files import other_file, plain

_log = logging.getLogger(__name__)

#: Bytes of the longest name that file systems take, less what is added to it
_LONGEST_NAME = 200
#: Bytes that are sent at once
MOST_BYTES = 2**31
#: Names that are listed
_MOST_LISTED = 4
#: Files that are sent at once; a CT of the whole body has 2000 images
MOST_FILES = 10_000
#: Folder of the DICOM files, whose names may be those of others
DICOM = "dicom"
#: Folder of what a page has sent, as reading.untrusted_folder calls it, in messages
_SENT = re.compile(
    rf"{re.escape(str(Path(tempfile.gettempdir()).resolve()))}[/\\\\]ussim-untrusted-\w+[/\\\\](?:{DICOM}[/\\\\])?"
)
#: Endings of images of one file; beside DICOM files nothing else is opened, as from a CD with a viewer
_IMAGES = (".nrrd", ".mha", ".nii", ".nii.gz", ".mgz", ".mgh", ".mnc", ".vti", ".vtp", ".mrb")


class Sent:
    """Files that a page has sent together. Nothing is read here in this process but their first bytes.

    Parameters
    ----------
    folder : empty; see reading.untrusted_folder.
    files : {name: content}.

    Raises SimulationError as require_whole_files does, before anything is written.
    """

    def __init__(self, folder: str, files: Mapping[str, bytes]) -> None:
        require_whole_files(files)
        self._folder = Path(folder)
        #: Those that are not DICOM images
        self.paths: list[Path] = []
        dicom = {name for name, content in files.items() if _is_dicom(name, content)}
        #: Whether there are DICOM files, which `series` and `take` make into a volume
        self.has_dicom = bool(dicom)
        for name, content in files.items():
            if name in dicom:
                self._write(self._folder / DICOM / name, content)
            elif not dicom or name.lower().endswith(_IMAGES):
                self._write(self._folder / name, content)
                self.paths.append(self._folder / name)

    def series(self) -> list[Series]:
        """The DICOM series; takes up to seconds."""
        return list_series(self._folder / DICOM)

    def take(self, chosen: Series, others: list[Series]) -> None:
        """Make a folder with the images of one series the first of the paths; `others` are all series.

        Files that are in no series stay with it: they may be damaged images of it, which its reader says.
        """
        folder = self._folder / chosen.title
        if folder.exists():
            folder = self._folder / f"{chosen.title} DICOM"
        folder.mkdir()
        taken = {Path(file) for series in others if series is not chosen for file in series.files}
        for file in sorted((self._folder / DICOM).iterdir()):
            if file not in taken:
                os.replace(file, folder / file.name)
        _log.info("DICOM: %s, %s", folder.name, chosen.images)
        self.paths.insert(0, folder)

    def _write(self, path: Path, content: bytes) -> None:
        try:
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(content)
        except OSError as error:
            raise SimulationError(f"{path.name}: cannot be stored ({error.strerror})") from None


def require_whole_files(files: Mapping[str, bytes]) -> None:
    """Raise SimulationError for names that are not plain file names, and for headers that name another file.

    `files` are {name: content} as a page sent them. Nothing has been written yet.
    """
    for name, content in files.items():
        require(
            bool(name) and name not in (".", "..") and not re.search(r"[/\\\0-\x1f\x7f]", name),
            f"{plain(name)}: is not a plain file name, expected one without slashes and control characters",
        )
        length = len(name.encode("utf-8", "replace"))
        require(
            length <= _LONGEST_NAME, f"{plain(name)}: its name has {length} bytes, expected at most {_LONGEST_NAME}"
        )
        other = other_file(name, content)
        require(
            other is None,
            f"{name}: is a header whose voxels are in another file ({other}), which a page cannot send; save it as one "
            "file, such as .nrrd, .mha or .nii.gz",
        )


def as_known(text: str) -> str:
    """A message with the names of files as the user knows them, without the folder of what a page has sent."""
    return _SENT.sub("", text)


def listed(names: Sequence[str]) -> str:
    """Names of files for a message; many are counted."""
    return ", ".join(map(plain, names)) if len(names) <= _MOST_LISTED else f"{len(names)} files"


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


def _is_dicom(name: str, content: bytes) -> bool:
    """Whether a file is a DICOM image: by its prefix, or by the ending of older ones that lack it."""
    has_prefix = content[128:132] == b"DICM" or name.lower().endswith((".dcm", ".ima"))
    return has_prefix and name.upper() != "DICOMDIR"
