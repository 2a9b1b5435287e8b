"""Comparison: a tracked sequence next to the simulation: playback, resampling to the same pixels, similarity."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from math import inf
from time import perf_counter
from typing import Any

import numpy as np
from trame_server.utils.asynchronous import get_event_loop

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.fitting.image_similarity import RealImages
from SlicerUSSim.Logic.fitting.search import Progress
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.probe.poses import slice_under_probe
from SlicerUSSim.Logic.tracked.images import TrackedImages
from SlicerUSSim.Workstation.state import ComparisonMode, SharedState
from SlicerUSSim.Workstation.streams import ImageStream

#: Seconds between two images during playback of a sequence.
_PLAY_EVERY_S = 0.1
#: Seconds between two of the best images of a fit
_BEST_EVERY_S = 0.5
#: Difference of matrices up to which a pose is the same, mm: nodes and files keep some digits
_SAME_POSE = 1e-3


class Comparison:
    """Shows real images on the page, with their similarity to the simulated image.

    Parameters
    ----------
    move : called with the pose (4, 4) of a real image.
    tell : calls a function soon in the event loop, from another thread.
    """

    def __init__(
        self, shared: SharedState, move: Callable[[np.ndarray], None], tell: Callable[[Callable[[], None]], None]
    ) -> None:  # fmt: skip
        self._shared, self._move, self._tell = shared, move, tell
        self._grid: ImageGrid | None = None  # of the simulated image
        self._real: RealImages | np.ndarray | None = None  # images whose place is not known are (n, rows, columns)
        self._numbers: Sequence[int] = ()  # of the images in their file
        self._browser: Any = None  # vtkMRMLSequenceBrowserNode
        self._playing: asyncio.Task | None = None
        self._waiting: tuple[RealImages, int, np.ndarray, ImageGrid] | None = None  # to be compared
        self._comparing: asyncio.Task | None = None
        self._era = 0  # changes when the previous similarity must no longer be shown
        #: For display next to the simulated image, and over it; and the best image of a fit that runs
        self.streams = (ImageStream("real"), ImageStream("real-over"), ImageStream("best"))
        self._best = (inf, 0.0)  # its cost, and when it was sent

    @property
    def is_comparing(self) -> bool:
        """Whether the similarity of the latest images is still to be shown."""
        return self._comparing is not None

    def take(self, images: TrackedImages | np.ndarray, browser_node: Any = None, number: int = 0) -> None:
        """Compare these images from now on, and show that with the index `number`.

        Of images (n, rows, columns) the place is not known: they are shown beside the simulated ones.
        """
        is_placed = isinstance(images, TrackedImages)
        self._real = real = RealImages(images) if isinstance(images, TrackedImages) else images
        self._browser = browser_node
        self._numbers = real.tracked.numbers if isinstance(real, RealImages) else range(len(real))
        if not is_placed:
            self.sees_nothing(None)
        with self._shared.changing() as now:
            sequence = now.sequence
            sequence.length, sequence.is_placed, sequence.mask = len(real), is_placed, ""
            sequence.numbers = f"{self._numbers[0]} to {self._numbers[-1]}"
            sequence.comparison = sequence.comparison if is_placed else ComparisonMode.BESIDE
        self.show(number)

    def show(self, number: int) -> None:
        """Show the real image with this index, and move the probe to its pose, if that is known."""
        real = self._real
        if real is None:
            return
        number = int(np.clip(number, 0, len(real) - 1))
        with self._shared.changing() as now:
            now.sequence.number, now.sequence.name = number, f"image {self._numbers[number]}"
        if isinstance(real, RealImages):
            self._browser.SetSelectedItemNumber(number)
            self._move(real.tracked.poses[number])
        self.send()

    def show_at(self, pose: np.ndarray) -> bool:
        """As show, for the image with this pose (4, 4); whether there is one."""
        poses = self._real.tracked.poses if isinstance(self._real, RealImages) else ()
        found = [number for number, known in enumerate(poses) if np.allclose(known, pose, atol=_SAME_POSE)]
        if found:
            self.show(found[0])
        return bool(found)

    def send(self) -> None:
        """Send the real image to the pages if they show it."""
        sequence, real, grid = self._shared.now.sequence, self._real, self._grid
        if sequence.comparison is ComparisonMode.SIMULATED:
            return
        if isinstance(real, np.ndarray):
            image = np.clip(real[sequence.number], 0, 255).astype(np.uint8)
            rows, columns = image.shape  # of a size that is not known: a separate ruler, without marks
            about = {"x": 0, "y": 0, "w": columns, "h": rows, "ticks": [], "size": rows / 36, "focus": 0, "range": ""}
            self.streams[0].send(image, ruler=about)
        elif real is not None and grid is not None:
            image, _ = real.on_grid(sequence.number, grid)
            width, height = (n * mm for n, mm in zip((grid.columns, grid.rows), grid.pixel_spacing_mm, strict=True))
            for stream in self.streams[:2]:
                stream.send(image, ruler={"w": width, "h": height})
            box = f"{grid.left_mm:.3f} {grid.top_mm:.3f} {width:.3f} {height:.3f}"
            if (sequence.box, bool(sequence.mask)) != (box, True):
                with self._shared.changing() as now:
                    now.sequence.box, now.sequence.mask = box, real.outline(grid)

    def follow(self, step: Progress) -> None:
        """Show the best image of a fit, at most twice a second; called in its thread."""
        is_new, seconds = step.best_cost != self._best[0], perf_counter()
        if step.image is not None and is_new and seconds > self._best[1] + _BEST_EVERY_S:
            self._best, image = (step.best_cost, seconds), step.image()
            words = f"Best after {step.evaluations} evaluations: image {step.number}, cost {step.best_cost:.3f}"
            self._tell(lambda: self._show_best(image, words, step.number))

    def _show_best(self, image: np.ndarray, words: str, number: int | None) -> None:
        real, grid = self._real, self._grid
        if number in self._numbers and number != self._numbers[self._shared.now.sequence.number]:
            self.show(self._numbers.index(number))  # the same image everywhere
        if isinstance(real, RealImages) and grid is not None and image.shape == real.tracked.mask.shape:
            placed = Volume(image[None].astype(np.float32), real.tracked.grid.slice_to_probe)
            self.streams[2].send(slice_under_probe(placed, grid, np.eye(4)).round().astype(np.uint8))
            with self._shared.changing() as now:
                now.fit.best = words

    def compare_next(self) -> None:
        """Compare in the next way of ComparisonMode."""
        modes = list(ComparisonMode)
        with self._shared.changing() as now:
            now.sequence.comparison = modes[(modes.index(now.sequence.comparison) + 1) % len(modes)]

    def compare(self, simulated: np.ndarray, grid: ImageGrid) -> None:
        """Show the similarity of a simulated image to the real one; if images arrive too fast, some are skipped."""
        if grid != self._grid:
            self._grid = grid
            self.send()
        if not isinstance(self._real, RealImages):
            return
        self._waiting = (self._real, self._shared.now.sequence.number, simulated, grid)
        if self._comparing is None:
            self._comparing = get_event_loop().create_task(self._compare_all())

    def tell_whether_at(self, pose: np.ndarray) -> None:
        """Bring is_elsewhere up to date, for a simulated image with this pose (4, 4)."""
        real, number = self._real, self._shared.now.sequence.number
        is_there = not isinstance(real, RealImages) or np.allclose(real.tracked.poses[number], pose, atol=_SAME_POSE)
        self._shared.put("sequence", {"is_elsewhere": not is_there})

    def sees_nothing(self, grid: ImageGrid | None) -> None:
        """Show no similarity: there is no image, or one without tissue, of which a number would mean nothing."""
        self._waiting = None
        self._era += 1
        if grid is not None and grid != self._grid:
            self._grid = grid
            self.send()
        with self._shared.changing() as now:
            now.sequence.similarity = ""

    def drop(self) -> None:
        """Forget the sequence, which belongs to another patient."""
        self.stop()
        self._real = self._browser = None
        self.sees_nothing(None)
        for stream in self.streams:
            stream.clear()
        with self._shared.changing() as now:
            now.sequence.length, now.sequence.number, now.sequence.name, now.sequence.mask = 0, 0, "", ""

    async def _compare_all(self) -> None:
        try:
            while self._waiting is not None:
                (real, number, image, grid), self._waiting = self._waiting, None
                era = self._era
                try:
                    found = await asyncio.to_thread(real.compared, number, image, grid)
                    text = f"cost {found.total:.3f} (ρ {found.bhattacharyya:.3f}, SAD {found.sad:.3f})"
                except SimulationError as error:
                    text = str(error)
                if era == self._era:
                    with self._shared.changing() as now:
                        now.sequence.similarity = text
        finally:
            self._comparing = None

    def play(self) -> None:
        """Start playing the sequence in a loop, or stop."""
        if self._playing is not None:
            self._playing.cancel()
            self._playing = None
        elif self._real is not None:
            self._playing = get_event_loop().create_task(self._play_on())
        with self._shared.changing() as now:
            now.sequence.playing = self._playing is not None

    def stop(self) -> None:
        """Play no more."""
        if self._playing is not None:
            self.play()

    async def _play_on(self) -> None:
        while self._real is not None:
            await asyncio.sleep(_PLAY_EVERY_S)
            self.show((self._shared.now.sequence.number + 1) % len(self._real))
