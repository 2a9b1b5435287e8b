"""The imaged field estimated from images: simulated images with known geometry, and real images."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import assume, given, strategies as st
from PIL import Image, ImageDraw

from SlicerUSSim.Logic import ConvexProbe, LinearProbe, PhasedProbe, SimulationError, TrackedSequence
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.tracked.imaged_field import ImagedField, draw_field, estimate_field
from SlicerUSSim.Logic.tracked.images import TrackedImages
from tests.conftest import SHARED, needs_shared


def screen(probe, left: int = 60, top: int = 15, seed: int = 0) -> tuple[np.ndarray, ImageGrid]:
    """A scanner's screen: speckle in the field of `probe`, a logo, a grey bar and a ruler beside it."""
    grid = ImageGrid.for_probe(probe, None)
    random = np.random.default_rng(seed)
    field = np.where(grid.field(probe), random.integers(5, 160, (grid.rows, grid.columns)), 0)
    image = np.zeros((grid.rows + 40, grid.columns + 120), np.uint8)
    image[top : top + grid.rows, left : left + grid.columns] = field
    image[5:25, 5:40] = 220
    image[60:300, 20:30] = np.linspace(255, 0, 240)[:, None]
    image[::25, -8:] = 200
    return image, grid


convex = st.builds(ConvexProbe, st.floats(10, 70), st.floats(40, 100), st.floats(40, 200))
linear = st.builds(LinearProbe, st.floats(20, 60), st.floats(20, 90))
phased = st.builds(PhasedProbe, st.floats(50, 100), st.floats(50, 180))


@given(st.one_of(convex, linear, phased))
@pytest.mark.slow
def test_geometry_is_found_from_the_image(probe):
    if isinstance(probe, ConvexProbe):  # with a smaller radius it is classified as a phased array
        assume(probe.radius_mm > 0.08 * (probe.radius_mm + probe.depth_mm))
    image, grid = screen(probe)
    field = estimate_field(image, grid.pixel_spacing_mm)
    pixel = grid.pixel_spacing_mm[1]
    found, true = field.probe.to_dict(), probe.to_dict()
    assert found["kind"] == true["kind"]
    assert found["depth_mm"] == pytest.approx(true["depth_mm"], abs=5 * pixel)
    if "field_of_view_deg" in true:
        assert found["field_of_view_deg"] == pytest.approx(true["field_of_view_deg"], abs=1.5)
    if "radius_mm" in true:
        assert found["radius_mm"] == pytest.approx(true["radius_mm"], abs=6 * pixel)
    if "width_mm" in true:
        assert found["width_mm"] == pytest.approx(true["width_mm"], abs=4 * pixel)
    face = (np.linalg.inv(field.image_to_probe) @ [0, 0, 0, 1])[:2]
    expected = np.linalg.inv(grid.image_to_probe)[:2, 3] + [60, 15]
    assert np.abs(face - expected).max() < 6.0
    assert field.overlap > 0.95


@pytest.mark.parametrize("kind", [LinearProbe(38, 50), ConvexProbe(15, 70, 60)], ids=["linear", "micro-convex"])
def test_edges_of_the_field_are_those_of_pixels_not_of_their_centres(kind):
    """Over pixels that lie anywhere on the field the estimate is right on average: half a pixel would be seen."""
    random, spacing, errors = np.random.default_rng(0), 0.25, []
    outline = kind.outline_mm()[:, :2]
    for _ in range(12):
        sizes = [name for name in ("depth_mm", "width_mm", "radius_mm") if name in kind.to_dict()]
        probe = replace(kind, **{name: getattr(kind, name) + random.uniform(0, 2 * spacing) for name in sizes})
        left, top = outline.min(axis=0) - spacing * random.uniform(20, 21, 2)
        columns, rows = (int(size / spacing) + 50 for size in np.ptp(outline, axis=0))
        x, y = np.meshgrid(left + spacing * np.arange(columns), top + spacing * np.arange(rows))
        found = estimate_field(np.where(probe.holds(x, y), 100, 0).astype(np.uint8), (spacing, spacing))
        wrong_by = [found.probe.to_dict()[name] - probe.to_dict()[name] for name in sizes]
        face = (np.linalg.inv(found.image_to_probe) @ [0, 0, 0, 1])[:2] * spacing + [left, top]
        errors.append([*wrong_by, *face])
    assert np.abs(np.mean(errors, axis=0)).max() < 0.25 * spacing


