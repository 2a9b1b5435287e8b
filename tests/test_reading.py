"""Files that are not trusted are read in a child process, with the same result and the same words."""

from __future__ import annotations

import logging
import os
import pickle
import re
import signal
import sys
import threading
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from click.testing import CliRunner

from SlicerUSSim.Command.cli import main
from SlicerUSSim.Logic import SimulationError, TissueTable, Volume
from SlicerUSSim.Logic.base import reading
from SlicerUSSim.Logic.base.reading import UNTRUSTED, ReadingLimits, in_child, reader, untrusted_folder
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.tracked.pose_files import read_pose, write_pose
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence

_log = logging.getLogger("SlicerUSSim.tests")


@reader
def process_of(path: Path) -> int:
    return os.getpid()


@reader
def crashes(path: Path) -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


@reader
def hangs(path: Path) -> None:
    time.sleep(3600)


@reader
def fills_the_memory(path: Path) -> int:
    return len(b"x" * 2**40)


@reader
def tells(path: Path) -> tuple[str, str]:
    import SlicerUSSim

    _log.info("%s: is a text", path.name)
    print("what libraries print")
    return path.read_text(), SlicerUSSim.__file__


@reader
def raises(path: Path) -> None:
    raise KeyError("no such tag")


@reader
def returns_a_call(path: Path) -> object:
    class Call:
        def __reduce__(self):
            return os.mkdir, (f"{path}.made",)

    return Call()


@in_child
def process_always_of(path: Path) -> int:
    return os.getpid()


@pytest.fixture
def file(tmp_path) -> Path:
    (tmp_path / "file.txt").write_text("text")
    return tmp_path / "file.txt"


@pytest.fixture
def sent():
    """An untrusted file."""
    with untrusted_folder(ReadingLimits(seconds=60)) as folder:
        path = Path(folder) / "file.txt"
        path.write_text("text")
        yield path
    assert not path.exists()


@pytest.mark.slow
def test_a_file_is_read_here_unless_it_is_not_trusted(file, sent, monkeypatch):
    assert process_of(file) == os.getpid()
    assert process_of(sent) not in (os.getpid(), process_of(sent))
    assert process_of(path=str(sent)) != os.getpid()
    assert process_always_of(file) != os.getpid() != process_always_of(path=file)
    monkeypatch.setenv(UNTRUSTED, "1")
    assert process_of(file) != os.getpid()
    monkeypatch.setenv(UNTRUSTED, "0")
    assert process_of(file) == os.getpid()


def test_a_folder_is_not_trusted_in_other_threads_too(sent):
    found: list[int] = []
    thread = threading.Thread(target=lambda: found.append(process_of(sent)))
    thread.start()
    thread.join()
    assert found and found[0] != os.getpid()


@pytest.mark.parametrize(
    ("read", "words"),
    [
        (crashes, r"cannot be read \(the library that reads it crashed: SIGSEGV\)"),
        (fills_the_memory, r"cannot be read \(it needs more memory than there is\)"),
        (raises, r"cannot be read \(KeyError: 'no such tag'\)"),
        (returns_a_call, r"cannot be read \(its reader gave no answer: posix.mkdir is not a value"),
    ],
)
def test_what_ends_or_deceives_a_reader_is_one_line(sent, read, words):
    with pytest.raises(SimulationError, match=words) as error:
        read(sent)
    assert str(error.value).startswith(f"{sent}: ") and "\n" not in str(error.value)
    assert not Path(f"{sent}.made").exists()


def test_what_does_not_end_is_ended(tmp_path):
    with untrusted_folder(ReadingLimits(seconds=1)) as folder:
        path = Path(folder) / "file.txt"
        path.write_text("text")
        with pytest.raises(SimulationError, match=r"file\.txt: is not read after 1 s, expected less for 4 bytes"):
            hangs(path)


