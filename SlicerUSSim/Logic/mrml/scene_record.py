"""SceneRecord: a patient, the choices and the probe of a scene as plain values, apart from the scene.

A scene file is read into one by a child process.
Taking a record copies no voxels: it shares those of the nodes, which are replaced and not changed by this package.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import slicer
from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkPoints
from vtkmodules.vtkCommonMath import vtkMatrix4x4

from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.base.vtk_data import matrix_array, vtk_matrix
from SlicerUSSim.Logic.mri.sheets.polydata import as_polydata, surfels_of
from SlicerUSSim.Logic.mrml.craniotomy_nodes import closed_labels, set_closed_labels, show_flap
from SlicerUSSim.Logic.mrml.fit_nodes import sequence_of
from SlicerUSSim.Logic.mrml.label_nodes import colour_table, node_labels, read_mask, set_colour_table
from SlicerUSSim.Logic.mrml.lesion_nodes import tag_of
from SlicerUSSim.Logic.mrml.nodes import (
    control_points,
    display_of,
    ijk_to_ras,
    named,
    node_to_world,
    nodes_of_class,
    probe_pose,
    write_volume,
)
from SlicerUSSim.Logic.mrml.own_results import OWN, claim, is_claimed, is_empty
from SlicerUSSim.Logic.mrml.parameter_node import VALUE_PARAMETERS, SceneParameters, preset_texts
from SlicerUSSim.Logic.mrml.sequence_nodes import known_field
from SlicerUSSim.Logic.mrml.share_nodes import set_shares_node, shares_node
from SlicerUSSim.Logic.mrml.taken_image import was_live
from SlicerUSSim.Logic.mrml.taken_sequence import FrozenRecord, SimulatedRecord, record_frozen, record_taken
from SlicerUSSim.Logic.tissue.surfels import Surfels
from SlicerUSSim.Logic.tracked.imaged_field import ImagedField
from SlicerUSSim.Logic.tracked.images import TrackedImages
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence

#: Classes of nodes that a record holds
_VOLUME, _LABELS, _SEGMENTS, _MODEL, _POINTS = (
    "vtkMRMLScalarVolumeNode", "vtkMRMLLabelMapVolumeNode", "vtkMRMLSegmentationNode", "vtkMRMLModelNode",
    "vtkMRMLMarkupsNode",
)  # fmt: skip
#: Roles of nodes of a patient, and of their labels before an opening and the shares of both
ROLES = ("mri", "second_mri", "labels", "mask", "lesions", "organs", "sheets", "seed", "opening", "real")
_CLOSED = "closed"
_SHARES_OF = {"labels": "shares", _CLOSED: "closed shares"}
#: Begin of the attributes of nodes that are this package's
_OWN = "SlicerUSSim."
#: Tags of a segment that are this package's
_TAGS = ("SlicerUSSim.source", "SlicerUSSim.checks")


@dataclass(frozen=True, eq=False)
class SegmentRecord:
    """A segment of a segmentation."""

    name: str
    #: Red, green and blue, 0 to 1
    colour: tuple[float, float, float]
    #: (k, j, i) bool, in the node's own frame
    mask: Volume
    tags: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class NodeRecord:
    """A node with data of a patient; what its class does not have is None or empty."""

    #: Its class
    kind: str
    name: str
    #: Those of this package
    attributes: Mapping[str, str]
    #: (4, 4) of its parent transforms, from its own frame to the world
    to_world: np.ndarray
    #: Of a volume or label map, in its own frame
    volume: Volume | None = None
    #: (name, red, green, blue, opacity) of label 0, 1, ...; None of a label map with the default colours
    colours: tuple[tuple[str, float, float, float, float], ...] | None = None
    segments: tuple[SegmentRecord, ...] = ()
    #: Of sheets, with the corners (4 n, 3) of their squares, which a hardened transform moves
    surfels: Surfels | None = None
    corners: np.ndarray | None = None
    #: (n, 3) of markups, in the world
    points: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class SequenceRecord:
    """Real images with their poses."""

    sequence: TrackedSequence
    name: str
    #: Transform from pixels to the reference frame, and (4, 4) from there to the world; see TrackedImages.of
    path: str = "ImageToReference"
    to_ras: np.ndarray | None = None
    #: As they were prepared; None: not yet
    tracked: TrackedImages | None = None
    #: The probe and its place in the images; a user may have changed that of the scene since. None: unknown
    field: ImagedField | None = None

    @property
    def what(self) -> str:
        """Its images and transforms, in words."""
        rows, columns = self.sequence.images.shape[1:]
        count = len(self.sequence)
        names = sorted({name for entry in self.sequence.transforms for name in entry})
        transforms = f"transforms {', '.join(names)}" if names else "no transforms"
        return f"{count} image{'s' * (count > 1)} of {columns}x{rows}, {transforms}"

    @property
    def is_calibrated(self) -> bool:
        """Whether the place of at least one image is known."""
        return any(self.sequence.has_pose(number, self.path) for number in range(len(self.sequence)))


@dataclass(frozen=True, eq=False)
class SceneRecord:
    """What a scene holds of one patient, with the choices of the module."""

    #: {role: node}, see ROLES; "closed": the labels before an opening; "shares": of the labels, "closed shares"
    nodes: Mapping[str, NodeRecord]
    #: {name: text} of the scene's values, see VALUE_PARAMETERS
    values: Mapping[str, str] = field(default_factory=dict)
    #: (4, 4) probe_to_ras; None without a probe
    pose: np.ndarray | None = None
    sequence: SequenceRecord | None = None
    #: Names of nodes with data that have no role and are left out
    left_out: tuple[str, ...] = ()
    #: Images of Simulate sequence
    simulated: SimulatedRecord | None = None
    #: The simulated image, if it is not the one of the probe's pose
    frozen: FrozenRecord | None = None


# ---- from a scene ----------------------------------------------------------------------------------------------------


def record_nodes(parameters: SceneParameters, roles: Iterable[str] = ROLES) -> dict[str, NodeRecord]:
    """The nodes of these roles, by role. Raises SimulationError for one that cannot be read.

    Labels that are a segmentation become a label map of the same numbers and names, which all views can show; a mask
    that is one is a label map on the grid of the MRI.
    """
    found: dict[str, NodeRecord] = {}
    for role in roles:
        node: Any = getattr(parameters, role)
        if node is None or node.IsA("vtkMRMLSequenceNode") or is_empty(node):
            continue
        if role == "labels":
            closed = closed_labels(node)
            for name, labels in (("labels", node), *(((_CLOSED, closed),) if closed is not node else ())):
                found[name] = _as_label_map(labels)
                shares = shares_node(labels)
                if shares is not None and shares.GetImageData() is not None:
                    found[_SHARES_OF[name]] = _recorded(shares)
        elif role == "mask" and node.IsA(_SEGMENTS) and parameters.mri is not None:
            volume = read_mask(node, parameters.mri)
            mask = volume.with_array((volume.array != 0).astype(np.uint8))
            found[role] = NodeRecord(
                _LABELS, node.GetName(), _attributes(node), node_to_world(parameters.mri), mask, _colours(["inside"])
            )
        else:
            found[role] = _recorded(node)
    return found


def recorded_values(parameters: SceneParameters) -> dict[str, str]:
    """{name: text} of the scene's values and preset that are not the default."""
    texts = parameters.texts
    return {**{name: texts[name] for name in VALUE_PARAMETERS if texts.get(name)}, **preset_texts(texts)}


