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
from SlicerUSSim.Command.proposals import split_seeds
from SlicerUSSim.Command.serve import _require_opening
from SlicerUSSim.Logic import SimulationError, Volume
from SlicerUSSim.Logic.mri.craniotomy import (
    disc_opening,
    file_opening,
    mask_opening,
    opened,
    polygon_opening,
    without_outside,
)
from SlicerUSSim.Logic.mri.outside import OUTSIDE
from SlicerUSSim.Logic.mri.samples import head_mri
from SlicerUSSim.Logic.mri.views import view_pose
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


def test_a_polygon_far_from_the_patient_is_said(head, caplog):
    corners = np.array([[-20.0, -10.0, 78.0], [20.0, -10.0, 78.0], [20.0, 10.0, 78.0], [-20.0, 10.0, 78.0]])
    polygon_opening(head, NAMES, corners)
    assert "from the patient" not in caplog.text
    polygon_opening(head, NAMES, corners + [0.0, 0.0, 40.0])
    assert re.search(r"the points of the polygon lie \d\d mm from the patient", caplog.text)


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
        opened(head, NAMES, head.array == 2)
    with pytest.raises(SimulationError, match="have nothing of skin, scalp, skull, cancellous bone"):
        opened(head, ("csf", "grey matter", "a", "b", "c", "d"), disc_opening(head, NAMES, TOP, 30.0))
    with pytest.raises(SimulationError, match="lie on a line"):
        polygon_opening(head, NAMES, np.array([[0.0, 0, 80], [1, 0, 80], [2, 0, 80]]))
    inside = np.array([[-5.0, -5, 10], [5, -5, 10], [5, 5, 10], [-5, 5, 10]])
    with pytest.raises(SimulationError, match=r"mm behind the polygon, .* draw it on the scalp, around the opening"):
        polygon_opening(head, NAMES, inside)
    with pytest.raises(SimulationError, match="of the polygon is 2, expected three or more"):
        polygon_opening(head, NAMES, np.array([[0.0, 0, 80], [1, 0, 80]]))
    (tmp_path / "a.json").write_text("{}")
    with pytest.raises(SimulationError, match=r"a\.json: has no points, expected a markup"):
        file_opening(head, NAMES, str(tmp_path / "a.json"))
    Volume(np.zeros((4, 4, 4), np.uint8), np.eye(4)).write(tmp_path / "empty.nrrd")
    with pytest.raises(SimulationError, match=r"empty\.nrrd: is empty, or lies outside"):
        file_opening(head, NAMES, str(tmp_path / "empty.nrrd"))


def test_an_opening_that_is_none_is_refused(head, tmp_path):
    """The whole head was removed by its own label map or MRI, and bone behind the probe, or of the face, was opened."""
    behind = pose_looking_at((0.0, 0.0, 60.0), (0.0, 0.0, 120.0))
    with pytest.raises(SimulationError, match=r"begins 1\d\d mm behind the probe, which is in the head or looks out"):
        disc_opening(head, NAMES, behind, 30.0)
    with pytest.raises(SimulationError, match=r"no brain under the craniotomy within 60 mm \(it begins 2\d\d mm below"):
        disc_opening(head, NAMES, pose_looking_at((0.0, 0.0, 320.0), (0.0, 0.0, 0.0)), 30.0)
    for diameter in (-5.0, 1e9, np.nan):
        with pytest.raises(SimulationError, match=r"diameter of the craniotomy is .* mm, expected 5 to 150"):
            disc_opening(head, NAMES, TOP, diameter)
    with pytest.raises(SimulationError, match="has 6 different values, expected a mask of the opening"):
        mask_opening(head, head, "labels")
    with pytest.raises(SimulationError, match=r"removes \d+ ml of skin and skull, expected 500 or less"):
        opened(head, NAMES, head.array > 2)
    soft = head.with_array(np.where(disc_opening(head, NAMES, TOP, 30.0), 0.9, 1e-6))
    np.testing.assert_array_equal(mask_opening(head, soft, "soft"), disc_opening(head, NAMES, TOP, 30.0))
    far = head.with_array(
        np.where(places_of(head)[..., 0] > 70.0, np.where(head.array == 0, 3, head.array), head.array)
    )
    with pytest.raises(SimulationError, match=r"lies \d+ mm from the brain, expected 30 or less"):
        opened(far, NAMES, (places_of(head) > [70.0, 45.0, 45.0]).all(axis=-1))


