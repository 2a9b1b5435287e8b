"""Tracker: a TrackerLink that moves the probe and sends the images, with its state on the page.

Where it waits for clients it is an ultrasound device, which answers their commands.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from trame_server.utils.asynchronous import get_event_loop

from SlicerUSSim.Logic.device.plus_commands import PlusCommands
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic
from SlicerUSSim.Logic.mrml.taken_image import TakenImage
from SlicerUSSim.Logic.tracked.openigtlink import TrackerLink, parse_address
from SlicerUSSim.Workstation.state import SharedState
from SlicerUSSim.Workstation.tasks import Tasks

#: Seconds between two checks of the connection's state.
_LOOK_EVERY_S = 0.3
#: Seconds that a command waits for the event loop
_PATIENCE_S = 5.0


class Tracker:
    """The connection to a tracker, if any.

    Parameters
    ----------
    move : called in the event loop with the pose (4, 4) from the tracker.
    """

    def __init__(
        self, shared: SharedState, tasks: Tasks, move: Callable[[np.ndarray], None], logic: UltrasoundSceneLogic
    ) -> None:
        self._shared, self._tasks, self._move, self._logic = shared, tasks, move, logic
        self._is_device, self._loop = False, get_event_loop()
        self._link: TrackerLink | None = None
        self._telling: asyncio.Task | None = None

    def start(self, address: str, device: str | None) -> None:
        """Connect, or wait for a connection; `address` as in parse_address, `device` is the transform to follow.

        Raises SimulationError for an invalid address, and for one at which it cannot listen.
        """
        host, port, listen = parse_address(address)
        self._is_device = listen
        commands = PlusCommands(
            lambda: self._in_loop(lambda: self._logic.preset),
            lambda preset: self._in_loop(lambda: setattr(self._logic, "preset", preset)), self._transforms,
        )  # fmt: skip
        self._link = TrackerLink(host, port, self._moved, device=device, listen=listen, answer=commands.answer)
        self._telling = self._loop.create_task(self._tell(self._link))

    def send(self, taken: TakenImage) -> None:
        """Send an image with its position (RAS), if there is a tracker; to clients with its transforms."""
        if self._link is not None:
            self._link.send(taken.volume(), self._transforms() if self._is_device else {})

    def stop(self) -> None:
        """Close the connection."""
        link, self._link = self._link, None
        if link is not None:
            link.stop()

    def _moved(self, pose: np.ndarray) -> None:
        self._tasks.tell(lambda: self._move(pose))

    def _in_loop(self, function: Callable[[], Any]) -> Any:
        """What `function` returns in the event loop, where nodes are used; called in a thread of the link.

        Raises TimeoutError if the page is busy.
        """

        async def run() -> Any:
            return function()

        return asyncio.run_coroutine_threadsafe(run(), self._loop).result(_PATIENCE_S)

    def _transforms(self) -> Mapping[str, np.ndarray]:
        taken = self._logic.taken
        if taken is None:
            return {}
        return {"ImageToProbe": taken.grid.image_to_probe, "ProbeToReference": taken.probe_to_world}

    async def _tell(self, link: TrackerLink) -> None:
        while self._link is link:
            self._shared.put("messages", {"tracker": link.status})
            await asyncio.sleep(_LOOK_EVERY_S)
