"""What a page may send, what each file is, and how files go together: uploads, DICOM series, tables, questions."""

from __future__ import annotations

import json
import logging
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import SimpleITK as sitk

pytest.importorskip("trame_slicer", reason="the workstation comes with: pip install '.[serve]'")

import slicer

from SlicerUSSim.Logic import SimulationError, TissueTable, Volume
from SlicerUSSim.Logic.base.reading import untrusted_folder
from SlicerUSSim.Logic.imaging.content import Kind, content_of
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mri.samples import head_mri
from SlicerUSSim.Logic.mrml.logic import AtOnce, UltrasoundSceneLogic
from SlicerUSSim.Logic.tissue.table import write_label_files
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence
from SlicerUSSim.Workstation import uploads
from SlicerUSSim.Workstation.file_nodes import FileNodes, Files
from SlicerUSSim.Workstation.opener import Opener
from tests.remembered import segment_once
from tests.test_label_maps import head

SEQUENCE = TrackedSequence(np.full((2, 8, 9), 3, np.uint8), ({"ImageToReference": np.eye(4)},) * 2, np.arange(2.0))


# ---- what may be sent ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("../mri.nii.gz", "is not a plain file name"),
        ("/etc/cron.d/x", "is not a plain file name"),
        ("a\\b.nii", "is not a plain file name"),
        ("a\0.nii", "is not a plain file name"),
        ("", "is not a plain file name"),
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
    for name in (path.name, f"image.{'mha' if suffix == '.mhd' else 'nrrd'}", "image", "image.dcm"):  # by its content
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
    SEQUENCE.write(path)
    uploads.require_whole_files({path.name: path.read_bytes()})
    assert content_of(path).kind is Kind.SEQUENCE


def test_files_of_one_name_in_several_folders_are_all_kept():
    files = uploads.plain_names([("IM1", b"a"), ("IM1", b"b"), ("2 IM1", b"c"), ("IM1", b"d")])
    assert sorted(files.values()) == [b"a", b"b", b"c", b"d"] and list(files)[:2] == ["IM1", "2 IM1"]


# ---- what it is ------------------------------------------------------------------------------------------------------


def test_what_images_are(tmp_path):
    mri = head_mri(3.0)
    mask = mri.with_array((mri.array > 0).astype(np.uint8))
    for name, volume, kind, words in (
        ("mri", mri, Kind.MRI, "an MRI of a brain without skull, "),
        ("mask", mask, Kind.MASK, "a mask of one region, "),
        ("aseg", head(), Kind.LABELS, "a label map: FreeSurfer, 8 labels, "),
    ):
        volume.write(tmp_path / f"{name}.nii.gz")
        found = content_of(tmp_path / f"{name}.nii.gz")
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
        assert content_of(tmp_path / name).kind is kind, name
    assert content_of(tmp_path / "preset.json").kind is Kind.PRESET


# ---- label maps and their tables -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def patient():
    return segment_once(head_mri(3.5), thin_sulci=True)


def opener() -> tuple[Opener, FileNodes]:
    """An opener without a page, and what it reads files with."""
    logic = UltrasoundSceneLogic(slicer.vtkMRMLScene())
    nodes = FileNodes(logic, AtOnce(), Files())
    panel = SimpleNamespace(shared=None, logic=logic, tasks=AtOnce(), presenter=None)
    return Opener(panel, nodes, None, None, None, None, None), nodes


@pytest.mark.slow
@pytest.mark.parametrize("table", ["t2", "names"])
def test_a_label_map_is_opened_with_the_table_of_its_labels(patient, tmp_path, table):
    """Of ussim segment, or of another program; the label map alone is refused with this remedy."""
    numbers = (0, 3, 2, 1, 4) if table == "t2" else (0, 507, 502, 504, 509)
    names = ("csf", "grey matter", "white matter", "leptomeninges")
    assert patient.tissue_names == names
    labels = patient.labels.with_array(np.array(numbers, np.uint16)[patient.labels.array])
    if table == "t2":
        order = ("white matter", "grey matter", "csf", "leptomeninges")
        write_label_files(tmp_path / "rem.nii.gz", labels, TissueTable.brain().for_names(order))
        (tmp_path / "rem.json").rename(tmp_path / "of another name.json")
    else:
        labels.write(tmp_path / "rem.nii.gz")
        lines = [f'{n} 255 0 0 1 1 1 "{name}"' for n, name in zip(numbers[1:], names, strict=True)]
        (tmp_path / "colours.txt").write_text("\n".join(lines))
    opens, nodes = opener()
    ((file,), wrong) = opens.recognised(sorted(tmp_path.iterdir()))
    assert file.kind is Kind.LABELS and not wrong
    node, found = nodes.labels(file.path, file.table)
    opens, nodes = opener()  # a table is of its own map only
    ((file,), _) = opens.recognised([tmp_path / "rem.nii.gz"])
    if table == "t2":  # whose names are in the map, too
        assert set(nodes.labels(file.path, file.table)[1].names) == set(names)
    else:
        with pytest.raises(SimulationError, match=r"rem\.nii\.gz: .*--map"):
            nodes.labels(file.path, file.table)
    assert node.GetName() == "rem.nii.gz" and set(found.names) == set(names)
    for name, n in zip(names, range(1, 5), strict=True):
        np.testing.assert_array_equal(found.labels.array == found.names.index(name) + 1, patient.labels.array == n)
    if table == "names":
        assert found.message.endswith("named in colours.txt")


