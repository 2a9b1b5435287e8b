"""Side lobes and receive apodisation against diffraction, computed here from the waves of points of an aperture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from SlicerUSSim.Logic import LinearProbe, SimulationSettings, TissueTable, UltrasoundSimulator
from SlicerUSSim.Logic.imaging.diffraction import lobes_of
from SlicerUSSim.Logic.opencl.layout import CONSTANTS
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.beam import widening
from tests.conftest import SPECKLE, block, rigid
from validation.measurement import correlation, depth_window

#: The receive aperture is half of the transmit aperture, whose lobes are then not those of reception.
PROBE = LinearProbe(30, 40, scan_lines=151, focus_mm=24.0, elevation_focus_mm=24.0, receive_f_number=3.0)
X = np.linspace(0.0, 30.0, 3001)


def field(probe: Probe, aperture: float, focus: float, depth: float, apodization: float = 0.0) -> np.ndarray:
    """(X,) amplitude at distances X from the axis: the waves of 1000 points, by exact distances."""
    point = ((np.arange(1000) + 0.5) / 1000 - 0.5) * aperture
    weight = 1.0 - apodization + apodization * np.cos(np.pi * point / aperture) ** 2
    path = np.hypot(X[:, None] - point, depth)
    phase = 2.0 * np.pi / probe.wavelength_mm * (path - np.hypot(point, focus))
    return np.abs((np.exp(1j * phase) * depth * path**-1.5) @ weight)


def two_way(probe: Probe, depth: float) -> np.ndarray:
    receive = min(probe.aperture_mm, depth / probe.receive_f_number)
    sent = field(probe, probe.aperture_mm, probe.focus_mm, depth)
    return sent * field(probe, receive, depth, depth, probe.receive_apodization)


def half_width(pattern: np.ndarray) -> float:
    """Where it falls to half of its peak."""
    at = int(np.argmax(pattern < 0.5 * pattern[0]))
    return float(np.interp(-0.5 * pattern[0], -pattern[at - 1 : at + 1], X[at - 1 : at + 1]))


@pytest.mark.slow
@pytest.mark.parametrize("apodization", [0.3, 1.0])
def test_apodisation_widens_the_main_lobe_as_diffraction_does(apodization):
    """The receive beam within 1 %; the two-way beam within 3 %, beside the 5 % by which Gaussians are narrower."""
    probe = replace(PROBE, receive_apodization=apodization)
    pattern = field(probe, 8.0, 24.0, 24.0, apodization)
    assert half_width(pattern) / half_width(field(probe, 8.0, 24.0, 24.0)) == pytest.approx(
        widening(apodization), rel=0.01
    )
    found, uniform = (float(each.beam_sigma_mm(24.0)[0]) for each in (probe, PROBE))
    expected = half_width(two_way(probe, 24.0))
    assert found / uniform == pytest.approx(expected / half_width(two_way(PROBE, 24.0)), rel=0.03)
    assert found * np.sqrt(2.0 * np.log(2.0)) == pytest.approx(0.95 * expected, rel=0.03)


def test_images_are_as_wide_as_the_apodised_pattern():
    """The correlation of speckle of neighbouring lines equals the autocorrelation of the pattern."""
    apodization = 1.0
    probe = replace(PROBE, receive_apodization=apodization)
    pattern = two_way(probe, 24.0)
    whole = np.concatenate([pattern[:0:-1], pattern])
    own = np.correlate(whole, whole, "full")[len(whole) - 1 :]
    at = np.argmax(own < 0.5 * own[0]) * (X[1] - X[0])
    solid, tissues = block(lambda x, y, z: np.ones_like(x), half_mm=(24, 48, 12)), TissueTable({0: SPECKLE, 1: SPECKLE})
    lines = round(at / float(probe.line_distance_mm(24.0)))
    expected = own[round(lines * float(probe.line_distance_mm(24.0)) / (X[1] - X[0]))] / own[0]
    found = []
    for seed in range(4):
        simulator = UltrasoundSimulator(
            solid, tissues, SimulationSettings(seed=seed, side_lobes=False, ring_down=False)
        )
        window = depth_window(simulator.simulate(probe, rigid(np.eye(3), [0, -24, 0])), 24.0, 3.0)
        middle = window[len(window) // 3 : -len(window) // 3]  # steered lines have wider beams
        found.append(correlation(middle[lines:], middle[:-lines]))
    assert np.mean(found) == pytest.approx(expected, abs=0.1)


def test_apodisation_lowers_the_lobes_by_as_much_as_the_pattern():
    """Power beyond 2.5 mm, eight wavelengths x f-number of the transmit aperture, re everything."""
    row, beyond = round(24.0 / PROBE.depth_mm * (CONSTANTS["LOBE_DEPTHS"] - 1)), X > 2.5
    found, expected = [], []
    for apodization in (0.0, 1.0):
        probe = replace(PROBE, receive_apodization=apodization, clutter_db=None, focus_mm=15.0)
        power = two_way(probe, 24.0) ** 2
        expected.append(10.0 * np.log10(power[beyond].sum() / power.sum()))
        unit = probe.wavelength_mm * probe.receive_f_number
        table = np.interp(
            X / unit, CONSTANTS["LOBE_STEP"] * np.arange(CONSTANTS["LOBE_DISTANCES"]), lobes_of(probe)[row]
        )
        found.append(10.0 * np.log10(2.0 * (table[beyond] ** 2).sum() * (X[1] - X[0]) / unit))
    assert found == pytest.approx(expected, abs=3.0)
    assert found[0] - found[1] > 8.0


def power_beyond(table: np.ndarray, apart_mm: float, unit_mm: float, least_mm: float) -> float:
    """dB of a row of a table, with columns `apart_mm` apart and its power per `unit_mm`, on both sides."""
    amplitude = np.interp(X, apart_mm * np.arange(len(table)), table, right=0.0)
    power = 2.0 * (amplitude[least_mm < X] ** 2).sum() * (X[1] - X[0]) / unit_mm
    return float(10.0 * np.log10(max(power, 1e-12)))


def plane_waves(probe: Probe) -> np.ndarray:
    """(X,) amplitude of the coherent sum of plane waves under all angles of a probe."""
    sines = np.sin(np.deg2rad(probe.largest_angle_deg)) * np.linspace(-1.0, 1.0, probe.transmit_angles)
    return np.abs(np.exp(2j * np.pi / probe.wavelength_mm * np.outer(X, sines)).sum(axis=1))


PLAIN = replace(PROBE, clutter_db=None)
PULSE = replace(PLAIN, frequency_mhz=0.5 * PLAIN.frequency_mhz)  # whose second harmonic has the frequency of PLAIN
#: name: (probe, depth, amplitude of the field on transmission); foci of the zones at 8, 24 and 40 mm, 8 mm is nearer
MODES = {
    "zones, behind the first": (replace(PLAIN, transmit="zones"), 15.0, lambda: field(PLAIN, 8.0 / 3.0, 8.0, 15.0)),
    "harmonic, out of focus": (replace(PULSE, harmonic=True), 12.5, lambda: field(PULSE, 12.0, 24.0, 12.5) ** 2),
    "angles": (
        replace(PLAIN, transmit="angles", transmit_angles=41), 15.0,
        lambda: plane_waves(replace(PLAIN, transmit="angles", transmit_angles=41)),
    ),
}  # fmt: skip


@pytest.mark.parametrize("mode", MODES)
def test_lobes_are_those_of_the_field_of_each_kind_of_transmission(mode):
    probe, depth, sent = MODES[mode]
    receive = min(probe.aperture_mm, depth / probe.receive_f_number)
    power = (sent() * field(PLAIN, receive, depth, depth)) ** 2
    row = round(depth / probe.depth_mm * (CONSTANTS["LOBE_DEPTHS"] - 1))
    unit = probe.wavelength_mm * max(probe.receive_f_number, depth / probe.aperture_mm)
    for least in (2.5, 4.0):
        expected = 10.0 * np.log10(power[least < X].sum() / power.sum())
        found = power_beyond(lobes_of(probe)[row], CONSTANTS["LOBE_STEP"] * unit, unit, least)
        assert found == pytest.approx(expected, abs=3.0), least


def test_elevational_lobes_of_the_harmonic_are_of_the_squared_field():
    probe, depth, row = replace(PULSE, harmonic=True), 25.0, 20
    height = probe.elevation_aperture_mm
    power = (field(PULSE, height, 24.0, depth) ** 2 * field(PLAIN, height, 24.0, depth)) ** 2
    lens = probe.lens()
    for least in (2.5, 4.0):
        expected = 10.0 * np.log10(power[(least < X) & (lens.lobes_mm[row] > X)].sum() / power.sum())
        found = [
            power_beyond(table[row, :, 0], float(ends.max()) / (CONSTANTS["LENS_DISTANCES"] - 1), 1.0, least)
            for table, ends in ((lens.main, lens.main_mm), (lens.lobes, lens.lobes_mm))
        ]
        assert 10.0 * np.log10(sum(10.0 ** (0.1 * db) for db in found)) == pytest.approx(expected, abs=4.0)


@pytest.mark.parametrize("angles", [{"steering_deg": 20.0}, {"trapezoid_deg": 20.0}])
def test_lobes_of_steered_lines_are_those_at_the_same_path(angles):
    """Depths count from behind the face: the table reaches farther, and has the same values at the same path."""
    steered = replace(PLAIN, **angles)
    place = np.linspace(0.0, 1.0, CONSTANTS["LOBE_DEPTHS"])
    for path in (10.0, 30.0):
        rows = [
            [np.interp(path, place * reach, column) for column in lobes_of(probe)[:, 1:12].T]
            for probe, reach in ((steered, steered.displayed_mm), (PLAIN, PLAIN.depth_mm))
        ]
        assert rows[0] == pytest.approx(rows[1], rel=0.15)


def test_a_probes_clutter_is_its_power_beside_the_beam():
    with_clutter, without = (lobes_of(replace(PROBE, clutter_db=level)) for level in (-20.0, None))
    density = with_clutter**2 - without**2
    more = (density[:, 1:] + density[:, :-1]).sum(axis=1) * CONSTANTS["LOBE_STEP"]  # trapezia, on both sides
    assert more == pytest.approx(np.full(len(more), 0.01), rel=0.01)
