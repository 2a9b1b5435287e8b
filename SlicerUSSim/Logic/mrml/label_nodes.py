"""Label maps and segmentations of a scene: their voxels, and the tissues of their names."""

from __future__ import annotations

import logging
from collections.abc import Collection, Hashable, Iterable

import numpy as np
import slicer
from vtkmodules.vtkCommonCore import vtkIntArray, vtkStringArray
from vtkmodules.vtkCommonMath import vtkMatrix4x4

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.segments import codes_of_entry, is_meaningful
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.base.vtk_data import matrix_array, vtk_matrix
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mrml.nodes import (
    display_of,
    ijk_to_ras,
    named,
    node_to_world,
    put_beside,
    read_volume,
    require_node,
    write_volume,
)
from SlicerUSSim.Logic.tissue.label_maps import LabelledTissues, as_whole, read_label_map
from SlicerUSSim.Logic.tissue.names import name_or_term, terminology_entry
from SlicerUSSim.Logic.tissue.presets import colour_of
from SlicerUSSim.Logic.tissue.table import TissueTable

_log = logging.getLogger(__name__)

#: Classes of nodes with labels.
LABEL_CLASSES = ("vtkMRMLLabelMapVolumeNode", "vtkMRMLSegmentationNode")

#: Slicer's table for every label map
_DEFAULT_COLOURS = "GenericAnatomyColors"
#: Tissues of label 0, 1, 2, ... in an unchanged preset
_OF_EVERY_BRAIN = tuple(Preset().tissues.names())


def read_mask(mask_node, mri_node) -> Volume:
    """A mask on the grid of an MRI: a label map or scalar volume on this grid, or a segmentation.

    Raises SimulationError for another node, and for an empty segmentation.
    """
    require_node(mask_node, "vtkMRMLScalarVolumeNode", "vtkMRMLSegmentationNode", use="mask")
    if not mask_node.IsA("vtkMRMLSegmentationNode"):
        return read_volume(mask_node, "mask")
    _require_segments(mask_node, "mask")
    mri = read_volume(mri_node, "MRI")
    geometry = slicer.vtkOrientedImageData()
    geometry.SetExtent(*(bound for n in mri.array.shape[::-1] for bound in (0, n - 1)))
    mri_to_segmentation = np.linalg.inv(node_to_world(mask_node)) @ node_to_world(mri_node)
    geometry.SetGeometryFromImageToWorldMatrix(vtk_matrix(mri_to_segmentation @ mri.ijk_to_ras))
    merged = slicer.vtkOrientedImageData()
    mask_node.GenerateMergedLabelmapForAllSegments(merged, slicer.vtkSegmentation.EXTENT_REFERENCE_GEOMETRY, geometry)
    return mri.with_array(Volume.from_vtk(merged, np.eye(4)).array)


def labels_version(labels_node) -> Hashable:
    """A value that changes with voxels, segments, their names or their position in the node's own frame."""
    if labels_node.IsA("vtkMRMLSegmentationNode"):
        segmentation = labels_node.GetSegmentation()
        parts = [labels_node.GetID()]
        for segment_id in segmentation.GetSegmentIDs():
            segment = segmentation.GetSegment(segment_id)
            source = segment.GetRepresentation(segmentation.GetSourceRepresentationName())
            parts.append((segment_id, segment.GetName(), None if source is None else source.GetMTime()))
        return tuple(parts)
    image, colours = labels_node.GetImageData(), _colour_node(labels_node)
    times = tuple(None if one is None else one.GetMTime() for one in (image, colours))
    return labels_node.GetID(), times, ijk_to_ras(labels_node).tobytes()


