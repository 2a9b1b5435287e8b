"""Affine alignment of the MNI152 brain with the MRI of a head or a brain, from several starts.

The template is skull-stripped and the patient is not: the mutual information is therefore taken over the template's
brain and a ring of 6 mm around it, where the skull is dark, and never over the scalp.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import cast

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import required
from SlicerUSSim.Logic.base.transforms import LPS_TO_RAS
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.atlas import mni152
from SlicerUSSim.Logic.mri.distances import distance_to

#: Voxel sizes of the template and the patient in the search, and width of the template's dark ring, mm
_TEMPLATE_MM, _PATIENT_MM, _RING_MM = 5, 4.0, 6.0
_TEMPLATE_BINS, _PATIENT_BINS = 8, 32
#: Nodding of the head in degrees and size of the brain in log percent of the template, at which the search starts
_PITCHES, _SIZES = (-30.0, -15.0, 0.0, 15.0, 30.0), (-10.0, 4.0)
#: Expected size: brains of adults have 1000 to 1900 ml, the template (with its CSF) 1886 ml.
_EXPECTED_SIZE, _SIZE_SPREAD = -5.0, 12.0


@dataclass(frozen=True, eq=False)
class Alignment:
    """Where the template's brain lies in a patient."""

    #: (4, 4) from the template's RAS millimetres to the patient's
    template_to_ras: np.ndarray
    #: Mean squared local correlation with the template in the brain, 0 to 1: about 0.05 by chance (see docs)
    agreement: float
    #: Size relative to the template, as the cube root of the ratio of volumes
    size: float

    @property
    def turn_deg(self) -> float:
        """Angle by which the head is turned against the template, degrees."""
        return self.turn_from(np.eye(3))

    def turn_from(self, turn: np.ndarray) -> float:
        """Angle between the head and the template after a (3, 3) turn, degrees."""
        left, _, right = np.linalg.svd(turn.T @ self.template_to_ras[:3, :3])
        return float(np.degrees(np.arccos(np.clip((np.trace(left @ right) - 1.0) / 2.0, -1.0, 1.0))))

    @property
    def stretch(self) -> float:
        """Largest over smallest size of the brain relative to the template, over all directions."""
        sizes = np.linalg.svd(self.template_to_ras[:3, :3], compute_uv=False)
        return float(sizes[0] / sizes[-1])

    def brain_on(self, grid: Volume) -> np.ndarray:
        """(k, j, i) float32 signed distance in template millimetres to the template's brain; negative inside it."""
        return _template().distance_on(grid, self.template_to_ras)


@dataclass(frozen=True, eq=False)
class CoarseImage:
    """A patient on a grid along R, A and S, smoothed to its voxel size, with intensities from 0 (air) to 1."""

    array: np.ndarray
    origin: np.ndarray
    spacing_mm: float

    @classmethod
    def of(cls, mri: Volume, spacing_mm: float = _PATIENT_MM) -> CoarseImage:
        """The bright fat of the scalp is clamped at the 99th percentile of the foreground."""
        array, origin = resampled_to_ras(mri, spacing_mm)
        low, high = np.percentile(array, (0.5, 99.5))
        bright = array[array > low + 0.05 * (high - low)]
        high = float(np.percentile(bright, 99.0)) if bright.size else high
        return cls(np.clip((array - low) / max(high - low, 1e-12), 0.0, 1.0).astype(np.float32), origin, spacing_mm)

    def smoothed(self, deviation_mm: float) -> CoarseImage:
        """The image after a Gaussian filter."""
        return CoarseImage(
            ndimage.gaussian_filter(self.array, deviation_mm / self.spacing_mm), self.origin, self.spacing_mm
        )

    def at(self, points: np.ndarray) -> np.ndarray:
        """Values at (n, 3) RAS points by linear interpolation; 0 outside."""
        index = (points - self.origin) / self.spacing_mm
        return ndimage.map_coordinates(self.array, index[:, ::-1].T, order=1, mode="constant", cval=0.0)

    def foreground(self) -> np.ndarray:
        """(k, j, i) True where it is brighter than air: the largest component, with its holes filled."""
        from skimage.filters import threshold_otsu

        inside = largest_component(self.array > 0.5 * threshold_otsu(self.array))
        closed = ndimage.binary_closing(np.pad(inside, 3), iterations=2)[3:-3, 3:-3, 3:-3]
        return ndimage.binary_fill_holes(closed | inside)  # type: ignore[return-value]


