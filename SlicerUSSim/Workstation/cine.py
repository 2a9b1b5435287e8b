"""Cine: the last seconds of live images, or those of Simulate sequence: shown again, played, trimmed, over time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates
from trame_server.utils.asynchronous import get_event_loop

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.settings import DisplaySettings
from SlicerUSSim.Logic.imaging.frame import Echoes
from SlicerUSSim.Logic.mrml.taken_image import TakenImage
from SlicerUSSim.Logic.mrml.taken_sequence import count_taken
from SlicerUSSim.Workstation.browser_panel import BrowserPanel
from SlicerUSSim.Workstation.comparison import Comparison
from SlicerUSSim.Workstation.streams import ImageStream
from SlicerUSSim.Workstation.tasks import AtMost

#: Seconds and bytes of live images that are kept: 10 s at 18 images per second of the default probe
KEPT_S, _MOST_BYTES = 10.0, 320 * 2**20
#: Seconds between two images of a sequence, and limits of those between live images while they are played
_EVERY_S, _SHORTEST_S, _LONGEST_S = 0.1, 0.04, 0.5
#: Least seconds between two messages to pages about a cine that grows, and columns of an M-mode image
_TELL_EVERY_S, _COLUMNS = 0.25, 480
#: Sources, and the message without images
LIVE, SEQUENCE = "live", "sequence"
_NONE = "the cine has no images, expected live images or those of Simulate sequence"


@dataclass(eq=False)
class CineImage:
    """One image of the cine."""

    #: With the display with which it was taken, without its frame
    taken: TakenImage
    #: When it was shown
    seconds: float
    #: With which it can have another display; None of an image of a sequence
    echoes: Echoes | None = None


class Cine:
    """Keeps live images, and shows them and those of the chosen sequence again. While it does there are no live ones.

    The methods for pages are called in a task. The place in the cine is CineState.

    Parameters
    ----------
    move : called with the pose (4, 4) of an image.
    """

    def __init__(self, panel: BrowserPanel, comparison: Comparison, move: Callable[[np.ndarray], None]) -> None:
        self._shared, self._logic, self._tasks = panel.shared, panel.logic, panel.tasks
        self._images, self._shown = panel.presenter.images, panel.presenter.shown
        self._comparison, self._move = comparison, move
        self._kept: deque[CineImage] = deque()
        self._round = 0  # of playing
        self._line: np.ndarray | None = None
        #: The grey levels along a line of the image over the time of the cine
        self.mmode = ImageStream("mmode")
        self._grown = AtMost(_TELL_EVERY_S, self._tell_grown)

    def add(self, taken: TakenImage) -> None:
        """Keep a new image with its echoes; one of another grid starts a new cine."""
        frame, kept, new = taken.frame, self._kept, CineImage(replace(taken, frame=None), perf_counter())
        if frame is None or (kept and kept[-1].taken.time == taken.time):  # it is here already
            return
        if kept and kept[-1].taken.grid != taken.grid:
            kept.clear()
        kept.append(new)
        done = get_event_loop().run_in_executor(None, lambda: setattr(new, "echoes", Echoes.of(frame)))
        # The display may have changed meanwhile
        done.add_done_callback(lambda _: self._logic.isLive or self._tasks.start(self.follow_display))
        size = taken.image.nbytes + next((one.echoes.parts.nbytes for one in kept if one.echoes), 0)
        while new.seconds - kept[0].seconds > KEPT_S or len(kept) * size > _MOST_BYTES:
            kept.popleft()
        self._set(index=len(kept) - 1)
        self._grown()

    def clear(self) -> None:
        """Forget all live images."""
        self._kept.clear()
        self.draw_mmode(None)
        self.tell()

    def tell(self) -> None:
        """Bring CineState up to date with live images, sequence and Live."""
        now, is_live = self._shared.now.cine, self._logic.isLive
        count = count_taken(self._logic.parameters.image_sequence)
        source = LIVE if is_live or not count else now.source
        length = len(self._kept) if source == LIVE else count
        last = max(length - 1, 0)
        if (source, length) != (now.source, now.length):
            self._set(first=0, last=last, index=last if source == LIVE else min(now.index, last))
        is_playing = now.playing and length > 0 and not is_live
        self._set(source=source, sequence_length=count, length=length, playing=is_playing)
        if source == LIVE and length:
            self._set(seconds=round(self._kept[now.index].seconds - self._kept[0].seconds, 2))

    # ---- requests of pages -------------------------------------------------------------------------------------

    def freeze(self) -> None:
        """End live images, or continue them."""
        self._images.setLive(not self._logic.isLive)

    def show(self, index: int) -> None:
        """Show the image with this index where it was taken, with the probe there, and the real image of that pose."""
        with self._shown():
            self._images.setLive(False)
            self._show(index)

    def step(self, by: int) -> None:
        """Show an image before or behind the one that is shown."""
        self._images.setLive(False)
        self.show(self._shared.now.cine.index + by)

    def choose(self, source: str) -> None:
        """Show the last live image, or the first one of the sequence."""
        self._images.setLive(False)
        self._set(source=source, index=0, length=0)
        self.tell()
        self.show(self._shared.now.cine.index)

    def trim(self, first: int, last: int) -> None:
        """Play and export only the images from `first` to `last`."""
        most = max(self._shared.now.cine.length - 1, 0)
        first, last = sorted(min(max(int(index), 0), most) for index in (first, last))
        self._set(first=first, last=last)

    def play(self) -> None:
        """Start playing the images in a loop, at the rate at which they were taken, or stop."""
        is_on = not self._shared.now.cine.playing
        self._round += 1
        self._comparison.stop()
        self._images.setLive(False)
        self._set(playing=is_on)
        self._play_next(self._round)

    def stop(self) -> None:
        """Play no more."""
        self._set(playing=False)

    def follow_display(self) -> None:
        """Show the frozen image with the display of now, if that has changed."""
        cine, taken = self._shared.now.cine, self._logic.taken
        if self._logic.isLive or taken is None or cine.source != LIVE or cine.index >= len(self._kept):
            return
        kept = self._kept[cine.index]
        if kept.taken.time == taken.time and kept.echoes is not None and taken.preset.display != self._display(kept):
            self._put(kept)

    def draw_mmode(self, ends: Sequence[float] | None) -> None:
        """Send the M-mode of a line (x0, y0, x1, y1) in mm of the probe frame; None: no more."""
        line = np.zeros((2, 2)) if ends is None else np.array(ends, float).reshape(2, 2)
        self._line = line if np.isfinite(line).all() and np.ptp(line, axis=0).any() else None
        if self._line is None:
            self.mmode.clear()
        self._send_mmode()

    # ---- exports -----------------------------------------------------------------------------------------------

    def displayed(self, progress: Callable[[float], None]) -> Iterator[tuple[float, TakenImage]]:
        """(seconds, image) of all between the trims, with the display of now.

        Raises SimulationError without an image.
        """
        cine = self._shared.now.cine
        require(cine.length > 0, _NONE)
        images = [self._at(index) for index in range(cine.first, cine.last + 1)]
        for number, kept in enumerate(images):
            progress(number / len(images))
            yield kept.seconds - images[0].seconds, self._displayed(kept)

    # ---- implementation ----------------------------------------------------------------------------------------

    def _at(self, index: int) -> CineImage:
        if self._shared.now.cine.source == LIVE:
            return self._kept[index]
        return CineImage(self._logic.sequenceImage(self._logic.parameters.image_sequence, index), index * _EVERY_S)

    def _show(self, index: int) -> None:
        self.tell()  # images may be gone since
        length = self._shared.now.cine.length
        require(length > 0, _NONE)
        index = min(max(int(index), 0), length - 1)
        kept = self._at(index)
        self._set(index=index, seconds=round(kept.seconds - self._at(0).seconds, 2))
        pose = kept.taken.probe_to_world
        if not self._comparison.show_at(pose):
            self._move(pose)
        self._put(kept)

    def _put(self, kept: CineImage) -> None:
        """Show an image, unless another one or live images are shown once it has its display."""
        cine = self._shared.now.cine
        place = cine.source, cine.index
        taken = self._displayed(kept)
        if not self._logic.isLive and (cine.source, cine.index) == place:
            self._logic.showTaken(taken, self._logic.parameters.output)

    def _display(self, kept: CineImage) -> DisplaySettings:
        """The current display, without the rest of earlier images."""
        return replace(self._logic.preset.display, persistence=kept.taken.preset.display.persistence)

    def _displayed(self, kept: CineImage) -> TakenImage:
        taken = kept.taken
        while kept.echoes is not None and taken.preset.display != (display := self._display(kept)):  # it may change
            is_own = display == kept.taken.preset.display
            taken = kept.taken if is_own else self._logic.redisplay(kept.taken, kept.echoes, display)
        return taken

    def _play_next(self, of_round: int) -> None:
        cine, loop = self._shared.now.cine, get_event_loop()
        begun = loop.time()
        if of_round != self._round or not cine.playing:
            return
        with self._shown():
            index = cine.index + 1 if cine.first <= cine.index < cine.last else cine.first
            self._show(index)
            wait = _LONGEST_S
            if index < cine.last:
                wait = min(max(self._at(index + 1).seconds - self._at(index).seconds, _SHORTEST_S), _LONGEST_S)
            later = max(begun + wait - loop.time(), 0.0)
            loop.call_later(later, self._tasks.start, lambda: self._play_next(of_round))
            return
        self.stop()

    def _tell_grown(self) -> None:
        self.tell()
        self._send_mmode()

    def _send_mmode(self) -> None:
        images = [self._at(index) for index in range(self._shared.now.cine.length)]
        if not images or self._line is None:
            return
        grid, times = images[0].taken.grid, np.array([kept.seconds for kept in images])
        length_mm = float(np.linalg.norm(self._line[1] - self._line[0]))
        along = np.linspace(self._line[0], self._line[1], max(round(length_mm / grid.pixel_spacing_mm[1]), 2))
        spots = (along - [grid.left_mm, grid.top_mm]) / grid.pixel_spacing_mm - 0.5
        last = np.searchsorted(times, np.linspace(times[0], times[-1], _COLUMNS), "right") - 1
        lines = {n: map_coordinates(images[n].taken.image, spots.T[::-1], order=1) for n in np.unique(last)}
        image = np.stack([lines[n] for n in last], axis=1)
        self.mmode.send(image, ruler={"w": float(times[-1] - times[0]), "h": length_mm})

    def _set(self, **values: Any) -> None:
        self._shared.put("cine", values)
