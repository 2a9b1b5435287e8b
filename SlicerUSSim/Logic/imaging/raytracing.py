"""Host code of kernels/raytracing.cl, sheet_hits.cl and face_hits.cl: the ray tree of every scan line."""

from __future__ import annotations

from functools import lru_cache
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np

from SlicerUSSim.Logic.imaging.signals import RayTree, TreeBuffers
from SlicerUSSim.Logic.imaging.stage import DeviceFrame, Stage
from SlicerUSSim.Logic.opencl.device import Device, Workspace
from SlicerUSSim.Logic.opencl.layout import CONSTANTS, HIT, SEGMENT

if TYPE_CHECKING:
    from pyopencl import Buffer


class RayTracer(Stage):
    """Traces all lines through a medium; the tree stays on the device for the stages that follow."""

    name = "ray tree"

    def __init__(self, device: Device) -> None:
        super().__init__(device)
        self.kernel = device.kernels("raytracing.cl")["trace"]
        self._strips = device.kernels("strips.cl")["strips"]
        self._sheet_hits = device.kernels("sheet_hits.cl")["sheet_hits"]
        self._face_hits = device.kernels("face_hits.cl")["face_hits"]
        self._losses = device.kernels("downshift.cl", device.lanes)["losses"]
        self.workspace = Workspace(device)
        self._quantile_key: tuple | None = None
        self._root_key: tuple | None = None
        self._overflown = device.zeros(4)
        # What these keys stand for
        self._quantiles: Buffer
        self._roots: Buffer
        #: (traced lines, elevational rays) of the last traced frame, its record and its tree
        self.shape: tuple[int, int]
        self._acquisition: np.ndarray
        self._tree: TreeBuffers

    def run(self, frame: DeviceFrame) -> None:
        """Enqueue the tracing of one frame: its `roots` and `tree`, and the `losses` along its scan lines."""
        acquisition, medium = frame.acquisition, frame.medium
        traced, rays = int(acquisition["traced_lines"]), int(acquisition["elevational_rays"])
        self.shape, self._acquisition = (traced, rays), acquisition
        get = self.workspace.get
        tree = frame.tree = self._tree = TreeBuffers(
            segments=get("segments", traced * CONSTANTS["MAX_SEGMENTS"] * SEGMENT.itemsize),
            segment_counts=get("segment_counts", traced * 4),
            hits=get("hits", traced * rays * CONSTANTS["MAX_HITS"] * HIT.itemsize),
            hit_counts=get("hit_counts", traced * rays * 4),
            cut=get("cut", traced * (rays + 1) * 4),
        )
        if self._quantile_key != (traced, rays):
            self._quantiles = self.device.upload(beam_quantiles(traced, rays))
            self._quantile_key = (traced, rays)
        array = tuple(acquisition[name].item() for name in _ARRAY_FIELDS)
        if self._root_key != array:
            self._roots = self.device.upload(line_roots(acquisition))
            self._root_key = array
        frame.roots = self._roots
        self.device.run(
            self.kernel,
            (traced, rays + 1),
            frame.acquisition_buffer,
            medium.voxel_buffer,
            medium.group_buffer,
            medium.smooth_buffer,
            medium.tissue_buffer,
            self._roots,
            self._quantiles,
            frame.beams,
            tree.segments,
            tree.segment_counts,
            tree.hits,
            tree.hit_counts,
            tree.cut,
            self._overflown,
            heavy=True,
        )
        self.device.run(self._strips, (traced,), frame.acquisition_buffer, tree.segments, tree.segment_counts, few=True)
        if medium.found is not None and medium.found.reflects:
            self.device.run(
                self._sheet_hits, (traced, rays), frame.acquisition_buffer, medium.sheet_buffer, self._quantiles,
                tree.segments, tree.segment_counts, tree.hits, tree.hit_counts, heavy=True,
            )  # fmt: skip
        if frame.reflects and acquisition["face_reflection"] and acquisition["max_ray_depth"]:
            self.device.run(
                self._face_hits, (traced, rays), frame.acquisition_buffer, self._quantiles, tree.segments,
                tree.segment_counts, tree.hits, tree.hit_counts, heavy=True,
            )  # fmt: skip
        lines, samples = frame.line_shape
        frame.losses = get("losses", lines * (samples // CONSTANTS["LOSS_STEP"] + 1) * 12)
        self.device.run(
            self._losses,
            (lines,),
            frame.acquisition_buffer,
            tree.segments,
            tree.segment_counts,
            frame.losses,
            few=True,
        )

    def download(self) -> RayTree:
        """The tree of the last traced frame."""
        (traced, rays), tree, download = self.shape, self._tree, self.device.download
        segments = download(tree.segments, (traced, CONSTANTS["MAX_SEGMENTS"]), SEGMENT)
        kept = np.arange(CONSTANTS["MAX_SEGMENTS"]) < download(tree.segment_counts, traced, np.int32)[:, None]
        hits = download(tree.hits, (traced, rays, CONSTANTS["MAX_HITS"]), HIT)
        hit_kept = np.arange(CONSTANTS["MAX_HITS"]) < download(tree.hit_counts, (traced, rays), np.int32)[..., None]
        where = np.nonzero(hit_kept)
        return RayTree(
            segments=segments[kept],
            segment_line=self._place(np.nonzero(kept)[0]),
            hits=hits[hit_kept],
            hit_line=self._place(where[0]),
            hit_ray=where[1],
            cut_weight=download(tree.cut, (traced, rays + 1), np.float32),
        )

    def _place(self, line: np.ndarray) -> np.ndarray:
        """Positions of traced lines among the scan lines."""
        return (line - float(self._acquisition["guard_lines"])) / float(self._acquisition["lateral_rays"])

    def overflown_lines(self) -> int:
        """Number of traced lines since the last call with more segments than the buffer can hold."""
        lines = int(self.device.download(self._overflown, 1, np.int32)[0])
        if lines:
            self.device.write(self._overflown, np.zeros(1, np.int32))
        return lines


#: Fields that determine the traced lines in the probe frame
_ARRAY_FIELDS = (
    "linear", "apex_radius_mm", "first_line", "line_spacing", "lateral_rays", "guard_lines", "traced_lines",
    "flat_face", "steering_sin",
)  # fmt: skip


def line_roots(acquisition: np.ndarray) -> np.ndarray:
    """(traced lines, 4) float32: origin (x, y) and direction (x, y) of every traced line in the probe frame.

    They include the guard lines beyond the edges of the array, which are not lines of the probe.
    """
    line = np.arange(int(acquisition["traced_lines"])) - int(acquisition["guard_lines"])
    position = float(acquisition["first_line"]) + float(acquisition["line_spacing"]) * line / int(
        acquisition["lateral_rays"]
    )
    roots = np.zeros((len(position), 4), np.float32)
    if acquisition["linear"]:
        sine, cosine = float(acquisition["steering_sin"]), float(acquisition["steering_cos"])
        roots[:, 0], roots[:, 2], roots[:, 3] = position / cosine, sine, cosine
    else:
        radius, sine, cosine = float(acquisition["apex_radius_mm"]), np.sin(position), np.cos(position)
        roots[:] = np.stack([radius * sine, radius * (cosine - 1.0), sine, cosine], axis=1)
        if acquisition["flat_face"]:
            roots[:, 0], roots[:, 1] = radius * sine / cosine, 0.0
    return roots


@lru_cache(maxsize=16)
def beam_quantiles(traced: int, rays: int) -> np.ndarray:
    """(traced, rays) float32 offsets in elevational sigmas: stratified quantiles of the beam profile.

    Equal weights then reproduce the profile. Each line shifts the quantiles by a golden-ratio sequence, so that a
    bent interface that is oblique in elevation appears as a band and not as `rays` separate lines.
    """
    shift = np.mod(0.5 + np.arange(traced) * 0.6180339887498949, 1.0)
    share = (np.arange(rays)[None, :] + 0.15 + 0.7 * shift[:, None]) / rays
    return np.vectorize(NormalDist().inv_cdf)(share).astype(np.float32)


@lru_cache(maxsize=16)
def ray_centres(rays: int) -> np.ndarray:
    """(rays,) float32 offsets in elevational sigmas at which the sum over the rays of a line is taken on flat walls.

    The quantiles of beam_quantiles without their shifts, of variance 1: a quadrature of equal weights that is exact up
    to the third power of the offset. Sums over the quantiles of a line are not: they differ from line to line by -25 dB
    of the echo of a perpendicular wall, as much as is left of an oblique one.
    """
    at = np.vectorize(NormalDist().inv_cdf)((np.arange(rays) + 0.5) / rays)
    return (at / max(np.sqrt((at * at).mean()), 1e-6)).astype(np.float32)
