"""The patient in a CT, without the couch, clothes and what else lies in the scanner."""

from __future__ import annotations

from typing import cast

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.volume import Volume

#: Size of the cells in which the patient is looked for; what is thinner than four of them is not: couch, tubes, clothes
CELL_MM = 2.5
#: Above: tissue, and not foam; below: air, and not lung
_TISSUE_HU, _AIR_HU = -250.0, -930.0
#: A part smaller than this share of the largest is no part of the patient
_LEAST_PART = 0.02
#: Share of air, from which on a space at the side of the image is outside; of lung that is cut by it 0.0
_OUTSIDE_AIR = 0.3
_LEAST_ML = 10.0
#: Lung and bowel are never as near to a couch
_GAP_MM = 8.0
#: Share of slices in which a couch is at the same place; how much of it is seen at least on either side of the patient,
#: and how far from a parabola
_SAME_IN_SLICES, _SEEN_MM, _MOST_OFF_MM = 0.8, 15.0, 1.5


def cells(ct: Volume) -> tuple[int, int, int]:
    """Voxels (k, j, i) of a cell."""
    k, j, i = (max(round(CELL_MM / size), 1) for size in ct.spacing_mm[::-1])
    return k, j, i


def pooled(array: np.ndarray, size: tuple[int, int, int], function: np.ufunc) -> np.ndarray:
    """(k, j, i) the result of np.maximum or the like over cells; those at the ends may have fewer voxels."""
    for axis, count in enumerate(size):
        if count > 1:
            array = function.reduceat(array, np.arange(0, array.shape[axis], count), axis=axis)
    return array


def spread(array: np.ndarray, size: tuple[int, int, int], shape: tuple[int, ...]) -> np.ndarray:
    """(k, j, i) of `shape`: the value of the cell of every voxel."""
    for axis, count in enumerate(size):
        array = np.repeat(array, count, axis=axis) if count > 1 else array
    return array[tuple(slice(0, n) for n in shape)]


def components(mask: np.ndarray, structure: np.ndarray | None = None) -> tuple[np.ndarray, int]:
    """(numbers of the connected parts from 1, how many)"""
    return cast(tuple[np.ndarray, int], ndimage.label(mask, structure))


def find_body(hu: np.ndarray, ct: Volume) -> tuple[np.ndarray | None, int]:
    """((k, j, i) bool, the patient with lungs and gas in it, in how many parts); (None, 0) if there is none.

    `hu` has Hounsfield units with sharp borders, on the grid of `ct`. Parts thinner than 1 cm are lost with the couch.
    """
    size = cells(ct)
    coarse = _mean_of_cells(hu, size)
    tissue = coarse > _TISSUE_HU
    core = _eroded(tissue, 2)
    core = ndimage.binary_dilation(core, _BALL, 2) & tissue  # pyright: ignore
    parts, count = components(core)
    if not count:
        return None, 0
    volumes = np.bincount(parts.ravel())[1:]
    cell_ml = float(np.prod(size)) * ct.voxel_ml
    if volumes.max() * cell_ml < _LEAST_ML:
        return None, 0
    kept = np.flatnonzero(volumes >= _LEAST_PART * volumes.max()) + 1
    body = np.isin(parts, kept)
    around = cast(np.ndarray, ndimage.binary_dilation(body, _BALL))
    filled = _filled(body, coarse, axis_of_slices(ct))
    deep = _eroded(filled, 1)  # cells at the outside are judged voxel by voxel
    inside = spread(around | filled, size, hu.shape) & (hu > _TISSUE_HU)
    inside |= spread(deep, size, hu.shape)
    _cut_couch(inside, hu, ct)
    return inside, len(kept)


