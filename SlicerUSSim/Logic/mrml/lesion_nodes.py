"""Lesions in a scene: the segments of a segmentation node that are laid over labels."""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np
import slicer
from vtkmodules.vtkCommonCore import mutable
from vtkmodules.vtkCommonMath import vtkMatrix4x4

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.base.vtk_data import matrix_array, vtk_matrix
from SlicerUSSim.Logic.mri.masks import read_masks
from SlicerUSSim.Logic.mri.pathology import Added, add_tissues, box_ras, tissue_to_add
from SlicerUSSim.Logic.mrml.nodes import named, node_to_world, require_node
from SlicerUSSim.Logic.tissue.presets import TISSUES, colour_of
from SlicerUSSim.Logic.tissue.table import TissueTable

#: Voxels on a side; masks farther away are an error, which is found later.
_MOST_PADDING = 40
#: Tags of a segment: what it was made from (a file), and what a user should check about that, in lines
_SOURCE, _CHECKS = "SlicerUSSim.source", "SlicerUSSim.checks"
#: (tissue, mask, name in messages)
Lesion = tuple[str, Volume, str]
#: {lesion, see place_of: (messages, warnings) when it was laid over labels that did not have it}
Told = dict[Hashable, tuple[tuple[str, ...], tuple[str, ...]]]


def read_lesions(lesions_node, to_frame_of, tissues: TissueTable) -> tuple[list[Lesion], list[str]]:
    """([(tissue, mask, name in messages)], warnings) of the segments that are called as tissues.

    Warnings are about segments that are not added, and those of add_lesion.

    Masks are in the own frame of the node `to_frame_of`, before its parent transform. Names are looked up in `tissues`,
    then in the presets. Raises SimulationError for another node, and if no segment is called as a tissue or has voxels.
    """
    require_node(lesions_node, "vtkMRMLSegmentationNode", use="lesions")
    segmentation = lesions_node.GetSegmentation()
    ids = list(segmentation.GetSegmentIDs())
    require(bool(ids), f"lesions {named(lesions_node)} is empty, expected segments called tumour, oedema, ...")
    require(
        lesions_node.CreateBinaryLabelmapRepresentation(),
        f"lesions {named(lesions_node)} has no binary label map and cannot be converted to one",
    )
    moved = np.linalg.inv(node_to_world(to_frame_of)) @ node_to_world(lesions_node)
    own = [tissue.name for tissue in tissues.all_tissues()]
    found, warnings = [], []
    for segment_id in ids:
        name = segmentation.GetSegment(segment_id).GetName()
        try:
            tissue = tissue_to_add(name, own)
        except SimulationError:
            warnings.append(f"segment {name!r} of {lesions_node.GetName()!r} is not added: no tissue is called so")
            continue
        mask = _mask(lesions_node, segment_id)
        if mask is None:
            warnings.append(f"segment {name!r} of {lesions_node.GetName()!r} is not added: it is empty")
        else:
            source = tag_of(segmentation.GetSegment(segment_id), _SOURCE)
            called = f"{source} (segment {name!r})" if source else f"segment {name!r}"
            found.append((tissue, Volume(mask.array, moved @ mask.ijk_to_ras), called))
            warnings += tag_of(segmentation.GetSegment(segment_id), _CHECKS).splitlines()
    require(
        bool(found),
        f"lesions {named(lesions_node)}: {'; '.join(warnings)}; expected segments with voxels, called as one of: "
        f"{', '.join(TISSUES)}",
    )
    return found, list(dict.fromkeys(warnings))  # a file may have been added twice


