"""What a brain mask cuts off."""

from __future__ import annotations

from typing import cast

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.volume import Volume
from SlicerUSSim.Logic.mri.coarse import resampled_to_ras
from SlicerUSSim.Logic.mri.refinement import brightness_near, on_grid, signed_distance

_SPACING_MM = 2.0
#: Tissue as bright as the brain, relative to it nearby: darker is CSF or skull in T1, brighter CSF in T2 and fat
_TISSUE = (0.75, 1.25)
#: Depth below and height above the mask's border at which tissue is looked for, and the areas worth a word, cm2
_BELOW_MM, _ABOVE_MM, _WORTH_CM2, _WORTH_AT_BASE_CM2 = 3.0, 4.0, 6.0, 20.0


def cut_off(mri: Volume, inside: np.ndarray) -> tuple[str, ...]:
    """One line if the mask's border runs through tissue as bright as the brain; nothing if it does not.

    Not at the edge of the image, and at the skull base, where nerves, vessels and the spinal cord leave, only over a
    larger area: whole masks of four heads had up to 5 cm2 there, without the lower 25 to 60 mm 25 to 155 cm2.
    """
    image, origin = resampled_to_ras(mri, _SPACING_MM)
    matrix = np.diag([_SPACING_MM] * 3 + [1.0])
    matrix[:3, 3] = origin
    grid = Volume(image, matrix)
    mask = on_grid(mri.with_array(inside), grid) > 0.5
    is_shown = on_grid(mri.with_array(np.ones(inside.shape, bool)), grid) > 0.99
    depth = -signed_distance(mask, np.full(3, _SPACING_MM), 2.0 * _ABOVE_MM)
    core = depth > 8.0
    if not core.any():  # a slab of a brain, with nothing deep to compare with
        return ()
    bright = brightness_near(image, core, _SPACING_MM)
    tissue = (bright > _TISSUE[0]) & (bright < _TISSUE[1]) & is_shown
    # The border is cut where tissue goes on without a gap from below it to well above it.
    above = (depth < 0.0) & (depth >= -_ABOVE_MM) & tissue
    below = (depth > 0.0) & (depth <= _BELOW_MM) & tissue
    solid = cast(np.ndarray, ndimage.binary_opening(tissue, np.ones((2, 2, 2))))
    across = cast(np.ndarray, ndimage.binary_dilation(below, iterations=2)) & above & solid
    points = np.argwhere(mask)
    centre = points.mean(axis=0)
    base = int(centre[0] + 10.0 / _SPACING_MM)
    found = [(*_largest(across, slice(base, None)), _WORTH_CM2), (*_largest(across, slice(base)), _WORTH_AT_BASE_CM2)]
    area, place, worth = max(found, key=lambda part: part[0] / part[2])
    if area < worth:
        return ()
    away = place - centre
    words = ("top" if away[0] > 0 else "bottom", "front" if away[1] > 0 else "back", "right" if away[2] > 0 else "left")
    where = words[int(np.abs(away / np.ptp(points, axis=0)).argmax())]
    return (
        f"the mask ends in tissue as bright as the brain over {area:.0f} cm2 at the {where}; check the cortex there",
    )


def _largest(across: np.ndarray, slices: slice) -> tuple[float, np.ndarray]:
    """(area in cm2, centre (k, j, i)) of the largest piece within these slices."""
    parts, count = ndimage.label(across[slices], np.ones((3, 3, 3)))  # type: ignore[misc]
    if count == 0:
        return 0.0, np.zeros(3)
    sizes = np.bincount(parts.ravel())[1:]
    place = np.argwhere(parts == sizes.argmax() + 1).mean(axis=0) + [slices.start or 0, 0, 0]
    return float(sizes.max()) * _SPACING_MM**3 / _ABOVE_MM / 100.0, place
