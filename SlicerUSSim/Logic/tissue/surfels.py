"""Surfels: small pieces of thin sheets, each with a place, a normal and a thickness, finer than any voxel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from SlicerUSSim.Logic.base.errors import require

#: Names of the kinds, by their numbers in Surfels.kind
KINDS = ("sulcus", "falx", "tentorium", "ependyma")


@dataclass(frozen=True, eq=False)
class Surfels:
    """Pieces of thin sheets in a patient's head."""

    #: (n, 3) float32 RAS mm
    place: np.ndarray
    #: (n, 3) float32 unit vectors across the sheet, RAS; their sign has no meaning
    normal: np.ndarray
    #: (n,) float32 mm, across the sheet: of a sulcus the fluid and membranes in it
    thickness: np.ndarray
    #: (n,) float32 from 0 to 1, how sure it is that a sheet is there, by which its reflection is scaled
    confidence: np.ndarray
    #: (n,) float32 mm², so that the areas of a sheet's surfels add up to the sheet's
    area: np.ndarray
    #: (n,) uint8 index in KINDS
    kind: np.ndarray

    def __post_init__(self) -> None:
        count = len(self.place)
        for entry in fields(self):
            array = getattr(self, entry.name)
            shape = (count, 3) if entry.name in ("place", "normal") else (count,)
            expected = np.dtype(np.uint8 if entry.name == "kind" else np.float32)
            require(
                array.shape == shape and array.dtype == expected,
                f"{entry.name} of surfels is {array.dtype} {array.shape}, expected {expected} {shape}",
            )

    def __len__(self) -> int:
        return len(self.place)

    @classmethod
    def of(
        cls,
        kind: str,
        place: np.ndarray,
        normal: np.ndarray,
        thickness: np.ndarray | float,
        confidence: np.ndarray | float,
        area: np.ndarray | float,
    ) -> Surfels:
        """Surfels of one kind; numbers stand for all of them."""
        count = len(place)
        place, normal = (np.asarray(array, np.float32).reshape(-1, 3) for array in (place, normal))
        numbers = [
            np.broadcast_to(np.asarray(value, np.float32), count).copy() for value in (thickness, confidence, area)
        ]
        return cls(place, normal, numbers[0], numbers[1], numbers[2], np.full(count, KINDS.index(kind), np.uint8))

    @classmethod
    def joined(cls, parts: Sequence[Surfels]) -> Surfels:
        """All surfels of several; none of none."""
        if not parts:
            return cls.of(KINDS[0], np.zeros((0, 3)), np.zeros((0, 3)), 0.0, 0.0, 0.0)
        return cls(*(np.concatenate([getattr(part, entry.name) for part in parts]) for entry in fields(cls)))

    def chosen(self, which: np.ndarray) -> Surfels:
        """The surfels of a mask or of indices."""
        return Surfels(*(getattr(self, entry.name)[which] for entry in fields(self)))

    def kinds(self) -> tuple[str, ...]:
        """Names of the kinds that there are, in the order of KINDS."""
        return tuple(KINDS[number] for number in np.unique(self.kind))

    def of_kind(self, *kinds: str) -> Surfels:
        """The surfels of some kinds only. Raises SimulationError for a name that is not in KINDS."""
        for name in kinds:
            require(name in KINDS, f"sheets have no kind {name!r}, expected some of: {', '.join(KINDS)}")
        return self.chosen(np.isin(self.kind, [KINDS.index(name) for name in kinds]))
