"""Reading files: what readers raise becomes one line, and files that are not trusted are read in a child process.

Libraries that read images end the whole process for some damaged files (ITK at HDF5, VTK at XML), run forever or fill
the memory for others, and files may be made to do worse. A child process with limits on time and memory loses only
itself; what it has read comes back as numbers, texts and this package's values, and as nothing else.
"""

from __future__ import annotations

import functools
import inspect
import io
import logging
import os
import pickle
import shutil
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, is_dataclass
from enum import Enum
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ParamSpec, TypeVar

from SlicerUSSim.Logic.base.errors import (
    Cancelled,
    OtherFileError,
    SimulationError,
    is_our_warning,
    require_path,
    shown_path,
    warn_again,
)

_T = TypeVar("_T")
_P = ParamSpec("_P")
_log = logging.getLogger(__name__)

#: Environment variable with which no file is trusted: any text but "" and "0"
UNTRUSTED = "USSIM_UNTRUSTED"
#: Threads of the libraries in a child; each takes address space
_ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS": "1"}
#: What is not of this package, but may come back from a child: (module, name)
_SAFE = {
    *((f"numpy.{part}.multiarray", name) for part in ("core", "_core") for name in ("_reconstruct", "scalar")),
    *((f"numpy.{part}.numeric", "_frombuffer") for part in ("core", "_core")),
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("SimpleITK.SimpleITK", "Image"),
    ("builtins", "set"),
    ("builtins", "frozenset"),
    ("builtins", "slice"),
    ("builtins", "complex"),
    ("copyreg", "_reconstructor"),
    ("builtins", "object"),
    *(("pathlib", name) for name in ("PosixPath", "WindowsPath", "PurePosixPath", "PureWindowsPath")),
}


class PlainValue:
    """Base of a class that is not a dataclass, but whose objects are plain values, and may come back from a child."""


