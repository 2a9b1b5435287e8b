"""Recorder: what a device sent as a sequence metafile, as the VirtualCapture device of PlusServer records it."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from threading import Lock

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.tracked.sequence import SIMULATED, TrackedSequence, require_sequence_name


class Recorder:
    """Records images of one size into a folder. An existing recording is never replaced."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._adding, self._writing = folder, Lock(), Lock()
        self.is_recording = False
        self._path, self._shape = folder, (0, 0)
        self._forget()

    def _forget(self) -> None:
        self._pixels = tempfile.TemporaryFile()  # noqa: SIM115, since minutes of images do not fit into memory
        #: (seconds, transforms) of the images that wait to be written
        self.frames: list[tuple[float, Mapping[str, np.ndarray]]] = []

    def start(self, name: str) -> None:
        """Begin a recording; without a name it is called after the time.

        A path in the name is left out: clients are not asked who they are.
        Raises SimulationError for a name of another format, and for a file that exists.
        """
        name = name.replace("\\", "/").rpartition("/")[2] or time.strftime("Recording_%Y%m%d_%H%M%S.igs.mha")
        path = self._folder / name
        require_sequence_name(path)
        require(not path.exists(), f"{path}: exists; give another name")
        self._path, self.is_recording = path, True

    def add(self, image: np.ndarray, stamp: float, transforms: Mapping[str, np.ndarray]) -> None:
        """An image (rows, columns) uint8, which is kept if it records."""
        with self._adding:
            if self.is_recording:
                self._shape = image.shape
                self._pixels.write(image.tobytes())
                self.frames.append((stamp, transforms))

    def stop(self) -> tuple[Path, int]:
        """(the file that was written, number of its images); without images there is no file.

        Raises SimulationError if the file cannot be written: nothing is lost then.
        """
        with self._writing:
            with self._adding:  # not while it writes, so that the device continues
                self.is_recording = False
            if not self.frames:
                return self._path, 0
            self._pixels.flush()
            images = np.memmap(self._pixels, np.uint8, "r", shape=(len(self.frames), *self._shape))
            stamps, transforms = zip(*self.frames, strict=True)
            TrackedSequence(images, transforms, np.array(stamps), fields={SIMULATED: "device"}).write(self._path, False)
            self._forget()
            return self._path, len(images)
