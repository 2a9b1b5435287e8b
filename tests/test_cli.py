"""The ussim command: its output; errors give one line on stderr, exit status 2, and no incomplete files."""

from __future__ import annotations

import inspect
import json
import os
import struct
import subprocess
import sys
import zlib

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from SlicerUSSim.Command.cli import main
from SlicerUSSim.Logic import Preset, UltrasoundSimulator, Volume
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
    head_mri(2.0).write(path)
    return path


@pytest.fixture(scope="module")
def labels(head):
    path = head.with_name("labels.nii.gz")
    result = ussim("segment", head, "-o", path)
    assert result.exit_code == 0, result.output
    return path


def test_help_names_the_commands():
    result = ussim("--help")
    assert result.exit_code == 0
    for command in ("check", "demo", "segment", "simulate", "devices"):
        assert command in result.output


@pytest.mark.slow
def test_demo_writes_everything_it_promises(head, tmp_path):
    pytest.importorskip("matplotlib", reason="pictures need matplotlib: pip install '.[demo]'")
    out = tmp_path / "out"
    result = ussim("demo", "--mri", head, "--out", out, "--probe", "convex", "--seed", 3)
    assert result.exit_code == 0, result.output
    assert "skull-stripped" in result.stderr and "grey matter" in result.stderr  # how, and the table of shares
    names = {
        "mri.png",
        "labels.png",
        "bmode.png",
        "figure.png",
        "bmode.mha",
        "labels.nii.gz",
        "labels.json",
        "demo.json",
        "preset.json",
    }
    assert names <= {p.name for p in out.iterdir()}
    for name in names:
        if name.endswith(".png"):
            picture = np.asarray(Image.open(out / name))
            assert picture.std() > 10, name
    summary = json.loads((out / "demo.json").read_text())
    assert summary["settings"]["seed"] == 3 and summary["probe"]["kind"] == "convex"
    assert summary["milliseconds_per_stage"]["scatterers"] > 0 and summary["device"]
    # The image with geometry is the picture, in its place in the patient.
    import SimpleITK as sitk

    image = sitk.ReadImage(str(out / "bmode.mha"))
    np.testing.assert_array_equal(sitk.GetArrayFromImage(image)[0], np.asarray(Image.open(out / "bmode.png")))
    pose = read_pose(out / "pose.json")
    centre_ras = np.array(image.TransformContinuousIndexToPhysicalPoint([(n - 1) / 2 for n in image.GetSize()])) * [
        -1,
        -1,
        1,
    ]
    assert abs((np.linalg.inv(pose) @ [*centre_ras, 1])[2]) < 1e-3


def test_what_sheets_lay_over_the_labels_is_not_what_add_did(head, tmp_path, monkeypatch):
    """--pose auto is aimed at what --add laid, and was aimed at a structure of --sheets auto."""
    from SlicerUSSim.Command import patient_options, sheets

    def found(self, path, mri, segmentation, contrast):
        array = segmentation.labels.array.copy()
        array[30:40, 30:40, 20:30] = len(segmentation.tissue_names) + 1
        return sheets._Drawn(
            None, segmentation.labels.with_array(array), (*segmentation.tissue_names, "choroid plexus")
        )

    placed, poses = patient_options._placed, []

    def recorded(*given):
        poses.append(placed(*given).probe_to_ras)
        return placed(*given)

    monkeypatch.setattr(patient_options, "_placed", recorded)
    for is_drawn in (False, True):
        if is_drawn:
            monkeypatch.setattr(sheets.DrawnSheets, "found", found)
        result = ussim("simulate", head, "--pose", "auto", "-o", tmp_path / "a.png")
        assert result.exit_code == 0, result.output
    np.testing.assert_allclose(poses[1], poses[0], atol=1e-6)


def test_a_pose_that_is_neither_a_file_nor_a_view_names_all_that_there_is(head):
    done = CliRunner().invoke(main, ["simulate", str(head), "--pose", "tempral", "-o", "a.png"])
    assert done.exit_code == 2 and len(done.stderr.splitlines()) == 1
    assert "--pose is 'tempral' (no such file), expected a file with the pose (.json, .txt, .tfm, .h5), auto, or" in (
        done.stderr
    )
    assert done.stderr.endswith("temporal, temporal-left, fontanelle, fontanelle-sagittal (temporal: from the right)\n")


