"""The scripted module USSim of 3D Slicer: its module, widget, logic and test classes.

The implementation is in the package SlicerUSSim, in Logic and Widget. This file is the part that needs the Slicer
application.
"""

import functools
import importlib.machinery
import importlib.util
import logging
import sys
import unittest
from pathlib import Path
from typing import Annotated

import qt
import slicer
import vtk
from slicer.i18n import tr as _, translate
from slicer.parameterNodeWrapper import Choice, WithinRange, parameterNodeWrapper
from slicer.ScriptedLoadableModule import (
    ScriptedLoadableModule,
    ScriptedLoadableModuleLogic,
    ScriptedLoadableModuleTest,
    ScriptedLoadableModuleWidget,
)
from slicer.util import VTKObservationMixin

if sys.version_info < (3, 10):  # noqa: UP036, older versions of Slicer can also load this file
    raise RuntimeError(f"USSim needs Python 3.10 (Slicer 5.10) or newer, but this is Python {sys.version.split()[0]}")

_HERE = Path(__file__).absolute().parent
_RESOURCES = _HERE / "Resources"
_REQUIREMENTS = _RESOURCES / "USSim" / "requirements.txt"
_HOME = "https://github.com/SlicerUSSim/SlicerUSSim"


def bindPackage() -> None:
    """Bind the name `SlicerUSSim` to the package to which this file belongs.

    Slicer adds only the folder of this file to sys.path. The package is a folder next to this file in a build tree of
    CMake. In a checkout, and after installation with pip, it is the folder of this file, under any name. Modules that
    were already imported, from another copy or from before a "Reload", are removed from sys.modules.
    """
    beside = _HERE / "SlicerUSSim"
    spec = importlib.machinery.ModuleSpec("SlicerUSSim", loader=None, is_package=True)
    spec.submodule_search_locations = [str(beside if (beside / "Logic").is_dir() else _HERE)]
    for name in [name for name in sys.modules if name.split(".")[0] == "SlicerUSSim"]:
        del sys.modules[name]
    sys.modules["SlicerUSSim"] = importlib.util.module_from_spec(spec)


bindPackage()

# Slicer's log includes DEBUG messages by default, which would be several lines for each live image.
if logging.getLogger("SlicerUSSim").level == logging.NOTSET:
    logging.getLogger("SlicerUSSim").setLevel(logging.INFO)

# Slicer runs this file at start-up. Imports that take time are therefore postponed until the module is first used.


class USSim(ScriptedLoadableModule):
    """The module's entry in Slicer's list of modules."""

    def __init__(self, parent) -> None:
        ScriptedLoadableModule.__init__(self, parent)
        self.parent.title = _("Ultrasound Simulator")
        self.parent.categories = [translate("qSlicerAbstractCoreModule", "Ultrasound")]
        self.parent.dependencies = []
        self.parent.contributors = ["The SlicerUSSim developers"]
        self.parent.helpText = _(
            "Simulates the B-mode image of an ultrasound probe from the MRI of a patient. "
            "Choose an MRI of a head or a brain, press Segment, tick Live, and move the probe. See the "
            '<a href="{home}/blob/main/docs/slicer.md">documentation</a>.'
        ).format(home=_HOME)
        self.parent.acknowledgementText = _(
            "Implements Salehi et al., Patient-specific 3D Ultrasound Simulation Based on Convolutional Ray-tracing "
            "and Appearance Optimization, MICCAI 2015. The sample brain and the brain atlas are the ICBM 152 2009a "
            "template (© 1993-2009 Louis Collins, McConnell Brain Imaging Centre, Montreal Neurological Institute). "
            "The sample head is MRHead, a sample of 3D Slicer."
        )
        slicer.app.connect("startupCompleted()", registerSampleData)


