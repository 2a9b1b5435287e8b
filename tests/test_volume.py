"""Volume: geometry is preserved by all conversions, and invalid files give an error of one line."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from types import SimpleNamespace

import nibabel
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic import SimulationError, Volume
from SlicerUSSim.Logic.base.files import written_whole
from SlicerUSSim.Logic.base.transforms import check_rigid
from SlicerUSSim.Logic.base.volume import read_array

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


#: An MRI, as a series of which tests damage copies
SERIES = Volume(numbered((6, 40, 50)), np.diag([-1.0, -1.0, 2.5, 1.0]))


@pytest.mark.parametrize("kind", ["vtk", "sitk"])
@given(matrix=geometries())
def test_geometry_survives_vtk_and_itk(kind, matrix):
    volume = Volume(numbered(), matrix)
    back = Volume.from_vtk(volume.to_vtk()) if kind == "vtk" else Volume.from_sitk(volume.to_sitk())
    np.testing.assert_array_equal(back.array, volume.array)
    np.testing.assert_allclose(back.ijk_to_ras, matrix, atol=1e-6)


@pytest.mark.parametrize("suffix", [".nii.gz", ".nrrd", ".mha", ".mhd", ".vti"])
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
    Volume(numbered().astype(np.float32), matrix).write(tmp_path / "v.mnc")
    back = Volume.read(tmp_path / "v.mnc")
    np.testing.assert_allclose(back.ijk_to_ras @ [1, 2, 1, 1], matrix @ [1, 2, 1, 1], atol=1e-4)
    np.testing.assert_allclose(back.array, numbered(), atol=1e-3)


def write_dicom(volume, folder, patient="Nobody", compressor=""):
    """A series of one file per slice."""
    import SimpleITK as sitk

    folder.mkdir(parents=True, exist_ok=True)
    image = volume.to_sitk()
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    if compressor:
        writer.UseCompressionOn()
        writer.SetCompressor(compressor)
    for k in range(image.GetSize()[2]):
        sheet = image[:, :, k]
        position = image.TransformIndexToPhysicalPoint((0, 0, k))
        for tag, value in {
            "0008|0060": "MR", "0020|000e": "1.2.3.4", "0020|000d": "1.2.3", "0020|0013": str(k),
            "0020|0032": "\\".join(map(str, position)), "0020|0037": "1\\0\\0\\0\\1\\0", "0018|0050": "2.5",
            "0010|0010": patient, "0010|0020": f"{patient} Number4711",
        }.items():  # fmt: skip
            sheet.SetMetaData(tag, value)
        writer.SetFileName(str(folder / f"{k}.dcm"))
        writer.Execute(sheet)


@pytest.mark.parametrize("place", [".", "DICOM/0000"])
def test_dicom_series_in_a_folder_is_read(place, tmp_path, caplog):
    """Or in the folders in it, as on a CD."""
    volume = Volume(numbered(), np.diag([-1.0, -1.0, 2.5, 1.0]))
    write_dicom(volume, tmp_path / place)
    back = Volume.read(tmp_path)
    assert ("those below it are read, in" in caplog.text) == (place != ".")
    np.testing.assert_array_equal(back.array, volume.array)
    np.testing.assert_allclose(back.ijk_to_ras, volume.ijk_to_ras, atol=1e-4)


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


def test_nifti_with_a_time_axis_of_one_is_a_volume(tmp_path):
    import SimpleITK as sitk

    sitk.WriteImage(sitk.GetImageFromArray(numbered((1, 3, 4, 5)), isVector=False), str(tmp_path / "t.nii.gz"))
    assert Volume.read(tmp_path / "t.nii.gz").array.shape == (3, 4, 5)


@pytest.mark.parametrize("shape", [(4, 5), (3, 2, 4, 5)])
def test_images_that_are_not_3d_are_refused(tmp_path, shape):
    import SimpleITK as sitk

    sitk.WriteImage(sitk.GetImageFromArray(np.zeros(shape, np.uint8), isVector=False), str(tmp_path / "i.nrrd"))
    with pytest.raises(SimulationError, match=r"i\.nrrd: is a .* image, expected three dimensions"):
        Volume.read(tmp_path / "i.nrrd")


@pytest.mark.parametrize(("number", "left"), [(3, 200), (5, 1000), (3, -10)])
def test_a_damaged_file_among_those_of_a_series_is_named(tmp_path, number, left):
    """The volume ended before the last image, which was cut short in a full disk, without a word."""
    write_dicom(SERIES, tmp_path)
    file = tmp_path / f"{number}.dcm"
    file.write_bytes(file.read_bytes()[:left])
    with pytest.raises(
        SimulationError, match=rf": {number}\.dcm cannot be read, which may be an image of the series of 5"
    ):
        Volume.read(tmp_path)


def test_other_objects_beside_the_images_of_a_series_are_no_damaged_images(tmp_path):
    write_dicom(SERIES, tmp_path)
    whole = (tmp_path / "3.dcm").read_bytes()
    pixels = whole.index(b"\xe0\x7f\x10\x00")
    state = whole[:pixels].replace(tag(0x0008, 0x0060) + b"\2\0\0\0MR", tag(0x0008, 0x0060) + b"\2\0\0\0PR")
    (tmp_path / "state.dcm").write_bytes(state)
    (tmp_path / "DICOMDIR").write_bytes(whole[:200])
    np.testing.assert_array_equal(Volume.read(tmp_path).array, SERIES.array)


def test_names_of_patients_stay_out_of_messages_logs_and_files(tmp_path, caplog):
    caplog.set_level("DEBUG")
    for patient, depth in (("Doe^Jane", 6), ("Roe^Rick", 7)):
        write_dicom(Volume(numbered((depth, 40, 50)), np.diag([-1.0, -1.0, 2.5, 1.0])), tmp_path / patient[:3], patient)
    volume = Volume.read(tmp_path / "Doe")
    for suffix in (".nii", ".mha", ".nrrd", ".vti", ".mnc"):
        volume.write(tmp_path / f"out{suffix}")
    said = caplog.text.encode() + b"".join(path.read_bytes() for path in tmp_path.glob("out*"))
    (tmp_path / "both").mkdir()
    for folder in ("Doe", "Roe"):
        for file in (tmp_path / folder).iterdir():
            (tmp_path / "both" / f"{folder}{file.name}").write_bytes(file.read_bytes())
    with pytest.raises(SimulationError) as error:
        Volume.read(tmp_path / "both")
    said += str(error.value).replace(str(tmp_path), "").encode()
    for secret in (b"Jane", b"Rick", b"Number4711"):
        assert secret not in said


@pytest.mark.parametrize("is_verbose", [False, True])
def test_descriptions_and_names_of_files_are_logged_only_if_asked(tmp_path, caplog, is_verbose):
    """Both may be names of patients."""
    caplog.set_level("INFO" if is_verbose else "WARNING")
    place = tmp_path / "DICOM" / "Doe_Jane"
    write_dicom(SERIES, place)
    for file in list(place.iterdir()):
        whole = file.read_bytes()
        at, text = whole.index(tag(0x10, 0x10)), b"T1 of Jane"
        series = tag(0x08, 0x103E) + len(text).to_bytes(4, "little") + text
        file.with_name(f"Doe{file.name}").write_bytes(whole[:at] + series + whole[at:])
        file.unlink()
    Volume.read(tmp_path / "DICOM")
    one = tmp_path / "one.dcm"
    for file in place.iterdir():
        file.rename(one if file.name == "Doe3.dcm" else tmp_path / file.name)
    Volume.read(one)
    assert "those below it are read, in 1 folder" in caplog.text
    assert "is one image of a DICOM series, which is read: " in caplog.text
    assert ("Jane" in caplog.text, "Doe" in caplog.text) == (is_verbose, is_verbose)


def of_size(dicom: bytes, rows: int, columns: int, frames: int = 0) -> bytes:
    """A DICOM file that promises another size."""
    content = bytearray(dicom)
    for element, value in ((0x10, rows), (0x11, columns)):
        at = content.index(tag(0x28, element))
        content[at + 8 : at + 10] = value.to_bytes(2, "little")
    if frames:
        text = str(frames).encode()
        text += b" " * (len(text) % 2)
        at = content.index(tag(0x28, 0x10))
        content[at:at] = tag(0x28, 0x08) + len(text).to_bytes(4, "little") + text
    return bytes(content)


@pytest.mark.parametrize(
    ("how", "name", "size", "words"),
    [
        ("one", "0.dcm", (65535, 65535), "voxels.* expected at most 2147483648 in all"),
        ("one", "IM0", (40, 50, 2000000), "voxels.* expected at most 2147483648 in all"),
        ("one", "IM0", (9000, 9000), r"promises .* voxels, \d+ bytes, which its \d+ bytes cannot hold; copy or export"),
        ("series", "0.dcm", (40, 50, 500), r"promises .* voxels, \d+ bytes, which its \d+ bytes cannot hold; copy or"),
        ("series", "IM0", (65535, 65535), "voxels.* expected at most 2147483648 in all"),
        ("folder", "IM0", (9000, 9000), r"promises .* voxels, \d+ bytes, which its \d+ bytes cannot hold; copy or"),
    ],
)
def test_what_a_dicom_file_promises_is_bounded_before_it_is_read(tmp_path, monkeypatch, name, size, words, how):
    """Without a suffix, and as one of a series, ITK asked for the memory that the header says."""
    import SimpleITK as sitk

    write_dicom(SERIES, tmp_path)
    whole = (tmp_path / "0.dcm").read_bytes()
    if how == "one":
        for path in tmp_path.iterdir():
            path.unlink()
        (tmp_path / name).write_bytes(of_size(whole, *size))
    else:
        for path in list(tmp_path.iterdir()):
            path.write_bytes(of_size(path.read_bytes(), *size))
            path.rename(path.with_name(path.name if name == "0.dcm" else f"IM{path.stem}"))
    monkeypatch.setattr(sitk.ImageFileReader, "Execute", lambda *_: pytest.fail("it was read"))
    monkeypatch.setattr(sitk.ImageSeriesReader, "Execute", lambda *_: pytest.fail("it was read"))
    with pytest.raises(SimulationError, match=words):
        Volume.read(tmp_path if how == "folder" else tmp_path / name)


def with_length(dicom: bytes, at: int, length: int) -> bytes:
    return dicom[:at] + length.to_bytes(4, "little") + dicom[at + 4 :]


@pytest.mark.parametrize(
    ("where", "door"),
    [
        ("meta", "file"), ("type", "file"), ("sequence", "file"), ("explicit", "file"), ("no prefix", "file"),
        ("patient", "folder"), ("patient", "array"),
    ],
)  # fmt: skip
def test_a_length_far_beyond_the_end_of_a_dicom_file_is_refused(tmp_path, where, door):
    """GDCM filled 4 GB with zeros for a file of 1.5 kB."""
    write_dicom(SERIES, tmp_path)
    whole = (tmp_path / "3.dcm").read_bytes()
    patient = whole.index(tag(0x10, 0x10))
    if where == "meta":  # its version, explicit as all of that part
        damaged = with_length(whole, whole.index(tag(2, 1)) + 8, 2**32 - 16)
    elif where == "type":  # GDCM took this text for a length then: 774 MB
        at = whole.index(tag(2, 3)) + 4
        damaged = whole[:at] + b"1.2." + whole[at + 4 :]
    elif where == "patient":
        damaged = with_length(whole, patient + 4, 2**32 - 16)
    elif where == "sequence":  # a code of an anatomic region
        code = tag(0x08, 0x0100) + b"\xf0\xff\xff\xf0" + b"T-A0100 "
        inner = tag(0xFFFE, 0xE000) + len(code).to_bytes(4, "little") + code
        damaged = whole[:patient] + tag(0x08, 0x2218) + len(inner).to_bytes(4, "little") + inner + whole[patient:]
    elif where == "explicit":
        name = tag(0x08, 0x0070) + b"UT\0\0\xf0\xff\xff\xf0" + b"nobody"
        damaged = whole[:132] + tag(2, 0x10) + b"UI\x14\x001.2.840.10008.1.2.1\0" + name
    else:
        damaged = with_length(whole, patient + 4, 2**32 - 16)[whole.index(tag(8, 0x16)) :]
    (tmp_path / "3.dcm").write_bytes(damaged)
    read = read_array if door == "array" else Volume.read
    words = r"has the type b'1\.', expected one of DICOM" if where == "type" else r"has 4\d{9} bytes, and \d+ are left"
    with pytest.raises(SimulationError, match=rf"3\.dcm: is damaged: its element .* {words}"):
        read(tmp_path if door == "folder" else tmp_path / "3.dcm")


def test_a_compressed_series_of_one_grey_level_is_read(tmp_path):
    """Its files are far smaller than its voxels."""
    volume = Volume(np.full((12, 256, 256), 7, np.int16), np.diag([-1.0, -1.0, 2.5, 1.0]))
    write_dicom(volume, tmp_path, compressor="JPEG2000")
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) < volume.array.nbytes / 100
    for path in (tmp_path, tmp_path / "3.dcm"):
        np.testing.assert_array_equal(Volume.read(path).array, volume.array)


def test_compressed_dicom_is_decoded_in_another_process(tmp_path, monkeypatch):
    """Decoders print several lines about a damaged one, and are where image libraries are broken into."""
    write_dicom(Volume(numbered((12, 40, 50)), np.diag([-1.0, -1.0, 2.5, 1.0])), tmp_path, compressor="JPEG2000")
    expected = Volume.read(tmp_path).array
    for name in ("ImageFileReader", "ImageSeriesReader"):
        monkeypatch.setattr(f"SimpleITK.{name}", lambda: pytest.fail("decoded here"))
    np.testing.assert_array_equal(Volume.read(tmp_path).array, expected)


@pytest.mark.parametrize("below", [False, True])
def test_a_folder_with_more_files_than_any_study_is_refused(tmp_path, monkeypatch, below):
    monkeypatch.setattr("SlicerUSSim.Logic.base.dicom._MOST_FILES", 5)
    place = tmp_path / "below" if below else tmp_path
    write_dicom(SERIES, place)
    with pytest.raises(SimulationError, match="has more than 5 files in it, give the folder of the series"):
        Volume.read(tmp_path)


def tag(group: int, element: int) -> bytes:
    return group.to_bytes(2, "little") + element.to_bytes(2, "little")


@pytest.mark.parametrize(
    ("where", "value", "words"),
    [
        (
            (0x20, 0x37),
            b"0\\1\\0\\1\\0\\0",
            r"has the orientation 0\\1.*, and \d\.dcm 1\\0.*, expected one in all images",
        ),
        ((0x20, 0x37), b"2\\0\\0\\0\\1\\0", r"has the orientation 2\\0.*, expected directions .* have length 1"),
        ((0x20, 0x32), b"nan", r"has the position 'nan.*' \(DICOM tag 0020,0032\), expected 3 numbers"),
        ((0x28, 0x30), b"0\\0 ", r"has voxels of 0 x 0 mm, expected 0\.01 to 50 mm"),
        ((0x28, 0x30), b"3\\1 ", r"has the pixel spacing 3\\1, and \d\.dcm 1\\1, expected one in all images"),
        ((0x28, 0x10), b"\x20\0", r"has the number of rows 32, and \d\.dcm 40, expected one in all images"),
        ((0x28, 0x101), b"\x09\0", r"has the BitsStored 9, and \d\.dcm \d+, expected one in all"),
        ((0x28, 0x103), b"\0\0", r"has the PixelRepresentation 0, and \d\.dcm \d+, expected one in all"),
        ((0x20, 0x37), None, r"has the orientation '' \(DICOM tag 0020,0037\), expected 6 numbers"),
    ],
)
def test_images_that_are_no_volume_together_are_refused(tmp_path, where, value, words):
    """Mixed orientations, places and spacings that are missing or no numbers, images of several sizes."""
    write_dicom(SERIES, tmp_path)
    file = tmp_path / "3.dcm"
    content = file.read_bytes()
    at = content.index(tag(*where))
    if value is None:
        content = content[:at] + tag(where[0], where[1] + 1 + (where[1] == 0x37)) + content[at + 4 :]
    else:
        content = content[: at + 8] + value + content[at + 8 + len(value) :]
    file.write_bytes(content)
    with pytest.raises(SimulationError, match=rf"3\.dcm:? {words}"):
        Volume.read(tmp_path)
    for path in tmp_path.glob("[45].dcm"):  # of three images as of six
        path.unlink()
    with pytest.raises(SimulationError, match=r"3\.dcm|0\.dcm"):
        Volume.read(tmp_path)


def with_pixels(dicom: bytes, pixels: bytes) -> bytes:
    at = dicom.index(tag(0x7FE0, 0x10)) + 4
    return dicom[:at] + len(pixels).to_bytes(4, "little") + pixels


def with_bits(dicom: bytes, element: int, value: int) -> bytes:
    at = dicom.index(tag(0x28, element)) + 8
    return dicom[:at] + value.to_bytes(2, "little") + dicom[at + 2 :]


@pytest.mark.parametrize(
    ("door", "which", "change", "words"),
    [
        ("folder", "3.dcm", lambda whole: with_pixels(whole, bytes(1000)), r"have 1000 bytes, expected 4000 for 40 ro"),
        ("file", "*.dcm", lambda whole: with_pixels(whole, bytes(3998)), r"have 3998 bytes, expected 4000"),
        ("array", "3.dcm", lambda whole: with_pixels(whole, bytes(3998)), r"have 3998 bytes, expected 4000"),
        ("folder", "*.dcm", lambda whole: with_bits(whole, 0x100, 32), r"expected 8000 .* 32 bits \(BitsAllocated\)"),
        ("array", "3.dcm", lambda whole: with_bits(whole, 0x100, 8), r"expected 2000 .* 8 bits \(BitsAllocated\)"),
        ("file", "3.dcm", lambda whole: with_bits(whole, 0x100, 8), r"has the BitsAllocated 8, and \d\.dcm 16, expec"),
    ],
)
def test_dicom_pixels_of_another_size_than_its_header_says_are_refused(tmp_path, change, words, which, door):
    """GDCM reads the missing ones as zeros without a word."""
    write_dicom(SERIES, tmp_path)
    for file in tmp_path.glob(which):
        file.write_bytes(change(file.read_bytes()))
    read = read_array if door == "array" else Volume.read
    with pytest.raises(SimulationError, match=rf"\d\.dcm:?.*{words}"):
        read(tmp_path if door == "folder" else tmp_path / "3.dcm")


def test_the_size_of_a_small_picture_in_a_dicom_file_is_not_the_images(tmp_path):
    write_dicom(SERIES, tmp_path)

    def element(group, number, value):
        return tag(group, number) + len(value).to_bytes(4, "little") + value

    picture = b"".join(
        element(0x28, number, value.to_bytes(2, "little"))
        for number, value in ((2, 1), (0x10, 8), (0x11, 8), (0x100, 8))
    ) + element(0x7FE0, 0x10, bytes(64))
    item = tag(0xFFFE, 0xE000) + b"\xff" * 4 + picture + tag(0xFFFE, 0xE00D) + bytes(4)
    icon = tag(0x88, 0x200) + b"\xff" * 4 + item + tag(0xFFFE, 0xE0DD) + bytes(4)
    for file in tmp_path.iterdir():
        whole = file.read_bytes()
        at = whole.index(tag(0x28, 0x02) + b"\2\0\0\0")
        file.write_bytes(whole[:at] + icon + whole[at:])
    np.testing.assert_array_equal(Volume.read(tmp_path).array, SERIES.array)
    whole = (tmp_path / "3.dcm").read_bytes()
    at = whole.rindex(tag(0x7FE0, 0x10)) + 4
    (tmp_path / "3.dcm").write_bytes(whole[:at] + (1000).to_bytes(4, "little") + bytes(1000))
    with pytest.raises(SimulationError, match=r"3\.dcm: its pixels have 1000 bytes, expected 4000"):
        Volume.read(tmp_path)


@pytest.mark.parametrize("name", ["i.nii", "i.nii.gz", "i.nrrd", "i.nhdr", "i.mha", "i.vti", "i.mgz"])
def test_a_file_whose_last_bytes_are_missing_is_refused(name, tmp_path):
    """All voxels may be there, but nothing says so: checksums and ends of files were not looked at."""
    rng = np.random.default_rng(0)
    volume = Volume(rng.integers(0, 1000, (20, 21, 22)).astype(np.int16), np.eye(4))
    if name.endswith(".mgz"):
        nibabel.save(nibabel.MGHImage(volume.array.T, np.eye(4)), tmp_path / name)  # type: ignore[attr-defined]
    else:
        volume.write(tmp_path / name)
    Volume.read(tmp_path / name)
    file = next(tmp_path.glob("*.raw*")) if name == "i.nhdr" else tmp_path / name
    whole = file.read_bytes()
    for missing in (1, 2, 4, 8, 11, 20, len(whole) // 2):
        file.write_bytes(whole.rstrip(b"\n" if name == "i.vti" else b"")[:-missing])
        with pytest.raises(SimulationError, match=re.escape(name)):
            Volume.read(tmp_path / name)
    if name not in ("i.vti", "i.mha", "i.nii"):
        file.write_bytes(whole[:-7] + bytes([whole[-7] ^ 1]) + whole[-6:])  # of the checksum
        with pytest.raises(SimulationError, match=re.escape(name)):
            Volume.read(tmp_path / name)


def test_metaimage_with_missing_voxels_says_so(tmp_path):
    Volume(numbered((20, 20, 20)), np.eye(4)).write(tmp_path / "image.mhd")
    (voxels,) = tmp_path.glob("image.*.raw")
    voxels.write_bytes(b"1234")
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


def test_what_is_wrong_with_an_unreadable_image_is_said(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    values = np.arange(60, dtype=np.int16).reshape(3, 4, 5)
    Volume(values, np.eye(4)).write(tmp_path / "good.nii.gz")
    (tmp_path / "packed.nii").write_bytes((tmp_path / "good.nii.gz").read_bytes())
    (tmp_path / "empty.nrrd").write_bytes(b"")
    (tmp_path / "text.nii.gz").write_text("no image")
    nibabel.save(nibabel.Nifti2Image(values, np.eye(4)), tmp_path / "second.nii.gz")
    for name, message in {
        "packed.nii": r"it is compressed by gzip: rename it to packed\.nii\.gz",
        "empty.nrrd": "it is empty, 0 bytes",
        "text.nii.gz": "it is not compressed by gzip, as its name says",
        "second.nii.gz": "it is NIfTI-2, expected NIfTI-1",
    }.items():
        with pytest.raises(SimulationError, match=f"{name}: .*{message}"):
            Volume.read(tmp_path / name)


def test_missing_and_unreadable_files_are_named(tmp_path):
    with pytest.raises(SimulationError, match=r"nothing\.nii: no such file"):
        Volume.read(tmp_path / "nothing.nii")
    (tmp_path / "bad.nii").write_text("not an image")
    with pytest.raises(SimulationError, match=r"bad\.nii: cannot be read"):
        Volume.read(tmp_path / "bad.nii")
    with pytest.raises(SimulationError, match=r"has no DICOM series.*images of their own \(bad\.nii\): give"):
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


def test_nan_around_the_head_is_read_as_zero_and_told(tmp_path, caplog):
    """ITK replaces it without a word; SPM writes it outside the brain."""
    nibabel = pytest.importorskip("nibabel")
    values = np.ones((6, 7, 8), np.float32)
    values[2, 3] = np.nan
    nibabel.Nifti1Image(values, np.eye(4)).to_filename(tmp_path / "mri.nii.gz")
    volume = Volume.read(tmp_path / "mri.nii.gz")
    assert "8 of 336 voxels, at the border of the volume, are NaN: they are read as 0" in caplog.text
    assert (volume.array == 0).sum() == 8
    values[:, :, 4:6] = np.nan
    nibabel.Nifti1Image(values, np.eye(4)).to_filename(tmp_path / "gap.nii.gz")
    with pytest.raises(SimulationError, match="2 slices are NaN between slices with values, the first at k = 4"):
        Volume.read(tmp_path / "gap.nii.gz")
    nibabel.Nifti1Image(np.full_like(values, np.nan), np.eye(4)).to_filename(tmp_path / "nothing.nii.gz")
    with pytest.raises(SimulationError, match="no voxel is a finite number"):
        Volume.read(tmp_path / "nothing.nii.gz")
    caplog.clear()
    nibabel.Nifti1Image(np.ones((6, 7, 8), np.float32), np.eye(4)).to_filename(tmp_path / "good.nii.gz")
    Volume.read(tmp_path / "good.nii.gz")
    assert not caplog.text


@pytest.mark.parametrize(("place", "value"), [((2, 3, 4), np.nan), ((0, 0, 0), np.inf)])
def test_voxels_within_the_head_that_are_no_numbers_are_refused(tmp_path, place, value):
    nibabel = pytest.importorskip("nibabel")
    values = np.ones((6, 7, 8), np.float32)
    values[5] = np.nan
    values[place] = value
    nibabel.Nifti1Image(values, np.eye(4)).to_filename(tmp_path / "mri.nii.gz")
    message = rf"1 of 336 voxels are not finite numbers, the first at \(i, j, k\) = \({', '.join(map(str, place))}\)"
    with pytest.raises(SimulationError, match=message):
        Volume.read(tmp_path / "mri.nii.gz")


def test_voxels_of_others_stay_beside_a_header(tmp_path):
    """A user's file whose name looks like ours, voxels of a header with the same stem, and of a copied header."""
    theirs = tmp_path / "a.0123456789abcdef.raw"
    plain = tmp_path / "a.raw"  # as ITK would call ours
    theirs.write_bytes(b"the MRI")
    plain.write_bytes(b"another MRI")
    images = [Volume(numbered((20, 20, 20)) + n, np.eye(4)) for n in range(4)]
    images[0].write(tmp_path / "a.mhd")
    images[1].write(tmp_path / "a.nhdr")
    (tmp_path / "copy.mhd").write_bytes((tmp_path / "a.mhd").read_bytes())
    images[2].write(tmp_path / "a.mhd")
    images[3].write(tmp_path / "a.mhd")
    assert theirs.read_bytes() == b"the MRI" and plain.read_bytes() == b"another MRI"
    for name, image in (("a.mhd", images[3]), ("a.nhdr", images[1]), ("copy.mhd", images[0])):
        assert np.array_equal(Volume.read(tmp_path / name).array, image.array)
    assert len(list(tmp_path.glob("a.*.raw*"))) == 4  # those of images[2] are gone
    assert not list(tmp_path.glob(".ussim-*"))


