"""Grey map of a scanner: from echo levels to grey levels, by its slope (docs/physics.md#grey-map).

A scanner's map from decibels to grey levels is not straight: most are flat near black, where noise is, and steeper or
flatter near white. A few knots give its slope at black, at a quarter of white and at white, relative to that at half of
it. So every map is monotone, whatever the knots are. Black stays at the lower end of the dynamic range, white at 0 dB.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy import ndimage

from SlicerUSSim.Logic.base.declaration import parameter_of
from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.settings import DisplaySettings

#: Grey levels of the knots; the third has the slope 1
KNOTS = (0.0, 64.0, 128.0, 255.0)
#: Slopes at the other three, of the maps of DisplaySettings.grey_map: as estimated from a scanner of an exposed brain
#: (RESECT) and from one of a spine phantom (Plus)
GREY_MAPS = {"linear": (1.0, 1.0, 1.0), "soft": (0.48, 0.76, 1.5), "contrast": (0.08, 0.65, 0.85)}
#: Entries of the table for the device
TABLE_SIZE = 1024
#: Steps of the integral over grey levels
_STEPS = 16384
#: For the estimate: width of windows, in which anatomy hardly varies; grey levels, how far medians may be from them,
#: and windows that one needs
_WINDOW_MM = 2.0
_LEVELS = np.arange(15.0, 226.0, 5.0)
_NEAR, _LEAST_WINDOWS = 6.0, 30


@dataclass(frozen=True)
class EstimatedMap:
    """The slope of a scanner's grey map."""

    #: (levels,) grey levels, and the slope there relative to that at 130; NaN where the images have too few windows
    level: np.ndarray
    slope: np.ndarray
    #: Of DisplaySettings: slopes at the knots relative to that at half of white
    map_black: float
    map_dark: float
    map_white: float

    def at(self, grey: float) -> float:
        """The slope at a grey level, relative to that at 130; beyond the levels that could be measured, the nearest."""
        known = np.isfinite(self.slope)
        return float(np.interp(grey, self.level[known], self.slope[known]))

    def changes(self) -> dict[str, float]:
        """Parameters of DisplaySettings, for dataclasses.replace."""
        return {"map_black": self.map_black, "map_dark": self.map_dark, "map_white": self.map_white}


def is_linear(display: DisplaySettings) -> bool:
    """Whether the display has the straight map of log compression alone."""
    return _slopes(display) == (1.0, 1.0, 1.0)


def grey_table(display: DisplaySettings) -> np.ndarray:
    """(TABLE_SIZE,) float32 grey levels, 0 to 255, at evenly spaced parts of the dynamic range from black to white."""
    return _table(_slopes(display))


def slope_at(grey: np.ndarray, slopes: tuple[float, float, float]) -> np.ndarray:
    """Slope of the map at grey levels, relative to that at half of white: straight between the knots."""
    black, dark, white = slopes
    return np.interp(grey, KNOTS, (black, dark, 1.0, white))


def estimate_grey_map(
    images: Sequence[np.ndarray], pixel_spacing_mm: tuple[float, float], mask: np.ndarray | None = None
) -> EstimatedMap:
    """The grey map of a scanner from its images (rows, columns) uint8 alone.

    Developed speckle has the same distribution in decibels at every level, so its distribution of grey levels is as
    wide as the map is steep there: in windows of 2 mm, the median distance of the quartiles over all windows of one
    median is the slope. Below grey level 30 it is too low, since speckle is clipped at black. `pixel_spacing_mm` is
    (column, row); `mask` (rows, columns) bool is the imaged field (default: all).

    Raises SimulationError where images have too few levels to compare.
    """
    require(len(images) > 0, "no image, expected at least one for a grey map")
    size = tuple(max(int(_WINDOW_MM / spacing) | 1, 3) for spacing in pixel_spacing_mm[::-1])
    quartiles = []
    for image in images:
        image = np.asarray(image)
        require(
            image.ndim == 2 and min(np.subtract(image.shape, size)) >= 0,
            f"an image has shape {image.shape}, expected (rows, columns) larger than a window of {size}",
        )
        inside = np.ones(image.shape, bool) if mask is None else np.asarray(mask, bool)
        step = max(size[0] // 3, 1)
        # Windows that are cut by the field have fewer pixels, and black ones
        whole = sliding_window_view(inside, size)[::step, ::step].all(axis=(2, 3))
        windows = sliding_window_view(image, size)[::step, ::step][whole]
        quartiles.append(np.percentile(windows.reshape(len(windows), -1), (25, 50, 75), axis=1))
    low, median, high = np.concatenate(quartiles, axis=1)
    slope = np.full(len(_LEVELS), np.nan)
    for n, level in enumerate(_LEVELS):
        near = np.abs(median - level) <= _NEAR
        if np.count_nonzero(near) >= _LEAST_WINDOWS:
            slope[n] = np.median((high - low)[near])
    known = np.isfinite(slope) & (slope > 0.0)
    if known.sum() < 4 or np.ptp(_LEVELS[known]) < 40.0:
        raise SimulationError("the images have too few grey levels for a grey map, expected dark and bright tissue")
    slope[known] = ndimage.gaussian_filter1d(slope[known], 1.0)
    slope /= np.interp(130.0, _LEVELS[known], slope[known])

    def at(grey: float) -> float:
        return float(np.interp(grey, _LEVELS[known], slope[known]))

    # To black, where nothing can be measured, along the line through 30 and 64
    half, dark = at(128.0), at(64.0)
    black = at(30.0) - 30.0 * (dark - at(30.0)) / 34.0
    lowest, highest = parameter_of(DisplaySettings, "map_black").bounds or (0.05, 4.0)
    knots = (float(np.clip(value / half, lowest, highest)) for value in (black, dark, at(225.0)))
    return EstimatedMap(_LEVELS, slope, *knots)


def _slopes(display: DisplaySettings) -> tuple[float, float, float]:
    named = GREY_MAPS[display.grey_map]
    return named[0] * display.map_black, named[1] * display.map_dark, named[2] * display.map_white


@lru_cache(maxsize=64)  # a fit tries many
def _table(slopes: tuple[float, float, float]) -> np.ndarray:
    # dy = slope(y) dx: x is the integral of 1 / slope
    grey = np.linspace(0.0, 255.0, _STEPS + 1)
    inverse = 1.0 / slope_at(grey, slopes)
    level = np.concatenate([[0.0], np.cumsum(0.5 * (inverse[1:] + inverse[:-1]))])
    table = np.interp(np.linspace(0.0, 1.0, TABLE_SIZE), level / level[-1], grey).astype(np.float32)
    table.flags.writeable = False
    return table
