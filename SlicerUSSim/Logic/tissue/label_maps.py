"""read_label_map: label maps of other programs as labels of tissues, by the user's words, names or known numbers.

Command, Slicer and workstation use it. `message` reports what was recognised and done, `warnings` what is doubtful.
What cannot be known is an error with its remedy, and never a guess.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, require, require_kind
from SlicerUSSim.Logic.base.label_numbers import whole_numbers
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.tissue.label_findings import UNNAMED, Findings, listed
from SlicerUSSim.Logic.tissue.label_mapping import LabelMapping
from SlicerUSSim.Logic.tissue.names import nearest_tissue, plain_name, tissue_named
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.schemes import Scheme, recognised, schemes
from SlicerUSSim.Logic.tissue.table import MAX_LABEL, TissueTable
from SlicerUSSim.Logic.tissue.tissue import Tissue

_log = logging.getLogger(__name__)

LARGEST_LABEL = 99_999
#: Smallest distance of a label from a whole number that is reported
_WORTH_ROUNDING = 0.01
#: Share of the labels that may be unknown to a program, and are taken as their surroundings
_MOST_UNKNOWN = 0.25
#: Labels of each numbering that is offered
_SHOWN = 4


@dataclass(frozen=True, eq=False)
class LabelledTissues:
    """A label map in the form for the simulator: one label per tissue."""

    #: uint8 labels
    labels: Volume
    #: The tissue of every label
    tissues: TissueTable
    #: {label in the input: label in `labels`} of those that occur
    relabelled: Mapping[int, int]
    #: What was recognised: "FreeSurfer aseg: 35 labels to 8 tissues"
    message: str
    #: What is doubtful, each in one line
    warnings: tuple[str, ...] = ()
    #: Whether the labels are as they were, with a tissue table that was made for them
    has_own_table: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Name of the tissue of label 1, 2, ...; "" for a number that a table leaves out."""
        table = self.tissues
        return tuple(table[label].name if label in table else "" for label in range(1, max(table) + 1))


def read_label_map(
    volume: Volume,
    names: Mapping[int, str] | None = None,
    mapping: LabelMapping | None = None,
    *,
    source: str = UNNAMED,
    tissues: TissueTable | None = None,
    by_number: TissueTable | None = None,
    renumber: bool = False,
    of_ct: bool = False,
) -> LabelledTissues:
    """The tissues of a label map: by the user's mapping, by names, by a table, or by the numbers of the only program
    that can have written it.

    Parameters
    ----------
    volume : (k, j, i) whole numbers from 0 to 99999, also stored as floating point.
    names : {label: name} of what is known about the labels: in the file, beside it, or in the scene.
    mapping : the user's tissues for labels; goes before everything else.
    source : the label map in messages.
    tissues : tissues that are known by their names before the presets, and the membrane; default: of the brain.
    by_number : a table made for this label map; used for labels without a name. If it has every label, and there are
        no names, labels are not renumbered.
    renumber : renumber them also then, from 1.
    of_ct : it has organs of a CT: only programs that label these are thought of.

    Raises SimulationError for numbers that are not labels, labels without a tissue, which it lists, numbers that fit
    several programs, and for a mask or lesion without a patient.

    >>> import numpy as np
    >>> from SlicerUSSim.Logic import Volume
    >>> from SlicerUSSim.Logic.tissue import read_label_map
    >>> aseg = Volume(np.zeros((20, 20, 20), np.float32), np.eye(4))
    >>> for label, i in ((2, 4), (41, 14), (4, 8), (43, 11), (10, 7), (251, 12)):
    ...     aseg.array[5:15, 5:15, i] = label
    >>> found = read_label_map(aseg)
    >>> found.message, found.names
    ('FreeSurfer: 6 labels to 3 tissues', ('white matter', 'csf', 'grey matter'))
    """
    require_kind("label map", volume, Volume, "Volume.read reads a file")
    reading = _Reading(
        as_whole(volume, source), names or {}, mapping or LabelMapping(), source,
        tissues or by_number or TissueTable.brain(), by_number, of_ct,
    )  # fmt: skip
    found = (None if renumber else reading.unchanged()) or reading.by_tissue()
    off = 0.0 if np.issubdtype(volume.array.dtype, np.integer) else _largest_fraction(volume.array)
    if off > _WORTH_ROUNDING:
        line = f"{source}: was stored with a scale; labels are rounded by up to {off:.2g} to whole numbers"
        found = replace(found, warnings=(*found.warnings, line))
    _log.info("%s: %s: %s", source, found.message, ", ".join(name for name in found.names if name))
    return found


