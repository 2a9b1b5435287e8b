"""Volume: geometry is preserved by all conversions, and invalid files give an error of one line."""

from __future__ import annotations

import gzip
import re
import subprocess
import sys

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic import SimulationError, Volume
from SlicerUSSim.Logic.base.files import written_whole
from SlicerUSSim.Logic.base.transforms import check_rigid

angles = st.floats(-180, 180)
spacings = st.floats(0.2, 6.0)
offsets = st.floats(-300, 300)


@st.composite
def geometries(draw):
    """Oblique, anisotropic, right- and left-handed ijk_to_ras matrices."""
    matrix = np.eye(4)
    rotation = Rotation.from_euler("xyz", [draw(angles) for _ in range(3)], degrees=True).as_matrix()
    flips = np.diag([draw(st.sampled_from([-1.0, 1.0])) for _ in range(3)])
    matrix[:3, :3] = rotation @ flips @ np.diag([draw(spacings) for _ in range(3)])
    matrix[:3, 3] = [draw(offsets) for _ in range(3)]
    return matrix


def numbered(shape=(3, 4, 5)) -> np.ndarray:
    return np.arange(np.prod(shape), dtype=np.int16).reshape(shape)


@pytest.mark.parametrize("kind", ["vtk", "sitk"])
@given(matrix=geometries())
def test_geometry_survives_vtk_and_itk(kind, matrix):
    volume = Volume(numbered(), matrix)
    back = Volume.from_vtk(volume.to_vtk()) if kind == "vtk" else Volume.from_sitk(volume.to_sitk())
    np.testing.assert_array_equal(back.array, volume.array)
    np.testing.assert_allclose(back.ijk_to_ras, matrix, atol=1e-6)


@pytest.mark.parametrize("suffix", [".nii.gz", ".nrrd", ".mha", ".vti"])
@settings(max_examples=8, deadline=None)
@given(matrix=geometries())
def test_geometry_survives_files(suffix, tmp_path_factory, matrix):
    path = tmp_path_factory.mktemp("volume") / f"v{suffix}"
    volume = Volume(numbered(), matrix)
    volume.write(path)
    back = Volume.read(path)
    np.testing.assert_array_equal(back.array, volume.array)
    np.testing.assert_allclose(back.ijk_to_ras, matrix, atol=2e-3)  # NIfTI stores float32 quaternions


def test_minc2_is_read_as_written_by_itk(tmp_path):
    matrix = np.diag([1.0, 1.5, 2.0, 1.0])
    matrix[:3, 3] = [-10, 20, 30]
    sitk.WriteImage(Volume(numbered().astype(np.float32), matrix).to_sitk(), str(tmp_path / "v.mnc"))
    back = Volume.read(tmp_path / "v.mnc")
    np.testing.assert_allclose(back.ijk_to_ras @ [1, 2, 1, 1], matrix @ [1, 2, 1, 1], atol=1e-4)
    np.testing.assert_allclose(back.array, numbered(), atol=1e-3)


def test_vtk_extent_that_does_not_start_at_zero_keeps_its_place():
    from vtkmodules.vtkImagingCore import vtkExtractVOI

    volume = Volume(numbered(), np.diag([1.0, 2.0, 3.0, 1.0]))
    crop = vtkExtractVOI()
    crop.SetInputData(volume.to_vtk())
    crop.SetVOI(1, 3, 1, 2, 1, 2)
    crop.Update()
    part = Volume.from_vtk(crop.GetOutput())
    np.testing.assert_array_equal(part.array, volume.array[1:3, 1:3, 1:4])
    np.testing.assert_allclose(part.ijk_to_ras @ [0, 0, 0, 1], volume.ijk_to_ras @ [1, 1, 1, 1])


@pytest.mark.parametrize("suffix", [".nii.gz", ".nrrd", ".mha"])
def test_an_image_with_a_time_axis_of_one_is_a_volume(suffix, tmp_path):
    import SimpleITK as sitk

    sitk.WriteImage(sitk.GetImageFromArray(numbered((1, 3, 4, 5)), isVector=False), str(tmp_path / f"t{suffix}"))
    assert Volume.read(tmp_path / f"t{suffix}").array.shape == (3, 4, 5)


@pytest.mark.parametrize("suffix", [".nrrd", ".nii", ".mha"])
@pytest.mark.parametrize("shape", [(4, 5), (3, 2, 4, 5)])
def test_images_that_are_not_3d_are_refused(tmp_path, shape, suffix):
    import SimpleITK as sitk

    path = tmp_path / f"i{suffix}"
    sitk.WriteImage(sitk.GetImageFromArray(np.zeros(shape, np.uint8), isVector=False), str(path))
    with pytest.raises(SimulationError, match=rf"i\{suffix}: is a .* image, expected three dimensions"):
        Volume.read(path)


