"""The simulator as VTK filters: from an MRI to labels, and from labels to a B-mode image.

    segmentation = SegmentationFilter()
    segmentation.SetInputConnection(reader.GetOutputPort())
    simulation = UltrasoundSimulationFilter()
    simulation.SetInputConnection(segmentation.GetOutputPort())
    simulation.SetProbeTransform(transform)
    actor.GetMapper().SetInputConnection(simulation.GetOutputPort())

All images are in patient space (RAS, mm), with origin, spacing and direction matrix. The first row of a B-mode image is
next to the probe. Writers of pictures put it at the bottom: flip the image for them (examples/vtk_picture.py). Errors
caused by the caller are reported by an ErrorEvent with one line, and by GetErrorMessage; the output is then empty.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import numpy as np
from vtkmodules.util.vtkAlgorithm import VTKPythonAlgorithmBase
from vtkmodules.vtkCommonCore import VTK_UNSIGNED_CHAR, vtkCommand, vtkOutputWindow, vtkStringArray
from vtkmodules.vtkCommonDataModel import vtkDataObject, vtkImageData, vtkPolyData
from vtkmodules.vtkCommonExecutionModel import vtkAlgorithm, vtkStreamingDemandDrivenPipeline
from vtkmodules.vtkCommonMath import vtkMatrix4x4
from vtkmodules.vtkCommonTransforms import vtkLinearTransform, vtkMatrixToLinearTransform, vtkTransform
from vtkmodules.vtkFiltersGeneral import vtkTransformPolyDataFilter

from SlicerUSSim.Logic.base.errors import Cancelled, SimulationError, require, require_kind, user_message
from SlicerUSSim.Logic.base.settings import DisplaySettings, SimulationSettings
from SlicerUSSim.Logic.base.transforms import check_rigid
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.base.vtk_data import matrix_array, set_scalars
from SlicerUSSim.Logic.imaging.found_sheets import with_their_tissue
from SlicerUSSim.Logic.imaging.frame import Frame
from SlicerUSSim.Logic.imaging.noise import seed_of_pose
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.imaging.reuse import ReusedSimulator
from SlicerUSSim.Logic.mri.ct import CtSegmentation
from SlicerUSSim.Logic.mri.modality import has_brain_mask, segment_image
from SlicerUSSim.Logic.mri.pathology import add_tissues
from SlicerUSSim.Logic.mri.segmentation import Segmentation
from SlicerUSSim.Logic.mri.segmentation_settings import SegmentationSettings
from SlicerUSSim.Logic.mri.sheets.polydata import placed_surfels
from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.probe.image_grid import ImageGrid
from SlicerUSSim.Logic.probe.shape import outline_polydata
from SlicerUSSim.Logic.tissue.label_maps import read_label_map
from SlicerUSSim.Logic.tissue.surfels import Surfels
from SlicerUSSim.Logic.tissue.table import MAX_LABEL, TissueTable
from SlicerUSSim.Logic.tissue.texture import Texture

_log = logging.getLogger(__name__)

_WHOLE_EXTENT = vtkStreamingDemandDrivenPipeline.WHOLE_EXTENT

#: Field data of a label image: the name of label 1, 2, ...
TISSUE_NAMES = "TissueNames"
#: Options of the command in messages of the segmentation, and what the filter has for them
_METHODS = (
    ("--mask", "SetMaskData"), ("--add tumour=FILE", "AddTissueData"), ("--add", "AddTissueData"),
    ("--contrast", "contrast"), ("--skull-strip none", "skull_strip='none'"), ("--skull-strip", "skull_strip"),
)  # fmt: skip


def _getter(attribute: str, what: str) -> Callable[[Any], Any]:
    """The method that gives what a Set method has set."""

    def get(self) -> Any:
        return getattr(self, attribute)

    get.__doc__ = what
    return get


class _ImageFilter(VTKPythonAlgorithmBase):
    """A filter that processes whole images and reports errors by VTK's means."""

    def __init__(self, **ports) -> None:
        super().__init__(inputType="vtkImageData", outputType="vtkImageData", **ports)
        self._message = ""
        self._device: str | None = None

    def SetDevice(self, device: str | None) -> None:
        """OpenCL device (see opencl.devices.choose_device)."""
        self._change("_device", device)

    GetDevice = _getter("_device", "The choice of an OpenCL device; None: the best.")
    GetErrorMessage = _getter("_message", "The error of the last update, one line; empty without an error.")

    def SetInputData(self, image: vtkImageData | None) -> None:
        """Set the input image directly, without a pipeline connection."""
        self.SetInputDataObject(0, image)

    def GetOutput(self, port: int = 0):
        """The output of the last update."""
        return self.GetOutputDataObject(port)

    def ProcessRequest(self, request, inInfo, outInfo):  # noqa: N803
        try:
            result = super().ProcessRequest(request, inInfo, outInfo)
        except Exception as error:
            message = user_message(error)
            if message is None:
                raise
            self._fail("" if isinstance(error, Cancelled) else message)
            return 0
        if request.Has(vtkStreamingDemandDrivenPipeline.REQUEST_DATA()):
            self._message = ""
        return result

    def RequestUpdateExtent(self, request, inInfo, outInfo):  # noqa: N803
        for port in inInfo:
            info = port.GetInformationObject(0)
            if info is not None and info.Has(_WHOLE_EXTENT()):
                update = vtkStreamingDemandDrivenPipeline.UPDATE_EXTENT()
                info.Set(update, info.Get(_WHOLE_EXTENT()), 6)
        return 1

    def _fail(self, message: str) -> None:
        self._message = message
        for port in range(self.GetNumberOfOutputPorts()):
            output = self.GetOutputDataObject(port)
            if output is not None:
                output.Initialize()
        if not message:
            return
        if self.HasObserver(vtkCommand.ErrorEvent):
            self.InvokeEvent(vtkCommand.ErrorEvent, message)
        else:
            vtkOutputWindow.GetInstance().DisplayErrorText(f"{type(self).__name__}: {message}\n")

    def _change(self, name: str, value) -> None:
        """Set an attribute; only a different value makes the filter execute again."""
        if getattr(self, name) != value:
            setattr(self, name, value)
            self.Modified()


