"""Numbering schemes of programs that write label maps, and recognition of the one that a label map uses.

Numbers alone are often not enough: 2, 3 and 4 are white matter, cortex and ventricle for FreeSurfer, kidneys and gall
bladder for TotalSegmentator. What the numbers stand for has its place in the body, however: the left hemisphere is left
of the right one, a vertebra is above the next lower one. A scheme is therefore accepted only if the positions agree,
and one of organs only if the labels do not lie around each other, as skin, skull and brain do: their centres are close
together, and any order of them is chance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache

import numpy as np

from SlicerUSSim.Logic.base.errors import either
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.tissue import freesurfer, totalsegmentator
from SlicerUSSim.Logic.tissue.brain_orders import BRAIN_TISSUES, BrainLabels
from SlicerUSSim.Logic.tissue.names import same_name
from SlicerUSSim.Logic.tissue.thinning import centres_of, label_places, lie_apart

#: At least this share of the positions of structures has to agree with a scheme, and this number of them.
_AGREEING, _FEWEST = 0.85, 3
#: Share of a file's labels that a scheme has to know.
_KNOWN = 0.85
#: The same if the places of structures leave no doubt; the other labels are then listed as unknown.
_KNOWN_IF_SURE = 0.6
#: Pairs of left and right that leave no doubt about FreeSurfer's numbers; or regions of the cortex
_SURE = 8
#: A label map of a tumour alone is smaller than this, and fills less of its box; a labelled brain is larger, and a part
#: of one fills its box.
_LARGEST_LESION_ML, _LARGEST_LESION_SHARE = 400.0, 0.25
#: Share of the voxels of label 4 that are two voxels and more from others, up to which it may be leptomeninges, which
#: `ussim segment` makes one or two voxels thin: 0.00 there, 0.2 to 0.6 in tumours, nuclei and white matter
_THICK = 0.05
#: What `ussim segment` writes of a T1 with contrast agent, but for 4, what enhances: no other program numbers
#: leptomeninges behind it. And the largest share that enhances
_OF_CONTRAST, _LARGEST_ENHANCING = {**dict(enumerate(BRAIN_TISSUES, 1)), 5: "leptomeninges"}, 0.15
#: Share of the voxels beside leptomeninges that is white matter
_IN_WHITE = 0.4
#: A brain with the fluid around it has up to 2 litres.
_LARGEST_BRAIN_ML = 3000.0


#: Schemes of organs in a CT
_OF_CT = ("totalsegmentator", "totalsegmentator-v1")


@dataclass(frozen=True)
class Scheme:
    """The numbering of one program."""

    #: As a user writes it: --map freesurfer
    key: str
    title: str
    #: {label: name}
    names: Mapping[int, str]
    #: (axis of RAS, labels whose centres have increasing coordinates along it)
    order: list[tuple[int, list[int]]] = field(default_factory=list)
    #: Whether it labels lesions only, and no patient around them
    is_lesion: bool = False


@dataclass(frozen=True)
class Recognition:
    """What a label map was recognised as."""

    scheme: Scheme | None
    #: Other schemes that fit as well; then `scheme` is None
    candidates: tuple[Scheme, ...] = ()
    #: A scheme that has all labels, but whose places cannot be compared to be sure; then `scheme` is None
    possible: Scheme | None = None
    #: Why not
    doubt: str = ""
    #: {label: tissue} of the only order of CSF, grey and white matter that fits three labels of a brain, and no scheme;
    #: other labels are unknown
    order: Mapping[int, str] = field(default_factory=dict)


@cache
def schemes() -> dict[str, Scheme]:
    """{key: Scheme} of all that are known."""
    entries = [
        Scheme(
            "freesurfer", "FreeSurfer", freesurfer.freesurfer_names(),
            [(0, list(pair)) for pair in freesurfer.freesurfer_sides()],
        )
    ]  # fmt: skip
    for key, title, names in (
        ("totalsegmentator", "TotalSegmentator CT", totalsegmentator.CT),
        ("totalsegmentator-v1", "TotalSegmentator CT, version 1", totalsegmentator.CT_V1),
        ("totalsegmentator-mr", "TotalSegmentator MR", totalsegmentator.MR),
    ):
        order = totalsegmentator.anatomical_order(names)
        entries.append(Scheme(key, title, totalsegmentator.numbered(names), order))
    # Its task tissue_types: https://github.com/wasserth/TotalSegmentator, "Subtasks"
    layers = {1: "subcutaneous_fat", 2: "torso_fat", 3: "skeletal_muscle"}
    entries.append(Scheme("totalsegmentator-tissues", "TotalSegmentator tissue_types", layers))
    # FSL's FAST (<name>_seg, <name>_pveseg of a T1) numbers alike: https://fsl.fmrib.ox.ac.uk/fsl/docs/structural/fast
    fluid_first = {1: "csf", 2: "grey matter", 3: "white matter", 4: "leptomeninges"}
    entries.append(Scheme("ussim", "numbers of ussim segment and FSL FAST, with grey around white matter", fluid_first))
    # Menze et al., IEEE Trans. Med. Imaging 34 (2015); 2017 to 2022 with 4 for the enhancing tumour, since 2023 with 3;
    # since 2024 (de Verdier et al., arXiv:2405.18368) with 4 for the resection cavity.
    before = {1: "necrotic core", 2: "oedema", 4: "enhancing tumour"}
    since = {1: "necrotic core", 2: "oedema", 3: "enhancing tumour", 4: "resection cavity"}
    entries.append(Scheme("brats-2022", "BraTS 2017 to 2022", before, is_lesion=True))
    entries.append(Scheme("brats", "BraTS since 2023", since, is_lesion=True))
    return {scheme.key: scheme for scheme in entries}


def recognised(labels: Volume, values: list[int]) -> Recognition:
    """The scheme of a label map with these labels other than 0, by their numbers and places.

    Parameters
    ----------
    labels : (k, j, i) whole numbers.
    """
    places = label_places(labels)
    centres = centres_of(places)
    possible = None
    may_be_freesurfers = False
    fits: list[tuple[int, Scheme]] = []
    for scheme in schemes().values():
        known = np.mean([value in scheme.names for value in values])
        if not scheme.order or known < _KNOWN_IF_SURE:
            continue
        holds, reverse, count = _agreement(scheme.order, centres)
        if scheme.key == "freesurfer":
            recognition = _freesurfer(scheme, values, float(known), holds, reverse, count)
            if recognition is not None:
                return recognition
            usual = np.mean([freesurfer.is_usual(value) for value in values])
            may_be_freesurfers = len(values) > 1 and known == 1 and usual >= _KNOWN and holds >= _AGREEING * count
            if len(values) > 1 and min(known, usual) == 1 and holds >= _AGREEING * count:
                possible = Recognition(None, possible=scheme, doubt="structures of both sides are too few to be sure")
            elif count > 1 and min(known, usual) == 1:
                doubt = "structures of the left do not lie to the left of those of the right: check the orientation in "
                possible = Recognition(None, possible=scheme, doubt=f"{doubt}its header")
        elif known >= _KNOWN and count >= _FEWEST and holds >= _AGREEING * count and lie_apart(places):
            fits.append((holds, scheme))
    if not fits:
        brain = _of_brain(labels, values)
        return possible if possible and brain.scheme is None and not brain.order else brain
    most = max(holds for holds, _ in fits)
    best = [scheme for holds, scheme in fits if holds == most]
    if may_be_freesurfers:  # one hemisphere, whose numbers a few organs have as well
        best = [schemes()["freesurfer"], *best]
    if len({tuple(scheme.names.get(value) for value in values) for scheme in best}) > 1:
        return Recognition(None, tuple(best))
    return Recognition(best[0])


def schemes_of_ct() -> list[Scheme]:
    """Those that number organs of a CT; brains' are none."""
    return [schemes()[key] for key in _OF_CT]