@pytest.mark.parametrize("names", [["rem.json"], ["a.nii.gz", "names.txt", "rem.json"], ["mri.nii.gz", "rem.json"]])
def test_a_table_of_nothing_is_one_line(patient, tmp_path, names):
    write_label_files(tmp_path / "rem.nii.gz", patient.labels, TissueTable.brain().for_names(patient.tissue_names))
    (tmp_path / "rem.nii.gz").rename(tmp_path / "a.nii.gz")
    head_mri(3.0).write(tmp_path / "mri.nii.gz")
    (tmp_path / "names.txt").write_text('1 255 0 0 1 1 1 "csf"')
    count = names.count("a.nii.gz")
    message = f"rem.json is a table of labels and was opened with {count} label maps, expected one for each"
    with pytest.raises(SimulationError, match=re.escape(message)):
        opener()[0].recognised([tmp_path / name for name in names])


def test_a_label_map_and_a_preset_are_told_apart(patient, tmp_path):
    """A preset is not a table of the labels that are opened with it."""
    Preset().write(tmp_path / "preset.json")
    patient.labels.write(tmp_path / "a.nii.gz")
    files, wrong = opener()[0].recognised(sorted(tmp_path.iterdir()))
    assert [(file.name, file.kind) for file in files] == [("preset.json", Kind.PRESET), ("a.nii.gz", Kind.LABELS)]
    assert not wrong and all(file.table is None for file in files)


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


def as_sent(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_of_several_series_one_is_taken_and_called_as_it_is_described(tmp_path, caplog):
    mri = head_mri(6.0)
    write_series(tmp_path, mri, 3, "T1 MPRAGE sag/../x")
    write_series(tmp_path, mri.with_array(mri.array[::-1]), 5, "T2 tse")
    write_series(tmp_path, Volume(mri.array[:3], mri.ijk_to_ras), 1, "localizer")
    (tmp_path / "README.TXT").write_text("a viewer")
    (tmp_path / "DICOMDIR").write_bytes(bytes(128) + b"DICM")
    with caplog.at_level(logging.DEBUG), untrusted_folder() as folder:
        sent = uploads.Sent(folder, as_sent(tmp_path))
        assert sent.has_dicom and not sent.paths
        series = sent.series()
        assert [(one.title, one.is_volume) for one in series] == [
            ("localizer (series 1)", False), ("T1 MPRAGE sag .. x (series 3)", True), ("T2 tse (series 5)", True),
        ]  # fmt: skip
        assert series[1].images == f"{len(mri.array)} images of {mri.array.shape[2]}x{mri.array.shape[1]}"
        sent.take(series[1], series)
        (path,) = sent.paths
        found = content_of(path)
        assert path.name == "T1 MPRAGE sag .. x (series 3)"
        assert np.array_equal(found.volume.array, mri.array.astype(np.int16))
        np.testing.assert_allclose(found.volume.ijk_to_ras, mri.ijk_to_ras, atol=1e-3)
    assert "Miller" not in caplog.text and "4711" not in caplog.text and "T1 MPRAGE" in caplog.text


def test_a_damaged_image_beside_the_chosen_series_is_reported(tmp_path):
    """The volume would end before it."""
    mri = head_mri(6.0)
    write_series(tmp_path, mri, 3, "T1")
    write_series(tmp_path, mri, 4, "T2")
    last = sorted(tmp_path.glob("IM3_*"))[-1]
    last.write_bytes(last.read_bytes()[:-200])
    with untrusted_folder() as folder:
        sent = uploads.Sent(folder, as_sent(tmp_path))
        series = sent.series()
        sent.take(next(one for one in series if one.title.startswith("T1")), series)
        with pytest.raises(SimulationError, match=last.name):
            content_of(sent.paths[0])


# ---- questions -------------------------------------------------------------------------------------------------------


def test_a_question_waits_for_its_own_answer_and_all_else_continues():
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
