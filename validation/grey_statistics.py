"""Grey levels of B-mode images: distribution and texture per tissue, level against depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage, stats

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.fitting.image_similarity import as_image
from SlicerUSSim.Logic.fitting.texture_costs import local_extrema
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid

#: Sigma of the local mean about which grey levels are counted, mm: wider than speckle, narrower than anatomy
LOCAL_MEAN_MM = 5.0
#: Bins of histograms of grey levels less that mean, from -128 to 128
_EDGES = np.linspace(-128.0, 128.0, 33)
#: Pixels of a tissue that are enough
_LEAST_PIXELS = 1000
#: Border of a tissue that is left out, mm: labels are not accurate, and speckle is as wide
_BORDER_MM = 1.0
_BAND_MM = 5.0


@dataclass(frozen=True)
class TissueGrey:
    """Grey levels of one tissue in some images, away from its borders."""

    pixels: int
    mean: float
    #: Of the grey level less its local mean: standard deviation, skewness, 1st and 99th percentile
    deviation: float
    skewness: float
    percentile_1: float
    percentile_99: float
    #: Local maxima per square centimetre
    maxima_per_cm2: float
    #: (32,) parts of the pixels, of the grey level less its local mean from -128 to 128
    histogram: np.ndarray = field(repr=False)

    def to_dict(self) -> dict:
        """Plain values for JSON."""
        return {**vars(self), "histogram": self.histogram.round(5).tolist()}


def extrema_density_cm2(image: np.ndarray, grid: ImageGrid, inside: np.ndarray) -> float:
    """Local maxima of an image (rows, columns) per square centimetre of `inside` (rows, columns) bool.

    They are counted as in T2 (texture_costs.py); the number depends on the size of the pixels.
    """
    area = np.count_nonzero(inside) * grid.pixel_spacing_mm[0] * grid.pixel_spacing_mm[1] / 100.0
    return float(np.count_nonzero(local_extrema(image)[0] & inside) / area) if area else float("nan")


def less_local_mean(image: np.ndarray, grid: ImageGrid, inside: np.ndarray) -> np.ndarray:
    """(rows, columns) float32 grey levels less their Gaussian mean over `inside` (rows, columns) bool; 0 elsewhere."""
    sigma = [LOCAL_MEAN_MM / spacing for spacing in grid.pixel_spacing_mm[::-1]]
    weight = np.maximum(ndimage.gaussian_filter(inside.astype(np.float32), sigma), 1e-6)
    level = np.where(inside, image, 0).astype(np.float32)
    return np.where(inside, level - ndimage.gaussian_filter(level, sigma) / weight, 0.0)


def grey_of_tissues(
    images: Sequence[np.ndarray],
    regions: Sequence[np.ndarray],
    names: dict[int, str],
    grid: ImageGrid,
    inside: np.ndarray,
) -> dict[str, TissueGrey]:
    """{tissue name: TissueGrey} of the tissues that have enough pixels in all images together.

    Parameters
    ----------
    images : (rows, columns) uint8 each.
    regions : (rows, columns) labels at the pixels of each.
    names : {label: tissue name}; labels of one name count as one tissue.
    inside : (rows, columns) bool, the imaged field.

    Raises SimulationError for unequal numbers of images and regions.
    """
    require(
        len(images) == len(regions), f"{len(images)} images and {len(regions)} label images, expected equal numbers"
    )
    high = [less_local_mean(as_image(f"image {n}", image), grid, inside) for n, image in enumerate(images)]
    found = {}
    for name in dict.fromkeys(names.values()):
        labels = [label for label, other in names.items() if other == name]
        where = [_inner(np.isin(region, labels), grid) & inside for region in regions]
        pixels = sum(int(np.count_nonzero(w)) for w in where)
        if pixels < _LEAST_PIXELS:
            continue
        values = np.concatenate([h[w] for h, w in zip(high, where, strict=True)]).astype(float)
        levels = np.concatenate([image[w] for image, w in zip(images, where, strict=True)])
        dense = [
            (extrema_density_cm2(image, grid, w), np.count_nonzero(w))
            for image, w in zip(images, where, strict=True)
            if w.any()
        ]
        found[name] = TissueGrey(
            pixels=pixels,
            mean=float(levels.mean()),
            deviation=float(values.std()),
            skewness=float(stats.skew(values)) if values.std() > 0 else 0.0,
            percentile_1=float(np.percentile(values, 1)),
            percentile_99=float(np.percentile(values, 99)),
            maxima_per_cm2=float(np.average([d for d, _ in dense], weights=[n for _, n in dense])),
            histogram=np.histogram(values, _EDGES)[0] / pixels,
        )
    return found


def level_by_depth(
    images: Sequence[np.ndarray], probe: Probe, grid: ImageGrid, inside: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(bands,) depths in mm and (bands,) mean grey levels of the images there, in bands of 5 mm along the beams."""
    rows, columns = np.indices((grid.rows, grid.columns), np.float32)
    x = grid.left_mm + (columns + 0.5) * grid.pixel_spacing_mm[0]
    y = grid.top_mm + (rows + 0.5) * grid.pixel_spacing_mm[1]
    if probe.is_linear:
        depth = y / np.cos(probe.steering_rad)
    else:
        depth = np.hypot(x, y + probe.apex_radius_mm) - probe.apex_radius_mm
    band = np.clip((depth / _BAND_MM).astype(int), 0, int(np.ceil(probe.depth_mm / _BAND_MM)) - 1)[inside]
    count = np.bincount(band)
    total = sum(np.bincount(band, image[inside], minlength=len(count)) for image in images)
    with np.errstate(invalid="ignore"):
        mean = total / (count * len(images))
    return (np.arange(len(count)) + 0.5) * _BAND_MM, mean


def histogram_misfit(one: TissueGrey, other: TissueGrey) -> float:
    """Sum of absolute differences of two histograms: 0 for equal ones, 2 for those that have no bin in common."""
    return float(np.abs(one.histogram - other.histogram).sum())


def _inner(region: np.ndarray, grid: ImageGrid) -> np.ndarray:
    distance = ndimage.distance_transform_edt(region, sampling=grid.pixel_spacing_mm[::-1])
    return np.asarray(distance) > _BORDER_MM