def read_labels(labels_node, tissues: TissueTable, *, of_ct: bool = False) -> LabelledTissues:
    """The content of a label map or segmentation, with one label for every tissue of its names.

    Names of segments or of a label map's colours are looked up in `tissues`, then in the presets.
    A label whose colour has no tissue's name, or only the name in Slicer's default table, is the tissue with that
    label in `tissues`; if these are the brain's, or do not have it, the numbers of other programs are recognised
    (label_maps.read_label_map). With `of_ct` it has organs of a CT, whose numbers are not those of `tissues`.
    Raises SimulationError for a node without voxels or segments, for unknown names, which it lists, and for a mask or
    lesion without a patient.
    """
    require_node(labels_node, *LABEL_CLASSES, use="label map")
    by_number = None
    if labels_node.IsA("vtkMRMLSegmentationNode"):
        volume, names = _read_segmentation(labels_node)
        segmentation = labels_node.GetSegmentation()
        segments = map(segmentation.GetSegment, segmentation.GetSegmentIDs())
        names = {
            number: name_or_term(segment.GetName(), codes_of_entry(segment.GetTerminology()))
            for number, segment in enumerate(segments, 1)
        }
    else:
        volume = read_volume(labels_node, "label map")
        names = _colour_names(labels_node, volume)
        if not of_ct and tuple(tissues.names()) != _OF_EVERY_BRAIN:  # the user chose which tissue has which number
            by_number = tissues
    found = read_label_map(
        volume, names, source=named(labels_node), tissues=tissues, by_number=by_number, renumber=True, of_ct=of_ct,
    )  # fmt: skip
    _log.info("%s: %s", named(labels_node), found.message)
    for warning in found.warnings:
        _log.warning("%s", warning)
    return found


def hidden_segments(segmentation_node) -> dict[str, str]:
    """{ID: name} of the segments of a segmentation that its display hides one by one."""
    display, segmentation = segmentation_node.GetDisplayNode(), segmentation_node.GetSegmentation()
    if display is None:
        return {}
    hidden = (name for name in segmentation.GetSegmentIDs() if not display.GetSegmentVisibility(name))
    return {segment_id: segmentation.GetSegment(segment_id).GetName() for segment_id in hidden}


def node_labels(labels_node, without: Collection[str] = ()) -> tuple[Volume, dict[int, str]]:
    """(labels in the node's own frame, {label: name of its segment or colour}) as they are, whether tissues or not.

    Segments with the IDs `without` are left out. Raises SimulationError for a node without labels.
    """
    if labels_node.IsA("vtkMRMLSegmentationNode"):
        return _read_segmentation(labels_node, without)
    volume, colours = read_volume(labels_node, "label map"), _colour_node(labels_node)
    present = [int(label) for label in np.unique(volume.array) if label]
    if colours is None:
        return volume, dict.fromkeys(present, "")
    known = colours.GetNumberOfColors()
    return volume, {label: colours.GetColorName(label) if 0 < label < known else "" for label in present}


def layered_segments(segmentation_node) -> list[Volume]:
    """The mask of every segment with a binary label map, in their order; none of a segmentation with one layer."""
    segmentation = segmentation_node.GetSegmentation()
    name = slicer.vtkSegmentationConverter.GetSegmentationBinaryLabelmapRepresentationName()
    masks = []
    for segment in map(segmentation.GetSegment, segmentation.GetSegmentIDs()):
        image = segment.GetRepresentation(name)
        if segmentation.GetNumberOfLayers(name) < 2 or image is None or min(image.GetDimensions()) < 1:
            continue
        matrix = vtkMatrix4x4()
        image.GetImageToWorldMatrix(matrix)
        voxels = Volume.from_vtk(image, matrix_array(matrix))
        masks.append(voxels.with_array((voxels.array == segment.GetLabelValue()).astype(np.uint8)))
    return masks


def _require_segments(segmentation_node, use: str) -> None:
    require(
        segmentation_node.GetSegmentation().GetNumberOfSegments() > 0,
        f"{use} {named(segmentation_node)} is empty, expected at least one segment",
    )


