"""ImageStream: sends a series of images to the pages."""

from __future__ import annotations

import io
import time
from typing import Any

import numpy as np
from PIL import Image

#: Qualities of which the first that is small enough is taken, in half a millisecond each. With the first one, speckle
#: differs by 2 of 255 grey levels in the mean (38 dB); the last one is for the widest fields (32 dB). WebP is a quarter
#: smaller for the same difference, and takes ten times as long, which images wait for.
_QUALITIES, _MOST_BYTES = (85, 78, 72, 66, 60), 45_000


class ImageStream:
    """Sends grey images to all pages under one name; static/workstation.js draws them.

    Implements the interface of an area of trame-rca.
    """

    def __init__(self, name: str) -> None:
        self.area_name = name
        self._streamer: Any = None
        self._last: tuple[bytes, dict] | None = None
        #: Number of the last image, starting at 1
        self.count = 0

    def send(self, image: np.ndarray, **about) -> None:
        """Send a (rows, columns) uint8 image with the metadata `about`.

        It is encoded here, in 1 to 5 ms: another thread's result would wait for the views to be drawn.
        """
        self.count += 1
        self._last = _jpeg(image), {"type": "image/jpeg", "number": self.count, **about}
        self._push(*self._last)

    def clear(self) -> None:
        """Let the pages show no image."""
        self.count += 1
        self._last = (b"", {"number": self.count, "blank": True})
        self._push(*self._last)

    def send_again(self) -> None:
        """Send the last image once more, to pages that have just opened."""
        if self._last is not None:
            content, about = self._last
            self._push(content, {**about, "stamp": None})  # which no previous event waits for

    def _push(self, content: bytes, about: dict) -> None:
        if self._streamer is not None:
            self._streamer.push_content(self.area_name, {**about, "st": int(time.time() * 1e3)}, content)

    # ---- interface of trame-rca --------------------------------------------------------------------------------

    def set_streamer(self, streamer) -> None:
        self._streamer = streamer

    def update_size(self, origin, size) -> None:
        """Ignored: pages scale the image themselves."""

    def on_interaction(self, origin, event) -> None:
        """Ignored: pages send events on the image as named triggers, see page.py."""


def _jpeg(image: np.ndarray) -> bytes:
    picture, content = Image.fromarray(image), b""
    for quality in _QUALITIES:
        buffer = io.BytesIO()
        picture.save(buffer, "JPEG", quality=quality)
        content = buffer.getvalue()
        if len(content) <= _MOST_BYTES:
            break
    return content
