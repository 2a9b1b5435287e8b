"""Planning the approach to a target: from where a probe sees it, what lies on the way, and what is to be opened.

Straight ways from all directions are compared by a cost in millimetres (docs/approach.md): the lower, the better.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import either, require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.pathology import LESIONS, tissue_to_add
from SlicerUSSim.Logic.placement.aiming import FARTHEST_DEG, largest_lesion, on_surface
from SlicerUSSim.Logic.placement.approach_weights import ApproachWeights
from SlicerUSSim.Logic.placement.bone_before_probe import SKULL
from SlicerUSSim.Logic.placement.craniotomy import (
    ROOM_MM,
    disc_opening,
    face_width_mm,
    opened,
    require_brain,
    without_outside,
)
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.poses import pose_looking_at, sample
from SlicerUSSim.Logic.probe.surface import PatientSurface
from SlicerUSSim.Logic.tissue.names import labels_of

#: Names of the parts of a way that no tissue has: fluid near the surface, and deep in the brain
SULCI, VENTRICLE = "sulci", "ventricle or cistern"
_FLUID, _VESSELS = ("csf", "leptomeninges"), ("blood", "enhancing")
#: Fluid is that of sulci up to so far below the brain's surface, mm
_SULCUS_MM = 15.0
#: A point that is chosen as the target, where no lesion is labelled, stands for a ball of this radius, mm
_POINT_MM = 3.0
_STEP_MM, _LONGEST_MM = 0.5, 250.0
#: The skin is so far from the end of the image at least, mm
_CUT_MM = 2.0
#: Ways with more outside the brain lead through face or neck, mm, as do those from below (cosine to the top of the
#: head) that do not come from behind (to its front)
_THICKEST_MM, _BELOW, _BEHIND = 35.0, -0.5, -0.4
#: Falx and sagittal sinus are nearer to the middle plane than this, mm
_MIDDLE_MM = 4.0
#: A probe is tilted so far at most; a disc is so much wider than the face at most, and keeps so much room on each side
_TILT_DEG, _WIDEST_MM, _CLEAR_MM = 35.0, 15.0, 2.0
#: Share of all directions in which the surface is met from a place within it
_FROM_INSIDE = 0.9
#: Voxels that stand for a target, and places on the line to each that are looked at
_VOXELS, _LOOKS = 150, 20
#: Candidates stand so far apart that their openings hardly overlap, mm
_APART_MM = 25.0


@dataclass(frozen=True, eq=False)
class Target:
    """What is to be seen."""

    #: "tumour", or "point"
    name: str
    #: (n, 3) RAS mm, places that fill it evenly, and their middle
    points_ras: np.ndarray = field(repr=False)
    centre_ras: np.ndarray
    volume_ml: float
    #: Of its extents along R, A and S the largest
    size_mm: float
    #: Of its uppermost point below the nearest place of the brain's surface
    depth_mm: float
    #: 1 in it
    region: Volume = field(repr=False)

    def holds(self, points_ras: np.ndarray) -> np.ndarray:
        """(...) bool: whether (..., 3) places are in it."""
        return sample(self.region, points_ras, order=0) > 0

    @property
    def text(self) -> str:
        """Its size and depth in words."""
        volume = f"{self.volume_ml:.1f}" if self.volume_ml >= 0.1 else f"{self.volume_ml:.2g}"
        return f"{self.name}: {self.size_mm:.0f} mm, {volume} ml, {self.depth_mm:.0f} mm below the brain's surface"


@dataclass(frozen=True, eq=False)
class Candidate:
    """A way to the target, and how a probe sees it from there."""

    #: (4, 4) of the probe, with its face on the brain
    probe_to_ras: np.ndarray = field(repr=False)
    #: (3,) RAS mm where the way begins on the skin, or on the brain without a head
    entry_ras: np.ndarray
    #: {tissue: mm} from there to the target; SULCI and VENTRICLE are fluid
    path_mm: Mapping[str, float]
    #: From the brain's surface to the target
    depth_mm: float
    #: Between the probe's axis and the normal of the brain's surface
    angle_deg: float
    #: Shares of the target, 0 to 1: in the field of a probe that is tilted in the opening, and in the focal zone
    seen: float
    focused: float
    #: Tilt to both sides that this takes, and diameter of the disc that is to be opened; 0 without a skull
    tilt_deg: float
    opening_mm: float
    #: {weight: its part of the cost}
    costs: Mapping[str, float]
    #: Mean echo of the target above that of the brain around it, and the image (rows, columns) uint8; None before they
    #: are simulated
    contrast_db: float | None = None
    image: np.ndarray | None = field(default=None, repr=False)

    @property
    def cost(self) -> float:
        """In millimetres; the lower, the better."""
        return sum(self.costs.values())

    @property
    def text(self) -> str:
        """One line."""
        path = ", ".join(f"{name} {mm:.0f}" for name, mm in self.path_mm.items() if mm >= 1.0)
        contrast = "" if self.contrast_db is None else f"; contrast {self.contrast_db:+.0f} dB"
        disc = f"; disc of {self.opening_mm:.0f} mm" if self.opening_mm else ""
        return (
            f"{_place(self.entry_ras)}: {100 * self.seen:.0f} % "
            f"seen, {100 * self.focused:.0f} % in focus, {self.angle_deg:.0f}° to the surface; mm on the way: "
            f"{path or 'none'}{disc}{contrast}; cost {self.cost:.0f}"
        )


@dataclass(frozen=True, eq=False)
class Approach:
    """The best candidates, the first before the others."""

    target: Target
    candidates: tuple[Candidate, ...]
    #: Number of ways that were compared
    compared: int


def _place(ras: np.ndarray) -> str:
    """In words; a value that is almost 0 has no sign."""
    return ", ".join(f"{axis} {round(mm) + 0.0:.0f}" for axis, mm in zip("RAS", ras.tolist(), strict=True))


def plan_approach(
    labels: Volume,
    names: Sequence[str],
    probe: Probe,
    what: str | Sequence[float] | Volume | None = None,
    *,
    weights: ApproachWeights | None = None,
    compared: int = 500,
    offered: int = 3,
) -> Approach:
    """Compare straight ways to a target, and return the best few, which are at least 25 mm apart.

    Parameters
    ----------
    labels : 1, 2, ... called `names`, of a closed head or of a brain alone.
    what : the target, see find_target; errors as there.
    weights : of the cost.
    compared, offered : numbers of ways, evenly from all directions, and of candidates at most.

    The face of the probe stands on the brain. Without a head nothing is opened, and entries are on the brain. Planned
    in a second; imaging.approach_images adds images and contrasts. It is a simulation and no medical advice.
    """
    require_brain(names)
    weights = weights or ApproachWeights()
    ground = without_outside(labels, names)
    surface = PatientSurface(ground)
    target = find_target(labels, names, what, surface)
    outward = _directions(compared)
    entries = [surface.hit(target.centre_ras + _LONGEST_MM * way, target.centre_ras) for way in outward]
    met = np.array([entry is not None for entry in entries])
    wrong = f"the {target.name} lies outside of the brain's surface, expected a target in the brain"
    require(met.mean() > _FROM_INSIDE, wrong)
    outward, faces = outward[met], np.array([entry for entry in entries if entry is not None])
    normals = np.array([surface.normal(face) for face in faces])
    ways = _Ways(labels, names, target, outward, faces, surface)
    poses = np.array([_aimed(face, target) for face in faces])
    angles = np.rad2deg(np.arccos(np.clip((outward * normals).sum(axis=1), -1.0, 1.0)))
    bone = ways.millimetres(SKULL)
    allowed = np.minimum(np.rad2deg(np.arctan2(0.5 * _WIDEST_MM - _CLEAR_MM, bone)), _TILT_DEG)
    seen, focused, _ = _views(probe, target, poses, allowed, labels, names)
    costs = _costs(weights, ways, angles, seen, focused)
    has_skull = bool(np.isin(labels.array, labels_of(names, SKULL)).any())
    from_below = (np.minimum(outward[:, 2], normals[:, 2]) < _BELOW) & (normals[:, 1] > _BEHIND)
    is_shut = has_skull & ((bone == 0.0) | ways.are_cut)  # where the image cuts the head
    unusual = from_below | is_shut | (ways.outside_mm > _THICKEST_MM) | (angles > FARTHEST_DEG)
    total = np.sum(list(costs.values()), axis=0) + np.where(unusual, np.inf, 0.0)
    if unusual.all():  # then the best of these, alone
        total, offered = np.sum(list(costs.values()), axis=0), 1
    candidates = []
    for number in _apart(faces, total, offered):
        pose = on_surface(poses[number], surface.slid(poses[number], faces[number]), probe, surface)
        views = _views(probe, target, pose[None], allowed[[number]], labels, names)
        share, sharp, needed = (float(each[0]) for each in views)
        room = 2.0 * (_CLEAR_MM + bone[number] * np.tan(np.deg2rad(needed)))
        disc = face_width_mm(probe) + float(np.clip(room, ROOM_MM, _WIDEST_MM))
        parts = {name: float(part[number]) for name, part in costs.items()}
        parts["unseen"] = 100.0 * weights.unseen_weight * (1.0 - share)  # which the place of the face changes
        parts["unfocused"] = 100.0 * weights.unfocused_weight * (1.0 - sharp)
        candidates.append(
            Candidate(
                pose, ways.starts[number], ways.path(number), float(ways.inside_mm[number]), float(angles[number]),
                share, sharp, needed, disc if bone[number] else 0.0, parts,
            )
        )  # fmt: skip
    return Approach(target, tuple(sorted(candidates, key=lambda candidate: candidate.cost)), len(outward))


def _apart(faces: np.ndarray, total: np.ndarray, count: int) -> list[int]:
    """Numbers of the `count` best places (n, 3) by a finite cost (n,), so far apart that openings hardly overlap."""
    chosen: list[int] = []
    for number in np.argsort(total, kind="stable"):
        if len(chosen) == count or not np.isfinite(total[number]):
            break
        if all(np.linalg.norm(faces[number] - faces[other]) >= _APART_MM for other in chosen):
            chosen.append(int(number))
    return chosen


def opened_for(labels: Volume, names: Sequence[str], candidates: Iterable[Candidate]) -> Volume:
    """The labels with the openings of candidates; those of a brain alone as they are. Errors as craniotomy.opened."""
    discs = [
        disc_opening(labels, names, candidate.probe_to_ras, candidate.opening_mm)
        for candidate in candidates
        if candidate.opening_mm
    ]
    return opened(labels, names, np.any(discs, axis=0))[0] if discs else labels


# ---- the target ------------------------------------------------------------------------------------------------------


def find_target(
    labels: Volume, names: Sequence[str], what: str | Sequence[float] | Volume | None = None,
    surface: PatientSurface | None = None,
) -> Target:  # fmt: skip
    """The target among labels 1, 2, ... called `names`.

    `what` is a tissue, of which it is the largest region; a point (3,) RAS mm, the lesion there or a ball of 3 mm
    around it; a mask on any grid, not 0 inside; or None, the largest lesion. `surface` is that of the brain. Raises
    SimulationError if there is no lesion, for an unknown tissue, and for a target outside the head.
    """
    require_brain(names)
    surface = surface or PatientSurface(without_outside(labels, names))
    name, inside, grid = "target", np.zeros(0, bool), labels
    if isinstance(what, Volume):
        grid, inside = what, _largest_part(np.nan_to_num(what.array) != 0)
        require(inside.any(), "the mask of the target is empty, expected voxels inside")
    elif what is None or isinstance(what, str):
        name, inside = _labelled_target(labels, names, what)
    else:
        point = np.asarray(what, float)
        require(point.shape == (3,) and np.isfinite(point).all(), f"the target is {what}, expected R, A, S in mm")
        label = int(sample(labels, point[None], order=0)[0])
        name = names[label - 1] if label and names[label - 1] in LESIONS else "point"
        if name != "point":
            parts, _ = ndimage.label(labels.array == label)  # type: ignore[misc]
            inside = parts == int(sample(labels.with_array(parts), point[None], order=0)[0])
    if name == "point":
        grid, inside = _ball(point)
    places = np.argwhere(inside)
    points, voxel_ml = places[:, ::-1] @ grid.ijk_to_ras[:3, :3].T + grid.ijk_to_ras[:3, 3], grid.voxel_ml
    centre, size = points.mean(axis=0), np.ptp(points, axis=0).max() + np.cbrt(1000.0 * voxel_ml)
    volume = len(points) * voxel_ml
    if len(points) > _VOXELS:  # those on a coarser grid
        step = int(np.ceil(np.cbrt(len(points) / _VOXELS)))
        on_grid = (places % step == 0).all(axis=1)
        points = points[on_grid] if on_grid.any() else points[:: step**3]
    is_in = sample(labels, points, order=0) > 0
    where = f"the {name} about {_place(centre)} mm lies outside of the head, expected a target in it"
    require(is_in.mean() >= 0.5, where)
    depth, region = float(surface.distances_mm(points).min()), grid.with_array(inside.astype(np.uint8))
    return Target(name, points, centre, float(volume), float(size), depth, region)


def _labelled_target(labels: Volume, names: Sequence[str], wanted: str | None) -> tuple[str, np.ndarray]:
    """(name, (k, j, i) bool) of the largest region of a tissue, or of the largest lesion."""
    if wanted is not None:
        name = tissue_to_add(wanted, names)
        inside = np.isin(labels.array, labels_of(names, (name,)))
        there = [lesion for lesion in dict.fromkeys(names) if lesion in LESIONS]
        hint = f"expected {either(there)}" if there else "expected a lesion; add one (--add tumour=mask.nii.gz)"
        require(inside.any(), f"the labels have no {name}, {hint}")
        return name, _largest_part(inside)
    found = largest_lesion(labels, names)
    require(found is not None, "the labels have no lesion, expected one; add one (--add tumour=mask.nii.gz)")
    return found  # type: ignore[return-value]


def _largest_part(inside: np.ndarray) -> np.ndarray:
    parts, count = ndimage.label(inside)  # type: ignore[misc]
    if count < 2:
        return inside
    return parts == np.bincount(parts.ravel())[1:].argmax() + 1


def _ball(centre_ras: np.ndarray) -> tuple[Volume, np.ndarray]:
    """(a grid of 1 mm, (k, j, i) bool) of a ball for a point."""
    axis = np.arange(-_POINT_MM - 1.0, _POINT_MM + 1.5)
    matrix = np.eye(4)
    matrix[:3, 3] = centre_ras + axis[0]
    away = np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis), axis=-1), axis=-1)
    return Volume(away.astype(np.float32), matrix), away <= _POINT_MM


# ---- ways ------------------------------------------------------------------------------------------------------------


class _Ways:
    """The tissues on straight ways from the target outwards, one for each direction.

    Parameters
    ----------
    outward, faces : (n, 3) unit vectors from the target, and where they leave the brain, RAS mm.
    """

    def __init__(
        self, labels: Volume, names: Sequence[str], target: Target, outward: np.ndarray, faces: np.ndarray,
        surface: PatientSurface,
    ) -> None:  # fmt: skip
        distance = np.arange(0.0, _LONGEST_MM, _STEP_MM)
        points = target.centre_ras + distance[:, None] * outward[:, None]
        found = sample(labels, points, order=0).astype(int)
        steps = np.arange(len(distance))
        to_face = np.linalg.norm(faces - target.centre_ras, axis=1)
        first = np.where(target.holds(points), steps, 0).max(axis=1)
        last = np.minimum(np.where(found > 0, steps, 0).max(axis=1), len(distance) - 5)
        self._labels = np.where((steps > first[:, None]) & (steps <= last[:, None]), found, 0)
        in_brain = distance < to_face[:, None]
        self.inside_mm = np.maximum(to_face - distance[first], 0.0)
        self.outside_mm = np.maximum(distance[last] - to_face, 0.0)
        self.starts = target.centre_ras + np.maximum(distance[last], to_face)[:, None] * outward
        #: (n,) where the image ends before the head does
        beyond = np.take_along_axis(points, (last + int(_CUT_MM / _STEP_MM))[:, None, None], axis=1)[:, 0]
        ijk = beyond @ labels.ras_to_ijk[:3, :3].T + labels.ras_to_ijk[:3, 3]
        self.are_cut = ((ijk < 0.0) | (ijk > np.array(labels.array.shape[::-1]) - 1.0)).any(axis=1)
        # Fluid near the surface is another thing than deep fluid: it gets labels of its own
        fluid = np.isin(self._labels, labels_of(names, _FLUID))
        deep = fluid & (to_face[:, None] - distance > _SULCUS_MM)  # the surface is not farther than along the way
        deep[deep] = np.isinf(surface.distances_mm(points[deep], _SULCUS_MM))
        self._labels[fluid] = len(names) + 1
        self._labels[deep] = len(names) + 2
        self._all = (*names, SULCI, VENTRICLE)
        middle = surface.centre[0]
        side = target.centre_ras[0] - middle
        is_there = in_brain & (self._labels > 0) & ((points[..., 0] - middle) * np.sign(side) < _MIDDLE_MM)
        self.other_side_mm = is_there.sum(axis=1) * _STEP_MM * (abs(side) > _MIDDLE_MM)

    def millimetres(self, wanted: Sequence[str]) -> np.ndarray:
        """(n,) of these tissues."""
        return np.isin(self._labels, labels_of(self._all, wanted)).sum(axis=1) * _STEP_MM

    def path(self, number: int) -> dict[str, float]:
        """{tissue: mm} of a way, in the order from outside."""
        labels = self._labels[number][::-1]
        order = dict.fromkeys(self._all[label - 1] for label in labels[labels > 0])
        return {name: float(self.millimetres((name,))[number]) for name in order}


def _directions(count: int) -> np.ndarray:
    """(count, 3) unit vectors, evenly from all directions: a spiral of Fibonacci."""
    place = np.arange(count) + 0.5
    up, turn = 1.0 - 2.0 * place / count, np.pi * (1.0 + np.sqrt(5.0)) * place
    flat = np.sqrt(1.0 - up**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), up], axis=1)


def _aimed(face: np.ndarray, target: Target) -> np.ndarray:
    """(4, 4) of a probe: the right of the image is that of the patient, or the back where it looks from the side."""
    depth = target.centre_ras - face
    from_side = abs(depth[0]) > 0.8 * np.linalg.norm(depth)
    return pose_looking_at(face, target.centre_ras, (0.0, -1.0, 0.0) if from_side else (1.0, 0.0, 0.0))


def _views(
    probe: Probe, target: Target, poses: np.ndarray, allowed_deg: np.ndarray, labels: Volume, names: Sequence[str]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(share seen, share seen in the focal zone, tilt for that in degrees), each (n,), of poses (n, 4, 4).

    The probe is tilted about the lateral axis of its face by up to `allowed_deg` (n,). The focal zone is that within
    half of the depth of field, 3.5 wavelengths times the square of the f-number, of the focus. What lies behind bone or
    air in the brain is not seen.
    """
    to_probe = np.linalg.inv(poses)
    x, y, z = np.moveaxis(target.points_ras @ np.swapaxes(to_probe[:, :3, :3], 1, 2) + to_probe[:, None, :3, 3], -1, 0)
    shares, faces = np.linspace(0.05, 0.97, _LOOKS)[:, None, None], poses[:, None, :3, 3]
    between = sample(labels, faces + shares[..., None] * (target.points_ras - faces), order=0)
    half = 0.5 * (face_width_mm(probe) + ROOM_MM)
    is_opened = (shares * np.hypot(x, z) <= half) & (shares * y <= half)  # bone there is removed
    is_clear = ~(np.isin(between, labels_of(names, (*SKULL, "air"))) & ~is_opened).any(axis=0)
    tilt, depth = np.abs(np.rad2deg(np.arctan2(z, y))), np.hypot(y, z)
    # A slice has a thickness, in which a place is seen without a tilt
    thick = 0.5 * probe.elevation_aperture_mm
    tilt = np.where((np.abs(z) <= thick) & (y > 0.0), 0.0, tilt)
    is_seen = is_clear & probe.holds(x, depth) & (tilt <= allowed_deg[:, None])
    zone = 3.5 * probe.wavelength_mm * (probe.focus_mm / probe.aperture_mm) ** 2
    in_focus = is_seen & (np.abs(depth - probe.focus_mm) <= zone)
    return is_seen.mean(axis=1), in_focus.mean(axis=1), np.where(is_seen, tilt, 0.0).max(axis=1)


def _costs(
    weights: ApproachWeights, ways: _Ways, angles: np.ndarray, seen: np.ndarray, focused: np.ndarray
) -> dict[str, np.ndarray]:
    """{weight: (n,) its part of the cost}."""
    amounts = {
        "brain": ways.inside_mm, "outside": ways.outside_mm, "ventricle": ways.millimetres((VENTRICLE,)),
        "vessel": ways.millimetres(_VESSELS), "air": ways.millimetres(("air",)), "other_side": ways.other_side_mm,
        "angle": angles, "unseen": 100.0 * (1.0 - seen), "unfocused": 100.0 * (1.0 - focused),
    }  # fmt: skip
    return {name: getattr(weights, f"{name}_weight") * amount for name, amount in amounts.items()}
