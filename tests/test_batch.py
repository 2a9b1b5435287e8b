"""simulate_batch has the bits of simulate; drafts look like full images; frames save, label and describe themselves."""

from __future__ import annotations

import io
import pickle
from dataclasses import replace

import numpy as np
import pydicom
import pytest
from PIL import Image

import SlicerUSSim.Logic
from SlicerUSSim.Logic import (
    DisplaySettings,
    LinearProbe,
    PhasedProbe,
    SimulationError,
    SimulationSettings,
    Tissue,
    UltrasoundSimulator,
)
from SlicerUSSim.Logic.base.volume import read_image_file
from SlicerUSSim.Logic.imaging import batch as batch_module
from SlicerUSSim.Logic.imaging.batch import OUTPUTS
from SlicerUSSim.Logic.imaging.quality import worked
from SlicerUSSim.Logic.mri.samples import head_mri
from SlicerUSSim.Logic.probe import PROBES, PatientSurface, craniotomy_pose, slice_under_probe, slide_sweep
from SlicerUSSim.Logic.probe.poses import sample
from tests.conftest import FLUID, SPECKLE, block, example, rigid, simulator

PROBE = PhasedProbe(70, 50, scan_lines=64)
SMALL = DisplaySettings(image_size=(64, 80))
POSES = slide_sweep(rigid(np.eye(3), [0, -25, 0]), length_mm=12, frames=3)
WALL = Tissue("wall", 1540.0, 1.75, 0.1)
DEEP, DENSE = replace(PROBES["phased"], depth_mm=200.0), SimulationSettings(scatterers_per_mm3=2e5)


def cyst(fluid: Tissue = FLUID) -> UltrasoundSimulator:
    """A ball of 6 mm, 27 mm deep, above a wall."""
    labels = block(lambda x, y, z: np.where(x**2 + (y - 2) ** 2 + z**2 < 36, 2, np.where(y > 18, 3, 1)), (40, 30, 20))
    return simulator(labels, SPECKLE, fluid, WALL)


@pytest.fixture(scope="module")
def made() -> UltrasoundSimulator:
    return cyst()


@pytest.mark.parametrize("quality", ["full", "draft"])
@pytest.mark.parametrize("varied", [False, True])
def test_a_batch_has_the_bits_of_single_images(made, quality, varied):
    before, made.settings = made.settings, replace(made.settings, quality=quality)
    nearest = 20.0 if quality == "full" else 30.0  # drafts have fewer scan lines for nearer foci, and signals one shape
    probes = [replace(PROBE, focus_mm=nearest + 5 * n) for n in range(3)] if varied else PROBE
    displays = [replace(SMALL, gain_db=3.0 * n) for n in range(3)] if varied else SMALL
    own = made.medium.tissues
    tables = [own, own.replace("speckle", mu0=0.5), own] if varied else None
    try:
        outputs = [name for name in OUTPUTS if (name, quality) != ("rf", "draft")]
        found = made.simulate_batch(probes, POSES, display=displays, tissues=tables, outputs=outputs, noise_seed=7)
        assert made.medium.tissues == own
        for n, pose in enumerate(POSES):
            probe, display = (probes[n], displays[n]) if varied else (probes, displays)
            with made.with_tissues(tables[n] if varied else own):
                frame = made.simulate(probe, pose, display, noise_seed=7 + n)
            for name in ("image", "iq", "envelope", "bmode"):
                np.testing.assert_array_equal(found[name][n], getattr(frame, name))
            if quality == "full":
                np.testing.assert_array_equal(found["rf"][n], frame.rf.real)
            np.testing.assert_array_equal(found["labels"][n], frame.labels())
    finally:
        made.settings = before
    assert {name: array.dtype for name, array in found.items()} == {name: OUTPUTS[name][0] for name in outputs}


def test_labels_and_depth_are_those_of_the_places_of_the_pixels(made):
    found = made.simulate_batch(PROBE, POSES[1:2], display=SMALL, outputs=("image", "labels", "depth"))
    grid = made.simulate(PROBE, POSES[1], SMALL).grid
    rows, columns = np.indices(grid.field(PROBE).shape)
    places = np.stack([columns, rows, 0 * rows, 1 + 0 * rows], -1) @ (POSES[1] @ grid.image_to_probe).T
    field, labels = grid.field(PROBE), found["labels"][0]
    np.testing.assert_array_equal(labels, np.where(field, sample(made.medium.labels, places[..., :3], order=0), 0))
    away = np.hypot(places[..., 0], places[..., 1] + 25)
    assert np.isnan(found["depth"][0][~field]).all()
    np.testing.assert_allclose(found["depth"][0][field], away[field], atol=1e-4)
    assert found["image"][0][labels == 2].mean() < 0.5 * found["image"][0][(labels == 1) & (away > 10)].mean()


