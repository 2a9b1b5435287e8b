"""Smooth sheets as heights above a surface: settled on the ridge of a relief by ever narrower windows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

#: Of the relief by which a place counts e times as much as another
_SOFTNESS = 0.6


def settled(
    relief: np.ndarray,
    offsets: np.ndarray,
    usable: np.ndarray,
    windows_mm: Sequence[float],
    smoothings: Sequence[float],
    softness: float = _SOFTNESS,
) -> tuple[np.ndarray, np.ndarray]:
    """((rows, columns) height in mm, confidence from 0 to 1 by how much the relief stands out there).

    Parameters
    ----------
    relief : (rows, columns, offsets) float32, larger where the sheet is more likely.
    offsets : (offsets,) mm, even steps.
    usable : (rows, columns, offsets) bool: where the relief says anything.
    windows_mm : around the height before, one per step, from wide to narrow.
    smoothings : standard deviations in rows and columns by which the heights of each step are smoothed; places where
        the relief stands out count more.
    """
    height = np.zeros(relief.shape[:2], np.float32)
    sure = np.zeros_like(height)
    for window, smoothing in zip(windows_mm, smoothings, strict=True):
        middle, sure = centred(relief, offsets, usable, height, window, softness)
        amount = ndimage.gaussian_filter(sure, smoothing, mode="nearest")
        smooth = ndimage.gaussian_filter(sure * middle, smoothing, mode="nearest") / np.maximum(amount, 1e-9)
        height = np.where(amount > 1e-6, smooth, height).astype(np.float32)
    return height, sure


def centred(
    relief: np.ndarray,
    offsets: np.ndarray,
    usable: np.ndarray,
    height: np.ndarray,
    window_mm: float,
    softness: float = _SOFTNESS,
) -> tuple[np.ndarray, np.ndarray]:
    """((rows, columns) middle in mm of the ridge of a relief within a window around heights, confidence from 0 to 1).

    The confidence tells how narrow the ridge is for the window; of a uniform relief it is 0.02, so that its middle,
    the height before, hardly counts. Arrays are as in `settled`.
    """
    step = float(offsets[1] - offsets[0])
    # The windows' ends lie between steps: on a plateau of the relief, whole steps would pull to one side
    share = np.clip((window_mm - np.abs(offsets - height[..., None])) / step + 0.5, 0.0, 1.0)
    near = usable & (share > 0.0)
    top = np.where(near, relief, -np.inf).max(axis=2, keepdims=True)
    weight = np.where(near, share * np.exp((relief - np.where(np.isfinite(top), top, 0.0)) / softness), 0.0)
    total = np.maximum(weight.sum(axis=2), 1e-9)
    middle = (weight * offsets).sum(axis=2) / total
    spread = np.sqrt((weight * (offsets - middle[..., None]) ** 2).sum(axis=2) / total)
    # A uniform relief has the spread of the window.
    sure = np.where(near.any(axis=2), np.clip(1.0 - spread / (window_mm / np.sqrt(3.0)), 0.02, 1.0), 0.0)
    return middle, sure.astype(np.float32)


def patches(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """((rows, columns, 3) unit normals, (rows, columns) areas) of a surface given by (rows, columns, 3) points."""
    along, across = np.gradient(corners, axis=0), np.gradient(corners, axis=1)
    normal = np.cross(along, across)
    area = np.linalg.norm(normal, axis=-1)
    return normal / np.maximum(area, 1e-9)[..., None], area