def largest_component(inside: np.ndarray) -> np.ndarray:
    """(k, j, i) the largest connected part of a mask."""
    components, count = ndimage.label(inside)  # type: ignore[misc]
    return inside if count < 2 else components == np.argmax(np.bincount(components.ravel())[1:]) + 1


def resampled_to_ras(mri: Volume, spacing_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """((k, j, i) float32 on axes R, A, S, (3,) RAS of its first voxel): averaged over blocks, then interpolated."""
    import SimpleITK as sitk

    image = sitk.Cast(mri.to_sitk(), sitk.sitkFloat32)
    air = float(np.percentile(mri.array[::4, ::4, ::4], 0.5))
    factors = [max(1, int(spacing_mm / size + 0.25)) for size in image.GetSpacing()]
    image = sitk.BinShrink(image, [min(n, size) for n, size in zip(factors, image.GetSize(), strict=True)])
    counts = np.array(mri.array.shape[::-1])
    corners = np.array(list(itertools.product(*((0, n - 1) for n in counts))))
    corners = corners @ mri.ijk_to_ras[:3, :3].T + mri.ijk_to_ras[:3, 3]
    low, high = corners.min(axis=0), corners.max(axis=0)
    size = (np.ceil((high - low) / spacing_mm) + 1).astype(int)
    direction = np.diag(np.diag(LPS_TO_RAS)[:3]).ravel().tolist()
    origin = (LPS_TO_RAS @ [*low, 1.0])[:3].tolist()
    resampled = sitk.Resample(
        image, size.tolist(), sitk.Transform(), sitk.sitkLinear, origin, [spacing_mm] * 3, direction, air
    )
    return sitk.GetArrayFromImage(resampled), low


class _Points:
    """Points of the template with their class: 0 is the dark ring, the others are intensities of the brain."""

    def __init__(self, xyz: np.ndarray, classes: np.ndarray, centre: np.ndarray) -> None:
        self.from_centre, self.classes = xyz - centre, classes

    def information(self, values: np.ndarray) -> float:
        """Mutual information, in nats, of the classes and (n,) values from 0 to 1."""
        bins = np.minimum((values * (_PATIENT_BINS - 1) + 0.5).astype(np.int64), _PATIENT_BINS - 1)
        joint = np.bincount(self.classes * _PATIENT_BINS + bins, minlength=_TEMPLATE_BINS * _PATIENT_BINS)
        joint = joint.reshape(_TEMPLATE_BINS, _PATIENT_BINS) / len(values)
        return entropy(joint.sum(axis=0)) + entropy(joint.sum(axis=1)) - entropy(joint)


def entropy(shares: np.ndarray) -> float:
    """Entropy in nats of shares that add up to 1."""
    shares = shares[shares > 0]
    return float(-(shares * np.log(shares)).sum())


class _Template:
    """The MNI152 T1 at 5 mm: points for the search, an image for the agreement, and the distance to its brain."""

    def __init__(self) -> None:
        t1 = required(mni152(), "the brain atlas needs nilearn; install it with: pip install nilearn").t1
        step = slice(None, None, _TEMPLATE_MM)
        brain = t1.array > 0
        # Its voxels are of 1 mm.
        outside, inside = (np.maximum(distance_to(side), 0.0) for side in (brain, ~brain))
        self.distance = t1.with_array((outside - inside).astype(np.float32))
        smooth = ndimage.gaussian_filter(t1.array.astype(np.float32), _TEMPLATE_MM / 2.4)
        self.image, self.is_brain = smooth[step, step, step], brain[step, step, step]
        used = self.distance.array[step, step, step] <= _RING_MM
        k, j, i = np.indices(used.shape)
        grid = _TEMPLATE_MM * np.stack([i, j, k], axis=-1)
        grid_xyz = grid @ t1.ijk_to_ras[:3, :3].T + t1.ijk_to_ras[:3, 3]
        self.brain_xyz = grid_xyz[self.is_brain]
        self.centre = self.brain_xyz.mean(axis=0)
        self.model = np.where(self.is_brain, self.image / self.image.max(), 0.0).astype(np.float32)
        self._weight = self._windows(self.is_brain.astype(np.float32))
        mean = self.local_mean(self.model)
        self.local = mean, self.local_mean(self.model**2) - mean**2
        borders = np.quantile(self.image[self.is_brain], np.arange(1, _TEMPLATE_BINS - 1) / (_TEMPLATE_BINS - 1))
        classes = np.where(self.is_brain, np.digitize(self.image, borders) + 1, 0)
        coarse = used & (k % 2 == 0) & (j % 2 == 0) & (i % 2 == 0)
        self.fine, self.coarse = (_Points(grid_xyz[at], classes[at], self.centre) for at in (used, coarse))

    def _windows(self, values: np.ndarray) -> np.ndarray:
        return ndimage.gaussian_filter(values, 10.0 / _TEMPLATE_MM)[self.is_brain]

    def local_mean(self, values: np.ndarray) -> np.ndarray:
        """(points of the brain,) means in Gaussian windows of 10 mm deviation of (k, j, i) values, 0 outside it."""
        return self._windows(values) / self._weight

    def distance_on(self, grid: Volume, template_to_ras: np.ndarray) -> np.ndarray:
        matrix = self.distance.ras_to_ijk @ np.linalg.inv(template_to_ras) @ grid.ijk_to_ras
        order = matrix[:3, :3][::-1, ::-1]
        shift = cast(float, matrix[:3, 3][::-1] + 1.0)  # annotated as a number, takes one for each axis
        padded = np.pad(self.distance.array, 1, mode="edge")  # far outside: at least the distance at the border
        return ndimage.affine_transform(
            padded, order, shift, grid.array.shape, output=np.float32, order=1, mode="nearest"
        )


@cache
def _template() -> _Template:
    return _Template()


def align_template(
    mri: Volume, *, turn: np.ndarray | None = None, quick: bool = False, progress: Callable[[float], None] | None = None
) -> Alignment:
    """The template's brain in the MRI of a head.

    `turn` (3, 3) is applied to the template first, to ask how the head lies. `quick` is for such questions: fewer
    starts, no affine. Raises SimulationError if nilearn is not installed.
    """
    image = CoarseImage.of(mri)
    return align_coarse(image, turn=turn, quick=quick, progress=progress)


def align_coarse(
    image: CoarseImage,
    *,
    turn: np.ndarray | None = None,
    quick: bool = False,
    progress: Callable[[float], None] | None = None,
) -> Alignment:
    """See align_template."""
    template, report = _template(), progress or (lambda share: None)
    search = _Search(image, np.eye(3) if turn is None else turn)
    blurred = search.of(image.smoothed(4.0))
    starts = blurred.starts(_PITCHES[1::2] if quick else _PITCHES, 18.0 if quick else 14.0, 8 if quick else 30)
    report(0.15)
    found = []
    for number, start in enumerate(starts):
        found.append(blurred.improved(start, template.coarse, 1.0, 1, 1e-2))
        report(0.15 + 0.3 * (number + 1) / len(starts))
    found.sort(key=lambda pair: pair[1])
    found = [search.improved(best, template.coarse, 1.0, 2) for best, _ in found[: 2 if quick else 5]]
    found.sort(key=lambda pair: pair[1])
    report(0.6)
    if not quick:
        fits = [search.improved(best, template.fine, 0.7, 2) for best, _ in found[:2]]
        best = np.concatenate([min(fits, key=lambda pair: pair[1])[0], np.zeros(5)])
        report(0.8)
        found = [search.improved(best, template.fine, 0.5, 3)]
    matrix = search.matrix(found[0][0])
    report(1.0)
    size = float(np.cbrt(abs(np.linalg.det(matrix[:3, :3]))))
    return Alignment(matrix, _agreement(image, matrix), size)


def agreement_by_moments(image: CoarseImage, inside: np.ndarray, turn: np.ndarray) -> float:
    """Best agreement (0 to 1) of nodding templates turned by (3, 3) `turn`, at the centre and of the size of `inside`.

    `inside` (k, j, i) is the brain of an image that shows nothing else.
    """
    template, search = _template(), _Search(image, turn)
    centre = image.origin + image.spacing_mm * np.argwhere(inside).mean(axis=0)[::-1]
    sizes = inside.sum() * image.spacing_mm**3, template.is_brain.sum() * float(_TEMPLATE_MM) ** 3
    log_percent = 100.0 * np.log(sizes[0] / sizes[1]) / 3.0
    places = (np.array([*centre, pitch, 0.0, 0.0, log_percent]) for pitch in _PITCHES[::2])
    return max(_agreement(image, search.matrix(place)) for place in places)


@dataclass(frozen=True, eq=False)
class _Search:
    image: CoarseImage
    turn: np.ndarray

    def of(self, image: CoarseImage) -> _Search:
        return _Search(image, self.turn)

    def linear(self, p: np.ndarray) -> np.ndarray:
        """(3, 3) of parameters: 3 mm, 3 degrees, log percent of size; affine: 2 log percent of shape, 3 shears."""
        from scipy.spatial.transform import Rotation

        matrix = np.exp(p[6] / 100.0) * Rotation.from_euler("xyz", p[3:6], degrees=True).as_matrix()
        if len(p) > 7:
            stretch = np.diag(np.exp(np.array([p[7], p[8], -p[7] - p[8]]) / 100.0))
            shear = np.eye(3)
            shear[[0, 0, 1], [1, 2, 2]] = p[9:12] / 100.0
            matrix = matrix @ stretch @ shear
        return self.turn @ matrix

    def matrix(self, p: np.ndarray) -> np.ndarray:
        """(4, 4) template_to_ras."""
        result = np.eye(4)
        result[:3, :3] = self.linear(p)
        result[:3, 3] = p[:3] - result[:3, :3] @ _template().centre
        return result

    def cost(self, p: np.ndarray, points: _Points) -> float:
        values = self.image.at(points.from_centre @ self.linear(p).T + p[:3])
        return 0.01 * ((p[6] - _EXPECTED_SIZE) / _SIZE_SPREAD) ** 2 - points.information(values)

    def improved(self, start, points: _Points, scale: float, iterations: int, ftol=1e-4) -> tuple[np.ndarray, float]:
        from scipy.optimize import minimize

        unit = scale * np.array([8.0, 8.0, 8.0, 8.0, 8.0, 8.0, 5.0] + [4.0] * (len(start) - 7))
        result = minimize(
            lambda x: self.cost(start + x * unit, points), np.zeros(len(start)), method="Powell",
            options={"maxiter": iterations, "xtol": 0.2 if iterations == 1 else 0.05, "ftol": ftol, "maxfev": 1500},
        )  # fmt: skip
        return start + result.x * unit, float(result.fun)

    def starts(self, pitches, step_mm: float, most: int) -> list[np.ndarray]:
        """The best and different ones of a grid of places, sizes and nods."""
        points, image = _template().coarse, self.image
        k, j, i = np.nonzero(image.foreground())
        inside = image.spacing_mm * np.stack([i, j, k], axis=1) + image.origin
        low, high = np.percentile(inside, (1, 99), axis=0)
        middle = 0.5 * (low + high)
        lines = [
            np.arange(a, b + 1, step_mm)
            for a, b in zip(np.minimum(low + 50, middle), np.maximum(high - 50, middle), strict=True)
        ]
        scored = []
        for pitch, size in itertools.product(pitches, _SIZES):
            place = np.array([0.0, 0.0, 0.0, pitch, 0.0, 0.0, size])
            turned = points.from_centre @ self.linear(place).T
            for where in itertools.product(*lines):
                scored.append((points.information(image.at(turned + where)), np.array([*where, *place[3:]])))
        scored.sort(key=lambda pair: -pair[0])
        chosen: list[np.ndarray] = []
        for _, start in scored:
            apart = [np.abs(start - other) / [16, 16, 16, 14, 1, 1, 3] for other in chosen]
            if all(difference.max() > 1 for difference in apart):
                chosen.append(start)
            if len(chosen) == most:
                break
        return chosen


def _agreement(image: CoarseImage, template_to_ras: np.ndarray) -> float:
    """Mean over the template's brain of the squared correlation with the patient in windows of 10 mm deviation.

    Local, so that neither a bias field nor the contrast matters: it asks whether borders are in the same places.
    """
    template = _template()
    points = template.brain_xyz @ template_to_ras[:3, :3].T + template_to_ras[:3, 3]
    patient = np.zeros(template.is_brain.shape, np.float32)
    patient[template.is_brain] = image.at(points)
    mean_model, variance_model = template.local
    mean_patient = template.local_mean(patient)
    covariance = template.local_mean(template.model * patient) - mean_model * mean_patient
    variances = variance_model * (template.local_mean(patient**2) - mean_patient**2)
    return float(np.mean(covariance**2 / np.maximum(variances, 1e-10)))
