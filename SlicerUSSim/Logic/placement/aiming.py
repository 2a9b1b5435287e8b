"""Aim of a probe in a craniotomy: from the middle of the opening at a lesion, if there is one below it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.pathology import ENHANCING, LESION_GROUPS, innermost_ras
from SlicerUSSim.Logic.placement.craniotomy import face_width_mm, without_outside
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.poses import aimed_at, craniotomy_pose, sample
from SlicerUSSim.Logic.probe.surface import PatientSurface
from SlicerUSSim.Logic.tissue.names import labels_of

#: A probe is turned so far from the surface's normal at most, degrees: farther, most of its face would be off the brain
FARTHEST_DEG = 35.0
#: Smaller regions are specks of a segmentation, ml
_LEAST_ML = 0.05
#: The edge of a turned face may press the brain in so far, mm, or as far as without the turn
_PRESSED_MM = 2.0


def opening_pose(
    labels: Volume, names: Sequence[str], probe: Probe, opening_ras: np.ndarray, target_ras: np.ndarray | None = None
) -> tuple[np.ndarray, str]:
    """((4, 4) probe_to_ras, a line about it) on the brain of labels 1, 2, ... called `names`, in an opening.

    The middle of the face stands where the surface of the brain is nearest to `opening_ras` (3,) mm, the middle of the
    opening. Its axis goes to `target_ras`, or else to the innermost voxel of the largest lesion, if that is up to
    FARTHEST_DEG off the surface's normal; the face is then drawn back along its axis until its edge lies on the
    surface. Otherwise it is the normal. The line is "" without a lesion.
    """
    ground = without_outside(labels, names)
    surface = PatientSurface(ground)
    start = craniotomy_pose(ground, probe, target_ras=target_ras)
    pose = surface.slid(start, surface.nearest(opening_ras))
    targets = lesions(labels, names) if target_ras is None else [(np.asarray(target_ras, float), "")]
    targets = [(place, name or _name_at(labels, names, place)) for place, name in targets]
    if not targets:
        return pose, ""
    seen = [(place, name) for place, name in targets if _off_axis_deg(pose, place) <= FARTHEST_DEG]
    if seen:
        place, name = seen[0]
        angle = _off_axis_deg(pose, place)
        return on_surface(aimed_at(pose, place), pose, probe, surface), (
            f"aimed at the {name}, {angle:.0f} degrees off the surface's normal"
        )
    place, name = min(targets, key=lambda target: _off_axis_deg(pose, target[0]))
    across, depth, up = (np.linalg.inv(pose) @ [*place, 1.0])[:3]
    if depth > 0.0 and np.hypot(across, up) <= 0.5 * face_width_mm(probe):
        return pose, f"the {name} lies in front of the face"
    return pose, (
        f"not aimed at the {name}, which is {_off_axis_deg(pose, place):.0f} degrees off the surface's normal at the "
        f"opening, more than {FARTHEST_DEG:.0f}"
    )


def lesions(labels: Volume, names: Sequence[str]) -> list[tuple[np.ndarray, str]]:
    """((3,) RAS mm of the innermost voxel, most frequent tissue) of the lesions in labels, the largest first."""
    for group in LESION_GROUPS:
        parts, _ = ndimage.label(np.isin(labels.array, labels_of(names, group)))  # type: ignore[misc]
        if ENHANCING in group:
            parts = _without_veins(parts, labels, names)
        sizes, boxes, found = np.bincount(parts.ravel())[1:], ndimage.find_objects(parts), []
        for number in np.argsort(-sizes, kind="stable"):
            if sizes[number] * labels.voxel_ml < _LEAST_ML:
                break
            box = boxes[number]
            where = parts[box] == number + 1
            tissue = names[int(np.bincount(labels.array[box][where]).argmax()) - 1]
            found.append((innermost_ras(where, labels, [part.start for part in box]), tissue))
        if found:
            return found
    return []


def _without_veins(parts: np.ndarray, labels: Volume, names: Sequence[str]) -> np.ndarray:
    """The numbered parts, 0 where all of one is what enhances: veins and choroid plexus."""
    others = (labels.array != names.index(ENHANCING) + 1) if ENHANCING in names else np.ones(parts.shape, bool)
    kept = np.zeros(parts.max() + 1, bool)
    kept[np.unique(parts[others])] = True
    return np.where(kept[parts], parts, 0)


def _name_at(labels: Volume, names: Sequence[str], place: np.ndarray) -> str:
    label = int(sample(labels, place[None], order=0)[0])
    return names[label - 1] if label else "target"


def _off_axis_deg(pose: np.ndarray, place: np.ndarray) -> float:
    """Angle between the axis of a probe and the direction from its face to a place."""
    way = place - pose[:3, 3]
    return float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(pose[:3, 1], way)), pose[:3, 1] @ way)))


def on_surface(turned: np.ndarray, upright: np.ndarray, probe: Probe, surface: PatientSurface) -> np.ndarray:
    """A turned probe, drawn back along its axis so that no edge of its face is pressed into the surface."""
    allowed, pose = max(_PRESSED_MM, _pressed_mm(upright, probe, surface)), turned.copy()
    for _ in range(4):  # the surface is curved
        excess = _pressed_mm(pose, probe, surface) - allowed
        if excess < 0.1:
            break
        pose[:3, 3] -= pose[:3, 1] * excess / np.cos(np.deg2rad(FARTHEST_DEG))
    return pose


def _pressed_mm(pose: np.ndarray, probe: Probe, surface: PatientSurface) -> float:
    """How deep the deepest point of a face is below a surface; negative above it."""
    across = probe.face_points_mm(np.linspace(-0.5, 0.5, 9) * probe.face_mm)
    points = across[None] + np.array([-0.5, 0.0, 0.5])[:, None, None] * [0.0, 0.0, probe.elevation_aperture_mm]
    depths = []
    for point in points.reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]:
        nearest = surface.nearest(point)
        depths.append(float((nearest - point) @ surface.normal(nearest)))
    return max(depths)
