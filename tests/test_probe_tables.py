"""The tables of a probe, which are made by transforms in single precision, against sums over points of apertures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from SlicerUSSim.Logic import LinearProbe, PhasedProbe
from SlicerUSSim.Logic.imaging import diffraction
from SlicerUSSim.Logic.opencl.layout import CONSTANTS
from SlicerUSSim.Logic.probe.beam import FWHM_PER_SIGMA

PROBE = PhasedProbe(75, 73, scan_lines=96)


def points(size_mm: float, count: int) -> np.ndarray:
    return ((np.arange(count) + 0.5) / count - 0.5) * size_mm


def db(power: np.ndarray) -> np.ndarray:
    return 10.0 * np.log10(np.maximum(power, 1e-9))


@pytest.mark.parametrize("harmonic", [False, True])
def test_the_lens_has_the_field_of_the_points_of_its_aperture(harmonic):
    """Down to -40 dB, averaged over a column of the table: within 0.5 dB, by what comes back from the plane's ends."""
    probe = replace(PROBE, harmonic=harmonic, frequency_mhz=2.5 if harmonic else 5.0)
    lens, row = probe.lens(), 20
    depth = probe.depth_mm * row / (CONSTANTS["LOBE_DEPTHS"] - 1)
    step, fine = float(lens.main_mm.max()) / (CONSTANTS["LENS_DISTANCES"] - 1), 16
    columns = int(0.85 * lens.main_mm[row] / step)  # behind, the main beam fades
    x = (np.arange(columns * fine) + 0.5 - 0.5 * fine) * step / fine
    aperture = points(probe.lens_height_mm, 800)
    bend = 1.0 / depth - 1.0 / probe.elevation_focus_mm

    def field(length: float) -> np.ndarray:
        path = bend * aperture**2 / 2.0 - x[:, None] * aperture / depth
        return np.exp(2j * np.pi / length * path).mean(axis=1) / np.sqrt(length)

    power = np.zeros(len(x))
    for node, weight in zip(*np.polynomial.hermite.hermgauss(7), strict=True):
        length = probe.wavelength_mm / (1.0 + probe.received_bandwidth / FWHM_PER_SIGMA * node)
        beam = field(length) * (field(2.0 * length) ** 2 if harmonic else field(length))
        power += weight * length ** (3.0 if harmonic else 2.0) * np.abs(beam) ** 2
    expected = power.reshape(columns, fine).mean(axis=1)
    found = lens.main[row, :columns, 0] ** 2
    clear = expected > 1e-4 * expected[0]
    assert clear.sum() > 20
    assert db(found / found[0])[clear] == pytest.approx(db(expected / expected[0])[clear], abs=0.5)


@pytest.mark.parametrize("apodization", [0.0, 1.0])
def test_planes_have_the_echo_of_the_ways_between_points(apodization):
    """Down to -30 dB: within 0.5 dB, since columns are interpolated, and times are 32."""
    probe = LinearProbe(38, 40, receive_apodization=apodization, focus_mm=16.0)
    rows, tilts = CONSTANTS["PLANE_DEPTHS"], np.linspace(0.0, 1.0, CONSTANTS["PLANE_TILTS"]) ** 2
    row = 8
    depth = probe.depth_mm * row / (rows - 1)
    received = min(probe.aperture_mm, depth / probe.receive_f_number)
    a, b = points(probe.aperture_mm, 300), points(received, 200)
    weights = 1.0 - apodization + apodization * np.cos(np.pi * b / received) ** 2
    spread = probe.received_bandwidth / FWHM_PER_SIGMA
    frequency = 1.0 + spread * np.linspace(-2.5, 2.5, 25)
    time = np.linspace(-6.0, 6.0, 241)
    chosen = np.arange(0, 24, 4)
    peaks = []
    for tilt in tilts[chosen]:
        echo = np.zeros(len(time), complex)
        for f in frequency:
            k = 2.0 * np.pi * f / probe.wavelength_mm
            bent = np.exp(0.5j * k * a**2 * (1.0 / depth - 1.0 / probe.focus_mm))
            ways = np.exp(-0.25j * k / depth * (a[:, None] + b - 2.0 * depth * tilt) ** 2)
            pulse = np.exp(-0.5 * ((f - 1.0) / spread) ** 2)
            echo += bent @ ways @ weights * pulse * np.exp(-2j * np.pi * f * time)
        peaks.append(np.abs(echo).max())
    expected = 20.0 * np.log10(np.array(peaks) / peaks[0])
    found = 20.0 * np.log10(2.0) * diffraction.plane_echoes(probe)[row, chosen, 0]
    assert found[expected > -30] == pytest.approx(expected[expected > -30], abs=0.5)
    assert (expected > -30).sum() > 3


def test_lateral_fields_are_those_of_the_points_of_the_aperture():
    depth, aperture = np.array([8.0, 30.0, 70.0]), np.full(3, 12.0)
    for octaves in (0, 1):
        step, found = diffraction._focused_once(0.308, aperture, np.full(3, 40.0), depth, octaves)
        place = points(12.0, 512)
        for at in range(3):
            x = step[at] * np.arange(300)
            path = (1.0 / depth[at] - 1.0 / 40.0) * place**2 / 2.0 - x[:, None] * place / depth[at]
            expected = np.abs(np.exp(2j * np.pi / (2**octaves * 0.308) * path).sum(axis=1))
            assert found[at, :300] / found[at, 0] == pytest.approx(expected / expected[0], abs=1e-4)


def test_weights_are_those_of_filters_that_are_sums():
    """Of the same steps with scipy's filter, which ends at four deviations: within 0.1 dB."""
    depths, distances, finer = CONSTANTS["LOBE_DEPTHS"], CONSTANTS["LOBE_DISTANCES"], 8
    probe = replace(PROBE, clutter_db=None)
    depth = probe.depth_mm * np.maximum(np.arange(depths), 0.5) / (depths - 1)
    unit = probe.wavelength_mm * np.maximum(probe.receive_f_number, depth / probe.aperture_mm)
    apart = probe.line_distance_mm(depth) / unit
    node = apart * np.clip((1.0 / apart).astype(int), 1, probe.scan_lines)
    deviation = np.sqrt(0.5 * (probe.beam_sigma_mm(depth)[0] / unit) ** 2 + 0.188 * node**2 + 0.130)
    fine = np.linspace(0, distances - 1, finer * (distances - 1) + 1)
    lobes, weights = (table(probe).astype(float) for table in (diffraction.lobes_of, diffraction.lateral_weights))
    for row in range(4, depths, 7):
        peak, power = lobes[row].argmax(), lobes[row] ** 2
        wanted = np.exp(np.interp(np.maximum(fine, peak), np.arange(distances), np.log(power + 1e-9)))
        made = wanted
        for _ in range(3):
            width = finer * deviation[row] / CONSTANTS["LOBE_STEP"]
            made = made * wanted / gaussian_filter1d(made, width, mode="mirror")
        clear = (np.arange(distances) > peak) & (power > 1e-6)
        assert db(weights[row] ** 2)[clear] == pytest.approx(db(made[::finer])[clear], abs=0.1)
        assert clear.sum() > 5 and not np.allclose(db(power)[clear], db(made[::finer])[clear], atol=0.5)