def record_scene(scene) -> SceneRecord:
    """All of a scene that was loaded from a file. Raises SimulationError if there is nothing to simulate in it."""
    parameters = SceneParameters(scene)
    _choose_missing(scene, parameters)
    nodes = record_nodes(parameters)
    require("mri" in nodes or "labels" in nodes, "the scene has no volume, expected an MRI, or labels of its tissues")
    real, sequence = parameters.real, None
    if real is not None and real.IsA("vtkMRMLSequenceNode") and real.GetNumberOfDataNodes():
        sequence = _real_images(real)
    transform = parameters.probe_transform
    pose = None if transform is None else probe_pose(transform)
    others = tuple(_others(scene, parameters))
    frozen = None if parameters.output is None or was_live(parameters.output) else record_frozen(parameters.output)
    return SceneRecord(
        nodes, recorded_values(parameters), pose, sequence, others, record_taken(parameters.image_sequence),
        frozen,
    )  # fmt: skip


def _real_images(images_node: Any) -> SequenceRecord:
    """Those of a sequence node, registered as they were: together that is where they are in the scene."""
    sequence, name = sequence_of(images_node), images_node.GetName()
    known = known_field(images_node, sequence.images.shape[1:])
    if known is None:
        return SequenceRecord(sequence, name)
    to_reference = np.linalg.inv(known.to_ras)
    before = tuple({way: to_reference @ matrix for way, matrix in entry.items()} for entry in sequence.transforms)
    return SequenceRecord(replace(sequence, transforms=before), name, to_ras=known.to_ras, field=known.field)


