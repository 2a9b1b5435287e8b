"""Memory bandwidth and arithmetic throughput of a device, measured with the kernels of kernels/machine.cl."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from SlicerUSSim.Logic.imaging.stage import Work
from SlicerUSSim.Logic.opencl.device import Device
from SlicerUSSim.Logic.verification.benchmark.timing import measured

_CHAINS = 16  # kernels/machine.cl
_MOVED_BYTES = 128 * 2**20  # in each direction: more than the size of caches


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
