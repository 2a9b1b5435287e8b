"""Rigid registration of several volumes of one patient."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.coarse import resampled_to_ras
from SlicerUSSim.Logic.mri.no_data import no_data

#: Millimetres of the registration's grid
_COARSE_MM = 3.0
#: Start rotations in degrees about the left-right axis and both others (the head nods most between two examinations),
#: and from how many of the best starts is searched
_NODS, _TURNS, _MOST_SEARCHES = (-24.0, -12.0, 0.0, 12.0, 24.0), (-10.0, 0.0, 10.0), 6
#: Least share of the brain in which the other volume has to have data. With T1 and T2 of a patient, where the T2 has
#: none, 0.86 of the labels are those of the T1 alone.
_LEAST_COVER = 0.8
#: Largest share of the brain in which it may be 0: its own mask may be tighter, CSF may be clipped
_MOST_ZERO = 0.25
#: Share of the brain without data from which it is said
_WORTH_BLANK = 0.02
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
    # One level, as by default: with a T2 of 5 mm slices a smoother one led 33 mm away from the right place.
    method.SetOptimizerAsRegularStepGradientDescent(1.0, 0.01, 60, gradientMagnitudeTolerance=1e-6)
    method.SetOptimizerScalesFromPhysicalShift()
    method.SetNumberOfWorkUnits(1)  # the same result every time, see atlas_registration.py
    best = _registered(method, fixed, moving)
    resampled = sitk.Resample(other.with_array(other.array.astype(np.float32)).to_sitk(), reference.to_sitk(), best)
    array = sitk.GetArrayFromImage(resampled)
    covered = sitk.Resample(
        other.with_array(np.ones(other.array.shape, np.uint8)).to_sitk(), reference.to_sitk(), best,
        sitk.sitkNearestNeighbor,
    )  # fmt: skip
    moved = reference.with_array(array.astype(np.float32))
    has_data = sitk.GetArrayViewFromImage(covered) > 0
    nothing = float((array[inside & has_data] == 0).sum() / inside.sum())
    require(
        nothing <= _MOST_ZERO,
        f"{name}: is 0 in {nothing:.0%} of the brain, as the map of one tissue is, or an image with a gap, expected "
        "intensities in all of it",
    )
    cover = float((has_data & ~no_data(moved))[inside].mean())
    require(
        cover >= _LEAST_COVER,
        f"{name}: has data in {cover:.0%} of the brain of the first volume, expected {_LEAST_COVER:.0%} or more; "
        "give volumes of one patient that show the whole brain",
    )
    share = share_in_place(reference, moved, inside)
    if share is None:
        raise SimulationError(f"{name}: shows nothing where the brain of the first volume is, expected its tissues")
    found = f"{name}: {share:.0%} of the brain's parts lie where the first volume has them, expected"
    require(
        share >= _LEAST_IN_PLACE,
        f"{found} {_LEAST_IN_PLACE:.0%} or more of one patient: two patients, or one does not lie as its header says, "
        "or too different images to be registered by this program",
    )
    is_usual = share >= _USUAL_IN_PLACE
    warnings = () if is_usual else (f"{found} {_USUAL_IN_PLACE:.0%} or more of one patient: check that both are",)
    if cover <= 1.0 - _WORTH_BLANK:
        warnings += (f"{name}: has no data in {1.0 - cover:.0%} of the brain: tissues are less sure there",)
    centre = fixed.TransformContinuousIndexToPhysicalPoint([0.5 * (n - 1) for n in fixed.GetSize()])
    shift = float(np.linalg.norm(np.subtract(best.TransformPoint(centre), centre)))
    axes = np.stack([np.subtract(best.TransformVector(axis, centre), 0.0) for axis in np.eye(3).tolist()], axis=1)
    angle = float(np.degrees(np.arccos(np.clip(0.5 * (np.trace(axes) - 1.0), -1.0, 1.0))))
    line = f"{name}: registered to the first volume: moved by {shift:.1f} mm, turned by {angle:.1f} degrees"
    return moved, line, warnings


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
    value, best = _optimised(method, fixed, moving, first)
    if value >= -_FOUND:
        others.sort(key=lambda start: _value(method, fixed, moving, start))
    for start in others[:_MOST_SEARCHES]:
        if value < -_FOUND:
            break
        found = _optimised(method, fixed, moving, start)
        if found[0] < value:
            value, best = found
    return best


def _value(method: Any, fixed: Any, moving: Any, transform: Any) -> float:
    """Negative mutual information; 0 where the images lose each other."""
    method.SetInitialTransform(transform, inPlace=False)
    try:
        return float(method.MetricEvaluate(fixed, moving))
    except RuntimeError:
        return 0.0


def _optimised(method: Any, fixed: Any, moving: Any, start: Any) -> tuple[float, Any]:
    """(negative mutual information, transform); the start where the images lose each other or it is better."""
    at_start = _value(method, fixed, moving, start)
    try:
        found = method.Execute(fixed, moving)
    except RuntimeError:
        return at_start, start
    value = method.GetMetricValue()
    return (value, found) if value < at_start else (at_start, start)


# ---- one patient or two, by block matching: do the parts of both brains lie in the same places? ----------------------

_SPACING_MM = 2.0
#: Edge of a block, largest shift along an axis (voxels), and share of the block that has to be in the brain
_BLOCK, _REACH, _INSIDE = 8, 3, 0.7
#: Classes of intensity in the first image; blocks that are looked at, at most
_CLASSES, _MOST_BLOCKS = 6, 120
#: What the best place explains more than the middle one, so that a block has a place, and the least blocks with one
_LEAST_PEAK, _LEAST_BLOCKS = 0.1, 10
_NEAR_MM = 3.5


def share_in_place(first: Volume, second: Volume, inside: np.ndarray) -> float | None:
    """Share of the blocks (16 mm) of a brain that fit the second image best within 3.5 mm of their own place.

    Two brains that are registered as wholes have the same outline, and other sulci in it. How well a block fits is the
    correlation ratio (Roche et al., MICCAI 1998), which holds for any relation between two contrasts; places up to 6 mm
    away along each axis are tried. `second` is on the grid of `first`, `inside` (k, j, i) is the brain there. None
    where fewer than ten blocks can tell.
    """
    volumes = (first, second, first.with_array(inside.astype(np.float32)))
    one, other, mask = (np.pad(resampled_to_ras(volume, _SPACING_MM)[0], _REACH) for volume in volumes)
    ranges = [range(_REACH, size - _REACH - _BLOCK, _BLOCK) for size in one.shape]
    corners = [(k, j, i) for k in ranges[0] for j in ranges[1] for i in ranges[2]]
    corners = [at for at in corners if (mask[_block(at)] > 0.5).mean() >= _INSIDE]
    step = max(1, -(-len(corners) // _MOST_BLOCKS))
    found = [shift for at in corners[::step] if (shift := _shift_mm(one, other, at)) is not None]
    if len(found) < _LEAST_BLOCKS:
        return None
    return float(np.mean(np.array(found) <= _NEAR_MM))


def _block(at: tuple[int, int, int], more: int = 0) -> tuple[slice, ...]:
    return tuple(slice(n - more, n + _BLOCK + more) for n in at)


def _shift_mm(one: np.ndarray, other: np.ndarray, at: tuple[int, int, int]) -> float | None:
    """Distance from a block of the first image to where it fits the second best; None for one that fits anywhere."""
    values = one[_block(at)].ravel()
    borders = np.quantile(values, np.arange(1, _CLASSES) / _CLASSES)
    of_class = (np.searchsorted(borders, values) == np.arange(_CLASSES)[:, None]).astype(np.float32)
    places = sliding_window_view(other[_block(at, _REACH)], (_BLOCK,) * 3).reshape(-1, values.size).T
    places = places - places.mean(axis=0)
    # Correlation ratio: variance of the means of the classes, relative to the whole
    counts = np.maximum(of_class.sum(axis=1), 1.0)[:, None]
    ratio = ((of_class @ places) ** 2 / counts).sum(axis=0) / np.maximum((places * places).sum(axis=0), 1e-9)
    best = int(ratio.argmax())
    if ratio[best] - np.median(ratio) < _LEAST_PEAK:
        return None
    shift = np.array(np.unravel_index(best, (2 * _REACH + 1,) * 3)) - _REACH
    return float(_SPACING_MM * np.linalg.norm(shift))
