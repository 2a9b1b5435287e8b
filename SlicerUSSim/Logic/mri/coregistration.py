"""Rigid registration of several volumes of one patient."""

from __future__ import annotations

from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.block_matching import share_in_place
from SlicerUSSim.Logic.mri.template import entropy

#: Millimetres of the registration's grid
_COARSE_MM = 3.0
#: Start rotations about the left-right axis in degrees, besides none: the head nods between two examinations
_TURNS = (0.0, 20.0, -20.0)
#: Least share of the brain that the other volume has to cover, and least normalised mutual information (Studholme et
#: al., Pattern Recognition 32(1), 1999) in it
_LEAST_COVER, _LEAST_INFORMATION = 0.9, 1.02
#: Share of the brain's parts that lie in the same places, below which there are two patients, and below which a user
#: should look. T1 and T2 of a patient with a glioma had 0.85, phantoms with noise of 7 % 0.95 to 0.98; seven pairs of
#: different heads 0.03 to 0.41.
_LEAST_IN_PLACE, _USUAL_IN_PLACE = 0.55, 0.7
#: Mutual information from which no further start is tried
_FOUND = 0.2


def aligned(other: Volume, reference: Volume, inside: np.ndarray, name: str) -> tuple[Volume, str, tuple[str, ...]]:
    """(the other volume on the grid of the reference, a line that says how it was moved, warnings).

    By Mattes' mutual information at 3 mm in the surroundings of the brain `inside` (k, j, i), from the places that the
    files state and from common centres. Raises SimulationError if the two do not become alike, or their parts lie in
    different places: two patients.
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
    method = sitk.ImageRegistrationMethod()
    method.SetMetricAsMattesMutualInformation(40)
    method.SetMetricFixedMask(mask)
    method.SetInterpolator(sitk.sitkLinear)
    method.SetShrinkFactorsPerLevel([2, 1])
    method.SetSmoothingSigmasPerLevel([_COARSE_MM, 0.0])
    method.SmoothingSigmasAreSpecifiedInPhysicalUnitsOn()
    method.SetOptimizerAsRegularStepGradientDescent(1.0, 0.01, 60, gradientMagnitudeTolerance=1e-6)
    method.SetOptimizerScalesFromPhysicalShift()
    value, best = 0.0, None
    for start in _starts(fixed, moving):
        found = _optimised(method, fixed, moving, start)
        if best is None or found[0] < value:
            value, best = found
        if value < -_FOUND:
            break
    assert best is not None
    resampled = sitk.Resample(other.with_array(other.array.astype(np.float32)).to_sitk(), reference.to_sitk(), best)
    array = sitk.GetArrayFromImage(resampled)
    covered = sitk.Resample(
        other.with_array(np.ones(other.array.shape, np.uint8)).to_sitk(), reference.to_sitk(), best,
        sitk.sitkNearestNeighbor,
    )  # fmt: skip
    cover = float(sitk.GetArrayViewFromImage(covered)[inside].mean())
    require(
        cover >= _LEAST_COVER,
        f"{name}: covers {cover:.0%} of the brain of the first volume, expected {_LEAST_COVER:.0%} or more; "
        "give volumes of one patient that show the whole brain",
    )
    information = normalised_information(reference.array[inside], array[inside])
    require(
        information >= _LEAST_INFORMATION,
        f"{name}: does not match the first volume after registration (normalised mutual information {information:.3f}, "
        f"expected {_LEAST_INFORMATION} or more); check that both are of one patient",
    )
    moved = reference.with_array(array.astype(np.float32))
    in_place = share_in_place(reference, moved, inside)
    share = 1.0 if in_place is None else in_place
    found = (
        f"{name}: {share:.0%} of the brain's parts lie where the first volume has them, expected {_USUAL_IN_PLACE:.0%} "
        "or more of one patient"
    )
    require(share >= _LEAST_IN_PLACE, f"{found}: give volumes of one patient")
    warnings = (f"{found}: check that both are",) if share < _USUAL_IN_PLACE else ()
    centre = fixed.TransformContinuousIndexToPhysicalPoint([0.5 * (n - 1) for n in fixed.GetSize()])
    shift = float(np.linalg.norm(np.subtract(best.TransformPoint(centre), centre)))
    axes = np.stack([np.subtract(best.TransformVector(axis, centre), 0.0) for axis in np.eye(3).tolist()], axis=1)
    angle = float(np.degrees(np.arccos(np.clip(0.5 * (np.trace(axes) - 1.0), -1.0, 1.0))))
    line = f"{name}: registered to the first volume: moved by {shift:.1f} mm, turned by {angle:.1f} degrees"
    return moved, line, warnings


def normalised_information(first: np.ndarray, second: np.ndarray, bins: int = 48) -> float:
    """(H(a) + H(b)) / H(a, b): 1 for two independent sets of values, 2 for two that determine each other."""
    ranges = [np.percentile(values, (0.5, 99.5)) for values in (first, second)]
    edges = [np.linspace(float(low), float(high), bins + 1) for low, high in ranges]
    clipped = [np.clip(values, edge[0], edge[-1]) for values, edge in zip((first, second), edges, strict=True)]
    if any(edge[0] == edge[-1] for edge in edges):
        return 1.0
    joint = np.histogram2d(*clipped, bins=edges)[0]
    joint /= joint.sum()
    return (entropy(joint.sum(axis=0)) + entropy(joint.sum(axis=1))) / entropy(joint.ravel())


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
    for turn in _TURNS:
        start = sitk.Euler3DTransform(centred)
        start.SetRotation(float(np.radians(turn)), 0.0, 0.0)
        starts.append(start)
    return starts


def _optimised(method: Any, fixed: Any, moving: Any, start: Any) -> tuple[float, Any]:
    """(negative mutual information, transform); the start where the images lose each other."""
    method.SetInitialTransform(start, inPlace=False)
    try:
        found = method.Execute(fixed, moving)
    except RuntimeError:
        return 0.0, start
    return method.GetMetricValue(), found
