"""What the Slicer module remembers in the scene, so that a saved scene opens as it was left.

The parameters live in the module's vtkMRMLScriptedModuleNode in the same form as Slicer's parameterNodeWrapper keeps
them there. So a scene made by a script opens in the module, and the other way round.
"""

from __future__ import annotations

from SlicerUSSim.Logic.base.errors import require

MODULE_NAME = "USSim"

#: Roles of nodes, and the classes that can play them.
NODE_PARAMETERS: dict[str, tuple[str, ...]] = {
    "mri": ("vtkMRMLScalarVolumeNode",),
    "mask": ("vtkMRMLLabelMapVolumeNode", "vtkMRMLSegmentationNode"),
    "labels": ("vtkMRMLLabelMapVolumeNode", "vtkMRMLSegmentationNode"),
    "probe_transform": ("vtkMRMLLinearTransformNode",),
    "output": ("vtkMRMLScalarVolumeNode",),
    "outline": ("vtkMRMLModelNode",),
    "real": ("vtkMRMLSequenceNode", "vtkMRMLScalarVolumeNode"),
}
#: Values with their defaults; "preset" is the JSON text of a Preset, empty for the default; fit_frames are numbers of
#: images as sequence.frame_numbers reads them, empty for all; fit_free names of parameters.py, with commas between.
VALUE_PARAMETERS: dict[str, str | bool | int] = {
    "contrast": "t1",
    "classes": 3,
    "thin_sulci": True,
    "bias_correction": False,
    "show_in_slice": True,
    "preset": "",
    "fit_frames": "",
    "fit_free": "display, white matter",
    "fit_estimate": False,
    "fit_register": False,
    "fit_evaluations": 500,
}


class SceneParameters:
    """The parameters of one scene as attributes: parameters.mri, parameters.contrast = "t2".

    Raises SimulationError for a name that is none and for a value or node of the wrong type.
    """

    def __init__(self, scene) -> None:
        object.__setattr__(self, "scene", scene)

    @property
    def node(self):
        """The vtkMRMLScriptedModuleNode, made if the scene has none."""
        node = self.scene.GetSingletonNode(MODULE_NAME, "vtkMRMLScriptedModuleNode")
        if node is None:
            node = self.scene.CreateNodeByClass("vtkMRMLScriptedModuleNode")
            node.UnRegister(None)
            node.SetSingletonTag(MODULE_NAME)
            node.SetName(self.scene.GenerateUniqueName(MODULE_NAME))
            node = self.scene.AddNode(node)
        node.SetAttribute("ModuleName", MODULE_NAME)  # which closing a scene may remove
        return node

    def __getattr__(self, name: str):
        if name in NODE_PARAMETERS:
            return self.node.GetNodeReference(name)
        require(name in VALUE_PARAMETERS, f"scene parameters have no {name!r}")
        default, text = VALUE_PARAMETERS[name], self.node.GetParameter(name)
        if text == "":
            return default
        return text == "True" if isinstance(default, bool) else type(default)(text)

    def __setattr__(self, name: str, value) -> None:
        if name in NODE_PARAMETERS:
            classes = NODE_PARAMETERS[name]
            require(
                value is None or any(value.IsA(kind) for kind in classes),
                f"scene parameter {name} is a {type(value).__name__}, expected {' or '.join(classes)}",
            )
            was_modifying = self.node.StartModify()
            self.node.SetParameter(name, "")
            self.node.SetNodeReferenceID(name, None if value is None else value.GetID())
            self.node.EndModify(was_modifying)
            return
        require(name in VALUE_PARAMETERS, f"scene parameters have no {name!r}")
        kind = type(VALUE_PARAMETERS[name])
        require(isinstance(value, kind), f"scene parameter {name} is {value!r}, expected {kind.__name__}")
        self.node.SetParameter(name, str(value))
