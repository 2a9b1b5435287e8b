"""Whether a labelled head is the right way up by its header: where brain stem and cerebellum lie below the cerebrum.

A head may be tilted in the scanner, so that "below" alone does not tell a mirrored head from a tilted one. Two
directions do, seen from the right: from the centre of the cerebrum, the cerebellum is always clockwise of the brain
stem, however the head is tilted; mirrored upside down or back to front, it is anticlockwise of it. How far both are
turned from where they are in a head that looks straight ahead is the tilt.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.tissue.names import plain_name
from SlicerUSSim.Logic.tissue.thinning import thinning

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
