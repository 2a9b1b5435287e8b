"""Atomic writing of files, JSON files, and what is wrong with an unreadable one."""

from __future__ import annotations

import codecs
import hashlib
import json
import os
import platform
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import IO

from SlicerUSSim.Logic.base.errors import SimulationError, require, require_path

_DEEPEST_NESTING = 16
#: Beginning of the names of folders for what is not complete yet
_PARTIAL = ".ussim-"
#: Endings of images that names of files beside them leave out
_IMAGES = (".nii.gz", ".nii", ".nrrd", ".nhdr", ".mha", ".mhd", ".mnc", ".vti", ".dcm", ".mgz", ".img", ".hdr")


def mask_beside(mri_path: str | Path) -> Path:
    """The file of an MRI's brain mask: head.nii.gz has head.brain-mask.nrrd, a DICOM folder the same beside it."""
    return named_beside(mri_path, "brain-mask.nrrd")


def named_beside(mri_path: str | Path, ending: str) -> Path:
    """The file beside an MRI's that has its name and another ending."""
    path = Path(mri_path)
    if path.is_dir():
        path = path.resolve()  # "." has no name
    name = path.name
    suffix = next((end for end in _IMAGES if not path.is_dir() and name.lower().endswith(end)), "")
    return path.with_name(f"{name[: len(name) - len(suffix)]}.{ending}")


def require_place(path: Path) -> None:
    """Raise SimulationError unless `path` can be a file in an existing folder."""
    require(path.parent.is_dir(), f"{path}: the folder {path.parent} does not exist")
    require(not path.is_dir(), f"{path}: is a folder, expected a file name")
    require(path.is_file() or not path.exists(), f"{path}: is a pipe or a device, expected the name of a file")
    require(os.access(path.parent, os.W_OK), f"{path}: cannot be written (no permission in {path.parent})")


def require_folder(path: str | os.PathLike) -> None:
    """Raise SimulationError unless the folder is there, or can be created, and can be written to."""
    folder = Path(path)
    there = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    why = "" if there.is_dir() else f"{there} is a file"
    if not why and not os.access(there, os.W_OK):
        why = f"no permission in {there}"
    require(not why, f"{folder}: cannot be {'written to' if there == folder else 'created'} ({why})")


def make_folder(path: str | os.PathLike) -> Path:
    """The folder, created if necessary. Raises SimulationError if it cannot be created."""
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SimulationError(f"{folder}: cannot be created ({error.strerror})") from None
    return folder


@contextmanager
def messages_withheld() -> Iterator[None]:
    """Keep what C++ libraries print to stderr in the block, and drop it if the block raises: the error says it all.

    The process has one stderr: while several threads are in such blocks, what all print is kept, and shown once the
    last is done unless one of them raised.
    """
    _withheld.begin()
    is_well = False
    try:
        yield
        is_well = True
    finally:
        _withheld.end(is_well)


class _Withheld:
    """What is printed to stderr while threads are in blocks of messages_withheld."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._blocks, self._are_well = 0, True
        self._stderr = -1
        self._printed: IO[bytes] | None = None

    def begin(self) -> None:
        with self._lock:
            self._blocks += 1
            if self._blocks > 1:
                return
            self._are_well, self._printed = True, None
            try:
                self._stderr = os.dup(2)
            except OSError:  # there is no stderr
                return
            try:
                self._printed = tempfile.TemporaryFile()  # noqa: SIM115 (closed in end)
            except OSError:  # there is no room
                os.close(self._stderr)
                return
            _flush_stderr()
            os.dup2(self._printed.fileno(), 2)

    def end(self, is_well: bool) -> None:
        with self._lock:
            self._blocks -= 1
            self._are_well = self._are_well and is_well
            if self._blocks or self._printed is None:
                return
            with self._printed as printed:
                self._printed = None
                _flush_stderr()
                os.dup2(self._stderr, 2)
                os.close(self._stderr)
                if self._are_well:
                    printed.seek(0)
                    os.write(2, printed.read())


_withheld = _Withheld()


def _flush_stderr() -> None:
    if sys.stderr is not None:  # as in programs without a console
        sys.stderr.flush()


@contextmanager
def written_whole(path: str | os.PathLike) -> Iterator[Path]:
    """Yield a temporary path to write to; it replaces `path` only if the block succeeds.

    All of it is on the disk before it replaces anything, so that after a crash or a power cut the file is the old or
    the new one. Raises SimulationError naming `path` if it cannot be written.
    """
    path = Path(path)
    require_place(path)
    with partial_folder(path) as folder:
        try:
            yield folder / path.name
            _put_in_place(folder, path)
        except (OSError, RuntimeError) as error:
            raise SimulationError(f"{path}: cannot be written ({str(error).strip().splitlines()[-1]})") from None


@contextmanager
def partial_folder(path: Path, problem: str = "cannot be written") -> Iterator[Path]:
    """A new folder beside the file `path`, or in it if it is a folder, for what is not complete yet.

    It is removed at the end of the block; those of runs that were killed are removed, too. Raises SimulationError,
    which says the `problem`, without room or permission.
    """
    try:
        folder = _new_partial_folder(path if path.is_dir() else path.parent)
    except OSError as error:
        raise SimulationError(f"{path}: {problem} ({error.strerror})") from None
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _new_partial_folder(parent: Path) -> Path:
    host = hashlib.sha256(platform.node().encode()).hexdigest()[:6]  # folders may be shared between computers
    for old in parent.glob(f"{_PARTIAL}{host}-*-*"):
        number = old.name.split("-")[2]
        if number.isdecimal() and not _is_running(int(number)):
            shutil.rmtree(old, ignore_errors=True)
    return Path(tempfile.mkdtemp(prefix=f"{_PARTIAL}{host}-{os.getpid()}-", dir=parent))


def _is_running(number: int) -> bool:
    """Whether a process of this number runs; where that cannot be asked without harm, it is taken to."""
    if os.name != "posix" or number <= 0:
        return True
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # it is another user's
        return True
    return True


def move_into(folder: Path, files: Sequence[Path]) -> None:
    """Move files to a folder, in their order, once all of them are on the disk. Raises OSError."""
    for file in files:
        _put_on_disk(file)
    for file in files:
        file.replace(folder / file.name)
    _put_on_disk(folder)


def _put_on_disk(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk. Raises OSError if they cannot be."""
    if path.is_dir() and os.name != "posix":  # elsewhere folders cannot be opened
        return
    opened = os.open(path, os.O_RDONLY if os.name == "posix" else os.O_RDWR)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


