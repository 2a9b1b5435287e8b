"""Tissues added on top of labels: where they go, what is refused, and how they look in ultrasound."""

from __future__ import annotations

import numpy as np
import pytest
from click.testing import CliRunner

from SlicerUSSim.Command.cli import main
from SlicerUSSim.Logic import (
    SimulationError,
    TissueTable,
    Volume,
)
from SlicerUSSim.Logic.mri import add_tissue, add_tissues, read_mask
from SlicerUSSim.Logic.mri.samples import head_mri
from SlicerUSSim.Logic.tissue.presets import TISSUES

from .conftest import block, rigid

pytestmark = pytest.mark.usefixtures("segmented_once")

#: White matter around the origin in a margin that is not the patient
BRAIN = block(lambda x, y, z: np.where(x**2 + y**2 + z**2 < 24**2, 1, 0))
CENTRE, RADIUS = np.array([4.0, -3.0, 2.0]), 8.0


def ussim(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


def distances(volume: Volume, centre=CENTRE) -> np.ndarray:
    """(k, j, i) mm of voxel centres from a point."""
    index = np.indices(volume.array.shape)[::-1].reshape(3, -1)
    points = volume.ijk_to_ras[:3, :3] @ index + volume.ijk_to_ras[:3, 3:]
    return np.linalg.norm(points - np.asarray(centre)[:, None], axis=0).reshape(volume.array.shape)


def empty(spacing_mm=(1.0, 1.0, 1.0), axes=None, half_mm=28.0) -> Volume:
    """A volume of zeros around the origin with these axes (columns: i, j, k in RAS)."""
    spacing = np.array(spacing_mm)
    counts = np.ceil(2 * half_mm / spacing).astype(int)
    matrix = np.eye(4)
    matrix[:3, :3] = (np.eye(3) if axes is None else axes) * spacing
    matrix[:3, 3] = -matrix[:3, :3] @ (counts - 1) / 2
    return Volume(np.zeros(counts[::-1], np.uint8), matrix)


def ball(volume: Volume, radius=RADIUS, centre=CENTRE) -> Volume:
    return volume.with_array((distances(volume, centre) < radius).astype(np.uint8))


def added(mask: Volume, tissue="tumour", labels=BRAIN, names=("white matter",), source="lesion.nii.gz", **options):
    return add_tissue(labels, names, mask, tissue, source=source, **options)


def dice(a: np.ndarray, b: np.ndarray) -> float:
    return 2 * float((a & b).sum()) / float(a.sum() + b.sum())


# ---- where it goes ---------------------------------------------------------------------------------------------------


def test_a_mask_on_the_grid_of_the_labels_is_taken_voxel_by_voxel():
    mask = ball(BRAIN)
    result = added(mask)
    assert ((result.labels.array == 2) == (mask.array > 0)).all()
    assert (result.labels.array[mask.array == 0] == BRAIN.array[mask.array == 0]).all()
    assert result.tissue_names == ("white matter", "tumour") and result.labels.array.dtype == np.uint8
    count = int(mask.array.sum())
    assert result.messages == (f"tumour: {count} voxels, {count / 1000:.1f} ml, added over white matter 100 %",)
    assert not result.warnings and BRAIN.array.max() == 1  # the labels given are as they were


TURNED = rigid(np.linalg.qr(np.array([[1.0, 0.4, 0.2], [-0.3, 1.0, 0.5], [0.1, -0.6, 1.0]]))[0], [0, 0, 0])[:3, :3]


@pytest.mark.parametrize(
    ("grid", "least"),
    [
        (empty((0.4, 0.5, 0.6), half_mm=16), 0.98),
        (empty((1.0, 1.0, 1.0), np.diag([-1.0, -1.0, 1.0])), 0.97),  # LPS, as most NIfTI files
        (empty((1.2, 1.2, 1.2), np.array([[0.0, 0, 1], [1, 0, 0], [0, -1, 0]])), 0.95),  # axes exchanged
        (empty((1.1, 1.1, 1.1), TURNED), 0.95),
        (empty((0.8, 0.8, 3.0)), 0.93),  # thick slices
        (empty((2.0, 2.0, 2.0)), 0.91),
    ],
)
def test_a_mask_on_another_grid_covers_the_same_place(grid, least):
    result = added(ball(grid)).labels
    assert dice(result.array == 2, distances(result) < RADIUS) > least
    assert float(distances(result)[result.array == 2].max()) < RADIUS + 0.6 * max(grid.spacing_mm)


def test_probabilities_count_from_one_half_on():
    grid = empty()
    probability = np.clip(0.5 + (RADIUS - distances(grid)) / 4.0, 0.0, 1.0).astype(np.float32)
    result = added(grid.with_array(probability)).labels
    assert dice(result.array == 2, distances(result) < RADIUS) > 0.98


def test_a_mask_of_255_or_of_whole_numbers_as_floats_is_a_mask():
    expected = added(ball(BRAIN)).labels.array
    for array in (ball(BRAIN).array * np.uint8(255), ball(BRAIN).array.astype(float), ball(BRAIN).array > 0):
        result = added(BRAIN.with_array(array))
        np.testing.assert_array_equal(result.labels.array, expected)
        assert not result.warnings


def test_the_last_is_on_top_and_a_tissue_that_is_there_keeps_its_label():
    small, large = ball(BRAIN, 4.0), ball(BRAIN, 9.0)
    result = add_tissues(BRAIN, ["white matter"], [("tumor", large, "a"), ("Cyst", small, "b"), ("tumour", small, "c")])
    assert result.tissue_names == ("white matter", "tumour", "cyst")
    assert (result.labels.array == 3).sum() == 0 and ((result.labels.array == 2) == (large.array > 0)).all()
    assert [message.split(":")[0] for message in result.messages] == ["tumour", "cyst", "tumour"]
    assert result.messages[1].endswith("added over tumour 100 %")


def test_labels_of_the_user_may_have_gaps_and_large_numbers():
    labels = BRAIN.with_array(np.where(BRAIN.array > 0, 7, 0).astype(np.int16))
    table = TissueTable({7: TISSUES["white matter"], 2: TISSUES["csf"]})
    result = added(ball(BRAIN), "haematoma", labels, table.names_by_label())
    after = result.table(table)
    assert result.labels.array.max() == 7 and after[1].name == "haematoma" and set(after) == {0, 1, 2, 7}
    own = TissueTable.brain(["white matter"]).replace("leptomeninges", mu0=1.2)
    over = added(ball(BRAIN), "leptomeninges", BRAIN, own.names_by_label())
    assert over.table(own)[2].mu0 == 1.2  # of the membrane in the user's own table


def test_a_brats_map_becomes_its_tissues_without_gaps_between_them():
    """On another grid, where voxels between two labels belong to neither by more than one half."""
    grid = empty((1.3, 1.1, 1.7), TURNED)
    r = distances(grid)
    for enhancing in (3, 4):
        values = np.select([r < 5, r < 8, r < 14], [1, enhancing, 2], 0).astype(np.float32)
        result = added(grid.with_array(values), "brats")
        assert result.tissue_names == ("white matter", "oedema", "necrosis", "enhancing")
        r_labels = distances(result.labels)
        assert not (result.labels.array[r_labels < 12.5] == 1).any()
        for label, low, high in ((2, 9.2, 12.8), (3, 0, 3.8), (4, 6.2, 6.8)):
            shell = (r_labels >= low) & (r_labels <= high)
            assert (result.labels.array[shell] == label).mean() > 0.95, label
        assert len(result.messages) == 3
        assert any("label 4 is read as enhancing" in warning for warning in result.warnings) == (enhancing == 4)
    values = np.select([r < 5, r < 8, r < 14], [4, 3, 2], 0)
    assert added(grid.with_array(values), "brats").tissue_names[1:] == ("oedema", "enhancing", "cavity")
    values = grid.with_array(np.select([r < 8, r < 14], [4, 2], 0))
    for year, tissue in (("brats-2021", "enhancing"), ("brats 2024", "cavity")):
        result = added(values, year)
        assert result.tissue_names[1:] == ("oedema", tissue) and not result.warnings


# ---- labels with names -----------------------------------------------------------------------------------------------


def segments(path, names: dict[int, str]):
    """A file of 3D Slicer with a ball in a ball, labels 2 and 1, in the frame of BRAIN."""
    import SimpleITK as sitk

    r = distances(BRAIN)
    image = BRAIN.with_array(np.select([r < 5, r < 10], [2, 1], 0).astype(np.uint8)).to_sitk()
    for place, (label, name) in enumerate(names.items()):
        for key, value in (("Name", name), ("LabelValue", label), ("Layer", 0), ("ID", f"Segment_{place + 1}")):
            image.SetMetaData(f"Segment{place}_{key}", str(value))
    sitk.WriteImage(image, str(path), True)
    return path


def test_names_of_segments_decide_what_brats_adds_and_not_their_numbers(tmp_path):
    path = segments(tmp_path / "l.seg.nrrd", {1: "Edema", 2: "Necrosis"})  # BraTS has them the other way round
    result = added(read_mask(path), "brats")
    assert result.tissue_names == ("white matter", "oedema", "necrosis")
    assert (result.labels.array[distances(BRAIN) < 5] == 3).all()
    assert result.warnings == (
        "lesion.nii.gz: labels are added by their names, 'Edema' as oedema, 'Necrosis' as necrosis",
    )
    (line,) = added(read_mask(path)).warnings
    assert "holds the labels 1 'Edema', 2 'Necrosis'; all of them are added as tumour" in line
    assert "(brats=FILE adds each by its name, as oedema, necrosis)" in line


# ---- what is refused or said -----------------------------------------------------------------------------------------


def moved(volume: Volume, *mm) -> Volume:
    return Volume(volume.array, rigid(np.eye(3), mm) @ volume.ijk_to_ras)


@pytest.mark.parametrize(
    ("mask", "tissue", "message"),
    [
        (BRAIN.with_array(np.zeros_like(BRAIN.array)), "tumour", "is empty, expected voxels that are not 0"),
        (moved(ball(BRAIN), 200, 0, 0), "tumour", "lies 174 mm outside the patient, expected a mask in the frame of"),
        (BRAIN, "tumour", "covers 100% of the patient, expected a lesion in it; is it the mask of the brain"),
        (head_mri(8.0), "tumour", "holds fractions from 0 to .*, expected a mask"),
        (BRAIN.with_array(np.arange(BRAIN.array.size).reshape(BRAIN.array.shape)), "cyst", "226981 whole numbers from"),
        (BRAIN.with_array(BRAIN.array * np.nan), "tumour", "has 226981 voxels that are not finite numbers"),
        (BRAIN.with_array(ball(BRAIN).array * 0.4), "tumour", r"no probability is above 0.5 \(the largest is 0.4\)"),
        (ball(BRAIN), "cheese", "no tissue is called 'cheese', expected one of: coupling, csf, .*oedema, necrosis"),
        (BRAIN.with_array(ball(BRAIN).array * 5), "brats", "holds the labels 5, expected those of BraTS: 1 necrosis"),
        (ball(BRAIN), "brats", "the label 1 alone, as the mask of a whole tumour does, .*: tumour=FILE, or necrosis="),
        (ball(empty((0.1, 0.1, 0.1), half_mm=1), 0.3, [0, 0, 0]), "tumour", "mm³ are too small for the voxels"),
    ],
)
def test_what_is_not_a_lesion_of_this_patient_is_refused_in_one_line(mask, tissue, message):
    with pytest.raises(SimulationError, match=message) as caught:
        added(mask, tissue)
    assert "\n" not in str(caught.value)
    assert tissue == "cheese" or str(caught.value).startswith("lesion.nii.gz: ")


def test_what_the_brain_mask_leaves_out_is_added_and_reported():
    mask = ball(BRAIN, 8.0, [22, 0, 0])
    result = added(mask, has_brain_mask=True)
    left_out = float((BRAIN.array[mask.array > 0] == 0).mean())
    assert 0.2 < left_out < 0.6 and ((result.labels.array == 2) == (mask.array > 0)).all()
    percent = f"{100 * left_out:.0f}"
    assert result.warnings == (f"the brain mask leaves out {percent} % of lesion.nii.gz; those voxels are added",)
    assert f"voxels outside {percent} %" in result.messages[0]
    meningioma = ball(BRAIN, 3.0, [27.9, 0, 0])
    beside = added(meningioma, has_brain_mask=True)  # which the brain mask cuts off wholly
    assert "leaves out 100 %" in beside.warnings[0]
    assert f"{percent} % of lesion.nii.gz lie where the labels have no tissue" in added(mask).warnings[0]


def test_a_mask_outside_the_volume_is_reported():
    box = Volume(np.ones((30, 30, 30), np.uint8), np.eye(4))
    out = added(ball(Volume(np.zeros((40, 40, 40), np.uint8), np.eye(4)), 6.0, [28, 15, 15]), labels=box)
    assert any("% of lesion.nii.gz lie outside the volume of the labels" in warning for warning in out.warnings)


# ---- the command -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A head, and masks on their own finer grid."""
    folder = tmp_path_factory.mktemp("lesions")
    head = head_mri(4.0)
    head.write(folder / "head.nii.gz")
    grid = moved(empty((1.5, 1.5, 2.0), np.diag([-1.0, -1.0, 1.0]), 20), 30, 10, 35)
    ball(grid, 10.0, [30, 10, 35]).write(folder / "tumour.nii.gz")
    ball(grid, 5.0, [30, 10, 35]).write(folder / "cyst.nrrd")
    return folder


@pytest.mark.slow
def test_segment_writes_added_tissues_and_says_what_it_added(files, tmp_path):
    out = tmp_path / "labels.nii.gz"
    adding = ("--add", f"tumour={files / 'tumour.nii.gz'}", "--add", f"cyst={files / 'cyst.nrrd'}")
    result = ussim("segment", files / "head.nii.gz", "-o", out, *adding)
    assert result.exit_code == 0, result.output
    assert "tumour: " in result.stderr and " ml, added over " in result.stderr and "over tumour 100 %" in result.stderr
    table, labels = TissueTable.read(tmp_path / "labels.json"), Volume.read(out)
    cyst = table.label_of("cyst")
    assert table.names() == ["coupling", "csf", "grey matter", "white matter", "tumour", "cyst"]
    volume_ml = (labels.array == cyst).sum() * 0.064
    assert volume_ml == pytest.approx(4 / 3 * np.pi * 0.5**3, rel=0.2)
    edema = ussim("segment", files / "head.nii.gz", "-o", out, "--overwrite", "--add", f"edema={files / 'cyst.nrrd'}")
    assert "--add edema: oedema" in edema.stderr and "oedema" in TissueTable.read(tmp_path / "labels.json").names()
    again = ussim("segment", files / "head.nii.gz", "-o", out, "--overwrite")
    assert again.exit_code == 0 and "tumour" not in TissueTable.read(tmp_path / "labels.json").names()


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("tumour", "--add is 'tumour', expected TISSUE=FILE"),
        ("tumour=none.nrrd", "none.nrrd: no such file"),
        ("tumour={head.nii.gz}", "head.nii.gz: holds fractions from"),
    ],
)
def test_a_mistake_in_an_addition_is_one_line_and_writes_nothing(files, tmp_path, value, message):
    value = value.replace("{head.nii.gz}", str(files / "head.nii.gz"))
    result = ussim("segment", files / "head.nii.gz", "-o", tmp_path / "l.nii.gz", "--add", value)
    assert result.exit_code == 2 and not list(tmp_path.iterdir())
    lines = [line for line in result.stderr.splitlines() if not line.startswith("ussim: warning: ")]
    errors = [line for line in lines if line.startswith("ussim: ")]
    assert len(errors) == 1 and message in errors[0], result.stderr