def recognised_in_ct(labels: Volume, values: list[int]) -> tuple[tuple[Scheme, ...], bool]:
    """(schemes of organs that a label map with these labels may have, whether the places of organs leave no doubt).

    Parameters
    ----------
    labels : (k, j, i) whole numbers.
    """
    places, fits = label_places(labels), []
    centres = centres_of(places)
    if len(places) >= _FEWEST and not lie_apart(places):
        return (), False
    for scheme in schemes_of_ct():
        holds, _, count = _agreement(scheme.order, centres)
        if np.mean([value in scheme.names for value in values]) >= _KNOWN and holds >= _AGREEING * count:
            fits.append((holds, count, scheme))
    sure = [fit for fit in fits if fit[1] >= _FEWEST]
    most = max((holds for holds, _, _ in sure), default=0)
    best = tuple(scheme for holds, _, scheme in sure if holds == most)
    return (best, True) if best else (tuple(scheme for _, _, scheme in fits), False)


def _freesurfer(
    scheme: Scheme, values: list[int], known: float, holds: int, reverse: int, count: int
) -> Recognition | None:
    """FreeSurfer's numbers, if enough pairs of a left and a right structure lie as they should, or all are mirrored."""
    usual = np.mean([freesurfer.is_usual(value) for value in values])
    if count >= _SURE and usual >= _KNOWN and reverse >= _AGREEING * count:
        return Recognition(scheme)
    if holds < _AGREEING * count:
        return None
    regions = sum(map(freesurfer.is_region, values))
    is_sure = count >= _SURE or (min(usual, known) >= _KNOWN and (count >= 2 or regions >= _SURE))
    return Recognition(scheme) if is_sure else None


