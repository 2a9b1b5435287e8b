"""Approaches to a target: which ways are offered, through which opening, and what a probe sees from there."""

from __future__ import annotations

import re
from dataclasses import replace
from html import unescape
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from SlicerUSSim.Command.cli import main
from SlicerUSSim.Logic import SimulationError, TissueTable, UltrasoundSimulator, Volume
from SlicerUSSim.Logic.imaging.approach_images import simulated_approach
from SlicerUSSim.Logic.placement import ApproachWeights, plan_approach
from SlicerUSSim.Logic.placement.approach import VENTRICLE, opened_for
from SlicerUSSim.Logic.placement.approach_weights import NO_ADVICE
from SlicerUSSim.Logic.placement.craniotomy import face_width_mm, without_outside
from SlicerUSSim.Logic.probe import PROBES
from SlicerUSSim.Logic.probe.poses import sample
from SlicerUSSim.Logic.tissue.table import write_label_files
from tests.test_aiming import ILL, TUMOUR, with_ball
from tests.test_craniotomy import NAMES, head, places_of  # noqa: F401

PHASED = PROBES["phased"]
PLACE = np.array([25.0, 10.0, 30.0])
CSF, SKULL_LABEL, SKIN_LABEL = 1, 5, 3


@pytest.fixture
def ill(head) -> Volume:  # noqa: F811
    """A round head with a tumour of 16 mm, 40 mm from its middle."""
    return with_ball(head, PLACE, 8.0)


def test_the_first_way_is_short_and_on_the_side_of_the_target(ill):
    plan = plan_approach(ill, ILL, PHASED, "tumour")
    best = plan.candidates[0]
    assert plan.target.name == "tumour" and plan.target.size_mm == pytest.approx(16.0, abs=2.0)
    assert plan.target.depth_mm == pytest.approx(60.0 - np.linalg.norm(PLACE) - 8.0, abs=3.0)
    away = np.rad2deg(np.arccos(best.entry_ras @ PLACE / np.linalg.norm(best.entry_ras) / np.linalg.norm(PLACE)))
    assert away < 12.0 and np.linalg.norm(best.entry_ras) == pytest.approx(78.0, abs=2.5)  # on the skin
    assert list(best.path_mm) == ["skin", "scalp", "skull", "cancellous bone", "grey matter"]
    assert best.path_mm["scalp"] == pytest.approx(8.0, abs=2.0) and best.path_mm["skull"] == pytest.approx(4.0, abs=1.5)
    assert best.path_mm["grey matter"] == pytest.approx(plan.target.depth_mm, abs=3.0) and best.angle_deg < 12.0
    assert best.cost == min(other.cost for other in plan.candidates)
    faces = [candidate.probe_to_ras[:3, 3] for candidate in plan.candidates]
    assert len(faces) == 3
    assert min(np.linalg.norm(faces[a] - faces[b]) for a, b in ((0, 1), (0, 2), (1, 2))) > 20.0


@pytest.mark.parametrize("name", ["phased", "burr_hole", "microconvex"])
def test_through_its_opening_the_probe_sees_the_target(ill, name):
    probe = PROBES[name]
    best = plan_approach(ill, ILL, probe, "tumour").candidates[0]
    assert best.seen >= 0.95 and best.opening_mm == face_width_mm(probe) + 15.0
    opened = opened_for(ill, ILL, [best])
    voxels = places_of(ill)[ill.array == TUMOUR][::5]
    ways = best.probe_to_ras[:3, 3] + np.linspace(0.0, 1.0, 80)[:, None, None] * (voxels - best.probe_to_ras[:3, 3])
    assert not np.isin(sample(opened, ways, order=0), [SKULL_LABEL, SKULL_LABEL + 1]).any()
    behind = best.probe_to_ras[:3, 3] - np.arange(1.0, 25.0)[:, None] * best.probe_to_ras[:3, 1]
    assert not sample(opened, behind, order=0).any() and sample(ill, behind, order=0).any()


