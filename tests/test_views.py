"""Standard views: transcranial and through a fontanelle."""

from __future__ import annotations

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from SlicerUSSim.Command.cli import main
from SlicerUSSim.Command.patient_options import STANDARD_VIEWS
from SlicerUSSim.Logic import SimulationError
from SlicerUSSim.Logic.mri.craniotomy import disc_opening
from SlicerUSSim.Logic.mri.views import VIEWS, view_pose
from SlicerUSSim.Logic.tissue.own_files import write_label_files
from SlicerUSSim.Logic.tissue.table import TissueTable
from tests.test_craniotomy import NAMES, head  # noqa: F401


def test_the_command_knows_the_views():
    assert tuple(VIEWS) == STANDARD_VIEWS


@pytest.mark.slow
@pytest.mark.parametrize("name", VIEWS)
@pytest.mark.parametrize("is_open, radius", [(False, 78.0), (True, 60.0)])
def test_a_view_is_square_to_the_skin_or_the_brain(head, name, is_open, radius):  # noqa: F811
    pose, _ = view_pose(head, NAMES, name, is_open=is_open)
    place, axis = pose[:3, 3], pose[:3, 1]
    assert np.linalg.norm(place) == pytest.approx(radius, abs=2.0)
    np.testing.assert_allclose(axis, -place / np.linalg.norm(place), atol=0.05)
    np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-9)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)


@pytest.mark.slow
def test_left_and_right_front_and_back_are_where_they_are_in_such_images(head):  # noqa: F811
    right, left, coronal, sagittal = (view_pose(head, NAMES, name)[0] for name in VIEWS)
    assert right[0, 3] > 70 and left[0, 3] < -70  # RAS: the right is positive
    assert right[1, 0] < -0.9 and left[1, 0] < -0.9 and sagittal[1, 0] < -0.9  # the front on the left of the image
    assert coronal[0, 0] < -0.9  # seen from the front: the patient's right on the left of the image
    assert coronal[2, 3] > 70 and coronal[1, 3] > 15


def test_a_view_that_is_none_and_labels_without_a_brain_are_refused(head):  # noqa: F811
    with pytest.raises(SimulationError, match="view is 'frontal', expected one of temporal, temporal-left, fontanelle"):
        view_pose(head, NAMES, "frontal")
    with pytest.raises(SimulationError, match="the labels have no brain"):
        view_pose(head.with_array(np.where(head.array > 2, head.array, 0).astype(np.uint8)), NAMES, "temporal")


@pytest.mark.slow
def test_the_command_stands_where_a_view_is_seen_from(head, tmp_path):  # noqa: F811
    path = tmp_path / "head.nii.gz"
    write_label_files(path, head, TissueTable.brain().for_names(NAMES))
    images = {}
    for name, more in (("temporal", []), ("fontanelle", []), ("fontanelle", ["--craniotomy", "disc:40"])):
        out = tmp_path / f"{name}{len(more)}.png"
        done = CliRunner().invoke(main, ["simulate", str(path), "--pose", name, *more, "-o", str(out)])
        assert done.exit_code == 0, done.output
        images[out.stem] = np.asarray(Image.open(out), float)
    deep = {name: image[image.shape[0] // 2 :].mean() for name, image in images.items()}
    assert deep["fontanelle2"] > deep["fontanelle0"] + 5.0  # through the opening alone
    done = CliRunner().invoke(main, ["simulate", str(path), "--pose", "temple", "-o", str(tmp_path / "a.png")])
    assert done.exit_code == 2 and "temple" in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fontanelle", "temporal"])
def test_with_an_opening_of_a_file_a_view_is_in_it_or_said_to_be_elsewhere(head, tmp_path, name):  # noqa: F811
    path, mask, out = tmp_path / "head.nii.gz", tmp_path / "mask.nii.gz", tmp_path / "out.png"
    write_label_files(path, head, TissueTable.brain().for_names(NAMES))
    head.with_array(disc_opening(head, NAMES, view_pose(head, NAMES, "fontanelle")[0], 40.0).astype(np.uint8)).write(
        mask
    )
    done = CliRunner().invoke(
        main, ["simulate", str(path), "--pose", name, "--craniotomy", str(mask), "-o", str(out)]
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    deep = np.asarray(Image.open(out), float)[256:].mean()
    if name == "fontanelle":
        assert "the view fontanelle is seen through the opening" in done.stderr and deep > 5.0
    else:
        assert "the opening is not where the view temporal is seen from" in done.stderr and deep < 5.0
    assert "bone lie behind the face" not in done.stderr
