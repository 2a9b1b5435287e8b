"""The list of stages: whole, and enough to add a display stage by one class and one line."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace

import numpy as np
import pytest

from benchmarks import frames
from SlicerUSSim.Logic import DisplaySettings, LinearProbe
from SlicerUSSim.Logic.fitting.appearance import AppearanceModel
from SlicerUSSim.Logic.imaging import stages
from SlicerUSSim.Logic.imaging.stage import Stage
from SlicerUSSim.Logic.opencl import device as opencl_device
from SlicerUSSim.Logic.opencl.device import Workspace, kernel_folder
from tests.conftest import SPECKLE, block, rigid, simulator

ALL_STAGES = (*stages.IMPULSE_STAGES, *stages.LINEAR_STAGES, *stages.DISPLAY_STAGES)
#: Its foci lie behind the image
PROBE = LinearProbe(8, 12, scan_lines=24, frequency_mhz=4, focus_mm=40, elevation_focus_mm=40)
POSE = rigid(np.eye(3), [0.0, -6.0, 0.0])


def make():
    """A simulator of two tissues that differ in level, with few scatterers."""
    labels = block(lambda x, y, z: 1 + (y > 0), (12, 12, 6))
    return simulator(labels, SPECKLE, replace(SPECKLE, name="more", mu0=1.0), scatterers_per_mm3=4.0)


@pytest.fixture(scope="module")
def plain():
    return make()


def test_the_simulator_runs_the_stages_of_the_list_in_its_order():
    found = make()
    assert [type(stage) for stage in found.stages] == list(ALL_STAGES)
    found.profiling = True
    frame = found.simulate(PROBE, POSE)
    assert list(frame.timings_ms) == ["upload", *(stage.name for stage in ALL_STAGES), "download"]


# ---- one class and one line ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Display(DisplaySettings):
    """With what the stage below lets a user choose; elsewhere it would be a field of DisplaySettings."""

    share: float = 0.0


class Mixing(Stage):
    """After compression: grey levels of neighbouring scan lines flow together."""

    name = "mixing"

    def __init__(self, device) -> None:
        super().__init__(device)
        self.kernel = device.kernels("mixing.cl", device.lanes)["mix_lines"]
        self.workspace = Workspace(device)

    def run(self, frame) -> None:
        if not frame.display.share:
            return
        lines, samples = frame.line_shape
        mixed = self.workspace.get("grey", lines * samples)
        size = samples // self.device.lanes, lines
        self.device.run(self.kernel, size, frame.grey, np.int32(samples), np.float32(frame.display.share), mixed)
        frame.grey = mixed


SOURCE = """
#include "display.clh"
__kernel void mix_lines(__global const uchar *grey, int samples, float share, __global uchar *mixed) {
  const int sample = get_global_id(0) * LANES, line = get_global_id(1), last = get_global_size(1) - 1;
  const floatn here = GREY_LANES(grey + line * samples + sample);
  const floatn beside = 0.5f * (GREY_LANES(grey + max(line - 1, 0) * samples + sample) +
                                GREY_LANES(grey + min(line + 1, last) * samples + sample));
  STORE_GREY(here + share * (beside - here) + 0.5f, mixed + line * samples + sample);
}
"""
ON, OFF = Display(share=0.8), Display()


@pytest.fixture
def added(monkeypatch, tmp_path):
    """A simulator with the stage in the list for the time of a test, its kernel file beside the others."""
    folder = tmp_path / "kernels"
    shutil.copytree(kernel_folder(), folder)
    (folder / "mixing.cl").write_text(SOURCE)
    monkeypatch.setattr(opencl_device, "kernel_folder", lambda: folder)
    *before, last = stages.DISPLAY_STAGES
    monkeypatch.setattr(stages, "DISPLAY_STAGES", (*before, Mixing, last))
    return make()


def test_the_simulator_uses_an_added_stage(added, plain):
    before, off, on = (s.simulate(PROBE, POSE, d) for s, d in ((plain, ON), (added, OFF), (added, ON)))
    assert np.array_equal(before.image, off.image) and np.array_equal(before.envelope, off.envelope)
    assert (np.abs(on.image.astype(int) - off.image) > 1).mean() > 0.3 and np.array_equal(on.iq, off.iq)
    grey = np.pad(off.bmode.astype(float), ((1, 1), (0, 0)), mode="edge")
    assert np.abs(0.2 * grey[1:-1] + 0.4 * (grey[:-2] + grey[2:]) - on.bmode).max() <= 0.501
    added.profiling = True
    assert list(added.simulate(PROBE, POSE, ON).timings_ms)[-3:] == [Mixing.name, "scan conversion", "download"]


def test_the_appearance_model_uses_an_added_stage(added):
    model = AppearanceModel(added, PROBE, [POSE], {"more": ("mu0",)})
    for display in (ON, OFF):
        exact = added.simulate(PROBE, POSE, display).image
        assert np.abs(model.image(0, added.medium.tissues, display).astype(int) - exact).max() <= 2
    other = added.medium.tissues.replace("more", mu0=0.9)
    with added.with_tissues(other):
        exact = added.simulate(PROBE, POSE, ON).image
    assert np.abs(model.image(0, other, ON).astype(int) - exact).mean() < 0.06


def test_the_benchmark_uses_an_added_stage(added, monkeypatch):
    monkeypatch.setattr(frames, "FRAMES", {"A": PROBE})
    monkeypatch.setattr(DisplaySettings, "share", ON.share, raising=False)  # as a field with this default
    benchmark = frames._DeviceBenchmark(added.device.info, None, 1, print)
    benchmark.simulator, benchmark.poses = added, {"A": POSE}
    row = benchmark._frame("A")["stages"][Mixing.name]
    assert row["best_ms"] > 0


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
