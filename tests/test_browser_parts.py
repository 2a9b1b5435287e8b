"""Parts of the workstation without a browser: tasks, sequences as nodes, the probe's shape."""

from __future__ import annotations

import asyncio
import io
import selectors
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkFiltersCore import vtkCleanPolyData, vtkFeatureEdges, vtkMassProperties, vtkTriangleFilter

from SlicerUSSim.Logic import (
    ConvexProbe,
    LinearProbe,
    PhasedProbe,
    TissueTable,
    UltrasoundSimulator,
)
from SlicerUSSim.Logic.base.errors import Cancelled
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.fitting.image_similarity import RealImages
from SlicerUSSim.Logic.mri.samples import head_mri
from SlicerUSSim.Logic.mri.segmentation import segment_mri
from SlicerUSSim.Logic.probe.arrays import PROBES
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.probe.poses import craniotomy_pose, tilt_sweep, turned
from SlicerUSSim.Logic.probe.shape import field_polydata, probe_polydata
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence

slicer = pytest.importorskip("slicer", reason="MRML nodes come with slicer-core: pip install '.[slicer]'")
pytest.importorskip("greenlet", reason="the workstation comes with: pip install '.[serve]'")
pytest.importorskip("trame_slicer", reason="the workstation comes with: pip install '.[serve]'")

from trame.app import get_server  # noqa: E402
from trame_server.state import State  # noqa: E402

from SlicerUSSim.Logic.mrml.fit_nodes import tracked_images  # noqa: E402
from SlicerUSSim.Logic.mrml.label_nodes import write_labels  # noqa: E402
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic  # noqa: E402
from SlicerUSSim.Logic.mrml.nodes import node_to_world, probe_pose, read_volume, set_node_to_world, write_volume  # noqa: E402
from SlicerUSSim.Logic.mrml.sequence_nodes import TIME, SequenceIndex, add_sequence  # noqa: E402
from SlicerUSSim.Logic.tracked.images import TrackedImages  # noqa: E402
from SlicerUSSim.Workstation.browser_panel import BrowserPanel  # noqa: E402
from SlicerUSSim.Workstation.comparison import Comparison  # noqa: E402
from SlicerUSSim.Workstation.image_flow import LatencyStamps  # noqa: E402
from SlicerUSSim.Workstation.state import (  # noqa: E402
    NAMES,
    ComparisonMode,
    NodeItem,
    SharedState,
    TissueLine,
    value_of,
)
from SlicerUSSim.Workstation.streams import ImageStream, _jpeg  # noqa: E402
from SlicerUSSim.Workstation.tasks import AtMost, Tasks  # noqa: E402


@pytest.fixture(scope="module")
def head():
    return segment_mri(head_mri(3.5), thin_sulci=True)


# ---- tasks -----------------------------------------------------------------------------------------------------------


def run_in_loop(coroutine_function):
    """The result of an async function in a separate event loop; fails if it waits too long."""
    return run_in(asyncio.new_event_loop(), coroutine_function)


def run_in(loop: asyncio.AbstractEventLoop, coroutine_function):
    if asyncio._get_running_loop() is None:
        return _run_in(loop, coroutine_function)
    with ThreadPoolExecutor(1) as thread:  # the loop of a browser's client runs in this one
        return thread.submit(_run_in, loop, coroutine_function).result()


def _run_in(loop: asyncio.AbstractEventLoop, coroutine_function):
    asyncio.set_event_loop(loop)
    try:
        return loop.run_until_complete(asyncio.wait_for(coroutine_function(), 180))
    finally:
        asyncio.set_event_loop(None)
        loop.close()


def test_the_event_loop_continues_and_results_come_back_to_their_tasks():
    async def scenario():
        tasks, seen, ticks = Tasks(seen_errors.append), [], 0
        goes_on = threading.Event()

        def work(name: str):
            assert goes_on.wait(150), "the event loop stood still"
            return name, threading.get_ident()

        def task(name: str) -> None:
            here = threading.get_ident()
            result, thread = tasks.do(lambda: work(name))
            seen.append((result, thread != here, threading.get_ident() == here))

        for name in ("first", "second"):
            tasks.start(lambda name=name: task(name))
        while len(seen) < 2:
            ticks += 1
            if ticks == 5:  # the work is done only if the loop gets here
                assert not tasks.are_done
                goes_on.set()
            await asyncio.sleep(0.01)
        tasks.stop()
        return seen, tasks.are_done

    seen_errors: list[Exception] = []
    seen, are_done = run_in_loop(scenario)
    assert seen == [("first", True, True), ("second", True, True)] and are_done and not seen_errors


