"""Comparison: a tracked sequence beside the simulation: played, in the same pixels, and how much they look alike."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import numpy as np
from trame_server.utils.asynchronous import get_event_loop

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.fitting.similarity import Similarity, similarity
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.probe.placement import slice_under_probe
from SlicerUSSim.Logic.tracked.images import TrackedImages
from SlicerUSSim.Workstation.page import SIMULATED
from SlicerUSSim.Workstation.streams import ImageStream

#: Seconds between two images of a sequence that is played.
_PLAY_EVERY_S = 0.1


class RealImages:
    """The images of a sequence on whatever grid the simulated image has."""

    def __init__(self, tracked: TrackedImages) -> None:
        self.tracked = tracked
        self._on_grid: tuple[tuple, np.ndarray, np.ndarray] | None = None

    def __len__(self) -> int:
        return len(self.tracked.images)

    def on_grid(self, place: int, grid: ImageGrid) -> tuple[np.ndarray, np.ndarray]:
        """((rows, columns) uint8, (rows, columns) bool where it shows the field) of the image at this place."""
        key = (place, grid)
        if self._on_grid is None or self._on_grid[0] != key:
            tracked = self.tracked
            image, mask = (
                slice_under_probe(Volume(array[None], tracked.grid.slice_to_probe), grid, np.eye(4), order)
                for array, order in ((tracked.images[place].astype(np.float32), 1), (tracked.mask.astype(np.uint8), 0))
            )
            mask = mask > 0
            self._on_grid = (key, np.where(mask, image.round(), 0).astype(np.uint8), mask)
        return self._on_grid[1], self._on_grid[2]

    def compared(self, place: int, simulated: np.ndarray, grid: ImageGrid) -> Similarity:
        """The paper's cost between a simulated image and the real one at this place."""
        real, mask = self.on_grid(place, grid)
        return similarity(simulated, real, grid.pixel_spacing_mm, mask=mask)


class Comparison:
    """Shows real images to the page, and tells it how alike the simulated one is.

    Parameters
    ----------
    state : of the trame server.
    move : takes the pose (4, 4) that a real image was taken at.
    """

    def __init__(self, state, move: Callable[[np.ndarray], None]) -> None:
        self._state, self._move = state, move
        self._grid: ImageGrid | None = None  # of the simulated image
        self._real: RealImages | None = None
        self._browser = None
        self._playing: asyncio.Task | None = None
        self._comparing = False
        #: Beside the simulated image, and over it
        self.streams = (ImageStream("real"), ImageStream("real-over"))

    def take(self, tracked: TrackedImages, browser_node) -> None:
        """Compare with these from now on."""
        self._real, self._browser = RealImages(tracked), browser_node
        with self._state:
            self._state.update({"sequence_length": len(self._real), "has_real": True})
        self.show(0)

    def show(self, number: int) -> None:
        """Put the probe where the real image at this place was taken, and show that image."""
        if self._real is None:
            return
        number = int(np.clip(number, 0, len(self._real) - 1))
        tracked = self._real.tracked
        with self._state:
            self._state.update({"sequence_number": number, "real_name": f", image {tracked.numbers[number]}"})
        self._browser.SetSelectedItemNumber(number)
        self._move(tracked.poses[number])
        self.send()

    def send(self) -> None:
        """Send the real image to the pages, if they show it."""
        if self._real is None or self._grid is None or self._state.comparison == SIMULATED:
            return
        image, _ = self._real.on_grid(self._state.sequence_number, self._grid)
        for stream in self.streams:
            stream.send(image)

    def compare(self, simulated: np.ndarray, grid: ImageGrid) -> None:
        """Tell how alike a simulated image and the real one are; of images that come too fast, some."""
        if grid != self._grid:
            self._grid = grid
            self.send()
        if self._real is None or self._comparing:
            return
        self._comparing = True
        real, number = self._real, self._state.sequence_number

        async def compare() -> None:
            try:
                found = await asyncio.get_running_loop().run_in_executor(None, real.compared, number, simulated, grid)
                text = f"cost {found.total:.3f} (ρ {found.bhattacharyya:.3f}, SAD {found.sad:.3f})"
            except SimulationError as error:
                text = str(error)
            finally:
                self._comparing = False
            with self._state:
                self._state.similarity = text

        get_event_loop().create_task(compare())

    def play(self) -> None:
        """Play the sequence round and round, or stop."""
        self._state.playing = self._playing is None
        if self._playing is not None:
            self._playing.cancel()
            self._playing = None
        elif self._real is not None:
            self._playing = get_event_loop().create_task(self._play_on())

    async def _play_on(self) -> None:
        while True:
            await asyncio.sleep(_PLAY_EVERY_S)
            self.show((self._state.sequence_number + 1) % len(self._real))
