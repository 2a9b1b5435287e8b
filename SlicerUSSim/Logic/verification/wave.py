"""Two-dimensional wave propagation through a map of the speed of sound, as a reference for beams in tissue.

Split steps: the angular spectrum over a short distance at the reference speed, then the phase that the medium adds
(Hardin and Tappert, SIAM Review 15, 1973). Independent of the simulator; there are no reflections.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

_DX_MM, _DZ_MM, _WIDTH = 0.1, 0.25, 512
_EDGE_MM = 3.0  # over which waves fade at the sides


def speckle_power(
    speed: Callable[[np.ndarray, np.ndarray], np.ndarray] | None,
    depths_mm: np.ndarray,
    *,
    frequency_mhz: float,
    aperture_mm: float,
    f_number: float,
    focus_mm: float,
    reference_m_s: float,
) -> np.ndarray:
    """(depths,) mean power of speckle on a scan line: the integral of the transmitted times the received intensity.

    `speed` gives metres per second at lateral positions and depths in the line's frame (mm, any one shape); None is a
    medium of the reference speed. The aperture transmits to `focus_mm` and receives focused at each depth, at
    `f_number` until it is fully open. Continuous waves.
    """
    x = (np.arange(_WIDTH) - _WIDTH / 2) * _DX_MM
    k = 2e-3 * np.pi * frequency_mhz * 1e6 / reference_m_s  # radians per millimetre
    kx = 2.0 * np.pi * np.fft.fftfreq(_WIDTH, _DX_MM)
    step = np.exp(1j * (np.sqrt(np.maximum(k**2 - kx**2, 0.0)) - k) * _DZ_MM) * (np.abs(kx) < 0.8 * k)
    sides = np.exp(-((np.maximum(np.abs(x) - x[-1] + 2.0 * _EDGE_MM, 0.0) / _EDGE_MM) ** 2))
    foci = np.array([focus_mm, *depths_mm])[:, None]
    open_mm = np.minimum(aperture_mm, np.r_[np.inf, depths_mm / f_number])[:, None]
    # Over an element, the edge of the aperture is soft: so is that of the simulator's.
    waves = np.clip((0.5 * open_mm - np.abs(x)) / _DX_MM + 0.5, 0.0, 1.0)
    waves = waves * np.exp(-1j * k * (np.hypot(x, foci) - foci))
    ends = np.rint(np.asarray(depths_mm) / _DZ_MM).astype(int)
    powers = np.zeros(len(ends))
    for n in range(ends.max()):
        waves = np.fft.ifft(np.fft.fft(waves, axis=1) * step, axis=1) * sides
        if speed is not None:
            here = speed(x, np.full_like(x, (n + 0.5) * _DZ_MM))
            waves = waves * np.exp(1j * k * (reference_m_s / here - 1.0) * _DZ_MM)
        for at in np.flatnonzero(ends == n + 1):
            powers[at] = np.sum(np.abs(waves[0]) ** 2 * np.abs(waves[at + 1]) ** 2)
    return powers
