"""Segmentation (docs/physics.md#1-from-mri-to-tissues): a real template, the filter by its definition, bad input."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import SimpleITK as sitk
from scipy.ndimage import uniform_filter
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic import SimulationError, Volume, segment_mri
from SlicerUSSim.Logic.mri.atlas import mni152
from SlicerUSSim.Logic.mri.atlas_registration import register_atlas
from SlicerUSSim.Logic.mri.bias import anatomy, estimate_field
from SlicerUSSim.Logic.mri.classification import class_names, classify
from SlicerUSSim.Logic.mri.coregistration import aligned
from SlicerUSSim.Logic.mri.filtering import guided_filter
from SlicerUSSim.Logic.mri.histogram import Histogram
from SlicerUSSim.Logic.mri.mixture import fit_mixture
from SlicerUSSim.Logic.mri.plausibility import enhancing
from SlicerUSSim.Logic.mri.samples import head_mri
from SlicerUSSim.Logic.mri.segmentation import estimate_noise, less_sure
from tests.conftest import rigid
from tests.remembered import segment_once
from validation.brain_phantoms import part_of, phantom, tissue_maps
from validation.brain_scores import scores


def with_rician_noise(volume: Volume, share: float, seed: int = 0) -> Volume:
    """Magnitude of a complex signal with noise of `share` x 255 in both channels, as in MRI."""
    rng = np.random.default_rng(seed)
    real, imaginary = (rng.normal(0, share * 255, volume.array.shape).astype(np.float32) for _ in range(2))
    return volume.with_array(np.hypot(volume.array + real, imaginary))


def dice(labels: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(3,) overlap for labels 1, 2, 3."""
    return np.array(
        [2 * ((labels == n) & (truth == n)).sum() / ((labels == n).sum() + (truth == n).sum()) for n in (1, 2, 3)]
    )


@pytest.fixture(scope="module")
def truth(mni):
    """CSF 1, grey 2, white 3 by the template's own probability maps."""
    t1, grey, white = mni
    g, w = grey.array / 255.0, white.array / 255.0
    labels = np.argmax(np.stack([np.clip(1 - g - w, 0, 1), g, w]), axis=0) + 1
    labels[t1.array == 0] = 0
    return labels


def test_tissues_do_not_depend_on_the_order_of_voxels_in_a_file():
    mri = head_mri(4.0)
    turned = Volume.from_sitk(sitk.DICOMOrient(mri.to_sitk(), "SPL"))
    found, other = segment_once(mri), segment_once(turned)
    assert other.labels.array.shape == turned.array.shape != mri.array.shape
    assert np.array_equal(other.labels.ijk_to_ras, turned.ijk_to_ras)
    back = Volume.from_sitk(sitk.DICOMOrient(other.labels.to_sitk(), "RAS"))
    assert np.array_equal(back.array, found.labels.array)
    for one, same in zip(other.posteriors, found.posteriors, strict=True):
        back = sitk.DICOMOrient(turned.with_array(one).to_sitk(), "RAS")
        assert np.array_equal(sitk.GetArrayFromImage(back), same)
    inside = other.evidence.to_whole(other.evidence.inside)
    assert np.array_equal(inside, other.brain.mask.array > 0)


@pytest.fixture(scope="module")
def mni2(mni) -> Volume:
    """Every other voxel of the template, 2 mm."""
    t1 = mni[0]
    return Volume(t1.array[::2, ::2, ::2].copy(), t1.ijk_to_ras @ np.diag([2.0, 2.0, 2.0, 1.0]))


