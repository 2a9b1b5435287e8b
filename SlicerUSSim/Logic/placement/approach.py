"""Planning the approach to a target: the probe's position, the tissue on the path, and the opening.

Straight paths from all directions are compared by a cost in millimetres (docs/approach.md): the lower, the better.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.pathology import LESION_GROUPS, tissue_to_add
from SlicerUSSim.Logic.placement.aiming import FARTHEST_DEG, lesions, on_surface
from SlicerUSSim.Logic.placement.approach_weights import ApproachWeights
from SlicerUSSim.Logic.placement.bone_before_probe import SKULL
from SlicerUSSim.Logic.placement.craniotomy import disc_opening, face_width_mm, opened, require_brain, without_outside
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.poses import aimed_at, pose_looking_at, sample
from SlicerUSSim.Logic.probe.surface import PatientSurface
from SlicerUSSim.Logic.tissue.names import labels_of

#: Names of the parts of a path without a tissue: fluid near the surface, and deep in the brain
SULCI, VENTRICLE = "sulci", "ventricle or cistern"
_FLUID, _VESSELS = ("csf", "leptomeninges"), ("blood", "enhancing")
#: Fluid counts as sulci up to so far below the brain's surface along the path, mm
_SULCUS_MM = 15.0
#: A point where no lesion is labelled stands for a ball of this radius, mm
_POINT_MM = 3
_STEP_MM, _LONGEST_MM = 0.5, 250.0
#: Paths with more outside the brain lead through face or neck, mm, as do those from below (cosine to the top of the
#: head) that do not come from behind (to its front)
_THICKEST_MM, _BELOW, _BEHIND = 35.0, -0.5, -0.4
#: Falx and sagittal sinus are so near to the middle plane; the skin is so far from the end of the image at least, mm
_MIDDLE_MM, _CUT_MM = 4.0, 2.0
#: An opening is so much wider than the face. A probe is tilted as this and the thickness of the bone allow, less a
#: clearance on each side, mm, and so far at most
_ROOM_MM, _CLEAR_MM, _TILT_DEG = 15.0, 2.0, 35.0
#: Number of paths, evenly in all directions; and the share of them that meet the surface from a place within it
_COMPARED, _FROM_INSIDE = 500, 0.9
#: Voxels that stand for a target, and places on the line to each that are looked at
_VOXELS, _LOOKS = 150, 20
_ADD = ", or one that is added (--add tumour=mask.nii.gz)"
#: Candidates stand so far apart that their openings hardly overlap, mm
_APART_MM = 25.0


@dataclass(frozen=True, eq=False)
class Target:
    """What is to be seen."""

    #: "tumour", or "point"
    name: str
    #: 1 in it
    region: Volume = field(repr=False)
    #: (n, 3) RAS mm of some of its voxels, and the middle of all
    points_ras: np.ndarray = field(repr=False)
    centre_ras: np.ndarray
    #: Of its extents along R, A and S the largest
    size_mm: float
    #: Of its uppermost point below the nearest place of the brain's surface
    depth_mm: float

    @property
    def text(self) -> str:
        """Its size and depth in words."""
        return f"{self.name}: {self.size_mm:.0f} mm, {self.depth_mm:.0f} mm below the brain's surface"


@dataclass(frozen=True, eq=False)
class Candidate:
    """A path to the target, and how a probe sees it from there."""

    #: (4, 4) of the probe, with its face on the brain
    probe_to_ras: np.ndarray = field(repr=False)
    #: (3,) RAS mm where the path begins on the skin, or on the brain without a head
    entry_ras: np.ndarray
    #: {tissue: mm} from there to the target; SULCI and VENTRICLE are fluid
    path_mm: Mapping[str, float]
    #: Between the probe's axis and the normal of the brain's surface
    angle_deg: float
    #: Shares of the target, 0 to 1: in the field of a probe that is tilted in the opening, and in the focal zone
    seen: float
    focused: float
    #: Diameter of the disc that is to be opened; 0 without a skull
    opening_mm: float
    #: In millimetres; the lower, the better
    cost: float
    #: Mean echo of the target above that of the brain around it, if simulated
    contrast_db: float | None = None
    #: (rows, columns, 3) uint8, if simulated: the image, and labels in its plane up to the skin, path and opening blue
    pictures: tuple[np.ndarray, ...] = field(default=(), repr=False)

    @property
    def text(self) -> str:
        """One line."""
        place = ", ".join(f"{axis} {round(mm) + 0.0:.0f}" for axis, mm in zip("RAS", self.entry_ras, strict=True))
        path = ", ".join(f"{name} {mm:.0f}" for name, mm in self.path_mm.items() if mm >= 1.0)
        contrast = "" if self.contrast_db is None else f"; contrast {self.contrast_db:+.0f} dB"
        opening = f"; opening of {self.opening_mm:.0f} mm" if self.opening_mm else ""
        focus = "" if self.focused >= 0.5 * self.seen else " (move the focus to the depth of the target)"
        return (
            f"{place}: {100 * self.seen:.0f} % seen, {100 * self.focused:.0f} % in focus{focus}, {self.angle_deg:.0f}° "
            f"to the surface's normal; path in mm: {path or 'none'}{opening}{contrast}; cost {self.cost:.0f}"
        )


@dataclass(frozen=True, eq=False)
class Approach:
    """The best candidates, the first before the others."""

    target: Target
    candidates: tuple[Candidate, ...]
    #: Of the brain
    surface: PatientSurface = field(repr=False)

    def in_opening(self, probe: Probe, probe_to_ras: np.ndarray, rim_ras: np.ndarray) -> np.ndarray:
        """(4, 4) of a probe that is moved into an opening, onto the brain, and aimed at the target.

        Its face stays within the disc about the middle of a rim of (points, 3) RAS mm, or anywhere without points.
        """
        place, target = probe_to_ras[:3, 3], self.target.centre_ras
        if len(rim_ras):
            middle = rim_ras.mean(axis=0)
            flat = np.linalg.svd(rim_ras - middle)[2][:2]  # axes of the plane of the rim
            away = (place - middle) @ flat.T
            room = np.linalg.norm((rim_ras - middle) @ flat.T, axis=1).min() - 0.5 * face_width_mm(probe)
            back = 1.0 - max(room, 0.0) / max(np.linalg.norm(away), 1e-6)
            place = place - max(back, 0.0) * away @ flat
        standing = probe_to_ras.copy()
        standing[:3, 3] = _entry(self.surface, target, place - target)
        if not np.isfinite(standing).all():  # in or below the target
            return probe_to_ras
        aimed = aimed_at(standing, target)
        return on_surface(aimed, self.surface.slid(aimed, aimed[:3, 3]), probe, self.surface)


def plan_approach(
    labels: Volume,
    names: Sequence[str],
    probe: Probe,
    what: str | Sequence[float] | None = None,
    *,
    weights: ApproachWeights | None = None,
    offered: int = 3,
) -> Approach:
    """Compare straight paths to a target, and return up to `offered` of the best, which are at least 25 mm apart.

    `labels` 1, 2, ... called `names` show a closed head or of a brain alone. `what` is the target, see
    find_target; errors as there, and for a target outside the brain. The face of the probe stands on the brain; without
    a head nothing is opened, and entries are on the brain. imaging.approach_images adds images and contrasts.
    It is a simulation and no medical advice.
    """
    require_brain(names)
    surface = PatientSurface(without_outside(labels, names))
    target = find_target(labels, names, what, surface)
    outward = _directions(_COMPARED)
    faces = np.array([_entry(surface, target.centre_ras, way) for way in outward])
    met = np.isfinite(faces[:, 0])
    require(met.mean() > _FROM_INSIDE, f"the {target.name} lies outside of the brain, expected a target in it")
    outward, faces = outward[met], faces[met]
    normals = np.array([surface.normal(face) for face in faces])
    angles = np.rad2deg(np.arccos(np.clip((outward * normals).sum(axis=1), -1.0, 1.0)))
    tissues, skin_mm = _tissues_on(labels, names, target, outward, faces)
    all_names = (*names, SULCI, VENTRICLE)
    poses = np.array([_aimed(face, target) for face in faces])

    def millimetres(*wanted: str) -> np.ndarray:
        return np.isin(tissues, labels_of(all_names, wanted)).sum(axis=1) * _STEP_MM

    bone, brain_mm = millimetres(*SKULL), np.linalg.norm(faces - target.centre_ras, axis=1)
    outside = np.maximum(skin_mm - brain_mm, 0.0)
    seen, focused = _views(probe, target, poses, bone, labels, names)
    amounts = {
        "brain": np.maximum(millimetres(*all_names) - outside, 0.0), "outside": outside, "angle": angles,
        "ventricle": millimetres(VENTRICLE), "vessel": millimetres(*_VESSELS), "air": millimetres("air"),
        "unseen": 100.0 * (1.0 - seen), "unfocused": 100.0 * (1.0 - focused),
    }  # fmt: skip
    weighted = [getattr(weights or ApproachWeights(), f"{name}_weight") * amount for name, amount in amounts.items()]
    cost = np.sum(weighted, axis=0)
    entries = faces + outside[:, None] * outward
    side, across = (target.centre_ras - surface.centre)[0], (entries - surface.centre)[:, 0]
    on_other_side = (abs(side) > _MIDDLE_MM) & (across * np.sign(side) < _MIDDLE_MM)
    from_below = (np.minimum(outward[:, 2], normals[:, 2]) < _BELOW) & (normals[:, 1] > _BEHIND)
    beyond = target.centre_ras + (skin_mm + _CUT_MM)[:, None] * outward
    is_cut = sample(labels.with_array(np.ones_like(labels.array)), beyond, order=0) == 0
    is_shut = bone.any() & ((bone == 0.0) | is_cut)
    is_long = (outside > _THICKEST_MM) | (angles > FARTHEST_DEG)
    unusual = on_other_side | from_below | is_shut | is_long | (seen == 0.0)
    best = _apart(faces, cost, unusual, offered)
    poses = np.array([on_surface(poses[way], surface.slid(poses[way], faces[way]), probe, surface) for way in best])
    seen, focused = _views(probe, target, poses, bone[best], labels, names)
    candidates = []
    for number, way in enumerate(best):
        on_way = tissues[way][tissues[way] > 0][::-1]
        path = {all_names[label - 1]: _STEP_MM * float((on_way == label).sum()) for label in dict.fromkeys(on_way)}
        opening = face_width_mm(probe) + _ROOM_MM if bone[way] else 0.0
        shares = seen[number], focused[number]
        candidates.append(Candidate(poses[number], entries[way], path, angles[way], *shares, opening, cost[way]))
    return Approach(target, tuple(candidates), surface)


def _entry(surface: PatientSurface, centre: np.ndarray, outward: np.ndarray) -> np.ndarray:
    """(3,) where a line from outside to a place meets the surface of the brain; nan if it does not."""
    found = surface.hit(centre + _LONGEST_MM * outward / np.linalg.norm(outward), centre)
    return np.full(3, np.nan) if found is None else found


def _apart(faces: np.ndarray, cost: np.ndarray, unusual: np.ndarray, count: int) -> list[int]:
    """Numbers of the `count` best places (n, 3), apart from each other; an unusual one alone, without any other."""
    chosen: list[int] = []
    for number in np.lexsort((cost, unusual)):
        if len(chosen) == count or (chosen and unusual[number]):
            break
        if all(np.linalg.norm(faces[number] - faces[other]) >= _APART_MM for other in chosen):
            chosen.append(int(number))
    return chosen


def opened_for(labels: Volume, names: Sequence[str], candidates: Iterable[Candidate]) -> Volume:
    """The labels with the openings of candidates; those of a brain alone as they are. Errors as craniotomy.opened."""
    discs = [disc_opening(labels, names, each.probe_to_ras, each.opening_mm) for each in candidates if each.opening_mm]
    return opened(labels, names, np.any(discs, axis=0))[0] if discs else labels


# ---- the target ------------------------------------------------------------------------------------------------------


def find_target(
    labels: Volume, names: Sequence[str], what: str | Sequence[float] | None, surface: PatientSurface
) -> Target:
    """The target among labels 1, 2, ... called `names`, below the `surface` of the brain.

    `what` is a tissue, of which it is the largest region; a point (3,) RAS mm, the lesion there or a ball of 3 mm
    around it; or None, the largest lesion. Raises SimulationError if there is no lesion, and for an unknown tissue and
    an invalid point.
    """
    point = None
    if isinstance(what, str):
        name = tissue_to_add(what, names)
    elif what is None:
        found = lesions(labels, names)
        require(bool(found), f"the labels have no lesion, expected one{_ADD}")
        point, name = found[0]
    else:
        point = np.asarray(what, float)
        require(point.shape == (3,) and np.isfinite(point).all(), f"the target is {what}, expected R, A, S in mm")
        name = ("", *names)[int(sample(labels, point[None], order=0)[0])]
    group = (name,) if isinstance(what, str) else next((group for group in LESION_GROUPS if name in group), None)
    if group is not None:
        parts, _ = ndimage.label(np.isin(labels.array, labels_of(names, group)))  # type: ignore[misc]
        require(parts.any(), f"the labels have no {name}, expected a lesion that they have{_ADD}")
        largest = np.bincount(parts.ravel())[1:].argmax() + 1
        part = largest if point is None else sample(labels.with_array(parts), point[None], order=0)[0]
        region = labels.with_array((parts == part).astype(np.uint8))
    else:
        axis, around = np.arange(-_POINT_MM, _POINT_MM + 1), np.eye(4)
        around[:3, 3] = point - _POINT_MM  # type: ignore[operator]
        away = np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis), axis=-1), axis=-1)
        name, region = "point", Volume((away <= _POINT_MM).astype(np.uint8), around)
    points = np.argwhere(region.array)[:, ::-1] @ region.ijk_to_ras[:3, :3].T + region.ijk_to_ras[:3, 3]
    size = np.ptp(points, axis=0).max() + np.cbrt(1000.0 * region.voxel_ml)
    some = points[:: int(np.ceil(len(points) / _VOXELS))]
    return Target(name, region, some, points.mean(axis=0), float(size), float(surface.distances_mm(points).min()))


# ---- paths -----------------------------------------------------------------------------------------------------------


def _tissues_on(
    labels: Volume, names: Sequence[str], target: Target, outward: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """((n, steps) labels every _STEP_MM from the middle of the target outwards, (n,) mm to the skin) of paths.

    They are 0 in the target and outside of the patient. Fluid has labels of its own, after those of `names`: SULCI, and
    VENTRICLE far below the `faces` (n, 3) in which the paths (n, 3) leave the brain.
    """
    distance = np.arange(0.0, _LONGEST_MM, _STEP_MM)
    points = target.centre_ras + distance[:, None] * outward[:, None]
    found = sample(labels, points, order=0).astype(int)
    skin_mm = np.where(found > 0, distance, 0.0).max(axis=1)
    in_target = np.where(sample(target.region, points, order=0) > 0, distance, -1.0).max(axis=1)
    found[distance <= in_target[:, None]] = 0
    is_deep = np.linalg.norm(faces - target.centre_ras, axis=1)[:, None] - distance > _SULCUS_MM
    return np.where(np.isin(found, labels_of(names, _FLUID)), len(names) + 1 + is_deep, found), skin_mm


def _directions(count: int) -> np.ndarray:
    """(count, 3) unit vectors, evenly from all directions: a spiral of Fibonacci."""
    place = np.arange(count) + 0.5
    up, turn = 1.0 - 2.0 * place / count, np.pi * (1.0 + np.sqrt(5.0)) * place
    flat = np.sqrt(1.0 - up**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), up], axis=1)


def _aimed(face: np.ndarray, target: Target) -> np.ndarray:
    """(4, 4) of a probe: the right of the image is the patient's right, or the back where it looks from the side."""
    depth = target.centre_ras - face
    from_side = abs(depth[0]) > 0.8 * np.linalg.norm(depth)
    return pose_looking_at(face, target.centre_ras, (0.0, -1.0, 0.0) if from_side else (1.0, 0.0, 0.0))


