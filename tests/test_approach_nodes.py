"""The section Approach of panel and page: targets, candidates, and the skull opened at one."""

from __future__ import annotations

import numpy as np
import pytest

slicer = pytest.importorskip("slicer", reason="MRML nodes come with slicer-core: pip install '.[slicer]'")

from SlicerUSSim.Logic.mrml.nodes import nodes_of_class, probe_pose  # noqa: E402
from SlicerUSSim.Logic.placement.approach_weights import NO_ADVICE  # noqa: E402
from SlicerUSSim.Logic.placement.craniotomy import face_width_mm  # noqa: E402
from SlicerUSSim.Widget.interface import by_widget  # noqa: E402
from SlicerUSSim.Widget.sections import panel_sections  # noqa: E402
from SlicerUSSim.Workstation.controls import control_html  # noqa: E402
from tests.test_aiming import ILL, with_ball  # noqa: E402
from tests.test_craniotomy import head  # noqa: E402, F401
from tests.test_craniotomy_nodes import TURN, Bench  # noqa: E402

PLACE = np.array([25.0, 10.0, 30.0])


@pytest.fixture
def bench(head) -> Bench:  # noqa: F811
    """A round head with a tumour under a transform, and nothing planned."""
    return Bench(with_ball(head, PLACE, 8.0), names=ILL)


def models(bench: Bench) -> dict[str, np.ndarray]:
    """{name: (3, 2) bounds} of the models of the approach."""
    found = [
        node for node in nodes_of_class(bench.scene, "vtkMRMLModelNode") if node.GetName() in ("Target", "Approach")
    ]
    return {node.GetName(): np.array(node.GetPolyData().GetBounds()).reshape(3, 2) for node in found}


def test_the_panel_lists_candidates_and_opens_the_skull_at_one(bench):
    approach = bench.presenter.approach
    assert not approach.canChoose(0)[0] and approach.text() == "" and approach.picture(0) == ""
    approach.plan()
    assert not bench.view.errors and approach.canChoose(2)[0] and not approach.canChoose(3)[0]
    lines = approach.text().splitlines()
    assert lines[0].startswith("tumour: 1") and lines[1].startswith("Candidate 1: R ") and lines[2] == NO_ADVICE
    pictures = [approach.picture(number) for number in range(3)]
    assert all(picture.startswith("data:image/png;base64,") for picture in pictures) and len(set(pictures)) == 3
    target = (TURN @ [*PLACE, 1.0])[:3]
    shown = models(bench)
    np.testing.assert_allclose(shown["Target"].mean(axis=1), target, atol=1.5)
    np.testing.assert_allclose(np.ptp(shown["Target"], axis=1), 16.0, atol=3.0)
    (model,) = [node for node in nodes_of_class(bench.scene, "vtkMRMLModelNode") if node.GetName() == "Target"]
    assert model.GetPolyData().GetPointData().GetScalars() is None  # in its own colour
    approach.choose(1)
    moved = models(bench)
    assert len(moved) == 2 and np.abs(moved["Approach"] - shown["Approach"]).max() > 5.0
    assert approach.text().splitlines()[1].startswith("Candidate 2: ")
    approach.choose(0)
    approach.openHere()
    assert not bench.view.errors and bench.labels is not bench.whole
    pose = probe_pose(bench.probe)
    across, depth, up = (np.linalg.inv(pose) @ [*target, 1.0])[:3]
    assert np.hypot(across, up) < 1.0 and depth == pytest.approx(60.0 - np.linalg.norm(PLACE), abs=4.0)
    face = face_width_mm(bench.logic.preset.probe)
    assert face + 10.0 <= bench.logic.parameters.panel.craniotomy_mm <= face + 15.0
    assert approach.canChoose(0)[0]  # of the head before the opening, from which another one can be opened
    before = bench.labels
    approach.choose(1)
    approach.openHere()
    assert bench.labels is before and not np.allclose(probe_pose(bench.probe), pose)


def test_a_target_is_a_tissue_or_a_clicked_point(bench):
    approach, parameters = bench.presenter.approach, bench.logic.parameters
    parameters.target = "cyst"
    approach.plan()
    assert "the labels have no cyst, expected tumour" in bench.view.errors[-1] and approach.found is None
    parameters.target = "a point"
    approach.plan()
    points, picked = bench.view.picking
    points.AddControlPointWorld(*(TURN @ [-20.0, 0.0, 20.0, 1.0])[:3])
    picked()
    assert approach.text().startswith("point: ") and len(bench.view.errors) == 1
    np.testing.assert_allclose(models(bench)["Target"].mean(axis=1), (TURN @ [-20.0, 0.0, 20.0, 1.0])[:3], atol=1.0)


def test_the_opening_can_be_drawn_as_a_curve(bench):
    bench.presenter.approach.plan()
    bench.presenter.approach.drawOpening()
    curve = bench.logic.parameters.opening
    assert curve.IsA("vtkMRMLMarkupsClosedCurveNode") and curve.GetNumberOfControlPoints() == 16
    bench.presenter.placing.openCraniotomy()
    assert not bench.view.errors and bench.labels is not bench.whole
    removed = bench.tissues(bench.whole)[bench.tissues(bench.labels) == 0]
    best = bench.presenter.approach.found.candidates[0]
    disc = np.pi * (0.5 * best.opening_mm) ** 2 * 16.0 / 8.0  # voxels of 2 mm, shells of 16 mm
    assert (removed == 2).sum() == pytest.approx(disc, rel=0.35)


def test_another_patient_has_no_plan_of_the_one_before(bench):
    bench.presenter.approach.plan()
    assert models(bench)
    bench.presenter.forgetPatient()
    assert not models(bench) and bench.presenter.approach.text() == ""
    bench.presenter.approach.openHere()
    assert "no approach is planned, press Plan first" in bench.view.errors[-1]


def test_panel_and_page_have_the_section_from_one_declaration(bench):
    controls = by_widget(panel_sections(bench.presenter))
    picture = controls["candidate1Picture"]
    assert picture.kind == "picture" and picture.shows is not None and picture.shows() == ""
    text = control_html(picture)
    assert ':src="value_candidate1Picture"' in text and "trigger('press', ['candidate1Picture'])" in text
    assert "trigger('press', ['openHereButton'])" in control_html(controls["openHereButton"])
    assert controls["targetComboBox"].choices[0] == "largest lesion"
