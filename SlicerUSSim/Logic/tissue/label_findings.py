"""Findings: what is known about the labels of a label map, what is wrong with it and what is doubtful."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import PurePath

import numpy as np

from SlicerUSSim.Logic.base.errors import SimulationError, either
from SlicerUSSim.Logic.base.volume import SIDES, Volume
from SlicerUSSim.Logic.tissue import label_findings as cut_brain
from SlicerUSSim.Logic.tissue.freesurfer import missing_structures
from SlicerUSSim.Logic.tissue.interpolated_labels import are_interpolated_numbers
from SlicerUSSim.Logic.tissue.label_advice import Advice
from SlicerUSSim.Logic.tissue.label_mapping import LabelMapping
from SlicerUSSim.Logic.tissue.names import nearest_tissue, same_name, tissue_named
from SlicerUSSim.Logic.tissue.presets import TISSUES
from SlicerUSSim.Logic.tissue.schemes import Scheme, schemes, schemes_of_ct
from SlicerUSSim.Logic.tissue.table import TissueTable
from SlicerUSSim.Logic.tissue.tissue import Tissue

_LONGEST_LIST = 12
#: As many tissues as `ussim segment` writes at most, with all that --outside, --sheets and --add give
_MOST_OF_OURS = 20
#: So few labels are not recognised by their places.
_TOO_FEW = 3
#: More unknown labels may be the intensities of an image
MOST_LABELS = 100
#: A label map without a name, in messages
UNNAMED = "label map"
#: Tissues of a lesion, which alone are no patient
_LESIONS = ("tumour", "oedema", "necrosis", "cyst", "cavity", "enhancing")
#: Tissues of every brain, and the least and largest volume of both that is not remarkable
_BRAIN, _BRAIN_ML = ("grey matter", "white matter"), (30.0, 2500.0)
_INTERPOLATED = (
    "many voxels between two labels have a number between theirs, which is that of another structure, as where a label "
    "map was resampled with interpolation and rounded: use the original, or resample it with nearest neighbours"
)
#: A larger binary mask is that of a brain or a head.
_LARGEST_LESION_ML = 500.0


class NoPatientError(SimulationError):
    """A label map is a mask or a lesion, and no patient."""


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
    advice: Advice
    #: Whether it is of organs of a CT
    of_ct: bool = False

    @property
    def is_mapped(self) -> bool:
        """Whether the user gave every label a tissue."""
        return all(self.mapping.tissue_of(label, name) for label, name in self.names.items())

    @property
    def _file(self) -> str:
        """The label map in options; FILE for one that has no name."""
        return "FILE" if self.source == UNNAMED else self.source

    def number(self) -> str:
        """Their number in words: "41 labels"."""
        return f"{len(self.names)} label{'s' * (len(self.names) > 1)}"

    @cached_property
    def _are_interpolated(self) -> bool:
        tissues = {label: tissue.name for label, tissue in self.found.items() if tissue is not None}
        return are_interpolated_numbers(self.labels.array, len(self.names), tissues)

    def require_patient(self) -> None:
        """Raise NoPatientError for a mask or lesion, which is no patient, unless the user gave it a tissue."""
        if self.is_mapped:
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
        of_file = _tissue_of_file(self.source) or self.advice.mask_tissue
        pairs = zip(self.names, known, strict=True)
        maps = self.advice.maps(f"{label}={tissue or of_file}" for label, tissue in pairs)
        is_brats = self.scheme is not None and self.scheme.is_lesion
        tissue = "brats" if is_brats or len(set(known)) > 1 else known[0] or of_file
        is_large = len(known) == 1 and self._millilitres(self.names) > _LARGEST_LESION_ML
        advice = self.advice.brain_mask if is_large else self.advice.lesion
        added = shlex.quote(f"{tissue}={self._file}")
        remedy = advice.format(added=added, tissue=tissue, source=self._file, maps=maps)
        if self.scheme is not None and is_brats and set(self.names) <= set(schemes()["ussim"].names):
            remedy += f"; if it is a brain, {self.advice.ambiguous.format(key='ussim')}"
        raise NoPatientError(f"{self.source}: {what}, not a patient's tissues; {remedy}")

    def require_known(self) -> None:
        """Raise SimulationError that lists the labels without a tissue, and what to do."""
        unknown = [label for label, tissue in self.found.items() if tissue is None]
        if not unknown:
            return
        remedy = self.advice.unknown.format(label=unknown[0])
        nothing = "no program's numbers are recognised, and " if len(unknown) == len(self.names) else ""
        if len(unknown) > 1 and not nothing and self.advice.leave_out and not self._are_interpolated:
            maps = self.advice.maps(f"{n}=0" for n in unknown[:_LONGEST_LIST])
            maps += " ..." * (len(unknown) > _LONGEST_LIST)
            remedy = f"{self.advice.leave_out.format(maps=maps)}; or {remedy}"
        if nothing:
            is_ours = sorted(self.names) == list(range(1, len(self.names) + 1)) and len(self.names) <= _MOST_OF_OURS
            remedy = f"{self._if_of_a_program(unknown)}{self.advice.own if is_ours else ''}{remedy}"
        if self._are_interpolated:
            remedy = f"{_INTERPOLATED}; or {remedy}"
        elif nothing and len(unknown) > MOST_LABELS:
            remedy = f"if these are intensities of an MRI, its file may be incomplete; {remedy}"
        known = ", ".join(dict.fromkeys([*self.tissues.names()[1:], *TISSUES]))
        called = listed(map(self._described, unknown))
        unused = self.mapping.unused(self.names)
        mistaken = f"; it has no label {listed(unused)}, which {self.advice.mapping} mentions" if unused else ""
        raise SimulationError(f"{self.source}: {nothing}no tissue is called {called}{mistaken}; {remedy}: {known}")

    def _if_of_a_program(self, labels: list[int]) -> str:
        """Which programs have all these numbers, though they are too few to be recognised, and how to say so."""
        known = schemes_of_ct() if self.of_ct else schemes().values()
        programs = [scheme for scheme in known if scheme.order and set(labels) <= set(scheme.names)]
        if not programs or len(labels) > _TOO_FEW:
            return ""
        first = programs[0]
        called = ", ".join(f"{label} {first.names[label]}" for label in labels)
        titles = either([f"{first.title} ({called})", *(scheme.title for scheme in programs[1:])])
        return f"if the numbers are those of {titles}, {self.advice.ambiguous.format(key=first.key)}; "

    def doubts(self) -> list[str]:
        """What a user should know, each in one line."""
        doubts = []
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
            doubts.append(f"{self.source}: has no label {listed(unused)}, which {self.advice.mapping} mentions")
        is_part = False
        if self.scheme is not None and self.scheme.key == "freesurfer":
            missing = missing_structures([name for name in self.names.values() if name is not None])
            is_part = bool(missing)
            if missing:
                doubts.append(
                    f"{self.source}: a part of a brain, without {', '.join(missing)}: they are the coupling medium; "
                    "a whole one is in aseg and aparc+aseg"
                )
        if self._are_interpolated:
            doubts.append(f"{self.source}: {_INTERPOLATED}")
        doubts += self._brain_that_was_cut()
        if not is_part:
            doubts += self._brain_of_another_size()
        is_body = self.scheme is not None and self.scheme.key.startswith("totalsegmentator")
        if is_body and 0 not in self.mapping.by_label and self.counts[0]:
            share = self.counts[0] / self.counts.sum()
            doubts.append(
                f"{self.source}: {share:.0%} of the volume has no label and is the coupling medium, also between the "
                f"organs; {self.advice.between}"
            )
        return doubts

    def _brain(self) -> list[int]:
        """Labels of grey and white matter, if there are both."""
        has_both = {tissue.name for tissue in self.found.values() if tissue} >= set(_BRAIN)
        return [label for label, tissue in self.found.items() if has_both and tissue and tissue.name in _BRAIN]

    @cached_property
    def cut_sides(self) -> list[str]:
        """At which sides a brain was cut off: of left, right, back, front, bottom, top."""
        brain = self._brain()
        return (
            cut_brain.cut_sides(self.labels, {label: self.names[label] for label in brain}, self.counts)
            if brain
            else []
        )

    @cached_property
    def is_part_of_brain(self) -> bool:
        """Whether grey and white matter are in one piece and cut, or less than a whole brain's."""
        brain = self._brain()
        if not brain or self.cut_sides:
            return bool(self.cut_sides)
        is_small = cut_brain.LEAST_ML <= self._millilitres(brain) < cut_brain.WHOLE_ML
        return is_small and cut_brain.is_solid(self.labels, {label: self.names[label] for label in brain}, self.counts)

    def _brain_that_was_cut(self) -> list[str]:
        if not self.is_part_of_brain:
            return []
        if not self.cut_sides:
            return [
                f"{self.source}: grey and white matter have {self._size(self._brain())}, an adult's 900 to 1500 ml: a "
                "part of a brain, of which the rest is the coupling medium, an infant's, or a wrong size of the voxels "
                "in its header"
            ]
        *sides, last = (f"the {side}" for side in self.cut_sides)
        where = f"{', '.join(sides)} and {last}" if sides else last
        return [
            f"{self.source}: a part of a brain of {self._size(self._brain())}, cut off at {where}: what is missing is "
            "the coupling medium"
        ]

    def _brain_of_another_size(self) -> list[str]:
        brain = self._brain()
        if not brain or _BRAIN_ML[0] < self._millilitres(brain) < _BRAIN_ML[1]:
            return []
        return [
            f"{self.source}: grey and white matter have {self._size(brain)}, an adult's 900 to 1500 ml: if it is a "
            f"whole brain, check the size of the voxels in its header ({1e3 * self.labels.voxel_ml:.3g} mm3)"
        ]

    def _described(self, label: int) -> str:
        """'Left-Lesion' (25, 3.1 ml)"""
        name = self.names[label]
        if not self.advice.gives_sizes:
            return repr(name or f"label {label}")
        return f"{name!r} ({label}, {self._size([label])})" if name else f"label {label} ({self._size([label])})"

    def _millilitres(self, labels: Iterable[int]) -> float:
        return float(self.counts[list(labels)].sum() * self.labels.voxel_ml)

    def _size(self, labels: Iterable[int]) -> str:
        size_ml = self._millilitres(labels)
        return f"{size_ml:.0f} ml" if size_ml >= 10 else f"{size_ml:.2g} ml"


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


