"""Figures of MRI, labels and B-mode in the image plane, with a millimetre scale."""

from __future__ import annotations

import base64
import importlib.util
import io
import os

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.files import written_whole
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.tissue.presets import colour_of

_BACKGROUND, _INK, _OUTLINE = "#111111", "#dddddd", "#ffc83d"


def draw_views(
    path: str | os.PathLike,
    views: list[tuple[str, np.ndarray, str]],
    probe: Probe,
    bounds_mm: tuple[float, float, float, float],
    tissue_names: tuple[str, ...] = (),
) -> None:
    """Write a PNG with the given views side by side; on failure an existing file is kept.

    Parameters
    ----------
    views : (title, image (rows, columns), kind) with kind "mri", "labels" or "bmode".
    bounds_mm : (left, right, top, bottom) of all of them in the probe frame.
    tissue_names : of labels 1, 2, ...; for their colours and the legend.

    Raises SimulationError without matplotlib and if the file cannot be written.
    """
    require_matplotlib()
    from matplotlib import patches
    from matplotlib.figure import Figure

    left, right, top, bottom = bounds_mm
    height = 5.0
    width = height * (right - left) / (bottom - top)
    size = (len(views) * (width + 0.35) + 0.5, height + 0.75)
    figure = Figure(figsize=size, facecolor=_BACKGROUND, dpi=110, layout="constrained")
    axes = figure.subplots(1, len(views), squeeze=False)[0]
    for axis, (title, image, kind) in zip(axes, views, strict=True):
        extent = (left, right, bottom, top)
        if kind == "labels":
            from matplotlib.colors import ListedColormap

            colours = ListedColormap(["black", *map(colour_of, tissue_names)])
            axis.imshow(image, cmap=colours, vmin=-0.5, vmax=colours.N - 0.5, extent=extent, interpolation="nearest")
            handles = [patches.Patch(color=colour_of(name), label=name) for name in tissue_names]
            axis.legend(
                handles=handles, loc="lower left", fontsize=7, framealpha=0.6, facecolor=_BACKGROUND, labelcolor=_INK
            )
        else:
            tissue = image[image > 0]
            white = float(np.percentile(tissue, 99.8)) if kind == "mri" and tissue.size else 255.0
            axis.imshow(image, cmap="gray", vmin=0, vmax=white, extent=extent, interpolation="bilinear")
        if kind != "bmode":
            outline = probe.outline_mm()
            axis.plot(outline[:, 0], outline[:, 1], color=_OUTLINE, linewidth=1.2)
        _scale_bar(axis, right, bottom)
        axis.set_title(title, color=_INK, fontsize=11)
        axis.set_xlim(left, right)
        axis.set_ylim(bottom, top)
        axis.set_facecolor("black")
        axis.tick_params(colors=_INK, labelsize=8)
        for spine in axis.spines.values():
            spine.set_color("#555555")
        axis.set_xlabel("lateral [mm]", color=_INK, fontsize=8)
    axes[0].set_ylabel("depth [mm]", color=_INK, fontsize=8)
    save_figure(path, figure, _BACKGROUND)


def save_figure(path: str | os.PathLike, figure, background: str) -> None:
    """Write a matplotlib figure as PNG; on failure an existing file is kept."""
    with written_whole(path) as partial:
        figure.savefig(partial, format="png", facecolor=background)


def write_png(path: str | os.PathLike, image: np.ndarray) -> None:
    """Write a (rows, columns) uint8 image unchanged as PNG; on failure an existing file is kept."""
    from PIL import Image

    with written_whole(path) as partial:
        Image.fromarray(image).save(partial, "PNG")


def png_url(image: np.ndarray) -> str:
    """An image (rows, columns) or (rows, columns, 3) uint8 as a data URL, for a page that needs no other file."""
    from PIL import Image

    data = io.BytesIO()
    Image.fromarray(image).save(data, "PNG", optimize=True)
    return data_url(data.getvalue())


def data_url(png: bytes) -> str:
    """The content of a PNG file as a data URL."""
    return "data:image/png;base64," + base64.b64encode(png).decode()


def _scale_bar(axis, right: float, bottom: float) -> None:
    from matplotlib.patheffects import withStroke

    y = 0.96 * bottom
    outline = [withStroke(linewidth=4.5, foreground="black")]  # for readability on bright tissue
    axis.plot([right - 13.0, right - 3.0], [y, y], color="white", linewidth=2.5, path_effects=outline)
    axis.text(right - 8.0, y - 1.0, "10 mm", color="white", fontsize=7, ha="center", va="bottom", path_effects=outline)


def require_matplotlib() -> None:
    """Raise SimulationError with the package to install if matplotlib is missing."""
    if importlib.util.find_spec("matplotlib") is None:
        raise SimulationError('figures need matplotlib; install it with: pip install "SlicerUSSim[demo]"')
