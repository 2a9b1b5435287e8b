"""PanelPresenter: the behaviour of the panel, without Qt: one presenter for each subject.

A view calls them for each action of the user and displays their state. Views are the panel in Slicer (panel.py), the
page in the browser, and the view of the tests. Errors caused by the user are not raised, but shown in one line.
"""

from __future__ import annotations

from typing import Any

from SlicerUSSim.Logic.mrml.fitting_nodes import fits
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic
from SlicerUSSim.Logic.mrml.nodes import nodes_of_class
from SlicerUSSim.Widget.approach_presenter import ApproachPresenter
from SlicerUSSim.Widget.fit_presenter import FitPresenter
from SlicerUSSim.Widget.image_presenter import ImagePresenter
from SlicerUSSim.Widget.interface import PanelHost, PanelView
from SlicerUSSim.Widget.lesion_presenter import LesionPresenter
from SlicerUSSim.Widget.notes import Notes
from SlicerUSSim.Widget.placement_presenter import PlacementPresenter
from SlicerUSSim.Widget.segment_presenter import SegmentPresenter
from SlicerUSSim.Widget.tissue_presenter import TissuePresenter
from SlicerUSSim.Widget.tracked_presenter import TrackedPresenter
from SlicerUSSim.Widget.value_presenter import ValuePresenter


class PanelPresenter(PanelHost):
    """Operates on one scene for one view.

    With `handles`, a placed probe has Slicer's interaction handles for translation and rotation. With `label_maps`, new
    labels are label maps and not segmentations.
    """

    def __init__(
        self, logic: UltrasoundSceneLogic, view: PanelView, handles: bool = True, label_maps: bool = False
    ) -> None:
        super().__init__(logic, view)
        self.notes = Notes(self)
        self.tissues = TissuePresenter(self)
        self.segmenting = SegmentPresenter(self, self.notes, label_maps)
        self.lesions = LesionPresenter(self, self.notes, self.segmenting)
        self.placing = PlacementPresenter(self, self.notes, handles)
        self.approach = ApproachPresenter(self, self.placing)
        self.values = ValuePresenter(self, self.placing)
        self.images = ImagePresenter(self, self.notes, self.placing)
        self.fits = FitPresenter(self, self.values, self.tissues)
        self.tracking = TrackedPresenter(self)

    def chooseDefaultNodes(self) -> None:
        """Select the first volume of the scene as the MRI, if none is selected."""
        parameters = self.parameters
        if parameters.mri is not None:
            return
        for node in nodes_of_class(self.logic.scene, "vtkMRMLScalarVolumeNode"):
            if fits("mri", node) and node not in (parameters.output, parameters.real):
                parameters.mri = node
                return

    def nodeAdded(self, node: Any) -> None:
        """Called after a node was added to the scene: a volume that is loaded becomes the MRI, if none is selected."""
        if node.IsA("vtkMRMLScalarVolumeNode") and self.parameters.mri is None:
            self.view.schedule(self.chooseDefaultNodes)  # when it has its voxels, and the role for which it was made

    def parametersChanged(self) -> None:
        """Update the view and the nodes of live update after a change of the scene's parameters or slice view."""
        self.segmenting.followMri()
        self.images.followChoices()
        self.images.showIn3D()
        self.approach.probe.watch(self.parameters.probe_transform)
        self.view.refresh(self.values.changes())

    def forgetPatient(self) -> None:
        """Release what is kept in memory of the last patient, with notes and fit; nodes stay."""
        self.logic.forgetPatient()
        self.view.showStatus("")
        self.images.sequenceDone = self.tracking.done = ""
        self.fits.forget()
        self.segmenting.forget()
        self.lesions.forget()
        self.approach.forget()
        self.logic.hideApproach()
        self.notes.set()
