"""Compounding: the images of a sweep, wherever they lie, become one volume in patient space."""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.errors import require, require_between
from SlicerUSSim.Logic.frame import Frame
from SlicerUSSim.Logic.probe import Probe
from SlicerUSSim.Logic.volume import Volume, check_rigid

_MOST_VOXELS = 400_000_000
_WIDEST_GAP_MM = 10.0  # farther apart, neighbouring images are two sweeps rather than one with a hole


def sweep_grid(probe: Probe, poses: Iterable[np.ndarray], spacing_mm: float = 0.5) -> Volume:
    """An empty uint8 volume along the patient's axes (RAS) that holds the field of `probe` at all `poses` (4, 4).

    Raises SimulationError without poses, for one that is not rigid, and for more voxels than a computer likes.
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
    """Collects images in a volume: every voxel near an image plane takes its grey level there.

    A voxel counts with a weight that falls linearly to zero at one voxel from the plane, so that neighbouring images
    blend into each other; where images overlap, it is their weighted mean. An image's own thickness, the elevational
    beam, is in its grey levels already.

    Parameters
    ----------
    grid : the volume to fill; its array is not looked at.
    probe : which took the images.
    """

    def __init__(self, grid: Volume, probe: Probe) -> None:
        self.grid = grid
        self.probe = probe
        self._sum = np.zeros(grid.array.shape, np.float32)
        self._weight = np.zeros(grid.array.shape, np.float32)
        self._field: np.ndarray | None = None  # 1 where a pixel lies in the imaged field, and its mean over a voxel
        self._field_share: np.ndarray | None = None
        self._poses: list[np.ndarray] = []

    def add(self, frame: Frame) -> None:
        """Put one image into the volume."""
        image = self._averaged(frame)
        voxel_to_image = np.linalg.inv(frame.probe_to_ras @ frame.image_to_probe) @ self.grid.ijk_to_ras
        self._poses.append(frame.probe_to_ras)
        # The plane is taken column by column of voxels along the axis that it crosses most steeply.
        across = voxel_to_image[2, :3]
        axis = int(np.argmax(np.abs(across)))
        others = [a for a in range(3) if a != axis]
        size = np.array(self.grid.array.shape[::-1])
        low, high = self._reach(frame, size)
        index = np.empty((3, high[others[0]] - low[others[0]], high[others[1]] - low[others[1]]))
        index[others[0]] = np.arange(low[others[0]], high[others[0]])[:, None]
        index[others[1]] = np.arange(low[others[1]], high[others[1]])[None, :]
        index[axis] = 0.0
        distance = np.tensordot(across, index, 1) + voxel_to_image[2, 3]  # millimetres from the plane, at index 0
        reach = float(np.abs(self.grid.ijk_to_ras[:3, :3].T @ frame.probe_to_ras[:3, 2]).max())  # one voxel
        first = np.ceil((-distance - np.sign(across[axis]) * reach) / across[axis])
        for step in range(int(np.ceil(2.0 * reach / abs(across[axis]))) + 1):
            index[axis] = first + step
            column, row, off = (np.tensordot(voxel_to_image[r, :3], index, 1) + voxel_to_image[r, 3] for r in range(3))
            weight = 1.0 - np.abs(off) / reach
            near = (weight > 0) & (index[axis] >= 0) & (index[axis] < size[axis])
            places = np.stack([row[near], column[near]])
            inside = ndimage.map_coordinates(self._field, places, order=0, mode="constant", cval=0) > 0
            grey = ndimage.map_coordinates(image, places[:, inside], order=1, mode="nearest")
            at = tuple(index[a][near][inside].astype(int) for a in (2, 1, 0))
            weight = weight[near][inside].astype(np.float32)
            self._sum[at] += weight * grey  # a voxel occurs once per image and step, so += is enough
            self._weight[at] += weight

    def volume(self, hole_mm: float | None = None) -> Volume:
        """The compounded uint8 volume; voxels that no image came near are 0, but for holes.

        `hole_mm` is how wide a gap between images is filled, smoothly from its borders; default: the widest gap between
        neighbouring images of the sweep, 10 mm at most. 0 fills none. Raises SimulationError for a negative one.
        """
        if hole_mm is None:
            hole_mm = min(self._widest_gap_mm(), _WIDEST_GAP_MM)
        require_between("Compounder.volume", "hole_mm", hole_mm, 0, 1000)
        known = self._weight > 0
        values = np.divide(self._sum, self._weight, out=np.zeros_like(self._sum), where=known)
        if hole_mm > 0 and known.any():
            values = _filled(values, known, hole_mm / self.grid.spacing_mm[::-1])
        return self.grid.with_array(np.clip(np.rint(values), 0, 255).astype(np.uint8))

    def _averaged(self, frame: Frame) -> np.ndarray:
        """The image averaged over what a voxel covers, within the field: single pixels would alias speckle."""
        size = [max(round(float(self.grid.spacing_mm.min()) / s), 1) for s in frame.pixel_spacing_mm[::-1]]
        if self._field is None or self._field.shape != frame.image.shape:
            rows, columns = frame.image.shape
            pixels = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
            places = pixels @ frame.image_to_probe[:2, :2].T + frame.image_to_probe[:2, 3]
            self._field = self.probe.holds(places[..., 0], places[..., 1]).astype(np.float32)
            self._field_share = ndimage.uniform_filter(self._field, size, mode="constant")
        image = ndimage.uniform_filter(frame.image * self._field, size, mode="constant")
        return np.divide(image, self._field_share, out=np.zeros_like(image), where=self._field_share > 1e-3)

    def _reach(self, frame: Frame, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First and one past the last voxel of the box around the imaged field, within the grid."""
        index = _outline(self.probe, self.grid.ras_to_ijk @ frame.probe_to_ras)
        low = np.clip(np.floor(index.min(axis=0)).astype(int) - 1, 0, size)
        return low, np.maximum(np.clip(np.ceil(index.max(axis=0)).astype(int) + 2, 0, size), low)

    def _widest_gap_mm(self) -> float:
        """How far any point of the field moves between neighbouring images at most."""
        places = [_outline(self.probe, pose) for pose in self._poses]
        return max((float(np.linalg.norm(b - a, axis=1).max()) for a, b in itertools.pairwise(places)), default=0.0)


def _outline(probe: Probe, matrix: np.ndarray) -> np.ndarray:
    """(points, 3) outline of the imaged field, taken from the probe frame by a (4, 4) matrix."""
    return probe.outline_mm() @ matrix[:3, :3].T + matrix[:3, 3]


def _filled(values: np.ndarray, known: np.ndarray, hole_voxels: np.ndarray) -> np.ndarray:
    """`values` with gaps up to `hole_voxels` (k, j, i) wide filled by normalised convolution from their borders.

    What is a gap is found by closing the known region with an ellipsoid of that size; beyond its outline stays empty.
    """
    pad = [int(np.ceil(h / 2)) + 1 for h in hole_voxels]
    sampling = tuple(2.0 / np.maximum(hole_voxels, 1e-3))  # distances in half holes
    around = np.pad(known, [(p, p) for p in pad])
    around = ndimage.distance_transform_edt(~around, sampling) <= 1.0
    around = ndimage.distance_transform_edt(around, sampling) > 1.0
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
