"""Time from interpreter start to the first image in a new process with empty kernel caches, and peak memory.

    python -m benchmarks.cold_start [--json FILE]

Frame A of frames.py, once from a label map in a file and once from the MRI, on every OpenCL device found.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from time import perf_counter

from benchmarks.frames import FRAMES
from benchmarks.measuring import output_file
from SlicerUSSim.Logic import TissueTable, UltrasoundSimulator, Volume, segment_mri
from SlicerUSSim.Logic.base import write_json
from SlicerUSSim.Logic.mri import demo_mri
from SlicerUSSim.Logic.opencl.devices import devices_to_measure
from SlicerUSSim.Logic.probe import craniotomy_pose

NAMES = ("csf", "grey matter", "white matter")


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--json", type=output_file, help="write the results to this file")
    parser.add_argument("--first-frame", metavar="DEVICE", help=argparse.SUPPRESS)
    parser.add_argument("--labels", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.first_frame:
        return first_frame(arguments.first_frame, arguments.labels)
    results = {}
    segmentation = segment_mri(demo_mri()[0], thin_sulci=False)
    with tempfile.TemporaryDirectory() as folder:
        labels = Path(folder) / "labels.nii.gz"
        segmentation.labels.write(labels)
        for info in devices_to_measure():
            for start, extra in (("label map", ["--labels", str(labels)]), ("MRI", [])):
                results[f"{info.platform}, from {start}"] = cold = run_first_frame(info.index, extra)
                print(f"{info.platform:26s} from {start:10s} {cold['seconds']:5.1f} s, peak {cold['peak_mb']:5.0f} MB")
    if arguments.json:
        write_json(arguments.json, results)


def run_first_frame(device: str, extra: list[str]) -> dict[str, float]:
    """Seconds to the first image and peak memory, in a separate process with empty caches."""
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
        labels, names = Volume.read(label_file), NAMES
    else:
        segmentation = segment_mri(demo_mri()[0], device=device, thin_sulci=False)
        labels, names = segmentation.labels, segmentation.tissue_names
    simulator = UltrasoundSimulator(labels, TissueTable.brain(names), device=device)
    simulator.simulate(FRAMES["A"], craniotomy_pose(labels, FRAMES["A"]))
    print(peak_memory_mb())


def peak_memory_mb() -> float:
    """Peak resident memory of this process since its start."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(float(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))
    except OSError:
        # Includes the memory of the parent process at the start.
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    main()
