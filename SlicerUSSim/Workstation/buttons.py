"""Buttons: what the buttons of the panel do on the page."""

from __future__ import annotations

from collections.abc import Callable

from trame_slicer.core import SlicerApp

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Widget.presenter import PanelPresenter
from SlicerUSSim.Workstation.loading import Loading
from SlicerUSSim.Workstation.state import SharedState
from SlicerUSSim.Workstation.tasks import Tasks


class Buttons:
    """Does what a button says, by its name in Resources/UI."""

    def __init__(
        self, shared: SharedState, app: SlicerApp, tasks: Tasks, presenter: PanelPresenter, loading: Loading
    ) -> None:
        self._shared, self._scene, self._tasks, self._presenter = shared, app.scene, tasks, presenter
        fits = presenter.fits
        self._actions: dict[str, Callable[[], None]] = {
            "segmentButton": loading.segment,
            "placeButton": loading.place_probe,
            "simulateButton": presenter.simulate,
            "resetTissuesButton": presenter.resetTissues,
            "assignTissueButton": self._assign_tissue,
            "simulateSequenceButton": self._simulate_sequence,
            "fitButton": fits.fit,
            "applyFitButton": fits.apply,
            "revertFitButton": fits.revert,
        }

    def press(self, name: str) -> None:
        """The user pressed a button."""
        self._tasks.start(self._actions[name])

    def _assign_tissue(self) -> None:
        panel = self._shared.now.panel
        with self._presenter.shown():
            require(bool(panel.chosen_tissue), "no tissue chosen, click on its line in the table")
            self._presenter.assignTissue(panel.chosen_tissue, str(panel.values["tissuePresetComboBox"]))

    def _simulate_sequence(self) -> None:
        values = self._shared.now.panel.values
        transforms, images = (
            self._scene.GetNodeByID(str(values[name] or ""))
            for name in ("transformSequenceSelector", "imageSequenceSelector")
        )
        self._presenter.simulateSequence(transforms, images)
