"""UltrasoundSimulator and Frame: geometry of the image, display, tissues, poses, warnings."""

from __future__ import annotations

import warnings
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic import (
    ConvexProbe,
    LinearProbe,
    Membrane,
    PhasedProbe,
    SimulationError,
    SimulationSettings,
    Tissue,
    TissueTable,
    UltrasoundSimulator,
    Volume,
    segment_mri,
)
from SlicerUSSim.Logic.imaging.simulator import EmptyViewWarning, SlowScatterersWarning
from SlicerUSSim.Logic.tissue import read_label_map
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.table import MAX_LABEL
from tests.conftest import FLUID, SPECKLE, block, even_display, rigid, simulator
from validation.checks import ORIENTATIONS
from validation.measurement import level_db
from validation.phantoms import band_power

PROBES = {
    "linear": LinearProbe(40, 50, scan_lines=161),
    "convex": ConvexProbe(40, 60, 50, scan_lines=161),
    "phased": PhasedProbe(75, 50, scan_lines=161),
}
QUIET = even_display(tgc_db_cm_mhz=0.0, noise_db=None)


@pytest.fixture(scope="module")
def solid():
    return simulator(block(lambda x, y, z: np.ones_like(x), half_mm=(40, 40, 40)), SPECKLE)


@pytest.mark.parametrize(("kind", "orientation"), list(zip(PROBES, ORIENTATIONS, strict=True)))
def test_a_small_target_appears_where_it_is_in_the_patient(kind, orientation):
    """The brightest pixel, transformed to RAS by the frame's matrices, is the front of the target."""
    probe, rotation = PROBES[kind], ORIENTATIONS[orientation]
    target = np.array([6.0, 3.0, -2.0])
    ball = block(lambda x, y, z: (x - 6) ** 2 + (y - 3) ** 2 + (z + 2) ** 2 < 2.0**2, spacing_mm=0.5)
    sim = simulator(ball, Tissue("ball", 1540.0, 8.0, 0.0), scattering=False)
    pose = np.eye(4)
    pose[:3, :3] = rotation
    # The target lies in the probe plane, 7 mm to the right of its axis and 30 mm deep.
    pose[:3, 3] = target - rotation @ [7.0, 30.0, 0.0]
    frame = sim.simulate(probe, pose, QUIET)
    row, column = np.unravel_index(np.argmax(frame.image), frame.image.shape)
    found = pose @ frame.image_to_probe @ [column, row, 0, 1]
    along_line = np.array([7.0, 30.0 + (probe.apex_radius_mm if np.isfinite(probe.apex_radius_mm) else 1e9), 0.0])
    front = target - 2.0 * rotation @ along_line / np.linalg.norm(along_line)
    assert np.linalg.norm(found[:3] - front) < 0.6
    volume = frame.to_volume()
    np.testing.assert_allclose(volume.ijk_to_ras @ [column, row, 0, 1], found, atol=1e-6)


@pytest.mark.parametrize("kind", PROBES)
def test_outside_the_field_the_image_is_black(solid, kind):
    probe = PROBES[kind]
    frame = solid.simulate(probe, rigid(np.eye(3), [0, -25, 0]), replace(QUIET, gain_db=100.0))
    columns, rows = np.meshgrid(np.arange(frame.image.shape[1]), np.arange(frame.image.shape[0]))
    x = columns * frame.pixel_spacing_mm[0] + frame.image_to_probe[0, 3]
    y = rows * frame.pixel_spacing_mm[1] + frame.image_to_probe[1, 3]
    if probe.is_linear:
        inside = (np.abs(x) < 20) & (y > 0) & (y < 50)
    else:
        radius, angle = np.hypot(x, y + probe.apex_radius_mm), np.arctan2(x, y + probe.apex_radius_mm)
        inside = (
            (np.abs(angle) < -probe.first_line) & (radius > probe.apex_radius_mm) & (radius < probe.apex_radius_mm + 50)
        )
    from scipy.ndimage import binary_dilation, binary_erosion

    # The outermost lines reach half a line beyond the field.
    assert (frame.image[~binary_dilation(inside, iterations=4)] == 0).all()
    assert (frame.image[binary_erosion(inside, iterations=6)] > 200).mean() > 0.99


