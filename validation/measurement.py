"""Measurements in a frame: levels, positions and widths of echoes, correlations, the Rayleigh fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import integrate, special

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.base.settings import DisplaySettings
from SlicerUSSim.Logic.imaging.frame import Frame
from SlicerUSSim.Logic.probe.arrays import Probe

#: Without a scanner's look, which theory does not have
EVEN = DisplaySettings(look="even")


def level_db(signal: np.ndarray) -> float:
    """Mean power in dB; -300 for a signal of zeros."""
    return float(10.0 * np.log10(max((np.abs(signal) ** 2).mean(), 1e-30)))


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Magnitude of the complex correlation coefficient of two zero-mean signals."""
    return float(abs((a * b.conj()).sum()) / np.sqrt((abs(a) ** 2).sum() * (abs(b) ** 2).sum()))


def sample_positions(frame: Frame, probe: Probe) -> tuple[np.ndarray, np.ndarray]:
    """(lateral (scan_lines, samples), depth (scan_lines, samples)) of every sample in the probe frame, millimetres."""
    along = np.arange(frame.iq.shape[1]) * frame.sample_interval_mm
    origins, directions = probe.origins_mm(), probe.directions()
    return tuple(origins[:, a, None] + along * directions[:, a, None] for a in (0, 1))


def depth_window(frame: Frame, depth_mm: float, half_mm: float) -> np.ndarray:
    """(scan_lines, samples) of the baseband signal within `half_mm` of a distance along the lines."""
    first, last = (round((depth_mm + side * half_mm) / frame.sample_interval_mm) for side in (-1, 1))
    return frame.iq[:, first:last]


def region_level_db(frame: Frame, probe: Probe, region_mm: tuple[float, float, float, float]) -> float:
    """Mean power in dB of the samples in (left, right, top, bottom). Raises SimulationError if there are none."""
    x, y = sample_positions(frame, probe)
    left, right, top, bottom = region_mm
    inside = (x >= left) & (x <= right) & (y >= top) & (y <= bottom)
    require(bool(inside.any()), f"region is {region_mm} mm in the probe frame, expected samples in it")
    return level_db(frame.iq[inside])


def echo_near(
    frame: Frame, probe: Probe, place_mm: tuple[float, float], within_mm: float
) -> tuple[float, float, float]:
    """(lateral mm, depth mm, amplitude) of the strongest echo within a distance of a position (lateral, depth).

    Across the lines the position is the centroid of the power within half a millimetre of the echo's range; along the
    line it is the centroid of the power between the -6 dB points. NaN if the signal is zero there.
    Raises SimulationError for a position outside the imaged field.
    """
    x, y = sample_positions(frame, probe)
    near = np.hypot(x - place_mm[0], y - place_mm[1]) < within_mm
    require(bool(near.any()), f"position is {place_mm} mm, expected samples within {within_mm:g} mm of it")
    amplitude = np.where(near, np.abs(frame.iq), 0.0)
    line, sample = np.unravel_index(np.argmax(amplitude), amplitude.shape)
    if amplitude[line, sample] == 0.0:
        return np.nan, np.nan, 0.0
    half = max(round(0.5 / frame.sample_interval_mm), 1)
    power = (amplitude[:, max(sample - half, 0) : sample + half + 1] ** 2).sum(axis=1)
    power[power < 0.25 * power.max()] = 0.0
    position = float(np.average(np.arange(len(power)), weights=power))
    trace = np.abs(frame.iq[line])
    peak = trace[sample]
    first = last = sample
    while first > 0 and trace[first - 1] > 0.5 * peak:
        first -= 1
    while last + 1 < len(trace) and trace[last + 1] > 0.5 * peak:
        last += 1
    along = np.average(np.arange(first, last + 1), weights=trace[first : last + 1] ** 2) * frame.sample_interval_mm
    origin, direction = probe.line_at(probe.first_line + position * probe.line_spacing)
    x, y, _ = origin + along * direction
    return float(x), float(y), float(peak)


