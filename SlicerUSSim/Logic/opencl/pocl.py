"""Workarounds for PoCL 3.0: a processor name that its compiler supports, signals, checks for a linker and of its cache.

PoCL builds kernels for the processor that LLVM 14 takes this one for, and links a library of built-in functions, which
it selects by the processor's flags and which was built for an older processor. Three things go wrong. LLVM calls a
processor it does not know "generic" (AMD Zen 5, for instance), which clang rejects: "unknown target CPU 'generic'"
(pocl/pocl issue 1049, open since 2022). Zen 4 it takes for Zen 3, which has no AVX-512: vectors of 16 floats then end
the process while they are compiled. And LLVM inlines a function only into one of a processor with all its
instructions, even those that it does not use: on Sapphire Rapids, taken for Rocket Lake, which lacks CLWB, and on Zen 1
and 2, which lack INVPCID, every fma, floor and vload of a kernel is a call, and an image takes half again as long. PoCL
3.0 has no setting for the name, but stores it as a C string that is read at every build. This module replaces the
string by the name of the processor that the library was built for.
"""

from __future__ import annotations

import ctypes
import logging
import os
import re
import shutil
import signal
import struct
import sys
import threading
from pathlib import Path

from SlicerUSSim.Logic.base.errors import require

_log = logging.getLogger(__name__)