def places_of(labels: Volume) -> np.ndarray:
    k, j, i = np.indices(labels.array.shape)
    return np.stack([i, j, k], axis=-1) @ labels.ijk_to_ras[:3, :3].T + labels.ijk_to_ras[:3, 3]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"coordinateSystem": "IJK"}, "coordinateSystem is 'IJK', expected LPS or RAS"),
        ({"coordinateUnits": "cm"}, "coordinateUnits is 'cm', expected mm"),
        ({"type": "Plane"}, "is a markup of type 'Plane', expected one of ClosedCurve, Curve, Fiducial"),
        (None, "has 2 markups, expected one"),
    ],
)
def test_a_markup_that_would_be_read_otherwise_is_refused(change, message, head, tmp_path):
    points = [{"position": [x, y, 78.0]} for x, y in ((-20, -10), (20, -10), (20, 10), (-20, 10))]
    points.append({"position": [0.0, 0.0, 0.0], "positionStatus": "undefined"})
    markup = {"type": "ClosedCurve", "coordinateSystem": "LPS", "controlPoints": points}
    path = tmp_path / "curve.mrk.json"
    path.write_text(json.dumps({"markups": [markup]}))
    gone = places(head, file_opening(head, NAMES, str(path)))
    assert gone[:, 2].min() > 30.0  # the point that is not placed takes no part
    path.write_text(json.dumps({"markups": [markup, markup] if change is None else [markup | change]}))
    with pytest.raises(SimulationError, match=message):
        file_opening(head, NAMES, str(path))


def test_an_open_curve_is_closed_and_that_is_said(head, tmp_path, caplog):
    points = [{"position": [x, y, 78.0]} for x, y in ((-20, -10), (20, -10), (20, 10), (-20, 10))]
    path, found = tmp_path / "curve.mrk.json", []
    for kind in ("ClosedCurve", "Curve"):
        markup = {"type": kind, "coordinateSystem": "LPS", "controlPoints": points}
        path.write_text(json.dumps({"markups": [markup]}))
        found.append(file_opening(head, NAMES, str(path)))
        assert ("is an open curve; the polygon is closed" in caplog.text) is (kind == "Curve")
    np.testing.assert_array_equal(*found)


