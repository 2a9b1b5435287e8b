"""Compounding of the images of a sweep, at any poses, into one volume in patient space."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import require, require_between
from SlicerUSSim.Logic.base.transforms import check_rigid
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.imaging.frame import Frame
from SlicerUSSim.Logic.opencl.device import Device, DeviceChoice
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid

if TYPE_CHECKING:
    from pyopencl import Buffer

_log = logging.getLogger(__name__)

_MOST_VOXELS = 400_000_000
_WIDEST_GAP_MM = 10.0  # neighbouring images at a larger distance belong to different sweeps


def sweep_grid(probe: Probe, poses: Iterable[np.ndarray], spacing_mm: float = 0.5) -> Volume:
    """An empty uint8 volume along the patient's axes (RAS) that contains the field of `probe` at all `poses` (4, 4).

    Raises SimulationError without poses, for a pose that is not rigid, and for too many voxels.
    """
    require_between("sweep_grid", "spacing_mm", spacing_mm, 0.02, 20)
    points = [_outline(probe, check_rigid("pose", pose)) for pose in poses]
    require(bool(points), "the sweep has no pose, expected at least one")
    low = np.min([p.min(axis=0) for p in points], axis=0) - spacing_mm
    high = np.max([p.max(axis=0) for p in points], axis=0) + spacing_mm
    counts = np.ceil((high - low) / spacing_mm).astype(int) + 1
    require(
        float(np.prod(counts.astype(float))) <= _MOST_VOXELS,
        f"a volume of {'x'.join(map(str, counts))} voxels is too large; raise spacing_mm ({spacing_mm:g})",
    )
    matrix = np.diag([spacing_mm] * 3 + [1.0])
    matrix[:3, 3] = low
    return Volume(np.zeros(counts[::-1], np.uint8), matrix)


class Compounder:
    """Collects images in a volume: voxels near an image plane get its grey levels.

    The weight of an image decreases linearly to zero at one voxel from its plane, and a voxel is the weighted mean of
    all images, so that neighbouring images blend. The slice thickness, due to the elevational beam, is already in the
    grey levels.

    Parameters
    ----------
    grid : the grid of the volume; its array is not used.
    probe : the probe of the images.
    device : see opencl.devices.choose_device.
    """

    def __init__(self, grid: Volume, probe: Probe, device: DeviceChoice = None) -> None:
        self.grid = grid
        self.probe = probe
        self.device = Device.get(device)
        kernels = self.device.kernels("compounding.cl")
        self._mean_in_field, self._add_image = kernels["mean_in_field"], kernels["add_image"]
        self._size = np.array(grid.array.shape[::-1])
        self._sum, self._weight = (self.device.zeros(4 * grid.array.size) for _ in range(2))
        self._to_image = self.device.empty(12 * 4)
        self._pixels: ImageGrid | None = None
        # For images with these pixels: uint8 mask of the field, and memory for means
        self._field: Buffer
        self._mean: Buffer
        self._poses: list[np.ndarray] = []

    def add(self, frame: Frame) -> None:
        """Add one image to the volume."""
        self.add_buffer(self.device.upload(frame.image), frame.grid, frame.probe_to_ras)

    def add_buffer(self, image: Buffer, pixels: ImageGrid, probe_to_ras: np.ndarray) -> None:
        """The same for an image on the device (UltrasoundSimulator.render)."""
        self._prepare(pixels)
        shape = pixels.columns, pixels.rows
        window = [max(round(float(self.grid.spacing_mm.min()) / s), 1) for s in pixels.pixel_spacing_mm]
        self.device.run(self._mean_in_field, shape, image, self._field, _int2(window), self._mean)
        voxel_to_image = np.linalg.inv(probe_to_ras @ pixels.image_to_probe) @ self.grid.ijk_to_ras
        self._poses.append(probe_to_ras)
        across = voxel_to_image[2, :3]
        axis = int(np.argmax(np.abs(across)))
        others = [a for a in range(3) if a != axis]
        low, high = self._reach(probe_to_ras)
        if (high <= low)[others].any():
            return
        self.device.write(self._to_image, np.ascontiguousarray(voxel_to_image[:3], np.float32))
        self.device.run(
            self._add_image,
            tuple(int(n) for n in (high - low)[others]),
            self._mean,
            self._field,
            _int2(shape),
            self._to_image,
            _int4([*others, axis]),
            _int4(low),
            _int4(self._size),
            np.float32(np.abs(self.grid.ijk_to_ras[:3, :3].T @ probe_to_ras[:3, 2]).max()),  # one voxel
            self._sum,
            self._weight,
        )

    def volume(self, hole_mm: float | None = None) -> Volume:
        """The compounded uint8 volume; voxels without an image nearby are 0, except in filled holes.

        Gaps between images are filled smoothly from their borders up to a width of `hole_mm`; default: the widest gap
        between neighbouring images of the sweep, at most 10 mm; 0: none. Raises SimulationError for a negative value.
        """
        if hole_mm is None:
            hole_mm = min(self._widest_gap_mm(), _WIDEST_GAP_MM)
            _log.info("holes up to %.1f mm are filled, the widest gap of the sweep or %g mm", hole_mm, _WIDEST_GAP_MM)
        require_between("Compounder.volume", "hole_mm", hole_mm, 0, 1000)
        total, weight = (
            self.device.download(buffer, self.grid.array.shape, np.float32) for buffer in (self._sum, self._weight)
        )
        known = weight > 0
        values = np.divide(total, weight, out=np.zeros_like(total), where=known)
        if hole_mm > 0 and known.any():
            values = _filled(values, known, hole_mm / self.grid.spacing_mm[::-1])
        return self.grid.with_array(np.clip(np.rint(values), 0, 255).astype(np.uint8))

    def _prepare(self, pixels: ImageGrid) -> None:
        """The imaged field of images with these pixels, and memory for their means."""
        if pixels != self._pixels:
            self._field = self.device.upload(pixels.field(self.probe).astype(np.uint8))
            self._mean = self.device.empty(4 * pixels.rows * pixels.columns)
            self._pixels = pixels

    def _reach(self, probe_to_ras: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First and one past the last voxel of the bounding box of the imaged field, within the grid."""
        index = _outline(self.probe, self.grid.ras_to_ijk @ probe_to_ras)
        low = np.clip(np.floor(index.min(axis=0)).astype(int) - 1, 0, self._size)
        return low, np.maximum(np.clip(np.ceil(index.max(axis=0)).astype(int) + 2, 0, self._size), low)

    def _widest_gap_mm(self) -> float:
        """Largest displacement of a point of the field between neighbouring images."""
        places = [_outline(self.probe, pose) for pose in self._poses]
        return max((float(np.linalg.norm(b - a, axis=1).max()) for a, b in itertools.pairwise(places)), default=0.0)


