"""predict: the cost of a fit on images that it has not seen, beside controls (docs/realism.md#fit-and-predict).

A cost on the images that were fitted flatters whatever has many parameters. So parameters found on some images are
judged on others, and the same is done with one uniform tissue without anatomy: fitted to the same images in the same
way, and judged on the same others. The floor is what real neighbours cost, which nothing needs to go below.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.settings import DisplaySettings
from SlicerUSSim.Logic.fitting.image_similarity import SimilaritySettings, similarity
from SlicerUSSim.Logic.fitting.parameters import DISPLAY_BOUNDS, GROUPS, TISSUES, Bounds
from SlicerUSSim.Logic.fitting.realism import NEIGHBOURS, UNIFORM, Cost, uniform_tissues
from SlicerUSSim.Logic.fitting.search import Progress
from SlicerUSSim.Logic.fitting.settings import FitSettings
from SlicerUSSim.Logic.fitting.texture_costs import TextureReference
from SlicerUSSim.Logic.fitting.tracked_fit import Fit, fit as fit_images, simulated
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.tracked.images import TrackedImages

#: Name of the fit's own images among the sources
FITTED = "simulated"
#: Names of the display that a fit of one tissue takes over as they are
_DISPLAY_NAMES = frozenset((*DISPLAY_BOUNDS, *GROUPS, "display"))


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
        costs = (self.fitted if fitted else self.predicted).get(source, [])
        values = [value for cost in costs if np.isfinite(value := cost.to_dict()[name])]
        return float(np.mean(values)) if values else float("nan")

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


def predict(
    found: Fit,
    simulator: UltrasoundSimulator,
    others: TrackedImages,
    *,
    free: Iterable[str] | Mapping[str, Bounds | None],
    display: DisplaySettings | None = None,
    speckle: bool = False,
    neighbours: Sequence[Sequence[np.ndarray]] | None = None,
    fitted_neighbours: Sequence[Sequence[np.ndarray]] | None = None,
    max_evaluations: int = FitSettings.evaluations,
    settings: SimilaritySettings | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> Prediction:
    """Judge a fit on images that it has not seen.

    Parameters
    ----------
    found, simulator : a fit, and the simulator that it was made with.
    others : other images of the same recording, at the poses as tracked; a registration moves them as well.
    free, display, speckle, max_evaluations : as they were for the fit; the uniform tissue is fitted with the same.
    neighbours, fitted_neighbours : per image of `others`, and of the fitted ones, real images near it
        (realism.neighbours_of); without them there is no floor.

    Raises SimulationError for images that were fitted too, and if no tissue has scatterers.
    """
    both = sorted(set(found.tracked.numbers) & set(others.numbers))
    require(
        not both,
        f"images {', '.join(map(str, both))} are fitted and predicted, expected others: what was fitted says little",
    )
    if found.registration is not None:
        others = replace(others, poses=[found.registration.correction @ pose for pose in others.poses])
    result = found.appearance
    labels, tissues = uniform_tissues(simulator)
    plain = replace(simulator.settings, partial_volume=False, mri_modulation_db=0.0)
    uniform = UltrasoundSimulator(labels, tissues, plain, simulator.device)
    control = fit_images(
        uniform, found.tracked, free=_free_of_one(free), display=display, speckle=speckle, restarts=0,
        max_evaluations=max_evaluations, settings=settings, progress=progress,
    )  # fmt: skip
    shown = control.appearance
    images = {
        FITTED: simulated(simulator, others, result.tissues, result.display),
        UNIFORM: simulated(uniform, others, shown.tissues, shown.display),
    }
    fitted = {FITTED: found.after, UNIFORM: control.after}

    def costs(sources: Mapping[str, Sequence[np.ndarray]], tracked: TrackedImages, near) -> dict[str, list[Cost]]:
        cost = _costs_against(tracked, settings or SimilaritySettings())
        table = {name: [cost(image, n) for n, image in enumerate(each)] for name, each in sources.items()}
        if near is not None:
            table[NEIGHBOURS] = [cost(image, n) for n, beside in enumerate(near) for image in beside]
        return table

    return Prediction(
        list(found.tracked.numbers),
        list(others.numbers),
        costs(fitted, found.tracked, fitted_neighbours),
        costs(images, others, neighbours),
        images,
    )


def _costs_against(tracked: TrackedImages, settings: SimilaritySettings) -> Callable[[np.ndarray, int], Cost]:
    spacing, inside = tracked.grid.pixel_spacing_mm, tracked.mask & tracked.grid.field(tracked.probe)
    references = [TextureReference(image, spacing, tracked.mask) for image in tracked.images]

    def cost(image: np.ndarray, number: int) -> Cost:
        paper = similarity(
            image, tracked.images[number], spacing, patch_mm=settings.patch_mm, bins=settings.bins,
            sad_weight=settings.sad_weight, mask=inside,
        )  # fmt: skip
        return Cost(paper, references[number].misfit(image))

    return cost


def _free_of_one(free: Iterable[str] | Mapping[str, Bounds | None]) -> dict[str, Bounds | None]:
    """The free parameters with those of tissues replaced by the one tissue's, by what an image shows of it."""
    entries = dict(free) if isinstance(free, Mapping) else dict.fromkeys([free] if isinstance(free, str) else free)
    shown = {name: bounds for name, bounds in entries.items() if name in _DISPLAY_NAMES}
    return shown if len(shown) == len(entries) and shown else {**shown, TISSUES: None}
