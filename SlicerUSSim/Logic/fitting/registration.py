"""register_poses: refines the position of the ultrasound in the MRI, with the cost of the appearance optimisation.

All poses get the same rigid correction with six parameters: millimetres along and degrees about the axes of the middle
image. The centre of rotation is the middle of all imaged fields, where translations and rotations are least coupled.
Every evaluation repeats ray tracing and scattering, so the search first uses a coarse simulation (fewer scan lines,
pixels, scatterers and rays), then the full one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from SlicerUSSim.Logic.base.errors import require_between
from SlicerUSSim.Logic.base.settings import DisplaySettings, SimulationSettings
from SlicerUSSim.Logic.base.transforms import check_rigid
from SlicerUSSim.Logic.fitting.image_similarity import (
    PatchComparison,
    SimilaritySettings,
    mean_total,
    target_comparisons,
)
from SlicerUSSim.Logic.fitting.search import Evaluation, Progress, Search
from SlicerUSSim.Logic.imaging.scattering import sites_per_mm3
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid

NAMES = ("x_mm", "y_mm", "z_mm", "about_x_deg", "about_y_deg", "about_z_deg")
#: Name in nlopt. A simplex is robust against the ripple of the cost due to speckle; quadratic models are not.
_ALGORITHM = "LN_NELDERMEAD"
#: Fraction of coarse evaluations; initial steps of the simplices, in units of the range. The best place of the coarse
#: cost is off by up to one degree, so that the simplices of the full cost have to start as wide as that.
_COARSE_SHARE = 0.6
_COARSE_SITES_PER_MM3 = 8.0
_STEPS, _FINE_STEPS = (0.12, 0.25, 0.12, 0.2, 0.12, 0.06), (0.08, 0.06, 0.04)


@dataclass(frozen=True, eq=False)
class Registration:
    """A rigid correction with costs."""

    #: (4, 4) rigid; corrected poses are correction @ pose
    correction: np.ndarray
    poses: list[np.ndarray] = field(repr=False)
    #: (3,) the middle of the imaged fields before the correction, and its displacement
    centre: np.ndarray = field(repr=False)
    shift_mm: float
    cost_before: float
    cost_after: float
    history: list[Evaluation] = field(repr=False)

    @property
    def turn_deg(self) -> float:
        """Angle by which the images were rotated."""
        return rotation_deg(self.correction)

    @classmethod
    def none(cls, poses: Sequence[np.ndarray]) -> Registration:
        """The identity, for poses that are not moved."""
        return cls(np.eye(4), list(poses), np.mean([pose[:3, 3] for pose in poses], axis=0), 0.0, 0.0, 0.0, [])

    def after(self, earlier: Registration) -> Registration:
        """The composition of two corrections."""
        correction = self.correction @ earlier.correction
        start = (np.linalg.inv(earlier.correction) @ [*self.centre, 1.0])[:3]
        moved = (correction @ [*start, 1.0])[:3] - start
        return replace(
            self, correction=correction, centre=start, shift_mm=float(np.linalg.norm(moved)),
            cost_before=earlier.cost_before, history=[*earlier.history, *self.history],
        )  # fmt: skip

    def to_dict(self) -> dict:
        """Plain values for JSON."""
        return {
            "correction": self.correction.tolist(),
            "shift_mm": self.shift_mm,
            "turn_deg": self.turn_deg,
            "cost_before": self.cost_before,
            "cost_after": self.cost_after,
            "evaluations": len(self.history),
        }


def register_poses(
    simulator: UltrasoundSimulator,
    probe: Probe,
    poses: Sequence[np.ndarray],
    references: Sequence[np.ndarray],
    *,
    display: DisplaySettings,
    grid: ImageGrid | None = None,
    masks: Sequence[np.ndarray] | None = None,
    range_mm: float = 8.0,
    range_deg: float = 8.0,
    max_evaluations: int = 900,
    settings: SimilaritySettings | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> Registration:
    """Move all poses together so that simulated and real images agree best.

    Parameters as in optimization.optimize_appearance. Tissues and display are not changed, so fit them first.
    `range_mm` and `range_deg` are the bounds of each parameter.

    Raises SimulationError for poses that are not rigid and references that do not fit.
    """
    require_between("register_poses", "range_mm", range_mm, 0.01, 100)
    require_between("register_poses", "range_deg", range_deg, 0.01, 90)
    poses = [check_rigid(f"pose {number}", pose) for number, pose in enumerate(poses)]
    settings = settings or SimilaritySettings()
    grid = grid or ImageGrid.for_probe(probe, display.image_size)
    ranges = np.array([range_mm] * 3 + [range_deg] * 3)

    def correction(units: np.ndarray) -> np.ndarray:
        return frame @ rigid_from((2.0 * np.asarray(units) - 1.0) * ranges) @ np.linalg.inv(frame)

    def describe(units: np.ndarray) -> dict[str, float]:
        return dict(zip(NAMES, ((2.0 * np.asarray(units) - 1.0) * ranges).tolist(), strict=True))

    comparisons = target_comparisons(simulator.device, probe, grid, references, masks, len(poses), settings)
    frame = middle_frame(probe, poses)
    full = _PoseCost(simulator, probe, poses, comparisons, grid, display, correction)
    coarse_probe, coarse_grid, coarse_references, coarse_masks = coarser(probe, grid, references, masks)
    coarse_comparisons = [
        PatchComparison(simulator.device, reference, mask, coarse_grid.pixel_spacing_mm, settings)
        for reference, mask in zip(coarse_references, coarse_masks, strict=True)
    ]
    coarse = _PoseCost(
        simulator, coarse_probe, poses, coarse_comparisons, coarse_grid, display, correction,
        _coarser_settings(simulator.settings, coarse_probe),
    )  # fmt: skip
    search = Search(coarse, describe, max_evaluations, 0, progress)
    here = np.full(6, 0.5)
    before = full(here)
    random = np.random.default_rng(0)
    best, coarse_budget = here, int(_COARSE_SHARE * max_evaluations)
    for step in _STEPS:
        # A simplex that has contracted in a local minimum due to speckle is restarted with larger steps.
        start = best if step == _STEPS[0] else best + random.normal(0.0, 0.3 * step, 6)
        search.minimise(_ALGORITHM, "coarse", start, coarse_budget - len(search.history), step=step)
        best = np.array(search.best("coarse").units)
        if len(search.history) >= coarse_budget:
            break
    search.cost = full
    for number, step in enumerate(_FINE_STEPS, 1):
        budget = (max_evaluations - len(search.history)) * number // len(_FINE_STEPS)
        if budget > 0 or number == 1:  # the full cost is needed once
            search.minimise(_ALGORITHM, "fine", best, budget, step=step)
            best = np.array(search.best("fine").units)
    after = search.best_cost("fine")
    if after > before:  # no improvement on the start
        best, after = here, before
    matrix = correction(best)
    centre = frame[:3, 3]
    shift = float(np.linalg.norm((matrix @ [*centre, 1.0])[:3] - centre))
    return Registration(matrix, [matrix @ pose for pose in poses], centre, shift, before, after, search.history)


def rigid_from(values: Sequence[float] | np.ndarray) -> np.ndarray:
    """(4, 4) from three translations (mm) and a rotation vector (degrees)."""
    from scipy.spatial.transform import Rotation

    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(np.deg2rad(values[3:])).as_matrix()
    matrix[:3, 3] = values[:3]
    return matrix


def rotation_deg(matrix: np.ndarray) -> float:
    """The angle of a rigid matrix's rotation."""
    return float(np.rad2deg(np.arccos(np.clip((np.trace(matrix[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))))


class _PoseCost:
    """The mean cost at corrected poses, as a function of the correction's parameters scaled to 0 to 1."""

    def __init__(
        self, simulator, probe, poses, comparisons: list[PatchComparison], grid, display, correction,
        simulation: SimulationSettings | None = None,
    ) -> None:  # fmt: skip
        self.simulator, self.probe, self.poses, self.grid, self.display = simulator, probe, poses, grid, display
        self.correction, self.simulation = correction, simulation or simulator.settings
        self.comparisons = comparisons

    def __call__(self, units: np.ndarray) -> float:
        matrix, render = self.correction(units), self.simulator.render
        for pose, comparison in zip(self.poses, self.comparisons, strict=True):
            frame = render(self.probe, matrix @ pose, self.display, self.grid, settings=self.simulation)
            comparison.run(frame.image)
        return mean_total(comparison.result() for comparison in self.comparisons)


def middle_frame(probe: Probe, poses: list[np.ndarray]) -> np.ndarray:
    """(4, 4) the axes of the middle image, with the origin in the middle of all imaged fields."""
    centres = [(pose @ [0.0, 0.5 * probe.depth_mm, 0.0, 1.0])[:3] for pose in poses]
    frame = np.array(poses[len(poses) // 2])
    frame[:3, 3] = np.mean(centres, axis=0)
    return frame


def coarser(probe: Probe, grid: ImageGrid, references, masks):
    """Half the scan lines, and pixels twice as large in both directions."""
    rows, columns = grid.rows // 2, grid.columns // 2
    spacing = 2.0 * grid.pixel_spacing_mm[0], 2.0 * grid.pixel_spacing_mm[1]

    def shrunk(image: np.ndarray) -> np.ndarray:
        return np.asarray(image, float)[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2).mean(axis=(1, 3))

    images = [np.ascontiguousarray(shrunk(image).round().astype(np.uint8)) for image in references]
    field = grid.field(probe)
    insides = [shrunk(field if masks is None else field & masks[n]) > 0.99 for n in range(len(images))]
    coarse_probe = replace(probe, scan_lines=max(probe.scan_lines // 2, 2))
    return coarse_probe, ImageGrid(rows, columns, grid.left_mm, grid.top_mm, spacing), images, insides


def _coarser_settings(settings: SimulationSettings, probe: Probe) -> SimulationSettings:
    """Fewer scatterers (of the same variance) and rays; no mirror images."""
    return replace(
        settings,
        scatterers_per_mm3=min(sites_per_mm3(settings, probe), _COARSE_SITES_PER_MM3),
        elevational_rays=min(settings.elevational_rays, 3),
        max_ray_depth=min(settings.max_ray_depth, 1),
    )
