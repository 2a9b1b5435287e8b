"""Costs of simulated images against real ones, and the controls beside them (docs/realism.md).

A cost alone says little: one uniform tissue without anatomy reaches that of many a simulation. So it is given beside

- *real neighbours*: the images before and after in the recording, the floor that nothing needs to go below;
- *uniform tissue*: one tissue instead of all.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.fitting.image_similarity import Similarity, SimilaritySettings, similarity
from SlicerUSSim.Logic.fitting.texture_costs import TextureMisfit, TextureReference
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tracked.images import TrackedImages
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence

#: Names of the fit's own images and of the controls
FITTED, NEIGHBOURS, UNIFORM = "simulated", "real neighbours", "uniform tissue"


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


@dataclass(frozen=True, eq=False)
class Prediction:
    """Costs of a fit and of its controls, on the images that were fitted and on others."""

    #: Numbers of the images in the recording
    fitted_numbers: list[int]
    numbers: list[int]
    #: {source: costs}; of the simulated images and the uniform tissue one per image, of real neighbours up to two
    fitted: dict[str, list[Cost]]
    predicted: dict[str, list[Cost]]
    #: {source: (rows, columns) uint8 images of `numbers`}
    images: dict[str, list[np.ndarray]] = field(repr=False)

    def mean(self, source: str, name: str = "paper", *, fitted: bool = False) -> float:
        """Mean of a source's "paper", "t1", "t2" or "sum"; NaN where there is none."""
        return mean_cost((self.fitted if fitted else self.predicted).get(source, []))[name]

    @property
    def of_uniform(self) -> float:
        """The predicted images' cost as a part of the uniform tissue's: below 1, the anatomy tells something."""
        return self.mean(FITTED) / self.mean(UNIFORM)

    def rows(self) -> list[tuple[str, float, float, float, float]]:
        """(source, the paper's cost and the sum on the fitted images, the same on the predicted ones)."""
        return [
            (
                source, self.mean(source, fitted=True), self.mean(source, "sum", fitted=True), self.mean(source),
                self.mean(source, "sum"),
            )
            for source in self.predicted
        ]  # fmt: skip

    def lines(self) -> list[str]:
        """A table as lines of text, and what it says."""
        listed = [", ".join(map(str, numbers)) for numbers in (self.fitted_numbers, self.numbers)]
        found = [f"cost (with texture)   fitted: images {listed[0]}   predicted: images {listed[1]}"]
        found += [
            f"{source:20s}  {row[0]:.3f} ({row[1]:.3f})   {row[2]:.3f} ({row[3]:.3f})" for source, *row in self.rows()
        ]
        return [*found, f"predicted images cost {self.of_uniform:.2f} of the uniform tissue's"]

    def to_dict(self) -> dict:
        """Plain values for JSON; what could not be measured is None."""

        def plain(costs: dict[str, list[Cost]]) -> dict:
            return {
                source: [
                    {name: value if np.isfinite(value) else None for name, value in cost.to_dict().items()}
                    for cost in each
                ]
                for source, each in costs.items()
            }

        return {
            "fitted_images": self.fitted_numbers,
            "images": self.numbers,
            "of_uniform": self.of_uniform if np.isfinite(self.of_uniform) else None,
            "fitted": plain(self.fitted),
            "predicted": plain(self.predicted),
        }