def test_errors_of_work_reach_the_task_and_those_of_tasks_are_reported():
    async def scenario():
        errors, caught = [], []
        tasks = Tasks(errors.append)

        def mends() -> None:
            try:
                tasks.do(lambda: 1 / 0)
            except ZeroDivisionError as error:
                caught.append(error)

        tasks.start(mends)
        tasks.start(lambda: tasks.do(lambda: [].pop()))
        while not (caught and errors):
            await asyncio.sleep(0.01)
        assert tasks.do(lambda: 7) == 7  # outside of a task it simply waits
        tasks.stop()
        return errors

    assert [type(error) for error in run_in_loop(scenario)] == [IndexError]


@pytest.mark.slow
def test_what_does_not_hear_of_its_cancellation_is_abandoned():
    async def scenario():
        goes_on, happened, renewed = threading.Event(), [], []
        tasks = Tasks(happened.append)
        begun = threading.Event()

        def long() -> str:
            begun.set()
            assert goes_on.wait(150)
            return "too late"

        waiting = []

        def task() -> None:
            from greenlet import getcurrent

            waiting.append(getcurrent())
            try:
                happened.append(tasks.do(long))
            except Cancelled:
                happened.append("cancelled")

        tasks.start(task)
        while not begun.is_set():
            await asyncio.sleep(0.01)
        tasks.start(lambda: happened.append(tasks.do(lambda: "an image")))  # behind it
        await asyncio.sleep(0.05)
        assert happened == []
        waits = []  # seconds that the loop is asked to wait, whatever the machine makes of them
        loop = asyncio.get_running_loop()
        later = loop.call_later
        loop.call_later = lambda delay, *rest, **more: (waits.append(delay), later(delay, *rest, **more))[1]
        tasks.abandonSoon(waiting[0], lambda: True, lambda: renewed.append(1))
        while not tasks.are_done:
            await asyncio.sleep(0.01)
        loop.call_later = later
        is_blocked = not goes_on.is_set()
        goes_on.set()
        await asyncio.sleep(0.1)
        return sorted(happened), renewed, sum(wait for wait in waits if wait > 0.05), is_blocked

    happened, renewed, waited, is_blocked = run_in_loop(scenario)
    assert happened == ["an image", "cancelled"] and renewed == [1] and is_blocked and 0.0 < waited < 1.0


@pytest.mark.slow
def test_images_do_not_wait_for_what_needs_no_device():
    async def scenario():
        goes_on, done = threading.Event(), []
        tasks = Tasks(done.append)
        tasks.start(lambda: done.append(tasks.doAside(lambda: goes_on.wait(150) and "a surface")))
        tasks.start(lambda: done.append(tasks.do(lambda: "an image")))
        while not done:
            await asyncio.sleep(0.01)
        first = list(done)
        goes_on.set()
        while not tasks.are_done:
            await asyncio.sleep(0.01)
        return first, done

    assert run_in_loop(scenario) == (["an image"], ["an image", "a surface"])


class _NoWaiting(selectors.DefaultSelector):
    """A selector of a loop whose clock stands still while something happens, and else jumps to the next timer."""

    now = 0.0

    def select(self, timeout=None):
        ready = super().select(0)
        if not ready and timeout:
            self.now += timeout
        return ready


def test_what_is_called_too_often_is_called_once_more_at_the_end():
    selector = _NoWaiting()
    loop = asyncio.SelectorEventLoop(selector)
    loop.time = lambda: selector.now

    async def scenario():
        told: list[tuple[float, int]] = []
        calls: list[int] = []
        often = AtMost(0.1, lambda: told.append((loop.time(), len(calls))))
        for number in range(31):  # from 0 to 0.3 s
            calls.append(number)
            often()
            await asyncio.sleep(0.01)
        assert often.is_waiting
        await asyncio.sleep(1.0)
        assert not often.is_waiting
        return told

    times, numbers = zip(*run_in(loop, scenario), strict=True)
    assert min(np.diff(times)) > 0.0999 and len(times) in (4, 5) and numbers[0] == 1 and numbers[-1] == 31


