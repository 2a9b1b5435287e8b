"""A weak Markov random field: neighbours tend to be of the same tissue (Zhang et al., IEEE TMI 20(1), 2001)."""

from __future__ import annotations

import numpy as np

#: Weight of a neighbour, and number of mean-field iterations
_WEIGHT, _ITERATIONS = 0.25, 3


def smoothed_posteriors(posteriors: np.ndarray, inside: np.ndarray, weight: float = _WEIGHT) -> np.ndarray:
    """(classes, voxels) posteriors of the voxels `inside` (k, j, i), led by those of their six neighbours.

    Mean field: the log-odds of every voxel are those of its intensity plus `weight` times the sum of the neighbours'
    posteriors, less what these are on average over the classes of the voxel's own intensity.
    """
    classes = len(posteriors)
    padded = np.zeros((classes, *(n + 2 for n in inside.shape)), np.float32)
    core = padded[:, 1:-1, 1:-1, 1:-1]
    result = posteriors
    for _ in range(_ITERATIONS):
        core[:, inside] = result
        around = np.zeros((classes, *inside.shape), np.float32)
        for axis in range(3):
            for start in (0, 2):
                part = [slice(1, -1)] * 3
                part[axis] = slice(start, start + inside.shape[axis])
                around += padded[(slice(None), *part)]
        result = posteriors * np.exp(weight * around[:, inside])
        result /= result.sum(axis=0)
    return result
