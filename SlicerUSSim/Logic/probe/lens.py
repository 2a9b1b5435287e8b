"""The elevational beam: the field of the lens, which is focused once, both ways, as tables for the kernels.

J. W. Goodman, Introduction to Fourier Optics, section 3.10 (docs/physics.md#the-lens).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import fft

from SlicerUSSim.Logic.opencl.layout import CONSTANTS

_DEPTHS, _DISTANCES = CONSTANTS["LOBE_DEPTHS"], CONSTANTS["LENS_DISTANCES"]
#: Points of the open aperture, and the fewest and most of the plane that waves run over
_OPEN, _LEAST_PLANE, _MOST_PLANE = 256, 2048, 16384
#: Frequencies of the band, by a Gauss-Hermite rule; the lowest relative to the centre
_FREQUENCIES, _LEAST_FREQUENCY = 7, 0.2
#: The main beam begins to fade where it has this part of the deviation of all of the power, and ends at this multiple
#: of that distance
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

    Power is the mean over the band of the pulse, phases belong to its centre frequency.

    Parameters
    ----------
    wavelength_mm : of what is received; of its second harmonic the square of a field of half the frequency is sent.
    spread : standard deviation of the amplitude's spectrum relative to the centre frequency.
    depth_mm : of the last row.
    """
    point = aperture_mm / _OPEN
    # What leaves the plane at one side returns at the other one: beams, with six lobes, must not be as wide. Beams
    # farther away than that are those there, as much wider.
    aside = 0.5 * aperture_mm / focus_mm + 6.0 * (2.0 if harmonic else 1.0) * wavelength_mm / aperture_mm
    needed = 2.0 * (aperture_mm + aside * depth_mm) / point
    half = int(np.clip(2 ** np.ceil(np.log2(needed)), _LEAST_PLANE, _MOST_PLANE)) // 2
    depth = np.linspace(0.0, depth_mm, _DEPTHS)
    near = np.minimum(depth, max(half * point - aperture_mm, 0.1 * depth_mm) / aside)
    wider = np.where(near < depth, depth / np.maximum(near, 1e-6), 1.0)
    place = point * (np.arange(_OPEN // 2) + 0.5)
    square = ((np.arange(half) / (2 * half * point)) ** 2).astype(np.float32)  # of the frequencies across

    def field(length: float) -> np.ndarray:
        """(depths, distances) complex64 to one side of the axis, by cosines: all is even."""
        face = cosines(phasor(-np.pi / (length * focus_mm) * place**2), n=half)
        run = (-np.pi * length * near).astype(np.float32)
        return cosines(face * phasor(run[:, None] * square), kind=3)[:, : half - _OPEN]

    power, beam = np.zeros(1), np.zeros((1, 1))
    nodes, weights = np.polynomial.hermite.hermgauss(_FREQUENCIES)
    for node, weight in zip(nodes.tolist(), weights.tolist(), strict=True):
        length = wavelength_mm / max(1.0 + spread * node, _LEAST_FREQUENCY)
        received = field(length)
        sent = field(2.0 * length) if harmonic else received
        intensity = _square(received) * _square(sent) ** (2 if harmonic else 1)
        # On the axis, in focus, the pulse has its spectrum, whatever the lens does to each frequency.
        power = power + weight * length ** (3.0 if harmonic else 2.0) * intensity
        if abs(node) < 1e-6:
            beam = received * sent ** (2 if harmonic else 1)
    sample_mm, place = wider * point, np.arange(beam.shape[1]) + 0.5
    power = power / (2.0 * sample_mm * power.sum(axis=1, dtype=float))[:, None]
    within, moments = _sums(power), _sums(power * place**2)[:, 1:]
    far = _KEPT**2 * moments[:, -1:] / within[:, -1:]
    fades = np.argmax(moments >= far * within[:, 1:], axis=1)[:, None] + 0.5
    main_mm = _to_columns(_ENDS * fades[:, 0] * sample_mm)
    lobes_mm = _to_columns(
        np.maximum(_REACH_LOBES * wavelength_mm * depth / aperture_mm, _REACH_WAVELENGTHS * wavelength_mm)
    )
    needed = min(int(main_mm.max() / point) + 2, len(place))
    fading = np.cos(0.5 * np.pi * np.clip((place[:needed] / fades - 1.0) / (_ENDS - 1.0), 0.0, 1.0)) ** 2
    kept = within.copy()
    kept[:, 1 : needed + 1] = np.cumsum(power[:, :needed] * fading, axis=1)
    kept[:, needed + 1 :] = kept[:, needed : needed + 1]
    main, lobes = _columns(kept, sample_mm, main_mm), _columns(within - kept, sample_mm, lobes_mm)
    main /= 2.0 * (main.sum(axis=1, keepdims=True) - 0.5 * main[:, :1]) * main_mm.max() / (_DISTANCES - 1)
    cycles = np.unwrap(np.angle(beam[:, :needed] * beam[:, :1].conj()), axis=1) / (2.0 * np.pi)
    at = np.linspace(0.0, main_mm.max(), _DISTANCES)
    turned = np.array([np.interp(at / mm, place[:needed], of) for mm, of in zip(sample_mm, cycles, strict=True)])
    tables = np.stack([np.sqrt(main), turned], axis=-1), np.stack([np.sqrt(lobes), 0.0 * lobes], axis=-1)
    sigma = np.sqrt(2.0 * moments[:, -1] / within[:, -1]) * sample_mm
    return LensBeam(*(part.astype(np.float32) for part in (sigma, tables[0], main_mm, tables[1], lobes_mm)))


def cosines(values: np.ndarray, kind: int = 2, n: int | None = None) -> np.ndarray:
    """scipy's transform by cosines along the last axis, of `n` values with zeros behind those given."""
    return np.asarray(fft.dct(values, type=kind, n=n))


def phasor(phase: np.ndarray) -> np.ndarray:
    """complex64 exp(i phase); numpy's own takes twenty times as long."""
    angle = phase.astype(np.float32)
    return np.cos(angle) + np.complex64(1j) * np.sin(angle)


def _square(wave: np.ndarray) -> np.ndarray:
    return np.real(wave) ** 2 + np.imag(wave) ** 2


def _sums(values: np.ndarray) -> np.ndarray:
    """(rows, samples + 1) running sums of float (rows, samples), from 0 on."""
    sums = np.zeros((len(values), values.shape[1] + 1))
    np.cumsum(values, axis=1, out=sums[:, 1:])
    return sums


def _to_columns(reach_mm: np.ndarray) -> np.ndarray:
    """The next column of a table to the largest reach: interpolated to zero there, a profile has no step."""
    step = reach_mm.max() / (_DISTANCES - 1)
    return step * np.ceil(reach_mm / step - 1e-6)


def _columns(sums: np.ndarray, sample_mm: np.ndarray, reach_mm: np.ndarray) -> np.ndarray:
    """(depths, LENS_DISTANCES) mean power around distances evenly from 0 to the largest reach, 0 from each row's on.

    `sums` (depths, samples + 1) are _sums of the power per mm at samples (depths,) mm apart.
    """
    at, step = np.linspace(0.0, reach_mm.max(), _DISTANCES, retstep=True)
    edge = (np.arange(_DISTANCES + 1) - 0.5) * step / sample_mm[:, None]
    before = np.minimum(np.abs(edge).astype(int), sums.shape[1] - 2)
    low, high = (np.take_along_axis(sums, before + n, axis=1) for n in (0, 1))
    found = (low + np.minimum(np.abs(edge) - before, 1.0) * (high - low)) * sample_mm[:, None] / step
    found[:, 0] *= -1.0
    return np.diff(found, axis=1) * (at < reach_mm[:, None] - 0.5 * step)
