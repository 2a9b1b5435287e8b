"""Between MRML nodes and this package's values: volumes, labels and their names, poses, images, outlines.

Only this file and scene.py know the `slicer` namespace, 3D Slicer's or that of the slicer-core wheel.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from dataclasses import dataclass

import numpy as np
import slicer
from vtkmodules.vtkCommonCore import vtkIntArray, vtkStringArray
from vtkmodules.vtkCommonMath import vtkMatrix4x4

from SlicerUSSim.Logic.errors import SimulationError, require
from SlicerUSSim.Logic.frame import Frame
from SlicerUSSim.Logic.probe import Probe
from SlicerUSSim.Logic.probe_shape import outline_polydata
from SlicerUSSim.Logic.tissues import TISSUES, TissueTable, colour_of, same_name, tissue_named
from SlicerUSSim.Logic.volume import Volume, check_rigid
from SlicerUSSim.Logic.vtk_data import matrix_array, vtk_matrix


@dataclass(frozen=True, eq=False)
class LabelledTissues:
    """A label map or segmentation as the simulator takes it: one label per tissue."""

    #: uint8 labels in the node's own frame, before its parent transform
    volume: Volume
    #: Name of the tissue of label 1, 2, ...
    names: tuple[str, ...]


def named(node) -> str:
    """How a message calls a node: its kind and name."""
    if node is None:
        return "no node"
    kind = node.GetNodeTagName() if hasattr(node, "GetNodeTagName") else type(node).__name__
    return f"{kind} {node.GetName()!r}"


def require_node(node, *classes: str, use: str) -> None:
    """Raise SimulationError unless `node` is of one of the classes and still in a scene."""
    words = " or ".join(name.removeprefix("vtkMRML").removesuffix("Node") for name in classes)
    require(node is not None, f"no {use} chosen, expected a {words} node")
    require(
        hasattr(node, "IsA") and any(node.IsA(name) for name in classes),
        f"{use} is {named(node)}, expected a {words} node",
    )
    require(node.GetScene() is not None, f"{use} {named(node)} is not in a scene any more; choose another")


def nodes_of_class(scene, name: str) -> list:
    """All nodes of a class, subclasses too, in the order of the scene."""
    return [scene.GetNthNodeByClass(number, name) for number in range(scene.GetNumberOfNodesByClass(name))]


def node_called(scene, kind: str, name: str):
    """The first vtkMRML`kind`Node of that name, or a new one."""
    known = (node for node in nodes_of_class(scene, f"vtkMRML{kind}Node") if node.GetName() == name)
    return next(known, None) or scene.AddNewNodeByClass(f"vtkMRML{kind}Node", name)


def display_of(node):
    """A node's display node, the default one if it has none; None where even that cannot be."""
    if node.GetDisplayNode() is None:
        node.CreateDefaultDisplayNodes()
    return node.GetDisplayNode()


# ---- where nodes are -------------------------------------------------------------------------------------------------


def node_to_world(node) -> np.ndarray:
    """(4, 4) from a node's own frame to the world (RAS): its parent transforms; for a transform node, itself too.

    Raises SimulationError where a transform on the way is not linear.
    """
    transform = node if node.IsA("vtkMRMLTransformNode") else node.GetParentTransformNode()
    if transform is None:
        return np.eye(4)
    matrix = vtkMatrix4x4()
    require(
        bool(transform.IsTransformToWorldLinear()) and bool(transform.GetMatrixTransformToWorld(matrix)),
        f"{named(node)} is under a transform that is not linear; harden it or use a linear one",
    )
    return matrix_array(matrix)


def set_node_to_world(transform_node, matrix: np.ndarray) -> None:
    """Set a linear transform node so that it and its parents together are `matrix` (4, 4)."""
    parent = transform_node.GetParentTransformNode()
    to_parent = matrix if parent is None else np.linalg.inv(node_to_world(parent)) @ matrix
    transform_node.SetMatrixTransformToParent(vtk_matrix(to_parent))


def probe_pose(transform_node) -> np.ndarray:
    """(4, 4) probe_to_ras of a transform node with all its parents. Raises SimulationError unless it is rigid."""
    require_node(transform_node, "vtkMRMLTransformNode", use="probe transform")
    return check_rigid(named(transform_node), node_to_world(transform_node))


