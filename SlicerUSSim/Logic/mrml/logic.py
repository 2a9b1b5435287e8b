"""UltrasoundSceneLogic: the simulator on the nodes of a MRML scene, in 3D Slicer or without it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar, overload

from SlicerUSSim.Logic.imaging.frame import Frame
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mrml.approach_logic import ApproachLogic
from SlicerUSSim.Logic.mrml.craniotomy_nodes import hide_flap
from SlicerUSSim.Logic.mrml.fit_logic import FitLogic
from SlicerUSSim.Logic.mrml.grown_nodes import LesionGrowth
from SlicerUSSim.Logic.mrml.image_logic import ImageLogic
from SlicerUSSim.Logic.mrml.live import LiveLogic
from SlicerUSSim.Logic.mrml.own_results import may_replace_result
from SlicerUSSim.Logic.mrml.patient_logic import AtOnce as AtOnce, PatientLogic
from SlicerUSSim.Logic.mrml.segment_logic import SegmentLogic
from SlicerUSSim.Logic.mrml.sequence_logic import SequenceLogic
from SlicerUSSim.Logic.mrml.taken_image import TakenImage

P = ParamSpec("P")
R = TypeVar("R")


class _Of(Generic[P, R]):
    """A method of a part as one of the class that has the part."""

    def __init__(self, part: str, method: Callable[Concatenate[Any, P], R]) -> None:
        self._part, self._method = part, method

    @overload
    def __get__(self, logic: None, owner: type) -> Callable[Concatenate[Any, P], R]: ...

    @overload
    def __get__(self, logic: UltrasoundSceneLogic, owner: type) -> Callable[P, R]: ...

    def __get__(self, logic, owner):
        return self._method if logic is None else getattr(getattr(logic, self._part), self._method.__name__)


class UltrasoundSceneLogic:
    """Simulates on the nodes of one scene.

    Every method belongs to the part with its subject. The choices (`preset`, and the nodes of the module) are saved in
    the scene, see parameter_node. All methods raise SimulationError for a node that is missing, empty, of the wrong
    kind or under a transform that is not linear.

    Parameters
    ----------
    scene : vtkMRMLScene.
    device : see opencl.devices.choose_device.
    work : runs slow functions that do not access nodes.
    """

    def __init__(self, scene, device: str | None = None, work: AtOnce | None = None) -> None:
        self.scene = scene
        self.patients = patients = PatientLogic(scene, device, work or AtOnce())
        self.images = images = ImageLogic(patients)
        self.live = LiveLogic(patients, images)
        self.labels = SegmentLogic(patients, self.live)
        self.sequences = SequenceLogic(patients, images, self.live)
        self.fits = FitLogic(patients)
        self.approaches = ApproachLogic(patients)
        self.parameters = patients.parameters

    tissues, settings = _Of("patients", PatientLogic.tissues), _Of("patients", PatientLogic.settings)
    recognised, anatomyOf = _Of("patients", PatientLogic.recognised), _Of("patients", PatientLogic.anatomyOf)
    renewSimulator = _Of("patients", PatientLogic.renewSimulator)
    segment, mayReplace = _Of("labels", SegmentLogic.segment), _Of("labels", SegmentLogic.mayReplace)
    addTissues, writeBrain = _Of("labels", SegmentLogic.addTissues), _Of("labels", SegmentLogic.writeBrain)
    isOwnBrain, isBrainOf = _Of("labels", SegmentLogic.isOwnBrain), _Of("labels", SegmentLogic.isBrainOf)
    openCraniotomy, closedLabels = _Of("labels", SegmentLogic.openCraniotomy), _Of("labels", SegmentLogic.closedLabels)
    hideOpening, mayReplaceResult = staticmethod(hide_flap), staticmethod(may_replace_result)
    simulate, holdImage = _Of("images", ImageLogic.simulate), _Of("images", ImageLogic.holdImage)
    clearImage, clearOutline = _Of("images", ImageLogic.clearImage), _Of("images", ImageLogic.clearOutline)
    lastImage, placeProbe = _Of("images", ImageLogic.lastImage), _Of("images", ImageLogic.placeProbe)
    aboutBone, aboutContact = _Of("images", ImageLogic.aboutBone), _Of("images", ImageLogic.aboutContact)
    showOutline, showInSlice = _Of("images", ImageLogic.showOutline), _Of("images", ImageLogic.showInSlice)
    showProbe, redisplay = _Of("images", ImageLogic.showProbe), _Of("images", ImageLogic.redisplay)
    differences, holdOutline = _Of("images", ImageLogic.differences), _Of("images", ImageLogic.holdOutline)
    startLiveUpdate, stopLiveUpdate = _Of("live", LiveLogic.startLiveUpdate), _Of("live", LiveLogic.stopLiveUpdate)
    simulateSequence = _Of("sequences", SequenceLogic.simulateSequence)
    followPath = _Of("sequences", SequenceLogic.followPath)
    compoundSequence = _Of("sequences", SequenceLogic.compoundSequence)
    sequenceImage = _Of("sequences", SequenceLogic.sequenceImage)
    showSequenceImage = _Of("sequences", SequenceLogic.showSequenceImage)
    showFrozen, imageHeld = _Of("sequences", SequenceLogic.showFrozen), _Of("sequences", SequenceLogic.imageHeld)
    showTaken = _Of("sequences", SequenceLogic.showTaken)
    areOfTissues = _Of("sequences", SequenceLogic.areOfTissues)
    sequenceIsOfTissues = _Of("sequences", SequenceLogic.sequenceIsOfTissues)
    optimize, applyFit = _Of("fits", FitLogic.optimize), _Of("fits", FitLogic.applyFit)
    revertFit, writeRegistration = _Of("fits", FitLogic.revertFit), _Of("fits", FitLogic.writeRegistration)
    planApproach = _Of("approaches", ApproachLogic.planApproach)
    showApproach = _Of("approaches", ApproachLogic.showApproach)
    hideApproach = _Of("approaches", ApproachLogic.hideApproach)
    showFit, showFitInSlice = _Of("fits", FitLogic.showFit), _Of("fits", FitLogic.showFitInSlice)

    @property
    def preset(self) -> Preset:
        """Probe, display, settings and tissues; saved in the scene. Raises SimulationError for an invalid value."""
        return self.parameters.preset

    @preset.setter
    def preset(self, preset: Preset) -> None:
        self.parameters.preset = preset

    @property
    def device(self) -> str | None:
        """The choice of the OpenCL device, see opencl.devices.choose_device."""
        return self.patients.device

    @device.setter
    def device(self, device: str | None) -> None:
        self.patients.device = device

    @property
    def growth(self) -> LesionGrowth:
        """Grows lesions on the MRI that was segmented last."""
        return self.labels.growth

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
        """The last result of simulate(), with everything it shows; None if there is none, or the last one failed."""
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
