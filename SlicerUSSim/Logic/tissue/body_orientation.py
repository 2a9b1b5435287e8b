"""Whether a labelled body lies in its volume as its header says: by the places of structures that have names.

Other than places of a head (upright.py), which may be tilted, these are compared along one axis only: nobody lies
across a scanner, so that a body whose vertebrae descend towards the head has a wrong header.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.tissue.names import plain_name
from SlicerUSSim.Logic.tissue.thinning import label_centres
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
