"""Axes of a local search: directions that change the images, each in steps that change them equally.

Attenuation and time-gain compensation, or gain and echogenicity, hardly change an image if they change together, and
change it much one without the other. Along the parameters themselves such a cost is a narrow oblique valley, in which a
local search stops before it reaches the bottom (docs/optimization.md#search). The axes here are the eigenvectors of
J^T J, where J is the change of the images' patches with the parameters (the metric of Gauss and Newton).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

#: Step of the differences, with bounds scaled to 0 and 1.
_DIFFERENCE = 0.02
#: Patches with fewer pixels have no standard deviation to speak of.
_LEAST_PIXELS = 20
#: A step of the search changes a patch by this fraction of the grey scale, but a parameter by no more than that part
#: of its bounds, where images hardly change.
FIRST_STEP, _LARGEST_STEP = 0.1, 0.3


def patch_statistics(image: np.ndarray, inside: np.ndarray, patch: tuple[int, int]) -> np.ndarray:
    """(2, patches) mean and standard deviation of grey levels in square patches, in fractions of the grey scale.

    Parameters
    ----------
    image : (rows, columns) uint8.
    inside : (rows, columns) bool, the pixels that count; patches with fewer than 20 of them are left out.
    patch : (rows, columns) of a patch, in pixels.
    """
    rows, columns = image.shape
    across = -(-columns // patch[1])
    number = ((np.arange(rows) // patch[0])[:, None] * across + np.arange(columns) // patch[1])[inside]
    grey = image[inside] / 255.0
    count = np.bincount(number)
    kept = count >= min(_LEAST_PIXELS, count.max())
    mean, square = (np.bincount(number, values)[kept] / count[kept] for values in (grey, grey * grey))
    return np.stack([mean, np.sqrt(np.maximum(square - mean * mean, 0.0))])


def search_axes(statistics_of: Callable[[np.ndarray], np.ndarray], units: np.ndarray) -> np.ndarray:
    """(parameters, parameters) columns by which positions change per unit of the search's coordinates.

    A unit along an axis changes `statistics_of` by 1 (root of the mean square), as far as it is linear; where it hardly
    changes at all, a parameter by 3 times its bounds, so that FIRST_STEP is 0.3 of them.

    Parameters
    ----------
    statistics_of : function of (parameters,) positions, 0 to 1 between the bounds, to an array of fixed shape.
    units : (parameters,) position at which the change is measured, by differences of 0.02 to either side.

    >>> import numpy as np
    >>> from SlicerUSSim.Logic.fitting.sensitivity import search_axes
    >>> axes = search_axes(lambda units: np.array([10.0 * (units[0] - units[1])]), np.array([0.5, 0.5]))
    >>> [round(float(size), 2) for size in sorted(np.linalg.norm(axes, axis=0))]  # against each other, and together
    [0.07, 3.0]
    """
    changes = []
    for place in range(len(units)):
        ends = np.repeat(np.asarray(units, float)[None], 2, axis=0)
        ends[:, place] = np.clip(units[place] + np.array([-_DIFFERENCE, _DIFFERENCE]), 0.0, 1.0)
        low, high = (np.ravel(statistics_of(end)) for end in ends)
        changes.append((high - low) / (ends[1, place] - ends[0, place]))
    jacobian = np.array(changes)
    power, axes = np.linalg.eigh(jacobian @ jacobian.T / jacobian.shape[1])
    return axes / np.sqrt(np.maximum(power, 0.0) + (FIRST_STEP / _LARGEST_STEP) ** 2)
