"""Scaling of the time of a frame with scan lines, depth, tree depth, scatterers, size of the label map, tissues.

    python -m benchmarks.scaling [--device NAME] [--out docs/images/scaling.png] [--json FILE]

Best of many frames in brain-like tissue: a head of layered ellipsoids with cysts, voxels of 0.25 to 2 mm. One quantity
varies at a time, for a convex array with 128 scan lines 80 mm deep. The slope of each curve between its ends (in
logarithms, 1 is linear) is printed next to it.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.measuring import measured, output_file, timed
from SlicerUSSim.Logic import (
    ConvexProbe,
    SimulationSettings,
    Tissue,
    TissueTable,
    UltrasoundSimulator,
    Volume,
)
from SlicerUSSim.Logic.base import write_json
from SlicerUSSim.Logic.probe import pose_looking_at

PROBE = ConvexProbe(40, 60, 80, scan_lines=128)
POSE = pose_looking_at((0.0, 0.0, 60.0), (0.0, 0.0, 0.0))
HALF_MM = 64.0
REPEAT = 15
SIDES = (64, 128, 256, 512)


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--device", help="see `ussim devices`")
    parser.add_argument("--out", type=output_file, default=Path("docs/images/scaling.png"))
    parser.add_argument("--json", type=output_file)
    arguments = parser.parse_args()
    curves = measure(arguments.device)
    print("| what grows | from | to | time from | time to | slope |\n|---|---|---|---|---|---|")
    for name, points in curves.items():
        (x0, t0), (x1, t1) = points[0], points[-1]
        print(f"| {name} | {x0:g} | {x1:g} | {t0:.1f} ms | {t1:.1f} ms | {slope(points):.2f} |")
    for side in SIDES:
        print(f"a label map of {side}³ voxels is prepared in {readiness(side, arguments.device):.2f} s")
    draw(curves, arguments.out)
    if arguments.json:
        write_json(arguments.json, curves)


def measure(device: str | None) -> dict[str, list[tuple[float, float]]]:
    """{varied quantity: [(its value, milliseconds of a frame)]}"""
    usual = simulator(128, 4, device)
    settings = SimulationSettings()
    mirrors = simulator(128, 4, device, hard=True)
    bushy = replace(settings, reflection_threshold=1e-4)  # so that the tree reaches its maximum depth
    return {
        "scan lines": [(n, frame(usual, replace(PROBE, scan_lines=n), settings)) for n in (32, 64, 128, 256, 512)],
        "depth, mm": [(d, frame(usual, replace(PROBE, depth_mm=d), settings)) for d in (20.0, 40.0, 80.0, 110.0)],
        "reflections along a path": [
            (d, frame(mirrors, PROBE, replace(bushy, max_ray_depth=d))) for d in (1, 2, 3, 4, 6, 8)
        ],
        "scatterers per mm³": [
            (n, frame(usual, PROBE, replace(settings, scatterers_per_mm3=n))) for n in (5.0, 20.0, 42.0, 100.0, 400.0)
        ],
        "voxels along a side": [(n, frame(simulator(n, 4, device), PROBE, settings)) for n in SIDES],
        "tissues": [(n, frame(simulator(128, n, device), PROBE, settings)) for n in (2, 4, 8, 16, 32, 60)],
    }


def frame(simulator: UltrasoundSimulator, probe, settings) -> float:
    """Milliseconds of one frame."""
    simulator.settings = settings

    def whole() -> None:
        simulator.forget_echoes()
        simulator.simulate(probe, POSE)

    return measured(whole, REPEAT)["best_ms"]


def simulator(side: int, tissues: int, device: str | None, hard: bool = False) -> UltrasoundSimulator:
    """A head of `side`³ voxels: brain with spheres of the other tissues; with `hard`, some of them are stones."""
    spacing = 2.0 * HALF_MM / side
    axis = ((np.arange(side) + 0.5) * spacing - HALF_MM).astype(np.float32)
    z, y, x = axis[:, None, None], axis[None, :, None], axis[None, None, :]
    labels = (x * x + y * y + z * z < 58.0**2).astype(np.uint8)
    random = np.random.default_rng(1)
    for n in range(120):  # the same number of spheres for every number of tissues
        centre, radius = random.uniform(-40, 40, 3), random.uniform(3, 7)
        box = tuple(slice(*np.searchsorted(axis, [c - radius, c + radius])) for c in centre[::-1])
        part = (z[box[0]] - centre[2]) ** 2 + (y[:, box[1]] - centre[1]) ** 2 + (x[:, :, box[2]] - centre[0]) ** 2
        labels[box][part < radius**2] = 2 + n % (tissues - 1) if tissues > 1 else 1
    table = {0: Tissue("fluid", 1540, 1.54, 0.0, 0.0, 0.0, 0.0)}
    for n in range(1, tissues + 1):
        # Brain-like; every fourth tissue forms an interface, as tumours and vessels do.
        speed = 1546.0 + 10.0 * (n // 4 if n % 4 == 0 else 0)
        table[n] = Tissue(f"tissue {n}", speed, speed * 1.04e-3, 0.5, 0.3, 0.0, 0.1 + 0.01 * n)
    if hard:
        table[4] = Tissue("stone", 2200, 4.0, 0.3, 0.3, 0.0, 0.3)
    matrix = np.diag([spacing] * 3 + [1.0])
    matrix[:3, 3] = axis[0]
    return UltrasoundSimulator(Volume(labels, matrix), TissueTable(table), device=device)


def readiness(side: int, device: str | None) -> float:
    """Seconds from a label map in memory to a simulator with it on the device; the better of two."""
    medium = simulator(side, 4, device).medium

    def build() -> None:
        UltrasoundSimulator(medium.labels, medium.tissues, device=device).device.queue.finish()

    return 1e-3 * min(timed(build) for _ in range(2))


def slope(points: list[tuple[float, float]]) -> float:
    """Exponent of the power law between the first and the last point."""
    (x0, t0), (x1, t1) = points[0], points[-1]
    return float(np.log(t1 / t0) / np.log(x1 / x0))


def draw(curves: dict, out: Path) -> None:
    """One logarithmic plot per curve, with a line of slope 1 for comparison."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot, ticker

    figure, axes = pyplot.subplots(2, 3, figsize=(11, 6), constrained_layout=True)
    for axis, (name, points) in zip(axes.ravel(), curves.items(), strict=True):
        x, milliseconds = map(np.array, zip(*points, strict=True))
        axis.loglog(x, milliseconds, "o-", color="tab:blue", label=f"slope {slope(points):.2f}")
        axis.loglog(x, milliseconds[0] * x / x[0], "--", color="0.7", label="linear")
        axis.set_xlabel(name)
        axis.set_ylabel("ms per frame")
        axis.set_xticks(x, [f"{value:g}" for value in x])
        axis.minorticks_off()
        axis.set_ylim(0.5 * milliseconds.min(), 2.0 * milliseconds.max())
        axis.yaxis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
        axis.yaxis.set_major_formatter(ticker.FormatStrFormatter("%g"))
        axis.legend(frameon=False)
    figure.savefig(out, dpi=110)


if __name__ == "__main__":
    main()
