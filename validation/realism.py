"""How much simulated images are like tracked real ones, with controls beside them (docs/realism.md).

    python -m validation.realism MRI_OR_LABELS --sequence tracked.igs.mha [--preset P] [--json FILE] [--picture FILE]

takes the options of `ussim sweep`, and prints costs, speckle, grey levels and sheets. `measure_realism` is the same in
Python.

A cost alone says little: one uniform tissue without anatomy reaches that of many a simulation, and a blurred real image
is closer by the paper's cost than any. So the same numbers are given for

- *real neighbours*: the images before and after in the recording, the floor that nothing needs to go below;
- *real, blurred* by 2 pixels: what a cost that sees speckle must refuse;
- *uniform tissue*: one tissue instead of all, at the gain that gives it the real images' mean grey level;
- *uniform, real level*: its speckle on the real images' own local mean (Gaussian, sigma 5 mm): what other speckle
  costs where the level of everything is known.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import click
import numpy as np
from scipy import ndimage

from SlicerUSSim.Command.cli import ToolCommand
from SlicerUSSim.Command.options import check_outputs, gathered, overwrite_option
from SlicerUSSim.Command.patient_options import PatientOptions
from SlicerUSSim.Command.progress import note
from SlicerUSSim.Command.sequence_options import SequenceOptions, open_tracked
from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.files import write_json, written_whole
from SlicerUSSim.Logic.base.settings import DisplaySettings
from SlicerUSSim.Logic.fitting.appearance import AppearanceModel
from SlicerUSSim.Logic.fitting.control_costs import (
    NEIGHBOURS,
    UNIFORM,
    Cost,
    costs_against,
    mean_cost,
    neighbours_of,
    uniform_tissues,
)
from SlicerUSSim.Logic.fitting.speckle_width import HALF_HEIGHT_PER_SIGMA, SpeckleWidth, speckle_widths
from SlicerUSSim.Logic.fitting.tracked_fit import simulated
from SlicerUSSim.Logic.imaging.grey_map import EstimatedMap, estimate_grey_map
from SlicerUSSim.Logic.imaging.medium import Medium
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.probe.poses import slice_under_probe
from SlicerUSSim.Logic.tracked.images import TrackedImages
from validation.grey_statistics import (
    TissueGrey,
    extrema_density_cm2,
    grey_of_tissues,
    histogram_misfit,
    less_local_mean,
    level_by_depth,
)
from validation.sheet_contrast import (
    LineContrast,
    LinePoints,
    line_contrast,
    sheet_points,
    surfel_points,
    wall_points,
)

#: Title, heads, and rows with one text per head
Table: TypeAlias = tuple[str, list[str], list[list[str]]]

#: Default number of images
_MOST_IMAGES = 6
#: Names of the sources that are always there
REAL, BLURRED, LEVELLED = "real", "real, blurred", "uniform, real level"
#: Bounds of the gain of the uniform control
_GAINS_DB = -80.0, 80.0
_CONTROLS = (REAL, NEIGHBOURS, BLURRED, UNIFORM, LEVELLED)
#: Sigma of the blurred control, pixels
BLUR_PIXELS = 2.0
#: Depths of the speckle's width, parts of the image depth
_DEPTH_SHARES = (0.33, 0.5, 0.7, 0.92)
#: Tissues whose borders are walls, and thin ones that are sheets, where the labels have them
_WALLS, _SHEETS = ("csf",), ("falx", "tentorium")


def control_named(name: str, reference: str) -> str:
    """The name of a source where the real images are called `reference`, such as those of a twin."""
    return name.replace(REAL, reference) if name in _CONTROLS else name


@dataclass(frozen=True, eq=False)
class Looks:
    """Statistics of the images of one source."""

    #: One per depth
    widths: list[SpeckleWidth]
    #: Local maxima per cm² within 8 mm of each of these depths
    maxima_per_cm2: list[float]
    tissues: dict[str, TissueGrey]
    #: (bands,) mm, and (bands,) mean grey levels
    depth_mm: np.ndarray = field(repr=False)
    level: np.ndarray = field(repr=False)
    #: {name of the tissue: by angle to the beam}
    lines: dict[str, list[LineContrast]]
    #: None where the images have too few grey levels
    grey_map: EstimatedMap | None

    def to_dict(self) -> dict:
        """Plain values for JSON."""
        return {
            "widths": [vars(w) for w in self.widths],
            "maxima_per_cm2": self.maxima_per_cm2,
            "tissues": {name: grey.to_dict() for name, grey in self.tissues.items()},
            "level": {"depth_mm": self.depth_mm.tolist(), "grey": self.level.tolist()},
            "grey_map": self.grey_map
            and {
                "grey": self.grey_map.level.tolist(),
                "slope": self.grey_map.slope.tolist(),
                **self.grey_map.changes(),
            },
            "lines": {name: [vars(line) for line in lines] for name, lines in self.lines.items()},
        }


@dataclass(frozen=True, eq=False)
class Realism:
    """Costs and looks of several sources of images, of which the first is the real one."""

    #: Numbers of the real images in the recording
    numbers: list[int]
    #: {source: costs against every real image}; none for the real images themselves
    costs: dict[str, list[Cost]]
    looks: dict[str, Looks]
    #: {source: (rows, columns) uint8 images}
    images: dict[str, list[np.ndarray]] = field(repr=False)

    def mean(self, source: str) -> dict[str, float]:
        """Mean over the images of "paper", "t1", "t2" and "sum" of a source; NaN where no image has one."""
        return mean_cost(self.costs[source])

    def to_dict(self) -> dict:
        """Plain values for JSON; what could not be measured is None."""
        return _without_nan(
            {
                "images": self.numbers,
                "costs": {
                    name: {"mean": self.mean(name), "images": [cost.to_dict() for cost in costs]}
                    for name, costs in self.costs.items()
                },
                "looks": {name: looks.to_dict() for name, looks in self.looks.items()},
            }
        )

    def tables(self, reference: str = REAL) -> list[Table]:
        """(title, heads, rows) of texts, for reports and terminals; `reference` is what the real images are called."""
        real, shown = self.looks[REAL], partial(control_named, reference=reference)
        costs = [
            [shown(name), *(_text(self.mean(name)[key], 3) for key in ("paper", "t1", "t2", "sum"))]
            for name in self.costs
        ]
        tables = [(f"Costs against the {reference} images", ["images", "paper's", "T1", "T2", "sum"], costs)]
        depths = [f"{width.depth_mm:.0f} mm" for width in real.widths]
        widths = [
            [
                shown(name),
                *(
                    f"{_text(HALF_HEIGHT_PER_SIGMA * w.axial_mm)} / {_text(HALF_HEIGHT_PER_SIGMA * w.lateral_mm)}"
                    for w in looks.widths
                ),
            ]
            for name, looks in self.looks.items()
        ]
        tables.append(("Width of the speckle at half height, axial / lateral, mm", ["depth", *depths], widths))
        maxima = [[shown(name), *(_text(m, 0) for m in looks.maxima_per_cm2)] for name, looks in self.looks.items()]
        tables.append(("Local maxima per cm²", ["depth", *depths], maxima))
        for tissue in real.tissues:
            rows = [
                [
                    shown(name), _text(grey.mean, 0), _text(grey.deviation, 1), f"{grey.skewness:+.2f}",
                    f"{grey.percentile_1:+.0f}", f"{grey.percentile_99:+.0f}", _text(grey.maxima_per_cm2, 0),
                    _text(histogram_misfit(grey, real.tissues[tissue])),
                ]
                for name, looks in self.looks.items()
                if (grey := looks.tissues.get(tissue)) is not None
            ]  # fmt: skip
            heads = ["images", "mean", "deviation", "skewness", "1 %", "99 %", "maxima/cm²", "histogram misfit"]
            tables.append((f"Grey levels of {tissue}; all but the mean less the local mean", heads, rows))
        half = 0.5 * (real.depth_mm[1] - real.depth_mm[0]) if len(real.depth_mm) > 1 else 0.0
        greys = (15, 30, 45, 60, 80, 100, 160, 200)
        maps = [
            [shown(name), *(_text(looks.grey_map.at(grey)) for grey in greys)]
            for name, looks in self.looks.items()
            if looks.grey_map is not None
        ]
        tables.append(("Slope of the grey map relative to that at 130", ["grey level", *map(str, greys)], maps))
        level_heads = ["depth, mm", *(f"{d - half:.0f}-{d + half:.0f}" for d in real.depth_mm)]
        level = [[shown(name), *(_text(g, 0) for g in looks.level)] for name, looks in self.looks.items()]
        tables.append(("Mean grey level", level_heads, level))
        for tissue in real.lines:
            rows = [
                [
                    shown(name), f"{line.angle_deg[0]}-{line.angle_deg[1]}°", str(line.points), _text(line.contrast, 0),
                    _text(line.chance, 0), _text(line.width_mm),
                ]
                for name, looks in self.looks.items()
                for line in looks.lines.get(tissue, [])
            ]  # fmt: skip
            heads = ["images", "normal to beam", "points", "contrast", "by chance", "width mm"]
            tables.append((f"Line of {tissue}", heads, rows))
        return tables


def measure_realism(
    tracked: TrackedImages,
    simulated: Mapping[str, Sequence[np.ndarray]],
    simulator: UltrasoundSimulator,
    *,
    neighbours: Sequence[Sequence[np.ndarray]] | None = None,
    display: DisplaySettings | None = None,
) -> Realism:
    """Compare simulated images with the real ones, beside the controls.

    Parameters
    ----------
    tracked : the real images, with probe and poses.
    simulated : {name: (rows, columns) uint8 images, one per real image}.
    simulator : its labels say which pixels are of which tissue, and where sheets and walls are; it also simulates the
        uniform tissue.
    neighbours : per real image, other real images near it (neighbours_of); none: without that control.
    display : of the uniform tissue, except for its gain.

    Raises SimulationError for numbers or shapes that differ, and for a name of a control.
    """
    for name, images in simulated.items():
        require(name not in _CONTROLS, f"{name!r} is the name of a control, expected others")
        require(
            len(images) == len(tracked.images),
            f"{len(images)} images of {name} and {len(tracked.images)} real ones, expected equal numbers",
        )
    sources: dict[str, list[np.ndarray]] = {REAL: list(tracked.images)}
    sources |= {name: list(images) for name, images in simulated.items()}
    sources[UNIFORM] = uniform_control(simulator, tracked, display or DisplaySettings())
    sources[LEVELLED] = [
        at_level_of(image, real, tracked) for image, real in zip(sources[UNIFORM], tracked.images, strict=True)
    ]
    sources[BLURRED] = [blurred(image) for image in tracked.images]
    cost = costs_against(tracked)
    costs = {name: [cost(i, n) for n, i in enumerate(images)] for name, images in sources.items() if name != REAL}
    if neighbours is not None:
        costs[NEIGHBOURS] = [cost(image, n) for n, others in enumerate(neighbours) for image in others]
    regions = [slice_under_probe(simulator.medium.labels, tracked.grid, pose, order=0) for pose in tracked.poses]
    looks = {name: _looks_of(images, tracked, regions, simulator.medium) for name, images in sources.items()}
    return Realism(tracked.numbers, costs, looks, sources)


def draw_sources(path: str | os.PathLike, found: Realism) -> None:
    """Write a PNG of the images of all sources, one row per real image, at their own pixels; names above them.

    On failure an existing file is kept. Raises SimulationError if the file cannot be written.
    """
    from PIL import Image, ImageDraw

    names = list(found.images)
    rows, columns = found.images[REAL][0].shape
    gap, head = 4, 16
    picture = Image.new("L", (len(names) * (columns + gap), len(found.numbers) * (rows + head)))
    draw = ImageDraw.Draw(picture)
    for place, name in enumerate(names):
        for line, (number, image) in enumerate(zip(found.numbers, found.images[name], strict=True)):
            corner = place * (columns + gap), line * (rows + head)
            picture.paste(Image.fromarray(image), (corner[0], corner[1] + head))
            draw.text((corner[0] + 4, corner[1] + 2), f"{name}, image {number}", fill=255)
    with written_whole(path) as partial:
        picture.save(partial, "PNG")


def blurred(image: np.ndarray) -> np.ndarray:
    """(rows, columns) uint8 blurred by a Gaussian of 2 pixels."""
    smooth = ndimage.gaussian_filter(np.asarray(image, np.float32), BLUR_PIXELS)
    return np.clip(np.rint(smooth), 0, 255).astype(np.uint8)


def uniform_control(
    simulator: UltrasoundSimulator, tracked: TrackedImages, display: DisplaySettings
) -> list[np.ndarray]:
    """(rows, columns) uint8 images of one uniform tissue at the poses, with the real images' mean grey level."""
    labels, tissues = uniform_tissues(simulator)
    settings = replace(simulator.settings, partial_volume=False, mri_modulation_db=0.0)
    uniform = UltrasoundSimulator(labels, tissues, settings, simulator.device)
    # Without free tissues it keeps the echoes of every pose, so that only the display is computed again
    model = AppearanceModel(uniform, tracked.probe, tracked.poses, {}, tracked.grid)
    wanted = float(np.mean([image[tracked.mask].mean() for image in tracked.images]))

    def at(gain_db: float) -> list[np.ndarray]:
        shown = replace(display, gain_db=gain_db)
        return [model.image(number, tissues, shown) for number in range(len(tracked.poses))]

    low, high = _GAINS_DB
    for _ in range(12):  # to 0.04 dB
        middle = 0.5 * (low + high)
        if np.mean([image[tracked.mask].mean() for image in at(middle)]) < wanted:
            low = middle
        else:
            high = middle
    return at(0.5 * (low + high))


