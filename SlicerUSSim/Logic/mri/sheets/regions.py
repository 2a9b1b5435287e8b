"""Regions of a head by the atlas and the patient's own intensities: ventricles, the hindbrain, bright tissue."""

from __future__ import annotations

from functools import cache

import numpy as np

from SlicerUSSim.Logic.base.neighbourhood import distance_to
from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.atlas import Atlas
from SlicerUSSim.Logic.mri.coarse import components
from SlicerUSSim.Logic.mri.sheets.head import Head

#: Corners of a box of the template that holds the lateral ventricles, and a place in each, in MNI152 millimetres
_LATERAL_BOX, _LATERAL_SEEDS = ((-42, -62, -45), (42, 45, 38)), ((-8, 10, 15), (8, 10, 15))
#: Boxes that cut the third and the fourth ventricle from the cisterns around
_MIDLINE_BOXES = (((-4, -28, -14), (4, 3, 7)), ((-12, -48, -42), (12, -36, -22)))
#: How far the ventricles may lie from where the affine transform carries the template's, mm: those at the sides, which
#: grow with age, and those in the middle, which are near cisterns
_REACH_MM, _MIDLINE_REACH_MM = 8.0, 2.0
#: Parts of ventricles that are kept
_LEAST_MM3 = 30.0
#: Without an atlas: fluid as wide as this, so deep below the hull, in parts of this size, mm
_WIDE_MM, _DEEP_MM, _LEAST_WIDE_MM3 = 4.0, 15.0, 500.0


def tentorium_height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """z of the tentorium in MNI152 millimetres; a polynomial through the template's dark sheet above the cerebellum."""
    a, b = np.sqrt(x * x + 25.0) - 5.0, y + 55.0
    square = 0.03004 * a**2 - 0.007813 * b**2 - 0.01459 * a * b
    return 3.284 - 1.4415 * a + 0.2725 * b + square - 0.000246 * a**3 - 0.0000914 * b**3


def in_tentorium(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Whether the tentorium has a part above MNI152's (x, y): outside its notch and within the skull."""
    is_notch = (x / 19.0) ** 2 + ((y + 22.0) / 28.0) ** 2 < 1.0
    is_skull = (x / 66.0) ** 2 + ((y + 48.0) / 54.0) ** 2 > 1.0
    return ~is_notch & ~is_skull & (y < -12.0 - 0.35 * np.maximum(np.abs(x) - 12.0, 0.0))


def hindbrain(head: Head, margin_mm: float = 3.0) -> np.ndarray:
    """(k, j, i) True in cerebellum, brain stem and the cisterns around, up to a margin above the tentorium.

    Nowhere without an atlas.
    """
    if head.registered is None:
        return np.zeros(head.brain.shape, bool)
    x, y, z = head.in_atlas
    is_behind = y < -12.0 - 0.35 * np.maximum(np.abs(x) - 12.0, 0.0)
    is_notch = ((x / 24.0) ** 2 + ((y + 20.0) / 30.0) ** 2 < 1.0) & (z < 2.0)
    # The polynomial holds where it was fitted.
    height = tentorium_height(np.clip(x, -60.0, 60.0), np.clip(y, -100.0, -10.0))
    return (is_behind & (z < height + margin_mm)) | is_notch | ((z < -25.0) & (np.abs(x) < 25.0) & (y < 5.0))


@cache
def _template_ventricles(atlas: Atlas) -> tuple[np.ndarray, np.ndarray]:
    """((k, j, i) lateral ventricles, third and fourth) of the atlas, float32 0 or 1."""
    t1, fluid = atlas.t1, atlas.csf.array > 0.5
    parts = components(fluid & _in_box(t1, *_LATERAL_BOX))
    seeds = np.array(_LATERAL_SEEDS) @ t1.ras_to_ijk[:3, :3].T + t1.ras_to_ijk[:3, 3]
    found = {int(parts[tuple(np.rint(seed).astype(int)[::-1])]) for seed in seeds} - {0}
    middle = fluid & np.logical_or.reduce([_in_box(t1, *box) for box in _MIDLINE_BOXES])
    return np.isin(parts, list(found)).astype(np.float32), middle.astype(np.float32)


def _in_box(grid: Volume, low: tuple[float, ...], high: tuple[float, ...]) -> np.ndarray:
    k, j, i = np.ogrid[tuple(map(slice, grid.array.shape))]
    axes = [row[0] * i + row[1] * j + row[2] * k + row[3] for row in grid.ijk_to_ras[:3]]
    return np.logical_and.reduce(
        np.broadcast_arrays(*[(p >= a) & (p <= b) for p, a, b in zip(axes, low, high, strict=True)])
    )


def lateral_ventricles_of_atlas(head: Head) -> np.ndarray:
    """(k, j, i) True where the affine transform carries the template's lateral ventricles."""
    return head.carried(_template_ventricles(head.atlas.atlas)[0]) > 0.5


def ventricles(head: Head) -> np.ndarray:
    """(k, j, i) True in the fluid of the patient's ventricles, found from where the atlas has them.

    Without an atlas in wide fluid deep in the brain, to which cisterns at its base belong.
    """
    fluid = (head.fluid(head.smoothed(0.4)) > 0.5) & head.brain
    if head.registered is None:
        return _wide_and_deep(head, fluid)
    result = np.zeros(fluid.shape, bool)
    for template, reach in zip(_template_ventricles(head.atlas.atlas), (_REACH_MM, _MIDLINE_REACH_MM), strict=True):
        core = head.carried(template) > 0.5
        region = fluid & (distance_to(core, head.image.spacing_mm) <= reach)
        parts = components(region)
        sizes, common = np.bincount(parts.ravel()), np.bincount(parts[core], minlength=int(parts.max()) + 1)
        kept = (sizes * head.voxel_mm3 > _LEAST_MM3) & (common > 0)
        kept[0] = False
        result |= kept[parts]
    return result


def _wide_and_deep(head: Head, fluid: np.ndarray) -> np.ndarray:
    """(k, j, i) True in parts of fluid that are wide somewhere; their narrow ends belong to them."""
    deep = fluid & (head.depth > _DEEP_MM)
    wide = distance_to(~deep, head.image.spacing_mm) >= 0.5 * _WIDE_MM
    region = deep & (distance_to(wide, head.image.spacing_mm) <= _WIDE_MM) if wide.any() else wide
    parts = components(region)
    sizes = np.bincount(parts.ravel()) * head.voxel_mm3
    kept = sizes > _LEAST_WIDE_MM3
    kept[0] = False
    return kept[parts]
