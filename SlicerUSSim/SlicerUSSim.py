"""What 3D Slicer loads: module, widget, logic and test of the scripted module SlicerUSSim.

Slicer runs this file under the name `SlicerUSSim`, which is also the package around it. So the file makes itself that
package: `from SlicerUSSim.Logic import ...` works here as it does after pip. What the module does is in Logic and
Widget; this file is the part that only exists inside Slicer.
"""

import os
import sys
from importlib.metadata import PackageNotFoundError, version
from typing import Annotated

import slicer
import vtk
from slicer import (
    vtkMRMLLinearTransformNode,
    vtkMRMLModelNode,
    vtkMRMLNode,
    vtkMRMLScalarVolumeNode,
)
from slicer.i18n import tr as _, translate
from slicer.parameterNodeWrapper import Choice, WithinRange, parameterNodeWrapper
from slicer.ScriptedLoadableModule import (
    ScriptedLoadableModule,
    ScriptedLoadableModuleLogic,
    ScriptedLoadableModuleTest,
    ScriptedLoadableModuleWidget,
)
from slicer.util import VTKObservationMixin

if sys.version_info < (3, 10):  # noqa: UP036, Slicer runs this file whatever its Python is
    raise RuntimeError(f"SlicerUSSim needs Slicer 5.10 or newer: Python 3.10, and this is {sys.version.split()[0]}")

__path__ = [os.path.dirname(os.path.abspath(__file__))]
# "Reload" runs this file again; the rest of the package has to be new then too.
for _name in [name for name in sys.modules if name.startswith("SlicerUSSim.")]:
    del sys.modules[_name]

# Slicer runs this file at start-up; what takes time to import is imported when the module is first used.

_HOME = "https://github.com/SlicerUSSim/SlicerUSSim"


class SlicerUSSim(ScriptedLoadableModule):
    """The module as Slicer lists it."""

    def __init__(self, parent) -> None:
        ScriptedLoadableModule.__init__(self, parent)
        self.parent.title = _("Ultrasound Simulator")
        self.parent.categories = [translate("qSlicerAbstractCoreModule", "Ultrasound")]
        self.parent.dependencies = []
        self.parent.contributors = ["The SlicerUSSim developers"]
        self.parent.helpText = _(
            "Simulates the B-mode image that an ultrasound probe would see in a patient, from the patient's MRI: "
            "choose a skull-stripped MRI, press Segment, tick Live, and move the probe. See the "
            '<a href="{home}/blob/main/docs/slicer.md">documentation</a>.'
        ).format(home=_HOME)
        self.parent.acknowledgementText = _(
            "Implements Salehi et al., Patient-specific 3D Ultrasound Simulation Based on Convolutional Ray-tracing "
            "and Appearance Optimization, MICCAI 2015. The sample MRI is the ICBM 152 2009a template (© 1993-2009 "
            "Louis Collins, McConnell Brain Imaging Centre, Montreal Neurological Institute), as nilearn carries it."
        )
        slicer.app.connect("startupCompleted()", registerSampleData)


def registerSampleData() -> None:
    """Add the demo brain to Slicer's Sample Data module."""
    import SampleData

    SampleData.SampleDataLogic.registerCustomSampleDataSource(
        category="Ultrasound Simulator",
        sampleName="MNI152 brain",
        thumbnailFileName=os.path.join(__path__[0], "Resources", "Icons", "MNI152Brain.png"),
        uris="https://raw.githubusercontent.com/nilearn/nilearn/59fffa24b81712132c78549c242f68d0f3db8a67/"
        "nilearn/datasets/data/mni_icbm152_t1_tal_nlin_sym_09a_converted.nii.gz",
        fileNames="mni_icbm152_t1_brain.nii.gz",
        checksums="SHA256:421a10e872fd6cadae7f61d358dffbcc1795a497d61ee76c5dda2503e1a1e9e6",
        nodeNames="MNI152 brain",
    )


