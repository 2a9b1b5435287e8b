"""Amplifier noise: different in every image, the same when an image is repeated, and the same throughout a fit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic import LinearProbe, SimulationError, seed_of_pose
from SlicerUSSim.Logic.fitting.appearance import AppearanceModel
from SlicerUSSim.Logic.imaging.compounding import Compounder, sweep_grid
from SlicerUSSim.Logic.probe.poses import slide_sweep
from tests.conftest import FLUID, block, even_display, rigid, simulator

PROBE = LinearProbe(40, 50, scan_lines=161)
POSE = rigid(np.eye(3), [0, -25, 0])
#: Nothing echoes in fluid: what is seen is noise.
NOISY = even_display(gain_db=30.0, tgc_db_cm_mhz=0.0, noise_db=-40.0)


@pytest.fixture(scope="module")
def fluid():
    return simulator(block(lambda x, y, z: np.ones_like(x)), FLUID, seed=3)


def likeness(a, b) -> float:
    """The largest correlation of two frames' noise, one against the other shifted by up to three samples and lines."""
    a, b = (np.asarray(frame.envelope, float) - frame.envelope.mean() for frame in (a, b))
    inner = a[3:-3, 3:-3]
    return max(
        abs(np.corrcoef(inner.ravel(), b[3 + i : b.shape[0] - 3 + i, 3 + j : b.shape[1] - 3 + j].ravel())[0, 1])
        for i in range(-3, 4)
        for j in range(-3, 4)
    )


def test_without_a_noise_seed_the_noise_is_what_it_always_was(fluid):
    plain, zero = fluid.simulate(PROBE, POSE, NOISY), fluid.simulate(PROBE, POSE, NOISY, noise_seed=0)
    np.testing.assert_array_equal(plain.envelope, zero.envelope)
    was = [0.01289186, 0.01239145, 0.01958689, 0.00845028, 0.00612079, 0.00368057]
    np.testing.assert_allclose(plain.envelope[7, 100:106], was, rtol=1e-4)


@pytest.mark.parametrize("other", [1, 2**32 - 1])
def test_another_noise_seed_is_another_noise_of_the_same_level(fluid, other):
    one, drawn, again = (fluid.simulate(PROBE, POSE, NOISY, noise_seed=seed) for seed in (0, other, other))
    np.testing.assert_array_equal(drawn.image, again.image)
    assert likeness(one, one) == pytest.approx(1.0) and likeness(one, drawn) < 0.03
    assert (drawn.envelope**2).mean() == pytest.approx((one.envelope**2).mean(), rel=0.02)


@pytest.mark.parametrize("seed", [-1, 2**32, 0.5])
def test_a_noise_seed_that_is_none_is_refused(fluid, seed):
    with pytest.raises(SimulationError, match=r"noise_seed is .*, expected a whole number from 0 to 4294967295"):
        fluid.simulate(PROBE, POSE, NOISY, noise_seed=seed)


def test_images_of_a_sweep_have_noise_of_their_own(fluid):
    poses = [POSE] * 3
    frames = list(fluid.sweep(PROBE, poses, NOISY))
    np.testing.assert_array_equal(frames[0].image, fluid.simulate(PROBE, POSE, NOISY).image)
    for number, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, fluid.simulate(PROBE, POSE, NOISY, noise_seed=number).image)
    assert max(likeness(a, b) for a, b in zip(frames, frames[1:] + frames[:1], strict=True)) < 0.03
    for frame, again in zip(frames, fluid.sweep(PROBE, poses, NOISY), strict=True):
        np.testing.assert_array_equal(frame.image, again.image)


def test_a_volume_is_compounded_of_the_images_of_the_sweep(fluid):
    poses = slide_sweep(POSE, 4.0, 5)
    grid = sweep_grid(PROBE, poses, 1.0)
    compounder = Compounder(grid, PROBE)
    for frame in fluid.sweep(PROBE, poses, NOISY):
        compounder.add(frame)
    volume = fluid.volume(PROBE, poses, NOISY, like=grid)
    assert volume.array.any()
    np.testing.assert_array_equal(volume.array, compounder.volume().array)


def test_a_fit_has_one_noise_at_every_pose_and_evaluation(fluid):
    other = rigid(np.eye(3), [3, -22, 1])
    model = AppearanceModel(fluid, PROBE, [POSE, other], {"fluid": ("mu0",)})
    tissues = fluid.medium.tissues
    images = [model.image(number, tissues, NOISY) for number in (0, 1, 0)]
    np.testing.assert_array_equal(images[0], images[1])
    np.testing.assert_array_equal(images[0], images[2])
    np.testing.assert_array_equal(images[0], fluid.simulate(PROBE, POSE, NOISY).image)


# ---- the seed of a pose ----------------------------------------------------------------------------------------------

ANGLES = st.tuples(*[st.floats(-180, 180)] * 3)
PLACES = st.tuples(*[st.floats(-300, 300)] * 3)
POSES = st.builds(lambda a, p: rigid(Rotation.from_euler("xyz", a, degrees=True).as_matrix(), p), ANGLES, PLACES)
TIDY = st.builds(
    lambda turns, tenths: rigid(Rotation.from_euler("xyz", np.multiply(turns, 15), degrees=True).as_matrix(), tenths),
    st.tuples(*[st.integers(-12, 12)] * 3),
    st.tuples(*[st.integers(-400, 400).map(lambda tenths: tenths / 16)] * 3),
)


@given(pose=POSES, parent=POSES)
def test_a_pose_keeps_its_seed_under_any_parents_that_give_it(pose, parent):
    again = parent @ (np.linalg.inv(parent) @ pose)
    assert 0 <= seed_of_pose(pose) < 2**32
    assert seed_of_pose(again) == seed_of_pose(pose)


@given(pose=TIDY, jitter=st.tuples(*[st.floats(-1e-6, 1e-6)] * 3), turn=st.tuples(*[st.floats(-1e-7, 1e-7)] * 3))
def test_a_pose_as_people_set_it_does_not_flicker_for_a_nanometre(pose, jitter, turn):
    moved = pose.copy()
    moved[:3, 3] += jitter
    moved[:3, :3] += np.diag(turn)
    assert seed_of_pose(moved) == seed_of_pose(pose)


def test_poses_of_a_sweep_have_seeds_of_their_own():
    poses = slide_sweep(POSE, 20.0, 1001)  # 0.02 mm apart
    assert len({seed_of_pose(pose) for pose in poses}) == len(poses)
    turned = [POSE @ rigid(Rotation.from_euler("z", 0.02 * n, degrees=True).as_matrix(), [0, 0, 0]) for n in range(99)]
    assert len({seed_of_pose(pose) for pose in turned}) == len(turned)


def test_without_a_pose_there_is_no_seed():
    with pytest.raises(SimulationError, match=r"probe_to_ras has shape \(3, 3\), expected \(4, 4\)"):
        seed_of_pose(np.eye(3))
