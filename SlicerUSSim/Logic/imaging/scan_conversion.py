"""Host side of kernels/scan_conversion.cl: from scan lines to an image in the probe plane."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from SlicerUSSim.Logic.imaging.bmode import Compressor
from SlicerUSSim.Logic.opencl.device import Device, Workspace
from SlicerUSSim.Logic.probe.image_grid import ImageGrid

if TYPE_CHECKING:
    from pyopencl import Buffer


class ScanConverter:
    """Interpolates the grey levels of the scan lines at the pixels of an ImageGrid."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self.average = device.kernels("bmode.cl", device.lanes)["average_depth"]
        self.convert = device.kernels("scan_conversion.cl", device.lanes)["scan_convert"]
        self.workspace = Workspace(device)
        # Of the frame converted last; the image is uint8 [row][column]
        self.grid: ImageGrid
        self.image: Buffer

    def run(self, acquisition_buffer: Buffer, acquisition: np.ndarray, grid: ImageGrid, lines: Compressor) -> None:
        """Enqueue the conversion of one frame."""
        self.grid = grid
        self.image = self.workspace.get("image", grid.rows * grid.columns)
        smooth = self.workspace.get("smooth", lines.lines * lines.samples)
        self.device.run(
            self.average,
            (lines.samples // self.device.lanes, lines.lines),
            lines.grey,
            smooth,
            np.int32(lines.samples),
            np.int32(max(round(grid.pixel_spacing_mm[1] / float(acquisition["sample_mm"])), 1)),
        )
        self.device.run(
            self.convert,
            (-(-grid.columns // self.device.lanes), grid.rows),
            acquisition_buffer,
            smooth,
            np.float32(grid.left_mm),
            np.float32(grid.top_mm),
            np.float32(grid.pixel_spacing_mm[0]),
            np.float32(grid.pixel_spacing_mm[1]),
            np.int32(grid.columns),
            self.image,
        )

    def download(self) -> np.ndarray:
        """(rows, columns) uint8 image of the frame converted last."""
        return self.device.download(self.image, (self.grid.rows, self.grid.columns), np.uint8)
