"""Why a region is no lesion: vessels, sinuses, choroid plexus, ventricles, cortex and deep nuclei are healthy."""

from __future__ import annotations

from typing import cast

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.mri.evidence import Evidence
from SlicerUSSim.Logic.mri.lesions.growth import Region, smoothed
from SlicerUSSim.Logic.mri.lesions.looks import Look, Window, brighter_than_white

#: Radius of the largest ball in a lesion: vessels and the cortex are thinner
_LEAST_ENHANCING_MM, _LEAST_WATERY_MM = 1.9, 3.5
#: Volume in units of that ball's: vessels are long, the cortex is a sheet
_MOST_ENHANCING_BALLS, _MOST_WATERY_BALLS = 14.0, 100.0
#: Share of the shell of 3 mm around that is no tissue, from which on what enhances is a vein, a sinus or choroid plexus
_MOST_BESIDE_NO_TISSUE, _SHELL_MM = 0.15, 3.0
#: Share of the border at the brain's surface from which on fluid is that of a sulcus
_MOST_AT_SURFACE = 0.1
#: Least mean difference of the likeness from the other hemisphere's
_LEAST_ASYMMETRY = 0.4
#: What is nearer to the midline has no counterpart; the two hemispheres differ by this much in place
_MIDLINE_MM, _APART_MM = 5.0, 4.0
_LEAST_SIDED, _MOST_ON_BOTH_SIDES = 0.2, 0.5
#: Smoothing before the comparison of the hemispheres: thin vessels fade, and folds of the cortex become alike
_VESSEL_SIGMA_MM, _TISSUE_SIGMA_MM = 2.0, 3.0
#: Share of a fluid region that is fluid in the other hemisphere, or that the atlas expects to be CSF
_MOST_MIRRORED, _MOST_EXPECTED = 0.25, 0.25
_CSF = 0


def why_no_lesion(evidence: Evidence, look: Look, region: Region, window: Window) -> str | None:
    """Words for why a region is healthy; None if nothing speaks for that."""
    balls = region.volume_ml(evidence.spacing_mm) * 1000.0 / (4.0 / 3.0 * np.pi * max(region.radius_mm, 0.5) ** 3)
    if look.name == "enhancing":
        if region.radius_mm < _LEAST_ENHANCING_MM or balls > _MOST_ENHANCING_BALLS:
            return "like a vessel, long and thin"
        if _beside_no_tissue(evidence, region, window) > _MOST_BESIDE_NO_TISSUE:
            return "in CSF or at the surface of the brain, as veins, choroid plexus and dura do"
        if _enhances_on_both_sides(evidence, region, window):
            return "on both sides, as vessels and choroid plexus do"
        return None
    if look.name == "fluid":
        return _why_healthy_fluid(evidence, region, window)
    if region.radius_mm < _LEAST_WATERY_MM or balls > _MOST_WATERY_BALLS:
        return "thin, as the cortex is"
    if _asymmetry(evidence, look, region, window) < _LEAST_ASYMMETRY:
        return "the other hemisphere looks the same"
    return None


def _why_healthy_fluid(evidence: Evidence, region: Region, window: Window) -> str | None:
    inside = region.inside
    if evidence.expected is None:
        return "without an atlas, it may be a ventricle"
    if _at_surface(evidence, region, window) > _MOST_AT_SURFACE:
        return "at the surface of the brain"
    if float(evidence.expected[_CSF][window][inside].mean()) > _MOST_EXPECTED:
        return "where a ventricle or a sulcus is expected"
    near = ndimage.binary_dilation(
        evidence.fluid, iterations=max(round(_APART_MM / float(evidence.spacing_mm.max())), 1)
    )
    mirrored = evidence.mirrored(near.astype(np.float32), window)
    if mirrored is not None and float((mirrored[inside] > 0.5).mean()) > _MOST_MIRRORED:
        return "on both sides, as ventricles are"
    return None


def _beside_no_tissue(evidence: Evidence, region: Region, window: Window) -> float:
    """Share of the shell around a region that is fluid or outside the brain."""
    apart = cast(np.ndarray, ndimage.distance_transform_edt(~region.inside, sampling=evidence.spacing_mm.tolist()))
    shell = (apart > 0.0) & (apart <= _SHELL_MM)
    return float((~evidence.inside | evidence.fluid)[window][shell].mean()) if shell.any() else 1.0


def _at_surface(evidence: Evidence, region: Region, window: Window) -> float:
    """Share of a region's border beyond which there is no brain."""
    border = ndimage.binary_dilation(region.inside) & ~region.inside
    return float((~evidence.inside[window])[border].mean()) if border.any() else 0.0


def _asymmetry(evidence: Evidence, look: Look, region: Region, window: Window) -> float:
    """Mean difference of the likeness from that at the counterpart in the other hemisphere.

    1 is a lesion in a healthy brain; 0, as on the other side. 1 without an atlas, and for what has no counterpart.
    """
    if evidence.sideways_mm is None:
        return 1.0
    inside = region.inside & (np.abs(evidence.sideways_mm[window]) > _MIDLINE_MM)
    if inside.sum() < _LEAST_SIDED * region.inside.sum():
        return 1.0
    images = np.stack([cast(np.ndarray, evidence.mirrored(image, window)) for image in evidence.images])
    tissue = evidence.inside & ~evidence.fluid
    there = cast(np.ndarray, evidence.mirrored(tissue.astype(np.float32), window)) > 0.5
    other = smoothed(look.of(images), there, evidence.spacing_mm, _TISSUE_SIGMA_MM)
    own = smoothed(look.likeness, look.allowed, evidence.spacing_mm, _TISSUE_SIGMA_MM)
    return float(own[inside].mean() - other[inside].mean())


def _enhances_on_both_sides(evidence: Evidence, region: Region, window: Window) -> bool:
    """Whether most of a region has something that enhances, and is no thin vessel, at its counterpart."""
    channel = evidence.channel("t1gd")
    if channel is None or evidence.sideways_mm is None:
        return False
    inside = region.inside & (np.abs(evidence.sideways_mm[window]) > _MIDLINE_MM)
    if inside.sum() < _LEAST_SIDED * region.inside.sum():
        return False
    image = cast(np.ndarray, evidence.mirrored(evidence.images[channel], window))
    there = cast(np.ndarray, evidence.mirrored(evidence.inside.astype(np.float32), window)) > 0.5
    bright = smoothed(image, there, evidence.spacing_mm, _VESSEL_SIGMA_MM) > brighter_than_white(evidence, channel)
    apart = ndimage.distance_transform_edt(~bright, sampling=evidence.spacing_mm.tolist()) if bright.any() else None
    return apart is not None and float((cast(np.ndarray, apart)[inside] <= _APART_MM).mean()) > _MOST_ON_BOTH_SIDES
