"""ImageFlow: distribution of every simulated image: page, views, comparison, cine loop, tracker."""

from __future__ import annotations

from time import perf_counter

import numpy as np

from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mrml.nodes import node_to_world
from SlicerUSSim.Logic.mrml.taken_image import TakenImage, about_as_json
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Workstation.anatomy import AnatomyViews
from SlicerUSSim.Workstation.browser_panel import BrowserPanel
from SlicerUSSim.Workstation.comparison import Comparison
from SlicerUSSim.Workstation.export import Cine
from SlicerUSSim.Workstation.streams import ImageStream
from SlicerUSSim.Workstation.tasks import AtMost
from SlicerUSSim.Workstation.tracker import Tracker

#: Seconds between two updates of Slicer's views, which delay the image.
_VIEWS_EVERY_S = 0.12
#: Height of the image in heights of its letters
_LETTERS = 36.0


class ImageFlow:
    """Distributes the images of the logic to page, views, comparison, cine loop and tracker."""

    def __init__(
        self, panel: BrowserPanel, views: AnatomyViews, comparison: Comparison, cine: Cine, tracker: Tracker,
        stamps: LatencyStamps,
    ) -> None:  # fmt: skip
        self._panel, self._logic, self._views = panel, panel.logic, views
        self._comparison, self._cine, self._tracker, self._stamps = comparison, cine, tracker, stamps
        self._simulated = ImageStream("simulated")
        self._field: tuple[tuple[ImageGrid, Probe], np.ndarray] | None = None
        self._show_in_views = AtMost(_VIEWS_EVERY_S, self._views_changed)

    @property
    def streams(self) -> tuple[ImageStream, ...]:
        """All image streams of the pages, simulated and real."""
        return self._simulated, *self._comparison.streams

    @property
    def is_shown(self) -> bool:
        """Whether Slicer's views have the last image."""
        return not self._show_in_views.is_waiting

    def image_changed(self) -> None:
        """Distribute the new image, or that there is none any more."""
        taken = self._logic.taken
        if taken is None:
            self.clear()
            return
        self._simulated.send(taken.image, stamp=self._stamps.computed, **_description(taken))
        self._cine.add(taken.image, perf_counter(), about_as_json(taken.node))
        self._show_in_views()
        if self._tracker.is_on:
            self._tracker.send(taken.volume())
        if taken.is_empty:
            self._comparison.sees_nothing(taken.grid)
        else:
            self._comparison.compare(taken.image, taken.grid)
        self._panel.tellFrozen()

    def clear(self) -> None:
        """Show no image anywhere, since that of before is not of this patient or pose."""
        self._simulated.clear()
        self._cine.clear()
        self._views.hide_image()
        self._comparison.sees_nothing(None)
        self._panel.tellFrozen()

    def show_again(self) -> None:
        """Send the current images again, for a page that has just opened."""
        for stream in self.streams:
            stream.send_again()
        for view in (self._views.threed, *self._views.slices):
            view.schedule_render()

    def _views_changed(self) -> None:
        """Show the image in Slicer's views, and turn the slices to it: both are of one moment."""
        taken = self._logic.taken
        if taken is not None:
            self._views.show_image(taken, self._field_of(taken.grid, taken.preset.probe))
            if self._logic.isLive or self._is_at(taken):  # the first image comes before Live has begun
                self._views.follow(taken.probe_to_world, taken.preset.probe)

    def _is_at(self, taken: TakenImage) -> bool:
        """Whether the probe is where an image was taken."""
        transform = self._logic.parameters.probe_transform
        return transform is not None and np.allclose(node_to_world(transform), taken.probe_to_world)

    def _field_of(self, grid: ImageGrid, probe: Probe) -> np.ndarray:
        """(rows, columns) bool: the imaged field."""
        key = grid, probe
        if self._field is None or self._field[0] != key:
            self._field = key, grid.field(probe)
        return self._field[1]


def _description(taken: TakenImage) -> dict[str, object]:
    """What pages show with an image, in one message with it, so that it is never that of another image."""
    return {
        "ruler": _ruler(taken.grid, taken.preset),
        "patient": taken.patient,
        "time": taken.time,
        "pose": taken.probe_to_world.round(3).tolist(),
        "sequence": None if taken.number is None else taken.number + 1,
    }


def _ruler(grid: ImageGrid, preset: Preset) -> dict[str, object]:
    """Edges of an image in the probe frame, mm, marks of depth, size of letters, focus, and dynamic range."""
    width, height = grid.columns * grid.pixel_spacing_mm[0], grid.rows * grid.pixel_spacing_mm[1]
    step = 10 if height > 40 else 5
    depths = range(0, int(grid.top_mm + height) + 1, step)
    return {
        "x": grid.left_mm,
        "y": grid.top_mm,
        "w": width,
        "h": height,
        "ticks": [{"y": depth, "text": str(depth) if depth % (2 * step) == 0 else ""} for depth in depths],
        "size": height / _LETTERS,
        "focus": preset.probe.focus_mm or 0.0,
        "range": f"{preset.display.dynamic_range_db:.0f}",
    }


#: A page, and the time of an event on it by that page's clock, ms.
Stamp = tuple[str, float]


class LatencyStamps:
    """Passes a stamp from the page that sent it, through the movement of the probe, to the image of that pose."""

    def __init__(self) -> None:
        self._received: Stamp | None = None
        self._applied: Stamp | None = None
        #: Stamp of the last image
        self.computed: Stamp | None = None

    def receive(self, page: str, milliseconds: float) -> None:
        """Store the time of a mouse event, which the page sends just before the event itself."""
        self._received = (page, milliseconds)

    def probe_moved(self) -> None:
        """Called before the user moves the probe: by the event of which the page has just sent the time, or by none."""
        self._applied, self._received = self._received, None

    def image_begun(self) -> None:
        """Called before an image of the current pose is computed; only the first one shows the effect of the event."""
        self.computed, self._applied = self._applied, None
