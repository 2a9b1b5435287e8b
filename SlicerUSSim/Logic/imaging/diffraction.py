"""What the diffraction pattern of a probe's apertures has beside the Gaussian main beam, as tables for the kernels.

J. W. Goodman, Introduction to Fourier Optics, sections 4.2 and 4.4 (docs/physics.md#side-lobes-and-ring-down).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy import fft
from scipy.ndimage import gaussian_filter1d
from scipy.special import erfc

from SlicerUSSim.Logic.opencl.layout import CONSTANTS
from SlicerUSSim.Logic.probe.beam import FWHM_PER_SIGMA, LEAST_F_NUMBER, MAIN_LOBE, apodized_pattern

if TYPE_CHECKING:
    from SlicerUSSim.Logic.probe.arrays import Probe

_DEPTHS, _DISTANCES, _STEP = (CONSTANTS[f"LOBE_{name}"] for name in ("DEPTHS", "DISTANCES", "STEP"))
_POINTS, _PADDED = 512, 4096  # of an aperture, and of its Fourier transform
_BEYOND_SIGMAS = 2.0  # what is closer to the axis belongs to the main beam
#: Variance by which side_lobes.cl widens lobes: of a node's lines and of the interpolation between nodes, in squared
#: distances of nodes (1/12 + 0.105), and of the table's mean over one lobe and its interpolation (1/12 + 0.75^2 / 12),
#: in squared wavelengths x f-number
_NODE_VARIANCE, _TABLE_VARIANCE = 0.188, 0.130
#: Steps of the deconvolution, its samples per distance of the table, and what it takes for no power
_SHARPENED, _FINER, _LEAST_POWER = 3, 8, 1e-9
#: Elevational lobes are computed up to the larger of these: in wavelengths x f-number, and in wavelengths
_REACH_LOBES, _REACH_WAVELENGTHS = 5.0, 26.0
#: Points of the elevational aperture for speckle_height_mm, and the fewest and most of the plane that waves run over
_OPEN, _LEAST_PLANE, _MOST_PLANE = 256, 2048, 16384


@dataclass(frozen=True)
class Lobes:
    """The lobes of a two-way beam, at LOBE_DEPTHS depths evenly from the face to the image depth.

    Amplitudes are square roots of the power per distance, on either side, re that of the main beam; the lateral power
    is averaged over one lobe, since it is sampled at intervals.
    """

    #: (depths, distances) float32, per wavelength x receive f-number at that depth; distances are LOBE_STEP of
    #: these apart
    lateral: np.ndarray
    #: (depths, distances) float32, per millimetre, at distances evenly from 0 to ...
    elevational: np.ndarray
    #: ... (depths,) float32 millimetres, where they are cut off
    reach_mm: np.ndarray


@lru_cache(maxsize=16)
def lobes_of(probe: Probe) -> Lobes:
    """The lobes of a probe's two-way beam at its centre frequency.

    The transmit aperture and the elements are uniform and focused once (with zones: once for each), the receive
    aperture has the weights 1 - a + a cos(pi x)^2 and is focused at every depth. The second harmonic is fed by the
    square of the field of the pulse, of twice the received wavelength. Compounded waves are in focus at every depth.
    The probe's clutter falls as 1 + cos(pi u / U) with the distance u up to the end U of the lateral table.
    """
    depth = probe.displayed_mm * np.maximum(np.arange(_DEPTHS), 0.5) / (_DEPTHS - 1)
    sigma = probe.beam_sigma_mm(depth)
    column = np.arange(_DISTANCES)

    unit = probe.wavelength_mm * np.maximum(probe.receive_f_number, depth / probe.aperture_mm)
    x, amplitude = _transmitted(probe, depth, unit)
    pattern = (amplitude * apodized_pattern(x / unit[:, None], probe.receive_apodization)) ** 2
    tails = _tails(x, pattern, sigma[0])
    place = column / (_DISTANCES - 1)
    clutter = 0.5 * probe.clutter_power / (_STEP * (_DISTANCES - 1)) * (1.0 + np.cos(np.pi * place))
    fading = 0.5 + 0.5 * np.cos(np.pi * np.clip(4.0 * place - 3.0, 0.0, 1.0))  # the table ends smoothly
    lateral = [
        _density(tail, _STEP * scale * column, scale) * scale * fading + clutter
        for tail, scale in zip(tails, unit, strict=True)
    ]

    lobe = probe.wavelength_mm * depth / probe.elevation_aperture_mm
    reach = np.maximum(_REACH_LOBES * lobe, _REACH_WAVELENGTHS * probe.wavelength_mm)
    lens = np.full(_DEPTHS, probe.elevation_aperture_mm), np.full(_DEPTHS, probe.elevation_focus_mm)
    x, received = _focused_once(probe.wavelength_mm, *lens, depth)
    sent = _focused_once(probe.wavelength_mm, *lens, depth, octaves=1)[1] ** 2 if probe.harmonic else received
    elevational = [
        _density(tail, step * column, step)
        for tail, step in zip(_tails(x, (sent * received) ** 2, sigma[1]), reach / (_DISTANCES - 1), strict=True)
    ]
    return Lobes(*(np.array(values, np.float32) for values in (np.sqrt(lateral), np.sqrt(elevational), reach)))


@lru_cache(maxsize=16)
def lateral_weights(probe: Probe) -> np.ndarray:
    """(depths, distances) float32, the lateral lobes as kernels/side_lobes.cl takes them.

    The kernel makes lobes wider: it applies them to lines, which have the main beam, averages these to nodes, and
    interpolates between nodes and between the table's distances. Where the beam is out of focus and lobes fall by 8 dB
    per millimetre, that adds 1 to 2 dB. So weights are such that lobes have the power of the pattern after it.
    """
    depth = probe.displayed_mm * np.maximum(np.arange(_DEPTHS), 0.5) / (_DEPTHS - 1)
    unit = probe.wavelength_mm * np.maximum(probe.receive_f_number, depth / probe.aperture_mm)
    apart = np.maximum(probe.line_distance_mm(depth) / unit, 1e-6)
    dense = -(-probe.scan_lines // CONSTANTS["LOBE_NODES"])
    node = apart * np.clip((1.0 / apart).astype(int), dense, probe.scan_lines)
    variance = 0.5 * (probe.beam_sigma_mm(depth)[0] / unit) ** 2 + _NODE_VARIANCE * node**2 + _TABLE_VARIANCE
    column = np.arange(_DISTANCES)
    place = column / (_DISTANCES - 1)
    clutter = 0.5 * probe.clutter_power / (_STEP * (_DISTANCES - 1)) * (1.0 + np.cos(np.pi * place))
    power = np.maximum(lobes_of(probe).lateral.astype(float) ** 2 - clutter, 0.0)
    fine = np.arange(_FINER * (_DISTANCES - 1) + 1) / _FINER
    rows = []
    for row, width in zip(power, np.sqrt(variance), strict=True):
        peak = int(row.argmax())  # nearer the axis is the main beam, which hides lobes
        wanted = np.exp(np.interp(np.maximum(fine, peak), column, np.log(row + _LEAST_POWER)))
        made = wanted
        for _ in range(_SHARPENED):
            made = made * wanted / gaussian_filter1d(made, width * _FINER / _STEP, mode="mirror")
        rows.append(np.where(column > peak, np.maximum(made[::_FINER] - _LEAST_POWER, 0.0), row))
    return np.sqrt(np.array(rows) + clutter).astype(np.float32)


@lru_cache(maxsize=16)
def speckle_height_mm(probe: Probe) -> np.ndarray:
    """(LOBE_DEPTHS,) float32 elevational sigma, in millimetres, of the beam without curved phase of the same speckle.

    At LOBE_DEPTHS depths evenly from the face to the image depth. Speckle d apart has the correlation
    exp(-d^2 / 4 sigma^2), here one half where that of the two-way field of the lens has one half. That field is found
    by its angular spectrum at the centre frequency (Goodman, section 3.10), so that its phase is right too
    (docs/physics.md#wavefront-curvature).
    """
    wavelength, focus = probe.wavelength_mm, probe.elevation_focus_mm
    aperture = min(probe.elevation_aperture_mm, focus / LEAST_F_NUMBER)
    point = aperture / _OPEN
    # What leaves the plane at one side returns at the other one: beams, with six lobes, must not be as wide. Far away
    # speckle has the same length at all depths, so that depths end there.
    aside = 0.5 * aperture / focus + 6.0 * (2.0 if probe.harmonic else 1.0) * wavelength / aperture
    needed = 2.0 * (aperture + aside * probe.displayed_mm) / point
    plane = int(np.clip(2 ** np.ceil(np.log2(needed)), _LEAST_PLANE, _MOST_PLANE))
    farthest = max(0.5 * plane * point - aperture, 0.0) / aside
    depth = np.minimum(np.linspace(0.0, probe.displayed_mm, _DEPTHS), farthest)
    place, frequency = ((np.arange(_OPEN) + 0.5) / _OPEN - 0.5) * aperture, np.fft.fftfreq(plane, point)

    def field(length: float) -> np.ndarray:
        face = fft.fft(np.exp(-1j * np.pi / (length * focus) * place**2), plane)
        return np.asarray(fft.ifft(face * np.exp(-1j * np.pi * length * depth[:, None] * frequency**2), axis=1))

    received = field(wavelength)
    sent = field(2.0 * wavelength) ** 2 if probe.harmonic else received
    power = np.abs(np.asarray(fft.fft(sent * received, axis=1))) ** 2
    correlation = np.abs(np.asarray(fft.ifft(power, axis=1)))[:, : plane // 2]
    correlation /= correlation[:, :1]
    beyond, row = np.argmax(correlation < 0.5, axis=1), np.arange(_DEPTHS)
    at, before = correlation[row, beyond], correlation[row, beyond - 1]
    half = point * (beyond - (0.5 - at) / (before - at))
    return (half / np.sqrt(4.0 * np.log(2.0))).astype(np.float32)


def _transmitted(probe: Probe, depth: np.ndarray, unit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """((depths, n) lateral distances in mm, from 0 on; amplitude there) of what is transmitted and has its harmonic.

    `unit` (depths,) is the wavelength x f-number of reception, in millimetres.
    """
    zones = np.array(probe.transmit_apertures())
    if len(zones) == 0:
        least, slope = probe.compounded_beam()
        own = np.maximum(least, slope * depth) * FWHM_PER_SIGMA / MAIN_LOBE
        x = np.outer(np.minimum(unit, own) * _POINTS / _PADDED, np.arange(_PADDED // 2))
        return x, np.abs(np.sinc(x / own[:, None]))  # each wave is plane, and so is its harmonic
    focus, aperture = zones[probe.zone_at(depth)].T
    x, amplitude = _focused_once(probe.wavelength_mm, aperture, focus, depth, octaves=int(probe.harmonic))
    return x, amplitude**2 if probe.harmonic else amplitude


def _focused_once(
    wavelength: float, aperture: np.ndarray, focus: np.ndarray, depth: np.ndarray, octaves: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """((depths, n) distances from the axis in mm, from 0 on; amplitude there) of a uniform aperture, by Fresnel.

    The field is that of a frequency `octaves` lower, at the distances of this wavelength; the others are (depths,). So
    near the face that points are too far apart, it is the shadow of the aperture: that of farther away, as much wider.
    """
    nearest = 1.0 / (1.0 / focus + 0.5 * _POINTS * wavelength / aperture**2)
    far = np.maximum(depth, nearest)
    wider = np.where(depth < nearest, (focus - depth) / (focus - nearest), 1.0)
    point = ((np.arange(_POINTS) + 0.5) / _POINTS - 0.5) * aperture[:, None]
    phase = np.pi / (2**octaves * wavelength) * (1.0 / far - 1.0 / focus)[:, None] * point**2
    field = np.asarray(fft.fft(np.exp(1j * phase).astype(np.complex64), 2**octaves * _PADDED, axis=1))
    field = field[:, : _PADDED // 2]
    step = wider * wavelength * far * _POINTS / (aperture * _PADDED)
    return step[:, None] * np.arange(_PADDED // 2), np.abs(field).astype(float)


def _tails(x: np.ndarray, pattern: np.ndarray, sigma: np.ndarray) -> list[Callable[[np.ndarray], np.ndarray]]:
    """For each depth a function of distances: by how much a pattern has more power beyond them than a Gaussian.

    `sigma` (depths,) is that of the Gaussian's amplitude. The excess falls with the distance, to 0; what is near the
    axis belongs to the main beam.
    """
    inside = np.cumsum(pattern, axis=1) - 0.5 * (pattern + pattern[:, :1])
    inside -= np.gradient(pattern, axis=1) / 12.0  # Euler and Maclaurin's correction of the sums
    beyond, density = 1.0 - inside / inside[:, -1:], pattern / inside[:, -1:]
    excess = beyond - erfc(x / sigma[:, None])
    # The last point before the nearest distance that counts moves there, along a cubic.
    nearest, row = _BEYOND_SIGMAS * sigma, np.arange(len(x))
    n = np.minimum((nearest / x[:, 1]).astype(int), x.shape[1] - 2)
    t, rise = nearest / x[:, 1] - n, beyond[row, n + 1] - beyond[row, n]
    bent = (1.0 - t) * (-density[row, n] - rise) + t * (density[row, n + 1] + rise)
    at_nearest = beyond[row, n] + t * rise + t * (1.0 - t) * bent
    x, excess[row, n] = x.copy(), at_nearest - erfc(_BEYOND_SIGMAS)
    x[row, n] = nearest
    excess = np.maximum.accumulate(np.maximum(excess, 0.0)[:, ::-1], axis=1)[:, ::-1]
    return [
        lambda at, of=of, power=power, least=least: np.interp(np.maximum(at, least), of, power)
        for of, power, least in zip(x, excess, nearest, strict=True)
    ]


def _density(tail: Callable[[np.ndarray], np.ndarray], at: np.ndarray, window: float) -> np.ndarray:
    """The power per millimetre on either side at distances `at`, averaged over a window."""
    return 0.5 * (tail(np.maximum(at - 0.5 * window, 0.0)) - tail(at + 0.5 * window)) / window
