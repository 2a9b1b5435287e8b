"""The measurements on each device: frames A and B with their stages, sweep, segmentation, optimisation, images.

Frame A: phased array, 196 scan lines, 73 mm deep, 5 MHz. Frame B: convex array, 192 scan lines, 120 mm deep. Both on
the MNI152 labels from the demo's view, ray tree to depth 6, from pose to scan-converted image on the host.
"""

from __future__ import annotations

import platform
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import require_between
from SlicerUSSim.Logic.base.settings import DisplaySettings
from SlicerUSSim.Logic.fitting.appearance import AppearanceModel
from SlicerUSSim.Logic.fitting.image_similarity import SimilaritySettings
from SlicerUSSim.Logic.fitting.optimization import AppearanceCost
from SlicerUSSim.Logic.fitting.parameters import FreeParameters
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.mri.samples import demo_mri
from SlicerUSSim.Logic.mri.segmentation import Segmentation, segment_mri
from SlicerUSSim.Logic.opencl.device import Device
from SlicerUSSim.Logic.opencl.devices import DeviceInfo
from SlicerUSSim.Logic.probe.arrays import ConvexProbe, PhasedProbe
from SlicerUSSim.Logic.probe.placement import craniotomy_pose, tilt_sweep
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.verification.benchmark.machine import Machine
from SlicerUSSim.Logic.verification.benchmark.timing import measured, summary
from SlicerUSSim.Logic.verification.benchmark.work import frame_work
from SlicerUSSim.Logic.verification.numpy_model import NumpyModel

FRAMES = {"A": PhasedProbe(75, 73, scan_lines=196), "B": ConvexProbe(60, 70, 120, scan_lines=192)}
SWEEP_IMAGES, SWEEP_DEG = 128, 50.0
#: Smallest fraction of pixels within one grey level of another device's, and of numpy's, with its other rounding
SAME_AS_DEVICE, SAME_AS_NUMPY = 0.999, 0.99
_WHITE = "white matter"
_FREE = {
    "evaluation: display, scatterers": ["display", f"{_WHITE}.mu0", f"{_WHITE}.sigma0"],
    "evaluation: and attenuation": ["display", _WHITE],
}


def run_benchmark(
    devices: Sequence[DeviceInfo], *, repeat: int = 30, brief: bool = False, progress: Callable[[str], None] = print
) -> dict:
    """Measure every device; returns the content of `ussim bench --json`.

    `brief` omits frame B, sweep and optimisation. `progress` is called with each device and measurement.
    The result's "wrong" lists images that differ too much from those of other devices or of numpy.
    Raises SimulationError for a `repeat` outside 1 to 10000, and if a device fails.
    """
    require_between("run_benchmark", "repeat", repeat, 1, 10_000)
    mri, source = demo_mri()
    result = {
        "machine": {"system": platform.platform(), "processor": _processor(), "python": platform.python_version()},
        "mri": f"{source}, {'x'.join(map(str, mri.array.shape[::-1]))} voxels",
        "devices": {},
        "wrong": [],
    }
    images: dict[str, np.ndarray] = {}
    for info in devices:
        name = f"{info.platform}, {info.name}"
        measurement = _DeviceBenchmark(info, mri, repeat, progress)
        result["devices"][name] = numbers = measurement.run(brief)
        result["wrong"] += [f"{name}: {text}" for text in _compare(numbers, measurement.images, images)]
        if not images and measurement.images:
            images = measurement.images
            progress("the same frame in numpy")
            result["numpy"], wrong = _numpy(measurement)
            result["wrong"] += [f"{name}: {text}" for text in wrong]
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
        self._tell("memory and arithmetic")
        machine = Machine.measure(self.device)
        self._tell("segmentation")
        numbers: dict[str, Any] = {"kind": self.info.kind, **asdict(machine), "frames": {}}
        numbers["segmentation"] = measured(self._segment, min(self.repeat, 5))
        self.poses = {name: craniotomy_pose(self.segmentation.labels, probe) for name, probe in FRAMES.items()}
        names = self.segmentation.tissue_names
        self.simulator = UltrasoundSimulator(self.segmentation.labels, TissueTable.brain(names), device=self.device)
        for name in ["A"] if brief else FRAMES:
            self._tell(f"frame {name}")
            numbers["frames"][name] = self._frame(name, machine)
        if not brief:
            self._tell(f"sweep of {SWEEP_IMAGES} images")
            numbers[f"volume of {SWEEP_IMAGES} images"] = measured(self._sweep, 1)
            self._tell("optimisation")
            numbers |= self._evaluations()
        return numbers

    def _tell(self, what: str) -> None:
        self.progress(f"{self.info.index} {what}")

    def _segment(self) -> None:
        self.segmentation = segment_mri(self.mri, device=self.device)

    def _frame(self, name: str, machine: Machine) -> dict:
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
        work = frame_work(simulator, probe, pose, frames[0].grid)
        numbers["stages"] = {
            stage: summary(frame.timings_ms[stage] for frame in frames)
            | ({**asdict(work[stage]), "floor_ms": machine.floor_ms(work[stage])} if stage in work else {})
            for stage in frames[0].timings_ms
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


def _compare(numbers: dict, images: dict[str, np.ndarray], reference: dict[str, np.ndarray]) -> list[str]:
    """Record the fraction of each frame that agrees with the first device; returns the errors."""
    wrong = []
    for name, image in images.items():
        if name in reference:
            same = _same(image, reference[name])
            numbers["frames"][name]["same_as_first_device"] = same
            if same < SAME_AS_DEVICE:
                wrong.append(
                    f"frame {name}: {same:.2%} of pixels as on the first device, expected {SAME_AS_DEVICE:.1%}"
                )
    return wrong


def _numpy(measurement: _DeviceBenchmark) -> tuple[dict, list[str]]:
    """(times of frame A in numpy and the fraction of pixels that agree, errors)."""
    model = NumpyModel(measurement.simulator)
    image = model.simulate(FRAMES["A"], measurement.poses["A"])
    same = _same(image, measurement.images["A"])
    numbers = {"frame A": {"whole_ms": sum(model.timings_ms.values()), "stages_ms": model.timings_ms, "same": same}}
    expected = f"frame A: {same:.2%} of pixels as in numpy, expected {SAME_AS_NUMPY:.0%}"
    return numbers, [expected] if same < SAME_AS_NUMPY else []


def _same(image: np.ndarray, other: np.ndarray) -> float:
    """Fraction of pixels within one grey level."""
    return float((np.abs(image.astype(int) - other) <= 1).mean())


def _processor() -> str:
    try:
        with open("/proc/cpuinfo") as lines:
            return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
