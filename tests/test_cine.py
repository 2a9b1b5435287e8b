"""The shown image and its record, the cine with its echoes, and DICOM files, without a browser."""

from __future__ import annotations

import asyncio
import io
import json
from dataclasses import replace
from types import SimpleNamespace

import highdicom
import numpy as np
import pydicom
import pytest
from PIL import Image

from SlicerUSSim.Logic import SimulationError
from SlicerUSSim.Logic.imaging.noise import seed_of_pose
from SlicerUSSim.Logic.probe.poses import turned
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence

slicer = pytest.importorskip("slicer", reason="MRML nodes come with slicer-core: pip install '.[slicer]'")
pytest.importorskip("trame_slicer", reason="the workstation comes with: pip install '.[serve]'")

from trame_server.state import State  # noqa: E402

from SlicerUSSim.Logic.mrml.nodes import Observed, node_to_world, set_node_to_world  # noqa: E402
from SlicerUSSim.Logic.mrml.taken_files import sequence_file  # noqa: E402
from SlicerUSSim.Workstation import cine as cine_module, image_flow  # noqa: E402
from SlicerUSSim.Workstation.browser_panel import BrowserPanel  # noqa: E402
from SlicerUSSim.Workstation.cine import Cine  # noqa: E402
from SlicerUSSim.Workstation.export import ultrasound_file  # noqa: E402
from SlicerUSSim.Workstation.image_flow import ImageFlow, LatencyStamps  # noqa: E402
from SlicerUSSim.Workstation.state import SharedState  # noqa: E402
from SlicerUSSim.Workstation.tasks import Tasks  # noqa: E402
from tests.test_browser_parts import head as head, live_scene, run_in_loop  # noqa: E402


class Bench:
    """Live images of a head and their cine; what else gets images takes note of poses only."""

    def __init__(self, head) -> None:
        self.errors: list[Exception] = []
        self.tasks = Tasks(self.errors.append)
        self.logic, labels, self.probe, output = live_scene(head, self.tasks)
        parameters = self.logic.parameters
        parameters.labels, parameters.probe_transform, parameters.output = labels, self.probe, output
        self.logic.preset = self.logic.preset.changed("probe", scan_lines=64, depth_mm=60.0)
        self.shared, self.followed, nothing = SharedState(State(ready=True)), [], lambda *ignored: None
        panel = BrowserPanel(self.shared, self.logic, self.tasks, nothing)
        views = SimpleNamespace(
            show_image=nothing, hide_image=nothing, follow=lambda pose, _: self.followed.append(pose)
        )
        methods = ("show_at", "stop", "compare", "sees_nothing", "tell_whether_at")
        comparison = SimpleNamespace(**dict.fromkeys(methods, nothing))
        self.cine = Cine(panel, comparison, lambda pose: set_node_to_world(self.probe, pose))
        tracker = SimpleNamespace(send=nothing)
        self.flow = ImageFlow(panel, views, comparison, self.cine, tracker, LatencyStamps())
        self.node = Observed("ImageDataModifiedEvent", self.flow.image_changed)
        self.node.watch(output)
        self.image, self.state = self.shared.now.image, self.shared.now.cine

    async def run(self, method, *arguments) -> None:
        self.tasks.start(lambda: method(*arguments))
        while not self.tasks.are_done:
            await asyncio.sleep(0.005)
        assert not self.errors and not self.shared.now.messages.errors

    async def move(self, rock_deg: float = 2.0) -> None:
        await self.run(set_node_to_world, self.probe, turned(node_to_world(self.probe), rock_deg=rock_deg))

    async def display(self, **values) -> None:
        self.logic.preset = self.logic.preset.changed("display", **values)
        await self.run(self.cine.follow_display)

    async def frozen(self, images: int, each=lambda: None) -> list:
        await self.run(self.cine.freeze)
        for _ in range(images - 1):
            each()
            await self.move()
        await self.run(self.cine.freeze)
        while any(kept.echoes is None for kept in self.cine._kept):
            await asyncio.sleep(0.005)
        return [kept.taken for kept in self.cine._kept]

    def tell(self) -> tuple[str, str]:
        self.flow.tell()
        return self.image.status, self.image.differs


@pytest.fixture
def clock(monkeypatch):
    clock = SimpleNamespace(now=0.0)
    for module in (cine_module, image_flow):
        monkeypatch.setattr(module, "perf_counter", lambda: clock.now)
    return clock


def on_bench(head, scenario):
    async def run():
        bench = Bench(head)
        try:
            await scenario(bench)
        finally:
            bench.logic.stopLiveUpdate()
            bench.tasks.stop()

    run_in_loop(run)


