"""A tracked sequence as nodes: images, the transforms they were taken at, and a browser that plays both."""

from __future__ import annotations

import numpy as np
import slicer

from SlicerUSSim.Logic.scene_nodes import write_volume
from SlicerUSSim.Logic.sequence import TrackedSequence
from SlicerUSSim.Logic.volume import Volume
from SlicerUSSim.Logic.vtk_data import vtk_matrix


def add_sequence(
    scene, sequence: TrackedSequence, name: str, path: str = "ImageToReference", to_ras: np.ndarray | None = None
):
    """(browser, images, transforms): a vtkMRMLSequenceBrowserNode and two vtkMRMLSequenceNodes in `scene`.

    The images are in pixels under the transforms, which take them to the world (RAS); `path` and `to_ras` (4, 4) are
    those of TrackedImages.of. Images that were not tracked are left out.
    Raises SimulationError if none were.
    """
    numbers = [number for number in range(len(sequence)) if sequence.has_pose(number, path)] or [0]
    matrices = [sequence.pose(number, path) for number in numbers]
    to_ras = np.eye(4) if to_ras is None else to_ras
    images, transforms = (
        scene.AddNewNodeByClass("vtkMRMLSequenceNode", scene.GenerateUniqueName(f"{name}{end}"))
        for end in ("", " transforms")
    )
    for node in (images, transforms):
        node.SetIndexName("time")
        node.SetIndexUnit("s")
    for number, matrix in zip(numbers, matrices, strict=True):
        index = f"{sequence.timestamps[number]:.6f}"
        image = slicer.vtkMRMLScalarVolumeNode()
        image.SetName(name)
        write_volume(image, Volume(sequence.images[number][None], np.eye(4)))
        images.SetDataNodeAtValue(image, index)
        transform = slicer.vtkMRMLLinearTransformNode()
        transform.SetName(f"{name} transform")
        transform.SetMatrixTransformToParent(vtk_matrix(to_ras @ matrix))
        transforms.SetDataNodeAtValue(transform, index)
    browser = scene.AddNewNodeByClass("vtkMRMLSequenceBrowserNode", scene.GenerateUniqueName(f"{name} browser"))
    browser.SetAndObserveMasterSequenceNodeID(transforms.GetID())
    browser.AddSynchronizedSequenceNodeID(images.GetID())
    placed = scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", f"{name} transform")
    placed.SetMatrixTransformToParent(vtk_matrix(to_ras @ matrices[0]))
    shown = scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", f"{name} image")
    write_volume(shown, Volume(sequence.images[numbers[0]][None], np.eye(4)))
    shown.SetAndObserveTransformNodeID(placed.GetID())
    browser.AddProxyNode(placed, transforms, False)
    browser.AddProxyNode(shown, images, False)
    return browser, images, transforms
