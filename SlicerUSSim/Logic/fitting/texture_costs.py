"""Misfit of the texture of two images: what the paper's cost does not see (docs/realism.md#costs).

Local histograms do not depend on where grey levels are within a patch, so equations 4 and 5 of Salehi et al., MICCAI
2015, take a blurred image for a near neighbour. Two numbers complete them, neither of which depends on the seed of
speckle:

    T1 = mean over patches of sqrt(mean over lags of (A_l - B_l)^2), A_l the normalised autocorrelation at lag l of the
         image less its local mean
    T2 = mean over patches, and over maxima and minima, of |log((1 + n_A) / (1 + n_B))|, n their number

T1 sees the size of the texture's grains, T2 their number: fine noise on coarse grains, or grains that are joined to
worms, have the right size and the wrong number. Lags are pixels, so images are compared on one grid, and T2 depends on
the pixel noise of a scanner and on codecs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.fitting.image_similarity import as_image, as_mask

#: Lags of the autocorrelation, (rows, columns) in pixels
LAGS = ((0, 1), (0, 3), (0, 6), (1, 0), (2, 0), (4, 0))
#: Sigma of the Gaussian mean that is subtracted, and sides of patches for T1 and T2, mm
LOCAL_MEAN_MM, CORRELATION_PATCH_MM, EXTREMA_PATCH_MM = 1.5, 15.0, 10.0
#: Patches that are darker in either image are left out: they are clipped at black
DARK = 15.0
#: Of the Gaussian before extrema are counted, pixels; extrema below this level are not counted
_EXTREMA_SIGMA, _EXTREMA_LEVEL = 0.5, 8.0
#: A patch counts if this part of it lies in the common field
_LEAST_SHARE = 0.5


@dataclass(frozen=True)
class TextureMisfit:
    """T1 and T2; 0 for equal images, NaN where no patch is bright enough in both."""

    #: T1
    autocorrelation: float
    #: T2
    extrema: float

    @property
    def total(self) -> float:
        """T1 + T2 / 2, which is added to the paper's cost."""
        return self.autocorrelation + 0.5 * self.extrema


class TextureReference:
    """Texture of one reference image, with which others are compared.

    Parameters
    ----------
    reference : (rows, columns) uint8.
    pixel_spacing_mm : (column, row).
    mask : (rows, columns) bool, the pixels inside both fields (default: all).

    Raises SimulationError for images that are not uint8 or of other shapes, and for a mask without pixels.
    """

    def __init__(
        self, reference: np.ndarray, pixel_spacing_mm: tuple[float, float], mask: np.ndarray | None = None
    ) -> None:
        self.reference = as_image("reference", reference)
        self.inside = as_mask(mask, self.reference.shape)
        self.spacing = pixel_spacing_mm
        self._sigma = LOCAL_MEAN_MM / pixel_spacing_mm[1], LOCAL_MEAN_MM / pixel_spacing_mm[0]
        self._weight = np.maximum(ndimage.gaussian_filter(self.inside.astype(np.float32), self._sigma), 1e-6)
        self._patches = {
            size: list(_patches(self.inside, size, pixel_spacing_mm))
            for size in (CORRELATION_PATCH_MM, EXTREMA_PATCH_MM)
        }
        self._own = self._numbers(self.reference)

    @property
    def is_dark(self) -> bool:
        """Whether no patch of the reference is bright enough to be compared: T1 is NaN."""
        levels, lags = self._own[0]
        return not ((levels >= DARK) & np.isfinite(lags).all(axis=1)).any()

    def misfit(self, image: np.ndarray) -> TextureMisfit:
        """T1 and T2 of an image (rows, columns) uint8 against the reference."""
        image = as_image("image", image)
        require(
            image.shape == self.reference.shape,
            f"the image has shape {image.shape}, expected that of the reference, {self.reference.shape}",
        )
        (own_level, own_lags), (own_bright, own_counts) = self._own
        (level, lags), (bright, counts) = self._numbers(image)
        compared = (np.minimum(own_level, level) >= DARK) & np.isfinite(lags + own_lags).all(axis=1)
        t1 = np.sqrt(((lags - own_lags)[compared] ** 2).mean(axis=1))
        ratio = np.abs(np.log((1.0 + counts) / (1.0 + own_counts)))[np.minimum(own_bright, bright) >= DARK]
        return TextureMisfit(
            float(t1.mean()) if t1.size else float("nan"), float(ratio.mean()) if ratio.size else float("nan")
        )

    def _numbers(self, image: np.ndarray) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
        """((patches,) levels, (patches, lags) autocorrelations), ((patches,) levels, (patches, 2) numbers)."""
        level = np.where(self.inside, image, 0).astype(np.float32)
        high = np.where(self.inside, level - ndimage.gaussian_filter(level, self._sigma) / self._weight, 0.0)
        levels, lags = [], []
        for patch in self._patches[CORRELATION_PATCH_MM]:
            levels.append(level[patch][self.inside[patch]].mean())
            lags.append(_autocorrelation(high[patch], self.inside[patch]))
        extrema = [where & self.inside for where in local_extrema(level)]
        bright, counts = [], []
        for patch in self._patches[EXTREMA_PATCH_MM]:
            bright.append(level[patch][self.inside[patch]].mean())
            counts.append([np.count_nonzero(where[patch]) for where in extrema])
        return (
            (np.array(levels), np.array(lags).reshape(-1, len(LAGS))),
            (np.array(bright), np.array(counts, float).reshape(-1, 2)),
        )