def registerSampleData() -> None:
    """Add a skull-stripped brain and a whole head to Slicer's Sample Data module."""
    import SampleData

    head = "cc211f0dfd9a05ca3841ce1141b292898b2dd2d3f08286affadf823a7e58df93"
    SampleData.SampleDataLogic.registerCustomSampleDataSource(
        category="Ultrasound Simulator",
        sampleName="Whole head (MRHead)",  # Slicer's own sample
        thumbnailFileName=str(Path(SampleData.__file__).parent / "Resources" / "Icons" / "MRHead.png"),
        uris=f"https://github.com/Slicer/SlicerTestingData/releases/download/SHA256/{head}",
        fileNames="MRHead.nrrd",
        checksums=f"SHA256:{head}",
        nodeNames="MRHead",
    )
    SampleData.SampleDataLogic.registerCustomSampleDataSource(
        category="Ultrasound Simulator",
        sampleName="MNI152 brain",
        thumbnailFileName=str(_RESOURCES / "USSim" / "MNI152Brain.png"),
        uris="https://raw.githubusercontent.com/nilearn/nilearn/59fffa24b81712132c78549c242f68d0f3db8a67/"
        "nilearn/datasets/data/mni_icbm152_t1_tal_nlin_sym_09a_converted.nii.gz",
        fileNames="mni_icbm152_t1_brain.nii.gz",
        checksums="SHA256:421a10e872fd6cadae7f61d358dffbcc1795a497d61ee76c5dda2503e1a1e9e6",
        nodeNames="MNI152 brain",
    )


def ensurePackages() -> None:
    """Install the packages that Slicer's Python lacks, after the user has confirmed; on first use, not at start-up.

    Raises SimulationError if packages are still missing.
    """
    from SlicerUSSim.Widget.packages import ensure_packages

    ensure_packages(_REQUIREMENTS)


@functools.cache
def makeParameterNodeClass() -> type:
    """USSimParameterNode: the parameters of a scene, typed, as declared in Logic/mrml/parameter_node.py.

    Roles that allow several classes of nodes have the type vtkMRMLNode. Values that may be None are omitted, since
    Slicer stores them in another format. The class is created on first use, because the declarations import packages
    that may not be installed before.
    """
    from SlicerUSSim.Logic.mrml.parameter_node import NODE_PARAMETERS, VALUE_PARAMETERS

    types, defaults = {}, {}
    for role, classes in NODE_PARAMETERS.items():
        types[role] = getattr(slicer, classes[0] if len(classes) == 1 else "vtkMRMLNode")
    for name, entry in VALUE_PARAMETERS.items():
        if entry.can_be_none:
            continue
        types[name], defaults[name] = entry.type, entry.default
        if entry.choices:
            types[name] = Annotated[entry.type, Choice(list(entry.choices))]
        elif entry.bounds is not None:
            types[name] = Annotated[entry.type, WithinRange(*entry.bounds)]
    body = {"__module__": __name__, "__doc__": "Parameters of USSim.", "__annotations__": types, **defaults}
    return parameterNodeWrapper(type("USSimParameterNode", (), body))


def __getattr__(name: str):
    if name == "USSimParameterNode":
        return makeParameterNodeClass()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


