"""The brain in an MRI: as the image shows it, by the atlas from a whole head, or as the user gives it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np

from SlicerUSSim.Logic.base.declaration import parameter_of
from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.volume import LARGEST_MM, Volume
from SlicerUSSim.Logic.mri.alignment import Alignment
from SlicerUSSim.Logic.mri.edges import ends_at_edge
from SlicerUSSim.Logic.mri.given_mask import checked_mask, label_doubts, volume_doubts
from SlicerUSSim.Logic.mri.kept_mask import keep, read_kept
from SlicerUSSim.Logic.mri.recognition import POSSIBLE_ML, USUAL_ML, above_noise, recognise
from SlicerUSSim.Logic.mri.refinement import refined
from SlicerUSSim.Logic.mri.segmentation_settings import SegmentationSettings


@dataclass(frozen=True, eq=False)
class BrainMask:
    """Where the brain is in an MRI, and how it was found."""

    #: uint8 on the MRI's grid, 1 inside
    mask: Volume
    #: "given" (also in a file beside the MRI), "stripped" (the MRI shows nothing else), "atlas" or "none" (threshold
    #: alone)
    method: str
    #: One line for the user: "whole head: brain extracted by the atlas in 9 s, 1520 ml"
    message: str
    #: One line each, for what a user should check
    warnings: tuple[str, ...] = ()

    @property
    def volume_ml(self) -> float:
        """Volume of the mask in millilitres."""
        return float(np.count_nonzero(self.mask.array) * self.mask.voxel_ml)


def find_brain(
    mri: Volume, method: str = "atlas", *, keep_at: Path | None = None, progress: Callable[[float], None] | None = None
) -> BrainMask:
    """The brain in an MRI of a whole head, or of a brain.

    Parameters
    ----------
    mri : the image, with its orientation and voxel size as in the patient.
    method : "atlas" extracts the brain of a whole head; "none" takes everything brighter than the background, whatever
        the image shows.
    keep_at : file in which the mask of a whole head is kept and from which it is read again; see mask_beside.
    progress : called with the fraction done, 0 to 1; may raise errors.Cancelled, which ends the extraction at once.

    Raises SimulationError if the image shows neither a head nor a brain, and for a kept mask that
    would be refused if it were given.
    """
    method = parameter_of(SegmentationSettings, "skull_strip").checked("segmentation", method)
    start, report = perf_counter(), progress or (lambda share: None)
    if method == "none":
        return _found(mri, above_noise(mri), "none", "everything brighter than the background")
    kept = read_kept(keep_at, mri) if keep_at is not None else None
    if kept is not None:
        try:
            found = given_brain(kept, mri)
        except SimulationError as error:
            raise SimulationError(f"{error}; correct that file, or delete it to extract the brain again") from None
        message = f"whole head: brain mask in {keep_at}, {found.volume_ml:.0f} ml; delete it to extract the brain again"
        return replace(found, message=message, warnings=(*found.warnings, *ends_at_edge(mri, found.mask.array > 0)))
    given, mri = mri, mri.along()
    size = mri.spacing_mm * mri.array.shape[::-1]
    require(
        float(size.max()) <= LARGEST_MM,
        f"the image is {'x'.join(f'{mm:g}' for mm in size)} mm large, expected a head of 100 to 400 mm; correct its "
        "voxel size, or the unit of length in its header",
    )
    shown = recognise(mri, lambda share: report(0.6 * share))
    if not isinstance(shown, Alignment):
        return _found(given, mri.with_array(shown).along(given).array, "stripped", "skull-stripped brain")
    distance = shown.brain_on(mri)
    report(0.7)
    border = lambda share: report(0.7 + 0.3 * share)  # noqa: E731
    inside = refined(mri, distance, core_mm=8.0, reach_mm=12.0, keep_mm=3.0, progress=border)
    millilitres = float(inside.sum() * mri.voxel_ml)
    require(
        POSSIBLE_ML[0] <= millilitres <= POSSIBLE_ML[1],
        f"no brain was found in this head: the atlas found {millilitres:.0f} ml, expected {USUAL_ML[0]:.0f} to "
        f"{USUAL_ML[1]:.0f} ml; give a brain mask (--mask)",
    )
    overlap = 2.0 * float((inside & (distance < 0.0)).sum() / (inside.sum() + (distance < 0.0).sum()))
    how = f"whole head: brain extracted by the atlas in {perf_counter() - start:.0f} s"
    found = _found(given, mri.with_array(inside).along(given).array, "atlas", how, ends_at_edge(mri, inside))
    message = f"{found.message}, overlap with the registered atlas {overlap:.2f}"
    if keep_at is not None:
        message += f"; {keep(keep_at, given, found.mask)}"
    report(1.0)
    return replace(found, message=message)


def given_brain(mask: Volume, mri: Volume) -> BrainMask:
    """The mask that a user gives. Raises SimulationError if it is empty, on another grid, or covers everything.

    What looks like no whole brain, and several labels, are warnings: it may be what the user wants.
    """
    return _found(mri, checked_mask(mask, mri), "given", "brain mask as given", label_doubts(mask))


def _found(mri: Volume, inside: np.ndarray, method: str, how: str, warnings: tuple[str, ...] = ()) -> BrainMask:
    """The brain `inside` (k, j, i) on the grid of the MRI, found as `how` says."""
    mask = mri.with_array(inside.astype(np.uint8))
    millilitres = float(np.count_nonzero(inside) * mri.voxel_ml)
    return BrainMask(mask, method, f"{how}, {millilitres:.0f} ml", (*warnings, *volume_doubts(millilitres)))
