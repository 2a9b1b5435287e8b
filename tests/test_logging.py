"""What the library logs, and what a command writes where: the answer to stdout, everything else to stderr."""

from __future__ import annotations

import json
import logging
import re
import subprocess
import sys

import numpy as np
import pytest
from click.testing import CliRunner

from SlicerUSSim.Command.cli import main
from SlicerUSSim.Logic import LinearProbe, SimulationSettings, TissueTable, UltrasoundSimulator, Volume
from SlicerUSSim.Logic.mri.samples import head_mri
from SlicerUSSim.Logic.opencl import device as devices
from SlicerUSSim.Logic.opencl.device import Device
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.probe.poses import craniotomy_pose, tilt_sweep
from SlicerUSSim.Logic.tracked.images import TrackedImages
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence
from tests.test_label_maps import head_tissues

OURS = logging.getLogger("SlicerUSSim")
PROBE = LinearProbe(40, 50, scan_lines=64)


@pytest.fixture
def log(caplog):
    """The records of our loggers, from DEBUG on."""
    with caplog.at_level(logging.DEBUG, logger="SlicerUSSim"):
        yield caplog


def messages(log, level: int = logging.DEBUG) -> list[str]:
    """What was logged at this level."""
    return [record.getMessage() for record in log.records if record.levelno == level]


