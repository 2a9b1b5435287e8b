"""segment_ct on phantoms whose tissues are known: agreement, no rims, units, refusals; and what ultrasound shows."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from unittest.mock import Mock

import numpy as np
import pytest
from scipy import ndimage

from SlicerUSSim.Command.cli import main as cli
from SlicerUSSim.Logic import LinearProbe, SimulationSettings, TissueTable, UltrasoundSimulator, segment_ct, segment_mri
from SlicerUSSim.Logic.base.errors import Cancelled, SimulationError
from SlicerUSSim.Logic.base.neighbourhood import largest_around
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri import CtSegmentation, head_mri
from SlicerUSSim.Logic.mri.ct_unit import why_ct
from SlicerUSSim.Logic.mri.modality import segment_image
from SlicerUSSim.Logic.probe.poses import pose_looking_at
from SlicerUSSim.Logic.tissue import LabelledTissues, LabelMapping, read_label_map
from tests.conftest import coarse_chest
from validation.ct_phantoms import BY_NUMBER, NAMES, CtPhantom, lower_chest, lumbar_spine


@cache
def coarse() -> CtPhantom:
    """The spine in voxels of 3 mm, where the place of tissues is not tested; no test changes it."""
    return lumbar_spine((3.0, 3.0, 3.0))


@cache
def spine() -> tuple[CtPhantom, CtSegmentation]:
    phantom = lumbar_spine((1.2, 1.2, 2.0))
    return phantom, segment_ct(phantom.ct)


@cache
def chest() -> tuple[CtPhantom, CtSegmentation]:
    phantom = lower_chest((1.5, 1.5, 2.5))
    return phantom, segment_ct(phantom.ct)


def of(found, name: str) -> np.ndarray:
    return found.labels.array == found.tissue_names.index(name) + 1


def dice(phantom: CtPhantom, found, name: str) -> float:
    """Of a tissue, with what the numbers alone cannot tell from it."""
    truth = np.isin(phantom.truth.array, [n for n, own in enumerate(NAMES, 1) if BY_NUMBER.get(own, own) == name])
    return 2.0 * (truth & of(found, name)).sum() / (truth.sum() + of(found, name).sum())


def test_a_spine_has_its_tissues_and_no_couch():
    phantom, found = spine()
    least = {"skin": 0.9, "fat": 0.96, "muscle": 0.98, "blood": 0.9, "cancellous bone": 0.92, "bone": 0.85}
    assert [name for name, value in least.items() if dice(phantom, found, name) < value] == []
    couch = (phantom.truth.array == 0) & (phantom.ct.array > -300)
    assert couch.sum() > 5000 and (found.labels.array[couch] > 0).mean() < 0.01


@pytest.mark.slow
def test_a_chest_has_its_tissues():
    least = {"fat": 0.95, "muscle": 0.95, "blood": 0.97, "bone": 0.8, "lung": 0.99, "air": 0.95}
    assert [name for name, value in least.items() if dice(*chest(), name) < value] == []


def test_borders_have_no_rim_of_a_third_tissue():
    """Air to muscle passes through lung and fat, bone to muscle through contrast agent."""
    spacing_mm = (0.7, 0.7, 2.5)
    shape = tuple(int(60 / mm) for mm in spacing_mm[::-1])
    grid = Volume(np.zeros(shape, np.int16), np.diag([*spacing_mm, 1.0]))
    place = np.moveaxis(np.indices(shape), 0, -1) * spacing_mm[::-1] - 30.0
    share = lambda radius: np.clip((radius - np.linalg.norm(place, axis=-1)) / 1.2 + 0.5, 0.0, 1.0)  # noqa: E731
    hu = -1000.0 + 1055.0 * share(28.0) + 1345.0 * (share(18.0) - share(12.0))
    hu += np.random.default_rng(2).normal(0.0, 20.0, shape)
    found = segment_ct(grid.with_array(hu.astype(np.int16)), skin_mm=0.0)
    counts = {name: int(of(found, name).sum()) for name in found.tissue_names}
    surface = (largest_around(found.labels.array == 0) & (found.labels.array > 0)).sum()
    assert sum(counts.get(name, 0) for name in ("fat", "lung", "air")) < 0.01 * surface
    assert counts.get("blood", 0) < 0.015 * counts["bone"]


def test_a_facet_joint_stays_open():
    """Two millimetres between the articular processes, in the middle of their height."""
    to_ijk, hard = spine()[0].ct.ras_to_ijk, of(spine()[1], "bone") | of(spine()[1], "cancellous bone")
    for z in (-19.0, -17.0, 17.0, 19.0):
        points = np.array([17.4, -32.5, z]) + np.arange(-5.0, 5.0, 0.25)[:, None] * [np.sqrt(0.5), np.sqrt(0.5), 0.0]
        i, j, k = np.rint(to_ijk[:3, :3] @ points.T + to_ijk[:3, 3:]).astype(int)
        row = hard[k, j, i]
        assert row[:6].all() and row[-6:].all() and 0.7 <= 0.25 * (~row[8:32]).sum() <= 3.0


@pytest.mark.slow
def test_organs_replace_muscle_and_blood_but_not_fat_and_bone():
    phantom, without = chest()
    organs = read_label_map(phantom.organs, mapping=LabelMapping.of(["totalsegmentator"]))
    found = segment_ct(phantom.ct, organs=organs)
    for name in ("liver", "kidney"):
        truth = phantom.truth.array == NAMES.index(name) + 1
        assert (truth & of(found, name)).sum() > 0.485 * (truth.sum() + of(found, name).sum())
    for name in ("fat", "bone", "lung", "air"):
        np.testing.assert_array_equal(of(found, name), of(without, name))
    assert any("--organs" in line for line in without.notes) and not found.warnings
    half = Volume(organs.labels.array[::2, ::2, ::2], phantom.ct.ijk_to_ras @ np.diag([2.0, 2.0, 2.0, 1.0]))
    coarsely = of(segment_ct(phantom.ct, organs=replace(organs, labels=half)), "liver")
    assert (coarsely & of(found, "liver")).sum() > 0.9 * coarsely.sum()


def test_organs_in_another_place_cause_a_warning_or_are_refused():
    ct, organs = coarse_chest().ct, read_label_map(coarse_chest().organs, mapping=LabelMapping.of("totalsegmentator"))

    def moved(scale: float, shift_mm: float) -> LabelledTissues:
        matrix = np.diag([scale, 1.0, 1.0, 1.0])
        matrix[0, 3] = shift_mm
        return replace(organs, labels=Volume(organs.labels.array, matrix @ organs.labels.ijk_to_ras))

    for other in (moved(-1.0, 0.0), moved(1.0, 60.0)):
        lines = "\n".join(segment_ct(ct, organs=other).warnings)
        assert re.search(r"organs: kidney: \d+% of it is soft tissue in the CT, expected 85% or", lines)
    with pytest.raises(SimulationError, match="does not meet the CT"):
        segment_ct(ct, organs=moved(1.0, 1000.0))


def test_an_offset_is_removed_and_reported():
    ct = coarse().ct
    found = segment_ct(ct.with_array(np.maximum(ct.array + 1024, 0).astype(np.uint16)))
    assert "1024 is subtracted" in found.warnings[0] and why_ct(ct) == "its values are Hounsfield units"
    assert (found.labels.array == segment_ct(ct).labels.array).mean() > 0.9999


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a / 1000.0, "expected Hounsfield units"),
        (lambda a: np.clip(a, -160, 240), "that are not cut off"),
        (lambda a: (np.clip(a, -160, 240) + 160) / 400.0 * 255.0, "for an MRI give its contrast"),
        (lambda a: np.where(a > 900, np.nan, a), "not finite numbers.*by -1000"),
        (lambda a: np.where(np.indices(a.shape).sum(axis=0) % 40 < 2, a, -1000.0 - a % 7), "in the CT has 0 ml"),
    ],
)  # fmt: skip
def test_what_is_not_a_ct_is_refused_with_what_it_is(change, message):
    ct = coarse().ct
    with pytest.raises(SimulationError, match=message):
        segment_ct(ct.with_array(change(ct.array.astype(np.float32))))


def test_what_may_be_hounsfield_units_is_used_with_a_warning():
    ct, lungs = coarse().ct, coarse_chest().ct
    for image, message in (
        (Volume(lungs.array[:, 12:34, 25:50], lungs.ijk_to_ras), "without air at -1000"),
        (ct.with_array(np.minimum(ct.array, 400.0)), "no bone was found; the densest is 39"),
    ):
        assert any(message in line for line in segment_ct(image).warnings)


@pytest.mark.slow
def test_padding_around_a_round_field_of_view_is_not_an_unit():
    ct, without = chest()[0].ct, chest()[1]
    height, width = ct.array.shape[1:]
    j, i = np.indices((height, width))
    outside = np.hypot(j - 0.5 * (height - 1), i - 0.5 * (width - 1)) > 0.45 * height
    found = segment_ct(ct.with_array(np.where(outside, np.float32(-3024.0), ct.array)))
    ours, whole = (np.array(["", *one.tissue_names])[one.labels.array] for one in (found, without))
    assert (ours == whole)[:, ndimage.binary_erosion(~outside, iterations=8)].mean() > 0.995
    assert not found.labels.array[:, outside].any() and "of the image is outside" in found.notes[0]


def test_an_mri_or_labels_called_ct_are_refused():
    mri = head_mri(4.0)
    for image in (coarse().organs, *(mri.with_array(np.float32(scale) * mri.array) for scale in (1.0, 9.0, 20.0))):
        assert why_ct(image) is None
        with pytest.raises(SimulationError, match="for an MRI give its contrast"):
            segment_ct(image)


def test_a_ct_is_recognised_by_its_modality_or_its_numbers():
    ct = coarse().ct
    for image, why in (
        (ct, "its values are Hounsfield units"),
        (replace(ct, modality="CT"), "its DICOM modality is CT"),
    ):
        assert segment_image(image, contrast="t1").notes[0] == f"taken as a CT: {why}"
    assert why_ct(replace(ct, modality="MR")) is None
    with pytest.raises(SimulationError, match="the image is a CT"):
        segment_mri(ct)
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
    shares = []
    segment_ct(coarse().ct, progress=shares.append)
    assert shares == sorted(shares) and shares[-1] == 1.0 and len(shares) > 3
    with pytest.raises(Cancelled):
        segment_ct(coarse().ct, progress=Mock(side_effect=Cancelled))


def test_the_command_segments_a_ct_with_organs_and_a_lesion(tmp_path, capsys):
    ct, organs, lesion, labels = (str(tmp_path / f"{name}.nii.gz") for name in ("ct", "organs", "lesion", "labels"))
    spine()[0].ct.write(ct)
    spine()[0].organs.write(organs)
    spine()[0].truth.with_array((spine()[0].truth.array == NAMES.index("blood") + 1).astype(np.uint8)).write(lesion)
    options = ["--organs", organs, "--map", "totalsegmentator", "--add", f"tumor={lesion}", "-o", labels]
    with pytest.raises(SystemExit) as ended:
        cli(["segment", ct, *options])
    told = capsys.readouterr()
    assert ended.value.code == 0 and "cancellous bone" in told.out and f"{ct}: taken as a CT" in told.err
    table = TissueTable.read(tmp_path / "labels.json")
    assert {"skin", "cancellous bone", "bone"} <= set(table.names())
    assert table.membrane is not None and "coupling" not in table.membrane.fluids


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["segment", "--thin-sulci"], "--thin-sulci is for an MRI"),
        (["segment", "--sheets", "x.vtp"], "sheets are not found in contrast 'ct'"),
        (["simulate", "--pose", "temporal"], "brain"),
    ],
)
def test_the_command_refuses_what_does_not_go_together(tmp_path, capsys, options, message):
    coarse().ct.write(tmp_path / "ct.nii.gz")
    with pytest.raises(SystemExit) as ended:
        cli([*options, str(tmp_path / "ct.nii.gz"), "-o", str(tmp_path / "labels.nii.gz")])
    assert ended.value.code == 2
    assert message in capsys.readouterr().err.replace("\n", " ")


@pytest.mark.slow
def test_ribs_cast_shadows_and_lung_is_a_bright_line_between_them():
    probe, found = LinearProbe(width_mm=48, depth_mm=50, frequency_mhz=6.0, focus_mm=25), chest()[1]
    tissues, settings = TissueTable.named(found.tissue_names), SimulationSettings(beam="ray")
    simulator = UltrasoundSimulator(found.labels, tissues, settings, texture=found.texture())
    frame = simulator.simulate(probe, pose_looking_at((120.5, 0.0, 46.0), (0.0, 0.0, 46.0), (0.0, 0.0, -1.0)))
    level, mm = 20.0 * np.log10(np.maximum(frame.envelope, 1e-9)), frame.sample_interval_mm
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
