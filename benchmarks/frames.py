"""Time per stage and per frame on every OpenCL device.

    python -m benchmarks.frames [--json FILE] [--repeat N] [--brief] [--device D]

Frame A: phased array, 196 scan lines, 73 mm deep, 5 MHz. Frame B: convex array, 192 scan lines, 120 mm deep. Both on
the MNI152 labels from the demo's view, ray tree to depth 6, from pose to scan-converted image on the host.
"""

from __future__ import annotations

import argparse
import platform
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from benchmarks.measuring import measured, output_file, summary
from SlicerUSSim.Logic.base.errors import SimulationError, require_between
from SlicerUSSim.Logic.base.files import write_json
from SlicerUSSim.Logic.base.settings import DisplaySettings
from SlicerUSSim.Logic.base.version import __version__
from SlicerUSSim.Logic.fitting.appearance import AppearanceModel
from SlicerUSSim.Logic.fitting.image_similarity import SimilaritySettings
from SlicerUSSim.Logic.fitting.optimization import AppearanceCost
from SlicerUSSim.Logic.fitting.parameters import FreeParameters
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.mri.samples import demo_mri
from SlicerUSSim.Logic.mri.segmentation import Segmentation, segment_mri
from SlicerUSSim.Logic.opencl.device import Device
from SlicerUSSim.Logic.opencl.devices import DeviceInfo, devices_to_measure
from SlicerUSSim.Logic.probe.arrays import ConvexProbe, PhasedProbe
from SlicerUSSim.Logic.probe.poses import craniotomy_pose, tilt_sweep
from SlicerUSSim.Logic.tissue.table import TissueTable

FRAMES = {"A": PhasedProbe(75, 73, scan_lines=196), "B": ConvexProbe(60, 70, 120, scan_lines=192)}
SWEEP_IMAGES, SWEEP_DEG = 128, 50.0
_WHITE = "white matter"
_FREE = {
    "evaluation: display, scatterers": ["display", f"{_WHITE}.mu0", f"{_WHITE}.sigma0"],
    "evaluation: and attenuation": ["display", _WHITE],
}


def run_benchmark(
    devices: Sequence[DeviceInfo], *, repeat: int = 30, brief: bool = False, progress: Callable[[str], None] = print
) -> dict:
    """Measure every device; returns the content of the JSON file.

    `brief` omits frame B, sweep and optimisation. `progress` is called with each device and measurement.
    Raises SimulationError for a `repeat` outside 1 to 10000, and if a device fails.
    """
    require_between("run_benchmark", "repeat", repeat, 1, 10_000)
    mri, source = demo_mri()
    result: dict[str, Any] = {
        "version": __version__,
        "machine": {"system": platform.platform(), "processor": _processor(), "python": platform.python_version()},
        "mri": f"{source}, {'x'.join(map(str, mri.array.shape[::-1]))} voxels",
        "devices": {},
    }
    for info in devices:
        measurement = _DeviceBenchmark(info, mri, repeat, progress)
        result["devices"][f"{info.platform}, {info.name}"] = measurement.run(brief)
    return result


