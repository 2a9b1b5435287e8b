"""UltrasoundSceneLogic: the simulator on the nodes of a MRML scene, in 3D Slicer or without it."""

from __future__ import annotations

import json
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, collected_warnings, require, required, warn_again
from SlicerUSSim.Logic.base.settings import SimulationSettings
from SlicerUSSim.Logic.base.transforms import check_rigid
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.base.vtk_data import matrix_array
from SlicerUSSim.Logic.fitting.adopted import taken_back, with_fit
from SlicerUSSim.Logic.fitting.fit_settings import FitSettings
from SlicerUSSim.Logic.fitting.held_out import predict
from SlicerUSSim.Logic.fitting.search import Progress
from SlicerUSSim.Logic.fitting.tracked_fit import Fit, fit
from SlicerUSSim.Logic.imaging.contact import about_contact
from SlicerUSSim.Logic.imaging.found_sheets import with_their_tissue
from SlicerUSSim.Logic.imaging.frame import Frame
from SlicerUSSim.Logic.imaging.noise import seed_of_pose
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.imaging.reuse import ReusedSimulator
from SlicerUSSim.Logic.imaging.simulator import EmptyViewWarning, UltrasoundSimulator
from SlicerUSSim.Logic.mri.addable import require_addable
from SlicerUSSim.Logic.mri.ct import CtSegmentation
from SlicerUSSim.Logic.mri.modality import has_brain_mask, segment_image
from SlicerUSSim.Logic.mri.pathology import Added, add_tissues, texture_below
from SlicerUSSim.Logic.mri.segmentation import Segmentation
from SlicerUSSim.Logic.mri.segmentation_settings import CT, GEL_MM, SegmentationSettings
from SlicerUSSim.Logic.mri.sheets.finding import find_sheets, require_findable
from SlicerUSSim.Logic.mrml.craniotomy_nodes import (
    closed_labels,
    flap_centre,
    hide_flap,
    is_opened,
    opening_of,
    set_closed_labels,
    show_flap,
)
from SlicerUSSim.Logic.mrml.fit_nodes import CostPlot, neighbours_in, tracked_images, write_compared
from SlicerUSSim.Logic.mrml.label_nodes import (
    LABEL_CLASSES,
    Patient,
    PatientReader,
    hidden_segments,
    labels_version,
    node_labels,
    read_labels,
    read_mask,
    write_labels,
)
from SlicerUSSim.Logic.mrml.lesion_nodes import padded_for, place_of, read_lesions
from SlicerUSSim.Logic.mrml.live import LiveNodes, LiveUpdate
from SlicerUSSim.Logic.mrml.nodes import (
    named,
    node_to_world,
    nodes_of_class,
    pose_in_labels,
    probe_pose,
    read_volume,
    require_node,
    set_node_to_world,
    show_in_slice,
    write_image,
    write_outline,
    write_slice,
)
from SlicerUSSim.Logic.mrml.own_labels import mark_as_made, may_replace
from SlicerUSSim.Logic.mrml.own_results import (
    IMAGE,
    OUTLINE,
    REGISTRATION,
    mark_as_result,
    may_replace_result,
    require_result,
)
from SlicerUSSim.Logic.mrml.parameter_node import SceneParameters
from SlicerUSSim.Logic.mrml.proposal_nodes import LesionProposals
from SlicerUSSim.Logic.mrml.sequence_nodes import SequenceIndex
from SlicerUSSim.Logic.mrml.share_nodes import read_shares, shares_version, write_shares
from SlicerUSSim.Logic.mrml.sheet_nodes import read_sheets, sheets_version, write_sheets
from SlicerUSSim.Logic.mrml.taken_image import (
    PATIENT,
    TakenImage,
    follow,
    freeze,
    patient_of,
    remove_image,
    write_about,
)
from SlicerUSSim.Logic.mrml.taken_sequence import FrozenRecord, in_node, read_taken, taken_of, write_taken
from SlicerUSSim.Logic.placement.aiming import opening_pose
from SlicerUSSim.Logic.placement.bone_before_probe import SCENE, about_bone
from SlicerUSSim.Logic.placement.craniotomy import default_pose, disc_diameter_mm, disc_opening, opened
from SlicerUSSim.Logic.placement.views import opened_view_pose, view_pose
from SlicerUSSim.Logic.probe.poses import pose_in_slice
from SlicerUSSim.Logic.tissue.label_maps import LabelledTissues
from SlicerUSSim.Logic.tissue.surfels import Surfels
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tissue.texture import Texture

T = TypeVar("T")
#: Attribute of a mask node: the ID of the MRI node from which it was extracted
_BRAIN_OF = "SlicerUSSim.brainOf"
#: Share of the time in which tissues are segmented, if sheets are looked for after that
_SEGMENTED = 0.4


class AtOnce:
    """Runs work immediately. In a program with an event loop, a class with the same methods can run it in a thread, and
    process events and other calls of the logic's methods until it is done."""

    def do(self, function: Callable[[], T]) -> T:
        """The result of `function`, which is slow and does not access nodes. Calls are sequential."""
        return function()

    def doAside(self, function: Callable[[], T]) -> T:
        """The same of a function that needs no device, such as reading a file, for which images need not wait."""
        return function()

    def tell(self, function: Callable[[], None]) -> None:
        """From within do(): call `function`, which accesses nodes, as soon as possible."""
        function()


@dataclass(frozen=True, eq=False)
class _Segmented:
    """Labels of a node that Segment wrote, and the texture of their MRI."""

    #: Of the node, see labels_version
    version: Hashable
    labels: Volume
    #: Of labels 1, 2, ...
    names: tuple[str, ...]
    #: With that of their MRI
    texture: Texture
    #: On the grid of the labels
    mri: Volume
    #: Whether the labels are within a brain mask
    is_of_brain: bool


#: {lesion, see lesion_nodes.place_of: (messages, warnings) when it was laid over labels that did not have it}
_Told = dict[Hashable, tuple[tuple[str, ...], tuple[str, ...]]]


