"""The list of stages: whole, and enough to add a display stage by one class and one line."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import pytest

from benchmarks import frames
from benchmarks.measuring import Machine
from SlicerUSSim.Logic import DisplaySettings, LinearProbe, SimulationError
from SlicerUSSim.Logic.base.settings import FULL_SCALE_DB
from SlicerUSSim.Logic.fitting.appearance import AppearanceModel
from SlicerUSSim.Logic.imaging import stages
from SlicerUSSim.Logic.imaging.bmode import Compressor
from SlicerUSSim.Logic.imaging.scan_conversion import ScanConverter
from SlicerUSSim.Logic.imaging.scattering import LateralBeam
from SlicerUSSim.Logic.imaging.stage import FrameInputs, Stage, Work
from SlicerUSSim.Logic.opencl import device as opencl_device
from SlicerUSSim.Logic.opencl.device import Workspace, kernel_folder
from tests.conftest import SPECKLE, block, rigid, simulator
from tests.reference import NumpyModel
from tests.reference.stages import TWINS, twin_of

ALL_STAGES = (*stages.IMPULSE_STAGES, *stages.LINEAR_STAGES, *stages.DISPLAY_STAGES)
#: Its foci lie so deep that the beam hardly changes, for which numpy needs less time
PROBE = LinearProbe(8, 12, scan_lines=24, frequency_mhz=4, focus_mm=40, elevation_focus_mm=40)
POSE = rigid(np.eye(3), [0.0, -6.0, 0.0])


def make():
    """A simulator of two tissues that differ in level, with few scatterers."""
    labels = block(lambda x, y, z: 1 + (y > 0), (12, 12, 6))
    return simulator(labels, SPECKLE, replace(SPECKLE, name="more", mu0=1.0), scatterers_per_mm3=4.0)


@pytest.fixture(scope="module")
def plain():
    return make()


# ---- the list is whole -----------------------------------------------------------------------------------------------


def test_the_simulator_runs_the_stages_of_the_list_in_its_order():
    found = make()
    assert [type(stage) for stage in found.stages] == list(ALL_STAGES)
    found.profiling = True
    frame = found.simulate(PROBE, POSE)
    names = [stage.name for stage in ALL_STAGES]
    assert list(frame.timings_ms) == ["upload", *names, "download"]
    assert [name for name in names if name in TWINS] == [
        "aperture",
        "ray tree",
        "scatterers",
        "beam",
        "side lobes",
        "interfaces",
        "pulse",
        "B-mode",
        "scan conversion",
    ]


@pytest.mark.parametrize("kind", ALL_STAGES, ids=lambda kind: kind.name)
def test_every_stage_has_its_work_and_one_twin(plain, kind):
    stage, frame = plain.stage(kind), plain.device_frame(PROBE, POSE)
    work = stage.work(frame, plain.trace(PROBE, POSE))
    # These tissues have no interfaces; and a stage that came later may be off by default.
    assert (work.operations >= 0 and work.bytes > 0) or kind.name == "interfaces" or kind.has_own_twin()
    assert callable(twin_of(stage))
    assert kind.has_own_twin() != (kind.name in TWINS)


def test_no_twin_is_left_of_a_stage_that_is_gone():
    assert set(TWINS) <= {kind.name for kind in ALL_STAGES}


def test_work_grows_with_what_is_done(plain):
    beam, tree = plain.stage(LateralBeam), plain.trace(PROBE, POSE)
    few, many = (beam.work(plain.device_frame(replace(PROBE, scan_lines=n), POSE), tree) for n in (16, 64))
    assert many.operations > few.operations > 0 and many.bytes > few.bytes


def test_a_stage_without_work_cannot_be_made(plain):
    class Idle(Stage):
        name = "idle"

        def run(self, frame) -> None:
            pass

    with pytest.raises(TypeError, match="work"):
        Idle(plain.device)  # pyright: ignore[reportAbstractUsage]


def test_a_stage_without_a_twin_is_named(monkeypatch):
    class Alone(Stage):
        name = "alone"

        def run(self, frame) -> None:
            pass

        def work(self, frame, tree) -> Work:
            return Work(0, 0)

    monkeypatch.setattr(stages, "DISPLAY_STAGES", (*stages.DISPLAY_STAGES, Alone))
    found = make()
    assert found.simulate(PROBE, POSE).image.max() > 0
    with pytest.raises(SimulationError, match="stage 'alone' has no twin in numpy, expected on_host in Alone"):
        NumpyModel(found)
    with pytest.raises(NotImplementedError, match="'alone'"):
        found.stage(Alone).on_host(None)  # pyright: ignore[reportArgumentType]


# ---- one class and one line ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Display(DisplaySettings):
    """With what the stages below let a user choose; elsewhere these would be fields of DisplaySettings."""

    smoothing: float = 0.0
    edge: float = 0.0


def _chosen(frame: FrameInputs) -> Display:
    return cast(Display, frame.display)


class LateralSmoothing(Stage):
    """After compression: grey levels of neighbouring scan lines flow together."""

    name = "lateral smoothing"

    def __init__(self, device) -> None:
        super().__init__(device)
        self.kernel = device.kernels("lateral_smoothing.cl", device.lanes)["smooth_lines"]
        self.workspace = Workspace(device)

    def run(self, frame) -> None:
        if not _chosen(frame).smoothing:
            return
        lines, samples = frame.line_shape
        smooth = self.workspace.get("grey", lines * samples)
        size = samples // self.device.lanes, lines
        self.device.run(self.kernel, size, frame.grey, np.int32(samples), np.float32(_chosen(frame).smoothing), smooth)
        frame.grey = smooth

    def work(self, frame, tree) -> Work:
        lines, samples = frame.line_shape
        return Work(2 * lines * samples, 5 * lines * samples)

    def on_host(self, frame) -> None:
        grey = np.pad(frame.grey.astype(np.float32), ((1, 1), (0, 0)), mode="edge")
        beside = 0.5 * (grey[:-2] + grey[2:])
        frame.grey = (grey[1:-1] + np.float32(_chosen(frame).smoothing) * (beside - grey[1:-1]) + 0.5).astype(np.uint8)


SMOOTHING_SOURCE = """
#include "display.clh"
__kernel void smooth_lines(__global const uchar *grey, int samples, float share, __global uchar *smooth) {
  const int sample = get_global_id(0) * LANES, line = get_global_id(1), last = get_global_size(1) - 1;
  const floatn here = GREY_LANES(grey + line * samples + sample);
  const floatn beside = 0.5f * (GREY_LANES(grey + max(line - 1, 0) * samples + sample) +
                                GREY_LANES(grey + min(line + 1, last) * samples + sample));
  STORE_GREY(here + share * (beside - here) + 0.5f, smooth + line * samples + sample);
}
"""


class EdgeEnhancement(Stage):
    """On the envelope: what differs from its surroundings in depth stands out; then it is compressed once more."""

    name = "edge enhancement"

    def __init__(self, device) -> None:
        super().__init__(device)
        self.kernel = device.kernels("edge_enhancement.cl")["enhance"]
        self.workspace = Workspace(device)

    def run(self, frame) -> None:
        display, (lines, samples) = _chosen(frame), frame.line_shape
        if not display.edge:
            return
        enhanced = self.workspace.get("envelope", 4 * lines * samples)
        grey = self.workspace.get("grey", lines * samples)
        self.device.run(
            self.kernel, (samples, lines), frame.envelope, np.float32(display.edge),
            np.float32(FULL_SCALE_DB - display.gain_db), np.float32(display.dynamic_range_db), enhanced, grey,
        )  # fmt: skip
        frame.envelope, frame.grey = enhanced, grey

    def work(self, frame, tree) -> Work:
        lines, samples = frame.line_shape
        return Work(9 * lines * samples, 30 * lines * samples)

    def on_host(self, frame) -> None:
        display, samples = _chosen(frame), frame.line_shape[1]
        n = np.arange(samples)
        around = 0.5 * (frame.envelope[:, np.maximum(n - 4, 0)] + frame.envelope[:, np.minimum(n + 4, samples - 1)])
        frame.envelope = np.maximum(frame.envelope + display.edge * (frame.envelope - around), 1e-6).astype(np.float32)
        below_white = 20.0 * np.log10(frame.envelope) - (FULL_SCALE_DB - display.gain_db)
        frame.grey = np.rint(np.clip(255.0 * (1.0 + below_white / display.dynamic_range_db), 0, 255)).astype(np.uint8)


EDGE_SOURCE = """
#include "display.clh"
__kernel void enhance(__global const float *envelope, float strength, float white_db, float range_db,
                      __global float *enhanced, __global uchar *grey) {
  const int sample = get_global_id(0), samples = get_global_size(0), row = get_global_id(1) * samples;
  const float here = envelope[row + sample];
  const float around = 0.5f * (envelope[row + max(sample - 4, 0)] + envelope[row + min(sample + 4, samples - 1)]);
  const float value = fmax(here + strength * (here - around), 1e-6f);
  enhanced[row + sample] = value;
  STORE_GREY(grey_level(6.02059991f * log2_fast(value), white_db, range_db), grey + row + sample);
}
"""


@pytest.fixture(params=[LateralSmoothing, EdgeEnhancement], ids=lambda stage: stage.name)
def added(request, monkeypatch, tmp_path):
    """A display stage in the list for the time of a test, its kernel file beside the others."""
    folder = tmp_path / "kernels"
    shutil.copytree(kernel_folder(), folder)
    (folder / "lateral_smoothing.cl").write_text(SMOOTHING_SOURCE)
    (folder / "edge_enhancement.cl").write_text(EDGE_SOURCE)
    monkeypatch.setattr(opencl_device, "kernel_folder", lambda: folder)
    *before, last = stages.DISPLAY_STAGES
    assert Compressor in before and last is ScanConverter
    monkeypatch.setattr(stages, "DISPLAY_STAGES", (*before, request.param, last))
    return request.param


ON, OFF = Display(smoothing=0.8, edge=0.7), Display()


def test_the_simulator_uses_an_added_stage(added, plain):
    found = make()
    before, off, on = (s.simulate(PROBE, POSE, d) for s, d in ((plain, ON), (found, OFF), (found, ON)))
    assert np.array_equal(before.image, off.image) and np.array_equal(before.envelope, off.envelope)
    assert (np.abs(on.image.astype(int) - off.image) > 1).mean() > 0.3
    assert np.array_equal(on.iq, off.iq) and not np.array_equal(on.bmode, off.bmode)
    assert np.array_equal(on.envelope, off.envelope) == (added is LateralSmoothing)
    found.profiling = True
    assert list(found.simulate(PROBE, POSE, ON).timings_ms)[-3:] == [added.name, "scan conversion", "download"]


def test_the_appearance_model_uses_an_added_stage(added):
    found = make()
    model = AppearanceModel(found, PROBE, [POSE], {"more": ("mu0",)})
    for display in (ON, OFF):
        exact = found.simulate(PROBE, POSE, display).image
        assert np.abs(model.image(0, found.medium.tissues, display).astype(int) - exact).max() <= 2
    other = found.medium.tissues.replace("more", mu0=0.4)
    with found.with_tissues(other):
        exact = found.simulate(PROBE, POSE, ON).image
    assert np.abs(model.image(0, other, ON).astype(int) - exact).mean() < 0.05


def test_the_benchmark_uses_an_added_stage(added, monkeypatch):
    found = make()
    monkeypatch.setattr(frames, "FRAMES", {"A": PROBE})
    for name in ("smoothing", "edge"):  # as fields of DisplaySettings with these defaults
        monkeypatch.setattr(DisplaySettings, name, getattr(ON, name), raising=False)
    benchmark = frames._DeviceBenchmark(found.device.info, None, 1, print)
    benchmark.simulator, benchmark.poses = found, {"A": POSE}
    row = benchmark._frame("A", Machine(1e9, 1e9))["stages"][added.name]
    assert row["best_ms"] > 0 and row["floor_ms"] > 0 and row["operations"] > 0


@pytest.mark.slow
def test_numpy_uses_an_added_stage(added):
    found = make()
    model = NumpyModel(found)
    image = model.simulate(PROBE, POSE, ON)
    assert list(model.timings_ms)[-2:] == [added.name, "scan conversion"]
    on, off = (found.simulate(PROBE, POSE, display).image.astype(int) for display in (ON, OFF))
    assert (np.abs(on - image) <= 1).mean() > 0.99 > 0.9 > (np.abs(off - image) <= 1).mean()


def test_frames_of_which_the_display_changed_start_from_the_same_echoes(plain):
    """So a display stage must leave the baseband signal as it is."""
    first = plain.simulate(PROBE, POSE)
    plain.simulate(PROBE, POSE, Display(gain_db=6.0))
    again = plain.simulate(PROBE, POSE)
    assert np.array_equal(first.iq, again.iq) and np.array_equal(first.image, again.image)


def test_bases_of_the_appearance_model_do_not_end_up_in_a_frame(plain):
    """They are made by the simulator's stages, in their buffers."""
    first = plain.simulate(PROBE, POSE)
    model = AppearanceModel(plain, PROBE, [POSE], {"more": ("mu0",)})
    assert np.array_equal(plain.simulate(PROBE, POSE).iq, first.iq)
    model.anchor(plain.medium.tissues.replace("more", mu0=0.2))
    assert np.array_equal(plain.simulate(PROBE, POSE).iq, first.iq)
