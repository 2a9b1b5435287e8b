"""Which parameters "tissues" stands for in a fit: those that the images can show."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from SlicerUSSim.Logic import TissueTable, UltrasoundSimulator, Volume
from SlicerUSSim.Logic.fitting.tracked_fit import parameters_seen, shares
from SlicerUSSim.Logic.probe import PROBES, ImageGrid
from SlicerUSSim.Logic.tissue import Surfels
from tests.conftest import rigid

PROBE = replace(PROBES["linear"], width_mm=30.0, depth_mm=40.0)


@pytest.fixture(scope="module")
def patient():
    """Grey matter above white matter, 20 mm each under the probe, a speck of tumour, and a falx beyond the field."""
    array = np.full((60, 60, 60), 3, np.uint8)  # (k, j, i), 1 mm; the probe looks along j
    array[:, :30] = 2
    array[:, 34:36, 29:32] = 4
    array[:, :, :8] = 5
    names = ("csf", "grey matter", "white matter", "tumour", "falx")
    table = TissueTable.named(names).with_membrane(TissueTable.brain().membrane)
    simulator = UltrasoundSimulator(Volume(array, np.eye(4)), table)
    grid = ImageGrid.for_probe(PROBE, (200, 150))
    tracked = SimpleNamespace(
        poses=[rigid(np.eye(3), [29.5, 9.5, 30.0])], grid=grid, mask=grid.field(PROBE), probe=PROBE
    )
    return simulator, tracked


def test_shares_are_those_of_the_imaged_field(patient):
    found = shares(*patient)
    assert found["grey matter"] == pytest.approx(0.5, abs=0.02) and found["falx"] == found["csf"] == 0.0
    assert found["tumour"] == pytest.approx(2 * 3 / (30 * 40), abs=0.002)


def test_only_what_the_images_show_is_free(patient):
    names = list(parameters_seen(["display", "tissues"], *patient))
    assert names == [
        "display", "grey matter.echogenicity_db", "grey matter.attenuation_db_cm_mhz", "white matter.echogenicity_db",
        "white matter.attenuation_db_cm_mhz", "tumour.echogenicity_db", "leptomeninges.echogenicity_db",
    ]  # fmt: skip


@pytest.mark.parametrize(("aside_mm", "is_free"), [(0.0, True), (9.0, False)])
def test_the_dura_that_was_found_in_an_image_is_free(patient, aside_mm, is_free):
    simulator, tracked = patient
    x, y = (values.ravel() for values in np.meshgrid(np.arange(20.0, 40.0), np.arange(15.0, 30.0)))
    place = np.stack([x, y, np.full_like(x, 30.0 + aside_mm)], axis=1)
    falx = Surfels.of("falx", place, np.broadcast_to(np.array([0.0, 1.0, 0.0]), place.shape), 0.5, 1.0, 1.0)
    drawn = UltrasoundSimulator(simulator.medium.labels, simulator.medium.tissues, sheets=falx)
    names = set(parameters_seen(["tissues"], drawn, tracked)) - set(parameters_seen(["tissues"], *patient))
    assert names == ({"falx.echogenicity_db"} if is_free else set())


def test_other_names_and_their_bounds_stay(patient):
    free = {"gain_db": (-3.0, 3.0), "falx": None}
    assert parameters_seen(free, *patient) == free