# The oldest Intel processor of each of PoCL's x86 kernel libraries, and the /proc/cpuinfo flags it needs.
# PoCL selects its library by these flags, and the name must match the library.
_KNOWN_PROCESSORS = (
    ("skylake-avx512", {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl", "avx2", "fma", "bmi2"}),
    ("haswell", {"avx2", "fma", "bmi1", "bmi2", "f16c", "movbe"}),
    ("ivybridge", {"avx", "f16c"}),
    ("nehalem", {"sse4_1", "sse4_2"}),
)
# What LLVM 14 calls processors that it does not know
_UNKNOWN = "generic"
# Names that LLVM 14 also gives to later processors, which have AVX-512
_WITHOUT_AVX512 = ("znver1", "znver2", "znver3")
# Bulldozer and its successors, for which PoCL has a library of their own
_OWN_LIBRARY = "fma4"
_DEVICE_STRUCT_BYTES = 4096
_NOTHING = "__kernel void nothing() {}"
_NOT_NAMED = "PoCL's compiler calls this processor %s, and that cannot be changed: %s; kernels may %s"


def name_processor(handle) -> str | None:
    """Give PoCL the processor name of its kernel library. Returns the name, or None if nothing was changed.

    Of other versions than 3.0 only one that its compiler rejects, or that ends the process, is changed. `handle` is the
    pyopencl Device. Nothing is written unless a pointer to exactly the string that is its name now, in a heap block
    large enough for the new name, is found in the device's own structure.
    """
    flags = _processor_flags()
    called = handle.version.rsplit("-", 1)[-1]
    fails = called == _UNKNOWN or (called in _WITHOUT_AVX512 and "avx512f" in flags)
    if not fails and re.match(r"3\.0\b", handle.driver_version) is None:
        return None
    name = next((name for name, needed in _KNOWN_PROCESSORS if needed <= flags), None)
    if name is None and called == _UNKNOWN:
        _log.warning("PoCL's compiler does not know this processor, and no older one is like it: kernels may not build")
    if name in (None, called) or (_OWN_LIBRARY in flags and not fails):
        return None
    level, otherwise = (logging.WARNING, "not build") if fails else (logging.INFO, "be slow")
    try:
        # Reading a wrong pointer through /proc/self/mem is an error; dereferencing it would end the process.
        memory = os.open("/proc/self/mem", os.O_RDONLY)
    except OSError as error:
        _log.log(level, _NOT_NAMED, called, f"its memory cannot be read ({error.strerror})", otherwise)
        return None
    try:
        address = _find_string(memory, handle.int_ptr, called.encode() + b"\0")
        if address is None and _find_string(memory, handle.int_ptr, name.encode() + b"\0") is not None:
            return None  # since the device was opened before; its version stays as it was
    finally:
        os.close(memory)
    if address is None or _usable_bytes(address) <= len(name):
        _log.log(level, _NOT_NAMED, called, "the name is not where PoCL 3.0 has it", otherwise)
        return None
    ctypes.memmove(address, name.encode() + b"\0", len(name) + 1)
    _log.info("PoCL's compiler calls this processor %s; kernels are built for %s", called, name)
    return name


def require_linker(version: str) -> None:
    """Raise SimulationError if PoCL cannot link kernels, which would end the process: up to version 5 it links every
    kernel with `ld` against libgcc and libc, and aborts if they are missing, as on a minimal Debian. `version` is that
    of the OpenCL platform."""
    found = re.search(r"PoCL (\d+)", version, re.IGNORECASE)
    if found is None or int(found.group(1)) > 5 or sys.platform != "linux":
        return
    search = os.pathsep.join([os.environ.get("PATH", ""), "/usr/bin", "/bin"])
    has_libraries = any(shutil.which(name, path=search) for name in ("gcc", "cc")) or any(
        any(Path("/usr").glob(f"{place}/gcc/*/*/libgcc.a")) for place in ("lib", "lib64")
    )
    require(
        shutil.which("ld", path=search) is not None and has_libraries,
        "PoCL, the OpenCL runtime in use, links its kernels with `ld` and libgcc, which are not installed; on Debian "
        "and Ubuntu run: sudo apt-get install gcc libc6-dev",
    )


def keep_signals(cl, context) -> None:
    """Give signals back the handlers that they had before PoCL's compiler took them.

    At its first build LLVM installs handlers that remove the files being written, also for signals that are ignored,
    and keeps them: Ctrl-C then fails a build in a process that ignores it, or meets a compiler that is ending. `cl` is
    pyopencl. The compiler asks for them once in a process, hence a build of nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        return  # only the main thread can set handlers
    cl.Program(context, _NOTHING).build(cache_dir=False)
    for number in {signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGINT)}:  # Windows has no SIGHUP
        handler = signal.getsignal(number)
        if handler is not None:  # None: not of Python
            signal.signal(number, handler)


def remove_damaged_kernels(folder: Path | None = None) -> int:
    """Remove programs with an incomplete file from PoCL's cache, which would end the process; returns their number.

    `folder` is by default the cache that PoCL uses.
    """
    folder = cache_folder() if folder is None else folder
    removed = 0
    for program in folder.glob("??/*"):
        files = [file for pattern in ("program.bc", "*/*/*.so") for file in program.glob(pattern)]
        try:
            is_damaged = not all(_is_complete(file) for file in files)
        except OSError:  # another process has removed it
            continue
        if is_damaged:
            _log.warning("%s: has an incomplete file, as of a process that was killed; it is removed", program)
            shutil.rmtree(program, ignore_errors=True)
            removed += 1
    return removed


def cache_folder() -> Path:
    """Where PoCL keeps programs, as pocl_cache_init_topdir of lib/CL/pocl_cache.c has it."""
    if "POCL_CACHE_DIR" in os.environ:
        return Path(os.environ["POCL_CACHE_DIR"])
    own = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(own) / "pocl" / "kcache"


def _is_complete(file: Path) -> bool:
    """Whether a shared library or a file of LLVM bitcode is as long as it says."""
    with file.open("rb") as opened:
        size = os.fstat(opened.fileno()).st_size
        start = opened.read(64)
        if file.suffix == ".so":  # ELF, 64 bits: its table of sections is the last thing in it
            if len(start) < 64 or start[:4] != b"\x7fELF":
                return False
            (table,) = struct.unpack_from("<Q", start, 40)
            each, count = struct.unpack_from("<HH", start, 58)
            return table > 0 and table + each * count <= size
        if start[:4] != b"BC\xc0\xde":  # or its wrapper, which is not written here
            return False
        place = 4
        while place < size:  # blocks, each with its length in words after the word with its number
            opened.seek(place)
            head = opened.read(8)
            if len(head) < 8:
                return False
            place += 8 + 4 * struct.unpack_from("<I", head, 4)[0]
        return place == size


def _processor_flags() -> set[str]:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return set()
    return next((set(line.split(":", 1)[1].split()) for line in lines if line.startswith("flags")), set())


def _find_string(memory: int, structure: int, text: bytes) -> int | None:
    def read(address: int, count: int) -> bytes:
        try:
            return os.pread(memory, count, address)
        except OSError:
            return b""

    raw = read(structure, _DEVICE_STRUCT_BYTES)
    for (address,) in struct.iter_unpack("<Q", raw[: len(raw) // 8 * 8]):
        if 4096 < address < 2**47 and read(address, len(text)) == text:
            return address
    return None


def _usable_bytes(address: int) -> int:
    usable = ctypes.CDLL(None).malloc_usable_size
    usable.restype, usable.argtypes = ctypes.c_size_t, [ctypes.c_void_p]
    return usable(address)
