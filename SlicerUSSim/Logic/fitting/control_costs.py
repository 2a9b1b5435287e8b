"""Costs of simulated images against real ones, and the controls beside them (docs/realism.md).

A cost alone says little: one uniform tissue without anatomy reaches that of many a simulation. So it is given beside

- *real neighbours*: the images before and after in the recording, the floor that nothing needs to go below;
- *uniform tissue*: one tissue instead of all, at the gain that gives it the real images' mean grey level.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.settings import DisplaySettings
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.fitting.appearance import AppearanceModel
from SlicerUSSim.Logic.fitting.image_similarity import Similarity, SimilaritySettings, similarity
from SlicerUSSim.Logic.fitting.texture_costs import TextureMisfit, TextureReference
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tracked.images import TrackedImages
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence

#: Names of the fit's own images and of the controls
FITTED, NEIGHBOURS, UNIFORM = "simulated", "real neighbours", "uniform tissue"
#: Between which the gain of the uniform control is looked for
_GAINS_DB = -80.0, 80.0


@dataclass(frozen=True)
class Cost:
    """Costs of one image against another."""

    paper: Similarity
    texture: TextureMisfit

    @property
    def total(self) -> float:
        """The paper's cost + T1 + T2 / 2."""
        return self.paper.total + self.texture.total

    def to_dict(self) -> dict[str, float]:
        """Plain values; NaN where an image has too few grains for T1 or T2."""
        return {"paper": self.paper.total, "t1": self.texture.autocorrelation, "t2": self.texture.extrema,
                "sum": self.total}  # fmt: skip


def mean_cost(costs: Iterable[Cost]) -> dict[str, float]:
    """Mean of "paper", "t1", "t2" and "sum"; NaN where no image has one."""
    rows = [cost.to_dict() for cost in costs]
    found = {}
    for name in ("paper", "t1", "t2", "sum"):
        known = [row[name] for row in rows if np.isfinite(row[name])]
        found[name] = float(np.mean(known)) if known else float("nan")
    return found


def costs_against(
    tracked: TrackedImages, settings: SimilaritySettings | None = None, mask: np.ndarray | None = None
) -> Callable[[np.ndarray, int], Cost]:
    """A function of an image (rows, columns) uint8 and the place of a real image in `tracked`: their cost.

    `mask` (rows, columns) bool is where the paper's cost is taken (default: that of `tracked`).
    """
    settings, spacing = settings or SimilaritySettings(), tracked.grid.pixel_spacing_mm
    references = [TextureReference(image, spacing, tracked.mask) for image in tracked.images]

    def cost(image: np.ndarray, place: int) -> Cost:
        paper = similarity(
            image, tracked.images[place], spacing, patch_mm=settings.patch_mm, bins=settings.bins,
            sad_weight=settings.sad_weight, mask=tracked.mask if mask is None else mask,
        )  # fmt: skip
        return Cost(paper, references[place].misfit(image))

    return cost


def control_costs(
    tracked: TrackedImages,
    images: Sequence[np.ndarray],
    simulator: UltrasoundSimulator,
    display: DisplaySettings,
    neighbours: Sequence[Sequence[np.ndarray]] | None = None,
) -> dict[str, list[Cost]]:
    """{source: costs against the real images} of simulated images, one per real image, and of the controls.

    `neighbours` are, per real image, real images near it (neighbours_of). Raises SimulationError if no tissue of the
    simulator's volume has scatterers.
    """
    cost = costs_against(tracked)
    sources = {FITTED: images, UNIFORM: uniform_control(simulator, tracked, display)}
    found = {name: [cost(image, place) for place, image in enumerate(each)] for name, each in sources.items()}
    if neighbours is not None:
        found[NEIGHBOURS] = [cost(image, place) for place, others in enumerate(neighbours) for image in others]
    return found


def neighbours_of(sequence: TrackedSequence, tracked: TrackedImages) -> list[list[np.ndarray]]:
    """The real images before and after each of `tracked` in its recording, cropped to its field.

    Those that are equal to it, as where a recording repeats images, are left out.
    """
    found = []
    for number, own in zip(tracked.numbers, tracked.images, strict=True):
        beside = [n for n in (number - 1, number + 1) if 0 <= n < len(sequence)]
        images = [np.ascontiguousarray(sequence.images[n][tracked.field.window]).astype(np.uint8) for n in beside]
        found.append([image for image in images if not np.array_equal(image, own) and image.any()])
    return found


def uniform_tissues(simulator: UltrasoundSimulator) -> tuple[Volume, TissueTable]:
    """Labels and tissues of the control without anatomy: all that is not coupling is the tissue that fills most.

    Raises SimulationError if no tissue of the volume has scatterers.
    """
    labels, tissues = simulator.medium.labels, simulator.medium.tissues
    most = [int(n) for n in simulator.medium.present if n and tissues[int(n)].scatterer_variance > 0.0]
    require(bool(most), "no tissue of the volume has scatterers, expected one for the uniform control")
    return (
        Volume(np.where(labels.array > 0, most[0], 0).astype(np.uint8), labels.ijk_to_ras),
        TissueTable({0: tissues[0], most[0]: tissues[most[0]]}),
    )


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
