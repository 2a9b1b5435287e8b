"""Workarounds for PoCL 3.0: a processor name that its compiler supports, signals, checks for a linker and of its cache.

PoCL builds kernels for the processor that LLVM 14 takes this one for, and links a library of built-in functions, which
it selects by the processor's flags and which was built for an older processor. LLVM calls a processor it does not know
"generic" (AMD Zen 5, for instance), which clang rejects: "unknown target CPU 'generic'" (pocl/pocl issue 1049, open
since 2022). Zen 4 it takes for Zen 3, which has no AVX-512: vectors of 16 floats then end the process while they are
compiled. PoCL 3.0 has no setting for the name, but stores it as a C string that is read at every build. Where a child
process cannot compute, this module replaces the string by the name of the processor that the library was built for.
"""

from __future__ import annotations

import ctypes
import logging
import os
import re
import shutil
import signal
import struct
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.reading import child_command
from SlicerUSSim.Logic.opencl.runtimes import load_pyopencl

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
_DEVICE_STRUCT_BYTES = 4096
_NOTHING = "__kernel void nothing() {}"
_NOT_NAMED = "PoCL's compiler calls this processor %s, and that cannot be changed: %s; kernels may not build"
_SELF_TEST = """__kernel void self_test(__global float *values) {
  vstore16(floor(fma(vload16(0, values), 2.0f, 0.5f)), 0, values);
}"""
_SELF_TEST_SECONDS = 120


def name_processor(handle) -> str | None:
    """Give PoCL the processor name of its kernel library, if it fails with its own. Returns the name, or None.

    `handle` is the pyopencl Device. Nothing is written unless a child process fails without it, and a pointer to
    exactly the string that is its name now, in a heap block large enough for the new name, is found in the device's own
    structure.
    """
    flags = _processor_flags()
    called = handle.version.rsplit("-", 1)[-1]
    if called != _UNKNOWN and not (called in _WITHOUT_AVX512 and "avx512f" in flags):
        return None
    if _passes_self_test(f"{handle.driver_version} {called}"):
        return None
    name = next((name for name, needed in _KNOWN_PROCESSORS if needed <= flags), None)
    if name is None:
        _log.warning("PoCL's compiler does not know this processor, and no similar older one: kernels may not build")
        return None
    try:
        # Reading a wrong pointer through /proc/self/mem is an error; dereferencing it would end the process.
        memory = os.open("/proc/self/mem", os.O_RDONLY)
    except OSError as error:
        _log.warning(_NOT_NAMED, called, f"its memory cannot be read ({error.strerror})")
        return None
    try:
        address = _find_string(memory, handle.int_ptr, called.encode() + b"\0")
        if address is None and _find_string(memory, handle.int_ptr, name.encode() + b"\0") is not None:
            return None  # since the device was opened before; its version does not change
    finally:
        os.close(memory)
    if address is None or _usable_bytes(address) <= len(name):
        _log.warning(_NOT_NAMED, called, "the name is not where PoCL 3.0 has it")
        return None
    ctypes.memmove(address, name.encode() + b"\0", len(name) + 1)
    _log.info("PoCL's compiler calls this processor %s; kernels are built for %s", called, name)
    return name


def _passes_self_test(what: str) -> bool:
    """Whether a child process computes with the present PoCL. The answer is kept beside PoCL's programs, for `what`."""
    kept, text = cache_folder() / "ussim-self-test", ""
    with suppress(OSError):
        text = kept.read_text()
    if not text.startswith(f"{what}\n"):
        command, environment = child_command(f"from {__name__} import self_test; self_test()")
        try:
            subprocess.run(command, env=environment, capture_output=True, check=True, timeout=_SELF_TEST_SECONDS)
            text = f"{what}\npassed"
        except subprocess.SubprocessError as error:
            _log.info("PoCL fails on this processor: %s", error)
            text = f"{what}\nfailed"
        with suppress(OSError):
            kept.write_text(text)
    return text.endswith("passed")


def self_test() -> None:
    """Compute with vectors of 16 floats; in a child process, which PoCL ends where it cannot build that."""
    cl: Any = load_pyopencl()
    platform = next(one for one in cl.get_platforms() if "Portable Computing Language" in one.name)
    context = cl.Context(platform.get_devices()[:1])
    queue = cl.CommandQueue(context)
    flags, values = cl.mem_flags, np.arange(16, dtype=np.float32)
    buffer = cl.Buffer(context, flags.READ_WRITE | flags.COPY_HOST_PTR, hostbuf=values)
    cl.Program(context, _SELF_TEST).build(cache_dir=False).self_test(queue, (1,), (1,), buffer)
    found = np.empty_like(values)
    cl.enqueue_copy(queue, found, buffer)
    require(np.array_equal(found, 2 * values), f"PoCL computes {found}, expected {2 * values}")


def require_linker(version: str) -> None:
    """Raise SimulationError if PoCL cannot link kernels, which would end the process: up to version 5 it links every
    kernel with `ld` of PATH against libgcc and libc, and aborts if they are missing, as on a minimal Debian.
    `version` belongs to the OpenCL platform."""
    found = re.search(r"PoCL (\d+)", version, re.IGNORECASE)
    if found is None or int(found.group(1)) > 5 or sys.platform != "linux":
        return
    require(
        shutil.which("ld", path=os.environ.get("PATH", "")) is not None,
        "PoCL, the OpenCL runtime in use, links its kernels with `ld`, which is not in a folder of PATH "
        f"({os.environ.get('PATH')}); add its folder, mostly /usr/bin, or install Debian's package binutils",
    )
    require(
        any(any(Path("/usr").glob(f"{place}/gcc/*/*/libgcc.a")) for place in ("lib", "lib64")),
        "PoCL, the OpenCL runtime in use, links its kernels with libgcc, which is not in /usr/lib/gcc; install "
        "Debian's packages gcc and libc6-dev",
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
            _log.warning("%s: has an incomplete file, as after a killed process; it is removed", program)
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
