"""Advice: the one line over the image that says what matters most now, and what its button does."""

from __future__ import annotations

from collections.abc import Callable

from SlicerUSSim.Widget.notes import CHECK
from SlicerUSSim.Workstation.browser_panel import BrowserPanel
from SlicerUSSim.Workstation.pose_registration import Registration

#: Words of warnings about the contrast (mri/plausibility.py), and the contrast that is meant
_CONTRASTS = {"as in t1 or t1gd": "t1", "as in flair or t2": "t2", "choose t1gd": "t1gd"}


class Advice:
    """Shows what the notes say first, with a remedy: bone before the probe, no contact, contrast, calibration."""

    def __init__(self, panel: BrowserPanel, registration: Registration) -> None:
        self._panel, self._presenter, self._registration = panel, panel.presenter, registration
        self._do: Callable[[], object] = lambda: None
        self._dismissed = ""

    def update(self) -> None:
        """Find the line anew; called when the panel has been refreshed."""
        # While something is under way the notes are about what was before
        text, remedy, self._do = ("", "", lambda: None) if self._presenter.isBusy else self._found()
        if text == self._dismissed:
            text = remedy = ""
        with self._panel.shared.changing() as now:
            now.advice, now.remedy = text, remedy

    def dismiss(self) -> None:
        """Do not show this line again."""
        self._dismissed = self._panel.shared.now.advice
        self.update()

    def follow(self, is_outdated: bool) -> None:
        """Do what the button says; called in a task."""
        if is_outdated:
            self._presenter.images.simulate()
        else:
            self._panel.act(self._do)

    def _found(self) -> tuple[str, str, Callable[[], object]]:
        placing, values = self._presenter.placing, self._presenter.values
        line = self._first("probeNotesLabel")
        if line.startswith("no skull is labelled"):

            def label() -> None:
                values.setValue("scene.outside", True)
                self._panel.act(self._presenter.segmenting.segment)

            return line, "Label the whole head", label
        if line and "skull" in line and placing.canOpenCraniotomy()[0]:
            return line, "Open skull", placing.openCraniotomy
        if line:
            return line, "Place the probe", placing.placeAtView
        line = self._first("notesLabel")
        labels = self._panel.logic.parameters.labels
        if labels is not None and self._panel.logic.closedLabels(labels) is not labels:
            return "", "", lambda: None  # another Segment would close the opening
        chosen = next((contrast for words, contrast in _CONTRASTS.items() if words in line), "")
        if chosen:

            def segment() -> None:
                values.setValue("scene.contrast", chosen)
                self._panel.act(self._presenter.segmenting.segment)

            return line, f"Segment as {chosen}", segment
        return line or self._registration.doubt, "", lambda: None

    def _first(self, label: str) -> str:
        """The first line of a label that a user should check."""
        lines = str(self._panel.shared.value(label) or "").splitlines()
        return next((line.partition(CHECK)[2] for line in lines if CHECK in line), "")