def _int2(values) -> np.ndarray:
    """An OpenCL int2."""
    return np.array(values, np.int32)


def _int4(values) -> np.ndarray:
    """An OpenCL int4 of three values."""
    return np.array([*values, 0], np.int32)


def _outline(probe: Probe, matrix: np.ndarray) -> np.ndarray:
    """(points, 3) outline of the imaged field, transformed from the probe frame by a (4, 4) matrix."""
    return probe.outline_mm() @ matrix[:3, :3].T + matrix[:3, 3]


def _filled(values: np.ndarray, known: np.ndarray, hole_voxels: np.ndarray) -> np.ndarray:
    """`values` with gaps up to `hole_voxels` (k, j, i) wide filled by normalised convolution from their borders.

    Gaps are found by closing the known region with an ellipsoid of this size; the outside stays empty.
    """
    pad = [int(np.ceil(h / 2)) + 1 for h in hole_voxels]
    sampling = 2.0 / np.maximum(hole_voxels, 1e-3)  # distances in units of half a hole
    around = np.pad(known, [(p, p) for p in pad])
    around = _distance_to(around, sampling) <= 1.0 + 1e-4
    around = _distance_to(~around, sampling) > 1.0 + 1e-4
    inner = tuple(slice(p, -p) for p in pad)
    missing = around[inner] & ~known
    result = values.copy()
    sigma = 0.75
    while missing.any() and sigma <= 2.0 * hole_voxels.max():
        weight = ndimage.gaussian_filter(known.astype(np.float32), sigma, mode="constant", truncate=3.0)
        smooth = ndimage.gaussian_filter(values, sigma, mode="constant", truncate=3.0)
        reached = missing & (weight > 0.02)
        result[reached] = smooth[reached] / weight[reached]
        missing &= ~reached
        sigma *= 2.0
    return result


def _distance_to(places: np.ndarray, sampling: np.ndarray) -> np.ndarray:
    """Distance of every voxel (k, j, i) to the nearest of `places`; the voxel spacing is `sampling`."""
    import SimpleITK as sitk  # on all cores: four times as fast as scipy's

    image = sitk.GetImageFromArray(places.astype(np.uint8))
    image.SetSpacing(tuple(float(step) for step in sampling[::-1]))
    signed = sitk.SignedMaurerDistanceMap(image, squaredDistance=False, useImageSpacing=True)
    return np.maximum(sitk.GetArrayViewFromImage(signed), 0.0)