def test_what_a_reader_logs_is_logged_here(sent, caplog):
    """It runs the package that the parent runs."""
    with caplog.at_level(logging.INFO, "SlicerUSSim"):
        assert tells(sent) == ("text", sys.modules["SlicerUSSim"].__file__)
    assert [(r.name, r.getMessage()) for r in caplog.records] == [("SlicerUSSim.tests", "file.txt: is a text")]


def written(folder: Path) -> list[tuple[Path, type | object]]:
    """A file of every kind, with what reads it."""
    volume = Volume(np.arange(60, dtype=np.int16).reshape(3, 4, 5), np.diag([2.0, 2.0, 2.0, 1.0]))
    found = []
    for suffix in (".nii.gz", ".vti"):
        volume.write(folder / f"volume{suffix}")
        found.append((folder / f"volume{suffix}", Volume.read))
    images = np.arange(40, dtype=np.uint8).reshape(2, 4, 5)
    TrackedSequence(images, ({"ImageToReference": np.eye(4)},) * 2, np.arange(2.0)).write(folder / "s.igs.mha")
    write_pose(folder / "pose.json", np.eye(4))
    sitk.WriteTransform(sitk.Euler3DTransform((0, 0, 0), 0.1, 0.2, 0.3, (1, 2, 3)), str(folder / "pose.h5"))
    TissueTable.brain().write(folder / "tissues.json")
    Preset().write(folder / "preset.json")
    found += [(folder / "s.igs.mha", TrackedSequence.read), (folder / "pose.json", read_pose)]
    found += [(folder / "pose.h5", read_pose), (folder / "tissues.json", TissueTable.read)]
    return [*found, (folder / "preset.json", Preset.read)]


def same(a: object, b: object) -> bool:
    if isinstance(a, Volume):
        return np.array_equal(a.array, b.array) and np.array_equal(a.ijk_to_ras, b.ijk_to_ras)
    if isinstance(a, TrackedSequence):
        return np.array_equal(a.images, b.images) and pickle.dumps(a.transforms) == pickle.dumps(b.transforms)
    return np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b


@pytest.mark.slow
def test_what_is_read_in_a_child_is_what_is_read_here(tmp_path, monkeypatch):
    for path, read in written(tmp_path):
        here = read(path)
        monkeypatch.setenv(UNTRUSTED, "1")
        there = read(path)
        path.write_bytes(path.read_bytes()[:7])
        with pytest.raises(SimulationError, match=re.escape(path.name)) as refused:
            read(path)
        monkeypatch.delenv(UNTRUSTED)
        assert type(here) is type(there) and same(here, there), path.name
        with pytest.raises(SimulationError) as expected:
            read(path)
        assert str(refused.value) == str(expected.value)


@pytest.mark.parametrize("arguments", [["--untrusted", "segment"], ["segment", "--untrusted"], ["segment"]])
def test_a_command_reads_in_children_when_asked_to(tmp_path, arguments, monkeypatch):
    monkeypatch.delenv(UNTRUSTED, raising=False)
    (tmp_path / "head.nii.gz").write_bytes(b"no image")
    children: list[object] = []
    run = reading.subprocess.run
    monkeypatch.setattr(reading.subprocess, "run", lambda *a, **k: (children.append(a), run(*a, **k))[1])
    result = CliRunner().invoke(main, [*arguments, str(tmp_path / "head.nii.gz"), "-o", str(tmp_path / "o.nii.gz")])
    assert result.exit_code == 2 and "head.nii.gz: cannot be read as an image" in result.output
    assert bool(children) == ("--untrusted" in arguments) and UNTRUSTED not in os.environ


@pytest.mark.slow
def test_a_warning_of_a_reader_reaches_the_caller(sent):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert warns(sent) == 4
    assert [(type(w.message).__name__, str(w.message)) for w in caught] == [("EmptyViewWarning", "no echoes")]


@reader
def warns(path: Path) -> int:
    from SlicerUSSim.Logic.imaging.simulator import EmptyViewWarning

    warnings.warn(EmptyViewWarning("no echoes"), stacklevel=2)
    return len(path.read_text())
