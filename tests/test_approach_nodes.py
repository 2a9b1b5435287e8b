"""The section Approach of panel and page: targets, candidates, and the skull opened at one."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

slicer = pytest.importorskip("slicer", reason="MRML nodes come with slicer-core: pip install '.[slicer]'")

from vtkmodules.vtkCommonCore import vtkCommand  # noqa: E402
from vtkmodules.vtkRenderingCore import vtkRenderer, vtkRenderWindow, vtkRenderWindowInteractor  # noqa: E402

from SlicerUSSim.Logic.mrml.approach_logic import OPENING, TARGET, WAY  # noqa: E402
from SlicerUSSim.Logic.mrml.nodes import control_points, nodes_of_class, probe_pose, set_node_to_world  # noqa: E402
from SlicerUSSim.Logic.placement.approach_weights import NO_ADVICE  # noqa: E402
from SlicerUSSim.Logic.placement.craniotomy import face_width_mm  # noqa: E402
from SlicerUSSim.Logic.probe import PROBES  # noqa: E402
from SlicerUSSim.Logic.probe.poses import turned  # noqa: E402
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


def shown(bench: Bench) -> dict[str, np.ndarray]:
    """{name: (3, 2) bounds in the world} of what shows the approach in the views."""
    nodes = [bench.scene.GetFirstNodeByName(name) for name in (TARGET, WAY, OPENING)]
    bounds = {}
    for node in filter(None, nodes):
        node.GetRASBounds(limits := [0.0] * 6)
        bounds[node.GetName()] = np.array(limits).reshape(3, 2)
    return bounds


def from_opening_mm(bench: Bench, place: np.ndarray) -> float:
    """Distance of a place in the world from the axis of the opening that is chosen."""
    rim = control_points(bench.logic.parameters.opening)
    flat = np.linalg.svd(rim - rim.mean(axis=0))[2][:2]
    return float(np.linalg.norm((place - rim.mean(axis=0)) @ flat.T))


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
    before = shown(bench)
    np.testing.assert_allclose(before[TARGET].mean(axis=1), target, atol=1.5)
    np.testing.assert_allclose(np.ptp(before[TARGET], axis=1), 16.0, atol=3.0)
    model = bench.scene.GetFirstNodeByName(TARGET)
    assert model.GetPolyData().GetPointData().GetScalars() is None  # in its own colour
    approach.choose(1)
    moved = shown(bench)
    assert len(moved) == 3 and np.abs(moved[WAY] - before[WAY]).max() > 5.0
    assert len(nodes_of_class(bench.scene, "vtkMRMLMarkupsNode")) == 2
    assert approach.text().splitlines()[1].startswith("Candidate 2: ")
    approach.choose(0)
    approach.openHere()
    assert not bench.view.errors and bench.labels is not bench.whole
    pose = probe_pose(bench.probe)
    across, depth, up = (np.linalg.inv(pose) @ [*target, 1.0])[:3]
    assert np.hypot(across, up) < 1.0 and depth == pytest.approx(60.0 - np.linalg.norm(PLACE), abs=4.0)
    removed = bench.tissues(bench.whole)[bench.tissues(bench.labels) == 0]
    disc = np.pi * (0.5 * approach.found.candidates[0].opening_mm) ** 2 * 16.0 / 8.0  # voxels of 2 mm, 16 mm of skull
    assert (removed == 2).sum() == pytest.approx(disc, rel=0.35)
    assert approach.canChoose(0)[0]  # of the head before the opening, from which another one can be opened
    before = bench.labels
    approach.choose(1)
    approach.openHere()
    assert bench.labels is before and not np.allclose(probe_pose(bench.probe), pose)


def test_a_target_is_a_tissue_or_a_clicked_point(bench):
    approach, parameters = bench.presenter.approach, bench.logic.parameters
    parameters.target = "cyst"
    approach.plan()
    assert "the labels have no cyst, expected a lesion" in bench.view.errors[-1] and approach.found is None
    parameters.target = "a point"
    approach.plan()
    points, picked = bench.view.picking
    points.AddControlPointWorld(*(TURN @ [-20.0, 0.0, 20.0, 1.0])[:3])
    picked()
    assert approach.text().startswith("point: ") and len(bench.view.errors) == 1
    np.testing.assert_allclose(shown(bench)[TARGET].mean(axis=1), (TURN @ [-20.0, 0.0, 20.0, 1.0])[:3], atol=1.0)


def test_the_opening_is_a_curve_that_can_be_moved(bench):
    approach = bench.presenter.approach
    approach.plan()
    curve = bench.logic.parameters.opening
    assert curve.IsA("vtkMRMLMarkupsClosedCurveNode") and curve.GetNumberOfControlPoints() == 12
    before, step = approach.text(), 12.0 * approach.found.candidates[0].probe_to_ras[:3, 0]
    for number, place in enumerate(control_points(curve)):
        curve.SetNthControlPointPositionWorld(number, *(place + step))
    assert "The opening was changed" not in before and "The opening was changed" in approach.text()
    approach.openHere()
    assert not bench.view.errors and bench.labels is not bench.whole
    pose, target = probe_pose(bench.probe), (TURN @ [*PLACE, 1.0])[:3]
    across, _, up = (np.linalg.inv(pose) @ [*target, 1.0])[:3]
    assert np.hypot(across, up) < 1.0 and from_opening_mm(bench, pose[:3, 3]) < 6.0
    closed, opened = bench.tissues(bench.whole), bench.tissues(bench.labels)
    k, j, i = np.argwhere((closed == 2) & (opened == 0)).mean(axis=0)
    middle = (TURN @ [2.0 * i - 84.0, 2.0 * j - 84.0, 2.0 * k - 84.0, 1.0])[:3]
    assert from_opening_mm(bench, middle) < 2.0


def test_a_probe_that_is_moved_stays_in_the_opening_and_aimed(bench):
    approach, parameters = bench.presenter.approach, bench.logic.parameters
    approach.plan()
    approach.openHere()
    start, target = probe_pose(bench.probe), (TURN @ [*PLACE, 1.0])[:3]
    aside = turned(start, tilt_deg=20.0)
    aside[:3, 3] += 40.0 * start[:3, 2]
    set_node_to_world(bench.probe, aside)
    np.testing.assert_allclose(probe_pose(bench.probe), aside)  # nobody wants it to be kept
    parameters.keep_in_opening = True
    bench.presenter.parametersChanged()
    room = 0.5 * (approach.found.candidates[0].opening_mm - face_width_mm(bench.logic.preset.probe))
    for step_mm in (40.0, 4.0, -40.0):
        wanted = start.copy()
        wanted[:3, 3] += step_mm * start[:3, 2]
        set_node_to_world(bench.probe, wanted)
        pose = probe_pose(bench.probe)
        across, depth, up = (np.linalg.inv(pose) @ [*target, 1.0])[:3]
        assert np.hypot(across, up) < 1.0 and 5.0 < depth < 30.0
        assert from_opening_mm(bench, pose[:3, 3]) == pytest.approx(min(abs(step_mm), room), abs=1.0)
    parameters.keep_in_opening = False
    bench.presenter.parametersChanged()
    set_node_to_world(bench.probe, aside)
    np.testing.assert_allclose(probe_pose(bench.probe), aside)


def test_on_the_page_a_point_of_the_curve_goes_before_the_probe(bench):
    hands = pytest.importorskip("SlicerUSSim.Workstation.hand", reason="the page comes with: pip install '.[serve]'")
    bench.presenter.approach.plan()
    display = bench.logic.parameters.opening.GetDisplayNode()
    window, renderer, interactor = vtkRenderWindow(), vtkRenderer(), vtkRenderWindowInteractor()
    window.SetSize(100, 100)
    window.AddRenderer(renderer)
    renderer.GetActiveCamera().SetPosition(0.0, -30.0, 300.0)
    renderer.GetActiveCamera().SetFocalPoint(0.0, -30.0, 0.0)  # on the body of a probe at the origin
    view = SimpleNamespace(interactor=lambda: interactor, renderer=lambda: renderer, get_view_node=lambda: display)
    nothing = lambda *_: None  # noqa: E731
    hand = hands.ProbeHand(lambda: np.eye(4), nothing, nothing, lambda: True, nothing, nothing)
    hand.set_probe(PROBES["phased"])
    hand.attach(view)
    reached: list[str] = []
    interactor.AddObserver(vtkCommand.LeftButtonPressEvent, lambda *_: reached.append(display.GetActiveComponentType()))
    for component in (display.ComponentControlPoint, display.ComponentNone):
        display.SetActiveComponent(component, 0)
        interactor.SetEventInformation(50, 50)
        interactor.InvokeEvent(vtkCommand.LeftButtonPressEvent)
    assert reached == [display.ComponentControlPoint]


def test_another_patient_has_no_plan_of_the_one_before(bench):
    bench.presenter.approach.plan()
    assert len(shown(bench)) == 3
    bench.presenter.forgetPatient()
    assert not shown(bench) and bench.logic.parameters.opening is None and bench.presenter.approach.text() == ""
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
