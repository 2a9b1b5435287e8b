"""Standard views of a head: where a probe stands, and what its image is oriented by, along the head's own axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.placement.craniotomy import require_brain, without_outside
from SlicerUSSim.Logic.placement.head_axes import head_axes
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
        "axial, through the right temporal bone: midline, ventricles, the other hemisphere; 2 MHz",
        (1.0, 0.1, 0.1), (0.0, -1.0, 0.0), _WINDOW_MM,
    ),
    "temporal-left": View(
        "the same through the left temporal bone", (-1.0, 0.1, 0.1), (0.0, -1.0, 0.0), _WINDOW_MM
    ),
    "fontanelle": View(
        "coronal, through the anterior fontanelle: ventricles, corpus callosum; 6 to 8 MHz in newborns",
        (0.0, 0.35, 1.0), (-1.0, 0.0, 0.0),
    ),
    "fontanelle-sagittal": View(
        "sagittal, through the anterior fontanelle: corpus callosum, in newborns the cerebellum",
        (0.0, 0.35, 1.0), (0.0, -1.0, 0.0),
    ),
}  # fmt: skip


#: Bone is looked for so far behind a face in an opening, and so much of it is a closed skull, mm
_BEHIND_MM, _CLOSED_MM = 40.0, 2
#: Cosine of the angle between a surface's normal and the plane of a view, within which the probe stands in that plane
_FLAT_COS = 0.87
#: Depths at which bone is looked for below a place on the skin
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
        f"the opening is not where the view {view} is seen from: the probe stands on the skin over the closed skull; "
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
