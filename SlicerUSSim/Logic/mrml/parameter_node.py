"""The choices of the Slicer module, saved with the scene.

The parameters are stored in the module's vtkMRMLScriptedModuleNode, in the format of Slicer's parameterNodeWrapper.
Scenes can therefore be exchanged between scripts and the module. Values belong to declared dataclasses
(base/declaration.py): all parameters declared there are saved.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Generic, TypeVar, overload

from SlicerUSSim.Logic.base.declaration import Declared, Parameter, Shown, parameter, parameters_of
from SlicerUSSim.Logic.base.errors import SimulationError, require
from SlicerUSSim.Logic.fitting.fit_settings import FitSettings
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mri.lesions.seeded import LESION_TISSUES
from SlicerUSSim.Logic.mri.segmentation_settings import MRI_CONTRASTS, SegmentationSettings, SheetSettings
from SlicerUSSim.Logic.placement.views import VIEWS

MODULE_NAME = "USSim"
#: Choices of PanelSettings.lesion_size, and one of lesion_as
SMALLER, LARGER = "smaller", "larger"
BY_LOOK = "by its look"
#: Choices of PanelSettings.target besides tissues
LARGEST, POINT = "largest lesion", "a point"
_OWNER = "scene"
S = TypeVar("S", bound=Declared)


@dataclass(frozen=True)
class PanelSettings(Declared):
    """Other saved choices of the panel."""

    show_in_slice: bool = parameter(
        True, "Slice view",
        "Move the slice view to the image plane and overlay the image", shown=True,
    )  # fmt: skip
    show_in_3d: bool = parameter(True, "3D", "Show the slice view with the image in the 3D views as well", shown=True)
    show_probe: bool = parameter(True, "Probe", "Show a model of the probe in the 3D views", shown=True)
    second_contrast: str = parameter(
        "none", "Second contrast", "Contrast of the second MRI of this patient",
        choices=("none", *MRI_CONTRASTS), shown=True,
    )  # fmt: skip
    gel: bool = parameter(
        True, "Gel on the skin", "Where tissues have skin and Contact gap is none, gel fills gaps of up to 3 mm, and "
        "lines without contact are dark; off: the coupling medium is everywhere", shown=True,
    )  # fmt: skip
    craniotomy_mm: float | None = parameter(
        None, "Craniotomy", "Diameter of the opening under the probe; none: as wide as its face needs",
        unit="mm", bounds=(5.0, 150.0), shown=Shown(4.0, 150.0, 1.0, none_at=4.0), can_be_none=True,
    )  # fmt: skip
    lesion_as: str = parameter(
        BY_LOOK, "Lesion is", "Tissue of the lesion at the point; by its look: as the MRI shows it",
        choices=(BY_LOOK, *LESION_TISSUES), shown=True,
    )  # fmt: skip
    lesion_size: str = parameter(
        SMALLER, "Lesion size", "smaller: to half of its contrast; larger: to the foot of its border, up to 3 mm "
        "farther out", choices=(SMALLER, LARGER), shown=True,
    )  # fmt: skip
    target: str = parameter(
        LARGEST, "Target", "Target of Plan: a lesion, the largest of a tissue, or a point in a slice view",
        choices=(LARGEST, *LESION_TISSUES, POINT), shown=True,
    )  # fmt: skip
    keep_in_opening: bool = parameter(
        False, "Keep in the opening, aimed at the target", "A moved probe stays in the opening of the approach, and "
        "looks at the target", shown=True,
    )  # fmt: skip
    view: str = parameter(
        next(iter(VIEWS)), "Standard view", "; ".join(f"{name}: {view.tip}" for name, view in VIEWS.items()),
        choices=tuple(VIEWS), shown=True,
    )  # fmt: skip
    calibration_text: str = parameter(
        "", "Or file, or numbers", "A Plus configuration (.xml), or 16 numbers of ImageToProbe by rows", shown=True
    )  # fmt: skip
    face_pixel: str = parameter(
        "", "Face in the image", "Column and row of the middle of the probe's face, such as 320 12; empty: "
        "found in the real images", shown=True,
    )  # fmt: skip
    preset_pose: bool = parameter(
        False, "Pose in presets", "Save preset also saves the pose of the probe; loading it moves the probe there",
        shown=True,
    )  # fmt: skip

    def _owner(self) -> str:
        return "panel"


class NodeParameter:
    """A node reference by role, with the classes that are allowed; None if there is no node."""

    def __init__(self, *classes: str) -> None:
        self.classes = classes

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, parameters: SceneParameters, owner: type | None = None) -> Any:
        return parameters.node.GetNodeReference(self.name)

    def __set__(self, parameters: SceneParameters, value) -> None:
        require(
            value is None or (hasattr(value, "IsA") and any(value.IsA(kind) for kind in self.classes)),
            f"scene parameter {self.name} is a {type(value).__name__}, expected {' or '.join(self.classes)}",
        )
        node = parameters.node
        was_modifying = node.StartModify()
        node.SetParameter(self.name, "")
        node.SetNodeReferenceID(self.name, None if value is None else value.GetID())
        node.EndModify(was_modifying)


class ValueParameter:
    """A declared value; an empty text in the node means the default."""

    def __init__(self, declared: Parameter) -> None:
        self.declared = declared

    def __get__(self, parameters: SceneParameters, owner: type | None = None) -> Any:
        text = parameters.node.GetParameter(self.declared.name)
        return self.declared.default if text == "" else self.declared.from_text(_OWNER, text)

    def __set__(self, parameters: SceneParameters, value) -> None:
        parameters.node.SetParameter(self.declared.name, self.declared.to_text(self.declared.checked(_OWNER, value)))


class SettingsParameter(Generic[S]):
    """The values of a declared dataclass; each is also an attribute of the owner, with a prefix."""

    def __init__(self, kind: type[S], prefix: str = "") -> None:
        self._kind, self._prefix = kind, prefix
        #: {name in the scene: declaration, under that name}
        self.values = {
            f"{prefix}{entry.name}": replace(entry, name=f"{prefix}{entry.name}") for entry in parameters_of(kind)
        }

    def __set_name__(self, owner: type, name: str) -> None:
        for value_name, declared in self.values.items():
            setattr(owner, value_name, ValueParameter(declared))

    @overload
    def __get__(self, parameters: None, owner: type) -> SettingsParameter[S]: ...

    @overload
    def __get__(self, parameters: SceneParameters, owner: type | None = None) -> S: ...

    def __get__(self, parameters: SceneParameters | None, owner: type | None = None) -> SettingsParameter[S] | S:
        if parameters is None:
            return self
        return self._kind(**{name.removeprefix(self._prefix): getattr(parameters, name) for name in self.values})

    def __set__(self, parameters: SceneParameters, settings: S) -> None:
        node = parameters.node
        was_modifying = node.StartModify()
        for name in self.values:
            setattr(parameters, name, getattr(settings, name.removeprefix(self._prefix)))
        node.EndModify(was_modifying)


def preset_texts(texts: Mapping[str, str]) -> dict[str, str]:
    """Those of a scene's {name: text} that belong to its preset, see Preset.to_texts."""
    sections = ("probe", "display", "settings", "tissues", "membrane")
    return {name: text for name, text in texts.items() if text and name.split(".")[0] in sections}


