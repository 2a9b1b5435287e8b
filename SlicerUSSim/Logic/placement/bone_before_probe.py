"""Bone between a probe and the brain: a face that does not fit an opening, and a skull that is closed before it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.poses import sample
from SlicerUSSim.Logic.tissue.names import BRAIN_TISSUES, OUTSIDE
from SlicerUSSim.Logic.tissue.tissue import Tissue

#: Tissues of the skull, which an opening removes
SKULL = ("skull", "cancellous bone")
#: Echoes from behind a skull that takes more from them, there and back, are lost in half of the usual dynamic range, dB
CLOSED_DB = 30.0
#: And they are dark where it takes this from half of the lines (a temple 17 dB at 2 MHz)
_DARK_DB = 22.0
#: Where less than this part of the lines that reach the brain pass, a skull is closed
_OPEN_SHARE = 0.1
#: A face does not fit where bone is before, or so near behind, that much of it, mm
_BEHIND_MM, _COVERED_MM = 10.0, 1.0
#: Depth of the search for brain in front of a face, mm
_BRAIN_MM = 60.0
_STEP_MM, _COVER_STEP_MM = 0.5, 1.0
_LINES = 33
#: An MRI shows a head if this share of the labels is unlabelled and bright, relative to the brain; voxels per sample
_HEAD, _BRIGHT, _SOME = 0.25, 0.35, 4
_BONE, _BRAIN = 1, 2


#: To open a skull under the probe
_OPEN_IT = "--craniotomy auto, disc:MM or a file; Open skull in 3D Slicer and on the page"


def about_bone(
    labels: Volume, names: Sequence[str], tissues: Iterable[Tissue], probe: Probe, probe_to_ras: np.ndarray, *,
    is_open: bool,
) -> tuple[str, ...]:  # fmt: skip
    """Lines about a probe at a pose (4, 4) on labels 1, 2, ... called `names`: bone before it, or a face that does not
    fit an opening. None where no skull is labelled, and of images that show the brain.

    `tissues` of the names. `is_open` says that the labels have an opening.
    """
    if "skull" not in names:
        return ()
    depth = np.arange(-_BRAIN_MM, 3.0, _COVER_STEP_MM)
    (kinds,) = _kinds_below(labels, names, probe_to_ras, np.zeros((1, 3)), depth)
    is_in_brain = bool((kinds[depth >= 0.0] == _BRAIN).any())  # a face that looks away from the skin is not
    bone_mm = (kinds[depth < 0.0] == _BONE).sum() * _COVER_STEP_MM if is_in_brain else 0.0
    if bone_mm >= _COVERED_MM:
        return (
            f"the probe is below the closed skull, with {bone_mm:.0f} mm of bone behind its face: open the skull "
            f"({_OPEN_IT}), or move the probe to the skin",
        )
    found = _bone_mm_and_db(labels, names, tissues, probe, probe_to_ras)
    if found is not None and (found[2] or not is_open):
        thick, loss, is_closed = found
        line = (
            f"the skull is closed in front of the probe, and {thick:.0f} mm of bone take {loss:.0f} dB from the echoes "
            "of the brain: "
        )
        if not is_closed:
            return (f"{line}expect a dark image; a craniotomy ({_OPEN_IT}) lets them through",)
        if is_open:
            return (
                f"{line}the opening is elsewhere (--pose auto is in it; the model of the removed piece shows where)",
            )
        through = "or image through the temple, with the probe transcranial at the view temporal (--pose temporal)"
        return (f"{line}open the skull ({_OPEN_IT}), {through}",)
    line = _misfit(labels, names, probe, probe_to_ras) if is_open else ""
    return (line,) if line else ()


def about_missing_skull(labels: Volume, names: Sequence[str], mri: Volume) -> tuple[str, ...]:
    """A line about an MRI of a whole head, in the frame of labels that have its brain but not its skull; or none."""
    if "skull" in names or not set(names) & set(BRAIN_TISSUES):
        return ()
    some = mri.array[(slice(None, None, _SOME),) * 3]
    places = _SOME * np.moveaxis(np.indices(some.shape)[::-1], 0, -1)  # (k, j, i, 3) i, j, k
    is_labelled = sample(labels, places @ mri.ijk_to_ras[:3, :3].T + mri.ijk_to_ras[:3, 3], order=0) > 0
    if not is_labelled.any():
        return ()
    around = (some > _BRIGHT * np.median(some[is_labelled])) & ~is_labelled
    if around.sum() < _HEAD * is_labelled.sum():
        return ()
    return (
        "no skull is labelled, so that images are as if it were open everywhere: to see what bone does, label the "
        "whole head (--outside)",
    )


def _bone_mm_and_db(
    labels: Volume, names: Sequence[str], tissues: Iterable[Tissue], probe: Probe, pose: np.ndarray
) -> tuple[float, float, bool] | None:
    """(Medians of bone in mm and of its two-way attenuation in dB over the lines to the brain, whether hardly any line
    passes); None where the brain is seen well."""
    positions = np.linspace(probe.first_line, -probe.first_line, _LINES)
    origin, direction = probe.line_at(positions)
    along = probe.line_starts_mm(positions)[:, None] + np.arange(0.0, probe.depth_mm, _STEP_MM)
    seen = _labels_at(labels, pose, origin[:, None] + along[..., None] * direction[:, None])
    kinds = _kinds(names)[seen]
    reached = (kinds == _BRAIN).any(axis=1)
    if not reached.any():
        return None
    before = _bone_before_brain(kinds)[reached]
    known = {tissue.name: tissue.attenuation_db_cm_mhz for tissue in tissues}
    per_mm = np.array([0.0, *(0.1 * known.get(name, 0.0) for name in names)]) * 2.0 * probe.frequency_mhz
    loss = (before * per_mm[seen[reached]]).sum(axis=1) * _STEP_MM
    is_closed = bool((loss < CLOSED_DB).mean() < _OPEN_SHARE)
    if not is_closed and np.median(loss) < _DARK_DB:
        return None
    return float(np.median(before.sum(axis=1)) * _STEP_MM), float(np.median(loss)), is_closed


def _misfit(labels: Volume, names: Sequence[str], probe: Probe, pose: np.ndarray) -> str:
    """A line about a face, the middle of which is in an opening, that bone covers in part; "" for others."""
    is_covered, sees_brain = _under(labels, names, pose, np.zeros((1, 3)))
    if is_covered[0] or not sees_brain[0]:  # most poses: looked up before the other places, since live images wait
        return ""
    lines = []
    count = 2 * int(np.ceil(probe.face_mm)) + 1
    across = probe.face_points_mm(np.linspace(-0.5, 0.5, count) * probe.face_mm)
    high = np.linspace(-0.5, 0.5, count)[:, None] * [0.0, 0.0, probe.elevation_aperture_mm]
    for points, size, side in ((across, probe.face_mm, "wide"), (high, probe.elevation_aperture_mm, "thick")):
        covered = float(_under(labels, names, pose, points)[0].mean() * size)
        if covered >= _COVERED_MM:
            lines.append((covered, size, side))
    if not lines:
        return ""
    covered, size, side = max(lines)
    return (
        f"the face of the probe is {size:.0f} mm {side} and does not fit the opening, which leaves "
        f"{size - covered:.0f} mm of it free: expect black sectors where it lies on bone or lifts off"
    )


def _under(labels: Volume, names: Sequence[str], pose: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(bone covers it, there is brain below), each (n,) bool, of (n, 3) places of a face."""
    depth = np.arange(-_BEHIND_MM, _BRAIN_MM, _COVER_STEP_MM)
    kinds = _kinds_below(labels, names, pose, points, depth)
    is_covered = _bone_before_brain(kinds).sum(axis=1) * _COVER_STEP_MM >= _COVERED_MM
    return is_covered, (kinds == _BRAIN).any(axis=1)


def _kinds_below(
    labels: Volume, names: Sequence[str], pose: np.ndarray, points: np.ndarray, depth: np.ndarray
) -> np.ndarray:
    """(n, depths) kinds at depths in mm, negative behind the face, below (n, 3) places of a face."""
    return _kinds(names)[_labels_at(labels, pose, points[:, None] + depth[:, None] * [0.0, 1.0, 0.0])]


def _kinds(names: Sequence[str]) -> np.ndarray:
    """(labels,) _BONE, _BRAIN or 0 of labels 0, 1, 2, ..."""
    return np.array([0, *(_BONE if name in SKULL else 0 if name in (*OUTSIDE, "") else _BRAIN for name in names)])


def _bone_before_brain(kinds: np.ndarray) -> np.ndarray:
    """(lines, places) bool: where lines meet bone before the brain, or anywhere if they do not reach it."""
    return (kinds == _BONE) & (np.cumsum(kinds == _BRAIN, axis=1) == 0)


def _labels_at(labels: Volume, pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Labels at (..., 3) points in the frame of a probe; 0 outside the volume."""
    return sample(labels, points @ pose[:3, :3].T + pose[:3, 3], order=0)
