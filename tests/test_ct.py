"""segment_ct on phantoms whose tissues are known: agreement, no rims, units, refusals; and what ultrasound shows."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import ndimage

from SlicerUSSim.Command.cli import main as cli
from SlicerUSSim.Logic import (
    ConvexProbe,
    LinearProbe,
    SimulationError,
    SimulationSettings,
    TissueTable,
    UltrasoundSimulator,
    Volume,
    segment_ct,
    segment_mri,
)
from SlicerUSSim.Logic.base.errors import Cancelled
from SlicerUSSim.Logic.base.neighbourhood import largest_around
from SlicerUSSim.Logic.mri import head_mri
from SlicerUSSim.Logic.mri.ct_unit import hounsfield_offset, looks_like_ct
from SlicerUSSim.Logic.probe.poses import pose_looking_at
from SlicerUSSim.Logic.tissue import LabelledTissues, LabelMapping, read_label_map
from validation.ct_phantoms import BY_NUMBER, NAMES, CtPhantom, lower_chest, lumbar_spine


@cache
def coarse() -> CtPhantom:
    """The spine in voxels of 3 mm, where the place of tissues is not what is asked; nobody changes it."""
    return lumbar_spine((3.0, 3.0, 3.0))


@pytest.fixture(scope="module")
def spine() -> CtPhantom:
    return lumbar_spine((1.2, 1.2, 2.0))


@pytest.fixture(scope="module")
def chest() -> CtPhantom:
    return lower_chest((1.5, 1.5, 2.5))


@pytest.fixture(scope="module")
def spine_found(spine):
    return segment_ct(spine.ct)


@pytest.fixture(scope="module")
def chest_found(chest):
    return segment_ct(chest.ct)


def dice(phantom: CtPhantom, found, name: str) -> float:
    """Of a tissue, with what the numbers alone cannot tell from it."""
    alike = [label for label, own in enumerate(NAMES, 1) if BY_NUMBER.get(own, own) == name]
    truth = np.isin(phantom.truth.array, alike)
    labelled = found.labels.array == found.tissue_names.index(name) + 1
    return 2.0 * (truth & labelled).sum() / (truth.sum() + labelled.sum())


def of(found, name: str) -> np.ndarray:
    return found.labels.array == found.tissue_names.index(name) + 1


@pytest.mark.parametrize(
    ("name", "least"),
    [("skin", 0.9), ("fat", 0.96), ("muscle", 0.98), ("blood", 0.9), ("cancellous bone", 0.92), ("bone", 0.85)],
)
def test_a_spine_has_its_tissues(spine, spine_found, name, least):
    assert dice(spine, spine_found, name) > least


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "least"), [("fat", 0.95), ("muscle", 0.95), ("blood", 0.97), ("bone", 0.8), ("lung", 0.99), ("air", 0.95)]
)
def test_a_chest_has_its_tissues(chest, chest_found, name, least):
    assert dice(chest, chest_found, name) > least


def test_the_couch_is_left_out_although_the_back_lies_on_it(spine, spine_found):
    outside = spine.truth.array == 0
    couch = outside & (spine.ct.array > -300)
    assert couch.sum() > 5000
    assert (spine_found.labels.array[couch] > 0).mean() < 0.01


def test_borders_have_no_rim_of_a_third_tissue():
    """Air to muscle passes through lung and fat, bone to muscle through contrast agent."""
    spacing_mm = (0.7, 0.7, 2.5)
    shape = tuple(int(60 / mm) for mm in spacing_mm[::-1])
    grid = Volume(np.zeros(shape, np.int16), np.diag([*spacing_mm, 1.0]))
    k, j, i = np.meshgrid(
        *(np.arange(n) * mm - 30.0 for n, mm in zip(shape, spacing_mm[::-1], strict=True)), indexing="ij"
    )
    share = lambda radius: np.clip((radius - np.hypot(np.hypot(i, j), k)) / 1.2 + 0.5, 0.0, 1.0)  # noqa: E731
    hu = -1000.0 + 1055.0 * share(28.0) + 1345.0 * (share(18.0) - share(12.0))
    hu += np.random.default_rng(2).normal(0.0, 20.0, shape)
    found = segment_ct(grid.with_array(hu.astype(np.int16)), skin_mm=0.0)
    counts = {name: int(of(found, name).sum()) for name in found.tissue_names}
    surface = (largest_around(found.labels.array == 0) & (found.labels.array > 0)).sum()
    assert surface > 10000
    assert sum(counts.get(name, 0) for name in ("fat", "lung", "air")) < 0.01 * surface
    assert counts.get("blood", 0) < 0.015 * counts["bone"]
    assert {"muscle", "bone", "cancellous bone"} <= set(counts)


def test_a_facet_joint_stays_open(spine, spine_found):
    """Two millimetres between the articular processes, in the middle of their height."""
    to_ijk = spine.ct.ras_to_ijk
    across = np.array([0.7, 0.7, 0.0]) / np.hypot(0.7, 0.7)
    hard = of(spine_found, "bone") | of(spine_found, "cancellous bone")
    rows = []
    for z in (-19.0, -17.0, 17.0, 19.0):
        points = np.array([17.4, -32.5, z]) + np.arange(-5.0, 5.0, 0.25)[:, None] * across
        i, j, k = np.rint(to_ijk[:3, :3] @ points.T + to_ijk[:3, 3:]).astype(int)
        rows.append(hard[k, j, i])
    open_mm = [0.25 * (~row[8:32]).sum() for row in rows]
    assert all(row[:6].all() and row[-6:].all() for row in rows)
    assert all(0.7 <= gap <= 3.0 for gap in open_mm)


@pytest.mark.slow
def test_organs_replace_muscle_and_blood_but_not_fat_and_bone(chest, chest_found):
    organs = read_label_map(chest.organs, mapping=LabelMapping.of(["totalsegmentator"]))
    found = segment_ct(chest.ct, organs=organs)
    for name in ("liver", "kidney"):
        truth = chest.truth.array == NAMES.index(name) + 1
        assert 2.0 * (truth & of(found, name)).sum() / (truth.sum() + of(found, name).sum()) > 0.97
    for name in ("fat", "bone", "lung", "air"):
        np.testing.assert_array_equal(of(found, name), of(chest_found, name))
    assert any("--organs" in line for line in chest_found.warnings) and not found.warnings


@pytest.mark.slow
def test_organs_are_resampled_and_those_of_another_place_refused(chest):
    organs = read_label_map(chest.organs, mapping=LabelMapping.of(["totalsegmentator"]))
    half = Volume(organs.labels.array[::2, ::2, ::2], chest.ct.ijk_to_ras @ np.diag([2.0, 2.0, 2.0, 1.0]))
    found = segment_ct(chest.ct, organs=replace(organs, labels=half))
    assert (of(found, "liver") & (chest.truth.array == NAMES.index("liver") + 1)).sum() > 0.9 * of(found, "liver").sum()
    away = half.ijk_to_ras.copy()
    away[0, 3] += 1000.0
    with pytest.raises(SimulationError, match="does not meet the CT"):
        segment_ct(chest.ct, organs=replace(organs, labels=Volume(half.array, away)))


def moved(organs: LabelledTissues, *, factors=(1.0, 1.0, 1.0), shift_mm=(0.0, 0.0, 0.0)) -> LabelledTissues:
    matrix = np.diag([*factors, 1.0])
    matrix[:3, 3] = shift_mm
    return replace(organs, labels=Volume(organs.labels.array, matrix @ organs.labels.ijk_to_ras))


@pytest.mark.slow
def test_organs_of_another_patient_are_refused_by_the_numbers_of_the_ct():
    chest, spine = lower_chest((2.0, 2.0, 2.0)), lumbar_spine((2.0, 2.0, 2.0))
    in_chest, in_spine = (
        read_label_map(phantom.organs, mapping=LabelMapping.of("totalsegmentator")) for phantom in (chest, spine)
    )
    for ct, organs, message in (
        (
            spine.ct,
            in_chest,
            r"organs: liver: \d\d% of it is free of bone in the CT, expected 97% or more; give",
        ),
        (chest.ct, in_spine, r"organs: bone: 0% of its surface is beside bone in the CT, expected 70% or more; give"),
        (chest.ct, moved(in_chest, factors=(-1.0, 1.0, 1.0)), r"organs: kidney: 4\d% of it is soft tissue in the CT"),
        (chest.ct, moved(in_chest, shift_mm=(60.0, 0.0, 0.0)), r"organs: kidney: \d+% of it is soft tissue"),
        (chest.ct, moved(in_chest, shift_mm=(0.0, 0.0, -60.0)), r"organs: lung: \d+% of it is gas or lung in the CT"),
        (spine.ct, moved(in_spine, shift_mm=(0.0, 30.0, 0.0)), r"organs: bone: \d\d% of its surface is beside bone"),
    ):
        with pytest.raises(SimulationError, match=message):
            segment_ct(ct, organs=organs)
    doubtful = segment_ct(chest.ct, organs=moved(in_chest, shift_mm=(0.0, 30.0, 0.0)))
    assert any("organs: liver: 8" in line and "is the label map of this CT" in line for line in doubtful.warnings)
    assert not any("of this CT" in line for line in segment_ct(chest.ct, organs=in_chest).warnings)


# ---- units and bad input ---------------------------------------------------------------------------------------------


def test_an_offset_is_removed_and_reported():
    ct, offset = coarse().ct, 1024
    found = segment_ct(ct.with_array(np.maximum(ct.array + offset, 0).astype(np.uint16)))
    assert f"{offset} is subtracted" in found.notes[0]
    assert (found.labels.array == segment_ct(ct).labels.array).mean() > 0.9999


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a / 1000.0, "expected Hounsfield units"),
        (lambda a: np.clip(a, -160, 240), "was cut to a window"),
        (lambda a: (np.clip(a, -160, 240) + 160) / 400.0 * 255.0, "for an MRI leave --ct out"),
        (lambda a: np.minimum(a, 400.0), "values end at 400, which .* voxels have: the CT was cut to a window"),
        (lambda a: a + 200.0, r"air is at -80\d, expected -1000: the values are \+(199|200|201) from"),
        (lambda a: np.where(a > 900, np.nan, a), "not finite numbers.*by -1000"),
        (lambda a: np.where(np.indices(a.shape).sum(axis=0) % 40 < 2, a, -1000.0 - a % 7), "shows no body"),
    ],
)  # fmt: skip
def test_what_is_no_ct_is_refused_with_what_it_is(change, message):
    ct = coarse().ct
    with pytest.raises(SimulationError, match=message):
        segment_ct(ct.with_array(change(ct.array.astype(np.float32))))


@pytest.mark.slow
def test_lungs_without_air_around_the_body_are_no_air(chest):
    smooth = ndimage.gaussian_filter(chest.ct.array.astype(np.float32), 1.5)
    within = smooth[:, 30:90, 30:137]
    offset, line, doubt = hounsfield_offset(Volume(within, chest.ct.ijk_to_ras))
    assert (offset, line) == (0.0, None) and doubt is not None and "no air is in the image" in doubt
    with pytest.raises(SimulationError, match=r"air is at -\d+, expected -1000: the values are \+\d+ from"):
        hounsfield_offset(chest.ct.with_array(chest.ct.array.astype(np.float32) + 151.0))


@pytest.mark.slow
def test_padding_around_a_round_field_of_view_is_no_unit(chest, chest_found):
    padding = -3024.0
    j, i = np.indices(chest.ct.array.shape[1:])
    middle = 0.5 * (np.array(chest.ct.array.shape[1:]) - 1)
    outside = np.hypot(j - middle[0], i - middle[1]) > 0.45 * chest.ct.array.shape[1]
    cut = chest.ct.with_array(np.where(outside, padding, chest.ct.array).astype(np.float32))
    assert hounsfield_offset(cut)[0] == 0.0
    found = segment_ct(cut)
    ours, whole = (np.array(["", *one.tissue_names])[one.labels.array] for one in (found, chest_found))
    same = ours == whole
    inner = ndimage.binary_erosion(~outside, iterations=8)
    assert same[:, inner].mean() > 0.995
    assert not found.labels.array[:, outside].any() and f"of the image is {padding:g}, outside" in found.notes[0]


def test_an_mri_called_ct_is_refused():
    head = head_mri(4.0)
    for scale in (1.0, 9.0, 20.0):
        scaled = head.with_array((head.array * scale).astype(np.float32))
        assert not looks_like_ct(scaled)
        with pytest.raises(SimulationError, match="leave --ct out"):
            segment_ct(scaled)


def test_a_label_map_called_ct_is_refused():
    with pytest.raises(SimulationError, match="CT is a label map"):
        segment_ct(coarse().organs)
    with pytest.raises(SimulationError, match="ct is a str, expected a Volume"):
        segment_ct("ct.nii.gz")  # type: ignore[arg-type]


def test_a_ct_called_mri_is_refused_with_the_option():
    phantom = coarse()
    for mri, mask in (
        (phantom.ct, None),
        (phantom.ct, phantom.ct.with_array((phantom.truth.array > 0).astype(np.uint8))),
    ):
        with pytest.raises(SimulationError, match="segment a CT with --ct"):
            segment_mri(mri, mask=mask)
    with pytest.raises(SimulationError, match="contrast is ct"):
        segment_mri(head_mri(4.0), contrast="ct")


def test_a_mask_says_where_the_patient_is():
    phantom = coarse()
    half = (phantom.truth.array > 0).astype(np.uint8)
    half[:, :, : half.shape[2] // 2] = 0
    found = segment_ct(phantom.ct, mask=phantom.ct.with_array(half))
    np.testing.assert_array_equal(found.labels.array > 0, half > 0)
    with pytest.raises(SimulationError, match="different grids"):
        segment_ct(phantom.ct, mask=Volume(half[:-1], phantom.ct.ijk_to_ras))


def test_it_reports_progress_and_can_be_cancelled():
    shares, ct = [], coarse().ct
    segment_ct(ct, progress=shares.append)
    assert shares == sorted(shares) and shares[-1] == 1.0 and len(shares) > 4

    def cancel(share: float) -> None:
        if share > 0.4:
            raise Cancelled

    with pytest.raises(Cancelled):
        segment_ct(ct, progress=cancel)


# ---- doors -----------------------------------------------------------------------------------------------------------


def test_the_command_segments_a_ct_with_organs(tmp_path, spine, capsys):
    spine.ct.write(tmp_path / "ct.nii.gz")
    spine.organs.write(tmp_path / "organs.nii.gz")
    with pytest.raises(SystemExit) as ended:
        cli(
            ["segment", str(tmp_path / "ct.nii.gz"), "--ct", "--organs", str(tmp_path / "organs.nii.gz"), "--map",
             "totalsegmentator", "-o", str(tmp_path / "labels.nii.gz")]
        )  # fmt: skip
    assert ended.value.code == 0
    assert "cancellous bone" in capsys.readouterr().out
    table = TissueTable.read(tmp_path / "labels.json")
    assert {"skin", "cancellous bone", "bone"} <= set(table.names())
    assert table.membrane is not None and "coupling" not in table.membrane.fluids


def test_a_mask_of_one_organ_is_not_a_lesion(tmp_path, capsys):
    """TotalSegmentator writes a file for each."""
    phantom, name, organ = coarse(), "kidney_left", "kidney"
    phantom.ct.write(tmp_path / "ct.nii.gz")
    Volume((phantom.organs.array > 0).astype(np.uint8), phantom.organs.ijk_to_ras).write(tmp_path / f"{name}.nii.gz")
    files = [str(tmp_path / "ct.nii.gz"), "--ct", "--organs", str(tmp_path / f"{name}.nii.gz")]
    with pytest.raises(SystemExit) as ended:
        cli(["segment", *files, "-o", str(tmp_path / "labels.nii.gz")])
    told = capsys.readouterr().err
    assert ended.value.code == 2 and ": a binary mask (" in told
    assert told.rstrip().endswith(f"say which organ it is with --map 1={organ}")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--ct", "--thin-sulci"], "--thin-sulci is for an MRI"),
        (["--organs", "x.nii.gz", "--skull-strip", "none"], "--organs is for a CT, expected --ct"),
    ],
)
def test_the_command_refuses_what_does_not_go_together(tmp_path, capsys, options, message):
    coarse().ct.write(tmp_path / "ct.nii.gz")
    with pytest.raises(SystemExit) as ended:
        cli(["segment", str(tmp_path / "ct.nii.gz"), "-o", str(tmp_path / "labels.nii.gz"), *options])
    assert ended.value.code == 2
    assert message in capsys.readouterr().err.replace("\n", " ")


def test_the_filter_segments_a_ct():
    from SlicerUSSim.Logic.vtk import SegmentationFilter

    ct, labels = coarse().ct, SegmentationFilter()
    labels.SetInputData(ct.to_vtk())
    labels.SetContrast("ct")
    labels.Update()
    np.testing.assert_array_equal(Volume.from_vtk(labels.GetOutput()).array, segment_ct(ct).labels.array)


# ---- ultrasound ------------------------------------------------------------------------------------------------------


def levels_db(phantom_found, probe, face, target, lateral) -> tuple[np.ndarray, float]:
    """((scan lines, samples) envelope in dB, sample interval in mm)"""
    tissues = TissueTable.named(phantom_found.tissue_names)
    settings = SimulationSettings(beam="ray")
    simulator = UltrasoundSimulator(phantom_found.labels, tissues, settings, texture=phantom_found.texture())
    frame = simulator.simulate(probe, pose_looking_at(face, target, lateral))
    return 20.0 * np.log10(np.maximum(frame.envelope, 1e-9)), frame.sample_interval_mm


@pytest.mark.slow
@pytest.mark.parametrize(("frequency_mhz", "attenuation"), [(2.5, 40.0), (4.0, 14.0), (8.0, 2.0)])
def test_the_attenuation_of_marrow_changes_nothing_in_front_of_it(spine, attenuation, frequency_mhz):
    """Brightest in this view are the cortex and what lies before it, whatever the marrow behind takes."""
    table = TissueTable.named([BY_NUMBER.get(name, name) for name in NAMES])
    table = table.replace("cancellous bone", attenuation_db_cm_mhz=attenuation)
    probe = ConvexProbe(radius_mm=50, field_of_view_deg=64, depth_mm=110, frequency_mhz=frequency_mhz, focus_mm=50)
    simulator = UltrasoundSimulator(spine.truth, table)
    for z in (-17.0, 0.0):
        pose = pose_looking_at((8.0, -69.0, z), (0.0, -35.0, z), (1.0, 0.0, 0.3))
        found = {}
        for beam in ("aperture", "ray"):
            simulator.settings = SimulationSettings(beam=beam)
            tree = simulator.trace(probe, pose)
            assert tree.hits["attenuation"].max() < 1.2 and tree.segments["attenuation"].max() < 1.2
            found[beam] = 20.0 * np.log10(simulator.simulate(probe, pose).envelope.max())
        assert found["aperture"] == pytest.approx(found["ray"], abs=3.0)


@pytest.mark.slow
def test_ribs_cast_shadows_and_lung_is_a_bright_line_between_them(chest_found):
    probe = LinearProbe(width_mm=48, depth_mm=50, frequency_mhz=6.0, focus_mm=25)
    level, mm = levels_db(chest_found, probe, (120.5, 0.0, 46.0), (0.0, 0.0, 46.0), (0.0, 0.0, -1.0))
    z = 46.0 - np.linspace(-24.0, 24.0, len(level))
    on_rib = np.min(np.abs(z[:, None] - (-75.0 + 24.0 * np.arange(8))), axis=1) < 2.0
    between = np.min(np.abs(z[:, None] - (-63.0 + 24.0 * np.arange(8))), axis=1) < 3.0
    part = lambda lines, low, high: level[lines][:, int(low / mm) : int(high / mm)]  # noqa: E731
    tissue = np.median(part(between, 22.0, 26.0))
    assert np.median(part(on_rib, 13.0, 20.0).max(axis=1)) > tissue + 10.0
    # The shadow holds the mirror image of the wall, down to twice the rib's depth of 14 mm or so. Beams 16 mm behind a
    # rib with radii of 10 mm across and 100 mm along it (r = 0.6) are 4.2 and 1.3 times as wide: -4.4 - 6.2 - 1.2 dB.
    assert np.median(part(on_rib, 28.0, 32.0)) == pytest.approx(tissue - 11.8, abs=2.5)
    assert np.median(part(on_rib, 36.0, 40.0)) < tissue - 20.0
    assert np.median(part(between, 26.0, 31.0).max(axis=1)) > tissue + 15.0


@pytest.mark.slow
def test_the_spinous_process_casts_a_shadow(spine_found):
    probe = ConvexProbe(radius_mm=50, field_of_view_deg=50, depth_mm=90, frequency_mhz=4.0, focus_mm=40)
    level, mm = levels_db(spine_found, probe, (0.0, -69.0, -2.0), (0.0, 0.0, -2.0), (1.0, 0.0, 0.0))
    middle, side = len(level) // 2, len(level) // 16
    at = slice(int(45.0 / mm), int(60.0 / mm))
    assert np.median(level[middle - 3 : middle + 3, at]) < np.median(level[:side, at]) - 20.0


def test_an_automatic_pose_on_a_ct_is_refused(tmp_path, capsys):
    coarse().ct.write(tmp_path / "ct.nii.gz")
    with pytest.raises(SystemExit) as ended:
        cli(["simulate", str(tmp_path / "ct.nii.gz"), "--ct", "--pose", "auto", "-o", str(tmp_path / "x.png")])
    assert ended.value.code == 2
    told = capsys.readouterr().err.replace("\n", " ")
    assert "--pose is auto, which is on a head, and the image is a CT" in told
