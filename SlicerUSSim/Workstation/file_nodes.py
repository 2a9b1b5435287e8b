"""FileNodes: reads files into nodes of the scene: MRI, label maps, masks, points, tracked sequences."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.files import mask_beside
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mri.given_mask import checked_mask
from SlicerUSSim.Logic.mri.markups import is_markup_name
from SlicerUSSim.Logic.mri.masks import with_label_names
from SlicerUSSim.Logic.mri.samples import demo_mri
from SlicerUSSim.Logic.mri.segmentation_settings import SheetSettings
from SlicerUSSim.Logic.mri.sheets.kept import sheets_beside
from SlicerUSSim.Logic.mri.sheets.polydata import as_polydata, read_surfels
from SlicerUSSim.Logic.mrml.label_nodes import write_labels
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic
from SlicerUSSim.Logic.mrml.nodes import display_of, read_volume, write_volume
from SlicerUSSim.Logic.mrml.scene_record import SceneRecord, SequenceRecord
from SlicerUSSim.Logic.mrml.sequence_nodes import KnownField, add_sequence, write_known_field
from SlicerUSSim.Logic.mrml.taken_image import PATIENT
from SlicerUSSim.Logic.placement.craniotomy import is_open, polygon_of_file
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.tissue.label_mapping import LabelMapping
from SlicerUSSim.Logic.tissue.label_maps import LabelledTissues, as_whole
from SlicerUSSim.Logic.tissue.label_sources import read_label_file, table_beside
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tracked.images import TrackedImages
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence
from SlicerUSSim.Workstation.tasks import Tasks
from SlicerUSSim.Workstation.uploads import as_known

#: Attribute of a node: the file from which it was read; "" for the demo brain, the name alone for one sent by a page.
FILE = "SlicerUSSim.file"


@dataclass(frozen=True)
class Files:
    """Files and options at the start; without an MRI and labels, the demo brain is used."""

    mri: str | None = None
    labels: str | None = None
    #: Tissues of the labels, as label_mapping.LabelMapping.of reads them
    maps: tuple[str, ...] = ()
    contrast: str = "t1"
    mask: str | None = None
    skull_strip: str = "atlas"
    #: Whether skin, scalp, skull and air are labelled, too
    outside: bool = False
    #: Label map of organs of a CT
    organs: str | None = None
    #: A .vtp with thin sheets; and what Segment looks for, and images show
    sheets: str | None = None
    sheet_settings: SheetSettings = field(default_factory=SheetSettings)
    #: Opening of skin and skull: none, auto or disc: (under the probe), or a file; and the diameter of the disc
    craniotomy: str = "none"
    craniotomy_mm: float | None = None
    #: {contrast: file} of further MRIs of the patient; the first is selected
    also: Mapping[str, str] = field(default_factory=dict)
    #: (tissue, file) of masks that are laid over the labels
    additions: tuple[tuple[str, str], ...] = ()
    preset: Preset | None = None
    sequence: TrackedSequence | None = None
    sequence_name: str = "sequence"
    #: Transform from pixels to the reference frame, and from there to the MRI; see TrackedImages.of
    transform: str = "ImageToReference"
    to_ras: np.ndarray | None = None
    #: A scene that is shown in place of a patient from files, and its name
    scene: SceneRecord | None = None
    scene_name: str = ""
    #: A file that is opened as if a page had sent it, after the others
    also_open: str | None = None
    #: OpenIGTLink, as openigtlink.parse_address reads it, and the transform to follow
    tracker: str | None = None
    tracker_device: str | None = None
    #: Volumes that have already been read, by file
    volumes: Mapping[str, Volume] = field(default_factory=dict)


@dataclass(frozen=True)
class LabelTable:
    """What the file of a table says about the labels of a label map."""

    name: str
    #: As `ussim segment` writes them; None of another table
    tissues: TissueTable | None = None
    mapping: LabelMapping = field(default_factory=LabelMapping)


class FileNodes:
    """Reads files in the worker thread and adds them to the scene. Raises SimulationError for invalid files."""

    def __init__(self, logic: UltrasoundSceneLogic, tasks: Tasks, files: Files) -> None:
        self._scene, self._logic, self._tasks, self._files = logic.scene, logic, tasks, files
        #: Volumes that were read to see what they are, by file, until they are used
        self.volumes = dict(files.volumes)
        #: Names of the preset's tissues since the table of a label map was added to them
        self._names_of_table: list[str] | tuple[str, ...] = ()

    # ---- images of the patient ---------------------------------------------------------------------------------

    def mri(self, path: str | None):
        """A volume node with the MRI of a file, or with the demo brain."""
        volume = self._tasks.doAside(lambda: demo_mri()[0]) if path is None else self._volume(path)
        node = self._node("ScalarVolume", path or "MNI152 brain")
        write_volume(node, volume)
        node.SetAttribute(FILE, "" if path is None else as_known(os.path.abspath(path)))
        show_all_tissue(node, volume)
        return node

    def second_mri(self, path: str):
        """A volume node with a further MRI of the patient."""
        node = self._node("ScalarVolume", path)
        write_volume(node, self._volume(path))
        return node

    def mask_file(self, mri_node) -> Path | None:
        """Where the brain mask of an MRI is kept: beside the file with which the workstation was started."""
        path = os.path.abspath(self._files.mri or "")
        return mask_beside(path) if self._files.mri and mri_node.GetAttribute(FILE) == path else None

    def sheets_file(self, mri_node) -> Path | None:
        """The same of the sheets that were found in it."""
        kept = self.mask_file(mri_node)
        return None if kept is None else sheets_beside(os.path.abspath(str(self._files.mri)))

    # ---- labels ------------------------------------------------------------------------------------------------

    def labels(self, path: str, table: LabelTable | None = None) -> tuple[Any, LabelledTissues]:
        """(label map node, what was recognised) of a file; see label_sources.read_label_file.

        Tissues come from `table`, the table or names beside the file, the preset, or a known program's numbers.
        """
        volume, mine = self._volume(path), self._logic.preset.tissues
        mapping = LabelMapping.of(self._files.maps if path == self._files.labels else (), mine)
        if table is not None:
            mapping, beside = table.mapping, table.tissues
        else:
            beside = None if mapping else table_beside(Path(path))
        # A table that came with other labels was not chosen for these, whose numbers mean something else.
        is_chosen = mine.names() not in (Preset().tissues.names(), self._names_of_table)
        found = self._tasks.doAside(
            lambda: read_label_file(
                Path(path), volume, mapping, table=beside, preset=mine if is_chosen else None, default=mine
            )
        )  # fmt: skip
        if beside is not None:
            for tissue in beside.values():
                mine = mine.with_tissue(tissue)
            self._logic.preset = replace(self._logic.preset, tissues=mine)
            self._names_of_table = mine.names()
        named = f", named in {table.name}" if table is not None and mapping.names else ""
        warnings = tuple(map(as_known, (*found.warnings, *volume.doubts)))
        found = replace(found, message=as_known(found.message) + named, warnings=warnings)
        node = self._label_map(found.labels, path, found.names)
        node.SetAttribute(PATIENT, node.GetName())
        return node, found

    def organs(self, path: str, maps: Iterable[str] = ()) -> tuple[Any, LabelledTissues]:
        """(label map node with the organs of a CT, what was recognised) of a file."""
        volume, table = self._volume(path), TissueTable({})
        mapping = LabelMapping.of(maps, table)
        found = self._tasks.doAside(lambda: read_label_file(Path(path), volume, mapping, default=table, of_ct=True))
        return self._label_map(found.labels, path, found.names), replace(found, message=as_known(found.message))

    def brain_mask(self, path: str, mri_node):
        """A label map node with the mask of a file. Raises SimulationError unless it is one on the grid of the MRI."""
        volume, mri = self._volume(path), read_volume(mri_node)
        self._tasks.doAside(lambda: checked_mask(volume, mri))
        return self._label_map(volume, path, ["inside"])

    def lesions(self, path: str) -> Volume:
        """The mask of lesions of a file, with the names of its labels."""
        found = with_label_names(self._volume(path), path)
        return replace(found, doubts=tuple(map(as_known, found.doubts)))

    # ---- surfaces and points -----------------------------------------------------------------------------------

    def sheets(self, path: str):
        """A model node with the sheets of a .vtp."""
        surfels = self._tasks.doAside(lambda: read_surfels(path))
        node = self._node("Model", path)
        node.SetAndObservePolyData(as_polydata(surfels))
        display_of(node).SetVisibility(False)
        return node

    def opening(self, path: str):
        """A node with the opening of a file: a closed curve through the points of a markup, or a mask."""
        if not is_markup_name(path):
            return self._label_map(is_open(with_label_names(self._volume(path), path), path), path, ["opening"])
        return self._markups("MarkupsClosedCurve", path, polygon_of_file(path))

    def points(self, path: str, points: np.ndarray):
        """A node with the list of points, (n, 3) RAS mm, of a file."""
        return self._markups("MarkupsFiducial", path, points)

    # ---- tracked ultrasound ------------------------------------------------------------------------------------

    def sequence(self, record: SequenceRecord):
        """(TrackedImages, sequence browser node, sequence node of the images, all nodes that were made)."""
        scene, tracked = self._scene, record.tracked or self.prepared(record)
        before = {scene.GetNthNode(number) for number in range(scene.GetNumberOfNodes())}
        browser, images = add_sequence(
            scene, record.sequence, record.name, record.path, record.to_ras, tracked.poses,
            self._logic.parameters.probe_transform,
        )  # fmt: skip
        write_known_field(images, KnownField(tracked.field, np.eye(4) if record.to_ras is None else record.to_ras))
        now = [scene.GetNthNode(number) for number in range(scene.GetNumberOfNodes())]
        return tracked, browser, images, [node for node in now if node not in before]

    def prepared(self, record: SequenceRecord, probe: Probe | None = None) -> TrackedImages:
        """The images of a record. Raises SimulationError for those in which the probe's field is not found.

        Without a known field the beam comes from `probe` or the present one, and the geometry from the preset at the
        start, if there was one.
        """
        probe = probe or self._logic.preset.probe
        known = probe if self._files.preset is not None else None
        return self._tasks.doAside(
            lambda: TrackedImages.of(
                record.sequence, path=record.path, reference_to_ras=record.to_ras, beam=probe, probe=known,
                field=record.field,
            )
        )  # fmt: skip

    # ---- implementation ----------------------------------------------------------------------------------------

    def _node(self, kind: str, path: str) -> Any:
        return self._scene.AddNewNodeByClass(f"vtkMRML{kind}Node", Path(path).name)

    def _markups(self, kind: str, path: str, points: np.ndarray):
        node = self._node(kind, path)
        for point in points:
            node.AddControlPointWorld(*point)
        return node

    def _volume(self, path: str) -> Volume:
        """The volume of a file, read once."""
        return self.volumes.pop(path, None) or self._tasks.doAside(lambda: Volume.read(path))

    def _label_map(self, volume: Volume, path: str, names):
        volume = as_whole(volume, path)
        node = self._node("LabelMapVolume", path)
        node.SetAttribute(FILE, as_known(os.path.abspath(path)))
        write_labels(node, volume.with_array(volume.array.astype(np.uint8)), names, node)
        return node


def show_all_tissue(mri_node, volume: Volume) -> None:
    """Choose the grey levels of an MRI; the automatic window saturates bright tissue."""
    display = display_of(mri_node)
    display.SetAutoWindowLevel(False)
    inside = volume.array[volume.array > 0]
    display.SetWindowLevelMinMax(0.0, 1.1 * float(np.percentile(inside, 99.8)) if inside.size else 1.0)
