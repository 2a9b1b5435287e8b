"""Time that MRML adds to a frame: the simulator alone and the scene's live update, alternating in one run.

    python -m benchmarks.live [--repeat N] [--device NAME]

Frame A (phased array, 196 scan lines, 73 mm deep) on the MNI152 segmentation. "live" is one change of the probe's
transform node until the output volume has the new image, through the observers, with an event loop that runs at once.
Needs pip install "SlicerUSSim[slicer,demo]".
"""

from __future__ import annotations

import argparse
from statistics import median
from time import perf_counter

import slicer

from SlicerUSSim.Logic import PhasedProbe, UltrasoundSimulator
from SlicerUSSim.Logic.base.vtk_data import vtk_matrix
from SlicerUSSim.Logic.mri import demo_mri
from SlicerUSSim.Logic.mrml import UltrasoundSceneLogic
from SlicerUSSim.Logic.mrml.nodes import node_to_world, write_volume
from SlicerUSSim.Logic.probe import slide_sweep

PROBE_A = PhasedProbe(75, 73, scan_lines=196)


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--repeat", type=int, default=60, help="frames of each kind")
    parser.add_argument("--device", help="see `ussim devices`")
    arguments = parser.parse_args()
    for kind in ("Segmentation", "LabelMapVolume"):
        alone, live = measure(kind, arguments.repeat, arguments.device)
        extra = sorted(b - a for a, b in zip(alone, live, strict=True))
        print(
            f"{kind:15s} simulator best {min(alone):6.2f} median {median(alone):6.2f} ms   "
            f"live best {min(live):6.2f} median {median(live):6.2f} ms   "
            f"MRML adds {min(live) - min(alone):5.2f} ms (best), {median(extra):5.2f} ms (median of pairs)"
        )


def measure(kind: str, repeat: int, device: str | None) -> tuple[list[float], list[float]]:
    """(milliseconds of the simulator alone, of the live update) for the same poses."""
    scene = slicer.vtkMRMLScene()
    logic = UltrasoundSceneLogic(scene, device)
    logic.preset = logic.preset.changed("probe", **{**PROBE_A.to_dict(), "kind": "phased"})
    node = scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "MRI")
    write_volume(node, demo_mri()[0])
    labels = scene.AddNewNodeByClass(f"vtkMRML{kind}Node", "Tissues")
    probe = scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "Probe")
    output = scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "Ultrasound")
    outline = scene.AddNewNodeByClass("vtkMRMLModelNode", "Outline")
    segmentation = logic.segment(node, labels)
    simulator = UltrasoundSimulator(
        segmentation.labels, logic.preset.tissues.for_names(segmentation.tissue_names), logic.preset.settings, device
    )
    logic.placeProbe(labels, probe)
    logic.startLiveUpdate(labels, probe, output, outline)
    poses = slide_sweep(node_to_world(probe), 10.0, repeat)
    alone, live = [], []
    for pose in poses:
        start = perf_counter()
        simulator.simulate(logic.preset.probe, pose, logic.preset.display)
        middle = perf_counter()
        probe.SetMatrixTransformToParent(vtk_matrix(pose))
        end = perf_counter()
        alone.append(1e3 * (middle - start))
        live.append(1e3 * (end - middle))
    return alone, live


if __name__ == "__main__":
    main()
