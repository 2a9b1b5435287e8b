"""The tentorium cerebelli: the template's, moved along its normal, with its apex at the straight sinus."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.mri.sheets.falx import FREE_EDGE
from SlicerUSSim.Logic.mri.sheets.head import Head
from SlicerUSSim.Logic.mri.sheets.heights import patches, settled
from SlicerUSSim.Logic.mri.sheets.regions import in_tentorium, tentorium_height
from SlicerUSSim.Logic.tissue.surfels import Surfels

#: x and y of MNI152 and length of the search along the normal, mm
_X_MM, _Y_MM, _REACH_MM, _STEP_MM = 66.0, (-104.0, -12.0), 6.0, 0.5
_WINDOWS_MM, _SMOOTHINGS_MM = (5.0, 4.0, 3.0, 2.0), (8.0, 6.0, 5.0, 4.0)
#: Second derivatives along the normal are of the image after this Gaussian, over these steps
_SIGMA_MM, _CURVATURE_STEPS = 1.0, 2
#: Half width of the apex, which rises to the straight sinus, and of the part that is held there, mm
_APEX_MM, _HELD_MM = 8.0, 3.0
#: Region of the search for the straight sinus around the template's, mm
_SINUS_REACH_MM, _SINUS_BESIDE_MM = 8.0, 4.0
#: Thickness; and its confidence by its place alone
_THICKNESS_MM, _SURE = 0.8, 0.6


def tentorium(head: Head, falx: Surfels | None = None) -> Surfels:
    """Surfels 1 mm apart on the tentorium; `falx` tells where its apex is from left to right."""
    x, y = np.arange(-_X_MM, _X_MM + 1e-6), np.arange(_Y_MM[0], _Y_MM[1] + 1e-6)
    apex_x, apex_z = straight_sinus(head, y, falx)
    across, along = np.meshgrid(x, y)  # (y, x)
    beside = np.abs(across - apex_x[:, None])
    rise = (apex_z - tentorium_height(np.zeros_like(y), y))[:, None] * np.exp(-((beside / _APEX_MM) ** 2))
    base = np.stack([across, along, tentorium_height(across, along) + rise], axis=-1)
    normal, _ = patches(base)
    offsets = np.arange(-_REACH_MM, _REACH_MM + 1e-6, _STEP_MM)
    points = head.from_atlas((base[:, :, None] + offsets[:, None] * normal[:, :, None]).reshape(-1, 3))
    values = head.at(points, head.smoothed(_SIGMA_MM)).reshape(*base.shape[:2], len(offsets))
    relief = _relief(values, head)
    is_there = in_tentorium(across, along)
    usable = np.zeros(relief.shape, bool)
    usable[..., _CURVATURE_STEPS:-_CURVATURE_STEPS] = is_there[..., None]
    is_apex = beside < _HELD_MM
    usable &= ~is_apex[..., None] | (np.abs(offsets) < 0.6)
    height = np.zeros(is_there.shape, np.float32)
    # The two halves do not pull each other over the apex.
    for half in (across < apex_x[:, None], across >= apex_x[:, None]):
        found, _ = settled(relief, offsets, usable & half[..., None], _WINDOWS_MM, _SMOOTHINGS_MM)
        height[half] = found[half]
    inside = head.at(points, (head.depth > -2.0).astype(np.float32)).reshape(relief.shape)
    column = (height + _REACH_MM) / _STEP_MM
    seen = ndimage.map_coordinates(relief, [*np.indices(height.shape), column], order=1)
    kept = is_there & (ndimage.map_coordinates(inside, [*np.indices(height.shape), column], order=1) > 0.5)
    place = head.from_atlas((base + height[..., None] * normal).reshape(-1, 3)).reshape(base.shape)
    normal, area = patches(place)
    confidence = _SURE + (1.0 - _SURE) * np.clip(seen, 0.0, 1.0)
    return Surfels.of("tentorium", place[kept], normal[kept], _THICKNESS_MM, confidence[kept], area[kept])


def _relief(values: np.ndarray, head: Head) -> np.ndarray:
    """(..., offsets) second derivative along the normal: of a bright sheet with contrast agent, of a dark one without.

    1 is the sheet of half the contrast between grey matter and CSF (between white matter and twice it).
    """
    n = _CURVATURE_STEPS
    bend = np.zeros_like(values)
    bend[..., n:-n] = values[..., 2 * n :] + values[..., : -2 * n] - 2.0 * values[..., n:-n]
    if head.is_enhanced:
        return -bend / (head.white - head.grey)
    return 2.0 * bend / (head.grey - head.csf)


def straight_sinus(head: Head, y: np.ndarray, falx: Surfels | None) -> tuple[np.ndarray, np.ndarray]:
    """(x, z) of the straight sinus at each y, mm of the atlas: the template's; with contrast the brightest near it."""
    edge = np.array(FREE_EDGE, float)
    z = np.interp(-y, -edge[:, 0], edge[:, 1])
    x = np.zeros_like(z)
    if falx is not None and len(falx):
        near = head.to_atlas(falx.place)
        for n, (at_y, at_z) in enumerate(zip(y, z, strict=True)):
            away = np.hypot(near[:, 1] - at_y, near[:, 2] - at_z)
            x[n] = near[np.argmin(away), 0]
        x = ndimage.gaussian_filter1d(x, 4.0, mode="nearest")
    if not head.is_enhanced:
        return x, z
    steps = np.arange(-_SINUS_REACH_MM, _SINUS_REACH_MM + 1e-6)
    sides = np.arange(-_SINUS_BESIDE_MM, _SINUS_BESIDE_MM + 1e-6)
    up, side = np.meshgrid(steps, sides, indexing="ij")
    points = np.stack(
        [x[:, None, None] + side, np.broadcast_to(y[:, None, None], (len(y), *up.shape)), z[:, None, None] + up],
        axis=-1,
    )
    bright = head.at(head.from_atlas(points.reshape(-1, 3)), head.smoothed(_SIGMA_MM)).reshape(len(y), *up.shape)
    relief = (bright - head.white).max(axis=2) / (4.0 * head.noise)
    usable = np.broadcast_to((y > -92.0)[:, None, None], (len(y), 1, len(steps))) & (y < -44.0)[:, None, None]
    found, _ = settled(np.clip(relief, 0.0, 6.0)[:, None], steps, usable, (8.0, 5.0, 3.0), (8.0, 5.0, 3.0))
    return x, z + found[:, 0]
