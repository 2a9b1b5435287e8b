"""Which OpenCL device computes, and the programs built for it.

Order of preference: a GPU, Intel's processor runtime, PoCL, anything else. An explicit choice overrides it: the
`device` argument, then PYOPENCL_CTX (pyopencl's own "platform:device" notation), then USSIM_DEVICE (either that
notation or part of a device or platform name).
"""

from __future__ import annotations

import importlib.metadata
import os
import re
import sys
import warnings
import zlib
from collections import deque
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.errors import SimulationError
from SlicerUSSim.Logic.layout import CONSTANTS, shared_source

_EMULATOR_RANK = 9
INTEL_HINT = 'pip install "SlicerUSSim[intel]"'


@dataclass(frozen=True)
class DeviceInfo:
    """One OpenCL device: `index` in "platform:device" notation, names, and its rank (smaller is preferred)."""

    index: str
    name: str
    platform: str
    kind: str  # "GPU", "CPU" or "other"
    compute_units: int
    memory_mb: int
    rank: int
    handle: object = field(repr=False, compare=False)

    @property
    def is_emulator(self) -> bool:
        """Whether it emulates other hardware, for that hardware's developers."""
        return self.rank == _EMULATOR_RANK

    def __str__(self) -> str:
        return f"{self.index}  {self.name} ({self.kind}, {self.platform}, {self.compute_units} compute units)"


@lru_cache(maxsize=1)
def _pyopencl():
    """Import pyopencl with every installed runtime visible to its ICD loader, or say what to install."""
    if "pyopencl" not in sys.modules and sys.platform == "linux" and "OCL_ICD_VENDORS" not in os.environ:
        _register_pip_runtimes()
    try:
        import pyopencl
    except ImportError as error:
        raise SimulationError(f"pyopencl cannot be imported ({error}); install it with: pip install pyopencl") from None
    return pyopencl


def _register_pip_runtimes() -> None:
    """Point the ICD loader at a folder that names every runtime by absolute path.

    Intel's wheel ships an .icd file with a placeholder path, and OCL_ICD_VENDORS *replaces* the loader's own folders,
    so a folder of our own has to list Intel's library, PoCL's wheel and whatever the system has installed.
    """
    libraries = {}
    for name, distribution, pattern in (
        ("intel", "intel-opencl-rt", "libintelocl.so"),
        ("pocl", "pocl-binary-distribution", "libpocl-"),
    ):
        library = _library_of(distribution, pattern)
        if library is not None:
            libraries[f"ussim-{name}.icd"] = str(library)
    if "ussim-intel.icd" not in libraries:
        return  # without Intel's wheel the loader finds everything by itself
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
    except OSError:
        return  # a read-only home: the loader's own folders still work
    os.environ["OCL_ICD_VENDORS"] = str(folder)


def _library_of(distribution: str, pattern: str) -> Path | None:
    try:
        files = importlib.metadata.files(distribution) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    for file in files:
        if file.name.startswith(pattern) and ".so" in file.name and not file.name.endswith((".py", ".pyc")):
            path = Path(str(file.locate())).resolve()
            if path.exists():
                return path
    return None


def list_devices() -> list[DeviceInfo]:
    """Every usable OpenCL device, best first. Empty when there is none.

    Raises SimulationError if pyopencl itself is missing.
    """
    cl = _pyopencl()
    try:
        platforms = cl.get_platforms()
    except cl.LogicError:  # the loader's way of saying "no platform at all"
        return []
    devices = []
    for platform_index, cl_platform in enumerate(platforms):
        try:
            handles = cl_platform.get_devices()
        except cl.Error:
            continue  # a driver without hardware
        for device_index, handle in enumerate(handles):
            device = _describe(cl, f"{platform_index}:{device_index}", cl_platform, handle)
            # A runtime registered twice (its wheel and a vendors folder) would be listed twice.
            names = {(known.platform, known.name) for known in devices if known.kind == "CPU"}
            if (device.platform, device.name) not in names:
                devices.append(device)
    return sorted(devices, key=lambda device: device.rank)


def _describe(cl, index, cl_platform, handle) -> DeviceInfo:
    is_gpu = bool(handle.type & cl.device_type.GPU)
    is_cpu = bool(handle.type & cl.device_type.CPU)
    platform_name = cl_platform.name.strip()
    if "FPGA" in platform_name or "FPGA" in handle.name:
        rank = _EMULATOR_RANK  # Intel's FPGA emulator also lists itself; it is for FPGA developers
    elif is_gpu:
        rank = 0
    elif is_cpu and "Intel" in platform_name:
        rank = 1
    elif is_cpu and "Portable Computing Language" in platform_name:
        rank = 2
    else:
        rank = 3
    return DeviceInfo(
        index=index,
        name=handle.name.strip(),
        platform=platform_name,
        kind="GPU" if is_gpu else "CPU" if is_cpu else "other",
        compute_units=handle.max_compute_units,
        memory_mb=handle.global_mem_size // 2**20,
        rank=rank,
        handle=handle,
    )


