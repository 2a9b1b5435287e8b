"""The fissure between the hemispheres as a border of lesions, where no atlas says where it is."""

from __future__ import annotations

from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.lesions.evidence import Evidence
from SlicerUSSim.Logic.mri.sheets.falx_of_part import fissure_of_part
from SlicerUSSim.Logic.mri.sheets.head import LEAST_VOXELS, Head

#: From the fissure, whose points are 1 mm apart, to its sides
_SIDE_MM = 1.0
#: What was found, since several seeds are tried
_known: WeakKeyDictionary[Evidence, Evidence] = WeakKeyDictionary()


def with_fissure(evidence: Evidence) -> Evidence:
    """The evidence with the fissure (sheets/falx_of_part.py); as it is with an atlas, which has it."""
    if evidence.atlas is not None or evidence.fissure is not None:
        return evidence
    if evidence not in _known:
        _known[evidence] = replace(evidence, fissure=_fissure(evidence))
    return _known[evidence]


def _fissure(evidence: Evidence) -> np.ndarray:
    """(k, j, i) bool: around the fissure; nowhere if none is found."""
    inside, spacing = evidence.inside, evidence.spacing_mm
    result = np.zeros(inside.shape, bool)
    channel = evidence.channel("t1", "t1gd", "t2")
    if channel is None:
        return result
    contrast = evidence.contrasts[channel]
    sign = np.float32(-1.0 if contrast == "t2" else 1.0)
    means = sign * evidence.means[:, channel]
    if not means[0] < means[1] < means[2]:
        return result
    image = Volume(sign * evidence.images[channel], evidence.ijk_to_ras)
    head = Head.of_part(image, inside, means.tolist(), float(evidence.deviations[channel]), contrast == "t1gd")
    if min(head.brain.shape) < LEAST_VOXELS:
        return result
    places = fissure_of_part(head)
    index = np.rint((places @ image.ras_to_ijk[:3, :3].T + image.ras_to_ijk[:3, 3])[:, ::-1]).astype(int)
    index = index[((index >= 0) & (index < inside.shape)).all(axis=1)]
    if not len(index):
        return result
    result[tuple(index.T)] = True
    away = np.asarray(ndimage.distance_transform_edt(~result, sampling=spacing.tolist()))
    return away < _SIDE_MM + 0.5 * float(spacing.max())
