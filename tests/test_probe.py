"""Probes: scan lines follow the geometry, the beam has the width of diffraction theory, parameters are checked."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from SlicerUSSim.Logic import ConvexProbe, LinearProbe, PhasedProbe, SimulationError
from SlicerUSSim.Logic.probe.arrays import probe_from_dict

lines = st.integers(2, 300)


@given(st.floats(5, 120), st.floats(10, 120), st.floats(10, 200), lines)
def test_convex_lines_leave_the_face_at_right_angles(radius, field, depth, count):
    probe = ConvexProbe(radius, field, depth, scan_lines=count)
    apex = np.array([0.0, -radius, 0.0])
    origins, directions = probe.origins_mm(), probe.directions()
    np.testing.assert_allclose(np.linalg.norm(origins - apex, axis=1), radius, rtol=1e-9)
    np.testing.assert_allclose((origins - apex) / radius, directions, atol=1e-9)
    opening = np.degrees(np.arccos(np.clip(directions[0] @ directions[-1], -1, 1)))
    assert opening == pytest.approx(field, abs=1e-5)


@given(st.floats(5, 100), st.floats(10, 200), lines)
def test_linear_lines_are_parallel_and_span_the_width(width, depth, count):
    probe = LinearProbe(width, depth, scan_lines=count)
    origins = probe.origins_mm()
    assert origins[-1, 0] - origins[0, 0] == pytest.approx(width)
    np.testing.assert_allclose(origins.mean(axis=0), 0, atol=1e-9)
    np.testing.assert_allclose(probe.directions(), np.tile([0.0, 1.0, 0.0], (count, 1)))


@given(st.floats(10, 120), st.floats(10, 200), lines)
def test_phased_lines_start_at_one_point(field, depth, count):
    probe = PhasedProbe(field, depth, scan_lines=count)
    np.testing.assert_allclose(probe.origins_mm(), 0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(probe.directions(), axis=1), 1)


@given(st.sampled_from(["linear", "convex", "phased"]), st.floats(20, 120), st.floats(20, 150))
def test_bounds_hold_every_scan_line_and_the_outline(kind, size, depth):
    probe = {
        "linear": lambda: LinearProbe(size, depth),
        "convex": lambda: ConvexProbe(size, 70, depth),
        "phased": lambda: PhasedProbe(size, depth),
    }[kind]()
    left, right, top, bottom = probe.image_bounds_mm()
    points = np.concatenate([probe.origins_mm(), probe.origins_mm() + depth * probe.directions(), probe.outline_mm()])
    assert (points[:, 0] >= left - 1e-6).all() and (points[:, 0] <= right + 1e-6).all()
    assert (points[:, 1] >= top - 1e-6).all() and (points[:, 1] <= bottom + 1e-6).all()


def test_beam_is_narrowest_near_its_focus_and_diffraction_limited_there():
    probe = PhasedProbe(75, 90, focus_mm=50, elevation_focus_mm=50, aperture_mm=15, receive_f_number=1.0)
    depth = np.linspace(1, 90, 500)
    lateral, elevational = probe.beam_sigma_mm(depth)
    assert depth[np.argmin(elevational)] == pytest.approx(50, abs=0.5)
    # Two-way: a product of two equal Gaussians, each of FWHM 1.21 wavelength x f-number.
    wavelength = 1.54 / 5
    expected = 1.21 * wavelength * 50 / 15 / 2.3548 / np.sqrt(2)
    assert np.interp(50, depth, lateral) == pytest.approx(expected, rel=0.01)
    assert lateral[-1] > lateral[250] and elevational[0] > elevational[250]


def test_a_focus_is_at_least_as_wide_as_that_of_half_its_aperture():
    """Formerly f/0.005 was 0.7 micrometres wide, and a frame took minutes."""
    close, least = (PhasedProbe(75, 90, focus_mm=focus, aperture_mm=20.0) for focus in (0.1, 10.0))
    assert close.transmit_waist()[0] == least.transmit_waist()[0]
    wavelength = 1.54 / 5
    assert least.transmit_waist()[0] == pytest.approx(1.21 * wavelength * 0.5 / 2.3548, rel=1e-3)


def test_pulse_has_the_bandwidth_asked_for():
    probe = PhasedProbe(75, 90, frequency_mhz=4.0, fractional_bandwidth=0.6)
    depth = np.arange(-4, 4, 0.001)
    envelope = np.exp(-0.5 * (depth / probe.axial_sigma_mm) ** 2)
    spectrum = np.abs(np.fft.fft(envelope, 2**17))
    frequency = np.fft.fftfreq(2**17, 0.001) * 1.54 / 2  # cycles/mm of depth to MHz
    half = frequency[(spectrum > spectrum.max() / 2)]
    assert half.max() - half.min() == pytest.approx(0.6 * 4.0, rel=0.02)


@given(
    st.floats(1, 300), st.integers(2, 512), st.floats(0.5, 40), st.sampled_from([LinearProbe, ConvexProbe, PhasedProbe])
)
def test_probes_survive_json(depth, count, frequency, kind):
    sizes = {LinearProbe: (40.0,), ConvexProbe: (60.0, 70.0), PhasedProbe: (75.0,)}[kind]
    probe = kind(*sizes, depth, scan_lines=count, frequency_mhz=frequency)
    assert probe_from_dict(probe.to_dict()) == probe


@pytest.mark.parametrize(
    "values, message",
    [
        ({"kind": "convex", "radius_mm": 60, "field_of_view_deg": 70, "depth_mm": 120, "frequency_mhz": -5.0},
         r"probe.json: frequency_mhz is -5.0, expected a number between 0.5 and 40"),
        ({"kind": "convex", "radius_mm": 60, "field_of_view_deg": 70}, "probe.json: lacks depth_mm"),
        ({"kind": "ring"}, "kind is 'ring', expected one of linear, convex, phased"),
        ({"kind": "linear", "width_mm": 40, "depth_mm": 50, "colour": 3}, "colour is not a parameter of a linear"),
        ({"kind": "linear", "width_mm": "wide", "depth_mm": 50}, "width_mm is 'wide'"),
        ({"kind": "linear", "width_mm": 40, "depth_mm": 50, "scan_lines": 10.5}, "expected a whole number"),
        ([1, 2], "is a list"),
    ],
)  # fmt: skip
def test_wrong_probe_files_say_what_is_wrong(values, message):
    with pytest.raises(SimulationError, match=message):
        probe_from_dict(values, "probe.json")
