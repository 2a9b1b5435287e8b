"""Fit display and one tissue to real images of a scanner: speckle of a phantom, and the noise of a bare RF frame.

    python examples/fit_real_speckle.py FOLDER [--out PICTURES]

FOLDER contains SpinePhantomFreehand.igs.mha and UltrasonixLinearRfData.igs.mha of the Plus toolkit's test data
(PlusLibData, TestImages; BSD-3-Clause). The interior of the phantom is not known, so it is modelled as one uniform
tissue, and only a region of one image is compared that shows speckle alone. The RF frame was recorded in air: below the
reverberations of the probe it contains only amplifier noise, which rises with depth with the time gain compensation
(TGC). Noise level and TGC can therefore be fitted to it.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter
from scipy.signal import hilbert

from SlicerUSSim.Logic import (
    DisplaySettings,
    LinearProbe,
    SimulationSettings,
    Tissue,
    TissueTable,
    TrackedSequence,
    UltrasoundSimulator,
    Volume,
    optimize_appearance,
)
from SlicerUSSim.Logic.probe import ImageGrid
from SlicerUSSim.Logic.tissue import TISSUES
from SlicerUSSim.Logic.tracked import estimate_field

WIDTH_MM = 38.0  # of the face of the L14-5
SAMPLING_MHZ = 40.0
GEL = replace(TISSUES["liver"], name="phantom")
SILENT = Tissue("air-coupled", 1540.0, 1.54, 0.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, default=Path("."))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    speckle = fit_speckle(TrackedSequence.read(arguments.folder / "SpinePhantomFreehand.igs.mha"))
    draw(arguments.out / "real-speckle.png", "Speckle of a spine phantom, linear array", *speckle)
    noise = fit_noise(TrackedSequence.read(arguments.folder / "UltrasonixLinearRfData.igs.mha"))
    draw(arguments.out / "real-noise.png", "Noise of an RF frame in air", *noise)


def fit_speckle(sequence: TrackedSequence):
    """Display and one tissue to the left part of image 20, where the phantom is homogeneous."""
    # The scanner's settings were not recorded; with these the speckle size is similar to that of the image.
    mm = WIDTH_MM / estimate_field(sequence.images, (1.0, 1.0)).probe.face_mm
    field = estimate_field(
        sequence.images, (mm, mm), scan_lines=256, frequency_mhz=6.6, fractional_bandwidth=0.35, aperture_mm=9.0
    )
    window = rows, columns = field.window
    pixel = field.image_to_probe[0, 0], field.image_to_probe[1, 1]
    left, top = (field.image_to_probe @ [columns.start - 0.5, rows.start - 0.5, 0, 1])[:2]
    real = np.ascontiguousarray(sequence.images[20][window])
    height, width = real.shape
    grid = ImageGrid(height, width, float(left), float(top), (float(pixel[0]), float(pixel[1])))
    region = np.zeros(real.shape, bool)
    region[round(8 / pixel[1]) : round(42 / pixel[1]), round(4 / pixel[0]) : round(18 / pixel[0])] = True
    free = {"display": None, "phantom": None, "phantom.attenuation_db_cm_mhz": (0.1, 3.0)}
    return fitted(GEL, field.probe, real, region, grid, free, DisplaySettings(tgc_db_cm_mhz=0.3))


def fit_noise(sequence: TrackedSequence):
    """Noise and TGC to the region below the reverberations; the envelope is compressed as by DisplaySettings."""
    depth = sequence.images.shape[2] * 1.54 / (2.0 * SAMPLING_MHZ)
    probe = LinearProbe(WIDTH_MM, depth, scan_lines=256, frequency_mhz=6.6)
    envelope = np.abs(hilbert(sequence.images[0].astype(float), axis=1))
    level_db = 20.0 * np.log10(envelope + 1e-3) - 90.3  # re full scale of the converter, 2^15
    grey = np.clip(255.0 * (1.0 + level_db / 65.0), 0, 255)
    grid = ImageGrid(512, 256, -0.5 * WIDTH_MM, 0.0, (WIDTH_MM / 256, depth / 512))
    edges = np.linspace(0, grey.shape[1], 513).astype(int)
    real = np.stack([grey[:, a:b].mean(axis=1) for a, b in pairwise(edges)]).round()
    region = np.zeros(real.shape, bool)
    region[290:490, 4:-4] = True  # below the reverberations, above the artefact at the end of the lines
    start = DisplaySettings(dynamic_range_db=65.0, noise_db=-60.0, tgc_db_cm_mhz=0.0)
    free = {"noise_db": (-110, -20), "tgc_db_cm_mhz": None}
    return fitted(SILENT, probe, real.astype(np.uint8), region, grid, free, start)


def fitted(tissue: Tissue, probe, real, region, grid, free, start: DisplaySettings):
    """(real, before, after, region, result) of one uniform tissue under the probe."""
    half = 0.5 * WIDTH_MM + 10.0
    size = np.ceil([2 * half, probe.depth_mm + 10.0, 20.0]).astype(int)
    place = np.eye(4)
    place[:3, 3] = -half, -1.0, -10.0
    labels = Volume(np.ones(size[::-1], np.uint8), place)
    simulator = UltrasoundSimulator(labels, TissueTable({0: SILENT, 1: tissue}), SimulationSettings(interfaces=False))
    result = optimize_appearance(
        simulator, probe, [np.eye(4)], [real], free=free, display=start, grid=grid, masks=[region], max_evaluations=600
    )
    before = simulator.simulate(probe, np.eye(4), start, grid).image
    simulator.set_tissues(result.tissues)
    after = simulator.simulate(probe, np.eye(4), result.display, grid).image
    print(
        f"\n{tissue.name}: cost {result.cost_before:.4f} -> {result.cost_after:.4f}, {result.evaluations} evaluations"
    )
    for spread in result.identifiability.spreads:
        print(f"  {spread.name:36s} {spread.value:8.3f}  equally good {spread.low:8.3f} to {spread.high:8.3f}")
    for name, image in (("before", before), ("after", after), ("real", real)):
        inside = image[region]
        print(f"  {name:7s} mean grey {inside.mean():6.1f}  sd {inside.std():5.1f}  cells {cells(image, region, grid)}")
    return real, before, after, region, result


def cells(image: np.ndarray, region: np.ndarray, grid: ImageGrid) -> str:
    """Width of the autocovariance at half its height, along and across the lines."""
    rows, columns = (np.flatnonzero(region.any(axis=axis)) for axis in (1, 0))
    part = image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].astype(float)
    part = part - gaussian_filter(part, 15.0)  # the fall with depth is not speckle
    if part.std() < 1e-6:
        return "none"
    widths = []
    for axis, pixel in ((0, grid.pixel_spacing_mm[1]), (1, grid.pixel_spacing_mm[0])):
        moved = [np.moveaxis(part, axis, 0)[: part.shape[axis] - lag] for lag in range(30)]
        other = [np.moveaxis(part, axis, 0)[lag:] for lag in range(30)]
        correlation = np.array([(a * b).mean() for a, b in zip(moved, other, strict=True)]) / part.var()
        below = int(np.argmax(correlation < 0.5)) if (correlation < 0.5).any() else 29
        step = correlation[below - 1] - correlation[below]
        widths.append(2.0 * pixel * (below - 1 + (correlation[below - 1] - 0.5) / max(step, 1e-9)))
    return f"{widths[0]:.2f} x {widths[1]:.2f} mm"


def draw(path: Path, title: str, real, before, after, region, result) -> None:
    """Images before and after the fit and real, with the region outlined, and histograms of the region."""
    figure = Figure(figsize=(14, 4.6), facecolor="#111111", dpi=110, layout="constrained")
    axes = figure.subplots(1, 4, width_ratios=(1, 1, 1, 1.2))
    rows, columns = (np.flatnonzero(region.any(axis=axis)) for axis in (1, 0))
    box = np.array([[columns[0], rows[0]], [columns[-1], rows[0]], [columns[-1], rows[-1]], [columns[0], rows[-1]]])
    names = (f"before, cost {result.cost_before:.3f}", f"after, cost {result.cost_after:.3f}", "real")
    for axis, image, name in zip(axes, (before, after, real), names, strict=False):
        axis.imshow(image, cmap="gray", vmin=0, vmax=255, aspect="auto")
        axis.plot(*np.vstack([box, box[:1]]).T, color="#ffc83d", linewidth=1)
        axis.set_title(name, color="white", fontsize=11)
        axis.set_axis_off()
    for image, colour, name in ((before, "#8a8a8a", "before"), (after, "#ffc83d", "after"), (real, "#6db3f2", "real")):
        share = np.bincount(image[region] // 8, minlength=32) / region.sum()
        axes[3].stairs(share, np.arange(0, 257, 8), color=colour, label=name, linewidth=1.8)
    axes[3].set_facecolor("#111111")
    axes[3].tick_params(colors="white")
    axes[3].set_xlabel("grey level in the region", color="white")
    axes[3].set_yticks([])
    axes[3].legend(facecolor="#111111", labelcolor="white")
    figure.suptitle(title, color="white")
    figure.savefig(path, facecolor="#111111")


if __name__ == "__main__":
    main()
