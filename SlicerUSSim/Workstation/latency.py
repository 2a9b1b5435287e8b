"""LatencyStamps: assigns mouse events to the images that show their effect, so that the page can measure latency."""

from __future__ import annotations

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
        """Called before the user moves the probe."""
        self._applied = self._received

    def image_begun(self) -> None:
        """Called before an image of the current pose is computed."""
        self.computed = self._applied