@pytest.mark.parametrize(
    "image, message",
    [
        (np.zeros((50, 60), np.uint8), "black"),
        (np.full((3, 0, 4), 9, np.uint8), "expected (n, rows, columns)"),
        (np.tri(200, 200, dtype=np.uint8) * 99, "not a probe's field"),
    ],
)
def test_images_without_a_fan_are_refused(image, message):
    with pytest.raises(SimulationError) as caught:
        estimate_field(image, (0.1, 0.1))
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_picture_to_check_shows_the_outline(tmp_path):
    image, grid = screen(ConvexProbe(40, 60, 80))
    field = estimate_field(image, grid.pixel_spacing_mm)
    draw_field(tmp_path / "field.png", image, field)
    picture = np.asarray(Image.open(tmp_path / "field.png")).astype(int)
    yellow = (picture[..., 0] > 200) & (picture[..., 2] < 120)
    rows, columns = np.nonzero(yellow[:-20])
    outline = field.outline_pixels()
    assert abs(columns.min() - outline[:, 0].min()) < 4 and abs(rows.max() - outline[:, 1].max()) < 4


def test_field_of_a_known_probe_is_its_own():
    probe = LinearProbe(20, 30)
    grid = ImageGrid.for_probe(probe, (60, 40))
    assert np.array_equal(ImagedField.of(probe, grid.image_to_probe, (60, 40)).mask, grid.field(probe))


# ---- tracked images --------------------------------------------------------------------------------------------------


def tracked_screen(probe) -> TrackedSequence:
    image, grid = screen(probe)
    calibration = np.diag([*grid.pixel_spacing_mm, 1.0, 1.0])
    calibration[:3, 3] = 3.0, 7.0, -2.0  # of a tracker's marker, not of the probe's face
    other = screen(probe, seed=1)[0]
    return TrackedSequence(
        np.stack([image, other]), ({"ImageToProbe": calibration, "ProbeToReference": np.eye(4)},) * 2, [0.0, 1.0]
    )


def test_poses_and_pixels_follow_from_calibration_and_field():
    probe = ConvexProbe(40, 60, 80)
    sequence = tracked_screen(probe)
    found = TrackedImages.of(sequence)
    # Pixels of the cropped image lie where those of the whole one do.
    row, column = 100, 120
    rows, columns = found.field.window
    there = found.poses[0] @ found.grid.image_to_probe @ [column, row, 0, 1]
    expected = sequence.pose(0, "ImageToReference") @ [column + columns.start, row + rows.start, 0, 1]
    assert np.allclose(there, expected, atol=1e-6)
    assert np.array_equal(found.images[1], sequence.images[1][rows, columns])
    assert np.allclose(found.poses[0][:3, :3], np.eye(3), atol=1e-6)


def test_a_given_probe_keeps_its_beam_and_gets_the_place_of_the_field():
    sequence = tracked_screen(ConvexProbe(40, 60, 80))
    probe = ConvexProbe(40, 60, 80, frequency_mhz=7.0)
    found = TrackedImages.of(sequence, [1], probe=probe)
    assert found.probe is probe and found.numbers == [1]
    assert np.allclose(found.poses[0], TrackedImages.of(sequence).poses[1], atol=0.4)
    with pytest.raises(SimulationError, match="the probe is linear, expected convex as in the images"):
        TrackedImages.of(sequence, probe=LinearProbe(40, 80))
    with pytest.raises(SimulationError, match="the probe's depth is 120 mm, expected"):
        TrackedImages.of(sequence, probe=ConvexProbe(40, 60, 120))


def test_images_are_spread_over_those_that_were_tracked():
    sequence = tracked_screen(LinearProbe(40, 50))
    many = TrackedSequence(
        np.concatenate([sequence.images] * 6), [t if n != 0 else {} for n, t in enumerate(sequence.transforms * 6)],
        np.arange(12.0),
    )  # fmt: skip
    assert TrackedImages.of(many).numbers == list(range(1, 12))
    assert TrackedImages.of(many, most=3).numbers == [1, 6, 11]
    assert TrackedImages.of(many, [2, 3, 4, 5], most=3).numbers == [2, 3, 4, 5]


