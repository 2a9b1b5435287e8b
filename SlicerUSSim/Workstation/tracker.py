"""Tracker: a TrackerLink that moves the probe and sends the images, with its state on the page."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import numpy as np
from trame_server.utils.asynchronous import get_event_loop

from SlicerUSSim.Logic.mrml.taken_image import TakenImage
from SlicerUSSim.Logic.tracked.openigtlink import TrackerLink, parse_address
from SlicerUSSim.Workstation.state import SharedState
from SlicerUSSim.Workstation.tasks import Tasks

#: Seconds between two checks of the connection's state.
_LOOK_EVERY_S = 0.3


class Tracker:
    """The connection to a tracker, if any.

    Parameters
    ----------
    move : called in the event loop with the pose (4, 4) from the tracker.
    """

    def __init__(self, shared: SharedState, tasks: Tasks, move: Callable[[np.ndarray], None]) -> None:
        self._shared, self._tasks, self._move = shared, tasks, move
        self._link: TrackerLink | None = None
        self._telling: asyncio.Task | None = None

    def start(self, address: str, device: str | None) -> None:
        """Connect, or wait for a connection; `address` as in parse_address, `device` is the transform to follow.

        Raises SimulationError for an invalid address, and for one at which it cannot listen.
        """
        host, port, listen = parse_address(address)
        self._link = TrackerLink(host, port, self._moved, device=device, listen=listen)
        self._telling = get_event_loop().create_task(self._tell(self._link))

    def send(self, taken: TakenImage) -> None:
        """Send an image with its position (RAS), if there is a tracker."""
        if self._link is not None:
            self._link.send(taken.volume())

    def stop(self) -> None:
        """Close the connection."""
        link, self._link = self._link, None
        if link is not None:
            link.stop()

    def _moved(self, pose: np.ndarray) -> None:
        self._tasks.tell(lambda: self._move(pose))

    async def _tell(self, link: TrackerLink) -> None:
        while self._link is link:
            self._shared.put("messages", {"tracker": link.status})
            await asyncio.sleep(_LOOK_EVERY_S)
