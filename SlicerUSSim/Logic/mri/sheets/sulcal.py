"""Sulci as the ridge of distance to white matter and of darkness: found where they are closed, too."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from SlicerUSSim.Logic.base.neighbourhood import distance_to
from SlicerUSSim.Logic.mri.sheets.head import Head
from SlicerUSSim.Logic.mri.sheets.regions import hindbrain
from SlicerUSSim.Logic.mri.sheets.ridges import Ridges, large_parts, ridges
from SlicerUSSim.Logic.tissue.surfels import Surfels

#: The distance counts up to this, and darkness as much as this distance, mm
_FARTHEST_MM, _DARK_MM = 7.0, 4.0
_SIGMA_MM, _LEAST_STRENGTH = 0.65, 0.35
#: Distance to white matter, depth below the hull of the brain, and area of connected parts from which on it is a sulcus
_LEAST_DISTANCE_MM, _LEAST_DEPTH_MM, _LEAST_MM2 = 1.2, 1.5, 40.0
#: A dip is the intensity between two places at this distance along the normal and that at the middle, in deviations of
#: the noise; the mean of this many neighbours counts
_FLANK_MM, _NEIGHBOURS, _LEAST_DIP = 2.0, 24, 1.5
#: Sulci of this dip are sure to 63 %: fitted to the share that a T2 confirms beyond chance, see docs/sheets.md
_SURE_DIP = 2.8
#: Profiles across sulci from which their width is taken, mm, and the least: two layers of pia mater
_REACH_MM, _STEP_MM, _THINNEST_MM = 3.0, 0.5, 0.2
#: Tumours and vessels are brighter than white matter by this many deviations of the noise
_BRIGHT = 3.0


def sulci(head: Head, ventricles: np.ndarray) -> Surfels:
    """Surfels on the middles of sulci: ridges of min(D, 7 mm) + 4 mm fluid, where D is the distance to white matter.

    None in and beside the `ventricles` (k, j, i), and none below the tentorium. Without an atlas, as of a part of a
    brain, darkness alone counts: the distance to white matter is not that of the whole, and a lesion may fill most of
    it.
    """
    is_whole = head.registered is not None
    relief = _DARK_MM * head.fluid(head.image.array)
    if is_whole:
        relief += np.minimum(head.white_distance, _FARTHEST_MM)
    near_ventricle = distance_to(ventricles, head.image.spacing_mm) < 2.0
    where = (
        (head.depth > _LEAST_DEPTH_MM)
        & ((head.white_distance > _LEAST_DISTANCE_MM) | (not is_whole))
        & (head.image.array < head.white + _BRIGHT * head.noise)
        & ~hindbrain(head)
        & ~near_ventricle
    )
    found = ridges(relief, head.spacing, where, _SIGMA_MM, _LEAST_STRENGTH)
    found = large_parts(found, where.shape, _LEAST_MM2)
    return described(head, found)


def described(head: Head, found: Ridges) -> Surfels:
    """Points as surfels with width and confidence; without those that no dip of the intensity supports."""
    place = head.to_ras(found.place)
    turn = head.image.ijk_to_ras[:3, :3] / head.image.spacing_mm
    normal = found.normal[:, ::-1] @ turn.T
    dip = dips(head, place, normal)
    dip = smoothed_over_neighbours(place, dip)
    kept = dip > _LEAST_DIP
    place, normal, dip = place[kept], normal[kept], dip[kept]
    confidence = 1.0 - np.exp(-dip / _SURE_DIP)
    return Surfels.of("sulcus", place, normal, widths(head, place, normal), confidence, found.area[kept])


def dips(head: Head, place: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(n,) by how much it is darker than beside, in deviations of the noise; white matter beside counts as grey."""
    sides = [np.minimum(head.at(place + side * _FLANK_MM * normal), head.grey) for side in (-1.0, 1.0)]
    return (0.5 * (sides[0] + sides[1]) - head.at(place)) / head.noise


def smoothed_over_neighbours(place: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(n,) means over the nearest surfels."""
    count = min(_NEIGHBOURS, len(place))
    if count < 2:
        return values
    _, nearest = KDTree(place).query(place, count, workers=-1)
    return values[nearest].mean(axis=1)


def widths(head: Head, place: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(n,) mm of fluid along the normal through the middle, as far as it goes on without tissue between."""
    total = head.fluid(head.at(place)) * _STEP_MM
    for side in (-1.0, 1.0):
        before = head.fluid(head.at(place))
        for step in np.arange(_STEP_MM, _REACH_MM + 1e-6, _STEP_MM):
            # A second sulcus beside is another: the fluid never grows again.
            before = np.minimum(before, head.fluid(head.at(place + side * step * normal)))
            total = total + before * _STEP_MM
    return np.maximum(total, _THINNEST_MM)
