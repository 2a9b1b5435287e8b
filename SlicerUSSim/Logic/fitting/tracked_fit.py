"""fit: fit of simulated to tracked images, with or without registration, with the images before and after."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from SlicerUSSim.Logic.base.settings import DisplaySettings
from SlicerUSSim.Logic.fitting.image_similarity import SimilaritySettings
from SlicerUSSim.Logic.fitting.optimization import AppearanceResult, optimize_appearance
from SlicerUSSim.Logic.fitting.parameters import Bounds
from SlicerUSSim.Logic.fitting.registration import Registration, register_poses
from SlicerUSSim.Logic.fitting.search import Progress
from SlicerUSSim.Logic.fitting.seen import parameters_seen
from SlicerUSSim.Logic.fitting.settings import FitSettings
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tracked.images import TrackedImages

_log = logging.getLogger(__name__)

#: Fraction of the evaluations for a fit before registration.
_FIRST_SHARE = 0.4
#: Successive registrations: bounds (mm and degrees) and evaluations. A fit at wrong poses is biased, and so is the
#: registration after it; later ones start closer.
_ROUNDS = ((8.0, 500), (4.0, 300), (2.0, 250))


@dataclass(frozen=True, eq=False)
class Fit:
    """Fitted parameters and poses, and the images."""

    appearance: AppearanceResult
    #: None without registration
    registration: Registration | None
    #: At the registered poses
    tracked: TrackedImages
    #: (rows, columns) uint8, simulated before and after the fit, with the parameters and poses of each
    before: list[np.ndarray] = field(repr=False)
    after: list[np.ndarray] = field(repr=False)

    def to_dict(self) -> dict:
        """Plain values for JSON."""
        found = {} if self.registration is None else {"registration": self.registration.to_dict()}
        return {**self.appearance.to_dict(), **found, "numbers": self.tracked.numbers}


def fit(
    simulator: UltrasoundSimulator,
    tracked: TrackedImages,
    *,
    free: Iterable[str] | Mapping[str, Bounds | None],
    display: DisplaySettings | None = None,
    register: bool = False,
    max_evaluations: int = FitSettings.evaluations,
    restarts: int = FitSettings.restarts,
    seed: int = 0,
    settings: SimilaritySettings | None = None,
    progress: Callable[[Progress], None] | None = None,
    resume: dict | None = None,
    checkpoint: Callable[[dict], None] | None = None,
) -> Fit:
    """Fit display and tissue parameters (optimization.optimize_appearance) and, with `register`, the poses.

    Registration requires similar images and the fit requires poses. Short fits and registrations therefore alternate,
    followed by the complete fit at the resulting poses. Of the free parameters, "tissues" means those that the images
    can show (seen.py). `resume` and `checkpoint` are those of the complete fit.
    Raises SimulationError as those do.
    """
    display = display or DisplaySettings()
    free = parameters_seen(free, simulator, tracked)
    masks = [tracked.mask] * len(tracked.images)
    given = tracked
    appearance_at = partial(
        optimize_appearance, simulator, tracked.probe, references=tracked.images, free=free, display=display,
        grid=tracked.grid, masks=masks, seed=seed, settings=settings, progress=progress,
    )  # fmt: skip
    registration = None
    if register:
        step_from = partial(
            register_poses, simulator, tracked.probe, references=tracked.images, grid=tracked.grid, masks=masks,
            settings=settings, progress=progress,
        )  # fmt: skip
        short = partial(appearance_at, restarts=0, max_evaluations=max(int(_FIRST_SHARE * max_evaluations), 1))
        tracked, registration = _registered(simulator, tracked, short, step_from)
    appearance = appearance_at(
        tracked.poses, restarts=restarts, max_evaluations=max_evaluations, resume=resume, checkpoint=checkpoint
    )
    before = simulated(simulator, given, simulator.medium.tissues, display)
    after = simulated(simulator, tracked, appearance.tissues, appearance.display)
    return Fit(appearance, registration, tracked, before, after)


def _registered(
    simulator: UltrasoundSimulator,
    tracked: TrackedImages,
    appearance_at: Callable[..., AppearanceResult],
    step_from: Callable[..., Registration],
) -> tuple[TrackedImages, Registration]:
    """The images at the poses where a short fit has the lowest cost, and their registration with its costs.

    `appearance_at` poses is a short fit, `step_from` poses a registration as a function of display and bounds.
    """
    candidates: list[tuple[float, TrackedImages, Registration]] = []
    moved = Registration.none(tracked.poses)

    def fitted() -> AppearanceResult:
        result = appearance_at(tracked.poses)
        candidates.append((result.cost_after, tracked, moved))
        return result

    for bound, most in _ROUNDS:
        first = fitted()
        with simulator.with_tissues(first.tissues):
            step = step_from(
                tracked.poses, display=first.display, range_mm=bound, range_deg=bound, max_evaluations=most
            )
        moved = step.after(moved)
        _log.info(
            "registration within %g mm and degrees: moved by %.2f mm and %.2f degrees in total", bound, moved.shift_mm,
            moved.turn_deg,
        )  # fmt: skip
        tracked = replace(tracked, poses=step.poses)
    fitted()
    cost, best, registration = min(candidates, key=lambda candidate: candidate[0])
    return best, replace(registration, cost_before=candidates[0][0], cost_after=cost)


def simulated(
    simulator: UltrasoundSimulator, tracked: TrackedImages, tissues: TissueTable, display: DisplaySettings
) -> list[np.ndarray]:
    """(rows, columns) uint8 simulated images on the pixels of the tracked ones."""
    with simulator.with_tissues(tissues):
        return [simulator.simulate(tracked.probe, pose, display, tracked.grid).image for pose in tracked.poses]
