"""Registration of poses with the cost of the appearance: a known offset is recovered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from benchmarks.twins import make_twin
from SlicerUSSim.Logic import (
    DisplaySettings,
    LinearProbe,
    PhasedProbe,
    SimulationError,
    TissueTable,
    UltrasoundSimulator,
    Volume,
    segment_mri,
    similarity,
)
from SlicerUSSim.Logic.base.errors import Cancelled
from SlicerUSSim.Logic.fitting.registration import Registration, register_poses, rigid_from, rotation_deg
from SlicerUSSim.Logic.fitting.search import Evaluation
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from tests.conftest import FLUID, SPECKLE, block

PROBE = PhasedProbe(75.0, 60.0, scan_lines=96)


@pytest.fixture(scope="module")
def twin(mni):
    segmentation = segment_mri(mni[0], thin_sulci=False)
    tissues = TissueTable.brain(segmentation.tissue_names)
    # Five images each way: with three, speckle leaves up to 2.4 degrees, depending on the patient.
    return make_twin(segmentation.labels, tissues, 2, probe=PROBE, crossing=True, frames=5)


def moved_away(twin, shift, turn) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """(offset, the point it turns about, poses without the offset)"""
    middle = np.mean([(pose @ [0.0, 30.0, 0.0, 1.0])[:3] for pose in twin.poses], axis=0)
    about = np.eye(4)
    about[:3, 3] = middle
    offset = about @ rigid_from([*shift, *turn]) @ np.linalg.inv(about)
    return offset, middle, [np.linalg.inv(offset) @ pose for pose in twin.poses]


@pytest.mark.long
def test_an_offset_of_four_millimetres_and_degrees_is_found_back(twin):
    offset, middle, poses = moved_away(twin, (2.4, -2.0, 2.5), (2.0, 2.8, -2.0))
    with twin.simulator.with_tissues(twin.true_tissues):
        found = register_poses(
            twin.simulator, PROBE, poses, twin.references, display=twin.true_display, max_evaluations=420
        )
    left = found.correction @ np.linalg.inv(offset)
    assert np.linalg.norm((left @ [*middle, 1.0])[:3] - middle) < 1.0
    assert rotation_deg(left) < 1.0
    assert found.cost_after < 0.85 * found.cost_before
    assert np.allclose(found.poses[0], found.correction @ poses[0])
    assert found.shift_mm == pytest.approx(4.0, abs=1.2) and found.turn_deg == pytest.approx(4.0, abs=1.2)


SMALL = LinearProbe(24, 24, scan_lines=48, focus_mm=12, elevation_focus_mm=12)


def cysts() -> tuple[UltrasoundSimulator, np.ndarray]:
    """A simulator of a few dark spheres in speckle, turned by the (4, 4) rotation beside it."""
    rotation = rigid_from([0, 0, 0, 10, 25, 65])
    holes = ((-5, -4, 0), (4, 0, 3), (-1, 5, -3), (7, -7, -2))
    labels = block(
        lambda x, y, z: 1 + sum((x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2 < 9 for a, b, c in holes), (22, 22, 12)
    )
    dark = replace(SPECKLE, name="dark", mu0=0.05, sigma0=0.02)
    turned = Volume(labels.array, rotation @ labels.ijk_to_ras)
    return UltrasoundSimulator(turned, TissueTable({0: FLUID, 1: SPECKLE, 2: dark})), rotation


def test_the_coarse_search_compares_the_same_field_at_half_the_resolution():
    """Half the scan lines, pixels twice as large, fewer scatterers and rays: the first cost belongs to such images."""
    seen, rotation = cysts()
    display = DisplaySettings(image_size=(96, 92))
    grid = ImageGrid.for_probe(SMALL, display.image_size)
    pose = rotation @ rigid_from([0, -12, 0, 0, 0, 0])
    reference = seen.simulate(SMALL, pose @ rigid_from([1, 0, 0, 0, 0, 0]), display, grid).image
    shown = grid.field(SMALL) & (np.arange(grid.columns) > grid.columns // 3)
    found = register_poses(
        seen, SMALL, [pose], [reference], display=display, grid=grid, masks=[shown], max_evaluations=2
    )
    pixels = ImageGrid(
        grid.rows // 2, grid.columns // 2, grid.left_mm, grid.top_mm,
        (2 * grid.pixel_spacing_mm[0], 2 * grid.pixel_spacing_mm[1]),
    )  # fmt: skip
    shape = pixels.rows, 2, pixels.columns, 2
    smaller = [image.astype(float).reshape(shape).mean((1, 3)) for image in (reference, shown)]
    seen.settings = replace(seen.settings, scatterers_per_mm3=8.0, elevational_rays=3, max_ray_depth=1)
    image = seen.simulate(replace(SMALL, scan_lines=SMALL.scan_lines // 2), pose, display, pixels).image
    expected = similarity(image, smaller[0].round().astype(np.uint8), pixels.pixel_spacing_mm, mask=smaller[1] == 1.0)
    first = found.history[0]
    assert first.stage == "coarse" and first.cost == pytest.approx(expected.total, abs=2e-3)


def test_poses_that_fit_exactly_are_returned():
    """The reference is the simulated image itself, so every other pose has a higher cost."""
    seen, rotation = cysts()
    display = DisplaySettings(image_size=(96, 96))
    grid = ImageGrid.for_probe(SMALL, display.image_size)
    pose = rotation @ rigid_from([0, -12, 0, 0, 0, 0])
    reference = seen.simulate(SMALL, pose, display, grid).image
    found = register_poses(
        seen, SMALL, [pose], [reference], display=display, grid=grid, range_mm=1.5, range_deg=1.5, max_evaluations=12
    )
    fine = [entry for entry in found.history if entry.stage == "fine"]
    assert fine and min(entry.cost for entry in fine) > 0.0
    assert found.cost_before == found.cost_after == 0.0
    np.testing.assert_allclose(found.poses, [pose], atol=1e-12)
    assert found.shift_mm == pytest.approx(0.0, abs=1e-12) and found.turn_deg == pytest.approx(0.0, abs=1e-4)


@pytest.mark.slow
def test_the_cost_found_is_that_of_images_at_the_corrected_poses():
    """At oblique poses, where correction @ pose and pose @ correction lie apart; costs by plain simulations."""
    seen, rotation = cysts()
    display = DisplaySettings(image_size=(96, 96))
    grid = ImageGrid.for_probe(SMALL, display.image_size)
    true = [rotation @ rigid_from([0, -12, z, 0, 0, 0]) for z in (-2, 2)]
    references = [seen.simulate(SMALL, pose, display, grid).image for pose in true]
    away = [rotation @ rigid_from([1.5, 1.0, -0.8, 2, 3, -3]) @ np.linalg.inv(rotation) @ pose for pose in true]
    found = register_poses(
        seen, SMALL, away, references, display=display, grid=grid, range_mm=4, range_deg=6, max_evaluations=140
    )

    def cost(poses):
        images = [seen.simulate(SMALL, pose, display, grid).image for pose in poses]
        pairs = zip(images, references, strict=True)
        return np.mean([similarity(i, r, grid.pixel_spacing_mm, mask=grid.field(SMALL)).total for i, r in pairs])

    np.testing.assert_allclose(found.poses, [found.correction @ pose for pose in away], atol=1e-9)
    assert found.cost_before == pytest.approx(cost(away), abs=2e-3)
    assert found.cost_after == pytest.approx(cost(found.poses), abs=2e-3)
    assert found.cost_after < 0.95 * found.cost_before and found.shift_mm > 0.5


def test_two_registrations_one_after_the_other_are_one():
    pose = rigid_from([10, -20, 30, 15, 40, -60])
    first, second = rigid_from([3, -2, 1, 4, -3, 20]), rigid_from([-1, 2, 2, -25, 5, 3])
    centre = np.array([12.0, -8.0, 20.0])
    seen = (first @ [*centre, 1.0])[:3]  # where the second one finds what it is about
    entry = [Evaluation("coarse", (0.5,) * 6, cost) for cost in (0.4, 0.3, 0.2)]
    moved = np.linalg.norm(seen - centre)
    earlier = Registration(first, [first @ pose], centre, moved, 0.4, 0.3, entry[:2])
    moved = np.linalg.norm((second @ [*seen, 1.0])[:3] - seen)
    later = Registration(second, [second @ first @ pose], seen, moved, 0.3, 0.2, entry[2:])
    both = later.after(earlier)
    np.testing.assert_allclose(both.correction @ pose, both.poses[0], atol=1e-9)
    np.testing.assert_allclose(both.centre, centre, atol=1e-9)
    end = (second @ first @ [*centre, 1.0])[:3]
    assert both.shift_mm == pytest.approx(np.linalg.norm(end - centre))
    assert (both.cost_before, both.cost_after) == (0.4, 0.2) and both.history == entry
    alone = earlier.after(Registration.none([pose]))
    np.testing.assert_allclose(alone.correction, first, atol=1e-12)


def test_the_numbers_of_a_registration_are_those_of_its_matrix():
    """Also in its JSON: how far the middle of the images went, and by how much they were turned."""
    matrix = rigid_from([3, -4, 12, 0, 0, 30])
    found = Registration(matrix, [matrix], np.zeros(3), 13.0, 0.5, 0.4, [Evaluation("fine", (0.5,) * 6, 0.4)] * 3)
    written = found.to_dict()
    assert written["turn_deg"] == pytest.approx(30.0) == found.turn_deg
    assert np.allclose(written["correction"], matrix) and written["shift_mm"] == 13.0
    assert (written["cost_before"], written["cost_after"], written["evaluations"]) == (0.5, 0.4, 3)


@given(st.lists(st.floats(-40, 40), min_size=6, max_size=6))
def test_six_numbers_are_a_rigid_matrix(values):
    matrix = rigid_from(values)
    assert np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-9)
    assert rotation_deg(matrix) == pytest.approx(np.linalg.norm(values[3:]), abs=1e-4)
    assert matrix[:3, 3].tolist() == values[:3]


def test_bad_input_is_one_line():
    seen, _ = cysts()
    display = DisplaySettings(image_size=(96, 96))
    image = np.full((96, 96), 100, np.uint8)
    for change, message in (
        ({"references": [image]}, "1 reference images and 2 poses"),
        ({"range_mm": 0}, "range_mm is 0"),
        ({"range_deg": 400}, "range_deg is 400"),
        ({"poses": [np.diag([2.0, 1, 1, 1])] * 2}, "pose 0"),
    ):
        arguments = {"poses": [np.eye(4)] * 2, "references": [image] * 2, "max_evaluations": 2, **change}
        with pytest.raises(SimulationError, match=message):
            register_poses(seen, SMALL, display=display, **arguments)


def test_settings_of_the_simulator_stay_when_it_is_cancelled():
    seen, _ = cysts()
    before = seen.settings

    def stop(progress):
        if progress.evaluations == 2:
            raise Cancelled

    image = np.full((96, 96), 100, np.uint8)
    with pytest.raises(Cancelled):
        register_poses(seen, SMALL, [np.eye(4)], [image], display=DisplaySettings(image_size=(96, 96)), progress=stop)
    assert seen.settings is before