def test_a_way_around_a_ventricle_is_taken_unless_that_costs_nothing(head):  # noqa: F811
    labels = with_ball(head, np.array([6.0, 0.0, 10.0]), 6.0)
    places = places_of(head)
    lake = (np.abs(places[..., 2] - 28.0) < 6.0) & (np.linalg.norm(places[..., :2], axis=-1) < 40.0)
    labels = labels.with_array(np.where(lake, CSF, labels.array))
    around = plan_approach(labels, ILL, PHASED, "tumour").candidates[0]
    assert VENTRICLE not in around.path_mm
    free = ApproachWeights(ventricle_weight=0.0, brain_weight=0.0, angle_weight=1.0)
    near = plan_approach(labels, ILL, PHASED, "tumour", weights=free, offered=40).candidates
    through = [candidate for candidate in near if VENTRICLE in candidate.path_mm]
    assert through and through[0].path_mm[VENTRICLE] == pytest.approx(12.0, abs=4.0)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_no_way_leads_through_the_other_side_of_the_brain(head, side):  # noqa: F811
    labels = with_ball(head, np.array([9.0 * side, 0.0, 20.0]), 5.0)
    candidates = plan_approach(labels, ILL, PHASED, "tumour").candidates
    assert len(candidates) == 3 and all(side * candidate.probe_to_ras[0, 3] > 4.0 for candidate in candidates)
    # nor through bone of the other side, to which some paths lead outside the brain
    aslant = ApproachWeights(angle_weight=0.0, brain_weight=0.0, outside_weight=0.0, unseen_weight=0.0)
    candidates = plan_approach(labels, ILL, PHASED, "tumour", weights=aslant, offered=40).candidates
    assert all(side * candidate.entry_ras[0] >= 4.0 for candidate in candidates)


def test_no_way_leads_from_below_or_where_the_image_ends(head):  # noqa: F811
    labels = with_ball(head, np.array([20.0, 15.0, -35.0]), 6.0)  # nearest to the base
    for candidate in plan_approach(labels, ILL, PHASED, "tumour").candidates:
        outward = -candidate.probe_to_ras[:3, 1]
        assert outward[2] >= -0.5 or outward[1] < 0.0
    cut = labels.array.copy()
    cut[58:] = 0  # without the top, from S 32 on
    cut = Volume(cut[:58], labels.ijk_to_ras)
    low = with_ball(cut, np.array([20.0, 0.0, 20.0]), 6.0)
    for candidate in plan_approach(low, ILL, PHASED, "tumour").candidates:
        assert candidate.path_mm["skull"] >= 2.0 and candidate.entry_ras[2] < 30.0


def test_a_target_is_a_tissue_a_point_or_the_largest_lesion(ill):
    named = plan_approach(ill, ILL, PHASED, "tumor").target
    np.testing.assert_allclose(named.centre_ras, PLACE, atol=0.5)
    for what in (None, tuple(PLACE)):
        found = plan_approach(ill, ILL, PHASED, what).target
        np.testing.assert_array_equal(found.region.array, named.region.array)
        assert found.text == named.text
    point = plan_approach(ill, ILL, PHASED, (0.0, 5.0, 0.0)).target
    assert point.name == "point" and point.size_mm == pytest.approx(6.0, abs=2.0)
    np.testing.assert_allclose(point.centre_ras, [0.0, 5.0, 0.0], atol=1e-6)
    assert re.fullmatch(r"tumour: 1\d mm, 1\d mm below the brain's surface", named.text)


def test_targets_of_all_sizes_and_places_are_planned(head):  # noqa: F811
    large = ((30.0, 0.0, 25.0), 18.0)  # its rim is beside the opening, below bone that is not before it
    for place, radius in (((0.0, 0.0, 54.0), 5.0), large, ((10.0, -20.0, 30.0), 1.2), ((0.0, 0.0, 0.0), 25.0)):
        labels = with_ball(head, np.array(place), radius)
        best = plan_approach(labels, ILL, PHASED, "tumour").candidates[0]
        assert best.seen > (0.95 if radius < 20.0 else 0.5)
    far = plan_approach(with_ball(head, PLACE, 5.0), ILL, replace(PHASED, focus_mm=85.0), "tumour").candidates[0]
    assert far.focused == 0.0 and "0 % in focus (move the focus to the depth of the target)" in far.text
    deep = plan_approach(with_ball(head, np.zeros(3), 5.0), ILL, PROBES["linear"], "tumour").candidates[0]
    assert deep.seen == 0.0  # its field is 40 mm deep: told, not refused


def test_a_brain_without_skull_is_approached_from_its_surface(ill):
    brain = without_outside(ill, ILL)
    best = plan_approach(brain, ILL, PHASED, "tumour").candidates[0]
    assert best.opening_mm == 0.0 and list(best.path_mm) == ["grey matter"]
    assert np.linalg.norm(best.entry_ras) == pytest.approx(60.0, abs=2.5)
    assert opened_for(brain, ILL, [best]) is brain


def test_only_a_target_that_cannot_be_found_is_refused(head, ill):  # noqa: F811
    cases = (
        (head, NAMES, None, "the labels have no lesion, expected one"),
        (head, NAMES, "tumour", "the labels have no tumour, expected a lesion that they have, or one that is added"),
        (ill, ILL, "cyst", "the labels have no cyst, expected a lesion"),
        (ill, ILL, "teapot", "no tissue is called 'teapot'"),
        (ill, ILL, (0.0, 0.0, 120.0), "the point lies outside of the brain, expected a target in it"),
        (head, NAMES, (0.0, 0.0, 65.0), "the point lies outside of the brain"),  # in bone
        (ill, ILL, (0.0, np.nan, 0.0), "expected R, A, S in mm"),
        (ill, ("liver", "muscle"), None, "no tissue of a brain"),
    )
    for labels, names, what, message in cases:
        with pytest.raises(SimulationError, match=message):
            plan_approach(labels, names, PHASED, what)
    with pytest.raises(SimulationError, match="unseen_weight is -1"):
        ApproachWeights(unseen_weight=-1.0)


