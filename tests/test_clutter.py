"""Clutter in black tissue: speckle that is fixed in the patient and falls off with the distance from what scatters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from SlicerUSSim.Logic import (
    ConvexProbe,
    LinearProbe,
    SimulationError,
    SimulationSettings,
    TissueTable,
    UltrasoundSimulator,
)
from SlicerUSSim.Logic.imaging.frame import Frame
from SlicerUSSim.Logic.probe.arrays import PROBES, Probe, probe_from_dict
from tests.conftest import SPECKLE, block, rigid
from validation.measurement import correlation, depth_window, level_db

DEPTH_MM = 24.0
LINEAR = PROBES["linear"]
TISSUE = replace(SPECKLE, attenuation_db_cm_mhz=0.0)
BLACK = replace(TISSUE, name="cyst", mu0=0.0, sigma0=0.0)


def frame(labels, probe: Probe, seed: int, aside_mm: float = 0.0, outside=TISSUE, **settings) -> Frame:
    """Of tissue (label 1) and black tissue (label 2), without walls; `outside` is around the volume."""
    sim = UltrasoundSimulator(
        labels, TissueTable({0: outside, 1: TISSUE, 2: BLACK}),
        SimulationSettings(seed=seed, interfaces=False, ring_down=False, **settings),
    )  # fmt: skip
    return sim.simulate(probe, rigid(np.eye(3), [aside_mm, -DEPTH_MM, 0]))


#: Black within 5 mm of the axis, at all depths
GAP = block(lambda x, y, z: np.where(abs(x) < 5.0, 2, 1), half_mm=(24, 30, 12))


def within_gap(frame: Frame, probe: Probe, half_mm: float = 3.5) -> np.ndarray:
    """(lines, samples) of equal power per line."""
    middle = probe.line_positions()
    signal = depth_window(frame, DEPTH_MM, 6.0)[np.abs(middle) < half_mm]
    return signal / np.sqrt((np.abs(signal) ** 2).mean(axis=1, keepdims=True))


def test_clutter_has_grains_as_the_main_beam_and_no_lattice():
    probe = replace(LINEAR, scan_lines=192)
    apart = float(probe.line_distance_mm(DEPTH_MM))
    signals = [within_gap(frame(GAP, probe, seed), probe) for seed in range(3)]
    lags = np.arange(1, int(5.0 / apart))
    found = np.array([np.mean([(s[lag:] * s[:-lag].conj()).mean().real for s in signals]) for lag in lags])
    grain = probe.wavelength_mm * probe.receive_f_number
    assert np.abs(found[lags * apart > 2.0 * grain]).max() < 0.12
    assert found.min() > -0.12
    half = float(np.interp(-0.5, -found, lags * apart))
    assert 0.4 * grain < half < 1.2 * grain


def test_clutter_falls_off_without_an_end():
    edge = -9.0
    labels = block(lambda x, y, z: np.where(x > edge, 2, 1), half_mm=(24, 30, 12))
    windows = [depth_window(frame(labels, LINEAR, seed, outside=BLACK), DEPTH_MM, 4.0) for seed in range(3)]
    away = LINEAR.line_positions() - edge
    distances = np.arange(3.0, 18.0, 1.5)
    levels = np.array([level_db(np.stack([w[np.abs(away - at) < 0.8] for w in windows])) for at in distances])
    assert (np.diff(levels) < 0.5).all() and (np.diff(levels) > -6.0).all()
    assert 2.0 < levels[0] - levels[np.searchsorted(distances, 9.0)] < 8.0


def test_clutter_is_fixed_in_the_patient():
    """As the probe moves, clutter stays where it is and changes slowly; another patient has another."""
    step = float(LINEAR.line_distance_mm(0.0))
    here, close, moved, other = (
        within_gap(frame(GAP, LINEAR, seed, aside), LINEAR)
        for seed, aside in ((0, 0.0), (0, 0.25 * step), (0, 3.0 * step), (1, 0.0))
    )
    assert correlation(here, close) > 0.9
    assert correlation(here[3:], moved[:-3]) > 0.8
    assert correlation(here, moved) < 0.4
    assert correlation(here, other) < 0.15


def test_an_image_along_the_axes_of_the_patient_ignores_rounding():
    """It lies in the border of the cells of signs."""
    sim = UltrasoundSimulator(GAP, TissueTable({0: TISSUE, 1: TISSUE, 2: BLACK}), SimulationSettings(interfaces=False))
    here, beside = (sim.simulate(LINEAR, rigid(np.eye(3), [0, -DEPTH_MM, aside])).iq for aside in (0.0, 1e-6))
    assert np.linalg.norm(here - beside) < 1e-3 * np.linalg.norm(here)


def test_lobes_leave_the_speckle_of_bright_tissue_unchanged():
    """At the focus 0.3 % of the power is in them."""
    solid = block(lambda x, y, z: np.ones_like(x), half_mm=(24, 30, 12))
    both = [depth_window(frame(solid, LINEAR, 0, side_lobes=on), DEPTH_MM, 6.0) for on in (True, False)]
    assert correlation(*both) > 0.98
    assert level_db(both[0]) == pytest.approx(level_db(both[1]), abs=0.1)


@pytest.mark.parametrize("name", ["phased", "linear_15"])
def test_a_10_mm_cyst_is_about_35_db_down(name):
    probe = replace(PROBES[name], directivity="none")
    depth = probe.focus_mm
    labels = block(lambda x, y, z: np.where(x**2 + y**2 + z**2 < 25.0, 2, 1), half_mm=(16, 8, 8), spacing_mm=0.5)
    near = np.abs(probe.line_positions() * float(probe.line_distance_mm(depth)) / probe.line_spacing)
    inside, outside = [], []
    for seed in range(3):
        sim = UltrasoundSimulator(
            labels, TissueTable({0: TISSUE, 1: TISSUE, 2: BLACK}),
            SimulationSettings(seed=seed, interfaces=False, ring_down=False),
        )  # fmt: skip
        window = depth_window(sim.simulate(probe, rigid(np.eye(3), [0, -depth, 0])), depth, 1.0)
        inside.append(window[near < 1.0])
        outside.append(window[(near > 7.0) & (near < 12.0)])
    assert -42.0 < level_db(np.concatenate(inside)) - level_db(np.concatenate(outside)) < -28.0


@pytest.mark.slow
def test_lobes_out_of_focus_fall_off_as_steeply_as_those_of_apertures():
    """A black strip at 20 mm, the focus at 54 mm: lobes fall by 8 dB per millimetre. Lines and nodes, as wide as the
    main beam, made them 1.1 dB brighter there."""
    probe, depth = ConvexProbe(60.0, 36.0, 90.0, scan_lines=129, clutter_db=None), 20.0
    strip, solid = (
        block(lambda x, y, z, half=half: np.where(abs(x) < half, 2, 1), half_mm=(24, 8, 12), spacing_mm=0.25)
        for half in (4.9, -1.0)
    )  # borders at 4.875 mm, between voxels
    middle = np.abs(probe.line_positions() * float(probe.line_distance_mm(depth)) / probe.line_spacing) < 1.0
    powers = []
    for labels in (strip, solid):
        total = np.zeros(probe.scan_lines)
        for seed in range(12):
            sim = UltrasoundSimulator(
                labels, TissueTable({0: TISSUE, 1: TISSUE, 2: BLACK}),
                SimulationSettings(seed=seed, interfaces=False, ring_down=False),
            )  # fmt: skip
            window = depth_window(sim.simulate(probe, rigid(np.eye(3), [0, -depth, 0])), depth, 1.0)
            total += (np.abs(window) ** 2).mean(axis=1)
        powers.append(total)
    level = 10.0 * np.log10(powers[0][middle].mean() / powers[1].mean())
    power = np.mean([strip_power(probe, depth, 4.875 + aside) for aside in np.linspace(-1.0, 1.0, 21)])
    assert level == pytest.approx(10.0 * np.log10(power), abs=0.8)


def strip_power(probe: Probe, depth_mm: float, half_mm: float) -> float:
    """Power of the two-way beam farther than `half_mm` aside: the sum of the waves of points of both apertures."""
    across = np.linspace(0.0, 40.0, 3201)
    power = np.ones(len(across))
    for size, focus in ((probe.aperture_mm, probe.focus_mm), (depth_mm / probe.receive_f_number, depth_mm)):
        point = ((np.arange(400) + 0.5) / 400 - 0.5) * size
        distance = np.hypot(across[:, None] - point, depth_mm)
        waves = np.exp(2j * np.pi / probe.wavelength_mm * (distance - np.hypot(point, focus)))
        power *= np.abs(waves.sum(axis=1)) ** 2
    return float(power[across > half_mm].sum() / (power.sum() - 0.5 * power[0]))


def test_clutter_can_be_switched_off():
    labels = block(lambda x, y, z: np.where(x > -9.0, 2, 1), half_mm=(24, 30, 12))
    off = replace(LINEAR, clutter_db=None)
    far = np.abs(LINEAR.line_positions()) < 1.0
    levels = [level_db(depth_window(frame(labels, p, 0, outside=BLACK), DEPTH_MM, 4.0)[far]) for p in (LINEAR, off)]
    assert levels[0] - levels[1] > 10.0
    assert probe_from_dict(off.to_dict()) == off
    with pytest.raises(SimulationError, match="clutter_db is 3"):
        LinearProbe(38, 40, clutter_db=3.0)
