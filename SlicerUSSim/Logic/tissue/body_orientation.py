"""Whether a labelled body lies in its volume as its header says: by the places of structures that have names.

Other than places of a head (below), which may be tilted, these are compared along one axis only: nobody lies
across a scanner, so that a body whose vertebrae descend towards the head has a wrong header.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

import numpy as np

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.tissue.names import plain_name
from SlicerUSSim.Logic.tissue.thinning import label_centres, thinning
from SlicerUSSim.Logic.tissue.totalsegmentator import FORWARDS, RIGHTWARDS, UPWARDS

#: Neighbours in these rows that tell at least, and the share of them that is the other way round in a turned body
_PAIRS, _REVERSED = 3, 0.8
#: Tangent from which on left and right are not across the body: 55 degrees, more than any tilt of a head
_TURNED = 1.43
#: Centres nearer to each other, in mm, tell nothing
_APART_MM = 2.0

#: {words of a name: centre in RAS mm}, see places_of
Places = Mapping[frozenset[str], np.ndarray]


def places_of(labels: Volume, names: Mapping[int, str | None]) -> Places:
    """{words of a name: the centre of its labels in RAS mm}.

    Parameters
    ----------
    labels : (k, j, i) whole numbers, the labels.
    names : {label: name}; None for one that is unknown.
    """
    centres = label_centres(labels)
    return {_words(name): centres[label] for label, name in names.items() if name and label in centres}


def wrong_body(centres: Places) -> str | None:
    """What is wrong with the orientation of a body by structures of both sides, and by TotalSegmentator's names.

    None if nothing is.
    """
    across = _across(centres)
    if across is not None and np.hypot(*across[1:]) > _TURNED * abs(across[0]):
        axis = "posterior to anterior" if abs(across[1]) > abs(across[2]) else "inferior to superior"
        return f"structures of the left and right side lie along the axis from {axis}: it is turned by 90 degrees"
    for axis, rows, wrong in ((2, UPWARDS, "upside down"), (1, FORWARDS, "back to front")):
        steps = _steps(centres, axis, rows)
        if len(steps) >= _PAIRS and np.mean(np.array(steps) < 0) >= _REVERSED:
            return f"structures lie in the wrong order: the body is {wrong}"
    return None


def has_exchanged_sides(centres: Places) -> bool:
    """Whether what is called left is on the right, of all structures with a name for both sides."""
    steps = [step[0] for step in _to_the_right(centres)] + _steps(centres, 0, RIGHTWARDS)
    told = np.array([step for step in steps if abs(step) > _APART_MM])
    return len(told) > 0 and bool(np.mean(told < 0) >= _REVERSED)


def _to_the_right(centres: Places) -> list[np.ndarray]:
    """From each structure of the left side to that of the right, mm in RAS."""
    pairs = [(name, (name - {"left"}) | {"right"}) for name in centres if "left" in name]
    return [centres[right] - centres[left] for left, right in pairs if right in centres]


def _across(centres: Places) -> np.ndarray | None:
    """The mean direction from left to right; None if there are too few structures of both sides."""
    steps = _to_the_right(centres)
    directions = [step / np.linalg.norm(step) for step in steps if np.linalg.norm(step) > _APART_MM]
    return np.mean(directions, axis=0) if len(directions) >= _PAIRS else None


def _steps(centres: Places, axis: int, rows: Iterable[list[str]]) -> list[float]:
    """From each structure to the next in its row, mm along an axis of RAS; those without a place are left out."""
    steps = []
    for row in rows:
        places = [centres[name][axis] for name in map(_words, row) if name in centres]
        steps += [step for step in np.diff(places) if abs(step) > _APART_MM]
    return steps


def _words(name: str) -> frozenset[str]:
    """The words of a name, in any order: "kidney_left" and "Left kidney"."""
    return frozenset({"lh": "left", "rh": "right"}.get(word, word) for word in plain_name(name).split())


# ---- is a labelled head the right way up? ----------------------------------------------------------------------------
# A head may be tilted in the scanner, so that "below" alone does not tell a mirrored head from a tilted one. Two
# directions do, seen from the right: from the centre of the cerebrum, the cerebellum is always clockwise of the brain
# stem; mirrored upside down or back to front, it is anticlockwise of it.

#: (structure, words in its names), of which the first that is found counts
_STRUCTURES = (
    ("cerebellum", re.compile(r"\b(cerebell\w+|cbm\w*|cblumnodulus|vermis)\b")),
    ("brain stem", re.compile(r"\b(brain ?stem|midbrain|pons|medulla oblongata)\b|^medulla$")),
    ("cerebrum", re.compile(r"\b(cerebral|cerebrum|ctx|wm [lr]h|white matter|gr[ea]y matter)\b")),
)
#: Directions from the cerebrum's centre, (anterior, superior); mean of four heads (an aseg and three of SynthSeg's
#: training data), which differ by up to 30 degrees
_USUAL = {"cerebellum": (-33.0, -52.0), "brain stem": (-7.0, -44.0)}
#: The sine from the cerebellum to the brain stem is 0.37 to 0.44 in those; it is near 0 in their posterior halves.
_MIRRORED = -0.25
#: A head is tilted by less, in degrees; one whose axes are exchanged is turned by 90. With both known, a mirrored one
#: is found by its sine. The cerebellum alone is turned by 65 to 115 degrees in a mirrored head, the brain stem by 160.
_MOST_TILTED = {"both": 60.0, "brain stem": 75.0, "cerebellum": 75.0}
#: Nearer to the cerebrum's centre, in mm, a direction is not known: a part of a brain
_NEAREST_MM = 15.0


def wrong_way_up(labels: Volume, names: Mapping[int, str | None], *, is_whole: bool = True) -> str | None:
    """What is wrong with the orientation of a head whose labels have these names, in words; None if nothing is.

    Of a part of a brain, whose centre lies elsewhere, only a mirrored one is found.

    Parameters
    ----------
    labels : (k, j, i) whole numbers, the labels.
    names : {label: name}; None for one that is unknown.
    """
    directions = _directions(labels, names)
    if not directions:
        return None
    angles = {name: _turn(_USUAL[name], direction) for name, direction in directions.items()}
    structures = " and ".join(sorted(directions))
    above_mm = float(np.mean([direction[1] for direction in directions.values()]))
    where = f"{'above' if above_mm > 0 else 'below'} the cerebrum's centre by {abs(above_mm):.0f} mm"
    if len(directions) == 2:
        sine = np.sin(np.radians(_turn(directions["cerebellum"], directions["brain stem"])))
        if sine < _MIRRORED:
            if above_mm > 0:
                return f"{structures} lie {where}: the head is upside down"
            return "the cerebellum lies in front of the brain stem: the head is back to front"
        if not is_whole:
            return None
        both = np.sum([np.exp(1j * np.radians(angle)) for angle in angles.values()])
        tilt, most = abs(float(np.degrees(np.angle(both)))), _MOST_TILTED["both"]
    elif not is_whole:
        return None
    else:
        ((only, angle),) = angles.items()
        tilt, most = abs(angle), _MOST_TILTED[only]
    if tilt <= most:
        return None
    verb = "lie" if len(directions) == 2 else "lies"
    return f"{structures} {verb} {where}: the head is upside down or turned by {tilt:.0f} degrees"


def _directions(labels: Volume, names: Mapping[int, str | None]) -> dict[str, tuple[float, float]]:
    """{structure: (anterior, superior) mm from the cerebrum's centre} of those that are far enough from it."""
    of_label = {label: _structure(name) for label, name in names.items() if name}
    if "cerebrum" not in of_label.values() or not set(_USUAL) & set(of_label.values()):
        return {}
    step = thinning(labels.array)
    array = labels.array[::step, ::step, ::step]
    centres = {}
    for structure, _ in _STRUCTURES:
        where = np.nonzero(np.isin(array, [label for label, found in of_label.items() if found == structure]))
        if where[0].size:
            ijk = np.array([axis.mean() * step for axis in where[::-1]])
            centres[structure] = labels.ijk_to_ras[:3, :3] @ ijk + labels.ijk_to_ras[:3, 3]
    cerebrum = centres.pop("cerebrum", None)
    if cerebrum is None:
        return {}
    found = {structure: centre[1:] - cerebrum[1:] for structure, centre in centres.items()}
    return {
        structure: (float(offset[0]), float(offset[1]))
        for structure, offset in found.items()
        if np.hypot(*offset) >= _NEAREST_MM
    }


def _structure(name: str) -> str | None:
    plain = plain_name(name)
    return next((structure for structure, words in _STRUCTURES if words.search(plain)), None)


def _turn(start: tuple[float, float], end: tuple[float, float]) -> float:
    """Degrees from one direction (anterior, superior) to another, positive from anterior to superior."""
    return float(np.degrees(np.angle(complex(*end) / complex(*start))))