def live_scene(head, tasks: Tasks):
    """(logic, labels, transform of the probe on the head, output volume)."""
    scene = slicer.vtkMRMLScene()
    labels, transform, output = (
        scene.AddNewNodeByClass(f"vtkMRML{kind}Node") for kind in ("LabelMapVolume", "LinearTransform", "ScalarVolume")
    )
    write_labels(labels, head.labels, head.tissue_names, labels)
    logic = UltrasoundSceneLogic(scene, work=tasks)
    set_node_to_world(transform, craniotomy_pose(head.labels, logic.preset.probe))
    return logic, labels, transform, output


@pytest.mark.slow
def test_changes_during_an_image_bring_one_more_of_the_last_pose(head):
    async def scenario():
        errors, reports = [], []
        tasks = Tasks(errors.append)
        logic, labels, transform, output = live_scene(head, tasks)

        async def done() -> None:
            while not tasks.are_done:
                await asyncio.sleep(0.01)

        tasks.start(
            lambda: logic.startLiveUpdate(labels, transform, output, schedule=tasks.start, report=reports.append)
        )
        await done()
        start, images = probe_pose(transform), len(reports)
        goes_on = threading.Event()
        tasks.start(lambda: tasks.do(goes_on.wait))  # images are computed one after the other, and after this
        for step in range(1, 40):
            set_node_to_world(transform, turned(start, rock_deg=0.5 * step))
            await asyncio.sleep(0)
        goes_on.set()
        await done()
        moved = np.linalg.inv(probe_pose(transform)) @ logic.lastImage().ijk_to_ras
        logic.stopLiveUpdate()
        tasks.stop()
        assert np.allclose(moved, logic.lastFrame.grid.slice_to_probe, atol=1e-6)
        return len(reports) - images, errors, reports

    images, errors, reports = run_in_loop(scenario)
    assert images == 2 and not errors and not any(reports)


def test_a_probe_that_moves_during_the_first_live_image_is_followed(head):
    async def scenario():
        tasks = Tasks(print)
        logic, labels, transform, output = live_scene(head, tasks)
        goes_on = threading.Event()
        tasks.start(lambda: tasks.do(goes_on.wait))
        tasks.start(lambda: logic.startLiveUpdate(labels, transform, output, schedule=tasks.start))
        await asyncio.sleep(0.05)  # the image waits for what is computed before
        assert logic.lastFrame is None
        set_node_to_world(transform, turned(probe_pose(transform), rock_deg=20.0))
        goes_on.set()
        while not tasks.are_done:
            await asyncio.sleep(0.01)
        moved = np.linalg.inv(probe_pose(transform)) @ logic.lastImage().ijk_to_ras
        logic.stopLiveUpdate()
        tasks.stop()
        return np.allclose(moved, logic.lastFrame.grid.slice_to_probe, atol=1e-6)

    assert run_in_loop(scenario)


def test_only_the_image_that_shows_a_movement_tells_its_latency():
    """Images of minutes later had the time of the last event of the mouse: the read-out said 446,552 ms."""
    stamps = LatencyStamps()
    stamps.receive("page", 1.0)
    stamps.image_begun()
    assert stamps.computed is None  # from before the movement
    stamps.probe_moved()
    stamps.image_begun()
    assert stamps.computed == ("page", 1.0)
    stamps.image_begun()  # after a new value of the panel, say
    stamps.probe_moved()  # by a key
    stamps.image_begun()
    assert stamps.computed is None

    stream, sent = ImageStream("simulated"), []
    stream.set_streamer(SimpleNamespace(push_content=lambda name, about, content: sent.append(about["stamp"])))
    stream.send(np.zeros((8, 8), np.uint8), stamp=("page", 1.0))
    stream.send_again()  # another page has opened
    assert sent == [("page", 1.0), None]


