"""Width of the speckle in B-mode images, axial and lateral, by depth (docs/realism.md#width-of-speckle).

Developed speckle of a point spread function with the Gaussian amplitude exp(-d^2 / 2 s^2) has the correlation of
intensity exp(-d^2 / 2 s^2). Log compression of exponentially distributed intensity turns a correlation c into
Li2(c) / Li2(1), Li2 the dilogarithm and Li2(1) = pi^2 / 6: the correlation of the logarithms of two exponential
variables. So grey levels have the autocorrelation

    C(d) = Li2(exp(-d^2 / 2 s^2)) / (pi^2 / 6),    whose width at half height is 1.823 s

as long as little is clipped at black. Real images contain more than speckle. They are resampled along and across the
beams, structure that is larger than speckle is removed across the direction that is measured, and s is fitted in small
windows, of which the 25th to 50th percentile counts: texture and sheets widen it.

From s follow frequency x bandwidth (axially) and aperture x frequency (laterally), not the frequency itself. What fits
the width alone need not look like the image: the widths of real images contain the texture of tissue and the smoothing
of the scanner (texture_costs.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy import ndimage, optimize, special

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.fitting.image_similarity import as_image, as_mask
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid

#: Width at half height of the autocorrelation of log-compressed developed speckle, in sigmas of the amplitude
HALF_HEIGHT_PER_SIGMA = 1.823
#: Steps of the polar grid: mm and degrees; of a linear array mm both
_STEP_MM, _STEP_DEG = 0.1, 0.25
#: Windows: height; width and the part of the distance to the apex that it is at least; overlap by half
_HIGH_MM, _WIDE_MM, _WIDE_SHARE = 9.0, 12.0, 0.35
#: Sigmas of the Gaussian means that are subtracted, whose full widths at half height are 6 and 2.5 mm: across the beams
#: before the axial autocorrelation, along them before the lateral one
_LATERAL_MEAN_MM, _AXIAL_MEAN_MM = 6.0 / 2.355, 2.5 / 2.355
#: A window is left out if the deviation of its local mean exceeds this part of the speckle's, if it is darker than
#: this on average, or if less than this part of it is in the field
_MOST_SLOW, _DARK, _LEAST_INSIDE = 0.9, 15.0, 0.98
#: Sigma of that local mean, mm
_SLOW_MM = 2.5
#: Lags of the fit reach as far as this, mm
_AXIAL_REACH_MM, _LATERAL_REACH_MM = 2.0, 6.0
_PERCENTILES = 25.0, 50.0
#: Windows for a width at a depth
_LEAST_WINDOWS = 4


@dataclass(frozen=True)
class SpeckleWidth:
    """Sigma of the speckle's amplitude around one depth; NaN where no window could be measured."""

    depth_mm: float
    axial_mm: float
    lateral_mm: float
    #: Windows that could be measured, axially
    windows: int


def log_speckle_correlation(distance: np.ndarray, sigma: float) -> np.ndarray:
    """Autocorrelation of the log of developed speckle at a distance; both in one unit.

    >>> import numpy as np
    >>> from SlicerUSSim.Logic.fitting.speckle_width import log_speckle_correlation
    >>> float(log_speckle_correlation(np.array([0.5 * 1.823]), 1.0)[0].round(3))
    0.5
    """
    intensity = np.exp(-0.5 * (np.asarray(distance, float) / sigma) ** 2)
    return special.spence(1.0 - intensity) / (np.pi**2 / 6.0)


