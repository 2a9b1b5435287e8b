"""Benchmarks: tables, comparison. No test depends on a time."""

from __future__ import annotations

import argparse
import json
import re

import pytest

from benchmarks.compare import comparison
from benchmarks.frames import run_benchmark, table_of
from benchmarks.measuring import output_file, result_file
from SlicerUSSim.Logic.opencl.devices import choose_device

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


def result(frame_ms: float) -> dict:
    times = {"best_ms": frame_ms, "median_ms": frame_ms + 1}
    frame = {"whole": times, "display changed": times, "stages": {"beam": times}}
    return {"devices": {"PoCL": {"frames": {"A": frame}, "segmentation": times}}}


def test_two_results_are_compared_row_by_row():
    text = comparison(result(30.0), result(12.0))
    assert re.search(r"frame A: beam +30.00 ms +12.00 ms +2.50x", text)
    assert re.search(r"segmentation +30.00 ms +12.00 ms +2.50x", text)


@pytest.mark.slow
def test_every_stage_has_its_time():
    result = run_benchmark([choose_device()[0]], repeat=2, brief=True, progress=lambda text: None)
    (device,), text = result["devices"].values(), table_of(result)
    assert set(device["frames"]) == {"A"} and set(device["frames"]["A"]["stages"]) >= STAGES
    for stage in STAGES:
        row = device["frames"]["A"]["stages"][stage]
        assert 0 < row["best_ms"] <= row["median_ms"]
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