def test_an_image_takes_at_most_45_kb_and_looks_alike(head):
    probe = PROBES["neonatal"]  # with the widest field
    simulator = UltrasoundSimulator(head.labels, TissueTable.brain(head.tissue_names))
    image = simulator.simulate(probe, craniotomy_pose(head.labels, probe)).image
    content = _jpeg(image)
    difference = np.abs(np.asarray(Image.open(io.BytesIO(content)), float) - image)
    assert image.shape[0] == 512 and len(content) <= 45_000 and difference[image > 0].mean() < 6.0


# ---- what page and control share -------------------------------------------------------------------------------------


def test_page_and_control_read_what_the_other_writes():
    state = State(ready=True)
    shared, seen = SharedState(state), []
    state.flush()  # of the defaults
    shared.on_change(NAMES.views.blend, seen.append)
    shared.on_change(NAMES.sequence.comparison, seen.append)
    with shared.changing() as now:
        now.panel.tissues = [TissueLine("csf", ["1"], ["a book"])]
        now.panel.nodes = {"mriSelector": [NodeItem("head", "1")]}
    assert (
        state[NAMES.panel.tissues][0]["values"] == ["1"]
        and state[NAMES.panel.nodes]["mriSelector"][0]["title"] == "head"
    )
    assert shared.now.panel.tissues == [TissueLine("csf", ["1"], ["a book"])]
    assert shared.now.panel.nodes == {"mriSelector": [NodeItem("head", "1")]}
    with state:  # as a page does
        state[NAMES.views.blend] = 1
        state[NAMES.sequence.comparison] = "Blink"
    assert seen == [1.0, ComparisonMode.BLINK] and shared.now.sequence.comparison is ComparisonMode.BLINK


