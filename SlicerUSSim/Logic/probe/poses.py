"""Placement of a probe: poses from a target and a direction, sweeps, and the MRI resampled in the image plane."""

from __future__ import annotations

import logging

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid

#: Rows of an image that are sampled together, so that their arrays stay in a processor's cache
_ROWS_AT_ONCE = 32
_log = logging.getLogger(__name__)


def pose_looking_at(face_ras, target_ras, lateral_ras=(1.0, 0.0, 0.0)) -> np.ndarray:
    """(4, 4) probe_to_ras of a probe whose face centre is at `face_ras` and whose axis points to `target_ras` (mm).

    `lateral_ras` is the preferred direction of the image's left-to-right axis; its component along the probe axis is
    ignored. Raises SimulationError if the points coincide or `lateral_ras` is parallel to the axis.

    >>> from SlicerUSSim.Logic.probe import pose_looking_at
    >>> pose = pose_looking_at(face_ras=(0, 0, 70), target_ras=(0, 0, 0))
    >>> float(pose[2, 1])  # the axis of the probe, straight down
    -1.0
    """
    face, target, lateral = (np.asarray(v, dtype=float) for v in (face_ras, target_ras, lateral_ras))
    depth = target - face
    require(np.linalg.norm(depth) > 1e-6, f"probe face and target are both at {face.tolist()}, expected two points")
    y = depth / np.linalg.norm(depth)
    x = lateral - (lateral @ y) * y
    require(
        np.linalg.norm(x) > 1e-3, f"lateral direction {lateral.tolist()} is along the probe axis, expected across it"
    )
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, y, np.cross(x, y)], axis=1)
    pose[:3, 3] = face
    return pose


def surface_point(foreground: Volume, target_ras, outward_ras) -> np.ndarray:
    """(3,) last point of the foreground (non-zero voxels) on the line from `target_ras` along `outward_ras` (RAS, mm).

    Raises SimulationError if the line does not meet the foreground.
    """
    target, outward = np.asarray(target_ras, float), np.asarray(outward_ras, float)
    outward = outward / np.linalg.norm(outward)
    distance = np.arange(0.0, 500.0, 0.25)
    points = target + distance[:, None] * outward
    inside = sample(foreground, points, order=0) > 0
    require(inside.any(), f"no tissue from {target.tolist()} in direction {outward.round(3).tolist()}")
    return points[np.flatnonzero(inside)[-1]]


def craniotomy_pose(
    brain: Volume, probe: Probe, tilt_deg: float = 32.0, standoff_mm: float = 1.0, target_ras=None
) -> np.ndarray:
    """(4, 4) probe_to_ras of a coronal view through a parasagittal craniotomy, aimed below the centre of the brain.

    `brain` is a mask or label map (non-zero inside). The view crosses cortex, a lateral ventricle and the midline.
    With `target_ras` (mm) it is the coronal view of that point, through a craniotomy of its side.

    >>> from SlicerUSSim.Logic.mri import head_mri
    >>> from SlicerUSSim.Logic.probe import PROBES, craniotomy_pose
    >>> pose = craniotomy_pose(head_mri(spacing_mm=4.0), PROBES["phased"])
    >>> bool(pose[2, 3] > 50)  # the face is above the centre of the brain, mm
    True
    """
    centre = brain.ijk_to_ras[:3] @ np.append(_centre_of_mass(brain.array > 0)[::-1], 1.0)
    tilt = np.deg2rad(tilt_deg)
    outward = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    target = centre + [0.0, 0.0, 2.0]
    if target_ras is not None:
        target = np.asarray(target_ras, float)
        outward[0] *= 1.0 if target[0] >= centre[0] else -1.0
    face = surface_point(brain, target, outward) + standoff_mm * outward
    _log.info("probe placed by itself: coronal view from RAS %s, %.0f degrees from the midline", _point(face), tilt_deg)
    return pose_looking_at(face, target, lateral_ras=(1.0, 0.0, 0.0))


def _centre_of_mass(inside: np.ndarray) -> np.ndarray:
    """(k, j, i) of a bool array; a fifth of the time of scipy's."""
    require(inside.any(), "the brain mask is empty, expected voxels inside")
    column = inside.view(np.uint8).sum(axis=0, dtype=np.uint16).astype(int)
    counts = [np.count_nonzero(plane) for plane in inside], column.sum(axis=1), column.sum(axis=0)
    return np.array([np.average(np.arange(len(along)), weights=along) for along in counts])


def _point(ras: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.1f}" for value in ras) + ") mm"


