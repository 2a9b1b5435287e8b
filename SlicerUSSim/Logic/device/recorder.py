"""Recorder: what a device sent as a sequence metafile, as the VirtualCapture device of PlusServer records it."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from threading import RLock
from typing import IO

import numpy as np

from SlicerUSSim.Logic.base.errors import require, required
from SlicerUSSim.Logic.base.files import require_place
from SlicerUSSim.Logic.tracked.sequence import SIMULATED, TrackedSequence, require_sequence_name


class Recorder:
    """Records images into one folder. Pixels wait in a temporary file; an existing recording is never replaced.

    The numbers of images, and whether they are taken, follow PlusServer: suspending keeps what was recorded.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._lock = folder, RLock()
        #: Whether images are taken now, and how many were
        self.is_recording, self.count = False, 0
        self._path: Path | None = None
        self._pixels: IO[bytes] | None = None
        self._shape: tuple[int, ...] = ()
        self._compress = False
        self._poses: list[tuple[float, Mapping[str, np.ndarray]]] = []

    def start(self, name: str, *, compress: bool = False, paused: bool = False) -> None:
        """Begin a recording, or go on with one that was suspended, under this name.

        A path in the name is left out: clients are not asked who they are. Without a name it is the time.
        Raises SimulationError for a name of another format, and for a file that exists or cannot be written.
        """
        name = name.replace("\\", "/").rpartition("/")[2] or time.strftime("Recording_%Y%m%d_%H%M%S.igs.mha")
        path = self._folder / name
        require_sequence_name(path)
        require_place(path)
        require(not path.exists(), f"{path}: exists; give another name")
        with self._lock:
            self._path, self._compress, self.is_recording = path, compress, not paused

    def pause(self, is_paused: bool) -> None:
        """Take no images for a while, or take them again."""
        self.is_recording = not is_paused

    def add(self, image: np.ndarray, stamp: float, transforms: Mapping[str, np.ndarray]) -> None:
        """An image (rows, columns) uint8, which is kept if it records. Raises SimulationError for another size."""
        with self._lock:
            if not self.is_recording:
                return
            if self._pixels is None:
                self._pixels = tempfile.TemporaryFile()  # noqa: SIM115, which stop() closes
                self._shape = image.shape
            require(image.shape == self._shape, f"the image has the size {image.shape}, expected {self._shape}")
            self._pixels.write(image.tobytes())
            self._poses.append((stamp, dict(transforms)))
            self.count += 1

    def stop(self, name: str = "") -> tuple[Path, int]:
        """(the file that was written, number of its images); a `name` replaces that of start().

        Raises SimulationError if nothing was recorded, and if the file cannot be written: nothing is lost then.
        """
        with self._lock:
            require(self.count > 0, "nothing was recorded")
            self.is_recording = False
            if name:
                self.start(name, compress=self._compress, paused=True)
            path, pixels = required(self._path, "no recording was begun"), required(self._pixels, "no pixels")
            pixels.flush()
            images = np.memmap(pixels, np.uint8, "r", shape=(self.count, *self._shape))
            stamps = np.array([stamp for stamp, _ in self._poses])
            transforms = tuple(entry for _, entry in self._poses)
            TrackedSequence(images, transforms, stamps, fields={SIMULATED: "device"}).write(path, self._compress)
            count, self.count, self._pixels = self.count, 0, None
            self._poses.clear()
            pixels.close()
            return path, count
