"""The ussim command: its output; errors give one line on stderr, exit status 2, and no incomplete files."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from SlicerUSSim.Command.cli import main
from SlicerUSSim.Logic import Volume
from SlicerUSSim.Logic.mri.samples import head_mri
from SlicerUSSim.Logic.probe.arrays import PROBES
from SlicerUSSim.Logic.tracked.pose_files import read_pose, write_pose
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence

pytestmark = pytest.mark.usefixtures("segmented_once")


def ussim(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


@pytest.fixture(scope="module")
def head(tmp_path_factory):
    path = tmp_path_factory.mktemp("head") / "head.nii.gz"
    head_mri(3.0).write(path)
    return path


@pytest.fixture(scope="module")
def labels(head):
    path = head.with_name("labels.nii.gz")
    result = ussim("segment", head, "-o", path)
    assert result.exit_code == 0, result.output
    return path


@pytest.mark.slow
def test_demo_writes_everything_it_promises(head, tmp_path):
    pytest.importorskip("matplotlib", reason="pictures need matplotlib: pip install '.[demo]'")
    out = tmp_path / "out"
    result = ussim("demo", "--mri", head, "--out", out, "--probe", "convex", "--seed", 3)
    assert result.exit_code == 0, result.output
    assert "skull-stripped" in result.stderr and "grey matter" in result.stderr  # how, and the table of shares
    pictures = {"mri.png", "labels.png", "bmode.png", "figure.png"}
    names = pictures | {"bmode.mha", "labels.nii.gz", "labels.json", "demo.json", "preset.json"}
    assert names <= {p.name for p in out.iterdir()}
    for name in pictures:
        assert np.asarray(Image.open(out / name)).std() > 10, name
    summary = json.loads((out / "demo.json").read_text())
    assert summary["settings"]["seed"] == 3 and summary["probe"]["kind"] == "convex"
    assert summary["milliseconds_per_stage"]["scatterers"] > 0 and summary["device"]
    # The image with geometry is the picture, in its place in the patient.
    import SimpleITK as sitk

    image = sitk.ReadImage(str(out / "bmode.mha"))
    np.testing.assert_array_equal(sitk.GetArrayFromImage(image)[0], np.asarray(Image.open(out / "bmode.png")))
    pose = read_pose(out / "pose.json")
    middle = image.TransformContinuousIndexToPhysicalPoint([(n - 1) / 2 for n in image.GetSize()])
    centre_ras = np.array(middle) * [-1, -1, 1]
    assert abs((np.linalg.inv(pose) @ [*centre_ras, 1])[2]) < 1e-3


def test_a_pose_that_is_neither_a_file_nor_a_view_names_all_that_there_is(head):
    done = CliRunner().invoke(main, ["simulate", str(head), "--pose", "tempral", "-o", "a.png"])
    assert done.exit_code == 2 and len(done.stderr.splitlines()) == 1
    assert "--pose is 'tempral' (no such file), expected a file with the pose (.json, .txt, .tfm, .h5), auto, or" in (
        done.stderr
    )
    assert done.stderr.endswith("temporal, temporal-left, fontanelle, fontanelle-sagittal (temporal: from the right)\n")


def test_a_probe_that_places_itself_looks_at_what_was_added(head, tmp_path):
    """On the other side of the brain than the usual view, 20 mm behind it: it was not in the image."""
    mri = Volume.read(head)
    grid = np.indices(mri.array.shape[::-1]).T
    centre = np.array([-30.0, -20.0, 20.0]) + mri.ijk_to_ras[:3] @ [*(np.array(mri.array.shape[::-1]) / 2), 1.0]
    away = grid @ mri.ijk_to_ras[:3, :3].T + mri.ijk_to_ras[:3, 3] - centre
    mri.with_array((np.linalg.norm(away, axis=-1) < 8.0).astype(np.uint8)).write(tmp_path / "tumour.nii.gz")
    lesion = ["--add", f"tumour={tmp_path / 'tumour.nii.gz'}"]
    place = tmp_path / "bmode.mha"
    result = ussim("simulate", head, "--pose", "auto", *lesion, "-o", place)
    assert result.exit_code == 0, result.output
    import SimpleITK as sitk

    image = sitk.ReadImage(str(place))
    i, j, k = image.TransformPhysicalPointToContinuousIndex((centre * [-1, -1, 1]).tolist())
    assert 0 < i < image.GetWidth() and 0 < j < image.GetHeight()
    assert abs(k) * image.GetSpacing()[2] < 2.0  # in the plane
    assert sitk.GetArrayFromImage(image)[0, round(j), round(i)] > 0


def test_segment_writes_labels_and_their_tissues(labels, head):
    volume = Volume.read(labels)
    assert set(np.unique(volume.array)) == {0, 1, 2, 3, 4}
    np.testing.assert_allclose(volume.ijk_to_ras, Volume.read(head).ijk_to_ras, atol=1e-4)
    tissues = json.loads(labels.with_name("labels.json").read_text())
    assert tissues["tissues"]["3"]["name"] == "white matter" and "membrane" in tissues


def test_simulate_takes_probe_tissues_and_pose_from_files(labels, head, tmp_path):
    from SlicerUSSim.Logic import LinearProbe

    (tmp_path / "probe.json").write_text(json.dumps(LinearProbe(40, 50).to_dict()))
    pose = np.eye(4)
    pose[:3, 3] = [10, -30, 0]
    write_pose(tmp_path / "pose.json", pose)
    pictures = []
    for number, source in enumerate((labels, labels, head)):
        out = tmp_path / f"{number}.png"
        result = ussim("simulate", source, "--pose", tmp_path / "pose.json", "--probe", tmp_path / "probe.json",
                       "--tissues", labels.with_name("labels.json"), "-o", out, "--seed", number)  # fmt: skip
        assert result.exit_code == 0, result.output
        pictures.append(np.asarray(Image.open(out)).astype(float))
    assert 0.2 < pictures[0].shape[1] / pictures[0].shape[0] < 1.2
    assert np.abs(pictures[0] - pictures[1]).mean() > 1  # another seed
    assert pictures[2].mean() == pytest.approx(pictures[0].mean(), rel=0.1)  # the MRI is segmented alike


def bad_inputs(folder):
    """(arguments, part of the message) for user errors; what is wrong with files is tested where they are read."""
    np.savetxt(folder / "scaled.txt", np.eye(4) * 2)
    (folder / "nokey.json").write_text("{}")
    (folder / "probe.json").write_text('{"kind": "linear", "width_mm": -4, "depth_mm": 50}')
    (folder / "broken.nii.gz").write_text("broken")
    Volume(np.full((8, 8, 8), 5.0), np.eye(4)).write(folder / "constant.nrrd")
    Volume(np.full((8, 8, 8), 9, np.uint8), np.eye(4)).write(folder / "nine.nrrd")
    images = np.random.default_rng(0).integers(0, 255, (2, 40, 30)).astype(np.uint8)
    TrackedSequence(images, [{"ImageToReference": np.eye(4)}] * 2, [0.0, 0.1]).write(folder / "sweep.igs.mha")
    segment, out = ["segment", folder / "head.nii.gz", "-o"], folder / "out.png"
    simulate = ["simulate", folder / "head.nii.gz", "-o", out, "--pose"]
    return [
        (["segment", folder / "none.nii", "-o", folder / "l.nii.gz"], "none.nii: no such file"),
        (["segment", folder / "broken.nii.gz", "-o", folder / "l.nii.gz"], "broken.nii.gz: cannot be read"),
        (["segment", folder / "constant.nrrd", "-o", folder / "l.nii.gz"], "constant"),
        ([*segment, folder / "l.gif"], "unknown image format"),
        ([*segment, folder / "l.NII.GZ"], "in small letters"),
        ([*segment, folder / "nowhere" / "l.nii.gz"], "does not exist"),
        ([*segment, folder / "l.nii.gz", "--classes", 9], "classes is 9"),
        ([*segment, folder / "l.nii.gz", "--map", "24=csf"], "--map is for a label map"),
        ([*segment, folder / "l.nii.gz", "--mask", folder / "nine.nrrd"], "same grid"),
        (
            ["segment", folder / "sweep.igs.mha", "-o", folder / "l.nii.gz"],
            "is a sequence of tracked ultrasound images",
        ),
        ([*simulate, folder / "none.txt"], "none.txt' (no such file)"),
        ([*simulate, folder / "scaled.txt"], "last row"),
        ([*simulate, folder / "nokey.json"], 'no "probe_to_ras"'),
        ([*simulate, "auto", "--probe", folder / "probe.json"], "width_mm is -4"),
        (
            [*simulate, "auto", "--probe", "neonatel"],
            f"which does not exist, expected a JSON file or one of {', '.join(PROBES)}",
        ),
        ([*simulate, "auto", "--device", "abacus"], "no OpenCL device fits 'abacus'"),
        ([*simulate, "auto", "--seed", -1], "seed is -1"),
        (["demo", "--mri", folder / "head.nii.gz", "--out", folder / "probe.json" / "x"], "cannot be created"),
    ]


def test_a_mistake_is_one_line_and_writes_nothing(head, tmp_path):
    (tmp_path / "head.nii.gz").write_bytes(head.read_bytes())
    cases = bad_inputs(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    for arguments, message in cases:
        result = ussim(*arguments)
        assert result.exit_code == 2, result.output
        lines = [line for line in result.stderr.splitlines() if not line.startswith("ussim: warning: ")]
        errors = [line for line in lines if line.startswith("ussim: ")]
        assert len(errors) == 1 and message in errors[0], result.stderr
        assert "Traceback" not in result.output
        assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("command", ["simulate", "volume", "sweep", "optimize"])
def test_no_command_replaces_a_file_that_it_reads(command, labels, tmp_path):
    """`simulate` wrote its image over the label map, `sweep` over the recording."""
    own = tmp_path / "labels.igs.mha"
    Volume.read(labels).write(own)
    before = own.read_bytes()
    more = {"simulate": ["--pose", "auto"], "volume": ["--pose", "auto", "--tilt", 20]}.get(
        command, ["--sequence", own]
    )
    for link in (own, tmp_path / "." / own.name):
        patient = own if command in ("simulate", "volume") else labels
        result = ussim(command, patient, *more, "-o", link, "--overwrite")
        assert result.exit_code == 2 and f"{link} is an input, which it would replace" in result.stderr
    table = tmp_path / "tumour.nii.gz"
    Volume.read(labels).write(table)
    result = ussim(command, labels, *more, "--add", f"tumour={table}", "-o", table, "--overwrite")
    assert result.exit_code == 2 and own.read_bytes() == before
    if command == "optimize":  # the tissues of the labels, which it reads too
        result = ussim(command, labels, *more, "-o", labels.with_name("labels.json"), "--overwrite")
        assert result.exit_code == 2 and "labels.json is an input, which it would replace" in result.stderr


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes have no names here")
def test_pipes_and_devices_are_not_outputs_and_endless_inputs_are_refused(labels, tmp_path):
    """Both waited forever, or filled the memory."""
    for name in ("o.png", "o.nii.gz", "o.mha"):
        os.mkfifo(tmp_path / name)
        result = ussim("simulate", labels, "--pose", "auto", "-o", tmp_path / name)
        assert result.exit_code == 2 and f"{tmp_path / name}: is a pipe or a device, expected" in result.stderr
    result = ussim("simulate", labels, "--pose", "auto", "--preset", "/dev/zero", "-o", tmp_path / "p.png")
    assert result.exit_code == 2 and "/dev/zero: has more than" in result.stderr


def test_values_that_are_not_text_and_sweeps_without_end_are_refused(labels, tmp_path):
    out = tmp_path / "o.nrrd"
    result = ussim("simulate", labels, "--pose", "auto", "-o", out, "--set", "probe.depth_mm=\udced\udca0")
    assert result.exit_code == 2 and "expected NAME=VALUE as text" in result.stderr
    for options, words in (
        (("--tilt", "nan"), "a sweep tilts over nan degrees"), (("--slide", "inf"), "a sweep slides over inf mm"),
        (("--tilt", 10, "--frames", 1_000_000), "not in the range 1<=x<=10000"),
    ):  # fmt: skip
        result = ussim("volume", labels, "--pose", "auto", "-o", out, *options)
        assert result.exit_code == 2 and words in result.stderr and not out.exists()


@pytest.mark.parametrize(
    ("name", "command"),
    [
        ("o.png", "simulate none.mha --pose auto -o o.png"),
        ("o.vti", "volume none.mha --pose auto --tilt 5 -o o.vti"),
        ("o.seq.mha", "sweep none.mha --sequence none.mha -o o.seq.mha"),
        ("f.png", "sweep none.mha --sequence none.mha -o o.seq.mha --set recording.field=f.png"),
        ("o.mha", "segment none.mha -o o.mha"),
        ("o.json", "segment none.mha -o o.mha"),
        ("s.vtp", "segment none.mha -o o.mha --sheets s.vtp"),
        *((name, f"optimize none.mha --sequence none.mha -o o.json {option}{name}") for option, name in (
            ("-o ", "r.json"), ("--report ", "r.html"), ("--save-preset ", "p.json"),
            ("--set results.save_transform=", "t.json"), ("--set recording.field=", "f.png"),
        )),
    ],
)  # fmt: skip
def test_an_output_that_exists_is_refused_before_anything_is_read(name, command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).write_text("mine")
    result = ussim(*command.split())
    assert result.exit_code == 2
    assert result.stderr == f"ussim: {name}: exists; give another name, or --overwrite to replace it\n"
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


def test_an_output_that_exists_is_replaced_with_overwrite(labels, tmp_path):
    for name in ("o.png", "o.mha", "o.nii.gz"):
        simulate = ("simulate", labels, "--pose", "auto", "-o", tmp_path / name)
        assert ussim(*simulate).exit_code == 0
        assert ussim(*simulate).exit_code == 2
        (tmp_path / name).write_bytes(b"mine")
        assert ussim(*simulate, "--overwrite").exit_code == 0 and (tmp_path / name).stat().st_size > 100


_MASK, _ALSO = ["--mask", "{labels}"], ["--also", "t2={labels}", "--contrast", "t2"]


@pytest.mark.parametrize(
    ("command", "given", "named"),
    [
        ("simulate", _MASK, "--mask is for an MRI"),
        ("simulate", ["--contrast", "t1"], "--contrast is for an MRI"),
        ("simulate", ["--skull-strip", "none"], "--skull-strip is for an MRI"),
        ("simulate", ["--set", "segmentation.thin_sulci=false"], "--set segmentation.thin_sulci is for an MRI"),
        ("volume", _MASK, "--mask is for an MRI"),
        ("sweep", _ALSO, "--also are for an MRI"),
        ("optimize", _ALSO, "--also are for an MRI"),
    ],
)
def test_options_for_an_mri_are_refused_with_labels(command, given, named, labels, tmp_path):
    """They were ignored without a word."""
    recording = tmp_path / "tracked.igs.mha"
    images = np.zeros((1, 8, 8), np.uint8)
    TrackedSequence(images, ({"ImageToReference": np.eye(4)},), np.zeros(1)).write(recording)
    more = ["--sequence", recording] if command in ("sweep", "optimize") else ["--pose", "auto"]
    more += ["--tilt", 20] if command == "volume" else []
    out = tmp_path / ("o.igs.mha" if command == "sweep" else "o.nrrd")
    result = ussim(command, labels, *more, "-o", out, *(text.format(labels=labels) for text in given))
    assert result.exit_code == 2 and named in result.stderr, result.output
    assert f"{labels}: is a label map, and " in result.stderr and "use --mri if it is one" in result.stderr


def test_a_pose_past_the_volume_is_a_warning_and_a_black_image(labels, tmp_path):
    pose = np.eye(4)
    pose[:3, 3] = [500, 0, 0]
    write_pose(tmp_path / "pose.json", pose)
    result = ussim("simulate", labels, "--pose", tmp_path / "pose.json", "-o", tmp_path / "o.png")
    assert result.exit_code == 0
    assert "ussim: warning: the probe looks past the volume" in result.stderr
    # Below the ring-down at the face there is amplifier noise only.
    assert np.asarray(Image.open(tmp_path / "o.png"))[128:].max() < 40


@pytest.mark.parametrize("of", ["labels", pytest.param("an MRI", marks=pytest.mark.slow)])
def test_set_changes_the_tissues_of_labels_and_of_an_mri(of, head, labels, tmp_path):
    source = labels if of == "labels" else head

    def image(source, *options):
        out = tmp_path / "image.png"
        result = ussim("simulate", source, "--pose", "auto", "-o", out, "--overwrite", *options)
        assert result.exit_code == 0, result.output
        return np.asarray(Image.open(out)).astype(float)

    plain = image(source)
    louder = image(source, "--set", "white matter.mu0=1.0", "--set", "membrane.thickness_mm=0.5")
    assert louder.mean() > plain.mean() + 1
    smaller = image(source, "--set", "probe.depth_mm=60", "--set", "display.image_size=100,120")
    assert smaller.shape == (100, 120)
    for name in ("liver", "lver"):
        result = ussim("simulate", source, "--pose", "auto", "-o", tmp_path / "o.png", "--set", f"{name}.mu0=1")
        assert result.exit_code == 2 and f"--set: no tissue '{name}', expected " in result.stderr
        assert not (tmp_path / "o.png").exists()


def test_an_image_of_labels_imports_no_library_without_need(labels, tmp_path):
    (tmp_path / "pose.json").write_text(json.dumps({"probe_to_ras": np.eye(4).tolist()}))
    call = ["simulate", str(labels), "--pose", str(tmp_path / "pose.json"), "-o", str(tmp_path / "o.png")]
    code = (
        f"import sys; from SlicerUSSim.Command.cli import main; main({call}, standalone_mode=False); "
        "print(*{'.'.join(name.split('.')[:n]) for name in sys.modules for n in (1, 2)})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    slow = {"SimpleITK", "skimage", "vtkmodules", "pydicom", "scipy.optimize", "scipy.spatial"}
    assert not slow & set(done.stdout.split())


@pytest.mark.long
def test_the_demo_replaces_its_files_only_with_overwrite(head, tmp_path):
    pytest.importorskip("matplotlib", reason="pictures need matplotlib: pip install '.[demo]'")
    out = tmp_path / "out"
    out.mkdir()
    mine = out / "figure.png"
    mine.write_bytes(b"my figure")
    (out / "notes.txt").write_text("mine")
    result = ussim("demo", "--mri", head, "-o", out)
    assert result.exit_code == 2 and f"{mine}: exists; give another name, or --overwrite" in result.stderr
    assert mine.read_bytes() == b"my figure"
    mine.unlink()
    assert ussim("demo", "--mri", head, "-o", out).exit_code == 0
    assert ussim("demo", "--mri", head, "-o", out, "--overwrite").exit_code == 0
    assert not list(out.glob(".results-*")) and (out / "notes.txt").read_text() == "mine"
    result = ussim("demo", "--mri", out / "labels.nii.gz", "--out", out, "--overwrite")
    assert result.exit_code == 2 and "labels.nii.gz is an input, which it would replace" in result.stderr


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="a file on a full disk is made by Linux")
@pytest.mark.parametrize("arguments", [["--version"], ["devices"]])
def test_an_output_on_a_full_disk_is_one_line(arguments):
    with open("/dev/full", "w") as full:
        result = subprocess.run(
            [sys.executable, "-m", "SlicerUSSim.Command", *arguments], stdout=full, stderr=subprocess.PIPE, text=True
        )
    assert result.returncode == 2
    assert result.stderr == "ussim: standard output cannot be written (No space left on device)\n"
