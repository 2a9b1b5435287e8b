"""ValuePresenter: declared values of the preset and the scene as a panel displays them, and presets, without Qt.

A value is called "section.name" in the preset ("display.gain_db") and "scene.name" in the parameters of the scene
("scene.contrast").
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from SlicerUSSim.Logic.base.declaration import Parameter, Shown, short
from SlicerUSSim.Logic.base.errors import SimulationError, require, required
from SlicerUSSim.Logic.imaging.preset import Preset, preset_parameters
from SlicerUSSim.Logic.mrml.nodes import probe_pose, set_node_to_world
from SlicerUSSim.Logic.mrml.parameter_node import NODE_PARAMETERS, VALUE_PARAMETERS
from SlicerUSSim.Logic.probe.arrays import PROBES, Probe
from SlicerUSSim.Widget.interface import PanelHost
from SlicerUSSim.Widget.placement_presenter import PlacementPresenter

SCENE = "scene"
#: Option of the probe preset for a probe that is not one of PROBES.
CUSTOM_PROBE = "custom"
#: {option of the probe preset: name in PROBES}
SHOWN_PROBES: dict[str, str] = {name.replace("_", " "): name for name in PROBES}


class ValuePresenter:
    """Shows and sets values, probes and presets."""

    def __init__(self, panel: PanelHost, placing: PlacementPresenter) -> None:
        self._panel, self._placing = panel, placing
        self._custom_probe: Probe | None = None  # the last one that was not one of PROBES
        self._known: dict[str, Any] = {}

    def value(self, name: str) -> Any:
        """The displayed form of a value; None if the probe has no such value."""
        declared = value_parameter(name)
        section, attribute = name.split(".")
        if section == SCENE:
            try:
                return to_shown(declared, getattr(self._panel.parameters, attribute))
            except SimulationError:  # an invalid value in the scene: the error is shown when it is used
                return to_shown(declared, declared.default)
        owner = getattr(self._panel.preset, section)
        return to_shown(declared, getattr(owner, attribute)) if hasattr(owner, attribute) else None

    def setValue(self, name: str, shown: Any) -> None:
        """Set a value from its displayed form."""
        declared = value_parameter(name)
        section, attribute = name.split(".")
        with self._panel.shown(), _in_words_of(declared, shown):
            value = from_shown(declared, shown)
            if section == SCENE:
                setattr(self._panel.parameters, attribute, value)
                return
            preset = self._panel.preset.changed(section, **{attribute: value})
            if preset != self._panel.preset:
                self._panel.logic.preset = preset

    def changes(self) -> set[str] | None:
        """Names of the values that have changed since the last call and of their sections; "tissues" is one of these.

        None if another node was chosen, added to the scene or removed, on which everything may depend.
        """
        node, preset, before = self._panel.parameters.node, self._panel.preset, self._known
        nodes = (self._panel.logic.scene.GetNumberOfNodes(), *map(node.GetNodeReferenceID, NODE_PARAMETERS))
        self._known = {"nodes": nodes, "tissues": preset.tissues}
        self._known |= {f"{SCENE}.{name}": node.GetParameter(name) for name in VALUE_PARAMETERS}
        for name in preset_parameters():
            section, attribute = name.split(".")
            self._known[name] = getattr(getattr(preset, section), attribute, None)
        changed = {name for name in before.keys() | self._known.keys() if before.get(name) != self._known.get(name)}
        return None if "nodes" in changed else changed | {name.split(".")[0] for name in changed}

    # ---- probes and presets ------------------------------------------------------------------------------------

    def chooseProbe(self, name: str) -> None:
        """Select a probe of probe.PROBES by its name there or in the panel.

        CUSTOM_PROBE is the last one that was not one of them; before there is one, the error tells how to make it.
        """
        with self._panel.acting():
            before = self._panel.preset.probe
            if self.probeName() == CUSTOM_PROBE:
                self._custom_probe = before
            if name == CUSTOM_PROBE:
                probe = required(
                    self._custom_probe, "there is no custom probe yet: change a value of this probe to make one"
                )
            else:
                key = SHOWN_PROBES.get(name, name)
                require(key in PROBES, f"no probe is called {name!r}, expected one of {', '.join(SHOWN_PROBES)}")
                probe = PROBES[key]
            self._panel.logic.preset = replace(self._panel.preset, probe=probe)

    def probeName(self) -> str:
        """Name in the panel of the probe of probe.PROBES; CUSTOM_PROBE if it is not one of them."""
        probe = self._panel.preset.probe
        return next((shown for shown, name in SHOWN_PROBES.items() if PROBES[name] == probe), CUSTOM_PROBE)

    def loadPreset(self, path: str | os.PathLike) -> None:
        """Read the preset from a JSON file of the module or the `ussim` command."""
        with self._panel.acting():
            self.takePreset(Preset.read(path))

    def takePreset(self, preset: Preset) -> None:
        """Use a preset; one with a pose moves the probe there, if there are tissues to look at."""
        pose, parameters = preset.probe_to_ras, self._panel.parameters
        self._panel.logic.preset = replace(preset, probe_to_ras=None)
        if pose is None:
            return
        require(
            parameters.labels is not None,
            "the pose of the preset is not used, since there are no tissues to look at; segment the MRI, and load it "
            "again",
        )
        if parameters.probe_transform is None:
            self._placing.put()
        set_node_to_world(parameters.probe_transform, np.array(pose))

    def presetToSave(self) -> Preset:
        """The preset, with the pose of the probe if it is wanted. Raises SimulationError if it has none."""
        preset, parameters = self._panel.preset, self._panel.parameters
        if not parameters.panel.preset_pose:
            return preset
        transform = required(
            parameters.probe_transform, "Pose in presets is ticked, and there is no probe; place it, or untick it"
        )
        return replace(preset, probe_to_ras=tuple(map(tuple, probe_pose(transform).tolist())))

    def savePreset(self, path: str | os.PathLike) -> None:
        """Write the preset to a JSON file."""
        with self._panel.shown():
            self.presetToSave().write(path)


# ---- declared and displayed values -----------------------------------------------------------------------------------


def value_parameter(name: str) -> Parameter:
    """The declaration of a value. Raises KeyError for an unknown one."""
    section, attribute = name.split(".")
    return VALUE_PARAMETERS[attribute] if section == SCENE else preset_parameters()[name]


def to_shown(declared: Parameter, found: Any) -> Any:
    """The displayed form of a value; None if nothing is displayed."""
    return declared.shown.number(found) if isinstance(declared.shown, Shown) else found


def from_shown(declared: Parameter, entered: Any) -> Any:
    """The value for the content of a widget, not yet checked.

    Values of type int are rounded, since widgets hold them as floats.
    """
    is_number = isinstance(entered, int | float) and not isinstance(entered, bool) and math.isfinite(entered)
    if not is_number or not isinstance(declared.shown, Shown):
        return entered
    converted = declared.shown.value(entered)
    return round(converted) if declared.type is int and converted is not None else converted


@contextmanager
def _in_words_of(declared: Parameter, entered: Any) -> Iterator[None]:
    """Within the block, an error about this parameter has its label, and what was entered as it is shown."""
    try:
        yield
    except SimulationError as error:
        _, is_about_it, rest = str(error).partition(f"{declared.name} is ")
        if not is_about_it:
            raise
        is_number = isinstance(entered, int | float) and not isinstance(entered, bool)
        what = f"{entered:g} {declared.unit}".rstrip() if is_number else short(entered)
        expected = rest.rpartition(", expected ")[2]
        raise SimulationError(f"{declared.label} is {what}, expected {expected}") from error
