"""PanelPresenter: everything the Slicer panel does, without Qt.

The panel (panel.py) tells the presenter what the user did and shows what the presenter knows; the browser and the tests
do the same. Nothing here raises for what a user did: it is shown, in one line, and everything stays as it was.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from time import perf_counter

from SlicerUSSim.Logic.base.errors import Cancelled, SimulationError, require, required, user_message
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.mrml.logic import UltrasoundSceneLogic
from SlicerUSSim.Logic.mrml.nodes import display_of, nodes_of_class
from SlicerUSSim.Logic.probe.arrays import PROBES
from SlicerUSSim.Logic.tissue.names import same_name
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tissue.tissue import TISSUE_PARAMETERS, Tissue
from SlicerUSSim.Widget.controls import SCENE, from_shown, to_shown, value_parameter
from SlicerUSSim.Widget.fit_presenter import FitPresenter
from SlicerUSSim.Widget.interface import PanelView
from SlicerUSSim.Widget.sections import CUSTOM_PROBE

_BUSY = "Wait until the work under way is done"
#: Columns of the tissue table: parameter, heading, tool tip.
TISSUE_COLUMNS = tuple(
    (entry.name, entry.symbol or entry.label, f"{entry.tip} [{entry.unit}]" if entry.unit else entry.tip)
    for entry in TISSUE_PARAMETERS
)


@dataclass(frozen=True)
class TissueRow:
    """A line of the tissue table."""

    name: str
    #: In the order of TISSUE_COLUMNS
    values: tuple[float, ...]
    #: Where the numbers come from
    sources: tuple[str, ...]


class PanelPresenter:
    """Acts on one scene for one view.

    With `handles`, a probe that is placed gets Slicer's handles to move and turn it by.
    """

    def __init__(self, logic: UltrasoundSceneLogic, view: PanelView, handles: bool = True) -> None:
        self.logic = logic
        self.view = view
        self._handles = handles
        self._busy = False
        self._last_image: float | None = None
        self._followed: tuple = ()  # the nodes of the live update
        #: The part that fits simulated to real ultrasound
        self.fits = FitPresenter(self)

    # ---- values of preset and scene ----------------------------------------------------------------------------

    def value(self, name: str):
        """What to show for a value, named as in controls.py; None where the probe has no such value."""
        declared = value_parameter(name)
        section, attribute = name.split(".")
        if section == SCENE:
            try:
                return to_shown(declared, getattr(self.logic.parameters, attribute))
            except SimulationError:  # a scene made by hand: what needs the value says what is wrong with it
                return to_shown(declared, declared.default)
        owner = getattr(self._preset(), section)
        return to_shown(declared, getattr(owner, attribute)) if hasattr(owner, attribute) else None

    def setValue(self, name: str, shown) -> None:
        """The user gave a value, as it is shown, another one."""
        declared = value_parameter(name)
        section, attribute = name.split(".")
        with self.shown():
            value = from_shown(declared, shown)
            if section == SCENE:
                setattr(self.logic.parameters, attribute, value)
                return
            preset = self._preset().changed(section, **{attribute: value})
            if preset != self._preset():
                self.logic.preset = preset

    def chooseProbe(self, name: str) -> None:
        """Take a probe of probe.PROBES; a custom one is not chosen but made."""
        with self.shown():
            if name != CUSTOM_PROBE:
                require(name in PROBES, f"no probe is called {name!r}, expected one of {', '.join(PROBES)}")
                self.logic.preset = replace(self._preset(), probe=PROBES[name])
        self.view.refresh()

    def probeName(self) -> str:
        """Which of probe.PROBES is in use, or sections.CUSTOM_PROBE."""
        probe = self._preset().probe
        return next((name for name, known in PROBES.items() if known == probe), CUSTOM_PROBE)

    def loadPreset(self, path: str | os.PathLike) -> None:
        """Take everything from a JSON file, one of the `ussim` command too."""
        with self.shown():
            self.logic.preset = Preset.read(path)
        self.view.refresh()

    def savePreset(self, path: str | os.PathLike) -> None:
        """Write everything to a JSON file."""
        with self.shown():
            self._preset().write(path)

    # ---- tissues -----------------------------------------------------------------------------------------------

    def tissues(self) -> list[TissueRow]:
        """The tissues of the chosen labels, coupling medium first and membrane last; of the preset without labels."""
        rows: dict[str, TissueRow] = {}
        for tissue in self.tissueTable().all_tissues():
            values = tuple(getattr(tissue, parameter) for parameter, _, _ in TISSUE_COLUMNS)
            sources = tuple(tissue.sources.get(parameter, "set by hand") for parameter, _, _ in TISSUE_COLUMNS)
            rows.setdefault(tissue.name, TissueRow(tissue.name, values, sources))
        return list(rows.values())

    def setTissue(self, name: str, parameter: str, text: str) -> None:
        """The user wrote `text` into the tissue table."""
        with self.shown():
            try:
                value = float(text.strip().replace(",", "."))
            except ValueError:
                value = math.nan
            require(math.isfinite(value), f"tissue {name!r}: {parameter} is {text!r}, expected a number")
            self._change_tissue(name, lambda old: replace(old, **{parameter: value}, sources=_without(old, parameter)))

    def assignTissue(self, name: str, preset: str) -> None:
        """Give the tissue `name` the numbers of the preset tissue `preset`."""
        with self.shown():
            require(preset in TISSUES, f"no tissue is called {preset!r}, expected one of {', '.join(TISSUES)}")
            self._change_tissue(name, lambda old: replace(TISSUES[preset], name=old.name))
        self.view.refresh()

    def resetTissues(self) -> None:
        """All numbers back to the presets'."""
        with self.shown():
            preset = self._preset()
            table = {label: TISSUES.get(tissue.name, tissue) for label, tissue in preset.tissues.items()}
            self.logic.preset = replace(preset, tissues=TissueTable(table, Preset().tissues.membrane))
        self.view.refresh()

    # ---- what the buttons do -----------------------------------------------------------------------------------

    def canSegment(self) -> tuple[bool, str]:
        """(whether Segment can be pressed, why not)"""
        if self._busy:
            return False, _BUSY
        if self.logic.parameters.mri is None:
            return False, "Choose an MRI first"
        return True, ""

    def canSimulate(self) -> tuple[bool, str]:
        """(whether there is something to simulate, why not)"""
        if self._busy:
            return False, _BUSY
        if self.logic.parameters.labels is None:
            return False, "Segment the MRI, or choose a label map or segmentation"
        return True, ""

    def segment(self) -> None:
        """Label the tissues of the MRI into the chosen label map or segmentation, or a new segmentation."""
        parameters = self.logic.parameters
        with self.shown(), self.working("Segment") as progress:
            require(parameters.mri is not None, "no MRI chosen, expected a scalar volume")
            with self._made(parameters.labels, "Segmentation", f"{parameters.mri.GetName()} tissues") as labels:
                self.logic.segment(
                    parameters.mri,
                    labels,
                    mask_node=parameters.mask,
                    progress=progress,
                    **asdict(parameters.segmentation),
                )
            parameters.labels = labels
        self.view.refresh()

    def placeProbe(self) -> None:
        """Put the probe on the surface in the slice view, or where a craniotomy might be; make one if there is none."""
        with self.shown():
            require(self.logic.parameters.labels is not None, "no label map chosen, expected one to put the probe on")
            self._put_probe(self.view.sliceNode())
        self.view.refresh()

    def simulate(self) -> None:
        """One image, into the chosen volume or a new one."""
        with self.shown():
            nodes = self._nodes()
            start = perf_counter()
            caught: list[Warning] = []
            self.logic.simulate(nodes.labels, nodes.probe_transform, nodes.output, warned=caught.append)
            self.view.showStatus("; ".join(map(str, caught)) or f"{(perf_counter() - start) * 1e3:.0f} ms")
            self.logic.showOutline(nodes.outline, nodes.probe_transform)
            if self.view.sliceNode() is not None:
                self.logic.showInSlice(self.view.sliceNode(), nodes.output, nodes.probe_transform)
        self.view.refresh()

    def isLive(self) -> bool:
        return self.logic.isLive

    def setLive(self, on: bool) -> None:
        """Let the image follow the probe, or rest."""
        if on == self.logic.isLive:
            return
        if not on:
            self.logic.stopLiveUpdate()
            return
        with self.shown():
            self._nodes()
            self._last_image = None
            self._followed = self._live_nodes()
            self.logic.startLiveUpdate(
                *self._followed,
                schedule=self.view.schedule,
                report=self._reported,
                stopped=self._stopped,
            )
        self.view.refresh()

    def simulateSequence(self) -> None:
        """Images for the chosen sequence of transforms, which the browser of that sequence then plays."""
        parameters = self.logic.parameters
        transforms_node, images_node = parameters.transform_sequence, parameters.image_sequence
        with self.shown(), self.working("Simulate sequence") as progress:
            require(transforms_node is not None, "no sequence of transforms chosen, expected a Sequence node")
            with self._made(images_node, "Sequence", f"{transforms_node.GetName()} ultrasound") as images:
                count = self.logic.simulateSequence(
                    parameters.labels,
                    transforms_node,
                    images,
                    browser_node=self._browser_of(transforms_node),
                    progress=progress,
                )
            self.view.showStatus(f"{count} images in {images.GetName()!r}")
        self.view.refresh()

    def chooseDefaultNodes(self) -> None:
        """Take the first volume of the scene for the MRI, if none was chosen, which saves a few clicks."""
        parameters = self.logic.parameters
        if parameters.mri is not None:
            return
        for node in nodes_of_class(self.logic.scene, "vtkMRMLScalarVolumeNode"):
            if not node.IsA("vtkMRMLLabelMapVolumeNode") and node not in (parameters.output, parameters.real):
                parameters.mri = node
                return

    def parametersChanged(self) -> None:
        """Something in the scene's parameters, or the slice view, is another: show it, and follow with those nodes."""
        if self.logic.isLive and self._live_nodes() != self._followed:
            self.logic.stopLiveUpdate()
            self.setLive(True)
        self.view.refresh()

    # ---- inside ------------------------------------------------------------------------------------------------

    def _preset(self) -> Preset:
        try:
            return self.logic.preset
        except SimulationError:  # a scene made by hand: simulating says what is wrong, here one can begin anew
            return Preset()

    def tissueTable(self) -> TissueTable:
        """The tissues of the chosen labels, or of the preset."""
        labels = self.logic.parameters.labels
        try:
            return self.logic.tissues(labels) if labels is not None else self._preset().tissues
        except SimulationError:  # an empty node, or names nobody knows: simulating will say so
            return self._preset().tissues

    def _change_tissue(self, name: str, change: Callable[[Tissue], Tissue]) -> None:
        """Change a tissue of the table in use; one that the preset did not have is added to it."""
        preset, used = self._preset(), self.tissueTable()
        old = required(
            next((tissue for tissue in used.all_tissues() if same_name(tissue.name, name)), None),
            f"no tissue is called {name!r}, expected one of {', '.join(used.names())}",
        )
        self.logic.preset = replace(preset, tissues=preset.tissues.with_tissue(change(old)))

    def _nodes(self):
        """The parameters, with the nodes that simulating needs; those that were not chosen are made."""
        parameters = self.logic.parameters
        require(parameters.labels is not None, "no label map chosen; segment the MRI first")
        if parameters.probe_transform is None:
            self._put_probe()
        if parameters.output is None:
            parameters.output = self._add("ScalarVolume", "Ultrasound")
        if parameters.outline is None:
            parameters.outline = self._add("Model", "Ultrasound outline")
        return parameters

    def _put_probe(self, slice_node=None) -> None:
        """Place the probe's transform, a new one if none was chosen."""
        parameters = self.logic.parameters
        with self._made(parameters.probe_transform, "LinearTransform", "Probe") as probe:
            self.logic.placeProbe(parameters.labels, probe, slice_node)
        parameters.probe_transform = probe
        display = display_of(probe)
        if display is not None:
            display.SetEditorVisibility(self._handles)

    def _live_nodes(self) -> tuple:
        nodes = self.logic.parameters
        return nodes.labels, nodes.probe_transform, nodes.output, nodes.outline, self.view.sliceNode()

    def _browser_of(self, sequence_node):
        browsers = nodes_of_class(self.logic.scene, "vtkMRMLSequenceBrowserNode")
        return next((node for node in browsers if node.IsSynchronizedSequenceNode(sequence_node, True)), None)

    def _add(self, kind: str, name: str):
        return self.logic.scene.AddNewNodeByClass(f"vtkMRML{kind}Node", self.logic.scene.GenerateUniqueName(name))

    @contextmanager
    def _made(self, node, kind: str, name: str):
        """`node`, or a new one, which goes again if the work with it fails."""
        made = node is None
        if made:
            node = self._add(kind, name)
        try:
            yield node
        except BaseException:
            if made:
                self.logic.scene.RemoveNode(node)
            raise

    def _reported(self, message: str) -> None:
        now = perf_counter()
        if message:
            self.view.showStatus(message)
        elif self._last_image is not None and now - self._last_image < 1.0:
            self.view.showStatus(f"{1.0 / max(now - self._last_image, 1e-3):.0f} images per second")
        else:
            self.view.showStatus("")
        self._last_image = now

    def _stopped(self) -> None:
        self.view.showStatus("")
        self.view.refresh()

    @contextmanager
    def shown(self) -> Iterator[None]:
        """What the user caused is shown in one line; the panel then shows what really is."""
        try:
            yield
        except Exception as error:
            message = user_message(error)
            if message is None:
                raise
            if not isinstance(error, Cancelled):
                self.view.showError(message)
            self.view.refresh()

    @contextmanager
    def working(self, title: str) -> Iterator[Callable[[float], None]]:
        require(not self._busy, "wait until the work under way is done")
        self._busy = True
        self.view.refresh()
        try:
            with self.view.progress(title) as progress:
                yield progress
        finally:
            self._busy = False


def _without(tissue: Tissue, parameter: str) -> dict[str, str]:
    """The sources of the other numbers: this one is the user's now."""
    return {name: source for name, source in tissue.sources.items() if name != parameter}