@pytest.mark.parametrize("command", [pytest.param("demo", marks=pytest.mark.slow), "simulate"])
def test_a_probe_that_places_itself_looks_at_what_was_added(command, head, tmp_path):
    """On the other side of the brain than the usual view, 20 mm behind it: it was not in the image."""
    mri = Volume.read(head)
    grid = np.indices(mri.array.shape[::-1]).T
    centre = np.array([-30.0, -20.0, 20.0]) + mri.ijk_to_ras[:3] @ [*(np.array(mri.array.shape[::-1]) / 2), 1.0]
    away = grid @ mri.ijk_to_ras[:3, :3].T + mri.ijk_to_ras[:3, 3] - centre
    mri.with_array((np.linalg.norm(away, axis=-1) < 8.0).astype(np.uint8)).write(tmp_path / "tumour.nii.gz")
    lesion = ["--add", f"tumour={tmp_path / 'tumour.nii.gz'}"]
    if command == "demo":
        pytest.importorskip("matplotlib", reason="pictures need matplotlib: pip install '.[demo]'")
        result = ussim("demo", "--mri", head, "--out", tmp_path / "out", *lesion)
        place = tmp_path / "out" / "bmode.mha"
    else:
        place = tmp_path / "bmode.mha"
        result = ussim("simulate", head, "--pose", "auto", *lesion, "-o", place)
    assert result.exit_code == 0, result.output
    import SimpleITK as sitk

    image = sitk.ReadImage(str(place))
    i, j, k = image.TransformPhysicalPointToContinuousIndex((centre * [-1, -1, 1]).tolist())
    assert 0 < i < image.GetWidth() and 0 < j < image.GetHeight()
    assert abs(k) * image.GetSpacing()[2] < 2.0  # in the plane
    assert sitk.GetArrayFromImage(image)[0, round(j), round(i)] > 0


def test_the_demo_without_nilearn_says_that_it_uses_a_phantom(monkeypatch):
    import importlib.util

    from SlicerUSSim.Logic.mri.samples import demo_mri

    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "nilearn" else find(name, *rest)
    )
    volume, source = demo_mri()
    assert "synthetic head phantom" in source and volume.array.max() > 0


def test_segment_writes_labels_and_their_tissues(labels, head):
    volume = Volume.read(labels)
    assert set(np.unique(volume.array)) == {0, 1, 2, 3, 4}
    np.testing.assert_allclose(volume.ijk_to_ras, Volume.read(head).ijk_to_ras, atol=1e-4)
    tissues = json.loads(labels.with_name("labels.json").read_text())
    assert tissues["tissues"]["3"]["name"] == "white matter" and "membrane" in tissues


@pytest.mark.parametrize("suffix", [".png", ".mha", ".nrrd", ".nii.gz", ".vti"])
def test_simulate_writes_every_format(labels, tmp_path, suffix):
    out = tmp_path / f"image{suffix}"
    result = ussim("simulate", labels, "--pose", "auto", "-o", out)
    assert result.exit_code == 0, result.output
    assert "from labels" in result.output and out.stat().st_size > 1000
    assert list(tmp_path.iterdir()) == [out]


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


@pytest.mark.parametrize("kind", ["json", "bare", "text", "tfm"])
def test_poses_are_read_in_every_form(kind, tmp_path):
    from scipy.spatial.transform import Rotation

    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_matrix()
    pose[:3, 3] = [1, -2, 30]
    path = tmp_path / {"json": "p.json", "bare": "p.json", "text": "p.txt", "tfm": "p.tfm"}[kind]
    if kind == "json":
        write_pose(path, pose)
    elif kind == "bare":
        path.write_text(json.dumps(pose.tolist()))
    elif kind == "text":
        np.savetxt(path, pose)
    else:
        import SimpleITK as sitk

        # As Slicer saves a linear transform: from world to probe, in LPS.
        flip = np.diag([-1.0, -1, 1, 1])
        inverse = flip @ np.linalg.inv(pose) @ flip
        transform = sitk.AffineTransform(3)
        transform.SetMatrix(inverse[:3, :3].ravel().tolist())
        transform.SetTranslation(inverse[:3, 3].tolist())
        sitk.WriteTransform(transform, str(path))
    np.testing.assert_allclose(read_pose(path), pose, atol=1e-9)