@given(st.integers(8, 300), st.integers(8, 300))
@settings(max_examples=4)
def test_the_image_has_the_size_asked_for_and_holds_the_field(solid, rows, columns):
    probe = PROBES["convex"]
    frame = solid.simulate(probe, rigid(np.eye(3), [0, -25, 0]), even_display(image_size=(rows, columns)))
    assert frame.image.shape == (rows, columns)
    left, right, top, bottom = probe.image_bounds_mm()
    assert frame.pixel_spacing_mm == pytest.approx(((right - left) / columns, (bottom - top) / rows))


def test_tgc_undoes_the_attenuation_it_is_set_to():
    lossy = replace(SPECKLE, attenuation_db_cm_mhz=0.5)
    sim = simulator(block(lambda x, y, z: np.ones_like(x)), lossy)
    frame = sim.simulate(
        PROBES["linear"], rigid(np.eye(3), [0, -25, 0]), even_display(tgc_db_cm_mhz=0.5, noise_db=None)
    )
    dz = frame.sample_interval_mm
    raw = [level_db(frame.iq[:, int(d / dz) : int((d + 8) / dz)]) for d in (5, 37)]
    seen = [level_db(frame.envelope[:, int(d / dz) : int((d + 8) / dz)]) for d in (5, 37)]
    # The band of the pulse loses 0.7 dB less than its centre.
    assert raw[1] - raw[0] == pytest.approx(-2 * 0.5 * 5 * 3.2 + 0.7, abs=0.4)
    assert seen[1] - seen[0] == pytest.approx(0, abs=0.7)


@pytest.mark.parametrize("reach", [0.0, 0.4, 1.0])
def test_tgc_rises_down_to_its_reach_and_stays_there(solid, reach):
    """Of a band of 5 MHz about its centre, each frequency by itself (tests/test_band.py has wider ones)."""
    pose, probe = rigid(np.eye(3), [0, -25, 0]), PROBES["linear"]
    display = even_display(tgc_db_cm_mhz=0.5, tgc_reach=reach, noise_db=None)
    raised, plain = (solid.simulate(probe, pose, shown) for shown in (display, replace(display, tgc_db_cm_mhz=0.0)))
    decibels = 20 * np.log10((raised.envelope / plain.envelope).mean(axis=0))
    depth_cm = 0.1 * raised.sample_interval_mm * np.arange(decibels.size)
    loss_db = 2 * 0.5 * 5 * np.minimum(depth_cm, 0.1 * reach * probe.depth_mm)
    assert decibels == pytest.approx(-10 * np.log10(band_power(probe, loss_db)), abs=0.02)


def test_grey_levels_are_decibels_in_the_dynamic_range(solid):
    pose = rigid(np.eye(3), [0, -25, 0])
    frame = solid.simulate(PROBES["linear"], pose, replace(QUIET, dynamic_range_db=60.0))
    louder = solid.simulate(PROBES["linear"], pose, replace(QUIET, dynamic_range_db=60.0, gain_db=12.0))
    middle = (frame.bmode > 10) & (louder.bmode < 245)
    rise = louder.bmode[middle].astype(int) - frame.bmode[middle]
    assert np.abs(rise - 255 * 12 / 60).max() <= 1
    decibels = 20 * np.log10(frame.envelope[middle])
    slope = np.polyfit(decibels, frame.bmode[middle], 1)[0]
    assert slope == pytest.approx(255 / 60, rel=0.01)


def test_noise_has_the_level_asked_for_and_is_seeded():
    empty = block(lambda x, y, z: np.ones_like(x))
    pose = rigid(np.eye(3), [0, -25, 0])
    noisy = even_display(tgc_db_cm_mhz=0.0, noise_db=-40.0)
    frames = [simulator(empty, FLUID, seed=seed).simulate(PROBES["linear"], pose, noisy) for seed in (1, 1, 2)]
    assert level_db(frames[0].envelope) == pytest.approx(-40, abs=0.1)
    np.testing.assert_array_equal(frames[0].envelope, frames[1].envelope)
    assert np.corrcoef(frames[0].envelope.ravel(), frames[2].envelope.ravel())[0, 1] < 0.01
    assert frames[0].envelope.mean() / frames[0].envelope.std() == pytest.approx(1.913, rel=0.01)


def test_rf_is_the_carrier_times_the_baseband(solid):
    frame = solid.simulate(PROBES["linear"], rigid(np.eye(3), [0, -25, 0]))
    np.testing.assert_allclose(np.abs(frame.rf), np.abs(frame.iq), rtol=1e-5, atol=1e-9)
    spectrum = np.abs(np.fft.fft(frame.rf, axis=1)).mean(axis=0)
    frequency = np.fft.fftfreq(frame.rf.shape[1], frame.sample_interval_mm)
    mean = (frequency * spectrum**2).sum() / (spectrum**2).sum()
    assert mean * 1.54 / 2 == pytest.approx(5.0, rel=0.03)  # MHz


