"""A scanner's floor: side lobes and ring-down (kernels/side_lobes.cl, bmode.cl)."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy import integrate, special

from SlicerUSSim.Logic.probe.arrays import Probe
from SlicerUSSim.Logic.verification.numpy_model.acquisition import harmonic_level
from SlicerUSSim.Logic.verification.numpy_model.beam import Beam
from SlicerUSSim.Logic.verification.numpy_model.elementary import f32, hash_mix

_COARSER = 3.0
#: Samples with one width of the lobes
_TOGETHER = 16
_WAVELENGTH = 1.54  # mm at 1 MHz
_SIGMA = 1.21 / np.sqrt(8.0 * np.log(2.0))  # of a one-way beam, in wavelengths x f-number


def elevational_lobes(acquisition: np.ndarray, probe: Probe) -> np.ndarray:
    """The record for what elevational side lobes receive: a wider beam, a coarser lattice with its own scatterers."""
    record = acquisition.copy()
    power, sigma = lobes(0.0, probe.harmonic)
    focus, rayleigh = float(acquisition["elevation_focus"]), float(acquisition["elevation_rayleigh"])
    waist, growth = (
        float(acquisition["elevation_sigma"]),
        sigma * _WAVELENGTH / (probe.frequency_mhz * (1 + probe.harmonic) * probe.elevation_aperture_mm),
    )
    # waist^2 (1 + ((z - focus) / rayleigh)^2) + (growth z)^2, about where it is least
    divergence = np.hypot(waist / rayleigh, growth)
    at = focus * (waist / rayleigh / divergence) ** 2
    width = np.sqrt(waist**2 * (1.0 + ((at - focus) / rayleigh) ** 2) + (growth * at) ** 2)
    record["elevation_sigma"], record["elevation_focus"] = width, at
    record["elevation_rayleigh"] = width / divergence
    record["cell_mm"] = _COARSER * float(acquisition["cell_mm"])
    record["seed"] = hash_mix(np.array([acquisition["seed"] ^ np.uint32(0x51DE10BE)], np.uint32))[0]
    record["speckle_scale"] = float(acquisition["speckle_scale"]) * _COARSER**1.5 * np.sqrt(power)
    return record


@cache
def lobes(apodization: float, harmonic: bool) -> tuple[float, float]:
    """(power, sigma in wavelengths x f-number) of a Gaussian with the pattern's power beyond 2 and 3 of these.

    The pattern of weights 1 - a + a cos^2 = (1 - a / 2) + (a / 2) cos(2 pi x) is sinc functions at -1, 0 and 1.
    """
    half = 0.5 * apodization

    def pattern(u: float) -> float:
        shifted = np.sinc(u - 1.0) + np.sinc(u + 1.0)
        sent = np.sinc(u / 2.0) ** 2 if harmonic else np.sinc(u)
        return float((sent * ((1.0 - half) * np.sinc(u) + 0.5 * half * shifted) / (1.0 - half)) ** 2)

    def power(low: float) -> float:
        return sum(integrate.quad(pattern, a, a + 1.0)[0] for a in np.arange(low, 64.0))

    near, far = power(2.0) / power(0.0), power(3.0) / power(0.0)
    widths = np.geomspace(0.3, 4.0, 200_001)
    ratios = special.erfc(3.0 / widths) / special.erfc(2.0 / widths)
    sigma = float(np.interp(far / near, ratios, widths))
    return near / float(special.erfc(2.0 / sigma)), sigma


def add_lateral_lobes(acquisition: np.ndarray, probe: Probe, scanned: np.ndarray) -> np.ndarray:
    """(scan lines, samples) complex64: with a broad Gaussian of the lines, in quadrature and of the lobes' power."""
    beam = Beam(acquisition)
    lines, samples = scanned.shape
    result = scanned.astype(np.complex128)
    starts = beam.line_start(np.arange(lines))
    for first in range(0, samples, _TOGETHER):
        block = scanned[:, first : first + _TOGETHER]
        paths = np.maximum(f32((first + 0.5 * _TOGETHER) * acquisition["sample_mm"]) - starts, f32(0))
        for path in np.unique(paths):  # one, unless lines are steered
            here = np.flatnonzero(paths == path)
            for place, weight in zip(*_lobe_weights(acquisition, probe, beam, np.array(path)), strict=True):
                to = here[(here + place >= 0) & (here + place < lines)]
                result[to, first : first + _TOGETHER] += 1j * weight * block[to + place]
    return result.astype(np.complex64)


def _lobe_weights(acquisition: np.ndarray, probe: Probe, beam: Beam, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(distances in scan lines, weights) of the lateral lobes at path length s."""
    power, sigma = lobes(probe.receive_apodization, probe.harmonic)
    apart = float(beam.line_distance(s)) * int(acquisition["lateral_rays"])
    main = float(beam.lateral_sigma(s))
    receive = max(float(acquisition["receive_sigma_min"]), float(acquisition["receive_sigma_slope"]) * float(s))
    wide = sigma / _SIGMA * receive
    rest = np.sqrt(max(wide**2 - main**2, 0.25 * wide**2))
    step = max(1, int(2.0 * main / apart))
    reach = int(np.ceil(float(acquisition["beam_cutoff"]) * rest / (step * apart)))
    places = np.arange(-reach, reach + 1)
    weights = np.exp(-0.5 * (places * step * apart / rest) ** 2)
    # A beam with a curved phase has less left of its sum.
    turned = 1.0 + (float(beam.lateral_curvature(s)) * main**2) ** 2
    return places * step, weights * np.sqrt(power * np.hypot(main, rest) / main) / weights.sum() * turned**0.25


def ring_down(acquisition: np.ndarray, probe: Probe, axial_sigma_mm: float) -> np.ndarray:
    """(samples,) complex64: pulses one width apart, of alternating sign, that fall by 40 dB over the ring-down."""
    depth = np.arange(int(acquisition["samples"])) * float(acquisition["sample_mm"])
    signal = np.zeros(len(depth), np.complex128)
    if probe.ring_down_mm > 0.0:
        apart, sign, place = np.sqrt(8.0 * np.log(2.0)) * axial_sigma_mm, 1.0, 0.0
        while place < 2.0 * probe.ring_down_mm:
            level = 10.0 ** ((probe.ring_down_db - 40.0 * place / probe.ring_down_mm) / 20.0)
            carrier = np.exp(-2j * np.pi * float(acquisition["cycles_per_mm"]) * place)
            signal += sign * level * carrier * np.exp(-0.5 * ((depth - place) / axial_sigma_mm) ** 2)
            sign, place = -sign, place + apart
    if probe.harmonic:
        signal *= harmonic_level(probe, depth)
    return signal.astype(np.complex64)
