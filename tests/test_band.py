"""What attenuation leaves of the band of a pulse, against a sum over its positive frequencies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from SlicerUSSim.Logic import DisplaySettings, SimulationSettings, TissueTable, UltrasoundSimulator
from SlicerUSSim.Logic.imaging.frame import Frame
from SlicerUSSim.Logic.probe.arrays import PROBES, Probe
from tests.conftest import SPECKLE, block, even_display, rigid
from validation.measurement import depth_window, level_db
from validation.phantoms import band_power

WIDE = ("cardiac", "neonatal", "matrix", "hockey_stick")
SOLID = block(lambda x, y, z: np.ones_like(x), half_mm=(10, 10, 10), spacing_mm=2.0)


def speckle(attenuation: float, seed: int, **settings) -> UltrasoundSimulator:
    tissue = replace(SPECKLE, attenuation_db_cm_mhz=attenuation)
    return UltrasoundSimulator(
        SOLID, TissueTable({0: tissue, 1: tissue}), SimulationSettings(seed=seed, ring_down=False, **settings)
    )


def frames(probe: Probe, attenuation: float, display: DisplaySettings | None = None, **settings) -> list[Frame]:
    return [speckle(attenuation, seed, **settings).simulate(probe, rigid(np.eye(3), [0, 0, 0]), display)
            for seed in range(6)]  # fmt: skip


def in_band(attenuation: float, probe: Probe, depth_mm: np.ndarray) -> np.ndarray:
    """dB (depths,) of power, each positive frequency attenuated by itself."""
    sigma = probe.fractional_bandwidth / 2.3548
    f = np.linspace(0.0, 4.0, 8001)
    spectrum = np.exp(-(((f - 1.0) / sigma) ** 2))
    loss_db = 0.2 * attenuation * probe.frequency_mhz * np.asarray(depth_mm)[:, None] * f
    return 10 * np.log10((spectrum * 10 ** (-0.1 * loss_db)).sum(axis=1) / spectrum.sum())


@pytest.mark.slow
@pytest.mark.parametrize("name", WIDE)
def test_levels_are_those_of_a_band_wise_sum_down_to_the_full_depth(name):
    """The frequency stopped at half of the pulse's, which made the far field 6 to 17 dB too dark."""
    probe = replace(PROBES[name], scan_lines=128, directivity="none")  # the sum is for lines that are not steered
    found = frames(probe, 0.8)
    for part in (0.4, 0.7, 0.95):
        depth, half = part * probe.depth_mm, 0.02 * probe.depth_mm
        near = depth + np.linspace(-half, half, 41)
        expected = 10 * np.log10((10 ** (0.1 * in_band(0.8, probe, near))).mean() * SPECKLE.scatterer_variance)
        assert level_db(np.stack([depth_window(f, depth, half) for f in found])) == pytest.approx(expected, abs=0.3)


@pytest.mark.parametrize("name", WIDE)
def test_time_gain_compensation_of_the_tissue_makes_it_even(name):
    """It compensated the loss of the centre frequency: the far fields of these were 5 to 12 dB too bright."""
    probe = replace(PROBES[name], scan_lines=128)
    found = frames(probe, 0.5, even_display(tgc_db_cm_mhz=0.5, tgc_reach=1.0, noise_db=None))
    levels = []
    for part in (0.3, 0.6, 0.9):
        ends = ((np.array([-0.04, 0.04]) + part) * probe.depth_mm / found[0].sample_interval_mm).astype(int)
        levels.append(level_db(np.stack([f.envelope[:, slice(*ends)] for f in found])))
    assert levels == pytest.approx([levels[0]] * 3, abs=0.4)


def test_without_downshift_the_compensation_is_in_proportion_to_depth():
    probe = replace(PROBES["matrix"], scan_lines=32)
    simulator = speckle(0.5, 0, frequency_downshift=False)
    with_tgc, without = (
        simulator.simulate(probe, np.eye(4), even_display(tgc_db_cm_mhz=tgc, tgc_reach=1.0, noise_db=None)).envelope
        for tgc in (0.5, 0.0)
    )
    samples = np.array([500, 1000, 1500])
    depth = samples * simulator.simulate(probe, np.eye(4)).sample_interval_mm
    rise = 20 * np.log10(with_tgc[:, samples] / without[:, samples])
    np.testing.assert_allclose(rise, np.broadcast_to(0.1 * 2 * 0.5 * 3.0 * depth, rise.shape), atol=0.02)


def test_the_phantoms_band_has_no_frequencies_below_zero():
    for name in WIDE:
        probe, depth = PROBES[name], PROBES[name].depth_mm * np.array([0.1, 0.5, 1.0])
        power = 10 * np.log10(band_power(probe, 0.2 * 0.8 * probe.frequency_mhz * depth))
        np.testing.assert_allclose(power, in_band(0.8, probe, depth), atol=0.02)
