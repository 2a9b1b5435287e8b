"""Figures of the validation: phantom next to simulation with the predictions, in the style of the paper's Fig. 2."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.files import written_whole
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.imaging.frame import Frame
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.poses import sample, slice_under_probe
from validation.measurement import RayleighFit
from validation.phantoms import Echo, LevelChange, Phantom

_OBJECT, _PREDICTION = "#4fb0c6", "#ffc83d"
_CURVES = ("#c0392b", "#2c5f8a", "#5f9e6e")
# One grey level per label: background, then the parts of the phantom.
_LABEL_GREYS = np.array([45, 75, 130, 255, 30, 255, 190], np.uint8)


@dataclass(frozen=True, eq=False)
class View:
    """One phantom and its image."""

    title: str
    phantom: Phantom
    probe: Probe
    frame: Frame


def draw_views(path: Path, views: list[View]) -> None:
    """Phantom and simulated image side by side, one row per view: circles at objects, crosses at their predicted
    positions in the image, boxes around regions of predicted level."""
    from matplotlib import patches

    left, right, top, bottom = views[0].probe.image_bounds_mm()
    figure, axes = _figure(len(views), 2, 3.2 * (right - left) / (bottom - top) + 0.9, 3.8)
    for (left, right), view in zip(axes, views, strict=True):
        bounds = view.probe.image_bounds_mm()
        extent = (bounds[0], bounds[1], bounds[3], bounds[2])
        labels = slice_under_probe(view.phantom.labels, view.frame.grid, view.phantom.probe_to_ras, order=0)
        left.imshow(_LABEL_GREYS[labels], cmap="gray", vmin=0, vmax=255, extent=extent, interpolation="nearest")
        outline = view.probe.outline_mm()
        left.plot(outline[:, 0], outline[:, 1], color="#888888", linewidth=0.8)
        right.imshow(view.frame.image, cmap="gray", vmin=0, vmax=255, extent=extent, interpolation="bilinear")
        for axis in (left, right):
            for mark in view.phantom.expected(view.probe):
                if isinstance(mark, Echo):
                    axis.plot(*mark.object_mm, "o", color=_OBJECT, fillstyle="none", markersize=9, markeredgewidth=1.2)
                    axis.plot(*mark.shown_mm, "x", color=_PREDICTION, markersize=6, markeredgewidth=1.2)
                else:
                    x0, x1, y0, y1 = mark.region_mm
                    axis.add_patch(patches.Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, color=_PREDICTION))
                    text = f"{mark.change_db:+.1f} dB" if isinstance(mark, LevelChange) else f"{mark.level_db:.1f} dB"
                    axis.text(x1 + 0.5, 0.5 * (y0 + y1), text, color=_PREDICTION, fontsize=8)
            axis.set_xlim(bounds[0], bounds[1])
            axis.set_ylim(bounds[3], bounds[2])
            axis.set_aspect("equal")
        left.set_title(f"{view.title}: phantom", fontsize=10)
        right.set_title("simulated; x: predicted, o: object", fontsize=10)
        left.set_ylabel("depth [mm]")
    for axis in axes[-1]:
        axis.set_xlabel("lateral [mm]")
    _save(figure, path)


def draw_rayleigh(path: Path, fit: RayleighFit, envelope: np.ndarray) -> None:
    """The envelope image and its histogram with the fitted density, as the paper's Fig. 4."""
    figure, axes = _figure(1, 2, 4.2, 4.2)
    image, histogram = axes[0]
    image.imshow(envelope.T, cmap="gray", aspect="auto")
    image.set_title("envelope", fontsize=10)
    image.set_xlabel("scan line")
    image.set_ylabel("sample")
    grey = np.arange(256) + 0.5
    histogram.bar(grey, fit.histogram, width=1.0, color="#8fb8c9", label="simulated")
    histogram.plot(grey, fit.density, color="#c0392b", label=f"Rayleigh, sigma {fit.sigma:.2f}")
    histogram.set_title(f"SSE {fit.sse:.2e} (paper 3.14e-05)", fontsize=10)
    histogram.set_xlabel("grey level")
    histogram.set_ylabel("fraction of samples")
    histogram.legend(fontsize=8)
    _save(figure, path)


@dataclass(frozen=True, eq=False)
class Curve:
    """Measured points and the theoretical curve."""

    name: str
    x: np.ndarray
    measured: np.ndarray
    theory_x: np.ndarray
    theory: np.ndarray


@dataclass(frozen=True, eq=False)
class Plot:
    """Curves in one pair of axes."""

    title: str
    x_label: str
    y_label: str
    curves: list[Curve]


def draw_plots(path: Path, plots: list[Plot]) -> None:
    """Plots side by side: dots are measured, lines are theory."""
    figure, axes = _figure(1, len(plots), 4.4, 3.6)
    for axis, plot in zip(axes[0], plots, strict=True):
        for n, curve in enumerate(plot.curves):
            colour = _CURVES[n % len(_CURVES)]
            axis.plot(curve.theory_x, curve.theory, color=colour, linewidth=1.2, label=f"theory, {curve.name}")
            axis.plot(curve.x, curve.measured, "o", color=colour, markersize=3.5)
        axis.set_title(plot.title, fontsize=10)
        axis.set_xlabel(plot.x_label)
        axis.set_ylabel(plot.y_label)
        axis.legend(fontsize=7)
    _save(figure, path)


def draw_images(path: Path, images: dict[str, np.ndarray]) -> None:
    """Envelopes (line, sample) side by side, in one grey scale of 50 dB."""
    figure, axes = _figure(1, len(images), 3.4, 3.4)
    loudest = max(np.abs(image).max() for image in images.values())
    for axis, (name, image) in zip(axes[0], images.items(), strict=True):
        level = 20.0 * np.log10(np.abs(image).T / loudest + 1e-9)
        axis.imshow(level, cmap="gray", vmin=-50, vmax=0, aspect="auto")
        axis.set_title(name, fontsize=10)
        axis.set_xlabel("scan line")
    axes[0, 0].set_ylabel("sample")
    _save(figure, path)


def draw_cross_sections(path: Path, volumes: dict[str, Volume], probe_to_ras: np.ndarray, depth_mm: float) -> None:
    """Volumes across a bar: elevational against depth, in the middle of the probe."""
    figure, axes = _figure(1, len(volumes), 3.4, 3.4)
    z, y = np.meshgrid(np.linspace(-6, 6, 160), depth_mm + np.linspace(-6, 6, 160))
    points = np.stack([np.zeros_like(z), y, z, np.ones_like(z)], axis=-1) @ probe_to_ras.T
    for axis, (name, volume) in zip(axes[0], volumes.items(), strict=True):
        axis.imshow(sample(volume, points[..., :3]), cmap="gray", vmin=0, extent=(-6, 6, depth_mm + 6, depth_mm - 6))
        axis.plot(0, depth_mm, "o", color=_OBJECT, fillstyle="none", markersize=9)
        axis.set_title(name, fontsize=10)
        axis.set_xlabel("elevational [mm]")
    axes[0, 0].set_ylabel("depth [mm]")
    _save(figure, path)


def _figure(rows: int, columns: int, width: float, height: float):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(columns * width, rows * height), dpi=100, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def _save(figure, path: Path) -> None:
    with written_whole(path) as partial:
        figure.savefig(partial)