@pytest.mark.slow
def test_the_probe_stands_on_the_brain_in_the_opening_of_a_file(head, tmp_path):
    """It stood under closed bone, and showed the brain all the same."""
    write_label_files(tmp_path / "head.nii.gz", head, TissueTable.brain().for_names(NAMES))
    side = pose_looking_at((-80.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    mask = disc_opening(head, NAMES, side, 40.0).astype(np.uint8)
    head.with_array(mask).write(tmp_path / "hole.nii.gz")
    through, told = image(tmp_path, "--pose", "auto", "--craniotomy", str(tmp_path / "hole.nii.gz"))
    assert "about R -69, A 0, S 0 mm are replaced" in told.replace("-0,", "0,").replace("-0 ", "0 ")
    assert "bone lie behind" not in told and through.mean() > 10.0
    pose = side.copy()
    pose[:3, 3] = (-59.0, 0.0, 0.0)
    (tmp_path / "pose.json").write_text(json.dumps(pose.tolist()))
    _, told = image(tmp_path, "--pose", str(tmp_path / "pose.json"))
    assert "mm of bone lie behind the face of the probe, which stands in a closed skull" in told
    _, told = image(tmp_path, "--pose", str(tmp_path / "pose.json"), "--craniotomy", "disc:10")
    assert re.search(
        r"the face of the probe is 12 mm wide and does not fit the opening, which leaves (9|10) mm of it free: expect",
        told,
    )
    assert "the skull is closed" not in told  # it is behind the face


@pytest.mark.slow
def test_the_command_aims_at_a_tumour_in_the_opening_of_a_file_and_says_where_the_skull_is_closed(head, tmp_path):
    place, names = (12.0, 0.0, 35.0), (*NAMES, "tumour")
    inside = np.linalg.norm(places_of(head) - place, axis=-1) <= 7.0
    labels = head.with_array(np.where(inside, len(names), head.array).astype(np.uint8))
    write_label_files(tmp_path / "head.nii.gz", labels, TissueTable.brain().for_names(names))
    hole = disc_opening(labels, names, TOP, 40.0).astype(np.uint8)
    head.with_array(hole).write(tmp_path / "hole.nii.gz")
    through, told = image(tmp_path, "--pose", "auto", "--craniotomy", str(tmp_path / "hole.nii.gz"))
    assert re.search(r"^probe: aimed at the tumour, 2\d degrees off the surface's normal$", told, re.MULTILINE)
    assert "the skull is closed" not in told and "does not fit" not in told and through.mean() > 10.0
    black, told = image(tmp_path, "--pose", "auto")
    assert told.count("the skull is closed in front of the probe") == 1 and "(--craniotomy auto, disc:MM or a " in told
    assert black[black.shape[0] // 3 :].mean() < 3.0


@pytest.mark.slow
def test_commands_say_that_no_part_of_the_face_touches_the_patient(head, tmp_path):
    """The image was black, without a word."""
    write_label_files(tmp_path / "head.nii.gz", head, TissueTable.brain().for_names(NAMES))
    off, on = tmp_path / "off.json", tmp_path / "on.json"
    for path, height in ((off, 88.0), (on, 78.5)):
        path.write_text(json.dumps(pose_looking_at((0.0, 0.0, height), (0.0, 0.0, 0.0)).tolist()))
    nothing = "0% of the probe's face touches the patient (contact gap: 3 mm): the image is black"
    black, told = image(tmp_path, "--pose", str(off), "--contact-gap", "3")
    assert told.count(nothing) == 1 and black[black.shape[0] // 3 :].mean() < 3.0
    for arguments in (("--pose", str(on), "--contact-gap", "3"), ("--pose", str(off), "--contact-gap", "none")):
        assert "face touches" not in image(tmp_path, *arguments)[1]
    done = CliRunner().invoke(
        main,
        ["volume", str(tmp_path / "head.nii.gz"), "--pose", str(on), "--contact-gap", "3", "--slide", "300",
         "--frames", "3", "--spacing", "4", "-o", str(tmp_path / "v.nrrd")],
    )  # fmt: skip
    assert done.exit_code == 0 and done.stderr.count("in 2 of 3 images 0% of the probe's face touches") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "and the image shows a brain without its skull, which has nothing to open; leave --craniotomy out"),
        (("--contrast", "t2"), "a brain without its skull, which has nothing to open; leave --craniotomy out"),
        (("--outside",), "image is a brain without its head (skull-stripped), and what is outside the brain"),
    ],
)
def test_a_brain_without_its_skull_has_nothing_to_open(arguments, message, tmp_path):
    """It was to be given --outside, which is refused for it."""
    head_mri(spacing_mm=4.0).write(tmp_path / "brain.nii.gz")
    told = refused_craniotomy(tmp_path / "brain.nii.gz", *arguments)
    assert message in told and ("expected --outside" not in told)


def test_a_head_is_to_be_labelled_whole_where_that_is_possible(head, tmp_path):
    noise = np.random.default_rng(3).normal(1.0, 0.05, head.array.shape)
    levels = np.array([5.0, 0.0, 100.0, 150.0, 120.0, 10.0, 90.0])
    head.with_array((levels[head.array] * noise).astype(np.float32)).write(tmp_path / "head.nii.gz")
    assert "--craniotomy is disc:30, and only a brain is labelled, expected --outside too" in refused_craniotomy(
        tmp_path / "head.nii.gz"
    )
    told = refused_craniotomy(tmp_path / "head.nii.gz", "--contrast", "t2")  # --outside is refused for it
    assert "expected --outside" not in told and "of contrast t1 or t1gd, and this is t2" in told


def test_labels_of_a_brain_alone_have_nothing_to_open(head):
    brain = without_outside(head, NAMES)
    with pytest.raises(SimulationError, match="as those of a brain without its skull: there is nothing to open"):
        opened(brain, NAMES, disc_opening(brain, NAMES, TOP, 30.0))


def refused_craniotomy(path, *arguments) -> str:
    done = CliRunner().invoke(
        main, ["simulate", str(path), "--pose", "auto", "--craniotomy", "disc:30", *arguments, "-o", "a.png"]
    )
    assert done.exit_code == 2, done.output
    return done.stderr


def test_a_file_with_two_segments_is_no_opening_and_both_are_named(head, tmp_path):
    """It was "has 3 different values"."""
    sides = (head.array == 3) * np.where(np.arange(head.array.shape[2]) < 56, 1, 2)
    stored = head.with_array(sides.astype(np.uint8)).to_sitk()
    for number, name in enumerate(("Flap", "Burr hole")):
        for key, value in (("Name", name), ("LabelValue", number + 1), ("Layer", 0), ("ID", f"Segment_{number + 1}")):
            stored.SetMetaData(f"Segment{number}_{key}", str(value))
    sitk.WriteImage(stored, path := str(tmp_path / "two.seg.nrrd"))
    for checked in (lambda: file_opening(head, NAMES, path), lambda: _require_opening(path)):
        with pytest.raises(SimulationError, match=r"two\.seg\.nrrd: holds the segments 1 'Flap', 2 'Burr hole'"):
            checked()
    with pytest.raises(SimulationError, match="a segment of 3D Slicer, is not grown but laid over the labels"):
        split_seeds([path])


def test_the_page_takes_the_list_of_points_of_an_older_slicer_as_an_opening(tmp_path):
    """It was read as an image."""
    corners = ("-20,-20", "20,-20", "20,20", "-20,20")
    rows = [f"n{n},{corner},78,0,0,0,1,1,1,0,F,," for n, corner in enumerate(corners)]
    head_lines = [
        "# Markups fiducial file version = 4.11",
        "# CoordinateSystem = RAS",
        "# columns = id,x,y,z,ow,ox,oy,oz",
    ]
    (tmp_path / "hole.fcsv").write_text("\n".join([*head_lines, *rows]) + "\n")
    _require_opening(str(tmp_path / "hole.fcsv"))


def image(tmp_path, *arguments) -> tuple[np.ndarray, str]:
    picture = str(tmp_path / "a.png")
    done = CliRunner().invoke(main, ["simulate", str(tmp_path / "head.nii.gz"), *arguments, "-o", picture])
    assert done.exit_code == 0, done.output
    return np.asarray(Image.open(picture), float), done.stderr


@pytest.mark.slow
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
        ("hole.nii", "--craniotomy is 'hole.nii' (no such file), expected none, auto, disc:MM, or a file"),
    ],
)
def test_another_value_is_one_line(value, message, head, tmp_path):
    write_label_files(tmp_path / "head.nii.gz", head, TissueTable.brain().for_names(NAMES))
    arguments = ["simulate", str(tmp_path / "head.nii.gz"), "--pose", "auto", "--craniotomy", value, "-o", "a.png"]
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 2 and message in done.stderr and len(done.stderr.splitlines()) == 1


