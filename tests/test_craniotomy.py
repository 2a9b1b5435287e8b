"""Openings in the skull of a whole head: what they remove, and what the probe then sees."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
import SimpleITK as sitk
from click.testing import CliRunner
from PIL import Image

from SlicerUSSim.Command.cli import main
from SlicerUSSim.Logic import SimulationError, Volume
from SlicerUSSim.Logic.placement.craniotomy import (
    disc_opening,
    file_opening,
    mask_opening,
    opened,
    polygon_opening,
    without_outside,
)
from SlicerUSSim.Logic.placement.views import view_pose
from SlicerUSSim.Logic.probe.poses import pose_looking_at
from SlicerUSSim.Logic.tissue.names import OUTSIDE
from SlicerUSSim.Logic.tissue.table import TissueTable, write_label_files

NAMES = ("csf", "grey matter", *OUTSIDE)
#: Outer radii in mm; 2 is the brain, 0 between it and the skull
SHELLS = ((60.0, 2), (62.0, 0), (64.0, 5), (66.0, 6), (68.0, 5), (76.0, 4), (78.0, 3))
TOP = pose_looking_at((0.0, 0.0, 80.0), (0.0, 0.0, 0.0))


SQUARE = np.array([[-20.0, -10.0, 78.0], [20.0, -10.0, 78.0], [20.0, 10.0, 78.0], [-20.0, 10.0, 78.0]])


@pytest.fixture(scope="module")
def head() -> Volume:
    """A round head in voxels of 2 mm."""
    axis = np.arange(-84.0, 84.5, 2.0)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    matrix = np.diag([2.0, 2.0, 2.0, 1.0])
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


def write_markup(path, *, count: int = 1, **change) -> str:
    """SQUARE and a point that is not placed as a markup of Slicer, in LPS."""
    points = [{"position": (corner * [-1.0, -1.0, 1.0]).tolist()} for corner in SQUARE]
    points.append({"position": [0.0, 0.0, 0.0], "positionStatus": "undefined"})
    markup = {"type": "ClosedCurve", "coordinateSystem": "LPS", "controlPoints": points, **change}
    path.write_text(json.dumps({"markups": [markup] * count}))
    return str(path)


def test_a_polygon_of_slicer_opens_the_tissue_under_it(head, tmp_path, caplog):
    direct, _ = opened(head, NAMES, polygon_opening(head, NAMES, SQUARE))
    gone = places(head, direct.array != head.array)
    assert np.abs(gone[:, 0]).max() == pytest.approx(19.5, abs=1.5) and np.abs(gone[:, 1]).max() <= 10.0
    assert gone[:, 2].min() > 30.0
    path = tmp_path / "curve.mrk.json"
    for kind in ("ClosedCurve", "Curve"):
        found = file_opening(head, NAMES, write_markup(path, type=kind))
        np.testing.assert_array_equal(opened(head, NAMES, found)[0].array, direct.array)
        assert ("is an open curve; the polygon is closed" in caplog.text) is (kind == "Curve")
    assert "from the patient" not in caplog.text
    polygon_opening(head, NAMES, SQUARE + [0.0, 0.0, 40.0])
    assert re.search(r"the points of the polygon lie \d\d mm from the patient", caplog.text)
    bent = np.insert(SQUARE, 2, [5.0, 0.0, 80.0], axis=0)  # not convex
    square = polygon_opening(head, NAMES, SQUARE)
    assert 0 < polygon_opening(head, NAMES, bent).sum() < square.sum()
    np.testing.assert_array_equal(polygon_opening(head, NAMES, np.repeat(SQUARE, 2, axis=0)), square)


def test_a_mask_on_another_grid_opens_where_it_is_not_0(head, tmp_path):
    matrix = np.diag([3.0, 3.0, 3.0, 1.0])
    matrix[:3, 3] = [30.0, -12.0, 50.0]
    Volume(np.ones((8, 8, 8), np.uint8), matrix).write(tmp_path / "hole.nii.gz")
    found, _ = opened(head, NAMES, file_opening(head, NAMES, str(tmp_path / "hole.nii.gz")))
    gone = places(head, found.array != head.array)
    assert gone[:, 0].min() >= 28.4 and gone[:, 0].max() <= 52.6 and len(gone) > 500


AWAY = pose_looking_at((300.0, 0.0, 80.0), (300.0, 0.0, 0.0))
IN_HEAD = pose_looking_at((0.0, 0.0, 60.0), (0.0, 0.0, 120.0))
ABOVE = pose_looking_at((0.0, 0.0, 320.0), (0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda head: disc_opening(head, NAMES, AWAY, 30.0), "there is no brain under the craniotomy"),
        (
            lambda head: disc_opening(head, NAMES, IN_HEAD, 30.0),
            r"begins 1\d\d mm behind the probe, which is in the head",
        ),
        (lambda head: disc_opening(head, NAMES, ABOVE, 30.0), r"within 60 mm \(it begins 2\d\d mm below"),
        (lambda head: disc_opening(head, NAMES, TOP, np.nan), "diameter of the craniotomy is .* mm, expected 5 to 150"),
        (lambda head: opened(head, NAMES, head.array == 2), "removes nothing, expected skin, scalp, skull, cancellous"),
        (lambda head: opened(head, NAMES, head.array > 2), r"removes \d+ ml of skin and skull, expected 500 or less"),
        (lambda head: opened(head, (*"ab", *"cdef"), head.array > 2), "have nothing of skin, scalp, skull, cancellous"),
        (lambda head: opened(without_outside(head, NAMES), NAMES, head.array > 2), "brain without its skull: there is"),
        (lambda head: mask_opening(head, head, "labels"), "has 6 different values, expected a mask of the opening"),
        (lambda head: polygon_opening(head, NAMES, SQUARE[:2]), "of the polygon is 2, expected three or more"),
        (lambda head: polygon_opening(head, NAMES, SQUARE[[0, 1, 1]]), "lie on a line"),
        (lambda head: polygon_opening(head, NAMES, SQUARE - [0, 0, 68.0]), "draw it on the scalp, around the opening"),
        (lambda head: polygon_opening(head, NAMES, SQUARE[[0, 2, 1, 3]]), "from point 1 to 2 and from point 3 to 4"),
    ],
)
def test_an_opening_that_is_none_is_refused(call, message, head):
    """The whole head was removed by its own label map, and bone behind the probe, or of the face, was opened."""
    with pytest.raises(SimulationError, match=message):
        call(head)


def test_a_soft_mask_opens_where_it_is_one_and_not_far_from_the_brain(head):
    disc = disc_opening(head, NAMES, TOP, 30.0)
    np.testing.assert_array_equal(mask_opening(head, head.with_array(np.where(disc, 0.9, 1e-6)), "soft"), disc)
    bony = (places_of(head)[..., 0] > 70.0) & (head.array == 0)
    with pytest.raises(SimulationError, match=r"lies \d+ mm from the brain, expected 30 or less"):
        opened(
            head.with_array(np.where(bony, 3, head.array)), NAMES, (places_of(head) > [70.0, 45.0, 45.0]).all(axis=-1)
        )


def places_of(labels: Volume) -> np.ndarray:
    k, j, i = np.indices(labels.array.shape)
    return np.stack([i, j, k], axis=-1) @ labels.ijk_to_ras[:3, :3].T + labels.ijk_to_ras[:3, 3]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"coordinateSystem": "IJK"}, "coordinateSystem is 'IJK', expected LPS or RAS"),
        ({"coordinateUnits": "cm"}, "coordinateUnits is 'cm', expected mm"),
        ({"type": "Plane"}, "is a markup of type 'Plane', expected one of ClosedCurve, Curve, Fiducial"),
        ({"count": 2}, "has 2 markups, expected one"),
        ({"count": 0}, "has no points, expected a markup"),
    ],
)
def test_a_markup_that_would_be_read_otherwise_is_refused(change, message, head, tmp_path):
    with pytest.raises(SimulationError, match=message):
        file_opening(head, NAMES, write_markup(tmp_path / "curve.mrk.json", **change))


@pytest.mark.slow
def test_the_probe_stands_on_the_brain_in_the_opening_of_a_file(head, tmp_path):
    """It stood under closed bone, and showed the brain all the same."""
    write_label_files(tmp_path / "head.nii.gz", head, TissueTable.brain().for_names(NAMES))
    side = pose_looking_at((-80.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    mask = disc_opening(head, NAMES, side, 40.0).astype(np.uint8)
    head.with_array(mask).write(tmp_path / "hole.nii.gz")
    through, told = image(tmp_path, "--pose", "auto", "--craniotomy", str(tmp_path / "hole.nii.gz"))
    assert "about R -68, A 0, S 0 mm are replaced" in told.replace("-0,", "0,").replace("-0 ", "0 ")
    assert through.mean() > 10.0
    pose = side.copy()
    pose[:3, 3] = (-59.0, 0.0, 0.0)
    (tmp_path / "pose.json").write_text(json.dumps(pose.tolist()))
    _, told = image(tmp_path, "--pose", str(tmp_path / "pose.json"), "--craniotomy", "disc:10")
    assert re.search(
        r"the face of the probe is 12 mm wide and does not fit the opening, which leaves (9|10) mm of it free: expect",
        told,
    )
    assert "the skull is closed" not in told  # it is behind the face


def test_only_a_head_that_is_labelled_whole_can_be_opened(head, tmp_path):
    noise = np.random.default_rng(3).normal(1.0, 0.05, head.array.shape)
    levels = np.array([5.0, 0.0, 100.0, 150.0, 120.0, 10.0, 90.0])
    head.with_array((levels[head.array] * noise).astype(np.float32)).write(tmp_path / "head.nii.gz")
    told = refused_craniotomy(tmp_path / "head.nii.gz")
    assert "--craniotomy is disc:30, and only a brain is labelled, expected --outside and an MRI" in told


def refused_craniotomy(path, *arguments) -> str:
    done = CliRunner().invoke(
        main, ["simulate", str(path), "--pose", "auto", "--craniotomy", "disc:30", *arguments, "-o", "a.png"]
    )
    assert done.exit_code == 2, done.output
    return done.stderr


def test_a_file_with_two_segments_is_not_an_opening_and_both_are_listed(head, tmp_path):
    """It was "has 3 different values"."""
    sides = (head.array == 3) * np.where(np.arange(head.array.shape[2]) < 42, 1, 2)
    stored = head.with_array(sides.astype(np.uint8)).to_sitk()
    for number, name in enumerate(("Flap", "Burr hole")):
        for key, value in (("Name", name), ("LabelValue", number + 1), ("Layer", 0), ("ID", f"Segment_{number + 1}")):
            stored.SetMetaData(f"Segment{number}_{key}", str(value))
    sitk.WriteImage(stored, path := str(tmp_path / "two.seg.nrrd"))
    with pytest.raises(SimulationError, match=r"two\.seg\.nrrd: holds the segments 1 'Flap', 2 'Burr hole'"):
        file_opening(head, NAMES, path)


def image(tmp_path, *arguments) -> tuple[np.ndarray, str]:
    picture = str(tmp_path / "a.png")
    done = CliRunner().invoke(
        main, ["simulate", str(tmp_path / "head.nii.gz"), *arguments, "--look", "even", "-o", picture, "--overwrite"]
    )
    assert done.exit_code == 0, done.output
    return np.asarray(Image.open(picture), float), done.stderr


@pytest.mark.slow
def test_the_beam_reaches_the_brain_through_the_opening_alone(head, tmp_path):
    write_label_files(tmp_path / "head.nii.gz", head, TissueTable.brain().for_names(NAMES))
    (tmp_path / "pose.json").write_text(json.dumps(TOP.tolist()))
    on_skin, told = image(tmp_path, "--pose", "auto")
    assert "gel fills gaps of up to 3 mm between skin and probe" in told
    _, told = image(tmp_path, "--pose", "auto", "--set", "settings.contact_gap_mm=5")  # was replaced by 3 mm
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
        ("disc:3", "--craniotomy is 'disc:3', expected disc: and a diameter from 5 to 150 mm"),
        ("hole.nii", "--craniotomy is 'hole.nii' (no such file), expected none, auto, disc:MM, or a file"),
    ],
)
def test_another_value_is_one_line(value, message, head, tmp_path):
    write_label_files(tmp_path / "head.nii.gz", head, TissueTable.brain().for_names(NAMES))
    told = refused_craniotomy(tmp_path / "head.nii.gz", "--craniotomy", value)
    assert message in told and len(told.splitlines()) == 1


def test_a_spine_has_no_craniotomy_and_no_views_of_a_head(head):
    """A back was opened as skin, scalp and skull, and a probe stood on the fontanelle of a spine."""
    names = ["muscle" if name == "grey matter" else name for name in NAMES]
    with pytest.raises(SimulationError, match=r"no tissue of a brain \(they have .*muscle.*\), expected those"):
        opened(head, names, np.ones(head.array.shape, bool))
    with pytest.raises(SimulationError, match="no tissue of a brain"):
        view_pose(head, names, "fontanelle")