@dataclass(frozen=True)
class ReadingLimits:
    """What a child process may use to read one file."""

    #: Seconds for a small file, and bytes of the file for which it gets one more
    seconds: float = 60.0
    bytes_per_second: float = 5e6
    #: Bytes of address space (not on Windows); 0: half of the memory of the computer, at least 4 GiB
    memory: int = 0

    def seconds_for(self, path: Path) -> float:
        """Seconds for a file or a folder."""
        return self.seconds + _size(path) / self.bytes_per_second

    @property
    def memory_or_default(self) -> int:
        """Bytes of address space."""
        if self.memory:
            return self.memory
        sysconf = getattr(os, "sysconf", None)
        whole = sysconf("SC_PAGE_SIZE") * sysconf("SC_PHYS_PAGES") if sysconf else 0
        return max(4 * 2**30, whole // 2)


#: Folders of files that are not trusted, with the limits for them
_folders: dict[Path, ReadingLimits] = {}
#: Whether this process is a child that reads a file for another
_is_child = False


@contextmanager
def untrusted_folder(limits: ReadingLimits | None = None) -> Iterator[str]:
    """A temporary folder for untrusted files such as uploads, which readers read in a child process."""
    with TemporaryDirectory(prefix="ussim-untrusted-") as name:
        folder = Path(name).resolve()
        _folders[folder] = limits or ReadingLimits()
        try:
            yield str(folder)
        finally:
            del _folders[folder]


def reader(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """A function that reads the file `path`: whatever is raised for a file becomes one line with its name.

    What was raised is logged with its traceback at the level debug (`--verbose`). A file that is not trusted, from an
    untrusted_folder or any with UNTRUSTED in the environment, is read in a child process.
    """
    return _reading(function, always_in_child=False)


def in_child(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """A reader whose file is always read in a child process, since its library crashes for damaged ones."""
    return _reading(function, always_in_child=True)


def _reading(function: Callable[_P, _T], *, always_in_child: bool) -> Callable[_P, _T]:
    signature = inspect.signature(function)

    @functools.wraps(function)
    def read(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        path = signature.bind(*args, **kwargs).arguments["path"]
        require_path(path)
        limits = _limits_of(path)
        if limits is None and always_in_child and not _is_child:
            limits = ReadingLimits()
        try:
            if limits is not None:
                return _in_child(read, args, kwargs, Path(path), limits)
            return function(*args, **kwargs)
        except (Cancelled, OtherFileError):
            raise
        except Exception as error:  # libraries document few of theirs, and raise others for damaged files
            raise _about(shown_path(path), error) from (error if isinstance(error, SimulationError) else None)

    return read


def starts_like_hdf5(path: Path) -> bool:
    """Whether a file is HDF5, as MINC 2 and ITK's .h5 are."""
    with path.open("rb") as file:
        return file.read(8) == b"\x89HDF\r\n\x1a\n"


def _limits_of(path: object) -> ReadingLimits | None:
    """The limits within which a file is read in a child process; None for one that is read here."""
    if _is_child or not isinstance(path, str | os.PathLike):
        return None
    if _folders:
        absolute = Path(os.path.abspath(path))
        for folder in (absolute, *absolute.parents):
            if folder in _folders:
                return _folders[folder]
    return ReadingLimits() if os.environ.get(UNTRUSTED, "0") not in ("", "0") and os.path.exists(path) else None


def _about(path: str, error: Exception) -> SimulationError:
    """An error of a reader as one line about a file."""
    if isinstance(error, SimulationError):
        return error if path in str(error) else SimulationError(f"{path}: {error}")
    _log.debug("%s", path, exc_info=error)
    if isinstance(error, MemoryError):
        return SimulationError(f"{path}: cannot be read (it needs more memory than there is)")
    lines = str(error).strip().splitlines()
    reason = f"{type(error).__name__}: {lines[-1][:200]}" if lines else type(error).__name__
    return SimulationError(f"{path}: cannot be read ({reason})")


# ---- parent ----------------------------------------------------------------------------------------------------------


def _in_child(function: Callable, args: tuple, kwargs: dict[str, Any], path: Path, limits: ReadingLimits) -> Any:
    """The result of a reader in a child process, which has logged and warned here too."""
    seconds, level = limits.seconds_for(path), logging.getLogger("SlicerUSSim").getEffectiveLevel()
    with TemporaryDirectory(prefix="ussim-child-") as folder:
        answer = Path(folder) / "answer"
        task = (
            function.__module__,
            function.__qualname__,
            args,
            kwargs,
            str(answer),
            (seconds, limits.memory_or_default),
            level,
        )
        command, environment = child_command(f"from {__name__} import answer_parent; answer_parent()")
        environment = {name: value for name, value in environment.items() if name != UNTRUSTED} | _ONE_THREAD
        try:
            ended = subprocess.run(
                command, input=pickle.dumps(task), capture_output=True, timeout=seconds, env=environment, check=False
            )
        except subprocess.TimeoutExpired:
            raise SimulationError(
                f"{shown_path(path)}: is not read after {seconds:.0f} s, expected less for {_size(path)} bytes"
            ) from None
        if ended.stderr:
            _log.debug("%s: %s", shown_path(path), ended.stderr.decode("utf-8", "replace"))
        if ended.returncode != 0 or not answer.is_file():
            raise SimulationError(f"{shown_path(path)}: cannot be read ({_ending(ended.returncode)})")
        try:
            with answer.open("rb") as file:
                kind, value, warned, logged = _Safe(file).load()
        except (pickle.UnpicklingError, EOFError, AttributeError, ValueError, TypeError, ImportError) as error:
            raise SimulationError(f"{shown_path(path)}: cannot be read (its reader gave no answer: {error})") from None
    for name, number, message in logged:
        logging.getLogger(str(name)).log(int(number), "%s", message)
    for warning in warned:
        warn_again(warning)
    if kind == "error":
        raise value
    return value


def child_command(code: str) -> tuple[list[str], dict[str, str]]:
    """(command, environment) of a Python that runs `code` and imports what this process does.

    In 3D Slicer, whose executable is the application, it is PythonSlicer. The package has the same place there, which
    need not be on sys.path, see USSim.bindPackage.
    """
    package = __name__.split(".")[0]
    bound = (
        "import importlib.machinery, importlib.util, sys; "
        f"spec = importlib.machinery.ModuleSpec({package!r}, None, is_package=True); "
        f"spec.submodule_search_locations = {list(sys.modules[package].__path__)!r}; "
        f"sys.modules[{package!r}] = importlib.util.module_from_spec(spec); "
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    return [shutil.which("PythonSlicer") or sys.executable, "-c", bound + code], environment


def _ending(code: int) -> str:
    if code >= 0:
        return f"the library that reads it ended the reading process with status {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    if name == "SIGXCPU":
        return "it takes too long"
    return f"the library that reads it crashed: {name}"


class _Safe(pickle.Unpickler):
    """Makes numbers, texts and this package's values, and calls nothing else, whatever a child writes."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _SAFE:
            return super().find_class(module, name)
        if module.startswith("SlicerUSSim.Logic."):
            found = super().find_class(module, name)
            is_value = isinstance(found, type) and issubclass(found, PlainValue | Enum | Warning | SimulationError)
            if is_value or (isinstance(found, type) and is_dataclass(found)):
                return found
        raise pickle.UnpicklingError(f"{module}.{name} is not a value that readers return")


def _size(path: Path) -> int:
    """Bytes of a file, or of the files in a folder."""
    try:
        if path.is_dir():
            return sum(entry.stat().st_size for entry in path.iterdir() if entry.is_file())
        return path.stat().st_size
    except OSError:
        return 0


# ---- child -----------------------------------------------------------------------------------------------------------


class _Kept(logging.Handler):
    """Keeps (logger, level, message) for the parent."""

    def __init__(self) -> None:
        super().__init__()
        self.records: list[tuple[str, int, str]] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.records.append((record.name, record.levelno, record.getMessage()))


def answer_parent() -> None:
    """Called in a child process: reads what stdin says, and writes the result into the file that it names."""
    global _is_child
    _is_child = True
    module, name, args, kwargs, answer, (seconds, memory), level = pickle.load(sys.stdin.buffer)
    _limit(seconds, memory)
    kept, logger = _Kept(), logging.getLogger("SlicerUSSim")
    logger.addHandler(kept)
    logger.setLevel(level)
    logger.propagate = False
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            result = ("value", _function(module, name)(*args, **kwargs))
        except SimulationError as error:
            result = ("error", type(error)(*error.args))  # without its cause, which may be of any library
    ours = [w.message for w in caught if is_our_warning(w.category)]
    content = io.BytesIO()
    pickle.dump((*result, ours, kept.records), content, protocol=pickle.HIGHEST_PROTOCOL)
    Path(answer).write_bytes(content.getbuffer())
    sys.stdout.flush()
    os._exit(0)  # at exit libraries may crash over what a damaged file left


def _function(module: str, name: str) -> Callable:
    found: Any = __import__(module, fromlist=["_"])
    for part in name.split("."):
        found = getattr(found, part)
    return getattr(found, "__func__", found)  # of a class method, whose class is the first argument


def _limit(seconds: float, memory: int) -> None:
    """Limit this process, on systems that can."""
    try:
        import resource
    except ImportError:
        return
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    whole = int(seconds) + 1
    resource.setrlimit(resource.RLIMIT_CPU, (whole, whole + 5))
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
