"""Gaussian mixtures of intensities by expectation maximisation on their histogram."""

from __future__ import annotations

import numpy as np

_HISTOGRAM_BINS = 2048
_MAX_ITERATIONS = 300


def fit_mixture(values: np.ndarray, classes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Gaussian mixture of `values`, fitted by EM to their histogram.

    Returns (means, standard deviations, weights), each (classes,) in ascending order of the means, and the mean
    log-likelihood of every iteration, which never decreases.
    """
    counts, edges = np.histogram(values, _HISTOGRAM_BINS)
    levels = 0.5 * (edges[1:] + edges[:-1])
    share = counts / counts.sum()
    step = edges[1] - edges[0]
    means, deviations, weights = _first_guess(levels, counts, classes)
    likelihoods: list[float] = []
    for _ in range(_MAX_ITERATIONS):
        density = _densities(levels, means, deviations, weights)
        total = density.sum(axis=0) + 1e-300
        likelihoods.append(float(share @ np.log(total)))
        if len(likelihoods) > 1 and likelihoods[-1] - likelihoods[-2] < 1e-9:
            break
        responsibility = density / total * share
        population = responsibility.sum(axis=1) + 1e-300
        means = responsibility @ levels / population
        variances = (responsibility * (levels - means[:, None]) ** 2).sum(axis=1) / population
        # The width of a bin limits the variance from below; a class on one grey level would otherwise collapse.
        deviations = np.sqrt(np.maximum(variances, step**2 / 12.0))
        weights = population / population.sum()
    order = np.argsort(means)
    return means[order], deviations[order], weights[order], np.array(likelihoods)


def _first_guess(levels, counts, classes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means, standard deviations and weights of the classes between multi-level Otsu thresholds; deterministic."""
    from skimage.filters import threshold_multiotsu

    coarse = 8  # Otsu's search grows fast with the number of bins
    pooled = counts.reshape(-1, coarse).sum(axis=1)
    centres = levels.reshape(-1, coarse).mean(axis=1)
    thresholds = threshold_multiotsu(hist=(pooled, centres), classes=classes)
    member = np.digitize(levels, thresholds)
    share = counts / counts.sum()
    step = levels[1] - levels[0]
    weights = np.array([share[member == n].sum() for n in range(classes)]) + 1e-6
    means = np.array([(share * levels)[member == n].sum() for n in range(classes)]) / weights
    variances = np.array([(share * (levels - means[n]) ** 2)[member == n].sum() for n in range(classes)]) / weights
    return means, np.sqrt(np.maximum(variances, step**2)), weights / weights.sum()


def _densities(levels, means, deviations, weights) -> np.ndarray:
    z = (levels - means[:, None]) / deviations[:, None]
    return weights[:, None] / (np.sqrt(2.0 * np.pi) * deviations[:, None]) * np.exp(-0.5 * z**2)


def mixture_posteriors(values, means, deviations, weights) -> np.ndarray:
    """(classes, values) by a look-up over intensity, as the posterior depends on nothing else."""
    levels = np.linspace(values.min(), values.max(), 4 * _HISTOGRAM_BINS)
    density = _densities(levels, means, deviations, weights)
    table = (density / (density.sum(axis=0) + 1e-300)).astype(np.float32)
    return table[:, _nearest(levels, values)]


def classify(values, means, deviations, weights) -> np.ndarray:
    """Labels 1..classes by the largest posterior, with borders that intensity crosses once, in order.

    A wide class would otherwise win again in the far tail of a narrow neighbour (bright voxels beyond white matter
    labelled as CSF); beyond its outermost mean the first and last class keep the tail.
    """
    levels = np.linspace(values.min(), values.max(), 4 * _HISTOGRAM_BINS)
    best = np.argmax(_densities(levels, means, deviations, weights), axis=0)
    best[levels <= means[0]] = 0
    best[levels >= means[-1]] = len(means) - 1
    best = np.maximum.accumulate(best)
    return (best[_nearest(levels, values)] + 1).astype(np.uint8)


def _nearest(levels: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Index of the nearest of equally spaced `levels`; rounding in float32 must not step past the last one."""
    index = np.rint((values - levels[0]) / (levels[1] - levels[0])).astype(np.int32)
    return np.clip(index, 0, len(levels) - 1)
