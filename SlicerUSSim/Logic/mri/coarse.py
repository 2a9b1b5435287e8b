"""Grids of an image: a coarse one along R, A and S, on which heads are recognised, and one without thick slices."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.transforms import LPS_TO_RAS
from SlicerUSSim.Logic.base.volume import Volume

_SPACING_MM = 4.0
#: Slices thicker than this, and than twice the pixels, are divided into ones of at most the second number, mm
_THICK_MM, _THIN_MM = 3.0, 1.5


@dataclass(frozen=True, eq=False)
class CoarseImage:
    """A patient on a grid along R, A and S, smoothed to its voxel size, with intensities from 0 (air) to 1."""

    array: np.ndarray
    origin: np.ndarray
    spacing_mm: float

    @classmethod
    def of(cls, mri: Volume, spacing_mm: float = _SPACING_MM) -> CoarseImage:
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

    @cached_property
    def foreground(self) -> np.ndarray:
        """(k, j, i) True where it is brighter than air: the largest component, with its holes filled."""
        from skimage.filters import threshold_otsu

        inside = largest_component(self.array > 0.5 * threshold_otsu(self.array))
        closed = ndimage.binary_closing(np.pad(inside, 3), iterations=2)[3:-3, 3:-3, 3:-3]
        return ndimage.binary_fill_holes(closed | inside)  # type: ignore[return-value]


def components(inside: np.ndarray, corners: bool = False) -> np.ndarray:
    """(k, j, i) numbers from 1 of the connected parts of a mask, 0 outside; by faces, or by edges and corners too."""
    structure = np.ones((3, 3, 3)) if corners else None
    return np.asarray(ndimage.label(inside, structure)[0])  # type: ignore[index]


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


def slices_divided(mri: Volume) -> tuple[int, int]:
    """(axis of the array along which slices are thick, into how many each is divided); 1 for any other image."""
    sizes = mri.spacing_mm[::-1]
    axis = int(sizes.argmax())
    is_thick = sizes[axis] > max(_THICK_MM, 2.0 * sizes.min())
    return axis, int(np.ceil(sizes[axis] / _THIN_MM)) if is_thick else 1


def with_thin_slices(volume: Volume, interpolate: bool = True) -> Volume:
    """The volume with thick slices divided, intensities interpolated linearly; the same volume if it has none."""
    axis, n = slices_divided(volume)
    if n == 1:
        return volume
    array = volume.array
    if interpolate:
        places = np.clip((np.arange(n * array.shape[axis]) + 0.5) / n - 0.5, 0.0, array.shape[axis] - 1.0)
        low = places.astype(int)
        part = (places - low).astype(np.float32).reshape([-1 if m == axis else 1 for m in range(3)])
        high = np.minimum(low + 1, array.shape[axis] - 1)
        array = array.take(low, axis) * (1.0 - part) + array.take(high, axis) * part
    else:
        array = array.repeat(n, axis)
    divided = np.eye(4)
    divided[2 - axis, 2 - axis], divided[2 - axis, 3] = 1.0 / n, 0.5 / n - 0.5
    return replace(volume, array=array, ijk_to_ras=volume.ijk_to_ras @ divided)


def widened(values: np.ndarray, step: int, shape: tuple[int, ...]) -> np.ndarray:
    """(k, j, i) float32 of `shape` from values at every `step`-th voxel, interpolated linearly and padded."""
    for axis, count in enumerate(shape):
        places = np.arange(count) / step
        low = np.minimum(places.astype(int), values.shape[axis] - 1)
        high = np.minimum(low + 1, values.shape[axis] - 1)
        part = (places - low).astype(np.float32).reshape([-1 if n == axis else 1 for n in range(3)])
        values = values.take(low, axis) * (1.0 - part) + values.take(high, axis) * part
    return values
