"""Lesions laid into a patient: balls with a rough surface."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.neighbourhood import distance_to
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.pathology import Added, add_tissue
from SlicerUSSim.Logic.placement.craniotomy import without_outside
from SlicerUSSim.Logic.tissue.names import labels_of

#: Where the middle of a lesion may lie, and how far from the wanted depth, mm
_WITHIN, _SHELL_MM = ("grey matter", "white matter", "brain"), 1.5
#: Waves over the sphere that make its surface rough, and their numbers per radian
_WAVES, _FINENESS = 24, 3.0


def with_lesion(labels: Volume, names: Sequence[str], drawn: Mapping[str, Any], random: np.random.Generator) -> Added:
    """Labels 1, 2, ... called `names` with a lesion at a random place of the drawn depth.

    `drawn` are values of LesionSettings. Raises SimulationError if the brain has no place that deep.
    """
    brain = without_outside(labels, names).array > 0
    depth = distance_to(~np.pad(brain, 1), labels.spacing_mm)[1:-1, 1:-1, 1:-1]
    where = np.isin(labels.array, labels_of(names, _WITHIN)) & (abs(depth - drawn["depth_mm"]) <= _SHELL_MM)
    places = np.flatnonzero(where)
    require(
        places.size > 0,
        f"[lesions] depth_mm is {drawn['depth_mm']:g}, and the brain has no tissue so deep, expected at most "
        f"{depth.max():.0f}",
    )
    middle = np.array(np.unravel_index(int(places[random.integers(places.size)]), labels.array.shape))
    waves, phases = random.normal(0.0, _FINENESS, (_WAVES, 3)), random.uniform(0.0, 2.0 * np.pi, _WAVES)
    spacing = np.asarray(labels.spacing_mm)[::-1]
    reach = np.ceil(drawn["radius_mm"] * 2.5 / spacing).astype(int)
    low, high = np.maximum(middle - reach, 0), np.minimum(middle + reach + 1, labels.array.shape)
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    offset = (np.moveaxis(np.mgrid[box], 0, -1) - middle) * spacing
    away = np.linalg.norm(offset, axis=-1)
    rough = np.cos(offset / np.maximum(away, 1e-6)[..., None] @ waves.T + phases).sum(axis=-1) * np.sqrt(2.0 / _WAVES)
    radius = drawn["radius_mm"] * np.clip(1.0 + drawn["roughness"] * rough, 0.3, 2.4)
    mask = np.zeros(labels.array.shape, np.uint8)
    mask[box] = (away <= radius) & brain[box]
    return add_tissue(labels, names, labels.with_array(mask), drawn["tissue"], source="the lesion")
