"""Images per second of batches, by size, quality and change of the probe, and the memory that they take.

    python -m benchmarks.batch [--device D] [--images N] [--memory N]

Frame A of benchmarks.frames at the poses of a tilt sweep. "of device" is the time that the device works per time of
the whole, 1 if the host hides behind it. `simulate` and `simulate_batch` alternate, three times each; the best counts.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from benchmarks.frames import FRAMES
from benchmarks.measuring import resident_mb, timed
from SlicerUSSim.Logic import DisplaySettings, SimulationError, UltrasoundSimulator
from SlicerUSSim.Logic.mri import demo_mri
from SlicerUSSim.Logic.opencl.devices import devices_to_measure
from SlicerUSSim.Logic.probe import craniotomy_pose, tilt_sweep

SIZES = {"512 x 659": None, "128 x 160": (128, 160)}
_AGAIN = 3


def rates(simulator: UltrasoundSimulator, images: int) -> list[tuple[str, float, float, float]]:
    """(what, images/s of simulate, images/s of simulate_batch, part of the device's rate) of every combination."""
    probe, own, found = FRAMES["A"], simulator.settings, []
    poses = tilt_sweep(craniotomy_pose(simulator.medium.labels, probe), 30.0, images)
    for quality in ("full", "draft"):
        simulator.settings = replace(own, quality=quality)
        for size, pixels in SIZES.items():
            for change in ("one probe", "new probes"):
                display, before, after, part = DisplaySettings(image_size=pixels), [], [], []
                for again in range(_AGAIN + 1):  # the first warms up
                    probes = [probe] * images
                    if change == "new probes":
                        probes = [replace(probe, focus_mm=30.0 + again + n / images) for n in range(images)]
                    others = [replace(each, aperture_mm=11.9) for each in probes] if change != "one probe" else probes

                    def one_by_one(others=others, display=display) -> None:
                        for each, pose in zip(others, poses, strict=True):
                            simulator.simulate(each, pose, display)

                    def batch(probes=probes, display=display) -> None:
                        simulator.simulate_batch(probes, poses, display=display)

                    before.append(timed(one_by_one))
                    took, worked = with_device(simulator, batch)
                    after.append(took)
                    part.append(worked / took)
                best = 1 + int(np.argmin(after[1:]))
                row = f"{quality}, {size}, {change}", 1e3 * images / min(before[1:]), 1e3 * images / after[best]
                found.append((*row, part[best]))
    simulator.settings = own
    return found


def with_device(simulator: UltrasoundSimulator, function: Callable[[], object]) -> tuple[float, float]:
    """(milliseconds of a call, those in which the device worked)."""
    simulator.device.profiling = True
    try:
        simulator.device.take_profile()
        took = timed(function)
        return took, sum(simulator.device.take_profile().values())
    finally:
        simulator.device.profiling = False


def memory(simulator: UltrasoundSimulator, images: int) -> list[float]:
    """Megabytes of the process after each fifth of a draft batch, into an array that is there before."""
    probe, simulator.settings = FRAMES["A"], replace(simulator.settings, quality="draft")
    poses = tilt_sweep(craniotomy_pose(simulator.medium.labels, probe), 30.0, images)
    out, found = np.zeros((images, 128, 160), np.uint8), []
    for part in np.array_split(np.arange(images), 5):
        first, last = part[0], part[-1] + 1
        simulator.simulate_batch(
            probe, poses[first:last], display=DisplaySettings(image_size=(128, 160)), out={"image": out[first:last]}
        )
        found.append(resident_mb())
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--device", help="number or part of the name of a device; default: all")
    parser.add_argument("--images", type=int, default=40, help="in each batch")
    parser.add_argument("--memory", type=int, default=2000, help="images over which memory is measured; 0: none")
    arguments = parser.parse_args()
    try:
        for info in devices_to_measure(arguments.device):
            simulator = UltrasoundSimulator.from_mri(demo_mri()[0], device=info)
            print(f"{info}, load {os.getloadavg()[0]:.1f}")
            print(f"  {'':32s}{'simulate':>10s}{'batch':>10s}{'of device':>11s}")
            for what, before, after, part in rates(simulator, arguments.images):
                print(f"  {what:32s}{before:8.1f}/s{after:8.1f}/s{part:11.2f}")
            if arguments.memory:
                sizes = " ".join(f"{size:.0f}" for size in memory(simulator, arguments.memory))
                print(f"  MB after each fifth of {arguments.memory} drafts: {sizes}")
    except SimulationError as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
