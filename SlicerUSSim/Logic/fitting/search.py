"""Search: nlopt on a deterministic cost, in stages, with progress and cancellation at every evaluation."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from math import isnan, nan

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError

#: Names in nlopt. docs/optimization.md justifies the choice with results of benchmarks/fitting.py.
GLOBAL_ALGORITHM, LOCAL_ALGORITHM = "G_MLSL_LDS", "LN_BOBYQA"
#: BOBYQA needs two parameters or more.
_ALGORITHM_FOR_ONE = "LN_SBPLX"
#: Tolerance of the best position and first step of local searches, with bounds scaled to 0 and 1.
_TOLERANCE, _FIRST_STEP = 1e-3, 0.1
#: The same along the axes of the images' changes, in fractions of the grey scale: 0.1 of 255 levels.
_TOLERANCE_ALONG_AXES = 5e-4


@dataclass(frozen=True)
class Evaluation:
    """One evaluation of the cost."""

    stage: str
    #: (parameters,) between 0 and 1 within the bounds
    units: tuple[float, ...]
    cost: float


@dataclass(frozen=True)
class Progress:
    """The argument of a progress function, after every evaluation."""

    stage: str
    evaluations: int
    #: Largest number of evaluations
    limit: int
    #: NaN in a step that has another cost than the fit
    cost: float
    best_cost: float
    #: {parameter name: value} of the best so far
    best: dict[str, float]
    #: Within a progress function: the first image with these, (rows, columns) uint8, and its number in the recording
    image: Callable[[], np.ndarray] | None = None
    number: int | None = None

    @property
    def share(self) -> float:
        """Fraction done, 0 to 1."""
        return min(self.evaluations / self.limit, 1.0)

    def in_words(self) -> str:
        """The stage and the best cost so far."""
        return self.stage if isnan(self.best_cost) else f"{self.stage}: cost {self.best_cost:.4f}"

    @staticmethod
    def shares(name: str, progress: Callable[[Progress], None] | None) -> Callable[[float], None] | None:
        """A function of the fraction done, 0 to 1, for a step of this name that says no cost."""
        if progress is None:
            return None
        told = progress
        return lambda share: told(Progress(name, round(100 * share), 100, nan, nan, {}))

    @staticmethod
    def named(name: str, progress: Callable[[Progress], None] | None) -> Callable[[Progress], None] | None:
        """A progress function that puts the name of a step before its stages."""
        if progress is None:
            return None
        told = progress
        return lambda step: told(replace(step, stage=f"{name}, {step.stage}"))


class Search:
    """Minimises a cost over positions from 0 to 1.

    Parameters
    ----------
    cost : function of (parameters,) positions; must be deterministic, so that a run is repeatable.
    describe : {parameter name: value} of a position, for progress.
    limit : largest number of evaluations, for progress.
    seed : of algorithms that draw random numbers.
    progress : called after every evaluation; may raise errors.Cancelled.
    image : (rows, columns) uint8 image of a position, for progress.
    """

    def __init__(
        self,
        cost: Callable[[np.ndarray], float],
        describe: Callable[[np.ndarray], dict[str, float]],
        limit: int,
        seed: int = 0,
        progress: Callable[[Progress], None] | None = None,
        image: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> None:
        self.cost, self.describe, self.limit, self.seed = cost, describe, limit, seed
        self.progress, self.image = progress, image
        self.history: list[Evaluation] = []
        self._best: Evaluation | None = None
        #: Whether evaluations are with another cost, so that none of them is the best
        self.is_aside = False

    def minimise(
        self,
        algorithm: str,
        stage: str,
        start: np.ndarray,
        budget: int,
        step: float = _FIRST_STEP,
        axes: np.ndarray | None = None,
    ) -> np.ndarray:
        """The best position, (parameters,) from 0 to 1, of at most `budget` evaluations that begin at `start`.

        Parameters
        ----------
        algorithm, stage : nlopt's name, and that of the entries in the history.
        step : first step of local searches, of positions or along the axes.
        axes : (parameters, parameters), columns by which positions change per unit of the search's coordinates (see
            optimization.py); default: the parameters themselves. Coordinates have no bounds: beyond those of the
            parameters the cost is that at the bound, and rises with the distance.

        Raises SimulationError for an algorithm that nlopt does not have or that cannot be used here.
        """
        import nlopt

        first = len(self.history)
        failure: list[BaseException] = []

        start = np.clip(start, 0.0, 1.0)
        coordinates = None if axes is None else np.linalg.inv(axes)

        def evaluate(place: np.ndarray, _gradient) -> float:
            if len(self.history) - first >= budget:  # some algorithms exceed the limit by a few
                itself.force_stop()
                return float("inf")
            units = place if axes is None else start + axes @ place
            try:
                cost = self.evaluate(stage, units)
                if coordinates is not None:
                    cost += float(np.linalg.norm(coordinates @ (units - np.clip(units, 0.0, 1.0))))
                return cost
            except BaseException as error:  # nlopt's C++ would lose the type of the exception
                failure.append(error)
                itself.force_stop()
                return float("inf")

        search = self._optimiser(algorithm, len(start), step, axes is None)
        itself = weakref.proxy(search)  # nlopt refers to `evaluate` invisibly to Python's garbage collector
        self.evaluate(stage, start)
        if budget > 1:
            nlopt.srand(self.seed + 1)
            search.set_min_objective(evaluate)
            search.set_maxeval(budget - 1)
            try:
                search.optimize(start if axes is None else np.zeros(len(start)))
            except (nlopt.ForcedStop, nlopt.RoundoffLimited):
                pass
            except (RuntimeError, ValueError) as error:
                if not failure:
                    raise SimulationError(f"nlopt's {algorithm} cannot be used here ({error})") from None
            if failure:
                raise failure[0]
        return np.array(min(self.history[first:], key=lambda entry: entry.cost).units)

    def evaluate(self, stage: str, units: np.ndarray) -> float:
        """The cost at one position, kept in the history."""
        key = tuple(np.clip(units, 0.0, 1.0).tolist())
        cost = self.cost(np.array(key))
        entry = Evaluation(stage, key, cost)
        self.history.append(entry)
        # A new stage may have another cost function, so earlier values are not comparable.
        is_new = self._best is None or self._best.stage != stage
        if self._best is None or (not self.is_aside and (is_new or cost < self._best.cost)):
            self._best = entry
        if self.progress is not None:
            best = self._best
            units = np.array(best.units)
            image = None if self.image is None else partial(self.image, units)
            values = self.describe(units)
            self.progress(Progress(stage, len(self.history), self.limit, cost, best.cost, values, image))
        return cost

    def best(self, stage: str) -> Evaluation:
        """The evaluation of lowest cost in one stage."""
        return min((entry for entry in self.history if entry.stage == stage), key=lambda entry: entry.cost)

    def best_cost(self, stage: str) -> float:
        """The lowest cost of one stage."""
        return self.best(stage).cost

    def _optimiser(self, algorithm: str, parameters: int, step: float, bounded: bool):
        import nlopt

        def made(name: str, tolerance: float):
            if parameters == 1 and name == LOCAL_ALGORITHM:
                name = _ALGORITHM_FOR_ONE
            try:
                optimiser = nlopt.opt(getattr(nlopt, name), parameters)
            except (AttributeError, TypeError, ValueError):
                known = f"{GLOBAL_ALGORITHM} or {LOCAL_ALGORITHM}"
                raise SimulationError(f"nlopt has no algorithm {name!r}, expected a name such as {known}") from None
            if bounded:
                optimiser.set_lower_bounds(np.zeros(parameters))
                optimiser.set_upper_bounds(np.ones(parameters))
            optimiser.set_xtol_abs(tolerance)
            optimiser.set_initial_step(step)
            return optimiser

        search = made(algorithm, _TOLERANCE if bounded else _TOLERANCE_ALONG_AXES)
        if "MLSL" in algorithm or "AUGLAG" in algorithm:
            search.set_local_optimizer(made(LOCAL_ALGORITHM, 10.0 * _TOLERANCE))
        return search
