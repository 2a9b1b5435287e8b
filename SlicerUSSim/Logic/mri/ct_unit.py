"""The unit of a CT: whether its numbers are Hounsfield units (air -1000, water 0), and what else they are."""

from __future__ import annotations

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.volume import Volume

#: Voxels that are looked at, about
_SAMPLE = 2_000_000
#: Offsets of CTs that are stored without a sign and were not rescaled
_OFFSETS = (1024.0, 1000.0)
#: Numbers of air, of what is neither air nor lung, and of soft tissue, fat and marrow among it
_AIR_HU, _NOT_LUNG_HU, _TISSUE_HU = (-1060.0, -940.0), -500.0, (-160.0, 300.0)
#: Least share of those; largest share of what lies between lung and fat, where a body has only partial volumes
_LEAST_TISSUE, _LEAST_AIR, _MOST_BETWEEN = 0.55, 0.01, 0.15
_BETWEEN_HU = (-700.0, -250.0)
#: Numbers below this one and above that of a table or a padding may be air's; within the first width around the most
#: frequent one lies so much of what is within the second, lungs being broad; that is so much of the image; and how far
#: from -1000 it may be
_MAYBE_AIR_HU, _PEAK_HU, _NEAR_PEAK_HU = (-1300.0, -500.0), 30.0, 120.0
_LEAST_OF_PEAK, _LEAST_OF_IMAGE, _MOST_OFF_HU = 0.85, 0.05, 50.0
#: Fat and soft tissue, of which a body has most: numbers have the offset with which more of them lie in these
_FAT_HU, _SOFT_HU = (-130.0, -70.0), (0.0, 90.0)
#: One number below this is padding, outside the round field of view, if nothing else is
_PADDING_HU = -1100.0
#: Bone begins here; an image whose largest number is below it and is had by so many voxels was cut to a window
_BONE_HU, _MOST_AT_TOP = 700.0, 50
#: Least noise of air
_LEAST_NOISE_HU = 2.0
_EXPECTED = "expected Hounsfield units (air -1000, water 0, bone 1000)"
_FOR_MRI = "for an MRI leave --ct out and choose its contrast"


def hounsfield_offset(ct: Volume) -> tuple[float, str | None, str | None]:
    """(what is to be subtracted from the numbers for Hounsfield units, a line if it is not 0, a doubt or None).

    Raises SimulationError for numbers that are no CT's, with what they are: an MRI, a window of a CT, a wrong unit.
    """
    found = _offset_of(_sample(ct.array))
    _require_whole_range(ct.array, found[0])
    return found


def _offset_of(values: np.ndarray) -> tuple[float, str | None, str | None]:
    """hounsfield_offset, of a sample of the numbers."""
    values = _without_padding(values)
    low, high = float(values.min()), float(values.max())
    level = _air_level(values)
    if level is not None:
        require(  # what is alike in all lungs may be as narrow a peak as air
            abs(level + 1000.0) <= _MOST_OFF_HU
            or _share_of_tissue(values) >= _share_of_tissue(values - level - 1000.0),
            f"air is at {level:.0f}, expected -1000: the values are {level + 1000.0:+.0f} from Hounsfield units; "
            "subtract that, or apply the intercept of the CT's header",
        )
    if _is_hounsfield(values):
        return 0.0, None, None
    if float(np.mean(values > -0.5)) > 0.999:  # nothing is below 0
        for offset in _OFFSETS:
            if _is_offset(values, offset):
                line = (
                    f"values are {offset:.0f} above Hounsfield units (air is at {offset - 1000.0:.0f}; the rescale "
                    f"intercept was not applied): {offset:.0f} is subtracted"
                )
                return offset, line, None
    found = f"values are from {low:g} to {high:g}"
    inside = values[values > _NOT_LUNG_HU]
    is_tissue = float(np.mean((inside > _TISSUE_HU[0]) & (inside < _TISSUE_HU[1]))) if inside.size else 0.0
    # A part of a body without air around it, with lung or not: fat is below water, which nothing of an MRI is
    has_fat = float(np.mean(values < -50.0)) > 0.005
    if is_tissue >= _LEAST_TISSUE and has_fat and low > -1100.0:
        return 0.0, None, "no air is in the image, so that it is not checked that its numbers are Hounsfield units"
    darkest = float(np.percentile(values, 5.0))
    raise SimulationError(
        f"{found}; 5 % are below {darkest:.4g} and {is_tissue:.0%} of what is no air lies between "
        f"{_TISSUE_HU[0]:.0f} and {_TISSUE_HU[1]:.0f}, {_EXPECTED}; {_FOR_MRI}, for "
        "a CT apply the slope and intercept of its header"
    )


