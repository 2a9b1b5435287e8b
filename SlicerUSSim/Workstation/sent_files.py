"""SentFiles: files of the patient that a page has sent, kept as long as the patient is open, for exported scripts."""

from __future__ import annotations

import filecmp
import io
import shutil
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

#: Suffixes of files that are compressed
_COMPRESSED = (".gz", ".zip", ".mgz")


class SentFiles:
    """Keeps files by name in a temporary folder, which is for this user alone and goes with the program."""

    def __init__(self) -> None:
        self._folder = TemporaryDirectory(prefix="ussim-sent-")
        self._files: dict[str, Path] = {}
        self._number = 0

    @property
    def files(self) -> Mapping[str, Path]:
        """{name: where it is}"""
        return dict(self._files)

    def name_for(self, path: Path) -> str:
        """The name under which a file would be kept: its own, or "name (2).nii.gz" beside another one called so."""
        stem, dot, suffix = path.name.partition(".")
        name, number = path.name, 1
        while (known := self._files.get(name)) is not None and not filecmp.cmp(known, path, shallow=False):
            number += 1
            name = f"{stem} ({number}){dot}{suffix}"
        return name

    def keep(self, name: str, path: Path) -> None:
        """Keep a file under a name; it is moved from where it was."""
        if name not in self._files:
            self._number += 1
            place = Path(self._folder.name) / str(self._number)
            shutil.move(path, place)
            self._files[name] = place

    def forget(self, kept: Iterable[str] = ()) -> None:
        """Remove those of the last patient; the names `kept` are of the next one, too."""
        for name in self._files.keys() - set(kept):
            self._files.pop(name).unlink(missing_ok=True)

    def bundle(self, script: str, names: Iterable[str]) -> bytes:
        """A .zip with a script, and the files of these names beside it."""
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:
            archive.writestr("image.py", script, zipfile.ZIP_DEFLATED)
            for name in names:
                kind = zipfile.ZIP_STORED if name.lower().endswith(_COMPRESSED) else zipfile.ZIP_DEFLATED
                archive.write(self._files[name], name, kind, 1)
        return buffer.getvalue()
