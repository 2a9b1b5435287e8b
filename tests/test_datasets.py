"""Data sets: recipes say what is wrong where, image i depends on (seed, i) alone, sets are whole, read and exported."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from SlicerUSSim.Command.cli import main
from SlicerUSSim.Logic import DisplaySettings, SimulationError, TrackedSequence
from SlicerUSSim.Logic.base.errors import Cancelled
from SlicerUSSim.Logic.datasets import (
    READY,
    Recipe,
    SimulatedImages,
    export_coco,
    export_nnunet,
    make_dataset,
    making as making_module,
)
from SlicerUSSim.Logic.datasets.draws import Draw, generator
from SlicerUSSim.Logic.datasets.patients import Scene
from SlicerUSSim.Logic.datasets.recipe import CLASSES
from SlicerUSSim.Logic.datasets.rendering import render
from SlicerUSSim.Logic.datasets.writers import checksums, record_path
from SlicerUSSim.Logic.imaging.preset import preset_parameters
from SlicerUSSim.Logic.mri.samples import head_mri
from SlicerUSSim.Logic.probe import pose_looking_at
from SlicerUSSim.Logic.probe.surface import PatientSurface
from SlicerUSSim.Logic.tissue.presets import TISSUES
from tests.conftest import block, example, name_labels

zarr = pytest.importorskip("zarr", reason="data sets need: pip install '.[datasets]'")
pytest.importorskip("h5py", reason="data sets need: pip install '.[datasets]'")

START = """
images = 12
seed = 5
shard = 4
outputs = [{outputs}]
format = "{format}"
[[patients]]
file = "{file}"
[display]
image_size = [48, 64]
gain_db = {{normal = [3, 2], unit = "dB"}}
[settings]
quality = "draft"
"""
VARIED = """
[pose]
on = "surface"
rotate_deg = {uniform = [-180, 180]}
rock_deg = {normal = [0, 8]}
[probe]
frequency_mhz = {uniform = [3, 6]}
[tissues.all]
mu0 = {log_uniform = [0.7, 1.4], relative = true}
[tissues."white matter"]
attenuation_db_cm_mhz = {uniform = [0.3, 0.7]}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A ball of a brain with ventricles as a label map, and files that are none."""
    folder = tmp_path_factory.mktemp("patients")

    def labels(x, y, z):
        radius = np.sqrt(x**2 + (y / 1.1) ** 2 + z**2)
        inner = np.where((np.abs(x) - 9) ** 2 + (y / 3) ** 2 + z**2 < 25, 1, 3)
        return np.select([radius > 48, radius > 40], [0, 2], inner)

    for name, shift in (("brain", 0.0), ("second", 1.3)):
        block(lambda x, y, z, d=shift: labels(x + d, y + d, z), (54, 58, 54), 2.0).write(folder / f"{name}.nii.gz")
        name_labels(folder / f"{name}.nii.gz", ["csf", "grey matter", "white matter"])
    (folder / "broken.nii.gz").write_bytes(b"this is not an image")
    return folder


def recipe(folder: Path, more: str = VARIED, *, outputs="image labels", format_="zarr", file="brain.nii.gz") -> Recipe:
    names = ", ".join(f'"{name}"' for name in outputs.split())
    return Recipe.of_text(START.format(outputs=names, format=format_, file=file) + more, "r.toml", folder)


# ---- recipes ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("images = 0", "line 1: images is 0, expected a whole number between 1 and"),
        ("images = 5\nimage = 3", "line 2: 'image' is unknown, expected one of images, seed"),
        ("images = 5", r"patients is \[\], expected \[\[patients\]\] with file"),
        ("images = ", r"is not TOML \(Invalid value"),
        (
            "images = 5\noutputs = ['image', 'colour']",
            "line 2: outputs are .*'colour'.*, expected some of image",
        ),
        (
            "P\n[display]\ngain_db = {uniform = [-600, 6]}",
            "line 5: gain_db is -600, expected a number between -200 and",
        ),
        (
            "P\n[display]\n\ngain_db = {uniform = [6, -6]}",
            "line 6: uniform is .6.0, -6.0., expected .low, high.",
        ),
        (
            "P\n[display]\ngain_db = {uniform = [0, 6], unit = 'mm'}",
            "line 5: gain_db is in 'mm', expected its unit, 'dB'",
        ),
        ("P\n[display]\ngain_db = {about = 3}", "line 5: gain_db is .*expected a number .*or {uniform = .low"),
        ("P\n[display]\ngain_db = {log_uniform = [0, 3]}", "line 5: log_uniform is .*expected .low, high. above 0"),
        ("P\n[display]\nlook = {uniform = ['even', 'even']}", "look is .*, expected one of scanner, even, or {choice"),
        ("P\n[display]\nimage_size = {choice = [[8, 8], [9, 9]]}", "line 5: image_size is .*one value for all images"),
        ("P\n[pose]\nrock_deg = {normal = [0, -1]}", "line 5: the deviation is -1, expected a number between 0"),
        ("P\n[pose]\non = 'path'", "line 5: on is path, which needs a file"),
        ("P\n[pose]\nwithin_deg = {uniform = [0, 90]}", "line 5: within_deg is"),
        ("P\n[probe]\nname = 'convexx'", "line 5: name is 'convexx', expected one of phased, convex"),
        ("P\n[probe]\nbeams = 3", "line 5: 'beams' is unknown, expected one of"),
        ("P\n[tissues.'gray matter']\nmu0 = 1", "line 4: 'gray matter' is unknown, expected one of all, coupling, csf"),
        (
            "P\n[tissues.all]\nmu0 = {uniform = [0, 200], relative = true}",
            "line 5: mu0 is 200, expected a number between 0 and 100",
        ),
        ("P\n[display]\ngain_db = {uniform = [0, 1], relative = true}", "line 5: gain_db is .*expected a number"),
        ("P\nlicence = 3", "line 4: licence is 3, expected text"),
        ("P\n[patients.segmentation]\nclasses = 9", "line 5: classes is 9, expected a whole number between 3 and 4"),
        ("P\n[[patients]]\nfiles = 'b'", "line 5: 'files' is unknown, expected one of file"),
        ("P\n[lesions]\neach = 9", "5 images are 5 shards for 9 patients with their lesions, expected one for each"),
        (
            "images = 5\noutputs = ['rf']\n[[patients]]\nfile = 'a'\n[probe]\ndepth_mm = {uniform = [60, 90]}",
            "line 5: rf would have .196, 1569. to .196, 2243. scan lines and samples, expected one shape",
        ),
        ("P\n[pose]\nrock_deg = 200", "line 5: rock_deg is 200, expected a number between -180 and 180"),
        (
            "images = 5\nformat = 'png'\noutputs = ['image', 'rf']",
            "line 2: format png holds image, .* have rf, expected",
        ),
    ],
)
def test_a_recipe_names_the_line_and_the_key_of_what_is_wrong(text, says):
    text = text.replace("P\n", "images = 5\n[[patients]]\nfile = 'a'\n")
    with pytest.raises(SimulationError, match=rf"^r\.toml: .*({says})") as error:
        Recipe.of_text(text, "r.toml")
    assert "\n" not in str(error.value)


def test_draws_stay_within_bounds_and_have_their_distribution():
    entry = preset_parameters()["display.gain_db"]
    drawn = {
        kind: np.array([Draw.of({kind: values}, entry, "r")(generator(1, n, "")) for n in range(2000)])
        for kind, values in {"uniform": [-3, 5], "normal": [190, 20], "choice": [1, 4], "log_uniform": [1, 100]}.items()
    }
    assert drawn["uniform"].min() >= -3 and drawn["uniform"].max() <= 5
    assert drawn["uniform"].mean() == pytest.approx(1.0, abs=0.2)
    assert drawn["normal"].max() == 200.0 and np.median(drawn["normal"]) == pytest.approx(190, abs=2)
    assert set(drawn["choice"]) == {1.0, 4.0} and np.median(drawn["log_uniform"]) == pytest.approx(10, rel=0.15)
    lines = Draw.of({"uniform": [10, 12]}, preset_parameters()["probe.scan_lines"], "r")
    assert {lines(generator(1, n, "")) for n in range(50)} == {10, 11, 12}


def test_a_draw_depends_on_seed_image_and_key_alone(folder):
    plain, more = recipe(folder), recipe(folder, f"{VARIED}texture_db = 3.0\n")
    other = recipe(folder, VARIED.replace("rock_deg = {normal = [0, 8]}", "tilt_deg = {normal = [0, 8]}"))
    assert plain.drawn(7) == more.drawn(7) != plain.drawn(8)
    mine, its = plain.drawn(7), other.drawn(7)
    assert mine["pose"].pop("rock_deg") != its["pose"].pop("rock_deg") == 0.0
    assert its["pose"].pop("tilt_deg") != mine["pose"].pop("tilt_deg") == 0.0 and mine == its


def test_ready_recipes_are_read_and_name_their_purpose():
    assert set(READY) == {"brain-tumour", "denoising", "mri-registration", "standard-views", "ventricles"}
    for name in READY:
        made = Recipe.read(name)
        assert made.settings.title and made.settings.images >= 500 and len(made.draws["display"]) > 2
    with pytest.raises(SimulationError, match=r"none.toml: does not exist, .*or one of brain-tumour, denoising"):
        Recipe.read("none.toml")


# ---- images ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def plain(folder, tmp_path_factory):
    """A set of 12 images by this process."""
    out = tmp_path_factory.mktemp("set") / "plain"
    made = make_dataset(recipe(folder), out, workers=1)
    assert (made.done, made.skipped) == (12, {}) and made.peak_mb > 50
    return out


def checksum(out: Path) -> str:
    return json.loads((out / "manifest.json").read_text())["checksum"]


def test_images_of_a_set_are_those_that_its_parameters_say(plain, folder):
    images = SimulatedImages(plain)
    assert len(images) == 12 and images.labels == {0: "coupling", 1: "csf", 2: "grey matter", 3: "white matter"}
    first, last = images[0], images[-1]
    assert first["image"].shape == first["labels"].shape == (48, 64) and last["number"] == 11
    assert (first["image"] > 0).mean() > 0.2 and set(np.unique(last["labels"])) <= {0, 1, 2, 3}
    made, values = Scene(recipe(folder), plain, recipe(folder).case_of(0)), images.parameters()[7]
    assert values["image"] == 7 and 3 <= values["probe"]["frequency_mhz"] <= 6
    drawn = recipe(folder).drawn(7)
    tissues, changed = made.tissues(7)
    assert changed == values["tissues"] and tissues.tissue("grey matter").mu0 == changed["grey matter"]["mu0"]
    assert 0.7 <= changed["grey matter"]["mu0"] / TISSUES["grey matter"].mu0 <= 1.4
    assert 0.3 <= changed["white matter"]["attenuation_db_cm_mhz"] <= 0.7
    np.testing.assert_allclose(images[7]["pose"], made.pose(7, drawn["pose"]))
    display = DisplaySettings(gain_db=drawn["display"]["gain_db"], image_size=(48, 64))
    with made.simulator.with_tissues(tissues):
        made.simulator.settings = replace(made.settings, **drawn["settings"])
        probe = recipe(folder).probes[values["probe"]["number"]]
        frame = made.simulator.simulate(probe, images[7]["pose"], display, noise_seed=7)
    np.testing.assert_array_equal(images[7]["image"], frame.image)
    np.testing.assert_array_equal(images[7]["labels"], frame.labels())
    np.testing.assert_allclose(images[7]["image_to_probe"], frame.image_to_probe)


def test_every_output_is_of_the_images_pixels_or_lines(folder, tmp_path):
    names = "image labels depth iq rf envelope bmode clean attenuation travel_time walls"
    more = '[pose]\non = "surface"\n'
    made = recipe(folder, more, outputs=names, format_="hdf5")
    making_module.prepare(made, 0, tmp_path)
    with pytest.raises(SimulationError, match=r"rf has 2 samples per cycle, .* quality full"):
        render(made, tmp_path, 1)
    text = START.replace("draft", "full").format(
        outputs=", ".join(f'"{name}"' for name in names.split()), format="hdf5", file="brain.nii.gz"
    )
    made = Recipe.of_text(text + more, "r.toml", folder)
    arrays, _ = render(made, tmp_path, 1)
    assert set(arrays) == {*names.split(), "pose", "image_to_probe"}
    inside = np.isfinite(arrays["depth"])
    for name in ("attenuation", "travel_time"):
        np.testing.assert_array_equal(np.isfinite(arrays[name]), inside)
    per_mm = arrays["travel_time"][inside].max() / arrays["depth"][inside].max()
    assert per_mm == pytest.approx(2e3 / 1540, rel=0.03)
    deepest = np.nanmax(arrays["attenuation"][0])
    depth_cm, mhz = np.nanmax(arrays["depth"]) / 10, made.probes[0].frequency_mhz
    assert 0.1 * depth_cm * mhz < deepest < 0.8 * depth_cm * mhz
    borders = np.diff(arrays["labels"].astype(int), axis=1)[:, :, :-1] != 0
    assert arrays["walls"].max() == pytest.approx(0.03, abs=0.02) and (arrays["walls"][:, :-1, :-1] > 0)[borders].any()
    assert np.mean(arrays["rf"] ** 2) == pytest.approx(0.5 * np.mean(np.abs(arrays["iq"]) ** 2), rel=0.2)
    roughness = [np.abs(np.diff(arrays[name].astype(float), axis=2)).mean() for name in ("image", "clean")]
    assert roughness[1] < 0.7 * roughness[0] and arrays["clean"].mean() == pytest.approx(
        arrays["image"].mean(), rel=0.1
    )


def test_signals_can_be_converted_to_the_image_by_what_the_manifest_says(folder, tmp_path):
    more = '[pose]\non = "surface"\n[probe]\nname = "convex"\n'
    text = recipe(folder, more, outputs="image bmode").text.replace("[settings]", 'look = "even"\n[settings]')
    text = text.replace("[48, 64]", "[256, 320]").replace("images = 12", "images = 1").replace("shard = 4", "")
    made = make_dataset(Recipe.of_text(text, folder=folder), tmp_path / "s", workers=1)
    images = SimulatedImages(made.folder)
    item, (probe,) = images[0], images.manifest["probes"]
    rows, columns = np.mgrid[:256:4, :320:4]
    image = item["image"][::4, ::4]
    places = np.stack([columns, rows, 0 * rows, 1 + 0 * rows], axis=-1) @ item["image_to_probe"].T
    origins, directions = np.array(probe["origins_mm"]), np.array(probe["directions"])
    offset = places[..., None, :3] - origins
    along = (offset * directions).sum(axis=-1)
    line = np.linalg.norm(offset - along[..., None] * directions, axis=-1).argmin(axis=-1)
    sample = np.rint(np.take_along_axis(along, line[..., None], -1)[..., 0] / probe["sample_mm"]).astype(int)
    inside = (image > 0) & (sample >= 0) & (sample < item["bmode"].shape[1])
    found = item["bmode"][line[inside], sample[inside]].astype(float)
    assert inside.mean() > 0.3 and np.corrcoef(found, image[inside])[0, 1] > 0.9
    cycle_mm = probe["sample_mm"] * probe["samples_per_cycle"]
    assert probe["sampling_mhz"] == pytest.approx(0.77 * probe["samples_per_cycle"] / cycle_mm)


@pytest.mark.parametrize("on", ["craniotomy", "view", "path", "sequence", "lesion"])
def test_poses_stand_where_the_recipe_says(folder, tmp_path, on):
    more = f'[pose]\non = "{on}"\n'
    if on == "path":
        points = [{"position": [x, 0.0, 50.0]} for x in (-30, 0, 30)]
        markup = {"type": "Curve", "coordinateSystem": "RAS", "controlPoints": points}
        (folder / "curve.mrk.json").write_text(json.dumps({"markups": [markup]}))
        more += 'file = "curve.mrk.json"\n'
    if on == "sequence":
        poses = [pose_looking_at((x, 0, 50), (x, 0, 0)) for x in (0.0, 5.0)]
        transforms = tuple({"ProbeToReference": pose} for pose in poses)
        TrackedSequence(np.zeros((2, 8, 8), np.uint8), transforms, np.array([0.0, 1.0])).write(folder / "s.igs.mha")
        more += 'file = "s.igs.mha"\n'
    if on == "lesion":
        more = '[pose]\naim = "tumour"\nright_deg = 20\n[lesions]\neach = 2\ndepth_mm = 20\nradius_mm = 7\n'
    made = recipe(folder, more, outputs="image")
    making_module.prepare(made, 0, tmp_path)
    scene = Scene(made, tmp_path, made.case_of(0))
    poses = [scene.pose(n, made.drawn(n)["pose"]) for n in range(3)]
    faces = np.array([pose[:3, 3] for pose in poses])
    surface = PatientSurface(scene.simulator.medium.labels)
    away = [np.linalg.norm(face - surface.nearest(face)) for face in faces]
    if on == "sequence":
        np.testing.assert_allclose(faces[[0, 1, 2], 0], [0.0, 5.0, 0.0])
    else:
        assert max(away) < 3.0
    if on == "path":
        assert np.diff(faces[:, 0]) == pytest.approx([1.0, 1.0], abs=0.3) or np.diff(faces[:, 0]).max() < 0
    if on == "lesion":
        labels = scene.simulator.medium.labels
        tumour = np.argwhere(labels.array == scene.names.index("tumour") + 1)[:, ::-1].mean(axis=0)
        across, depth, _ = (np.linalg.inv(poses[0]) @ labels.ijk_to_ras @ [*tumour, 1.0])[:3]
        assert abs(across) < 3.0 and 12.0 < depth < 45.0
        other = Scene(made, tmp_path, made.case_of(2))
        assert (other.simulator.medium.labels.array != labels.array).any()


@pytest.mark.slow
def test_ventricles_are_a_label_of_their_own(tmp_path):
    head_mri(3.0).write(tmp_path / "head.nii.gz")
    text = 'images = 2\n[[patients]]\nfile = "head.nii.gz"\nventricles = true\n[display]\nimage_size = [48, 64]\n'
    made = make_dataset(Recipe.of_text(text, folder=tmp_path), tmp_path / "set", workers=1)
    labels = SimulatedImages(made.folder)[0]["labels"]
    assert "ventricle" in made.folder.joinpath("README.md").read_text()
    assert (labels == CLASSES.index("ventricle")).any()


# ---- files -----------------------------------------------------------------------------------------------------------


def test_all_formats_hold_the_same_images(plain, folder, tmp_path):
    for format_ in ("hdf5", "png", "tracked"):
        make_dataset(recipe(folder, format_=format_), tmp_path / format_, workers=1)
        assert checksum(plain) == checksum(tmp_path / format_)
    before, hdf5 = SimulatedImages(plain), SimulatedImages(tmp_path / "hdf5")
    for shard, about in before.manifest["shards"].items():
        items = [before[number] for number in range(*about["images"])]
        arrays = {name: np.stack([item[name] for item in items]) for name in about["checksums"]}
        assert checksums(arrays) == about["checksums"], shard
    for number in (0, 5, 11):
        wanted = before[number]
        for name, values in hdf5[number].items():
            np.testing.assert_array_equal(values, wanted[name])
        for name in ("image", "labels"):
            picture = Image.open(tmp_path / "png" / name / f"{number:08d}.png")
            sequence = TrackedSequence.read(tmp_path / "tracked" / f"{name}-{number // 4:06d}.igs.mha")
            np.testing.assert_array_equal(np.asarray(picture), wanted[name])
            np.testing.assert_array_equal(sequence.images[number % 4], wanted[name])
            pose = sequence.pose(number % 4, "ImageToReference")
            np.testing.assert_allclose(pose, wanted["pose"] @ wanted["image_to_probe"], atol=1e-4)
        values = json.loads((tmp_path / "png" / "parameters" / f"{number:08d}.json").read_text())
        assert values["image"] == number and np.allclose(values["pose"], wanted["pose"])
    with pytest.raises(SimulationError, match="has the format png, expected zarr or hdf5"):
        SimulatedImages(tmp_path / "png")[0]


def test_a_zarr_set_has_a_file_per_shard_and_any_reader_opens_it(plain):
    group = zarr.open_group(plain / "images.zarr", mode="r")
    assert group.metadata.zarr_format == 3 and group["image"].shape == (12, 48, 64)
    assert len([path for path in (plain / "images.zarr" / "image" / "c").rglob("*") if path.is_file()]) == 3
    assert (group["image"].chunks, group["image"].shards) == ((1, 48, 64), (4, 48, 64))


def test_only_missing_shards_are_made_and_no_other_set_is_touched(plain, folder, tmp_path):
    out, calls = tmp_path / "set", []

    def counted(*arguments):
        calls.append(arguments[-1])
        return making_module.render_task(*arguments)

    make_dataset(recipe(folder), out, workers=1)
    record_path(out, 1).unlink()
    made = make_dataset(recipe(folder), out, workers=1, task=counted)
    assert calls == [1] and (made.found, made.done) == (8, 12) and checksum(out) == checksum(plain)
    with pytest.raises(SimulationError, match="has the set of another recipe"):
        make_dataset(recipe(folder, ""), out, workers=1)
    with pytest.raises(SimulationError, match="has other files, expected a new or empty folder"):
        make_dataset(recipe(folder), folder, workers=1)


def test_a_patient_that_cannot_be_read_is_left_out_and_listed(folder, tmp_path):
    text = START.format(outputs='"image"', format="zarr", file="brain.nii.gz")
    text += '[[patients]]\nfile = "broken.nii.gz"\n[[patients]]\nfile = "second.nii.gz"\n'
    (folder / "three.toml").write_text(text)
    result = CliRunner().invoke(
        main, ["dataset", str(folder / "three.toml"), "-o", str(tmp_path / "s"), "--workers", "1"]
    )
    assert result.exit_code == 1 and "left out: " in result.stderr and "broken.nii.gz" in result.stderr
    images = SimulatedImages(tmp_path / "s")
    assert len(images) == 8 and "broken.nii.gz" in (tmp_path / "s" / "README.md").read_text()
    assert [images[n]["number"] for n in (3, 4)] == [3, 8]
    assert images.manifest["shards"]["2"]["patient"] == "second.nii.gz"
    with pytest.raises(SimulationError, match="has no output 'labels', expected some of image"):
        SimulatedImages(tmp_path / "s", ["labels"])


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ('[pose]\naim = "tumour"\n', r"aim is 'tumour', which is not labelled, expected one of csf, grey matter"),
        (
            "[lesions]\neach = 1\ndepth_mm = 80\n",
            r"depth_mm is 80, and the brain has no tissue so deep, expected at most",
        ),
        (
            '[pose]\non = "surface"\nwithin_deg = 0.001\n',
            r"within_deg is 0.001, and the surface has no point so near to its top",
        ),
    ],
)
def test_what_a_patient_has_not_is_said_and_no_image_is_made(folder, tmp_path, more, says):
    made = make_dataset(recipe(folder, more, file="second.nii.gz"), tmp_path / "s", workers=1)
    assert made.done == 0 and re.search(says, made.skipped["second.nii.gz"])


def test_warnings_about_a_patient_are_in_the_manifest_with_its_name(folder, tmp_path):
    block(lambda x, y, z: (np.hypot(x - 45, y) + abs(z) < 12).astype(np.uint8), (54, 58, 54), 2.0).write(
        folder / "mask.nii.gz"
    )
    lines: list[str] = []
    text = recipe(folder, "").text.replace(
        'file = "brain.nii.gz"', 'file = "brain.nii.gz"\nadd = {tumour = "mask.nii.gz"}'
    )
    made = make_dataset(Recipe.of_text(text, folder=folder), tmp_path / "s", workers=1, say=lines.append)
    (warning,) = SimulatedImages(made.folder).manifest["warnings"]
    assert warning.startswith("brain.nii.gz: ") and "mask.nii.gz" in warning
    assert lines == ["brain.nii.gz: preparing it ..."]


def test_a_full_disk_ends_the_run_in_one_line(folder, tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("SlicerUSSim.Logic.datasets.writers._zarr", full)
    (folder / "one.toml").write_text(recipe(folder).text)
    result = CliRunner().invoke(
        main, ["dataset", str(folder / "one.toml"), "-o", str(tmp_path / "s"), "--workers", "1"]
    )
    assert result.exit_code == 2 and "shard 0 cannot be written (No space left on device)" in result.stderr
    assert not record_path(tmp_path / "s", 0).exists()


def test_exports_are_what_coco_and_nnunet_read(plain):
    coco = json.loads(export_coco(plain).read_text())
    images = SimulatedImages(plain)
    entry = max(coco["annotations"], key=lambda one: one["area"])
    size, counts = entry["segmentation"]["size"], entry["segmentation"]["counts"]
    mask = np.repeat(np.arange(len(counts)) % 2, counts).reshape(size[::-1]).T
    labels = images[entry["image_id"]]["labels"]
    assert mask.sum() == entry["area"] and (labels[mask == 1] == entry["category_id"]).all()
    left, top, width, height = entry["bbox"]
    rows, columns = np.nonzero(mask)
    assert (columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1) == (left, top, width, height)
    assert [one["name"] for one in coco["categories"]] == ["csf", "grey matter", "white matter"]
    folder = export_nnunet(plain)
    about = json.loads((folder / "dataset.json").read_text())
    assert about["labels"] == {"background": 0, "csf": 1, "grey matter": 2, "white matter": 3}
    assert len(list((folder / "imagesTr").glob("*_0000.png"))) == about["numTraining"] == 12
    assert {path.stem for path in (folder / "labelsTr").iterdir()} == {
        path.stem.removesuffix("_0000") for path in (folder / "imagesTr").iterdir()
    }


def test_without_a_package_or_python_3_11_one_line_says_what_to_do(folder, tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == "zarr" else name)
    with pytest.raises(
        SimulationError, match=r"format zarr needs SlicerUSSim\[datasets\]; install it with: pip install"
    ):
        make_dataset(recipe(folder), tmp_path / "s", workers=1)
    monkeypatch.setattr(making_module, "sys", SimpleNamespace(version_info=(3, 10, 13)))
    with pytest.raises(SimulationError, match=r'zarr needs Python 3\.11; write format = "hdf5"'):
        make_dataset(recipe(folder), tmp_path / "s", workers=1)


def test_pytorch_and_monai_read_a_set(plain):
    torch = pytest.importorskip("torch", reason="needs PyTorch")
    loader = torch.utils.data.DataLoader(SimulatedImages(plain, ["image", "labels"]), batch_size=4)
    assert next(iter(loader))["image"].shape == (4, 48, 64)
    pytest.importorskip("monai", reason="needs MONAI")
    assert 0.0 < example("train_unet").train(plain, "white matter", epochs=2) <= 1.0


@pytest.mark.slow
def test_a_forest_finds_ventricles_of_another_head_better_than_a_threshold(tmp_path):
    pytest.importorskip("sklearn", reason="needs scikit-learn")
    found = example("find_ventricles")
    train, test = found.made(tmp_path / "a", "mni152", 100, 1), found.made(tmp_path / "b", "synthetic", 12, 2)
    forest, threshold = found.find_ventricles(train, test)
    assert forest > max(threshold, 0.2)


# ---- Dask ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def distributed():
    return pytest.importorskip("distributed", reason="data sets need: pip install '.[datasets]'")


@pytest.mark.slow
def test_two_workers_make_the_bits_of_one_process(plain, folder, tmp_path, distributed):
    told = []
    made = make_dataset(recipe(folder), tmp_path / "s", workers=2, progress=lambda done: told.append(done.in_words()))
    assert made.done == 12 and checksum(tmp_path / "s") == checksum(plain)
    assert "12 of 12 images" in told[-1] and "images/s" in told[-1] and 50 < made.peak_mb < 600


def killing_task(out: str, files: str, shard: int) -> float:
    """The worker that gets shard 7 first is killed in it."""
    marker = Path(out) / "patients" / "killed"
    if shard == 7 and not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return making_module.render_task(out, files, shard)


@pytest.mark.slow
def test_two_thousand_images_survive_a_killed_worker(folder, tmp_path, distributed):
    changes = {"images = 12": "images = 2000", "shard = 4": "", "[probe]": "[probe]\ndepth_mm = 30", "[3, 6]": "[2, 4]"}
    text = recipe(folder).text
    for old, new in changes.items():
        text = text.replace(old, new)
    many = Recipe.of_text(text, folder=folder)  # of small images, which take 10 ms
    for name, workers, task in (("one", 1, making_module.render_task), ("two", 2, killing_task)):
        assert make_dataset(many, tmp_path / name, workers=workers, task=task).done == 2000
    assert (tmp_path / "two" / "patients" / "killed").exists() and checksum(tmp_path / "one") == checksum(
        tmp_path / "two"
    )


def slow_task(out: str, files: str, shard: int) -> float:
    time.sleep(1.0)
    return making_module.render_task(out, files, shard)


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_a_scheduler_that_is_gone_is_reported_within_ten_seconds(plain, folder, tmp_path, distributed, how):
    file, tools = tmp_path / "scheduler.json", [sys.executable, "-m", "distributed.cli."]
    start = [*tools[:2], f"{tools[2]}dask_scheduler", "--scheduler-file", str(file), "--port", "0", "--no-dashboard"]
    scheduler = subprocess.Popen(start, stderr=subprocess.DEVNULL)
    options = ["--scheduler-file", str(file), "--no-dashboard", "--death-timeout", "30", "--nthreads", "1"]
    worker = subprocess.Popen([*tools[:2], f"{tools[2]}dask_worker", *options], stderr=subprocess.DEVNULL)
    gone: list[float] = []

    def end(_) -> None:
        if not gone:
            gone.append(time.perf_counter())
            scheduler.send_signal(how)

    try:
        while not file.exists():
            time.sleep(0.1)
        with pytest.raises(SimulationError, match=r"the scheduler is gone .*the same command resumes"):
            make_dataset(recipe(folder), tmp_path / "s", scheduler=str(file), progress=end, task=slow_task)
        assert time.perf_counter() - gone[0] < 10.0
    finally:
        for process in (scheduler, worker):
            process.kill()
            process.wait()
    assert make_dataset(recipe(folder), tmp_path / "s", workers=1).found >= 4
    assert checksum(tmp_path / "s") == checksum(plain)


def test_workers_that_are_awaited_are_one_line(folder, tmp_path, distributed):
    lines = []

    def say(line: str) -> None:
        lines.append(line)
        if "waiting" in line:
            raise Cancelled

    with distributed.LocalCluster(n_workers=0, dashboard_address=None) as cluster, pytest.raises(Cancelled):
        make_dataset(recipe(folder), tmp_path / "s", scheduler=cluster.scheduler_address, say=say)
    assert re.fullmatch(r"tcp://.*: waiting for workers ...", lines[-1])


def test_a_scheduler_that_does_not_answer_is_one_line(folder, tmp_path, distributed):
    with pytest.raises(SimulationError, match=r"no scheduler answers at tcp://127.0.0.1:9"):
        make_dataset(recipe(folder), tmp_path / "s", scheduler="tcp://127.0.0.1:9")
    with pytest.raises(SimulationError, match=r"--scheduler is 'nowhere.json', expected tcp://HOST:PORT, or"):
        make_dataset(recipe(folder), tmp_path / "t", scheduler="nowhere.json")
