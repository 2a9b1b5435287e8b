"""Files whose headers made ITK and VTK crash, hang or allocate everything, and what else fuzzing found."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk

from SlicerUSSim.Logic import SimulationError, Volume
from SlicerUSSim.Logic.tissue import TissueTable
from SlicerUSSim.Logic.tissue.label_files import read_names
from SlicerUSSim.Logic.tracked.pose_files import read_coordinate_definitions, read_pose, read_tags, read_transform

ARRAY = (np.arange(6 * 5 * 4) % 200).reshape(6, 5, 4).astype(np.int16)


def written(folder: Path, suffix: str) -> Path:
    path = folder / f"image{suffix}"
    Volume(ARRAY, np.diag([1.0, 1.0, 2.0, 1.0])).write(path)
    return path


def with_bytes(path: Path, old: bytes, new: bytes) -> Path:
    content = path.read_bytes()
    assert content.count(old) >= 1
    path.write_bytes(content.replace(old, new, 1))
    return path


def refused(path: Path, words: str, read=Volume.read) -> None:
    with pytest.raises(SimulationError, match=re.escape(words)) as error:
        read(path)
    assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("suffix", "old", "new", "words"),
    [
        (".mha", b"NDims = 3", b"NDims = 999999999999999999999", "the library that reads it crashed"),
        (".mha", b"-1 0 0 0 -1 0 0 0 1", b"-1 0 0 0 -1 0 0 nan 1", "cannot be read as an image"),
        (".mha", b"DimSize = 4 5 6", b"DimSize = 4 5 4294967296", "has 4x5x4294967296 voxels, expected at most"),
        (".mha", b"DimSize = 4 5 6", b"DimSize = 4 5 600000", "copy or export it again"),
        (".nii", b"\0\0\xb0\x43", b"\0\0\0\0", "vox_offset is 0, expected 352 or more, behind the header"),
        (".mha", b"DimSize = 4 5 6", b"DimSize = 4 5 12", "has 240 bytes of voxels, expected 480 for 4x5x12"),
        (".mha", b"ElementDataFile", b"ElementDataPile", "its header has no line ElementDataFile"),
        (".mha", b"LOCAL", b"%n%n.raw 1 9 1", "ElementDataFile is '%n%n.raw 1 9 1', expected a file"),  # went to printf
        (".vti", b'WholeExtent="0 3 0 4 0 5"', b'WholeExtent="0 999999999 0 4 0 5"', "cannot be read"),
        (".vti", b'Spacing="1 1 2"', b'Spacing="1 1 1e308"', "ijk_to_ras is singular"),
        (".vti", b"<ImageData", b"<ImageDada", "cannot be read as a VTK image"),
    ],
)
def test_an_image_that_no_reader_survives_is_refused(tmp_path, suffix, old, new, words):
    refused(with_bytes(written(tmp_path, suffix), old, new), words)


def test_slices_in_numbered_files_are_read(tmp_path):
    for number, slice_ in enumerate(ARRAY, 1):
        (tmp_path / f"slice{number:03d}.raw").write_bytes(slice_.tobytes())
    header = (
        written(tmp_path, ".mha").read_bytes().partition(b"ElementDataFile")[0].replace(b"Data = True", b"Data = False")
    )
    header = header.replace(b"BinaryData = False", b"BinaryData = True")
    (tmp_path / "image.mhd").write_bytes(header + b"ElementDataFile = slice%03d.raw 1 6 1\n")
    np.testing.assert_array_equal(Volume.read(tmp_path / "image.mhd").array, ARRAY)


@pytest.mark.parametrize(
    ("mm", "words"),
    [(0.001, "look like metres"), (1000.0, "look like micrometres"), (70.0, "expected 0.01 to 50 mm along every axis")],
)
def test_voxels_in_another_unit_are_refused_with_the_unit(tmp_path, mm, words):
    image = sitk.GetImageFromArray(ARRAY)
    image.SetSpacing([mm] * 3)
    path = tmp_path / "image.mha"
    sitk.WriteImage(image, str(path))
    refused(path, words)


@pytest.mark.skipif(os.name != "posix", reason="names of bytes")
def test_a_name_that_is_not_utf8_is_refused(tmp_path):
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/a\xff.nii"))
    path.write_bytes(written(tmp_path, ".nii").read_bytes())
    with pytest.raises(SimulationError, match="its name has bytes that are not UTF-8") as error:
        Volume.read(path)
    str(error.value).encode()


@pytest.mark.parametrize(
    "old, new, words",
    [
        ("0.1 0.2", "inf 0.2", "Parameters of Euler3DTransform has 'inf', expected numbers"),  # ended the process
        ("0.1 0.2", "\u0663 0.2", "Parameters of Euler3DTransform has '\u0663', expected numbers"),  # ITK saw five
        ("0.1 0.2 ", "", "Euler3DTransform has 4 parameters, expected 6"),  # was made of the next bytes in memory
        ("Parameters: 0.1", "P: 0.1", "expected Transform, Parameters and FixedParameters"),  # was the identity
        ("\nFixedParameters: 0 0 0 0", "", "expected Transform, Parameters and FixedParameters"),  # was the identity
        ("Euler3DTransform_double_3_3", "BSplineTransform_double_3_3", "expected a linear one"),
        ("Euler3DTransform_double_3_3", "Euler2DTransform_double_2_2", "expected a linear one in three dimensions"),
        ("#Transform 0\n", "#Transform 0\nTransform: IdentityTransform_double_3_3\nParameters: \nFixedParameters: \n",
         "has 2 transforms that are not chained"),  # all but the first were left out
    ],
)  # fmt: skip
def test_a_transform_without_all_its_numbers_is_refused(tmp_path, old, new, words):
    path = tmp_path / "pose.tfm"
    sitk.WriteTransform(sitk.Euler3DTransform((0, 0, 0), 0.1, 0.2, 0.3, (1, 2, 3)), str(path))
    refused(with_bytes(path, old.encode(), new.encode()), words, read_pose)


@pytest.mark.parametrize("suffix", [".tfm", ".mat", pytest.param(".h5", marks=pytest.mark.slow)])
def test_every_rigid_kind_of_transform_and_a_chain_of_them_are_read(tmp_path, suffix):
    path = tmp_path / f"pose{suffix}"
    euler = sitk.Euler3DTransform((0, 0, 0), 0.1, 0.2, 0.3, (1, 2, 3))
    affine = sitk.AffineTransform(3)
    affine.SetMatrix(euler.GetMatrix())
    affine.SetTranslation(euler.GetTranslation())
    versor = sitk.VersorRigid3DTransform()
    versor.SetMatrix(euler.GetMatrix())
    versor.SetTranslation(euler.GetTranslation())
    sitk.WriteTransform(euler, str(path))
    expected = read_pose(path)
    assert abs(expected - np.eye(4)).max() > 1.0
    for other in (affine, versor):
        sitk.WriteTransform(other, str(path))
        np.testing.assert_allclose(read_pose(path), expected, atol=1e-12)
    if suffix != ".mat":  # which holds no chain
        sitk.WriteTransform(sitk.CompositeTransform([euler, sitk.TranslationTransform(3, (0, 0, 5))]), str(path))
        np.testing.assert_allclose(read_pose(path)[:3, :3], expected[:3, :3], atol=1e-12)
        assert abs(read_pose(path)[:3, 3] - expected[:3, 3]).max() > 1.0


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("p.txt", read_pose), ("t.tfm", read_pose), ("t.xfm", read_transform), ("p.tag", read_tags),
        ("plus.xml", read_coordinate_definitions), ("n.ctbl", read_names), ("p.json", read_pose),
        ("t.json", TissueTable.read),
    ],
)  # fmt: skip
def test_a_text_far_larger_than_its_kind_is_refused_before_it_is_read(tmp_path, name, read):
    path = tmp_path / name
    path.write_text("#Insight\n" if name == "t.tfm" else "1 ")
    os.truncate(path, 2**40)  # without blocks on the disk
    refused(path, f"has {2**40} bytes, expected at most", read)