def test_images_of_the_candidates_show_the_contrast_of_the_target(ill):
    for tissue, is_brighter in (("tumour", True), ("cyst", False)):
        names = (*ILL[: TUMOUR - 1], tissue, ILL[-1])
        plan = plan_approach(ill, names, PHASED, tissue, offered=2)
        shown = simulated_approach(plan, UltrasoundSimulator(ill, TissueTable.named(names)), PHASED).candidates
        for candidate in shown:
            assert candidate.pictures[0].max() > 100 and candidate.contrast_db is not None
            assert (candidate.contrast_db > 4.0) if is_brighter else (candidate.contrast_db < -4.0)
        picture, section = shown[0].pictures
        rows, columns = np.nonzero((picture == (255, 200, 61)).all(axis=2))
        depth = (rows + 0.5) * 90.0 / len(picture)
        middle = np.linalg.norm(plan.target.centre_ras - shown[0].probe_to_ras[:3, 3])
        assert [depth.min(), depth.max()] == pytest.approx([middle - 8.0, middle + 8.0], abs=2.0)
        assert columns.mean() == pytest.approx(0.5 * picture.shape[1], abs=4)
        assert np.ptp(columns) == pytest.approx(np.ptp(rows), abs=6)  # a ball is round: pixels are square
        rows, columns = np.nonzero((section == (89, 217, 255)).all(axis=2))
        pixel_mm = 90.0 / len(picture)
        assert np.ptp(columns) * pixel_mm == pytest.approx(shown[0].opening_mm, abs=4.0)
        above = np.linalg.norm(shown[0].entry_ras - shown[0].probe_to_ras[:3, 3])
        assert np.ptp(rows) * pixel_mm == pytest.approx(above + middle + 40 * pixel_mm, abs=3.0)  # skin to target


def test_the_example_of_the_page_runs(capsys):
    page = (Path(__file__).parents[1] / "docs/approach.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"^```python\n(.*?)^```", page, flags=re.DOTALL | re.MULTILINE)
    exec(compile(code, "docs/approach.md", "exec"), {})
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4 and lines[0].startswith("tumour: 16 mm, ") and "contrast +" in lines[1]


def test_the_command_writes_a_report_and_simulates_the_first_candidate(ill, tmp_path):
    labels, report = tmp_path / "labels.nii.gz", tmp_path / "report.html"
    write_label_files(labels, ill, TissueTable.named(ILL))
    run = CliRunner().invoke(main, ["approach", str(labels), "-o", str(report), "--set", "approach.angle_weight=0.5"])
    assert run.exit_code == 0, run.output
    text = report.read_text(encoding="utf-8")
    assert text.count("data:image/png;base64,") == 6 and NO_ADVICE in text and NO_ADVICE in run.stdout
    assert text.count("<h2>Candidate") == 3 and all(line in unescape(text) for line in run.stdout.splitlines())
    first = run.stdout.splitlines()[1].split("; contrast")[0]
    image = tmp_path / "image.png"
    run = CliRunner().invoke(main, ["simulate", str(labels), "--approach", "tumour", "-o", str(image)])
    assert run.exit_code == 0 and NO_ADVICE in run.output and "opening of" in run.output, run.output
    pixels = np.asarray(Image.open(image))
    assert pixels[100:200, 250:400].mean() > 20.0
    preset = tmp_path / "preset.json"
    preset.write_text('{"approach": {"angle_weight": 0.5}}', encoding="utf-8")
    for given in (["--set", "approach.angle_weight=0.5"], ["--preset", str(preset)]):
        run = CliRunner().invoke(
            main, ["simulate", str(labels), "--approach", "tumour", *given, "-o", str(image), "--overwrite"]
        )
        assert run.exit_code == 0 and first in run.output, run.output
    for arguments, message in (
        (["--approach", "1,2"], "expected R, A, S in mm"),
        (["--approach", "tumour", "--pose", "auto"], "expected exactly one of --pose and --approach"),
        (["--approach", "tumour", "--craniotomy", "auto"], "it opens the head"),
    ):
        run = CliRunner().invoke(main, ["simulate", str(labels), *arguments, "-o", str(tmp_path / "b.png")])
        assert run.exit_code == 2 and message in run.output
    assert not (tmp_path / "b.png").exists()