@pytest.mark.parametrize("name", ["i.nii", "i.nii.gz", "i.nrrd", "i.mha", "i.vti", "i.mgz"])
def test_a_file_whose_end_is_missing_is_refused_or_has_all_voxels(name, tmp_path):
    """Some libraries read what is missing as zeros, or as the memory was."""
    volume = Volume(np.random.default_rng(0).integers(1, 1000, (20, 21, 22)).astype(np.int16), np.eye(4))
    if name.endswith(".mgz"):
        nibabel.save(nibabel.MGHImage(volume.array.T, np.eye(4)), tmp_path / name)  # type: ignore[attr-defined]
    else:
        volume.write(tmp_path / name)
    file = tmp_path / name
    whole, is_refused = file.read_bytes(), False
    for missing in (1, 20, 200, len(whole) // 2):
        file.write_bytes(whole[:-missing])
        try:
            assert np.array_equal(Volume.read(tmp_path / name).array, volume.array)
        except SimulationError as error:
            assert name in str(error) and "\n" not in str(error)
            is_refused = True
    assert is_refused


def test_metaimage_with_missing_voxels_says_so(tmp_path):
    sitk.WriteImage(sitk.GetImageFromArray(numbered((20, 20, 20))), str(tmp_path / "image.mhd"))
    (tmp_path / "image.raw").write_bytes(b"1234")
    with pytest.raises(SimulationError, match=r"image\.mhd: .*its voxels are missing or incomplete"):
        Volume.read(tmp_path / "image.mhd")


@pytest.mark.parametrize("name", ["mri.nii.gz.nii.gz", "mri.nii.nii.gz", "mri.nii.gz.nii"])
def test_a_name_that_would_be_written_as_another_is_refused(name, tmp_path):
    """ITK writes mri.nii.gz.nii.gz as mri.nii.gz: a patient's MRI was replaced by its labels."""
    mri = Volume(numbered(), np.eye(4))
    mri.write(tmp_path / "mri.nii.gz")
    before = (tmp_path / "mri.nii.gz").read_bytes()
    with pytest.raises(SimulationError, match="after another one"):
        Volume(numbered() + 1, np.eye(4)).write(tmp_path / name)
    with (
        pytest.raises(SimulationError, match=r"would be written as mri\.nii\.gz"),
        written_whole(tmp_path / name) as partial,
    ):
        partial.with_name("mri.nii.gz").write_bytes(b"labels")
    assert (tmp_path / "mri.nii.gz").read_bytes() == before and len(list(tmp_path.iterdir())) == 1


def test_nifti_is_read_whatever_its_version_and_the_end_of_its_name(tmp_path):
    values = np.arange(60, dtype=np.int16).reshape(3, 4, 5)
    Volume(values, np.eye(4)).write(tmp_path / "good.nii.gz")
    (tmp_path / "packed.nii").write_bytes((tmp_path / "good.nii.gz").read_bytes())
    (tmp_path / "plain.nii.gz").write_bytes(gzip.decompress((tmp_path / "good.nii.gz").read_bytes()))
    nibabel.save(nibabel.Nifti2Image(values.T, np.eye(4)), tmp_path / "second.nii.gz")  # type: ignore[attr-defined]
    for name in ("packed.nii", "plain.nii.gz", "second.nii.gz"):
        np.testing.assert_array_equal(Volume.read(tmp_path / name).array, values)
    (tmp_path / "empty.nrrd").write_bytes(b"")
    with pytest.raises(SimulationError, match=r"empty.nrrd: cannot be read as an image \(it is empty, 0 bytes\)"):
        Volume.read(tmp_path / "empty.nrrd")


def nifti(path, **fields) -> Volume:
    """What is read of an image with the axes of RAS whose header has other `fields`."""
    image = nibabel.Nifti1Image(np.arange(60, dtype=np.int16).reshape(5, 4, 3), np.diag([2.0, 2, 2, 1]))
    image.set_qform(image.affine, 1)
    nibabel.save(image, path)
    content = bytearray(path.read_bytes())
    header = nibabel.Nifti1Header(bytes(content[:348]), check=False)
    for name, value in fields.items():
        header[name] = value
    content[:348] = header.binaryblock
    path.write_bytes(content)
    return Volume.read(path)


CODES = {"sform_code": 0, "qform_code": 0}


@pytest.mark.parametrize(
    ("fields", "diagonal", "words"),
    [
        ({}, (2, 2, 2), None),
        ({"pixdim": [1, -2, 2, 2, 1, 1, 1, 1]}, (2, 2, 2), "its pixdim says voxels of -2x2x2 mm, its axes 2x2x2 mm"),
        ({"pixdim": [1, 0, 0, 0, 1, 1, 1, 1]}, (2, 2, 2), "its pixdim says voxels of 0x0x0 mm, its axes 2x2x2 mm"),
        ({"qoffset_x": 30}, (2, 2, 2), "its qform puts it 30.0 mm away from its sform, which is used"),
        ({"sform_code": 0, "qoffset_x": 30}, (2, 2, 2), None),
        (CODES, (-2, -2, 2), r"has no orientation \(no sform and no qform\), read as LPS; check left and right"),
        ({"srow_x": [0] * 4, "srow_y": [0] * 4}, (2, 2, 2), "its sform has no three axes and is not used"),
        ({"xyzt_units": 3}, (0.002, 0.002, 0.002), None),
        ({"sform_code": 0, "pixdim": [-5, 2, 2, 2, 1, 1, 1, 1]}, (2, 2, -2), None),  # any number below 0 is -1
        ({"scl_slope": 0, "scl_inter": 5}, (2, 2, 2), "scl_slope is 0 and scl_inter 5, read without both"),
    ],
)
def test_a_contradicting_nifti_header_is_reported_with_both_values(fields, diagonal, words, tmp_path, caplog):
    if fields.get("xyzt_units"):
        with pytest.raises(SimulationError, match=r"has voxels of 0\.002 x 0\.002 x 0\.002 mm"):
            nifti(tmp_path / "i.nii", **fields)
        return
    found = nifti(tmp_path / "i.nii", **fields)
    np.testing.assert_allclose(np.diag(found.ijk_to_ras)[:3], diagonal)
    np.testing.assert_array_equal(found.array.ravel(), np.arange(60).reshape(5, 4, 3).T.ravel())
    assert len(found.doubts) == (words is not None) and re.search(words or "", " ".join(found.doubts))
    if "by the sform" in " ".join(found.doubts):
        assert "RAS from (30, 0, 0) mm by the qform, RAS from (0, 0, 0) mm by the sform" in found.doubts[0]
    assert caplog.text.count("WARNING") == len(found.doubts)


def test_a_nifti_without_the_size_of_voxels_is_refused(tmp_path):
    with pytest.raises(SimulationError, match=r"pixdim is 0x0x0 and there is no sform, expected the size of its"):
        nifti(tmp_path / "i.nii", sform_code=0, pixdim=[1, 0, 0, 0, 1, 1, 1, 1])


@pytest.mark.parametrize(
    ("fields", "corner", "words"),
    [
        ({"space": "left-posterior-superior"}, (-10, -20, 30), None),
        ({"space": "RAS"}, (10, 20, 30), None),
        ({"space": "LAS"}, (-10, 20, 30), None),
        ({"space": "scanner-xyz"}, (-10, -20, 30), "its space is scanner-xyz, which is not anatomical, read as LPS"),
        ({"space dimension": 3}, (-10, -20, 30), "it has no space, read as LPS, as 3D Slicer does; check left and"),
        ({"space": "RAS", "space units": ["cm", "cm", "cm"]}, (100, 200, 300), None),
        (
            {"space": "RAS", "space units": ["furlong"] * 3},
            (10, 20, 30),
            "its space units are furlong, expected one of mm",
        ),
    ],
)
def test_a_nrrd_is_read_in_its_space_and_unit(fields, corner, words, tmp_path):
    import nrrd

    header = {**fields, "space directions": np.diag([1.0, 2, 3]), "space origin": [10, 20, 30]}
    nrrd.write(str(tmp_path / "i.nrrd"), np.arange(60, dtype=np.int16).reshape(3, 4, 5), header, index_order="C")
    found = Volume.read(tmp_path / "i.nrrd")
    np.testing.assert_allclose(found.ijk_to_ras[:3, 3], corner)
    np.testing.assert_array_equal(found.array.ravel(), np.arange(60))
    assert len(found.doubts) == (words is not None) and re.search(words or "", " ".join(found.doubts))


def test_missing_and_unreadable_files_are_named(tmp_path):
    with pytest.raises(SimulationError, match=r"nothing\.nii: no such file"):
        Volume.read(tmp_path / "nothing.nii")
    (tmp_path / "bad.nii").write_text("not an image")
    with pytest.raises(SimulationError, match=r"bad\.nii: cannot be read"):
        Volume.read(tmp_path / "bad.nii")
    with pytest.raises(SimulationError, match=r"has no DICOM series.*separate images \(bad\.nii\): give"):
        Volume.read(tmp_path)
    (tmp_path / "bad.nii").unlink()
    with pytest.raises(SimulationError, match=r"has no DICOM series, nor have the folders in it$"):
        Volume.read(tmp_path)


@pytest.mark.parametrize(
    "array, matrix, message",
    [
        (np.zeros((2, 2)), np.eye(4), "2 dimensions"),
        (np.zeros((2, 0, 2)), np.eye(4), "empty"),
        (np.array([[["a"]]]), np.eye(4), "expected real numbers"),
        (np.zeros((2, 2, 2), complex), np.eye(4), "complex128, expected real numbers"),
        (np.zeros((2, 2, 2)), np.eye(3), "shape"),
        (np.zeros((2, 2, 2)), np.diag([1.0, 0, 1, 1]), "singular"),
        (np.zeros((2, 2, 2)), np.diag([1.0, np.nan, 1, 1]), "not finite, expected a 4x4 affine matrix"),
    ],
)
def test_impossible_volumes_are_refused(array, matrix, message):
    with pytest.raises(SimulationError, match=message):
        Volume(array, matrix)


def test_a_sheared_matrix_in_a_file_is_refused_with_a_remedy(tmp_path):
    """In ITK's words it was "No orthonormal definition found"."""
    import nibabel

    skewed = np.eye(4)
    skewed[0, 1] = 0.2
    path = tmp_path / "sheared.nii.gz"
    nibabel.Nifti1Image(np.ones((5, 6, 7), np.int16), skewed).to_filename(path)
    with pytest.raises(
        SimulationError, match=r"sheared.nii.gz: .*axes are not perpendicular.*resample it to a regular"
    ):
        Volume.read(path)


def test_a_failed_write_leaves_nothing_behind(tmp_path):
    skewed = np.eye(4)
    skewed[0, 1] = 0.5
    target = tmp_path / "v.nrrd"
    target.write_text("what was there before")
    with pytest.raises(SimulationError, match="not perpendicular"):
        Volume(numbered(), skewed).write(target)
    assert target.read_text() == "what was there before"
    assert list(tmp_path.iterdir()) == [target]
    with pytest.raises(SimulationError, match="unknown image format"):
        Volume(numbered(), np.eye(4)).write(tmp_path / "v.xyz")
    with pytest.raises(SimulationError, match="does not exist"):
        Volume(numbered(), np.eye(4)).write(tmp_path / "nowhere" / "v.nrrd")


@given(geometries())
def test_only_rotations_with_translation_pass_as_poses(matrix):
    rotation = matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=0)
    pose = matrix.copy()
    pose[:3, :3] = rotation
    if np.linalg.det(rotation) > 0:
        np.testing.assert_array_equal(check_rigid("pose", pose), pose)
    else:
        with pytest.raises(SimulationError, match="mirrors"):
            check_rigid("pose", pose)
    pose[:3, :3] *= 1.1
    with pytest.raises(SimulationError, match="not rigid"):
        check_rigid("pose", pose)


