"""What thin sheets of each kind are made of, and so how they echo (docs/physics.md#sheets-found-in-the-mri)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.table import MAX_LABEL, TissueTable
from SlicerUSSim.Logic.tissue.tissue import Tissue


@dataclass(frozen=True)
class SheetLook:
    """How sheets of one kind echo."""

    #: Of the layer of scatterers, mm
    least_thickness_mm: float
    most_thickness_mm: float
    #: Their level relative to that tissue, dB
    level_db: float
    #: Whether it is the border of a ventricle, whose scatterers fade with the angle as those of any wall
    is_wall: bool
    #: Whether these have the table's tissue DURA, and otherwise the membrane's
    is_dura: bool
    #: Amplitude reflection coefficient of the layer where the beam meets it squarely and it is smooth
    reflection: float


#: Name of the tissue of falx and tentorium
DURA = "falx"
#: Part of the power of its scatterers that is the same from all sides; the rest falls with the angle of incidence i by
#: Lambert's law, as cos^2 i (measured on a real falx, docs/physics.md#sheets-found-in-the-mri)
DURA_ISOTROPIC = 0.1
#: The tissue of each kind; None: that of the membrane
_TISSUES = {"sulcus": None, "falx": DURA, "tentorium": DURA, "ependyma": None}
DURA_KINDS = tuple(kind for kind, name in _TISSUES.items() if name == DURA)
#: Most of a layer that is drawn, mm: dura is 0.3 to 0.8 mm (Protasoni et al., J. Neurosurg. 114(6), 2011); a sulcus is
#: as wide as it was found, up to the fluid that voxels of 1 mm show as such
_MOST_MM = {"sulcus": 1.5, "falx": 0.8, "tentorium": 0.8, "ependyma": 0.0}
_OWN_VARIANCE = TISSUES["leptomeninges"].scatterer_variance


def looks_of(tissues: TissueTable) -> dict[str, SheetLook]:
    """By kind of sheet, for a table with a membrane."""
    membrane = tissues.membrane
    if membrane is None:
        return {}
    around, has_dura = _tissue(tissues, "grey matter"), dura_label(tissues) >= 0
    result = {}
    for kind, name in _TISSUES.items():
        tissue = membrane.tissue if name is None else _tissue(tissues, name)
        is_dura, level_db = name == DURA and has_dura, 0.0
        if name is not None and not is_dura:
            # Relative to the membrane's in the presets: where a fit changes the membrane's level, the dura's follows.
            level_db = 10.0 * np.log10(TISSUES[name].scatterer_variance / _OWN_VARIANCE)
        most = max(_MOST_MM[kind], membrane.thickness_mm)
        result[kind] = SheetLook(
            membrane.thickness_mm, most, float(level_db), kind == "ependyma", is_dura, _of_layer(tissue, around)
        )
    return result


def dura_label(tissues: TissueTable) -> int:
    """The first label of the tissue of falx and tentorium, which need not have voxels; -1 where the table has none."""
    return next((label for label, tissue in tissues.items() if tissue.name == DURA), -1)


def with_dura(tissues: TissueTable, kinds: Iterable[str], known: TissueTable | None = None) -> TissueTable:
    """The table with the tissue of falx and tentorium, under a label without voxels, where sheets are of these `kinds`.

    With it, their level belongs to a separate tissue, which a fit changes, and is not tied to the membrane's. Its
    parameters are those in the table `known`, or else the preset's. Unchanged if the table has it, or no label is left.
    """
    # The last free label: the next one may be another tissue's in label maps for which a preset is used
    label = next((label for label in range(MAX_LABEL, 0, -1) if label not in tissues), None)
    if set(kinds).isdisjoint(DURA_KINDS) or dura_label(tissues) >= 0 or label is None:
        return tissues
    tissue = TISSUES[DURA] if known is None else _tissue(known, DURA)
    return TissueTable({**tissues, label: tissue}, tissues.membrane)


def _tissue(tissues: TissueTable, name: str) -> Tissue:
    try:
        return tissues.tissue(name)
    except SimulationError:
        return TISSUES[name]


def _of_layer(tissue: Tissue, around: Tissue) -> float:
    """Of a layer of unknown thickness: its two faces, of opposite sign, have echoes of independent phase."""
    inside, outside = tissue.impedance_mrayl, around.impedance_mrayl
    return float(np.sqrt(2.0) * (inside - outside) / (inside + outside))
