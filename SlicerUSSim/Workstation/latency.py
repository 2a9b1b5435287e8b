"""LatencyStamps: which mouse event an image shows the effect of, so that the page can measure how long it took."""

from __future__ import annotations

#: A page, and the time of an event on it, by that page's clock, ms.
Stamp = tuple[str, float]


class LatencyStamps:
    """Follows a stamp from the page that told it, through the probe that was moved, to the image of that pose."""

    def __init__(self) -> None:
        self._told: Stamp | None = None
        self._applied: Stamp | None = None
        #: Of the last image
        self.computed: Stamp | None = None

    def told(self, page: str, milliseconds: float) -> None:
        """A page says when the mouse moved, just before it says that it did."""
        self._told = (page, milliseconds)

    def probe_moved(self) -> None:
        """A hand is about to move the probe."""
        self._applied = self._told

    def image_begun(self) -> None:
        """An image is about to be computed, of where the probe is now."""
        self.computed = self._applied
