"""Sequence nodes: index values of their items, tracked images with a browser, and what is known of these."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import count, pairwise
from math import inf, isfinite, nan, ulp
from typing import Any

import numpy as np
import slicer

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.transforms import check_affine, check_rigid
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.base.vtk_data import vtk_matrix
from SlicerUSSim.Logic.mrml.nodes import named, write_volume
from SlicerUSSim.Logic.probe.arrays import probe_from_dict
from SlicerUSSim.Logic.tracked.imaged_field import ImagedField
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence

#: Attribute of an image in a sequence: its time in seconds, independent of its index value.
TIME = "SlicerUSSim.time"
#: Reference of a sequence of simulated images to that of their transforms, and of a browser to the probe's poses
MADE_FROM, POSES = "SlicerUSSim.transforms", "SlicerUSSim.poses"
#: Attribute of a sequence node with real images: probe, its place in the images and registration, as JSON
_KNOWN = "SlicerUSSim.field"
#: Default tolerance within which a sequence node considers numbers equal; step between generated values.
_TOLERANCE, _STEP = 1e-3, 1e-6


@dataclass(frozen=True)
class SequenceIndex:
    """Index values of the items of sequences, common to all sequences of one browser.

    A sequence node has one item for each index value, in the order of the numbers, and considers numbers equal that
    differ by less than its tolerance (a millisecond). To keep all items and their order, an index value that is not a
    number, or not larger than the previous one, is replaced by the previous one plus a millionth, and the tolerance is
    set to less than the smallest step. Recorded times therefore change only for images with equal times.
    """

    values: tuple[str, ...]
    name: str = "time"
    unit: str = "s"
    is_text: bool = False
    tolerance: float = _TOLERANCE

    def __post_init__(self) -> None:
        values = _distinct(self.values) if self.is_text else _rising(self.values)
        object.__setattr__(self, "values", values)
        if not self.is_text:
            steps = [float(after) - float(before) for before, after in pairwise(values)]
            object.__setattr__(self, "tolerance", min([self.tolerance, *(0.5 * step for step in steps)]))

    @classmethod
    def of_times(cls, seconds: Iterable[float]) -> SequenceIndex:
        """Index of items recorded at these times, to a microsecond."""
        return cls(tuple(f"{time:.6f}" for time in seconds))

    @classmethod
    def of_node(cls, sequence_node) -> SequenceIndex:
        """Index of a vtkMRMLSequenceNode."""
        count = sequence_node.GetNumberOfDataNodes()
        values, name = map(sequence_node.GetNthIndexValue, range(count)), sequence_node.GetIndexName()
        unit, is_text = sequence_node.GetIndexUnit(), sequence_node.GetIndexType() == sequence_node.TextIndex
        return cls(tuple(values), name, unit, is_text, sequence_node.GetNumericIndexValueTolerance())

    def fill(self, sequence_node, items: Iterable) -> None:
        """Replace the content of a vtkMRMLSequenceNode by `items`, a data node for each value."""
        sequence_node.RemoveAllDataNodes()
        sequence_node.SetIndexName(self.name)
        sequence_node.SetIndexUnit(self.unit)
        sequence_node.SetIndexType(sequence_node.TextIndex if self.is_text else sequence_node.NumericIndex)
        sequence_node.SetNumericIndexValueTolerance(self.tolerance)
        for value, item in zip(self.values, items, strict=True):
            sequence_node.SetDataNodeAtValue(item, value)


def _distinct(texts: Sequence[str]) -> tuple[str, ...]:
    """The same texts, with a number appended to duplicates."""
    found: list[str] = []
    for place, text in enumerate(texts):
        others = {*texts, *found}
        if text in found:
            text = next(name for name in (f"{text} ({n})" for n in count(place)) if name not in others)
        found.append(text)
    return tuple(found)


def _rising(texts: Sequence[str]) -> tuple[str, ...]:
    """The same numbers, as long as they increase."""
    risen, last = [], -inf
    for text in texts:
        value = number_in(text)
        if not (isfinite(value) and value > last):
            text = f"{last + max(_STEP, 2.0 * ulp(last)) if risen else 0.0:.6f}"
        risen.append(text)
        last = float(text)
    return tuple(risen)


def number_in(text: str) -> float:
    """The number of an index value; NaN for text."""
    try:
        return float(text)
    except ValueError:
        return nan


def add_sequence(
    scene, sequence: TrackedSequence, name: str, path: str = "ImageToReference", to_ras: np.ndarray | None = None,
    poses: Sequence[np.ndarray] = (), probe_transform_node=None,
):  # fmt: skip
    """(browser, images): a vtkMRMLSequenceBrowserNode and the vtkMRMLSequenceNode of the images in `scene`.

    The images are in pixels, under the recorded transforms to the world (RAS); `path` and `to_ras` (4, 4) as for
    TrackedImages.of. Images that were not tracked are omitted. `poses`, one probe_to_ras (4, 4) for each remaining
    image, become a sequence for `probe_transform_node`, which follows the browser, and has the reference POSES. The
    index of all three sequences is the images' times (with unique values, see SequenceIndex); the original time of an
    image is its attribute TIME.
    Raises SimulationError if no image was tracked.
    """
    numbers = [number for number in range(len(sequence)) if sequence.has_pose(number, path)] or [0]
    matrices = [sequence.pose(number, path) for number in numbers]
    to_ras = np.eye(4) if to_ras is None else to_ras
    index = SequenceIndex.of_times(sequence.timestamps[numbers])
    images, transforms = _sequence_node(scene, name), _sequence_node(scene, f"{name} transforms")
    index.fill(images, (_image(name, sequence, number) for number in numbers))
    index.fill(transforms, (_transform(f"{name} transform", to_ras @ matrix) for matrix in matrices))
    browser = _browser(scene, name, transforms)
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
        index.fill(held, (_transform(f"{name} probe", pose) for pose in poses))
        browser.AddSynchronizedSequenceNodeID(held.GetID())
        browser.SetNodeReferenceID(POSES, held.GetID())
        if probe_transform_node is not None:
            browser.AddProxyNode(probe_transform_node, held, False)
    return browser, images


def add_poses(scene, poses: Sequence[np.ndarray], name: str):
    """(browser, transforms): a vtkMRMLSequenceBrowserNode with the poses (4, 4) as a vtkMRMLSequenceNode.

    The index is the number of the pose. A new linear transform node follows the browser.
    """
    transforms = _sequence_node(scene, name)
    numbers = SequenceIndex(tuple(str(number) for number in range(len(poses))), "pose", "")
    numbers.fill(transforms, (_transform(name, pose) for pose in poses))
    browser = _browser(scene, name, transforms)
    browser.AddProxyNode(scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", name), transforms, False)
    return browser, transforms


def _browser(scene, name: str, transforms: Any):
    """A browser whose master sequence has the transforms."""
    browser = scene.AddNewNodeByClass("vtkMRMLSequenceBrowserNode", scene.GenerateUniqueName(f"{name} browser"))
    browser.SetAndObserveMasterSequenceNodeID(transforms.GetID())
    return browser


def _sequence_node(scene, name: str):
    return scene.AddNewNodeByClass("vtkMRMLSequenceNode", scene.GenerateUniqueName(name))


def _image(name: str, sequence: TrackedSequence, number: int):
    """A volume node with one image, in pixels."""
    node = slicer.vtkMRMLScalarVolumeNode()
    node.SetName(name)
    write_volume(node, Volume(sequence.images[number][None], np.eye(4)))
    if isfinite(sequence.timestamps[number]):
        node.SetAttribute(TIME, f"{sequence.timestamps[number]:.6f}")
    return node


def _transform(name: str, matrix: np.ndarray):
    """A linear transform node."""
    node = slicer.vtkMRMLLinearTransformNode()
    node.SetName(name)
    node.SetMatrixTransformToParent(vtk_matrix(matrix))
    return node


@dataclass(frozen=True, eq=False)
class KnownField:
    """What was found or given when the images were opened."""

    field: ImagedField
    #: (4, 4) from the frame in which the images were tracked to the world
    to_ras: np.ndarray


def write_known_field(images_node: Any, known: KnownField) -> None:
    """Keep it with a vtkMRMLSequenceNode of images, also in the scene's file."""
    values = {
        "probe": known.field.probe.to_dict(),
        "image_to_probe": known.field.image_to_probe.tolist(),
        "to_ras": known.to_ras.tolist(),
    }
    images_node.SetAttribute(_KNOWN, json.dumps(values))


def known_field(images_node: Any, shape: tuple[int, int]) -> KnownField | None:
    """What write_known_field kept with a node of images of `shape` (rows, columns); None if it kept nothing.

    Raises SimulationError for an attribute with something else.
    """
    text = images_node.GetAttribute(_KNOWN)
    if text is None:
        return None
    try:
        values = json.loads(text)
        probe = probe_from_dict(values["probe"], "the probe of real images")
        image_to_probe = check_affine("image_to_probe", np.array(values["image_to_probe"], float))
        to_ras = check_rigid("to_ras", np.array(values["to_ras"], float))
    except (SimulationError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise SimulationError(
            f"{named(images_node)}: its attribute {_KNOWN} is damaged ({error}); without it the probe must be found in "
            "the images"
        ) from None
    return KnownField(ImagedField.of(probe, image_to_probe, shape), to_ras)