class SegmentationFilter(_ImageFilter):
    """From an MRI or a CT (port 0), and a mask of the brain or patient (port 1, optional), to uint8 tissue labels.

    Tissues can be laid over the labels from masks (AddTissueData).

    The names of the labels are field data "TissueNames" of the output, from which UltrasoundSimulationFilter identifies
    the tissues. Parameters and defaults as in SegmentationSettings, errors as in modality.segment_image.
    """

    def __init__(self) -> None:
        super().__init__(nInputPorts=2)
        self._settings = SegmentationSettings()
        self._segmentation: Segmentation | CtSegmentation | None = None
        self._others: dict[str, vtkImageData] = {}
        self._added: tuple[tuple[str, vtkImageData], ...] = ()
        self._notes: tuple[str, ...] = ()
        self._warnings: tuple[str, ...] = ()

    def SetSettings(self, settings: SegmentationSettings) -> None:
        """What is segmented and how; by default what SegmentationSettings has."""
        require_kind("settings", settings, SegmentationSettings)
        self._change("_settings", settings)

    GetSettings = _getter("_settings", "The SegmentationSettings.")
    GetOtherData = _getter("_others", "{contrast: vtkImageData} of the other MRIs.")
    GetAddedTissues = _getter("_added", "(tissue, vtkImageData) of all that is laid over the labels, the last on top.")
    GetNotes = _getter("_notes", "What the last update recognised and decided, one line each.")
    GetWarnings = _getter("_warnings", "What should be checked after the last update, one line each.")
    GetSegmentation = _getter("_segmentation", "Segmentation or CtSegmentation of the last update, with its texture.")

    def SetOtherData(self, contrast: str, image: vtkImageData | None) -> None:
        """Another MRI of the same patient, on any grid, to classify together with the first; None removes it.

        The image is not observed: call Modified() of the filter after changing it.
        """
        others = {name: other for name, other in self._others.items() if name != contrast}
        self._change("_others", others if image is None else {**others, contrast: image})

    def AddTissueData(self, tissue: str, mask: vtkImageData) -> None:
        """Lay a tissue over the labels where a mask on any grid is not 0, the last on top; see mri.add_tissue.

        The image is not observed: call Modified() of the filter after changing it.
        """
        self._change("_added", (*self._added, (tissue, mask)))

    def RemoveAddedTissues(self) -> None:
        """Undo AddTissueData."""
        self._change("_added", ())

    def SetMaskData(self, mask: vtkImageData | None) -> None:
        """A mask of the brain or patient on the MRI's grid, non-zero inside; or SetInputConnection(1, port)."""
        self.SetInputDataObject(1, mask)

    def GetMaskData(self) -> vtkImageData | None:
        """The mask, or None."""
        return self.GetInputDataObject(1, 0)

    def FillInputPortInformation(self, port, info):
        super().FillInputPortInformation(port, info)
        if port == 1:
            info.Set(vtkAlgorithm.INPUT_IS_OPTIONAL(), 1)
        return 1

    def RequestInformation(self, request, inInfo, outInfo):  # noqa: N803
        mri, labels = inInfo[0].GetInformationObject(0), outInfo.GetInformationObject(0)
        for key in (_WHOLE_EXTENT(), vtkDataObject.SPACING(), vtkDataObject.ORIGIN(), vtkDataObject.DIRECTION()):
            if mri.Has(key):
                labels.CopyEntry(mri, key)
        vtkDataObject.SetPointDataActiveScalarInfo(labels, VTK_UNSIGNED_CHAR, 1)
        return 1

    def RequestData(self, request, inInfo, outInfo):  # noqa: N803
        self._segmentation, self._notes, self._warnings = None, (), ()
        mri = vtkImageData.GetData(inInfo[0])
        masked = inInfo[1].GetNumberOfInformationObjects() > 0
        masks = [(tissue, Volume.from_vtk(image), f"the mask of {tissue}") for tissue, image in self._added]
        image, mask = Volume.from_vtk(mri), Volume.from_vtk(vtkImageData.GetData(inInfo[1])) if masked else None
        settings, others = self._settings, self._others.items()
        is_of_brain = has_brain_mask(settings.contrast)
        found = segment_image(
            image, settings, others={name: Volume.from_vtk(other) for name, other in others}, mask=mask,
            device=self._device, progress=self._report,
        )  # fmt: skip
        output = vtkImageData.GetData(outInfo)
        output.CopyStructure(mri)
        added = add_tissues(found.labels, found.tissue_names, masks, has_brain_mask=is_of_brain)
        set_scalars(output, added.labels.array)
        set_tissue_names(output, added.tissue_names)
        self._segmentation = found
        self._notes = (*found.notes, *added.messages)
        self._warnings = tuple(map(_by_methods, (*found.warnings, *added.warnings)))
        return 1

    def _fail(self, message: str) -> None:
        super()._fail(_by_methods(message))

    def _report(self, share: float) -> None:
        self.UpdateProgress(share)
        if self.CheckAbort():
            raise Cancelled