def ensurePackages() -> None:
    """Install what Slicer's Python lacks, after asking; on first use, not at start-up.

    Raises RuntimeError if the user declines, and what pip raises if it fails.
    """
    requirements = os.path.join(__path__[0], "Resources", "requirements.txt")
    try:
        from slicer.packaging import load_requirements, pip_ensure
    except ImportError:  # before Slicer 5.11
        _install_missing(requirements)
    else:
        pip_ensure(load_requirements(requirements), requester="SlicerUSSim")


def _install_missing(path: str) -> None:
    from packaging.requirements import Requirement

    with open(path, encoding="utf-8") as file:
        wanted = [Requirement(line.strip()) for line in file if line.strip() and not line.startswith("#")]
    missing = []
    for requirement in wanted:
        try:
            here = requirement.specifier.contains(version(requirement.name), prereleases=True)
        except PackageNotFoundError:
            here = False
        if not here and (requirement.marker is None or requirement.marker.evaluate()):
            missing.append(f"{requirement.name}{requirement.specifier}")
    if not missing:
        return
    question = _("SlicerUSSim needs these Python packages: {names}. Install them now?").format(names=", ".join(missing))
    if not slicer.util.confirmOkCancelDisplay(question):
        raise RuntimeError("the installation was declined")
    slicer.util.pip_install(missing)


@parameterNodeWrapper
class SlicerUSSimParameterNode:
    """What a scene remembers of the module; the names are those of Logic/mrml/parameter_node.py.

    mask and labels may be label maps or segmentations, real a sequence or a volume, which the panel sees to.
    """

    mri: vtkMRMLScalarVolumeNode
    mask: vtkMRMLNode
    labels: vtkMRMLNode
    probe_transform: vtkMRMLLinearTransformNode
    output: vtkMRMLScalarVolumeNode
    outline: vtkMRMLModelNode
    real: vtkMRMLNode
    contrast: Annotated[str, Choice(["t1", "t1gd", "t2", "flair"])] = "t1"
    classes: Annotated[int, WithinRange(3, 4)] = 3
    thin_sulci: bool = True
    bias_correction: bool = False
    show_in_slice: bool = True
    preset: str = ""
    fit_frames: str = ""
    fit_free: str = "display, white matter"
    fit_estimate: bool = False
    fit_register: bool = False
    fit_evaluations: int = 500


class SlicerUSSimWidget(ScriptedLoadableModuleWidget, VTKObservationMixin):
    """The panel's life in Slicer: it shows the parameters of the scene that is open."""

    def __init__(self, parent=None) -> None:
        ScriptedLoadableModuleWidget.__init__(self, parent)
        VTKObservationMixin.__init__(self)
        self.logic = None
        self.panel = None
        self._parameterNode = None
        self._parameterNodeGuiTag = None

    def setup(self) -> None:
        """Called when the user opens the module for the first time."""
        ScriptedLoadableModuleWidget.setup(self)
        try:
            from SlicerUSSim.Widget.panel import Panel
        except ImportError:  # a Slicer without scipy
            ensurePackages()
            from SlicerUSSim.Widget.panel import Panel
        widget = slicer.util.loadUI(self.resourcePath("UI/SlicerUSSim.ui"))
        self.layout.addWidget(widget)
        self.ui = slicer.util.childWidgetVariables(widget)
        widget.setMRMLScene(slicer.mrmlScene)
        self.logic = SlicerUSSimLogic()
        self.initializeParameterNode()
        self.panel = Panel(self.ui, self.logic.ultrasound, ensurePackages)
        self.panel.presenter.chooseDefaultNodes()
        self.addObserver(slicer.mrmlScene, slicer.mrmlScene.StartCloseEvent, self.onSceneStartClose)
        self.addObserver(slicer.mrmlScene, slicer.mrmlScene.EndCloseEvent, self.onSceneEndClose)

    def cleanup(self) -> None:
        """Called when the application closes or the module is reloaded."""
        if self.logic is not None:
            self.logic.ultrasound.stopLiveUpdate()
        self.setParameterNode(None)
        self.removeObservers()

    def enter(self) -> None:
        """Called each time the user opens this module."""
        self.initializeParameterNode()

    def exit(self) -> None:
        """Called each time the user opens another module; live update goes on."""
        self.setParameterNode(None)

    def onSceneStartClose(self, caller, event) -> None:
        """Called just before the scene is closed."""
        self.setParameterNode(None)

    def onSceneEndClose(self, caller, event) -> None:
        """Called just after the scene is closed."""
        if self.parent.isEntered:
            self.initializeParameterNode()

    def initializeParameterNode(self) -> None:
        """Make sure that the scene has a parameter node and that the panel shows it."""
        self.setParameterNode(self.logic.getParameterNode())
        if self.panel is not None:
            self.panel.presenter.chooseDefaultNodes()

    def setParameterNode(self, parameterNode) -> None:  # noqa: N803, as in Slicer's template
        """Show and observe another parameter node, or none."""
        if self._parameterNode is not None:
            self._parameterNode.disconnectGui(self._parameterNodeGuiTag)
            self.removeObserver(self._parameterNode, vtk.vtkCommand.ModifiedEvent, self.onParametersModified)
        self._parameterNode = parameterNode
        if self._parameterNode is not None:
            self._parameterNodeGuiTag = self._parameterNode.connectGui(self.ui)
            self.addObserver(self._parameterNode, vtk.vtkCommand.ModifiedEvent, self.onParametersModified)
            self.onParametersModified()

    def onParametersModified(self, caller=None, event=None) -> None:
        """Show what the parameters now are."""
        if self.panel is not None:
            self.panel.presenter.parametersChanged()


