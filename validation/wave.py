"""Two-dimensional waves as references for beams: propagation through a map of the speed of sound, and of a lens.

Split steps: the angular spectrum over a short distance at the reference speed, then the phase that the medium adds
(Hardin and Tappert, SIAM Review 15, 1973). The field of a lens is Huygens' sum over its aperture, with the distances as
they are and for several frequencies of the band. Waves at a rod are the exact series of cylindrical waves (Morse and
Ingard, Theoretical Acoustics, section 8.1). Independent of the simulator; only rods reflect.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.special import h1vp, hankel1, jvp

_DX_MM, _DZ_MM, _WIDTH = 0.1, 0.25, 512
_EDGE_MM = 3.0  # over which waves fade at the sides


#: Values at lateral positions and depths in a line's frame
Map = Callable[[np.ndarray, np.ndarray], np.ndarray]


def speckle_power(
    speed: Map | None, depths_mm: np.ndarray, *, nepers_per_mm: Map | None = None, **beam: float
) -> np.ndarray:
    """(depths,) mean power of speckle on a scan line: the integral of the transmitted times the received intensity.

    Parameters as in beam_fields.
    """
    _, transmitted, received = beam_intensities(speed, depths_mm, nepers_per_mm=nepers_per_mm, **beam)
    return (transmitted * received).sum(axis=1)


def beam_intensities(
    speed: Map | None,
    depths_mm: np.ndarray,
    **beam,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Intensities across a scan line: (lateral,) place in mm, (depths, lateral) transmitted and received.

    Parameters as in beam_fields.
    """
    x, transmitted, received = beam_fields(speed, depths_mm, **beam)
    return x, np.abs(transmitted) ** 2, np.abs(received) ** 2


