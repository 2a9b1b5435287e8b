"""Thin sheets of the membrane's own tissue, as planes fitted to their voxels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic import (
    LinearProbe,
    Membrane,
    SimulationSettings,
    Tissue,
    TissueTable,
    UltrasoundSimulator,
    Volume,
)
from SlicerUSSim.Logic.imaging.labelled_sheets import sheet_planes
from SlicerUSSim.Logic.opencl.device import Device
from SlicerUSSim.Logic.tissue.presets import TISSUES
from tests.conftest import block, rigid

SHEET = 2


def planes_of(labels: np.ndarray, spacing_mm=(1.0, 1.0, 1.0)):
    """(gradients (k, j, i, 3) of length 1, distances in voxels, labels beside, flat indices of thin voxels)."""
    device = Device.get()
    buffer, points = sheet_planes(device, labels, SHEET, np.array(spacing_mm))
    shape = labels.shape if len(points) else (1, 1, 1)
    packed = device.download(buffer, shape, np.uint32).astype(np.int64)
    u, v = ((packed >> shift & 511) / 255.0 - 256.0 / 255.0 for shift in (0, 9))
    z = 1.0 - abs(u) - abs(v)
    folded = np.maximum(-z, 0.0)
    gradient = np.stack([u - np.copysign(folded, u), v - np.copysign(folded, v), z], axis=-1)
    gradient /= np.linalg.norm(gradient, axis=-1, keepdims=True)
    return np.where(packed[..., None] > 0, gradient, 0.0), ((packed >> 18 & 255) - 128) / 64.0, packed >> 26, points


def slab(normal, spacing_mm, thickness_mm: float, half: int = 16) -> np.ndarray:
    """(k, j, i) labels: a layer through the middle, 1 on one side of it and 3 on the other."""
    k, j, i = np.meshgrid(*[np.arange(-half, half + 1)] * 3, indexing="ij")
    away = sum(n * x * mm for n, x, mm in zip(normal, (i, j, k), spacing_mm, strict=True))
    return np.where(abs(away) < 0.5 * thickness_mm, SHEET, np.where(away > 0.0, 3, 1)).astype(np.uint8)


@pytest.mark.parametrize("spacing_mm", [(0.5, 0.5, 0.5), (0.8, 1.0, 1.3)])
@pytest.mark.parametrize("across", [(0, 0, 1), (1, 2, 4), (-3, 1, 2)])
def test_a_plane_is_fitted_to_a_flat_sheet(spacing_mm, across):
    """Of gradients in voxels, which are not the normals in millimetres where voxels are not cubes."""
    normal = np.array(across) / np.linalg.norm(across)
    labels = slab(normal, spacing_mm, 1.5 * np.mean(spacing_mm))
    gradient, distance, beside, points = planes_of(labels, spacing_mm)
    inside = np.zeros(labels.shape, bool)
    inside[6:-6, 6:-6, 6:-6] = True
    at = np.unravel_index(points, labels.shape)
    at = tuple(index[inside[at]] for index in at)
    found = gradient[at] / spacing_mm
    cosine = abs(found @ normal) / np.linalg.norm(found, axis=1)
    assert np.degrees(np.arccos(np.clip(cosine, 0.0, 1.0))).max() < 4.5
    expected = -sum(n * (x - 16) * mm for n, x, mm in zip(normal, at[::-1], spacing_mm, strict=True))
    off = distance[at] / np.linalg.norm(found, axis=1) * np.sign(found @ normal) - expected
    assert np.abs(off).max() < 0.35 * np.mean(spacing_mm)
    assert set(np.unique(beside[at])) <= {1, 3}


def test_what_is_not_a_sheet_has_no_plane():
    labels = np.ones((40, 40, 40), np.uint8)
    labels[5, 5, 5] = SHEET
    labels[10, 10, 5:35] = SHEET
    labels[20:26, 5:35, 5:35] = SHEET  # thick
    gradient, _, _, points = planes_of(labels)
    assert not gradient.any()
    assert set(points) == set(np.flatnonzero((labels == SHEET) & (np.arange(40)[:, None, None] < 15)))
    assert not len(planes_of(np.ones((8, 8, 8), np.uint8))[3])


def test_voxels_beside_a_sheet_have_its_plane():
    labels = slab((0.0, 0.0, 1.0), (1.0, 1.0, 1.0), 1.0)
    gradient, distance, _, _ = planes_of(labels)
    assert gradient[15:18, 16, 16].any(axis=-1).all() and not gradient[[13, 14, 18, 19], 16, 16].any()
    np.testing.assert_allclose(distance[15:18, 16, 16] * gradient[15:18, 16, 16, 2], [1.0, 0.0, -1.0], atol=0.02)


@pytest.mark.parametrize(("spacing_mm", "turn"), [(0.5, (25, 35)), (1.0, (0, 0))])
def test_a_thin_sulcus_along_the_beam_is_not_brighter_than_the_brain(spacing_mm, turn):
    """As its own tissue it was 9 to 15 dB brighter, whatever the angle."""
    half = round(22 / spacing_mm)
    turned = Rotation.from_euler("xz", turn, degrees=True).as_matrix()
    k, j, i = np.meshgrid(*[np.arange(-half, half + 1)] * 3, indexing="ij")
    away = turned[1, 0] * i + turned[1, 1] * j + turned[1, 2] * k  # along y of the patient, voxels
    matrix = rigid(turned, [-half * spacing_mm] * 3)
    matrix[:3, :3] *= spacing_mm
    labels = Volume(np.where(abs(away) < 0.75, 2, 1).astype(np.uint8), matrix)
    grey, pia = (replace(TISSUES[n], attenuation_db_cm_mhz=0.0) for n in ("grey matter", "leptomeninges"))
    sheet = Membrane(pia, diffuse_exponent=4.0)  # at 80 degrees nothing is left of it
    simulator = UltrasoundSimulator(
        labels, TissueTable({0: grey, 1: grey, 2: pia}, sheet), SimulationSettings(ring_down=False)
    )
    probe = LinearProbe(20, 30, scan_lines=81, frequency_mhz=5.0, focus_mm=15, elevation_focus_mm=15)
    levels = []
    for angle in (0.0, 80.0):
        rotation = Rotation.from_euler("z", angle, degrees=True).as_matrix()
        power = np.abs(simulator.simulate(probe, rigid(rotation, [0, -15, 0])).iq) ** 2
        y = (np.arange(power.shape[1]) + 0.5) * 30.0 / power.shape[1] - 15.0
        x = probe.line_positions()[:, None]
        near = abs(np.sin(np.radians(angle)) * x + np.cos(np.radians(angle)) * y) < 0.3
        near &= (abs(x) < 8.0) & (abs(y) < 8.0)
        levels.append(10.0 * np.log10(power[near].mean() / grey.scatterer_variance))
    assert levels[0] > 20.0 and levels[1] < 1.0


def test_a_sheet_at_the_ends_of_the_volume_and_an_isolated_voxel():
    """No plane is read or written beyond the volume; a voxel outside sheets keeps its tissue."""
    silent = Tissue("silent", 1540.0, 1.54, 0.0)
    bright = Tissue("pia", 1540.0, 1.54, 0.0, mu0=1.0, sigma0=0.5)
    labels = block(lambda x, y, z: np.where((abs(y) > 9.5) | (abs(x) + abs(y) + abs(z) < 0.5), 2, 1), (10, 10, 10))
    table = TissueTable({0: silent, 1: silent, 2: bright}, Membrane(bright, 0.4, ("pia",), diffuse_db=0.0))
    simulator = UltrasoundSimulator(labels, table, SimulationSettings(ring_down=False, side_lobes=False))
    probe = LinearProbe(16, 30, scan_lines=41, focus_mm=15, elevation_focus_mm=15)
    power = (np.abs(simulator.simulate(probe, rigid(np.eye(3), [0, -15, 0])).iq) ** 2).mean(axis=0)
    depth = (np.arange(len(power)) + 0.5) * 30.0 / len(power)
    at = [power[abs(depth - mm) < 1.5].max() for mm in (5.0, 15.0, 25.0, 10.0, 20.0)]
    assert min(at[:3]) > 1e4 * max(at[3:])
