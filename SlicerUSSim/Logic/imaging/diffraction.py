"""What the diffraction pattern of a probe's apertures has beside the Gaussian main beam, as tables for the kernels.

J. W. Goodman, Introduction to Fourier Optics, sections 4.2 and 4.4 (docs/physics.md#side-lobes-and-ring-down).
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy import fft
from scipy.special import erfc

from SlicerUSSim.Logic.opencl.layout import CONSTANTS
from SlicerUSSim.Logic.probe.beam import FWHM_PER_SIGMA, MAIN_LOBE, apodized_pattern
from SlicerUSSim.Logic.probe.lens import cosines, phasor

if TYPE_CHECKING:
    from SlicerUSSim.Logic.probe.arrays import Probe

_DEPTHS, _DISTANCES, _STEP = (CONSTANTS[f"LOBE_{name}"] for name in ("DEPTHS", "DISTANCES", "STEP"))
_POINTS, _PADDED = 512, 4096  # of an aperture, and of its Fourier transform
_PLANE_POINTS, _PLANE_FREQUENCIES, _PLANE_TIMES = 256, 9, 31  # of both apertures, and of the pulse, for planes
_LEAST_PLANE = 1e-4  # of these, relative to a square plane
_BEYOND_SIGMAS = 2.0  # what is closer to the axis belongs to the main beam
_GAUSSIAN_SIGMAS = 6.0  # that has nothing beyond these
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
    sampled at intervals, on either side, relative to the main beam.

    The transmit aperture is uniform and focused once (with zones: once for each), the receive
    aperture has the weights 1 - a + a cos(pi x)^2 and is focused at every depth. The second harmonic is fed by the
    square of the field of the pulse, of twice the received wavelength. Compounded waves are in focus at every depth.
    The probe's clutter falls as 1 + cos(pi u / U) with the distance u up to the end U of the lateral table.
    """
    depth, unit, clutter = _rows(probe)
    sigma = probe.beam_sigma_mm(depth)[0]
    column = np.arange(_DISTANCES)
    step, amplitude = _transmitted(probe, depth, unit)
    place = (step / unit).astype(np.float32)[:, None] * np.arange(amplitude.shape[1], dtype=np.float32)
    pattern = (amplitude * apodized_pattern(place, probe.receive_apodization)).astype(float) ** 2
    at = _STEP * column + np.array([[-0.5], [0.5]])  # of the lobe over which power is averaged
    near, far = np.moveaxis(_excess(step, pattern, sigma, unit[:, None, None] * np.maximum(at, 0.0)), 1, 0)
    ends = np.clip(4.0 * column / (_DISTANCES - 1) - 3.0, 0.0, 1.0)  # the table ends smoothly
    fading = 0.5 + 0.5 * np.cos(np.pi * ends)
    return np.sqrt(0.5 * (near - far) * fading + clutter).astype(np.float32)


