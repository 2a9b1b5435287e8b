"""Opener: reads files into nodes of the scene: MRI, label maps, masks, tracked sequences."""

from __future__ import annotations

import filecmp
import logging
import os
import shutil
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import Cancelled, SimulationError, require
from SlicerUSSim.Logic.base.files import mask_beside, read_json
from SlicerUSSim.Logic.base.reading import untrusted_folder
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mri.markups import is_markup_name
from SlicerUSSim.Logic.mri.masks import with_label_names
from SlicerUSSim.Logic.mri.samples import demo_mri
from SlicerUSSim.Logic.mri.segmentation_settings import SheetSettings
from SlicerUSSim.Logic.mri.sheets.kept import sheets_beside
from SlicerUSSim.Logic.mri.sheets.polydata import as_polydata, read_surfels
from SlicerUSSim.Logic.mrml.label_nodes import read_labels, write_labels
from SlicerUSSim.Logic.mrml.lesion_nodes import add_lesion
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic
from SlicerUSSim.Logic.mrml.nodes import display_of, write_volume
from SlicerUSSim.Logic.mrml.scene_record import SceneRecord, SequenceRecord
from SlicerUSSim.Logic.mrml.sequence_nodes import KnownField, add_sequence, write_known_field
from SlicerUSSim.Logic.mrml.taken_image import PATIENT, patient_of
from SlicerUSSim.Logic.placement.craniotomy import is_open, polygon_of_file
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.tissue.label_mapping import LabelMapping
from SlicerUSSim.Logic.tissue.label_maps import LabelledTissues, as_whole
from SlicerUSSim.Logic.tissue.label_sources import read_label_file, table_beside
from SlicerUSSim.Logic.tissue.table import TissueTable, tissues_beside
from SlicerUSSim.Logic.tracked.images import TrackedImages
from SlicerUSSim.Logic.tracked.sequence import TrackedSequence
from SlicerUSSim.Workstation.content import Content, Kind, content_of, has_probe
from SlicerUSSim.Workstation.parcel import Parcel
from SlicerUSSim.Workstation.script import LabelSource
from SlicerUSSim.Workstation.tasks import Tasks
from SlicerUSSim.Workstation.zipped import zipped

_log = logging.getLogger(__name__)

#: Kinds of files in the order in which those of one parcel are opened: settings, a patient, what is laid on him
_ORDER = (
    Kind.SCENE, Kind.PRESET, Kind.MRI, Kind.CT, Kind.LABELS, Kind.LESIONS, Kind.MASK, Kind.SHEETS, Kind.SEQUENCE,
    Kind.TRANSFORM, Kind.POSE, Kind.POINTS, Kind.TABLE,
)  # fmt: skip
#: Parcels whose names of files are known
_MOST_PARCELS = 8
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


@dataclass(frozen=True)
class Upload:
    """A file that a page has sent."""

    path: str
    content: Content
    #: Of the labels; None without
    table: LabelTable | None = None

    @property
    def kind(self) -> Kind:
        """What it was recognised as."""
        return self.content.kind

    @property
    def name(self) -> str:
        """Its name, as the user knows it."""
        return Path(self.path).name


