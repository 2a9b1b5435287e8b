"""Time of a change of the display, with each of the console's effects: python -m benchmarks.display [--device D].

The limit is 3 ms in addition to a change of gain alone, on two idle cores with Intel's runtime.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from time import perf_counter

import numpy as np

from SlicerUSSim.Logic import DisplaySettings, TissueTable, UltrasoundSimulator, Volume
from SlicerUSSim.Logic.probe import PROBES, ImageGrid, pose_looking_at

#: Repetitions, of which the fastest counts: others may use the computer
_REPEAT = 40
_EFFECTS = {
    "gain alone": {},
    "smoothing": {"smoothing_axial_mm": 0.1, "smoothing_lateral_deg": 0.34},
    "grey map": {"grey_map": "soft"},
    "edge enhancement": {"edge_enhancement": 0.7},
    "persistence": {"persistence": 0.5},
    "sliders": {"depth_gain_3_db": 4.0, "line_gain_1_db": -6.0},
    "all": {
        "smoothing_axial_mm": 0.1, "smoothing_lateral_deg": 0.34, "grey_map": "soft", "edge_enhancement": 0.7,
        "depth_gain_3_db": 4.0, "line_gain_1_db": -6.0, "persistence": 0.5,
    },
}  # fmt: skip


def main() -> None:
    """Print milliseconds per effect and probe."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device")
    device = parser.parse_args().device
    labels = Volume(np.ones((120, 160, 160), np.uint8), np.eye(4))
    simulator = UltrasoundSimulator(labels, TissueTable.named(["white matter"]), device=device)
    pose = pose_looking_at((80, 150, 60), (80, 0, 60))
    print(simulator.device.info)
    for name in ("phased", "linear", "convex"):
        probe = PROBES[name]
        grid = ImageGrid.for_probe(probe, None)
        times: dict[str, list[float]] = {effect: [] for effect in _EFFECTS}
        simulator.render(probe, pose, DisplaySettings(), grid)
        simulator.device.queue.finish()
        for n in range(_REPEAT):
            for effect, changes in _EFFECTS.items():
                display = replace(DisplaySettings(gain_db=0.01 * n), **changes)
                started = perf_counter()
                simulator.simulate(probe, pose, display, grid)  # persistence is part of it
                times[effect].append(perf_counter() - started)
        best = {effect: 1e3 * min(found) for effect, found in times.items()}
        print(f"{name}: " + ", ".join(f"{effect} {ms:.2f} ms" for effect, ms in best.items()))


if __name__ == "__main__":
    main()