def test_devices_says_which_is_used():
    result = ussim("devices")
    assert result.exit_code == 0 and "used: " in result.output and "* " in result.output


def bad_inputs(folder):
    """(arguments, part of the message) for user errors."""
    np.savetxt(folder / "three.txt", np.eye(3))
    np.savetxt(folder / "scaled.txt", np.eye(4) * 2)
    np.savetxt(folder / "singular.txt", np.zeros((4, 4)))
    (folder / "words.txt").write_text("to the left")
    (folder / "nokey.json").write_text("{}")
    (folder / "probe.json").write_text('{"kind": "linear", "width_mm": -4, "depth_mm": 50}')
    (folder / "broken.nii.gz").write_text("broken")
    (folder / "empty").mkdir()
    import SimpleITK as sitk

    sitk.WriteImage(sitk.GetImageFromArray(np.zeros((20, 20), np.uint8)), str(folder / "flat.nrrd"))
    Volume(np.full((8, 8, 8), 5.0), np.eye(4)).write(folder / "constant.nrrd")
    Volume(np.full((8, 8, 8), np.nan), np.eye(4)).write(folder / "nan.nrrd")
    Volume(np.full((8, 8, 8), 9, np.uint8), np.eye(4)).write(folder / "nine.nrrd")
    mri, out = folder / "head.nii.gz", folder / "out.png"
    return [
        (["segment", folder / "none.nii", "-o", folder / "l.nii.gz"], "none.nii: no such file"),
        (["segment", folder / "broken.nii.gz", "-o", folder / "l.nii.gz"], "broken.nii.gz: cannot be read"),
        (["segment", folder / "empty", "-o", folder / "l.nii.gz"], "no DICOM series"),
        (["segment", folder / "flat.nrrd", "-o", folder / "l.nii.gz"], "flat.nrrd: is a 20x20 image"),
        (["segment", folder / "constant.nrrd", "-o", folder / "l.nii.gz"], "constant"),
        (["segment", folder / "nan.nrrd", "-o", folder / "l.nii.gz"], "not finite"),
        (["segment", mri, "-o", folder / "l.gif"], "unknown image format"),
        (["segment", mri, "-o", folder / "l.NII.GZ"], "in small letters"),
        (["segment", mri, "-o", folder / "nowhere" / "l.nii.gz"], "does not exist"),
        (["segment", mri, "-o", folder / "l.nii.gz", "--classes", 9], "classes is 9"),
        (["segment", mri, "-o", folder / "l.nii.gz", "--map", "24=csf"], "--map is for a label map"),
        (["segment", mri, "-o", folder / "l.nii.gz", "--mask", folder / "nine.nrrd"], "same grid"),
        (["simulate", mri, "--pose", folder / "none.txt", "-o", out], "none.txt' (no such file)"),
        (["simulate", mri, "--pose", folder / "three.txt", "-o", out], "9 numbers"),
        (["simulate", mri, "--pose", folder / "scaled.txt", "-o", out], "last row"),
        (["simulate", mri, "--pose", folder / "singular.txt", "-o", out], "last row"),
        (["simulate", mri, "--pose", folder / "words.txt", "-o", out], "is not a pose"),
        (["simulate", mri, "--pose", folder / "nokey.json", "-o", out], 'no "probe_to_ras"'),
        (["simulate", mri, "--pose", "auto", "--probe", folder / "probe.json", "-o", out], "width_mm is -4"),
        (["simulate", mri, "--pose", "auto", "--device", "abacus", "-o", out], "no OpenCL device fits 'abacus'"),
        (["simulate", mri, "--pose", "auto", "--seed", -1, "-o", out], "seed is -1"),
        (["simulate", mri, "--pose", "auto", "--dynamic-range", 0, "-o", out], "dynamic_range_db is 0"),
        (["simulate", folder / "nine.nrrd", "--pose", "auto", "-o", out], "a binary mask (1 label"),
        (["simulate", mri, "--pose", "auto", "-o", folder / "out.xyz"], "unknown image format"),
        (["simulate", mri, "--pose", "auto", "-o", folder / "nowhere" / "o.png"], "does not exist"),
        (["demo", "--mri", mri, "--out", folder / "probe.json" / "x"], "cannot be created"),
        (["simulate", mri, "--pose", "auto", "-o", "/proc/o.png"], "/proc/o.png: cannot be written"),
    ]


