"""Standard views of a head: where a probe stands, and what its image is oriented by, along the head's own axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.atlas import Atlas, mni152
from SlicerUSSim.Logic.mri.atlas_registration import AtlasFit, register_atlas
from SlicerUSSim.Logic.mri.plausibility import is_whole_brain
from SlicerUSSim.Logic.placement.craniotomy import require_brain, without_outside
from SlicerUSSim.Logic.probe.poses import pose_looking_at, sample
from SlicerUSSim.Logic.probe.surface import PatientSurface
from SlicerUSSim.Logic.tissue.names import labels_of


@dataclass(frozen=True)
class View:
    """A place on the head and an orientation: to the head's right, front and top."""

    #: What it shows
    tip: str
    #: From the middle of the brain to the probe
    outward: tuple[float, float, float]
    #: To the right of the image
    lateral: tuple[float, float, float]
    #: Up to so far from there the probe looks for the thinnest bone, mm
    window_mm: float = 0.0


#: A temporal window is found by moving the probe: about so far, in such steps, mm
_WINDOW_MM, _STEP_MM = 15.0, 5.0
#: Millimetres of bone that are worth moving for
_WORTH_MM = 2

#: Views by name, with the conventions of transcranial and neonatal ultrasound: the front is on the left of the image;
#: coronal images are seen from the front, with the patient's right on their left
VIEWS = {
    "temporal": View(
        "axial, through the right temporal bone; 2 MHz",
        (1.0, 0.1, 0.1), (0.0, -1.0, 0.0), _WINDOW_MM,
    ),
    "temporal-left": View(
        "the same through the left temporal bone", (-1.0, 0.1, 0.1), (0.0, -1.0, 0.0), _WINDOW_MM
    ),
    "fontanelle": View(
        "coronal, through the anterior fontanelle; 6 to 8 MHz in newborns",
        (0.0, 0.35, 1.0), (-1.0, 0.0, 0.0),
    ),
    "fontanelle-sagittal": View(
        "sagittal, through the anterior fontanelle",
        (0.0, 0.35, 1.0), (0.0, -1.0, 0.0),
    ),
}  # fmt: skip


#: Depth of the search for bone behind a face in an opening, and the amount of it that is a closed skull, mm
_BEHIND_MM, _CLOSED_MM = 40.0, 2
#: Cosine of the angle between a surface's normal and the plane of a view, within which the probe stands in that plane
_FLAT_COS = 0.87
#: Depths of the search for bone below a place on the skin
_DEEP_MM = np.arange(0.5, 40.0)


def opened_view_pose(labels: Volume, names: Sequence[str], view: str) -> tuple[np.ndarray, str]:
    """((4, 4) probe_to_ras, a line about it) of one of VIEWS on labels with an opening; errors as view_pose.

    It stands on the brain if the opening is where the view is seen from, and on the skin of the closed skull otherwise.
    """
    pose, line = view_pose(labels, names, view, is_open=True)
    behind = pose[:3, 3] - np.arange(1.0, _BEHIND_MM)[:, None] * pose[:3, 1]
    if int(np.isin(sample(labels, behind, order=0), labels_of(names, ("skull", "bone"))).sum()) < _CLOSED_MM:
        return pose, _joined(line, f"the view {view} is seen through the opening")
    pose, line = view_pose(labels, names, view)
    return pose, _joined(
        line,
        f"the view {view} does not pass through the opening: the probe stands on the skin over the closed skull; "
        "without a view it stands in the opening",
    )


