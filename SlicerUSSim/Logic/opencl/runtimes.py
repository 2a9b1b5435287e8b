"""Imports pyopencl after registering the OpenCL runtimes installed by pip with its loader.

A driver registers its runtime with the system; a wheel cannot. Its library is therefore registered here before pyopencl
is imported: by a folder of .icd files on Linux, by OCL_ICD_FILENAMES on Windows (untested there).
"""

from __future__ import annotations

import importlib.metadata
import logging
import os
import re
import sys
import zlib
from contextlib import closing, suppress
from functools import lru_cache
from pathlib import Path

from SlicerUSSim.Logic.base.errors import SimulationError

_log = logging.getLogger(__name__)

#: The distribution of Intel's runtime for processors
INTEL_RUNTIME = "intel-opencl-rt"


@lru_cache(maxsize=1)
def load_pyopencl():
    """Import pyopencl with all installed runtimes visible to its ICD loader. Raises SimulationError without it."""
    if "pyopencl" not in sys.modules:
        register_pip_runtimes()
        _remove_damaged_calls()
    try:
        import pyopencl
    except ImportError as error:
        raise SimulationError(f"pyopencl cannot be imported ({error}); install it with: pip install pyopencl") from None
    return pyopencl


def _remove_damaged_calls() -> None:
    """Remove pyopencl's store of generated calls if it is damaged: pyopencl would fail on it every time."""
    import sqlite3

    import platformdirs

    folder = Path(platformdirs.user_cache_dir("pytools", "pytools"))
    for file in folder.glob("pdict-*pyopencl*.sqlite"):
        try:
            with closing(sqlite3.connect(file)) as store:
                is_sound = store.execute("PRAGMA quick_check").fetchone() == ("ok",)
        except sqlite3.DatabaseError as error:
            is_sound = isinstance(error, sqlite3.OperationalError)  # locked, or not to be opened
        if not is_sound:
            _log.warning("%s: is damaged, and is removed", file)
            with suppress(OSError):
                file.unlink()


def register_pip_runtimes() -> None:
    """Register the runtimes installed by pip with the ICD loader, in the environment of this process."""
    if sys.platform == "linux" and "OCL_ICD_VENDORS" not in os.environ:
        _point_at_vendors_folder()
    elif sys.platform == "win32":
        _add_to_icd_filenames()


def _add_to_icd_filenames() -> None:
    """Add Intel's library to the variable that Khronos' loader, which is in pyopencl's wheels, reads on Windows.

    The loader reads paths separated by ; before the drivers in the registry, and searches a library's own folder for
    its dependencies. It ignores the variable in programs that run as administrator. Source: icd.c and windows/* of
    KhronosGroup/OpenCL-ICD-Loader. Untested on Windows.
    """
    library = _library_of(INTEL_RUNTIME, r"intelocl64\.dll")
    if library is None:
        return
    named = [path for path in os.environ.get("OCL_ICD_FILENAMES", "").split(";") if path]
    if str(library) not in named:
        os.environ["OCL_ICD_FILENAMES"] = ";".join([*named, str(library)])
        _log.debug("OpenCL runtime installed by pip: %s", library)


def _point_at_vendors_folder() -> None:
    """Point the ICD loader at a folder that names every runtime by absolute path.

    Intel's wheel has an .icd file with a placeholder path, and OCL_ICD_VENDORS *replaces* the loader's default folders.
    A separate folder therefore lists Intel's library, PoCL's wheel and the runtimes installed in the system.
    """
    libraries = {}
    for name, library in (("intel", _library_of(INTEL_RUNTIME, r"libintelocl\.so.*")), ("pocl", pocl_of_pip())):
        if library is not None:
            libraries[f"ussim-{name}.icd"] = str(library)
    if "ussim-intel.icd" not in libraries:
        return  # without Intel's wheel the loader finds all runtimes
    import platformdirs

    folder = Path(platformdirs.user_cache_dir("ussim")) / "vendors" / f"{zlib.crc32(sys.prefix.encode()):08x}"
    try:
        for vendor in Path("/etc/OpenCL/vendors").glob("*.icd"):
            libraries[vendor.name] = vendor.read_text().strip()
        folder.mkdir(parents=True, exist_ok=True)
        for stale in folder.glob("*.icd"):
            if stale.name not in libraries:
                stale.unlink(missing_ok=True)
        for name, library in libraries.items():
            if not (folder / name).exists() or (folder / name).read_text() != library:
                partial = folder / f"{name}.{os.getpid()}"
                partial.write_text(library)
                partial.replace(folder / name)
    except OSError as error:  # a read-only home directory: the loader's default folders still work
        _log.warning(
            "Intel's OpenCL runtime is installed but not used: %s cannot be written (%s)", folder, error.strerror
        )
        return
    _log.debug("OpenCL runtimes: %s", ", ".join(libraries.values()))
    os.environ["OCL_ICD_VENDORS"] = str(folder)


def pocl_of_pip() -> Path | None:
    """The library of PoCL's wheel, or None."""
    return _library_of("pocl-binary-distribution", r"libpocl-.*\.so.*")


def _library_of(distribution: str, pattern: str) -> Path | None:
    """The first file of an installed distribution whose name matches `pattern`, or None."""
    try:
        files = importlib.metadata.files(distribution) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    for file in files:
        if re.fullmatch(pattern, file.name) and not file.name.endswith((".py", ".pyc")):
            path = Path(str(file.locate())).resolve()
            if path.exists():
                return path
    return None