def _cut_couch(inside: np.ndarray, hu: np.ndarray, ct: Volume) -> None:
    """Take out what is beyond the surface of a couch that touches the patient.

    A couch is the same in all slices. On both sides of the patient its surface is seen; a parabola through it goes on
    below.
    """
    axes = [2 - int(np.abs(ct.ijk_to_ras[row, :3] / ct.spacing_mm).argmax()) for row in (0, 1, 2)]
    if len(set(axes)) < 3:
        return
    across, vertical, along = axes
    beside = ((hu > _TISSUE_HU) & ~inside).mean(axis=along) > _SAME_IN_SLICES
    body = inside.any(axis=along)
    if vertical > across:  # both as (vertical, across)
        beside, body = beside.T, body.T
    patient = np.moveaxis(inside, (vertical, across), (0, 1))
    size, width = ct.spacing_mm[2 - vertical], ct.spacing_mm[2 - across]
    columns = np.flatnonzero(body.any(axis=0))
    rows = np.flatnonzero(body.T.any(axis=0))
    middle = columns.mean()
    for part, sign in ((slice(None), -1), (slice(None, None, -1), 1)):  # below the middle row, and above
        seen = beside[part][: len(beside) // 2 + 1][::-1]  # outwards from the middle
        at = np.flatnonzero(seen.any(axis=0))
        sides = [np.count_nonzero(at < middle) * width, np.count_nonzero(at > middle) * width]
        if min(sides) < _SEEN_MM or not len(rows):
            continue
        start = len(seen) - 1 - seen[:, at].argmax(axis=0)  # row of its surface, counted from this end
        surface = np.polynomial.Polynomial.fit(at, start, 2)
        off = np.abs(surface(at) - start) * size
        if np.median(off) > _MOST_OFF_MM:
            continue
        level = surface(np.arange(beside.shape[1]))
        row = np.arange(len(beside)) if sign < 0 else np.arange(len(beside))[::-1]
        patient[row[:, None] <= np.floor(level + 0.5)[None]] = False
        near = row[:, None] <= (level + _GAP_MM / size)[None]  # gaps between the skin and the couch
        values = np.moveaxis(hu, (vertical, across), (0, 1))
        patient[near] &= values[near] > _TISSUE_HU


_BALL = ndimage.generate_binary_structure(3, 2)


def _eroded(mask: np.ndarray, times: int) -> np.ndarray:
    """Eroded by cells; what is beyond the ends of the image counts as inside, so that a cut body stays whole."""
    return cast(np.ndarray, ndimage.binary_erosion(mask, _BALL, times, border_value=1))


def _mean_of_cells(hu: np.ndarray, size: tuple[int, int, int]) -> np.ndarray:
    sums = pooled(hu.astype(np.int32), size, np.add)
    counts = pooled(np.ones(hu.shape[:1], np.int32)[:, None, None], (size[0], 1, 1), np.add)
    for axis in (1, 2):
        shape = [1, 1, 1]
        shape[axis] = hu.shape[axis]
        one = [1, 1, 1]
        one[axis] = size[axis]
        counts = counts * pooled(np.ones(shape, np.int32), (one[0], one[1], one[2]), np.add)
    return (sums / counts).astype(np.float32)


def axis_of_slices(ct: Volume) -> int:
    """The axis (of k, j, i) nearest to that from the feet to the head: across it the body is one closed outline."""
    return 2 - int(np.abs(ct.ijk_to_ras[2, :3] / ct.spacing_mm).argmax())


def extend_into(hu: np.ndarray, padding: np.ndarray, axis: int) -> None:
    """Fill what lies outside of a round field of view (k, j, i) in every slice with the nearest number in it.

    So what the field cuts is no surface, as at the sides of an image; lung that it cut was air around the patient.
    """
    last, nearest = np.zeros(0, bool), ()
    for values, outside in zip(np.moveaxis(hu, axis, 0), np.moveaxis(padding, axis, 0), strict=True):
        if outside.any() and not outside.all():
            if not np.array_equal(outside, last):
                indices = ndimage.distance_transform_edt(outside, return_distances=False, return_indices=True)
                nearest, last = tuple(cast(np.ndarray, indices)[:, outside]), outside
            values[outside] = values[nearest]


def _filled(body: np.ndarray, coarse: np.ndarray, axis: int) -> np.ndarray:
    """The body with what it encloses in a slice, and with lung that the side of the image cuts."""
    result = body.copy()
    for inside, values, filled in zip(
        np.moveaxis(body, axis, 0), np.moveaxis(coarse, axis, 0), np.moveaxis(result, axis, 0), strict=True
    ):
        if not inside.any():
            continue
        around, count = components(~inside)
        if not count:
            continue
        sides = np.concatenate([around[0], around[-1], around[:, 0], around[:, -1]])
        is_air = ndimage.mean(values < _AIR_HU, around, np.arange(count + 1))
        is_outside = np.zeros(count + 1, bool)
        is_outside[np.unique(sides)] = True
        is_outside &= np.asarray(is_air) >= _OUTSIDE_AIR
        is_outside[0] = False
        filled |= ~is_outside[around] & ~inside
    return result
