"""The brain in an MRI: recognition, extraction, kept masks, DICOM series."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import SimpleITK as sitk
from click.testing import CliRunner
from scipy import ndimage
from scipy.spatial.transform import Rotation

from SlicerUSSim.Command.cli import main
from SlicerUSSim.Logic import SimulationError, Volume
from SlicerUSSim.Logic.base.errors import Cancelled
from SlicerUSSim.Logic.base.files import mask_beside
from SlicerUSSim.Logic.mri import kept_mask, recognition, refinement
from SlicerUSSim.Logic.mri.alignment import Alignment, align_template
from SlicerUSSim.Logic.mri.atlas import mni152
from SlicerUSSim.Logic.mri.brain import BrainMask, find_brain, given_brain
from SlicerUSSim.Logic.mri.edges import ends_at_edge
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
        (lambda a: np.where(a == 0, -1000.0, 40.0 + 0.1 * a), "is a CT (its values are Hounsfield units)"),
    ],
)
def test_what_is_not_an_mri_is_reported(change, message):
    mri = head_mri(4.0)
    with pytest.raises(SimulationError) as caught:
        find_brain(mri.with_array(change(mri.array)))
    assert message in str(caught.value) and "\n" not in str(caught.value)


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


def test_a_command_that_is_interrupted_says_so_in_one_line(monkeypatch, tmp_path):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(Volume, "read", interrupted)
    result = CliRunner().invoke(main, ["segment", "head.nii.gz", "-o", str(tmp_path / "l.nii.gz")])
    assert result.exit_code == 130 and result.stderr == "ussim: interrupted\n"


# ---- kept masks ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name, mask", [("a.nii.gz", "a.brain-mask.nrrd"), ("b.c.nrrd", "b.c.brain-mask.nrrd"), ("d", "d.brain-mask.nrrd")]
)
def test_the_mask_has_the_name_of_its_mri(tmp_path, name, mask):
    assert mask_beside(tmp_path / name) == tmp_path / mask


def test_a_kept_mask_is_read_and_never_replaced(head, found, tmp_path):
    mri, place = head[0], tmp_path / "head.brain-mask.nrrd"
    assert f"the brain mask is kept in {found.place}" in found.result.message
    again = find_brain(mri, keep_at=found.place)
    assert f"brain mask in {found.place}" in again.message and again.method == "given"
    assert np.array_equal(again.mask.array, found.result.mask.array)
    place.write_bytes(found.place.read_bytes())
    other = mri.with_array(mri.array + 1.0)
    assert kept_mask.read_kept(place, other) is None
    assert kept_mask.keep(place, other, found.result.mask).endswith(f"{place} exists and belongs to another image")
    assert place.read_bytes() == found.place.read_bytes()
    assert "is not kept: " in kept_mask.keep(tmp_path / "absent" / "mask.nrrd", mri, found.result.mask)


def test_an_edited_kept_mask_is_used_and_checked_as_one_that_is_given(head, tmp_path):
    mri, brain = head
    path = tmp_path / "head.brain-mask.nrrd"
    edited = brain.astype(np.uint8)
    edited[:, : edited.shape[1] // 2] = 0
    mri.with_array(edited).write(path)  # by a program that drops our entry
    used = find_brain(mri, keep_at=path)
    assert np.array_equal(used.mask.array, edited)
    assert any("expected 1000 to 1900 ml of an adult" in line for line in used.warnings)  # half of it is gone
    mri.with_array(ndimage.gaussian_filter(brain.astype(np.float32), 1.5)).write(path)
    assert find_brain(mri, keep_at=path).volume_ml == pytest.approx(brain.sum() * mri.voxel_ml, rel=0.05)
    mri.with_array(np.ones_like(edited)).write(path)
    with pytest.raises(SimulationError, match=r"head.brain-mask.nrrd has .* covers 100% .*or delete it"):
        find_brain(mri, keep_at=path)
    Volume(edited, np.eye(4)).write(path)
    assert kept_mask.read_kept(path, mri) is None


# ---- masks that are given, and lesions -------------------------------------------------------------------------------


def test_several_labels_in_a_mask_are_reported(head):
    mri, brain = head
    labels = brain * np.where(np.arange(brain.shape[2]) < 40, 1, 2)
    (line,) = given_brain(mri.with_array(labels.astype(np.uint8)), mri).warnings
    assert "the mask holds the labels 1, 2, expected one; the brain is taken where any of them is" in line


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


def test_a_mask_may_be_a_probability():
    mri = Volume(np.random.default_rng(0).normal(100.0, 10.0, (50, 60, 70)).astype(np.float32), np.diag([2, 2, 2, 1.0]))
    inside = np.zeros(mri.array.shape, np.float32)
    inside[5:45, 5:55, 5:65] = 1.0
    smooth = ndimage.gaussian_filter(inside, 1.0)
    assert np.array_equal(given_brain(mri.with_array(smooth), mri).mask.array, smooth > 0.5)
    with pytest.raises(SimulationError, match="is it an image"):
        given_brain(mri, mri)


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


# ---- real heads ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.skipif(not COLIN.exists(), reason="Debian's mricron-data is not installed")
def test_the_atlas_finds_colin_as_his_own_mask_does():
    mri = Volume.read(COLIN)
    result = find_brain(mri, "atlas")
    assert dice(result.mask.array > 0, Volume.read(COLIN_BRAIN).array > 0) > 0.95
    assert isinstance(recognise(Volume.read(COLIN_BRAIN)), np.ndarray)


@pytest.mark.long
@needs_shared
def test_the_mask_of_a_t1_has_the_gyri_of_the_vertex_that_its_t2_shows():
    """In the T2 tissue is dark between bright CSF and dark bone; both images lie in one frame."""
    t1, t2 = (Volume.read(SHARED / f"remind022/{name}.nii.gz") for name in ("t1_contrast", "t2"))
    first, second = find_brain(t1), find_brain(t2, "atlas")
    assert first.method == "atlas"  # sure enough of it
    assert 1200 < first.volume_ml < 1700
    glioma = Volume.read(SHARED / "remind022/glioma.nii.gz")
    assert (refinement.on_grid(first.mask, glioma)[glioma.array > 0] > 0.5).all()
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