class UltrasoundSceneLogic:
    """Simulates on the nodes of one scene.

    The choices (`preset`, and the nodes of the module) are saved in the scene, see parameter_node. All methods raise
    SimulationError for a node that is missing, empty, of the wrong kind or under a transform that is not linear.

    Parameters
    ----------
    scene : vtkMRMLScene.
    device : see opencl.devices.choose_device.
    work : runs slow functions that do not access nodes.
    """

    def __init__(self, scene, device: str | None = None, work: AtOnce | None = None) -> None:
        self.scene = scene
        self.device = device
        self._work = work or AtOnce()
        self.parameters = SceneParameters(scene)
        self._simulators = ReusedSimulator()
        self._patients = PatientReader()
        self._segmented: _Segmented | None = None
        #: Version of the labels over which lesions were laid last, and what was told about each of them
        self._laid: tuple[Hashable, _Told] = (None, {})
        # (labels_version, (3,) mm in their frame) of the largest lesion that was laid over labels
        self._lesion_place: tuple[Hashable, np.ndarray | None] = (None, None)
        #: Lesions proposed from the MRI that was segmented last
        self.proposals = LesionProposals(scene, lambda work: self._work.do(work))
        #: What the last segment() or addTissues() did, and what a user should check, one line each
        self.notes: tuple[str, ...] = ()
        self.warnings: tuple[str, ...] = ()
        self._sheets: tuple[Hashable, Surfels] | None = None  # with the version of their node, kinds and frame
        self._texture: tuple[Hashable, Texture | None] | None = None  # with the version of its labels
        self._preset: tuple[str, Preset] = ("", Preset())
        self._live: LiveUpdate | None = None
        self._taken: TakenImage | None = None
        #: ID of the last simulated sequence, and what its images show of the patient
        self._in_sequence: tuple[str, Hashable] = ("", None)

    # ---- choices -------------------------------------------------------------------------------------------

    @property
    def preset(self) -> Preset:
        """Probe, display, settings and tissues; saved in the scene. Raises SimulationError if the scene's preset is
        invalid."""
        text = self.parameters.preset
        if text != self._preset[0]:
            self._preset = (text, self.presetOf(text))
        return self._preset[1]

    @staticmethod
    def presetOf(text: str) -> Preset:
        """The preset of a scene's text. Raises SimulationError for one that is invalid."""
        try:
            values = json.loads(text or "{}")
        except ValueError as error:
            raise SimulationError(f"the scene's preset is not JSON ({error})") from None
        return Preset.from_dict(values, "the scene's preset")

    @preset.setter
    def preset(self, preset: Preset) -> None:
        text = json.dumps(preset.to_dict())
        self._preset = (text, preset)
        self.parameters.preset = text

    def tissues(self, labels_node) -> TissueTable:
        """The tissues of a label map or segmentation by name, from the preset's table or else the tissue presets.

        With that of falx and tentorium, if images show such sheets.
        """
        try:
            sheets = self._sheets_of(labels_node)
        except SimulationError:  # what is chosen has no sheets, which an image will tell
            sheets = None
        return _tissues_of(self.preset, self._patient(labels_node).names, sheets)

    def settings(self, labels_node) -> SimulationSettings:
        """The preset's settings, with gel between skin and probe (GEL_MM) where labels have skin and nobody says more.

        That is: no contact gap, the parameter `gel`, and no opening, which is filled with the coupling medium.
        """
        settings = self.preset.settings
        is_default = settings.contact_gap_mm is None and self.parameters.panel.gel and not is_opened(labels_node)
        if is_default and "skin" in self._patient(labels_node).names:
            return replace(settings, contact_gap_mm=GEL_MM)
        return settings

    def _effective_preset(self, labels_node) -> Preset:
        """The preset with the settings that images of these labels have."""
        return replace(self.preset, settings=self.settings(labels_node))

    # ---- single steps ------------------------------------------------------------------------------------------------

    def segment(
        self,
        mri_node,
        labels_node,
        *,
        mask_node=None,
        others: Mapping[str, Any] | None = None,
        organs_node=None,
        lesions_node=None,
        sheets: Iterable[str] = (),
        sheets_node=None,
        overwrite: bool = False,
        keep_mask_at: Path | None = None,
        keep_sheets_at: Path | None = None,
        classes: int | None = SegmentationSettings.classes,
        contrast: str = SegmentationSettings.contrast,
        filter_radius: int = SegmentationSettings.filter_radius,
        filter_epsilon: float | None = SegmentationSettings.filter_epsilon,
        bias_correction: bool | None = SegmentationSettings.bias_correction,
        thin_sulci: bool = SegmentationSettings.thin_sulci,
        outside: bool = SegmentationSettings.outside,
        skull_strip: str = SegmentationSettings.skull_strip,
        progress: Callable[[float], None] | None = None,
    ) -> Segmentation | CtSegmentation:
        """Label the tissues of a scalar volume into a label map or segmentation node, with names and colours.

        See segmentation.segment_mri, and ct.segment_ct for the contrast "ct". `mask_node` is a label map on the MRI's
        grid, or a segmentation; `others` are volume nodes of the same patient by their contrast. The segments of
        `lesions_node` are laid over the labels, as by addTissues, but are not in the result. `organs_node` is a label
        map or segmentation of organs of a CT. `sheets` are looked for, too (sheets.find_sheets): those with a volume
        are laid over the labels, the others are written into the model `sheets_node`, which images show if it is the
        parameter `sheets`. `progress` may raise errors.Cancelled; the nodes are then as they were.
        Raises SimulationError for a node with labels that were not made by this method, or edited since; `overwrite`
        replaces them nevertheless.
        """
        require_node(labels_node, *LABEL_CLASSES, use="output of Segment")
        require(labels_node is not mri_node, f"input and output are both {named(mri_node)}, expected different nodes")
        mri = read_volume(mri_node, "MRI")
        mask = None if mask_node is None else read_mask(mask_node, mri_node)
        require(
            mask_node is not labels_node, f"mask and output are both {named(labels_node)}, expected different nodes"
        )
        require(
            overwrite or self.mayReplace(labels_node),
            f"{named(labels_node)} was not made by Segment, or edited since, and is not replaced; choose another node",
        )
        volumes = {contrast: _in_frame_of(node, mri_node) for contrast, node in (others or {}).items()}
        lesions, skipped = ([], []) if lesions_node is None else self._lesions(lesions_node, mri_node)
        own = [tissue.name for tissue in self.preset.tissues.all_tissues()]
        is_of_brain = has_brain_mask(contrast)
        wanted = tuple(sheets)
        if wanted:
            require_findable(wanted, contrast)
            require_node(sheets_node, "vtkMRMLModelNode", use="sheets")
            require_result(sheets_node, "sheets")
        organs = None if organs_node is None else self._organs(organs_node, mri_node, contrast)
        report = progress or (lambda share: None)
        until = _SEGMENTED if wanted else 1.0
        extraction = skull_strip if is_of_brain else "none"
        self._work.do(lambda: require_addable(mri, lesions, mask=mask, skull_strip=extraction, also=own))
        result = self._work.do(
            lambda: segment_image(
                mri, classes=classes, contrast=contrast, others=volumes, mask=mask, organs=organs,
                filter_radius=filter_radius, filter_epsilon=filter_epsilon, bias_correction=bias_correction,
                thin_sulci=thin_sulci, outside=outside, skull_strip=skull_strip,
                keep_mask_at=keep_mask_at, device=self.device,
                progress=lambda share: report(until * share),
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
        added, told = self._with_lesions(labels, names, lesions, has_brain_mask=is_of_brain)
        shares = self._work.do(lambda: texture_below(result.texture(), mri, result.labels, added.labels))
        require_node(labels_node, *LABEL_CLASSES, use="output of Segment")
        self._write_tissues(labels_node, added, mri_node, shares)
        self._laid = labels_version(labels_node), told
        self._lesion_place = labels_version(labels_node), added.centre_ras(labels)
        if isinstance(result, Segmentation):  # lesions are proposed on MRIs only
            self.proposals.segmented(mri_node, result)
        self._segmented = _Segmented(
            labels_version(labels_node), added.labels, added.tissue_names, shares, mri, is_of_brain
        )
        if found is not None:
            write_sheets(sheets_node, found.surfels, mri_node)
        sheet_notes = () if found is None else found.notes
        self.notes = (*result.notes, *sheet_notes, *result.table().splitlines(), *added.messages)
        self.warnings = (*result.warnings, *skipped, *added.warnings)
        return result

    def writeBrain(self, result: Segmentation, mri_node):
        """The label map node "NAME brain" with the mask that segment() extracted from a whole head.

        It is used again as long as nobody has edited it; otherwise another node is made.
        """
        name = f"{mri_node.GetName()} brain"
        known = nodes_of_class(self.scene, "vtkMRMLLabelMapVolumeNode")
        node = next(
            (one for one in known if one.GetAttribute(_BRAIN_OF) == mri_node.GetID() and may_replace(one)), None
        )
        if node is None:
            node = self.scene.AddNewNodeByClass("vtkMRMLLabelMapVolumeNode", self.scene.GenerateUniqueName(name))
        write_labels(node, result.brain.mask, ("brain",), mri_node)
        node.SetAttribute(_BRAIN_OF, mri_node.GetID())
        mark_as_made(node)
        return node

    def isOwnBrain(self, mask_node) -> bool:
        """Whether a mask is one that writeBrain wrote, and nobody has edited it."""
        return self.brainOf(mask_node) is not None and may_replace(mask_node)

    def brainOf(self, mask_node) -> str | None:
        """The ID of the MRI node from which writeBrain's mask is, whether edited or not; None for other masks."""
        return None if mask_node is None else mask_node.GetAttribute(_BRAIN_OF)

    def mayReplace(self, labels_node) -> bool:
        """Whether segment() may write into a node: if it is empty, or has what segment() wrote and nobody edited."""
        require_node(labels_node, *LABEL_CLASSES, use="output of Segment")
        return may_replace(labels_node)

    def mayReplaceResult(self, node) -> bool:
        """Whether simulate(), showOutline() and others may write into a node: if it is empty, or has their result."""
        return may_replace_result(node)

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
        require(
            self.mayReplace(output),
            f"{named(output)} was not made by Segment, or edited since, and is not replaced; choose another node",
        )
        require(lesions_node is not output, f"lesions and output are both {named(output)}, expected different nodes")
        was = self._segmented
        if was is not None and was.version == labels_version(labels_node):
            labels, names = was.labels, was.names
        else:
            was, labelled = None, read_labels(labels_node, self.preset.tissues)
            labels, names = labelled.labels, labelled.names
        whole, known = labels, read_shares(labels_node, labels, names) if was is None else was.texture
        lesions, skipped = self._lesions(lesions_node, labels_node)
        if labels_node.IsA("vtkMRMLSegmentationNode"):
            labels = padded_for(lesions, labels)  # it is cropped to what it holds
        before = self._laid[1] if self._laid[0] == labels_version(labels_node) else {}
        added, told = self._with_lesions(
            labels, names, lesions, before, has_brain_mask=was is not None and was.is_of_brain
        )
        stays = is_opened(output)
        texture = None
        if known is not None and labels is whole:
            # Without the MRI, deviations are 0 as in what was read from the node
            mri = whole.with_array(np.zeros(whole.array.shape, np.float32)) if was is None else was.mri
            texture = self._work.do(lambda: texture_below(known, mri, whole, added.labels))
        self._write_tissues(output, added, labels_node, texture)
        self._laid = labels_version(output), told
        self._lesion_place = labels_version(output), added.centre_ras(labels)
        if texture is not None and was is not None:
            self._segmented = _Segmented(
                labels_version(output), added.labels, added.tissue_names, texture, was.mri, was.is_of_brain
            )
        self.notes, self.warnings = added.messages, (*skipped, *added.warnings)
        if stays:
            self.warnings += (f"the opening of {named(output)} can no longer be closed or moved; for that, add the "
                              "lesions to the labels before it, and open those",)  # fmt: skip
        return added

    def openCraniotomy(
        self,
        labels_node,
        output_node,
        *,
        probe_transform_node=None,
        opening_node=None,
        diameter_mm: float | None = None,
    ) -> float:
        """Open skin, scalp and skull over the brain for the beam; returns how many ml were removed.

        The opening is a disc under the probe of `diameter_mm` (default: as wide as its face needs), or what
        `opening_node` says: the polygon of a markups node, such as a closed curve, or a label map or segmentation. The
        labels (a label map or segmentation with skin and skull, as Segment makes with `outside`) with the opening,
        filled with the coupling medium, are written into `output_node`; the labels stay as they are. Opened labels are
        opened anew from those before (closedLabels). A model shows the piece that was removed.
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
        is_left_out = closed is not labels_node and not self.mayReplace(labels_node)
        require(
            self.mayReplace(output_node),
            f"{named(output_node)} was not made by this module, or edited since, and is not replaced; choose another "
            "node",
        )
        was = self._segmented
        if was is not None and was.version == labels_version(closed):
            labels, names = was.labels, was.names
        else:
            labelled = read_labels(closed, self.preset.tissues)
            was, labels, names = None, labelled.labels, labelled.names
        known = read_shares(closed, labels, names) if was is None else was.texture
        world_to_labels, scaling = pose_in_labels(closed, np.eye(4))
        placed = Volume(labels.array, scaling @ labels.ijk_to_ras)
        hidden: dict[str, str] = {}
        if opening_node is not None:
            opening = self._work.do(lambda: opening_of(opening_node, placed, names, world_to_labels))
            what = named(opening_node)
            if opening_node.IsA("vtkMRMLSegmentationNode"):
                hidden = hidden_segments(opening_node)
                what += f" with {', '.join(node_labels(opening_node, hidden)[1].values())}"
        else:
            pose, probe = world_to_labels @ probe_pose(probe_transform_node), self.preset.probe
            diameter = disc_diameter_mm(probe) if diameter_mm is None else diameter_mm
            opening = self._work.do(lambda: disc_opening(placed, names, pose, diameter))
            what = f"a disc of {diameter:.0f} mm under the probe"
        result, millilitres = self._work.do(lambda: opened(placed, names, opening))
        found = labels.with_array(result.array)
        texture = None
        if known is not None:
            mri = labels.with_array(np.zeros(labels.array.shape, np.float32)) if was is None else was.mri
            texture = self._work.do(lambda: texture_below(known, mri, labels, found))
        self._write_tissues(output_node, Added(found, tuple(names)), closed, texture)
        set_closed_labels(output_node, closed)
        show_flap(output_node, labels.with_array(found.array != labels.array))
        self.notes = (
            f"craniotomy: {what}; {millilitres:.1f} ml of skin, scalp and skull are replaced by the coupling medium in "
            f"{named(output_node)}, and {named(closed)} stays as it is",
        )
        self.warnings = ()
        if hidden:
            names_hidden = ", ".join(hidden.values())
            self.warnings = (f"of {named(opening_node)} what is hidden is not opened: {names_hidden}",)
        if is_left_out:
            self.warnings += (
                f"what was edited in {named(labels_node)} is not in {named(output_node)}, which is {named(closed)} "
                "with the opening",
            )
        return millilitres

    def closedLabels(self, labels_node):
        """The labels from which openCraniotomy made these; other labels are returned themselves."""
        require_node(labels_node, *LABEL_CLASSES, use="label map")
        return closed_labels(labels_node)

    def hideOpening(self, labels_node) -> None:
        """Hide the model of the piece that openCraniotomy removed."""
        hide_flap(labels_node)

    def simulate(
        self, labels_node, probe_transform_node, output_node, *, warned: Callable[[Warning], None] = warn_again
    ) -> Frame:
        """Write the image at the probe's pose into a scalar volume node, and put it under the probe's transform.

        `labels_node` is a label map or a segmentation; its names determine the tissues, see label_nodes.read_labels.
        Amplifier noise differs between poses in the labels' frame (noise.seed_of_pose). `warned` is called with each
        warning.
        Raises SimulationError, before anything is computed, for an output with data that this module did not make.
        """
        self._check_output(labels_node, output_node)
        try:
            taken = self._take(labels_node, probe_pose(probe_transform_node), output_node, warned)
            self._check_output(labels_node, output_node)  # nodes may have changed in the meantime
            require_node(probe_transform_node, "vtkMRMLTransformNode", use="probe transform")
        except BaseException:
            self.clearImage(output_node)  # an image of before would be taken for that of this pose
            raise
        self._taken = taken
        was_modifying = output_node.StartModify()
        write_about(taken)
        frame = required(taken.frame, "the image has no frame")
        write_image(output_node, frame, probe_transform_node)
        mark_as_result(output_node, IMAGE)
        output_node.EndModify(was_modifying)
        return frame

    def _take(
        self,
        labels_node,
        probe_to_world: np.ndarray,
        output_node,
        warned: Callable[[Warning], None],
        number: int | None = None,
    ) -> TakenImage:
        """The image at a pose (4, 4) for a volume node, into which nothing is written; `number`: in a sequence."""
        warnings: list[Warning] = []
        anatomy = self.anatomyOf(labels_node)
        preset, patient = self._effective_preset(labels_node), patient_of(labels_node)
        frame = self._frame(labels_node, probe_to_world, warnings.append, number)
        for warning in warnings:
            warned(warning)
        is_empty = any(isinstance(warning, EmptyViewWarning) for warning in warnings) or not frame.iq.any()
        time = datetime.now(timezone.utc).isoformat(timespec="milliseconds")
        return TakenImage(
            frame.image, frame.grid, probe_to_world, preset, patient, anatomy, time, is_empty, output_node,
            frame=frame, number=number,
        )  # fmt: skip

    def anatomyOf(self, labels_node) -> Hashable:
        """A value that changes with what images show of the patient: labels and sheets."""
        require_node(labels_node, *LABEL_CLASSES, use="label map")
        node: Any = self.parameters.sheets
        sheets = None if node is None else (sheets_version(node), self.parameters.sheet.kinds)
        return labels_version(labels_node), sheets

    def holdImage(self, output_node) -> None:
        """Freeze the image that simulate() wrote last into this node: it stays where it was taken.

        Without that it is under the probe's transform, for the next image, and would be shown where the probe is then.
        """
        taken = self._taken
        if taken is not None and taken.node is output_node and output_node.GetImageData() is not None:
            freeze(taken)

    @contextmanager
    def imageHeld(self) -> Iterator[None]:
        """While a scene is saved: as if Live ended, so that the image is where it was taken; it goes on after that.

        The scene says that the image is live. Saving lays the segments of tissues together into one label map. The
        images are of them as before.
        """
        taken, labels, images = self._taken, self.parameters.labels, self.parameters.image_sequence
        is_of_tissues, are_of_tissues = self.areOfTissues()
        transform = taken.node.GetParentTransformNode() if taken is not None and self.isLive else None
        if taken is not None and transform is not None:
            freeze(taken, while_saved=True)
        try:
            yield
        finally:
            if taken is not None and transform is not None:
                follow(taken, transform)
            if taken is not None and is_of_tissues:
                self._taken = replace(taken, anatomy=self.anatomyOf(labels))
            if are_of_tissues:
                self.sequenceIsOfTissues(images)

    def areOfTissues(self) -> tuple[bool, bool]:
        """(whether the last image, whether those of the chosen sequence) show labels and sheets as they are now."""
        labels, images = self.parameters.labels, self.parameters.image_sequence
        if labels is None:
            return False, False
        now, (node_id, in_sequence) = self.anatomyOf(labels), self._in_sequence
        is_known = images is not None and images.GetID() == node_id
        return self._taken is not None and self._taken.anatomy == now, is_known and in_sequence == now

    def sequenceIsOfTissues(self, images_node) -> None:
        """Take the images of a sequence for those of the chosen labels and sheets, with which it was restored."""
        labels = required(self.parameters.labels, "no label map is chosen, expected that of the images")
        self._in_sequence = images_node.GetID(), self.anatomyOf(labels)

    def clearImage(self, output_node) -> None:
        """Empty a node with an image of this module, which is not of the present patient or pose.

        Data of others, which were put in place of the image, are kept.
        """
        if output_node is None:
            return
        if self._taken is not None and self._taken.node is output_node:
            self._taken = None
        if output_node.GetImageData() is not None and may_replace_result(output_node):
            remove_image(output_node)

    def clearOutline(self, model_node) -> None:
        """Empty a model with an outline of this module, which is where a probe was on another patient."""
        if model_node is not None and may_replace_result(model_node):
            model_node.SetAndObservePolyData(None)

    def renewSimulator(self) -> None:
        """Make images with another simulator from now on: work that was abandoned may still use the one of before."""
        self._simulators = ReusedSimulator()

    def forgetPatient(self) -> None:
        """Release what is kept in memory of the last patient; nodes stay."""
        self.stopLiveUpdate()
        self._simulators.forget()
        self._patients = PatientReader()
        self._segmented = self._sheets = self._texture = self._taken = None
        self._laid, self._lesion_place, self._in_sequence = (None, {}), (None, None), ("", None)
        self.proposals = LesionProposals(self.scene, lambda work: self._work.do(work))
        self.notes = self.warnings = ()

    @property
    def taken(self) -> TakenImage | None:
        """The last result of simulate(), with all that it is of; None if there is none, or the last one failed."""
        return self._taken

    @property
    def lastFrame(self) -> Frame | None:
        """The last result of simulate()."""
        return None if self._taken is None else self._taken.frame

    def lastImage(self) -> Volume:
        """The image of lastFrame as one slice at the probe's pose of that time (RAS), not its present pose.

        Raises SimulationError if there is none.
        """
        return required(self._taken, "there is no image yet, simulate one first").volume()

    def simulateSequence(
        self,
        labels_node,
        transforms_node,
        images_node,
        *,
        browser_node=None,
        progress: Callable[[float], None] | None = None,
    ) -> int:
        """A sequence of simulated images from a vtkMRMLSequenceNode of linear transforms; returns how many.

        Images are in the probe frame with the transforms' index values; SequenceIndex changes values that a sequence
        node cannot distinguish, so that no image is lost. Their numbers are the seeds of their noise. With the browser
        of the transforms, the parents of its current transform are applied, and the images are added to it, under that
        transform. `progress` is called with the fraction done and may raise errors.Cancelled; `images_node` is then
        unchanged. Raises SimulationError for an `images_node` with data that this module did not make.
        """
        require_node(transforms_node, "vtkMRMLSequenceNode", use="sequence of transforms")
        require_node(images_node, "vtkMRMLSequenceNode", use="sequence of images")
        require(
            images_node is not transforms_node,
            f"input and output are both {named(images_node)}, expected different nodes",
        )
        require_result(images_node, "sequence of images")
        count = transforms_node.GetNumberOfDataNodes()
        require(count > 0, f"sequence {named(transforms_node)} is empty, expected transforms")
        proxy = None if browser_node is None else browser_node.GetProxyNode(transforms_node)
        parent = None if proxy is None else proxy.GetParentTransformNode()
        to_world = np.eye(4) if parent is None else node_to_world(parent)

        images: list[TakenImage] = []
        for number in range(count):
            item = transforms_node.GetNthDataNode(number)
            require_node(item, "vtkMRMLTransformNode", use=f"item {number} of {named(transforms_node)}")
            pose = check_rigid(f"item {number} of {named(transforms_node)}", to_world @ node_to_world(item))
            image = self.scene.CreateNodeByClass("vtkMRMLScalarVolumeNode")
            image.UnRegister(None)
            taken = self._take(labels_node, pose, image, warn_again, number)
            write_about(taken)
            write_slice(image, Volume(taken.image[None], taken.grid.slice_to_probe))
            mark_as_result(image, IMAGE)  # the browser's node for the shown image is a copy
            images.append(replace(taken, frame=None))  # whose signals are many times larger
            if progress is not None:
                progress((number + 1) / count)
        require_node(images_node, "vtkMRMLSequenceNode", use="sequence of images")

        write_taken(images_node, SequenceIndex.of_node(transforms_node), images)
        same = {image.anatomy for image in images}
        self._in_sequence = (images_node.GetID(), images[0].anatomy if len(same) == 1 else None)
        if browser_node is not None:
            if not browser_node.IsSynchronizedSequenceNode(images_node, True):
                browser_node.AddSynchronizedSequenceNode(images_node)
            shown = browser_node.GetProxyNode(images_node)
            if shown is not None and proxy is not None:
                shown.SetAndObserveTransformNodeID(proxy.GetID())
        return count

    def sequenceImage(self, images_node, number: int) -> TakenImage:
        """The image with a number, from 0, that simulateSequence made, with all that it is of.

        Raises SimulationError for a sequence of something else.
        """
        require_node(images_node, "vtkMRMLSequenceNode", use="sequence of images")
        node_id, anatomy = self._in_sequence
        return read_taken(images_node, number, anatomy if node_id == images_node.GetID() else None)

    def showFrozen(self, record: FrozenRecord, output_node) -> TakenImage:
        """Write an image of a scene that was saved into a scalar volume node, where it was taken; it stays there.

        The chosen labels and sheets are those of the scene, if the record is of them. Ends live update.
        Raises SimulationError for a damaged record, and for an output that this module did not make.
        """
        require_node(output_node, "vtkMRMLScalarVolumeNode", use="output")
        require_result(output_node, "output")
        labels = self.parameters.labels
        anatomy = self.anatomyOf(labels) if record.is_of_tissues and labels is not None else None
        return self._show_frozen(replace(taken_of(record, output_node), anatomy=anatomy), output_node)

    def showSequenceImage(self, images_node, number: int, output_node) -> TakenImage:
        """Write an image that simulateSequence made into a scalar volume node, where it was taken; it stays there.

        Ends live update, whose next image would take its place. Raises SimulationError for an output with data that
        this module did not make.
        """
        require_node(output_node, "vtkMRMLScalarVolumeNode", use="output")
        require_result(output_node, "output")
        return self._show_frozen(in_node(self.sequenceImage(images_node, number), output_node), output_node)

    def _show_frozen(self, taken: TakenImage, output_node) -> TakenImage:
        self.stopLiveUpdate()
        self._taken = taken
        was_modifying = output_node.StartModify()
        write_about(taken)
        write_slice(output_node, Volume(taken.image[None], taken.grid.slice_to_probe))
        mark_as_result(output_node, IMAGE)
        freeze(taken)
        output_node.EndModify(was_modifying)
        return taken

    def placeProbe(
        self, labels_node, probe_transform_node, slice_node=None, target_ras=None, *, view: str | None = None,
        will_open: bool = False,
    ) -> str:  # fmt: skip
        """Put the probe on the surface of the labelled tissue, with its axis inwards.

        With a slice node the image is in that slice, with its depth towards the bottom of the view, aimed at
        `target_ras` (default: the middle of the view). Without one it is a coronal view through a parasagittal
        craniotomy: on a brain, upright on the skin of a whole head, or on the brain in the middle of an opening, aimed
        at a lesion below it (aiming.opening_pose).
        `view` is one of mri.views.VIEWS instead, as "temporal". With `will_open` it is on the brain of a closed head,
        where openCraniotomy opens a disc under it: over the lesion that was laid over the labels, if there is one.
        Returns a line about what was done in labels with an opening, or about how the head lies for a view, or "".
        """
        require_node(probe_transform_node, "vtkMRMLLinearTransformNode", use="probe transform")
        patient = self._patient(labels_node)
        surface = Volume(patient.labels.array, np.linalg.inv(patient.world_to_patient) @ patient.labels.ijk_to_ras)
        line = ""
        if view is not None and is_opened(labels_node):
            pose, line = opened_view_pose(surface, patient.names, view)
        elif view is not None:
            pose, line = view_pose(surface, patient.names, view)
        elif slice_node is None:
            opening = flap_centre(labels_node)
            probe, names = self.preset.probe, patient.names
            if opening is None:
                pose = default_pose(
                    surface, names, probe, is_open=will_open or is_opened(labels_node),
                    target_ras=self._laid_lesion(labels_node) if will_open else None,
                )  # fmt: skip
            else:
                pose, line = opening_pose(surface, names, probe, opening)
        else:
            require_node(slice_node, "vtkMRMLSliceNode", use="slice view")
            pose = pose_in_slice(surface, matrix_array(slice_node.GetSliceToRAS()), target_ras)
        set_node_to_world(probe_transform_node, pose)
        return line

    def _laid_lesion(self, labels_node) -> np.ndarray | None:
        """(3,) RAS mm of the largest lesion that was laid over these labels at last, as of --add; or None."""
        version, place = self._lesion_place
        if place is None or version != labels_version(labels_node):
            return None
        world_to_labels, scaling = pose_in_labels(labels_node, np.eye(4))
        return (np.linalg.inv(world_to_labels) @ scaling @ [*place, 1.0])[:3]

    def aboutBone(self, labels_node, probe_transform_node) -> tuple[str, ...]:
        """Lines about bone before the probe at its pose: a closed skull, or an opening that its face does not fit.

        See bone_before_probe.about_bone.
        """
        patient = self._patient(labels_node)
        tissues = _tissues_of(self.preset, patient.names, None).all_tissues()
        pose = patient.pose(probe_pose(probe_transform_node))
        return about_bone(
            patient.labels, patient.names, tissues, self.preset.probe, pose, is_open=is_opened(labels_node), words=SCENE
        )

    def aboutContact(self, labels_node, probe_transform_node) -> tuple[str, ...]:
        """Lines about a probe whose face does not touch the patient at its pose, or with little of it.

        See contact.about_contact.
        """
        patient, gap_mm = self._patient(labels_node), self.settings(labels_node).contact_gap_mm
        pose = patient.pose(probe_pose(probe_transform_node))
        return about_contact(patient.labels, self.preset.probe, [pose], gap_mm)

    def showOutline(self, model_node, probe_transform_node) -> None:
        """The outline of the imaged field as a model under the probe's transform.

        Raises SimulationError for a model with a surface that this module did not make.
        """
        require_node(model_node, "vtkMRMLModelNode", use="outline")
        require_node(probe_transform_node, "vtkMRMLTransformNode", use="probe transform")
        require_result(model_node, "outline")
        write_outline(model_node, self.preset.probe, probe_transform_node)
        mark_as_result(model_node, OUTLINE)

    def showInSlice(self, slice_node, output_node, probe_transform_node, fit: bool = True) -> None:
        """Move a slice view to the image plane and overlay the image."""
        require_node(slice_node, "vtkMRMLSliceNode", use="slice view")
        require_node(output_node, "vtkMRMLScalarVolumeNode", use="output")
        show_in_slice(slice_node, output_node, probe_pose(probe_transform_node), self.preset.probe, fit)

    # ---- fit to real ultrasound --------------------------------------------------------------------------------

    def optimize(
        self,
        labels_node,
        images_node,
        *,
        probe_transform_node=None,
        frames: Sequence[int] | None = None,
        validate: Sequence[int] = (),
        free: Iterable[str] | Mapping[str, tuple[float, float] | None] = ("display", "tissues"),
        register: bool = False,
        deform: bool = False,
        speckle: bool = False,
        estimate_geometry: bool = False,
        max_evaluations: int = FitSettings.evaluations,
        restarts: int = FitSettings.restarts,
        plot: CostPlot | None = None,
        progress: Callable[[Progress], None] | None = None,
    ) -> Fit:
        """Fit display and tissue parameters, with `register` the poses, with `deform` the tissues' place and
        with `speckle` the speckle, to real images.

        See fitting.fit.

        `images_node` is a sequence of images with its browser's transforms, a volume of one slice, or a 3D ultrasound
        volume, resampled in the image plane. `frames` are numbers of images (default: six, evenly spaced), `validate`
        those of others, which are predicted beside controls (fitting.predict). `plot` shows the cost during the fit.
        Nothing else in the scene changes; applyFit adopts the result. `progress` may raise errors.Cancelled.
        """
        patient, preset = self._patient(labels_node), self._effective_preset(labels_node)
        pose = None if probe_transform_node is None else probe_pose(probe_transform_node)
        tracked = tracked_images(
            images_node, frames, preset.probe, probe_to_world=pose, estimate_geometry=estimate_geometry, apart=validate
        )
        tracked = replace(tracked, poses=[patient.pose(pose) for pose in tracked.poses])
        tracked, others = tracked.split(validate) if validate else (tracked, None)
        near = [neighbours_in(images_node, images) for images in (tracked, others) if images is not None]
        texture, sheets = self._texture_of(labels_node, patient), self._sheets_of(labels_node)

        def report(step: Progress) -> None:
            if plot is not None:
                self._work.tell(partial(plot.add, step))
            if progress is not None:
                progress(step)

        def compute() -> Fit:
            simulator = self._simulator(patient, preset, texture, sheets)
            found = fit(
                simulator,
                tracked,
                free=free,
                display=preset.display,
                register=register,
                deform=deform,
                speckle=speckle,
                restarts=restarts,
                max_evaluations=max_evaluations,
                progress=report,
            )
            if others is None:
                return found
            prediction = predict(
                found, simulator, others, free=free, display=preset.display, speckle=speckle, fitted_neighbours=near[0],
                neighbours=near[1], max_evaluations=max_evaluations, restarts=restarts, progress=report,
            )  # fmt: skip
            return replace(found, prediction=prediction)

        try:
            return self._work.do(compute)
        finally:
            if plot is not None:
                plot.draw()

    def applyFit(self, found: Fit) -> Preset:
        """Adopt probe, display and tissues of a fit in the preset; returns the previous preset, for reverting."""
        before = self.preset
        self.preset = with_fit(before, found)
        return before

    def revertFit(self, found: Fit, before: Preset) -> list[str]:
        """Take back what applyFit adopted in the preset `before`; returns names of values changed since, which stay."""
        self.preset, kept = taken_back(before, with_fit(before, found), self.preset)
        return kept

    def writeRegistration(self, found: Fit, labels_node, transform_node) -> None:
        """Write the registration's correction into a linear transform: the last parent of the tracking.

        Raises SimulationError for a transform that is neither the identity nor written by this method.
        """
        require_node(transform_node, "vtkMRMLLinearTransformNode", use="registration")
        registration = required(found.registration, "the fit was made without registration")
        require_result(transform_node, "registration")
        to_world = self._fit_to_world(labels_node)
        set_node_to_world(transform_node, to_world @ registration.correction @ np.linalg.inv(to_world))
        mark_as_result(transform_node, REGISTRATION)

    def showFit(self, found: Fit, labels_node, nodes: Mapping[str, object], number: int | None = None) -> None:
        """Write one image of a fit, by default the first, into volume nodes: any of {"real": ..., "before": ...,
        "after": ..., "difference": ...}.

        Raises SimulationError for one with data that this module did not make; none is changed then.
        """
        number = found.tracked.numbers[0] if number is None else number
        write_compared(dict(nodes), found, number, self._fit_to_world(labels_node))

    def showFitInSlice(self, slice_node, found: Fit, labels_node, shown_node, real_node, number: int) -> None:
        """Move a slice view to the plane of an image of a fit: `shown_node` in front of `real_node`, for fading."""
        require_node(slice_node, "vtkMRMLSliceNode", use="slice view")
        pose = self._fit_to_world(labels_node) @ found.tracked.poses[found.tracked.numbers.index(number)]
        show_in_slice(slice_node, shown_node, pose, found.tracked.probe, fit=True, behind=real_node)

    def _fit_to_world(self, labels_node) -> np.ndarray:
        """(4, 4) from the frame of a fit's poses, which is the labels' frame unless its transform scales."""
        in_labels, _ = pose_in_labels(labels_node, np.eye(4))
        return np.linalg.inv(in_labels)

    # ---- live --------------------------------------------------------------------------------------------------

    @property
    def isLive(self) -> bool:
        """Whether a live update is running."""
        return self._live is not None and self._live.running

    def startLiveUpdate(
        self,
        labels_node,
        probe_transform_node,
        output_node,
        outline_node=None,
        slice_node=None,
        *,
        schedule: Callable[[Callable[[], None]], None] | None = None,
        report: Callable[[str], None] | None = None,
        stopped: Callable[[], None] | None = None,
    ) -> None:
        """Simulate now, and again whenever the transform or its parents, the labels or the preset change.

        `outline_node` is a model for the outline of the imaged field, `slice_node` a slice view that follows its plane.
        `schedule(function)` must call `function` once, soon, from the event loop (in Slicer: qt.QTimer.singleShot(0,
        function)). One image is then computed for all changes before the call. Without `schedule` an image is computed
        synchronously with each change.
        `report` is called with "" after an image, and otherwise with one line that describes the error; the update
        continues, since the error may be corrected. `stopped` is called when it ends: by stopLiveUpdate, when one of
        its nodes or the scene is removed, or when another live update uses the output.
        """
        self.stopLiveUpdate()
        caught: list[Warning] = []

        def version() -> tuple[Hashable, ...]:
            pose = node_to_world(probe_transform_node).tobytes()
            return pose, labels_version(labels_node), self.parameters.node.GetMTime()

        before = version()
        self.simulate(labels_node, probe_transform_node, output_node, warned=caught.append)  # raises errors immediately
        if outline_node is not None:
            self.showOutline(outline_node, probe_transform_node)
        if slice_node is not None:
            self.showInSlice(slice_node, output_node, probe_transform_node)
        nodes = LiveNodes(labels_node, probe_transform_node, output_node, outline_node, slice_node)
        self._live = LiveUpdate(self, nodes, schedule, report, stopped)
        if report is not None:
            report("; ".join(map(str, caught)))
        if version() != before:  # changed while the first image was computed, before anything was observed
            self._live.request()

    def stopLiveUpdate(self) -> None:
        """End the live update and remove its observers."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    # ---- internal ------------------------------------------------------------------------------------------------

    def _lesions(self, lesions_node, to_frame_of) -> tuple[list[tuple[str, Volume, str]], list[str]]:
        return read_lesions(lesions_node, to_frame_of, self.preset.tissues)

    def _organs(self, organs_node, mri_node, contrast: str) -> LabelledTissues:
        """The organs of a CT in its own frame. Raises SimulationError beside an MRI."""
        require(
            contrast == CT,
            f"{named(organs_node)} has organs of a CT, and the contrast is {contrast}; choose ct, or no organs",
        )
        require_node(organs_node, *LABEL_CLASSES, use="organs")
        to_mri = np.linalg.inv(node_to_world(mri_node)) @ node_to_world(organs_node)

        def in_frame_of_mri(found: LabelledTissues) -> LabelledTissues:
            labels = Volume(found.labels.array, to_mri @ found.labels.ijk_to_ras)
            return replace(found, labels=labels, others=tuple(map(in_frame_of_mri, found.others)))

        return in_frame_of_mri(read_labels(organs_node, self.preset.tissues, of_ct=True))

    def _sheets_of(self, labels_node) -> Surfels | None:
        """The chosen sheets of the kinds that are ticked, in the frame of the simulator's labels; None without any."""
        node, kinds = self.parameters.sheets, self.parameters.sheet.kinds
        if node is None:
            return None
        world_to_labels, _ = pose_in_labels(labels_node, np.eye(4))
        version = sheets_version(node), kinds, world_to_labels.tobytes()
        if self._sheets is None or self._sheets[0] != version:
            self._sheets = version, read_sheets(node, world_to_labels, kinds)
        return self._sheets[1]

    def _with_lesions(
        self,
        labels: Volume,
        names: Sequence[str],
        lesions: list[tuple[str, Volume, str]],
        before: _Told | None = None,
        *,
        has_brain_mask: bool,
    ) -> tuple[Added, _Told]:
        """(labels with lesions, what is told about each); `before` is that about those which the labels have."""
        own = [tissue.name for tissue in self.preset.tissues.all_tissues()]

        def lay() -> tuple[Added, _Told]:
            added, told = Added(labels, tuple(names)), {}
            for tissue, mask, source in lesions:
                added = add_tissues(
                    added.labels, added.tissue_names, [(tissue, mask, source)], also=own, has_brain_mask=has_brain_mask
                )
                place = (tissue, source, *place_of(mask))
                told[place] = (before or {}).get(place, (added.messages, added.warnings))
            lines = [tuple(line for one in told.values() for line in one[kind]) for kind in (0, 1)]
            return Added(added.labels, added.tissue_names, *lines), told

        return self._work.do(lay)

    def _check_output(self, labels_node, output_node) -> None:
        require_node(output_node, "vtkMRMLScalarVolumeNode", use="output")
        require(
            labels_node is not output_node, f"input and output are both {named(output_node)}, expected different nodes"
        )
        require(
            not output_node.IsA("vtkMRMLLabelMapVolumeNode"),
            f"output is {named(output_node)}, expected a ScalarVolume node",
        )
        require(
            output_node is not self.parameters.mri, f"output is the MRI {named(output_node)}, expected another volume"
        )
        require_result(output_node, "output")

    def recognised(self) -> tuple[str, tuple[str, ...]]:
        """(what the labels of the last image were recognised as, warnings about them): "FreeSurfer aseg: ..."."""
        return self._patients.recognised

    def _patient(self, labels_node) -> Patient:
        return self._patients.read(labels_node, self.preset.tissues)

    def _frame(
        self,
        labels_node,
        probe_to_world: np.ndarray,
        warned: Callable[[Warning], None],
        noise_seed: int | None = None,
    ) -> Frame:
        """The image at a pose; the default seed of its noise depends on the pose."""
        patient, preset = self._patient(labels_node), self._effective_preset(labels_node)
        texture, sheets = self._texture_of(labels_node, patient), self._sheets_of(labels_node)
        pose = patient.pose(probe_to_world)
        seed = seed_of_pose(pose) if noise_seed is None else noise_seed

        def compute() -> tuple[Frame, list[Warning]]:
            # Collected within the work, since Python collects warnings for all threads together.
            with collected_warnings() as caught:
                simulator = self._simulator(patient, preset, texture, sheets)
                return simulator.simulate(preset.probe, pose, preset.display, noise_seed=seed), caught

        frame, caught = self._work.do(compute)
        for warning in caught:
            warned(warning)
        return frame

    def _simulator(
        self, patient: Patient, preset: Preset, texture: Texture | None, sheets: Surfels | None
    ) -> UltrasoundSimulator:
        """Uses the device and no node; called within the work."""
        tissues = _tissues_of(preset, patient.names, sheets)
        return self._simulators.get(
            patient.version, patient.labels, tissues, preset.settings, self.device, texture, sheets
        )

    def _write_tissues(self, labels_node, added: Added, like_node, texture: Texture | None) -> None:
        """Write labels and what is known of their shares."""
        write_labels(labels_node, added.labels, added.tissue_names, like_node)
        mark_as_made(labels_node)
        labels_node.SetAttribute(PATIENT, patient_of(like_node))
        set_closed_labels(labels_node, None)
        hide_flap(labels_node)
        if texture is not None:
            write_shares(labels_node, added.labels, added.tissue_names, texture)
            if self._live is not None:  # which may have seen the labels without them
                self._live.request()

    def _texture_of(self, labels_node, patient: Patient) -> Texture | None:
        """What the settings take from the MRI besides the labels; None if they take nothing, or if nothing is known.

        Raises SimulationError if they demand what is not known.
        """
        settings = self.preset.settings
        is_modulated = settings.mri_modulation_db != 0.0
        if settings.partial_volume is False and not is_modulated:
            return None
        version = patient.version, shares_version(labels_node), is_modulated
        if self._texture is None or self._texture[0] != version:
            _, scaling = pose_in_labels(labels_node, np.eye(4))
            own = Volume(patient.labels.array, np.linalg.inv(scaling) @ patient.labels.ijk_to_ras)
            segmented, texture = self._segmented, None
            if not is_modulated:
                texture = read_shares(labels_node, own, patient.names)
            elif segmented is not None and segmented.version == patient.node_version:
                # A segmentation node may return its labels on a larger or smaller part of the grid.
                texture = segmented.texture.on_grid_of(own, segmented.labels)
            self._texture = version, texture
        if self._texture[1] is None and settings.needs_texture:
            raise SimulationError(
                f"the settings need a texture from the MRI, which {patient.name} lacks; segment the MRI again, or set "
                "partial_volume to none and mri_modulation_db to 0"
            )
        return self._texture[1]


def _in_frame_of(volume_node, node) -> Volume:
    """A volume in the own frame of another node, before its parent transform."""
    volume = read_volume(volume_node, "second MRI")
    return Volume(volume.array, np.linalg.inv(node_to_world(node)) @ node_to_world(volume_node) @ volume.ijk_to_ras)


def _tissues_of(preset: Preset, names: Sequence[str], sheets: Surfels | None) -> TissueTable:
    """The tissues of labels with these names, and of the sheets."""
    return with_their_tissue(preset.tissues.for_names(names), sheets, preset.tissues)
