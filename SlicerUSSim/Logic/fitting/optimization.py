"""optimize_appearance: fit of display and tissue parameters to real images.

A global search is followed by a local one. Then the bases are recomputed there (appearance.py) and the local search
continues, until a new anchor no longer changes the cost (docs/optimization.md#search). All evaluations use the same
seed for scatterers and noise (common random numbers), so the cost is a deterministic function: the same problem gives
the same result.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter

import numpy as np

from SlicerUSSim.Logic.base.errors import require_between
from SlicerUSSim.Logic.base.settings import DisplaySettings
from SlicerUSSim.Logic.fitting.appearance import AppearanceModel
from SlicerUSSim.Logic.fitting.fit_settings import AGAIN_SHARE, DRAWS, RESTART_SHARE, FitSettings
from SlicerUSSim.Logic.fitting.identifiability import (
    Identifiability,
    State,
    Units,
    equal_variance_draws,
    quantities_of,
)
from SlicerUSSim.Logic.fitting.image_similarity import Similarity, SimilaritySettings, mean_total, target_comparisons
from SlicerUSSim.Logic.fitting.parameters import ECHOGENICITY, Bounds, FreeParameters
from SlicerUSSim.Logic.fitting.search import (
    GLOBAL_ALGORITHM,
    LOCAL_ALGORITHM,
    Evaluation,
    Progress,
    Search,
)
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.tissue.table import TissueTable

_log = logging.getLogger(__name__)

#: Stages of the search; they are followed by "redraw n", "restart n", AGAIN and "draw".
STAGES = ("global", "local", "polish")
#: A search from the best restart, where that fits better
AGAIN = "again"
#: Fractions of the evaluations for the first two; the rest is for the search after the anchor has changed.
_SHARES = (0.4, 0.3)
#: Standard deviation of the starting points of restarts around the best, with bounds scaled to 0 and 1.
_RESTART_SPREAD = 0.15
#: Costs that differ by less than this fraction are considered equal, even if other speckle changes them by less.
_LEAST_TOLERANCE = 0.01
#: Evaluations for the level of a tissue alone, and their steps, in parts of its bounds (2 of 24 dB)
_FOR_A_LEVEL, _LEVEL_STEP = 4, 1.0 / 12.0


@dataclass(frozen=True, eq=False)
class AppearanceResult:
    """Result of an optimisation."""

    tissues: TissueTable
    display: DisplaySettings
    parameters: FreeParameters
    #: {parameter name: value} at the start and at the end
    before: dict[str, float]
    after: dict[str, float]
    #: Mean over the images, from full simulations
    cost_before: float
    cost_after: float
    #: Of each image
    similarity_before: list[Similarity]
    similarity_after: list[Similarity]
    history: list[Evaluation] = field(repr=False)
    seconds: float
    identifiability: Identifiability = field(repr=False)

    @property
    def evaluations(self) -> int:
        """Number of evaluations of the cost."""
        return len(self.history)

    @property
    def at_bounds(self) -> list[str]:
        """Names of parameters that ended at one of their bounds; wider bounds might give a better fit."""
        return [p.name for p in self.parameters if not 0.005 < p.unit(self.after[p.name]) < 0.995]

    def to_dict(self) -> dict:
        """Plain values for JSON."""
        return {
            "at_bounds": self.at_bounds,
            "parameters": [
                {"name": p.name, "low": p.low, "high": p.high, "before": self.before[p.name],
                 "after": self.after[p.name]}
                for p in self.parameters
            ],
            "cost_before": self.cost_before,
            "cost_after": self.cost_after,
            "images": [
                {"before": vars(before), "after": vars(after)}
                for before, after in zip(self.similarity_before, self.similarity_after, strict=True)
            ],
            "evaluations": self.evaluations,
            "seconds": round(self.seconds, 3),
            "identifiability": self.identifiability.to_dict(),
            "display": vars(self.display),
            **self.tissues.to_dict(),
        }  # fmt: skip


class AppearanceCost:
    """The mean cost of simulated images against references, as a function of free parameters.

    Parameters
    ----------
    model : AppearanceModel with one pose per reference.
    references : (rows, columns) uint8 each, on the model's grid.
    masks : (rows, columns) bool each, the imaged field of the reference; None: all pixels.

    Raises SimulationError where shapes or counts differ, fields do not overlap, or a reference is black.
    """

    def __init__(
        self,
        model: AppearanceModel,
        parameters: FreeParameters,
        references: Sequence[np.ndarray],
        masks: Sequence[np.ndarray] | None,
        tissues: TissueTable,
        display: DisplaySettings,
        settings: SimilaritySettings,
    ) -> None:
        self.model, self.parameters, self.tissues, self.display = model, parameters, tissues, display
        grid = model.grid(display)
        self.comparisons = target_comparisons(
            model.device, model.probe, grid, references, masks, len(model.poses), settings
        )

    def of_each(self, tissues: TissueTable, display: DisplaySettings) -> list[Similarity]:
        """The similarity of every image."""
        for number, comparison in enumerate(self.comparisons):
            comparison.run(self.model.run(number, tissues, display))
        return [comparison.result() for comparison in self.comparisons]

    def __call__(self, units: np.ndarray) -> float:
        """The mean cost at (parameters,) positions, 0 to 1 between the bounds."""
        tissues, display = self.parameters.apply(units, self.tissues, self.display)
        return mean_total(self.of_each(tissues, display))

    def image(self, units: np.ndarray) -> np.ndarray:
        """(rows, columns) uint8 of the first pose at (parameters,) positions."""
        return self.model.image(0, *self.parameters.apply(units, self.tissues, self.display))

    def anchor(self, units: np.ndarray) -> None:
        """Recompute what the model approximates, so that it is exact here."""
        self.model.anchor(self.parameters.apply(units, self.tissues, self.display)[0])

    def axes(self, units: np.ndarray) -> np.ndarray:
        """(parameters, parameters) axes of a local search from a position (below)."""

        def statistics(at: np.ndarray) -> np.ndarray:
            tissues, display = self.parameters.apply(at, self.tissues, self.display)
            images = (self.model.image(number, tissues, display) for number in range(len(self.comparisons)))
            return np.concatenate(
                [
                    patch_statistics(image, comparison.inside, comparison.patch)
                    for image, comparison in zip(images, self.comparisons, strict=True)
                ],
                axis=1,
            )

        return search_axes(statistics, units)


def optimize_appearance(
    simulator: UltrasoundSimulator,
    probe: Probe,
    poses: Iterable[np.ndarray],
    references: Sequence[np.ndarray],
    *,
    free: Iterable[str] | Mapping[str, Bounds | None],
    display: DisplaySettings | None = None,
    begin: tuple[TissueTable, DisplaySettings] | None = None,
    grid: ImageGrid | None = None,
    masks: Sequence[np.ndarray] | None = None,
    max_evaluations: int = FitSettings().of_search,
    restarts: int = FitSettings.restarts,
    seed: int = 0,
    settings: SimilaritySettings | None = None,
    algorithms: tuple[str | None, str] = (GLOBAL_ALGORITHM, LOCAL_ALGORITHM),
    progress: Callable[[Progress], None] | None = None,
) -> AppearanceResult:
    """Fit display and tissue parameters to real images.

    Parameters
    ----------
    simulator : of the patient; the search starts from its tissues. It is not changed.
    probe, poses : the probe of the references, and the (4, 4) probe_to_ras of each.
    references : (rows, columns) uint8 images.
    free : names of free parameters, or names with (low, high); see parameters.py.
    display : the values before the fit, and of what is not free.
    begin : tissues and display at whose free parameters the search begins instead, as an earlier fit has left them.
    grid : the pixels of the references in the probe frame (default: those of simulated images).
    masks : (rows, columns) bool each, the imaged field of a reference; only pixels inside both fields count.
    max_evaluations : largest number of evaluations of the cost of all images, without restarts.
    restarts : searches from other starting points with other scatterers, for the spread of equally good fits.
    seed : of the search; the seed of scatterers and noise is the simulator's.
    algorithms : nlopt's names of the global algorithm (None for none) and the local one.
    progress : called after every evaluation; may raise errors.Cancelled.

    Raises SimulationError as FreeParameters, AppearanceModel and AppearanceCost do.

    Example: recovering the gain of one image:

    >>> import numpy as np
    >>> from SlicerUSSim.Logic import LinearProbe, TissueTable, UltrasoundSimulator, Volume
    >>> from SlicerUSSim.Logic import DisplaySettings, optimize_appearance
    >>> from SlicerUSSim.Logic.probe import pose_looking_at
    >>> labels = Volume(np.ones((40, 40, 40), np.uint8), np.eye(4))
    >>> simulator = UltrasoundSimulator(labels, TissueTable.named(["liver"]))
    >>> probe = LinearProbe(width_mm=20, depth_mm=30, scan_lines=64)
    >>> pose = pose_looking_at(face_ras=(20, 20, 39), target_ras=(20, 20, 0))
    >>> reference = simulator.simulate(probe, pose, DisplaySettings(gain_db=6.0)).image
    >>> found = optimize_appearance(simulator, probe, [pose], [reference], free=["gain_db"], max_evaluations=50)
    >>> round(found.display.gain_db, 2)
    6.0
    >>> found.cost_after < found.cost_before
    True
    """
    started = perf_counter()
    display = display or DisplaySettings()
    require_between("optimize_appearance", "max_evaluations", max_evaluations, 1, 1_000_000)
    require_between("optimize_appearance", "restarts", restarts, 0, 100)
    tissues = simulator.medium.tissues
    parameters = FreeParameters.of(free, tissues, display)
    settings = settings or SimilaritySettings()
    poses, references = list(poses), [np.asarray(reference) for reference in references]
    model = AppearanceModel(simulator, probe, poses, parameters.varied(), grid)
    cost = AppearanceCost(model, parameters, references, masks, tissues, display, settings)
    start = parameters.units(*(begin or (tissues, display)))
    limit = max_evaluations + restarts * (int(RESTART_SHARE * max_evaluations) + 1) + DRAWS
    limit += int(AGAIN_SHARE * max_evaluations) if restarts else 0

    def describe(units: np.ndarray) -> dict[str, float]:
        return dict(zip(parameters.names, parameters.values(units).tolist(), strict=True))

    _log.info(
        "fit of %d images, %d free parameters: %s", len(references), len(parameters.names), ", ".join(parameters.names)
    )
    search = Search(cost, describe, limit, seed, progress, cost.image)

    before = cost.of_each(tissues, display)
    if begin is not None:
        cost.anchor(start)
    best = _searched(search, cost, start, algorithms, max_evaluations)
    again = _restarted(cost, search, simulator, best, restarts, int(RESTART_SHARE * max_evaluations), algorithms[1])
    best, best_cost = _better(search, cost, algorithms[1], best, again, int(AGAIN_SHARE * max_evaluations))
    fitted_tissues, fitted_display = parameters.apply(best, tissues, display)
    model.anchor(fitted_tissues)
    after = cost.of_each(fitted_tissues, fitted_display)
    identifiability = _identifiability(cost, search, best, best_cost, again)
    return AppearanceResult(
        tissues=_with_source(fitted_tissues, parameters),
        display=fitted_display,
        parameters=parameters,
        before=dict(zip(parameters.names, parameters.current(tissues, display).tolist(), strict=True)),
        after=describe(best),
        cost_before=mean_total(before),
        cost_after=mean_total(after),
        similarity_before=before,
        similarity_after=after,
        history=search.history,
        seconds=perf_counter() - started,
        identifiability=identifiability,
    )


def _searched(
    search: Search, cost: AppearanceCost, start: np.ndarray, algorithms: tuple[str | None, str], evaluations: int
) -> np.ndarray:
    """The best positions: global, local, and local with the bases recomputed there."""
    global_name, local_name = algorithms
    best = start
    if global_name is not None:
        best = search.minimise(global_name, STAGES[0], best, int(_SHARES[0] * evaluations))
    best = _descended(search, cost, local_name, STAGES[1], best, int(_SHARES[1] * evaluations))
    # With the anchor here, the model is exact again.
    cost.anchor(best)
    levels = [place for place, free in enumerate(cost.parameters) if free.attribute == ECHOGENICITY.name]
    rest = evaluations - len(search.history)
    kept = min(_FOR_A_LEVEL * len(levels), rest // 2) if len(cost.parameters) > 1 else 0
    _descended(search, cost, local_name, STAGES[2], best, rest - kept)
    return _levels_alone(search, STAGES[2], levels, evaluations - len(search.history) if kept else 0)


def _levels_alone(search: Search, stage: str, places: Sequence[int], budget: int) -> np.ndarray:
    """The best positions when each of these is moved alone, in turn, from the best of a stage.

    What images show little of, such as a falx, changes the cost less than a search of all parameters tells from the
    curvature of the others, and stays where that has carried it: often so dark that nothing is seen of it.
    """
    end, first = len(search.history) + budget, search.best(stage)
    best, cost = np.array(first.units), first.cost
    for place in places:
        start = best[place]
        for step in (_LEVEL_STEP, -_LEVEL_STEP):
            while len(search.history) < end and 0.0 < best[place] + step < 1.0:
                units = best.copy()
                units[place] += step
                found = search.evaluate(stage, units)
                if found >= cost:
                    break
                best, cost = units, found
            if best[place] != start:
                break
    return best


def _descended(
    search: Search, cost: AppearanceCost, algorithm: str, stage: str, start: np.ndarray, budget: int
) -> np.ndarray:
    """The best positions of a local search, along the axes at its start."""
    return search.minimise(algorithm, stage, start, budget, FIRST_STEP, cost.axes(start))


def _descended_again(
    search: Search,
    cost: AppearanceCost,
    algorithm: str,
    stage: str,
    start: np.ndarray,
    axes: np.ndarray | None,
    budget: int,
    enough: float,
) -> np.ndarray:
    """The best positions of local searches, the first along `axes`, each of the others along those where one ended.

    Far from the best fit a valley's direction is not the one at the bottom, so that steps along the axes of the start
    soon gain nothing. Another search follows while the cost is above `enough`, the last one gained, and evaluations are
    left for more than the quadratic model with which BOBYQA begins.
    """
    end = len(search.history) + budget
    best = search.minimise(algorithm, stage, start, budget, FIRST_STEP, axes)
    reached, gain = search.best_cost(stage), np.inf
    while reached > enough and gain > _LEAST_TOLERANCE * reached and end - len(search.history) > 2 * len(start) + 1:
        best = _descended(search, cost, algorithm, stage, best, end - len(search.history))
        gain, reached = reached - search.best_cost(stage), search.best_cost(stage)
    return best


@dataclass(frozen=True)
class _Again:
    """Searches with other scatterers from starting points around the best fit."""

    #: Of the best fit, with its own scatterers and each of the others
    costs_of_best: list[float]
    #: (positions, cost above that of the best fit with the same scatterers)
    found: list[tuple[np.ndarray, float]]


def _restarted(
    cost: AppearanceCost,
    search: Search,
    simulator: UltrasoundSimulator,
    best: np.ndarray,
    restarts: int,
    budget: int,
    algorithm: str,
) -> _Again:
    """Searches with other scatterers, from starting points around the best."""
    random = np.random.default_rng(search.seed)
    best_cost = search.best_cost(STAGES[2])
    settings = simulator.settings
    costs_of_best, found = [best_cost], []
    axes = cost.axes(best) if restarts else None
    search.is_aside = True
    try:
        for number in range(1, restarts + 1):
            simulator.settings = replace(settings, seed=(settings.seed + 7919 * number) % 2**32)
            cost.anchor(best)
            stage = f"restart {number}"
            start = np.clip(best + random.normal(0.0, _RESTART_SPREAD, len(best)), 0.0, 1.0)
            costs_of_best.append(search.evaluate(f"redraw {number}", best))
            enough = costs_of_best[-1] + _LEAST_TOLERANCE * best_cost
            units = _descended_again(search, cost, algorithm, stage, start, axes, budget, enough)
            found.append((units, search.best_cost(stage) - costs_of_best[-1]))
    finally:
        simulator.settings, search.is_aside = settings, False
    return _Again(costs_of_best, found)


def _better(
    search: Search, cost: AppearanceCost, algorithm: str, best: np.ndarray, again: _Again, budget: int
) -> tuple[np.ndarray, float]:
    """(the best positions, their cost): those of a search from the best restart, if it fits better.

    The cost has several minima, and a restart that is better with its scatterers is in another one than the fit.
    """
    best_cost = search.best_cost(STAGES[2])
    units, excess = min(again.found, key=lambda found: found[1], default=(best, 0.0))
    if excess >= 0.0:
        return best, best_cost
    cost.anchor(units)
    found = _descended(search, cost, algorithm, AGAIN, units, budget)
    exact = []
    for place in (best, found):  # far from an anchor, a cost is not exact
        cost.anchor(place)
        exact.append(cost(place))
    return (found, exact[1]) if exact[1] < exact[0] else (best, best_cost)


def _identifiability(
    cost: AppearanceCost, search: Search, best: np.ndarray, best_cost: float, again: _Again
) -> Identifiability:
    """Equally good fits: restarts, evaluations of the searches, and draws of equal variance."""
    parameters = cost.parameters
    random = np.random.default_rng(search.seed)
    met = [entry for entry in search.history if entry.stage in (*STAGES[1:], AGAIN)]
    # The change of the cost between realisations of the speckle: a smaller difference of two fits is not significant.
    tolerance = max(float(np.std(again.costs_of_best)), _LEAST_TOLERANCE * best_cost)
    for units in equal_variance_draws(parameters, best, cost.tissues, cost.display, random, DRAWS):
        search.evaluate("draw", units)
    met += [entry for entry in search.history if entry.stage == "draw"]
    as_good = [entry.units for entry in met if entry.cost <= best_cost + tolerance]
    # A restart is judged against the fit that it began around, which may no longer be the best one
    gained = again.costs_of_best[0] - best_cost
    good_again = [units for units, excess in again.found if excess + gained <= tolerance]

    def state_of(units: Units) -> State:
        return parameters.apply(np.asarray(units), cost.tissues, cost.display)

    quantities = quantities_of(parameters, cost.model.probe.received_mhz, cost.tissues)
    return Identifiability.of(quantities, state_of, best, as_good, good_again, len(again.found), tolerance)


def _with_source(tissues: TissueTable, parameters: FreeParameters) -> TissueTable:
    """The table with the source of fitted values."""
    for tissue in tissues.all_tissues():
        fitted = [p.attribute for p in parameters if p.tissue == tissue.name]
        if fitted:
            tissues = tissues.with_tissue(
                replace(tissue, sources={**tissue.sources, **dict.fromkeys(fitted, "fitted to tracked ultrasound")})
            )
    return tissues


# ---- axes of a local search: directions that change the images, in steps that change them equally --------------------
# Attenuation and time-gain compensation hardly change an image if they change together: along the parameters a cost is
# an oblique valley, in which a local search stops early (docs/optimization.md#search). The axes are the eigenvectors of
# J^T J, where J is the change of the images' patches with the parameters (the metric of Gauss and Newton).

#: Step of the differences, with bounds scaled to 0 and 1.
_DIFFERENCE = 0.02
#: Patches with fewer pixels have no standard deviation to speak of.
_LEAST_PIXELS = 20
#: A step of the search changes a patch by this fraction of the grey scale, but a parameter by no more than that part
#: of its bounds, where images hardly change.
FIRST_STEP, _LARGEST_STEP = 0.1, 0.3


def patch_statistics(image: np.ndarray, inside: np.ndarray, patch: tuple[int, int]) -> np.ndarray:
    """(2, patches) mean and standard deviation of grey levels in square patches, in fractions of the grey scale.

    Parameters
    ----------
    image : (rows, columns) uint8.
    inside : (rows, columns) bool, the pixels that count; patches with fewer than 20 of them are left out.
    patch : (rows, columns) of a patch, in pixels.
    """
    rows, columns = image.shape
    across = -(-columns // patch[1])
    number = ((np.arange(rows) // patch[0])[:, None] * across + np.arange(columns) // patch[1])[inside]
    grey = image[inside] / 255.0
    count = np.bincount(number)
    kept = count >= min(_LEAST_PIXELS, count.max())
    mean, square = (np.bincount(number, values)[kept] / count[kept] for values in (grey, grey * grey))
    return np.stack([mean, np.sqrt(np.maximum(square - mean * mean, 0.0))])


def search_axes(statistics_of: Callable[[np.ndarray], np.ndarray], units: np.ndarray) -> np.ndarray:
    """(parameters, parameters) columns by which positions change per unit of the search's coordinates.

    A unit along an axis changes `statistics_of` by 1 (root of the mean square), as far as it is linear; where it hardly
    changes at all, a parameter by 3 times its bounds, so that FIRST_STEP is 0.3 of them.

    Parameters
    ----------
    statistics_of : function of (parameters,) positions, 0 to 1 between the bounds, to an array of fixed shape.
    units : (parameters,) position at which the change is measured, by differences of 0.02 to either side.

    >>> import numpy as np
    >>> from SlicerUSSim.Logic.fitting.optimization import search_axes
    >>> axes = search_axes(lambda units: np.array([10.0 * (units[0] - units[1])]), np.array([0.5, 0.5]))
    >>> [round(float(size), 2) for size in sorted(np.linalg.norm(axes, axis=0))]  # against each other, and together
    [0.07, 3.0]
    """
    changes = []
    for place in range(len(units)):
        ends = np.repeat(np.asarray(units, float)[None], 2, axis=0)
        ends[:, place] = np.clip(units[place] + np.array([-_DIFFERENCE, _DIFFERENCE]), 0.0, 1.0)
        low, high = (np.ravel(statistics_of(end)) for end in ends)
        changes.append((high - low) / (ends[1, place] - ends[0, place]))
    jacobian = np.array(changes)
    power, axes = np.linalg.eigh(jacobian @ jacobian.T / jacobian.shape[1])
    return axes / np.sqrt(np.maximum(power, 0.0) + (FIRST_STEP / _LARGEST_STEP) ** 2)
