"""What a scanner's console does to an image (imaging/console.py, grey_map.py): off by default, and free in fits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from SlicerUSSim.Logic import (
    ConvexProbe,
    DisplaySettings,
    LinearProbe,
    SimulationError,
    TissueTable,
    TrackedSequence,
    UltrasoundSimulator,
    optimize_appearance,
)
from SlicerUSSim.Logic.fitting import AppearanceModel, speckle_widths
from SlicerUSSim.Logic.imaging.console import gains_across, gains_along
from SlicerUSSim.Logic.imaging.grey_map import GREY_MAPS, TABLE_SIZE, estimate_grey_map, grey_table, slope_at
from SlicerUSSim.Logic.probe import PROBES, ImageGrid, probe_from_dict
from SlicerUSSim.Logic.tracked import TrackedImages
from tests.conftest import SHARED, SPECKLE, block, even_display, needs_shared, rigid, simulator
from tests.reference.display import image_of

EVEN = replace(SPECKLE, texture_db=0.0, specks_per_mm3=0.0)
SMALL = LinearProbe(8, 12, scan_lines=24, frequency_mhz=4, focus_mm=40, elevation_focus_mm=40)
POSE = rigid(np.eye(3), [0.0, -6.0, 0.0])
EVERYTHING = even_display(
    smoothing_axial_mm=0.15, smoothing_lateral_deg=0.6, edge_enhancement=0.8, grey_map="soft", map_dark=0.7,
    depth_gain_2_db=4.0, depth_gain_7_db=-6.0, line_gain_1_db=-9.0, line_gain_4_db=3.0, noise_db=-30.0,
    near_gain_db=-14.0,
)  # fmt: skip


@pytest.fixture(scope="module")
def small():
    labels = block(lambda x, y, z: 1 + (y > 0), (12, 12, 6))
    return simulator(labels, EVEN, replace(EVEN, name="more", mu0=1.0), scatterers_per_mm3=4.0)


@pytest.fixture(scope="module")
def solid():
    return simulator(block(lambda x, y, z: np.ones_like(x), (40, 40, 12)), EVEN)


@pytest.mark.parametrize(
    "changes",
    [{}, {"smoothing_axial_mm": 0.0, "smoothing_lateral_deg": 0.0}, {"edge_enhancement": 0.0},
     {"grey_map": "linear", "map_dark": 1.0}, {"smoothing_axial_mm": 2.5}],
)  # fmt: skip
@pytest.mark.parametrize(
    "probe",
    [SMALL, ConvexProbe(20.0, 40.0, 12.0, scan_lines=24, frequency_mhz=4.0)],
    ids=["linear", "convex"],
)
def test_the_kernels_do_what_numpy_does(small, probe, changes):
    frame = small.device_frame(probe, POSE, replace(EVERYTHING, **changes))
    for stage in small.stages:
        stage.run(frame)
    image = frame.download("image").astype(int)
    assert (np.abs(image - image_of(frame, frame.download("iq"))) <= 1).mean() > 0.999 and image.max() > 60
    small.forget_echoes()
    assert (np.abs(image - small.simulate(probe, POSE, even_display(noise_db=-30.0)).image) > 8).mean() > 0.3


def test_off_by_default_and_without_effect_on_the_echoes(small):
    """The baseband signal is the same, so that frames are displayed again and fits keep their bases."""
    plain, other = small.simulate(SMALL, POSE), small.simulate(SMALL, POSE, EVERYTHING)
    np.testing.assert_array_equal(plain.iq, other.iq)
    np.testing.assert_array_equal(small.simulate(SMALL, POSE).image, plain.image)
    assert even_display().grey_map == "linear" and even_display().smoothing_axial_mm == 0.0


def test_smoothing_widens_speckle_by_its_sigma(solid):
    """A Gaussian of sigma t adds 2 t^2 to the s^2 of the correlation of intensities; smoothed speckle has another law,
    as compounded looks have, by which its log is up to a quarter wider."""
    probe = LinearProbe(30, 40, scan_lines=181)
    grid = ImageGrid.for_probe(probe, None)
    pose = rigid(np.eye(3), [0, -30, 0])
    plain, smooth = (
        speckle_widths([solid.simulate(probe, pose, d).image], probe, grid, [20.0], reach_mm=15.0)[0]
        for d in (
            even_display(),
            even_display(smoothing_axial_mm=0.15, smoothing_lateral_deg=0.6),
        )
    )
    for before, after, sigma in (
        (plain.axial_mm, smooth.axial_mm, 0.15),
        (plain.lateral_mm, smooth.lateral_mm, np.deg2rad(0.6) * probe.focus_mm),
    ):
        assert 0.9 * np.hypot(before, np.sqrt(2) * sigma) < after < 1.6 * np.hypot(before, np.sqrt(2) * sigma)


@pytest.mark.parametrize("number", [5, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 8))])
def test_a_slider_changes_the_level_at_its_depth_and_not_elsewhere(solid, number):
    probe, pose = LinearProbe(30, 40, scan_lines=91), rigid(np.eye(3), [0, -30, 0])
    display = even_display(noise_db=None, tgc_db_cm_mhz=0.0)
    frames = [solid.simulate(probe, pose, d) for d in (display, replace(display, **{f"depth_gain_{number}_db": 7.0}))]
    depth = np.arange(frames[0].envelope.shape[1]) * frames[0].sample_interval_mm
    change = 20 * np.log10(frames[1].envelope / frames[0].envelope).mean(axis=0)
    middle = (number - 0.5) * 5.0
    np.testing.assert_allclose(change[np.abs(depth - middle) < 0.05], 7.0, atol=0.1)
    np.testing.assert_allclose(change[(np.abs(depth - middle) > 5.1) & (depth < 40.0)], 0.0, atol=1e-3)


def test_the_near_gain_is_that_of_the_face_and_fades_with_depth(solid):
    probe, pose = LinearProbe(30, 40, scan_lines=91), rigid(np.eye(3), [0, -30, 0])
    display = even_display(noise_db=None, tgc_db_cm_mhz=0.0)
    frames = [solid.simulate(probe, pose, d) for d in (display, replace(display, near_gain_db=-20.0))]
    depth = np.arange(frames[0].envelope.shape[1]) * frames[0].sample_interval_mm
    change = 20 * np.log10(frames[1].envelope / frames[0].envelope).mean(axis=0)
    for mm, share in ((0.0, 1.0), (6.0, np.exp(-1.0)), (18.0, np.exp(-3.0)), (36.0, np.exp(-6.0))):
        np.testing.assert_allclose(change[np.abs(depth - mm) < 0.05], -20.0 * share, atol=0.2)


def test_gain_by_line_goes_from_left_to_right(solid):
    probe, pose = LinearProbe(30, 40, scan_lines=101), rigid(np.eye(3), [0, -30, 0])
    plain, dark = (
        solid.simulate(probe, pose, even_display(noise_db=None, **g)) for g in ({}, {"line_gain_1_db": -12.0})
    )
    change = 20 * np.log10(dark.envelope / plain.envelope).mean(axis=1)
    np.testing.assert_allclose(change[[0, 12, 25, 100]], [-12.0, -12.0 * 13 / 25, 0.0, 0.0], atol=0.05)


@pytest.mark.parametrize("name", GREY_MAPS)
@pytest.mark.parametrize("slopes", [(1.0, 1.0, 1.0), (0.1, 3.0, 0.1), (3.0, 0.1, 3.0)])
def test_every_grey_map_rises_from_black_to_white(name, slopes):
    table = grey_table(even_display(grey_map=name, map_black=slopes[0], map_dark=slopes[1], map_white=slopes[2]))
    assert table.shape == (TABLE_SIZE,) and table[0] == 0.0 and table[-1] == pytest.approx(255.0)
    assert (np.diff(table) > 0.0).all()
    wanted = slope_at(table, tuple(np.multiply(GREY_MAPS[name], slopes)))
    np.testing.assert_allclose((np.diff(table) / np.diff(table)[500])[20:-20] * wanted[500], wanted[20:-21], rtol=0.08)


def test_a_straight_map_is_log_compression(solid):
    np.testing.assert_allclose(grey_table(even_display()), np.linspace(0, 255, TABLE_SIZE), atol=1e-3)
    probe, pose = LinearProbe(30, 40, scan_lines=91), rigid(np.eye(3), [0, -30, 0])
    plain = solid.simulate(probe, pose, even_display()).image.astype(int)
    # By way of the table: a map that is straight except beyond any float
    nearly = solid.simulate(probe, pose, even_display(map_white=1.0 + 1e-6)).image
    assert np.abs(plain - nearly).max() <= 1


def shown_speckle(slopes, seed=0, pixel_mm=0.2) -> np.ndarray:
    """Developed speckle from dark to bright, by a grey map with these slopes."""
    random = np.random.default_rng(seed)
    parts = [ndimage.gaussian_filter(random.normal(size=(400, 500)), (1.2, 2.5)) for _ in range(2)]
    power = parts[0] ** 2 + parts[1] ** 2
    level = 10.0 * np.log10(power / power.mean()) + np.linspace(-42.0, -8.0, 500)
    table = grey_table(even_display(map_black=slopes[0], map_dark=slopes[1], map_white=slopes[2]))
    return np.interp(1.0 + level / 60.0, np.linspace(0, 1, TABLE_SIZE), table).round().astype(np.uint8)


@pytest.mark.parametrize(
    "slopes",
    [(0.5, 0.75, 1.6), *(pytest.param(s, marks=pytest.mark.slow) for s in ((1.0, 1.0, 1.0), (0.25, 0.7, 0.9)))],
)
def test_the_grey_map_is_found_in_images_alone(slopes):
    found = estimate_grey_map([shown_speckle(slopes, seed) for seed in range(4)], (0.2, 0.2))
    for grey in (45.0, 60.0, 80.0, 100.0, 160.0, 180.0):
        wanted = slope_at(np.array([grey, 130.0]), slopes)
        assert found.at(grey) == pytest.approx(float(wanted[0] / wanted[1]), rel=0.15)
    assert found.map_dark == pytest.approx(slopes[1], rel=0.15)
    assert set(found.changes()) == {"map_black", "map_dark", "map_white"}


def test_a_grey_map_needs_several_levels():
    with pytest.raises(SimulationError, match="too few grey levels"):
        estimate_grey_map([np.full((200, 200), 80, np.uint8)], (0.2, 0.2))
    with pytest.raises(SimulationError, match="no image"):
        estimate_grey_map([], (0.2, 0.2))


@needs_shared
@pytest.mark.slow
def test_the_grey_maps_of_two_scanners_are_those_found_by_trial():
    """A brain, and a spine phantom as the control: another scanner, another map."""
    greys = (15, 30, 45, 60, 80, 100, 160, 200)
    sequence = TrackedSequence.read(SHARED / "SpinePhantomFreehand.igs.mha")
    from SlicerUSSim.Logic.tracked.imaged_field import estimate_field

    field = estimate_field(sequence.images, (0.1, 0.1))
    images = [np.ascontiguousarray(image[field.window]) for image in sequence.images[::4]]
    phantom = estimate_grey_map(images, (0.1, 0.1), field.mask[field.window])
    found = np.array([phantom.at(grey) for grey in greys])
    np.testing.assert_allclose(found, (0.18, 0.36, 0.55, 0.71, 0.91, 0.95, 0.98, 0.87), atol=0.19)
    if not (SHARED / "brain_sweep").is_dir():
        pytest.skip("the real sweep is missing")
    from SlicerUSSim.Logic.base.files import read_json

    probe = probe_from_dict(read_json(SHARED / "brain_sweep" / "probe.json"), "probe")
    brain = TrackedImages.of(TrackedSequence.read(SHARED / "brain_sweep" / "brain_sweep.igs.mha"), probe=probe)
    estimate = estimate_grey_map(brain.images[::3], brain.grid.pixel_spacing_mm, brain.mask)
    found = np.array([estimate.at(grey) for grey in greys])
    np.testing.assert_allclose(found, (0.54, 0.55, 0.62, 0.71, 0.81, 0.93, 1.14, 1.35), atol=0.12)


@pytest.mark.slow
def test_fits_find_what_the_console_does(solid):
    """Smoothing, map and a slider of the true image, from their defaults, each free by its own name."""
    probe, pose = LinearProbe(24, 30, scan_lines=64), rigid(np.eye(3), [0, -30, 0])
    truth = DisplaySettings(
        look="even", map_dark=0.5, map_white=1.5, depth_gain_6_db=8.0, smoothing_axial_mm=0.12, image_size=(150, 120)
    )
    image = solid.simulate(probe, pose, truth).image
    result = optimize_appearance(
        solid, probe, [pose], [image], display=even_display(image_size=(150, 120)), max_evaluations=250,
        free=["map_dark", "map_white", "depth_gain_6_db", "smoothing_axial_mm"], restarts=0,
    )  # fmt: skip
    assert result.cost_after < 0.25 * result.cost_before
    assert result.display.depth_gain_6_db == pytest.approx(8.0, abs=1.5)
    assert result.display.smoothing_axial_mm == pytest.approx(0.12, abs=0.04)


def test_bases_of_a_fit_have_the_console(small):
    model = AppearanceModel(small, SMALL, [POSE], {"more": ["mu0"]})
    display = replace(EVERYTHING, noise_db=None)
    expected = small.simulate(SMALL, POSE, display, model.grid(display)).image
    assert (np.abs(model.image(0, small.medium.tissues, display).astype(int) - expected) <= 1).mean() > 0.999


def test_persistence_keeps_a_part_of_the_last_images():
    """Of a point that is gone, half stays in each next image; a still scene is shown as it is."""
    labels = block(lambda x, y, z: 1 + (np.abs(y - 5.0) < 2.0), half_mm=(20, 20, 8))
    made = UltrasoundSimulator(labels, TissueTable.named(["liver", "bone"]))
    probe, pose = LinearProbe(20, 30, scan_lines=64), rigid(np.eye(3), [0.0, -18.0, 0.0])
    away = rigid(np.eye(3), [0.0, -18.0, 2.0])
    still = even_display(image_size=(120, 80))
    lasting = replace(still, persistence=0.5)
    plain = [made.simulate(probe, at, still).image.astype(float) for at in (pose, away)]
    shown = [made.simulate(probe, at, lasting).image.astype(float) for at in (pose, pose, away, away, away)]
    np.testing.assert_array_equal(shown[0], plain[0])
    np.testing.assert_array_equal(shown[1], plain[0])
    for number, part in ((2, 0.5), (3, 0.25), (4, 0.125)):
        np.testing.assert_allclose(shown[number], part * plain[0] + (1.0 - part) * plain[1], atol=0.51)
    assert np.abs(plain[0] - plain[1]).max() > 20.0
    # Another probe, another size and no persistence begin anew
    small = replace(lasting, image_size=(60, 40))
    first = made.simulate(probe, pose, small).image
    np.testing.assert_array_equal(first, made.simulate(probe, pose, replace(small, persistence=0.0)).image)
    np.testing.assert_array_equal(made.simulate(probe, pose, lasting).image, plain[0])


def test_the_look_of_a_scanner_falls_off_with_depth_and_at_the_edges(solid):
    """Controls add to it, and it does not change with the depth of the image or jump with a radius."""
    display, depth = DisplaySettings(noise_db=None), np.array([10.0, 60.0])
    for name, fall_db in (("phased", 20.0), ("abdominal", 4.0), ("linear", 4.0)):
        near, far = gains_along(display, PROBES[name], depth * (0.5 if name == "linear" else 1.0))
        across = gains_across(display, PROBES[name], 101)
        assert near - far > fall_db and across[50] > across[[0, -1]].max()
    deeper = replace(PROBES["phased"], depth_mm=180.0)
    np.testing.assert_allclose(gains_along(display, deeper, depth), gains_along(display, PROBES["phased"], depth))
    radii = [gains_along(display, replace(PROBES["convex"], radius_mm=r), depth) for r in np.arange(10.0, 60.0, 0.5)]
    assert np.abs(np.diff(radii, axis=0)).max() < 0.5
    straight, trapezoid = (replace(PROBES["linear"], trapezoid_deg=angle) for angle in (0.0, 1.0))
    np.testing.assert_allclose(gains_along(display, straight, depth), gains_along(display, trapezoid, depth))
    sliders = gains_along(replace(display, near_gain_db=-6.0), PROBES["phased"], np.zeros(1))
    assert sliders == gains_along(display, PROBES["phased"], np.zeros(1)) - 6.0
    assert not gains_along(even_display(), PROBES["phased"], depth).any()
