"""Side lobes of the beam: host code of kernels/side_lobes.cl, and what scattering.cl needs for those in elevation.

The main lobe of a beam is a Gaussian. What an aperture of finite size has beside it is as in its diffraction pattern
(diffraction.py; docs/physics.md#side-lobes-and-ring-down).
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from SlicerUSSim.Logic.imaging.diffraction import lateral_weights
from SlicerUSSim.Logic.imaging.noise import stirred
from SlicerUSSim.Logic.imaging.stage import DeviceFrame, Stage
from SlicerUSSim.Logic.opencl.device import Device
from SlicerUSSim.Logic.probe.arrays import Probe

if TYPE_CHECKING:
    from pyopencl import Buffer

#: How many times larger, along each axis, cells of the lattice are for elevational lobes, which are as much wider
COARSER = 4.0
#: Elevational lobes are computed where tissue scatters less than this part of the typical power: elsewhere its own
#: echoes hide them
DARK = 0.25
#: Elevational lobes follow one path for all traced lines within this many sigmas of the beam
_TOGETHER_SIGMAS, _MOST_TOGETHER = 3.0, 9
_SEED = 0x51DE10BE


class SideLobes(Stage):
    """Adds the echoes that lateral side lobes receive of scatterers; those of walls cancel."""

    name = "side lobes"

    def __init__(self, device: Device) -> None:
        super().__init__(device)
        self.kernel = device.kernels("side_lobes.cl", device.lanes)["side_lobes"]
        self.tables = Tables(device)

    def run(self, frame: DeviceFrame) -> None:
        """Enqueue the side lobes of one frame, which are added to `scanned`, unless they are off."""
        if not frame.settings.side_lobes:
            return
        probe = frame.probe
        self.device.run(
            self.kernel,
            (frame.line_shape[1] // self.device.lanes,),
            frame.acquisition_buffer,
            self.tables.get(probe, lateral_weights(probe)),
            frame.roots,
            frame.scanned.re,
            frame.scanned.im,
            np.int32(frame.scanned.stride),
            np.float32(probe.wavelength_mm * probe.receive_f_number),
            np.float32(probe.wavelength_mm / probe.aperture_mm),
            heavy=True,
        )


class Tables:
    """The table of the last probe on a device."""

    def __init__(self, device: Device) -> None:
        self._device = device
        self._probe: Probe | None = None
        self._buffer: Buffer

    def get(self, probe: Probe, values: np.ndarray) -> Buffer:
        """A buffer with `values`, which are the same whenever `probe` is."""
        if probe != self._probe:
            self._buffer, self._probe = self._device.upload(values.astype(np.float32)), probe
        return self._buffer


def elevational_lobe_record(acquisition: np.ndarray) -> np.ndarray:
    """The record (layout.ACQUISITION) for what elevational side lobes receive: a COARSER lattice of its own."""
    record = acquisition.copy()
    record["cell_mm"] = COARSER * float(acquisition["cell_mm"])
    record["seed"] = stirred(int(acquisition["seed"]) ^ _SEED)
    record["speckle_scale"] = float(acquisition["speckle_scale"]) * COARSER**1.5
    return record


@lru_cache(maxsize=16)
def lines_together(lateral_rays: int, probe: Probe) -> int:
    """Traced lines whose elevational lobes follow the path of the one in the middle."""
    middle = 0.5 * probe.depth_mm
    apart = float(probe.line_distance_mm(middle)) / lateral_rays
    lines = _TOGETHER_SIGMAS * float(probe.beam_sigma_mm(middle)[0]) / apart
    return int(np.clip(round(lines), 1, _MOST_TOGETHER))
