"""Where left, front and top of a labelled head are, which a scanner's axes need not be."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.atlas import Atlas, mni152
from SlicerUSSim.Logic.mri.atlas_registration import AtlasFit, register_atlas
from SlicerUSSim.Logic.mri.plausibility import is_whole_brain
from SlicerUSSim.Logic.probe.poses import sample

#: Brightness in a T1, by which the atlas is registered to labels; what is not named here is as grey matter
_BRIGHTNESS = {"csf": 0.2, "ventricle": 0.2, "resection cavity": 0.2, "white matter": 1.0, "corpus callosum": 1.0}
_OTHERS = 0.6
#: Correlation of that brightness with the atlas from which an orientation is believed: 0.46 to 0.51 in heads that lie
#: anyhow, found as they lie, and 0.15 to 0.33 otherwise, where the masks overlap as well (Dice 0.88 to 0.91)
_LEAST_CORRELATION = 0.38
#: Orientations that are tried where the registration, which starts upright, finds none, and so many points for each
_MOST_TRIED, _POINTS = 4, 4000
#: A head that lies less obliquely than this needs no word, degrees
_TOLD_DEG = 8.0
_AXES = ("R", "A", "S")


def head_axes(brain: Volume, names: Sequence[str]) -> tuple[np.ndarray, str]:
    """((3, 3) whose columns are the head's right, front and top in RAS, a line about it or "").

    `brain` are labels 1, 2, ... called `names`, of a brain without what is around it. The axes are those of MNI152,
    registered to the labels with the brightness that tissues have in a T1; those of the image where that is not to be
    trusted: without the atlas, in a part of a brain, where the two do not agree. Takes about two seconds, and ten for a
    head that lies turned by more than a scanner's nod.
    """
    inside = brain.array > 0
    reason = is_whole_brain(brain, inside)
    atlas = mni152()
    if reason or atlas is None:
        return np.eye(3), f"the view follows the image's axes, since {reason or 'there is no atlas (nilearn)'}"
    brightness = np.array([0.0, *(_BRIGHTNESS.get(name, _OTHERS) for name in names)], np.float32)
    image = brain.with_array(brightness[brain.array])
    fit, correlation = _found(image, inside, atlas)
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
