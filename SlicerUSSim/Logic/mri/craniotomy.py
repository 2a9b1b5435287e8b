"""Craniotomy: an opening in what lies outside the brain, through which a beam reaches it.

Skin, scalp, skull and marrow in the opening become the coupling medium, as saline fills it in an operation. The brain,
what was laid over it, and air stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.files import read_json
from SlicerUSSim.Logic.base.transforms import LPS_TO_RAS
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.outside import OUTSIDE
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.placement import craniotomy_pose, sample
from SlicerUSSim.Logic.probe.surface import PatientSurface

#: What an opening removes
REMOVED = tuple(name for name in OUTSIDE if name != "air")
#: An opening reaches this far below the brain's surface in its middle, times its half-width: the surface is curved
_BELOW = 1.0
#: A face needs so much more room than it is wide, mm
ROOM_MM = 10.0


def without_outside(labels: Volume, names: Sequence[str]) -> Volume:
    """The labels, 1, 2, ... called `names`, without what lies outside the brain."""
    return labels.with_array(np.where(_is_any(labels, names, OUTSIDE), 0, labels.array))


def disc_opening(labels: Volume, names: Sequence[str], probe_to_ras: np.ndarray, diameter_mm: float) -> np.ndarray:
    """(k, j, i) bool: a cylinder about the axis of a probe at this pose (4, 4), from outside to the brain.

    Raises SimulationError if there is no brain under it.
    """
    places = _in_probe(labels, probe_to_ras)
    across = np.hypot(places[..., 0], places[..., 2])
    within = across <= 0.5 * diameter_mm
    return within & (places[..., 1] < _deepest(labels, names, within, places[..., 1], 0.5 * diameter_mm))


def polygon_opening(labels: Volume, names: Sequence[str], points_ras: np.ndarray) -> np.ndarray:
    """(k, j, i) bool: the prism over a polygon of (points, 3) RAS mm, along the normal of its plane.

    Raises SimulationError for fewer than three points, points on a line, and if there is no brain under it.
    """
    from skimage.measure import points_in_poly

    require(len(points_ras) >= 3, f"the polygon has {len(points_ras)} points, expected three or more")
    middle = points_ras.mean(axis=0)
    _, sizes, axes = np.linalg.svd(points_ras - middle)
    require(sizes[1] > 1e-3 * sizes[0], "the points of the polygon lie on a line, expected an area")
    brain = np.argwhere(without_outside(labels, names).array > 0)
    require(brain.size > 0, "the labels have no brain, expected one under the craniotomy")
    centre = labels.ijk_to_ras[:3] @ np.append(brain.mean(axis=0)[::-1], 1.0)
    inward = axes[2] * np.sign(axes[2] @ (centre - middle) or 1.0)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([axes[0], inward, np.cross(axes[0], inward)], axis=1)
    pose[:3, 3] = middle
    places = _in_probe(labels, pose)
    outline = (points_ras - middle) @ pose[:3, [0, 2]]
    inside = points_in_poly(places[..., [0, 2]].reshape(-1, 2), outline).reshape(labels.array.shape)
    radius = 0.5 * float(np.ptp(outline, axis=0).max())
    return inside & (places[..., 1] < _deepest(labels, names, inside, places[..., 1], radius))


def file_opening(labels: Volume, names: Sequence[str], path: str) -> np.ndarray:
    """(k, j, i) bool of a file: a mask (not 0 is open), or a markup of 3D Slicer (.mrk.json), a polygon of its points.

    Raises SimulationError for another file, and for a mask that is empty or lies elsewhere.
    """
    if Path(path).suffix.lower() == ".json":
        return polygon_opening(labels, names, _control_points(path))
    return mask_opening(labels, Volume.read(path), path)


def mask_opening(labels: Volume, mask: Volume, name: str) -> np.ndarray:
    """(k, j, i) bool of a mask on any grid (not 0 is open), called `name` in errors.

    Raises SimulationError for one that is empty or lies elsewhere.
    """
    k, j, i = np.indices(labels.array.shape)
    ras = np.stack([i, j, k], axis=-1) @ labels.ijk_to_ras[:3, :3].T + labels.ijk_to_ras[:3, 3]
    opening = sample(mask.with_array((mask.array != 0).astype(np.uint8)), ras, order=0) > 0
    require(bool(opening.any()), f"{name}: is empty, or lies outside of the patient, expected a mask of the opening")
    return opening


def disc_diameter_mm(probe: Probe) -> float:
    """Diameter of a disc through which a probe reaches the brain."""
    return max(probe.face_mm, probe.elevation_aperture_mm) + ROOM_MM


def default_pose(
    labels: Volume, names: Sequence[str], probe: Probe, *, is_open: bool = False,
    opening_ras: np.ndarray | None = None, target_ras: np.ndarray | None = None,
) -> np.ndarray:  # fmt: skip
    """(4, 4) probe_to_ras where a probe stands by default on labels 1, 2, ... called `names`.

    On a brain alone it is a view through a craniotomy (placement.craniotomy_pose), of `target_ras` if that is given; on
    a whole head the same, upright on the skin. With `is_open` it is on the brain, at `opening_ras` (3,), the middle of
    an opening, if that is given.
    """
    ground = without_outside(labels, names) if is_open else labels
    pose = craniotomy_pose(ground, probe, target_ras=target_ras)
    if opening_ras is not None:
        surface = PatientSurface(ground)
        return surface.slid(pose, surface.nearest(opening_ras))
    if not is_open and "skin" in names:  # a face that is oblique to the skin would stand in the bone
        surface = PatientSurface(labels)
        return surface.slid(pose, surface.nearest(pose[:3, 3]))
    return pose


def opened(labels: Volume, names: Sequence[str], opening: np.ndarray) -> tuple[Volume, float]:
    """(labels with the opening, ml that were removed).

    Raises SimulationError if nothing outside the brain lies in the opening.
    """
    removed = opening & _is_any(labels, names, REMOVED)
    require(
        bool(removed.any()),
        f"the craniotomy removes nothing, expected {', '.join(REMOVED)} in it; it is off the head, or --outside was "
        "not used",
    )
    return labels.with_array(np.where(removed, 0, labels.array)), float(removed.sum() * labels.voxel_ml)


def _is_any(labels: Volume, names: Sequence[str], which: Sequence[str]) -> np.ndarray:
    return np.isin(labels.array, [number for number, name in enumerate(names, 1) if name in which])


def _in_probe(labels: Volume, probe_to_ras: np.ndarray) -> np.ndarray:
    """(k, j, i, 3) float32 lateral, depth and elevational mm of all voxels."""
    k, j, i = np.indices(labels.array.shape, np.float32)
    matrix = (np.linalg.inv(probe_to_ras) @ labels.ijk_to_ras).astype(np.float32)
    return np.stack([i, j, k], axis=-1) @ matrix[:3, :3].T + matrix[:3, 3]


def _deepest(labels: Volume, names: Sequence[str], within: np.ndarray, depth: np.ndarray, radius_mm: float) -> float:
    """Depth in mm to which an opening reaches: that of the uppermost brain in it, and as far as the brain is curved."""
    brain = within & (without_outside(labels, names).array > 0)
    require(bool(brain.any()), "there is no brain under the craniotomy, expected one; move it or the probe")
    return float(depth[brain].min()) + _BELOW * radius_mm


def _control_points(path: str) -> np.ndarray:
    """(points, 3) RAS mm of the first markup of a .mrk.json file of 3D Slicer."""
    values = read_json(path)
    try:
        markup = values["markups"][0]
        points = np.array([point["position"] for point in markup["controlPoints"]], float).reshape(-1, 3)
    except (KeyError, IndexError, TypeError, ValueError):
        require(False, f"{path}: has no points, expected a markup of 3D Slicer (.mrk.json), such as a closed curve")
        raise
    return points if str(markup.get("coordinateSystem", "LPS")).upper() in ("RAS", "1") else points @ LPS_TO_RAS[:3, :3]