def _by_methods(message: str) -> str:
    """A message with the filter's methods in place of the command's options."""
    for option, method in _METHODS:
        message = message.replace(option, method)
    return message


class UltrasoundSimulationFilter(_ImageFilter):
    """From tissue labels (port 0) to the B-mode image (output 0) and the outline of the imaged field (output 1).

    The image is one slice in the image plane. The filter executes again only if the labels, the probe's transform
    (including transforms from which it is concatenated) or a parameter has changed. Amplifier noise differs between
    poses (noise.seed_of_pose). Labels are identified by the names from SegmentationFilter (field data "TissueNames");
    without names, by the labels of the table that SetTissues or SetPreset gave; without one, or with labels that it
    lacks, by what they are (tissue.read_label_map): numbers of a known program. A mask or a tumour alone is an error
    then. Between skin and probe the coupling medium fills any gap, unless the settings have a contact_gap_mm.

    >>> import numpy as np
    >>> from vtkmodules.vtkCommonTransforms import vtkTransform
    >>> from SlicerUSSim.Logic import LinearProbe, TissueTable, Volume
    >>> from SlicerUSSim.Logic.vtk import UltrasoundSimulationFilter
    >>> labels = Volume(np.ones((40, 40, 40), np.uint8), np.eye(4))
    >>> simulation = UltrasoundSimulationFilter()
    >>> simulation.SetInputData(labels.to_vtk())
    >>> simulation.SetTissues(TissueTable.named(["liver"]))
    >>> simulation.SetProbe(LinearProbe(width_mm=20, depth_mm=30, scan_lines=64))
    >>> transform = vtkTransform()  # the face in the middle of the upper side, looking down
    >>> transform.Translate(20, 20, 39)
    >>> transform.RotateX(-90)
    >>> simulation.SetProbeTransform(transform)
    >>> simulation.Update()
    >>> simulation.GetOutput().GetDimensions()
    (342, 512, 1)
    """

    def __init__(self) -> None:
        # Port 1 is internal: the outline, moved by the probe's transform. The pipeline therefore detects every movement
        # of the probe, also by a transform within a chain of transforms, and no observer can outlive the filter.
        super().__init__(nInputPorts=2, nOutputPorts=2)
        preset = Preset()
        self._probe, self._display, self._settings = preset.probe, preset.display, preset.settings
        self._tissues, self._texture = preset.tissues, None
        self._are_numbered = False  # whether the table has the labels of the label image
        self._field_alpha = False
        self._probe_transform: vtkLinearTransform | vtkMatrix4x4 = vtkTransform()  # as it was given
        self._simulator = ReusedSimulator()
        self._frame: Frame | None = None
        self._read: tuple[tuple, tuple[Volume, TissueTable]] | None = None  # labels without names, and their version
        self._sheets_data: vtkPolyData | None = None
        self._sheets: tuple[tuple, Surfels] | None = None  # with the version of their surface
        self._placed_outline = vtkTransformPolyDataFilter()
        self._placed_outline.SetInputData(outline_polydata(self._probe))
        self._placed_outline.SetTransform(self._probe_transform)
        self.SetInputConnection(1, self._placed_outline.GetOutputPort())

    def SetProbe(self, probe: Probe) -> None:
        """A LinearProbe, ConvexProbe or PhasedProbe."""
        require_kind("probe", probe, Probe, "PROBES has typical ones")
        if probe != self._probe:
            self._placed_outline.SetInputData(outline_polydata(probe))
        self._change("_probe", probe)

    def SetProbeTransform(self, transform: vtkLinearTransform | vtkMatrix4x4) -> None:
        """Set the pose of the probe, probe_to_ras. The object is observed, not copied.

        Raises SimulationError for objects other than a vtkLinearTransform or a vtkMatrix4x4.
        """
        require(
            isinstance(transform, vtkLinearTransform | vtkMatrix4x4),
            f"probe transform is a {type(transform).__name__}, expected a vtkLinearTransform or a vtkMatrix4x4",
        )
        if transform is self._probe_transform:
            return
        self._change("_probe_transform", transform)
        if isinstance(transform, vtkMatrix4x4):
            matrix, transform = transform, vtkMatrixToLinearTransform()
            transform.SetInput(matrix)
        self._placed_outline.SetTransform(transform)

    GetProbe = _getter("_probe", "The probe.")
    GetProbeTransform = _getter("_probe_transform", "The object that was given as the probe's pose.")
    GetTissues = _getter("_tissues", "Acoustic parameters of the labels.")
    GetSettings = _getter("_settings", "The SimulationSettings.")
    GetDisplay = _getter("_display", "The DisplaySettings.")
    GetTexture = _getter("_texture", "The texture, or None.")
    GetSheetsData = _getter("_sheets_data", "The surface of thin sheets, or None.")
    GetFieldAlpha = _getter("_field_alpha", "Whether the image has an alpha component.")

    def SetTissues(self, tissues: TissueTable) -> None:
        """Acoustic parameters of the labels; default: presets of the brain, for labels that have names or are known."""
        require_kind("tissues", tissues, TissueTable, "TissueTable.brain makes one")
        self._change("_tissues", tissues)
        self._change("_are_numbered", True)

    def SetSettings(self, settings: SimulationSettings) -> None:
        """Settings of the physical model."""
        require_kind("settings", settings, SimulationSettings)
        self._change("_settings", settings)

    def SetDisplay(self, display: DisplaySettings) -> None:
        """Gain, dynamic range, time gain compensation, noise, image size."""
        require_kind("display", display, DisplaySettings)
        self._change("_display", display)

    def SetPreset(self, preset: Preset) -> None:
        """Probe, display, settings and tissues at once."""
        self.SetProbe(preset.probe)
        self.SetDisplay(preset.display)
        self.SetSettings(preset.settings)
        self.SetTissues(preset.tissues)

    def GetPreset(self) -> Preset:
        """Probe, display, settings and tissues."""
        return Preset(self._probe, self._display, self._settings, self._tissues)

    def SetTexture(self, texture: Texture | None) -> None:
        """Texture from the MRI (Segmentation.texture), which UltrasoundSimulator.from_mri also takes; default: none."""
        self._change("_texture", texture)

    def SetSheetsData(self, surface: vtkPolyData | None) -> None:
        """Thin sheets (falx, tentorium, sulci, walls of ventricles) as `ussim segment --sheets` writes them to a .vtp.

        They replace the lines of the labels where they are; None: the lines of the labels. They consist of the table's
        membrane; without a membrane none are drawn. The surface is not observed: call Modified() of the filter after
        changing it. An update raises an error for any other surface.
        """
        self._change("_sheets_data", surface)

    def SetFieldAlpha(self, on: bool) -> None:
        """Add an alpha component to the image, 255 in the imaged field and 0 outside, for overlays; default off."""
        self._change("_field_alpha", bool(on))

    def GetFrame(self) -> Frame | None:
        """The frame of the last update: RF, envelope, image, pose; None after an error."""
        return self._frame if self.GetOutput().GetNumberOfPoints() else None

    def FillInputPortInformation(self, port, info):
        info.Set(vtkAlgorithm.INPUT_REQUIRED_DATA_TYPE(), ("vtkImageData", "vtkPolyData")[port])
        return 1

    def FillOutputPortInformation(self, port, info):
        info.Set(vtkDataObject.DATA_TYPE_NAME(), ("vtkImageData", "vtkPolyData")[port])
        return 1

    def RequestInformation(self, request, inInfo, outInfo):  # noqa: N803
        grid = ImageGrid.for_probe(self._probe, self._display.image_size)
        pose = self._pose()
        slice_to_ras = pose @ grid.slice_to_probe
        info = outInfo.GetInformationObject(0)
        info.Set(_WHOLE_EXTENT(), (0, grid.columns - 1, 0, grid.rows - 1, 0, 0), 6)
        info.Set(vtkDataObject.SPACING(), tuple(np.linalg.norm(slice_to_ras[:3, :3], axis=0)), 3)
        info.Set(vtkDataObject.ORIGIN(), tuple(slice_to_ras[:3, 3]), 3)
        info.Set(vtkDataObject.DIRECTION(), tuple(pose[:3, :3].ravel()), 9)
        vtkDataObject.SetPointDataActiveScalarInfo(info, VTK_UNSIGNED_CHAR, 2 if self._field_alpha else 1)
        return 1

    def RequestData(self, request, inInfo, outInfo):  # noqa: N803
        self._frame = None
        labels = vtkImageData.GetData(inInfo[0])
        (volume, tissues), sheets = self._patient(labels), self._read_sheets()
        tissues = with_their_tissue(tissues, sheets, self._tissues)
        simulator = self._simulator.get(
            labels.GetMTime(), volume, tissues, self._settings, self._device, self._texture, sheets
        )
        pose = self._pose()
        self._frame = simulator.simulate(self._probe, pose, self._display, noise_seed=seed_of_pose(pose))
        image = vtkImageData.GetData(outInfo, 0)
        image.ShallowCopy(self._frame.to_vtk())
        if self._field_alpha:
            field = self._frame.grid.field(self._probe)
            set_scalars(image, np.stack([self._frame.image, np.where(field, np.uint8(255), np.uint8(0))], axis=-1))
        vtkPolyData.GetData(outInfo, 1).ShallowCopy(vtkPolyData.GetData(inInfo[1]))
        return 1

    def _patient(self, labels: vtkImageData) -> tuple[Volume, TissueTable]:
        """The labels and their tissues: by names, by a table that was given for them, or by what they are."""
        names = tissue_names(labels)
        if names:
            return Volume.from_vtk(labels), self._tissues.for_names(names)
        key = (labels.GetMTime(), self._tissues, self._are_numbered)
        if self._read is None or self._read[0] != key:  # once for an image, and not for each pose
            self._read = (key, self._identified(labels))
        return self._read[1]

    def _identified(self, labels: vtkImageData) -> tuple[Volume, TissueTable]:
        """The labels without names, and their tissues."""
        volume = Volume.from_vtk(labels)
        is_numbered = self._are_numbered and labels.GetScalarRange()[1] <= MAX_LABEL
        if is_numbered and all(int(label) in self._tissues for label in np.unique(volume.array)):
            return volume, self._tissues
        try:
            found = read_label_map(volume, source="label image", tissues=self._tissues)
        except SimulationError:
            if is_numbered:  # the simulator names the labels that the table lacks
                return volume, self._tissues
            raise
        _log.info("label image: %s", found.message)
        for warning in found.warnings:
            _log.warning("%s", warning)
        return found.labels, found.tissues

    def _read_sheets(self) -> Surfels | None:
        """The sheets; the same object as long as the surface is the same."""
        if self._sheets_data is None:
            return None
        key = (self._sheets_data, self._sheets_data.GetMTime())
        if self._sheets is None or self._sheets[0] != key:
            self._sheets = key, placed_surfels(self._sheets_data, "sheets")
        return self._sheets[1]

    def _pose(self) -> np.ndarray:
        return check_rigid("probe transform", matrix_array(self._placed_outline.GetTransform().GetMatrix()))


def set_tissue_names(image: vtkImageData, names) -> None:
    """Store the names of labels 1, 2, ... in the field data of a label image."""
    array = vtkStringArray()
    array.SetName(TISSUE_NAMES)
    for name in names:
        array.InsertNextValue(name)
    image.GetFieldData().AddArray(array)


def tissue_names(image: vtkImageData) -> tuple[str, ...]:
    """The names stored by set_tissue_names; empty if there are none."""
    array = image.GetFieldData().GetAbstractArray(TISSUE_NAMES)
    return () if array is None else tuple(array.GetValue(n) for n in range(array.GetNumberOfValues()))
