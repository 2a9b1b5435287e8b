"""Stage, and the frame under computation on which stages work.

A new *display* stage, which changes grey levels or pixels but not echoes, is one class and one line: a Stage with
`run`, and its place in stages.DISPLAY_STAGES. Simulator, appearance model and benchmark use this list. Its
user settings are fields of DisplaySettings, read from `frame.display`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from SlicerUSSim.Logic.base.settings import DisplaySettings, SimulationSettings
from SlicerUSSim.Logic.imaging.medium import Medium
from SlicerUSSim.Logic.imaging.signals import EchoLines, TreeBuffers
from SlicerUSSim.Logic.opencl.device import Device
from SlicerUSSim.Logic.opencl.layout import DISPLAY
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid

if TYPE_CHECKING:
    from pyopencl import Buffer

#: Bytes of a complex float32 sample
SAMPLE_BYTES = 8


@dataclass(eq=False)
class DeviceFrame:
    """A frame under computation on the device: its inputs, and the signals passed between stages.

    A stage replaces signals by its own buffers and does not change those that it reads, since frames of which only the
    display has changed start again from `iq`.
    """

    probe: Probe
    settings: SimulationSettings
    #: layout.ACQUISITION record
    acquisition: np.ndarray
    #: Standard deviation of the pulse in depth, with the scanner's speed of sound
    axial_sigma_mm: float
    display: DisplaySettings
    grid: ImageGrid
    #: Seed of the amplifier noise (noise.py)
    noise_seed: int
    acquisition_buffer: Buffer
    medium: Medium
    #: (scan lines,) float32 factor of contact.line_contact; None where the patient lies in the coupling medium
    contact: np.ndarray | None = None
    #: Whether a border of its tissues may reflect rays
    reflects: bool = field(init=False)
    #: What soft tissue does to beams: float4 [screen line][depth] of aperture.cl
    screens: Buffer = field(init=False)
    #: The same of the traced lines, from the face on: float4 [traced line][1 + depth]
    beams: Buffer = field(init=False)
    #: How much wider that makes the beam, and a factor of its echoes: float2 [screen line][depth]
    spreads: Buffer = field(init=False)
    #: Where traced lines begin, and their directions: float4 [traced line] of raytracing.cl
    roots: Buffer = field(init=False)
    #: Of the ray tree
    tree: TreeBuffers = field(init=False)
    #: Of the direct path to the samples of scan lines: float [scan line][1 + samples / LOSS_STEP][3] of downshift.cl
    losses: Buffer = field(init=False)
    #: Impulses on the left and right edges of every traced line's strip
    traced: EchoLines = field(init=False)
    #: Impulses of every scan line
    scanned: EchoLines = field(init=False)
    #: Baseband signal: complex64 [scan line][sample]
    iq: Buffer = field(init=False)
    #: After noise and time-gain compensation: float32 [scan line][sample]
    envelope: Buffer = field(init=False)
    #: Grey levels along the scan lines: uint8 [scan line][sample]
    grey: Buffer = field(init=False)
    #: uint8 [row][column]
    image: Buffer = field(init=False)

    @property
    def line_shape(self) -> tuple[int, int]:
        """(scan lines, samples) of the signals along lines; samples are whole blocks."""
        return int(self.acquisition["scan_lines"]), int(self.acquisition["samples"])

    @property
    def display_record(self) -> np.ndarray:
        """() record of layout.DISPLAY: what `display` says, which kernels take by value."""
        return _record_of(self.display)

    def download(self, signal: str) -> np.ndarray:
        """A copy on the host of "iq", "envelope", "grey" (scan lines, samples) or "image" (rows, columns)."""
        return self.medium.device.download(*self._signal(signal))

    def on_demand(self, signal: str, samples: int) -> Any:
        """What gives (scan lines, samples) of it when called, and keeps its pooled buffer for that."""
        device, content = self.medium.device, self._signal(signal)
        return lambda: device.download(*content)[:, :samples]

    def start_download(self, signal: str) -> Callable[[], np.ndarray]:
        """The same without waiting, see Device.start_download."""
        return self.medium.device.start_download(*self._signal(signal))

    def _signal(self, signal: str) -> tuple[Buffer, tuple[int, int], type[np.generic]]:
        shape = (self.grid.rows, self.grid.columns) if signal == "image" else self.line_shape
        return getattr(self, signal), shape, _SIGNAL_TYPES[signal]


@lru_cache(maxsize=16)
def _record_of(display: DisplaySettings) -> np.ndarray:
    record = np.zeros((), DISPLAY)
    for name in DISPLAY.names or ():
        value = getattr(display, name)
        record[name] = np.nan if value is None else value
    return record


_SIGNAL_TYPES = {"iq": np.complex64, "envelope": np.float32, "grey": np.uint8, "image": np.uint8}


class Stage(ABC):
    """One step from a pose to an image. A stage is created once per device and keeps its buffers between frames."""

    #: Key of its time in Frame.timings_ms
    name: ClassVar[str]

    def __init__(self, device: Device) -> None:
        self.device = device

    @abstractmethod
    def run(self, frame: DeviceFrame) -> None:
        """Enqueue the stage without waiting."""