def _choose_missing(scene, parameters: SceneParameters) -> None:
    """Choose the MRI of a scene that this module has not been used in: its first volume."""
    if parameters.mri is not None or parameters.labels is not None:
        return
    for node in nodes_of_class(scene, _VOLUME):
        if node.GetClassName() == _VOLUME and not node.GetHideFromEditors() and not is_empty(node):
            parameters.mri = node
            return


def _others(scene, parameters: SceneParameters) -> Iterable[str]:
    """Names of the volumes, labels, models and markups of a scene that have no role and are not results."""
    chosen = {node.GetID() for role in ROLES if (node := getattr(parameters, role)) is not None}
    labels = parameters.labels
    if labels is not None:
        chosen.add(closed_labels(labels).GetID())
    for kind in ("vtkMRMLVolumeNode", _SEGMENTS, _MODEL, _POINTS):
        for node in nodes_of_class(scene, kind):
            is_own = node.GetHideFromEditors() or any(name.startswith(_OWN) for name in _attributes(node))
            is_own = is_own or (node.GetName() or "").endswith("Volume Slice")
            if node.GetID() not in chosen and not is_own and node.GetSaveWithScene():
                yield node.GetName() or node.GetID()


def _recorded(node) -> NodeRecord:
    name, attributes, to_world = node.GetName() or "", _attributes(node), node_to_world(node)
    if node.IsA("vtkMRMLVolumeNode"):
        kind = _LABELS if node.IsA(_LABELS) else _VOLUME
        volume = Volume.from_vtk(node.GetImageData(), ijk_to_ras(node))
        return NodeRecord(kind, name, attributes, to_world, volume, colour_table(node) if kind == _LABELS else None)
    if node.IsA(_SEGMENTS):
        return NodeRecord(_SEGMENTS, name, attributes, to_world, segments=tuple(_segments(node)))
    if node.IsA(_MODEL):
        data = node.GetPolyData()
        surfels = surfels_of(data, f"sheets {named(node)}")
        corners = np.array(vtk_to_numpy(data.GetPoints().GetData()), np.float32)
        return NodeRecord(_MODEL, name, attributes, to_world, surfels=surfels, corners=corners)
    require(node.IsA(_POINTS), f"{named(node)} has a class that is not kept")
    return NodeRecord(node.GetClassName(), name, attributes, np.eye(4), points=control_points(node))


def _as_label_map(node) -> NodeRecord:
    if not node.IsA(_SEGMENTS):
        return _recorded(node)
    volume, names = node_labels(node)
    segmentation = node.GetSegmentation()
    colours = {
        segment.GetName(): segment.GetColor() for segment in map(segmentation.GetSegment, segmentation.GetSegmentIDs())
    }
    texts = [names.get(number, "") for number in range(1, max(names) + 1)]
    return NodeRecord(
        _LABELS, node.GetName() or "", _attributes(node), node_to_world(node), volume, _colours(texts, colours)
    )


def _colours(
    names: Iterable[str], colours: Mapping[str, tuple[float, ...]] | None = None
) -> tuple[tuple[str, float, float, float, float], ...]:
    known = colours or {}
    lines = [(name, *(float(part) for part in known.get(name, (0.8, 0.8, 0.5))[:3]), 1.0) for name in names]
    return (("coupling", 0.0, 0.0, 0.0, 0.0), *lines)  # type: ignore[return-value]


def _attributes(node) -> dict[str, str]:
    """Of this module; OWN, which is a reference in scenes, tells whose the node is."""
    found = {name: node.GetAttribute(name) for name in node.GetAttributeNames() if name.startswith(_OWN)}
    return {**found, OWN: "1"} if is_claimed(node) else found


def _segments(node) -> Iterable[SegmentRecord]:
    require(
        node.CreateBinaryLabelmapRepresentation(),
        f"{named(node)} has no binary label map and cannot be converted to one",
    )
    segmentation = node.GetSegmentation()
    for segment_id in segmentation.GetSegmentIDs():
        segment, image = segmentation.GetSegment(segment_id), slicer.vtkOrientedImageData()
        if not node.GetBinaryLabelmapRepresentation(segment_id, image) or min(image.GetDimensions()) < 1:
            continue
        matrix = vtkMatrix4x4()
        image.GetImageToWorldMatrix(matrix)
        mask = Volume.from_vtk(image, matrix_array(matrix))
        tags = {name: text for name in _TAGS if (text := tag_of(segment, name))}
        yield SegmentRecord(segment.GetName(), segment.GetColor(), mask.with_array(mask.array > 0), tags)


# ---- into a scene ----------------------------------------------------------------------------------------------------


