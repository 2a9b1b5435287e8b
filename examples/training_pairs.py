"""Images with labels for training a network: python examples/training_pairs.py MRI OUT.npz [IMAGES]

Drafts of 128 x 160 pixels at random poses on the patient, each with another focus and gain.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np

from SlicerUSSim.Logic import DisplaySettings, SimulationError, SimulationSettings, UltrasoundSimulator, Volume
from SlicerUSSim.Logic.probe import PROBES, PatientSurface, craniotomy_pose, turned


def write_pairs(mri: Volume, out: Path, images: int, seed: int = 0) -> None:
    """Write arrays "image" and "labels" (images, rows, columns) uint8, and "poses" (images, 4, 4)."""
    random = np.random.default_rng(seed)
    simulator = UltrasoundSimulator.from_mri(mri, SimulationSettings(quality="draft"))
    surface = PatientSurface(simulator.medium.labels)
    start = craniotomy_pose(simulator.medium.labels, PROBES["phased"])
    poses = []
    for _ in range(images):
        point = surface.at(right_deg=random.uniform(-70, 70), front_deg=random.uniform(-60, 60))
        rock, tilt, rotate = random.uniform([-15, -15, -180], [15, 15, 180])
        poses.append(turned(surface.slid(start, point), rock_deg=rock, tilt_deg=tilt, rotate_deg=rotate))
    probes = [replace(PROBES["phased"], focus_mm=focus) for focus in random.choice([30.0, 45.0, 60.0], images)]
    gains = random.uniform(-6, 6, images)
    displays = [DisplaySettings(gain_db=gain, image_size=(128, 160)) for gain in gains]
    started = perf_counter()
    pairs = simulator.simulate_batch(probes, poses, display=displays, outputs=("image", "labels"))
    print(f"{images} pairs in {perf_counter() - started:.1f} s, after the segmentation", file=sys.stderr)
    np.savez_compressed(out, poses=poses, image=pairs["image"], labels=pairs["labels"])


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    count = int(sys.argv[3]) if len(sys.argv) > 3 else 100
    try:
        write_pairs(Volume.read(sys.argv[1]), Path(sys.argv[2]), count)
    except SimulationError as error:
        sys.exit(str(error))
