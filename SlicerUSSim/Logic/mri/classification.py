"""Classification of the voxels of a brain: the mixture's start, its fit, and which tissue every voxel is."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from SlicerUSSim.Logic.base.declaration import parameter_of
from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.mri.histogram import Histogram
from SlicerUSSim.Logic.mri.mixture import ANY, TISSUES, Points, TissueMixture, fit_mixture
from SlicerUSSim.Logic.mri.segmentation_settings import CT, SegmentationSettings

#: Tissues (indices in mixture.TISSUES) from dark to bright
ORDERS = {"t1": (0, 1, 2), "t1gd": (0, 1, 2), "t2": (2, 1, 0), "flair": (0, 2, 1)}
#: Name of what is brighter than all tissues, where it is a separate class
_BRIGHT_NAMES = {"t1gd": "enhancing", "flair": "tumour"}
#: Contrasts from the one that tells grey from white matter best
_PREFERENCE = ("t1", "t1gd", "flair", "t2")
#: The spatial prior's exponent: the affine transform leaves the cortex some millimetres off. The second where fitted
#: grey and white matter differ by less than the first of these deviations of the noise: there the atlas has to decide
_PRIOR_EXPONENT, _STRONG_EXPONENT, FAINT = 0.3, 1.0, (2.5, 4.0)
#: Noise of posteriors per that of the fit, for filtered images: filters leave more error at borders than within tissues
FILTER_BLUR = 1.5
_START_ITERATIONS = 12
#: Distance of means, in standard deviations of the noise, below which two tissues are one
_LEAST_GAP = 0.5
#: Least contrast of CSF to grey matter by that of grey to white matter, in T1 and T2. CSF's T1 is about three times
#: that of grey matter, which is 1.6 times that of white matter (Wansapura et al., JMRI 9(4), 1999); T2s differ more
_LEAST_CONTRAST = 1.0
#: Gain of the mean log-likelihood that the limits of the weights never cost in a brain, where it is below 0.02
_MUCH_MORE_LIKELY = 0.1
#: Smallest and largest share of CSF, grey and white matter in the starts, and in a result without a warning
START_SHARES = ((0.01, 0.05, 0.15, 0.3), (0.3, 0.45, 0.65))
EXPECTED_SHARES = ((0.005, 0.4), (0.3, 0.75), (0.2, 0.6))


@dataclass(frozen=True, eq=False)
class Classes:
    """Which tissue every voxel is."""

    #: (classes,) names, and (classes, voxels) float32 probabilities, which add up to 1
    names: tuple[str, ...]
    posteriors: np.ndarray
    #: (classes, channels)
    means: np.ndarray
    standard_deviations: np.ndarray
    mixture: TissueMixture
    #: Difference of grey and white matter in deviations of the noise, over all channels, before the atlas decides
    grey_white_contrast: float = np.inf

    @property
    def grey_and_white(self) -> tuple[float, float]:
        """Means of grey and white matter in the first channel."""
        grey, white = (float(self.means[self.names.index(name), 0]) for name in ("grey matter", "white matter"))
        return grey, white

    @property
    def shares(self) -> np.ndarray:
        """(classes,) share of the voxels in which each class is the most probable one."""
        counts = np.bincount(self.posteriors.argmax(axis=0), minlength=len(self.names))
        return counts / counts.sum()


def class_names(contrasts: tuple[str, ...], classes: int | None) -> tuple[str, ...]:
    """The names of the classes of one image, in order of intensity, or of several, in a fixed order.

    With None they are four if contrast agent was given. Raises SimulationError for an unknown contrast, and for a
    number of classes that does not go with the contrast.
    """
    entry = parameter_of(SegmentationSettings, "contrast")
    contrasts = tuple(entry.checked("segmentation", contrast) for contrast in contrasts)
    require(CT not in contrasts, "contrast is ct, expected that of an MRI; segment_ct and segment_image segment a CT")
    order = ORDERS[contrasts[0]] if len(contrasts) == 1 else range(len(TISSUES))
    names = tuple(TISSUES[n] for n in order)
    bright = next((_BRIGHT_NAMES[contrast] for contrast in contrasts if contrast in _BRIGHT_NAMES), None)
    allowed = (3, 4) if bright else (3,)
    require(
        classes is None or (classes in allowed and not isinstance(classes, bool)),
        f"classes is {classes!r}, expected {' or '.join(map(str, allowed))} for contrast {'+'.join(contrasts)}",
    )
    if classes is None:
        classes = 4 if "t1gd" in contrasts else 3
    return (*names, bright) if classes == 4 and bright else names


def classify(
    values: np.ndarray,
    contrasts: tuple[str, ...],
    names: tuple[str, ...],
    prior: np.ndarray | None,
    blur: float = 1.0,
    voxel_mm: float = 1.0,
) -> Classes:
    """The classes of (channels, voxels) float32 intensities; `prior` (3, voxels) is the atlas's share of tissues.

    Posteriors assume `blur` times the noise of the fit.
    """
    found = _classified(values, contrasts, names, prior, _PRIOR_EXPONENT, blur, voxel_mm)
    apart = found.mixture.means[2] - found.mixture.means[1]
    contrast = float(np.sqrt(apart @ np.linalg.solve(found.mixture.covariance, apart)))
    exponent = float(np.interp(contrast, FAINT, (_STRONG_EXPONENT, _PRIOR_EXPONENT)))
    if prior is not None and exponent > _PRIOR_EXPONENT:
        found = _classified(values, contrasts, names, prior, exponent, blur, voxel_mm)
    return replace(found, grey_white_contrast=contrast)


def _classified(
    values: np.ndarray,
    contrasts: tuple[str, ...],
    names: tuple[str, ...],
    prior: np.ndarray | None,
    exponent: float,
    blur: float,
    voxel_mm: float,
) -> Classes:
    """See classify; with the prior to the power of `exponent`."""
    if prior is not None:
        prior = prior**exponent
        prior /= prior.sum(axis=0)
    first = _best_channel(contrasts)
    histogram = Histogram.of(values[first : first + 1], contrasts[first : first + 1], prior, voxel_mm=voxel_mm)
    mixture = fit_one(histogram.points, contrasts[first])
    if len(contrasts) > 1:
        shares, outside = mixture.shares(histogram.points)
        shares = (shares * (1.0 - outside))[:, histogram.point_of_voxel]
        means = (shares @ values.T) / (shares.sum(axis=1, keepdims=True) + 1e-9)
        deviation = np.sqrt(
            [
                float(np.average((y - means.T[n] @ shares) ** 2, weights=1.0 - outside[histogram.point_of_voxel]))
                for n, y in enumerate(values)
            ]
        )
        histogram = Histogram.of(values, contrasts, prior, voxel_mm=voxel_mm)
        mixture = fit_mixture(histogram.points, means, 0.5 * deviation)
    return _named(histogram, mixture, contrasts, names, blur)


def _best_channel(contrasts: tuple[str, ...]) -> int:
    return min(range(len(contrasts)), key=lambda n: _PREFERENCE.index(contrasts[n]))


def fit_one(points: Points, contrast: str) -> TissueMixture:
    """The fit of one channel: the most likely of several starts that leave tissues of plausible size."""
    starts = [
        fit_mixture(points, means, deviation, iterations=_START_ITERATIONS)
        for means, deviation in _starts(points, contrast)
    ]
    order = ORDERS[contrast]
    in_order = [fit for fit in starts if (np.diff(fit.means[list(order), 0]) > 0).all()] or starts
    in_order.sort(key=lambda fit: (_csf_is_grey(fit, contrast), _excess(fit, points) > 0.1, -fit.log_likelihoods[-1]))
    found = []
    for fit in in_order[:2]:
        whole = fit_mixture(points, fit.means, np.sqrt(np.diag(fit.covariance)), spread=fit.spread)
        is_doubtful = _csf_is_grey(whole, contrast) or _excess(whole, points) > 0.0 or _has_collapsed(whole)
        found.append((is_doubtful, -whole.log_likelihoods[-1], whole))
    is_doubtful, _, best = min(found, key=lambda entry: entry[:2])
    if not is_doubtful:
        return best
    # In an image without borders, such as a synthetic one, the limits of the weights force tissues together.
    means, deviation = _otsu_start(points, contrast)
    without = fit_mixture(points, means, deviation, least_weights=ANY)
    gain = without.log_likelihoods[-1] - best.log_likelihoods[-1]
    is_better = _has_collapsed(best) or gain > _MUCH_MORE_LIKELY
    return without if is_better and not _has_collapsed(without) else best


def _otsu_start(points: Points, contrast: str) -> tuple[np.ndarray, np.ndarray]:
    """((3, 1) means, (1,) standard deviation) of the classes between Otsu's thresholds."""
    from skimage.filters import threshold_multiotsu

    values = points.values[:, 0]
    counts, edges = np.histogram(values, 256, weights=points.counts)
    centres = 0.5 * (edges[1:] + edges[:-1])
    member = np.digitize(values, threshold_multiotsu(hist=(counts, centres), classes=len(TISSUES)))
    means, variance = np.empty((len(TISSUES), 1)), 0.0
    for n, tissue in enumerate(ORDERS[contrast]):
        weights = points.counts * (member == n) + 1e-9
        means[tissue] = np.average(values, weights=weights)
        variance += float(weights @ (values - means[tissue]) ** 2)
    return means, np.array([max(np.sqrt(variance / points.counts.sum()), float(points.steps[0]))])