def beam_fields(
    speed: Map | None,
    depths_mm: np.ndarray,
    *,
    frequency_mhz: float,
    aperture_mm: float,
    f_number: float,
    focus_mm: float,
    reference_m_s: float,
    steering_rad: float = 0.0,
    nepers_per_mm: Map | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Complex amplitudes across a scan line: (lateral,) place in mm, (depths, lateral) transmitted and received.

    `speed` gives metres per second at lateral positions and depths in the line's frame (mm, any one shape); None is a
    medium of the reference speed. `nepers_per_mm` is what amplitudes lose there, one way. The aperture transmits to
    `focus_mm` and receives focused at each depth, at `f_number` until it is fully open. It is flat, and its normal lies
    `steering_rad` from the line against the lateral
    axis; behind it is the reference speed. Continuous waves.
    """
    x = (np.arange(_WIDTH) - _WIDTH / 2) * _DX_MM
    k = 2e-3 * np.pi * frequency_mhz * 1e6 / reference_m_s  # radians per millimetre
    kx = 2.0 * np.pi * np.fft.fftfreq(_WIDTH, _DX_MM)
    step = np.exp(1j * (np.sqrt(np.maximum(k**2 - kx**2, 0.0)) - k) * _DZ_MM) * (np.abs(kx) < 0.8 * k)
    sides = np.exp(-((np.maximum(np.abs(x) - x[-1] + 2.0 * _EDGE_MM, 0.0) / _EDGE_MM) ** 2))
    sine, cosine = np.sin(steering_rad), np.cos(steering_rad)
    start = -np.ceil(0.5 * aperture_mm * abs(sine) / _DZ_MM) * _DZ_MM  # waves start behind all of the aperture
    away = np.array([focus_mm, *depths_mm])[:, None] - start
    open_mm = np.minimum(aperture_mm, np.r_[np.inf, depths_mm / f_number])[:, None]
    # Where the way from the start to the focus crosses the aperture: its part, and the place on the aperture
    crossed = (x * sine - start * cosine) / (away * cosine + x * sine)
    face = x * (1.0 - crossed) * cosine + (start + crossed * away) * sine
    # Over an element, the edge of the aperture is soft: so is the simulator's.
    waves = np.clip((0.5 * open_mm - np.abs(face)) / _DX_MM + 0.5, 0.0, 1.0)
    waves = waves * np.exp(-1j * k * (np.hypot(x, away) - away))
    ends = np.rint((np.asarray(depths_mm) - start) / _DZ_MM).astype(int)
    transmitted, received = np.zeros((2, len(ends), _WIDTH), complex)
    for n in range(ends.max()):
        waves = np.fft.ifft(np.fft.fft(waves, axis=1) * step, axis=1) * sides
        if speed is not None:
            depth = start + (n + 0.5) * _DZ_MM
            here = np.where(depth * cosine > x * sine, speed(x, np.full_like(x, depth)), reference_m_s)
            waves = waves * np.exp(1j * k * (reference_m_s / here - 1.0) * _DZ_MM)
        if nepers_per_mm is not None:
            waves = waves * np.exp(-nepers_per_mm(x, np.full_like(x, start + (n + 0.5) * _DZ_MM)) * _DZ_MM)
        for at in np.flatnonzero(ends == n + 1):
            transmitted[at], received[at] = waves[[0, at + 1]]
    return x, transmitted, received


def speckle_half_length(
    depth_mm: float,
    *,
    frequency_mhz: float,
    fractional_bandwidth: float,
    transmit_mm: tuple[float, float],
    receive_mm: tuple[float, float],
    speed_m_s: float = 1540.0,
) -> float:
    """Distance in mm across the beam over which the correlation of speckle falls to one half, at `depth_mm`.

    `transmit_mm` and `receive_mm` are (size, focus) of uniform apertures in that direction; pulses have this -6 dB
    two-way bandwidth. Speckle is the sum of the echoes of point scatterers that are everywhere.
    """
    half = 1.5 * max(transmit_mm[0], receive_mm[0])
    place = np.arange(-half, half, 0.05 * speed_m_s * 1e-3 / frequency_mhz)
    element = (np.arange(400) - 199.5) / 400.0
    power, sigma = np.zeros(2 * len(place)), fractional_bandwidth / np.sqrt(8.0 * np.log(2.0))
    for offset in np.linspace(-1.4, 1.4, 7):
        wave_number = 2e3 * np.pi * frequency_mhz * (1.0 + offset * sigma) / speed_m_s
        both = np.ones(len(place), complex)
        for size, focus in (transmit_mm, receive_mm):
            path = np.hypot(depth_mm, place[:, None] - size * element)
            late = path - np.hypot(focus, size * element)
            both *= (np.exp(1j * wave_number * late) / np.sqrt(path)).sum(axis=1)
        power += np.exp(-(offset**2)) * np.abs(np.fft.fft(both, 2 * len(place))) ** 2
    correlation = np.abs(np.fft.ifft(power))[: len(place)]
    beyond = int(np.argmax(correlation < 0.5 * correlation[0]))
    near = slice(beyond - 1, beyond + 1)
    return float(np.interp(-0.5 * correlation[0], -correlation[near], place[near] - place[0]))


#: (size, focus) of the transmit and the receive aperture, mm
Apertures = tuple[tuple[float, float], tuple[float, float]]


def past_rod(
    radius_mm: float, centre_mm: tuple[float, float], depth_mm: float, apertures: Apertures, frequency_mhz: float
) -> float:
    """Power of speckle at a depth on a scan line past a rigid rod, re none; `centre_mm` is (lateral, depth).

    The integral of the transmitted times the received intensity across the line, continuous waves.
    """
    place = np.arange(-10.0, 10.0, 0.05)
    plain, scattered = _at_rod(place, np.full_like(place, depth_mm), radius_mm, centre_mm, apertures, frequency_mhz)
    return float(np.sum(_both(plain + scattered)) / np.sum(_both(plain)))


def mirrored_by_rod(
    radius_mm: float, top_mm: float, away_mm: float, apertures: Apertures, frequency_mhz: float
) -> float:
    """Power of the speckle that a rigid rod on the axis mirrors, shown `away_mm` behind its surface, re no rod."""
    centre, reach = (0.0, top_mm + radius_mm), radius_mm + away_mm
    angle = np.linspace(-0.75, 0.75, 1201) * np.pi
    x, y = reach * np.sin(angle), centre[1] - reach * np.cos(angle)
    seen = y > 0.0
    _, mirrored = _at_rod(x[seen], y[seen], radius_mm, centre, apertures, frequency_mhz)
    place = np.arange(-10.0, 10.0, 0.05)
    depth = np.full_like(place, top_mm + away_mm)
    plain, _ = _at_rod(place, depth, 1e-3, (50.0, 0.0), apertures, frequency_mhz)
    return float(np.sum(_both(mirrored)) * reach * (angle[1] - angle[0]) / (np.sum(_both(plain)) * 0.05))


def _both(fields: np.ndarray) -> np.ndarray:
    return np.abs(fields[0] * fields[1]) ** 2


def _at_rod(
    x: np.ndarray, y: np.ndarray, radius_mm: float, centre_mm: tuple[float, float], apertures: Apertures,
    frequency_mhz: float, speed_m_s: float = 1540.0,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """((2, places) transmitted and received fields without the rod; what the rod adds), of points 0.45 waves apart."""
    k = 2e3 * np.pi * frequency_mhz / speed_m_s
    half = 0.5 * max(size for size, _ in apertures)
    point = np.arange(-half, half, 0.9 * np.pi / k)
    weights = np.stack(
        [(abs(point) <= 0.5 * size) * np.exp(-1j * k * np.hypot(point, focus)) for size, focus in apertures], axis=1
    )
    plain = hankel1(0, k * np.hypot(x[:, None] - point, y[:, None])) @ weights
    order = np.arange(-int(k * radius_mm + 25), int(k * radius_mm + 26))
    waves = []  # about the rod: of every order at every point of the aperture and every place
    for aside, below in ((point - centre_mm[0], 0.0 * point - centre_mm[1]), (x - centre_mm[0], y - centre_mm[1])):
        waves.append((hankel1(order, k * np.hypot(aside, below)[:, None]), np.arctan2(below, aside)[:, None]))
    sent = (waves[0][0] * np.exp(-1j * order * waves[0][1])).T @ weights
    strength = jvp(order, k * radius_mm) / h1vp(order, k * radius_mm)
    added = -(waves[1][0] * np.exp(1j * order * waves[1][1]) * strength) @ sent
    return plain.T, added.T