class Opener:
    """Reads files in the worker thread and adds them to the scene. Raises SimulationError for invalid files."""

    def __init__(self, scene, logic: UltrasoundSceneLogic, tasks: Tasks, files: Files) -> None:
        self._scene, self._logic, self._tasks, self._files = scene, logic, tasks, files
        self._sources: dict[tuple, LabelSource] = {}
        #: {segments of a node: (tissue, file) of each}
        self._lesion_files: dict[tuple, tuple[tuple[str, str], ...]] = {}
        self._volumes = dict(files.volumes)  # read, but not yet used
        #: Names of the preset's tissues since the table of a label map was added to them
        self._names_of_table: list[str] | tuple[str, ...] = ()
        #: The sequence of the patient, which is opened
        self.opened_sequence: SequenceRecord | None = None
        #: What pages have sent last, some of which may still wait for an answer
        self._parcels: deque[Parcel] = deque(maxlen=_MOST_PARCELS)
        #: Of files that pages have sent, by temporary path: the others that are read with it, and the name under which
        #: it is kept
        self._read_with: dict[str, tuple[Path, ...]] = {}
        self._kept_names: dict[str, str] = {}
        #: Those of the patient that scripts need
        self.sent_files = SentFiles()

    def mri(self, path: str | None):
        """A volume node with the MRI of a file, or with the demo brain."""
        volume = self._tasks.doAside(lambda: demo_mri()[0]) if path is None else self._volume(path)
        name = "MNI152 brain" if path is None else Path(path).name
        node = self._scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", name)
        write_volume(node, volume)
        node.SetAttribute(FILE, "" if path is None else self._place(path))
        show_all_tissue(node, volume)
        return node

    def mask_file(self, mri_node) -> Path | None:
        """Where the brain mask of an MRI is kept: beside the file with which the workstation was started."""
        path = None if self._files.mri is None else os.path.abspath(self._files.mri)
        return mask_beside(path) if path is not None and mri_node.GetAttribute(FILE) == path else None

    def sheets_file(self, mri_node) -> Path | None:
        """The same of the sheets that were found in it."""
        kept = self.mask_file(mri_node)
        return None if kept is None else sheets_beside(os.path.abspath(str(self._files.mri)))

    def sheets(self, path: str):
        """A model node with the sheets of a .vtp."""
        surfels = self._tasks.doAside(lambda: read_surfels(path))
        node = self._scene.AddNewNodeByClass("vtkMRMLModelNode", Path(path).name)
        node.SetAndObservePolyData(as_polydata(surfels))
        node.SetAttribute(FILE, self._place(path))
        display_of(node).SetVisibility(False)
        return node

    def organs(self, path: str, maps: Iterable[str] = ()) -> tuple[Any, LabelledTissues]:
        """(label map node with the organs of a CT, what was recognised) of a file."""
        volume, table = self._volume(path), TissueTable({})
        mapping = LabelMapping.of(maps, table)
        found = self._tasks.doAside(lambda: read_label_file(Path(path), volume, mapping, default=table, of_ct=True))
        return self._label_map(found.labels, path, found.names), replace(found, message=self.as_known(found.message))

    def second_mri(self, path: str):
        """A volume node with a further MRI of the patient."""
        node = self._scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", Path(path).name)
        write_volume(node, self._volume(path))
        node.SetAttribute(FILE, self._place(path))
        return node

    def mask(self, path: str):
        """A label map node with the mask of a file."""
        return self._label_map(self._volume(path), path, ["inside"])

    def opening(self, path: str):
        """A node with the opening of a file: a closed curve through the points of a markup, or a mask."""
        if not is_markup_name(path):
            return self._label_map(is_open(self._mask(path), path), path, ["opening"])
        return self._markups("vtkMRMLMarkupsClosedCurveNode", path, polygon_of_file(path))

    def points(self, path: str, points: np.ndarray):
        """A node with the list of points, (n, 3) RAS mm, of a file."""
        return self._markups("vtkMRMLMarkupsFiducialNode", path, points)

    def _markups(self, kind: str, path: str, points: np.ndarray):
        node = self._scene.AddNewNodeByClass(kind, Path(path).name)
        for point in points:
            node.AddControlPointWorld(*point)
        node.SetAttribute(FILE, self._place(path))
        return node

    def labels(self, path: str, table: LabelTable | None = None) -> tuple[Any, LabelledTissues]:
        """(label map node, what was recognised) of a file; see label_sources.read_label_file.

        Tissues are those of `table`, of the table or names beside it, of the preset, or of a known program's numbers.
        """
        volume = self._volume(path)
        mine = self._logic.preset.tissues
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
        if mapping.names and table is not None:
            found = replace(found, message=f"{found.message}, named in {table.name}")
        found = replace(
            found,
            message=self.as_known(found.message),
            warnings=tuple(map(self.as_known, (*found.warnings, *volume.doubts))),
        )
        node = self._label_map(found.labels, path, found.names)
        node.SetAttribute(PATIENT, node.GetName())
        order = read_labels(node, self._logic.preset.tissues).names
        relabelled = {old: order.index(found.names[new - 1]) + 1 if new else 0 for old, new in found.relabelled.items()}
        source = LabelSource(self._place(path), True, relabelled=relabelled, tissue_names=tuple(order))
        self._sources = {_voxels_of(node): source}
        return node, found

    def lesion(self, path: str) -> tuple[Volume, str]:
        """(volume with the names of its labels, path or kept name) of a file with lesions."""
        return self._mask(path), self._place(path)

    def peek(self, path: str) -> Volume:
        """The volume of a file, which is read again from what is known of it."""
        self._volumes[path] = volume = self._volume(path)
        return volume

    def lesion_of_file(self, lesions_node, tissue: str, path: str):
        """The segmentation node with the lesions, with a mask of a file; made if it is None."""
        node, _ = self.add_lesion(lesions_node, self._mask(path), tissue, Path(path).name, os.path.abspath(path))
        return node

    def add_lesion(self, lesions_node, mask: Volume, tissue: str, name: str, file: str):
        """(segmentation node with the lesions, function that takes the mask out of it again).

        `file` is that of the mask: its path, or the name under which what a page has sent is kept.
        """
        files = self.lesion_files(lesions_node)
        made = lesions_node is None
        node = self._scene.AddNewNodeByClass("vtkMRMLSegmentationNode", "Lesions") if made else lesions_node

        def undo(ids: Iterable[str] = ()) -> None:
            for segment_id in ids:
                node.GetSegmentation().RemoveSegment(segment_id)
            if made:
                self._scene.RemoveNode(node)

        try:
            told = replace(mask, doubts=tuple(map(self.as_known, mask.doubts)))
            ids = add_lesion(node, told, tissue, name)
        except SimulationError:
            undo()
            raise
        if files is not None:
            self._lesion_files[_segments_of(node)] = (*files, (tissue, file))
        return node, lambda: undo(ids)

    def restore_lesions(self, lesions_node, files: tuple[tuple[str, str], ...]) -> None:
        """Record the (tissue, file) of all lesions of a node that was restored."""
        self._lesion_files[_segments_of(lesions_node)] = files

    def lesion_files(self, lesions_node) -> tuple[tuple[str, str], ...] | None:
        """(tissue, file) of all lesions; None if they are not all of files."""
        if lesions_node is None:
            return ()
        return self._lesion_files.get(_segments_of(lesions_node))

    def segmented(
        self, labels_node, mri_node, mask_node, options: dict, others: Mapping[str, Any], lesions_node,
        sheets: tuple[str, ...] = (), organs_node=None,
    ) -> None:  # fmt: skip
        """Record the source of labels that Segment made, from these nodes and {contrast: node}, with the lesions.

        `sheets` are the kinds that were looked for. Labels with organs have no source.
        """
        labels_node.SetAttribute(PATIENT, mri_node.GetName())
        file, mask = mri_node.GetAttribute(FILE), None if mask_node is None else _file_of(mask_node)
        self._sources = {}
        additions = self.lesion_files(lesions_node)
        if file is not None and additions is not None and organs_node is None:
            files = {contrast: _file_of(node) for contrast, node in others.items()}
            source = LabelSource(file, mask=mask, options=options, others=files, additions=additions, sheets=sheets)
            self._sources[_voxels_of(labels_node)] = source

    def added(self, source: LabelSource | None, patient: str, labels_node, lesions_node) -> None:
        """Record the source of labels that are those of `source`, of this patient, with the lesions on top."""
        labels_node.SetAttribute(PATIENT, patient)
        additions = self.lesion_files(lesions_node)
        if source is not None and additions is not None:
            self._sources[_voxels_of(labels_node)] = replace(source, additions=additions)

    def restored(self, source: LabelSource | None, labels_node) -> None:
        """Record the source of labels that are those from before Segment again."""
        self._sources = {} if source is None else {_voxels_of(labels_node): source}

    def opened(
        self, source: LabelSource | None, patient: str, labels_node, disc: tuple[float, np.ndarray] | None
    ) -> None:
        """Record the source of labels that are those of `source` with a disc opened; None: with another opening."""
        labels_node.SetAttribute(PATIENT, patient)
        if source is not None and disc is not None:
            self._sources[_voxels_of(labels_node)] = replace(source, disc=disc)

    def forget_patient(self, *new: Any) -> None:
        """Release what is kept of the last patient; `new` are nodes of the next one."""
        self.sent_files.forget(node.GetAttribute(FILE) or "" for node in new if node is not None)
        self._sources, self._lesion_files = {}, {}

    def patient(self) -> str:
        """Name of the patient of the chosen labels, or of the MRI if there are none; "" without either."""
        labels, mri = self._logic.parameters.labels, self._logic.parameters.mri
        if labels is not None:
            return patient_of(labels)
        return "" if mri is None else patient_of(mri)

    def known_source(self, labels_node) -> LabelSource | None:
        """The source of labels; None if it is unknown, or there are no labels."""
        return None if labels_node is None else self._sources.get(_voxels_of(labels_node))

    def source_of(self, labels_node) -> LabelSource:
        """The source of labels. Raises SimulationError if they were not made from files."""
        source = self.known_source(labels_node)
        if source is None:
            name = labels_node.GetName()
            raise SimulationError(f"{name!r} has no source file, expected labels of a file (save, open with --labels)")
        return source

    def sequence(self, record: SequenceRecord):
        """(TrackedImages, sequence browser node, sequence node of the images, all nodes that were made).

        The probe of images that were not prepared yet is that of the preset at the start, if there was one.
        """
        preset, scene, tracked = self._logic.preset, self._scene, record.tracked
        if tracked is None:
            tracked = self._prepared(record, preset.probe, is_known=self._files.preset is not None)
        before = {scene.GetNthNode(number) for number in range(scene.GetNumberOfNodes())}
        browser, images = add_sequence(
            scene, record.sequence, record.name, record.path, record.to_ras, tracked.poses,
            self._logic.parameters.probe_transform,
        )  # fmt: skip
        write_known_field(images, KnownField(tracked.field, np.eye(4) if record.to_ras is None else record.to_ras))
        now = [scene.GetNthNode(number) for number in range(scene.GetNumberOfNodes())]
        return tracked, browser, images, [node for node in now if node not in before]

    def prepared(self, record: SequenceRecord, probe: Probe) -> TrackedImages:
        """The images of a scene in which the probe was this one at last. Raises SimulationError without its field.

        They are of the probe that was kept with them. In a scene of before it is the present one, unless a user has
        changed that so that it does not fit to the images: it is looked for in them then, as when they were opened.
        """
        try:
            return self._prepared(record, probe, is_known=True)
        except Cancelled:
            raise
        except SimulationError as error:
            _log.info("%s: %s; the probe is looked for in the images", record.name, error)
            return self._prepared(record, probe, is_known=False)

    def _prepared(self, record: SequenceRecord, probe: Probe, *, is_known: bool) -> TrackedImages:
        """`probe` is that of the images if it is known, and otherwise that of which the geometry alone is not used."""
        return self._tasks.doAside(
            lambda: TrackedImages.of(
                record.sequence, path=record.path, reference_to_ras=record.to_ras, beam=probe,
                probe=probe if is_known else None, field=record.field,
            )
        )  # fmt: skip

    @contextmanager
    def uploaded_mask(self, name: str, content: bytes) -> Iterator[tuple[Volume, str]]:
        """(volume, name under which it is kept) of a file with a mask uploaded from a page."""
        with self.sent({name: content}) as parcel:
            path = str(parcel.paths[0] if parcel.paths else self._tasks.doAside(lambda: _of_dicom(parcel)))
            volume, file = self.lesion(path)
            self.keep(path)
        yield volume, file

    @contextmanager
    def sent(self, files: Mapping[str, bytes]) -> Iterator[Parcel]:
        """What a page has sent together, {name: content}, which can be opened within the block.

        Errors within the block are about the names of files, as the user knows them. Raises SimulationError for names
        that are no plain names and for headers without their voxels, before anything is written.
        """
        with untrusted_folder() as folder:
            parcel = Parcel(folder, files)
            self._parcels.append(parcel)
            try:
                with self.known_names():
                    yield parcel
            finally:
                for path in parcel.names:
                    for known in (self._volumes, self._read_with, self._kept_names):
                        known.pop(path, None)

    @contextmanager
    def known_names(self) -> Iterator[None]:
        """Errors within the block are about the names of files, as the user knows them."""
        try:
            yield
        except SimulationError as error:
            if isinstance(error, Cancelled):
                raise
            raise SimulationError(self.as_known(str(error))) from None

    def uploads(self, parcel: Parcel) -> tuple[list[Upload], list[str]]:
        """(what the files of a parcel are, in the order in which they can be opened; lines about those that cannot).

        Label maps come with the tables of their labels. Raises SimulationError if there is nothing to open.
        """
        found: dict[Path, Content] = {}
        wrong: list[str] = []
        for path in parcel.paths:
            try:
                found[path] = content = self._tasks.doAside(lambda path=path: content_of(path))
            except SimulationError as error:
                if isinstance(error, Cancelled):
                    raise
                wrong.append(parcel.as_known(str(error)))
                continue
            _log.info("%s: is %s", path.name, content.what)
            if content.volume is not None:
                self._volumes[str(path)] = content.volume
        if not found:
            raise SimulationError("; ".join(wrong) or "no files were sent, expected one or more")
        tables = _tables_of(found)
        parts = {name for content in found.values() for name in content.files[1:]}
        for path, content in found.items():
            self._read_with[str(path)] = tuple(path.with_name(name) for name in content.files[1:])
        uploads = [
            Upload(str(path), content, None if path not in tables else self._table(tables[path]))
            for path, content in found.items()
            if path not in tables.values() and path.name not in parts
        ]
        return sorted(uploads, key=lambda upload: _ORDER.index(upload.kind)), wrong

    def _table(self, path: Path) -> LabelTable:
        if _is_json(path) and _has_tissues_only(path):
            return LabelTable(path.name, TissueTable.read(path))
        return LabelTable(path.name, mapping=LabelMapping.of([str(path)], self._logic.preset.tissues))

    def as_known(self, text: str) -> str:
        """A message with the names of files as the user knows them, without the temporary folder."""
        for parcel in self._parcels:
            text = parcel.as_known(text)
        return text

    def _place(self, path: str) -> str:
        """The path of a file; if a page has sent it, the name under which it is kept."""
        parcel = next((parcel for parcel in self._parcels if path in parcel.names), None)
        if parcel is None:
            return os.path.abspath(path)
        if path not in self._kept_names:
            self._kept_names[path] = self.sent_files.name_for(Path(path), self._read_with.get(path, ()))
        return self._kept_names[path]

    def keep(self, path: str) -> None:
        """Keep a file that a page has sent for scripts, if it was read into a node; it is moved from where it was."""
        if path in self._kept_names:
            self.sent_files.keep(self._kept_names[path], Path(path), self._read_with.get(path, ()))

    def _volume(self, path: str) -> Volume:
        """The volume of a file, read once."""
        return self._volumes.pop(path, None) or self._tasks.doAside(lambda: Volume.read(path))

    def _mask(self, path: str) -> Volume:
        """The same of a mask, with the names of its labels."""
        return with_label_names(self._volume(path), path)

    def _label_map(self, volume: Volume, path: str, names):
        volume = as_whole(volume, path)
        node = self._scene.AddNewNodeByClass("vtkMRMLLabelMapVolumeNode", Path(path).name)
        node.SetAttribute(FILE, self._place(path))
        write_labels(node, volume.with_array(volume.array.astype(np.uint8)), names, node)
        return node


