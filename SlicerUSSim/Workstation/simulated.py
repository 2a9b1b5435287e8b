"""SimulatedSequence: shows and plays on the page the images that Simulate sequence made."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import numpy as np
from trame_server.utils.asynchronous import get_event_loop

from SlicerUSSim.Logic.base.errors import required
from SlicerUSSim.Workstation.browser_panel import BrowserPanel
from SlicerUSSim.Workstation.comparison import Comparison

#: Seconds between two images while they are played
_PLAY_EVERY_S = 0.1


class SimulatedSequence:
    """The chosen sequence of simulated images. While one of them is shown, there are no live images.

    Parameters
    ----------
    move : called with the pose (4, 4) of an image.
    """

    def __init__(self, panel: BrowserPanel, comparison: Comparison, move: Callable[[np.ndarray], None]) -> None:
        self._shared, self._logic, self._presenter = panel.shared, panel.logic, panel.presenter
        self._comparison, self._move = comparison, move
        self._playing: asyncio.Task | None = None

    def show(self, number: int) -> None:
        """Show the image with this index where it was taken, with the probe there, and the real image of that pose."""
        with self._presenter.shown():
            self._show(number)

    def _show(self, number: int) -> None:
        parameters: Any = self._logic.parameters
        images = required(parameters.image_sequence, "no simulated sequence is chosen, press Simulate sequence")
        output = required(parameters.output, "no image is shown yet, expected a patient and a probe first")
        number = int(np.clip(number, 0, max(images.GetNumberOfDataNodes() - 1, 0)))
        pose = self._logic.sequenceImage(images, number).probe_to_world
        self._presenter.images.setLive(False)
        if not self._comparison.show_at(pose):
            self._move(pose)
        self._logic.showSequenceImage(images, number, output)
        with self._shared.changing() as now:
            now.simulated.number = number

    def play(self) -> None:
        """Start playing the images in a loop, or stop."""
        if self._playing is not None:
            self.stop()
            return
        self._comparison.stop()
        self._presenter.images.setLive(False)
        self._playing = get_event_loop().create_task(self._play_on())
        self._tell()

    def stop(self) -> None:
        """Play no more."""
        if self._playing is not None:
            self._playing.cancel()
            self._playing = None
            self._tell()

    def _tell(self) -> None:
        with self._shared.changing() as now:
            now.simulated.playing = self._playing is not None

    async def _play_on(self) -> None:
        with self._presenter.shown():
            number = 0
            # Live images, once they are wanted again, end it
            while (length := self._shared.now.simulated.length) and not self._logic.isLive:
                self._show(number % length)
                await asyncio.sleep(_PLAY_EVERY_S)
                number = self._shared.now.simulated.number + 1
        self._playing = None
        self._tell()