# ---- files that are not replaced -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["l.nii.gz", "l.json"])
def test_labels_and_their_table_are_replaced_only_when_asked(name, files, tmp_path):
    call = ("segment", files / "head.nii.gz", "-o", tmp_path / "l.nii.gz")
    (tmp_path / name).write_text("mine")  # as the table of l.nrrd, which has the same name
    assert ussim(*call).exit_code == 2 and [path.read_text() for path in tmp_path.iterdir()] == ["mine"]
    assert ussim(*call, "--overwrite").exit_code == 0
    assert Volume.read(tmp_path / "l.nii.gz").array.any() and len(TissueTable.read(tmp_path / "l.json")) > 2


def test_segment_never_replaces_its_inputs_and_takes_no_labels_for_an_mri(tmp_path):
    head = tmp_path / "head.nii.gz"
    mri = head_mri(4.0)
    mri.write(head)
    before = head.read_bytes()
    same = ussim("segment", head, "-o", head, "--overwrite")
    assert same.exit_code == 2 and "is an input, which it would replace" in same.output and head.read_bytes() == before
    kept = ussim("segment", head, "-o", tmp_path / "head.brain-mask.nrrd", "--overwrite")
    assert kept.exit_code == 2 and "head.brain-mask.nrrd is an input" in kept.output  # the next run would read it
    labels, mask = tmp_path / "labels.nii.gz", tmp_path / "tumour.nii.gz"
    values = np.digitize(mri.array, [20, 62, 97])
    mri.with_array(values.astype(np.uint8)).write(labels)
    part = values == 3
    part[..., part.shape[2] // 3 :] = False
    mri.with_array(part.astype(np.uint8)).write(mask)
    told = ussim("segment", labels, "-o", tmp_path / "out.nii.gz").output
    assert "is a label map" in told and f"ussim simulate {labels}" in told
    assert f"--add tumour={mask}" in ussim("segment", mask, "-o", tmp_path / "out.nii.gz").output
    assert not (tmp_path / "out.nii.gz").exists()
