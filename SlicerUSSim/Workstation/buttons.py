"""Buttons: actions of the panel's buttons on the page."""

from __future__ import annotations

from collections.abc import Callable

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Widget.controls import Section, by_widget, part_of
from SlicerUSSim.Widget.presenter import PanelPresenter
from SlicerUSSim.Workstation.loading import Loading
from SlicerUSSim.Workstation.state import SharedState
from SlicerUSSim.Workstation.tasks import Tasks

#: Button of the page that the panel in Slicer, where a scene is closed, does not have
_CLOSE = "closePatient"


class Buttons:
    """Runs the action of a button, by the name of its widget: that of its control, or one specific to the page."""

    def __init__(
        self,
        shared: SharedState,
        tasks: Tasks,
        presenter: PanelPresenter,
        sections: tuple[Section, ...],
        loading: Loading,
    ) -> None:
        self._shared, self._tasks, self._presenter, self._loading = shared, tasks, presenter, loading
        self._controls = by_widget(sections)
        #: By widget, and by name of the page's own buttons
        self._own_actions: dict[str, Callable[[], object]] = {
            "segmentButton": loading.segment,
            "undoSegmentButton": loading.undo_segment,
            "addTissuesButton": loading.add_tissues,
            "acceptProposalButton": loading.accept_proposal,
            "openCraniotomyButton": loading.open_craniotomy,
            "closeCraniotomyButton": loading.close_craniotomy,
            "placeButton": loading.place_probe,
            "placeAtViewButton": loading.place_at_view,
            "assignTissueButton": self._assign_tissue,
            _CLOSE: self._close_patient,
        }

    def press(self, name: str) -> None:
        """Called when the user presses a button."""
        self._tasks.start(self._own_actions.get(name) or part_of(self._presenter, self._controls[name].action))

    def _close_patient(self) -> None:
        with self._presenter.shown():
            self._loading.close_patient()
        self._presenter.view.refresh()

    def _assign_tissue(self) -> None:
        panel = self._shared.now.panel
        with self._presenter.shown():
            require(bool(panel.chosen_tissue), "no tissue chosen, click on its line in the table")
            self._presenter.tissues.assignTissue(panel.chosen_tissue, str(panel.values["tissuePresetComboBox"]))
