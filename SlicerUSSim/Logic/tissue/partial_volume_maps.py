"""CAT12's partial volume map p0: one number per voxel, 1 CSF, 2 grey, 3 white matter, and fractions between them.

Its numbers are those of an MRI scaled to three, but its histogram is not: many voxels are one pure tissue, at exactly
1, 2 and 3, where nothing is above. Noise widens the tissues of an MRI, and one cut off at its largest value has no
peaks below it (C. Gaser et al., CAT: a computational anatomy toolbox, GigaScience 13, 2024; its manual, "p0").
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.tissue.probability_maps import CombinedMaps

#: Largest value, which is that of pure white matter
_LARGEST = (2.95, 3.05)
#: Half of the width of a peak, and the share of what is above zero that peaks of grey and white matter have at least
_NEAR, _PURE_SHARE = 0.03, 0.04
#: How many times more voxels are at 2 than half-way to 1 and 3
_ABOVE_BETWEEN = 2.0
#: Share of what is above zero that is at least between the peaks; a label map stored as floating point has none
_FRACTIONS_SHARE = 0.02
_BYTES = 256


def partial_volume_labels(path: Path, volume: Volume) -> CombinedMaps | None:
    """The label map of CAT12's p0, each voxel its nearest tissue; None if it is none."""
    if not is_partial_volume_map(volume.array):
        return None
    labels = volume.with_array(np.rint(np.clip(volume.array, 0, 3)).astype(np.uint8))
    message = f"{path}: CAT12's partial volume map (p0), 3 tissues: 1 csf, 2 grey matter, 3 white matter, rounded"
    return CombinedMaps(labels, message, (path.name,) * 3)


def is_as_cat12_writes(path: Path, array: np.ndarray) -> bool:
    """Whether a file is called as CAT12 does, or stored in bytes as it does; no label map that was interpolated is."""
    return path.name.startswith("p0") or len(np.unique(array)) <= _BYTES


def is_partial_volume_map(array: np.ndarray) -> bool:
    """Whether a (k, j, i) array is a partial volume map of CSF, grey and white matter, 0 to 3, by its histogram."""
    if not np.issubdtype(array.dtype, np.floating):
        return False
    low, high = float(array.min()), float(array.max())  # NaN fails both comparisons
    if not (low >= -_NEAR and _LARGEST[0] <= high <= _LARGEST[1]):
        return False
    inside = array[array > _NEAR]
    grey, white, below, above = (float(np.mean(np.abs(inside - at) < _NEAR)) for at in (2.0, 3.0, 1.5, 2.5))
    has_fractions = float(np.mean(np.abs(inside - np.rint(inside)) > _NEAR)) >= _FRACTIONS_SHARE
    return has_fractions and min(grey, white) >= _PURE_SHARE and grey >= _ABOVE_BETWEEN * max(below, above)