class _DeviceBenchmark:
    """The measurements on one device."""

    def __init__(self, info: DeviceInfo, mri, repeat: int, progress: Callable[[str], None]) -> None:
        self.info, self.mri, self.repeat, self.progress = info, mri, repeat, progress
        self.device = Device.get(info)
        self.images: dict[str, np.ndarray] = {}
        # Intermediate results, for later measurements
        self.segmentation: Segmentation
        self.poses: dict[str, np.ndarray]
        self.simulator: UltrasoundSimulator

    def run(self, brief: bool) -> dict:
        self._tell("segmentation")
        numbers: dict[str, Any] = {"kind": self.info.kind, "frames": {}}
        numbers["segmentation"] = measured(self._segment, min(self.repeat, 5))
        self.poses = {name: craniotomy_pose(self.segmentation.labels, probe) for name, probe in FRAMES.items()}
        names = self.segmentation.tissue_names
        self.simulator = UltrasoundSimulator(self.segmentation.labels, TissueTable.brain(names), device=self.device)
        for name in ["A"] if brief else FRAMES:
            self._tell(f"frame {name}")
            numbers["frames"][name] = self._frame(name)
        if not brief:
            self._tell(f"sweep of {SWEEP_IMAGES} images")
            numbers[f"volume of {SWEEP_IMAGES} images"] = measured(self._sweep, 1)
            self._tell("optimisation")
            numbers |= self._evaluations()
        return numbers

    def _tell(self, what: str) -> None:
        self.progress(f"{self.info.index} {what}")

    def _segment(self) -> None:
        self.segmentation = segment_mri(self.mri, device=self.device, thin_sulci=False)

    def _frame(self, name: str) -> dict:
        probe, pose, simulator = FRAMES[name], self.poses[name], self.simulator

        def whole() -> None:
            simulator.forget_echoes()
            self.images[name] = simulator.simulate(probe, pose).image

        gains = iter(np.linspace(-3.0, 3.0, self.repeat + 1))
        numbers: dict[str, dict] = {
            "whole": measured(whole, self.repeat),
            "display changed": measured(
                lambda: simulator.simulate(probe, pose, DisplaySettings(gain_db=float(next(gains)))), self.repeat
            ),
        }
        simulator.profiling = True
        try:
            frames = [simulator.simulate(probe, pose) for _ in range(self.repeat + 1)][1:]
        finally:
            simulator.profiling = False
        numbers["stages"] = {
            stage: summary(frame.timings_ms[stage] for frame in frames) for stage in frames[0].timings_ms
        }
        return numbers

    def _sweep(self) -> None:
        self.simulator.volume(FRAMES["A"], tilt_sweep(self.poses["A"], SWEEP_DEG, SWEEP_IMAGES))

    def _evaluations(self) -> dict:
        """One evaluation of the cost of frame A against itself, for several sets of free parameters."""
        display, tissues = DisplaySettings(), self.simulator.medium.tissues
        numbers = {}
        for name, free in _FREE.items():
            parameters = FreeParameters.of(free, tissues, display)
            model = AppearanceModel(self.simulator, FRAMES["A"], [self.poses["A"]], parameters.varied())
            images, settings = [self.images["A"]], SimilaritySettings()
            cost = AppearanceCost(model, parameters, images, None, tissues, display, settings)
            numbers[name] = measured(_at_random(cost, len(parameters)), self.repeat)
        return numbers


def _at_random(cost: AppearanceCost, parameters: int) -> Callable[[], object]:
    random = np.random.default_rng(0)
    return lambda: cost(random.random(parameters))


def _processor() -> str:
    try:
        with open("/proc/cpuinfo") as lines:
            return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def table_of(result: dict) -> str:
    """The whole result of run_benchmark, a table per device."""
    return "\n".join(_lines(result))


def _lines(result: dict) -> Iterator[str]:
    yield f"SlicerUSSim {result.get('version', '')} on {result['machine']['processor']}, {result['mri']}"
    for name, numbers in result["devices"].items():
        yield ""
        yield name
        yield f"  {'':36s}{'best':>10s}{'median':>11s}"
        for label, row in rows_of(numbers):
            yield f"  {label:36s}{row['best_ms']:7.2f} ms{row['median_ms']:8.2f} ms"


def rows_of(numbers: dict) -> Iterator[tuple[str, dict]]:
    """(label, times) of everything measured on one device; stages are indented."""
    for frame, times in numbers["frames"].items():
        yield f"frame {frame}", times["whole"]
        for stage, row in times["stages"].items():
            yield f"  {stage}", row
        yield f"frame {frame}, only the display changed", times["display changed"]
    for label, row in numbers.items():
        if isinstance(row, dict) and "best_ms" in row:
            yield label, row


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--json", type=output_file, metavar="FILE", help="write the results to this file as well")
    parser.add_argument("--repeat", type=int, default=30, help="calls per measurement: best and median are reported")
    parser.add_argument("--brief", action="store_true", help="only frame A and the segmentation, with few calls")
    parser.add_argument("--device", help="number or part of the name of a device; default: all")
    arguments = parser.parse_args()
    repeat = min(arguments.repeat, 5) if arguments.brief else arguments.repeat
    try:
        result = run_benchmark(devices_to_measure(arguments.device), repeat=repeat, brief=arguments.brief)
    except SimulationError as error:
        parser.error(str(error))
    print(table_of(result))
    if arguments.json:
        write_json(arguments.json, result)


if __name__ == "__main__":
    main()