def _read_segmentation(segmentation_node, without: Collection[str] = ()) -> tuple[Volume, dict[int, str]]:
    _require_segments(segmentation_node, "label map")
    segmentation = segmentation_node.GetSegmentation()
    ids, values, names = vtkStringArray(), vtkIntArray(), {}
    shown = [segment_id for segment_id in segmentation.GetSegmentIDs() if segment_id not in without]
    for number, segment_id in enumerate(shown, 1):
        ids.InsertNextValue(segment_id)
        values.InsertNextValue(number)
        names[number] = segmentation.GetSegment(segment_id).GetName()
    require(
        segmentation_node.CreateBinaryLabelmapRepresentation(),
        f"label map {named(segmentation_node)} has no binary label map and cannot be converted to one",
    )
    # A segmentation is stored cropped to its voxels, but a head does not end where the border to its surroundings lies.
    merged = slicer.vtkOrientedImageData()
    segmentation_node.GenerateMergedLabelmapForAllSegments(
        merged, slicer.vtkSegmentation.EXTENT_UNION_OF_EFFECTIVE_SEGMENTS_AND_REFERENCE_GEOMETRY, None, ids, values
    )
    require(
        min(merged.GetDimensions()) > 0 and merged.GetScalarRange()[1] > 0,
        f"label map {named(segmentation_node)} is empty, expected a segment with voxels",
    )
    matrix = vtkMatrix4x4()
    merged.GetImageToWorldMatrix(matrix)
    volume = Volume.from_vtk(merged, matrix_array(matrix))
    return volume, names


def _colour_node(labels_node):
    display = labels_node.GetDisplayNode()
    return None if display is None else display.GetColorNode()


def _colour_names(labels_node, volume: Volume) -> dict[int, str]:
    """{label: name} of the colours of a label map; labels without a name are left out."""
    as_whole(volume, f"label map {named(labels_node)}")
    colours, names = _colour_node(labels_node), {}
    # Slicer assigns this table to every label map; its names (2 is bone, 3 is skin) are therefore ignored.
    is_default = colours is not None and colours.GetName() == _DEFAULT_COLOURS
    if is_default:
        _log.info("%s: has Slicer's default colours, so labels are identified by their numbers", named(labels_node))
    present = [label for label in map(int, np.unique(volume.array)) if label]
    require(present, f"label map {named(labels_node)} is empty, expected voxels that are not 0")
    if colours is None or is_default:
        return {}
    for label in present:
        name = colours.GetColorName(label) if label < colours.GetNumberOfColors() else None
        if name is not None:
            name = name_or_term(name, codes_of_entry(colours.GetTerminologyAsString(label)))
        if is_meaningful(name):
            names[label] = name
    return names


def write_labels(labels_node, labels: Volume, names: Iterable[str], like_node) -> None:
    """Write labels with named, coloured tissues into a label map or segmentation node, aligned with another
    node of volumes or labels. Tissues that the node already has keep their colours, which may be the user's."""
    parent = like_node.GetParentTransformNode()
    labels_node.SetAndObserveTransformNodeID(None if parent is None else parent.GetID())
    put_beside(labels_node, like_node)
    if labels_node.IsA("vtkMRMLSegmentationNode"):
        if like_node.IsA("vtkMRMLVolumeNode"):
            # After the transform, since the node converts the reference geometry to its own frame.
            labels_node.SetReferenceImageGeometryParameterFromVolumeNode(like_node)
        elif like_node.IsA("vtkMRMLSegmentationNode"):
            geometry = slicer.vtkSegmentationConverter.GetReferenceImageGeometryParameterName()
            text = like_node.GetSegmentation().GetConversionParameter(geometry)
            labels_node.GetSegmentation().SetConversionParameter(geometry, text)
        _write_segmentation(labels_node, labels, tuple(names))
    else:
        _write_label_map(labels_node, labels, tuple(names))


def empty(labels_node) -> None:
    """Remove the voxels of a label map, or the segments of a segmentation."""
    if labels_node.IsA("vtkMRMLSegmentationNode"):
        labels_node.GetSegmentation().RemoveAllSegments()
    else:
        labels_node.SetAndObserveImageData(None)


def _write_label_map(labels_node, labels: Volume, names: tuple[str, ...]) -> None:
    write_volume(labels_node, labels)
    is_new = labels_node.GetNodeReference("tissueColors") is None
    colours = _own_colours(labels_node)
    kept = {} if is_new else _colours_of_table(colours)
    colours.SetTypeToUser()
    colours.SetNumberOfColors(len(names) + 1)
    colours.SetColor(0, "coupling", 0.0, 0.0, 0.0, 0.0)
    for label, name in enumerate(names, 1):
        colours.SetColor(label, name, *kept.get(name, (*colour_of(name), 1.0)))
        if entry := terminology_entry(name):
            colours.SetTerminologyFromString(label, entry)
    _show_in_colours(labels_node, colours)