def _tissue_of_file(source: str) -> str | None:
    """The tissue that a file is called after: glioma.nii.gz."""
    name = PurePath(source).name.split(".")[0]
    try:
        return tissue_named(name).name
    except SimulationError:
        return nearest_tissue(name)


# ---- where a labelled brain was cut off: a brain is round, and its outermost slices are small ------------------------

#: Share of the largest slice that the outermost has where a brain was cut (0.36 where a tenth of its extent is gone);
#: of whole ones it is below 0.1, at slices of 3 mm. In thicker slices than this, it tells nothing.
_FLAT, _THICKEST_MM = 0.2, 5.0
#: Smaller pieces are not judged, and none that fill less of their box, which a brain fills by half
LEAST_ML, _LEAST_FILLED = 100.0, 0.2
#: Grey and white matter of a whole brain have more; a newborn's has 300
WHOLE_ML = 600.0
#: Share of one side's volume that the other has at least, by names, and the volume from which both are there: labels of
#: the right side may have been given the names of the left
_LEAST_SIDE, _BOTH_SIDES_ML = 0.5, 750.0
_LEFT, _RIGHT = (re.compile(rf"(^|[-_ ])({words})([-_ ]|$)", re.IGNORECASE) for words in ("left|lh", "right|rh"))


def cut_sides(labels: Volume, names: Mapping[int, str | None], counts: np.ndarray) -> list[str]:
    """At which sides a brain was cut off, or which side is mostly missing: of left, right, back, front, bottom, top.

    Parameters
    ----------
    labels : (k, j, i) whole numbers, the labels.
    names : {label: name} of the labels that are brain; None for one without a name.
    counts : voxels of label 0, 1, 2, ...
    """
    if counts[list(names)].sum() * labels.voxel_ml < LEAST_ML:
        return []
    inside = _inside(labels, names, counts)
    found = set(_flat_sides(inside, labels))
    left, right = (
        sum(int(counts[label]) for label, name in names.items() if name and side.search(name))
        for side in (_LEFT, _RIGHT)
    )
    is_half = inside.sum() * labels.voxel_ml < _BOTH_SIDES_ML
    if is_half and min(left, right) < _LEAST_SIDE * max(left, right):
        found.add("left" if left < right else "right")
    return [side for sides in SIDES for side in sides if side in found]


