"""What is known of real images, kept with their sequence node: the probe's field in them, and their registration."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.transforms import check_affine, check_rigid
from SlicerUSSim.Logic.mrml.nodes import named
from SlicerUSSim.Logic.probe.arrays import probe_from_dict
from SlicerUSSim.Logic.tracked.imaged_field import ImagedField

#: Attribute of a sequence node with real images: probe, its place in the images and registration, as JSON
_KNOWN = "SlicerUSSim.field"


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
            f"{named(images_node)}: its attribute {_KNOWN} is damaged ({error}); without it the probe is looked for in "
            "the images"
        ) from None
    return KnownField(ImagedField.of(probe, image_to_probe, shape), to_ras)
