"""predict: the cost of a fit on images that it has not seen, beside controls (docs/realism.md#fit-and-predict).

A cost on the images that were fitted flatters whatever has many parameters. So parameters found on some images are
judged on others, and the same is done with one uniform tissue without anatomy: fitted to the same images in the same
way, and judged on the same others. The floor is what real neighbours cost, which nothing needs to go below.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.settings import DisplaySettings
from SlicerUSSim.Logic.fitting.control_costs import (
    FITTED,
    NEIGHBOURS,
    UNIFORM,
    Cost,
    Prediction,
    costs_against,
    uniform_tissues,
)
from SlicerUSSim.Logic.fitting.fit_settings import FitSettings
from SlicerUSSim.Logic.fitting.image_similarity import SimilaritySettings
from SlicerUSSim.Logic.fitting.parameters import DISPLAY_BOUNDS, GROUPS, TISSUES, Bounds
from SlicerUSSim.Logic.fitting.search import Progress
from SlicerUSSim.Logic.fitting.tracked_fit import Fit, fit as fit_images, simulated
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.tracked.images import TrackedImages

#: Names of the display that a fit of one tissue takes over as they are
_DISPLAY_NAMES = frozenset((*DISPLAY_BOUNDS, *GROUPS, "display"))


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
    max_evaluations: int = FitSettings().of_search,
    restarts: int = FitSettings.restarts,
    settings: SimilaritySettings | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> Prediction:
    """Judge a fit on images that it has not seen.

    Parameters
    ----------
    found, simulator : a fit, and the simulator that it was made with.
    others : other images of the same recording, at the poses as tracked; a registration moves them as well.
    free, display, speckle, max_evaluations, restarts : as they were for the fit; the uniform tissue is fitted with the
        same, since a cost has several minima.
    neighbours, fitted_neighbours : per image of `others`, and of the fitted ones, real images near it
        (control_costs.neighbours_of); without them there is no floor.

    Raises SimulationError for images that were fitted too, and if no tissue has scatterers.
    """
    both = sorted(set(found.tracked.numbers) & set(others.numbers))
    require(
        not both,
        f"images {', '.join(map(str, both))} are fitted and predicted, expected others: fitted images test nothing",
    )
    others = as_fitted(found, others)
    result = found.appearance
    labels, tissues = uniform_tissues(simulator)
    plain = replace(simulator.settings, partial_volume=False, mri_modulation_db=0.0)
    uniform = UltrasoundSimulator(labels, tissues, plain, simulator.device)
    control = fit_images(
        uniform, found.tracked, free=_free_of_one(free), display=display, speckle=speckle, restarts=restarts,
        max_evaluations=max_evaluations, settings=settings, progress=Progress.named("uniform tissue", progress),
    )  # fmt: skip
    shown = control.appearance
    images = {
        FITTED: simulated(simulator, others, result.tissues, result.display),
        UNIFORM: simulated(uniform, others, shown.tissues, shown.display),
    }
    fitted = {FITTED: found.after, UNIFORM: control.after}

    def costs(sources: Mapping[str, Sequence[np.ndarray]], tracked: TrackedImages, near) -> dict[str, list[Cost]]:
        cost = costs_against(tracked, settings, tracked.mask & tracked.grid.field(tracked.probe))
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


def as_fitted(found: Fit, others: TrackedImages) -> TrackedImages:
    """Other images of the recording at the poses where a fit has them."""
    if found.registration is None:
        return others
    return replace(others, poses=[found.registration.correction @ pose for pose in others.poses])


def _free_of_one(free: Iterable[str] | Mapping[str, Bounds | None]) -> dict[str, Bounds | None]:
    """The free parameters with those of tissues replaced by the one tissue's, by what an image shows of it."""
    entries = dict(free) if isinstance(free, Mapping) else dict.fromkeys([free] if isinstance(free, str) else free)
    shown = {name: bounds for name, bounds in entries.items() if name in _DISPLAY_NAMES}
    return shown if len(shown) == len(entries) and shown else {**shown, TISSUES: None}