def colour_table(labels_node) -> tuple[tuple[str, float, float, float, float], ...] | None:
    """(name, red, green, blue, opacity) of label 0, 1, ... of a label map; None for Slicer's default colours."""
    colours = _colour_node(labels_node)
    if colours is None or colours.GetName() == _DEFAULT_COLOURS:
        return None
    lines = []
    for label in range(colours.GetNumberOfColors()):
        colour = [0.0] * 4
        colours.GetColor(label, colour)
        red, green, blue, opacity = colour
        lines.append((colours.GetColorName(label) or "", red, green, blue, opacity))
    return tuple(lines)


def set_colour_table(labels_node, lines: tuple[tuple[str, float, float, float, float], ...]) -> None:
    """Give a label map names and colours as colour_table returns them."""
    colours = _own_colours(labels_node)
    colours.SetTypeToUser()
    colours.SetNumberOfColors(len(lines))
    for label, line in enumerate(lines):
        colours.SetColor(label, *line)
    _show_in_colours(labels_node, colours)


def _own_colours(labels_node):
    """The colour table of a label map that write_labels or set_colour_table made, or a new one."""
    colours, scene = labels_node.GetNodeReference("tissueColors"), labels_node.GetScene()
    if colours is None:
        colours = scene.AddNewNodeByClass("vtkMRMLColorTableNode", f"{labels_node.GetName()} tissues")
        labels_node.SetNodeReferenceID("tissueColors", colours.GetID())
    return colours


def _show_in_colours(labels_node, colours) -> None:
    display = labels_node.GetDisplayNode()
    if display is None:  # the default display node requires colours that exist only in Slicer's own scene
        display = labels_node.GetScene().AddNewNodeByClass("vtkMRMLLabelMapVolumeDisplayNode")
        labels_node.SetAndObserveDisplayNodeID(display.GetID())
    display.SetAndObserveColorNodeID(colours.GetID())
    labels_node.Modified()


def _colours_of_table(colours) -> dict[str, tuple[float, ...]]:
    """{name: red, green, blue and opacity, 0 to 1} of a colour table."""
    found: dict[str, tuple[float, ...]] = {}
    for label in range(1, colours.GetNumberOfColors()):
        colour = [0.0] * 4
        colours.GetColor(label, colour)
        found.setdefault(colours.GetColorName(label), tuple(colour))
    return found


def _write_segmentation(segmentation_node, labels: Volume, names: tuple[str, ...]) -> None:
    segmentation = segmentation_node.GetSegmentation()
    was_modifying = segmentation_node.StartModify()
    segments = [segmentation.GetSegment(segment_id) for segment_id in segmentation.GetSegmentIDs()]
    kept = {segment.GetName(): segment.GetColor() for segment in segments}
    segmentation.RemoveAllSegments()
    segmentation_node.SetSourceRepresentationToBinaryLabelmap()
    representation = slicer.vtkSegmentationConverter.GetSegmentationBinaryLabelmapRepresentationName()
    layer = slicer.vtkOrientedImageData()  # one for all segments, as none overlap
    voxels = labels.array.astype(np.uint8 if len(names) < 256 else np.int16)  # a copy, which users may edit
    layer.ShallowCopy(Volume(voxels, np.eye(4)).to_vtk())
    layer.SetImageToWorldMatrix(vtk_matrix(labels.ijk_to_ras))
    for label, name in enumerate(names, 1):
        segment = slicer.vtkSegment()
        segment.SetName(name)
        segment.SetColor(kept.get(name) or colour_of(name))
        segment.SetLabelValue(label)
        segment.AddRepresentation(representation, layer)
        if entry := terminology_entry(name):
            segment.SetTerminology(entry)
        segmentation.AddSegment(segment, name)
    segmentation_node.EndModify(was_modifying)
    display_of(segmentation_node)
