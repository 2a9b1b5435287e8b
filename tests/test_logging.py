"""What the library logs, and what a command writes where: the answer to stdout, everything else to stderr."""

from __future__ import annotations

import json
import logging
import re
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
from click.testing import CliRunner

from SlicerUSSim.Command.cli import main
from SlicerUSSim.Logic import LinearProbe, SimulationSettings, TissueTable, UltrasoundSimulator, Volume, segment_mri
from SlicerUSSim.Logic.mri.samples import head_mri
from SlicerUSSim.Logic.opencl import device as devices
from SlicerUSSim.Logic.opencl.device import Device
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.probe.placement import craniotomy_pose, tilt_sweep
from SlicerUSSim.Logic.tracked.images import TrackedImages
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence

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
    mri = head_mri(3.0)
    mri.write(folder / "head.nii.gz")
    segmentation = segment_mri(mri)
    segmentation.labels.write(folder / "labels.nii.gz")
    tissues = TissueTable.brain(segmentation.tissue_names)
    tissues.write(folder / "labels.json")
    (folder / "probe.json").write_text(json.dumps(PROBE.to_dict()))
    poses = tilt_sweep(craniotomy_pose(segmentation.labels, PROBE), 10.0, 3)
    images = [frame.image for frame in UltrasoundSimulator(segmentation.labels, tissues).sweep(PROBE, poses)]
    to_probe = ImageGrid.for_probe(PROBE, None).image_to_probe
    transforms = tuple({"ImageToProbe": to_probe, "ProbeToReference": pose} for pose in poses)
    TrackedSequence(np.stack(images), transforms, 0.1 * np.arange(3)).write(folder / "sweep.igs.mha")
    return folder


# ---- the library -----------------------------------------------------------------------------------------------------


