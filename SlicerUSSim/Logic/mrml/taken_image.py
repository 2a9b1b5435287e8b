"""TakenImage: a simulated image with a record of everything it shows, also as attributes of its volume node.

An image without the name of its patient, its pose and its settings can be mistaken for one of another patient or place.
"""

from __future__ import annotations

import json
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.base.vtk_data import vtk_matrix
from SlicerUSSim.Logic.imaging.frame import Frame
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mrml.nodes import write_slice
from SlicerUSSim.Logic.mrml.own_results import IMAGE, mark_as_result
from SlicerUSSim.Logic.probe.image_grid import ImageGrid

#: Attribute of a node with an MRI or labels: the name of the patient; without it the node's own name is
PATIENT = "SlicerUSSim.patient"
#: Reference of labels to the volume of which they were made
MRI = "SlicerUSSim.mri"
#: Attributes of the image's volume node: its record, as JSON, and whether it stays where it was taken
_ABOUT, _FROZEN = "SlicerUSSim.image", "SlicerUSSim.frozen"
#: Texts of _FROZEN: of an image that stays, and of a live one while its scene is saved
_STAYS, _WHILE_SAVED = "stays", "while saved"


@dataclass(frozen=True, eq=False)
class TakenImage:
    """An image that was simulated on nodes of a scene."""

    #: (rows, columns) uint8, and its place in the probe frame
    image: np.ndarray
    grid: ImageGrid
    #: (4, 4) at the time of the image
    probe_to_world: np.ndarray
    #: Probe, display, settings and tissues with which it was simulated
    preset: Preset
    #: Name of the patient
    patient: str
    #: Changes with labels and sheets
    anatomy: Hashable
    #: Coordinated universal time, ISO 8601
    time: str
    #: Whether there is no tissue in the imaged field
    is_empty: bool
    #: The volume node into which it was written
    node: Any
    #: The signals from which it was made; None of an image of a sequence that was made before
    frame: Frame | None = None
    #: Its number in a simulated sequence, from 0, which is the seed of its noise; None: not of a sequence
    number: int | None = None

    @property
    def image_to_world(self) -> np.ndarray:
        """(4, 4) from (column, row, 0, 1) of the slice to the world, mm."""
        return self.probe_to_world @ self.grid.slice_to_probe

    def volume(self) -> Volume:
        """One slice where it was taken."""
        return Volume(self.image[None], self.image_to_world)

    def about(self) -> dict[str, object]:
        """Patient, time, pose and preset, as JSON can hold them."""
        pose, preset = self.probe_to_world.round(6).tolist(), self.preset.to_dict()
        return {"patient": self.patient, "time": self.time, "probe_to_ras": pose, "preset": preset}


def mri_of(labels_node) -> Any:
    """The volume node of which labels were made, also after lesions were laid over them; None if that is not known."""
    return labels_node.GetNodeReference(MRI)


def patient_of(node) -> str:
    """Name of the patient of a node with an MRI or labels."""
    return node.GetAttribute(PATIENT) or node.GetName() or ""


def write_image(taken: TakenImage, transform_node=None) -> None:
    """Write an image and its record into its node: fixed geometry in the probe frame, under the probe's transform.

    The slice therefore moves with the transform immediately, before its pixels are updated.
    """
    was_modifying = taken.node.StartModify()
    pose = taken.probe_to_world.tolist()  # all digits: scripts make the same pixels again
    about = {**taken.about(), "probe_to_ras": pose, "is_empty": taken.is_empty}
    about |= {} if taken.number is None else {"number": taken.number}
    taken.node.SetAttribute(_ABOUT, json.dumps(about))
    taken.node.RemoveAttribute(_FROZEN)
    write_slice(taken.node, Volume(taken.image[None], taken.grid.slice_to_probe), transform_node)
    mark_as_result(taken.node, IMAGE)
    taken.node.EndModify(was_modifying)


def about_image(volume_node) -> dict[str, Any]:
    """What the image in a volume node shows, see TakenImage.about; {} for any other volume.

    With `is_empty`, and the `number` of an image of a sequence.
    """
    text = volume_node.GetAttribute(_ABOUT)
    try:
        return {} if text is None else json.loads(text)
    except ValueError:
        raise SimulationError(f"{volume_node.GetName()!r} has an attribute {_ABOUT} that is not JSON") from None


def is_frozen(volume_node) -> bool:
    """Whether an image stays where it was taken, however the probe moves."""
    return volume_node.GetAttribute(_FROZEN) is not None


def was_live(volume_node) -> bool:
    """Whether a frozen image of a scene that was saved was live, and frozen while that was done only."""
    return volume_node.GetAttribute(_FROZEN) == _WHILE_SAVED


def freeze(taken: TakenImage, *, while_saved: bool = False) -> None:
    """Leave the image of a volume node where it was taken, no longer under the probe's transform.

    `while_saved`: it is live, and follows the probe again once its scene is saved.
    """
    node = taken.node
    was_modifying = node.StartModify()
    node.SetAndObserveTransformNodeID(None)
    node.SetIJKToRASMatrix(vtk_matrix(taken.image_to_world))
    node.SetAttribute(_FROZEN, _WHILE_SAVED if while_saved else _STAYS)
    node.EndModify(was_modifying)


def follow(taken: TakenImage, transform_node) -> None:
    """Put a frozen image under the probe's transform again."""
    node = taken.node
    was_modifying = node.StartModify()
    node.SetAndObserveTransformNodeID(transform_node.GetID())
    node.SetIJKToRASMatrix(vtk_matrix(taken.grid.slice_to_probe))
    node.RemoveAttribute(_FROZEN)
    node.EndModify(was_modifying)


def remove_image(volume_node) -> None:
    """Empty a volume node with an image of this module."""
    was_modifying = volume_node.StartModify()
    volume_node.SetAndObserveImageData(None)
    volume_node.SetAndObserveTransformNodeID(None)
    for name in (_ABOUT, _FROZEN):
        volume_node.RemoveAttribute(name)
    volume_node.EndModify(was_modifying)
    volume_node.InvokeEvent(volume_node.ImageDataModifiedEvent)  # the views show its last image otherwise
