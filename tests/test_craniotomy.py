"""Openings in the skull of a whole head: what they remove, and what the probe then sees."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from SlicerUSSim.Command.cli import main
from SlicerUSSim.Logic import SimulationError, Volume
from SlicerUSSim.Logic.mri.craniotomy import disc_opening, file_opening, opened, polygon_opening
from SlicerUSSim.Logic.mri.outside import OUTSIDE
from SlicerUSSim.Logic.probe.placement import pose_looking_at
from SlicerUSSim.Logic.tissue.own_files import write_label_files
from SlicerUSSim.Logic.tissue.table import TissueTable

NAMES = ("csf", "grey matter", *OUTSIDE)
#: Outer radii in mm; 2 is the brain, 0 between it and the skull
SHELLS = ((60.0, 2), (62.0, 0), (64.0, 5), (66.0, 6), (68.0, 5), (76.0, 4), (78.0, 3))
TOP = pose_looking_at((0.0, 0.0, 80.0), (0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def head() -> Volume:
    axis = np.arange(-84.0, 84.5, 1.5)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    matrix = np.diag([1.5, 1.5, 1.5, 1.0])
    matrix[:3, 3] = axis[0]
    labels, radius = np.zeros(x.shape, np.uint8), np.sqrt(x**2 + y**2 + z**2)
    for outer, number in reversed(SHELLS):
        labels[radius <= outer] = number
    return Volume(labels, matrix)


def places(labels: Volume, where: np.ndarray) -> np.ndarray:
    """(voxels, 3) RAS."""
    return np.argwhere(where)[:, ::-1] @ labels.ijk_to_ras[:3, :3].T + labels.ijk_to_ras[:3, 3]


def test_a_disc_opens_skin_and_skull_under_the_probe_and_nothing_else(head):
    found, millilitres = opened(head, NAMES, disc_opening(head, NAMES, TOP, 30.0))
    gone = places(head, found.array != head.array)
    assert np.hypot(gone[:, 0], gone[:, 1]).max() <= 15.0 and gone[:, 2].min() > 55.0
    assert (found.array[head.array == 2] == 2).all() and not found.array[found.array != head.array].any()
    assert millilitres == pytest.approx(np.pi * 15.0**2 * 16.0 / 1000.0, rel=0.1)  # shells from 62 to 78 mm
    column = places(head, found.array > 2)
    assert not (np.hypot(column[:, 0], column[:, 1]) < 14.0)[column[:, 2] > 0].any()  # open
    assert (np.hypot(column[:, 0], column[:, 1]) < 14.0)[column[:, 2] < 0].any()  # the other side is not


def test_a_polygon_of_slicer_opens_what_lies_under_it(head, tmp_path):
    corners = np.array([[-20.0, -10.0, 78.0], [20.0, -10.0, 78.0], [20.0, 10.0, 78.0], [-20.0, 10.0, 78.0]])
    direct, _ = opened(head, NAMES, polygon_opening(head, NAMES, corners))
    gone = places(head, direct.array != head.array)
    assert np.abs(gone[:, 0]).max() == pytest.approx(19.5, abs=1.5) and np.abs(gone[:, 1]).max() <= 10.0
    assert gone[:, 2].min() > 30.0
    path = tmp_path / "curve.mrk.json"
    points = [{"position": (corner * [-1.0, -1.0, 1.0]).tolist()} for corner in corners]  # LPS, as Slicer writes
    path.write_text(
        json.dumps({"markups": [{"type": "ClosedCurve", "coordinateSystem": "LPS", "controlPoints": points}]})
    )
    np.testing.assert_array_equal(opened(head, NAMES, file_opening(head, NAMES, str(path)))[0].array, direct.array)


def test_a_mask_on_another_grid_opens_where_it_is_not_0(head, tmp_path):
    matrix = np.diag([3.0, 3.0, 3.0, 1.0])
    matrix[:3, 3] = [30.0, -12.0, 50.0]
    Volume(np.ones((8, 8, 8), np.uint8), matrix).write(tmp_path / "hole.nii.gz")
    found, _ = opened(head, NAMES, file_opening(head, NAMES, str(tmp_path / "hole.nii.gz")))
    gone = places(head, found.array != head.array)
    assert gone[:, 0].min() >= 28.4 and gone[:, 0].max() <= 52.6 and len(gone) > 500


def test_what_is_no_craniotomy_is_refused(head, tmp_path):
    away = pose_looking_at((300.0, 0.0, 80.0), (300.0, 0.0, 0.0))
    with pytest.raises(SimulationError, match="there is no brain under the craniotomy"):
        disc_opening(head, NAMES, away, 30.0)
    with pytest.raises(SimulationError, match="removes nothing, expected skin, scalp, skull, cancellous bone in it"):
        opened(head, ("csf", "grey matter", "a", "b", "c", "d"), disc_opening(head, NAMES, TOP, 30.0))
    with pytest.raises(SimulationError, match="lie on a line"):
        polygon_opening(head, NAMES, np.array([[0.0, 0, 80], [1, 0, 80], [2, 0, 80]]))
    with pytest.raises(SimulationError, match="has 2 points, expected three or more"):
        polygon_opening(head, NAMES, np.array([[0.0, 0, 80], [1, 0, 80]]))
    (tmp_path / "a.json").write_text("{}")
    with pytest.raises(SimulationError, match=r"a\.json: has no points, expected a markup"):
        file_opening(head, NAMES, str(tmp_path / "a.json"))
    Volume(np.zeros((4, 4, 4), np.uint8), np.eye(4)).write(tmp_path / "empty.nrrd")
    with pytest.raises(SimulationError, match=r"empty\.nrrd: is empty, or lies outside"):
        file_opening(head, NAMES, str(tmp_path / "empty.nrrd"))


def image(tmp_path, *arguments) -> tuple[np.ndarray, str]:
    picture = str(tmp_path / "a.png")
    done = CliRunner().invoke(main, ["simulate", str(tmp_path / "head.nii.gz"), *arguments, "-o", picture])
    assert done.exit_code == 0, done.output
    return np.asarray(Image.open(picture), float), done.stderr


def test_the_beam_reaches_the_brain_through_the_opening_and_not_through_the_skull(head, tmp_path):
    write_label_files(tmp_path / "head.nii.gz", head, TissueTable.brain().for_names(NAMES))
    (tmp_path / "pose.json").write_text(json.dumps(TOP.tolist()))
    on_skin, told = image(tmp_path, "--pose", "auto")
    assert "gel fills gaps of up to 3 mm between skin and probe" in told
    for given in (
        ("--contact-gap", "5"),
        ("--set", "settings.contact_gap_mm=5"),
        ("--set", "settings.contact_gap_mm=none"),
    ):
        _, told = image(tmp_path, "--pose", "auto", *given)  # was replaced by 3 mm
        assert "gel" not in told
    through, told = image(tmp_path, "--pose", "auto", "--craniotomy", "auto")
    assert "craniotomy: a disc of" in told and "gel" not in told
    deep = np.s_[on_skin.shape[0] // 2 : -40, on_skin.shape[1] // 3 : -on_skin.shape[1] // 3]
    assert through[deep].mean() > on_skin[deep].mean() + 20.0
    at_pose, told = image(tmp_path, "--pose", str(tmp_path / "pose.json"), "--craniotomy", "disc:40")
    assert "a disc of 40 mm" in told and at_pose[deep].mean() > on_skin[deep].mean() + 20.0


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("disc:x", "--craniotomy is 'disc:x', expected disc: and a diameter from 5 to 150 mm"),
        ("disc:3", "expected disc: and a diameter from 5 to 150 mm"),
        ("hole.nii", "--craniotomy is 'hole.nii', expected none, auto, disc:MM, or a file"),
    ],
)
def test_another_value_is_one_line(value, message, head, tmp_path):
    write_label_files(tmp_path / "head.nii.gz", head, TissueTable.brain().for_names(NAMES))
    arguments = ["simulate", str(tmp_path / "head.nii.gz"), "--pose", "auto", "--craniotomy", value, "-o", "a.png"]
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 2 and message in done.stderr and len(done.stderr.splitlines()) == 1
