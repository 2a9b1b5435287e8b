"""What the paper's Fig. 2 shows, with the numbers of PHYSICS section 7, and how interface echoes spread."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from SlicerUSSim.Logic import DisplaySettings, LinearProbe, Tissue
from tests.conftest import FLUID, ORIENTATIONS, SPECKLE, block, level_db, rigid, simulator

PROBE = LinearProbe(30, 60, scan_lines=121, focus_mm=30, elevation_focus_mm=30)


def peak_depths(frame, line: int, count: int) -> np.ndarray:
    """Depths in millimetres of the strongest `count` separate peaks of one line, ascending."""
    envelope = np.abs(frame.iq[line]).copy()
    found = []
    for _ in range(count):
        best = int(np.argmax(envelope))
        found.append(best * frame.sample_interval_mm)
        envelope[max(best - 25, 0) : best + 25] = 0
    return np.sort(found)


@pytest.mark.parametrize("slab_alpha", [1.2, 0.1], ids=["shadow", "enhancement"])
@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_behind_a_slab_the_level_changes_by_its_attenuation(orientation, slab_alpha):
    """-2 (alpha_slab - alpha_background) f d dB within 0.5 dB, both signs."""
    background = replace(SPECKLE, name="background", attenuation_db_cm_mhz=0.5)
    slab = replace(SPECKLE, name="slab", attenuation_db_cm_mhz=slab_alpha)
    normal, thickness = ORIENTATIONS[orientation][:, 1], 11.0
    pose = rigid(ORIENTATIONS[orientation], [0, -30, 0])

    def labels(x, y, z):
        return np.where(np.abs(x * normal[0] + y * normal[1] + z * normal[2]) < thickness / 2, 2, 1)

    changes = []
    for seed in range(3):
        frames = [
            simulator(block(function, half_mm=(45, 45, 45)), background, slab, seed=seed).simulate(PROBE, pose)
            for function in (labels, lambda x, y, z: np.ones_like(x))
        ]
        behind = slice(int(42 / frames[0].sample_interval_mm), int(56 / frames[0].sample_interval_mm))
        changes.append(level_db(frames[0].iq[:, behind]) - level_db(frames[1].iq[:, behind]))
    expected = -2 * (slab_alpha - 0.5) * PROBE.frequency_mhz * thickness / 10
    assert np.mean(changes) == pytest.approx(expected, abs=0.5)


@pytest.mark.parametrize("speed", [1450.0, 1650.0])
def test_an_echo_behind_a_fast_slab_arrives_early_and_behind_a_slow_one_late(speed):
    """The back wall of a slab of thickness d moves by d (c_ref / c1 - 1) (within one sample + 0.05 mm)."""
    slab = block(lambda x, y, z: np.abs(y) < 9.5)
    tissue = Tissue("slab", speed, 2.0, 0.0)
    frame = simulator(slab, tissue, reflections=False).simulate(PROBE, rigid(np.eye(3), [0, -20, 0]))
    front, back = peak_depths(frame, 60, 2)
    assert front == pytest.approx(10.5, abs=frame.sample_interval_mm + 0.05)
    assert back - front == pytest.approx(19.0 * 1540 / speed, abs=frame.sample_interval_mm + 0.05)


def test_echoes_between_plates_fall_by_their_reflectances():
    """Plates d apart: an echo every d c_ref / c1, falling by 20 log10(r1 r2) dB per bounce (within 0.5 dB)."""
    # A gap of 7 mm in a medium of another impedance.
    gap = block(lambda x, y, z: np.abs(y) < 3.5)
    hard = Tissue("hard", 1540.0, 3.0, 0.0)
    sim = simulator(gap, FLUID, coupling=hard, reflection_threshold=1e-6, scattering=False)
    frame = sim.simulate(PROBE, rigid(np.eye(3), [0, -20, 0]))
    r = (3.0 - 1.54) / (3.0 + 1.54)
    envelope = np.abs(frame.iq[60])
    depths = 23.5 + 7.0 * np.arange(4)  # the far wall, and the bounces between the walls
    peaks = []
    for depth in depths:
        near = slice(int((depth - 1) / frame.sample_interval_mm), int((depth + 1) / frame.sample_interval_mm))
        peaks.append(envelope[near].max())
        assert (near.start + np.argmax(envelope[near])) * frame.sample_interval_mm == pytest.approx(depth, abs=0.1)
    falls = np.diff(20 * np.log10(peaks))
    np.testing.assert_allclose(falls, 20 * np.log10(r * r), atol=0.5)


def test_a_target_before_a_mirror_appears_again_behind_it():
    """Within 0.3 mm of its mirror image, as the ray tree alone produces it."""
    normal = np.array([np.sin(np.radians(45)), np.cos(np.radians(45)), 0.0])
    mirror = block(
        lambda x, y, z: np.where(x * normal[0] + y * normal[1] > 0, 1, 0), half_mm=(40, 40, 20), spacing_mm=0.5
    )
    array = mirror.array.copy()
    z, y, x = np.meshgrid(*((np.arange(n) - (n - 1) / 2) * 0.5 for n in array.shape), indexing="ij")
    # The ray comes down at x = 0, meets the mirror at the origin and leaves along -x; the target waits there.
    array[(x <= -12.0) & (x > -15.0) & (np.abs(y) < 3) & (np.abs(z) < 3)] = 2
    hard, plate = Tissue("mirror", 1540.0, 30.0, 0.0), Tissue("plate", 1540.0, 6.0, 0.0)
    sim = simulator(mirror.with_array(array), hard, plate, scattering=False, max_ray_depth=1)
    probe = LinearProbe(4, 55, scan_lines=41)
    tree = sim.trace(probe, rigid(np.eye(3), [0, -25, 0]))
    ghost = tree.hits[(tree.hits["reflections"] == 1) & (tree.hits["label_behind"] == 2)]
    front = ghost[ghost["label_before"] == 0]
    assert len(front) > 0
    # The mirror's face is half-way between voxel layers, at x + y = 0.25: 25.25 mm down to it, then 11.75 mm along to
    # the plate, whose outermost voxels have their centres at 12 mm.
    np.testing.assert_allclose(np.median(front["depth_mm"]), 37.0, atol=0.3)
    frame = sim.simulate(probe, rigid(np.eye(3), [0, -25, 0]))
    near = slice(int(35 / frame.sample_interval_mm), int(39 / frame.sample_interval_mm))
    shown = (near.start + np.argmax(np.abs(frame.iq[20, near]))) * frame.sample_interval_mm
    assert shown == pytest.approx(37.0, abs=0.3)


@pytest.mark.filterwarnings("ignore:the probe looks past")
def test_a_small_sheet_spreads_over_lines_and_slices_as_the_beam_says():
    """PHYSICS section 3: an interface echo has the beam's lateral and elevational width, within 10 %."""
    half = 2.0
    # Fine voxels: the smoothing that finds the border rounds the sheet's corners by about a voxel.
    sheet = block(
        lambda x, y, z: (np.abs(y) < 0.7) & (np.abs(x) < half) & (np.abs(z) < half), half_mm=(4, 2, 4), spacing_mm=0.1
    )
    hard = Tissue("sheet", 1540.0, 1.7, 0.0)
    sim = simulator(sheet, hard, scattering=False, elevational_rays=16, specular_exponent=0.0)
    probe = LinearProbe(20, 40, scan_lines=101, focus_mm=35, elevation_focus_mm=35)
    depth = 20.0
    sigma_l, sigma_e = probe.beam_sigma_mm(depth)

    def echo(offset_z: float) -> np.ndarray:
        frame = sim.simulate(probe, rigid(np.eye(3), [0, -depth, offset_z]))
        near = slice(int((depth - 2) / frame.sample_interval_mm), int((depth + 2) / frame.sample_interval_mm))
        return np.abs(frame.iq[:, near]).max(axis=1)

    def width(positions, values) -> float:
        """Second moment about the mean of values that stand for a box convolved with a Gaussian."""
        mean = np.average(positions, weights=values)
        return float(np.sqrt(np.average((positions - mean) ** 2, weights=values)))

    lateral = echo(0.0)
    offsets = np.arange(-6, 6.1, 0.4)
    elevational = np.array([echo(offset)[50] for offset in offsets])
    box = (2 * half - 0.1) ** 2 / 12  # the outermost voxel centres are at 1.9 mm
    assert width(probe.line_positions(), lateral) == pytest.approx(np.sqrt(box + sigma_l**2), rel=0.1)
    assert width(offsets, elevational) == pytest.approx(np.sqrt(box + sigma_e**2), rel=0.1)


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


def test_energy_reflection_writes_r_squared():
    wall = block(lambda x, y, z: y > 0)
    hard = Tissue("wall", 1540.0, 1.8, 0.0)
    pose = rigid(np.eye(3), [0, -20, 0])
    peaks = {
        kind: np.abs(simulator(wall, hard, scattering=False, interface_reflection=kind).simulate(PROBE, pose).iq).max()
        for kind in ("pressure", "energy")
    }
    r = (1.8 - 1.54) / (1.8 + 1.54)
    assert peaks["energy"] / peaks["pressure"] == pytest.approx(r, rel=1e-3)


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
