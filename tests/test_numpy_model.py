"""The kernels against the same model in plain numpy, and the devices of this computer against each other."""

from __future__ import annotations

import numpy as np
import pytest

from SlicerUSSim.Logic import (
    ConvexProbe,
    DisplaySettings,
    LinearProbe,
    PhasedProbe,
    SimulationError,
    SimulationSettings,
    Tissue,
    TissueTable,
    UltrasoundSimulator,
    list_devices,
    seed_of_pose,
)
from SlicerUSSim.Logic.tissue.tissue import Membrane
from SlicerUSSim.Logic.verification.numpy_model import NumpyModel
from tests.conftest import block, rigid

FLUID = Tissue("fluid", 1520, 1.52, 0.0, 0.0, 0.0, 0.0)
BRAIN = Tissue("brain", 1546, 1.60, 0.5, 0.3, 0.0, 0.15)
STONE = Tissue("stone", 2600, 3.5, 1.0, 0.5, 0.3, 0.3)
PROBES = {
    "linear": LinearProbe(24, 30, scan_lines=48, frequency_mhz=5),
    "convex": ConvexProbe(20, 60, 30, scan_lines=48, frequency_mhz=4),
    "phased": PhasedProbe(70, 30, scan_lines=48, frequency_mhz=5),
}


def scene(membrane: bool = True):
    """(labels, tissues): brain with a cyst and a stone in it, in fluid."""

    def label(x, y, z):
        brain = np.where(np.hypot(x, np.hypot(y - 14, z)) < 17, 1, 0)
        brain = np.where(np.hypot(x + 5, np.hypot(y - 10, z)) < 4, 2, brain)
        return np.where(np.hypot(x - 7, np.hypot(y - 16, z)) < 3, 3, brain)

    tissues = {0: FLUID, 1: BRAIN, 2: FLUID, 3: STONE}
    skin = Membrane(Tissue("pia", 1546, 1.60, 0.6, 0.9, 0.0, 0.5), 1.0, ("fluid",)) if membrane else None
    return block(label, half_mm=(22, 34, 12)), TissueTable(tissues, membrane=skin)


@pytest.mark.parametrize("kind", PROBES)
@pytest.mark.parametrize(
    "turn",
    [np.eye(3), pytest.param([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]], marks=pytest.mark.slow)],
)
def test_the_kernels_draw_what_numpy_draws(kind, turn):
    labels, tissues = scene()
    simulator = UltrasoundSimulator(labels, tissues)
    pose, display = rigid(turn, [1.0, -4.0, 0.5]), DisplaySettings(noise_db=-30.0, image_size=(240, 200))
    seed = seed_of_pose(pose)
    image = simulator.simulate(PROBES[kind], pose, display, noise_seed=seed).image
    model = NumpyModel(simulator)
    difference = np.abs(image.astype(int) - model.simulate(PROBES[kind], pose, display, noise_seed=seed))
    assert image.max() > 100
    assert (difference <= 1).mean() > 0.97  # a ray that just grazes a voxel may go the other way: a line of 48
    assert set(model.timings_ms) == {
        "ray tree", "scatterers", "interfaces", "beam", "pulse", "B-mode", "scan conversion"
    }  # fmt: skip


@pytest.mark.parametrize(
    "settings",
    [
        SimulationSettings(scattering=False, reflection_spreading=False),
        pytest.param(SimulationSettings(interfaces=False, seed=7, scatterers_per_mm3=10), marks=pytest.mark.slow),
        SimulationSettings(interface_reflection="energy", max_ray_depth=2, reference_speed_m_s=1480),
    ],
)
def test_numpy_follows_the_settings(settings):
    labels, tissues = scene(membrane=False)
    simulator = UltrasoundSimulator(labels, tissues, settings)
    pose = rigid(np.eye(3), [0.0, -4.0, 0.0])
    frame = simulator.simulate(PROBES["convex"], pose)
    difference = np.abs(frame.image.astype(int) - NumpyModel(simulator).simulate(PROBES["convex"], pose))
    assert (difference <= 1).mean() > 0.99


def test_every_device_of_this_computer_draws_the_same_image():
    devices = list_devices()
    if len(devices) < 2:
        pytest.skip("one OpenCL device only")
    labels, tissues = scene()
    pose = rigid(np.eye(3), [0.0, -4.0, 0.0])
    images = [UltrasoundSimulator(labels, tissues, device=info).simulate(PROBES["phased"], pose).image
              for info in devices]  # fmt: skip
    for image in images[1:]:
        assert (np.abs(image.astype(int) - images[0]) <= 1).mean() >= 0.999


def test_numpy_has_no_texture_and_says_so():
    labels, tissues = scene()
    simulator = UltrasoundSimulator(labels, tissues)
    simulator.settings = SimulationSettings(mri_modulation_db=2.0)
    with pytest.raises(SimulationError, match="expected partial_volume and mri_modulation_db 0"):
        NumpyModel(simulator)
