"""What the diffraction pattern of a probe's apertures has beside the Gaussian main beam, as tables for the kernels.

J. W. Goodman, Introduction to Fourier Optics, sections 4.2 and 4.4 (docs/physics.md#side-lobes-and-ring-down).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy import fft
from scipy.special import erfc

from SlicerUSSim.Logic.opencl.layout import CONSTANTS
from SlicerUSSim.Logic.probe.arrays import apodized_pattern

if TYPE_CHECKING:
    from SlicerUSSim.Logic.probe.arrays import Probe

_DEPTHS, _DISTANCES, _STEP = (CONSTANTS[f"LOBE_{name}"] for name in ("DEPTHS", "DISTANCES", "STEP"))
_POINTS, _PADDED = 512, 4096  # of an aperture, and of its Fourier transform
_BEYOND_SIGMAS = 2.0  # what is closer to the axis belongs to the main beam
#: Elevational lobes are computed up to the larger of these: in wavelengths x f-number, and in wavelengths
_REACH_LOBES, _REACH_WAVELENGTHS = 5.0, 26.0


@dataclass(frozen=True)
class Lobes:
    """The lobes of a two-way beam, at LOBE_DEPTHS depths evenly from the face to the image depth.

    Amplitudes are square roots of the power per distance, on either side, re that of the main beam, averaged over one
    lobe.
    """

    #: (depths, distances) float32, per wavelength x receive f-number at that depth; distances are LOBE_STEP of
    #: these apart
    lateral: np.ndarray
    #: (depths,) float32 power of all lateral lobes
    lateral_power: np.ndarray
    #: (depths, distances) float32, per millimetre, at distances evenly from 0 to ...
    elevational: np.ndarray
    #: ... (depths,) float32 millimetres, where they are cut off
    reach_mm: np.ndarray


@lru_cache(maxsize=16)
def lobes_of(probe: Probe) -> Lobes:
    """The lobes of a probe's two-way beam at its centre frequency.

    The transmit aperture and the elements are uniform and focused once, the receive aperture has the weights
    1 - a + a cos(pi x)^2 and is focused at every depth. The probe's clutter is spread evenly over the lateral table.
    """
    depth = probe.depth_mm * np.maximum(np.arange(_DEPTHS), 0.5) / (_DEPTHS - 1)
    sigma = probe.beam_sigma_mm(depth)
    column = np.arange(_DISTANCES)

    unit = probe.wavelength_mm * np.maximum(probe.receive_f_number, depth / probe.aperture_mm)
    x, amplitude = _focused_once(probe.wavelength_mm, probe.aperture_mm, probe.focus_mm, depth)
    pattern = (amplitude * apodized_pattern(x / unit[:, None], probe.receive_apodization)) ** 2
    tails = _tails(x, pattern, sigma[0])
    clutter = 10.0 ** (probe.clutter_db / 10.0)
    lateral = [
        _density(*row, _STEP * scale * column, scale) * scale + 0.5 * clutter / (_STEP * (_DISTANCES - 1))
        for row, scale in zip(tails, unit, strict=True)
    ]

    lobe = probe.wavelength_mm * depth / probe.elevation_aperture_mm
    reach = np.maximum(_REACH_LOBES * lobe, _REACH_WAVELENGTHS * probe.wavelength_mm)
    x, amplitude = _focused_once(probe.wavelength_mm, probe.elevation_aperture_mm, probe.elevation_focus_mm, depth)
    elevational = [
        _density(*row, far / (_DISTANCES - 1) * column, max(wide, far / (_DISTANCES - 1)))
        for row, far, wide in zip(_tails(x, amplitude**4, sigma[1]), reach, lobe, strict=True)
    ]
    power = [clutter + float(row[1][0]) for row in tails]
    return Lobes(*(np.array(values, np.float32) for values in (np.sqrt(lateral), power, np.sqrt(elevational), reach)))


def _focused_once(wavelength: float, aperture: float, focus: float, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """((depths, n) distances from the axis in mm, from 0 on; amplitude there) of a uniform aperture, by Fresnel."""
    point = ((np.arange(_POINTS) + 0.5) / _POINTS - 0.5) * aperture
    phase = np.pi / wavelength * np.outer(1.0 / depth - 1.0 / focus, point**2)
    field = fft.fft(np.exp(1j * phase).astype(np.complex64), _PADDED, axis=1)[:, : _PADDED // 2]
    step = wavelength * depth * _POINTS / (aperture * _PADDED)
    return step[:, None] * np.arange(_PADDED // 2), np.abs(field).astype(float)


def _tails(x: np.ndarray, pattern: np.ndarray, sigma: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """For each depth distances, and by how much the power of a pattern beyond them exceeds that of a Gaussian.

    `sigma` (depths,) is that of the Gaussian's amplitude. The excess falls with the distance, to 0.
    """
    inside = np.cumsum(pattern, axis=1) - 0.5 * (pattern + pattern[:, :1])
    excess = 1.0 - inside / inside[:, -1:] - erfc(x / sigma[:, None])
    excess[x < _BEYOND_SIGMAS * sigma[:, None]] = 0.0
    excess = np.maximum.accumulate(np.maximum(excess, 0.0)[:, ::-1], axis=1)[:, ::-1]
    return list(zip(x, excess, strict=True))


def _density(x: np.ndarray, tail: np.ndarray, at: np.ndarray, window: float) -> np.ndarray:
    """The power per millimetre on either side at distances `at`, averaged over a window."""
    inner, outer = np.maximum(at - 0.5 * window, 0.0), at + 0.5 * window
    return 0.5 * (np.interp(inner, x, tail) - np.interp(outer, x, tail)) / window
