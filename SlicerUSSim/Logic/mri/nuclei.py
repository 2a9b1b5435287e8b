"""Deep nuclei: thalamus, putamen and pallidum are grey matter that an MRI shows nearly as bright as white matter.

Myelin and iron make them so, and a mixture with one mean per tissue splits them. What tells them from white matter is
their place: the atlas says where a nucleus may be, and a separate mixture, in those voxels alone, says which of them
it is. Only white matter becomes grey by it; CSF, vessels and lesions stay.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy import ndimage
from scipy.special import ndtr

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.atlas import Atlas
from SlicerUSSim.Logic.mri.atlas_registration import AtlasFit
from SlicerUSSim.Logic.mri.classification import Classes
from SlicerUSSim.Logic.mri.refinement import box_around


@dataclass(frozen=True)
class Nucleus:
    """Where the template shows a nucleus: an ellipsoid of either side, and within it what is not too bright."""

    #: MNI152 millimetres (|x|, y, z)
    centre: tuple[float, float, float]
    #: Millimetres to the side, forwards and upwards, before the ellipsoid is turned about z, its front to the middle
    half_axes: tuple[float, float, float]
    degrees: float
    #: Intensity of the template; its CSF, grey and white matter have 68, 167 and 222
    brightest: float


#: Thalamus, and putamen with pallidum; drawn on the template's T1. The caudate nucleus is as dark as cortex.
NUCLEI = (
    Nucleus((11.9, -17.6, 8.0), (10.9, 16.2, 12.6), 24.0, 198.0),
    Nucleus((25.4, 2.0, 2.0), (9.0, 23.5, 14.0), 18.0, 196.0),
)
_DARKEST = 140.0
#: Gaussians against the template's noise, and of the maps, which an affine transform leaves some millimetres off
_TEMPLATE_SIGMA_MM, _SIGMA_MM = 0.7, 1.5
#: Around the ellipsoids, for these
_MARGIN_MM = 8.0
#: Probability of a nucleus where its place leaves no doubt, and below which the search ignores it
_MOST, _LEAST = 0.95, 0.02
#: Shares of white matter, grey matter and voxels that are part of both in what surrounds a nucleus
_AROUND = (0.7, 0.1, 0.2)
#: Brightest mean of a nucleus, and its largest deviation, where grey matter has 0 and white matter 1
_BRIGHTEST, _WIDEST = 0.8, 0.3
_ITERATIONS = 40


def with_nuclei(found: Classes, values: np.ndarray, fit: AtlasFit, grid: Volume, inside: np.ndarray) -> Classes:
    """The classes after white matter in deep nuclei has become grey matter.

    `values` (channels, voxels) are the intensities of the voxels `inside` (k, j, i) on `grid`, by which `found` was
    classified.
    """
    line, deviation = _grey_to_white(found, values)
    posteriors = found.posteriors.copy()
    grey, white = found.names.index("grey matter"), found.names.index("white matter")
    for nucleus in nuclear_maps(fit.atlas):
        place = fit.warped(nucleus, grid, inside)
        here = np.flatnonzero(place > _LEAST)
        if not len(here):
            continue
        moved = _belonging(line[here], place[here], deviation) * posteriors[white, here]
        posteriors[grey, here] += moved
        posteriors[white, here] -= moved
    return replace(found, posteriors=posteriors)


@cache
def nuclear_maps(atlas: Atlas) -> tuple[np.ndarray, ...]:
    """(k, j, i) float32 probability of every one of NUCLEI, of both sides, on the grid of the template."""
    template, spacing = atlas.t1, atlas.t1.spacing_mm[::-1]
    maps = []
    for nucleus in NUCLEI:
        box, (x, y, z) = _around(nucleus, template)
        image = ndimage.gaussian_filter(template.array[box].astype(np.float32), _TEMPLATE_SIGMA_MM / spacing)
        across, forward, up = (p - c for p, c in zip((np.abs(x), y, z), nucleus.centre, strict=True))
        cosine, sine = np.cos(np.radians(nucleus.degrees)), np.sin(np.radians(nucleus.degrees))
        turned = (cosine * across + sine * forward, cosine * forward - sine * across, up)
        ellipsoid = np.hypot.reduce([p / axis for p, axis in zip(turned, nucleus.half_axes, strict=True)]) < 1.0
        body = ndimage.binary_opening(ellipsoid & (image > _DARKEST) & (image < nucleus.brightest))
        body = ellipsoid & ndimage.binary_closing(body, iterations=2)
        maps.append(np.zeros(template.array.shape, np.float32))
        maps[-1][box] = _MOST * ndimage.gaussian_filter(body.astype(np.float32), _SIGMA_MM / spacing)
    return tuple(maps)


def _around(nucleus: Nucleus, template: Volume) -> tuple[tuple[slice, ...], list[np.ndarray]]:
    """((k, j, i) part of the template with both sides of a nucleus, x, y and z there in float32 RAS mm)."""
    reach = max(nucleus.half_axes[:2]) + _MARGIN_MM, nucleus.half_axes[2] + _MARGIN_MM
    x, y, z = nucleus.centre
    corners = itertools.product(
        (-x - reach[0], x + reach[0]), (y - reach[0], y + reach[0]), (z - reach[1], z + reach[1])
    )
    box = box_around(np.array(list(corners)), template)
    k, j, i = np.ogrid[box]
    return box, [(row[0] * i + row[1] * j + row[2] * k + row[3]).astype(np.float32) for row in template.ijk_to_ras[:3]]


def _grey_to_white(found: Classes, values: np.ndarray) -> tuple[np.ndarray, float]:
    """((voxels,) place of the intensities on the line from grey matter, 0, to white matter, 1; deviation by noise).

    With several channels the one linear combination that tells the two apart best (Fisher's discriminant).
    """
    _, grey, white = found.mixture.means
    weights = np.linalg.solve(found.mixture.covariance, white - grey)
    length = float(weights @ (white - grey))
    return (weights @ values - weights @ grey) / length, length**-0.5


def _belonging(line: np.ndarray, place: np.ndarray, noise: float) -> np.ndarray:
    """(voxels,) probability that each voxel is of a nucleus, which its place alone gives the probability `place`.

    By EM for the nucleus's mean and deviation; what surrounds it is known.
    """

    def normal(mean: float, deviation: float) -> np.ndarray:
        return np.exp(-0.5 * ((line - mean) / deviation) ** 2) / (np.sqrt(2.0 * np.pi) * deviation)

    mixed = ndtr(line / noise) - ndtr((line - 1.0) / noise)
    shares = zip(_AROUND, (normal(1.0, noise), normal(0.0, noise), mixed), strict=True)
    around = (1.0 - place) * sum(share * density for share, density in shares)
    mean, deviation, widest = 0.5, max(0.2, noise), max(_WIDEST, noise)
    belonging = place
    for _ in range(_ITERATIONS):
        joint = place * normal(mean, deviation)
        belonging = joint / (joint + around + 1e-12)
        total = belonging.sum() + 1e-12
        # Not by BLAS, whose threads wait for each other while another process works.
        mean = float(np.clip((belonging * line).sum() / total, 0.0, _BRIGHTEST))
        deviation = float(np.clip(np.sqrt((belonging * (line - mean) ** 2).sum() / total), noise, widest))
    return belonging
