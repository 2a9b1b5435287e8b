"""What a page sends together: formats by content, DICOM series, and what each file is."""

from __future__ import annotations

import json
import logging

import numpy as np
import pytest
import SimpleITK as sitk

from SlicerUSSim.Logic import SimulationError, Volume
from SlicerUSSim.Logic.base.reading import untrusted_folder
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mri.samples import head_mri
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence
from tests.test_label_maps import head

content = pytest.importorskip("SlicerUSSim.Workstation.content")
formats = pytest.importorskip("SlicerUSSim.Workstation.formats")
parcels = pytest.importorskip("SlicerUSSim.Workstation.parcel")
uploads = pytest.importorskip("SlicerUSSim.Workstation.uploads")
Kind, Parcel = content.Kind, parcels.Parcel

SEQUENCE = TrackedSequence(np.full((2, 8, 9), 3, np.uint8), ({"ImageToReference": np.eye(4)},) * 2, np.arange(2.0))


@pytest.mark.parametrize("ending", [".nii.gz", ".nrrd", ".mha", ".vti"])
def test_a_format_is_known_by_its_content(tmp_path, ending):
    path = tmp_path / f"v{ending}"
    Volume(np.arange(60, dtype=np.float32).reshape(3, 4, 5), np.eye(4)).write(path)
    data = path.read_bytes()
    assert formats.readable_name("V" + ending.upper(), data) == "V" + ending.upper()
    assert formats.readable_name("scan", data) == f"scan{ending}"
    assert formats.readable_name("scan.dat", data) == f"scan.dat{ending}"
    with untrusted_folder() as folder:
        parcel = Parcel(folder, {"scan.dat": data})
        assert parcel.renamed == {f"scan.dat{ending}": "scan.dat"}
        assert Volume.read(parcel.paths[0]).array.shape == (3, 4, 5)


@pytest.mark.parametrize(
    ("text", "ending"),
    [
        ('{"a": 1}', ".json"),
        ("MNI Tag Point File\nVolumes = 2;", ".tag"),
        ("MNI Transform File\n", ".xfm"),
        ("#Insight Transform File V1.0\n", ".tfm"),
        ("<PlusConfiguration/>", ".xml"),
        ('<?xml version="1.0"?><VTKFile type="PolyData">', ".vtp"),
        ("what is this", ""),
        ("", ""),
    ],
)
def test_texts_are_known_by_their_first_words(text, ending):
    assert formats.readable_name("x", text.encode()) == f"x{ending}"


def test_a_header_of_another_file_stays_refused_under_any_name(tmp_path):
    """Renamed by its content it would name its voxels again."""
    sitk.WriteImage(sitk.GetImageFromArray(np.ones((3, 4, 5), np.uint8)), str(tmp_path / "v.mhd"))
    data = (tmp_path / "v.mhd").read_bytes()
    for name in ("v", "v.dat", "v.img", "v.dcm"):
        with pytest.raises(SimulationError, match="is a header whose voxels are in another file"):
            uploads.require_whole_files({name: data})


def test_files_of_one_name_in_several_folders_are_all_kept():
    files = uploads.plain_names([("IM1", b"a"), ("IM1", b"b"), ("2 IM1", b"c"), ("IM1", b"d")])
    assert sorted(files.values()) == [b"a", b"b", b"c", b"d"] and list(files)[:2] == ["IM1", "2 IM1"]
    with pytest.raises(SimulationError, match="10001 files are sent at once, expected at most 10000"):
        uploads.require_whole_files({str(n): b"" for n in range(10_001)})


@pytest.mark.parametrize("name", ["a.igs.mha", "a.nrrd", "a"])
def test_tracked_ultrasound_is_one_under_any_name(tmp_path, name):
    SEQUENCE.write(tmp_path / (name if name.endswith((".mha", ".nrrd")) else "a.mha"))
    (data,) = [path.read_bytes() for path in tmp_path.iterdir()]
    with untrusted_folder() as folder:
        parcel = Parcel(folder, {name: data})
        assert content.content_of(parcel.paths[0]).kind is Kind.SEQUENCE
        assert len(TrackedSequence.read(parcel.paths[0])) == 2


