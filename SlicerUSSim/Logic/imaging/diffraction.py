"""What the diffraction pattern of a probe's apertures has beside the Gaussian main beam, as tables for the kernels.

J. W. Goodman, Introduction to Fourier Optics, sections 4.2 and 4.4 (docs/physics.md#side-lobes-and-ring-down).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy import fft
from scipy.ndimage import gaussian_filter1d
from scipy.special import erfc

from SlicerUSSim.Logic.opencl.layout import CONSTANTS
from SlicerUSSim.Logic.probe.beam import FWHM_PER_SIGMA, MAIN_LOBE, apodized_pattern

if TYPE_CHECKING:
    from SlicerUSSim.Logic.probe.arrays import Probe

_DEPTHS, _DISTANCES, _STEP = (CONSTANTS[f"LOBE_{name}"] for name in ("DEPTHS", "DISTANCES", "STEP"))
_POINTS, _PADDED = 512, 4096  # of an aperture, and of its Fourier transform
_PLANE_POINTS, _PLANE_FREQUENCIES = 256, 9  # of both apertures, and of the pulse, for the echoes of planes
_LEAST_PLANE = 1e-4  # of these, re a square plane
_BEYOND_SIGMAS = 2.0  # what is closer to the axis belongs to the main beam
#: Variance by which side_lobes.cl widens lobes: of a node's lines and of the interpolation between nodes, in squared
#: distances of nodes (1/12 + 0.105), and of the table's mean over one lobe and its interpolation (1/12 + 0.75^2 / 12),
#: in squared wavelengths x f-number
_NODE_VARIANCE, _TABLE_VARIANCE = 0.188, 0.130
#: Steps of the deconvolution, its samples per distance of the table, and what it takes for no power
_SHARPENED, _FINER, _LEAST_POWER = 3, 8, 1e-9


@lru_cache(maxsize=16)
def lobes_of(probe: Probe) -> np.ndarray:
    """(depths, distances) float32, the lateral lobes of a probe's two-way beam at its centre frequency.

    At LOBE_DEPTHS depths evenly from the face to the image depth, and distances LOBE_STEP wavelengths times receive
    f-number at that depth apart: square roots of the power per such distance, averaged over one lobe, since it is
    sampled at intervals, on either side, re that of the main beam.

    The transmit aperture is uniform and focused once (with zones: once for each), the receive
    aperture has the weights 1 - a + a cos(pi x)^2 and is focused at every depth. The second harmonic is fed by the
    square of the field of the pulse, of twice the received wavelength. Compounded waves are in focus at every depth.
    The probe's clutter falls as 1 + cos(pi u / U) with the distance u up to the end U of the lateral table.
    """
    depth = probe.displayed_mm * np.maximum(np.arange(_DEPTHS), 0.5) / (_DEPTHS - 1)
    sigma = probe.beam_sigma_mm(depth)[0]
    column = np.arange(_DISTANCES)

    unit = probe.wavelength_mm * np.maximum(probe.receive_f_number, depth / probe.aperture_mm)
    x, amplitude = _transmitted(probe, depth, unit)
    pattern = (amplitude * apodized_pattern(x / unit[:, None], probe.receive_apodization)) ** 2
    tails = _tails(x, pattern, sigma)
    place = column / (_DISTANCES - 1)
    clutter = 0.5 * probe.clutter_power / (_STEP * (_DISTANCES - 1)) * (1.0 + np.cos(np.pi * place))
    fading = 0.5 + 0.5 * np.cos(np.pi * np.clip(4.0 * place - 3.0, 0.0, 1.0))  # the table ends smoothly
    lateral = [
        _density(tail, _STEP * scale * column, scale) * scale * fading + clutter
        for tail, scale in zip(tails, unit, strict=True)
    ]

    return np.sqrt(lateral).astype(np.float32)


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
    power = np.maximum(lobes_of(probe).astype(float) ** 2 - clutter, 0.0)
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


@lru_cache(maxsize=16)
def plane_echoes(probe: Probe) -> np.ndarray:
    """(PLANE_DEPTHS, PLANE_TILTS, 2) float32, echoes of tilted planes re square ones, for kernels/interfaces.cl.

    Exponents of two of the peak of the pulse, by lateral and by elevational tilt: at depths evenly from the face to the
    image depth, and tangents of the tilt whose square roots are evenly from 0 to 1. What leaves the transmit aperture
    at a is reflected to c - a, c = 2 s tan(tilt), but for diffraction:

        integral T(a) R(b) exp(-i k (a + b - c)^2 / 4 s) da db,    T(a) = exp(i k a^2 (1 / s - 1 / F) / 2)

    over the apertures, at every frequency of the pulse (docs/physics.md#3-rays). Those of the second harmonic are not
    known: nan, for which the kernel takes those of a Gaussian beam.
    """
    rows, tilts = CONSTANTS["PLANE_DEPTHS"], CONSTANTS["PLANE_TILTS"]
    if probe.harmonic:
        return np.full((rows, tilts, 2), np.nan, np.float32)
    depth = probe.displayed_mm * np.maximum(np.arange(rows), 0.5) / (rows - 1)
    received = np.minimum(probe.aperture_mm, depth / probe.receive_f_number)
    zones = np.array(probe.transmit_apertures())
    if len(zones):
        focus, sent = zones[probe.zone_at(depth)].T
    else:
        least, slope = probe.compounded_beam()
        wide = np.maximum(least, slope * depth) * FWHM_PER_SIGMA / MAIN_LOBE
        focus, sent = depth, depth * probe.wavelength_mm / wide
    lens = np.full(rows, probe.lens_height_mm), 1.0 / depth - 1.0 / probe.elevation_focus_mm
    lateral = (sent, 1.0 / depth - 1.0 / focus), (received, 0.0 * depth)
    found = [
        _plane_echo(probe, depth, *apertures, apodization)
        for apertures, apodization in ((lateral, probe.receive_apodization), ((lens, lens), 0.0))
    ]
    return np.log2(np.maximum(np.stack(found, axis=-1), _LEAST_PLANE)).astype(np.float32)


def _plane_echo(
    probe: Probe, depth: np.ndarray, sent: tuple[np.ndarray, np.ndarray], received: tuple[np.ndarray, np.ndarray],
    apodization: float,
) -> np.ndarray:  # fmt: skip
    """(depths, tilts) peaks of the integral of plane_echoes; apertures are (sizes in mm, bends 1 / s - 1 / F)."""
    step = (sent[0] + received[0])[:, None] / _PLANE_POINTS
    place, across = (np.fft.fftfreq(2 * _PLANE_POINTS, per) for per in (0.5 / _PLANE_POINTS, 1.0))
    place, across = step * place, across / step
    one, other = (np.clip(0.5 + (0.5 * size[:, None] - np.abs(place)) / step, 0.0, 1.0) for size, _ in (sent, received))
    other *= 1.0 - apodization * np.sin(np.pi * place / received[0][:, None]) ** 2
    spread = float(probe.received_bandwidth / FWHM_PER_SIGMA)
    frequency = np.maximum(1.0 + spread * np.linspace(-2.5, 2.5, _PLANE_FREQUENCIES), 0.1)
    time = np.linspace(-0.5, 0.5, 32) * (_PLANE_FREQUENCIES - 1) / (frequency[-1] - frequency[0])
    echo: np.ndarray = np.zeros((1, 1, 1))
    for f in frequency:
        length = probe.wavelength_mm / f
        pairs = np.exp(2j * np.pi * length * depth[:, None] * across**2 - 0.5 * ((f - 1.0) / spread) ** 2) / np.sqrt(f)
        for weight, (_, bend) in ((one, sent), (other, received)):
            pairs = pairs * np.fft.fft(weight * np.exp(1j * np.pi / length * bend[:, None] * place**2), axis=1)
        echo = echo + np.fft.ifft(pairs, axis=1)[:, :_PLANE_POINTS, None] * np.exp(-2j * np.pi * f * time)
    peak, tilt = np.abs(echo).max(axis=-1), np.linspace(0.0, 1.0, CONSTANTS["PLANE_TILTS"]) ** 2
    ways = zip(depth, place[:, :_PLANE_POINTS], peak, strict=True)
    return np.array([np.interp(2.0 * s * tilt, at, of / of[0], right=0.0) for s, at, of in ways])
