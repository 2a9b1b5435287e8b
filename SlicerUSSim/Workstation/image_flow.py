"""ImageFlow: distribution of every simulated image: page, views, comparison, cine loop, tracker."""

from __future__ import annotations

from time import perf_counter

import numpy as np

from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Workstation.anatomy import AnatomyViews
from SlicerUSSim.Workstation.comparison import Comparison
from SlicerUSSim.Workstation.export import Cine
from SlicerUSSim.Workstation.latency import LatencyStamps
from SlicerUSSim.Workstation.state import DepthTick, ImageGeometry, SharedState
from SlicerUSSim.Workstation.streams import ImageStream
from SlicerUSSim.Workstation.tracker import Tracker


class ImageFlow:
    """Distributes the images of the logic to page, views, comparison, cine loop and tracker."""

    def __init__(
        self,
        shared: SharedState,
        logic: UltrasoundSceneLogic,
        views: AnatomyViews,
        comparison: Comparison,
        cine: Cine,
        tracker: Tracker,
        stamps: LatencyStamps,
    ) -> None:
        self._shared, self._logic, self._views = shared, logic, views
        self._comparison, self._cine, self._tracker, self._stamps = comparison, cine, tracker, stamps
        self._simulated = ImageStream("simulated")
        self._field: tuple[tuple[ImageGrid, Probe], np.ndarray] | None = None

    @property
    def streams(self) -> tuple[ImageStream, ...]:
        """All image streams of the pages, simulated and real."""
        return self._simulated, *self._comparison.streams

    def image_changed(self) -> None:
        """Distribute the new image."""
        frame = self._logic.lastFrame
        if frame is None:
            return
        self._simulated.send(frame.image, stamp=self._stamps.computed)
        self._cine.add(frame.image, perf_counter())
        self._views.show_image(self._logic.parameters.output, self._field_of(frame.grid))
        if self._tracker.is_on:
            self._tracker.send(self._logic.lastImage())
        self._comparison.compare(frame.image, frame.grid)

    def tell_geometry(self) -> None:
        """Update the geometry that the page draws around the image, after a change of probe or display."""
        preset = self._logic.preset
        grid = ImageGrid.for_probe(preset.probe, preset.display.image_size)
        width, height = grid.columns * grid.pixel_spacing_mm[0], grid.rows * grid.pixel_spacing_mm[1]
        step = 10 if height > 40 else 5
        ticks = [
            DepthTick(depth, str(depth) if depth % (2 * step) == 0 else "")
            for depth in range(0, int(grid.top_mm + height) + 1, step)
        ]
        with self._shared.changing() as now:
            now.image = ImageGeometry(
                x=grid.left_mm,
                y=grid.top_mm,
                w=width,
                h=height,
                ticks=ticks,
                size=height / 36.0,
                focus=preset.probe.focus_mm or 0.0,
                range=f"{preset.display.dynamic_range_db:.0f}",
            )

    def show_again(self) -> None:
        """Send the current images again, for a page that has just opened."""
        for stream in self.streams:
            stream.send_again()
        for view in (self._views.threed, *self._views.slices):
            view.schedule_render()

    def _field_of(self, grid: ImageGrid) -> np.ndarray:
        """(rows, columns) bool: the imaged field."""
        key = grid, self._logic.preset.probe
        if self._field is None or self._field[0] != key:
            self._field = key, grid.field(key[1])
        return self._field[1]