def test_of_images_that_come_fast_the_last_is_compared(head):
    probe = PhasedProbe(75.0, 70.0, scan_lines=48)
    grid = ImageGrid.for_probe(probe, None)
    pose = craniotomy_pose(head.labels, probe)
    simulator = UltrasoundSimulator(head.labels, TissueTable.brain(head.tissue_names))
    image = simulator.simulate(probe, pose).image
    known = {"ImageToProbe": grid.image_to_probe}
    known, lost = {**known, "ProbeToReference": pose}, known
    sequence = TrackedSequence(np.stack([image] * 3), (known, lost, known), np.arange(3.0))
    tracked = TrackedImages.of(sequence, path="ImageToReference", beam=probe, probe=probe)

    class Browser:
        def SetSelectedItemNumber(self, number: int) -> None:
            self.number = number

    async def scenario():
        shared, moved = SharedState(State(ready=True)), []
        comparison = Comparison(shared, moved.append, lambda function: function())
        comparison.take(sequence.images, number=1)  # before its place is known
        for stream in comparison.streams:
            stream.set_streamer(SimpleNamespace(push_content=lambda name, about, content: sent.append(name)))
        assert shared.now.sequence.name == "image 1" and not (shared.now.sequence.is_placed or moved)
        comparison.compare(image, grid)
        assert set(sent) == {"real"} and not shared.now.sequence.similarity
        comparison.take(tracked, Browser(), 1)
        shown = shared.now.sequence
        assert (shown.name, shown.numbers, shown.length, shown.is_placed) == ("image 2", "0 to 2", 2, True)
        for simulated in (image // 2, np.zeros_like(image), image):  # one is compared while the others come
            comparison.compare(simulated, grid)
        while comparison.is_comparing:
            await asyncio.sleep(0.01)
        assert len(moved) == 1 and np.allclose(moved[0], pose)
        corners = np.array([point.split(",") for point in shared.now.sequence.mask[2:-2].split()], float)
        x, y = corners.T  # the outline of what is compared
        area = 0.5 * abs(x @ np.roll(y, 1) - y @ np.roll(x, 1))
        assert area == pytest.approx(tracked.mask.sum() * np.prod(tracked.grid.pixel_spacing_mm), rel=0.02)
        return shared.now.sequence.similarity

    sent: list[str] = []
    cost = run_in_loop(scenario)
    same = RealImages(tracked).compared(0, image, grid).total
    assert cost.startswith(f"cost {same:.3f} ") and same < 0.5 * RealImages(tracked).compared(0, image // 2, grid).total


# ---- work under way --------------------------------------------------------------------------------------------------


def test_of_tasks_at_once_the_last_is_shown_and_each_can_be_cancelled():
    """After the first of two had ended, the other one was neither shown nor could be cancelled."""
    shared = SharedState(State(ready=True))
    tasks = SimpleNamespace(abandonSoon=lambda *ignored: None)
    logic = UltrasoundSceneLogic(slicer.vtkMRMLScene())
    panel = BrowserPanel(shared, logic, tasks, lambda: None)
    messages = shared.now.messages
    first, second = panel.progress("First"), panel.progress("Second")
    report_first, report_second = first.__enter__(), second.__enter__()
    report_first(0.2)
    report_second(0.4)
    assert (messages.progress_title, messages.progress_percent) == ("Second", 40)
    first.__exit__(None, None, None)
    assert (messages.progress_title, messages.progress_percent) == ("Second", 40)
    panel.cancel()
    with pytest.raises(Cancelled):
        report_second(0.5)
    report_first(0.9)  # which was not cancelled
    second.__exit__(None, None, None)
    assert messages.progress_title == ""
    panel.cancel()  # nothing


def test_a_changed_value_brings_the_page_no_other_values(monkeypatch):
    """Nor node lists, tissues and what can be done; a node brings all."""
    read, sent = [], {}
    shared, tasks = SharedState(State(ready=True, commit_fn=sent.update)), SimpleNamespace(start=lambda act: act())
    panel = BrowserPanel(shared, UltrasoundSceneLogic(slicer.vtkMRMLScene()), tasks, lambda: None)
    presenter = panel.presenter
    panel.refresh()
    presenter.parametersChanged()
    sent.clear()
    value = presenter.values.value
    monkeypatch.setattr(presenter.values, "value", lambda name: (read.append(name), value(name))[1])
    monkeypatch.setattr(presenter.tissues, "rows", lambda: 1 / 0)
    panel.set("gainSlider", 7.0)
    presenter.parametersChanged()  # as for every change of the scene's parameters
    assert set(read) == {"display.gain_db"} and sent == {value_of("gainSlider"): 7.0}
    read.clear(), sent.clear()
    panel.set("kindComboBox", "convex")
    presenter.parametersChanged()
    assert all(name.startswith("probe.") for name in read) and "probe.radius_mm" in read
    assert sent[value_of("kindComboBox")] == "convex" and value_of("gainSlider") not in sent
    monkeypatch.undo()
    presenter.logic.scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "head")
    presenter.parametersChanged()
    assert "head" in [item.title for item in panel.shared.now.panel.nodes["mriSelector"]]


# ---- sequences as nodes ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recorded(head):
    """(probe, poses, TrackedSequence) of four images, the second of which was not tracked."""
    probe = PhasedProbe(75.0, 70.0, scan_lines=64)
    poses = tilt_sweep(craniotomy_pose(head.labels, probe), 10.0, 4)
    simulator = UltrasoundSimulator(head.labels, TissueTable.brain(head.tissue_names))
    images = np.stack([frame.image for frame in simulator.sweep(probe, poses)])
    to_probe = ImageGrid.for_probe(probe, None).image_to_probe
    transforms = [{"ImageToProbe": to_probe, "ProbeToReference": pose} for pose in poses]
    transforms[1] = {"ImageToProbe": to_probe}
    return probe, poses, TrackedSequence(images, tuple(transforms), 0.1 * np.arange(4))


@pytest.mark.parametrize(
    "times",
    [
        [0.0, 0.1, 0.2, 0.3],
        [0.0, 0.0, 0.0, 0.3],
        [0.0, 2e-4, 4e-4, 6e-4],  # a fast scanner; a sequence node takes what is within a millisecond for one
        [0.0, 0.1, np.nan, 0.3],
    ],
)
def test_a_sequence_as_nodes_holds_its_images_and_moves_the_probe(recorded, times):
    probe, poses, sequence = recorded
    sequence = replace(sequence, timestamps=times)
    kept, numbers = [poses[0], poses[2], poses[3]], [0, 2, 3]
    scene = slicer.vtkMRMLScene()
    logic = slicer.vtkSlicerSequencesLogic()
    logic.SetMRMLScene(scene)
    transform = scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "Probe")
    browser, node = add_sequence(scene, sequence, "sweep", poses=kept, probe_transform_node=transform)
    assert browser.GetNumberOfItems() == 3 and node.GetNumberOfDataNodes() == 3
    shown = browser.GetProxyNode(node)
    for number, pose in enumerate(kept):
        browser.SetSelectedItemNumber(number)
        logic.UpdateProxyNodesFromSequences(browser)
        assert np.allclose(probe_pose(transform), pose, atol=1e-6)
        image = read_volume(shown)
        assert np.array_equal(image.array[0], sequence.images[numbers[number]])
        in_world = sequence.pose(numbers[number], "ImageToReference")
        assert np.allclose(node_to_world(shown) @ image.ijk_to_ras, in_world, atol=1e-6)
    found = tracked_images(node, None, probe)
    assert len(found.images) == 3
    for pose, expected in zip(found.poses, kept, strict=True):
        assert np.allclose(pose[:3, 1], expected[:3, 1], atol=0.01)
        assert np.linalg.norm(pose[:3, 3] - expected[:3, 3]) < 1.0  # the field is found in the images


