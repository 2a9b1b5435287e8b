"""What a page may send: plain names and whole files."""

from __future__ import annotations

import numpy as np
import pytest
import SimpleITK as sitk

from SlicerUSSim.Logic import SimulationError, Volume
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence

uploads = pytest.importorskip("SlicerUSSim.Workstation.uploads")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("../mri.nii.gz", "is no plain file name"),
        ("/etc/cron.d/x", "is no plain file name"),
        ("a\\b.nii", "is no plain file name"),
        ("a\0.nii", "is no plain file name"),
        ("", "is no plain file name"),
        ("x" * 300 + ".nii", "its name has 304 bytes, expected at most 200"),
    ],
)
def test_names_that_are_paths_are_refused(name, words):
    with pytest.raises(SimulationError, match=words) as error:
        uploads.require_whole_files({name: b"1"})
    assert str(error.value).isprintable() and len(str(error.value)) < 200


@pytest.mark.parametrize("suffix", [".mhd", ".nhdr"])
def test_a_header_that_names_another_file_is_refused(suffix, tmp_path):
    """It put any file of the server's user into a scene."""
    path = tmp_path / f"image{suffix}"
    sitk.WriteImage(sitk.GetImageFromArray(np.ones((3, 4, 5), np.uint8)), str(path))
    for name in (path.name, f"image.{'mha' if suffix == '.mhd' else 'nrrd'}"):
        with pytest.raises(SimulationError, match=r"is a header whose voxels are in another file \(image\.\w+"):
            uploads.require_whole_files({name: path.read_bytes()})


@pytest.mark.parametrize("suffix", [".mha", ".nrrd", ".nii.gz"])
def test_whole_files_are_taken(suffix, tmp_path):
    path = tmp_path / f"image{suffix}"
    Volume(np.ones((3, 4, 5), np.uint8), np.eye(4)).write(path)
    uploads.require_whole_files({path.name: path.read_bytes(), "labels of a patient.json": b"{}"})


@pytest.mark.parametrize("suffix", [".igs.mha", ".seq.nrrd"])
def test_whole_sequences_are_taken(suffix, tmp_path):
    path = tmp_path / f"sweep{suffix}"
    TrackedSequence(np.zeros((2, 4, 5), np.uint8), ({"ImageToReference": np.eye(4)},) * 2, np.arange(2.0)).write(path)
    uploads.require_whole_files({path.name: path.read_bytes()})


def test_more_than_two_gigabytes_are_refused(monkeypatch):
    monkeypatch.setattr(uploads, "MOST_BYTES", 3)
    with pytest.raises(SimulationError, match=r"a\.nii, b\.nii: 4 bytes, expected at most 3"):
        uploads.require_whole_files({"a.nii": b"12", "b.nii": b"34"})
