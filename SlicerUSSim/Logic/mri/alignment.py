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

from SlicerUSSim.Logic.base.neighbourhood import distance_to
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.atlas import mni152
from SlicerUSSim.Logic.mri.coarse import CoarseImage, resampled_to_ras

#: Nodding of the head in degrees and size of the brain in log percent of the template, at which the search starts
_PITCHES, _SIZES = (-30.0, -15.0, 0.0, 15.0, 30.0), (-10.0, 4.0)
#: Expected size: brains of adults have 1000 to 1900 ml, the template (with its CSF) 1886 ml.
_EXPECTED_SIZE, _SIZE_SPREAD = -5.0, 12.0
#: A fit that explains less of the image is repeated without fat. Plain T1s have 0.5 to 0.97
_DOUBTFUL = 0.45
#: Brighter than this many times the inner brain is fat, which drags the fit outwards; depth of that brain, mm; and its
#: least brightness as a share of the image's range, below which (CT, half a head) it does not measure fat
_FAT, _INNER_MM, _LEAST_INNER = 1.5, 15.0, 0.05


@dataclass(frozen=True, eq=False)
class Alignment:
    """Where the template's brain lies in a patient."""

    #: (4, 4) from the template's RAS millimetres to the patient's
    template_to_ras: np.ndarray
    #: Share of the image's variance that the template's tissues explain, 0 to 1; see `explained`
    explained: float

    def brain_on(self, grid: Volume) -> np.ndarray:
        """(k, j, i) float32 signed distance in template millimetres to the template's brain; negative inside it."""
        return template().distance_on(grid, self.template_to_ras)


def align_template(mri: Volume, progress: Callable[[float], None] | None = None) -> Alignment:
    """The template's brain in the MRI of a head.

    If the fit is doubtful, fat is set to air and the fit repeated; the better one is taken.
    """
    report = progress or (lambda share: None)

    def fit(image: Volume, first: float) -> Alignment:
        matrix = _aligned(CoarseImage.of(image), lambda share: report(first + 0.5 * share))
        return Alignment(matrix, explained(mri, matrix))

    found = fit(mri, 0.0)
    if found.explained < _DOUBTFUL:
        found = max(found, fit(_without_fat(mri, found.template_to_ras), 0.5), key=lambda each: each.explained)
    report(1.0)
    return found


def _without_fat(mri: Volume, template_to_ras: np.ndarray) -> Volume:
    """The image with everything much brighter than the inner brain set to air, at full resolution."""
    values = mri.array.astype(np.float32)
    air, high = np.percentile(values[::2, ::2, ::2], (1.0, 99.5))
    inner = values[template().distance_on(mri, template_to_ras) < -_INNER_MM]
    brain = float(np.median(inner)) - air if inner.size else 0.0
    if brain < _LEAST_INNER * (high - air):
        return mri
    return mri.with_array(np.where(values - air > _FAT * brain, air, values).astype(np.float32))


def _aligned(image: CoarseImage, report: Callable[[float], None]) -> np.ndarray:
    """(4, 4) template_to_ras."""
    brain, search, blurred = template(), _Search(image), _Search(image.smoothed(4.0))
    starts = [start for _, start in blurred.starts(_PITCHES, _SIZES, 14.0, 30)]
    report(0.15)
    found = []
    for number, start in enumerate(starts):
        found.append(blurred.improved(start, brain.coarse, 1.0, 1, 1e-2))
        report(0.15 + 0.3 * (number + 1) / len(starts))
    found.sort(key=lambda pair: pair[1])
    found = [search.improved(best, brain.coarse, 1.0, 2) for best, _ in found[:5]]
    found.sort(key=lambda pair: pair[1])
    report(0.6)
    fits = [search.improved(best, brain.fine, 0.7, 2) for best, _ in found[:2]]
    best = np.concatenate([min(fits, key=lambda pair: pair[1])[0], np.zeros(5)])
    report(0.8)
    best, _ = search.improved(best, brain.fine, 0.5, 3)
    report(1.0)
    return search.matrix(best)


