"""Data passed between stages: the ray tree and the impulses along every line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from SlicerUSSim.Logic.opencl.device import Device, Workspace
from SlicerUSSim.Logic.opencl.layout import CONSTANTS

if TYPE_CHECKING:
    from pyopencl import Buffer


@dataclass(frozen=True, eq=False)
class TreeBuffers:
    """The ray tree of one frame on the device: layout.SEGMENT and layout.HIT, with their counts.

    segments [traced line][MAX_SEGMENTS], segment_counts int32 [traced line], hits [traced line][ray][MAX_HITS],
    hit_counts int32 [traced line][ray], cut float32 [traced line][1 + elevational rays].
    """

    segments: Buffer
    segment_counts: Buffer
    hits: Buffer
    hit_counts: Buffer
    cut: Buffer


@dataclass(frozen=True, eq=False)
class RayTree:
    """The tree of one frame, on the host.

    segments : structured array (layout.SEGMENT) of all straight segments along the beam axes; `segment_line` (same
        length) is the position among the scan lines: fractional for lines between them, and outside
        0..scan_lines - 1 for lines beyond the edge of the field.
    hits : structured array (layout.HIT) of all interface crossings of the elevational rays; `hit_line` is the position
        among the scan lines and `hit_ray` the elevational ray.
    cut_weight : (traced lines, 1 + elevational rays) weight of the branches that were not followed.
    """

    segments: np.ndarray
    segment_line: np.ndarray
    hits: np.ndarray
    hit_line: np.ndarray
    hit_ray: np.ndarray
    cut_weight: np.ndarray


class EchoLines:
    """Complex baseband impulses per line, planar: re, im float32 [line][stride], zeros on either side."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self.workspace = Workspace(device)
        self._shape: tuple[int, int] | None = None
        # Size of the allocated frame, see prepare
        self.re: Buffer
        self.im: Buffer
        #: Samples from one line to the next, including pads
        self.stride: int

    def prepare(self, lines: int, samples: int) -> None:
        """Allocate a frame. Kernels write every sample between the pads, so only a new shape is cleared."""
        # An odd number of cache lines avoids that the same sample of many lines maps to the same cache sets.
        self.stride = (samples + 2 * CONSTANTS["LINE_PAD"]) // 16 * 16 + 16
        self.stride += self.stride % 32 == 0 and 16
        nbytes = lines * self.stride * 4
        self.re, self.im = self.workspace.get("re", nbytes), self.workspace.get("im", nbytes)
        if self._shape != (lines, samples):
            self.clear()
            self._shape = lines, samples

    def clear(self) -> None:
        """Set everything to zero."""
        self.device.clear(self.re)
        self.device.clear(self.im)