class USSimWidget(ScriptedLoadableModuleWidget, VTKObservationMixin):
    """Creates the panel, and connects it to the parameter node of the open scene."""

    def __init__(self, parent=None) -> None:
        ScriptedLoadableModuleWidget.__init__(self, parent)
        VTKObservationMixin.__init__(self)
        self.logic = None
        self.panel = None
        self.devices = None
        self._parameterNode = None

    def setup(self) -> None:
        """Called when the user opens the module for the first time."""
        ScriptedLoadableModuleWidget.setup(self)
        try:
            self.showPanel()
        except ImportError:  # packages that the panel itself needs are missing
            self.installButton = qt.QPushButton(_("Install the Python packages that this module needs"))
            self.installButton.clicked.connect(self.onInstall)
            self.layout.addWidget(self.installButton)
            self.onInstall()

    def onInstall(self, *_unused) -> None:
        """Offer to install the packages; show the panel if they are installed."""
        from SlicerUSSim.Logic.base.errors import SimulationError

        try:
            ensurePackages()
        except SimulationError as error:
            slicer.util.errorDisplay(str(error))
            return
        self.installButton.setVisible(False)
        self.showPanel()

    def showPanel(self) -> None:
        """Create the panel. Raises ImportError if a package is missing."""
        from SlicerUSSim.Widget.device_bar import DeviceBar
        from SlicerUSSim.Widget.packages import are_installed
        from SlicerUSSim.Widget.panel import Panel

        self.logic = USSimLogic()
        self.initializeParameterNode()
        widget = qt.QWidget()
        self.layout.addWidget(widget)
        column = qt.QVBoxLayout(widget)
        above = qt.QVBoxLayout()
        column.addLayout(above)
        self.panel = Panel(column, self.logic.ultrasound, self.prepare)
        self.ui = self.panel.ui
        self.devices = DeviceBar(above, self.panel.advanced, self.panel.presenter)
        if are_installed(_REQUIREMENTS):
            self.devices.begin()
        self.panel.presenter.chooseDefaultNodes()
        scene = slicer.mrmlScene
        for event in (scene.StartCloseEvent, scene.StartImportEvent):
            self.addObserver(scene, event, self.onSceneStartChange)
        self.addObserver(scene, scene.EndCloseEvent, self.onSceneEndClose)
        self.addObserver(scene, scene.EndImportEvent, self.onSceneEndChange)
        self.addObserver(scene, scene.NodeAddedEvent, self.onNodeAdded)
        self.addObserver(scene, scene.NodeAboutToBeRemovedEvent, self.onNodeAboutToBeRemoved, priority=1000.0)
        self.addObserver(scene, scene.NodeRemovedEvent, self.onNodeRemoved)

    def prepare(self) -> None:
        """Called before actions that need packages. Raises SimulationError if any are missing afterwards."""
        ensurePackages()
        if self.devices is not None:
            self.devices.begin()

    def cleanup(self) -> None:
        """Called when the application closes or the module is reloaded."""
        if self.devices is not None:
            self.devices.stop()
        if self.logic is not None:
            self.logic.ultrasound.stopLiveUpdate()
        self.setParameterNode(None)
        self.removeObservers()

    def enter(self) -> None:
        """Called each time the user opens this module."""
        self.initializeParameterNode()

    def exit(self) -> None:
        """Called each time the user opens another module; live update continues, the user's layout comes back."""
        self.setParameterNode(None)
        if self.panel is not None:
            self.panel.restoreLayout()

    def onSceneStartChange(self, caller, event) -> None:
        """Called just before the scene is closed or imported; disconnects the panel from it."""
        self.setParameterNode(None)

    def onSceneEndClose(self, caller, event) -> None:
        """Called just after the scene was closed; nodes of the next one have the IDs of those that were known."""
        if self.panel is not None:
            self.panel.presenter.forgetPatient()
        self.onSceneEndChange(caller, event)

    def onSceneEndChange(self, caller, event) -> None:
        """Called just after the scene was closed or imported; connects the panel to it."""
        if self.parent.isEntered:
            self.initializeParameterNode()

    @vtk.calldata_type(vtk.VTK_OBJECT)
    def onNodeAdded(self, caller, event, node) -> None:
        """Called after a node was added to the scene."""
        if self.panel is not None and self.panel.isConnected:
            self.panel.presenter.nodeAdded(node)

    @vtk.calldata_type(vtk.VTK_OBJECT)
    def onNodeAboutToBeRemoved(self, caller, event, node) -> None:
        """Called before node selectors see a removal; these then choose the next node."""
        if self.panel is not None:
            self.panel.nodeGoes(node)

    def onNodeRemoved(self, caller, event) -> None:
        """Called after a node was removed."""
        if self.panel is not None:
            self.panel.nodeGone()

    def initializeParameterNode(self) -> None:
        """Ensure that the scene has a parameter node and that the panel shows it."""
        if self.logic is None:
            return  # the panel could not be created yet
        # Not the typed node, which observes each of its values: addObserver would keep that of every visit.
        self.setParameterNode(self.logic.getParameterNode().parameterNode)
        if self.panel is not None:
            self.panel.presenter.chooseDefaultNodes()

    def setParameterNode(self, parameterNode) -> None:  # noqa: N803, as in Slicer's template
        """Show and observe another parameter node, or none."""
        if self._parameterNode is not None:
            self.removeObserver(self._parameterNode, vtk.vtkCommand.ModifiedEvent, self.onParametersModified)
        self._parameterNode = parameterNode
        if self.panel is not None:
            self.panel.isConnected = parameterNode is not None
        if self._parameterNode is not None:
            self.addObserver(self._parameterNode, vtk.vtkCommand.ModifiedEvent, self.onParametersModified)
            self.onParametersModified()
            if self.panel is not None:
                self.panel.refresh()  # the nodes of the scene may be others

    def onParametersModified(self, caller=None, event=None) -> None:
        """Show the current parameters."""
        if self.panel is not None:
            self.panel.presenter.parametersChanged()