@dataclass(frozen=True, eq=False)
class _Search:
    image: CoarseImage

    def linear(self, p: np.ndarray) -> np.ndarray:
        """(3, 3) of parameters: 3 mm, 3 degrees, log percent of size; affine: 2 log percent of shape, 3 shears."""
        from scipy.spatial.transform import Rotation

        matrix = np.exp(p[6] / 100.0) * Rotation.from_euler("xyz", p[3:6], degrees=True).as_matrix()
        if len(p) > 7:
            stretch = np.diag(np.exp(np.array([p[7], p[8], -p[7] - p[8]]) / 100.0))
            shear = np.eye(3)
            shear[[0, 0, 1], [1, 2, 2]] = p[9:12] / 100.0
            matrix = matrix @ stretch @ shear
        return matrix

    def matrix(self, p: np.ndarray) -> np.ndarray:
        """(4, 4) template_to_ras."""
        result = np.eye(4)
        result[:3, :3] = self.linear(p)
        result[:3, 3] = p[:3] - result[:3, :3] @ template().centre
        return result

    def cost(self, p: np.ndarray, points: Points) -> float:
        values = self.image.at(points.from_centre @ self.linear(p).T + p[:3])
        return 0.01 * ((p[6] - _EXPECTED_SIZE) / _SIZE_SPREAD) ** 2 - points.information(values)

    def improved(self, start, points: Points, scale: float, iterations: int, ftol=1e-4) -> tuple[np.ndarray, float]:
        from scipy.optimize import minimize

        unit = scale * np.array([8.0, 8.0, 8.0, 8.0, 8.0, 8.0, 5.0] + [4.0] * (len(start) - 7))
        result = minimize(
            lambda x: self.cost(start + x * unit, points), np.zeros(len(start)), method="Powell",
            options={"maxiter": iterations, "xtol": 0.2 if iterations == 1 else 0.05, "ftol": ftol, "maxfev": 1500},
        )  # fmt: skip
        return start + result.x * unit, float(result.fun)

    def starts(self, pitches, sizes, step_mm: float, most: int) -> list[tuple[float, np.ndarray]]:
        """(information, parameters) of the best and different ones of a grid of places, nods and sizes."""
        points, image = template().coarse, self.image
        k, j, i = np.nonzero(image.foreground)
        inside = image.spacing_mm * np.stack([i, j, k], axis=1) + image.origin
        low, high = np.percentile(inside, (1, 99), axis=0)
        middle = 0.5 * (low + high)
        lines = [
            np.rint((np.arange(a, b + 1, step_mm) - first) / image.spacing_mm).astype(int)
            for a, b, first in zip(
                np.minimum(low + 50, middle), np.maximum(high - 50, middle), image.origin, strict=True
            )
        ]
        scored = []
        for pitch, size in itertools.product(pitches, sizes):
            place = np.array([0.0, 0.0, 0.0, pitch, 0.0, 0.0, size])
            turned = np.rint(points.from_centre @ self.linear(place).T / image.spacing_mm).astype(int)
            # Places are voxels: one addition moves all points, in an image with so much air around it that none leaves.
            margin = int(np.abs(turned).max()) + 1
            padded = np.pad(binned(image.array), margin)
            flat, steps = padded.ravel(), np.array([1, padded.shape[2], padded.shape[1] * padded.shape[2]])
            first = turned @ steps
            for voxel in itertools.product(*lines):
                score = points.information_of(flat[first + (np.array(voxel) + margin) @ steps])
                where = image.origin + image.spacing_mm * np.array(voxel)
                scored.append((score, np.array([*where, *place[3:]])))
        scored.sort(key=lambda pair: -pair[0])
        chosen: list[tuple[float, np.ndarray]] = []
        for score, start in scored:
            apart = [np.abs(start - other) / [16, 16, 16, 14, 1, 1, 3] for _, other in chosen]
            if all(difference.max() > 1 for difference in apart):
                chosen.append((score, start))
            if len(chosen) == most:
                break
        return chosen


# ---- the MNI152 brain as the search uses it: points, their classes, and how well they agree --------------------------

#: Voxel size of the template in the search and width of its dark ring, mm
TEMPLATE_MM, _RING_MM = 5, 6.0
_TEMPLATE_BINS, _PATIENT_BINS = 8, 32


class Points:
    """Points of the template with their class: 0 is the dark ring, the others are intensities of the brain."""

    def __init__(self, xyz: np.ndarray, classes: np.ndarray, centre: np.ndarray) -> None:
        self.from_centre, self.classes = xyz - centre, classes

    def information(self, values: np.ndarray) -> float:
        """Mutual information, in nats, of the classes and (n,) values from 0 to 1."""
        return self.information_of(binned(values))

    def information_of(self, bins: np.ndarray) -> float:
        """The same of (n,) values that are binned."""
        joint = np.bincount(self.classes * _PATIENT_BINS + bins, minlength=_TEMPLATE_BINS * _PATIENT_BINS)
        joint = joint.reshape(_TEMPLATE_BINS, _PATIENT_BINS) / len(bins)
        return entropy(joint.sum(axis=0)) + entropy(joint.sum(axis=1)) - entropy(joint)


def binned(values: np.ndarray) -> np.ndarray:
    """Numbers of the histogram's bins of values from 0 to 1."""
    return np.minimum((values * (_PATIENT_BINS - 1) + 0.5).astype(np.int64), _PATIENT_BINS - 1)


