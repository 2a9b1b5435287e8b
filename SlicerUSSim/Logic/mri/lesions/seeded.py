"""grow_lesion: the lesion around a point of an MRI."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import SimulationError, either, require
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.evidence import Evidence
from SlicerUSSim.Logic.mri.lesions.grown_lesion import GrownLesion, place
from SlicerUSSim.Logic.mri.lesions.half_maximum import SNAP_MM, Region, Window, closed, grow, smoothed
from SlicerUSSim.Logic.mri.pathology import LESIONS, tissue_to_add
from SlicerUSSim.Logic.mri.refinement import near_points
from SlicerUSSim.Logic.mri.sheets.falx_of_part import fissure_of_part
from SlicerUSSim.Logic.mri.sheets.head import LEAST_VOXELS, Head

if TYPE_CHECKING:
    from SlicerUSSim.Logic.mri.segmentation import Segmentation

#: Windows in which a region is grown, one after the other (reach and voxels): most lesions are small
_WINDOWS_MM = ((38.0, 1.0), (70.0, 2.0))
#: Tissues that a lesion may be called
LESION_TISSUES = tuple(name for name in LESIONS if name != "brats")
#: Of these, what does not enhance
_NEVER_ENHANCING = ("cyst", "necrosis", "cavity", "oedema")
#: Ball at a seed whose median is the lesion's intensity, and shell around it that is its surroundings, to begin with
_BALL_MM, _AROUND_MM = 3.0, (8.0, 16.0)
#: Least enhancement: above white matter in deviations of the noise, and above the surroundings in theirs
_ABOVE_WHITE, _ABOVE_AROUND = 1.5, 3.0
#: Share of the contrast of the brightest place near a seed that its lesion has at least, to begin with
_LEAST_OF_PEAK = 0.6
#: Least contrast of what does not enhance, in that of grey to white matter
_LEAST_CONTRAST = 0.5
#: Widest gap of a rim; its greatest distance from what it encloses, and the share of the way around that it covers
_GAP_MM, _RIM_MM, _LEAST_ENCLOSED = 4.0, 4.0, 0.5
#: Necrosis: least depth, least volume, and largest share of the contrast of what enhances
_LEAST_DEPTH_MM, _LEAST_NECROSIS_ML, _DARK = 2.0, 0.1, 0.3
#: Radius of the largest ball in a lesion: vessels and the cortex are thinner
_THIN_MM = 2.0
#: From the fissure, whose points are 1 mm apart, to its sides
_SIDE_MM = 1.0


@dataclass(frozen=True, eq=False)
class _Grown:
    """A region, and the image in whose half maximum it lies."""

    window: Window
    region: Region
    #: (k, j, i) of the window, smoothed, and the combination of the images (channels) that it is
    image: np.ndarray
    weights: np.ndarray
    look: str


def grow_lesion(segmentation: Segmentation, seed_ras_mm: Sequence[float], tissue: str | None = None) -> GrownLesion:
    """The lesion around one point, and a larger version of it; the segmentation does not change.

    Parameters
    ----------
    segmentation : of the MRI by segment_mri; with several volumes, all are used.
    seed_ras_mm : (3,) RAS mm of a point in the lesion. Of what enhances, up to 5 mm beside it.
    tissue : what it is, where the user knows, one of LESION_TISSUES; default: by its look. What enhances is "tumour",
        with "necrosis" in it; fluid that no rim encloses is "cyst", and what else is unlike the brain, "tumour".

    The lesion ends half-way between its own intensity and that of its surroundings; the larger version at the foot of
    that border, up to 3 mm outside. Whatever a user should look at is among its warnings.

    Raises SimulationError for a point outside the image or the brain, in what looks like its surroundings, and in what
    has no border within 70 mm.

    Takes 1 to 5 seconds.
    """
    named = None if tissue is None else lesion_tissue(tissue)
    evidence = segmentation.evidence
    seed = require_in_image(segmentation.labels, seed_ras_mm)
    index = _require_in_brain(evidence, seed)
    grown = next(_regions_at(evidence, index, named), None)
    if grown is None:
        raise SimulationError(
            f"the seed {place(seed)} is in tissue that looks like its surroundings, or has no border within "
            f"{_WINDOWS_MM[-1][0]:.0f} mm: expected a point in a lesion that stands out; draw a mask for --add"
        )
    warnings = tuple(_doubts(grown, named))
    larger = _lesion(segmentation, grown, grown.region.larger, seed, named, warnings, None)
    return _lesion(segmentation, grown, grown.region.inside, seed, named, warnings, larger)


def lesion_tissue(name: str) -> str:
    """One of LESION_TISSUES, by any of its names. Raises SimulationError that lists them for another.

    >>> from SlicerUSSim.Logic.mri.lesions.seeded import lesion_tissue
    >>> lesion_tissue("Edema")
    'oedema'
    """
    expected = f"expected a lesion: {either(LESION_TISSUES)}"
    try:
        tissue = tissue_to_add(name)
    except SimulationError:
        raise SimulationError(f"no tissue is called {name!r}, {expected}") from None
    require(tissue in LESION_TISSUES, f"{name!r} is not a lesion, {expected}")
    return tissue


def require_in_image(grid: Volume, seed_ras_mm: Sequence[float]) -> np.ndarray:
    """(3,) RAS mm of a seed. Raises SimulationError for one outside the grid of an MRI and for other values."""
    seed = np.asarray(seed_ras_mm, float)
    require(
        seed.shape == (3,) and bool(np.isfinite(seed).all()),
        f"the seed is {seed_ras_mm!r}, expected three finite numbers: R, A and S in mm",
    )
    ijk = grid.ras_to_ijk[:3] @ [*seed, 1.0]
    size = np.array(grid.array.shape[::-1])
    beyond = float((np.maximum(np.maximum(-0.5 - ijk, ijk - size + 0.5), 0.0) * grid.spacing_mm).max())
    require(
        beyond == 0.0,
        f"the seed {place(seed)} is {max(beyond, 1.0):.0f} mm outside the image, expected a point in the lesion in RAS "
        "mm of the MRI; is it in voxels, or in LPS?",
    )
    return seed


def _require_in_brain(evidence: Evidence, seed: np.ndarray) -> np.ndarray:
    """(3,) k, j, i in the box of the brain of a point in RAS mm. Raises SimulationError for one outside the brain."""
    index = evidence.index_of(seed)
    nearest = np.rint(index).astype(int)
    within = bool((nearest >= 0).all() and (nearest < evidence.inside.shape).all())
    if not (within and evidence.inside[tuple(nearest)]):
        voxels = np.argwhere(evidence.inside)
        apart = float(np.linalg.norm((voxels - index) * evidence.spacing_mm, axis=1).min())
        raise SimulationError(
            f"the seed {place(seed)} is {max(apart, 1.0):.0f} mm outside the brain, expected a point in the lesion; if "
            "the lesion is outside the brain mask, give it with --add"
        )
    return index


def _regions_at(evidence: Evidence, index: np.ndarray, named: str | None) -> Iterator[_Grown]:
    """The regions around a place (k, j, i in the box), the likeliest for a tissue first."""
    for reach, mm in _WINDOWS_MM:
        window = Window(evidence, index, reach, mm, mm == _WINDOWS_MM[-1][1])
        if named not in _NEVER_ENHANCING and (grown := _enhancing(window)) is not None:
            yield grown
        if (grown := _unlike_white(window)) is None:
            continue
        rim = _rim_of(grown) if named not in _NEVER_ENHANCING else None
        if rim is not None:
            yield from (around for around in [_enhancing(replace(window, centre=rim))] if around is not None)
        yield grown


def _enhancing(window: Window) -> _Grown | None:
    """The region at the centre of a window that takes up contrast agent."""
    evidence = window.evidence
    channel = evidence.channel("t1gd")
    if channel is None:
        return None
    inside, distance = window.of(evidence.inside) > 0.5, window.distance
    image = smoothed(window.of(evidence.images[channel]), inside, window.mm)
    near, tissue = inside & (distance <= SNAP_MM), inside & (window.of(evidence.fluid) < 0.5)
    shell = tissue & (distance >= _AROUND_MM[0]) & (distance <= _AROUND_MM[1])
    if not near.any() or not shell.any():
        return None
    around, peak = float(np.median(image[shell])), float(image[near].max())
    deviation = 1.4826 * float(np.median(np.abs(image[shell] - around)))
    # Of a large lesion the shell is a part
    base = min(around, _white(evidence, channel))
    if peak < max(_bright(evidence, channel), base + _ABOVE_AROUND * min(deviation, peak - base)):
        return None
    ball = near & (distance <= _BALL_MM)
    own = max(float(np.median(image[ball])) if ball.any() else base, base + _LEAST_OF_PEAK * (peak - base))
    region = grow(image, inside, window, own, base)
    return None if region is None else _Grown(window, region, image, np.eye(len(evidence.images))[channel], "enhancing")


def _bright(evidence: Evidence, channel: int) -> float:
    """Least intensity of a channel that is brighter than white matter and its noise."""
    return _white(evidence, channel) + _ABOVE_WHITE * float(evidence.deviations[channel])


@lru_cache(maxsize=8)
def _white(evidence: Evidence, channel: int) -> float:
    """Intensity of white matter: of its class, unless that is brighter than three quarters of the brain."""
    return min(float(evidence.white[channel]), float(np.percentile(evidence.images[channel][evidence.inside], 75)))


def _unlike_white(window: Window) -> _Grown | None:
    """The region at the centre of a window that is unlike white matter, dark or bright.

    Unlike white matter, since lesions that hold more water are as dark in T1 as grey matter (Bakshi et al., NeuroRx
    2(2), 2005). The images are weighted as by Fisher's discriminant of white matter and the seed.
    """
    evidence, distance = window.evidence, window.distance
    inside, fluid = window.of(evidence.inside) > 0.5, window.of(evidence.fluid) > 0.5
    ball = inside & (distance <= _BALL_MM)
    if not ball.any():
        return None
    is_fluid = fluid[ball].mean() >= 0.5
    allowed = inside if is_fluid else inside & ~fluid & (window.of(_between_hemispheres(evidence)) < 0.5)
    images = np.stack([window.of(image) for image in evidence.images])
    healthy = evidence.white
    spread = np.maximum(np.abs(evidence.grey - healthy), 2.0 * evidence.deviations)
    step = np.median(images[:, ball], axis=1) - healthy
    contrast = step / spread
    if np.abs(contrast).max() < _LEAST_CONTRAST:
        return None
    weights = contrast / spread
    image = smoothed(np.tensordot(weights, images - healthy[:, None, None, None], 1), allowed, window.mm)
    region = grow(image, allowed, window, float(weights @ step), 0.0)
    if region is None:
        return None
    strongest = int(np.abs(contrast).argmax())
    shown = f"{'bright' if step[strongest] > 0 else 'dark'} in {evidence.contrasts[strongest].upper()}"
    return _Grown(window, region, image, weights, "fluid" if is_fluid else shown)


@lru_cache(maxsize=1)
def _between_hemispheres(evidence: Evidence) -> np.ndarray:
    """(k, j, i) bool: the fissure; without an atlas as sheets/falx_of_part.py finds it, where it does."""
    channel = evidence.channel("t1", "t1gd", "t2")
    if evidence.atlas is not None or channel is None:
        return evidence.between_hemispheres
    contrast = evidence.contrasts[channel]
    sign = np.float32(-1.0 if contrast == "t2" else 1.0)
    means = sign * evidence.means[:, channel]
    image = Volume(sign * evidence.images[channel], evidence.ijk_to_ras)
    if not means[0] < means[1] < means[2]:
        return evidence.between_hemispheres
    head = Head.of_part(image, evidence.inside, means.tolist(), float(evidence.deviations[channel]), contrast == "t1gd")
    if min(head.brain.shape) < LEAST_VOXELS:
        return evidence.between_hemispheres
    return near_points(image, fissure_of_part(head), _SIDE_MM + 0.5 * float(evidence.spacing_mm.max()))


def _rim_of(grown: _Grown) -> np.ndarray | None:
    """(3,) k, j, i in the box of the brightest place of the rim that enhances around a region; None without one."""
    window, inside = grown.window, grown.region.inside
    evidence = window.evidence
    channel = evidence.channel("t1gd")
    if channel is None:
        return None
    brain = window.of(evidence.inside) > 0.5
    image = smoothed(window.of(evidence.images[channel]), brain, window.mm)
    apart = np.asarray(ndimage.distance_transform_edt(~inside, sampling=window.mm))
    bright = brain & (apart > 0.0) & (apart <= _RIM_MM) & (image > _bright(evidence, channel))
    seen = ndimage.binary_dilation(bright, iterations=round(_RIM_MM / window.mm))
    border = ndimage.binary_dilation(inside) & ~inside
    if float(seen[border].mean()) < _LEAST_ENCLOSED:
        return None
    return window.index_of(np.array(np.unravel_index(int(np.where(bright, image, -np.inf).argmax()), image.shape)))


def _lesion(
    segmentation: Segmentation, grown: _Grown, inside: np.ndarray, seed: np.ndarray, named: str | None,
    warnings: tuple[str, ...], larger: GrownLesion | None,
) -> GrownLesion:  # fmt: skip
    """The parts of a region, on the grid of the MRI."""
    window, region, evidence = grown.window, grown.region, grown.window.evidence
    necrosis = np.zeros(inside.shape, bool)
    if grown.look == "enhancing" and named is None:
        inside = closed(inside, window.of(evidence.inside) > 0.5, window.mm, _GAP_MM)
        depth = np.asarray(ndimage.distance_transform_edt(inside, sampling=window.mm))
        dark = grown.image < region.base + _DARK * (region.own - region.base)
        necrosis = np.asarray(ndimage.binary_opening(inside & dark & (depth > _LEAST_DEPTH_MM)))
    labels = window.to_box(inside).astype(np.uint8)
    tissues = (named or ("cyst" if grown.look == "fluid" else "tumour"),)
    if necrosis.sum() * window.mm**3 >= 1000.0 * _LEAST_NECROSIS_ML:
        labels[window.to_box(necrosis) & (labels > 0)] = 2
        tissues += ("necrosis",)
    if not labels.any():  # smaller than a voxel
        labels[tuple(np.rint(evidence.index_of(seed)).astype(int))] = 1
    whole = segmentation.labels.with_array(evidence.to_whole(labels))
    return GrownLesion(whole, tissues, grown.look, seed, warnings, larger)


def _doubts(grown: _Grown, named: str | None) -> Iterator[str]:
    """What a user should look at, a line each."""
    if named is None and grown.look == "fluid":
        yield "fluid looks alike in ventricles, sulci and cysts: check which it is"
    elif named is None and grown.look != "enhancing":
        yield "a lesion that does not enhance may be tumour or oedema: look, and state which (TISSUE)"
    if grown.region.radius_mm < _THIN_MM:
        yield "it is thin like vessels and cortex: check whether it is one of them"