class USSimLogic(ScriptedLoadableModuleLogic):
    """Provides the UltrasoundSceneLogic of the scene (Logic/mrml/logic.py) to Slicer, as `ultrasound`.

    In scripts: logic = slicer.util.getModuleLogic("USSim").ultrasound
    """

    def __init__(self) -> None:
        ScriptedLoadableModuleLogic.__init__(self)
        from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic

        self.ultrasound = UltrasoundSceneLogic(slicer.mrmlScene)

    def getParameterNode(self):
        """The parameters of the scene, typed."""
        return makeParameterNodeClass()(super().getParameterNode())


class USSimTest(ScriptedLoadableModuleTest):
    """The main workflow in Slicer: phantom head, Segment, placement of the probe, Live, a sequence, a fit."""

    def setUp(self) -> None:
        slicer.mrmlScene.Clear()

    def runTest(self) -> None:
        """Called by the SelfTests module and by Reload and Test; CTest calls the test_ methods directly."""
        self.setUp()
        try:
            self.test_from_mri_to_fit()
        except unittest.SkipTest as reason:
            self.delayDisplay(f"Test skipped: {reason}")

    def test_from_mri_to_fit(self) -> None:
        """An image appears under the probe and follows it; a path is swept; a fit finds the gain of an image.

        Skipped where packages or an OpenCL device are missing.
        """
        import numpy as np

        from SlicerUSSim.Logic.base.errors import SimulationError
        from SlicerUSSim.Logic.opencl.devices import choose_device

        try:
            ensurePackages()
            choose_device()
        except SimulationError as error:  # nothing is installed in testing mode
            self.skipTest(str(error))
        from SlicerUSSim.Logic.mri.samples import head_mri

        self.delayDisplay("Create a phantom head")
        mri = head_mri(2.0)
        node = slicer.util.addVolumeFromArray(mri.array, mri.ijk_to_ras, "Head")
        logic = USSimLogic().ultrasound
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
        moved = np.eye(4)
        moved[2, 3] = 5.0
        pose = slicer.util.arrayFromTransformMatrix(probe) @ moved
        slicer.util.updateTransformMatrixFromArray(probe, pose)
        self.assertTrue((slicer.util.arrayFromVolume(output) != before).mean() > 0.1)
        logic.stopLiveUpdate()
        self.assertFalse(logic.isLive)

        self.delayDisplay("Sweep along a line")
        path = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLMarkupsLineNode", "Path")
        for step in (-3.0, 3.0):
            path.AddControlPointWorld(*(pose[:3, 3] + [0, step, 0]))
        browser, transforms = logic.followPath(labels, path)
        images = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSequenceNode", "Images")
        self.assertGreater(logic.simulateSequence(labels, transforms, images, browser_node=browser), 4)
        volume = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "Volume")
        logic.compoundSequence(images, volume)
        self.assertGreater(slicer.util.arrayFromVolume(volume).max(), 100)

        self.delayDisplay("Fit the gain")
        logic.simulate(labels, probe, output)
        given = logic.preset.display.gain_db
        logic.preset = logic.preset.changed("display", gain_db=given + 6.0)
        found = logic.optimize(
            labels, output, probe_transform_node=probe, free=["gain_db"], max_evaluations=40, restarts=0
        )
        self.assertAlmostEqual(found.appearance.display.gain_db, given, delta=1.0)
        self.delayDisplay("Test passed")
