"""Host code of kernels/scan_conversion.cl: from scan lines to pixels in the image plane."""

from __future__ import annotations

import numpy as np

from SlicerUSSim.Logic.imaging.signals import RayTree
from SlicerUSSim.Logic.imaging.stage import DeviceFrame, Stage, Work
from SlicerUSSim.Logic.opencl.device import Device, Workspace

_PER_PIXEL = 80  # operations


class ScanConverter(Stage):
    """Interpolates the grey levels of the scan lines at the pixels of an ImageGrid."""

    name = "scan conversion"

    def __init__(self, device: Device) -> None:
        super().__init__(device)
        self.average = device.kernels("bmode.cl", device.lanes)["average_depth"]
        self.convert = device.kernels("scan_conversion.cl", device.lanes)["scan_convert"]
        self.workspace = Workspace(device)

    def run(self, frame: DeviceFrame) -> None:
        """Enqueue the conversion of one frame: its `image`."""
        grid, (lines, samples) = frame.grid, frame.line_shape
        sample_mm = float(frame.acquisition["sample_mm"])
        frame.image = self.workspace.get("image", grid.rows * grid.columns)
        smooth = self.workspace.get("smooth", lines * samples)
        self.device.run(
            self.average,
            (samples // self.device.lanes, lines),
            frame.grey,
            smooth,
            np.int32(samples),
            np.int32(np.ceil(float(frame.acquisition["depth_mm"]) / sample_mm)),
            np.int32(max(round(grid.pixel_spacing_mm[1] / sample_mm), 1)),
        )
        self.device.run(
            self.convert,
            (-(-grid.columns // self.device.lanes), grid.rows),
            frame.acquisition_buffer,
            smooth,
            np.float32(grid.left_mm),
            np.float32(grid.top_mm),
            np.float32(grid.pixel_spacing_mm[0]),
            np.float32(grid.pixel_spacing_mm[1]),
            np.int32(grid.columns),
            frame.image,
        )

    def work(self, frame: DeviceFrame, tree: RayTree) -> Work:
        grid, (lines, samples) = frame.grid, frame.line_shape
        pixels, averaged = grid.rows * grid.columns, grid.pixel_spacing_mm[1] / float(frame.acquisition["sample_mm"])
        return Work(2 * lines * samples + 9 * pixels, averaged * lines * samples + _PER_PIXEL * pixels)