def choose_device(device: str | DeviceInfo | None = None) -> tuple[DeviceInfo, str]:
    """The device to use and the reason, one short phrase.

    Parameters
    ----------
    device : "0:1" (platform:device), part of a name, a DeviceInfo, or None for PYOPENCL_CTX, then USSIM_DEVICE, then
        the best there is.

    Raises SimulationError if there is no device or none fits the choice.
    """
    if isinstance(device, DeviceInfo):
        return device, "chosen by argument"
    devices = list_devices()
    if not devices:
        raise SimulationError(
            "no OpenCL device found; on Linux run: pip install pocl-binary-distribution (or, faster: "
            f"{INTEL_HINT}); on Windows and macOS install the graphics driver"
        )
    for choice, source in (
        (device, "argument"),
        (os.environ.get("PYOPENCL_CTX"), "PYOPENCL_CTX"),
        (os.environ.get("USSIM_DEVICE"), "USSIM_DEVICE"),
    ):
        if choice:
            return _find(devices, str(choice), source), f"chosen by {source}"
    return devices[0], {0: "a GPU", 1: "the fastest processor runtime"}.get(devices[0].rank, "the only kind found")


def _find(devices: list[DeviceInfo], choice: str, source: str) -> DeviceInfo:
    text = choice.strip().lower()
    text = {"pocl": "portable computing language"}.get(text, text)
    exact = text if ":" in text else f"{text}:0"
    for device in devices:
        if device.index == exact or (not text.isdigit() and text in f"{device.name} {device.platform}".lower()):
            return device
    known = "; ".join(f"{device.index} {device.platform}" for device in devices)
    raise SimulationError(f"{source}: no OpenCL device fits {choice!r}, expected one of: {known}")


def devices_to_measure(device: str | None = None) -> list[DeviceInfo]:
    """The device chosen by `device`, or without a choice all that are no emulators, best first.

    Raises SimulationError as choose_device does.
    """
    chosen = [choose_device(device)[0]]
    return chosen if device else [info for info in list_devices() if not info.is_emulator] or chosen


def faster_hint(device: DeviceInfo) -> str | None:
    """The one pip line that would give a faster device than `device` on this computer, or None."""
    if device.kind == "CPU" and "Intel" not in device.platform and sys.platform == "linux":
        return INTEL_HINT
    return None


