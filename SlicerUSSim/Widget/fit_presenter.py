"""FitPresenter: fits of simulated to real ultrasound for the panel, without Qt."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from SlicerUSSim.Logic.base.errors import SimulationError, require, required
from SlicerUSSim.Logic.base.settings import DisplaySettings
from SlicerUSSim.Logic.fitting.parameters import FreeParameters, all_names, declaration_of
from SlicerUSSim.Logic.fitting.search import Progress
from SlicerUSSim.Logic.fitting.tracked_fit import Fit
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mrml.fit_nodes import COMPARED, CostPlot
from SlicerUSSim.Logic.mrml.nodes import composite_of, display_of, require_node
from SlicerUSSim.Logic.mrml.own_results import result_called
from SlicerUSSim.Logic.tracked.sequence import checked_apart, frame_numbers
from SlicerUSSim.Widget.interface import PanelHost, tr as _
from SlicerUSSim.Widget.notes import CHECK
from SlicerUSSim.Widget.tissue_presenter import TissuePresenter
from SlicerUSSim.Widget.value_presenter import ValuePresenter

_FREE = "scene.fit_free"
_REGISTRATION = "Ultrasound registration"


class FitPresenter:
    """Sets up, runs, applies and shows fits for the panel."""

    def __init__(self, panel: PanelHost, values: ValuePresenter, tissues: TissuePresenter) -> None:
        self._panel, self._values, self._tissues = panel, values, tissues
        self._fit: tuple[Fit, object] | None = None  # with its labels
        self._before: Preset | None = None  # the preset that Apply replaced
        #: Result of the last fit, as text
        self.summary = ""
        #: Called in the thread of a fit with its progress
        self.following: Callable[[Progress], None] = lambda step: None

    def forget(self) -> None:
        """Forget the last fit, which belongs to another patient."""
        self._fit = self._before = None
        self.summary = ""

    # ---- free parameters ---------------------------------------------------------------------------------------

    def freeParameters(self) -> list[tuple[str, str, bool]]:
        """(name, label, whether it is free) of each parameter that a fit can vary, for the tissues in use."""
        tissues, free = self._tissues.table(), set(self._free())
        return [(name, label_of(name), name in free) for name in all_names(tissues)]

    def setFree(self, name: str, on: bool) -> None:
        """Called when the user ticks or unticks a parameter."""
        names = [known for known, _label, is_free in self.freeParameters() if (on if known == name else is_free)]
        self._values.setValue(_FREE, ", ".join(names) or "none")  # an empty text means the default

    def _free(self) -> list[str]:
        return list(dict.fromkeys(name for names in self._groups().values() for name in names))

    def _groups(self) -> dict[str, list[str]]:
        """{a name as chosen: the parameters that it stands for}."""
        names = [name.strip() for name in self._values.value(_FREE).split(",") if name.strip()]
        tissues = self._tissues.table()
        known: dict[str, list[str]] = {}
        for name in names:
            try:
                known[name] = FreeParameters.of([name], tissues, DisplaySettings()).names
            except SimulationError:  # a tissue that these labels do not have
                continue
        return known

    # ---- fit ---------------------------------------------------------------------------------------------------

    def canFit(self) -> tuple[bool, str]:
        """(whether Fit is enabled, the reason if not)"""
        can, why_not = self._panel.canSimulate()
        if can and self._panel.parameters.real is None:
            return False, _("Choose real images first")
        return can, why_not

    def fit(self) -> None:
        """Fit to the chosen real images; the preset does not change until apply()."""
        panel, parameters = self._panel, self._panel.parameters
        with panel.acting(), panel.working(_("Fit")) as progress:
            require(parameters.real is not None, "no real images chosen, expected a sequence or a volume")
            free = list(self._groups())  # "tissues" as such: the fit looks which the images show
            require(bool(free), "no parameter is free; tick at least one")
            plot = CostPlot(panel.logic.scene)
            panel.view.showChart(plot.chart)

            def report(step: Progress) -> None:
                panel.view.showStatus(step.in_words())
                self.following(step)
                progress(step.share)

            labels, settings = parameters.labels, parameters.fit
            found = panel.logic.optimize(
                labels, parameters.real, probe_transform_node=parameters.probe_transform, frames=self._frames(),
                validate=self._predicted(), free=free, register=settings.register,
                speckle=settings.speckle, estimate_geometry=settings.estimate, max_evaluations=settings.of_search,
                restarts=settings.restarts, plot=plot, progress=report,
            )  # fmt: skip
            self._fit, self._before = (found, labels), None
            self.summary = _in_words(found)
            panel.view.showStatus("")
            self._show("after", found.tracked.numbers[0])

    def _frames(self) -> list[int] | None:
        text, real = self._panel.parameters.fit.frames.strip(), self._panel.parameters.real
        if not text or not real.IsA("vtkMRMLSequenceNode"):
            return None
        return frame_numbers(text, real.GetNumberOfDataNodes())

    def _predicted(self) -> list[int]:
        text, real = self._panel.parameters.fit.validate, self._panel.parameters.real
        if not text.strip():
            return []
        require(real.IsA("vtkMRMLSequenceNode"), "a single image leaves none to predict, expected a sequence")
        return checked_apart(text, self._frames(), real.GetNumberOfDataNodes())

    # ---- apply and revert --------------------------------------------------------------------------------------

    def canApply(self) -> tuple[bool, str]:
        """(whether the fit can be applied, the reason if not)"""
        return self._canChange(self._before is None, _("The fit is applied already"))

    def canRevert(self) -> tuple[bool, str]:
        """(whether the values from before Apply can be restored, the reason if not)"""
        return self._canChange(self._before is not None, _("Apply a fit first"))

    def _canChange(self, met: bool, why_not: str) -> tuple[bool, str]:
        labels: Any = None if self._fit is None else self._fit[1]
        is_chosen = labels is not None and labels is self._panel.parameters.labels
        text = _("The fit belongs to {name!r}; choose these tissues")
        other = "" if labels is None else text.format(name=labels.GetName())
        return self._panel.ready((self._fit, _("Fit to real images first")), (is_chosen, other), (met, why_not))

    def apply(self) -> None:
        """Write the result to the preset, and a registration to a transform node, the future parent of the tracking."""
        panel = self._panel
        with panel.acting():
            require(*self.canApply())
            found, labels = required(self._fit, "fit first")
            before = panel.logic.applyFit(found)
            if found.registration is not None:
                transform = result_called(self._panel.logic.scene, "LinearTransform", _REGISTRATION)
                panel.logic.writeRegistration(found, labels, transform)
            self._before, self.summary = before, _in_words(found)

    def revert(self) -> None:
        """Restore the values from before apply(), except those that were changed since, which the summary names."""
        with self._panel.acting():
            require(*self.canRevert())
            before = required(self._before, "nothing to revert to, apply a fit first")
            found = required(self._fit, "nothing to revert, fit first")[0]
            kept = self._panel.logic.revertFit(found, before)
            self._before, self.summary = None, _in_words(found)
            if kept:
                self.summary += f"\nRevert kept what was changed after Apply: {', '.join(kept)}"

    # ---- compare -----------------------------------------------------------------------------------------------

    def comparedNumbers(self) -> list[int]:
        """Numbers of the fitted images."""
        return [] if self._fit is None else list(self._fit[0].tracked.numbers)

    def canCompare(self) -> bool:
        return self._fit is not None

    def canBlink(self) -> bool:
        real: Any = self._panel.parameters.real
        return self.canCompare() or (real is not None and real.IsA("vtkMRMLVolumeNode"))

    def compare(self, kind: str, number: int) -> None:
        """Show one image of the fit in the slice view; `kind` is one of fit_nodes.COMPARED."""
        with self._panel.shown():
            required(self._fit, "nothing to show, fit first")
            require(kind in COMPARED, f"unknown image {kind!r}, expected one of {', '.join(COMPARED)}")
            self._show(kind, number)

    def blink(self) -> None:
        """Toggle the foreground of the slice view, which covers the real image in the background."""
        composite = self._composite()
        if composite is not None:
            composite.SetForegroundOpacity(0.0 if composite.GetForegroundOpacity() > 0.5 else 1.0)

    def showDifference(self, on: bool) -> None:
        """Let grey in the slice view be no difference of foreground and background: half of each, one inverted."""
        composite = self._composite()
        shown = composite and self._panel.logic.scene.GetNodeByID(composite.GetForegroundVolumeID() or "")
        if shown:
            display_of(shown).SetAndObserveColorNodeID(f"vtkMRMLColorTableNode{'InvertedGrey' if on else 'Grey'}")
            composite.SetForegroundOpacity(0.5 if on else 1.0)

    def _composite(self) -> Any:
        view = self._panel.view.sliceNode()
        return None if view is None else composite_of(view)

    def _show(self, kind: str, number: int) -> None:
        found, labels = required(self._fit, "nothing to show, fit first")
        logic = self._panel.logic
        require_node(labels, "vtkMRMLLabelMapVolumeNode", "vtkMRMLSegmentationNode", use="label map of the fit")
        nodes = {name: result_called(self._panel.logic.scene, "ScalarVolume", f"Fit: {name}") for name in COMPARED}
        logic.showFit(found, labels, nodes, number)
        view = self._panel.view.sliceNode()
        if view is not None:
            logic.showFitInSlice(view, found, labels, nodes[kind], nodes["real"], number)


def label_of(name: str) -> str:
    """What users call a parameter of a fit, with its tissue before it."""
    tissue, label = name.rpartition(".")[0], _(declaration_of(name).label)
    return f"{tissue}: {label[0].lower()}{label[1:]}" if tissue else label


def _in_words(found: Fit) -> str:
    result = found.appearance
    cost = f"cost {result.cost_before:.3f} → {result.cost_after:.3f}"
    lines = [f"{cost}, {len(found.tracked.images)} images, {result.evaluations} evaluations"]
    if result.cost_after >= result.cost_before:
        lines.insert(0, f"{CHECK}the fit is no better than before: give more evaluations, or free fewer parameters")
    if found.registration is not None:
        lines.append(f"moved by {found.registration.shift_mm:.1f} mm and {found.registration.turn_deg:.1f}°")
    if found.prediction is not None:
        lines += found.prediction.lines()
    for name, value in result.after.items():
        spread = result.identifiability[name]
        line = f"{label_of(name)}: {result.before[name]:.3g} → {value:.3g} {declaration_of(name).unit}".rstrip()
        if name in result.at_bounds:
            line += " (at its bound)"
        elif spread.is_determined is False:
            line += f" (not determined: {spread.low:.3g} to {spread.high:.3g} fit equally well)"
        lines.append(line)
    return "\n".join(lines)