def test_labels_as_imaged_are_displaced_by_travel_time():
    """Behind 12 mm of a fluid at 1400 m/s everything is 12 (1540 / 1400 - 1) mm deeper, as its echoes are."""
    slow = cyst(replace(FLUID, speed_of_sound_m_s=1400.0))
    found = slow.simulate_batch(PROBE, POSES[1:2], display=DisplaySettings(image_size=(250, 80)),
                                outputs=("labels", "labels_as_imaged"))  # fmt: skip
    row_mm = 50.0 / 250
    again = slow.simulate_batch(PROBE, POSES[1:2], display=SMALL, outputs=("labels_as_imaged", "iq"))  # echoes at hand
    assert (again["labels_as_imaged"] == 3).any()
    true, seen = (int(np.argmax(labels[0][:, 40] == 3)) * row_mm for labels in found.values())
    assert true == pytest.approx(43.5, abs=0.3)
    assert seen - true == pytest.approx(12.0 * (1540.0 / 1400.0 - 1.0), abs=0.3)
    plain = cyst().simulate_batch(PROBE, POSES[1:2], display=SMALL, outputs=("labels", "labels_as_imaged"))
    assert np.mean(plain["labels"] == plain["labels_as_imaged"]) > 0.98


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"out": {"image": np.zeros((3, 64, 81), np.uint8)}}, r"out\['image'\] is 3 x 64 x 81 uint8, expected 3 x 64"),
        ({"out": {"image": np.zeros((3, 64, 80))}}, r"float64, expected 3 x 64 x 80 uint8"),
        ({"out": {"labels": np.zeros((3, 64, 80), np.uint8)}}, "expected a dict with an array for each of image"),
        ({"display": [SMALL, SMALL, DisplaySettings()]}, "image 2 of the batch is 512 x .* the first is 64 x 80"),
        ({"display": [SMALL]}, "display are 1 for 3 poses"),
        ({"probes": [PROBE, PROBE, "convex"]}, "expected one Probe or one for each"),
        ({"probes": None}, "probes is None, expected one Probe or one for each pose"),
        ({"display": (64, 80)}, r"display is \(64, 80\), expected one DisplaySettings or"),
        ({"outputs": ["rf"], "settings": SimulationSettings(quality="draft")}, "rf has 2 samples per cycle"),
        ({"probes": [PROBE, PROBE, replace(PROBE, scan_lines=65)], "outputs": ["iq"]}, "image 2 of the batch is 65 x"),
        ({"outputs": ("picture",)}, "output 'picture' is unknown, expected some of image, labels"),
        ({"probes": DEEP, "settings": [SimulationSettings()] * 2 + [DENSE]}, "200000 scatterers .* expected at most"),
        ({"poses": []}, "the batch has no pose"),
        ({"poses": [2.0 * np.eye(4)]}, "pose 0"),
    ],
)  # fmt: skip
def test_what_makes_no_batch_is_reported_before_anything_is_computed(made, monkeypatch, change, says):
    monkeypatch.setattr(made, "render", lambda *_, **__: pytest.fail("computed"))
    values = {"probes": PROBE, "poses": POSES, "display": SMALL, **change}
    with pytest.raises(SimulationError, match=says) as error:
        made.simulate_batch(values.pop("probes"), values.pop("poses"), **values)
    assert "\n" not in str(error.value)


def test_a_batch_beyond_the_memory_is_a_file_and_out_may_be_one(made, monkeypatch, tmp_path):
    plain = made.simulate_batch(PROBE, POSES, display=SMALL)["image"]
    monkeypatch.setattr(batch_module, "free_memory", lambda: 20_000.0)
    filed = made.simulate_batch(PROBE, POSES, display=SMALL)["image"]
    assert isinstance(filed, np.memmap) and not isinstance(plain, np.memmap)
    own = np.memmap(tmp_path / "images", np.uint8, "w+", shape=plain.shape)
    assert made.simulate_batch(PROBE, POSES, display=SMALL, out={"image": own})["image"] is own
    for found in (filed, own):
        np.testing.assert_array_equal(found, plain)