class SlicerUSSimLogic(ScriptedLoadableModuleLogic):
    """`ultrasound` does everything (see Logic/mrml/logic.py); this class gives it to Slicer.

    In scripts: logic = slicer.util.getModuleLogic("SlicerUSSim").ultrasound
    """

    def __init__(self) -> None:
        ScriptedLoadableModuleLogic.__init__(self)
        from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic

        self.ultrasound = UltrasoundSceneLogic(slicer.mrmlScene)

    def getParameterNode(self):
        """The parameters of the scene, typed."""
        return SlicerUSSimParameterNode(super().getParameterNode())


class SlicerUSSimTest(ScriptedLoadableModuleTest):
    """The whole way in Slicer: phantom head, Segment, place, Live."""

    def setUp(self) -> None:
        slicer.mrmlScene.Clear()

    def runTest(self) -> None:
        self.setUp()
        self.test_image_follows_probe()

    def test_image_follows_probe(self) -> None:
        """An image appears under the probe and follows it."""
        try:
            ensurePackages()
        except RuntimeError as error:  # in testing mode Slicer installs nothing
            self.skipTest(str(error))
        from SlicerUSSim.Logic.mri.samples import head_mri

        self.delayDisplay("Make a head")
        mri = head_mri(2.0)
        node = slicer.util.addVolumeFromArray(mri.array, mri.ijk_to_ras, "Head")
        logic = SlicerUSSimLogic().ultrasound
        labels = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSegmentationNode", "Tissues")
        probe = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "Probe")
        output = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "Ultrasound")

        self.delayDisplay("Segment")
        logic.segment(node, labels)
        self.assertEqual(labels.GetSegmentation().GetNumberOfSegments(), 4)

        self.delayDisplay("Simulate")
        logic.placeProbe(labels, probe)
        logic.startLiveUpdate(labels, probe, output)
        before = slicer.util.arrayFromVolume(output).copy()
        self.assertGreater(before.mean(), 5)

        self.delayDisplay("Move the probe")
        moved = vtk.vtkTransform()
        moved.SetMatrix(probe.GetMatrixTransformToParent())
        moved.Translate(0, 0, 5)
        probe.SetMatrixTransformToParent(moved.GetMatrix())
        self.assertTrue((slicer.util.arrayFromVolume(output) != before).mean() > 0.1)
        logic.stopLiveUpdate()
        self.assertFalse(logic.isLive)
        self.delayDisplay("Test passed")