def test_what_images_are(tmp_path):
    mri = head_mri(3.0)
    mask = mri.with_array((mri.array > 0).astype(np.uint8))
    for name, volume, kind, words in (
        ("mri", mri, Kind.MRI, "an MRI of a brain without skull, "),
        ("mask", mask, Kind.MASK, "a mask of one region, "),
        ("aseg", head(), Kind.LABELS, "a label map: FreeSurfer, 8 labels, "),
    ):
        volume.write(tmp_path / f"{name}.nii.gz")
        found = content.content_of(tmp_path / f"{name}.nii.gz")
        assert found.kind is kind and found.what.startswith(words), found.what
        assert found.volume is not None and np.array_equal(found.volume.array, volume.array)


def test_what_texts_are(tmp_path):
    Preset().write(tmp_path / "preset.json")
    for name, text, kind in (
        ("pose.json", json.dumps({"probe_to_ras": np.eye(4).tolist()}), Kind.POSE),
        ("matrix.json", json.dumps(np.eye(4).tolist()), Kind.TRANSFORM),
        ("matrix.txt", "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", Kind.TRANSFORM),
        ("map.json", '{"24": "csf"}', Kind.TABLE),
        ("names.txt", '24 0 0 0 1 1 1 "csf"', Kind.TABLE),
        ("plus.xml", "<PlusConfiguration/>", Kind.TRANSFORM),
    ):
        (tmp_path / name).write_text(text)
        assert content.content_of(tmp_path / name).kind is kind, name
    assert content.content_of(tmp_path / "preset.json").kind is Kind.PRESET


# ---- DICOM -----------------------------------------------------------------------------------------------------------


def write_series(folder, volume: Volume, number: int, description: str, patient: str = "Miller^Secret") -> None:
    """A series of one file for each slice of a volume along axes R, A and S."""
    import SimpleITK as sitk

    folder.mkdir(parents=True, exist_ok=True)
    image = volume.with_array(volume.array.astype(np.int16)).to_sitk()
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    direction = np.reshape(image.GetDirection(), (3, 3))
    for k in range(image.GetSize()[2]):
        sheet = image[:, :, k]
        position = image.TransformIndexToPhysicalPoint((0, 0, k))
        for tag, value in {
            "0008|0060": "MR", "0020|000d": "1.2.3", "0020|000e": f"1.2.3.{number}", "0008|0018": f"1.2.{number}.{k}",
            "0008|0016": "1.2.840.10008.5.1.4.1.1.4", "0020|0011": str(number), "0020|0013": str(k + 1),
            "0008|103e": description, "0020|0032": "\\".join(f"{value:.6f}" for value in position),
            "0020|0037": "\\".join(f"{value:.6f}" for value in (*direction[:, 0], *direction[:, 1])),
            "0018|0050": str(image.GetSpacing()[2]), "0010|0010": patient, "0010|0020": f"{patient} 4711",
        }.items():  # fmt: skip
            sheet.SetMetaData(tag, value)
        writer.SetFileName(str(folder / f"IM{number}_{k:03d}"))
        writer.SetImageIO("GDCMImageIO")
        writer.Execute(sheet)