def speckle_widths(
    images: Sequence[np.ndarray],
    probe: Probe,
    grid: ImageGrid,
    depths_mm: Sequence[float],
    mask: np.ndarray | None = None,
    *,
    where: Sequence[np.ndarray] | None = None,
    reach_mm: float = 8.0,
) -> list[SpeckleWidth]:
    """The width of the speckle around each depth, from all windows of all images within `reach_mm` of it.

    Parameters
    ----------
    images : (rows, columns) uint8 each, on `grid`.
    mask : (rows, columns) bool, the imaged field (default: that of the probe).
    where : per image (rows, columns) bool, to which windows are restricted, such as one tissue.

    Raises SimulationError for images that are not uint8 on the grid.
    """
    shape = grid.rows, grid.columns
    inside = grid.field(probe) if mask is None else as_mask(mask, shape) & grid.field(probe)
    found: list[tuple[float, float, float]] = []
    for number, image in enumerate(images):
        image = as_image(f"image {number}", image)
        require(image.shape == shape, f"image {number} has shape {image.shape}, expected that of the grid, {shape}")
        chosen = inside if where is None else inside & as_mask(where[number], shape)
        found += _windows(image, probe, grid, chosen)
    values = np.array(found).reshape(-1, 3)
    result = []
    for depth in depths_mm:
        near = values[np.abs(values[:, 0] - depth) <= reach_mm]
        axial, lateral = (_typical(near[:, n]) for n in (1, 2))
        result.append(SpeckleWidth(float(depth), axial, lateral, int(np.isfinite(near[:, 1]).sum())))
    return result


def width_misfit(widths: Sequence[SpeckleWidth], reference: Sequence[SpeckleWidth]) -> float:
    """Mean |log ratio| of widths, axial and lateral, at depths where both are known; NaN without one."""
    both = zip(widths, reference, strict=True)
    ratios = np.log([(a.axial_mm / b.axial_mm, a.lateral_mm / b.lateral_mm) for a, b in both])
    known = np.abs(ratios[np.isfinite(ratios)])
    return float(known.mean()) if known.size else float("nan")


