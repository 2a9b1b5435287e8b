"""UltrasoundSceneLogic: the simulator on the nodes of a MRML scene, in 3D Slicer or without it."""

from __future__ import annotations

import json
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TypeVar

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, collected_warnings, require, required, warn_again
from SlicerUSSim.Logic.base.transforms import check_rigid
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.base.vtk_data import matrix_array
from SlicerUSSim.Logic.fitting.search import Progress
from SlicerUSSim.Logic.fitting.settings import FitSettings
from SlicerUSSim.Logic.fitting.tracked_fit import Fit, fit
from SlicerUSSim.Logic.imaging.frame import Frame
from SlicerUSSim.Logic.imaging.noise import seed_of_pose
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.imaging.reuse import ReusedSimulator
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.mri.segmentation import Segmentation, segment_mri
from SlicerUSSim.Logic.mri.settings import SegmentationSettings
from SlicerUSSim.Logic.mrml.fit_nodes import CostPlot, tracked_images, write_compared
from SlicerUSSim.Logic.mrml.label_nodes import (
    LABEL_CLASSES,
    Patient,
    PatientReader,
    labels_version,
    read_mask,
    write_labels,
)
from SlicerUSSim.Logic.mrml.live import LiveNodes, LiveUpdate
from SlicerUSSim.Logic.mrml.nodes import (
    named,
    node_to_world,
    pose_in_labels,
    probe_pose,
    read_volume,
    require_node,
    set_node_to_world,
    show_in_slice,
    write_image,
    write_outline,
)
from SlicerUSSim.Logic.mrml.parameter_node import SceneParameters
from SlicerUSSim.Logic.mrml.sequence_nodes import SequenceIndex
from SlicerUSSim.Logic.probe.placement import craniotomy_pose, pose_in_slice
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tissue.texture import Texture

T = TypeVar("T")


class AtOnce:
    """How a program with one thread works: at once. Where there is an event loop, another class of this form may do it
    in a thread of its own, and serve events and other calls of the logic's methods until it is done."""

    def do(self, function: Callable[[], T]) -> T:
        """What `function` gives. It takes time and touches no node; one is called after the other."""
        return function()

    def tell(self, function: Callable[[], None]) -> None:
        """From within do(): call `function`, which touches nodes, soon."""
        function()


