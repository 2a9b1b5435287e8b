"""Numberings of programs that write label maps: labels/*.csv, with numbers, names, tissues and SNOMED CT codes.

Numbers and names are from FreeSurfer's FreeSurferColorLUT.txt
(https://surfer.nmr.mgh.harvard.edu/fswiki/FsTutorial/AnatomicalROI/FreeSurferColorLUT), without 500 to 558, parts of
the hippocampus that other programs use for bone and skin; of SynthSeg's and FastSurfer's tables, which are parts of
it; of TotalSegmentator's class details (https://github.com/wasserth/TotalSegmentator); of FSL
(https://fsl.fmrib.ox.ac.uk/fsl/docs/structural/fast); and of BraTS (Menze et al., IEEE Trans. Med. Imaging 34, 2015;
since 2024 with a resection cavity: de Verdier et al., arXiv:2405.18368).

Many programs use the same numbers. A label map is a program's whose numbers occur completely, or else one whose usual
numbers hold all labels. Labels that count from 1 without a gap are anybody's, and are only read if they are complete.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cache

from SlicerUSSim.Logic.tissue.names import label_table

_TITLES = {
    "ussim": "ussim segment and FSL FAST", "ussim-t1gd": "ussim segment of a T1 with contrast agent",
    "spm": "SPM and fMRIPrep", "freesurfer": "FreeSurfer", "synthseg": "SynthSeg", "fastsurfer": "FastSurfer",
    "fsl-first": "FSL FIRST", "totalsegmentator": "TotalSegmentator CT",
    "totalsegmentator-v1": "TotalSegmentator CT, version 1", "totalsegmentator-mr": "TotalSegmentator MR",
    "totalsegmentator-tissues": "TotalSegmentator tissue_types", "brats-2022": "BraTS 2017 to 2022",
    "brats": "BraTS since 2023",
}  # fmt: skip
#: Those of organs of a CT
OF_CT = ("totalsegmentator", "totalsegmentator-v1")


@dataclass(frozen=True)
class Scheme:
    """The numbering of one program."""

    #: As a user writes it: --map freesurfer
    key: str
    title: str
    #: {label: name} and {label: tissue}
    names: Mapping[int, str]
    tissues: Mapping[int, str]
    #: Labels that every label map of the program has, and those that few have
    always: frozenset[int]
    seldom: frozenset[int]

    @property
    def is_lesion(self) -> bool:
        """Whether it labels lesions only, and no patient around them."""
        return self.key.startswith("brats")


@cache
def schemes() -> dict[str, Scheme]:
    """{key: Scheme} of all that are known."""
    return {key: _scheme(key, title) for key, title in _TITLES.items()}


def _scheme(key: str, title: str) -> Scheme:
    rows = {int(row["number"]): row for row in label_table(key)}
    always, seldom = (
        frozenset(label for label, row in rows.items() if row["occurs"] == word) for word in ("always", "seldom")
    )
    names, tissues = ({label: row[column] for label, row in rows.items()} for column in ("name", "tissue"))
    return Scheme(key, title, names, tissues, always, seldom)


def recognised(values: Collection[int], *, of_ct: bool = False) -> tuple[Scheme | None, list[Scheme]]:
    """(the scheme of a label map with these labels other than 0, or None, schemes that a user may mean).

    The latter give the labels different tissues, and hold all of them.
    """
    labels = set(values)
    known = [
        scheme for scheme in schemes().values()
        if labels <= scheme.names.keys() and (scheme.key in OF_CT or not of_ct)
    ]  # fmt: skip
    complete = [scheme for scheme in known if scheme.always and scheme.always <= labels]
    usual = [scheme for scheme in known if not labels & scheme.seldom]
    is_counted = len(labels) == max(labels, default=0)
    choices = {
        tuple(scheme.tissues[label] for label in labels): scheme for scheme in (complete or usual or known)[::-1]
    }
    found = list(choices.values())[::-1]
    is_sure = len(found) == 1 and bool(complete or (usual and not is_counted))
    return (found[0] if is_sure else None), found
