"""The brain in an MRI: recognition, extraction, kept masks, DICOM series."""

import os
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import SimpleITK as sitk
from click.testing import CliRunner
from scipy import ndimage
from scipy.spatial.transform import Rotation

from SlicerUSSim.Command.cli import main
from SlicerUSSim.Logic import SimulationError, Volume, segment_mri
from SlicerUSSim.Logic.base.errors import Cancelled
from SlicerUSSim.Logic.mri import brain as brain_module, extractors, recognition, refinement
from SlicerUSSim.Logic.mri.alignment import Alignment, align_template
from SlicerUSSim.Logic.mri.atlas import mni152
from SlicerUSSim.Logic.mri.brain import BrainMask, find_brain, given_brain, left_out
from SlicerUSSim.Logic.mri.kept_mask import mask_beside
from SlicerUSSim.Logic.mri.no_data import ends_at_edge, no_data, without_blank
from SlicerUSSim.Logic.mri.recognition import recognise
from SlicerUSSim.Logic.mri.samples import head_mri
from tests.conftest import SHARED, needs_shared

COLIN = Path("/usr/share/mricron/templates/ch2.nii.gz")
COLIN_BRAIN = COLIN.with_name("ch2bet.nii.gz")


def dice(one, other):
    return 2.0 * (one & other).sum() / (one.sum() + other.sum())


def ellipsoid(radii, spacing=3.0, margin=12.0):
    """(Volume of zeros, scaled radius at every voxel)."""
    n = [int(2 * (r + margin) / spacing) + 1 for r in radii]
    matrix = np.diag([spacing] * 3 + [1.0])
    matrix[:3, 3] = [-(m - 1) * spacing / 2 for m in n]
    z, y, x = np.meshgrid(*[np.arange(m) * spacing - (m - 1) * spacing / 2 for m in n[::-1]], indexing="ij")
    radius = np.sqrt((x / radii[0]) ** 2 + (y / radii[1]) ** 2 + (z / radii[2]) ** 2)
    return Volume(np.zeros(radius.shape, np.float32), matrix), radius


def whole_head(nod_deg=12.0, scale=0.93, spacing=2.0):
    """(MRI of a head, its brain): the MNI152 brain, nodded and smaller, in CSF, skull and scalp, with noise."""
    t1 = mni152().t1
    n = (110, 130, 120)
    matrix = np.diag([spacing, spacing, spacing, 1.0])
    matrix[:3, 3] = [-110.0, -140.0, -120.0]
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("xz", [nod_deg, 4.0], degrees=True).as_matrix() * scale
    turn[:3, 3] = [5.0, -8.0, 6.0]
    back = t1.ras_to_ijk @ np.linalg.inv(turn) @ matrix
    brain = ndimage.affine_transform(
        t1.array.astype(np.float32), back[:3, :3][::-1, ::-1], back[:3, 3][::-1], n[::-1], order=1
    )
    inside = ndimage.binary_fill_holes(brain > 60)
    outside = spacing * ndimage.distance_transform_edt(~inside)
    rng = np.random.default_rng(0)
    head = np.where(inside, brain, 12.0)
    head[(outside > 0) & (outside <= 2.5)] = 50.0
    head[(outside > 8) & (outside <= 15)] = 320.0
    head[outside > 15] = 0.0
    x = np.linspace(-0.15, 0.15, n[0])
    head = np.abs(head * (1.0 + x) + rng.normal(0, 4.0, head.shape))
    return Volume(head.astype(np.float32), matrix), inside


class Found(NamedTuple):
    """A brain, where its mask is kept, what was reported, and how the atlas lies."""

    result: BrainMask
    place: Path
    shares: list[float]
    alignment: Alignment


@pytest.fixture(scope="module")
def head():
    return whole_head()


