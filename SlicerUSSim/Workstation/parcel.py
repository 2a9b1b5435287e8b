"""Parcel: the files that a page has sent together, in a folder of their own, sorted into images, series and texts."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from pathlib import Path

from SlicerUSSim.Logic.base.dicom import Series, list_series
from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Workstation.formats import is_dicom_file, is_text_name, readable_name
from SlicerUSSim.Workstation.uploads import require_whole_files

_log = logging.getLogger(__name__)

#: Folder of the DICOM files, whose names may be those of others
_DICOM = "dicom"
#: Endings of images of one file; beside DICOM files nothing else is opened, as from a CD with a viewer
_IMAGES = (".nrrd", ".mha", ".nii", ".nii.gz", ".mgz", ".mgh", ".mnc", ".vti", ".vtp", ".mrb")


class Parcel:
    """Files of a page. Nothing is read here in this process but their first bytes.

    Parameters
    ----------
    folder : empty; see reading.untrusted_folder.
    files : {name: content}.

    Raises SimulationError as require_whole_files does, before anything is written.
    """

    def __init__(self, folder: str, files: Mapping[str, bytes]) -> None:
        require_whole_files(files)
        self._folder = Path(folder)
        #: {path: name} as the user knows it
        self.names: dict[str, str] = {}
        #: Files that are whole images, or texts
        self.paths: list[Path] = []
        #: Names of files that are opened as another format than their names say
        self.renamed: dict[str, str] = {}
        #: How many files beside DICOM files are none of an image
        self.left_out = 0
        dicom = {
            name: content
            for name, content in files.items()
            if is_dicom_file(name, content) and Path(name).name.upper() != "DICOMDIR"
        }
        for name, content in files.items():
            if name in dicom:
                self._write(self._folder / _DICOM / name, content)
                continue
            known = readable_name(name, content)
            if dicom and (is_text_name(known) or not known.lower().endswith(_IMAGES)):
                self.left_out += 1
                continue
            path = self._folder / known
            require(not path.exists(), f"{name}: has the name of another file by its content, {known}; rename one")
            self._write(path, content)
            self.paths.append(path)
            self.names[str(path)] = known
            if known != name:
                self.renamed[known] = name

    @property
    def has_dicom(self) -> bool:
        """Whether there are DICOM files, which `series` and `take` make into a volume."""
        return (self._folder / _DICOM).is_dir()

    def series(self) -> list[Series]:
        """The DICOM series; takes up to seconds."""
        return list_series(self._folder / _DICOM)

    def take(self, chosen: Series, others: list[Series]) -> Path:
        """A folder with the images of one series, called as it is described; `others` are those of the parcel.

        Files that are in no series stay with it: they may be damaged images of it, which its reader says.
        """
        folder = self._folder / chosen.title
        if folder.exists():
            folder = self._folder / f"{chosen.title} DICOM"
        folder.mkdir()
        taken = {Path(file) for series in others if series is not chosen for file in series.files}
        for file in sorted((self._folder / _DICOM).iterdir()):
            if file not in taken:
                os.replace(file, folder / file.name)
        self.names[str(folder)] = folder.name
        _log.info("DICOM: %s, %s", folder.name, chosen.images)
        return folder

    def as_known(self, text: str) -> str:
        """A message with the names of files as the user knows them, without the temporary folder."""
        return text.replace(str(self._folder / _DICOM) + os.sep, "").replace(str(self._folder) + os.sep, "")

    def _write(self, path: Path, content: bytes) -> None:
        try:
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(content)
        except OSError as error:
            raise SimulationError(f"{path.name}: cannot be stored ({error.strerror})") from None
