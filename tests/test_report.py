"""What the report of a fit is drawn from: the grey levels of every tissue, where the labels have it."""

from __future__ import annotations

import numpy as np
import pytest

from SlicerUSSim.Logic import LinearProbe
from SlicerUSSim.Logic.fitting.report import grey_levels_per_tissue
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.tracked.imaged_field import ImagedField
from SlicerUSSim.Logic.tracked.images import TrackedImages
from tests.conftest import FLUID, SPECKLE, block, rigid, simulator

PROBE = LinearProbe(20, 30, scan_lines=16)
POSES = [rigid(np.eye(3), [0, -15, z]) for z in (-3, 3)]


def tracked(mask=None) -> TrackedImages:
    grid = ImageGrid.for_probe(PROBE, (60, 40))
    field = ImagedField.of(PROBE, grid.image_to_probe, (grid.rows, grid.columns))
    images = [np.zeros((grid.rows, grid.columns), np.uint8)] * 2
    return TrackedImages(PROBE, POSES, images, grid, field.mask if mask is None else mask, [0, 1], field)


def test_pixels_go_to_the_tissue_that_lies_under_them():
    """The coupling (label 0) is left out, as are pixels outside the field."""
    quiet = simulator(block(lambda x, y, z: np.where(x < 0, 1, np.where(y < 5, 2, 0)), (12, 20, 8)), SPECKLE, FLUID)
    given = tracked()
    x = given.grid.image_to_probe[0, 3] + given.grid.image_to_probe[0, 0] * np.arange(given.grid.columns)
    left = np.broadcast_to(x < -0.5, given.mask.shape)  # half a voxel before the border
    images = [np.where(left, 100 + n, 30).astype(np.uint8) for n in range(2)]
    found = grey_levels_per_tissue(given, images, quiet)
    assert list(found) == ["speckle", "fluid"]
    assert np.array_equal(np.bincount(found["speckle"])[-2:], [(left & given.mask).sum()] * 2)
    assert found["speckle"].min() == 100 and set(np.unique(found["fluid"])) == {30}
    assert found["fluid"].size == pytest.approx(2 * (~left & given.mask).sum() * 20 / 30, rel=0.1)


def test_pixels_outside_the_mask_do_not_count():
    quiet = simulator(block(lambda x, y, z: np.ones_like(x), (12, 20, 8)), SPECKLE)
    whole = tracked()
    half = whole.mask & (np.arange(whole.grid.rows) < whole.grid.rows // 2)[:, None]
    images = [np.full(whole.mask.shape, 7, np.uint8)] * 2
    assert grey_levels_per_tissue(tracked(half), images, quiet)["speckle"].size == 2 * half.sum()
