"""The cost of the optimisation: equations 4 and 5 of the paper."""

import numpy as np
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra.numpy import arrays

from SlicerUSSim.Logic import LinearProbe, SimulationError, similarity
from SlicerUSSim.Logic.fitting.image_similarity import PatchComparison, Similarity, SimilaritySettings
from SlicerUSSim.Logic.opencl.device import Device
from tests.conftest import SPECKLE, block, simulator

images = arrays(np.uint8, st.tuples(st.integers(4, 40), st.integers(4, 40)))


def by_the_equations(a, b, patch, bins, weight):
    """Equations 4 and 5 implemented literally, patch by patch, for images that consist of complete patches."""
    distances = []
    for y in range(0, a.shape[0], patch):
        for x in range(0, a.shape[1], patch):
            p = np.histogram(a[y : y + patch, x : x + patch], bins, (0, 256))[0] / patch**2
            q = np.histogram(b[y : y + patch, x : x + patch], bins, (0, 256))[0] / patch**2
            distances.append(np.sqrt(max(1.0 - np.sqrt(p * q).sum(), 0.0)))
    sad = np.abs(a / 255.0 - b / 255.0).mean()
    return np.mean(distances) + weight * sad, np.mean(distances), sad


def test_cost_is_that_of_the_equations():
    random = np.random.default_rng(0)
    a, b = random.integers(0, 256, (2, 40, 60), dtype=np.uint8)
    found = similarity(a, b, (0.5, 0.5), patch_mm=5.0, bins=16, sad_weight=0.7)
    total, rho, sad = by_the_equations(a, b, 10, 16, 0.7)
    assert (found.total, found.bhattacharyya, found.sad) == pytest.approx((total, rho, sad), abs=1e-6)


def compared(comparison: PatchComparison, image: np.ndarray) -> Similarity:
    comparison.run(comparison.device.upload(image))
    return comparison.result()


@pytest.mark.parametrize("histogram_weight", [0.0, 1.0, 2.0])
def test_both_parts_of_the_cost_have_a_weight(histogram_weight):
    random = np.random.default_rng(4)
    a, b = random.integers(0, 256, (2, 40, 60), dtype=np.uint8)
    weights = SimilaritySettings(5.0, 16, sad_weight=0.7, histogram_weight=histogram_weight)
    found = compared(PatchComparison(Device.get(), b, np.ones(b.shape, bool), (0.5, 0.5), weights), a)
    _, rho, sad = by_the_equations(a, b, 10, 16, 0.7)
    assert (found.bhattacharyya, found.sad) == pytest.approx((rho, sad), abs=1e-6)
    assert found.total == pytest.approx(histogram_weight * rho + 0.7 * sad, abs=2e-6)


@given(images, st.integers(2, 256), st.floats(0.5, 20.0))
def test_an_image_is_at_no_distance_from_itself(image, bins, patch_mm):
    assert similarity(image, image, (1.0, 1.0), patch_mm=patch_mm, bins=bins).total == 0.0


@given(images, st.integers(0, 2**32 - 1))
def test_cost_is_symmetric_and_within_its_bounds(image, seed):
    other = np.random.default_rng(seed).integers(0, 256, image.shape, dtype=np.uint8)
    there, back = similarity(image, other, (1.0, 1.0)), similarity(other, image, (1.0, 1.0))
    assert there.total == pytest.approx(back.total)
    assert 0.0 <= there.bhattacharyya <= 1.0 and 0.0 <= there.sad <= 1.0


def test_black_against_white_is_as_far_as_can_be():
    found = similarity(np.zeros((20, 20), np.uint8), np.full((20, 20), 255, np.uint8), (1.0, 1.0))
    assert (found.bhattacharyya, found.sad, found.total) == (1.0, 1.0, 2.0)


@given(
    st.integers(8, 90), st.integers(8, 90), st.integers(2, 256), st.floats(0.7, 30.0), st.floats(0.0, 2.0),
    st.integers(0, 2**32 - 1),
)  # fmt: skip
def test_device_agrees_with_numpy(rows, columns, bins, patch_mm, weight, seed):
    random = np.random.default_rng(seed)
    a, b = random.integers(0, 256, (2, rows, columns), dtype=np.uint8)
    mask = random.random((rows, columns)) > 0.3
    mask[0, 0] = True
    spacing = (0.7, 0.4)
    settings = SimilaritySettings(patch_mm, bins, weight)
    on_device = compared(PatchComparison(Device.get(), b, mask, spacing, settings), a)
    plain = similarity(a, b, spacing, patch_mm=patch_mm, bins=bins, sad_weight=weight, mask=mask)
    assert on_device.total == pytest.approx(plain.total, abs=2e-6)
    assert on_device.sad == pytest.approx(plain.sad, abs=1e-6)


def test_pixels_outside_the_mask_do_not_count():
    random = np.random.default_rng(1)
    a, b = random.integers(0, 256, (2, 30, 30), dtype=np.uint8)
    mask = np.zeros((30, 30), bool)
    mask[5:25, 5:25] = True
    before = similarity(a, b, (1.0, 1.0), mask=mask)
    a[~mask] = 0
    b[~mask] = 255
    assert similarity(a, b, (1.0, 1.0), mask=mask) == before


def test_another_draw_of_the_speckle_costs_little_and_another_level_much():
    labels = block(lambda x, y, z: np.ones_like(x), (16, 30, 8))
    probe = LinearProbe(20, 25, scan_lines=64)
    pose = np.eye(4)
    pose[:3, 3] = 0.0, -25.0, 0.0
    one, other = (simulator(labels, SPECKLE, seed=seed).simulate(probe, pose) for seed in (1, 2))
    brighter = np.clip(one.image.astype(int) + 25, 0, 255).astype(np.uint8)
    redrawn = similarity(one.image, other.image, one.pixel_spacing_mm).bhattacharyya
    shifted = similarity(one.image, brighter, one.pixel_spacing_mm).bhattacharyya
    assert redrawn < 0.15
    assert shifted > 2.0 * redrawn


def test_bad_input_is_refused_in_one_line():
    image = np.zeros((8, 8), np.uint8)
    for arguments, options, message in (
        ((image, np.zeros((8, 9), np.uint8), (1, 1)), {}, "shapes (8, 8) and (8, 9)"),
        ((image.astype(float), image, (1, 1)), {}, "float64"),
        ((image, image, (1, 1)), {"mask": np.zeros((8, 8), bool)}, "do not overlap"),
        ((image, image, (1, 1)), {"mask": np.ones((9, 8), bool)}, "(9, 8)"),
        ((image, image, (1, 1)), {"bins": 1}, "bins is 1"),
        ((image, image, (1, 1)), {"bins": 2.5}, "bins is 2.5"),
        ((image, image, (1, 1)), {"patch_mm": -1.0}, "patch_mm is -1.0"),
    ):
        with pytest.raises(SimulationError) as caught:
            similarity(*arguments, **options)
        assert message in str(caught.value) and "\n" not in str(caught.value)