class Device:
    """An OpenCL device ready to compute: its context, its in-order queue and its built programs.

    Use `Device.get(choice)`, which makes one per device and process, so that programs are built once.
    With `profiling = True` every kernel's event is kept until `take_profile()`.
    """

    def __init__(self, info: DeviceInfo) -> None:
        cl = _pyopencl()
        self.cl = cl
        self.info = info
        if "Portable Computing Language" in info.platform:
            from SlicerUSSim.Logic.pocl import name_unknown_processor, require_linker

            require_linker(info.handle.platform.version)
            name_unknown_processor(info.handle)
        try:
            self.context = cl.Context([info.handle])
            self.queue = cl.CommandQueue(self.context, properties=cl.command_queue_properties.PROFILING_ENABLE)
        except cl.Error as error:
            raise SimulationError(f"OpenCL device {info} cannot be opened: {error}") from None
        self.lanes = _vector_lanes(info)
        #: Samples of a line that one work-item fills with scatterers: long for a few cores, so that little is looked at
        #: twice; short for a GPU, which one frame shall fill. A divisor of CONSTANTS["BLOCK"]
        self.chunk = 16 if info.kind == "GPU" else CONSTANTS["BLOCK"]
        self.profiling = False
        self._events: list[tuple[str, object]] = []
        self._writes: deque = deque(maxlen=64)
        self._kernels: dict[tuple, dict[str, object]] = {}

    @staticmethod
    def get(device: str | DeviceInfo | Device | None = None) -> Device:
        """The Device for a choice (see choose_device); the same object for the same hardware."""
        if isinstance(device, Device):
            return device
        return _open_device(choose_device(device)[0])

    def kernels(self, file_name: str, lanes: int = 1, *defines: str) -> dict[str, object]:
        """The kernels of kernels/`file_name`, built once; each work-item computes `lanes` values side by side.

        `defines` are preprocessor names that choose a variant.
        """
        key = (file_name, lanes, *defines)
        if key not in self._kernels:
            source = shared_source() + "\n" + _with_includes(kernel_folder(), file_name)
            options = ["-cl-std=CL1.2", "-cl-no-signed-zeros", f"-DLANES={lanes}"]
            if self.info.handle.single_fp_config & self.cl.device_fp_config.CORRECTLY_ROUNDED_DIVIDE_SQRT:
                options.append("-cl-fp32-correctly-rounded-divide-sqrt")
            options += [f"-D{name}" for name in defines]
            if self.lanes > 1 and "Intel" in self.info.platform:
                options.append("-DNO_IMPLICIT_VECTORS")
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", self.cl.CompilerWarning)  # runtimes report success at length
                    program = self.cl.Program(self.context, source).build(options=options)
            except self.cl.Error as error:
                lines = [line.strip() for line in str(error).splitlines() if "error:" in line] or [str(error)]
                raise SimulationError(
                    f"OpenCL device {self.info} cannot build {file_name} ({lines[0]}); try another device "
                    "(`ussim devices` lists them)"
                ) from error
            self._kernels[key] = {kernel.function_name: kernel for kernel in program.all_kernels()}
        return self._kernels[key]

    def run(self, kernel, global_size: tuple[int, ...], *arguments, heavy: bool = False) -> None:
        """Enqueue a kernel; its profiling event is kept if `profiling` is on.

        `heavy` is for work-items with large private arrays: on a processor each is then a group of its own, since PoCL
        keeps the arrays of a whole group on one thread's stack and ends the process when that overflows.
        """
        local_size = (1,) * len(global_size) if heavy and self.info.kind != "GPU" else None
        event = kernel(self.queue, global_size, local_size, *arguments)
        if self.profiling:
            self._events.append((kernel.function_name, event))

    def upload(self, array: np.ndarray):
        """A new read-only device buffer holding a copy of `array`."""
        flags = self.cl.mem_flags
        self._check_size(array.nbytes)
        return self.cl.Buffer(self.context, flags.READ_ONLY | flags.COPY_HOST_PTR, hostbuf=np.ascontiguousarray(array))

    def empty(self, nbytes: int):
        """A new uninitialised device buffer."""
        self._check_size(nbytes)
        return self.cl.Buffer(self.context, self.cl.mem_flags.READ_WRITE, size=max(int(nbytes), 4))

    def zeros(self, nbytes: int):
        """A new device buffer of zeros; `nbytes` is a multiple of four."""
        buffer = self.empty(nbytes)
        self.cl.enqueue_fill_buffer(self.queue, buffer, np.float32(0), 0, buffer.size)
        return buffer

    def write(self, buffer, array: np.ndarray) -> None:
        """Copy `array` into a buffer that is at least as large, in its turn; nothing is waited for."""
        # An event keeps its array alive, and waits for the copy when it is dropped itself.
        event = self.cl.enqueue_copy(self.queue, buffer, array.copy(), is_blocking=False)
        self._writes.append(event)

    def mark(self):
        """An event that completes when everything enqueued so far has; its wait() waits for that."""
        marker = self.cl.enqueue_marker(self.queue)
        self.queue.flush()
        return marker

    def download(self, buffer, shape, dtype) -> np.ndarray:
        """A new host array with the buffer's content; waits for everything enqueued before."""
        array = np.empty(shape, dtype)
        if array.nbytes:
            self.cl.enqueue_copy(self.queue, array, buffer)
        return array

    def take_profile(self) -> dict[str, float]:
        """Milliseconds per kernel since the last call (profiling has to be on)."""
        self.queue.finish()
        events, self._events = self._events, []
        total: dict[str, float] = {}
        for name, event in events:
            total[name] = total.get(name, 0.0) + (event.profile.end - event.profile.start) * 1e-6
        return total

    def _check_size(self, nbytes: int) -> None:
        limit = self.info.handle.max_mem_alloc_size
        if nbytes > limit:
            raise SimulationError(
                f"a buffer of {nbytes / 2**20:.0f} MB is needed but {self.info.name} allows {limit / 2**20:.0f} MB; "
                "use a smaller or coarser volume, or another device"
            )


@cache
def _open_device(info: DeviceInfo) -> Device:
    return Device(info)


def _vector_lanes(info: DeviceInfo) -> int:
    """How many values one work-item computes side by side.

    Processor runtimes vectorise the branching scatter kernel badly or not at all, so it is vectorised by hand there
    (measured: 2.7 times faster with Intel's runtime, 3 times with PoCL). A GPU runs one value per work-item.
    """
    if info.kind == "GPU":
        return 1
    return 16 if info.handle.native_vector_width_float >= 16 else 8


def _with_includes(folder: Path, file_name: str) -> str:
    """The text of a kernel file with the files it includes in place of the #include lines.

    The compiler is not asked to find them: runtimes disagree about include paths that hold spaces.
    """

    def included(line: re.Match) -> str:
        return _with_includes(folder, line.group(1))

    return re.sub(r'^#include "([^"]+)"$', included, (folder / file_name).read_text(), flags=re.MULTILINE)


@lru_cache(maxsize=1)
def kernel_folder() -> Path:
    """The folder of the .cl files: inside an installed package, or beside it in a checkout or Slicer module."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "kernels", package.parent / "kernels"):
        if (folder / "common.clh").exists():
            return folder
    raise SimulationError(f"the OpenCL kernels are missing beside {package}; reinstall SlicerUSSim")


class Workspace:
    """Named buffers of one stage, kept between frames and replaced only by larger ones."""

    def __init__(self, device: Device) -> None:
        self._device = device
        self._buffers: dict[str, object] = {}

    def get(self, name: str, nbytes: int):
        """A buffer of at least `nbytes`; its content is whatever the last frame left."""
        buffer = self._buffers.get(name)
        if buffer is None or buffer.size < nbytes:
            buffer = self._buffers[name] = self._device.empty(nbytes)
        return buffer
