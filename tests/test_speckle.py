"""Speckle is fixed in the patient: with sparse lines, small motions, other directions; linear in mu0 and sigma0."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from SlicerUSSim.Logic import LinearProbe
from SlicerUSSim.Logic.verification.measurement import correlation, level_db
from SlicerUSSim.Logic.verification.validation import ORIENTATIONS
from tests.conftest import SPECKLE, block, rigid, simulator

LINEAR = LinearProbe(40, 50, scan_lines=161, focus_mm=25, elevation_focus_mm=25)
SOLID = block(lambda x, y, z: np.ones_like(x), half_mm=(48, 48, 48))
SEEDS = range(6)


def at_depth(signal: np.ndarray, frame, depth_mm: float, half_mm: float = 1.0) -> np.ndarray:
    first, last = ((depth_mm + s * half_mm) / frame.sample_interval_mm for s in (-1, 1))
    return signal[:, int(first) : int(last)]


@pytest.fixture(scope="module")
def simulators():
    return [simulator(SOLID, SPECKLE, seed=seed) for seed in SEEDS]


def test_lines_far_apart_see_as_much_as_lines_close_together():
    """Twelve millimetres between scan lines: enough lines are traced between them to fill every beam."""
    sparse = LinearProbe(48, 40, scan_lines=5, focus_mm=25, elevation_focus_mm=25)
    levels = [
        level_db(simulator(SOLID, SPECKLE, seed=s).simulate(sparse, rigid(np.eye(3), [0, -20, 0])).iq) for s in range(8)
    ]
    assert np.mean(levels) == pytest.approx(10 * np.log10(SPECKLE.scatterer_variance), abs=0.6)


def test_moving_by_a_fraction_of_a_line_keeps_the_speckle(simulators):
    """Half a line to the side, the mean of two neighbours comes close; nothing flickers between grid positions."""
    probe = replace(LINEAR, scan_lines=201)
    here = simulators[0].simulate(probe, rigid(np.eye(3), [0, -25, 0])).iq
    moved = simulators[0].simulate(probe, rigid(np.eye(3), [0.1, -25, 0])).iq
    assert correlation(0.5 * (here[1:] + here[:-1]), moved[:-1]) > 0.97


def test_the_same_pose_gives_the_same_bits_and_another_seed_another_patient(simulators):
    pose = rigid(ORIENTATIONS["oblique"], [0, -25, 0])
    once = simulators[0].simulate(LINEAR, pose)
    simulators[0].forget_echoes()
    again = simulators[0].simulate(LINEAR, pose)
    np.testing.assert_array_equal(once.iq, again.iq)
    np.testing.assert_array_equal(once.image, again.image)
    other = simulators[1].simulate(LINEAR, pose)
    assert correlation(once.iq, other.iq) < 0.1
    fresh = simulator(SOLID, SPECKLE, seed=0).simulate(LINEAR, pose)
    np.testing.assert_array_equal(once.iq, fresh.iq)


def test_the_signal_is_linear_in_mu0_and_sigma0():
    """The basis of docs/optimization.md#efficient-evaluation: RF(mu0, sigma0) = mu0 RF(1, 0) + sigma0 RF(0, 1)."""
    pose = rigid(ORIENTATIONS["oblique"], [0, -25, 0])
    rf = {
        (mu0, sigma0): simulator(SOLID, replace(SPECKLE, mu0=mu0, sigma0=sigma0)).simulate(LINEAR, pose).iq
        for mu0, sigma0 in ((1.0, 0.0), (0.0, 1.0), (0.4, 0.15))
    }
    combined = 0.4 * rf[1.0, 0.0] + 0.15 * rf[0.0, 1.0]
    np.testing.assert_allclose(rf[0.4, 0.15], combined, atol=1e-5 * np.abs(combined).max())


@pytest.mark.parametrize("seed", range(3))
def test_a_scatterer_is_in_the_same_place_seen_from_the_front_and_from_the_side(seed):
    """Sparse scatterers, two probes at right angles: the order of lattice axes differs, the scatterers do not."""
    tissue = replace(SPECKLE, mu0=0.0, sigma0=1.0)
    sim = simulator(SOLID, tissue, seed=seed, scatterers_per_mm3=0.1)
    probe = LinearProbe(20, 40, scan_lines=101, focus_mm=20, elevation_focus_mm=20)

    def seen(rotation, centre):
        """Amplitudes of the frame that looks along the rotation's second column at `centre`, 20 mm deep."""
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = centre - 20.0 * rotation[:, 1]
        frame = sim.simulate(probe, pose)
        return np.abs(frame.iq), frame.sample_interval_mm

    front = np.eye(3)
    heights = np.arange(-2.0, 2.01, 0.2)
    stack = np.stack([seen(front, np.array([0.0, 0.0, z]))[0][30:71, 400:640] for z in heights])
    n, line, sample = np.unravel_index(np.argmax(stack), stack.shape)
    dz = seen(front, np.zeros(3))[1]
    place = np.array([(line + 30 - 50) * 0.2, (sample + 400) * dz - 20.0, heights[n]])
    strength = stack.max()

    side = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])  # lateral z, depth x, elevational y
    amplitude, dz = seen(side, place)
    near = amplitude[47:54, int(19.6 / dz) : int(20.4 / dz)]
    assert near.max() > 0.7 * strength
    found_line, found_sample = np.unravel_index(np.argmax(near), near.shape)
    assert abs(found_line - 3) <= 2  # 0.2 mm a line; the beam is wider
    assert abs((found_sample + int(19.6 / dz)) * dz - 20.0) < 0.25