@pytest.mark.parametrize("number", range(27))
def test_a_mistake_is_one_line_and_writes_nothing(number, head, tmp_path):
    (tmp_path / "head.nii.gz").write_bytes(head.read_bytes())
    cases = bad_inputs(tmp_path)
    assert len(cases) == 27
    arguments, message = cases[number]
    before = sorted(tmp_path.rglob("*"))
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
        result = ussim(command, own if command in ("simulate", "volume") else labels, *more, "-o", link)
        assert result.exit_code == 2 and f"{link} is an input, which it would replace" in result.stderr
    table = tmp_path / "tumour.nii.gz"
    Volume.read(labels).write(table)
    result = ussim(command, labels, *more, "--add", f"tumour={table}", "-o", table)
    assert result.exit_code == 2 and own.read_bytes() == before


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes have no names here")
def test_pipes_and_devices_are_no_outputs_and_endless_inputs_are_refused(labels, tmp_path):
    """Both waited for ever, or filled the memory."""
    for name in ("o.png", "o.nii.gz", "o.mha"):
        os.mkfifo(tmp_path / name)
        result = ussim("simulate", labels, "--pose", "auto", "-o", tmp_path / name)
        assert result.exit_code == 2 and f"{tmp_path / name}: is a pipe or a device, expected" in result.stderr
    result = ussim("simulate", labels, "--pose", "auto", "--preset", "/dev/zero", "-o", tmp_path / "p.png")
    assert result.exit_code == 2 and "/dev/zero: has more than" in result.stderr


def test_a_picture_that_is_too_large_to_be_looked_at_is_not_replaced(labels, tmp_path):
    header = struct.pack(">IIBBBBB", 60000, 60000, 8, 0, 0, 0, 0)
    chunks = b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in ((b"IHDR", header), (b"IDAT", zlib.compress(b"")), (b"IEND", b""))
    )
    out = tmp_path / "o.png"
    out.write_bytes(b"\x89PNG\r\n\x1a\n" + chunks)
    result = ussim("simulate", labels, "--pose", "auto", "-o", out)
    assert result.exit_code == 2 and "is not as this program wrote it" in result.stderr


def test_values_that_are_no_text_and_sweeps_without_end_are_refused(labels, tmp_path):
    out = tmp_path / "o.nrrd"
    result = ussim("simulate", labels, "--pose", "auto", "-o", out, "--set", "probe.depth_mm=\udced\udca0")
    assert result.exit_code == 2 and "expected NAME=VALUE as text" in result.stderr
    for options, words in (
        (("--tilt", "nan"), "a sweep tilts over nan degrees"), (("--slide", "inf"), "a sweep slides over inf mm"),
        (("--tilt", 10, "--frames", 1_000_000), "not in the range 1<=x<=10000"),
    ):  # fmt: skip
        result = ussim("volume", labels, "--pose", "auto", "-o", out, *options)
        assert result.exit_code == 2 and words in result.stderr and not out.exists()


@pytest.mark.parametrize("name", ["o.png", "o.mha", "o.mhd", "o.nrrd", "o.nii.gz", "o.vti"])
def test_an_image_is_replaced_only_as_it_was_written(name, labels, tmp_path):
    """A user's file, and a result that a user edited, were replaced without a word."""
    out = tmp_path / name
    simulate = ("simulate", labels, "--pose", "auto", "-o", out)
    for _ in range(2):  # its own file is replaced
        result = ussim(*simulate)
        assert result.exit_code == 0, result.output
    if name.endswith(".png"):
        with Image.open(out) as picture:
            pixels, kept = np.asarray(picture), picture.info["Software"]
        entries = PngInfo()
        entries.add_text("Software", kept)  # as an editor that keeps it
        Image.fromarray(255 - pixels).save(out, pnginfo=entries)
    else:
        Volume.read(labels).write(out)
    before = out.read_bytes()
    result = ussim(*simulate)
    assert result.exit_code == 2 and out.read_bytes() == before
    assert f"{out}: exists and is not as this program wrote it" in result.stderr
    assert "choose another name, or remove it" in result.stderr and "\n" not in result.stderr.strip()