def test_bad_sequences_are_refused_in_one_line():
    sequence = tracked_screen(LinearProbe(40, 50))
    black = sequence.with_images([0, 1], np.stack([sequence.images[0], np.zeros_like(sequence.images[0])]))
    skewed = sequence.with_transforms(
        {"ImageToProbe": np.array([[0.1, 0.05, 0, 0], [0, 0.1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])}
    )
    for attempt, message in (
        (lambda: TrackedImages.of(black), "image 1 of the sequence is black"),
        (lambda: TrackedImages.of(skewed), "skewed"),
        (lambda: TrackedImages.of(sequence, [5]), "image 5 does not exist, expected 0 to 1"),
        (lambda: TrackedImages.of(sequence, path="ImageToPatient"), "no path from Image to Patient"),
        (lambda: TrackedImages.of(sequence, reference_to_ras=np.diag([2.0, 1, 1, 1])), "reference_to_ras"),
    ):  # fmt: skip
        with pytest.raises(SimulationError) as caught:
            attempt()
        assert message in str(caught.value) and "\n" not in str(caught.value)


@needs_shared
@pytest.mark.parametrize("name, depth", [("SpinePhantomFreehand", 50.0), ("BoneUltrasound_L14", 50.0)])
def test_real_images_show_the_field_of_the_38_mm_probe_that_took_them(name, depth):
    sequence = TrackedSequence.read(SHARED / f"{name}.igs.mha")
    field = estimate_field(sequence.images, (0.1, 0.1))
    mm = 38.0 / field.probe.face_mm  # of a pixel: L14-5
    assert field.probe.is_linear and mm * field.probe.depth_mm == pytest.approx(depth, abs=1.0) and field.overlap > 0.99


# ---- what hides the field --------------------------------------------------------------------------------------------


@cache
def recording(probe, count: int = 6) -> TrackedSequence:
    """Images of one probe with other speckle each, with the calibration of its own frame."""
    grid = ImageGrid.for_probe(probe, None)
    inside = grid.field(probe)
    random = np.random.default_rng(3)
    images = np.where(inside, random.integers(20, 200, (count, grid.rows, grid.columns)), 0).astype(np.uint8)
    transforms = ({"ImageToProbe": grid.image_to_probe, "ProbeToReference": np.eye(4)},) * count
    return TrackedSequence(images, transforms, np.arange(float(count)))


CONVEX = ConvexProbe(40, 60, 80)


def test_the_field_is_found_from_all_images_of_a_recording():
    """The right half is dark in the image that is fitted, as without contact."""
    sequence = tracked_screen(CONVEX)
    images = sequence.images.copy()
    images[0][:, images.shape[2] // 2 :] = 0
    half = sequence.with_images([0, 1], images)
    with pytest.raises(SimulationError, match="not a probe's field"):
        estimate_field(images[:1], (0.1, 0.1))
    found, whole = TrackedImages.of(half, [0]), TrackedImages.of(sequence, [0])
    assert found.probe.depth_mm == pytest.approx(whole.probe.depth_mm, abs=0.5)
    assert found.mask.sum() == pytest.approx(whole.mask.sum(), rel=0.02)


def test_one_image_that_is_partly_dark_is_enough_with_a_probe():
    probe = CONVEX
    image, grid = screen(probe)
    image[: 15 + grid.rows, 60 + 4 * grid.columns // 5 :] = 0
    image[15 + 2 * grid.rows // 3 :] = 0  # and nothing comes from the depth
    calibration = np.diag([*grid.pixel_spacing_mm, 1.0, 1.0])
    calibration[:3, 3] = 3.0, 7.0, -2.0  # of a tracker's marker
    sequence = TrackedSequence(image[None], ({"ImageToProbe": calibration, "ProbeToReference": np.eye(4)},), [0.0])
    found = TrackedImages.of(sequence, probe=probe)
    face = (np.linalg.inv(found.field.image_to_probe) @ [0, 0, 0, 1])[:2]
    assert np.abs(face - np.linalg.inv(grid.image_to_probe)[:2, 3] - [60, 15]).max() < 5.0
    with pytest.raises(SimulationError, match="of the bright region in the images, expected at least 85%"):
        TrackedImages.of(sequence, probe=LinearProbe(8, 20))


def test_a_small_radius_is_a_convex_array_and_none_is_a_phased_one():
    """4.5 mm under 78 mm: with the apex for the face, everything would lie 4.5 mm too deep."""
    for probe, kind in ((ConvexProbe(4.53, 88, 73.8), "convex"), (PhasedProbe(88, 78.3), "phased")):
        image, grid = screen(probe)
        found = estimate_field(image, grid.pixel_spacing_mm).probe
        assert found.to_dict()["kind"] == kind
        assert found.depth_mm == pytest.approx(probe.depth_mm, abs=0.6)
    assert found.apex_radius_mm == 0.0


@pytest.mark.parametrize("count", [1, 6])
def test_what_the_file_cuts_off_is_outside_the_mask(count, caplog):
    sequence = recording(CONVEX, count)
    images = sequence.images.copy()
    edge = images.shape[2] - 60
    images[:, :, edge:] = 0
    found = TrackedImages.of(sequence.with_images(range(count), images), probe=CONVEX)
    assert "are beyond what the file shows: left out" in caplog.text
    whole = ImagedField.of(CONVEX, found.field.image_to_probe, images.shape[1:]).mask
    np.testing.assert_array_equal(found.field.mask[:, :edge], whole[:, :edge])
    assert not found.field.mask[:, edge:].any() and whole[:, edge:].any()
    assert found.images[0].shape == found.mask.shape == (found.grid.rows, found.grid.columns)


def test_darkness_is_not_a_cut():
    """Levels that fall with depth and to a side, as tissue's do, stay in the mask."""
    sequence = recording(CONVEX)
    rows, columns = (np.arange(size) for size in sequence.images.shape[1:])
    fall = np.clip(1.1 - rows[:, None] / rows[-1], 0, 1) * np.clip(1.2 - columns / columns[-1], 0, 1)
    dark = (sequence.images * fall).astype(np.uint8)
    found = TrackedImages.of(sequence.with_images(range(6), dark), probe=CONVEX)
    whole = ImagedField.of(CONVEX, found.field.image_to_probe, dark.shape[1:]).mask
    np.testing.assert_array_equal(found.field.mask, whole)


def test_text_and_boxes_in_the_field_are_left_out_and_reported(caplog):
    """Letters have smooth edges."""
    sequence = recording(CONVEX)
    part = letters(sequence.images.shape[1:], 60, sequence.images.shape[2] // 2 - 80, 20)
    images = (sequence.images * (1 - part) + 240 * part).round().astype(np.uint8)
    middle = np.array(images.shape[1:]) // 2
    box = np.zeros(images.shape[1:], bool)
    box[middle[0] + 40 : middle[0] + 90, middle[1] - 50 : middle[1] + 20] = True
    box[middle[0] + 41 : middle[0] + 89, middle[1] - 49 : middle[1] + 19] = False
    images[:, box] = 180
    found = TrackedImages.of(sequence.with_images(range(6), images), probe=CONVEX)
    assert "are the same in all images, as text, rulers and boxes are" in caplog.text
    assert not found.field.mask[box].any()
    assert found.field.mask[part > 0.1].mean() < 0.05
    clean = ImagedField.of(CONVEX, found.field.image_to_probe, images.shape[1:]).mask
    assert 0.9 < found.field.mask.sum() / clean.sum() < 1.0
    assert found.field.mask[middle[0] + 60, middle[1]]  # inside the box the patient is seen


def letters(shape: tuple[int, int], row: int, column: int, height: int) -> np.ndarray:
    """(rows, columns) float, the part of each pixel that strokes of eight letters cover: their edges are smooth."""
    fine = 8
    drawing = Image.new("L", (shape[1] * fine, shape[0] * fine))
    pen = ImageDraw.Draw(drawing)
    a, e = [(0, 1), (0.4, 0), (0.8, 1)], [(0.7, 0), (0, 0), (0, 0.5), (0.6, 0.5), (0, 0.5), (0, 1), (0.7, 1)]
    for place in range(8):
        points = [
            ((column + (x + place) * height) * fine + 3, (row + y * height) * fine + 3) for x, y in (a, e)[place % 2]
        ]
        pen.line(points, fill=255, width=round(0.12 * height * fine))
    return np.asarray(drawing, float).reshape(shape[0], fine, shape[1], fine).mean(axis=(1, 3)) / 255


def test_images_that_cannot_tell_what_is_drawn_are_reported(caplog):
    few = recording(CONVEX, 3)
    TrackedImages.of(few, probe=CONVEX)
    assert "marks in the images could not be detected: 3 different images, expected at least 4" in caplog.text
    caplog.clear()
    still = few.images[[0] * 6] + np.arange(6, dtype=np.uint8)[:, None, None] * (few.images[0] > 0)
    TrackedImages.of(few.with_images([0] * 6, still.astype(np.uint8)), probe=CONVEX)
    assert "changes by at most 5 grey levels, expected 20 or more" in caplog.text
    caplog.clear()
    TrackedImages.of(replace(few, fields={"SlicerUSSimSimulated": "twin 1"}), probe=CONVEX)
    assert "could not be detected" not in caplog.text


def test_pixels_of_another_size_are_named():
    sequence = recording(CONVEX)
    large = sequence.transforms[0]["ImageToProbe"] @ np.diag([10.0, 10.0, 1.0, 1.0])
    scaled = sequence.with_transforms({"ImageToProbe": large})
    with pytest.raises(SimulationError, match=r"check the size of a pixel in ImageToReference or the calibration"):
        TrackedImages.of(scaled, probe=CONVEX)
    with pytest.raises(
        SimulationError, match=r"radius_mm is 400.* pixels are 1.67 x 1.67 mm large, check the calibration"
    ):
        TrackedImages.of(scaled)


def test_an_image_that_shows_nearly_nothing_is_refused():
    sequence = recording(CONVEX)
    images = sequence.images.copy()
    images[1] = 0
    images[1, 200, 150:180] = 90
    with pytest.raises(SimulationError, match=r"image 1 shows something in 0.0% of the probe's field only"):
        TrackedImages.of(sequence.with_images(range(6), images), probe=CONVEX)


def in_colours(path, sequence: TrackedSequence, colours: np.ndarray) -> TrackedSequence:
    """The sequence with (n, rows, columns, 3) colours, as read from a file."""
    import SimpleITK as sitk

    sequence.write(path)
    grey = sitk.ReadImage(str(path))
    colour = sitk.GetImageFromArray(colours, isVector=True)
    for key in grey.GetMetaDataKeys():
        colour.SetMetaData(key, grey.GetMetaData(key))
    sitk.WriteImage(colour, str(path))
    return TrackedSequence.read(path)


@pytest.mark.parametrize(
    "tint",
    [np.outer(np.arange(256), [1, 0.85, 0.6]), np.clip(np.arange(256)[:, None] * 3 - np.array([0, 255, 510]), 0, 255)],
    ids=["sepia", "hot iron"],
)
def test_tinted_images_are_grey_levels_with_a_warning(tint, tmp_path, caplog):
    """Sepia was Doppler's: what was left of the field was black, and fitted."""
    sequence = recording(CONVEX)
    read = in_colours(tmp_path / "tinted.mha", sequence, tint.astype(np.uint8)[sequence.images])
    assert "the images are tinted: " in caplog.text
    levels = tint.astype(np.uint8)[sequence.images] @ [0.299, 0.587, 0.114]
    assert np.abs(read.images - levels).max() <= 0.5 + 1e-9
    found = TrackedImages.of(read, probe=CONVEX)
    assert "have colours" not in caplog.text
    assert found.field.mask.sum() == ImagedField.of(CONVEX, found.field.image_to_probe, levels.shape[1:]).mask.sum()


def test_colours_are_left_out_and_reported(tmp_path, caplog):
    sequence = recording(CONVEX, 2)
    array = np.repeat(sequence.images[..., None], 3, axis=-1)
    middle = np.array(array.shape[1:3]) // 2
    flow = (slice(middle[0], middle[0] + 20), slice(middle[1], middle[1] + 30))
    array[(1, *flow)] = 200, 30, 10
    read = in_colours(tmp_path / "colour.mha", sequence, array)
    assert read.coloured is not None and read.coloured.sum() == 600
    found = TrackedImages.of(read, probe=CONVEX)
    assert "have colours, such as Doppler or markers: left out" in caplog.text
    assert not found.field.mask[flow].any()
    sequence.write(tmp_path / "grey.mha")
    assert TrackedSequence.read(tmp_path / "grey.mha").coloured is None


def test_a_mirroring_calibration_is_reported(caplog):
    sequence = recording(CONVEX, 2)
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    transforms = tuple({**entry, "ProbeToReference": mirror} for entry in sequence.transforms)
    TrackedImages.of(replace(sequence, transforms=transforms), probe=CONVEX)
    assert "ImageToReference mirrors" in caplog.text


def test_an_image_of_one_grey_level_is_refused_with_its_number():
    """White images were fitted, with costs and textures that were NaN."""
    sequence = recording(CONVEX, 2)
    images = sequence.images.copy()
    images[1] = 255
    with pytest.raises(SimulationError, match="image 1 has the grey level 255 in all of the probe's field"):
        TrackedImages.of(sequence.with_images([0, 1], images), probe=CONVEX)


@needs_shared
def test_the_real_sweep_is_cut_at_column_543():
    sequence = TrackedSequence.read(SHARED / "brain_sweep" / "brain_sweep.igs.mha")
    found = TrackedImages.of(sequence, [4])
    probe = found.probe.to_dict()
    assert probe["kind"] == "convex" and probe["radius_mm"] == pytest.approx(4.53, abs=0.4)
    assert probe["field_of_view_deg"] == pytest.approx(88.0, abs=1.0)
    assert probe["depth_mm"] == pytest.approx(73.8, abs=0.4)
    assert found.field.window[1].stop == 544