def at_level_of(image: np.ndarray, real: np.ndarray, tracked: TrackedImages) -> np.ndarray:
    """(rows, columns) uint8 image with the local mean (less_local_mean) of a real one instead of its own."""
    levelled = real + (
        less_local_mean(image, tracked.grid, tracked.mask) - less_local_mean(real, tracked.grid, tracked.mask)
    )
    return np.clip(np.rint(levelled), 0, 255).astype(np.uint8)


@click.command(cls=ToolCommand)
@gathered(patient=PatientOptions, recording=SequenceOptions)
@click.option("--json", "out", type=click.Path(path_type=Path), help="All numbers: .json")
@click.option("--picture", type=click.Path(path_type=Path), help="Real and simulated images and controls: .png")
@overwrite_option
def main(patient: PatientOptions, recording: SequenceOptions, out: Path | None, picture: Path | None) -> None:
    """Measure how much simulated images are like tracked real ones: costs, speckle, grey levels, sheets."""
    check_outputs(out, picture, recording.field)
    tracked = open_tracked(patient, recording, most=_MOST_IMAGES)
    simulator, display, real = tracked.examination.simulator, tracked.examination.display, tracked.images
    images = simulated(simulator, real, simulator.medium.tissues, display)
    found = measure_realism(
        real, {"simulated": images}, simulator, neighbours=neighbours_of(tracked.sequence, real), display=display
    )
    if out:
        write_json(out, found.to_dict())
    if picture:
        draw_sources(picture, found)
    for title, heads, rows in found.tables():
        click.echo(f"\n{title}")
        widths = [max(len(row[n]) for row in [heads, *rows]) for n in range(len(heads))]
        for row in [heads, *rows]:
            click.echo(
                "  ".join([row[0].ljust(widths[0]), *(t.rjust(w) for t, w in zip(row[1:], widths[1:], strict=True))])
            )
    written = [place for place in (out, picture, recording.field) if place]
    if written:
        note("wrote " + ", ".join(map(str, written)))


