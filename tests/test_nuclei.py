"""Deep nuclei are grey matter, though an MRI shows them nearly as bright as white matter."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from SlicerUSSim.Logic import Volume, segment_mri
from SlicerUSSim.Logic.mri.atlas import mni152
from SlicerUSSim.Logic.mri.nuclei import nuclear_maps
from validation.brain_phantoms import COLIN27, BrainPhantom, TissueMaps, phantom, tissue_maps

#: Share of white matter by which nuclei look in T1, as measured in a scan labelled by FreeSurfer (labelled_brains)
_LOOK = 0.56
#: Labels of AAL (Tzourio-Mazoyer et al., NeuroImage 15(1), 2002), which was drawn on Colin27
_AAL = {"putamen": (73, 74), "thalamus": (77, 78)}


@cache
def bright_nuclei() -> tuple[TissueMaps, np.ndarray, np.ndarray]:
    """(maps of a bent and turned MNI152 at 2 mm whose nuclei are nearly white, the nuclei, as bright white matter)."""
    maps = tissue_maps("mni152")
    nuclei = (np.sum(nuclear_maps(mni152()), axis=0) > 0.6).astype(np.float32)
    # In the frontal white matter, as large as a thalamus and as far from the midline as the putamen
    k, j, i = np.ogrid[tuple(map(slice, nuclei.shape))]
    x, y, z = (row[0] * i + row[1] * j + row[2] * k + row[3] for row in maps.ijk_to_ras[:3])
    ball = ((np.abs(x) - 26) ** 2 + (y - 20) ** 2 + (z - 32) ** 2 < 7.0**2) & (maps.white > 0.9)
    carried = replace(maps, shares=np.concatenate([maps.shares, np.stack([nuclei, ball])]))
    moved = carried.coarser(2).warped(3.0)
    nuclei, ball = (share > 1.0 / 3.0 for share in moved.shares[3:])  # half a voxel: all five add up to 1
    shares = moved.shares[:3] / np.maximum(moved.shares[:3].sum(axis=0), 1e-6)
    look = np.float32(_LOOK) * np.array([-1.0, 1.0], np.float32)[:, None, None, None]
    appearance = shares.copy()
    appearance[1:] = np.where(nuclei | ball, [[[[1.0]]], [[[0.0]]]] + look, appearance[1:])
    appearance[0] = np.where(nuclei | ball, 0.0, appearance[0])
    return TissueMaps("bright nuclei", shares, moved.mask, moved.ijk_to_ras, appearance), nuclei, ball


def grey_share(case: BrainPhantom, where: np.ndarray, contrast: str) -> float:
    found = segment_mri(case.mri, contrast=contrast, mask=case.mask, thin_sulci=False)
    return float((found.labels.array[where] == found.tissue_names.index("grey matter") + 1).mean())


@pytest.mark.slow
def test_nuclei_nearly_as_bright_as_white_matter_are_grey():
    contrast = "t1"
    maps, nuclei, ball = bright_nuclei()
    case = phantom(maps, contrast, noise=0.03, bias=0.1)
    inside, elsewhere = (grey_share(case, where, contrast) for where in (nuclei, ball))
    assert inside > 0.8
    assert elsewhere < inside - 0.2  # of the same intensity, where no nucleus is


@pytest.mark.slow
def test_white_matter_beside_a_nucleus_stays_white():
    maps, nuclei, ball = bright_nuclei()
    case = phantom(maps, noise=0.03, bias=0.0)
    found = segment_mri(case.mri, mask=case.mask, thin_sulci=False)
    capsule = (maps.white > 0.7) & ~nuclei & ~ball & (sum_around(nuclei) > 0)
    assert capsule.sum() > 150
    assert (found.labels.array[capsule] == 3).mean() > 0.9


def sum_around(inside: np.ndarray) -> np.ndarray:
    """Number of voxels of a mask that lie within two voxels along an axis."""
    return np.sum([np.roll(inside, step, axis) for axis in range(3) for step in (-2, -1, 1, 2)], axis=0)


@pytest.mark.slow
def test_putamen_and_thalamus_of_colin27_are_grey_where_aal_draws_them():
    if not (COLIN27 / "aal.nii.gz").exists():
        pytest.skip("mricron-data is not installed")
    brain, drawn = (Volume.read(COLIN27 / name) for name in ("ch2bet.nii.gz", "aal.nii.gz"))
    found = segment_mri(brain, thin_sulci=False)
    assert drawn.array.shape == brain.array.shape
    for labels in _AAL.values():
        inside = np.isin(drawn.array, labels) & (found.labels.array > 1)  # AAL's thalamus reaches into the ventricle
        assert (found.labels.array[inside] == 2).mean() > 0.65  # .47 and .57 by intensity alone
