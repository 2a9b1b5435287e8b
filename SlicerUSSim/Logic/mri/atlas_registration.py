"""Registration of the atlas to a patient's brain: where each tissue is likely, and where left and right are."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.atlas import Atlas
from SlicerUSSim.Logic.mri.refinement import box_around, on_grid

if TYPE_CHECKING:
    import SimpleITK as sitk

#: Millimetres of the registration's grid, and of the grid on which tissue maps are kept
_COARSE_MM, _MAPS_MM = 4.0, 2.0
#: Smoothing of the tissue maps, which an affine transform leaves some millimetres off, and their least value
_PRIOR_SIGMA_MM, _PRIOR_FLOOR = 3.0, 0.02
#: Overlap of the two brain masks from which the atlas counts as found
_LEAST_DICE = 0.85
#: Start rotations about the patient's axes in degrees, besides none
_TURNS = ((25, 0, 0), (-25, 0, 0), (0, 25, 0), (0, -25, 0), (0, 0, 25), (0, 0, -25))


@dataclass(frozen=True, eq=False)
class AtlasFit:
    """The atlas in a patient's frame."""

    #: (4, 4) from RAS millimetres of the patient to those of the atlas
    patient_to_atlas: np.ndarray
    #: Overlap (Dice) of the atlas's brain with the patient's
    dice: float
    atlas: Atlas

    @property
    def is_good(self) -> bool:
        """Whether the masks overlap well enough for the tissue maps to be of use."""
        return self.dice >= _LEAST_DICE

    def prior(self, grid: Volume, inside: np.ndarray) -> np.ndarray:
        """(3, voxels) float32 share of CSF, grey and white matter to be expected in the voxels `inside` (k, j, i)."""
        shrink, maps = _smooth_maps(self.atlas)
        stride = np.maximum(np.rint(_MAPS_MM / grid.spacing_mm[::-1]).astype(int), 1)
        matrix = self.atlas.t1.ras_to_ijk @ self.patient_to_atlas @ grid.ijk_to_ras
        # scipy wants the map from array indices (k, j, i) of the result to those of the input.
        linear = matrix[:3, :3][::-1, ::-1]
        offset = (matrix[:3, 3][::-1] + linear @ (0.5 * (stride - 1)) - 0.5 * (shrink - 1)) / shrink
        linear = linear * stride / shrink[:, None]
        coarse = tuple(-(-n // step) for n, step in zip(inside.shape, stride, strict=True))
        shares = np.empty((3, int(inside.sum())), np.float32)
        for n, smooth in enumerate(maps):
            warped = ndimage.affine_transform(smooth, linear, offset, coarse, order=1)  # pyright: ignore[reportArgumentType]
            for axis, step in enumerate(stride):
                warped = warped.repeat(step, axis)
            shares[n + 1] = warped[tuple(map(slice, inside.shape))][inside]
        shares[0] = 1.0 - shares[1] - shares[2]
        shares = np.maximum(shares, _PRIOR_FLOOR)
        return shares / shares.sum(axis=0)

    def warped(self, array: np.ndarray, grid: Volume, inside: np.ndarray) -> np.ndarray:
        """(voxels,) float32 values of an `array` on the atlas's grid in the voxels `inside` (k, j, i)."""
        atlas_to_ras = np.linalg.inv(self.patient_to_atlas) @ self.atlas.t1.ijk_to_ras
        corners = np.argwhere(array > 0)
        corners = np.stack([corners.min(axis=0), corners.max(axis=0)])[:, ::-1]
        ends = np.array(list(itertools.product(*corners.T.tolist())))
        box = box_around(ends @ atlas_to_ras[:3, :3].T + atlas_to_ras[:3, 3], grid)
        result = np.zeros(inside.shape, np.float32)
        if result[box].size:
            box_to_ras = grid.ijk_to_ras.copy()
            box_to_ras[:3, 3] = (grid.ijk_to_ras @ [*(part.start for part in box[::-1]), 1.0])[:3]
            result[box] = on_grid(Volume(array, atlas_to_ras), Volume(inside[box], box_to_ras))
        return result[inside]


def register_atlas(
    image: Volume, inside: np.ndarray, atlas: Atlas, progress: Callable[[float], None] | None = None
) -> AtlasFit:
    """The affine transform between the atlas and a brain, by Mattes' mutual information at 4 mm.

    `image` is any contrast, and `inside` (k, j, i) its brain mask. Started from the centres and sizes of the masks, in
    seven orientations. Takes about two seconds.
    """
    import SimpleITK as sitk

    report = progress or (lambda share: None)
    fixed, fixed_mask = _coarse(image, inside)
    moving, moving_mask = _coarse(atlas.t1, atlas.t1.array > 0)
    centres = [_centroid(mask) for mask in (fixed_mask, moving_mask)]
    volumes = [float(sitk.GetArrayViewFromImage(mask).sum()) for mask in (fixed_mask, moving_mask)]
    scale = (volumes[1] / volumes[0]) ** (1.0 / 3.0)
    starts = []
    for turn in ((0, 0, 0), *_TURNS):
        similarity = sitk.Similarity3DTransform()
        similarity.SetCenter(centres[0].tolist())
        similarity.SetTranslation((centres[1] - centres[0]).tolist())
        rotation = sitk.Euler3DTransform()
        rotation.SetRotation(*np.radians(turn).tolist())
        similarity.SetMatrix((np.reshape(rotation.GetMatrix(), (3, 3)) * scale).ravel().tolist())
        starts.append((metric_at(registration_method(bins=32), fixed, moving, similarity), similarity))
    report(0.2)
    starts.sort(key=lambda start: start[0])
    fits = [optimised(_method(40, (2,)), fixed, moving, start) for _, start in starts[:2]]
    best = min(fits, key=lambda found: found[0])[1]
    report(0.6)
    affine = sitk.AffineTransform(3)
    linear, shift = _matrix(best)
    affine.SetCenter(centres[0].tolist())
    affine.SetMatrix(linear.ravel().tolist())
    affine.SetTranslation((linear @ centres[0] + shift - centres[0]).tolist())
    found = optimised(_method(50, (2, 1)), fixed, moving, affine)[1]
    # A separate array: a view of an image that nothing else holds is of memory that is used again
    warped = sitk.GetArrayFromImage(sitk.Resample(moving_mask, fixed_mask, found)) > 0.5
    mask = sitk.GetArrayViewFromImage(fixed_mask) > 0.5
    report(1.0)
    return AtlasFit(_ras_matrix(found), 2.0 * float((warped & mask).sum()) / float(warped.sum() + mask.sum()), atlas)


@cache
def _smooth_maps(atlas: Atlas) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """((3,) k, j, i voxels of the atlas in one of the maps, smooth maps of grey and white matter); the rest is CSF."""
    spacing = atlas.t1.spacing_mm[::-1]
    shrink = np.maximum(np.rint(_MAPS_MM / spacing).astype(int), 1)
    deviation = _PRIOR_SIGMA_MM / (spacing * shrink)
    sources = (atlas.grey.array, atlas.white.array)
    return shrink, tuple(ndimage.gaussian_filter(_block_means(array, shrink), deviation) for array in sources)


def _block_means(array: np.ndarray, shrink: np.ndarray) -> np.ndarray:
    """(k, j, i) float32 means of blocks of `shrink` voxels; the remainder at the far ends is cut off."""
    counts = [size // step for size, step in zip(array.shape, shrink, strict=True)]
    cut = array[tuple(slice(0, n * step) for n, step in zip(counts, shrink, strict=True))]
    shape = [n for pair in zip(counts, shrink, strict=True) for n in pair]
    return cut.reshape(shape).mean(axis=(1, 3, 5), dtype=np.float32)


def _coarse(image: Volume, inside: np.ndarray) -> tuple[sitk.Image, sitk.Image]:
    """(masked image clamped at its 99.5th percentile, mask) at 4 mm with a margin, both float32."""
    import SimpleITK as sitk

    box = ndimage.find_objects(inside.astype(np.uint8))[0]
    margin = np.ceil(3.0 * _COARSE_MM / image.spacing_mm[::-1]).astype(int)
    part = inside[box]
    values = image.array[box].astype(np.float32)
    low, high = np.percentile(values[part], (0.5, 99.5))
    # The background is as dark as the darkest tissue, so that the mask's border counts like an edge.
    values = np.where(part, np.clip(values, low, high) - low + 0.05 * (high - low), 0.0)
    shrink = [max(1, round(_COARSE_MM / mm)) for mm in image.spacing_mm.tolist()]
    origin = np.array([part_.start for part_ in box]) - margin
    matrix = image.ijk_to_ras.copy()
    matrix[:3, 3] = (image.ijk_to_ras @ [*origin[::-1], 1.0])[:3]
    padding = [(n, n) for n in margin]
    arrays = (np.pad(values, padding), np.pad(part.astype(np.float32), padding))
    images = (Volume(array.astype(np.float32), matrix).to_sitk() for array in arrays)
    first, second = (sitk.BinShrink(each, shrink) for each in images)
    return first, second


def _centroid(mask: sitk.Image) -> np.ndarray:
    import SimpleITK as sitk

    centre = np.array(ndimage.center_of_mass(sitk.GetArrayViewFromImage(mask)), float)
    return np.array(mask.TransformContinuousIndexToPhysicalPoint(centre[::-1].tolist()))


def registration_method(bins: int) -> sitk.ImageRegistrationMethod:
    """One by Mattes' mutual information, which gives the same result every time."""
    import SimpleITK as sitk

    method = sitk.ImageRegistrationMethod()
    method.SetMetricAsMattesMutualInformation(bins)
    method.SetInterpolator(sitk.sitkLinear)
    method.SetNumberOfWorkUnits(1)  # ITK adds up what several find in the order in which they end
    return method


def metric_at(method: sitk.ImageRegistrationMethod, fixed: sitk.Image, moving: sitk.Image, transform: Any) -> float:
    """Negative mutual information; 0 where the images do not overlap."""
    method.SetInitialTransform(transform, inPlace=False)
    try:
        return float(method.MetricEvaluate(fixed, moving))
    except RuntimeError:
        return 0.0


def optimised(
    method: sitk.ImageRegistrationMethod, fixed: sitk.Image, moving: sitk.Image, start: Any
) -> tuple[float, Any]:
    """(negative mutual information, transform); (0, start) where the images lose each other."""
    method.SetInitialTransform(start, inPlace=False)
    try:
        found = method.Execute(fixed, moving)
    except RuntimeError:
        return 0.0, start
    return method.GetMetricValue(), found


def _method(iterations: int, shrink: tuple[int, ...]) -> sitk.ImageRegistrationMethod:
    method = registration_method(bins=32)
    method.SetShrinkFactorsPerLevel(shrink)
    method.SetSmoothingSigmasPerLevel([0.5 * factor * _COARSE_MM for factor in shrink])
    method.SmoothingSigmasAreSpecifiedInPhysicalUnitsOn()
    method.SetOptimizerAsRegularStepGradientDescent(
        learningRate=1.0, minStep=0.02, numberOfIterations=iterations, gradientMagnitudeTolerance=1e-6
    )
    method.SetOptimizerScalesFromPhysicalShift()
    return method


def _matrix(transform: sitk.Transform) -> tuple[np.ndarray, np.ndarray]:
    """((3, 3), (3,)) of a linear transform x -> A x + b."""
    shift = np.array(transform.TransformPoint((0.0, 0.0, 0.0)))
    columns = [np.array(transform.TransformPoint(axis)) - shift for axis in np.eye(3).tolist()]
    return np.stack(columns, axis=1), shift


def _ras_matrix(transform: sitk.Transform) -> np.ndarray:
    """(4, 4) in RAS of an ITK transform, which is in LPS."""
    from SlicerUSSim.Logic.base.transforms import LPS_TO_RAS

    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = _matrix(transform)
    return LPS_TO_RAS @ matrix @ LPS_TO_RAS
