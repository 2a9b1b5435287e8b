"""SentFiles: files of the patient that a page has sent, kept as long as the patient is open, for exported scripts."""

from __future__ import annotations

import filecmp
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory

from SlicerUSSim.Workstation.zipped import zipped


class SentFiles:
    """Keeps files by name in a temporary folder, which is for this user alone and goes with the program.

    The name of a folder, such as a DICOM series, is that of all files in it. Files that are read together, such as
    probability maps of three tissues, are in a folder, of which the name of one of them means all.
    """

    def __init__(self) -> None:
        self._folder = TemporaryDirectory(prefix="ussim-sent-")
        self._files: dict[str, Path] = {}
        self._number = 0

    @property
    def files(self) -> Mapping[str, Path]:
        """{name: where it is}; names of files in folders have slashes."""
        return dict(self._files)

    def has(self, name: str) -> bool:
        """Whether a file or folder of this name is kept."""
        return bool(self._meant([name]))

    def name_for(self, path: Path, others: Sequence[Path] = ()) -> str:
        """The name under which a file or folder would be kept: its own, or "name (2).nii.gz" beside one called so.

        `others` are read together with it.
        """
        stem, dot, suffix = (path.stem.partition(".")[0], "", "") if others else path.name.partition(".")
        name, number = f"{stem}{dot}{suffix}", 1
        while self._is_another(name, path, others):
            number += 1
            name = f"{stem} ({number}){dot}{suffix}"
        return f"{name}/{path.name}" if others else name

    def keep(self, name: str, path: Path, others: Sequence[Path] = ()) -> None:
        """Keep a file or folder under a name of name_for, with `others`; they are moved from where they were."""
        folder = str(PurePosixPath(name).parent) if others else name
        for part, file in _parts(path, others).items():
            key = f"{folder}/{part}" if part else folder
            if key not in self._files:
                self._number += 1
                place = Path(self._folder.name) / str(self._number)
                shutil.move(file, place)
                self._files[key] = place

    def forget(self, kept: Iterable[str] = ()) -> None:
        """Remove those of the last patient; the names `kept` are of the next one, too."""
        for name in self._files.keys() - self._meant(kept):
            self._files.pop(name).unlink(missing_ok=True)

    def bundle(self, script: str, names: Iterable[str], progress: Callable[[float], None]) -> bytes:
        """A .zip with a script, and the files of these names beside it; `progress` may raise Cancelled."""
        files = {name: self._files[name] for name in sorted(self._meant(names))}
        return zipped(files, progress, {"image.py": script})

    def _meant(self, names: Iterable[str]) -> set[str]:
        """The kept files that names of files and folders mean."""
        wanted = {str(PurePosixPath(name).parent) if "/" in name else name for name in names if name}
        return {name for name in self._files if name in wanted or name.partition("/")[0] in wanted}

    def _is_another(self, name: str, path: Path, others: Sequence[Path]) -> bool:
        """Whether this is the name of other files than these."""
        known = {key: self._files[key] for key in self._meant([name])}
        parts = {f"{name}/{part}" if part else name: file for part, file in _parts(path, others).items()}
        if not known:
            return False
        return known.keys() != parts.keys() or not all(
            filecmp.cmp(known[key], file, shallow=False) for key, file in parts.items()
        )


def _parts(path: Path, others: Sequence[Path]) -> dict[str, Path]:
    """{name below that under which they are kept: file} of a folder, of files that are read together, or of one."""
    if path.is_dir():
        return {file.name: file for file in sorted(path.iterdir())}
    return {file.name: file for file in (path, *others)} if others else {"": path}
