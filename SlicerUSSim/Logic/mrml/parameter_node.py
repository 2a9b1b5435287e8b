"""What the Slicer module remembers in the scene, so that a saved scene opens as it was left.

The parameters live in the module's vtkMRMLScriptedModuleNode in the same form as Slicer's parameterNodeWrapper keeps
them there. So a scene made by a script opens in the module, and the other way round.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Generic, TypeVar

from SlicerUSSim.Logic.base.errors import SimulationError, require

MODULE_NAME = "USSim"
T = TypeVar("T", str, bool, int)


class NodeParameter:
    """A role that a node plays, and the classes that can play it; None where no node does."""

    def __init__(self, *classes: str) -> None:
        self.classes = classes

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, parameters: SceneParameters, owner: type | None = None) -> Any:
        return self if parameters is None else parameters.node.GetNodeReference(self.name)

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


class ValueParameter(Generic[T]):
    """A value with its default, which also says its type."""

    def __init__(self, default: T) -> None:
        self.default: T = default

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, parameters: SceneParameters, owner: type | None = None) -> T:
        if parameters is None:
            return self  # type: ignore[return-value], of the class: the parameter itself
        text = parameters.node.GetParameter(self.name)
        if text == "":
            return self.default
        kind: Any = type(self.default)
        try:
            return text == "True" if kind is bool else kind(text)
        except ValueError:
            raise SimulationError(f"scene parameter {self.name} is {text!r}, expected {kind.__name__}") from None

    def __set__(self, parameters: SceneParameters, value: T) -> None:
        kind = type(self.default)
        require(type(value) is kind, f"scene parameter {self.name} is {value!r}, expected {kind.__name__}")
        parameters.node.SetParameter(self.name, str(value))


class SceneParameters:
    """The parameters of one scene as attributes: parameters.mri, parameters.contrast = "t2".

    Raises SimulationError for a name that is none and for a value or node of the wrong type.
    """

    mri = NodeParameter("vtkMRMLScalarVolumeNode")
    mask = NodeParameter("vtkMRMLLabelMapVolumeNode", "vtkMRMLSegmentationNode")
    labels = NodeParameter("vtkMRMLLabelMapVolumeNode", "vtkMRMLSegmentationNode")
    probe_transform = NodeParameter("vtkMRMLLinearTransformNode")
    output = NodeParameter("vtkMRMLScalarVolumeNode")
    outline = NodeParameter("vtkMRMLModelNode")
    real = NodeParameter("vtkMRMLSequenceNode", "vtkMRMLScalarVolumeNode")
    contrast = ValueParameter("t1")
    classes = ValueParameter(3)
    thin_sulci = ValueParameter(True)
    bias_correction = ValueParameter(False)
    show_in_slice = ValueParameter(True)
    #: The JSON text of a Preset, empty for the default
    preset = ValueParameter("")
    #: Numbers of images as sequence.frame_numbers reads them, empty for all
    fit_frames = ValueParameter("")
    #: Names of fitting/parameters.py, with commas between
    fit_free = ValueParameter("display, white matter")
    fit_estimate = ValueParameter(False)
    fit_register = ValueParameter(False)
    fit_evaluations = ValueParameter(500)

    def __init__(self, scene) -> None:
        object.__setattr__(self, "scene", scene)

    @property
    def node(self) -> Any:
        """The vtkMRMLScriptedModuleNode, made if the scene has none."""
        scene = self.__dict__["scene"]
        node = scene.GetSingletonNode(MODULE_NAME, "vtkMRMLScriptedModuleNode")
        if node is None:
            node = scene.CreateNodeByClass("vtkMRMLScriptedModuleNode")
            node.UnRegister(None)
            node.SetSingletonTag(MODULE_NAME)
            node.SetName(scene.GenerateUniqueName(MODULE_NAME))
            node = scene.AddNode(node)
        node.SetAttribute("ModuleName", MODULE_NAME)  # which closing a scene may remove
        return node

    if not TYPE_CHECKING:  # a type checker knows the names

        def __getattr__(self, name: str):
            raise SimulationError(f"scene parameters have no {name!r}")

        def __setattr__(self, name: str, value) -> None:
            if name not in NODE_PARAMETERS and name not in VALUE_PARAMETERS:
                raise SimulationError(f"scene parameters have no {name!r}")
            object.__setattr__(self, name, value)


#: {role: classes of nodes that can play it}
NODE_PARAMETERS = {
    name: entry.classes for name, entry in vars(SceneParameters).items() if isinstance(entry, NodeParameter)
}
#: {name: default}
VALUE_PARAMETERS: dict[str, str | bool | int] = {
    name: entry.default for name, entry in vars(SceneParameters).items() if isinstance(entry, ValueParameter)
}
