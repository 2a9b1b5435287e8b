"""Images of a simulated sequence with all that each is of, as nodes that are saved with the scene."""

from __future__ import annotations

import json
from collections.abc import Hashable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.transforms import check_rigid
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mrml.nodes import ijk_to_ras, named
from SlicerUSSim.Logic.mrml.own_results import SEQUENCE, mark_as_result
from SlicerUSSim.Logic.mrml.sequence_nodes import SequenceIndex
from SlicerUSSim.Logic.mrml.taken_image import TakenImage
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
        lines.append(
            {
                **about,
                "preset": presets.index(preset),  # type: ignore[arg-type]
                "probe_to_ras": image.probe_to_world.tolist(),  # all digits: scripts make the same pixels again
                "is_empty": image.is_empty,
            }
        )
    images_node.SetAttribute(_ABOUT, json.dumps({"presets": presets, "images": lines}))
    mark_as_result(images_node, SEQUENCE)


def read_taken(images_node, number: int, anatomy: Hashable = None) -> TakenImage:
    """The image with this number of a sequence that write_taken filled. Raises SimulationError for another one.

    `anatomy` is that of all its images, if it is known.
    """
    count = images_node.GetNumberOfDataNodes()
    require(0 <= number < count, f"{named(images_node)} has {count} images, expected one with the number {number}")
    node = images_node.GetNthDataNode(number)
    try:
        about = json.loads(images_node.GetAttribute(_ABOUT) or "{}")
        line = about["images"][number]
        preset = Preset.from_dict(about["presets"][line["preset"]])
        patient, time, is_empty = str(line["patient"]), str(line["time"]), bool(line["is_empty"])
        pose = check_rigid("the pose of an image", line["probe_to_ras"])
        image = Volume.from_vtk(node.GetImageData(), ijk_to_ras(node)).array
    except (ValueError, LookupError, TypeError, AttributeError):
        raise SimulationError(
            f"{named(images_node)} does not say what its images are of, expected those of Simulate sequence; make them "
            "again"
        ) from None
    grid = ImageGrid.for_probe(preset.probe, preset.display.image_size)
    require(
        image.shape == (1, grid.rows, grid.columns) and image.dtype == np.uint8,
        f"image {number} of {named(images_node)} is {image.shape}, expected {grid.rows} rows of {grid.columns} pixels",
    )
    return TakenImage(image[0].copy(), grid, pose, preset, patient, anatomy, time, is_empty, node, number=number)


def count_taken(images_node: Any) -> int:
    """Number of images that read_taken reads; 0 of another node, or none."""
    if images_node is None or images_node.GetAttribute(_ABOUT) is None:
        return 0
    return images_node.GetNumberOfDataNodes()


def in_node(taken: TakenImage, volume_node: Any) -> TakenImage:
    """The same image, in another volume node."""
    return replace(taken, node=volume_node)
