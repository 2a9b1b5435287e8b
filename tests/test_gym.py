"""The environment for agents passes Gymnasium's own checks, and rewards a probe that comes nearer."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from SlicerUSSim.Logic import SimulationError, SimulationSettings, TissueTable, UltrasoundSimulator
from tests.conftest import block

gymnasium = pytest.importorskip("gymnasium", reason="needs: pip install '.[gym]'")
SIZE = (32, 40)


@pytest.fixture(scope="module")
def patient() -> UltrasoundSimulator:
    labels = block(lambda x, y, z: np.select([x**2 + y**2 + z**2 > 45**2, z > 20], [0, 1], 2), (50, 50, 50), 2.0)
    table = TissueTable.named(["grey matter", "white matter"])
    return UltrasoundSimulator(labels, table, SimulationSettings(quality="draft"))


def environment(patient, **values):
    from SlicerUSSim.gym import FindView

    return FindView(simulator=patient, image_size=SIZE, **values)


def test_gymnasium_finds_nothing_wrong_with_the_environment(patient):
    from gymnasium.utils.env_checker import check_env

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # VTK 9.6.0 with NumPy 2.5
        warnings.filterwarnings("ignore", "Setting the shape", DeprecationWarning)
        check_env(environment(patient), skip_render_check=True)
    assert np.ptp(environment(patient).reset(seed=1)[0]) > 50


def test_the_way_to_the_target_is_the_reward_and_ends_there(patient):
    made = environment(patient)
    image, about = made.reset(seed=3)
    assert image.shape == (*SIZE, 1) and image.max() > 50 and about["distance_mm"] > 4.0
    made._pose = made._moved(made.target, np.array([1.0, 0.0, 0.0, 0.0, 0.5]))
    near = made.distance_mm()
    _, reward, found, ended, about = made.step(np.array([-1.0, 0.0, 0.0, 0.0, 0.0]))
    _, more, found, ended, about = made.step(np.array([0.0, 0.0, 0.0, 0.0, -0.5]))
    assert found and not ended and about["distance_mm"] < 4.0 < near
    assert reward + more == pytest.approx(near - about["distance_mm"] + 10.0)


def test_a_seed_repeats_an_episode_and_steps_end_it(patient):
    import SlicerUSSim.gym  # noqa: F401, which registers it

    made = gymnasium.make("SlicerUSSim/FindView-v0", simulator=patient, image_size=SIZE, max_episode_steps=3)
    runs = []
    for _ in range(2):
        runs.append([made.reset(seed=8)[0], *(made.step(np.full(5, 0.5)) for _ in range(3))])
    np.testing.assert_array_equal(runs[0][0], runs[1][0])
    np.testing.assert_array_equal(runs[0][3][0], runs[1][3][0])
    assert [run[3] for run in runs[0][1:]] == [False, False, True]


def test_environments_are_vectorised_and_registered(patient):
    import SlicerUSSim.gym

    many = gymnasium.make_vec("SlicerUSSim/FindView-v0", num_envs=2, simulator=patient, image_size=SIZE)
    images, _ = many.reset(seed=1)
    assert images.shape == (2, *SIZE, 1) and (images[0] != images[1]).any()
    assert many.step(many.action_space.sample())[1].shape == (2,)
    assert SlicerUSSim.gym.FindView.__module__ == "SlicerUSSim.gym.find_view"


def test_what_makes_no_environment_is_said(patient):
    with pytest.raises(SimulationError, match="view is 'apical', expected one of temporal"):
        environment(patient, view="apical")
    with pytest.raises(SimulationError, match=r"within_mm is 0, expected a number between 0.1 and 100"):
        environment(patient, within_mm=0)
