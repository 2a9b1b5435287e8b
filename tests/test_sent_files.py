"""SentFiles: what a page has sent is kept for scripts: files, folders of DICOM images, and files read together."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import pytest

SentFiles = pytest.importorskip("SlicerUSSim.Workstation.opener").SentFiles


def bundled(sent, *names: str) -> dict[str, bytes]:
    """{name: content} of what goes with a script that needs these names."""
    with zipfile.ZipFile(io.BytesIO(sent.bundle("script", names, lambda share: None))) as archive:
        assert archive.read("image.py") == b"script"
        return {name: archive.read(name) for name in archive.namelist() if name != "image.py"}


def written(folder: Path, **contents: bytes) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / name for name in contents]
    for path, content in zip(paths, contents.values(), strict=True):
        path.write_bytes(content)
    return paths


def kept(sent, path: Path, others: list[Path] | None = None) -> str:
    name = sent.name_for(path, others or [])
    sent.keep(name, path, others or [])
    return name


def test_files_of_one_name_stay_apart_and_the_same_file_is_kept_once(tmp_path):
    sent = SentFiles()
    names = [
        kept(sent, written(tmp_path / str(n), **{"m.nii.gz": content})[0])
        for n, content in enumerate((b"1", b"2", b"1"))
    ]
    assert names == ["m.nii.gz", "m (2).nii.gz", "m.nii.gz"] and len(sent.files) == 2
    assert bundled(sent, "m (2).nii.gz") == {"m (2).nii.gz": b"2"}
    sent.forget(["m.nii.gz"])
    assert list(sent.files) == ["m.nii.gz"] and sent.has("m.nii.gz") and not sent.has("m (2).nii.gz")


def test_a_series_is_kept_as_its_folder(tmp_path):
    sent = SentFiles()
    for n, content in enumerate((b"1", b"other")):
        written(tmp_path / str(n) / "T1 1.5 mm 3", IM1=content, IM2=b"2")
    name, other = (kept(sent, tmp_path / str(n) / "T1 1.5 mm 3") for n in range(2))
    assert name == "T1 1.5 mm 3" and other == "T1 1 (2).5 mm 3" and sent.has(other)
    written(tmp_path / "2" / "T1 1.5 mm 3", IM1=b"1", IM2=b"2")
    assert sent.name_for(tmp_path / "2" / "T1 1.5 mm 3") == "T1 1.5 mm 3"
    assert bundled(sent, "T1 1.5 mm 3") == {"T1 1.5 mm 3/IM1": b"1", "T1 1.5 mm 3/IM2": b"2"}
    sent.forget([other])
    assert set(sent.files) == {f"{other}/IM1", f"{other}/IM2"}


def test_maps_that_are_read_together_are_kept_together_under_their_names(tmp_path):
    """Their reader knows them by these names."""
    sent = SentFiles()
    names = []
    for patient in (b"a", b"b"):
        one, *others = written(tmp_path / patient.decode(), **{f"c{n}head.nii": patient for n in (1, 2, 3)})
        names.append(kept(sent, one, others))
    assert names == ["c1head/c1head.nii", "c1head (2)/c1head.nii"]
    for name, patient in zip(names, (b"a", b"b"), strict=True):
        folder = name.partition("/")[0]
        assert bundled(sent, name) == {f"{folder}/c{n}head.nii": patient for n in (1, 2, 3)}
    sent.forget([names[1]])
    assert {name.partition("/")[0] for name in sent.files} == {"c1head (2)"}
