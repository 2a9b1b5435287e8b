"""A MRML scene without Slicer's window: python examples/slicer_scene.py [OUT.mrb]

Loads the demo brain, segments it, places the probe on the cortex, updates the image while the probe slides, records the
sweep as sequences with a browser, and saves a .mrb. When it is opened in 3D Slicer, the module USSim restores its
state: tick Live, and move the probe. The file is read back here to show that it is complete.

Needs pip install "SlicerUSSim[slicer,demo]"; in Slicer's own Python console `slicer.mrmlScene` takes the scene's place.
"""

from __future__ import annotations

import sys
import tempfile
import zipfile
from pathlib import Path
from time import perf_counter

import numpy as np
import slicer

from SlicerUSSim.Logic import Volume
from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.vtk_data import vtk_matrix
from SlicerUSSim.Logic.mri import demo_mri
from SlicerUSSim.Logic.mrml import UltrasoundSceneLogic
from SlicerUSSim.Logic.mrml.nodes import node_to_world, read_volume, write_volume
from SlicerUSSim.Logic.probe import slide_sweep


def new_scene() -> tuple[slicer.vtkMRMLScene, slicer.vtkSlicerSequencesLogic]:
    """A scene with the classes of sequence browsers, which Slicer's own scene has already."""
    scene = slicer.vtkMRMLScene()
    sequences = slicer.vtkSlicerSequencesLogic()
    sequences.SetMRMLScene(scene)
    return scene, sequences


def add_volume(scene, volume: Volume, name: str):
    """Add a volume node as Slicer does when it loads a file."""
    node = scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", name)
    write_volume(node, volume)
    return node


def build(mri: Volume):
    """(scene, its logic, the sequences' logic) with all nodes and one simulated image."""
    scene, sequences = new_scene()
    logic = UltrasoundSceneLogic(scene)
    nodes = logic.parameters
    nodes.mri = add_volume(scene, mri, "MRI")
    nodes.labels = scene.AddNewNodeByClass("vtkMRMLSegmentationNode", "Tissues")
    nodes.probe_transform = scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "Probe")
    nodes.output = scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "Ultrasound")
    nodes.outline = scene.AddNewNodeByClass("vtkMRMLModelNode", "Ultrasound outline")
    logic.preset = logic.preset.changed("probe", kind="convex").changed("display", gain_db=2.0)
    logic.segment(nodes.mri, nodes.labels)
    logic.placeProbe(nodes.labels, nodes.probe_transform)
    return scene, logic, sequences


def sweep_live(logic: UltrasoundSceneLogic, length_mm: float, frames: int) -> tuple[list[np.ndarray], float]:
    """Slide the probe while the image follows it; (poses, images per second)."""
    nodes = logic.parameters
    poses = slide_sweep(node_to_world(nodes.probe_transform), length_mm, frames)
    logic.startLiveUpdate(nodes.labels, nodes.probe_transform, nodes.output, nodes.outline)
    start = perf_counter()
    for pose in poses:
        nodes.probe_transform.SetMatrixTransformToParent(vtk_matrix(pose))
    seconds = perf_counter() - start
    logic.stopLiveUpdate()
    return poses, frames / seconds


def record(scene, logic: UltrasoundSceneLogic, sequences, poses) -> None:
    """The sweep as a sequence of transforms and one of images, with a browser that plays both."""
    transforms = scene.AddNewNodeByClass("vtkMRMLSequenceNode", "Sweep")
    images = scene.AddNewNodeByClass("vtkMRMLSequenceNode", "Sweep images")
    for number, pose in enumerate(poses):
        item = slicer.vtkMRMLLinearTransformNode()
        item.SetMatrixTransformToParent(vtk_matrix(pose))
        transforms.SetDataNodeAtValue(item, f"{0.05 * number:.2f}")
    browser = scene.AddNewNodeByClass("vtkMRMLSequenceBrowserNode", "Sweep browser")
    browser.SetAndObserveMasterSequenceNodeID(transforms.GetID())
    sequences.UpdateProxyNodesFromSequences(browser)
    logic.simulateSequence(logic.parameters.labels, transforms, images, browser_node=browser)


def save(scene, path: Path) -> None:
    """Write a .mrb."""
    path = path.resolve()
    with tempfile.TemporaryDirectory() as folder:  # where the scene puts its files together
        scene.SetURL(str(Path(folder) / "scene.mrml"))
        scene.SetRootDirectory(folder)
        require(bool(scene.WriteToMRB(str(path))), f"{path}: cannot be written")


def read_back(path: Path):
    """A new scene from a .mrb."""
    scene, _sequences = new_scene()
    with tempfile.TemporaryDirectory() as folder:
        zipfile.ZipFile(path).extractall(folder)
        scene.SetURL(str(next(Path(folder).rglob("*.mrml"))))
        require(bool(scene.Import()), f"{path}: cannot be read")
    return scene


def main(path: Path) -> None:
    scene, logic, sequences = build(demo_mri()[0])
    poses, rate = sweep_live(logic, 12.0, 13)
    print(f"{len(poses)} images followed the probe, {rate:.0f} per second")
    record(scene, logic, sequences, poses)
    save(scene, path)

    again = UltrasoundSceneLogic(read_back(path))
    nodes = again.parameters
    require(again.preset == logic.preset, "the preset has changed on its way through the file")
    frame = again.simulate(nodes.labels, nodes.probe_transform, nodes.output)
    same = float(np.mean(frame.image == read_volume(logic.parameters.output).array[0]))
    print(f"read back, the scene simulates the same image ({same:.2%})")
    print(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB)", file=sys.stderr)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "ultrasound.mrb"))
