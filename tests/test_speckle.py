"""Speckle is fixed in the patient: with sparse lines, small motions, other directions; linear in mu0 and sigma0."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from SlicerUSSim.Logic import LinearProbe
from SlicerUSSim.Logic.probe.arrays import PROBES
from tests.conftest import SPECKLE, block, rigid, simulator
from validation.checks import ORIENTATIONS
from validation.measurement import correlation, depth_window, level_db
from validation.speckle import smallest_cell

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


def test_the_same_pose_gives_the_same_bits_and_another_seed_others(simulators):
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


def test_the_signal_is_linear_in_the_deviation_of_the_scatterers():
    """The basis of docs/optimization.md#efficient-evaluation, for all mu0, mu1 and sigma0 but the sparsest."""
    pose = rigid(ORIENTATIONS["oblique"], [0, -25, 0])
    tissues = [
        replace(SPECKLE, mu0=mu0, mu1=mu1, sigma0=sigma0)
        for mu0, mu1, sigma0 in ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.4, -1.0, 0.15), (0.06, 2.0, 0.31))
    ]
    first, *others = (
        simulator(SOLID, tissue).simulate(LINEAR, pose).iq / np.sqrt(tissue.scatterer_variance) for tissue in tissues
    )
    for other in others:
        np.testing.assert_allclose(other, first, atol=1e-5 * np.abs(first).max())


def test_sparse_tissue_is_sparse_with_the_same_power():
    """With mu1 = 4.5 there are 0.4 of the paper's sites per mm^3: fewer than one in a resolution cell of 0.2 mm^3."""
    pose, sparse = rigid(ORIENTATIONS["oblique"], [0, -25, 0]), replace(SPECKLE, mu0=10.0, mu1=4.5, sigma0=80.0)
    signal = np.stack([simulator(SOLID, sparse, seed=seed).simulate(LINEAR, pose).iq for seed in range(6)])
    envelope = np.abs(signal)
    assert 10 * np.log10((envelope**2).mean() / sparse.scatterer_variance) == pytest.approx(0.0, abs=1.0)
    assert envelope.mean() / envelope.std() < 1.0  # of developed speckle 1.91


@pytest.mark.parametrize("seed", range(2))
def test_a_scatterer_is_in_the_same_place_from_the_front_and_the_side(seed):
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


@pytest.mark.slow
def test_a_pulse_loses_less_than_its_centre_frequency():
    """(A sf)^2 / 2 nepers, for a Gaussian band: 1.6 dB after 25 dB, and its mean frequency falls by 0.65 MHz."""
    lossy = replace(SPECKLE, attenuation_db_cm_mhz=1.0)
    probe = LinearProbe(20, 30, scan_lines=65, focus_mm=25, elevation_focus_mm=25)
    levels, frequencies = [], []
    for is_on in (True, False):
        frames = [
            simulator(SOLID, lossy, seed=seed, frequency_downshift=is_on).simulate(probe, rigid(np.eye(3), [0, -26, 0]))
            for seed in range(8)
        ]
        near = np.stack([depth_window(frame, 25.0, 1.0) for frame in frames])
        levels.append(level_db(near))
        turn = np.angle((near[..., 1:] * near[..., :-1].conj()).sum())
        frequencies.append(5.0 + 5.0 * turn / (2 * np.pi * frames[0].sample_interval_mm * frames[0].cycles_per_mm))
    assert levels[0] - levels[1] == pytest.approx(1.6, abs=0.25)
    assert frequencies[0] - frequencies[1] == pytest.approx(-0.65, abs=0.06)


@pytest.mark.slow
def test_speckle_near_the_face_of_a_phased_array_has_its_level():
    """Near the point where all lines begin. (Elements make steered lines darker.)"""
    probe = replace(PROBES["phased"], scan_lines=64, directivity="none")
    pose = rigid(np.eye(3), [0, -10, 0])
    signals = [simulator(SOLID, SPECKLE, coupling=SPECKLE, seed=s).simulate(probe, pose) for s in range(30)]
    for depth in (1.5, 2.5, 3.5, 4.5):
        near = np.stack([at_depth(frame.iq, frame, depth, 0.5) for frame in signals])
        assert level_db(near) == pytest.approx(10 * np.log10(SPECKLE.scatterer_variance), abs=1.2), depth


@pytest.mark.slow
def test_rare_scatterers_of_a_15_mhz_array_are_sparse_as_predicted():
    """There are 2.4 in the smallest resolution cell: the slice is thinnest in front of the lens's focus, at 9 mm."""
    tissue, probe = replace(SPECKLE, mu1=3.0), PROBES["linear_15"]
    depth, cell, expected = smallest_cell(probe, tissue, 1.0)
    assert 125_000 * tissue.scatterer_share * cell == pytest.approx(2.4, abs=0.1) and 8.0 < depth < 11.0
    frames = [
        simulator(SOLID, tissue, seed=seed).simulate(probe, rigid(np.eye(3), [0, -depth, 0])) for seed in range(12)
    ]
    envelope = np.abs(np.stack([depth_window(frame, depth, 1.0) for frame in frames]))
    assert envelope.mean() / envelope.std() == pytest.approx(expected, rel=0.025)
    assert expected < 1.75
