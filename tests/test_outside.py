"""Skin, scalp, skull, marrow and air around the brain of a whole head."""

from __future__ import annotations

import json
from functools import cache

import numpy as np
import pytest
from click.testing import CliRunner
from scipy import ndimage

from SlicerUSSim.Command.cli import main
from SlicerUSSim.Logic import SimulationError, Volume, segment_mri
from SlicerUSSim.Logic.mri.outside import find_outside
from SlicerUSSim.Logic.mri.samples import head_mri
from SlicerUSSim.Logic.tissue.names import OUTSIDE
from SlicerUSSim.Logic.tissue.table import TissueTable

pytestmark = pytest.mark.usefixtures("segmented_once")

SPACING_MM = (1.0, 1.2, 1.5)
#: Where the place of the layers is not what is asked: an eighth of the voxels
COARSE_MM = (2.0, 2.4, 3.0)
#: Outer radii in mm of the layers of a round head, and their intensities
LAYERS = {"brain": (60.0, 100.0), "fluid": (62.0, 20.0), "inner table": (64.5, 6.0), "marrow": (67.5, 110.0),
          "outer table": (70.0, 6.0), "scalp": (80.0, 90.0)}  # fmt: skip


@cache
def round_head(
    spacing_mm: tuple[float, float, float] = SPACING_MM, seed: int = 0
) -> tuple[Volume, np.ndarray, np.ndarray]:
    """(MRI with noise, (k, j, i) bool brain, (k, j, i) distance from the centre in mm), with a cavity in the scalp."""
    matrix = np.diag([*spacing_mm, 1.0])
    shape = [int(172.0 / mm) for mm in spacing_mm[::-1]]
    places = [(index - (n - 1) / 2.0) * mm for index, n, mm in zip(np.indices(shape), shape, spacing_mm[::-1])]  # noqa: B905
    radius = np.sqrt(sum(place**2 for place in places))
    radius *= 1.0 + 0.03 * np.sin(3.0 * np.arctan2(places[1], places[2]))  # not quite round
    image = np.full(shape, 1.0)
    for outer, value in reversed(LAYERS.values()):
        image[radius <= outer] = value
    cavity = (places[0] + 75.0) ** 2 + places[1] ** 2 + places[2] ** 2 < 3.5**2
    image[cavity] = 1.0
    image = ndimage.gaussian_filter(image, 0.5)
    noise = np.random.default_rng(seed).normal(0.0, 2.0, (2, *shape))
    found = np.hypot(image + noise[0], noise[1]).astype(np.float32), radius <= 60.0, radius
    for array in found:
        array.setflags(write=False)  # of all tests
    return Volume(found[0], matrix), *found[1:]


@pytest.mark.slow
def test_layers_of_a_round_head_are_found_where_they_are():
    mri, brain, radius = round_head()
    found = find_outside(mri, brain)
    named = {name: found.labels == number for number, name in enumerate(OUTSIDE, 1)}
    skull = named["skull"] | named["cancellous bone"]
    truth = (radius > 62.0) & (radius <= 70.0)
    assert 2.0 * (skull & truth).sum() / (skull.sum() + truth.sum()) > 0.88
    assert radius[skull].max() < 72.5 and radius[skull].min() > 60.0
    marrow = (radius > 64.5) & (radius <= 67.5)
    assert 2.0 * (named["cancellous bone"] & marrow).sum() / (named["cancellous bone"].sum() + marrow.sum()) > 0.75
    assert radius[named["skin"]].min() > 76.5
    assert (named["scalp"] | named["skin"])[(radius > 72.0) & (radius < 79.0)].mean() > 0.98
    assert 50 < named["air"].sum() * mri.voxel_ml * 1000.0 < 250  # 180 mm3
    assert not found.labels[(radius > 85.0) | brain].any()


@pytest.mark.slow
def test_a_head_that_the_image_cuts_is_reported():
    mri, brain, _ = round_head(COARSE_MM)
    assert find_outside(mri, brain).warnings == ()
    for part, side in ((np.s_[:52], "top"), (np.s_[:, :, 6:], "left"), (np.s_[:, :-5], "front")):
        found = find_outside(Volume(mri.array[part].copy(), mri.ijk_to_ras), brain[part])
        (line,) = found.warnings
        assert line.startswith(f"the image cuts the head ({side} ") and "do not put a probe there" in line
    assert find_outside(Volume(mri.array[5:].copy(), mri.ijk_to_ras), brain[5:]).warnings == ()  # the neck


def test_the_tissues_of_the_brain_go_first():
    mri, brain, _ = round_head(COARSE_MM)
    labels = mri.with_array(np.where(brain, 2, 0).astype(np.uint8))
    over, names = find_outside(mri, brain).over(labels, ("csf", "grey matter"))
    assert names == ("csf", "grey matter", *OUTSIDE)
    assert (over.array[brain] == 2).all() and set(np.unique(over.array)) == {0, 2, 3, 4, 5, 6, 7}


