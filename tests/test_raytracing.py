"""The ray tree against geometry and physics: interfaces, Snell, reflectance, attenuation, time, weights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from SlicerUSSim.Logic import ConvexProbe, LinearProbe, PhasedProbe, Tissue
from SlicerUSSim.Logic.simulator import TreeOverflowWarning
from tests.conftest import FLUID, ORIENTATIONS, block, rigid, simulator

SLOW, FAST = Tissue("slow", 1450.0, 1.45, 0.3), Tissue("fast", 1650.0, 1.9, 0.9)
PROBES = {
    "linear": LinearProbe(24, 50, scan_lines=49),
    "convex": ConvexProbe(40, 30, 50, scan_lines=49),
    "phased": PhasedProbe(40, 50, scan_lines=49),
}


def first_hits(tree):
    return tree.hits[tree.hits["reflections"] == 0]


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_a_voxelised_sphere_has_smooth_normals_in_the_right_place(orientation):
    """PHYSICS section 3: 1 mm voxels, radius 20 mm: normals within 3 degrees, position within 0.15 voxel, RMS."""
    centre = np.array([0.31, 0.17, -0.42])  # nowhere special on the grid
    sphere = block(lambda x, y, z: (x - centre[0]) ** 2 + (y - centre[1]) ** 2 + (z - centre[2]) ** 2 < 20.0**2)
    sim = simulator(sphere, FAST, coupling=Tissue("outside", 1650.0, 1.6, 0.0), elevational_rays=16)
    probe = LinearProbe(30, 30, scan_lines=121, elevation_aperture_mm=30, elevation_focus_mm=60)
    tree = sim.trace(probe, rigid(ORIENTATIONS[orientation], [0, -29, 0]))
    front = tree.hits[(tree.hits["label_before"] == 0) & (tree.hits["reflections"] == 0)]
    assert len(front) > 1000
    radius = np.linalg.norm(front["position"] - centre, axis=1)
    outward = (front["position"] - centre) / radius[:, None]
    angle = np.degrees(np.arccos(np.clip((front["normal"] * outward).sum(axis=1), -1, 1)))
    assert np.sqrt((angle**2).mean()) < 3.0
    assert np.sqrt(((radius - 20.0) ** 2).mean()) < 0.15
    assert abs((radius - 20.0).mean()) < 0.05  # curvature does not shrink it


@pytest.mark.parametrize("tilt_deg", [5, 10, 20, 35, 50])
def test_a_tilted_plane_has_no_terraces(tilt_deg):
    """Voxels cut a plane that is nearly aligned with them into long steps; its normals must not show them."""
    normal = np.array([np.sin(np.radians(tilt_deg)), np.cos(np.radians(tilt_deg)), 0.0])
    plane = block(lambda x, y, z: x * normal[0] + y * normal[1] > 0, half_mm=(30, 40, 20), spacing_mm=0.5)
    sim = simulator(plane, FAST, coupling=replace(FAST, name="before", impedance_mrayl=1.6), reflections=False)
    hits = sim.trace(LinearProbe(20, 40, scan_lines=161), rigid(np.eye(3), [0, -20, 0])).hits
    angle = np.degrees(np.arccos(np.clip(-hits["normal"] @ normal, -1, 1)))
    assert np.sqrt((angle**2).mean()) < 3.0
    assert (hits["position"] @ normal).std() < 0.2 * 0.5


def test_a_gap_of_a_few_voxels_keeps_its_width():
    """Smoothing that sees both sides of a gap must not move them."""
    for voxels in (3, 5, 7, 9):
        gap = block(lambda x, y, z, half=0.5 * voxels: np.abs(y) < half, spacing_mm=1.0)
        tree = simulator(gap, replace(FAST, speed_of_sound_m_s=1540.0)).trace(
            PROBES["linear"], rigid(np.eye(3), [0, -20, 0])
        )
        straight = tree.hits[tree.hits["reflections"] == 0]
        for behind, place in ((1, 20 - voxels / 2), (0, 20 + voxels / 2)):
            depth = straight["depth_mm"][straight["label_behind"] == behind]
            np.testing.assert_allclose(depth, place, atol=0.15)


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_a_sheet_one_voxel_thick_does_not_vanish(orientation):
    sheet = block(lambda x, y, z: np.abs(y) < 0.5)
    tree = simulator(sheet, FAST).trace(PROBES["linear"], rigid(ORIENTATIONS["aligned"], [0, -20, 0]))
    assert (first_hits(tree)["label_behind"] == 1).sum() == len(set(tree.hit_line)) * 7
    # An oblique sheet, voxelised so that its voxels touch at least by their edges.
    direction = ORIENTATIONS[orientation][:, 1]
    oblique = block(lambda x, y, z: np.abs(x * direction[0] + y * direction[1] + z * direction[2]) < 0.75)
    tree = simulator(oblique, FAST).trace(PROBES["linear"], rigid(ORIENTATIONS[orientation], [0, -20, 0]))
    hit = {(line, ray) for line, ray in zip(tree.hit_line, tree.hit_ray, strict=True)}
    assert len(hit) == len(set(tree.hit_line)) * 7


@pytest.mark.parametrize("probe", PROBES.values(), ids=PROBES)
@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_refraction_follows_snell_and_reflection_fresnel(probe, orientation):
    """A plane tilted by 20 degrees against the probe, between two fluids."""
    rotation = ORIENTATIONS[orientation]
    normal = rotation @ [np.sin(np.radians(20)), np.cos(np.radians(20)), 0.0]
    half = block(
        lambda x, y, z: x * normal[0] + y * normal[1] + z * normal[2] > 0, half_mm=(40, 40, 40), spacing_mm=0.8
    )
    tree = simulator(half, FAST, coupling=SLOW).trace(probe, rigid(rotation, [0, -20, 0]))
    crossing = first_hits(tree)[first_hits(tree)["label_behind"] == 1]
    off = np.degrees(np.arccos(np.clip(-crossing["normal"] @ normal, -1, 1)))
    assert np.median(off) < 3.0
    cos_in = crossing["cos_incidence"].astype(float)
    sin_out = FAST.speed_of_sound_m_s / SLOW.speed_of_sound_m_s * np.sqrt(1 - cos_in**2)
    cos_out = np.sqrt(np.clip(1 - sin_out**2, 0, None))
    z1, z2 = SLOW.impedance_mrayl, FAST.impedance_mrayl
    expected = np.where(sin_out >= 1, 1.0, ((z2 * cos_in - z1 * cos_out) / (z2 * cos_in + z1 * cos_out)) ** 2)
    np.testing.assert_allclose(crossing["reflectance"], expected, atol=2e-4)

    # The segments on either side of the plane obey Snell with the true normal.
    segments, lines = (
        tree.segments[tree.segments["reflections"] == 0],
        tree.segment_line[tree.segments["reflections"] == 0],
    )
    ratios = []
    for line in np.unique(lines):
        path = segments[lines == line]
        behind = np.flatnonzero(path["label"] == 1)
        if behind.size and behind[0] > 0:
            sines = [np.linalg.norm(np.cross(path[n]["direction"], normal)) for n in (behind[0] - 1, behind[0])]
            ratios.append(sines[1] / sines[0])
    assert np.median(ratios) == pytest.approx(FAST.speed_of_sound_m_s / SLOW.speed_of_sound_m_s, rel=0.03)


def test_beyond_the_critical_angle_everything_is_reflected():
    # Behind a plane at 75 degrees (critical angle asin(1450 / 1650) = 61.5 degrees) nothing arrives.
    normal = np.array([np.sin(np.radians(75)), np.cos(np.radians(75)), 0.0])
    half = block(lambda x, y, z: x * normal[0] + y * normal[1] > 0, half_mm=(40, 40, 20))
    tree = simulator(half, FAST, coupling=SLOW).trace(LinearProbe(4, 50, scan_lines=9), rigid(np.eye(3), [0, -20, 0]))
    hits = tree.hits[(tree.hits["label_behind"] == 1) & (tree.hits["reflections"] == 0)]
    assert len(hits) > 0 and (hits["reflectance"] == 1.0).all()
    assert not (tree.segments["label"][tree.segments["reflections"] == 0] == 1).any()
    mirrored = tree.segments[tree.segments["reflections"] == 1]
    assert (mirrored["weight"] == 1.0).all()
    expected = np.array([0.0, 1.0, 0.0]) - 2 * normal[1] * normal
    assert np.degrees(np.arccos(mirrored["direction"] @ expected)).max() < 10  # twice the error of the normal


def test_depth_follows_travel_time_and_attenuation_the_path():
    slab = block(lambda x, y, z: np.where(np.abs(y) < 9.5, 1, 2))
    back = Tissue("back", 1540.0, 1.6, 0.1)
    tree = simulator(slab, FAST, back, reflections=False).trace(PROBES["linear"], rigid(np.eye(3), [0, -20, 0]))
    out = first_hits(tree)[first_hits(tree)["label_before"] == 1]
    # 10.5 mm of label 2 at 1540 m/s, then 19 mm at 1650 m/s.
    np.testing.assert_allclose(out["path_mm"], 29.5, atol=0.05)
    np.testing.assert_allclose(out["depth_mm"], 10.5 + 19 * 1540 / 1650, atol=0.05)
    decibels = 20 * np.log10(out["attenuation"].astype(float))
    np.testing.assert_allclose(decibels, -2 * 5.0 * (0.1 * 1.05 + 0.9 * 1.9), atol=0.1)


def test_weights_of_the_tree_and_what_was_cut_make_one():
    """R + T = 1 at every node: leaves and cut branches together carry the whole weight of the root."""
    layers = block(lambda x, y, z: 1 + (np.floor(y / 7).astype(int) % 2), half_mm=(20, 35, 20))
    sim = simulator(layers, SLOW, FAST, reflection_threshold=1e-4, intensity_threshold=1e-9)
    tree = sim.trace(LinearProbe(4, 60, scan_lines=5), rigid(np.eye(3), [0, -30, 0]))
    for line in np.unique(tree.segment_line):
        path = tree.segments[tree.segment_line == line]
        ends = path["depth_mm"] + path["length_mm"] * path["depth_per_mm"]
        leaves = path["weight"][ends > 60 - 1e-3].sum()
        index = round(line + (tree.cut_weight.shape[0] - 5) / 2)
        total = leaves + tree.cut_weight[index, 0]
        assert total == pytest.approx(1.0, abs=2e-3)


def test_tissues_of_one_speed_and_impedance_have_no_interface_but_their_own_attenuation():
    calm, lossy = Tissue("calm", 1540, 1.6, 0.2), Tissue("lossy", 1540, 1.6, 1.2)
    slab = block(lambda x, y, z: np.where(np.abs(y) < 4.5, 2, 1))
    tree = simulator(slab, calm, lossy, coupling=Tissue("calm", 1540, 1.6, 0.2)).trace(
        PROBES["linear"], rigid(np.eye(3), [0, -20, 0])
    )
    assert len(tree.hits) == 0
    path = tree.segments[tree.segment_line == 0]
    last = path[-1]
    end_db = 20 * np.log10(last["attenuation"]) - last["length_mm"] * last["decay_per_mm"] * 20 / np.log(10)
    assert end_db == pytest.approx(-2 * 5.0 * (0.2 * 4.1 + 1.2 * 0.9), abs=0.05)


def test_max_ray_depth_counts_reflections_and_zero_switches_them_off():
    plates = block(lambda x, y, z: (np.abs(y) > 5) & (np.abs(y) < 8))
    hard = Tissue("hard", 1540, 8.0, 0.0)
    pose = rigid(np.eye(3), [0, -15, 0])
    for depth in (0, 1, 3):
        tree = simulator(plates, hard, max_ray_depth=depth, reflection_threshold=1e-6).trace(PROBES["linear"], pose)
        assert tree.segments["reflections"].max() == depth
    off = simulator(plates, hard, reflections=False).trace(PROBES["linear"], pose)
    assert off.segments["reflections"].max() == 0


def test_more_segments_than_there_is_room_for_are_a_warning():
    """Plates that reflect nearly everything, and a threshold that follows every bounce."""
    plates = block(lambda x, y, z: np.floor(y / 1.0).astype(int) % 2, half_mm=(6, 30, 6))
    hard = Tissue("hard", 1540.0, 6.0, 0.0)
    sim = simulator(plates, hard, reflection_threshold=1e-9, intensity_threshold=1e-9, max_ray_depth=16)
    with pytest.warns(TreeOverflowWarning, match="have more than 256 ray segments"):
        sim.simulate(LinearProbe(4, 60, scan_lines=5), rigid(np.eye(3), [0, -30, 0]))


def test_a_line_that_leaves_the_volume_goes_on_in_the_coupling_medium():
    small = block(lambda x, y, z: np.ones_like(x), half_mm=(10, 10, 10))
    tree = simulator(small, FLUID).trace(PROBES["linear"], rigid(np.eye(3), [0, -40, 0]))
    path = tree.segments[tree.segment_line == 24]
    assert path["length_mm"].sum() == pytest.approx(50.0, abs=0.01)
