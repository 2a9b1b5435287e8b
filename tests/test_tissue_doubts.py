"""Contrast agent that was not said, a contrast in another order, and a mask without CSF."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import cast

import numpy as np
import pytest
from scipy import ndimage

from SlicerUSSim.Logic import SimulationError, segment_mri
from SlicerUSSim.Logic.mri.plausibility import enhancement
from SlicerUSSim.Logic.verification.brain_phantoms import TissueMaps, phantom, tissue_maps, with_ring_tumour
from SlicerUSSim.Logic.verification.brain_scores import scores


@cache
def brain() -> TissueMaps:
    maps = tissue_maps("mni152")
    if maps is None:
        pytest.skip("nilearn, which carries MNI152, is not installed")
    return maps.coarser(2)


def test_a_tumours_rim_that_enhances_in_a_t1_without_contrast_agent_is_said_with_the_remedy():
    case = phantom(with_ring_tumour(brain()), "t1gd", bias=0.0)
    told = segment_mri(case.mri, contrast="t1", mask=case.mask).warnings
    assert any("--contrast t1gd" in line for line in told)
    assert not any("t1gd" in line for line in segment_mri(case.mri, contrast="t1gd", mask=case.mask).warnings)


def test_a_healthy_t1_is_not_taken_for_one_with_contrast_agent():
    case = phantom(brain(), "t1", noise=0.07)
    assert not segment_mri(case.mri, contrast="t1", mask=case.mask).warnings


def test_bright_pieces_smaller_than_2_ml_are_no_contrast_agent():
    image, inside = np.full((20, 30, 30), 100.0), np.ones((20, 30, 30), bool)
    image[2:12, 2:12, 2:12] = image[14:, 14:, 14:24] = 300.0  # 1.0 and 0.96 ml
    assert not enhancement(image, inside, 80.0, 100.0, voxel_ml=0.001)
    assert "2.0 ml" in enhancement(image, inside, 80.0, 100.0, voxel_ml=0.002)[0]


@pytest.mark.parametrize(("shown", "said"), [("t2", "t1"), ("t1", "t2"), ("t1", "flair"), ("t2", "flair")])
def test_a_contrast_in_another_order_is_refused_and_the_right_one_is_named(shown, said):
    case = phantom(brain(), shown)
    with pytest.raises(SimulationError, match=f"contrast is {said}, but .* choose .*{shown}"):
        segment_mri(case.mri, contrast=said, mask=case.mask)


def test_cortex_does_not_become_csf_where_the_mask_leaves_only_the_ventricles():
    whole = brain()
    deep = cast(np.ndarray, ndimage.distance_transform_edt(whole.mask)) * 2.0 > 24.0
    kept = whole.mask & ((whole.csf < 0.2) | deep)
    shares = np.where(kept, whole.shares, 0.0).astype(np.float32)
    case = phantom(replace(whole, shares=shares, mask=kept), "t1", bias=0.0)
    true = float((case.truth.array == 1).sum() / kept.sum())
    assert true < 0.03
    found = segment_mri(case.mri, contrast="t1", mask=case.mask)
    share = float((found.labels.array == found.tissue_names.index("csf") + 1).sum() / kept.sum())
    assert 0.3 * true < share < 2.0 * true
    assert scores(found.labels.array, dict(enumerate(found.tissue_names, 1)), case)["grey and white"] > 0.9