def test_a_draft_has_less_work_the_smaller_the_image_and_full_none(made):
    full, own = SimulationSettings(), PROBES["phased"]
    assert worked(own, full, 16) == (own, full)
    lines = [worked(own, replace(full, quality="draft"), columns)[0].scan_lines for columns in (16, 160, 659)]
    assert lines[0] <= lines[1] == 80 < lines[2] == own.scan_lines
    probe, settings = worked(own, replace(full, quality="draft", scatterers_per_mm3=3.0), 16)
    depth = np.linspace(0.0, own.depth_mm, 50)
    assert (probe.line_distance_mm(depth) / probe.beam_sigma_mm(depth)[0]).max() < 2.0
    assert (settings.samples_per_cycle, settings.elevational_rays, settings.scatterers_per_mm3) == (2, 1, 3.0)


def test_a_draft_has_level_and_structures_of_the_full_image(made):
    coarse = replace(made.settings, quality="draft")
    drafts = made.simulate_batch(PROBE, POSES, display=SMALL, settings=coarse, outputs=("image", "labels"))
    full = made.simulate_batch(PROBE, POSES, display=SMALL)["image"].astype(float)
    tissue, fluid = (drafts["labels"] == label for label in (1, 2))
    db = SMALL.dynamic_range_db / 255.0
    assert db * (drafts["image"][tissue].mean() - full[tissue].mean()) == pytest.approx(0.0, abs=1.0)
    assert db * (drafts["image"][tissue].mean() - drafts["image"][fluid].mean()) > 10.0


def test_signals_are_downloaded_when_asked_for_whatever_comes_after(made, monkeypatch):
    shapes, download = [], made.device.download
    monkeypatch.setattr(made.device, "download", lambda *of: shapes.append(of[1]) or download(*of))
    expected = made.simulate_batch(PROBE, POSES, display=SMALL, outputs=("iq", "envelope", "bmode"))
    smooth = replace(SMALL, smoothing_axial_mm=0.4)
    shapes.clear()
    frames = [made.simulate(PROBE, pose, SMALL, noise_seed=n) for n, pose in enumerate(POSES)]
    assert shapes.count((64, 80)) == 3 and len(shapes) == 9  # images, overflows and three signals of the first frame
    made.simulate(PROBE, POSES[0], smooth)
    list(made.sweep(PROBE, POSES, smooth))
    pickled = pickle.loads(pickle.dumps(frames[1]))
    for n, frame in enumerate(frames):
        for name, arrays in expected.items():
            np.testing.assert_array_equal(getattr(frame, name), arrays[n])
            np.testing.assert_array_equal(getattr(pickled, name), arrays[1])
    assert frames[0].iq is frames[0].iq
    shapes.clear()
    for pose in POSES * 3:
        frame = made.simulate(PROBE, pose, SMALL)
    assert len(shapes) == 18, "a frame whose name gets the next one is not downloaded"
    assert frame.iq.shape == expected["iq"][0].shape and len(shapes) == 19


def test_frames_that_come_and_go_share_buffers(made, monkeypatch):
    made.simulate(PROBE, POSES[0], SMALL)
    sizes, empty = [], made.device.empty
    monkeypatch.setattr(made.device, "empty", lambda size: sizes.append(size) or empty(size))
    for pose in POSES * 4:
        frame = made.simulate(PROBE, pose, SMALL)
    assert len(sizes) <= 3 and frame.image.any(), "one more buffer for each signal"


# ---- manners ---------------------------------------------------------------------------------------------------------


def test_a_frame_is_saved_in_the_format_of_its_name(made, tmp_path):
    frame = made.simulate(PROBE, POSES[0], SMALL)
    for name in ("a.png", "a.dcm", "a.nrrd"):
        frame.save(tmp_path / name)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "a.png")), frame.image)
    data = pydicom.dcmread(tmp_path / "a.dcm")
    np.testing.assert_array_equal(data.pixel_array, frame.image)
    (region,) = data.SequenceOfUltrasoundRegions
    assert (10 * region.PhysicalDeltaX, 10 * region.PhysicalDeltaY) == pytest.approx(frame.pixel_spacing_mm)
    assert (data.BurnedInAnnotation, data.SOPClassUID.name) == ("NO", "Ultrasound Image Storage")
    read = read_image_file(tmp_path / "a.nrrd")
    np.testing.assert_allclose(read.ijk_to_ras, frame.to_volume().ijk_to_ras, atol=1e-6)
    with pytest.raises(SimulationError, match=r"a\.jpg: unknown image format, expected .*\.png, \.dcm"):
        frame.save(tmp_path / "a.jpg")


