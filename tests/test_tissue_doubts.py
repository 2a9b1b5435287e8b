"""Contrast agent that was not said, a contrast in another order, and a mask without CSF."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import cast

import numpy as np
import pytest
from scipy import ndimage

from SlicerUSSim.Logic import SimulationError, segment_mri
from SlicerUSSim.Logic.mri.classification import Classes
from SlicerUSSim.Logic.mri.plausibility import csf_is_doubtful, faint, require_order, require_several_tissues
from validation.brain_phantoms import TissueMaps, phantom, tissue_maps
from validation.brain_scores import scores


@cache
def brain() -> TissueMaps:
    maps = tissue_maps("mni152")
    if maps is None:
        pytest.skip("nilearn, which carries MNI152, is not installed")
    return maps.coarser(2)


@pytest.mark.slow
@pytest.mark.parametrize(("shown", "said"), [("t2", "t1"), ("t1", "flair")])
def test_a_wrong_contrast_is_refused_and_the_right_one_is_named(shown, said):
    case = phantom(brain(), shown)
    with pytest.raises(SimulationError, match=f"contrast is {said}, but .* choose .*{shown}"):
        segment_mri(case.mri, contrast=said, mask=case.mask)


def test_a_brain_that_lies_unlike_its_header_is_said():
    case = phantom(brain(), "t1", noise=0.03, bias=0.0)
    for axis in (None, 0, 1):
        mri, mask = (one if axis is None else one.with_array(np.flip(one.array, axis)) for one in (case.mri, case.mask))
        warnings = segment_mri(mri, mask=mask, thin_sulci=False).warnings
        assert any("lies as its header says" in line for line in warnings) == (axis is not None), warnings


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


def classes_of(means, posteriors=None, names=("csf", "grey matter", "white matter")):
    posteriors = np.eye(len(names)) if posteriors is None else np.asarray(posteriors, float)
    means = np.array(means, float)[:, None]
    return Classes(names, posteriors, means, np.ones_like(means), None)


def test_tissues_in_the_order_of_another_contrast_are_refused():
    t2_as_t1 = classes_of([10.6, 277.5, 130.4])
    with pytest.raises(SimulationError, match=r"grey matter 277.5, white matter 130.4\): choose t2 or flair"):
        require_order(t2_as_t1, "t1", True)
    assert len(require_order(t2_as_t1, "t1", False)) == 1
    assert require_order(classes_of([10.6, 130.4, 277.5]), "t1", True) == []


def test_one_tissue_alone_is_no_brain():
    posteriors = np.zeros((3, 1000))
    posteriors[1] = 1.0
    posteriors[:, :12] = [[1.0], [0.0], [0.0]]
    with pytest.raises(SimulationError, match=r"98.8% of the voxels are grey matter, expected several tissues"):
        require_several_tissues(classes_of([1, 2, 3], posteriors))
    require_several_tissues(classes_of([1, 2, 3]))


def test_grey_and_white_matter_that_noise_hides_are_reported():
    (line,) = faint(classes_of([10, 136, 125]), noise=10.0)
    assert "differ by 1.1 times the noise" in line
    assert faint(classes_of([10, 160, 220]), noise=10.0) == []


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


def test_csf_that_is_nearly_as_bright_as_grey_matter_is_reported():
    near, far = classes_of([124.0, 142.0, 176.0]), classes_of([27.0, 136.0, 174.0])
    (line,) = csf_is_doubtful(near, "t1gd")
    assert line.startswith("csf (124) is nearer to grey matter (142) than that to white matter (176)")
    assert csf_is_doubtful(far, "t1gd") == []