def test_equal_times_of_images_follow_each_other():
    assert SequenceIndex.of_times([0.0, 0.1, 2.0]) == SequenceIndex(("0.000000", "0.100000", "2.000000"))
    assert SequenceIndex.of_times([0.1, 0.1, 0.1, 0.3]).values == ("0.100000", "0.100001", "0.100002", "0.300000")
    assert SequenceIndex.of_times([5.0, np.nan, 1.0]).values == ("5.000000", "5.000001", "5.000002")
    assert SequenceIndex(("b", "a", "b"), is_text=True).values == ("b", "a", "b (2)")
    for texts in (("a", "a", "a (1)", "a"), ("a (2)", "a", "a"), ("a", "a", "a")):
        assert len(set(SequenceIndex(texts, is_text=True).values)) == len(texts), texts
    sequence = TrackedSequence(np.ones((3, 8, 8), np.uint8), ({"ImageToReference": np.eye(4)},) * 3, [0.2, 0.2, np.nan])
    scene, logic = slicer.vtkMRMLScene(), slicer.vtkSlicerSequencesLogic()
    logic.SetMRMLScene(scene)
    _, images = add_sequence(scene, sequence, "sweep")
    assert [images.GetNthDataNode(number).GetAttribute(TIME) for number in range(3)] == ["0.200000", "0.200000", None]
    assert (images.GetIndexName(), images.GetIndexUnit(), images.GetIndexTypeAsString()) == ("time", "s", "numeric")


# ---- the probe's shape -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", list(PROBES))
def test_a_probe_has_a_closed_body_and_its_ridge_on_the_left(name):
    probe = PROBES[name]
    body = probe_polydata(probe)
    points = vtk_to_numpy(body.GetPoints().GetData())
    assert points[:, 1].max() == pytest.approx(0.0, abs=1e-3) and points[:, 1].min() < -60
    half = np.abs(probe.origins_mm()[:, 0]).max()
    assert np.abs(points[:, 0]).max() >= half  # it holds all scan lines
    color = vtk_to_numpy(body.GetCellData().GetScalars())
    of_ridge = np.flatnonzero((color == color[-1]).all(axis=1))
    ridge = [points[list(_cell_points(body, cell)), 0].mean() for cell in of_ridge]
    assert ridge and max(ridge) < -0.5 * half
    triangles = vtkTriangleFilter()
    triangles.SetInputData(body)
    cleaned = vtkCleanPolyData()  # sharp edges have their points twice, for their normals
    cleaned.SetInputConnection(triangles.GetOutputPort())
    cleaned.Update()
    mass = vtkMassProperties()
    mass.SetInputData(cleaned.GetOutput())
    assert mass.GetVolume() > 10_000  # mm3
    edges = vtkFeatureEdges()
    edges.SetInputConnection(cleaned.GetOutputPort())
    edges.BoundaryEdgesOn()
    edges.FeatureEdgesOff()
    edges.NonManifoldEdgesOff()
    edges.ManifoldEdgesOff()
    edges.Update()
    assert edges.GetOutput().GetNumberOfCells() == 0  # closed


