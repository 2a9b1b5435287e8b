"""Host side of kernels/scattering.cl, interfaces.cl and beam.cl: echoes as baseband impulses along every line."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from SlicerUSSim.Logic.imaging.medium import Medium
from SlicerUSSim.Logic.imaging.raytracing import RayTracer
from SlicerUSSim.Logic.opencl.device import Device, Workspace
from SlicerUSSim.Logic.opencl.layout import CONSTANTS

if TYPE_CHECKING:
    from pyopencl import Buffer


class EchoLines:
    """Complex baseband impulses per line, planar: re, im float32 [line][stride], zeros on either side."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self.workspace = Workspace(device)
        self._shape: tuple[int, int] | None = None
        # Of the frame that there is room for: see prepare
        self.re: Buffer
        self.im: Buffer
        #: Samples from one line to the next, pads included
        self.stride: int

    def prepare(self, lines: int, samples: int) -> None:
        """Make room for a frame. Kernels write every sample between the pads, so only a new shape is cleared."""
        # An odd number of cache lines: the same sample of many lines then does not fall into the same few sets.
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


class Scatterers:
    """Adds speckle: every scatterer beside every ray segment."""

    def __init__(self, device: Device) -> None:
        self.device = device

    def run(
        self,
        acquisition_buffer: Buffer,
        acquisition: np.ndarray,
        medium: Medium,
        tree: RayTracer,
        lines: EchoLines,
        varied: tuple[Buffer, ...] = (),
    ) -> None:
        """Enqueue the speckle of one frame; it overwrites `lines`.

        With `varied`, the device buffers of roles (MAX_TISSUES,) int32 and band tops (BANDS,) float32, it comes in
        CONSTANTS["PARTS"] parts one after the other: see kernels/scattering.cl and appearance.py.
        """
        variant = (["TEXTURE"] if medium.has_texture else []) + (["VARIED"] if varied else [])
        variant.append(f"CHUNK={self.device.chunk}")
        self.device.run(
            self.device.kernels("scattering.cl", self.device.lanes, *variant)["scatter"],
            (int(acquisition["samples"]) // self.device.chunk, int(acquisition["traced_lines"])),
            acquisition_buffer,
            medium.voxel_buffer,
            medium.texture_buffer,
            medium.tissue_buffer,
            tree.segments,
            tree.segment_counts,
            lines.re,
            lines.im,
            np.int32(lines.stride),
            *varied,
            heavy=True,
        )


class InterfaceEchoes:
    """Adds the echoes of the interfaces that the elevational rays hit."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self.kernel = device.kernels("interfaces.cl")["interface_echoes"]

    def run(self, acquisition_buffer: Buffer, acquisition: np.ndarray, tree: RayTracer, lines: EchoLines) -> None:
        """Enqueue the interface echoes of one frame; they are added to `lines`."""
        self.device.run(
            self.kernel,
            (int(acquisition["traced_lines"]),),
            acquisition_buffer,
            tree.hits,
            tree.hit_counts,
            lines.re,
            lines.im,
            np.int32(lines.stride),
        )


class LateralBeam:
    """Spreads the impulses of the traced lines over the scan lines, as the lateral beam profile says."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self.kernel = device.kernels("beam.cl", device.lanes)["lateral_beam"]

    def run(self, acquisition_buffer: Buffer, acquisition: np.ndarray, traced: EchoLines, scanned: EchoLines) -> None:
        """Enqueue the lateral convolution of one frame; it overwrites `scanned`."""
        self.device.run(
            self.kernel,
            (int(acquisition["samples"]) // self.device.lanes, int(acquisition["scan_lines"])),
            acquisition_buffer,
            traced.re,
            traced.im,
            scanned.re,
            scanned.im,
            np.int32(traced.stride),
        )
