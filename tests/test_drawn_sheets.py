"""Sheets found in an MRI, as images draw them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from SlicerUSSim.Command.sheet_options import DrawnSheets
from SlicerUSSim.Logic import SimulationError, TissueTable, UltrasoundSimulator, Volume
from SlicerUSSim.Logic.imaging.found_sheets import beside_image
from SlicerUSSim.Logic.mri.sheets.polydata import write_surfels
from SlicerUSSim.Logic.tissue import Surfels
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.sheet_looks import looks_of, with_dura
from tests.conftest import block
from validation import sulci
from validation.phantoms import layered


def plane(kind: str, probe_to_ras: np.ndarray, depth_mm: float = 15.0, confidence: float = 1.0) -> Surfels:
    """A plane of surfels across the beam."""
    across = np.arange(-25.0, 25.0, 0.8)
    x, z = (grid.ravel() for grid in np.meshgrid(across, across))
    place = np.stack([x, np.full_like(x, depth_mm), z], axis=1) @ probe_to_ras[:3, :3].T + probe_to_ras[:3, 3]
    return Surfels.of(kind, place, np.broadcast_to(probe_to_ras[:3, 1], place.shape), 0.4, confidence, 0.64)


def grey(rotation: np.ndarray | None = None, layers=None, borders=(15.0,)):
    layers = layers or [sulci._GREY, sulci._GREY]
    phantom = layered(layers, list(borders), rotation, spacing_mm=1.0, half_width_mm=26.0, half_thickness_mm=26.0)
    return phantom, TissueTable({**phantom.tissues, 0: layers[0]}, sulci._MEMBRANE)


def level_db(simulator: UltrasoundSimulator, pose: np.ndarray, angle_deg: float, seeds: int = 3) -> float:
    """Mean level about a plane 15 mm deep, seen at an angle, re grey matter."""
    angle, turned = np.radians(angle_deg), np.eye(4)
    turned[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    turned[:3, 3] = [0.0, 15.0, 0.0] - turned[:3, :3] @ [0.0, 15.0, 0.0]
    power, settings = [], simulator.settings
    for seed in range(seeds):
        simulator.settings = replace(settings, seed=seed)
        frame = simulator.simulate(sulci._PROBE, pose @ turned)
        depth = (np.arange(frame.iq.shape[1]) + 0.5) * frame.sample_interval_mm - 15.0
        aside = sulci._PROBE.line_positions()[:, None]
        near = np.abs(np.sin(angle) * aside + np.cos(angle) * depth) < 0.3
        near &= (np.abs(aside) < 9.0) & (np.abs(depth) < 9.0)
        power.append((np.abs(frame.iq[near]) ** 2).mean())
    simulator.settings = settings
    return float(10.0 * np.log10(np.mean(power) / sulci._GREY.scatterer_variance))


def test_a_sheet_echoes_as_a_thin_sulcus_of_labels_is_predicted():
    rotation = sulci.Rotation.from_euler("xz", (26.0, 15.0), degrees=True).as_matrix()
    phantom, tissues = grey(rotation)
    surfels = plane("sulcus", phantom.probe_to_ras)
    simulator = UltrasoundSimulator(phantom.labels, tissues, sulci._SETTINGS, sheets=surfels)
    predicted = dict(zip(sulci._ANGLES_DEG, sulci._predicted_db("sulcus"), strict=True))
    for angle in (0.0, 60.0):
        assert level_db(simulator, phantom.probe_to_ras, angle) == pytest.approx(predicted[angle], abs=2.0)


def test_confidence_scales_the_amplitude():
    phantom, tissues = grey()
    levels = []
    for confidence in (1.0, 0.5):
        surfels = plane("sulcus", phantom.probe_to_ras, confidence=confidence)
        simulator = UltrasoundSimulator(phantom.labels, tissues, sulci._SETTINGS, sheets=surfels)
        levels.append(level_db(simulator, phantom.probe_to_ras, 0.0))
    assert levels[0] - levels[1] == pytest.approx(6.0, abs=0.5)


def test_found_walls_fade_with_the_angle_more_than_sulci():
    phantom, tissues = grey()
    membrane = replace(sulci._MEMBRANE, diffuse_exponent=3.0, sheet_exponent=1.0)
    fade = {}
    for kind in ("ependyma", "sulcus"):
        surfels = plane(kind, phantom.probe_to_ras)
        simulator = UltrasoundSimulator(
            phantom.labels, tissues.with_membrane(membrane), sulci._SETTINGS, sheets=surfels
        )
        square, oblique = (level_db(simulator, phantom.probe_to_ras, angle) for angle in (0.0, 45.0))
        fade[kind] = square - oblique
    # cos^3 against cos: 3 dB for every exponent of the power at 45 degrees
    assert fade["ependyma"] - fade["sulcus"] == pytest.approx(6.0, abs=1.0)


def test_dura_has_a_coherent_echo_that_is_seen_square_only():
    phantom, tissues = grey()
    mirror = replace(sulci._SETTINGS, interfaces=True, scattering=False)
    surfels = plane("falx", phantom.probe_to_ras)
    simulator = UltrasoundSimulator(phantom.labels, tissues, mirror, sheets=surfels)
    square = level_db(simulator, phantom.probe_to_ras, 0.0, seeds=1)
    assert square > 20.0 and level_db(simulator, phantom.probe_to_ras, 20.0, seeds=1) < square - 20.0
    # As a border of the same reflection coefficient and roughness, here of a wall with the membrane
    r = looks_of(tissues)["falx"].reflection
    dense = replace(sulci._GREY, impedance_mrayl=sulci._GREY.impedance_mrayl * (1.0 + r) / (1.0 - r))
    fluid = replace(dense, name="csf", mu0=0.0, sigma0=0.0)
    wall, of_wall = grey(layers=[sulci._GREY, fluid])
    border = level_db(UltrasoundSimulator(wall.labels, of_wall, mirror), wall.probe_to_ras, 0.0, seeds=1)
    assert square == pytest.approx(border, abs=1.5)


def test_dura_is_a_separate_tissue_whose_level_a_fit_can_change():
    phantom, tissues = grey()
    surfels = Surfels.joined([plane(kind, phantom.probe_to_ras, at) for kind, at in (("falx", 15.0), ("sulcus", 8.0))])
    simulator = UltrasoundSimulator(phantom.labels, tissues, sulci._SETTINGS, sheets=surfels)
    table = simulator.medium.tissues
    assert table.tissue("falx") == TISSUES["falx"] and "falx" not in tissues.names()

    def change_db(depth_mm: float, **changed) -> float:
        """By how much the level about this depth changes with the mu0 of tissues."""
        power = []
        for values in (table, louder(table, changed)):
            with simulator.with_tissues(values):
                frame = simulator.simulate(sulci._PROBE, phantom.probe_to_ras)
            depth = (np.arange(frame.iq.shape[1]) + 0.5) * frame.sample_interval_mm
            power.append((np.abs(frame.iq[:, np.abs(depth - depth_mm) < 0.3]) ** 2).mean())
        return float(10.0 * np.log10(power[1] / power[0]))

    def louder(values: TissueTable, changed: dict[str, float]) -> TissueTable:
        for name, factor in changed.items():
            tissue = values.tissue(name)
            values = values.replace(name, mu0=factor * tissue.mu0, sigma0=factor * tissue.sigma0)
        return values

    own = {"falx": 4.0}
    assert change_db(15.0, **own) == pytest.approx(12.0, abs=1.0) and abs(change_db(8.0, **own)) < 0.1
    other = {tissues.membrane.tissue.name: 4.0}
    assert abs(change_db(15.0, **other)) < 0.1 and change_db(8.0, **other) > 6.0
    # What a user has set stays, also as a preset's that has no voxels of it
    own_falx = replace(TISSUES["falx"], mu0=0.7)
    assert with_dura(tissues, ["falx"], tissues.with_tissue(own_falx)).tissue("falx") == own_falx
    assert with_dura(tissues, ["sulcus", "ependyma"]) is tissues
    # Not under the next label, which is another tissue's in label maps for which a preset with it is used
    label = table.label_of("falx")
    assert label == 62 and max(tissues) < label


def test_without_sheets_nothing_changes():
    phantom, tissues = grey(layers=[sulci._GREY, sulci._CSF])
    none = plane("sulcus", phantom.probe_to_ras).of_kind("falx")
    away = plane("sulcus", phantom.probe_to_ras, depth_mm=150.0)
    images = [
        UltrasoundSimulator(phantom.labels, tissues, sheets=sheets).simulate(sulci._PROBE, phantom.probe_to_ras).iq
        for sheets in (None, none, away)
    ]
    assert np.array_equal(images[0], images[1]) and np.array_equal(images[0], images[2])
    no_membrane = tissues.with_membrane(None)
    images = [
        UltrasoundSimulator(phantom.labels, no_membrane, sheets=s).simulate(sulci._PROBE, phantom.probe_to_ras).iq
        for s in (None, plane("ependyma", phantom.probe_to_ras))
    ]
    assert np.array_equal(images[0], images[1])


def test_sheets_in_another_frame_are_refused():
    phantom, tissues = grey()
    far = phantom.probe_to_ras.copy()
    far[:3, 3] += 1000.0
    with pytest.raises(SimulationError, match=r"the sheets lie \d+ mm outside the labels, expected those that were"):
        UltrasoundSimulator(phantom.labels, tissues, sheets=plane("falx", far))


def test_one_image_needs_the_sheets_beside_its_plane_alone():
    phantom, _ = grey()
    sheets = plane("sulcus", phantom.probe_to_ras)
    beside = beside_image(Surfels.joined([sheets, replace(sheets, place=sheets.place + np.float32(500.0))]),
                          phantom.probe_to_ras)  # fmt: skip
    away_mm = (sheets.place - phantom.probe_to_ras[:3, 3]) @ phantom.probe_to_ras[:3, 2]
    assert 0 < len(beside) == np.count_nonzero(np.abs(away_mm) <= 20.0)


def test_a_wall_is_drawn_once():
    phantom, tissues = grey(layers=[sulci._GREY, sulci._CSF])
    wall = plane("ependyma", phantom.probe_to_ras, 15.0)
    both = [
        level_db(UltrasoundSimulator(phantom.labels, tissues, sulci._SETTINGS, sheets=s), phantom.probe_to_ras, 0.0)
        for s in (None, wall)
    ]
    assert both[0] == pytest.approx(both[1], abs=1.5)  # twice would be 3 dB more, or two lines


def test_a_narrow_gap_is_closed_and_a_wide_one_stays():
    for width, is_closed in ((2.0, True), (8.0, False)):
        phantom, tissues = grey(layers=[sulci._GREY, sulci._CSF, sulci._GREY], borders=(15 - width / 2, 15 + width / 2))
        simulator = UltrasoundSimulator(
            phantom.labels, tissues, sulci._SETTINGS, sheets=plane("sulcus", phantom.probe_to_ras)
        )
        found = simulator.medium.found
        assert (found is not None) == is_closed
        if found is not None:
            csf = tissues.label_of("csf")
            assert (found.labels == csf).sum() < 0.2 * (phantom.labels.array == csf).sum()


def test_a_falx_does_not_hang_in_the_saline_of_an_opening():
    """It continues above the hull of the brain into the sinus, which is absent without the head."""
    labels = block(lambda x, y, z: (y > 0.0) & (np.abs(x) > 0.6), half_mm=(20, 20, 20))  # a fissure below coupling
    y, z = (grid.ravel() for grid in np.meshgrid(np.arange(-12.0, 12.0, 0.8), np.arange(-12.0, 12.0, 0.8)))
    place = np.stack([np.zeros_like(y), y, z], axis=1)
    falx = Surfels.of("falx", place, np.broadcast_to([1.0, 0.0, 0.0], place.shape), 0.6, 1.0, 0.64)
    tissues = TissueTable({0: TISSUES["coupling"], 1: TISSUES["grey matter"]}, TissueTable.brain().membrane)
    found = UltrasoundSimulator(labels, tissues, sheets=falx).medium.found
    voxels = np.stack(np.unravel_index(found.voxels, found.labels.shape), axis=1)
    at = voxels[:, 1] - 1 - 20.0  # y, mm
    assert at.max() > 10.0 and at.min() > -2.5


@pytest.mark.slow
def test_options_of_the_command(tmp_path):
    from SlicerUSSim.Command.cli import main

    array = np.full((34, 34, 34), 2, np.uint8)
    array[:4], array[4:10] = 1, 3
    Volume(array, np.eye(4)).write(tmp_path / "labels.nii.gz")
    (tmp_path / "pose.txt").write_text("1 0 0 17 0 0 1 17 0 -1 0 31 0 0 0 1")
    across = np.stack(np.meshgrid(np.arange(3.0, 30.0), np.arange(3.0, 30.0), [20.0]), -1).reshape(-1, 3)
    surfels = Surfels.of("sulcus", across, np.tile([0.0, 0.0, 1.0], (len(across), 1)), 1.0, 1.0, 1.0)
    write_surfels(tmp_path / "s.vtp", surfels)
    call = ["simulate", str(tmp_path / "labels.nii.gz"), "--map", "ussim", "--pose", str(tmp_path / "pose.txt")]
    sheets, images = ["--sheets", str(tmp_path / "s.vtp")], {}
    for name, more in (("none", []), ("file", sheets), ("off", [*sheets, "--set", "patient.no_sheets=sulcus"])):
        result = CliRunner().invoke(main, [*call, "-o", str(tmp_path / f"{name}.png"), *more])
        assert result.exit_code == 0, result.output
        images[name] = (tmp_path / f"{name}.png").read_bytes()
    assert images["none"] == images["off"] != images["file"]
    for given, without, message in (
        ("none", ("falx",), "give --sheets, too"), ("auto", ("dura",), "no_sheets is 'dura'"),
        ("auto", (), "a label map has no sheets"), ("nowhere.vtp", (), "no such file"),
        ("all", (), "expected a .vtp file, auto or none"),
    ):  # fmt: skip
        with pytest.raises(SimulationError, match=message):
            DrawnSheets.of(given, without, is_labels=True, contrast="t1")
