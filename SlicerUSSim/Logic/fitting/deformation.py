"""Deformation: a smooth displacement of the tissues, fitted to real images (docs/optimization.md#deformation).

A brain that was opened sinks and is pushed by the probe (brain shift), which no rigid transform follows. The tissues
are displaced in the plane of the middle image by a cubic B-spline of few knots, alike along its normal: one plane, or a
few beside each other, tells no more. What it costs to bend, the mean square of the displacement's gradient, keeps it
from following speckle. Smooth modes are searched first, as the cost has local minima where anatomy is off by more than
its own size. Simulated images are warped in the search, since that takes milliseconds; then the labels themselves are,
and images are simulated from them: only their cost decides whether the deformation is kept.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, ndimage
from scipy.interpolate import BSpline

from SlicerUSSim.Logic.base.settings import DisplaySettings
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.fitting.image_similarity import PatchComparison, SimilaritySettings
from SlicerUSSim.Logic.fitting.registration import coarser, middle_frame
from SlicerUSSim.Logic.fitting.search import Progress, Search
from SlicerUSSim.Logic.fitting.targets import mean_cost, target_comparisons
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.tissue.surfels import Surfels
from SlicerUSSim.Logic.tissue.texture import Texture
from SlicerUSSim.Logic.tracked.images import TrackedImages

_log = logging.getLogger(__name__)

_DEGREE = 3
#: Distance of knots that is aimed at, and the least and largest number of control points along an axis
_KNOT_MM, _FEWEST, _MOST = 25.0, 4, 6
#: Bounds of a control point's displacement
_RANGE_MM = 8.0
#: What a mean square gradient of 1 adds to the cost: 3 mm over 25 mm cost as much as 0.014 of the images' cost
STIFFNESS = 1.0
#: Points along each axis at which the gradient is measured
_LATTICE = 24
#: Of the search: (modes, evaluations, first step in the range), of the first round and of those after it
_STAGES = (((1, 40, 0.2), (3, 90, 0.15), (9, 140, 0.1), (None, 120, 0.06)), ((9, 60, 0.06), (None, 80, 0.05)))
#: Name in nlopt. A simplex is robust against the ripple of the cost due to speckle
_ALGORITHM = "LN_SBPLX"
#: A deformation whose simulated images gain less than this is not kept: other speckle changes the cost as much
_LEAST_GAIN = 0.003


@dataclass(frozen=True, eq=False)
class Deformation:
    """A displacement field: what is simulated at a point p are the tissues that the labels have at p + u(p)."""

    #: (4, 4) from the axes of the middle image (x along its rows, y along its columns, mm) to RAS
    frame: np.ndarray
    #: (2,) mm in these axes, the part of the plane that the knots cover; beyond it u goes on as at its edge
    low_mm: np.ndarray
    high_mm: np.ndarray
    #: (knots along y, knots along x, 2) mm, displacements of the control points along x and y
    control_mm: np.ndarray
    #: Mean and largest |u| in the imaged fields
    mean_mm: float = 0.0
    largest_mm: float = 0.0
    #: The paper's cost of images simulated without and with it, at the parameters with which it was found
    cost_before: float = float("nan")
    cost_after: float = float("nan")
    #: Evaluations of the search
    evaluations: int = 0

    def in_plane(self, points_mm: np.ndarray) -> np.ndarray:
        """(n, 2) mm, the displacement at (n, 2) points in the axes of `frame`."""
        return basis(points_mm, self.low_mm, self.high_mm, self.control_mm.shape[:2]) @ self.control_mm.reshape(-1, 2)

    def at(self, points_ras: np.ndarray) -> np.ndarray:
        """(n, 3) RAS mm, the displacement at (n, 3) points."""
        to_frame = np.linalg.inv(self.frame)
        local = points_ras @ to_frame[:3, :3].T + to_frame[:3, 3]
        return self.in_plane(local[:, :2]) @ self.frame[:3, :2].T

    @property
    def bending(self) -> float:
        """Mean square of the gradient, without unit."""
        return float(
            sum(
                ((matrix @ self.control_mm.reshape(-1, 2)) ** 2).sum(axis=1).mean()
                for matrix in gradients(self.low_mm, self.high_mm, self.control_mm.shape[:2])
            )
        )

    def to_dict(self) -> dict:
        """Plain values for JSON."""
        return {
            "mean_mm": self.mean_mm,
            "largest_mm": self.largest_mm,
            "mean_square_gradient": self.bending,
            "cost_before": self.cost_before,
            "cost_after": self.cost_after,
            "evaluations": self.evaluations,
            "frame": self.frame.tolist(),
            "low_mm": self.low_mm.tolist(),
            "high_mm": self.high_mm.tolist(),
            "control_mm": self.control_mm.tolist(),
        }


def basis(points_mm: np.ndarray, low_mm: np.ndarray, high_mm: np.ndarray, shape: Sequence[int]) -> np.ndarray:
    """(n, knots along y x knots along x) float64 weights of the control points at (n, 2) points (x, y)."""
    down, across = (_along(points_mm[:, axis], low_mm[axis], high_mm[axis], shape[1 - axis]) for axis in (1, 0))
    return (down[:, :, None] * across[:, None, :]).reshape(len(points_mm), -1)


def gradients(low_mm: np.ndarray, high_mm: np.ndarray, shape: Sequence[int]) -> list[np.ndarray]:
    """Two matrices (points, control points): the derivatives along x and y on a lattice over the covered plane."""
    parts = (np.arange(_LATTICE) + 0.5) / _LATTICE
    x, y = (low_mm[axis] + parts * (high_mm[axis] - low_mm[axis]) for axis in (0, 1))
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    found = []
    for axis in (0, 1):
        step = np.zeros(2)
        step[axis] = 1e-3 * (high_mm[axis] - low_mm[axis])
        ahead, behind = (basis(grid + sign * step, low_mm, high_mm, shape) for sign in (1.0, -1.0))
        found.append((ahead - behind) / (2.0 * step[axis]))
    return found


def smooth_modes(low_mm: np.ndarray, high_mm: np.ndarray, shape: Sequence[int]) -> np.ndarray:
    """(control points, control points) columns: displacements of one component, the smoothest first, the largest 1.

    The first is a translation; they are the eigenvectors of the mean square gradient for a mean square displacement.
    """
    parts = (np.arange(_LATTICE) + 0.5) / _LATTICE
    x, y = (low_mm[axis] + parts * (high_mm[axis] - low_mm[axis]) for axis in (0, 1))
    weights = basis(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2), low_mm, high_mm, shape)
    stiff = sum(matrix.T @ matrix for matrix in gradients(low_mm, high_mm, shape))
    _, vectors = linalg.eigh(stiff, weights.T @ weights)
    return vectors / np.abs(weights @ vectors).max(axis=0)


def deformed(simulator: UltrasoundSimulator, deformation: Deformation) -> UltrasoundSimulator:
    """A simulator of the deformed patient, with the same tissues, settings and device."""
    labels = simulator.medium.labels
    place = _source_voxels(labels, deformation)

    def warped(array: np.ndarray | None) -> np.ndarray | None:
        return None if array is None else np.ascontiguousarray(array.reshape(-1)[place])

    texture = simulator.texture
    if texture is not None:
        texture = Texture(*(warped(array) for array in vars(texture).values()))  # type: ignore[arg-type]
    sheets = simulator.medium.sheets
    return UltrasoundSimulator(
        Volume(np.ascontiguousarray(labels.array.reshape(-1)[place]), labels.ijk_to_ras), simulator.medium.tissues,
        simulator.settings, simulator.device, texture, None if sheets is None else _moved(sheets, deformation),
    )  # fmt: skip


def find_deformation(
    simulator: UltrasoundSimulator,
    tracked: TrackedImages,
    display: DisplaySettings,
    *,
    settings: SimilaritySettings | None = None,
    stiffness: float = STIFFNESS,
    progress: Callable[[Progress], None] | None = None,
) -> tuple[Deformation, UltrasoundSimulator]:
    """The deformation with which simulated images are closest to the real ones, and the simulator of what it makes.

    Tissues and display should fit already. If it gains nothing, it is zero, and the simulator the given one.
    """
    settings = settings or SimilaritySettings()
    shown = tracked.grid.field(tracked.probe) & tracked.mask
    frame = middle_frame(tracked.probe, tracked.poses)
    fields = [_in_frame(frame, pose, tracked, shown) for pose in tracked.poses]
    low, high = np.min([f.min(axis=0) for f in fields], axis=0), np.max([f.max(axis=0) for f in fields], axis=0)
    across, down = np.clip(np.rint((high - low) / _KNOT_MM).astype(int), _FEWEST, _MOST)
    full = target_comparisons(
        simulator.device, tracked.probe, tracked.grid, tracked.images, [tracked.mask] * len(tracked.images),
        len(tracked.images), settings,
    )  # fmt: skip

    def cost_of(images: Sequence[np.ndarray]) -> float:
        return mean_cost(one.of(image) for one, image in zip(full, images, strict=True))

    def images_of(made: UltrasoundSimulator) -> list[np.ndarray]:
        still = replace(display, persistence=0.0)
        return [made.simulate(tracked.probe, pose, still, tracked.grid).image for pose in tracked.poses]

    best = Deformation(frame, low, high, np.zeros((int(down), int(across), 2)))
    images = images_of(simulator)
    before = cost_of(images)
    best, kept, made_now = replace(best, cost_before=before, cost_after=before), simulator, best
    evaluations, most = 0, sum(count for stages in _STAGES for _, count, _ in stages)
    modes = smooth_modes(low, high, best.control_mm.shape[:2])
    for number, stages in enumerate(_STAGES, 1):
        warp = _Warp(simulator, tracked, images, made_now, settings, stiffness)
        control = made_now.control_mm
        for count, budget, step in stages:
            part = _Part(warp, modes[:, :count], control)
            search = Search(part, part.describe, most, 0, progress)
            stage = f"deformation {number}.{part.modes.shape[1]}"
            control = part.control(search.minimise(_ALGORITHM, stage, part.start, budget, step))
            evaluations += len(search.history)
        made_now = replace(made_now, control_mm=control)
        changed = deformed(simulator, made_now)
        images = images_of(changed)
        cost = cost_of(images)
        _log.info("deformation: cost %.4f, %.4f without", cost, before)
        if cost + stiffness * made_now.bending < best.cost_after + stiffness * best.bending:
            best, kept = replace(made_now, cost_before=before, cost_after=cost), changed
    if before - best.cost_after < _LEAST_GAIN:
        best = replace(best, control_mm=np.zeros_like(best.control_mm), cost_after=before)
        kept = simulator
    size = np.concatenate([np.linalg.norm(best.in_plane(points), axis=1) for points in fields])
    best = replace(best, mean_mm=float(size.mean()), largest_mm=float(size.max()), evaluations=evaluations)
    return best, kept


class _Warp:
    """The cost of images warped by what a deformation differs from the one they were simulated with."""

    def __init__(
        self,
        simulator: UltrasoundSimulator,
        tracked: TrackedImages,
        images: Sequence[np.ndarray],
        made_with: Deformation,
        settings: SimilaritySettings,
        stiffness: float,
    ) -> None:
        _, grid, references, masks = coarser(
            tracked.probe, tracked.grid, tracked.images, [tracked.mask] * len(tracked.images)
        )
        self.shape = made_with.control_mm.shape
        self.made_with, self.stiffness = made_with, stiffness
        self.comparisons = [
            PatchComparison(simulator.device, reference, mask, grid.pixel_spacing_mm, settings)
            for reference, mask in zip(references, masks, strict=True)
        ]
        rows, columns = grid.rows, grid.columns
        self.images = [
            image[: 2 * rows, : 2 * columns].astype(np.float32).reshape(rows, 2, columns, 2).mean(axis=(1, 3))
            for image in images
        ]
        self.pixels = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")).astype(np.float32)
        coarse = replace(tracked, grid=grid, mask=np.ones((rows, columns), bool), images=references)
        everywhere = np.ones((rows, columns), bool)
        self.basis, self.to_pixels = [], []
        for pose in tracked.poses:
            points = _in_frame(made_with.frame, pose, coarse, everywhere)
            self.basis.append(basis(points, made_with.low_mm, made_with.high_mm, self.shape[:2]).astype(np.float32))
            # From displacements in the frame to rows and columns of this image
            turn = (pose[:3, :3].T @ made_with.frame[:3, :2])[:2]
            self.to_pixels.append((turn / np.array(grid.pixel_spacing_mm)[:, None])[::-1].astype(np.float32))
        self.gradients = gradients(made_with.low_mm, made_with.high_mm, self.shape[:2])

    def __call__(self, control: np.ndarray) -> float:
        more = (control - self.made_with.control_mm).reshape(-1, 2).astype(np.float32)
        costs = []
        for image, weights, turn, comparison in zip(
            self.images, self.basis, self.to_pixels, self.comparisons, strict=True
        ):
            shift = (turn @ (weights @ more).T).reshape(2, *image.shape)
            warped = ndimage.map_coordinates(image, self.pixels + shift, order=1, mode="nearest")
            costs.append(comparison.of(np.clip(np.rint(warped), 0, 255).astype(np.uint8)).total)
        bending = sum(((matrix @ control.reshape(-1, 2)) ** 2).sum(axis=1).mean() for matrix in self.gradients)
        return float(np.mean(costs) + self.stiffness * bending)


class _Part:
    """The cost as a function of some modes' amplitudes, scaled to 0 to 1, about a given deformation."""

    def __init__(self, warp: _Warp, modes: np.ndarray, around: np.ndarray) -> None:
        self.warp, self.modes, self.around = warp, modes, around
        self.start = np.full(2 * modes.shape[1], 0.5)

    def control(self, units: np.ndarray) -> np.ndarray:
        """(knots, knots, 2) mm of positions from 0 to 1."""
        amplitudes = (2.0 * np.asarray(units).reshape(-1, 2) - 1.0) * _RANGE_MM
        moved = self.around + (self.modes @ amplitudes).reshape(self.around.shape)
        return np.clip(moved, -_RANGE_MM, _RANGE_MM)

    def describe(self, units: np.ndarray) -> dict[str, float]:
        """The largest displacement of a control point, for progress."""
        return {"deformation_mm": float(np.abs(self.control(units)).max())}

    def __call__(self, units: np.ndarray) -> float:
        return self.warp(self.control(units))


