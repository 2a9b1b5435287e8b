"""Dark radial streaks by refraction in brains: beams from an aperture, and single rays as the control.

    python -m benchmarks.streaks [--views N] [--device NAME]

Random views of the MNI152 template and, where Debian's mricron-data is installed, Colin27, by a phased and a convex
array. All tissues have the same scatterers and there are no interface echoes, so that what changes the level of a line
is the way to it. A view has streaks if in their deeper half at least 2 % of its lines are darker by more than 12 dB
than with the speed of sound of brain everywhere.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from SlicerUSSim.Logic import ConvexProbe, PhasedProbe, SimulationSettings, UltrasoundSimulator
from SlicerUSSim.Logic.probe import Probe
from validation.brain_views import even_brains, random_pose

PROBES = {"phased": PhasedProbe(75, 73, scan_lines=192), "convex": ConvexProbe(60, 60, 100, scan_lines=192)}
DARK_DB, LEAST_SHARE = -12.0, 0.02


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--views", type=int, default=40, help="of every brain, by either probe")
    parser.add_argument("--device", help="see `ussim devices`")
    arguments = parser.parse_args()
    for brain in even_brains(arguments.device):
        tables = (brain.tissues, brain.baseline)
        simulators = [UltrasoundSimulator(brain.labels, table, device=arguments.device) for table in tables]
        for kind, probe in PROBES.items():
            rng = np.random.default_rng(11)
            poses = [random_pose(brain.labels, rng) for _ in range(arguments.views)]
            for beam in ("aperture", "ray"):
                changes = np.array([change_db(simulators, probe, pose, beam) for pose in poses])
                streaks = int(((changes < DARK_DB).mean(axis=1) >= LEAST_SHARE).sum())
                darkest = np.percentile(changes, 100 * LEAST_SHARE, axis=1)
                print(
                    f"{brain.name:8s} {kind:7s} {beam:9s} streaks in {streaks:2d} of {len(poses)} views; the darkest "
                    f"2 % of lines below {np.median(darkest):6.1f} dB (median), {darkest.min():6.1f} dB (worst view)"
                )


def change_db(simulators: list[UltrasoundSimulator], probe: Probe, pose: np.ndarray, beam: str) -> np.ndarray:
    """(lines,) level in the deeper half of the image, relative to the last simulator."""
    levels = []
    for simulator in simulators:
        simulator.settings = replace(SimulationSettings(interfaces=False), beam=beam)
        iq = simulator.simulate(probe, pose).iq
        levels.append(10.0 * np.log10((np.abs(iq[:, iq.shape[1] // 2 :]) ** 2).mean(axis=1) + 1e-30))
    return levels[0] - levels[-1]


if __name__ == "__main__":
    main()
