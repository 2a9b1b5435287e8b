"""RealImages: a tracked sequence beside the simulation: the same pixels, and how much they look alike."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.scan_conversion import ImageGrid
from SlicerUSSim.Logic.similarity import Similarity, similarity
from SlicerUSSim.Logic.tracked import TrackedImages


class RealImages:
    """The images of a sequence on whatever grid the simulated image has."""

    def __init__(self, tracked: TrackedImages) -> None:
        self.tracked = tracked
        self._on_grid: tuple[tuple, np.ndarray, np.ndarray] | None = None

    def __len__(self) -> int:
        return len(self.tracked.images)

    def on_grid(self, place: int, grid: ImageGrid) -> tuple[np.ndarray, np.ndarray]:
        """((rows, columns) uint8, (rows, columns) bool where it shows the field) of the image at this place."""
        key = (place, grid)
        if self._on_grid is None or self._on_grid[0] != key:
            tracked = self.tracked
            columns, rows = np.meshgrid(np.arange(grid.columns), np.arange(grid.rows))
            pixels = np.stack([columns, rows, 0 * rows, 1 + 0 * rows], axis=-1) @ (
                np.linalg.inv(tracked.grid.image_to_probe) @ grid.image_to_probe
            ).T  # fmt: skip
            at = np.stack([pixels[..., 1], pixels[..., 0]])
            image = ndimage.map_coordinates(tracked.images[place].astype(np.float32), at, order=1)
            mask = ndimage.map_coordinates(tracked.mask.astype(np.uint8), at, order=0) > 0
            self._on_grid = (key, np.where(mask, image.round(), 0).astype(np.uint8), mask)
        return self._on_grid[1], self._on_grid[2]

    def compared(self, place: int, simulated: np.ndarray, grid: ImageGrid) -> Similarity:
        """The paper's cost between a simulated image and the real one at this place."""
        real, mask = self.on_grid(place, grid)
        return similarity(simulated, real, grid.pixel_spacing_mm, mask=mask)