def texture_misfit(
    image: np.ndarray, reference: np.ndarray, pixel_spacing_mm: tuple[float, float], mask: np.ndarray | None = None
) -> TextureMisfit:
    """T1 and T2 of two images, as TextureReference.

    >>> import numpy as np
    >>> from scipy import ndimage
    >>> from SlicerUSSim.Logic.fitting import texture_misfit
    >>> noise = ndimage.gaussian_filter(np.random.default_rng(0).normal(size=(200, 200)), 1.0)
    >>> speckle = np.clip(128 + 150 * noise, 0, 255).astype(np.uint8)
    >>> coarse = np.clip(128 + 300 * ndimage.gaussian_filter(noise, 1.5), 0, 255).astype(np.uint8)
    >>> texture_misfit(speckle, speckle, (0.2, 0.2)).total
    0.0
    >>> texture_misfit(coarse, speckle, (0.2, 0.2)).total > 0.3
    True
    """
    return TextureReference(reference, pixel_spacing_mm, mask).misfit(image)


def local_extrema(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two (rows, columns) bool: where an image has a maximum, or a minimum, among its eight neighbours.

    After a Gaussian of half a pixel, and only where that is not black. Of pixels of one level side by side, as codecs
    and saturation leave them, the first one stands for all, if all beside them are darker (brighter).
    """
    smooth = ndimage.gaussian_filter(image.astype(np.float32), _EXTREMA_SIGMA)
    counted = smooth > _EXTREMA_LEVEL
    return _maxima(smooth, counted), _maxima(-smooth, counted)


def _maxima(image: np.ndarray, counted: np.ndarray) -> np.ndarray:
    """(rows, columns) bool: one pixel of each maximum among those that are counted."""
    highest = ndimage.maximum_filter(image, 3)
    found = (image == highest) & counted
    # Two neighbours of one level, which is rare
    if not any((found & np.roll(found, step, (0, 1))).any() for step in ((0, 1), (1, 0), (1, 1), (1, -1))):
        return found
    regions, _ = ndimage.label(found, np.ones((3, 3)))  # type: ignore[misc]
    # A region with a brighter neighbour at any of its pixels is not a maximum.
    goes_on = found & (ndimage.maximum_filter(np.where(found, -np.inf, image), 3) == highest)
    places = np.flatnonzero(found)
    numbers, first = np.unique(regions.flat[places], return_index=True)
    chosen = np.zeros(image.size, bool)
    chosen[places[first[~np.isin(numbers, regions[goes_on])]]] = True
    return chosen.reshape(image.shape)


def _patches(inside: np.ndarray, size_mm: float, spacing_mm: tuple[float, float]) -> Iterator[tuple[slice, slice]]:
    rows, columns = (max(round(size_mm / spacing), 1) for spacing in spacing_mm[::-1])
    # One patch if the image is smaller
    rows, columns = min(rows, inside.shape[0]), min(columns, inside.shape[1])
    for row in range(0, inside.shape[0], rows):
        for column in range(0, inside.shape[1], columns):
            patch = slice(row, row + rows), slice(column, column + columns)
            if np.count_nonzero(inside[patch]) >= _LEAST_SHARE * rows * columns:
                yield patch


def _autocorrelation(values: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """(lags,) normalised; NaN for a patch without contrast or smaller than a lag."""
    power = float((values[inside] ** 2).mean())
    found = np.full(len(LAGS), np.nan)
    if power < 1e-6:
        return found
    rows, columns = values.shape
    for n, (down, across) in enumerate(LAGS):
        both = inside[: rows - down, : columns - across] & inside[down:, across:]
        if both.any():
            products = values[: rows - down, : columns - across] * values[down:, across:]
            found[n] = float(products[both].mean()) / power
    return found