def _looks_of(
    images: Sequence[np.ndarray], tracked: TrackedImages, regions: Sequence[np.ndarray], medium: Medium
) -> Looks:
    probe, grid, mask = tracked.probe, tracked.grid, tracked.mask & tracked.grid.field(tracked.probe)
    depths = [share * probe.depth_mm for share in _DEPTH_SHARES]
    away = _depth_of_pixels(tracked)
    maxima = []
    for depth in depths:
        where = mask & (np.abs(away - depth) <= 8.0)
        maxima.append(_mean([extrema_density_cm2(image, grid, where) for image in images]))
    names, sheets = {label: tissue.name for label, tissue in medium.tissues.items() if label}, medium.sheets
    lines: dict[str, list[LinePoints]] = {}
    for wanted, points_of in ((_WALLS, wall_points), (_SHEETS, sheet_points)):
        for name in wanted:
            chosen = [label for label, other in names.items() if other == name]
            if chosen:
                lines[name] = [points_of(region, chosen, grid) for region in regions]
    for name in _SHEETS:
        of_kind = None if sheets is None else sheets.of_kind(name)
        if of_kind:
            lines[f"{name} that was found"] = [surfel_points(of_kind, pose, grid) for pose in tracked.poses]
    contrasts = {name: line_contrast(images, points, probe, grid, mask) for name, points in lines.items()}
    band_mm, level = level_by_depth(images, probe, grid, mask)
    return Looks(
        speckle_widths(images, probe, grid, depths, mask),
        maxima,
        grey_of_tissues(images, regions, names, grid, mask),
        band_mm,
        level,
        {name: found for name, found in contrasts.items() if found},
        _grey_map_of(images, tracked),
    )