def _cell_points(polydata, cell: int):
    ids = polydata.GetCell(int(cell)).GetPointIds()
    return (ids.GetId(n) for n in range(ids.GetNumberOfIds()))


@pytest.mark.parametrize("probe", [LinearProbe(38.0, 50.0), ConvexProbe(40.0, 60.0, 100.0), PhasedProbe(80.0, 90.0)])
def test_the_field_as_triangles_has_its_area_and_the_image_lies_on_it(probe):
    field = field_polydata(probe)
    triangles = vtkTriangleFilter()
    triangles.SetInputData(field)
    triangles.Update()
    mass = vtkMassProperties()
    mass.SetInputData(triangles.GetOutput())
    if probe.is_linear:
        area = -2 * probe.first_line * probe.depth_mm
    else:  # a sector between two radii
        radius = probe.apex_radius_mm
        area = -probe.first_line * ((radius + probe.depth_mm) ** 2 - radius**2)
    assert mass.GetSurfaceArea() == pytest.approx(area, rel=0.01)
    points = vtk_to_numpy(field.GetPoints().GetData())
    across, down = vtk_to_numpy(field.GetPointData().GetTCoords()).T
    left, right, top, bottom = probe.image_bounds_mm()
    assert np.allclose(left + across * (right - left), points[:, 0], atol=1e-3)
    assert np.allclose(top + down * (bottom - top), points[:, 1], atol=1e-3)
    assert np.allclose(probe.outline_mm()[:-1], points, atol=1e-4)


# ---- views -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_frozen_image_stays_where_it_was_taken_in_3d_and_in_the_slices():
    """It was draped over the anatomy at the probe's new place."""
    from trame_slicer.core import SlicerApp

    from SlicerUSSim.Logic.mrml.fitting_nodes import fits
    from SlicerUSSim.Logic.mrml.label_nodes import write_labels
    from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic
    from SlicerUSSim.Logic.mrml.nodes import ijk_to_ras, node_called, node_to_world, set_node_to_world
    from SlicerUSSim.Workstation.anatomy import AnatomyViews

    async def scenario():
        app = SlicerApp()
        views = AnatomyViews(app, get_server("views of a test", client_type="vue3"), lambda *ignored: None)
        logic = UltrasoundSceneLogic(app.scene)
        segmentation = segment_mri(head_mri(3.0), thin_sulci=False)
        labels, probe, output = (
            app.scene.AddNewNodeByClass(f"vtkMRML{kind}Node")
            for kind in ("LabelMapVolume", "LinearTransform", "ScalarVolume")
        )
        write_labels(labels, segmentation.labels, segmentation.tissue_names, labels)
        logic.placeProbe(labels, probe)
        logic.simulate(labels, probe, output)
        taken = logic.taken
        views.show_probe(taken.preset.probe, probe)
        views.show_image(taken, taken.grid.field(taken.preset.probe))
        views.follow(taken.probe_to_world, taken.preset.probe)
        logic.holdImage(output)
        moved = taken.probe_to_world.copy()
        moved[:3, 3] += [5.0, -7.0, 9.0]
        set_node_to_world(probe, moved)
        views.follow(moved, taken.preset.probe)
        field, seen = (
            node_called(app.scene, "Model", "Ultrasound field"),
            node_called(app.scene, "ScalarVolume", "Ultrasound as shown"),
        )
        body = node_called(app.scene, "Model", "Probe body")
        in_slices = node_to_world(seen) @ ijk_to_ras(seen)
        shown_ids = {view.get_foreground_volume_id() for view in views.slices}
        views.show_surface(None)  # an empty model
        for name in ("Ultrasound field", "Probe body", "Patient surface"):
            assert not any(fits(role, node_called(app.scene, "Model", name)) for role in ("sheets", "outline")), name
        assert not any(fits(role, seen) for role in ("mri", "second_mri", "real", "output"))
        return (
            node_to_world(field), in_slices, node_to_world(output) @ ijk_to_ras(output), node_to_world(body), moved,
            taken, shown_ids == {seen.GetID()},
        )  # fmt: skip

    field, in_slices, in_scene, body, moved, taken, is_shown = run_in_loop(scenario)
    np.testing.assert_allclose(field, taken.probe_to_world, atol=1e-6)
    np.testing.assert_allclose(in_slices, taken.image_to_world, atol=1e-6)
    np.testing.assert_allclose(in_scene, taken.volume().ijk_to_ras, atol=1e-6)
    np.testing.assert_allclose(body, moved, atol=1e-6)  # the probe has gone on
    assert is_shown


