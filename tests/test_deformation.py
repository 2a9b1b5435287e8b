"""Smooth deformation of the tissues (fitting/deformation.py): what it moves, what it finds, what it costs."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from SlicerUSSim.Logic import (
    ConvexProbe,
    DisplaySettings,
    SimulationSettings,
    TissueTable,
    TrackedSequence,
    UltrasoundSimulator,
    Volume,
)
from SlicerUSSim.Logic.fitting import fit
from SlicerUSSim.Logic.fitting.deformation import Deformation, basis, deformed, find_deformation, gradients
from SlicerUSSim.Logic.probe import ImageGrid, tilt_sweep
from SlicerUSSim.Logic.tissue.surfels import Surfels
from SlicerUSSim.Logic.tissue.texture import Texture
from SlicerUSSim.Logic.tracked import TrackedImages
from tests.conftest import block, rigid

PROBE = ConvexProbe(12.0, 70.0, 40.0, scan_lines=120)
TISSUES = TissueTable.named(["white matter", "csf"])
PLAIN = DisplaySettings(gain_db=4.0, noise_db=None, image_size=(200, 220))
LOW, HIGH = np.array([-20.0, 0.0]), np.array([20.0, 40.0])


def labels(shift_mm: float = 0.0) -> Volume:
    return block(lambda x, y, z: 1 + (np.hypot(x - 3.0 - shift_mm, y + 2.0) < 9.0), half_mm=(36, 32, 12))


def simulator(volume: Volume, seed: int) -> UltrasoundSimulator:
    return UltrasoundSimulator(volume, TISSUES, SimulationSettings(seed=seed, ring_down=False))


def tracked_on(volume: Volume) -> TrackedImages:
    poses = tilt_sweep(rigid(np.eye(3), [0.0, -24.0, 0.0]), 4.0, 2)
    frames = [simulator(volume, 11).simulate(PROBE, pose, PLAIN) for pose in poses]
    to_probe = ImageGrid.for_probe(PROBE, PLAIN.image_size).image_to_probe
    transforms = tuple({"ImageToProbe": to_probe, "ProbeToReference": pose} for pose in poses)
    sequence = TrackedSequence(np.stack([frame.image for frame in frames]), transforms, np.arange(2.0))
    return TrackedImages.of(sequence, probe=PROBE)


def test_the_basis_is_a_partition_of_unity_and_goes_on_beyond_its_ends():
    points = np.random.default_rng(0).uniform(-60.0, 80.0, (200, 2))
    weights = basis(points, LOW, HIGH, (5, 4))
    assert np.allclose(weights.sum(axis=1), 1.0) and weights.min() > -1e-9
    edge = basis(np.clip(points, LOW, HIGH), LOW, HIGH, (5, 4))
    np.testing.assert_allclose(weights, edge, atol=1e-9)


def test_the_gradient_of_a_linear_displacement_is_its_slope():
    ends = np.linspace(0.0, 1.0, 4)  # the control points of a linear function with four of them
    control = np.zeros((4, 4, 2))
    control[..., 0] = 0.1 * (LOW[0] + ends * (HIGH[0] - LOW[0]))[None, :]
    control[..., 1] = -0.05 * (LOW[1] + ends * (HIGH[1] - LOW[1]))[:, None]
    field = Deformation(np.eye(4), LOW, HIGH, control)
    assert field.bending == pytest.approx(0.1**2 + 0.05**2, rel=1e-3)
    x, y = (matrix @ control.reshape(-1, 2) for matrix in gradients(LOW, HIGH, (4, 4)))
    np.testing.assert_allclose(x, [[0.1, 0.0]] * len(x), atol=1e-6)
    np.testing.assert_allclose(y, [[0.0, -0.05]] * len(y), atol=1e-6)
    assert json.loads(json.dumps(field.to_dict() | {"cost_before": None, "cost_after": None}, allow_nan=False))


def test_labels_texture_and_sheets_move_together():
    """A constant displacement of 4 mm along x brings what lay at x + 4 mm to x."""
    volume = labels()
    share = np.random.default_rng(0).random(volume.array.shape).astype(np.float32)
    texture = Texture((3 - volume.array).astype(np.uint8), 0.5 * share, share, 0.5 * share)
    sheet = Surfels.of("falx", [[5.0, 3.0, 1.0]], [[1.0, 0.0, 0.0]], 1.0, 1.0, 1.0)
    made = UltrasoundSimulator(volume, TISSUES, SimulationSettings(), texture=texture, sheets=sheet)
    turned = rigid([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], [0.0, 0.0, 0.0])  # its y axis is along x
    control = np.zeros((4, 4, 2))
    control[..., 1] = 4.0
    found = deformed(made, Deformation(turned, LOW, HIGH, control))
    ahead = found.medium.labels.array
    np.testing.assert_array_equal(ahead[:, :, :-4], volume.array[:, :, 4:])
    assert found.texture is not None and found.medium.sheets is not None
    for name, array in vars(texture).items():
        np.testing.assert_array_equal(getattr(found.texture, name)[:, :, :-4], array[:, :, 4:])
    np.testing.assert_allclose(found.medium.sheets.place, [[1.0, 3.0, 1.0]], atol=1e-4)
    np.testing.assert_array_equal(made.medium.labels.array, volume.array)


@pytest.mark.slow
def test_a_displaced_ball_is_found_again_and_a_true_one_is_left_alone():
    tracked = tracked_on(labels(4.0))
    found, patient = find_deformation(simulator(labels(), 2), tracked, PLAIN)
    middle = np.array([[7.0, -2.0, 0.0]])  # of the true ball; its tissue lies 4 mm less far in the labels
    assert found.at(middle)[0, 0] == pytest.approx(-4.0, abs=1.2)
    assert abs(found.at(middle)[0, 1]) < 1.2
    assert found.cost_after < found.cost_before - 0.01
    there = patient.medium.labels
    i = np.nonzero(there.array == 2)[2]
    assert there.ijk_to_ras[0, 0] * i.mean() + there.ijk_to_ras[0, 3] == pytest.approx(7.0, abs=1.2)
    assert 0.5 < found.mean_mm < found.largest_mm < 8.5
    same, patient = find_deformation(right := simulator(labels(4.0), 2), tracked, PLAIN)
    assert patient is right or same.largest_mm < 1.5
    assert same.cost_after <= same.cost_before


@pytest.mark.slow
def test_a_fit_deforms_before_it_fits_and_says_so(caplog):
    tracked, made = tracked_on(labels(4.0)), simulator(labels(), 2)
    free = ["gain_db"]
    plain = fit(made, tracked, free=free, display=replace(PLAIN, gain_db=0.0), max_evaluations=60, restarts=0)
    found = fit(
        made, tracked, free=free, display=replace(PLAIN, gain_db=0.0), max_evaluations=60, restarts=0, deform=True
    )
    assert "short fit, of 60 evaluations in all, expected at least 300" in caplog.text
    assert found.deformation is not None and found.simulator is not None
    assert plain.deformation is None and plain.simulator is None
    assert found.appearance.cost_after < plain.appearance.cost_after - 0.01
    assert found.appearance.cost_before == pytest.approx(plain.appearance.cost_before, abs=1e-3)
    assert found.to_dict()["deformation"]["largest_mm"] == found.deformation.largest_mm > 2.0
    np.testing.assert_array_equal(made.medium.labels.array, labels().array)
