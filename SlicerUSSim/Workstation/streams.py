"""ImageStream: sends the newest of a series of images, at the rate at which it can encode them."""

from __future__ import annotations

import asyncio
import io
import time
from typing import Any

import numpy as np
from PIL import Image
from trame_server.utils.asynchronous import get_event_loop

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
        self._waiting: tuple[np.ndarray, dict] | None = None
        self._last: tuple[bytes, dict] | None = None
        self._encoding = False
        self._era = 0  # changes when images of before must not be shown any more
        #: Number of the last image, starting at 1
        self.count = 0

    def send(self, image: np.ndarray, **about) -> None:
        """Send a (rows, columns) uint8 image with the metadata `about`; an image that is still waiting is replaced."""
        self._waiting = (image, about)
        if not self._encoding:
            self._encoding = True
            get_event_loop().create_task(self._encode_all())

    def clear(self) -> None:
        """Let the pages show no image; one that is still waiting or encoded is dropped."""
        self._waiting = None
        self._era += 1
        self.count += 1
        self._last = (b"", {"number": self.count, "blank": True})
        self._push(*self._last)

    @property
    def is_sending(self) -> bool:
        """Whether an image is being sent to the pages."""
        return self._encoding

    def send_again(self) -> None:
        """Send the last image once more, to pages that have just opened."""
        if self._last is not None:
            content, about = self._last
            self._push(content, {**about, "stamp": None})  # which is not shown to an event of before

    async def _encode_all(self) -> None:
        try:
            while self._waiting is not None:
                (image, about), self._waiting = self._waiting, None
                era = self._era
                content = await asyncio.get_running_loop().run_in_executor(None, _jpeg, image)
                if era != self._era:
                    continue
                self.count += 1
                about = {"type": "image/jpeg", "number": self.count, **about}
                self._last = (content, about)
                self._push(content, about)
        finally:
            self._encoding = False

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