def view_pose(labels: Volume, names: Sequence[str], view: str, *, is_open: bool = False) -> tuple[np.ndarray, str]:
    """((4, 4) probe_to_ras of one of VIEWS on labels 1, 2, ... called `names`, a line about the head's axes or "").

    The probe's axis is square to the surface; left, front and top are the head's own (head_axes). It stands on the skin
    if that is labelled, unless skin and skull are to be opened (`is_open`), and on the brain otherwise. Raises
    SimulationError for an unknown view, and for labels without a brain.
    """
    require(view in VIEWS, f"view is {view!r}, expected one of {', '.join(VIEWS)}")
    require_brain(names)
    brain = without_outside(labels, names)
    inside = np.argwhere(brain.array > 0)
    require(inside.size > 0, "the labels have no brain, expected one to look at")
    middle = 0.5 * (inside.min(axis=0) + inside.max(axis=0))
    centre = (labels.ijk_to_ras @ [*middle[::-1], 1.0])[:3]
    surface = PatientSurface(brain if is_open else labels)
    chosen = VIEWS[view]
    axes, line = head_axes(brain, names)
    outward = _unit(axes @ chosen.outward)
    face = _face(surface, centre, outward)
    if chosen.window_mm and not labels_of(names, ("skull", "bone")):
        line = _joined(line, "no skull is labelled: the probe stands on the brain, and the image has no bone")
    elif chosen.window_mm and not is_open:
        face, told = _at_window(surface, labels, names, face, axes, centre, chosen)
        line = _joined(line, told)
    return pose_looking_at(face, face + _inwards(surface.normal(face), axes, chosen), axes @ chosen.lateral), line


def _inwards(normal: np.ndarray, axes: np.ndarray, view: View) -> np.ndarray:
    """(3,) unit vector into the head: square to the surface as seen in the view's plane, which stays in the head's.

    Gyri tilted it out of that plane. Where the surface is more oblique to the plane than 30 degrees the face lies flat.
    """
    across = _unit(np.cross(axes @ view.lateral, axes @ view.outward))
    within = normal - (normal @ across) * across
    return -_unit(within) if np.linalg.norm(within) > _FLAT_COS else -normal


def _face(surface: PatientSurface, centre: np.ndarray, outward: np.ndarray) -> np.ndarray:
    """(3,) RAS mm of the surface outwards of the brain's middle."""
    far = centre + 1000.0 * outward
    found = surface.hit(far, centre)
    return surface.nearest(far) if found is None else found


def _at_window(
    surface: PatientSurface, labels: Volume, names: Sequence[str], face: np.ndarray, axes: np.ndarray,
    centre: np.ndarray, view: View,
) -> tuple[np.ndarray, str]:  # fmt: skip
    """((3,) place near a face with the thinnest bone below it, and a line if it is another place)."""
    bones = labels_of(names, ("skull", "bone", "cancellous bone"))

    def thickness(place: np.ndarray) -> int:
        return int(np.isin(sample(labels, place - _DEEP_MM[:, None] * surface.normal(place), order=0), bones).sum())

    usual = thickness(face)
    steps = np.arange(-view.window_mm, view.window_mm + 0.5, _STEP_MM)
    best, thinnest = face, usual
    # The nearest ones first, so that it moves no farther than it has to
    for front, up in sorted(((a, b) for a in steps for b in steps), key=lambda step: np.hypot(*step)):
        if 0.0 < np.hypot(front, up) <= view.window_mm:
            place = _face(surface, centre, _unit(face + axes @ (0.0, front, up) - centre))
            here = thickness(place)
            if 0 < here < thinnest and here <= usual - _WORTH_MM:
                best, thinnest = place, here
    if thinnest == usual:
        return face, ""
    moved = float(np.linalg.norm(best - face))
    return (
        best,
        f"placed where bone is {thinnest} mm thick, {moved:.0f} mm from the middle of the temple, where it is {usual}",
    )


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def _joined(*lines: str) -> str:
    """The lines that are not empty, as one."""
    return "; ".join(line for line in lines if line)


# ---- where left, front and top of a labelled head are, which a scanner's axes need not be ----------------------------

#: Brightness in a T1, by which the atlas is registered to labels; what is not named here is as grey matter
_BRIGHTNESS = {"csf": 0.2, "ventricle": 0.2, "resection cavity": 0.2, "white matter": 1.0, "corpus callosum": 1.0}
_OTHERS = 0.6
#: Least correlation of that brightness with the atlas that confirms an orientation: 0.46 to 0.51 for correct ones in
#: heads of any orientation, 0.15 to 0.33 for wrong ones, although their masks overlap (Dice 0.88 to 0.91)
_LEAST_CORRELATION = 0.38
#: Orientations to try if the registration, which starts upright, finds none, and points for each
_MOST_TRIED, _POINTS = 4, 4000
#: A head that lies less obliquely than this needs no word, degrees
_TOLD_DEG = 8.0
_AXES = ("R", "A", "S")


