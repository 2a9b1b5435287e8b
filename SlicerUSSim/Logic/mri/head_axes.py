"""Where left, front and top of a labelled head are, which a scanner's axes need not be."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.atlas import mni152
from SlicerUSSim.Logic.mri.atlas_registration import register_atlas
from SlicerUSSim.Logic.mri.plausibility import is_whole_brain

#: Brightness in a T1, by which the atlas is registered to labels; what is not named here is as grey matter
_BRIGHTNESS = {"csf": 0.2, "ventricle": 0.2, "resection cavity": 0.2, "white matter": 1.0, "corpus callosum": 1.0}
_OTHERS = 0.6
#: A head that lies less obliquely than this needs no word, degrees
_TOLD_DEG = 8.0
_AXES = ("R", "A", "S")


def head_axes(brain: Volume, names: Sequence[str]) -> tuple[np.ndarray, str]:
    """((3, 3) whose columns are the head's right, front and top in RAS, a line about it or "").

    `brain` are labels 1, 2, ... called `names`, of a brain without what is around it. The axes are those of MNI152,
    registered to the labels with the brightness that tissues have in a T1; those of the image where that is not to be
    trusted: without the atlas, in a part of a brain, where the two do not overlap well. Takes about two seconds.
    """
    inside = brain.array > 0
    reason = is_whole_brain(brain, inside)
    atlas = mni152()
    if reason or atlas is None:
        return np.eye(3), f"the view follows the image's axes, since {reason or 'there is no atlas (nilearn)'}"
    brightness = np.array([0.0, *(_BRIGHTNESS.get(name, _OTHERS) for name in names)], np.float32)
    fit = register_atlas(brain.with_array(brightness[brain.array]), inside, atlas)
    if not fit.is_good:
        return np.eye(3), (
            f"the view follows the image's axes, since MNI152 covers the brain with a Dice of {fit.dice:.2f} only"
        )
    # The rotation next to the affine transform: its polar factor.
    left, _, right = np.linalg.svd(np.linalg.inv(fit.patient_to_atlas[:3, :3]))
    axes = left @ right
    degrees = np.degrees(np.arccos(np.clip(0.5 * (np.trace(axes) - 1.0), -1.0, 1.0)))
    if degrees < _TOLD_DEG:
        return axes, ""
    top = ", ".join(f"{letter} {value:.2f}" for letter, value in zip(_AXES, axes[:, 2], strict=True))
    return (
        axes,
        f"the head lies turned by {degrees:.0f} degrees in its image (its top is at {top}): the view follows it",
    )