def show_all_tissue(mri_node, volume: Volume) -> None:
    """Choose the grey levels of an MRI; the automatic window saturates bright tissue."""
    display = display_of(mri_node)
    display.SetAutoWindowLevel(False)
    inside = volume.array[volume.array > 0]
    display.SetWindowLevelMinMax(0.0, 1.1 * float(np.percentile(inside, 99.8)) if inside.size else 1.0)


def _is_json(path: Path) -> bool:
    return path.suffix.lower() == ".json"


def _has_tissues_only(path: Path) -> bool:
    """Whether a .json file has the tissues of a label map, as `ussim segment` writes them, and is no preset."""
    values = read_json(path)
    return isinstance(values, dict) and "tissues" in values and not has_probe(values)


def _tables_of(found: dict[Path, Content]) -> dict[Path, Path]:
    """{label map: table of its labels} of what was sent together. Raises SimulationError for tables of nothing."""
    maps = [path for path, content in found.items() if content.kind in (Kind.LABELS, Kind.MASK, Kind.LESIONS)]
    # With a label map, a .json file that is no preset says what its labels are
    tables = [
        path
        for path, content in found.items()
        if content.kind is Kind.TABLE
        or (maps and content.kind is Kind.PRESET and _is_json(path) and not has_probe(read_json(path)))
    ]
    if not tables:
        return {}
    called = ", ".join(path.name for path in tables)
    others = [path.name for path in found if path not in tables]
    if not maps:
        what = "the tissue table" if _is_json(tables[0]) else "a table of the labels"
        require(
            not others,
            f"{', '.join(others)} is no label map, and {called} a table of labels, expected both of a label map; open "
            "it alone",
        )
        require(len(tables) == 1, f"{called}: are tables, expected a label map with one of them")
        raise SimulationError(f"{called} is {what} of a label map: open both files together")
    pairs: dict[Path, Path] = {}
    for table in tables:
        own = [path for path in maps if tissues_beside(path).stem == table.stem] or maps
        require(
            len(own) == 1 and own[0] not in pairs,
            f"{called}: {'are tables' if len(tables) > 1 else 'is a table'} of {len(maps)} label "
            f"map{'s' * (len(maps) > 1)}, expected one for each, called as its label map",
        )
        pairs[own[0]] = table
    return pairs


