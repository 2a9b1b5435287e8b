"""Interface echoes: their level, and walls around fluid."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from SlicerUSSim.Logic import DisplaySettings, LinearProbe, Tissue
from tests.conftest import FLUID, SPECKLE, block, rigid, simulator

PROBE = LinearProbe(30, 60, scan_lines=121, focus_mm=30, elevation_focus_mm=30)


def test_an_interface_echo_does_not_depend_on_line_density():
    wall = block(lambda x, y, z: y > 0)
    hard = Tissue("wall", 1540.0, 1.8, 0.0)
    sim = simulator(wall, hard, scattering=False)
    pose = rigid(np.eye(3), [0, -20, 0])
    peaks = [
        np.abs(sim.simulate(replace(PROBE, scan_lines=lines), pose).iq[lines // 2]).max() for lines in (41, 81, 161)
    ]
    np.testing.assert_allclose(peaks, peaks[0], rtol=0.05)
    # Perpendicular, focused or not: r times the gain, in the unit of the speckle.
    r = (1.8 - 1.54) / (1.8 + 1.54)
    gain = 10 ** (sim.settings.interface_gain_db / 20)
    assert peaks[0] == pytest.approx(r * gain, rel=0.05)


def test_fluid_is_black_and_its_walls_are_bright():
    cyst = block(lambda x, y, z: np.where(x**2 + y**2 + z**2 < 10**2, 2, 1))
    frame = simulator(cyst, SPECKLE, FLUID).simulate(
        PROBE, rigid(np.eye(3), [0, -25, 0]), DisplaySettings(tgc_db_cm_mhz=0.0, noise_db=None)
    )
    line = frame.bmode[60].astype(float)
    inside = line[int(17.5 / frame.sample_interval_mm) : int(32.5 / frame.sample_interval_mm)]
    before = line[int(5 / frame.sample_interval_mm) : int(13 / frame.sample_interval_mm)]
    assert inside.mean() < 5 < 50 < before.mean()
    for wall in (15.0, 35.0):
        near = line[int((wall - 1) / frame.sample_interval_mm) : int((wall + 1) / frame.sample_interval_mm)]
        assert near.max() > before.mean() + 40
