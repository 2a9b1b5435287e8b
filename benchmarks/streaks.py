"""Dark radial streaks by refraction in brains: beams from an aperture, and single rays as the control.

    python benchmarks/streaks.py [--views N] [--device NAME]

Random views of the MNI152 template and, where Debian's mricron-data is installed, Colin27, by a phased and a convex
array. All tissues have the same scatterers and there are no interface echoes, so that what changes the level of a line
is the way to it. A view has streaks if in their deeper half at least 2 % of its lines are darker by more than 12 dB
than with the speed of sound of brain everywhere.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic import (
    ConvexProbe,
    PhasedProbe,
    SimulationSettings,
    TissueTable,
    UltrasoundSimulator,
    Volume,
    segment_mri,
)
from SlicerUSSim.Logic.mri import demo_mri
from SlicerUSSim.Logic.probe import Probe, pose_looking_at
from SlicerUSSim.Logic.probe.placement import surface_point
from SlicerUSSim.Logic.verification.brain_phantoms import COLIN27

PROBES = {"phased": PhasedProbe(75, 73, scan_lines=192), "convex": ConvexProbe(60, 60, 100, scan_lines=192)}
DARK_DB, LEAST_SHARE = -12.0, 0.02
SCATTERERS = {"mu0": 0.33, "sigma0": 0.15, "mu1": 0.0}
BRAIN_M_S = 1541.0


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--views", type=int, default=40, help="of every brain, by either probe")
    parser.add_argument("--device", help="see `ussim devices`")
    arguments = parser.parse_args()
    colin27 = COLIN27 / "ch2bet.nii.gz"
    brains = {"MNI152": demo_mri()[0]} | ({"Colin27": Volume.read(colin27)} if colin27.exists() else {})
    for brain, mri in brains.items():
        found = segment_mri(mri, thin_sulci=True, device=arguments.device)
        tissues = TissueTable.brain(found.tissue_names).with_membrane(None)
        for name in dict.fromkeys(tissues.names()):
            tissues = tissues.replace(name, **SCATTERERS)
        even = tissues
        for name in dict.fromkeys(tissues.names()):
            even = even.replace(name, speed_of_sound_m_s=BRAIN_M_S)
        simulators = [UltrasoundSimulator(found.labels, table, device=arguments.device) for table in (tissues, even)]
        for kind, probe in PROBES.items():
            rng = np.random.default_rng(11)
            poses = [random_pose(found.labels, rng) for _ in range(arguments.views)]
            for beam in ("aperture", "ray"):
                changes = np.array([change_db(simulators, probe, pose, beam) for pose in poses])
                streaks = int(((changes < DARK_DB).mean(axis=1) >= LEAST_SHARE).sum())
                darkest = np.percentile(changes, 100 * LEAST_SHARE, axis=1)
                print(
                    f"{brain:8s} {kind:7s} {beam:9s} streaks in {streaks:2d} of {len(poses)} views; the darkest 2 % of "
                    f"lines below {np.median(darkest):6.1f} dB (median), {darkest.min():6.1f} dB (worst view)"
                )


def change_db(simulators: list[UltrasoundSimulator], probe: Probe, pose: np.ndarray, beam: str) -> np.ndarray:
    """(lines,) level in the deeper half of the image, re that of the last simulator."""
    levels = []
    for simulator in simulators:
        simulator.settings = replace(SimulationSettings(interfaces=False), beam=beam)
        iq = simulator.simulate(probe, pose).iq
        levels.append(10.0 * np.log10((np.abs(iq[:, iq.shape[1] // 2 :]) ** 2).mean(axis=1) + 1e-30))
    return levels[0] - levels[-1]


def random_pose(labels: Volume, rng: np.random.Generator) -> np.ndarray:
    """(4, 4) pose on the surface of a brain, not from below, aimed within 10 mm of its centre along each axis."""
    centre = labels.ijk_to_ras[:3] @ [*ndimage.center_of_mass(labels.array > 0)[::-1], 1.0]
    outward = rng.normal(size=3)
    while outward[2] < -0.3 * np.linalg.norm(outward):
        outward = rng.normal(size=3)
    outward /= np.linalg.norm(outward)
    target = centre + rng.uniform(-10.0, 10.0, 3)
    face = surface_point(labels, target, outward) + outward
    return pose_looking_at(face, target, lateral_ras=tuple(rng.normal(size=3)))


if __name__ == "__main__":
    main()
