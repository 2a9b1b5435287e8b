"""The bias field of an MRI: whether there is one, and its correction."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.atlas import Atlas
from SlicerUSSim.Logic.mri.atlas_registration import AtlasFit
from SlicerUSSim.Logic.mri.classification import fit_one
from SlicerUSSim.Logic.mri.coarse import widened
from SlicerUSSim.Logic.mri.histogram import Histogram
from SlicerUSSim.Logic.mri.mixture import fit_mixture
from SlicerUSSim.Logic.mri.plausibility import is_whole_brain

#: Millimetres of the grid on which the field is estimated
_COARSE_MM = 4.0
#: Length of an adult's brain: the field of a part of a brain is as smooth as that of the whole, which a coil makes
_BRAIN_MM = 170.0
#: Ratio of the 95th to the 5th percentile of the field in the brain, less 1: below the first its estimate is no better
#: than none; from the second, as with surface coils, it is too strong for the polynomial and N4 goes first
LEAST_FIELD, STRONG_FIELD = 0.1, 0.6
#: The first for a part of a brain, which shows a part of what a field varies. On parts of phantoms with fields of 0 to
#: 20 %, anything from 0 to 0.13 gives the same mean Dice to 0.0005
LEAST_FIELD_OF_PART = 0.05


@dataclass(frozen=True, eq=False)
class Corrected:
    """An image without its bias field, and a line for the user."""

    image: Volume
    message: str


def corrected(
    image: Volume,
    inside: np.ndarray,
    contrast: str,
    atlas: AtlasFit | None,
    prior: np.ndarray | None,
    wanted: bool | None,
    report: Callable[[float], None],
) -> Corrected:
    """The image without bias field in the brain `inside` (k, j, i), if it has one or it is `wanted`.

    Led by an atlas (its share of tissues is `prior`, (3, voxels)), the field is estimated together with the tissues,
    which takes a second; N4 goes first where the field is strong, and instead where there is no atlas for a whole
    brain. In a part of a brain N4, whose splines are then as fine as lobes, takes white matter for the field.
    """
    if atlas is None and not is_whole_brain(image, inside):
        field = without_bias(image, inside, report)
        ratio = np.where(inside, image.array, 1.0) / np.maximum(np.where(inside, field, 1.0), 1e-6)
        strength = _strength(ratio, inside)
        apply = bool(wanted) or strength > LEAST_FIELD
        result = image.with_array(field) if apply else image
        return Corrected(result, _about(contrast, strength, wanted, "N4 applied" if apply else "", LEAST_FIELD))

    def estimated(source: Volume) -> np.ndarray:
        least_mm = _BRAIN_MM if atlas is None else 0.0
        field = estimate_field(
            source.array, inside, source.spacing_mm, contrast, prior, report, least_extent_mm=least_mm
        )
        if atlas is None or contrast not in ("t1", "t1gd"):
            return field.factor
        return field.factor / anatomy(atlas, source, inside.shape)

    least = LEAST_FIELD if atlas is not None else LEAST_FIELD_OF_PART
    factor = estimated(image)
    strength = _strength(factor, inside)
    if not wanted and strength <= least:
        return Corrected(image, _about(contrast, strength, wanted, "", least))
    how = "removed by a polynomial fitted with the tissues"
    if (wanted and atlas is not None) or strength > STRONG_FIELD:
        image = image.with_array(without_bias(image, inside, report))
        factor = estimated(image)
        how = "removed by N4 and by a polynomial fitted with the tissues"
    return Corrected(image.with_array(image.array / factor), _about(contrast, strength, wanted, how, least))


def _strength(factor: np.ndarray, inside: np.ndarray) -> float:
    step = (slice(None, None, 3),) * 3
    low, high = np.percentile(factor[step][inside[step]], (5, 95))
    return float(high / low - 1.0) if low > 0 else np.inf


def _about(contrast: str, strength: float, wanted: bool | None, how: str, least: float) -> str:
    amount = f"{strength:.1%}" if strength < 10.0 else "more than a factor of ten"
    found = f"{contrast}: intensity varies by {amount} across the brain"
    if not how:
        return f"{found}, below {least:.0%}: not removed"
    return f"{found}: {how}{', as asked for' if wanted else ''}"


def without_bias(image: Volume, inside: np.ndarray, report: Callable[[float], None]) -> np.ndarray:
    """(k, j, i) float32 image without its bias field (N4: Tustison et al., IEEE TMI 29(6), 2010).

    The field is estimated on means over 4 mm of the voxels `inside`, and applied to all voxels.
    """
    import SimpleITK as sitk

    box = ndimage.find_objects(inside.astype(np.uint8))[0]
    first = np.array([part.start for part in box])
    matrix = image.ijk_to_ras.copy()
    matrix[:3, 3] = (image.ijk_to_ras @ [*first[::-1], 1.0])[:3]
    part = Volume(np.where(inside[box], image.array[box], 0).astype(np.float32), matrix)
    shrink = [
        max(1, min(round(_COARSE_MM / mm), n // 8))
        for mm, n in zip(part.spacing_mm, part.array.shape[::-1], strict=True)
    ]
    mask = sitk.BinShrink(part.with_array(inside[box].astype(np.float32)).to_sitk(), shrink)
    means = sitk.Divide(sitk.BinShrink(part.to_sitk(), shrink), sitk.Maximum(mask, 0.01))
    corrector = sitk.N4BiasFieldCorrectionImageFilter()
    iterations = [50, 50, 30]
    corrector.SetMaximumNumberOfIterations(iterations)
    raised: list[Exception] = []

    def iterated() -> None:
        done = sum(iterations[: corrector.GetCurrentLevel()]) + corrector.GetElapsedIterations()
        try:
            report(min(done / sum(iterations), 1.0))
        except Exception as error:  # it cannot propagate through C++
            raised.append(error)
            corrector.Abort()

    corrector.AddCommand(sitk.sitkIterationEvent, iterated)
    corrector.Execute(means, sitk.Cast(mask > 0.5, sitk.sitkUInt8))
    if raised:
        raise raised[0]
    whole = sitk.Cast(image.to_sitk(), sitk.sitkFloat32)
    field = sitk.GetArrayFromImage(corrector.GetLogBiasFieldAsImage(whole))
    return (image.array / np.exp(field)).astype(np.float32)


# ---- the field that makes the mixture of tissues most likely ---------------------------------------------------------
# Its logarithm is a polynomial; Gauss-Newton steps on the likelihood alternate with steps of EM (Wells et al., IEEE TMI
# 15(4), 1996; Ashburner and Friston, NeuroImage 26(3), 2005).

#: Total degree of the polynomial, and deviation of a coefficient of degree 1 that is expected; it falls with the square
#: of the degree. The voxels count as if each were independent, so that the deviation is smaller than that of a field:
#: with 0.3 degree 5 follows the tissues, with 0.01 a real field is left
_DEGREE, _EXPECTED = 4, 0.05
#: Weight of pure grey matter in the field, chosen with the two above on phantoms of MNI152, Colin27 and one label map
#: of SynthSeg. By its wide class alone it counts less than white matter, which is in the middle and brighter there
_GREY_WEIGHT = 2.0
#: Millimetres between the voxels that are used
_STEP_MM = 4.0
_MOST_STEPS, _EM_PER_STEP, _LEAST_CHANGE = 16, 8, 0.001
#: Bins of the histogram, and deviation in voxels of the Gaussian against noise
_BINS, _SIGMA = 160, 0.7
#: Share of what the atlas's own T1 shows that every T1 is taken to show: white matter is brighter inside, cortex darker
_ANATOMY = 0.5


@dataclass(frozen=True, eq=False)
class Field:
    """The logarithm of a bias field on the grid of an image."""

    coefficients: np.ndarray
    #: (n,) place of every voxel along k, j and i, where -1 and 1 are the ends of the polynomial
    _places: tuple[np.ndarray, ...]
    #: Mean of every term over the brain, so that the field is 1 on average
    _means: np.ndarray

    @cached_property
    def factor(self) -> np.ndarray:
        """(k, j, i) float32 factor by which the field multiplies the image."""
        axes = [_legendre(place).astype(np.float32) for place in self._places]
        table = np.zeros([_DEGREE + 1] * 3, np.float32)
        for value, orders in zip(self.coefficients, _TERMS, strict=True):
            table[orders] = value
        log = np.einsum("abc,ka,jb,ic->kji", table, *axes, optimize=True)
        log -= np.float32(self.coefficients @ self._means)
        return np.exp(log, out=log)


_TERMS = [orders for orders in itertools.product(range(_DEGREE + 1), repeat=3) if 0 < sum(orders) <= _DEGREE]


def _legendre(x: np.ndarray) -> np.ndarray:
    """(points, degree + 1) Legendre polynomials."""
    return np.polynomial.legendre.legvander(x, _DEGREE)


def _smooth(array: np.ndarray, every: tuple[slice, ...]) -> np.ndarray:
    """A Gaussian at `every` so-manieth voxel; the axes one after the other, so that little is computed in vain."""
    for axis, part in enumerate(every):
        array = ndimage.gaussian_filter1d(array, _SIGMA, axis, truncate=2.0)
        array = array[(slice(None),) * axis + (part,)]
    return array


def estimate_field(
    image: np.ndarray,
    inside: np.ndarray,
    spacing_mm: np.ndarray,
    contrast: str,
    prior: np.ndarray | None,
    report: Callable[[float], None] = lambda share: None,
    *,
    least_extent_mm: float = 0.0,
) -> Field:
    """The field of an `image` (k, j, i) in the brain `inside`; `prior` (3, voxels) is the atlas's share of tissues.

    The polynomial reaches over the image, and over at least `least_extent_mm` along every axis. Without a prior it
    may leave more of a whole brain's field than N4 (a fifth more on MNI152 warped), since the middle of a brain
    contains more white matter than its rim.
    """
    stride = np.maximum(np.rint(_STEP_MM / spacing_mm[::-1]).astype(int), 1)
    every = tuple(slice(None, None, int(n)) for n in stride)
    weight = _smooth(inside.astype(np.float32), every)
    smooth = _smooth(np.where(inside, image, 0).astype(np.float32), every)
    used = inside[every] & (smooth > 0)
    raw = smooth[used] / np.maximum(weight[used], 1e-6)
    low = np.percentile(raw, 0.1)
    raw = np.maximum(raw, max(low, 1e-3 * float(raw.mean())))
    if prior is not None:
        chosen = np.zeros(inside.shape, bool)
        chosen[every] = used
        prior = prior[:, chosen[inside]]
    places = np.argwhere(used) * stride
    ends = [
        min(n * mm / least_extent_mm, 1.0) if least_extent_mm else 1.0
        for n, mm in zip(inside.shape, spacing_mm[::-1], strict=True)
    ]
    along_axes = tuple(np.linspace(-end, end, n) for end, n in zip(ends, inside.shape, strict=True))
    axes = [_legendre(place).astype(np.float32) for place in along_axes]
    along = [axis[places[:, n]] for n, axis in enumerate(axes)]
    design = np.stack([along[0][:, a] * along[1][:, b] * along[2][:, c] for a, b, c in _TERMS], axis=1)
    means = design.mean(axis=0)
    design -= means
    degree = np.array([sum(orders) for orders in _TERMS], float)
    penalty = (degree**2 / _EXPECTED) ** 2
    found = np.zeros(len(_TERMS))
    mixture = None
    log = np.zeros(len(raw), np.float32)
    for step in range(_MOST_STEPS):
        values = raw * np.exp(-log)
        histogram = Histogram.of(values[None], (contrast,), prior, bins=_BINS, voxel_mm=float(spacing_mm.mean()))
        if mixture is None:
            mixture = fit_one(histogram.points, contrast)
        else:
            mixture = fit_mixture(
                histogram.points,
                mixture.means,
                np.sqrt(np.diag(mixture.covariance)),
                iterations=_EM_PER_STEP,
                spread=mixture.spread,
            )
        slope = mixture.slope(histogram.points, _GREY_WEIGHT)
        slope = -(slope * histogram.points.values[:, 0])[histogram.point_of_voxel].astype(np.float32)
        # einsum and not BLAS, whose threads wait for each other while another process works
        normal = np.einsum("na,nb->ab", design * (slope**2)[:, None], design) + np.diag(penalty)
        gradient = np.einsum("na,n->a", design, slope) - penalty * found
        change = np.linalg.solve(normal, gradient)
        found = found + change
        moved = np.einsum("na,a->n", design, change.astype(np.float32))
        log += moved
        report((step + 1) / _MOST_STEPS)
        if float(moved.std()) < _LEAST_CHANGE:
            break
    return Field(found, along_axes, means)


def anatomy(fit: AtlasFit, grid: Volume, shape: tuple[int, ...]) -> np.ndarray:
    """(k, j, i) float32 part of a T1's estimated field that is anatomy rather than field, as the atlas's T1 shows."""
    matrix = fit.atlas.t1.ras_to_ijk @ fit.patient_to_atlas @ grid.ijk_to_ras
    linear, offset = matrix[:3, :3][::-1, ::-1], matrix[:3, 3][::-1]
    stride = 4
    coarse = tuple(-(-n // stride) for n in shape)
    field = ndimage.affine_transform(_of_atlas(fit.atlas), linear * stride, offset, coarse, order=1, mode="nearest")  # pyright: ignore[reportArgumentType]
    return widened(field, stride, shape) ** np.float32(_ANATOMY)


@cache
def _of_atlas(atlas: Atlas) -> np.ndarray:
    inside = atlas.t1.array > 0
    prior = AtlasFit(np.eye(4), 1.0, atlas).prior(atlas.t1, inside)
    return estimate_field(atlas.t1.array.astype(np.float32), inside, atlas.t1.spacing_mm, "t1", prior).factor