def pose_in_labels(labels_node, probe_to_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(probe pose, what the volume has to be moved by), both (4, 4), in one rigid frame.

    A rigid transform of the labels is taken out of the pose, so that moving them costs nothing; one that scales has to
    be put into the volume.
    """
    labels_to_world = node_to_world(labels_node)
    try:
        check_rigid("labels", labels_to_world)
    except SimulationError:
        return probe_to_world, labels_to_world
    return np.linalg.inv(labels_to_world) @ probe_to_world, np.eye(4)


# ---- volumes ---------------------------------------------------------------------------------------------------------


def ijk_to_ras(volume_node) -> np.ndarray:
    """(4, 4) of a volume node, in its own frame."""
    matrix = vtkMatrix4x4()
    volume_node.GetIJKToRASMatrix(matrix)
    return matrix_array(matrix)


def read_volume(volume_node, use: str = "volume") -> Volume:
    """The image of a scalar volume node, in its own frame; its voxels are shared, not copied.

    Raises SimulationError for another node, and for one without image data.
    """
    require_node(volume_node, "vtkMRMLScalarVolumeNode", use=use)
    image = volume_node.GetImageData()
    require(image is not None and image.GetNumberOfPoints() > 0, f"{use} {named(volume_node)} has no image data")
    try:
        return Volume.from_vtk(image, ijk_to_ras(volume_node))
    except SimulationError as error:
        raise SimulationError(f"{use} {named(volume_node)}: {error}") from None


def write_volume(volume_node, volume: Volume) -> None:
    """Put a volume into a volume node, as loading a file does; the node has its own copy of the voxels."""
    volume_node.SetIJKToRASMatrix(vtk_matrix(volume.ijk_to_ras))
    volume_node.SetAndObserveImageData(Volume(volume.array, np.eye(4)).to_vtk())


def read_mask(mask_node, mri_node) -> Volume:
    """A mask on the grid of an MRI: a label map or scalar volume that has it, or a segmentation.

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


# ---- labels ----------------------------------------------------------------------------------------------------------


def labels_version(labels_node) -> Hashable:
    """Changes when voxels, segments, their names or their place in the node's own frame change."""
    if labels_node.IsA("vtkMRMLSegmentationNode"):
        segmentation = labels_node.GetSegmentation()
        parts = [labels_node.GetID()]
        for segment_id in segmentation.GetSegmentIDs():
            segment = segmentation.GetSegment(segment_id)
            source = segment.GetRepresentation(segmentation.GetSourceRepresentationName())
            parts.append((segment_id, segment.GetName(), None if source is None else source.GetMTime()))
        return tuple(parts)
    image, colours = labels_node.GetImageData(), _colour_node(labels_node)
    return (
        labels_node.GetID(),
        None if image is None else image.GetMTime(),
        ijk_to_ras(labels_node).tobytes(),
        None if colours is None else colours.GetMTime(),
    )


def read_labels(labels_node, tissues: TissueTable) -> LabelledTissues:
    """What a label map or a segmentation holds, one label for every tissue that its names stand for.

    The names are those of segments, or of a label map's colours; `tissues` are known by name before the presets are.
    A label whose colour has no tissue's name, or only the one of Slicer's default table, is the tissue with that label
    in `tissues`.
    Raises SimulationError for a node without voxels or segments, and lists names that nobody knows.
    """
    require_node(labels_node, "vtkMRMLLabelMapVolumeNode", "vtkMRMLSegmentationNode", use="label map")
    if labels_node.IsA("vtkMRMLSegmentationNode"):
        volume, names = _read_segmentation(labels_node)
    else:
        volume = read_volume(labels_node, "label map")
        names = _colour_names(labels_node, volume, tissues)
    known = {label: _tissue_name(name, tissues) for label, name in names.items()}
    unknown = [names[label] for label, tissue in known.items() if tissue is None]
    require(
        not unknown,
        f"{named(labels_node)}: no tissue is called {', '.join(map(repr, unknown))}; rename to one of: "
        f"{', '.join([*tissues.names()[1:], *(name for name in TISSUES if name not in tissues.names())])}",
    )
    order = tuple(dict.fromkeys(known.values()))
    table = np.zeros(max(names, default=0) + 1, np.uint8)
    for label, tissue in known.items():
        table[label] = order.index(tissue) + 1
    return LabelledTissues(volume.with_array(table[volume.array]), order)


def _tissue_name(name: str, tissues: TissueTable) -> str | None:
    for tissue in tissues.values():
        if same_name(tissue.name, name):
            return tissue.name
    try:
        return tissue_named(name).name
    except SimulationError:
        return None


def _require_segments(segmentation_node, use: str) -> None:
    require(
        segmentation_node.GetSegmentation().GetNumberOfSegments() > 0,
        f"{use} {named(segmentation_node)} is empty, expected at least one segment",
    )


def _read_segmentation(segmentation_node) -> tuple[Volume, dict[int, str]]:
    _require_segments(segmentation_node, "label map")
    segmentation = segmentation_node.GetSegmentation()
    ids, values, names = vtkStringArray(), vtkIntArray(), {}
    for number, segment_id in enumerate(segmentation.GetSegmentIDs(), 1):
        ids.InsertNextValue(segment_id)
        values.InsertNextValue(number)
        names[number] = segmentation.GetSegment(segment_id).GetName()
    require(
        segmentation_node.CreateBinaryLabelmapRepresentation(),
        f"label map {named(segmentation_node)} has no binary label map and none can be made of it",
    )
    merged = slicer.vtkOrientedImageData()
    segmentation_node.GenerateMergedLabelmapForAllSegments(
        merged, slicer.vtkSegmentation.EXTENT_UNION_OF_EFFECTIVE_SEGMENTS, None, ids, values
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


def _colour_names(labels_node, volume: Volume, tissues: TissueTable) -> dict[int, str]:
    values = volume.array
    require(
        np.issubdtype(values.dtype, np.integer) and int(values.min()) >= 0 and int(values.max()) < 100_000,
        f"label map {named(labels_node)} holds {values.dtype} from {values.min()} to {values.max()}, expected whole "
        "numbers from 0 to 99999",
    )
    colours, names = _colour_node(labels_node), {}
    known_colours = 0 if colours is None else colours.GetNumberOfColors()
    # Slicer gives every label map this table, in which 2 is bone and 3 is skin, whatever they are.
    is_default = colours is not None and colours.GetName() == "GenericAnatomyColors"
    for label in map(int, np.flatnonzero(np.bincount(values.ravel()))):
        if label == 0:
            continue
        name = colours.GetColorName(label) if label < known_colours else None
        if name in (None, "", "(none)"):
            name = f"label {label}"
        if label in tissues and (is_default or _tissue_name(name, tissues) is None):
            name = tissues[label].name
        names[label] = name
    require(bool(names), f"label map {named(labels_node)} is empty, expected voxels that are not 0")
    return names


def write_labels(labels_node, labels: Volume, names: Iterable[str], like_node) -> None:
    """Put a label map with named, coloured tissues into a label map or segmentation node, where a volume node is."""
    parent = like_node.GetParentTransformNode()
    labels_node.SetAndObserveTransformNodeID(None if parent is None else parent.GetID())
    if labels_node.IsA("vtkMRMLSegmentationNode"):
        # After the transform: the node translates the reference geometry into its own frame.
        labels_node.SetReferenceImageGeometryParameterFromVolumeNode(like_node)
        _write_segmentation(labels_node, labels, tuple(names))
    else:
        _write_label_map(labels_node, labels, tuple(names))


def _write_label_map(labels_node, labels: Volume, names: tuple[str, ...]) -> None:
    scene = labels_node.GetScene()
    write_volume(labels_node, labels)
    colours = labels_node.GetNodeReference("tissueColors")
    if colours is None:
        colours = scene.AddNewNodeByClass("vtkMRMLColorTableNode", f"{labels_node.GetName()} tissues")
        labels_node.SetNodeReferenceID("tissueColors", colours.GetID())
    colours.SetTypeToUser()
    colours.SetNumberOfColors(len(names) + 1)
    colours.SetColor(0, "coupling", 0.0, 0.0, 0.0, 0.0)
    for label, name in enumerate(names, 1):
        colours.SetColor(label, name, *colour_of(name), 1.0)
    display = labels_node.GetDisplayNode()
    if display is None:  # not the default one, which looks for colours that only Slicer's own scene has
        display = scene.AddNewNodeByClass("vtkMRMLLabelMapVolumeDisplayNode")
        labels_node.SetAndObserveDisplayNodeID(display.GetID())
    display.SetAndObserveColorNodeID(colours.GetID())
    labels_node.Modified()


def _write_segmentation(segmentation_node, labels: Volume, names: tuple[str, ...]) -> None:
    segmentation = segmentation_node.GetSegmentation()
    was_modifying = segmentation_node.StartModify()
    segmentation.RemoveAllSegments()
    segmentation_node.SetSourceRepresentationToBinaryLabelmap()
    for label, name in enumerate(names, 1):
        mask = slicer.vtkOrientedImageData()
        mask.ShallowCopy(Volume(labels.array == label, np.eye(4)).to_vtk())
        mask.SetImageToWorldMatrix(vtk_matrix(labels.ijk_to_ras))
        segmentation_node.AddSegmentFromBinaryLabelmapRepresentation(mask, name, colour_of(name), name)
    segmentation_node.EndModify(was_modifying)
    display_of(segmentation_node)


# ---- what is simulated -----------------------------------------------------------------------------------------------


def write_image(volume_node, frame: Frame, transform_node=None) -> None:
    """Put a frame into a volume node: fixed geometry in the probe frame, under the probe's transform node.

    So the slice moves with the transform at once, and the pixels follow.
    """
    write_slice(volume_node, Volume(frame.image[None], frame.grid.slice_to_probe), transform_node)


def write_slice(volume_node, in_probe: Volume, transform_node=None) -> None:
    """Put a uint8 volume of one slice into a volume node, which keeps its memory where the size is the same."""
    was_modifying = volume_node.StartModify()
    if transform_node is not None and volume_node.GetTransformNodeID() != transform_node.GetID():
        volume_node.SetAndObserveTransformNodeID(transform_node.GetID())
    image = volume_node.GetImageData()
    _, rows, columns = in_probe.array.shape
    if image is None or image.GetDimensions() != (columns, rows, 1) or image.GetScalarTypeAsString() != "unsigned char":
        write_volume(volume_node, in_probe)
        _show_all_greys(volume_node)
    else:
        if not np.array_equal(ijk_to_ras(volume_node), in_probe.ijk_to_ras):
            volume_node.SetIJKToRASMatrix(vtk_matrix(in_probe.ijk_to_ras))
        scalars = image.GetPointData().GetScalars()
        np.asarray(memoryview(scalars)).reshape(rows, columns)[:] = in_probe.array[0]
        scalars.Modified()
        image.Modified()
    volume_node.EndModify(was_modifying)


def _show_all_greys(volume_node) -> None:
    """Black at 0 and white at 255, as on a scanner: an automatic window would change brightness from frame to frame."""
    if volume_node.GetScene() is None:  # an item of a sequence
        return
    display = display_of(volume_node)
    if display is not None and display.GetAutoWindowLevel():
        display.SetAutoWindowLevel(False)
        display.SetWindowLevelMinMax(0, 255)


def write_outline(model_node, probe: Probe, transform_node) -> None:
    """Put the outline of the imaged field into a model node, under the probe's transform node."""
    model_node.SetAndObservePolyData(outline_polydata(probe))
    if model_node.GetTransformNodeID() != transform_node.GetID():
        model_node.SetAndObserveTransformNodeID(transform_node.GetID())
    is_new = model_node.GetDisplayNode() is None
    display = display_of(model_node)
    if is_new and display is not None:
        display.SetColor(1.0, 0.85, 0.1)
        display.SetLineWidth(3)
        display.SetLighting(False)
        display.SetVisibility2D(True)
        display.SetSliceDisplayModeToProjection()


def show_in_slice(slice_node, volume_node, probe_to_world: np.ndarray, probe: Probe, fit: bool, behind=None) -> None:
    """Turn a slice view into the plane of the probe, standing as on a scanner, and lay the image over its background.

    `fit` also makes the imaged field fill the view; `behind` is another volume to put into the background.
    """
    left, right, top, bottom = probe.image_bounds_mm()
    view = probe_to_world @ np.diag([1.0, -1.0, -1.0, 1.0])  # a view's second axis goes up, the probe's goes down
    view[:3, 3] = (probe_to_world @ [0.5 * (left + right), 0.5 * (top + bottom), 0.0, 1.0])[:3]
    slice_node.GetSliceToRAS().DeepCopy(vtk_matrix(view))
    if fit:
        width, height, thickness = slice_node.GetFieldOfView()
        scale = max((right - left) / width, (bottom - top) / height) * 1.05
        slice_node.SetFieldOfView(width * scale, height * scale, thickness)
    slice_node.UpdateMatrices()
    composite = composite_of(slice_node)
    if composite is None:
        return
    if behind is not None:
        composite.SetBackgroundVolumeID(behind.GetID())
    if composite.GetForegroundVolumeID() != volume_node.GetID():
        composite.SetForegroundVolumeID(volume_node.GetID())
        composite.SetForegroundOpacity(1.0)


def composite_of(slice_node):
    """The vtkMRMLSliceCompositeNode that says what a slice view shows, or None."""
    composites = nodes_of_class(slice_node.GetScene(), "vtkMRMLSliceCompositeNode")
    return next((node for node in composites if node.GetLayoutName() == slice_node.GetLayoutName()), None)
