"""Transmission: focal zones, compounded angles, steered lines, harmonic imaging, the phase across the beam."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from SlicerUSSim.Logic import (
    ConvexProbe,
    DisplaySettings,
    LinearProbe,
    PhasedProbe,
    Preset,
    SimulationError,
    SimulationSettings,
    TissueTable,
    UltrasoundSimulator,
)
from SlicerUSSim.Logic.imaging.diffraction import lobes_of
from SlicerUSSim.Logic.opencl.layout import CONSTANTS
from SlicerUSSim.Logic.probe.arrays import PROBES, probe_from_dict
from SlicerUSSim.Logic.probe.beam import LEAKED, MOST_ZONES
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from tests.conftest import SPECKLE, block, rigid, simulator
from validation.measurement import correlation, depth_window, level_db
from validation.wave import speckle_half_length

LINEAR = LinearProbe(12, 30, scan_lines=24, frequency_mhz=5)
MODES = {
    "zones": replace(LINEAR, transmit="zones", focal_zones=3),
    "angles": PhasedProbe(35, 30, scan_lines=24, transmit="angles", transmit_angles=7),
    "one wave": replace(LINEAR, transmit="angles", transmit_angles=1),
    "trapezoid": replace(LINEAR, trapezoid_deg=15.0),
    "wide trapezoid": replace(LINEAR, trapezoid_deg=45.0),
    "steered": replace(LINEAR, steering_deg=-20.0),
    "harmonic": replace(LINEAR, harmonic=True, frequency_mhz=2.5),
    "harmonic, steered, zones": replace(
        LINEAR, harmonic=True, frequency_mhz=2.5, steering_deg=12.0, transmit="zones", focal_zones=2
    ),
}


def test_the_kernels_have_room_for_all_zones():
    assert CONSTANTS["MAX_ZONES"] == MOST_ZONES
    assert len(replace(LINEAR, transmit="zones", focal_zones=MOST_ZONES).transmit_zones()) == MOST_ZONES


@pytest.mark.parametrize("mode", MODES)
def test_every_mode_survives_json_and_set(mode):
    probe = MODES[mode]
    assert probe_from_dict(probe.to_dict()) == probe
    assert Preset(probe=PROBES["linear"]).changed("probe", **probe.to_dict()).probe == probe


def test_the_defaults_are_one_focus_and_lines_at_right_angles_to_the_face():
    for probe in PROBES.values():
        assert (probe.transmit, probe.harmonic, probe.steering_rad) == ("focus", False, 0.0)
        assert not probe.line_starts_mm(probe.line_positions()).any() and probe.displayed_mm == probe.depth_mm


def test_lines_are_steered_or_fan_out_but_not_both():
    with pytest.raises(SimulationError, match="steering_deg is 10, trapezoid_deg 15, expected one of them to be 0"):
        LinearProbe(38, 40, steering_deg=10.0, trapezoid_deg=15.0)
    with pytest.raises(SimulationError, match=r"trapezoid_deg is 0\.1, expected 0 or at least 1"):
        LinearProbe(38, 40, trapezoid_deg=0.1)
    with pytest.raises(SimulationError, match=r"steering_deg is 60\.0, expected a number between -45 and 45"):
        LinearProbe(38, 40, steering_deg=60.0)
    with pytest.raises(SimulationError, match="steering_deg is not a parameter of a convex"):
        probe_from_dict(ConvexProbe(40, 60, 80).to_dict() | {"steering_deg": 5.0})


@given(st.floats(-40, 40), st.floats(1.0, 40), st.booleans())
def test_steered_lines_leave_the_face_between_its_ends(steering, opening, is_fan):
    angles = {"trapezoid_deg": opening} if is_fan else {"steering_deg": steering}
    probe = LinearProbe(38.0, 50.0, scan_lines=41, **angles)
    at = probe.line_positions()
    origin, direction = probe.line_at(at)
    face = origin + probe.line_starts_mm(at)[:, None] * direction
    assert np.abs(face[:, 1]).max() < 1e-6 and (probe.line_starts_mm(at) > -1e-6).all()
    assert np.abs(face[[0, -1], 0]) == pytest.approx([19.0, 19.0])
    expected = np.deg2rad(np.linspace(-opening, opening, 41) if is_fan else np.full(41, steering))
    np.testing.assert_allclose(np.arctan2(direction[:, 0], direction[:, 1]), expected, atol=1e-6)
    back, along = probe.line_through(*(origin + 7.0 * direction)[:, :2].T)
    np.testing.assert_allclose(back, at, atol=1e-6)
    np.testing.assert_allclose(along, 7.0, atol=1e-6)
    # Origins are on a surface across all lines, where neighbouring lines agree in phase.
    apart = np.diff(origin, axis=0)
    assert np.abs((apart * (direction[1:] + direction[:-1])).sum(axis=1)).max() < 1e-5
    bounds = probe.image_bounds_mm()
    outline = probe.outline_mm()
    assert bounds[2] == pytest.approx(0.0, abs=1e-6) and bounds[0] <= outline[:, 0].min() + 1e-6
    assert bounds[1] >= outline[:, 0].max() - 1e-6 and bounds[3] >= outline[:, 1].max() - 1e-6


def test_all_lines_of_a_wide_trapezoid_have_the_level_of_speckle():
    """Near the face those in the middle were 0.6 to 0.9 dB too bright: all had the mean distance of lines."""
    probe = LinearProbe(38, 40, scan_lines=192, trapezoid_deg=45.0, frequency_mhz=9.0, elevation_aperture_mm=5.0)
    medium = block(lambda x, y, z: np.ones_like(x), half_mm=(80, 60, 20), spacing_mm=2.0)
    frames = [
        simulator(medium, SPECKLE, coupling=SPECKLE, seed=seed).simulate(probe, rigid(np.eye(3), [0, -50, 0]))
        for seed in range(12)
    ]
    starts = probe.line_starts_mm(probe.line_positions())
    dz = frames[0].sample_interval_mm
    spans = [slice(int((start + 2.0) / dz), int((start + 8.0) / dz)) for start in starts]
    power = [np.mean([np.mean(np.abs(frame.iq[n, span]) ** 2) for frame in frames]) for n, span in enumerate(spans)]
    steered = probe.steered_level(np.arcsin(probe.directions()[:, 0]))
    levels = 10.0 * np.log10(np.reshape(power / steered**2, (6, 32)).mean(axis=1) / SPECKLE.scatterer_variance)
    np.testing.assert_allclose(levels, 0.0, atol=0.25)


@pytest.mark.parametrize("angles", [{"steering_deg": 20.0}, {"trapezoid_deg": 20.0}])
def test_the_imaged_field_is_where_its_outline_says(angles):
    probe = LinearProbe(20.0, 25.0, scan_lines=80, **angles)
    solid = block(lambda x, y, z: np.ones_like(x), half_mm=(30, 30, 6))
    frame = simulator(solid, SPECKLE, coupling=SPECKLE).simulate(
        probe, rigid(np.eye(3), [0, -20, 0]), DisplaySettings(dynamic_range_db=200.0)
    )
    wrong = (frame.image > 0) != ImageGrid.for_probe(probe, None).field(probe)
    assert wrong.mean() < 0.01


def test_zones_lie_within_twice_the_focal_depth_and_the_narrowest_counts():
    probe = LinearProbe(38, 60, focus_mm=30.0, transmit="zones", focal_zones=3, receive_f_number=2.0)
    assert [focus for _, focus, _ in probe.transmit_zones()] == [10.0, 30.0, 50.0]
    at_foci = probe.lateral_sigmas_mm(np.array([10.0, 30.0, 50.0]))[0] * 2.3548
    np.testing.assert_allclose(at_foci, 1.21 * probe.wavelength_mm * np.array([2.0, 2.5, 50 / 12]), rtol=1e-3)
    alone = [replace(probe, transmit="focus", focus_mm=f).lateral_sigmas_mm(20.0)[0] for f in (30.0, 50.0)]
    assert probe.lateral_sigmas_mm(20.0)[0] <= min(alone)


def test_the_sum_over_angles_has_the_width_of_the_array_factor():
    """The magnitude of a sum of phasors, against the Gaussian of the same width at half its height."""
    probe = LinearProbe(38, 60, transmit="angles", transmit_angles=9, largest_angle_deg=12.0)
    angle, x = np.deg2rad(np.linspace(-12, 12, 9)), np.linspace(0.0, 1.2, 4001)
    factor = np.abs(np.exp(2j * np.pi / probe.wavelength_mm * np.outer(x, np.sin(angle))).mean(axis=1))
    half = x[np.argmax(factor < 0.5)]
    assert 2.3548 * probe.lateral_sigmas_mm(20.0)[0] == pytest.approx(2.0 * half, rel=0.02)
    # Deeper than the face is seen under these angles, the aperture is the whole face.
    assert probe.lateral_sigmas_mm(150.0)[0] * 2.3548 == pytest.approx(1.21 * probe.wavelength_mm * 150 / 38, rel=1e-3)


def test_the_harmonic_grows_as_the_logarithm_of_the_quasi_linear_solution():
    """Beside a hundredth of its power at the focus, which leaves the face already."""
    probe = LinearProbe(
        30, 60, frequency_mhz=2.5, harmonic=True, focus_mm=30.0, elevation_focus_mm=30.0, aperture_mm=10.0,
        elevation_aperture_mm=10.0,
    )  # fmt: skip
    depth = np.array([2.0, 10.0, 25.0, 30.0, 40.0, 60.0])
    length = 2 * np.pi * (1.21 * 1.54 / 2.5 * 3.0 / 2.3548) ** 2 / (1.54 / 2.5)
    b = (np.append([0.0, 30.0], depth) - 30.0) / length
    grown = np.abs(np.log((1 + 1j * b[1:]) / (1 + 1j * b[0])))
    expected = np.sqrt(((grown[1:] / grown[0]) ** 2 + 0.01) / 1.01)
    np.testing.assert_allclose(probe.harmonic_level(depth), expected, rtol=1e-3)


@pytest.mark.parametrize(("name", "mhz"), [("abdominal", 1.75), ("linear", 4.5), ("phased", 2.5), ("cardiac", 1.4)])
def test_the_level_of_the_harmonic_has_no_steps_and_no_black_face(name, mhz):
    """Between focal zones it had steps of 2 to 4 dB, and 5 mm deep it was 29 dB down."""
    for transmit in ("focus", "zones", "angles"):
        probe = replace(PROBES[name], frequency_mhz=mhz, harmonic=True, transmit=transmit)
        depth = np.arange(0.0, probe.depth_mm, 0.05)
        level = 20 * np.log10(probe.harmonic_level(depth))
        assert np.abs(np.diff(level)).max() < 0.1, transmit
        assert -21.0 < level[0] < -19.0 and level.argmax() * 0.05 > 0.2 * probe.focus_mm
        assert probe.harmonic_level(np.array([probe.focus_mm]))[0] == pytest.approx(1.0, abs=1e-3)


def test_speckle_of_the_harmonic_is_even_where_zones_meet():
    """The mean level of every millimetre of an image, without attenuation, against that of a smooth curve."""
    probe = LinearProbe(
        20.0, 40.0, scan_lines=81, frequency_mhz=3.0, harmonic=True, transmit="zones", focal_zones=3, focus_mm=20.0
    )
    tissue = replace(SPECKLE, attenuation_db_cm_mhz=0.0)
    frames = [
        UltrasoundSimulator(
            SOLID, TissueTable({0: tissue, 1: tissue}), SimulationSettings(ring_down=False, seed=seed)
        ).simulate(probe, rigid(np.eye(3), [0, -20, 0]))
        for seed in range(6)
    ]
    borders = np.flatnonzero(np.diff(probe.zone_at(np.arange(1.0, 39.0, 0.05)))) * 0.05 + 1.0
    assert len(borders) == 2
    for border in borders:
        before, behind = (
            level_db(np.stack([depth_window(frame, border + side, 0.75) for frame in frames])) for side in (-0.75, 0.75)
        )
        growth = np.diff(20 * np.log10(probe.harmonic_level(np.array([border - 0.75, border + 0.75]))))[0]
        assert behind - before == pytest.approx(growth, abs=0.8) and abs(growth) < 1.5


def test_the_second_harmonic_must_lie_in_the_band_of_the_array():
    message = (
        r"ConvexProbe: the second harmonic of frequency_mhz 3\.5 is 7 MHz, expected within band_mhz, 2\.6 to 4\.4; "
        r"set frequency_mhz to between 1\.3 and 2\.2"
    )
    with pytest.raises(SimulationError, match=message):
        replace(PROBES["abdominal"], harmonic=True)
    with pytest.raises(SimulationError, match=message):
        Preset(PROBES["abdominal"]).changed("probe", harmonic=True)
    with pytest.raises(SimulationError, match="band_mhz is 5 to 3, expected the lower frequency first"):
        LinearProbe(38, 40, band_mhz=(5.0, 3.0))
    for name, probe in PROBES.items():
        low, high = probe.band_mhz or (0.0, 0.0)
        width = 0.5 * probe.fractional_bandwidth * probe.frequency_mhz
        assert (low, high) == pytest.approx((probe.frequency_mhz - width, probe.frequency_mhz + width), abs=0.1), name
        second = replace(probe, harmonic=True, frequency_mhz=0.5 * probe.frequency_mhz)
        assert second.received_mhz == probe.frequency_mhz


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"focal_zones": 4}, "focal_zones is 4 with transmit 'focus', expected transmit 'zones', or 3, the default"),
        (
            {"transmit": "zones", "transmit_angles": 9},
            "transmit_angles is 9 with transmit 'zones', expected transmit 'ang",
        ),
        ({"largest_angle_deg": 12.5}, "largest_angle_deg is 12.5 with transmit 'focus', expected transmit 'angles'"),
    ],
)
def test_parameters_of_another_kind_of_transmission_are_refused(values, message):
    """They were ignored."""
    with pytest.raises(SimulationError, match=message):
        replace(PROBES["linear"], **values)
    with pytest.raises(SimulationError, match=message):
        probe_from_dict(PROBES["linear"].to_dict() | values)
    with pytest.raises(SimulationError, match=message):
        Preset(PROBES["linear"]).changed("probe", **values)


def test_another_kind_of_transmission_takes_its_parameters_with_it():
    zones = Preset(PROBES["linear"]).changed("probe", transmit="zones").changed("probe", focal_zones=5)
    assert zones.probe.focal_zones == 5
    assert zones.changed("probe", transmit="focus").probe == PROBES["linear"]


def test_a_parameter_of_another_kind_of_probe_is_named():
    with pytest.raises(
        SimulationError, match=r"ConvexProbe has no steering_deg, expected one of frequency_mhz.*radius_mm"
    ):
        ConvexProbe(radius_mm=40, field_of_view_deg=60, depth_mm=100, steering_deg=5.0)  # type: ignore[call-arg]
    with pytest.raises(SimulationError, match="PhasedProbe has no width_mm"):
        replace(PROBES["phased"], width_mm=5.0)  # type: ignore[call-arg]


def test_the_harmonic_has_twice_the_frequency_and_weaker_side_lobes():
    pulse = replace(PROBES["abdominal"], frequency_mhz=2.0, clutter_db=None)
    second = replace(pulse, harmonic=True)
    assert second.cycles_per_mm == 2.0 * pulse.cycles_per_mm
    assert second.axial_sigma_mm == pytest.approx(pulse.axial_sigma_mm / np.sqrt(2.0))
    assert (second.received_mhz, second.received_bandwidth) == (4.0, pytest.approx(0.5 / np.sqrt(2.0)))
    at_focus = round(0.6 * (CONSTANTS["LOBE_DEPTHS"] - 1))
    powers = [(lobes_of(probe)[at_focus, 3:] ** 2).sum() for probe in (second, pulse)]
    assert 10 * np.log10(powers[0] / powers[1]) < -9.0


SOLID = block(lambda x, y, z: np.ones_like(x), half_mm=(15, 25, 6))


@pytest.mark.parametrize("lines", [41, 201])
def test_a_curved_phase_shortens_the_correlation_of_speckle_at_its_level(lines):
    probe = LinearProbe(20.0, 40.0, scan_lines=lines, focus_mm=30.0, elevation_focus_mm=25.0)
    pose, lag, found = rigid(np.eye(3), [0, -20, 0]), lines // 40, {}
    for curved in (False, True):
        settings = SimulationSettings(wavefront_curvature=curved)
        sim = UltrasoundSimulator(SOLID, simulator(SOLID, SPECKLE, coupling=SPECKLE).medium.tissues, settings)
        windows = [depth_window(sim.simulate(probe, pose), 12.0, 4.0)]
        found[curved] = correlation(windows[0][:-lag], windows[0][lag:]), level_db(windows[0])
    apart = 20.0 / (lines - 1) * lag
    if lines == 201:
        for curved, sigma in ((False, probe.beam_sigma_mm(12.0)[0]), (True, probe.speckle_sigma_mm(12.0))):
            assert found[curved][0] == pytest.approx(float(np.exp(-(apart**2) / (4 * sigma**2))), abs=0.05)
    assert found[True][0] < found[False][0] - 0.05
    assert found[True][1] == pytest.approx(found[False][1], abs=0.5)


@pytest.mark.parametrize("depth", [12.0, 38.0])
def test_speckle_changes_across_the_image_plane_as_that_of_waves(depth):
    """The half length of waves; the beam without its curved phase has a correlation of 0.9 and 0.8 there."""
    probe = LinearProbe(20.0, 44.0, scan_lines=81, focus_mm=25.0, elevation_focus_mm=25.0)
    lens = probe.elevation_aperture_mm, probe.elevation_focus_mm
    half = speckle_half_length(
        depth, frequency_mhz=5.0, fractional_bandwidth=0.5, transmit_mm=lens, receive_mm=lens
    )  # fmt: skip
    poses = [rigid(np.eye(3), [0, -22, z]) for z in (-0.5 * half, 0.5 * half)]
    tissues = simulator(SOLID, SPECKLE, coupling=SPECKLE).medium.tissues
    found = []
    for seed in range(4):
        sim = UltrasoundSimulator(SOLID, tissues, SimulationSettings(seed=seed))
        found.append(correlation(*(depth_window(sim.simulate(probe, pose), depth, 3.0) for pose in poses)))
    assert np.mean(found) == pytest.approx(0.5, abs=0.08)


@pytest.mark.parametrize("changes", [{}, {"elevation_aperture_mm": 12.0}, {"frequency_mhz": 2.0}])
def test_the_height_of_speckle_is_that_of_waves(changes):
    probe = LinearProbe(20.0, 80.0, focus_mm=25.0, elevation_focus_mm=35.0, fractional_bandwidth=0.05, **changes)
    lens, beam = (probe.elevation_aperture_mm, probe.elevation_focus_mm), probe.lens()
    step = float(beam.main_mm.max()) / (beam.main.shape[1] - 1)
    for row in (6, 14, 24):
        half = speckle_half_length(
            row / 32.0 * 80.0, frequency_mhz=probe.frequency_mhz, fractional_bandwidth=0.05,
            transmit_mm=lens, receive_mm=lens,
        )  # fmt: skip
        root, cycles = beam.main[row].astype(float).T
        one_side = root * np.exp(-2j * np.pi * cycles)
        signal = np.concatenate([one_side[:0:-1], one_side])
        correlation_ = np.abs(np.correlate(signal, signal, "full"))[len(signal) - 1 :]
        found = step * np.interp(-0.5, -correlation_ / correlation_[0], np.arange(len(signal)))
        assert found == pytest.approx(half, rel=0.1)


def _fed_by_uniform_apertures(probe, count: int = 300) -> tuple[np.ndarray, np.ndarray]:
    """(depths, power of the second harmonic) that the pulse's beam of two uniform apertures has fed, lossless.

    Quasi-linear and paraxial: at every depth the square of the pulse's field adds to a field of twice the frequency,
    which diffracts from there on. The power is a sum over pairs of depths of the correlation of what both have added,
    the product of a lateral and an elevational one.
    """
    depth = (np.arange(count) + 0.5) / count * probe.depth_mm
    sent = 1.54 / probe.frequency_mhz
    correlated = np.ones((count, count))
    for aperture, focus in (
        (probe.aperture_mm, probe.focus_mm),
        (probe.elevation_aperture_mm, probe.elevation_focus_mm),
    ):
        width, points = max(6.0 * aperture, 40.0 + 2.0 * aperture), 2048
        x, k = (np.arange(points) / points - 0.5) * width, np.fft.fftfreq(points, width / points)
        at_face = np.fft.fft((np.abs(x) < 0.5 * aperture) * np.exp(-1j * np.pi * x**2 / (sent * focus)))
        pulse = np.fft.ifft(at_face * np.exp(-1j * np.pi * sent * depth[:, None] * k**2))
        # Carried back to the face, so that parts of all depths add up there
        added = np.fft.fft(pulse**2) * np.exp(1j * np.pi * 0.5 * sent * depth[:, None] * k**2)
        correlated = correlated * (added.conj() @ added.T)
    return depth, np.cumsum(np.cumsum(correlated, axis=0), axis=1).diagonal().real


@pytest.mark.parametrize(
    ("name", "mhz"), [("abdominal", 1.75), ("cardiac", 1.5), ("phased", 2.5), ("neonatal", 4.0), ("linear", 4.5)]
)
def test_the_harmonic_grows_as_the_field_of_uniform_apertures_feeds_it(name, mhz):
    """From the face on, where it is 13 to 20 dB weaker than at the focus: docs/physics.md#harmonic-imaging."""
    probe = replace(PROBES[name], frequency_mhz=mhz, harmonic=True, band_mhz=None)
    depth, power = _fed_by_uniform_apertures(probe)
    expected = (power / np.interp(probe.focus_mm, depth, power) + LEAKED**2) / (1.0 + LEAKED**2)
    until = (depth > 2.0) & (depth < 1.1 * probe.focus_mm)
    np.testing.assert_allclose(
        20.0 * np.log10(probe.harmonic_level(depth[until])), 10.0 * np.log10(expected[until]), atol=1.0
    )
