"""Tissues of a CT by their Hounsfield units, with borders at half of the step between two tissues.

A voxel on a border has the numbers of neither side: between air and skin lie those of lung and fat, between bone and
muscle those of contrast agent. So borders are sharpened first: a voxel on a step belongs to the side on which half of
the step puts it, as edges in CT are measured, and takes the number of that side beyond the step (after toggle mapping;
Kramer and Bruckner, Pattern Recognition 7, 1975). What is in between afterwards is a tissue of its own.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.neighbourhood import largest_around, smallest_around
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.ct_body import cells, components, pooled, spread

#: Classes in the order of their numbers, as indices from 1; the tissues that the presets have
NAMES = ("skin", "fat", "muscle", "blood", "cancellous bone", "bone", "metal", "lung", "air")
SKIN, FAT, SOFT, BLOOD, SPONGY, BONE, METAL, LUNG, AIR = range(1, len(NAMES) + 1)

#: Numbers between the classes, HU: middles of the ranges that radiology gives them (Kalender, Computed Tomography,
#: 2011): lung -950 to -500, fat -120 to -80, muscle and organs 20 to 80, 100 to 130 with contrast agent, vessels with
#: contrast agent 140 to 400, bone from 150 (cancellous) to 2000
_AIR_LUNG, _LUNG_FAT, _FAT_SOFT, _SOFT_BRIGHT, _METAL = -930, -250, -25, 135, 2900
#: Only bone is as dense as the first number, or as the second in a sheet; around it cortex goes down to the third
_DENSE_HU, _CORE_HU, _CORTEX_HU = 700, 450, 300
#: Thin cortex has less: from this number on, if it stands out so much from what is wider than this, mm
_SHEET_HU, _STANDS_OUT, _SHEET_MM = 220, 90, 6.0
#: A gap between bones that is narrower than the first number, mm, and so much darker than both
_GAP_MM, _GAP_DEPTH_HU = 3.5, 150
#: Marrow with trabeculae from this number on, in what bone encloses to the first share; any in the second
_MARROW_HU, _ENCLOSED, _WHOLLY_ENCLOSED = 100, 0.84, 0.95
#: How far away bone may be that encloses, mm
_REACH_MM = 30.0
#: Of its 26 directions, so many may leave the image: those beyond one of its faces
_MOST_LEFT = 9
#: Voxels by which marrow grows towards the cortex
_MARROW_STEPS = 3
#: Cortex that is thicker than the blur
_WHOLE_CORTEX_HU = 1600.0
#: A difference across a voxel from which on it is on a step (more with noise): less than from fat to muscle
_LEAST_STEP, _STEP_PER_NOISE, _SHARPENINGS = 90, 5.0, 3
#: Deviations of the noise, within which a number alone does not tell contrast agent
_MARGIN_PER_NOISE = 2.0
#: Voxels of contrast agent among 27 below which it is noise; two by two across a vessel have 12
_LEAST_TOGETHER = 10
#: Gas in a smaller space than this is no lung, ml
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
    del low, high
    known = _steepness(hu) < max(_LEAST_STEP, round(_STEP_PER_NOISE * noise))
    result = hu.copy()
    for _ in range(_SHARPENINGS):
        for side, around, none in ((is_upper, smallest_around, _ABOVE_ALL), (~is_upper, largest_around, -_ABOVE_ALL)):
            nearest = around(np.where(known & side, result, none))
            found = side & ~known & (nearest != none)
            np.copyto(result, nearest, where=found)
            known |= found
    for side, around in ((is_upper, largest_around), (~is_upper, smallest_around)):  # thinner than two voxels
        np.copyto(result, around(hu), where=side & ~known)
    return result


_ABOVE_ALL = np.int16(32000)


def _steepness(hu: np.ndarray) -> np.ndarray:
    """(k, j, i) int16 the largest difference between a voxel's neighbours along an axis; of a crest it is small."""
    result = np.zeros_like(hu)
    for axis in range(3):
        values, steep = np.moveaxis(hu, axis, 0), np.moveaxis(result, axis, 0)
        np.maximum(steep[1:-1], np.abs(values[2:] - values[:-2]), out=steep[1:-1])
        for end, beside in ((0, 1), (-1, -2)):
            if len(values) > 1:
                np.maximum(steep[end], np.abs(values[end] - values[beside]), out=steep[end])
    return result


def classified(
    hu: np.ndarray, filtered: np.ndarray, noise: float, body: np.ndarray, ct: Volume, skin_mm: float = SKIN_MM
) -> np.ndarray:
    """(k, j, i) uint8 classes, 0 outside the body; `hu` is `filtered`, of this noise, with sharp borders."""
    limits = np.array([_AIR_LUNG, _LUNG_FAT, _FAT_SOFT, _SOFT_BRIGHT, _METAL])
    table = np.array([AIR, LUNG, FAT, SOFT, BLOOD, METAL], np.uint8)
    lookup = table[np.searchsorted(limits, np.arange(-1024, 3501), side="right")]
    classes = lookup[hu + 1024]
    classes[~body] = 0
    _mark_gas(classes, ct)
    _mark_bone(classes, hu, filtered, ct)
    _settle_blood(classes, hu, noise)
    # Gas lies in an organ, whose wall is often too thin to be seen between gas and fat.
    classes[(classes == FAT) & _beside(classes == AIR)] = SOFT
    if skin_mm > 0.0:
        _mark_skin(classes, body, ct, skin_mm)
    return classes


