"""Speckle: Rayleigh statistics, the point spread function's correlations, one patient seen from every pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from SlicerUSSim.Logic import ConvexProbe, LinearProbe, PhasedProbe
from SlicerUSSim.Logic.tissues import TISSUES
from tests.conftest import ORIENTATIONS, SPECKLE, block, correlation, level_db, rigid, simulator

LINEAR = LinearProbe(40, 50, scan_lines=161, focus_mm=25, elevation_focus_mm=25)
SOLID = block(lambda x, y, z: np.ones_like(x), half_mm=(48, 48, 48))
SEEDS = range(6)


def at_depth(signal: np.ndarray, frame, depth_mm: float, half_mm: float = 1.0) -> np.ndarray:
    first, last = ((depth_mm + s * half_mm) / frame.sample_interval_mm for s in (-1, 1))
    return signal[:, int(first) : int(last)]


@pytest.fixture(scope="module")
def simulators():
    return [simulator(SOLID, SPECKLE, seed=seed) for seed in SEEDS]


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_speckle_is_fully_developed(simulators, orientation):
    """Envelope mean / standard deviation of a Rayleigh distribution: 1.913 (PHYSICS section 4: within 2 %)."""
    pose = rigid(ORIENTATIONS[orientation], [0, -25, 0])
    envelope = np.concatenate([np.abs(sim.simulate(LINEAR, pose).iq[:, 50:-50]).ravel() for sim in simulators])
    assert envelope.mean() / envelope.std() == pytest.approx(1.913, rel=0.02)


@pytest.mark.parametrize("depth", [8, 25, 42])
@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_speckle_correlates_as_the_point_spread_function_says(simulators, orientation, depth):
    """exp(-d^2 / 4 sigma^2) between signals d apart: laterally, elevationally, axially; at and away from the focus."""
    rotation = ORIENTATIONS[orientation]
    sigma_l, sigma_e = LINEAR.beam_sigma_mm(depth)
    step_e = 0.8 * sigma_e
    lines = max(1, round(1.0 * sigma_l / LINEAR.line_spacing))
    found = {"lateral": [], "elevational": [], "axial": []}
    for sim in simulators:
        frame = sim.simulate(LINEAR, rigid(rotation, [0, -25, 0]))
        beside = sim.simulate(LINEAR, rigid(rotation, [0, -25, step_e]))
        signal, other = at_depth(frame.iq, frame, depth), at_depth(beside.iq, frame, depth)
        found["lateral"].append(correlation(signal[:-lines], signal[lines:]))
        found["elevational"].append(correlation(signal, other))
        wide = at_depth(frame.iq, frame, depth, 3.0)
        found["axial"].append(correlation(wide[:, :-4], wide[:, 4:]))
    expected = {
        "lateral": np.exp(-((lines * LINEAR.line_spacing) ** 2) / (4 * sigma_l**2)),
        "elevational": np.exp(-(step_e**2) / (4 * sigma_e**2)),
        "axial": np.exp(-((4 * frame.sample_interval_mm) ** 2) / (4 * LINEAR.axial_sigma_mm**2)),
    }
    for direction, values in found.items():
        assert np.mean(values) == pytest.approx(expected[direction], rel=0.1), direction


@pytest.mark.parametrize(
    "probe", [ConvexProbe(60, 60, 90, scan_lines=128), PhasedProbe(75, 73, scan_lines=196)], ids=["convex", "phased"]
)
def test_curved_probes_have_the_same_level_and_lateral_correlation_at_every_depth(probe):
    wide = block(lambda x, y, z: np.ones_like(x), half_mm=(80, 60, 15))
    depths = (10, probe.focus_mm, probe.depth_mm - 6)
    levels, ratios = [], []
    for seed in range(4):
        frame = simulator(wide, SPECKLE, seed=seed).simulate(probe, rigid(np.eye(3), [0, -50, 0]))
        row_levels, row_ratios = [], []
        for depth in depths:
            signal = at_depth(frame.iq, frame, depth, 2.0)
            sigma = probe.beam_sigma_mm(depth)[0]
            apart = probe.line_spacing * (probe.apex_radius_mm + depth)
            lines = max(1, round(0.9 * sigma / apart))
            row_levels.append(level_db(signal))
            row_ratios.append(
                correlation(signal[:-lines], signal[lines:]) / np.exp(-((lines * apart) ** 2) / 4 / sigma**2)
            )
        levels.append(row_levels)
        ratios.append(row_ratios)
    np.testing.assert_allclose(np.mean(ratios, axis=0), 1.0, atol=0.1)
    np.testing.assert_allclose(np.mean(levels, axis=0), 10 * np.log10(SPECKLE.scatterer_variance), atol=0.6)


def test_lines_far_apart_see_as_much_as_lines_close_together():
    """Twelve millimetres between scan lines: enough lines are traced between them to fill every beam."""
    sparse = LinearProbe(48, 40, scan_lines=5, focus_mm=25, elevation_focus_mm=25)
    levels = [
        level_db(simulator(SOLID, SPECKLE, seed=s).simulate(sparse, rigid(np.eye(3), [0, -20, 0])).iq) for s in range(8)
    ]
    assert np.mean(levels) == pytest.approx(10 * np.log10(SPECKLE.scatterer_variance), abs=0.6)


@pytest.mark.parametrize("name", ["grey matter", "white matter", "leptomeninges", "liver"])
def test_level_is_the_variance_of_the_scatterers(name):
    """PHYSICS section 4: Var = p (1 - p) mu0^2 + p sigma0^2 alone sets the echogenicity; also with a rare mu1."""
    for changes in ({}, {"mu1": 1.0}, {"mu0": 0.0}, {"sigma0": 0.0}):
        tissue = replace(TISSUES[name], attenuation_db_cm_mhz=0.0, **changes)
        levels = [
            level_db(simulator(SOLID, tissue, seed=seed).simulate(LINEAR, rigid(np.eye(3), [0, -25, 0])).iq[:, 50:-50])
            for seed in range(2)
        ]
        assert np.mean(levels) == pytest.approx(10 * np.log10(tissue.scatterer_variance), abs=0.5), changes


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_moving_the_probe_along_itself_moves_the_speckle(simulators, orientation):
    """0.2 mm along the lateral axis: the same speckle 0.2 mm further, correlation above 0.95."""
    rotation = ORIENTATIONS[orientation]
    probe = replace(LINEAR, scan_lines=201)  # lines 0.2 mm apart
    here = simulators[0].simulate(probe, rigid(rotation, [0, -25, 0])).iq
    moved = simulators[0].simulate(probe, rigid(rotation, [0.2, -25, 0])).iq
    assert correlation(here[1:], moved[:-1]) > 0.95
    assert correlation(here, moved) < correlation(here[1:], moved[:-1])


def test_moving_by_a_fraction_of_a_line_keeps_the_speckle(simulators):
    """Half a line to the side, the mean of two neighbours comes close; nothing flickers between grid positions."""
    probe = replace(LINEAR, scan_lines=201)
    here = simulators[0].simulate(probe, rigid(np.eye(3), [0, -25, 0])).iq
    moved = simulators[0].simulate(probe, rigid(np.eye(3), [0.1, -25, 0])).iq
    assert correlation(0.5 * (here[1:] + here[:-1]), moved[:-1]) > 0.97


def test_the_same_pose_gives_the_same_bits_and_another_seed_another_patient(simulators):
    pose = rigid(ORIENTATIONS["oblique"], [0, -25, 0])
    once, again = (simulators[0].simulate(LINEAR, pose) for _ in range(2))
    np.testing.assert_array_equal(once.iq, again.iq)
    np.testing.assert_array_equal(once.image, again.image)
    other = simulators[1].simulate(LINEAR, pose)
    assert correlation(once.iq, other.iq) < 0.1
    fresh = simulator(SOLID, SPECKLE, seed=0).simulate(LINEAR, pose)
    np.testing.assert_array_equal(once.iq, fresh.iq)


def test_the_signal_is_linear_in_mu0_and_sigma0():
    """PHYSICS section 6 builds on it: RF(mu0, sigma0) = mu0 RF(1, 0) + sigma0 RF(0, 1)."""
    pose = rigid(ORIENTATIONS["oblique"], [0, -25, 0])
    rf = {
        (mu0, sigma0): simulator(SOLID, replace(SPECKLE, mu0=mu0, sigma0=sigma0)).simulate(LINEAR, pose).iq
        for mu0, sigma0 in ((1.0, 0.0), (0.0, 1.0), (0.4, 0.15))
    }
    combined = 0.4 * rf[1.0, 0.0] + 0.15 * rf[0.0, 1.0]
    np.testing.assert_allclose(rf[0.4, 0.15], combined, atol=1e-5 * np.abs(combined).max())


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_no_lattice_shows_in_the_envelope(simulators, orientation):
    """The spectrum of the intensity has no line standing out: a lattice or a tiling would be one."""
    power = 0.0
    for sim in simulators:
        intensity = np.abs(sim.simulate(LINEAR, rigid(ORIENTATIONS[orientation], [0, -25, 0])).iq[:, 64:-64]) ** 2
        power = power + np.abs(np.fft.fft2(intensity - intensity.mean())) ** 2
    # Against its surroundings: the spectrum of speckle itself falls smoothly with frequency.
    from scipy.ndimage import median_filter

    smooth = median_filter(power, size=(9, 31), mode="wrap")
    strong = smooth > 1e-3 * smooth.max()
    # The mean of six exponential variables exceeds its median eightfold about once in 10^18.
    assert (power[strong] / smooth[strong]).max() < 8


def test_scatterers_can_be_as_dense_as_the_papers():
    """1250 per mm^3 (Meunier and Bertrand): the level stays, the statistics are closer to Rayleigh."""
    probe = LinearProbe(8, 12, scan_lines=41, focus_mm=30, elevation_focus_mm=30)
    small = block(lambda x, y, z: np.ones_like(x), half_mm=(15, 15, 15))
    frames = [
        simulator(small, SPECKLE, seed=seed, scatterers_per_mm3=1250).simulate(probe, rigid(np.eye(3), [0, -6, 0]))
        for seed in range(2)
    ]
    assert np.mean([level_db(f.iq) for f in frames]) == pytest.approx(
        10 * np.log10(SPECKLE.scatterer_variance), abs=1.2
    )


@pytest.mark.parametrize("seed", range(3))
def test_a_scatterer_is_in_the_same_place_seen_from_the_front_and_from_the_side(seed):
    """Sparse scatterers, two probes at right angles: the lattice is enumerated along other axes, the patient stays."""
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
