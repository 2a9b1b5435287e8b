"""Benchmarks: lower bounds, tables, comparison. No test depends on a time."""

from __future__ import annotations

import argparse
import json
import re

import numpy as np
import pytest
from scipy.integrate import trapezoid

from benchmarks.compare import comparison
from benchmarks.frames import run_benchmark, table_of
from benchmarks.measuring import Machine, frame_work, output_file, result_file
from SlicerUSSim.Logic import ConvexProbe
from SlicerUSSim.Logic.imaging.scattering import scatterer_counts, sites_per_mm3
from SlicerUSSim.Logic.imaging.stage import Work
from SlicerUSSim.Logic.opencl.devices import choose_device
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from tests.conftest import SPECKLE, block, rigid, simulator

STAGES = {
    "aperture",
    "ray tree",
    "scatterers",
    "interfaces",
    "beam",
    "side lobes",
    "pulse",
    "B-mode",
    "scan conversion",
}


@pytest.fixture(scope="module")
def solid():
    return simulator(block(lambda x, y, z: np.ones_like(x), half_mm=(25, 25, 25)), SPECKLE, interfaces=False)


def test_the_floor_is_what_takes_longer_moving_or_computing():
    machine = Machine(bytes_per_s=1e9, operations_per_s=1e10)
    assert machine.floor_ms(Work(bytes=2e6, operations=1e6)) == pytest.approx(2.0)
    assert machine.floor_ms(Work(bytes=2e3, operations=5e7)) == pytest.approx(5.0)


def test_a_machine_is_measured_within_what_machines_can_do(solid):
    machine = Machine.measure(solid.device, repeat=2)
    assert 1e8 < machine.bytes_per_s < 1e14
    assert 1e8 < machine.operations_per_s < 1e16


def test_the_work_of_a_frame_grows_with_its_depth(solid):
    pose = rigid(np.eye(3), [0, -20, 0])
    foci = {"focus_mm": 15.0, "elevation_focus_mm": 15.0}
    probe, deeper = (ConvexProbe(30, 50, depth, scan_lines=64, **foci) for depth in (20.0, 40.0))
    work, more = (frame_work(solid, p, pose, ImageGrid.for_probe(p, None)) for p in (probe, deeper))
    assert set(work) == STAGES | {"smoothing", "grey map", "edges"} and work["edges"].operations == 0
    for stage in STAGES - {"interfaces", "scan conversion"}:  # nothing reflects; an image has as many rows
        assert work[stage].bytes > 0
        assert more[stage].operations > 1.5 * work[stage].operations > 0


def test_scatterers_are_counted_by_the_volume_of_the_beam(solid):
    """Without refraction the strips of all lines fill the field: area between arcs times height times density."""
    probe, pose = ConvexProbe(30, 50, 30, scan_lines=64), rigid(np.eye(3), [0, -20, 0])
    tree = solid.trace(probe, pose)
    inside = (tree.segment_line >= 0) & (tree.segment_line <= 63)
    found, looked_at = scatterer_counts(solid.device_frame(probe, pose), tree.segments[inside], solid.device.chunk)
    depth = np.linspace(0, float(solid.acquisition(probe, pose)["traced_mm"]), 1001)
    height = 2 * solid.settings.beam_cutoff * probe.beam_sigma_mm(depth)[1]
    width = np.deg2rad(50) * (30 + depth) * 64 / 63  # half a strip beyond either edge
    expected = sites_per_mm3(solid.settings, probe) * trapezoid(width * height, depth)
    assert found == pytest.approx(expected, rel=0.02)
    assert 1.2 * found < looked_at < 6 * found


def result(frame_ms: float) -> dict:
    times = {"best_ms": frame_ms, "median_ms": frame_ms + 1}
    frame = {"whole": times, "display changed": times, "stages": {"beam": times}}
    return {"devices": {"PoCL": {"frames": {"A": frame}, "segmentation": times}}}


def test_two_results_are_compared_row_by_row():
    text = comparison(result(30.0), result(12.0))
    assert re.search(r"frame A: beam +30.00 ms +12.00 ms +2.50x", text)
    assert re.search(r"segmentation +30.00 ms +12.00 ms +2.50x", text)


@pytest.mark.slow
def test_every_stage_has_its_time_and_its_lower_bound(solid):
    result = run_benchmark([choose_device()[0]], repeat=2, brief=True, progress=lambda text: None)
    (device,), text = result["devices"].values(), table_of(result)
    assert set(device["frames"]) == {"A"} and set(device["frames"]["A"]["stages"]) >= STAGES
    for stage in STAGES:
        row = device["frames"]["A"]["stages"][stage]
        assert row["floor_ms"] > 0 and 0 < row["best_ms"] <= row["median_ms"]
        assert re.search(rf"{stage} +[\d.]+ ms", text)


def test_files_of_the_scripts_are_refused_before_anything_is_measured(tmp_path):
    assert output_file(str(tmp_path / "new.json")) == tmp_path / "new.json"
    with pytest.raises(argparse.ArgumentTypeError, match=r"nowhere does not exist"):
        output_file(str(tmp_path / "nowhere" / "new.json"))
    kept = tmp_path / "kept.json"
    kept.write_text(json.dumps(result(1.0)))
    assert result_file(str(kept)) == result(1.0)
    for text, message in (("{", "cannot be read"), ("[1]", "has no devices"), ('{"a": 1}', "has no devices")):
        kept.write_text(text)
        with pytest.raises(argparse.ArgumentTypeError, match=message):
            result_file(str(kept))
