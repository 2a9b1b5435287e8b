"""The unit of a CT: whether its numbers are Hounsfield units (air -1000, water 0), and what else they are."""

from __future__ import annotations

import numpy as np

from SlicerUSSim.Logic.base.errors import require
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
#: From this share on, one number that is not air's is a background or the end of a window
_ONE_NUMBER = 0.2
#: Least noise of air
_LEAST_NOISE_HU = 2.0
_EXPECTED = "expected Hounsfield units (air -1000, water 0, bone 1000)"
_FOR_MRI = "for an MRI leave --ct out and choose its contrast"


def hounsfield_offset(ct: Volume) -> tuple[float, str | None, str | None]:
    """(what is to be subtracted from the numbers for Hounsfield units, a line if it is not 0, a doubt or None).

    Raises SimulationError for numbers that are no CT's, with what they are: an MRI, a window of a CT, a wrong unit.
    """
    values = _sample(ct.array)
    low, high = float(values.min()), float(values.max())
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
    level, share = _most_frequent(values)
    require(
        high > _NOT_LUNG_HU or low < -1100.0,
        f"shows air alone (values are from {low:g} to {high:g}), expected a patient",
    )
    require(
        high - low >= 300.0,
        f"{found}, {_EXPECTED}; multiply them by the slope of the CT's header; {_FOR_MRI}",
    )
    require(
        share < _ONE_NUMBER or level < _AIR_HU[1],
        f"{found} and {share:.0%} of them are {level:g}, as in an MRI with a background, or in a CT that was cut "
        f"off or masked; {_EXPECTED}, uncut; {_FOR_MRI}",
    )
    inside = values[values > _NOT_LUNG_HU]
    is_tissue = float(np.mean((inside > _TISSUE_HU[0]) & (inside < _TISSUE_HU[1]))) if inside.size else 0.0
    # A part of a body without air around it, with lung or not: fat is below water, which nothing of an MRI is
    has_fat = float(np.mean(values < -50.0)) > 0.005
    if is_tissue >= _LEAST_TISSUE and has_fat and low > -1100.0:
        return 0.0, None, "no air is in the image, so that it is not checked that its numbers are Hounsfield units"
    darkest = float(np.percentile(values, 5.0))
    require(
        False,
        f"{found}; 5 % are below {darkest:.4g} and {is_tissue:.0%} of what is no air lies between "
        f"{_TISSUE_HU[0]:.0f} and {_TISSUE_HU[1]:.0f}, {_EXPECTED}; {_FOR_MRI}, for "
        "a CT apply the slope and intercept of its header",
    )
    raise AssertionError


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


def _most_frequent(values: np.ndarray) -> tuple[float, float]:
    found, counts = np.unique(values, return_counts=True)
    return float(found[counts.argmax()]), float(counts.max() / values.size)


def _sample(array: np.ndarray) -> np.ndarray:
    step = max(round((array.size / _SAMPLE) ** (1.0 / 3.0)), 1)
    return array[::step, ::step, ::step].ravel().astype(np.float32)
