"""Which of three labels of a brain are CSF, grey and white matter, by how much there is of each and where it lies."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.tissue.thinning import thinning

BRAIN_TISSUES = ("csf", "grey matter", "white matter")
#: Smallest and largest share of a brain; in people about 0.02 (ventricles only) to 0.35, 0.35 to 0.6 and 0.25 to 0.5
_SHARES = {"csf": (0.0, 0.5), "grey matter": (0.15, 0.8), "white matter": (0.15, 0.7)}
#: Fluid that lies as deep as white matter is that of the ventricles, and little: 0.02 to 0.05.
_LARGEST_VENTRICLES = 0.2
#: Share of white matter's surface that touches grey matter: 0.9 and more in people
_COVERED = 0.5
#: Share of a volume that has to be outside a brain to tell how deep its tissues are
_OUTSIDE = 0.2


@dataclass(frozen=True, eq=False)
class BrainLabels:
    """Amounts and places of up to three labels of a brain."""

    #: Label of row and column 1, 2, 3 of `contacts`
    labels: tuple[int, ...]
    #: {label: share of the voxels of these labels}
    shares: dict[int, float]
    #: {label: mean distance from the outside, in voxels}; None for a part of a brain
    depths: dict[int, float] | None
    #: Pairs of neighbouring voxels; 0 for the outside and other labels
    contacts: np.ndarray

    @classmethod
    def of(cls, volume: Volume, labels: tuple[int, ...]) -> BrainLabels:
        """Of a label map, (k, j, i) whole numbers, in which at least one of these up to three labels occurs."""
        from scipy import ndimage

        array = np.zeros(volume.array.shape, np.uint8)
        for place, label in enumerate(labels, 1):
            array[volume.array == label] = place
        counts = np.bincount(array.ravel(), minlength=len(labels) + 1)[1:]
        contacts = np.zeros(16, np.int64)
        for axis in range(3):
            first = np.moveaxis(array, axis, 0)
            contacts += np.bincount((first[:-1] * np.uint8(4) + first[1:]).ravel(), minlength=16)
        contacts = contacts.reshape(4, 4)
        step = thinning(array)
        thin = array[::step, ::step, ::step]
        depths = None
        filled = volume.array[::step, ::step, ::step] > 0
        if np.mean(~filled) >= _OUTSIDE:
            depth = np.asarray(ndimage.distance_transform_edt(filled))
            mean = [float(depth[thin == place].mean()) if (thin == place).any() else 0.0 for place in (1, 2, 3)]
            depths = dict(zip(labels, mean, strict=False))
        shares = dict(zip(labels, (counts / max(1, counts.sum())).tolist(), strict=True))
        return cls(labels, shares, depths, contacts + contacts.T)

    def fits(self, csf: int, grey: int, white: int) -> bool:
        """Whether these labels may be CSF, grey and white matter.

        White matter is covered by grey matter, and deeper than it; fluid is around the brain, or in little ventricles.
        Of a part of a brain, whose depth is not known, only amounts and contacts are judged.
        """
        found = dict(zip(BRAIN_TISSUES, (csf, grey, white), strict=True))
        for tissue, label in found.items():
            low, high = _SHARES[tissue]
            if not low <= self.shares.get(label, 0.0) <= high:
                return False
        fluid = self.labels.index(csf) + 1 if csf in self.labels else 0
        row = self.contacts[self.labels.index(white) + 1]
        others = row.sum() - row[self.labels.index(white) + 1]
        touching = row[self.labels.index(grey) + 1]
        if touching < _COVERED * others or (fluid and touching < row[fluid]):
            return False
        if self.depths is None:
            return True
        is_around = fluid == 0 or self.depths[csf] < self.depths[white]
        is_possible = is_around or self.shares[csf] <= _LARGEST_VENTRICLES
        return self.depths[white] > self.depths[grey] and is_possible

    def orders(self) -> list[dict[int, str]]:
        """{label: tissue} of every order in which all three labels may be the tissues; none for a part of a brain."""
        if self.depths is None or len(self.labels) != 3:
            return []
        return [
            dict(zip(order, BRAIN_TISSUES, strict=True)) for order in permutations(self.labels) if self.fits(*order)
        ]
