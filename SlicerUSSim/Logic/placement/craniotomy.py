"""Craniotomy: an opening in the tissues outside the brain, through which a beam reaches it.

Skin, scalp, skull and marrow in the opening become the coupling medium, as saline fills it in an operation. The brain,
what was laid over it, and air stay.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.neighbourhood import distance_to
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.markups import is_markup_name, markup_points
from SlicerUSSim.Logic.mri.masks import read_mask, several_segments
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.poses import craniotomy_pose, sample
from SlicerUSSim.Logic.tissue.names import OUTSIDE, labels_of

_log = logging.getLogger(__name__)

#: What an opening removes
REMOVED = tuple(name for name in OUTSIDE if name != "air")
#: An opening reaches this far below the brain's surface in its middle, times its half-width: the surface is curved
_BELOW = 1.0
#: Where the brain may begin under the probe, or under a polygon, mm: a probe on the brain has the skull behind its face
_BRAIN_MM = (-40.0, 60.0)
#: Tissues of a head, and of a body but not of a head; fluid is in spines, too
_OF_BRAIN, _OF_BODY = ("grey matter", "white matter", "brain"), ("muscle", "bone", "liver", "kidney")
#: Markups of 3D Slicer whose points are a polygon
POLYGONS = ("ClosedCurve", "Curve", "Fiducial")
#: Diameters of discs, mm; and more than a craniotomy removes, ml
DIAMETERS_MM, _MOST_ML = (5.0, 150.0), 500.0
#: Half of what an opening removes must be so near to the brain, mm
_NEAR_BRAIN_MM = 30.0
#: A polygon that was drawn on the skin or the brain is so near to them, mm: half of its points
_NEAR_POLYGON_MM = 15.0
#: A face needs this much more room than it is wide, mm
ROOM_MM = 10.0


def without_outside(labels: Volume, names: Sequence[str]) -> Volume:
    """The labels, 1, 2, ... called `names`, without those outside the brain."""
    return labels.with_array(np.where(_is_any(labels, names, OUTSIDE), 0, labels.array))


def require_brain(names: Sequence[str]) -> None:
    """Raise SimulationError if tissues belong to a body without a brain, such as a spine or an abdomen."""
    require(
        not set(_OF_BRAIN).isdisjoint(names) or set(_OF_BODY).isdisjoint(names),
        f"the labels have no tissue of a brain (they have {', '.join(names)}), expected those of a head",
    )


def disc_opening(labels: Volume, names: Sequence[str], probe_to_ras: np.ndarray, diameter_mm: float) -> np.ndarray:
    """(k, j, i) bool: a cylinder about the axis of a probe at this pose (4, 4), from outside to the brain.

    Raises SimulationError for a diameter out of DIAMETERS_MM, and if there is no brain under the probe.
    """
    low, high = DIAMETERS_MM
    require(
        low <= diameter_mm <= high,
        f"the diameter of the craniotomy is {diameter_mm:g} mm, expected {low:g} to {high:g}",
    )
    places = _in_probe(labels, probe_to_ras)
    across = np.hypot(places[..., 0], places[..., 2])
    within = across <= 0.5 * diameter_mm
    return within & (places[..., 1] < _deepest(labels, names, within, places[..., 1], 0.5 * diameter_mm))


def polygon_opening(labels: Volume, names: Sequence[str], points_ras: np.ndarray) -> np.ndarray:
    """(k, j, i) bool: the prism over a polygon of (points, 3) RAS mm, along the normal of its plane.

    Raises SimulationError for fewer than three points, points on a line, sides that cross, and if there is no brain
    under it.
    """
    from skimage.measure import points_in_poly

    require(len(points_ras) >= 3, f"the number of points of the polygon is {len(points_ras)}, expected three or more")
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
    crossing = _crossing_sides(outline)
    if crossing is not None:
        first, second = (f"{side + 1} to {(side + 1) % len(outline) + 1}" for side in crossing)
        require(
            False,
            f"the sides of the polygon from point {first} and from point {second} cross, expected points in their "
            "order around the opening",
        )
    inside = points_in_poly(places[..., [0, 2]].reshape(-1, 2), outline).reshape(labels.array.shape)
    radius = 0.5 * float(np.ptp(outline, axis=0).max())
    deepest = _deepest(
        labels, names, inside, places[..., 1], radius, above="polygon", move="draw it on the scalp, around the opening"
    )
    filled = labels.array > 0
    patient = places[filled & ~np.asarray(ndimage.binary_erosion(filled), bool)]  # the nearest place is on the surface
    drawn = (points_ras - middle) @ pose[:3, :3]
    away = float(np.median([np.linalg.norm(patient - point, axis=1).min() for point in drawn]))
    if away > _NEAR_POLYGON_MM:
        _log.warning(
            "the points of the polygon lie %.0f mm from the patient, %.0f or less of one that was drawn there; the "
            "tissue below them is opened: check that it belongs to this patient", away, _NEAR_POLYGON_MM,
        )  # fmt: skip
    return inside & (places[..., 1] < deepest)


def file_opening(labels: Volume, names: Sequence[str], path: str) -> np.ndarray:
    """(k, j, i) bool of a file: a mask (not 0 is open), or points of 3D Slicer (.mrk.json), a polygon.

    Raises SimulationError for another file, and for a mask that is empty or lies elsewhere.
    """
    if is_markup_name(path):
        return polygon_opening(labels, names, polygon_of_file(path))
    return mask_opening(labels, read_mask(path), path)


def mask_opening(labels: Volume, mask: Volume, name: str) -> np.ndarray:
    """(k, j, i) bool of a mask on any grid (not 0 is open; above 1/2 of values from 0 to 1), called `name` in errors.

    Raises SimulationError for a volume that is not a mask, and for a mask that is empty or elsewhere.
    """
    k, j, i = np.indices(labels.array.shape)
    ras = np.stack([i, j, k], axis=-1) @ labels.ijk_to_ras[:3, :3].T + labels.ijk_to_ras[:3, 3]
    opening = sample(is_open(mask, name), ras, order=0) > 0
    require(bool(opening.any()), f"{name}: is empty, or lies outside of the patient, expected a mask of the opening")
    return opening


def is_open(mask: Volume, name: str) -> Volume:
    """A mask as uint8, 1 where it is open: not 0, or above 1/2 of values from 0 to 1; `name` as in errors.

    Raises SimulationError for a volume that is not a mask.
    """
    segments = several_segments(mask)
    require(
        not segments,
        f"{name}: holds the segments {segments}, expected a file with one segment, the opening: export that one alone",
    )
    values = np.unique(mask.array[np.isfinite(mask.array)])
    is_soft = bool(values.size) and float(values[0]) >= 0.0 and float(values[-1]) <= 1.0
    require(
        values.size <= 2 or is_soft,
        f"{name}: has {values.size} different values, expected a mask of the opening (0 and one other, or 0 to 1)",
    )
    inside = mask.array > 0.5 if is_soft else np.nan_to_num(mask.array) != 0
    return mask.with_array(inside.astype(np.uint8))


def face_width_mm(probe: Probe) -> float:
    """The larger side of a probe's face."""
    return max(probe.face_mm, probe.elevation_aperture_mm)