def head_axes(brain: Volume, names: Sequence[str]) -> tuple[np.ndarray, str]:
    """((3, 3) whose columns are the head's right, front and top in RAS, a line about it or "").

    `brain` are labels 1, 2, ... called `names`, of a brain without its surroundings. The axes belong to MNI152,
    registered to the labels with the brightness that tissues have in a T1; those of the image where that is not to be
    trusted: in a part of a brain, where the two do not agree. Takes about two seconds, and ten for a
    head that lies turned by more than a scanner's nod.
    """
    inside = brain.array > 0
    reason = is_whole_brain(brain, inside)
    if reason:
        return np.eye(3), f"the view follows the image's axes, since {reason}"
    brightness = np.array([0.0, *(_BRIGHTNESS.get(name, _OTHERS) for name in names)], np.float32)
    image = brain.with_array(brightness[brain.array])
    fit, correlation = _found(image, inside, mni152())
    if not fit.is_good or correlation < _LEAST_CORRELATION:
        return np.eye(3), (
            f"the view follows the image's axes, since MNI152 covers the brain with a Dice of {fit.dice:.2f} and "
            f"correlates with its tissues by {correlation:.2f} only: check where the probe stands"
        )
    # The rotation next to the affine transform: its polar factor.
    left, _, right = np.linalg.svd(np.linalg.inv(fit.patient_to_atlas[:3, :3]))
    axes = left @ right
    degrees = np.degrees(np.arccos(np.clip(0.5 * (np.trace(axes) - 1.0), -1.0, 1.0)))
    if degrees < _TOLD_DEG:
        return axes, ""
    top = ", ".join(f"{letter} {value:.2f}" for letter, value in zip(_AXES, axes[:, 2], strict=True))
    told = f"the head lies turned by {degrees:.0f} degrees in its image (its top is at {top}): the view follows it"
    return axes, told


def _found(image: Volume, inside: np.ndarray, atlas: Atlas) -> tuple[AtlasFit, float]:
    """(the registered atlas, its correlation with the image; 1 where that has one brightness)."""
    places = np.argwhere(inside)
    places = places[:: max(len(places) // _POINTS, 1)]
    values = image.array[tuple(places.T)]
    points = places[:, ::-1] @ image.ijk_to_ras[:3, :3].T + image.ijk_to_ras[:3, 3]

    def correlation(patient_to_atlas: np.ndarray) -> float:
        there = sample(atlas.t1, points @ patient_to_atlas[:3, :3].T + patient_to_atlas[:3, 3], order=0)
        return float(np.corrcoef(values, there)[0, 1]) if there.std() > 0.0 else 0.0

    upright = register_atlas(image, inside, atlas)
    if values.std() == 0.0:
        return upright, 1.0
    best = upright, correlation(upright.patient_to_atlas)
    if best[1] >= _LEAST_CORRELATION:
        return best
    # About the centres of both brains, in their sizes
    of_atlas = np.argwhere(atlas.t1.array > 0)
    to_ras = atlas.t1.ijk_to_ras
    middle = of_atlas.mean(axis=0)[::-1] @ to_ras[:3, :3].T + to_ras[:3, 3]
    size = np.cbrt(len(of_atlas) * atlas.t1.voxel_ml / (inside.sum() * image.voxel_ml))
    centre, turns = points.mean(axis=0), []
    for rotation in (*Rotation.create_group("O").as_matrix(), *Rotation.create_group("I").as_matrix()):
        matrix = np.eye(4)
        matrix[:3, :3] = size * rotation
        matrix[:3, 3] = middle - matrix[:3, :3] @ centre
        turns.append((correlation(matrix), rotation))
    for _, rotation in sorted(turns, key=lambda turn: -turn[0])[:_MOST_TRIED]:
        turned = np.eye(4)
        turned[:3, :3], turned[:3, 3] = rotation, centre - rotation @ centre
        fit = register_atlas(Volume(image.array, turned @ image.ijk_to_ras), inside, atlas)
        fit = AtlasFit(fit.patient_to_atlas @ turned, fit.dice, atlas)
        best = max(best, (fit, correlation(fit.patient_to_atlas)), key=lambda found: found[1])
        if best[1] >= _LEAST_CORRELATION and best[0].is_good:
            break
    return best
