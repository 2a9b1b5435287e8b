"""Milliseconds per stage and per frame, on every OpenCL device found.

    python benchmarks/frames.py [--json FILE] [--repeat N]

Frame A: phased array, 196 scan lines, 73 mm deep, 5 MHz. Frame B: convex array, 192 scan lines, 120 mm deep. Both on
the MNI152 labels from the demo's view, ray tree to depth 6, from pose to scan-converted image on the host. Also the
segmentation, a volume compounded from a tilt, and the first frame of a fresh process with empty kernel caches (from
interpreter start to image, from a label map and from the MRI) with its peak memory.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from time import perf_counter

from SlicerUSSim.Logic import (
    ConvexProbe,
    PhasedProbe,
    TissueTable,
    UltrasoundSimulator,
    Volume,
    list_devices,
    segment_mri,
)
from SlicerUSSim.Logic.demo import demo_mri
from SlicerUSSim.Logic.placement import craniotomy_pose, tilt_sweep

PROBES = {"A": PhasedProbe(75, 73, scan_lines=196), "B": ConvexProbe(60, 70, 120, scan_lines=192)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="keep the numbers in this file")
    parser.add_argument("--repeat", type=int, default=30, help="frames per measurement (best and median are shown)")
    parser.add_argument("--first-frame", metavar="DEVICE", help=argparse.SUPPRESS)
    parser.add_argument("--labels", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.first_frame:
        return first_frame(arguments.first_frame, arguments.labels)

    mri, source = demo_mri()
    print(f"{source}, {'x'.join(map(str, mri.array.shape[::-1]))} voxels")
    results = {}
    for info in list_devices():
        print(f"\n{info}")
        results[str(info)] = measured = {}
        runs = [timed(lambda info=info: segment_mri(mri, device=info)) for _ in range(3)]
        times, segmentation = [milliseconds for milliseconds, _ in runs], runs[-1][1]
        measured["segmentation"] = best_and_median(times)
        print(f"  segmentation            {show(times)}")
        simulator = UltrasoundSimulator(segmentation.labels, TissueTable.brain(segmentation.tissue_names), device=info)
        for name, probe in PROBES.items():
            pose = craniotomy_pose(segmentation.labels, probe)
            simulator.profiling = False
            simulator.simulate(probe, pose)
            times = [timed(lambda s=simulator, p=probe, q=pose: s.simulate(p, q))[0] for _ in range(arguments.repeat)]
            measured[f"frame {name}"] = best_and_median(times)
            print(f"  frame {name}                 {show(times)}")
            simulator.profiling = True
            frames = [simulator.simulate(probe, pose) for _ in range(arguments.repeat)]
            for stage in frames[0].timings_ms:
                times = [frame.timings_ms[stage] for frame in frames]
                measured[f"frame {name}: {stage}"] = best_and_median(times)
                print(f"    {stage:22s}{show(times)}")
        simulator.profiling = False
        poses = tilt_sweep(craniotomy_pose(segmentation.labels, PROBES["A"]), 50.0, 51)
        times = [timed(lambda s=simulator, p=poses: s.volume(PROBES["A"], p))[0] for _ in range(2)]
        measured["volume of 51 images"] = best_and_median(times)
        print(f"  volume of 51 images     {show(times)}")
        with tempfile.TemporaryDirectory() as folder:
            labels = Path(folder) / "labels.nii.gz"
            segmentation.labels.write(labels)
            for start, extra in (("label map", ["--labels", str(labels)]), ("MRI", [])):
                measured[f"first frame, cold, from {start}"] = cold = run_first_frame(info.index, extra)
                print(f"  first frame, cold, from {start:10s} {cold['seconds']:.1f} s, peak {cold['peak_mb']:.0f} MB")
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=2) + "\n")


def run_first_frame(device: str, extra: list[str]) -> dict:
    """Seconds from interpreter start to the first image and peak memory, in a process of its own with empty caches."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "XDG_CACHE_HOME": folder, "POCL_CACHE_DIR": folder, "HOME": folder}
        environment.pop("OCL_ICD_VENDORS", None)
        command = [sys.executable, __file__, "--first-frame", device, *extra]
        start = perf_counter()
        output = subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout
        return {"seconds": perf_counter() - start, "peak_mb": float(output)}


def first_frame(device: str, label_file: Path | None) -> None:
    """Simulate frame A once, from a label map or from the MRI; print the peak memory in MB."""
    if label_file:
        labels, names = Volume.read(label_file), ("csf", "grey matter", "white matter")
    else:
        segmentation = segment_mri(demo_mri()[0], device=device)
        labels, names = segmentation.labels, segmentation.tissue_names
    simulator = UltrasoundSimulator(labels, TissueTable.brain(names), device=device)
    simulator.simulate(PROBES["A"], craniotomy_pose(labels, PROBES["A"]))
    print(peak_memory_mb())


def peak_memory_mb() -> float:
    """Peak resident memory of this process since it was started."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(float(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))
    except OSError:
        # Counts what the parent held when it started us, too.
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def timed(function) -> tuple[float, object]:
    """(milliseconds, result)"""
    start = perf_counter()
    result = function()
    return (perf_counter() - start) * 1e3, result


def best_and_median(times: list[float]) -> dict[str, float]:
    return {"best_ms": round(min(times), 3), "median_ms": round(sorted(times)[len(times) // 2], 3)}


def show(times: list[float]) -> str:
    values = best_and_median(times)
    return f"best {values['best_ms']:8.2f} ms   median {values['median_ms']:8.2f} ms"


if __name__ == "__main__":
    main()