def pose_in_slice(foreground: Volume, slice_to_ras: np.ndarray, target_ras=None) -> np.ndarray:
    """(4, 4) probe_to_ras of a probe on the surface whose image lies in a slice view, in the orientation of the view.

    `slice_to_ras` (4, 4) has the view's right, up and normal as its columns and its middle as its origin, as in slice
    nodes of Slicer. The probe is at the top of the view, and its axis points down through `target_ras` (default: the
    middle of the view), projected onto the slice.
    Raises SimulationError if no foreground (non-zero voxels) lies above or below the target in the view.
    """
    right, up, normal = (slice_to_ras[:3, n] / np.linalg.norm(slice_to_ras[:3, n]) for n in range(3))
    middle = slice_to_ras[:3, 3]
    target = middle if target_ras is None else np.asarray(target_ras, float)
    target = target - ((target - middle) @ normal) * normal
    # Start below the patient, so that a target in the coupling medium beneath it still finds the surface above.
    face = surface_point(foreground, target - 200.0 * up, up)
    return pose_looking_at(face, face - up, lateral_ras=right)


def turned(probe_to_ras: np.ndarray, *, rock_deg=0.0, tilt_deg=0.0, rotate_deg=0.0) -> np.ndarray:
    """(4, 4) probe_to_ras turned about the middle of the probe face, which does not move.

    Rocking is in the image plane (about z), tilting out of it (about the lateral axis x), rotating about the probe axis
    (y); signs as rotations about these axes. The terms are from the AIUM.

    >>> import numpy as np
    >>> from SlicerUSSim.Logic.probe import turned
    >>> round(float(turned(np.eye(4), tilt_deg=90)[2, 1]), 3)  # the axis points along +z
    1.0
    """
    from scipy.spatial.transform import Rotation  # not needed for an image

    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_euler("ZXY", [rock_deg, tilt_deg, rotate_deg], degrees=True).as_matrix()
    return probe_to_ras @ motion


def carried(probe_to_ras: np.ndarray, face_ras, outward_from, outward_to) -> np.ndarray:
    """(4, 4) probe_to_ras with its face at `face_ras` (mm), turned by the smallest rotation between two directions.

    If the directions are the outward normals of a surface at the old and the new position, the probe keeps its angles
    to the surface. If they are the reversed probe axis and the new normal, the probe is aligned with the normal.
    Raises SimulationError for a direction of zero length.
    """
    from scipy.spatial.transform import Rotation

    start, end = (np.asarray(v, float) for v in (outward_from, outward_to))
    require(
        min(np.linalg.norm(start), np.linalg.norm(end)) > 1e-9,
        f"directions are {start.tolist()} and {end.tolist()}, expected two of non-zero length",
    )
    start, end = start / np.linalg.norm(start), end / np.linalg.norm(end)
    axis = np.cross(start, end)
    angle = np.arctan2(np.linalg.norm(axis), start @ end)
    if np.linalg.norm(axis) < 1e-9:  # parallel or antiparallel: any perpendicular axis will do
        axis = np.cross(start, np.eye(3)[np.argmin(np.abs(start))])
    axis = axis / np.linalg.norm(axis)
    turn = Rotation.from_rotvec(angle * axis)
    pose = np.eye(4)
    pose[:3, :3] = turn.as_matrix() @ probe_to_ras[:3, :3]
    pose[:3, 3] = face_ras
    return pose


def aimed_at(probe_to_ras: np.ndarray, target_ras) -> np.ndarray:
    """(4, 4) probe_to_ras turned by the smallest rotation that points the probe axis at `target_ras` (mm).

    Raises SimulationError if the target is on the face.
    """
    face = probe_to_ras[:3, 3]
    return carried(probe_to_ras, face, probe_to_ras[:3, 1], np.asarray(target_ras, float) - face)


def angles_to_surface(probe_to_ras: np.ndarray, outward_ras) -> tuple[float, float]:
    """(rock, tilt) in degrees by which turned() takes a probe aligned with the surface normal to this orientation."""
    inward = probe_to_ras[:3, :3].T @ (-np.asarray(outward_ras, float))
    inward = inward / np.linalg.norm(inward)
    # (Rz(rock) Rx(tilt))^-1 takes y to (sin rock, cos rock cos tilt, -cos rock sin tilt).
    tilt = -np.arctan2(inward[2], inward[1])
    rock = np.arcsin(np.clip(inward[0], -1.0, 1.0))
    return float(np.rad2deg(rock)), float(np.rad2deg(tilt))


