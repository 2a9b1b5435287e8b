"""Organs from a label map, laid over the classes of a CT."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.neighbourhood import smallest_around
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.ct_classes import BLOOD, BONE, NAMES, SOFT, SPONGY
from SlicerUSSim.Logic.tissue.label_maps import LabelledTissues

#: Tissues of a label map that the numbers know better
_BY_NUMBER = {"bone", "skull", "cancellous bone", "lung", "air", "fat", "skin", "scalp", "metal", "muscle", "coupling"}
_BONES = {"bone", "skull", "cancellous bone"}
#: Vessels stay blood in an organ from this far above its median on, HU
_ABOVE_ORGAN = 45.0
#: Share of an organ map that has to lie in the patient
_LEAST_INSIDE = 0.6


@dataclass(frozen=True, eq=False)
class Organs:
    """A label map of organs on the grid of a CT."""

    #: (k, j, i) uint8
    labels: np.ndarray
    #: Tissue of label 1, 2, ...
    names: tuple[str, ...]

    @classmethod
    def on(cls, organs: LabelledTissues, ct: Volume) -> Organs:
        """By the nearest voxel. Raises SimulationError for a label map that does not meet the CT."""
        volume = organs.labels
        same = volume.array.shape == ct.array.shape and np.allclose(volume.ijk_to_ras, ct.ijk_to_ras, atol=1e-2)
        if same:
            labels = volume.array.astype(np.uint8)
        else:
            to_organs = (volume.ras_to_ijk @ ct.ijk_to_ras)[[2, 1, 0, 3]][:, [2, 1, 0, 3]]
            labels = ndimage.affine_transform(
                volume.array.astype(np.uint8), to_organs[:3, :3], to_organs[:3, 3].tolist(), ct.array.shape, order=0
            )
        require(
            bool(labels.any()),
            "the label map of organs does not meet the CT, expected one of this patient in its frame",
        )
        return cls(np.asarray(labels), organs.names)


def laid_over(
    organs: Organs, classes: np.ndarray, hu: np.ndarray, names: tuple[str, ...]
) -> tuple[np.ndarray, tuple[str, ...], list[str]]:
    """((k, j, i) classes with organs, names of classes with theirs, lines about it).

    Soft organs replace muscle and blood; vessels in them that stand out stay. Bones of the label map are cancellous
    where the numbers have soft tissue in them, one voxel below their surface.
    Raises SimulationError if most of the organs lie where the CT has no patient.
    """
    inside = float((classes[organs.labels > 0] > 0).mean())
    require(
        inside >= _LEAST_INSIDE,
        f"{1.0 - inside:.0%} of the organs lie outside the patient in the CT, expected a label map of this CT",
    )
    classes, lines = classes.copy(), []
    for label, name in enumerate(organs.names, 1):
        where = organs.labels == label
        if not where.any():
            continue
        if name in _BONES:
            soft = smallest_around(where) & ((classes == SOFT) | (classes == BLOOD))
            classes[soft] = SPONGY
        elif name not in _BY_NUMBER:
            soft = where & ((classes == SOFT) | (classes == BLOOD))
            if name == "blood":
                classes[soft] = BLOOD
                continue
            if not soft.any():
                continue
            stands_out = hu > float(np.median(hu[soft])) + _ABOVE_ORGAN
            if name not in names:
                names = (*names, name)
            classes[soft & ~((classes == BLOOD) & stands_out)] = names.index(name) + 1
            lines.append(name)
    found = f"organs: {', '.join(lines)}" if lines else "organs: none but bone, lung and muscle"
    assert NAMES[BONE - 1] == "bone"
    return classes, names, [found]
