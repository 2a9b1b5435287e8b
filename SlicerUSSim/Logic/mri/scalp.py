"""Whether an object on an empty background is a head: below its surface lies the dark skull."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.volume import Volume

#: Voxels that are looked at, and shells below the surface, for a head of 4000 ml; smaller objects have thinner ones
_VOXEL_MM, _SHELL_MM, _SHELLS, _WHOLE_ML = 2.0, 2.8, 18, 4000.0
#: Sectors around the centre in the upper half: along the equator, and from it to the top
_AROUND, _UPWARDS, _LEAST_VOXELS, _LEAST_SHELLS = 12, 4, 50, 6
#: A sector has a skull if a shell is darker than this part of what is brightest on either side of it
_DARK = 0.7


def skull_share(mri: Volume, inside: np.ndarray) -> float:
    """Share of the sectors of an object's upper half, `inside` (k, j, i) bool, with a dark shell below a bright one.

    Of whole heads shrunk to 0.75 and more, which have the size of a brain, 1.0; of stripped brains 0.0 to 0.17.
    """
    strides = [max(1, round(_VOXEL_MM / mm)) for mm in mri.spacing_mm[::-1]]
    every = tuple(slice(None, None, stride) for stride in strides)
    mm = np.array(strides) * mri.spacing_mm[::-1]
    values = ndimage.uniform_filter(mri.array.astype(np.float32) - float(mri.array.min()), strides)[every]  # type: ignore[arg-type]
    shown = inside[every]
    depth = ndimage.distance_transform_edt(np.pad(shown, 1), sampling=mm)[1:-1, 1:-1, 1:-1]  # type: ignore[index]
    scale = float(np.cbrt(shown.sum() * mm.prod() / 1000.0 / _WHOLE_ML))
    points = (np.argwhere(shown) - np.argwhere(shown).mean(axis=0)) * mm
    towards = points[:, ::-1] @ (mri.ijk_to_ras[:3, :3] / mri.spacing_mm).T
    height = towards[:, 2] / np.maximum(np.linalg.norm(towards, axis=1), 1e-6)
    around = ((np.arctan2(towards[:, 1], towards[:, 0]) / (2.0 * np.pi) + 0.5) * _AROUND).astype(int) % _AROUND
    sector = around * _UPWARDS + np.clip((height * _UPWARDS).astype(int), 0, _UPWARDS - 1)
    shell = (depth[shown] / (_SHELL_MM * scale)).astype(int)
    used = (height > 0.0) & (shell < _SHELLS)
    key, found = (sector * _SHELLS + shell)[used], values[shown][used]
    counts = np.bincount(key, minlength=_AROUND * _UPWARDS * _SHELLS)
    medians = np.full(len(counts), np.nan)
    present = np.flatnonzero(counts > 5)
    medians[present] = ndimage.median(found, key, present)
    with_skull = []
    sectors = _AROUND * _UPWARDS, _SHELLS
    for profile, total in zip(medians.reshape(sectors), counts.reshape(sectors).sum(axis=1), strict=True):
        profile = profile[np.isfinite(profile)]
        if total < _LEAST_VOXELS or len(profile) < _LEAST_SHELLS:
            continue
        beside = [min(profile[:n].max(), profile[n + 1 :].max()) for n in range(1, len(profile) - 1)]
        with_skull.append((profile[1:-1] < _DARK * np.array(beside)).any())
    return float(np.mean(with_skull)) if with_skull else 0.0
