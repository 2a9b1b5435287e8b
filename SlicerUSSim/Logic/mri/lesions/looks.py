"""How lesions look in an MRI: the likeness of every voxel to a lesion, from 0 in healthy tissue to 1 at the seed.

Enhancing: brighter after contrast agent than white matter. Oedema and gliomas of low grade: bright in T2 and FLAIR and
dark in T1, since they hold more water than white matter (Bakshi et al., NeuroRx 2(2), 2005); on the line from white
matter to the seed's intensity, in units of what tissues vary.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from SlicerUSSim.Logic.mri.evidence import Evidence
from SlicerUSSim.Logic.mri.lesions.growth import distance_from, smoothed

Window = tuple[slice, slice, slice]
#: A seed means the brightest place within this distance: clicks miss, and rims are thin
SNAP_MM = 5.0
#: Shell around a seed from whose median its brightness is counted
_AROUND_MM = (8.0, 16.0)
#: Least enhancement: above white matter in deviations of the noise, and above the surroundings in theirs
_ABOVE_WHITE, _ABOVE_AROUND = 2.0, 3.0
#: Tissue itself varies by this share of the contrast of grey to white matter, besides the noise
_TISSUE_SHARE = 0.3
#: Least abnormality of a seed that is not enhancing, in units of the contrast from white matter to grey
_LEAST_ABNORMAL = 0.5
_BALL_MM = 2.5
#: Where water is bright, by how many deviations of the noise oedema is brighter than white matter at least, and how
#: many times that a seed counts at most
_BRIGHT_CONTRASTS, _TYPICAL_NOISES, _MOST_TYPICAL = ("t2", "flair"), 3.0, 1.25


@dataclass(frozen=True, eq=False)
class Look:
    """The likeness to a lesion in a window around a seed."""

    name: str
    #: The likeness of images (channels, k, j, i), and (k, j, i) float32 that of the window
    of: Callable[[np.ndarray], np.ndarray]
    likeness: np.ndarray
    #: (k, j, i) bool
    allowed: np.ndarray
    #: (3,) k, j, i in the window, where it is to be grown from
    seed: np.ndarray


def window_around(evidence: Evidence, seed: np.ndarray, reach_mm: float) -> Window:
    """The part of the box within a distance of a seed (k, j, i) along its axes."""
    half = np.ceil(reach_mm / evidence.spacing_mm).astype(int)
    low = np.maximum(np.rint(seed).astype(int) - half, 0)
    high = np.minimum(np.rint(seed).astype(int) + half + 1, evidence.inside.shape)
    k, j, i = (slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
    return k, j, i


def in_window(seed: np.ndarray, window: Window) -> np.ndarray:
    """(3,) k, j, i of a place of the box in a window."""
    return np.asarray(seed, float) - [part.start for part in window]


def around(evidence: Evidence, seed: np.ndarray, radius_mm: float = _BALL_MM) -> tuple[Window, np.ndarray]:
    """(window, (k, j, i) bool of the brain's voxels in a ball around a seed in it)."""
    window = window_around(evidence, seed, radius_mm + 1.0)
    place = in_window(seed, window)
    inside = evidence.inside[window]
    return window, inside & (distance_from(place, inside.shape, evidence.spacing_mm) <= radius_mm)


def enhancing(evidence: Evidence, window: Window, seed: np.ndarray) -> Look | None:
    """The look of what takes up contrast agent near the seed (k, j, i in the box); None where nothing does."""
    channel = evidence.channel("t1gd")
    if channel is None:
        return None
    image, inside, place = evidence.images[channel][window], evidence.inside[window], in_window(seed, window)
    distance = distance_from(place, inside.shape, evidence.spacing_mm)
    smooth = smoothed(image, inside, evidence.spacing_mm)
    near = inside & (distance <= SNAP_MM)
    shell = inside & ~evidence.fluid[window] & (distance >= _AROUND_MM[0]) & (distance <= _AROUND_MM[1])
    if not near.any() or not shell.any():
        return None
    peak_at = np.unravel_index(int(np.where(near, smooth, -np.inf).argmax()), smooth.shape)
    peak, base = float(smooth[peak_at]), float(np.median(smooth[shell]))
    deviation = 1.4826 * float(np.median(np.abs(smooth[shell] - base)))
    if peak < max(brighter_than_white(evidence, channel), base + _ABOVE_AROUND * deviation):
        return None

    def of(images: np.ndarray) -> np.ndarray:
        return (images[channel] - np.float32(base)) / np.float32(peak - base)

    return Look("enhancing", of, of(evidence.images[(slice(None), *window)]), inside, np.array(peak_at))


def brighter_than_white(evidence: Evidence, channel: int) -> float:
    """Intensity from which on a channel is brighter than white matter and its noise."""
    return float(evidence.white[channel]) + _ABOVE_WHITE * float(evidence.deviations[channel])


def watery(evidence: Evidence, window: Window, seed: np.ndarray) -> Look | None:
    """The look of tissue with more water than white matter at the seed (k, j, i in the box); None if it has not."""
    ball_window, ball = around(evidence, seed)
    ball &= ~evidence.fluid[ball_window]
    if not ball.any():
        return None
    here = np.array([float(np.median(image[ball_window][ball])) for image in evidence.images])
    # A seed in the brightest part means all of it: in T2 and FLAIR, where grey matter is no brighter than that
    most = evidence.white + _MOST_TYPICAL * (typically_watery(evidence) - evidence.white)
    bright = np.isin(evidence.contrasts, _BRIGHT_CONTRASTS)
    here = np.where(bright, np.minimum(here, most), here)
    weights = watery_weights(evidence, here)
    if weights is None:
        return None
    allowed = evidence.inside[window] & ~evidence.fluid[window] & ~evidence.is_between_hemispheres(window)
    return watery_look(evidence, window, weights, allowed, in_window(seed, window))


def typically_watery(evidence: Evidence) -> np.ndarray:
    """(channels,) intensities of oedema: as dark as grey matter in T1, and clearly brighter than white in others."""
    bright = np.isin(evidence.contrasts, _BRIGHT_CONTRASTS)
    step = np.abs(evidence.grey - evidence.white)
    return evidence.white + np.where(bright, np.maximum(step, _TYPICAL_NOISES * evidence.deviations), -step)


def watery_look(evidence: Evidence, window: Window, weights: np.ndarray, allowed: np.ndarray, seed: np.ndarray) -> Look:
    """The look of what is like a seed in a window, by watery_weights."""
    shown = [f"bright in {name.upper()}" for name in ("t2", "flair") if (evidence.channel(name) is not None)]

    def of(images: np.ndarray) -> np.ndarray:
        return watery_likeness(evidence, images, weights)

    name = shown[0] if shown else "dark in T1"
    return Look(name, of, of(evidence.images[(slice(None), *window)]), allowed, seed)


def watery_weights(evidence: Evidence, here: np.ndarray) -> np.ndarray | None:
    """(channels,) factors of the intensities minus white matter's, of which the sum is 1 where they are as `here`.

    Fisher's discriminant of white matter and the seed, with independent channels. None where `here` is no more watery
    than white matter: less than half-way to grey matter.
    """
    signs = np.where(np.isin(evidence.contrasts, _BRIGHT_CONTRASTS), 1.0, -1.0)
    contrast = np.abs(evidence.grey - evidence.white)
    step = np.maximum(signs * (here - evidence.white), 0.0)
    spread = np.hypot(evidence.deviations, _TISSUE_SHARE * contrast)
    abnormal = step / np.maximum(contrast, 2.0 * evidence.deviations)
    if abnormal.max() < _LEAST_ABNORMAL:
        return None
    weights = signs * step / spread**2
    return weights / float(weights @ (signs * step))


def watery_likeness(evidence: Evidence, images: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(k, j, i) float32 likeness to the seed of watery_weights; enhancing voxels count as white matter."""
    result = np.zeros(images.shape[1:], np.float32)
    for image, white, weight in zip(images, evidence.white, weights, strict=True):
        step = image - np.float32(white)
        result += np.float32(weight) * (np.minimum(step, 0.0) if weight < 0.0 else step)
    return result


def fluid(evidence: Evidence, window: Window, seed: np.ndarray) -> Look | None:
    """The look of fluid at the seed (k, j, i in the box); None if it is in tissue."""
    ball_window, ball = around(evidence, seed)
    is_fluid = evidence.fluid[ball_window]
    if not ball.any() or float(is_fluid[ball].mean()) < 0.5:
        return None

    def of(images: np.ndarray) -> np.ndarray:
        return evidence.is_fluid(images).astype(np.float32)

    return Look(
        "fluid", of, of(evidence.images[(slice(None), *window)]), evidence.inside[window], in_window(seed, window)
    )
