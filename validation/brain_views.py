"""Random views of brains in which nothing but the speed of sound differs between tissues."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.samples import demo_mri
from SlicerUSSim.Logic.mri.segmentation import segment_mri
from SlicerUSSim.Logic.probe.poses import pose_looking_at, surface_point
from SlicerUSSim.Logic.tissue.table import TissueTable
from validation.brain_phantoms import COLIN27

#: m/s, of brain
BRAIN_M_S = 1541.0
_SAME = {"mu0": 0.33, "sigma0": 0.15, "mu1": 0.0}


@dataclass(frozen=True, eq=False)
class EvenBrain:
    """A segmented brain whose tissues have the same scatterers."""

    name: str
    labels: Volume
    tissues: TissueTable
    #: The same with the speed of sound of brain everywhere
    baseline: TissueTable


def even_brains(device=None, **acoustics: float) -> list[EvenBrain]:
    """The MNI152 template and, if Debian's mricron-data is installed, Colin27.

    The table has no membrane. `acoustics` are further values for all tissues, such as attenuation_db_cm_mhz=0.0.
    """
    mris = {"MNI152": demo_mri()[0]}
    colin27 = COLIN27 / "ch2bet.nii.gz"
    if colin27.exists():
        mris["Colin27"] = Volume.read(colin27)
    brains = []
    for name, image in mris.items():
        found = segment_mri(image, thin_sulci=True, device=device)
        tissues = TissueTable.brain(found.tissue_names).with_membrane(None)
        for tissue in dict.fromkeys(tissues.names()):
            tissues = tissues.replace(tissue, **_SAME, **acoustics)
        baseline = tissues
        for tissue in dict.fromkeys(tissues.names()):
            baseline = baseline.replace(tissue, speed_of_sound_m_s=BRAIN_M_S)
        brains.append(EvenBrain(name, found.labels, tissues, baseline))
    return brains


def random_pose(labels: Volume, rng: np.random.Generator) -> np.ndarray:
    """(4, 4) pose on the surface of a brain, not from below, aimed within 10 mm of its centre along each axis."""
    centre = labels.ijk_to_ras[:3] @ [*ndimage.center_of_mass(labels.array > 0)[::-1], 1.0]
    outward = rng.normal(size=3)
    while outward[2] < -0.3 * np.linalg.norm(outward):
        outward = rng.normal(size=3)
    outward /= np.linalg.norm(outward)
    target = centre + rng.uniform(-10.0, 10.0, 3)
    face = surface_point(labels, target, outward) + outward
    return pose_looking_at(face, target, lateral_ras=tuple(rng.normal(size=3)))
