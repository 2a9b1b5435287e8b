"""Level at the centre of a cyst relative to its surroundings, against depth, for three probe presets as a figure.

    python -m benchmarks.cyst_contrast PICTURE.png [--all]

The cyst is a black sphere of 10 mm in uniform tissue without attenuation, the probe has its own focus. Dashed: what the
diffraction of its apertures and its clutter predict (validation/phantoms.py). Dots: images, mean of four scatterer
seeds. With --all, a table of all presets at their transmit focus follows, and no figure is needed for it.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from SlicerUSSim.Logic import SimulationSettings, TissueTable, UltrasoundSimulator, Volume
from SlicerUSSim.Logic.probe import PROBES
from SlicerUSSim.Logic.probe.arrays import Probe
from validation.measurement import depth_window, level_db
from validation.phantoms import BACKGROUND, clutter_power

SHOWN = {"phased": "phased, 5 MHz", "abdominal": "convex, 3.5 MHz", "linear": "linear, 9 MHz"}
RADIUS_MM, SEEDS = 5.0, 4


def contrast_db(probe: Probe, depth_mm: float, device: str | None) -> float:
    """Mean power within 1 mm of the centre of the cyst, relative to that beside it at the same depth."""
    spacing = 0.5
    axis = np.arange(-12, 13) * spacing
    x, y, z = np.meshgrid(axis, axis, axis)
    matrix = np.diag([spacing, spacing, spacing, 1.0])
    matrix[:3, 3] = axis[0] + np.array([0.0, depth_mm, 0.0])
    labels = Volume(np.where(x**2 + y**2 + z**2 < RADIUS_MM**2, 2, 1).astype(np.uint8), matrix)
    tissue = replace(BACKGROUND, attenuation_db_cm_mhz=0.0)
    cyst = replace(tissue, name="cyst", mu0=0.0, sigma0=0.0)
    tissues = TissueTable({0: tissue, 1: tissue, 2: cyst})  # the tissue continues around the volume
    apart = float(probe.line_distance_mm(depth_mm))
    middle, near = probe.scan_lines // 2, max(round(1.0 / apart), 1)
    aside = min(round(9.0 / apart), middle - near - 1)
    inside, outside = [], []
    for seed in range(SEEDS):
        settings = SimulationSettings(seed=seed, interfaces=False, ring_down=False)
        frame = UltrasoundSimulator(labels, tissues, settings, device).simulate(probe, np.eye(4))
        window = depth_window(frame, depth_mm, 1.0)
        inside.append(window[middle - near : middle + near + 1])
        outside += [window[at - near : at + near + 1] for at in (middle - aside, middle + aside)]
    return level_db(np.stack(inside)) - level_db(np.stack(outside))


def predicted_db(probe: Probe, depth_mm: float) -> float:
    return float(10.0 * np.log10(clutter_power(probe, depth_mm, RADIUS_MM, within_mm=1.0)))


def draw(path: str, device: str | None) -> None:
    figure, axes = plt.subplots(figsize=(7.0, 4.0), layout="constrained")
    for name, label in SHOWN.items():
        probe = PROBES[name]
        shallowest = 6.0 if probe.is_linear else 16.0  # where the field is wide enough for tissue beside the cyst
        depths = np.linspace(shallowest, 0.95 * probe.depth_mm, 10)
        found = [contrast_db(probe, depth, device) for depth in depths]
        expected = [predicted_db(probe, depth) for depth in depths]
        color = axes.plot(depths, found, "o", label=f"{label}, focus at {probe.focus_mm:g} mm")[0].get_color()
        axes.plot(depths, expected, "--", color=color)
        print(name, *(f"{d:.0f} mm: {f:.1f} ({e:.1f})" for d, f, e in zip(depths, found, expected, strict=True)))
    axes.set(xlabel="depth of the centre of the cyst [mm]", ylabel="centre of a 10 mm cyst re around it [dB]")
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("picture", help="PNG to write")
    parser.add_argument("--all", action="store_true", help="also print a table of all presets, at their focus")
    parser.add_argument("--device", help="see `ussim devices`")
    arguments = parser.parse_args()
    draw(arguments.picture, arguments.device)
    for name, probe in PROBES.items() if arguments.all else ():
        found, expected = contrast_db(probe, probe.focus_mm, arguments.device), predicted_db(probe, probe.focus_mm)
        print(f"{name:13} {probe.focus_mm:5.0f} mm {found:6.1f} dB, predicted {expected:6.1f}")


if __name__ == "__main__":
    main()
