"""The falx cerebri: a height field over the midsagittal plane, above the template's free edge.

It ends at the line between the rims of the hemispheres, and with contrast agent continues into the visible sinus.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.neighbourhood import distance_to
from SlicerUSSim.Logic.mri.coarse import largest_component
from SlicerUSSim.Logic.mri.sheets.head import Head
from SlicerUSSim.Logic.mri.sheets.heights import centred, patches, settled
from SlicerUSSim.Logic.tissue.surfels import Surfels

#: y and z of MNI152 of the search for the falx, its distance from the midsagittal plane, and steps; mm
_Y_MM, _Z_MM, _X_MM, _STEP_MM = (-112.0, 78.0), (-30.0, 90.0), 16.0, 1.0
#: The rims of the hemispheres, between which the hull of the brain may dip, are this near to the midsagittal plane
_RIM_MM = 24.0
#: Free edge, (y, z) of MNI152 in mm, from the front; its last part is the straight sinus
FREE_EDGE = (
    (64, -14), (58, 2), (52, 14), (43, 26), (30, 36), (14, 42), (-4, 44), (-20, 40), (-34, 32), (-41, 22), (-46, 13),
    (-60, 5), (-78, -3), (-96, -7),
)  # fmt: skip
_WINDOWS_MM, _SMOOTHINGS_MM = (6.0, 4.0, 3.0, 2.0), (8.0, 6.0, 5.0, 4.0)
#: Distance to white matter counts up to this; fluid and enhancement count as this many mm of it
_FARTHEST_MM, _EVIDENCE_MM = 6.0, 1.5
#: Half the thickness of the thinnest white matter that counts, and what is added when it is grown back, for the grid
_THIN_MM, _ROUNDING_MM = 1.5, 0.3
#: Distance to white matter in the fissure, after smoothing
_FISSURE_MM, _FISSURE_SIGMA = 1.8, 2.0
#: With contrast agent the falx is followed this far beyond the rims, into the sinus, where it enhances by this much
_SINUS_MM, _ENHANCED = 8.0, 0.5
#: Bright lines between fluids that are narrower than this may be the falx itself, mm
_LINE_MM = 5.0
#: Thickness of the falx; and its confidence by its place in the head alone, reached so far above the free edge, mm
_THICKNESS_MM, _SURE, _EDGE_MM = 1.0, 0.7, 6.0
#: The same where the relief is flat within this window: there the falx is drawn on from below. It is not flat where the
#: ridge is that much narrower than the window, smoothed by this
_UNSEEN, _SUPPORT_MM, _SUPPORTED, _SUPPORT_SIGMA = 0.35, 6.0, 0.4, 2.0


def falx(head: Head, use_intensity: bool = True) -> Surfels:
    """Surfels 1 mm apart on the falx; without `use_intensity` by the distance to white matter alone."""
    y, z = (np.arange(low, high + 1e-6, _STEP_MM) for low, high in (_Y_MM, _Z_MM))
    x = np.arange(-_X_MM, _X_MM + 1e-6, _STEP_MM)
    points = np.stack(np.meshgrid(z, y, x, indexing="ij")[::-1], axis=-1)
    flat = head.from_atlas(points.reshape(-1, 3))

    def sampled(array: np.ndarray) -> np.ndarray:
        return head.at(flat, array).reshape(points.shape[:3])

    distance = sampled(_distance_to_thick_white(head))
    between = _between_rims(head, y, z)
    beyond = np.asarray(ndimage.distance_transform_edt(~between, _STEP_MM))
    evidence = _sampled_evidence(head, sampled, beyond) if use_intensity else np.zeros_like(distance)
    relief = np.minimum(distance, _FARTHEST_MM) + _EVIDENCE_MM * np.where(distance > 0.5, evidence, 0.0)
    # Beyond the rims the relief is flat, and counts as such: were it left out, the middle of the rest beside a rim
    # that is higher than the other would draw the falx over that rim.
    usable = np.ones(relief.shape, bool)
    height, _ = settled(relief, x, usable, _WINDOWS_MM, _SMOOTHINGS_MM)

    def on_sheet(array: np.ndarray) -> np.ndarray:
        column = np.clip((height + _X_MM) / _STEP_MM, 0, len(x) - 1)
        rows = np.indices(height.shape)
        return ndimage.map_coordinates(array.astype(np.float32), [*rows, column], order=1)

    wide = ndimage.gaussian_filter(on_sheet(distance), _FISSURE_SIGMA) > _FISSURE_MM
    edge = np.interp(-y, [-corner[0] for corner in FREE_EDGE], [float(corner[1]) for corner in FREE_EDGE])
    above = z[:, None] - edge[None]
    # Far above the edge there is no callosum; white matter there is the rim of an enhancing vein.
    kept = (wide | (above > _EDGE_MM)) & (above > 0.0) & (on_sheet(between) > 0.5)
    if use_intensity and head.is_enhanced:
        bright = (on_sheet(evidence) > _ENHANCED) & (above > _EDGE_MM)
        kept = np.asarray(ndimage.binary_propagation(kept, mask=kept | bright), bool)
        # It is whole between the brain and the sinus.
        kept |= np.asarray(ndimage.binary_fill_holes(kept), bool) & (above > _EDGE_MM)
    kept = largest_component(np.asarray(ndimage.binary_opening(kept, np.ones((3, 3)))))
    place = head.from_atlas(np.stack([height, *np.broadcast_arrays(y[None], z[:, None])], axis=-1).reshape(-1, 3))
    place = place.reshape(*height.shape, 3)
    normal, area = patches(place)
    _, narrow = centred(relief, x, usable, height, _SUPPORT_MM)
    support = np.clip(ndimage.gaussian_filter(narrow, _SUPPORT_SIGMA) / _SUPPORTED, 0.0, 1.0)
    seen = np.clip(on_sheet(evidence), 0.0, 1.0)
    if use_intensity and head.is_enhanced:
        support = np.maximum(support, seen)  # fluid may be wide, but what enhances here is the falx
    by_place = _UNSEEN + (_SURE - _UNSEEN) * support + (1.0 - _SURE) * seen * support
    confidence = np.clip(above / _EDGE_MM, 0.3, 1.0) * by_place
    return Surfels.of("falx", place[kept], normal[kept], _THICKNESS_MM, confidence[kept], area[kept])


def _between_rims(head: Head, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """(z, y, x) bool: in the hull of the brain, or between two places of the same y and z that are.

    The hull dips into a wide fissure, over the falx in it; and more on the side of the smaller gyrus.
    """
    x = np.arange(-_RIM_MM, _RIM_MM + 1e-6, _STEP_MM)
    points = np.stack(np.meshgrid(z, y, x, indexing="ij")[::-1], axis=-1)
    values = head.at(head.from_atlas(points.reshape(-1, 3)), (head.depth > -1.0).astype(np.float32))
    inside = values.reshape(points.shape[:3]) > 0.5
    from_left = np.logical_or.accumulate(inside, axis=-1)
    from_right = np.logical_or.accumulate(inside[..., ::-1], axis=-1)[..., ::-1]
    return (from_left & from_right)[..., np.abs(x) < _X_MM + 0.5 * _STEP_MM]


def _distance_to_thick_white(head: Head) -> np.ndarray:
    """(k, j, i) float32 mm to white matter of at least 3 mm, 0 in it; far from the midsagittal plane 0.

    A falx that enhances faintly, and the rims of one that does brightly, are as bright as white matter, but thinner.
    """
    result = np.zeros(head.brain.shape, np.float32)
    x, _, _ = head.in_atlas
    box = ndimage.find_objects((np.abs(x) < _X_MM + _FARTHEST_MM).astype(np.uint8))[0]
    result[box] = np.maximum(distance_to(thick_white_matter(head, box), head.image.spacing_mm), 0.0)
    return result


def thick_white_matter(head: Head, box: tuple[slice, ...] = (slice(None),) * 3) -> np.ndarray:
    """(k, j, i) bool in a box of the head: white matter that is at least 3 mm thick."""
    spacing = head.image.spacing_mm
    inner = distance_to(~head.white_matter[box], spacing) > _THIN_MM
    return head.white_matter[box] & (distance_to(inner, spacing) <= _THIN_MM + _ROUNDING_MM)


def _sampled_evidence(
    head: Head, sampled: Callable[[np.ndarray], np.ndarray], beyond: np.ndarray
) -> np.ndarray:  # fmt: skip
    """(z, y, x) float32 evidence; `beyond` are mm (z, y, x) from the space between the rims of the hemispheres."""
    found = sampled(_evidence(head))
    if head.is_enhanced:
        return np.where(beyond <= _SINUS_MM, found, 0.0)  # marrow and scalp are bright as well
    # In wide fluid the falx is a brighter line, and the fluid on either side of it would draw it there.
    found = np.asarray(ndimage.grey_closing(found, (1, 1, round(_LINE_MM / _STEP_MM))))
    return np.where(beyond > 0.0, 1.0, found)  # bone and marrow do not show the falx


def _evidence(head: Head) -> np.ndarray:
    """(k, j, i) float32: share of fluid, or with contrast agent enhancement by that of white to grey matter, 0 to 2.

    Where the dura enhances, the fluid beside it is not evidence, since the falx is elsewhere.
    """
    if head.is_enhanced:
        return np.clip((head.image.array - head.white) / (head.white - head.grey), 0.0, 2.0)
    return head.fluid(head.image.array)
