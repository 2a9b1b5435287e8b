"""The elevational beam: the field of the lens, which is focused once, both ways, as tables for the kernels.

J. W. Goodman, Introduction to Fourier Optics, section 3.10 (docs/physics.md#the-lens).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from SlicerUSSim.Logic.opencl.layout import CONSTANTS

_DEPTHS, _DISTANCES = CONSTANTS["LOBE_DEPTHS"], CONSTANTS["LENS_DISTANCES"]
#: Points of the open aperture, and the fewest and most of the plane that waves run over
_OPEN, _LEAST_PLANE, _MOST_PLANE = 256, 2048, 16384
#: Frequencies of the band, by a Gauss-Hermite rule; the lowest re the centre
_FREQUENCIES, _LEAST_FREQUENCY = 7, 0.2
#: The main beam begins to fade where it has this part of the deviation of all of the power, and ends at so many times
#: that distance
_KEPT, _ENDS = 0.9, 1.06
#: Lobes are computed up to the larger of these: in wavelengths x f-number, and in wavelengths
_REACH_LOBES, _REACH_WAVELENGTHS = 5.0, 26.0


@dataclass(frozen=True)
class LensBeam:
    """The two-way beam in elevation, at LOBE_DEPTHS depths evenly from the face to the image depth."""

    #: (depths,) float32 sqrt(2) times the standard deviation of the power, mm: the amplitude's, were it a Gaussian
    sigma_mm: np.ndarray
    #: (depths, LENS_DISTANCES, 2) float32 of the main beam: square root of the power per mm, of unit sum over both
    #: sides, and by how many cycles its phase is behind that on the axis, at distances evenly from 0 to main_mm.max()
    main: np.ndarray
    #: (depths,) float32, where it is cut off
    main_mm: np.ndarray
    #: The same of what it leaves out, without phases, to lobes_mm.max()
    lobes: np.ndarray
    lobes_mm: np.ndarray


@lru_cache(maxsize=16)
def lens_beam(
    wavelength_mm: float, spread: float, aperture_mm: float, focus_mm: float, depth_mm: float, harmonic: bool
) -> LensBeam:
    """The beam of a uniform aperture with a lens.

    Power is the mean over the band of the pulse, phases are those of its centre frequency.

    Parameters
    ----------
    wavelength_mm : of what is received; of its second harmonic the square of a field of half the frequency is sent.
    spread : standard deviation of the amplitude's spectrum re the centre frequency.
    depth_mm : of the last row.
    """
    point = aperture_mm / _OPEN
    # What leaves the plane at one side returns at the other one: beams, with six lobes, must not be as wide. Beams
    # farther away than that are those there, as much wider.
    aside = 0.5 * aperture_mm / focus_mm + 6.0 * (2.0 if harmonic else 1.0) * wavelength_mm / aperture_mm
    needed = 2.0 * (aperture_mm + aside * depth_mm) / point
    plane = int(np.clip(2 ** np.ceil(np.log2(needed)), _LEAST_PLANE, _MOST_PLANE))
    depth = np.linspace(0.0, depth_mm, _DEPTHS)
    near = np.minimum(depth, max(0.5 * plane * point - aperture_mm, 0.1 * depth_mm) / aside)
    wider = np.where(near < depth, depth / np.maximum(near, 1e-6), 1.0)
    place, across = ((np.arange(_OPEN) + 0.5) / _OPEN - 0.5) * aperture_mm, np.fft.fftfreq(plane, point)

    def field(length: float) -> np.ndarray:
        face = np.fft.fft(np.exp(-1j * np.pi / (length * focus_mm) * place**2), plane)
        beam = np.fft.ifft(face * np.exp(-1j * np.pi * length * near[:, None] * across**2), axis=1)
        return beam[:, _OPEN // 2 : plane // 2 - _OPEN // 2]  # to one side of the axis

    power, cycles = np.zeros(1), np.zeros((1, 1))
    nodes, weights = np.polynomial.hermite.hermgauss(_FREQUENCIES)
    for node, weight in zip(nodes, weights, strict=True):
        length = wavelength_mm / max(1.0 + spread * node, _LEAST_FREQUENCY)
        received = field(length)
        beam = received * (field(2.0 * length) ** 2 if harmonic else received)
        # On the axis, in focus, the pulse has its spectrum, whatever the lens does to each frequency.
        power = power + weight * np.abs(beam) ** 2 * length ** (3.0 if harmonic else 2.0)
        if abs(node) < 1e-6:
            cycles = np.unwrap(np.angle(beam * beam[:, :1].conj()), axis=1) / (2.0 * np.pi)
    x = wider[:, None] * point * (np.arange(cycles.shape[1]) + 0.5)
    power /= 2.0 * point * wider[:, None] * power.sum(axis=1, keepdims=True)
    within, moments = np.cumsum(power, axis=1), np.cumsum(power * x**2, axis=1)
    sigma = np.sqrt(2.0 * moments[:, -1] / within[:, -1])
    row = np.arange(_DEPTHS)
    fades_mm = x[row, np.argmax(2.0 * moments >= (_KEPT * sigma[:, None]) ** 2 * within, axis=1)]
    main_mm = _to_columns(_ENDS * fades_mm)
    lobes_mm = _to_columns(
        np.maximum(_REACH_LOBES * wavelength_mm * depth / aperture_mm, _REACH_WAVELENGTHS * wavelength_mm)
    )
    fading = np.cos(0.5 * np.pi * np.clip((x / fades_mm[:, None] - 1.0) / (_ENDS - 1.0), 0.0, 1.0)) ** 2
    main, lobes = _columns(x, power * fading, main_mm), _columns(x, power * (1.0 - fading), lobes_mm)
    main /= 2.0 * (main.sum(axis=1, keepdims=True) - 0.5 * main[:, :1]) * main_mm.max() / (_DISTANCES - 1)
    at = np.linspace(0.0, main_mm.max(), _DISTANCES)
    turned = np.array([np.interp(at, *of) for of in zip(x, cycles, strict=True)])
    tables = np.stack([np.sqrt(main), turned], axis=-1), np.stack([np.sqrt(lobes), 0.0 * lobes], axis=-1)
    return LensBeam(*(part.astype(np.float32) for part in (sigma, tables[0], main_mm, tables[1], lobes_mm)))


def _to_columns(reach_mm: np.ndarray) -> np.ndarray:
    """The next column of a table to the largest reach: interpolated to zero there, a profile has no step."""
    step = reach_mm.max() / (_DISTANCES - 1)
    return step * np.ceil(reach_mm / step - 1e-6)


def _columns(x: np.ndarray, power: np.ndarray, reach_mm: np.ndarray) -> np.ndarray:
    """(depths, LENS_DISTANCES) mean power around distances evenly from 0 to the largest reach, 0 from each row's on."""
    at, step = np.linspace(0.0, reach_mm.max(), _DISTANCES, retstep=True)
    rows = []
    for places, values, reach in zip(x, power, reach_mm, strict=True):
        half = 0.5 * (places[1] - places[0])
        edges, sums = np.append(0.0, places + half), np.append(0.0, np.cumsum(values) * 2.0 * half)
        low, high = (np.interp(np.abs(at + side * step), edges, sums) for side in (-0.5, 0.5))
        low[0] *= -1.0
        rows.append((high - low) / step * (at < reach - 0.5 * step))
    return np.array(rows)
