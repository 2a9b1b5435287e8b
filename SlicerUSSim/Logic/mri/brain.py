"""The brain in an MRI: as the image shows it, as a program extracts it from a whole head, or as the user gives it."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np

from SlicerUSSim.Logic.base.declaration import parameter_of
from SlicerUSSim.Logic.base.errors import Cancelled, SimulationError, require, required
from SlicerUSSim.Logic.base.volume import LARGEST_MM, Volume
from SlicerUSSim.Logic.mri import extractors
from SlicerUSSim.Logic.mri.extractors import Report
from SlicerUSSim.Logic.mri.given_mask import checked_mask, label_doubts, mask_doubts, volume_warnings
from SlicerUSSim.Logic.mri.kept_mask import keep, read_kept
from SlicerUSSim.Logic.mri.no_data import ends_at_edge, without_blank
from SlicerUSSim.Logic.mri.recognition import (
    POSSIBLE_ML,
    USUAL_ML,
    above_noise,
    recognise,
)
from SlicerUSSim.Logic.mri.refinement import on_grid, refined, signed_distance
from SlicerUSSim.Logic.mri.segmentation_settings import SegmentationSettings

_log = logging.getLogger(__name__)

_NAMES = {"robex": "ROBEX", "deepbet": "deepbet", "atlas": "the atlas"}


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
        return _millilitres(self.mask.array > 0, self.mask)


def find_brain(
    mri: Volume, method: str = "auto", *, keep_at: Path | None = None, progress: Report | None = None
) -> BrainMask:
    """The brain in an MRI of a whole head, or of a brain.

    Parameters
    ----------
    mri : the image, with its orientation and voxel size as in the patient.
    method : how a brain is extracted from a whole head: "robex", "deepbet" or "atlas"; "auto" for the first of the
        atlas and the programs that are installed that finds one; "none" takes everything brighter than the background,
        whatever the image shows.
    keep_at : file in which the mask of a whole head is kept and from which it is read again; see mask_beside.
    progress : called with the fraction done, 0 to 1; may raise errors.Cancelled, which ends the extraction at once.

    Raises SimulationError if the image shows neither a head nor a brain, or if no method is available or succeeds.
    """
    method = parameter_of(SegmentationSettings, "skull_strip").checked("segmentation", method)
    start, report = perf_counter(), _forwards(progress)
    if method == "none":
        inside = above_noise(mri)
        mask, millilitres = mri.with_array(inside.astype(np.uint8)), _millilitres(inside, mri)
        message = f"everything brighter than the background, {millilitres:.0f} ml"
        return BrainMask(mask, "none", message, volume_warnings(millilitres), perf_counter() - start)
    kept = _kept(keep_at, mri, method) if keep_at is not None else None
    if kept is not None:
        return kept
    given, mri = mri, mri.along()
    size = mri.spacing_mm * mri.array.shape[::-1]
    require(
        float(size.max()) <= LARGEST_MM,
        f"the image is {'x'.join(f'{mm:g}' for mm in size)} mm large, expected a head of 100 to 400 mm; correct its "
        "voxel size, or the unit of length in its header",
    )
    stripped, alignment = recognise(mri, lambda share: report(0.6 * share))
    if stripped is not None:
        mask = mri.with_array(stripped.astype(np.uint8)).along(given)
        millilitres = _millilitres(stripped, mri)
        message = f"skull-stripped brain, {millilitres:.0f} ml"
        if method != "auto":
            message += f"; {_NAMES[method]} is not asked, as there is no skull to strip"
        return BrainMask(mask, "stripped", message, volume_warnings(millilitres), perf_counter() - start)
    expected = required(alignment, "a head has no fitted atlas").brain_on(mri)
    found = _extracted(mri, expected, method, lambda share: report(0.6 + 0.35 * share))
    inside, blank = without_blank(mri, found.inside)
    millilitres = _millilitres(inside, mri)
    warnings = (
        *found.warnings,
        *blank,
        *volume_warnings(millilitres),
        *ends_at_edge(mri, inside),
    )
    seconds = perf_counter() - start
    message = (
        f"whole head: brain extracted by {_NAMES[found.method]} in {seconds:.0f} s, {millilitres:.0f} ml, overlap with "
        f"the registered atlas {_dice(found.inside, expected < 0.0):.2f}"
    )
    mask = mri.with_array(inside.astype(np.uint8)).along(given)
    if keep_at is not None:
        note = keep(keep_at, given, mask.array, found.method, seconds, warnings)
        _log.info("%s", note.text)
        warnings = warnings if note.is_beside else (*warnings, note.text)
    report(1.0)
    return BrainMask(mask, found.method, message, warnings, seconds)


def given_brain(mask: Volume, mri: Volume) -> BrainMask:
    """The mask that a user gives. Raises SimulationError if it is empty, on another grid, or covers everything.

    What looks like no whole brain, and tissue that it cuts off, are warnings: it may be what the user wants.
    """
    inside = checked_mask(mask, mri)
    millilitres = _millilitres(inside, mri)
    found = mri.with_array(inside.astype(np.uint8))
    warnings = (*label_doubts(mask), *mask_doubts(mri, inside))
    return BrainMask(found, "given", f"brain mask as given, {millilitres:.0f} ml", warnings)


def left_out(mask: Volume, lesion: Volume) -> float:
    """Share of a lesion's volume (non-zero voxels, on any grid) that a brain mask leaves out, 0 to 1.

    Raises SimulationError if the lesion is empty.
    """
    inside = lesion.array > 0
    require(bool(inside.any()), "lesion is empty, expected at least one voxel inside")
    return float((on_grid(mask.with_array(mask.array > 0), lesion)[inside] < 0.5).mean())


@dataclass(frozen=True, eq=False)
class _Extracted:
    inside: np.ndarray
    method: str
    warnings: tuple[str, ...] = ()


def _extracted(mri: Volume, expected: np.ndarray, method: str, report: Report) -> _Extracted:
    """The brain by `method`, or by the first of the available ones whose result has the volume of one.

    `expected` (k, j, i) is the distance to the aligned template's brain.
    """
    failures: list[str] = []
    for name in _candidates(method):
        try:
            inside = _by(name, mri, expected, report)
            millilitres = _millilitres(inside, mri)
            require(
                POSSIBLE_ML[0] <= millilitres <= POSSIBLE_ML[1],
                f"{_NAMES[name]} found {millilitres:.0f} ml, expected {USUAL_ML[0]:.0f} to {USUAL_ML[1]:.0f} ml",
            )
        except Cancelled:
            raise
        except SimulationError as error:
            failures.append(str(error))
            _log.warning("%s", error)
            continue
        return _Extracted(inside, name, tuple(failures))
    raise SimulationError(f"no brain was found in this head: {'; '.join(failures)}; give a brain mask (--mask)")


def _forwards(progress: Report | None) -> Report:
    """A progress that never goes back, when another method starts."""
    reached = 0.0

    def report(share: float) -> None:
        nonlocal reached
        reached = max(reached, share)
        if progress is not None:
            progress(reached)

    return report


def _candidates(method: str) -> list[str]:
    """Methods to try, in the order of their measured quality (docs/brain.md)."""
    if method != "auto":
        return [method]
    available = {"deepbet": extractors.has_deepbet(), "robex": extractors.robex_folder() is not None}
    return ["atlas", *(name for name, is_available in available.items() if is_available)]


def _by(name: str, mri: Volume, expected: np.ndarray, report: Report) -> np.ndarray:
    """(k, j, i) the brain by one method, with its border moved to the dark valley outside the cortex."""
    if name == "atlas":
        return refined(mri, expected, core_mm=8.0, reach_mm=12.0, keep_mm=3.0)
    program = extractors.robex if name == "robex" else extractors.deepbet
    inside = program(mri, lambda share: report(0.9 * share))
    require(bool(inside.any()), f"{_NAMES[name]} found no brain")
    distance = signed_distance(inside, mri.spacing_mm, 20.0)
    return refined(mri, distance, core_mm=6.0, reach_mm=12.0, keep_mm=2.0)


def _dice(one: np.ndarray, other: np.ndarray) -> float:
    return float(2.0 * (one & other).sum() / max(int(one.sum()) + int(other.sum()), 1))


def _kept(path: Path, mri: Volume, method: str) -> BrainMask | None:
    kept = read_kept(path, mri, method)
    if kept is None:
        return None
    millilitres = _millilitres(kept.inside, mri)
    if kept.is_edited:
        message = f"whole head: brain mask as edited in {kept.path}, {millilitres:.0f} ml"
        if method not in ("auto", "none"):
            message += (
                f"; --skull-strip {method} was not followed: delete or rename that file to extract the brain again"
            )
    else:
        by = _NAMES.get(kept.method, kept.method)
        message = f"whole head: brain mask kept in {kept.path}, by {by} in {kept.seconds:.0f} s, {millilitres:.0f} ml"
    mask = mri.with_array(kept.inside.astype(np.uint8))
    if not kept.is_edited:
        return BrainMask(mask, kept.method, message, kept.warnings, 0.0)
    return BrainMask(mask, "given", message, mask_doubts(mri, kept.inside))


def _millilitres(inside: np.ndarray, grid: Volume) -> float:
    return float(inside.sum() * grid.voxel_ml)
