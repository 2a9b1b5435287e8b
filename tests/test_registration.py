"""Registration of poses with the cost of the appearance: a known offset is recovered."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from SlicerUSSim.Logic import PhasedProbe, SimulationError, TissueTable, segment_mri
from SlicerUSSim.Logic.base.errors import Cancelled
from SlicerUSSim.Logic.fitting.registration import register_poses, rigid_from, rotation_deg
from SlicerUSSim.Logic.verification.twins import make_twin

PROBE = PhasedProbe(75.0, 60.0, scan_lines=96)


@pytest.fixture(scope="module")
def twin(mni):
    segmentation = segment_mri(mni[0])
    tissues = TissueTable.brain(segmentation.tissue_names)
    return make_twin(segmentation.labels, tissues, 2, probe=PROBE, crossing=True)


def moved_away(twin, shift, turn) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """(offset, the point it turns about, poses without the offset)"""
    middle = np.mean([(pose @ [0.0, 30.0, 0.0, 1.0])[:3] for pose in twin.poses], axis=0)
    about = np.eye(4)
    about[:3, 3] = middle
    offset = about @ rigid_from([*shift, *turn]) @ np.linalg.inv(about)
    return offset, middle, [np.linalg.inv(offset) @ pose for pose in twin.poses]


@pytest.mark.slow
def test_an_offset_of_four_millimetres_and_degrees_is_found_back(twin):
    offset, middle, poses = moved_away(twin, (2.4, -2.0, 2.5), (2.0, 2.8, -2.0))
    with twin.simulator.with_tissues(twin.true_tissues):
        found = register_poses(twin.simulator, PROBE, poses, twin.references, display=twin.true_display)
    left = found.correction @ np.linalg.inv(offset)
    assert np.linalg.norm((left @ [*middle, 1.0])[:3] - middle) < 1.0
    assert rotation_deg(left) < 1.0
    assert found.cost_after < 0.85 * found.cost_before
    assert np.allclose(found.poses[0], found.correction @ poses[0])
    assert found.shift_mm == pytest.approx(4.0, abs=1.2) and found.turn_deg == pytest.approx(4.0, abs=1.2)


def test_poses_in_place_are_not_made_worse(twin):
    found = register_poses(
        twin.simulator, PROBE, twin.poses[:2], twin.references[:2], display=twin.true_display, max_evaluations=40
    )
    assert found.cost_after <= found.cost_before
    assert len(found.history) <= 40


def test_settings_of_the_simulator_stay_when_it_is_cancelled(twin):
    before = twin.simulator.settings

    def stop(progress):
        if progress.evaluations == 3:
            raise Cancelled

    with pytest.raises(Cancelled):
        register_poses(
            twin.simulator, PROBE, twin.poses[:1], twin.references[:1], display=twin.true_display, progress=stop
        )
    assert twin.simulator.settings is before


@given(st.lists(st.floats(-40, 40), min_size=6, max_size=6))
def test_six_numbers_are_a_rigid_matrix(values):
    matrix = rigid_from(values)
    assert np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-9)
    assert rotation_deg(matrix) == pytest.approx(np.linalg.norm(values[3:]), abs=1e-4)
    assert matrix[:3, 3].tolist() == values[:3]


def test_bad_input_is_one_line(twin):
    for change, message in (
        ({"references": twin.references[:1]}, "1 reference images and 2 poses"),
        ({"range_mm": 0}, "range_mm is 0"),
        ({"range_deg": 400}, "range_deg is 400"),
        ({"poses": [np.diag([2.0, 1, 1, 1])] * 2}, "pose 0"),
    ):
        arguments = {"poses": twin.poses[:2], "references": twin.references[:2], **change}
        with pytest.raises(SimulationError, match=message):
            register_poses(twin.simulator, PROBE, display=twin.true_display, **arguments)
