"""UltrasoundSceneLogic: the simulator on the nodes of a MRML scene, in 3D Slicer or without it."""

from __future__ import annotations

from SlicerUSSim.Logic.imaging.frame import Frame
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mrml.craniotomy_nodes import hide_flap
from SlicerUSSim.Logic.mrml.fit_logic import FitLogic
from SlicerUSSim.Logic.mrml.image_logic import ImageLogic
from SlicerUSSim.Logic.mrml.live import LiveLogic
from SlicerUSSim.Logic.mrml.own_results import may_replace_result
from SlicerUSSim.Logic.mrml.patient_logic import AtOnce as AtOnce, PatientLogic
from SlicerUSSim.Logic.mrml.proposal_nodes import LesionProposals
from SlicerUSSim.Logic.mrml.segment_logic import SegmentLogic
from SlicerUSSim.Logic.mrml.sequence_logic import SequenceLogic
from SlicerUSSim.Logic.mrml.taken_image import TakenImage


class UltrasoundSceneLogic:
    """Simulates on the nodes of one scene.

    Every method is that of the part with its subject, which has its documentation. The choices (`preset`, and the nodes
    of the module) are saved in the scene, see parameter_node. All methods raise SimulationError for a node that is
    missing, empty, of the wrong kind or under a transform that is not linear.

    Parameters
    ----------
    scene : vtkMRMLScene.
    device : see opencl.devices.choose_device.
    work : runs slow functions that do not access nodes.
    """

    def __init__(self, scene, device: str | None = None, work: AtOnce | None = None) -> None:
        self.scene, self.device = scene, device
        self.patients = patients = PatientLogic(scene, device, work or AtOnce())
        self.images = images = ImageLogic(patients)
        self.live = live = LiveLogic(patients, images)
        self.labels = labels = SegmentLogic(patients, live)
        self.sequences = sequences = SequenceLogic(patients, images, live)
        self.fits = fits = FitLogic(patients)
        self.parameters = patients.parameters

        self.tissues, self.settings, self.recognised = patients.tissues, patients.settings, patients.recognised
        self.anatomyOf, self.renewSimulator = patients.anatomyOf, patients.renewSimulator

        self.segment, self.mayReplace, self.addTissues = labels.segment, labels.mayReplace, labels.addTissues
        self.writeBrain, self.isOwnBrain, self.brainOf = labels.writeBrain, labels.isOwnBrain, labels.brainOf
        self.openCraniotomy, self.closedLabels = labels.openCraniotomy, labels.closedLabels
        self.hideOpening = hide_flap

        self.simulate, self.holdImage, self.clearImage = images.simulate, images.holdImage, images.clearImage
        self.clearOutline, self.lastImage, self.placeProbe = images.clearOutline, images.lastImage, images.placeProbe
        self.aboutBone, self.aboutContact = images.aboutBone, images.aboutContact
        self.showOutline, self.showInSlice = images.showOutline, images.showInSlice
        self.mayReplaceResult = may_replace_result

        self.startLiveUpdate, self.stopLiveUpdate = live.startLiveUpdate, live.stopLiveUpdate

        self.simulateSequence, self.sequenceImage = sequences.simulateSequence, sequences.sequenceImage
        self.showSequenceImage, self.showFrozen = sequences.showSequenceImage, sequences.showFrozen
        self.imageHeld, self.areOfTissues = sequences.imageHeld, sequences.areOfTissues
        self.sequenceIsOfTissues = sequences.sequenceIsOfTissues

        self.optimize, self.applyFit, self.revertFit = fits.optimize, fits.applyFit, fits.revertFit
        self.writeRegistration, self.showFit = fits.writeRegistration, fits.showFit
        self.showFitInSlice = fits.showFitInSlice

    @property
    def preset(self) -> Preset:
        """Probe, display, settings and tissues; saved in the scene. Raises SimulationError for an invalid value."""
        return self.parameters.preset

    @preset.setter
    def preset(self, preset: Preset) -> None:
        self.parameters.preset = preset

    @property
    def proposals(self) -> LesionProposals:
        """Lesions proposed from the MRI that was segmented last."""
        return self.labels.proposals

    @property
    def notes(self) -> tuple[str, ...]:
        """What the last segment(), addTissues() or openCraniotomy() did, one line each."""
        return self.labels.notes

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a user should check after it, one line each."""
        return self.labels.warnings

    @property
    def isLive(self) -> bool:
        """Whether a live update is running."""
        return self.live.isLive

    @property
    def taken(self) -> TakenImage | None:
        """The last result of simulate(), with all that it is of; None if there is none, or the last one failed."""
        return self.images.taken

    @property
    def lastFrame(self) -> Frame | None:
        """The last result of simulate()."""
        return None if self.taken is None else self.taken.frame

    def forgetPatient(self) -> None:
        """Release what is kept in memory of the last patient; nodes stay."""
        self.live.stopLiveUpdate()
        self.patients.forget()
        self.labels.forget()
        self.sequences.forget()
        self.images.taken = None