@pytest.mark.parametrize("bandwidth, samples_per_cycle", [(0.05, 4), (0.5, 16)])
def test_the_pulse_is_whole_at_every_bandwidth_and_sampling_rate(bandwidth, samples_per_cycle):
    """The echo of a point has the complete Gaussian envelope of axial_sigma_mm."""
    wall = block(lambda x, y, z: y > 0)
    probe = LinearProbe(4, 45, scan_lines=9, fractional_bandwidth=bandwidth)
    sim = simulator(wall, Tissue("wall", 1540.0, 1.8, 0.0), scattering=False, samples_per_cycle=samples_per_cycle)
    frame = sim.simulate(probe, rigid(np.eye(3), [0, -22, 0]))
    envelope = np.abs(frame.iq[4])
    depth = np.arange(envelope.size) * frame.sample_interval_mm
    centre = np.average(depth, weights=envelope)
    width = np.sqrt(np.average((depth - centre) ** 2, weights=envelope))
    assert width == pytest.approx(probe.axial_sigma_mm, rel=0.03)


def test_frames_go_to_vtk_with_their_place_in_the_patient(solid):
    pose = rigid(ORIENTATIONS["oblique"], [0, -25, 0])
    frame = solid.simulate(PROBES["convex"], pose)
    image = frame.to_vtk()
    rows, columns = frame.image.shape
    assert image.GetDimensions() == (columns, rows, 1)
    corner = [0.0, 0.0, 0.0]
    image.TransformIndexToPhysicalPoint([columns - 1, rows - 1, 0], corner)
    np.testing.assert_allclose(corner, (pose @ frame.image_to_probe @ [columns - 1, rows - 1, 0, 1])[:3], atol=1e-4)


@pytest.mark.slow
@given(
    st.lists(st.floats(-180, 180), min_size=3, max_size=3),
    st.lists(st.floats(-25, 25), min_size=3, max_size=3),
    st.lists(st.sampled_from([-1.0, 1.0]), min_size=3, max_size=3),
)
@settings(max_examples=15)
def test_the_grid_of_the_labels_does_not_matter_only_their_place(angles, shift, flips):
    """The same tissue on a rotated or mirrored grid gives the same speckle: scatterers are fixed in the patient."""
    rotation = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    matrix = np.eye(4)
    matrix[:3, :3] = rotation @ np.diag(flips) * 1.5
    matrix[:3, 3] = -matrix[:3, :3] @ [40, 40, 40] + shift
    solid_labels = Volume(np.ones((81, 81, 81), np.uint8), matrix)
    pose = rigid(np.eye(3), [0, -10, 0])
    probe = LinearProbe(10, 20, scan_lines=24)
    stored = simulator(solid_labels, SPECKLE).simulate(probe, pose)
    straight = simulator(block(lambda x, y, z: np.ones_like(x), half_mm=(40, 40, 40)), SPECKLE).simulate(probe, pose)
    np.testing.assert_allclose(stored.iq, straight.iq, atol=2e-3 * np.abs(straight.iq).max())


def test_changed_tissues_give_what_a_new_simulator_would(solid):
    labels = block(lambda x, y, z: np.where(x**2 + y**2 + z**2 < 100, 2, 1))
    pose, probe = rigid(np.eye(3), [0, -25, 0]), PROBES["linear"]
    csf = replace(TISSUES["csf"], name="csf")
    membrane = Membrane(TISSUES["leptomeninges"], thickness_mm=1.5)
    before = TissueTable({0: FLUID, 1: SPECKLE, 2: csf})
    after = TissueTable({0: FLUID, 1: replace(SPECKLE, mu0=0.9), 2: csf}, membrane)
    sim = UltrasoundSimulator(labels, before)
    sim.simulate(probe, pose)
    sim.set_tissues(after)
    np.testing.assert_array_equal(
        sim.simulate(probe, pose).iq, UltrasoundSimulator(labels, after).simulate(probe, pose).iq
    )
    with pytest.raises(SimulationError, match="label 2 has no tissue"):
        sim.set_tissues(TissueTable({0: FLUID, 1: SPECKLE}))
    np.testing.assert_array_equal(
        sim.simulate(probe, pose).iq, UltrasoundSimulator(labels, after).simulate(probe, pose).iq
    )


