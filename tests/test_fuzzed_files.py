"""Damaged files of every format that is read: what comes back is what was meant, or one line with the file's name.

    USSIM_FUZZ=10000 python -m pytest tests/test_fuzzed_files.py

tries that many inputs per format instead of some hundred. What once ended the process, hung or was raised is kept in
tests/corpus, under names that begin with the format.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import SimpleITK as sitk
from hypothesis import HealthCheck, given, settings, strategies as st

from SlicerUSSim.Logic import SimulationError, TissueTable, Volume
from SlicerUSSim.Logic.base import reading
from SlicerUSSim.Logic.base.reading import ReadingLimits
from SlicerUSSim.Logic.base.volume import read_image_file
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mri.sheets.polydata import read_surfels, write_surfels
from SlicerUSSim.Logic.tissue import Surfels
from SlicerUSSim.Logic.tissue.label_files import read_names
from SlicerUSSim.Logic.tracked.pose_files import (
    read_coordinate_definitions,
    read_matrix,
    read_pose,
    read_tags,
    read_transform,
    write_pose,
)
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence

CORPUS = sorted((Path(__file__).parent / "corpus").iterdir())
#: What stands in damaged headers for a number
NUMBERS = (
    "1e6", "1e308", "-1e308", "4294967296", "2147483647", "65536", "-1", "0", "nan", "inf", "9" * 21, "1e-300", "3 3 3",
    "", "\0",
)  # fmt: skip


def write_volume(path: Path) -> None:
    array = (np.arange(12 * 11 * 10) % 200).reshape(12, 11, 10).astype(np.int16)
    Volume(array, np.diag([1.0, 1.0, 2.0, 1.0])).write(path)


def write_minc(path: Path) -> None:
    sitk.WriteImage(sitk.GetImageFromArray(np.arange(1320, dtype=np.float32).reshape(12, 11, 10)), str(path))


def write_mgh(path: Path) -> None:
    nibabel = pytest.importorskip("nibabel")
    nibabel.MGHImage(np.arange(60, dtype=np.float32).reshape(5, 4, 3), np.eye(4)).to_filename(path)


def write_sequence(path: Path) -> None:
    if path.suffix == ".nrrd":
        pytest.importorskip("nrrd")
    images = np.random.default_rng(0).integers(0, 255, (3, 20, 16)).astype(np.uint8)
    transforms = ({"ImageToReference": np.eye(4), "ProbeToReference": np.eye(4)},) * 3
    TrackedSequence(images, transforms, np.arange(3.0)).write(path)


def write_transform(path: Path) -> None:
    sitk.WriteTransform(sitk.Euler3DTransform((0, 0, 0), 0.1, 0.2, 0.3, (1, 2, 3)), str(path))


def write_dicom(path: Path) -> None:
    sitk.WriteImage(sitk.GetImageFromArray(np.arange(80, dtype=np.uint16).reshape(4, 4, 5)), str(path))


def write_bare_dicom(path: Path) -> None:
    whole = path.with_suffix(".dcm")
    write_dicom(whole)
    whole.rename(path)


def write_compressed_dicom(path: Path) -> None:
    writer = sitk.ImageFileWriter()
    writer.UseCompressionOn()
    writer.SetCompressor("JPEG2000")
    writer.SetFileName(str(path))
    # A small one corrupts the memory of its writer
    image = sitk.GetImageFromArray(np.add.outer(np.arange(64), np.arange(48)).astype(np.uint16))
    for tag, value in {"0020|0032": "0\\0\\0", "0020|0037": "1\\0\\0\\0\\1\\0", "0008|0060": "MR"}.items():
        image.SetMetaData(tag, value)
    writer.Execute(image)


def write_dicom_series(path: Path) -> None:
    """Twelve images in a folder, one of which is `path`."""
    image = sitk.GetImageFromArray(np.arange(20, dtype=np.uint16).reshape(4, 5))
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    for k in range(12):
        for key, value in {
            "0008|0060": "MR", "0020|000e": "1.2.3", "0020|0032": f"0\\0\\{2 * k}", "0020|0037": "1\\0\\0\\0\\1\\0",
            "0008|0018": f"1.2.3.{k}",
        }.items():  # fmt: skip
            image.SetMetaData(key, value)
        writer.SetFileName(str(path.with_name(f"{k}.dcm")))
        writer.Execute(image)


def text(content: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(content)


TAGS = 'MNI Tag Point File\nVolumes = 2;\nPoints =\n 1.5 2.5 3 4 5 6 "a"\n -1 2 3 -4 5 6 "b"\n 7 8 9 7 8 9 "";\n'
XFM = "MNI Transform File\n%c\nTransform_Type = Linear;\nLinear_Transform =\n 1 0 0 4\n 0 1 0 5\n 0 0 1 6;\n"
COLOURS = "# Color table file x\n0 Background 0 0 0 0\n1 csf 0 0 255 255\n24 Left-Lateral 1 2 3 255\n"
PLUS = (
    '<PlusConfiguration version="2.1"><CoordinateDefinitions><Transform From="Image" To="Probe" '
    'Matrix="1 0 0 1 0 1 0 2 0 0 1 3 0 0 0 1"/></CoordinateDefinitions></PlusConfiguration>'
)


class Format(NamedTuple):
    """A kind of file: its name, how an intact one is written, and what reads it."""

    name: str
    write: Callable[[Path], object]
    read: Callable[[Path], object]
    #: The part of the file in which most of the damage is: its header
    header_bytes: int
    #: Whether each input costs a child process
    in_child: bool = False
    #: Whether what is read is the folder of the file
    folder: bool = False

    def of(self, path: Path) -> Path:
        """What is read."""
        return path.parent if self.folder else path


FORMATS = {
    "mha": Format("v.mha", write_volume, Volume.read, 400, in_child=True),
    "nii": Format("v.nii", write_volume, Volume.read, 352),
    "nii.gz": Format("v.nii.gz", write_volume, Volume.read, 400),
    "nrrd": Format("v.nrrd", write_volume, Volume.read, 400),
    "vti": Format("v.vti", write_volume, Volume.read, 1200, in_child=True),
    "mgz": Format("v.mgz", write_mgh, Volume.read, 400),
    "mgh": Format("v.mgh", write_mgh, Volume.read, 284),
    "mnc": Format("v.mnc", write_minc, Volume.read, 9000, in_child=True),
    "dcm": Format("v.dcm", write_dicom, Volume.read, 900),
    "IM": Format("IM1", write_bare_dicom, Volume.read, 900),
    "j2k": Format("j.dcm", write_compressed_dicom, read_image_file, 900, in_child=True),
    "dcms": Format("3.dcm", write_dicom_series, Volume.read, 900, folder=True),
    "mhaseq": Format("s.igs.mha", write_sequence, TrackedSequence.read, 1500, in_child=True),
    "nrrdseq": Format("s.seq.nrrd", write_sequence, TrackedSequence.read, 1500),
    "pose": Format("p.json", lambda path: write_pose(path, np.eye(4)), read_pose, 250),
    "pose.txt": Format("p.txt", text("1 0 0 4\n0 1 0 5\n0 0 1 6\n0 0 0 1\n"), read_pose, 40),
    "matrix": Format("p.txt", text("1 0 0 4\n0 1 0 5\n0 0 1 6\n0 0 0 1\n"), read_matrix, 40),
    "tfm": Format("t.tfm", write_transform, read_pose, 200),
    "h5": Format("t.h5", write_transform, read_pose, 8000, in_child=True),
    "xfm": Format("t.xfm", text(XFM), read_transform, 200),
    "tag": Format("t.tag", text(TAGS), read_tags, 200),
    "tissues": Format("t.json", TissueTable.brain().write, TissueTable.read, 3000),
    "preset": Format("p.json", Preset().write, Preset.read, 3000),
    "ctbl": Format("n.ctbl", text(COLOURS), read_names, 150),
    "xml": Format("plus.xml", text(PLUS), read_coordinate_definitions, 200),
    "vtp": Format("s.vtp", lambda path: write_surfels(path, surfels()), read_surfels, 2000, in_child=True),
}


def surfels() -> Surfels:
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(20, 3))
    unit = normals / np.linalg.norm(normals, axis=1)[:, None]
    return Surfels.of("falx", rng.normal(size=(20, 3)), unit, 0.3, 1.0, 1.0)


def inputs(name: str) -> int:
    """Inputs to try of a format."""
    wanted = int(os.environ.get("USSIM_FUZZ", "150"))
    costs = 20 if FORMATS[name].in_child else 3 if name in ("IM", "dcm", "dcms") else 1
    return max(wanted // costs, 6)


@st.composite
def damages(draw: st.DrawFn, whole: bytes, header_bytes: int) -> bytes:
    """A file with up to three damages: numbers, bytes, a cut, and what was lost or came in between."""
    content = bytearray(whole)
    for _ in range(draw(st.integers(1, 3))):
        last = max(min(len(content), header_bytes) - 1, 0)
        place = draw(st.integers(0, last) | st.integers(0, max(len(content) - 1, 0)))
        how = draw(st.sampled_from(("number", "number", "bytes", "cut", "lost", "inserted")))
        found = list(re.finditer(rb"[-+0-9.eE]+", bytes(content[:header_bytes]))) if how == "number" else []
        if found:
            match = draw(st.sampled_from(found))
            content[match.start() : match.end()] = draw(st.sampled_from(NUMBERS)).encode()
        elif how == "cut":
            del content[place:]
        elif how == "lost":
            del content[place : place + draw(st.sampled_from((1, 4, 64)))]
        else:
            new = draw(st.binary(min_size=1, max_size=16) | st.sampled_from((b"\xff" * 4, b"\0" * 8, b"\x7f\xff")))
            content[place : place + (0 if how == "inserted" else len(new))] = new
    return bytes(content)


def is_read_or_refused(path: Path, read: Callable[[Path], object]) -> None:
    """Read a file; whatever is raised is a SimulationError of one line with the file's name."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            found = read(path)
        except SimulationError as error:
            message = str(error)
            assert path.name in message and "\n" not in message and len(message) < 2000
            return
    if isinstance(found, Volume):
        assert np.isfinite(found.ijk_to_ras).all() and abs(np.linalg.det(found.ijk_to_ras[:3, :3])) > 0
    elif isinstance(found, np.ndarray):
        assert np.isfinite(found).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", list(FORMATS))