@pytest.mark.parametrize(
    ("given", "named"),
    [
        (["--mask", "{labels}"], "--mask is for an MRI"),
        (["--contrast", "t1"], "--contrast is for an MRI"),
        (["--skull-strip", "none"], "--skull-strip is for an MRI"),
        (["--no-thin-sulci"], "--thin-sulci is for an MRI"),
        (["--also", "t2={labels}", "--contrast", "t2"], "--also are for an MRI"),
    ],
)
@pytest.mark.parametrize("command", ["simulate", "volume", "sweep", "optimize"])
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


@pytest.mark.slow
def test_errors_about_another_mri_name_its_file_alone(head, labels, tmp_path):
    constant = tmp_path / "constant.nii.gz"
    mri = Volume.read(head)
    mri.with_array(np.full(mri.array.shape, 7.0, np.float32)).write(constant)
    for other in (constant, labels):
        result = ussim("segment", head, "--also", f"t2={other}", "-o", tmp_path / "o.nii.gz")
        assert result.exit_code == 2 and str(other) in result.stderr and str(head) not in result.stderr
    for command in (("segment", head), ("demo", "--out", tmp_path / "demo", "--mri", head)):
        out = ("-o", tmp_path / "o.nii.gz") if command[0] == "segment" else ()
        result = ussim(*command, "--also", f"t2={head}", *out)
        assert result.exit_code == 2
        assert f"--also t2={head}: is the file of the MRI again, expected another image" in result.stderr
    twice = ("--also", f"t2={constant}", "--also", f"flair={constant}")
    result = ussim("segment", head, *twice, "-o", tmp_path / "o.nii.gz")
    assert result.exit_code == 2 and "is the file of --also t2 again" in result.stderr


def test_a_volume_replaces_images_of_this_program_only(labels, tmp_path):
    out = tmp_path / "o.nrrd"
    volume = ("volume", labels, "--pose", "auto", "--tilt", 4, "--frames", 3, "--spacing", 2, "-o", out)
    assert ussim("simulate", labels, "--pose", "auto", "-o", out).exit_code == 0
    for _ in range(2):
        result = ussim(*volume)
        assert result.exit_code == 0, result.output
    for content in (b"", b"my notes", b"{", b"\x89PNG", b"<html>mine"):
        out.write_bytes(content)
        result = ussim(*volume)
        assert result.exit_code == 2 and f"{out}: exists and is not as" in result.stderr
        assert out.read_bytes() == content


def test_a_device_that_fails_is_one_line_too(labels, tmp_path, monkeypatch):
    import pyopencl

    def fail(*_):
        raise pyopencl.MemoryError("clEnqueueNDRangeKernel", -4)

    monkeypatch.setattr("SlicerUSSim.Logic.imaging.raytracing.RayTracer.run", fail)
    result = ussim("simulate", labels, "--pose", "auto", "-o", tmp_path / "o.png")
    assert result.exit_code == 2 and "the OpenCL device failed" in result.stderr
    assert not list(tmp_path.iterdir())


def test_a_pose_past_the_volume_is_a_warning_and_a_black_image(labels, tmp_path):
    pose = np.eye(4)
    pose[:3, 3] = [500, 0, 0]
    write_pose(tmp_path / "pose.json", pose)
    result = ussim("simulate", labels, "--pose", tmp_path / "pose.json", "-o", tmp_path / "o.png")
    assert result.exit_code == 0
    assert "ussim: warning: the probe looks past the volume" in result.stderr
    # Below the ring-down at the face there is amplifier noise only.
    assert np.asarray(Image.open(tmp_path / "o.png"))[128:].max() < 40


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_an_unwritable_folder_is_named(labels, tmp_path):
    tmp_path.chmod(0o500)
    result = ussim("simulate", labels, "--pose", "auto", "-o", tmp_path / "o.png")
    assert result.exit_code == 2 and "cannot be written" in result.stderr