def disc_diameter_mm(probe: Probe) -> float:
    """Diameter of a disc through which a probe reaches the brain."""
    return face_width_mm(probe) + ROOM_MM


def default_pose(
    labels: Volume, names: Sequence[str], probe: Probe, *, is_open: bool = False, target_ras: np.ndarray | None = None
) -> np.ndarray:
    """(4, 4) probe_to_ras where a probe stands by default on labels 1, 2, ... called `names`.

    On a brain alone it is a view through a craniotomy (placement.craniotomy_pose), of `target_ras` if that is given; on
    a whole head the same, upright on the skin. With `is_open` it is on the brain, where a disc is opened under it; in
    an opening that is there it stands by aiming.opening_pose.
    """
    ground = without_outside(labels, names) if is_open else labels
    pose = craniotomy_pose(ground, probe, target_ras=target_ras)
    if not is_open and "skin" in names:  # a face that is oblique to the skin would stand in the bone
        from SlicerUSSim.Logic.probe.surface import PatientSurface  # a pose on a brain does not wait for VTK

        surface = PatientSurface(labels)
        return surface.slid(pose, surface.nearest(pose[:3, 3]))
    return pose


def opened(labels: Volume, names: Sequence[str], opening: np.ndarray) -> tuple[Volume, float]:
    """(labels with the opening, ml that were removed).

    Raises SimulationError if nothing outside the brain lies in the opening, and for labels without a brain.
    """
    require_brain(names)
    around = _is_any(labels, names, REMOVED)
    require(
        bool(around.any()),
        f"the labels have nothing of {', '.join(REMOVED)}, as those of a brain without its skull: there is nothing to "
        "open; leave the craniotomy out, or label the whole head (--outside)",
    )
    removed = opening & around
    require(
        bool(removed.any()),
        f"the craniotomy removes nothing, expected {', '.join(REMOVED)} in it; it is off the head or in the brain, or "
        "the image cuts the head there",
    )
    millilitres = float(removed.sum() * labels.voxel_ml)
    require(
        millilitres <= _MOST_ML,
        f"the craniotomy removes {millilitres:.0f} ml of skin and skull, expected {_MOST_ML:g} or less; is it "
        "the mask of an opening?",
    )
    brain = without_outside(labels, names).array > 0
    if brain.any():
        away = float(np.median(distance_to(brain, labels.spacing_mm)[removed]))
        require(
            away <= _NEAR_BRAIN_MM,
            f"what the craniotomy removes lies {away:.0f} mm from the brain, expected {_NEAR_BRAIN_MM:g} or less: it "
            "is not over the brain",
        )
    return labels.with_array(np.where(removed, 0, labels.array)), millilitres


