"""Brains whose tissues another program or a person has labelled, as phantoms and as scans to be judged on.

The values are from FreeSurfer's colour table (Fischl et al., Neuron 33(3), 2002), which SynthSeg and FastSurfer
use too.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.volume import Volume
from validation.brain_phantoms import BrainPhantom, TissueMaps

_CSF = (4, 5, 14, 15, 24, 43, 44, 72, 257)
_GREY = (3, 8, 17, 18, 26, 42, 47, 53, 54, 58, *range(1001, 1036), *range(2001, 2036))
_WHITE = (2, 41, 7, 46, 85, 251, 252, 253, 254, 255, 192, 77, 78, 79)
#: Structures that are grey matter, or mixed, and the share of white matter by which they look in T1. Measured in one
#: scan of OASIS (mean intensity in FreeSurfer's labels, cortex 0, cerebral white matter 1).
_NUCLEI = {10: 0.58, 49: 0.58, 11: 0.28, 50: 0.28, 12: 0.54, 51: 0.54, 13: 0.95, 52: 0.95, 136: 0.3, 137: 0.3}
#: Neither grey nor white in the sense of any classification: brain stem, ventral diencephalon, vessels, plexus
_UNJUDGED = {16: 0.5, 28: 0.8, 60: 0.8, 30: 0.0, 62: 0.0, 31: 0.0, 63: 0.0, 80: 0.0, 163: 0.3, 164: 0.3}
#: Standard deviation of the blur that gives crisp labels partial volumes, in voxels: about a scanner's point spread
_BLUR = 0.5


def maps_of_labels(labels: Volume, name: str) -> TissueMaps:
    """The maps of a brain from a label map with FreeSurfer's values, cropped to the brain.

    Crisp labels are blurred by half a voxel, so that voxels at borders are mixed. Deep nuclei count as grey matter and
    look as bright as in a T1; brain stem, ventral diencephalon and choroid plexus are shown and not judged.

    Raises SimulationError if it contains no cortex and white matter.
    """
    values = np.rint(labels.array).astype(np.int32)
    known = np.isin(values, (*_CSF, *_GREY, *_WHITE, *_NUCLEI, *_UNJUDGED))
    require(
        np.isin(values, (2, 41)).any() and np.isin(values, _GREY).any(),
        f"labels have values up to {values.max()}, expected FreeSurfer's, among them 2 and 41 (white matter)",
    )
    box = ndimage.find_objects(known.astype(np.uint8))[0]
    box = tuple(
        slice(max(side.start - 4, 0), min(side.stop + 4, size)) for side, size in zip(box, known.shape, strict=True)
    )
    values, known = values[box], known[box]
    ijk_to_ras = labels.ijk_to_ras.copy()
    ijk_to_ras[:3, 3] += ijk_to_ras[:3, :3] @ [side.start for side in box[::-1]]
    grey = np.isin(values, (*_GREY, *_NUCLEI, *_UNJUDGED))
    shares = np.stack([np.isin(values, _CSF), grey, np.isin(values, _WHITE)]).astype(np.float32)
    looks = np.zeros(values.shape, np.float32)
    for label, white in {**_NUCLEI, **_UNJUDGED}.items():
        looks[values == label] = white
    appearance = shares + np.stack([np.zeros_like(looks), -looks, looks])
    return TissueMaps(
        name,
        shares=_blurred(shares, known),
        mask=known,
        ijk_to_ras=ijk_to_ras,
        appearance=_blurred(appearance, known),
        judged=known & ~np.isin(values, tuple(_UNJUDGED)),
    )


def _blurred(shares: np.ndarray, mask: np.ndarray) -> np.ndarray:
    smooth = np.stack([ndimage.gaussian_filter(share, _BLUR) for share in shares])
    return np.where(mask, smooth / np.maximum(smooth.sum(axis=0), 1e-6), 0.0).astype(np.float32)


def labelled_scan(mri: Volume, labels: Volume, name: str) -> BrainPhantom:
    """A real scan with another program's labels (FreeSurfer's values) as the truth; the mask is what is labelled.

    Agreement with such labels does not measure accuracy beyond about 0.9: programs differ from each other, and
    FreeSurfer's cortex is cut out by surfaces rather than by intensity.

    Raises SimulationError if the grids differ or the labels contain no white matter.
    """
    require(
        mri.array.shape == labels.array.shape,
        f"{name}: labels have shape {labels.array.shape} and the MRI {mri.array.shape}, expected the same grid",
    )
    maps = maps_of_labels(labels, name)
    first = np.rint(labels.ras_to_ijk @ maps.ijk_to_ras[:, 3]).astype(int)[:3][::-1]
    box = tuple(slice(start, start + size) for start, size in zip(first, maps.mask.shape, strict=True))
    judged = maps.mask if maps.judged is None else maps.judged
    truth = np.where(judged, maps.shares.argmax(axis=0) + 1, 0).astype(np.uint8)
    arrays = (mri.array[box].astype(np.float32), maps.mask.astype(np.uint8), truth)
    image, mask, truth = (Volume(array, maps.ijk_to_ras) for array in arrays)
    return BrainPhantom(name, image, mask, truth, maps, np.ones(maps.mask.shape, np.float32), float("nan"))
