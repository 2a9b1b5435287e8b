"""A tracked sequence as nodes: images, the transforms they were taken at, and a browser that plays both."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.base.vtk_data import vtk_matrix
from SlicerUSSim.Logic.mrml.libraries import slicer
from SlicerUSSim.Logic.mrml.nodes import write_volume
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence


def add_sequence(
    scene,
    sequence: TrackedSequence,
    name: str,
    path: str = "ImageToReference",
    to_ras: np.ndarray | None = None,
    poses: Sequence[np.ndarray] = (),
    probe_transform_node=None,
):
    """(browser, images): a vtkMRMLSequenceBrowserNode and the vtkMRMLSequenceNode of the images in `scene`.

    The images are in pixels under recorded transforms, which take them to the world (RAS); `path` and `to_ras` (4, 4)
    are those of TrackedImages.of. Images that were not tracked are left out. `poses`, one probe_to_ras (4, 4) for each
    image that is kept, become a sequence too, which `probe_transform_node` follows when the browser plays.
    Raises SimulationError if no image was tracked.
    """
    numbers = [number for number in range(len(sequence)) if sequence.has_pose(number, path)] or [0]
    matrices = [sequence.pose(number, path) for number in numbers]
    to_ras = np.eye(4) if to_ras is None else to_ras
    images, transforms = _sequence_node(scene, name), _sequence_node(scene, f"{name} transforms")
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
    if len(poses):
        held = _sequence_node(scene, f"{name} probe")
        for number, pose in zip(numbers, poses, strict=True):
            transform = slicer.vtkMRMLLinearTransformNode()
            transform.SetName(f"{name} probe")
            transform.SetMatrixTransformToParent(vtk_matrix(pose))
            held.SetDataNodeAtValue(transform, f"{sequence.timestamps[number]:.6f}")
        browser.AddSynchronizedSequenceNodeID(held.GetID())
        if probe_transform_node is not None:
            browser.AddProxyNode(probe_transform_node, held, False)
    return browser, images


def _sequence_node(scene, name: str):
    node = scene.AddNewNodeByClass("vtkMRMLSequenceNode", scene.GenerateUniqueName(name))
    node.SetIndexName("time")
    node.SetIndexUnit("s")
    return node