def _views(
    probe: Probe, target: Target, poses: np.ndarray, bone_mm: np.ndarray, labels: Volume, names: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """(share seen, share seen in the focal zone), each (n,), of poses (n, 4, 4) in openings of bone (n,).

    The probe is tilted about the lateral axis of its face as the opening allows. The focal zone is that within half of
    the depth of field, 3.5 wavelengths times the square of the f-number, of the focus. Bone and air in the brain
    hide the places behind them.
    """
    to_probe = np.linalg.inv(poses)
    x, y, z = np.moveaxis(target.points_ras @ np.swapaxes(to_probe[:, :3, :3], 1, 2) + to_probe[:, None, :3, 3], -1, 0)
    shares, faces = np.linspace(0.05, 0.97, _LOOKS)[:, None, None], poses[:, None, :3, 3]
    between = sample(labels, faces + shares[..., None] * (target.points_ras - faces), order=0)
    is_near = shares * y <= 0.5 * (face_width_mm(probe) + _ROOM_MM)  # bone so near to the face is removed
    is_clear = ~(np.isin(between, labels_of(names, (*SKULL, "air"))) & ~is_near).any(axis=0)
    allowed = np.minimum(np.rad2deg(np.arctan2(0.5 * _ROOM_MM - _CLEAR_MM, bone_mm)), _TILT_DEG)
    # A slice has a thickness, in which a place is seen without a tilt
    beside = np.maximum(np.abs(z) - 0.5 * probe.elevation_aperture_mm, 0.0)
    depth = np.hypot(y, z)
    is_seen = is_clear & probe.holds(x, depth) & (np.rad2deg(np.arctan2(beside, y)) <= allowed[:, None])
    zone = 3.5 * probe.wavelength_mm * (probe.focus_mm / probe.aperture_mm) ** 2
    in_focus = is_seen & (np.abs(depth - probe.focus_mm) <= zone)
    return is_seen.mean(axis=1), in_focus.mean(axis=1)
