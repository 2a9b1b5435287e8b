"""Kernels of single stages against short references in numpy, and the devices of this computer against each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage, special

from SlicerUSSim.Logic import (
    ConvexProbe,
    LinearProbe,
    PhasedProbe,
    SimulationSettings,
    Texture,
    Tissue,
    TissueTable,
    UltrasoundSimulator,
    Volume,
    list_devices,
)
from SlicerUSSim.Logic.imaging.bmode import pulse_taps
from SlicerUSSim.Logic.opencl.layout import CONSTANTS
from SlicerUSSim.Logic.tissue.tissue import Membrane
from tests.conftest import block, even_display, rigid
from tests.reference import lines as reference
from tests.reference.display import envelope_of, image_of
from tests.reference.elementary import hash_mix
from tests.reference.scatterers import scatterer_lines

FLUID = Tissue("fluid", 1520, 1.52, 0.0, 0.0, 0.0, 0.0)
BRAIN = Tissue("brain", 1546, 1.60, 1.2, 0.3, 0.0, 0.15)
STONE = Tissue("stone", 2600, 3.5, 1.0, 0.5, 0.3, 0.3)
SPOTTED = replace(BRAIN, name="spotted", texture_db=4.0, texture_mm=0.7, specks_per_mm3=0.05, speck_db=12.0)
LINEAR = LinearProbe(12, 24, scan_lines=24, frequency_mhz=5)
PROBES = {
    "linear": LINEAR,
    "convex": ConvexProbe(20, 40, 24, scan_lines=24, frequency_mhz=4),
    "phased": PhasedProbe(50, 24, scan_lines=24, frequency_mhz=5),
    "zones": replace(LINEAR, transmit="zones", focal_zones=3),
    "angles": PhasedProbe(35, 24, scan_lines=24, transmit="angles", transmit_angles=7),
    "trapezoid": replace(LINEAR, trapezoid_deg=20.0),
    "steered harmonic": replace(LINEAR, harmonic=True, frequency_mhz=2.5, steering_deg=-20.0),
}
TURNED = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])


def scene(spacing_mm=1.0):
    """(labels, tissues): brain in fluid, with a cyst, a stone, and uneven tissue on one side."""

    def label(x, y, z):
        brain = np.where(np.hypot(x, np.hypot(y - 14, z)) < 17, 1 + 3 * (z > 1), 0)
        brain = np.where(np.hypot(x + 5, np.hypot(y - 10, z)) < 4, 2, brain)
        return np.where(np.hypot(x - 7, np.hypot(y - 16, z)) < 3, 3, brain)

    return block(label, (22, 34, 12), spacing_mm), TissueTable(dict(enumerate([FLUID, BRAIN, FLUID, STONE, SPOTTED])))


def off(found: np.ndarray, expected: np.ndarray) -> float:
    """The mean over depths, in steps of 64 samples, of the difference relative to the expected (60 dB at most)."""
    error, power = ((np.abs(x) ** 2).reshape(len(x), -1, 64).sum(axis=(0, 2)) for x in (found - expected, expected))
    return float(np.sqrt(error / np.maximum(power, 1e-6 * power.max())).mean())


@pytest.mark.parametrize("turn", [np.eye(3), pytest.param(TURNED, marks=pytest.mark.slow)], ids=["aligned", "turned"])
@pytest.mark.parametrize("kind", PROBES)
def test_stages_do_what_their_references_do_with_the_same_inputs(kind, turn):
    probe, pose = PROBES[kind], rigid(turn, [1.0, -4.0, 0.5])
    display = even_display(noise_db=-30.0, tgc_reach=0.6, image_size=(240, 200))
    settings = SimulationSettings(side_lobes=False, interfaces=False, scatterers_per_mm3=5.0, seed=5)
    made = UltrasoundSimulator(*scene(), settings)
    frame = made.device_frame(probe, pose, display, noise_seed=77)
    record, download = frame.acquisition, made.device.download
    lines, samples = frame.line_shape

    def impulses(echoes, count: int) -> np.ndarray:
        re, im = (download(part, (count, echoes.stride), np.float32) for part in (echoes.re, echoes.im))
        return (re + 1j * im)[:, CONSTANTS["LINE_PAD"] :][:, :samples]

    for stage in made.impulse_stages:
        stage.run(frame)
    tree, traced = made.tracer.download(), impulses(frame.traced, 2 * int(record["traced_lines"]))
    at = np.rint(tree.segment_line * int(record["lateral_rays"]) + int(record["guard_lines"])).astype(int)
    labels = np.pad(made.medium.labels.array, 1, mode="edge")
    # Where the kernel's gains are linear along pieces of paths, and single scatterers lie between two strips
    most = 0.04 if kind == "angles" else 0.015
    assert off(traced, scatterer_lines(record, probe.lens(), labels, made.medium.rows, tree.segments, at)) < most

    losses = download(frame.losses, (lines, samples // CONSTANTS["LOSS_STEP"] + 1, 3), np.float32)
    nodes = np.arange(losses.shape[1]) * CONSTANTS["LOSS_STEP"]
    frequencies = np.array([np.interp(np.arange(samples), nodes, line[:, 2]) for line in losses.astype(float)])
    spreads = download(frame.spreads, (int(record["screen_lines"]), int(record["screen_depths"]), 2), np.float32)
    beam, *others = made.linear_stages
    beam.run(frame)
    scanned = impulses(frame.scanned, lines)
    assert off(scanned, reference.lateral_beam(record, traced, spreads, frequencies)) < 0.004
    for stage in others:
        stage.run(frame)
    iq = frame.download("iq")
    assert off(iq, reference.baseband(frame, scanned, frequencies)) < 1e-4 and frequencies.min() < 0.95

    for stage in made.display_stages:
        stage.run(frame)
    np.testing.assert_allclose(frame.download("envelope"), envelope_of(frame, iq), rtol=1e-4)
    image = frame.download("image")
    assert (np.abs(image.astype(int) - image_of(frame, iq)) <= 1).mean() > 0.999 and image.max() > 80


@pytest.mark.parametrize("sigma", [0.3, 0.7, 2.0, 11.5])
def test_the_pulse_follows_from_the_equations(sigma):
    np.testing.assert_allclose(pulse_taps(sigma), reference.pulse_taps(sigma), rtol=1e-5)


def test_the_record_of_a_frame_follows_from_the_equations():
    probe = ConvexProbe(
        60.0, 64.0, 120.0, scan_lines=65, frequency_mhz=3.5, fractional_bandwidth=0.63, focus_mm=31.0, aperture_mm=15.5,
        elevation_aperture_mm=12.0, elevation_focus_mm=60.0, receive_f_number=1.5,
    )  # fmt: skip
    settings = SimulationSettings(
        seed=77, reference_speed_m_s=1480, samples_per_cycle=6, interface_gain_db=31, scatterers_per_mm3=99
    )
    pose = rigid(TURNED, [1.0, -4.0, 0.5])
    made = UltrasoundSimulator(*scene(), settings)
    record = made.acquisition(probe, pose)
    fwhm, wavelength = np.sqrt(8.0 * np.log(2.0)), 1.54 / 3.5
    per_f_number, axial = 1.21 * wavelength / fwhm, 1.48 * fwhm / (4.0 * np.pi * 0.63 * 3.5)
    transmit, elevation = 2.0 * per_f_number, 5.0 * per_f_number
    expected = {
        "probe_to_ras": pose[:3].ravel(),
        "ras_to_voxel": np.linalg.inv(made.medium.labels.ijk_to_ras)[:3].ravel() + np.tile([0, 0, 0, 1], 3),
        "dims": np.array(made.medium.labels.array.shape[::-1]) + 2,
        "first_line": -np.radians(32.0), "line_spacing": np.radians(1.0), "apex_radius_mm": 60.0,
        "cycles_per_mm": 7.0 / 1.48, "sample_mm": 1.48 / 42.0, "traced_lines": 64 * record["lateral_rays"] + 1
        + 2 * record["guard_lines"],
        "transmit_sigma": [transmit, *[0.0] * 7], "transmit_focus": [31.0, *[0.0] * 7],
        "transmit_rayleigh": [2.0 * np.pi * transmit**2 / wavelength, *[0.0] * 7],
        "receive_sigma_min": 1.5 * per_f_number, "receive_sigma_slope": per_f_number / 15.5,
        "elevation_focus": 60.0,
        "elevation_rayleigh": 2.0 * np.pi * elevation**2 / wavelength,
        "cell_mm": 99.0 ** (-1.0 / 3.0), "speckle_scale": (99.0 * np.pi**1.5 * axial) ** -0.5,
        "seed": hash_mix(np.array([77], np.uint32))[0] ^ np.uint32(0x2545F491),
        "interface_gain": 10.0 ** (31.0 / 20.0), "downshift": (0.63 / fwhm) ** 2,
        "band_above": np.log(special.erfc(-fwhm / 0.63)),
    }  # fmt: skip
    for name, value in expected.items():
        np.testing.assert_allclose(record[name], value, rtol=1e-5, atol=1e-5, err_msg=name)
    assert made.device_frame(probe, pose).axial_sigma_mm == pytest.approx(axial)


@pytest.mark.parametrize("has_shares", [False, True])
def test_the_medium_has_groups_smoothed_shares_and_the_fluid_distance(has_shares):
    """In voxels that are not cubes, where no border of fluid is flattened."""
    labels, tissues = scene()
    labels = Volume(labels.array, labels.ijk_to_ras @ np.diag([1.0, 1.0, 1.3, 1.0]))
    tissues = TissueTable(tissues, membrane=Membrane(BRAIN, 0.8, ("fluid",)))
    group_of, texture = np.array([0, 1, 0, 2, 1]), None  # of labels, the most frequent first
    padded = np.pad(labels.array, 1, mode="edge")
    second, part = padded, np.zeros(padded.shape)
    if has_shares:
        rng, shape = np.random.default_rng(0), labels.array.shape
        nothing, share = np.zeros(shape, np.float32), rng.uniform(0.0, 0.5, shape).astype(np.float32)
        texture = Texture(rng.integers(0, 5, shape).astype(np.uint8), nothing, nothing, share)
        second, part = (np.pad(values, 1, mode="edge") for values in texture.membership())
        part = part / 255.0
    found = UltrasoundSimulator(labels, tissues, texture=texture).medium
    download = found.device.download
    voxels = download(found.voxel_buffer, padded.shape, np.uint16)
    assert np.array_equal(voxels & CONSTANTS["LABEL_MASK"], padded)
    groups = download(found.group_buffer, padded.shape, np.uint8) & CONSTANTS["GROUP_MASK"]
    assert np.array_equal(groups, group_of[padded])
    smooth = download(found.smooth_buffer, (found.smooth_groups, *padded.shape), np.uint16)
    for number in range(3):
        member = (1.0 - part) * (group_of[padded] == number) + part * (group_of[second] == number)
        expected = 65535.0 * ndimage.gaussian_filter(member, 3.0, mode="nearest", truncate=2.5)
        assert np.abs(smooth[number] - expected).max() < 2.5
    sigma_mm = 0.75 * np.prod(labels.spacing_mm) ** (1.0 / 3.0)
    fluid = np.isin(padded, (0, 2)).astype(float)
    share = ndimage.gaussian_filter(fluid, sigma_mm / labels.spacing_mm[::-1], mode="nearest", truncate=3.0)
    distance = 127.5 + 127.5 / 2.2 * np.clip(special.ndtri(np.clip(share, 0.0, 1.0)), -2.2, 2.2)
    assert np.abs((voxels >> 8) - distance)[2:-2, 2:-2, 2:-2].max() < 1.1
    assert found.membrane_reach == pytest.approx(0.4 / sigma_mm * 127.5 / 2.2)
    brain, fluids = found.rows[1], found.rows["is_fluid"][:5]
    assert brain["scatterer_share"] == pytest.approx(special.ndtr(-BRAIN.mu1)) and list(fluids) == [1, 0, 1, 0, 0]


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
