"""The atlas: the MNI152 template and its tissue maps, which nilearn carries."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.errors import required
from SlicerUSSim.Logic.base.volume import Volume


@dataclass(frozen=True, eq=False)
class Atlas:
    """A skull-stripped T1 and the share of each tissue in every voxel, on one grid."""

    #: 0 outside the brain
    t1: Volume
    #: float32, 0 to 1; the three add up to 1 in the brain
    csf: Volume
    grey: Volume
    white: Volume


@cache
def mni152() -> Atlas | None:
    """The MNI152 2009a template at 1 mm (Fonov et al., NeuroImage 54(1), 2011); None if nilearn is not installed."""
    package = importlib.util.find_spec("nilearn")
    if package is None or package.origin is None:
        return None
    folder = Path(package.origin).parent / "datasets/data"
    t1, grey, white = (
        Volume.read(folder / f"mni_icbm152_{name}_tal_nlin_sym_09a_converted.nii.gz") for name in ("t1", "gm", "wm")
    )
    inside = t1.array > 0
    shares = [np.where(inside, volume.array.astype(np.float32) / 255.0, 0.0) for volume in (grey, white)]
    csf = np.where(inside, np.clip(1.0 - shares[0] - shares[1], 0.0, 1.0), 0.0)
    return Atlas(t1, *(t1.with_array(share.astype(np.float32)) for share in (csf, *shares)))


def required_atlas() -> Atlas:
    """As mni152. Raises SimulationError, with the remedy, if nilearn is not installed."""
    return required(
        mni152(), "a whole head needs the brain atlas of nilearn: pip install nilearn, or give a brain mask (--mask)"
    )
