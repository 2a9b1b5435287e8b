"""ImageFlow: distribution of every simulated image: page, views, comparison, cine, tracker; and what it is of."""

from __future__ import annotations

from dataclasses import asdict
from time import perf_counter

import numpy as np
from trame_server.utils.asynchronous import get_event_loop

from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mrml.taken_image import TakenImage
from SlicerUSSim.Logic.probe.arrays import PROBES, Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Widget.image_presenter import FROZEN
from SlicerUSSim.Workstation.anatomy import AnatomyViews
from SlicerUSSim.Workstation.browser_panel import BrowserPanel
from SlicerUSSim.Workstation.cine import Cine
from SlicerUSSim.Workstation.comparison import Comparison
from SlicerUSSim.Workstation.state import ImageState
from SlicerUSSim.Workstation.streams import ImageStream
from SlicerUSSim.Workstation.tasks import AtMost
from SlicerUSSim.Workstation.tracker import Tracker

#: Seconds between two updates of Slicer's views, which delay the image.
_VIEWS_EVERY_S = 0.12
#: Seconds for which a live image may differ from the scene until it is outdated, and between two comparisons
_OUTDATED_S, _COMPARE_EVERY_S = 0.5, 0.25
#: Height of the image in heights of its letters
_LETTERS = 36.0


class ImageFlow:
    """Distributes the images of the logic to page, views, comparison, cine and tracker."""

    def __init__(
        self, panel: BrowserPanel, views: AnatomyViews, comparison: Comparison, cine: Cine, tracker: Tracker,
        stamps: LatencyStamps,
    ) -> None:  # fmt: skip
        self._panel, self._logic, self._views = panel, panel.logic, views
        self._comparison, self._cine, self._tracker, self._stamps = comparison, cine, tracker, stamps
        self._simulated = ImageStream("simulated")
        self._field: tuple[tuple[ImageGrid, Probe], np.ndarray] | None = None
        self._differs_since: float | None = None
        self._show_in_views = AtMost(_VIEWS_EVERY_S, self._views_changed)
        panel.refreshed.append(self.tell)

    @property
    def streams(self) -> tuple[ImageStream, ...]:
        """All image streams of the pages, simulated and real."""
        return self._simulated, self._cine.mmode, *self._comparison.streams

    @property
    def is_shown(self) -> bool:
        """Whether Slicer's views have the last image."""
        return not self._show_in_views.is_waiting

    def image_changed(self) -> None:
        """Distribute the new image, or the news that there is no longer one."""
        taken = self._logic.taken
        if taken is None:
            self.clear()
            return
        self._simulated.send(taken.image, stamp=self._stamps.computed, **_description(taken))
        self._cine.add(taken)
        self._show_in_views()
        self._tracker.send(taken)
        if taken.is_empty:
            self._comparison.sees_nothing(taken.grid)
        else:
            self._comparison.compare(taken.image, taken.grid)
        self._differs_since = None
        self.tell()

    def clear(self) -> None:
        """Show no image anywhere, since the previous one shows another patient or pose."""
        self._simulated.clear()
        self._cine.clear()
        self._views.hide_image()
        self._comparison.sees_nothing(None)
        self.tell()

    def watch(self) -> None:
        """Compare the image with the scene from now on; pages learn whether they differ, whatever has changed."""
        self.tell()
        get_event_loop().call_later(_COMPARE_EVERY_S, self.watch)

    def tell(self) -> None:
        """Bring ImageState and CineState up to date."""
        self._cine.tell()
        taken, shown = self._logic.taken, ImageState()
        if taken is not None:
            self._comparison.tell_whether_at(taken.probe_to_world)
            differs, seconds = self._logic.differences(taken), perf_counter()
            if not differs:
                self._differs_since = None
            elif self._differs_since is None:
                self._differs_since = seconds
            is_late = self._differs_since is not None and seconds - self._differs_since > _OUTDATED_S
            shown = _texts(taken)
            shown.status = "OUTDATED" if is_late else "LIVE"
            if not self._logic.isLive and not (differs and self._panel.presenter.isBusy):  # not until Segment is done
                shown.status = FROZEN
                self._logic.holdOutline()
            shown.differs = "" if shown.status == "LIVE" else ", ".join(differs)
        self._panel.shared.put("image", asdict(shown))

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
            self._views.follow(taken.probe_to_world, taken.preset.probe)

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
        "sequence": taken.number,
    }


def _texts(taken: TakenImage) -> ImageState:
    """What a banner says of an image."""
    probe, display = taken.preset.probe, taken.preset.display
    name = next((name.replace("_", " ") for name, known in PROBES.items() if known == probe), probe.kind)
    focus = {"Focus": f"{probe.focus_mm:.4g} mm"} if probe.focus_mm else {}
    values = {"Depth": f"{probe.depth_mm:.4g} mm", **focus, "Gain": f"{display.gain_db:+.3g} dB"}
    return ImageState(
        patient=taken.patient, time=f"{taken.time[11:19]} UTC", probe=name, frequency=f"{probe.received_mhz:.3g} MHz",
        values={**values, "DR": f"{display.dynamic_range_db:.3g} dB"},
    )  # fmt: skip


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
