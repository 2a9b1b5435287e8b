"""Special cases of the ray tree: tilted planes, narrow gaps, equal tissues, full trees, rays that leave the volume."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic import ConvexProbe, LinearProbe, PhasedProbe, Tissue
from SlicerUSSim.Logic.imaging.simulator import TreeOverflowWarning
from tests.conftest import FLUID, block, rigid, simulator

SLOW, FAST = Tissue("slow", 1450.0, 1.45, 0.3), Tissue("fast", 1650.0, 1.9, 0.9)
PROBES = {
    "linear": LinearProbe(24, 50, scan_lines=49),
    "convex": ConvexProbe(40, 30, 50, scan_lines=49),
    "phased": PhasedProbe(40, 50, scan_lines=49),
}


@pytest.mark.parametrize("tilt_deg", [5, 20, 50])
def test_a_tilted_plane_has_no_terraces(tilt_deg):
    """A plane nearly aligned with the voxels has long steps, which must not affect its normals."""
    normal = np.array([np.sin(np.radians(tilt_deg)), np.cos(np.radians(tilt_deg)), 0.0])
    plane = block(lambda x, y, z: x * normal[0] + y * normal[1] > 0, half_mm=(30, 40, 20), spacing_mm=0.5)
    sim = simulator(plane, FAST, coupling=replace(FAST, name="before", impedance_mrayl=1.6), reflections=False)
    hits = sim.trace(LinearProbe(20, 40, scan_lines=161), rigid(np.eye(3), [0, -20, 0])).hits
    angle = np.degrees(np.arccos(np.clip(-hits["normal"] @ normal, -1, 1)))
    assert np.sqrt((angle**2).mean()) < 3.0
    assert (hits["position"] @ normal).std() < 0.2 * 0.5


@pytest.mark.parametrize(("seed", "spacing_mm", "thick_mm"), [(31, 0.5, 100.0), (31, 1.0, 3.0), (7, 1.0, 100.0)])
def test_a_flat_mirror_is_flat_near_its_edge(seed, spacing_mm, thick_mm):
    """6 to 15 voxels from the edge of an oblique plane of bone: mirrored speckle has no streaks."""
    turned = Rotation.random(random_state=seed).as_matrix()

    def mirror(x, y, z):
        across, deep = (turned[0, n] * x + turned[1, n] * y + turned[2, n] * z for n in (0, 1))
        behind = (deep - 6.0 - 0.5 * across) / np.hypot(1.0, 0.5)
        return 1 + ((behind > 0.0) & (behind < thick_mm) & (across > 0.0))

    labels = block(mirror, (26, 26, 26), spacing_mm)
    before = replace(FAST, name="before", speed_of_sound_m_s=1540.0, impedance_mrayl=1.6)
    sim = simulator(labels, before, Tissue("bone", 3500.0, 7.0, 8.0), coupling=before, interfaces=False)
    mirrored = sim.trace(PhasedProbe(80, 60, scan_lines=161), rigid(turned, [0.0, -10.0, 0.0])).segments
    mirrored = mirrored[mirrored["reflections"] == 1]
    from_edge = (mirrored["start"] @ turned[:, 0]) / spacing_mm
    near = (from_edge > 6.0) & (from_edge < 15.0) & (mirrored["tube"][:, 0] == 1.0)
    assert near.sum() > 10
    deep = mirrored["tube"][near][:, [0, 2]] + 20.0 * mirrored["tube"][near][:, [1, 3]]  # 20 mm behind the mirror
    level = -10.0 * np.log10(deep.prod(axis=1))
    assert level.min() > -3.5 and np.sqrt((level**2).mean()) < 0.8


#: Fat, muscle, the shell of a rib and its marrow
RIB_TISSUES = (
    Tissue("fat", 1450.0, 1.38, 0.5), Tissue("muscle", 1580.0, 1.68, 0.6), Tissue("bone", 3500.0, 7.0, 8.0),
    Tissue("marrow", 1900.0, 2.5, 9.0),
)  # fmt: skip


def rib(spacing_mm: float = 1.0, radius_mm: float = 8.0):
    """A round rib along z, of a shell around marrow, in fat which meets muscle at its flanks."""

    def label(x, y, z):
        away = np.hypot(x, y)
        return np.where(away < radius_mm, np.where(away < radius_mm - 2.0, 4, 3), 1 + (y > -0.6 * radius_mm))

    return block(label, (26, 26, 14), spacing_mm)


def test_a_mirror_is_curved_also_where_the_tissue_before_it_changes():
    """At the flank of a rib, where fat meets muscle.

    Rays beside each other at a distance d meet normals turned by d / (r cos i), and part by twice that angle.
    """
    radius_mm = 8.0
    sim = simulator(rib(1.0, radius_mm), *RIB_TISSUES, coupling=RIB_TISSUES[0], interfaces=False)
    mirrored = sim.trace(LinearProbe(20, 40, scan_lines=161), rigid(np.eye(3), [0.0, -20.0, 0.0])).segments
    first = np.hypot(mirrored["start"][:, 0], mirrored["start"][:, 1]) < radius_mm + 1.0
    outside = np.isin(mirrored["label"], (0, 1, 2)) & (mirrored["tube"][:, 0] == 1.0)
    mirrored = mirrored[(mirrored["reflections"] == 1) & first & outside]
    height = mirrored["start"][:, 1] / radius_mm
    flank = mirrored[(height > -0.75) & (height < -0.45)]  # where they meet, and 3 voxels beside it
    assert len(flank) > 8
    cosine = -flank["start"][:, 1] / np.hypot(flank["start"][:, 0], flank["start"][:, 1])
    growth = flank["tube"][:, 1] * radius_mm * cosine / 2.0
    assert (growth > 0.3).mean() > 0.9 and 0.6 < np.median(growth) < 1.5
    assert np.median(flank["tube"][:, 3]) < 0.02  # along the rib it is straight


def test_a_gap_of_a_few_voxels_keeps_its_width():
    """Smoothing across a gap must not displace its sides."""
    for voxels in (3, 5, 7, 9):
        gap = block(lambda x, y, z, half=0.5 * voxels: np.abs(y) < half, spacing_mm=1.0)
        tree = simulator(gap, replace(FAST, speed_of_sound_m_s=1540.0)).trace(
            PROBES["linear"], rigid(np.eye(3), [0, -20, 0])
        )
        straight = tree.hits[tree.hits["reflections"] == 0]
        for behind, place in ((1, 20 - voxels / 2), (0, 20 + voxels / 2)):
            depth = straight["depth_mm"][straight["label_behind"] == behind]
            np.testing.assert_allclose(depth, place, atol=0.15)


def test_tissues_of_one_speed_and_impedance_have_no_interface():
    calm, lossy = Tissue("calm", 1540, 1.6, 0.2), Tissue("lossy", 1540, 1.6, 1.2)
    slab = block(lambda x, y, z: np.where(np.abs(y) < 4.5, 2, 1))
    tree = simulator(slab, calm, lossy, coupling=Tissue("calm", 1540, 1.6, 0.2)).trace(
        PROBES["linear"], rigid(np.eye(3), [0, -20, 0])
    )
    assert len(tree.hits) == 0
    path = tree.segments[tree.segment_line == 0]
    last = path[-1]
    end_db = 20 * np.log10(last["attenuation"]) - (50.0 - last["depth_mm"]) * last["decay_per_mm"] * 20 / np.log(10)
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
    """Plates that reflect nearly all energy, and a threshold at which every reflection is followed."""
    plates = block(lambda x, y, z: np.floor(y / 1.0).astype(int) % 2, half_mm=(6, 30, 6))
    hard = Tissue("hard", 1540.0, 6.0, 0.0)
    sim = simulator(plates, hard, reflection_threshold=1e-9, intensity_threshold=1e-9, max_ray_depth=16)
    with pytest.warns(TreeOverflowWarning, match="have more than 256 ray segments"):
        sim.simulate(LinearProbe(4, 60, scan_lines=5), rigid(np.eye(3), [0, -30, 0]))


def test_a_line_that_leaves_the_volume_continues_in_the_coupling_medium():
    small = block(lambda x, y, z: np.ones_like(x), half_mm=(10, 10, 10))
    tree = simulator(small, FLUID).trace(PROBES["linear"], rigid(np.eye(3), [0, -40, 0]))
    path = tree.segments[tree.segment_line == 24]
    # and 11 samples and a voxel farther: echoes of the last sample of the image come from half a pulse behind it
    behind = 11 * 1.54 / (2 * 5.0) / 4 + 1.0
    assert path["length_mm"].sum() == pytest.approx(50.0 + behind, abs=0.01)