_WRITERS = """
import os, sys
import numpy as np
from SlicerUSSim.Logic import Volume

path = sys.argv[1]
volumes = [Volume((np.arange(1320) % n).reshape(12, 11, 10).astype(np.int16), np.eye(4)) for n in (50, 60)]
for _ in range(15):
    children = []
    for first in range(3):
        child = os.fork()
        if child == 0:
            for number in range(4):
                volumes[(first + number) % 2].write(path)
            os._exit(0)
        children.append(child)
    assert all(os.waitpid(child, 0)[1] == 0 for child in children), "a writer failed"
    found = Volume.read(path).array
    assert any(np.array_equal(found, volume.array) for volume in volumes), "halves of two runs"
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="processes are forked")
def test_runs_that_write_one_header_at_once_leave_the_voxels_that_it_names(tmp_path):
    """One removed the voxels that another had moved, but not named yet."""
    subprocess.run([sys.executable, "-c", _WRITERS, str(tmp_path / "a.mhd")], check=True)
    assert len(list(tmp_path.iterdir())) == 2


def test_voxels_that_a_header_names_but_we_did_not_write_stay(tmp_path):
    image = Volume(numbered((20, 20, 20)), np.eye(4))
    image.write(tmp_path / "a.mhd")
    (ours,) = tmp_path.glob("a.*.raw")
    theirs = tmp_path / "a.0123456789abcdef.raw"
    ours.rename(theirs)
    header = tmp_path / "a.mhd"
    header.write_text(header.read_text().replace(ours.name, theirs.name))
    Volume(image.array + 1, np.eye(4)).write(header)
    assert theirs.is_file()


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
    """Of a NIfTI file ITK did not say so: the file before was replaced by an empty one."""
    names = ["v.mha", "v.nii", "v.nii.gz", "v.nrrd", "v.vti"]
    done = subprocess.run([sys.executable, "-c", _FULL, *names], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0 and done.stderr == ""  # ITK and VTK told of it in words of their own
    assert sorted(file.name for file in tmp_path.iterdir()) == names
    for name in names:
        assert done.stdout.count(f"{name}: cannot be written") == 2, done.stdout
        kept = Volume.read(tmp_path / name)
        assert kept.array.shape == (10, 10, 10) and (kept.array == 1).all()


def test_a_minc_file_is_not_begun_where_it_may_not_fit(tmp_path, monkeypatch):
    """HDF5 left a torso without an error, and ended the program when it was closed."""
    volume = Volume(np.ones((10, 10, 10), np.uint8), np.eye(4))
    volume.write(tmp_path / "v.mnc")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=7999))
    with pytest.raises(SimulationError, match=r"v\.mnc: cannot be written \(may need 8000 bytes, .* 7999 left\)"):
        Volume(np.zeros((20, 20, 20), np.uint8), np.eye(4)).write(tmp_path / "v.mnc")
    assert (Volume.read(tmp_path / "v.mnc").array == 1).all() and len(list(tmp_path.iterdir())) == 1