def _has_collapsed(fit: TissueMixture) -> bool:
    """Whether two tissues have the same mean in all channels."""
    deviation = np.sqrt(np.diag(fit.covariance))
    gaps = [np.abs(a - b) / deviation for a, b in itertools.combinations(fit.means, 2)]
    return min(float(gap.max()) for gap in gaps) < _LEAST_GAP


def _csf_is_grey(fit: TissueMixture, contrast: str) -> bool:
    """Whether CSF is too close to grey matter, as where the mask holds little CSF and two classes share the cortex."""
    csf, grey, white = fit.means[:, 0]
    return _is_csf_near_grey(csf, grey, white, contrast)


def _is_csf_near_grey(csf: float, grey: float, white: float, contrast: str) -> bool:
    """Whether these intensities are closer to each other in CSF and grey matter than in grey and white matter."""
    way = np.sign(white - csf)
    return bool(contrast != "flair" and way * (grey - csf) < _LEAST_CONTRAST * way * (white - grey))


def _excess(fit: TissueMixture, points: Points) -> float:
    """By how much the shares of the tissues leave the expected range."""
    shares = fit.shares(points)[0]
    volumes = (shares * points.counts).sum(axis=1)
    volumes = volumes / volumes.sum()
    return float(sum(max(low - v, v - high, 0.0) for v, (low, high) in zip(volumes, EXPECTED_SHARES, strict=True)))