def as_whole(volume: Volume, source: str = "label map") -> Volume:
    """The volume with labels as integers. Raises SimulationError unless it holds whole numbers from 0 to 99999."""
    array = volume.array
    if array.dtype == np.uint8:
        return volume
    low, high = array.min(), array.max()
    what = "a label map with negative labels, " if low < 0 else ""
    remedy = "; set its background to 0, or add 1 if all labels are one too low" if low == -1 else ""
    require(
        bool(np.isfinite(low) and np.isfinite(high)) and low >= 0 and high <= LARGEST_LABEL,
        f"{source}: {what}has values from {low:g} to {high:g}, expected labels, whole numbers from 0 to "
        f"{LARGEST_LABEL}{remedy}",
    )
    whole = whole_numbers(array)
    require(whole is not None, f"{source}: has fractions, expected labels, whole numbers; segment an MRI first")
    return volume.with_array(np.asarray(whole).astype(np.int32))


def _largest_fraction(array: np.ndarray) -> float:
    return float(np.abs(array - np.rint(array)).max())


class _Reading:
    """One label map on its way to tissues; see read_label_map for the parameters."""

    def __init__(
        self, volume: Volume, names: Mapping[int, str], mapping: LabelMapping, source: str, tissues: TissueTable,
        by_number: TissueTable | None, of_ct: bool,
    ) -> None:  # fmt: skip
        self._of_ct = of_ct
        self._volume, self._mapping, self._source = volume, mapping, source
        self._tissues, self._by_number = tissues, by_number
        self._counts = np.bincount(volume.array.ravel())
        self._present = [int(label) for label in np.flatnonzero(self._counts) if label]
        require(self._present, f"{source}: is 0 everywhere, expected labels that are not 0")
        everything = {**names, **mapping.names}
        self._names = {label: everything[label] for label in self._present if label in everything}

    def unchanged(self) -> LabelledTissues | None:
        """The labels as they are, if the table by number has all of them and nothing else maps them."""
        table = self._by_number
        if table is None or self._mapping or self._names or any(label not in table for label in self._present):
            return None
        labels = self._volume.with_array(self._volume.array.astype(np.uint8))
        same, count = {label: label for label in (0, *self._present)}, len(self._present)
        message = f"{count} labels by their numbers in the tissue table"
        return LabelledTissues(labels, table, same, message, has_own_table=True)

    def by_tissue(self) -> LabelledTissues:
        """Labels renumbered from 1, one for each tissue, in the order of their first labels."""
        scheme = self._scheme()
        coupling = (self._by_number or self._tissues)[0]
        names = {label: self._names.get(label, scheme.names.get(label) if scheme else None) for label in self._present}
        found = {label: self._tissue(label, name, scheme) for label, name in names.items()}
        around = self._around(found) if scheme is not None and not scheme.is_lesion else {}
        found |= {label: found[beside] if beside else coupling for label, beside in around.items()}
        findings = Findings(
            self._source, self._volume, self._counts, names, found, scheme, self._mapping, self._tissues, self._of_ct
        )  # fmt: skip
        findings.require_scheme()
        findings.require_patient()
        findings.require_known()
        order: list[Tissue] = []
        relabelled = {0: 0}
        between = self._mapping.by_label.get(0, "coupling")
        if between != "coupling":
            found = {0: self._named(between), **found}
        for label, tissue in found.items():
            assert tissue is not None
            if tissue.name == "coupling":
                relabelled[label] = 0
                continue
            if tissue not in order:
                order.append(tissue)
            relabelled[label] = order.index(tissue) + 1
        require(order, f"{self._source}: all labels are mapped to 0, expected a tissue for one of them")
        require(
            len(order) <= MAX_LABEL, f"{self._source}: has {len(order)} different tissues, expected at most {MAX_LABEL}"
        )
        lookup = np.zeros(len(self._counts), np.uint8)
        lookup[list(relabelled)] = list(relabelled.values())
        table = TissueTable({0: coupling, **dict(enumerate(order, 1))}, self._tissues.membrane)
        labels = self._volume.with_array(lookup[self._volume.array])
        tissues = f"{len(order)} tissue{'s' * (len(order) > 1)}"
        message = f"{self._title(findings)}: {findings.number()} to {tissues}"
        return LabelledTissues(labels, table, relabelled, message, tuple(findings.doubts(around)))

    def _around(self, found: Mapping[int, Tissue | None]) -> dict[int, int]:
        """{unknown label: the known one that it touches most, 0 without} if few labels are unknown, and no names."""
        unknown = [label for label, tissue in found.items() if tissue is None and label not in self._names]
        if len(unknown) > _MOST_UNKNOWN * len(found):
            return {}
        around, array = {}, self._volume.array
        for label in unknown:
            touched = np.zeros(len(self._counts), int)
            for first, second in ((np.moveaxis(array, n, 0)[:-1], np.moveaxis(array, n, 0)[1:]) for n in range(3)):
                for one, other in ((first, second), (second, first)):
                    touched += np.bincount(other[one == label], minlength=len(touched))
            touched[[0, *unknown]] = 0
            around[label] = int(touched.argmax())
        return around

    def _scheme(self) -> Scheme | None:
        """The numbering that the user said, or, if neither names nor the user tell of any label, the recognised one.

        Raises SimulationError that lists the numberings which the labels may have.
        """
        if self._mapping.scheme:
            return schemes()[self._mapping.scheme]
        unknown = [label for label in self._present if self._tissue(label, self._names.get(label)) is None]
        if len(unknown) < 2 or self._names:
            return None
        of_programs = [label for label in unknown if any(label in scheme.names for scheme in schemes().values())]
        if len(unknown) - len(of_programs) <= _MOST_UNKNOWN * len(unknown):
            unknown = of_programs
        scheme, choices = recognised(unknown, of_ct=self._of_ct)
        if scheme is None and choices:
            raise SimulationError(
                f"{self._source}: labels {listed(unknown)} have no names; state their program: "
                f"{', '.join(self._offered(choice, unknown) for choice in choices)}; or give each its tissue: --map "
                f"{unknown[0]}=TISSUE"
            )
        return scheme

    def _offered(self, scheme: Scheme, labels: list[int]) -> str:
        """--map spm (SPM and fMRIPrep: 1 grey matter, 2 white matter, 3 csf)"""
        called = listed([f"{label} {plain_name(scheme.names[label])}" for label in labels], _SHOWN)
        return f"--map {scheme.key} ({scheme.title}: {called})"

    def _tissue(self, label: int, name: str | None, scheme: Scheme | None = None) -> Tissue | None:
        given = self._mapping.tissue_of(label, name)
        if given is not None:
            return self._named(given)
        preset = scheme.tissues.get(label) if scheme is not None and label not in self._names else None
        named = None if name is None else self._named(name, preset)
        if named is not None or self._by_number is None or self._mapping.scheme:
            return named
        return self._by_number.get(label)

    def _named(self, name: str, preset: str | None = None) -> Tissue | None:
        """The tissue with a name among the user's tissues, or else `preset`, by default of that name or the nearest."""
        try:
            preset = preset or tissue_named(name).name
        except SimulationError:
            preset = nearest_tissue(name)
        mine = self._tissues.all_tissues()[::-1]
        exactly = {tissue.name: tissue for tissue in mine}
        plainly = {plain_name(tissue.name): tissue for tissue in mine}
        own = exactly.get(name) or plainly.get(plain_name(name))
        if own is not None or preset is None:
            return own
        return exactly.get(preset) or TISSUES[preset]

    def _title(self, findings: Findings) -> str:
        if findings.is_mapped:
            return "mapped"
        if findings.scheme is not None:
            return findings.scheme.title
        return "labels with names" if self._names else "labels by number"