def test_a_damaged_file_is_read_or_refused_in_one_line(name, tmp_path_factory):
    file, folder = FORMATS[name], tmp_path_factory.mktemp("fuzz")
    path = folder / file.name
    file.write(path)
    assert file.read(file.of(path)) is not None
    whole = path.read_bytes()

    @settings(
        max_examples=inputs(name), deadline=None, derandomize=True, database=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.large_base_example],
    )  # fmt: skip
    @given(content=damages(whole, file.header_bytes))
    def damaged(content: bytes) -> None:
        path.write_bytes(content)
        is_read_or_refused(file.of(path), file.read)

    damaged()


#: Refused after the limit of a minute, which a test does not wait for
ENDLESS, SHORTER = "bad_vol_mha_70.mha", ReadingLimits(seconds=10.0)


@pytest.mark.parametrize(
    "kept",
    [pytest.param(path, marks=pytest.mark.slow if path.name == ENDLESS else (), id=path.name) for path in CORPUS],
)
def test_what_once_failed_is_read_or_refused_in_one_line(kept, tmp_path, monkeypatch):
    if kept.name == ENDLESS:
        monkeypatch.setattr(reading, "ReadingLimits", lambda: SHORTER)
    name = kept.name.split("_")[1]
    name = {"vol": kept.suffix[1:], "mhau": "mhaseq"}.get(name, name)
    path = tmp_path / FORMATS[name].name
    path.write_bytes(kept.read_bytes())
    is_read_or_refused(path, FORMATS[name].read)
