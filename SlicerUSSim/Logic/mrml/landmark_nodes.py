"""Landmarks of a registration as a markups node: points in the patient, and the pixels of a recording that they are."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.transforms import MOST_MM
from SlicerUSSim.Logic.mrml.nodes import control_points, named, nodes_of_class

#: Attributes of a markups node: number of the image, column and row of each of its points, as JSON; and what is left of
#: each, without which the registration was not made by them
_PIXELS, _LEFT = "SlicerUSSim.landmarks", "SlicerUSSim.landmarksLeft"


@dataclass(frozen=True, eq=False)
class Landmark:
    """A place in a recorded image, and the same in the patient."""

    #: Number of the image in the recording, and (2,) column and row in it
    number: int
    pixel: np.ndarray
    #: (3,) RAS in millimetres
    point: np.ndarray
    #: Distance in millimetres that is left in the registration by all of them; None: it was not made by these
    left_mm: float | None = None

    def check(self, columns: int, rows: int) -> None:
        """Raise SimulationError for a pixel outside an image of this size, or a point farther than MOST_MM.

        The centre of the first pixel is at 0, so that the image begins half a pixel before.
        """
        for name, value, count in zip(("column", "row"), self.pixel, (columns, rows), strict=True):
            require(
                -0.5 <= value <= count - 0.5,
                f"Landmark in the image has {name} {value:g}, expected 0 to {count - 1}, as the image has "
                f"{columns}x{rows} pixels",
            )
        for name, value in zip("RAS", self.point, strict=True):
            require(
                abs(value) <= MOST_MM,
                f"Landmark in the patient has {name} {value:g} mm, expected at most {MOST_MM:g} mm from the origin",
            )

    def to_list(self) -> list[float]:
        """Number, column, row, R, A and S, and what is left if it is known, as JSON can hold them."""
        left = [] if self.left_mm is None else [self.left_mm]
        return [self.number, *map(float, self.pixel), *map(float, self.point), *left]

    @classmethod
    def of_list(cls, values: Sequence[float]) -> Landmark:
        """The inverse of to_list. Raises ValueError or TypeError for something else."""
        number, *rest = values
        numbers = np.array(rest, float)
        if numbers.shape not in ((5,), (6,)) or not np.isfinite(numbers).all():
            raise ValueError(f"{values}: expected six or seven numbers")
        return cls(int(number), numbers[:2], numbers[2:5], float(numbers[5]) if len(numbers) == 6 else None)


def is_landmarks(node: Any) -> bool:
    """Whether a node was written by write_landmarks."""
    return node.GetAttribute(_PIXELS) is not None


def write_landmarks(node: Any, landmarks: Sequence[Landmark]) -> None:
    """Replace the points of a vtkMRMLMarkupsFiducialNode; each is called by its number, from 1."""
    was_modifying = node.StartModify()
    node.RemoveAllControlPoints()
    for number, landmark in enumerate(landmarks, 1):
        node.AddControlPointWorld(*landmark.point.tolist(), str(number))
    node.SetAttribute(_PIXELS, json.dumps([[mark.number, *map(float, mark.pixel)] for mark in landmarks]))
    left = [mark.left_mm for mark in landmarks]
    node.SetAttribute(_LEFT, None if None in left else json.dumps(left))
    node.SetLocked(True)  # a point that is dragged would not be what was registered
    node.EndModify(was_modifying)


def landmarks_of(scene) -> tuple[Landmark, ...]:
    """Those of a scene. Raises SimulationError for a node whose points and pixels do not go together."""
    for node in nodes_of_class(scene, "vtkMRMLMarkupsFiducialNode"):
        if is_landmarks(node):
            try:
                pixels, points = json.loads(node.GetAttribute(_PIXELS)), control_points(node)
                text = node.GetAttribute(_LEFT)
                left = [[]] * len(pixels) if text is None else [[value] for value in json.loads(text)]
                parts = zip(pixels, points, left, strict=True)
                return tuple(Landmark.of_list([*pixel, *point, *rest]) for pixel, point, rest in parts)
            except (ValueError, TypeError):
                raise SimulationError(
                    f"{named(node)}: its points and the attribute {_PIXELS} do not go together; remove the node"
                ) from None
    return ()