def test_an_image_is_live_only_while_its_record_is_that_of_now(head, clock):
    """After Segment the previous image stood unmarked for 9 s."""

    async def scenario(bench) -> None:
        assert bench.tell() == ("", "")
        await bench.run(bench.cine.freeze)
        assert bench.image.status == "LIVE" and (bench.image.values["Depth"], bench.image.values["Gain"]) == (
            "60 mm",
            "+0 dB",
        )
        bench.logic.parameters.labels.GetImageData().Modified()  # as Segment writes them; no image has come yet
        assert bench.tell() == ("LIVE", "")
        clock.now = 0.45
        assert bench.tell() == ("LIVE", "")
        clock.now = 0.55
        assert bench.tell() == ("OUTDATED", "tissues")
        await bench.move()
        assert (bench.image.status, bench.image.differs) == ("LIVE", "")
        await bench.run(bench.cine.freeze)
        assert (bench.image.status, bench.image.differs) == ("FROZEN", "")
        seen, pose = len(bench.followed), bench.logic.taken.probe_to_world
        await bench.move()
        assert bench.tell() == ("FROZEN", "pose")
        assert all(np.array_equal(one, pose) for one in bench.followed[seen:])
        outline, probe = bench.logic.parameters.outline, bench.logic.preset.probe
        middle = (pose @ [0.0, probe.depth_mm, 0.0, 1.0])[:3]
        lines = [outline.GetPolyData().GetPoint(n) for n in range(outline.GetPolyData().GetNumberOfPoints())]
        assert outline.GetTransformNodeID() is None and min(np.linalg.norm(lines - middle, axis=1)) < 1.0

    on_bench(head, scenario)


def test_frozen_images_are_shown_and_played_where_they_were_taken(head):
    async def scenario(bench) -> None:
        taken, state = await bench.frozen(4), bench.state
        assert (state.length, state.index, state.first, state.last) == (4, 3, 0, 3) and state.seconds > 0
        await bench.run(bench.cine.show, 1)
        assert state.index == 1 and np.array_equal(bench.logic.taken.image, taken[1].image)
        np.testing.assert_allclose(node_to_world(bench.probe), taken[1].probe_to_world, atol=1e-9)
        assert bench.image.status == "FROZEN" and bench.image.time == f"{taken[1].time[11:19]} UTC"
        await bench.run(bench.cine.step, 9)
        assert state.index == 3
        bench.cine.trim(2, 1)
        await bench.run(bench.cine.play)
        indices = set()
        while len(indices) < 2:
            indices.add(state.index)
            await asyncio.sleep(0.005)
        await bench.run(bench.cine.freeze)
        assert indices == {1, 2} and not state.playing and bench.image.status == "LIVE"
        assert (state.length, state.first, state.last) == (5, 0, 4)

    on_bench(head, scenario)


def test_gain_acts_on_frozen_echoes_and_back_are_the_same_pixels(head):
    async def scenario(bench) -> None:
        await bench.frozen(2)
        kept = bench.logic.taken
        await bench.display(gain_db=6.0, depth_gain_7_db=8.0, grey_map="soft", persistence=0.5)
        shown, display = bench.logic.taken, replace(bench.logic.preset.display, persistence=0.0)
        assert (bench.image.values["Gain"], shown.time, bench.image.status) == ("+6 dB", kept.time, "FROZEN")
        simulator = bench.logic.patients.simulator(bench.logic.patients.imaged(bench.logic.parameters.labels))
        pose = kept.frame.probe_to_ras
        now = simulator.simulate(kept.preset.probe, pose, display, noise_seed=seed_of_pose(pose)).image
        off, change = np.abs(shown.image.astype(int) - now), np.abs(now.astype(int) - kept.image)
        assert (off > 1).mean() < 1e-3 and (change > 10).mean() > 0.1  # smoothing reaches behind the end of lines
        await bench.run(bench.cine.step, -1)
        assert bench.image.values["Gain"] == "+6 dB" and bench.logic.taken.time < kept.time
        await bench.run(bench.cine.step, 1)
        await bench.move()
        pose = node_to_world(bench.probe)
        await bench.display(gain_db=0.0, depth_gain_7_db=0.0, grey_map="linear")
        assert np.array_equal(bench.logic.taken.image, kept.image) and bench.image.values["Gain"] == "+0 dB"
        assert np.array_equal(node_to_world(bench.probe), pose)  # the image stays, and so does the probe

    on_bench(head, scenario)


def test_a_cine_has_ten_seconds_and_a_bounded_memory(head, clock, monkeypatch):
    async def scenario(bench) -> None:
        await bench.frozen(7, lambda: setattr(clock, "now", clock.now + 3.0))
        kept = bench.cine._kept
        assert [one.seconds for one in kept] == [9.0, 12.0, 15.0, 18.0] and bench.state.seconds == 9.0
        size = kept[0].echoes.parts.nbytes + kept[0].taken.image.nbytes
        assert bench.logic.lastFrame.iq.nbytes == 2 * kept[0].echoes.parts.nbytes
        monkeypatch.setattr(cine_module, "_MOST_BYTES", 2 * size)
        assert len(await bench.frozen(2)) == 2
        bench.logic.preset = bench.logic.preset.changed("probe", depth_mm=50.0)
        assert {one.preset.probe.depth_mm for one in await bench.frozen(2)} == {50.0}

    on_bench(head, scenario)


