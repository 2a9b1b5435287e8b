"""Probes: scan lines follow the geometry, the beam has the width of diffraction theory, parameters are checked."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

from SlicerUSSim.Logic import (
    ConvexProbe,
    LinearProbe,
    PhasedProbe,
    Preset,
    SimulationError,
    SimulationSettings,
    UltrasoundSimulator,
)
from SlicerUSSim.Logic.probe.arrays import PROBES, Probe, probe_from_dict
from SlicerUSSim.Logic.probe.beam import FWHM_PER_SIGMA
from tests.conftest import SPECKLE
from validation.measurement import correlation, depth_window
from validation.phantoms import uniform_speckle

PROBES_PAGE = Path(__file__).parents[1] / "docs" / "probes.md"
lines = st.integers(2, 300)
each_preset = pytest.mark.parametrize("name", PROBES)


@pytest.mark.parametrize(
    "probe", [*PROBES.values(), LinearProbe(38, 40, trapezoid_deg=15.0), LinearProbe(38, 40, steering_deg=-20.0)]
)
def test_lines_leave_points_of_the_face(probe):
    positions = probe.line_positions()
    leave = probe.origins_mm() + probe.line_starts_mm(positions)[:, None] * probe.directions()
    np.testing.assert_allclose(probe.face_points_mm(leave[:, 0]), leave, atol=1e-9)


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
    assert 25.0 < depth[np.argmin(elevational)] < 50.5  # a lens of few Fresnel zones is narrowest before its focus
    # Two-way: a product of two equal Gaussians, each of FWHM 1.21 wavelength x f-number.
    wavelength = 1.54 / 5
    expected = 1.21 * wavelength * 50 / 15 / 2.3548 / np.sqrt(2)
    assert np.interp(50, depth, lateral) == pytest.approx(expected, rel=0.01)
    assert lateral[-1] > lateral[250] and elevational[0] > elevational[250]


def test_a_focus_is_at_least_as_wide_as_that_of_half_its_aperture():
    close, least = (PhasedProbe(75, 90, focus_mm=focus, aperture_mm=20.0) for focus in (0.1, 10.0))
    assert close.transmit_zones()[0][0] == least.transmit_zones()[0][0]
    wavelength = 1.54 / 5
    assert least.transmit_zones()[0][0] == pytest.approx(1.21 * wavelength * 0.5 / 2.3548, rel=1e-3)


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
        ({"kind": "linear", "width_mm": 40, "depth_mm": 50, "scan_lines": 10.5}, "expected a whole number"),
        ([1, 2], "is a list"),
    ],
)  # fmt: skip
def test_wrong_probe_files_say_what_is_wrong(values, message):
    with pytest.raises(SimulationError, match=message):
        probe_from_dict(values, "probe.json")


# ---- presets ---------------------------------------------------------------------------------------------------------


def footprint_mm(probe: Probe) -> float:
    """Lateral size of the face: the width of the scan lines on it, or the aperture of a phased array."""
    return float(np.ptp(probe.origins_mm()[:, 0])) or probe.aperture_mm


def fwhm_mm(probe: Probe, depth_mm) -> np.ndarray:
    """Two-way lateral resolution."""
    return FWHM_PER_SIGMA * probe.beam_sigma_mm(depth_mm)[0]


@each_preset
def test_a_preset_is_a_probe_that_could_be_built(name):
    probe = PROBES[name]
    assert probe.aperture_mm <= footprint_mm(probe) + 1e-9
    assert probe.elevation_aperture_mm <= max(footprint_mm(probe), 14.0)
    if isinstance(probe, ConvexProbe):  # elements at the edge of the aperture still look along the line
        assert np.degrees(np.arcsin(0.5 * probe.aperture_mm / probe.radius_mm)) < 25.0
    for focus, size in ((probe.focus_mm, probe.aperture_mm), (probe.elevation_focus_mm, probe.elevation_aperture_mm)):
        assert 0.2 * probe.depth_mm < focus < 0.8 * probe.depth_mm
        assert 1.5 < focus / size < 10.0
    low, high = (probe.frequency_mhz * (1.0 + side * probe.fractional_bandwidth / 2.0) for side in (-1, 1))
    assert 1.2 < low < high < 20.0


@each_preset
def test_a_preset_has_lines_finer_than_its_beam_and_penetrates_its_depth(name):
    probe = PROBES[name]
    depth = np.linspace(0.0, probe.depth_mm, 101)
    assert (probe.line_distance_mm(depth) < 0.7 * fwhm_mm(probe, depth)).all()
    assert 2.0 * 0.5 * probe.frequency_mhz * 0.1 * probe.depth_mm < 65.0  # dB, of tissue with 0.5 dB/(cm MHz)
    # Resolution of 0.5 to 3 % of the depth: neither an image of a few blobs nor one finer than its own pixels
    assert 0.003 < fwhm_mm(probe, probe.focus_mm) / probe.depth_mm < 0.03


@pytest.mark.slow
@pytest.mark.parametrize("name", ["phased", "linear_15", "abdominal"])
def test_a_preset_resolves_at_its_focus_what_its_aperture_and_band_say(name):
    """The speckle of the simulated image has the size of the beam: neighbours correlate as exp(-d^2 / 4 sigma^2)."""
    probe = PROBES[name]
    phantom = uniform_speckle(SPECKLE)
    settings = [SimulationSettings(seed=seed) for seed in range(6)]
    simulators = [UltrasoundSimulator(phantom.labels, phantom.tissues, chosen) for chosen in settings]
    frames = [found.simulate(probe, phantom.probe_to_ras) for found in simulators]
    half = 0.03 * probe.depth_mm
    signals = [depth_window(frame, probe.focus_mm, half) for frame in frames]
    deep = probe.focus_mm + np.linspace(-half, half, 61)  # where the beam is not equally wide
    lateral, apart = probe.beam_sigma_mm(deep)[0], probe.line_distance_mm(deep)
    lines = max(1, round(1.2 * float(lateral[30] / apart[30])))
    samples = round(1.2 * probe.axial_sigma_mm / frames[0].sample_interval_mm)
    across = np.mean([correlation(signal[:-lines], signal[lines:]) for signal in signals])
    along = np.mean([correlation(signal[:, :-samples], signal[:, samples:]) for signal in signals])
    assert across == pytest.approx(np.exp(-((lines * apart / lateral) ** 2) / 4.0).mean(), abs=0.05)
    distance = samples * frames[0].sample_interval_mm / probe.axial_sigma_mm
    assert along == pytest.approx(np.exp(-(distance**2) / 4.0), abs=0.05)


def test_the_burr_hole_probe_fits_through_a_burr_hole():
    probe = PROBES["burr_hole"]
    assert np.hypot(footprint_mm(probe), probe.elevation_aperture_mm) < 14.0  # mm, of a usual perforator


def test_a_matrix_array_is_focused_elevationally_as_laterally():
    probe = PROBES["matrix"]
    for depth in (probe.depth_mm, 90.0):
        seen = Preset(probe).changed("probe", depth_mm=depth).probe
        assert seen.elevation_waist() == seen.transmit_zones()[0]


def row_of(name: str) -> str:
    """The numbers of a preset as in the table of docs/probes.md."""
    probe = PROBES[name]
    low, high = (probe.frequency_mhz * (1.0 + side * probe.fractional_bandwidth / 2.0) for side in (-1, 1))
    face = f"{footprint_mm(probe):.3g}"
    if isinstance(probe, ConvexProbe):
        face += f", R {probe.radius_mm:g}"
    lens, height = probe.elevation_focus_mm, probe.elevation_aperture_mm
    columns = (
        f"`{name}`", probe.kind, f"{probe.frequency_mhz:g} ({low:.1f} to {high:.1f})", face, f"{probe.aperture_mm:g}",
        f"{probe.focus_mm:g}, f/{probe.focus_mm / probe.aperture_mm:.1f}",
        f"{height:g}", f"{lens:g}, f/{lens / height:.1f}",
        f"{probe.depth_mm:g}",
    )  # fmt: skip
    return f"| {' | '.join(columns)} |"


def test_the_page_of_the_presets_has_their_numbers_and_sources():
    rows = re.findall(r"^\| `.*$", PROBES_PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    numbers = [row for row in rows if row.count("|") > 3]
    assert numbers == [row_of(name) for name in PROBES]
    assert [re.findall("`(.*?)`", row)[0] for row in rows if row not in numbers] == list(PROBES)


@pytest.mark.parametrize("angle, width", [(0.0, 1.24), (20.0, 1.31), (36.0, 1.52)])
def test_a_steered_aperture_is_foreshortened(angle, width):
    """Widths by sums over the aperture, in mm at the focus."""
    found = FWHM_PER_SIGMA * PROBES["phased"].beam_sigma_mm(54.0, float(np.cos(np.radians(angle))))[0]
    assert found == pytest.approx(width, rel=0.06)


@pytest.mark.parametrize("directivity, level_db", [("soft", -6.9), ("rigid", -2.8)])
def test_elements_send_and_receive_less_along_steered_lines(directivity, level_db):
    """The echo of a point at 38 degrees, by sums over elements of half a wavelength; the beam is wider by 1 / cos."""
    probe, steered = replace(PROBES["phased"], directivity=directivity), np.radians(38.0)
    peak = float(probe.steered_level(steered)) * np.sqrt(np.cos(steered))
    assert 20.0 * np.log10(peak) == pytest.approx(level_db, abs=0.2)
    assert replace(probe, directivity="none").line_levels() is None is PROBES["convex"].line_levels()


@pytest.mark.parametrize(
    "name, thickness", [("linear", (1.04, 0.54, 0.24, 0.46)), ("phased", (1.35, 0.62, 0.68, 1.06))]
)
def test_a_slice_is_as_thick_as_its_lens_makes_it(name, thickness):
    """RMS by power at F/5, F/2, F and 1.5 F, in mm: sums over points of the lens, all frequencies of the pulse."""
    probe, found = PROBES[name], []
    lens = probe.lens()
    across = np.linspace(0.0, float(lens.main_mm.max()), lens.main.shape[1])
    for part in (0.2, 0.5, 1.0, 1.5):
        row = part * probe.elevation_focus_mm / probe.displayed_mm * (len(lens.main) - 1)
        near, far = lens.main[int(row) : int(row) + 2, :, 0].astype(float)
        power = (near + row % 1.0 * (far - near)) ** 2
        power[0] *= 0.5
        found.append(float(np.sqrt((power * across**2).sum() / power.sum())))
    assert found == pytest.approx(thickness, rel=0.12)