@pytest.mark.parametrize("spacing_mm", [0.3, 1.0])
def test_a_membrane_continues_beyond_the_end_of_a_label_map(spacing_mm):
    half = block(lambda x, y, z: np.where(y > 0, 1, 0), (8, 12, 6), spacing_mm)
    bright = Tissue("bright", 1540.0, 1.54, 0.0, mu0=1.0, sigma0=0.5)
    silent = Tissue("silent", 1540.0, 1.54, 0.0)
    table = TissueTable({0: FLUID, 1: silent}, Membrane(bright, 0.4, (FLUID.name,), diffuse_db=0.0))
    probe = LinearProbe(40, 22, scan_lines=81, focus_mm=12, elevation_focus_mm=12)
    settings = SimulationSettings(interfaces=False, side_lobes=False)
    iq = UltrasoundSimulator(half, table, settings).simulate(probe, rigid(np.eye(3), [0, -10, 0])).iq
    power, outside = np.mean(np.abs(iq) ** 2, axis=1), np.abs(probe.line_positions()) > 10.0
    assert power.min() > 1e-4
    assert 0.5 < power[outside].mean() / power[~outside].mean() < 2.0


def test_the_end_of_a_label_map_is_not_a_border_and_is_reported_once(caplog):
    """Tissue continues with its level and without a wall, whether the map ends in the depth or beside the lines."""
    whole, short = (simulator(block(lambda x, y, z: 1 + 0 * x, half), SPECKLE) for half in ((40,) * 3, (12, 12, 20)))
    probe = LinearProbe(30, 40, scan_lines=61, focus_mm=20, elevation_focus_mm=20)
    shallow = replace(probe, depth_mm=23.0)
    views = (whole, probe), (short, shallow), (short, shallow), (short, probe), (short, probe)
    images = [made.simulate(seen_by, rigid(np.eye(3), [0, -10, 0])).iq for made, seen_by in views]
    np.testing.assert_allclose(images[4], images[0], atol=1e-3 * np.abs(images[0]).max())
    told = [record.getMessage() for record in caplog.records if "beyond the volume" in record.getMessage()]
    end = "% of the image is beyond the volume: it shows the tissue at the volume's end, not the patient"
    assert told == [f"27 {end}", f"57 {end}"]  # again once the share has doubled


@pytest.mark.parametrize("thickness", [0.6, 1.6])
def test_the_membrane_is_as_thick_as_it_is_set(thickness):
    """Thinner and thicker than a voxel: the fraction of scatterers in it is its thickness (within 15 %)."""
    half = block(lambda x, y, z: np.where(y > 0, 2, 1), half_mm=(25, 25, 25))
    bright = Tissue("bright", 1540.0, 1.54, 0.0, mu0=1.0, sigma0=0.5)
    silent, csf = Tissue("silent", 1540.0, 1.54, 0.0), Tissue("csf", 1540.0, 1.54, 0.0)
    table = TissueTable({0: FLUID, 1: silent, 2: csf}, Membrane(bright, thickness, ("csf",), diffuse_db=0.0))
    probe = LinearProbe(30, 40, scan_lines=121, focus_mm=20, elevation_focus_mm=20)
    powers = []
    for seed in range(6):
        iq = (
            UltrasoundSimulator(half, table, SimulationSettings(seed=seed))
            .simulate(probe, rigid(np.eye(3), [0, -20, 0]))
            .iq
        )
        dz = 40 / iq.shape[1]
        powers.append((np.abs(iq) ** 2).sum(axis=1).mean() * dz)
    # Mean square times depth: unit energy of the pulse makes it variance x thickness.
    assert np.mean(powers) / bright.scatterer_variance == pytest.approx(thickness, rel=0.15)


@pytest.mark.parametrize(("spacing_mm", "exponent"), [(0.5, 2.0), (1.0, 0.0)])
def test_the_membrane_fades_where_the_beam_meets_it_obliquely(spacing_mm, exponent):
    """A line crosses 1 / cos i of the thickness, and the power of its scatterers falls with cos^2n i."""
    bright = Tissue("bright", 1540.0, 1.54, 0.0, mu0=1.0, sigma0=0.5)
    silent, csf = Tissue("silent", 1540.0, 1.54, 0.0), Tissue("csf", 1540.0, 1.54, 0.0)
    half = block(lambda x, y, z: np.where(y > 0, 2, 1), (25, 25, 25), spacing_mm)
    table = TissueTable({0: FLUID, 1: silent, 2: csf}, Membrane(bright, 0.6, ("csf",), diffuse_exponent=exponent))
    probe = LinearProbe(24, 40, scan_lines=97, focus_mm=20, elevation_focus_mm=20)
    powers = []
    for tilt in (0.0, 50.0):
        pose = rigid(Rotation.from_euler("z", tilt, degrees=True).as_matrix(), [0, -20, 0])
        power = 0.0
        for seed in range(4):
            iq = UltrasoundSimulator(half, table, SimulationSettings(seed=seed)).simulate(probe, pose).iq
            power += float((np.abs(iq) ** 2).sum(axis=1)[24:-24].mean())
        powers.append(power)
    cosine = np.cos(np.radians(50.0))
    assert 10 * np.log10(powers[1] / powers[0]) == pytest.approx(10 * np.log10(cosine ** (2 * exponent - 1)), abs=1.0)


