"""The brain in an MRI: recognition of what the image shows, and extraction from a whole head."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import cast

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.volume import Volume


@dataclass(frozen=True, eq=False)
class BrainMask:
    """Where the brain is in an MRI, and how it was found."""

    #: uint8 on the MRI's grid, 1 inside
    mask: Volume
    #: "given", "stripped" (the MRI shows nothing else), "robex", "deepbet", "atlas" or "none" (threshold alone)
    method: str
    #: One line for the user: "whole head: brain extracted by ROBEX in 9 s, 1520 ml"
    message: str
    #: One line each, for what a user should check
    warnings: tuple[str, ...] = ()
    seconds: float = 0.0

    @property
    def volume_ml(self) -> float:
        """Volume of the mask in millilitres."""
        return float((self.mask.array > 0).sum() * abs(np.linalg.det(self.mask.ijk_to_ras[:3, :3])) / 1000.0)


def find_brain(
    mri: Volume,
    method: str = "auto",
    *,
    keep_at: Path | None = None,
    progress: Callable[[float], None] | None = None,
) -> BrainMask:
    """The brain in an MRI of a whole head, or of a brain."""
    start = perf_counter()
    inside = _foreground(mri.array)
    mask = mri.with_array(inside.astype(np.uint8))
    return BrainMask(mask, "none", "foreground found by Otsu's threshold", seconds=perf_counter() - start)


def given_brain(mask: Volume, mri: Volume) -> BrainMask:
    """The mask that a user gives. Raises SimulationError if it is empty or on another grid."""
    require(
        mask.array.shape == mri.array.shape and np.allclose(mask.ijk_to_ras, mri.ijk_to_ras, atol=1e-3),
        f"mask has shape {mask.array.shape} and the MRI {mri.array.shape}, expected the same grid; resample the mask",
    )
    inside = mask.array > 0
    require(bool(inside.any()), "mask is empty, expected at least one voxel inside")
    found = BrainMask(mri.with_array(inside.astype(np.uint8)), "given", "")
    return BrainMask(found.mask, "given", f"brain mask as given, {found.volume_ml:.0f} ml")


def _foreground(intensity: np.ndarray) -> np.ndarray:
    from skimage.filters import threshold_otsu

    inside = intensity > 0.5 * threshold_otsu(intensity)  # half: Otsu's threshold itself would exclude CSF in T1
    # Casts: the return types of scipy's functions depend on their arguments, without type annotations for that.
    components, count = cast(tuple[np.ndarray, int], ndimage.label(inside))
    if count > 1:
        inside = components == np.argmax(np.bincount(components.ravel())[1:]) + 1
    return cast(np.ndarray, ndimage.binary_fill_holes(inside))
