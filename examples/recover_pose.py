"""How well a displaced probe is found again by its images: python examples/recover_pose.py MRI

Three images of a sweep are "real": they have other scatterers and noise. Their poses are moved by some millimetres and
degrees, and registered to them.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

from SlicerUSSim.Logic import DisplaySettings, SimulationError, UltrasoundSimulator, Volume
from SlicerUSSim.Logic.fitting import register_poses
from SlicerUSSim.Logic.probe import PROBES, craniotomy_pose, tilt_sweep, turned


def errors_mm(mri: Volume, evaluations: int = 300) -> tuple[float, float]:
    """Distance of the middle of the field to where it is, before and after registration."""
    simulator = UltrasoundSimulator.from_mri(mri)
    probe, display = PROBES["phased"], DisplaySettings(image_size=(128, 160))
    poses = tilt_sweep(craniotomy_pose(simulator.medium.labels, probe), angle_deg=30, frames=3)
    own = simulator.settings
    simulator.settings = replace(own, seed=1)
    real = simulator.simulate_batch(probe, poses, display=display)["image"]
    simulator.settings = own

    moved = [turned(pose, rock_deg=3.0) for pose in poses]
    for pose in moved:
        pose[:3, 3] += 3.0
    found = register_poses(simulator, probe, moved, list(real), display=display, max_evaluations=evaluations)
    middle = np.array([0.0, 0.5 * probe.depth_mm, 0.0, 1.0])
    before, after = (
        float(np.mean([np.linalg.norm((a @ middle - b @ middle)[:3]) for a, b in zip(these, poses, strict=True)]))
        for these in (moved, found.poses)
    )
    return before, after


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    try:
        print("{:.1f} mm before, {:.1f} mm after".format(*errors_mm(Volume.read(sys.argv[1]))))
    except SimulationError as error:
        sys.exit(str(error))