@pytest.mark.slow
@pytest.mark.parametrize(("tilt_deg", "thickness_mm"), [(3.0, 6.0), (6.0, 99.0)])
def test_the_membrane_on_a_flat_border_has_no_steps(tilt_deg, thickness_mm):
    """Its line in the image is straight within 0.1 mm.

    Also in front of a layer of the fluid, whose other wall is as near as the Gaussian is wide.
    """
    slope = np.tan(np.radians(tilt_deg))

    def in_layer(x, y, z):
        depth = (y - slope * x - 0.03 * z - 0.2) * np.cos(np.arctan(slope))
        return np.where((depth > 0) & (depth < thickness_mm), 2, 1)

    half = block(in_layer, (30, 25, 25))
    bright = Tissue("bright", 1540.0, 1.54, 0.0, mu0=1.0, sigma0=0.5)
    silent, csf = Tissue("silent", 1540.0, 1.54, 0.0), Tissue("csf", 1540.0, 1.5, 0.0)
    table = TissueTable({0: silent, 1: silent, 2: csf}, Membrane(bright, 0.4, ("csf",), diffuse_exponent=0.0))
    probe = LinearProbe(36, 40, scan_lines=73, focus_mm=20, elevation_focus_mm=20)
    power = 0.0
    for seed in range(16):
        settings = SimulationSettings(seed=seed, interfaces=False, ring_down=False, side_lobes=False)
        iq = UltrasoundSimulator(half, table, settings).simulate(probe, rigid(np.eye(3), [0, -20, 0])).iq
        power = power + np.abs(iq) ** 2
    depths, lateral = (np.arange(power.shape[1]) + 0.5) * 40.0 / power.shape[1], probe.line_positions()
    power[np.abs(depths - 20.0 - slope * lateral[:, None]) > 2.5] = 0.0  # without the other wall
    place = (power * depths).sum(axis=1) / power.sum(axis=1)
    off = place - np.polyval(np.polyfit(lateral, place, 1), lateral)
    assert np.std(off) < 0.1


@pytest.mark.parametrize(("half_voxels", "across"), [(0.6, (1, 2, 4)), (1.0, (0, 0, 1)), (1.0, (1, 1, 1))])
def test_a_thin_sulcus_is_one_line(half_voxels, across):
    """A layer of the membrane's own tissue of one or two voxels, however it lies in the grid, is one sheet."""
    across = np.array(across) / np.linalg.norm(across)
    (turn, _), half = Rotation.align_vectors([[0, 1, 0]], [across]), 24
    k, j, i = np.meshgrid(*[np.arange(-half, half + 1)] * 3, indexing="ij")
    labels = np.where(np.abs(i * across[0] + j * across[1] + k * across[2]) < half_voxels, 2, 1).astype(np.uint8)
    ijk_to_ras = rigid(turn.as_matrix(), [0, 0, 0]) @ rigid(np.eye(3), [-half] * 3)
    bright = Tissue("sheet", 1540.0, 1.54, 0.0, mu0=0.5, sigma0=0.5)
    table = TissueTable(
        {0: FLUID, 1: Tissue("silent", 1540.0, 1.54, 0.0), 2: bright},
        Membrane(bright, 0.4, ("sheet",), diffuse_db=12.0),
    )
    probe = LinearProbe(20, 40, scan_lines=121, focus_mm=20, elevation_focus_mm=20)
    power = 0.0
    for seed in range(6):
        simulator = UltrasoundSimulator(Volume(labels, ijk_to_ras), table, SimulationSettings(seed=seed))
        power += (np.abs(simulator.simulate(probe, rigid(np.eye(3), [0, -20, 0])).iq) ** 2).mean(axis=0)
    level = 10.0 * np.log10(power / power.max() + 1e-12)
    bright_at = np.flatnonzero(level > -6.0)
    assert level[bright_at[0] : bright_at[-1] + 1].min() > -8.5
    assert np.ptp(bright_at) * 40.0 / len(level) < 1.6
    assert (bright_at.mean() + 0.5) * 40.0 / len(level) == pytest.approx(20.0, abs=0.2)