def test_the_library_adds_no_handler_and_sets_no_level():
    code = (
        "import logging, SlicerUSSim.Logic.imaging.simulator, SlicerUSSim.Logic.tracked.openigtlink\n"
        "named = [n for n in logging.root.manager.loggerDict if n.startswith('SlicerUSSim.')]\n"
        "assert len(named) > 5, named\n"
        "for logger in [logging.root, *map(logging.getLogger, ['SlicerUSSim', *named])]:\n"
        "    assert not logger.handlers and (logger is logging.root or logger.level == 0), logger"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
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


def test_a_build_is_logged_with_its_options_and_the_next_use_as_known(log):
    device = Device(Device.get().info)
    device.kernels("bmode.cl", device.lanes)
    build = messages(log)[-1]
    assert re.match(r"bmode\.cl: (built|taken from pyopencl's cache) in \d+ ms with .*-DLANES=", build)
    device.kernels("bmode.cl", device.lanes)
    assert messages(log)[-1] == f"bmode.cl ({device.lanes}): built before in this process"


@pytest.mark.slow
def test_segmentation_says_what_it_found_and_how_long_it_took(log):
    segment_mri(head_mri(3.0), thin_sulci=True)
    found = "\n".join(messages(log, logging.INFO))
    for part in ("skull-stripped brain, 1855 ml", "led by the MNI152 atlas", "left as it is", "thin sulci:"):
        assert part in found
    assert re.search(r"segmentation: brain \d+ ms, atlas \d+ ms, .*mixture \d+ ms", messages(log)[-1])


def test_the_medium_and_the_use_of_echoes_are_logged(log):
    labels = Volume(np.ones((20, 20, 20), np.uint8), np.eye(4))
    simulator = UltrasoundSimulator(labels, TissueTable.brain(), SimulationSettings())
    assert any(re.match(r"acoustic medium: 20x20x20 voxels, labels 1, 1 acoustic groups", m) for m in messages(log))
    for expected in ("rays and echoes computed", "the echoes of the last frame are reused"):
        simulator.simulate(PROBE, np.eye(4))
        assert [text for text in messages(log) if text.startswith("frame: ")][-1] == f"frame: {expected}"


@pytest.mark.parametrize(
    ("array", "said"),
    [
        (np.arange(8, dtype=np.int16), "8 whole numbers from 0 to 7, as a label map does"),
        (np.arange(512, dtype=np.int16), "512 whole numbers from 0 to 511, as an MRI does"),
        (np.linspace(0, 1, 8), "float64 numbers, as an MRI does"),
        (np.arange(-4, 4), "negative numbers (down to -4), as an MRI does"),
    ],
)
def test_a_guess_about_a_volume_is_logged_with_what_it_comes_from(log, array, said):
    Volume(np.resize(array, (8, 8, 8)), np.eye(4)).looks_like_labels()
    assert messages(log, logging.INFO) == [f"the volume contains {said}"]


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
    assert "NIfTI orientation from its sform and qform" in log.text and not messages(log, logging.WARNING)
    assert f"i, j, k towards {'RAS' if mirrored > 0 else 'RAI'}" in log.text
    used = nifti(tmp_path / "differ.nii", (shifted, 4), (matrix, 1))
    (warning,) = messages(log, logging.WARNING)
    form = "qform" if np.allclose(used.ijk_to_ras, matrix, atol=1e-3) else "sform"
    assert "differ by up to 20.0 mm" in warning and f"ITK uses the {form}" in warning
    log.clear()
    nifti(tmp_path / "none.nii", (None, 0), (None, 0))
    assert "without an orientation" in messages(log, logging.WARNING)[0]
    log.clear()
    nifti(tmp_path / "metres.nii", (matrix @ np.diag([1e-3, 1e-3, 1e-3, 1]), 1), (None, 0), "meter")
    assert "NIfTI in metres" in log.text
    np.testing.assert_allclose(Volume.read(tmp_path / "metres.nii").spacing_mm, [1.0, 1.5, 2.0], rtol=1e-5)


def test_a_size_that_no_patient_has_is_a_warning(log, tmp_path):
    Volume(np.zeros((20, 20, 20), np.uint8), np.diag([0.1, 0.1, 0.1, 1])).write(tmp_path / "small.nrrd")
    Volume.read(tmp_path / "small.nrrd")
    assert "its size is 2x2x2 mm" in messages(log, logging.WARNING)[0]


def test_what_a_sequence_is_taken_for_is_logged(log, files):
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


def test_names_taken_for_tissues_are_logged(log):
    TissueTable.named(["csf", "Left-Cerebral-White-Matter"])
    assert messages(log, logging.INFO) == ["label 2, 'Left-Cerebral-White-Matter', is interpreted as white matter"]


def test_a_refused_pose_is_a_warning_with_its_reason_and_comes_once(log):
    pyigtl = pytest.importorskip("pyigtl", reason="OpenIGTLink comes with pyigtl: pip install '.[serve]'")
    from SlicerUSSim.Logic.tracked.openigtlink import TrackerLink

    def sent(matrix, name="ProbeToReference"):
        return pyigtl.TransformMessage(matrix, device_name=name).pack()

    poses = []
    with socket.create_server(("127.0.0.1", 0)) as listener:
        link = TrackerLink(*listener.getsockname()[:2], poses.append)
        try:
            peer, _ = listener.accept()
            with peer:
                peer.sendall(sent(np.eye(4)) + sent(np.diag([2.0, 1.0, 1.0, 1.0])) * 3 + sent(np.eye(4), "Stylus"))
                peer.sendall(sent(np.eye(4)))
                end = time.monotonic() + 120
                while len(poses) < 2 and time.monotonic() < end:
                    time.sleep(0.01)
                end = time.monotonic() + 120
                while "3 were refused" not in log.text and time.monotonic() < end:
                    time.sleep(0.01)
                (warning,) = messages(log, logging.WARNING)
        finally:
            link.stop()
    assert "pose refused: transform 'ProbeToReference' is not rigid: its axes are off by" in warning
    assert sum("pose refused" in text for text in messages(log)) == 2
    said = messages(log, logging.INFO)
    assert "OpenIGTLink: poses are used again, 3 were refused" in said
    assert "OpenIGTLink: no transform was chosen, the first that came is followed: 'ProbeToReference'" in said
    assert "OpenIGTLink: transform 'Stylus' is passed over, 'ProbeToReference' is followed" in said


# ---- the command -----------------------------------------------------------------------------------------------------


def simulate(files, before=(), after=()):
    out = files / "image.png"
    return ussim(*before, "simulate", files / "labels.nii.gz", "--pose", "auto", "-o", out, *after)


@pytest.mark.parametrize(
    ("before", "after", "levels"),
    [
        ([], [], set()),
        (["-v"], [], {"info"}),
        ([], ["-v"], {"info"}),
        ([], ["--verbose"], {"info"}),
        (["-v"], ["-v"], {"info", "debug"}),
        ([], ["-vv"], {"info", "debug"}),
        (["-vv"], [], {"info", "debug"}),
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


def test_warnings_are_shown_without_being_asked_for_and_other_packages_are_not(files, monkeypatch):
    def warn(*_):
        logging.getLogger("SlicerUSSim.Logic.tracked").warning("of ours")
        logging.getLogger("another.package").warning("of theirs")
        return {}

    monkeypatch.setattr("SlicerUSSim.Logic.opencl.devices.faster_hint", warn)
    result = ussim("devices", "-vv")
    assert "ussim: warning: of ours\n" in result.stderr and "of theirs" not in result.stderr
    assert "ussim: warning: of ours\n" in ussim("devices").stderr


def test_help_does_not_wait_for_logging():
    code = (
        "import sys\nfrom click.testing import CliRunner\nfrom SlicerUSSim.Command.cli import main\n"
        "before = 'logging' in sys.modules\n"
        "for words in (['--help'], ['simulate', '--help'], ['-v', 'simulate', '--help']):\n"
        "    assert CliRunner().invoke(main, words).exit_code == 0\n"
        "assert before or 'logging' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", list(main.commands))
def test_every_command_takes_verbose(name):
    assert any("--verbose" in option.opts for option in main.commands[name].params)


def test_files_that_were_asked_for_leave_stdout_empty(files, tmp_path):
    labels, sequence = files / "labels.nii.gz", files / "sweep.igs.mha"
    for arguments in (
        ["simulate", labels, "--pose", "auto", "-o", tmp_path / "image.mha"],
        ["volume", labels, "--pose", "auto", "--tilt", 4, "--frames", 2, "--spacing", 3, "-o", tmp_path / "us.nrrd"],
        ["sweep", labels, "--sequence", sequence, "--probe", files / "probe.json", "-o", tmp_path / "sweep.igs.mha"],
    ):
        result = ussim(*arguments)
        assert result.stdout == "" and result.stderr.startswith("wrote "), arguments[0]


@pytest.mark.slow
def test_segment_prints_its_tissues_alone(files, tmp_path):
    result = ussim("segment", files / "head.nii.gz", "-o", tmp_path / "labels.nii.gz", "-vv")
    lines = [line.split() for line in result.stdout.splitlines()]
    assert [line[0] for line in lines] == ["label", "1", "2", "3", "4"] and lines[1][1] == "csf"
    assert "wrote" in result.stderr and "ussim: debug: segmentation: " in result.stderr


def test_optimize_prints_what_it_found_alone(files, tmp_path):
    result = ussim(
        "optimize", files / "labels.nii.gz", "--sequence", files / "sweep.igs.mha", "--probe", files / "probe.json",
        "--frames", 1, "--free", "gain_db", "--evaluations", 5, "--restarts", 0, "-o", tmp_path / "fit.json", "-v",
    )  # fmt: skip
    cost, texture, parameter = result.stdout.splitlines()
    assert cost.startswith("cost ") and texture.startswith("texture T1 ") and parameter.startswith("gain_db ")
    assert "wrote" in result.stderr and "ussim: info: fit of 1 images, 1 free parameters: gain_db" in result.stderr


def test_devices_prints_its_table_alone():
    result = ussim("devices", "-vv")
    assert all(
        re.match(r"[* ] \d+:\d+  |used: |faster on this computer: ", line) for line in result.stdout.splitlines()
    )
    assert "ussim: debug: OpenCL devices: " in result.stderr


@pytest.mark.slow
def test_demo_prints_the_path_of_its_figure(files, tmp_path):
    pytest.importorskip("matplotlib", reason="pictures need matplotlib: pip install '.[demo]'")
    out = tmp_path / "demo"
    result = ussim("demo", "--mri", files / "head.nii.gz", "--out", out)
    assert result.stdout == f"{out / 'figure.png'}\n"
    assert "device: " in result.stderr


@pytest.mark.slow
def test_validate_prints_its_numbers_and_not_where_they_are(tmp_path):
    pytest.importorskip("matplotlib", reason="pictures need matplotlib: pip install '.[demo]'")
    from validation.__main__ import main as validation
    from validation.run import all_checks

    result = CliRunner().invoke(validation, ["--only", all_checks()[0].name, "--out", str(tmp_path / "report")])
    assert "Wrote" not in result.stdout and "wrote" not in result.stdout and result.stdout.count("\n") >= 1
    assert f"wrote {tmp_path / 'report' / 'report.md'}" in result.stderr


def test_where_there_is_no_terminal_what_takes_long_is_told_in_few_lines(monkeypatch, capsys):
    from SlicerUSSim.Command import progress

    now = [0.0]
    monkeypatch.setattr(progress, "perf_counter", lambda: now[0])
    with progress.Share("segment") as bar:
        for second in range(601):
            now[0] = float(second)
            bar(second / 600)
    lines = capsys.readouterr().err.splitlines()
    assert lines[:2] == ["segment: 0% done in 2 s", "segment: 1% done in 4 s"] and len(lines) == 9
    now[0] = 0.0
    with progress.Share("segment") as bar:  # what is quick is not told
        bar(0.5)
        bar(1.0)
    assert capsys.readouterr().err == ""
