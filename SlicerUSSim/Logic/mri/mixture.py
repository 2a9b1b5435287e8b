"""The mixture of tissues: three pure classes of nearly one covariance, two mixed ones, and outliers; by EM.

A voxel of a pure class has the intensity of its tissue plus noise. A mixed voxel contains two neighbouring tissues in
any proportion with equal probability, so its intensity lies on the line between their means (Laidlaw et al., IEEE TMI
17(1), 1998; Shattuck et al., NeuroImage 13(5), 2001). Vessels, lesions and what the mask leaves of the skull are
uniform outliers. The noise is the same everywhere, hence the common covariance: with free ones the widest class
swallows its neighbours. Grey matter may be a little wider, within limits: its tissue differs from place to place. With
several sequences CSF may, too.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

#: The tissues in the order of all arrays here, and the pairs that share voxels.
TISSUES = ("csf", "grey matter", "white matter")
MIXED = ((0, 1), (1, 2))
_INSIDE = len(TISSUES) + len(MIXED)
#: Share of a mixed voxel above which it counts as the second tissue
_MIDDLE = 0.5
#: Least weight of the pure classes, and of the mixed ones: at 1 mm every tissue has borders. Without these, wide pure
#: classes replace the mixed ones, or one class takes grey and white matter where their contrast is low
ANATOMICAL = np.array([1e-4, 0.2, 0.12, 0.1, 0.15])
#: Largest weights of the mixed classes in voxels of 1 mm: borders of 0.2 m^2 each, blurred over 1 to 1.5 mm
MOST_MIXED = np.array([0.25, 0.22])
#: The same without knowledge of a brain
ANY = np.full(_INSIDE, 1e-4)
_MAX_ITERATIONS, _LEAST_GAIN = 150, 1e-6
#: Grey matter's pure voxels differ among themselves, as cortex does by its myelin and deep nuclei by their iron: the
#: largest variance in units of the noise's, and the largest deviation of the tissue itself in units of its contrast to
#: white matter
_GREY, _WIDEST, _TISSUE_DEVIATION = 1, 4.0, 0.25
#: The largest variance of CSF where there are several sequences: it flows and pulses, and shows otherwise in each. With
#: the noise's, the noise of all tissues comes out twice as large, and cortex is lost
_CSF, _WIDEST_CSF = 0, 6.0


@dataclass(frozen=True, eq=False)
class Points:
    """Occupied bins of a histogram of intensities and of the spatial prior."""

    #: (points, channels) intensity
    values: np.ndarray
    #: (points,) number of voxels
    counts: np.ndarray
    #: (points, 3) prior share of each tissue, adding up to 1
    priors: np.ndarray
    #: (channels,) width of a bin
    steps: np.ndarray
    #: (outlier classes, points) density of each, which the fit leaves alone, and (outlier classes,) its largest weight
    outliers: np.ndarray
    limits: np.ndarray
    #: Mean side of a voxel, on which the share of mixed voxels depends
    voxel_mm: float = 1.0


@dataclass(frozen=True, eq=False)
class TissueMixture:
    """The parameters of the mixture. K = 3 tissues, C channels."""

    #: (K, C)
    means: np.ndarray
    #: (C, C), the same for all classes
    covariance: np.ndarray
    #: (5 + outlier classes,) of the pure classes, the mixed ones and the outliers, where the prior is even
    weights: np.ndarray
    #: Mean log-likelihood of every iteration, which never decreases
    log_likelihoods: np.ndarray
    #: (K,) variance of every pure class in units of the covariance
    spread: np.ndarray = field(default_factory=lambda: np.ones(len(TISSUES)))

    def shares(self, points: Points, blur: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """((K, points) probability that each tissue fills most of the voxel, (points,) that it is an outlier).

        They add up to 1. The noise is taken to be `blur` times that of the fit.
        """
        parts = _Parts(points, self.means, blur**2 * self.covariance, np.maximum(self.spread / blur**2, 1.0))
        density = parts.density * self.weights[:, None] * _affinity(points)
        density /= density.sum(axis=0) + 1e-300
        result = density[: len(TISSUES)].copy()
        for n, (first, second) in enumerate(MIXED):
            beyond = parts.beyond_middle(n)
            result[first] += density[len(TISSUES) + n] * (1.0 - beyond)
            result[second] += density[len(TISSUES) + n] * beyond
        return result, density[_INSIDE:].sum(axis=0)

    def slope(self, points: Points, grey: float = 1.0) -> np.ndarray:
        """(points,) derivative of the logarithm of the density by the intensity, for one channel.

        What pure grey matter adds to it counts `grey` times.
        """
        parts = _Parts(points, self.means, self.covariance, self.spread)
        density = parts.density * self.weights[:, None] * _affinity(points)
        density /= density.sum(axis=0) + 1e-300
        density[_GREY] *= grey
        values, means = points.values[:, 0], self.means[:, 0]
        pure = density[: len(TISSUES)] / self.spread[:, None]
        result = pure.T @ means - (pure.sum(axis=0) + density[len(TISSUES) : _INSIDE].sum(axis=0)) * values
        for n, (first, second) in enumerate(MIXED):
            content = parts.content(n)
            result += density[len(TISSUES) + n] * ((1.0 - content) * means[first] + content * means[second])
        return result / self.covariance[0, 0]


def fit_mixture(
    points: Points,
    means: np.ndarray,
    deviation: np.ndarray,
    *,
    least_weights: np.ndarray = ANATOMICAL,
    iterations: int = _MAX_ITERATIONS,
    spread: np.ndarray | None = None,
) -> TissueMixture:
    """The mixture by expectation maximisation from (3, channels) means and (channels,) standard deviations.

    `least_weights` (5,) are lower limits of the weights of the pure classes and the mixed ones.

    Weights follow the spatial prior as in Ashburner and Friston, NeuroImage 26(3), 2005: a class's probability in a
    voxel is its weight times its prior there, normalised. No step lowers the likelihood, unless
    the limit of grey matter's variance falls.
    """
    counts = points.counts / points.counts.sum()
    mixed = np.minimum(MOST_MIXED * max(points.voxel_mm, 1.0), 0.5)
    most = np.concatenate([np.ones(len(TISSUES)), mixed, points.limits])
    spread = np.ones(len(TISSUES)) if spread is None else spread
    covariance = np.diag(deviation**2)
    weights = np.concatenate([[0.2, 0.25, 0.25, 0.15, 0.15], 0.5 * points.limits])
    weights = _limited(weights, least_weights, most)
    affinity = _affinity(points)
    least = np.diag(points.steps**2 / 12.0)
    likelihoods: list[float] = []
    for _ in range(iterations):
        parts = _Parts(points, means, covariance, spread)
        around = weights @ affinity
        joint = parts.density * (weights[:, None] * affinity / around)
        total = joint.sum(axis=0) + 1e-300
        likelihoods.append(float(counts @ np.log(total)))
        if len(likelihoods) > 1 and likelihoods[-1] - likelihoods[-2] < _LEAST_GAIN:
            break
        belonging = joint * (counts / total)
        weights = belonging.sum(axis=1) / np.maximum(affinity @ (counts / around), 1e-12) + 1e-12
        weights = _limited(weights, least_weights, most)
        means, covariance, spread = parts.update(belonging, means, least)
    return TissueMixture(means, covariance, weights, np.array(likelihoods), spread)


class _Parts:
    """Densities of the six components at points, in coordinates in which the covariance is the identity."""

    def __init__(self, points: Points, means: np.ndarray, covariance: np.ndarray, spread: np.ndarray) -> None:
        self._points, self._spread = points, spread
        factor = np.linalg.cholesky(covariance)
        white = np.linalg.solve(factor, points.values.T).T
        centres = np.linalg.solve(factor, means.T).T
        channels = white.shape[1]
        constant = (2.0 * np.pi) ** (-channels / 2.0) / np.prod(np.diag(factor))
        away = np.stack([((white - centre) ** 2).sum(axis=1) for centre in centres])
        self.density = np.empty((_INSIDE + len(points.limits), len(white)))
        wide = spread[:, None]
        self.density[: len(TISSUES)] = constant * np.exp(-0.5 * away / wide) / wide ** (0.5 * channels)
        self.density[_INSIDE:] = points.outliers
        self._along = []
        for n, (first, second) in enumerate(MIXED):
            line = centres[second] - centres[first]
            length = max(float(np.linalg.norm(line)), 1e-6)
            along = (white - centres[first]) @ line / length
            inside = _inside(along, length)
            across = np.exp(-0.5 * np.maximum(away[first] - along**2, 0.0)) * constant * np.sqrt(2.0 * np.pi)
            self.density[len(TISSUES) + n] = across * inside / length
            self._along.append((along, length, inside))

    def beyond_middle(self, mixed: int) -> np.ndarray:
        """(points,) probability that the second tissue of a mixed class fills most of the voxel."""
        along, length, inside = self._along[mixed]
        middle = _MIDDLE * length
        return np.clip(_inside(along - middle, length - middle) / np.maximum(inside, 1e-300), 0.0, 1.0)

    def content(self, mixed: int) -> np.ndarray:
        """(points,) expected share of the second tissue of a mixed class."""
        return _content(*self._along[mixed])[0]

    def update(
        self, belonging: np.ndarray, means: np.ndarray, least: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(means, covariance, spread) that raise the expected likelihood, one after the other.

        Means and covariance are by least squares of the values on the contents.
        """
        values = self._points.values
        pure = belonging[: len(TISSUES)] / self._spread[:, None]
        normal = np.diag(pure.sum(axis=1))
        moment = pure @ values
        for n, (first, second) in enumerate(MIXED):
            part = belonging[len(TISSUES) + n]
            mean, square = _content(*self._along[n])
            for one, other, share in (
                (first, first, 1.0 - 2.0 * mean + square), (second, second, square), (first, second, mean - square),
            ):  # fmt: skip
                normal[one, other] += part @ share
            normal[second, first] = normal[first, second]
            moment[first] += (part * (1.0 - mean)) @ values
            moment[second] += (part * mean) @ values
        # A class that has vanished keeps its mean.
        hold = 1e-6 * np.eye(len(TISSUES))
        means = np.linalg.solve(normal + hold, moment + hold @ means)
        used = pure.sum(axis=0) + belonging[len(TISSUES) : _INSIDE].sum(axis=0)
        scatter = (values * used[:, None]).T @ values
        covariance = scatter - moment.T @ means - means.T @ moment + means.T @ normal @ means
        covariance = 0.5 * (covariance + covariance.T) / belonging[:_INSIDE].sum() + least
        return means, covariance, self._spread_of(belonging, means, covariance)

    def _spread_of(self, belonging: np.ndarray, means: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        """(K,) the most likely variance of the pure voxels, of which belong `belonging` (K, points), in its limits."""
        inverse = np.linalg.inv(covariance)
        contrast = means[2] - means[1]
        most = {_GREY: min(_WIDEST, 1.0 + _TISSUE_DEVIATION**2 * float(contrast @ inverse @ contrast))}
        if means.shape[1] > 1:
            most[_CSF] = _WIDEST_CSF
        spread = np.ones(len(TISSUES))
        for tissue, limit in most.items():
            away, own = self._points.values - means[tissue], belonging[tissue]
            distance = np.einsum("pc,cd,pd->p", away, inverse, away)
            spread[tissue] = np.clip(own @ distance / (own.sum() * away.shape[1] + 1e-12), 1.0, limit)
        return spread


def _inside(along: np.ndarray, length: float) -> np.ndarray:
    """Probability that a normal variable of mean `along` and unit deviation lies between 0 and `length`."""
    from scipy.special import ndtr

    near = np.minimum(along, length - along)  # in the lower tail, where differences of ndtr are accurate
    return ndtr(near) - ndtr(near - length)


def _content(along: np.ndarray, length: float, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and mean square of the second tissue's share: a normal variable truncated to the line, over its length."""
    pdf = [np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi) for x in (along, length - along)]
    safe = np.maximum(inside, 1e-280)
    shift = (pdf[0] - pdf[1]) / safe
    mean = np.clip(along + shift, 0.0, length)
    square = along**2 + 1.0 + along * shift - length * pdf[1] / safe
    square = np.clip(square, mean**2, length * mean)
    return mean / length, square / length**2


def _limited(weights: np.ndarray, least: np.ndarray, most: np.ndarray) -> np.ndarray:
    """The weights within their limits, adding up to 1."""
    weights = weights / weights.sum()
    low = np.concatenate([least, np.full(len(weights) - len(least), 1e-6)])
    bound = np.zeros(len(weights), bool)
    for _ in range(len(weights)):  # what a limit gives or takes is shared by the classes that are free
        if bound.all():
            return weights / weights.sum()
        free = (1.0 - weights[bound].sum()) / weights[~bound].sum()
        scaled = np.where(bound, weights, free * weights)
        outside = ~bound & ((scaled < low) | (scaled > most))
        weights = np.where(outside, np.clip(scaled, low, most), scaled)
        if not outside.any():
            break
        bound |= outside
    return weights


def _affinity(points: Points) -> np.ndarray:
    """(components, points) factor of every component's weight from the prior share of each tissue; even priors give 1.

    Two tissues mix where both are likely, hence the geometric mean.
    """
    pure = len(TISSUES) * points.priors.T
    mixed = np.stack([np.sqrt(pure[first] * pure[second]) for first, second in MIXED])
    return np.vstack([pure, mixed, np.ones((len(points.limits), len(points.priors)))])