def _mark_gas(classes: np.ndarray, ct: Volume) -> None:
    """Lung in small pieces is gas: bowel with contents, the rims of bubbles."""
    size = cells(ct)
    lung = pooled((classes == LUNG).view(np.uint8), size, np.minimum) > 0  # cells that are lung as a whole
    parts, count = components(lung)
    if count:
        cell_ml = float(np.prod(size)) * ct.voxel_ml
        large = np.bincount(parts.ravel()) * cell_ml >= _LEAST_LUNG_ML
        large[0] = False
        lung = ndimage.binary_dilation(large[parts], iterations=2)
    classes[(classes == LUNG) & ~spread(np.asarray(lung), size, classes.shape)] = AIR


def _mark_bone(classes: np.ndarray, hu: np.ndarray, filtered: np.ndarray, ct: Volume) -> None:
    """Cortex where the numbers are high, trabeculae where bone encloses what is brighter than muscle."""
    size = cells(ct)
    above = _beyond_surroundings(hu, ct, _SHEET_MM, is_crest=True)
    is_core = (classes > 0) & ((hu >= _DENSE_HU) | ((hu >= _CORE_HU) & (above >= _STANDS_OUT)))
    core = pooled(is_core.view(np.uint8), size, np.maximum) > 0
    if not core.any():
        return
    near = spread(np.asarray(ndimage.binary_dilation(core, np.ones((3, 3, 3)))), size, hu.shape)
    bright = classes == BLOOD
    cortex = bright & ((near & (hu >= _CORTEX_HU)) | ((hu >= _SHEET_HU) & (above >= _STANDS_OUT)))
    # Small vessels stand out, too: cortex hangs together with what only bone can be.
    parts, _ = components(pooled(cortex.view(np.uint8), size, np.maximum), np.ones((3, 3, 3)))
    of_bone = np.zeros(parts.max() + 1, bool)
    of_bone[parts[core]] = True
    of_bone[0] = False
    cortex &= spread(of_bone[parts], size, hu.shape)
    wall = pooled(cortex.view(np.uint8), size, np.maximum) > 0
    # The space of a joint is bright, too, between two cortices, but a gap; marrow is wider.
    is_gap = near & (_beyond_surroundings(filtered, ct, _GAP_MM, is_crest=False) >= _GAP_DEPTH_HU)
    # The lower the crest of a sheet that is thinner than the blur, the nearer to it its border: at half for thick ones.
    base = np.maximum(smallest_around(filtered)[cortex], 0).astype(np.float32)
    crest = np.maximum(hu[cortex] - base, 1.0)
    part = np.minimum(crest / np.maximum(_WHOLE_CORTEX_HU - base, 1.0), 1.0)
    cortex[cortex] = ((base >= _CORTEX_HU) & ~is_gap[cortex]) | (filtered[cortex] >= base + crest * (1.0 - 0.5 * part))
    share, is_whole = enclosed_share(wall, np.array(size) * ct.spacing_mm[::-1])
    enclosed, wholly = (
        spread(where, size, hu.shape)
        for where in (share >= _ENCLOSED, is_whole & (share >= _WHOLLY_ENCLOSED))
    )  # fmt: skip
    is_marrow = enclosed & (hu >= _MARROW_HU) & (classes >= SOFT) & (classes <= BLOOD)
    is_marrow |= wholly & (classes >= FAT) & (classes <= BLOOD)
    classes[is_marrow] = SPONGY
    classes[cortex] = BONE
    classes[is_gap & ((classes == BLOOD) | (classes == SPONGY))] = SOFT
    for _ in range(_MARROW_STEPS):  # into the cells of the cortex itself, which enclosed nothing
        beside = _beside(classes == SPONGY) & (classes == BLOOD)
        classes[beside] = SPONGY


def _beyond_surroundings(hu: np.ndarray, ct: Volume, width_mm: float, is_crest: bool) -> np.ndarray:
    """(k, j, i) int16 how far a voxel is above what is around on both sides, or below if it is no crest but a gap.

    Of a sheet it is the height, of what is wider nothing (white and black top-hat; Meyer 1979).
    """
    levelled = hu
    for extreme in (np.minimum, np.maximum) if is_crest else (np.maximum, np.minimum):
        for axis, mm in enumerate(ct.spacing_mm[::-1]):
            for _ in range(int(0.5 * width_mm / mm)):
                narrow, levelled = np.moveaxis(levelled, axis, 0), levelled.copy()
                wide = np.moveaxis(levelled, axis, 0)
                extreme(wide[1:], narrow[:-1], out=wide[1:])
                extreme(wide[:-1], narrow[1:], out=wide[:-1])
    return hu - levelled if is_crest else levelled - hu