def test_a_shown_frame_has_square_pixels(made, monkeypatch):
    frame, shown = made.simulate(PROBE, POSES[0], DisplaySettings(image_size=(100, 300))), []
    monkeypatch.setattr(Image.Image, "show", lambda image, title: shown.append(image.size))
    frame.show()
    across, down = np.multiply(frame.pixel_spacing_mm, (300, 100))
    assert shown == [(round(100 * across / down), 100)] == [Image.open(io.BytesIO(frame._repr_png_())).size]
    assert frame.sampling_rate_hz == pytest.approx(4 * 5e6) and "milliseconds" in str(type(frame).__doc__)
    with pytest.raises(SimulationError, match="the frame has no patient"):
        replace(frame, patient=None).labels()


def test_a_simulator_is_made_of_a_file_and_pickles(tmp_path):
    head_mri(spacing_mm=4.0).write(tmp_path / "mri.nii.gz")
    made = UltrasoundSimulator.from_mri(tmp_path / "mri.nii.gz", SimulationSettings(seed=3), classes=3)
    pose = craniotomy_pose(made.medium.labels, PROBE)
    copy = pickle.loads(pickle.dumps(made))
    assert copy.settings.seed == 3 and made.texture is not None and SlicerUSSim.Logic.__version__[0].isdigit()
    np.testing.assert_array_equal(copy.simulate(PROBE, pose).iq, made.simulate(PROBE, pose).iq)


def test_a_slice_is_the_volume_at_the_pixels_and_the_centre_its_mean(made):
    volume = made.medium.labels.with_array(np.random.default_rng(0).normal(size=made.medium.labels.array.shape))
    frame = made.simulate(PROBE, POSES[0] @ rigid(np.eye(3), [0, 0, 1.3]), SMALL)
    columns, rows = np.meshgrid(np.arange(80), np.arange(64))
    points = np.stack([columns, rows, 0 * rows, 1 + 0 * rows], -1) @ (frame.probe_to_ras @ frame.image_to_probe).T
    np.testing.assert_allclose(
        slice_under_probe(volume, frame.grid, frame.probe_to_ras), sample(volume, points[..., :3]), atol=1e-9
    )
    whole = volume.with_array((1000.0 * volume.array).astype(np.int16))  # whose values are rounded
    found, exact = (
        slice_under_probe(whole, frame.grid, frame.probe_to_ras),
        volume.with_array(whole.array.astype(float)),
    )
    assert found.dtype == np.int16
    np.testing.assert_allclose(found, sample(exact, points[..., :3]), atol=0.501)


def test_the_examples_of_three_users_run(tmp_path):
    mri = head_mri(spacing_mm=3.0)
    example("training_pairs").write_pairs(mri, tmp_path / "pairs.npz", 4)
    pairs = np.load(tmp_path / "pairs.npz")
    assert pairs["image"].shape == pairs["labels"].shape == (4, 128, 160) and (pairs["image"] > 0).mean() > 0.1
    filter_ = example("vtk_picture").write_picture(mri.to_vtk(), str(tmp_path / "picture.png"))
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "picture.png")), filter_.GetFrame().image)
    before, after = example("recover_pose").errors_mm(head_mri(spacing_mm=4.0), evaluations=45)
    assert before > 4.0 and after < before


def test_a_random_pose_stands_on_the_surface():
    labels = block(lambda x, y, z: x**2 + y**2 + z**2 < 25**2)
    surface, probe = PatientSurface(labels), LinearProbe(20, 30)
    pose = surface.slid(craniotomy_pose(labels, probe), surface.at(right_deg=40, front_deg=-30))
    assert np.linalg.norm(pose[:3, 3]) == pytest.approx(25.5, abs=1.5)
    assert pose[:3, 1] @ pose[:3, 3] / np.linalg.norm(pose[:3, 3]) == pytest.approx(-1.0, abs=0.02)
