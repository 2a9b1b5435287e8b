"""TissuePresenter: the table of tissues, without Qt."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from SlicerUSSim.Logic.base.errors import SimulationError, require, required
from SlicerUSSim.Logic.imaging.preset import Preset
from SlicerUSSim.Logic.tissue.names import same_name
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tissue.tissue import TISSUE_PARAMETERS, Tissue
from SlicerUSSim.Widget.interface import PanelHost, tr as _

#: What the table shows, up to the scatterers; the texture of a tissue is in preset files alone
COLUMN_PARAMETERS = TISSUE_PARAMETERS[:6]
#: Columns of the tissue table: parameter, heading, tool tip.
TISSUE_COLUMNS = tuple(
    (entry.name, entry.symbol or entry.label, f"{entry.tip} [{entry.unit}]" if entry.unit else entry.tip)
    for entry in COLUMN_PARAMETERS
)


@dataclass(frozen=True)
class TissueRow:
    """A line of the tissue table."""

    name: str
    #: In the order of TISSUE_COLUMNS
    values: tuple[float, ...]
    #: Sources of the values
    sources: tuple[str, ...]


class TissuePresenter:
    """Shows and changes the tissues in use."""

    def __init__(self, panel: PanelHost) -> None:
        self._panel = panel

    def rows(self) -> list[TissueRow]:
        """The tissues of the chosen labels, or of the preset without labels; coupling medium first, membrane last."""
        rows: dict[str, TissueRow] = {}
        for tissue in self.table().all_tissues():
            values = tuple(getattr(tissue, column[0]) for column in TISSUE_COLUMNS)
            sources = tuple(tissue.sources.get(column[0], _("set manually")) for column in TISSUE_COLUMNS)
            rows.setdefault(tissue.name, TissueRow(tissue.name, values, sources))
        return list(rows.values())

    def table(self) -> TissueTable:
        """The tissues of the chosen labels, or of the preset."""
        labels = self._panel.parameters.labels
        try:
            return self._panel.logic.tissues(labels) if labels is not None else self._panel.preset.tissues
        except SimulationError:  # an empty node, or unknown names: the error is shown when an image is simulated
            return self._panel.preset.tissues

    def setTissue(self, name: str, parameter: str, text: str) -> None:
        """Set a parameter of a tissue from the text of a table cell."""
        with self._panel.shown():
            try:
                value = float(text.strip().replace(",", "."))
            except ValueError:
                value = math.nan
            require(math.isfinite(value), f"tissue {name!r}: {parameter} is {text!r}, expected a number")
            self._change(name, lambda old: replace(old, **{parameter: value}, sources=_without(old, parameter)))

    def assignTissue(self, name: str, preset: str) -> None:
        """Copy the parameters of the preset tissue `preset` to the tissue `name`."""
        with self._panel.acting():
            require(preset in TISSUES, f"no tissue is called {preset!r}, expected one of {', '.join(TISSUES)}")
            self._change(name, lambda old: replace(TISSUES[preset], name=old.name))

    def resetTissues(self) -> None:
        """Reset all tissues to the presets."""
        with self._panel.acting():
            preset = self._panel.preset
            table = {label: TISSUES.get(tissue.name, tissue) for label, tissue in preset.tissues.items()}
            self._panel.logic.preset = replace(preset, tissues=TissueTable(table, Preset().tissues.membrane))

    def _change(self, name: str, change: Callable[[Tissue], Tissue]) -> None:
        """Change a tissue of the table in use; it is added to the preset if missing there."""
        preset, used = self._panel.preset, self.table()
        old = required(
            next((tissue for tissue in used.all_tissues() if same_name(tissue.name, name)), None),
            f"no tissue is called {name!r}, expected one of {', '.join(used.names())}",
        )
        self._panel.logic.preset = replace(preset, tissues=preset.tissues.with_tissue(change(old)))


def _without(tissue: Tissue, parameter: str) -> dict[str, str]:
    """The sources of all parameters except `parameter`."""
    return {name: source for name, source in tissue.sources.items() if name != parameter}