def _starts(points: Points, contrast: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """((3, 1) means, (1,) standard deviation) from shares of CSF and white matter, in the contrast's order."""
    values = points.values[:, 0]
    order = np.argsort(values, kind="stable")
    rank = np.cumsum(points.counts[order]) / points.counts.sum()

    def at(share: float) -> float:
        return float(values[order][min(np.searchsorted(rank, share), len(rank) - 1)])

    result = []
    for below in (0.0, 0.12) if contrast == "t2" else (0.0,):
        for csf, white in itertools.product(*START_SHARES):
            size = np.array([csf, 1.0 - csf - white, white]) * (1.0 - below)
            means, start = np.empty((3, 1)), below
            for tissue in ORDERS[contrast]:
                means[tissue] = at(start + 0.5 * size[tissue])
                start += size[tissue]
            spread = max(at(0.98) - at(0.02), float(points.steps[0]))
            result.append((means, np.array([0.08 * spread])))
    return result


def _named(
    histogram: Histogram, mixture: TissueMixture, contrasts: tuple[str, ...], names: tuple[str, ...], blur: float
) -> Classes:
    """The mixture's tissues under their names, and outliers where they belong."""
    points = histogram.points
    shares, outside = mixture.shares(points, blur)
    deviation = np.sqrt(np.diag(mixture.covariance))
    bright = np.zeros(len(points.counts), bool)
    if len(names) > len(TISSUES):
        channel = next(n for n, contrast in enumerate(contrasts) if contrast in _BRIGHT_NAMES)
        brightest = mixture.means[:, channel].max()
        bright = points.values[:, channel] > brightest + 2.0 * deviation[channel]
    # By the contrast that tells tissues apart best: tissue dark in T1 and in T2 is nearest to white matter in T2.
    best = _best_channel(contrasts)
    away = np.abs(points.values[:, best] - mixture.means[:, best, None])
    nearest = away.argmin(axis=0)
    for tissue in range(len(TISSUES)):
        shares[tissue] += np.where((nearest == tissue) & ~bright, outside, 0.0)
    rows = [shares[TISSUES.index(name)] for name in names[: len(TISSUES)]]
    means = [mixture.means[TISSUES.index(name)] for name in names[: len(TISSUES)]]
    deviations = [deviation * np.sqrt(mixture.spread[TISSUES.index(name)]) for name in names[: len(TISSUES)]]
    if len(names) > len(TISSUES):
        rows.append(np.where(bright, outside, 0.0))
        weight = rows[-1] * points.counts
        total = weight.sum()
        mean = weight @ points.values / total if total > 0 else mixture.means.max(axis=0) + 3.0 * deviation
        spread = np.sqrt(weight @ (points.values - mean) ** 2 / total) if total > 0 else deviation
        means.append(mean)
        deviations.append(np.maximum(spread, points.steps))
    table = np.stack(rows).astype(np.float32)
    return Classes(names, table[:, histogram.point_of_voxel], np.stack(means), np.stack(deviations), mixture)