@pytest.fixture(scope="module")
def found(head, tmp_path_factory):
    """The brain in the synthetic head by the atlas, kept."""
    place = tmp_path_factory.mktemp("kept") / "head.brain-mask.nrrd"
    shares, alignments = [], []

    def recorded(*args, **options):
        alignments.append(align_template(*args, **options))
        return alignments[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recognition, "align_template", recorded)
        result = find_brain(head[0], "atlas", keep_at=place, progress=shares.append)
    (alignment,) = alignments
    return Found(result, place, shares, alignment)


# ---- recognition -----------------------------------------------------------------------------------------------------


def test_a_stripped_brain_is_recognised_and_taken_whole():
    mri = head_mri(4.0)
    result = find_brain(mri)
    assert result.method == "stripped"
    assert result.message == f"skull-stripped brain, {result.volume_ml:.0f} ml"
    assert np.array_equal(result.mask.array > 0, ndimage.binary_fill_holes(mri.array != 0))


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda a: np.where(a > 100, np.nan, a), "not finite numbers"),
        (lambda a: np.full_like(a, 7.0), "constant (7)"),
        (lambda a: (a > 0).astype(np.uint8), "2 different values"),
        (lambda a: np.where(a == 0, -1000.0, 40.0 + 0.1 * a), "CT has (Hounsfield"),
    ],
)
def test_what_is_no_mri_is_reported(change, message):
    mri = head_mri(4.0)
    with pytest.raises(SimulationError) as caught:
        find_brain(mri.with_array(change(mri.array)))
    assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.long
def test_voxels_without_data_are_left_out_with_a_warning(head, found):
    (mri, _), value = head, -3.0
    inside = found.result.mask.array > 0
    array = mri.array.copy()
    array[: np.argwhere(inside)[:, 0].min() + 12] = value  # as in an image padded below
    brain, lines = without_blank(mri.with_array(array), inside)
    assert not brain[array == value].any() and (brain == inside)[array != value].all()
    lost = (inside & (array == value)).sum() * mri.voxel_ml
    assert len(lines) == 1 and f"{lost:.0f} ml where the brain should be have no data" in lines[0]
    assert lines[0].endswith("cut off at its bottom")
    assert without_blank(mri, inside) == (inside, ())