def _air_level(values: np.ndarray) -> float | None:
    """The number of what seems to be air: the place of a narrow peak of what is far below soft tissue, or None."""
    dark = values[(values > _MAYBE_AIR_HU[0]) & (values < _MAYBE_AIR_HU[1])]
    if dark.size < _LEAST_OF_IMAGE * values.size:
        return None
    level = _mode(dark, *_MAYBE_AIR_HU)
    peak, near = (int(np.sum(np.abs(dark - level) < width)) for width in (_PEAK_HU, _NEAR_PEAK_HU))
    is_narrow = peak >= _LEAST_OF_PEAK * near and peak >= _LEAST_OF_IMAGE * values.size
    return float(np.median(dark[np.abs(dark - level) < _PEAK_HU])) if is_narrow else None


def padding_of(ct: Volume) -> float | None:
    """The number far below air that a scanner writes around a round field of view, as -2000 or -3024; or None."""
    lowest = float(ct.array.min())
    return lowest if lowest < _PADDING_HU and _without_padding(_sample(ct.array)).min() >= _PADDING_HU else None


def _without_padding(values: np.ndarray) -> np.ndarray:
    """The values within the field of view."""
    below = values[values < _PADDING_HU]
    is_padded = below.size and below.size < values.size and below.min() == below.max()
    return values[values >= _PADDING_HU] if is_padded else values


def _share_of_tissue(values: np.ndarray) -> float:
    """Share of what is neither air nor lung that has the numbers of fat or soft tissue."""
    inside = values[values > _NOT_LUNG_HU]
    within = sum(np.count_nonzero((inside > low) & (inside < high)) for low, high in (_FAT_HU, _SOFT_HU))
    return within / max(inside.size, 1)


def _mode(values: np.ndarray, low: float, high: float) -> float:
    """The most frequent of the values between two numbers, in bins of 10, with their neighbours."""
    counts, edges = np.histogram(values, bins=np.arange(low, high + 10.0, 10.0))
    return float(edges[int(np.convolve(counts, np.ones(3), mode="same").argmax())]) + 5.0


def _require_whole_range(array: np.ndarray, offset: float) -> None:
    """Raise SimulationError if bone was cut off at the top: of an uncut image one voxel has the largest number."""
    top = array.max()
    count = int(np.count_nonzero(array == top))
    require(
        float(top) - offset >= _BONE_HU or count <= _MOST_AT_TOP,
        f"values end at {float(top) - offset:g}, which {count} voxels have: the CT was cut to a window, and bone, from "
        f"{_BONE_HU:.0f} on, cannot be told from blood with contrast agent; {_EXPECTED}, uncut",
    )


def looks_like_ct(volume: Volume) -> bool:
    """Whether the numbers are a CT's in Hounsfield units, also with an offset; takes some 50 ms."""
    values = _sample(volume.array)
    return _is_hounsfield(values) or any(_is_offset(values, offset) for offset in _OFFSETS)


def _is_hounsfield(values: np.ndarray) -> bool:
    """Whether there is air, and most of what is not is soft tissue, with little between the two."""
    air = float(np.mean((values > _AIR_HU[0]) & (values < _AIR_HU[1])))
    body = values[values > _NOT_LUNG_HU]
    if air < _LEAST_AIR or body.size < 0.001 * values.size:
        return False
    tissue = float(np.mean((body > _TISSUE_HU[0]) & (body < _TISSUE_HU[1])))
    between = float(np.sum((values > _BETWEEN_HU[0]) & (values < _BETWEEN_HU[1]))) / body.size
    return tissue >= _LEAST_TISSUE and between <= _MOST_BETWEEN


def _is_offset(values: np.ndarray, offset: float) -> bool:
    """Whether they are a CT's with this offset: air is at its place, and noisy, where the background of an MRI is 0."""
    near = values[np.abs(values - offset + 1000.0) < 60.0]
    return bool(
        _is_hounsfield(values - offset)
        and abs(float(np.median(near)) - offset + 1000.0) < 12.0
        and float(near.std()) > _LEAST_NOISE_HU
    )


def _sample(array: np.ndarray) -> np.ndarray:
    step = max(round((array.size / _SAMPLE) ** (1.0 / 3.0)), 1)
    return array[::step, ::step, ::step].ravel().astype(np.float32)
