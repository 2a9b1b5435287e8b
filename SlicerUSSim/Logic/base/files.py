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
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Lock
from typing import IO

from SlicerUSSim.Logic.base.errors import SimulationError, require, require_path

_DEEPEST_NESTING = 16
#: Beginning of the names of folders for what is not complete yet
_PARTIAL = ".ussim-"
#: Suffixes of headers with voxels in a second file, and endings of that
_HEADERS, _VOXELS = (".mhd", ".nhdr"), (".raw.gz", ".zraw", ".raw")
#: Those that are looked through for the names of files
_MOST_HEADER_BYTES = 2**26
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


def require_space(path: Path, most_bytes: int) -> None:
    """Raise SimulationError unless the disk has room for a file of `most_bytes`."""
    free = shutil.disk_usage(path.parent).free
    require(free > most_bytes, f"{path}: cannot be written (may need {most_bytes} bytes, and the disk has {free} left)")


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
    the new one. The voxels of a .mhd or .nhdr get a name of their own, by their content, and the header that names them
    comes last; those that this program wrote for the header before are removed then, unless another header names them.
    Raises SimulationError naming `path` if it cannot be written.
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
            with suppress(OSError), _alone_in(parent):
                _remove_unnamed(old)
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
    main = folder / path.name
    if path.suffix.lower() in _HEADERS:
        _name_by_content(main)
    for file in folder.iterdir():
        is_own = file.name == path.name or _is_voxels_of(file.name, path)
        require(is_own, f"{path}: would be written as {file.name}; give another name")
    if path.suffix.lower() not in _HEADERS:
        move_into(path.parent, [main])
        return
    voxels = sorted(file for file in folder.iterdir() if file != main)
    with _alone_in(path.parent):
        if path.is_file():
            _keep_header(path, folder)
        try:
            move_into(path.parent, [*voxels, main])  # the header, which names the voxels, last
        finally:
            with suppress(OSError):
                _remove_unnamed(folder)


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Keep other runs of this program from moving and removing files in a folder meanwhile, where that can be.

    Another run may write the same voxels, which have the same name: they are there before the header that names them.
    """
    lock = None
    try:
        import fcntl

        lock = os.open(folder, os.O_RDONLY)
        fcntl.flock(lock, fcntl.LOCK_EX)
    except (ImportError, OSError):  # on Windows, and on some network disks
        pass
    try:
        yield
    finally:
        if lock is not None:
            os.close(lock)


def _keep_header(path: Path, folder: Path) -> None:
    """Copy a header that is replaced to a folder in `folder`, so that also the run after a killed one finds it."""
    old = folder / "replaced"
    old.mkdir()
    if path.stat().st_size <= _MOST_HEADER_BYTES:
        shutil.copyfile(path, old / path.name)


def _remove_unnamed(folder: Path) -> None:
    """Remove the voxels beside a partial folder that headers left in it name, and none of the headers beside it does.

    Only those are removed that have the name, by their content, which this program gives.
    """
    for header in (*folder.glob("*"), *folder.glob("*/*")):
        if header.suffix.lower() not in _HEADERS or not header.is_file():
            continue
        named = rf"^(?:ElementDataFile\s*=|data file:)[ \t]*({re.escape(header.stem)}\.[^\r\n]*)"
        for found in re.finditer(os.fsencode(named), header.read_bytes(), re.MULTILINE):
            voxels = folder.parent / os.fsdecode(found[1]).strip()
            if _is_voxels_of(voxels.name, header) and voxels.parent == folder.parent and voxels.is_file():
                is_ours = hash_of_file(voxels)[:16] == voxels.name[len(header.stem) + 1 :][:16]
                if is_ours and not _is_named(voxels):
                    voxels.unlink(missing_ok=True)


def _is_named(voxels: Path) -> bool:
    """Whether a header in its folder names a file, or is too large to be looked through."""
    name = os.fsencode(voxels.name)
    headers = (file for file in voxels.parent.iterdir() if file.suffix.lower() in _HEADERS and file.is_file())
    return any(file.stat().st_size > _MOST_HEADER_BYTES or name in file.read_bytes() for file in headers)


def _name_by_content(header: Path) -> None:
    """Give the file of voxels beside a header a name by its content, also in the header."""
    for file in sorted(header.parent.iterdir()):
        ending = next((end for end in _VOXELS if file.name == header.stem + end), None)
        if ending is None:
            continue
        name = f"{header.stem}.{hash_of_file(file)[:16]}{ending}"
        line = re.compile(
            rb"^((?:ElementDataFile\s*=|data file:)\s*)" + re.escape(os.fsencode(file.name)), re.MULTILINE
        )
        text, count = line.subn(rb"\g<1>" + os.fsencode(name), header.read_bytes())
        if count != 1:
            raise OSError(f"its header does not name {file.name}")
        header.write_bytes(text)
        file.rename(file.with_name(name))


def _is_voxels_of(name: str, header: Path) -> bool:
    """Whether a name is one of voxels that this program wrote for a header."""
    endings = "|".join(re.escape(end) for end in _VOXELS)
    is_header = header.suffix.lower() in _HEADERS
    return is_header and re.fullmatch(rf"{re.escape(header.stem)}\.[0-9a-f]{{16}}({endings})", name) is not None


def hash_of_file(path: Path) -> str:
    """SHA-256 of what is in a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


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

    `errors` is that of bytes.decode. Raises UnicodeDecodeError, and SimulationError as read_small does.
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
