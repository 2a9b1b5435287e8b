"""Fit and predict (fitting/held_out.py): images that were not fitted, beside a uniform tissue and real neighbours."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from SlicerUSSim.Logic import (
    ConvexProbe,
    DisplaySettings,
    SimulationError,
    SimulationSettings,
    TissueTable,
    TrackedSequence,
    UltrasoundSimulator,
)
from SlicerUSSim.Logic.fitting import fit, neighbours_of, predict
from SlicerUSSim.Logic.fitting.registration import Registration, rigid_from
from SlicerUSSim.Logic.probe import ImageGrid, tilt_sweep
from SlicerUSSim.Logic.tracked import TrackedImages
from tests.conftest import block, rigid

PROBE = ConvexProbe(12.0, 70.0, 40.0, scan_lines=80)
LABELS = block(lambda x, y, z: 1 + (np.hypot(x - 3.0, y + 2.0) < 11.0), half_mm=(36, 32, 12))
TISSUES = TissueTable.named(["white matter", "csf"])
PLAIN = DisplaySettings(gain_db=4.0, noise_db=None, image_size=(140, 154))
FREE = ["gain_db", "tissues"]


def simulator(seed: int) -> UltrasoundSimulator:
    return UltrasoundSimulator(LABELS, TISSUES, SimulationSettings(seed=seed, ring_down=False))


@pytest.fixture(scope="module")
def recording():
    poses = tilt_sweep(rigid(np.eye(3), [0.0, -24.0, 0.0]), 8.0, 5)
    frames = [simulator(11).simulate(PROBE, pose, PLAIN) for pose in poses]
    to_probe = ImageGrid.for_probe(PROBE, PLAIN.image_size).image_to_probe
    transforms = tuple({"ImageToProbe": to_probe, "ProbeToReference": pose} for pose in poses)
    sequence = TrackedSequence(np.stack([frame.image for frame in frames]), transforms, np.arange(5.0))
    return sequence, TrackedImages.of(sequence, probe=PROBE)


@pytest.fixture(scope="module")
def found(recording):
    fitted, _ = recording[1].split([1, 3, 4])
    return fit(simulator(2), fitted, free=FREE, display=PLAIN, max_evaluations=40, restarts=0)


def test_the_tissues_predict_what_one_tissue_cannot(recording, found):
    sequence, images = recording
    others = images.only([1, 4])
    near = [neighbours_of(sequence, of) for of in (others, found.tracked)]
    made = predict(
        found, simulator(2), others, free=FREE, display=PLAIN, neighbours=near[0], fitted_neighbours=near[1],
        max_evaluations=40,
    )  # fmt: skip
    assert made.fitted_numbers == [0, 2] and made.numbers == [1, 4]
    assert made.of_uniform < 0.8
    assert made.mean("real neighbours") < made.mean("simulated") < made.mean("uniform tissue")
    assert made.mean("simulated", fitted=True) < made.mean("uniform tissue", fitted=True)
    assert [len(made.predicted[name]) for name in made.predicted] == [2, 2, 3]  # image 4 is the last: one neighbour
    assert made.mean("simulated", "sum") > made.mean("simulated")
    written = json.loads(json.dumps(made.to_dict(), allow_nan=False))
    assert written["of_uniform"] == pytest.approx(made.of_uniform)
    assert any("fitted: images 0, 2   predicted: images 1, 4" in line for line in made.lines())
    # The control has no anatomy: levels to the left and right of the ball's middle agree with the same depths
    image = made.images["uniform tissue"][0].astype(float)
    assert abs(image[42:84, 42:70].mean() - image[42:84, 84:112].mean()) < 12.0


def test_a_registration_moves_the_predicted_images_too(recording, found):
    others = recording[1].only([1])
    moved = Registration.none(found.tracked.poses)
    away = replace(found, registration=replace(moved, correction=rigid_from([0.0, 0.0, 0.0, 0.0, 0.0, 180.0])))
    same = replace(found, registration=moved)
    options = {"free": ["gain_db"], "display": PLAIN, "max_evaluations": 5}
    here, there = (predict(one, simulator(2), others, **options) for one in (same, away))
    assert there.mean("simulated") > 1.2 * here.mean("simulated")
    assert np.isnan(here.mean("real neighbours"))  # none were given


def test_what_was_fitted_is_not_predicted(recording, found):
    with pytest.raises(SimulationError, match="images 2 are fitted and predicted"):
        predict(found, simulator(2), recording[1].only([2, 3]), free=FREE)
    with pytest.raises(SimulationError, match="images 9 are not among 0, 1, 2, 3, 4"):
        recording[1].only([9])
    with pytest.raises(SimulationError, match="all images are predicted"):
        recording[1].split(range(5))
