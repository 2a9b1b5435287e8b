"""What is a CT, and its unit: whether its numbers are Hounsfield units (air -1000, water 0), or lie above them."""

from __future__ import annotations

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.segmentation_settings import CT, SegmentationSettings

#: Voxels that are looked at, about
_SAMPLE = 2_000_000
_OFFSETS = (1024.0, 1000.0)  #: of CTs that are stored without a sign, and whose intercept was not applied
#: Numbers of air, of what is neither air nor lung, of fat and soft tissue among it, and between lung and fat, where a
#: body has only partial volumes; with the least and largest shares
_AIR_HU, _NOT_LUNG_HU, _TISSUE_HU, _BETWEEN_HU = (-1060.0, -940.0), -500.0, (-160.0, 300.0), (-700.0, -250.0)
_LEAST_AIR, _LEAST_TISSUE, _MOST_BETWEEN = 0.01, 0.55, 0.15
#: How far air may be from -1000 with an offset, and its least noise: the background of an MRI has none
_MOST_OFF_HU, _LEAST_NOISE_HU = 12.0, 2.0
#: Numbers below lie outside of a round field of view, as -2000 or -3024
FIELD_HU = -1100.0


def hounsfield_offset(ct: Volume) -> tuple[float, str | None]:
    """(what is to be subtracted from the numbers for Hounsfield units, a line about what should be checked or None).

    Raises SimulationError for numbers without air that begin at 0 or are cut off (an MRI, a window of a CT).
    """
    values = _sample(ct.array)
    offset = _offset_of(values)
    if offset is not None:
        air = f"air is at {offset - 1000.0:.0f}, expected -1000: {offset:.0f} is subtracted from the values"
        return offset, air if offset else None
    low, high = float(values.min()), float(values.max())
    require(
        float(np.mean(values < -50.0)) > 0.005 and float(np.mean(values == low)) < 0.01,
        f"values are from {low:g} to {high:g}, expected Hounsfield units (air -1000, water 0, bone 1000) that are not "
        "cut off; for an MRI give its contrast, for a CT apply slope and intercept of its header",
    )
    return 0.0, f"values are from {low:g} to {high:g} without air at -1000; they are assumed to be Hounsfield units"


def why_ct(image: Volume) -> str | None:
    """What tells that an image is a CT: its DICOM modality, or else numbers in Hounsfield units, also with an offset.

    None for another image. Takes some 50 ms.
    """
    if image.modality:
        return "its DICOM modality is CT" if image.modality == "CT" else None
    return "its values are Hounsfield units" if _offset_of(_sample(image.array)) is not None else None


def settings_for(image: Volume, settings: SegmentationSettings) -> tuple[SegmentationSettings, str | None]:
    """(the settings, with the contrast "ct" for what is a CT, a line that says so and why or None)."""
    why = None if settings.contrast == CT else why_ct(image)
    if why is None:
        return settings, None
    line = f"taken as a CT: {why}"
    if settings.contrast != SegmentationSettings().contrast:
        line += f"; the contrast {settings.contrast} is not used"
    return SegmentationSettings.of(settings, contrast=CT), line


def _offset_of(values: np.ndarray) -> float | None:
    """The offset with which there is air at -1000 and most else is soft tissue and fat; None if there is none."""
    if _is_hounsfield(values):
        return 0.0
    for offset in _OFFSETS:
        hu = values - offset
        air = hu[(hu > _AIR_HU[0]) & (hu < _AIR_HU[1])]
        if _is_hounsfield(hu) and abs(np.median(air) + 1000.0) < _MOST_OFF_HU and air.std() > _LEAST_NOISE_HU:
            return offset
    return None


def _is_hounsfield(values: np.ndarray) -> bool:
    share = lambda low, high: float(np.count_nonzero((values > low) & (values < high)))  # noqa: E731
    body = max(share(_NOT_LUNG_HU, np.inf), 0.001 * values.size)
    return (
        share(*_AIR_HU) >= _LEAST_AIR * values.size
        and share(*_TISSUE_HU) >= _LEAST_TISSUE * body
        and share(*_BETWEEN_HU) <= _MOST_BETWEEN * body
    )


def _sample(array: np.ndarray) -> np.ndarray:
    """About _SAMPLE of the numbers within the field of view."""
    step = max(round((array.size / _SAMPLE) ** (1.0 / 3.0)), 1)
    values = array[::step, ::step, ::step].ravel().astype(np.float32)
    inside = values[values >= FIELD_HU]
    return inside if inside.size else values
