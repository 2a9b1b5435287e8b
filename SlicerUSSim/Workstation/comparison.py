"""Comparison: a tracked sequence next to the simulation: playback, resampling to the same pixels, similarity."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from math import inf
from time import perf_counter
from typing import Any

import numpy as np
from trame_server.utils.asynchronous import get_event_loop

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.fitting.image_similarity import Similarity, similarity
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


class RealImages:
    """The images of a sequence, resampled to the grid of the simulated image."""

    def __init__(self, tracked: TrackedImages) -> None:
        self.tracked = tracked
        self._on_grid: tuple[tuple, np.ndarray, np.ndarray] | None = None

    def __len__(self) -> int:
        return len(self.tracked.images)

    def on_grid(self, place: int, grid: ImageGrid) -> tuple[np.ndarray, np.ndarray]:
        """(image (rows, columns) uint8, mask (rows, columns) bool of the imaged field) of the image with this index."""
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

    @property
    def numbers(self) -> list[int]:
        """Numbers of the images in their file."""
        return self.tracked.numbers

    def outline(self, grid: ImageGrid) -> str:
        """What is compared, as a path of an SVG in mm of the probe frame."""
        from skimage.measure import approximate_polygon, find_contours

        _, mask = self.on_grid(0, grid)
        lines = find_contours(np.pad(mask, 1).astype(float), 0.5)
        (dx, dy), points = grid.pixel_spacing_mm, [approximate_polygon(line, 0.7) - 0.5 for line in lines]
        paths = (" ".join(f"{grid.left_mm + dx * x:.2f},{grid.top_mm + dy * y:.2f}" for y, x in line) for line in points)
        return " ".join(f"M {path} Z" for path in paths)

    def compared(self, place: int, simulated: np.ndarray, grid: ImageGrid) -> Similarity:
        """The paper's cost between a simulated image and the real image with this index."""
        real, mask = self.on_grid(place, grid)
        return similarity(simulated, real, grid.pixel_spacing_mm, mask=mask)


class LooseImages:
    """The images of a sequence whose place in the patient is not known; they can only be viewed.

    Parameters
    ----------
    images : (n, rows, columns) numbers.
    """

    def __init__(self, images: np.ndarray) -> None:
        self._images, self.numbers = images, list(range(len(images)))
        self._low, self._high = (0, 255) if images.dtype == np.uint8 else (float(images.min()), float(images.max()))

    def __len__(self) -> int:
        return len(self._images)

    def image(self, place: int) -> np.ndarray:
        """(rows, columns) uint8 of the image with this index."""
        return np.interp(self._images[place], (self._low, max(self._high, self._low + 1)), (0, 255)).astype(np.uint8)


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
        self._real: RealImages | LooseImages | None = None
        self._browser: Any = None  # vtkMRMLSequenceBrowserNode
        self._playing: asyncio.Task | None = None
        self._waiting: tuple[RealImages, int, np.ndarray, ImageGrid] | None = None  # to be compared
        self._comparing: asyncio.Task | None = None
        self._era = 0  # changes when a similarity of before must not be shown any more
        #: For display next to the simulated image, and over it; and the best image of a fit that runs
        self.streams = (ImageStream("real"), ImageStream("real-over"), ImageStream("best"))
        self._best = (inf, 0.0)  # its cost, and when it was sent

    @property
    def is_comparing(self) -> bool:
        """Whether the similarity of the latest images is still to be shown."""
        return self._comparing is not None

    def take(self, tracked: TrackedImages, browser_node: Any, number: int = 0) -> None:
        """Use these images for comparison from now on, and show that with the index `number`."""
        self._use(RealImages(tracked), browser_node, number)

    def view(self, images: np.ndarray, number: int = 0) -> None:
        """Show images (n, rows, columns) whose place is not known, beside the simulated ones, from index `number` on."""
        self._use(LooseImages(images), None, number)

    def _use(self, real: RealImages | LooseImages, browser_node: Any, number: int) -> None:
        self._real, self._browser = real, browser_node
        if isinstance(real, LooseImages):
            self.sees_nothing(None)
        with self._shared.changing() as now:
            sequence, numbers = now.sequence, real.numbers
            sequence.length, sequence.is_placed, sequence.mask = len(real), isinstance(real, RealImages), ""
            sequence.numbers = f"{numbers[0]} to {numbers[-1]}"
            if not sequence.is_placed:
                sequence.comparison = ComparisonMode.BESIDE
        self.show(number)

    def show(self, number: int) -> None:
        """Show the real image with this index, and move the probe to its pose, if that is known."""
        real = self._real
        if real is None:
            return
        number = int(np.clip(number, 0, len(real) - 1))
        with self._shared.changing() as now:
            now.sequence.number, now.sequence.name = number, f"image {real.numbers[number]}"
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
        if isinstance(real, LooseImages):
            image = real.image(sequence.number)
            rows, columns = image.shape  # of a size that is not known: a ruler of its own, without marks
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

    def follow(self, step: Progress | None) -> None:
        """Show the best image of a fit, at most twice a second; called in its thread, and with None at its end."""
        if step is None:
            self._tell(lambda: self._show_best(None, ""))
        elif step.image is not None and step.best_cost != self._best[0] and perf_counter() > self._best[1] + _BEST_EVERY_S:
            self._best, image = (step.best_cost, perf_counter()), step.image()
            words = f"Best after {step.evaluations} evaluations: image {step.number}, cost {step.best_cost:.3f}"
            self._tell(lambda: self._show_best(image, words))

    def _show_best(self, image: np.ndarray | None, words: str) -> None:
        real, grid = self._real, self._grid
        if image is None:
            self._best = (inf, 0.0)
            self.streams[2].clear()
        elif isinstance(real, RealImages) and grid is not None and image.shape == real.tracked.mask.shape:
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
        """Forget the sequence, which is of another patient."""
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