@lru_cache(maxsize=16)
def lateral_weights(probe: Probe) -> np.ndarray:
    """(depths, distances) float32, the lateral lobes as kernels/side_lobes.cl takes them.

    The kernel makes lobes wider: it applies them to lines, which have the main beam, averages these to nodes, and
    interpolates between nodes and between the table's distances. Where the beam is out of focus and lobes fall by 8 dB
    per millimetre, that adds 1 to 2 dB. So weights are such that lobes have the power of the pattern after it.
    """
    depth, unit, clutter = _rows(probe)
    apart = np.maximum(probe.line_distance_mm(depth) / unit, 1e-6)
    dense = -(-probe.scan_lines // CONSTANTS["LOBE_NODES"])
    node = apart * np.clip((1.0 / apart).astype(int), dense, probe.scan_lines)
    variance = 0.5 * (probe.beam_sigma_mm(depth)[0] / unit) ** 2 + _NODE_VARIANCE * node**2 + _TABLE_VARIANCE
    column = np.arange(_DISTANCES)
    power = np.maximum(lobes_of(probe).astype(float) ** 2 - clutter, 0.0)
    peak = power.argmax(axis=1)[:, None]  # nearer the axis is the main beam, which hides lobes
    known = np.log(np.where(column < peak, np.take_along_axis(power, peak, axis=1), power) + _LEAST_POWER)
    part = np.arange(_FINER) / _FINER
    between = known[:, :-1, None] + part * np.diff(known, axis=1)[..., None]
    made = wanted = np.exp(np.append(between.reshape(_DEPTHS, -1), known[:, -1:], axis=1))
    # Mirrored at both ends, a Gaussian filter is a product with the coefficients of cosines.
    waves = np.linspace(0.0, np.pi * _FINER / _STEP, wanted.shape[1])
    filtered = np.exp(-0.5 * np.outer(variance, waves**2)) / (2 * (len(waves) - 1))
    for _ in range(_SHARPENED):
        made = made * wanted / np.maximum(cosines(cosines(made, kind=1) * filtered, kind=1), _LEAST_POWER)
    rows = np.where(column > peak, np.maximum(made[:, ::_FINER] - _LEAST_POWER, 0.0), power)
    return np.sqrt(rows + clutter).astype(np.float32)


def _rows(probe: Probe) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(depths,) mm, (depths,) receive wavelengths x f-number in mm, and (distances,) power of the clutter."""
    depth = probe.displayed_mm * np.maximum(np.arange(_DEPTHS), 0.5) / (_DEPTHS - 1)
    unit = probe.wavelength_mm * np.maximum(probe.receive_f_number, depth / probe.aperture_mm)
    falling = 1.0 + np.cos(np.linspace(0.0, np.pi, _DISTANCES))
    return depth, unit, 0.5 * probe.clutter_power / (_STEP * (_DISTANCES - 1)) * falling


def _transmitted(probe: Probe, depth: np.ndarray, unit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """((depths,) mm, and (depths, n) amplitudes so far apart, from the axis on) of what is transmitted or its harmonic.

    `unit` (depths,) is the wavelength x f-number of reception, in millimetres.
    """
    zones = np.array(probe.transmit_apertures())
    if len(zones) == 0:
        least, slope = probe.compounded_beam()
        own = np.maximum(least, slope * depth) * FWHM_PER_SIGMA / MAIN_LOBE
        step = np.minimum(unit, own) * _POINTS / _PADDED
        return step, np.sinc(np.outer(step / own, np.arange(_PADDED // 2)))  # each wave is plane, and so its harmonic
    focus, aperture = zones[probe.zone_at(depth)].T
    step, amplitude = _focused_once(probe.wavelength_mm, aperture, focus, depth, octaves=int(probe.harmonic))
    return step, amplitude**2 if probe.harmonic else amplitude


def _focused_once(
    wavelength: float, aperture: np.ndarray, focus: np.ndarray, depth: np.ndarray, octaves: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """((depths,) mm, and (depths, n) amplitudes so far apart, from the axis on) of a uniform aperture, by Fresnel.

    The field has a frequency `octaves` lower, at the distances of this wavelength; the others are (depths,). So
    near the face that points are too far apart, it is the shadow of the aperture: that of farther away, as much wider.
    """
    nearest = 1.0 / (1.0 / focus + 0.5 * _POINTS * wavelength / aperture**2)
    far = np.maximum(depth, nearest)
    wider = np.where(depth < nearest, (focus - depth) / (focus - nearest), 1.0)
    point = (np.arange(_POINTS // 2) + 0.5) / _POINTS * aperture[:, None]
    phase = np.pi / (2**octaves * wavelength) * (1.0 / far - 1.0 / focus)[:, None] * point**2
    field = cosines(phasor(phase), n=2**octaves * _PADDED // 2)[..., : _PADDED // 2]  # all is even
    step = wider * wavelength * far * _POINTS / (aperture * _PADDED)
    return step, np.abs(field)


def _excess(step: np.ndarray, pattern: np.ndarray, sigma: np.ndarray, at: np.ndarray) -> np.ndarray:
    """By how much a pattern has more power beyond the distances `at` (depths, ...) than a Gaussian.

    The pattern (depths, n) is at distances `step` (depths,) apart, from the axis on; `sigma` (depths,) of the
    Gaussian's amplitude. The excess falls with the distance, to 0; what is near the axis belongs to the main beam.
    """
    inside = 0.5 * (pattern + pattern[:, :1])
    inside += np.gradient(pattern, axis=1) / 12.0  # Euler and Maclaurin's correction of the sums
    inside = np.subtract(np.cumsum(pattern, axis=1), inside, out=inside)
    total = inside[:, -1:].copy()
    beyond = np.subtract(1.0, np.divide(inside, total, out=inside), out=inside)
    excess, wide = beyond.copy(), int(_GAUSSIAN_SIGMAS * (sigma / step).max()) + 1
    excess[:, :wide] -= erfc(np.outer(step / sigma, np.arange(pattern.shape[1])[:wide]))
    # The last point before the nearest distance that counts moves there, along a cubic.
    nearest, row = _BEYOND_SIGMAS * sigma / step, np.arange(len(step))
    n = np.minimum(nearest.astype(int), pattern.shape[1] - 2)
    t, rise = nearest - n, beyond[row, n + 1] - beyond[row, n]
    density = [pattern[row, n + k] / total[:, 0] for k in (0, 1)]
    bent = (1.0 - t) * (-density[0] - rise) + t * (density[1] + rise)
    excess[row, n] = beyond[row, n] + t * rise + t * (1.0 - t) * bent - erfc(_BEYOND_SIGMAS)
    excess = np.maximum.accumulate(np.maximum(excess, 0.0)[:, ::-1], axis=1)[:, ::-1]

    nearest, n, t = (each.reshape(-1, *(1,) * (at.ndim - 1)) for each in (nearest, n, t))
    place = np.maximum(at / step.reshape(nearest.shape), nearest)
    before = np.minimum(place.astype(int), pattern.shape[1] - 2)
    part = np.minimum(place - before, 1.0)
    part = np.where(before == n, (part - t) / (1.0 - t), part)
    low, high = (excess[row.reshape(n.shape), before + k] for k in (0, 1))
    return low + part * (high - low)


@lru_cache(maxsize=16)
def plane_echoes(probe: Probe) -> np.ndarray:
    """(PLANE_DEPTHS, PLANE_TILTS, 2) float32, echoes of tilted planes re square ones, for kernels/interfaces.cl.

    Exponents of two of the peak of the pulse, by lateral and by elevational tilt: at depths evenly from the face to the
    image depth, and tangents of the tilt whose square roots are evenly from 0 to 1. What leaves the transmit aperture
    at a is reflected to c - a, c = 2 s tan(tilt), except for diffraction:

        integral T(a) R(b) exp(-i k (a + b - c)^2 / 4 s) da db,    T(a) = exp(i k a^2 (1 / s - 1 / F) / 2)

    over the apertures, at every frequency of the pulse (docs/physics.md#3-rays). Those of the second harmonic are not
    known: nan, for which the kernel takes those of a Gaussian beam.
    """
    rows, tilts = CONSTANTS["PLANE_DEPTHS"], CONSTANTS["PLANE_TILTS"]
    if probe.harmonic:
        return np.full((rows, tilts, 2), np.nan, np.float32)
    depth = _plane_depths(probe.displayed_mm)
    received = np.minimum(probe.aperture_mm, depth / probe.receive_f_number)
    zones = np.array(probe.transmit_apertures())
    if len(zones):
        focus, sent = zones[probe.zone_at(depth)].T
    else:
        least, slope = probe.compounded_beam()
        wide = np.maximum(least, slope * depth) * FWHM_PER_SIGMA / MAIN_LOBE
        focus, sent = depth, depth * probe.wavelength_mm / wide
    pulse = probe.wavelength_mm, float(probe.received_bandwidth / FWHM_PER_SIGMA)
    lateral = _plane_echo(*pulse, depth, sent, 1.0 / depth - 1.0 / focus, received, probe.receive_apodization)
    elevational = _lens_echo(*pulse, probe.displayed_mm, probe.lens_height_mm, probe.elevation_focus_mm)
    return np.stack([lateral, elevational], axis=-1)


@lru_cache(maxsize=16)
def _lens_echo(wavelength_mm: float, spread: float, depth_mm: float, height_mm: float, focus_mm: float) -> np.ndarray:
    """(PLANE_DEPTHS, PLANE_TILTS) of plane_echoes by elevational tilt, of which probes often have the same."""
    depth = _plane_depths(depth_mm)
    return _plane_echo(wavelength_mm, spread, depth, np.full(len(depth), height_mm), 1.0 / depth - 1.0 / focus_mm)


def _plane_depths(depth_mm: float) -> np.ndarray:
    rows = CONSTANTS["PLANE_DEPTHS"]
    return depth_mm * np.maximum(np.arange(rows), 0.5) / (rows - 1)


def _plane_echo(
    wavelength_mm: float, spread: float, depth: np.ndarray, sent: np.ndarray, bend: np.ndarray,
    received: np.ndarray | None = None, apodization: float = 0.0,
) -> np.ndarray:  # fmt: skip
    """(depths, tilts) float32 exponents of two of the peaks of the integral of plane_echoes.

    `sent` are sizes in mm, with the `bend` 1 / s - 1 / F; `received` those of apertures that are in focus at each of
    the depths, by default the same as sends. All is even, so that transforms are those by cosines.
    """
    step = (sent + (sent if received is None else received))[:, None] / _PLANE_POINTS
    place = step * np.arange(_PLANE_POINTS + 1)
    across = np.arange(_PLANE_POINTS + 1) / (2 * _PLANE_POINTS * step)
    f = np.linspace(max(1.0 - 2.5 * spread, 0.1), 1.0 + 2.5 * spread, _PLANE_FREQUENCIES)[:, None, None]

    def opening(size: np.ndarray) -> np.ndarray:
        return np.clip(0.5 + (0.5 * size[:, None] - place) / step, 0.0, 1.0)

    pairs = _spectrum(opening(sent), np.pi / wavelength_mm * f * (bend[:, None] * place**2))
    if received is None:
        pairs *= pairs
    else:
        weights = 1.0 - apodization * np.sin(np.pi * place / received[:, None]) ** 2
        pairs *= _spectrum(opening(received) * weights, np.zeros_like(place))
    pairs *= phasor(2.0 * np.pi * wavelength_mm / f * (depth[:, None] * across**2))
    echo = cosines(pairs, kind=1)[..., :_PLANE_POINTS]
    # At times evenly on both sides of 0; without BLAS, whose threads wait for those of the device
    late = np.exp(-1j * np.pi / _PLANE_TIMES * np.arange(_PLANE_FREQUENCIES))[:, None, None]
    pulse = (late * np.exp(-0.5 * ((f - 1.0) / spread) ** 2) / np.sqrt(f)).astype(np.complex64)
    peak = np.abs(np.asarray(fft.fft(echo * pulse, n=_PLANE_TIMES, axis=0))).max(axis=0)
    tilt = np.linspace(0.0, 1.0, CONSTANTS["PLANE_TILTS"]) ** 2
    ways = zip(depth, place[:, :_PLANE_POINTS], peak, strict=True)
    found = np.array([np.interp(2.0 * s * tilt, at, of / of[0], right=0.0) for s, at, of in ways])
    return np.log2(np.maximum(found, _LEAST_PLANE)).astype(np.float32)


def _spectrum(weight: np.ndarray, phase: np.ndarray) -> np.ndarray:
    """complex64, of an even wave from the axis on."""
    return cosines(weight.astype(np.float32) * phasor(phase), kind=1)
