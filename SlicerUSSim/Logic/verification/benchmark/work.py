"""The minimum work of a frame: Stage.work of every stage, for the frame's ray tree."""

from __future__ import annotations

import numpy as np

from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.imaging.stage import Work
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid


def frame_work(simulator: UltrasoundSimulator, probe: Probe, pose: np.ndarray, grid: ImageGrid) -> dict[str, Work]:
    """{stage: Work} of one frame, with the names of Frame.timings_ms."""
    frame, tree = simulator.device_frame(probe, pose, grid=grid), simulator.trace(probe, pose)
    return {stage.name: stage.work(frame, tree) for stage in simulator.stages}
