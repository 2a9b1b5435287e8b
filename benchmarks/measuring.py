"""What the benchmarks share: files as argparse types, times, and the throughput of a device as a lower bound."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.files import require_place
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.imaging.stage import Work
from SlicerUSSim.Logic.opencl.device import Device
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid

_CHAINS = 16  # kernels/machine.cl
_MOVED_BYTES = 128 * 2**20  # in each direction: more than the size of caches


def output_file(text: str) -> Path:
    """A file name to which the results can be written."""
    path = Path(text)
    try:
        require_place(path)
    except SimulationError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return path


def result_file(text: str) -> dict:
    """The content of a file of `python -m benchmarks.frames --json`."""
    try:
        result = json.loads(Path(text).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise argparse.ArgumentTypeError(f"{text}: cannot be read ({error})") from None
    if not isinstance(result, dict) or "devices" not in result:
        raise argparse.ArgumentTypeError(
            f"{text}: has no devices, expected a file of python -m benchmarks.frames --json"
        )
    return result


def summary(milliseconds: Iterable[float]) -> dict[str, float]:
    """{"best_ms", "median_ms"} of some times."""
    times = sorted(milliseconds)
    return {"best_ms": round(times[0], 4), "median_ms": round(times[len(times) // 2], 4)}


def timed(function: Callable[[], object]) -> float:
    """Milliseconds of one call."""
    start = perf_counter()
    function()
    return (perf_counter() - start) * 1e3


def measured(function: Callable[[], object], repeat: int) -> dict[str, float]:
    """Best and median milliseconds of `repeat` calls, after a warm-up call."""
    function()
    return summary(timed(function) for _ in range(repeat))


@dataclass(frozen=True)
class Machine:
    """Largest measured throughput of a device per second."""

    bytes_per_s: float
    operations_per_s: float

    @classmethod
    def measure(cls, device: Device, repeat: int = 7) -> Machine:
        """Copies memory and computes chains of multiply-adds; the best of `repeat` runs is used."""
        kernels = device.kernels("machine.cl", device.lanes)
        nbytes = min(_MOVED_BYTES, device.info.handle.max_mem_alloc_size // 2)
        floats = nbytes // 4 // device.lanes * device.lanes
        source, target = device.upload(np.zeros(floats, np.float32)), device.empty(4 * floats)

        def move() -> None:
            device.run(kernels["move_memory"], (floats // device.lanes,), source, target)
            device.queue.finish()

        # Enough work-items for every lane of a GPU, or every core of a processor.
        items, rounds = (2**19, 512) if device.lanes == 1 else (256, 50_000)

        def multiply() -> None:
            device.run(kernels["multiply_add"], (items,), target, np.float32(0.999), np.float32(1e-3), np.int32(rounds))
            device.queue.finish()

        seconds = [1e-3 * measured(work, repeat)["best_ms"] for work in (move, multiply)]
        return cls(8.0 * floats / seconds[0], 2.0 * _CHAINS * device.lanes * items * rounds / seconds[1])

    def floor_ms(self, work: Work) -> float:
        """Lower bound for the time of this work in any implementation, milliseconds."""
        return 1e3 * max(work.bytes / self.bytes_per_s, work.operations / self.operations_per_s)


def frame_work(simulator: UltrasoundSimulator, probe: Probe, pose: np.ndarray, grid: ImageGrid) -> dict[str, Work]:
    """{stage: Work} of one frame, with the names of Frame.timings_ms."""
    frame, tree = simulator.device_frame(probe, pose, grid=grid), simulator.trace(probe, pose)
    return {stage.name: stage.work(frame, tree) for stage in simulator.stages}