def is_solid(labels: Volume, names: Mapping[int, str | None], counts: np.ndarray) -> bool:
    """Whether labels, as for cut_sides, fill their box as a piece of a brain does, and not as scattered pieces."""
    return _filled(_inside(labels, names, counts)) >= _LEAST_FILLED


def _inside(labels: Volume, names: Mapping[int, str | None], counts: np.ndarray) -> np.ndarray:
    """(k, j, i) True in the labels that have these names."""
    lookup = np.zeros(len(counts), bool)
    lookup[list(names)] = True
    return lookup[labels.array]


def _filled(inside: np.ndarray) -> float:
    boxes = [np.flatnonzero(inside.any(axis=tuple(other for other in range(3) if other != axis))) for axis in range(3)]
    return float(inside.sum() / np.prod([float(np.ptp(box) + 1) for box in boxes]))


def _flat_sides(inside: np.ndarray, labels: Volume) -> list[str]:
    if _filled(inside) < _LEAST_FILLED:
        return []
    sides = []
    for axis, column in enumerate((2, 1, 0)):  # of (k, j, i), and of the matrix
        if labels.spacing_mm[column] > _THICKEST_MM:
            continue
        areas = inside.sum(axis=tuple(other for other in range(3) if other != axis))
        occupied = np.flatnonzero(areas)
        for end, side in zip(occupied[[0, -1]], labels.ends[column], strict=True):
            if areas[end] > _FLAT * areas.max():
                sides.append(side)
    return sides
