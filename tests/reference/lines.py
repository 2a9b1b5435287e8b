"""From impulses of traced lines to the baseband signal of scan lines (docs/physics.md#4-beam-and-pulse)."""

from __future__ import annotations

import numpy as np

from SlicerUSSim.Logic.imaging.stage import DeviceFrame
from tests.reference.beam import Beam


def lateral_beam(record: np.ndarray, traced: np.ndarray, spreads: np.ndarray, frequencies: np.ndarray) -> np.ndarray:
    """(scan lines, samples) complex impulses from those of the traced lines (2 traced lines, samples).

    `spreads` (screen lines, depths, 2) is by how much tissue has made the beam wider, and a factor of its echoes;
    `frequencies` (scan lines, samples) are relative to the transmitted pulse.
    """
    beam = Beam(record)
    of, edges = beam.of, traced[1:-1:2] + traced[2::2]  # edge n is half a step after traced line n
    depth = np.arange(traced.shape[1]) * of["sample_mm"]
    screens, depths, _ = spreads.shape
    nodes = of["screen_step"] * np.arange(1, depths + 1)
    result = np.empty((int(of["scan_lines"]), len(depth)), complex)
    for n in range(len(result)):
        cosine = beam.line_cosine(n)
        start, centre = beam.line_start(n), of["guard_lines"] + n * of["lateral_rays"]
        s = np.maximum(depth - start, 0.0)
        line = centre * (screens - 1) / (of["traced_lines"] - 1)
        left = min(int(line), screens - 2)
        of_line = spreads[left] + (line - left) * (spreads[left + 1] - spreads[left])
        spread, factor = (np.interp(s, nodes, of_line[:, k]) for k in range(2))
        sigma, apart = spread * beam.lateral_sigma(s, frequencies[n], cosine), beam.line_distance(s + start)
        # Between traced lines in sigmas of these weights, less the variance that the distribution to edges has added
        narrow2 = np.maximum(1.0 - (apart / sigma) ** 2 / 6.0, 0.25)
        apart2 = (apart / sigma) ** 2 / narrow2
        away = np.arange(len(edges))[:, None] + 0.5 - centre
        near = np.abs(away) <= np.ceil(of["beam_cutoff"] * sigma / apart) + 0.5
        # The phase in the middle of sixteen samples.
        blocks = np.arange(len(s)) // 16
        middle = np.maximum((16 * blocks + 8) * of["sample_mm"] - start, 0.0)
        of_blocks = frequencies[n].reshape(-1, 16).mean(axis=1)[blocks]
        # A beam that tissue has made wider keeps its spatial frequencies.
        undisturbed2 = beam.lateral_sigma(middle, of_blocks, cosine) ** 2
        frequencies2 = 1.0 + (beam.lateral_curvature(middle, of_blocks, cosine) * undisturbed2) ** 2
        curved = np.sqrt(np.maximum(frequencies2 - spread**-2.0, 0.0)) / (spread * undisturbed2)
        curved = curved * beam.line_distance(middle + start) ** 2 * bool(of["wavefront_curvature"])
        weights = near * np.exp(-0.5 * (apart2 + 1j * curved) * away**2)
        # Interpolation between edges loses some power of what turns from one to the next.
        kept = (2.0 + np.exp(-0.25 * (apart2 + curved**2 / apart2))) / (2.0 + np.exp(-0.25 * apart2))
        result[n] = (weights * edges).sum(axis=0) * factor * np.sqrt(apart2 * spread / (2.0 * np.pi * kept))
    return result


def pulse_taps(sigma: float) -> np.ndarray:
    """(2 n + 1,) envelope of the pulse; its width with the interpolation of impulses is `sigma` samples."""
    own = np.sqrt(max(sigma**2 - 1.0 / 6.0, 0.25))
    at = np.arange(-np.ceil(3.7 * own), np.ceil(3.7 * own) + 1.0)
    return sigma / own * np.exp(-0.5 * (at / own) ** 2)


def baseband(frame: DeviceFrame, scanned: np.ndarray, frequencies: np.ndarray) -> np.ndarray:
    """(scan lines, samples) complex: impulses of the same shape, each with the pulse of the frequency at its depth."""
    beam, samples = Beam(frame.acquisition), scanned.shape[1]
    step = beam.of["sample_mm"] * beam.of["cycles_per_mm"]
    missing = 1.0 - frequencies
    turns = np.cumsum(missing, axis=1) * step - 0.5 * step * (missing + missing[:, :1])
    # Of an echo between two samples, which have one phase: the mean of |1 - t + t exp(i angle)|^2
    kept = (2.0 + np.cos(2.0 * np.pi * step * missing)) / 3.0
    lines = scanned * np.exp(2j * np.pi * turns) / np.sqrt(kept)
    if frame.probe.harmonic:
        level = frame.probe.harmonic_level(np.arange(samples) * beam.of["sample_mm"])
        lines = lines * level[np.maximum(samples_from_face(beam, *scanned.shape), 0)]
    for factor in (frame.contact, frame.probe.line_levels()):
        lines = lines * (1.0 if factor is None else factor[:, None])
    taps = pulse_taps(frame.axial_sigma_mm / beam.of["sample_mm"])
    return np.array([np.convolve(line, taps, "same") for line in lines]) * np.exp(-2j * np.pi * turns)


def samples_from_face(beam: Beam, lines: int, samples: int) -> np.ndarray:
    """(lines, samples) numbers of samples behind the point where a line leaves the face."""
    starts = np.floor(beam.line_start(np.arange(lines)) / beam.of["sample_mm"] + 0.5).astype(int)
    return np.arange(samples) - starts[:, None]