def test_a_polygon_whose_sides_cross_is_refused_and_a_bent_one_is_not(head):
    square = np.array([[-20.0, -10.0, 78.0], [20.0, -10.0, 78.0], [20.0, 10.0, 78.0], [-20.0, 10.0, 78.0]])
    with pytest.raises(
        SimulationError, match=r"the sides of the polygon from point 1 to 2 and from point 3 to 4 cross"
    ):
        polygon_opening(head, NAMES, square[[0, 2, 1, 3]])
    bent = np.insert(square, 2, [5.0, 0.0, 80.0], axis=0)  # not convex
    assert 0 < polygon_opening(head, NAMES, bent).sum() < polygon_opening(head, NAMES, square).sum()
    assert polygon_opening(head, NAMES, np.repeat(square, 2, axis=0)).any()  # points twice


def test_a_spine_has_no_craniotomy_and_no_views_of_a_head(head):
    """A back was opened as skin, scalp and skull, and a probe stood on the fontanelle of a spine."""
    names = ["muscle" if name == "grey matter" else name for name in NAMES]
    with pytest.raises(SimulationError, match=r"no tissue of a brain \(they have .*muscle.*\), expected those"):
        opened(head, names, np.ones(head.array.shape, bool))
    with pytest.raises(SimulationError, match="no tissue of a brain"):
        view_pose(head, names, "fontanelle")