def test_roughness_of_the_membrane_takes_the_coherent_echo_of_its_border():
    """exp(-(2 k s cos i)^2 / 2) at the border of the fluid, nothing at the border between two other tissues."""
    tilt_deg = 35.0
    fluid, brain, bone = (Tissue(name, 1540.0, z, 0.0) for name, z in (("csf", 1.5), ("brain", 1.6), ("bone", 4.0)))
    slabs = block(lambda x, y, z: np.where(y < 0, 1, np.where(y < 8, 2, 3)))
    pose = rigid(Rotation.from_euler("z", tilt_deg, degrees=True).as_matrix(), [0, -15, 0])
    probe = LinearProbe(4, 40, scan_lines=9, frequency_mhz=5.0)
    echoes = []
    for roughness in (0.0, 0.03):
        table = TissueTable({0: fluid, 1: fluid, 2: brain, 3: bone}, Membrane(brain, 0.5, ("csf",), roughness))
        tree = UltrasoundSimulator(slabs, table, SimulationSettings(reflections=False)).trace(probe, pose)
        behind = tree.hits["label_behind"]
        echoes.append([tree.hits["echo"][behind == label].mean() for label in (2, 3)])
    at_fluid, inside = np.divide(echoes[1], echoes[0])
    phase = 2 * (2 * np.pi * 5.0 / 1.54) * 0.03 * np.cos(np.radians(tilt_deg))
    assert at_fluid == pytest.approx(np.exp(-0.5 * phase**2), rel=0.03) and inside == pytest.approx(1.0, rel=1e-4)


def test_a_label_map_without_labels_is_a_warning_and_a_black_image():
    empty = Volume(np.zeros((20, 20, 20), np.uint8), np.eye(4))
    sim = UltrasoundSimulator(empty, TissueTable({0: FLUID}), SimulationSettings(ring_down=False))
    with pytest.warns(EmptyViewWarning, match="no labels"):
        assert not sim.simulate(PROBES["linear"], rigid(np.eye(3), [10, 0, 10])).image.any()


def test_a_probe_that_looks_past_the_volume_warns(solid):
    with pytest.warns(EmptyViewWarning, match="looks past the volume"):
        solid.simulate(PROBES["linear"], rigid(np.eye(3), [300, 0, 0]), QUIET)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solid.simulate(PROBES["linear"], rigid(np.eye(3), [0, -60, 0]), QUIET)


@pytest.mark.parametrize(
    "pose, message",
    [
        (np.zeros((4, 4)), "last row"),
        (np.diag([1.0, 1, 1, 1]) * [[0], [1], [1], [1]], "not rigid"),
        (np.diag([-1.0, 1, 1, 1]), "mirrors"),
        (np.full((4, 4), np.nan), "not finite"),
        (np.eye(3), "shape"),
    ],
)
def test_poses_that_are_not_rigid_are_refused(solid, pose, message):
    with pytest.raises(SimulationError, match=f"probe_to_ras.*{message}"):
        solid.simulate(PROBES["linear"], pose)


@pytest.mark.parametrize(
    "array, message",
    [
        (np.full((4, 4, 4), 3), "label 3 has no tissue"),
        (np.full((4, 4, 4), 0.5), "fractions"),
        (np.full((4, 4, 4), -1), "from -1"),
        (np.full((4, 4, 4), MAX_LABEL + 1, np.uint8), f"has label {MAX_LABEL + 1}, expected 0 to {MAX_LABEL}"),
        (np.full((4, 4, 4), 200), f"from 200 to 200, expected whole numbers from 0 to {MAX_LABEL}"),
    ],
)
def test_labels_that_cannot_be_used_are_refused(array, message):
    with pytest.raises(SimulationError, match=message):
        UltrasoundSimulator(Volume(array, np.eye(4)), TissueTable({1: SPECKLE}))


def test_the_largest_label_can_be_used():
    labels = Volume(np.full((4, 4, 4), MAX_LABEL, np.float32), np.eye(4))
    medium = UltrasoundSimulator(labels, TissueTable({0: FLUID, MAX_LABEL: SPECKLE})).medium
    assert list(medium.present) == [MAX_LABEL]


