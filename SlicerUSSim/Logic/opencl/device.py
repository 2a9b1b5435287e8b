"""Device: an opened OpenCL device with the programs built for it; Workspace: buffers on it."""

from __future__ import annotations

import logging
import os
import re
import warnings
from collections import deque
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from threading import RLock
from time import perf_counter
from typing import TYPE_CHECKING, TypeAlias, cast

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.opencl.devices import DeviceInfo, choose_device
from SlicerUSSim.Logic.opencl.layout import CONSTANTS, shared_source
from SlicerUSSim.Logic.opencl.limits import lack_of_address_space, lack_of_disk, lack_of_programs_disk
from SlicerUSSim.Logic.opencl.runtimes import load_pyopencl

if TYPE_CHECKING:
    from pyopencl import Buffer, Event, Kernel, Program

_log = logging.getLogger(__name__)

#: Choice of a device; see devices.choose_device
DeviceChoice: TypeAlias = "str | DeviceInfo | Device | None"

_ZERO = np.zeros(1, np.float32)
#: How often a program is built whose cached file is damaged
_ATTEMPTS = 4


class Device:
    """An opened OpenCL device: its context, its in-order queue and its built programs.

    Use `Device.get(choice)`, which creates one per device and process, so that programs are built once.
    With `profiling = True` the events of all kernels are kept until `take_profile()`. Threads may share it; a process
    that is forked from one that has a Device cannot use it.
    """

    def __init__(self, info: DeviceInfo) -> None:
        cl = load_pyopencl()
        from pyopencl.tools import ImmediateAllocator, MemoryPool

        self.cl = cl
        self.info = info
        self._is_pocl = "Portable Computing Language" in info.platform
        lack = lack_of_address_space(info.platform)
        if lack is not None:  # Intel's runtime would end the process
            raise SimulationError(f"OpenCL device {info} cannot be opened: {lack}")
        if self._is_pocl:
            from SlicerUSSim.Logic.opencl.pocl import (
                cache_folder,
                keep_signals,
                name_processor,
                remove_damaged_kernels,
                require_linker,
            )

            full = lack_of_programs_disk(cache_folder())
            if full is not None:
                raise SimulationError(
                    f"OpenCL device {info} cannot be opened: {full}; free some of it, or set XDG_CACHE_HOME"
                )
            require_linker(info.handle.platform.version)
            name_processor(info.handle)
            remove_damaged_kernels()
        try:
            self.context = cl.Context([info.handle])
            self.queue = cl.CommandQueue(self.context, properties=cl.command_queue_properties.PROFILING_ENABLE)
            self._pool = MemoryPool(ImmediateAllocator(self.queue))
            if self._is_pocl:
                keep_signals(cl, self.context)
        except cl.Error as error:
            raise SimulationError(f"OpenCL device {info} cannot be opened: {error}") from None
        self.lanes = _vector_lanes(info)
        #: Samples of a line for which one work-item computes scatterers: many on a processor, so that few cells are
        #: processed twice; few on a GPU, so that one frame occupies it. A divisor of CONSTANTS["BLOCK"]
        self.chunk = 16 if info.kind == "GPU" else CONSTANTS["BLOCK"]
        self.profiling = False
        self._events: list[tuple[str, Event]] = []
        self._writes: deque[Event] = deque(maxlen=64)
        self._kernels: dict[tuple, dict[str, Kernel]] = {}
        # A kernel keeps its arguments until it is enqueued, and all simulators of a device share it
        self._lock = RLock()

    @staticmethod
    def get(device: DeviceChoice = None) -> Device:
        """The Device for a choice (see choose_device); the same object for the same hardware."""
        _require_not_forked()
        if isinstance(device, Device):
            return device
        info, reason = choose_device(device)
        if info not in _opened:
            _log.info("OpenCL device: %s; %s", info, reason)
            opened = _opened[info] = Device(info)
            if not opened.rounds_divisions:
                _log.warning(
                    "%s does not round divisions as IEEE 754 requires: its images may differ from other devices: "
                    "by a grey level, and by more where a ray grazes a voxel",
                    info,
                )
        return _opened[info]

    @property
    def rounds_divisions(self) -> bool:
        """Whether divisions and square roots can be rounded as in IEEE 754, as the kernels are on all devices."""
        return bool(self.info.handle.single_fp_config & self.cl.device_fp_config.CORRECTLY_ROUNDED_DIVIDE_SQRT)

    def kernels(self, file_name: str, lanes: int = 1, *defines: str) -> dict[str, Kernel]:
        """The kernels of kernels/`file_name`, built once; each work-item computes a vector of `lanes` values.

        `defines` are preprocessor names that select a variant. Raises SimulationError if the build fails.
        """
        with self._lock:
            return self._built((file_name, lanes, *defines))

    def _built(self, key: tuple) -> dict[str, Kernel]:
        file_name, lanes, *defines = key
        if key in self._kernels:
            _log.debug("%s (%s): built before in this process", file_name, ", ".join(map(str, key[1:])))
        else:
            started = perf_counter()
            source = shared_source() + "\n" + _with_includes(kernel_folder(), file_name)
            options = ["-cl-std=CL1.2", "-cl-no-signed-zeros", f"-DLANES={lanes}"]
            if self.rounds_divisions:
                options.append("-cl-fp32-correctly-rounded-divide-sqrt")
            options += [f"-D{name}" for name in defines]
            if self.lanes > 1 and "Intel" in self.info.platform:
                options.append("-DNO_IMPLICIT_VECTORS")
            program, kernels = self._build(file_name, source, options)
            _log.debug(
                "%s: %s in %.0f ms with %s", file_name,
                "taken from pyopencl's cache" if _was_cached(program) else "built",
                (perf_counter() - started) * 1e3, " ".join(options),
            )  # fmt: skip
            self._kernels[key] = kernels
        return self._kernels[key]

    def _build(self, file_name: str, source: str, options: list[str]) -> tuple[Program, dict[str, Kernel]]:
        """The program of a source, and its kernels, once more under another name where what is cached is damaged."""
        why = ""
        for attempt in range(_ATTEMPTS):
            again = [f"-DBUILT_AGAIN={attempt}"] if attempt else []  # another entry of every cache
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", self.cl.CompilerWarning)  # runtimes emit them for successful builds
                    program = self.cl.Program(self.context, source).build(options=[*options, *again])
                kernels = {kernel.function_name: kernel for kernel in program.all_kernels()}
            except self.cl.Error as error:
                what = "try another device (`ussim devices` lists them)"
                errors = [line.strip() for line in str(error).splitlines() if "error:" in line]
                full = None if errors else lack_of_disk(self._cache_folders())
                if full is not None:
                    why, what = full, "free some of it, or set XDG_CACHE_HOME and TMPDIR"
                else:
                    why = errors[0] if errors else " ".join(str(error).split())
                raise SimulationError(f"OpenCL device {self.info} cannot build {file_name} ({why}); {what}") from error
            except Exception as error:  # pyopencl raises whatever pickle does
                why = f"{type(error).__name__}: {error}"
            else:
                # For a damaged file the runtime returns a program without them, without an error
                missing = set(re.findall(r"^(?:__)?kernel\s+void\s+(\w+)", source, re.MULTILINE)) - kernels.keys()
                if not missing:
                    return program, kernels
                why = f"it lacks {', '.join(sorted(missing))}"
            _log.warning("the cached program of %s is damaged (%s): it is built again", file_name, why)
        raise SimulationError(
            f"OpenCL device {self.info} cannot build {file_name} ({why}); its cache of programs may be damaged: delete "
            "~/.cache/pocl and ~/.cache/pyopencl"
        )

    def run(
        self, kernel: Kernel, global_size: tuple[int, ...], *arguments, heavy: bool = False, few: bool = False,
        group: tuple[int, ...] | None = None,
    ) -> None:  # fmt: skip
        """Enqueue a kernel; its event is kept if `profiling` is on.

        `heavy` is for work-items with large private arrays: on a processor each is then a separate group, since PoCL
        keeps the arrays of a group on the stack of one thread, and a stack overflow would end the process. `few` is
        for long work-items of which there are at most some thousand: PoCL puts hundreds of them into one group, which
        one core computes while the others wait, so that each is a separate group there. `group` is PoCL's group where
        it is not to follow from the global size, which it divides.
        """
        if self.info.kind != "GPU" and (heavy or (few and self._is_pocl)):
            local_size = (1,) * len(global_size)
        else:
            local_size = (group or pocl_group(global_size)) if self._is_pocl else None
        _require_not_forked()
        with self._lock:
            event = kernel(self.queue, global_size, local_size, *arguments)
            if self.profiling:
                self._events.append((kernel.function_name, event))

    def upload(self, array: np.ndarray) -> Buffer:
        """A new read-only device buffer holding a copy of `array`."""
        flags = self.cl.mem_flags
        _require_not_forked()
        array = np.ascontiguousarray(array)
        flags = flags.READ_ONLY | flags.COPY_HOST_PTR
        return self._allocated(array.nbytes, lambda: self.cl.Buffer(self.context, flags, hostbuf=array))

    def empty(self, nbytes: int) -> Buffer:
        """A new uninitialised device buffer."""
        flags, size = self.cl.mem_flags.READ_WRITE, max(int(nbytes), 4)
        return self._allocated(int(nbytes), lambda: self.cl.Buffer(self.context, flags, size=size))

    def pooled(self, nbytes: int) -> Buffer:
        """An uninitialised buffer of at least `nbytes`, whose memory is used again when nothing refers to it."""
        return self._allocated(nbytes, lambda: cast("Buffer", self._pool.allocate(nbytes)))

    def zeros(self, nbytes: int) -> Buffer:
        """A new device buffer of zeros; `nbytes` is a multiple of four."""
        buffer = self.empty(nbytes)
        self.clear(buffer)
        return buffer

    def clear(self, buffer: Buffer) -> None:
        """Enqueue filling a buffer, whose size is a multiple of four, with zeros."""
        self.cl.enqueue_fill_buffer(self.queue, buffer, _ZERO, 0, buffer.size)

    def copy(
        self, source: Buffer, target: Buffer, nbytes: int, target_offset: int = 0, *, source_offset: int = 0
    ) -> None:
        """Enqueue copying `nbytes` from `source_offset` (bytes) of a buffer to `target_offset` of another."""
        self.cl.enqueue_copy(
            self.queue, target, source, byte_count=nbytes, src_offset=source_offset, dst_offset=target_offset
        )

    def write(self, buffer: Buffer, array: np.ndarray) -> None:
        """Enqueue copying `array` into a buffer that is at least as large, without waiting for completion."""
        _require_not_forked()
        # An event keeps its array alive, and its destructor waits for the copy.
        event = self.cl.enqueue_copy(self.queue, buffer, array.copy(), is_blocking=False)
        self._writes.append(event)

    def mark(self) -> Event:
        """An event that completes when all commands enqueued so far have completed; use its wait()."""
        marker = self.cl.enqueue_marker(self.queue)
        self.queue.flush()
        return marker

    def download(self, buffer: Buffer, shape: int | tuple[int, ...], dtype) -> np.ndarray:
        """A new host array with the buffer's content; waits for all commands enqueued before."""
        _require_not_forked()
        array = np.empty(shape, dtype)
        if array.nbytes:
            self.queue.finish()  # this thread takes part in Intel's runtime, unlike one that waits for a copy
            self.cl.enqueue_copy(self.queue, array, buffer)
        return array

    def start_download(self, buffer: Buffer, shape: tuple[int, ...], dtype) -> Callable[[], np.ndarray]:
        """Enqueue copying a buffer's content to a host array, which what is returned gives when it is there."""
        _require_not_forked()
        array = np.empty(shape, dtype)
        done = self.cl.enqueue_copy(self.queue, array, buffer, is_blocking=False)

        def wait() -> np.ndarray:
            done.wait()
            return array

        return wait

    def take_profile(self) -> dict[str, float]:
        """Milliseconds per kernel since the last call (requires profiling)."""
        self.queue.finish()
        events, self._events = self._events, []
        total: dict[str, float] = {}
        for name, event in events:
            total[name] = total.get(name, 0.0) + (event.profile.end - event.profile.start) * 1e-6
        return total

    @staticmethod
    def _cache_folders() -> list[Path]:
        """Where runtimes and pyopencl keep programs."""
        import platformdirs

        from SlicerUSSim.Logic.opencl.pocl import cache_folder

        return [cache_folder(), Path(platformdirs.user_cache_dir("pyopencl", "pyopencl"))]

    def _allocated(self, nbytes: int, make: Callable[[], Buffer]) -> Buffer:
        """A new device buffer. Raises SimulationError with its size if the device has no room for it."""
        self._check_size(nbytes)
        try:
            return make()
        except (MemoryError, self.cl.MemoryError) as error:
            raise SimulationError(
                f"{self.info.name} has no memory for a buffer of {nbytes / 2**20:.0f} MB; close other programs, use a "
                "smaller or coarser volume, or another device"
            ) from error

    def _check_size(self, nbytes: int) -> None:
        limit = self.info.handle.max_mem_alloc_size
        if nbytes > limit:
            raise SimulationError(
                f"buffer size is {nbytes / 2**20:.0f} MB, expected at most {limit / 2**20:.0f} on {self.info.name}; "
                "use a smaller or coarser volume, or another device"
            )


