"""The bias field of an MRI: whether there is one, and its correction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.atlas_registration import AtlasFit
from SlicerUSSim.Logic.mri.field import anatomy, estimate_field
from SlicerUSSim.Logic.mri.plausibility import is_whole_brain

#: Millimetres of the grid on which the field is estimated
_COARSE_MM = 4.0
#: Length of an adult's brain: the field of a part of a brain is as smooth as that of the whole, which a coil makes
_BRAIN_MM = 170.0
#: Ratio of the 95th to the 5th percentile of the field in the brain, less 1: below the first its estimate is no better
#: than none; from the second, as of surface coils, it is too strong for the polynomial and N4 goes first
LEAST_FIELD, STRONG_FIELD = 0.1, 0.6
#: The first for a part of a brain, which shows a part of what a field varies. On parts of phantoms with fields of 0 to
#: 20 %, anything from 0 to 0.13 gives the same mean Dice to 0.0005
LEAST_FIELD_OF_PART = 0.05


@dataclass(frozen=True, eq=False)
class Corrected:
    """An image without its bias field, and a line for the user."""

    image: Volume
    message: str


def corrected(
    image: Volume,
    inside: np.ndarray,
    contrast: str,
    atlas: AtlasFit | None,
    prior: np.ndarray | None,
    wanted: bool | None,
    report: Callable[[float], None],
) -> Corrected:
    """The image without bias field in the brain `inside` (k, j, i), if it has one or it is `wanted`.

    Led by an atlas (its share of tissues is `prior`, (3, voxels)), the field is estimated together with the tissues,
    which takes a second; N4 goes first where the field is strong, and instead where there is no atlas for a whole
    brain. In a part of a brain N4, whose splines are then as fine as lobes, takes white matter for the field.
    """
    if atlas is None and not is_whole_brain(image, inside):
        field = without_bias(image, inside, report)
        ratio = np.where(inside, image.array, 1.0) / np.maximum(np.where(inside, field, 1.0), 1e-6)
        strength = _strength(ratio, inside)
        apply = bool(wanted) or strength > LEAST_FIELD
        result = image.with_array(field) if apply else image
        return Corrected(result, _about(contrast, strength, wanted, "N4 applied" if apply else "", LEAST_FIELD))

    def estimated(source: Volume) -> np.ndarray:
        least_mm = _BRAIN_MM if atlas is None else 0.0
        field = estimate_field(
            source.array, inside, source.spacing_mm, contrast, prior, report, least_extent_mm=least_mm
        )
        if atlas is None or contrast not in ("t1", "t1gd"):
            return field.factor
        return field.factor / anatomy(atlas, source, inside.shape)

    least = LEAST_FIELD if atlas is not None else LEAST_FIELD_OF_PART
    factor = estimated(image)
    strength = _strength(factor, inside)
    if not wanted and strength <= least:
        return Corrected(image, _about(contrast, strength, wanted, "", least))
    how = "removed by a polynomial fitted with the tissues"
    if (wanted and atlas is not None) or strength > STRONG_FIELD:
        image = image.with_array(without_bias(image, inside, report))
        factor = estimated(image)
        how = "removed by N4 and by a polynomial fitted with the tissues"
    return Corrected(image.with_array(image.array / factor), _about(contrast, strength, wanted, how, least))


def _strength(factor: np.ndarray, inside: np.ndarray) -> float:
    step = (slice(None, None, 3),) * 3
    low, high = np.percentile(factor[step][inside[step]], (5, 95))
    return float(high / low - 1.0) if low > 0 else np.inf


def _about(contrast: str, strength: float, wanted: bool | None, how: str, least: float) -> str:
    amount = f"{strength:.1%}" if strength < 10.0 else "more than a factor of ten"
    found = f"{contrast}: intensity varies by {amount} across the brain"
    if not how:
        return f"{found}, below {least:.0%}: left as it is"
    return f"{found}: {how}{', as asked for' if wanted else ''}"


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