def test_a_preset_gives_the_same_image_and_options_go_before_it(head, labels, tmp_path):
    preset = Preset(PROBES["microconvex"]).changed("display", gain_db=6.0).changed("settings", seed=5)
    preset.write(tmp_path / "preset.json")
    probe = tmp_path / "probe.json"
    probe.write_text(json.dumps(preset.probe.to_dict()))

    def image(*options):
        out = tmp_path / "image.png"
        result = ussim("simulate", labels, "--pose", "auto", "-o", out, *options)
        assert result.exit_code == 0, result.output
        return np.asarray(Image.open(out))

    whole = image("--preset", tmp_path / "preset.json")
    np.testing.assert_array_equal(whole, image("--probe", probe, "--gain", 6, "--seed", 5))
    quieter = image("--preset", tmp_path / "preset.json", "--gain", -6)
    np.testing.assert_array_equal(quieter, image("--probe", probe, "--gain", -6, "--seed", 5))
    assert quieter.mean() < whole.mean()


def test_an_mri_gives_its_simulator_the_shares_of_voxels_and_labels_have_none(head, labels, tmp_path, monkeypatch):
    textures = []

    class Seen(UltrasoundSimulator):
        def __init__(self, labels, tissues, settings=None, device=None, texture=None, sheets=None):
            textures.append(texture)
            super().__init__(labels, tissues, settings, device, texture, sheets)

    monkeypatch.setattr("SlicerUSSim.Logic.imaging.simulator.UltrasoundSimulator", Seen)
    for source in (head, labels):
        result = ussim("simulate", source, "--pose", "auto", "-o", tmp_path / "image.png")
        assert result.exit_code == 0, result.output
    assert textures[0].volume_share.max() > 0.4 and textures[1] is None


@pytest.mark.parametrize("of", [pytest.param("labels", marks=pytest.mark.slow), "an MRI"])
def test_set_changes_the_tissues_of_labels_and_of_an_mri(of, head, labels, tmp_path):
    source = labels if of == "labels" else head

    def image(source, *options):
        out = tmp_path / "image.png"
        result = ussim("simulate", source, "--pose", "auto", "-o", out, *options)
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


def test_the_command_offers_every_probe_there_is():
    options = {option.name: option for option in main.commands["demo"].params}
    assert list(options["kind"].type.choices) == list(PROBES)


@pytest.mark.parametrize("name", list(main.commands))
def test_a_command_says_every_parameter_and_its_type(name):
    parameters = inspect.signature(main.commands[name].callback).parameters.values()
    for parameter in parameters:
        assert parameter.kind is not parameter.VAR_KEYWORD, f"{name} takes **{parameter.name}"
        assert parameter.annotation is not parameter.empty, f"{name}: {parameter.name} has no type"


def test_python_m_is_the_command():
    done = subprocess.run([sys.executable, "-m", "SlicerUSSim.Command", "--version"], capture_output=True, text=True)
    assert done.returncode == 0 and "ussim, version" in done.stdout


@pytest.mark.parametrize("command", ["segment", "simulate"])
def test_a_tracked_sweep_given_as_an_mri_is_called_what_it_is(command, tmp_path):
    """Formerly it "goes through the image from the bottom to the top, as a limb or a body does"."""
    rng = np.random.default_rng(0)
    sweep = TrackedSequence(
        rng.integers(0, 255, (4, 40, 30)).astype(np.uint8), [{"ImageToReference": np.eye(4)}] * 4, [0.0, 0.1, 0.2, 0.3]
    )
    sweep.write(tmp_path / "sweep.igs.mha")
    options = ["--pose", "auto", "--mri"] if command == "simulate" else []
    result = ussim(command, tmp_path / "sweep.igs.mha", *options, "-o", tmp_path / "out.nii.gz")
    assert result.exit_code == 2 and "is a sequence of tracked ultrasound images, expected an MRI" in result.stderr


@pytest.mark.slow
def test_the_demo_replaces_only_files_that_it_wrote_itself(head, tmp_path):
    pytest.importorskip("matplotlib", reason="pictures need matplotlib: pip install '.[demo]'")
    out = tmp_path / "out"
    out.mkdir()
    mine = out / "figure.png"
    mine.write_bytes(b"my figure")
    (out / "notes.txt").write_text("mine")
    result = ussim("demo", "--mri", head, "--out", out)
    assert result.exit_code == 2 and f"{mine}: exists and is not as this command wrote it" in result.stderr
    assert mine.read_bytes() == b"my figure"
    mine.unlink()
    assert ussim("demo", "--mri", head, "--out", out).exit_code == 0
    assert ussim("demo", "--mri", head, "--out", out).exit_code == 0  # its own files are replaced
    assert not list(out.glob(".results-*")) and (out / "notes.txt").read_text() == "mine"
    preset = out / "preset.json"
    preset.write_text(preset.read_text() + "\n")  # edited
    edited = preset.read_text()
    result = ussim("demo", "--mri", head, "--out", out)
    assert result.exit_code == 2 and "preset.json: exists and is not as" in result.stderr
    assert preset.read_text() == edited


