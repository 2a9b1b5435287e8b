"""ussim sweep and ussim optimize: their output; errors give one line, exit status 2, and no incomplete files."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from click.testing import CliRunner

from benchmarks.twins import make_twin
from SlicerUSSim.Command.cli import main
from SlicerUSSim.Logic import (
    PhasedProbe,
    Preset,
    TissueTable,
    TrackedSequence,
    UltrasoundSimulator,
    Volume,
)
from SlicerUSSim.Logic.base.files import write_json
from SlicerUSSim.Logic.fitting import tracked_fit
from SlicerUSSim.Logic.fitting.registration import rigid_from
from SlicerUSSim.Logic.fitting.tracked_fit import fit
from SlicerUSSim.Logic.probe.poses import tilt_sweep
from SlicerUSSim.Logic.tracked import TrackedImages, read_pose, write_pose
from SlicerUSSim.Logic.tracked.sequence import SIMULATED
from tests.conftest import SHARED, example, needs_shared
from tests.test_label_maps import head_tissues
from tests.test_sequence import linear_transforms, slicer_sequence


def ussim(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A twin on disk, as examples/write_twin.py writes one."""
    place = tmp_path_factory.mktemp("twin")
    probe = PhasedProbe(70.0, 50.0, scan_lines=80)
    twin = make_twin(*head_tissues(3.0), 3, probe=probe)
    twin.simulator.medium.labels.write(place / "labels.nii.gz")
    twin.simulator.medium.tissues.write(place / "labels.json")
    twin.sequence().write(place / "tracked.igs.mha")
    write_json(place / "probe.json", probe.to_dict())
    return place


def optimize(folder, *options):
    return ussim(
        "optimize", folder / "labels.nii.gz", "--sequence", folder / "tracked.igs.mha", "--probe",
        folder / "probe.json", "-o", folder / "result.json", "--overwrite", *options,
    )  # fmt: skip