def entropy(shares: np.ndarray) -> float:
    """Entropy in nats of shares that add up to 1."""
    shares = shares[shares > 0]
    return float(-(shares * np.log(shares)).sum())


class Template:
    """The MNI152 T1 at 5 mm: points for the search, and the distance to its brain."""

    def __init__(self) -> None:
        t1 = mni152().t1
        step = slice(None, None, TEMPLATE_MM)
        brain = t1.array > 0
        # Its voxels are of 1 mm.
        outside, inside = (np.maximum(distance_to(side), 0.0) for side in (brain, ~brain))
        self.distance = t1.with_array((outside - inside).astype(np.float32))
        smooth = ndimage.gaussian_filter(t1.array.astype(np.float32), TEMPLATE_MM / 2.4)
        image, is_brain = smooth[step, step, step], brain[step, step, step]
        used = self.distance.array[step, step, step] <= _RING_MM
        k, j, i = np.indices(used.shape)
        grid = TEMPLATE_MM * np.stack([i, j, k], axis=-1)
        grid_xyz = grid @ t1.ijk_to_ras[:3, :3].T + t1.ijk_to_ras[:3, 3]
        self.centre = grid_xyz[is_brain].mean(axis=0)
        borders = np.quantile(image[is_brain], np.arange(1, _TEMPLATE_BINS - 1) / (_TEMPLATE_BINS - 1))
        classes = np.where(is_brain, np.digitize(image, borders) + 1, 0)
        coarse = used & (k % 2 == 0) & (j % 2 == 0) & (i % 2 == 0)
        self.fine, self.coarse = (Points(grid_xyz[at], classes[at], self.centre) for at in (used, coarse))

    def distance_on(self, grid: Volume, template_to_ras: np.ndarray) -> np.ndarray:
        matrix = self.distance.ras_to_ijk @ np.linalg.inv(template_to_ras) @ grid.ijk_to_ras
        order = matrix[:3, :3][::-1, ::-1]
        shift = cast(float, matrix[:3, 3][::-1] + 1.0)  # annotated as a number, takes one for each axis
        padded = np.pad(self.distance.array, 1, mode="edge")  # far outside: at least the distance at the border
        return ndimage.affine_transform(
            padded, order, shift, grid.array.shape, output=np.float32, order=1, mode="nearest"
        )


@cache
def template() -> Template:
    """The template, computed once."""
    return Template()


# ---- how sure a fit is: the share of the image that the template's tissues explain ----------------------------------

#: Voxels in which it is measured, and the width of the windows whose means are left out, as a bias field's, mm
_SCORE_MM, _WINDOW_MM = 3, 20.0


@cache
def _tissues() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(inside (k, j, i), (n, 3) RAS points in it, weight (k, j, i), (n, 2) maps of CSF and white matter)."""
    step = slice(None, None, _SCORE_MM)
    atlas = mni152()
    inside = template().distance.array[step, step, step] < -2.0
    points = _SCORE_MM * np.argwhere(inside)[:, ::-1] @ atlas.t1.ijk_to_ras[:3, :3].T + atlas.t1.ijk_to_ras[:3, 3]
    weight = np.maximum(ndimage.gaussian_filter(inside.astype(np.float32), _WINDOW_MM / _SCORE_MM), 1e-3)
    maps = (ndimage.gaussian_filter(volume.array, 1.5)[step, step, step][inside] for volume in (atlas.csf, atlas.white))
    return inside, points, weight, np.stack([_detail(values, inside, weight) for values in maps], axis=1)


def _detail(values: np.ndarray, inside: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """(n,) values without their means in Gaussian windows."""
    whole = np.zeros(inside.shape, np.float32)
    whole[inside] = values
    return values - (ndimage.gaussian_filter(whole, _WINDOW_MM / _SCORE_MM) / weight)[inside]


def explained(mri: Volume, template_to_ras: np.ndarray) -> float:
    """Share of the image's variance, without a bias field, that the template's CSF and white matter explain, 0 to 1."""
    inside, points, weight, maps = _tissues()
    image, origin = resampled_to_ras(_without_fat(mri, template_to_ras), 2.0)
    index = (points @ template_to_ras[:3, :3].T + template_to_ras[:3, 3] - origin) / 2.0
    values = ndimage.map_coordinates(ndimage.gaussian_filter(image, 0.7), index[:, ::-1].T, order=1, cval=0.0)
    values = _detail(np.clip(values, *np.percentile(values, (1.0, 95.0))), inside, weight)
    total = float((values**2).sum())
    change = np.linalg.lstsq(maps, values, rcond=None)[0]
    return 1.0 - float(((values - maps @ change) ** 2).sum()) / total if total > 0.0 else 0.0