def slide_sweep(probe_to_ras: np.ndarray, length_mm: float, frames: int) -> list[np.ndarray]:
    """Poses (4, 4) of a probe that slides across its image plane, `length_mm` in total, centred at `probe_to_ras`.

    Raises SimulationError for a length that is not finite, and an invalid number of frames.
    """
    require(np.isfinite(length_mm), f"a sweep slides over {length_mm} mm, expected a finite number")
    return [probe_to_ras @ elevational_motion(offset_mm=share * length_mm) for share in _shares(frames)]


def tilt_sweep(probe_to_ras: np.ndarray, angle_deg: float, frames: int) -> list[np.ndarray]:
    """Poses (4, 4) of a probe that tilts about the lateral axis of its face, `angle_deg` in total, as in the scan of a
    matrix array or a mechanically swept array.

    >>> import numpy as np
    >>> from SlicerUSSim.Logic.probe import tilt_sweep
    >>> poses = tilt_sweep(np.eye(4), angle_deg=60, frames=7)
    >>> [round(float(np.rad2deg(np.arcsin(pose[2, 1])))) for pose in poses]
    [-30, -20, -10, 0, 10, 20, 30]

    Raises SimulationError for an angle that is not finite, and an invalid number of frames.
    """
    require(np.isfinite(angle_deg), f"a sweep tilts over {angle_deg} degrees, expected a finite number")
    return [probe_to_ras @ elevational_motion(angle_deg=share * angle_deg) for share in _shares(frames)]


def elevational_motion(offset_mm: float = 0.0, angle_deg: float = 0.0) -> np.ndarray:
    """(4, 4) motion in the probe frame: `offset_mm` along z, and `angle_deg` about x, which turns depth towards +z."""
    angle = np.deg2rad(angle_deg)
    motion = np.eye(4)
    motion[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    motion[2, 3] = offset_mm
    return motion


def _shares(frames: int) -> np.ndarray:
    """(frames,) from -1/2 to 1/2, or 0 for a single frame. Raises SimulationError for an invalid number of frames."""
    require(int(frames) == frames and frames >= 1, f"a sweep has {frames!r} frames, expected a whole number above 0")
    return np.linspace(-0.5, 0.5, int(frames)) if frames > 1 else np.zeros(1)


def sample(volume: Volume, points_ras: np.ndarray, order: int = 1) -> np.ndarray:
    """Values of `volume` at (..., 3) RAS points; order 0 is nearest neighbour, 1 is linear; 0 outside the volume."""
    points = np.asarray(points_ras, float)
    ijk = points @ volume.ras_to_ijk[:3, :3].T + volume.ras_to_ijk[:3, 3]
    return ndimage.map_coordinates(volume.array, np.moveaxis(ijk[..., ::-1], -1, 0), order=order, cval=0)


def slice_under_probe(volume: Volume, grid: ImageGrid, probe_to_ras: np.ndarray, order: int = 1) -> np.ndarray:
    """(rows, columns) values of `volume` at the pixels of a probe's image (frame.grid), as by sample()."""
    array, to_ijk = volume.array, volume.ras_to_ijk @ probe_to_ras @ grid.image_to_probe
    _, height, width = array.shape
    flat, last = array.reshape(-1), np.array(array.shape[::-1])[:, None, None] - 1
    corners = [step + behind for behind in (0, width * height) for step in (0, 1, width, width + 1)]
    across = to_ijk[:3, 0, None] * np.arange(grid.columns)
    found = np.empty((grid.rows, grid.columns), array.dtype)
    kind = array.dtype if array.dtype.kind == "f" else np.float32
    for first in range(0, grid.rows, _ROWS_AT_ONCE):
        rows = np.arange(first, min(first + _ROWS_AT_ONCE, grid.rows))
        place = (to_ijk[:3, 1, None] * rows + to_ijk[:3, 3, None])[..., None] + across[:, None]
        cell = (place if order else place + 0.5).astype(int)
        np.clip(cell, 0, np.maximum(last - order, 0), out=cell)
        at = (cell[2] * height + cell[1]) * width + cell[0]
        if order == 0:
            values = flat.take(at)
        else:
            values = [flat.take(at + corner, mode="clip").astype(kind) for corner in corners]
            for part in (place - cell).astype(kind):
                values = [low + part * (high - low) for low, high in zip(values[::2], values[1::2], strict=True)]
            values = values[0] if array.dtype.kind == "f" else np.floor(values[0] + 0.5)
        found[rows] = np.where(((place < 0) | (place > last)).any(axis=0), 0, values)
    return found