class PresetParameter:
    """Probe, display, settings and tissues; each value is a parameter, see Preset.to_texts.

    A pose is not kept.
    """

    def __get__(self, parameters: SceneParameters, owner: type | None = None) -> Preset:
        known, version = vars(parameters).get("_preset"), _version(parameters.node)
        if known is None or known[0] != version:  # all texts are read only then: images need the preset often
            texts = preset_texts(parameters.texts)
            preset = known[2] if known and known[1] == texts else Preset.from_texts(texts, "the scene's preset")
            vars(parameters)["_preset"] = version, texts, preset
        return vars(parameters)["_preset"][2]

    def __set__(self, parameters: SceneParameters, preset: Preset) -> None:
        texts = preset.to_texts()
        parameters.put_preset(texts)
        vars(parameters)["_preset"] = _version(parameters.node), texts, replace(preset, probe_to_ras=None)


def _version(node: Any) -> tuple[int, int]:
    """Changes with a node, also while its events are held back."""
    return node.GetMTime(), node.GetModifiedEventPending()


#: What SceneParameters has
_PARAMETERS = NodeParameter | ValueParameter | SettingsParameter | PresetParameter


class SceneParameters:
    """The parameters of one scene as attributes: parameters.mri, parameters.contrast = "t2", parameters.fit.register.

    Values are available one by one, under the names of VALUE_PARAMETERS, or together as the dataclass that declares
    them. Raises SimulationError for an unknown name, a value or node of the wrong type, and a value out of range.
    """

    mri = NodeParameter("vtkMRMLScalarVolumeNode")
    #: Of the same patient, with panel.second_contrast
    second_mri = NodeParameter("vtkMRMLScalarVolumeNode")
    mask = NodeParameter("vtkMRMLSegmentationNode", "vtkMRMLLabelMapVolumeNode")
    labels = NodeParameter("vtkMRMLSegmentationNode", "vtkMRMLLabelMapVolumeNode")
    #: Its segments are laid over the labels
    lesions = NodeParameter("vtkMRMLSegmentationNode")
    #: Label map of organs of a CT
    organs = NodeParameter("vtkMRMLSegmentationNode", "vtkMRMLLabelMapVolumeNode")
    #: Thin sheets that images show
    sheets = NodeParameter("vtkMRMLModelNode")
    #: Point in a lesion
    seed = NodeParameter("vtkMRMLMarkupsFiducialNode")
    #: Of a craniotomy; none: a disc under the probe
    opening = NodeParameter("vtkMRMLMarkupsNode", "vtkMRMLSegmentationNode", "vtkMRMLLabelMapVolumeNode")
    probe_transform = NodeParameter("vtkMRMLLinearTransformNode")
    #: What a tracker measures, such as ProbeToReference, and the calibration of the image, ImageToProbe
    tracked = NodeParameter("vtkMRMLLinearTransformNode")
    calibration = NodeParameter("vtkMRMLLinearTransformNode")
    output = NodeParameter("vtkMRMLScalarVolumeNode")
    outline = NodeParameter("vtkMRMLModelNode")
    real = NodeParameter("vtkMRMLSequenceNode", "vtkMRMLScalarVolumeNode")
    #: Recorded transforms, and the images simulated at them
    transform_sequence = NodeParameter("vtkMRMLSequenceNode")
    image_sequence = NodeParameter("vtkMRMLSequenceNode")
    #: Along which the probe moves on the patient
    path = NodeParameter("vtkMRMLMarkupsCurveNode", "vtkMRMLMarkupsLineNode")

    segmentation = SettingsParameter(SegmentationSettings)
    sheet = SettingsParameter(SheetSettings, "sheet_")
    fit = SettingsParameter(FitSettings, "fit_")
    panel = SettingsParameter(PanelSettings)
    preset = PresetParameter()

    def __init__(self, scene) -> None:
        object.__setattr__(self, "scene", scene)

    @property
    def node(self) -> Any:
        """The vtkMRMLScriptedModuleNode, created if the scene has none."""
        scene = self.__dict__["scene"]
        node = scene.GetSingletonNode(MODULE_NAME, "vtkMRMLScriptedModuleNode")
        if node is None:
            node = scene.CreateNodeByClass("vtkMRMLScriptedModuleNode")
            node.UnRegister(None)
            node.SetSingletonTag(MODULE_NAME)
            node.SetName(scene.GenerateUniqueName(MODULE_NAME))
            node = scene.AddNode(node)
        node.SetAttribute("ModuleName", MODULE_NAME)  # closing a scene may remove it
        return node

    @property
    def texts(self) -> dict[str, str]:
        """{name: text} of all that the node has."""
        node = self.node
        return {name: node.GetParameter(name) for name in node.GetParameterNames()}

    def put_preset(self, texts: Mapping[str, str]) -> None:
        """Set the texts of a preset as they are; one change of the node, or none."""
        node, texts = self.node, preset_texts(texts)
        was_modifying = node.StartModify()
        for name in preset_texts(self.texts).keys() - texts:
            node.UnsetParameter(name)
        for name, text in texts.items():
            node.SetParameter(name, text)
        node.EndModify(was_modifying)

    if not TYPE_CHECKING:  # type checkers use the names declared above

        def __getattr__(self, name: str):
            raise SimulationError(f"scene parameters have no {name!r}")

        def __setattr__(self, name: str, value) -> None:
            if not isinstance(vars(type(self)).get(name), _PARAMETERS):
                raise SimulationError(f"scene parameters have no {name!r}")
            object.__setattr__(self, name, value)


#: {role: allowed node classes}
NODE_PARAMETERS = {
    name: entry.classes for name, entry in vars(SceneParameters).items() if isinstance(entry, NodeParameter)
}
#: {name: declaration}
VALUE_PARAMETERS: dict[str, Parameter] = {
    name: entry.declared for name, entry in vars(SceneParameters).items() if isinstance(entry, ValueParameter)
}
