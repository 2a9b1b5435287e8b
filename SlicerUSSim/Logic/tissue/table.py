"""TissueTable: the tissue of every label of a label map."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from SlicerUSSim.Logic.base.declaration import built, kind_of, parameters_of, short
from SlicerUSSim.Logic.base.errors import SimulationError, require, require_kind
from SlicerUSSim.Logic.base.files import read_json, write_json
from SlicerUSSim.Logic.base.reading import PlainValue, reader
from SlicerUSSim.Logic.tissue.names import plain_name, segments_header, tissue_named
from SlicerUSSim.Logic.tissue.presets import MEMBRANE, TISSUES
from SlicerUSSim.Logic.tissue.tissue import Membrane, Tissue

if TYPE_CHECKING:
    from SlicerUSSim.Logic.base.volume import Volume

_log = logging.getLogger(__name__)

MAX_LABEL = 62  # six bits in the device's label volume, and 63 is the membrane


class TissueTable(PlainValue, Mapping[int, Tissue]):
    """The tissues of a label map: a read-only mapping {label: Tissue}, and the membrane, if any.

    Label 0 is the coupling medium around the patient and is added when it is not given.
    Raises SimulationError for labels outside 0..62.

    >>> from SlicerUSSim.Logic import TissueTable
    >>> tissues = TissueTable.brain(["csf", "grey matter", "white matter"])
    >>> tissues.names()
    ['coupling', 'csf', 'grey matter', 'white matter']
    >>> tissues.replace("white matter", attenuation_db_cm_mhz=0.45)[3].attenuation_db_cm_mhz
    0.45
    """

    def __init__(self, tissues: Mapping[int, Tissue], membrane: Membrane | None = None) -> None:
        table = {}
        require_kind("tissues", tissues, Mapping, "{1: Tissue(...)}")
        for label, tissue in tissues.items():
            require(
                isinstance(label, int | np.integer) and not isinstance(label, bool) and 0 <= label <= MAX_LABEL,
                f"tissue label is {label!r}, expected a whole number from 0 to {MAX_LABEL}",
            )
            require(isinstance(tissue, Tissue), f"label {label}: {tissue!r} is not a Tissue")
            table[int(label)] = tissue
        table.setdefault(0, TISSUES["coupling"])
        self._tissues = dict(sorted(table.items()))
        self.membrane = membrane

    def __getitem__(self, label: int) -> Tissue:
        return self._tissues[label]

    def __iter__(self):
        return iter(self._tissues)

    def __len__(self) -> int:
        return len(self._tissues)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, TissueTable) and (self._tissues, self.membrane) == (other._tissues, other.membrane)

    def __repr__(self) -> str:
        names = ", ".join(f"{label}: {tissue.name}" for label, tissue in self.items())
        return f"TissueTable({names}{'' if self.membrane is None else '; ' + self.membrane.tissue.name})"

    # ---- presets -----------------------------------------------------------------------------------------------

    @classmethod
    def brain(cls, tissue_names: Iterable[str] = ("csf", "grey matter", "white matter")) -> TissueTable:
        """Presets for labels 1, 2, ... named `tissue_names`, with leptomeninges and ependyma as the membrane."""
        return cls.named(tissue_names, MEMBRANE)

    @classmethod
    def named(cls, tissue_names: Iterable[str], membrane: Membrane | None = None) -> TissueTable:
        """Presets for labels 1, 2, ... by name, for all organs. Raises SimulationError for an unknown name."""
        table = {label: _preset(label, name) for label, name in enumerate(tissue_names, 1)}
        return cls(table, membrane)

    def label_of(self, name: str) -> int:
        """The label of a tissue by name. Raises SimulationError if the table has no tissue with that name."""
        for label, tissue in self.items():
            if tissue.name == name:
                return label
        raise SimulationError(f"no tissue named {name!r} in the table, expected one of: {', '.join(self.names())}")

    def names(self) -> list[str]:
        """Tissue names in the order of their labels."""
        return [tissue.name for tissue in self.values()]

    def names_by_label(self) -> tuple[str, ...]:
        """Names of labels 1, 2, ... to the last; "" for one that the table lacks."""
        return tuple(self[label].name if label in self else "" for label in range(1, max(self) + 1))

    def all_tissues(self) -> list[Tissue]:
        """Tissues in the order of their labels, the membrane's last."""
        return [*self.values(), *([] if self.membrane is None else [self.membrane.tissue])]

    def tissue(self, name: str) -> Tissue:
        """Tissue by name, including the membrane's. Raises SimulationError that lists the names for unknown ones."""
        for tissue in self.all_tissues():
            if tissue.name == name:
                return tissue
        names = dict.fromkeys(tissue.name for tissue in self.all_tissues())
        raise SimulationError(f"no tissue named {name!r}, expected one of: {', '.join(names)}")

    def with_tissue(self, tissue: Tissue) -> TissueTable:
        """A new table in which `tissue` replaces all tissues of its name, including the membrane's, or is added."""
        if any(old.name == tissue.name for old in self.all_tissues()):
            return self._changed(tissue.name, lambda _: tissue)
        free = next(
            label for label in range(MAX_LABEL + 2) if label not in self
        )  # refused as out of range if the table is full
        return TissueTable({**self, free: tissue}, self.membrane)

    def replace(self, name: str, /, **changes) -> TissueTable:
        """A new table with parameters changed in every tissue named `name`, including the membrane's.

        The name itself cannot be changed, since membrane, label maps and fits refer to it. Raises SimulationError that
        lists the names or parameters for an unknown one.
        """
        known = [field.name for field in parameters_of(Tissue) if field.name != "name"]
        for parameter in changes:
            require(
                parameter in known,
                f"{parameter!r} is not a tissue parameter that can be replaced, expected one of: {', '.join(known)}",
            )
        self.tissue(name)  # raises SimulationError for an unknown name
        return self._changed(name, lambda tissue: replace(tissue, **changes))

    def _changed(self, name: str, change: Callable[[Tissue], Tissue]) -> TissueTable:
        """A new table with `change` applied to every tissue named `name`."""

        def after(tissue: Tissue) -> Tissue:
            return change(tissue) if tissue.name == name else tissue

        membrane = self.membrane
        if membrane is not None:
            membrane = replace(membrane, tissue=after(membrane.tissue))
        return TissueTable({label: after(tissue) for label, tissue in self.items()}, membrane)

    def for_names(self, names: Iterable[str]) -> TissueTable:
        """A table for labels 1, 2, ... named `names`, with the coupling medium and membrane of this table.

        With skin among the names the coupling medium lies on it, outside the membrane's fluids. A tissue is taken from
        this table, including its membrane, if the name occurs there, or else if it occurs with
        other case, hyphens or underscores, or else from the presets. Of several tissues with one name, the first is
        taken, as in `label_of` and `tissue`.

        Raises SimulationError that lists the unknown names.
        """
        last_first = self.all_tissues()[::-1]
        mine = {plain_name(tissue.name): tissue for tissue in last_first}
        exactly = {tissue.name: tissue for tissue in last_first}
        table, unknown = {0: self[0]}, []
        for label, name in enumerate(names, 1):
            try:
                table[label] = exactly.get(name) or mine.get(plain_name(name)) or _preset(label, name)
            except SimulationError:
                unknown.append(name)
        require(
            not unknown,
            f"no tissue for {', '.join(map(repr, unknown))}, expected names among: {', '.join(TISSUES)}",
        )
        return self.with_labels(table)

    def with_labels(self, tissues: Mapping[int, Tissue]) -> TissueTable:
        """A table of these tissues by label, with this table's membrane; coupling is not one of its fluids on skin.

        Raises SimulationError for a label out of range.
        """
        membrane = self.membrane
        if membrane is not None and any(tissue.name == "skin" for tissue in tissues.values()):
            membrane = replace(membrane, fluids=tuple(name for name in membrane.fluids if name != "coupling"))
        return TissueTable(tissues, membrane)

    def with_membrane(self, membrane: Membrane | None) -> TissueTable:
        """A new table with another membrane, or none."""
        return TissueTable(self, membrane)

    # ---- JSON --------------------------------------------------------------------------------------------------

    def to_dict(self) -> dict:
        """Plain values, the input of from_dict."""
        values: dict[str, dict] = {"tissues": {str(label): _plain(tissue) for label, tissue in self.items()}}
        if self.membrane is not None:
            numbers = asdict(replace(self.membrane, tissue=replace(self.membrane.tissue, sources={})))
            values["membrane"] = {
                **numbers, "tissue": _plain(self.membrane.tissue), "fluids": list(self.membrane.fluids)
            }  # fmt: skip
        return values

    @classmethod
    def from_dict(cls, values: dict, source: str = "tissues") -> TissueTable:
        """The inverse of to_dict. Raises SimulationError that names `source` and the error in it."""
        expected = 'expected {"tissues": {"1": {...}}}'
        require(isinstance(values, dict), f"{source}: is {kind_of(values)}, {expected}")
        require("tissues" in values, f"{source}: lacks tissues, {expected}")
        tissues = values["tissues"]
        require(isinstance(tissues, dict), f"{source}: tissues is {kind_of(tissues)}, {expected}")
        table = {
            _label(label, source): built(Tissue, tissue, f"{source}: tissue {label}")
            for label, tissue in tissues.items()
        }
        membrane = values.get("membrane")
        if membrane is not None:
            within = f"{source}: membrane"
            if isinstance(membrane, dict) and "tissue" in membrane:
                membrane = {**membrane, "tissue": built(Tissue, membrane["tissue"], f"{within}: tissue")}
            membrane = built(Membrane, membrane, within)
        return cls(table, membrane)

    @classmethod
    @reader
    def read(cls, path: str | os.PathLike) -> TissueTable:
        """Read a table from JSON. Raises SimulationError for a missing, unreadable or invalid file."""
        return cls.from_dict(read_json(path), str(path))

    def write(self, path: str | os.PathLike) -> None:
        """Write the table as JSON; on failure an existing file is kept."""
        write_json(path, self.to_dict())


