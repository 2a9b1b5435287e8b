"""Partial volumes of a CT: the part of a voxel on a border that the tissue beside it fills."""

from __future__ import annotations

import numpy as np

#: The part of the range between two tissues in which a number tells a share, as in texture.volume_shares; a step is
#: clear from this many deviations of the noise on
_INNER_RANGE, _CLEAR = 0.7, 5.0


def border_shares(
    labels: np.ndarray, filtered: np.ndarray, sharp: np.ndarray, noise: float
) -> tuple[np.ndarray, np.ndarray]:
    """((k, j, i) uint8 label of the other tissue in every voxel, float32 part that it fills, 0 to 1/2).

    A voxel beside another label, whose filtered number lies between the numbers that both have beyond the border (the
    sharpened ones), is filled in that proportion. Of several neighbours the one across the largest step counts.
    """
    second, share = np.zeros(labels.shape, np.uint8), np.zeros(labels.shape, np.float32)
    step = np.zeros(labels.shape, np.int16)
    for axis in range(3):
        for towards in (1, -1):
            here, there = (_side(axis, towards * sign) for sign in (1, -1))
            differs = labels[here] != labels[there]
            rise = sharp[there] - sharp[here]
            larger = differs & (np.abs(rise) > np.abs(step[here])) & (np.abs(rise) > _CLEAR * noise)
            np.copyto(step[here], rise, where=larger)
            np.copyto(second[here], labels[there], where=larger)
    on_border = step != 0
    part = (filtered[on_border].astype(np.float32) - sharp[on_border]) / step[on_border]
    share[on_border] = np.clip((part - 0.5) / _INNER_RANGE + 0.5, 0.0, 0.5)
    return second, share


def _side(axis: int, sign: int) -> tuple[slice, ...]:
    parts = [slice(None)] * 3
    parts[axis] = slice(None, -1) if sign > 0 else slice(1, None)
    return tuple(parts)