def _put_in_place(folder: Path, path: Path) -> None:
    """Move what was written in `folder` under the name of `path` to it."""
    for file in folder.iterdir():
        require(file.name == path.name, f"{path}: would be written as {file.name}; give another name")
    move_into(path.parent, [folder / path.name])


def read_small(path: str | os.PathLike, most_bytes: int = 16 * 2**20) -> bytes:
    """The content of a file. Raises SimulationError for one that is larger than any of its kind, before all is read."""
    size = Path(path).stat().st_size
    require(size <= most_bytes, f"{path}: has {size} bytes, expected at most {most_bytes}")
    with open(path, "rb") as file:
        content = file.read(most_bytes + 1)  # pipes and devices have no size
    require(len(content) <= most_bytes, f"{path}: has more than {most_bytes} bytes, expected at most as many")
    return content


def read_text(path: str | os.PathLike, most_bytes: int = 16 * 2**20, errors: str = "strict") -> str:
    """The text of a file in UTF-8, or in UTF-16 if it starts with the mark of that; no mark is left in it.

    `errors` as in bytes.decode. Raises UnicodeDecodeError, and SimulationError as read_small does.
    """
    content = read_small(path, most_bytes)
    is_utf_16 = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return content.decode("utf-16" if is_utf_16 else "utf-8-sig", errors)


def read_json(path: str | os.PathLike, most_bytes: int = 4 * 2**20):
    """The content of a JSON file.

    Raises SimulationError naming the file if it cannot be read, is larger than `most_bytes`, is nested deeper than any
    file of this project, or has ambiguous content: duplicate names, NaN and infinities.
    """
    require_path(path)
    try:
        text = read_text(path, most_bytes)
        _check_nesting(path, text)
        return json.loads(text, object_pairs_hook=_distinct, parse_constant=_refused)
    except OSError as error:
        raise SimulationError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError) as error:
        raise SimulationError(f"{path}: is not JSON ({error})") from None


def _check_nesting(path: str | os.PathLike, text: str) -> None:
    depth = 0
    for bracket in re.finditer(r'"(?:[^"\\]|\\.)*"|[\[{]|[\]}]', text):
        if bracket[0] in ("[", "{"):
            depth += 1
            require(depth <= _DEEPEST_NESTING, f"{path}: is nested deeper than {_DEEPEST_NESTING} levels")
        elif bracket[0] in ("]", "}"):
            depth -= 1


def _distinct(pairs: list[tuple[str, object]]) -> dict[str, object]:
    """The object of these pairs. Raises ValueError for a duplicate name."""
    found: dict[str, object] = {}
    for name, value in pairs:
        if name in found:
            raise ValueError(f"{name[:80]!r} is given twice")
        found[name] = value
    return found


def _refused(constant: str) -> float:
    raise ValueError(f"{constant} is not a number")


def write_json(path: str | os.PathLike, values) -> None:
    """Write plain values as JSON; on failure an existing file is kept."""
    with written_whole(path) as partial:
        partial.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")
