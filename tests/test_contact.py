"""Contact of the probe's face with the patient: which lines are dark, and how dark."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from SlicerUSSim.Logic import (
    ConvexProbe,
    LinearProbe,
    PhasedProbe,
    SimulationSettings,
    TissueTable,
    UltrasoundSimulator,
)
from SlicerUSSim.Logic.imaging.contact import about_contact, line_contact, touching_share
from tests.conftest import FLUID, SPECKLE, block, rigid

TABLE = TissueTable({0: FLUID, 1: SPECKLE})
LINEAR = LinearProbe(40, 30, scan_lines=96, focus_mm=15, aperture_mm=8.0)
CONVEX = ConvexProbe(40.0, 60.0, depth_mm=40.0, scan_lines=97, aperture_mm=10.0)
PHASED = PhasedProbe(60.0, 40.0, scan_lines=48, aperture_mm=16.0)
AT_TOP = rigid(np.eye(3), [0, -20, 0])
SIZE_MM = (60, 40, 20)


def slab(until_mm: float = np.inf, from_mm: float = -20.0):
    """Speckle from a surface across the beam on, up to a place along the face."""
    return block(lambda x, y, z: ((x < until_mm) & (y >= from_mm)).astype(np.uint8), SIZE_MM, 0.5)


def signal(probe, labels, gap_mm, **changes) -> np.ndarray:
    """(scan lines, samples) baseband signal."""
    settings = SimulationSettings(contact_gap_mm=gap_mm, side_lobes=False, **changes)
    simulator = UltrasoundSimulator(labels, TABLE, settings)
    frame = simulator.device_frame(probe, AT_TOP)
    for stage in [*simulator.impulse_stages, *simulator.linear_stages]:
        stage.run(frame)
    return frame.download("iq")


@pytest.mark.parametrize("edge", [-8.75, 0.25, 10.75])
@pytest.mark.parametrize("probe", [LINEAR, PHASED, CONVEX], ids=lambda probe: probe.kind)
def test_the_share_of_an_aperture_over_the_patient_counts_twice(probe, edge):
    """A surface that ends: of every aperture the part before the end touches, when sending and when receiving."""
    found = line_contact(slab(edge), probe, AT_TOP, 12.0)  # wider than what a curved face is away from a plane
    position = probe.line_positions()
    if probe is CONVEX:  # along the normals, from the arc to the plane
        angles = position[:, None] + probe.aperture_mm / probe.radius_mm * (np.arange(4000) / 3999.0 - 0.5)
        rise = probe.radius_mm * (1.0 - np.cos(angles))
        reaches = probe.radius_mm * np.sin(angles) + rise * np.tan(angles)
        lowest = probe.radius_mm * np.sin(angles) + 12.0 * np.sin(angles)
        expected = (np.where(angles > 0, reaches, np.minimum(reaches, lowest)) < edge).mean(axis=1) ** 2
    else:
        middle = position if probe is LINEAR else 0.0 * position
        expected = np.clip((edge - middle) / probe.aperture_mm + 0.5, 0.0, 1.0) ** 2
    np.testing.assert_allclose(found, expected, atol=0.06)
    assert found.dtype == np.float32 and found.shape == (probe.scan_lines,)


def test_gel_fills_gaps_up_to_its_width():
    deep = slab(from_mm=-18.0)  # 2 mm below the face
    assert (line_contact(deep, LINEAR, AT_TOP, 1.5) == 0.0).all()
    np.testing.assert_allclose(line_contact(deep, LINEAR, AT_TOP, 2.5)[8:-8], 1.0, atol=1e-6)
    lifted = AT_TOP @ rigid(np.eye(3), [0, -10.0, 0])
    assert (line_contact(slab(), CONVEX, lifted, 3.0) == 0.0).all()


def test_a_curved_face_touches_a_plane_as_far_as_the_gel_reaches():
    probe = ConvexProbe(40.0, 60.0, depth_mm=40.0, scan_lines=241, aperture_mm=1.0)
    touching = probe.line_positions()[line_contact(slab(), probe, AT_TOP, 2.0) > 0.25]
    # R (1 - cos a) / cos a = gap
    assert np.rad2deg(touching.max()) == pytest.approx(np.rad2deg(np.arccos(40.0 / 42.0)), abs=2.0)
    assert np.rad2deg(-touching.min()) == pytest.approx(np.rad2deg(touching.max()), abs=0.6)


def test_a_face_off_the_patient_is_reported_with_the_share_that_touches():
    """The image was black, without a word."""
    deep = slab(from_mm=-17.0)  # 3 mm below the face
    (line,) = about_contact(deep, LINEAR, [AT_TOP], 2.0)
    assert line == (
        "0% of the probe's face touches the patient (contact gap: 2 mm): the image is black; move the probe "
        "onto the patient"
    )
    assert about_contact(deep, LINEAR, [AT_TOP], 3.5) == () and about_contact(deep, LINEAR, [AT_TOP], None) == ()
    assert about_contact(slab(until_mm=0.25), PHASED, [AT_TOP], 2.0) == ()  # half of it
    corner = slab(until_mm=-4.0)  # a quarter
    assert touching_share(corner, PHASED, AT_TOP, 2.0) == pytest.approx(0.25, abs=0.03)
    assert about_contact(corner, PHASED, [AT_TOP], 2.0) == ()


def test_a_face_far_from_a_patient_in_the_coupling_medium_is_reported():
    """A probe 45 mm off an opened head gave the image of a water bath, without a word."""
    near, far = slab(from_mm=5.0), slab(from_mm=15.0)  # 25 and 35 mm below the face
    assert about_contact(near, LINEAR, [AT_TOP], None) == ()
    (line,) = about_contact(far, LINEAR, [AT_TOP], None)
    assert line.startswith("the probe's face is more than 30 mm from the patient, across the coupling medium")
    aside = AT_TOP @ rigid(np.eye(3), [500.0, 0.0, 0.0])
    (line,) = about_contact(near, LINEAR, [AT_TOP, aside, AT_TOP], None)
    assert line.startswith("in 1 of 3 images the probe's face is more than 30 mm")


@pytest.mark.parametrize("probe", [LINEAR, PHASED, CONVEX], ids=lambda probe: probe.kind)
@pytest.mark.parametrize("off_mm", [0.0, 90.0])
def test_no_share_of_a_face_touches_where_all_lines_are_dark(probe, off_mm):
    pose = AT_TOP @ rigid(np.eye(3), [off_mm, 0.0, 0.0])
    dark = not line_contact(slab(-25.0), probe, pose, 2.0).any()
    assert (
        dark
        == (touching_share(slab(-25.0), probe, pose, 2.0) == 0.0)
        == any("the image is black" in line for line in about_contact(slab(-25.0), probe, [pose], 2.0))
    )
    assert dark or off_mm == 0.0


def test_images_of_a_sweep_without_contact_are_counted():
    lifted = AT_TOP @ rigid(np.eye(3), [0.0, -10.0, 0.0])
    assert about_contact(slab(), LINEAR, [AT_TOP, AT_TOP], 2.0) == ()
    (black,) = about_contact(slab(), LINEAR, [AT_TOP, lifted, lifted], 2.0)
    assert black.startswith("in 2 of 3 images 0% of the probe's face touches the patient (")
    assert "): they are black" in black


@pytest.mark.parametrize(
    "probe", [LINEAR, replace(LINEAR, harmonic=True, frequency_mhz=2.5)], ids=["pulse", "harmonic"]
)
def test_lines_without_contact_are_dark_and_the_others_as_before(probe):
    labels = slab()
    plain, full = signal(probe, labels, None), signal(probe, labels, 2.0)
    np.testing.assert_array_equal(full[8:-8], plain[8:-8])
    half = slab(until_mm=0.25)
    immersed, touching = signal(probe, half, None), signal(probe, half, 2.0)
    contact = line_contact(half, probe, AT_TOP, 2.0)
    np.testing.assert_allclose(touching, immersed * contact[:, None], rtol=1e-4, atol=1e-6 * np.abs(immersed).max())
    assert (np.abs(touching[60:]) == 0.0).all() and np.abs(immersed[:30]).max() > 0.0


def test_a_phased_array_half_in_the_air_has_a_quarter_of_its_amplitude():
    found = line_contact(slab(until_mm=0.25), PHASED, AT_TOP, 2.0)
    np.testing.assert_allclose(20.0 * np.log10(found), -12.04, atol=0.7)