def test_a_blank_within_the_image_has_data():
    """Dark CSF and bone may have the background's value, but do not reach the edge without a gap."""
    empty, radius = ellipsoid((70, 90, 70), spacing=2.0)
    array = np.where(radius < 1, 100.0, 0.0)
    array[radius < 0.3] = 0.0
    array[:, :, radius.shape[2] // 2][radius[:, :, radius.shape[2] // 2] < 1] = 0.0  # a slit to the edge
    blank = no_data(empty.with_array(array))
    assert blank[radius > 1.1].all() and not blank[radius < 0.9].any()


@pytest.mark.slow
def test_a_turned_head_is_used_with_a_warning(head):
    turned = Volume(np.ascontiguousarray(np.swapaxes(head[0].array, 0, 1)), head[0].ijk_to_ras)
    (line,) = segment_mri(turned).warnings
    assert "check the orientation and the voxel size in its header" in line


def test_none_takes_everything_brighter_than_the_background():
    empty, radius = ellipsoid((60, 80, 65))
    values = np.where(radius < 1, 100.0, 0.0) + np.random.default_rng(0).normal(0, 3, radius.shape)
    result = find_brain(empty.with_array(np.maximum(values, 0.0).astype(np.float32)), "none")
    assert result.method == "none" and result.volume_ml == pytest.approx(1307, rel=0.05)


# ---- extraction ------------------------------------------------------------------------------------------------------


def test_the_atlas_finds_the_brain_of_a_nodding_head(head, found):
    result, shares = found.result, found.shares
    assert result.method == "atlas"
    assert dice(result.mask.array > 0, head[1]) > 0.95
    assert result.message.startswith("whole head: brain extracted by the atlas in ") and "overlap" in result.message
    assert shares == sorted(shares) and shares[-1] == 1.0 and len(shares) > 20


def test_a_cancelled_alignment_stops(head):
    def progress(share):
        if share > 0.03:
            raise Cancelled

    with pytest.raises(Cancelled):
        find_brain(head[0], "atlas", progress=progress)


def on_other_voxels(mri, inside, spacing):
    """The head and its brain with voxels of (i, j, k) mm, stored as sagittal slices with rows from the top."""
    image = mri.to_sitk()
    size = [int(n * old / new) for n, old, new in zip(image.GetSize(), image.GetSpacing(), spacing, strict=True)]
    results = []
    for source in (image, mri.with_array(inside.astype(np.float32)).to_sitk()):
        grid = (size, sitk.Transform(), sitk.sitkLinear, source.GetOrigin(), spacing, source.GetDirection())
        results.append(Volume.from_sitk(sitk.DICOMOrient(sitk.Resample(source, *grid), "PIL"), "resampled"))
    return results[0], results[1].array > 0.5


@pytest.mark.slow
def test_the_atlas_finds_the_brain_in_a_stack_of_thick_sagittal_slices(head):
    mri, inside = on_other_voxels(*head, (5.0, 1.2, 1.2))
    result = find_brain(mri, "atlas")
    assert result.mask.array.shape == mri.array.shape
    assert dice(result.mask.array > 0, inside) > 0.94


def fake_robex(folder, script):
    program = folder / "ROBEX"
    program.write_text(f"#!{sys.executable}\n{script}")
    program.chmod(0o700)
    return folder


COPY = """
import sys, SimpleITK as sitk
print("Step 1 of 9: ...It took roughly 1 seconds", flush=True)
image = sitk.ReadImage(sys.argv[1])
sitk.WriteImage(sitk.Cast(image > 60, sitk.sitkUInt8), sys.argv[3])
"""


def test_a_program_gets_a_copy_of_1_mm_and_its_mask_comes_back_on_the_grid(tmp_path, monkeypatch):
    monkeypatch.setattr(extractors, "robex_folder", lambda: fake_robex(tmp_path, COPY))
    mri = head_mri(3.0)
    turned = Volume(mri.array[::-1].copy(), mri.ijk_to_ras @ np.diag([1.0, 1.0, -1.0, 1.0]))
    mask = extractors.robex(turned, lambda share: None)
    assert dice(mask, turned.array > 60) > 0.97


def test_a_cancelled_program_is_ended_and_leaves_nothing(tmp_path, monkeypatch):
    script = f"import os, time\nopen({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid()))\ntime.sleep(60)"
    monkeypatch.setattr(extractors, "robex_folder", lambda: fake_robex(tmp_path, script))
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(extractors.tempfile, "tempdir", str(temporary))

    def progress(share):
        if (tmp_path / "pid").exists() and (tmp_path / "pid").read_text():
            raise Cancelled

    with pytest.raises(Cancelled):
        extractors.robex(head_mri(4.0), progress)
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)
    assert not list(temporary.iterdir())


def test_a_command_that_is_interrupted_says_so_in_one_line(monkeypatch, tmp_path):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(Volume, "read", interrupted)
    result = CliRunner().invoke(main, ["segment", "head.nii.gz", "-o", str(tmp_path / "l.nii.gz")])
    assert result.exit_code == 130 and result.stderr == "ussim: interrupted\n"


def test_a_program_that_fails_is_named_with_its_last_line(tmp_path, monkeypatch):
    script = "import sys; print('no model'); sys.exit(3)"
    monkeypatch.setattr(extractors, "robex_folder", lambda: fake_robex(tmp_path, script))
    with pytest.raises(SimulationError, match=r"ROBEX failed with status 3 \(no model\)"):
        extractors.robex(head_mri(4.0), lambda share: None)


# ---- kept masks ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name, mask", [("a.nii.gz", "a.brain-mask.nrrd"), ("b.c.nrrd", "b.c.brain-mask.nrrd"), ("d", "d.brain-mask.nrrd")]
)
def test_the_mask_has_the_name_of_its_mri(tmp_path, name, mask):
    assert mask_beside(tmp_path / name) == tmp_path / mask