def _of_dicom(parcel: Parcel) -> Path:
    """The folder of the only series of a parcel."""
    series = parcel.series()
    require(len(series) == 1, f"has {len(series)} DICOM series, expected one of a mask")
    return parcel.take(series[0], series)


def _file_of(node) -> str:
    """The file of a node; for a node without one, that in which a user would save it."""
    return node.GetAttribute(FILE) or f"{node.GetName()}.nrrd"


def _segments_of(lesions_node) -> tuple:
    """A key that changes with the number of segments of a node."""
    return lesions_node.GetID(), lesions_node.GetSegmentation().GetNumberOfSegments()


def _voxels_of(labels_node) -> tuple:
    """A key that changes with the voxels of a label map."""
    image = labels_node.GetImageData() if labels_node.IsA("vtkMRMLVolumeNode") else None
    return labels_node.GetID(), None if image is None else image.GetMTime()


# ---- files of the patient that a page has sent, kept as long as the patient is open, for scripts ---------------------


class SentFiles:
    """Keeps files by name in a temporary folder, which is for this user alone and goes with the program.

    The name of a folder, such as a DICOM series, is that of all files in it. Files that are read together, such as
    probability maps of three tissues, are in a folder, of which the name of one of them means all.
    """

    def __init__(self) -> None:
        self._folder = TemporaryDirectory(prefix="ussim-sent-")
        self._files: dict[str, Path] = {}
        self._number = 0

    @property
    def files(self) -> Mapping[str, Path]:
        """{name: where it is}; names of files in folders have slashes."""
        return dict(self._files)

    def has(self, name: str) -> bool:
        """Whether a file or folder of this name is kept."""
        return bool(self._meant([name]))

    def name_for(self, path: Path, others: Sequence[Path] = ()) -> str:
        """The name under which a file or folder would be kept: its own, or "name (2).nii.gz" beside one called so.

        `others` are read together with it.
        """
        stem, dot, suffix = (path.stem.partition(".")[0], "", "") if others else path.name.partition(".")
        name, number = f"{stem}{dot}{suffix}", 1
        while self._is_another(name, path, others):
            number += 1
            name = f"{stem} ({number}){dot}{suffix}"
        return f"{name}/{path.name}" if others else name

    def keep(self, name: str, path: Path, others: Sequence[Path] = ()) -> None:
        """Keep a file or folder under a name of name_for, with `others`; they are moved from where they were."""
        folder = str(PurePosixPath(name).parent) if others else name
        for part, file in _parts(path, others).items():
            key = f"{folder}/{part}" if part else folder
            if key not in self._files:
                self._number += 1
                place = Path(self._folder.name) / str(self._number)
                shutil.move(file, place)
                self._files[key] = place

    def forget(self, kept: Iterable[str] = ()) -> None:
        """Remove those of the last patient; the names `kept` are of the next one, too."""
        for name in self._files.keys() - self._meant(kept):
            self._files.pop(name).unlink(missing_ok=True)

    def bundle(self, script: str, names: Iterable[str], progress: Callable[[float], None]) -> bytes:
        """A .zip with a script, and the files of these names beside it; `progress` may raise Cancelled."""
        files = {name: self._files[name] for name in sorted(self._meant(names))}
        return zipped(files, progress, {"image.py": script})

    def _meant(self, names: Iterable[str]) -> set[str]:
        """The kept files that names of files and folders mean."""
        wanted = {str(PurePosixPath(name).parent) if "/" in name else name for name in names if name}
        return {name for name in self._files if name in wanted or name.partition("/")[0] in wanted}

    def _is_another(self, name: str, path: Path, others: Sequence[Path]) -> bool:
        """Whether this is the name of other files than these."""
        known = {key: self._files[key] for key in self._meant([name])}
        parts = {f"{name}/{part}" if part else name: file for part, file in _parts(path, others).items()}
        if not known:
            return False
        return known.keys() != parts.keys() or not all(
            filecmp.cmp(known[key], file, shallow=False) for key, file in parts.items()
        )


def _parts(path: Path, others: Sequence[Path]) -> dict[str, Path]:
    """{name below that under which they are kept: file} of a folder, of files that are read together, or of one."""
    if path.is_dir():
        return {file.name: file for file in sorted(path.iterdir())}
    return {file.name: file for file in (path, *others)} if others else {"": path}
