"""Points of markups that 3D Slicer wrote: .mrk.json, and .fcsv of its versions before 5.0."""

from __future__ import annotations

import csv
import os
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.files import read_json, read_text
from SlicerUSSim.Logic.base.transforms import LPS_TO_RAS

_LIST = ".fcsv"
#: Frames as lists of points name them; 4.10 and before by number
_FRAMES = {"RAS": "RAS", "LPS": "LPS", "0": "RAS", "1": "LPS"}
_MOST_BYTES = 4 * 2**20


def is_markup_name(path: str | os.PathLike) -> bool:
    """Whether a file is one of points by its ending."""
    return Path(path).suffix.lower() in (".json", _LIST)


def markup_points(path: str, kinds: Sequence[str], such_as: str) -> tuple[str, np.ndarray]:
    """(kind, (points, 3) RAS mm) of the markup in a file, one of `kinds` ("Fiducial", "ClosedCurve", ...).

    Points that were not placed are left out. `such_as` is an example of what is expected, for errors. Raises
    SimulationError for another file, and for several markups, another kind, frame or unit.
    """
    if Path(path).suffix.lower() == _LIST:
        require("Fiducial" in kinds, f"{path}: is a list of points, expected one of {', '.join(kinds)}")
        return "Fiducial", _listed_points(path)
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


def _listed_points(path: str) -> np.ndarray:
    """(points, 3) RAS mm of a list: comments with the frame and the columns, then id, x, y, z, ... of each point."""
    expected = "expected a list of points of 3D Slicer (.fcsv)"
    try:
        text = read_text(path, _MOST_BYTES)
    except OSError as error:
        raise SimulationError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise SimulationError(f"{path}: is no text, {expected}") from None
    head = dict(re.findall(r"^#\s*(\w+)\s*=\s*(.*?)\s*$", text, re.MULTILINE))
    named = str(head.get("CoordinateSystem", ""))
    require(bool(named), f"{path}: names no CoordinateSystem, {expected}")
    require(named in _FRAMES, f"{path}: CoordinateSystem is {named!r}, expected one of {', '.join(_FRAMES)}")
    columns = head.get("columns", "id,x,y,z").split(",")
    rows = [row for row in csv.reader(text.splitlines()) if row and not row[0].startswith("#")]
    try:
        at = [columns.index(name) for name in "xyz"]
        points = np.array([[float(row[n]) for n in at] for row in rows]).reshape(-1, 3)
    except (ValueError, IndexError):
        raise SimulationError(f"{path}: has a row without x, y and z, {expected}") from None
    require(bool(np.isfinite(points).all()), f"{path}: has a point that is not finite, {expected}")
    return points if _FRAMES[named] == "RAS" else points @ LPS_TO_RAS[:3, :3]