def brain_of(share: dict[str, float], noise: float, seed: int) -> np.ndarray:
    """(voxels,) intensities with CSF 40, grey 90 and white 120, a quarter of them mixed with the next tissue."""
    rng = np.random.default_rng(seed)
    means = {"csf": 40.0, "grey": 90.0, "white": 120.0}
    count = 120_000
    pure = [np.full(int(0.75 * count * share[name]), mean) for name, mean in means.items()]
    mixed = [rng.uniform(40, 90, count // 8), rng.uniform(90, 120, count // 8)]
    values = np.concatenate([*pure, *mixed])
    return (values + rng.normal(0, noise, len(values))).astype(np.float32)


@pytest.mark.slow
def test_the_template_with_five_percent_noise_is_segmented_well(mni, truth):
    mri, mask = mni[0], mni[0].with_array((mni[0].array > 0).astype(np.uint8))
    noisy = with_rician_noise(mri, 0.05)
    plain = dice(
        segment_mri(noisy, mask=mask, filter_radius=0, bias_correction=False, thin_sulci=False).labels.array, truth
    )
    result = segment_mri(noisy, mask=mask, bias_correction=False, thin_sulci=False)
    filtered = dice(result.labels.array, truth)
    assert result.tissue_names == ("csf", "grey matter", "white matter")
    assert filtered.mean() > plain.mean()
    assert filtered[1:].min() >= 0.84
    assert result.noise == pytest.approx(0.05 * 255, rel=0.1)
    assert "MNI152 atlas" in result.notes[1]
    assert not result.warnings


def test_brighter_voxels_never_have_a_darker_class():
    """Also far beyond the outermost means, where outliers are: bright ones are white matter in plain T1."""
    values = brain_of({"csf": 0.15, "grey": 0.45, "white": 0.4}, 5.0, 1)
    values = np.concatenate([values, np.linspace(0, 300, 500, dtype=np.float32)])
    labels = classify(values[None], ("t1",), class_names(("t1",), None), None).posteriors.argmax(axis=0)
    assert (np.diff(labels[np.argsort(values, kind="stable")].astype(int)) >= 0).all()
    assert (labels[values > 200] == 2).all()


def test_what_is_brighter_than_white_matter_enhances():
    """And nothing of a healthy brain does."""
    values = brain_of({"csf": 0.15, "grey": 0.45, "white": 0.4}, 5.0, 2)
    vessels = np.random.default_rng(3).uniform(180, 400, 2000).astype(np.float32)
    names = class_names(("t1gd",), None)
    assert names[3] == "enhancing"
    healthy = classify(values[None], ("t1gd",), names, None)
    assert healthy.shares[3] < 0.005
    found = classify(np.concatenate([values, vessels])[None], ("t1gd",), names, None)
    label = found.posteriors.argmax(axis=0)
    assert (label[-2000:] == 3).mean() > 0.97 and (label[:-2000] == 3).mean() < 0.005


def test_posteriors_are_calibrated_on_voxels_of_known_content():
    """Of the voxels given 70 %, 60 to 80 % are right; the truth is what fills more than half of a voxel."""
    rng = np.random.default_rng(4)
    content = np.concatenate([np.zeros(15_000), rng.uniform(0, 1, 20_000), np.ones(45_000), rng.uniform(1, 2, 20_000),
                              np.full(40_000, 2.0)])  # fmt: skip
    values = np.interp(content, [0, 1, 2], [40, 90, 120]) + rng.normal(0, 8, len(content))
    found = classify(values[None].astype(np.float32), ("t1",), class_names(("t1",), None), None)
    sure = found.posteriors.max(axis=0)
    is_right = found.posteriors.argmax(axis=0) == np.rint(content)
    near = (sure > 0.65) & (sure < 0.75)
    assert near.sum() > 1000 and 0.6 < is_right[near].mean() < 0.8


def test_two_channels_tell_apart_what_neither_does():
    """Grey and white matter are alike in T2, CSF and grey matter in this T1."""
    rng = np.random.default_rng(5)
    tissue = rng.choice(3, 60_000, p=[0.15, 0.5, 0.35])
    values = np.stack([np.array([80, 90, 120.0])[tissue], np.array([300, 120, 115.0])[tissue]])
    values += rng.normal(0, 6, values.shape)
    values = values.astype(np.float32)
    both = classify(values, ("t1", "t2"), class_names(("t1", "t2"), None), None).posteriors.argmax(axis=0)
    alone = classify(values[:1], ("t1",), class_names(("t1",), None), None).posteriors.argmax(axis=0)
    assert (both == tissue).mean() > 0.97 > (alone == tissue).mean()


def test_a_prior_moves_only_what_intensity_leaves_open():
    values = brain_of({"csf": 0.15, "grey": 0.45, "white": 0.4}, 8.0, 6)  # a contrast that leaves the atlas weak
    prior = np.full((3, len(values)), 1 / 3, np.float32)
    prior[:, ::2] = np.array([[0.05], [0.9], [0.05]])
    names = class_names(("t1",), None)
    led = classify(values[None], ("t1",), names, prior)
    is_grey = led.posteriors.argmax(axis=0) == 1
    between, clear = np.abs(values - 105) < 3, values > 140
    assert is_grey[::2][between[::2]].mean() > is_grey[1::2][between[1::2]].mean() + 0.05
    assert is_grey[::2][clear[::2]].mean() < 0.02


def test_an_empty_bin_changes_nothing_and_the_fit_is_deterministic():
    values = brain_of({"csf": 0.15, "grey": 0.45, "white": 0.4}, 5.0, 7)
    histogram = Histogram.of(values[None], ("t1",))
    assert histogram.points.counts.sum() == len(values)
    start = np.array([[50.0], [90.0], [110.0]])
    first, second = (fit_mixture(histogram.points, start, np.array([10.0])) for _ in range(2))
    np.testing.assert_array_equal(first.means, second.means)
    shares, outside = first.shares(histogram.points)
    np.testing.assert_allclose(shares.sum(axis=0) + outside, 1, atol=1e-9)


@pytest.mark.parametrize("radius", [1, 5])
def test_the_guided_filter_is_what_its_definition_says(radius):
    """He et al., eq. 5, 6, 8, with models weighted by the inverse of their window's variance."""
    rng = np.random.default_rng(2)
    image = rng.normal(100, 20, (13, 17, 21)).astype(np.float32)
    mask = rng.random(image.shape) < 0.8
    epsilon, size, inside = 150.0, 2 * radius + 1, mask.astype(float)

    def box(values):
        return uniform_filter(values * inside, size, mode="constant") * size**3

    centred = np.where(mask, image - image[mask].mean(), 0).astype(float)
    count = np.maximum(box(np.ones_like(centred)), 1)
    mean = box(centred) / count
    least = 1e-4 * image[mask].var()
    variance = np.maximum(box(centred**2) / count - mean**2, 0) + least
    a = variance / (variance + epsilon)
    weight = 1 / variance
    expected = (box(weight * a) * centred + box(weight * (1 - a) * mean)) / np.maximum(box(weight), 1e-12)
    found = guided_filter(image, mask, radius, epsilon)
    np.testing.assert_allclose(found[mask], (expected + image[mask].mean())[mask], atol=0.02)
    assert (found[~mask] == 0).all()


@pytest.mark.parametrize("sigma", [1.0, 12.0])
def test_noise_is_estimated_beside_edges(sigma):
    image = np.where(np.indices((40, 40, 40)).sum(axis=0) % 20 < 10, 80.0, 140.0)
    noisy = image + np.random.default_rng(4).normal(0, sigma, image.shape)
    assert estimate_noise(noisy.astype(np.float32), np.ones(image.shape, bool)) == pytest.approx(sigma, rel=0.35)


def test_classes_are_named_by_contrast():
    assert class_names(("t1",), None) == ("csf", "grey matter", "white matter")
    assert class_names(("t2",), None) == ("white matter", "grey matter", "csf")
    assert class_names(("flair",), 4) == ("csf", "white matter", "grey matter", "tumour")


@pytest.mark.slow
def test_the_table_has_means_and_deviations_in_any_unit():
    head, unit = head_mri(4.0), 1e-6
    result = segment_mri(head.with_array((head.array * np.float64(unit)).astype(np.float32)), thin_sulci=False)
    lines = result.table().splitlines()[1:]
    assert len(lines) == len(result.means) == 3 and len(set(map(len, lines))) == 1
    for line, mean, deviation in zip(lines, result.means, result.standard_deviations, strict=True):
        numbers = [float(text) for text in line.split()[-2:]]
        assert numbers == pytest.approx([mean, deviation], rel=0.006, abs=0.006 * unit)


def test_thin_sulci_are_found_on_their_middle_and_only_there():
    """A sheet one voxel thick, a third of the way from grey to CSF, between banks of grey matter."""
    rng = np.random.default_rng(5)
    image = np.full((40, 40, 40), 85.0)
    image[:, :, :8] = 115.0
    image[:, :, 32:] = 115.0
    image[30:, :, 10:30] = 40.0  # real CSF, so that the mixture has its class
    image[:28, 20, 10:30] = 65.0
    image += rng.normal(0, 1.0, image.shape)
    mri = Volume(image.astype(np.float32), np.eye(4))
    mask = mri.with_array(np.ones(image.shape, np.uint8))
    result = segment_mri(mri, mask=mask, thin_sulci=True)
    assert result.tissue_names[3] == "leptomeninges"
    sulcus = result.labels.array == 4
    assert sulcus[4:24, 20, 12:28].mean() > 0.95
    assert sulcus[4:24, 12:18, 12:28].mean() < 0.01
    assert not (segment_mri(mri, mask=mask, thin_sulci=False).labels.array == 4).any()


def test_a_brain_of_which_two_thirds_are_white_matter_keeps_its_grey():
    """Starts with less white matter once put both means into the one peak: 110 and 110 instead of 85 and 110."""
    np.testing.assert_allclose(segment_once(head_mri(3.0), thin_sulci=False).means, [40, 85, 110], atol=2)


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(contrast="pd"), "contrast is 'pd', expected one of t1, t1gd, t2, flair, ct"),
        (dict(classes=4), "classes is 4, expected 3 for contrast t1"),
        (dict(filter_radius=-1), "filter_radius is -1"),
        (dict(filter_epsilon=float("nan")), "filter_epsilon is nan"),
        (dict(mask=Volume(np.zeros((4, 4, 4)), np.eye(4))), "expected the same grid"),
    ],
)
def test_wrong_arguments_are_named(change, message):
    with pytest.raises(SimulationError, match=message):
        segment_mri(head_mri(4.0), **change)


