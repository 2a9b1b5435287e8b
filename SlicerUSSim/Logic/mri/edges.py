"""What the edges of an image tell: its background, and what it cuts off."""

from __future__ import annotations

import numpy as np

from SlicerUSSim.Logic.base.volume import SIDES, Volume

#: Least area of the brain at an edge of the image that is reported, and at the bottom, where the stem leaves, cm2
_WORTH_CM2, _WORTH_AT_BASE_CM2 = 6.0, 20.0


def edge_value(values: np.ndarray) -> tuple[float, float]:
    """(the most frequent value at the six edges of a (k, j, i) image, its share of them)."""
    border = np.concatenate([values[[0, -1]].ravel(), values[:, [0, -1]].ravel(), values[:, :, [0, -1]].ravel()])
    levels, counts = np.unique(border, return_counts=True)
    return levels[counts.argmax()], float(counts.max() / border.size)


def ends_at_edge(mri: Volume, inside: np.ndarray) -> tuple[str, ...]:
    """One line for each edge of the image that cuts the brain (k, j, i) off; at the bottom only over a larger area.

    A whole brain does not reach the edge except at the stem, however little of scalp and skull is shown.
    """
    return tuple(
        f"the brain reaches the {name} edge of the image over {area:.0f} cm2: it is cut off there"
        for name, area in areas_at_edges(mri, inside)
        if area >= (_WORTH_AT_BASE_CM2 if name == "bottom" else _WORTH_CM2)
    )


def areas_at_edges(mri: Volume, inside: np.ndarray) -> list[tuple[str, float]]:
    """(side of the patient, cm2 of a mask (k, j, i) at that edge of the image) of all six edges."""
    areas = []
    for axis in range(3):
        others = [other for other in range(3) if other != axis]
        cm2 = float(np.linalg.norm(np.cross(*mri.ijk_to_ras[:3, others].T))) / 100.0
        for end in (0, -1):
            outwards = mri.ijk_to_ras[:3, axis] * (1 if end else -1)
            main = int(np.abs(outwards).argmax())
            areas.append((SIDES[main][int(outwards[main] > 0)], np.count_nonzero(inside.take(end, 2 - axis)) * cm2))
    return areas
