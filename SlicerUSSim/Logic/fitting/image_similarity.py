"""Similarity of B-mode images: equations 4 and 5 of Salehi et al., MICCAI 2015 (docs/optimization.md#cost-function).

    L(A, B) = rho(A, B) + lambda SAD(A, B),    rho = mean over patches of sqrt(1 - sum_j sqrt(P_j Q_j))

P and Q are the normalised histograms of the two images in one square patch, SAD is the mean absolute difference of
intensities scaled to [0, 1]. Histograms do not depend on the positions of grey levels within a patch, so rho does not
depend on the speckle's seed. It does depend on the position of patches, and therefore on anatomy and attenuation.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from SlicerUSSim.Logic.base.declaration import Declared, parameter
from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.opencl.device import Device, Workspace
from SlicerUSSim.Logic.opencl.layout import CONSTANTS
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.probe.poses import slice_under_probe
from SlicerUSSim.Logic.tracked.images import TrackedImages

#: A patch at the edge of the common field counts if at least this fraction of it lies inside.
_LEAST_SHARE = 0.25


@dataclass(frozen=True)
class Similarity:
    """The cost and its two parts; 0 for equal images, larger for less similar ones."""

    #: bhattacharyya + sad_weight x sad
    total: float
    #: rho, 0 to 1
    bhattacharyya: float
    #: 0 to 1
    sad: float


@dataclass(frozen=True)
class SimilaritySettings(Declared):
    """Patches, histograms and weights of the cost."""

    patch_mm: float = parameter(
        5.0, "Patches", "Side of the square patches; one patch if larger than the image", unit="mm",
        bounds=(0.01, 1e6),
    )  # fmt: skip
    bins: int = parameter(32, "Bins", "Number of histogram bins", bounds=(2, CONSTANTS["MAX_BINS"]))
    sad_weight: float = parameter(
        1.0, "Weight of the difference", "Weight of the absolute difference", symbol="λ", bounds=(0, 1e3)
    )
    histogram_weight: float = parameter(
        1.0, "Weight of the histograms", "Weight of the histograms; 0: absolute difference only",
        bounds=(0, 1e3), source="1 in the paper",
    )  # fmt: skip

    def patch_pixels(self, shape: tuple[int, int], pixel_spacing_mm: tuple[float, float]) -> tuple[int, int]:
        """(rows, columns) of a patch in an image of `shape` (rows, columns); `pixel_spacing_mm` is (column, row)."""
        rows, columns = (
            max(round(min(self.patch_mm / spacing, size)), 1)
            for spacing, size in zip(pixel_spacing_mm[::-1], shape, strict=True)
        )
        return rows, columns

    def combine(self, apart: np.ndarray, difference: np.ndarray, count: np.ndarray, full: int) -> Similarity:
        """The cost from the patches' 1 - Bhattacharyya coefficient, sum of absolute grey differences and pixel count;
        `full` is the pixel count of a complete patch."""
        pixels = int(count.sum())
        counts = count >= min(_LEAST_SHARE * full, count.max())
        rho = float(np.sqrt(np.clip(apart[counts], 0.0, 1.0)).mean())
        sad = float(difference.sum(dtype=np.float64) / (255.0 * pixels))
        return Similarity(self.histogram_weight * rho + self.sad_weight * sad, rho, sad)


def similarity(
    a: np.ndarray,
    b: np.ndarray,
    pixel_spacing_mm: tuple[float, float],
    *,
    patch_mm: float = 5.0,
    bins: int = 32,
    sad_weight: float = 1.0,
    mask: np.ndarray | None = None,
) -> Similarity:
    """The cost of two images, in plain numpy.

    Parameters
    ----------
    a, b : (rows, columns) uint8 on one grid.
    pixel_spacing_mm : (column, row).
    patch_mm, bins, sad_weight : see SimilaritySettings.
    mask : (rows, columns) bool, the pixels inside both fields (default: all).

    Raises SimulationError for images that are not uint8 or differ in shape, and for a mask without pixels.

    >>> import numpy as np
    >>> from SlicerUSSim.Logic import similarity
    >>> image = np.random.default_rng(0).integers(0, 256, (120, 100), np.uint8)
    >>> similarity(image, image, pixel_spacing_mm=(0.2, 0.2)).total
    0.0
    """
    settings = SimilaritySettings(patch_mm, bins, sad_weight)
    a, b = as_image("first image", a), as_image("second image", b)
    require(a.shape == b.shape, f"the images have shapes {a.shape} and {b.shape}, expected equal shapes")
    inside = as_mask(mask, a.shape)
    rows, columns = settings.patch_pixels(a.shape, pixel_spacing_mm)
    down, across = -(-a.shape[0] // rows), -(-a.shape[1] // columns)
    patch = (np.arange(a.shape[0]) // rows)[:, None] * across + (np.arange(a.shape[1]) // columns)[None, :]
    patch = patch[inside]

    def histograms(image: np.ndarray) -> np.ndarray:
        bin_of = image[inside].astype(np.int64) * bins // 256
        return np.bincount(patch * bins + bin_of, minlength=down * across * bins).reshape(-1, bins)

    count = np.bincount(patch, minlength=down * across)
    apart = 0.5 * ((np.sqrt(histograms(a)) - np.sqrt(histograms(b))) ** 2).sum(axis=1) / np.maximum(count, 1)
    difference = np.bincount(patch, np.abs(a[inside].astype(int) - b[inside]), minlength=down * across)
    return settings.combine(apart, difference, count, rows * columns)


class PatchComparison:
    """Compares images on the device with one reference image that is kept there."""

    def __init__(
        self,
        device: Device,
        reference: np.ndarray,
        mask: np.ndarray,
        pixel_spacing_mm: tuple[float, float],
        settings: SimilaritySettings,
    ) -> None:
        reference = as_image("reference", reference)
        self.shape, self.settings, self.device = reference.shape, settings, device
        self.patch = settings.patch_pixels(reference.shape, pixel_spacing_mm)
        self.patches = tuple(-(-size // step) for size, step in zip(self.shape, self.patch, strict=True))
        self.kernel = device.kernels("similarity.cl")["compare_patches"]
        self._reference = device.upload(reference)
        #: (rows, columns) bool, the pixels that are compared
        self.inside = as_mask(mask, reference.shape)
        self._inside = device.upload(self.inside.astype(np.uint8))
        self._workspace = Workspace(device)

    def run(self, image) -> None:
        """Enqueue the comparison with a device buffer that holds (rows, columns) uint8."""
        rows, columns = self.shape
        self._result = self._workspace.get("result", self.patches[0] * self.patches[1] * 12)
        self.device.run(
            self.kernel,
            self.patches[::-1],
            image,
            self._reference,
            self._inside,
            np.int32(columns),
            np.int32(rows),
            np.int32(self.patch[1]),
            np.int32(self.patch[0]),
            np.int32(self.settings.bins),
            self._result,
        )

    def result(self) -> Similarity:
        """The cost of the image compared last; waits for it."""
        parts = self.device.download(self._result, (*self.patches, 3), np.float32)
        return self.settings.combine(parts[..., 0], parts[..., 1], parts[..., 2], self.patch[0] * self.patch[1])


def as_image(name: str, image: np.ndarray) -> np.ndarray:
    """(rows, columns) uint8, contiguous. Raises SimulationError that names it for anything else."""
    image = np.asarray(image)
    require(
        image.ndim == 2 and image.dtype == np.uint8 and image.size > 0,
        f"{name} is {image.dtype} of shape {image.shape}, expected uint8 (rows, columns)",
    )
    return np.ascontiguousarray(image)


def as_mask(mask: np.ndarray | None, shape: tuple[int, int]) -> np.ndarray:
    """(rows, columns) bool of this shape, all pixels for None. Raises SimulationError for another shape or none."""
    if mask is None:
        return np.ones(shape, bool)
    mask = np.asarray(mask, bool)
    require(mask.shape == shape, f"the mask has shape {mask.shape}, expected that of the images, {shape}")
    require(bool(mask.any()), "the fields of the two images do not overlap: no pixel lies inside both")
    return mask


def target_comparisons(
    device: Device,
    probe: Probe,
    grid: ImageGrid,
    references: Sequence[np.ndarray],
    masks: Sequence[np.ndarray] | None,
    poses: int,
    settings: SimilaritySettings,
) -> list[PatchComparison]:
    """One comparison per reference, (rows, columns) uint8 on `grid`; only pixels inside both fields count.

    Raises SimulationError where shapes or counts differ, fields do not overlap, or a reference is black.
    """
    seen = grid.field(probe)
    require(len(references) > 0, "no reference image, expected at least one")
    require(
        len(references) == poses,
        f"{len(references)} reference images and {poses} poses, expected equal numbers",
    )
    require(
        masks is None or len(masks) == len(references),
        f"{len(masks or ())} masks and {len(references)} reference images, expected equal numbers",
    )
    comparisons = []
    for number, reference in enumerate(references):
        reference = np.asarray(reference)
        require(
            reference.shape == (grid.rows, grid.columns),
            f"reference image {number} has shape {reference.shape}, expected that of the simulated images, "
            f"{(grid.rows, grid.columns)}",
        )
        inside = seen if masks is None else seen & np.asarray(masks[number], bool)
        require(
            bool(inside.any()),
            f"reference image {number}: its field and the probe's do not overlap; check the geometry",
        )
        require(int(reference[inside].max()) > 0, f"reference image {number} is black inside the field")
        comparisons.append(PatchComparison(device, reference, inside, grid.pixel_spacing_mm, settings))
    return comparisons


def mean_total(similarities: Iterable[Similarity]) -> float:
    """The mean cost of several images."""
    return float(np.mean([one.total for one in similarities]))


class RealImages:
    """The images of a sequence, resampled to the grid of the simulated image."""

    def __init__(self, tracked: TrackedImages) -> None:
        self.tracked = tracked
        self._on_grid: tuple[tuple, np.ndarray, np.ndarray] | None = None

    def __len__(self) -> int:
        return len(self.tracked.images)

    def on_grid(self, place: int, grid: ImageGrid) -> tuple[np.ndarray, np.ndarray]:
        """(image (rows, columns) uint8, mask (rows, columns) bool of the imaged field) of the image with this index."""
        key = (place, grid)
        if self._on_grid is None or self._on_grid[0] != key:
            tracked = self.tracked
            image, mask = (
                slice_under_probe(Volume(array[None], tracked.grid.slice_to_probe), grid, np.eye(4), order)
                for array, order in ((tracked.images[place].astype(np.float32), 1), (tracked.mask.astype(np.uint8), 0))
            )
            mask = mask > 0
            self._on_grid = (key, np.where(mask, image.round(), 0).astype(np.uint8), mask)
        return self._on_grid[1], self._on_grid[2]

    def outline(self, grid: ImageGrid) -> str:
        """What is compared, as a path of an SVG in mm of the probe frame."""
        from skimage.measure import approximate_polygon, find_contours

        _, mask = self.on_grid(0, grid)
        lines = find_contours(np.pad(mask, 1).astype(float), 0.5)
        scale, first = np.array(grid.pixel_spacing_mm), np.array([grid.left_mm, grid.top_mm])
        shapes = [first + scale * (approximate_polygon(line, 0.7)[:, ::-1] - 0.5) for line in lines]
        return " ".join("M " + " ".join(f"{x:.2f},{y:.2f}" for x, y in shape) + " Z" for shape in shapes)

    def compared(self, place: int, simulated: np.ndarray, grid: ImageGrid) -> Similarity:
        """The paper's cost between a simulated image and the real image with this index."""
        real, mask = self.on_grid(place, grid)
        return similarity(simulated, real, grid.pixel_spacing_mm, mask=mask)