def enclosed_share(wall: np.ndarray, spacing_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """((k, j, i) float32 share of 26 directions in which a wall is within reach, bool whether all could be looked at).

    `spacing_mm` is along k, j, i. Directions that leave the image without a wall do not count. Marrow has a wall all
    around; a vessel beside a vertebra has one on one side, a disc above and below, the spinal canal not along itself.
    """
    met, left = np.zeros(wall.shape, np.uint8), np.zeros(wall.shape, np.uint8)
    for direction in np.ndindex(3, 3, 3):
        step = np.subtract(direction, 1)
        if not step.any():
            continue
        reach = max(int(_REACH_MM / np.linalg.norm(step * spacing_mm)), 1)
        hit = _any_along(wall, step, reach, False)
        met += hit
        left += _any_along(wall, step, reach, True) & ~hit
    share = met / np.maximum(26.0 - left, 1.0)
    return np.where(left <= _MOST_LEFT, share, 0.0).astype(np.float32), left == 0


def _any_along(wall: np.ndarray, step: np.ndarray, reach: int, beyond: bool) -> np.ndarray:
    """Whether a wall is in this direction within `reach` steps, by doubling; `beyond` the ends of the image."""
    result, done = _shifted(wall, step, beyond), 1
    while done < reach:
        more = min(done, reach - done)
        result = result | _shifted(result, step * more, beyond)
        done += more
    return result


def _shifted(mask: np.ndarray, step: np.ndarray, beyond: bool) -> np.ndarray:
    """The mask at `step` from every cell, and what is beyond the ends."""
    result = np.full_like(mask, beyond)
    if (np.abs(step) >= mask.shape).any():
        return result
    to = tuple(slice(max(-n, 0), size - max(n, 0)) for n, size in zip(step, mask.shape, strict=True))
    of = tuple(slice(max(n, 0), size - max(-n, 0)) for n, size in zip(step, mask.shape, strict=True))
    result[to] = mask[of]
    return result


def _settle_blood(classes: np.ndarray, hu: np.ndarray, noise: float) -> None:
    """Contrast agent and soft tissue by the mean of both around, where the number alone is within the noise.

    Specks of noise, and contrast agent beside bone that is thinner than three voxels, which is what is left of its
    border, are soft tissue.
    """
    both = (classes == SOFT) | (classes == BLOOD)
    margin = _MARGIN_PER_NOISE * noise
    doubtful = both & (hu >= _SOFT_BRIGHT - margin) & (hu < _SOFT_BRIGHT + margin)
    if not doubtful.any():
        return
    total = _sum_around(np.where(both, np.clip(hu, 0, 2 * _SOFT_BRIGHT), 0).astype(np.int16))
    is_bright = total >= _SOFT_BRIGHT * _sum_around(both.astype(np.uint8)).astype(np.int16)
    classes[doubtful] = np.where(is_bright[doubtful], BLOOD, SOFT)
    blood = classes == BLOOD
    classes[blood & (_sum_around(blood.astype(np.uint8)) < _LEAST_TOGETHER)] = SOFT
    blood = classes == BLOOD
    near = largest_around(largest_around(np.isin(classes, (BONE, SPONGY, METAL))))
    thick = largest_around(smallest_around(blood))
    classes[blood & near & ~thick] = SOFT


def _sum_around(array: np.ndarray) -> np.ndarray:
    """(k, j, i) the sum of the 27 voxels around, in the type of the array."""
    for axis in range(3):
        one, total = np.moveaxis(array, axis, 0), np.moveaxis(array.copy(), axis, 0)
        total[1:] += one[:-1]
        total[:-1] += one[1:]
        array = np.moveaxis(total, 0, axis)
    return array


def _beside(where: np.ndarray) -> np.ndarray:
    """Whether one of the six neighbours is True."""
    result = np.zeros_like(where)
    for axis in range(3):
        one, any_ = np.moveaxis(where, axis, 0), np.moveaxis(result, axis, 0)
        any_[1:] |= one[:-1]
        any_[:-1] |= one[1:]
    return result


def _mark_skin(classes: np.ndarray, body: np.ndarray, ct: Volume, skin_mm: float) -> None:
    """The outermost layer of fat or soft tissue is skin; the ends of the image are no surface."""
    outside, steps = ~body, np.rint(skin_mm / ct.spacing_mm[::-1]).astype(int)
    count = max(int(steps.max()), 1)
    for n in range(count):
        grown = outside.copy()
        for axis in np.flatnonzero((n + 1) * steps // count > n * steps // count):
            # By a cube and a cross in turn, which is nearly a ball
            narrow = np.moveaxis(grown.copy() if n % 2 else outside, axis, 0)
            wide = np.moveaxis(grown, axis, 0)
            wide[1:] |= narrow[:-1]
            wide[:-1] |= narrow[1:]
        outside = grown
    gas = (classes == LUNG) | (classes == AIR)  # of a crease, or beside the couch
    classes[outside & ((classes >= FAT) & (classes <= BLOOD) | gas)] = SKIN
    soft = classes == SOFT  # what is left of thicker skin
    classes[soft & largest_around(classes == SKIN) & ~largest_around(smallest_around(soft))] = SKIN
