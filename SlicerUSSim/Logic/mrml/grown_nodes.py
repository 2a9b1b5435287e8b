"""Lesions of a scene that are grown from a markups point into the segments that are laid over labels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.lesions.seeded import grow_lesion
from SlicerUSSim.Logic.mri.segmentation import Segmentation
from SlicerUSSim.Logic.mrml.lesion_nodes import add_lesion
from SlicerUSSim.Logic.mrml.nodes import control_points, named, node_to_world, require_node


class LesionGrowth:
    """Grows lesions on the last segmentation of a scene.

    Parameters
    ----------
    work : runs a slow function that does not access nodes, and returns its result.
    """

    def __init__(self, work: Callable[[Callable[[], Any]], Any]) -> None:
        self._work = work
        self._last: tuple[str, object, Segmentation] | None = None
        #: Of the last lesion: what it is, and what a user should check, one line each
        self.notes: tuple[str, ...] = ()
        self.warnings: tuple[str, ...] = ()

    def segmented(self, mri_node, result: Segmentation) -> None:
        """Take note of a segmentation of an MRI node, on which lesions are grown from now on."""
        self._last = (mri_node.GetID(), _version(mri_node), result)

    def knows(self, mri_node) -> bool:
        """Whether lesions can be grown on an MRI node: it was segmented, and has not changed since."""
        return mri_node is not None and self._last is not None and self._last[:2] == (
            mri_node.GetID(), _version(mri_node),
        )  # fmt: skip

    def growFrom(
        self, mri_node, points_node, lesions_node, tissue: str | None = None, larger: bool = False
    ) -> list[str]:
        """Add the lesion around the last placed control point of a markups node to a segmentation node.

        See seeded.grow_lesion; `larger`: its larger version. Returns the IDs of the segments, one for each part.
        UltrasoundSceneLogic.addTissues lays them over labels. Raises SimulationError, and changes nothing, if the MRI
        was not segmented or has changed since, and where nothing grows.
        """
        require_node(points_node, "vtkMRMLMarkupsFiducialNode", use="point in the lesion")
        require_node(lesions_node, "vtkMRMLSegmentationNode", use="lesions")
        placed = control_points(points_node)
        require(len(placed) > 0, f"{named(points_node)} has no point, expected one in the lesion; click it in a slice")
        require_node(mri_node, "vtkMRMLScalarVolumeNode", use="MRI")
        if self._last is None or not self.knows(mri_node):
            raise SimulationError(f"{named(mri_node)} was not segmented yet, or has changed since; segment it first")
        result = self._last[2]
        seed = np.linalg.inv(node_to_world(mri_node)) @ [*placed[-1], 1.0]
        grown = self._work(lambda: grow_lesion(result, seed[:3].tolist(), tissue))
        moved = np.linalg.inv(node_to_world(lesions_node)) @ node_to_world(mri_node)
        ids = []
        lesion = grown.larger if larger and grown.larger is not None else grown
        for part in lesion.tissues:
            mask = lesion.mask(part)
            ids += add_lesion(lesions_node, Volume(mask.array, moved @ mask.ijk_to_ras), part, part)
        self.notes, self.warnings = (grown.message,), grown.warnings
        return ids


def _version(volume_node) -> object:
    """Changes with the voxels of a volume node."""
    image = volume_node.GetImageData()
    return None if image is None else image.GetMTime()
