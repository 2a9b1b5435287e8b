"""VirtualDevice: an ultrasound device that clients see over OpenIGTLink, without a window."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, collected_warnings
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.device.imaging_parameters import fixed_grid
from SlicerUSSim.Logic.device.plus_commands import PlusCommands
from SlicerUSSim.Logic.device.recorder import Recorder
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.tracked.openigtlink import Address, TrackerLink

_log = logging.getLogger(__name__)

#: Name of the IMAGE messages: in Plus' words the image with its place in the frame called Reference
IMAGE_NAME = "Image_Reference"
#: Most images per second, as of a scanner; seconds between poses of a path, and between looks for a client
_MOST_HZ, _STEP_S, _LOOK_EVERY_S = 50.0, 0.05, 0.05


class VirtualDevice:
    """Makes images while a client is connected, or one is recorded, until stop().

    Parameters
    ----------
    simulator, preset : its probe and display.
    poses : (4, 4) probe_to_ras; more than one are a path, which goes to and fro until a client sends a pose.
    address : where it listens.
    folder : of recordings.
    transform : name of the TRANSFORM to follow; None: the first that comes.

    The frame Reference is that of the patient, RAS in mm. Raises SimulationError for an address in use.
    """

    def __init__(
        self, simulator: UltrasoundSimulator, preset: Preset, poses: Sequence[np.ndarray], address: Address,
        folder: Path, transform: str | None = None,
    ) -> None:  # fmt: skip
        self._simulator, self._preset, self._poses = simulator, preset, poses
        size = preset.display.image_size
        self._grid = fixed_grid(preset, ImageGrid.for_probe(preset.probe, size))
        self._moved: np.ndarray | None = None  # by a client
        self._begun = time.monotonic()
        self._stopping = threading.Event()
        self._said: set[str] = set()
        self.recorder = Recorder(folder)
        commands = PlusCommands(lambda: (self._preset, self._grid), self.change, self.transforms, self.recorder)
        self.link = TrackerLink(
            address.host, address.port, self._move, device=transform, listen=True, image_name=IMAGE_NAME,
            answering=commands.session,
        )  # fmt: skip
        #: Images made, and the seconds that the last one took
        self.made, self.seconds = 0, 0.0

    @property
    def pose(self) -> np.ndarray:
        """(4, 4) probe_to_ras of now."""
        if self._moved is not None:
            return self._moved
        there_and_back = [*self._poses, *self._poses[-2:0:-1]]
        return there_and_back[int((time.monotonic() - self._begun) / _STEP_S) % len(there_and_back)]

    def transforms(self) -> Mapping[str, np.ndarray]:
        """{"ProbeToReference": (4, 4), "ImageToProbe": (4, 4)} of now."""
        return {"ProbeToReference": self.pose, "ImageToProbe": self._grid.image_to_probe}

    def change(self, preset: Preset) -> None:
        """Use another probe or display from the next image on. Raises SimulationError if that would be too slow."""
        self._simulator.warn_if_slow(preset.probe)
        self._preset, self._grid = preset, fixed_grid(preset, self._grid)

    def run(self) -> None:
        """Make images until stop() is called."""
        while not self._stopping.is_set():
            if not self.link.clients and not self.recorder.is_recording:
                self._stopping.wait(_LOOK_EVERY_S)
                continue
            begun = time.monotonic()
            self.make_image()
            self.seconds = time.monotonic() - begun
            self._stopping.wait(max(1.0 / _MOST_HZ - self.seconds, 0.0))

    def make_image(self) -> None:
        """Simulate one image, send it and record it. Its time is that at which the pose was read."""
        preset, grid, pose, stamp = self._preset, self._grid, self.pose, time.time()
        with collected_warnings() as caught:
            frame = self._simulator.simulate(preset.probe, pose, preset.display, grid, noise_seed=self.made % 2**31)
        for text in {str(warning) for warning in caught} - self._said:
            self._said.add(text)
            _log.warning("%s", text)
        self.made += 1
        transforms = {"ImageToProbe": grid.image_to_probe, "ProbeToReference": pose}
        self.link.send(Volume(frame.image[None], pose @ grid.slice_to_probe), transforms, stamp=stamp)
        try:
            self.recorder.add(frame.image, stamp, transforms)
        except (SimulationError, OSError) as error:
            self.recorder.pause(True)
            _log.warning("the recording is suspended: %s", error)

    def stop(self) -> None:
        """End run(), close the connections, and write a recording that was not stopped."""
        self._stopping.set()
        self.link.stop()
        if self.recorder.count:
            _log.warning("a recording was not stopped: written to %s (%d images)", *self.recorder.stop())

    def _move(self, pose: np.ndarray) -> None:
        self._moved = pose
