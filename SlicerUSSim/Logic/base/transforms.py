"""Checks and comparison of 4x4 matrices, and LPS_TO_RAS for reading and writing ITK's files."""

from __future__ import annotations

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require

#: (4, 4) for homogeneous points in millimetres: from LPS, the convention of ITK, to RAS; its own inverse.
LPS_TO_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])
#: Farthest from the origin that a coordinate may be, millimetres, where single precision still has .01
MOST_MM = 1e5


def check_affine(name: str, matrix, expected: str = "a 4x4 affine matrix") -> np.ndarray:
    """`matrix` as a new (4, 4) float64 array.

    Raises SimulationError unless it is affine, of finite numbers, and moves by at most MOST_MM.
    """
    try:
        array = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError):
        raise SimulationError(f"{name} is not a matrix of numbers, expected {expected}") from None
    require(array.shape == (4, 4), f"{name} has shape {array.shape}, expected (4, 4)")
    require(bool(np.isfinite(array).all()), f"{name} has a value that is not finite, expected {expected}")
    require(
        np.allclose(array[3], [0, 0, 0, 1], atol=1e-6), f"{name} has last row {array[3].tolist()}, expected 0 0 0 1"
    )
    farthest = float(np.abs(array[:3, 3]).max())
    require(farthest <= MOST_MM, f"{name} moves by {farthest:.3g} mm, expected at most {MOST_MM:g} mm along every axis")
    return array


def check_rigid(name: str, matrix) -> np.ndarray:
    """`matrix` as a (4, 4) float64 array. Raises SimulationError unless it is a rotation and a translation."""
    pose = check_affine(name, matrix, "a 4x4 rigid transform")
    rotation = pose[:3, :3]
    off = np.abs(rotation.T @ rotation - np.eye(3)).max()
    require(off < 1e-3, f"{name} is not rigid: its axes are off by {off:.3g} (expected unit length, perpendicular)")
    require(np.linalg.det(rotation) > 0, f"{name} mirrors (determinant -1), expected a right-handed rotation")
    return pose


def is_singular(matrix: np.ndarray) -> bool:
    """Whether the axes of a (4, 4) affine matrix lie in a plane, independent of their lengths."""
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    return bool((lengths == 0).any()) or abs(np.linalg.det(matrix[:3, :3] / np.where(lengths > 0, lengths, 1))) <= 1e-6


def nearest_rotation(axes: np.ndarray) -> np.ndarray:
    """(3, 3) the orthogonal matrix nearest to `axes`, to remove rounding errors of files."""
    u, _, vt = np.linalg.svd(axes)
    return u @ vt


def pose_of_angles(position_mm, angles_deg) -> np.ndarray:
    """(4, 4) rigid map that turns about the axes R, A and S of the world, in this order, and then moves.

    Parameters
    ----------
    position_mm : (3,) R, A, S to which the origin is moved.
    angles_deg : (3,) right-handed, about R, A and S.

    >>> from SlicerUSSim.Logic.base.transforms import pose_of_angles
    >>> pose_of_angles([10.0, 0.0, 5.0], [90.0, 0.0, 0.0]).round(3).tolist()[2]
    [0.0, 1.0, 0.0, 5.0]
    """
    pose = np.eye(4)
    for axis, angle in enumerate(np.radians(np.asarray(angles_deg, float))):
        one, other = (axis + 1) % 3, (axis + 2) % 3
        turn = np.eye(3)
        turn[one, one] = turn[other, other] = np.cos(angle)
        turn[other, one], turn[one, other] = np.sin(angle), -np.sin(angle)
        pose[:3, :3] = turn @ pose[:3, :3]
    pose[:3, 3] = position_mm
    return pose


def angles_of_pose(pose: np.ndarray) -> np.ndarray:
    """(3,) degrees, the angles of pose_of_angles, of a (4, 4) rigid map; about A from -90 to 90.

    Where A is turned by 90 degrees either way, R and S turn about the same axis, and R is 0.
    """
    rotation = np.asarray(pose)[:3, :3]
    about_a = np.arcsin(np.clip(-rotation[2, 0], -1.0, 1.0))
    if np.hypot(rotation[2, 1], rotation[2, 2]) < 1e-6:
        about_r, about_s = 0.0, np.arctan2(-rotation[0, 1], rotation[1, 1])
    else:
        about_r = np.arctan2(rotation[2, 1], rotation[2, 2])
        about_s = np.arctan2(rotation[1, 0], rotation[0, 0])
    return np.degrees([about_r, about_a, about_s])


def rigid_between(points: np.ndarray, onto: np.ndarray) -> tuple[np.ndarray, float]:
    """((4, 4) rigid map with the least squared distances of points (n, 3) to others, remaining RMS distance in mm).

    Arun et al., IEEE PAMI 9(5) 1987. Raises SimulationError for fewer than three points or different numbers of them.

    >>> import numpy as np
    >>> from SlicerUSSim.Logic.base import rigid_between
    >>> landmarks = np.array([[0.0, 0, 0], [50, 0, 0], [0, 40, 0], [0, 0, 30]])
    >>> matrix, left_mm = rigid_between(landmarks, landmarks + [5.0, 4.0, -2.0])
    >>> matrix[:3, 3].round(3).tolist(), round(left_mm, 3)
    ([5.0, 4.0, -2.0], 0.0)
    """
    points, onto = np.asarray(points, float), np.asarray(onto, float)
    require(
        points.shape == onto.shape and points.ndim == 2 and points.shape[1] == 3 and len(points) >= 3,
        f"landmarks have shapes {points.shape} and {onto.shape}, expected three or more pairs of 3D points",
    )
    middle, goal = points.mean(axis=0), onto.mean(axis=0)
    u, _, vt = np.linalg.svd((points - middle).T @ (onto - goal))
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))])
    matrix = np.eye(4)
    matrix[:3, :3] = vt.T @ mirror @ u.T
    matrix[:3, 3] = goal - matrix[:3, :3] @ middle
    left = points @ matrix[:3, :3].T + matrix[:3, 3] - onto
    return matrix, float(np.sqrt((left**2).sum(axis=1).mean()))
