"""Phantoms of brains have the tissues, noise and bias that they say; segment_mri and its controls on small ones."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy import ndimage

from benchmarks.segmentation_controls import NAMES
from SlicerUSSim.Logic import segment_mri
from validation.brain_phantoms import (
    MEANS,
    TISSUES,
    TissueMaps,
    bias_field,
    phantom,
    tight_mask,
    tissue_maps,
    with_ring_tumour,
)
from validation.brain_scores import calibration, dice, scores


@cache
def fine(name: str) -> TissueMaps:
    maps = tissue_maps(name)
    if maps is None:
        pytest.skip(f"the package with {name} is not installed")
    return maps


@cache
def small(name: str) -> TissueMaps:
    """On voxels of 2 mm."""
    return fine(name).coarser(2)


# ---- what phantoms are -----------------------------------------------------------------------------------------------


def test_shares_sum_to_one_in_the_brain_and_are_0_outside():
    maps = small("mni152")
    total = maps.shares.sum(axis=0)
    assert np.allclose(total[maps.mask], 1.0, atol=1e-5) and not total[~maps.mask].any()
    volume_ml = maps.mask.sum() * abs(np.linalg.det(maps.ijk_to_ras[:3, :3])) / 1000.0
    assert 1500 < volume_ml < 2000
    csf, grey, white = maps.shares[:, maps.mask].mean(axis=1)
    assert 0.05 < csf < 0.2 and 0.45 < grey < 0.6 and 0.3 < white < 0.42  # as in any adult


def test_noise_is_rician_of_the_deviation_it_says():
    maps, noise = small("mni152"), 0.07
    clean, noisy = (phantom(maps, noise=n, bias=0.0) for n in (0.0, noise))
    difference = (noisy.mri.array - clean.mri.array)[maps.mask]
    bright = clean.mri.array[maps.mask] > 150
    assert noisy.noise == pytest.approx(noise * 222.0)
    assert difference[bright].std() == pytest.approx(noisy.noise, rel=0.02)
    # Rician: the mean rises by variance / (2 signal)
    expected = float((noisy.noise**2 / (2.0 * clean.mri.array[maps.mask]))[~bright].mean())
    assert difference[~bright].mean() == pytest.approx(expected, rel=0.15)


def test_bias_field_reaches_both_ends_and_is_smooth():
    maps = small("mni152")
    case = phantom(maps, noise=0.0, bias=0.2)
    inside = case.bias[maps.mask]
    assert (inside.min(), inside.max()) == pytest.approx((0.8, 1.2), abs=1e-5)
    steps = [np.abs(np.diff(np.where(maps.mask, case.bias, np.nan), axis=axis)) for axis in range(3)]
    assert max(np.nanmax(step) for step in steps) < 0.03  # per 2 mm
    assert np.allclose(case.mri.array, np.tensordot(MEANS["t1"][:3], maps.shares, 1) * case.bias, rtol=1e-4)
    assert (bias_field(maps.mask, 0.0, np.random.default_rng(0)) == 1.0).all()


def test_tight_mask_lacks_outer_csf_and_keeps_ventricles_and_tissue():
    maps = small("mni152")
    tight = tight_mask(maps)
    depth = 2.0 * np.asarray(ndimage.distance_transform_edt(maps.mask))
    rim, deep = maps.mask & (depth <= 2.0), depth > 12.0
    is_csf = maps.mask & (maps.csf > 0.5)
    assert (tight & rim & is_csf).sum() < 0.3 * (rim & is_csf).sum()
    assert (tight & deep & is_csf).sum() > 0.99 * (deep & is_csf).sum()
    assert (tight | (maps.csf >= 0.5))[maps.mask].all()


def test_ring_tumour_has_a_rim_around_necrosis_in_oedema_of_white_matter():
    maps = with_ring_tumour(small("mni152"))
    truth = np.where(maps.mask, maps.shares.argmax(axis=0) + 1, 0)
    ml = {tissue: (truth == n).sum() * 8e-3 for n, tissue in enumerate(TISSUES, start=1)}
    assert 3.0 < ml["enhancing"] < 6.0 and 2.0 < ml["necrosis"] < 5.0 and 10.0 < ml["oedema"] < 40.0
    assert np.allclose(maps.shares.sum(axis=0)[maps.mask], 1.0, atol=1e-5)
    around_core = np.asarray(ndimage.binary_dilation(truth == 5)) & (truth != 5)
    assert (truth[around_core] == 4).mean() > 0.95
    assert small("mni152").white[truth == 6].min() > 0.3


# ---- scores ----------------------------------------------------------------------------------------------------------


def test_scores_are_1_for_the_truth_and_fall_where_labels_are_exchanged():
    case = phantom(small("mni152"), noise=0.0, bias=0.0)
    right = scores(case.truth.array, NAMES, case)
    assert right == dict.fromkeys(right, 1.0)
    exchanged = scores(case.truth.array, {1: "csf", 2: "white matter", 3: "grey matter"}, case)
    assert exchanged["csf"] == 1.0 and exchanged["grey and white"] == 0.0
    assert dice(np.array([True, True, False]), np.array([True, False, False])) == pytest.approx(2 / 3)


# ---- methods ---------------------------------------------------------------------------------------------------------


#: Least mean Dice of grey and white matter: what is wanted, 0.955 at 3 % noise and 0.93 at 7 %, or just below what is
#: reached where that is less (docs/segmentation.md).
LEAST = {
    ("mni152", 0.03, 0.0): 0.960, ("mni152", 0.03, 0.2): 0.955, ("mni152", 0.07, 0.2): 0.935,
    ("colin27", 0.03, 0.0): 0.955, ("colin27", 0.03, 0.2): 0.955, ("colin27", 0.07, 0.2): 0.930,
    ("mni152", 0.03, 0.1): 0.957, ("colin27", 0.03, 0.1): 0.951,
}  # fmt: skip
#: The others are for a release.
IN_CI = (("mni152", 0.03, 0.2, "full"), ("colin27", 0.07, 0.2, "tight"))


@pytest.mark.parametrize(
    ("name", "noise", "bias", "mask"),
    [
        pytest.param(*case, mask, marks=pytest.mark.slow if (*case, mask) in IN_CI else pytest.mark.long)
        for case in LEAST
        for mask in ("full", "tight")
    ],
)
def test_segmentation_at_1_mm_is_as_good_as_the_documentation_says(name, noise, bias, mask):
    case = phantom(fine(name), noise=noise, bias=bias, mask=mask)
    found = segment_mri(case.mri, mask=case.mask, thin_sulci=False)
    names = dict(enumerate(found.tissue_names, start=1))
    assert scores(found.labels.array, names, case)["grey and white"] >= LEAST[name, noise, bias]
    for stated, right, voxels in calibration(found.posteriors, names, case):
        # Three standard errors of a share: a single voxel is right or wrong, and shows nothing.
        assert right == pytest.approx(stated, abs=0.07 + 1.5 / voxels**0.5)