def test_a_sweep_is_the_frames_of_its_poses(solid):
    poses = [rigid(np.eye(3), [0, -25, z]) for z in (-1.0, 0.0, 2.0)]
    seen = []
    frames = list(solid.sweep(PROBES["linear"], poses, QUIET, progress=seen.append))
    assert seen == [1, 2, 3]
    for frame, pose in zip(frames, poses, strict=True):
        np.testing.assert_array_equal(frame.image, solid.simulate(PROBES["linear"], pose, QUIET).image)  # no noise


def kernels_of(sim, *arguments) -> set[str]:
    """Names of the kernels that run for an image."""
    sim.device.profiling = True
    try:
        sim.simulate(*arguments)
        return set(sim.device.take_profile())
    finally:
        sim.device.profiling = False


def test_what_did_not_change_is_not_computed_again(solid):
    probe, pose = PROBES["linear"], rigid(np.eye(3), [0, -25, 0])
    solid.simulate(probe, pose, QUIET)
    bright = replace(QUIET, gain_db=6.0)
    assert kernels_of(solid, probe, pose, bright) == {"compress", "average_depth", "scan_convert"}
    assert "trace" in kernels_of(solid, probe, rigid(np.eye(3), [0, -25, 0.1]), bright)
    assert "trace" in kernels_of(solid, replace(probe, frequency_mhz=4.0), pose, bright)
    assert "trace" in kernels_of(solid, replace(probe, fractional_bandwidth=0.3), pose, bright)
    assert "trace" not in kernels_of(solid, replace(probe, fractional_bandwidth=0.3), pose, QUIET)


def test_a_change_gives_the_image_of_a_new_simulator():
    labels = block(lambda x, y, z: np.where(y > 0, 2, 1), half_mm=(20, 20, 10))
    probe, pose = PROBES["convex"], rigid(np.eye(3), [0, -18, 0])
    louder = replace(SPECKLE, name="louder", mu0=0.0, sigma0=2.0)
    sim = simulator(labels, SPECKLE, louder)
    tables = [sim.medium.tissues, sim.medium.tissues.replace("louder", sigma0=0.4)]
    changes = [
        (tables[0], sim.settings, QUIET),
        (tables[0], sim.settings, even_display(gain_db=-5, noise_db=-10)),
        (tables[1], sim.settings, QUIET),
        (tables[1], replace(sim.settings, seed=3), QUIET),
        (tables[1], replace(sim.settings, interfaces=False), QUIET),
        (tables[0], sim.settings, replace(QUIET, image_size=(100, 90))),
    ]
    for tissues, simulation, display in changes:
        sim.set_tissues(tissues)
        sim.settings = simulation
        fresh = UltrasoundSimulator(labels, tissues, simulation).simulate(probe, pose, display)
        np.testing.assert_array_equal(sim.simulate(probe, pose, display).image, fresh.image)


def test_acoustic_groups_may_split_or_merge():
    """Groups are tissues of equal speed and impedance; there is an interface wherever two of them meet."""
    labels = block(lambda x, y, z: 1 + (y > 0) + (y > 6), half_mm=(12, 14, 8))
    probe, pose = LinearProbe(16, 22, scan_lines=48), rigid(np.eye(3), [0, -12, 0])
    sim = simulator(labels, *(replace(SPECKLE, name=name) for name in ("upper", "middle", "lower")))
    together = sim.medium.tissues
    split = together.replace("middle", impedance_mrayl=2.0)
    regrouped = together.replace("upper", impedance_mrayl=2.0).replace("middle", impedance_mrayl=2.0)
    slower = regrouped.replace("lower", speed_of_sound_m_s=1400.0)
    images = []
    for tissues in (together, split, regrouped, slower, together):
        sim.set_tissues(tissues)
        images.append(sim.simulate(probe, pose, QUIET).image)
        fresh = UltrasoundSimulator(labels, tissues, sim.settings)
        np.testing.assert_array_equal(images[-1], fresh.simulate(probe, pose, QUIET).image)
    for before, after in pairwise(images):
        assert not np.array_equal(before, after)


def test_stages_are_timed_on_request(solid):
    solid.profiling = True
    try:
        frame = solid.simulate(PROBES["linear"], rigid(np.eye(3), [0, -25, 0]))
    finally:
        solid.profiling = False
    assert {"ray tree", "scatterers", "pulse", "B-mode", "scan conversion"} <= set(frame.timings_ms)
    assert solid.simulate(PROBES["linear"], rigid(np.eye(3), [0, -25, 0])).timings_ms == {}


