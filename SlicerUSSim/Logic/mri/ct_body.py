"""The patient in a CT, without the couch, clothes and what else lies in the scanner."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.volume import Volume

#: Size of the cells in which the search for the patient works; it ignores parts thinner than four cells: couch, tubes
CELL_MM = 2.5
#: Above: tissue, and not foam; below: air, and not lung
_TISSUE_HU, _AIR_HU = -250.0, -930.0
#: A part smaller than this share of the largest is not part of the patient
_LEAST_PART = 0.02
#: Least share of air of a space at the side of the image that is outside; of lung that is cut by it 0.0
_OUTSIDE_AIR = 0.3
#: Share of slices in which a couch is at the same place; how much of it is seen at least on either side of the patient,
#: and how far from a parabola
_SAME_IN_SLICES, _SEEN_MM, _MOST_OFF_MM = 0.8, 15.0, 1.5
_BALL = ndimage.generate_binary_structure(3, 2)


def cells(ct: Volume) -> list[int]:
    """Voxels along k, j, i of a cell."""
    return [max(round(CELL_MM / size), 1) for size in ct.spacing_mm[::-1]]


def pooled(array: np.ndarray, size: list[int], function: np.ufunc) -> np.ndarray:
    """(k, j, i) the result of np.maximum or the like over cells; those at the ends may have fewer voxels."""
    for axis, count in enumerate(size):
        array = function.reduceat(array, np.arange(0, array.shape[axis], count), axis=axis)
    return array


def spread(array: np.ndarray, size: list[int], shape: tuple[int, ...]) -> np.ndarray:
    """(k, j, i) of `shape`: the value of the cell of every voxel."""
    for axis, count in enumerate(size):
        array = np.repeat(array, count, axis=axis)
    return array[tuple(slice(0, n) for n in shape)]


def find_body(hu: np.ndarray, ct: Volume) -> np.ndarray:
    """(k, j, i) bool, the patient with lungs and gas in it; parts thinner than 1 cm are lost with the couch.

    `hu` has Hounsfield units with sharp borders, on the grid of `ct`, which is stored along R, A and S.
    """
    size = cells(ct)
    coarse = pooled(hu.astype(np.int32), size, np.add) / pooled(np.ones(hu.shape, np.int32), size, np.add)
    tissue = coarse > _TISSUE_HU
    core = ndimage.binary_dilation(_eroded(tissue, 2), _BALL, 2) & tissue  # pyright: ignore
    parts: Any = ndimage.label(core)[0]  # pyright: ignore
    volumes = np.bincount(parts.ravel(), minlength=2)[1:]
    body = np.isin(parts, np.flatnonzero(volumes >= _LEAST_PART * volumes.max()) + 1)
    around = cast(np.ndarray, ndimage.binary_dilation(body, _BALL))
    for inside, values in zip(body, coarse, strict=True):  # what it encloses in a slice, and lung that a side cuts
        spaces: Any = ndimage.label(~inside)[0]  # pyright: ignore
        sides = np.unique(np.concatenate([spaces[0], spaces[-1], spaces[:, 0], spaces[:, -1]]))
        outside = [n for n in sides if n and np.mean(values[spaces == n] < _AIR_HU) >= _OUTSIDE_AIR]
        if inside.any():
            inside |= ~np.isin(spaces, outside)
    # Cells at the outside are judged voxel by voxel
    inside = spread(around | body, size, hu.shape) & (hu > _TISSUE_HU) | spread(_eroded(body, 1), size, hu.shape)
    for flipped in (slice(None), slice(None, None, -1)):  # supine and prone
        _cut_couch(inside[:, flipped], hu[:, flipped], ct)
    return inside


def _eroded(mask: np.ndarray, times: int) -> np.ndarray:
    """Eroded by cells; space beyond the ends of the image counts as inside, so that a cut body stays whole."""
    return cast(np.ndarray, ndimage.binary_erosion(mask, _BALL, times, border_value=1))


def _cut_couch(inside: np.ndarray, hu: np.ndarray, ct: Volume) -> None:
    """Remove everything beyond the surface of a couch that touches the patient at the first rows.

    A couch is the same in all slices. On both sides of the patient its surface is seen; a parabola through it continues
    below.
    """
    couch = ((hu > _TISSUE_HU) & ~inside).mean(axis=0) > _SAME_IN_SLICES
    couch[len(couch) // 2 :] = False
    at, patient = np.flatnonzero(couch.any(axis=0)), np.flatnonzero(inside.any(axis=(0, 1)))
    width, height, _ = ct.spacing_mm
    if not len(patient) or min(np.sum(at < patient.mean()), np.sum(at > patient.mean())) * width < _SEEN_MM:
        return
    top = len(couch) - 1 - couch[::-1, at].argmax(axis=0)
    surface = np.polynomial.Polynomial.fit(at, top, 2)
    if np.median(np.abs(surface(at) - top)) * height > _MOST_OFF_MM:
        return
    above = np.arange(len(couch))[:, None] - surface(np.arange(couch.shape[1]))
    inside[:, above <= 0.5] = False