def middle_of(before: Volume, after: Volume) -> np.ndarray:
    """(3,) RAS mm, the middle of the largest piece that an opening removed from labels."""
    parts, _ = ndimage.label(before.array != after.array)  # type: ignore[misc]
    largest = parts == np.bincount(parts.ravel())[1:].argmax() + 1
    return before.ijk_to_ras[:3] @ np.append(np.argwhere(largest).mean(axis=0)[::-1], 1.0)


def _is_any(labels: Volume, names: Sequence[str], which: Sequence[str]) -> np.ndarray:
    return np.isin(labels.array, labels_of(names, which))


def _in_probe(labels: Volume, probe_to_ras: np.ndarray) -> np.ndarray:
    """(k, j, i, 3) float32 lateral, depth and elevational mm of all voxels."""
    k, j, i = np.indices(labels.array.shape, np.float32)
    matrix = (np.linalg.inv(probe_to_ras) @ labels.ijk_to_ras).astype(np.float32)
    return np.stack([i, j, k], axis=-1) @ matrix[:3, :3].T + matrix[:3, 3]


def _deepest(
    labels: Volume, names: Sequence[str], within: np.ndarray, depth: np.ndarray, radius_mm: float, *,
    above: str = "probe", move: str = "move or turn the probe",
) -> float:  # fmt: skip
    """Depth in mm to which an opening reaches: that of the uppermost brain in it, and as far as the brain is curved.

    Depths count from what is `above` it; `move` is what to do if it is in a wrong place, in errors.
    """
    brain = within & (without_outside(labels, names).array > 0)
    require(bool(brain.any()), f"there is no brain under the craniotomy, expected one; {move}")
    begins = float(depth[brain].min())
    low, high = _BRAIN_MM
    require(
        begins <= high,
        f"there is no brain under the craniotomy within {high:g} mm (it begins {begins:.0f} mm below), expected one; "
        f"{move}",
    )
    require(
        begins >= low,
        f"the brain under the craniotomy begins {-begins:.0f} mm behind the {above}, which is in the head or looks out "
        f"of it, expected one before it; {move}",
    )
    return begins + _BELOW * radius_mm


def _crossing_sides(outline: np.ndarray) -> tuple[int, int] | None:
    """Numbers of the first two sides, from point n to n + 1, of a closed polygon (points, 2) that cross; or None."""
    start, end = outline, np.roll(outline, -1, axis=0)

    def turn(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        """Sign of the turn from a by b to c; 0 on a line."""
        (ux, uy), (vx, vy) = np.moveaxis(b - a, -1, 0), np.moveaxis(c - a, -1, 0)
        return np.sign(ux * vy - uy * vx)

    a, b, c, d = start[:, None], end[:, None], start[None], end[None]
    crosses = (turn(a, b, c) * turn(a, b, d) < 0) & (turn(c, d, a) * turn(c, d, b) < 0)
    found = np.argwhere(np.triu(crosses))
    return None if not len(found) else (int(found[0, 0]), int(found[0, 1]))


def polygon_of_file(path: str) -> np.ndarray:
    """(points, 3) RAS mm of the points in a file of 3D Slicer (.mrk.json), which are a polygon.

    Raises SimulationError for another file, and for several markups, another kind, frame or unit.
    """
    kind, points = markup_points(path, POLYGONS, "a closed curve")
    if kind == "Curve":
        _log.warning("%s: is an open curve; the polygon is closed from its last point to its first", path)
    return points
