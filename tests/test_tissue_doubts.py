"""Contrast agent that was not said, a contrast in another order, and a mask without CSF."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import cast

import numpy as np
import pytest
from scipy import ndimage

from SlicerUSSim.Logic import SimulationError, segment_mri
from SlicerUSSim.Logic.mri.plausibility import unsure
from validation.brain_phantoms import TissueMaps, phantom, tissue_maps
from validation.brain_scores import scores


@cache
def brain() -> TissueMaps:
    maps = tissue_maps("mni152")
    return maps.coarser(2)


@pytest.mark.slow
@pytest.mark.parametrize(("shown", "said"), [("t2", "t1"), ("t1", "flair")])
def test_a_wrong_contrast_is_refused_and_the_right_one_is_named(shown, said):
    case = phantom(brain(), shown)
    with pytest.raises(SimulationError, match=f"contrast is {said}, but .* choose .*{shown}"):
        segment_mri(case.mri, contrast=said, mask=case.mask)


@pytest.mark.slow
def test_cortex_is_not_csf_where_the_mask_leaves_only_the_ventricles():
    whole = brain()
    deep = cast(np.ndarray, ndimage.distance_transform_edt(whole.mask)) * 2.0 > 24.0
    kept = whole.mask & ((whole.csf < 0.2) | deep)
    shares = np.where(kept, whole.shares, 0.0).astype(np.float32)
    case = phantom(replace(whole, shares=shares, mask=kept), "t1", bias=0.0)
    true = float((case.truth.array == 1).sum() / kept.sum())
    assert true < 0.03
    found = segment_mri(case.mri, contrast="t1", mask=case.mask, thin_sulci=False)
    share = float((found.labels.array == found.tissue_names.index("csf") + 1).sum() / kept.sum())
    assert 0.3 * true < share < 2.0 * true
    assert scores(found.labels.array, dict(enumerate(found.tissue_names, 1)), case)["grey and white"] > 0.9


def test_a_brain_that_lies_unlike_its_header_is_reported():
    case = phantom(brain(), "t1", noise=0.03, bias=0.0)
    for axis in (None, 0, 1):
        mri, mask = (one if axis is None else one.with_array(np.flip(one.array, axis)) for one in (case.mri, case.mask))
        warnings = segment_mri(mri, mask=mask, thin_sulci=False).warnings
        assert any("check the orientation" in line for line in warnings) == (axis is not None), warnings


def test_one_warning_says_how_sure_labels_are_and_why():
    class Found:
        grey_white_contrast = 1.4

    (line,) = unsure(Found, 0.11, True)
    assert "the atlas explains 11% of this image" in line and "differ by 1.4 times the noise only" in line
    (line,) = unsure(Found, None, False)  # without an atlas
    assert "the atlas" not in line
    Found.grey_white_contrast = 4.0
    assert unsure(Found, 0.5, True) == []


@pytest.mark.long
def test_an_mri_as_z_scores_gets_the_labels_of_the_mri():
    """The usual preparation for neural networks; a field multiplies."""
    maps = brain()
    shown = phantom(maps, "t1", noise=0.03, bias=0.3)
    inside = shown.mask.array > 0
    values = shown.mri.array[inside]
    scored_values = np.where(inside, (shown.mri.array - values.mean()) / values.std(), 0.0).astype(np.float32)
    raw = segment_mri(shown.mri, mask=shown.mask, thin_sulci=False)
    scored = segment_mri(shown.mri.with_array(scored_values), mask=shown.mask, thin_sulci=False)
    for found in (raw, scored):  # which value no signal has is lost, so that the labels are not quite the same
        names = dict(enumerate(found.tissue_names, 1))
        assert scores(found.labels.array, names, shown)["grey and white"] > 0.9
    assert scored.warnings == raw.warnings == ()
    assert any("values below 0 in the brain" in line for line in scored.notes)
    assert not any("below 0" in line for line in raw.notes)
    assert scored.means[0] < 0.0 < scored.means[2]  # in the unit of the image
