"""Findings: what is known about the labels of a label map, what is wrong with it and what is doubtful."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.tissue.label_mapping import LabelMapping
from SlicerUSSim.Logic.tissue.names import nearest_tissue, same_name, tissue_named
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.schemes import Scheme, recognised, schemes
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tissue.tissue import Tissue

_LONGEST_LIST = 12
#: About labels without a tissue, before the list of tissues
MAP_THEM = (
    "map them with --map {label}=TISSUE (0 removes a label), a .json file, a table of names or the names of segments, "
    "to one of"
)
#: About a mask or lesion without a patient
_NO_PATIENT = (
    "add it to a segmentation with --add {added}, or simulate it alone with {maps} (ussim simulate); in 3D Slicer, add "
    "it as a segment"
)
#: A label map without a name, in messages
UNNAMED = "label map"
#: Tissues of a lesion, which alone are not a patient
_LESIONS = ("tumour", "oedema", "necrosis", "cyst", "cavity", "enhancing")


class NoPatientError(SimulationError):
    """A label map is a mask or a lesion, not a patient."""


@dataclass(frozen=True, eq=False)
class Findings:
    """The labels of a label map, other than 0, with their names and tissues."""

    #: The label map in messages
    source: str
    #: The label map, and its voxels of label 0, 1, 2, ...
    labels: Volume
    counts: np.ndarray
    #: {label: name}, None for one without
    names: Mapping[int, str | None]
    #: {label: tissue}, None for an unknown one
    found: Mapping[int, Tissue | None]
    scheme: Scheme | None
    mapping: LabelMapping
    tissues: TissueTable
    #: Whether it labels organs of a CT
    of_ct: bool = False

    @property
    def is_mapped(self) -> bool:
        """Whether the user gave every label a tissue."""
        return all(self.mapping.tissue_of(label, name) for label, name in self.names.items())

    @property
    def _file(self) -> str:
        """The label map in options; FILE for one without a file."""
        return "FILE" if self.source == UNNAMED or "'" in self.source else self.source

    def number(self) -> str:
        """Their number in words: "41 labels"."""
        return f"{len(self.names)} label{'s' * (len(self.names) > 1)}"

    def require_scheme(self) -> None:
        """Raise SimulationError for a numbering of the user that lacks half of the labels."""
        key, scheme = self.mapping.scheme, self.scheme
        other = [] if scheme is None else [label for label in self.names if label not in scheme.names]
        if key is None or scheme is None or 2 * len(other) < len(self.names):
            return
        found, choices = recognised(self.names, of_ct=self.of_ct)
        fits = " or ".join(f"--map {one.key}" for one in ([found] if found else choices) or schemes().values())
        raise SimulationError(f"{self.source}: labels {listed(other, 4)} do not belong to --map {key}; expected {fits}")

    def require_patient(self) -> None:
        """Raise NoPatientError for a mask or lesion, which is not a patient, unless the user gave it a tissue."""
        if self.is_mapped or self.mapping.scheme:
            return
        size = f"{self.number()}, {self._size(self.names)}"
        known = [None if tissue is None else tissue.name for tissue in self.found.values()]
        names = [str(name) for name in self.names.values() if name is not None]
        if len(known) == 1 and (known[0] is None or any(map(_is_nearest, names))):
            what = f"a binary mask ({size})"
        elif self.scheme is not None and self.scheme.is_lesion:
            what = f"a tumour's labels (as {self.scheme.title}: {', '.join(names)}; {size})"
        elif all(tissue in _LESIONS for tissue in known):
            what = f"a lesion ({', '.join(names)}; {size})"
        else:
            return
        usual = "liver" if self.of_ct else "tumour"
        maps = options(f"{label}={tissue or usual}" for label, tissue in zip(self.names, known, strict=True))
        is_brats = self.scheme is not None and self.scheme.is_lesion
        tissue = "brats" if is_brats or len(set(known)) > 1 else known[0] or usual
        remedy = _NO_PATIENT.format(added=shlex.quote(f"{tissue}={self._file}"), maps=maps)
        if self.of_ct:
            remedy = f"say which organ it is with {maps}"
        raise NoPatientError(f"{self.source}: {what}, not a patient's tissues; {remedy}")

    def require_known(self) -> None:
        """Raise SimulationError that lists the labels without a tissue, and what to do."""
        unknown = [label for label, tissue in self.found.items() if tissue is None]
        if not unknown:
            return
        nothing = "no program's numbers are recognised, and " if len(unknown) == len(self.names) else ""
        known = ", ".join(dict.fromkeys([*self.tissues.names()[1:], *TISSUES]))
        called = listed(map(self._described, unknown))
        remedy = MAP_THEM.format(label=unknown[0])
        raise SimulationError(f"{self.source}: {nothing}no tissue is called {called}; {remedy}: {known}")

    def doubts(self, around: Collection[int]) -> list[str]:
        """What a user should know, each in one line; `around` are unknown labels, which are taken as others."""
        doubts = []
        taken = {label: tissue.name for label, tissue in self.found.items() if tissue and label in around}
        for label, name in taken.items():
            doubts.append(
                f"{self.source}: {self._described(label)} is unknown and taken as {name}, which is around it; --map "
                f"{label}=TISSUE gives it another tissue"
            )
        if self.scheme is not None and self.scheme.is_lesion and not self.is_mapped:
            doubts.append(
                f"{self.source}: has a tumour alone, in the coupling medium; --add brats={shlex.quote(self._file)} "
                "adds it to a patient's labels"
            )
        complete = recognised(self.names, of_ct=self.of_ct)[0] if self.mapping.scheme else None
        if complete is not None and complete is not self.scheme:
            doubts.append(f"{self.source}: its labels belong to {complete.title} (--map {complete.key})")
        nearest: dict[str, list[str]] = {}
        for label, name in self.names.items():
            tissue = self.found[label]
            is_mine = name is None or self.mapping.tissue_of(label, name) is not None
            if tissue and not is_mine and not same_name(str(name), tissue.name) and _is_nearest(str(name)):
                nearest.setdefault(tissue.name, []).append(str(name))
        if nearest:
            pairs = "; ".join(f"{listed(names, 4)} as {tissue}" for tissue, names in nearest.items())
            doubts.append(f"{self.source}: the nearest tissue is used for {pairs}")
        unused = self.mapping.unused(self.names)
        if unused:
            doubts.append(f"{self.source}: has no label {listed(unused)}, which --map mentions")
        return doubts

    def _described(self, label: int) -> str:
        """'Left-Lesion' (25, 3.1 ml)"""
        name = self.names[label]
        return f"{name!r} ({label}, {self._size([label])})" if name else f"label {label} ({self._size([label])})"

    def _size(self, labels: Iterable[int]) -> str:
        size_ml = float(self.counts[list(labels)].sum() * self.labels.voxel_ml)
        return f"{size_ml:.0f} ml" if size_ml >= 10 else f"{size_ml:.2g} ml"


def options(texts: Iterable[str]) -> str:
    """Options of texts for LabelMapping.of: --map 1=csf --map 2=tumour."""
    return " ".join(f"--map {shlex.quote(text)}" for text in texts)


def listed(items: Iterable[object], most: int = _LONGEST_LIST) -> str:
    """Items with commas; of more than `most`, the first and their number."""
    texts = list(map(str, items))
    more = [f"and {len(texts) - most} more"] if len(texts) > most else []
    return ", ".join([*texts[:most], *more])


def _is_nearest(name: str) -> bool:
    try:
        tissue_named(name)
    except SimulationError:
        return nearest_tissue(name) is not None
    return False
