"""Frame: one simulated image with its geometry and signals."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.probe.image_grid import ImageGrid

#: Largest of the numbers of Echoes, well within float16
_LARGEST = 2.0**15


@dataclass(frozen=True, eq=False)
class Frame:
    """One simulated image with its geometry and the signals from which it was computed."""

    #: (scan_lines, samples) complex64 baseband (I/Q) signal before ring-down, noise and TGC
    iq: np.ndarray = field(repr=False)
    #: (scan_lines, samples) float32 after noise and TGC
    envelope: np.ndarray = field(repr=False)
    #: (scan_lines, samples) uint8 grey levels along the scan lines
    bmode: np.ndarray = field(repr=False)
    #: (rows, columns) uint8 scan-converted image; outside the field 0
    image: np.ndarray = field(repr=False)
    #: Depth between samples
    sample_interval_mm: float
    #: Carrier cycles per millimetre of depth
    cycles_per_mm: float
    grid: ImageGrid
    #: (4, 4)
    probe_to_ras: np.ndarray
    #: Milliseconds per stage; empty unless the simulator profiles
    timings_ms: dict[str, float] = field(default_factory=dict, repr=False)

    @cached_property
    def rf(self) -> np.ndarray:
        """(scan_lines, samples) complex64 analytic RF signal; its real part is the sampled echo signal."""
        depth = np.arange(self.iq.shape[1]) * self.sample_interval_mm
        return self.iq * np.exp(2j * np.pi * self.cycles_per_mm * depth).astype(np.complex64)

    @property
    def pixel_spacing_mm(self) -> tuple[float, float]:
        """(column, row) spacing of the image."""
        return self.grid.pixel_spacing_mm

    @property
    def image_to_probe(self) -> np.ndarray:
        """(4, 4) from (column, row, 0, 1) to the probe frame in millimetres."""
        return self.grid.image_to_probe

    def to_volume(self) -> Volume:
        """The image as a Volume of one slice in patient space; the slice thickness is the pixel height."""
        return Volume(self.image[None], self.probe_to_ras @ self.grid.slice_to_probe)

    def to_vtk(self):
        """The image as a vtkImageData of one slice in patient space (RAS)."""
        return self.to_volume().to_vtk()


@dataclass(frozen=True, eq=False)
class Echoes:
    """The baseband signal of a frame in half of its memory, from which it can be displayed again."""

    #: (scan_lines, samples, 2) float16 real and imaginary part: exact within 0.005 dB at all levels, since attenuation,
    #: which TGC compensates, can be 100 dB
    parts: np.ndarray = field(repr=False)
    #: Value of 1 in `parts`
    unit: float
    #: (4, 4)
    probe_to_ras: np.ndarray

    @classmethod
    def of(cls, frame: Frame) -> Echoes:
        """Those of a frame."""
        parts = frame.iq.view(np.float32).reshape(*frame.iq.shape, 2)
        unit = float(np.abs(parts).max(initial=0.0)) / _LARGEST or 1.0
        return cls((parts * np.float32(1.0 / unit)).astype(np.float16), unit, frame.probe_to_ras)

    def iq(self, samples: int) -> np.ndarray:
        """(scan_lines, samples) complex64; behind the image the last sample is repeated."""
        behind = samples - self.parts.shape[1]
        signal = np.pad(self.parts, ((0, 0), (0, behind), (0, 0)), "edge").astype(np.float32)
        return (signal * np.float32(self.unit)).view(np.complex64)[..., 0]
