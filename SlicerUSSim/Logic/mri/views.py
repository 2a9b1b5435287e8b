"""Standard views of a head: where a probe stands, and what its image is oriented by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.craniotomy import without_outside
from SlicerUSSim.Logic.probe.placement import pose_looking_at
from SlicerUSSim.Logic.probe.surface import PatientSurface


@dataclass(frozen=True)
class View:
    """A place on the head and an orientation, both in RAS."""

    #: What it shows
    tip: str
    #: From the middle of the brain to the probe
    outward: tuple[float, float, float]
    #: To the right of the image
    lateral: tuple[float, float, float]


#: Views by name, with the conventions of transcranial and neonatal ultrasound: the front is on the left of the image;
#: coronal images are seen from the front, with the patient's right on their left
VIEWS = {
    "temporal": View(
        "axial, through the right temporal bone: midline, ventricles, the other hemisphere; 2 MHz",
        (1.0, 0.1, 0.1), (0.0, -1.0, 0.0),
    ),
    "temporal-left": View(
        "the same through the left temporal bone", (-1.0, 0.1, 0.1), (0.0, -1.0, 0.0)
    ),
    "fontanelle": View(
        "coronal, through the anterior fontanelle: ventricles, corpus callosum; 6 to 8 MHz in newborns",
        (0.0, 0.35, 1.0), (-1.0, 0.0, 0.0),
    ),
    "fontanelle-sagittal": View(
        "sagittal, through the anterior fontanelle: corpus callosum, cerebellum", (0.0, 0.35, 1.0), (0.0, -1.0, 0.0)
    ),
}  # fmt: skip


def view_pose(labels: Volume, names: Sequence[str], view: str, *, is_open: bool = False) -> np.ndarray:
    """(4, 4) probe_to_ras of one of VIEWS on labels 1, 2, ... called `names`, with the axis square to the surface.

    It stands on the skin if that is labelled, unless skin and skull are to be opened (`is_open`), and on the brain
    otherwise. Raises SimulationError for an unknown view, and for labels without a brain.
    """
    require(view in VIEWS, f"view is {view!r}, expected one of {', '.join(VIEWS)}")
    brain = without_outside(labels, names)
    inside = np.argwhere(brain.array > 0)
    require(inside.size > 0, "the labels have no brain, expected one to look at")
    middle = 0.5 * (inside.min(axis=0) + inside.max(axis=0))
    centre = (labels.ijk_to_ras @ [*middle[::-1], 1.0])[:3]
    surface = PatientSurface(brain if is_open else labels)
    chosen = VIEWS[view]
    outward = np.asarray(chosen.outward) / np.linalg.norm(chosen.outward)
    far = centre + 1000.0 * outward
    found = surface.hit(far, centre)
    face = surface.nearest(far) if found is None else found
    return pose_looking_at(face, face - surface.normal(face), chosen.lateral)
