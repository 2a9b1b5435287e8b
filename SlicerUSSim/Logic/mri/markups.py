"""Points of markups that 3D Slicer wrote (.mrk.json)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.files import read_json
from SlicerUSSim.Logic.base.transforms import LPS_TO_RAS


def is_markup_name(path: str | os.PathLike) -> bool:
    """Whether a file is one of points by its ending."""
    return Path(path).suffix.lower() == ".json"


def markup_points(path: str, kinds: Sequence[str], such_as: str) -> tuple[str, np.ndarray]:
    """(kind, (points, 3) RAS mm) of the markup in a file, one of `kinds` ("Fiducial", "ClosedCurve", ...).

    Points that were not placed are left out. `such_as` is an example of what is expected, for errors. Raises
    SimulationError for another file, and for several markups, another kind, frame or unit.
    """
    values = read_json(path)
    try:
        markup, *others = values["markups"]
        placed = [point for point in markup["controlPoints"] if point.get("positionStatus", "defined") == "defined"]
        points = np.array([point["position"] for point in placed], float).reshape(-1, 3)
    except (KeyError, IndexError, TypeError, ValueError):
        require(False, f"{path}: has no points, expected a markup of 3D Slicer (.mrk.json), such as {such_as}")
        raise
    require(not others, f"{path}: has {len(others) + 1} markups, expected one")
    kind, frame, unit = (
        markup.get(*entry) for entry in (("type", ""), ("coordinateSystem", "LPS"), ("coordinateUnits", "mm"))
    )
    require(kind in kinds, f"{path}: is a markup of type {kind!r}, expected one of {', '.join(kinds)}")
    require(frame in ("LPS", "RAS"), f"{path}: coordinateSystem is {frame!r}, expected LPS or RAS")
    require(unit == "mm", f"{path}: coordinateUnits is {unit!r}, expected mm")
    return kind, points if frame == "RAS" else points @ LPS_TO_RAS[:3, :3]
