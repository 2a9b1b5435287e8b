"""PatientLogic: a scene, its choices, and what images need of the patient in it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.settings import SimulationSettings
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.imaging.found_sheets import with_their_tissue
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.imaging.reuse import ReusedSimulator
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.mri.segmentation_settings import GEL_MM
from SlicerUSSim.Logic.mrml.craniotomy_nodes import is_opened
from SlicerUSSim.Logic.mrml.label_nodes import LABEL_CLASSES, labels_version, read_labels
from SlicerUSSim.Logic.mrml.nodes import named, pose_in_labels, require_node
from SlicerUSSim.Logic.mrml.parameter_node import SceneParameters
from SlicerUSSim.Logic.mrml.share_nodes import read_shares, shares_version
from SlicerUSSim.Logic.mrml.sheet_nodes import read_sheets, sheets_version
from SlicerUSSim.Logic.tissue.label_maps import LabelledTissues
from SlicerUSSim.Logic.tissue.surfels import Surfels
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tissue.texture import Texture

_log = logging.getLogger(__name__)
T = TypeVar("T")


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
class Patient:
    """A copy of all data of a label node for the simulator; the node is not accessed again."""

    #: Description of the node in messages
    name: str
    #: uint8 labels, one per tissue, in a frame with a rigid transform to the world
    labels: Volume
    #: Name of the tissue of label 1, 2, ...
    names: tuple[str, ...]
    #: (4, 4) rigid, from the world (RAS) to the frame of `labels`
    world_to_patient: np.ndarray
    #: Version of the node's voxels and names, see labels_version; and of the inputs of simulators, which also include
    #: the tissues of the names and a scaling transform
    node_version: Hashable
    version: Hashable

    def pose(self, probe_to_world: np.ndarray) -> np.ndarray:
        """(4, 4) of a probe in the frame of `labels`."""
        return self.world_to_patient @ probe_to_world


@dataclass(frozen=True, eq=False)
class KnownLabels:
    """Labels of a node, and what is known of them besides."""

    #: Of the node, see labels_version
    version: Hashable
    labels: Volume
    #: Of labels 1, 2, ...
    names: tuple[str, ...]
    #: With that of their MRI, if Segment wrote them last
    texture: Texture | None
    #: The MRI on the grid of the labels; 0 everywhere if Segment did not write them last
    mri: Volume
    #: Whether Segment wrote the labels last, within a brain mask
    is_of_brain: bool


@dataclass(frozen=True, eq=False)
class Imaged:
    """All that images of labels need but the pose, read from the scene once."""

    patient: Patient
    #: With the settings that images of these labels have
    preset: Preset
    texture: Texture | None
    sheets: Surfels | None

    @property
    def tissues(self) -> TissueTable:
        """Those of the labels and sheets."""
        return _tissues_of(self.preset, self.patient.names, self.sheets)


class PatientLogic:
    """What all parts of UltrasoundSceneLogic share; see there for parameters and errors."""

    def __init__(self, scene, device: str | None, work: AtOnce) -> None:
        self.scene = scene
        self.device = device
        self.work = work
        self.parameters = SceneParameters(scene)
        self._simulators = ReusedSimulator()
        self.forget()

    def forget(self) -> None:
        """Release what is kept in memory of the last patient."""
        self._simulators.forget()
        self._read: tuple[Hashable, LabelledTissues] | None = None  # with its version
        #: Labels that Segment wrote last
        self.segmented: KnownLabels | None = None
        #: (labels_version, (3,) mm in their frame) of the largest lesion that was laid over labels
        self.lesion_place: tuple[Hashable, np.ndarray | None] = (None, None)
        self._sheets: tuple[Hashable, Surfels] | None = None  # with the version of their node, kinds and frame
        self._texture: tuple[Hashable, Texture | None] | None = None  # with the version of its labels

    def renewSimulator(self) -> None:
        """Make images with another simulator from now on: work that was abandoned may still use the previous one."""
        self._simulators = ReusedSimulator()

    def patient(self, labels_node) -> Patient:
        """The content and position of a label map or segmentation, read again if node or tissues have changed."""
        require_node(labels_node, *LABEL_CLASSES, use="label map")
        node_version, tissues = labels_version(labels_node), self.parameters.preset.tissues
        # Names are not sufficient: a label map without names takes those of `tissues` by label.
        version = (node_version, tuple((label, tissue.name) for label, tissue in tissues.items()))
        if self._read is None or self._read[0] != version:
            self._read = (version, read_labels(labels_node, tissues))
            _log.debug("%s: labels read from the node", named(labels_node))
        found = self._read[1]
        world_to_patient, scaling = pose_in_labels(labels_node, np.eye(4))
        labels = Volume(found.labels.array, scaling @ found.labels.ijk_to_ras)
        of_simulator = (version, scaling.tobytes())
        return Patient(named(labels_node), labels, found.names, world_to_patient, node_version, of_simulator)

    def recognised(self) -> tuple[str, tuple[str, ...]]:
        """(what the labels of the last image were recognised as, warnings about them): "FreeSurfer aseg: ..."."""
        return ("", ()) if self._read is None else (self._read[1].message, self._read[1].warnings)

    def tissues(self, labels_node) -> TissueTable:
        """The tissues of a label map or segmentation by name, from the preset's table or else the tissue presets.

        With that of falx and tentorium, if images show such sheets.
        """
        try:
            sheets = self.sheets(labels_node)
        except SimulationError:  # what is chosen has no sheets, which an image will tell
            sheets = None
        return _tissues_of(self.parameters.preset, self.patient(labels_node).names, sheets)

    def settings(self, labels_node, patient: Patient | None = None) -> SimulationSettings:
        """The preset's settings, with gel between skin and probe (GEL_MM) where labels have skin, by default.

        That is: no contact gap, the parameter `gel`, and no opening, which is filled with the coupling medium.
        """
        settings = self.parameters.preset.settings
        is_default = settings.contact_gap_mm is None and self.parameters.panel.gel and not is_opened(labels_node)
        if is_default and "skin" in (patient or self.patient(labels_node)).names:
            return replace(settings, contact_gap_mm=GEL_MM)
        return settings

    def imaged(self, labels_node) -> Imaged:
        """What images of these labels need. Raises SimulationError if the settings demand what is not known."""
        patient = self.patient(labels_node)
        preset = replace(self.parameters.preset, settings=self.settings(labels_node, patient))
        return Imaged(patient, preset, self._texture_of(labels_node, patient), self.sheets(labels_node))

    def simulator(self, imaged: Imaged) -> UltrasoundSimulator:
        """Uses the device and no node; called within the work."""
        return self._simulators.get(
            imaged.patient.version, imaged.patient.labels, imaged.tissues, imaged.preset.settings, self.device,
            imaged.texture, imaged.sheets,
        )  # fmt: skip

    def sheets(self, labels_node) -> Surfels | None:
        """The chosen sheets of the kinds that are ticked, in the frame of the simulator's labels; None without any."""
        node, kinds = self.parameters.sheets, self.parameters.sheet.kinds
        if node is None:
            return None
        world_to_labels, _ = pose_in_labels(labels_node, np.eye(4))
        version = sheets_version(node), kinds, world_to_labels.tobytes()
        if self._sheets is None or self._sheets[0] != version:
            self._sheets = version, read_sheets(node, world_to_labels, kinds)
        return self._sheets[1]

    def anatomyOf(self, labels_node) -> Hashable:
        """A value that changes with what images show of the patient: labels and sheets."""
        require_node(labels_node, *LABEL_CLASSES, use="label map")
        node: Any = self.parameters.sheets
        sheets = None if node is None else (sheets_version(node), self.parameters.sheet.kinds)
        return labels_version(labels_node), sheets

    def _texture_of(self, labels_node, patient: Patient) -> Texture | None:
        """What the settings take from the MRI besides the labels; None if they take nothing, or if nothing is known.

        Raises SimulationError if they demand what is not known.
        """
        settings = self.parameters.preset.settings
        is_modulated = settings.mri_modulation_db != 0.0
        if settings.partial_volume is False and not is_modulated:
            return None
        version = patient.version, shares_version(labels_node), is_modulated
        if self._texture is None or self._texture[0] != version:
            _, scaling = pose_in_labels(labels_node, np.eye(4))
            own = Volume(patient.labels.array, np.linalg.inv(scaling) @ patient.labels.ijk_to_ras)
            segmented, texture = self.segmented, None
            if not is_modulated:
                texture = read_shares(labels_node, own, patient.names)
            elif segmented is not None and segmented.version == patient.node_version and segmented.texture is not None:
                # A segmentation node may return its labels on a larger or smaller part of the grid.
                texture = segmented.texture.on_grid_of(own, segmented.labels)
            self._texture = version, texture
        if self._texture[1] is None and settings.needs_texture:
            raise SimulationError(
                f"the settings need a texture from the MRI, which {patient.name} lacks; segment the MRI again, or set "
                "partial_volume to none and mri_modulation_db to 0"
            )
        return self._texture[1]


def _tissues_of(preset: Preset, names: Sequence[str], sheets: Surfels | None) -> TissueTable:
    """The tissues of labels with these names, and of the sheets."""
    return with_their_tissue(preset.tissues.for_names(names), sheets, preset.tissues)