def title_of(scheme: Scheme, values: list[int]) -> str:
    """The scheme, and which of its segmentations this is."""
    if scheme.key != "freesurfer":
        return _title_with_alike(scheme, values)
    if any(value >= 11100 for value in values):
        return "FreeSurfer aparc.a2009s+aseg"
    if any(3000 <= value <= 5002 for value in values):
        return "FreeSurfer wmparc"
    if any(1000 <= value < 3000 for value in values):
        return "FreeSurfer or FastSurfer aparc+aseg"
    if any(value in (31, 63, 77, 85, *range(251, 256)) for value in values):
        return "FreeSurfer aseg"
    return "FreeSurfer's numbers, as SynthSeg uses them" if 24 in values else "FreeSurfer aseg"


def _title_with_alike(scheme: Scheme, values: list[int]) -> str:
    """The scheme's title; of TotalSegmentator's, with the others that call these labels the same."""
    family = "TotalSegmentator "
    alike = [
        other.title.removeprefix(family).replace(", ", " of ")
        for other in schemes().values()
        if other.order and other.title.startswith(family)
        and all(other.names.get(value) == scheme.names.get(value) for value in values)
    ]  # fmt: skip
    return f"{family}{either(alike)}" if scheme.title.startswith(family) and len(alike) > 1 else scheme.title


def scheme_with_names(names: Mapping[int, str]) -> Scheme | None:
    """The scheme that gives most of these labels these names, if there is one."""
    if not names:
        return None
    shares = {
        key: np.mean([same_name(name, scheme.names.get(label, "")) for label, name in names.items()])
        for key, scheme in schemes().items()
    }
    best = max(shares, key=lambda key: shares[key])
    return schemes()[best] if shares[best] >= _KNOWN else None


def _of_brain(labels: Volume, values: list[int]) -> Recognition:
    """A brain as `ussim segment` numbers it or in another order, or a tumour as BraTS does, with labels from 1 to 4."""
    known = schemes()
    has_few = set(values) <= set(known["brats"].names)
    is_with_others = {1, 2, 3} <= set(values) <= {1, 2, 3, 4, 5}  # what enhances and leptomeninges of `ussim segment`
    if len(values) < 2 or not (has_few or len(values) == 3 or is_with_others):
        return Recognition(None)
    if has_few and 4 in values and 3 not in values:  # a brain without white matter, but with thin sulci, is none
        return Recognition(known["brats-2022"])
    filled = int(np.count_nonzero(labels.array))
    volume_ml = filled * labels.voxel_ml
    if volume_ml < _LARGEST_LESION_ML and filled < _LARGEST_LESION_SHARE * labels.array.size:
        return Recognition(known["brats"] if has_few else None)
    if volume_ml > _LARGEST_BRAIN_ML:
        return Recognition(None)
    has_other_numbers = len(values) == 3 and not has_few
    tissues = BrainLabels.of(labels, tuple(value for value in values if value < 4 or has_other_numbers))
    is_ours = has_few and {2, 3} <= set(values) and tissues.fits(1, 2, 3)
    if is_ours and (4 not in values or _is_leptomeninges(labels, 4, white=3)):
        return Recognition(known["ussim"])
    three = (1, 2, 3) if {1, 2, 3} <= set(values) else tuple(values)
    if len(three) != 3:
        return Recognition(None)
    orders = [dict(zip(three, BRAIN_TISSUES, strict=True))] if is_ours else BrainLabels.of(labels, three).orders()
    if len(orders) != 1:
        return Recognition(None)
    (order,) = orders
    white = next(label for label, tissue in order.items() if tissue == "white matter")
    thin = [value for value in values if value not in three and _is_leptomeninges(labels, value, white=white)]
    order |= dict.fromkeys(thin[-1:], "leptomeninges")
    if order == _OF_CONTRAST and np.count_nonzero(labels.array == 4) <= _LARGEST_ENHANCING * filled:
        order = order | {4: "enhancing"}
    return Recognition(None, order=order)


def _is_leptomeninges(labels: Volume, label: int, *, white: int) -> bool:
    """Whether a label is at most two voxels thick nearly everywhere, and does not lie in white matter."""
    from scipy import ndimage

    array = labels.array == label
    if np.asarray(ndimage.binary_erosion(array)).sum() > _THICK * array.sum():
        return False
    beside = np.asarray(ndimage.binary_dilation(array)) & ~array
    return bool((labels.array[beside] == white).mean() <= _IN_WHITE)


def _agreement(order: list[tuple[int, list[int]]], centres: Mapping[int, np.ndarray]) -> tuple[int, int, int]:
    """Of pairs of neighbours in the order: those that lie as they should, those that lie the other way round, and all.

    Pairs of which one structure is not there are left out.
    """
    holds = reverse = count = 0
    for axis, row in order:
        steps = np.diff([centres[label][axis] for label in row if label in centres])
        holds, reverse = holds + int(np.sum(steps > 0)), reverse + int(np.sum(steps < 0))
        count += len(steps)
    return holds, reverse, count
