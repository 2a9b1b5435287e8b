"""Tissues of a CT by their Hounsfield units, with borders at half of the step between two tissues.

A voxel on a border has the numbers of neither side: between air and skin lie those of lung and fat, between bone and
muscle those of contrast agent. So borders are sharpened first: a voxel on a step belongs to the side on which half of
the step puts it, as edges in CT are measured, and takes the number of that side beyond the step (after toggle mapping;
Kramer and Bruckner, Pattern Recognition 7, 1975). What is in between afterwards is a separate tissue.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.neighbourhood import largest_around, smallest_around
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.ct_body import cells, pooled, spread

#: Classes in the order of their numbers, as indices from 1; the tissues that the presets have
NAMES = ("skin", "fat", "muscle", "blood", "cancellous bone", "bone", "metal", "lung", "air")
SKIN, FAT, SOFT, BLOOD, SPONGY, BONE, METAL, LUNG, AIR = range(1, len(NAMES) + 1)

#: Numbers between the classes, HU: middles of the ranges that radiology gives them (Kalender, Computed Tomography,
#: 2011): lung -950 to -500, fat -120 to -80, muscle and organs 20 to 80, 100 to 130 with contrast agent, vessels with
#: contrast agent 140 to 400, bone from 150 (cancellous) to 2000
_AIR_LUNG, _LUNG_FAT, _FAT_SOFT, _SOFT_BRIGHT, _METAL = -930, -250, -25, 135, 2900
#: Only bone is as dense as the first number, or as the second in a sheet; around it cortex goes down to the third,
#: and has the last where it is thicker than the blur
_DENSE_HU, _CORE_HU, _CORTEX_HU, _WHOLE_CORTEX_HU = 700, 450, 300, 1600.0
#: Thin cortex has less: at least this number, if it exceeds wider structures than the third, mm, by the second
_SHEET_HU, _STANDS_OUT, _SHEET_MM = 220, 90, 6.0
#: A gap between bones that is narrower than the first number, mm, and by the second darker than both
_GAP_MM, _GAP_DEPTH_HU = 3.5, 150
#: Marrow with trabeculae has at least this number, where bone is in this share of 26 directions within this many mm
_MARROW_HU, _ENCLOSED, _REACH_MM = 100, 0.84, 30.0
#: Least difference across a voxel that is on a step: less than from fat to muscle, or this many deviations of
#: the noise; and those within which a number alone does not tell contrast agent
_LEAST_STEP, _STEP_PER_NOISE, _MARGIN_PER_NOISE = 90, 5.0, 2.0
#: Gas in a smaller space than this is not lung, ml
_LEAST_LUNG_ML = 10.0
#: Thickness of the skin (1.6 to 2.3 mm; Laurent et al., Vaccine 25(34), 2007)
SKIN_MM = 1.8


def sharpened(hu: np.ndarray, noise: float) -> np.ndarray:
    """(k, j, i) int16 with steps as sharp as the voxels; `noise` is the deviation in `hu`.

    Voxels on a step are those whose neighbours on both sides differ. Of its side's voxels that are on none, each takes
    the number nearest to its own, and the next ones theirs from it.
    """
    low, high = (around(around(hu)) for around in (smallest_around, largest_around))
    is_upper = hu >= (low >> 1) + (high >> 1)
    known = np.ones(hu.shape, bool)
    for axis in range(3):
        steepness = np.abs(ndimage.convolve1d(hu, [1, 0, -1], axis, mode="nearest"))
        known &= steepness < max(_LEAST_STEP, round(_STEP_PER_NOISE * noise))
    result, far = hu.copy(), np.int16(32000)
    for _ in range(2):
        for side, around, none in ((is_upper, smallest_around, far), (~is_upper, largest_around, -far)):
            nearest = around(np.where(known & side, result, none))
            found = side & ~known & (nearest != none)
            np.copyto(result, nearest, where=found)
            known |= found
    for side, around in ((is_upper, largest_around), (~is_upper, smallest_around)):  # thinner than two voxels
        np.copyto(result, around(hu), where=side & ~known)
    return result


def classified(
    hu: np.ndarray, filtered: np.ndarray, noise: float, body: np.ndarray, ct: Volume, skin_mm: float = SKIN_MM
) -> np.ndarray:
    """(k, j, i) uint8 classes, 0 outside the body; `hu` is `filtered`, of this noise, with sharp borders."""
    limits = np.array([_AIR_LUNG, _LUNG_FAT, _FAT_SOFT, _SOFT_BRIGHT, _METAL])
    table = np.array([AIR, LUNG, FAT, SOFT, BLOOD, METAL], np.uint8)
    classes = np.where(body, table[np.searchsorted(limits, np.arange(-1024, 3501), side="right")][hu + 1024], 0)
    _mark_gas(classes, ct)
    _mark_bone(classes, hu, filtered, ct)
    _settle_blood(classes, hu, noise)
    if skin_mm > 0.0:  # the outermost layer; the ends of the image are not a surface
        import SimpleITK as sitk

        outside, radius = sitk.GetImageFromArray((~body).astype(np.uint8)), np.rint(skin_mm / ct.spacing_mm)
        near = sitk.GetArrayFromImage(sitk.BinaryDilate(outside, radius.astype(int).tolist(), sitk.sitkBall)) > 0
        classes[body & near & ~np.isin(classes, (SPONGY, BONE, METAL))] = SKIN
        soft = classes == SOFT  # the rest of thicker skin
        classes[soft & largest_around(classes == SKIN) & ~largest_around(smallest_around(soft))] = SKIN
    return classes


def _settle_blood(classes: np.ndarray, hu: np.ndarray, noise: float) -> None:
    """Contrast agent and soft tissue by the mean of both around, where the number alone is within the noise."""
    both = (classes == SOFT) | (classes == BLOOD)
    mean = ndimage.uniform_filter(np.where(both, np.clip(hu, 0, 2 * _SOFT_BRIGHT) - _SOFT_BRIGHT, 0).astype(np.float32))
    both &= np.abs(hu - _SOFT_BRIGHT) < _MARGIN_PER_NOISE * noise
    classes[both] = np.where(mean[both] >= 0.0, BLOOD, SOFT)
    blood = classes == BLOOD  # what is thin beside bone is the rest of its border
    near = largest_around(largest_around(np.isin(classes, (SPONGY, BONE, METAL))))
    classes[blood & near & ~largest_around(smallest_around(blood))] = SOFT


def _mark_gas(classes: np.ndarray, ct: Volume) -> None:
    """Lung in small pieces is gas, as in bowel; so is the rim of a bubble, whose wall is often too thin to be seen."""
    size = cells(ct)
    lung = pooled(classes == LUNG, size, np.logical_and)
    parts: Any = ndimage.label(lung)[0]  # pyright: ignore
    large = np.bincount(parts.ravel()) * float(np.prod(size)) * ct.voxel_ml >= _LEAST_LUNG_ML
    large[0] = False
    near = np.asarray(ndimage.binary_dilation(large[parts], iterations=2))
    classes[(classes == LUNG) & ~spread(near, size, classes.shape)] = AIR
    classes[(classes == FAT) & largest_around(classes == AIR)] = SOFT


def _mark_bone(classes: np.ndarray, hu: np.ndarray, filtered: np.ndarray, ct: Volume) -> None:
    """Cortex where the numbers are high, trabeculae where bone encloses what is brighter than muscle."""
    size = cells(ct)
    widths = [[2 * int(0.5 * mm / size) + 1 for size in ct.spacing_mm[::-1]] for mm in (_SHEET_MM, _GAP_MM)]
    is_sheet = hu - np.asarray(ndimage.grey_opening(hu, widths[0])) >= _STANDS_OUT
    is_core = (classes > 0) & ((hu >= _DENSE_HU) | ((hu >= _CORE_HU) & is_sheet))
    core = pooled(is_core, size, np.logical_or)
    near = spread(largest_around(core), size, hu.shape)
    cortex = (classes == BLOOD) & ((near & (hu >= _CORTEX_HU)) | ((hu >= _SHEET_HU) & is_sheet))
    # Small vessels stand out, too: cortex hangs together with what only bone can be.
    parts: Any = ndimage.label(pooled(cortex, size, np.logical_or), np.ones((3, 3, 3)))[0]  # pyright: ignore
    cortex &= spread(np.isin(parts, np.unique(parts[core & (parts > 0)])), size, hu.shape)
    wall = pooled(cortex, size, np.logical_or)
    # The lower the crest of a sheet that is thinner than the blur, the nearer to it its border: at half for thick ones.
    base = np.maximum(smallest_around(filtered)[cortex], 0).astype(np.float32)
    crest = np.maximum(hu[cortex] - base, 1.0)
    part = np.minimum(crest / np.maximum(_WHOLE_CORTEX_HU - base, 1.0), 1.0)
    cortex[cortex] = (base >= _CORTEX_HU) | (filtered[cortex] >= base + crest * (1.0 - 0.5 * part))
    # The space of a joint is bright, too, between two cortices, but a gap; marrow is wider.
    is_gap = near & (np.asarray(ndimage.grey_closing(filtered, widths[1])) - filtered >= _GAP_DEPTH_HU)
    enclosed = spread(enclosed_share(wall, np.array(size) * ct.spacing_mm[::-1]) >= _ENCLOSED, size, hu.shape)
    classes[cortex] = BONE
    classes[enclosed & np.isin(classes, (SOFT, BLOOD)) & (hu >= _MARROW_HU)] = SPONGY
    for _ in range(max(size)):  # into the cells of the cortex, of which only the inner part is enclosed
        classes[ndimage.binary_dilation(classes == SPONGY) & (classes == BLOOD)] = SPONGY
    classes[is_gap & ((classes == BLOOD) | (classes == SPONGY))] = SOFT


def enclosed_share(wall: np.ndarray, spacing_mm: np.ndarray) -> np.ndarray:
    """(k, j, i) share of 26 directions in which a wall is within reach; the image continues beyond its ends.

    `spacing_mm` is along k, j, i. Marrow has a wall all around; a vessel beside a vertebra has one on one side, a disc
    above and below, the spinal canal not along itself.
    """
    steps = [np.subtract(step, 1) for step in np.ndindex(3, 3, 3) if step != (1, 1, 1)]
    reaches = [max(int(_REACH_MM / np.linalg.norm(step * spacing_mm)), 1) for step in steps]
    margin, met = max(reaches), np.zeros(wall.shape, np.uint8)
    wide = np.pad(wall, margin, mode="edge")
    for step, reach in zip(steps, reaches, strict=True):
        hit = np.zeros(wall.shape, bool)
        for start in (margin + n * step for n in range(1, reach + 1)):
            hit |= wide[tuple(slice(a, a + count) for a, count in zip(start, wall.shape, strict=True))]
        met += hit
    return met / len(steps)