def test_a_kept_mask_is_read_instead_of_extracted_again(head, found):
    result, place = found.result, found.place
    again = find_brain(head[0], keep_at=place)
    assert again.seconds == 0.0 and "kept in" in again.message
    assert np.array_equal(again.mask.array, result.mask.array)


def save_edited(place, array, path):
    """Save other voxels with the notes of the kept mask at `place`, as an editor does."""
    image = sitk.ReadImage(str(place))
    edited = sitk.GetImageFromArray(array)
    edited.CopyInformation(image)
    for key in image.GetMetaDataKeys():
        edited.SetMetaData(key, image.GetMetaData(key))
    sitk.WriteImage(edited, str(path))


@pytest.mark.slow
def test_an_edited_kept_mask_is_used_and_reported_and_never_overwritten(head, found, tmp_path, own_cache):
    array = found.result.mask.array.copy()
    array[: array.shape[0] // 2] = 0
    place = tmp_path / "edited.nrrd"
    save_edited(found.place, array, place)
    result = find_brain(head[0], "atlas", keep_at=place)
    assert "as edited in" in result.message and result.method == "given"
    assert np.array_equal(result.mask.array, array > 0)
    other = head[0].with_array(head[0].array + 1.0)
    before = place.read_bytes()
    assert not brain_module.keep(place, other, array > 0, "atlas", 1.0, ()).is_beside
    assert place.read_bytes() == before


@pytest.mark.parametrize("edit", ["everything", pytest.param("smoothed", marks=pytest.mark.slow)])
def test_an_edited_kept_mask_is_checked_as_one_that_is_given(edit, head, found, tmp_path):
    """All of the head would be segmented as a brain, and a smoothed mask would be wider by a litre."""
    mask = found.result.mask.array.astype(np.float32)
    path = tmp_path / "head.brain-mask.nrrd"
    save_edited(found.place, np.ones_like(mask) if edit == "everything" else ndimage.gaussian_filter(mask, 1.5), path)
    if edit == "smoothed":
        used = find_brain(head[0], keep_at=path)
        assert used.volume_ml == pytest.approx((mask > 0).sum() * head[0].voxel_ml, rel=0.05)
        return
    with pytest.raises(SimulationError, match=r"head.brain-mask.nrrd has .* covers 100% .*or delete it"):
        find_brain(head[0], keep_at=path)


def test_a_mask_edited_in_a_program_that_keeps_no_notes_is_the_users(head, found, tmp_path):
    path = tmp_path / "head.brain-mask.nrrd"
    edited = found.result.mask.array.copy()
    edited[:, : edited.shape[1] // 2] = 0
    head[0].with_array(edited).write(path)  # without the entries of `keep`
    used = find_brain(head[0], keep_at=path)
    assert np.array_equal(used.mask.array > 0, edited > 0) and "edited" in used.message
    assert any("expected a brain of 1000 to 1900 ml" in line for line in used.warnings)  # half of it is gone
    Volume(edited, np.eye(4)).write(path)
    assert brain_module.read_kept(path, head[0], "auto") is None


def test_a_mask_of_another_image_or_method_is_not_used(tmp_path):
    mri = head_mri(4.0)
    place = tmp_path / "head.brain-mask.nrrd"
    assert brain_module.keep(place, mri, mri.array > 0, "robex", 1.0, ()).is_beside
    assert brain_module.read_kept(place, mri, "auto") is not None
    assert brain_module.read_kept(place, mri, "atlas") is None
    assert brain_module.read_kept(place, mri.with_array(mri.array * 2), "auto") is None


@pytest.mark.parametrize("is_taken", [True, False])
def test_a_mask_is_kept_in_the_cache_where_it_cannot_be_beside(is_taken, tmp_path, own_cache):
    mri = head_mri(4.0)
    place = tmp_path / "absent" / "head.brain-mask.nrrd"  # a folder that cannot be written, also for root
    if is_taken:
        place.parent.mkdir()
        place.write_text("mine")
    kept = brain_module.keep(place, mri, mri.array > 0, "robex", 1.0, ())
    why = f"{place} exists" if is_taken else f"{place.parent} cannot be written"
    assert str(own_cache) in kept.text and kept.text.endswith(f"since {why}") and not kept.is_beside
    assert brain_module.read_kept(place, mri, "auto").method == "robex"
    assert not is_taken or place.read_text() == "mine"


# ---- masks that are given, and lesions -------------------------------------------------------------------------------


def test_masks_empty_on_another_grid_or_of_everything_are_refused():
    mri = head_mri(4.0)
    with pytest.raises(SimulationError, match="mask is empty"):
        given_brain(mri.with_array(np.zeros(mri.array.shape, np.uint8)), mri)
    with pytest.raises(SimulationError, match="expected the same grid"):
        given_brain(head_mri(3.0), mri)
    with pytest.raises(SimulationError, match=r"covers 100% of the image"):
        given_brain(mri.with_array(np.ones(mri.array.shape, np.uint8)), mri)


def test_the_share_of_a_lesion_outside_the_mask_is_found_on_another_grid():
    grid, radius = ellipsoid((70, 80, 60))
    mask = grid.with_array((radius < 1.0).astype(np.uint8))
    lesion = Volume(
        np.ones((20, 20, 20), np.uint8), np.array([[1.0, 0, 0, 60], [0, 1, 0, -10], [0, 0, 1, -10], [0, 0, 0, 1]])
    )
    x = np.arange(60, 80)
    assert left_out(mask, lesion) == pytest.approx((x > 69.5).mean(), abs=0.1)
    with pytest.raises(SimulationError, match="lesion is empty"):
        left_out(mask, lesion.with_array(np.zeros((20, 20, 20))))


def test_several_labels_in_a_mask_are_reported(head):
    mri, brain = head
    labels = brain * np.where(np.arange(brain.shape[2]) < 40, 1, 2)
    (line,) = given_brain(mri.with_array(labels.astype(np.uint8)), mri).warnings
    assert "the mask holds 2 values (1, 2), expected one; the brain is taken where it is not 0" in line


def test_a_vertex_outside_the_image_is_reported_and_a_tight_image_is_not(head):
    mri, brain = head
    filled = np.argwhere(brain)
    low, high = filled.min(axis=0), filled.max(axis=0)
    tight = (slice(low[0] - 1, high[0] + 2), slice(low[1] - 1, high[1] + 2), slice(low[2] - 1, high[2] + 2))
    assert ends_at_edge(Volume(mri.array[tight], mri.ijk_to_ras), brain[tight]) == ()
    for end, name in ((slice(None, high[0] - 8), "top"), (slice(low[0] + 25, None), "bottom")):
        (line,) = ends_at_edge(Volume(mri.array[end], mri.ijk_to_ras), brain[end])
        area = brain[end][-1 if name == "top" else 0].sum() * mri.spacing_mm[0] * mri.spacing_mm[1] / 100.0
        assert line == f"the brain reaches the {name} edge of the image over {area:.0f} cm2: it is cut off there"
    turned = sitk.DICOMOrient(mri.with_array(brain.astype(np.uint8)).to_sitk(), "SPL")
    other = Volume.from_sitk(turned)
    end = int(np.argwhere(other.array)[:, 2].max()) - 8 if other.ijk_to_ras[2, 0] > 0 else None
    cut = other.array[:, :, :end] if end else other.array[:, :, int(np.argwhere(other.array)[:, 2].min()) + 8 :]
    assert "the top edge" in ends_at_edge(Volume(cut, other.ijk_to_ras), cut > 0)[0]


def test_a_mask_whose_voxels_are_stored_in_another_order_is_the_same_mask():
    rng = np.random.default_rng(0)
    mri = Volume(rng.normal(100.0, 10.0, (50, 60, 70)).astype(np.float32), np.diag([2.0, -3.0, 2.5, 1.0]))
    inside = np.zeros(mri.array.shape, np.uint8)
    inside[5:40, 3:50, 20:60] = 1
    inside[5:9, 3:8, 20:28] = 0  # not symmetric
    other = mri.with_array(inside).to_sitk()
    for order in ("RAS", "SPL"):
        turned = Volume.from_sitk(sitk.DICOMOrient(other, order))
        assert turned.array.shape != mri.array.shape or not np.array_equal(turned.array, inside)
        assert np.array_equal(given_brain(turned, mri).mask.array, inside)
    matrix = Volume.from_sitk(sitk.DICOMOrient(other, "SPL")).ijk_to_ras.copy()
    matrix[0, 3] += 2.0  # one voxel off
    with pytest.raises(SimulationError, match="expected the same"):
        given_brain(Volume(Volume.from_sitk(sitk.DICOMOrient(other, "SPL")).array, matrix), mri)


def test_a_mask_may_be_a_probability_and_an_image_is_none():
    mri = Volume(np.random.default_rng(0).normal(100.0, 10.0, (50, 60, 70)).astype(np.float32), np.diag([2, 2, 2, 1.0]))
    inside = np.zeros(mri.array.shape, np.float32)
    inside[5:45, 5:55, 5:65] = 1.0
    smooth = ndimage.gaussian_filter(inside, 1.0)
    assert np.array_equal(given_brain(mri.with_array(smooth), mri).mask.array, smooth > 0.5)
    image = inside * np.clip(mri.array / 150.0, 0.0, 1.0)  # as intensities scaled from 0 to 1
    with pytest.raises(SimulationError, match="is it an image"):
        given_brain(mri.with_array(image.astype(np.float32)), mri)


def test_a_head_segmented_whole_by_the_users_wish_is_reported():
    grid, radius = ellipsoid((85, 105, 100))
    values = np.where(radius < 1.0, 100.0, 0.0) + np.random.default_rng(0).normal(0.0, 5.0, radius.shape)
    (warning,) = find_brain(grid.with_array(values.astype(np.float32)), "none").warnings
    assert "expected 1000 to 1900 ml of an adult" in warning


def test_errors_about_a_mask_name_its_file_and_count_voxels_as_viewers_do(tmp_path):
    mri = head_mri(4.0)
    for name, array in (
        ("small", np.ones((5, 6, 7), np.uint8)), ("empty", np.zeros(mri.array.shape, np.uint8))
    ):  # fmt: skip
        Volume(array, mri.ijk_to_ras).write(tmp_path / f"{name}.nii.gz")
    size = "x".join(map(str, mri.array.shape[::-1]))
    with pytest.raises(SimulationError, match=rf"small.nii.gz has 7x6x5 voxels and the MRI {size}, expected"):
        given_brain(Volume.read(tmp_path / "small.nii.gz"), mri)
    with pytest.raises(SimulationError, match=r"empty.nii.gz is empty, expected"):
        given_brain(Volume.read(tmp_path / "empty.nii.gz"), mri)


def test_more_than_any_brain_given_as_the_brain_is_refused():
    mri = Volume(np.zeros((40, 40, 40), np.float32), np.diag([5.0, 5.0, 5.0, 1.0]))
    outside = np.ones(mri.array.shape, np.uint8)
    outside[12:28, 12:28, 12:28] = 0
    with pytest.raises(SimulationError, match=r"mask has 7488 ml, expected a brain \(1000 to 1900 ml\)"):
        given_brain(mri.with_array(outside), mri)


def test_masks_of_an_infant_of_a_part_and_of_a_small_image_are_taken():
    def of(millilitres, box_mm):
        """A ball of so many ml in a noisy cube, without whole heads' surroundings."""
        place = np.linalg.norm(np.indices([round(box_mm / 2)] * 3) * 2.0 - box_mm / 2, axis=0)
        ball = (place < 10.0 * (3.0 * millilitres / (4.0 * np.pi)) ** (1 / 3)).astype(np.uint8)
        values = np.random.default_rng(0).normal(100.0, 10.0, ball.shape).astype(np.float32)
        mri = Volume(values, np.diag([2.0, 2.0, 2.0, 1.0]))
        return mri, mri.with_array(ball)

    for millilitres, box_mm in ((300.0, 160.0), (110.0, 160.0), (60.0, 54.0)):
        mri, mask = of(millilitres, box_mm)
        assert given_brain(mask, mri).volume_ml == pytest.approx(millilitres, rel=0.05)
    mri, mask = of(60.0, 160.0)
    assert "the mask has 60" in given_brain(mask, mri).warnings[-1]
    stripped = mri.with_array(mri.array * mask.array)  # a small brain in a large empty box
    assert given_brain(mask, stripped).volume_ml == pytest.approx(60.0, rel=0.05)


# ---- DICOM -----------------------------------------------------------------------------------------------------------


def write_series(folder, count, uid, number, description, skip=(), tilt=0.0, patient="1", first_patient="1"):
    folder.mkdir(exist_ok=True)
    rng = np.random.default_rng(int(number))
    voxels = rng.integers(0, 1000, (count, 12, 10)).astype(np.int16)
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    for k in range(count):
        if k in skip:
            continue
        image = sitk.GetImageFromArray(voxels[k])
        image.SetSpacing((1.5, 1.5))
        tags = {
            "0008|0060": "MR", "0020|000d": "1.2.3", "0020|000e": uid, "0008|0018": f"{uid}.{k + 1}",
            "0008|0016": "1.2.840.10008.5.1.4.1.1.4", "0020|0011": number, "0020|0013": str(k + 1),
            "0008|103e": description, "0020|0037": "1\\0\\0\\0\\1\\0", "0020|0032": f"0\\{tilt * k}\\{2.0 * k}",
            "0018|0050": "2", "0010|0020": patient if k else first_patient,
        }  # fmt: skip
        for key, value in tags.items():
            image.SetMetaData(key, value)
        writer.SetFileName(str(folder / f"s{number}_{k:03d}.dcm"))
        writer.Execute(image)
    return voxels


def test_the_only_volume_of_a_dicom_folder_is_read_and_reported(tmp_path, caplog):
    voxels = write_series(tmp_path / "d", 14, "1.2.3.5", "5", "t1 mprage")
    write_series(tmp_path / "d", 3, "1.2.3.1", "1", "localizer")
    mri = Volume.read(tmp_path / "d")
    assert np.array_equal(mri.array, voxels)
    assert "2 DICOM series; the only volume is read: series 5: 14 images of 10x12" in caplog.text
    assert "mprage" not in caplog.text  # descriptions may hold names


def test_several_volumes_are_listed_and_one_is_chosen_by_one_of_its_images(tmp_path):
    write_series(tmp_path / "d", 12, "1.2.3.5", "5", "t1")
    voxels = write_series(tmp_path / "d", 11, "1.2.3.6", "6", "t2")
    with pytest.raises(SimulationError, match=r"give the path of one image.*5 't1': 12 images.*6 't2': 11 images"):
        Volume.read(tmp_path / "d")
    assert np.array_equal(Volume.read(tmp_path / "d" / "s6_004.dcm").array, voxels)


def test_volumes_of_different_patients_in_one_folder_are_reported(tmp_path):
    write_series(tmp_path / "d", 12, "1.2.3.5", "5", "t1")
    write_series(tmp_path / "d", 11, "1.2.3.6", "6", "t2", patient="2", first_patient="2")
    with pytest.raises(SimulationError, match="has 2 DICOM series of 2 different patients, 2 of them with 10 or more"):
        Volume.read(tmp_path / "d")


def test_a_missing_slice_and_a_tilted_stack_are_refused(tmp_path):
    write_series(tmp_path / "gap", 14, "1.2.3.5", "5", "t1", skip=(6,))
    with pytest.raises(
        SimulationError, match="slices are missing or unevenly spaced at 1 place, first 4 mm after slice 6"
    ):
        Volume.read(tmp_path / "gap")
    write_series(tmp_path / "tilt", 14, "1.2.3.5", "5", "t1", tilt=0.5)
    with pytest.raises(SimulationError, match=r"tilted by 14\.0 degrees"):
        Volume.read(tmp_path / "tilt")


def test_images_of_two_patients_with_one_series_number_are_refused(tmp_path):
    write_series(tmp_path / "mixed", 14, "1.2.3.5", "5", "t1", patient="2")
    with pytest.raises(SimulationError, match="its images are of 2 patients by their PatientID"):
        Volume.read(tmp_path / "mixed")


# ---- real heads ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.skipif(not COLIN.exists(), reason="Debian's mricron-data is not installed")
def test_the_atlas_finds_colin_as_his_own_mask_does():
    mri = Volume.read(COLIN)
    result = find_brain(mri, "atlas")
    assert dice(result.mask.array > 0, Volume.read(COLIN_BRAIN).array > 0) > 0.95
    assert recognise(Volume.read(COLIN_BRAIN))[0] is not None


@pytest.mark.long
@needs_shared
def test_the_mask_of_a_t1_has_the_gyri_of_the_vertex_that_its_t2_shows():
    """In the T2 tissue is dark between bright CSF and dark bone; both images lie in one frame."""
    t1, t2 = (Volume.read(SHARED / f"remind022/{name}.nii.gz") for name in ("t1_contrast", "t2"))
    first, second = find_brain(t1), find_brain(t2, "atlas")
    assert first.method == "atlas"  # sure enough of it
    assert 1200 < first.volume_ml < 1700
    assert left_out(first.mask, Volume.read(SHARED / "remind022/glioma.nii.gz")) == 0.0
    values, within = refinement.on_grid(t2, t1), refinement.on_grid(second.mask, t1) > 0.5
    relative = values / np.median(values[ndimage.binary_erosion(within, iterations=10)])
    depth = ndimage.distance_transform_edt(within, t1.spacing_mm[::-1])
    tissue = ndimage.binary_opening((depth > 3.0) & (relative > 0.7) & (relative < 1.25))
    points = np.argwhere(within) @ t1.ijk_to_ras[:3, :3][:, ::-1].T
    height = (np.indices(within.shape).T @ t1.ijk_to_ras[:3, :3][:, ::-1].T)[..., 2].T
    at_top = tissue & (height > points[:, 2].max() - 30.0)
    millilitres = t1.voxel_ml * float((at_top & (first.mask.array == 0)).sum())
    assert at_top.sum() * t1.voxel_ml > 15.0
    assert millilitres < 1.5  # 3.9 ml with one border of tissue everywhere


def test_the_alignment_finds_the_size_and_the_nod_of_the_brain(found):
    linear = found.alignment.template_to_ras[:3, :3]
    assert np.cbrt(np.linalg.det(linear)) == pytest.approx(0.93, abs=0.02)
    left, _, right = np.linalg.svd(linear)
    turn_deg = np.degrees(np.arccos((np.trace(left @ right) - 1.0) / 2.0))
    assert turn_deg == pytest.approx(12.6, abs=3.0)  # 12 and 4 degrees about two axes


def test_an_image_in_metres_is_refused_before_it_fills_the_memory():
    """Lengths of a NIfTI in metres are read as 1000 mm per voxel; formerly it was resampled until memory ran out."""
    head = head_mri(4.0)
    scaled = Volume(head.array, np.diag([1000.0, 1000.0, 1000.0, 1.0]) @ head.ijk_to_ras)
    with pytest.raises(SimulationError, match="mm large, expected a head of 100 to 400 mm; correct its voxel size"):
        find_brain(scaled)
