"""Rigid registration of several volumes of one patient."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.atlas_registration import metric_at, optimised, registration_method

#: Millimetres of the registration's grid
_COARSE_MM = 3.0
#: Start rotations in degrees about the left-right axis and both others (the head nods most between two examinations),
#: and from how many of the best starts is searched
_NODS, _TURNS, _MOST_SEARCHES = (-24.0, -12.0, 0.0, 12.0, 24.0), (-10.0, 0.0, 10.0), 6
#: Least share of the brain in which the other volume has to have data. With T1 and T2 of a patient, where the T2 has
#: none, 0.86 of the labels agree with the T1 alone; its own mask may be tighter, and CSF may be clipped.
_LEAST_COVER = 0.75
#: Mutual information from which no further start is tried
_FOUND = 0.2


def aligned(other: Volume, reference: Volume, inside: np.ndarray, name: str) -> tuple[Volume, str]:
    """(the other volume on the grid of the reference, a line that says how it was moved).

    By Mattes' mutual information at 3 mm in the surroundings of the brain `inside` (k, j, i), from the places that the
    files state and from common centres. Raises SimulationError where the other has no data in much of the brain.
    """
    import SimpleITK as sitk
    from scipy import ndimage

    fixed = _smooth(reference.with_array(reference.array.astype(np.float32)).to_sitk())
    moving = _smooth(other.with_array(other.array.astype(np.float32)).to_sitk())
    near = ndimage.binary_dilation(inside[::2, ::2, ::2], iterations=3)
    near = near.repeat(2, 0).repeat(2, 1).repeat(2, 2)[tuple(map(slice, inside.shape))]
    mask = sitk.Resample(
        reference.with_array(near.astype(np.uint8)).to_sitk(), fixed, sitk.Transform(), sitk.sitkNearestNeighbor
    )
    method = registration_method(bins=40)
    method.SetMetricFixedMask(mask)
    # One level, as by default: with a T2 of 5 mm slices a smoother one led 33 mm away from the right place.
    method.SetOptimizerAsRegularStepGradientDescent(1.0, 0.01, 60, gradientMagnitudeTolerance=1e-6)
    method.SetOptimizerScalesFromPhysicalShift()
    best = _registered(method, fixed, moving)
    resampled = sitk.Resample(other.with_array(other.array.astype(np.float32)).to_sitk(), reference.to_sitk(), best)
    moved = reference.with_array(sitk.GetArrayFromImage(resampled))
    cover = float((moved.array[inside] != 0).mean())
    require(
        cover >= _LEAST_COVER,
        f"{name}: has data (other than 0) in {cover:.0%} of the brain of the first volume, expected "
        f"{_LEAST_COVER:.0%} or more; give volumes of one patient that show the whole brain",
    )
    centre = fixed.TransformContinuousIndexToPhysicalPoint([0.5 * (n - 1) for n in fixed.GetSize()])
    shift = float(np.linalg.norm(np.subtract(best.TransformPoint(centre), centre)))
    axes = np.stack([np.subtract(best.TransformVector(axis, centre), 0.0) for axis in np.eye(3).tolist()], axis=1)
    angle = float(np.degrees(np.arccos(np.clip(0.5 * (np.trace(axes) - 1.0), -1.0, 1.0))))
    line = f"{name}: registered to the first volume: moved by {shift:.1f} mm, turned by {angle:.1f} degrees"
    return moved, line


def _smooth(image: Any) -> Any:
    """The image by means over about 3 mm."""
    import SimpleITK as sitk

    sides = zip(image.GetSpacing(), image.GetSize(), strict=True)
    return sitk.BinShrink(image, [max(1, min(round(_COARSE_MM / mm), n // 4)) for mm, n in sides])


def _starts(fixed: Any, moving: Any) -> list[Any]:
    """Transforms: none, as the files state; and from centre of gravity to centre of gravity, turned."""
    import SimpleITK as sitk

    centred = sitk.CenteredTransformInitializer(
        fixed, moving, sitk.Euler3DTransform(), sitk.CenteredTransformInitializerFilter.MOMENTS
    )
    plain = sitk.Euler3DTransform(centred)
    plain.SetTranslation((0.0, 0.0, 0.0))
    starts = [plain]
    for turn in itertools.product(_NODS, _TURNS, _TURNS):
        start = sitk.Euler3DTransform(centred)
        start.SetRotation(*np.radians(turn).tolist())
        starts.append(start)
    return starts


def _registered(method: Any, fixed: Any, moving: Any) -> Any:
    """The transform, searched from where the files place the images, and else from the best starts."""
    first, *others = _starts(fixed, moving)
    value, best = optimised(method, fixed, moving, first)
    if value >= -_FOUND:
        others.sort(key=lambda start: metric_at(method, fixed, moving, start))
    for start in others[:_MOST_SEARCHES]:
        if value < -_FOUND:
            break
        value, best = min((value, best), optimised(method, fixed, moving, start), key=lambda found: found[0])
    return best
