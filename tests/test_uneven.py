"""Echogenicity that varies within a tissue (docs/physics.md#uneven-tissue): texture and specks, fixed in it.

Statistics come from the reference in numpy, with which test_kernels.py compares the kernel.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from SlicerUSSim.Logic import (
    DisplaySettings,
    LinearProbe,
    SimulationError,
    SimulationSettings,
    TissueTable,
    UltrasoundSimulator,
)
from SlicerUSSim.Logic.fitting import AppearanceModel
from SlicerUSSim.Logic.imaging.scattering import speck_power, unevenness_table
from SlicerUSSim.Logic.opencl.layout import TISSUE
from SlicerUSSim.Logic.tissue.presets import TISSUES
from tests.conftest import SPECKLE, block, rigid
from tests.reference.scatterers import unevenness
from validation.measurement import correlation, level_db
from validation.speckle import one_line_on

PROBE = LinearProbe(36, 46, scan_lines=145, focus_mm=25, elevation_focus_mm=25)
POSE = rigid(np.eye(3), [0, -23, 0])
SOLID = block(lambda x, y, z: np.ones_like(x), half_mm=(30, 30, 12))
EVEN = replace(SPECKLE, texture_db=0.0, specks_per_mm3=0.0)
UNEVEN = replace(EVEN, texture_db=4.0, texture_mm=0.7, specks_per_mm3=0.02, speck_db=12.0)


def simulator(tissue, seed=0, **settings) -> UltrasoundSimulator:
    return UltrasoundSimulator(SOLID, TissueTable({0: EVEN, 1: tissue}), SimulationSettings(seed=seed, **settings))


def rows(**values) -> np.ndarray:
    row = np.zeros(1, TISSUE)
    for name, value in ({"texture_mm": 0.5} | values).items():
        row[name] = value
    return row


def factors(row: np.ndarray, places: np.ndarray, seed=3) -> np.ndarray:
    return unevenness(seed, np.repeat(row, len(places)), places)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        pytest.param({"texture_db": 0.0}, marks=pytest.mark.slow),
        pytest.param({"specks_per_mm3": 0.0, "texture_db": 8.0}, marks=pytest.mark.slow),
    ],
)
def test_mean_power_is_kept(changes):
    """Against the same scatterers without, so that the draw of the speckle does not count."""
    uneven = replace(UNEVEN, **changes)
    ratios = []
    for seed in range(8):
        power = [
            10 ** (0.1 * level_db(simulator(tissue, seed, side_lobes=False).simulate(PROBE, POSE).iq[:, 64:-64]))
            for tissue in (EVEN, uneven)
        ]
        ratios.append(power[1] / power[0])
    error = np.std(ratios) / np.sqrt(len(ratios)) * 10 / np.log(10)
    assert 10 * np.log10(np.mean(ratios)) == pytest.approx(0.0, abs=max(0.1, 2.5 * error))


@pytest.mark.slow
@pytest.mark.parametrize(
    "values",
    [
        pytest.param({"texture_db": 3.0}, marks=pytest.mark.slow),
        pytest.param({"texture_db": 8.0}, marks=pytest.mark.slow),
        pytest.param({"specks_per_mm3": 0.05, "speck_db": 14.0}, marks=pytest.mark.slow),
        {"texture_db": 4.0, "specks_per_mm3": 0.02, "speck_db": 12.0},
    ],
)
def test_mean_square_of_the_gain_is_one_within_a_tenth_of_a_decibel(values):
    places = np.random.default_rng(0).uniform(-400, 400, (3_000_000, 3))
    power = factors(rows(**values), places).astype(float) ** 2
    assert 10 * np.log10(power.mean()) == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize(("deviation", "length"), [(3.0, 0.5), (5.0, 1.2)])
def test_texture_has_its_deviation_and_length(deviation, length):
    row = rows(texture_db=deviation, texture_mm=length)
    random = np.random.default_rng(1)
    places = random.uniform(-200, 200, (200_000, 3))
    here = 20 * np.log10(factors(row, places))
    assert here.std() == pytest.approx(deviation, rel=0.02)
    assert stats.kurtosis(here) == pytest.approx(0.0, abs=0.1)
    for axis in range(3):
        beside = 20 * np.log10(factors(row, places + length * np.eye(3)[axis]))
        assert np.corrcoef(here, beside)[0, 1] == pytest.approx(0.5, abs=0.03)
    far = 20 * np.log10(factors(row, places + [5 * length, 0, 0]))
    assert np.corrcoef(here, far)[0, 1] == pytest.approx(0.0, abs=0.02)
    # No step: places close by have nearly the same level, also across the lattice
    close = 20 * np.log10(factors(row, places + 0.02 * length))
    assert np.abs(close - here).max() < 0.35 * deviation


def test_specks_are_as_many_and_as_bright_as_set():
    row = rows(texture_mm=0.5, specks_per_mm3=0.03, speck_db=12.0)
    places = np.random.default_rng(2).uniform(-100, 100, (400_000, 3))
    gain_db = 20 * np.log10(factors(row, places))
    ground = np.median(gain_db)
    assert (gain_db > ground + 0.01).mean() == pytest.approx(0.03 * 4 / 3 * np.pi * 0.25**3, rel=0.05)
    assert gain_db.max() - ground == pytest.approx(12.0, abs=0.3)
    assert speck_power(0.0) == pytest.approx(1.0)


def test_it_is_fixed_in_the_patient_and_depends_on_the_seed():
    made = simulator(UNEVEN)
    here = made.simulate(PROBE, POSE)
    probe = replace(PROBE, scan_lines=181)
    moved = [made.simulate(probe, pose) for pose in (POSE, POSE @ one_line_on(probe))]
    assert correlation(moved[0].iq[1:], moved[1].iq[:-1]) > 0.95
    assert not np.array_equal(here.iq, simulator(UNEVEN, seed=1).simulate(PROBE, POSE).iq)
    # Another part of the patient, in a separate image, is not the same
    ratio = [np.abs(made.simulate(PROBE, POSE).iq) / np.abs(simulator(EVEN).simulate(PROBE, POSE).iq) for _ in range(2)]
    np.testing.assert_array_equal(*ratio)


def test_without_deviation_and_specks_nothing_changes():
    plain = simulator(EVEN).simulate(PROBE, POSE)
    off = simulator(replace(UNEVEN, texture_db=0.0, speck_db=0.0)).simulate(PROBE, POSE)
    np.testing.assert_array_equal(plain.iq, off.iq)
    # Beside a tissue that varies, one that does not is the same up to rounding
    both = UltrasoundSimulator(SOLID, TissueTable({0: UNEVEN, 1: EVEN})).simulate(PROBE, POSE)
    np.testing.assert_allclose(
        both.iq[40:-40, 300:-300], plain.iq[40:-40, 300:-300], atol=1e-4 * np.abs(plain.iq).max()
    )
    assert not unevenness_table(rows(texture_db=0.0, specks_per_mm3=1.0, speck_db=0.0))[:, [0, 3]].any()


def test_specks_make_a_bright_tail():
    def skewness(tissue):
        images = [
            simulator(tissue, seed).simulate(PROBE, POSE, DisplaySettings(tgc_db_cm_mhz=0.0)).image for seed in range(2)
        ]
        return stats.skew(np.concatenate([image[100:400, 60:-60].ravel() for image in images]))

    assert skewness(replace(EVEN, texture_db=4.0, specks_per_mm3=0.05, speck_db=24.0)) > skewness(EVEN) + 0.35


def test_fits_vary_the_echogenicity_of_uneven_tissue_exactly():
    """The signal is linear in amplitudes, whatever factor each scatterer has: bases of fits are the simulator's."""
    made = simulator(UNEVEN)
    model = AppearanceModel(made, PROBE, [POSE], {"speckle": ["mu0", "sigma0"]})
    display = DisplaySettings(noise_db=None)
    brighter = made.medium.tissues.replace("speckle", mu0=1.5 * UNEVEN.mu0, sigma0=1.5 * UNEVEN.sigma0)
    with made.with_tissues(brighter):
        expected = made.simulate(PROBE, POSE, display).image
    assert (np.abs(model.image(0, brighter, display).astype(int) - expected) <= 1).mean() > 0.999


def test_presets_of_brain_vary_and_values_out_of_range_are_refused():
    for name in ("white matter", "grey matter", "tumour"):
        assert TISSUES[name].texture_db > 0.0 and "texture_db" in TISSUES[name].sources
    assert TISSUES["csf"].texture_db == 0.0
    with pytest.raises(SimulationError, match="texture_db is 40"):
        replace(EVEN, texture_db=40.0)