def _along(places: np.ndarray, low: float, high: float, count: int) -> np.ndarray:
    """(n, count) weights of a clamped cubic B-spline of `count` control points between two ends."""
    inner = np.linspace(0.0, 1.0, count - _DEGREE + 1)
    knots = np.concatenate([np.zeros(_DEGREE), inner, np.ones(_DEGREE)])
    parts = np.clip((np.asarray(places, float) - low) / (high - low), 0.0, 1.0)
    return BSpline.design_matrix(parts, knots, _DEGREE).toarray()


def _in_frame(frame: np.ndarray, pose: np.ndarray, tracked: TrackedImages, where: np.ndarray) -> np.ndarray:
    """(n, 2) mm, the pixels of an image in `where` in the axes of the frame."""
    grid = tracked.grid
    rows, columns = np.nonzero(where)
    x = grid.left_mm + grid.pixel_spacing_mm[0] * (columns + 0.5)
    y = grid.top_mm + grid.pixel_spacing_mm[1] * (rows + 0.5)
    points = np.stack([x, y, np.zeros_like(x), np.ones_like(x)], axis=1)
    return (points @ (np.linalg.inv(frame) @ pose).T)[:, :2]


def _source_voxels(labels: Volume, deformation: Deformation) -> np.ndarray:
    """(k, j, i) flat index of the voxel whose label every voxel gets: the nearest to where it is displaced from."""
    shape = np.array(labels.array.shape)
    # The field is smooth: at every fourth voxel, and linear between
    coarse = [np.unique(np.append(np.arange(0, size, 4), size - 1)) for size in shape]
    ijk = np.stack(np.meshgrid(*coarse, indexing="ij"), axis=-1).reshape(-1, 3)[:, ::-1].astype(float)
    moved = deformation.at(ijk @ labels.ijk_to_ras[:3, :3].T + labels.ijk_to_ras[:3, 3])
    in_voxels = (moved @ labels.ras_to_ijk[:3, :3].T)[:, ::-1].reshape(*map(len, coarse), 3)
    places = [np.interp(np.arange(size), at, np.arange(len(at))) for size, at in zip(shape, coarse, strict=True)]
    found = np.empty(tuple(shape), np.intp)
    for k in range(shape[0]):  # a plane at a time, for memory
        at = np.stack(np.meshgrid([places[0][k]], places[1], places[2], indexing="ij")).reshape(3, -1)
        index = 0
        here = np.indices((1, *shape[1:])).reshape(3, -1).astype(float)
        here[0] = k
        for axis in range(3):
            shift = ndimage.map_coordinates(in_voxels[..., axis], at, order=1, mode="nearest")
            nearest = np.clip(np.rint(here[axis] + shift), 0, shape[axis] - 1).astype(np.intp)
            index = index * shape[axis] + nearest
        found[k] = np.asarray(index).reshape(tuple(shape[1:]))
    return found


def _moved(sheets: Surfels, deformation: Deformation) -> Surfels:
    """The sheets where the deformation has brought them: places p with p + u(p) = their place before."""
    before = sheets.place.astype(float)
    place = before.copy()
    for _ in range(8):  # a contraction, since u changes by less than the distance
        place = before - deformation.at(place)
    return replace(sheets, place=place.astype(np.float32))