def as_sent(folder) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_of_several_series_one_is_taken_and_called_as_it_is_described(tmp_path, caplog):
    mri = head_mri(6.0)
    write_series(tmp_path, mri, 3, "T1 MPRAGE sag/../x")
    write_series(tmp_path, mri.with_array(mri.array[::-1]), 5, "T2 tse")
    write_series(tmp_path, Volume(mri.array[:3], mri.ijk_to_ras), 1, "localizer")
    (tmp_path / "README.TXT").write_text("a viewer")
    (tmp_path / "DICOMDIR").write_bytes(bytes(128) + b"DICM")
    with caplog.at_level(logging.DEBUG), untrusted_folder() as folder:
        parcel = Parcel(folder, as_sent(tmp_path))
        assert parcel.has_dicom and not parcel.paths and parcel.left_out == 2
        series = parcel.series()
        assert [(one.title, one.is_volume) for one in series] == [
            ("localizer (series 1)", False), ("T1 MPRAGE sag .. x (series 3)", True), ("T2 tse (series 5)", True),
        ]  # fmt: skip
        assert series[1].images == f"{len(mri.array)} images of {mri.array.shape[2]}x{mri.array.shape[1]}"
        path = parcel.take(series[1], series)
        found = content.content_of(path)
        assert path.name == parcel.names[str(path)] == "T1 MPRAGE sag .. x (series 3)"
        assert np.array_equal(found.volume.array, mri.array.astype(np.int16))
        np.testing.assert_allclose(found.volume.ijk_to_ras, mri.ijk_to_ras, atol=1e-3)
    assert "Miller" not in caplog.text and "4711" not in caplog.text and "T1 MPRAGE" in caplog.text


def test_a_damaged_image_beside_the_chosen_series_is_said(tmp_path):
    """The volume would end before it."""
    mri = head_mri(6.0)
    write_series(tmp_path, mri, 3, "T1")
    write_series(tmp_path, mri, 4, "T2")
    last = sorted(tmp_path.glob("IM3_*"))[-1]
    last.write_bytes(last.read_bytes()[:-200])
    with untrusted_folder() as folder:
        parcel = Parcel(folder, as_sent(tmp_path))
        series = parcel.series()
        path = parcel.take(next(one for one in series if one.title.startswith("T1")), series)
        with pytest.raises(SimulationError, match=last.name):
            content.content_of(path)


# ---- questions -------------------------------------------------------------------------------------------------------


def test_a_question_waits_for_its_own_answer_and_all_else_goes_on():
    import asyncio

    from trame_server.state import State

    from SlicerUSSim.Logic.base.errors import Cancelled
    from SlicerUSSim.Workstation.questions import Questions
    from SlicerUSSim.Workstation.state import Choice, SharedState
    from SlicerUSSim.Workstation.tasks import Tasks
    from tests.test_browser_parts import run_in_loop

    async def scenario():
        tasks, shared, happened = Tasks(print), SharedState(State(ready=True)), []
        questions = Questions(shared, tasks)

        def ask(name: str) -> None:
            try:
                happened.append((name, questions.ask(name, "?", [Choice("yes", "Yes"), Choice("no", "No")])))
            except Cancelled:
                happened.append((name, None))

        tasks.start(lambda: ask("first"))
        tasks.start(lambda: ask("second"))
        while shared.now.question.number == 0 or not tasks.are_done:
            await asyncio.sleep(0.01)
        number = shared.now.question.number
        assert shared.now.question.title == "first" and [c.key for c in shared.now.question.choices] == ["yes", "no"]
        tasks.start(lambda: happened.append(tasks.do(lambda: "an image")))
        while len(happened) < 1:
            await asyncio.sleep(0.01)
        questions.answer(number, "perhaps")
        questions.answer(number + 7, "yes")
        await asyncio.sleep(0.05)
        assert happened == ["an image"] and shared.now.question.number == number
        questions.answer(number, "yes")
        questions.answer(number, "no")  # of another page, too late
        while len(happened) < 2:
            await asyncio.sleep(0.01)
        assert shared.now.question.title == "second"
        questions.answer(shared.now.question.number, None)
        while len(happened) < 3:
            await asyncio.sleep(0.01)
        await asyncio.sleep(0.05)
        assert tasks.are_done and shared.now.question.number == 0 and shared.now.question.choices == []
        tasks.stop()
        return happened

    assert run_in_loop(scenario) == ["an image", ("first", "yes"), ("second", None)]
