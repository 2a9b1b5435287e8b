"""List of OpenCL devices, and the choice of one.

Order of preference: a GPU, Intel's processor runtime, PoCL, others. An explicit choice overrides it: the `device`
argument, then PYOPENCL_CTX (pyopencl's "platform:device" notation), then USSIM_DEVICE (that notation, or part of a
device or platform name).
"""

from __future__ import annotations

import logging
import os
import platform
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.opencl.limits import lack_of_address_space, lack_of_cache
from SlicerUSSim.Logic.opencl.pocl import cache_folder
from SlicerUSSim.Logic.opencl.runtimes import INTEL_RUNTIME, load_pyopencl, pocl_of_pip

if TYPE_CHECKING:
    import pyopencl

_log = logging.getLogger(__name__)

_EMULATOR_RANK = 9


@dataclass(frozen=True)
class Runtime:
    """A runtime for processors that pip installs: its name, packages, and megabytes on the disk."""

    name: str
    packages: tuple[str, ...]
    megabytes: int


_POCL = Runtime("PoCL", ("pocl-binary-distribution",), 140)
#: {sys.platform: runtimes, the fastest first}; there are wheels for x86-64 only.
_RUNTIMES = {
    "linux": (Runtime("Intel's runtime", (INTEL_RUNTIME, "intel-cmplr-lib-rt"), 1000), _POCL),
    "win32": (Runtime("Intel's runtime", (INTEL_RUNTIME,), 120),),
}


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
    handle: pyopencl.Device = field(repr=False, compare=False)

    @property
    def is_emulator(self) -> bool:
        """Whether it emulates other hardware, for developers."""
        return self.rank == _EMULATOR_RANK

    def __str__(self) -> str:
        return f"{self.index}  {self.name} ({self.kind}, {self.platform}, {self.compute_units} compute units)"


def list_devices() -> list[DeviceInfo]:
    """Every usable OpenCL device, best first. Empty when there is none.

    Raises SimulationError if pyopencl itself is missing.
    """
    cl = load_pyopencl()
    try:
        platforms = cl.get_platforms()
    except cl.LogicError:  # raised by the loader if there is no platform
        return []
    devices = []
    for platform_index, cl_platform in enumerate(platforms):
        try:
            handles = cl_platform.get_devices()
        except cl.Error:
            continue  # a driver without hardware
        for device_index, handle in enumerate(handles):
            device = _describe(cl, f"{platform_index}:{device_index}", cl_platform, handle)
            # A runtime that is registered twice (by its wheel and in a vendors folder) is listed once.
            names = {(known.platform, known.name) for known in devices if known.kind == "CPU"}
            if (device.platform, device.name) not in names:
                devices.append(device)
    return sorted(devices, key=lambda device: device.rank)


def _describe(cl, index: str, cl_platform: pyopencl.Platform, handle: pyopencl.Device) -> DeviceInfo:
    is_gpu = bool(handle.type & cl.device_type.GPU)
    is_cpu = bool(handle.type & cl.device_type.CPU)
    platform_name = cl_platform.name.strip()
    if "FPGA" in platform_name or "FPGA" in handle.name:
        rank = _EMULATOR_RANK  # Intel's FPGA emulator, for FPGA developers
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
    """The device to use, and the reason as a short phrase.

    Parameters
    ----------
    device : "0:1" (platform:device), part of a name, a DeviceInfo, or None for PYOPENCL_CTX, then USSIM_DEVICE, then
        the best available device.

    Raises SimulationError if there is no device or none matches the choice.
    """
    if isinstance(device, DeviceInfo):
        return device, "chosen by argument"
    devices = list_devices()
    _log.debug("OpenCL devices: %s", "; ".join(map(str, devices)) or "none")
    if not devices:
        why = lack_of_address_space() or (lack_of_cache(cache_folder()) if _has_pocl() else None)
        raise SimulationError(f"no OpenCL device found; {why or how_to_get_one()}")
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
    """The device chosen by `device`, or without a choice all devices except emulators, best first.

    Raises SimulationError as choose_device does.
    """
    chosen = [choose_device(device)[0]]
    return chosen if device else [info for info in list_devices() if not info.is_emulator] or chosen


def runtimes() -> tuple[Runtime, ...]:
    """The runtimes for processors that pip can install on this computer, the fastest first."""
    return _RUNTIMES.get(sys.platform, ()) if platform.machine().lower() in ("x86_64", "amd64") else ()


def faster_hint(device: DeviceInfo) -> str | None:
    """The pip command that would install a faster device than `device` on this computer, or None."""
    is_slow = device.kind == "CPU" and "Intel" not in device.platform
    return f"pip install {' '.join(runtimes()[0].packages)}" if is_slow and runtimes() else None


def how_to_get_one() -> str:
    """How to get an OpenCL device on this computer; names only packages that there are for it."""
    if sys.platform == "darwin":
        return "macOS computes on its graphics processor only, and this Mac offers none to this program"
    if sys.platform == "linux" and not runtimes():
        return "install the system's OpenCL runtime, which Debian and Ubuntu have in the package pocl-opencl-icd"
    known = " or ".join(f"{runtime.name} ({', '.join(runtime.packages)})" for runtime in runtimes())
    return f"install the driver of a graphics card, or with pip for the processor {known}"


def _has_pocl() -> bool:
    """Whether PoCL is installed, by pip or in the system."""
    return pocl_of_pip() is not None or any(Path("/etc/OpenCL/vendors").glob("pocl*.icd"))
