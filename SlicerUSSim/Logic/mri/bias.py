"""The bias field of an MRI: whether there is one, and its correction by N4."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.volume import Volume

#: Millimetres of the grid on which the field is estimated
_COARSE_MM = 4.0
#: Ratio of the 95th to the 5th percentile of the field in the brain, less 1, from which it is corrected
LEAST_FIELD = 0.05


def field_strength(image: Volume, tissue: np.ndarray, expected: np.ndarray) -> float:
    """How far a smooth field spreads: the ratio of its 95th to its 5th percentile in the brain, less 1.

    The field is a polynomial of second order, fitted to the logarithm of the intensity of the voxels `tissue` (k, j, i)
    over that which their class has, `expected`, with three rounds that leave out what does not fit.
    """
    step = tuple(slice(None, None, max(1, round(_COARSE_MM / mm))) for mm in image.spacing_mm[::-1])
    inside = tissue[step] & (image.array[step] > 0)
    if inside.sum() < 500:
        return 0.0
    ratio = np.log(image.array[step][inside] / expected[step][inside])
    places = (np.argwhere(inside) / np.array(inside.shape) - 0.5) * 2.0
    terms = [np.ones(len(places)), *places.T, *(places.T**2), *(places.T * np.roll(places.T, 1, axis=0))]
    design = np.stack(terms, axis=1)
    keep = np.ones(len(ratio), bool)
    fitted = np.zeros(len(ratio))
    for _ in range(3):
        fitted = design @ np.linalg.lstsq(design[keep], ratio[keep], rcond=None)[0]
        away = np.abs(ratio - fitted)
        keep = away < 3.0 * np.median(away[keep]) + 1e-6
    low, high = np.percentile(fitted, (5, 95))
    return float(np.exp(high - low) - 1.0)


def without_bias(image: Volume, inside: np.ndarray, report: Callable[[float], None]) -> np.ndarray:
    """(k, j, i) float32 image without its bias field (N4: Tustison et al., IEEE TMI 29(6), 2010).

    The field is estimated on means over 4 mm of the voxels `inside`, and applied to all voxels.
    """
    import SimpleITK as sitk

    box = ndimage.find_objects(inside.astype(np.uint8))[0]
    first = np.array([part.start for part in box])
    matrix = image.ijk_to_ras.copy()
    matrix[:3, 3] = (image.ijk_to_ras @ [*first[::-1], 1.0])[:3]
    part = Volume(np.where(inside[box], image.array[box], 0).astype(np.float32), matrix)
    shrink = [
        max(1, min(round(_COARSE_MM / mm), n // 8))
        for mm, n in zip(part.spacing_mm, part.array.shape[::-1], strict=True)
    ]
    mask = sitk.BinShrink(part.with_array(inside[box].astype(np.float32)).to_sitk(), shrink)
    means = sitk.Divide(sitk.BinShrink(part.to_sitk(), shrink), sitk.Maximum(mask, 0.01))
    corrector = sitk.N4BiasFieldCorrectionImageFilter()
    iterations = [50, 50, 30]
    corrector.SetMaximumNumberOfIterations(iterations)
    raised: list[Exception] = []

    def iterated() -> None:
        done = sum(iterations[: corrector.GetCurrentLevel()]) + corrector.GetElapsedIterations()
        try:
            report(min(done / sum(iterations), 1.0))
        except Exception as error:  # it cannot propagate through C++
            raised.append(error)
            corrector.Abort()

    corrector.AddCommand(sitk.sitkIterationEvent, iterated)
    corrector.Execute(means, sitk.Cast(mask > 0.5, sitk.sitkUInt8))
    if raised:
        raise raised[0]
    whole = sitk.Cast(image.to_sitk(), sitk.sitkFloat32)
    field = sitk.GetArrayFromImage(corrector.GetLogBiasFieldAsImage(whole))
    return (image.array / np.exp(field)).astype(np.float32)
