"""The shown image and its record, the cine with its echoes, and DICOM files, without a browser."""

from __future__ import annotations

import asyncio
import io
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from SlicerUSSim.Logic import SimulationError
from SlicerUSSim.Logic.imaging.frame import Echoes
from SlicerUSSim.Logic.mri.samples import head_mri
from SlicerUSSim.Logic.mri.segmentation import segment_mri
from SlicerUSSim.Logic.probe.poses import turned
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence

slicer = pytest.importorskip("slicer", reason="MRML nodes come with slicer-core: pip install '.[slicer]'")
pytest.importorskip("trame_slicer", reason="the workstation comes with: pip install '.[serve]'")

from trame_server.state import State  # noqa: E402

from SlicerUSSim.Logic.mrml.nodes import node_to_world, set_node_to_world  # noqa: E402
from SlicerUSSim.Workstation import cine as cine_module, image_flow  # noqa: E402
from SlicerUSSim.Workstation.browser_panel import BrowserPanel, Observed  # noqa: E402
from SlicerUSSim.Workstation.cine import Cine  # noqa: E402
from SlicerUSSim.Workstation.dicom_export import ultrasound_file  # noqa: E402
from SlicerUSSim.Workstation.export import sequence_file  # noqa: E402
from SlicerUSSim.Workstation.image_flow import ImageFlow, LatencyStamps  # noqa: E402
from SlicerUSSim.Workstation.state import SharedState  # noqa: E402
from SlicerUSSim.Workstation.tasks import Tasks  # noqa: E402
from tests.test_browser_parts import live_scene, run_in_loop  # noqa: E402


class Bench:
    """Live images of a head and their cine, with views, comparison and tracker that take note of what they get."""

    def __init__(self, head) -> None:
        self.errors: list[Exception] = []
        self.tasks = Tasks(self.errors.append)
        self.logic, labels, self.probe, self.output = live_scene(head, self.tasks)
        parameters = self.logic.parameters
        parameters.labels, parameters.probe_transform, parameters.output = labels, self.probe, self.output
        probe = replace(self.logic.preset.probe, scan_lines=64, depth_mm=60.0)
        self.logic.preset = replace(self.logic.preset, probe=probe)
        self.shared = SharedState(State(ready=True))
        self.panel = BrowserPanel(self.shared, self.logic, self.tasks, lambda: None)
        self.followed: list[np.ndarray] = []
        views = SimpleNamespace(
            show_image=lambda *ignored: None, hide_image=lambda: None, follow=lambda pose, _: self.followed.append(pose)
        )
        comparison = SimpleNamespace(
            streams=(), show_at=lambda pose: False, stop=lambda: None, compare=lambda *ignored: None,
            sees_nothing=lambda grid: None,
        )  # fmt: skip
        self.cine = Cine(self.panel, comparison, lambda pose: set_node_to_world(self.probe, pose))
        tracker = SimpleNamespace(is_on=False)
        self.flow = ImageFlow(self.panel, views, comparison, self.cine, tracker, LatencyStamps())
        self.node = Observed("ImageDataModifiedEvent", self.flow.image_changed)
        self.node.watch(self.output)

    @property
    def image(self):
        return self.shared.now.image

    @property
    def state(self):
        return self.shared.now.cine

    async def run(self, method, *arguments) -> None:
        self.tasks.start(lambda: method(*arguments))
        while not self.tasks.are_done:
            await asyncio.sleep(0.005)
        assert not self.errors and not self.shared.now.messages.errors

    async def move(self, **angles) -> None:
        await self.run(lambda: set_node_to_world(self.probe, turned(node_to_world(self.probe), **angles)))

    async def display(self, **values) -> None:
        await self.run(lambda: setattr(self.logic, "preset", self.logic.preset.changed("display", **values)))
        await self.run(self.cine.follow_display)

    async def frozen(self, images: int) -> None:
        await self.run(self.cine.freeze)
        for _ in range(images - 1):
            await self.move(rock_deg=2.0)
        await self.run(self.cine.freeze)


def on_bench(head, scenario):
    async def run():
        bench = Bench(head)
        try:
            await scenario(bench)
        finally:
            bench.logic.stopLiveUpdate()
            bench.tasks.stop()

    run_in_loop(run)


@pytest.fixture(scope="module")
def head():
    return segment_mri(head_mri(3.5), thin_sulci=True)


def test_an_image_is_live_only_while_its_record_is_that_of_now(head, monkeypatch):
    """After Segment the image of before stood unmarked for 9 s."""
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(image_flow, "perf_counter", lambda: clock.now)

    async def scenario(bench) -> None:
        bench.flow.tell()
        assert bench.image.status == ""
        await bench.run(bench.cine.freeze)
        record = bench.logic.taken.preset
        assert bench.image.status == "LIVE" and bench.image.depth == "60 mm" and bench.image.gain == "+0 dB"
        assert bench.image.time == f"{bench.logic.taken.time[11:19]} UTC" and record.probe.depth_mm == 60.0
        bench.logic.parameters.labels.GetImageData().Modified()  # as Segment writes them; no image has come yet
        bench.flow.tell()
        clock.now = 0.45
        bench.flow.tell()
        assert bench.image.status == "LIVE"
        clock.now = 0.55
        bench.flow.tell()
        assert (bench.image.status, bench.image.differs) == ("OUTDATED", "tissues")
        await bench.move(rock_deg=3.0)
        assert (bench.image.status, bench.image.differs) == ("LIVE", "")
        await bench.run(bench.cine.freeze)
        assert (bench.image.status, bench.image.differs) == ("FROZEN", "")
        seen, pose = len(bench.followed), bench.logic.taken.probe_to_world
        await bench.move(rock_deg=3.0)
        bench.flow.tell()
        assert (bench.image.status, bench.image.differs) == ("FROZEN", "pose")
        assert all(np.array_equal(one, pose) for one in bench.followed[seen:])

    on_bench(head, scenario)


def test_frozen_images_are_shown_again_where_they_were_taken(head):
    async def scenario(bench) -> None:
        await bench.frozen(4)
        taken = [kept.taken for kept in bench.cine._kept]
        assert (bench.state.length, bench.state.index, bench.state.first, bench.state.last) == (4, 3, 0, 3)
        await bench.run(bench.cine.show, 1)
        assert bench.state.index == 1 and np.array_equal(bench.logic.taken.image, taken[1].image)
        np.testing.assert_allclose(node_to_world(bench.probe), taken[1].probe_to_world, atol=1e-9)
        assert bench.image.status == "FROZEN" and bench.image.time == f"{taken[1].time[11:19]} UTC"
        await bench.run(bench.cine.step, 1)
        await bench.run(bench.cine.step, 9)
        assert bench.state.index == 3
        bench.cine.trim(2, 1)
        await bench.run(bench.cine.play)
        indices = set()
        while len(indices) < 2:
            indices.add(bench.state.index)
            await asyncio.sleep(0.005)
        await bench.run(bench.cine.freeze)
        assert indices == {1, 2} and not bench.state.playing and bench.image.status == "LIVE"
        assert (bench.state.length, bench.state.first, bench.state.last) == (5, 0, 4)

    on_bench(head, scenario)