def test_a_view_stands_in_the_plane_that_it_is_called():
    """ "Axial" showed a coronal section until the probe had moved."""
    from trame_slicer.core import SlicerApp

    from SlicerUSSim.Logic.base.vtk_data import matrix_array
    from SlicerUSSim.Logic.mrml.nodes import write_volume
    from SlicerUSSim.Workstation.anatomy import AnatomyViews
    from SlicerUSSim.Workstation.state import ACROSS, IN_PLANE

    normals = {"Axial": [0, 0, 1], "Coronal": [0, 1, 0], "Sagittal": [1, 0, 0]}

    def stand_as_called(views) -> bool:
        for view in views.slices:
            plane = views.planes[view.get_singleton_tag()]
            if plane not in (IN_PLANE, ACROSS):
                normal = matrix_array(view.get_view_node().GetSliceToRAS())[:3, 2]
                np.testing.assert_allclose(abs(normal), normals[plane], atol=1e-6)
        return any(plane in normals for plane in views.planes.values())

    async def scenario():
        app = SlicerApp()
        views = AnatomyViews(app, get_server("planes of a test", client_type="vue3"), lambda *ignored: None)
        assert stand_as_called(views)
        node = app.scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "head")
        write_volume(node, head_mri(4.0))
        views.show_volume(node)
        assert stand_as_called(views)
        for plane in normals:
            views.set_plane("Green", plane)
            assert stand_as_called(views)
            # Those that follow the probe are empty until it is there, and show no other section under their name
            shown = {view.get_singleton_tag(): view.get_background_volume_id() for view in views.slices}
            assert shown["Green"] == node.GetID() and not shown["Red"]
        probe_to_ras = np.array([[1.0, 0, 0, 3], [0, 0, 1, 5], [0, -1, 0, 40], [0, 0, 0, 1]])
        views.follow(probe_to_ras, PhasedProbe(field_of_view_deg=75.0, depth_mm=70.0))
        assert stand_as_called(views)
        red = next(view for view in views.slices if view.get_singleton_tag() == "Red")
        in_view = matrix_array(red.get_view_node().GetSliceToRAS())[:3, 2]
        np.testing.assert_allclose(abs(in_view), [0, 1, 0], atol=1e-6)  # the image plane
        assert red.get_background_volume_id() == node.GetID()
        return True

    assert run_in_loop(scenario)


@pytest.mark.slow
def test_a_scene_is_written_again_after_nodes_are_gone(tmp_path):
    """It named the folder of the last one as the file of a node that was gone, and was refused."""
    from trame_slicer.core import SlicerApp

    from SlicerUSSim.Workstation.export import write_bundle, zipped
    from SlicerUSSim.Workstation.scene_files import read_scene

    app = SlicerApp()
    app.register_module_logic(slicer.vtkSlicerSequencesLogic())
    mri = head_mri(5.0)
    write_volume(app.scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "head"), mri)
    images = app.scene.AddNewNodeByClass("vtkMRMLSequenceNode", "sweep")
    for number in range(2):
        item = slicer.vtkMRMLScalarVolumeNode()
        write_volume(item, Volume(np.ones((1, 4, 4), np.uint8), np.eye(4)))
        images.SetDataNodeAtValue(item, str(number))
    for number in range(2):
        files = write_bundle(app, tmp_path / f"scene {number}")
        told: list[float] = []
        (tmp_path / "scene.mrb").write_bytes(zipped(files, told.append))
        record = read_scene(tmp_path / "scene.mrb")
        assert np.array_equal(record.nodes["mri"].volume.array, mri.array) and 0.0 == told[0] < told[-1] < 1.0
        assert 'useCompression="0"' not in files[f"scene {number}/scene {number}.mrml"].read_text()
        if number == 0:
            app.scene.RemoveNode(images)
