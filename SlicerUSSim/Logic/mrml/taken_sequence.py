"""Images of a simulated sequence with their records, as nodes that are saved with the scene."""

from __future__ import annotations

import json
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import slicer

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.transforms import check_rigid
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mrml.nodes import ijk_to_ras, named
from SlicerUSSim.Logic.mrml.own_results import SEQUENCE, mark_as_result
from SlicerUSSim.Logic.mrml.sequence_nodes import SequenceIndex
from SlicerUSSim.Logic.mrml.taken_image import TakenImage, about_image, is_frozen, write_image
from SlicerUSSim.Logic.probe.image_grid import ImageGrid

#: Attribute of a sequence node with images: what each is of, as JSON. Those of its items are lost when Slicer saves
#: them as one file
_ABOUT = "SlicerUSSim.images"


def write_taken(images_node, index: SequenceIndex, taken: Sequence[TakenImage]) -> None:
    """Replace the content of a vtkMRMLSequenceNode by images, which are in the volume nodes `taken.node`."""
    index.fill(images_node, [image.node for image in taken])
    presets: list[dict[str, object]] = []
    lines = []
    for image in taken:
        about = image.about()
        preset = about.pop("preset")
        if preset not in presets:  # one for all, as a rule
            presets.append(preset)  # type: ignore[arg-type]
        pose = image.probe_to_world.tolist()  # all digits: the noise of an image follows from them
        is_of = {"preset": presets.index(preset), "probe_to_ras": pose, "is_empty": image.is_empty}  # type: ignore[arg-type]
        lines.append({**about, **is_of})
    images_node.SetAttribute(_ABOUT, json.dumps({"presets": presets, "images": lines}))
    mark_as_result(images_node, SEQUENCE)


def read_taken(images_node, number: int, anatomy: Hashable = None) -> TakenImage:
    """The image with this number of a sequence that write_taken filled. Raises SimulationError for another one.

    `anatomy` of all its images, if it is known.
    """
    count = images_node.GetNumberOfDataNodes()
    require(0 <= number < count, f"{named(images_node)} has {count} images, expected one with the number {number}")
    node = images_node.GetNthDataNode(number)
    try:
        image = Volume.from_vtk(node.GetImageData(), ijk_to_ras(node)).array[0].copy()
        return _taken(images_node.GetAttribute(_ABOUT) or "{}", number, image, anatomy, node)
    except (ValueError, LookupError, TypeError, AttributeError):
        raise SimulationError(
            f"{named(images_node)} has no records of its images, expected those of Simulate sequence; make them again"
        ) from None


def _taken(about: str, number: int, image: np.ndarray, anatomy: Hashable, node: Any) -> TakenImage:
    """The image with a number and what `about` says of it; raises one of several errors for another text."""
    values = json.loads(about)
    line = values["images"][number]
    return _image_of(line, values["presets"][line["preset"]], image, anatomy, node, number)


def _image_of(
    line: Mapping[str, Any], settings: Any, image: np.ndarray, anatomy: Hashable, node: Any, number: int | None
) -> TakenImage:
    preset = Preset.from_dict(settings)
    pose = check_rigid("the pose of an image", line["probe_to_ras"])
    grid = ImageGrid.for_probe(preset.probe, preset.display.image_size)
    what = "a saved image" if number is None else f"image {number} of a sequence"
    require(
        image.shape == (grid.rows, grid.columns) and image.dtype == np.uint8,
        f"{what} is {image.shape}, expected {grid.rows} rows of {grid.columns} pixels",
    )
    return TakenImage(
        image, grid, pose, preset, str(line["patient"]), anatomy, str(line["time"]), bool(line.get("is_empty")), node,
        number=number,
    )  # fmt: skip


def count_taken(images_node: Any) -> int:
    """Number of images that read_taken reads; 0 of another node, or none."""
    if images_node is None or images_node.GetAttribute(_ABOUT) is None:
        return 0
    return images_node.GetNumberOfDataNodes()


# ---- a frozen image --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class FrozenRecord:
    """An image that stays where it was taken, as plain values."""

    #: See TakenImage.about
    about: Mapping[str, Any]
    #: (rows, columns) uint8
    image: np.ndarray

    @property
    def number(self) -> int | None:
        """See TakenImage.number."""
        number = self.about.get("number")
        return number if type(number) is int and number >= 0 else None

    @property
    def pose(self) -> np.ndarray:
        """(4, 4) probe_to_ras at the time of the image; no numbers if that is not known."""
        try:
            return np.array(self.about["probe_to_ras"], float).reshape(4, 4)
        except (LookupError, ValueError, TypeError):
            return np.full((4, 4), np.nan)


def record_frozen(volume_node: Any) -> FrozenRecord | None:
    """The image in a volume node, if it is one of this module that stays where it was taken."""
    if volume_node is None or volume_node.GetImageData() is None or not is_frozen(volume_node):
        return None
    about = about_image(volume_node)
    array = Volume.from_vtk(volume_node.GetImageData(), ijk_to_ras(volume_node)).array
    return FrozenRecord(about, array[0].copy()) if about else None


def taken_of(record: FrozenRecord, volume_node: Any) -> TakenImage:
    """The image of a record for a volume node. Raises SimulationError if it is damaged."""
    try:
        return _image_of(record.about, record.about["preset"], record.image, None, volume_node, record.number)
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise SimulationError(f"the image of the scene is damaged ({error})") from None


# ---- kept apart from a scene -----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class SimulatedRecord:
    """A sequence that write_taken filled, as plain values."""

    name: str
    #: What its images are of, as JSON
    about: str
    index: SequenceIndex
    #: (rows, columns) uint8 of each
    images: tuple[np.ndarray, ...]


def version_taken(images_node: Any) -> Hashable:
    """A value that changes with what record_taken returns; None if there is nothing."""
    return (images_node.GetID(), images_node.GetAttribute(_ABOUT)) if count_taken(images_node) else None


def record_taken(images_node: Any) -> SimulatedRecord | None:
    """The images of a sequence node; None of another node, or none. Raises SimulationError for one that is damaged."""
    count = count_taken(images_node)
    if not count:
        return None
    images = tuple(read_taken(images_node, number).image for number in range(count))
    about = images_node.GetAttribute(_ABOUT)
    return SimulatedRecord(images_node.GetName(), about, SequenceIndex.of_node(images_node), images)


def put_taken(scene, record: SimulatedRecord):
    """The sequence node of a record, added to a scene. Raises SimulationError, and adds nothing, if it is damaged."""
    taken = []
    for number, image in enumerate(record.images):
        node = slicer.vtkMRMLScalarVolumeNode()
        try:
            found = _taken(record.about, number, image, None, node)
        except (ValueError, LookupError, TypeError, AttributeError) as error:
            raise SimulationError(f"the images of {record.name!r} are damaged ({error})") from None
        write_image(found)
        taken.append(found)
    require(len(taken) == len(record.index.values), f"the images of {record.name!r} have {len(taken)} places")
    images = scene.AddNewNodeByClass("vtkMRMLSequenceNode", scene.GenerateUniqueName(record.name))
    write_taken(images, record.index, taken)
    return images
