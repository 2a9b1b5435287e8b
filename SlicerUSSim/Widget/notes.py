"""Notes: what was found and done in the last steps, and what a user should check, in lines."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.mri.segmentation_settings import GEL_MM
from SlicerUSSim.Widget.interface import PanelHost, in_panel, tr as _

#: Begin of the lines that a user should check
CHECK = "Check: "
#: Begins of the lines about what was grown last, about an opening, and about where the probe was placed: in an opening,
#: or at a standard view
GROWN, OPENED, PLACED, VIEW = "grown: ", "craniotomy: ", "probe: ", "view: "
_PROBE = (OPENED, PLACED, VIEW)


class Notes:
    """The lines about the last segmentation or addition, and about the probe where it is now."""

    def __init__(self, panel: PanelHost) -> None:
        self._panel = panel
        self._lines: list[str] = []
        #: Those of the lines that are about the tissues under the lesions
        self.checks: list[str] = []
        #: The MRI node that was segmented
        self.segmented: Any = None
        self._labels: Any = None  # that the notes are about
        #: The lines about contact and bone before the probe that the notes had when they were shown last
        self._about_probe: tuple[str, ...] = ()

    def text(self) -> str:
        """The lines about the tissues: of Segment, of a file, of lesions that were laid over them."""
        return _text(line for line in self._lines if not line.startswith((*_PROBE, GROWN)))

    def aboutLesions(self) -> str:
        """The lines about what was grown last."""
        return _text(line for line in self._lines if line.startswith(GROWN))

    def aboutProbe(self) -> str:
        """The lines about opening and place of the probe, with those that follow from where it is now."""
        self._about_probe = self._found_about_probe()
        lines = [line for line in self._lines if line.startswith(_PROBE)]
        return _text([*lines, *self._gel(), *checks(self._about_probe)])

    @property
    def lines(self) -> tuple[str, ...]:
        """The lines without what follows from the present choices, for set()."""
        return tuple(self._lines)

    def set(self, *lines: str) -> None:
        """Replace them by lines about another patient, whose labels are chosen; by none, to forget them."""
        self._lines, self.segmented = list(lines), None
        self.checks = [line for line in lines if line.startswith(CHECK)]
        self.areAbout(self._panel.parameters.labels)

    def add(self, *lines: str) -> None:
        """Add lines."""
        self._lines += lines

    def drop(self, *begins: str) -> None:
        """Remove the lines that begin so."""
        self._lines = [line for line in self._lines if not line.startswith(begins)]

    def say(self, begin: str, *lines: str) -> None:
        """Replace the lines that begin so."""
        self.drop(begin)
        self._lines += [f"{begin}{line}" for line in lines]

    def areAbout(self, labels: Any) -> None:
        """Remember that they are about these labels."""
        self._labels = labels

    def isAbout(self, labels: Any) -> bool:
        """Whether they are about these labels."""
        return self._labels is labels

    def recognise(self, labels: Any) -> None:
        """Replace them by what labels were recognised as, if they are about others."""
        if not self.isAbout(labels):
            message, warnings = self._panel.logic.recognised()
            self.set(f"{labels.GetName()}: {message}", *checks(warnings))

    def addOfLogic(self) -> None:
        """Add what the logic says of its last step."""
        self._lines += [*self._panel.logic.notes, *checks(self._panel.logic.warnings)]

    def replaceByLogic(self, source: Any, labels: Any) -> None:
        """Replace them by what the logic says of its last step, about `source`; they are about these labels."""
        self._lines = [f"{source.GetName()}:"]
        self.addOfLogic()
        self.areAbout(labels)

    def probeSaysOther(self) -> bool:
        """Whether the probe has moved over bone or an opening, or off the patient, since the lines were shown."""
        before, self._about_probe = self._about_probe, self._found_about_probe()
        return self._about_probe != before

    def _gel(self) -> list[str]:
        """A line about gel on the skin, if the chosen tissues have it by default."""
        labels = self._panel.parameters.labels
        try:
            is_there = labels is not None and self._panel.logic.settings(labels) != self._panel.preset.settings
        except SimulationError:  # an empty node, or unknown names: the error is shown when an image is simulated
            return []
        return [_("gel fills gaps of up to {mm:g} mm between skin and probe").format(mm=GEL_MM)] if is_there else []

    def _found_about_probe(self) -> tuple[str, ...]:
        """Lines about the probe where it is now: its contact with the patient, and bone before it."""
        logic, labels, probe = self._panel.logic, self._panel.parameters.labels, self._panel.parameters.probe_transform
        if labels is None or probe is None:
            return ()
        try:
            return (*logic.aboutContact(labels, probe), *logic.aboutBone(labels, probe))
        except SimulationError:  # as in _gel, or a probe that scales
            return ()


def checks(warnings: Iterable[str]) -> list[str]:
    """Warnings as lines of the notes."""
    return [f"{CHECK}{warning}" for warning in warnings]


def _text(lines: Iterable[str]) -> str:
    """Lines as text; those to check come first."""
    return in_panel("\n".join(sorted(lines, key=lambda line: CHECK not in line)))