def along_beams(values: np.ndarray, probe: Probe, grid: ImageGrid, order: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (rows, columns) resampled along and across the beams.

    Returns (depths, angles) values, beyond the image those of its edge, and (depths,) mm between neighbours across.
    `order` of the splines. A linear array's lines are parallel.
    """
    radius = 0.0 if probe.is_linear else probe.apex_radius_mm
    depth = np.arange(0.5 * _STEP_MM, probe.depth_mm, _STEP_MM)
    low, high = probe.first_line, probe.first_line + (probe.scan_lines - 1) * probe.line_spacing
    if probe.is_linear:
        across = np.arange(low, high, _STEP_MM)
        angle = probe.steering_rad
        x = across[None, :] + depth[:, None] * np.sin(angle)
        y = depth[:, None] * np.cos(angle) + 0.0 * across[None, :]
        apart = np.full(len(depth), _STEP_MM * np.cos(angle))
    else:
        step = np.deg2rad(_STEP_DEG)
        across = np.arange(low, high, step)
        away = radius + depth[:, None]
        x, y = away * np.sin(across), away * np.cos(across) - radius
        apart = step * away[:, 0]
    pixel = grid.pixel_spacing_mm
    rows, columns = (y - grid.top_mm) / pixel[1] - 0.5, (x - grid.left_mm) / pixel[0] - 0.5
    return ndimage.map_coordinates(values.astype(np.float32), [rows, columns], order=order, mode="nearest"), apart


def _windows(image: np.ndarray, probe: Probe, grid: ImageGrid, inside: np.ndarray) -> list[tuple[float, float, float]]:
    """(depth, axial sigma, lateral sigma), mm, of every window that can be measured."""
    grey, apart = along_beams(image, probe, grid)
    within = along_beams(inside, probe, grid, order=0)[0] > 0.5
    radius = 0.0 if probe.is_linear else probe.apex_radius_mm
    high = round(_HIGH_MM / _STEP_MM)
    pixel_x, pixel_y = grid.pixel_spacing_mm
    found = []
    for first in range(0, len(grey) - high + 1, high // 2):
        here = slice(first, first + high)
        depth = (first + 0.5 * high) * _STEP_MM
        step = float(apart[here].mean())
        wide = min(round(max(_WIDE_MM, _WIDE_SHARE * (radius + depth)) / step), grey.shape[1])
        # Means reach beyond the window; the whole row of windows is filtered at once
        margin = round(2.0 * _AXIAL_MEAN_MM / _STEP_MM)
        rows = slice(max(first - margin, 0), first + high + margin)
        crop = slice(first - rows.start, first - rows.start + high)
        strip, valid = grey[rows], within[rows]
        lateral_free = _less_mean(strip, valid, (0.0, _LATERAL_MEAN_MM / step))[crop]
        axial_free = _less_mean(strip, valid, (_AXIAL_MEAN_MM / _STEP_MM, 0.0))[crop]
        slow = strip - _less_mean(strip, valid, (_SLOW_MM / _STEP_MM, _SLOW_MM / step))
        fast, slow = (strip - slow)[crop], slow[crop]
        for left in range(0, grey.shape[1] - wide + 1, max(wide // 2, 1)):
            part = slice(left, left + wide)
            if within[here, part].mean() < _LEAST_INSIDE or grey[here, part].mean() < _DARK:
                continue
            if slow[:, part].std() > _MOST_SLOW * fast[:, part].std():
                continue
            found.append(
                (
                    depth,
                    _fitted(lateral_free[:, part], _STEP_MM, pixel_y, _AXIAL_REACH_MM),
                    _fitted(axial_free[:, part].T, step, pixel_x, _LATERAL_REACH_MM),
                )
            )
    return found


def _less_mean(values: np.ndarray, valid: np.ndarray, sigma: tuple[float, float]) -> np.ndarray:
    """Values less their Gaussian mean over valid ones."""
    weight = ndimage.gaussian_filter(valid.astype(np.float32), sigma)
    return values - ndimage.gaussian_filter(np.where(valid, values, 0.0), sigma) / np.maximum(weight, 1e-3)


def _fitted(values: np.ndarray, step_mm: float, pixel_mm: float, reach_mm: float) -> float:
    """Sigma in mm of the speckle along the first axis of a window (samples, others); NaN where the fit fails.

    The law, convolved with the autocorrelation of a pixel, times A plus B is fitted to the autocorrelation.
    """
    lags = min(max(int(reach_mm / step_mm), 4), len(values) // 2)
    values = values - values.mean()
    products = np.array([(values[: len(values) - n] * values[n:]).mean() for n in range(lags + 1)])
    if products[0] < 1e-6:
        return float("nan")
    measured = products / products[0]
    # Behind it are other grains, and what the filters leave
    low = np.flatnonzero(measured < 0.1)
    last = min(lags, max(int(low[0]), 4)) if low.size else lags
    distance, measured = np.arange(last + 1) * step_mm, measured[: last + 1]

    varying = measured - measured.mean()

    def misfit(log_sigma: float) -> float:
        # Of the best A and B, by linear regression
        law = _law_in_pixels(distance, np.exp(log_sigma), pixel_mm)
        law -= law.mean()
        power = law @ law
        return float(varying @ varying - ((law @ varying) ** 2 / power if power > 0.0 else 0.0))

    bounds = np.log(0.25 * step_mm), np.log(reach_mm)
    best = float(np.exp(optimize.fminbound(misfit, *bounds)))
    return best if 0.3 * step_mm < best < 0.9 * reach_mm else float("nan")


def _law_in_pixels(distance: np.ndarray, sigma: float, pixel_mm: float) -> np.ndarray:
    """The law as pixels show it, each the mean over its size: convolved with a triangle of that half width."""
    offsets, weights = _triangle()
    at = np.abs(distance[:, None] + pixel_mm * offsets)
    return np.interp(at / sigma, *_law()) @ weights


@cache
def _law() -> tuple[np.ndarray, np.ndarray]:
    """(sigmas, correlation): the law as a table, since the dilogarithm takes most of the time."""
    sigmas = np.linspace(0.0, 8.0, 8001)  # beyond it is zero
    return sigmas, log_speckle_correlation(sigmas, 1.0)


@cache
def _triangle() -> tuple[np.ndarray, np.ndarray]:
    offsets = np.linspace(-1.0, 1.0, 9)[1:-1]
    weights = 1.0 - np.abs(offsets)
    return offsets, weights / weights.sum()


def _typical(values: np.ndarray) -> float:
    """Mean between the 25th and the 50th percentile: texture and sheets widen speckle, never narrow it."""
    values = np.sort(values[np.isfinite(values)])
    if values.size < _LEAST_WINDOWS:
        return float("nan")
    low, high = np.percentile(values, _PERCENTILES)
    return float(values[(values >= low) & (values <= high)].mean())
