"""Organs from a label map, laid over the classes of a CT."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.neighbourhood import largest_around, smallest_around
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.ct_classes import AIR, BLOOD, BONE, LUNG, METAL, NAMES, SOFT, SPONGY
from SlicerUSSim.Logic.tissue.label_maps import LabelledTissues

#: Tissues of a label map that the numbers know better
_BY_NUMBER = {"bone", "skull", "cancellous bone", "lung", "air", "fat", "skin", "scalp", "metal", "muscle", "coupling"}
_BONES = {"bone", "skull", "cancellous bone"}
#: Vessels stay blood in an organ from this far above its median on, HU
_ABOVE_ORGAN = 45.0
#: Share of an organ map that has to lie in the patient
_LEAST_INSIDE = 0.6
#: What is solid, and of it what holds neither stones nor so much contrast agent that it is as dense as bone
_SOLID = {"liver", "spleen", "kidney", "heart", "white matter", "grey matter"}
_WITHOUT_STONES = {"liver", "spleen"}
#: Organs of another patient or place show by the numbers of the CT. Below the first share of an organ, without its
#: outermost voxels, in what it is made of, it is not of this CT, below the second doubtful: of solid organs no fat, gas
#: or air (0.99 and more of the phantoms' own, 0.53 to 0.91 shifted by 30 mm, 0.46 and 0.54 mirrored); gas of lung
#: (1.00, 0.36 to 0.63, 0.58)
_LEAST_SOFT, _LEAST_GAS = (0.7, 0.9), (0.5, 0.8)
#: Shares of bone in a liver or spleen; another patient's has 0.07 to 0.16
_MOST_BONE = (0.08, 0.03)
#: As above of the surface of bones, which is to be beside cortex: 0.82 and more, also with marrow as soft as muscle;
#: 0.42 to 0.76 shifted by 8 mm, 0.18 to 0.30 by 30 mm across, up to 0.1 of another patient's. Larger voxels hide it
_LEAST_CORTEX, _LARGEST_FOR_CORTEX_ML = (0.4, 0.7), 0.028
#: Smaller organs tell nothing, ml
_LEAST_ML = 2.0


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


def organs_of_ct(organs: LabelledTissues, classes: np.ndarray, ct: Volume) -> tuple[Organs, list[str]]:
    """(Organs on the grid of a CT of these (k, j, i) classes, lines about what is doubtful).

    Raises SimulationError as Organs.on and require_of_ct do.
    """
    on_ct = Organs.on(organs, ct)
    return on_ct, require_of_ct(on_ct, classes, ct.voxel_ml)


def require_of_ct(organs: Organs, classes: np.ndarray, voxel_ml: float) -> list[str]:
    """Lines about organs that hardly lie in what they are made of, by the (k, j, i) classes of a CT.

    Raises SimulationError, naming the first one, for organs that do not: of another patient, moved or mirrored; and if
    most of them lie where the CT has no patient.
    """
    outside = float((classes[organs.labels > 0] == 0).mean())
    require(
        outside <= 1.0 - _LEAST_INSIDE,
        f"{outside:.0%} of the organs lie outside the patient in the CT, expected a label map of this CT",
    )
    doubts = []
    boxes = ndimage.find_objects(organs.labels)
    for label, (name, box) in enumerate(zip(organs.names, boxes, strict=False), 1):
        if box is None or name not in {*_SOLID, *_BONES, "lung"}:
            continue
        box = tuple(slice(max(part.start - 1, 0), part.stop + 1) for part in box)
        where, of_ct = organs.labels[box] == label, classes[box]
        inside = smallest_around(where)
        is_unseen = name in _BONES and voxel_ml > _LARGEST_FOR_CORTEX_ML
        if inside.sum() * voxel_ml < _LEAST_ML or is_unseen:
            continue
        if name in _BONES:
            beside = largest_around((of_ct == BONE) | (of_ct == METAL))
            found = [("of its surface is beside bone", float(beside[where & ~inside].mean()), _LEAST_CORTEX)]
        elif name == "lung":
            found = [("of it is gas or lung", _share(of_ct[inside], LUNG, AIR), _LEAST_GAS)]
        else:
            dense = _share(of_ct[inside], BONE, SPONGY, METAL)
            found = [("of it is soft tissue", _share(of_ct[inside], SOFT, BLOOD) + dense, _LEAST_SOFT)]
            if name in _WITHOUT_STONES:
                found.append(("of it is free of bone", 1.0 - dense, (1.0 - _MOST_BONE[0], 1.0 - _MOST_BONE[1])))
        for what, share, (least, usual) in found:
            text = f"organs: {name}: {share:.0%} {what} in the CT, expected {usual:.0%} or more"
            require(
                share >= least,
                f"{text}; give a label map of this CT, in its frame, whose numbers are what they are taken for, or "
                "without that organ",
            )
            if share < usual:
                doubts.append(f"{text}: is the label map of this CT, and in its frame?")
    return doubts


def _share(classes: np.ndarray, *wanted: int) -> float:
    return float(np.isin(classes, wanted).mean())


def laid_over(
    organs: Organs, classes: np.ndarray, hu: np.ndarray, names: tuple[str, ...]
) -> tuple[np.ndarray, tuple[str, ...], list[str]]:
    """((k, j, i) classes with organs, names of classes with theirs, lines about it).

    Soft organs replace muscle and blood; vessels in them that stand out stay. Bones of the label map are cancellous
    where the numbers have soft tissue in them, one voxel below their surface.
    """
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
