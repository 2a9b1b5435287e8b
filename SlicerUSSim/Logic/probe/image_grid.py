"""ImageGrid: the pixels of an image in the plane of a probe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from SlicerUSSim.Logic.probe.arrays import Probe

_DEFAULT_ROWS = 512


@dataclass(frozen=True)
class ImageGrid:
    """The pixels of the scan-converted image in the probe frame (millimetres).

    >>> from SlicerUSSim.Logic.probe import PROBES, ImageGrid
    >>> grid = ImageGrid.for_probe(PROBES["linear"], (400, 380))  # rows, columns
    >>> [round(mm, 3) for mm in grid.pixel_spacing_mm]
    [0.1, 0.1]
    >>> (grid.image_to_probe @ [0, 0, 0, 1])[:3].round(2).tolist()  # the centre of the first pixel
    [-18.95, 0.05, 0.0]
    """

    rows: int
    columns: int
    #: Outer edges of the first pixel
    left_mm: float
    top_mm: float
    #: (column, row)
    pixel_spacing_mm: tuple[float, float]

    @classmethod
    def for_probe(cls, probe: Probe, image_size: tuple[int, int] | None) -> ImageGrid:
        """The smallest grid around the imaged field; square pixels unless `image_size` (rows, columns) is given."""
        left, right, top, bottom = probe.image_bounds_mm()
        if image_size is None:
            pixel = (bottom - top) / _DEFAULT_ROWS
            columns = max(int(np.ceil((right - left) / pixel)), 2)
            centre = 0.5 * (left + right)
            return cls(_DEFAULT_ROWS, columns, centre - 0.5 * columns * pixel, top, (pixel, pixel))
        rows, columns = image_size
        return cls(rows, columns, left, top, ((right - left) / columns, (bottom - top) / rows))

    @property
    def image_to_probe(self) -> np.ndarray:
        """(4, 4) map from (column, row, 0, 1) of pixel centres to the probe frame in millimetres."""
        matrix = np.eye(4)
        matrix[0, 0], matrix[1, 1] = self.pixel_spacing_mm
        matrix[0, 3] = self.left_mm + 0.5 * self.pixel_spacing_mm[0]
        matrix[1, 3] = self.top_mm + 0.5 * self.pixel_spacing_mm[1]
        return matrix

    @property
    def slice_to_probe(self) -> np.ndarray:
        """(4, 4) the same for the image as a volume of one slice, whose thickness is the height of a pixel."""
        matrix = self.image_to_probe
        matrix[2, 2] = self.pixel_spacing_mm[1]
        return matrix

    def field(self, probe: Probe) -> np.ndarray:
        """(rows, columns) bool: pixels within the field imaged by `probe`."""
        x, y = self.left_mm, self.top_mm
        dx, dy = self.pixel_spacing_mm
        return probe.holds(
            x + dx * (np.arange(self.columns) + 0.5)[None, :], y + dy * (np.arange(self.rows) + 0.5)[:, None]
        )
