"""optimize_appearance: display and tissue parameters fitted until simulated and real images agree (PHYSICS section 6).

A global search finds the basin, a local one its bottom, then the bases are computed anew there (appearance.py) and the
local search goes on until the anchor no longer moves the cost. One seed draws scatterers and noise of every evaluation
(common random numbers), so the cost is a function: the same problem gives the same answer, and an interrupted run is
resumed by replaying what it had evaluated.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter

import numpy as np

from SlicerUSSim.Logic.appearance import AppearanceModel
from SlicerUSSim.Logic.errors import SimulationError, require, require_between
from SlicerUSSim.Logic.identifiability import Identifiability, quantities_of
from SlicerUSSim.Logic.parameters import Bounds, FreeParameters
from SlicerUSSim.Logic.probe import Probe
from SlicerUSSim.Logic.scan_conversion import ImageGrid
from SlicerUSSim.Logic.settings import DisplaySettings
from SlicerUSSim.Logic.similarity import PatchComparison, Similarity, SimilaritySettings
from SlicerUSSim.Logic.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.tissues import TissueTable

#: nlopt's names. The choice is justified in docs/optimization.md by benchmarks/optimization.py.
GLOBAL_ALGORITHM, LOCAL_ALGORITHM = "GN_CRS2_LM", "LN_SBPLX"
#: Shares of the evaluations: global search, local search; the rest is for the search after the anchor has moved.
_SHARES = (0.6, 0.25)
#: Between 0 and 1 across the bounds: how exactly the best is wanted, and the first step of local searches.
_UNIT_TOLERANCE, _FIRST_STEP = 1e-3, 0.1
#: Standard deviation of the starts of restarts around the best, likewise.
_RESTART_SPREAD = 0.15


@dataclass(frozen=True)
class Evaluation:
    """One evaluation of the cost."""

    stage: str
    #: (parameters,) between 0 and 1 within the bounds
    units: tuple[float, ...]
    cost: float


@dataclass(frozen=True)
class Progress:
    """What a progress function is told after every evaluation."""

    stage: str
    evaluations: int
    #: How many there will be at most
    limit: int
    cost: float
    best_cost: float
    #: {parameter name: value} of the best so far
    best: dict[str, float]

    @property
    def share(self) -> float:
        """Share done, 0 to 1."""
        return min(self.evaluations / self.limit, 1.0)


@dataclass(frozen=True, eq=False)
class AppearanceResult:
    """What an optimisation found."""

    tissues: TissueTable
    display: DisplaySettings
    parameters: FreeParameters
    #: {parameter name: value} at the start and at the end
    before: dict[str, float]
    after: dict[str, float]
    #: Mean over the images, of full simulations
    cost_before: float
    cost_after: float
    #: Of each image
    similarity_before: list[Similarity]
    similarity_after: list[Similarity]
    history: list[Evaluation] = field(repr=False)
    #: Evaluations computed in this run; a resumed one has more in its history
    evaluations: int
    seconds: float
    identifiability: Identifiability = field(repr=False)
    #: What a later run needs to go on: pass it as `resume`
    state: dict = field(repr=False)

    def to_dict(self) -> dict:
        """Plain values for JSON."""
        return {
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
    references : (rows, columns) uint8 each, on the grid of the probe's image.
    masks : (rows, columns) bool each, where the reference shows its field; None is everywhere.

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
        grid = ImageGrid.for_probe(model.probe, display.image_size)
        seen = grid.field(model.probe)
        require(len(references) > 0, "no reference image, expected at least one")
        require(
            len(references) == len(model.poses),
            f"{len(references)} reference images and {len(model.poses)} poses, expected as many",
        )
        require(
            masks is None or len(masks) == len(references),
            f"{len(masks or ())} masks and {len(references)} reference images, expected as many",
        )
        self.comparisons = []
        for number, reference in enumerate(references):
            reference = np.asarray(reference)
            require(
                reference.shape == (grid.rows, grid.columns),
                f"reference image {number} has shape {reference.shape}, expected that of the probe's image, "
                f"{(grid.rows, grid.columns)}",
            )
            inside = seen if masks is None else seen & np.asarray(masks[number], bool)
            require(
                bool(inside.any()),
                f"reference image {number}: its field and the probe's do not overlap; check the geometry",
            )
            require(int(reference[inside].max()) > 0, f"reference image {number} is black inside the field")
            self.comparisons.append(PatchComparison(model.device, reference, inside, grid.pixel_spacing_mm, settings))

    def of_each(self, tissues: TissueTable, display: DisplaySettings) -> list[Similarity]:
        """The similarity of every image."""
        for number, comparison in enumerate(self.comparisons):
            comparison.run(self.model.run(number, tissues, display))
        return [comparison.result() for comparison in self.comparisons]

    def __call__(self, units: np.ndarray) -> float:
        """The mean cost at (parameters,) positions between the bounds."""
        tissues, display = self.parameters.apply(units, self.tissues, self.display)
        return float(np.mean([one.total for one in self.of_each(tissues, display)]))


def optimize_appearance(
    simulator: UltrasoundSimulator,
    probe: Probe,
    poses: Iterable[np.ndarray],
    references: Sequence[np.ndarray],
    *,
    free: Iterable[str] | Mapping[str, Bounds | None],
    display: DisplaySettings | None = None,
    masks: Sequence[np.ndarray] | None = None,
    max_evaluations: int = 600,
    restarts: int = 2,
    seed: int = 0,
    settings: SimilaritySettings | None = None,
    algorithms: tuple[str | None, str] = (GLOBAL_ALGORITHM, LOCAL_ALGORITHM),
    progress: Callable[[Progress], None] | None = None,
    resume: dict | None = None,
) -> AppearanceResult:
    """Fit display and tissue parameters to real images.

    Parameters
    ----------
    simulator : of the patient; its tissues and settings are where the search starts, and it is left as it is.
    probe, poses : what saw the references, and its (4, 4) probe_to_ras for each.
    references : (rows, columns) uint8 images on the grid of the probe's image (ImageGrid.for_probe).
    free : names of free parameters, or names with (low, high); see parameters.py.
    display : where the search starts.
    masks : (rows, columns) bool each, the field that a reference shows; only pixels inside both fields count.
    max_evaluations : of the cost of all images, in the search for the best.
    restarts : searches from other starts with other scatterers, for the spread of what fits equally well.
    seed : of the search; that of scatterers and noise is the simulator's.
    algorithms : nlopt's names of the global algorithm (None for none) and the local one.
    progress : told after every evaluation; may raise errors.Cancelled.
    resume : the state of an earlier, shorter run on the same problem.

    Raises SimulationError for what FreeParameters, AppearanceModel and AppearanceCost refuse, and for the state of
    another problem.
    """
    started = perf_counter()
    display = display or DisplaySettings()
    require_between("optimize_appearance", "max_evaluations", max_evaluations, 1, 1_000_000)
    require_between("optimize_appearance", "restarts", restarts, 0, 100)
    tissues = simulator.medium.tissues
    parameters = FreeParameters.of(free, tissues, display)
    settings = settings or SimilaritySettings()
    poses, references = list(poses), [np.asarray(reference) for reference in references]
    model = AppearanceModel(simulator, probe, poses, parameters.varied())
    cost = AppearanceCost(model, parameters, references, masks, tissues, display, settings)
    problem = _fingerprint(parameters, probe, poses, references, masks, tissues, display, settings, simulator, seed)
    limit = max_evaluations + restarts * int(_SHARES[1] * max_evaluations)
    search = _Search(cost, limit, seed, progress, _replayed(resume, problem))

    start = parameters.units(tissues, display)
    before = cost.of_each(tissues, display)
    global_name, local_name = algorithms
    best = start
    if global_name is not None:
        best = search.minimise(global_name, "global", best, int(_SHARES[0] * max_evaluations))
    best = search.minimise(local_name, "local", best, int(_SHARES[1] * max_evaluations))
    # What the model approximates away from its anchor is exact again once the anchor is here.
    model.anchor(parameters.apply(best, tissues, display)[0])
    best = search.minimise(local_name, "polish", best, max_evaluations - len(search.history))

    fitted_tissues, fitted_display = parameters.apply(best, tissues, display)
    model.anchor(fitted_tissues)
    after = cost.of_each(fitted_tissues, fitted_display)
    identifiability = _identifiability(search, simulator, best, restarts, int(_SHARES[1] * max_evaluations))
    return AppearanceResult(
        tissues=_with_source(fitted_tissues, parameters),
        display=fitted_display,
        parameters=parameters,
        before=dict(zip(parameters.names, parameters.current(tissues, display).tolist(), strict=True)),
        after=dict(zip(parameters.names, parameters.values(best).tolist(), strict=True)),
        cost_before=float(np.mean([one.total for one in before])),
        cost_after=float(np.mean([one.total for one in after])),
        similarity_before=before,
        similarity_after=after,
        history=search.history,
        evaluations=search.computed,
        seconds=perf_counter() - started,
        identifiability=identifiability,
        state={"problem": problem, "history": [[e.stage, list(e.units), e.cost] for e in search.history]},
    )


class _Search:
    """Runs nlopt on the cost, stage by stage, and keeps what it evaluated."""

    def __init__(
        self,
        cost: AppearanceCost,
        limit: int,
        seed: int,
        progress: Callable[[Progress], None] | None,
        replayed: list[Evaluation],
    ) -> None:
        self.cost, self.limit, self.seed, self.progress, self.replayed = cost, limit, seed, progress, replayed
        self.history: list[Evaluation] = []
        self.computed = 0

    def minimise(self, algorithm: str, stage: str, start: np.ndarray, budget: int) -> np.ndarray:
        """The best of at most `budget` evaluations from `start` on, (parameters,) between 0 and 1."""
        import nlopt

        first = len(self.history)
        failure: list[BaseException] = []

        def evaluate(units: np.ndarray, _gradient) -> float:
            try:
                return self._evaluate(stage, units)
            except BaseException as error:  # through nlopt's C++, which would lose what kind it was
                failure.append(error)
                search.force_stop()
                return float("inf")

        try:
            search = nlopt.opt(getattr(nlopt, algorithm), len(start))
        except (AttributeError, TypeError):
            raise SimulationError(f"nlopt has no algorithm {algorithm!r}, expected such as {LOCAL_ALGORITHM}") from None
        self._evaluate(stage, start)
        if budget > 1:
            nlopt.srand(self.seed + 1)
            search.set_min_objective(evaluate)
            search.set_lower_bounds(np.zeros(len(start)))
            search.set_upper_bounds(np.ones(len(start)))
            search.set_maxeval(budget - 1)
            search.set_xtol_abs(_UNIT_TOLERANCE)
            search.set_initial_step(_FIRST_STEP)
            if algorithm.startswith(("G_MLSL", "GN_MLSL", "AUGLAG")):
                local = nlopt.opt(getattr(nlopt, LOCAL_ALGORITHM), len(start))
                local.set_xtol_abs(10 * _UNIT_TOLERANCE)
                local.set_initial_step(_FIRST_STEP)
                search.set_local_optimizer(local)
            try:
                search.optimize(start)
            except (nlopt.ForcedStop, nlopt.RoundoffLimited):
                pass
            except (RuntimeError, ValueError) as error:
                if not failure:
                    raise SimulationError(f"nlopt's {algorithm} cannot be used here ({error})") from None
            if failure:
                raise failure[0]
        return np.array(min(self.history[first:], key=lambda entry: entry.cost).units)

    def _evaluate(self, stage: str, units: np.ndarray) -> float:
        place = len(self.history)
        key = tuple(np.clip(units, 0.0, 1.0).tolist())
        known = self.replayed[place] if place < len(self.replayed) else None
        if known is not None and known.stage == stage and known.units == key:
            cost = known.cost
        else:
            cost = self.cost(np.array(key))
            self.computed += 1
        self.history.append(Evaluation(stage, key, cost))
        if self.progress is not None:
            best = min(self.history, key=lambda entry: entry.cost)
            parameters = self.cost.parameters
            values = dict(zip(parameters.names, parameters.values(best.units).tolist(), strict=True))
            self.progress(Progress(stage, len(self.history), self.limit, cost, best.cost, values))
        return cost


def _identifiability(
    search: _Search, simulator: UltrasoundSimulator, best: np.ndarray, restarts: int, budget: int
) -> Identifiability:
    """What fits as well: searches with other scatterers from starts around the best, and what was met on the way."""
    cost, parameters = search.cost, search.cost.parameters
    random = np.random.default_rng(search.seed)
    best_cost = min(entry.cost for entry in search.history if entry.stage == "polish")
    met = [entry for entry in search.history if entry.stage in ("local", "polish")]
    settings = simulator.settings
    costs_of_best, found = [best_cost], []
    try:
        for number in range(1, restarts + 1):
            simulator.settings = replace(settings, seed=(settings.seed + 7919 * number) % 2**32)
            cost.model.anchor(parameters.apply(best, cost.tissues, cost.display)[0])
            stage = f"restart {number}"
            start = np.clip(best + random.normal(0.0, _RESTART_SPREAD, len(best)), 0.0, 1.0)
            costs_of_best.append(search._evaluate(stage, best))
            units = search.minimise(LOCAL_ALGORITHM, stage, start, budget)
            reached = min(entry.cost for entry in search.history if entry.stage == stage)
            found.append((units, reached - costs_of_best[-1]))
    finally:
        simulator.settings = settings
    # How much the cost changes from one draw of the speckle to the next: less cannot tell two fits apart.
    tolerance = max(float(np.std(costs_of_best)), 0.01 * best_cost)
    as_good = [entry.units for entry in met if entry.cost <= best_cost + tolerance]
    again = [units for units, excess in found if excess <= tolerance]

    def state_of(units) -> tuple[TissueTable, DisplaySettings]:
        return parameters.apply(np.asarray(units), cost.tissues, cost.display)

    quantities = quantities_of(parameters, cost.model.probe.frequency_mhz, cost.tissues)
    return Identifiability.of(quantities, state_of, best, as_good, again, restarts, tolerance)


def _with_source(tissues: TissueTable, parameters: FreeParameters) -> TissueTable:
    """The table with the origin of what was fitted."""
    for tissue in tissues.all_tissues():
        fitted = [p.attribute for p in parameters if p.tissue == tissue.name]
        if fitted:
            tissues = tissues.with_tissue(
                replace(tissue, sources={**tissue.sources, **dict.fromkeys(fitted, "fitted to tracked ultrasound")})
            )
    return tissues


def _replayed(state: dict | None, problem: str) -> list[Evaluation]:
    """The evaluations of an earlier run. Raises SimulationError if it was on another problem."""
    if state is None:
        return []
    try:
        known, history = (
            state["problem"],
            [Evaluation(str(s), tuple(map(float, u)), float(c)) for s, u, c in state["history"]],
        )
    except (KeyError, TypeError, ValueError):
        raise SimulationError(
            "the state to resume is not one of an optimisation, expected problem and history"
        ) from None
    require(known == problem, "the state to resume is of another problem: other images, poses, parameters or settings")
    return history


def _fingerprint(parameters, probe, poses, references, masks, tissues, display, settings, simulator, seed) -> str:
    """What makes two problems the same one."""
    digest = hashlib.sha256()
    plain = (list(parameters), probe, tissues.to_dict(), display, settings, simulator.settings, seed)
    digest.update(repr(plain).encode())
    for array in (
        *poses,
        *references,
        *(masks or ()),
        simulator.medium.labels.array,
        simulator.medium.labels.ijk_to_ras,
    ):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