def _grey_map_of(images: Sequence[np.ndarray], tracked: TrackedImages) -> EstimatedMap | None:
    try:
        return estimate_grey_map(images, tracked.grid.pixel_spacing_mm, tracked.mask)
    except SimulationError:
        return None


def _depth_of_pixels(tracked: TrackedImages) -> np.ndarray:
    grid, probe = tracked.grid, tracked.probe
    x = grid.left_mm + grid.pixel_spacing_mm[0] * (np.arange(grid.columns) + 0.5)[None, :]
    y = grid.top_mm + grid.pixel_spacing_mm[1] * (np.arange(grid.rows) + 0.5)[:, None]
    if probe.is_linear:
        return y + 0.0 * x
    return np.hypot(x, y + probe.apex_radius_mm) - probe.apex_radius_mm


def _mean(values: Sequence[float]) -> float:
    """Mean of what is a number; NaN for none."""
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else float("nan")


def _text(value: float, decimals: int = 2) -> str:
    return f"{value:.{decimals}f}" if np.isfinite(value) else "–"


def _without_nan(values: Any) -> Any:
    if isinstance(values, dict):
        return {name: _without_nan(value) for name, value in values.items()}
    if isinstance(values, list | tuple):
        return [_without_nan(value) for value in values]
    return None if isinstance(values, float) and not np.isfinite(values) else values


if __name__ == "__main__":
    main(prog_name="python -m validation.realism")