@pytest.mark.slow
def test_a_second_mri_without_much_of_the_brain_is_refused(mni2):
    j = np.flatnonzero((mni2.array > 0).any(axis=(0, 2)))
    end = int(j[0] + 0.6 * len(j))
    cropped = Volume(mni2.array[:, :end].copy(), mni2.ijk_to_ras)
    with pytest.raises(SimulationError, match=r"t1gd: has data \(other than 0\) in [67]\d% of the brain of the first"):
        segment_mri(mni2, contrast="t1", others={"t1gd": cropped})


@pytest.mark.slow
def test_a_label_map_is_refused_as_second_mri(mni2):
    labels = mni2.with_array(np.digitize(mni2.array, [20, 60, 90]).astype(np.uint8))
    refusal = r"t2 has only 4 different values, as a mask or label map has.*--add tumour=FILE"
    with pytest.raises(SimulationError, match=refusal):
        segment_mri(mni2, contrast="t1", others={"t2": labels})
    parts = labels.array * (1 + np.indices(mni2.array.shape)[2] // 12)  # many labels
    with pytest.raises(SimulationError, match="t2 is a label map"):
        segment_mri(mni2, contrast="t1", others={"t2": mni2.with_array(parts.astype(np.uint8))})


@pytest.mark.slow
def test_thick_slices_of_a_turned_head_are_registered(mni):
    """A T2 of 5 mm slices, turned by 10 degrees."""
    t1, axis = mni[0], 2
    inside = t1.array > 20
    noise = np.random.default_rng(3).normal(0.0, 4.0, t1.array.shape)
    thick = np.where(inside, 160.0 - t1.array, 0.0) + noise
    thick = thick[: thick.shape[0] // 5 * 5].reshape(-1, 5, *thick.shape[1:]).mean(axis=1)
    matrix = t1.ijk_to_ras @ np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 5, 2], [0, 0, 0, 1.0]])
    turned = rigid(Rotation.from_rotvec(10.0 * np.eye(3)[axis], degrees=True).as_matrix(), [6.0, -4.0, 9.0])
    moved, line = aligned(Volume(thick.astype(np.float32), turned @ matrix), t1, inside, "t2")
    angle = float(line.split("turned by ")[1].split()[0])
    assert angle == pytest.approx(10.0, abs=0.6)
    assert np.corrcoef(moved.array[inside], t1.array[inside])[0, 1] < -0.75