@pytest.mark.slow
def test_optimize_writes_result_report_and_preset(folder):
    pytest.importorskip("matplotlib", reason="reports need matplotlib: pip install '.[demo]'")
    done = optimize(
        folder, "--set", "fit.evaluations=30", "--set", "fit.restarts=1", "--report", folder / "report.html",
        "--save-preset", folder / "preset.json", "--free", "display",
        "--free", "white matter.mu0=0.1:0.9",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    result = json.loads((folder / "result.json").read_text())
    assert result["cost_after"] < result["cost_before"] and len(result["images"]) == 3
    names = [parameter["name"] for parameter in result["parameters"]]
    assert names[-1] == "white matter.mu0" and len(names) == 6
    assert result["parameters"][-1]["low"] == 0.1
    assert re.search(r"cost [\d.]+ -> [\d.]+", done.output) and "wrote" in done.output
    preset = Preset.read(folder / "preset.json")
    assert preset.display.gain_db == result["display"]["gain_db"]
    assert preset.tissues[3].sources["mu0"] == "fitted to tracked ultrasound"

    report = (folder / "report.html").read_text()
    assert report.count("data:image/png;base64,") >= 3 * 4 + 3
    assert not re.search(r"(src|href)=\"(?!data:)", report)  # nothing outside the file
    assert "<figcaption>real</figcaption>" not in report  # a twin is not real
    for words in ("simulated, before", "<figcaption>twin</figcaption>", "texture T1", "white matter.mu0", "net atten"):
        assert words in report


def test_a_probe_off_the_patient_is_reported(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_json(tmp_path / "off.json", rigid_from([300.0, 0.0, 0.0, 0.0, 0.0, 0.0]).tolist())
    done = ussim(
        "sweep", folder / "labels.nii.gz", "--sequence", folder / "tracked.igs.mha", "--probe", folder / "probe.json",
        "-o", "o.igs.mha", "--set", "settings.contact_gap_mm=3", "--to-mri", tmp_path / "off.json",
    )  # fmt: skip
    assert "in 3 of 3 images 0% of the probe's face touches the patient (contact gap: 3 mm)" in done.stderr


def test_a_sweep_simulates_poses_of_slicer_without_images(folder, tmp_path):
    tracked = TrackedSequence.read(folder / "tracked.igs.mha")
    nodes = linear_transforms([tracked.pose(n, "ProbeToReference") for n in range(3)])
    storage, node = slicer_sequence("LinearTransform", tmp_path / "poses.seq.mha", "ProbeToReference", nodes)
    assert storage.WriteData(node) == 1
    images = []
    for sequence, out in ((folder / "tracked.igs.mha", "a.igs.mha"), (tmp_path / "poses.seq.mha", "b.igs.mha")):
        options = ("--sequence", sequence, "--probe", folder / "probe.json", "-o", tmp_path / out)
        done = ussim("sweep", folder / "labels.nii.gz", *options)
        assert done.exit_code == 0, done.output
        images.append(TrackedSequence.read(tmp_path / out).images.astype(int))
    assert np.abs(images[0] - images[1]).mean() < 0.5  # Slicer writes poses with six digits
    done = ussim("optimize", folder / "labels.nii.gz", "--sequence", sequence, "-o", tmp_path / "o.json")
    assert done.exit_code == 2 and "has poses without images, expected images" in done.stderr


@pytest.mark.parametrize("name", ["o.igs.mha", pytest.param("o.nrrd", marks=pytest.mark.slow)])
def test_a_sweep_is_never_mistaken_for_a_recording(name, folder, tmp_path):
    sweep = ("sweep", folder / "labels.nii.gz", "--sequence", folder / "tracked.igs.mha", "-o", tmp_path / name)
    for more in ((), ("--overwrite",)):
        result = ussim(*sweep, "--frames", "0:2", *more)
        assert result.exit_code == 0, result.output
    found = TrackedSequence.read(tmp_path / name)
    assert found.fields[SIMULATED] == "sweep" and found.is_simulated


def test_sweep_draws_the_same_images_on_the_same_pixels(folder):
    done = ussim(
        "sweep", folder / "labels.nii.gz", "--sequence", folder / "tracked.igs.mha", "--probe", folder / "probe.json",
        "--frames", "2,0", "-o", folder / "simulated.seq.nrrd", "--set", f"recording.field={folder / 'field.png'}",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    assert (folder / "field.png").stat().st_size > 1000
    real, simulated = (TrackedSequence.read(folder / name) for name in ("tracked.igs.mha", "simulated.seq.nrrd"))
    assert simulated.images.shape == (2, *real.images.shape[1:])
    assert simulated.timestamps.tolist() == [pytest.approx(0.2), 0.0]
    assert np.allclose(simulated.pose(0, "ImageToReference"), real.pose(2, "ImageToReference"), atol=1e-5)
    # The anatomy is the same: where the real image is dark and bright, so is the simulated one.
    blocks = [
        s.images[n][:480, :480].reshape(24, 20, 24, 20).mean(axis=(1, 3)).ravel()
        for s, n in ((real, 2), (simulated, 0))
    ]
    assert np.corrcoef(blocks)[0, 1] > 0.9


def test_images_of_a_sweep_have_noise_by_their_number(folder, tmp_path):
    sequence = TrackedSequence.read(folder / "tracked.igs.mha")
    still = [0, 0, 0]  # the probe rests
    sequence.select(still).write(tmp_path / "still.igs.mha")
    Preset(PhasedProbe(70.0, 50.0, scan_lines=80)).changed("display", noise_db=-20.0).write(tmp_path / "noisy.json")
    for name, options in (("all", ()), ("last", ("--frames", "2"))):
        done = ussim(
            "sweep", folder / "labels.nii.gz", "--sequence", tmp_path / "still.igs.mha", "--preset",
            tmp_path / "noisy.json", "-o", tmp_path / f"{name}.igs.mha", *options,
        )  # fmt: skip
        assert done.exit_code == 0, done.output
    images, (last,) = (TrackedSequence.read(tmp_path / f"{name}.igs.mha").images for name in ("all", "last"))
    for number in (1, 2):
        assert (images[number] != images[0]).mean() > 0.2
    assert np.array_equal(last, images[2]) and not np.array_equal(images[1], images[2])


@pytest.mark.slow
def test_the_saved_transform_puts_the_images_where_the_fit_found_them(folder, tmp_path, monkeypatch):
    fits = []
    monkeypatch.setattr(tracked_fit, "_ROUNDS", ((8.0, 24), (4.0, 16)))  # how well: test_registration
    monkeypatch.setattr(tracked_fit, "fit", lambda *a, **b: fits.append(fit(*a, **b)) or fits[-1])
    given_map = rigid_from([1.5, -1.0, 2.0, 2.0, -1.0, 1.5])
    write_pose(tmp_path / "given.json", given_map)
    done = optimize(
        folder, "--register", "--set", "fit.evaluations=12", "--set", "fit.restarts=0", "--free", "display", "--set",
        f"results.save_transform={tmp_path / 'saved.json'}", "--to-mri", tmp_path / "given.json",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    assert re.search(r"moved by [\d.]+ mm and [\d.]+ degrees", done.output)
    registration = json.loads((folder / "result.json").read_text())["registration"]
    assert registration["cost_after"] <= registration["cost_before"]

    def poses(reference_to_ras):
        """As `ussim optimize --to-mri` places the images."""
        sequence = TrackedSequence.read(folder / "tracked.igs.mha")
        return TrackedImages.of(sequence, reference_to_ras=reference_to_ras, probe=PhasedProbe(70.0, 50.0)).poses

    fitted, correction = fits[0].tracked.poses, np.array(registration["correction"])
    assert not np.allclose(correction, np.eye(4), atol=1e-3)
    assert np.allclose([correction @ pose for pose in poses(given_map)], fitted, atol=1e-6)
    assert np.allclose(poses(read_pose(tmp_path / "saved.json")), fitted, atol=1e-6)


@pytest.mark.slow
def test_a_volume_with_landmarks_is_cut_where_the_probe_looked(folder, tmp_path):
    """Data as in RESECT: ultrasound as NIfTI in its own frame, landmarks in MRI and ultrasound as .tag."""
    sequence = TrackedSequence.read(folder / "tracked.igs.mha")
    probe = PhasedProbe(70.0, 50.0, scan_lines=80)
    labels, tissues = Volume.read(folder / "labels.nii.gz"), TissueTable.read(folder / "labels.json")
    pose = sequence.pose(1, "ProbeToReference")
    ultrasound = UltrasoundSimulator(labels, tissues).volume(probe, tilt_sweep(pose, 20.0, 15), spacing_mm=0.5)
    shift = np.array([30.0, -12.0, 7.0])
    place = np.eye(4)
    place[:3, 3] = shift
    Volume(ultrasound.array, place @ ultrasound.ijk_to_ras).write(tmp_path / "us.nii.gz")
    write_pose(tmp_path / "probe-pose.json", place @ pose)
    points = [[0, 0, 0], [30, 5, 2], [-4, 25, 9], [3, -8, 31]]
    rows = "\n".join(" ".join(map(str, [*p, *(np.array(p) + shift)])) + ' "x"' for p in points)
    (tmp_path / "case.tag").write_text(f"MNI Tag Point File\nVolumes = 2;\n\nPoints =\n{rows};\n")
    common = (
        folder / "labels.nii.gz", "--sequence", tmp_path / "us.nii.gz", "--set",
        f"recording.cut={tmp_path / 'probe-pose.json'}",
        "--probe", folder / "probe.json", "--to-mri", tmp_path / "case.tag",
    )  # fmt: skip
    costs = []
    for where in (common, common[:-2]):  # with the landmarks, and without them somewhere else in the brain
        done = ussim(
            "optimize", *where, "--set", "recording.cut_tilt=12", "--set", "recording.cuts=2", "--free", "display",
            "--set", "fit.evaluations=60", "--set", "fit.restarts=0", "-o", tmp_path / "result.json", "--overwrite",
        )  # fmt: skip
        assert done.exit_code == 0, done.output
        assert ("4 landmarks agree to 0.00 mm" in done.output) == (where is common)
        result = json.loads((tmp_path / "result.json").read_text())
        costs.append(result["cost_after"])
    assert len(result["images"]) == 2 and costs[0] < 0.85 * costs[1]
    done = ussim("sweep", *common, "-o", tmp_path / "cut.igs.mha")
    assert done.exit_code == 0 and len(TrackedSequence.read(tmp_path / "cut.igs.mha")) == 1


@pytest.mark.parametrize(
    "options, message",
    [
        (
            ["--frames", "0,1", "--set", "fit.validate=1:"],
            "images 1 are fitted and predicted, expected others to predict",
        ),
        (["--set", "fit.validate=9"], "image 9 does not exist, expected 0 to 2"),
        (["--frames", "one"], "frames are 'one', expected numbers such as 0,5,10, 3-5 or 0:20:5"),
        (["--free", "gain_db=5:1"], "bounds of gain_db are 5.0 to 1.0, expected two numbers, the smaller one first"),
        (["--free", "liver.mu0"], "no free parameter 'liver.mu0'"),
        (["--set", "results.save_transform=there.json"], "results.save_transform needs --register"),
        (["--register", "--set", "results.save_transform=there.tfm"], "there.tfm, expected a name ending in .json"),
        (["--report", "result.json"], "given for 2 outputs, expected a separate file for each"),
        (["--report", "probe.json"], "probe.json is an input, which it would replace"),
    ],
)
def test_mistakes_are_one_line_and_write_nothing(folder, options, message, monkeypatch):
    monkeypatch.chdir(folder)
    (folder / "result.json").unlink(missing_ok=True)
    before = sorted(path.name for path in folder.iterdir())
    done = optimize(folder, "--set", "fit.evaluations=5", *options)
    assert done.exit_code == 2
    lines = [line for line in done.output.splitlines() if line.startswith("ussim:")]
    assert len(lines) == 1 and message in lines[0]
    assert sorted(path.name for path in folder.iterdir()) == before


@pytest.mark.long
def test_the_example_writes_a_twin_that_optimize_reads(mni, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["write_twin.py", str(tmp_path), "--seed", "4"])
    example("write_twin").main()
    assert "tracked.igs.mha" in capsys.readouterr().err
    done = ussim(
        "optimize", tmp_path / "labels.nii.gz", "--sequence", tmp_path / "tracked.igs.mha", "--probe",
        tmp_path / "probe.json", "--frames", "1", "--free", "display", "--set", "fit.evaluations=42",
        "--set", "fit.restarts=0", "-o", tmp_path / "result.json",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    truth, result = (json.loads((tmp_path / f"{name}.json").read_text()) for name in ("truth", "result"))
    assert result["cost_after"] < result["cost_before"]
    assert abs(result["display"]["dynamic_range_db"] - truth["display"]["dynamic_range_db"]) < 15


@pytest.mark.long
@needs_shared
def test_real_speckle_and_noise_can_be_fitted(tmp_path, monkeypatch, capsys):
    pytest.importorskip("matplotlib", reason="the example draws: pip install '.[demo]'")
    monkeypatch.setattr("sys.argv", ["fit_real_speckle.py", str(SHARED), "--out", str(tmp_path)])
    example("fit_real_speckle").main()
    costs = re.findall(r"cost ([\d.]+) -> ([\d.]+)", capsys.readouterr().out)
    assert len(costs) == 2 and all(float(after) < 0.55 * float(before) for before, after in costs)
    assert {path.name for path in tmp_path.iterdir()} == {"real-speckle.png", "real-noise.png"}
