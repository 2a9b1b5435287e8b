"""Probe poses in files: JSON, plain text, and ITK transforms as 3D Slicer saves them."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.errors import SimulationError, require
from SlicerUSSim.Logic.tissues import read_json, write_json
from SlicerUSSim.Logic.volume import LPS_TO_RAS, check_rigid

_ITK_SUFFIXES = (".tfm", ".h5", ".hdf5", ".mat")


def read_pose(path: str | os.PathLike) -> np.ndarray:
    """(4, 4) probe_to_ras from a file.

    JSON holds {"probe_to_ras": [[...], ...]} or the bare matrix; a text file sixteen numbers by rows. ITK files (.tfm,
    .h5, .mat, .txt) hold, as Slicer writes a linear transform, the map from world to probe in LPS.
    Raises SimulationError for anything else and for a matrix that is not rigid.
    """
    path = Path(path)
    require(path.is_file(), f"{path}: no such file")
    if path.suffix.lower() == ".json":
        values = read_json(path)
        if isinstance(values, dict):
            require("probe_to_ras" in values, f'{path}: has no "probe_to_ras", expected a 4x4 matrix under that name')
            values = values["probe_to_ras"]
        return check_rigid(f"{path}: probe_to_ras", values)
    if path.suffix.lower() in _ITK_SUFFIXES or _starts_like_itk(path):
        return _read_itk(path)
    try:
        numbers = np.array(path.read_text().replace(",", " ").split(), float)
    except (ValueError, UnicodeDecodeError):
        raise SimulationError(f"{path}: is not a pose, expected 16 numbers by rows, JSON or an ITK transform") from None
    require(numbers.size == 16, f"{path}: holds {numbers.size} numbers, expected 16 (a 4x4 matrix by rows)")
    return check_rigid(f"{path}: probe_to_ras", numbers.reshape(4, 4))


def write_pose(path: str | os.PathLike, probe_to_ras: np.ndarray) -> None:
    """Write a pose as JSON, whole or not at all."""
    write_json(path, {"probe_to_ras": np.asarray(probe_to_ras).tolist()})


def _starts_like_itk(path: Path) -> bool:
    with open(path, "rb") as file:
        return file.read(8) == b"#Insight"


def _read_itk(path: Path) -> np.ndarray:
    import SimpleITK as sitk

    try:
        transform = sitk.ReadTransform(str(path))
    except RuntimeError as error:
        raise SimulationError(
            f"{path}: cannot be read as a transform ({str(error).splitlines()[-1].strip()})"
        ) from None
    require(transform.IsLinear(), f"{path}: the transform is not linear, expected a rigid one")
    # A linear map is known from where it takes the origin and the axes.
    origin = np.array(transform.TransformPoint((0.0, 0.0, 0.0)))
    world_to_probe = np.eye(4)
    for axis, unit in enumerate(np.eye(3)):
        world_to_probe[:3, axis] = np.array(transform.TransformPoint(unit.tolist())) - origin
    world_to_probe[:3, 3] = origin
    require(
        abs(np.linalg.det(world_to_probe[:3, :3])) > 1e-9, f"{path}: the transform is singular, expected a rigid one"
    )
    return check_rigid(f"{path}: transform", LPS_TO_RAS @ np.linalg.inv(world_to_probe) @ LPS_TO_RAS)