def test_a_line_over_time_and_the_cine_as_a_sequence(head, clock, tmp_path, monkeypatch):
    sent = []

    async def scenario(bench) -> None:
        monkeypatch.setattr(bench.cine.mmode, "send", lambda image, **about: sent.append((image, about)))
        taken = await bench.frozen(3, lambda: setattr(clock, "now", clock.now + 2.0))
        grid = taken[0].grid
        (dx, dy), column = grid.pixel_spacing_mm, grid.columns // 2
        x, y = grid.left_mm + (column + 0.5) * dx, grid.top_mm + 0.5 * dy
        bench.cine.draw_mmode([x, y, x, y + (grid.rows - 1) * dy])
        image, about = sent[-1]
        assert about["ruler"] == {"w": 4.0, "h": pytest.approx((grid.rows - 1) * dy)}
        down = np.linspace(0, grid.rows - 1, len(image)).round().astype(int)
        for at, one in zip((0, image.shape[1] // 2 + 1, -1), taken, strict=True):
            assert np.abs(image[:, at].astype(int) - one.image[down, column]).mean() < 4
        bench.cine.draw_mmode(None)
        bench.cine.draw_mmode([0.0, 0.0, float("nan"), 1.0])
        assert len(sent) == 1
        bench.cine.trim(1, 2)
        path = tmp_path / "cine.igs.mha"
        path.write_bytes(sequence_file(list(bench.cine.displayed(lambda share: None))))
        read = TrackedSequence.read(path)
        assert read.is_simulated and read.timestamps.tolist() == [0.0, 2.0]
        np.testing.assert_array_equal(read.images[1], taken[2].image)
        place = taken[2].probe_to_world @ grid.image_to_probe
        np.testing.assert_allclose(read.pose(1, "ImageToReference"), place, atol=1e-5)
        assert json.loads(read.fields["SlicerUSSim"])["time"] == taken[2].time

    on_bench(head, scenario)


# ---- DICOM -----------------------------------------------------------------------------------------------------------

ABOUT = {"x0": 40, "y0": 30, "x1": 340, "y1": 280, "mm_x": 0.21, "mm_y": 0.2, "frame_ms": 62.5}
TAKEN = SimpleNamespace(patient="Müller=head^1\\.nii.gz", time="2026-11-29T14:47:38.123+00:00")


def composed(frames: int, **about) -> dict[str, bytes]:
    """What a page sends: a cross at the ends of a distance of 40 mm down the image."""
    sent = {"": json.dumps(ABOUT | about).encode()}
    for number in range(frames):
        image = np.full((320, 400, 3), number, np.uint8)
        image[50, 100] = image[250, 100] = (255, 255, 0)
        buffer = io.BytesIO()
        Image.fromarray(image).save(buffer, "PNG")
        sent[f"{number}.png"] = buffer.getvalue()
    return sent


@pytest.mark.parametrize("frames", [1, 5])
def test_a_dicom_ultrasound_image_is_calibrated(frames, tmp_path):
    path = tmp_path / "ultrasound.dcm"
    path.write_bytes(ultrasound_file(composed(frames), TAKEN))
    data = pydicom.dcmread(path)
    assert data.SOPClassUID.name.startswith("Ultrasound ") and ("Multi" in data.SOPClassUID.name) == (frames > 1)
    assert data.BurnedInAnnotation == "YES" and "Simulated" in data.SeriesDescription and data.ImageType[0] == "DERIVED"
    assert str(data.PatientName) == "Müller head 1 .nii.gz" and (data.StudyDate, data.StudyTime) == (
        "20261129",
        "144738",
    )
    pixels = data.pixel_array.reshape(frames, 320, 400, -1)
    assert pixels.shape[-1] == 3 and np.array_equal(pixels[:, 0, 0, 0], np.arange(frames))
    (region,) = data.SequenceOfUltrasoundRegions
    ends = np.argwhere(pixels[0, ..., 0] == 255)
    assert (region.RegionLocationMinX0, region.RegionLocationMaxX1, region.RegionLocationMaxY1) == (40, 339, 279)
    down, across = np.diff(ends, axis=0)[0] * [region.PhysicalDeltaY, region.PhysicalDeltaX] * 10.0
    assert region.PhysicalUnitsXDirection == region.PhysicalUnitsYDirection == 3
    assert np.hypot(down, across) == pytest.approx(40.0, abs=0.3) and region.PhysicalDeltaX == 0.021
    if frames > 1:
        assert (data.NumberOfFrames, data.FrameTime, data.FrameIncrementPointer) == (5, 62.5, 0x00181063)
    assert highdicom.imread(path).get_raw_frame(1)


@pytest.mark.parametrize(
    "sent",
    [{}, composed(0), composed(1, x1=401), composed(1, mm_x=0), composed(2, frame_ms="nan"), composed(1, y0="nan"),
     {"": b"[]", "a.png": b"GIF"}, composed(1) | {"b.png": composed(1)["0.png"][:60]}],
)  # fmt: skip
def test_frames_that_make_no_image_are_one_line(sent):
    with pytest.raises(SimulationError, match=r"^the (frames|region) .*(expected|cannot be read)") as error:
        ultrasound_file(sent, TAKEN)
    assert "\n" not in str(error.value)