_FULL = """
import resource, signal, sys
from SlicerUSSim.Command import whole_line
from SlicerUSSim.Command.cli import main

draw = whole_line.draw_views

def draw_on_a_full_disk(*arguments):  # only then: the compiler of the kernels has files of its own
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4000, resource.RLIM_INFINITY))
    draw(*arguments)

whole_line.draw_views = draw_on_a_full_disk
main(sys.argv[1:])
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no limit of the size of files")
@pytest.mark.slow
def test_the_demo_on_a_full_disk_names_its_own_folder_and_leaves_nothing(head, tmp_path):
    """It named a file in a hidden folder that was gone, and left an empty one."""
    pytest.importorskip("matplotlib", reason="pictures need matplotlib: pip install '.[demo]'")
    out = tmp_path / "out"
    command = [sys.executable, "-c", _FULL, "demo", "--mri", head, "--skull-strip", "none", "--out", out]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True)
    assert done.returncode == 2 and f"{out / 'figure.png'}: cannot be written" in done.stderr, done.stderr
    assert not out.exists()


def test_the_demo_refuses_a_label_map_as_segment_does(labels, tmp_path):
    result = ussim("demo", "--mri", labels, "--out", tmp_path / "demo")
    assert result.exit_code == 2 and "is a label map" in result.stderr and "expected an MRI" in result.stderr
    assert not (tmp_path / "demo").exists()


@pytest.mark.slow
def test_the_demo_leaves_nothing_behind_of_an_image_that_it_refuses(tmp_path):
    pytest.importorskip("matplotlib", reason="pictures need matplotlib: pip install '.[demo]'")
    noise = tmp_path / "noise.nrrd"
    values = np.random.default_rng(0).normal(100, 20, (60, 60, 60)).astype(np.float32)
    Volume(values, np.diag([3.0, 3.0, 3.0, 1.0])).write(noise)
    result = ussim("demo", "--mri", noise, "--out", tmp_path / "new" / "demo")
    assert result.exit_code == 2 and "noise" in result.stderr and not (tmp_path / "new").exists()


def test_simulate_takes_probes_by_name(labels, tmp_path):
    """`--probe neonatal` was read as a file."""
    named, from_file = tmp_path / "named.png", tmp_path / "file.png"
    (tmp_path / "probe.json").write_text(json.dumps(PROBES["neonatal"].to_dict()))
    for probe, out in (("neonatal", named), (tmp_path / "probe.json", from_file)):
        result = ussim(
            "simulate", labels, "--pose", "auto", "--probe", probe, "--set", "probe.scan_lines=32", "-o", out
        )
        assert result.exit_code == 0, result.output
    np.testing.assert_array_equal(np.asarray(Image.open(named)), np.asarray(Image.open(from_file)))
    result = ussim("simulate", labels, "--pose", "auto", "--probe", "neonatel", "-o", tmp_path / "none.png")
    assert result.exit_code == 2 and len(result.stderr.splitlines()) == 1
    assert "neonatel" in result.stderr and ", ".join(PROBES) in result.stderr
    result = ussim("simulate", labels, "--pose", "auto", "--set", "probe.focal_zones=4", "-o", tmp_path / "none.png")
    assert (
        result.exit_code == 2 and "focal_zones is 4 with transmit 'focus', expected transmit 'zones'" in result.stderr
    )
    assert not (tmp_path / "none.png").exists()


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="a file on a full disk is made by Linux")
@pytest.mark.parametrize("arguments", [["--version"], ["--help"], ["devices"]])
def test_an_output_on_a_full_disk_is_one_line(arguments):
    with open("/dev/full", "w") as full:
        result = subprocess.run(
            [sys.executable, "-m", "SlicerUSSim.Command", *arguments], stdout=full, stderr=subprocess.PIPE, text=True
        )
    assert result.returncode == 2
    assert result.stderr == "ussim: standard output cannot be written (No space left on device)\n"