def _label(text: str, source: str) -> int:
    """The label in a JSON file. Raises SimulationError for a text that does not consist of digits."""
    known = {str(label): label for label in range(MAX_LABEL + 1)}
    require(text in known, f"{source}: tissue label is {short(text)}, expected a whole number from 0 to {MAX_LABEL}")
    return known[text]


def _preset(label: int, name: str) -> Tissue:
    tissue = tissue_named(name)
    if tissue.name != name:
        _log.info("label %d, %r, is interpreted as %s", label, name, tissue.name)
    return tissue


def _plain(tissue: Tissue) -> dict:
    return {**asdict(replace(tissue, sources={})), "sources": dict(tissue.sources)}


def tissues_beside(labels: Path) -> Path:
    """The file of a label map's tissue table: the same name with .json."""
    name = labels.name
    for suffix in (".nii.gz", labels.suffix):
        if suffix and name.endswith(suffix):
            return labels.with_name(name[: -len(suffix)] + ".json")
    return labels.with_name(name + ".json")


def write_label_files(path: Path, labels: Volume, tissues: TissueTable) -> Path:
    """Write a label map, and its tissue table beside it, whose path is returned.

    The names are in the label map, too, if it is NIfTI, or NRRD, which has 3D Slicer's segments.
    Raises SimulationError if one of the files cannot be written.
    """
    beside = tissues_beside(path)
    write_named_labels(path, labels, {label: tissue.name for label, tissue in tissues.items() if label})
    tissues.write(beside)
    return beside


def write_named_labels(path: Path, labels: Volume, names: Mapping[int, str]) -> None:
    """Write a label map with its names, if it is NIfTI, or NRRD, which has 3D Slicer's segments with their codes."""
    about = segments_header(names, labels.array.shape[::-1]) if path.suffix.lower() == ".nrrd" else None
    replace(labels, label_names=dict(names)).write(path, about)
