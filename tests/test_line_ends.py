"""Scan lines end without fading: their last samples have the echoes of half a pulse behind the image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from SlicerUSSim.Logic import DisplaySettings, LinearProbe
from SlicerUSSim.Logic.probe.arrays import PROBES
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.tissue.presets import TISSUES
from tests.conftest import SPECKLE, block, rigid, simulator

WHOLE = block(lambda x, y, z: np.ones_like(x), half_mm=(120, 90, 40), spacing_mm=2.0)
POSE = rigid(np.eye(3), [0, -85, 0])
LINEAR = LinearProbe(30, 40, scan_lines=101, focus_mm=25, elevation_focus_mm=25)
#: Nothing of the signal depends on the depth of the image
PLAIN = {"beam": "ray", "side_lobes": False, "scatterers_per_mm3": 30.0, "wavefront_curvature": False}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["phased", "convex", "linear", "neonatal", "cardiac", "linear_15", "matrix"])
def test_the_last_samples_of_a_line_are_as_bright_as_those_before(name):
    """They were 2 to 3.6 dB darker: of half the pulse there were no echoes."""
    power = np.mean(
        [
            np.mean(np.abs(simulator(WHOLE, SPECKLE, seed=seed).simulate(PROBES[name], POSE).iq) ** 2, axis=0)
            for seed in range(8)
        ],
        axis=0,
    )
    # Speckle of three samples differs by 0.3 to 0.5 dB from that of forty, of these fans.
    assert 10.0 * np.log10(power[-3:].mean() / power[-50:-10].mean()) == pytest.approx(0.0, abs=1.2)


@pytest.mark.parametrize("probe", [LINEAR, replace(LINEAR, steering_deg=15.0), replace(LINEAR, trapezoid_deg=20.0)])
def test_an_image_ends_as_a_deeper_one_continues(probe):
    """Tissue and an oblique wall that lies partly within the image, partly behind its end."""
    medium = block(lambda x, y, z: 1 + (y > -45.0 + 0.03 * x), half_mm=(50, 90, 20), spacing_mm=1.0)
    sim = simulator(medium, SPECKLE, replace(TISSUES["fat"], attenuation_db_cm_mhz=0.0), **PLAIN)
    short, long = (sim.simulate(replace(probe, depth_mm=depth), POSE).iq for depth in (40.0, 46.0))
    cut = long[:, : short.shape[1]]
    np.testing.assert_allclose(short[:, -40:], cut[:, -40:], atol=0.03 * np.abs(cut[:, -40:]).max())


def test_a_coarse_image_has_no_dark_last_row():
    """A pixel of 1.25 mm averages 32 samples, of which half were behind the end of the line."""
    display = DisplaySettings(noise_db=None, tgc_db_cm_mhz=0.0, gain_db=10.0)
    sim = simulator(WHOLE, SPECKLE)
    grid = ImageGrid.for_probe(LINEAR, (32, 24))
    rows = np.mean(
        [sim.simulate(replace(LINEAR), rigid(np.eye(3), [0, -85, z]), display, grid).image for z in range(-12, 13, 2)],
        axis=(0, 2),
    )
    assert rows[-1] == pytest.approx(rows[-8:-1].mean(), abs=4.0)
