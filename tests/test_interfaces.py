"""Interface echoes: their level, and walls around fluid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic import (
    ConvexProbe,
    DisplaySettings,
    LinearProbe,
    SimulationSettings,
    Tissue,
    TissueTable,
    UltrasoundSimulator,
)
from SlicerUSSim.Logic.probe.arrays import PROBES
from tests.conftest import FLUID, SPECKLE, block, rigid, simulator
from validation.measurement import depth_window
from validation.phantoms import folds, parallel_plates

PROBE = LinearProbe(30, 60, scan_lines=121, focus_mm=30, elevation_focus_mm=30)


def test_an_interface_echo_does_not_depend_on_line_density():
    wall = block(lambda x, y, z: y > 0)
    hard = Tissue("wall", 1540.0, 1.8, 0.0)
    sim = simulator(wall, hard, scattering=False)
    pose = rigid(np.eye(3), [0, -20, 0])
    peaks = [
        np.abs(sim.simulate(replace(PROBE, scan_lines=lines), pose).iq[lines // 2]).max() for lines in (41, 81, 161)
    ]
    np.testing.assert_allclose(peaks, peaks[0], rtol=0.05)
    # Perpendicular, focused or not: r times the gain, in the unit of the speckle.
    r = (1.8 - 1.54) / (1.8 + 1.54)
    gain = 10 ** (sim.settings.interface_gain_db / 20)
    assert peaks[0] == pytest.approx(r * gain, rel=0.05)


@pytest.mark.parametrize(("radius_mm", "is_ball", "least_db"), [(8.0, False, -1.5), (15.0, True, -2.5)])
def test_bent_walls_in_coarse_voxels_are_as_bright_as_theory_says(radius_mm, is_ball, least_db):
    """A rod of 8 voxels and a ball of 15 in oblique grids, relative to a plane; expected are -0.2 to -0.4 dB."""
    focus = LinearProbe(
        20.0, 40.0, scan_lines=161, focus_mm=25.0, aperture_mm=12.5, receive_f_number=2.0, elevation_focus_mm=25.0
    )
    fluid, soft = replace(FLUID, impedance_mrayl=1.6), replace(FLUID, impedance_mrayl=1.9)
    levels = []
    for seed in range(500, 506):
        turned = Rotation.random(random_state=seed).as_matrix()

        def body(x, y, z, turned=turned):
            across, deep, aside = (turned[0, n] * x + turned[1, n] * y + turned[2, n] * z for n in range(3))
            return 1 + (across**2 + (deep - radius_mm + 8.0) ** 2 + is_ball * aside**2 < radius_mm**2)

        found = simulator(
            block(body, (18, 18, 18)), fluid, soft, coupling=fluid, scattering=False, specular_exponent=0.0
        )
        frame = found.simulate(focus, rigid(turned, np.array([0.1, -33.0, 0.2])))
        near = slice(*(round(depth / frame.sample_interval_mm) for depth in (23.0, 27.0)))
        gain = 0.3 / 3.5 * 10 ** (found.settings.interface_gain_db / 20)
        levels.append(20 * np.log10(np.abs(frame.iq[75:86, near]).max() / gain))
    assert least_db < min(levels) and max(levels) < 0.5, np.round(levels, 1)


def test_fluid_is_black_and_its_walls_are_bright():
    cyst = block(lambda x, y, z: np.where(x**2 + y**2 + z**2 < 10**2, 2, 1))
    frame = simulator(cyst, SPECKLE, FLUID).simulate(
        PROBE, rigid(np.eye(3), [0, -25, 0]), DisplaySettings(tgc_db_cm_mhz=0.0, noise_db=None)
    )
    line = frame.bmode[60].astype(float)
    inside = line[int(17.5 / frame.sample_interval_mm) : int(32.5 / frame.sample_interval_mm)]
    before = line[int(5 / frame.sample_interval_mm) : int(13 / frame.sample_interval_mm)]
    assert inside.mean() < 5 < 50 < before.mean()
    for wall in (15.0, 35.0):
        near = line[int((wall - 1) / frame.sample_interval_mm) : int((wall + 1) / frame.sample_interval_mm)]
        assert near.max() > before.mean() + 40


WALL = Tissue("wall", 1540.0, 1.8, 0.0)


def peaks_of_lines(sim, scan_lines: int, angle_deg: float = 0.0, x_mm: float = 0.0) -> np.ndarray:
    """The largest echo around 20 mm on every line of a probe tilted in the image plane about (x, 20) mm."""
    angle = np.radians(angle_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    probe = replace(PROBE, scan_lines=scan_lines, frequency_mhz=4.0, focus_mm=20, elevation_focus_mm=20)
    frame = sim.simulate(probe, rigid(turn, [x_mm, -20, 0]))
    near = slice(*(int(depth / frame.sample_interval_mm) for depth in (17.0, 23.0)))
    return np.abs(frame.iq[:, near]).max(axis=1)


def peak(sim, scan_lines: int, angle_deg: float) -> float:
    """That on the middle line."""
    return float(peaks_of_lines(sim, scan_lines, angle_deg)[scan_lines // 2])


def test_an_oblique_wall_does_not_depend_on_line_density():
    angle_deg = 10.0
    sim = simulator(block(lambda x, y, z: y > 0), WALL, scattering=False)
    peaks = [peak(sim, lines, angle_deg) for lines in (41, 61, 121, 241)]
    np.testing.assert_allclose(peaks, peaks[-1], rtol=0.1)
    assert peaks[-1] < 0.8 * peak(sim, 121, 0.0)


def test_a_steep_wall_returns_nothing():
    sim = simulator(block(lambda x, y, z: y > 0), WALL, scattering=False)
    square = peak(sim, 61, 0.0)
    for angle_deg in (25.0, 35.0):
        assert peak(sim, 61, angle_deg) < 10 ** (-30 / 20) * square


@pytest.mark.parametrize(
    ("probe", "depth_mm", "angle_deg", "turn_deg"),
    [
        # Lines 0.9 mm apart, for which the wall differs by 6.3 radians from line to line, aliased to -26 dB
        (PROBES["matrix"], 55.0, 16.0, 0.0),
        # 2.3 radians per elevational deviation, which a few rays cannot add up
        (PROBES["linear_15"], 15.0, 8.0, 40.0),
    ],
    ids=["matrix", "linear_15"],
)
def test_a_steep_wall_does_not_depend_on_the_lines_of_shipped_probes(probe, depth_mm, angle_deg, turn_deg):
    """Levels relative to a square wall on the centre line, equal below -28 dB; in a grid oblique to the probe."""
    grid = Rotation.from_euler("xyz", [25.0, -35.0, 15.0], degrees=True)
    normal = grid.apply([0.0, 1.0, 0.0])
    wall = block(
        lambda x, y, z: x * normal[0] + y * normal[1] + z * normal[2] > 0, half_mm=(20, 20, 20), spacing_mm=0.3
    )
    sim = UltrasoundSimulator(
        wall, TissueTable({0: FLUID, 1: WALL}), SimulationSettings(scattering=False, specular_exponent=0.0)
    )
    turn = Rotation.from_euler("y", turn_deg, degrees=True)

    def level_db(scan_lines: int, tilt_deg: float) -> float:
        tilt = grid * turn * Rotation.from_euler("z", tilt_deg, degrees=True) * turn.inv()
        pose = rigid(tilt.as_matrix(), [0.0, -depth_mm, 0.0])
        frame = sim.simulate(replace(probe, scan_lines=scan_lines), pose)
        near = slice(*(round((depth_mm + off) / frame.sample_interval_mm) for off in (-3.0, 3.0)))
        return float(20 * np.log10(np.abs(frame.iq[scan_lines // 2, near]).max() + 1e-12))

    square = level_db(193, 0.0)
    assert square > 10.0
    levels = [level_db(lines, angle_deg) - square for lines in (97, 193, 257, 385)]
    assert np.ptp(np.maximum(levels, -28.0)) < 1.0, levels


@pytest.mark.parametrize("name", ["microconvex", "phased"])
def test_lines_on_a_walls_flank_do_not_depend_on_their_number(name):
    """A plane that is oblique to the image plane as well, in voxels of 1 mm turned against it; levels above -30 dB re a
    square wall.
    """
    probe = replace(PROBES[name], frequency_mhz=5.0, band_mhz=None)
    tilt, azimuth, depth_mm = np.radians(5.0), np.radians(200.0), 30.0
    grid = Rotation.random(random_state=12)
    normal = np.array([np.sin(tilt) * np.cos(azimuth), np.cos(tilt), np.sin(tilt) * np.sin(azimuth)])
    across = grid.apply(normal)
    wall = block(lambda x, y, z: x * across[0] + y * across[1] + z * across[2] > 0, (30, 30, 30))
    sim = simulator(wall, WALL, scattering=False, specular_exponent=0.0, side_lobes=False)
    pose = rigid(grid.as_matrix(), [0.1, -depth_mm, 0.3])

    def levels_db(scan_lines: int) -> np.ndarray:
        """On every line of 96 that meets the wall within 14 mm of the axis."""
        dense = replace(probe, scan_lines=scan_lines)
        origins, directions = dense.origins_mm(), dense.directions()
        path = ((np.array([0.0, depth_mm, 0.0]) - origins) @ normal) / (directions @ normal)
        near = np.abs((origins + path[:, None] * directions)[:, 0]) < 14.0
        frame = sim.simulate(dense, pose)
        at = np.arange(frame.iq.shape[1]) * frame.sample_interval_mm
        peaks = np.array(
            [
                np.abs(line[np.abs(at - length) < 3.0]).max() if is_near else 1e-12
                for line, length, is_near in zip(frame.iq, path, near, strict=True)
            ]
        )
        return 20 * np.log10(peaks[:: (scan_lines - 1) // 95])

    levels = np.array([levels_db(lines) for lines in (96, 191, 381)])
    levels -= levels.max()
    seen = levels.min(axis=0) > -30.0
    assert seen.sum() > 10
    assert levels[:, seen].min() < -18.0
    assert np.ptp(levels[:, seen], axis=0).max() < 2.5, np.round(levels[:, seen], 1)


def test_a_plane_nearly_across_a_diagonal_of_the_voxels_keeps_its_level():
    """Tilted by 5 degrees to the beam, and turned by 0.8 from the diagonal: its steps are 51 voxels long."""
    to_diagonal = Rotation.align_vectors([(0.0, 1.0, 1.0)], [[0.0, 1.0, 0.0]])[0]
    turn = to_diagonal * Rotation.from_euler("x", 0.8, degrees=True) * Rotation.from_rotvec([0.0, 1.6, 0.0])
    normal = turn.apply([0.0, 1.0, 0.0])
    wall = block(lambda x, y, z: x * normal[0] + y * normal[1] + z * normal[2] > 0.2, (44, 44, 44))
    sim = simulator(wall, WALL, scattering=False, specular_exponent=0.0, side_lobes=False)
    tilt = turn * Rotation.from_euler("z", 5.0, degrees=True)
    probe = replace(PROBES["linear"], frequency_mhz=5.0, focus_mm=25.0, elevation_focus_mm=25.0)
    frame = sim.simulate(probe, rigid(tilt.as_matrix(), [0.0, -25.0, 0.0]))
    lateral = np.linspace(-0.5, 0.5, probe.scan_lines) * probe.width_mm
    near = slice(*(round(depth / frame.sample_interval_mm) for depth in (22.0, 28.0)))
    levels = 20 * np.log10(np.abs(frame.iq[np.abs(lateral) < 12.0, near]).max(axis=1))
    assert np.ptp(levels) < 3.0, np.round(levels[::8], 1)


@pytest.mark.parametrize(("rays", "angle_deg"), [(1, 4.0), (2, 9.0), (3, 20.0), (32, 9.0)])
def test_few_elevational_rays_see_a_plane_as_many_do(rays, angle_deg):
    """A plane oblique out of the image. With one or two rays it was too bright, or its lines were NaN."""
    slope = np.tan(np.radians(angle_deg))
    wall = block(lambda x, y, z: y > slope * z, half_mm=(16, 12, 16), spacing_mm=0.5)
    probe, hard = replace(PROBE, width_mm=16.0, depth_mm=35.0, scan_lines=65), Tissue("wall", 1540.0, 1.8, 0.0)
    levels = []
    for number in (7, rays):
        sim = simulator(wall, hard, scattering=False, elevational_rays=number)
        iq = sim.simulate(probe, rigid(np.eye(3), [0, -20, 0])).iq
        assert np.isfinite(iq).all()
        levels.append(20.0 * np.log10(np.maximum(np.abs(iq[24:41]).max(axis=1), 0.1)))  # of a square one: 44 - 22 dB
    np.testing.assert_allclose(levels[1], levels[0], atol=1.0)


def test_the_two_borders_of_a_slab_have_opposite_signs():
    sim = simulator(block(lambda x, y, z: abs(y) < 3), WALL, scattering=False, reflections=False)
    hits = sim.trace(PROBE, rigid(np.eye(3), [0, -20, 0])).hits
    front = hits["label_behind"] == 1
    assert front.any() and (~front).any()
    assert (hits["echo"][front] > 0).all() and (hits["echo"][~front] < 0).all()
    np.testing.assert_allclose(hits["curvature"], 0.0, atol=1e-3)


@pytest.mark.parametrize(("seed", "gap_mm"), [(0, 7.2), (3, 14.4)])
def test_plates_closer_than_the_smoothing_are_found_one_by_one(seed, gap_mm):
    """In voxels of 1 mm: each plane from the tissue beyond both."""
    phantom = parallel_plates(Rotation.random(random_state=seed).as_matrix(), gap_mm=gap_mm, spacing_mm=1.0)
    settings = SimulationSettings(scattering=False, reflections=False)
    hits = UltrasoundSimulator(phantom.labels, phantom.tissues, settings).trace(PROBE, phantom.probe_to_ras).hits
    inverse = np.linalg.inv(phantom.probe_to_ras)
    depth = hits["position"] @ inverse[1, :3] + inverse[1, 3]
    middle = np.abs(hits["position"] @ inverse[0, :3] + inverse[0, 3]) < 10.0
    for behind, expected in ((2, 15.0), (3, 15.0 + gap_mm)):
        found = depth[middle & (hits["label_behind"] == behind)]
        assert found.mean() == pytest.approx(expected, abs=0.02)
        assert found.std() < 0.012


@pytest.mark.parametrize("beam", ["aperture", "ray"])
def test_every_hit_is_at_a_border_of_the_labels(beam):
    """Between the walls of thin folds the smoothed indicators are flat, and their border could be centimetres away."""
    phantom = folds()
    simulator = UltrasoundSimulator(phantom.labels, phantom.tissues, SimulationSettings(beam=beam, reflections=False))
    for probe in (ConvexProbe(40, 60, 50), LinearProbe(40, 50)):
        tree = simulator.trace(probe, phantom.probe_to_ras)
        labels = phantom.labels.array
        is_border = ndimage.maximum_filter(labels, 3) != ndimage.minimum_filter(labels, 3)
        away = ndimage.distance_transform_edt(~is_border)
        places = (phantom.labels.ras_to_ijk @ np.c_[tree.hits["position"], np.ones(len(tree.hits))].T)[2::-1]
        inside = ((places > 2) & (places < np.array(labels.shape)[:, None] - 3)).all(axis=0)
        found = ndimage.map_coordinates(away, places[:, inside], order=1)
        assert inside.sum() > 1000 and found.max() < 1.0


def errors_of_walls(normal, half_mm, start, thickness_mm=None) -> np.ndarray:
    """(walls, 2): RMS place error in mm and largest error of the normal in degrees, of walls in voxels of 1 mm.

    The first wall is a plane through the point `start`, which a narrow beam meets at right angles.
    """
    normal, start = np.array(normal) / np.linalg.norm(normal), np.array(start)
    labels = block(
        lambda x, y, z: (
            1
            + ((d := x * normal[0] + y * normal[1] + z * normal[2] - normal @ start) > 0) * (d < (thickness_mm or 1e3))
        ),
        half_mm,
    )
    across = np.cross(normal, [0.3, 0.5, 0.8])
    across /= np.linalg.norm(across)
    rotation = np.stack([across, normal, np.cross(across, normal)], axis=1)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, start - 15.0 * normal
    probe = LinearProbe(4.0, 30.0, scan_lines=17, focus_mm=15.0, elevation_focus_mm=15.0, elevation_aperture_mm=4.0)
    hits = simulator(labels, FLUID, WALL, scattering=False, reflections=False).trace(probe, pose).hits
    depth = (hits["position"] - start) @ normal
    errors = []
    for wall in (0.0, *([thickness_mm] if thickness_mm else [])):
        here = np.abs(depth - wall) < 0.7
        assert here.sum() > 10
        angle = np.degrees(np.arccos(np.clip(np.abs(hits["normal"][here] @ normal), 0.0, 1.0)))
        errors.append([np.sqrt(np.mean((depth[here] - wall) ** 2)), angle.max()])
    return np.array(errors)


@pytest.mark.parametrize(("from_end_mm", "thickness_mm"), [(5.0, None), (5.0, 3.0), (8.0, 6.0), (16.0, 12.0)])
def test_an_end_of_the_label_map_does_not_bend_a_wall(from_end_mm, thickness_mm):
    errors = errors_of_walls([0.6, 0.7, 0.39], (40, 40, 40), [from_end_mm - 40.5, 0.2, 0.1], thickness_mm)
    assert (errors < [0.07, 0.5]).all()


@pytest.mark.parametrize(("normal", "thickness_mm"), [([0.087, 1.0, 0.03], 2.0), ([0.6, 0.7, 0.39], 4.0)])
def test_both_walls_of_a_thin_layer_are_flat(normal, thickness_mm):
    errors = errors_of_walls(normal, (40, 40, 40), [0.3, 0.2, 0.1], thickness_mm)
    assert (errors < [0.05, 0.4]).all()


def test_the_steps_of_a_plane_that_is_hardly_turned_are_not_seen():
    """They are 38 voxels long."""
    for x in (0.0, 10.0):
        errors = errors_of_walls([0.026, 1.0, 0.008], (75, 25, 75), [x, 0.2, 0.1])
        assert (errors < [0.05, 0.2]).all()


def test_an_oblique_plane_echoes_as_the_apertures_of_its_probe_say():
    """Sums over the ways between points of uniform apertures give -4.0 and -11.1 dB, a Gaussian beam -5.0 and -17.6."""
    probe = replace(PROBES["linear"], scan_lines=65, width_mm=16.0)
    labels = block(lambda x, y, z: np.where(y > 0.0, 2, 1), half_mm=(14, 26, 5), spacing_mm=0.2)
    behind = replace(FLUID, name="behind", impedance_mrayl=1.9)
    made = UltrasoundSimulator(
        labels,
        TissueTable({0: FLUID, 1: FLUID, 2: behind}),
        SimulationSettings(scattering=False, specular_exponent=0.0),
    )
    levels = []
    for tilt in np.radians([0.0, 4.0, 8.0]):
        turn = np.array([[np.cos(tilt), -np.sin(tilt), 0.0], [np.sin(tilt), np.cos(tilt), 0.0], [0.0, 0.0, 1.0]])
        frame = made.simulate(probe, rigid(turn, turn @ [0.0, -20.0, 0.0]))
        levels.append(20.0 * np.log10(np.abs(depth_window(frame, 20.0, 3.0)[32]).max()))
    assert np.array(levels[1:]) - levels[0] == pytest.approx([-4.0, -11.1], abs=1.2)