def test_a_brain_without_a_head_is_refused():
    mri, brain, _ = round_head(COARSE_MM)
    with pytest.raises(SimulationError, match="next to nothing around the brain, expected a whole head"):
        find_outside(mri.with_array(np.where(brain, mri.array, 0.0)), brain)
    with pytest.raises(SimulationError, match="the brain mask is empty"):
        find_outside(mri, np.zeros_like(brain))


@pytest.mark.long
def test_the_commands_label_what_is_outside_the_brain(tmp_path):
    mri, brain, _ = round_head()
    mri.write(tmp_path / "head.nii.gz")
    mri.with_array(brain.astype(np.uint8)).write(tmp_path / "brain.nii.gz")
    image, mask, out = (str(tmp_path / name) for name in ("head.nii.gz", "brain.nii.gz", "labels.nii.gz"))
    done = CliRunner().invoke(main, ["segment", image, "--mask", mask, "--outside", "-o", out])
    assert done.exit_code == 0, done.output
    assert "outside the brain: skin" in done.stderr and "skull" in done.stdout
    table = json.loads((tmp_path / "labels.json").read_text())
    assert {"skin", "scalp", "skull", "cancellous bone"} <= {
        entry["name"] for entry in table.get("tissues", table).values() if isinstance(entry, dict) and "name" in entry
    }
    picture = str(tmp_path / "a.png")
    for arguments in ([image, "--mask", mask, "--outside"], [out]):
        done = CliRunner().invoke(main, ["simulate", *arguments, "--pose", "auto", "-o", picture, "--overwrite"])
        assert done.exit_code == 0, done.output
    for arguments, message in (
        ([out, "--outside"], "is a label map, and --outside is for an MRI"),
        (
            [image, "--skull-strip", "none", "--outside"],
            "--outside needs the brain, which --skull-strip none does not find",
        ),
        (
            [image, "--mask", mask, "--contrast", "t2", "--outside"],
            "(--outside) are found in a whole head of contrast t1 or t1gd, and this is t2",
        ),
    ):
        done = CliRunner().invoke(main, ["simulate", *arguments, "--pose", "auto", "-o", picture, "--overwrite"])
        assert done.exit_code == 2 and message in done.stderr


def test_a_brain_without_a_head_is_refused_before_it_is_segmented(tmp_path):
    path = str(tmp_path / "brain.nii.gz")
    head_mri(4.0).write(path)
    done = CliRunner().invoke(main, ["segment", path, "--outside", "-o", str(tmp_path / "labels.nii.gz")])
    assert done.exit_code == 2 and "is a brain without its head (skull-stripped), and tissue outside" in done.stderr
    assert "segmented" not in done.stderr and not (tmp_path / "labels.nii.gz").exists()


@pytest.mark.slow
def test_the_segmentation_has_what_is_outside_after_its_own_labels():
    mri, brain, _ = round_head(COARSE_MM)
    mask = mri.with_array(brain.astype(np.uint8))
    told: list[float] = []
    plain, whole = (
        segment_mri(mri, mask=mask, bias_correction=False, outside=on, thin_sulci=False, progress=told.append)
        for on in (False, True)
    )
    told = [0.0, *told[told.index(1.0) + 1 :]]  # of the whole head; it stood at 75 % for half of the time
    assert np.diff(told).min() >= 0.0 and np.diff(told).max() < 0.25
    assert whole.tissue_names == (*plain.tissue_names, *OUTSIDE)
    np.testing.assert_array_equal(np.where(brain, whole.labels.array, 0), plain.labels.array)
    found = find_outside(mri, brain).over(plain.labels, plain.tissue_names)
    np.testing.assert_array_equal(whole.labels.array, found[0].array)
    np.testing.assert_array_equal(whole.posteriors, plain.posteriors)
    for name in ("second_label", "second_share", "deviation", "volume_share"):
        np.testing.assert_array_equal(getattr(whole.texture(), name), getattr(plain.texture(), name))
    assert whole.notes[-1].startswith("outside the brain: skin")


@pytest.mark.slow
def test_a_table_of_other_tissues_is_refused(tmp_path):
    names = ("liver", "kidney")
    message = "lacks the patient's tissues, expected tissues called csf, grey"
    mri, brain, _ = round_head(COARSE_MM)
    mri.write(tmp_path / "head.nii.gz")
    mri.with_array(brain.astype(np.uint8)).write(tmp_path / "brain.nii.gz")
    TissueTable.brain().for_names(names).write(tmp_path / "table.json")
    done = CliRunner().invoke(
        main,
        [
            "simulate", str(tmp_path / "head.nii.gz"), "--mask", str(tmp_path / "brain.nii.gz"), "--tissues",
            str(tmp_path / "table.json"), "--pose", "auto", "-o", str(tmp_path / "a.png"),
        ],
    )  # fmt: skip
    assert done.exit_code == 2 and f"table.json: {message}" in done.stderr