class UltrasoundSceneLogic:
    """Simulates on the nodes of one scene.

    What is set (`preset`, and the nodes the module works with) is kept in the scene, see parameter_node. Every method
    raises SimulationError for a node that is missing, empty, of the wrong kind or under a transform that is not linear.

    Parameters
    ----------
    scene : vtkMRMLScene.
    device : see opencl.devices.choose_device.
    work : who does what takes time and touches no node.
    """

    def __init__(self, scene, device: str | None = None, work: AtOnce | None = None) -> None:
        self.scene = scene
        self.device = device
        self._work = work or AtOnce()
        self.parameters = SceneParameters(scene)
        self._simulators = ReusedSimulator()
        self._patients = PatientReader()
        self._segmented: tuple[Hashable, Segmentation] | None = None  # labels of that version came from it
        self._texture: tuple[Hashable, Texture] | None = None  # of labels of that version
        self._preset: tuple[str, Preset] = ("", Preset())
        self._live: LiveUpdate | None = None
        self._last: tuple[Frame, np.ndarray] | None = None  # and where the probe was

    # ---- what is set -------------------------------------------------------------------------------------------

    @property
    def preset(self) -> Preset:
        """Probe, display, settings and tissues; kept in the scene. Raises SimulationError if the scene holds another
        thing in its place."""
        text = self.parameters.preset
        if text != self._preset[0]:
            try:
                values = json.loads(text)
            except ValueError as error:
                raise SimulationError(f"the scene's preset is not JSON ({error})") from None
            self._preset = (text, Preset.from_dict(values, "the scene's preset"))
        return self._preset[1]

    @preset.setter
    def preset(self, preset: Preset) -> None:
        text = json.dumps(preset.to_dict())
        self._preset = (text, preset)
        self.parameters.preset = text

    def tissues(self, labels_node) -> TissueTable:
        """The tissues of a label map or segmentation: what the preset says about those names, else the presets."""
        return self.preset.tissues.for_names(self._patient(labels_node).names)

    # ---- once --------------------------------------------------------------------------------------------------

    def segment(
        self,
        mri_node,
        labels_node,
        *,
        mask_node=None,
        classes: int = SegmentationSettings.classes,
        contrast: str = SegmentationSettings.contrast,
        filter_radius: int = SegmentationSettings.filter_radius,
        filter_epsilon: float | None = SegmentationSettings.filter_epsilon,
        bias_correction: bool = SegmentationSettings.bias_correction,
        thin_sulci: bool = SegmentationSettings.thin_sulci,
        progress: Callable[[float], None] | None = None,
    ) -> Segmentation:
        """Label the tissues of a scalar volume into a label map or segmentation node, with names and colours.

        See segmentation.segment_mri; `mask_node` is a label map on the MRI's grid, or a segmentation. `progress` may
        raise errors.Cancelled; the nodes are then as they were.
        """
        require_node(labels_node, *LABEL_CLASSES, use="output of Segment")
        require(labels_node is not mri_node, f"input and output are both {named(mri_node)}, expected two nodes")
        mri = read_volume(mri_node, "MRI")
        mask = None if mask_node is None else read_mask(mask_node, mri_node)
        require(mask_node is not labels_node, f"mask and output are both {named(labels_node)}, expected two nodes")
        result = self._work.do(
            lambda: segment_mri(
                mri, classes=classes, contrast=contrast, mask=mask, filter_radius=filter_radius,
                filter_epsilon=filter_epsilon, bias_correction=bias_correction, thin_sulci=thin_sulci,
                device=self.device, progress=progress,
            )
        )  # fmt: skip
        require_node(labels_node, *LABEL_CLASSES, use="output of Segment")
        write_labels(labels_node, result.labels, result.tissue_names, mri_node)
        self._segmented = (labels_version(labels_node), result)
        return result

    def simulate(
        self, labels_node, probe_transform_node, output_node, *, warned: Callable[[Warning], None] = warn_again
    ) -> Frame:
        """The image under the probe, into a scalar volume node that is put under the probe's transform.

        `labels_node` is a label map or a segmentation; its names choose the tissues, see label_nodes.read_labels. Every
        pose in the labels' frame has amplifier noise of its own (noise.seed_of_pose). `warned` is told what there is to
        warn of.
        """
        self._check_output(labels_node, output_node)
        probe_to_world = probe_pose(probe_transform_node)
        frame = self._frame(self._patient(labels_node), probe_to_world, warned)
        self._check_output(labels_node, output_node)  # much may have happened meanwhile
        require_node(probe_transform_node, "vtkMRMLTransformNode", use="probe transform")
        self._last = (frame, probe_to_world)
        write_image(output_node, frame, probe_transform_node)
        return frame

    @property
    def lastFrame(self) -> Frame | None:
        """What simulate() computed last."""
        return None if self._last is None else self._last[0]

    def lastImage(self) -> Volume:
        """The image of lastFrame as one slice where the probe was then (RAS), wherever its transform is now.

        Raises SimulationError if there is none.
        """
        frame, probe_to_world = required(self._last, "there is no image yet, simulate one first")
        return Volume(frame.image[None], probe_to_world @ frame.grid.slice_to_probe)

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

        Images are in the probe frame with the transforms' index values (SequenceIndex says what becomes of values that
        a sequence node cannot tell apart; no image is lost), and their numbers say which noise they have. With the
        browser of the transforms, its current transform's parents count, and the images are added to it, under that
        transform. `progress` is told the share done and may raise errors.Cancelled; `images_node` is then as it was.
        """
        require_node(transforms_node, "vtkMRMLSequenceNode", use="sequence of transforms")
        require_node(images_node, "vtkMRMLSequenceNode", use="sequence of images")
        require(images_node is not transforms_node, f"input and output are both {named(images_node)}, expected two")
        count = transforms_node.GetNumberOfDataNodes()
        require(count > 0, f"sequence {named(transforms_node)} is empty, expected transforms")
        proxy = None if browser_node is None else browser_node.GetProxyNode(transforms_node)
        parent = None if proxy is None else proxy.GetParentTransformNode()
        to_world = np.eye(4) if parent is None else node_to_world(parent)

        images = []
        for number in range(count):
            item = transforms_node.GetNthDataNode(number)
            require_node(item, "vtkMRMLTransformNode", use=f"item {number} of {named(transforms_node)}")
            pose = check_rigid(f"item {number} of {named(transforms_node)}", to_world @ node_to_world(item))
            frame = self._frame(self._patient(labels_node), pose, warn_again, noise_seed=number)
            image = self.scene.CreateNodeByClass("vtkMRMLScalarVolumeNode")
            image.UnRegister(None)
            write_image(image, frame)
            images.append(image)
            if progress is not None:
                progress((number + 1) / count)
        require_node(images_node, "vtkMRMLSequenceNode", use="sequence of images")

        SequenceIndex.of_node(transforms_node).fill(images_node, images)
        if browser_node is not None:
            if not browser_node.IsSynchronizedSequenceNode(images_node, True):
                browser_node.AddSynchronizedSequenceNode(images_node)
            shown = browser_node.GetProxyNode(images_node)
            if shown is not None and proxy is not None:
                shown.SetAndObserveTransformNodeID(proxy.GetID())
        return count

    def placeProbe(self, labels_node, probe_transform_node, slice_node=None, target_ras=None) -> None:
        """Put the probe on the surface of what is labelled, looking inwards.

        With a slice node the image lies in that slice, its depth running down the view, aimed at `target_ras` (the
        middle of the view by default). Without one it is a coronal view through a parasagittal craniotomy.
        """
        require_node(probe_transform_node, "vtkMRMLLinearTransformNode", use="probe transform")
        patient = self._patient(labels_node)
        surface = Volume(patient.labels.array, np.linalg.inv(patient.world_to_patient) @ patient.labels.ijk_to_ras)
        if slice_node is None:
            pose = craniotomy_pose(surface, self.preset.probe)
        else:
            require_node(slice_node, "vtkMRMLSliceNode", use="slice view")
            pose = pose_in_slice(surface, matrix_array(slice_node.GetSliceToRAS()), target_ras)
        set_node_to_world(probe_transform_node, pose)

    def showOutline(self, model_node, probe_transform_node) -> None:
        """The outline of the imaged field as a model under the probe's transform."""
        require_node(model_node, "vtkMRMLModelNode", use="outline")
        require_node(probe_transform_node, "vtkMRMLTransformNode", use="probe transform")
        write_outline(model_node, self.preset.probe, probe_transform_node)

    def showInSlice(self, slice_node, output_node, probe_transform_node, fit: bool = True) -> None:
        """Turn a slice view into the plane of the probe and lay the image over what it shows."""
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
        free: Iterable[str] | Mapping[str, tuple[float, float] | None] = ("display", "white matter"),
        register: bool = False,
        estimate_geometry: bool = False,
        max_evaluations: int = FitSettings.evaluations,
        restarts: int = FitSettings.restarts,
        plot: CostPlot | None = None,
        progress: Callable[[Progress], None] | None = None,
    ) -> Fit:
        """Fit display and tissue parameters, and with `register` the poses, to real images; see fitting.fit.

        `images_node` is a sequence of images with its browser's transforms, a volume of one slice, or a 3D ultrasound
        volume, cut where the probe is. `frames` are numbers of images (default: six, spread). `plot` draws the cost,
        live. Nothing else in the scene changes: applyFit takes the result over. `progress` may raise errors.Cancelled.
        """
        patient, preset = self._patient(labels_node), self.preset
        pose = None if probe_transform_node is None else probe_pose(probe_transform_node)
        tracked = tracked_images(
            images_node, frames, preset.probe, probe_to_world=pose, estimate_geometry=estimate_geometry
        )
        tracked = replace(tracked, poses=[patient.pose(pose) for pose in tracked.poses])
        texture = self._texture_of(patient)

        def told(step: Progress) -> None:
            if plot is not None:
                self._work.tell(partial(plot.add, step))
            if progress is not None:
                progress(step)

        def compute() -> Fit:
            return fit(
                self._simulator(patient, preset, texture),
                tracked,
                free=free,
                display=preset.display,
                register=register,
                restarts=restarts,
                max_evaluations=max_evaluations,
                progress=told,
            )

        try:
            return self._work.do(compute)
        finally:
            if plot is not None:
                plot.draw()

    def applyFit(self, found: Fit) -> Preset:
        """Take probe, display and tissues of a fit into the preset; returns the preset that was, to revert to."""
        before = self.preset
        tissues = before.tissues
        for name in found.appearance.parameters.varied():
            tissues = tissues.with_tissue(found.appearance.tissues.tissue(name))
        self.preset = replace(before, probe=found.tracked.probe, display=found.appearance.display, tissues=tissues)
        return before

    def writeRegistration(self, found: Fit, labels_node, transform_node) -> None:
        """Put what registration moved the ultrasound by into a linear transform: the last parent of its tracking."""
        require_node(transform_node, "vtkMRMLLinearTransformNode", use="registration")
        registration = required(found.registration, "the fit was made without registration")
        to_world = self._fit_to_world(labels_node)
        set_node_to_world(transform_node, to_world @ registration.correction @ np.linalg.inv(to_world))

    def showFit(self, found: Fit, labels_node, nodes: Mapping[str, object], number: int | None = None) -> None:
        """Put one image of a fit, the first by default, into volume nodes: {"real": ..., "before": ..., "after": ...,
        "difference": ...}, any of them."""
        number = found.tracked.numbers[0] if number is None else number
        write_compared(dict(nodes), found, number, self._fit_to_world(labels_node))

    def showFitInSlice(self, slice_node, found: Fit, labels_node, shown_node, real_node, number: int) -> None:
        """Turn a slice view into the plane of an image of a fit: `shown_node` before `real_node`, to fade between."""
        require_node(slice_node, "vtkMRMLSliceNode", use="slice view")
        pose = self._fit_to_world(labels_node) @ found.tracked.poses[found.tracked.numbers.index(number)]
        show_in_slice(slice_node, shown_node, pose, found.tracked.probe, fit=True, behind=real_node)

    def _fit_to_world(self, labels_node) -> np.ndarray:
        """(4, 4) from the frame that poses of a fit are in, that of the labels unless they scale."""
        in_labels, _ = pose_in_labels(labels_node, np.eye(4))
        return np.linalg.inv(in_labels)

    # ---- live --------------------------------------------------------------------------------------------------

    @property
    def isLive(self) -> bool:
        """Whether images follow the probe."""
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

        `outline_node` is a model that shows the imaged field, `slice_node` a slice view that stays in its plane.
        `schedule(function)` has to call `function` once, soon, from the event loop (in Slicer: qt.QTimer.singleShot(0,
        function)). However many changes come before that, one image is computed, of the last. Without an event loop
        the image is computed within the change itself.
        `report` is told "" after an image, and otherwise one line about what is wrong; the update goes on, since what
        is wrong may be mended. `stopped` is called when it ends: by stopLiveUpdate, when one of its nodes or the scene
        goes away, or when another live update takes over the output.
        """
        self.stopLiveUpdate()
        caught: list[Warning] = []
        self.simulate(labels_node, probe_transform_node, output_node, warned=caught.append)  # raises what is wrong now
        if outline_node is not None:
            self.showOutline(outline_node, probe_transform_node)
        if slice_node is not None:
            self.showInSlice(slice_node, output_node, probe_transform_node)
        nodes = LiveNodes(labels_node, probe_transform_node, output_node, outline_node, slice_node)
        self._live = LiveUpdate(self, nodes, schedule, report, stopped)
        if report is not None:
            report("; ".join(map(str, caught)))

    def stopLiveUpdate(self) -> None:
        """Let the image rest; nothing is observed any more."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    # ---- inside ------------------------------------------------------------------------------------------------

    def _check_output(self, labels_node, output_node) -> None:
        require_node(output_node, "vtkMRMLScalarVolumeNode", use="output")
        require(labels_node is not output_node, f"input and output are both {named(output_node)}, expected two nodes")
        require(
            not output_node.IsA("vtkMRMLLabelMapVolumeNode"),
            f"output is {named(output_node)}, expected a ScalarVolume node",
        )
        require(
            output_node is not self.parameters.mri, f"output is the MRI {named(output_node)}, expected another volume"
        )

    def _patient(self, labels_node) -> Patient:
        return self._patients.read(labels_node, self.preset.tissues)

    def _frame(
        self,
        patient: Patient,
        probe_to_world: np.ndarray,
        warned: Callable[[Warning], None],
        noise_seed: int | None = None,
    ) -> Frame:
        """The image at a pose; its draw of the noise is the pose's own unless another is given."""
        preset, texture = self.preset, self._texture_of(patient)
        pose = patient.pose(probe_to_world)
        seed = seed_of_pose(pose) if noise_seed is None else noise_seed

        def compute() -> tuple[Frame, list[Warning]]:
            # Collected within the work: Python can do that for one thing at a time only.
            with collected_warnings() as caught:
                simulator = self._simulator(patient, preset, texture)
                return simulator.simulate(preset.probe, pose, preset.display, noise_seed=seed), caught

        frame, caught = self._work.do(compute)
        for warning in caught:
            warned(warning)
        return frame

    def _simulator(self, patient: Patient, preset: Preset, texture: Texture | None) -> UltrasoundSimulator:
        """Touches no node, but the device: to be called in the work itself."""
        tissues = preset.tissues.for_names(patient.names)
        return self._simulators.get(patient.version, patient.labels, tissues, preset.settings, self.device, texture)

    def _texture_of(self, patient: Patient) -> Texture | None:
        """What the MRI knows of a patient beyond labels, if the settings ask for it."""
        if not self.preset.settings.needs_texture:
            return None
        segmented = self._segmented
        if segmented is None or segmented[0] != patient.node_version:
            raise SimulationError(
                f"the settings want more of the MRI than {patient.name} holds; segment the MRI again, or set "
                "partial_volume to false and mri_modulation_db to 0"
            )
        if self._texture is None or self._texture[0] != patient.version:
            # A segmentation node gives its labels cropped to what it holds.
            texture = segmented[1].texture().on_grid_of(patient.labels, segmented[1].labels)
            self._texture = (patient.version, texture)
        return self._texture[1]