_LABELS = block(lambda x, y, z: np.ones_like(x), half_mm=(5, 5, 5))
_TABLE = TissueTable({1: SPECKLE})


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: segment_mri("head.nii.gz"), r"mri is a str, expected a Volume \(Volume.read reads a file\)"),
        (lambda: read_label_map(np.ones((3, 3, 3))), "label map is a ndarray, expected a Volume"),
        (lambda: Volume.read(None), "the file is None, expected its name: text or a Path"),
        (lambda: TissueTable("brain"), "tissues is a str, expected a Mapping"),
        (lambda: UltrasoundSimulator(_LABELS, None), r"tissues is None, expected a TissueTable \(TissueTable.brain"),
        (
            lambda: UltrasoundSimulator(_LABELS, _TABLE).simulate("convex", np.eye(4)),
            "probe is a str, expected a Probe",
        ),
        (
            lambda: list(UltrasoundSimulator(_LABELS, _TABLE).sweep(PROBES["linear"], None)),
            "poses is None, expected an",
        ),
    ],
)
def test_an_argument_of_a_wrong_type_is_named_with_what_was_expected(call, message):
    with pytest.raises(SimulationError, match=message):
        call()


def test_so_many_scatterers_that_an_image_takes_long_are_a_warning():
    labels, pose = block(lambda x, y, z: np.ones_like(x)), rigid(np.eye(3), [0, -60, 0])
    with warnings.catch_warnings():  # as an error, before the image is computed
        warnings.simplefilter("error")
        dense = simulator(labels, SPECKLE, scatterers_per_mm3=200_000.0)
        with pytest.raises(SlowScatterersWarning, match=r"200000 .* 3\.2e\+09 cells .* about 108 s on .*none: 18\)"):
            dense.simulate(PROBES["convex"], pose)
        with pytest.raises(SlowScatterersWarning):
            dense.volume(PROBES["convex"], [pose])
        for enough in (None, 500.0):
            simulator(labels, SPECKLE, scatterers_per_mm3=enough).simulate(PROBES["convex"], pose)
        simulator(labels, SPECKLE, scatterers_per_mm3=200_000.0, scattering=False).simulate(PROBES["convex"], pose)


def test_a_probe_that_would_take_minutes_is_refused_with_the_numbers():
    labels = block(lambda x, y, z: np.ones_like(x), half_mm=(10, 10, 10))
    probe = replace(
        PROBES["phased"], frequency_mhz=30.0, depth_mm=300.0, elevation_aperture_mm=100.0, elevation_focus_mm=1.0
    )
    words = r"30 MHz, elevation aperture 100 mm, elevation focus 1 mm\) .* cells .* expected at most 1e\+10"
    small = simulator(labels, SPECKLE)
    for use in (lambda: small.simulate(probe, np.eye(4)), lambda: small.volume(probe, [np.eye(4)])):
        with pytest.raises(SimulationError, match=words):
            use()


def test_a_wall_breaks_where_its_roughness_varies_and_keeps_its_level():
    """Levels along a flat wall vary from patch to patch; the mean power of its scatterers stays."""
    bright = replace(SPECKLE, mu0=1.0, sigma0=0.5)
    silent, csf = replace(SPECKLE, mu0=0.0, sigma0=0.0), replace(FLUID, name="csf")
    labels = block(lambda x, y, z: np.where(y < 0, 2, 1), half_mm=(40, 20, 20))
    probe, pose = LinearProbe(60, 30, scan_lines=181), rigid(np.eye(3), [0, -15, 0])
    level = {}
    for patch_db in (0.0, 7.0):
        power = 0.0
        for seed in range(12):
            membrane = Membrane(bright, 0.6, ("csf",), diffuse_db=0.0, patch_db=patch_db)
            table = TissueTable({0: silent, 1: silent, 2: csf}, membrane)
            made = UltrasoundSimulator(labels, table, SimulationSettings(seed=seed, interfaces=False, ring_down=False))
            power = power + (np.abs(made.simulate(probe, pose).iq) ** 2).sum(axis=1)[20:-20]
            level.setdefault(f"single {patch_db}", power)
        level[patch_db] = power
    assert 10 * np.log10(level[7.0].mean() / level[0.0].mean()) == pytest.approx(0.0, abs=1.5)
    wide = {db: uniform_filter1d(level[f"single {db}"], 12)[6:-6] for db in (0.0, 7.0)}  # over the speckle
    assert np.log10(wide[7.0]).std() > 1.5 * np.log10(wide[0.0]).std()
