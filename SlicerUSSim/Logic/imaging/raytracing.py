"""Host side of kernels/raytracing.cl: the ray tree of every scan line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np

from SlicerUSSim.Logic.imaging.medium import Medium
from SlicerUSSim.Logic.opencl.device import Device, Workspace
from SlicerUSSim.Logic.opencl.layout import CONSTANTS, HIT, SEGMENT

if TYPE_CHECKING:
    from pyopencl import Buffer


@dataclass(frozen=True, eq=False)
class RayTree:
    """The tree of one frame, on the host.

    segments : structured array (layout.SEGMENT) of every straight piece along the beam axes; `segment_line` (same
        length) is its place among the scan lines: a fraction for a line traced between them, and outside
        0..scan_lines - 1 for one beyond the edge of the field.
    hits : structured array (layout.HIT) of every interface crossing of the elevational rays; `hit_line` is its place
        among the scan lines and `hit_ray` its elevational ray.
    cut_weight : (traced lines, 1 + elevational rays) weight of the branches that were not followed.
    """

    segments: np.ndarray
    segment_line: np.ndarray
    hits: np.ndarray
    hit_line: np.ndarray
    hit_ray: np.ndarray
    cut_weight: np.ndarray


class RayTracer:
    """Traces all lines through a medium; the tree stays on the device for the stages that follow."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self.kernel = device.kernels("raytracing.cl")["trace"]
        self.workspace = Workspace(device)
        self._quantile_key: tuple | None = None
        self._root_key: tuple | None = None
        self._overflown = device.zeros(4)
        # What these keys stand for
        self._quantiles: Buffer
        self._roots: Buffer
        #: (traced lines, elevational rays) of the frame traced last, and its tree: see layout.SEGMENT and layout.HIT
        self.shape: tuple[int, int]
        self.segments: Buffer
        self.segment_counts: Buffer
        self.hits: Buffer
        self.hit_counts: Buffer
        self.cut: Buffer
        self._place: Callable[[np.ndarray], np.ndarray]

    def run(self, acquisition_buffer: Buffer, acquisition: np.ndarray, medium: Medium) -> None:
        """Enqueue the tracing of one frame: a layout.ACQUISITION record, and the same on the device."""
        traced, rays = int(acquisition["traced_lines"]), int(acquisition["elevational_rays"])
        self.shape = traced, rays
        self._place = lambda line: (line - float(acquisition["guard_lines"])) / float(acquisition["lateral_rays"])
        get = self.workspace.get
        self.segments = get("segments", traced * CONSTANTS["MAX_SEGMENTS"] * SEGMENT.itemsize)
        self.segment_counts = get("segment_counts", traced * 4)
        self.hits = get("hits", traced * rays * CONSTANTS["MAX_HITS"] * HIT.itemsize)
        self.hit_counts = get("hit_counts", traced * rays * 4)
        self.cut = get("cut", traced * (rays + 1) * 4)
        if self._quantile_key != (traced, rays):
            self._quantiles = self.device.upload(beam_quantiles(traced, rays))
            self._quantile_key = (traced, rays)
        array = tuple(acquisition[name].item() for name in _ARRAY_FIELDS)
        if self._root_key != array:
            self._roots = self.device.upload(line_roots(acquisition))
            self._root_key = array
        self.device.run(
            self.kernel,
            (traced, rays + 1),
            acquisition_buffer,
            medium.voxel_buffer,
            medium.group_buffer,
            medium.smooth_buffer,
            medium.tissue_buffer,
            self._roots,
            self._quantiles,
            self.segments,
            self.segment_counts,
            self.hits,
            self.hit_counts,
            self.cut,
            self._overflown,
            heavy=True,
        )

    def download(self) -> RayTree:
        """The tree of the frame traced last."""
        traced, rays = self.shape
        segments = self.device.download(self.segments, (traced, CONSTANTS["MAX_SEGMENTS"]), SEGMENT)
        counts = self.device.download(self.segment_counts, traced, np.int32)
        kept = np.arange(CONSTANTS["MAX_SEGMENTS"]) < counts[:, None]
        hits = self.device.download(self.hits, (traced, rays, CONSTANTS["MAX_HITS"]), HIT)
        hit_counts = self.device.download(self.hit_counts, (traced, rays), np.int32)
        hit_kept = np.arange(CONSTANTS["MAX_HITS"]) < hit_counts[..., None]
        where = np.nonzero(hit_kept)
        return RayTree(
            segments=segments[kept],
            segment_line=self._place(np.nonzero(kept)[0]),
            hits=hits[hit_kept],
            hit_line=self._place(where[0]),
            hit_ray=where[1],
            cut_weight=self.device.download(self.cut, (traced, rays + 1), np.float32),
        )

    def overflown_lines(self) -> int:
        """How many traced lines since the last call had more segments than there is room for."""
        lines = int(self.device.download(self._overflown, 1, np.int32)[0])
        if lines:
            self.device.write(self._overflown, np.zeros(1, np.int32))
        return lines


#: What places the traced lines in the probe frame
_ARRAY_FIELDS = (
    "linear", "apex_radius_mm", "first_line", "line_spacing", "lateral_rays", "guard_lines", "traced_lines"
)  # fmt: skip


def line_roots(acquisition: np.ndarray) -> np.ndarray:
    """(traced lines, 4) float32: origin (x, y) and direction (x, y) of every traced line in the probe frame.

    The guard lines go on beyond the edges of the array, so they are not lines that the probe knows.
    """
    line = np.arange(int(acquisition["traced_lines"])) - int(acquisition["guard_lines"])
    position = float(acquisition["first_line"]) + float(acquisition["line_spacing"]) * line / int(
        acquisition["lateral_rays"]
    )
    roots = np.zeros((len(position), 4), np.float32)
    if acquisition["linear"]:
        roots[:, 0], roots[:, 3] = position, 1.0
    else:
        radius, sine, cosine = float(acquisition["apex_radius_mm"]), np.sin(position), np.cos(position)
        roots[:] = np.stack([radius * sine, radius * (cosine - 1.0), sine, cosine], axis=1)
    return roots


@lru_cache(maxsize=16)
def beam_quantiles(traced: int, rays: int) -> np.ndarray:
    """(traced, rays) float32 offsets in elevational sigmas: stratified quantiles of the beam profile.

    Equal weights then reproduce the profile. Each line shifts the strata by a golden-ratio sequence, so that an
    interface tilted in elevation does not show as `rays` separate lines but as the band its time differences make.
    """
    shift = np.mod(0.5 + np.arange(traced) * 0.6180339887498949, 1.0)
    share = (np.arange(rays)[None, :] + 0.05 + 0.9 * shift[:, None]) / rays
    return np.vectorize(NormalDist().inv_cdf)(share).astype(np.float32)
