"""Images computed from bases for the free parameters of an optimiser equal those of complete simulations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st

from SlicerUSSim.Logic import DisplaySettings, LinearProbe, Membrane, SimulationError, Tissue
from SlicerUSSim.Logic.fitting.appearance import VARIABLE, AppearanceModel
from SlicerUSSim.Logic.fitting.parameters import TISSUE_BOUNDS
from SlicerUSSim.Logic.imaging.side_lobes import DARK
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.tissue.presets import TISSUES
from tests.conftest import block, simulator

UPPER = Tissue("upper", 1540.0, 1.60, 0.5, 0.33, 0.0, 0.15)
LOWER = Tissue("lower", 1540.0, 1.60, 0.7, 0.20, 0.3, 0.30)
ECHO = Tissue("plate", 1580.0, 1.75, 0.5, 0.3, 0.0, 0.2)
PROBE = LinearProbe(24, 40, scan_lines=64)
DISPLAY = DisplaySettings(tgc_db_cm_mhz=0.4, noise_db=-75.0)


def at(y: float, x: float = 0.0) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = x, y, 0.0
    return pose


@pytest.fixture(scope="module")
def layers():
    """Two tissues without an interface between them, and a plate that echoes, at two poses."""

    def label(x, y, z):
        return 1 + (y > 2 + 0.3 * x) + (np.abs(y - 14) < 1.5) * 1 * (y > 2 + 0.3 * x)

    found = simulator(block(label, (20, 30, 8)), UPPER, LOWER, ECHO, seed=5)
    return found, [at(-20.0), at(-18.0, 2.0)]


VARIED = {"upper": ("mu0", "sigma0", "mu1", "attenuation_db_cm_mhz"), "lower": ("mu0", "sigma0")}


@pytest.fixture(scope="module")
def model(layers):
    found, poses = layers
    return AppearanceModel(found, PROBE, poses, VARIED)


def whole(found, pose, tissues, display=DISPLAY) -> np.ndarray:
    with found.with_tissues(tissues):
        return found.simulate(PROBE, pose, display).image


def test_images_at_the_anchor_are_those_of_whole_simulations(layers, model):
    found, poses = layers
    for number, pose in enumerate(poses):
        image = model.image(number, found.medium.tissues, DISPLAY)
        difference = np.abs(image.astype(int) - whole(found, pose, found.medium.tissues))
        # Sums in another order differ most in the darkest grains.
        assert (difference <= 1).mean() > 0.9999 and difference.max() <= 3
        assert (image > 0).mean() > 0.5


@settings(max_examples=12)
@given(st.floats(0.0, 1.0), st.floats(-1.0, 1.5), st.floats(0.0, 0.6), st.floats(0.0, 0.8), st.floats(0.02, 0.5))
def test_scatterers_are_exact_far_from_the_anchor(layers, model, mu0, mu1, sigma0, other_mu0, other_sigma0):
    found, poses = layers
    tissues = found.medium.tissues.replace("upper", mu0=mu0, mu1=mu1, sigma0=sigma0)
    tissues = tissues.replace("lower", mu0=other_mu0, sigma0=other_sigma0)
    dark = found.medium.quieter(DARK)
    with found.with_tissues(tissues):
        assume((found.medium.quieter(DARK) == dark).all())  # otherwise elevational lobes are computed elsewhere
    difference = model.image(1, tissues, DISPLAY).astype(int) - whole(found, poses[1], tissues)
    assert np.abs(difference).mean() < 0.02


@pytest.mark.parametrize("attenuation", [0.2, 0.8])
def test_attenuation_by_the_direct_path_is_that_of_a_whole_simulation(layers, model, attenuation):
    found, poses = layers
    tissues = found.medium.tissues.replace("upper", attenuation_db_cm_mhz=attenuation)
    image, exact = model.image(0, tissues, DISPLAY).astype(int), whole(found, poses[0], tissues)
    before = whole(found, poses[0], found.medium.tissues)
    field = exact > 0
    assert np.abs(exact[field].astype(int) - before[field]).mean() > 10.0 * abs(attenuation - 0.5)
    assert abs((image - exact)[field].mean()) < 0.4
    # The grains belong to the anchor's frequency.
    assert np.abs(image - exact)[field].mean() < 10.0 * abs(attenuation - 0.5)


def test_attenuation_without_downshift_has_the_same_grains(layers):
    found, poses = layers
    before = found.settings
    try:
        found.settings = replace(before, frequency_downshift=False)
        model = AppearanceModel(found, PROBE, poses[:1], VARIED)
        for attenuation in (0.2, 1.0):
            tissues = found.medium.tissues.replace("upper", attenuation_db_cm_mhz=attenuation)
            exact = whole(found, poses[0], tissues)
            off = (model.image(0, tissues, DISPLAY).astype(int) - exact)[exact > 0]
            assert abs(off.mean()) < 0.3 and np.abs(off).mean() < 1.0
    finally:
        found.settings = before


def test_moving_the_anchor_makes_the_model_exact_there(layers):
    found, poses = layers
    model = AppearanceModel(found, PROBE, poses[:1], VARIED)
    tissues = found.medium.tissues.replace("upper", mu1=0.9, attenuation_db_cm_mhz=1.5)
    before = found.medium.tissues
    exact = whole(found, poses[0], tissues)
    off = np.abs(model.image(0, tissues, DISPLAY).astype(int) - exact).mean()
    model.anchor(tissues)
    assert off > 0.2 and np.abs(model.image(0, tissues, DISPLAY).astype(int) - exact).max() <= 1
    assert found.medium.tissues is before


def test_display_needs_no_separate_bases(layers):
    found, poses = layers
    model = AppearanceModel(found, PROBE, poses[:1], {})
    for display in (DISPLAY, DisplaySettings(gain_db=6, dynamic_range_db=40, tgc_db_cm_mhz=0.9, noise_db=-50)):
        exact = whole(found, poses[0], found.medium.tissues, display)
        assert np.abs(model.image(0, found.medium.tissues, display).astype(int) - exact).max() <= 1


def test_the_membrane_can_be_varied():
    sheet = replace(TISSUES["leptomeninges"], name="sheet")
    fluid = Tissue("fluid", 1540.0, 1.54, 0.0)
    labels = block(lambda x, y, z: (y > 0) * 1, (20, 30, 8))
    found = simulator(labels, UPPER, coupling=fluid, membrane=Membrane(sheet, 1.2, ("fluid",)))
    model = AppearanceModel(found, PROBE, [at(-10.0)], {"sheet": ("mu0", "sigma0")})
    tissues = found.medium.tissues.replace("sheet", mu0=0.2, sigma0=1.0)
    exact = whole(found, at(-10.0), tissues)
    assert np.abs(model.image(0, tissues, DISPLAY).astype(int) - exact).max() <= 1
    assert np.abs(whole(found, at(-10.0), found.medium.tissues).astype(int) - exact).max() > 5


def test_one_tissue_on_two_labels_is_varied_on_both():
    labels = block(lambda x, y, z: 1 + (x > 0), (20, 30, 8))
    found = simulator(labels, UPPER, UPPER)
    model = AppearanceModel(found, PROBE, [at(-15.0)], {"upper": ("mu0", "attenuation_db_cm_mhz")})
    tissues = found.medium.tissues.with_tissue(replace(UPPER, mu0=0.9, attenuation_db_cm_mhz=0.3))
    exact = whole(found, at(-15.0), tissues)
    off = (model.image(0, tissues, DISPLAY).astype(int) - exact)[exact > 0]
    assert abs(off.mean()) < 0.4 and np.abs(off).mean() < 3.0  # with the grains of the anchor's frequency


def test_pixels_of_another_grid_are_the_same_image(layers):
    found, poses = layers
    grid = ImageGrid(100, 80, -10.0, 3.0, (0.25, 0.3))
    model = AppearanceModel(found, PROBE, poses, VARIED, grid)
    exact = found.simulate(PROBE, poses[0], DISPLAY, grid).image
    assert exact.shape == (100, 80)
    assert np.abs(model.image(0, found.medium.tissues, DISPLAY).astype(int) - exact).max() <= 1


def test_a_tissue_that_is_not_there_is_named(layers):
    with pytest.raises(SimulationError, match=r"no tissue named 'liver', expected one of: fluid, upper, lower, plate"):
        AppearanceModel(layers[0], PROBE, layers[1], {"liver": ("mu0",)})


def test_tissue_parameters_that_a_fit_cannot_vary_are_refused(layers):
    assert set(TISSUE_BOUNDS) == VARIABLE
    with pytest.raises(SimulationError, match="upper: a fit cannot vary impedance_mrayl, expected attenuation_db_cm_m"):
        AppearanceModel(layers[0], PROBE, layers[1], {"upper": ("mu0", "impedance_mrayl")})


def test_more_images_than_memory_holds_are_refused(layers):
    with pytest.raises(SimulationError, match=r"8000 images with 3 parts each need [\d.]+ GB, expected at most 4"):
        AppearanceModel(layers[0], PROBE, layers[1] * 4000, VARIED)