#: One per device and process
_opened: dict[DeviceInfo, Device] = {}
_is_forked = False


def _after_fork() -> None:
    global _is_forked
    _is_forked = bool(_opened)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def _require_not_forked() -> None:
    """Raise SimulationError in a fork of a process with a Device: it would hang without the runtime's threads."""
    if _is_forked:
        raise SimulationError(
            "this process is a fork of one that uses OpenCL, whose threads it lacks; start processes anew, for example "
            'by multiprocessing.get_context("spawn"), or fork before the first simulation'
        )


def divisible(count: int, by: int = 1024) -> int:
    """The next larger global size that a runtime can divide into groups: of a prime number of work-items, it makes one
    group, which one core computes, or a group of each."""
    return -(-count // by) * by


def pocl_group(global_size: tuple[int, ...]) -> tuple[int, ...]:
    """The work-items of a group with PoCL: 64, 8 or 1 along the first axis.

    PoCL compiles a kernel anew for every size of its groups, for some tenths of a second. Left to itself it takes the
    largest divisors of the global size, so that every label map of another shape had its kernels compiled.
    """
    first = next(size for size in (64, 8, 1) if global_size[0] % size == 0)
    return (first, *(1 for _ in global_size[1:]))


def _was_cached(program: Program) -> bool:
    """Whether pyopencl had the binary on disk. PoCL has a separate cache, which only the time shows."""
    # pyopencl's own, for its messages: (what, whether it was cached, seconds)
    info = getattr(program, "_build_duration_info", None)
    return bool(info and info[1])


def _vector_lanes(info: DeviceInfo) -> int:
    """Number of values that one work-item computes as a vector.

    Processor runtimes vectorise the branching scatter kernel poorly or not at all, so it is vectorised by hand there
    (measured: 2.7 times faster with Intel's runtime, 3 times with PoCL). A GPU runs one value per work-item.
    """
    if info.kind == "GPU":
        return 1
    return 16 if info.handle.native_vector_width_float >= 16 else 8


def _with_includes(folder: Path, file_name: str) -> str:
    """The text of a kernel file with its #include lines replaced by the included files.

    The compiler's include path is not used, since runtimes treat paths with spaces differently.
    """

    def included(line: re.Match) -> str:
        return _with_includes(folder, line.group(1))

    return re.sub(r'^#include "([^"]+)"$', included, (folder / file_name).read_text(), flags=re.MULTILINE)


@lru_cache(maxsize=1)
def kernel_folder() -> Path:
    """The folder of the .cl files: inside an installed package, or next to it in a checkout or Slicer module."""
    package = Path(__file__).resolve().parents[2]
    for folder in (package / "kernels", package.parent / "kernels"):
        if (folder / "common.clh").exists():
            return folder
    raise SimulationError(f"the OpenCL kernels are missing next to {package}; reinstall SlicerUSSim")


class Workspace:
    """Named buffers of one stage, kept between frames and replaced only by larger ones."""

    def __init__(self, device: Device) -> None:
        self._device = device
        self._buffers: dict[str, Buffer] = {}

    def get(self, name: str, nbytes: int) -> Buffer:
        """A buffer of at least `nbytes`, with the content of its last use."""
        if name not in self._buffers or self._buffers[name].size < nbytes:
            self._buffers[name] = self._device.empty(nbytes)
        return self._buffers[name]