def test_less_sure_posteriors_shrink_log_odds_and_change_no_label():
    posteriors = np.random.default_rng(0).dirichlet([0.3, 1.0, 1.0], 500).T.astype(np.float32)
    found = less_sure(posteriors)
    np.testing.assert_allclose(found.sum(axis=0), 1.0, rtol=1e-5)
    np.testing.assert_array_equal(found.argmax(axis=0), posteriors.argmax(axis=0))
    before, after = (np.log(p[2] / p[1]) for p in (posteriors, found))
    np.testing.assert_allclose(after, 0.9 * before, atol=1e-3)


def test_a_registration_is_the_same_every_time():
    """Whatever the order of threads and the memory before; else kept sheets are not found again."""
    atlas, head = mni152(), head_mri(4.0)
    found = set()
    for _ in range(2):
        fit = register_atlas(head, head.array > 0, atlas)
        found.add((fit.patient_to_atlas.tobytes(), fit.dice))
        np.ones(500_000)  # uses memory again
    assert len(found) == 1


@pytest.mark.slow
def test_a_fifth_of_the_field_of_one_persons_phantom_is_left_at_most():
    """Colin27, whose grey and white matter differ from place to place."""
    maps = tissue_maps("colin27")
    atlas = mni152()
    if maps is None:
        pytest.skip("needs Colin27")
    case = phantom(maps, noise=0.03, bias=0.2)
    inside = case.mask.array > 0
    fit = register_atlas(case.mri, inside, atlas)
    found = estimate_field(case.mri.array, inside, case.mri.spacing_mm, "t1", fit.prior(case.mri, inside))
    tissue = case.truth.array > 1
    true = np.log(case.bias[tissue])
    left = np.log((found.factor / anatomy(fit, case.mri, inside.shape))[tissue]) - true
    assert left.std() < 0.19 * true.std()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "bias", "least"),
    [("quarter", 0.0, 0.95), ("part of a coronal slab", 0.2, 0.94)],
)
def test_white_matter_of_a_part_of_a_brain_is_not_a_bias_field(part, bias, least):
    maps = tissue_maps("colin27")
    if maps is None:
        pytest.skip("needs Colin27")
    case = part_of(phantom(maps, noise=0.03, bias=bias, seed=3), part)
    found = segment_mri(case.mri, mask=case.mask, thin_sulci=False)
    assert found.atlas is None
    names = dict(enumerate(found.tissue_names, start=1))
    assert scores(found.labels.array, names, case)["grey and white"] >= least
    assert any(("not removed" if not bias else "removed by a polynomial") in line for line in found.notes)
    if bias:
        tissue = case.truth.array > 1
        true = np.log(case.bias[tissue])
        left = np.log(case.mri.array[tissue] / found.corrected[tissue]) - true
        assert left.std() < 0.4 * true.std()


def test_contrast_agent_that_was_not_given_is_a_warning():
    image = np.random.default_rng(0).normal(100.0, 3.0, (60, 60, 60)).astype(np.float32)
    found, inside = SimpleNamespace(grey_and_white=(70.0, 100.0)), np.ones(image.shape, bool)
    assert enhancing(image, inside, found, 0.001) == []
    image[10:25, 10:25, 10:25] = 160.0
    (line,) = enhancing(image, inside, found, 0.001)
    assert line.startswith("contrast is t1, but 3.4 ml in one piece are far brighter than white matter")