def put_nodes(scene, record: SceneRecord) -> dict[str, Any]:
    """{role: node} of a record, added to a scene; nothing is chosen yet.

    Raises SimulationError for a record that does not fit together; no node is left in the scene then.
    """
    made: dict[str, Any] = {}
    extra: list[Any] = []
    try:
        for role, entry in record.nodes.items():
            made[role] = _put(scene, entry, extra)
        for role, of_role in _SHARES_OF.items():
            shares = made.get(of_role)
            if role in made and shares is not None:
                set_shares_node(made[role], shares)
        if _CLOSED in made and "labels" in made:
            _open_again(made["labels"], made[_CLOSED], record)
    except BaseException:
        for node in (*made.values(), *extra):
            scene.RemoveNode(node)
        raise
    return made


def put_values(parameters: SceneParameters, values: Mapping[str, str]) -> list[str]:
    """Set the scene's values and preset from their texts; returns lines about values that this version does not take.

    A preset is taken unchecked, and checked when it is used.
    """
    node, refused = parameters.node, []
    was_modifying = node.StartModify()
    for name, declared in VALUE_PARAMETERS.items():
        text = values.get(name, "")
        try:
            value = declared.default if text == "" else declared.from_text("scene", text)
            setattr(parameters, name, value)
        except SimulationError as error:
            refused.append(str(error).replace(f"scene: {name} is ", f"{declared.label or name} in the scene is ", 1))
    parameters.put_preset(values)
    node.EndModify(was_modifying)
    return refused


def _put(scene, entry: NodeRecord, extra: list[Any]):
    known = (_VOLUME, _LABELS, _SEGMENTS, _MODEL, "vtkMRMLMarkupsFiducialNode", "vtkMRMLMarkupsClosedCurveNode")
    kind = entry.kind if entry.kind in known or entry.points is None else "vtkMRMLMarkupsClosedCurveNode"
    require(kind in known, f"{entry.name!r} is a {entry.kind}, which is not kept")
    node = scene.AddNewNodeByClass(kind, entry.name)
    try:
        if not np.array_equal(entry.to_world, np.eye(4)):
            parent = scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", f"{entry.name} transform")
            extra.append(parent)
            parent.SetMatrixTransformToParent(vtk_matrix(entry.to_world))
            node.SetAndObserveTransformNodeID(parent.GetID())
        if entry.volume is not None:
            write_volume(node, entry.volume)
            if kind == _LABELS and entry.colours is not None:
                set_colour_table(node, entry.colours)
        for segment in entry.segments:
            _put_segment(node, segment)
        if entry.surfels is not None and entry.corners is not None:
            _put_sheets(node, entry.surfels, entry.corners)
        for point in () if entry.points is None else entry.points.tolist():
            node.AddControlPointWorld(*point)
        for name, text in entry.attributes.items():
            if name == OWN:
                claim(node)
            elif name.startswith(_OWN):
                node.SetAttribute(name, text)
    except BaseException:
        scene.RemoveNode(node)
        raise
    return node


def _put_segment(node, segment: SegmentRecord) -> None:
    if node.GetSegmentation().GetNumberOfSegments() == 0:
        node.SetSourceRepresentationToBinaryLabelmap()
    image = slicer.vtkOrientedImageData()
    image.ShallowCopy(Volume(segment.mask.array, np.eye(4)).to_vtk())
    image.SetImageToWorldMatrix(vtk_matrix(segment.mask.ijk_to_ras))
    segment_id = node.GetSegmentation().GenerateUniqueSegmentID(segment.name)
    node.AddSegmentFromBinaryLabelmapRepresentation(image, segment.name, segment.colour, segment_id)
    for name, text in segment.tags.items():
        node.GetSegmentation().GetSegment(segment_id).SetTag(name, text)


def _put_sheets(node, surfels: Surfels, corners: np.ndarray) -> None:
    data = as_polydata(surfels)
    require(corners.shape == (4 * len(surfels), 3), f"sheets {node.GetName()!r}: corners are {corners.shape}")
    points = vtkPoints()
    points.SetData(numpy_to_vtk(np.ascontiguousarray(corners, np.float32), deep=1))
    data.SetPoints(points)
    node.SetAndObservePolyData(data)
    display = display_of(node)
    if display is not None:
        display.SetVisibility(False)


def _open_again(labels: Any, closed: Any, record: SceneRecord) -> None:
    """Let labels be those of another node with an opening again, with the model of what was removed."""
    now, before = record.nodes["labels"].volume, record.nodes[_CLOSED].volume
    set_closed_labels(labels, closed)
    if now is None or before is None or now.array.shape != before.array.shape:
        return
    removed = now.array != before.array
    if removed.any():
        show_flap(labels, now.with_array(removed))