@pytest.mark.parametrize("name", ["mri.nii.gz", "mri.nrrd", "mri.mha"])
def test_voxels_that_are_not_finite_are_read_as_zero_and_reported(name, tmp_path, caplog):
    """SPM and others write NaN outside the head."""
    values = np.ones((6, 7, 8), np.float32)
    values[4:] = np.nan
    values[2, 3, 4] = np.inf
    Volume(values, np.eye(4)).write(tmp_path / name)
    found = Volume.read(tmp_path / name)
    np.testing.assert_array_equal(found.array, np.where(np.isfinite(values), values, 0))
    (line,) = found.doubts
    assert (
        line.endswith(f"{name}: 113 of 336 voxels are not finite numbers; they are read as 0") and line in caplog.text
    )
    Volume(np.full((6, 7, 8), np.nan), np.eye(4)).write(tmp_path / name)
    with pytest.raises(SimulationError, match="no voxel is a finite number"):
        Volume.read(tmp_path / name)


_FULL = """
import resource, signal, sys
import nibabel
import numpy as np
from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.volume import Volume

for name in sys.argv[1:]:
    Volume(np.ones((10, 10, 10), np.uint8), np.eye(4)).write(name)
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (40 * 40 * 64, 40 * 40 * 64))
for size in (80, 64):  # of 64, only the header does not fit
    array = np.random.default_rng(0).integers(0, 256, (40, 40, size)).astype(np.uint8)
    for name in sys.argv[1:]:
        try:
            Volume(array, np.eye(4)).write(name)
            print("written", name)
        except SimulationError as error:
            print(error)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no limit of the size of files")
def test_a_file_that_does_not_fit_on_the_disk_leaves_the_one_before(tmp_path):
    """ITK did not report it for NIfTI: an empty file replaced the previous one."""
    names = ["v.mha", "v.nii", "v.nii.gz", "v.nrrd", "v.vti"]
    done = subprocess.run([sys.executable, "-c", _FULL, *names], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0 and done.stderr == ""  # ITK and VTK reported it in their own words
    assert sorted(file.name for file in tmp_path.iterdir()) == names
    for name in names:
        assert done.stdout.count(f"{name}: cannot be written") == 2, done.stdout
        kept = Volume.read(tmp_path / name)
        assert kept.array.shape == (10, 10, 10) and (kept.array == 1).all()
