"""SegmentLogic: the tissues of a scene. Segments an MRI or a CT, lays lesions over labels, and opens the skull."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.errors import Cancelled, SimulationError, require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.ct import CtSegmentation
from SlicerUSSim.Logic.mri.ct_unit import settings_for
from SlicerUSSim.Logic.mri.modality import has_brain_mask, segment_image
from SlicerUSSim.Logic.mri.pathology import Added, add_tissues, texture_below
from SlicerUSSim.Logic.mri.segmentation import Segmentation
from SlicerUSSim.Logic.mri.segmentation_settings import CT, SegmentationSettings
from SlicerUSSim.Logic.mri.sheets.finding import find_sheets, require_findable
from SlicerUSSim.Logic.mrml.craniotomy_nodes import closed_labels, is_opened, opening_of, set_closed_labels, show_flap
from SlicerUSSim.Logic.mrml.grown_nodes import LesionGrowth
from SlicerUSSim.Logic.mrml.label_nodes import LABEL_CLASSES, labels_version, read_labels, read_mask, write_labels
from SlicerUSSim.Logic.mrml.lesion_nodes import Told, padded_for, read_lesions, with_lesions
from SlicerUSSim.Logic.mrml.live import LiveLogic
from SlicerUSSim.Logic.mrml.nodes import (
    named,
    node_to_world,
    nodes_of_class,
    pose_in_labels,
    probe_pose,
    read_volume,
    require_node,
)
from SlicerUSSim.Logic.mrml.own_results import mark_as_made, may_replace, require_result
from SlicerUSSim.Logic.mrml.patient_logic import KnownLabels, PatientLogic
from SlicerUSSim.Logic.mrml.share_nodes import read_shares, write_shares
from SlicerUSSim.Logic.mrml.sheet_nodes import write_sheets
from SlicerUSSim.Logic.mrml.taken_image import MRI, PATIENT, mri_of, patient_of
from SlicerUSSim.Logic.placement.craniotomy import disc_diameter_mm, disc_opening, opened
from SlicerUSSim.Logic.tissue.label_maps import LabelledTissues
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tissue.texture import Texture

#: Attribute of a mask node that was extracted
_BRAIN_OF = "SlicerUSSim.brainOf"
#: Share of the time in which tissues are segmented, if a search for sheets follows
_SEGMENTED = 0.4


class SegmentLogic:
    """Labels of a patient, written into unedited nodes of this module."""

    def __init__(self, patient: PatientLogic, live: LiveLogic) -> None:
        self._patient, self._live, self._work = patient, live, patient.work
        self.forget()

    def forget(self) -> None:
        """Release what is kept in memory of the last patient."""
        #: Version of the labels over which lesions were laid last, and what was reported about each of them
        self._laid: tuple[Hashable, Told] = (None, {})
        #: Grows lesions on the MRI that was segmented last
        self.growth = LesionGrowth(self._work.do)
        #: What the last segment(), addTissues() or openCraniotomy() did, and what to check, one line each
        self.notes: tuple[str, ...] = ()
        self.warnings: tuple[str, ...] = ()

    def segment(
        self, mri_node, labels_node, settings: SegmentationSettings | None = None, *, mask_node=None,
        others: Mapping[str, Any] | None = None, organs_node=None, lesions_node=None, sheets: Iterable[str] = (),
        sheets_node=None, overwrite: bool = False, keep_mask_at: Path | None = None,
        keep_sheets_at: Path | None = None, progress: Callable[[float], None] | None = None, **values: Any,
    ) -> Segmentation | CtSegmentation:  # fmt: skip
        """Label the tissues of a scalar volume into a label map or segmentation node, with names and colours.

        See segmentation.segment_mri, and ct.segment_ct for the contrast "ct"; `values` change single ones of the
        settings. `mask_node` is a label map on the MRI's grid, or a segmentation; `others` are volume nodes of the same
        patient by their contrast. The segments of `lesions_node` are laid over the labels, as by addTissues, but are
        not in the result. `organs_node` is a label map or segmentation of organs of a CT. `sheets` are found, too
        (sheets.find_sheets): those with a volume are laid over the labels, the others are written into the model
        `sheets_node`, which images show if it is the parameter `sheets`. `progress` may raise errors.Cancelled; the
        nodes are then as they were.
        Raises SimulationError for a node with labels that were not made by this method, or edited since; `overwrite`
        replaces them nevertheless.
        """
        require_node(labels_node, *LABEL_CLASSES, use="output of Segment")
        require(labels_node is not mri_node, f"input and output are both {named(mri_node)}, expected different nodes")
        mri = read_volume(mri_node, "MRI")
        settings, line = settings_for(mri, SegmentationSettings.of(settings, **values))
        contrast, is_of_brain = settings.contrast, has_brain_mask(settings.contrast)
        mask = None if mask_node is None else read_mask(mask_node, mri_node)
        require(
            mask_node is not labels_node, f"mask and output are both {named(labels_node)}, expected different nodes"
        )
        if not overwrite:
            self._require_replaceable(labels_node)
        volumes = {contrast: _in_frame_of(node, mri_node) for contrast, node in (others or {}).items()}
        lesions, skipped = ([], []) if lesions_node is None else read_lesions(lesions_node, mri_node, self._tissues)
        wanted = tuple(sheets)
        if wanted:
            require_findable(wanted, contrast)
            require_node(sheets_node, "vtkMRMLModelNode", use="sheets")
            require_result(sheets_node, "sheets")
        organs = None if organs_node is None else self._organs(organs_node, mri_node, contrast)
        report = progress or (lambda share: None)
        until = _SEGMENTED if wanted else 1.0
        own = self._own_tissues()
        result = self._work.do(
            lambda: segment_image(
                mri, settings=settings, others=volumes, mask=mask, organs=organs, keep_mask_at=keep_mask_at,
                device=self._patient.device, progress=lambda share: report(until * share),
            )
        )  # fmt: skip
        labels, names, found = result.labels, result.tissue_names, None
        if wanted and isinstance(result, Segmentation):
            segmentation = result
            found = self._work.do(
                lambda: find_sheets(
                    mri, segmentation, contrast=contrast, kinds=wanted, keep_at=keep_sheets_at,
                    progress=lambda share: report(until + (1.0 - until) * share),
                )
            )  # fmt: skip
            masks = found.masks()
            if masks:
                laid = self._work.do(lambda: add_tissues(labels, names, masks, has_brain_mask=True))
                labels, names = laid.labels, laid.tissue_names
        lay = partial(with_lesions, labels, names, also=own, before={}, has_brain_mask=is_of_brain)
        try:
            added, told = self._work.do(lambda: lay(lesions))
        except Cancelled:
            raise
        except SimulationError as error:  # the segmentation is kept: it took much longer
            added, told = lay([])
            skipped = [*skipped, f"no lesion was added: {error}"]
        shares = self._work.do(lambda: texture_below(result.texture(), mri, result.labels, added.labels))
        require_node(labels_node, *LABEL_CLASSES, use="output of Segment")
        self._write(labels_node, added, mri_node, shares)
        self._note_laid(labels_node, added, told, labels)
        self._patient.segmented = KnownLabels(
            labels_version(labels_node), added.labels, added.tissue_names, shares, mri, is_of_brain
        )
        if isinstance(result, Segmentation):  # lesions are grown on MRIs only
            self.growth.segmented(mri_node, result)
        if found is not None:
            write_sheets(sheets_node, found.surfels, mri_node)
        sheet_notes = () if found is None else found.notes
        recognised = () if line is None else (line,)
        self.notes = (*recognised, *result.notes, *sheet_notes, _shares(added), *added.messages)
        self.warnings = (*result.warnings, *skipped, *added.warnings)
        return result

    def writeBrain(self, result: Segmentation, mri_node):
        """The label map node "NAME brain" with the mask that segment() extracted from a whole head.

        It is used again until a user edits it; then another node is made.
        """
        scene, name = self._patient.scene, f"{mri_node.GetName()} brain"
        known = nodes_of_class(scene, "vtkMRMLLabelMapVolumeNode")
        node = next((one for one in known if self.isBrainOf(one, mri_node) and may_replace(one)), None)
        if node is None:
            node = scene.AddNewNodeByClass("vtkMRMLLabelMapVolumeNode", scene.GenerateUniqueName(name))
        write_labels(node, result.brain.mask, ("brain",), mri_node)
        node.SetAttribute(_BRAIN_OF, "1")
        node.SetNodeReferenceID(MRI, mri_node.GetID())
        mark_as_made(node)
        return node

    def isOwnBrain(self, mask_node) -> bool:
        """Whether writeBrain wrote a mask, and no user has edited it."""
        return self.isBrainOf(mask_node, None) is not None and may_replace(mask_node)

    def isBrainOf(self, mask_node, mri_node) -> bool | None:
        """Whether writeBrain's mask, edited since or not, is from this MRI node; None for other masks."""
        if mask_node is None or mask_node.GetAttribute(_BRAIN_OF) is None:
            return None
        return mri_of(mask_node) is mri_node

    def mayReplace(self, labels_node) -> bool:
        """Whether segment() may write into a node: if it is empty, or has unedited labels by segment()."""
        require_node(labels_node, *LABEL_CLASSES, use="output of Segment")
        return may_replace(labels_node)

    def addTissues(self, labels_node, lesions_node, output_node=None) -> Added:
        """Lay the segments of a segmentation node over the tissues of a label map or segmentation node.

        Segments are called as tissues: tumour, oedema, necrosis, cyst, haematoma, cavity, or others of the preset and
        the presets; the last is on top. The result is written into `output_node`, by default into `labels_node` itself,
        which must then be made by segment() and not be edited since. `notes` and `warnings` tell what was done; of a
        lesion that the labels already have, what it was laid over at first.
        Raises SimulationError if no segment is called as a tissue, and for one that is not a lesion of this patient
        (see pathology.add_tissue); nothing is changed then.
        """
        output = labels_node if output_node is None else output_node
        require_node(output, *LABEL_CLASSES, use="output of Add to tissues")
        self._require_replaceable(output)
        require(lesions_node is not output, f"lesions and output are both {named(output)}, expected different nodes")
        was = self._known(labels_node)
        lesions, skipped = read_lesions(lesions_node, labels_node, self._tissues)
        labels = was.labels
        if labels_node.IsA("vtkMRMLSegmentationNode"):
            labels = padded_for(lesions, labels)  # it is cropped to what it holds
        before = self._laid[1] if self._laid[0] == was.version else {}
        own, is_of_brain = self._own_tissues(), was.is_of_brain
        added, told = self._work.do(
            lambda: with_lesions(labels, was.names, lesions, also=own, before=before, has_brain_mask=is_of_brain)
        )
        stays = is_opened(output)
        texture = self._texture_of(was, added.labels) if labels is was.labels else None
        self._write(output, added, labels_node, texture)
        self._note_laid(output, added, told, labels)
        if texture is not None and was is self._patient.segmented:
            self._patient.segmented = replace(
                was, version=labels_version(output), labels=added.labels, names=added.tissue_names, texture=texture
            )
        self.notes, self.warnings = added.messages, (*skipped, *added.warnings)
        if stays:
            self.warnings += (f"the opening of {named(output)} can no longer be closed or moved; for that, add the "
                              "lesions to the labels before it, and open those",)  # fmt: skip
        return added

    def openCraniotomy(
        self, labels_node, output_node, *, probe_transform_node=None, opening_node=None,
        diameter_mm: float | None = None,
    ) -> float:  # fmt: skip
        """Open skin, scalp and skull over the brain for the beam; returns how many ml were removed.

        The opening is a disc under the probe of `diameter_mm` (default: as wide as its face needs), or what
        `opening_node` says: the polygon of a markups node, such as a closed curve, or a label map or segmentation. The
        labels (a label map or segmentation with skin and skull, as Segment makes with `outside`) with the opening,
        filled with the coupling medium, are written into `output_node`; the labels do not change. Opened labels are
        opened again from the closed ones (closedLabels). A model shows the piece that was removed.
        Raises SimulationError, and changes nothing, if that removes nothing or there is no brain under it, and for an
        output with labels that this module did not make, or edited since.
        """
        closed = self.closedLabels(labels_node)
        require_node(output_node, *LABEL_CLASSES, use="output of Open skull")
        require(closed is not output_node, f"labels and output are both {named(closed)}, expected different nodes")
        require(
            opening_node is None or opening_node not in (closed, labels_node, output_node),
            f"opening is {named(opening_node)}, the labels themselves, expected a node with the opening alone",
        )
        was_edited = closed is not labels_node and not may_replace(labels_node)
        self._require_replaceable(output_node, by="this module")
        was = self._known(closed)
        labels, names = was.labels, was.names
        world_to_labels, scaling = pose_in_labels(closed, np.eye(4))
        placed = Volume(labels.array, scaling @ labels.ijk_to_ras)
        left_out: tuple[str, ...] = ()
        if opening_node is not None:
            opening, what, left_out = self._work.do(lambda: opening_of(opening_node, placed, names, world_to_labels))
        else:
            pose, probe = world_to_labels @ probe_pose(probe_transform_node), self._patient.parameters.preset.probe
            diameter = disc_diameter_mm(probe) if diameter_mm is None else diameter_mm
            opening = self._work.do(lambda: disc_opening(placed, names, pose, diameter))
            what = f"a disc of {diameter:.0f} mm under the probe"
        result, millilitres = self._work.do(lambda: opened(placed, names, opening))
        with_opening = labels.with_array(result.array)
        self._write(output_node, Added(with_opening, names), closed, self._texture_of(was, with_opening))
        set_closed_labels(output_node, closed)
        show_flap(output_node, labels.with_array(result.array != labels.array))
        self.notes = (
            f"craniotomy: {what}; {millilitres:.1f} ml of skin, scalp and skull are replaced by the coupling medium in "
            f"{named(output_node)}, and {named(closed)} is not changed",
        )
        self.warnings = left_out
        if was_edited:
            self.warnings += (
                f"what was edited in {named(labels_node)} is not in {named(output_node)}, which is {named(closed)} "
                "with the opening",
            )
        return millilitres

    def closedLabels(self, labels_node):
        """The labels from which openCraniotomy made these; other labels are returned themselves."""
        require_node(labels_node, *LABEL_CLASSES, use="label map")
        return closed_labels(labels_node)

    def _require_replaceable(self, labels_node, by: str = "Segment") -> None:
        require(
            may_replace(labels_node),
            f"{named(labels_node)} was not made by {by}, or edited since, and is not replaced; choose another node",
        )

    @property
    def _tissues(self) -> TissueTable:
        return self._patient.parameters.preset.tissues

    def _own_tissues(self) -> list[str]:
        return [tissue.name for tissue in self._tissues.all_tissues()]

    def _known(self, labels_node) -> KnownLabels:
        """What Segment wrote into a node last, or what is read from it."""
        segmented, version = self._patient.segmented, labels_version(labels_node)
        if segmented is not None and segmented.version == version:
            return segmented
        found = read_labels(labels_node, self._tissues)
        labels, names = found.labels, found.names
        without_mri = labels.with_array(np.zeros(labels.array.shape, np.float32))
        return KnownLabels(version, labels, names, read_shares(labels_node, labels, names), without_mri, False)

    def _texture_of(self, known: KnownLabels, labels: Volume) -> Texture | None:
        """The texture below other labels on the same grid; None where there is none."""
        texture = known.texture
        if texture is None:
            return None
        return self._work.do(lambda: texture_below(texture, known.mri, known.labels, labels))

    def _organs(self, organs_node, mri_node, contrast: str) -> LabelledTissues:
        """The organs of a CT in its own frame. Raises SimulationError beside an MRI."""
        require(
            contrast == CT,
            f"{named(organs_node)} has organs of a CT, and the contrast is {contrast}; choose ct, or no organs",
        )
        require_node(organs_node, *LABEL_CLASSES, use="organs")
        to_mri = np.linalg.inv(node_to_world(mri_node)) @ node_to_world(organs_node)
        found = read_labels(organs_node, self._tissues, of_ct=True)
        return replace(found, labels=Volume(found.labels.array, to_mri @ found.labels.ijk_to_ras))

    def _write(self, labels_node, added: Added, like_node, texture: Texture | None) -> None:
        """Write labels and what is known of their shares."""
        write_labels(labels_node, added.labels, added.tissue_names, like_node)
        mark_as_made(labels_node)
        labels_node.SetAttribute(PATIENT, patient_of(like_node))
        mri = mri_of(like_node) if any(map(like_node.IsA, LABEL_CLASSES)) else like_node
        labels_node.SetNodeReferenceID(MRI, None if mri is None else mri.GetID())
        set_closed_labels(labels_node, None)
        if texture is not None:
            write_shares(labels_node, added.labels, added.tissue_names, texture)
            self._live.request()  # it may have seen the labels without them

    def _note_laid(self, labels_node, added: Added, told: Told, before: Volume) -> None:
        version = labels_version(labels_node)
        self._laid, self._patient.lesion_place = (version, told), (version, added.centre_ras(before))


def _shares(found: Added) -> str:
    """How much of the labels each tissue is, the largest first."""
    counts = np.bincount(found.labels.array.ravel(), minlength=len(found.tissue_names) + 1)[1:]
    order = [n for n in np.argsort(-counts, kind="stable") if counts[n]]
    return ", ".join(f"{found.tissue_names[n]} {counts[n] / counts.sum():.0%}" for n in order)


def _in_frame_of(volume_node, node) -> Volume:
    """A volume in the own frame of another node, before its parent transform."""
    volume = read_volume(volume_node, "second MRI")
    return Volume(volume.array, np.linalg.inv(node_to_world(node)) @ node_to_world(volume_node) @ volume.ijk_to_ras)
