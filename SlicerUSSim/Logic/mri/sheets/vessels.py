"""Vessels and choroid plexus, where contrast agent shows them."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.neighbourhood import distance_to
from SlicerUSSim.Logic.mri.coarse import components
from SlicerUSSim.Logic.mri.refinement import closed
from SlicerUSSim.Logic.mri.sheets.head import Head
from SlicerUSSim.Logic.mri.sheets.regions import lateral_ventricles_of_atlas
from SlicerUSSim.Logic.tissue.surfels import Surfels

#: Radii of vessels, mm; their objectness counts from this percentile of the brain's
_SIGMAS_MM, _PERCENTILE = (0.7, 1.0, 1.5), 93.0
#: Brighter than white matter by these deviations of the noise: every voxel, and at least one of each vessel
_LEAST, _PEAK = 3.0, 6.0
_LEAST_VESSEL_MM3 = 2.0
#: Sinuses are wider than this, lie this far around those parts and this near the surface, and dura is this near to its
#: sheets; mm
_SINUS_MM, _SINUS_RIM_MM, _SURFACE_MM, _DURA_MM = 5.0, 2.0, 1.0, 1.5
#: Choroid plexus: gaps that it leaves in the fluid, how far it may stick out of it, mm; brightness, and least volume
_CLOSED_MM, _OUTSIDE_MM, _CHOROID_LEAST, _LEAST_CHOROID_MM3 = 3.6, 1.5, 2.0, 15.0
#: Internal cerebral veins are nearer to the midline
_MIDLINE_MM = 5.0


def choroid_plexus(head: Head, ventricles: np.ndarray) -> np.ndarray:
    """(k, j, i) True where tissue in the `ventricles` enhances; without internal cerebral veins."""
    if not ventricles.any():
        return np.zeros(ventricles.shape, bool)
    mm = float(head.spacing.mean())
    # The plexus fills the atria, where no fluid tells of them.
    region = closed(ventricles | lateral_ventricles_of_atlas(head), _CLOSED_MM / mm)
    region = distance_to(region, head.image.spacing_mm) <= _OUTSIDE_MM
    bright = region & (head.image.array > head.white + _CHOROID_LEAST * head.noise)
    bright &= np.abs(head.in_atlas[0]) > _MIDLINE_MM
    return _large(bright, _LEAST_CHOROID_MM3 / head.voxel_mm3)


def vessels(head: Head, sheets: Surfels, apart: np.ndarray) -> np.ndarray:
    """(k, j, i) True in enhancing tubes of the brain (Antiga, Insight Journal 2007, after Frangi et al., MICCAI 1998).

    Without the sinuses, the dura's `sheets`, which enhance as well, and what is `apart` (k, j, i).
    """
    bright = head.brain & (head.image.array > head.white + _LEAST * head.noise)
    tubes = _tubeness(head)
    found = bright & (tubes > np.percentile(tubes[head.brain], _PERCENTILE))
    wide = head.image.array > head.white + _LEAST * head.noise
    core = distance_to(~wide, head.image.spacing_mm) > 0.5 * _SINUS_MM
    if core.any():
        found &= distance_to(core, head.image.spacing_mm) > 0.5 * _SINUS_MM + _SINUS_RIM_MM
    found &= (head.depth > _SURFACE_MM) & ~apart & ~_near(head, sheets, _DURA_MM)
    parts = components(found, corners=True)
    sizes = np.bincount(parts.ravel())
    peaks = ndimage.maximum(head.image.array, parts, np.arange(len(sizes)))
    kept = (sizes * head.voxel_mm3 > _LEAST_VESSEL_MM3) & (np.asarray(peaks) > head.white + _PEAK * head.noise)
    kept[0] = False
    return kept[parts]


def _tubeness(head: Head) -> np.ndarray:
    """(k, j, i) float32 largest objectness of bright lines over the radii."""
    import SimpleITK as sitk

    image, result = head.image.to_sitk(), np.zeros(head.brain.shape, np.float32)
    for sigma in _SIGMAS_MM:
        smooth = sitk.SmoothingRecursiveGaussian(image, [sigma] * 3)
        lines = sitk.ObjectnessMeasure(
            smooth, alpha=0.5, beta=0.5, gamma=20.0, scaleObjectnessMeasure=False, objectDimension=1, brightObject=True
        )
        result = np.maximum(result, sigma**2 * sitk.GetArrayViewFromImage(lines))
    return result


def _near(head: Head, sheets: Surfels, distance_mm: float) -> np.ndarray:
    """(k, j, i) True within a distance of surfels."""
    result = np.zeros(head.brain.shape, bool)
    matrix = head.image.ras_to_ijk
    index = np.rint(sheets.place @ matrix[:3, :3].T + matrix[:3, 3]).astype(int)[:, ::-1]
    index = index[((index >= 0) & (index < result.shape)).all(axis=1)]
    if not len(index):
        return result
    result[tuple(index.T)] = True
    return distance_to(result, head.image.spacing_mm) <= distance_mm


def _large(inside: np.ndarray, voxels: float) -> np.ndarray:
    parts = components(inside)
    kept = np.bincount(parts.ravel()) > voxels
    kept[0] = False
    return kept[parts]