def add_lesion(lesions_node, mask: Volume, tissue: str, name: str) -> list[str]:
    """Append the segments of a mask, as add_tissue reads it, to a segmentation node; returns their IDs.

    What should be checked about the mask is kept with the segments: see read_lesions.
    Raises SimulationError for what is not a mask; the node is then as it was.
    """
    masks = read_masks(mask, tissue, name)
    if lesions_node.GetSegmentation().GetNumberOfSegments() == 0:
        lesions_node.SetSourceRepresentationToBinaryLabelmap()
    ids = []
    for number, part in enumerate(masks.tissues):
        # Parts inside overlap it: segments that only touch could leave gaps on another grid.
        inside = masks.shares[number:].sum(axis=0) > 0.5
        image = slicer.vtkOrientedImageData()
        image.ShallowCopy(Volume(inside, np.eye(4)).to_vtk())
        image.SetImageToWorldMatrix(vtk_matrix(masks.union.ijk_to_ras))
        segment_id = lesions_node.GetSegmentation().GenerateUniqueSegmentID(part)
        lesions_node.AddSegmentFromBinaryLabelmapRepresentation(image, part, colour_of(part), segment_id)
        if name != part:
            lesions_node.GetSegmentation().GetSegment(segment_id).SetTag(_SOURCE, name)
        ids.append(segment_id)
    checks = (*masks.warnings, *mask.doubts)
    if checks:
        lesions_node.GetSegmentation().GetSegment(ids[0]).SetTag(_CHECKS, "\n".join(checks))
    return ids


def tag_of(segment, tag: str) -> str:
    """The text of a segment's tag; "" without one."""
    text = mutable("")
    return str(text) if segment.GetTag(tag, text) else ""


def with_lesions(
    labels: Volume, names: Sequence[str], lesions: list[Lesion], *, also: list[str], before: Told, has_brain_mask: bool
) -> tuple[Added, Told]:
    """(labels with lesions, a report about each); `before` is the report about those that the labels have.

    See pathology.add_tissues.
    """
    added, told = Added(labels, tuple(names)), {}
    for lesion in lesions:
        added = add_tissues(added.labels, added.tissue_names, [lesion], also=also, has_brain_mask=has_brain_mask)
        tissue, mask, source = lesion
        place = (tissue, source, *place_of(mask))
        told[place] = before.get(place, (added.messages, added.warnings))
    lines = [tuple(line for one in told.values() for line in one[kind]) for kind in (0, 1)]
    return Added(added.labels, added.tissue_names, *lines), told


def place_of(mask: Volume) -> tuple[float, ...]:
    """Volume in ml, centre and box in RAS mm of a mask that is not empty: equal for an unedited lesion."""
    inside = mask.array > 0
    centre = mask.ijk_to_ras[:3] @ np.append(np.argwhere(inside).mean(axis=0)[::-1], 1.0)
    numbers = (inside.sum() * mask.voxel_ml, *centre, *np.ravel(box_ras(inside, mask)))
    return tuple(round(float(number), 3) for number in numbers)


def padded_for(lesions: list[Lesion], labels: Volume) -> Volume:
    """Labels on a larger grid, if necessary, that contains the lesions beside them."""
    low, high = np.zeros(3, int), np.array(labels.array.shape[::-1]) - 1
    for _, mask, _ in lesions:
        corners = np.array([box_ras(mask.array > 0, mask)[n][axis] for axis in range(3) for n in (0, 1)]).reshape(3, 2)
        points = np.array([*np.meshgrid(*corners, indexing="ij")]).reshape(3, -1)
        there = labels.ras_to_ijk[:3, :3] @ points + labels.ras_to_ijk[:3, 3:]
        low = np.minimum(low, np.floor(there.min(axis=1)).astype(int))
        high = np.maximum(high, np.ceil(there.max(axis=1)).astype(int))
    before = np.minimum(-low, _MOST_PADDING)
    after = np.minimum(high - np.array(labels.array.shape[::-1]) + 1, _MOST_PADDING)
    if not before.any() and not after.any():
        return labels
    matrix = labels.ijk_to_ras.copy()
    matrix[:3, 3] -= matrix[:3, :3] @ before
    return Volume(np.pad(labels.array, list(zip(before[::-1], after[::-1], strict=True))), matrix)


def _mask(lesions_node, segment_id: str) -> Volume | None:
    """A segment's voxels in the node's own frame; None if there are none."""
    image = slicer.vtkOrientedImageData()
    if not lesions_node.GetBinaryLabelmapRepresentation(segment_id, image) or min(image.GetDimensions()) < 1:
        return None
    matrix = vtkMatrix4x4()
    image.GetImageToWorldMatrix(matrix)
    mask = Volume.from_vtk(image, matrix_array(matrix))
    return mask.with_array(mask.array > 0) if mask.array.any() else None