def full_width(positions: np.ndarray, amplitudes: np.ndarray, at: float = 0.5) -> float:
    """Width between the crossings of `at` times the maximum on either side of it (default: -6 dB, FWHM)."""
    top = int(np.argmax(amplitudes))
    limit = at * amplitudes[top]

    def crossing(step: int) -> float:
        n = top
        while 0 <= n + step < len(amplitudes) and amplitudes[n + step] >= limit:
            n += step
        require(0 <= n + step < len(amplitudes), f"profile ends above {at:g} of its maximum, expected a fall below it")
        inner, outer = amplitudes[n], amplitudes[n + step]
        return float(positions[n] + (positions[n + step] - positions[n]) * (inner - limit) / (inner - outer))

    return abs(crossing(1) - crossing(-1))


@dataclass(frozen=True, eq=False)
class RayleighFit:
    """The paper's Fig. 4: a Rayleigh density fitted to the histogram of an envelope scaled to 8 bits."""

    #: In grey levels
    sigma: float
    #: Sum of squared differences between the normalised histogram and the density, over 256 bins
    sse: float
    #: (256,) fraction of the samples per grey level
    histogram: np.ndarray
    #: (256,) fitted density
    density: np.ndarray


def fit_rayleigh(envelope: np.ndarray) -> RayleighFit:
    """Least-squares Rayleigh fit to the 256-bin histogram of `envelope`, its maximum scaled to 255."""
    from scipy.optimize import curve_fit

    scaled = 255.0 * np.ravel(envelope) / np.max(envelope)
    histogram = np.histogram(scaled, bins=256, range=(0.0, 256.0))[0] / scaled.size
    grey = np.arange(256) + 0.5

    def density(r, sigma):
        return r / sigma**2 * np.exp(-0.5 * (r / sigma) ** 2)

    (sigma,), _ = curve_fit(density, grey, histogram, p0=[np.sqrt(0.5 * (scaled**2).mean())])
    fitted = density(grey, sigma)
    return RayleighFit(float(sigma), float(((histogram - fitted) ** 2).sum()), histogram, fitted)


def envelope_snr(
    scatterers_per_mm3: float, sites_per_mm3: float, sigmas_mm: Sequence[tuple[float, float, float]]
) -> float:
    """Predicted mean / standard deviation of the envelope of speckle with few scatterers in the resolution cell.

    Scatterers of one amplitude and random phases are in independent cells of a lattice, of which each has one or none,
    anywhere within it. `sigmas_mm` of Gaussian point spread functions (axial, lateral, elevational), by which
    parts of the envelope of the same mean power were seen.

    The envelope A of such a sum is the length of a random walk in a plane: E A is the integral of (1 - f(u)) / u^2,
    and log f the sum of log(1 - q (1 - J0(u h))) over the cells, with the point spread function h and the share q of
    cells that have one (E. Jakeman, P. N. Pusey, IEEE Trans. Antennas Propag. 24, 1976; here to the second order of
    q, in which the mean over a cell counts).
    """
    r, dr = np.linspace(0.01, 7.99, 400, retstep=True)  # sigmas; volumes are in cells of (2 pi)^1.5 sigmas
    shell = np.sqrt(2.0 / np.pi) * r**2 * dr
    u = np.geomspace(1e-4, 1e4, 2400)
    missing = 1.0 - special.j0(u[:, None] * np.exp(-0.5 * r**2))
    first, second = missing @ shell, missing**2 @ shell
    means = []
    for sigmas in sigmas_mm:
        cell = (2.0 * np.pi) ** 1.5 * float(np.prod(sigmas))
        count, share = scatterers_per_mm3 * cell, scatterers_per_mm3 / sites_per_mm3
        # Of the power, two places of one cell have this correlation on average: E exp(-d^2 / 2 sigma^2) along each axis
        t = sites_per_mm3 ** (-1.0 / 3.0) / (np.sqrt(2.0) * np.array(sigmas))
        alike = float(np.prod(np.sqrt(np.pi) / t * special.erf(t) - (1.0 - np.exp(-(t**2))) / t**2))
        walk = np.exp(-count * (first + 0.5 * share * alike * second))
        power = count / 2.0**1.5
        below, above = 0.25 * power * u[0], 1.0 / u[-1]  # of the integral
        means.append((integrate.trapezoid((1.0 - walk) / u, np.log(u)) + below + above) / np.sqrt(power))
    mean = float(np.mean(means))
    return mean / float(np.sqrt(1.0 - mean**2))
