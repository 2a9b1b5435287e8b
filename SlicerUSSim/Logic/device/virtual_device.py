"""VirtualDevice: an ultrasound device that clients see over OpenIGTLink, without a window."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.device.plus_commands import PlusCommands
from SlicerUSSim.Logic.device.recorder import Recorder
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.tracked.openigtlink import Address, TrackerLink

_log = logging.getLogger(__name__)

#: Seconds between poses of a path, and between looks for a client
_STEP_S, _LOOK_EVERY_S = 0.05, 0.05


class VirtualDevice:
    """Makes images while a client is connected, or one is recorded, until stop().

    Parameters
    ----------
    simulator, preset : its probe and display.
    poses : (4, 4) probe_to_ras; more than one are a path, which goes to and fro until a client sends a pose.
    address : where it listens.
    folder : of recordings.

    The frame Reference is the patient's RAS in mm. Raises SimulationError for an address in use.
    """

    def __init__(
        self, simulator: UltrasoundSimulator, preset: Preset, poses: Sequence[np.ndarray], address: Address,
        folder: Path,
    ) -> None:  # fmt: skip
        grid = ImageGrid.for_probe(preset.probe, preset.display.image_size)
        #: Probe and display of now; rows and columns stay at another depth
        self.preset = preset.changed("display", image_size=(grid.rows, grid.columns))
        self._simulator = simulator
        self._path, self._begun = [*poses, *poses[-2:0:-1]], time.monotonic()  # there and back
        self._stopping = threading.Event()
        self.recorder = Recorder(folder)
        commands = PlusCommands(lambda: self.preset, self.change, self.transforms, self.recorder)
        host, port, _ = address
        image = "Image_Reference"  # in Plus' words, with its place in the frame called Reference
        self.link = TrackerLink(host, port, self._move, listen=True, image_name=image, answer=commands.answer)

    @property
    def pose(self) -> np.ndarray:
        """(4, 4) probe_to_ras of now."""
        return self._path[int((time.monotonic() - self._begun) / _STEP_S) % len(self._path)]

    def transforms(self) -> Mapping[str, np.ndarray]:
        """{"ImageToProbe": (4, 4), "ProbeToReference": (4, 4)} of now."""
        grid = ImageGrid.for_probe(self.preset.probe, self.preset.display.image_size)
        return {"ImageToProbe": grid.image_to_probe, "ProbeToReference": self.pose}

    def change(self, preset: Preset) -> None:
        """Use another probe or display from the next image on. Raises SimulationError if that would be too slow."""
        self._simulator.warn_if_slow(preset.probe)
        self.preset = preset

    def run(self) -> None:
        """Make images until stop() is called."""
        number = 0
        while not self._stopping.is_set():
            if self.link.peers or self.recorder.is_recording:
                self._make_image(number)
                number += 1
            else:
                self._stopping.wait(_LOOK_EVERY_S)

    def _make_image(self, number: int) -> None:
        """Simulate one image, send it and record it. Its time is that at which the pose was read."""
        preset, pose, stamp = self.preset, self.pose, time.time()
        frame = self._simulator.simulate(preset.probe, pose, preset.display, noise_seed=number)
        transforms = {"ImageToProbe": frame.grid.image_to_probe, "ProbeToReference": pose}
        self.link.send(Volume(frame.image[None], pose @ frame.grid.slice_to_probe), transforms, stamp)
        self.recorder.add(frame.image, stamp, transforms)

    def stop(self) -> None:
        """End run(), close the connections, and write a recording that was not stopped."""
        self._stopping.set()
        self.link.stop()
        if (written := self.recorder.stop())[1]:
            _log.warning("a recording was not stopped: written to %s (%d images)", *written)

    def _move(self, pose: np.ndarray) -> None:
        self._path = [pose]
