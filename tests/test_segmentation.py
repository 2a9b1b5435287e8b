"""Segmentation (docs/physics.md#1-from-mri-to-tissues): a real template, the filter by its definition, bad input."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.ndimage import uniform_filter

from SlicerUSSim.Logic import SimulationError, Volume, segment_mri
from SlicerUSSim.Logic.mri.filtering import guided_filter
from SlicerUSSim.Logic.mri.mixture import classify, fit_mixture
from SlicerUSSim.Logic.mri.samples import head_mri
from SlicerUSSim.Logic.mri.segmentation import estimate_noise


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


def test_mni_with_five_percent_noise_meets_the_rows_of_the_design(mni, truth):
    """Mean Dice of CSF, grey and white >= 0.83 (plain EM 0.79), white >= 0.82."""
    mri, mask = mni[0], mni[0].with_array((mni[0].array > 0).astype(np.uint8))
    noisy = with_rician_noise(mri, 0.05)
    plain = dice(segment_mri(noisy, mask=mask, filter_radius=0).labels.array, truth)
    result = segment_mri(noisy, mask=mask)
    filtered = dice(result.labels.array, truth)
    assert result.tissue_names == ("csf", "grey matter", "white matter")
    assert plain.mean() == pytest.approx(0.79, abs=0.02)
    assert filtered.mean() >= 0.83 and filtered[2] >= 0.82
    assert result.noise == pytest.approx(0.05 * 255, rel=0.1)


def test_mni_without_noise_is_not_below_plain_em(mni, truth):
    mri, mask = mni[0], mni[0].with_array((mni[0].array > 0).astype(np.uint8))
    plain = dice(segment_mri(mri, mask=mask, filter_radius=0).labels.array, truth)
    filtered = dice(segment_mri(mri, mask=mask).labels.array, truth)
    assert filtered.mean() >= plain.mean()
    # Without a mask, Otsu and the largest component find the brain as well.
    own = segment_mri(mri).labels.array
    inside = mri.array > 0
    assert 2 * ((own > 0) & inside).sum() / ((own > 0).sum() + inside.sum()) > 0.97


@given(st.integers(2, 4), st.integers(0, 2**16))
def test_the_likelihood_never_falls_and_classes_are_ordered(classes, seed):
    rng = np.random.default_rng(seed)
    centres = np.sort(rng.uniform(0, 200, classes))
    values = np.concatenate([rng.normal(c, rng.uniform(1, 20), rng.integers(200, 5000)) for c in centres])
    means, deviations, weights, likelihoods = fit_mixture(values.astype(np.float32), classes)
    assert (np.diff(likelihoods) > -1e-12).all()
    assert (np.diff(means) >= 0).all() and (deviations > 0).all() and weights.sum() == pytest.approx(1)


def test_a_known_mixture_is_recovered():
    rng = np.random.default_rng(1)
    values = np.concatenate([rng.normal(m, s, n) for m, s, n in ((40, 6, 20000), (90, 8, 60000), (120, 5, 40000))])
    means, deviations, weights, _ = fit_mixture(values, 3)
    np.testing.assert_allclose(means, [40, 90, 120], atol=0.5)
    np.testing.assert_allclose(deviations, [6, 8, 5], rtol=0.05)
    np.testing.assert_allclose(weights, [1 / 6, 1 / 2, 1 / 3], atol=0.01)


@given(
    st.lists(st.tuples(st.floats(0, 200), st.floats(1, 60), st.floats(0.01, 1)), min_size=2, max_size=4),
    st.floats(20, 200),
)
def test_brighter_voxels_never_have_a_darker_class(classes, beyond):
    """For all widths of the classes, and far beyond the outermost means."""
    means, deviations, weights = (np.array(column) for column in zip(*sorted(classes), strict=True))
    values = np.linspace(means[0] - beyond, means[-1] + beyond, 400, dtype=np.float32)
    labels = classify(values, means, deviations, weights / weights.sum())
    assert (np.diff(labels.astype(int)) >= 0).all()
    step = values[1] - values[0]
    assert (labels[values < means[0] - step] == 1).all()
    assert (labels[values > means[-1] + step] == len(means)).all()


def test_bright_voxels_beyond_white_matter_are_white_matter():
    """CSF is the widest class: by its posterior alone, both tails of the image and vessels would be its."""
    rng = np.random.default_rng(7)
    image = np.full((30, 40, 40), 90.0)
    image[:, :, 20:] = 120.0
    image += rng.normal(0, 2.0, image.shape)
    image[:, :10] = rng.normal(50, 25.0, image[:, :10].shape)
    image[10:20, 30:32, 30:32] = 190.0
    mri = Volume(image.astype(np.float32), np.eye(4))
    result = segment_mri(mri, mask=mri.with_array(np.ones(image.shape, np.uint8)), filter_radius=0)
    assert result.standard_deviations[0] > 3 * result.standard_deviations[1:].max()
    assert (result.labels.array[10:20, 30:32, 30:32] == 3).all()
    in_order = result.labels.array.ravel()[np.argsort(image.astype(np.float32).ravel(), kind="stable")]
    assert (np.diff(in_order.astype(int)) >= 0).all()


@pytest.mark.parametrize("radius", [1, 2, 5])
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


def test_a_strong_filter_flattens_and_a_weak_one_keeps():
    rng = np.random.default_rng(3)
    image = rng.normal(100, 5, (20, 20, 20)).astype(np.float32)
    mask = np.ones(image.shape, bool)
    assert guided_filter(image, mask, 2, 1e6).std() < 1
    np.testing.assert_allclose(guided_filter(image, mask, 2, 1e-6), image, atol=1e-2)
    np.testing.assert_array_equal(guided_filter(image, mask, 0, 1.0), image)


@pytest.mark.parametrize("sigma", [1.0, 4.0, 12.0])
def test_noise_is_estimated_beside_edges(sigma):
    image = np.where(np.indices((40, 40, 40)).sum(axis=0) % 20 < 10, 80.0, 140.0)
    noisy = image + np.random.default_rng(4).normal(0, sigma, image.shape)
    assert estimate_noise(noisy.astype(np.float32), np.ones(image.shape, bool)) == pytest.approx(sigma, rel=0.35)


@pytest.mark.parametrize(
    "contrast, order",
    [
        ("t1", ("csf", "grey matter", "white matter")),
        ("t2", ("white matter", "grey matter", "csf")),
        ("flair", ("csf", "white matter", "grey matter")),
    ],
)
def test_classes_are_named_by_contrast(contrast, order):
    head = head_mri(2.0)
    mri = head.with_array(np.where(head.array > 0, 160 - head.array, 0)) if contrast == "t2" else head
    result = segment_mri(mri, contrast=contrast)
    assert result.tissue_names == order
    assert (np.diff(result.means) > 0).all()


def test_posteriors_sum_to_one_inside_and_agree_with_the_labels():
    result = segment_mri(head_mri(2.0))
    posteriors = result.posteriors
    inside = result.labels.array > 0
    assert posteriors.shape == (3, *inside.shape) and posteriors.dtype == np.float32
    np.testing.assert_allclose(posteriors.sum(axis=0)[inside], 1, atol=1e-5)
    assert (posteriors[:, ~inside] == 0).all()
    agree = posteriors.argmax(axis=0)[inside] + 1 == result.labels.array[inside]
    assert agree.mean() > 0.99


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
    assert not (segment_mri(mri, mask=mask).labels.array == 4).any()


def test_bias_correction_saves_the_classes_of_a_shaded_image():
    head = head_mri(2.0)
    shade = np.linspace(0.72, 1.28, head.array.shape[0])[:, None, None].astype(np.float32)
    reference = segment_mri(head).labels.array
    shaded = head.with_array(head.array * shade)
    plain = (segment_mri(shaded).labels.array == reference)[reference > 0].mean()
    corrected = (segment_mri(shaded, bias_correction=True).labels.array == reference)[reference > 0].mean()
    assert corrected > max(plain + 0.1, 0.8)


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(contrast="ct"), "contrast is 'ct', expected one of t1, t1gd, t2, flair"),
        (dict(classes=7), "classes is 7, expected 3 for contrast t1"),
        (dict(filter_radius=-1), "filter_radius is -1"),
        (dict(filter_epsilon=float("nan")), "filter_epsilon is nan"),
        (dict(mask=Volume(np.zeros((4, 4, 4)), np.eye(4))), "expected the same grid"),
        (dict(device="no such device"), "no OpenCL device fits"),
    ],
)
def test_wrong_arguments_are_named(change, message):
    with pytest.raises(SimulationError, match=message):
        segment_mri(head_mri(4.0), **change)


def test_images_without_tissue_are_refused():
    grid = head_mri(4.0)
    with pytest.raises(SimulationError, match="not finite numbers"):
        segment_mri(grid.with_array(np.where(grid.array > 80, np.nan, grid.array)))
    with pytest.raises(SimulationError, match="MRI is constant"):
        segment_mri(grid.with_array(np.full_like(grid.array, 7)))
    with pytest.raises(SimulationError, match="mask is empty"):
        segment_mri(grid, mask=grid.with_array(np.zeros_like(grid.array)))