def ussim(*arguments):
    result = CliRunner().invoke(main, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output
    return result


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A head, its labels with their tissues, and a tracked sequence of it."""
    folder = tmp_path_factory.mktemp("patient")
    head_mri(3.0).write(folder / "head.nii.gz")
    labels, tissues = head_tissues(3.0)
    labels.write(folder / "labels.nii.gz")
    tissues.write(folder / "labels.json")
    (folder / "probe.json").write_text(json.dumps(PROBE.to_dict()))
    poses = tilt_sweep(craniotomy_pose(labels, PROBE), 10.0, 3)
    images = [frame.image for frame in UltrasoundSimulator(labels, tissues).sweep(PROBE, poses)]
    to_probe = ImageGrid.for_probe(PROBE, None).image_to_probe
    transforms = tuple({"ImageToProbe": to_probe, "ProbeToReference": pose} for pose in poses)
    TrackedSequence(np.stack(images), transforms, 0.1 * np.arange(3)).write(folder / "sweep.igs.mha")
    return folder


# ---- the library -----------------------------------------------------------------------------------------------------


_IMPORTS = """
import sys
from click.testing import CliRunner
from SlicerUSSim import Logic
from SlicerUSSim.Command.cli import main

Logic.SimulationError
heavy = [name for name in ("numpy", "vtkmodules", "SimpleITK", "pyopencl", "scipy") if name in sys.modules]
assert not heavy, heavy
before = "logging" in sys.modules
for words in (["--help"], ["simulate", "--help"], ["-v", "simulate", "--help"]):
    assert CliRunner().invoke(main, words).exit_code == 0
assert before or "logging" not in sys.modules

import logging
import SlicerUSSim.Logic.imaging.simulator, SlicerUSSim.Logic.tracked.openigtlink
named = [name for name in logging.root.manager.loggerDict if name.startswith("SlicerUSSim.")]
assert len(named) > 5, named
for logger in [logging.root, *map(logging.getLogger, ["SlicerUSSim", *named])]:
    assert not logger.handlers and (logger is logging.root or logger.level == 0), logger
"""


def test_imports_load_nothing_heavy_and_set_no_handler_and_no_level():
    """Nor does help wait for logging."""
    done = subprocess.run([sys.executable, "-c", _IMPORTS], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_device_is_logged_once_with_the_reason(log, monkeypatch):
    monkeypatch.setattr(devices, "_opened", {})
    opened = Device.get()
    assert Device.get() is opened
    (said,) = [text for text in messages(log, logging.INFO) if "OpenCL device: " in text]
    assert opened.info.name in said and said.endswith(devices.choose_device()[1])
    monkeypatch.setattr(devices, "_opened", {})
    Device.get(opened.info.index)
    assert messages(log, logging.INFO)[-1].endswith("; chosen by argument")


def test_the_medium_and_the_use_of_echoes_are_logged(log):
    labels = Volume(np.ones((20, 20, 20), np.uint8), np.eye(4))
    simulator = UltrasoundSimulator(labels, TissueTable.brain(), SimulationSettings())
    assert any(re.match(r"acoustic medium: 20x20x20 voxels, labels 1, 1 acoustic groups", m) for m in messages(log))
    for expected in ("rays and echoes computed", "the echoes of the last frame are reused"):
        simulator.simulate(PROBE, np.eye(4))
        assert [text for text in messages(log) if text.startswith("frame: ")][-1] == f"frame: {expected}"


def nifti(path, sform, qform, unit: str = "mm"):
    """A file with these orientations, each a (4, 4) matrix and its code."""
    nibabel = pytest.importorskip("nibabel")
    image = nibabel.Nifti1Image(np.zeros((20, 30, 40), np.int16), None)
    image.set_qform(*qform)
    image.set_sform(*sform)
    image.header.set_xyzt_units(unit)
    if sform[0] is not None:
        image.header.set_zooms(np.linalg.norm(sform[0][:3, :3], axis=0))
    nibabel.save(image, path)
    return Volume.read(path)


@pytest.mark.parametrize("mirrored", [1.0, -1.0])
def test_orientation_and_unit_of_nifti_are_logged(log, tmp_path, mirrored):
    from scipy.spatial.transform import Rotation

    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_matrix() * [1.0, 1.5, 2.0 * mirrored]
    matrix[:3, 3] = [5, 6, 7]
    shifted = matrix.copy()
    shifted[0, 3] += 20.0
    nifti(tmp_path / "same.nii", (matrix, 1), (matrix, 1))
    assert not messages(log, logging.WARNING)
    assert f"i, j, k towards {'RAS' if mirrored > 0 else 'RAI'}" in log.text
    used = nifti(tmp_path / "differ.nii", (shifted, 4), (matrix, 1))
    (warning,) = messages(log, logging.WARNING)
    assert "its qform puts it 20.0 mm away from its sform, which is used" in warning
    np.testing.assert_allclose(used.ijk_to_ras, shifted, atol=1e-3)
    log.clear()
    nifti(tmp_path / "none.nii", (None, 0), (None, 0))
    assert "has no orientation" in messages(log, logging.WARNING)[0]
    log.clear()
    nifti(tmp_path / "metres.nii", (matrix @ np.diag([1e-3, 1e-3, 1e-3, 1]), 1), (None, 0), "meter")
    assert "lengths are converted to millimetres, by 1000" in log.text
    np.testing.assert_allclose(Volume.read(tmp_path / "metres.nii").spacing_mm, [1.0, 1.5, 2.0], rtol=1e-5)


def test_a_size_that_no_patient_has_is_a_warning(log, tmp_path):
    Volume(np.zeros((20, 20, 20), np.uint8), np.diag([0.1, 0.1, 0.1, 1])).write(tmp_path / "small.nrrd")
    Volume.read(tmp_path / "small.nrrd")
    assert "its size is 2x2x2 mm" in messages(log, logging.WARNING)[0]


def test_what_a_sequence_is_read_as_is_logged(log, files):
    sequence = TrackedSequence.read(files / "sweep.igs.mha")
    assert sequence.composition(0, "ReferenceToImage") == ["inverse of ProbeToReference", "inverse of ImageToProbe"]
    TrackedImages.of(sequence, most=2)
    said = "\n".join(messages(log, logging.INFO))
    assert "images chosen: 2 of 3: 0, 2" in said
    assert "ImageToReference is composed of ImageToProbe, ProbeToReference" in said
    assert re.search(r"field found in the images: linear probe \(width_mm 3\d", said)


def test_images_that_were_not_tracked_are_a_warning(log, files):
    sequence = TrackedSequence.read(files / "sweep.igs.mha")
    lost = TrackedSequence(sequence.images, ({}, *sequence.transforms[1:]), sequence.timestamps)
    TrackedImages.of(lost, probe=PROBE)
    assert "1 of 3 images have no ImageToReference and are left out" in messages(log, logging.WARNING)


# ---- the command -----------------------------------------------------------------------------------------------------


def simulate(files, before=(), after=()):
    out = files / "image.png"
    return ussim(*before, "simulate", files / "labels.nii.gz", "--pose", "auto", "-o", out, "--overwrite", *after)


@pytest.mark.parametrize(
    ("before", "after", "levels"),
    [
        ([], [], set()),
        ([], ["-v"], {"info"}),
        (["-v"], ["-v"], {"info", "debug"}),
        (["-vvv"], [], {"info", "debug"}),
    ],
)
def test_verbose_counts_before_and_after_the_subcommand(files, before, after, levels):
    result = simulate(files, before, after)
    lines = [line.split(": ") for line in result.stderr.splitlines() if line.startswith("ussim: ")]
    assert {line[1] for line in lines} == levels
    assert result.stdout == ""
    if levels:
        assert "labels.nii.gz is read as a label map; use --mri if it is not" in result.stderr
        assert "tissues: the table next to the label map" in result.stderr


def test_a_command_leaves_the_loggers_as_they_were(files):
    def state():
        return list(OURS.handlers), OURS.level, OURS.propagate, logging.lastResort.level

    before = state()
    simulate(files, ["-vv"])
    assert state() == before


def test_warnings_are_shown_and_those_of_other_packages_are_not(files, monkeypatch):
    def warn(*_):
        logging.getLogger("SlicerUSSim.Logic.tracked").warning("of ours")
        logging.getLogger("another.package").warning("of theirs")
        return {}

    monkeypatch.setattr("SlicerUSSim.Logic.opencl.devices.faster_hint", warn)
    result = ussim("devices", "-vv")
    assert "ussim: warning: of ours\n" in result.stderr and "of theirs" not in result.stderr
    assert "ussim: warning: of ours\n" in ussim("devices").stderr


def test_files_that_were_asked_for_leave_stdout_empty(files, tmp_path):
    labels, sequence = files / "labels.nii.gz", files / "sweep.igs.mha"
    for arguments in (
        ["simulate", labels, "--pose", "auto", "-o", tmp_path / "image.mha"],
        ["volume", labels, "--pose", "auto", "--tilt", 4, "--frames", 2, "--spacing", 3, "-o", tmp_path / "us.nrrd"],
        ["sweep", labels, "--sequence", sequence, "--probe", files / "probe.json", "-o", tmp_path / "sweep.igs.mha"],
    ):
        result = ussim(*arguments)
        # On a busy machine lines of progress come before it
        assert result.stdout == "" and result.stderr.splitlines()[-1].startswith("wrote "), arguments[0]


@pytest.mark.slow
def test_segment_prints_its_tissues_alone(files, tmp_path):
    result = ussim("segment", files / "head.nii.gz", "-o", tmp_path / "labels.nii.gz", "-vv")
    lines = [line.split() for line in result.stdout.splitlines()]
    assert [line[0] for line in lines] == ["label", "1", "2", "3", "4"] and lines[1][1] == "csf"
    assert "wrote" in result.stderr and "ussim: info: " in result.stderr


@pytest.mark.slow
def test_validate_prints_its_numbers_and_not_where_they_are(tmp_path):
    pytest.importorskip("matplotlib", reason="pictures need matplotlib: pip install '.[demo]'")
    from validation.__main__ import main as validation
    from validation.run import all_checks

    result = CliRunner().invoke(validation, ["--only", all_checks()[0].name, "--out", str(tmp_path / "report")])
    assert "Wrote" not in result.stdout and "wrote" not in result.stdout and result.stdout.count("\n") >= 1
    assert f"wrote {tmp_path / 'report' / 'report.md'}" in result.stderr
